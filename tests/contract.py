"""One pass over a subject, as an environment, a control and a backend, in which many properties are checked by name."""

import importlib.util
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.utils.env_checker import check_env
from models import make_model, random_actions, short_episodes

from filtergym.envs.contract.model import Model
from filtergym.envs.engine.catalogue import task_class

NEEDED = {"numpy": "numpy", "compiled": "llvmlite", "torch": "torch"}
BACKENDS = [backend for backend, library in NEEDED.items() if importlib.util.find_spec(library)]
"""Those that work here."""


@dataclass(frozen=True)
class Subject:
    """What a pass goes over; its episodes are five decisions long."""

    id: str
    control: str | None = None
    backend: str = "auto"

    def __str__(self) -> str:
        return f"{self.id}, control {self.control or 'default'}, backend {self.backend}"

    @property
    def keywords(self) -> dict[str, Any]:
        """What an environment of it is made with."""
        return {"control": self.control, "backend": self.backend, **short_episodes(self.id)}

    @property
    def order(self) -> int:
        """Place of the control among those of the environment; zero of the default."""
        return 0 if self.control is None else list(task_class(self.id).controls).index(self.control)

    def single(self, **keywords: Any) -> gym.Env:
        return gym.make(self.id, disable_env_checker=True, **self.keywords | keywords)

    def native(self, count: int, **keywords: Any) -> gym.vector.VectorEnv:
        """Make many of them side by side."""
        return gym.make_vec(self.id, num_envs=count, **self.keywords | keywords)

    def synchronous(self, count: int, mode: Any = gym.vector.AutoresetMode.NEXT_STEP, **keywords: Any) -> Any:
        """Make Gymnasium's own vector of single environments."""
        makers = [lambda: self.single(**keywords)] * count
        return gym.vector.SyncVectorEnv(makers, autoreset_mode=mode)

    def model(self, **keywords: Any) -> Model:
        return make_model(self.id, self.control, **short_episodes(self.id) | keywords)

    def actions(self, env: Any, count: int, steps: Iterable[int]) -> list[Any]:
        """Random actions for a batch, of each step."""
        space = getattr(env, "single_action_space", env.action_space)
        return [random_actions(space, count, step) for step in steps]


def continued(env: Any, actions: Iterable[Any]) -> list[np.ndarray]:
    return [np.asarray(part) for action in actions for part in env.step(action)[:4]]


def assert_equals_its_vector(
    id: str, actions: Iterable[Any], render: bool = True, **keywords: Any
) -> gym.Env:
    """Gymnasium's check of an environment, and an episode as the last one of a vector; return the environment.

    Args:
        id: of the environment.
        actions: of the last of three environments at every decision, alike in all; as many as an episode has.
        render: whether it is drawn by the check.
        keywords: of both.
    """
    env = gym.make(id, **keywords)
    check_env(env.unwrapped, skip_render_check=not render)
    vector = gym.make_vec(id, num_envs=3, **{k: v for k, v in keywords.items() if k != "render_mode"})
    shown, _ = vector.reset(seed=4)
    single, _ = env.reset(seed=6)
    np.testing.assert_array_equal(shown[2], single)
    truncated = False
    for action in actions:
        shown, *_ = vector.step(np.stack([action] * 3))
        single, *_, truncated, _ = env.step(action)
        np.testing.assert_array_equal(shown[2], single)
    assert truncated
    return env


Property = Callable[[Any], None]
"""Function that raises where its subject lacks what its name states."""


def assert_properties(subject: Any, properties: Iterable[Property]) -> None:
    """Check all properties of a subject, or of each of a list, and tell of each that does not hold which one it is and
    of what.

    Raises:
        ExceptionGroup: if there are some.
    """
    properties, failures = list(properties), []
    for one in subject if isinstance(subject, list) else [subject]:
        for has in properties:
            try:
                has(one)
            except Exception as error:
                name = getattr(has, "func", has).__name__
                error.add_note(f"property {name!r} of {one}")
                failures.append(error)
    if failures:
        raise ExceptionGroup(f"{len(failures)} properties do not hold", failures)
