"""ManeuveringTarget: a radar track of an aircraft that turns, with alpha-beta filters of adjustable gain.

Source: P. A. Bakulev, M. I. Sychev and Nguyen Trong Luu, "Tracking a manoeuvring target with an IMM
algorithm over two alpha-beta filters" (in Russian). Equation numbers are theirs as far as they print them;
the mathematics stands in ``filters/alpha_beta.py``, ``filters/imm.py`` and ``filters/polar.py``.
"""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy

from ..contract.model import Model
from ..contract.observation import Array
from ..contract.parameters import check, field_limits, freeze
from ..contract.task import Component, PaperPolicy, Scenario, Task
from ..data.flights import Flights, flight_of
from ..data.trajectory import Trajectory
from . import ID
from .banks import FilterBank, GainBank, SteeredFilterBank
from .causes import CAUSES
from .clutter import Track
from .hypotheses import HypothesesBank
from .kalman_net import KalmanNetBank
from .live import PlotInput
from .logs import FARTHEST_RANGE, LOG_FORMAT, has_regular_scans
from .parameters import ManeuveringTargetParameters
from .scenarios import SCENARIOS
from .student import RadarStudentBank
from .world import RadarWorld

MOST_SCANS = 100_000
"""Of all flights of a set together: a week of flying at 6 s."""


class ManeuveringTarget(Task):
    """Radar tracking of an aircraft that manoeuvres, with fixed-gain filters (Bakulev, Sychev, Nguyen).

    ## Description

    A surveillance radar scans every 6 s and measures the position of one aircraft with errors of 100 m in
    range and 0.25 degrees in azimuth. The aircraft flies straight, sometimes turns or changes speed, and
    flies straight again. A small filter gain is quiet on the straight legs and lags far behind in a
    manoeuvre; a large gain follows and is noisy. The paper runs two filters of different gain that mix on
    their weights, an interacting multiple model (IMM). The agent sees their innovations and corrects Bayes'
    rule for the weights, states the weights, or moves the filters' gains; or it sets the gain of one filter
    alone. Zero ``evidence`` is exactly the paper's IMM, and so is zero ``gains``.

    ## Action Space

    What each control means stands in ``actions``. Values outside the box are taken at its edge.

    ## Observation Space

    A flat `Box` of float64; `env.unwrapped.observation_fields` lists name, unit and scale of every component.
    `gain`: innovations over their predicted sigma, log(1 + normalised innovation squared), exponential
    averages of both, the share 1 - R/S of the innovation variance that is the filter's own, the last alpha,
    the measurement sigma, scans since the start, whether this scan saw the target and the time since the last one that did.
    Bank: the same for each filter, log-likelihoods relative to
    the largest, log predicted mode probabilities, last weights, under `gains` the last gains. Large values are
    compressed by sign(x) log(1 + |x|).

    ## Rewards

    By default ("log-relative") `log(1 + x0) - log(1 + x)`, x the squared position error over `range_sigma` squared in
    units of 8.0, what the paper's IMM is charged on average where half of the flights have regular scans, and x0 that of
    the action zero on the same flight and noise.
    "relative" compares with the IMM under every control, and compresses nothing but lost tracks.

    ## Starting State

    The track starts at the true state plus errors of the measurement's size: sigma in position and
    sqrt(2) sigma / T in velocity, the same for all filters (24).

    ## Scans that miss the target or come early

    In the paper every scan sees the target, T seconds after the one before. With `detection_probability` below 1 some do
    not: `available` is 0 then, the measurement zero (an estimator gets NaN), the filters' state the predicted one and
    the weights the predicted ones (13), whatever the action. With `scan_jitter` j scan k comes at T (k - j u), u uniform on [0, 1): the filters
    predict over the time that has passed, and estimate and truth are those of that time. The velocity's gain is
    beta over the time since the last measurement, for which the innovation has grown.

    ## Episode End

    Truncation after `horizon` scans; there is no termination.

    ## Arguments

    Every field of `ManeuveringTargetParameters` is a keyword of `gym.make`, beside `control`, `scenario`,
    `reward` and `render_mode`.

    ## Version History

    * v0: first release
    """

    id = ID
    # 2: scans may miss the target, and fields say so; under `gain` and `gains` the same action is another velocity gain then.
    interface = 2
    paper_source = (
        "P. A. Bakulev, M. I. Sychev, Nguyen Trong Luu, Tracking a manoeuvring target with an IMM algorithm "
        "over two alpha-beta filters (in Russian)"
    )
    Parameters = ManeuveringTargetParameters
    World = RadarWorld
    log_format = LOG_FORMAT
    live_input = PlotInput
    actions = {
        "evidence": "times 2 nats (`evidence_scale`), added to the log-posterior of each mode; **0 is the paper's IMM**",
        "gains": "position gains of the filters of the paper's IMM: `logit alpha = logit gain + gain_logits a`, with "
        "the beta that belongs to it; **0 is the paper's IMM**",
        "gain": "position gain alpha of one filter, linear over `alpha_range`; 0 is alpha = 0.5; "
        "beta = alpha^2 / (2 - alpha)",
        "hypotheses": "factors r^a in the semi-Markov Gaussian sum at this scan: odds that a manoeuvre has begun (r = 3), "
        "has ended (9), is a turn (1.5); predicted covariances in straight flight and in manoeuvres (1.25 each); variance "
        "of the measurement (1.25); **0 is the estimator `semi-markov`**",
        "mode": "the filter of the bank that is believed; the bank collapses to one filter that switches",
        "weights": "weights of the bank, normalised; all zero is uniform",
    }
    banks = {
        "evidence": FilterBank,
        "gains": SteeredFilterBank,
        "gain": GainBank,
        "hypotheses": HypothesesBank,
        "mode": FilterBank,
        "weights": FilterBank,
    }
    trained_banks = {"kalman-net": KalmanNetBank, "student": RadarStudentBank}
    reach = {"evidence": ("evidence_scale",)}
    scenarios = SCENARIOS
    components = (
        Component("position_x", "m"),
        Component("position_y", "m"),
        Component("velocity_x", "m/s"),
        Component("velocity_y", "m/s"),
    )
    groups = {"position": ("position_x", "position_y"), "velocity": ("velocity_x", "velocity_y")}
    causes = CAUSES
    cost_description = "squared position error over the squared range sigma"
    # An error of a kilometre throughout: ten times that of a plot.
    lost_cost = 100.0
    reward_unit = 8.0
    # What a turn costs rules the noise of the reward, and who does nothing pays for it too; a logarithm, because a few
    # hard turns would hide what an action changes on all other flights.
    reward = "log-relative"
    paper_policy = PaperPolicy("evidence", (0.0, 0.0))

    parameters: ManeuveringTargetParameters

    def set_up(self) -> None:
        """Name the hypotheses and the paper's action."""
        count = len(self.parameters.gains)
        self.flights = self.parameters.track_scans
        self.regular = self.parameters.regular and (
            self.recording is None or has_regular_scans(self.recording, self.parameters)
        )
        """Whether every scan sees the target, all of them one ``sampling_interval`` apart."""
        self.modes = tuple(f"mode_{j + 1}" for j in range(count))
        self.paper_policy = PaperPolicy("evidence", (0.0,) * count)

    def is_closed_loop(self) -> bool:
        """Whether there is clutter."""
        return self.parameters.cluttered

    def feedback(self, mean: Array, covariance: Array, measurement: Any) -> Track:
        """Track about which the radar looks for plots."""
        return Track(mean, covariance)

    def _sampling_interval(self) -> float | None:
        """Return the time between scans, s; None where some miss the target, or come early."""
        return self.parameters.sampling_interval if self.regular else None

    def picture(self, model: Model) -> Any:
        """Return what draws an episode; imported here, because it brings matplotlib."""
        from .picture import PICTURE

        return PICTURE(model)

    @classmethod
    def _scenario_of_trajectory(cls, trajectory: Trajectory, keywords: Mapping[str, Any]) -> Scenario:
        """Fly a user's trajectory, sampled once a scan and straight on beyond its end."""
        interval, _, horizon = cls._sampling(keywords)
        farthest = float(numpy.hypot(*trajectory.position.T).max())
        if farthest > FARTHEST_RANGE:
            raise ValueError(
                f"trajectory {trajectory.name!r} goes {farthest / 1e3:,.0f} km from the radar at the origin; "
                f"its range ends at {FARTHEST_RANGE / 1e3:,.0f} km (positions are metres)"
            )
        scans = trajectory.intervals(interval)
        if scans < 2:
            raise ValueError(
                f"trajectory {trajectory.name!r} lasts {trajectory.duration:g} s, which is less than two scans "
                f"of {interval:g} s: give a smaller sampling_interval"
            )
        horizon = scans if horizon is None else horizon
        track = trajectory.resample(interval, horizon + 2)
        return Scenario(
            trajectory.name,
            "A flight given by its positions.",
            {"flight": "track", "horizon": horizon, "track": tuple(map(tuple, track.tolist()))},
        )

    @classmethod
    def _sampling(cls, keywords: Mapping[str, Any]) -> tuple[float, int, int | None]:
        """Sampling interval (s), scans for which an action holds, and the horizon if it is among the keywords."""
        found: dict[str, Any] = {}
        for name in ("sampling_interval", "decision_interval", "horizon"):
            found[name] = getattr(ManeuveringTargetParameters, name) if name != "horizon" else None
            if name in keywords:
                found[name] = freeze(keywords[name])
                check(name, found[name], *field_limits(ManeuveringTargetParameters)[name])
        return found["sampling_interval"], found["decision_interval"], found["horizon"]

    @classmethod
    def scenario_of_flights(cls, flights: Trajectory | Flights, keywords: Mapping[str, Any]) -> Scenario:
        """Fly a user's flights, one in every episode, each to its end or for the horizon that is asked for."""
        if isinstance(flights, Trajectory):
            return cls._scenario_of_trajectory(flights, keywords)
        interval, held, horizon = cls._sampling(keywords)
        used, notes = flights.flyable(interval, FARTHEST_RANGE)
        if len(used) == 1:
            return replace(cls._scenario_of_trajectory(used[0], keywords), notes=tuple(notes))
        scans = [flight.intervals(interval) for flight in used]
        if horizon is not None:
            scans = [min(count, horizon) for count in scans]
        scans = [max(count - count % held, held) for count in scans]
        if sum(scans) > MOST_SCANS:
            raise ValueError(
                f"the flights of {flights.name!r} have {sum(scans):,} scans of {interval:g} s together, more than "
                f"{MOST_SCANS:,}: fly fewer, or give a smaller horizon"
            )
        tracks = [flight.resample(interval, count + 2) for flight, count in zip(used, scans, strict=True)]
        return Scenario(
            flights.name,
            "Flights given by their positions.",
            {
                "flight": "track",
                "horizon": max(scans),
                "track": tuple(map(tuple, numpy.concatenate(tracks, axis=1).tolist())),
                "track_scans": tuple(scans),
            },
            flights=tuple(map(flight_of, used)),
            notes=tuple(notes),
        )


TASK = ManeuveringTarget
