r"""Equations of a state-space model, and their values on the arrays of a task.

    x(k) = f(x(k-1), dt, u) + w,  w ~ N(0, Q(dt))          z(k) = h(x(k), u) + v,  v ~ N(0, R(x(k), dt, u))

dt is the interval between the measurements k - 1 and k, and u the constant input in it. A model may have neither. A
filter evaluates R at the predicted state. Where u is known only with white noise of covariance N, the predicted
covariance is

    P' = F P F^T + G N G^T + Q,  F = df/dx,  G = df/du          at the estimate before

(Simon, Optimal State Estimation (2006), section 13.2, with the input among the noises). Where h depends on
the input, R becomes ``R + D N D^T`` with ``D = dh/du``. Reading: the correlation of this error with that of the motion,
G N D^T, is left out.
"""

import math
import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import partial
from types import ModuleType
from typing import Any, ClassVar, NamedTuple

import numpy

from ...compiler.vector_functions import VectorFunction
from ...filters.angles import shorten, unwrap
from ...filters.gaussian import log_density
from ...filters.innovation_update import Received, kalman_gain, keep_received
from ...filters.small_matrices import apply, product, transpose
from ...filters.unscented import GAUSSIAN, Spread, limit_spread, sigma_points
from ..contract.observation import Array
from ..contract.task import Task
from .inputs import Input
from .parameters import StateSpaceParameters
from .sensors import Channel


@dataclass(frozen=True, eq=False)
class StateSpaceModel:
    """Equations of a state-space model, such as f, Q, h and R.

    Functions of the motion take the state, then the interval where the model is timed, s, and then the inputs.
    """

    f: VectorFunction
    h: VectorFunction
    Q: numpy.ndarray | VectorFunction
    """Process noise covariance, ``(n, n)``; or a function that returns its n^2 numbers row by row: then the model is
    timed."""
    R: numpy.ndarray | VectorFunction
    """Measurement noise covariance, ``(m, m)``; or a function that returns its m^2 numbers row by row."""
    G: VectorFunction | None = None
    """The function f with the inputs as its first arguments; None where no input has noise."""
    D: VectorFunction | None = None
    """The function h with the inputs as its first arguments; None where no input has noise or h does not depend on
    inputs."""
    sources: Mapping[str, numpy.ndarray | VectorFunction] = field(default_factory=dict)
    """Terms of which Q is the sum, by the names of the noises; empty where the noises have no names."""
    warned: dict[str, str] = field(default_factory=dict)
    """Warnings about values that are not finite, by the functions that gave them."""

    @property
    def timed(self) -> bool:
        """Whether f and Q depend on the interval between measurements."""
        return isinstance(self.Q, VectorFunction)

    def allows_zero_interval(self, mean: numpy.ndarray, inputs: numpy.ndarray) -> bool:
        """Return whether f is the identity and Q zero over no time, judged numerically at a few states.

        Then measurements may be simultaneous.
        """
        if not isinstance(self.Q, VectorFunction):
            return False
        x = mean[:, None] + numpy.linspace(-1.0, 2.0, 3 * len(mean)).reshape(len(mean), 3)
        given = numpy.concatenate([x, numpy.zeros((1, 3)), inputs[:, None] + numpy.zeros((1, 3))])
        with numpy.errstate(all="ignore"):  # some states may be out of the functions' range
            moved = self.f.value(given, numpy)
            return numpy.allclose(moved, x, 1e-12, 1e-12) and not self.Q.value(given, numpy).any()

    @property
    def is_linear(self) -> bool:
        """Whether both f and h are given as matrices."""
        maps = (self.f, self.h)
        return all(one.matrix is not None and not numpy.any(one.offset) for one in maps)


@dataclass(frozen=True, eq=False)
class StateSpaceDefinition:
    """Definition of a task of state-space models: models, initial estimate, cost weights, inputs, sensors."""

    world: tuple[StateSpaceModel, ...]
    """The M models of the world."""
    filters: tuple[StateSpaceModel, ...]
    """The model that the filters use for each model of the world."""
    transition: tuple[tuple[float, ...], ...]
    """Probabilities that one model follows another from a measurement to the next (row = from), ``(M, M)``."""
    switching: bool
    """Whether the world switches between its models; otherwise it uses the first."""
    mean: numpy.ndarray
    """Initial mean, ``(n,)``."""
    covariance: numpy.ndarray
    """Initial covariance, ``(n, n)``."""
    weights: numpy.ndarray
    """Weight of the squared error of each component in the cost, ``(n,)``."""
    measured: Mapping[str, str]
    """Units of the m measured numbers, by their names."""
    inputs: Mapping[str, Input]
    """The p known inputs, by their names."""
    channels: tuple[Channel, ...]
    """Sensors, each of which measures some of the m numbers; one for all of them where they have no names."""

    @property
    def nominal_inputs(self) -> numpy.ndarray:
        """Mean values of the inputs, ``(p,)``."""
        return numpy.array([one.mean for one in self.inputs.values()])

    @property
    def measurement_words(self) -> str:
        """Sentence that lists the numbers of a measurement and the inputs, with units."""
        words = f"Of a measurement, values and available are of {', '.join(self.measured)}, in this order"
        inputs = ", ".join(self.inputs)
        return f"{words}; inputs, which acted since the one before, are {inputs}." if inputs else f"{words}."

    def nominal_process_noise(self, interval: float) -> numpy.ndarray:
        """Return the first filter model's Q over an interval, s, at the initial mean, ``(n, n)``."""
        return process_noise(self.filters[0], self.mean, interval, self.nominal_inputs)


def process_noise(
    model: StateSpaceModel, x: numpy.ndarray, interval: float, inputs: numpy.ndarray
) -> numpy.ndarray:
    """Return the process noise covariance Q of a model, ``(n, n)``.

    ``x`` is a state ``(n,)``, ``interval`` in s, ``inputs`` ``(p,)``.
    """
    if not isinstance(model.Q, VectorFunction):
        return model.Q
    given = numpy.concatenate([x, [interval], inputs])
    with numpy.errstate(all="ignore"):  # the check of the covariance reports values that are not finite
        return numpy.reshape(model.Q.value(given[:, None], numpy), (len(x), len(x)))


def sensor_noise(
    model: StateSpaceModel, x: numpy.ndarray, interval: numpy.ndarray, inputs: numpy.ndarray
) -> numpy.ndarray:
    """Return the measurement noise covariance R of a model at K measurements, ``(m, m, K)``.

    ``x`` is a state ``(n,)``, ``interval`` in s ``(K,)``, ``inputs`` ``(p, K)``.
    """
    m, K = model.h.size, len(interval)
    if not isinstance(model.R, VectorFunction):
        return numpy.broadcast_to(model.R[:, :, None], (m, m, K))
    rows = [numpy.broadcast_to(x[:, None], (len(x), K)), *([interval[None]] * model.timed), inputs]
    return numpy.reshape(model.R.value(numpy.concatenate(rows), numpy), (m, m, K))


def nominal_sensor_noise(
    model: StateSpaceModel, mean: numpy.ndarray, interval: float, inputs: Mapping[str, Input]
) -> numpy.ndarray:
    """Return R of a model at the initial mean, averaged over the distribution of the inputs, ``(m, m)``.

    The average over 2 p sigma points is exact where R is quadratic in the inputs, such as a standard deviation.

    Args:
        model: the equations.
        mean: initial mean, ``(n,)``.
        interval: s.
        inputs: the p inputs.
    """
    p = max(len(inputs), 1)
    centre = numpy.array([one.mean for one in inputs.values()])[:, None]
    offsets = math.sqrt(p) * numpy.diag([one.deviation for one in inputs.values()])
    points = (
        numpy.concatenate([centre + offsets, centre - offsets], axis=1) if inputs else numpy.zeros((0, 1))
    )
    return sensor_noise(model, mean, numpy.full(points.shape[1], interval), points).mean(axis=-1)


class InvalidNoise(NamedTuple):
    """Measurement and sensor whose R is not positive definite, and that R."""

    place: int
    """Index of the measurement."""
    sensor: str
    R: list[list[float]]
    """R of this sensor."""


def find_invalid_noise(
    definition: StateSpaceDefinition, available: numpy.ndarray, interval: numpy.ndarray, inputs: numpy.ndarray
) -> InvalidNoise | None:
    """Return the first of K measurements at which a sensor's R is not positive definite; None if there is none.

    Sensors whose R depends on the state are skipped. ``available``, ``(m, K)``, is above zero where a number was
    received.
    """
    n = len(definition.mean)
    for model in definition.filters:
        if not isinstance(model.R, VectorFunction):
            continue
        R = numpy.moveaxis(sensor_noise(model, definition.mean, interval, inputs), -1, 0)
        of_state = numpy.reshape([min(read, default=n) < n for read in model.R.reads], R.shape[1:])
        for channel in definition.channels:
            own = R[:, channel.places, channel.places]
            if of_state[channel.places, channel.places].any():
                continue
            there = (available[channel.places] > 0.0).any(axis=0)
            finite = numpy.asarray(numpy.isfinite(own).all(axis=(1, 2)))
            least = numpy.linalg.eigvalsh(numpy.where(finite[:, None, None], own, 0.0))[:, 0]
            wrong = there & ~(finite & (least > 0.0))
            if wrong.any():
                place = int(wrong.argmax())
                return InvalidNoise(place, channel.name, own[place].tolist())
    return None


class StateSpaceMeasurement(NamedTuple):
    """Values of all sensors at one time, with the interval, the inputs, and delayed values."""

    values: Array
    """Measured values, ``(m, N)``; arbitrary where nothing was received."""
    available: Array
    """1 where a value was received, 0 where not, ``(m, N)``."""
    interval: Array | None = None
    """Time since the previous measurement, or the start, s, ``(N,)``; None where the model is not timed."""
    inputs: Array | None = None
    """Known inputs that acted in that interval, ``(p, N)``; None where the model has none."""
    late: Array | None = None
    """Values that arrive now with a delay of ``lateness`` measurements, ``(m, N)``, zero where none arrives; None in a
    task without delays."""
    late_available: Array | None = None
    """1 where a delayed value has arrived, 0 where not, ``(m, N)``; None in a task without delays."""


class Passage(NamedTuple):
    """Interval and inputs up to the next measurement."""

    interval: Array | None
    inputs: Array | None


QUARTER = 0.25
"""Share of a turn by which sigma points may move an angle: half of the range in which the nearest turn is unique."""
Passed = StateSpaceMeasurement | Passage
"""Interval and inputs since the previous measurement."""


class StateSpaceProblem(Task):
    """Base class of a task of state-space models, used by equations, world, filters and live input."""

    definition: ClassVar[StateSpaceDefinition]
    parameters: StateSpaceParameters

    def set_up(self) -> None:
        """Create the :class:`Equations` of the filters' models on the task's arrays."""
        own = self.definition
        self.filter_equations: list[Equations] = [Equations(self, model) for model in own.filters]
        count = len(own.filters)
        self.modes: tuple[str, ...] = tuple(f"hypothesis_{j}" for j in range(count)) if count > 1 else ()
        self.transition: Array = self.constant([list(row) for row in own.transition])

    def _sampling_interval(self) -> float | None:
        return None if self.parameters.jitter > 0.0 else self.parameters.sampling_interval


class Equations:
    """Equations of a state-space model on the arrays of a task.

    In the methods x are states, ``(n, N)``, and ``passed`` the interval and inputs until the next measurement.
    """

    def __init__(self, task: StateSpaceProblem, model: StateSpaceModel) -> None:
        self.model = model
        self.xp: ModuleType = task.xp
        self.components: list[str] = [component.name for component in task.components]
        self._R = self._constant(task, model.R)
        self._Q = self._constant(task, model.Q)
        self._sources = {name: self._constant(task, own) for name, own in model.sources.items()}
        self._F, self._H = (
            None if one.matrix is None else task.constant(one.matrix) for one in (model.f, model.h)
        )
        self.channels: tuple[Channel, ...] = task.definition.channels
        self.periods: dict[int, float] = {i: c.period for c in self.channels if c.period for i in c.numbers}
        """Periods of the numbers of a measurement that are angles, by their indices."""
        self.angles: dict[int, float] = task.periods
        self.gated: bool = any(channel.gate for channel in self.channels)
        self._input_variances = [one.noise**2 for one in task.definition.inputs.values()]

    @staticmethod
    def _constant(task: StateSpaceProblem, noise: numpy.ndarray | VectorFunction) -> Array | None:
        return None if isinstance(noise, VectorFunction) else task.constant(noise)

    def move(self, x: Array, passed: Passed) -> Array:
        """Return the state f(x) at the next measurement, without process noise, ``(n, ...)``."""
        return self._value("f", self.model.f, self._with_passed(x, passed))

    def _with_passed(self, x: Array, passed: Passed) -> Array:
        """Return the state with interval and inputs appended as rows, ``(n + 1 + p, ...)``."""
        rows = [] if passed.interval is None else [passed.interval]
        if passed.inputs is not None:
            rows += [passed.inputs[j] for j in range(passed.inputs.shape[0])]
        return self.xp.concat([x, *((0.0 * x[0] + row)[None] for row in rows)]) if rows else x

    def process_noise(self, x: Array, passed: Passed, of_sources: Mapping[str, Any] | None = None) -> Array:
        """Return the process noise covariance Q, ``(n, n, N)``; ``(n, n, 1)`` where it is constant.

        ``of_sources`` are factors on terms of Q by name, a number or ``(N,)`` each.
        """
        if not of_sources:
            return self._noise(self.model.Q, self._Q, x, passed)
        parts = [
            of_sources.get(name, 1.0) * self._noise(own, self._sources[name], x, passed)
            for name, own in self.model.sources.items()
        ]
        return sum(parts[1:], parts[0])

    def _noise(
        self, noise: numpy.ndarray | VectorFunction, constant: Array | None, x: Array, passed: Passed
    ) -> Array:
        if constant is not None:
            return constant[:, :, None]
        assert isinstance(noise, VectorFunction)
        size = math.isqrt(noise.size)
        name = "Q" if noise is not self.model.R else "R"
        entries = self._value(name, noise, self._with_passed(x, passed))
        return self.xp.reshape(entries, (size, size, *x.shape[1:]))

    def input_noise(self, x: Array, passed: Passed) -> Array | float:
        """Return the covariance ``G N G^T`` that noise of the inputs adds to a prediction, ``(n, n, N)``, or 0.0."""
        return self._through(self.model.G, self._with_passed(x, Passage(passed.interval, None)), passed)

    def measured_noise(self, R: Array, x: Array, passed: Passed) -> Array:
        """Return ``R + D N D^T``: R plus the effect of the inputs' noise on the measurement, ``(m, m, N)``."""
        return R if self.model.D is None else R + self._through(self.model.D, x, passed)

    def _through(self, function: VectorFunction | None, given: Array, passed: Passed) -> Array | float:
        if function is None:
            return 0.0
        assert passed.inputs is not None
        inputs = passed.inputs + 0.0 * given[0]
        J = function.jacobian(self.xp.concat([inputs, given]), self.xp)
        scaled = self.xp.stack(
            [J[:, j] * variance for j, variance in enumerate(self._input_variances)], axis=1
        )
        return product(scaled, transpose(J))

    def sensor_noise(
        self, x: Array, passed: Passed, factor: Any = 1.0, of_sensors: Mapping[str, Any] | None = None
    ) -> Array:
        """Return the measurement noise covariance R times factors, ``(m, m, N)`` or ``(m, m, 1)``.

        ``of_sensors`` are further factors for some sensors, by their names.
        """
        R = factor * self._noise(self.model.R, self._R, x, passed)
        if not of_sensors:
            return R
        rows, none = [], 0.0 * sum(of_sensors.values())  # of their shape
        for channel in self.channels:
            own = of_sensors.get(channel.name, 1.0) + none
            rows += [own * R[place] for place in channel.numbers]
        return self.xp.stack(rows)

    def measure(self, x: Array, passed: Passed) -> Array:
        """Return the measurement h(x) without noise, ``(m, ...)``."""
        return self._value("h", self.model.h, self._with_inputs(x, passed))

    def _with_inputs(self, x: Array, passed: Passed) -> Array:
        return self._with_passed(x, Passage(None, passed.inputs)) if self.model.h.given else x

    def subtract(self, z: Array, predicted: Array) -> Array:
        """Return the innovation, measurement minus prediction, ``(m, ...)``; of angles within half a turn."""
        return shorten(z - predicted, self.periods)

    def continuous_measurement(
        self, mean: Array, covariance: Array, passed: Passed
    ) -> tuple[Callable[[Array], Array], Spread]:
        """Return the function h with unwrapped angles, and sigma points of an unscented transform for it.

        An angle follows its slope over any number of turns along states in which it is linear; along the others the
        points are so close that it changes by less than half a turn.
        """
        return self._unfold(
            partial(self.measure, passed=passed),
            (self.model.h, lambda: self.measurement_matrix(mean, passed), self.periods),
            mean,
            covariance,
        )

    def continuous_motion(
        self, mean: Array, covariance: Array, passed: Passed
    ) -> tuple[Callable[[Array], Array], Spread]:
        """Return the function f with angles unwrapped to the mean's turn, and sigma points for it."""
        return self._unfold(
            partial(self.move, passed=passed),
            (self.model.f, lambda: self.transition_matrix(mean, passed), self.angles),
            mean,
            covariance,
        )

    def _unfold(
        self,
        function: Callable[[Array], Array],
        traced: tuple[VectorFunction, Callable[[], Array], Mapping[int, float]],
        mean: Array,
        covariance: Array,
    ) -> tuple[Callable[[Array], Array], Spread]:
        """Return a function with angles unwrapped from the mean to the sigma points, and points close enough.

        Args:
            function: from points ``(n, 2n + 1, N)``.
            traced: the traced function, a function that computes its Jacobian at the mean, the periods of its angles.
            mean: ``(n, N)``.
            covariance: ``(n, n, N)``.
        """
        own, jacobian, periods = traced
        if not periods:
            return function, GAUSSIAN
        J, linear = jacobian(), self.xp.asarray(own.linear.astype(float))[:, :, None]
        slopes = self.xp.where(linear > 0.0, J, 0.0)
        near = function(mean[:, None])

        def continuous(x: Array) -> Array:
            return unwrap(function(x), near + apply(slopes[:, :, None], x - mean[:, None]), periods)

        bent = [row for row in periods if not own.linear[row].all()]
        if not bent:
            return continuous, GAUSSIAN
        turns = self.xp.stack([(J[row] - slopes[row]) / periods[row] for row in bent])
        return continuous, limit_spread(turns, covariance, QUARTER)

    def receive(self, measurement: StateSpaceMeasurement, mean: Array, R: Array) -> Received:
        """Return the innovation, Jacobian H and noise R of the received numbers of a measurement."""
        nu = self.subtract(measurement.values, self.measure(mean, measurement))
        R = self.measured_noise(R, mean, measurement)
        return keep_received(nu, self.measurement_matrix(mean, measurement), R, measurement.available)

    def gain(self, covariance: Array, received: Received) -> Array:
        """Return the Kalman gain ``(n, m, N)`` for a covariance ``(n, n, N)``; zero for sensors outside their gates."""
        if self.gated:
            S = product(product(received.H, covariance), transpose(received.H)) + received.R
            kept = self.within_gates(received.innovation, S)
            received = keep_received(received.innovation, received.H, received.R, received.available * kept)
        return kalman_gain(covariance, received)

    def within_gates(self, nu: Array, S: Array) -> Array:
        """Return 1 for the numbers of sensors whose innovation passes the sensor's gate, else 0, ``(m, N)``."""
        xp, rows = self.xp, []
        for channel in self.channels:
            within = 1.0 + 0.0 * nu[channel.first]
            if channel.gate is not None:
                _, squared = log_density(nu[channel.places], S[channel.places, channel.places])
                within = xp.where(squared <= channel.gate**2, within, 0.0)
            rows += [within] * channel.size
        return xp.stack(rows)

    def _value(self, name: str, function: VectorFunction, x: Array) -> Array:
        values = self._warn(name, function.value, self.xp.reshape(x, (x.shape[0], -1)))
        return self.xp.reshape(values, (function.size, *x.shape[1:]))

    def _warn(self, name: str, compute: Callable[[Array, Any], Array], x: Array) -> Array:
        if self.xp is not numpy:
            return compute(x, self.xp)
        with numpy.errstate(all="ignore"):
            values = compute(x, numpy)
        if numpy.geterr()["invalid"] != "ignore" and name not in self.model.warned:
            sentence = self._describe(name, values, x)
            if sentence:
                self.model.warned[name] = sentence
                warnings.warn(sentence, RuntimeWarning, stacklevel=2)
        return values

    def _describe(self, name: str, values: numpy.ndarray, x: numpy.ndarray) -> str:
        entries = values.reshape(len(values), -1, x.shape[1])
        wrong = numpy.asarray(~numpy.isfinite(entries).all(axis=1) & numpy.isfinite(x).all(axis=0))
        if not wrong.any():
            return ""
        lane = int(wrong.any(axis=0).argmax())
        row = int(wrong[:, lane].argmax())
        if name.endswith("h") and len(self.channels) > 1:
            channel = next(one for one in self.channels if row in one.numbers)
            name = f"{name} of the sensor {channel.name!r}"
        value = next(value for value in entries[row, :, lane].tolist() if not math.isfinite(value))
        state = ", ".join(
            f"{component} = {value:.6g}"
            for component, value in zip(self.components, x[:, lane].tolist(), strict=False)
        )
        return (
            f"{name} gives {value:g} at {state}: keep arguments of logarithms, roots and quotients within "
            "their range, such as by numpy.maximum"
        )

    def explain_loss(
        self, mean: numpy.ndarray, covariance: numpy.ndarray, measurement: StateSpaceMeasurement
    ) -> str:
        """Return a sentence that names the function, f or h, that is not finite near an estimate; else empty."""
        with numpy.errstate(all="ignore"):
            points = sigma_points(mean, covariance)
            given = self._with_passed(points, measurement).reshape(-1, points[0].size)
            moved = self.model.f.value(given, numpy)
            found = self._describe("f", moved, given)
            if found:
                return found
            given = self._with_inputs(moved.reshape(points.shape), measurement).reshape(-1, points[0].size)
            return self._describe("h", self.model.h.value(given, numpy), given)

    def transition_matrix(self, x: Array, passed: Passed) -> Array:
        """Return the Jacobian F of f, ``(n, n, N)``; ``(n, n, 1)`` where it is constant."""
        if self._F is not None:
            return self._F[:, :, None]
        return self._warn("the derivative of f", self.model.f.jacobian, self._with_passed(x, passed))

    def measurement_matrix(self, x: Array, passed: Passed) -> Array:
        """Return the Jacobian H of h, ``(m, n, N)``; ``(m, n, 1)`` where it is constant."""
        if self._H is not None:
            return self._H[:, :, None]
        return self._warn("the derivative of h", self.model.h.jacobian, self._with_inputs(x, passed))

    def predict_moments(self, mean: Array, covariance: Array, passed: Passed) -> tuple[Array, Array]:
        """Return mean and covariance predicted to the next measurement, without process noise."""
        F = self.transition_matrix(mean, passed)
        carried = product(product(F, covariance), transpose(F))
        if self.model.G is not None:
            carried = carried + self.input_noise(mean, passed)
        return self.move(mean, passed), carried
