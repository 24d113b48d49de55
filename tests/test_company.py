"""Episode i is episode i, bit for bit, whatever the number of episodes that are evaluated with it."""

import gymnasium
import numpy as np
import pytest
from models import KINDS, make_model

from filtergym import evaluate
from filtergym.agents.named_policies import pretrained_agents
from filtergym.agents.residual import ResidualPolicy
from filtergym.baselines.problem import problem_of
from filtergym.envs.engine import programs
from filtergym.evaluation.competitors.kinds import DRAWN_AT_ONCE, RandomPolicy
from filtergym.names import competitor

ID = "filtergym/ManeuveringTarget-v0"


def assert_same(some, more):
    """The episodes of one dataset are the first of the other."""
    for name in more:
        expected = more[name].values
        if "episode" in more[name].dims:
            expected = expected[:, : some.sizes["episode"]]
        np.testing.assert_array_equal(some[name].values, expected, err_msg=str(name))


@pytest.mark.parametrize("env_id", KINDS)
def test_an_episode_is_the_same_in_any_company(env_id, short, monkeypatch):
    """One of each kind, since a competitor may take a second to trace."""
    problem, agents = problem_of(env_id), pretrained_agents(env_id)
    known = problem.baselines
    kinds = (known.policies, known.estimators, known.smoothers, known.references, known.bounds, agents)
    names = [name for kind in kinds for name in list(kind)[:1]]
    monkeypatch.setattr(programs, "PROGRAM_CACHE_SIZE", len(names))  # what was traced once serves twice
    together = evaluate(env_id, names, episodes=13, **short)
    monkeypatch.setattr("filtergym.evaluation.statistics.bootstrap.BLOCK", 12)  # and the last one alone
    assert_same(evaluate(env_id, names, episodes=13, **short), together)


def residual(model):
    return ResidualPolicy(model, RandomPolicy(model), competitor(ID, "adaptive")(model))


residual.control = "gain"


def test_random_actions_are_every_episodes_own(monkeypatch):
    makers = {"random": "random", "residual": residual}
    monkeypatch.setattr("filtergym.evaluation.statistics.bootstrap.BLOCK", 8)
    together = evaluate(ID, makers, episodes=17, horizon=10)
    assert_same(evaluate(ID, makers, episodes=3, horizon=10), together)
    policy = RandomPolicy(make_model(ID, "gain"))
    observation = np.zeros((17, len(policy.model.fields)))
    actions, _ = policy.predict(
        observation, policy.begin([int(seed) for seed in together["episode_seed"].values])
    )
    assert len(np.unique(actions)) == 17


@pytest.mark.parametrize("control", ["weights", "mode"])
def test_random_actions_are_one_draw_after_another(control):
    policy = RandomPolicy(make_model(ID, control))
    space, memory = policy.model.action_space, policy.begin([3, 5])
    generators = [np.random.default_rng([policy.seed, seed]) for seed in (3, 5)]
    for _ in range(2 * DRAWN_AT_ONCE + 1):
        found, memory = policy.predict(np.zeros((2, len(policy.model.fields))), memory)
        if control == "mode":
            expected = [generator.integers(space.n) for generator in generators]
        else:
            expected = [generator.uniform(space.low, space.high) for generator in generators]
        np.testing.assert_array_equal(found, expected)


def test_a_model_is_asked_about_as_many_always():
    pytest.importorskip("sb3_contrib")
    from filtergym.agents.sb3_algorithms import ALGORITHMS

    env = gymnasium.make(ID, horizon=10)
    model = ALGORITHMS["recurrent-ppo"]("MlpLstmPolicy", env, seed=0, device="cpu", n_steps=8, batch_size=8)
    together = evaluate(ID, {"model": model}, episodes=130, horizon=10)
    for count in (1, 3):
        assert_same(evaluate(ID, {"model": model}, episodes=count, horizon=10), together)
