"""Reference estimators and the bound of ManeuveringTarget."""

from typing import NamedTuple

from ...envs.contract.faults import GaussMarkov
from ...envs.contract.filter import FilterInput, Initial, Likelihood
from ...envs.contract.observation import Array
from ...envs.maneuvering_target.constant_velocity import ConstantVelocityModel, KalmanModel
from ...envs.maneuvering_target.world import Measurement, RadarWorld, Truth
from ...filters import bounds, kalman
from ...filters.small_matrices import apply

DISTURBANCES = ("glint", "coloured", "bias", "clutter")
"""Disturbances that the reference knows. The bound ignores them: each adds errors, except false plots, which it never
uses.
"""


class TurnMemory(NamedTuple):
    """State of :class:`KnownTurn`: its estimate, and the truth at the last scan."""

    mean: Array
    covariance: Array
    likelihood: Likelihood
    truth: Truth
    """Truth at the last scan."""


class KnownTurn(KalmanModel):
    """The Kalman filter that knows the manoeuvres of the episode: the optimal one, given these.

    It knows begin, end and acceleration or turn rate of each; then the flight has no random disturbance. With
    x the state, z the given state of the target and F the transition that turns a deviation of the velocity
    as the target turns (:meth:`.Course.carry`), the errors obey ``x(k) - z(k) = F (x(k-1) - z(k-1))``: its
    prediction is ``x' = F x + (z(k) - F z(k-1))``, whose second term is the effect of thrust alone and zero
    in a turn. Of the measurements it knows the variances at the true position, the scans with glint, a
    constant bias, and in clutter the plot of the target. Of a coloured error it knows deviation and
    correlation time, and estimates its level as two more states.

    Flights that are tables, such as those of aircraft, have no turn rates: there it knows the acceleration from scan to
    scan, which counts as thrust.
    """

    kind = "reference"
    knows = (
        "when every manoeuvre begins and ends, its acceleration or turn rate, the variance and bias of every scan, the "
        "deviation and correlation time of coloured errors, and which plot is the target's"
    )

    disturbances = DISTURBANCES

    def initialise(self, inputs: FilterInput) -> TurnMemory:
        """Return the state at the initial estimate; a coloured error starts with its stationary variance."""
        (mean, covariance), truth = inputs.measurement, inputs.truth
        if "coloured" in truth.disturbances:
            none, variance = 0.0 * mean[:2], truth.disturbances["coloured"].deviation ** 2
            mean = self.xp.concat([mean, none])
            covariance = self.block_diagonal(covariance, self.identity * variance)
        return TurnMemory(mean, covariance, Likelihood.unknown(mean[0]), truth)

    def block_diagonal(self, first: Array, second: Array) -> Array:
        """Return the block-diagonal matrix ``(n + m, n + m, N)`` of blocks ``(n, n, N)`` and ``(m, m, N)``."""
        corner = 0.0 * first[:, :1] + 0.0 * second[:1]
        return self.xp.concat(
            [
                self.xp.concat([first, corner], axis=1),
                self.xp.concat([self.xp.moveaxis(corner, 0, 1), second], axis=1),
            ]
        )

    def update(self, state: TurnMemory, inputs: FilterInput) -> TurnMemory:
        """Predict with the known flight, update with the measured position; return the state."""
        measurement, truth = inputs.measurement, inputs.truth
        xp, world, disturbances = self.xp, self.task.world, truth.disturbances
        assert isinstance(world, RadarWorld)
        early = None
        if truth.scans is not None and state.truth.scans is not None:
            early = state.truth.scans.early, truth.scans.early
        one = xp.ones_like(truth.scan)
        identity = xp.stack([xp.stack([one, 0.0 * one]), xp.stack([0.0 * one, one])])
        columns = [
            world.course.propagate_deviation(truth.flight, truth.scan, early, identity[i]) for i in range(2)
        ]
        by_velocity = xp.stack([xp.concat(column) for column in columns], axis=1)
        F = xp.concat([xp.concat([identity, 0.0 * identity]), by_velocity], axis=1)
        before, now = (xp.concat([state.position, state.velocity]) for state in (state.truth, truth))
        offset, Q, H = now - apply(F, before), 0.0 * F, self.H[:, :, None]
        variance = world.variances(truth.position)
        axes = world.error_axes(truth.position)
        if "clutter" in disturbances:
            measurement = measurement._replace(**disturbances["clutter"].echo._asdict())
        if "bias" in disturbances:
            bias = apply(axes, disturbances["bias"])
            measurement = measurement._replace(position=measurement.position - bias)
        if "coloured" in disturbances:
            colour = disturbances["coloured"]
            process = GaussMarkov.sampled(colour.deviation, colour.correlation_time, measurement.interval, xp)
            F = self.block_diagonal(F, self.identity * process.decay)
            Q = self.block_diagonal(Q, self.identity * process.kick**2)
            offset = xp.concat([offset, 0.0 * variance])
            H = xp.concat([H + 0.0 * variance[0], axes], axis=1)
        if "glint" in disturbances:
            variance = disturbances["glint"] ** 2 * variance
        predicted = kalman.predict(state.mean, state.covariance, F, Q, offset)
        result = self.update_estimate(predicted, measurement._replace(variance=variance), H)
        return TurnMemory(*self.track(measurement, result), truth)


class KnownInputBound(ConstantVelocityModel):
    """Posterior Cramér-Rao bound of an estimator that knows the whole acceleration: no process noise."""

    kind = "bound"
    traceable = True
    knows = "the acceleration in every scan"
    disturbances = DISTURBANCES

    def start(self, initial: Initial, truth: Truth) -> Array:
        """Return the initial covariance, as the bound's memory."""
        return initial.covariance

    def update(self, memory: Array, measurement: Measurement, truth: Truth) -> tuple[Array, Array]:
        """Predict and update at the true position; return the bound on variances, and the covariance."""
        world = self.task.world
        assert isinstance(world, RadarWorld)
        predicted = bounds.predict_bound(memory, self.motion(measurement.interval)[0])
        variance = world.variances(truth.position)
        P = bounds.posterior_cramer_rao_bound(predicted, self.H, self.identity * variance)
        clutter = truth.disturbances.get("clutter")
        available = measurement.available if clutter is None else clutter.echo.available
        P = self.xp.where(available > 0.0, P, predicted)
        return self.xp.stack([P[i, i] for i in range(4)]), P
