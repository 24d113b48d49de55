"""Baselines of a user's state-space model, such as its Kalman filter and the filter with the true model."""

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from types import ModuleType
from typing import Any, NamedTuple

import numpy

from ..envs.contract.filter import EstimateState, Filter, FilterInput, Initial, Likelihood
from ..envs.contract.model import Model
from ..envs.contract.observation import Array
from ..envs.linear.equations import Equations
from ..envs.linear.state_space import StateSpace, StateSpaceMeasurement, StateSpaceTruth
from ..envs.linear.state_space_banks import Mixture, MultipleModelBank
from ..evaluation.competitors.kinds import ConstantPolicy, Policy, RandomPolicy
from ..filters import kalman, scans, smoothing, unscented
from ..filters.array_namespace import map_nested, namespace, select_nested
from ..filters.innovation_update import unscented_update, update_with_gain
from ..filters.ordered_sums import ordered_sum
from .table import Baselines, tunable

NOISE = "_noise"
"""Suffix of the parameter that is a factor on R of a sensor, or on a source of Q."""
UNCERTAIN = 1e-9
"""Share of Q that is added to the initial covariance for sigma points, which must be positive definite."""


class StateSpaceKalman(ConstantPolicy):
    """The Kalman filter of the user's model, extended where the model is not linear."""

    control = "noise"
    action: tuple[float, ...] = (0.0, 0.0)


class CovarianceMatching(Policy):
    """Policy that raises the process noise while the NIS is above its mean, and lowers it while it is below."""

    control = "noise"
    traceable = True
    step: float = 0.02

    def __init__(self, model: Model) -> None:
        super().__init__(model)
        self.nis, self.last, self.available = (model.reader(n) for n in ("nis", "last_action", "available"))

    def act(self, observation: numpy.ndarray, state: Any, start: numpy.ndarray) -> tuple[numpy.ndarray, Any]:
        """Return the last action, its process noise a step larger or smaller as the NIS is above or below its
        mean.
        """
        degrees = numpy.sum(self.available(observation), axis=1)
        excess = numpy.minimum(self.nis(observation)[:, 0], 5.0 * degrees) - degrees
        process = numpy.clip(self.last(observation)[:, 0] + self.step * excess, -1.0, 1.0)
        return numpy.stack([process, 0.0 * process], axis=1), None


class StateSpaceInteractingMultipleModel(ConstantPolicy):
    """The interacting multiple model of the user's hypotheses, without added evidence."""

    control = "evidence"

    def __init__(self, model: Model) -> None:
        super().__init__(model)
        self.action: tuple[float, ...] = (0.0,) * len(model.task.modes)


def _likelihood(result: kalman.Update, available: Array, xp: Any) -> Likelihood:
    degrees = ordered_sum(available)
    there = degrees > 0.0
    return Likelihood(
        xp.where(there, result.log_likelihood, math.nan),
        xp.where(there, result.squared_distance, math.nan),
        degrees,
    )


def _zero_missing(measurement: StateSpaceMeasurement, xp: Any) -> Array:
    """Return a measurement's values ``(m, N)``, with zero for missing ones."""
    return xp.where(measurement.available > 0.0, measurement.values, 0.0)


class Past(NamedTuple):
    """A measurement in a filter's buffer, for which late values may still arrive."""

    measurement: StateSpaceMeasurement
    truth: Any
    """Truth at this measurement, for a reference; None for other filters."""
    happened: Array
    """Whether this entry is a measurement, not an empty one before the start, ``(N,)``."""


class Buffered(NamedTuple):
    """State of a filter with its last measurements, which are processed again when a late value arrives."""

    now: Any
    """State of the filter after all received measurements."""
    settled: Any
    """State before the oldest measurement in the buffer."""
    past: tuple[Past, ...]
    """Measurements since, the oldest first, as many as the largest lateness."""

    @property
    def mean(self) -> Array:
        """Mean after all received measurements, ``(n, N)``."""
        mean: Array = self.now.mean
        return mean

    @property
    def covariance(self) -> Array:
        """Covariance of the error of :attr:`mean`, ``(n, n, N)``."""
        covariance: Array = self.now.covariance
        return covariance

    @property
    def likelihood(self) -> Likelihood:
        """Likelihood of the last measurement, predicted from all measurements received before."""
        likelihood: Likelihood = self.now.likelihood
        return likelihood


def _buffer(task: StateSpace, begun: Any, truth: Any = None) -> Any:
    """Return a filter's initial state, with an empty buffer where measurements may arrive late."""
    if not task.parameters.late:
        return begun
    own, none = task.definition, 0.0 * begun.mean[0]
    zeros = lambda rows: task.xp.stack([none] * rows)  # noqa: E731
    m = own.filters[0].h.size
    empty = StateSpaceMeasurement(
        zeros(m),
        zeros(m),
        none + task.parameters.sampling_interval if own.filters[0].timed else None,
        zeros(len(own.inputs)) if own.inputs else None,
    )
    past = Past(empty, truth, none > 0.0)
    return Buffered(begun, begun, (past,) * task.parameters.lateness)


def _in_order(
    state: Any, measurement: StateSpaceMeasurement, step: Callable[..., Any], truth: Any = None
) -> Any:
    """Return the state after a measurement; late values that arrive with it are processed in their place."""
    if not isinstance(state, Buffered):
        return step(state, Past(measurement, truth, None))
    xp = namespace(measurement.available)
    (oldest, *others), late = state.past, measurement.late_available
    assert late is not None
    first = oldest.measurement
    both = xp.where(late > 0.0, measurement.late, _zero_missing(first, xp)), xp.maximum(first.available, late)
    oldest = oldest._replace(measurement=first._replace(values=both[0], available=both[1]))
    alone = measurement._replace(late=None, late_available=None)
    past = (*others, Past(alone, truth, late[0] >= 0.0))
    settled = select_nested(oldest.happened, step(state.settled, oldest), state.settled)
    now = settled
    for one in past[:-1]:
        now = select_nested(one.happened, step(now, one), now)
    return Buffered(step(now, past[-1]), settled, past)


class Extended(Filter[StateSpace, StateSpaceMeasurement, EstimateState]):
    """The Kalman filter of the user's model, extended where it is not linear, as an estimator.

    Args:
        process_noise: factor on Q.
        measurement_noise: factor on R.
        **noises: factors on some sources of Q, and on R of some sensors, by their names with ``_noise``.
    """

    def __init__(
        self, task: StateSpace, process_noise: Any = 1.0, measurement_noise: Any = 1.0, **noises: Any
    ) -> None:
        super().__init__(task)
        self.equations: Equations = task.filter_equations[0]
        self.factor = process_noise
        self.of_sources, of_sensors = _split(task, noises)
        self.sensor_factors: tuple[Any, dict[str, Any]] = measurement_noise, of_sensors

    def process_noise(self, mean: Array, measurement: StateSpaceMeasurement) -> Array:
        """Return Q at a predicted mean ``(n, N)``, times its factors, ``(n, n, N)`` or ``(n, n, 1)``."""
        return self.factor * self.equations.process_noise(mean, measurement, self.of_sources)

    def sensor_noise(self, mean: Array, measurement: StateSpaceMeasurement) -> Array:
        """Return R at a predicted mean ``(n, N)``, times its factors, ``(m, m, N)`` or ``(m, m, 1)``."""
        return self.equations.sensor_noise(mean, measurement, *self.sensor_factors)

    def start(self, initial: Initial) -> Any:
        """Return the state at the initial estimate."""
        begun = EstimateState(initial.mean, initial.covariance, Likelihood.unknown(initial.mean[0]))
        return _buffer(self.task, begun)

    def update(self, state: Any, inputs: FilterInput) -> Any:
        """Predict to a measurement and update with it; return the state."""
        return _in_order(state, inputs.measurement, self.take)

    def take(self, state: EstimateState, one: Past) -> EstimateState:
        """Return the state predicted to a measurement and updated with it."""
        measurement = one.measurement
        mean, carried = self.equations.predict_moments(state.mean, state.covariance, measurement)
        Q = self.process_noise(mean, measurement)
        R = self.sensor_noise(mean, measurement)
        result = _update(self.equations, mean, carried + Q, R, measurement, self.xp)
        return EstimateState(
            result.mean, result.covariance, _likelihood(result, measurement.available, self.xp)
        )


def _update(
    equations: Equations, mean: Array, P: Array, R: Array, measurement: StateSpaceMeasurement, xp: Any
) -> kalman.Update:
    received = equations.receive(measurement._replace(values=_zero_missing(measurement, xp)), mean, R)
    return update_with_gain(mean, P, received, equations.gain(P, received))


class ExtendedSmoother(Extended):
    """The Kalman filter of the user's model, smoothed with all later measurements (Rauch, Tung and Striebel 1965).

    Args:
        process_noise: factor on Q.
        measurement_noise: factor on R.
        lag: number of later measurements that each estimate uses; default: all of them.
        **noises: factors on sources of Q and on R of sensors, as of :class:`Extended`.
    """

    kind = "smoother"

    def __init__(
        self,
        task: StateSpace,
        process_noise: Any = 1.0,
        measurement_noise: Any = 1.0,
        lag: int | None = None,
        **noises: Any,
    ) -> None:
        super().__init__(task, process_noise, measurement_noise, **noises)
        self.lag = lag

    def smooth(
        self, measurements: Sequence[StateSpaceMeasurement], states: Sequence[Any]
    ) -> tuple[Array, Array]:
        """Return means and covariances of a track, smoothed with all later measurements or those within the
        lag.
        """
        measured, memories = scans.stack_scans(measurements), scans.stack_scans(states)
        if isinstance(memories, Buffered):
            measured = _put_in_order(measured, self.task.parameters.lateness, self.xp)
            memories = self._filter_in_order(memories.settled, measured)
        filtered = smoothing.Gaussian(memories.mean, memories.covariance)
        motion = scans.by_stretches(self._motion, filtered.mean, measured)
        smoothed = smoothing.smooth(filtered, motion, self.lag)
        return smoothed.mean[:, 1:], smoothed.covariance[:, :, 1:]

    def _filter_in_order(self, settled: EstimateState, measured: StateSpaceMeasurement) -> EstimateState:
        """Filter a track again with late values in their places; return the estimates at start and
        measurements.
        """
        K = measured.available.shape[-2]
        known = max(K - self.task.parameters.lateness, 0)
        found = [scans.take_scans(settled, slice(K - known, K + 1))]
        for k in range(known, K):
            state, measurement = (
                map_nested(lambda values, place=place: values[..., place, :], part)
                for part, place in ((found[-1], -1), (measured, k))
            )
            found.append(scans.stack_scans([self.take(state, Past(measurement, None, None))]))
        return scans.join(found)

    def _motion(self, mean: Array, measurement: StateSpaceMeasurement) -> smoothing.Motion:
        equations, each = self.equations, 0.0 * mean[0]
        predicted = equations.move(mean, measurement)
        noise = equations.input_noise(mean, measurement) + self.process_noise(predicted, measurement)
        return smoothing.Motion(
            equations.transition_matrix(mean, measurement) + each, noise + each, predicted
        )


def _put_in_order(measured: StateSpaceMeasurement, lateness: int, xp: Any) -> StateSpaceMeasurement:
    """Move late values to the measurements ``(..., K, N)`` to which they belong."""
    plain = measured._replace(values=_zero_missing(measured, xp), late=None, late_available=None)
    assert measured.late is not None
    assert measured.late_available is not None
    late, late_available = (values[:, lateness:] for values in (measured.late, measured.late_available))
    own, rest = (
        scans.take_scans(plain, some) for some in (slice(0, late.shape[1]), slice(late.shape[1], None))
    )
    own = own._replace(
        values=xp.where(late_available > 0.0, late, own.values),
        available=xp.maximum(own.available, late_available),
    )
    return scans.join([own, rest])


class Unscented(Extended):
    """The unscented Kalman filter; arguments as of :class:`Extended`.

    A measured angle may have any spread. Where the posterior is not Gaussian, as after one bearing of an uncertain
    position, the covariance stays definite and the mean NEES is at most twice the number of states.
    """

    def __init__(
        self, task: StateSpace, process_noise: Any = 1.0, measurement_noise: Any = 1.0, **noises: Any
    ) -> None:
        super().__init__(task, process_noise, measurement_noise, **noises)
        usual = task.definition.nominal_process_noise(task.parameters.sampling_interval)
        self.uncertain: Array = UNCERTAIN * (process_noise * task.constant(usual)[:, :, None])

    def start(self, initial: Initial) -> Any:
        """Return the state at the initial estimate, its covariance made positive definite."""
        return super().start(initial._replace(covariance=initial.covariance + self.uncertain))

    def take(self, state: EstimateState, one: Past) -> EstimateState:
        """Return the state predicted to a measurement and updated with it by sigma points."""
        measurement = one.measurement
        own = self.equations
        motion, points = own.continuous_motion(state.mean, state.covariance, measurement)
        mean, spread = unscented.transform(state.mean, state.covariance, motion, points)
        P = spread + own.input_noise(state.mean, measurement) + self.process_noise(mean, measurement)
        h, points = own.continuous_measurement(mean, P, measurement)
        result = unscented_update(
            mean,
            P,
            _zero_missing(measurement, self.xp),
            h,
            own.measured_noise(self.sensor_noise(mean, measurement), mean, measurement),
            measurement.available,
            own.within_gates if own.gated else None,
            points,
            own.subtract,
        )
        return EstimateState(
            result.mean, result.covariance, _likelihood(result, measurement.available, self.xp)
        )


class InteractingKalman(Filter[StateSpace, StateSpaceMeasurement, Any]):
    """The interacting multiple model as an estimator; arguments as of :class:`Extended`."""

    def __init__(
        self, task: StateSpace, process_noise: Any = 1.0, measurement_noise: Any = 1.0, **noises: Any
    ) -> None:
        super().__init__(task)
        factors = process_noise, measurement_noise
        self.bank: MultipleModelBank = MultipleModelBank(task, "evidence", *factors, *_split(task, noises))

    def start(self, initial: Initial) -> Any:
        """Return the state at the initial estimate."""
        return _buffer(self.task, self.bank.start(initial))

    def update(self, state: Any, inputs: FilterInput) -> Any:
        """Predict the bank to a measurement and update it without an action; return the state."""
        return _in_order(state, inputs.measurement, self.take)

    def take(self, state: Mixture, one: Past) -> Mixture:
        """Return the state predicted to a measurement and updated with it."""
        measurement = one.measurement._replace(values=_zero_missing(one.measurement, self.xp))
        predicted = self.bank.predict(state, measurement)
        return self.bank.act(predicted, measurement, 0.0 * predicted.action)

    def records(self, state: Any, measurement: StateSpaceMeasurement) -> dict[str, Array]:
        """Return the log-likelihood of the last measurement, by name."""
        own = state.now if isinstance(state, Buffered) else state
        return {"log_likelihood": self.bank.records(own, measurement)["log_likelihood"]}


class KnownModel:
    """The (extended) Kalman filter with the true functions, Q and R of this episode, and the true hypothesis."""

    kind = "reference"
    traceable = True
    knows = "the true model at every measurement, with its Q and R"

    def __init__(self, task: StateSpace) -> None:
        self.task = task
        self.xp: ModuleType = task.xp

    def start(self, initial: Initial, truth: StateSpaceTruth) -> Any:
        """Return the state at the initial estimate."""
        begun = EstimateState(initial.mean, initial.covariance, Likelihood.unknown(initial.mean[0]))
        return _buffer(self.task, begun, self._model_truth(truth))

    def update(
        self, memory: Any, measurement: StateSpaceMeasurement, truth: StateSpaceTruth
    ) -> tuple[Array, Array, Any, Likelihood]:
        """Predict and update with the true model; return mean, covariance, memory and likelihood."""
        after = _in_order(memory, measurement, self.take, self._model_truth(truth))
        return after.mean, after.covariance, after, after.likelihood

    @staticmethod
    def _model_truth(truth: StateSpaceTruth) -> StateSpaceTruth:
        return truth._replace(state=None, inputs=None, sensors=None, waiting=None)

    def take(self, state: EstimateState, one: Past) -> EstimateState:
        """Predict to a measurement by the true model and update with it; return the state."""
        (measurement, truth, _), xp, chosen = one, self.xp, None
        world: Any = self.task.world
        for j, equations in enumerate(world.equations if world.is_switching else world.equations[:1]):
            mean, carried = equations.predict_moments(state.mean, state.covariance, measurement)
            P = carried + truth.process_noise * equations.process_noise(mean, measurement)
            R = equations.sensor_noise(mean, measurement, truth.measurement_noise)
            result = _update(equations, mean, P, R, measurement, xp)
            held = truth.hypothesis == float(j)
            chosen = (
                result
                if chosen is None
                else kalman.Update(*(xp.where(held, a, b) for a, b in zip(result, chosen, strict=True)))
            )
        assert chosen is not None
        return EstimateState(chosen.mean, chosen.covariance, _likelihood(chosen, measurement.available, xp))


def _split(task: StateSpace, noises: Mapping[str, Any]) -> tuple[dict[str, Any], dict[str, Any]]:
    """Split noise factors by name into those of sources of Q and those of sensors."""
    named = {name.removesuffix(NOISE): factor for name, factor in noises.items()}
    sources = task.definition.filters[0].sources
    known = [*sources, *(channel.name for channel in task.definition.channels)]
    unknown = [name for name in named if name not in known]
    if unknown:
        raise ValueError(f"noises are of {', '.join(known)}, got {unknown[0]!r}")
    of_sources = {name: factor for name, factor in named.items() if name in sources}
    return of_sources, {name: factor for name, factor in named.items() if name not in sources}


def _scales(task: type[StateSpace]) -> dict[str, tuple[float, float, float]]:
    """Return lowest, untuned and highest value of each tunable noise factor, by name."""

    def names(of: Iterable[str], else_all: str) -> list[str]:
        several = [name + NOISE for name in of]
        return several if len(several) > 1 else [else_all]

    process = names(task.definition.filters[0].sources, "process_noise")
    sensors = names([channel.name for channel in task.definition.channels], "measurement_noise")
    return {
        **{f"log10_{name}": (-4.0, 0.0, 4.0) for name in process},
        **{f"log10_{name}": (-2.0, 0.0, 2.0) for name in sensors},
    }


def state_space_baselines(task: type[StateSpace]) -> Baselines:
    """Return the baselines of a task class made from a user's state-space model: policies, estimators, a smoother."""
    several = len(task.definition.filters) > 1
    linear = all(model.is_linear for model in task.definition.filters)
    policies: dict[str, Any] = {
        "kalman": StateSpaceKalman,
        "covariance-matching": CovarianceMatching,
        "random": RandomPolicy,
    }
    estimators: dict[str, Any] = {"extended": Extended}
    if not linear:
        estimators["unscented"] = Unscented
    if several:
        policies = {"imm": StateSpaceInteractingMultipleModel, **policies}
        estimators["kalman-imm"] = InteractingKalman
    paper = next(iter(policies))
    families = {name: tunable(make, **_scales(task)) for name, make in estimators.items()}
    return Baselines(
        environment=task.id,
        policies=policies,
        estimators=estimators,
        smoothers={"kalman-smoother": ExtendedSmoother},
        references={"known-model": KnownModel},
        score_paper=paper,
        score_reference="known-model",
        physical=("rmse", task.components[0].name),
        tunable=families,
        log_families=lambda recording: families,  # their factors may be arrays: candidates run side by side
        benchmark=(*policies, *estimators, "known-model"),
    )
