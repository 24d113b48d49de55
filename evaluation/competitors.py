"""What a policy, a reference estimator and a bound are.

A **policy** sees observations and returns actions; learned or classical, it answers Stable-Baselines3's
call. A **reference** estimates from the measurements, never through actions, and may be told what no
competitor knows; it is never ranked with policies. A **bound** is computed. Each says what it is by its ``kind``;
what says nothing is a policy, such as a model of Stable-Baselines3.
"""

from collections.abc import Sequence
from typing import Any, ClassVar, Literal, Protocol, get_args

import numpy

from ..envs.task import Array, Task

Kind = Literal["policy", "reference", "bound"]


def kind_of(competitor: Any) -> Kind:
    """Say what a competitor is, or what a maker makes."""
    return getattr(competitor, "kind", "policy")


def check_competitor(name: str, found: Any) -> Any:
    """Return what a user has named, if it can compete; it is not called yet.

    Raises:
        ValueError: if it is neither an object or a class with ``predict``, nor the class of a reference or a bound.
    """
    kind = kind_of(found)
    methods = ("predict",) if kind == "policy" else ("start", "update")
    if kind not in get_args(Kind) or not all(callable(getattr(found, method, None)) for method in methods):
        raise ValueError(
            f"{name!r} is no policy, reference or bound: a policy has a method predict, the others say their kind and "
            "have start and update"
        )
    return found


class Policy:
    """Base of the classical policies: made for a task, deterministic unless it says otherwise.

    Subclasses set ``control`` and answer :meth:`predict`; those with memory keep it in the ``state`` that
    goes in and out, so that one object serves any number of episodes.
    """

    kind: ClassVar[Kind] = "policy"
    control: ClassVar[str]
    """The control that the policy's actions are meant for."""

    def __init__(self, task: Task) -> None:
        self.task = task

    def begin(self, seeds: Sequence[int]) -> Any:
        """Memory at the start of the episodes with these seeds, for the first :meth:`predict` of an evaluation.

        A policy that draws numbers draws them from the seeds, so that an episode stays what it is in any company.
        """
        return None

    def predict(
        self,
        observation: numpy.ndarray,
        state: Any = None,
        episode_start: numpy.ndarray | None = None,
        deterministic: bool = True,
    ) -> tuple[numpy.ndarray, Any]:
        """Choose actions.

        Args:
            observation: ``(N, len(task.fields))``, or one observation without the batch axis.
            state: what the last call returned; None at the first.
            episode_start: ``(N,)`` booleans, true where a new episode begins.
            deterministic: as in Stable-Baselines3; classical policies ignore it.

        Returns:
            Actions, batch first, and the state for the next call.
        """
        single = observation.ndim == 1
        batch = observation[None] if single else observation
        start = numpy.zeros(len(batch), dtype=bool) if episode_start is None else numpy.asarray(episode_start)
        if state is None:
            start = numpy.ones(len(batch), dtype=bool)
        action, state = self.act(batch, state, start.reshape(-1))
        return (action[0] if single else action), state

    def act(self, observation: numpy.ndarray, state: Any, start: numpy.ndarray) -> tuple[numpy.ndarray, Any]:
        """Answer a batch; ``start`` is true where memory must begin anew."""
        raise NotImplementedError


class ConstantPolicy(Policy):
    """The same action always."""

    action: tuple[float, ...]

    def act(self, observation: numpy.ndarray, state: Any, start: numpy.ndarray) -> tuple[numpy.ndarray, Any]:
        """Repeat the action for every episode."""
        return numpy.tile(numpy.asarray(self.action, dtype=float), (len(observation), 1)), None


class RandomPolicy(Policy):
    """Uniform actions; the floor that any policy should beat."""

    seed = 0

    def __init__(self, task: Task) -> None:
        super().__init__(task)
        self.control = task.control  # type: ignore[misc]  # it suits every control

    def begin(self, seeds: Sequence[int]) -> list[numpy.random.Generator]:
        """Give every episode a generator of its own, of the policy's seed and the episode's."""
        return [numpy.random.default_rng([self.seed, seed]) for seed in seeds]

    def act(self, observation: numpy.ndarray, state: Any, start: numpy.ndarray) -> tuple[numpy.ndarray, Any]:
        """Draw from the action space, each row from its generator."""
        generators = self.begin(range(len(observation))) if state is None else state
        space: Any = self.task.action_space
        if hasattr(space, "n"):
            return numpy.array([generator.integers(space.n) for generator in generators]), generators
        return numpy.stack([generator.uniform(space.low, space.high) for generator in generators]), generators


class Reference(Protocol):
    """An estimator that runs on the episode's measurements and may know what no competitor does.

    It starts where everyone starts. In a closed loop it flies a truth of its own, on the same noise.
    """

    kind: ClassVar[Kind] = "reference"
    knows: ClassVar[str]
    """What it is told, in words; printed wherever it is reported."""

    def __init__(self, task: Task) -> None: ...

    def start(self, initial: Any, truth: Any) -> Any:
        """Memory at the start of the track.

        Args:
            initial: what everyone is told of it.
            truth: at that time.
        """

    def update(self, measurement: Any, truth: Any, memory: Any) -> tuple[Array, Array, Any]:
        """Estimate after a measurement: mean ``(C, N)``, covariance ``(C, C, N)``, and the memory."""


class Bound(Protocol):
    """A computed limit of the mean square error."""

    kind: ClassVar[Kind] = "bound"
    knows: ClassVar[str]

    def __init__(self, task: Task) -> None: ...

    def start(self, initial: Any, truth: Any) -> Any:
        """Memory at the start of the track; arguments as of :meth:`Reference.start`."""

    def update(self, measurement: Any, truth: Any, memory: Any) -> tuple[Array, Any]:
        """Bound of the mean square of ``task.components``, ``(C, N)``, and the memory."""
