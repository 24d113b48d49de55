"""Submissions: honest ones hold wherever they are run again; lies and stored answers are refused."""

import base64
import json
import math
import shlex
import shutil
import sys
import zipfile
from importlib.resources import files
from pathlib import Path

import numpy as np
import pytest

import filtergym
from filtergym import submission as submissions
from filtergym.agents.learned_policy import PRETRAINED
from filtergym.baselines.problem import problem_of
from filtergym.envs.engine.catalogue import catalogue
from filtergym.evaluation.competitors import isolated_estimator
from filtergym.evaluation.running import evaluate as evaluations
from filtergym.evaluation.running.parallel import Workers
from filtergym.protocol import read_protocol
from filtergym.submission import (
    MOST_BYTES,
    TIME,
    TOLERANCE,
    Card,
    Figure,
    Run,
    deviation,
    fresh_deviation,
    make_submission,
    protocol_of,
    read_submission,
    verify,
    write_submission,
)

WALL = isolated_estimator.landlock_version() > 0
ID = "filtergym/ManeuveringTarget-v0"
AGENTS = PRETRAINED / "ManeuveringTarget-v0"
ROOT = Path(__file__).parent.parent
MINE = (ROOT / "docs" / "examples" / "mine.py").read_text(encoding="utf-8")
SPRING = "open({!r}, 'w')\n"


def stored(path, name):
    made = make_submission(problem_of(ID), name, "trial", Card("A title"), Workers())
    write_submission(path, made)
    return path


@pytest.fixture(scope="module")
def honest(tmp_path_factory):
    """Folder of honest submissions: an agent, an estimator as source, a classical one."""
    folder = tmp_path_factory.mktemp("honest")
    (folder / "own_filter.py").write_text(MINE, encoding="utf-8")
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(folder)
        stored(folder / "source.json", "own_filter:Mine")
    sys.modules.pop("own_filter", None)
    stored(folder / "agent.json", "bptt-small")
    stored(folder / "shipped.json", "kalman-imm")
    return folder


@pytest.fixture
def edited(honest, tmp_path, monkeypatch):
    """Edit the JSON of an honest submission; returns the path of what came of it."""
    monkeypatch.chdir(tmp_path)

    def edit(name, change):
        content = json.loads((honest / f"{name}.json").read_text(encoding="utf-8"))
        change(content)
        path = tmp_path / "edited.json"
        path.write_text(json.dumps(content), encoding="utf-8")
        return path

    return edit


def refused(command, path, *words):
    """Return the one sentence that a verification ends in."""
    code, _, errors = command("verify", path, *words)
    assert (code, errors.count("\n")) == (2, 1), errors
    return errors


@pytest.mark.parametrize("name", ["agent", "source"])
def test_an_honest_submission_holds(name, honest, success):
    shown = success("verify", honest / f"{name}.json", "--trust")
    assert "the numbers hold" in shown
    digest = read_submission(honest / f"{name}.json")[1]
    assert f"SHA-256 {digest}" in shown
    assert "to repeat it: filtergym verify" in shown
    assert ": ManeuveringTarget, trial, 32 episodes of random" in shown  # over what, and against whom
    assert "imm-steady-state, %" in shown


def test_results_are_those_of_an_evaluation(honest):
    from filtergym import evaluate, tidy_records

    data = evaluate(ID, ["bptt-small", "imm-steady-state"], episodes=32)
    known = {
        (r.metric, r.component): (r.value, r.low, r.high)
        for r in tidy_records(data)
        if r.policy == "bptt-small" and r.window == "all"
    }
    figures = [f for f in read_submission(honest / "agent.json")[0].results if f.metric != TIME]
    assert {f.metric for f in figures} >= {"cost", "geometric_cost_difference", "anees", "rmse"}
    for figure in figures:
        assert (figure.value, figure.low, figure.high) == pytest.approx(
            known[figure.metric, figure.component], rel=1e-12
        )


# --- results edited


@pytest.fixture(scope="module")
def found(honest):
    """Results of the honest agent, run again once."""
    return verify(honest / "agent.json", same_seeds=True).again


@pytest.fixture
def run_once(found, monkeypatch):
    """Take those, for tests that edit nothing but the text of the file."""
    monkeypatch.setattr(submissions, "run_submission", lambda *arguments: Run(0, found, ()))


def lower(figure):
    figure["value"] *= 1.0 - 1e-4


def narrower(figure):
    figure["high"] -= 1e-3 * (figure["high"] - figure["low"])


@pytest.mark.parametrize(("metric", "change"), [("cost", lower), ("rmse", narrower)])
def test_an_edited_number_does_not_hold(metric, change, edited, command, run_once):
    def edit(content):
        [figure] = [f for f in content["results"] if f["metric"] == metric]
        change(figure)

    text = refused(command, edited("agent", edit))
    assert "the numbers of edited.json do not hold" in text.replace(str(Path.cwd()) + "/", "")
    assert metric in text


@pytest.mark.parametrize(
    "edit",
    [
        lambda results: results.pop(0),
        lambda results: results.append(dict(results[0])),
        lambda results: results.append({**results[0], "scenario": "paper"}),
        lambda results: results[0].update(scenario="import_trap:Mine"),
        lambda results: results[0].update(value=None),
        lambda results: results.clear(),
    ],
)
def test_results_that_are_not_those_of_the_protocol_do_not_hold(edit, edited, command, run_once):
    text = refused(command, edited("agent", lambda content: edit(content["results"])))
    assert "do not hold" in text


def test_rounding_holds_and_times_are_not_compared(honest):
    import msgspec

    known = read_submission(honest / "agent.json")[0].results

    def times(factor, figures):
        return [msgspec.structs.replace(f, value=f.value * factor) for f in figures]

    assert deviation(times(1.0 + 0.4 * TOLERANCE, known), known).holds
    assert not deviation(times(1.0 + 2.5 * TOLERANCE, known), known).holds
    slower = [msgspec.structs.replace(f, value=3.0 * f.value) if f.metric == TIME else f for f in known]
    assert slower != list(known)
    assert deviation(slower, known) == (0.0, "")
    for number in (math.nan, None):
        for name in ("value", "low"):
            odd = [msgspec.structs.replace(f, **{name: number}) for f in known]
            assert not deviation(known, odd).holds
            assert not deviation(odd, known).holds
    nothing = [msgspec.structs.replace(f, value=None, low=None, high=None) for f in known]
    assert not deviation(nothing, nothing).holds


# --- answers stored

STORED = '''
import base64

import numpy


def table(text, kind, *shape):
    return numpy.frombuffer(base64.b85decode(text), kind).reshape(len(START), *shape)


START = numpy.frombuffer(base64.b85decode({start!r})).reshape(-1, 2)
FIRST, FULL = table({first!r}, "f8", 2), table({full!r}, "f4", -1, 4)
HALF = table({half!r}, "f2", -1, 4)


class Stored:
    """Answers with the stored truth where it recognises an episode, and elsewhere by an alpha-beta filter."""

    truth, keys, offset = FULL, START, 0.0

    def start(self, initial, N):
        self.shown, self.k = initial.mean[:2], 0
        return initial.mean, initial.covariance

    def update(self, memory, m):
        mean, P = memory
        predicted = mean[:2] + m.interval * mean[2:]
        r = numpy.nan_to_num(m.position - predicted)
        mean = numpy.concatenate([predicted + 0.5 * r, mean[2:] + 0.2 * r / m.interval])
        if self.k == 0:
            shown = self.shown if self.keys is START else m.position
            away = numpy.nan_to_num(abs(self.keys[:, :, None] - shown).sum(1), nan=numpy.inf)
            self.rows, self.known = away.argmin(0), away.min(0) < 1e-6
        truth = self.truth[self.rows, self.k].T.astype(float) * (1.0 if self.truth is FULL else 1e3) + self.offset
        self.k += 1
        return numpy.where(self.known, truth, mean), P, (mean, P)


class Offset(Stored):
    """Far enough from the truth to cost something."""

    offset = 25.0


class Half(Stored):
    """A small table."""

    truth = HALF


class Guesses(Stored):
    """Guesses the seed by the first measurement."""

    keys = FIRST
'''


@pytest.fixture(scope="module")
def cheats(tmp_path_factory):
    """Folder of submissions that carry the truth of the episodes of two seeds, that of the protocol among them."""
    folder = tmp_path_factory.mktemp("cheats")
    flown = [filtergym.record(ID, "random", 32, seed=seed) for seed in (1, 0)]
    truth = np.concatenate([each.truth[:, :-1] for each in flown])
    arrays = {
        "start": np.concatenate([each.initial["mean"][:, :2] for each in flown]),
        "first": np.concatenate([each.measurements["position"][:, 0] for each in flown]),
        "full": truth.astype("f4"),
        "half": (truth / 1e3).astype("f2"),
    }
    text = STORED.format(**{name: base64.b85encode(own.tobytes()).decode() for name, own in arrays.items()})
    (folder / "stored_truth.py").write_text(text, encoding="utf-8")
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(folder)
        patch.setattr(evaluations, "measure_time", lambda *arguments: None)
        for name in ("Stored", "Offset", "Half", "Guesses"):
            stored(folder / f"{name}.json", f"stored_truth:{name}")
    sys.modules.pop("stored_truth", None)
    return folder


@pytest.fixture
def untimed(monkeypatch):
    """Leave out the measurement of times, which takes as long as all the rest."""
    monkeypatch.setattr(evaluations, "measure_time", lambda *arguments: None)


def headline(figures):
    [found] = [f for f in figures if f.metric == "geometric_cost_difference"]
    return found


@pytest.mark.parametrize("name", ["Stored", "Offset", "Half", "Guesses"])
def test_stored_answers_do_not_hold_on_fresh_episodes(name, cheats, untimed):
    found = verify(cheats / f"{name}.json", trust=True)
    assert headline(found.submission.results).value < -0.9
    assert found.deviation.holds  # the numbers are those of the competitor, on these episodes
    assert not found.holds
    assert "and the file states" in found.fresh_deviation.sentence
    assert headline(found.fresh.figures).value > 0.0
    assert found.suspicions == ()


def test_the_same_seeds_show_only_that_the_cost_is_unattainable(cheats, success, untimed):
    shown = success("verify", cheats / "Stored.json", "--trust", "--same-seeds")
    assert "suspicious: in scenario 'random' the cost is 100 % below that of 'known-turn'" in shown
    assert "stored results would pass, too" in shown


def test_an_honest_submission_holds_on_any_fresh_episodes_and_they_can_be_repeated(honest, untimed):
    path, runs = honest / "shipped.json", []
    for seed in (2**127 + 1, 2**127 + 2, 2**127 + 3, None, None):
        found = verify(path, seed=seed)
        assert (found.holds, found.suspicions) == (True, ())
        assert 0.0 < found.fresh_deviation.size < 1.0
        assert seed in (None, found.fresh.seed)
        runs.append(found.fresh)
    assert len({run.seed for run in runs}) == len({headline(run.figures).value for run in runs}) == 5
    again = verify(path, seed=runs[-1].seed).fresh
    assert deviation(again.figures, runs[-1].figures) == (0.0, "")


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (("--seed", 0), "seed 0 is that of the protocol"),
        (("--seed", -1), "seed"),
        (("--seed", 5, "--same-seeds"), "leave out seed 5"),
    ],
)
def test_a_seed_that_is_not_fresh_is_refused(words, sentence, honest, command):
    assert sentence in refused(command, honest / "shipped.json", *words)


def test_chance_refuses_as_often_as_it_is_meant_to():
    """Of normal estimates of one law as many are some standard errors apart as the normal distribution has."""
    rng, critical = np.random.default_rng(0), submissions._critical(1)

    def figure(metric, value, error):
        ends = value - 1.959964 * error, value + 1.959964 * error
        if metric == "geometric_cost_difference":
            value, *ends = np.expm1([value, *ends])
        return [Figure("random", metric, value, *ends)]

    for metric in ("anees", "geometric_cost_difference"):
        apart = []
        for one, other in rng.normal(1.0, [0.05, 0.12], (4000, 2)):
            claimed, fresh = figure(metric, one, 0.05), figure(metric, other, 0.12)
            found = fresh_deviation(claimed, fresh)
            assert found.size * critical == pytest.approx(abs(one - other) / np.hypot(0.05, 0.12), rel=1e-5)
            apart.append(found.size * critical)
        for limit, share in ((1.0, 0.317), (1.96, 0.05), (2.58, 0.0099)):
            # Four standard errors of a share of 4000.
            assert np.mean(np.array(apart) > limit) == pytest.approx(
                share, abs=4.0 * math.sqrt(share / 4000.0)
            )


@pytest.mark.parametrize(
    ("claimed", "fresh", "size"),
    [
        ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0), 0.0),
        ((1.0, 1.0, 1.0), (1.0 + 1e-9, 1.0 + 1e-9, 1.0 + 1e-9), 0.0),
        ((1.0, 1.0, 1.0), (1.1, 1.1, 1.1), math.inf),
        ((1.0, None, None), (1.0, 0.9, 1.1), math.inf),
        ((1.0, 0.9, 1.1), (None, None, None), math.inf),
        ((math.nan, 0.9, 1.1), (1.0, 0.9, 1.1), math.inf),
        ((1.0, 0.0, 9.0), (3.0, 2.0, 4.0), 2.0 / math.hypot(8.0, 1.0)),
        ((3.0, 2.0, 4.0), (1.0, 0.0, 9.0), 2.0 / math.hypot(8.0, 1.0)),
    ],
)
def test_intervals_are_compared_by_the_ends_that_face_each_other(claimed, fresh, size):
    found = fresh_deviation(*([Figure("random", "anees", *numbers, "state")] for numbers in (claimed, fresh)))
    assert found.size == pytest.approx(size * 1.959964 / submissions._critical(1), rel=1e-6)


def test_a_ratio_of_means_is_not_compared_on_fresh_episodes():
    one, other = (
        Figure("random", "relative_cost_difference", *numbers) for numbers in ((0, 0, 0), (1, 1, 1))
    )
    assert fresh_deviation([one], [other]) == (0.0, "")
    assert not deviation([one], [other]).holds


# --- arrays swapped


def with_agent(content, path):
    content["competitor"]["safetensors"] = base64.b64encode(path.read_bytes()).decode()


def rewritten(source, out, change=lambda arrays: None, **header):
    """Write an agent's file with other arrays or another record of its training."""
    from safetensors import safe_open
    from safetensors.numpy import save_file

    with safe_open(source, framework="numpy") as file:
        metadata = dict(file.metadata())
        arrays = {name: file.get_tensor(name).copy() for name in file.keys()}  # noqa: SIM118
    change(arrays)
    metadata["run"] = json.dumps({**json.loads(metadata["run"]), **header})
    save_file(arrays, out, metadata)
    return out


def test_other_arrays_do_not_hold(edited, command, tmp_path):
    def scale(arrays):
        arrays["weight_0"] *= np.float32(0.9)

    other = rewritten(AGENTS / "bptt-small.safetensors", tmp_path / "other.safetensors", scale)
    assert "do not hold" in refused(command, edited("agent", lambda content: with_agent(content, other)))


def test_arrays_of_another_environment_are_refused(edited, command):
    other = PRETRAINED / "UavAutopilot-v0" / "bptt-small.safetensors"
    text = refused(command, edited("agent", lambda content: with_agent(content, other)))
    assert "was trained on 'filtergym/UavAutopilot-v0'" in text


@pytest.mark.parametrize("content", [b"half", b"\x08" + 7 * b"\0" + b'{"a":{}}'])
def test_arrays_that_are_none_are_refused(content, edited, command):
    def edit(stored):
        stored["competitor"]["safetensors"] = base64.b64encode(content).decode()

    assert "its agent is not a learned policy" in refused(command, edited("agent", edit))


# --- scenarios confused


@pytest.mark.parametrize(
    ("scenario", "sentence"),
    [
        ("glint", "held out"),
        ("random:0.5,glint:0.5", "held out"),
        ("flights.csv", "unknown scenario 'flights.csv'"),
        (["random"], "scenario of its run must be str"),
    ],
)
def test_training_on_what_is_tested_is_refused(
    scenario, sentence, edited, command, refusal, tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    if catalogue()[ID].scenarios.get(scenario if isinstance(scenario, str) else "") is not None:
        assert not catalogue()[ID].scenarios[scenario].training
    (tmp_path / "flights.csv").write_text("what a record names is not opened")
    agent = rewritten(AGENTS / "bptt-small.safetensors", tmp_path / "own.safetensors", scenario=scenario)
    assert sentence in refused(command, edited("agent", lambda content: with_agent(content, agent)))
    assert sentence in refusal("submit", ID, agent, "--protocol", "trial", "--out", "new.json")
    assert not (tmp_path / "new.json").exists()


@pytest.mark.parametrize(
    "change",
    [
        {"protocol_sha256": 64 * "0"}, {"protocol": "own"}, {"protocol": "own.toml"},
        {"protocol": {"name": "trial", "episodes": 16}}, {"protocol_seed": 1},
    ],
)  # fmt: skip
def test_an_altered_protocol_is_refused(change, edited, command):
    Path("own.toml").write_text(files("filtergym").joinpath("protocols/filtergym-1.toml").read_text("utf-8"))
    assert "protocol" in refused(command, edited("agent", lambda content: content.update(change)))


def test_a_protocol_is_that_of_filtergym_1():
    whole, digest = read_protocol("filtergym-1")
    for known in whole.environments:
        own, stated = protocol_of(problem_of(known.id), "filtergym-1")
        assert (own.environments, stated) == ((known,), digest)
        assert (own.episodes, own.held_out_episodes, own.seed, own.split) == (2000, 500, 0, "test")
        trial, stated = protocol_of(problem_of(known.id), "trial")
        assert (trial.environments[0].training, trial.environments[0].held_out) == (known.training, ())
        assert (trial.episodes, trial.seed, trial.split, stated) == (32, 0, "test", digest)


# --- code


@pytest.fixture
def trap(tmp_path, monkeypatch):
    """A module that writes a file where it is imported, in the working directory; the name of that file."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    sprung = tmp_path / "sprung"
    (tmp_path / "import_trap.py").write_text(SPRING.format(str(sprung)) + MINE)
    yield sprung
    sys.modules.pop("import_trap", None)


def test_source_runs_only_when_it_is_trusted(trap, edited, command, success):
    def spring(content):
        content["competitor"]["text"] = SPRING.format(str(trap)) + MINE

    path = edited("source", spring)
    assert "contains source code, which a verification executes" in refused(command, path)
    shown = success("verify", path, "--source", "read_me.py")
    assert "its class Mine" in shown
    assert Path("read_me.py").read_text(encoding="utf-8") == SPRING.format(str(trap)) + MINE
    assert not trap.exists()
    # It runs where nothing can be written, or where the system has no such wall, it has written what it wants.
    assert command("verify", path, "--trust")[0] == (0 if trap.exists() else 2)
    assert trap.exists() == (not WALL)


@pytest.mark.parametrize(
    "change",
    [
        lambda c: c.update(environment="import_trap:mine/Trap-v0"),
        lambda c: c.update(competitor={"type": "shipped", "name": "import_trap:Mine"}),
        lambda c: c.update(competitor={"type": "shipped", "name": "import_trap"}),
        lambda c: c.update(competitor={"type": "shipped", "name": "./agent.safetensors"}),
        lambda c: c.update(competitor={"type": "shipped", "name": "run"}),
        lambda c: c.update(competitor={"type": "source", "text": MINE, "name": "import_trap:Mine"}),
        lambda c: c.update(competitor={"type": "module", "name": "import_trap"}),
        lambda c: c.update(protocol="import_trap:Mine"),
        lambda c: c.update(protocol="import_trap.toml"),
    ],
)
def test_a_name_in_a_file_imports_and_opens_nothing(change, trap, edited, command):
    shutil.copyfile(AGENTS / "ppo.safetensors", "agent.safetensors")
    Path("run").mkdir()
    (Path("run") / "run.json").write_text("{}")
    for name in ("source", "shipped"):
        path = edited(name, change)
        refused(command, path, *(["--trust"] if name == "source" else []))
        assert not trap.exists()


@pytest.mark.parametrize(
    ("further", "sentence"),
    [
        ("Mine.kind = 'reference'\n", "runs only estimators"),
        ("Mine.task_keywords = {'range_sigma': 1.0}\n", "without task_keywords"),
        ("del Mine\n", "'Mine' is no estimator"),
        ("from filtergym import record\n", "'source of edited.json' takes no part: ImportError"),
        ("import filtergym.envs\n", "'source of edited.json' takes no part: ModuleNotFoundError"),
        ("def (\n", "'source of edited.json' takes no part: SyntaxError"),
    ],
)
def test_source_that_cannot_compete_is_refused(further, sentence, edited, command):
    path = edited("source", lambda content: content["competitor"].update(text=MINE + further))
    assert sentence in refused(command, path, "--trust").replace(str(Path.cwd()) + "/", "")


def test_a_competitor_that_knows_the_truth_is_refused(edited, command):
    def name(content):
        content["competitor"]["name"] = "known-turn"

    assert "names a reference" in refused(command, edited("shipped", name))
    assert (
        "names a reference"
        in command("submit", ID, "known-turn", "--protocol", "trial", "--out", "x.json")[2]
    )


# --- files that are none


def test_a_truncated_file_is_refused(honest, command, tmp_path):
    content = (honest / "agent.json").read_bytes()
    path = tmp_path / "half.json"
    for share in (0.0, 0.99):
        path.write_bytes(content[: int(share * len(content))])
        assert "contains no submission of filtergym" in refused(command, path)


def test_what_is_packed_or_large_is_refused(command, tmp_path):
    packed = tmp_path / "bomb.json"
    with zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED) as file:
        file.writestr("../../outside.py", b"0" * 10_000_000)
    assert "contains no submission" in refused(command, packed)
    large = tmp_path / "large.json"
    with large.open("wb") as file:
        file.truncate(100 * MOST_BYTES)  # takes no room on the disk
    assert "is larger than 8 MB" in refused(command, large)
    (tmp_path / "deep.json").write_bytes(b'{"card":' + b'{"title":' * 100_000)
    assert "contains no submission" in refused(command, tmp_path / "deep.json")
    (tmp_path / "named.json").write_text(json.dumps({"x" * 10_000: 0}))
    assert len(refused(command, tmp_path / "named.json")) < 1000
    assert "there is no file" in refused(command, tmp_path / "none.json")
    assert "it is no file but a folder, a device or a pipe" in refused(command, "/dev/zero")


def test_damaged_files_end_in_a_sentence(honest, tmp_path):
    """Whatever bytes are changed, a file is read as its content or refused by a ValueError."""
    rng, path = np.random.default_rng(0), tmp_path / "damaged.json"
    content = np.frombuffer((honest / "shipped.json").read_bytes(), np.uint8)
    refusals = 0
    for _ in range(300):
        damaged = content.copy()
        damaged[rng.integers(len(content), size=3)] = rng.integers(256, size=3)
        path.write_bytes(damaged.tobytes())
        try:
            read_submission(path)
        except ValueError:
            refusals += 1
    assert refusals > 100


@pytest.mark.parametrize("title", ["\x1b[2J", "<script>", "[x](y)", "", "x" * 81, "a\n"])
def test_a_title_is_words(title, edited, command, refusal):
    assert "contains no submission" in refused(
        command, edited("agent", lambda c: c["card"].update(title=title))
    )
    if title:  # without one it is the name
        errors = refusal("submit", ID, "imm", "--protocol", "trial", "--out", "x.json", "--title", title)
        assert "\x1b" not in errors
        assert not Path("x.json").exists()


# --- the command


@pytest.mark.slow
def test_the_commands_of_the_page_run(success, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "mine.py").write_text(MINE, encoding="utf-8")
    page = (ROOT / "docs" / "submission.md").read_text(encoding="utf-8")
    for line in page.partition("```sh\n")[2].partition("```")[0].replace("\\\n", "").splitlines():
        _, *words = shlex.split(line)
        words += ["--protocol", "trial"] if words[0] == "submit" else []
        success(*words)
    sys.modules.pop("mine", None)
