"""Models of an environment, made by its id; modules of examples."""

import importlib.util
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np

from filtergym.baselines import catalogue as baselines
from filtergym.envs.contract.filter import Filter, FilterInput, Likelihood
from filtergym.envs.contract.model import Model
from filtergym.envs.engine import backend, registration
from filtergym.envs.engine.catalogue import task_class
from filtergym.evaluation.running.rollout import rollout
from filtergym.evaluation.running.seeds import episode_seeds

KINDS = tuple(
    f"filtergym/{name}-v0" for name in ("ManeuveringTarget", "LooselyCoupledNavigation", "UavAutopilot")
)
"""Environments whose scans may miss, with ten measurements a decision, with a closed loop: for tests of what treats all
environments alike."""
DECISIONS = 5
"""Length of the short episodes, in decisions."""


def load_module(file: Path, name: str | None = None) -> Iterator[Any]:
    """Yield the module in a file outside the packages, by a name of its own; then forget it and its environments."""
    name, known = name or file.stem, set(registration.USER_TASKS)
    spec: Any = importlib.util.spec_from_file_location(name, file)
    sys.modules[name] = module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    yield module
    sys.modules.pop(name)
    for id in set(registration.USER_TASKS) - known:
        for table in (registration.USER_TASKS, baselines.USER_BASELINES, gymnasium.registry):
            table.pop(id, None)


def make_model(id: str, control: str | None = None, scenario: Any = None, **keywords: Any) -> Model:
    return backend.make_model(task_class(id), control, scenario, **keywords)


def begin(model: Model, rng: np.random.Generator, count: int) -> Any:
    noise = model.task.noise
    return model.begin(rng.random((noise.uniforms, count)), rng.normal(size=(noise.initial_normals, count)))


def next_row(model: Model, rng: np.random.Generator, count: int) -> np.ndarray:
    """Numbers of the next measurement."""
    noise = model.task.noise
    return np.concatenate([rng.normal(size=(noise.normals, count)), rng.random((noise.row_uniforms, count))])


def draw(
    model: Model, count: int, seed: int, steps: int
) -> tuple[np.ndarray, np.ndarray, Iterator[np.ndarray]]:
    """Draw what episodes side by side take: uniforms, initial normals, and a row of each step."""
    rng, noise = np.random.default_rng(seed), model.task.noise
    start = rng.random((noise.uniforms, count)), rng.standard_normal((noise.initial_normals, count))
    return *start, (next_row(model, rng, count) for _ in range(steps))


def short_episodes(id: str) -> dict[str, Any]:
    """Keywords that make episodes of an environment five decisions long, of two measurements at most."""
    interval = min(task_class(id).Parameters().decision_interval, 2)
    return {"horizon": DECISIONS * interval, "decision_interval": interval}


class Asked:
    """A filter as a user's estimator, to look at what it is given and answers; further arguments make the filter."""

    make: Any = None
    """Class of the filter, of subclasses."""

    def __init__(self, made: Any, *arguments: Any, **keywords: Any) -> None:
        self.filter: Filter = made if isinstance(made, Filter) else self.make(made, *arguments, **keywords)
        self.traceable = not self.filter.in_python

    def start(self, initial: Any, N: int) -> Any:
        return self.filter.start(initial)

    def update(self, memory: Any, measurement: Any) -> tuple[Any, ...]:
        own, state = self.filter, self.filter.step(memory, FilterInput(measurement))
        likelihood = Likelihood.of_records(own.records(state, measurement))
        return own.mean(state), own.covariance(state), state, likelihood


LANES = 8
"""Of a bank of hypotheses that is watched."""


def act(bank: Any, state: Any, measurement: Any, action: Any) -> Any:
    """Take a measurement in by the same action in every lane."""
    return bank.act(state, measurement, np.array(action)[:, None] + np.zeros(LANES))


def watch_hypotheses(model: Model, estimator: Any, field: str, no_action: Any) -> tuple[list[Any], list[Any]]:
    """Fly the estimator that a bank of hypotheses steers, beside the bank under no action.

    Returns:
        for every measurement the bank's state as predicted with the measurement, and the estimator's answers.
    """
    bank, scans, answers = model.filter, [], []
    estimator = Asked(estimator) if isinstance(estimator, Filter) else estimator

    class Watched:
        kind = "estimator"

        def start(self, initial, N):
            self.state = bank.start(initial)
            return estimator.start(initial, N)

        def update(self, memory, measurement):
            # A bank is given some number where there is no reading, an estimator NaN.
            given = measurement._replace(**{field: np.nan_to_num(getattr(measurement, field))})
            self.state = bank.predict(self.state, given)
            scans.append((self.state, given))
            self.state = act(bank, self.state, given, no_action)
            answers.append(estimator.update(memory, measurement))
            return answers[-1]

    for _ in rollout(model, Watched(), episode_seeds("train", 3, LANES)):
        pass
    return scans, answers


def watch_estimator(model: Model, estimator: Any) -> tuple[Any, list[Any], list[Any]]:
    """Fly an estimator, and look at what it is given and answers.

    Returns:
        the start, the measurements, and for each of them mean, covariance and likelihood.
    """
    given: list[Any] = []
    answers: list[Any] = []
    asked = Asked(estimator)

    class Watched:
        def start(self, initial: Any, N: int) -> Any:
            given.append(initial)
            return asked.start(initial, N)

        def update(self, memory: Any, measurement: Any) -> Any:
            mean, covariance, memory, likelihood = asked.update(memory, measurement)
            given.append(measurement)
            answers.append((mean, covariance, likelihood))
            return mean, covariance, memory

    for _ in rollout(model, Watched(), episode_seeds("train", 3, LANES)):
        pass
    return given[0], given[1:], answers


def assert_no_action_is_the_estimator(bank: Any, scans: Any, answers: Any, no_action: Any) -> None:
    """Compare what :func:`watch_hypotheses` returns, bit for bit."""
    for (state, measurement), (mean, covariance, _, likelihood) in zip(scans, answers, strict=True):
        after = act(bank, state, measurement, no_action)
        np.testing.assert_array_equal(bank.mean(after), mean)
        np.testing.assert_array_equal(bank.covariance(after), covariance)
        records = bank.records(after, measurement)
        for name in ("log_likelihood", "nis", "nis_degrees"):
            np.testing.assert_array_equal(records[name], getattr(likelihood, name))


def random_actions(space: gymnasium.Space, count: int, step: int) -> np.ndarray:
    """Draw actions for a batch, each independent of how many others there are."""
    return np.stack([_action(space, np.random.default_rng([step, i])) for i in range(count)])


def _action(space: Any, rng: np.random.Generator) -> Any:
    if isinstance(space, gymnasium.spaces.Discrete):
        return rng.integers(space.n)
    return rng.uniform(space.low, space.high).astype(space.dtype)
