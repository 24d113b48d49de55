"""The multi-hypothesis measurer of an inertial-satellite system (Moroz): figures 1 and 2, the claims.

The paper gives neither the step nor any noise. Its text is read in two ways (see the task's module): ``increment``,
scenario ``paper``, where the velocity grows while the accelerometers measure zero, and ``kinematic``, where they
measure the acceleration. Every filter of one experiment faces the same noise.

Reading: "spherical error" is the three-dimensional root-mean-square error.
Reading: "loss of track" is not defined; here the first of ten steps in a row on which a pseudorange rate is
further from the combined prediction than a frequency discriminator measures (9.36 m/s), with tracking loops that
are steered by that prediction (``aperture``).
Reading: "without rates", "pseudoranges only": the standard deviation of what is left out is 10^6 of its unit.
"""

from ...evaluation.running.parallel import Workers
from ..reproduction import Progress, Reproduction, episode_count, judge_claims, reproduction_command
from . import claims, experiment, figures

TITLE = "Adaptive multi-hypothesis algorithm of an inertial-satellite navigation system"
STEPS = experiment.STEPS


def reproduce(
    progress: Progress, episodes: int | None = None, workers: Workers | None = None
) -> Reproduction:
    """Run the paper's experiment, judge its claims, and return claims, tables and figures.

    Comparators have at most ``FEW`` runs.
    """
    r = experiment.run_everything(progress, episode_count(episodes, experiment.EPISODES), workers)
    shown = judge_claims(claims.CLAIMS, claims.quantities(r)), claims.tables(r), figures.figures(r)
    return Reproduction(TITLE, *shown, command=reproduction_command(__name__, episodes))
