"""Reference estimators and the bound of UavAutopilot.

Equation numbers are those of the task's paper (Gridnev, Rusetski, Rak).
"""

from types import ModuleType

import numpy

from ...envs.contract.filter import Initial, Likelihood
from ...envs.contract.observation import Array
from ...envs.uav_autopilot.level_bank import likelihood_of
from ...envs.uav_autopilot.task import UavAutopilot
from ...envs.uav_autopilot.world import Measurement, Start, Truth
from ...filters import packed_covariance


class TrueState:
    """Reference whose estimate is the true state: no estimator is better for this loop."""

    kind = "reference"
    traceable = True
    knows = "the whole state"
    disturbances = None

    def __init__(self, task: UavAutopilot) -> None:
        self.task = task

    def start(self, initial: Start, truth: Truth) -> Array:
        """Return the initial covariance, which is reported at all times."""
        return initial.covariance

    def update(self, memory: Array, measurement: Measurement, truth: Truth) -> tuple[Array, Array, Array]:
        """Return the true state as mean, the covariance, and the memory."""
        return truth.state, memory, memory


class _KnownNoise:
    """Base of reference and bound: covariance (12) with the present noise and the sensors' coloured errors.

    A coloured error is a further coordinate of the state, which its sensor reads together with its own; its decay and
    its noise are known (A. E. Bryson and L. J. Henrikson, "Estimation using sampled data containing sequentially
    correlated noise", Journal of Spacecraft and Rockets 5 (1968), 662-665, by augmentation).
    """

    kind = "reference"
    traceable = True
    knows: str
    disturbances: tuple[str, ...] = ("noisy_sensors", "coloured", "bias", "dropouts")

    def __init__(self, task: UavAutopilot) -> None:
        self.task = task
        self.xp: ModuleType = task.xp
        model, n, m = task.design.true_model, len(task.components), len(task.sensors)
        errors = m if task.parameters.sensor_coloured[1] else 0
        pack, size = packed_covariance.pack, n + errors
        self.rows = [(i, n + k) if errors else (i,) for k, i in enumerate(task.measured)]
        """Coordinates whose sum each sensor measures."""

        def enlarge(matrix: numpy.ndarray) -> numpy.ndarray:
            return numpy.pad(matrix, (0, errors))

        rest = enlarge(numpy.zeros((n, n))) + numpy.diag([0.0] * n + [1.0] * errors)
        self.F = task.constant(enlarge(model.F) + rest)
        self.B = task.constant(numpy.concatenate([model.B, numpy.zeros((errors, 1))]))
        self.propagator: Array = task.constant(packed_covariance.propagator(enlarge(model.F) + rest))
        self.scaled: Array = task.constant(pack(enlarge(model.scaled_noise))[:, None])
        self.other: Array = task.constant(pack(enlarge(model.other_noise))[:, None])
        self.variances: Array = task.constant(task.sensor_variances)[:, None]
        self.diagonal: list[int] = packed_covariance.diagonal(size)
        placed = numpy.zeros((size * (size + 1) // 2, errors))
        placed[self.diagonal[n:], range(errors)] = 1.0
        self.placed: Array = task.constant(placed)
        """Places of the coloured errors' variances in the packed triangle."""
        self.initial_covariance: Array = task.constant(
            pack(enlarge(numpy.diag(numpy.square(task.parameters.value("initial_sigmas")))))[:, None]
        )
        gust = numpy.zeros((len(placed), 1))
        gust[self.diagonal[n - 1]] = float(task.parameters.plant == "U")
        self.gust: Array = task.constant(gust)
        self.n: int = n
        self.size: int = size

    def start_covariance(self, truth: Truth) -> Array:
        """Return the packed initial covariance, with the true levels of the gust and of the coloured errors."""
        covariance = self.initial_covariance * (1.0 + self.gust * (truth.level**2 - 1.0))
        if self.size == self.n:
            return covariance
        process = truth.disturbances["coloured"].process
        stationary = process.kick**2 / (1.0 - process.decay**2)
        return covariance + self.xp.matmul(self.placed, stationary)

    def decays(self, truth: Truth) -> Array:
        """Return the factor on each coordinate in a step beside F, ``(size, N)``: decay of gust and coloured errors."""
        return self.xp.concat([self.xp.ones_like(truth.state), truth.disturbances["coloured"].process.decay])

    def predict_covariance(self, covariance: Array, truth: Truth) -> Array:
        """Predict the packed covariance to this measurement with the true disturbance."""
        predicted = self.xp.matmul(self.propagator, covariance)
        noise = truth.level**2 * self.scaled + self.other
        if self.size > self.n:
            decays = self.decays(truth)
            predicted = packed_covariance.pack(decays[:, None] * decays[None]) * predicted
            noise = noise + self.xp.matmul(self.placed, truth.disturbances["coloured"].process.kick ** 2)
        return predicted + noise

    def update_covariance(
        self, mean: Array, covariance: Array, measurement: Measurement, truth: Truth
    ) -> packed_covariance.PackedUpdate:
        """Update with the readings less their constant errors, by the true sensor noise."""
        return packed_covariance.update_coordinates(
            mean,
            covariance,
            measurement.reading - truth.disturbances["bias"],
            self.rows,
            self.sensor_variances(truth),
            measurement.available,
        )

    def sensor_variances(self, truth: Truth) -> Array:
        return self.variances * truth.sensor_level**2


class Matched(_KnownNoise):
    """The Kalman filter of the true plant and noise: the posterior mean given the draw of the episode.

    Its regulator is that of all competitors, designed for the nominal actuator.
    """

    kind = "reference"
    knows = (
        "the level of the disturbance and of each sensor's noise, the sensors' constant and coloured errors, "
        "and the true actuator"
    )

    def start(self, initial: Start, truth: Truth) -> Initial:
        """Return the state at the initial estimate, with the true covariance, packed."""
        mean = self.xp.concat([initial.mean, 0.0 * truth.disturbances["bias"]])[: self.size]
        return Initial(mean, self.start_covariance(truth))

    def predict(self, measurement: Measurement, truth: Truth, memory: Initial) -> Initial:
        """Predict by (10) and (12) with the true disturbance; return the state with packed covariance."""
        mean = self.xp.matmul(self.F, memory.mean) + self.B * measurement.control
        if self.size > self.n:
            mean = self.decays(truth) * mean
        return Initial(mean, self.predict_covariance(memory.covariance, truth))

    def update(
        self, memory: Initial, measurement: Measurement, truth: Truth
    ) -> tuple[Array, Array, Initial, Likelihood]:
        """Update by (12), (11) with the true sensor noise; return mean, covariance, memory and likelihood."""
        n = self.n
        updated = self.update_covariance(*self.predict(measurement, truth, memory), measurement, truth)
        covariance = packed_covariance.unpack(updated.covariance, self.size)[:n, :n]
        likelihood = likelihood_of(measurement, updated.log_likelihood, updated.squared_distance, self.xp)
        return updated.mean[:n], covariance, Initial(updated.mean, updated.covariance), likelihood


class KnownNoiseBound(_KnownNoise):
    """Covariance of the best estimator that knows plant and noise: the Riccati recursion.

    The problem is linear and Gaussian with a known control, so this posterior Cramer-Rao bound is attained,
    and the same for all policies.
    """

    kind = "bound"
    knows: str = Matched.knows

    def start(self, initial: Start, truth: Truth) -> Array:
        """Return the true covariance at the start, packed, as memory."""
        return self.start_covariance(truth)

    def update(self, memory: Array, measurement: Measurement, truth: Truth) -> tuple[Array, Array]:
        """Return the bound on the variances after this measurement, and the memory."""
        zero = self.xp.zeros_like(self.xp.concat([truth.state, truth.disturbances["bias"]])[: self.size])
        predicted = self.predict_covariance(memory, truth)
        after = self.update_covariance(zero, predicted, measurement, truth).covariance
        return after[self.diagonal[: self.n]], after
