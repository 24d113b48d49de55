r"""The learned estimator ``kalman-net`` of UavAutopilot: a recurrent network sets noises and gain of the filter.

This is the Kalman filter of the paper with two covariances: P of its errors, and M, from which the gain is computed.
At every measurement the network returns numbers in [-1, 1]: a_l for each part l of the process noise (the part that
the level of the disturbance multiplies, and the rest), a_i for each sensor i, then b_l and b_i like them:

    noise    Q_l = 10^(process_decades a_l) Q_l,  R_i = 10^(2 sensor_decades a_i) R_i,  P' = F P F^T + sum_l Q_l
    gain     M' = F M F^T + sum_l agility^(2 b_l) Q_l,  K = M' H^T (H M' H^T + diag(caution^(2 b_i) R_i))^-1,
             M = (I - K H) M'
    update   x = x' + K nu,  P = (I - K H) P' (I - K H)^T + K R K^T                                 (Joseph form)

All zero is the paper's filter: M is P. The column of K of a sensor in a dropout is zero. The autopilot uses x. M
follows the Riccati equation of noises between limits, so that the filter is stable for any output; with P in place of
M it is not. References and reading are in ``maneuvering_target/kalman_net.py``.
"""

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import gymnasium
import numpy

from ...filters import packed_covariance
from ..contract.observation import SIGNED_LOG, Array, Block, last_action_block
from .banks import NoiseBank
from .problem import AutopilotProblem
from .world import Measurement, Start

AGILITY = 5.0
"""Largest factor and divisor of the disturbances' deviations in the gain alone."""
CAUTION = 5.0
"""Largest factor and divisor of the sensors' deviations in the gain alone."""


class NetFilter(NamedTuple):
    """State of the bank: the fields of :class:`~.banks.KalmanState` and the covariance of the gain."""

    mean: Array
    covariance: Array
    estimate: Array
    estimate_covariance: Array
    scale: Array
    """Factors on the parts of the process noise in the last update, ``(L, N)``."""
    action: Array
    innovation: Array
    nis: Array
    log_likelihood: Array
    mean_innovation: Array
    mean_square: Array
    mean_nis: Array
    gain_covariance: Array
    """M as a packed triangle, after an update."""


class KalmanNetBank(NoiseBank):
    """Bank of the learned estimator ``kalman-net``: the action sets noises and gain of the paper's filter."""

    def __init__(self, task: AutopilotProblem, control: str) -> None:
        super().__init__(task, control)
        model, sensors = task.design.model, task.sensors
        parts = {"disturbance": model.scaled_noise, "other": model.other_noise}
        parts = {name: Q for name, Q in parts.items() if Q.any()}
        self.noise_parts = [task.constant(packed_covariance.pack(Q)[:, None]) for Q in parts.values()]
        self.action_names: tuple[str, ...] = (
            *parts,
            *sensors,
            *(f"agility_{name}" for name in parts),
            *(f"caution_{s}" for s in sensors),
        )
        self.no_action: tuple[float, ...] = (0.0,) * len(self.action_names)

    @property
    def blocks(self) -> Sequence[Block]:
        """Observation blocks of the bank, without a dropout's repeated reading, which estimators do not get."""
        reading = Block(
            "reading",
            lambda _, measurement: measurement.available * measurement.reading / self.sensor_sigmas,
            "the reading over its sigma; 0 in a dropout",
            self.task.sensors,
            SIGNED_LOG,
        )
        return [reading if block.name == reading.name else block for block in super().blocks]

    @property
    def action_space(self) -> gymnasium.Space[Any]:
        """Gymnasium box: factors on parts of the process noise and on each sensor's, then the same for the gain."""
        return gymnasium.spaces.Box(-1.0, 1.0, (len(self.action_names),), numpy.float32)

    @property
    def action_block(self) -> Block:
        """Observation block of the last output of the network."""
        return last_action_block(self.action_names, name="action")

    def scaled_noise(self, scale: Array, entries: list[int] | slice) -> Array:
        """Return the process noise with its parts times factors ``(L, N)``, at packed entries, ``(entries, N)``."""
        total = scale[0] * self.noise_parts[0][entries]
        for factor, part in zip(scale[1:], self.noise_parts[1:], strict=True):
            total = total + factor * part[entries]
        return total

    def start(self, initial: Start) -> Any:
        """Return the filter of the paper at the initial estimate, as a :class:`NetFilter`."""
        fields = super().start(initial)._asdict()
        fields["scale"] = self.xp.stack([fields["scale"]] * len(self.noise_parts))
        return NetFilter(**fields, gain_covariance=fields["covariance"])

    def act(self, state: Any, measurement: Measurement, action: Array) -> Any:
        """Return the state updated with the noises and the gain that the action sets."""
        xp, p, parts = self.xp, self.parameters, len(self.noise_parts)
        count = parts + len(self.task.sensors)
        a = xp.clip(xp.astype(action, xp.float64), -1.0, 1.0)
        scale = xp.exp(p.process_decades * math.log(10.0) * a[:parts])
        R = self.nominal_variances * xp.exp(2.0 * p.sensor_decades * math.log(10.0) * a[parts:count])
        agile = scale * xp.exp(2.0 * math.log(AGILITY) * a[count : count + parts])
        cautious = R * xp.exp(2.0 * math.log(CAUTION) * a[count + parts :])
        every, carried = slice(None), xp.matmul(self.propagator, state.gain_covariance)
        update = packed_covariance.update_coordinates_with_gain(
            state.mean,
            state.covariance + self.scaled_noise(scale, every),
            measurement.reading,
            self.task.measured,
            R,
            measurement.available,
            packed_covariance.GainModel(carried + self.scaled_noise(agile, every), cautious),
        )
        return state._replace(
            mean=update.mean,
            covariance=update.covariance,
            estimate=update.mean,
            estimate_covariance=update.covariance,
            scale=scale,
            action=a,
            gain_covariance=update.gain_covariance,
        )
