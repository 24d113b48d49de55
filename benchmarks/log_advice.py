"""What is advised on logs with the truth beside: its judged error, against the rival and the best in hindsight.

The rival is the shipped filter that one would take by the same measurements.

Example: python benchmarks/log_advice.py walk.csv drive.csv
"""

import argparse
import math
import time

from filtergym.baselines.advice import advise
from filtergym.baselines.problem import problem_of
from filtergym.envs.engine.scenario_choice import read_recording
from filtergym.evaluation.statistics.bootstrap import Estimate

from filtergym.commands.evaluation import causal_names
from filtergym.names import find_competitor

ID = "filtergym/ManeuveringTarget-v0"


def percent(estimate: Estimate) -> str:
    """Difference with its interval, %."""
    if math.isnan(estimate.value):
        return "-"
    return "{:+.1f} [{:+.1f}, {:+.1f}]".format(*(100.0 * value for value in estimate))


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("logs", nargs="+")
    problem = problem_of(ID)
    print(
        "| log | advised | error | rival | against it, % | best in hindsight | against it, % | s | s of one core |"
    )
    print("|---|---|---|---|---|---|---|---|---|")
    for log in parser.parse_args().logs:
        recording = read_recording(log, ID, speeds=(0.001, 1000.0))
        shipped = {name: find_competitor(problem, name) for name in causal_names(problem, recording)}
        begun, used = time.perf_counter(), time.process_time()
        found = advise(problem, recording, shipped)
        seconds, cpu = time.perf_counter() - begun, time.process_time() - used
        errors = {c.name: c.error for c in found.competitors}
        one = found.advised
        print(
            f"| {recording.name} | {one.name}{' (fitted)' if one.fitted else ''} | {one.error:.4g} | {found.rival} "
            f"{errors[found.rival]:.4g} | {percent(one.relative_error)} | {found.best_shipped} "
            f"{errors[found.best_shipped]:.4g} | {percent(found.hindsight)} | {seconds:.1f} | {cpu:.1f} |",
            flush=True,
        )


if __name__ == "__main__":
    main()
