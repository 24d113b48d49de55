"""What other libraries rely on beside reset and step: keywords they try, specs, videos, types, copies."""

import concurrent.futures
import copy
import functools
import multiprocessing
import pickle

import gymnasium as gym
import numpy as np
import pytest
from contract import BACKENDS, Subject, assert_properties, continued
from gymnasium.envs.registration import EnvSpec
from gymnasium.vector import AutoresetMode
from gymnasium.wrappers import TimeAwareObservation, TimeLimit
from models import KINDS

import filtergym  # noqa: F401  (registers the environments)
from filtergym.envs.data.trajectory import Trajectory
from filtergym.envs.drawing import rendering
from filtergym.envs.engine.lanes import ModelStepper
from filtergym.envs.interface.environment import TaskEnv
from filtergym.envs.interface.vector_environment import TaskVectorEnv

ID = "filtergym/ManeuveringTarget-v0"
make_three = functools.partial(gym.make_vec, num_envs=3)


def actions_for(env, count, seed=0):
    env.action_space.seed(seed)
    return [env.action_space.sample() for _ in range(count)]


def assert_all_equal(some, others):
    for one, other in zip(some, others, strict=True):
        np.testing.assert_array_equal(one, other)


def length(env):
    env.reset(seed=0)
    action, count, finished = env.action_space.sample(), 0, False
    while not finished:
        finished, count = np.all(env.step(action)[3]), count + 1
    return count


# --- one pass over every environment


def test_pictures():
    assert_properties(Subject(ID), [draws_without_a_trace_and_copies_alike])


@pytest.mark.parametrize("id", KINDS)
def test_every_kind(id):
    assert_properties(Subject(id, backend="numpy"), PROPERTIES)
    for backend in BACKENDS:
        assert_properties(Subject(id, backend=backend), [rounds_float64_to_float32])


def refuses_keywords_as_a_client_expects_who_tries_them(subject):
    # TorchRL's GymEnv does, and takes the keyword back if Python raises this.
    for make in (gym.make, make_three):
        with pytest.raises(TypeError, match="unexpected keyword argument 'frameskip'"):
            make(subject.id, frameskip=1)
        with pytest.raises(
            ValueError, match=r"unexpected keyword argument 'horizons'.*did you mean 'horizon'"
        ):
            make(subject.id, horizons=5)


def spec_has_the_length_of_an_episode(subject):
    for make in (subject.single, functools.partial(subject.native, 3)):
        env, limited, unlimited = (make(**k) for k in ({}, *({"max_episode_steps": n} for n in (3, -1))))
        assert env.spec.max_episode_steps == length(env) == 5
        assert limited.spec.max_episode_steps == length(limited) == 3
        assert unlimited.spec.max_episode_steps == length(unlimited) == 5
        spec = EnvSpec.from_json(env.spec.to_json())
        # A vector's spec holds the number of environments.
        again = gym.make(spec) if make == subject.single else gym.make_vec(spec)
        assert again.spec.max_episode_steps == length(again) == 5


def scenarios_have_their_length(subject):
    task = subject.single().unwrapped.task
    for name, scenario in (
        (None, task.scenarios[task.default_scenario]),
        max(task.scenarios.items(), key=lambda one: one[1].parameters.get("horizon", 0)),
    ):
        parameters = task.Parameters(**scenario.parameters)
        expected = parameters.horizon // parameters.decision_interval
        for make in (gym.make, make_three)[: 1 + (name is None)]:
            env = make(subject.id, scenario=name, backend="numpy")
            assert env.spec.max_episode_steps == expected, name


def limits_only_whom_asks(subject):
    def limited(env):
        return isinstance(env, TimeLimit) or (isinstance(env, gym.Wrapper) and limited(env.env))

    assert not limited(subject.single())
    assert limited(subject.single(max_episode_steps=3))


def is_aware_of_time(subject):
    env = TimeAwareObservation(subject.single(), normalize_time=True)
    shown, _ = env.reset(seed=0)
    times, finished = [shown[-1]], False
    while not finished:
        shown, _, _, finished, _ = env.step(env.action_space.sample())
        times.append(shown[-1])
    np.testing.assert_allclose(times, np.arange(6) / 5, rtol=1e-6)


def rounds_float64_to_float32(subject):
    fine, rounded = (
        subject.native(3, dtype=dtype, autoreset_mode="SameStep") for dtype in ("float64", "float32")
    )
    assert rounded.single_observation_space.dtype == rounded.observation_space.dtype == np.float32
    assert fine.single_observation_space.dtype == np.float64
    pairs = [(fine.reset(seed=0)[0], rounded.reset(seed=0)[0])]
    for action in actions_for(fine, 7):
        one, other = fine.step(action), rounded.step(action)
        pairs += zip(one[:2], other[:2], strict=True)
        if one[3].any():
            final = [info["final_obs"] for info in (one[4], other[4])]
            pairs.append(tuple(np.stack([np.asarray(row) for row in rows]) for rows in final))
    assert len(pairs) == 1 + 2 * 7 + 1
    for exact, coarse in pairs:
        assert np.asarray(coarse).dtype == np.float32
        np.testing.assert_array_equal(np.asarray(exact).astype(np.float32), np.asarray(coarse))


def rounds_a_single_environment_as_a_vector(subject):
    env, vector = subject.single(dtype="float32"), subject.native(1, dtype="float32")
    shown = env.reset(seed=2)[0]
    assert env.observation_space.dtype == shown.dtype == np.float32
    np.testing.assert_array_equal(shown, vector.reset(seed=2)[0][0])
    for action in actions_for(env, 5):
        shown, paid, *_ = env.step(action)
        many, all_paid, *_ = vector.step(np.asarray(action)[None])
        assert env.observation_space.contains(shown)
        np.testing.assert_array_equal(shown, many[0])
        assert type(paid) is float
        assert paid == all_paid[0]


def draws_without_a_trace_and_copies_alike(subject):
    """To draw, close or copy a picture changes no episode, and a copy draws what the original does."""
    plain, env = subject.single(), subject.single(render_mode="rgb_array")
    np.testing.assert_array_equal(plain.reset(seed=3)[0], env.reset(seed=3)[0])
    actions = actions_for(env, 5)
    assert_all_equal(continued(plain, actions[:2]), continued(env, actions[:2]))
    env.render()
    other = pickle.loads(pickle.dumps(env))
    expected = continued(plain, actions[2:])
    assert_all_equal(expected, continued(env, actions[2:]))
    assert_all_equal(expected, continued(other, actions[2:]))
    drawn = other.render()
    assert (drawn.shape, drawn.dtype) == ((608, 960, 3), np.uint8)
    np.testing.assert_array_equal(env.render(), drawn)


PROPERTIES = (
    refuses_keywords_as_a_client_expects_who_tries_them,
    spec_has_the_length_of_an_episode,
    scenarios_have_their_length,
    limits_only_whom_asks,
    is_aware_of_time,
    rounds_a_single_environment_as_a_vector,
)


@pytest.fixture(scope="module")
def elsewhere():
    """A process that starts afresh."""
    context = multiprocessing.get_context("spawn")
    with concurrent.futures.ProcessPoolExecutor(1, mp_context=context) as pool:
        yield pool


@pytest.mark.parametrize("env_id", KINDS)
def test_episodes_go_on_in_another_process(env_id, short, elsewhere):
    for make in (gym.make, make_three):
        env = make(env_id, **short)
        env.reset(seed=3)
        actions = actions_for(env, 5)
        continued(env, actions[:2])
        there = elsewhere.submit(continued, env, actions[2:]).result(timeout=120)
        assert_all_equal(continued(env, actions[2:]), there)
        again = elsewhere.submit(make, env.spec if make is gym.make else env_id).result(timeout=120)
        assert again.unwrapped.task.id == env_id


# --- keywords


def test_keywords_of_the_environment_itself_are_hinted_at_too():
    for name, meant in (("contol", "control"), ("scenari", "scenario"), ("detail_info", "detailed_info")):
        with pytest.raises(ValueError, match=f"'{name}'.*did you mean '{meant}'"):
            gym.make(ID, **{name: "x"})


# --- specs as text

FLIGHT = Trajectory(
    time=np.arange(0.0, 200.0, 7.3),
    position=np.stack([2e4 + 100.3 * np.arange(28), 5e3 + 0.1 * np.arange(28) ** 2], axis=1),
    name="mine",
)


@pytest.mark.parametrize(("make", "velocity"), [(gym.make, True), (make_three, False)])
def test_a_trajectory_survives_json(make, velocity):
    moving = np.gradient(FLIGHT.position, FLIGHT.time, axis=0) if velocity else None
    flight = Trajectory(FLIGHT.time, FLIGHT.position, moving, "mine")
    env = make(ID, scenario=flight, gains=np.array([0.2, 0.8]), horizon=np.int64(20))
    spec = EnvSpec.from_json(env.spec.to_json())
    again = gym.make(spec) if make is gym.make else gym.make_vec(spec)
    np.testing.assert_array_equal(env.reset(seed=0)[0], again.reset(seed=0)[0])
    actions = actions_for(env, 5)
    assert_all_equal(continued(env, actions), continued(again, actions))
    assert again.unwrapped.task.parameters == env.unwrapped.task.parameters


def test_a_mode_of_resets_survives_json():
    env = gym.make_vec(ID, num_envs=2, autoreset_mode=AutoresetMode.SAME_STEP)
    again = gym.make_vec(EnvSpec.from_json(env.spec.to_json()))
    assert again.unwrapped.autoreset_mode is AutoresetMode.SAME_STEP


def test_the_path_of_a_file_is_a_scenario(tmp_path):
    path = tmp_path / "flight.csv"
    rows = np.column_stack([FLIGHT.time, FLIGHT.position])
    np.savetxt(path, rows, delimiter=",", header="time,x,y", comments="")
    env = gym.make(ID, scenario=path)
    again = gym.make(EnvSpec.from_json(env.spec.to_json()))
    np.testing.assert_array_equal(env.reset(seed=0)[0], again.reset(seed=0)[0])


# --- wrong arguments

MAKING = {
    "scenario list": ({"scenario": ["paper", "atc"]}, "a scenario is a name.*got \\['paper', 'atc'\\]"),
    "scenario dictionary": ({"scenario": {"tme": [0, 1]}}, "a trajectory as a dictionary has time.*got 'tme'"),
    "scenario half": ({"scenario": {"time": [0, 1], "position": [[0, 0], [1]]}}, "scenario as a dictionary: "),
    "control": ({"control": 0}, "unknown control 0: choose from evidence, gains, gain"),
    "reward list": ({"reward": ["cost"]}, "unknown reward .*did you mean 'cost'"),
    "backend": ({"backend": 1}, "unknown backend 1"),
    "render_mode": ({"render_mode": "rgb"}, "unknown render_mode 'rgb'.*rgb_array"),
    "detailed_info": ({"detailed_info": "no"}, "detailed_info must be True or False, got 'no'"),
    "dtype": ({"dtype": "float16"}, "unknown dtype 'float16': did you mean 'float"),
    "dtype class": ({"dtype": np.float32}, "unknown dtype .*choose from float64, float32"),
    "task": ({"task": 5}, "an environment is named by its id.*got 5"),
}  # fmt: skip
MAKING_VECTORS = {
    "num_envs word": ({"num_envs": "2"}, "num_envs must be an integer of at least 1, got '2'"),
    "threads": ({"threads": "2"}, "threads must be an integer of at least 1, got '2'"),
    "autoreset_mode": ({"autoreset_mode": "samestep"}, "unknown autoreset_mode 'samestep': did you mean 'SameStep'"),
    "max_episode_steps": ({"max_episode_steps": 0}, "max_episode_steps must be an integer of at least 1, got 0"),
    "device": ({"device": "cuda"}, "works on the CPU only, got device 'cuda'"),
    "render_mode human": ({"render_mode": "human"}, "a window for one episode: use gymnasium.make"),
}  # fmt: skip


def assert_refused(face, keywords, message):
    with pytest.raises((ValueError, TypeError), match=message) as caught:
        face(**{"task": ID, **keywords})
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("face", [TaskEnv, TaskVectorEnv])
def test_wrong_arguments(face):
    cases = MAKING if face is TaskEnv else MAKING | MAKING_VECTORS
    for keywords, message in cases.values():
        assert_refused(face, keywords, message)


RESETS = {
    "seed word": ({"seed": "1"}, "a seed is None or an integer of at least 0, got '1'"),
    "seed negative": ({"seed": -1}, "a seed is None or an integer of at least 0, got -1"),
    "options list": ({"options": [1]}, r"options of a reset are a dictionary or None, got \[1\]"),
    "unknown option": ({"options": {"reset_masks": 1}}, "unknown option of a reset 'reset_masks'"),
}
RESETS_OF_VECTORS = {
    "seeds few": ({"seed": [1]}, "expected 2 seeds, one for each sub-environment, got 1"),
    "seeds negative": ({"seed": [1, -1]}, "a seed is None or an integer of at least 0, got -1"),
    "mask": ({"options": {"reset_mask": "all"}}, "'reset_mask'. must be a boolean array .*got 'all'"),
    "shortened ragged": ({"options": {"shortened_by": [[1], [1, 2]]}}, "'shortened_by'. must hold 2 integers"),
}  # fmt: skip


def assert_refused_without_a_trace(env, untouched, keywords, message):
    for one in (env, untouched):
        one.reset(seed=4)
    with pytest.raises((ValueError, TypeError), match=message):
        env.reset(**keywords)
    actions = actions_for(env, 3)
    assert_all_equal(continued(env, actions), continued(untouched, actions))
    np.testing.assert_array_equal(env.reset()[0], untouched.reset()[0])


@pytest.mark.parametrize("face", [TaskEnv, TaskVectorEnv])
def test_wrong_arguments_of_a_reset(face):
    many = {} if face is TaskEnv else {"num_envs": 2}
    env, untouched = (face(ID, **many) for _ in range(2))
    for keywords, message in (RESETS if face is TaskEnv else RESETS | RESETS_OF_VECTORS).values():
        assert_refused_without_a_trace(env, untouched, keywords, message)


def test_seeds_may_be_numpys():
    single, vector = TaskEnv(ID), TaskVectorEnv(ID, 2)
    expected = single.reset(seed=5)[0]
    np.testing.assert_array_equal(single.reset(seed=np.int64(5))[0], expected)
    for seed in (np.uint32(5), np.array([5, 9]), (5, None), [np.int64(5), 6]):
        np.testing.assert_array_equal(vector.reset(seed=seed)[0][0], expected)


# --- gradients


def test_gradients_flow_through_float32():
    torch = pytest.importorskip("torch")
    slopes = []
    for dtype in ("float64", "float32"):
        env = TaskVectorEnv(ID, 2, "gain", backend="torch", dtype=dtype, horizon=5)
        env.reset(seed=0)
        action = torch.zeros((2, 1), dtype=torch.float64, requires_grad=True)
        env.step(action)
        _, paid, *_ = env.step(action)
        paid.sum().backward()
        slopes.append(action.grad.numpy())
    assert (slopes[0] != 0.0).all()
    np.testing.assert_allclose(slopes[0], slopes[1], rtol=1e-6)


# --- pictures of vectors


@pytest.mark.parametrize("mode", list(AutoresetMode))
def test_a_vector_draws_what_single_environments_draw(mode, monkeypatch):
    monkeypatch.setattr(rendering, "MAX_PICTURES", 1)
    keywords = {"render_mode": "rgb_array", "horizon": 4, "control": "weights"}
    vector = TaskVectorEnv(ID, 2, autoreset_mode=mode, **keywords)
    single = TaskEnv(ID, **keywords)
    single.picture.caption = "sub-environment 0"
    vector.reset(seed=3), single.reset(seed=3)
    actions = actions_for(vector, 7)
    for step, action in enumerate(actions):
        if mode is AutoresetMode.DISABLED and step == 4:
            vector.reset(), single.reset()
        *_, finished, _ = vector.step(action)
        if mode is AutoresetMode.NEXT_STEP and step == 4:
            single.reset()
        else:
            single.step(action[0])
        if mode is AutoresetMode.SAME_STEP and finished.all():
            single.reset()
    assert single.picture.count == {"NextStep": 2, "SameStep": 3, "Disabled": 3}[mode.value]
    frames = vector.render()
    assert isinstance(frames, tuple)
    np.testing.assert_array_equal(frames[0], single.render())
    assert [frame.min() < 255 for frame in frames] == [True, False]
    assert {frame.shape for frame in frames} == {(608, 960, 3)}
    vector.close()


@pytest.mark.parametrize("backend", BACKENDS[1:])
def test_drawing_a_vector_leaves_its_episodes_alone(backend, monkeypatch):
    monkeypatch.setattr(rendering, "MAX_PICTURES", 1)
    subject = Subject(ID, backend=backend)
    plain, drawn = (subject.native(2, render_mode=mode) for mode in (None, "rgb_array"))
    np.testing.assert_array_equal(plain.reset(seed=0)[0], drawn.reset(seed=0)[0])
    actions = actions_for(plain, 7)
    assert_all_equal(continued(plain, actions), continued(drawn, actions))
    assert [(frame.shape, frame.dtype) for frame in drawn.render()] == [((608, 960, 3), np.uint8)] * 2


def test_the_functions_of_the_model_are_left_to_compiled_code_without_a_render_mode(monkeypatch):
    pytest.importorskip("llvmlite")
    called = []
    monkeypatch.setattr(ModelStepper, "decide", lambda *_: called.append("decide"))
    env = TaskVectorEnv(ID, 2, backend="compiled")
    env.reset(seed=0)
    env.step(env.action_space.sample())
    assert called == []
    assert env.pictures is None


# --- copies


def test_copies_of_vectors_are_drawn_alike(monkeypatch):
    monkeypatch.setattr(rendering, "MAX_PICTURES", 1)
    env = gym.make_vec(ID, num_envs=2, render_mode="rgb_array", horizon=5)
    env.reset(seed=3)
    actions = actions_for(env, 5)
    continued(env, actions)
    drawn = env.render()
    # What was closed is drawn anew, and can then be copied as before.
    env.close()
    again = pickle.loads(pickle.dumps(env))
    np.testing.assert_array_equal(again.render(), drawn)
    np.testing.assert_array_equal(copy.deepcopy(again).render(), drawn)
