"""Estimators of UavAutopilot: the settled filter, and some that estimate noise in flight.

Each closes the loop around its own truth. Equation numbers are those of ``filters/noise_adaptation.py``, for
the settled filter those of the task's paper.
"""

from typing import Any, ClassVar, NamedTuple

from ...envs.contract.filter import Filter, FilterInput, Initial, Likelihood
from ...envs.contract.observation import Array
from ...envs.uav_autopilot.level_bank import likelihood_of
from ...envs.uav_autopilot.task import UavAutopilot
from ...envs.uav_autopilot.world import Measurement, Start
from ...filters import imm, packed_covariance
from ...filters import noise_adaptation as adaptation
from ...filters.ordered_sums import weighted_sum
from ..measurement_noise import (
    MeasurementNoise,
    Mehra,
    SageHusaMeasurementNoise,
    VariationalBayesMeasurementNoise,
)
from ..table import Variant


class SteadyKalman(Filter[UavAutopilot, Measurement, Initial]):
    """The nominal filter with its steady-state, constant gain; it ignores missing readings."""

    def __init__(self, task: UavAutopilot) -> None:
        super().__init__(task)
        model, steady = task.design.model, task.design.steady
        self.F, self.B, self.gain = (task.constant(part) for part in (model.F, model.B, steady.gain))
        self.settled: Array = task.constant(steady.posterior)[:, :, None]

    def start(self, initial: Start) -> Initial:
        """Return the state at the initial estimate."""
        return Initial(initial.mean, initial.covariance)

    def update(self, state: Initial, inputs: FilterInput) -> Initial:
        """Predict and update by (10) and (11) with the constant gain; return the state."""
        measurement = inputs.measurement
        predicted = self.xp.matmul(self.F, state.mean) + self.B * measurement.control
        innovation = measurement.reading - self.task.readings_of(predicted)
        innovation = self.xp.where(measurement.available > 0.0, innovation, 0.0)
        mean = predicted + self.xp.matmul(self.gain, innovation)
        return Initial(mean, self.settled + 0.0 * measurement.number)


class SensorAware(NamedTuple):
    """State of one filter with its estimate of the sensors' noise."""

    mean: Array
    """Mean of the state, ``(n, N)``."""
    covariance: Array
    """Covariance of the state, packed."""
    noise: tuple[Any, ...]
    """Memory of the estimate of each sensor's noise."""


class Step(NamedTuple):
    """Result of a prediction and the update with one measurement."""

    filter: SensorAware
    log_likelihood: Array
    """Log-likelihood of the readings, ``(N,)``."""
    nis: Array
    """Normalised innovation squared of the readings, ``(N,)``."""
    correction: Array
    """Correction of the mean, ``(n, N)``."""
    carried: Array
    """Packed covariance predicted without the disturbance."""


class AdaptiveState(NamedTuple):
    """State of a filter that estimates noise."""

    mean: Array
    """Mean of the state, ``(n, N)``."""
    covariance: Array
    """Covariance of the state, ``(n, n, N)``."""
    likelihood: Likelihood
    memory: Any
    """Memory of the filter, with the filters of an IMM."""


class AdaptiveKalman(Filter[UavAutopilot, Measurement, AdaptiveState]):
    """Kalman filter (10)-(12) of the paper with the noise of each sensor estimated."""

    def __init__(
        self, task: UavAutopilot, rule: type[MeasurementNoise] = MeasurementNoise, **values: float
    ) -> None:
        super().__init__(task)
        self.sensor_noise: MeasurementNoise = rule(**values)
        model, pack = task.design.model, packed_covariance.pack
        self.F, self.B = task.constant(model.F), task.constant(model.B)
        self.propagator: Array = task.constant(packed_covariance.propagator(model.F))
        self.scaled, self.other = (
            task.constant(pack(Q)[:, None]) for Q in (model.scaled_noise, model.other_noise)
        )
        self.n: int = len(model.F)

    def start_filter(self, initial: Start) -> SensorAware:
        """Return the state of one filter at the initial estimate, with the stated sensor noise."""
        zero = 0.0 * initial.mean[0]
        noise = tuple(self.sensor_noise.start(zero + R) for R in self.task.sensor_variances)
        return SensorAware(initial.mean, packed_covariance.pack(initial.covariance), noise)

    def predict_and_update(
        self, before: SensorAware, measurement: Measurement, factor: Array | float
    ) -> Step:
        """Predict with a factor on the gusts' covariance, then update and estimate the noise sensor by
        sensor.
        """
        predicted = self.xp.matmul(self.F, before.mean) + self.B * measurement.control
        carried = self.xp.matmul(self.propagator, before.covariance) + self.other
        mean, covariance = predicted, carried + factor * self.scaled
        noise, log_likelihood, nis = [], 0.0 * measurement.number, 0.0 * measurement.number
        readings = self.xp.where(measurement.available > 0.0, measurement.reading, 0.0)
        for k, i in enumerate(self.task.measured):
            available = measurement.available[k]
            R, memory = self.sensor_noise.update(
                before.noise[k],
                readings[k] - mean[i],
                covariance[packed_covariance.position(self.n, i, i)],
                self.task.sensor_variances[k] + 0.0 * available,
                available,
            )
            mean, covariance, likelihood, squared = packed_covariance.update_coordinates(
                mean, covariance, readings[k][None], (i,), R[None], available[None]
            )
            noise.append(memory)
            log_likelihood, nis = log_likelihood + likelihood, nis + squared
        return Step(
            SensorAware(mean, covariance, tuple(noise)), log_likelihood, nis, mean - predicted, carried
        )

    def start(self, initial: Start) -> AdaptiveState:
        """Return the state at the initial estimate."""
        unknown = Likelihood.unknown(initial.mean[0])
        return AdaptiveState(initial.mean, initial.covariance, unknown, self.first_memory(initial))

    def first_memory(self, initial: Start) -> Any:
        """Return the memory at the start: one filter at the initial estimate."""
        return self.start_filter(initial)

    def update(self, state: AdaptiveState, inputs: FilterInput) -> AdaptiveState:
        """Predict with gusts as designed and update; return the state."""
        after, log_likelihood, nis, *_ = self.predict_and_update(state.memory, inputs.measurement, 1.0)
        likelihood = likelihood_of(inputs.measurement, log_likelihood, nis, self.xp)
        return AdaptiveState(
            after.mean, packed_covariance.unpack(after.covariance, self.n), likelihood, after
        )


class AdaptiveGusts(AdaptiveKalman):
    """Sensor noise estimated, and the disturbance by equation (3) from the corrections of the last coordinate.

    It is the gust, or the rate of plant P.
    """

    limits: ClassVar[tuple[float, float]] = (1.0 / 16.0, 16.0)
    """Limits of the factor on the disturbance's covariance: the range of ``random``."""

    def __init__(
        self, task: UavAutopilot, rule: type[MeasurementNoise], gust_memory: float, **values: float
    ) -> None:
        super().__init__(task, rule, **values)
        self.gust_memory = gust_memory
        self.forgetting: float = 1.0 - 1.0 / gust_memory
        self.last: int = packed_covariance.position(self.n, self.n - 1, self.n - 1)

    def first_memory(self, initial: Start) -> tuple[SensorAware, adaptation.Level]:
        """Return the memory at the start: the filter, and a factor of one on the gusts' covariance."""
        one = 0.0 * initial.mean[0] + 1.0
        return self.start_filter(initial), adaptation.Level(one, self.gust_memory * one)

    def update(self, state: AdaptiveState, inputs: FilterInput) -> AdaptiveState:
        """Predict and update, then estimate the factor on the gusts' covariance; return the state."""
        (before, level), measurement = state.memory, inputs.measurement
        after, log_likelihood, nis, correction, carried = self.predict_and_update(
            before, measurement, level.value
        )
        last = slice(self.last, self.last + 1)
        sample = adaptation.process_noise_factor(
            correction[-1:], after.covariance[last], carried[last], self.scaled[last]
        )
        level = adaptation.fading_mean(level, sample, self.forgetting)
        level = level._replace(value=self.xp.clip(level.value, *self.limits))
        likelihood = likelihood_of(measurement, log_likelihood, nis, self.xp)
        covariance = packed_covariance.unpack(after.covariance, self.n)
        return AdaptiveState(after.mean, covariance, likelihood, (after, level))


class GustModels(NamedTuple):
    """Filters for several levels of the gusts, and the probabilities of the levels."""

    filters: tuple[SensorAware, ...]
    probabilities: Array
    """Probabilities of the levels, ``(M, N)``."""


class GustInteractingMultipleModel(AdaptiveKalman):
    """IMM over three levels of the gusts, in each the sensors' noise by variational Bayes."""

    def __init__(
        self,
        task: UavAutopilot,
        memory: float = 50.0,
        stay: float = 0.99,
        low: float = 0.5,
        high: float = 2.0,
    ) -> None:
        super().__init__(task, VariationalBayesMeasurementNoise, memory=memory)
        self.levels: tuple[float, float, float] = low, 1.0, high
        change = (1.0 - stay) / 2.0
        self.transition = task.constant([[stay if i == j else change for j in range(3)] for i in range(3)])

    def first_memory(self, initial: Start) -> GustModels:
        """Return the memory at the start: all filters at the initial estimate, with equal probabilities."""
        third = self.xp.stack([0.0 * initial.mean[0] + 1.0 / 3.0] * 3)
        return GustModels((self.start_filter(initial),) * 3, third)

    def update(self, state: AdaptiveState, inputs: FilterInput) -> AdaptiveState:
        """Run one IMM cycle over the gust levels, each with its own sensor noise; return the state."""
        xp, memory, measurement = self.xp, state.memory, inputs.measurement
        prediction = imm.predict_mode_probabilities(self.transition, memory.probabilities)
        mean, covariance = imm.mix(*self.stack_filters(memory.filters), prediction.mixing)
        steps = [
            self.predict_and_update(
                SensorAware(mean[:, j], packed_covariance.pack(covariance[:, :, j]), memory.filters[j].noise),
                measurement,
                level**2,
            )
            for j, level in enumerate(self.levels)
        ]
        likelihoods = xp.stack([step.log_likelihood for step in steps])
        log_predicted = imm.log_probabilities(prediction.probabilities)
        probabilities = imm.mode_posterior(log_predicted, likelihoods)
        after = GustModels(tuple(step.filter for step in steps), probabilities)
        nis = weighted_sum(probabilities, xp.stack([step.nis for step in steps]))
        density = imm.log_mixture_density(log_predicted, likelihoods)
        likelihood = likelihood_of(measurement, density, nis, xp)
        combined = imm.combine(*self.stack_filters(after.filters), probabilities)
        return AdaptiveState(*combined, likelihood, after)

    def stack_filters(self, filters: tuple[SensorAware, ...]) -> tuple[Array, Array]:
        """Stack the filters' means to ``(n, 3, N)`` and their covariances to ``(n, n, 3, N)``."""
        xp = self.xp
        covariances = [packed_covariance.unpack(f.covariance, self.n) for f in filters]
        return xp.stack([f.mean for f in filters], axis=1), xp.stack(covariances, axis=2)


ESTIMATORS: dict[str, Any] = {
    "mehra": Variant(
        AdaptiveKalman,
        "The paper's filter, each sensor's noise by the mean square of its last innovations (Mehra 1972).",
        rule=Mehra,
        window=100.0,
    ),
    "sage-husa": Variant(
        AdaptiveGusts,
        "The paper's filter, noise of sensors and gusts by fading means of the innovations (Sage and Husa 1969).",
        rule=SageHusaMeasurementNoise,
        memory=100.0,
        gust_memory=100.0,
    ),
    "variational-bayes": Variant(
        AdaptiveGusts,
        "The paper's filter, gusts by Sage and Husa, sensors by variational Bayes (Särkkä and Nummenmaa 2009).",
        rule=VariationalBayesMeasurementNoise,
        memory=100.0,
        gust_memory=100.0,
    ),
    "gust-imm": GustInteractingMultipleModel,
    "steady-kalman": SteadyKalman,
}
"""Classes of the estimators by name."""
