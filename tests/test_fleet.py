"""Mixtures of scenarios, and scenarios and parameters named at a reset: which episodes are flown, and that nothing else
changes.
"""

import copy
import pickle

import gymnasium
import numpy as np
import pytest
from contract import BACKENDS, continued

from filtergym.envs.engine.catalogue import task_class
from filtergym.envs.engine.scenario_choice import find_mixture
from filtergym.envs.interface.fleet import EpisodeDistribution

ID = "filtergym/ManeuveringTarget-v0"
MIXTURE = {"random": 0.6, "paper": 0.4}
SHORT = {"horizon": 6, "control": "gain"}
WAYS = (copy.deepcopy, lambda env: pickle.loads(pickle.dumps(env)))


def same(one, two):
    for a, b in zip(one, two, strict=True):
        np.testing.assert_array_equal(a, b)


def test_every_lane_is_the_single_environment_with_its_seed():
    actions = np.random.default_rng(0).uniform(-1.0, 1.0, (20, 11, 1))
    many = gymnasium.make_vec(ID, num_envs=11, scenario=MIXTURE, autoreset_mode="SameStep", **SHORT)
    shown, _ = many.reset(seed=5)
    scenarios = set()
    rows = [shown]
    for action in actions:
        rows.append(many.step(action)[0])
    for lane in range(11):
        env = gymnasium.make(ID, scenario=MIXTURE, **SHORT)
        own, _ = env.reset(seed=5 + lane)
        for step, action in enumerate(actions):
            np.testing.assert_array_equal(own, rows[step][lane])
            own, _, _, truncated, _ = env.step(action[lane])
            scenarios.add(env.unwrapped.fleet.scenario_of(0))
            if truncated:
                own, _ = env.reset()
    assert scenarios == set(MIXTURE)


def test_an_episode_of_a_mixture_is_one_of_its_scenario_from_where_the_choice_left_the_generator():
    env = gymnasium.make(ID, scenario=MIXTURE, **SHORT)
    seen = set()
    for seed in range(6):
        shown, _ = env.reset(seed=seed)
        name = env.unwrapped.fleet.scenario_of(0)
        generator = gymnasium.utils.seeding.np_random(seed)[0]
        assert name == ("random" if generator.random() < 0.6 else "paper")
        alone = gymnasium.make(ID, scenario=name, **SHORT).unwrapped
        alone.fleet.seed(0, generator)
        alone.fleet.restart()
        np.testing.assert_array_equal(shown, alone.fleet.observe()[0])
        seen.add(name)
        assert env.unwrapped.task.parameters == alone.task.parameters
    assert len(seen) == 2


def test_shares_of_a_mixture():
    distribution = EpisodeDistribution(None, {}, (None, None, None), ("a", "b", "c"), (0.2, 0.5, 0.3))
    generator = np.random.default_rng(0)
    counts = np.bincount([distribution.draw_task(generator) for _ in range(20_000)], minlength=3)
    np.testing.assert_allclose(counts / 20_000, [0.2, 0.5, 0.3], atol=0.015)


@pytest.mark.parametrize("keywords", [{"scenario": MIXTURE}, {"observation": "asymmetric"}])
def test_copies_of_single_environments_keep_what_a_reset_named(keywords):
    env = gymnasium.make(ID, **SHORT, **keywords)
    env.reset(seed=1, options={"parameters": {"range_sigma": 44.0}})
    action = np.full(1, 0.1)
    env.step(action)
    others = [way(env) for way in WAYS]
    expected = [*(env.step(action) for _ in range(3)), env.reset()]
    for other in others:
        np.testing.assert_equal([*(other.step(action) for _ in range(3)), other.reset()], expected)
        assert other.unwrapped.task.parameters.range_sigma == 44.0


def test_restored_lanes_draw_what_a_reset_names_from_the_generators_of_their_episodes():
    """As if they had never been restored, also where the lanes of one task are left for another's."""
    env = gymnasium.make_vec(ID, num_envs=4, **SHORT).unwrapped
    env.reset(seed=3)
    snapshot, runs = env.fleet.snapshot(), []
    for restored in (False, True):
        if restored:
            env.fleet.restore(snapshot)
        env.fleet.restart()
        shown = np.array(env.fleet.observe())
        runs.append([shown, env.reset(options={"parameters": {"range_sigma": 44.0}})[0]])
    same(*runs)


def test_gradients_flow_through_a_mixture(torch):
    env = gymnasium.make_vec(ID, num_envs=64, scenario=MIXTURE, backend="torch", **SHORT)
    observation, _ = env.reset(seed=0)
    seen = observation[:, env.unwrapped.model.columns(["available"])[0]] > 0.0
    action = torch.zeros((64, 1), dtype=torch.float64, requires_grad=True)
    env.step(action)
    env.step(torch.zeros((64, 1), dtype=torch.float64))[1].sum().backward()
    assert not seen.all()  # an action on a scan that missed the target does nothing
    assert ((action.grad[:, 0] != 0.0) == seen).all()


def test_episodes_of_different_length_end_at_their_own():
    env = gymnasium.make_vec(
        ID, num_envs=12, scenario={"random": 1, "cruise": 1}, autoreset_mode="SameStep", control="gain"
    )
    env.reset(seed=0)
    lanes = env.unwrapped.fleet
    names = [lanes.scenario_of(lane) for lane in range(12)]
    assert set(names) == {"random", "cruise"}
    assert env.spec.max_episode_steps == 100
    ends = np.zeros(12, dtype=int)
    for step in range(1, 101):
        truncated = env.step(np.zeros((12, 1)))[3]
        ends[(ends == 0) & truncated] = step
    np.testing.assert_array_equal(ends, [100 if name == "random" else 60 for name in names])


def test_max_episode_steps_and_shortening():
    env = gymnasium.make_vec(ID, num_envs=3, scenario=MIXTURE, max_episode_steps=4, **SHORT)
    env.reset(seed=0, options={"shortened_by": [0, 1, 3]})
    ends = [env.step(np.zeros((3, 1)))[3].tolist() for _ in range(4)]
    assert ends[0] == [False, False, True]
    assert ends[2][1]
    assert ends[3][0]


def test_a_scenario_named_at_a_reset_is_that_scenario():
    env = gymnasium.make(ID, **SHORT)
    env.reset(seed=0)
    for options, keywords in [
        ({"scenario": "paper"}, {"scenario": "paper"}),
        ({"parameters": {"range_sigma": 50.0}}, {"scenario": "paper", "range_sigma": 50.0}),
        (None, {"scenario": "paper", "range_sigma": 50.0}),
        ({"scenario": None}, {"range_sigma": 50.0}),
        ({"parameters": {}}, {}),
        ({"scenario": MIXTURE}, {"scenario": MIXTURE}),
        ({"scenario": "random", "parameters": {"horizon": 3}}, {"horizon": 3}),
    ]:
        other = gymnasium.make(ID, **{**SHORT, **keywords})
        same([env.reset(seed=7, options=options)[0]], [other.reset(seed=7)[0]])
        assert env.unwrapped.task.parameters == other.unwrapped.task.parameters
        actions = [np.array([0.3])] * 3
        same(continued(env, actions), continued(other, actions))


@pytest.mark.parametrize("backend", BACKENDS)
def test_only_lanes_that_are_reset_change_their_scenario(backend):
    keywords = {"num_envs": 4, "backend": backend, "autoreset_mode": "Disabled", **SHORT}
    env, plain = gymnasium.make_vec(ID, **keywords), gymnasium.make_vec(ID, **keywords)
    paper = gymnasium.make_vec(ID, scenario="paper", **keywords)
    for one in (env, plain, paper):
        one.reset(seed=0)
    actions = np.random.default_rng(0).uniform(-1.0, 1.0, (6, 4, 1))
    same(continued(env, actions[:2]), continued(plain, actions[:2]))
    mask = np.array([False, True, False, True])
    shown, _ = env.reset(seed=20, options={"reset_mask": mask, "scenario": "paper"})
    started, _ = paper.reset(seed=20)
    np.testing.assert_array_equal(shown[mask], started[mask])
    for action in actions[2:]:
        shown, paid = map(np.asarray, env.step(action)[:2])
        for other, lanes in ((plain, ~mask), (paper, mask)):
            expected = other.step(action)
            np.testing.assert_array_equal(shown[lanes], np.asarray(expected[0])[lanes])
            np.testing.assert_array_equal(paid[lanes], np.asarray(expected[1])[lanes])


def test_what_a_reset_named_holds_after_an_autoreset():
    env = gymnasium.make_vec(
        ID, num_envs=2, autoreset_mode="SameStep", horizon=2, context=True, control="gain"
    )
    mask = np.array([False, True])
    env.reset(seed=0)
    _, info = env.reset(options={"reset_mask": mask, "scenario": "paper"})
    np.testing.assert_array_equal(info["_context"], mask)
    for _ in range(5):
        info = env.step(np.zeros((2, 1)))[4]
        assert info["context"]["maneuver_first"].shape == (2, 3)
        # The paper's flight has one manoeuvre, and where others have more there is no number.
        np.testing.assert_array_equal(np.isnan(info["context"]["maneuver_first"][1]), [False, True, True])


def test_lanes_of_a_scenario_that_is_left_are_forgotten():
    env = gymnasium.make(ID, **SHORT)
    for k in range(5):
        env.reset(seed=0, options={"parameters": {"range_sigma": 50.0 + k}})
        assert len(env.unwrapped.fleet.snapshot()["parts"]) == 1


def test_a_mixture_takes_as_many_places_as_it_needs():
    env = gymnasium.make_vec(ID, num_envs=100, scenario=MIXTURE, autoreset_mode="SameStep", **SHORT).unwrapped
    env.reset(seed=0)
    for _ in range(30):
        env.step(np.zeros((100, 1)))
    assert sum(count for _, count, _ in env.fleet.snapshot()["parts"]) < 150


def test_details_of_a_mixture_are_those_of_its_scenarios():
    env = gymnasium.make(ID, scenario=MIXTURE, detailed_info=True, **SHORT)
    many = gymnasium.make_vec(ID, num_envs=9, scenario=MIXTURE, detailed_info=True, **SHORT)
    many.reset(seed=0)
    records = many.step(np.full((9, 1), 0.1))[4]
    for lane in range(9):
        env.reset(seed=lane)
        for name, values in env.step(np.full(1, 0.1))[4].items():
            np.testing.assert_array_equal(values, records[name][lane])


@pytest.mark.parametrize(
    ("scenario", "weights"),
    [
        ("random:3,paper:1", {"random": 0.75, "paper": 0.25}),
        ({"random": 3, "paper": 1, "atc": 0}, {"random": 0.75, "paper": 0.25}),
        ("random", None),
        ("C:/flights,of:mine.csv", None),
        ({"time": [0, 1], "position": [[0, 0], [1, 1]]}, None),
    ],
)
def test_mixtures_in_words_and_as_dictionaries(scenario, weights):
    assert find_mixture(task_class(ID), scenario) == weights


@pytest.mark.parametrize(
    ("scenario", "message"),
    [
        ({"random": 0.5, "papr": 0.5}, "unknown scenario 'papr': did you mean 'paper'"),
        ({"random": -1.0, "paper": 2.0}, "weights of a mixture are numbers of at least 0"),
        ({"random": 0.0}, "weights of a mixture"),
        ({"random": True}, "weights of a mixture"),
        ({"random": float("nan")}, "weights of a mixture"),
        ("random:0.5,random:0.5", "names each scenario once"),
        ("random:half,paper:0.5", "a mixture in words is scenario:weight"),
    ],
)
def test_wrong_mixtures_are_refused(scenario, message):
    with pytest.raises(ValueError, match=message):
        gymnasium.make(ID, scenario=scenario)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"scenario": "papr"}, "unknown scenario 'papr'"),
        ({"parameters": {"range_sgma": 1.0}}, "range_sgma.*did you mean 'range_sigma'"),
        ({"parameters": {"range_sigma": -1.0}}, "range_sigma must be"),
        ({"parameters": ["range_sigma"]}, "maps names of parameters to values"),
        ({"parameters": {"decision_interval": 2}}, "would change decision_interval"),
        ({"scenarios": "paper"}, "unknown option of a reset"),
    ],
)
def test_wrong_options_are_refused_and_change_nothing(options, message):
    for env in (gymnasium.make(ID, **SHORT), gymnasium.make_vec(ID, num_envs=2, **SHORT)):
        shown, _ = env.reset(seed=0)
        action = np.zeros(env.action_space.shape)
        with pytest.raises(ValueError, match=message):
            env.reset(options=options)
        env.step(action)
        np.testing.assert_array_equal(env.reset(seed=0)[0], shown)


def test_what_would_change_the_spaces_is_refused():
    env = gymnasium.make("filtergym/UavAutopilot-v0", scenario="random")
    env.reset(seed=0)
    with pytest.raises(ValueError, match="would change the fields of the observation of this environment"):
        env.reset(
            options={"parameters": {"plant": "U" if env.unwrapped.task.parameters.plant == "P" else "P"}}
        )


def test_a_vector_of_mixtures_is_not_drawn():
    with pytest.raises(ValueError, match="cannot be drawn"):
        gymnasium.make_vec(ID, num_envs=2, scenario=MIXTURE, render_mode="rgb_array")
    env = gymnasium.make_vec(ID, num_envs=2, render_mode="rgb_array")
    with pytest.raises(ValueError, match="omit render_mode"):
        env.reset(options={"scenario": "paper"})
