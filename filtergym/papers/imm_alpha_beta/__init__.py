"""The IMM over two alpha-beta filters (Bakulev, Sychev, Nguyen): figures 2 to 5, the gain grid, the claims.

The paper shows curves and prints no numbers, so its claims are tested on root-mean-square errors (RMS) along
x, as in its figure 4, over episodes and scans of the windows of scenario ``paper``. Every run faces the same
noise, so comparisons are paired.

Reading: the paper calls the improvement substantial without a number; here the RMS over the manoeuvre section
(the turn and the seven scans after it) must be at least ``SUBSTANTIAL`` smaller.
Reading: it gives no criterion for the best gains; here the RMS over the whole run.
"""

from ...evaluation.running.parallel import Workers
from ..reproduction import Progress, Reproduction, episode_count, judge_claims, reproduction_command
from . import claims, experiment, figures

TITLE = "Tracking a manoeuvring target with an IMM algorithm over two alpha-beta filters"
STEPS = experiment.STEPS


def reproduce(
    progress: Progress, episodes: int | None = None, workers: Workers | None = None
) -> Reproduction:
    """Run the paper's experiment, judge its claims, and return claims, tables and figures.

    A cell of the grids of gains has at most ``GRID_EPISODES`` runs.
    """
    r = experiment.run_everything(progress, episode_count(episodes, experiment.EPISODES), workers)
    shown = judge_claims(claims.CLAIMS, claims.quantities(r)), claims.tables(r), figures.figures(r)
    return Reproduction(TITLE, *shown, command=reproduction_command(__name__, episodes))
