"""Policies, estimators and a reference of the attitude problem."""

from typing import Any, ClassVar

import numpy
from filtergym.baselines.table import Baselines, tunable
from filtergym.envs.contract.model import Model
from filtergym.envs.contract.observation import Array
from filtergym.evaluation.competitors.kinds import ConstantPolicy, Policy, RandomPolicy

from . import gradient_filters, quaternions, vqf
from .metrics import METRICS
from .task import Attitude
from .world import GRAVITY, Measurement, Start, Truth


class Madgwick(ConstantPolicy):
    """Madgwick's filter with one beta, by default the published one."""

    control = "gain"

    def __init__(self, model: Model, log10_factor: float = 0.0) -> None:
        super().__init__(model)
        self.action = (_within(log10_factor / self.task.parameters.gain_decades),)


class Mahony(ConstantPolicy):
    """Mahony's filter with constant gains, by default the published ones."""

    control = "gains"

    def __init__(
        self,
        model: Model,
        log10_accelerometer: float = 0.0,
        log10_magnetometer: float = 0.0,
        integral: float = 0.0,
    ) -> None:
        super().__init__(model)
        p = self.task.parameters
        self.action = (
            _within(log10_accelerometer / p.gain_decades),
            _within(log10_magnetometer / p.gain_decades),
            _within(integral / p.integral_gain) if p.integral_gain else 0.0,
        )


class VQF(ConstantPolicy):
    """VQF with constant time constants, by default the published ones."""

    control = "time_constants"

    def __init__(
        self, model: Model, log10_accelerometer: float = 0.0, log10_magnetometer: float = 0.0
    ) -> None:
        super().__init__(model)
        decades = self.task.parameters.gain_decades
        self.action = (_within(log10_accelerometer / decades), _within(log10_magnetometer / decades))


class GatedMadgwick(Policy):
    """Madgwick's filter whose beta falls to its least while the specific force is far from gravity.

    The factor is one up to a tenth of gravity and falls linearly to none at two tenths, of the root mean square here.

    Source: R. G. Valenti, I. Dryanovski, J. Xiao, Sensors 15 (2015), 19302-19330, section 4.2.
    """

    control = "gain"
    traceable = True

    def __init__(self, model: Model) -> None:
        super().__init__(model)
        self.excess = model.reader("excess_rms")

    def act(self, observation: numpy.ndarray, state: Any, start: numpy.ndarray) -> tuple[numpy.ndarray, Any]:
        """Choose the gain by the specific force."""
        relative = self.excess(observation) / GRAVITY
        factor = numpy.clip(2.0 - 10.0 * relative, 10.0**-self.task.parameters.gain_decades, 1.0)
        return numpy.log10(factor) / self.task.parameters.gain_decades, None


def _within(action: float) -> float:
    return min(max(action, -1.0), 1.0)


class BasicVQF:
    """VQF without bias estimation and without rejection of disturbed fields."""

    kind: ClassVar[str] = "estimator"
    traceable = True

    def __init__(self, task: Attitude) -> None:
        self.task = task

    def start(self, initial: Start, N: int) -> vqf.VQF:
        """Start where everyone starts."""
        return vqf.start_vqf(initial.quaternion, bias=False, rejection=False, settled=True)

    def update(self, measurement: Measurement, memory: vqf.VQF) -> tuple[Array, Array, vqf.VQF]:
        """One step."""
        memory = vqf.vqf_step(memory, *measurement, self.task.parameters.sampling_interval)
        attitude = vqf.vqf_attitude(memory)
        return quaternions.direction_cosines(attitude), self.task.stated_covariance(attitude[0]), memory


class Undisturbed:
    """Mahony's filter that is told accelerations, disturbances of the field and biases, and takes them away.

    White noise alone is left, which is weak: the gain begins with that of a mean and ends at a low one.
    """

    kind = "reference"
    traceable = True
    knows = "accelerations, disturbances of the field and the constant errors of the sensors"
    gain = 0.2
    """1/s: about white error of the gyroscope over that of the accelerometer's direction."""

    def __init__(self, task: Attitude) -> None:
        self.task = task

    def start(self, initial: Start, truth: Truth) -> Array:
        """Start where everyone starts."""
        return initial.quaternion

    def update(self, measurement: Measurement, truth: Truth, memory: Array) -> tuple[Array, Array, Array]:
        """One step with corrected measurements."""
        task, T = self.task, self.task.parameters.sampling_interval
        world: Any = task.world
        cosines = quaternions.direction_cosines(truth.attitude)
        rate = (measurement.rate - truth.gyroscope_bias) / (1.0 + truth.gyroscope_scale)
        force = (
            measurement.force
            - truth.accelerometer_bias
            - quaternions.to_sensor(cosines, world.acceleration(truth))
        )
        field = measurement.field - truth.magnet - quaternions.to_sensor(cosines, world.disturbance(truth))
        gain = task.xp.clip(1.0 / (T * truth.number), self.gain, 20.0)
        attitude, _ = gradient_filters.mahony_step(
            memory, 0.0 * rate, rate, force, field, (gain, gain, 0.0), T
        )
        return quaternions.direction_cosines(attitude), task.stated_covariance(attitude[0]), attitude


BASELINES = Baselines(
    environment=Attitude.id,
    policies={
        "madgwick": Madgwick,
        "madgwick-gated": GatedMadgwick,
        "mahony": Mahony,
        "vqf": VQF,
        "random": RandomPolicy,
    },
    estimators={"vqf-basic": BasicVQF},
    references={"undisturbed": Undisturbed},
    score_paper="madgwick",
    score_reference="undisturbed",
    tunable={
        "madgwick": tunable(Madgwick, log10_factor=(-1.5, 0.0, 1.0)),
        "mahony": tunable(
            Mahony,
            log10_accelerometer=(-1.5, 0.0, 1.0),
            log10_magnetometer=(-1.5, 0.0, 1.0),
            integral=(0.0, 0.0, 0.02),
        ),
        "vqf": tunable(VQF, log10_accelerometer=(-1.0, 0.0, 1.0), log10_magnetometer=(-1.0, 0.0, 1.0)),
    },
    best_constant="madgwick",
    physical=("angle_rmse", "total"),
    metrics=METRICS,
)
