"""Protocols and base classes of policies, estimators, smoothers, references and bounds.

A **policy** has Stable-Baselines3's method ``predict``. An **estimator** receives the initial estimate and
every measurement, and returns mean and covariance; it is ranked with the policies. A **smoother** is an
estimator that also uses later measurements, a **reference** one that may use the truth; neither is ranked. A
**bound** is computed. The attribute ``kind`` gives the kind; an object without it is an estimator if it has
``start`` and ``update``, otherwise a policy, such as a model of Stable-Baselines3.
"""

import functools
import types
from collections.abc import Callable, Collection, Mapping, Sequence
from typing import Any, ClassVar, Literal, NamedTuple, Protocol, get_args

import numpy

from ...envs.contract.filter import Filter
from ...envs.contract.model import Model
from ...envs.contract.task import Array, Task
from ...filters.array_namespace import host_array
from .adapters import check_update_order, takes_problem

Kind = Literal["policy", "estimator", "smoother", "reference", "bound"]
RANKED: tuple[Kind, ...] = ("policy", "estimator")
"""Kinds of competitors that are ranked: they use only the measurements so far."""
INFORMED_KINDS: tuple[Kind, ...] = ("reference", "bound")
"""Kinds of competitors that can use the truth; their attribute ``knows`` describes what they use."""
NOT_CAUSAL = "Not causal, with later measurements"
"""Words before the names of smoothers in every report."""


class Competitor(NamedTuple):
    """Name and maker of a competitor in an evaluation."""

    name: str
    maker: Any
    """A class or function that makes the competitor, or the competitor itself; see :func:`make_competitor`."""
    learned: bool = False
    """Whether it was trained."""
    identity: str | None = None
    """Text that changes whenever the maker does; None where a change cannot be recognised."""
    log: Any = None
    """Settings with which the log was read that the competitor was fitted to
    (:class:`.envs.contract.log_format.LogSetup`), or None.
    """


class CompetitorFiles(NamedTuple):
    """Functions by which competitors are found and loaded from files and folders."""

    find: Callable[[str, Any, bool, Callable[[str, str], Competitor]], Competitor | None]
    """Function that returns the competitor of a name in a problem, or None. Its other arguments: whether files that
    can execute code are loaded, and a function that returns a shipped competitor by its name and a description for
    errors.
    """
    endings: Sequence[str]
    """Endings of the names of files of competitors."""
    names: Callable[[str], list[str]] = lambda id: []
    """Function from a Gymnasium id to the names of the environment's shipped competitors."""
    adopt: Callable[[Any], Any] = lambda found: found
    """Function that wraps an object of a known library in its adapter, and returns other objects unchanged."""


def kind_of(competitor: Any) -> Kind:
    """Return the kind of a competitor, or of the competitors that a maker makes, as a string."""
    estimates = _has(competitor, "start", "update") and (
        is_filter(competitor) or not hasattr(competitor, "predict")
    )
    return getattr(competitor, "kind", "estimator" if estimates else "policy")


def is_filter(competitor: Any) -> bool:
    """Return whether a competitor, or the class that makes it, is a :class:`.Filter`."""
    made = getattr(competitor, "func", competitor)
    return issubclass(made if isinstance(made, type) else type(made), Filter)


def is_program(competitor: Any) -> bool:
    """Return whether a competitor runs a program in a separate process, which reports its own processor time."""
    return getattr(competitor, "is_program", False) is True


def _has(found: Any, *methods: str) -> bool:
    return all(callable(getattr(found, method, None)) for method in methods)


def make_competitor(maker: Any, problem: Task | Model) -> Any:
    """Make a competitor for a problem; an object that is no maker is returned unchanged.

    Args:
        maker: a class or function that takes the problem, or nothing; or the competitor itself. One whose first
            argument has a default is called without arguments, unless that argument is named ``task`` or ``model``.
        problem: the model for a policy, the task for any other kind.
    """
    if not callable(maker):
        return maker
    return maker(problem) if takes_problem(maker) else maker()


def is_made_for_episodes(competitor: Any) -> bool:
    """Return whether a competitor is made for given episodes: it has ``of_episodes(task, seeds)``."""
    return _has(competitor, "of_episodes")


def check_competitor(name: str, competitor: Any, kind: Kind | None = None) -> Any:
    """Return a competitor unchanged, or raise ValueError if it lacks a method of its kind.

    Args:
        name: its name in the table of results.
        competitor: a competitor, or its class.
        kind: required kind; default: its own.

    Raises:
        ValueError: for a missing method, or an ``update`` that takes the memory after the measurement.
    """
    kind = kind or kind_of(competitor)
    methods = {"policy": ("predict",), "smoother": ("start", "update", "smooth")}.get(
        kind, ("start", "update")
    )
    if kind not in get_args(Kind) or not _has(competitor, *methods):
        too = ", a smoother smooth too" if kind == "smoother" else ""
        raise ValueError(
            f"{name!r} is no competitor: a policy has a method predict, an estimator the methods start and update{too}"
        )
    try:
        check_update_order(competitor)
    except ValueError as error:
        raise ValueError(f"{name!r}: {error}") from None
    return competitor


def expose_spaces(outer: Any, inner: Any, *further: str) -> None:
    """Copy the inner model's spaces, and its attributes named in ``further``, to ``outer``."""
    for name in ("observation_space", "action_space", *further):
        if hasattr(inner, name):
            setattr(outer, name, getattr(inner, name))


class Policy:
    """Base class of classical policies; observations and actions are ``(N, ...)``, batch first, as in Gymnasium.

    A policy is made for a model, and deterministic unless documented otherwise.

    Subclasses set ``control`` and define :meth:`act`. A policy with memory takes and returns it as ``state``, so that
    one object serves any number of episodes.
    """

    kind: ClassVar[Kind] = "policy"
    control: ClassVar[str]
    """Name of the control for which the policy's actions are made."""
    traceable: ClassVar[bool] = False
    """Whether :meth:`act` is compiled where the steps of the model are: it computes with NumPy alone, no value decides
    what is executed, its memory is nested tuples of arrays, batch first, of which only the values depend on the
    observations, and the object stores nothing. A class with another ``act`` must declare it again."""

    def __init__(self, model: Model) -> None:
        self.model = model
        self.task: Any = model.task

    def begin(self, seeds: Sequence[int]) -> Any:
        """Return the policy's memory at the start of episodes; a random policy draws from these seeds."""
        return None

    def predict(
        self,
        observation: numpy.ndarray,
        state: Any = None,
        episode_start: numpy.ndarray | None = None,
        deterministic: bool = True,
    ) -> tuple[numpy.ndarray, Any]:
        """Return the actions for a batch of observations, batch first, and the memory for the next call.

        Args:
            observation: ``(N, len(model.fields))``, or one observation without the batch axis.
            state: memory that the last call returned; None at the first call.
            episode_start: mask of new episodes, ``(N,)`` booleans.
            deterministic: as in Stable-Baselines3; classical policies ignore it.
        """
        single = observation.ndim == 1
        batch = observation[None] if single else observation
        start = numpy.full(len(batch), state is None) if episode_start is None else episode_start
        if state is None:
            start = numpy.ones(len(batch), dtype=bool)
        action, state = self.act(batch, state, numpy.reshape(start, -1))
        return (action[0] if single else action), state

    def act(self, observation: numpy.ndarray, state: Any, start: numpy.ndarray) -> tuple[numpy.ndarray, Any]:
        """Return actions ``(N, ...)`` and memory for observations ``(N, fields)``; ``start`` marks episodes that
        begin.
        """
        raise NotImplementedError


def compilation_key(maker: Any) -> Any:
    """Return the key under which a competitor's compiled code is cached: the maker, or a new object for a
    function.
    """
    return functools.partial(maker) if isinstance(maker, types.FunctionType) else maker


def is_traceable(policy: Any) -> bool:
    """Return whether a policy declares that its methods can be traced and compiled.

    The declaration does not apply to methods that a subclass replaces.
    """
    own = getattr(policy, "__dict__", {})
    if "traceable" in own:
        return bool(own["traceable"])
    for cls in type(policy).__mro__:
        if "traceable" in vars(cls):
            return bool(vars(cls)["traceable"])
        if vars(cls).keys() & {"act", "predict", "begin"}:
            break
    return False


class FunctionPolicy(Policy):
    """Policy that calls a function of the observation, to evaluate an agent of any library.

    Args:
        function: function from observations ``(N, fields)`` to actions, batch first, an array or a tensor on the CPU.
        control: name of the control of the actions; default: the environment's first.
        task_keywords: parameters of the task that the policy requires, such as :attr:`.SteppingPolicy.task_keywords` of
            an agent; default: only those of the evaluation.
    """

    def __init__(
        self,
        function: Callable[[numpy.ndarray], Any],
        control: str | None = None,
        task_keywords: Mapping[str, Any] | None = None,
    ) -> None:
        self.function = function
        self.task_keywords: dict[str, Any] = dict(task_keywords or {})
        if control is not None:
            self.control = control  # type: ignore[misc]  # of the function, not of the class

    def act(self, observation: numpy.ndarray, state: Any, start: numpy.ndarray) -> tuple[numpy.ndarray, Any]:
        """Return the function's actions for a batch of observations, and None as memory."""
        return host_array(self.function(observation)), None


class ConstantPolicy(Policy):
    """Policy that always returns the same action."""

    traceable = True
    action: tuple[float, ...]

    def act(self, observation: numpy.ndarray, state: Any, start: numpy.ndarray) -> tuple[numpy.ndarray, Any]:
        """Return the constant action for every episode, ``(N, A)``, and None as memory."""
        return numpy.tile(1.0 * numpy.asarray(self.action), (len(observation), 1)), None


DRAWN_AT_ONCE = 32
"""Number of decisions whose random actions are drawn in one call."""


class RandomActions:
    """Random actions of parallel episodes, from one generator for each episode and the space of one action."""

    def __init__(self, generators: Sequence[numpy.random.Generator], space: Any) -> None:
        self._generators, self._space = generators, space
        self._drawn: list[numpy.ndarray] = []

    def next(self) -> numpy.ndarray:
        """Return the random actions of the next decision, one row for each episode."""
        if not self._drawn:
            space = self._space
            each: list[numpy.ndarray]
            if hasattr(space, "n"):
                each = [g.integers(space.n, size=DRAWN_AT_ONCE) for g in self._generators]
            else:
                shape = (DRAWN_AT_ONCE, *space.shape)
                each = [g.uniform(space.low, space.high, shape) for g in self._generators]
            self._drawn = list(numpy.stack(each, axis=1))[::-1]
        return self._drawn.pop()


class RandomPolicy(Policy):
    """Policy of uniformly random actions."""

    seed = 0

    def __init__(self, model: Model) -> None:
        super().__init__(model)
        self.control: str = model.control  # type: ignore[misc]  # it suits every control

    def begin(self, seeds: Sequence[int]) -> RandomActions:
        """Return the generators of random actions, one for each episode, seeded by policy and episode."""
        generators = [numpy.random.default_rng([self.seed, seed]) for seed in seeds]
        return RandomActions(generators, self.model.action_space)

    def act(self, observation: numpy.ndarray, state: Any, start: numpy.ndarray) -> tuple[numpy.ndarray, Any]:
        """Return uniformly random actions ``(N, ...)``, and their generators as memory."""
        actions = self.begin(range(len(observation))) if state is None else state
        return actions.next(), actions


class Estimator(Protocol):
    """Protocol of a user's estimator: any object with these two methods, for arrays ``(..., N)`` of N episodes.

    A class is made for the task if its constructor takes an argument: ``task.parameters`` contains every
    constant, ``task.components`` the estimated components with their units.

    N is a multiple of eight: the last episode is repeated in further lanes (parallel episodes), so that rounding in
    matrix products does not depend on the number of episodes.
    """

    kind: ClassVar[Kind] = "estimator"
    traceable: ClassVar[bool] = False
    """Whether it is compiled with the steps of the world: its memory is nested tuples of arrays ``(..., N)``, its
    methods compute with the array functions of ``task.xp`` alone, no value decides what is executed, and the object
    stores nothing. Other estimators run as Python code."""

    def start(self, initial: Any, N: int) -> Any:
        """Return the estimator's memory at the start of N episodes.

        Args:
            initial: the initial estimate given to every filter: :class:`~filtergym.envs.contract.filter.Initial` or a
                NamedTuple with its fields, ``mean`` ``(C, N)`` and ``covariance`` ``(C, C, N)``.
            N: number of episodes.
        """

    def update(self, memory: Any, measurement: Any) -> tuple[Array, Array, Any]:
        """Return mean, covariance and memory after a measurement, for N episodes.

        Args:
            memory: memory that the last call or :meth:`start` returned.
            measurement: the task's ``Measurement``, arrays with N as their last axis; do not change them in place.

        Returns:
            Mean ``(C, N)`` and covariance ``(C, C, N)`` of the task's components in their units, and the memory. A
            fourth entry may give the log-likelihood of the measurement, ``(N,)`` in nats, or a :class:`Likelihood`.
            Then the estimator is also evaluated by its predictions, on recordings without truth, too.
        """
        ...


class Smoother(Estimator, Protocol):
    """Protocol of an estimator that estimates each time with later measurements, too.

    It runs forward like any estimator, and :meth:`smooth` then receives all its memories. It declares
    ``kind = "smoother"``; without it an estimator with a method ``smooth`` is evaluated by its causal
    estimates. It cannot run in a closed loop.
    """

    kind: ClassVar[Kind] = "smoother"

    def smooth(self, measurements: Sequence[Any], memories: Sequence[Any]) -> tuple[Array, Array]:
        """Return the smoothed means and covariances at all measurements, after the last one.

        Args:
            measurements: the K measurements that :meth:`update` received, in their order.
            memories: K + 1 memories returned by :meth:`start` and every :meth:`update`. A memory that is changed in
                place contains only its last state.

        Returns:
            Means ``(C, K, N)`` and covariances ``(C, C, K, N)`` at the measurements.
        """
        ...


class Reference(Protocol):
    """Protocol of an estimator that can use the truth, to show what remains to be gained.

    It starts from the initial estimate given to every filter. In a closed loop it has its own truth, on the same noise.
    """

    kind: ClassVar[Kind] = "reference"
    knows: ClassVar[str]
    """Description of the truth that it uses, for reports."""
    disturbances: ClassVar[Collection[str] | None] = ()
    """Names of the world's disturbances that it uses or ignores on purpose; None: it uses no sensors."""

    def __init__(self, task: Task) -> None: ...

    def start(self, initial: Any, truth: Any) -> Any:
        """Return the reference's memory at the start of N episodes.

        Args:
            initial: the initial estimate given to every filter.
            truth: the true state at the start.
        """

    def update(self, memory: Any, measurement: Any, truth: Any) -> tuple[Array, Array, Any]:
        """Return mean ``(C, N)``, covariance ``(C, C, N)`` and memory after a measurement, with the present truth."""
        ...


class Bound(Protocol):
    """Protocol of a computed lower bound of the mean square error."""

    kind: ClassVar[Kind] = "bound"
    knows: ClassVar[str]
    disturbances: ClassVar[Collection[str] | None] = ()

    def __init__(self, task: Task) -> None: ...

    def start(self, initial: Any, truth: Any) -> Any:
        """Return the bound's memory at the start of N episodes; arguments as of :meth:`Reference.start`."""

    def update(self, memory: Any, measurement: Any, truth: Any) -> tuple[Array, Any]:
        """Return the bound of the mean square error of ``task.components``, ``(C, N)``, and the memory."""
        ...
