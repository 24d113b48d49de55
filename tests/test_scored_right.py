"""A policy is scored as what it is: models with their normalisation, runs by their folder, loops like evaluations."""

import re
import shutil
import warnings
from pathlib import Path

import gymnasium
import numpy as np
import pytest

from filtergym import evaluate, make_policy
from filtergym.agents.learned_policy import PRETRAINED
from filtergym.names import competitor

DOCS = Path(__file__).parent.parent / "docs"
ID = "filtergym/ManeuveringTarget-v0"
SHORT = {"horizon": 24}
AGENTS = PRETRAINED / "ManeuveringTarget-v0"


def costs(*names, **keywords):
    """Mean cost of every policy, over few short episodes."""
    dataset = evaluate(ID, *names, episodes=5, **{**SHORT, **keywords})
    return dataset["cost"].mean(["episode", "time"]).values


@pytest.fixture(scope="module")
def sb3():
    """Stable-Baselines3 with sb3-contrib, and tiny models."""
    pytest.importorskip("sb3_contrib")
    import sb3_contrib
    import stable_baselines3
    import torch
    from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

    torch.set_num_threads(1)

    class Tiny:
        def env(self, control="gain", wrapper=lambda env: env, dtype="float64", **normalisation):
            """One environment, under VecNormalize if there are keywords of it."""
            env = DummyVecEnv([lambda: wrapper(gymnasium.make(ID, control=control, dtype=dtype, **SHORT))])
            return VecNormalize(env, **normalisation) if normalisation else env

        def model(self, name, control="gain", policy="MlpPolicy", learn=0, env=None, **keywords):
            cls = getattr(stable_baselines3, name, None) or getattr(sb3_contrib, name)
            model = cls(policy, env or self.env(control), seed=0, device="cpu", **keywords)
            if learn:
                model.learn(learn)
            return model

        def normalised(self, name="PPO", **keywords):
            """A model that acts quite differently on raw observations."""
            settings = (
                {"n_steps": 16, "batch_size": 16, "n_epochs": 1} if name == "PPO" else {"learning_starts": 8}
            )
            env = keywords.pop("env", None) or self.env(norm_obs=True)
            model = self.model(name, env=env, learn=16, **settings, **keywords)
            if name == "PPO":
                model.policy.action_net.weight.data.mul_(300.0)
            return model

    return Tiny()


def save(model, folder, name="model.zip", statistics="vecnormalize.pkl"):
    folder.mkdir(parents=True, exist_ok=True)
    model.save(folder / name)
    if statistics:
        (folder / statistics).parent.mkdir(parents=True, exist_ok=True)
        model.get_vec_normalize_env().save(str(folder / statistics))
    return str(folder / name)


class TestNormalisation:
    def test_it_is_found_beside_the_model(self, sb3, tmp_path):
        model = sb3.normalised()
        own = costs({"model": model})
        env = "filtergym-ManeuveringTarget-v0"
        files = [
            save(model, tmp_path / "beside"),
            save(model, tmp_path / f"{env}_1", f"{env}.zip", f"{env}/vecnormalize.pkl"),
            save(model, tmp_path / f"{env}_2", "best_model.zip", f"{env}/vecnormalize.pkl"),
            save(model, tmp_path / "moved", "best_model.zip", f"{env}/vecnormalize.pkl"),
            save(model, tmp_path / "steps", "rl_16_steps.zip", "rl_vecnormalize_16_steps.pkl"),
        ]
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            found = costs(files, trust=True)
        np.testing.assert_array_equal(found, np.full(len(files), own))
        alone = save(model, tmp_path / "alone", statistics=None)
        with pytest.warns(
            UserWarning, match=rf"model {alone} .*was trained under VecNormalize.*vecnormalize\.pkl"
        ):
            raw = costs([alone], trust=True)
        assert raw != own

    def test_a_model_brings_that_of_its_environment(self, sb3, tmp_path):
        from filtergym.agents import Sb3Policy

        model = sb3.normalised()
        statistics = model.get_vec_normalize_env()
        loaded = type(model).load(save(model, tmp_path, statistics=None))
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            own, wrapped, given = costs(
                {"model": model, "wrapped": Sb3Policy(model), "given": Sb3Policy(loaded, statistics)}
            )
        assert own == wrapped == given
        # By hand: what normalises and what acts.
        shown = gymnasium.make(ID, control="gain").reset(seed=0)[0]
        scale = np.sqrt(statistics.obs_rms.var + statistics.epsilon)
        normalised = np.clip((shown - statistics.obs_rms.mean) / scale, -10, 10)
        expected = model.predict(normalised, deterministic=True)
        np.testing.assert_allclose(Sb3Policy(model).predict(shown)[0], expected[0], rtol=1e-4)
        with pytest.warns(UserWarning, match="this model of PPO was trained under VecNormalize"):
            raw = costs({"model": loaded})
        assert raw != own

    @pytest.mark.parametrize("name", ["PPO", "SAC"])
    @pytest.mark.parametrize("dtype", ["float64", "float32"])
    @pytest.mark.parametrize("normalisation", [{}, {"norm_obs": True}, {"norm_obs": False}])
    def test_the_sign_of_it(self, sb3, name, dtype, normalisation, tmp_path):
        from filtergym.agents.sb3_policy import was_trained_normalised

        model = sb3.normalised(name, env=sb3.env(dtype=dtype, **normalisation))
        sign = was_trained_normalised(type(model).load(save(model, tmp_path, statistics=None)))
        exact = normalisation.get("norm_obs", False)
        if dtype == "float64":
            assert sign == exact
        elif name == "PPO":
            assert sign == bool(normalisation)  # cannot tell rewards from observations
        else:
            assert not sign  # cannot tell at all

    def test_statistics_of_another_model(self, sb3, tmp_path):
        file = save(sb3.normalised(), tmp_path)
        sb3.env("weights", norm_obs=True).save(str(tmp_path / "vecnormalize.pkl"))
        with pytest.raises(ValueError, match="they are another model's"):
            competitor(ID, file, trust=True)


ALGORITHMS = [
    ("PPO", "gain", {"n_steps": 16, "batch_size": 16, "n_epochs": 1}),
    ("RecurrentPPO", "mode", {"policy": "MlpLstmPolicy", "n_steps": 16, "batch_size": 16, "n_epochs": 1}),
    ("SAC", "gain", {"learning_starts": 8}),
    ("DDPG", "gain", {"learning_starts": 8}),
    ("ARS", "mode", {"policy": "LinearPolicy", "n_delta": 1}),
    ("DQN", "mode", {"learning_starts": 8}),
]
"""One of each form: on and off its policy, recurrent, linear, with discrete actions, saved under another name."""


@pytest.mark.parametrize(
    ("name", "control", "keywords"),
    ALGORITHMS,
    ids=lambda part: str(part)[:12],
)
def test_every_algorithms_zip_is_loaded(sb3, name, control, keywords, tmp_path):
    model = sb3.model(name, control, learn=16, **keywords)
    file = save(model, tmp_path, statistics=None)
    loaded = competitor(ID, file, trust=True)
    assert type(loaded.model) is type(model) or (name, type(loaded.model).__name__) == ("DDPG", "TD3")
    dataset = evaluate(ID, {"zip": file, "model": model}, episodes=3, trust=True, **SHORT)
    assert set(dataset["control"].values) == {control}
    np.testing.assert_array_equal(dataset["error"][0], dataset["error"][1])


def test_an_unknown_algorithm_is_named(sb3, tmp_path):
    from sb3_contrib.common.wrappers import ActionMasker

    env = sb3.env("mode", lambda env: ActionMasker(env, lambda _: np.ones(env.action_space.n, dtype=bool)))
    file = save(sb3.model("MaskablePPO", env=env), tmp_path, statistics=None)
    with pytest.raises(
        ValueError, match=r"its policy, MaskableActorCriticPolicy, belongs to none of .* TQC, CrossQ, DQN"
    ):
        competitor(ID, file, trust=True)


def run_folder(folder, agent="bptt", arrays=True):
    """The folder of a run whose best agent is a shipped one."""
    (folder / "best").mkdir(parents=True)
    shutil.copyfile(AGENTS / f"{agent}.json", folder / "run.json")
    if arrays:
        shutil.copyfile(AGENTS / f"{agent}.safetensors", folder / "best" / "agent.safetensors")
    return folder


class TestRunFolder:
    def test_it_means_the_best_agent(self, tmp_path, command):
        folder = run_folder(tmp_path / "runs" / "mine-tuned")
        own, shipped = costs({"run": str(folder), "shipped": "bptt"})
        assert own == shipped
        words = ("--policy", folder, "--episodes", 2, "--set", "horizon=8")
        code, output, errors = command("evaluate", ID, *words)
        assert (code, errors) == (0, "")
        assert "tuned" in output  # a long name goes on below, from its hyphen on
        assert "Costs are compared with that of imm-steady-state where it takes part" in " ".join(
            output.split()
        )

    def test_where_there_are_no_arrays_it_is_the_model(self, sb3, tmp_path):
        folder = run_folder(tmp_path / "run", "ppo", arrays=False)
        model = sb3.normalised()
        save(model, folder / "best")
        with pytest.raises(ValueError, match="trust=True"):
            competitor(ID, str(folder))
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            own, run = costs({"model": model, "run": str(folder)}, trust=True)
        assert own == run
        with pytest.raises(
            ValueError, match=r"contains a run of filtergym/ManeuveringTarget-v0, not of .*UavAutopilot"
        ):
            competitor("filtergym/UavAutopilot-v0", str(folder), trust=True)

    def test_a_name_is_no_folder(self, tmp_path, monkeypatch):
        monkeypatch.chdir(tmp_path)
        for name in ("imm", "imm-tuned", "ppo"):
            (tmp_path / name).mkdir()
            competitor(ID, name)
            with pytest.raises(ValueError, match=rf"no training run in {name}: it has no run\.json"):
                competitor(ID, f"./{name}")


class Sluggish:
    """A user's policy that only takes batches, and whose memory hangs on ``episode_start`` alone."""

    control = "gain"

    def __init__(self, task):
        self.innovation = task.columns(["innovation_x"])[0]

    def predict(self, observation, state=None, episode_start=None, deterministic=True):
        assert observation.ndim == 2
        state = np.zeros(len(observation)) if state is None else state
        state = 0.9 * np.where(episode_start, 3.0, state) + 0.1 * observation[:, self.innovation]
        return np.tanh(state)[:, None], state


def looped(policy, seeds, begin=True, **keywords):
    env = gymnasium.make(ID, detailed_info=True, **{**policy.keywords, **keywords})
    found = []
    for seed in seeds:
        observation, _ = env.reset(seed=seed)
        state, finished = policy.begin([seed]) if begin else None, False
        while not finished:
            action, state = policy.predict(observation, state)
            observation, _, _, finished, info = env.step(action)
            found.append(info["cost"])
    return found


class TestMadePolicy:
    @pytest.mark.parametrize(
        "name",
        ["imm", "adaptive", "random", "adaptive-rearm-tuned", "ppo"],
    )
    def test_a_loop_has_the_cost_of_an_evaluation(self, name):
        dataset = evaluate(ID, [name], episodes=3, **SHORT)
        seeds = [int(seed) for seed in dataset["episode_seed"]]
        policy = make_policy(ID, name, **SHORT)
        expected = dataset["cost"].values.ravel()
        np.testing.assert_array_equal(looped(policy, seeds), expected)
        if name != "random":
            np.testing.assert_array_equal(looped(policy, seeds, begin=False), expected)
        else:  # its numbers are those of the episodes
            assert (looped(policy, seeds, begin=False) != expected).any()

    @pytest.mark.parametrize("control", ["gain", "mode"])
    def test_of_a_recurrent_model(self, sb3, control, tmp_path):
        model = sb3.model("RecurrentPPO", control, "MlpLstmPolicy", policy_kwargs={"lstm_hidden_size": 4})
        model.policy.action_net.weight.data.mul_(300.0)
        file = save(model, tmp_path, statistics=None)
        dataset = evaluate(ID, [file], episodes=2, trust=True, **SHORT)
        policy = make_policy(ID, file, trust=True, **SHORT)
        found = looped(policy, [int(seed) for seed in dataset["episode_seed"]])
        np.testing.assert_array_equal(found, dataset["cost"].values.ravel())

        with pytest.raises(ValueError, match="the state is not one of 130 episodes"):
            policy.predict(np.zeros((130, len(policy.model.fields))), policy.begin([0]))

    def test_of_a_run_and_of_an_object(self, tmp_path):
        for policy in (str(run_folder(tmp_path / "run")), Sluggish):
            dataset = evaluate(ID, {"mine": policy}, episodes=2, **SHORT)
            made = make_policy(ID, policy, **SHORT)
            found = looped(made, [int(seed) for seed in dataset["episode_seed"]])
            np.testing.assert_array_equal(found, dataset["cost"].values.ravel())

    @pytest.mark.parametrize("name", ["adaptive", "bptt"])
    def test_batches_and_episodes_that_begin_at_different_times(self, name):
        keywords = {"autoreset_mode": "SameStep", "detailed_info": True, **SHORT}
        env = gymnasium.make_vec(ID, num_envs=11, control=competitor(ID, name).control, **keywords)
        policy = make_policy(env, name)
        observation, _ = env.reset(seed=0, options={"shortened_by": np.arange(11)})
        state, start, actions = None, np.ones(11, dtype=bool), []
        inner, memory = competitor(ID, name)(env.unwrapped.model), None
        alone = [make_policy(env, name) for _ in range(11)]
        states = [None] * 11
        for _ in range(40):
            action, state = policy.predict(observation, state, start)
            expected, memory = inner.predict(observation, memory, start)
            # A batch of another size: matrix products may round otherwise.
            np.testing.assert_allclose(action, expected, rtol=1e-6, atol=1e-6)
            for i, one in enumerate(alone):
                single, states[i] = one.predict(observation[i], states[i], start[i])
                np.testing.assert_array_equal(single, action[i])
            actions.append(action)
            observation, _, _, start, _ = env.step(action)
        assert np.std(actions) > 0.01

    def test_an_environment_lists_its_options(self):
        env = gymnasium.make(ID, control="weights")
        assert make_policy(env, "imm").keywords == {"control": "weights"}
        with pytest.raises(ValueError, match="'adaptive' is made for control 'gain', not 'weights'"):
            make_policy(env, "adaptive")
        with pytest.raises(
            ValueError, match="'known-turn' does not act: of kind reference, it can be evaluated only"
        ):
            make_policy(env, "known-turn")
        with pytest.raises(ValueError, match=r"the environment's own: leave them out"):
            make_policy(env, "imm", control="weights")
        with pytest.raises(
            ValueError, match=r"one of filtergym made by gymnasium.make or make_vec, got CartPole"
        ):
            make_policy(gymnasium.make("CartPole-v1"), "imm")
        with pytest.raises(ValueError, match="unknown policy 'imn': did you mean 'imm'"):
            make_policy(ID, "imn")

    def test_competitors_tuned_beside_the_policy_are_listed(self):
        id = "filtergym/TightlyCoupledNavigation-v0"
        policy = make_policy(id, "sticky", "mode" if competitor(id, "sticky").control == "mode" else None)
        env = gymnasium.make(id, **policy.keywords)
        assert make_policy(env, "sticky").keywords == policy.keywords
        with pytest.raises(ValueError, match=r"'sticky' acts in an environment with transition="):
            make_policy(gymnasium.make(id, control=policy.control), "sticky")


def test_the_snippet_of_the_page_runs(capsys):
    text = (DOCS / "evaluation.md").read_text(encoding="utf-8")
    [snippet] = [s for s in re.findall(r"```python\n(.*?)```", text, re.S) if "make_policy" in s]
    exec(compile(snippet, "evaluation.md", "exec"), {"__name__": "snippet"})
    assert float(capsys.readouterr().out.split()[-1]) > 0.0
