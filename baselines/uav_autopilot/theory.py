"""The steady-state loop of UavAutopilot without command, by the Lyapunov equation."""

from typing import NamedTuple

import numpy

from ...envs.uav_autopilot.task import UavAutopilot
from ...filters import linear_systems


class Stationary(NamedTuple):
    """Variances of output and control, and mean cost, of a steady-state loop without command."""

    output_variance: float
    control_variance: float
    cost: float
    """Mean cost, in the task's unit."""


def stationary(task: UavAutopilot, name: str) -> Stationary | None:
    """Return cost and variances of a policy's or reference's steady-state loop; None where they have no
    closed form.

    Returns:
        None where the loop is not linear with constant coefficients (levels that change, dropouts, actions
        that depend on the data), where sensors have coloured or constant errors, where the true actuator differs from
        the nominal one, or where the loop is unstable.
    """
    p, d = task.parameters, task.design
    nominal = ((1.0, 1.0),)
    slow = max(p.sensor_coloured[1], p.sensor_bias[1])
    if (p.disturbance_levels, p.sensor_levels, p.dropout_period, p.actuator_lag, slow) != (
        nominal,
        nominal,
        0,
        1.0,
        0.0,
    ):
        return None
    F, B, H, L, R = d.model.F, d.model.B, d.H, d.feedback, d.R
    Q, n = d.model.scaled_noise + d.model.other_noise, len(d.model.F)
    scales = {
        "kalman": 1.0,
        "matched": 1.0,
        "steady-kalman": 1.0,
        "over-smoothed": p.over_smoothed_scale,
        "wide-band": p.wide_band_scale,
    }
    if name == "true-state":
        X = linear_systems.stationary_covariance(F - B @ L, Q)
        control = float((L @ X @ L.T)[0, 0])
    elif name == "raw-sensors":
        loop = linear_systems.measurement_feedback_loop(F, B, H, L, Q, R)
        if linear_systems.spectral_radius(loop.transition) >= 1.0:
            return None
        X = linear_systems.stationary_covariance(*loop)
        raw = L @ H.T
        control = float((raw @ (H @ X @ H.T + R) @ raw.T)[0, 0])
    elif name in scales:
        K = linear_systems.steady_kalman(F, H, scales[name] * Q, R).gain
        both = linear_systems.stationary_covariance(
            *linear_systems.estimate_feedback_loop(F, B, H, L, K, Q, R)
        )
        X, estimate = both[:n, :n], numpy.hstack([L, -L])
        control = float((estimate @ both @ estimate.T)[0, 0])
    else:
        return None
    cost = float(numpy.trace(d.weight @ X)) + d.control_weight * control
    return Stationary(float(X[task.output, task.output]), control, cost / task.cost_unit)
