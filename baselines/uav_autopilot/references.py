"""Reference estimators and the bound of UavAutopilot.

Equation numbers are those of the task's paper (Gridnev, Rusetski, Rak).
"""

from ...envs.filter import Initial
from ...envs.observation import Array
from ...envs.uav_autopilot.plant import Model
from ...envs.uav_autopilot.task import UavAutopilot
from ...envs.uav_autopilot.world import Measurement, Start, Truth
from ...evaluation.competitors import Likelihood
from ...filters import packed_covariance
from .estimators import likelihood_of


class TrueState:
    """The autopilot gets the state itself: no estimator feeds this loop better."""

    kind = "reference"
    traceable = True
    knows = "the whole state"

    def __init__(self, task: UavAutopilot) -> None:
        self.task = task

    def start(self, initial: Start, truth: Truth) -> Array:
        """Covariance of the start, which is reported for ever: the error is zero, and that has no density."""
        return initial.covariance

    def update(self, measurement: Measurement, truth: Truth, memory: Array) -> tuple[Array, Array, Array]:
        """Put the truth in place of the estimate."""
        return truth.state, memory, memory


class _KnownNoise:
    """The covariance (12) of a plant with the noise as it is now.

    Args:
        task: whose noise it is.
        model: the plant that is believed.
    """

    kind = "reference"
    traceable = True
    knows: str

    def __init__(self, task: UavAutopilot, model: Model) -> None:
        self.task, self.xp = task, task.xp
        self.F, self.B = task.constant(model.F), task.constant(model.B)
        self.propagator = task.constant(packed_covariance.propagator(model.F))
        self.scaled = task.constant(packed_covariance.pack(model.scaled_noise)[:, None])
        self.other = task.constant(packed_covariance.pack(model.other_noise)[:, None])
        self.variances = task.constant(task.sensor_variances)[:, None]

    def start_covariance(self, initial: Start, truth: Truth) -> Array:
        """Packed covariance of the start: the gust starts at the level of the first part."""
        covariance = packed_covariance.pack(initial.covariance)
        if self.task.parameters.plant != "U":
            return covariance
        return self.xp.concat([covariance[:-1], covariance[-1:] * truth.level**2])

    def predict_covariance(self, covariance: Array, truth: Truth) -> Array:
        """Packed covariance predicted with the disturbance of the interval before this measurement."""
        return self.xp.matmul(self.propagator, covariance) + (truth.level**2 * self.scaled + self.other)

    def sensor_variances(self, truth: Truth) -> Array:
        """Variance of each sensor at this measurement, ``(m, N)``."""
        return self.variances * truth.sensor_level**2


class Matched(_KnownNoise):
    """The Kalman filter with the noise as it is now: its Q and R follow every change at once.

    It is not told of a slower actuator.
    """

    kind = "reference"
    knows = "the present level of the disturbance and of each sensor's noise"

    def __init__(self, task: UavAutopilot) -> None:
        super().__init__(task, task.design.model)

    def start(self, initial: Start, truth: Truth) -> Initial:
        """Start where everyone starts, with the true covariance, packed."""
        return Initial(initial.mean, self.start_covariance(initial, truth))

    def predict(self, measurement: Measurement, truth: Truth, memory: Initial) -> Initial:
        """Equations (10), (12) with the disturbance as it is; the covariance is packed."""
        mean = self.xp.matmul(self.F, memory.mean) + self.B * measurement.control
        return Initial(mean, self.predict_covariance(memory.covariance, truth))

    def update(
        self, measurement: Measurement, truth: Truth, memory: Initial
    ) -> tuple[Array, Array, Initial, Likelihood]:
        """Equations (12), (11) with the noise of this measurement."""
        updated = packed_covariance.update_coordinates(
            *self.predict(measurement, truth, memory),
            measurement.reading,
            self.task.measured,
            self.sensor_variances(truth),
            measurement.available,
        )
        covariance = packed_covariance.unpack(updated.covariance, len(self.task.components))
        likelihood = likelihood_of(measurement, updated.log_likelihood, updated.squared_distance, self.xp)
        return updated.mean, covariance, Initial(updated.mean, updated.covariance), likelihood


class KnownNoiseBound(_KnownNoise):
    """Covariance of the best estimate for an estimator that is told plant and noise: the Riccati recursion.

    Linear and Gaussian with a known control, so it is the posterior Cramer-Rao bound, it is attained, and it
    does not depend on the control: the filters of all policies face the same bound.
    """

    kind = "bound"
    knows = "the level of every noise and the true actuator"

    def __init__(self, task: UavAutopilot) -> None:
        super().__init__(task, task.design.true_model)

    def start(self, initial: Start, truth: Truth) -> Array:
        """Covariance of the state's own distribution at the start, packed."""
        return self.start_covariance(initial, truth)

    def update(self, measurement: Measurement, truth: Truth, memory: Array) -> tuple[Array, Array]:
        """Bound after this measurement."""
        after = packed_covariance.update_coordinates(
            self.xp.zeros_like(truth.state),
            self.predict_covariance(memory, truth),
            measurement.reading,
            self.task.measured,
            self.sensor_variances(truth),
            measurement.available,
        ).covariance
        return after[packed_covariance.diagonal(len(self.task.components))], after
