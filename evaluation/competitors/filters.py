"""Competitors as filters: what puts an estimator, a reference or a bound in the place of a task's bank.

What says that it is ``traceable`` is compiled like a bank. The rest runs as Python code between compiled steps of the
world, and keeps its memory to itself: it may be anything.
"""

from dataclasses import dataclass
from typing import Any, NamedTuple

import gymnasium
import numpy

from ...compiler.functions import map_arrays
from ...compiler.namespace import NotTraceable
from ...envs.contract.failures import explain_errors
from ...envs.contract.filter import Filter, Input
from ...envs.contract.model import Model
from ...envs.contract.observation import Array
from ...envs.contract.task import Task, named_arrays
from ...envs.engine.compiled import warn_of
from ...filters.small_matrices import cholesky
from ..storage.dataset import FAULTS
from .kinds import Kind, Likelihood, check_competitor, compilation_key, make_competitor

UNTOLD: tuple[Kind, ...] = ("estimator", "smoother")
"""What starts and updates with nothing but the initial estimate and the measurements."""


def select_lanes(part: Any, lanes: numpy.ndarray | int) -> Any:
    """Return nested tuples of arrays with some entries of their last axis, each an array of its own; or with one
    entry, without that axis.
    """
    return map_arrays(lambda values: values[..., lanes], part)


class Estimated(NamedTuple):
    """State of an estimator or a reference in the loop."""

    mean: Array
    """Last valid answer, ``(C, N)``; before any the initial estimate."""
    covariance: Array
    """``(C, C, N)``."""
    memory: Any
    """Its own; None of what runs in Python."""
    likelihood: Likelihood
    """Of the last measurement, NaN where it is not told."""
    fault: Array
    """Number of the reason among ``FAULTS`` why the episode is lost, from 1 on; 0 where it is not, ``(N,)``."""
    missed: Array
    """One where a measurement was not received in full so far, ``(N,)``."""


class ReferenceFilter(Filter[Task, Any, Estimated]):
    """A reference in the loop, see :class:`.kinds.Reference`.

    Args:
        task: the estimation problem.
        own: the reference, made for it; None where it runs in Python, beside traced steps.
        in_python: whether it does.
    """

    def __init__(self, task: Task, own: Any, in_python: bool = False) -> None:
        super().__init__(task)
        self.own, self.in_python = own, in_python  # type: ignore[misc]  # of this filter, not of the class
        self.knows = getattr(own, "knows", "") or "the truth"  # type: ignore[misc]

    def initialise(self, given: Input) -> Estimated:
        """Start where everyone starts, with the truth."""
        return self._start_state(given.measurement, self.own.start(given.measurement, given.truth))

    def start(self, initial: Any) -> Estimated:
        """Start without the truth."""
        return self.initialise(Input(initial))

    def _start_state(self, initial: Any, memory: Any) -> Estimated:
        zero = 0.0 * initial.mean[0]
        nothing = Likelihood(None).fill_unknown(zero)
        return Estimated(initial.mean, initial.covariance, memory, nothing, zero, zero)

    def update(self, state: Estimated, given: Input) -> Estimated:
        """Take its answer as it is."""
        mean, covariance, memory, *reported = self.own.update(given.measurement, given.truth, state.memory)
        likelihood = Likelihood.of(*reported).fill_unknown(mean[0]) if reported else state.likelihood
        return state._replace(mean=mean, covariance=covariance, memory=memory, likelihood=likelihood)

    def records(self, state: Estimated, measurement: Any) -> dict[str, Array]:
        """How likely the measurement was."""
        return state.likelihood._asdict()


class EstimatorFilter(ReferenceFilter):
    """An estimator in the loop, see :class:`.kinds.Estimator`, whose answers are checked.

    An episode in which an answer is not finite, or no covariance, is lost from that measurement on: the last valid
    answer, or else the initial estimate, is held to the end. Any estimator could give that answer itself, so
    that losing an episode is no advantage.
    """

    def __init__(self, task: Task, own: Any, in_python: bool = False) -> None:
        super().__init__(task, own, in_python)
        self.knows = ""  # type: ignore[misc]  # nothing, whatever it says

    def initialise(self, given: Input) -> Estimated:
        """Start where everyone starts."""
        initial = given.measurement
        return self._start_state(initial, self.own.start(initial, initial.mean.shape[-1]))

    def update(self, state: Estimated, given: Input) -> Estimated:
        """Check its answer, and keep the last valid one."""
        received = self.task.world.mask_missing(given.measurement)
        mean, covariance, memory, *reported = self.own.update(received, state.memory)
        missed = self.xp.where(is_lacking(received, self.xp), 1.0, state.missed)
        fault = find_fault(mean, covariance, state.fault, missed, self.xp)
        lost = fault > 0.0
        return Estimated(
            self._held(lost, state.mean, mean),
            self._held(lost, state.covariance, covariance),
            memory,
            Likelihood.of(*reported).fill_unknown(mean[0]) if reported else state.likelihood,
            fault,
            missed,
        )

    def _held(self, lost: Array, last: Array, answer: Array) -> Array:
        """The last valid answer where the episode is lost."""
        if self.in_python:  # it is a copy, and keeps its layout, by which matrix products round
            answer[..., lost] = last[..., lost]
            return answer
        return self.xp.where(lost, last, answer)

    def records(self, state: Estimated, measurement: Any) -> dict[str, Array]:
        """How likely the measurement was, and why the episode is lost."""
        return {**super().records(state, measurement), "lost": state.fault}


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
        Numbers of :data:`.dataset.FAULTS` from 1 on, zero where nothing is, ``(N,)``.
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
    fault = xp.where(unreceived, float(len(FAULTS)), fault)
    return xp.where(before > 0.0, before, fault)


class LimitState(NamedTuple):
    """State of a bound in the loop."""

    bank: Any
    """Of the bank, which flies the loop."""
    mean_square: Array
    """Of the task's components, ``(C, N)``."""
    memory: Any
    """The bound's own; None of what runs in Python."""


class BoundFilter(Filter[Task, Any, LimitState]):
    """A bound in the loop, see :class:`.kinds.Bound`, beside a bank under the action zero.

    Args:
        task: the estimation problem.
        bank: what flies the loop.
        own: the bound, made for it; None where it runs in Python, beside traced steps.
        in_python: whether it does.
    """

    def __init__(self, task: Task, bank: Any, own: Any, in_python: bool = False) -> None:
        super().__init__(task)
        self.own, self.bank, self.in_python = own, bank, in_python  # type: ignore[misc]
        self.knows = getattr(own, "knows", "") or "the truth"  # type: ignore[misc]

    def initialise(self, given: Input) -> LimitState:
        """Start where everyone starts, with the truth."""
        initial = given.measurement
        return LimitState(self.bank.start(initial), 0.0 * initial.mean, self.own.start(initial, given.truth))

    def start(self, initial: Any) -> LimitState:
        """Start without the truth."""
        return self.initialise(Input(initial))

    def predict(self, state: LimitState, measurement: Any) -> LimitState:
        """Predict in the bank."""
        return state._replace(bank=self.bank.predict(state.bank, measurement))

    def update(self, state: LimitState, given: Input) -> LimitState:
        """Compute the limit at this measurement."""
        mean_square, memory = self.own.update(given.measurement, given.truth, state.memory)
        space, N = self.bank.action_space, mean_square.shape[-1]
        dtype = self.xp.int64 if isinstance(space, gymnasium.spaces.Discrete) else self.xp.float64
        neutral = self.xp.zeros((*(space.shape or ()), N), dtype=dtype)
        return LimitState(self.bank.act(state.bank, given.measurement, neutral), mean_square, memory)

    def mean(self, state: LimitState) -> Array:
        """That of the bank."""
        return self.bank.mean(state.bank)

    def covariance(self, state: LimitState) -> Array:
        """That of the bank."""
        return self.bank.covariance(state.bank)

    def feedback(self, state: LimitState, measurement: Any) -> Any:
        """That of the bank."""
        return self.bank.feedback(state.bank, measurement)

    def records(self, state: LimitState, measurement: Any) -> dict[str, Array]:
        """The limit."""
        return {"mean_square": state.mean_square}


def make_filter(kind: Kind, model: Model, own: Any, in_python: bool) -> Filter:
    """Make the filter of a competitor.

    Args:
        kind: estimator, smoother, reference or bound.
        model: in whose loop it is put; a bound flies beside its filter.
        own: the competitor, made for the task; None where it runs in Python, beside traced steps.
        in_python: whether it does.
    """
    if kind == "bound":
        return BoundFilter(model.task, model.filter, own, in_python)
    return (EstimatorFilter if kind in UNTOLD else ReferenceFilter)(model.task, own, in_python)


class _InPython:
    """What competes, asked in Python: its memory stays here, and what it raises is explained.

    Args:
        own: the estimator, reference or bound.
        task: that it is made for.
        name: what it is and its name, in errors.
    """

    def __init__(self, own: Any, task: Task, name: str) -> None:
        self.own, self.task, self.name = own, task, name
        self.memory, self.step = None, 0
        self.knows = getattr(own, "knows", "")

    def start(self, initial: Any, second: Any) -> None:
        """Keep the memory."""
        with explain_errors(f"{self.name} failed at the start of the track"):
            self.memory = self.own.start(initial, second)

    def update(self, *given: Any) -> Any:
        """Answer, with nothing in place of the memory.

        Raises:
            ValueError: if the mean, or what is computed of it, is not of all components: it would be broadcast.
        """
        self.step += 1
        with explain_errors(f"{self.name} failed at measurement {self.step}"):
            answer = list(self.own.update(*given[:-1], self.memory))
        place = min(2, len(answer) - 1)
        self.memory, answer[place] = answer[place], None
        C, width = len(self.task.components), given[0][0].shape[-1]
        for word, values, shape in zip(
            ("mean", "covariance"), answer[:place], ((C, width), (C, C, width)), strict=False
        ):
            self._check_shape(word, values, shape)
        return tuple(answer)

    def _check_shape(self, word: str, array: Any, shape: tuple[int, ...]) -> None:
        if array.shape != shape:
            components = ", ".join(c.name for c in self.task.components)
            raise ValueError(
                f"{self.name}: the {word} at measurement {self.step} must have shape {shape}, "
                f"{len(self.task.components)} components ({components}) of {shape[-1]} episodes, got {array.shape}"
            )


class _CheckedInPython(_InPython):
    """A user's estimator: what it returns is checked, too.

    Args:
        own: the estimator.
        task: that it is made for.
        name: what it is and its name, in errors.
        count: number of episodes; lanes beyond are given the last of them.
    """

    def __init__(self, own: Any, task: Task, name: str, count: int) -> None:
        super().__init__(own, task, name)
        self.count = count

    def _repeat_last(self, part: Any) -> Any:
        width = part[0].shape[-1]
        return select_lanes(part, numpy.minimum(numpy.arange(width), self.count - 1))

    def start(self, initial: Any, second: Any) -> None:
        """Keep the memory; an array of the initial estimate may be changed in place."""
        super().start(self._repeat_last(initial), second)

    def update(self, *given: Any) -> Any:
        """Answer, without the memory."""
        self.step += 1
        width = given[0][0].shape[-1]
        with explain_errors(f"{self.name} failed at measurement {self.step}"):
            answer = self.own.update(self._repeat_last(given[0]), self.memory)
            if not isinstance(answer, tuple | list) or len(answer) not in (3, 4):
                count = f" of {len(answer)}" if isinstance(answer, tuple | list) else ""
                raise TypeError(
                    "update must return mean, covariance and memory, and may return the log-likelihood, not "
                    f"{type(answer).__name__}{count}"
                )
            mean, covariance, self.memory, *reported = answer
            likelihood = [Likelihood.of(*reported)] if reported else []
        C = len(self.task.components)
        # Copies: the estimator may go on in its own arrays. In their layout, by which matrix products round.
        mean = numpy.copy(self._numbers("mean", mean, (C, width)), order="K")
        covariance = numpy.copy(self._numbers("covariance", covariance, (C, C, width)), order="K")
        checked = [
            Likelihood(
                *(v if v is None else self._numbers(n, v, (width,)) for n, v in stated._asdict().items())
            )
            for stated in likelihood
        ]
        return (mean, covariance, None, *checked)

    def _numbers(self, word: str, values: Any, shape: tuple[int, ...]) -> numpy.ndarray:
        """Return what was answered as float64, or raise ValueError if it has another shape."""
        where = f"{self.name}: the {word} at measurement {self.step}"
        try:
            given = numpy.asanyarray(values)
            # What float64 has no room for would vanish in it: masks, imaginary parts, words.
            if isinstance(given, numpy.ma.MaskedArray) or given.dtype.kind not in "fiub":
                masked = "a masked array of " * isinstance(given, numpy.ma.MaskedArray)
                raise TypeError(f"expected an array of real numbers, got {masked}{given.dtype}")
            array = numpy.asarray(given, dtype=numpy.float64)
        except (TypeError, ValueError) as error:
            raise ValueError(f"{where} is no array: {error}") from None
        self._check_shape(word, array, shape)
        return array


@dataclass(frozen=True)
class _Maker:
    """Makes the filter of a competitor for a model; equal ones are traced once."""

    kind: Kind
    maker: Any
    """Of a competitor that can be traced; None of one that runs in Python."""

    def __call__(self, model: Model) -> Filter:
        """Make it, on any arrays."""
        own = None if self.maker is None else make_competitor(self.maker, model.task)
        return make_filter(self.kind, model, own, self.maker is None)


def _can_be_traced(maker: Any, own: Any) -> bool:
    if not (callable(maker) and getattr(own, "traceable", False)):
        return False
    try:
        hash(maker)
    except TypeError:
        return False
    return True


def put_in_loop(model: Model, competitor: Any, kind: Kind, name: str, count: int) -> Model:
    """Return a model whose filter is a competitor.

    Args:
        model: task with a bank.
        competitor: estimator, smoother, reference or bound, or a class or function that makes it.
        kind: what it is.
        name: of it, in errors.
        count: number of episodes.

    Raises:
        ValueError: if it cannot be made, or has not the methods of its kind.
    """
    with explain_errors(f"{kind} {name!r} cannot be made"):
        own = make_competitor(competitor, model.task)
    check_competitor(name, own, kind)
    if _can_be_traced(competitor, own):
        try:
            return model.with_filter(_Maker(kind, compilation_key(competitor)))
        except NotTraceable as error:
            warn_of(f"{name!r} of {model.task.id}", error)
    looped = model.with_filter(_Maker(kind, None))
    shown = f"{kind} {name!r}"
    estimates = kind in UNTOLD
    asked = (
        _CheckedInPython(own, model.task, shown, count) if estimates else _InPython(own, model.task, shown)
    )
    looped.filter = make_filter(kind, model, asked, True)
    return looped
