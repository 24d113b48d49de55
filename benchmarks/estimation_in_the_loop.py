"""Loss of an agent by noisy sensors, and gain by a filter: returns under truth, readings and estimates.

    python benchmarks/estimation_in_the_loop.py [fixed trained time] [--only ENVIRONMENT ...] [--seeds N] [--out FILE]

``fixed``
    One good controller of each environment, which takes the state: from the truth, from raw readings and their
    differences, from a moving average of four, and from the estimates of filters; 100 episodes of equal seeds.
``trained``
    PPO of Stable-Baselines3 on the full observation, on readings, on a stack of four readings and on estimates,
    with its mean return over 50 fresh episodes; of two environments at the medium noise also on estimates with
    deviation, NIS and innovation, and the same with actions that steer the filter's noise, too.

``time``
    Processor time of a step of Pendulum, bare, with readings and with estimates, in turns: medians of 25.

Results are appended to FILE, one line of JSON for each cell, and an existing cell is not computed again. Tables
are printed at the end: mean returns, and differences with 95 % intervals, paired by episode or by training seed.
"""

import argparse
import itertools
import json
import math
import os
import sys
import time
from collections import deque
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")  # before NumPy loads its BLAS

import gymnasium
import numpy
import scipy.linalg

from filtergym.wrappers import CLASSIC_CONTROL, EstimatedObservation, NoisyObservation, vector

EPISODES, FRESH, LEVELS, STACK = 100, 50, ("low", "medium", "high"), 4
Controller = Callable[[numpy.ndarray], Any]


def cart_pole() -> Controller:
    """Return the linear-quadratic regulator of the upright pole, whose force is rounded to left or right."""
    model, n = CLASSIC_CONTROL["CartPole"], 4
    step = 1e-6
    origin = numpy.zeros(n)
    f = lambda x, u: numpy.array(model.f(x, model.interval, [u]), dtype=float)  # noqa: E731
    A = numpy.stack([(f(step * e, 0.0) - f(-step * e, 0.0)) / (2 * step) for e in numpy.eye(n)], axis=1)
    B = ((f(origin, step) - f(origin, -step)) / (2 * step))[:, None]
    P = scipy.linalg.solve_discrete_are(A, B, numpy.diag([1.0, 0.1, 10.0, 0.1]), [[0.01]])
    K = numpy.linalg.solve(0.01 + B.T @ P @ B, B.T @ P @ A)[0]
    return lambda x: int(-K @ x > 0.0)


def pendulum(x: numpy.ndarray) -> Any:
    """Return the force that pumps energy (Astrom and Furuta, 2000), and near the top that of proportional-derivative
    control.
    """
    angle = (x[0] + math.pi) % (2.0 * math.pi) - math.pi
    energy = x[1] ** 2 / 6.0 + 5.0 * math.cos(angle) - 5.0
    near = math.cos(angle) > 0.85
    torque = -20.0 * angle - 5.0 * x[1] if near else -2.0 * math.copysign(1.0, x[1] * energy + 1e-9)
    return numpy.array([min(max(torque, -2.0), 2.0)], dtype=numpy.float32)


def mountain_car(x: numpy.ndarray) -> Any:
    """Return the full force along the velocity."""
    return numpy.array([math.copysign(1.0, x[1])], dtype=numpy.float32)


def acrobot(x: numpy.ndarray) -> Any:
    """Return the torque along the rate of the second link, which pumps energy."""
    return 2 if x[3] > 0.0 else 0


PROBLEMS: dict[str, tuple[str, Any, dict[str, Any], dict[str, float], list[float]]] = {
    "CartPole-v1": ("CartPole", cart_pole(), {"h": ["position", "angle"]}, {}, [0.01, 0.03, 0.1]),
    "Pendulum-v1": ("Pendulum", pendulum, {"h": "angle"}, {}, [0.03, 0.1, 0.3]),
    "MountainCarContinuous-v0": ("MountainCarContinuous", mountain_car, {"h": "position"}, {}, [0.01, 0.03, 0.1]),
    "Acrobot-v1": ("Acrobot", acrobot, {"h": ["angle_1", "angle_2"]}, {}, [0.03, 0.1, 0.3]),
}  # fmt: skip
"""Model, controller, sensor, its further fields, and the standard deviations of its levels of noise."""
TRAINING: dict[str, dict[str, Any]] = {
    "CartPole-v1": {"steps": 60_000, "n_steps": 128, "batch_size": 256, "n_epochs": 10, "gamma": 0.98,
                    "gae_lambda": 0.9, "learning_rate": 1e-3},
    "Pendulum-v1": {"steps": 100_000, "n_steps": 256, "batch_size": 256, "n_epochs": 10, "gamma": 0.9,
                    "gae_lambda": 0.95, "learning_rate": 1e-3, "use_sde": True, "sde_sample_freq": 4},
    "MountainCarContinuous-v0": {"steps": 60_000, "n_steps": 512, "batch_size": 256, "n_epochs": 10, "gamma": 0.99,
                                 "gae_lambda": 0.9, "learning_rate": 3e-4, "ent_coef": 0.0, "use_sde": True,
                                 "sde_sample_freq": 64,
                                 "policy_kwargs": {"log_std_init": -1.0, "ortho_init": False}},
    "Acrobot-v1": {"steps": 100_000, "n_steps": 256, "batch_size": 256, "n_epochs": 4, "gamma": 0.99,
                   "gae_lambda": 0.94},
}  # fmt: skip
"""Steps of a training, and what differs from PPO's defaults, for eight lanes: near those of RL Baselines3 Zoo; those of
MountainCarContinuous were chosen on two seeds under the truth, which the Zoo's did not solve."""
LANES = 8
FILTERS = ("extended", "unscented")
STEERING = {"uncertainty": None, "steered": "noise"}
"""Agents that observe deviation, NIS and innovation, too, and the control of their filter."""
STEERED = ("Pendulum-v1", "CartPole-v1")
SIZES = ("1", "64")
"""Lanes whose steps are timed."""


def sensors_of(name: str, level: str) -> dict[str, Any]:
    """Return the sensor of an environment at a level of noise."""
    _, _, sensor, further, deviations = PROBLEMS[name]
    return {"sensor": {**sensor, **further, "R": deviations[LEVELS.index(level)] ** 2}}


def differences(place: list[int], n: int, interval: float, turning: numpy.ndarray, window: int) -> Any:
    """Return a function from readings to a state: their mean over a window, and the slope between means."""
    past: deque[numpy.ndarray] = deque(maxlen=window + 1)

    def state(reading: numpy.ndarray, starts: bool) -> numpy.ndarray:
        if starts:
            past.clear()
        if past:
            jump = reading - past[-1]
            reading = (
                past[-1]
                + jump
                - numpy.where(turning, 2.0 * math.pi * numpy.rint(jump / (2.0 * math.pi)), 0.0)
            )
        past.append(reading)
        x, values = numpy.zeros(n), numpy.array(past)
        x[place] = values[-window:].mean(axis=0)
        slope = numpy.zeros(len(place)) if len(values) < 2 else (values[-1] - values[0]) / (len(values) - 1)
        rates = [i for i in range(n) if i not in place]
        x[rates] = slope / interval
        return x

    return state


def fly(name: str, way: str, level: str) -> list[float]:
    """Return the returns of the fixed controller over all episodes."""
    model_name, controller, sensor, _, _ = PROBLEMS[name]
    model = CLASSIC_CONTROL[model_name]
    n, named = len(model.names), sensor["h"]
    measured = [named] if isinstance(named, str) else named
    place = [model.names.index(one) for one in measured]
    turning = numpy.array([one in model.angles for one in measured])
    env: Any = gymnasium.make(name)
    if way != "truth":
        env = noisy = NoisyObservation(env, sensors_of(name, level))
    if way in FILTERS:
        env = EstimatedObservation(env, competitor=way, show="mean")
    window = {"raw": 1, "average": 4}.get(way)
    smooth = None if window is None else differences(place, n, model.interval, turning, window)
    returns = []
    for seed in range(EPISODES):
        observation, _ = env.reset(seed=seed)
        total, ended, starts = 0.0, False, True
        while not ended:
            if way == "truth":
                x = model.state(numpy.asarray(observation, dtype=float)[None])[0]
            elif smooth is not None:
                x = smooth(noisy.reading.values[0], starts)
            else:
                x = env.estimates.mean[0]
            starts = False
            observation, reward, terminated, truncated, _ = env.step(controller(x))
            total, ended = total + float(reward), terminated or truncated
        returns.append(total)
    return returns


def show_directions(env: Any, name: str) -> Any:
    """Replace readings that are angles by cosine and sine, so that networks on readings meet no jump at half a turn."""
    model, _, sensor, _, _ = PROBLEMS[name]
    named = [sensor["h"]] if isinstance(sensor["h"], str) else sensor["h"]
    if not any(one in CLASSIC_CONTROL[model].angles for one in named):
        return env
    space = gymnasium.spaces.Box(-1.0, 1.0, (2 * len(named),), env.observation_space.dtype)
    transform = lambda angles: numpy.concatenate([numpy.cos(angles), numpy.sin(angles)])  # noqa: E731
    return gymnasium.wrappers.TransformObservation(env, transform, space)


def choose_steering(env: Any) -> Any:
    """Let an agent of discrete actions choose each action of the filter among three: its lowest, zero and highest."""
    if not isinstance(env.action_space, gymnasium.spaces.Tuple):
        return env
    discrete, own = env.action_space
    space = gymnasium.spaces.MultiDiscrete([discrete.n, *[3] * own.shape[0]])
    levels = numpy.array([own.low, numpy.zeros(own.shape), own.high])
    each = numpy.arange(own.shape[0])
    return gymnasium.wrappers.TransformAction(env, lambda a: (a[0], levels[a[1:], each]), space)


def make(name: str, way: str, level: str) -> Any:
    """Return an environment as an agent in training observes it."""
    env: Any = gymnasium.make(name)
    if way != "truth":
        env = NoisyObservation(env, sensors_of(name, level))
    if way in ("raw", "stack"):
        env = show_directions(env, name)
    if way == "estimate":
        env = EstimatedObservation(env)
    elif way in STEERING:
        form = "mean" if CLASSIC_CONTROL[PROBLEMS[name][0]].observation is None else "observation"
        show = (form, "deviation", "nis", "innovation")
        env = choose_steering(EstimatedObservation(env, show=show, control=STEERING[way]))
    elif way == "stack":
        env = gymnasium.wrappers.FlattenObservation(gymnasium.wrappers.FrameStackObservation(env, STACK))
    return env


def train(name: str, way: str, level: str, seed: str) -> dict[str, Any]:
    """Train PPO once; return its returns in training and on fresh episodes, and the time."""
    import torch
    from stable_baselines3 import PPO
    from stable_baselines3.common.evaluation import evaluate_policy
    from stable_baselines3.common.monitor import Monitor
    from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize, sync_envs_normalization

    torch.set_num_threads(1)
    settings = dict(TRAINING[name])
    steps = settings.pop("steps")
    lanes = VecNormalize(
        DummyVecEnv([lambda: Monitor(make(name, way, level))] * LANES), gamma=settings["gamma"]
    )
    began = time.process_time()
    model = PPO("MlpPolicy", lanes, seed=int(seed), **settings)
    model.learn(steps)
    spent = time.process_time() - began
    curve = [(int(at), float(value)) for env in lanes.venv.envs for at, value in zip(
        numpy.cumsum(env.get_episode_lengths()) * LANES, env.get_episode_rewards(), strict=True)]  # fmt: skip
    fresh = VecNormalize(
        DummyVecEnv([lambda: Monitor(make(name, way, level))]), training=False, norm_reward=False
    )
    fresh.seed(10_000)
    sync_envs_normalization(lanes, fresh)
    returns, _ = evaluate_policy(model, fresh, FRESH, return_episode_rewards=True)
    last = [value for at, value in curve if at > 0.9 * steps]
    edges = numpy.linspace(0, steps, 21)
    means = [
        float(numpy.mean([v for at, v in curve if low < at <= high] or [math.nan]))
        for low, high in itertools.pairwise(edges)
    ]
    return {
        "fresh": [float(one) for one in returns],
        "last": float(numpy.mean(last)),
        "curve": means,
        "seconds": spent,
    }


def time_steps(lanes: str) -> list[float]:
    """Return the processor time of a step of Pendulum of some lanes, bare, with readings and estimates, us."""
    count, sensors, bare = int(lanes), sensors_of("Pendulum-v1", "medium"), "Pendulum-v1"
    if count == 1:
        made: list[Any] = [gymnasium.make(bare) for _ in range(3)]
        wrappers: Any = NoisyObservation, EstimatedObservation
    else:
        made = [gymnasium.make_vec(bare, count, "sync") for _ in range(3)]
        wrappers = vector.NoisyObservation, vector.EstimatedObservation
    made[1:] = [wrappers[0](env, sensors) for env in made[1:]]
    made[2] = wrappers[1](made[2])
    action = numpy.full(made[0].action_space.shape, 0.5, dtype=numpy.float32)
    spent: list[list[float]] = [[], [], []]
    for _, (env, times) in itertools.product(range(25), zip(made, spent, strict=True)):
        env.reset(seed=0)
        began = time.process_time()
        for _ in range(150):
            env.step(action)
        times.append((time.process_time() - began) / 150 * 1e6)
    return [float(numpy.median(times)) for times in spent]


def print_times(found: dict[tuple[str, ...], Any]) -> None:
    """Print the processor time of a step."""
    print(
        "\n| a step of Pendulum, µs of a processor | bare | with readings | with estimates |\n|---|---|---|---|"
    )
    for lanes in SIZES:
        row = found.get(("time", lanes), [])
        print(f"| {lanes} at once | " + " | ".join(f"{one:.1f}" for one in row) + " |")


def cells(stages: list[str], only: list[str], seeds: int) -> Iterator[tuple[str, ...]]:
    """Yield the cells of the tables, those of the first training seed before those of the next."""
    for name in only:
        if "fixed" in stages:
            yield "fixed", name, "truth", ""
            yield from (
                ("fixed", name, way, level) for level in LEVELS for way in ("raw", "average", *FILTERS)
            )
    if "time" in stages:
        yield from (("time", lanes) for lanes in SIZES)
    if "trained" in stages:
        for seed in range(seeds):
            for level in ("", "medium", "high", "low"):
                for way in ("truth",) if not level else ("estimate", "stack", "raw"):
                    yield from (("trained", name, way, level, str(seed)) for name in only)
            steered = [name for name in only if name in STEERED]
            yield from (("trained", name, way, "medium", str(seed)) for name in steered for way in STEERING)


def interval(values: numpy.ndarray) -> tuple[float, float, float]:
    """Return a mean and its 95 % bootstrap interval."""
    drawn = numpy.random.default_rng(0).integers(0, len(values), (2000, len(values)))
    low, high = numpy.percentile(values[drawn].mean(axis=1), [2.5, 97.5])
    return float(values.mean()), float(low), float(high)


def mean_returns(runs: dict[tuple[str, ...], Any], way: str, level: str) -> dict[str, float]:
    """Return the mean return on fresh episodes by training seed."""
    return {key[4]: float(numpy.mean(one["fresh"])) for key, one in runs.items() if key[2:4] == (way, level)}


def print_fixed(found: dict[tuple[str, ...], Any], only: list[str]) -> None:
    """Print the loss of return of the fixed controllers against the truth."""
    ways = ("raw", "average", *FILTERS)
    print("\n| fixed controller, less return than under truth | noise | " + " | ".join(ways) + " |")
    print("|---|---|" + "---|" * len(ways))
    for name, level in itertools.product(only, LEVELS):
        truth = numpy.array(found.get(("fixed", name, "truth", ""), [math.nan]))
        row = []
        for way in ways:
            returns = found.get(("fixed", name, way, level))
            row.append(
                "" if returns is None else "{:.1f} [{:.1f}, {:.1f}]".format(*interval(truth - returns))
            )
        deviation = PROBLEMS[name][4][LEVELS.index(level)]
        print(f"| {name}, {truth.mean():.0f} | {deviation:g} | " + " | ".join(row) + " |")


def steps_to_level(curve: list[float], level: float, steps: int) -> float:
    """Return the steps after which the mean return in training reaches a level; NaN where it never does."""
    reached = numpy.flatnonzero(numpy.array(curve) >= level)
    return (reached[0] + 1) * steps / len(curve) if len(reached) else math.nan


def print_trained(found: dict[tuple[str, ...], Any], only: list[str]) -> None:
    """Print the returns of trained agents, and those of estimates against stacks, seed by seed."""
    ways = ("raw", "stack", "estimate")
    print("\n| PPO, mean return (seeds) | noise | truth | " + " | ".join(ways), end=" | ")
    print("estimate less stack, lowest and highest seed | steps until the stack's last return |")
    print("|---|---|" + "---|" * (len(ways) + 3))
    for name, level in itertools.product(only, LEVELS):
        runs = {key: value for key, value in found.items() if key[:2] == ("trained", name)}
        of = {way: mean_returns(runs, way, level) for way in ways}
        each = [mean_returns(runs, "truth", ""), *of.values()]
        row = [f"{numpy.mean([*one.values()]):.1f} ({len(one)})" if one else "" for one in each]
        both, total = sorted({*of["estimate"]} & {*of["stack"]}), TRAINING[name]["steps"]
        if both:
            pairs = [of["estimate"][seed] - of["stack"][seed] for seed in both]
            row.append(f"{numpy.mean(pairs):+.1f} ({min(pairs):+.1f}, {max(pairs):+.1f})")
            curves = [
                [runs["trained", name, way, level, seed]["curve"] for way in ("estimate", "stack")]
                for seed in both
            ]
            needed = [steps_to_level(own, float(numpy.nanmean(other[-2:])), total) for own, other in curves]
            row.append(
                f"{numpy.median(needed):,.0f} of {total:,}"
                if numpy.isfinite(needed).all()
                else "not all seeds"
            )
        deviation = PROBLEMS[name][4][LEVELS.index(level)]
        print(f"| {name} | {deviation:g} | " + " | ".join(row) + " |")


def print_steered(found: dict[tuple[str, ...], Any], only: list[str]) -> None:
    """Print the returns of agents that observe the filter's uncertainty, and of those that steer the filter, too."""
    ways = ("estimate", *STEERING)
    print("\n| PPO, mean return (seeds) | noise | estimate | and its uncertainty | and steering", end=" | ")
    print("steering less none, lowest and highest seed |\n" + "|---" * 6 + "|")
    for name in (one for one in STEERED if one in only):
        runs = {key: value for key, value in found.items() if key[:2] == ("trained", name)}
        of = {way: mean_returns(runs, way, "medium") for way in ways}
        row = [f"{numpy.mean([*one.values()]):.1f} ({len(one)})" if one else "" for one in of.values()]
        pairs = [
            value - of["uncertainty"][seed]
            for seed, value in of["steered"].items()
            if seed in of["uncertainty"]
        ]
        row.append(f"{numpy.mean(pairs):+.1f} ({min(pairs):+.1f}, {max(pairs):+.1f})" if pairs else "")
        print(f"| {name} | {PROBLEMS[name][4][1]:g} | " + " | ".join(row) + " |")


def draw_episode(file: Path) -> None:
    """Draw the angle of the pendulum, its readings, and the estimate with its 95 % band."""
    from matplotlib.figure import Figure

    env: Any = NoisyObservation(gymnasium.make("Pendulum-v1"), sensors_of("Pendulum-v1", "high"))
    env = EstimatedObservation(env, show=("mean", "deviation"))
    env.reset(seed=4)
    rows = []
    for _ in range(120):
        found = env.estimates
        angle, rate = env.unwrapped.state
        rows.append([angle, rate, env.env.reading.values[0, 0], *found.mean[0], *found.deviation[0]])
        env.step(pendulum(found.mean[0]))
    t, (angle, rate, reading, mean, speed, sigma, own) = 0.05 * numpy.arange(120), numpy.array(rows).T
    turn = 2.0 * math.pi
    angle, reading, mean = (
        one - turn * numpy.rint((one - angle[0]) / turn) for one in (angle, reading, mean)
    )
    angle, reading, mean = (numpy.unwrap(one) for one in (angle, reading, mean))
    reading, mean = (one - turn * numpy.rint((one - angle) / turn) for one in (reading, mean))
    figure = Figure(figsize=(8.0, 4.2), layout="constrained")
    for axis, truth, line, deviation, label in zip(
        figure.subplots(2, 1, sharex=True), (angle, rate), (mean, speed), (sigma, own),
        ("angle, rad", "rate, rad/s"), strict=True,
    ):  # fmt: skip
        axis.fill_between(t, line - 1.96 * deviation, line + 1.96 * deviation, color="tab:blue", alpha=0.2, lw=0,
                          label="95 % of the filter")  # fmt: skip
        if label.startswith("angle"):
            axis.plot(t, reading, ".", color="0.6", ms=4, label="reading")
        axis.plot(t, truth, color="black", lw=1.0, label="truth")
        axis.plot(t, line, color="tab:blue", lw=1.3, label="estimate")
        axis.set_ylabel(label)
        axis.grid(alpha=0.25)
    figure.axes[1].set_xlabel("time, s")
    figure.legend(
        *figure.axes[0].get_legend_handles_labels(), ncols=4, frameon=False, loc="outside upper center"
    )
    figure.savefig(file, dpi=150)


def main() -> None:
    """Compute the missing cells, and print the tables."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("stages", nargs="*", default=["fixed"], metavar="STAGE")
    parser.add_argument("--only", nargs="+", choices=PROBLEMS, default=[*PROBLEMS], metavar="ENVIRONMENT")
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--out", type=Path, default=Path("results/estimation_in_the_loop.jsonl"))
    parser.add_argument(
        "--picture", type=Path, help="draw an episode of the pendulum into this file, and end"
    )
    given = parser.parse_args()
    if given.picture:
        draw_episode(given.picture)
        return
    given.out.parent.mkdir(parents=True, exist_ok=True)
    found: dict[tuple[str, ...], Any] = {}
    if given.out.exists():
        for line in given.out.read_text(encoding="utf-8").splitlines():
            one = json.loads(line)
            found[tuple(one["cell"])] = one["found"]
    work = [cell for cell in cells(given.stages, given.only, given.seeds) if cell not in found]
    for number, cell in enumerate(work, 1):
        stage, *arguments = cell
        print(f"{number} of {len(work)}: {' '.join(filter(None, cell))} ...", file=sys.stderr, flush=True)
        run: dict[str, Callable[..., Any]] = {"fixed": fly, "trained": train, "time": time_steps}
        result = run[stage](*arguments)
        found[cell] = result
        with given.out.open("a", encoding="utf-8") as file:
            file.write(json.dumps({"cell": cell, "found": result}) + "\n")
    print_fixed(found, given.only)
    print_trained(found, given.only)
    print_steered(found, given.only)
    print_times(found)


if __name__ == "__main__":
    main()
