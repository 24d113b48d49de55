"""ManeuveringTarget: a radar track of an aircraft that turns, with alpha-beta filters of adjustable gain.

Source: P. A. Bakulev, M. I. Sychev and Nguyen Trong Luu, "Tracking a manoeuvring target with an IMM
algorithm over two alpha-beta filters" (in Russian). Equation numbers are theirs as far as they print them;
the equations are in ``filters/alpha_beta.py``, ``filters/imm.py`` and ``filters/polar.py``.
"""

from typing import Any, ClassVar

from ...extensions import load_present
from ..contract.causes import Causes
from ..contract.companions import Actions, LostTracks, Paper, PictureMaker, TrainedBanks
from ..contract.model import Model
from ..contract.observation import Array
from ..contract.task import Banks, Component, PaperPolicy, Reward
from . import ID
from .banks import FilterBank, GainBank, GainsBank
from .causes import CAUSES
from .clutter import ReportedTrack
from .hypotheses import HypothesesBank
from .kalman_net import KalmanNetBank
from .parameters import ManeuveringTargetParameters
from .problem import TargetProblem
from .scenarios import SCENARIOS
from .student import RadarStudentBank
from .unscented_banks import ScalingBank, SigmaPointsBank
from .world import RadarWorld


def _picture(model: Model) -> Any:
    from .picture import PICTURE  # imports matplotlib

    return PICTURE(model)


class ManeuveringTarget(TargetProblem):
    """Radar tracking of a manoeuvring aircraft: steer an IMM of fixed-gain filters (Bakulev, Sychev, Nguyen).

    ## Description

    A surveillance radar scans every 6 s and measures the position of one aircraft with errors of 100 m in
    range and 0.25 degrees in azimuth. The aircraft flies straight, sometimes turns or changes speed, and
    flies straight again. A small filter gain is quiet on the straight legs and lags far behind in a
    manoeuvre; a large gain follows and is noisy. The paper runs two filters of different gain that mix on
    their weights, an interacting multiple model (IMM). The agent sees their innovations and corrects Bayes'
    rule for the weights, states the weights, or moves the filters' gains; or it sets the gain of one filter
    alone. Zero ``evidence`` is exactly the paper's IMM, and so is zero ``gains``.

    ## Action Space

    ``Actions`` describes each control. Values outside the box are clipped to it.

    ## Observation Space

    A flat `Box` of float64; `env.unwrapped.observation_fields` lists name, unit and scale of every component.
    `gain`: innovations over their predicted sigma, log(1 + normalised innovation squared), exponential
    averages of both, the share 1 - R/S of the innovation variance that is the filter's own, the last alpha,
    the measurement sigma, scans since the start, whether this scan saw the target and the time since the last one that
    did.
    Bank: the same for each filter, log-likelihoods relative to
    the largest, log predicted mode probabilities, last weights, under `gains` the last gains. Large values are
    compressed by sign(x) log(1 + |x|).

    ## Rewards

    By default ("log-relative") `log(1 + x0) - log(1 + x)`, x the squared position error over `range_sigma` squared in
    units of 8.0, the mean cost of the paper's IMM where half of the flights have regular scans, and x0 that of
    the action zero on the same flight and noise.
    "relative" compares with the IMM under every control, and compresses nothing but lost tracks.

    ## Starting State

    The track starts at the true state plus errors of the measurement's size: sigma in position and
    sqrt(2) sigma / T in velocity, the same for all filters (24).

    ## Scans that miss the target or come early

    In the paper every scan sees the target, T seconds after the one before. With `detection_probability` below 1 some do
    not: `available` is 0 then, the measurement zero (an estimator gets NaN), the filters' state the predicted one and
    the weights the predicted ones (13), whatever the action. With `scan_jitter` j scan k comes at T (k - j u), u
    uniform on [0, 1): the filters predict over the time that has passed, and estimate and truth are those of that time.
    The velocity's gain is beta over the time since the last measurement, for which the innovation has grown.

    ## Episode End

    Truncation after `horizon` scans; there is no termination.

    ## Arguments

    Every field of `ManeuveringTargetParameters` is a keyword of `gym.make`, beside `control`, `scenario`,
    `reward` and `render_mode`.

    ## Version History

    * v0: first release
    """

    id = ID
    # 2: scans may miss the target, and fields say so; under `gain` and `gains` the same action is another velocity gain
    # then.
    interface = 2
    Parameters = ManeuveringTargetParameters
    World: ClassVar[type[RadarWorld]] = RadarWorld
    banks: ClassVar[Banks] = {
        "evidence": FilterBank,
        "gains": GainsBank,
        "gain": GainBank,
        "hypotheses": HypothesesBank,
        "mode": FilterBank,
        "sigma-points": SigmaPointsBank,
        "unscented": ScalingBank,
        "weights": FilterBank,
    }
    scenarios = SCENARIOS
    components: tuple[Component, ...] = (
        Component("position_x", "m", group="position"),
        Component("position_y", "m", group="position"),
        Component("velocity_x", "m/s", group="velocity"),
        Component("velocity_y", "m/s", group="velocity"),
    )
    # The cost of turns dominates the noise of the reward, also for action zero; a logarithm, because a few
    # hard turns would hide what an action changes on all other flights.
    reward: ClassVar[Reward] = Reward(
        "squared position error over the squared range sigma",
        "log-relative",
        unit=8.0,
    )
    paper_policy: PaperPolicy = PaperPolicy("evidence", (0.0, 0.0))
    companions: tuple[Any, ...] = (
        Paper(
            "P. A. Bakulev, M. I. Sychev, Nguyen Trong Luu, Tracking a manoeuvring target with an IMM algorithm "
            "over two alpha-beta filters (in Russian)"
        ),
        Actions(
            {
                "evidence": "times 2 nats (`evidence_scale`), added to the log-posterior of each mode; **0 is the paper's IMM**",
                "gains": "position gains of the filters of the paper's IMM: `logit alpha = logit gain + gain_logits a`, with "
                "the beta that follows from it; **0 is the paper's IMM**",
                "gain": "position gain alpha of one filter, linear over `alpha_range`; 0 is alpha = 0.5; "
                "beta = alpha^2 / (2 - alpha)",
                "hypotheses": "factors r^a in the semi-Markov Gaussian sum at this scan: odds that a manoeuvre has begun (r = 3), "
                "has ended (9), is a turn (1.5); predicted covariances in straight flight and in manoeuvres (1.25 each); variance "
                "of the measurement (1.25); **0 is the estimator `semi-markov`**",
                "mode": "the selected filter of the bank; the bank collapses to one filter that switches",
                "sigma-points": "factors 5^a of the weights of the 11 sigma points in the estimator `unscented-turn` at this scan: "
                "ten for the mean, normalised, eleven for the covariance (MA-UKF); **0 is that estimator**",
                "unscented": "factors r^a in the estimator `unscented-turn` at this scan: spread of the sigma points "
                "(r = sqrt(2)), variances of the acceleration and of the change of the turn rate (30 each), variance of "
                "the measurement (10); **0 is that estimator**",
                "weights": "weights of the bank, normalised; all zero is uniform",
            },
            {"evidence": ("evidence_scale",)},
        ),
        TrainedBanks({"kalman-net": KalmanNetBank, "student": RadarStudentBank}),
        PictureMaker(_picture),
        Causes(CAUSES),
        # An error of a kilometre throughout: ten times that of a plot.
        LostTracks(100.0),
        *load_present(
            (
                "logs:LOG_FORMAT",
                "live:LIVE_READER",
                "flights:FLIGHT_SCENARIOS",
            ),
            __package__,
        ),
    )

    def set_up(self) -> None:
        """Name the hypotheses, and set the paper's policy."""
        super().set_up()
        count = len(self.parameters.gains)
        self.flights: tuple[int, ...] = self.parameters.track_scans
        self.modes: tuple[str, ...] = tuple(f"mode_{j + 1}" for j in range(count))
        self.paper_policy = PaperPolicy("evidence", (0.0,) * count)
        self.closes_loop: bool = self.parameters.cluttered

    def feedback(self, mean: Array, covariance: Array, measurement: Any) -> ReportedTrack:
        """Return the filter's estimate, around which the radar returns plots in clutter."""
        return ReportedTrack(mean, covariance)


TASK = ManeuveringTarget
