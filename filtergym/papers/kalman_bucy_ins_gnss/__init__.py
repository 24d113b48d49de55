"""Kalman-Bucy filters in orientation and navigation (Benkafo, Lobaty): figures 2, 4 and 5, and the claims.

The paper prints no numbers ("hypothetical conditions") and curves without ordinates. The examples below are
ours, chosen so that its figures look as described: (a) a first-order process, which the filter follows
although the reference goes elsewhere; (b) fusion of INS and GNSS, scenario ``paper`` of the environment.

Reading: "the systematic errors are compensated" is tested twice, as attenuation (smaller than in the INS) and
as removal (no mean error left).
"""

from ...evaluation.running.parallel import Workers
from ..reproduction import Progress, Reproduction, episode_count, judge_claims, reproduction_command
from . import claims, experiment, figures

TITLE = "Kalman-Bucy filters in orientation and navigation complexes: what they follow, and INS/GNSS fusion"
STEPS = experiment.STEPS


def reproduce(
    progress: Progress, episodes: int | None = None, workers: Workers | None = None
) -> Reproduction:
    """Run the paper's examples, judge its claims, and return claims, tables and figures."""
    r = experiment.run_everything(progress, episode_count(episodes, experiment.EPISODES), workers)
    shown = judge_claims(claims.CLAIMS, claims.quantities(r)), claims.tables(r), figures.figures(r)
    return Reproduction(TITLE, *shown, command=reproduction_command(__name__, episodes))
