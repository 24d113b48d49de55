r"""The filter of TightlyCoupledNavigation inside the learned estimator ``kalman-net``, which a recurrent network
steers.

One extended Kalman filter with Singer's model of the manoeuvre, in place of the paper's three hypotheses on the
motion. At every measurement the network outputs numbers in [-1, 1]:

    noise    the groups of sensors, accelerometers that repeat themselves, and outliers of ranges and rates, as under
             control ``robust`` at its full range
    motion   until the next measurement the acceleration's noise is manoeuvre_range^(2 a) times that of Singer's model
    gain     of a reading with variance r, g = caution^(2 b) in its group of sensors:
             k = P h^T / (h P h^T + g r),  P -= k u^T + u k^T,  u = P h^T - k (h P h^T + r) / 2         (Joseph form)

All zero is the policy ``singer``, the paper's third hypothesis alone, except for the state that steers the tracking
loops where there are apertures: for ``singer`` it is predicted by all three hypotheses, here by this filter.
References and reading are in ``maneuvering_target/kalman_net.py``.
"""

import math
from collections.abc import Sequence
from typing import Any

import numpy

from ...filters import gnss_ins
from ...filters.packed_covariance import diagonal, pack, unpack
from ..contract.filter import Initial
from ..contract.observation import STORED_AS_LOG, Array, Block
from .banks import Filters, Prediction, RobustBank
from .parameters import HYPOTHESES, SINGER
from .problem import NavigationProblem
from .world import Measurement

MANOEUVRE_RANGE = 30.0
"""Largest factor and divisor of the deviation of the acceleration."""
CAUTION = 2.0
"""Largest factor and divisor of the deviation of a reading in the gain alone. Much larger ones can make a filter
unstable."""
DROPPED = ("log_likelihood", "log_predicted")
"""Names of the observation blocks that compare hypotheses, which one filter has not."""


class KalmanNetBank(RobustBank):
    """Bank of the learned estimator ``kalman-net``: the action sets noises, gain and motion of a Kalman filter."""

    hypotheses: Sequence[str] = HYPOTHESES[SINGER:]
    reach: float = 1.0  # it learns through the filter, and does not explore

    def __init__(self, task: NavigationProblem, control: str) -> None:
        super().__init__(task, control)
        only = slice(SINGER, SINGER + 1)
        model = task.models[SINGER]
        still = model._replace(noise=0.0 * model.noise)
        common = gnss_ins.process_noise(still, task.common)
        moving = gnss_ins.process_noise(model, task.common) - common
        self.manoeuvre: int = list(self.actions).index("manoeuvre")
        self.axis: Array = task.axis[:, :, only]
        self.common_noise, self.manoeuvre_noise = (
            task.constant(Q)[:, :, None, None] for Q in (common, moving)
        )

    @property
    def actions(self) -> Sequence[str]:
        """Names of the action's components: those of ``robust``, the manoeuvre, and sensor noise in the gain alone."""
        groups = [sensor.name for sensor in self.task.sensors]
        return [*super().actions, "manoeuvre", *(f"caution_{name}" for name in groups)]

    @property
    def blocks(self) -> Sequence[Block]:
        """Observation blocks of the paper's filters, and the standard deviations of this filter."""
        xp, p = self.xp, self.parameters
        parts = {
            "position": (gnss_ins.POSITION, p.position_unit),
            "velocity": (gnss_ins.VELOCITY, p.velocity_unit),
        }
        places = numpy.array(diagonal(gnss_ins.SIZE))

        def spread(f: Filters, _: Measurement) -> Array:
            sums = [
                sum(f.covariances[int(place), 0] for place in places[part]) * (1.0 / unit**2)
                for part, unit in parts.values()
            ]
            return 0.5 * xp.log(xp.stack(sums))

        *shown, last = (block for block in super().blocks if block.name not in DROPPED)
        sure = Block(
            "spread", spread, "predicted deviation over the unit of the cost", tuple(parts), STORED_AS_LOG
        )
        return (*shown, sure, last)

    def start(self, initial: Initial) -> Filters:
        """Return the filter's state at the start of the track, from the initial estimate."""
        state = super().start(initial)
        certain = state.log_likelihood
        return state._replace(log_predicted=certain, probabilities=1.0 + certain)

    def _predict_hypotheses(self, state: Filters) -> Prediction:
        common = self.task.common
        factor = self.xp.exp(2.0 * math.log(MANOEUVRE_RANGE) * state.action[self.manoeuvre])
        noise = self.common_noise + factor * self.manoeuvre_noise
        covariances = unpack(state.covariances, gnss_ins.SIZE)
        mean, covariance = gnss_ins.predict(
            state.means, covariances, self.axis, common.T, common.decay, noise
        )
        return Prediction(mean, pack(covariance), state.probabilities)

    def feedback(self, state: Filters, measurement: Any) -> Array | None:
        """Return None: the tracking loops are steered by the estimate, see :meth:`.Task.feedback`."""
        return None

    def act(self, state: Filters, measurement: Measurement, action: Array) -> Filters:
        """Return the state updated with the noises and the gain that the action sets."""
        xp = self.xp
        exponent = xp.astype(xp.clip(action, -1.0, 1.0), state.mean.dtype)
        caution = xp.exp(2.0 * math.log(CAUTION) * exponent[self.manoeuvre + 1 :])
        update = self._update_hypotheses(
            state.means,
            state.covariances,
            measurement,
            self._variance(exponent, state),
            self._thresholds(exponent[: self.manoeuvre]),
            [
                caution[i]
                for i, sensor in enumerate(self.task.sensors)
                for _ in range(sensor.readings.start, sensor.readings.stop)
            ],
        )
        state = state._replace(
            means=update.mean, covariances=pack(update.covariance), log_likelihood=update.log_likelihood
        )
        return self._combine(state, state.probabilities, exponent)

    def covariance(self, state: Filters) -> Array:
        """Return the covariance of the single filter, ``(17, 17, N)``."""
        return unpack(state.covariances[:, 0], gnss_ins.SIZE)

    def records(self, state: Filters, measurement: Measurement) -> dict[str, Array]:
        """Return the records of the paper's bank, without probabilities, by name."""
        records = super().records(state, measurement)
        del records["mode_probability"]
        return records
