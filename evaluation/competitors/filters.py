"""Competitors as filters: what puts an estimator, a reference or a bound in the place of a task's bank.

What ships is a filter. What a user brings becomes one here (:func:`as_filter`): it is compiled like a bank if it says
that it is ``traceable``. The rest runs as Python code between compiled steps of the world, and keeps its memory to
itself: it may be anything.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import gymnasium
import numpy

from ...compiler.namespace import NotTraceable
from ...envs.contract.failures import explain_errors
from ...envs.contract.filter import Filter, FilterInput, Likelihood, State, Stated
from ...envs.contract.model import Model
from ...envs.contract.observation import Array
from ...envs.contract.task import Task, named_arrays
from ...envs.engine.compiled import warn_of
from ...filters.small_matrices import cholesky
from .adapters import select_lanes
from .kinds import TOLD_MORE, Kind, check_competitor, compilation_key, is_program, make_competitor

AFTER_MISSED = 5.0
"""Number of the reason among :data:`..storage.dataset.FAULTS` that a missed measurement explains."""
UNTOLD: tuple[Kind, ...] = ("estimator", "smoother")
"""What starts and updates with nothing but the initial estimate and the measurements."""


class Adapted(NamedTuple):
    """State of what a user brings."""

    mean: Array
    """``(C, N)``."""
    covariance: Array
    """``(C, C, N)``; None of a bound."""
    memory: Any
    """Its own, or None where that is kept in Python."""
    likelihood: Likelihood
    """Of the last measurement, NaN where it is not told."""


class Adapter(Filter[Task, Any, Adapted]):
    """A user's estimator as a filter, see :class:`.kinds.Estimator`.

    Args:
        task: the estimation problem.
        own: the estimator, made for it.
    """

    def __init__(self, task: Task, own: Any) -> None:
        super().__init__(task)
        self.own = own
        self.in_python: bool = not getattr(own, "traceable", False)
        self.tells: bool = False
        """Whether it has told how well it predicted, ever."""

    def start(self, initial: Any) -> Adapted:
        """Start where everyone starts."""
        return self.first(initial, self.own.start(initial, initial.mean.shape[-1]))

    def first(self, initial: Any, memory: Any) -> Adapted:
        """State before the first measurement."""
        return Adapted(initial.mean, initial.covariance, memory, Likelihood.unknown(initial.mean[0]))

    def update(self, state: Adapted, given: FilterInput) -> Adapted:
        """Take its answer."""
        answer = self.ask(given, state.memory)
        if not isinstance(answer, tuple | list) or len(answer) not in (3, 4):
            count = f" of {len(answer)}" if isinstance(answer, tuple | list) else ""
            raise TypeError(
                "update must return mean, covariance and memory, and may return the log-likelihood, not "
                f"{type(answer).__name__}{count}"
            )
        mean, covariance, memory, *reported = answer
        likelihood = state.likelihood
        if reported:
            self.tells, likelihood = True, Likelihood.of(*reported)
            likelihood = likelihood if self.in_python else likelihood.fill_unknown(mean[0])
        return Adapted(mean, covariance, memory, likelihood)

    @property
    def fault(self) -> int:
        """Number of the reason among ``FAULTS`` for which it has no answer at all, as a program may have; 0: none."""
        return getattr(self.own, "fault", 0)

    def ask(self, given: FilterInput, memory: Any) -> Any:
        """Its answer to a measurement."""
        return self.own.update(memory, given.measurement)

    def smooth(self, measurements: Sequence[Any], states: Sequence[Adapted]) -> tuple[Array, Array]:
        """Smooth the track, of a smoother."""
        answer: tuple[Array, Array] = self.own.smooth(measurements, [state.memory for state in states])
        return answer


class ReferenceAdapter(Adapter):
    """A user's reference as a filter, see :class:`.kinds.Reference`."""

    def __init__(self, task: Task, own: Any) -> None:
        super().__init__(task, own)
        self.knows: str = getattr(own, "knows", "") or "the truth"

    def initialise(self, given: FilterInput) -> Adapted:
        """Start where everyone starts, with the truth."""
        return self.first(given.measurement, self.own.start(given.measurement, given.truth))

    def ask(self, given: FilterInput, memory: Any) -> Any:
        """Its answer to a measurement and the truth."""
        return self.own.update(memory, given.measurement, given.truth)


class BoundAdapter(ReferenceAdapter):
    """A bound as a filter whose mean is the limit, see :class:`.kinds.Bound`."""

    def first(self, initial: Any, memory: Any) -> Adapted:
        """Nothing is known before the first measurement."""
        return Adapted(0.0 * initial.mean, None, memory, Likelihood.unknown(initial.mean[0]))

    def ask(self, given: FilterInput, memory: Any) -> Any:
        """Its limit, without a covariance."""
        limit, memory = super().ask(given, memory)
        return limit, None, memory


def as_filter(task: Task, own: Any, kind: Kind = "estimator") -> Filter[Any, Any, Any]:
    """Return what was made for a task as a filter: itself, if it is one."""
    if isinstance(own, Filter):
        return own
    adapters = {"reference": ReferenceAdapter, "bound": BoundAdapter}
    return adapters.get(kind, Adapter)(task, own)


class HeldInPython(Filter[Task, Any, Adapted]):
    """A filter asked in Python: its state stays here, and may be anything; its answers are checked.

    Args:
        task: the estimation problem.
        own: the filter; None beside traced steps.
        name: what it is and its name, in errors.
        count: number of episodes; lanes beyond are given the last of them. None: all lanes as they are.
        stated: what it states, where ``own`` is None.
    """

    in_python = True

    def __init__(
        self,
        task: Task,
        own: Any = None,
        name: str = "",
        count: int | None = None,
        stated: Stated | None = None,
    ) -> None:
        super().__init__(task)
        self.own = own
        self.name = name
        self.count = count
        self.stated: Stated | None = getattr(own, "stated", stated)
        self.memory: Any = None
        self.step_number: int = 0
        self.told: Mapping[str, Array] = {}
        """What it has said beside its last estimate."""
        self.knows: str = getattr(own, "knows", "")

    @property
    def fault(self) -> int:
        """Number of the reason among ``FAULTS`` for which a program has no answer at all; 0: it has."""
        return self.own.fault if isinstance(self.own, Adapter) else 0

    def _repeat_last(self, given: FilterInput) -> FilterInput:
        """Copies, which may be changed in place."""
        if self.count is None:
            return given
        width = given.measurement[0].shape[-1]
        lanes = numpy.minimum(numpy.arange(width), self.count - 1)
        return given._replace(measurement=select_lanes(given.measurement, lanes))

    def initialise(self, given: FilterInput) -> Adapted:
        """Keep its state."""
        with explain_errors(f"{self.name} failed at the start of the track"):
            self.memory = self.own.initialise(self._repeat_last(given))
        initial = given.measurement
        return Adapted(initial.mean, initial.covariance, None, Likelihood.unknown(initial.mean[0]))

    def start(self, initial: Any) -> Adapted:
        """Start without the truth."""
        return self.initialise(FilterInput(initial))

    def update(self, state: Adapted, given: FilterInput) -> Adapted:
        """Its answer.

        Raises:
            ValueError: if what it answers is no array of the right shape.
        """
        self.step_number += 1
        given = self._repeat_last(given)
        with explain_errors(f"{self.name} failed at measurement {self.step_number}"):
            self.memory = after = self.own.step(self.memory, given)
            mean, covariance = self.own.mean(after), self.own.covariance(after)
            self.told = self.own.records(after, given.measurement)
        C, width = len(self.task.components), given.measurement[0].shape[-1]
        # Copies: the estimator may go on in its own arrays. In their layout, by which matrix products round.
        mean = numpy.copy(self._numbers("mean", mean, (C, width)), order="K")
        if covariance is None:  # of a bound
            covariance = state.covariance
        else:
            covariance = numpy.copy(self._numbers("covariance", covariance, (C, C, width)), order="K")
        known = (
            None if values is None else self._numbers(name, values, (width,))
            for name, values in Likelihood.of_records(self.told)._asdict().items()
        )
        return Adapted(mean, covariance, None, Likelihood(*known).fill_unknown(mean[0]))

    def feedback(self, state: Adapted, measurement: Any) -> Array | None:
        """What a program has reported to steer the world."""
        own: Any = self.own.own if isinstance(self.own, Adapter) else None
        return own.feedback if is_program(own) else None

    def _numbers(self, word: str, values: Any, shape: tuple[int, ...]) -> numpy.ndarray:
        """Return what was answered as float64, or raise ValueError if it has another shape."""
        where = f"{self.name}: the {word} at measurement {self.step_number}"
        try:
            given = numpy.asanyarray(values)
            # What float64 has no room for would vanish in it: masks, imaginary parts, words.
            if isinstance(given, numpy.ma.MaskedArray) or given.dtype.kind not in "fiub":
                masked = "a masked array of " * isinstance(given, numpy.ma.MaskedArray)
                raise TypeError(f"expected an array of real numbers, got {masked}{given.dtype}")
            array = numpy.asarray(given, dtype=numpy.float64)
        except (TypeError, ValueError) as error:
            raise ValueError(f"{where} is no array: {error}") from None
        if array.shape != shape:
            components = ", ".join(c.name for c in self.task.components)
            raise ValueError(
                f"{where} must have shape {shape}, {len(self.task.components)} components ({components}) of "
                f"{shape[-1]} episodes, got {array.shape}"
            )
        return array


class Checked(NamedTuple):
    """State of a filter whose answers are checked."""

    own: Any
    """Of the filter."""
    mean: Array
    """Last valid answer, ``(C, N)``; before any the initial estimate."""
    covariance: Array
    """``(C, C, N)``."""
    fault: Array
    """Number of the reason among ``FAULTS`` why the episode is lost, from 1 on; 0 where it is not, ``(N,)``."""
    missed: Array
    """One where a measurement was not received in full so far, ``(N,)``."""
    missing: Array = None
    """One where it has no estimate of this measurement and holds its last one, ``(N,)``; None of what always has."""


class CheckedFilter(Filter[Task, Any, Checked]):
    """A filter in the loop that competes: it never sees what was not received, and its answers are checked.

    An episode in which an answer is not finite, or no covariance, is lost from that measurement on: the last valid
    answer, or else the initial estimate, is held to the end. Any estimator could give that answer itself, so
    that losing an episode is no advantage.
    """

    def __init__(self, task: Task, own: Filter[Any, Any, Any]) -> None:
        super().__init__(task)
        self.own = own
        self.in_python: bool = own.in_python
        self.stated: Stated | None = own.stated

    def start(self, initial: Any) -> Checked:
        """Start where everyone starts."""
        zero = 0.0 * initial.mean[0]
        missing = None if self.stated is None else zero
        return Checked(self.own.start(initial), initial.mean, initial.covariance, zero, zero, missing)

    def predict(self, state: Checked, measurement: Any) -> Checked:
        """Let it predict."""
        return state._replace(own=self.own.predict(state.own, self.task.world.mask_missing(measurement)))

    def update(self, state: Checked, given: FilterInput) -> Checked:
        """Check its answer, and keep the last valid one."""
        received = self.task.world.mask_missing(given.measurement)
        own = self.own.update(state.own, FilterInput(received))
        mean, covariance = self.own.mean(own), self.own.covariance(own)
        missed = self.xp.where(is_lacking(received, self.xp), 1.0, state.missed)
        before, missing = state.fault, None
        if isinstance(self.own, HeldInPython):
            before = numpy.where(before > 0.0, before, self.own.told.get("lost", float(self.own.fault)))
            missing = self.own.told.get("missing")
        fault = find_fault(*self._stated(mean, covariance), before, missed, self.xp)
        lost = fault > 0.0
        mean = self._held(lost, state.mean, mean)
        return Checked(own, mean, self._held(lost, state.covariance, covariance), fault, missed, missing)

    def _stated(self, mean: Array, covariance: Array) -> tuple[Array, Array]:
        """Mean and covariance with valid numbers in place of what is never stated."""
        if self.stated is None:
            return mean, covariance
        known, deviations = map(numpy.array, self.stated)
        both = numpy.logical_and.outer(deviations, deviations)[:, :, None]
        apart = numpy.eye(len(known))[:, :, None]
        return numpy.where(known[:, None], mean, 0.0), numpy.where(both, covariance, apart)

    def _held(self, lost: Array, last: Array, answer: Array) -> Array:
        """The last valid answer where the episode is lost."""
        if self.in_python:  # it is a copy, and keeps its layout, by which matrix products round
            answer[..., lost] = last[..., lost]
            return answer
        return self.xp.where(lost, last, answer)

    def feedback(self, state: Checked, measurement: Any) -> Array | None:
        """What a program reports, where that is a number and the episode not lost; else what the estimate says."""
        own = self.own.feedback(state.own, measurement) if isinstance(self.own, HeldInPython) else None
        if own is None:
            return None
        usable = numpy.isfinite(own).all(axis=0) & (state.fault == 0.0)
        return numpy.where(usable, own, self.task.feedback(state.mean, state.covariance, measurement))

    def records(self, state: Checked, measurement: Any) -> dict[str, Array]:
        """How likely the measurement was, and why the episode is lost."""
        told = Likelihood.of_records(self.own.records(state.own, measurement)).fill_unknown(state.fault)
        missing = {} if state.missing is None else {"missing": state.missing}
        return {**told._asdict(), "lost": state.fault, **missing}


def is_lacking(received: Any, xp: Any) -> Array:
    """Return whether something in a measurement is NaN, ``(N,)``."""
    lacking: Any = False
    for _, values in named_arrays(received):
        axes = tuple(range(len(values.shape) - 1))
        here = xp.isnan(values)
        lacking = (xp.any(here, axis=axes) if axes else here) | lacking
    return lacking


def find_fault(mean: Array, covariance: Array, before: Array, missed: Array, xp: Any) -> Array:
    """Return what is wrong with an estimate, or was before.

    Args:
        mean: ``(C, N)``.
        covariance: ``(C, C, N)``.
        before: number of the reason why the episode was lost before, ``(N,)``.
        missed: above zero where not everything was received so far, ``(N,)``.
        xp: array namespace.

    Returns:
        Numbers of :data:`..storage.dataset.FAULTS` from 1 on, zero where nothing is, ``(N,)``.
    """
    finite = xp.all(xp.isfinite(mean), axis=0), xp.all(xp.isfinite(covariance), axis=(0, 1))
    identity = xp.eye(len(mean), dtype=xp.float64)[:, :, None]
    P = xp.where(finite[1], covariance, identity)
    with numpy.errstate(invalid="ignore", divide="ignore", over="ignore"):
        pivots = [row[-1] for row in cholesky(P)]
        # A root of what is negative is NaN, and so is all that follows.
        definite = pivots[-1] > 0.0
        for pivot in pivots[:-1]:
            definite = definite & (pivot > 0.0)
        size = xp.max(xp.abs(P), axis=(0, 1))
        symmetric = xp.max(xp.abs(P - xp.moveaxis(P, 0, 1)), axis=(0, 1)) <= 1e-6 * size
    fault = xp.where(symmetric, 0.0, 4.0)
    fault = xp.where(definite, fault, 3.0)
    fault = xp.where(finite[1], fault, 2.0)
    fault = xp.where(finite[0], fault, 1.0)
    unreceived = (missed > 0.0) & ((fault == 1.0) | (fault == 2.0))
    fault = xp.where(unreceived, AFTER_MISSED, fault)
    return xp.where(before > 0.0, before, fault)


class AroundBank(Filter[Task, Any, State]):
    """A filter in the loop whose estimate is that of a bank; its state, a NamedTuple, has the bank's as ``bank``.

    Attributes:
        bank: what flies the loop.
    """

    bank: Any

    def predict(self, state: Any, measurement: Any) -> Any:
        """Predict in the bank."""
        return state._replace(bank=self.bank.predict(state.bank, measurement))

    def mean(self, state: Any) -> Array:
        """That of the bank."""
        return self.bank.mean(state.bank)

    def covariance(self, state: Any) -> Array:
        """That of the bank."""
        return self.bank.covariance(state.bank)

    def feedback(self, state: Any, measurement: Any) -> Any:
        """That of the bank."""
        return self.bank.feedback(state.bank, measurement)


class LimitState(NamedTuple):
    """State of a bound in the loop."""

    bank: Any
    """Of the bank, which flies the loop."""
    own: Any
    """Of the bound."""


class BoundFilter(AroundBank[LimitState]):
    """A bound in the loop beside a bank under the action zero.

    Args:
        task: the estimation problem.
        own: the bound as a filter.
        bank: what flies the loop.
    """

    def __init__(self, task: Task, own: Filter[Any, Any, Any], bank: Any) -> None:
        super().__init__(task)
        self.own = own
        self.bank = bank
        self.in_python: bool = own.in_python
        self.knows: str = own.knows or "the truth"

    def initialise(self, given: FilterInput) -> LimitState:
        """Start where everyone starts, with the truth."""
        return LimitState(self.bank.start(given.measurement), self.own.initialise(given))

    def start(self, initial: Any) -> LimitState:
        """Start without the truth."""
        return self.initialise(FilterInput(initial))

    def update(self, state: LimitState, given: FilterInput) -> LimitState:
        """Compute the limit at this measurement."""
        own = self.own.update(state.own, given)
        space, N = self.bank.action_space, self.own.mean(own).shape[-1]
        dtype = self.xp.int64 if isinstance(space, gymnasium.spaces.Discrete) else self.xp.float64
        neutral = self.xp.zeros((*(space.shape or ()), N), dtype=dtype)
        return LimitState(self.bank.act(state.bank, given.measurement, neutral), own)

    def records(self, state: LimitState, measurement: Any) -> dict[str, Array]:
        """The limit."""
        return {"mean_square": self.own.mean(state.own)}


def surround(kind: Kind, model: Model, own: Filter[Any, Any, Any]) -> Filter[Any, Any, Any]:
    """Return what runs in a model's loop: a competitor checked, a bound beside the bank, a reference as it is."""
    if kind == "bound":
        return BoundFilter(model.task, own, model.filter)
    return CheckedFilter(model.task, own) if kind in UNTOLD else own


@dataclass(frozen=True)
class _Maker:
    """Makes the filter of a competitor for a model; equal ones are traced once."""

    kind: Kind
    maker: Any
    """Of a competitor that can be traced; None of one that runs in Python."""
    stated: Stated | None = None
    """Of one that runs in Python."""

    def __call__(self, model: Model) -> Filter[Any, Any, Any]:
        """Make it, on any arrays."""
        task = model.task
        own = (
            HeldInPython(task, stated=self.stated)
            if self.maker is None
            else make_competitor(self.maker, task)
        )
        return surround(self.kind, model, as_filter(task, own, self.kind))


def _can_be_traced(maker: Any, own: Filter[Any, Any, Any]) -> bool:
    if own.in_python or not callable(maker):
        return False
    try:
        hash(maker)
    except TypeError:
        return False
    return True


def check_knowledge(name: str, own: Any, kind: Kind, task: Task) -> None:
    """Check that a reference or a bound says of every disturbance of the world that it knows it.

    Args:
        name: of it, in errors.
        own: reference or bound, see :class:`.kinds.Reference`.
        kind: which of them.
        task: whose world it is.

    Raises:
        ValueError: if it does not: a disturbance that is new would make it worse than who is told nothing.
    """
    known = getattr(own, "disturbances", ())
    for part in task.world.disturbances.parts if known is not None else ():
        if part.name not in known:
            raise ValueError(
                f"{kind} {name!r} does not know the disturbance {part.name!r} of {task.id}: add it to the reference's "
                "class attribute disturbances, and use it or ignore it on purpose"
            )


def put_in_loop(
    model: Model, competitor: Any, kind: Kind, name: str, count: int, last: int | None = None
) -> Model:
    """Return a model whose filter is a competitor.

    Args:
        model: task with a bank.
        competitor: estimator, smoother, reference or bound, or a class or function that makes it.
        kind: what it is.
        name: of it, in errors.
        count: number of episodes.
        last: number of their last measurement; None: not known.

    Raises:
        ValueError: if it cannot be made, has not the methods of its kind, or is a reference that knows not all that may
            happen.
    """
    with explain_errors(f"{kind} {name!r} cannot be made"):
        own = make_competitor(competitor, model.task)
    if kind in TOLD_MORE:
        check_knowledge(name, own, kind, model.task)
    if is_program(own):
        own.tracks, own.last = count, last
    own = as_filter(model.task, check_competitor(name, own, kind), kind)
    if _can_be_traced(competitor, own):
        try:
            return model.with_filter(_Maker(kind, compilation_key(competitor)))
        except NotTraceable as error:
            warn_of(f"{name!r} of {model.task.id}", error)
    looped = model.with_filter(_Maker(kind, None, own.stated))
    held = HeldInPython(model.task, own, f"{kind} {name!r}", count if kind in UNTOLD else None)
    looped.filter = surround(kind, model, held)
    return looped
