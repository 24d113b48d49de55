"""A bank closed by a policy is a filter that computes what the policy answers, asked in Python."""

import numpy as np
import pytest

from filtergym import evaluate
from filtergym.agents.learned_policy import PRETRAINED
from filtergym.agents.settings import ESTIMATORS
from filtergym.baselines.problem import import_problem
from filtergym.compiler import namespace
from filtergym.compiler.namespace import NotTraceable
from filtergym.envs.engine.backend import make_model
from filtergym.evaluation.competitors.kinds import make_competitor
from filtergym.evaluation.competitors.steered_filter import steer, trace_policy
from filtergym.evaluation.running.evaluate import control_of
from filtergym.evaluation.running.rollout import run_competitor, start_lanes
from filtergym.names import find_competitor

pytest.importorskip("llvmlite")

AGENTS = [file for file in sorted(PRETRAINED.glob("*/*.safetensors")) if file.stem not in ESTIMATORS]
"""All that are shipped and act."""
SEEDS = range(8)
HORIZON = 30


class Steer:
    """Closes the bank of a traced model by a policy."""

    def __init__(self, maker, keywords):
        self.maker, self.keywords = maker, keywords

    def __call__(self, model):
        plain = make_model(type(model.task), model.control, **self.keywords)
        return steer(model, make_competitor(self.maker, plain))


def estimates(model, episode):
    return {"mean": model.mean(episode), "covariance": model.covariance(episode)}


@pytest.mark.parametrize(
    ("environment", "name", "options"),
    [
        ("ManeuveringTarget", "imm", {}),
        ("ManeuveringTarget", "adaptive", {"decision_interval": 3}),
        ("UavAutopilot", "over-smoothed", {}),
        ("RadarEsmTracking", "forgetting-joint-type", {}),
        ("LooselyCoupledNavigation", "augmented-gain-mehra", {}),
        ("LooselyCoupledNavigation", "innovation-adaptive", {"decision_interval": 5}),
        ("UavAutopilot", "innovation-adaptive", {}),
        pytest.param("TightlyCoupledNavigation", "nis-adaptive", {}, marks=pytest.mark.slow),
        *(
            pytest.param(
                file.parent.name.removesuffix("-v0"),
                file.stem,
                {},
                marks=pytest.mark.slow if file.parent.name.startswith("Tightly") else (),
            )
            for file in AGENTS
        ),
    ],
)
def test_a_traced_policy_does_what_it_does_when_it_is_asked(environment, name, options):
    problem = import_problem(f"filtergym/{environment}-v0")
    maker = find_competitor(problem, name).maker
    control = control_of(maker, None, problem.task, name)
    keywords = {"horizon": HORIZON, **getattr(maker, "task_keywords", {}), **options}
    model = make_model(problem.task, control, backend="compiled", **keywords)
    asked = run_competitor(model, maker, "policy", SEEDS, estimates)
    steered = model.with_filter(Steer(maker, keywords))
    lanes, found = start_lanes(steered, SEEDS), []
    for _ in range(lanes.decisions_per_episode):
        found += [report["mean"] for report, _ in lanes.decide(np.zeros(len(SEEDS), dtype=int), estimates)]
    sigma = np.sqrt(np.diagonal(asked["covariance"], axis1=-2, axis2=-1))
    # Measured 2e-13 of a deviation: a last bit of the action, over the steps that follow.
    error = np.abs(np.moveaxis(np.array(found), -1, 0) - asked["mean"]) / np.maximum(sigma, 1e-9)
    assert error.max() < 1e-10


def test_a_policy_that_draws_numbers_is_not_traced():
    problem = import_problem("filtergym/ManeuveringTarget-v0")
    maker = find_competitor(problem, "random").maker
    model = make_model(problem.task, "gain", backend="compiled")
    with pytest.raises(NotTraceable):
        model.with_filter(Steer(maker, {}))


BPTT = "filtergym/ManeuveringTarget-v0", "bptt"


def test_the_layers_of_a_network_are_loops_that_sum_in_the_same_order(monkeypatch):
    """The same bits as of a straight line, in a program that is shorter than the network has weights."""
    problem = import_problem(BPTT[0])
    maker = find_competitor(problem, BPTT[1]).maker
    found, steps = [], []
    for large in (namespace.LARGE, 10**9):  # beyond the second no product is a loop
        monkeypatch.setattr(namespace, "LARGE", large)
        model = make_model(problem.task, maker.control, backend="compiled", horizon=HORIZON)
        policy = make_competitor(maker, model)
        steps.append(len(trace_policy(model, policy).program.steps))
        model.programs._kept.clear()  # what was traced for the same parameters before
        found.append(run_competitor(model, maker, "policy", SEEDS, estimates))
    weights = sum(values.size for values in maker.arrays.values())
    assert steps[0] < weights < steps[1]
    for name, values in found[0].items():
        np.testing.assert_array_equal(values, found[1][name], err_msg=name)


def test_an_agent_is_traced_once_for_all_that_an_evaluation_does_with_it(monkeypatch):
    monkeypatch.setattr(
        "filtergym.evaluation.statistics.bootstrap.BLOCK", 8
    )  # several pieces of few episodes
    traced = []
    monkeypatch.setattr(
        "filtergym.evaluation.running.rollout.trace_policy",
        lambda *given: traced.append(given) or trace_policy(*given),
    )
    evaluate(*BPTT, episodes=24, horizon=HORIZON - 1, timed=True)  # a horizon of no other test
    assert len(traced) == 1
