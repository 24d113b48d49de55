"""An environment in one file: the estimate of a Kalman filter holds a pendulum upright.

    filtergym list inverted_pendulum:mine/InvertedPendulum-v0
    filtergym evaluate inverted_pendulum:mine/InvertedPendulum-v0 --policy kalman --policy matching --policy known-gusts

Gusts of unknown, changing strength push the pendulum. A sensor reads the angle. The torque follows from the estimate,
so the loop is closed; the action scales the process noise of the filter.
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
from filtergym.envs.contract.observation import ACTION, LOG1P, SIGNED_LOG, Array, Block
from filtergym.envs.contract.parameters import TaskParameters, parameter
from filtergym.envs.contract.filter import Bank, Initial
from filtergym.envs.contract.model import Model
from filtergym.envs.contract.task import Component, PaperPolicy, Reward, Scenario, Task
from filtergym.envs.contract.world import World
from filtergym.evaluation.competitors.kinds import ConstantPolicy, Policy, RandomPolicy
from filtergym.filters import kalman

import filtergym


@dataclass(frozen=True)
class InvertedPendulumParameters(TaskParameters):
    """Every constant of the task; each is a keyword of ``gym.make``."""

    horizon: int = parameter(200, at_least=1)
    """Measurements acted on in one episode."""
    sampling_interval: float = parameter(0.05, above=0.0)
    """T, s."""
    length: float = parameter(1.0, above=0.0)
    """Length of the pendulum, m."""
    angle_sigma: float = parameter(0.01, above=0.0)
    """Standard deviation of the angle sensor, rad."""
    gust: float = parameter(0.5, above=0.0)
    """Standard deviation of the angular acceleration by gusts in the filter's model, rad/s^2."""
    gust_levels: tuple[float, float] = parameter((0.1, 10.0), above=0.0, ascending=True)
    """Limits of its true factor, drawn log-uniformly before and after a change."""
    gains: tuple[float, float] = (20.0, 6.0)
    """Torque per angle and per rate, over the moment of inertia, 1/s^2 and 1/s."""
    noise_decades: float = parameter(2.0, above=0.0)
    """Decades by which an action of one scales the process noise."""


class Truth(NamedTuple):
    """The pendulum, and the gusts of the episode."""

    number: Array
    """Number of the measurement, ``(N,)``."""
    state: Array
    """Angle from upright, rad, and rate, rad/s, ``(2, N)``."""
    levels: Array
    """Factor on the gusts before and after the change, ``(2, N)``."""
    change: Array
    """First measurement after it, ``(N,)``."""


class Measurement(NamedTuple):
    """The sensor's reading, and the torque, which is known because it was commanded."""

    angle: Array
    """Angle, rad, ``(1, N)``; its variance is ``angle_sigma`` squared."""
    torque: Array
    """Torque since the measurement before, over the moment of inertia, rad/s^2, ``(N,)``."""


class PendulumWorld(World[Task, Truth, Measurement]):
    """A stick on a hinge in gusty air."""

    parameters: InvertedPendulumParameters
    initial_normals = 2
    normals = 2

    def begin(self, draws: Draws, normals: Array) -> tuple[Truth, Initial]:
        """Start nearly upright and nearly at rest; all estimates start at zero."""
        p, xp = self.parameters, self.xp
        levels = xp.stack(
            [draws.log_uniform(name, p.gust_levels) for name in ("level before", "level after")]
        )
        change = draws.integer("change", (1, p.horizon))
        sigma = self.task.constant([[0.05], [0.05]])
        zero = 0.0 * normals
        covariance = self.task.constant([[0.05**2, 0.0], [0.0, 0.05**2]])[:, :, None] + zero[0]
        return Truth(zero[0], sigma * normals, levels, change), Initial(zero, covariance)

    def level(self, truth: Truth) -> Array:
        """Return the factor on the gusts in the interval before this measurement."""
        return self.xp.where(truth.number < truth.change, truth.levels[0], truth.levels[1])

    def advance(self, truth: Truth, noise: Array, feedback: Array) -> tuple[Truth, Measurement]:
        """Swing for one interval under torque and gust, then read the angle."""
        p, xp, T = self.parameters, self.xp, self.parameters.sampling_interval
        truth = truth._replace(number=truth.number + 1.0)
        angle, rate = truth.state[0], truth.state[1]
        gust = p.gust * self.level(truth) * noise[0]
        acceleration = 9.81 / p.length * xp.sin(angle) + feedback + gust
        state = xp.stack([angle + T * rate + 0.5 * T**2 * acceleration, rate + T * acceleration])
        # A pendulum that has fallen lies where it is; squares stay numbers.
        state = xp.clip(state, -100.0, 100.0)
        reading = state[:1] + p.angle_sigma * noise[1:]
        return truth._replace(state=state), Measurement(reading, feedback)

    def cost(self, truth: Truth, mean: Array) -> Array:
        """Return the squared angle, over the variance of the sensor."""
        return (truth.state[0] / self.parameters.angle_sigma) ** 2

    def records(self, truth: Truth) -> dict[str, Array]:
        """Factor on the gusts."""
        return {"level": self.level(truth)}


class Filter(NamedTuple):
    """The Kalman filter."""

    mean: Array
    """Predicted with the nominal noise after ``predict``, estimated after ``act``, ``(2, N)``."""
    covariance: Array
    """Covariance of the mean, ``(2, 2, N)``; predicted without process noise."""
    nis: Array
    """Normalised innovation squared, with the process noise of the last action, ``(N,)``."""
    innovation: Array
    """Innovation over its sigma, ``(N,)``."""
    scale: Array
    """Factor on the process noise in the last update, ``(N,)``."""


class NoiseBank(Bank["InvertedPendulum", Measurement, Filter]):
    """Control ``gain``: the action scales the process noise."""

    parameters: InvertedPendulumParameters
    action_space = gymnasium.spaces.Box(-1.0, 1.0, (1,), numpy.float32)

    @property
    def blocks(self) -> Sequence[Block]:
        """Return the observation blocks of the agent."""
        decades = self.parameters.noise_decades * math.log(10.0)
        return (
            Block("innovation", lambda f, _: f.innovation, "innovation over its sigma", compression=SIGNED_LOG),
            Block("nis", lambda f, _: f.nis, "normalised innovation squared", compression=LOG1P),
            Block(
                "last_action", lambda f, _: self.xp.log(f.scale) / decades, "action applied before", compression=ACTION
            ),
        )

    def start(self, initial: Initial) -> Filter:
        """Start at the common initial estimate."""
        zero = 0.0 * initial.mean[0]
        return Filter(initial.mean, initial.covariance, zero, zero, zero + 1.0)

    def predict(self, state: Filter, measurement: Measurement) -> Filter:
        """Predict with the known torque and compare with the reading."""
        task, xp = self.task, self.xp
        mean, covariance = kalman.predict(state.mean, state.covariance, task.F, 0.0 * task.Q)
        mean = mean + task.push * measurement.torque
        predicted = covariance[0, 0] + state.scale * task.Q[0, 0]
        innovation = (measurement.angle[0] - mean[0]) / xp.sqrt(predicted + task.R[0, 0])
        return Filter(mean, covariance, innovation * innovation, innovation, state.scale)

    def act(self, state: Filter, measurement: Measurement, action: Array) -> Filter:
        """Update with the process noise of the action."""
        task = self.task
        scale = self.xp.exp(
            self.parameters.noise_decades * math.log(10.0) * self.xp.clip(action[0], -1.0, 1.0)
        )
        covariance = state.covariance + scale * task.Q[:, :, None]
        result = kalman.update(state.mean, covariance, measurement.angle, task.H, task.R)
        return state._replace(mean=result.mean, covariance=result.covariance, scale=scale)

    def records(self, state: Filter, measurement: Measurement) -> dict[str, Array]:
        """Return NIS and the factor on the process noise."""
        return {"nis": state.nis, "nis_degrees": 1.0 + 0.0 * state.nis, "scale": state.scale}


class InvertedPendulum(Task):
    """A pendulum held upright by the estimate of a Kalman filter, in gusts of unknown strength."""

    id = "mine/InvertedPendulum-v0"
    Parameters = InvertedPendulumParameters
    World = PendulumWorld
    banks: Mapping[str, Any] = {"gain": NoiseBank}
    scenarios: Mapping[str, Scenario] = {
        "random": Scenario("random", "Gusts of any strength, which changes once.", training=True),
        "storm": Scenario(
            "storm", "Held out: gusts ten times as strong as believed.", {"gust_levels": (10.0, 10.0)}
        ),
    }
    components = (Component("angle", "rad"), Component("rate", "rad/s"))
    reward = Reward("squared angle over the variance of the sensor")
    paper_policy = PaperPolicy("gain", (0.0,))
    companions = (Actions({"gain": "decades of the process noise; 0 is the Kalman filter"}),)

    def set_up(self) -> None:
        """Compute the model of the filter: the pendulum for small angles."""
        p, T = self.parameters, self.parameters.sampling_interval
        stiffness = 9.81 / p.length
        self.F = self.constant([[1.0 + 0.5 * T**2 * stiffness, T], [T * stiffness, 1.0]])
        self.push = self.constant([[0.5 * T**2], [T]])
        self.Q = p.gust**2 * self.push @ self.push.T
        self.H = self.constant([[1.0, 0.0]])
        self.R = self.constant([[p.angle_sigma**2]])

    def feedback(self, mean: Array, covariance: Array, measurement: Any) -> Array:
        """Return the torque over the moment of inertia, rad/s^2, ``(N,)``."""
        angle_gain, rate_gain = self.parameters.gains
        return -(angle_gain * mean[0] + rate_gain * mean[1])


class Nominal(ConstantPolicy):
    """The Kalman filter as designed."""

    control = "gain"
    action = (0.0,)


class Matching(Policy):
    """Process noise raised while the normalised innovation squared is above one, lowered while it is below."""

    control = "gain"

    def __init__(self, model: Model) -> None:
        super().__init__(model)
        self.nis, self.last_action = model.reader("nis"), model.reader("last_action")

    def act(self, observation: numpy.ndarray, state: Any, start: numpy.ndarray) -> tuple[numpy.ndarray, Any]:
        """Take a step from the last action."""
        excess = numpy.minimum(self.nis(observation), 5.0) - 1.0
        return numpy.clip(self.last_action(observation) + 0.05 * excess, -1.0, 1.0), None


class KnownGusts:
    """The Kalman filter that knows the strength of the gusts."""

    kind = "reference"
    knows = "the factor on the gusts at every moment"

    def __init__(self, task: InvertedPendulum) -> None:
        self.task = task

    def start(self, initial: Initial, truth: Truth) -> Initial:
        """Start at the common initial estimate."""
        return initial

    def update(self, memory: Initial, measurement: Measurement, truth: Truth) -> tuple[Array, Array, Initial]:
        """Predict and update with the true noise."""
        task: Any = self.task
        Q = task.world.level(truth) ** 2 * task.Q[:, :, None]
        offset = task.push * measurement.torque
        mean, covariance = kalman.predict(memory.mean, memory.covariance, task.F, Q, offset)
        result = kalman.update(mean, covariance, measurement.angle, task.H, task.R)
        return result.mean, result.covariance, Initial(result.mean, result.covariance)


BASELINES = Baselines(
    environment=InvertedPendulum.id,
    policies={"kalman": Nominal, "matching": Matching, "random": RandomPolicy},
    references={"known-gusts": KnownGusts},
    score_paper="kalman",
    score_reference="known-gusts",
    physical=("rmse", "angle"),
)

filtergym.register_task(InvertedPendulum, BASELINES)
