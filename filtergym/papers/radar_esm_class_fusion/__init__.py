"""Radar and ESM with class recognition (Ivanov, Seliverstov): figures 1 to 4 and the claims.

The paper shows curves without legible numbers. Its experiment leaves open the duration, the manoeuvre noise,
the composition of the classes and the rest that :class:`.RadarEsmTrackingParameters` marks "ours", so claims
are tested on sizes that those choices give, and a list of variants shows what depends on them.

Errors of a filter of one fixed class are exact (covariance recursion of truth and error together); those of
the adaptive filter are root-mean-squares over episodes.

Reading: the "posterior" deviations of figures 2 to 4 belong to one run "corresponding to figure 1", so they
are most likely the filters' own; both those and the actual errors are drawn, each by its name.
"""

from ...evaluation.running.parallel import Workers
from ..reproduction import Progress, Reproduction, episode_count, judge_claims, reproduction_command
from . import claims, experiment, figures

TITLE = "Adaptive radar and ESM tracking filter with recognition of the target's class"
STEPS = experiment.STEPS


def reproduce(
    progress: Progress, episodes: int | None = None, workers: Workers | None = None
) -> Reproduction:
    """Run the paper's experiment, judge its claims, and return claims, tables and figures.

    There are at least 100 episodes, so that every class has some.
    """
    r = experiment.run_everything(progress, episode_count(episodes, experiment.EPISODES, least=100), workers)
    shown = judge_claims(claims.CLAIMS, claims.quantities(r)), claims.tables(r), figures.figures(r)
    return Reproduction(TITLE, *shown, command=reproduction_command(__name__, episodes))
