"""Budgeted sensing in one file: four manoeuvring targets, and one beam that looks at one of them at a time.

    filtergym evaluate budgeted_sensing:mine/BudgetedSensing-v0 --policy round-robin --policy greedy --policy rollout
    python docs/examples/budgeted_sensing.py

Each target flies along a line of its own, at constant velocity and now and then with an acceleration that lasts for
3 to 12 s. A semi-Markov bank follows each (:mod:`filtergym.filters.semi_markov`). The action is which target the next
measurement is of. The measurements of the others remain hidden, so the noise does not depend on the choice.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import gymnasium
import numpy
from filtergym.baselines.table import Baselines
from filtergym.envs.contract.companions import Actions
from filtergym.envs.contract.draws import Draws
from filtergym.envs.contract.filter import Bank, Initial
from filtergym.envs.contract.observation import LOG1P, SIGNED_LOG, Array, Block
from filtergym.envs.contract.parameters import TaskParameters, parameter
from filtergym.envs.contract.task import Component, PaperPolicy, Reward, Scenario, Task
from filtergym.envs.contract.world import World
from filtergym.evaluation.competitors.kinds import Policy, RandomPolicy
from filtergym.filters import imm, kalman, semi_markov
from filtergym.filters.array_namespace import namespace
from filtergym.filters.semi_markov import AgedHypotheses
from filtergym.filters.small_matrices import outer
from scipy.special import erf

import filtergym

TARGETS, BEGIN, SHORTEST, LONGEST = 4, 0.04, 3, 12
"""Targets; probability that a manoeuvre begins before a second; its durations, s, all alike."""
HAZARDS = semi_markov.hazards([0.0] * (SHORTEST - 1) + [1.0] * (LONGEST - SHORTEST + 1), 5)
NUMBERS = tuple(map(str, range(1, TARGETS + 1)))
ENTRIES = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))
"""Entries of a covariance of position, velocity and acceleration, as the observation contains them."""


@dataclass(frozen=True)
class BudgetedSensingParameters(TaskParameters):
    """Every constant that a scenario changes."""

    horizon: int = parameter(100, at_least=1)
    """Looks in one episode, one each second."""
    agility: tuple[float, float] = parameter((1.0, 10.0), above=0.0, ascending=True)
    """Limits of the standard deviation of a target's accelerations, m/s^2, drawn log-uniformly; it is known."""
    sigma: tuple[float, float] = parameter((5.0, 50.0), above=0.0, ascending=True)
    """Limits of the standard deviation of its measured position, m, drawn log-uniformly; it is known."""
    beam: float = parameter(1e6, above=0.0)
    """A target that is further from its prediction, m, gives no echo."""
    lost: float = parameter(1000.0, above=0.0)
    """Error beyond which a target costs no more, m."""


class Truth(NamedTuple):
    """The targets, arrays ``(4, N)`` each."""

    position: Array
    velocity: Array
    acceleration: Array
    remaining: Array
    """Seconds until the manoeuvre ends, zero between manoeuvres."""
    agility: Array
    sigma: Array


class Measurement(NamedTuple):
    """The beam's measurement of each target, of which the filter receives one; arrays ``(4, N)``."""

    position: Array
    sigma: Array
    agility: Array


class Targets(World[Task, Truth, Measurement]):
    """Four targets."""

    parameters: BudgetedSensingParameters
    initial_normals = 2 * TARGETS
    normals = 2 * TARGETS
    row_uniforms = 2 * TARGETS

    def begin(self, draws: Draws, normals: Array) -> tuple[Truth, Initial]:
        """Start all estimates at zero, within 50 m and 30 m/s."""
        p, xp, zero = self.parameters, self.xp, 0.0 * normals[:TARGETS]
        agility, sigma = (
            xp.stack([draws.log_uniform(f"{what} {j}", limits) for j in NUMBERS])
            for what, limits in (("agility", p.agility), ("sigma", p.sigma))
        )
        truth = Truth(50.0 * normals[:TARGETS], 30.0 * normals[TARGETS:], zero, zero, agility, sigma)
        covariance = self.task.constant(50.0**2 * numpy.eye(TARGETS))[:, :, None] + zero[0]
        return truth, Initial(zero, covariance)

    def advance(self, truth: Truth, noise: Array, feedback: Any) -> tuple[Truth, Measurement]:
        """End and begin manoeuvres, fly for a second, measure."""
        xp, n = self.xp, TARGETS
        begins, lasts = noise[2 * n : 3 * n], noise[3 * n :]
        remaining = xp.maximum(truth.remaining - 1.0, 0.0 * lasts)
        free = remaining < 0.5
        begun = free & (begins < BEGIN)
        drawn = xp.floor(SHORTEST + (LONGEST - SHORTEST + 1) * lasts)
        a = xp.where(begun, truth.agility * noise[:n], xp.where(free, 0.0 * lasts, truth.acceleration))
        truth = truth._replace(
            position=truth.position + truth.velocity + 0.5 * a,
            velocity=truth.velocity + a,
            acceleration=a,
            remaining=xp.where(begun, drawn, remaining),
        )
        read = truth.position + truth.sigma * noise[n : 2 * n]
        return truth, Measurement(read, truth.sigma, truth.agility)

    def state(self, truth: Truth) -> Array:
        """Return the positions."""
        return truth.position

    def error_cost(self, error: Array) -> Array:
        """Return the mean squared error of the positions, limited to that of a lost target."""
        squares = self.xp.minimum(error**2, self.parameters.lost**2 + 0.0 * error)
        return sum(squares[j] for j in range(TARGETS)) / TARGETS


class Track(NamedTuple):
    """Hypotheses on one target, by their age."""

    steady: AgedHypotheses
    """Position and velocity."""
    thrust: AgedHypotheses
    """Position, velocity and acceleration."""


class Tracks(NamedTuple):
    """The estimates of all targets."""

    tracks: tuple[Track, ...]
    mean: Array
    """Position, velocity, acceleration, ``(3, 4, N)``."""
    covariance: Array
    """``(3, 3, 4, N)``."""
    waited: Array
    """Seconds since each was looked at, ``(4, N)``."""


class BeamBank(Bank["BudgetedSensing", Measurement, Tracks]):
    """Control ``beam``: the action is the number of the target to look at."""

    parameters: BudgetedSensingParameters
    action_space = gymnasium.spaces.Discrete(TARGETS)

    @property
    def blocks(self) -> Sequence[Block]:
        """Return the covariance of each target before the look, and its agility and noise."""
        places = tuple(f"{j}_{a}{b}" for a, b in ENTRIES for j in NUMBERS)
        return (
            Block(
                "covariance",
                lambda f, _: self.xp.concat([f.covariance[a, b] for a, b in ENTRIES]),
                "predicted covariance of position, velocity and acceleration",
                places,
                SIGNED_LOG,
            ),
            Block("waited", lambda f, _: f.waited, "s since it was looked at", NUMBERS, LOG1P, "s"),
            Block("sigma", lambda _, m: m.sigma, "deviation of a measurement", NUMBERS, LOG1P, "m"),
            Block("agility", lambda _, m: m.agility, "of accelerations", NUMBERS, LOG1P, "m/s^2"),
        )

    def start(self, initial: Initial) -> Tracks:
        """Start between manoeuvres, at an unknown velocity."""
        xp, zero = self.xp, 0.0 * initial.mean[0]
        least = semi_markov.LEAST_PROBABILITY
        tracks = []
        for j in range(TARGETS):
            mean = xp.stack([initial.mean[j], zero])
            speed = 30.0**2 + zero
            covariance = _matrix(xp, [[initial.covariance[j, j], zero], [zero, speed]])
            steady = AgedHypotheses(mean[:, None], covariance[:, :, None], 1.0 + zero[None])
            mean, covariance = _accelerated(xp, mean, covariance, 0.0 * zero)
            ages = len(HAZARDS)
            thrust = AgedHypotheses(
                xp.stack([mean] * ages, axis=1),
                xp.stack([covariance] * ages, axis=2),
                xp.stack([least + zero] * ages),
            )
            tracks.append(Track(steady, thrust))
        return self._together(tuple(tracks), xp.stack([zero] * TARGETS))

    def _together(self, tracks: tuple[Track, ...], waited: Array) -> Tracks:
        """Return the tracks with mean and covariance of each target over its hypotheses."""
        xp, means, covariances = self.xp, [], []
        for track in tracks:
            steady, zero = track.steady, 0.0 * track.steady.probability
            mean, covariance = _accelerated(xp, steady.mean, steady.covariance, zero)
            both = semi_markov.join([AgedHypotheses(mean, covariance, steady.probability), track.thrust])
            total = both.probability / sum(both.probability[h] for h in range(both.probability.shape[0]))
            mean, covariance = imm.combine(both.mean, both.covariance, total)
            means.append(mean)
            covariances.append(covariance)
        return Tracks(tracks, xp.stack(means, axis=1), xp.stack(covariances, axis=2), waited)

    def predict(self, state: Tracks, measurement: Measurement) -> Tracks:
        """Let manoeuvres end and begin, and fly on for a second."""
        xp, tracks = self.xp, []
        hazard, one = self.task.constant(HAZARDS)[:, None], 1.0 + 0.0 * state.waited[0]
        F = kalman.constant_acceleration(one)
        for j, track in enumerate(state.tracks):
            variance = measurement.agility[j] ** 2

            def begin(mean: Array, covariance: Array, variance: Array = variance) -> tuple[Array, Array]:
                return _accelerated(xp, mean, covariance, variance)

            mode = semi_markov.Mode(track.thrust, hazard, BEGIN, begin)
            steady, (thrust,) = semi_markov.switch(track.steady, [mode])
            tracks.append(Track(_flown(steady, F[:2, :2]), _flown(thrust, F)))
        return self._together(tuple(tracks), state.waited + 1.0)

    def act(self, state: Tracks, measurement: Measurement, action: Array) -> Tracks:
        """Look at one target."""
        xp = self.xp
        looked = xp.stack([xp.where(action == j, 1.0, 0.0 * state.waited[j]) for j in range(TARGETS)])
        return self.look(state, measurement, looked)

    def look(self, state: Tracks, measurement: Measurement, looked: Array) -> Tracks:
        """Update with the beam's measurements of the targets of which ``looked``, ``(4, N)``, is 1."""
        xp, tracks = self.xp, []
        within = xp.abs(measurement.position - state.mean[0]) <= self.parameters.beam
        for j, track in enumerate(state.tracks):
            seen = (looked[j] > 0.0) & within[j]
            steady, thrust = (_update(table, measurement, j) for table in track)
            logarithms = xp.concat(
                [
                    xp.log(t.probability) + r.log_likelihood
                    for t, r in zip(track, (steady, thrust), strict=True)
                ]
            )
            weights, place, after = imm.softmax(logarithms), 0, []
            for table, result in zip(track, (steady, thrust), strict=True):
                end = place + table.probability.shape[0]
                found = AgedHypotheses(result.mean, result.covariance, weights[place:end])
                after.append(AgedHypotheses(*(xp.where(seen, a, b) for a, b in zip(found, table, strict=True))))
                place = end
            tracks.append(Track(*after))
        return self._together(tuple(tracks), xp.where(looked > 0.0, 0.0 * state.waited, state.waited))

    def mean(self, state: Tracks) -> Array:
        """Return the positions."""
        return state.mean[0]

    def covariance(self, state: Tracks) -> Array:
        """Return the covariance of the positions: targets are independent."""
        zero = 0.0 * state.waited[0]
        size = range(TARGETS)
        return _matrix(self.xp, [[state.covariance[0, 0, i] if i == j else zero for j in size] for i in size])


def _matrix(xp: Any, rows: Sequence[Sequence[Array]]) -> Array:
    return xp.stack([xp.stack(list(row)) for row in rows])


def _accelerated(xp: Any, mean: Array, covariance: Array, variance: Array) -> tuple[Array, Array]:
    """Return the state of a manoeuvre whose acceleration has this variance, from position and velocity."""
    zero = 0.0 * mean[0]
    rows = [[covariance[i, 0], covariance[i, 1], zero] for i in range(2)]
    return xp.concat([mean, zero[None]]), _matrix(xp, [*rows, [zero, zero, variance + zero]])


def _flown(table: AgedHypotheses, F: Array) -> AgedHypotheses:
    mean, covariance = kalman.predict(table.mean, table.covariance, F[:, :, None], 0.0 * F[:, :, None])
    return table._replace(mean=mean, covariance=covariance)


def _update(table: AgedHypotheses, measurement: Measurement, j: int) -> kalman.Update:
    """Update the Kalman filter of every hypothesis with a measured position."""
    S = table.covariance[0, 0] + measurement.sigma[j] ** 2
    innovation = measurement.position[j] - table.mean[0]
    K = table.covariance[:, 0] / S
    squared = innovation**2 / S
    xp = namespace(S)
    return kalman.Update(
        table.mean + K * innovation,
        table.covariance - outer(K, K) * S,
        -0.5 * (squared + xp.log(2.0 * math.pi * S)),
        squared,
    )


class BudgetedSensing(Task):
    """Four manoeuvring targets, and a beam that looks at one of them each second."""

    id = "mine/BudgetedSensing-v0"
    Parameters = BudgetedSensingParameters
    World = Targets
    banks: Mapping[str, Any] = {"beam": BeamBank}
    scenarios: Mapping[str, Scenario] = {
        "random": Scenario("random", "Targets of any kind; the beam finds each.", training=True),
        "narrow": Scenario(
            "narrow", "The beam misses what is 300 m from its prediction.", {"beam": 300.0}, training=True
        ),
        "alike": Scenario(
            "alike", "Held out: four targets of one kind.", {"agility": (3.0, 3.0), "sigma": (15.0, 15.0)}
        ),
    }
    components = tuple(Component(f"position_{j}", "m") for j in NUMBERS)
    reward = Reward("mean squared error of the positions, at most that of a lost target, m^2", unit=1000.0)
    paper_policy = PaperPolicy("beam", 0)
    companions = (Actions({"beam": "the target that is looked at"}),)


# --- policies


def later(P: numpy.ndarray, agility: numpy.ndarray) -> numpy.ndarray:
    """Covariance of position, velocity and acceleration a second later, ``(3, 3, ...)``: a Gauss-Markov course with the
    moments of the semi-Markov one.
    """
    mean = 0.5 * (SHORTEST + LONGEST)
    kept, share = 1.0 - 1.0 / mean, BEGIN * mean / (BEGIN * mean + 1.0 - BEGIN)
    F = numpy.array([[1.0, 1.0, 0.5], [0.0, 1.0, 1.0], [0.0, 0.0, kept]])
    P = numpy.einsum("ab,bc...,dc->ad...", F, P, F)
    P[2, 2] += (1.0 - kept**2) * share * agility**2
    return P


def updated(P: numpy.ndarray, R: numpy.ndarray, share: Any = 1.0) -> numpy.ndarray:
    """Return the covariance after a look, or after a share of one."""
    return P - share * P[:, None, 0] * P[None, :, 0] / (P[0, 0] + R)


class Manager(Policy):
    """Chooses the target of the largest index; the policies below differ in it."""

    control = "beam"

    def __init__(self, model: Any) -> None:
        super().__init__(model)
        p = model.task.parameters
        self.beam, self.lost = p.beam, p.lost
        names = ("covariance", "waited", "sigma", "agility")
        self.readers = {name: model.reader(name) for name in names}

    def act(self, observation: numpy.ndarray, state: Any, start: numpy.ndarray) -> tuple[numpy.ndarray, Any]:
        """Choose the target of the largest index."""
        rest = {name: read(observation).T for name, read in self.readers.items()}
        entries = dict(zip(ENTRIES, rest.pop("covariance").reshape(len(ENTRIES), TARGETS, -1), strict=True))
        P = numpy.array([[entries[min(a, b), max(a, b)] for b in range(3)] for a in range(3)])
        return self.index(P, rest["sigma"] ** 2, rest).argmax(axis=0), None

    def index(self, P: numpy.ndarray, R: numpy.ndarray, rest: Mapping[str, numpy.ndarray]) -> numpy.ndarray:
        """Return the index of each target, ``(4, N)``.

        Args:
            P: predicted covariance of each, ``(3, 3, 4, N)``.
            R: variance of a measurement of it, ``(4, N)``.
            rest: the rest of the observation.
        """
        raise NotImplementedError

    def found(self, P: numpy.ndarray, R: numpy.ndarray) -> numpy.ndarray:
        """Return the probability that the beam finds it."""
        return erf(self.beam / numpy.sqrt(2.0 * (P[0, 0] + R)))

    def cost(self, P: numpy.ndarray) -> numpy.ndarray:
        """Return the expected squared error, limited to that of a lost target."""
        ratio = self.lost / numpy.sqrt(P[0, 0])
        within = erf(ratio / math.sqrt(2.0))
        density = numpy.exp(-0.5 * ratio**2) / math.sqrt(2.0 * math.pi)
        return P[0, 0] * (within - 2.0 * ratio * density) + self.lost**2 * (1.0 - within)


class RoundRobin(Manager):
    """The target that has waited longest."""

    def index(self, P: Any, R: Any, rest: Any) -> numpy.ndarray:
        """Return the seconds since the last look."""
        return rest["waited"]


class GreedyInformation(Manager):
    """The look of the largest expected information about the position, nats."""

    def index(self, P: Any, R: Any, rest: Any) -> numpy.ndarray:
        """Return half the logarithm of the variance before over that after."""
        return self.found(P, R) * 0.5 * numpy.log1p(P[0, 0] / R)


class Greedy(Manager):
    """The look of the least expected cost now."""

    def index(self, P: Any, R: Any, rest: Any) -> numpy.ndarray:
        """Return the expected cost before less that after."""
        return self.found(P, R) * (self.cost(P) - self.cost(updated(P, R)))


class Deferral(Manager):
    """A Whittle-type index: the cost of not looking now, over some seconds without looks."""

    seconds = TARGETS

    def index(self, P: Any, R: Any, rest: Any) -> numpy.ndarray:
        """Sum of the differences, as in P. Whittle, Restless bandits, J. Applied Probability 25A (1988), 287-298."""
        found, active, total = self.found(P, R), updated(P, R), 0.0
        for _ in range(self.seconds):
            total = total + self.cost(P) - self.cost(active)
            P, active = later(P, rest["agility"]), later(active, rest["agility"])
        return found * total


class Rollout(Manager):
    """Every pair of looks, followed by some seconds of `greedy`."""

    seconds = TARGETS

    def index(self, P: Any, R: Any, rest: Any) -> numpy.ndarray:
        """Return the negative cost of the best sequence that begins with each."""
        pairs = numpy.eye(TARGETS)
        best = []
        for first in pairs:
            costs = []
            for second in pairs:
                state, total = P, 0.0
                for k in range(2 + self.seconds):
                    if k > 1:
                        gain = self.found(state, R) * (self.cost(state) - self.cost(updated(state, R)))
                        looked = (gain == gain.max(axis=0)).astype(float)
                    else:
                        looked = (first, second)[k][:, None]
                    state = updated(state, R, looked * self.found(state, R))
                    total = total + self.cost(state).sum(axis=0)
                    state = later(state, rest["agility"])
                costs.append(total)
            best.append(-numpy.min(costs, axis=0))
        return numpy.array(best)


# --- references


class AllBeams:
    """A bank that looks at every target each second."""

    kind = "reference"
    traceable = True
    knows = "what the beam would say of every target"

    def __init__(self, task: BudgetedSensing) -> None:
        self.bank, self.xp = BeamBank(task, "beam"), task.xp

    def start(self, initial: Initial, truth: Truth) -> Tracks:
        """Start at the common initial estimate."""
        return self.bank.start(initial)

    def update(self, memory: Tracks, measurement: Measurement, truth: Truth) -> tuple[Array, Array, Tracks]:
        """Predict and look."""
        predicted = self.bank.predict(memory, measurement)
        all_seen = self.bank.look(predicted, measurement, 1.0 + 0.0 * predicted.waited)
        after = self.choose(predicted, all_seen, measurement, truth)
        return self.bank.mean(after), self.bank.covariance(after), after

    def choose(self, predicted: Tracks, seen: Tracks, measurement: Measurement, truth: Truth) -> Tracks:
        """Choose all targets."""
        return seen


class Clairvoyant(AllBeams):
    """The same beam, and of each target is known where it is and what the look would change: of the looks the one
    whose true errors are least over the next seconds without looks.
    """

    knows = "the true state of every target, and what the beam would say of it"
    seconds = TARGETS

    def choose(self, predicted: Tracks, seen: Tracks, measurement: Measurement, truth: Truth) -> Tracks:
        """Choose one target."""
        xp = self.xp
        state = xp.stack([truth.position, truth.velocity, truth.acceleration])
        gain = self._errors(predicted.mean - state) - self._errors(seen.mean - state)
        best, looked = gain[0], [1.0 + 0.0 * gain[0]]
        for j in range(1, TARGETS):
            better = gain[j] > best
            best = xp.where(better, gain[j], best)
            looked = [xp.where(better, 0.0 * one, one) for one in looked]
            looked.append(xp.where(better, 1.0 + 0.0 * best, 0.0 * best))
        return self.bank.look(predicted, measurement, xp.stack(looked))

    def _errors(self, error: Array) -> Array:
        """Return the sum of the squared future errors of the positions, ``(4, N)``."""
        total, limit = 0.0, self.bank.parameters.lost**2 + 0.0 * error[0]
        for k in range(self.seconds):
            ahead = error[0] + k * error[1] + 0.5 * k * k * error[2]
            total = total + self.xp.minimum(ahead**2, limit)
        return total


POLICIES = {
    "round-robin": RoundRobin,
    "greedy-information": GreedyInformation,
    "greedy": Greedy,
    "index": Deferral,
    "rollout": Rollout,
    "random": RandomPolicy,
}
REFERENCES = {"clairvoyant": Clairvoyant, "all-beams": AllBeams}
BASELINES = Baselines(
    environment=BudgetedSensing.id,
    policies=POLICIES,
    references=REFERENCES,
    score_paper="round-robin",
    score_reference="all-beams",
    physical=("rmse", "position_1"),
)
filtergym.register_task(BudgetedSensing, BASELINES)
