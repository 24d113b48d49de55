"""How soon a training run beats the paper's algorithm: environment steps and seconds, five seeds, medians.

    python benchmarks/time_to_beat.py [ENVIRONMENT] [--algo ppo] [--steps N] [--set algo.n_steps=25 ...]

Every seed is trained in a process of its own, as ``filtergym train`` trains it, and is stopped at the first validation
whose whole 95 % interval lies below the paper's algorithm (512 episodes of the validation split). ``wall`` runs from
the start of the process to its end: imports, compilation, training, validations and checkpoints. ``processor`` is what
the process took of all cores, ``training`` the seconds in ``run.json``, from the making of the environments on. With
``--whole`` a run is not stopped, and the best validation of the whole budget stands beside.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

THREADS = {"OMP_NUM_THREADS": "1"}
"""One thread: matrices this small gain nothing by two."""


def arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("environment", nargs="?", default="filtergym/ManeuveringTarget-v0")
    parser.add_argument("--algo", default="ppo")
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--steps", type=int, help="environment steps of the whole run; default: as shipped")
    parser.add_argument("--validate-every", type=int, help="environment steps; default: as train")
    parser.add_argument("--set", action="append", default=[], help="as of filtergym train")
    parser.add_argument("--whole", action="store_true", help="do not stop when the paper is beaten")
    parser.add_argument("--only", type=int, help=argparse.SUPPRESS)  # the seed of a process of its own
    return parser.parse_args()


def train_once(chosen: argparse.Namespace, folder: Path) -> None:
    """Train one seed in this process."""
    from filtergym.agents.settings import THROUGH_THE_FILTER, parse_settings
    from filtergym.agents.training_run import RunOptions, new_run
    from filtergym.agents.training_session import Session
    from filtergym.baselines.problem import problem_of

    if chosen.algo in THROUGH_THE_FILTER:
        from filtergym.agents.bptt import train_bptt as train
    else:
        from filtergym.agents.sb3_training import train_sb3 as train

    keywords, hyperparameters = parse_settings(chosen.set)
    options = RunOptions(
        chosen.algo, steps=chosen.steps, seed=chosen.only, overrides=hyperparameters, keywords=keywords
    )
    run = new_run(problem_of(chosen.environment), options)

    def beaten(entry: Any) -> bool:
        return not chosen.whole and run.beat_paper is not None

    train(run, Session(folder, validate_every=chosen.validate_every, validated=beaten))


def measure(chosen: argparse.Namespace, seed: int) -> dict[str, float]:
    """Train one seed in a process of its own."""
    with tempfile.TemporaryDirectory() as folder:
        before, begun = os.times(), time.perf_counter()
        words = [sys.executable, __file__, *sys.argv[1:], "--only", str(seed)]
        subprocess.run(words, check=True, cwd=folder, env={**os.environ, **THREADS})
        wall, after = time.perf_counter() - begun, os.times()
        run = json.loads((Path(folder) / "run.json").read_text())
    best = min(run["validation"], key=lambda entry: entry["cost"])
    passed = run["beat_paper"] or {"steps": float("nan"), "seconds": float("nan")}
    return {
        "seed": seed,
        "steps": passed["steps"],
        "wall, s": wall,
        "processor, s": sum(after[2:4]) - sum(before[2:4]),
        "training, s": passed["seconds"],
        "best, %": 100.0 * best["relative_cost_difference"][0],
        "at steps": best["steps"],
    }


def main() -> None:
    chosen = arguments()
    if chosen.only is not None:
        train_once(chosen, Path.cwd())
        return
    import numpy

    found = []
    for seed in range(chosen.seeds):
        found.append(measure(chosen, seed))
        if seed == 0:
            print("  ".join(f"{name:>12}" for name in found[0]))
        print("  ".join(f"{value:12,.7g}" for value in found[-1].values()), flush=True)
    medians = [float(numpy.median([row[name] for row in found])) for name in found[0]]
    print("  ".join([f"{'median':>12}", *(f"{value:12,.7g}" for value in medians[1:])]))


if __name__ == "__main__":
    main()
