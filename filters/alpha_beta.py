r"""Alpha-beta filters: the fixed-gain tracker of one coordinate and the covariance of its error.

The filter of gain ``alpha`` follows position and velocity of a coordinate measured every T seconds:

    prediction  x' = x + T v,  v' = v
    update      x = x' + alpha nu,  v = v' + (beta / T) nu,  nu = z - x'            (19), (20)

Numbers in brackets are those of the IMM paper by Bakulev, Sychev and Nguyen. With P the error covariance,
H = [1 0] and the gain K = [alpha, beta / T]^T in force, whatever it is,

    P(k|k) = (I - K H) P(k|k-1) (I - K H)^T + K R K^T                               (Joseph form)

belongs to the gains that were used. Reading: the paper needs a covariance for the likelihood (11) and gives
none; of the readings tried this is the only one that reproduces its claim about the best gains, and
(I - K H) P with a gain that is not Kalman's is indefinite.

**Scans that are missed or come early.** Over an interval Delta the prediction is ``x' = x + Delta v``, and a scan that
has no measurement ends there: state and covariance are those predicted. The innovation of the next one has grown since
the last measurement, for ``t = sum Delta`` s, so the velocity's gain is ``beta / t``: what (19), (20) make of a filter
whose scan period is t. T of the functions below is Delta in a prediction, t in an update, a number or ``(N,)``.

All arrays are elementwise in the batch; axes of space are just more batch.
"""

from typing import NamedTuple

from .array_namespace import Array, namespace


class Covariance(NamedTuple):
    """Error covariance of position and velocity in one coordinate: three arrays of one shape."""

    position: Array
    """Variance of the position, m^2."""
    cross: Array
    """Covariance of position and velocity, m^2/s."""
    velocity: Array
    """Variance of the velocity, m^2/s^2."""


def benedict_bordner_beta(alpha: Array) -> Array:
    """Return the Benedict-Bordner velocity gain ``beta = alpha^2 / (2 - alpha)``, equation (21).

    Benedict and Bordner (1962): this relation minimises noise and transient error together.
    """
    return alpha * alpha / (2.0 - alpha)


def predict(position: Array, velocity: Array, T: float | Array) -> Array:
    """Return the predicted position ``x + T v``; the velocity does not change."""
    return position + T * velocity


def update(
    predicted: Array, velocity: Array, innovation: Array, alpha: Array, beta: Array, T: float | Array
) -> tuple[Array, Array]:
    """Return position and velocity updated with an innovation, equations (19) and (20)."""
    return predicted + alpha * innovation, velocity + (beta / T) * innovation


def predict_covariance(P: Covariance, T: float | Array) -> Covariance:
    """Return the predicted covariance ``F P F^T`` with ``F = [[1, T], [0, 1]]``, without process noise."""
    cross = P.cross + T * P.velocity
    return Covariance(P.position + T * (P.cross + cross), cross, P.velocity)


def update_covariance(P: Covariance, R: Array, alpha: Array, beta: Array, T: float | Array) -> Covariance:
    """Return the covariance after an update with any gains (Joseph form).

    Args:
        P: predicted covariance.
        R: variance of the measurement, m^2.
        alpha: position gain.
        beta: velocity gain.
        T: time since the last measurement, s.
    """
    rate = beta / T
    rest = 1.0 - alpha
    noise = alpha * R
    return Covariance(
        rest * rest * P.position + alpha * noise,
        rest * (P.cross - rate * P.position) + rate * noise,
        P.velocity - rate * (2.0 * P.cross - rate * (P.position + R)),
    )


def add_acceleration_error(
    P: Covariance, mean_square: Array, alpha: Array, beta: Array, T: float | Array, since: float | Array = 0.0
) -> Covariance:
    """Return an updated covariance plus the error of an acceleration since the previous measurement.

    The target accelerates since the previous measurement. An acceleration ``a`` over an interval moves the position by
    ``d = a T^2 / 2`` and the velocity by ``2 d / T``, of which the update (19), (20) leaves ``(1 - alpha) d`` and
    ``(2 - beta) d / T``. Where it lasts for ``since`` s after the update, without a measurement, these become, with
    ``r = since / T``, ``(1 - alpha + (2 - beta) r + r^2) d`` and ``(2 - beta + 2 r) d / T``.

    Args:
        P: covariance without acceleration, after the update, or predicted from there by ``since``.
        mean_square: mean square of ``d``, m^2.
        alpha: position gain of the update.
        beta: velocity gain of the update.
        T: time from the previous measurement to the update, s.
        since: time since the update, s.
    """
    ratio = since / T
    left = 2.0 - beta
    rest, rate = 1.0 - alpha + ratio * (left + ratio), (left + 2.0 * ratio) / T
    return Covariance(
        P.position + rest * rest * mean_square,
        P.cross + rest * rate * mean_square,
        P.velocity + rate * rate * mean_square,
    )


def predict_joint_covariance(P: Array, T: float | Array) -> Array:
    """Return the predicted covariance ``F P F^T`` of several coordinates together, without process noise.

    Args:
        P: covariance of (positions, velocities), ``(2 d, 2 d, ...)``.
        T: interval, s; one for all, or broadcasting against the trailing axes.
    """
    xp = namespace(P)
    d = P.shape[0] // 2
    rows = xp.concat([P[:d] + T * P[d:], P[d:]], axis=0)
    return xp.concat([rows[:, :d] + T * rows[:, d:], rows[:, d:]], axis=1)


def update_joint_covariance(P: Array, R: Array, alpha: Array, beta: Array, T: float | Array) -> Array:
    """Return the covariance of several coordinates after an update with the same gains in each (Joseph form).

    Args:
        P: predicted covariance of (positions, velocities), ``(2 d, 2 d, ...)``.
        R: measurement variance of each coordinate, ``(d, ...)``.
        alpha: position gain, broadcasting against the trailing axes.
        beta: velocity gain.
        T: time since the last measurement, s; one for all, or broadcasting in the same way.
    """
    xp = namespace(P)
    d = P.shape[0] // 2
    rate = beta / T
    rest = 1.0 - alpha
    rows = xp.concat([rest * P[:d], P[d:] - rate * P[:d]], axis=0)
    trailing = (slice(None), slice(None), *[None] * (P.ndim - 2))
    diagonal = xp.eye(d, dtype=P.dtype, device=P.device)[trailing] * R
    cross = (alpha * rate) * diagonal
    left = rest * rows[:, :d] + xp.concat([alpha * alpha * diagonal, cross], axis=0)
    right = rows[:, d:] - rate * rows[:, :d] + xp.concat([cross, rate * rate * diagonal], axis=0)
    return xp.concat([left, right], axis=1)
