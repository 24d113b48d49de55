"""Results of ten minutes of reinforcement learning: Stable-Baselines3 with its defaults.

    python benchmarks/plain_ppo.py --out plain_ppo.json
    python benchmarks/plain_ppo.py --algo sac --out plain_sac.json
    python benchmarks/plain_ppo.py --algo sac --set ent_coef=0.001 --split validation --out less_entropy.json

One environment by ``gymnasium.make(id)`` with the defaults of filtergym, 200,000 decisions (50,000 in
TightlyCoupledNavigation), five training seeds; then the deterministic policy, the action zero and the paper's algorithm
run on the same episodes of the test split. Runs in the file are not repeated.
"""

import argparse
import json
import time
import warnings
from pathlib import Path
from typing import Any

import gymnasium
import numpy
from rich.console import Console
from rich.table import Table

import filtergym
from filtergym.baselines.catalogue import baselines_of
from filtergym.envs.engine.catalogue import bare_name

LONG = {"filtergym/TightlyCoupledNavigation-v0"}
"""Environments in which a decision takes ten measurements of three filters: fewer decisions, and fewer episodes."""


POLICIES = {"ppo": "MlpPolicy", "recurrent-ppo": "MlpLstmPolicy", "sac": "MlpPolicy"}
"""Algorithms, and the kind of their networks."""
ROLLOUT = {"ppo": 2048, "recurrent-ppo": 128}
"""Decisions of a rollout by default, in one environment."""


def arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--algo", choices=sorted(POLICIES), default="ppo")
    parser.add_argument("--environment", action="append", help="id; default: all")
    parser.add_argument("--seeds", type=int, default=5, help="training runs of each")
    parser.add_argument(
        "--envs",
        type=int,
        default=1,
        help="native environments side by side, and PPO's rollout shared among them: faster, not quite the same",
    )
    parser.add_argument(
        "--steps", type=int, default=200_000, help="decisions; a quarter in TightlyCoupledNavigation"
    )
    parser.add_argument(
        "--episodes", type=int, default=2000, help="of the test; a fifth in TightlyCoupledNavigation"
    )
    parser.add_argument("--split", default="test", help="split of the episodes of the policies")
    parser.add_argument(
        "--set", action="append", default=[], metavar="NAME=VALUE", help="in place of the algorithm's default"
    )
    parser.add_argument("--out", type=Path, default=Path("plain_ppo.json"))
    parser.add_argument("--markdown", action="store_true", help="print the table as Markdown")
    return parser.parse_args()


def run(chosen: argparse.Namespace, id: str, seed: int) -> dict:
    import torch

    from filtergym.agents import to_sb3
    from filtergym.agents.sb3_algorithms import ALGORITHMS
    from filtergym.agents.settings import parse_settings

    algo, envs = chosen.algo, chosen.envs
    quarter, fifth = (4, 5) if id in LONG else (1, 1)
    steps, episodes = chosen.steps // quarter, chosen.episodes // fifth
    torch.set_num_threads(1)
    env: Any = gymnasium.make(id)
    settings: dict[str, Any] = {}
    if envs > 1:
        env = to_sb3(gymnasium.make_vec(id, num_envs=envs, autoreset_mode="SameStep"))
        settings = {"n_steps": ROLLOUT[algo] // envs} if algo in ROLLOUT else {}
    settings |= parse_settings([f"algo.{word}" for word in chosen.set])[1]
    begun = time.perf_counter()
    model: Any = ALGORITHMS[algo](POLICIES[algo], env, seed=seed, device="cpu", **settings).learn(steps)
    seconds = time.perf_counter() - begun
    paper = baselines_of(id).score_paper
    nothing = filtergym.FunctionPolicy(lambda shown: numpy.zeros((len(shown), *env.action_space.shape)))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of a model without normalisation
        results = filtergym.evaluate(
            id,
            {"plain": model, paper: paper, "nothing": nothing},
            episodes=episodes,
            seed=0,
            split=chosen.split,
        )
    names = ("plain", paper, "nothing")
    cost = {name: results["cost"].sel(policy=name).values.mean(axis=1) for name in names}
    return {
        "algorithm": algo,
        "environment": id,
        "seed": seed,
        "steps": steps,
        "seconds": round(seconds, 1),
        "control": str(results["control"].sel(policy="plain").values),
        "difference": float(cost["plain"].mean() / cost[paper].mean() - 1.0),
        "median_difference": float(numpy.median(cost["plain"] / cost[paper]) - 1.0),
        "zero_difference": float(cost["nothing"].mean() / cost[paper].mean() - 1.0),
        "zero_median_difference": float(numpy.median(cost["nothing"] / cost[paper]) - 1.0),
        "median_difference_to_zero": float(numpy.median(cost["plain"] / cost["nothing"]) - 1.0),
        "geometric_difference_to_zero": float(numpy.expm1(numpy.log(cost["plain"] / cost["nothing"]).mean())),
    }


def table(runs: list[dict]) -> Table:
    from scipy.stats import t

    title = "Stable-Baselines3, its defaults and ours: cost against the paper, %"
    shown = Table(title=title)
    for head in (
        "environment",
        "control",
        "decisions",
        "mean",
        "95 %",
        "median episode",
        "zero action",
        "its median",
        "seeds",
        "decisions/s",
    ):
        shown.add_column(head, no_wrap=True)
    for id in sorted({found["environment"] for found in runs}):
        own = sorted((found for found in runs if found["environment"] == id), key=lambda found: found["seed"])
        each = 100.0 * numpy.array([found["difference"] for found in own])
        half = t.ppf(0.975, max(len(own) - 1, 1)) * each.std(ddof=len(own) > 1) / len(own) ** 0.5
        median = 100.0 * numpy.median([found["median_difference"] for found in own])
        rate = numpy.median([found["steps"] / found["seconds"] for found in own])
        shown.add_row(
            bare_name(id),
            own[0]["control"],
            f"{own[0]['steps']:,}",
            f"{each.mean():+.1f}",
            f"[{each.mean() - half:+.1f}, {each.mean() + half:+.1f}]" if len(own) > 1 else "",
            f"{median:+.1f}",
            f"{100.0 * own[0]['zero_difference']:+.1f}",
            f"{100.0 * own[0]['zero_median_difference']:+.1f}",
            ", ".join(f"{value:+.1f}" for value in each),
            f"{rate:,.0f}",
        )
    return shown


def main() -> None:
    chosen = arguments()
    runs = json.loads(chosen.out.read_text()) if chosen.out.exists() else []
    console = Console()
    ids = chosen.environment or sorted(i for i in gymnasium.registry if i.startswith("filtergym/"))
    for seed in range(chosen.seeds):
        for id in ids:
            if any((found["environment"], found["seed"]) == (id, seed) for found in runs):
                continue
            runs.append(run(chosen, id, seed))
            chosen.out.write_text(json.dumps(runs, indent=1) + "\n")
            console.print(
                f"{id} seed {seed}: {100 * runs[-1]['difference']:+.1f} % in {runs[-1]['seconds']:.0f} s"
            )
    if chosen.markdown:
        from rich.box import MARKDOWN

        shown = table(runs)
        shown.box, shown.title = MARKDOWN, None
        Console(width=240).print(shown)
    else:
        console.print(table(runs))


if __name__ == "__main__":
    main()
