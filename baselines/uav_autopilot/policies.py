"""Policies, reference estimators, the bound and the metrics of UavAutopilot.

Equation numbers are those of the task's paper (Gridnev, Rusetski, Rak).
"""

import math
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy

from ...envs.catalogue import make_task
from ...envs.controls import signed_exponential
from ...envs.task import Array
from ...envs.uav_autopilot.task import MODES, State, UavAutopilot
from ...evaluation.bootstrap import Bootstrap, Estimate
from ...evaluation.competitors import ConstantPolicy, Policy, RandomPolicy
from ...evaluation.metrics import Measure
from ...filters import linear_systems, packed_covariance
from ..table import Baselines, Tunable

OVER_SMOOTHED, WIDE_BAND = 0.01, 100.0
"""Factors on the process noise of the two badly tuned filters."""
LOST_SIGMAS = 100.0
"""Tracking error, over the nominal sigma of the output's sensor, beyond which a loop counts as lost."""


# --- policies


class FixedScale(ConstantPolicy):
    """One Kalman filter whose process noise is the nominal one times ``10 ** log10_scale``.

    A factor that the action cannot reach is taken at the edge of the action's range.
    """

    control = "gain"

    def __init__(self, task: UavAutopilot, log10_scale: float = 0.0) -> None:
        super().__init__(task)
        self.action = (min(max(log10_scale / task.parameters.gain_decades, -1.0), 1.0),)


class Kalman(FixedScale):
    """The paper's filter, equations (10)-(12): the process noise is what the design says."""


class OverSmoothed(FixedScale):
    """A filter that trusts its model too much: process noise times 0.01."""

    def __init__(self, task: UavAutopilot) -> None:
        super().__init__(task, math.log10(OVER_SMOOTHED))


class WideBand(FixedScale):
    """A filter that trusts its sensors too much: process noise times 100."""

    def __init__(self, task: UavAutopilot) -> None:
        super().__init__(task, math.log10(WIDE_BAND))


class RawSensors(Policy):
    """No filter: the readings are fed back, the last valid one during a dropout."""

    control = "mode"

    def act(self, observation: numpy.ndarray, state: Any, start: numpy.ndarray) -> tuple[numpy.ndarray, Any]:
        """Name the mode."""
        return numpy.full(len(observation), MODES.index("raw-sensors")), None


class InnovationAdaptive(Policy):
    """Process noise scaled by a window of normalised innovations squared (NIS).

    The logarithm of the factor is the last one, ``memory`` of it kept, plus ``weights`` times the logarithm
    of the innovations' mean square of each sensor over an exponential window; the mean square of a
    consistent filter is one. Without weights of their own all sensors count alike with positive sign, the
    textbook's rule: innovations larger than predicted mean that the model is trusted too much. It cannot
    tell gusts from a noisier sensor, for which the right answer is the opposite; tuned weights can.

    Args:
        task: whose observation it reads.
        window: effective length of the window, measurements.
        memory: share of the last factor's logarithm that is kept, 0 to 1.
        offset: logarithm (base 10) of the factor when the innovations are as predicted.
        weights: decades of the factor per decade of each sensor's mean square.
    """

    control = "gain"

    def __init__(
        self,
        task: UavAutopilot,
        window: float = 50.0,
        memory: float = 0.5,
        offset: float = 0.0,
        weights: tuple[float, ...] | None = None,
    ) -> None:
        super().__init__(task)
        self.forget, self.memory = 1.0 / window, memory
        self.unit = 1.0 / task.parameters.gain_decades
        self.offset = offset
        m = len(task.sensors)
        self.weights = numpy.array([1.0 / m] * m if weights is None else (*weights, *[0.0] * m)[:m])
        self.innovation = task.columns([f"innovation_{s}" for s in task.sensors])
        self.available = task.columns([f"available_{s}" for s in task.sensors])
        self.last = task.columns(["action"])[0]

    def act(self, observation: numpy.ndarray, state: Any, start: numpy.ndarray) -> tuple[numpy.ndarray, Any]:
        """Update the window and scale the noise."""
        squared = signed_exponential(observation[:, self.innovation], numpy) ** 2
        # A window starts where a consistent filter would be.
        mean = numpy.where(start[:, None], 1.0, 1.0 if state is None else state)
        mean = mean + self.forget * observation[:, self.available] * (squared - mean)
        wanted = self.unit * (self.offset + numpy.log10(numpy.maximum(mean, 1e-12)) @ self.weights)
        action = self.memory * observation[:, self.last] + (1.0 - self.memory) * wanted
        return numpy.clip(action, -1.0, 1.0)[:, None], mean


# --- reference estimators and the bound


class TrueState:
    """The autopilot gets the state itself: no estimator feeds this loop better."""

    kind = "reference"
    knows = "the whole state"

    def __init__(self, task: UavAutopilot) -> None:
        self.task = task

    def start(self, state: State) -> None:
        """Nothing to remember."""

    def update(self, state: State, memory: None) -> tuple[State, None]:
        """Put the truth in place of the estimate; the filter runs on behind, and its covariance is shown."""
        posterior = self.task.act(state, 0.0 * state.clock[None])
        return posterior._replace(estimate=state.truth), None


class Matched:
    """The Kalman filter with the noise as it is now: its Q and R follow every change at once.

    It is not told of a slower actuator.
    """

    kind = "reference"
    knows = "the present level of the disturbance and of each sensor's noise"

    def __init__(self, task: UavAutopilot) -> None:
        self.task = task

    def start(self, state: State) -> Array:
        """What the first prediction's covariance lacks: the gust starts at the level of its first part."""
        task = self.task
        p, design = task.parameters, task.design
        n = len(design.model.F)
        missing = numpy.zeros((n, n))
        if p.plant == "U":
            missing[-1, -1] = p.value("initial_sigmas")[-1] ** 2
        predicted = packed_covariance.pack(design.model.F @ missing @ design.model.F.T)
        return task.constant(predicted[:, None]) * (state.levels[0] ** 2 - 1.0)

    def update(self, state: State, memory: Array) -> tuple[State, Array]:
        """Equations (12), (11) with the noise of this measurement."""
        task, xp = self.task, self.task.xp
        variances = task.constant(task.sensor_variances)[:, None] * state.sensor_level**2
        covariance = state.filter_covariance + memory + task.process_noise(state.level)
        update = packed_covariance.update_coordinates(
            state.mean, covariance, state.measurement, task.measured, variances, state.available
        )
        diagonal = packed_covariance.diagonal(state.mean.shape[0])
        innovation = xp.stack(
            [
                state.available[k]
                * (state.measurement[k] - state.mean[i])
                / xp.sqrt(covariance[diagonal[i]] + variances[k])
                for k, i in enumerate(task.measured)
            ]
        )
        count = state.available.sum(axis=0)
        nis = xp.where(count > 0.0, update.squared_distance / xp.clip(count, 1.0, None), state.nis)
        posterior = state._replace(
            mean=update.mean,
            filter_covariance=update.covariance,
            estimate=update.mean,
            estimate_covariance=update.covariance,
            innovation=innovation,
            nis=nis,
        )
        return posterior, 0.0 * memory


class SteadyKalman:
    """The nominal filter with the constant gain that it settles to; a missing reading changes nothing."""

    kind = "reference"
    knows = "nothing hidden, but its gain is outside what the action can steer"

    def __init__(self, task: UavAutopilot) -> None:
        self.task = task
        steady = task.design.steady
        self.gain = task.constant(steady.gain)
        self.covariance = task.constant(packed_covariance.pack(steady.posterior)[:, None])

    def start(self, state: State) -> None:
        """Nothing to remember."""

    def update(self, state: State, memory: None) -> tuple[State, None]:
        """Equation (11) with the gain of the algebraic Riccati equation."""
        task, xp = self.task, self.task.xp
        predicted = xp.stack([state.mean[i] for i in task.measured])
        estimate = state.mean + xp.matmul(self.gain, state.available * (state.measurement - predicted))
        covariance = self.covariance + 0.0 * state.filter_covariance
        posterior = state._replace(
            mean=estimate,
            filter_covariance=covariance,
            estimate=estimate,
            estimate_covariance=covariance,
        )
        return posterior, None


class KnownNoiseBound:
    """Covariance of the best estimate for an estimator that is told plant and noise: the Riccati recursion.

    Linear and Gaussian with a known control, so it is the posterior Cramer-Rao bound, it is attained, and it
    does not depend on the control: the filters of all policies face the same bound.
    """

    kind = "bound"
    knows = "the level of every noise and the true actuator"

    def __init__(self, task: UavAutopilot) -> None:
        self.task = task
        model, pack = task.design.true_model, packed_covariance.pack
        self.propagator = task.constant(packed_covariance.propagator(model.F))
        self.scaled = task.constant(pack(model.scaled_noise)[:, None])
        self.other = task.constant(pack(model.other_noise)[:, None])

    def start(self, state: State) -> Array:
        """Covariance of the state's own distribution at the start."""
        task = self.task
        variance = numpy.square(task.parameters.value("initial_sigmas"))
        at_level = numpy.zeros_like(variance)
        if task.parameters.plant == "U":
            at_level[-1] = variance[-1]
        fixed = packed_covariance.pack(numpy.diag(variance - at_level))[:, None]
        gust = packed_covariance.pack(numpy.diag(at_level))[:, None]
        return task.constant(fixed) + task.constant(gust) * state.levels[0] ** 2

    def update(self, state: State, memory: Array) -> tuple[Array, Array]:
        """Bound after this measurement."""
        task, xp = self.task, self.task.xp
        covariance = xp.matmul(self.propagator, memory) + state.level**2 * self.scaled + self.other
        variances = task.constant(task.sensor_variances)[:, None] * state.sensor_level**2
        zero = xp.zeros_like(state.truth)
        after = packed_covariance.update_coordinates(
            zero, covariance, state.measurement, task.measured, variances, state.available
        ).covariance
        return after[packed_covariance.diagonal(len(task.components))], after


# --- theory of the stationary loop


class Stationary(NamedTuple):
    """Second moments of a settled linear loop without command."""

    output_variance: float
    control_variance: float
    cost: float
    """In the task's unit."""


def stationary(task: UavAutopilot, name: str) -> Stationary | None:
    """Solve the discrete Lyapunov equation of a policy's or reference's loop.

    Returns:
        None where the loop is not linear with constant coefficients (levels that change, dropouts, actions
        that depend on the data), where the true actuator differs from the believed one, or where the loop is
        unstable.
    """
    p, d = task.parameters, task.design
    nominal = ((1.0, 1.0),)
    if (p.disturbance_levels, p.sensor_levels, p.dropout_period, p.actuator_lag) != (
        nominal,
        nominal,
        0,
        1.0,
    ):
        return None
    F, B, H, L, R = d.model.F, d.model.B, d.H, d.feedback, d.R
    Q, n = d.model.scaled_noise + d.model.other_noise, len(d.model.F)
    scales = {
        "kalman": 1.0,
        "matched": 1.0,
        "steady-kalman": 1.0,
        "over-smoothed": OVER_SMOOTHED,
        "wide-band": WIDE_BAND,
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
    elif name in scales and abs(math.log10(scales[name])) <= p.gain_decades:
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


# --- metrics


def metrics(run: Any, bootstrap: Bootstrap) -> list[Measure]:
    """Measures of the loop, beside those of the estimate.

    ``output_variance`` (of output minus command) and ``control_variance``: across episodes at each
    measurement, mean over the window. ``tracking_rmse``: root mean square of output minus command.
    ``innovation_autocorrelation``: at lag one, of the output sensor's normalised innovation (node 4); zero
    for a consistent filter. ``lost_loops``: share of episodes whose tracking error ever exceeds
    ``LOST_SIGMAS``. In window "steady" of a stationary linear loop ``*_theory``: the same by the Lyapunov
    equation. With a step command ``overshoot``, ``rise_time`` (to 90 %), ``settling_time`` (to 5 %) of the
    response averaged over episodes, whose noise falls with the root of their number, and ``mean_output``
    when settled; times that are not reached are cut off at the end of the window "transient".
    """
    if "output" not in run or numpy.isnan(run["output"].values).all():
        return []
    attrs = run.attrs
    task = make_task(attrs["environment"], "gain", attrs["scenario"], **attrs["keywords"])
    assert isinstance(task, UavAutopilot)
    name = str(run["policy"].values)
    unit, control_unit = task.components[task.output].unit, {"P": "m/s^2", "U": "deg"}[task.parameters.plant]
    output, control = run["output"].values, run["control_signal"].values
    tracking = output - run["command"].values
    windows = {w: slice(first - 1, last) for w, (first, last) in attrs["windows"].items()}
    tracking_variance, control_variance = _variances(tracking, bootstrap), _variances(control, bootstrap)
    theory = stationary(task, name)
    innovation = run["innovation"].values
    found: list[Measure] = []
    for window, times in windows.items():

        def add(metric: str, estimate: Estimate, unit: str, window: str = window) -> None:
            found.append(Measure(metric, "", window, estimate, unit))

        add("output_variance", bootstrap.interval(tracking_variance[:, times].mean(axis=1)), f"({unit})^2")
        add(
            "control_variance",
            bootstrap.interval(control_variance[:, times].mean(axis=1)),
            f"({control_unit})^2",
        )
        add("tracking_rmse", bootstrap.estimate((tracking[:, times] ** 2).mean(axis=1), numpy.sqrt), unit)
        if theory is not None and window == "steady":
            add("output_variance_theory", _exact(theory.output_variance), f"({unit})^2")
            add("control_variance_theory", _exact(theory.control_variance), f"({control_unit})^2")
            add("cost_theory", _exact(theory.cost), "1")
        found.append(
            Measure(
                "innovation_autocorrelation",
                "lag 1",
                window,
                _correlation(innovation[:, times], bootstrap),
                "1",
            )
        )
    far = (numpy.abs(tracking) > LOST_SIGMAS * math.sqrt(task.cost_unit)).any(axis=1)
    found.append(Measure("lost_loops", "", "all", bootstrap.estimate(far.astype(float)), "1"))
    if task.parameters.step_size:
        found += _step_response(task, output, windows, unit, bootstrap)
    return found


def _exact(value: float) -> Estimate:
    return Estimate(value, value, value)


def _variances(values: numpy.ndarray, bootstrap: Bootstrap) -> numpy.ndarray:
    """Unbiased variance across episodes at each time, of the data and of every resample."""
    episodes = len(values)
    mean = values.mean(axis=0)
    around = values - mean
    biased = bootstrap.means(around**2) - bootstrap.means(around) ** 2
    return biased * (episodes / max(episodes - 1, 1))


def _correlation(values: numpy.ndarray, bootstrap: Bootstrap) -> Estimate:
    """Autocorrelation at lag one, pooled over episodes."""
    if values.shape[1] < 2:
        return Estimate(math.nan, math.nan, math.nan)
    product = bootstrap.means((values[:, 1:] * values[:, :-1]).mean(axis=1))
    power = bootstrap.means((values**2).mean(axis=1))
    return bootstrap.interval(product / numpy.maximum(power, 1e-300))


def _step_response(
    task: UavAutopilot, output: numpy.ndarray, windows: Mapping[str, slice], unit: str, bootstrap: Bootstrap
) -> list[Measure]:
    p = task.parameters
    T, first = p.value("sampling_interval"), p.step_time - 1
    last = windows["transient"].stop if "transient" in windows else output.shape[1]
    response = bootstrap.means(output[:, first:last]) / p.step_size
    length = response.shape[1]
    if length < 2:
        return []
    reached = response >= 0.9
    rise = numpy.where(reached.any(axis=1), reached.argmax(axis=1), length)
    outside = numpy.abs(response - 1.0) > 0.05
    settling = numpy.where(outside.any(axis=1), length - outside[:, ::-1].argmax(axis=1), 0)
    over = numpy.maximum(response.max(axis=1) - 1.0, 0.0)
    found = [
        Measure("overshoot", "", "transient", bootstrap.interval(over), "1"),
        Measure("rise_time", "", "transient", bootstrap.interval(rise * T), "s"),
        Measure("settling_time", "", "transient", bootstrap.interval(settling * T), "s"),
    ]
    if "steady" in windows:
        settled = bootstrap.estimate(output[:, windows["steady"]].mean(axis=1))
        found.append(Measure("mean_output", "", "steady", settled, unit))
    return found


# --- tables


def _tuned_adaptive(values: Mapping[str, float]) -> tuple[dict[str, Any], Callable[[Any], Policy]]:
    weights = tuple(values[name] for name in ("output_weight", "rate_weight", "elevator_weight"))

    def make(task: UavAutopilot) -> Policy:
        return InnovationAdaptive(task, values["window"], values["memory"], values["offset"], weights)

    return {}, make


TUNABLE = {
    "fixed-best": Tunable(
        "gain",
        {"log10_scale": (-2.0, 2.0)},
        {"log10_scale": 0.0},
        lambda values: ({}, lambda task: FixedScale(task, values["log10_scale"])),
    ),
    "innovation-adaptive": Tunable(
        "gain",
        {
            "window": (5.0, 150.0),
            "memory": (0.0, 0.95),
            "offset": (-1.0, 1.0),
            "output_weight": (-3.0, 3.0),
            "rate_weight": (-3.0, 3.0),
            "elevator_weight": (-3.0, 3.0),
        },
        {
            "window": 50.0,
            "memory": 0.5,
            "offset": 0.0,
            "output_weight": 1.0 / 3.0,
            "rate_weight": 1.0 / 3.0,
            "elevator_weight": 1.0 / 3.0,
        },
        _tuned_adaptive,
    ),
}

BASELINES = Baselines(
    environment="filtergym/UavAutopilot-v0",
    policies={
        "kalman": Kalman,
        "over-smoothed": OverSmoothed,
        "wide-band": WideBand,
        "raw-sensors": RawSensors,
        "innovation-adaptive": InnovationAdaptive,
        "fixed-best": FixedScale,
        "random": RandomPolicy,
    },
    references={"true-state": TrueState, "matched": Matched, "steady-kalman": SteadyKalman},
    bounds={"known-noise-bound": KnownNoiseBound},
    score_paper="kalman",
    score_bound="matched",
    tunable=TUNABLE,
    best_constant="fixed-best",
    physical=("tracking_rmse", ""),
    benchmark=(
        "kalman",
        "over-smoothed",
        "wide-band",
        "raw-sensors",
        "innovation-adaptive",
        "random",
        "true-state",
        "matched",
        "steady-kalman",
        "known-noise-bound",
    ),
    metrics=metrics,
)
