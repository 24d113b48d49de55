"""Tightly coupled INS/GNSS navigation with several hypotheses on the motion.

The experiment and the bank are those of A. N. Moroz, "Adaptive multi-hypothesis algorithm of integrated
secondary processing in an inertial-satellite navigation system" (Minsk, in Russian); its steps are numbered
as there:

    1, 2  p(i) = sum_j pi_ji p(j),  p_ji = pi_ji p(j) / p(i)              filters.imm
    3     mixing of estimates and covariances                             filters.imm
    4     extrapolation under rest, constant velocity, Singer             filters.gnss_ins
    5, 6  residual and update of every filter                             filters.extended_kalman
    7     likelihoods and probabilities                                   filters.imm, in logarithms
    8     combination                                                     filters.imm

Reading: the paper gives the algorithm and almost no values. The step is 0.01 s, because its shortest
adaptation time of 0.01 s must be at least one step. Readings of its motion are in :mod:`.world`, of its
step 3 in :mod:`.banks`.
"""

from typing import Any, ClassVar

from ...extensions import load_present
from ...filters import gnss_ins
from ..contract.causes import Causes
from ..contract.companions import Actions, ArrayMeanings, LostTracks, Paper, PictureMaker, TrainedBanks
from ..contract.model import Model
from ..contract.observation import Array
from ..contract.task import Banks, Component, PaperPolicy, Reward
from . import ID
from .banks import HypothesisBank, NoiseBank, RobustBank
from .causes import CAUSES
from .hypotheses import FaultHypothesesBank
from .kalman_net import KalmanNetBank
from .parameters import HYPOTHESES, SINGER, TightlyCoupledNavigationParameters
from .problem import NavigationProblem
from .scenarios import SCENARIOS
from .world import NavigationWorld


def _picture(model: Model) -> Any:
    from .picture import PICTURE  # imports matplotlib

    return PICTURE(model)


class TightlyCoupledNavigation(NavigationProblem):
    """Tightly coupled INS/GNSS navigation: steer a bank of extended Kalman filters over motion hypotheses.

    ## Description

    An aircraft stands, flies straight, or manoeuvres with up to 40 m/s^2. Every 0.01 s a receiver gives the
    pseudoranges and pseudorange rates of four GLONASS satellites, a strapdown INS its accelerometers and
    the difference of its angles from an attitude reference. Three extended Kalman filters of 17 states
    (position, velocity, acceleration, receiver clock, attitude errors) run side by side, one for each
    hypothesis on the motion: rest, constant velocity, Singer manoeuvre. They are mixed before every step with
    their weights and combined into the estimate after it. Sensors fail for a while in the default
    scenario: a rate channel becomes five times noisier, the accelerometers stick, all rates or two satellites
    are lost.

    The paper is Moroz, adaptive multi-hypothesis measurer of an inertial-satellite navigation system. In its
    own experiment (scenario `paper`) the velocity grows in leg 2 while the accelerometers show nothing: that
    is an accelerometer stuck at zero. Scenario `kinematic` is the physically consistent alternative.

    ## Action Space

    ``Actions`` describes each control. Values outside the box are clipped to it.

    The weights are used for the combination and as the prior of the next mixing.

    ## Observation Space

    A flat `Box`; see `observation_fields` for each component, unit and scale. For every hypothesis the
    normalised innovation squared by sensor group (now, and as a short average; given the groups before it in
    the order of the action `gain`), the log-likelihood relative to the largest, the predicted
    log-probability; the accelerometers, and whether they repeat exactly; the innovations of pseudoranges
    and rates at the combined prediction; availability of every satellite; the time; the last action.
    Innovations and likelihoods, which are unbounded under a wrong hypothesis, are observed as
    ``y / (1 + |y| / 8)`` of ``y = sign(x) log(1 + |x|)``, so below 8.

    ## Rewards

    By default ("log-relative") ``log(1 + x0) - log(1 + x)``, x the cost over 0.1, the median of what the paper's
    algorithm costs in an episode of `random`, and x0 that of the action zero on the same flight and noise. The cost is
    the squared error of position (unit 7.4 m) plus that of velocity (unit 0.25 m/s), the errors of a fix from one epoch
    alone. The unit of the other rewards is 10, between that median and the mean, 60, which is a few lost tracks'.

    ## Starting State

    Position, velocity and acceleration are known up to 10 m, 0.5 m/s and 0.5 m/s^2 per axis, the clock up to
    30 m and 1 m/s, attitude errors up to 1 degree; every hypothesis starts alike with probability 1/3.

    ## Episode End

    Truncation after `horizon` measurements; no termination.

    ## Arguments

    Every field of `TightlyCoupledNavigationParameters` is a keyword, among them `satellites` (slots; fewer than four
    give no complete fix), `increment_sigma` of hypothesis 2, sensor sigmas, faults, and `aperture`: the
    tracking loops, steered by the combined prediction, lose a rate that is 9.36 m/s or a range that is 293 m away from
    it.

    ## Version History

    * v0: first version.
    """

    id = ID
    interface = 3
    Parameters = TightlyCoupledNavigationParameters
    World: ClassVar[type[NavigationWorld]] = NavigationWorld
    banks: ClassVar[Banks] = {
        "robust": RobustBank,
        "gain": NoiseBank,
        "hypotheses": FaultHypothesesBank,
        "evidence": HypothesisBank,
        "mode": HypothesisBank,
        "weights": HypothesisBank,
    }
    scenarios = SCENARIOS
    components: tuple[Component, ...] = (
        *(Component(f"position_{axis}", "m", group="position") for axis in ("east", "north", "up")),
        Component("clock_bias", "m"),
        *(Component(f"velocity_{axis}", "m/s", group="velocity") for axis in ("east", "north", "up")),
        Component("clock_drift", "m/s"),
        *(
            Component(f"acceleration_{axis}", "m/s^2", group="acceleration")
            for axis in ("east", "north", "up")
        ),
        *(Component(f"{angle}_error", "rad", group="attitude") for angle in ("heading", "pitch", "roll")),
        *(Component(f"{angle}_rate_error", "rad/s") for angle in ("heading", "pitch", "roll")),
    )
    modes: tuple[str, ...] = HYPOTHESES
    # A few lost tracks dominate the mean, also for action zero.
    reward: ClassVar[Reward] = Reward(
        "squared position error over (7.4 m)^2 plus squared velocity error over (0.25 m/s)^2, the errors of "
        "a single-epoch fix",
        "log-relative",
        unit=10.0,
        log_unit=0.1,
    )
    paper_policy: PaperPolicy = PaperPolicy("evidence", (0.0, 0.0, 0.0))
    companions: tuple[Any, ...] = (
        Paper(
            "A. N. Moroz, Adaptive multi-hypothesis algorithm of integrated secondary processing in an "
            "inertial-satellite navigation system, Military Academy of the Republic of Belarus (in Russian)"
        ),
        Actions(
            {
                "robust": "noise as under `gain`, by r = 0.3 times the action (`noise_reach`), and the treatment of single readings: "
                "assumed noise of accelerometers while they repeat their last reading exactly, 300 to the power of a "
                "positive action; and Huber's robust update of pseudoranges and of rates, beyond 1.345 standard deviations over a "
                "positive action; **0 is the paper's algorithm**",
                "gain": "assumed standard deviation of the noise over the nominal one, for each "
                "sensor group (pseudoranges, rates, accelerometers, attitude): 300 to the power of a "
                "positive action, 3 to that of a negative one; under the paper's probabilities, for "
                "faults that no weight can compensate; **0 is the paper's algorithm**",
                "hypotheses": "factors r^a in the bank over motion and faults at every measurement: probability that a manoeuvre has "
                "begun (r = 4), that one continues (1.05), odds that the error of a pseudorange has jumped (4), probability of a "
                "rate's highest noise level (1.5); process noise of the motion (2), variance of pseudoranges (2), of rates (2), of "
                "accelerometers (4); **0 is the estimator `fault-hypotheses`**",
                "evidence": "times `evidence_scale` nats, added to the log-posterior of the hypotheses; **0 is the "
                "paper's algorithm**",
                "mode": "the selected hypothesis; the bank mixes with its weights, so this collapses it to one "
                "filter that switches its model",
                "weights": "weights of the three filters, normalised; all zero is uniform",
            },
            {
                "robust": ("noise_reach", "noise_scale", "noise_reduction"),
                "gain": ("noise_scale", "noise_reduction"),
                "kalman-net": ("noise_scale", "noise_reduction"),
            },
        ),
        TrainedBanks({"kalman-net": KalmanNetBank}),
        PictureMaker(_picture),
        Causes(CAUSES, start=100),
        # Five times the errors of a single-epoch fix throughout.
        LostTracks(25.0),
        ArrayMeanings(
            feedback="state that the tracking loops expect at the next measurement, in the order of the components; by default the "
            "estimate, extrapolated as in a manoeuvre"
        ),
        *load_present(("live:LIVE_READER",), __package__),
    )

    def feedback(self, mean: Array, covariance: Array, measurement: Any) -> Array:
        """Return the state that steers the tracking loops, ``(17, N)``: the estimate, extrapolated as a manoeuvre."""
        return gnss_ins.advance(mean, self.axis[:, :, SINGER], self.common.T, self.common.decay)


TASK = TightlyCoupledNavigation
