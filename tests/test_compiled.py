"""Compiled steps: as near to NumPy's as rounding allows, the same bits for every N, everywhere that NumPy goes."""

import multiprocessing
import warnings
from concurrent.futures import ThreadPoolExecutor

import gymnasium as gym
import numpy as np
import pytest
from models import KINDS, make_model
from rounding import assert_same, flown_side_by_side

from filtergym.envs.engine import compiled as compiled_tasks
from filtergym.envs.engine.catalogue import catalogue
from filtergym.envs.interface.vector_environment import TaskVectorEnv
from filtergym.envs.maneuvering_target.task import TASK as MANEUVERING
from filtergym.envs.maneuvering_target.world import RadarWorld

pytest.importorskip("llvmlite")


def compare(env_id, count, fly, **keywords):
    """What ``fly`` finds in a vector compiled, on NumPy, and a function that finds it with roundings moved."""

    def make(backend):
        env = gym.make_vec(env_id, num_envs=count, backend=backend, **keywords)
        assert env.unwrapped.backend == backend
        return env

    return flown_side_by_side(fly, lambda: make("compiled"), lambda: make("numpy"))


def flown(env, actions, **reset):
    found = [env.reset(seed=3, **reset)[0]]
    for action in actions:
        found += [np.asarray(part) for part in env.step(action)[:4]]
    return found


def assert_same_episodes(env_id, count, actions, reset=None, **keywords):
    def fly(env):
        first, *steps = flown(env, sampled(env, actions), **(reset or {}))
        return [np.stack([first, *steps[::4]]), *(np.stack(steps[i::4]) for i in (1, 2, 3))]

    found, expected, moved = compare(env_id, count, fly, **keywords)
    for i, name in enumerate(("observation", "reward", "terminated", "truncated")):
        assert_same(found[i], expected[i], lambda i=i: [other[i] for other in moved()], name, time=0, lanes=1)


def sampled(env, count):
    env.action_space.seed(0)
    return [env.action_space.sample() for _ in range(count)]


WITHIN_OTHERS = {
    "filtergym/TightlyCoupledNavigation-v0": {
        "rates-lost", "two-satellites", "accelerometer-failure", "urban", "coloured-ranges", "satellite-bias",
    },
}  # fmt: skip
"""Scenarios all of whose disturbances others have with other numbers, where each takes a second to trace."""


@pytest.mark.processors
def test_every_scenario_is_that_of_numpy(env_id, short):
    """Under one control; what each shows, is rewarded and reports is compared over a few decisions."""
    for scenario in set(catalogue()[env_id].scenarios) - WITHIN_OTHERS.get(env_id, set()):
        assert_same_episodes(env_id, 7, 3, scenario=scenario, **short)


def test_a_flight_without_manoeuvres_is_that_of_numpy():
    assert_same_episodes(MANEUVERING.id, 7, 8, maneuver_count=(0, 0))


@pytest.mark.parametrize("env_id", KINDS)
@pytest.mark.parametrize(("reward", "mode"), [("relative", "NextStep"), ("cost-and-likelihood", "SameStep")])
def test_rewards_and_autoreset_are_those_of_numpy(env_id, short, reward, mode):
    shortened = {"options": {"shortened_by": np.arange(7) % 3}}
    assert_same_episodes(env_id, 7, 12, shortened, reward=reward, autoreset_mode=mode, **short)


@pytest.mark.processors
def test_details_are_those_of_numpy(env_id, control, short):
    """Beside observation and reward."""

    def fly(env):
        env.reset(seed=2)
        steps = [env.step(action) for action in sampled(env, 3)]
        return [{"observation": shown, "reward": paid, **info} for shown, paid, _, _, info in steps]

    runs = compare(env_id, 7, fly, control=control, detailed_info=True, **short)
    for step, (found, expected) in enumerate(zip(*runs[:2], strict=True)):
        assert found.keys() == expected.keys()
        for name, values in expected.items():
            assert found[name].dtype == values.dtype, name

            def moved(step=step, name=name):
                return [other[step][name] for other in runs[2]()]

            # Zeros of a covariance are differences of its large numbers.
            assert_same(found[name], values, moved, name, lanes=tuple(range(values.ndim)))


@pytest.mark.parametrize("env_id", KINDS)
def test_looking_at_the_state_between_steps_changes_nothing(env_id, short, random_actions):
    plain, looked_at = (gym.make(env_id, backend="compiled", **short).unwrapped for _ in range(2))
    np.testing.assert_array_equal(plain.reset(seed=5)[0], looked_at.reset(seed=5)[0])
    for step in range(3):
        action = random_actions(plain.action_space, 1, step)[0]
        state = looked_at.fleet.only.state
        looked_at.fleet.only.state = state  # through the arrays, not the stepper's memory
        one, other = plain.step(action), looked_at.step(action)
        np.testing.assert_array_equal(one[0], other[0])
        assert one[1] == other[1]


def _elsewhere(pipe):
    env = gym.make("filtergym/ManeuveringTarget-v0", control="gain", backend="compiled", horizon=5)
    env.reset(seed=1)
    pipe.send([env.step(np.zeros(1))[0] for _ in range(4)])


@pytest.mark.skipif("fork" not in multiprocessing.get_all_start_methods(), reason="no fork here")
def test_a_forked_process_sees_the_same():
    here, there = multiprocessing.Pipe()
    _elsewhere(there)  # before the fork, so that code is loaded already
    context = multiprocessing.get_context("fork")
    process = context.Process(target=_elsewhere, args=(there,))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # threads of other tests
        process.start()
    process.join(120)
    assert process.exitcode == 0
    for one, other in zip(here.recv(), here.recv(), strict=True):
        np.testing.assert_array_equal(one, other)


def test_environments_are_made_in_threads():
    def flight(seed):
        env = gym.make_vec(
            "filtergym/LooselyCoupledNavigation-v0", num_envs=8, backend="compiled", horizon=70
        )
        return flown(env, [np.zeros(env.action_space.shape)] * 5)

    compiled_tasks._trace_once.cache_clear()
    with ThreadPoolExecutor(4) as pool:
        first, *others = pool.map(flight, range(4))
    for other in others:
        for one, two in zip(first, other, strict=True):
            np.testing.assert_array_equal(one, two)


# --- which backend


def test_backends_by_name(monkeypatch):
    assert gym.make("filtergym/UavAutopilot-v0").unwrapped.backend == "compiled"
    assert gym.make("filtergym/UavAutopilot-v0", backend="numpy").unwrapped.backend == "numpy"
    with pytest.raises(ValueError, match="did you mean 'compiled'"):
        gym.make("filtergym/UavAutopilot-v0", backend="compile")
    with pytest.raises(ValueError, match="make_vec"):
        gym.make("filtergym/UavAutopilot-v0", backend="torch")
    with pytest.raises(ValueError, match="threads must be an integer of at least 1"):
        gym.make_vec("filtergym/UavAutopilot-v0", num_envs=2, threads=0)
    # Without llvmlite.
    monkeypatch.setattr("filtergym.envs.engine.backend.AVAILABLE", False)
    monkeypatch.setattr(compiled_tasks, "AVAILABLE", False)
    assert gym.make("filtergym/UavAutopilot-v0").unwrapped.backend == "numpy"
    with pytest.raises(ImportError, match=r"pip install 'filtergym\[fast\]'"):
        gym.make("filtergym/UavAutopilot-v0", backend="compiled")


class Branching(RadarWorld):
    """Its arithmetic depends on a branch that depends on the numbers."""

    def advance(self, truth, noise, feedback):
        if truth.scan[0] > 3.0:  # the line to name
            noise = 2.0 * noise
        return super().advance(truth, noise, feedback)


class Outlandish(RadarWorld):
    """It calls what the namespace does not have."""

    def advance(self, truth, noise, feedback):
        return super().advance(truth, noise + 0.0 * self.xp.cumsum(noise, axis=0), feedback)


@pytest.mark.parametrize(
    ("world", "pattern"),
    [
        (Branching, r"depends on the numbers.*test_compiled\.py, line \d+: if truth\.scan"),
        (Outlandish, "cumsum"),
    ],
)
def test_what_cannot_be_traced_runs_with_numpy(monkeypatch, world, pattern):
    monkeypatch.setattr(MANEUVERING, "World", world)
    compiled_tasks._trace_once.cache_clear()
    with pytest.warns(UserWarning, match=pattern) as warned:
        env = gym.make(MANEUVERING.id, control="gain")
    assert len([w for w in warned if "runs with NumPy" in str(w.message)]) == 1
    assert env.unwrapped.backend == "numpy"
    env.reset(seed=0)
    assert np.isfinite(env.step(np.zeros(1))[1])
    with pytest.raises(ValueError, match="cannot be compiled"):
        gym.make(MANEUVERING.id, backend="compiled")
    compiled_tasks._trace_once.cache_clear()


def test_a_report_that_cannot_be_traced_is_made_with_numpy():
    model = make_model(MANEUVERING.id, "gain", horizon=5, backend="compiled")

    def odd(model, episode):
        return {"cost": model.cost(episode), "largest": np.full(8, float(model.cost(episode).max()))}

    env = TaskVectorEnv(MANEUVERING.id, 3, "gain", backend="compiled", horizon=5)
    env.reset(seed=0)
    with pytest.warns(UserWarning, match="odd of filtergym/ManeuveringTarget-v0 is not compiled"):
        ((found, _),) = env.fleet.only.decide(np.zeros((3, 1)), odd)
    assert found["largest"][0] == found["cost"].max()
    with pytest.warns(UserWarning, match="is not compiled"):
        model.run(lambda model, episode: float(episode.max()), np.ones((2, 8)))
