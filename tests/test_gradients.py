"""Gradients of compiled episodes: those that torch finds."""

from unittest.mock import Mock

import numpy as np
import pytest

from filtergym.baselines.problem import problem_of
from filtergym.envs.engine import backend
from filtergym.envs.interface.vector_environment import TaskVectorEnv

pytest.importorskip("torch")
pytest.importorskip("llvmlite")
pytest.importorskip("stable_baselines3")
import array_api_compat.torch as torch_namespace
import torch
from rounding import assert_same, move_roundings

from filtergym.agents import bptt
from filtergym.agents.bptt import NetworkPolicy, descend_episodes, train_bptt
from filtergym.agents.training_run import RunOptions, new_run
from filtergym.agents.training_session import Session
from filtergym.agents.unrolled import Unrolled
from filtergym.compiler import namespace
from filtergym.compiler.functions import CompiledFunction
from filtergym.compiler.gradients import FLAT, RULES, pullback
from filtergym.compiler.program import FUNCTIONS, OPERATIONS, Graph

UNARY = ("negative", "abs", "sign", "floor", "ceil", "trunc", "round", "sqrt", "exp", "expm1", "exp2", "log")
UNARY += ("log1p", "log2", "log10", "sin", "cos", "tan", "asin", "acos", "atan", "sinh", "cosh", "tanh")
UNARY += ("asinh", "acosh", "atanh")
BINARY = ("add", "subtract", "multiply", "divide", "remainder", "maximum", "minimum", "atan2", "pow", "hypot")


def compiled_gradients(function, *arrays):
    """Gradients with respect to arrays of what a function of a namespace and arrays returns, times 1, 2, 3, ..."""
    graph = Graph()

    def back(*parts):
        *inputs, adjoint = parts
        return tuple(pullback(graph, [function(namespace, *inputs)], [adjoint], inputs))

    return CompiledFunction(back, graph)(*arrays, np.arange(1.0, arrays[0].shape[-1] + 1.0))


def torch_gradients(function, *arrays):
    tensors = [torch.tensor(array, requires_grad=True) for array in arrays]
    answer = function(torch_namespace, *tensors)
    if answer.requires_grad:
        answer.backward(torch.arange(1.0, arrays[0].shape[-1] + 1.0, dtype=torch.float64))
    return [np.zeros(t.shape) if t.grad is None else t.grad.numpy() for t in tensors]


def assert_same_gradients(function, *arrays):
    ours, theirs = compiled_gradients(function, *arrays), torch_gradients(function, *arrays)
    for one, other in zip(ours, theirs, strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-13, atol=1e-15)


@pytest.mark.processors
@pytest.mark.parametrize("name", UNARY + BINARY)
def test_every_operation_has_the_gradient_of_torch(name):
    rng = np.random.default_rng(0)
    arrays = rng.uniform(0.1, 0.9, (2, 16)) * (
        1.0 if name in ("log", "log2", "log10", "sqrt", "pow") else -1.0
    )
    arrays = [2.0 - arrays[0]] if name == "acosh" else arrays[: 1 + (name in BINARY)]
    assert_same_gradients(lambda xp, *given: getattr(xp, name)(*given), *arrays)


def test_no_operation_is_forgotten():
    assert RULES.keys() | FLAT == OPERATIONS.keys() | FUNCTIONS.keys() | {"take", "input", "constant"}


@pytest.mark.parametrize(
    "function",
    [
        lambda xp, x, y: xp.maximum(x, y) * 3.0 + xp.minimum(x, y),
        lambda xp, x, y: xp.clip(x, -1.0, 1.0) * y,
        lambda xp, x, y: xp.clip(x, None, 0.0) + xp.clip(y, 1.0, None),
        lambda xp, x, y: xp.abs(x - y),
        lambda xp, x, y: xp.where(x >= y, x * y, x - y),
        lambda xp, x, y: xp.where((x > 0.0) & (y > 0.0), x, y * y),
        lambda xp, x, y: xp.sum(xp.stack([x, y, x * y]), axis=0) * x,
        lambda xp, x, y: xp.astype(x > y, xp.float64) * x,
        lambda xp, x, y: (x**3.0) * (y**2),
    ],
)
def test_at_ties_and_limits_the_gradient_is_that_of_torch(function):
    places = np.array([-2.0, -1.0, 0.0, 1.0, 2.0])
    x, y = (part.ravel() for part in np.meshgrid(places, places))
    assert_same_gradients(function, x, y)


def test_nothing_flows_back_to_a_place_in_a_table():
    index = np.array([0.0, 2.0, 1.0, 0.0])
    table = np.array([5.0, 7.0, 11.0])

    def function(xp, index, x):
        taken = xp.take(xp.asarray(table), xp.astype(index, xp.int64))
        return taken * x

    of_index, of_x = compiled_gradients(function, index, np.ones(4))
    np.testing.assert_array_equal(of_index, 0.0)
    np.testing.assert_array_equal(of_x, table[[0, 2, 1, 0]] * np.arange(1.0, 5.0))


def random_policy(env, dtype, network="recurrent"):
    torch.manual_seed(0)
    policy = NetworkPolicy(len(env.model.fields), env.model.action_space, 6, network=network).to(dtype)
    with torch.no_grad():
        policy.head.weight.mul_(10.0)
        policy.head.bias.normal_(0.0, 0.3)
        policy.mean.normal_()
        # So small that some observations are cut at the limit.
        policy.scale.uniform_(0.1, 0.5)
        policy.use_fields(len(env.model.fields) - 2)
    return policy


@pytest.mark.processors
@pytest.mark.parametrize(
    ("name", "control", "keywords", "largest", "network"),
    [
        ("ManeuveringTarget", "gain", {}, 0.01, "feedforward"),
        ("ManeuveringTarget", "weights", {"decision_interval": 3, "horizon": 99}, None, "linear"),
        ("ManeuveringTarget", "kalman-net", {}, 0.01, "recurrent"),
        ("ManeuveringTarget", "student", {}, None, "recurrent"),
        ("ManeuveringTarget", "sigma-points", {}, 0.01, "recurrent"),
        ("LooselyCoupledNavigation", "gain", {"decision_interval": 2}, 0.01, "recurrent"),
        ("UavAutopilot", "gain", {}, None, "recurrent"),
        ("RadarEsmTracking", "evidence", {}, 0.01, "recurrent"),
        # Its gradient takes longest to compile; a decision is ten measurements.
        pytest.param(
            "TightlyCoupledNavigation",
            "evidence",
            {"max_episode_steps": 2},
            None,
            "recurrent",
            marks=pytest.mark.slow,
        ),
    ],
)
def test_gradients_of_a_policy_are_those_of_torch(name, control, keywords, largest, network):
    penalty = 0.0 if largest is None else 0.3

    def descended(backend, repetition=None):
        """Mean cost, and gradients by window: of three decisions, three and one; five episodes in eight lanes."""
        env = TaskVectorEnv(
            f"filtergym/{name}-v0", 5, control=control, backend=backend, reward="cost",
            autoreset_mode="Disabled", **{"max_episode_steps": 7, **keywords},
        )  # fmt: skip
        policy, found = random_policy(env, torch.float64, network), []

        def descend():
            found.append(torch.cat([part.grad.ravel() for part in policy.parameters()]))
            policy.zero_grad()

        if repetition is not None:
            move_roundings(env, repetition)
        env.reset(seed=0)
        if backend == "torch":
            cost = descend_episodes(env, policy, 3, descend, largest=largest, penalty=penalty)
        else:
            cost = Unrolled(env, policy, 3, largest=largest, penalty=penalty).descend_episodes(descend)
        assert len(found) == -(-env.last_decision // 3)
        return cost, torch.stack(found).numpy()

    cost, gradients = descended("compiled")
    expected_cost, expected = descended("torch")
    other_costs, others = zip(*(descended("torch", repetition) for repetition in range(4)), strict=True)
    assert (abs(expected).max(axis=1) > 0.0).all()
    assert_same(cost, expected_cost, other_costs, "cost")
    assert_same(gradients, expected, others, "gradient", lanes=1)


def test_actions_that_are_no_numbers_are_refused():
    env = TaskVectorEnv("filtergym/ManeuveringTarget-v0", 2, backend="compiled", autoreset_mode="Disabled")
    policy = random_policy(env, torch.float32)
    with torch.no_grad():
        policy.head.bias.fill_(float("nan"))
    with pytest.raises(ValueError, match="not finite"):
        Unrolled(env, policy, 1).descend_episodes(lambda: None)  # a measurement at a time


def test_without_llvmlite_training_learns_the_same_through_torch(tmp_path, monkeypatch):
    learned = {}
    for there in (True, False):
        monkeypatch.setattr(backend, "AVAILABLE", there)
        folder = tmp_path / str(there)
        folder.mkdir()
        through_torch = Mock(side_effect=descend_episodes)
        monkeypatch.setattr(bptt, "descend_episodes", through_torch)
        overrides = {"hidden_size": 4, "truncation": 40}
        run = new_run(
            problem_of("filtergym/ManeuveringTarget-v0"),
            RunOptions("bptt", "gain", 400, 4, overrides=overrides),
        )
        monkeypatch.setattr("filtergym.agents.validation.VALIDATION_EPISODES", 16)
        train_bptt(run, Session(folder, validate_every=10**9))
        assert through_torch.called is not there
        learned[there] = torch.load(folder / "checkpoint" / "checkpoint.pt", weights_only=True)["policy"]
    for name, tensor in learned[True].items():
        torch.testing.assert_close(tensor, learned[False][name], rtol=0.0, atol=1e-3)
