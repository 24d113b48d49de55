r"""The filter of LooselyCoupledNavigation inside the learned estimator ``kalman-net``, steered by a recurrent network.

The augmented filter of the position with the rate errors beta and eta. At every measurement the network outputs
six numbers a in [-1, 1]:

    noise    the receiver's, the coloured and the white one, scaled by a1, a2, a3 as under control ``noise`` at its
             full range
    gain     K = diag(1, rate_range^a5, rate_range^a6) P' H^T / (H P' H^T + caution^a4 R)
    update   x = x' + K nu,  P = (I - K H) P' (I - K H)^T + K R K^T                                 (Joseph form)

All zero is the augmented filter. Without a fix K is zero. References and reading are in
``maneuvering_target/kalman_net.py``.
"""

import math
from collections.abc import Sequence
from typing import Any

import gymnasium
import numpy

from ...filters import loosely_coupled as ins_gnss
from ..contract.filter import Initial
from ..contract.observation import SIGNED_LOG, Array, Block
from .banks import NOISES, Augmented, NoiseBank
from .world import Measurement

CAUTION = 100.0
"""Largest factor and divisor of the receiver's variance in the gain alone."""
RATE_RANGE = 3.0
"""Largest factor and divisor of the gains of the rate errors."""
GAINS = ("caution", "drift_gain", "coloured_gain")


class KalmanNetBank(NoiseBank):
    """Bank of the learned estimator ``kalman-net``: the action sets noises and gain of an augmented filter."""

    action_space: gymnasium.Space[Any] = gymnasium.spaces.Box(
        -1.0, 1.0, (len(NOISES) + len(GAINS),), numpy.float32
    )
    reach: float = 1.0  # trained through the filter, without exploration

    @property
    def blocks(self) -> Sequence[Block]:
        """Observation blocks of control ``noise``, and the estimated rate errors."""
        p = self.parameters
        unit = 1.0 / math.hypot(p.drift, p.coloured)
        return (
            *super().blocks,
            Block(
                "drift",
                lambda f, _: f.drift * unit,
                "estimated drift over a usual rate error",
                self.axes,
                SIGNED_LOG,
            ),
            Block(
                "coloured",
                lambda f, _: f.coloured * unit,
                "estimated coloured rate error over its deviation",
                self.axes,
                SIGNED_LOG,
            ),
        )

    def last_action(self) -> Block:
        """Return the observation block of the previous action."""
        return Block("last_action", lambda f, _: f.action, "action applied before", (*NOISES, *GAINS))

    def start(self, initial: Initial) -> Augmented:
        """Return the filter's state at the start of the track, with the modelled prior of the rate errors."""
        state = super().start(initial)
        return state._replace(action=self.xp.concat([state.action, state.action]))

    def predict(self, state: Augmented, measurement: Measurement) -> Augmented:
        """Return the state predicted with the noises that the last action set."""
        predicted = super().predict(state._replace(action=state.action[: len(NOISES)]), measurement)
        return predicted._replace(action=state.action)

    def act(self, state: Augmented, measurement: Measurement, action: Array) -> Augmented:
        """Return the state updated with the noises and the gain that the action sets."""
        xp, innovation = self.xp, state.innovations.innovation
        a = xp.clip(action, -1.0, 1.0)
        P = self.predict_covariance(state, a[: len(NOISES)])
        R = self.receiver_variance(measurement, a)
        caution, *rates = a[len(NOISES) :]
        share = measurement.available / (P.position + xp.exp(math.log(CAUTION) * caution) * R)
        by_drift, by_coloured = (share * xp.exp(math.log(RATE_RANGE) * rate) for rate in rates)
        gain = ins_gnss.AugmentedFilterGain(
            share * P.position, by_drift * P.position_drift, by_coloured * P.position_coloured
        )
        return state._replace(
            position=state.position + gain.position * innovation,
            drift=state.drift - gain.drift * innovation,
            coloured=state.coloured - gain.coloured * innovation,
            covariance=ins_gnss.update_augmented_by(P, R, gain),
            action=a,
        )
