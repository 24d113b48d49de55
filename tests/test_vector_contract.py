"""The native vector of every environment against Gymnasium's own vector of single environments."""

import copy

import gymnasium as gym
import numpy as np
import pytest
from filtergym.envs.interface.vector_environment import TaskVectorEnv
from gymnasium.vector import AutoresetMode

import filtergym  # noqa: F401  (registers the environments)

MODES = list(AutoresetMode)
COMPANY = [*zip((3, 8, 13), MODES, strict=True), (1, AutoresetMode.SAME_STEP)]
"""Few, as many as fill up a batch, and more, each in a mode; and alone."""
STEPS = 13
"""Two episodes of five decisions and a part, with the steps that NEXT_STEP spends on resets."""


def native(env_id, count, mode=AutoresetMode.NEXT_STEP, **keywords):
    return gym.make_vec(env_id, num_envs=count, autoreset_mode=mode, **keywords)


def synchronous(env_id, count, mode=AutoresetMode.NEXT_STEP, **keywords):
    return gym.vector.SyncVectorEnv(
        [lambda: gym.make(env_id, disable_env_checker=True, **keywords)] * count, autoreset_mode=mode
    )


def some(count, step):
    """A mask of sub-environments to reset, at least one and not all where there are several."""
    return (np.arange(count) + step) % 3 == 0 if count > 1 else np.ones(1, dtype=bool)


def assert_same_step(one, other):
    """Compare observation, reward, both flags and final observations of a step, bit for bit."""
    for name, a, b in zip(("observation", "reward", "terminated", "truncated"), one, other, strict=False):
        assert a.dtype == b.dtype, name
        np.testing.assert_array_equal(a, b, err_msg=name)
    assert_same_info(one[4], other[4])


def assert_same_info(one, other):
    """Every value that the mask beside it declares present is the same."""
    assert {k for k in one if not k.startswith("_")} == {k for k in other if not k.startswith("_")}
    for name, values in other.items():
        if name.startswith("_"):
            continue
        mask = other[f"_{name}"]
        np.testing.assert_array_equal(one[f"_{name}"], mask, err_msg=name)
        if isinstance(values, dict):
            assert_same_info(one[name], values)
            continue
        for lane in np.flatnonzero(mask):
            np.testing.assert_array_equal(one[name][lane], values[lane], err_msg=name)


def assert_proper(env, observation, reward=None, terminated=None, truncated=None):
    """Types, shapes and spaces of what a reset or a step returns."""
    assert env.observation_space.contains(observation)
    assert observation.dtype == np.float64
    if reward is not None:
        assert (reward.dtype, terminated.dtype, truncated.dtype) == (np.float64, np.bool_, np.bool_)
        assert reward.shape == terminated.shape == truncated.shape == (env.num_envs,)
        assert np.isfinite(reward).all()
        assert not terminated.any()


@pytest.mark.with_controls(("count", "mode"), COMPANY)
def test_equals_a_vector_of_single_environments(env_id, control, mode, count, short, random_actions):
    keywords = {"control": control, "detailed_info": True, **short}
    ours, theirs = native(env_id, count, mode, **keywords), synchronous(env_id, count, mode, **keywords)
    assert ours.observation_space == theirs.observation_space
    assert ours.action_space == theirs.action_space
    assert ours.single_observation_space == theirs.single_observation_space
    observation, info = ours.reset(seed=3)
    assert info == {}
    assert_proper(ours, observation)
    np.testing.assert_array_equal(observation, theirs.reset(seed=3)[0])
    partial_resets = finished_apart = 0
    kept = [(observation, observation.copy())]
    for step in range(STEPS):
        actions = random_actions(ours.single_action_space, count, step)
        ours_step, theirs_step = ours.step(actions), theirs.step(actions)
        assert_same_step(ours_step, theirs_step)
        assert_proper(ours, *ours_step[:4])
        kept.append((list_of(ours_step), copy.deepcopy(list_of(ours_step))))
        done = ours_step[3]
        finished_apart += done.any() and not done.all()
        # Resets by mask bring the sub-environments out of step with each other.
        mask = some(count, step) if step in (1, 2) else np.zeros(count, dtype=bool)
        if mode is AutoresetMode.DISABLED:
            mask = mask | done
        if mask.any():
            partial_resets += 1
            seed = 50 + step if step == 1 else None
            shown, _ = ours.reset(seed=seed, options={"reset_mask": mask.copy()})
            expected, _ = theirs.reset(seed=seed, options={"reset_mask": mask.copy()})
            np.testing.assert_array_equal(shown, expected)
    assert partial_resets
    assert finished_apart or count == 1
    for result, then in kept:
        assert_deeply_equal(result, then)


@pytest.mark.parametrize("reward", ["cost", "log-likelihood", "relative"])
def test_every_reward_equals_that_of_the_single_environment(env_id, reward, short, random_actions):
    ours = native(env_id, 3, reward=reward, **short)
    theirs = synchronous(env_id, 3, reward=reward, **short)
    ours.reset(seed=1), theirs.reset(seed=1)
    for step in range(8):
        actions = random_actions(ours.single_action_space, 3, step)
        assert_same_step(ours.step(actions), theirs.step(actions))


def test_long_episodes_that_draw_noise_in_blocks(env_id, random_actions):
    # More than 256 measurements: blocks from a child generator, and resets that fall inside a block.
    ours, theirs = (make(env_id, 3, horizon=260, decision_interval=10) for make in (native, synchronous))
    ours.reset(seed=5), theirs.reset(seed=5)
    for step in range(30):
        actions = random_actions(ours.single_action_space, 3, step)
        assert_same_step(ours.step(actions), theirs.step(actions))
        if step == 17:
            mask = np.array([False, True, False])
            ours.reset(options={"reset_mask": mask.copy()})
            theirs.reset(options={"reset_mask": mask.copy()})


def test_seeds(env_id, short):
    env = native(env_id, 3, **short)
    together, _ = env.reset(seed=11)
    listed, _ = env.reset(seed=[11, 12, 13])
    np.testing.assert_array_equal(together, listed)
    shifted, _ = env.reset(seed=12)
    np.testing.assert_array_equal(shifted[:2], together[1:])
    following, _ = env.reset()
    assert (following != shifted).any(axis=1).all(), "a reset without seed must start new episodes"
    env.reset(seed=12)
    again, _ = env.reset()
    np.testing.assert_array_equal(again, following)
    fresh = [native(env_id, 3, **short).reset()[0] for _ in range(2)]
    assert (fresh[0] != fresh[1]).any(axis=1).all(), "environments without seed must differ"
    with pytest.raises(ValueError, match="3 seeds"):
        env.reset(seed=[1, 2])


def test_same_noise_under_every_control(env_id, short, random_actions):
    # Open loop: what the sensors say must not depend on the control, so comparisons are paired.
    cls_controls = TaskVectorEnv(env_id).task.controls
    rows = []
    for control in cls_controls:
        env = native(env_id, 2, control=control, backend="numpy", **short)
        env.reset(seed=4)
        for step in range(5):
            env.step(random_actions(env.single_action_space, 2, step))
        noise = env.unwrapped.fleet.only.noise
        rows.append([noise.identities.tolist(), noise.measurement.tolist(), noise.row.tolist()])
    assert all(row == rows[0] for row in rows)


def test_next_step_autoreset(env_id, short, random_actions):
    env = native(env_id, 2, AutoresetMode.NEXT_STEP, **short)
    env.reset(seed=0)
    for step in range(5):
        last, _, _, truncated, _ = env.step(random_actions(env.single_action_space, 2, step))
        assert (truncated == (step == 4)).all()
    shown, reward, _, truncated, _ = env.step(random_actions(env.single_action_space, 2, 5))
    assert (shown != last).any(axis=1).all()
    assert (reward == 0.0).all()
    assert not truncated.any()


def test_same_step_autoreset(env_id, short, random_actions):
    env = native(env_id, 2, AutoresetMode.SAME_STEP, **short)
    waiting = native(env_id, 2, AutoresetMode.DISABLED, **short)
    env.reset(seed=0), waiting.reset(seed=0)
    for step in range(5):
        actions = random_actions(env.single_action_space, 2, step)
        shown, _, _, truncated, info = env.step(actions)
        last, *_ = waiting.step(actions)
        assert ("final_obs" in info) == (step == 4)
    assert truncated.all()
    np.testing.assert_array_equal(np.stack(list(info["final_obs"])), last)
    assert info["_final_obs"].all()
    assert (shown != last).any(axis=1).all()


def test_disabled_autoreset_wants_a_reset(env_id, short, random_actions):
    env = native(env_id, 2, AutoresetMode.DISABLED, **short)
    env.reset(seed=0)
    for step in range(5):
        env.step(random_actions(env.single_action_space, 2, step))
    with pytest.raises(gym.error.ResetNeeded, match=r"\[0, 1\]"):
        env.step(random_actions(env.single_action_space, 2, 5))
    env.reset(options={"reset_mask": np.array([True, False])})
    with pytest.raises(gym.error.ResetNeeded, match=r"\[1\]"):
        env.step(random_actions(env.single_action_space, 2, 5))
    env.reset(options={"reset_mask": np.array([False, True])})
    env.step(random_actions(env.single_action_space, 2, 5))


def test_reset_mask_leaves_the_others_alone(env_id, control, short, random_actions):
    masked, untouched = (native(env_id, 5, control=control, **short) for _ in range(2))
    masked.reset(seed=2), untouched.reset(seed=2)
    mask = np.array([True, False, False, True, False])
    for step in range(5):
        actions = random_actions(masked.single_action_space, 5, step)
        one, other = masked.step(actions), untouched.step(actions)
        np.testing.assert_array_equal(one[0][~mask], other[0][~mask])
        np.testing.assert_array_equal(one[1][~mask], other[1][~mask])
        if step == 1:
            options = {"reset_mask": mask.copy()}
            shown, _ = masked.reset(options=options)
            np.testing.assert_array_equal(shown[~mask], other[0][~mask])
            assert (shown[mask] != other[0][mask]).any(axis=1).all()
            np.testing.assert_array_equal(options["reset_mask"], mask)
    assert (one[3] == ~mask).all()


BAD_MASKS = [
    [True, False],
    np.array([1, 0]),
    np.array([True]),
    np.array([False, False]),
    np.array([[True, False]]),
]


@pytest.mark.parametrize("mask", BAD_MASKS)
def test_bad_reset_mask(mask):
    env = native("filtergym/ManeuveringTarget-v0", 2)
    env.reset(seed=0)
    with pytest.raises(ValueError, match="reset_mask"):
        env.reset(options={"reset_mask": mask})


def test_needs_a_reset_first(env_id, random_actions):
    env = native(env_id, 2)
    with pytest.raises(gym.error.ResetNeeded):
        env.step(random_actions(env.single_action_space, 2, 0))
    with pytest.raises(gym.error.ResetNeeded):
        env.reset(options={"reset_mask": np.array([True, False])})


def scribble(value):
    """Overwrite every array inside."""
    if isinstance(value, dict):
        for part in value.values():
            scribble(part)
    elif isinstance(value, np.ndarray):
        if value.dtype == object:
            for part in value:
                scribble(part)
        else:
            value[...] = ~value if value.dtype == bool else 77


@pytest.mark.with_controls(("count", "mode"), [(count, mode) for count in (3, 8) for mode in MODES])
def test_nothing_returned_or_given_is_shared(env_id, control, mode, count, short, random_actions):
    # A caller may keep and overwrite whatever it gets, and reuse the arrays that it gives.
    clean, abused = (
        native(env_id, count, mode, control=control, detailed_info=True, **short) for _ in range(2)
    )
    clean.reset(seed=6)
    scribble(abused.reset(seed=6)[0])
    for step in range(9):
        actions = random_actions(clean.single_action_space, count, step)
        expected = clean.step(actions)
        given = actions.copy()
        result = abused.step(given)
        assert_same_step_without_masks(result, expected)
        kept = copy.deepcopy(result[:4])
        done = expected[3].copy()
        scribble(given), scribble(list_of(result))
        del kept
        if step == 1 or (mode is AutoresetMode.DISABLED and done.any()):
            mask = some(count, step) | done
            clean.reset(options={"reset_mask": mask.copy()})
            given_mask = mask.copy()
            scribble(abused.reset(options={"reset_mask": given_mask})[0])
            scribble(given_mask)


def list_of(result):
    return dict(enumerate(result))


def assert_same_step_without_masks(one, other):
    for a, b in zip(one[:4], other[:4], strict=True):
        np.testing.assert_array_equal(a, b)


def assert_deeply_equal(one, other):
    if isinstance(one, dict):
        assert one.keys() == other.keys()
        for key in one:
            assert_deeply_equal(one[key], other[key])
    elif isinstance(one, list) or (isinstance(one, np.ndarray) and one.dtype == object):
        for a, b in zip(one, other, strict=True):
            assert_deeply_equal(a, b)
    else:
        np.testing.assert_array_equal(one, other)


def test_max_episode_steps(env_id, short, random_actions):
    ours, theirs = (make(env_id, 3, max_episode_steps=3, **short) for make in (native, synchronous))
    ours.reset(seed=0), theirs.reset(seed=0)
    truncations = 0
    for step in range(9):
        actions = random_actions(ours.single_action_space, 3, step)
        one, other = ours.step(actions), theirs.step(actions)
        assert_same_step(one, other)
        truncations += one[3].all()
    assert truncations == 2
    longer = native(env_id, 1, max_episode_steps=1000, **short)
    longer.reset(seed=0)
    ends = [longer.step(random_actions(longer.single_action_space, 1, s))[3][0] for s in range(5)]
    assert ends == [False] * 4 + [True], "the task's own horizon still ends the episode"


def test_rejects_no_environments(env_id):
    with pytest.raises(ValueError, match="num_envs"):
        TaskVectorEnv(env_id, 0)


def test_snapshot_of_the_lanes_is_gone_back_to_as_often_as_one_likes(env_id, control, short, random_actions):
    env = native(env_id, 3, AutoresetMode.SAME_STEP, control=control, reward="relative", **short).unwrapped
    env.reset(seed=5)
    env.step(random_actions(env.single_action_space, 3, 0))
    snapshot = env.fleet.snapshot()
    runs = []
    for _ in range(2):
        env.fleet.restore(snapshot)
        # Through the end, whose restarts draw from the generators.
        shown = [env.step(random_actions(env.single_action_space, 3, k))[:2] for k in range(1, 5)]
        env.fleet.restart([1])
        runs.append([*(part for pair in shown for part in pair), env.fleet.observe()])
    for one, other in zip(*runs, strict=True):
        np.testing.assert_array_equal(one, other)
    with pytest.raises(ValueError, match="the snapshot holds 3 environments, not 2"):
        TaskVectorEnv(env_id, num_envs=2, control=control, **short).fleet.restore(snapshot)
