"""The Kalman filter inside the control loop of a small unmanned aircraft.

After Y. V. Gridnev, A. Y. Rusetski and S. A. Rak, "Stochastic simulation of the automatic control systems of
unmanned aircraft using optimal Kalman filter". Numbers in brackets are the paper's equations.

    truth       x(k+1) = F x(k) + B u(k) + s(k+1) C_s xi + C_o eta                   (8)
    sensors     z_i(k) = x_i(k) + f_i(k) sigma_i v_i                                 (9)
    prediction  x'(k+1) = F x(k|k) + B u(k),  P' = F P F^T + g Q                     (10), (12)
    update      with the Kalman gain of P', for the available sensors                (11), (12)
    autopilot   u(k) = N r(k) - L x(k|k)

``s`` is the level of the disturbance and ``f`` that of the sensor noise, both 1 in the filter's model; the
action sets ``g``. The command r shifts the equilibrium: output r, everything else zero, which both plants
hold without control because they integrate.

Reading: (6) prints the feedback without the command, with which a unit command ends far from one; the prediction
uses the current control, ``B U`` of (8) and (10), command included. Reading: the noise printed in (10) has mean zero and is unknown, so it is dropped.
"""

from typing import Any, ClassVar

from ...extensions import load_present
from ..contract.causes import Causes
from ..contract.companions import Actions, LoopRecords, LostTracks, Paper, PictureMaker, TrainedBanks
from ..contract.model import Episode, Model
from ..contract.observation import Array
from ..contract.task import Banks, Component, PaperPolicy, Reward
from . import ID
from .banks import GainBank, ModeBank, NoiseBank
from .causes import CAUSES
from .hypotheses import HypothesesBank
from .kalman_net import KalmanNetBank
from .parameters import COORDINATES, UavAutopilotParameters
from .problem import AutopilotProblem
from .scenarios import SCENARIOS
from .world import AircraftWorld, Measurement, Start


def _picture(model: Model) -> Any:
    from .picture import PICTURE  # imports matplotlib

    return PICTURE(model)


def _records(model: Model, episode: Episode, kept: dict[str, Array]) -> dict[str, Array]:
    return {"control_signal": model.feedback(episode.filter, episode.measurement)}


class UavAutopilot(AutopilotProblem):
    """Autopilot of a small unmanned aircraft: steer the Kalman filter in its control loop.

    ## Description

    A plant is held on its command by ``u = N r - L x(k|k)``. The autopilot does not receive the state x but
    the estimate of a Kalman filter on noisy sensors, and this loop is closed. The action changes the
    filter, the estimate moves the controls, the controls move the aircraft. Noise is fixed by the seed; the
    truth follows from the actions.

    ``plant="U"`` (default) is the pitch channel of a small aircraft with an actuator and gusts, 50
    measurements a second, state incidence, rate, pitch, elevator, gust; pitch is commanded. ``plant="P"`` is
    the paper's double integrator, 4 measurements a second. The autopilot is a linear-quadratic regulator.

    The filter assumes nominal noise. In the scenario ``random`` the gusts and the sensors' noise differ from
    it and change during the episode, sensors have short dropouts, and steps and doublets are commanded. A
    filter that trusts its model too much follows gusts late; one that trusts its sensors too much passes
    their noise on to the elevator.

    ## Action Space

    ``Actions`` describes each control. Values outside the box are clipped to it.

    ## Observation Space

    For each sensor the innovation over its sigma, its short average, the logarithm of the short average of
    its square, the reading, and its availability; the log NIS per reading and that of its short average;
    the command, the current control, the log trace of the covariance, the time, the last action.
    Innovations, command, control and readings are compressed by ``sign(x) log(1 + |x|)`` in units of one
    sigma of a sensor; the logarithms of squares stop at 0.01. Sigmas are those of the filter before the action: its last covariance, predicted
    with the Q of the last action.

    ## Rewards

    The cost of the loop at a measurement, which evaluations report, is
    ``((x - x_r)^T W (x - x_r) + R u^2) / sigma^2``. ``x_r`` is the equilibrium of the command (output r, all
    else zero), u the control that follows from the estimate, sigma the nominal standard deviation of the
    output's sensor (U: 0.5 deg; P: 1 m). Gusts and commands cause most of it under any control. The reward uses the
    part that the agent can change, the loss of u against the optimal control u* of the true state,
    ``x = (R + B^T S B) (u - u*)^2 / sigma^2`` with S of the Riccati equation: on average it differs between two
    filters by the difference of the costs of their episodes. By default ("relative") the reward is that of the
    paper's filter on the same noise less that of the agent, ``30 log(1 + x / 30)`` each; "cost" is minus the
    agent's part. An action affects the control at once and the estimate later: the problem
    is not myopic.

    ## Starting State

    The state is drawn with ``initial_sigmas`` about zero and the filter starts at zero with that covariance.

    ## Episode End

    Truncation after ``horizon`` measurements (600: 12 s for U, 150 s for P). No termination: a loop
    that diverges under an unstable choice (such as raw readings of too few sensors) is limited to 10 000 units of
    each coordinate and continues to cost.

    ## Arguments

    ``plant``, ``control``, ``scenario`` (``random``, ``paper-noise``, ``paper-step``; held out:
    ``gust-front``, ``sensor-degradation``, ``actuator-lag``, ``gyro-bias``), and every field of
    :class:`UavAutopilotParameters`. Errors, with the reason, are an L that does not stabilise the plant, noise
    that is not positive, sensors that do not determine the state.

    ## Version History

    * v0: first version.
    """

    id = ID
    interface = 5
    Parameters = UavAutopilotParameters
    World: ClassVar[type[AircraftWorld]] = AircraftWorld
    banks: ClassVar[Banks] = {
        "noise": NoiseBank,
        "gain": GainBank,
        "hypotheses": HypothesesBank,
        "mode": ModeBank,
    }
    scenarios = SCENARIOS
    components: tuple[Component, ...] = COORDINATES["U"]
    # Gusts and sensors dominate the noise of the reward, and affect the paper's filter equally.
    reward: ClassVar[Reward] = Reward(
        "quadratic cost of the loop, weighted tracking error and control squared, in units of the nominal "
        "variance of the output's sensor",
        "relative",
        unit=1.5,
    )
    paper_policy: PaperPolicy = PaperPolicy("gain", (0.0,))
    companions: tuple[Any, ...] = (
        Paper(
            "Y. V. Gridnev, A. Y. Rusetski, S. A. Rak, Stochastic simulation of the automatic control systems of "
            "unmanned aircraft using optimal Kalman filter"
        ),
        Actions(
            {
                "noise": "the process noise Q of the filter is scaled by 10^(1.5 r a) (`process_decades`), the standard deviation of "
                "each sensor by 10^(0.8 r a) (`sensor_decades`), r = 0.2 (`noise_reach`), in the update by the measurement that "
                "was just observed; **0 is the paper's filter**",
                "gain": "the process noise Q of the filter is scaled by 10^(a/2) (`gain_decades` = 0.5) in the "
                "update by the measurement that was just observed; **0 is the paper's filter**",
                "hypotheses": "factors r^a in the bank over levels at this measurement: probability of the highest level of the "
                "gusts (r = 1.1), that all noise is as designed (1.25), the process noise (2), the variance of each sensor (1.5); "
                "**0 is the estimator `level-bank`**",
                "mode": "0 nominal; 1 wide-band, Q times 100; 2 raw sensors: the same L on the readings (held "
                "during dropouts), zero for coordinates without a sensor; the filter continues; 3 over-smoothed, Q over 100",
            },
            {
                "noise": ("noise_reach", "process_decades", "sensor_decades"),
                "gain": ("gain_decades",),
                "kalman-net": ("process_decades", "sensor_decades"),
            },
        ),
        TrainedBanks({"kalman-net": KalmanNetBank}),
        PictureMaker(_picture),
        Causes(CAUSES, start=20),
        # A loop with an error of ten times that of its sensor throughout.
        LostTracks(100.0),
        LoopRecords(_records),
        *load_present(("live:LIVE_READER",), __package__),
    )

    def feedback(self, mean: Array, covariance: Array, measurement: Measurement | Start) -> Array:
        """Return the control that the autopilot computes from an estimate, ``(N,)``."""
        return self.autopilot(mean, measurement.command)


TASK = UavAutopilot
