"""Reproduction of the Kalman filter in the control loop of an unmanned aircraft (Gridnev, Rusetski, Rak).

The paper prints the transition matrix, two kinds of input and the list of observed nodes; all other numbers are ours,
so its curves can be compared in kind only. Where possible, checks are exact (Lyapunov and Riccati equations).

Nodes: 1 the plant's input (control, command and white noise), 2 the observation z, 3 the estimate, 4 the
innovation; all of the output coordinate. Energy spectrum: ``|DFT|^2 T / n`` averaged over runs, two-sided.
"""

from ...evaluation.running.parallel import Workers
from ..reproduction import Progress, Reproduction, episode_count, judge_claims, reproduction_command
from . import claims, experiment, figures

TITLE = "Stochastic simulation of a UAV autopilot with the optimal Kalman filter (Gridnev, Rusetski, Rak)"
STEPS = experiment.STEPS


def reproduce(
    progress: Progress, episodes: int | None = None, workers: Workers | None = None
) -> Reproduction:
    """Run the paper's experiments, judge its claims, and return claims, tables and figures."""
    r = experiment.run_everything(progress, episode_count(episodes, experiment.EPISODES), workers)
    shown = judge_claims(claims.CLAIMS, claims.quantities(r)), claims.tables(r), figures.figures(r)
    return Reproduction(TITLE, *shown, command=reproduction_command(__name__, episodes))
