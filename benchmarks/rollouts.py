"""What a measurement of an evaluation costs, by competitor and by the number of episodes.

Processor time of running the episodes of one competitor and keeping what an evaluation keeps, in nanoseconds a
measurement; the second run in the process, of one thread.

    python benchmarks/rollouts.py --episodes 512 --episodes 2048
    python benchmarks/rollouts.py ManeuveringTarget semi-markov bptt kalman-imm-turn-tuned
"""

import argparse
import os
import time

os.environ.setdefault("OMP_NUM_THREADS", "1")

from filtergym.evaluation.running.evaluate import Experiment, plan_of, run_piece

from filtergym.names import find_competitor, import_problem

COMPETITORS = {
    "ManeuveringTarget": (
        "imm", "adaptive", "kalman-imm", "kalman-imm-turn", "sage-husa", "known-turn", "known-input-bound",
    ),
    "RadarEsmTracking": ("quasi-optimal", "joint-type", "ideal"),
    "LooselyCoupledNavigation": ("plain-reduced", "augmented", "augmented-mehra"),
    "UavAutopilot": ("kalman", "innovation-adaptive", "mehra"),
}  # fmt: skip
REPEATS = 3


def measure(environment: str, name: str, episodes: int) -> float:
    """Return nanoseconds a measurement, the least of several runs."""
    problem = import_problem(f"filtergym/{environment}-v0")
    plan = plan_of(Experiment(problem.task, episodes=episodes), {name: find_competitor(problem, name)})
    piece = plan.piece(name, 0, episodes, True)
    spent = []
    for _ in range(1 + REPEATS):
        start = time.process_time()
        run_piece(piece, lambda measurements: None)
        spent.append(time.process_time() - start)
    return min(spent[1:]) / piece.measurements * 1e9


def main() -> None:
    """Print a table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("environment", nargs="?", help="only this one")
    parser.add_argument("competitor", nargs="*", help="of it; default: some")
    parser.add_argument("--episodes", type=int, action="append")
    chosen = parser.parse_args()
    episodes = chosen.episodes or [512, 2048]
    only = chosen.environment
    competitors = {only: chosen.competitor or COMPETITORS.get(only, ())} if only else COMPETITORS
    print("| environment | competitor |", " | ".join(f"{count} episodes, ns" for count in episodes), "|")
    print("|" + "---|" * (2 + len(episodes)))
    for environment, names in competitors.items():
        for name in names:
            cells = [f"{measure(environment, name, count):.0f}" for count in episodes]
            print("|", environment, "|", name, "|", " | ".join(cells), "|", flush=True)


if __name__ == "__main__":
    main()
