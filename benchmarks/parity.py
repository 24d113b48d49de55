"""Differences of compiled steps from NumPy's: whole episodes in every environment, control and scenario.

    python benchmarks/parity.py [--environment ID] [--episodes N]

Both backends run the same episodes with the same random actions. The differences are of rounding, and grow where a
filter is unstable or decides by a threshold. The table shows the largest differences of an observation and of a reward
over all episodes and steps, ``|compiled - numpy| / (1 + |numpy|)``, and the median over the episodes of their largest.
"""

import argparse
from collections.abc import Iterator
from typing import NamedTuple

import gymnasium
import numpy

import filtergym
from filtergym.envs.engine.catalogue import catalogue


class Parity(NamedTuple):
    """Largest differences of compiled steps from NumPy's in one scenario under one control."""

    environment: str
    control: str
    scenario: str
    observation: float
    reward: float
    median: float
    """Median over episodes of the largest difference of an observation."""


def parity(id: str, control: str, scenario: str, episodes: int, decisions: int | None = None) -> Parity:
    envs = [
        gymnasium.make_vec(
            id,
            num_envs=episodes,
            control=control,
            scenario=scenario,
            backend=backend,
            autoreset_mode="Disabled",
        )
        for backend in ("compiled", "numpy")
    ]
    shown = [env.reset(seed=0)[0] for env in envs]
    envs[0].action_space.seed(0)
    worst = numpy.zeros(episodes)
    reward = 0.0
    last = envs[0].unwrapped.last_decision  # type: ignore[attr-defined]
    for _ in range(min(decisions or last, last)):
        worst = numpy.maximum(worst, _difference(*shown).max(axis=1))
        action = envs[0].action_space.sample()
        steps = [env.step(action) for env in envs]
        shown = [step[0] for step in steps]
        reward = max(reward, float(_difference(steps[0][1], steps[1][1]).max()))
    worst = numpy.maximum(worst, _difference(*shown).max(axis=1))
    return Parity(id, control, scenario, float(worst.max()), reward, float(numpy.median(worst)))


def _difference(one: numpy.ndarray, other: numpy.ndarray) -> numpy.ndarray:
    return numpy.abs(one - other) / (1.0 + numpy.abs(other))


def all_parities(ids: list[str], episodes: int) -> Iterator[Parity]:
    for id in ids:
        for control in catalogue()[id].controls:
            for scenario in catalogue()[id].scenarios:
                yield parity(id, control, scenario, episodes)


def main() -> None:
    parser = argparse.ArgumentParser(description="Compiled steps against NumPy.")
    parser.add_argument("--environment", action="append", metavar="ID", help="only this one; may be repeated")
    parser.add_argument("--episodes", type=int, default=64, help="side by side (default 64)")
    arguments = parser.parse_args()
    filtergym.register()
    print(f"{'environment':<28} {'control':<9} {'scenario':<22} observation   reward   median")
    for found in all_parities(arguments.environment or list(catalogue()), arguments.episodes):
        name = found.environment.removeprefix("filtergym/")
        print(
            f"{name:<28} {found.control:<9} {found.scenario:<22} {found.observation:11.1e} {found.reward:8.1e} "
            f"{found.median:8.1e}",
            flush=True,
        )


if __name__ == "__main__":
    main()
