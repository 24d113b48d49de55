"""Adapters that run an estimator, a reference or a bound as the filter of a model.

:func:`as_filter` makes a filter from a user's estimator. It is compiled like a bank if it is declared
``traceable``, otherwise it runs as Python code between compiled steps of the world.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import gymnasium
import numpy

from ...compiler.namespace import NotTraceable
from ...envs.contract.failures import explain_errors
from ...envs.contract.filter import Filter, FilterInput, Likelihood, ReportedParts, State
from ...envs.contract.model import Model
from ...envs.contract.observation import Array
from ...envs.contract.task import Task, named_arrays
from ...envs.engine.compiled import warn_not_compiled
from ...filters.small_matrices import cholesky
from .adapters import select_lanes
from .kinds import INFORMED_KINDS, Kind, check_competitor, compilation_key, is_program, make_competitor

AFTER_MISSED = 5.0
"""Number among :data:`..storage.dataset.FAULTS` for an estimate that is not finite after a missed measurement."""
TRUTH_FREE_KINDS: tuple[Kind, ...] = ("estimator", "smoother")
"""Kinds of competitors that use only the initial estimate and the measurements."""


class AdaptedState(NamedTuple):
    """State of a user's estimator, reference or bound."""

    mean: Array
    """Mean of the components, ``(C, N)``; for a bound its limit of the mean square error."""
    covariance: Array
    """Covariance of the components, ``(C, C, N)``; None for a bound."""
    memory: Any
    """Memory of the estimator; None where Python code stores it."""
    likelihood: Likelihood
    """Log-likelihood of the last measurement; NaN where the estimator returns none."""


class Adapter(Filter[Task, Any, AdaptedState]):
    """Filter that calls a user's estimator, see :class:`.kinds.Estimator`."""

    def __init__(self, task: Task, estimator: Any) -> None:
        super().__init__(task)
        self.own = estimator
        self.in_python: bool = not getattr(estimator, "traceable", False)
        self.has_likelihood: bool = False
        """Whether the estimator has ever returned a log-likelihood."""

    def start(self, initial: Any) -> AdaptedState:
        """Start the estimator; return the filter's state with the initial estimate."""
        return self.first(initial, self.own.start(initial, initial.mean.shape[-1]))

    def first(self, initial: Any, memory: Any) -> AdaptedState:
        """Return the filter's state before the first measurement, with the estimator's memory."""
        return AdaptedState(initial.mean, initial.covariance, memory, Likelihood.unknown(initial.mean[0]))

    def update(self, state: AdaptedState, inputs: FilterInput) -> AdaptedState:
        """Update the estimator with the measurement; return the filter's state with its estimate."""
        answer = self.call_update(inputs, state.memory)
        if not isinstance(answer, tuple | list) or len(answer) not in (3, 4):
            count = f" of {len(answer)}" if isinstance(answer, tuple | list) else ""
            raise TypeError(
                "update must return mean, covariance and memory, and may return the log-likelihood, not "
                f"{type(answer).__name__}{count}"
            )
        mean, covariance, memory, *reported = answer
        likelihood = state.likelihood
        if reported:
            self.has_likelihood, likelihood = True, Likelihood.of(*reported)
            likelihood = likelihood if self.in_python else likelihood.fill_unknown(mean[0])
        return AdaptedState(mean, covariance, memory, likelihood)

    @property
    def fault(self) -> int:
        """Number among ``FAULTS`` of the reason why a program returned no estimate; 0 without a fault."""
        return getattr(self.own, "fault", 0)

    def call_update(self, inputs: FilterInput, memory: Any) -> Any:
        """Call the estimator's ``update``; return mean, covariance, memory, and optionally the likelihood."""
        return self.own.update(memory, inputs.measurement)

    def smooth(self, measurements: Sequence[Any], states: Sequence[AdaptedState]) -> tuple[Array, Array]:
        """Return a smoother's means ``(C, K, N)`` and covariances ``(C, C, K, N)`` at all K measurements."""
        answer: tuple[Array, Array] = self.own.smooth(measurements, [state.memory for state in states])
        return answer


class ReferenceAdapter(Adapter):
    """Filter that calls a user's reference, with the truth, see :class:`.kinds.Reference`."""

    def __init__(self, task: Task, reference: Any) -> None:
        super().__init__(task, reference)
        self.knows: str = getattr(reference, "knows", "") or "the truth"

    def initialise(self, inputs: FilterInput) -> AdaptedState:
        """Start the reference with the initial estimate and the truth; return the filter's state."""
        return self.first(inputs.measurement, self.own.start(inputs.measurement, inputs.truth))

    def call_update(self, inputs: FilterInput, memory: Any) -> Any:
        """Call the reference's ``update`` with measurement and truth; return its result."""
        return self.own.update(memory, inputs.measurement, inputs.truth)


class BoundAdapter(ReferenceAdapter):
    """Filter that calls a user's bound; its mean is the limit of the mean square error, see :class:`.kinds.Bound`."""

    def first(self, initial: Any, memory: Any) -> AdaptedState:
        """Return the state before the first measurement, with a bound of zero on the mean square error."""
        return AdaptedState(0.0 * initial.mean, None, memory, Likelihood.unknown(initial.mean[0]))

    def call_update(self, inputs: FilterInput, memory: Any) -> Any:
        """Call the bound's ``update``; return its mean square error, None in place of a covariance, and its
        memory.
        """
        limit, memory = super().call_update(inputs, memory)
        return limit, None, memory


def as_filter(task: Task, competitor: Any, kind: Kind = "estimator") -> Filter[Any, Any, Any]:
    """Return a filter that runs a user's estimator, reference or bound; a filter is returned unchanged."""
    if isinstance(competitor, Filter):
        return competitor
    adapters = {"reference": ReferenceAdapter, "bound": BoundAdapter}
    return adapters.get(kind, Adapter)(task, competitor)


class PythonFilter(Filter[Task, Any, AdaptedState]):
    """Wrapper of a filter that runs in Python: it stores that filter's state and checks the shape of its
    estimates.

    Args:
        wrapped: the filter; None while the steps of the world are traced.
        name: kind and name of the competitor, for error messages.
        count: number of episodes; further lanes repeat the last episode. None: all lanes are used as they
            are.
        stated: components that the filter reports, where ``wrapped`` is None.
    """

    in_python = True

    def __init__(
        self,
        task: Task,
        wrapped: Any = None,
        name: str = "",
        count: int | None = None,
        stated: ReportedParts | None = None,
    ) -> None:
        super().__init__(task)
        self.own = wrapped
        self.name = name
        self.count = count
        self.stated: ReportedParts | None = getattr(wrapped, "stated", stated)
        self.memory: Any = None
        self.step_number: int = 0
        self.extra: Mapping[str, Array] = {}
        """Records of the last measurement by name, such as the log-likelihood."""
        self.knows: str = getattr(wrapped, "knows", "")

    @property
    def fault(self) -> int:
        """Number among ``FAULTS`` of the reason why the program returned no estimate; 0 without a fault."""
        return self.own.fault if isinstance(self.own, Adapter) else 0

    def _repeat_last(self, inputs: FilterInput) -> FilterInput:
        """Return the inputs with the last episode repeated in padding lanes, as copies."""
        if self.count is None:
            return inputs
        width = inputs.measurement[0].shape[-1]
        lanes = numpy.minimum(numpy.arange(width), self.count - 1)
        return inputs._replace(measurement=select_lanes(inputs.measurement, lanes))

    def initialise(self, inputs: FilterInput) -> AdaptedState:
        """Start the wrapped filter, with the truth where it may use it; return the first state."""
        with explain_errors(f"{self.name} failed at the start of the track"):
            self.memory = self.own.initialise(self._repeat_last(inputs))
        initial = inputs.measurement
        return AdaptedState(initial.mean, initial.covariance, None, Likelihood.unknown(initial.mean[0]))

    def start(self, initial: Any) -> AdaptedState:
        """Start the wrapped filter without the truth; return the first state."""
        return self.initialise(FilterInput(initial))

    def update(self, state: AdaptedState, inputs: FilterInput) -> AdaptedState:
        """Update the wrapped filter; return the state with its estimate, checked for shape and type."""
        self.step_number += 1
        inputs = self._repeat_last(inputs)
        with explain_errors(f"{self.name} failed at measurement {self.step_number}"):
            self.memory = after = self.own.step(self.memory, inputs)
            mean, covariance = self.own.mean(after), self.own.covariance(after)
            self.extra = self.own.records(after, inputs.measurement)
        C, width = len(self.task.components), inputs.measurement[0].shape[-1]
        # Copies, since the estimator may change its own arrays; in their layout, on which rounding in matrix products
        # depends.
        mean = numpy.copy(self._numbers("mean", mean, (C, width)), order="K")
        if covariance is None:  # of a bound
            covariance = state.covariance
        else:
            covariance = numpy.copy(self._numbers("covariance", covariance, (C, C, width)), order="K")
        known = (
            None if values is None else self._numbers(name, values, (width,))
            for name, values in Likelihood.of_records(self.extra)._asdict().items()
        )
        return AdaptedState(mean, covariance, None, Likelihood(*known).fill_unknown(mean[0]))

    def feedback(self, state: AdaptedState, measurement: Any) -> Array | None:
        """Return the feedback that a program has written for the simulated world; None for other filters."""
        own: Any = self.own.own if isinstance(self.own, Adapter) else None
        return own.feedback if is_program(own) else None

    def _numbers(self, word: str, values: Any, shape: tuple[int, ...]) -> numpy.ndarray:
        """Return mean or covariance (``word``) as float64 array; raise ValueError for another shape or type."""
        where = f"{self.name}: the {word} at measurement {self.step_number}"
        try:
            given = numpy.asanyarray(values)
            # float64 would drop masks, imaginary parts and words.
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
    """State of a :class:`CheckedFilter`: state of the wrapped filter, last valid estimate, and fault."""

    own: Any
    """State of the filter."""
    mean: Array
    """Last valid mean, ``(C, N)``; before the first the initial estimate."""
    covariance: Array
    """Last valid covariance, ``(C, C, N)``."""
    fault: Array
    """Number among ``FAULTS`` of the reason why the episode is lost, from 1 on; 0 where it is not, ``(N,)``."""
    missed: Array
    """One from the first measurement on that was not received in full, before zero, ``(N,)``."""
    missing: Array = None
    """One where the file of estimates has no row at this measurement, ``(N,)``; None for filters that always have an
    estimate.
    """


class CheckedFilter(Filter[Task, Any, Checked]):
    """Wrapper of a competing filter: it masks missing measurements and checks the estimates.

    An episode with an invalid estimate or covariance is lost from that measurement on: the last valid
    estimate, or else the initial one, is repeated to the end. Losing an episode is no advantage.
    """

    def __init__(self, task: Task, wrapped: Filter[Any, Any, Any]) -> None:
        super().__init__(task)
        self.own = wrapped
        self.in_python: bool = wrapped.in_python
        self.stated: ReportedParts | None = wrapped.stated

    def start(self, initial: Any) -> Checked:
        """Return the state of the filter, started with the initial estimate."""
        zero = 0.0 * initial.mean[0]
        missing = None if self.stated is None else zero
        return Checked(self.own.start(initial), initial.mean, initial.covariance, zero, zero, missing)

    def predict(self, state: Checked, measurement: Any) -> Checked:
        """Predict the filter to the time of the measurement; return the state."""
        return state._replace(own=self.own.predict(state.own, self.task.world.mask_missing(measurement)))

    def update(self, state: Checked, inputs: FilterInput) -> Checked:
        """Update the filter with the masked measurement; return the state, with the last valid estimate once it
        is lost.
        """
        received = self.task.world.mask_missing(inputs.measurement)
        own = self.own.update(state.own, FilterInput(received))
        mean, covariance = self.own.mean(own), self.own.covariance(own)
        missed = self.xp.where(is_lacking(received, self.xp), 1.0, state.missed)
        before, missing = state.fault, None
        if isinstance(self.own, PythonFilter):
            before = numpy.where(before > 0.0, before, self.own.extra.get("lost", float(self.own.fault)))
            missing = self.own.extra.get("missing")
        fault = find_fault(*self._stated(mean, covariance), before, missed, self.xp)
        lost = fault > 0.0
        mean = self._repeat_last_valid(lost, state.mean, mean)
        return Checked(
            own, mean, self._repeat_last_valid(lost, state.covariance, covariance), fault, missed, missing
        )

    def _stated(self, mean: Array, covariance: Array) -> tuple[Array, Array]:
        """Fill components that the filter never reports: mean 0, covariance of the identity."""
        if self.stated is None:
            return mean, covariance
        known, deviations = map(numpy.array, self.stated)
        both = numpy.logical_and.outer(deviations, deviations)[:, :, None]
        apart = numpy.eye(len(known))[:, :, None]
        return numpy.where(known[:, None], mean, 0.0), numpy.where(both, covariance, apart)

    def _repeat_last_valid(self, lost: Array, last: Array, estimate: Array) -> Array:
        """Replace an estimate by the last valid one where the episode is lost; in place for filters in
        Python.
        """
        if self.in_python:  # a copy retains its layout, on which rounding in matrix products depends
            estimate[..., lost] = last[..., lost]
            return estimate
        return self.xp.where(lost, last, estimate)

    def feedback(self, state: Checked, measurement: Any) -> Array | None:
        """Return a program's feedback to the world, or that of the estimate where it is invalid; None without a
        program.
        """
        own = self.own.feedback(state.own, measurement) if isinstance(self.own, PythonFilter) else None
        if own is None:
            return None
        usable = numpy.isfinite(own).all(axis=0) & (state.fault == 0.0)
        return numpy.where(usable, own, self.task.feedback(state.mean, state.covariance, measurement))

    def records(self, state: Checked, measurement: Any) -> dict[str, Array]:
        """Return likelihood statistics of the measurement by name, and as ``lost`` the number of the fault."""
        likelihood = Likelihood.of_records(self.own.records(state.own, measurement)).fill_unknown(state.fault)
        missing = {} if state.missing is None else {"missing": state.missing}
        return {**likelihood._asdict(), "lost": state.fault, **missing}


def is_lacking(received: Any, xp: Any) -> Array:
    """Return a boolean mask ``(N,)`` of lanes whose measurement contains NaN."""
    lacking: Any = False
    for _, values in named_arrays(received):
        axes = tuple(range(len(values.shape) - 1))
        here = xp.isnan(values)
        lacking = (xp.any(here, axis=axes) if axes else here) | lacking
    return lacking


def find_fault(mean: Array, covariance: Array, earlier_fault: Array, any_missing: Array, xp: Any) -> Array:
    """Return the number of each estimate's fault, ``(N,)``: not finite, not symmetric or not positive
    definite.

    Args:
        mean: means, ``(C, N)``.
        covariance: covariances, ``(C, C, N)``.
        earlier_fault: number of the reason why the episode was lost earlier, ``(N,)``; or zero.
        any_missing: above zero where a measurement was missing so far, ``(N,)``.
        xp: array namespace.

    Returns:
        Numbers of :data:`..storage.dataset.FAULTS` from 1 on, zero without a fault, ``(N,)``.
    """
    finite = xp.all(xp.isfinite(mean), axis=0), xp.all(xp.isfinite(covariance), axis=(0, 1))
    identity = xp.eye(len(mean), dtype=xp.float64)[:, :, None]
    P = xp.where(finite[1], covariance, identity)
    with numpy.errstate(invalid="ignore", divide="ignore", over="ignore"):
        pivots = [row[-1] for row in cholesky(P)]
        # The root of a negative number is NaN, and so are all results of it.
        definite = pivots[-1] > 0.0
        for pivot in pivots[:-1]:
            definite = definite & (pivot > 0.0)
        size = xp.max(xp.abs(P), axis=(0, 1))
        symmetric = xp.max(xp.abs(P - xp.moveaxis(P, 0, 1)), axis=(0, 1)) <= 1e-6 * size
    fault = xp.where(symmetric, 0.0, 4.0)
    fault = xp.where(definite, fault, 3.0)
    fault = xp.where(finite[1], fault, 2.0)
    fault = xp.where(finite[0], fault, 1.0)
    unreceived = (any_missing > 0.0) & ((fault == 1.0) | (fault == 2.0))
    fault = xp.where(unreceived, AFTER_MISSED, fault)
    return xp.where(earlier_fault > 0.0, earlier_fault, fault)


class AroundBank(Filter[Task, Any, State]):
    """Filter that contains a bank and returns its estimate; its state, a NamedTuple, has the field ``bank``.

    Attributes:
        bank: the bank whose estimate closes the loop.
    """

    bank: Any

    def predict(self, state: Any, measurement: Any) -> Any:
        """Predict the bank to the time of the measurement; return the state."""
        return state._replace(bank=self.bank.predict(state.bank, measurement))

    def mean(self, state: Any) -> Array:
        """Return the mean of the bank, ``(C, N)``."""
        return self.bank.mean(state.bank)

    def covariance(self, state: Any) -> Array:
        """Return the covariance of the bank, ``(C, C, N)``."""
        return self.bank.covariance(state.bank)

    def feedback(self, state: Any, measurement: Any) -> Any:
        """Return the bank's feedback to the simulated world."""
        return self.bank.feedback(state.bank, measurement)


class LimitState(NamedTuple):
    """State of a :class:`BoundFilter`."""

    bank: Any
    """State of the bank, whose estimate closes the loop."""
    own: Any
    """State of the bound."""


class BoundFilter(AroundBank[LimitState]):
    """Filter that computes a bound while a bank with the action zero closes the loop."""

    def __init__(self, task: Task, bound: Filter[Any, Any, Any], bank: Any) -> None:
        super().__init__(task)
        self.own = bound
        self.bank = bank
        self.in_python: bool = bound.in_python
        self.knows: str = bound.knows or "the truth"

    def initialise(self, inputs: FilterInput) -> LimitState:
        """Start the bank, and the bound with the truth; return the state."""
        return LimitState(self.bank.start(inputs.measurement), self.own.initialise(inputs))

    def start(self, initial: Any) -> LimitState:
        """Start bank and bound without the truth; return the state."""
        return self.initialise(FilterInput(initial))

    def update(self, state: LimitState, inputs: FilterInput) -> LimitState:
        """Update the bank with the action zero and the bound with the truth; return the state."""
        own = self.own.update(state.own, inputs)
        space, N = self.bank.action_space, self.own.mean(own).shape[-1]
        dtype = self.xp.int64 if isinstance(space, gymnasium.spaces.Discrete) else self.xp.float64
        neutral = self.xp.zeros((*(space.shape or ()), N), dtype=dtype)
        return LimitState(self.bank.act(state.bank, inputs.measurement, neutral), own)

    def records(self, state: LimitState, measurement: Any) -> dict[str, Array]:
        """Return the bound on the mean square error by component, ``(C, N)``, as ``mean_square``."""
        return {"mean_square": self.own.mean(state.own)}


def wrap_for_loop(
    kind: Kind, model: Model, competitor_filter: Filter[Any, Any, Any]
) -> Filter[Any, Any, Any]:
    """Wrap an estimator's filter with checks, a bound's with a bank that closes the loop; return a reference's
    unchanged.
    """
    if kind == "bound":
        return BoundFilter(model.task, competitor_filter, model.filter)
    return CheckedFilter(model.task, competitor_filter) if kind in TRUTH_FREE_KINDS else competitor_filter


@dataclass(frozen=True)
class _Maker:
    """Function that makes a competitor's filter for a model; hashable, so that equal makers are traced once."""

    kind: Kind
    maker: Any
    """Maker of a competitor that can be traced; None for one that runs in Python."""
    stated: ReportedParts | None = None
    """Components that a competitor in Python reports."""

    def __call__(self, model: Model) -> Filter[Any, Any, Any]:
        task = model.task
        own = (
            PythonFilter(task, stated=self.stated)
            if self.maker is None
            else make_competitor(self.maker, task)
        )
        return wrap_for_loop(self.kind, model, as_filter(task, own, self.kind))


def _can_be_traced(maker: Any, own: Filter[Any, Any, Any]) -> bool:
    if own.in_python or not callable(maker):
        return False
    try:
        hash(maker)
    except TypeError:
        return False
    return True


def check_knowledge(name: str, competitor: Any, kind: Kind, task: Task) -> None:
    """Raise ValueError unless a reference or bound lists every disturbance of the world in ``disturbances``.

    An unknown disturbance could make it worse than estimators.
    """
    known = getattr(competitor, "disturbances", ())
    for part in task.world.disturbances.parts if known is not None else ():
        if part.name not in known:
            raise ValueError(
                f"{kind} {name!r} does not know the disturbance {part.name!r} of {task.id}: add it to the reference's "
                "class attribute disturbances, and use it or ignore it on purpose"
            )


def close_loop(
    model: Model, competitor: Any, kind: Kind, name: str, count: int, last: int | None = None
) -> Model:
    """Return a model whose filter is a competitor: an estimator, smoother, reference or bound.

    Args:
        model: task with a bank.
        competitor: estimator, smoother, reference or bound, or a class or function that makes it.
        kind: kind of the competitor.
        name: its name, for error messages.
        count: number of episodes.
        last: number of the last measurement of the episodes; None: unknown.

    Raises:
        ValueError: if it cannot be made, lacks a method, or is a reference that does not declare every
            disturbance.
    """
    with explain_errors(f"{kind} {name!r} cannot be made"):
        own = make_competitor(competitor, model.task)
    if kind in INFORMED_KINDS:
        check_knowledge(name, own, kind, model.task)
    if is_program(own):
        own.tracks, own.last = count, last
    own = as_filter(model.task, check_competitor(name, own, kind), kind)
    if _can_be_traced(competitor, own):
        try:
            return model.with_filter(_Maker(kind, compilation_key(competitor)))
        except NotTraceable as error:
            warn_not_compiled(f"{name!r} of {model.task.id}", error)
    looped = model.with_filter(_Maker(kind, None, own.stated))
    held = PythonFilter(model.task, own, f"{kind} {name!r}", count if kind in TRUTH_FREE_KINDS else None)
    looped.filter = wrap_for_loop(kind, model, held)
    return looped
