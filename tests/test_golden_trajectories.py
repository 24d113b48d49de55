"""Stored trajectories: a change of what is seen, done or paid raises ``interface``, later the version of the id.

One file for each id and control, ``golden/<Name>-<control>.json``: seed, actions, and what they led to in the
default scenario. A new environment or control gets its files by

    python tests/test_golden_trajectories.py

which writes those that are missing and leaves the others alone. To accept a change, raise the task's ``interface``, by
which agents that were trained before are refused, delete the file and run it again. Once 0.1.0 is tagged, the version
of the id goes up instead.
"""

import functools
import json
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
from models import make_model
from rounding import REPETITIONS, assert_near, move_roundings, moved_parameters, tolerance

from filtergym.envs.engine.catalogue import catalogue

FOLDER = Path(__file__).parent / "golden"
SEED = 7
DECISIONS = 30
FEWER = 10
"""Decisions that are compared to within rounding: what that may do takes seconds to ask. Other controls than the first
one go on in the same world and are compared no further, nor is NumPy; the steps of compiled code under other controls,
which take a second to trace, are those of NumPy by tests of their own."""
LATER = float(np.finfo(np.float32).eps)
"""Of a number or of one, what later decisions may differ by: agents see no finer."""


def stored_file(env_id, control):
    return FOLDER / f"{env_id.split('/')[-1]}-{control}.json"


@functools.cache
def stored(env_id, control):
    """The stored trajectory, of the first control to its end."""
    path = stored_file(env_id, control)
    assert path.exists(), (
        f"{path.name} is missing: run `python tests/test_golden_trajectories.py` and look at what it wrote"
    )
    found = json.loads(path.read_text())
    if control != catalogue()[env_id].controls[0]:
        for name, length in (("actions", FEWER), ("observations", FEWER + 1), ("rewards", FEWER)):
            found[name] = found[name][:length]
    return found


@functools.cache
def trajectory_of_stored_actions(env_id, control, backend, decisions):
    """Trajectory that the first stored actions lead to now."""
    return trajectory(env_id, control, stored(env_id, control)["actions"][:decisions], backend)


def trajectory(env_id, control, actions, backend="numpy"):
    env = gym.make(env_id, control=control, backend=backend, disable_env_checker=True)
    shown, paid = [env.reset(seed=SEED)[0].tolist()], []
    discrete = isinstance(env.action_space, gym.spaces.Discrete)
    for action in actions:
        observation, reward, *_ = env.step(action if discrete else np.array(action))
        shown.append(observation.tolist())
        paid.append(reward)
    fields = [field.name for field in env.unwrapped.observation_fields]
    interface = env.unwrapped.task.interface
    return {"interface": interface, "fields": fields, "observations": shown, "rewards": paid}


@functools.cache
def tolerances(env_id, control):
    """What rounding may do to the trajectory, that of the constants which follow from the parameters included."""
    actions = stored(env_id, control)["actions"][:FEWER]
    parameters = make_model(env_id, control).task.parameters
    found = {"observations": [], "rewards": []}
    for repetition in REPETITIONS:
        keywords = moved_parameters(parameters, repetition)
        env = gym.make_vec(env_id, num_envs=8, control=control, backend="numpy", **keywords)
        shown, paid = [move_roundings(env, repetition).reset(seed=[SEED] * 8)[0]], []
        for action in actions:
            observation, reward, *_ = env.step(np.array([action] * 8))
            shown.append(observation)
            paid.append(reward)
        found["observations"] += list(np.stack(shown, axis=1))
        found["rewards"] += list(np.stack(paid, axis=1))
    here = trajectory_of_stored_actions(env_id, control, "numpy", FEWER)
    return {name: tolerance(np.array(here[name]), others, time=0) for name, others in found.items()}


@pytest.mark.processors
def test_trajectory_is_the_stored_one(env_id, control):
    assert_is_stored(env_id, control, "numpy")


@pytest.mark.processors
def test_compiled_trajectory_is_the_stored_one(env_id):
    pytest.importorskip("llvmlite")
    assert_is_stored(env_id, catalogue()[env_id].controls[0], "compiled")


def assert_is_stored(env_id, control, backend):
    expected = stored(env_id, control)
    decisions = FEWER if backend == "numpy" else DECISIONS
    now = trajectory_of_stored_actions(env_id, control, backend, decisions)
    assert now["interface"] == expected["interface"]
    assert now["fields"] == expected["fields"]
    for name, one in (("observations", 1), ("rewards", 0)):
        then = expected[name][: decisions + one]
        np.testing.assert_allclose(now[name], then, rtol=LATER, atol=LATER, err_msg=name)
        first = slice(FEWER + one)
        if now[name][first] != then[first]:  # compiled, or on another processor
            assert_near(now[name][first], then[first], tolerances(env_id, control)[name], name)


def test_no_file_is_left_over():
    wanted = {stored_file(id, control).name for id, cls in catalogue().items() for control in cls.controls}
    assert {path.name for path in FOLDER.glob("*.json")} == wanted


def write_missing():
    FOLDER.mkdir(exist_ok=True)
    for env_id, cls in catalogue().items():
        for control in cls.controls:
            path = stored_file(env_id, control)
            if path.exists():
                continue
            space = gym.make(env_id, control=control).action_space
            space.seed(SEED)
            actions = [space.sample().tolist() for _ in range(DECISIONS)]
            record = {"seed": SEED, "actions": actions, **trajectory(env_id, control, actions)}
            rows = [f'"{key}": {json.dumps(value)}' for key, value in record.items()]
            path.write_text("{\n" + ",\n".join(rows).replace("], [", "],\n[") + "\n}\n")
            print(f"wrote {path}")


if __name__ == "__main__":
    write_missing()
