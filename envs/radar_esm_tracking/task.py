"""RadarEsmTracking: one range channel, radar and ESM together, a target of unknown manoeuvrability.

Source: S. L. Ivanov and D. V. Seliverstov, on the joint processing of an airborne radar and an electronic
support measures (ESM) station with recognition of the target's class (in Russian). Equation numbers are
theirs; the equations are in ``filters/class_fusion.py`` and ``filters/singer.py``.
"""

from typing import Any, ClassVar

from ...extensions import load_present
from ...filters.ordered_sums import weighted_sum
from ..contract.causes import Causes
from ..contract.companions import Actions, LoopRecords, LostTracks, Paper, PictureMaker, TrainedBanks
from ..contract.model import Episode, Model
from ..contract.observation import Array
from ..contract.task import Banks, Component, PaperPolicy, Reward
from . import ID
from .banks import ClassBank, one_hot
from .causes import causes_of
from .hypotheses import HypothesesBank
from .kalman_net import KalmanNetBank
from .parameters import RadarEsmTrackingParameters
from .problem import RadarEsmProblem
from .scenarios import SCENARIOS
from .world import RadarEsmWorld


def _picture(model: Model) -> Any:
    from .picture import PICTURE  # imports matplotlib

    return PICTURE(model)


def _records(model: Model, episode: Episode, kept: dict[str, Array]) -> dict[str, Array]:
    task: Any = model.task
    covariance = model.covariance(episode)
    own = {f"variance_{c.name}": covariance[i, i] for i, c in enumerate(task.components)}
    if "mode_probability" in kept and task.recording is None:
        is_true = one_hot(episode.truth.target_class, task.classes, task.xp)
        own["true_class_probability"] = weighted_sum(is_true, kept["mode_probability"])
    return own


class RadarEsmTracking(RadarEsmProblem):
    """Fusion of radar and ESM for tracking and target classification: weight a filter for each class.

    ## Description

    A fighter's radar measures range and range rate of one air target every 0.5 s, with errors of 3000 m and
    20 m/s. The target may be anything from an early-warning aircraft (class S0) to an agile fighter or a
    missile (S2), and the filter needs the manoeuvre model of the right class: on an S0 target
    the filter for S2 is 4.5 times worse in acceleration. A bank runs one Kalman filter with Singer's
    manoeuvre model for each class. Every 2 s the electronic support measures (ESM) station, which receives
    the target's own emissions, decides for an emitter type; the classes have different distributions of
    types. A gate on the difference of the radar's and the ESM's bearings decides whether both have one
    target and the decision is used.

    The agent observes the innovations of the filters and the ESM decisions, and weights the classes. Zero
    ``evidence`` is the paper's algorithm. In order (8)-(10): every filter predicts and updates with the radar
    measurement under the class at the previous scan; the last weights times the radar likelihoods go
    through the class transition, and the filters mix on them; the agent observes the result; the ESM
    decision is the last factor, and the action gives P(s(k)) given everything to k. Evidence is added to the
    weights of this scan only: Bayes' rule continues from its own posterior. ``mode`` and ``weights`` replace
    the posterior, and the next transition and mixing start from their weights.

    With a constant class (``class_transition`` the identity, the default) nothing mixes: the action decides
    only which combination of the filters is reported now. It does not affect the filters, and the problem is
    myopic: a discount of 0 suffices. Under ``evidence`` this holds for any transition.

    `paper` redraws the emitter type for every decision, which is the assumption behind (8) and makes it
    exactly Bayesian for the radar and the decisions that pass the gate. A real target has one type: in
    `fixed-type` and all other scenarios the same rule counts one fact repeatedly and becomes certain of a
    wrong class.

    Everything is linear, so range and speed of the target have no influence on any error.

    ## Action Space

    ``Actions`` describes each control. Values outside the box are clipped to it. An action holds for
    ``decision_interval`` scans, four by default: from one ESM decision to the next.

    ## Observation Space

    A flat `Box` of float64; `env.unwrapped.observation_fields` lists name, unit and scale of every component.
    For each class: the whitened innovations of range and range rate (the second is the part that the first does not
    explain; their squares add to the normalised innovation squared), log(1 + that square),
    exponential averages of these, the radar log-likelihood of this scan and its sum since the start, both
    relative to the largest. Of the ESM: the decision (one-hot, or "none"; "refused by the gate" appears
    together with the decision), counts of used and of refused decisions, the bearing difference
    over the gate. The last weights and the time. Large values are compressed by y = sign(x) log(1 + |x|), the sum
    of the log-likelihoods, which grows without limit, by y / (1 + |y| / 8).
    Only differences between measurements and predictions enter: range and speed themselves do not.

    ## Rewards

    By default ("log-relative") `log(1 + x0) - log(1 + x)`, x the mean of three squared errors (range over
    `range_scale`, range rate over `range_rate_scale`, acceleration over `acceleration_scale`) in units of 0.05, and
    x0 that of the action zero on the same noise. Most scans cost more than 0.05, so the reward is about the logarithm
    of a ratio: a few mistaken classes do not dominate it. "cost" is `-30 log(1 + x / 30)` in units of 0.3, the mean cost of
    the paper's algorithm.

    ## Starting State

    The first radar measurement (scan 0) starts all filters: its range and range rate, no acceleration, with
    variances `range_sigma`^2, `range_rate_sigma`^2, `acceleration_sigma`^2 of the class. The true
    acceleration is drawn with the latter variance. The ESM decides at scan 0 too: that decision multiplies
    the prior, and the first observation, of scan 1, contains it in the counts and in the last weights.

    ## Episode End

    Truncation after `horizon` scans (120, 30 decisions); there is no termination. The range is a coordinate of a linear model: a
    near and fast target may pass through zero.

    ## Arguments

    Every field of `RadarEsmTrackingParameters` is a keyword of `gym.make`, in addition to `control`,
    `scenario`, `reward` and `render_mode`.

    ## Version History

    * v0: first release
    """

    id = ID
    interface = 4
    Parameters = RadarEsmTrackingParameters
    World: ClassVar[type[RadarEsmWorld]] = RadarEsmWorld
    banks: ClassVar[Banks] = {
        "evidence": ClassBank,
        "mode": ClassBank,
        "weights": ClassBank,
        "hypotheses": HypothesesBank,
    }
    scenarios = SCENARIOS
    components: tuple[Component, ...] = (
        Component("range", "m"),
        Component("range_rate", "m/s"),
        Component("acceleration", "m/s^2"),
    )
    modes: tuple[str, ...] = ("S0", "S1", "S2")
    # The noise of the track is most of the cost, and no weight changes it. The reward is logarithmic, because a few
    # mistaken classes would hide the effect of actions in all other episodes.
    reward: ClassVar[Reward] = Reward(
        "mean of the squared errors of range, range rate and acceleration over range_scale, range_rate_scale "
        "and acceleration_scale",
        "log-relative",
        unit=0.3,
        log_unit=0.05,
    )
    paper_policy: PaperPolicy = PaperPolicy("evidence", (0.0, 0.0, 0.0))
    companions: tuple[Any, ...] = (
        Paper(
            "S. L. Ivanov, D. V. Seliverstov, Joint processing of radar and electronic support measures with "
            "recognition of the target's class (in Russian)"
        ),
        Actions(
            {
                "evidence": "times `evidence_scale` nats, added to log P; **0 is the paper's algorithm**",
                "mode": "the class whose filter is used",
                "weights": "class probabilities, normalised; all zero is uniform",
                "hypotheses": "factors r^a in Bayes' rule over class, its change and emitters at every scan: probability of "
                "each class (r = 1.15), odds that the class has changed (1.3) and of a second emitter (2), process noise "
                "(2), variance of the radar (1.35); **0 is `exact-bayes`**",
            },
            {"evidence": ("evidence_scale",)},
        ),
        TrainedBanks({"kalman-net": KalmanNetBank}),
        PictureMaker(_picture),
        # Errors of three of the scales throughout.
        LostTracks(9.0),
        LoopRecords(_records),
        *load_present(("logs:LOG_FORMAT", "live:LIVE_READER"), __package__),
    )

    def set_up(self) -> None:
        """Set the names of the classes, the paper's policy and the causes of cost."""
        super().set_up()
        self.modes = self.parameters.class_names
        self.companions = (Causes(causes_of(self.modes)), *type(self).companions)
        self.paper_policy = PaperPolicy("evidence", (0.0,) * self.classes)


TASK = RadarEsmTracking
