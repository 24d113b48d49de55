"""The episode's context in ``info``, and observations for critics: what they say is true, and no policy is shown it."""

import re
from pathlib import Path

import gymnasium
import numpy as np
import pytest
from models import KINDS, make_model

from filtergym import evaluate, make_policy
from filtergym.baselines.problem import problem_of
from filtergym.envs.contract.world import World
from filtergym.envs.engine.catalogue import catalogue
from filtergym.envs.interface.privileged import context_shapes

ID = "filtergym/ManeuveringTarget-v0"
LOOSE = "filtergym/LooselyCoupledNavigation-v0"
ESM = "filtergym/RadarEsmTracking-v0"
TIGHT = "filtergym/TightlyCoupledNavigation-v0"
UAV = "filtergym/UavAutopilot-v0"
ON_TIME = {"detection_probability": (1.0, 1.0), "scan_jitter": (0.0, 0.0)}


def rollout(id, steps, seed=0, **keywords):
    """Context at the reset and at every step of an episode, and the episodes of the engine."""
    env = gymnasium.make(id, context=True, **keywords)
    _, info = env.reset(seed=seed)
    env.action_space.seed(0)
    contexts, states = [info["context"]], [env.unwrapped.fleet.only.state]
    for _ in range(steps):
        contexts.append(env.step(env.action_space.sample())[4]["context"])
        states.append(env.unwrapped.fleet.only.state)
    return contexts, states


def test_context_is_finite_of_one_shape_and_the_truths_own(env_id, short):
    assert catalogue()[env_id].World.context is not World.context
    name = list(catalogue()[env_id].scenarios)[1]
    contexts, states = rollout(env_id, 2, scenario=name, **short)
    model = make_model(env_id, scenario=name, **short)
    shapes = context_shapes(model.task)
    assert shapes
    for context, state in zip(contexts, states, strict=True):
        assert {key: values.shape for key, values in context.items()} == shapes
        for key, values in model.task.world.context(state.truth).items():
            assert np.isfinite(values).all(), key
            np.testing.assert_array_equal(context[key], values[..., 0])


def test_maneuvers_are_flown_as_the_context_states():
    found = 0
    for seed in range(2):
        # On time: of a scan that comes early the velocity is that between two scans.
        contexts, states = rollout(ID, 99, seed, control="gain", **ON_TIME)
        now = [c["maneuvering"] for c in contexts]
        first, last = contexts[0]["maneuver_first"], contexts[0]["maneuver_last"]
        scans = np.arange(1, 101)[:, None]
        inside = ((scans >= first) & (scans <= last)).any(axis=1)
        np.testing.assert_array_equal(now, inside)
        velocity = np.array([state.truth.velocity[:, 0] for state in states])
        changed = (np.diff(velocity, axis=0) != 0.0).any(axis=1)
        np.testing.assert_array_equal(changed, inside[1:])
        found += inside.sum()
        assert ((first == -1) == (last == -1)).all()
    assert found


def test_outages_are_as_the_context_states():
    contexts, states = rollout(LOOSE, 499, scenario="outage", decision_interval=1)
    first, beyond = contexts[0]["outage"]
    number = np.arange(1, 501)
    np.testing.assert_array_equal([c["available"] for c in contexts], (number < first) | (number >= beyond))
    np.testing.assert_array_equal(contexts[0]["jamming"], [-1.0, -1.0])
    assert states[-1].measurement.available[0] == contexts[-1]["available"]


def test_class_changes_as_the_context_states():
    contexts, _ = rollout(ESM, 100, scenario="class-change", decision_interval=1)
    start = contexts[0]
    changed = np.arange(1, 102) >= start["change_scan"]
    assert changed.any()
    classes = np.array([c["target_class"] for c in contexts])
    assert set(classes[changed]) == {start["next_class"]}
    assert set(classes[~changed]) == {start["target_class"]}


def test_faults_hold_as_the_context_states():
    contexts, _ = rollout(TIGHT, 20, scenario="accelerometer-failure", decision_interval=10, horizon=300)
    first, last = contexts[0]["stuck"]
    steps = 1 + 10 * np.arange(21)
    np.testing.assert_array_equal(
        [c["stuck_now"] for c in contexts], (steps >= first) & (steps <= last) & (steps > 1)
    )
    # What does not happen has no steps.
    for name in ("noisy", "no_rates", "hidden", "ramp"):
        np.testing.assert_array_equal(contexts[0][name], [-1.0, -1.0], err_msg=name)


def test_levels_are_those_of_the_times():
    contexts, _ = rollout(UAV, 200, scenario="random")
    start = contexts[0]
    for number, context in enumerate(contexts, 1):
        part = (number >= start["level_times"]).sum()
        assert context["level"] == start["levels"][part]


def test_context_of_a_vector_has_gymnasiums_form():
    keywords = {"num_envs": 2, "context": True, "horizon": 3, "decision_interval": 1}
    own = gymnasium.make_vec(LOOSE, **keywords)
    synced = gymnasium.make_vec(LOOSE, vectorization_mode="sync", **keywords)
    infos = [(own.reset(seed=0)[1], synced.reset(seed=0)[1])]
    action = np.zeros(own.action_space.shape)
    infos += [(own.step(action)[4], synced.step(action)[4]) for _ in range(6)]
    for one, other in infos:
        assert one["context"].keys() == other["context"].keys()
        np.testing.assert_array_equal(one["_context"], other["_context"])
        for name, values in one["context"].items():
            np.testing.assert_array_equal(values, other["context"][name])
            assert values.dtype == other["context"][name].dtype


# --- privileged observations


@pytest.mark.parametrize("env_id", KINDS)
def test_privileged_observations_are_context_and_error(env_id, short):
    keywords = {"detailed_info": False, **short}
    env = gymnasium.make(env_id, observation="asymmetric", context=True, **keywords)
    plain = gymnasium.make(env_id, **{**keywords, "detailed_info": True})
    shown, info = env.reset(seed=2)
    assert env.observation_space.contains(shown)
    np.testing.assert_array_equal(shown["observation"], plain.reset(seed=2)[0])
    components = len(env.unwrapped.task.components)
    np.testing.assert_array_equal(shown["privileged"][-components:], 0.0)
    env.action_space.seed(0)
    for _ in range(3):
        action = env.action_space.sample()
        shown, paid, _, _, info = env.step(action)
        other = plain.step(action)
        np.testing.assert_allclose(shown["observation"], other[0], rtol=1e-12, atol=1e-12)
        assert paid == pytest.approx(other[1], rel=1e-12)
        flat = np.concatenate([np.ravel(values) for values in info["context"].values()])
        np.testing.assert_array_equal(shown["privileged"][:-components], flat)
        sigma = np.sqrt(np.diagonal(other[4]["covariance"]))
        np.testing.assert_allclose(shown["privileged"][-components:], other[4]["error"] / sigma, rtol=1e-9)


def test_privileged_vectors_are_those_of_single_environments():
    pytest.importorskip("torch")
    keywords = {"observation": "asymmetric", "scenario": {"random": 0.5, "quiet": 0.5}, "reward": "relative"}
    keywords |= {"horizon": 3, "decision_interval": 1}
    many = gymnasium.make_vec(LOOSE, num_envs=4, backend="torch", autoreset_mode="SameStep", **keywords)
    shown = [many.reset(seed=0)[0]]
    action = np.full((4, *many.single_action_space.shape), 0.1)
    steps = [many.step(action) for _ in range(5)]
    shown += [step[0] for step in steps]
    for lane in range(4):
        env = gymnasium.make(LOOSE, backend="numpy", **keywords)
        own = env.reset(seed=lane)[0]
        for before, (_, paid, _, over, info) in zip(shown, steps, strict=False):
            for name in own:
                np.testing.assert_allclose(np.asarray(before[name])[lane], own[name], rtol=1e-9, atol=1e-9)
            own, earned, _, truncated, _ = env.step(action[lane])
            assert float(paid[lane]) == pytest.approx(earned, abs=1e-9)
            assert bool(over[lane]) == truncated
            if truncated:
                final = np.asarray(info["final_obs"]["privileged"][lane])
                np.testing.assert_allclose(final, own["privileged"], rtol=1e-9, atol=1e-9)
                own = env.reset()[0]


def test_privileged_environments_say_so():
    env = gymnasium.make(ID, observation="asymmetric")
    assert env.metadata["privileged"] is True
    assert env.spec.kwargs["observation"] == "asymmetric"
    assert "privileged" not in gymnasium.make(ID).metadata
    many = gymnasium.make_vec(ID, num_envs=2, observation="asymmetric", dtype="float32")
    assert many.metadata["privileged"] is True
    assert many.observation_space.contains(many.reset(seed=0)[0])


def test_policies_are_not_shown_what_is_privileged():
    with pytest.raises(ValueError, match="shows the truth, which a policy may not observe"):
        make_policy(gymnasium.make(ID, observation="asymmetric"), "imm")
    with pytest.raises(ValueError, match="has several"):
        make_policy(gymnasium.make(ID, scenario={"random": 1, "paper": 1}), "imm")

    class Cheat:
        observation_space = gymnasium.make(ID, observation="asymmetric").observation_space
        predict = None

    with pytest.raises(ValueError, match=r"privileged observations.*no evaluation provides"):
        evaluate(ID, {"cheat": Cheat()}, episodes=2)


@pytest.mark.parametrize(
    ("keywords", "message"),
    [
        ({"observation": "asymetric"}, "unknown observation 'asymetric': did you mean 'asymmetric'"),
        ({"context": "yes"}, "context must be True or False"),
        ({"observation": "asymmetric", "scenario": {"random": 1, "paper": 1}}, "context of another shape"),
    ],
)
def test_wrong_keywords_are_refused(keywords, message):
    with pytest.raises(ValueError, match=message):
        gymnasium.make(ID, **keywords)


def test_a_policy_that_is_corrected_sees_the_observation_only():
    pytest.importorskip("torch")
    pytest.importorskip("sb3_contrib")
    from filtergym.agents import to_sb3

    model = make_model(ID, "weights")
    policy, zero = problem_of(ID).competitor("imm")(model), np.zeros((1, *model.action_space.shape))
    keywords = {"control": "weights", "horizon": 4, "num_envs": 1, "autoreset_mode": "SameStep"}
    paid = []
    for observation in ("measured", "asymmetric"):
        vector = to_sb3(gymnasium.make_vec(ID, observation=observation, **keywords), residual_to=policy)
        vector.seed(0)
        vector.reset()
        paid.append([vector.step(zero)[1][0] for _ in range(4)])
    assert paid[0] == paid[1]


@pytest.mark.slow
def test_snippet_of_an_asymmetric_critic(capsys):
    pytest.importorskip("stable_baselines3")
    text = (Path(__file__).parent.parent / "docs" / "agents_learning.md").read_text(encoding="utf-8")
    (snippet,) = [s for s in re.findall(r"```python\n(.*?)```", text, re.S) if "asymmetric" in s]
    short = snippet.replace("20_000", "256").replace("episodes=200", "episodes=8")
    assert short != snippet
    names: dict = {"__name__": "snippet"}
    exec(compile(short, "agents_learning.md", "exec"), names)
    assert capsys.readouterr().out.strip()
    # The actor's actions do not depend on what is privileged; the critic's values do.
    model = names["model"]
    torch = pytest.importorskip("torch")
    shown = {name: torch.as_tensor(values) for name, values in model._last_obs.items()}
    other = {**shown, "privileged": shown["privileged"] + 1.0}
    assert torch.equal(model.policy._predict(shown, True), model.policy._predict(other, True))
    assert not torch.equal(model.policy.predict_values(shown), model.policy.predict_values(other))
