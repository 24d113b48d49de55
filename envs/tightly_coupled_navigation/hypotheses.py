r"""Control ``hypotheses``: the estimator ``fault-hypotheses``, whose prior and noises the action sets.

The filters stand in ``fault_hypotheses.py``. Before a measurement the hypotheses on the motion have probabilities p',
each range error j is drawn anew with the probability p_j, and the level l of every rate has the probability q'(l). The
action a in [-1, 1]^8 changes what every measurement is weighed with for which it is held:

    p'(begun) <- p'(begun) r1^a1,  p'(manoeuvre) <- p'(manoeuvre) r2^a2                    renormalised by Bayes' rule
    p_j / (1 - p_j) <- r3^a3 p_j / (1 - p_j)
    q'(l) <- q'(l) r4^(a4 s(l))                                                            likewise
    Q <- Q r5^a5,  R_k <- R_k r(5 + k)^a(5 + k)                                            k = 1, 2, 3

begun: a manoeuvre begins at this step; manoeuvre: one goes on; s(l): how far the level lies above the nominal one,
logarithmically, one for the highest; Q: process noise of the 17 states; R_k: variance of pseudoranges, of rates at all
their levels, of accelerometers. Where a rate is missing its levels stay what they were expected to be. All zero is the
estimator itself, bit for bit: an agent begins where the strongest classical filter ends.
"""

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import gymnasium
import numpy

from ...filters import gnss_ins, imm
from ...filters.ordered_sums import ordered_sum, weighted_sum
from ..contract.filter import Initial
from ..contract.observation import BOUNDED_LOG, KEPT_AS_LOG, SHARE, Array, Block
from .banks import HypothesisBank
from .fault_hypotheses import Factors, FaultHypotheses, Hypotheses
from .parameters import HYPOTHESES
from .world import Measurement

if TYPE_CHECKING:
    from .task import TightlyCoupledNavigation

ODDS = ("begun", "manoeuvre", "renewal", "levels")
NOISES = ("motion", "pseudoranges", "rates", "accelerometers")
REACH = (4.0, 1.05, 4.0, 1.5, 2.0, 2.0, 2.0, 4.0)
"""Factors by which actions of one multiply: so small that white noise of deviation one, with which a new policy
explores, costs a twentieth at most."""


class SteeredHypotheses(NamedTuple):
    """The bank over motion and faults at one moment; four hypotheses: those on the motion, and one that has begun."""

    mean: Array
    """``(17, N)``."""
    covariance: Array
    """Of all hypotheses together, ``(17, 17, N)``."""
    memory: Hypotheses
    """After the last action."""
    probabilities: Array
    """Of rest, constant velocity and manoeuvre then, ``(3, N)``."""
    last_action: Array
    """``(8, N)``."""
    log_predicted: Array
    """Logarithms of the probabilities before the readings, ``(4, N)``."""
    log_likelihood: Array
    """Of the readings under each hypothesis, ``(4, N)``."""
    nis: Array
    """Normalised innovation squared by group of sensors, each given those before it, ``(4, 4, N)``."""
    average_nis: Array
    """Short average of the same per reading, ``(4, 4, N)``."""
    repeated: Array
    """1 where the accelerometers repeat the readings before exactly, ``(N,)``."""
    range_innovation: Array
    """Of all hypotheses together: S pseudoranges, m, S rates, m/s; ``(2 S, N)``."""
    expected: Array
    """Probabilities after the readings if the action is zero, ``(4, N)``."""
    range_error: Array
    """Error of each pseudorange then, m, ``(S, N)``."""
    noisy: Array
    """Probability then that the noise of a rate is above its nominal level, ``(S, N)``."""
    between: Array
    """1 where the C/N0 tells of houses, ``(N,)``."""
    log_density: Array
    """Of the readings as the estimator predicts them, nats, ``(N,)``."""
    squared_distance: Array
    """Their normalised innovation squared by the estimator, ``(N,)``."""
    degrees: Array
    """How many readings it takes in, ``(N,)``."""


class FaultHypothesesBank(HypothesisBank):
    """The bank over motion and faults, steered by factors of its probabilities and of its noises."""

    hypotheses = (*HYPOTHESES, "begun")

    def __init__(self, task: "TightlyCoupledNavigation", control: str) -> None:
        super().__init__(task, control)
        self.bank = FaultHypotheses(task)
        levels = self.bank.prior.levels
        self.log_reach = task.constant([math.log(factor) for factor in REACH])[:, None]
        self.heights = task.constant([math.log(level) / math.log(levels[-1]) for level in levels])[:, None]

    @property
    def action_space(self) -> gymnasium.Space:
        """Odds, then noises."""
        return gymnasium.spaces.Box(-1.0, 1.0, (len(self.actions),), numpy.float32)

    @property
    def actions(self) -> Sequence[str]:
        """What the components of the action multiply."""
        return (*ODDS, *NOISES)

    @property
    def blocks(self) -> Sequence[Block]:
        """What the paper's bank shows, and what this one believes."""
        xp, p, task = self.xp, self.parameters, self.task
        slots = [str(slot) for slot in p.satellites]
        units = task.constant([0.5 * math.log(2.0 * math.pi * r) for r in task.sensor_variance])[:, None]
        return (
            *super().blocks,
            Block(
                "log_density", lambda f, y: f.log_density + ordered_sum(y.available * units),
                "the log-density of the readings in units of their nominal sigmas, nats", shown=BOUNDED_LOG,
                over_interval="mean",
            ),
            Block(
                "probability", lambda f, y: xp.clip(f.expected, 0.0, 1.0),
                "probability after the readings if the action is zero", self.hypotheses, SHARE,
            ),
            Block(
                "range_error", lambda f, y: f.range_error / task.sensors[0].sigma,
                "error of the pseudorange then over sigma", slots, BOUNDED_LOG,
            ),
            Block(
                "noisy_rate", lambda f, y: xp.clip(f.noisy, 0.0, 1.0),
                "probability then that the rate is noisier than nominal", slots, SHARE,
            ),
            Block(
                "between_houses", lambda f, y: f.between, "1 where a C/N0 is not that of an open sky", shown=SHARE,
                over_interval="mean",
            ),
            Block(
                "position_sigma", lambda f, y: 0.5 * xp.log(ordered_sum(f.covariance[i, i] for i in range(3))),
                "the sigma of the position after the last action, m", shown=KEPT_AS_LOG,
            ),
        )  # fmt: skip

    def start(self, initial: Initial) -> SteeredHypotheses:  # type: ignore[override]
        """Start where the estimator starts."""
        xp, S, M = self.xp, self.task.satellites, len(self.hypotheses)
        memory = self.bank.start_bank(initial)
        none = 0.0 * initial.mean[0]
        probabilities = xp.concat([memory.probabilities, none[None]])
        nis = xp.stack([xp.stack([none] * M)] * len(self.task.sensors))
        return SteeredHypotheses(
            mean=initial.mean,
            covariance=initial.covariance,
            memory=memory,
            probabilities=memory.probabilities,
            last_action=xp.stack([none] * len(self.actions)),
            log_predicted=imm.log_probabilities(probabilities),
            log_likelihood=nis[0],
            nis=nis,
            average_nis=nis + 1.0,
            repeated=none,
            range_innovation=xp.stack([none] * (2 * S)),
            expected=probabilities,
            range_error=xp.stack([none] * S),
            noisy=1.0 - memory.levels[0],
            between=none,
            log_density=none,
            squared_distance=none,
            degrees=none,
        )

    def feedback(self, state: SteeredHypotheses, measurement: Any) -> Array | None:  # type: ignore[override]
        """None: the tracking loops expect what follows from the estimate."""
        return None

    def predict(  # type: ignore[override]
        self, state: SteeredHypotheses, measurement: Measurement
    ) -> SteeredHypotheses:
        """See what the estimator would make of the measurement; :meth:`act` begins before it."""
        xp, task = self.xp, self.task
        found = self.bank.update_bank(measurement, state.memory)
        dtype = found.mean.dtype
        log_predicted = imm.log_probabilities(found.predicted)
        change = found.squares / self._present(measurement) - state.average_nis
        memory = found.memory
        return state._replace(
            log_predicted=log_predicted,
            log_likelihood=found.log_likelihoods,
            nis=found.squares,
            average_nis=state.average_nis + (1.0 / self.parameters.averaging_measurements) * change,
            repeated=xp.astype(found.repeated, dtype) * measurement.available[task.sensors[2].readings.start],
            range_innovation=weighted_sum(found.predicted, found.residual[task.tracked]),
            expected=imm.mode_posterior(log_predicted, found.log_likelihoods),
            range_error=weighted_sum(memory.probabilities, memory.means[gnss_ins.SIZE :]),
            noisy=1.0 - memory.levels[0],
            between=xp.astype(found.between, dtype),
            log_density=found.log_likelihood,
            squared_distance=found.nis,
            degrees=found.degrees,
        )

    def act(  # type: ignore[override]
        self, state: SteeredHypotheses, measurement: Measurement, action: Array
    ) -> SteeredHypotheses:
        """Predict and update as the estimator does, with the probabilities and noises that the action sets."""
        xp = self.xp
        action = xp.astype(xp.clip(action, -1.0, 1.0), state.mean.dtype)
        logarithms = self.log_reach * action
        factors = Factors(*xp.exp(logarithms))
        levels = xp.exp(self.heights * logarithms[ODDS.index("levels")])
        found = self.bank.update_bank(measurement, state.memory, factors._replace(levels=levels))
        return state._replace(
            mean=found.mean,
            covariance=found.covariance,
            memory=found.memory,
            probabilities=found.memory.probabilities,
            last_action=action,
        )

    def covariance(self, state: SteeredHypotheses) -> Array:  # type: ignore[override]
        """Of all hypotheses together, ``(17, 17, N)``."""
        return state.covariance

    def records(  # type: ignore[override]
        self, state: SteeredHypotheses, measurement: Measurement
    ) -> dict[str, Array]:
        """As the paper's bank, likelihood and NIS as the estimator finds them."""
        xp, rates = self.xp, self.task.sensors[1]
        beyond = xp.abs(state.range_innovation[rates.readings]) > self.parameters.rate_aperture
        return {
            "mode_probability": state.probabilities,
            "nis": state.squared_distance,
            "nis_degrees": state.degrees,
            "log_likelihood": state.log_density,
            "rate_outside_aperture": xp.astype(xp.any(beyond, axis=0), state.mean.dtype),
        }
