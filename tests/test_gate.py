"""Gates and alarms: silent where nothing is wrong, heard where something is, and the same in training as outside."""

import pickle
from dataclasses import replace

import gymnasium
import numpy as np
import pytest
from models import make_model
from scipy.stats import norm

from filtergym import evaluate
from filtergym.agents.gate import FallbackAction, Gate, Gated, GatedMaker, excess_cost
from filtergym.baselines.alarm import LARGER, Alarm, InnovationAlarm, scale_ratio, shift_ratio
from filtergym.baselines.catalogue import baselines_of
from filtergym.baselines.problem import Problem, problem_of
from filtergym.evaluation.competitors.kinds import ConstantPolicy, Policy
from filtergym.names import competitor

ID = "filtergym/ManeuveringTarget-v0"


class Scripted(Alarm):
    """Speaks where the first field is above one."""

    window = 3

    def update(self, observation, memory, start):
        return observation[:, 0] > 1.0, None


class Counting(Policy):
    """Answers how many decisions of the episode it has been asked about, in thousandths."""

    control = "gain"

    def act(self, observation, state, start):
        count = np.where(start, 0, 0 if state is None else state) + 1
        return count[:, None] / 1000.0, count


class Constant(ConstantPolicy):
    control = "gain"
    action = (0.5,)


def test_gate_is_open_for_a_window_and_the_policy_remembers_what_it_was_not_asked_for():
    model = make_model(ID, "gain")
    policy = Gated(model, Counting, alarm=Scripted, fallback=Constant)
    shown = np.zeros((12, 2, len(model.fields)))
    shown[[2, 4], 0, 0] = shown[6, 1, 0] = 2.0
    start = np.zeros((12, 2), dtype=bool)
    start[0] = start[8, 1] = True
    state, actions = None, []
    for row, begun in zip(shown, start, strict=True):
        action, state = policy.predict(row, state, begun)
        actions.append(action[:, 0])
    actions = 1000.0 * np.array(actions).T
    shut = 500.0
    np.testing.assert_allclose(actions[0], [shut, shut, 3, 4, 5, 6, 7, shut, shut, shut, shut, shut])
    # The second episode of the other begins before its window ends.
    np.testing.assert_allclose(actions[1], [*[shut] * 6, 7, 8, shut, shut, shut, shut])


def test_evidence_is_the_ratio_of_densities():
    z = np.linspace(-4.0, 4.0, 9)
    wider = norm.logpdf(z, scale=np.sqrt(LARGER)) - norm.logpdf(z)
    np.testing.assert_allclose(scale_ratio(z**2, 1.0, LARGER), wider, atol=1e-13)
    np.testing.assert_allclose(shift_ratio(z, 0.5), norm.logpdf(z, 0.5) - norm.logpdf(z), atol=1e-13)


class White(InnovationAlarm):
    """On two innovations, without a task that shows them."""

    def __init__(self, decisions):
        self.decisions = decisions
        self.innovation = lambda observation: observation
        self.available = lambda observation: np.ones((len(observation), 1))


def heard(alarm, shown):
    """Whether the alarm speaks, ``(decisions, N)``."""
    memory, found = None, []
    for i, row in enumerate(shown):
        spoken, memory = alarm.update(row, memory, np.full(len(row), i == 0))
        found.append(spoken)
    return np.array(found)


def test_false_alarms_are_as_rare_as_stated():
    noise = np.random.default_rng(0).normal(size=(300, 4000, 2))
    alarm = White(300)
    alarm.false_alarms = 0.3
    assert 0.01 < heard(alarm, noise).any(axis=0).mean() <= 0.3


@pytest.mark.parametrize(("factor", "mean"), [(2.0, 0.0), (0.4, 0.0), (1.0, 1.0), (1.0, -1.0)])
def test_it_speaks_soon_and_falls_silent_when_it_is_over(factor, mean):
    noise = np.random.default_rng(1).normal(size=(300, 200, 2))
    noise[100:200, :, 0] = mean + factor * noise[100:200, :, 0]
    spoken = heard(White(300), noise)
    assert spoken[:100].any(axis=0).mean() < 0.05
    assert spoken[100:160].any(axis=0).mean() > 0.95
    assert spoken[150:200].mean() > 0.4
    assert spoken[240:].any(axis=0).mean() < 0.05


AS_MODELLED = [
    ("LooselyCoupledNavigation", "noise", "outage", {"decision_interval": 5}),
    ("UavAutopilot", "noise", "paper-step", {"horizon": 200}),
    ("RadarEsmTracking", "evidence", "paper", {}),
    ("TightlyCoupledNavigation", "gain", "two-satellites", {"horizon": 20}),
]
WRONG = [
    ("LooselyCoupledNavigation", "noise", "jamming", {}),
    ("UavAutopilot", "noise", "sensor-degradation", {}),
    ("RadarEsmTracking", "evidence", "crowded", {}),
    ("TightlyCoupledNavigation", "gain", "accelerometer-failure", {"horizon": 150}),
    ("ManeuveringTarget", "gains", "missed-detections", {}),
]


def opened(name, control, scenario, episodes, keywords):
    """Share of episodes in which the gate opens, under the action zero."""
    seen = []

    class Listening(Gated):
        def act(self, observation, state, start):
            action, state = super().act(observation, state, start)
            seen.append(state[1].trust.active > 0.0)
            return action, state

    def make(task):
        return Listening(task, FallbackAction)

    make.control = control
    # Compiling takes longer than these episodes.
    keywords = {"split": "validation", "backend": "numpy", **keywords}
    evaluate(f"filtergym/{name}-v0", {"gated": make}, scenario, episodes, **keywords)
    return np.array(seen)[:, :episodes].any(axis=0).mean()


@pytest.mark.parametrize("case", AS_MODELLED, ids=lambda case: case[0])
def test_it_stays_shut_where_nothing_is_wrong(case):
    name, control, scenario, keywords = case
    assert opened(name, control, scenario, 32, keywords) < 0.06


@pytest.mark.parametrize("case", WRONG, ids=lambda case: case[0])
def test_alarms_hear_what_is_wrong(case):
    name, control, scenario, keywords = case
    assert opened(name, control, scenario, 8, keywords) > 0.6


def test_every_alarm_serves_every_control(env_id, control, short):
    """Of every environment; it speaks or not, but answers what it should."""
    env = gymnasium.make_vec(env_id, num_envs=3, control=control, backend="numpy", **short)
    alarm = (baselines_of(env_id).alarm or InnovationAlarm)(env.unwrapped.model)
    shown, _ = env.reset(seed=0)
    memory, start = None, np.ones(3, dtype=bool)
    for _ in range(2):
        spoken, memory = alarm.update(shown, memory, start)
        assert spoken.shape == (3,)
        assert spoken.dtype == bool
        assert not np.isnan(memory.sums).any()
        start = np.zeros(3, dtype=bool)
        shown = env.step(env.action_space.sample())[0]


def test_a_gated_agent_answers_as_one_of_its_two_filters():
    fallback = baselines_of(ID).fallback
    names = ["bptt", fallback, "gated:bptt"]
    data = evaluate(ID, names, episodes=16, scenario="random", tracks=True, split="validation")
    agent, other, gated = data["estimate"].values
    is_agent, is_other = ((gated == estimate).all(axis=-1) for estimate in (agent, other))
    assert (is_agent | is_other).all()
    assert 0.05 < is_agent.mean() < 0.95
    variance = data["covariance"].values
    assert (variance[2][is_other] == variance[1][is_other]).all()


def test_who_is_shown_one_plot_of_many_is_not_trusted():
    """The fallback takes in all plots of a scan, and has no density of the one that the agent's filter takes."""
    fallback, name = baselines_of(ID).fallback, "kalman-net"
    options = {"episodes": 4, "scenario": "clutter", "split": "validation", "tracks": True}
    data = evaluate(ID, [fallback, name, f"gated:{name}"], **options)
    other, agent, gated = data["estimate"].values
    # Before the first plot nothing is compared; what that answer moves the window by is less than an error of range.
    sigma = make_model(ID, None, "clutter").task.parameters.range_sigma
    np.testing.assert_allclose(gated[..., :2], other[..., :2], atol=sigma, rtol=0.0)
    assert abs(agent - other).max() > 10.0 * sigma


@pytest.mark.parametrize(
    ("name", "agent"),
    [
        ("ManeuveringTarget", "kalman-net"),
        pytest.param("UavAutopilot", "ppo", marks=pytest.mark.slow),
        # Trained behind a gate and as a correction: what is around it is compiled, too.
        pytest.param("TightlyCoupledNavigation", "ppo", marks=pytest.mark.slow),
    ],
)
def test_both_filters_and_alarms_are_compiled_and_nothing_else_comes_out(name, agent):
    id = f"filtergym/{name}-v0"
    names, options = [f"gated:{agent}"], {"episodes": 3, "split": "validation", "horizon": 40}
    compiled = evaluate(id, names, backend="compiled", timed=True, **options)
    assert compiled["compiled"].values.all()
    plain = evaluate(id, names, backend="numpy", **options)
    np.testing.assert_allclose(compiled["cost"].values, plain["cost"].values, rtol=1e-6)


class Lying(Policy):
    """The network in its place takes the most extreme action."""

    control = "gain"
    traceable = True

    def act(self, observation, state, start):
        return np.ones((len(observation), 1)), state


class Silent(Alarm):
    """Never speaks."""

    def update(self, observation, memory, start):
        return observation[:, 0] != observation[:, 0], None


class Loud(Alarm):
    """Speaks always."""

    def update(self, observation, memory, start):
        return observation[:, 0] == observation[:, 0], None


def test_who_predicts_worse_than_the_fallback_is_not_trusted():
    """Under control gain of UavAutopilot the action one triples the process noise, and the alarm is always on."""
    problem = problem_of("filtergym/UavAutopilot-v0")
    gated = GatedMaker(problem, "lying", Lying, fallback="kalman", alarm=Loud)
    makers = {"kalman": "kalman", "lying": Lying, "gated": gated}
    data = evaluate(problem.id, makers, "paper-noise", 32, split="validation")
    paper, lying, held = data["cost"].mean(["episode", "time"]).values
    assert lying > 1.01 * paper
    assert held - paper < 0.25 * (lying - paper)


def test_the_fallback_covariance_follows_its_innovations():
    """Receivers that are five to ten times as noisy as stated; with the stated noise nothing changes."""
    problem = problem_of("filtergym/LooselyCoupledNavigation-v0")
    options = {"split": "validation", "episodes": 8, "tracks": True}
    silent = GatedMaker(problem, "silent", competitor(problem.id, problem.paper), alarm=Silent)
    makers = {"paper": problem.paper, "gated": silent}
    jammed, plain = (evaluate(problem.id, makers, scenario, **options) for scenario in ("jamming", "paper"))
    for data in (jammed, plain):
        paper, gated = data["estimate"].values
        np.testing.assert_allclose(gated, paper, rtol=1e-9, atol=1e-12)
    paper, gated = (jammed["nees"].sel(policy=name).mean().item() for name in makers)
    assert gated < 0.5 * paper
    paper, gated = plain["covariance"].values
    assert (np.isclose(gated, paper, rtol=1e-9).all(axis=(-1, -2))).mean() > 0.95
    naive = naive_factors(
        jammed["nis"].sel(policy="paper").values, jammed["nis_degrees"].sel(policy="paper").values
    )
    paper, gated = jammed["covariance"].values
    np.testing.assert_allclose(gated, naive[..., None, None] * paper, rtol=1e-6)


def naive_factors(nis, degrees):
    """Of the covariance, measurement by measurement, ``(episodes, time)``."""
    factors = np.ones_like(nis)
    for episode in range(len(nis)):
        squares = count = 50.0
        for k, (square, freedom) in enumerate(zip(nis[episode], degrees[episode], strict=True)):
            if np.isfinite(square) and freedom > 0.0:
                squares, count = 0.98 * squares + square, 0.98 * count + freedom
            if squares / count > 1.0 + 3.0 / np.sqrt(count):
                factors[episode, k] = squares / count
    return factors


@pytest.mark.parametrize(
    ("fallback", "message"),
    [
        ("fixed-low", r"fallback 'fixed-low' costs [\d.]+ % more than the paper's algorithm 'imm'"),
        ("imm-smoother", "'imm-smoother' is of kind smoother and cannot be the fallback of a gate"),
        ("imm-tuned", "'imm-tuned' has task parameters of its own"),
    ],
)
def test_what_a_gate_cannot_fall_back_on_is_refused(fallback, message):
    with pytest.raises(ValueError, match=message):
        GatedMaker(problem_of(ID), "adaptive", competitor(ID, "adaptive"), fallback=fallback)


@pytest.mark.claims
def test_every_environment_falls_back_on_something_better_than_the_paper(env_id):
    problem = problem_of(env_id)
    if not problem.baselines.fallback:
        pytest.skip("it falls back on the paper's algorithm")
    excess, errors = excess_cost(problem, problem.baselines.fallback)
    assert excess < 0.0
    assert errors < 0.0


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("kalman-imm", "'kalman-imm' is of kind estimator and has no actions that depend on measurements"),
        ("random", "'random' is of kind policy and has no actions that depend on measurements"),
        ("immm", "unknown policy 'immm'"),
    ],
)
def test_who_has_no_gate_is_refused(name, message):
    with pytest.raises(ValueError, match=message):
        competitor(ID, f"gated:{name}")


@pytest.mark.parametrize(
    ("make", "control", "message"),
    [
        (Gate, "mode", "has no constant action of the paper's algorithm: give the gate a fallback"),
        (Gate, "weights", "has no constant action of the paper's algorithm"),
        (lambda model: Gate(model, fallback=Constant), "gains", "fallback is made for control 'gain', but"),
        (lambda model: Gated(model, Constant), "gains", "policy is made for control 'gain', but the task"),
        (lambda model: Gate(model, window=0), "gain", "window must be at least one decision, got 0"),
        (InnovationAlarm, "gains", "has no 'innovation' in its observation under control 'gains'"),
    ],
)
def test_gates_that_cannot_be(make, control, message):
    with pytest.raises(ValueError, match=message):
        make(make_model(ID, control))


def test_an_environment_brings_an_alarm_or_has_the_general_one(monkeypatch):
    problem, model = problem_of(ID), make_model(ID, "gain")
    assert type(Gate(model).trust.alarm) is problem.baselines.alarm
    assert Gate(model, alarm=Scripted).trust.window == 3
    without = replace(problem, baselines=replace(problem.baselines, alarm=None))
    monkeypatch.setattr(Problem, "of", lambda cls: without)
    assert type(Gate(model).trust.alarm) is InnovationAlarm
    assert Gate(model).trust.window == InnovationAlarm.window


# --- in training


def native(**keywords):
    from filtergym.agents import to_sb3

    model = make_model(ID, "gain")
    env = gymnasium.make_vec(ID, num_envs=5, autoreset_mode="SameStep", control="gain", horizon=30)
    made = to_sb3(env, staggered=True, **keywords)
    made.seed(0)
    return made, model


def test_the_adapter_asks_the_gate_as_the_policy_does():
    pytest.importorskip("stable_baselines3")
    inside, model = native(gate=Gate(make_model(ID, "gain"), Constant))
    outside, _ = native()
    policy = Gated(model, Counting, fallback=Constant)
    shown = inside.reset()
    np.testing.assert_array_equal(outside.reset(), shown)
    agent, memory, state, start = Counting(model), None, None, np.ones(5, dtype=bool)
    for step in range(70):
        raw, memory = agent.predict(shown, memory, start)
        action, state = policy.predict(shown, state, start)
        one, other = inside.step(raw), outside.step(action)
        for mine, theirs in zip(one[:3], other[:3], strict=True):
            np.testing.assert_array_equal(mine, theirs)
        if step == 40:
            kept = pickle.dumps(inside.snapshot())
            inside, _ = native(gate=Gate(model, Constant))
            inside.restore(pickle.loads(kept))
        shown, start = one[0], one[2]


def test_what_was_around_an_agent_is_around_it_again(monkeypatch, tmp_path):
    pytest.importorskip("sb3_contrib")
    from filtergym.agents import validation
    from filtergym.agents.export import export_run
    from filtergym.agents.sb3_training import train_sb3
    from filtergym.agents.training_run import RunOptions, load_run, new_run, open_run
    from filtergym.agents.training_session import Session

    monkeypatch.setattr(validation, "VALIDATION_EPISODES", 16)
    network = {"n_steps": 30, "batch_size": 60, "n_epochs": 2, "policy_kwargs": {"net_arch": [8]}}
    options = RunOptions("ppo", None, 240, 4, overrides=network, residual_to="adaptive", gated=True)
    run = train_sb3(open_run(tmp_path, new_run(problem_of(ID), options), False), Session(tmp_path))
    assert run.control == "gain"
    assert (load_run(tmp_path).residual_to, load_run(tmp_path).gated) == ("adaptive", True)
    assert " --residual-to adaptive --gated --set " in run.command
    agent = tmp_path / "agent.safetensors"
    export_run(tmp_path, agent)
    names = [str(tmp_path), str(tmp_path / "best" / "model.zip"), str(agent), "adaptive"]
    cost = evaluate(ID, names, episodes=16, split="validation", trust=True)["cost"].values
    best = min(entry["cost"] for entry in run.validation)
    assert best == pytest.approx(cost[0].mean(), rel=1e-6)
    np.testing.assert_allclose(cost[1], cost[0], rtol=1e-4)
    np.testing.assert_array_equal(cost[2], cost[0])
    # With regular scans there are episodes without an alarm, and then nothing is corrected.
    regular = {"detection_probability": (1.0, 1.0), "scan_jitter": (0.0, 0.0)}
    cost = evaluate(ID, names[::3], episodes=16, split="validation", trust=True, **regular)["cost"].values
    unchanged = (cost[1] == cost[0]).all(axis=1)
    assert 0 < unchanged.sum() < 16


@pytest.mark.parametrize(
    ("algorithm", "around", "message"),
    [
        ("bptt", {"residual_to": "adaptive"}, "'bptt' has no gradient of the policy that would be corrected"),
        (
            "ppo",
            {"residual_to": "kalman-imm"},
            "of kind estimator and has no actions to correct",
        ),
        ("ppo", {"residual_to": "adaptive", "control": "gains"}, "made for control 'gain', but the environ"),
        ("ppo", {"residual_to": "imm-tuned"}, "has task parameters of its own"),
        ("ppo", {"gated": True, "control": "mode"}, "has no constant action of the paper's algorithm"),
    ],
)
def test_training_around_what_cannot_be(algorithm, around, message):
    pytest.importorskip("sb3_contrib")
    from filtergym.agents.training_run import RunOptions, new_run

    with pytest.raises(ValueError, match=message):
        new_run(problem_of(ID), RunOptions(algorithm, **around))


def test_a_policy_that_chooses_a_hypothesis_has_no_residual():
    pytest.importorskip("sb3_contrib")
    from filtergym.agents.training_run import RunOptions, new_run

    problem = problem_of("filtergym/UavAutopilot-v0")
    with pytest.raises(ValueError, match="a residual action needs a continuous control: 'mode' has Discrete"):
        new_run(problem, RunOptions("ppo", residual_to="over-smoothed"))


def test_gradient_through_the_gate_is_that_of_torch():
    torch = pytest.importorskip("torch")
    pytest.importorskip("llvmlite")
    from filtergym.agents.bptt import NetworkPolicy, descend_episodes
    from filtergym.agents.unrolled import Unrolled
    from filtergym.envs.interface.vector_environment import TaskVectorEnv

    keywords = {"control": "gain", "horizon": 12, "reward": "cost", "autoreset_mode": "Disabled"}
    envs = [TaskVectorEnv(ID, 6, backend=backend, **keywords) for backend in ("torch", "compiled")]
    torch.manual_seed(0)
    policy = NetworkPolicy(len(envs[0].model.fields), envs[0].model.action_space, 4).double()
    policy.low, policy.high = policy.low.double(), policy.high.double()
    found = []

    def descend():
        found.append(torch.cat([part.grad.ravel() for part in policy.parameters()]))
        policy.zero_grad()

    gates = [Gate(env.model, Constant, window=2) for env in envs]
    for env in envs:
        env.reset(seed=0)
    # Two windows, between which the gradient is cut.
    costs = [
        descend_episodes(envs[0], policy, 6, descend, gates[0]),
        Unrolled(envs[1], policy, 6, gate=gates[1]).descend_episodes(descend),
        Unrolled(envs[1], policy, 12).descend_episodes(descend),
    ]
    assert costs[1] == pytest.approx(costs[0], rel=1e-9)
    for torchs, compiled in zip(found[:2], found[2:4], strict=True):
        torch.testing.assert_close(compiled, torchs, rtol=0.0, atol=1e-6 * float(torchs.abs().max()))
    ungated = found[4] - (found[2] + found[3]) / 2.0
    assert ungated.abs().max() > 0.01 * found[2].abs().max()
