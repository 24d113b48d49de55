r"""Loosely coupled navigation: an INS that drifts, corrected by a GNSS receiver through one gain.

After Benkafo and Lobaty, "Features of application of Kalman-Bucy filters in orientation and navigation
complexes". The reference ``Xr`` is ``amplitude sin(rate t)``, or a sum of such harmonics that is drawn anew for every
episode; the INS integrates it with the rate errors of :mod:`filtergym.filters.loosely_coupled`, the receiver measures
it with white noise, and in some scenarios with a coloured error e beside it. On every axis

    X += dXr + T beta + drive eta + dd,   eta = decay eta + de,   Z = Xr + e + sigma n
    Xh' = Xh + dX,   nu = Z - Xh',   Xh = Xh' + gain nu                                         (3)

Reading: the paper prints no numbers; those marked "ours" make its Figs. 2, 4 and 5 look as described.
"""

from typing import Any, ClassVar

from ...extensions import load_present
from ..contract.causes import Causes
from ..contract.companions import Actions, LostTracks, Paper, TrainedBanks
from ..contract.task import Banks, Component, PaperPolicy, Reward, Task
from . import ID
from .banks import SCHEMES, GainBank, NoiseBank, SchemeBank
from .causes import CAUSES
from .hypotheses import HypothesesBank
from .kalman_net import KalmanNetBank
from .parameters import AXES, LooselyCoupledNavigationParameters
from .scenarios import SCENARIOS
from .world import InsGnssWorld


class LooselyCoupledNavigation(Task):
    """Loosely coupled INS/GNSS navigation: steer the gain that weights a drifting INS against a noisy receiver.

    ### Description

    The inertial navigation system (INS) gives smooth increments of position whose rate error is a random
    constant, a coloured and a white noise; its error grows without limit. The satellite receiver (GNSS)
    measures the position with strong white noise and no memory. The Kalman-Bucy filter of the paper adds the
    increments to the estimate and corrects it towards the measurement by a gain. A high gain follows the receiver
    noise, a low one follows the drift, and the better one depends on unknown noise levels.

    With ``control="noise"`` (default) the augmented filter, which also estimates the rate errors, computes its
    gain from noises that the action scales. With ``gain`` the action sets the gain of the plain scheme itself.
    Both act on the estimate and so on all later ones. With ``mode`` and ``weights`` a bank of three filters runs
    beside the agent without mixing: the plain scheme tuned to the white noise, the plain scheme with the
    coloured noise reduced to white, both with the gain (4) of the Riccati equation, and the augmented filter.
    The action then selects only the reported estimate *now*: the problem is myopic, a discount factor of zero
    suffices.

    Axes are independent: one gain for each, one set of noises or weights for all.

    ### Action Space

    ``Actions`` describes each control. Values outside the box are clipped to it. An action holds for
    ``decision_interval`` measurements, ten by default.

    Without a measurement the gain is zero, for any action; under ``noise`` the covariance still grows by
    the rate errors' noises that the action sets.

    ### Observation Space

    A flat ``Box``; for each filter (three under mode and weights, one otherwise) and axis, in this order:
    innovation over its standard deviation; innovation over the receiver's *reported* noise; short averages of
    the normalised innovation, of its square and of its product with the previous one. All are observed as signed
    logarithms ``sign(x) log(1 + |x|)``. Then the logarithm of the reported over the nominal noise (the report may
    be wrong), whether there is a measurement, the last action (under mode and weights: the last weights), and
    the time t as ``t / (t + tau)``; under noise also the logarithm of the predicted standard deviation of the
    position. A filter without a measurement has the innovation zero, and its averages do not change. Under noise,
    predictions use the noises of the last action.

    The observation does not contain the increments of the INS: in ``paper`` the reference motion is always the same, so
    an agent that memorised it could compute the rate errors from them. The observation depends on the errors alone, so
    that an agent acts independently of the motion. An estimator receives the increments; in every scenario but
    ``paper`` the motion is drawn anew for every episode, and an estimator that uses only the time costs far more than
    the paper's filter.

    ### Rewards

    By default ("log-relative") ``log(1 + x0) - log(1 + x)``, x the squared error of position, summed over the axes,
    over the nominal variance of a measurement (``N / sampling_interval``), in units of 0.02, its median under the
    action zero, and x0 that of the action zero on the same noise. Outages and jamming dominate the mean of x
    for any filter. "cost" is ``-30 log(1 + x / 30)`` in units of 0.16, the mean cost of the paper's plain scheme.

    ### Starting State

    INS, estimate and reference agree at time zero. The rate errors, the noise levels and the times of
    disturbances are drawn by the scenario.

    ### Episode End

    Truncation after ``horizon`` measurements (500 = 5 s, 50 decisions). There is no termination.

    ### Arguments

    ``scenario``: "random" (default; noise levels over a decade, changes of the receiver noise, outages),
    "paper", "outage", "jamming", "spoof-ramp", "quiet", "outliers", "coloured-receiver". ``control``: "noise", "gain",
    "hypotheses", "mode", "weights". Every field of :class:`LooselyCoupledNavigationParameters` is a keyword.

    ### Version History

    v0: initial version.
    """

    id = ID
    interface = 4
    Parameters = LooselyCoupledNavigationParameters
    World: ClassVar[type[InsGnssWorld]] = InsGnssWorld
    banks: ClassVar[Banks] = {
        "noise": NoiseBank,
        "gain": GainBank,
        "hypotheses": HypothesesBank,
        "mode": SchemeBank,
        "weights": SchemeBank,
    }
    scenarios = SCENARIOS
    modes: tuple[str, ...] = SCHEMES
    # Few outages rule the mean of the error, and the deviation of a return is three times its mean.
    reward: ClassVar[Reward] = Reward(
        "squared error of position over the nominal variance of a measurement",
        "log-relative",
        unit=0.16,
        log_unit=0.02,
    )
    paper_policy: PaperPolicy = PaperPolicy("gain", (0.0,))
    companions: tuple[Any, ...] = (
        Paper(
            "A. S. Benkafo, A. A. Lobaty, Features of application of Kalman-Bucy filters in orientation and "
            "navigation complexes (in Russian)"
        ),
        Actions(
            {
                "noise": "assumed variances of the augmented filter's noises over the modelled ones: "
                "`receiver_scale` to the power of r times a positive, `receiver_reduction` to that of a negative action for the "
                "receiver, `process_scale` for the coloured and the white rate error, r = 0.1 (`noise_reach`); **0 is the paper's "
                "augmented filter**",
                "gain": "gain of this sample, logarithmic from the settled gain of the paper's reduced tuning (0.042, "
                "`K = 4.2 1/s`) at 0 to 1 at +1 (GNSS only) and to `smallest_gain` just above -1; exactly 0 (INS only) at "
                "-1. In continuous time `K = gain / sampling_interval`; **0 is the paper's plain scheme**",
                "hypotheses": "factors r^a in the bank over faults at this fix: odds that the receiver is pulled off (r = 1.05), "
                "that all noises are as modelled (1.05), probability of the receiver's highest level (1.5); variance of the fix "
                "(1.25), process noise of the INS and of the receiver's coloured error (2 each); **0 is the estimator "
                "`fault-bank`**",
                "mode": "the selected filter: plain-white, plain-reduced, augmented",
                "weights": "weights of the three estimates, normalised; all zero is uniform",
            },
            {
                "noise": (
                    "noise_reach",
                    "receiver_scale",
                    "receiver_reduction",
                    "process_scale",
                ),
                "gain": ("smallest_gain",),
                "kalman-net": ("receiver_scale", "receiver_reduction", "process_scale"),
            },
        ),
        TrainedBanks({"kalman-net": KalmanNetBank}),
        Causes(CAUSES, start=50),
        # No better than single measurements throughout; more axes cost more.
        LostTracks(1.0),
        *load_present(("logs:LOG_FORMAT", "live:LIVE_READER"), __package__),
    )

    parameters: LooselyCoupledNavigationParameters

    def set_up(self) -> None:
        """Name the components, one for each axis, and set the paper's policy to its steady-state gain."""
        p = self.parameters
        names = ("position",) if p.axes == 1 else tuple(f"position_{axis}" for axis in AXES[: p.axes])
        group = "position" if p.axes > 1 else ""
        self.components: tuple[Component, ...] = tuple(Component(name, "m", group=group) for name in names)
        action = GainBank(self, "gain").action_for_gain(p.steady_state_gains[1]).item()
        self.paper_policy = PaperPolicy("gain", (action,) * p.axes)
        self.companions = (LostTracks(float(p.axes)), *type(self).companions)


TASK = LooselyCoupledNavigation
