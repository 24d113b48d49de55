"""What holds for every single environment, task, policy and control of the catalogue."""

import inspect
import json
import warnings

import gymnasium as gym
import numpy as np
import pytest
from contract import Subject, assert_properties
from gymnasium.utils.env_checker import check_env
from models import KINDS, begin, make_model, next_row, random_actions, short_episodes

from filtergym import evaluate, make_policy
from filtergym.baselines.catalogue import baselines_of
from filtergym.envs.contract.model import Episode
from filtergym.envs.engine.catalogue import catalogue
from filtergym.evaluation.running.recording import NoFilter

ALLOWED_WARNINGS = (
    "we recommend using a symmetric and normalized space",  # weights lie between 0 and 1
    "render_mode 'human' shows nothing",  # on a machine without a display
)


def test_every_control(env_id, control):
    assert_properties(Subject(env_id, control), BY_CONTROL)


def test_every_environment(env_id):
    assert_properties(Subject(env_id), BY_ENVIRONMENT)


def test_policies_of_every_environment(env_id):
    assert_properties(Subject(env_id), OF_POLICIES)


# --- of every control


def passes_gymnasiums_check(subject):
    drawn = subject.order == 0  # a second
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        # Where it is drawn without an option, as its users call it.
        check_env(subject.single().unwrapped, **({} if drawn else {"skip_render_check": True}))
        if subject.order == 0:
            check_env(subject.single(detailed_info=True).unwrapped, skip_render_check=True)
    # Garbage of other tests may be collected meanwhile.
    found = [str(warning.message) for warning in caught if warning.category is not ResourceWarning]
    assert [text for text in found if not any(allowed in text for allowed in ALLOWED_WARNINGS)] == []


def shows_what_lies_in_its_space(subject):
    """At the edges of the action space, too, where filters are worst."""
    env = subject.native(16)
    low, high = env.single_observation_space.low, env.single_observation_space.high
    assert np.isfinite([low, high]).all()
    rng = np.random.default_rng(4)
    observation, _ = env.reset(seed=4)
    for actions in subject.actions(env, 16, range(env.unwrapped.last_decision)):
        assert (low <= observation).all()
        assert (observation <= high).all()
        if isinstance(env.single_action_space, gym.spaces.Box):
            assert (env.action_space.low < env.action_space.high).all()
            edge = np.where(rng.random(actions.shape) < 0.5, env.action_space.low, env.action_space.high)
            actions = edge.astype(actions.dtype)
        observation, *_ = env.step(actions)


def run(env, actions, seed=21):
    shown, paid = [env.reset(seed=seed)[0]], []
    for action in actions:
        observation, reward, terminated, truncated, _ = env.step(action)
        shown.append(observation)
        paid.append(reward)
        assert not terminated
    return np.stack(shown), np.array(paid), truncated


def needs_nothing_but_the_measurements(subject):
    """No truth: fed with the measurements alone, the bank shows and estimates the same."""
    model = subject.model()
    rng = np.random.default_rng(3)
    episode = begin(model, rng, 8)
    alone = model.filter.start(episode.measurement)
    for step in range(model.task.horizon):
        episode = model.measure(episode, next_row(model, rng, 8))
        alone = model.filter.predict(alone, episode.measurement)
        np.testing.assert_array_equal(
            model.observe(Episode(None, episode.measurement, alone)), model.observe(episode)
        )
        action = random_actions(model.action_space, 8, step).T
        episode = model.act(episode, action)
        alone = model.filter.act(alone, episode.measurement, action)
        np.testing.assert_array_equal(model.filter.mean(alone), model.mean(episode))
        np.testing.assert_array_equal(model.filter.covariance(alone), model.covariance(episode))


def takes_actions_in_their_own_precision(subject):
    env = subject.single()
    if isinstance(env.action_space, gym.spaces.Box):  # 0.1 is another number in float32
        fine = np.full(env.action_space.shape, 0.3)
        fine[0] = 0.1
        exact, rounded = (run(env.unwrapped, [action])[0][1] for action in (fine, fine.astype(np.float32)))
        assert (exact != rounded).any()
        np.testing.assert_allclose(exact, rounded, rtol=1e-5, atol=1e-5)


def leaves_no_door_for_the_truth(subject):
    doors = {"self", "initial", "state", "measurement", "action"}  # none of them is for the truth
    for name in ("start", "predict", "act", "mean", "covariance", "feedback", "records"):
        function = getattr(type(subject.model().filter), name)
        assert set(inspect.signature(function).parameters) <= doors, name


BY_CONTROL = (
    passes_gymnasiums_check,
    shows_what_lies_in_its_space,
    needs_nothing_but_the_measurements,
    takes_actions_in_their_own_precision,
    leaves_no_door_for_the_truth,
)


# --- of every environment


def is_made_again_from_text_and_ends_at_its_horizon(subject):
    env = subject.single(scenario="random")
    copy = gym.make(gym.envs.registration.EnvSpec.from_json(env.spec.to_json()))
    actions = [action for (action,) in subject.actions(env, 1, range(5))]
    found = run(env, actions)
    for one, other in zip(found, run(copy, actions), strict=True):
        np.testing.assert_array_equal(one, other)
    assert found[2], "the fifth decision is the last"
    assert not run(env, actions[:4])[2]


def estimate_made_outside_starts_at_the_common_start(subject):
    """The task without its bank: a competitor without estimates reports the start for ever, in a loop of its own."""
    model = subject.model().with_filter(lambda other: NoFilter(other.task))
    noise = model.task.noise
    episode = model.begin(np.full((noise.uniforms, 8), 0.5), np.zeros((noise.initial_normals, 8)))
    mean, covariance = episode.measurement.mean, episode.measurement.covariance
    count = len(model.task.components)
    assert mean.shape == (count, 8)
    assert covariance.shape == (count, count, 8)
    np.testing.assert_array_equal(covariance, covariance.swapaxes(0, 1))
    for _ in range(3):
        episode = model.measure(episode, np.zeros((noise.normals + noise.row_uniforms, 8)))
        np.testing.assert_array_equal(model.mean(episode), mean)
        assert np.isfinite(model.error(episode)).all()
        assert np.isfinite(model.cost(episode)).all()


def parameters_survive_json(subject):
    # Lists from a file mean the same as tuples from Python.
    model = make_model(subject.id)
    values = {
        name: getattr(model.task.parameters, name) for name in model.task.Parameters.__dataclass_fields__
    }
    again = make_model(subject.id, **json.loads(json.dumps(values)))
    assert again.task.parameters == model.task.parameters


def one_scenario_is_for_training(subject):
    scenarios = catalogue()[subject.id].scenarios
    assert scenarios["random"].training
    papers = [scenario for name, scenario in scenarios.items() if name.startswith("paper")]
    assert papers
    assert not any(scenario.training for scenario in papers)


def evaluation_replays_what_gymnasium_shows(subject):
    """An evaluation's errors are those of the environment under the evaluation's episode seeds."""
    known, short = baselines_of(subject.id), short_episodes(subject.id)
    name = known.score_paper
    alone = evaluate(subject.id, [name], episodes=2, seed=5, **short)
    env = subject.single(control=known.policies[name].control, detailed_info=True)
    policy = make_policy(env, name)
    interval = env.unwrapped.task.decision_interval
    for episode, seed in enumerate(alone.episode_seed.values):
        observation, _ = env.reset(seed=int(seed))
        state = None
        for decision in range(5):
            action, state = policy.predict(observation, state, np.array([decision == 0]))
            observation, _, _, _, info = env.step(action)
            expected = alone.error.isel(policy=0, episode=episode, time=(decision + 1) * interval - 1)
            np.testing.assert_array_equal(info["error"], expected.values)


BY_ENVIRONMENT = (
    is_made_again_from_text_and_ends_at_its_horizon,
    estimate_made_outside_starts_at_the_common_start,
    parameters_survive_json,
    one_scenario_is_for_training,
    evaluation_replays_what_gymnasium_shows,
)


# --- of its policies


def papers_policy_equals_the_papers_constant_action(subject):
    """The policy that sees observations, and the same algorithm inside the task."""
    known = baselines_of(subject.id)
    paper = make_model(subject.id).task.paper_policy

    class Constant:
        control = paper.control

        def __init__(self, model):
            self.discrete = isinstance(model.action_space, gym.spaces.Discrete)

        def predict(self, observation, state=None, episode_start=None, deterministic=True):
            action = np.tile(np.asarray(paper.action), (len(observation), 1))
            return (action[:, 0].astype(int) if self.discrete else action), state

    scenario = next(name for name in catalogue()[subject.id].scenarios if name.startswith("paper"))
    # Only one paper's experiment is longer.
    horizon = min(make_model(subject.id, scenario=scenario).task.horizon, 600)
    makers = {"policy": known.policies[known.score_paper], "inside": Constant}
    result = evaluate(subject.id, makers, scenario, episodes=4, horizon=horizon)
    policy, inside = (result.error.sel(policy=name).values for name in ("policy", "inside"))
    # A bank that mixes amplifies rounding: 1e-6 m and m/s, or a millionth of large errors.
    np.testing.assert_allclose(policy, inside, rtol=1e-6, atol=1e-6)


def policies_answer_one_and_many(subject):
    known = baselines_of(subject.id)
    for name, maker in known.policies.items():
        model = make_model(subject.id, getattr(maker, "control", None), **short_episodes(subject.id))
        policy = maker(model)
        assert policy.control == model.control
        env = subject.native(3, control=model.control)
        observation, _ = env.reset(seed=0)
        state, single_state = None, None
        start = np.ones(3, dtype=bool)
        for _ in range(5):
            action, state = policy.predict(observation, state, start, deterministic=True)
            first = observation[0]
            single, single_state = policy.predict(first, single_state, start[:1], deterministic=True)
            assert np.shape(action) == env.action_space.shape, name
            assert np.shape(single) == env.single_action_space.shape, name
            if name != "random":
                np.testing.assert_allclose(single, action[0], rtol=1e-14, atol=1e-14, err_msg=name)
            observation, *_ = env.step(np.asarray(action))
            start = np.zeros(3, dtype=bool)


def policies_forget_at_the_start_of_an_episode(subject):
    known = baselines_of(subject.id)
    for name, maker in known.policies.items():
        if name == "random":
            continue
        model = make_model(subject.id, getattr(maker, "control", None))
        policy = maker(model)
        rng = np.random.default_rng(0)
        rows = rng.normal(size=(15, 2, len(model.fields)))
        state = None
        for k in range(10):
            _, state = policy.predict(rows[k], state, np.full(2, k == 0))
        fresh = None
        for k in range(10, 15):
            # The first row starts anew, the second goes on.
            action, state = policy.predict(rows[k], state, np.array([k == 10, False]))
            expected, fresh = policy.predict(rows[k], fresh, np.full(2, k == 10))
            np.testing.assert_allclose(action[0], expected[0], rtol=1e-14, err_msg=name)


OF_POLICIES = (
    papers_policy_equals_the_papers_constant_action,
    policies_answer_one_and_many,
    policies_forget_at_the_start_of_an_episode,
)


@pytest.mark.parametrize("env_id", KINDS)
def test_relative_reward_is_the_difference_of_costs(env_id):
    subject = Subject(env_id)
    paper, other = subject.model().task.paper_policy, subject.model().task.controls[-1]
    ours, relative = (subject.native(3, reward=reward, control=other) for reward in ("cost", "relative"))
    theirs = subject.native(3, reward="cost", control=paper.control)
    for env in (ours, relative, theirs):
        env.reset(seed=1)
    paper_action = np.tile(np.asarray(paper.action), (3, 1))
    for actions in subject.actions(ours, 3, range(5)):
        mine, difference, papers = (
            ours.step(actions)[1],
            relative.step(actions)[1],
            theirs.step(paper_action)[1],
        )
        np.testing.assert_allclose(difference, mine - papers, rtol=1e-12, atol=1e-12)
