"""Whole episodes in one native call are the episodes that are stepped, bit for bit."""

import copy
import itertools

import gymnasium as gym
import numpy as np
import pytest

from filtergym import evaluate
from filtergym.baselines.problem import problem_of
from filtergym.envs.engine import stepper
from filtergym.envs.engine.backend import make_model
from filtergym.evaluation.competitors.kinds import Policy, kind_of
from filtergym.evaluation.running import rollout as rollouts
from filtergym.evaluation.running import times
from filtergym.evaluation.running.evaluate import control_of
from filtergym.evaluation.running.rollout import rollout, run_episodes
from filtergym.evaluation.running.seeds import episode_seeds
from filtergym.evaluation.running.stored_values import StoredValues, bound_values

pytest.importorskip("llvmlite")

ID = "filtergym/ManeuveringTarget-v0"
SEEDS = episode_seeds("test", 4, 11)
CASES = [
    ("ManeuveringTarget", "missed-detections", {"horizon": 40, "decision_interval": 5}),
    # More than the noise that is drawn at once.
    ("LooselyCoupledNavigation", "outage", {"horizon": 300, "decision_interval": 3}),
    ("UavAutopilot", "sensor-degradation", {"horizon": 90}),
]


def model_of(environment, name, scenario, threads=1, **keywords):
    problem = problem_of(f"filtergym/{environment}-v0")
    maker = problem.competitor(name)
    kind = kind_of(maker)
    control = control_of(maker, None, problem.task, name)
    keywords = {**getattr(maker, "task_keywords", {}), **keywords}
    model = make_model(problem.task, control, scenario, backend="compiled", threads=threads, **keywords)
    return model, maker, kind, bound_values if kind == "bound" else StoredValues(tracks=True)


def run_stepped(model, maker, kind, report, seeds=SEEDS):
    """The same by one step after another."""
    series, actions = {}, []
    for found, action in rollout(model, maker, seeds, report, kind=kind):
        for each, values in found.items():
            series.setdefault(each, []).append(np.moveaxis(values[..., : len(seeds)], -1, 0).copy())
        actions.append(action)
    return {each: np.stack(values, axis=1) for each, values in series.items()}, np.stack(actions, axis=1)


@pytest.mark.parametrize(("environment", "scenario", "keywords"), CASES)
def test_whole_episodes_are_those_that_are_stepped(environment, scenario, keywords, monkeypatch):
    """Of two competitors of each kind."""
    monkeypatch.setattr(rollouts, "_step_episodes", None)
    known = problem_of(f"filtergym/{environment}-v0").baselines
    kinds = (known.policies, known.estimators, known.references, known.bounds)
    for name in [name for kind in kinds for name in (*list(kind)[:1], *list(kind)[-1:]) if name != "random"]:
        given = model_of(environment, name, scenario, **keywords)
        found, action = run_episodes(*given[:3], SEEDS, given[3])
        expected, actions = run_stepped(*given)
        assert found.keys() == expected.keys()
        for each, values in expected.items():
            np.testing.assert_array_equal(found[each], values, err_msg=f"{name}: {each}")
        if given[2] == "policy":
            np.testing.assert_array_equal(action, actions, err_msg=name)


@pytest.mark.parametrize("name", ["imm", "adaptive", "kalman-imm"])
def test_episodes_go_on_from_where_they_were_left(name, monkeypatch):
    """World, filter and the memory of a policy, over chunks of seven measurements."""
    given = model_of("ManeuveringTarget", name, "random", horizon=24)
    found, action = run_episodes(*given[:3], SEEDS, given[3])
    monkeypatch.setattr(rollouts, "AT_ONCE", 16 * 7)
    ticks = []
    parts, actions = run_episodes(*given[:3], SEEDS, given[3], tick=ticks.append)
    assert ticks == [11 * 7, 11 * 7, 11 * 7, 11 * 3]
    for each, values in found.items():
        np.testing.assert_array_equal(parts[each], values, err_msg=each)
        assert parts[each].flags.c_contiguous
    np.testing.assert_array_equal(actions, action)


@pytest.mark.parametrize("threads", [1, 3])
def test_company_tiles_and_threads_change_no_bit(threads):
    """1600 lanes are several tiles, and enough for several threads."""
    given = model_of("ManeuveringTarget", "adaptive", "random", threads=threads, horizon=7)
    seeds = episode_seeds("test", 5, 1600)
    found, action = run_episodes(*given[:3], seeds, given[3])
    few, few_actions = run_episodes(*given[:3], seeds[1100:1103], given[3])
    np.testing.assert_array_equal(action[1100:1103], few_actions)
    for each, values in few.items():
        np.testing.assert_array_equal(found[each][1100:1103], values, err_msg=each)


class Traced(Policy):
    """States what it returns."""

    control = "gain"
    traceable = True

    def act(self, observation, state, start):
        return self.answer(observation), None


class Far(Traced):
    def answer(self, observation):
        return 1e3 * observation[:, :1]


class NoNumber(Traced):
    def answer(self, observation):
        return np.log(-1.0 - observation[:, :1] ** 2)


class Branching(Traced):
    def answer(self, observation):
        if (observation[:, 0] > 0.5).any():
            return np.zeros((len(observation), 1))
        return np.ones((len(observation), 1))


class Counting(Far):
    """Another ``act`` without declarations."""

    def act(self, observation, state, start):
        self.asked = getattr(self, "asked", 0) + 1
        return np.full((len(observation), 1), 0.01 * self.asked), None


def test_actions_are_recorded_within_their_limits():
    action = evaluate(ID, {"far": Far}, episodes=3, horizon=10)["action"].values
    assert np.abs(action).max() == 1.0


def test_an_action_that_is_no_number_is_refused():
    with np.errstate(invalid="ignore"), pytest.raises(ValueError, match="expected finite actions"):
        evaluate(ID, {"none": NoNumber}, episodes=3, horizon=10)


def test_a_policy_that_cannot_be_traced_runs_in_python_with_a_note():
    with pytest.warns(UserWarning, match="Branching.*test_native_rollout.py, line"):
        run = evaluate(ID, {"mine": Branching}, episodes=3, horizon=10)
    assert set(np.unique(run["action"])) <= {0.0, 1.0}


def test_a_method_that_is_replaced_is_not_taken_for_traceable():
    action = evaluate(ID, {"mine": Counting}, episodes=3, horizon=10)["action"].values
    np.testing.assert_allclose(action[0, 0, :, 0], 0.01 * np.arange(1, 11), rtol=1e-15)


def test_a_function_may_make_another_policy_next_time():
    """It is unknown whether its maker always makes the same."""
    level = 0.1

    class Level(Policy):
        traceable = True
        control = "gain"

        def __init__(self, model, level):
            super().__init__(model)
            self.level = level

        def act(self, observation, state, start):
            return self.level + 0.0 * observation[:, :1], None

    def make(model):
        return Level(model, level)

    make.control = "gain"
    first = evaluate(ID, {"mine": make}, episodes=4, horizon=20)["action"].values
    level = 0.2
    second = evaluate(ID, {"mine": make}, episodes=4, horizon=20)["action"].values
    assert (first == 0.1).all()
    assert (second == 0.2).all()


def test_a_function_may_make_another_estimator_next_time():
    """A function that is compiled as a filter, by its outputs."""
    known = problem_of(ID)
    names = ["kalman-imm", "kalman-imm-turn"]

    def make(task):
        return known.competitor(names[0])(task)

    make.kind = "estimator"
    expected = evaluate(ID, names, episodes=4, horizon=20)["error"]
    for name in list(names):
        found = evaluate(ID, {"mine": make}, episodes=4, horizon=20)["error"]
        np.testing.assert_array_equal(found.sel(policy="mine"), expected.sel(policy=name))
        names.reverse()


def test_a_time_is_that_of_a_decision_without_setting_up(monkeypatch):
    """A clock that advances by 3 ms in every run and by 40 us in every measurement of all episodes, of which the world
    takes 15 us.
    """
    given = model_of("ManeuveringTarget", "imm", "random", horizon=90)
    clock, flown = [0.0], []

    def run(self, report, compiled_policy, measurements):
        idle = compiled_policy is None
        clock[0] += 3e-3 + (15e-6 if idle else 40e-6) * measurements
        if not idle:
            flown.append(measurements)

    monkeypatch.setattr(rollouts.Lanes, "run", run)
    monkeypatch.setattr(rollouts.time, "process_time", lambda: clock[0])
    found = rollouts.measure_time(*given[:3], SEEDS, "imm")
    assert found.compiled
    assert found.nanoseconds == pytest.approx(25e3 / rollouts.COMPILED_EPISODES, rel=1e-9)
    # A run of about ten milliseconds, were setting it up all that a first decision takes; some of them.
    assert set(flown) == {1, 5}
    assert flown.count(5) >= rollouts.TIMED_ROUNDS * rollouts.FEWEST_RUNS


@pytest.mark.parametrize("backend", ["compiled", "numpy"])
def test_an_estimator_that_does_nothing_takes_the_least_time(backend, monkeypatch):
    """Which the time of its run less that of the world cannot fall below."""
    monkeypatch.setattr(times, "LEAST_NANOSECONDS", 1e9)
    model = make_model(problem_of(ID).task, "gain", "random", backend=backend)
    found = rollouts.measure_time(model, rollouts.IdleEstimator, "estimator", SEEDS)
    assert found == (1e9, backend == "compiled", False, 1e9, 1e9)


def test_rounds_are_repeated_while_their_times_differ(monkeypatch):
    """The world takes 100 ns; the competitor 200 ns, or 300 in disturbed rounds."""
    for slow, rounds, low in ((0.0, rollouts.TIMED_ROUNDS, 200.0), (100.0, rollouts.MOST_ROUNDS, 100.0)):
        spent = itertools.cycle([300.0, 300.0 + slow, 300.0 + slow])
        timed = lambda spent=spent: times.ProcessorTime(next(spent), True)  # noqa: E731
        monkeypatch.setattr(rollouts, "_timed_run", lambda *_, timed=timed: timed)
        worlds = []
        monkeypatch.setattr(rollouts, "measure_world", lambda *_, seen=worlds: seen.append(1) or 100.0)
        found = rollouts.measure_time(None, None, "policy", SEEDS)
        assert found == (200.0, True, False, low, 200.0)
        assert len(worlds) == rounds


@pytest.mark.parametrize(
    ("together", "world", "expected"),
    [
        ([300.0, 310.0, 390.0], [100.0, 104.0, 180.0], (200.0, 190.0, 204.0)),
        ([300.0], [100.0], (200.0, 200.0, 200.0)),
        ([100.0, 100.0, 150.0], [101.0, 140.0, 150.0], (1.0, 1.0, 38.0)),
    ],
)
def test_a_net_time_is_as_uncertain_as_its_middle_round(together, world, expected):
    found = times.net_time(together, world, True)
    assert (found.nanoseconds, found.low, found.high) == expected


def test_a_time_is_shorter_only_beyond_the_spread_of_both():
    exact, unsure = times.ProcessorTime(100.0, True), times.ProcessorTime(120.0, True, low=90.0, high=125.0)
    assert times.is_quicker(exact, times.ProcessorTime(120.0, True))
    assert not times.is_quicker(exact, times.ProcessorTime(109.0, True))
    assert not times.is_quicker(exact._replace(low=95.0, high=101.0), unsure)
    assert not times.is_quicker(unsure, exact._replace(nanoseconds=140.0, low=125.0, high=141.0))
    assert times.is_quicker(unsure, exact._replace(nanoseconds=140.0, low=126.0, high=141.0))
    points = [
        times.Point("a", "policy", exact._replace(low=95.0, high=101.0), 1.0),
        times.Point("b", "policy", unsure, 0.5),
    ]
    assert times.front(points) == ["b"]


def test_an_estimate_is_checked_in_the_world_of_estimators_alone(monkeypatch):
    """Policies and references run without that check: its time must not be subtracted from theirs."""
    kinds = []
    run = lambda model, competitor, kind, *_: kinds.append(kind) or (lambda: times.ProcessorTime(1.0, True))  # noqa: E731
    monkeypatch.setattr(rollouts, "_timed_run", run)
    model = make_model(problem_of(ID).task, "gain", "random")
    for kind in ("policy", "reference", "estimator"):
        rollouts.measure_world(model, kind, SEEDS)
    assert kinds == ["reference", "reference", "estimator"]


@pytest.mark.parametrize("name", ["ManeuveringTarget", "LooselyCoupledNavigation"])
def test_numbers_of_a_tile_side_by_side_change_no_bit(name, monkeypatch):
    """Nor do lanes that begin anew, or a copy."""

    def shown(wide, lanes=576):
        monkeypatch.setattr(stepper, "WIDE", wide)
        keywords = {"num_envs": lanes, "threads": 3, "autoreset_mode": "Disabled"}
        env = gym.make_vec(f"filtergym/{name}-v0", **keywords)
        env.action_space.seed(0)
        found = [env.reset(seed=0)[0]]
        for k in range(6):
            found += env.step(env.action_space.sample())[:2]
            if k == 1:
                found.append(env.reset(options={"reset_mask": np.arange(lanes) % 3 == 0})[0])
            if k == 3:
                env = copy.deepcopy(env)
        return found

    for tiled, rows in zip(shown(64), shown(1024), strict=True):
        np.testing.assert_array_equal(tiled, rows)
