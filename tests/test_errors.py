"""Bad input gets one clear error that names the value and what was expected."""

import gymnasium as gym
import numpy as np
import pytest
from filtergym.envs.engine.catalogue import catalogue, task_class
from filtergym.envs.interface.environment import TaskEnv
from filtergym.envs.interface.vector_environment import TaskVectorEnv
from filtergym.evaluation.running.seeds import episode_seeds
from models import make_model

import filtergym
from filtergym import evaluate
from filtergym.names import competitor

ID = "filtergym/ManeuveringTarget-v0"


@pytest.mark.parametrize("make", [TaskEnv, TaskVectorEnv, make_model])
class TestNames:
    def test_environment(self, make):
        with pytest.raises(ValueError, match=r"unknown environment .*Manoeuvring.*did you mean '" + ID):
            make("filtergym/ManoeuvringTarget-v0")

    def test_control(self, make):
        with pytest.raises(ValueError, match=r"unknown control 'wieghts': did you mean 'weights'"):
            make(ID, control="wieghts")

    def test_control_of_every_environment(self, make):
        for id, cls in catalogue().items():
            with pytest.raises(ValueError, match=f"unknown control 'zzz'.*{cls.controls[0]}"):
                make(id, control="zzz")

    def test_scenario(self, make):
        with pytest.raises(ValueError, match=r"unknown scenario 'papper': did you mean 'paper'"):
            make(ID, scenario="papper")

    def test_parameter(self, make):
        with pytest.raises(ValueError, match=r"argument 'range_sigmas', .*: did you mean 'range_sigma'"):
            make(ID, range_sigmas=50.0)


def test_short_names_of_environments():
    assert task_class("ManeuveringTarget") is task_class("ManeuveringTarget-v0") is task_class(ID)


@pytest.mark.parametrize("make", [TaskEnv, TaskVectorEnv])
def test_reward(make):
    with pytest.raises(ValueError, match=r"unknown reward 'costs': did you mean 'cost'"):
        make(ID, reward="costs")


def test_names_through_gymnasium():
    with pytest.raises(ValueError, match="did you mean 'paper'"):
        gym.make(ID, scenario="papr")
    with pytest.raises(ValueError, match="did you mean 'gain'"):
        gym.make_vec(ID, num_envs=2, control="gian")


@pytest.mark.parametrize(
    ("keywords", "message"),
    [
        (
            {"transition": ((0.9, 0.2), (0.1, 0.9))},
            r"transition\[0\] must sum to 1, got \(0.9, 0.2\) with sum 1.1",
        ),
        ({"transition": ((0.9, 0.1), (0.2, 0.9))}, r"transition\[1\] must sum to 1"),
        ({"transition": ((1.1, -0.1), (0.1, 0.9))}, r"transition\[0\]\[0\] must be .* at most 1"),
        ({"transition": ((0.9, 0.1),)}, "transition must have 2 rows"),
        ({"transition": ((0.9, 0.1, 0.0), (0.1, 0.9, 0.0))}, r"transition\[0\] must be 2 numbers"),
        ({"transition": 0.9}, "transition must be a sequence of rows, got 0.9"),
        ({"maneuver_steps": (50.5, 55)}, r"maneuver_steps\[0\] must be an integer"),
        ({"polar_measurements": "false"}, "polar_measurements must be True or False, got 'false'"),
        ({"legs": 5, "flight": "legs"}, "legs must be a sequence of rows, got 5"),
        ({"gains": (0.0, 0.7)}, r"gains\[0\] must be .*above 0.*got 0.0"),
        ({"gains": (0.3, 1.0)}, r"gains\[1\] must be .*below 1.*got 1.0"),
        ({"gains": (0.3, float("nan"))}, r"gains\[1\] must be a finite number"),
        ({"gains": (0.3,)}, "at least two filters"),
        ({"gains": "0.3"}, "gains must be a sequence of numbers"),
        ({"gains": (0.2, 0.5, 0.8)}, "transition must have 3 rows"),
        ({"initial_probabilities": (0.5, 0.6)}, "initial_probabilities.*sum to 1"),
        ({"alpha_range": (0.9, 0.1)}, "alpha_range must be in ascending order"),
        ({"alpha_range": (0.0, 0.9)}, r"alpha_range\[0\]"),
        ({"range_sigma": -1.0}, "range_sigma must be .*above 0"),
        ({"range_sigma": "wide"}, "range_sigma must be a finite number.*'wide'"),
        ({"sampling_interval": float("inf")}, "sampling_interval must be a finite number"),
        ({"bearing_sigma": 90.0}, "bearing_sigma must be .*below 90"),
        ({"horizon": 0}, "horizon must be an integer of at least 1, got 0"),
        ({"horizon": 10.5}, "horizon must be an integer"),
        ({"horizon": True}, "horizon must be an integer"),
        ({"decision_interval": 0}, "decision_interval must be an integer of at least 1"),
        ({"decision_interval": 7}, "horizon must be a multiple of decision_interval, got 100 and 7"),
        ({"flight": "loop"}, "flight must be one of 'maneuver', 'random'"),
        ({"flight": "legs"}, "needs at least one leg"),
        ({"flight": "track", "scan_jitter": (0.0, 0.0), "track": ((0.0,),)}, "four rows"),
        ({"flight": "track"}, "has no states between its scans, got scan_jitter"),
        ({"maneuver_steps": (55, 50)}, "maneuver_steps must be in ascending order"),
        ({"speed": (60.0, 300.0, 400.0)}, "speed must be 2 numbers"),
    ],
)
def test_parameter_values(keywords, message):
    with pytest.raises(ValueError, match=message):
        gym.make(ID, **keywords)


BAD_ACTIONS = {
    "gain": [
        [np.nan], [np.inf], [[0.0]], 0.0, [0.0, 0.0], ["up"], None, [],
    ],
    "weights": [[0.5], [np.nan, 0.5], [[0.5, 0.5]], 1],
    "evidence": [[0.5], [0.5, -np.inf], [0.0, 0.0, 0.0]],
    "mode": [2, -1, 0.0, 0.5, [0], np.nan, "0"],
}  # fmt: skip


@pytest.mark.parametrize(
    ("control", "action"), [(control, action) for control, many in BAD_ACTIONS.items() for action in many]
)
def test_bad_actions_say_what_arrived_and_change_nothing(control, action):
    env, reference = (gym.make(ID, control=control, disable_env_checker=True).unwrapped for _ in range(2))
    env.reset(seed=0), reference.reset(seed=0)
    with pytest.raises(ValueError, match=r"expected (finite|integer) actions .*shape .*got"):
        env.step(action)
    good = np.int64(1) if control == "mode" else np.full(env.action_space.shape, 0.5)
    np.testing.assert_array_equal(env.step(good)[0], reference.step(good)[0])


@pytest.mark.parametrize("shape", [(2,), (3, 1), (2, 2), (1, 2)])
def test_bad_vector_actions(shape):
    env = gym.make_vec(ID, num_envs=2, control="gain")
    env.reset(seed=0)
    with pytest.raises(ValueError, match=r"shape \(2, 1\), got float64 of shape"):
        env.step(np.zeros(shape))


def test_one_bad_action_among_many():
    env = gym.make_vec(ID, num_envs=3, control="weights")
    env.reset(seed=0)
    actions = np.full((3, 2), 0.5)
    actions[1, 0] = np.nan
    with pytest.raises(ValueError, match="finite"):
        env.step(actions)
    env = gym.make_vec(ID, num_envs=3, control="mode")
    env.reset(seed=0)
    with pytest.raises(ValueError, match="from 0 to 1"):
        env.step(np.array([0, 1, 2]))


def test_actions_that_cancel_are_not_taken_for_finite_ones():
    env = gym.make_vec(ID, num_envs=2, control="gain")
    env.reset(seed=0)
    with pytest.raises(ValueError, match="finite"):
        env.step(np.array([[np.inf], [-np.inf]]))


def test_large_finite_actions_are_taken_at_the_edge():
    env, edge = (gym.make_vec(ID, num_envs=2, control="gain") for _ in range(2))
    env.reset(seed=0), edge.reset(seed=0)
    large = np.full((2, 1), 3e38, dtype=np.float32)
    np.testing.assert_array_equal(env.step(large)[0], edge.step(np.ones((2, 1), dtype=np.float32))[0])


def test_steps_before_a_reset():
    with pytest.raises(gym.error.ResetNeeded):
        TaskEnv(ID).step([0.0])


class TestPolicies:
    def test_unknown(self):
        with pytest.raises(ValueError, match=r"unknown policy 'adaptve': did you mean 'adaptive'"):
            evaluate(ID, ["adaptve"], episodes=1)

    def test_a_file_without_its_ending(self, tmp_path, monkeypatch):
        monkeypatch.chdir(tmp_path)
        (tmp_path / "mine.zip").touch()
        with pytest.raises(ValueError, match=r"unknown policy 'mine': a file is named whole, mine\.zip"):
            evaluate(ID, ["mine"], episodes=1)

    @pytest.mark.parametrize(
        ("policy", "control"), [("imm", "gain"), ("adaptive", "weights"), ("zero", "mode")]
    )
    def test_that_do_not_fit_the_control(self, policy, control):
        with pytest.raises(ValueError, match=f"policy '{policy}' is made for control .*, not '{control}'"):
            evaluate(ID, [policy], episodes=1, control=control)

    def test_not_importable(self):
        with pytest.raises(ValueError, match="cannot load policy 'nowhere:Policy'"):
            competitor(ID, "nowhere:Policy")
        with pytest.raises(ValueError, match="cannot load policy 'math:Policy'"):
            competitor(ID, "math:Policy")

    def test_none(self):
        with pytest.raises(ValueError, match="at least one policy"):
            evaluate(ID, [], episodes=1)

    def test_bad_action_of_a_users_policy(self):
        class Wrong:
            control = "gain"

            def __init__(self, task):
                pass

            def predict(self, observation, state=None, episode_start=None, deterministic=True):
                return np.full((len(observation), 1), np.nan), state

        with pytest.raises(ValueError, match="finite"):
            evaluate(ID, {"wrong": Wrong}, episodes=2)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"scenario": "papper"}, "did you mean 'paper'"),
        ({"episodes": 0}, "episodes must be an integer of at least 1"),
        ({"seed": -1}, "seed must be an integer of at least 0"),
        ({"split": "tset"}, "did you mean 'test'"),
        ({"control": "wieghts"}, "did you mean 'weights'"),
        ({"gains": (0.3, 1.5)}, "gains"),
        ({"gain": (0.3, 0.5)}, "did you mean 'gains'"),
        ({"episodes": 1.5}, "episodes must be an integer of at least 1, got 1.5"),
        ({"episodes": True}, "episodes must be an integer of at least 1, got True"),
        ({"seed": 1.5}, "seed must be an integer of at least 0, got 1.5"),
        ({"split": ["test"]}, "unknown split"),
        ({"drawn_episodes": -1}, "drawn_episodes must be an integer of at least 0, got -1"),
        ({"workers": 2}, r"workers must be .*Workers\(2\), got 2"),
        (
            {"sampling_interval": 1e300},
            "sampling_interval must be a finite number .* at most 86400.0, got 1e",
        ),
    ],
)
def test_evaluation_arguments(arguments, message):
    with pytest.raises(ValueError, match=message):
        evaluate(ID, ["random"], **{"episodes": 1, **arguments})


def test_further_arguments_of_another_type():
    with pytest.raises(ValueError, match="competitors are a name, a sequence of names, or a mapping"):
        evaluate(ID, 3)
    with pytest.raises(ValueError, match=r"speeds must be 2 numbers, got 1\.5"):
        filtergym.read_flights("nowhere.csv", speeds=1.5)
    with pytest.raises(
        ValueError, match="horizon must be an integer of at least 1, got a whole number of 400 digits"
    ):
        gym.make(ID, horizon=10**400)


class Answering:
    """An estimator that answers with one mean."""

    def __init__(self, answer):
        self.answer = answer

    def start(self, initial, N):
        return initial

    def update(self, measurement, memory):
        return self.answer(memory.mean), memory.covariance, memory


@pytest.mark.parametrize(
    ("answer", "message"),
    [
        (lambda mean: mean + 0j, "no array: expected an array of real numbers, got complex128"),
        (lambda mean: np.ma.masked_array(mean, mean > 0.0), "real numbers, got a masked array of float64"),
        (lambda mean: mean.astype(str), "expected an array of real numbers, got <U"),
        (lambda mean: None, "expected an array of real numbers, got object"),
    ],
)
def test_means_that_are_no_numbers(answer, message):
    with pytest.raises(ValueError, match=message):
        evaluate(ID, {"own": Answering(answer)}, episodes=1)


@pytest.mark.parametrize("path", [None, 3, [None], {}])
def test_a_recording_that_is_no_path(path):
    with pytest.raises(ValueError, match="files are named by a path or a pattern"):
        filtergym.read_recording(path)


def test_splits_and_seeds_share_no_episode():
    drawn = [
        s for split in ("train", "validation", "test") for n in (0, 1) for s in episode_seeds(split, n, 500)
    ]
    assert len(set(drawn)) == 3000
    assert episode_seeds("test", 0, 5, first=3) == episode_seeds("test", 0, 8)[3:]


@pytest.mark.parametrize(
    "odd",
    [
        {"progress": [1.0]},
        {"control": np.eye(2)},
        {"scenario": np.eye(2)},
        {"competitors": np.eye(2)},
        {"competitors": "é" * 500},
        {"competitors": {"imm": np.eye(2)}},
        {"backend": np.eye(2)},
        {"range_sigma": 10**400},
        {"range_sigma": 1e308},
        {"env": np.eye(2)},
    ],
    ids=lambda odd: " ".join(f"{name} {type(value).__name__}" for name, value in odd.items()),
)
def test_odd_arguments_of_an_evaluation_get_one_sentence(odd):
    given = {"env": ID, "competitors": "imm", "episodes": 1, "horizon": 4, **odd}
    with pytest.raises(ValueError, match=r".{20}") as error:
        evaluate(**given)
    assert "\n" not in str(error.value)
    assert len(str(error.value)) < 1000
    assert "ambiguous" not in str(error.value)  # NumPy's
