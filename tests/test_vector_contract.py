"""The native vector of every environment against Gymnasium's own vector of single environments."""

import copy
import pickle

import gymnasium as gym
import numpy as np
import pytest
from contract import BACKENDS, Subject, assert_properties, continued
from gymnasium.vector import AutoresetMode
from models import KINDS

import filtergym  # noqa: F401  (registers the environments)
from filtergym.envs.interface.vector_environment import TaskVectorEnv

COMPANY = [*zip((3, 8, 13), AutoresetMode, strict=True), (1, AutoresetMode.SAME_STEP)]
"""Few, as many as fill up a batch, and more, each in a mode; and alone."""
STEPS = 13
"""Two episodes of five decisions and a part, with the steps that NEXT_STEP spends on resets."""


def test_vectors_of_every_control(env_id, control):
    assert_properties(Subject(env_id, control), BY_CONTROL)


@pytest.mark.parametrize("env_id", KINDS)
def test_vectors_of_every_kind_of_environment(env_id):
    assert_properties(Subject(env_id), BY_KIND)


# --- what two vectors return


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


def assert_proper(env, observation, reward, terminated, truncated):
    """Types, shapes and spaces of what a step returns."""
    assert env.observation_space.contains(observation)
    assert (observation.dtype, reward.dtype) == (np.float64, np.float64)
    assert (terminated.dtype, truncated.dtype) == (np.bool_, np.bool_)
    assert reward.shape == terminated.shape == truncated.shape == (env.num_envs,)
    assert np.isfinite(reward).all()
    assert not terminated.any()


def assert_same_steps(ours, theirs, actions):
    for action in actions:
        assert_same_step(ours.step(action), theirs.step(action))


def arrays_in(value):
    if isinstance(value, dict | tuple | list) or (isinstance(value, np.ndarray) and value.dtype == object):
        for part in value.values() if isinstance(value, dict) else value:
            yield from arrays_in(part)
    elif isinstance(value, np.ndarray):
        yield value


def scribble(value):
    for array in arrays_in(value):
        array[...] = ~array if array.dtype == bool else 77


# --- of every control


def equals_a_vector_of_single_environments(subject):
    for count, mode in COMPANY if subject.order == 0 else [COMPANY[subject.order % len(COMPANY)]]:
        assert_equal_in_company(subject, count, mode)


def assert_equal_in_company(subject, count, mode):
    """A caller may keep and overwrite whatever it gets, and reuse the arrays that it gives: nothing is shared."""
    ours = subject.native(count, autoreset_mode=mode, detailed_info=True)
    theirs = subject.synchronous(count, mode, detailed_info=True)
    assert ours.observation_space == theirs.observation_space
    assert ours.action_space == theirs.action_space
    assert ours.single_observation_space == theirs.single_observation_space
    shown, info = ours.reset(seed=3)
    assert info == {}
    assert ours.observation_space.contains(shown)
    np.testing.assert_array_equal(shown, theirs.reset(seed=3)[0])
    scribble(shown)
    finished_apart, kept = 0, []
    for step, actions in enumerate(subject.actions(ours, count, range(STEPS))):
        returned, given, mask = [], actions.copy(), np.zeros(count, dtype=bool)
        found = ours.step(given)
        returned.append(found)
        assert_same_step(found, theirs.step(actions))
        assert_proper(ours, *found[:4])
        done = found[3].copy()
        finished_apart += done.any() and not done.all()
        if step in (1, 2):  # resets by mask bring the sub-environments out of step with each other
            mask = (np.arange(count) + step) % 3 == 0 if count > 1 else np.ones(1, dtype=bool)
        if mode is AutoresetMode.DISABLED:
            mask = mask | done
        given_mask = mask.copy()
        if mask.any():
            seed = 50 + step if step == 1 else None
            shown, _ = ours.reset(seed=seed, options={"reset_mask": given_mask})
            expected, _ = theirs.reset(seed=seed, options={"reset_mask": mask.copy()})
            np.testing.assert_array_equal(shown, expected)
            returned.append(shown)
        np.testing.assert_array_equal(given, actions)
        np.testing.assert_array_equal(given_mask, mask)
        if step % 2:
            scribble([returned, given, given_mask])
        else:
            kept.append((returned, copy.deepcopy(returned)))
    assert finished_apart or count == 1
    for found, then in kept:
        for one, other in zip(arrays_in(found), arrays_in(then), strict=True):
            np.testing.assert_array_equal(one, other, err_msg="what was returned has been written over")


BY_CONTROL = (equals_a_vector_of_single_environments,)


# --- of every kind of environment


def goes_back_to_a_snapshot_as_often_as_one_likes(subject):
    made = subject.native(3, autoreset_mode=AutoresetMode.SAME_STEP, reward="relative")
    env, (first, *others) = made.unwrapped, subject.actions(made, 3, range(5))
    env.reset(seed=5)
    env.step(first)
    snapshot = env.fleet.snapshot()
    runs = []
    for _ in range(2):
        env.fleet.restore(snapshot)
        # Through the end, whose restarts draw from the generators.
        shown = [env.step(action)[:2] for action in others]
        env.fleet.restart([1])
        runs.append([*(part for pair in shown for part in pair), env.fleet.observe()])
    for one, other in zip(*runs, strict=True):
        np.testing.assert_array_equal(one, other)
    with pytest.raises(ValueError, match="the snapshot holds 3 environments, not 2"):
        subject.native(2).unwrapped.fleet.restore(snapshot)


def pays_as_the_single_environment(subject):
    ours, theirs = subject.native(3, reward="relative"), subject.synchronous(3, reward="relative")
    ours.reset(seed=1), theirs.reset(seed=1)
    assert_same_steps(ours, theirs, subject.actions(ours, 3, range(8)))


def seeds_each_sub_environment(subject):
    env = subject.native(3)
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
    fresh = [subject.native(3).reset()[0] for _ in range(2)]
    assert (fresh[0] != fresh[1]).any(axis=1).all(), "environments without seed must differ"
    with pytest.raises(ValueError, match="3 seeds"):
        env.reset(seed=[1, 2])


def has_the_same_noise_under_every_control(subject):
    # Open loop: what the sensors say must not depend on the control, so comparisons are paired.
    rows = []
    for control in TaskVectorEnv(subject.id).task.controls:
        env = subject.native(2, control=control, backend="numpy")
        env.reset(seed=4)
        for action in subject.actions(env, 2, range(5)):
            env.step(action)
        noise = env.unwrapped.fleet.only.noise
        rows.append([noise.identities.tolist(), noise.measurement.tolist(), noise.row.tolist()])
    assert all(row == rows[0] for row in rows)


def waits_for_the_reset_of_what_has_finished(subject):
    env = subject.native(2, autoreset_mode=AutoresetMode.DISABLED)
    *actions, more = subject.actions(env, 2, range(6))
    with pytest.raises(gym.error.ResetNeeded):
        env.step(more)
    with pytest.raises(gym.error.ResetNeeded):
        env.reset(options={"reset_mask": np.array([True, False])})
    env.reset(seed=0)
    for action in actions:
        env.step(action)
    for left, mask in ((r"\[0, 1\]", [True, False]), (r"\[1\]", [False, True])):
        with pytest.raises(gym.error.ResetNeeded, match=left):
            env.step(more)
        env.reset(options={"reset_mask": np.array(mask)})
    env.step(more)


def ends_where_it_is_limited(subject):
    ours = subject.native(3, max_episode_steps=3)
    theirs = subject.synchronous(3, max_episode_steps=3)
    ours.reset(seed=0), theirs.reset(seed=0)
    ended = []
    for action in subject.actions(ours, 3, range(9)):
        found = ours.step(action)
        assert_same_step(found, theirs.step(action))
        ended.append(found[3].all())
    assert np.flatnonzero(ended).tolist() == [2, 6]
    longer = subject.native(1, max_episode_steps=1000)
    longer.reset(seed=0)
    ends = [longer.step(action)[3][0] for action in subject.actions(longer, 1, range(5))]
    assert ends == [False] * 4 + [True], "the task's own horizon still ends the episode"


def copies_go_on_as_the_original(subject):
    """Single and many, on each backend that is here, by each way to copy."""
    for backend in BACKENDS:
        assert_copies_go_on(subject.native(3, backend=backend), 8, backend)
        if (
            backend != "torch"
        ):  # single environments go on to the end of an episode of five decisions, vectors beyond
            assert_copies_go_on(subject.single(backend=backend), 2, backend)


def assert_copies_go_on(env, steps, message):
    """Copies from the middle of an episode return what the original does, in the next episode, too."""
    env.reset(seed=3)
    env.action_space.seed(0)
    first, then = ([env.action_space.sample() for _ in range(n)] for n in (3, steps))
    continued(env, first)
    others = [copy.deepcopy(env), pickle.loads(pickle.dumps(env))]
    expected = continued(env, then)
    following = env.reset()[0]
    for other in others:
        for one, two in zip(expected, continued(other, then), strict=True):
            np.testing.assert_array_equal(one, two, err_msg=message)
        np.testing.assert_array_equal(following, other.reset()[0], err_msg=message)


BY_KIND = (
    pays_as_the_single_environment,
    goes_back_to_a_snapshot_as_often_as_one_likes,
    copies_go_on_as_the_original,
    seeds_each_sub_environment,
    has_the_same_noise_under_every_control,
    waits_for_the_reset_of_what_has_finished,
    ends_where_it_is_limited,
)


BAD_MASKS = [
    [True, False],
    np.array([1, 0]),
    np.array([True]),
    np.array([False, False]),
    np.array([[True, False]]),
]


def test_bad_reset_masks():
    env = gym.make_vec("filtergym/ManeuveringTarget-v0", num_envs=2)
    env.reset(seed=0)
    for mask in BAD_MASKS:
        with pytest.raises(ValueError, match="reset_mask"):
            env.reset(options={"reset_mask": mask})
