"""What a policy, an estimator, a smoother, a reference and a bound are.

A **policy** sees observations and returns actions; learned or classical, it answers Stable-Baselines3's
call. An **estimator** sees what a policy's filters see, the start of the track and every measurement, and answers with
mean and covariance; it is ranked with the policies, and marked. A **smoother** is an estimator that answers after the
last measurement and uses later ones, too: it is not causal, and never ranked. A **reference** is an estimator
that may be told what no competitor knows; it is never ranked. A **bound** is computed. Each says what it is by its
``kind``; what says nothing is an estimator if it has ``start`` and ``update``, otherwise a policy, such as a model of
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
"""What is ranked: it knows nothing that is hidden, and nothing before it is measured."""
TOLD_MORE: tuple[Kind, ...] = ("reference", "bound")
"""What may be told more than is measured, and says so in ``knows``."""
NOT_CAUSAL = "Not causal, with later measurements"
"""What is said of smoothers wherever they are reported, before their names."""


class Competitor(NamedTuple):
    """A name with what it stands for in a problem."""

    name: str
    maker: Any
    """A class or function that makes the competitor, or the competitor itself; see :func:`make_competitor`."""
    learned: bool = False
    """Whether it was trained."""
    identity: str | None = None
    """Words that change whenever the maker does; None where nothing says whether it is what it was."""
    log: Any = None
    """How the log was read that the competitor was fitted to (:class:`.envs.contract.log_format.LogSetup`), or None."""


class CompetitorFiles(NamedTuple):
    """Competitors that are kept in files and folders."""

    find: Callable[[str, Any, bool, Callable[[str, str], Competitor]], Competitor | None]
    """The competitor of a name in a problem, or None. Takes also whether to load what can execute code, and a function
    that returns the shipped competitor of a name; its second argument names the thing in errors."""
    endings: Sequence[str]
    """Of the names of its files."""
    names: Callable[[str], list[str]] = lambda id: []
    """Names of those that are shipped for a Gymnasium id."""
    adopt: Callable[[Any], Any] = lambda found: found
    """Puts an object of a known library behind its adapter, and returns others as they are."""


def kind_of(competitor: Any) -> Kind:
    """Say what a competitor is, or what a maker makes."""
    estimates = _has(competitor, "start", "update") and (
        is_filter(competitor) or not hasattr(competitor, "predict")
    )
    return getattr(competitor, "kind", "estimator" if estimates else "policy")


def is_filter(competitor: Any) -> bool:
    """Whether it is a filter, or makes one; what else estimates is put into one (:func:`.filters.as_filter`)."""
    made = getattr(competitor, "func", competitor)
    return issubclass(made if isinstance(made, type) else type(made), Filter)


def is_program(found: Any) -> bool:
    """Whether it computes in a process of its own, whose time that process tells."""
    return getattr(found, "is_program", False) is True


def _has(found: Any, *methods: str) -> bool:
    return all(callable(getattr(found, method, None)) for method in methods)


def make_competitor(maker: Any, problem: Task | Model) -> Any:
    """Make a competitor for a problem.

    Args:
        maker: a class or function that takes the problem, or nothing; or the competitor itself. One whose first
            argument has a default is given nothing, unless it is called ``task`` or ``model``.
        problem: of a policy the model that it acts in, of anything else the task.
    """
    if not callable(maker):
        return maker
    return maker(problem) if takes_problem(maker) else maker()


def answers_by_track(competitor: Any) -> bool:
    """Whether a competitor, such as one from a file, must be told which episodes it runs in.

    It has ``of_episodes(task, seeds)``, which makes the competitor in the episodes of these seeds.
    """
    return _has(competitor, "of_episodes")


def check_competitor(name: str, found: Any, kind: Kind | None = None) -> Any:
    """Return what a user has named or made, if it can compete; it is not called yet.

    Args:
        name: in the table.
        found: a competitor, or a class of one.
        kind: as which it must compete; default: what it says it is.

    Raises:
        ValueError: if it has not the methods of its kind: ``predict``, or ``start`` and ``update``, and ``smooth`` of a
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
    """Let a policy be asked like the model inside it, whose spaces say how.

    Args:
        outer: the policy.
        inner: what may be a model of Stable-Baselines3.
        further: attributes that go over, too, where there are any.
    """
    for name in ("observation_space", "action_space", *further):
        if hasattr(inner, name):
            setattr(outer, name, getattr(inner, name))


class Policy:
    """Base of the classical policies, batch first: observations and actions are ``(N, ...)``, as in Gymnasium.

    A policy is made for a model, and deterministic unless it says otherwise. Filters have the batch last; where a
    policy acts inside a filter, :mod:`.steered_filter` turns the axes.

    Subclasses set ``control`` and answer :meth:`predict`; those with memory keep it in the ``state`` that
    goes in and out, so that one object serves any number of episodes.
    """

    kind: ClassVar[Kind] = "policy"
    control: ClassVar[str]
    """The control that the policy's actions are meant for."""
    traceable: ClassVar[bool] = False
    """Whether :meth:`act` is compiled where the steps of the model are: it computes with NumPy alone, no value decides
    what is executed, its memory is nested tuples of arrays, batch first, of which only the values depend on the
    observations, and nothing is kept in the object. A class with another ``act`` says it anew."""

    def __init__(self, model: Model) -> None:
        self.model = model
        self.task: Any = model.task

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
            observation: ``(N, len(model.fields))``, or one observation without the batch axis.
            state: what the last call returned; None at the first.
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
        """Answer a batch; ``start`` is true where memory must begin anew."""
        raise NotImplementedError


def compilation_key(maker: Any) -> Any:
    """Return what code compiled of a competitor is kept by: what makes it, or of a function, which may make another one
    next time, an object of this call's own.
    """
    return functools.partial(maker) if isinstance(maker, types.FunctionType) else maker


def says_traceable(policy: Any) -> bool:
    """Whether a policy says of its own methods, not of those that they replace, that they can be traced; or of itself,
    where that depends on what it is made of.
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
    """Actions by a function of the observation: how an agent of any library is evaluated.

    Args:
        function: given observations ``(N, fields)``, returns actions, batch first, as an array or a tensor on the CPU.
        control: that the actions are meant for; default: the environment's first.
        task_keywords: parameters of the task that it acts with, as :attr:`.SteppingPolicy.task_keywords` of the policy
            that it is a copy of; default: none but those of the evaluation.
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
        """Ask the function."""
        return host_array(self.function(observation)), None


class ConstantPolicy(Policy):
    """The same action always."""

    traceable = True
    action: tuple[float, ...]

    def act(self, observation: numpy.ndarray, state: Any, start: numpy.ndarray) -> tuple[numpy.ndarray, Any]:
        """Repeat the action for every episode."""
        return numpy.tile(1.0 * numpy.asarray(self.action), (len(observation), 1)), None


DRAWN_AT_ONCE = 32
"""Decisions for which random actions are drawn together."""


class RandomActions:
    """Actions of episodes side by side, each drawn by a generator of its own, for several decisions at once.

    The numbers are those of one draw after another.

    Args:
        generators: one for each episode.
        space: of one action.
    """

    def __init__(self, generators: Sequence[numpy.random.Generator], space: Any) -> None:
        self._generators, self._space = generators, space
        self._drawn: list[numpy.ndarray] = []

    def next(self) -> numpy.ndarray:
        """Actions of the next decision, one row for each episode."""
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
    """Uniform actions; the floor that any policy should beat."""

    seed = 0

    def __init__(self, model: Model) -> None:
        super().__init__(model)
        self.control: str = model.control  # type: ignore[misc]  # it suits every control

    def begin(self, seeds: Sequence[int]) -> RandomActions:
        """Give every episode a generator of its own, of the policy's seed and the episode's."""
        generators = [numpy.random.default_rng([self.seed, seed]) for seed in seeds]
        return RandomActions(generators, self.model.action_space)

    def act(self, observation: numpy.ndarray, state: Any, start: numpy.ndarray) -> tuple[numpy.ndarray, Any]:
        """Draw from the action space, each row from its generator."""
        actions = self.begin(range(len(observation))) if state is None else state
        return actions.next(), actions


class Estimator(Protocol):
    """An estimator that a user brings, batch last: any object with these two methods, for arrays ``(..., N)``.

    A class is made for the task if its constructor takes an argument: ``task.parameters`` holds every constant,
    ``task.components`` what is estimated, in which unit. Nothing else of the task is needed.

    N episodes are estimated side by side. N is a multiple of eight: the last episode is
    repeated to fill up, so that rounding in matrix products does not depend on how many there are.
    """

    kind: ClassVar[Kind] = "estimator"
    traceable: ClassVar[bool] = False
    """Whether it is compiled with the steps of the world: its memory is nested tuples of arrays ``(..., N)``, its
    methods compute with the array functions of ``task.xp`` alone, no value decides what is executed, and nothing is
    kept in the object. What is not runs as Python code."""

    def start(self, initial: Any, N: int) -> Any:
        """Memory at the start of the track.

        Args:
            initial: the initial estimate given to every filter: :class:`~filtergym.envs.contract.filter.Initial` or a
                NamedTuple with its fields, ``mean`` ``(C, N)`` and ``covariance`` ``(C, C, N)``.
            N: number of episodes.
        """

    def update(self, memory: Any, measurement: Any) -> tuple[Array, Array, Any]:
        """Estimate after a measurement.

        Args:
            memory: what the last call returned.
            measurement: the task's ``Measurement``, arrays with N as their last axis; not to be changed in place.

        Returns:
            Mean ``(C, N)`` and covariance ``(C, C, N)`` of the task's components in their units, and the memory. A
            fourth entry may tell how well the measurement was predicted: its log-likelihood ``(N,)`` in nats, or a
            :class:`Likelihood`. Then the estimator is judged by it too, also on recordings without truth.
        """
        ...


class Smoother(Estimator, Protocol):
    """An estimator that answers after the last measurement, each time with all measurements or some scans later.

    It runs forward like any estimator, and what it has kept is given back to it. It says so by ``kind = "smoother"``;
    an estimator with a method ``smooth`` alone is judged by what it says at the time. In a closed loop, where the
    estimate decides what is measured next, it is refused.
    """

    kind: ClassVar[Kind] = "smoother"

    def smooth(self, measurements: Sequence[Any], memories: Sequence[Any]) -> tuple[Array, Array]:
        """Estimate again when all is measured.

        Args:
            measurements: the K measurements that :meth:`update` was given, in their order.
            memories: what :meth:`start` and every :meth:`update` have returned, K + 1 of them. A memory that is changed
                in place shows only its last state.

        Returns:
            Means ``(C, K, N)`` and covariances ``(C, C, K, N)`` at the measurements.
        """
        ...


class Reference(Protocol):
    """An estimator that runs on the episode's measurements and may know what no competitor does.

    It starts where everyone starts. In a closed loop it flies a truth of its own, on the same noise.
    """

    kind: ClassVar[Kind] = "reference"
    knows: ClassVar[str]
    """What it is told, in words; printed wherever it is reported."""
    disturbances: ClassVar[Collection[str] | None] = ()
    """Names of the world's disturbances that it is told of or ignores on purpose; None: sensors are nothing to it."""

    def __init__(self, task: Task) -> None: ...

    def start(self, initial: Any, truth: Any) -> Any:
        """Memory at the start of the track.

        Args:
            initial: the initial estimate given to every filter.
            truth: at that time.
        """

    def update(self, memory: Any, measurement: Any, truth: Any) -> tuple[Array, Array, Any]:
        """Estimate after a measurement; returns as of :meth:`Estimator.update`."""
        ...


class Bound(Protocol):
    """A computed limit of the mean square error."""

    kind: ClassVar[Kind] = "bound"
    knows: ClassVar[str]
    disturbances: ClassVar[Collection[str] | None] = ()

    def __init__(self, task: Task) -> None: ...

    def start(self, initial: Any, truth: Any) -> Any:
        """Memory at the start of the track; arguments as of :meth:`Reference.start`."""

    def update(self, memory: Any, measurement: Any, truth: Any) -> tuple[Array, Any]:
        """Bound of the mean square of ``task.components``, ``(C, N)``, and the memory."""
        ...
