"""The engine's noise: every measurement takes its own row of its own episode, whatever other lanes do."""

import pickle

import gymnasium as gym
import numpy as np
import pytest
from models import KINDS, make_model

from filtergym.compiler.counter_numbers import numbers
from filtergym.envs.contract.model import Model
from filtergym.envs.engine import episode_noise
from filtergym.envs.engine.compiled import share_world
from filtergym.envs.engine.episode_noise import EpisodeNoise, identities_of_seeds, start_numbers
from filtergym.envs.engine.lanes import Lanes
from filtergym.envs.engine.reward import REWARD_FUNCTIONS, reward_baseline

ID = "filtergym/ManeuveringTarget-v0"


def naive_identities(generator, episodes):
    """Identities that a lane's generator draws for one episode after another, as the module describes them."""
    return [generator.bit_generator.random_raw(2) for _ in range(episodes)]


def naive_row(identity, t, layout):
    """Row of one episode's measurement, ``(rows,)``."""
    return numbers(identity[:, None], np.array([t]), layout.normals, layout.row_uniforms)[:, 0]


@pytest.fixture(params=[True, False], ids=["compiled numbers", "NumPy's numbers"])
def either_way(request, monkeypatch):
    if request.param:
        pytest.importorskip("llvmlite")
    monkeypatch.setattr(episode_noise, "AVAILABLE", request.param)
    # Lanes restart in the middle of a block, and at its end.
    monkeypatch.setattr(episode_noise, "AHEAD", 16 * 7)


def test_every_measurement_takes_its_own_row(monkeypatch, either_way):
    model = make_model(ID, "gain", backend="numpy", horizon=9)
    layout, taken, started = model.task.noise, [], []
    measure, begin = model.measure, model.begin
    monkeypatch.setattr(
        model, "measure", lambda state, row: (taken.append((row, row.copy())), measure(state, row))[1]
    )
    monkeypatch.setattr(model, "begin", lambda u, n: (started.append((u, n)), begin(u, n))[1])
    lanes = Lanes(model, 11)
    for lane in range(11):
        lanes.seed(lane, np.random.default_rng(10 + lane))
    lanes.restart()
    drawn = [naive_identities(np.random.default_rng(10 + lane), 9) for lane in range(11)]
    episode, t = np.zeros(11, dtype=int), np.ones(11, dtype=int)

    def check(chosen):
        """The last row is that of the episodes in these lanes."""
        identities = np.stack([drawn[lane][episode[lane]] for lane in chosen], axis=1)
        rows = [
            naive_row(identity, t[lane], layout) for lane, identity in zip(chosen, identities.T, strict=True)
        ]
        np.testing.assert_array_equal(taken[-1][0][:, : len(chosen)].T, rows)
        return identities

    def check_start(identities):
        for found, own in zip(started[-1], start_numbers(identities, layout), strict=True):
            np.testing.assert_array_equal(found[:, : identities.shape[1]], own)

    every_lane = list(range(11))
    check_start(check(every_lane))
    for step in range(40):
        lanes.decide(np.zeros((11, 1)))
        t += 1
        check(every_lane)
        if step % 5 == 0:
            chosen = sorted([(3 * step) % 11, (3 * step + 4) % 11])
            lanes.restart(chosen)
            episode[chosen] += 1
            t[chosen] = 1
            check_start(check(chosen))
    for row, then in taken:
        np.testing.assert_array_equal(row, then, err_msg="what was taken has been written over")


def test_identities_of_seeds_are_those_of_environments_that_are_reset():
    seeds = [5, 0, 2**40]
    identities = identities_of_seeds(seeds)
    env = gym.make(ID, backend="numpy", disable_env_checker=True).unwrapped
    for seed, identity in zip(seeds, identities.T, strict=True):
        env.reset(seed=seed)
        np.testing.assert_array_equal(env.fleet.identity_of(0)[:, 0], identity)
    np.testing.assert_array_equal(identities_of_seeds(np.array(seeds)), identities)
    with pytest.raises(ValueError, match="read-only"):
        identities[0, 0] = 1


@pytest.mark.parametrize("env_id", KINDS)
def test_a_reference_runs_beside_as_lanes_of_its_own(env_id):
    """Also where it has no world of its own: after restarts of few lanes, growth, a snapshot and other reports."""
    pytest.importorskip("llvmlite")
    # One of two in turn: for either, programs of both algorithms are traced.
    kind = ("relative", "log-relative")[KINDS.index(env_id) % 2]
    model = make_model(env_id, backend="compiled")
    beside = reward_baseline(kind, model)
    count, report, space = 24, REWARD_FUNCTIONS[kind], model.action_space
    lanes, own, other = (
        Lanes(*each) for each in ((model, count, beside), (model, count), (beside.model, count))
    )
    everywhere = (lanes, own, other)
    for each in everywhere:
        for lane in range(32):
            each.seed(lane, np.random.default_rng(lane))
        each.restart()
    assert share_world(model, beside.model) != model.task.closes_loop
    space.seed(0)
    for step in range(12):
        if step in (2, 3, 7):
            for each in everywhere:
                each.restart([1, 5, 20] if step != 3 else range(16))
        if step == 5:
            for each in everywhere:
                each.grow(32)
        if step == 6:
            for each in everywhere:
                snapshot = each.snapshot()
                each.decide(np.zeros((each.count, *each.model.action_space.shape)))
                each.restore(snapshot)
        shown = Model.cost if step == 9 else report
        action, theirs = (
            np.stack([np.asarray(one)] * lanes.count) for one in (space.sample(), beside.action)
        )
        expected = own.decide(action, shown), other.decide(theirs, shown)
        for found, ours, others in zip(lanes.decide(action, shown), *expected, strict=True):
            np.testing.assert_array_equal(found[0], ours[0])
            np.testing.assert_array_equal(found[1], others[0])
        np.testing.assert_array_equal(lanes.observe(), own.observe())


def test_copies_and_snapshots_go_on_as_the_original(either_way):
    noise = EpisodeNoise(make_model(ID, backend="numpy").task, 3)
    for lane in range(3):
        noise.seed(lane, np.random.default_rng(lane))
    noise.set_identities(noise.draw_identities(range(3)))
    noise.start()
    noise.advance()
    first, other, snapshot = noise.row, pickle.loads(pickle.dumps(noise)), noise.snapshot()
    noise.advance()
    other.advance()
    np.testing.assert_array_equal(noise.row, other.row)
    following, drawn = noise.row, noise.draw_identities([1])
    np.testing.assert_array_equal(other.draw_identities([1]), drawn)
    for _ in range(2):
        noise.restore(snapshot)
        noise.advance()
        np.testing.assert_array_equal(noise.row, following)
        np.testing.assert_array_equal(noise.draw_identities([1]), drawn)
    assert (first != following).any()
