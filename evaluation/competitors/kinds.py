"""Protocols and bases of policies, estimators, smoothers, references and bounds.

A **policy** observes and returns actions; learned or classical, it has Stable-Baselines3's method ``predict``. An
**estimator** receives what a policy's filters receive, the initial estimate and every measurement, and returns mean and
covariance; it is ranked with the policies, and marked. A **smoother** is an estimator that returns its estimates after
the last measurement and also uses later ones: it is not causal, and never ranked. A **reference** is an estimator that
may know what no competitor measures; it is never ranked. A **bound** is computed. The attribute ``kind`` gives the
kind; an object without it is an estimator if it has ``start`` and ``update``, otherwise a policy, such as a model of
Stable-Baselines3.
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
"""Kinds that are ranked: they know nothing hidden, and nothing before it is measured."""
INFORMED_KINDS: tuple[Kind, ...] = ("reference", "bound")
"""Kinds that may know more than is measured; their attribute ``knows`` describes it."""
NOT_CAUSAL = "Not causal, with later measurements"
"""Words before the names of smoothers in every report."""


class Competitor(NamedTuple):
    """A competitor by its name in a problem."""

    name: str
    maker: Any
    """A class or function that makes the competitor, or the competitor itself; see :func:`make_competitor`."""
    learned: bool = False
    """Whether it was trained."""
    identity: str | None = None
    """Words that change whenever the maker does; None where such a change cannot be recognised."""
    log: Any = None
    """How the log was read that the competitor was fitted to (:class:`.envs.contract.log_format.LogSetup`), or None."""


class CompetitorFiles(NamedTuple):
    """Functions that find and load competitors stored in files and folders."""

    find: Callable[[str, Any, bool, Callable[[str, str], Competitor]], Competitor | None]
    """The competitor of a name in a problem, or None. Also takes whether to load files that can execute code, and a
    function that returns the shipped competitor of a name; its second argument names the thing in errors."""
    endings: Sequence[str]
    """Endings of the names of such files."""
    names: Callable[[str], list[str]] = lambda id: []
    """Names of the shipped competitors of a Gymnasium id."""
    adopt: Callable[[Any], Any] = lambda found: found
    """Wraps an object of a known library in its adapter, and returns other objects unchanged."""


def kind_of(competitor: Any) -> Kind:
    """Return the kind of a competitor, or of the competitors that a maker makes."""
    estimates = _has(competitor, "start", "update") and (
        is_filter(competitor) or not hasattr(competitor, "predict")
    )
    return getattr(competitor, "kind", "estimator" if estimates else "policy")


def is_filter(competitor: Any) -> bool:
    """Return whether it is a filter, or makes one; :func:`.filters.as_filter` wraps other estimators in a filter."""
    made = getattr(competitor, "func", competitor)
    return issubclass(made if isinstance(made, type) else type(made), Filter)


def is_program(found: Any) -> bool:
    """Return whether it computes in a process of its own, which reports its time."""
    return getattr(found, "is_program", False) is True


def _has(found: Any, *methods: str) -> bool:
    return all(callable(getattr(found, method, None)) for method in methods)


def make_competitor(maker: Any, problem: Task | Model) -> Any:
    """Make a competitor for a problem.

    Args:
        maker: a class or function that takes the problem, or nothing; or the competitor itself. One whose first
            argument has a default is called without arguments, unless that argument is named ``task`` or ``model``.
        problem: for a policy the model that it acts in, for any other kind the task.
    """
    if not callable(maker):
        return maker
    return maker(problem) if takes_problem(maker) else maker()


def is_made_for_episodes(competitor: Any) -> bool:
    """Return whether a competitor, such as one from a file, is made for given episodes.

    Such a competitor has ``of_episodes(task, seeds)``, which makes the competitor for the episodes of these seeds.
    """
    return _has(competitor, "of_episodes")


def check_competitor(name: str, found: Any, kind: Kind | None = None) -> Any:
    """Check that an object that a user has named or made can compete, and return it; it is not called yet.

    Args:
        name: its name in the table of results.
        found: a competitor, or a class of one.
        kind: as which it must compete; default: its own.

    Raises:
        ValueError: if it lacks a method of its kind: ``predict``, or ``start`` and ``update``, and ``smooth`` of a
            smoother; or if its ``update`` takes the memory after the measurement.
    """
    kind = kind or kind_of(found)
    methods = {"policy": ("predict",), "smoother": ("start", "update", "smooth")}.get(
        kind, ("start", "update")
    )
    if kind not in get_args(Kind) or not _has(found, *methods):
        too = ", a smoother smooth too" if kind == "smoother" else ""
        raise ValueError(
            f"{name!r} is no competitor: a policy has a method predict, an estimator the methods start and update{too}"
        )
    try:
        check_update_order(found)
    except ValueError as error:
        raise ValueError(f"{name!r}: {error}") from None
    return found


def expose_spaces(outer: Any, inner: Any, *further: str) -> None:
    """Copy the spaces of an inner model to the policy around it, so that both are called alike.

    Args:
        outer: the policy.
        inner: for example a model of Stable-Baselines3.
        further: other attributes to copy where the inner model has them.
    """
    for name in ("observation_space", "action_space", *further):
        if hasattr(inner, name):
            setattr(outer, name, getattr(inner, name))


class Policy:
    """Base of the classical policies, batch first: observations and actions are ``(N, ...)``, as in Gymnasium.

    A policy is made for a model, and deterministic unless documented otherwise. Filters have the batch last; where a
    policy acts inside a filter, :mod:`.steered_filter` transposes the axes.

    Subclasses set ``control`` and define :meth:`act`. A policy with memory takes and returns it as ``state``, so that
    one object serves any number of episodes.
    """

    kind: ClassVar[Kind] = "policy"
    control: ClassVar[str]
    """The control that the policy's actions are meant for."""
    traceable: ClassVar[bool] = False
    """Whether :meth:`act` is compiled where the steps of the model are: it computes with NumPy alone, no value decides
    what is executed, its memory is nested tuples of arrays, batch first, of which only the values depend on the
    observations, and the object stores nothing. A class with another ``act`` must declare it again."""

    def __init__(self, model: Model) -> None:
        self.model = model
        self.task: Any = model.task

    def begin(self, seeds: Sequence[int]) -> Any:
        """Return the memory at the start of the episodes with these seeds, for the first :meth:`predict` of an
        evaluation.

        A policy with random numbers draws them from the seeds, so that an episode does not depend on the others beside
        it.
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
            observation: ``(N, len(model.fields))``, or one observation without the batch axis.
            state: as returned by the last call; None at the first.
            episode_start: ``(N,)`` booleans, true where a new episode begins.
            deterministic: as in Stable-Baselines3; classical policies ignore it.

        Returns:
            Actions, batch first, and the state for the next call.
        """
        single = observation.ndim == 1
        batch = observation[None] if single else observation
        start = numpy.full(len(batch), state is None) if episode_start is None else episode_start
        if state is None:
            start = numpy.ones(len(batch), dtype=bool)
        action, state = self.act(batch, state, numpy.reshape(start, -1))
        return (action[0] if single else action), state

    def act(self, observation: numpy.ndarray, state: Any, start: numpy.ndarray) -> tuple[numpy.ndarray, Any]:
        """Return the actions of a batch and the memory; ``start`` is true where memory must be reset."""
        raise NotImplementedError


def compilation_key(maker: Any) -> Any:
    """Return the key of compiled code in its cache: the maker of the competitor; for a function, which may make a
    different one next time, a new object.
    """
    return functools.partial(maker) if isinstance(maker, types.FunctionType) else maker


def is_traceable(policy: Any) -> bool:
    """Return whether a policy declares that its methods can be traced.

    The declaration must stand in the object, or in the class that defines the methods or one derived from it: it does
    not hold for methods that a subclass replaces.
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
    """Policy that computes its actions by a function of the observation, to evaluate an agent of any library.

    Args:
        function: takes observations ``(N, fields)`` and returns actions, batch first, as an array or a tensor on the
            CPU.
        control: the control that the actions are for; default: the environment's first.
        task_keywords: parameters of the task that the policy requires, such as :attr:`.SteppingPolicy.task_keywords` of
            the policy that it copies; default: only those of the evaluation.
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
        """Call the function."""
        return host_array(self.function(observation)), None


class ConstantPolicy(Policy):
    """Policy with one constant action."""

    traceable = True
    action: tuple[float, ...]

    def act(self, observation: numpy.ndarray, state: Any, start: numpy.ndarray) -> tuple[numpy.ndarray, Any]:
        """Repeat the action for every episode."""
        return numpy.tile(1.0 * numpy.asarray(self.action), (len(observation), 1)), None


DRAWN_AT_ONCE = 32
"""Number of decisions whose random actions are drawn in one call."""


class RandomActions:
    """Random actions of episodes side by side, drawn by one generator for each episode.

    Several decisions are drawn in one call; the numbers equal those of one draw after another.

    Args:
        generators: one for each episode.
        space: Gymnasium space of one action.
    """

    def __init__(self, generators: Sequence[numpy.random.Generator], space: Any) -> None:
        self._generators, self._space = generators, space
        self._drawn: list[numpy.ndarray] = []

    def next(self) -> numpy.ndarray:
        """Return the actions of the next decision, one row for each episode."""
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
    """Policy of uniformly random actions; every policy should have a lower cost."""

    seed = 0

    def __init__(self, model: Model) -> None:
        super().__init__(model)
        self.control: str = model.control  # type: ignore[misc]  # it suits every control

    def begin(self, seeds: Sequence[int]) -> RandomActions:
        """Make a generator for every episode from the policy's seed and the episode's."""
        generators = [numpy.random.default_rng([self.seed, seed]) for seed in seeds]
        return RandomActions(generators, self.model.action_space)

    def act(self, observation: numpy.ndarray, state: Any, start: numpy.ndarray) -> tuple[numpy.ndarray, Any]:
        """Draw actions from the action space, each row by the generator of its episode."""
        actions = self.begin(range(len(observation))) if state is None else state
        return actions.next(), actions


class Estimator(Protocol):
    """Protocol of a user's estimator, batch last: any object with these two methods, for arrays ``(..., N)``.

    A class is made for the task if its constructor takes an argument: ``task.parameters`` contains every constant,
    ``task.components`` the estimated components with their units. Nothing else of the task is needed.

    N episodes are estimated side by side. N is a multiple of eight: the last episode is
    repeated to fill up, so that rounding in matrix products does not depend on the number of episodes.
    """

    kind: ClassVar[Kind] = "estimator"
    traceable: ClassVar[bool] = False
    """Whether it is compiled with the steps of the world: its memory is nested tuples of arrays ``(..., N)``, its
    methods compute with the array functions of ``task.xp`` alone, no value decides what is executed, and the object
    stores nothing. Other estimators run as Python code."""

    def start(self, initial: Any, N: int) -> Any:
        """Return the memory at the start of the track.

        Args:
            initial: the initial estimate given to every filter: :class:`~filtergym.envs.contract.filter.Initial` or a
                NamedTuple with its fields, ``mean`` ``(C, N)`` and ``covariance`` ``(C, C, N)``.
            N: number of episodes.
        """

    def update(self, memory: Any, measurement: Any) -> tuple[Array, Array, Any]:
        """Return the estimate after a measurement.

        Args:
            memory: as returned by the last call.
            measurement: the task's ``Measurement``, arrays with N as their last axis; not to be changed in place.

        Returns:
            Mean ``(C, N)`` and covariance ``(C, C, N)`` of the task's components in their units, and the memory. A
            fourth entry may give the log-likelihood of the measurement, ``(N,)`` in nats, or a :class:`Likelihood`.
            Then the estimator is also evaluated by its predictions, on recordings without truth, too.
        """
        ...


class Smoother(Estimator, Protocol):
    """Protocol of an estimator that estimates each time with all measurements, or with those of some scans later.

    It runs forward like any estimator, and :meth:`smooth` then receives all its memories. It declares ``kind =
    "smoother"``; without that declaration an estimator with a method ``smooth`` is evaluated by its causal estimates. A
    closed loop, where the estimate decides what is measured next, raises an error for a smoother.
    """

    kind: ClassVar[Kind] = "smoother"

    def smooth(self, measurements: Sequence[Any], memories: Sequence[Any]) -> tuple[Array, Array]:
        """Return the smoothed estimates, after the last measurement.

        Args:
            measurements: the K measurements that :meth:`update` was given, in their order.
            memories: K + 1 memories returned by :meth:`start` and every :meth:`update`. A memory that is changed in
                place contains only its last state.

        Returns:
            Means ``(C, K, N)`` and covariances ``(C, C, K, N)`` at the measurements.
        """
        ...


class Reference(Protocol):
    """An estimator that runs on the episode's measurements and may know what no competitor does.

    It starts from the initial estimate of every filter. In a closed loop it flies a truth of its own, on the same
    noise.
    """

    kind: ClassVar[Kind] = "reference"
    knows: ClassVar[str]
    """Hidden knowledge that it has, in words; printed in every report."""
    disturbances: ClassVar[Collection[str] | None] = ()
    """Names of the world's disturbances that it knows or ignores on purpose; None: it uses no sensors."""

    def __init__(self, task: Task) -> None: ...

    def start(self, initial: Any, truth: Any) -> Any:
        """Return the memory at the start of the track.

        Args:
            initial: the initial estimate given to every filter.
            truth: at that time.
        """

    def update(self, memory: Any, measurement: Any, truth: Any) -> tuple[Array, Array, Any]:
        """Return mean ``(C, N)``, covariance ``(C, C, N)`` and memory after a measurement, as an estimator."""
        ...


class Bound(Protocol):
    """A computed limit of the mean square error."""

    kind: ClassVar[Kind] = "bound"
    knows: ClassVar[str]
    disturbances: ClassVar[Collection[str] | None] = ()

    def __init__(self, task: Task) -> None: ...

    def start(self, initial: Any, truth: Any) -> Any:
        """Return the memory at the start of the track; arguments as of :meth:`Reference.start`."""

    def update(self, memory: Any, measurement: Any, truth: Any) -> tuple[Array, Any]:
        """Return the bound of the mean square error of ``task.components``, ``(C, N)``, and the memory."""
        ...
