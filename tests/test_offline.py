"""Offline data: transitions as Gymnasium gives them; Minari writes and loads them, and makes the environment again."""

import json

import gymnasium as gym
import numpy as np
import pytest
from models import KINDS

from filtergym import Trajectory, make_policy
from filtergym.baselines.catalogue import baselines_of
from filtergym.baselines.problem import problem_of
from filtergym.evaluation.competitors.kinds import kind_of
from filtergym.evaluation.running.seeds import episode_seeds
from filtergym.evaluation.running.transitions import clip_to_space, transitions_of
from filtergym.names import competitor

ENV = "filtergym/ManeuveringTarget-v0"
SEEDS = episode_seeds("train", 3, 3)


@pytest.fixture
def minari(monkeypatch, tmp_path):
    """Minari, with data sets in a folder of the test's own."""
    pytest.importorskip("h5py")
    module = pytest.importorskip("minari", reason="not installed: pip install 'filtergym[offline]'")
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "datasets"))
    return module


def in_a_loop_of_ones_own(id, policy, seed, **keywords):
    """One episode by ``gymnasium.make``, in the plain way."""
    env = gym.make(id, **policy.keywords, **keywords)
    observation, _ = env.reset(seed=seed)
    state, ended = policy.begin([seed]), False
    observations, actions, rewards = [observation], [], []
    while not ended:
        action, state = policy.predict(observation, state)
        if isinstance(env.action_space, gym.spaces.Box):
            action = np.clip(action, env.action_space.low, env.action_space.high)
        action = np.asarray(action, dtype=env.action_space.dtype)
        observation, reward, terminated, ended, _ = env.step(action)
        assert env.action_space.contains(action)
        assert not terminated
        for kept, value in ((observations, observation), (actions, action), (rewards, reward)):
            kept.append(value)
    return np.array(observations), np.array(actions), np.array(rewards)


@pytest.mark.parametrize("env_id", KINDS)
def test_transitions_are_those_of_a_single_environment(env_id, short):
    policy = make_policy(env_id, problem_of(env_id).tuned_values.best_policy(), **short)
    found = transitions_of(env_id, policy, SEEDS)
    assert [episode.seed for episode in found] == SEEDS
    for episode in found:
        expected = in_a_loop_of_ones_own(env_id, policy, episode.seed)
        for values, right in zip(episode[1:4], expected, strict=True):
            np.testing.assert_array_equal(values, right)
        assert episode.observations.dtype == expected[0].dtype
        assert episode.actions.dtype == expected[1].dtype
        assert episode.truncations.tolist() == [False] * (len(episode.rewards) - 1) + [True]


def test_transitions_of_discrete_actions_and_of_other_types():
    policy = make_policy(ENV, "random", "mode", horizon=6)
    keywords = {"reward": "cost", "dtype": "float32"}
    [episode] = transitions_of(ENV, policy, SEEDS[:1], **keywords)
    expected = in_a_loop_of_ones_own(ENV, policy, SEEDS[0], **keywords)
    for values, right in zip(episode[1:4], expected, strict=True):
        np.testing.assert_array_equal(values, right)
    assert (episode.observations.dtype, episode.rewards.dtype) == (np.float32, np.float32)
    assert episode.actions.dtype == gym.make(ENV, control="mode").action_space.dtype


def test_episodes_of_different_length_end_where_they_end():
    """The short ones are not filled up with the episodes that follow."""
    times = [np.arange(0.0, end, 2.0) for end in (80.0, 160.0)]
    flights = [Trajectory(t, np.column_stack([2e4 + 100.0 * t, 5e3 + 10.0 * t])) for t in times]
    policy = make_policy(ENV, "adaptive", scenario=flights)
    found = transitions_of(ENV, policy, SEEDS + episode_seeds("test", 0, 5))
    assert len({len(episode.rewards) for episode in found}) == 2
    for episode in found:
        expected = in_a_loop_of_ones_own(ENV, policy, episode.seed)
        for values, right in zip(episode[1:4], expected, strict=True):
            np.testing.assert_array_equal(values, right)


def test_actions_are_brought_into_their_space():
    box = gym.spaces.Box(-1.0, 1.0, (2,), np.float32)
    action = clip_to_space(box, np.array([[1.0 + 1e-12, -3.0], [0.1, 0.2]]))
    assert all(map(box.contains, action))
    np.testing.assert_array_equal(action, np.array([[1.0, -1.0], [0.1, 0.2]], dtype=np.float32))


@pytest.mark.claims
def test_the_best_tuned_policy_acts_and_cost_least(env_id):
    name = problem_of(env_id).tuned_values.best_policy()
    assert kind_of(competitor(env_id, name)) == "policy"
    assert problem_of(ENV).tuned_values.best_policy() == "adaptive-rearm-tuned"  # 4.0 against 5.1 and more
    assert problem_of(ENV).tuned_values.best_policy("weights") == "imm-tuned"
    assert problem_of(ENV).tuned_values.best_policy("evidence") is None


@pytest.mark.parametrize("env_id", KINDS)
def test_data_sets_are_loaded_back_by_minari(env_id, short, minari):
    from filtergym.offline import write_datasets

    written = write_datasets(env_id, episodes=3, seed=3, **short)
    assert sorted(minari.list_local_datasets()) == sorted(entry.name for entry in written)
    tuned = problem_of(env_id).tuned_values.best_policy()
    assert [entry.policy for entry in written] == [baselines_of(env_id).score_paper, tuned, "random"]
    for entry in written:
        dataset = minari.load_dataset(entry.name)
        keywords = {name: value for name, value in entry.environment.items() if name not in short}
        policy = make_policy(env_id, entry.policy, keywords.pop("control"), **keywords, **short)
        for episode, right in zip(dataset, transitions_of(env_id, policy, SEEDS), strict=True):
            np.testing.assert_array_equal(episode.observations, right.observations)
            np.testing.assert_array_equal(episode.actions, right.actions)
            np.testing.assert_array_equal(episode.rewards, right.rewards)
            np.testing.assert_array_equal(episode.truncations, right.truncations)
            assert not episode.terminations.any()
        assert [episode["seed"] for episode in dataset.storage.get_episode_metadata(range(3))] == SEEDS
        assert dataset.storage.metadata["algorithm_name"] == entry.policy
        assert entry.mean_return == pytest.approx(np.mean([e.rewards.sum() for e in dataset]), rel=1e-12)

        # The environment that it recovers goes on as the recorded one did.
        env, first = dataset.recover_environment(), dataset[0]
        observation, _ = env.reset(seed=SEEDS[0])
        np.testing.assert_array_equal(observation, first.observations[0])
        for i, action in enumerate(first.actions):
            observation, reward, _, truncated, _ = env.step(action)
            np.testing.assert_array_equal(observation, first.observations[i + 1])
            assert reward == first.rewards[i]
        assert truncated


def test_random_actions_go_with_the_policy_before_them(minari):
    from filtergym.offline import default_policies, write_datasets

    paper = baselines_of(ENV).score_paper
    assert [paper in default_policies(problem_of(ENV), control) for control in (None, "gain")] == [
        True,
        False,
    ]
    _, tuned, random = write_datasets(ENV, episodes=8, horizon=20)
    assert tuned.environment == random.environment
    assert tuned.environment["gains"] == competitor(ENV, tuned.policy).task_keywords["gains"]
    parts = [minari.load_dataset(entry.name) for entry in (tuned, random)]
    both = minari.combine_datasets(parts, "filtergym/both-v0")
    assert (both.total_episodes, both.total_steps) == (16, 320)
    scores = [minari.get_normalized_score(part, np.array([tuned.mean_return])) for part in parts]
    assert tuned.mean_return > random.mean_return
    assert scores == [1.0, 1.0]


def test_more_episodes_than_are_flown_at_once(minari, monkeypatch, tmp_path):
    from filtergym import offline

    whole = offline.write_datasets(ENV, ["random"], episodes=7, horizon=4, namespace="mine/whole")
    [space, *_] = sorted((tmp_path / "datasets").rglob("namespace_metadata.json"))
    space.write_text('{"description": "the user\'s own"}')
    monkeypatch.setattr(offline, "CHUNK", 3)
    parts = offline.write_datasets(ENV, ["random"], episodes=7, horizon=4, namespace="mine/parts")
    one, other = (minari.load_dataset(entry.name) for [entry] in (whole, parts))
    assert one.total_episodes == other.total_episodes == 7
    assert "own" in space.read_text()  # also where others are written beside it
    for left, right in zip(one, other, strict=True):
        np.testing.assert_array_equal(left.observations, right.observations)
        np.testing.assert_array_equal(left.actions, right.actions)


def test_the_command_writes_and_refuses(minari, command, tmp_path):
    words = ("offline", ENV, "--policy", "imm", "--episodes", 2, "--set", "horizon=5")
    words = (*words, "--set", "dtype=float32", "--out", tmp_path / "out")
    code, shown, _ = command(*words)
    assert code == 0
    assert f'"filtergym/maneuvering-target/imm-v0"), with MINARI_DATASETS_PATH={tmp_path / "out"}' in shown
    about = tmp_path / "out" / "filtergym" / "maneuvering-target" / "imm-v0" / "data" / "metadata.json"
    assert json.loads(about.read_text())["total_steps"] == 10
    before = {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}
    assert "already" in command(*words)[2]
    for more, expected in (
        (("--policy", "known-turn"), "does not act"),
        (("--scenario", "atc"), "held out"),
        (("--namespace", "../x"), "Malformed"),
        (("--set", "rewrd=cost"), "did you mean 'reward'"),
    ):
        code, _, errors = command(*words, "--namespace", "other", *more)
        assert (code, expected in errors, errors.strip().count("\n")) == (2, True, 0)
    assert {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()} == before
    # Held-out scenarios are for judging.
    assert command(*words, "--namespace", "other", "--split", "test", "--scenario", "atc")[0] == 0


def test_an_interruption_leaves_no_half_of_a_data_set(minari, monkeypatch, tmp_path):
    from filtergym import offline

    def stopped(*_):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        offline.write_datasets(ENV, ["imm"], episodes=2, horizon=4, folder=tmp_path / "out", progress=stopped)
    monkeypatch.setattr(offline, "_store_scores", stopped)
    with pytest.raises(KeyboardInterrupt):
        offline.write_datasets(ENV, ["imm"], episodes=2, horizon=4, folder=tmp_path / "out")
    assert list(tmp_path.rglob("*")) == []
