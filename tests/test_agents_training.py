"""Training runs: what they refuse, that a resumed one equals one that never stopped, and what they export."""

import dataclasses
import json
import os
import shutil
import signal
from types import SimpleNamespace

import gymnasium
import numpy as np
import pytest

from filtergym import evaluate, tidy_records
from filtergym.baselines.catalogue import baselines_of
from filtergym.baselines.problem import Problem, problem_of
from filtergym.names import competitor
from filtergym.reports.tables import standing
from filtergym.reports.tables.terminal_tables import with_interval

pytest.importorskip("torch")
pytest.importorskip("stable_baselines3")
pytest.importorskip("sb3_contrib")
import torch
from models import make_model
from sb3_contrib import RecurrentPPO

from filtergym.agents import training_run, training_session, validation
from filtergym.agents.adapter import to_sb3
from filtergym.agents.bptt import Descent, NetworkPolicy, train_bptt
from filtergym.agents.export import export_run
from filtergym.agents.learned_policy import PRETRAINED, LearnedPolicy, read_arrays, write_arrays
from filtergym.agents.network_arrays import network_arrays
from filtergym.agents.sb3_policy import Sb3Policy, load_sb3_policy
from filtergym.agents.sb3_training import train_sb3
from filtergym.agents.settings import THROUGH_THE_FILTER
from filtergym.agents.training_run import RunOptions, load_run, new_run, resume_run
from filtergym.agents.training_session import Session, Trainee

ID = "filtergym/ManeuveringTarget-v0"
SMALL = {
    "ppo": {"n_steps": 30, "batch_size": 60, "n_epochs": 2, "policy_kwargs": {"net_arch": [8]}},
    "recurrent-ppo": {
        "n_steps": 30, "batch_size": 60, "n_epochs": 1, "policy_kwargs": {"net_arch": [4], "lstm_hidden_size": 4},
    },
    "sac": {"learning_starts": 60, "buffer_size": 500, "batch_size": 16, "policy_kwargs": {"net_arch": [8]}},
    "dqn": {"learning_starts": 60, "buffer_size": 500, "batch_size": 16, "policy_kwargs": {"net_arch": [8]}},
    "bptt": {"hidden_size": 4, "truncation": 40},
    "bptt-small": {"hidden_size": 4, "fields_kept": 3, "truncation": 40},
    "kalman-net": {"hidden_size": 4, "truncation": 40},
    "student": {"hidden_size": 4, "truncation": 40},
}  # fmt: skip
CONTROL = {"kalman-net": "kalman-net", "student": "student"}


@pytest.fixture(autouse=True)
def few_validation_episodes(monkeypatch):
    monkeypatch.setattr(validation, "VALIDATION_EPISODES", 16)


def small_run(algorithm, steps, envs=4, **keywords):
    control = keywords.pop("control", CONTROL.get(algorithm, "gain"))
    return new_run(
        problem_of(ID), RunOptions(algorithm, control, steps, envs, overrides=SMALL[algorithm], **keywords)
    )


def train(run, folder, **keywords):
    folder.mkdir(exist_ok=True)
    trainer = train_bptt if run.algorithm in THROUGH_THE_FILTER else train_sb3
    return trainer(run, Session(folder, **{"validate_every": 10**9, "trust": True, **keywords}))


def weights(algorithm, folder):
    if algorithm in THROUGH_THE_FILTER:
        return torch.load(folder / "checkpoint" / "checkpoint.pt", weights_only=True)["policy"]
    agent = load_sb3_policy(folder / "checkpoint" / "model.zip", trust=True)
    statistics = agent.normalisation.obs_rms
    return {
        **agent.model.policy.state_dict(),
        "mean": torch.as_tensor(statistics.mean),
        "var": torch.as_tensor(statistics.var),
    }


@pytest.mark.parametrize(
    ("algorithm", "number", "around"),
    [
        ("ppo", signal.SIGTERM, {"residual_to": "adaptive", "gated": True}),
        ("recurrent-ppo", signal.SIGINT, {}),
        ("sac", signal.SIGINT, {}),
        ("bptt-small", signal.SIGINT, {}),
        ("student", signal.SIGTERM, {}),
    ],
)
def test_resumed_run_equals_one_that_never_stopped(algorithm, number, around, tmp_path):
    # Interrupted at about a third, in the middle of an episode; what learns through the filter, of whole ones.
    steps = 1200 if algorithm in THROUGH_THE_FILTER else 480
    before = signal.getsignal(number)
    train(small_run(algorithm, steps, **around), tmp_path / "whole")
    parts = tmp_path / "parts"
    asked = []

    def interrupt(done):
        if done >= 130 and not asked:
            asked.append(done)
            os.kill(os.getpid(), number)

    train(small_run(algorithm, steps, **around), parts, progress=interrupt)
    assert 130 <= load_run(parts).steps_done < 480
    assert signal.getsignal(number) is before
    train(resume_run(parts, small_run(algorithm, steps, **around)), parts, resume=True)
    assert load_run(parts).steps_done == load_run(tmp_path / "whole").steps_done == steps
    assert len(load_run(parts).validation) == 2
    one, other = weights(algorithm, parts), weights(algorithm, tmp_path / "whole")
    assert one.keys() == other.keys()
    for name, tensor in one.items():
        assert torch.equal(tensor, other[name]), name


def test_curves_are_written_at_once_and_what_a_logger_gathers_stays():
    from stable_baselines3.common.logger import KVWriter, Logger

    written = []

    class Kept(KVWriter):
        def write(self, key_values, key_excluded, step=0):
            written.append((dict(key_values), step))

        def close(self):
            pass

    logger = Logger(None, [Kept()])
    logger.record("loss", 1.0)
    training_session.curve_writer(logger)(40, {"cost": 2.0})
    assert written == [({"cost": 2.0, "time/total_timesteps": 40}, 40)]
    assert dict(logger.name_to_value) == {"loss": 1.0}


def contents(folder):
    return {path: path.is_file() and path.read_bytes() for path in folder.rglob("*")}


@pytest.mark.parametrize("algorithm", ["ppo", "bptt"])
def test_resuming_a_finished_run_changes_nothing(algorithm, tmp_path):
    train(small_run(algorithm, 240), tmp_path)
    before = contents(tmp_path)
    for steps in (240, 100):
        run = train(resume_run(tmp_path, small_run(algorithm, steps)), tmp_path, resume=True)
        assert len(run.validation) == 1
        assert contents(tmp_path) == before
    # What computes the steps may be another.
    assert resume_run(tmp_path, small_run(algorithm, 240, backend="numpy")).backend == "numpy"


def test_a_checkpoint_newer_than_the_record_is_the_run(tmp_path):
    train(small_run("bptt", 400), tmp_path)
    # As a crash leaves it: the new checkpoint complete beside its place, the record still to be written.
    (tmp_path / "checkpoint").rename(tmp_path / "checkpoint.partial")
    (tmp_path / "checkpoint.old").mkdir()
    record = (tmp_path / "run.json").read_bytes()
    (tmp_path / "run.json").unlink()
    with pytest.raises(ValueError, match="add --resume"):
        training_run.open_run(tmp_path, small_run("bptt", 400), resume=False)
    run = resume_run(tmp_path, small_run("bptt", 800))
    assert (tmp_path / "run.json").read_bytes() == record
    assert train(run, tmp_path, resume=True).steps_done == 800


@pytest.mark.parametrize("algorithm", ["ppo", "bptt"])
def test_validation_is_that_of_evaluate(algorithm, tmp_path):
    run = train(small_run(algorithm, 240), tmp_path)
    (entry,) = run.validation
    agent = str(tmp_path / "best" / "agent.safetensors")
    costs = evaluate(ID, [agent, "imm"], episodes=16, split="validation")["cost"]
    each = {name: costs.sel(policy=name).values.mean(axis=1) for name in (agent, "imm")}
    for maker, name, control in (
        (competitor(ID, agent), agent, "gain"),
        (competitor(ID, "imm"), "imm", None),
    ):
        found = validation.TrainingEpisodes(run, 16).costs(maker, control)
        np.testing.assert_array_equal(found, each[name])
    means = validation.Bootstrap(16).means
    assert entry["cost"] == means(each[agent])[0]
    assert entry["paper_cost"] == means(each["imm"])[0]
    assert entry["relative_cost_difference"][0] == entry["cost"] / entry["paper_cost"] - 1.0
    if algorithm == "ppo":
        # The model's actions are these arrays' but for rounding in float32.
        model = str(tmp_path / "best" / "model.zip")
        cost = evaluate(ID, [model], episodes=16, split="validation", trust=True)["cost"].mean()
        assert entry["cost"] == pytest.approx(float(cost), rel=1e-5)


def test_a_network_that_arrays_cannot_hold_is_validated_as_a_model(tmp_path):
    run = small_run("recurrent-ppo", 240)
    run.hyperparameters["policy_kwargs"]["n_lstm_layers"] = 2
    (entry,) = train(run, tmp_path).validation
    model = str(tmp_path / "best" / "model.zip")
    costs = evaluate(ID, [model], episodes=16, split="validation", trust=True)["cost"].values[0]
    assert entry["cost"] == validation.Bootstrap(16).means(costs.mean(axis=1))[0]
    with pytest.raises(ValueError, match=r"cannot export LSTM\(.*num_layers=2.*has one layer"):
        export_run(tmp_path, tmp_path / "agent.safetensors", trust=True)


@pytest.mark.parametrize(("algorithm", "control"), [("ppo", "weights"), ("sac", "gain"), ("dqn", "mode")])
def test_exported_agent_acts_like_the_model(algorithm, control, tmp_path):
    train(small_run(algorithm, 240, control=control), tmp_path)
    file = tmp_path / "agent.safetensors"
    if algorithm == "sac":  # of a folder with the model only
        (tmp_path / "best" / "agent.safetensors").unlink()
    export_run(tmp_path, file, trust=True)
    policy = competitor(ID, str(file))(make_model(ID, control))
    model = load_sb3_policy(tmp_path / "best" / "model.zip", trust=True)
    shown = np.random.default_rng(0).normal(0.0, 3.0, (50, *model.observation_space.shape))
    action, expected = policy.predict(shown)[0], model.predict(shown)[0]
    assert action.shape == expected.shape
    # float32 in both, with sums in another order.
    np.testing.assert_allclose(action, expected, atol=3e-6)
    assert load_run(tmp_path).command == read_arrays(file)[1]["run"]["command"]


def test_an_exported_estimator_is_what_was_validated(tmp_path):
    run = train(small_run("kalman-net", 400), tmp_path)
    file = tmp_path / "agent.safetensors"
    exported = export_run(tmp_path, file).exported
    assert exported is not None
    dataset = evaluate(ID, [str(file), str(tmp_path)], episodes=32, split="validation")
    assert dataset["kind"].values.tolist() == ["estimator", "estimator"]
    cost = dataset["cost"].mean(["episode", "time"]).values
    # Means over the same numbers in another order.
    np.testing.assert_allclose(cost, exported["cost"], rtol=1e-14)
    # The validation has half of these episodes.
    half = float(dataset["cost"][0, :16].mean())
    assert run.validation[-1]["cost"] == pytest.approx(half, rel=1e-9)


@pytest.mark.parametrize(("network", "kept"), [("recurrent", None), ("feedforward", 4), ("linear", 1)])
def test_exported_network_acts_like_the_trained_one(network, kept, tmp_path):
    model = make_model(ID, "weights")
    torch.manual_seed(0)
    trained = NetworkPolicy(len(model.fields), model.action_space, 5, network=network, fields_kept=kept)
    trained.head.weight.data.mul_(20.0)
    trained.mean.fill_(0.3)
    trained.scale.fill_(2.0)
    trained.use_fields(trained.fields_kept)
    assert int(trained.used.sum()) == (len(model.fields) if kept is None else kept)
    path = tmp_path / "agent.safetensors"
    run = new_run(problem_of(ID), RunOptions("bptt", "weights"))
    write_arrays(path, trained.arrays(), run, "tanh", "relu", trained.fields(model))
    assert read_arrays(path)[1]["fields"] == [
        field.name for field, used in zip(model.fields, trained.used, strict=True) if used
    ]
    policy = competitor(ID, str(path))(model)
    rng = np.random.default_rng(1)
    hidden, state = trained.new_memory(6), None
    for step in range(12):
        shown = rng.normal(0.0, 4.0, (6, len(model.fields)))
        start = rng.random(6) < 0.3 if step else np.ones(6, dtype=bool)
        action, state = policy.predict(shown, state, start)
        hidden[torch.as_tensor(start)] = 0.0
        with torch.no_grad():
            expected, hidden = trained(torch.as_tensor(shown), hidden)
        # float32 in training; the logistic function is computed from tanh there.
        np.testing.assert_allclose(action, expected.numpy(), atol=3e-6)


def test_fields_of_the_largest_weights_are_kept_and_none_comes_back():
    space = gymnasium.spaces.Box(-1.0, 1.0, (2,), np.float32)
    policy = NetworkPolicy(4, space, 8, network="linear", fields_kept=2)
    with torch.no_grad():
        policy.head.weight.copy_(torch.tensor([[0.1, -3.0, 0.5, 0.0], [0.2, 1.0, -2.0, 0.4]]))
        assert policy.strongest_fields(2).tolist() == [1, 2]
        policy.use_fields(3)
        policy.head.weight[:, 0] = 9.0
        assert policy.used.tolist() == [0.0, 1.0, 1.0, 1.0]
        assert policy.strongest_fields(2).tolist() == [1, 2]
        np.testing.assert_array_equal(policy.arrays()["weight_0"], policy.head.weight[:, [1, 2]])
        shown = torch.randn(3, 4)
        answer = policy(shown, policy.new_memory(3))[0]
        shown[:, 0] += 5.0
        assert (policy(shown, policy.new_memory(3))[0] == answer).all()


def test_a_descent_reads_geometrically_fewer_fields_until_half_of_its_run_is_done():
    space = gymnasium.spaces.Box(-1.0, 1.0, (2,), np.float32)
    policy, group = NetworkPolicy(8, space, 4, network="linear", fields_kept=2), {}
    for done, used in ((0, 8), (25, 4), (50, 2), (100, 2)):
        descent = SimpleNamespace(steps_done=done, run=SimpleNamespace(steps=100), policy=policy)
        descent.optimiser = SimpleNamespace(param_groups=[group])
        descent.learning_rate = lambda left: 0.1 * left
        Descent.follow_schedule(descent)
        assert int(policy.used.sum()) == used
        assert group["lr"] == pytest.approx(0.1 * (1.0 - done / 100.0))


def test_networks_that_there_are_not_are_refused():
    space = gymnasium.spaces.Box(-1.0, 1.0, (2,), np.float32)
    with pytest.raises(ValueError, match="unknown network 'linaer': did you mean 'linear'"):
        NetworkPolicy(4, space, 8, network="linaer")
    with pytest.raises(ValueError, match="fields_kept"):
        NetworkPolicy(4, space, 8, fields_kept=0)


@pytest.mark.parametrize(
    ("algorithm", "control", "message"),
    [
        ("dqn", "gain", "'dqn' does not fit control 'gain'.*choose from ppo, recurrent-ppo, sac"),
        ("sac", "mode", "'sac' does not fit control 'mode'.*choose from ppo, recurrent-ppo, dqn"),
        ("bptt", "mode", "'bptt' needs the gradient of continuous actions, but control 'mode'"),
    ],
)
def test_algorithm_that_does_not_fit(algorithm, control, message, tmp_path):
    with pytest.raises(ValueError, match=message):
        train(small_run(algorithm, 100, control=control), tmp_path)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("algorithm", ["ppo", "bptt"])
def test_checkpoints_that_cannot_be_resumed(algorithm, tmp_path):
    run = small_run(algorithm, 400)
    with pytest.raises(ValueError, match=r"it has no run\.json"):
        resume_run(tmp_path, run)
    train(run, tmp_path)
    with pytest.raises(ValueError, match="contains a run with control 'gain', not 'weights'"):
        resume_run(tmp_path, small_run(algorithm, 400, control="weights"))
    with pytest.raises(ValueError, match="contains a run with seed 0, not 3"):
        resume_run(tmp_path, small_run(algorithm, 400, seed=3))
    later = dataclasses.replace(small_run(algorithm, 400), interface=7)
    with pytest.raises(ValueError, match="contains a run with interface 2, not 7"):
        resume_run(tmp_path, later)
    for file in (tmp_path / "checkpoint").iterdir():
        file.write_bytes(b"\x80garbage" * 20)
    with pytest.raises(ValueError, match=r"cannot read the checkpoint in"):
        train(resume_run(tmp_path, small_run(algorithm, 800)), tmp_path, resume=True)
    (tmp_path / "run.json").write_text("{")
    with pytest.raises(ValueError, match=r"cannot read .*run\.json"):
        resume_run(tmp_path, run)


def test_files_that_are_no_policies(tmp_path):
    for name in ("a.zip", "a.safetensors"):
        with pytest.raises(ValueError, match=r"no (model|learned policy) at"):
            competitor(ID, str(tmp_path / name))
        (tmp_path / name).write_bytes(b"garbage" * 30)
        with pytest.raises(ValueError, match=r"cannot read the model|is not a learned policy"):
            competitor(ID, str(tmp_path / name), trust=True)


def test_exported_recurrent_agent_remembers_like_the_model():
    env = gymnasium.make_vec(ID, 5, autoreset_mode="SameStep", control="mode", horizon=30)
    env = to_sb3(env, staggered=True)  # so that episodes end at different times
    network = {"net_arch": [6], "lstm_hidden_size": 4}
    model = RecurrentPPO("MlpLstmPolicy", env, seed=0, policy_kwargs=network, device="cpu")
    # It starts with actions near zero, which would hide its memory.
    model.policy.action_net.weight.data.mul_(100.0)
    agent = Sb3Policy(model, None, "mode")
    policy = LearnedPolicy(make_model(ID, "mode"), *network_arrays(agent, "recurrent-ppo"))
    shown, start = env.reset(), np.ones(5, dtype=bool)
    memory = state = None
    met = []
    for _ in range(40):
        expected, state = agent.predict(shown, state, start)
        action, memory = policy.predict(shown, memory, start)
        np.testing.assert_array_equal(action, expected)
        met.append(action)
        shown, _, start, _ = env.step(expected)
    assert np.std(met) > 0.1


TRAIN = ("train", ID, "--control", "gain", "--no-compare")


def test_train_resume_export(command, refusal, tmp_path):
    train = (*TRAIN, "--algo", "bptt", "--envs", 2, "--out", tmp_path / "run")
    assert command(*train, "--steps", 200)[0] == 0
    assert "add --resume" in refusal(*train, "--steps", 200)
    assert command(*train, "--steps", 400, "--resume")[0] == 0
    run = load_run(tmp_path / "run")
    assert run.steps_done == 400
    assert run.command.startswith("filtergym train " + ID)
    assert run.versions["torch"] == torch.__version__
    assert run.seconds > 0.0
    assert command("export", tmp_path / "run")[0] == 0
    assert (tmp_path / "run" / "agent.safetensors").is_file()


def test_seeds_are_trained_skipped_and_resumed(command, refusal, tmp_path):
    words = (*TRAIN, "--algo", "bptt", "--envs", 2, "--out", tmp_path / "x")
    assert command(*words, "--seeds", "0,2", "--steps", 200)[0] == 0
    assert command(*words, "--seeds", "2", "--steps", 400)[0] == 0
    before = contents(tmp_path / "x-2")
    code, output, _ = command(*words, "--seeds", "0-2", "--steps", 400)
    assert code == 0
    assert "x-2 is finished: 400 steps" in output
    assert contents(tmp_path / "x-2") == before
    runs = {path.name: load_run(path) for path in tmp_path.iterdir()}
    found = {name: (run.seed, run.steps_done, run.validation[0]["steps"]) for name, run in runs.items()}
    # Validated every twentieth of the run: an update, in one episode of two environments, is more.
    assert found == {"x-0": (0, 400, 200), "x-1": (1, 400, 200), "x-2": (2, 400, 200)}
    for more, message in (
        (("--seeds", "0", "--seed", 3), "--seeds names every seed"),
        (("--seeds", "2-1"), "--seeds needs whole numbers such as 0-4"),
        (("--seeds", "0-3", "--envs", 3), "contains a run with envs 2, not 3"),
    ):
        assert message in refusal(*words, *more)
    assert not (tmp_path / "x-3").exists()


def test_seeds_of_stable_baselines3_are_resumed_with_trust(command, refusal, tmp_path):
    folder = tmp_path / "x-0"
    train(small_run("ppo", 240), folder)
    settings = [f"--set=algo.{name}={json.dumps(value)}" for name, value in SMALL["ppo"].items()]
    words = (*TRAIN, "--envs", 4, *settings, "--out", tmp_path / "x")
    assert "add --trust" in refusal(*words, "--seeds", "0-1", "--steps", 480)
    assert not (tmp_path / "x-1" / "run.json").exists()
    assert command(*words, "--seeds", "0", "--steps", 480, "--trust")[0] == 0
    assert load_run(folder).steps_done == 480


def test_export_refuses_what_is_no_file_for_it(refusal, tmp_path):
    best = tmp_path / "best"
    best.mkdir()
    shipped = PRETRAINED / "ManeuveringTarget-v0" / "bptt"
    shutil.copyfile(shipped.with_suffix(".safetensors"), best / "agent.safetensors")
    shutil.copyfile(shipped.with_suffix(".json"), tmp_path / "run.json")
    (tmp_path / "folder.safetensors").mkdir()
    (tmp_path / "taken.json").mkdir()
    before = contents(tmp_path)
    for out, expected in (
        (".", "must end in .safetensors"),
        (tmp_path / "a.json", "must end in .safetensors"),
        (tmp_path / "folder.safetensors", "a folder or device has that name"),
        (tmp_path / "taken.safetensors", "a folder or device has that name"),
    ):
        assert expected in refusal("export", tmp_path, "--out", out)
        assert contents(tmp_path) == before


def test_the_best_agent_is_kept_and_when_the_paper_was_beaten_is_noted(tmp_path):
    saved, lines, run = [], [], small_run("ppo", 100)
    books = training_session.Bookkeeping(
        run,
        Session(tmp_path, validate_every=10, report=lines.append),
        Trainee(None, lambda _: None, lambda _: saved.append(run.steps_done)),
        lambda: False,
    )
    # The mean alone below the paper's is not enough; what comes later does not matter.
    costs, highs = iter([3.0, 5.0, 2.0, 2.0, 4.0]), iter([0.3, 0.1, -0.1, 0.2, -0.2])
    books.validation.score = lambda _: {
        "steps": run.steps_done, "cost": next(costs), "paper": "imm", "paper_cost": 1.0,
        "relative_cost_difference": [-0.1, -0.3, next(highs)],
    }  # fmt: skip
    for steps in (10, 20, 30, 40, 50):
        assert load_run(tmp_path).beat_paper is None if steps in (20, 30) else True
        books.safe_point(steps)
    assert saved == [10, 30]
    assert run.best["steps"] == 30
    noted = load_run(tmp_path).beat_paper
    assert noted["steps"] == 30
    assert 0.0 < noted["seconds"] <= run.seconds
    beaten = ["better than imm for the first time" in line for line in lines]
    assert beaten == [False, False, True, False, False]
    assert lines[1].endswith("imm 1, difference -10.0 % (-30.0 % to +10.0 %)")


@pytest.mark.parametrize("algorithm", ["ppo", "kalman-net"])
def test_a_run_is_validated_anew_and_can_be_stopped_by_its_progress(algorithm, tmp_path):
    """What is compiled of an agent is kept by what makes it, and the network has learned since."""
    entries = []

    def on_validation(entry):
        entries.append(entry)
        return len(entries) == 2

    run = train(small_run(algorithm, 4000), tmp_path, validate_every=400, on_validation=on_validation)
    assert run.steps_done == load_run(tmp_path).steps_done == entries[1]["steps"] < 1200
    assert not run.is_complete
    assert entries[0]["cost"] != entries[1]["cost"]


def test_the_standing_is_that_of_evaluate(tmp_path, monkeypatch):
    monkeypatch.setattr(standing, "SCREENING_SECONDS", 0.0)
    # A policy, an estimator and a tuned one of each: all of them take long.
    known = baselines_of(ID)
    few = dataclasses.replace(
        known,
        policies={name: known.policies[name] for name in ("imm", "adaptive")},
        estimators={"kalman-imm": known.estimators["kalman-imm"]},
    )
    tuned = ["adaptive-rearm-tuned", "kalman-imm-tuned"]
    monkeypatch.setattr(Problem, "tuned_policies", tuned)
    run = train(small_run("bptt", 400), tmp_path)
    run.problem = dataclasses.replace(problem_of(ID), baselines=few)
    names = [*few.policies, *few.estimators, *tuned, "known-turn"]
    agent = training_run.best_agent(tmp_path)
    found = standing.measure_standing(run, {"mine": agent})
    dataset = evaluate(
        ID, {"mine": str(agent), **{name: name for name in names}}, episodes=16, split="validation"
    )
    costs = {name: dataset["cost"].sel(policy=name).values.mean(axis=1) for name in ["mine", *names]}
    classical = min(set(names) - {"imm", "known-turn"}, key=lambda name: costs[name].mean())
    lines = found["policy"].values.tolist()
    assert lines == ["mine", "imm", classical, "known-turn"]
    assert found["role"].values.tolist() == ["agent", "paper", "strongest classical", "reference"]
    records = {(r.policy, r.metric): r for r in tidy_records(dataset.sel(policy=lines)) if r.window == "all"}
    for line in lines:
        np.testing.assert_array_equal(found["cost"].sel(policy=line), costs[line])
        assert found["anees"].sel(policy=line).values.mean() == pytest.approx(
            records[line, "anees"].value, rel=1e-9
        )
    table = standing.standing_table(found, {"mine": run.beat_paper})
    difference = records["mine", "geometric_cost_difference"]
    cells = {column.header: list(column.cells) for column in table.columns}
    assert cells["cost vs imm, %"][0] == with_interval(difference, 100.0, negligible=0.005)
    means = records["mine", "relative_cost_difference"].value
    assert cells["means,\n%"][0] == f"{100.0 * means:+.1f}"


def test_a_run_begins_at_the_first_action():
    space = gymnasium.spaces.Box(np.array([-1.0, 0.0], np.float32), np.array([1.0, 4.0], np.float32))
    for asked, answered in ((None, [0.0, 2.0]), ([0.5, 1.0], [0.5, 1.0]), ([1.0, 0.0], [0.9, 0.2])):
        torch.manual_seed(0)
        policy = NetworkPolicy(3, space, 8, asked)
        with torch.no_grad():
            policy.head.weight.zero_()
            action, _ = policy(torch.randn(5, 3), torch.zeros(5, 8))
        np.testing.assert_allclose(action, np.tile(answered, (5, 1)), atol=1e-6)
    for wrong in ([0.0], [0.0, 5.0]):
        with pytest.raises(ValueError, match="first_action must be an action of Box"):
            NetworkPolicy(3, space, 8, wrong)
