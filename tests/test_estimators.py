"""An estimator that a user brings: the same noise, the same start, and a sentence for whatever goes wrong."""

import json
import re
import sys
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from models import KINDS, make_model

import filtergym
from filtergym.__main__ import main
from filtergym.baselines.catalogue import baselines_of
from filtergym.baselines.problem import problem_of
from filtergym.evaluation.competitors.kinds import make_competitor
from filtergym.evaluation.storage.dataset import notes_of
from filtergym.reports.tables.results import read_results

ID = "filtergym/ManeuveringTarget-v0"
EXAMPLES = Path(__file__).parent.parent / "docs" / "examples"


class Start:
    """Reports the start for ever; where it is exact, with a variance of one."""

    def start(self, initial, N):
        assert N % 8 == 0
        identity = np.eye(len(initial.mean))[:, :, None]
        return initial.mean, initial.covariance + identity

    def update(self, memory, measurement):
        return *memory, memory


class Recording(Start):
    """Keeps its inputs and its estimates."""

    def __init__(self, task):
        self.task, self.estimates = task, []

    def estimate(self, measurement, memory):
        return memory[0]

    def update(self, memory, measurement):
        mean = self.estimate(measurement, memory)
        self.estimates.append((measurement, mean))
        return mean, memory[1], memory


class Raw(Recording):
    """UavAutopilot on raw readings, held during dropouts; zero for what no sensor reads."""

    def estimate(self, measurement, memory):
        mean, measured = np.zeros_like(memory[0]), list(self.task.measured)
        held = self.estimates[-1][1][measured] if self.estimates else 0.0
        mean[measured] = np.where(measurement.available > 0, measurement.reading, held)
        return mean


@pytest.fixture
def command(command, monkeypatch, tmp_path):
    """Run the command line in a folder of one's own; returns exit code, output and errors."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [place for place in sys.path if place not in ("", str(tmp_path))])
    return command


@pytest.mark.parametrize("env_id", KINDS)
def test_a_plain_estimator_works_everywhere(env_id, short):
    paper = baselines_of(env_id).score_paper
    counts = []
    result = filtergym.evaluate(
        env_id, {"class": Start, "object": Start(), paper: paper}, episodes=3, progress=counts.append, **short
    )
    assert result.kind.values.tolist() == ["estimator", "estimator", "policy"]
    assert np.isfinite(result.error.values).all()
    assert np.isfinite(result.cost.values).all()
    assert np.isfinite(result.nees.values).all()
    np.testing.assert_array_equal(result.error.values[0], result.error.values[1])
    assert sum(counts) == 3 * 3 * short["horizon"]
    measured = {r.metric for r in filtergym.tidy_records(result) if r.policy == "class"}
    assert {"cost", "anees", "relative_cost_difference"} <= measured


def test_in_a_closed_loop_an_estimate_flies_its_own_truth_on_the_same_noise():
    env, episodes = "filtergym/UavAutopilot-v0", 8
    model = make_model(env)
    competitors = {"start": Recording(model.task), "raw": Raw(model.task)}
    result = filtergym.evaluate(env, competitors, episodes=episodes, horizon=100)
    measured, noise, truths = list(model.task.measured), [], []
    for name, recording in competitors.items():
        measurements, means = zip(*recording.estimates, strict=True)
        errors = result.error.sel(policy=name).transpose("time", "component", "episode").values
        truth = np.stack(means) - errors
        there = np.stack([m.available for m in measurements])
        readings = np.stack([m.reading for m in measurements])
        noise.append(np.where(there > 0, readings - truth[:, measured], 0.0))
        truths.append(truth)
        # What it estimates is flown: the control that follows is in force until the next measurement.
        commanded = [model.task.autopilot(mean, m.command) for m, mean in recording.estimates]
        np.testing.assert_array_equal([m.control for m, _ in recording.estimates[1:]], commanded[:-1])
    assert abs(truths[0] - truths[1]).max() > 1.0
    # Rounding of truths of some hundred degrees.
    np.testing.assert_allclose(noise[0], noise[1], rtol=0, atol=1e-11)


def wrong_at(step, lane, change):
    """An estimator whose answer is wrong once."""

    class Wrong(Start):
        def start(self, initial, N):
            return (*super().start(initial, N), 0)

        def update(self, memory, measurement):
            mean, covariance, k = memory
            k += 1
            estimate = mean.copy(), covariance.copy()
            if k == step:
                estimate = change(*estimate, lane) or estimate
            return *estimate, (mean, covariance, k)

    return Wrong


def set_mean(mean, covariance, lane):
    mean[1, lane] = np.nan


def make_semidefinite(mean, covariance, lane):
    covariance[:, :, lane] = 0.0


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (set_mean, "the mean is not finite in episode {} at measurement 3"),
        (make_semidefinite, "the covariance is not positive definite in episode {} at measurement 3"),
        (lambda m, P, _: (m[:3], P), r"the mean at measurement 3 must have shape \(4, 16\), 4 components"),
        (lambda m, P, _: (m, P[0]), r"the covariance at measurement 3 must have shape \(4, 4, 16\)"),
        (lambda m, P, _: ("north", P), "the mean at measurement 3 is no array"),
    ],
)
def test_a_wrong_answer_is_named_with_episode_and_measurement(change, message):
    wrong = wrong_at(3, 9, change)
    with pytest.raises(ValueError, match=f"estimator 'mine': {message.format(9)}"):
        filtergym.evaluate(ID, {"mine": wrong}, episodes=12, horizon=5, strict=True)


@pytest.mark.parametrize("env_id", KINDS[1:])
@pytest.mark.parametrize("step", [1, 3])
def test_a_lost_episode_keeps_its_last_valid_answer_to_the_end(env_id, short, step):
    """As of an estimator that gives the same answer again and again by itself, also in a closed loop."""

    class Holding(Start):
        lost = range(0)

        def start(self, initial, N):
            return (*super().start(initial, N), 0)

        def update(self, memory, measurement):
            mean, covariance, k = memory
            drift = np.full(mean.shape[-1], k + 1.0)
            drift[9:] = min(k + 1, step - 1)
            answer = mean + drift
            if k + 1 in self.lost:
                answer[0, 9:] = np.nan
            return answer, covariance, (mean, covariance, k + 1)

    class Losing(Holding):
        lost = (step,)

    dataset = filtergym.evaluate(env_id, {"losing": Losing, "holding": Holding}, episodes=12, **short)
    losing, holding = (dataset.sel(policy=name) for name in ("losing", "holding"))
    expected = np.zeros((12, losing.sizes["time"]))
    expected[9:, step - 1 :] = 1.0
    np.testing.assert_array_equal(losing["lost"] > 0.0, expected)
    assert not holding["lost"].any()
    for name in ("error", "cost"):
        np.testing.assert_array_equal(losing[name], holding[name])
        assert np.isfinite(losing[name]).all()
    (note,) = notes_of(dataset)
    assert note.startswith("losing: 3 of 12 episodes lost: the ")
    assert note.endswith(
        f" in episode 9 at measurement {step}; the last valid estimate is repeated from there on"
    )


LOSING = """import numpy

class Losing:
    def __init__(self, task):
        self.episodes = 0

    def start(self, initial, N):
        return initial.mean, initial.covariance

    def update(self, memory, measurement):
        mean, covariance = memory[0].copy(), memory[1].copy()
        covariance[0, 1, 3] = numpy.inf
        return mean, covariance, memory
"""


def test_lost_episodes_stand_in_table_records_and_results(
    command, success, without_figures, monkeypatch, tmp_path
):
    """Two of twenty, in two pieces of work; what others have finished is not lost."""
    monkeypatch.delitem(sys.modules, "losing", raising=False)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("filtergym.evaluation.statistics.bootstrap.BLOCK", 8)
    Path("losing.py").write_text(LOSING)
    words = [
        "evaluate",
        ID,
        "--episodes",
        14,
        "--set",
        "horizon=4",
        "--set",
        "detection_probability=(1.0, 1.0)",
    ]
    words += ["--policy", "losing:Losing", "--policy", "imm", "--json", "records.json"]
    code, output, errors = command(*words, "--strict")
    assert (code, errors.count("\n")) == (2, 1)
    assert "losing:Losing': the covariance is not finite in episode 3 at measurement 1" in errors
    message = (
        "losing:Losing: 2 of 14 episodes lost: the covariance is not finite in episode 3 at measurement 1"
    )
    # Every number kept, and summaries alone, in pieces: the same message.
    for further in (("--out", "out"), ("--out", "small", "--no-netcdf")):
        monkeypatch.setattr("filtergym.evaluation.running.summary.TOGETHER", 8)
        output = success(*words, *further)
        assert message in " ".join(output.split())
        [record] = [
            record for record in json.loads(Path("records.json").read_text())
            if record["metric"] == "lost_episodes"
        ]  # fmt: skip
        assert (record["policy"], round(14 * record["value"])) == ("losing:Losing", 2)
        [result], _ = read_results(Path(further[1]))
        assert [note for note in result.notes if note.startswith(message)]


RAISING = """class AtUpdate:
    def start(self, initial, N):
        return initial
    def update(self, memory, measurement):
        return self.gain(measurement)
    def gain(self, measurement):
        return measurement.doppler


class AtStart(AtUpdate):
    def start(self, initial, N):
        return {}["lost"]


class AtBirth(AtUpdate):
    def __init__(self, task):
        1 / 0


class Nothing:
    pass
"""


def test_an_error_of_an_estimator_names_its_line(refusal, monkeypatch):
    monkeypatch.delitem(sys.modules, "raising", raising=False)
    Path("raising.py").write_text(RAISING)
    words = ("evaluate", ID, "--episodes", 2, "--set", "horizon=3", "--policy")
    for name, message, line in (
        (
            "AtUpdate",
            "failed at measurement 1: AttributeError: 'Measurement' object has no attribute 'doppler'",
            7,
        ),
        ("AtStart", "failed at the start of the track: KeyError: 'lost'", 12),
        ("AtBirth", "cannot be made: ZeroDivisionError: division by zero", 17),
    ):
        errors = refusal(*words, f"raising:{name}")
        assert f"estimator 'raising:{name}' {message}" in errors
        assert errors.rstrip().endswith(f"(raising.py, line {line})")
    monkeypatch.setattr("sys.argv", ["filtergym", *map(str, words), "raising:AtBirth", "--debug"])
    with pytest.raises(ValueError, match="AtBirth") as caught:
        main()
    assert caught.value.__cause__ is not None
    assert "an estimator the methods start and update" in refusal(*words, "raising:Nothing")


def test_a_name_that_is_taken_is_refused():
    for name in ("imm", "kalman-imm", "known-turn", "imm-tuned", "bptt"):
        with pytest.raises(ValueError, match=f"'{name}' is already a name of {ID}"):
            filtergym.evaluate(ID, {name: Start}, episodes=2, horizon=3)


def test_a_constructor_gets_the_task_where_it_needs_one():
    class Setting(Start):
        def __init__(self, gain=0.5):
            self.gain = gain

    class NeedsTask(Start):
        def __init__(self, task=None):
            self.task = task

    class Needing(Start):
        def __init__(self, problem, gain=0.5):
            self.task, self.gain = problem, gain

    assert make_competitor(Setting, "task").gain == 0.5
    assert make_competitor(partial(Setting, gain=0.7), "task").gain == 0.7
    assert make_competitor(NeedsTask, "task").task == "task"
    assert make_competitor(partial(Needing, gain=0.7), "task").__dict__ == {"task": "task", "gain": 0.7}


def test_the_papers_algorithm_is_known_by_another_name():
    def compare(paper, other="imm"):
        found = filtergym.evaluate(ID, {**paper, "bptt": "bptt", other: "imm"}, episodes=4, horizon=20)
        records = filtergym.tidy_records(found)
        return found.attrs["paper"], {
            r.policy: r.value for r in records if (r.metric, r.window) == ("geometric_cost_difference", "all")
        }

    stronger = problem_of(ID).competitor("imm-steady-state")
    name, differences = compare({"paper": stronger}, "other reading")
    assert (name, differences["paper"]) == ("paper", 0.0)
    known = compare({"imm-steady-state": "imm-steady-state"})[1]
    assert differences["bptt"] == known["bptt"]
    assert differences["other reading"] == known["imm"]
    assert compare({"another": "kalman-imm"}, "first reading")[0] == "first reading"


def test_a_class_of_ones_own_is_found_from_the_working_directory(success, monkeypatch):
    """The example of the page, as the page runs it."""
    monkeypatch.delitem(sys.modules, "mine", raising=False)
    monkeypatch.chdir(EXAMPLES)
    words = [word for name in ("mine:Mine", "imm", "bptt", "known-turn") for word in ("--policy", name)]
    output = success("evaluate", ID, "--episodes", 3, "--set", "horizon=10", *words)
    assert [line for line in output.splitlines() if line.startswith("> mine:Mine  ")]
    assert output.count("mine:Mine: ") > 1  # why, in sentences: it is the first that is named
    assert re.match(r"mine:Mine: [\d.]+ ", output)  # the first sentence is about the user's own
    assert "cost vs imm, %" in output
    sys.modules.pop("mine")


@pytest.mark.parametrize("given", ["z, dt", "z", "measurement, dt", "y, t"])
def test_a_class_of_one_track_is_refused_with_its_adapter(given):
    made = {}
    exec(f"def start(self, x0, P0): pass\ndef update(self, {given}): pass", made)  # as students write it
    found = type("OneTrack", (), {name: made[name] for name in ("start", "update")})
    sentence = rf"'one': update\({given}\) is of a single-track filter, .*adapters\.SingleTrackEstimator"
    with pytest.raises(ValueError, match=sentence):
        filtergym.evaluate(ID, {"one": found}, episodes=1)


def test_an_update_with_the_memory_last_is_refused():
    class Old(Start):
        def update(self, measurement, memory):
            return *memory, memory

    with pytest.raises(
        ValueError, match=r"'old': update takes the memory first, as update\(memory, measurement\)"
    ):
        filtergym.evaluate(ID, {"old": Old}, episodes=1)
