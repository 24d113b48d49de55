"""Readings of sensors and estimates of filters around environments of Gymnasium."""

import copy
import json
import pickle

import gymnasium
import numpy as np
import pytest
from gymnasium.envs.registration import EnvSpec
from gymnasium.utils.env_checker import check_env

from filtergym import Sensor
from filtergym.wrappers import (
    CLASSIC_CONTROL,
    EnvironmentModel,
    EnvironmentSensor,
    EstimatedObservation,
    NoisyObservation,
    estimates,
    fit_model,
    vector,
)

pytestmark = pytest.mark.filterwarnings("ignore::UserWarning:gymnasium", "ignore:.*Overriding environment.*")
ENCODER = {"encoder": {"h": "angle", "R": 0.01}}
FAULTS = {
    "encoder": {"h": "angle", "R": 0.01, "availability": 0.7, "delay": 2, "bias": 0.05, "quantum": 0.01},
    "gyro": {"h": "rate", "R": 0.04, "interval": 0.1},
}
SENSORS = {
    "CartPole-v1": {"camera": {"h": ["position", "angle"], "R": 1e-4}},
    "Pendulum-v1": FAULTS,
    "MountainCarContinuous-v0": {"radar": {"h": "position", "R": 1e-4}},
    "Acrobot-v1": {"encoders": {"h": ["angle_1", "angle_2"], "R": [[0.01, 0.0], [0.0, 0.02]]}},
}
ALL = ("mean", "deviation", "nis", "innovation")


def wrapped(name, sensors=None, **arguments):
    """An environment with sensors and a filter."""
    return EstimatedObservation(NoisyObservation(gymnasium.make(name), sensors or SENSORS[name]), **arguments)


def turned(difference, model):
    """A difference of states without whole turns."""
    for i, name in enumerate(model.names):
        if name in model.angles:
            difference[..., i] = (difference[..., i] + np.pi) % (2.0 * np.pi) - np.pi
    return difference


@pytest.mark.parametrize("name", SENSORS)
def test_models_are_those_of_the_simulators(name):
    env, model = gymnasium.make(name), CLASSIC_CONTROL[name.rpartition("-")[0]]
    env.action_space.seed(0)
    observation, _ = env.reset(seed=1)
    # The car's state has 32 bits, the others' 64; angles come from cosines and sines of 32 bits.
    tolerance = 1e-7 if name.startswith("Mountain") else 1e-14
    for _ in range(300):
        before, action = np.array(env.unwrapped.state, dtype=float), env.action_space.sample()
        assert np.abs(turned(model.state(observation[None].astype(float))[0] - before, model)).max() < 2e-6
        if model.observation is not None:
            np.testing.assert_allclose(model.observation(before[None])[0], observation, atol=2e-6)
        inputs = model.action(np.asarray(action)[None])[0]
        observation, _, terminated, truncated, _ = env.step(action)
        moved = np.array(model.f(before, model.interval, inputs), dtype=float)
        assert np.abs(turned(moved - np.array(env.unwrapped.state), model)).max() < tolerance
        if terminated or truncated:
            observation, _ = env.reset()


def test_estimates_are_those_of_a_naive_filter():
    """An extended Kalman filter of Pendulum written out, with its Jacobian by hand."""
    env = wrapped("Pendulum-v1", ENCODER, show=ALL)
    sensors, model, dt, R = env.env, CLASSIC_CONTROL["Pendulum"], 0.05, 0.01
    env.reset(seed=5)
    x, P = np.zeros(2), np.diag([np.pi**2 / 3.0, 1.0 / 3.0])
    for step in range(120):
        torque = np.array([2.0 * np.sin(0.3 * step)])
        if step:
            env.step(torque)
            slope = 15.0 * np.cos(x[0]) * dt
            rate = x[1] + dt * (15.0 * np.sin(x[0]) + 3.0 * torque[0])
            clipped = abs(rate) > 8.0
            rate = np.clip(rate, -8.0, 8.0)
            row = np.zeros(2) if clipped else np.array([slope, 1.0])
            F = np.array([np.array([1.0, 0.0]) + dt * row, row])
            x = np.array([x[0] + dt * rate, rate])
            P = F @ P @ F.T + dt * np.diag(model.noise)
        z = sensors.reading.values[0, 0]
        innovation = (z - x[0] + np.pi) % (2.0 * np.pi) - np.pi
        S = P[0, 0] + R
        gain = P[:, 0] / S
        x, P = x + gain * innovation, P - np.outer(gain, gain) * S
        found = env.estimates
        # Rounding of the covariance, 0.3 to 1e-3, grows by the motion that is unstable at the top.
        np.testing.assert_allclose(turned(found.mean[0] - x, model), 0.0, atol=1e-12)
        np.testing.assert_allclose(found.deviation[0], np.sqrt(np.diag(P)), rtol=1e-11)
        np.testing.assert_allclose(found.nis[0], innovation**2 / S, rtol=1e-9, atol=1e-12)
        np.testing.assert_allclose(found.innovation[0, 0], innovation, atol=1e-12)


@pytest.mark.parametrize("control", [None, "gain"])
def test_numpy_has_the_numbers_of_the_compiled_step(control, monkeypatch):
    envs = [wrapped("Pendulum-v1", FAULTS, show=ALL, control=control)]
    for module in ("readings", "recursions"):
        monkeypatch.setattr(f"filtergym.wrappers.{module}.AVAILABLE", False)
    envs.append(wrapped("Pendulum-v1", FAULTS, show=ALL, control=control))
    envs[0].action_space.seed(0)
    for seed in (3, 4):
        assert len({env.reset(seed=seed)[0].tobytes() for env in envs}) == 1
        for _ in range(70):
            action = envs[0].action_space.sample()
            infos = [env.step(action)[-1] for env in envs]
            np.testing.assert_array_equal(infos[0]["available"], infos[1]["available"])
            # Sine, cosine and arctangent of the libraries differ in the last place.
            np.testing.assert_allclose(*(env.env.reading.values for env in envs), rtol=1e-14, atol=1e-14)
            for one, other in zip(*(env.estimates for env in envs), strict=True):
                np.testing.assert_allclose(one, other, rtol=1e-10, atol=1e-12)


def test_filters_of_the_same_sensors_and_of_several_steps():
    class TwoSteps(gymnasium.Wrapper):
        def step(self, action):
            self.env.step(action)
            return self.env.step(action)

    sensors = pendulum()
    both = [EstimatedObservation(sensors, competitor=one, show="mean") for one in ("unscented", "extended")]
    alone = wrapped("Pendulum-v1", ENCODER, show="mean")
    skipping = EstimatedObservation(TwoSteps(pendulum()), show="mean")
    for env in (both[1], alone, skipping):
        env.reset(seed=1)
    for _ in range(20):
        found = [both[1].step([1.0])[0] for _ in range(2)][-1]
        np.testing.assert_array_equal([alone.step([1.0])[0] for _ in range(2)][-1], found)
        np.testing.assert_array_equal(skipping.step([1.0])[0], found)
    assert (both[0].estimates.mean != both[1].estimates.mean).any()


class AverageReading:
    """An estimator in Python: the mean of all readings of an episode."""

    def __init__(self, task):
        self.size = len(task.components)

    def start(self, initial, N):
        return np.zeros((2, N))

    def update(self, memory, measurement):
        memory = memory + np.stack([measurement.values[0], np.ones(memory.shape[1])])
        mean = np.zeros((self.size, memory.shape[1]))
        mean[0] = memory[0] / memory[1]
        return mean, np.repeat(np.eye(self.size)[:, :, None], memory.shape[1], axis=2), memory


def test_an_estimator_in_python_begins_anew_with_every_episode():
    env = wrapped("MountainCarContinuous-v0", competitor=AverageReading, show="mean")
    for seed in (0, 1):
        env.reset(seed=seed)
        readings = [env.env.reading.values[0, 0]]
        for _ in range(5):
            found = env.step([1.0])[0]
            readings.append(env.env.reading.values[0, 0])
            assert found[0] == pytest.approx(np.mean(readings), abs=1e-7)


def test_a_model_without_inputs_under_any_action():
    env = gymnasium.make("MountainCar-v0")
    env.action_space = gymnasium.spaces.Box(-1.0, 1.0, (3,))
    env = gymnasium.wrappers.TransformAction(env, lambda action: 1, env.action_space)
    model = EnvironmentModel(
        names=("p", "v"), f=lambda x, dt: [x[0] + x[1], x[1]], interval=1.0, noise=(1e-6, 1e-6),
        mean=(-0.5, 0.0), covariance=(0.01, 1e-4),
    )  # fmt: skip
    env = EstimatedObservation(NoisyObservation(env, {"p": {"h": "p", "R": 1e-4}}, model), show="mean")
    env.reset(seed=0)
    for _ in range(20):
        found = env.step(np.zeros(3, dtype=np.float32))[0]
    assert found[0] == pytest.approx(env.unwrapped.state[0], abs=0.03)


def test_a_delay_is_bridged_by_the_motion():
    """The filter of late readings is that of readings in time, as many steps before, carried forward."""
    late, model = {"encoder": {**ENCODER["encoder"], "delay": 3}}, CLASSIC_CONTROL["Pendulum"]
    now, delayed = (wrapped("Pendulum-v1", one, show="mean") for one in (ENCODER, late))
    now.reset(seed=3)
    delayed.reset(seed=3)
    means, torques = [now.estimates.mean[0].copy()], []
    for step in range(40):
        torques.append(np.array([1.5 * np.cos(step)]))
        now.step(torques[-1])
        delayed.step(torques[-1])
        means.append(now.estimates.mean[0].copy())
        if step >= 3:
            x = means[step + 1 - 3]
            for torque in torques[-3:]:
                x = np.array(model.f(x, 0.05, torque))
            np.testing.assert_allclose(turned(delayed.estimates.mean[0] - x, model), 0.0, atol=1e-12)


@pytest.mark.parametrize("mode", ["NextStep", "SameStep"])
@pytest.mark.parametrize("name", SENSORS)
def test_lanes_are_single_environments_bit_for_bit(name, mode):
    count, sensors, horizon = 3, SENSORS[name], {"max_episode_steps": 40}
    lanes = gymnasium.make_vec(
        name, num_envs=count, vectorization_mode="sync", vector_kwargs={"autoreset_mode": mode}, **horizon
    )
    lanes = vector.EstimatedObservation(vector.NoisyObservation(lanes, sensors), show=ALL)
    singles = [
        EstimatedObservation(NoisyObservation(gymnasium.make(name, **horizon), sensors), show=ALL)
        for _ in range(count)
    ]
    observations, _ = lanes.reset(seed=7)
    assert lanes.observation_space.contains(observations)
    np.testing.assert_array_equal(observations, [one.reset(seed=7 + i)[0] for i, one in enumerate(singles)])
    ended, episodes = [False] * count, 0
    lanes.action_space.seed(1)
    for _ in range(100):
        actions = lanes.action_space.sample()
        observations, _, terminations, truncations, infos = lanes.step(actions)
        for i, one in enumerate(singles):
            if ended[i]:
                found, ended[i] = one.reset()[0], False
            else:
                found, _, terminated, truncated, _ = one.step(actions[i])
                assert (terminated, truncated) == (terminations[i], truncations[i])
                ended[i] = terminated or truncated
                episodes += ended[i]
                if ended[i] and mode == "SameStep":
                    np.testing.assert_array_equal(infos["final_obs"][i], found)
                    found, ended[i] = one.reset()[0], False
            np.testing.assert_array_equal(observations[i], found)
    assert episodes >= count


def test_lanes_that_are_reset_by_a_mask():
    lanes = gymnasium.make_vec(
        "Pendulum-v1", num_envs=3, vectorization_mode="sync", vector_kwargs={"autoreset_mode": "Disabled"}
    )
    lanes = vector.EstimatedObservation(vector.NoisyObservation(lanes, ENCODER), show=ALL)
    before, _ = lanes.reset(seed=1)
    before = lanes.step(np.zeros((3, 1), dtype=np.float32))[0]
    mask = np.array([False, True, False])
    after, _ = lanes.reset(options={"reset_mask": mask})
    np.testing.assert_array_equal(after[~mask], before[~mask])
    assert (after[mask] != before[mask]).any()


def readings_of(sensors, steps, model=None, name="Pendulum-v1", lanes=200):
    """Readings of motionless lanes, ``(steps, lanes, m)``, and whether they were received."""
    env = vector.NoisyObservation(
        gymnasium.make_vec(name, num_envs=lanes, vectorization_mode="sync"), sensors
    )
    every, state = np.ones(lanes, dtype=bool), np.full((lanes, len(env.model.names)), 0.3)
    observation = state if env.model.observation is None else env.model.observation(state)
    env._read(observation, every, ~every, list(range(lanes)))
    found = [env.reading]
    for _ in range(steps - 1):
        env._read(observation)
        found.append(env.reading)
    return tuple(np.array(part) for part in zip(*found, strict=True))


def test_noise_has_the_covariance_that_is_stated():
    R = [[0.04, 0.01], [0.01, 0.09]]
    values, received = readings_of({"both": {"h": ["angle", "rate"], "R": R}}, 100, name="CartPole-v1")
    # 20,000 independent numbers: their variance is known to 1 %.
    np.testing.assert_allclose(np.cov(values.reshape(-1, 2).T), R, atol=0.003)
    np.testing.assert_allclose(values.mean(axis=(0, 1)), 0.3, atol=0.01)
    assert received.all()
    assert abs(np.corrcoef(values[1:, :, 0].ravel(), values[:-1, :, 0].ravel())[0, 1]) < 0.03


def test_noise_may_depend_on_the_state():
    sensors = {"angle": Sensor(h=lambda x: [x[0] * x[0]], R=lambda x: 0.01 + x[1] * x[1])}
    values, _ = readings_of(sensors, 100)
    assert values.mean() == pytest.approx(0.09, abs=0.01)
    assert values.var() == pytest.approx(0.1, rel=0.05)


def test_faults_of_sensors():
    values, received = readings_of({"encoder": {"h": "angle", "R": 1e-10, "bias": 0.2}}, 20)
    offsets = values[0, :, 0] - 0.3
    assert offsets.std() == pytest.approx(0.2, rel=0.2)
    np.testing.assert_allclose(values[:, :, 0] - 0.3, np.broadcast_to(offsets, (20, 200)), atol=1e-3)
    values, _ = readings_of({"encoder": {"h": "angle", "R": 0.01, "quantum": 0.25}}, 20)
    np.testing.assert_array_equal(values % 0.25, 0.0)
    _, received = readings_of({"encoder": {"h": "angle", "R": 0.01, "interval": 0.2}}, 21)
    np.testing.assert_array_equal(received[:, 0, 0], np.arange(21) % 4 == 0)
    values, received = readings_of({"encoder": {"h": "angle", "R": 0.01, "availability": 0.6}}, 100)
    assert received[0].all()
    assert received[1:].mean() == pytest.approx(0.6, abs=0.02)
    kept = np.flatnonzero(~received[1:, 0, 0]) + 1
    np.testing.assert_array_equal(values[kept, 0], values[kept - 1, 0])


def test_late_readings_are_those_of_before():
    now, late = (readings_of({"e": {"h": "angle", "R": 0.01, "delay": d}}, 30) for d in (0, 4))
    np.testing.assert_array_equal(late[0][4:], now[0][:-4])
    assert not late[1][:4].any()
    assert late[1][4:].all()


def test_agents_meet_the_same_noise():
    """The second episode of a seed, whatever happened in the first."""
    found = []
    for steps in (3, 70):
        env = NoisyObservation(gymnasium.make("Pendulum-v1"), ENCODER)
        env.reset(seed=9)
        for _ in range(steps):
            env.step(env.action_space.sample())
        _, _ = env.reset()
        angle = np.arctan2(*env.unwrapped._get_obs()[[1, 0]].astype(float))
        found.append(env.reading.values[0, 0] - angle)
    assert found[0] == pytest.approx(found[1], abs=1e-12)


def test_a_measured_angle_is_an_angle_in_whatever_form_it_is_named():
    forms = [
        {"h": "angle", "R": 0.01}, {"h": 0, "R": 0.01}, {"h": [[1.0, 0.0]], "R": 0.01},
        EnvironmentSensor(h="angle", R=0.01), Sensor(h=[[1.0, 0.0]], R=[[0.01]]),
    ]  # fmt: skip
    found = []
    for sensor in forms:
        env = wrapped("Pendulum-v1", {"encoder": sensor}, show=ALL)
        env.reset(seed=3)
        found.append([env.step([2.0])[0] for _ in range(100)])
        assert np.abs(np.array(found)[..., -1]).max() < np.pi
    for one in found[1:]:
        np.testing.assert_array_equal(one, found[0])


def test_lanes_without_a_seed_go_on():
    env = vector.NoisyObservation(
        gymnasium.make_vec("Pendulum-v1", num_envs=3, vectorization_mode="sync"), ENCODER
    )
    env.reset(seed=[4, 5, None])
    env.reset(seed=[None, 8, None])
    single = NoisyObservation(gymnasium.make("Pendulum-v1"), ENCODER)
    single.reset(seed=4)
    single.reset()
    np.testing.assert_array_equal(env.reading.values[0], single.reading.values[0])
    single.reset(seed=8)
    np.testing.assert_array_equal(env.reading.values[1], single.reading.values[0])


def test_mixed_readings_have_the_same_bits_in_any_number_of_lanes():
    R = [[0.04, 0.01, 0.02], [0.01, 0.09, 0.03], [0.02, 0.03, 0.05]]
    sensors = {"mixed": {"h": np.random.default_rng(0).normal(size=(3, 4)), "R": R}}
    found = [readings_of(sensors, 20, name="CartPole-v1", lanes=count)[0] for count in (1, 5, 64)]
    for one in found[1:]:
        np.testing.assert_array_equal(one[:, :1], found[0])


def test_readings_of_whole_numbers_are_not_whole():
    env = gymnasium.make("MountainCar-v0")
    env.observation_space = gymnasium.spaces.Box(0, 255, (2,), dtype=np.uint8)
    env = NoisyObservation(env, {"position": {"h": np.int64(0), "R": 1e-4}})
    found, _ = env.reset(seed=0)
    assert found.dtype == np.float32
    assert found == pytest.approx(env.unwrapped.state[0], abs=0.06)


def test_a_filter_that_is_lost_begins_anew():
    model = EnvironmentModel(
        names=("p", "v"), f=lambda x, dt: [x[0] * 1e12, x[1]], interval=1.0, noise=(1.0, 1.0), mean=(0.5, 0.1),
        covariance=(1.0, 4.0),
    )  # fmt: skip
    env = NoisyObservation(gymnasium.make("MountainCar-v0"), {"v": {"h": 1, "R": 1.0}}, model)
    env = EstimatedObservation(env, show=("mean", "deviation"))
    env.reset(seed=0)
    found = np.array([env.step(1)[0] for _ in range(20)])
    assert np.isfinite(env.estimates.mean).all()
    lost = found[:, 0] == 0.5
    assert 0 < lost.sum() < 20
    np.testing.assert_allclose(found[lost] - np.array([0.5, 0.1, 1.0, 2.0]), 0.0, atol=1e-6)


@pytest.mark.parametrize("control", ["noise", "gain"])
def test_an_action_steers_the_filter_and_zero_does_not(control):
    steered, plain = (wrapped("Pendulum-v1", ENCODER, control=one) for one in (control, None))
    own = steered.action_space.shape[0] - 1
    np.testing.assert_array_equal(steered.reset(seed=2)[0], plain.reset(seed=2)[0])
    for step in range(60):
        torque = np.array([np.sin(step)], dtype=np.float32)
        found = steered.step(np.concatenate([torque, np.zeros(own, dtype=np.float32)]))[0]
        np.testing.assert_array_equal(found, plain.step(torque)[0])
    found = steered.step(np.concatenate([torque, np.ones(own, dtype=np.float32)]))[0]
    assert (found != plain.step(torque)[0]).any()


def test_a_discrete_action_and_that_of_the_filter():
    env = wrapped("CartPole-v1", control="noise")
    env.action_space.seed(0)
    env.reset(seed=0)
    assert env.observation_space.contains(env.step(env.action_space.sample())[0])


def test_a_spec_is_json():
    spec = copy.deepcopy(gymnasium.spec("Pendulum-v1"))
    spec.additional_wrappers = (
        NoisyObservation.wrapper_spec(sensors=FAULTS),
        EstimatedObservation.wrapper_spec(competitor="unscented"),
    )
    env = gymnasium.make(spec)
    assert json.loads(env.spec.to_json())["additional_wrappers"][1]["name"] == "EstimatedObservation"
    again = gymnasium.make(EnvSpec.from_json(env.spec.to_json()))
    np.testing.assert_array_equal(env.reset(seed=4)[0], again.reset(seed=4)[0])
    for _ in range(20):
        action = env.action_space.sample()
        np.testing.assert_array_equal(env.step(action)[0], again.step(action)[0])


@pytest.mark.parametrize("name", SENSORS)
def test_wrapped_environments_pass_gymnasiums_check(name):
    check_env(NoisyObservation(gymnasium.make(name), SENSORS[name]), skip_render_check=True)
    check_env(wrapped(name), skip_render_check=True)


@pytest.mark.parametrize("control", [None, "noise"])
def test_copies_go_on_alike(control):
    env = wrapped("Pendulum-v1", FAULTS, control=control, show=ALL)
    env.action_space.seed(0)
    env.reset(seed=1)
    for _ in range(30):
        env.step(env.action_space.sample())
    copies = [pickle.loads(pickle.dumps(env)), copy.deepcopy(env)]
    for _ in range(60):
        action = env.action_space.sample()
        found = env.step(action)[0]
        for one in copies:
            np.testing.assert_array_equal(one.step(action)[0], found)


def test_a_model_of_ones_own_and_a_fitted_one():
    def drive(x, dt, u):
        return [x[0] + dt * x[1], x[1] + dt * (u[0] - 0.1 * x[1])]

    class Cart(gymnasium.Env):
        observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (2,))
        action_space = gymnasium.spaces.Box(-1.0, 1.0, (1,))

        def reset(self, *, seed=None, options=None):
            super().reset(seed=seed)
            self.state, self.count = self.np_random.normal(0.0, 1.0, 2), 0
            return self.state.astype(np.float32), {}

        def step(self, action):
            self.state, self.count = np.array(drive(self.state, 0.1, action)), self.count + 1
            return self.state.astype(np.float32), 0.0, False, self.count >= 50, {}

    own = EnvironmentModel(
        names=("x", "v"),
        f=drive,
        interval=0.1,
        noise=(1e-6, 1e-6),
        mean=(0, 0),
        covariance=(1, 1),
        inputs=("a",),
    )
    fitted = fit_model(Cart(), steps=2000, degree=1, interval=0.1, names=("x", "v"))
    moved = [np.array(one.f([0.4, -0.8], 0.1, [0.5])) for one in (own, fitted)]
    np.testing.assert_allclose(moved[1], moved[0], atol=1e-4)
    sensors = {"range": {"h": "x", "R": 0.01}}
    for model in (own, fitted):
        env = EstimatedObservation(NoisyObservation(Cart(), sensors, model), show="mean")
        env.reset(seed=0)
        errors = [env.step(np.array([0.3]))[0] - env.unwrapped.state for _ in range(50)]
        assert np.sqrt(np.mean(np.square(errors[20:]))) < 0.06


def image():
    env = gymnasium.make("Pendulum-v1")
    env.observation_space = gymnasium.spaces.Box(0, 255, (4, 4, 3), dtype=np.uint8)
    return env


def dictionary():
    env = gymnasium.make("Pendulum-v1")
    env.observation_space = gymnasium.spaces.Dict(x=gymnasium.spaces.Box(0.0, 1.0, (1,)))
    return env


def discrete(action=None):
    model = EnvironmentModel(
        names=("p", "v"), f=lambda x, dt, u: [x[0], x[1] + u[0]], interval=1.0, noise=(1, 1), mean=(0, 0),
        covariance=(1, 1), inputs=("force",), action=action,
    )  # fmt: skip
    return EstimatedObservation(
        NoisyObservation(gymnasium.make("MountainCar-v0"), {"p": {"h": 0, "R": 1}}, model)
    )


def pendulum(**sensor):
    return NoisyObservation(gymnasium.make("Pendulum-v1"), {"e": {"h": "angle", "R": 0.01, **sensor}})


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: NoisyObservation(image(), ENCODER), "is an image"),
        (lambda: NoisyObservation(dictionary(), ENCODER), "vector of numbers"),
        (lambda: pendulum(h="speed"), "component 'speed', and the state has 2: angle, rate"),
        (lambda: pendulum(h=7), "component 7"),
        (lambda: pendulum(h=[[1.0, 0.0, 0.0]]), "must be finite numbers of shape"),
        (lambda: pendulum(R=-1.0), "positive definite"),
        (lambda: pendulum(delay=-1), "delay of a sensor"),
        (lambda: pendulum(quantum=-1), "quantum of a sensor"),
        (lambda: pendulum(speed=1), "must be a Sensor, or a mapping"),
        (lambda: pendulum(h=["angle", "rate"]), "one sensor to each kind"),
        (lambda: pendulum(h=True), "component True"),
        (lambda: pendulum(R=np.nan), "positive definite"),
        (
            lambda: NoisyObservation(
                gymnasium.wrappers.TimeAwareObservation(gymnasium.make("CartPole-v1")), ENCODER
            ),
            "the observation has 5 fields",
        ),
        (lambda: NoisyObservation(gymnasium.make("Pendulum-v1", g=9.81), ENCODER), "g = 9.81"),
        (
            lambda: EstimatedObservation(
                NoisyObservation(
                    gymnasium.wrappers.RescaleAction(gymnasium.make("Pendulum-v1"), -1, 1), ENCODER
                )
            ),
            "below wrappers that change the action",
        ),
        (lambda: NoisyObservation(gymnasium.make("Pendulum-v1"), {}), "at least one"),
        (lambda: NoisyObservation(gymnasium.make("Pendulum-v1"), ENCODER, model="Pong"), "one of CartPole"),
        (
            lambda: EstimatedObservation(gymnasium.make("Pendulum-v1")),
            "wrap the environment in NoisyObservation",
        ),
        (lambda: EstimatedObservation(pendulum(), model="CartPole"), "give both wrappers one model"),
        (lambda: EstimatedObservation(pendulum(), competitor="ekf"), "one of extended, unscented"),
        (lambda: EstimatedObservation(pendulum(), show="truth"), "show must be"),
        (lambda: EstimatedObservation(pendulum(), control="evidence"), "noise or gain"),
        (
            lambda: vector.EstimatedObservation(
                vector.NoisyObservation(gymnasium.make_vec("Pendulum-v1", 2, "sync"), ENCODER),
                competitor=AverageReading,
            ),
            "wrap each environment",
        ),
        (lambda: discrete(), "a function from actions to these inputs"),
        (lambda: discrete(lambda action: np.zeros((len(action), 2))), "must return the 1 inputs force"),
        (
            lambda: EstimatedObservation(
                NoisyObservation(gymnasium.make("MountainCar-v0"), {"p": {"h": 0, "R": 1}})
            ),
            "no model is known of MountainCar-v0",
        ),
    ],
)
def test_bad_input_is_refused_before_the_first_step(make, words):
    with pytest.raises(ValueError, match=words):
        make()


@pytest.mark.parametrize("name", ["InvertedPendulum-v5"])
def test_a_fitted_model_of_mujoco(name):
    pytest.importorskip("mujoco")
    env = gymnasium.make(name)
    model = fit_model(env, steps=3000, degree=2, interval=0.04, names=("x", "angle", "v", "rate"))
    sensors = {"encoders": {"h": ["x", "angle"], "R": 1e-4}}
    env = EstimatedObservation(NoisyObservation(gymnasium.make(name), sensors, model), show="mean")
    env.action_space.seed(0)
    raw, estimated = [], []
    for seed in range(20):
        env.reset(seed=seed)
        for _ in range(30):
            found, _, terminated, _, _ = env.step(env.action_space.sample())
            truth = np.concatenate([env.unwrapped.data.qpos, env.unwrapped.data.qvel])
            raw.append(env.env.reading.values[0] - truth[:2])
            estimated.append(found[:2] - truth[:2])
            if terminated:
                break
    assert np.mean(np.square(estimated)) < 0.8 * np.mean(np.square(raw))


def test_a_loop_of_ppo_in_one_file_needs_no_special_case():
    """The calls that such a loop makes of a vector environment, with random actions."""

    def make():
        return gymnasium.wrappers.RecordEpisodeStatistics(wrapped("CartPole-v1", show=("mean", "nis")))

    lanes = gymnasium.vector.SyncVectorEnv([make] * 4)
    assert isinstance(lanes.single_action_space, gymnasium.spaces.Discrete)
    storage = np.zeros((64, 4, *lanes.single_observation_space.shape), dtype=np.float32)
    observation, _ = lanes.reset(seed=1)
    returns = []
    for step in range(64):
        storage[step] = observation
        observation, _, _, _, infos = lanes.step(lanes.action_space.sample())
        if "episode" in infos:
            returns += infos["episode"]["r"][infos["_episode"]].tolist()
    assert np.isfinite(storage).all()
    assert returns


def test_observations_that_are_not_finite_are_not_received():
    """A filter bridges them, with or without a control, and a lane that overflows begins anew."""
    sensors = {"encoder": {"h": ["position", "angle"], "R": 1e-4}}
    for control in (None, "noise"):
        steps = iter(range(99))
        broken = gymnasium.wrappers.TransformObservation(
            gymnasium.make("CartPole-v1"), lambda o, steps=steps: o * np.nan if next(steps) == 5 else o, None
        )
        env = EstimatedObservation(NoisyObservation(broken, sensors), control=control)
        env.reset(seed=0)
        zero = np.zeros(()) if control is None else np.zeros(env.action_space[1].shape)
        received = []
        for step in range(9):
            action = step % 2 if control is None else (step % 2, zero)
            observation, *_, info = env.step(action)
            received.append(bool(info["available"].all()))
            assert np.isfinite(observation).all()
        assert received == [step != 4 for step in range(9)]
        assert env.estimates.nis > 0.0


def test_copies_define_no_further_problem():
    model = EnvironmentModel(("x",), lambda x, dt: [x[0]], 1.0, [1.0], [0.0], [1.0])
    sensors = {"s": EnvironmentSensor(h=[[1.0]], R=[[1.0]])}
    first = estimates.define_problem(model, sensors)
    assert estimates.define_problem(copy.deepcopy(model), copy.deepcopy(sensors)) is first


def test_a_fit_needs_more_episodes_than_components():
    with pytest.raises(ValueError, match="rollouts of 3 components need 4 episodes, got 1"):
        fit_model(gymnasium.make("Pendulum-v1").unwrapped, steps=400)
