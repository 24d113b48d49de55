"""The command line: what it prints, what it writes, and one clear sentence for every mistake."""

import importlib.util
import inspect
import json
import platform
import re
import sys
from importlib import metadata
from types import SimpleNamespace

import commands
import pytest
from made_results import without_times

from filtergym.__main__ import GROUPS, import_command
from filtergym.agents.learned_policy import pretrained_path
from filtergym.baselines.problem import problem_of
from filtergym.commands import terminal
from filtergym.commands.progress import ProgressLines
from filtergym.commands.terminal import progress_bar
from filtergym.compiler import native
from filtergym.envs.engine.catalogue import catalogue
from filtergym.evaluation.running import summary
from filtergym.names import find_competitor
from filtergym.reports.tables import benchmark
from filtergym.reports.tables.results import read_results

ENV = "filtergym/ManeuveringTarget-v0"
OF_OPTIONS = {"Backend": ["filtergym[fast]"], "Cluster": ["filtergym[cluster]"]}
"""Extras in the help of options."""


@pytest.fixture
def run(command, monkeypatch, tmp_path):
    """Run the command line in an empty folder, as if a terminal had."""

    def ran(*arguments):
        monkeypatch.chdir(tmp_path)
        code, shown, errors = command(*arguments)
        return SimpleNamespace(returncode=code, stdout=shown, stderr=errors)

    return ran


def test_version_is_that_of_the_installed_package(success):
    assert success("--version") == f"filtergym {metadata.version('filtergym')}\n"


COMMANDS = {name: import_command(own) for group in GROUPS.values() for name, own in group.items()}


@pytest.mark.parametrize("name", COMMANDS)
def test_help_of_every_command_ends_with_an_example(name, success):
    shown, source = success(name, "--help"), inspect.getsource(COMMANDS[name])
    assert f"Example: filtergym {name}" in shown
    # The extras that a command names are not swallowed as markup.
    extras = {
        word for option in ("Backend", "Cluster") if f": {option}" in source for word in OF_OPTIONS[option]
    }
    extras |= set(re.findall(r"filtergym\[\w+\]", inspect.getdoc(COMMANDS[name])))
    assert extras == set(re.findall(r"filtergym\[\w+\]", shown))


REFUSED = {
    "evaluate": [
        ((ENV, "--episodes", "0", "--out", "new/out"), "episodes must be an integer of at least 1"),
        (("Manoeuvre", "--json", "new/records.json"), "unknown environment"),
        ((ENV, "--policy", "imm", "--why", "imn", "--out", "new"), "did you mean 'imm'"),
        ((ENV, "--set", "gains"), "--set needs name=value"),
        ((ENV, "--set", "gains=(0.3,"), "cannot read the value"),
        ((ENV, "--out", "/proc/nowhere"), "cannot write to folder"),
        ((ENV, "--scenario", "missing.csv"), "cannot read trajectory"),
    ],
    "record": [((ENV, "--episodes", "0", "--out", "new/plots.nc"), "episodes must be an integer")],
    "offline": [((ENV, "--policy", "missing", "--out", "new"), "unknown policy")],
    "benchmark": [(("--environment", ENV, "--split", "tset", "--out", "new"), "unknown split 'tset'")],
    "report": [(("missing.json", "--out", "new/report.html"), "cannot read the results")],
    "tune": [
        ((ENV, "--policy", "imm", "--budget", "0", "--out", "new"), "a budget of 0 steps"),
        ((ENV, "--policy", "imm", "--scenario", "atc", "--out", "new"), "held out"),
        ((ENV, "--policy", "random", "--out", "new"), "unknown tunable policy"),
    ],
    "reproduce": [
        (("imm-alpha-beta", "--episodes", "0", "--out", "new"), "episodes must be at least"),
        (("imm", "--out", "new"), "unknown paper"),
    ],
    "advise": [(("missing.csv", "--out", "new/mine.filter.json"), "missing.csv")],
    "animate": [((ENV, "--policy", "known-input-bound", "--out", "new"), "it has no estimates")],
    "train": [
        ((ENV, *words, "--out", "new/run"), "must be an integer of at least 1")
        for words in (("--steps", 0), ("--envs", 0), ("--validate-every", 0), ("--set", "algo.n_envs=1.5"))
    ],
    "export": [(("missing", "--out", "new/agent.safetensors"), "missing")],
    "submit": [((ENV, "missing", "--out", "new/mine.json"), "unknown competitor to submit")],
}
"""Words that are refused by each command that writes, and the message."""


def test_every_command_with_out_is_among_those_that_are_refused():
    with_out = {
        name for name, function in COMMANDS.items() if "out" in inspect.signature(function).parameters
    }
    assert with_out == REFUSED.keys()


@pytest.mark.parametrize("name", REFUSED)
def test_what_is_refused_gets_one_sentence_and_leaves_nothing(name, run, tmp_path):
    if name == "train":
        pytest.importorskip("stable_baselines3")
    for words, expected in REFUSED[name]:
        result = run(name, *words)
        assert result.returncode == 2
        assert result.stderr.startswith("Error: ")
        assert expected in result.stderr
        assert result.stderr.count("\n") == 1, result.stderr
        assert list(tmp_path.iterdir()) == []


def test_a_report_without_its_extra_is_refused_alone_and_left_out_beside_results(
    run, without_figures, tmp_path, monkeypatch
):
    monkeypatch.setitem(sys.modules, "filtergym.reports.pages.html_report", None)
    result = run("evaluate", ENV, "--policy", "imm", "--episodes", "2", "--set", "horizon=10", "--out", "out")
    assert result.returncode == 0
    assert "no report: reports need more packages: pip install 'filtergym[report]'" in result.stdout
    result = run("report", "out")
    assert result.returncode == 2
    assert result.stderr.startswith("Error: reports need more packages: pip install 'filtergym[report]'")
    assert not list(tmp_path.rglob("report.html"))


@pytest.mark.parametrize(("columns", "width"), [("80", None), ("", 100), ("0", 100), ("wide", 100)])
def test_columns_sets_the_width_of_piped_output(columns, width, monkeypatch):
    monkeypatch.setenv("COLUMNS", columns)
    assert terminal.output_width() == width


def test_help_shows_the_commands_in_groups(run):
    shown = run("--help").stdout
    words = [
        word
        for group, commands in GROUPS.items()
        for word in (f"─ {group} ─", *(f"│ {c} " for c in commands))
    ]
    places = [shown.find(word) for word in words]
    assert -1 not in places
    assert places == sorted(places)


@pytest.mark.parametrize("name", commands.COMMANDS)
def test_help_of_what_makes_the_pages_ends_with_an_example(name, make_page):
    code, shown, _ = make_page(name, "--help")
    assert code == 0
    assert f"Example: python docs/make {name}" in shown


def test_progress_bar_is_silent_without_a_terminal(capsys):
    with progress_bar() as bar:
        bar.add_task("evaluating", total=None)
    assert capsys.readouterr().err == ""


class Clock:
    """Seconds that pass when it is called."""

    now = 0.0

    def __call__(self):
        return self.now


def test_progress_without_a_terminal_is_few_lines_with_the_remaining_time():
    lines, clock = [], Clock()
    with ProgressLines(lines.append, clock) as shown:
        task = shown.add_task("tuning imm", total=1000)
        for second in range(1, 1001):
            clock.now = float(second)
            shown.update(task, advance=1)
    # One for every twentieth of the work.
    assert len(lines) == 20
    assert lines[0] == "tuning imm: 5 % done after 50 s, 15 min 50 s left"
    assert lines[-1] == "tuning imm: 100 % done after 16 min 40 s"
    # No sooner than after ten seconds, and not later than after a minute.
    lines.clear()
    task = shown.add_task("evaluating", total=100)
    clock.now += 9.0
    shown.update(task, completed=99)
    assert lines == []
    task = shown.add_task("training ppo", total=100_000)
    for minute in range(1, 4):
        clock.now += 60.0
        shown.update(task, completed=minute)
        shown.update(task, completed=minute)
    assert len(lines) == 3
    assert lines[0] == "training ppo: 0 % done after 1 min 0 s, 1666 h 39 min left"


def test_finished_work_is_printed_with_the_remaining_time():
    lines, clock = [], Clock()
    shown = ProgressLines(lines.append, clock)
    shown.write_line("log.nc: 250 measurements")
    task = shown.add_task("benchmark", total=10)
    clock.now = 8.0
    shown.update(task, advance=4)
    shown.write_line("ManeuveringTarget, random: 41 competitors over 500 episodes")
    shown.update(task, description="fitting")
    shown.update(task, description="fitting")
    assert lines.pop() == "fitting (40 % done after 8 s, 12 s left)"
    assert lines == [
        "log.nc: 250 measurements",
        "ManeuveringTarget, random: 41 competitors over 500 episodes (40 % done after 8 s, 12 s left)",
    ]


def test_list_names_everything(run):
    lines = run("list").stdout.splitlines()
    assert [line.split()[0] for line in lines[: len(catalogue())]] == list(catalogue())
    assert lines[len(catalogue())] == ""
    shown = run("list", "ManeuveringTarget").stdout
    assert shown.startswith(f"{ENV}\n")
    assert "UavAutopilot" not in shown
    assert max(map(len, shown.splitlines())) <= 100
    # What a reader needs to judge a number, too: whose algorithm it is, and what a reference receives.
    for word in (
        *("evidence", "descent", "adaptive-rearm", "imm-tuned", "bptt", "Bakulev"),
        *("knows when every manoeuvre begins and ends", "knows the acceleration in every scan"),
    ):
        assert word in shown
    assert shown.count("(default)") == 2  # one control, one scenario
    assert "clutter_density" not in shown
    everything = run("list", "ManeuveringTarget", "--all").stdout
    assert "clutter_density" in everything
    assert "about the track. No training episode holds any." in " ".join(everything.split())


def test_a_listing_fits_two_screens(run, env_id):
    name, *lines = run("list", env_id).stdout.splitlines()
    assert name == env_id
    assert len(lines) < 50
    assert max(map(len, lines)) <= 100
    scenarios = catalogue()[env_id].scenarios
    assert [line.split()[0] for line in lines[-len(scenarios) :]] == list(scenarios)


def test_doctor_prints_what_an_issue_needs(run, monkeypatch):
    lines = dict(line.split(maxsplit=1) for line in run("doctor").stdout.splitlines())
    assert lines["filtergym"] == f"{metadata.version('filtergym')} on Python {platform.python_version()}"
    for name in ("numpy", "msgspec"):
        assert f"{name} {metadata.version(name)}" in lines["libraries"]
    assert "[dev]" not in lines
    known = metadata.version

    def version(name):
        if name == "llvmlite":
            raise metadata.PackageNotFoundError(name)
        return "0.1" if name == "numpy" else known(name)

    monkeypatch.setattr(metadata, "version", version)
    lines = dict(line.split(maxsplit=1) for line in run("doctor").stdout.splitlines())
    assert lines["[fast]"].startswith("llvmlite missing, platformdirs ")
    assert "numpy 0.1, wants >=2.2" in lines["libraries"]
    monkeypatch.setattr(native, "AVAILABLE", True)
    for features, widest in (
        ("+avx2,+avx512f", "AVX-512"),
        ("+avx2", "AVX2"),
        ("+sse2", "neither AVX2 nor AVX-512"),
    ):
        monkeypatch.setattr(native, "processor", lambda features=features: ("mine", features))
        lines = dict(line.split(maxsplit=1) for line in run("doctor").stdout.splitlines())
        assert lines["backend"] == f"compiled for mine, {widest}"


def test_animate_draws_every_policy(tmp_path, run):
    pictures = ("animate", "ManeuveringTarget", "--scenario", "paper", "--every", "100", "--out", "new")
    result = run(*pictures, "--policy", "ppo", "--policy", "known-turn")
    assert result.returncode == 0, result.stderr
    made = sorted(path.name for path in (tmp_path / "new").iterdir())
    assert made == [f"ManeuveringTarget-v0-{name}.gif" for name in ("known-turn", "ppo")]


def test_evaluate_writes_tidy_records_and_figures(tmp_path, run):
    result = run(
        "evaluate", ENV, "--scenario", "paper", "--policy", "imm", "--policy", "known-turn", "--episodes", "4",
        "--seed", "1", "--out", "out", "--json", "new/records.json", "--set", "transition=[[0.8,0.2],[0.1,0.9]]",
    )  # fmt: skip
    assert result.returncode == 0, result.stderr
    records = json.loads((tmp_path / "new" / "records.json").read_text())
    assert set(records[0]) == {
        "environment", "control", "scenario", "policy", "kind", "metric", "component", "window", "value", "low",
        "high", "unit", "episodes", "seed", "split",
    }  # fmt: skip
    assert {r["policy"] for r in records} == {"imm", "known-turn"}
    assert {r["seed"] for r in records} == {1}
    made = {path.name for path in (tmp_path / "out").iterdir()}
    # The report takes an extra, which the core install lacks: then an error names it.
    report = {"report.html"} if importlib.util.find_spec("plotly") else set()
    assert report or "no report: reports need more packages" in result.stdout
    assert made == report | {
        "records.json", "records.csv", "table.tex", "results.nc", "results.json", "rmse_over_time.png",
        "error_distribution.png", "consistency.png", "mode_probabilities.png", "cost_difference.png",
            "cost_and_time.png",
        "worst_episodes.png",
    }  # fmt: skip
    # Whose cost is explained is the first that is named; what belongs together stands in one line.
    assert re.search(r"^imm: \d+ % of its cost falls ", result.stdout, re.MULTILINE)
    assert not re.search(r"^known-turn: ", result.stdout, re.MULTILINE)
    assert "known-turn knows when every manoeuvre begins and ends, its accel" in result.stdout


def test_benchmark_goes_on_with_the_missing_competitors(tmp_path, monkeypatch):
    cells = [
        benchmark.Cell(problem_of(ENV), scenario, 4, ("imm", "known-turn"))
        for scenario in ("paper", "random")
    ]
    monkeypatch.setattr(benchmark, "cells", lambda full, environments, split: cells)
    ran = []
    original = summary.summarise

    def interrupted(asked, tick):
        if len(ran) == 3 and not resumed:
            raise KeyboardInterrupt
        ran.append((asked.experiment.scenario, asked.name))
        return original(asked, tick)

    resumed = False
    monkeypatch.setattr(summary, "summarise", interrupted)
    with pytest.raises(KeyboardInterrupt):
        benchmark.run_benchmark(tmp_path / "parts", benchmark.BenchmarkOptions())
    assert not (tmp_path / "parts" / "results.json").exists()
    resumed = True
    results = benchmark.run_benchmark(tmp_path / "parts", benchmark.BenchmarkOptions())
    assert ran == [(cell.scenario, name) for cell in cells for name in cell.policies]
    assert [result.scenario for result in results] == ["paper", "random"]
    read, settings = read_results(tmp_path / "parts")
    assert [result.records for result in read] == [result.records for result in results]
    assert settings.command == "filtergym benchmark"
    assert not (tmp_path / "parts" / "unfinished").exists()
    # What a file has kept is what was in memory: the results of one go are the same to the last digit.
    benchmark.run_benchmark(tmp_path / "whole", benchmark.BenchmarkOptions())
    whole, parts = (without_times(tmp_path / folder / "results.json") for folder in ("whole", "parts"))
    assert whole == parts


def test_benchmark_runs_until_the_headline_is_narrow(tmp_path, monkeypatch):
    """As many episodes as the half width needs, which falls with their root; in the training distribution alone."""
    problem = problem_of(ENV)
    cells = [benchmark.Cell(problem, name, 10, ("imm", "fixed-best")) for name in ("paper", "random")]
    monkeypatch.setattr(benchmark, "cells", lambda full, environments, split: cells)
    small = benchmark.run_benchmark(tmp_path / "small", benchmark.BenchmarkOptions(timed=False))
    width = 100.0 * benchmark.headline_half_width(small[1])
    options = benchmark.BenchmarkOptions(timed=False, half_width=width / 2.0)
    found = benchmark.run_benchmark(tmp_path / "large", options)
    assert [result.records[0].episodes for result in small] == [10, 10]
    assert found[0].records == small[0].records
    assert found[1].records[0].episodes >= 4 * 10
    assert 100.0 * benchmark.headline_half_width(found[1]) <= width / 2.0


def test_benchmark_shows_how_to_run_a_filter_of_the_user(tmp_path, monkeypatch, command):
    monkeypatch.chdir(tmp_path)
    code, _, errors = command("benchmark", "--policy", "mine:Mine")
    assert (code, "evaluate --protocol filtergym-1 --policy mine:Mine" in errors) == (2, True)
    assert not list(tmp_path.iterdir())


def test_benchmark_removes_only_its_own_files(tmp_path, monkeypatch):
    cell = benchmark.Cell(problem_of(ENV), "paper", 5, ("imm",))
    monkeypatch.setattr(benchmark, "cells", lambda full, environments, split: [cell])
    waiting = tmp_path / "unfinished"
    others = {"thesis.tex", "ManeuveringTarget-v0.paper.5.test1.json", "folder"}
    (waiting / "folder").mkdir(parents=True)
    for name in others - {"folder"}:
        (waiting / name).write_text("mine")
    benchmark.run_benchmark(tmp_path, benchmark.BenchmarkOptions())
    assert (tmp_path / "results.json").exists()
    assert {path.name for path in waiting.iterdir()} == others


def test_full_benchmark_compares_everything():
    cells = benchmark.cells(True, [ENV, "filtergym/TightlyCoupledNavigation-v0"])
    own, dear = cells[0], cells[-1]
    assert own.policies[0] == "imm"
    expected = {"fixed-low", "adaptive-rearm-tuned", "ppo", "bptt", "known-turn", "known-input-bound"}
    assert expected <= set(own.policies)
    assert own.episodes == 5000
    assert 20 <= dear.episodes < 1000
    # Held-out scenarios are run for final tables only.
    assert [cell.scenario for cell in benchmark.cells(True, [ENV], "validation")] == ["random"]


def test_the_quick_benchmark_runs_a_tuned_one_in_the_place_of_what_it_was_and_only_where_it_has_won():
    """Of equals the first is called the best: not what is made of it."""
    expected = [(id, cls.default_scenario) for id, cls in catalogue().items()]
    cells = benchmark.cells(False)
    assert [(cell.environment, cell.scenario) for cell in cells] == expected
    own, loose = (
        next(cell for cell in cells if cell.environment == id)
        for id in (ENV, "filtergym/LooselyCoupledNavigation-v0")
    )
    names = own.policies
    assert own.problem.tuned_values.is_improved("kalman-imm")
    assert not loose.problem.tuned_values.is_improved("fault-bank")
    assert {"kalman-imm-tuned", "semi-markov"} <= {*names}
    assert "fault-bank" in loose.policies
    assert "kalman-imm" not in names
    assert "fault-bank-tuned" not in loose.policies
    assert names.index("kalman-imm-tuned") < names.index("semi-markov") < names.index("semi-markov-pda")


@pytest.mark.parametrize(
    ("name", "learned"),
    [
        ("imm", False), ("imm-tuned", False), ("known-turn", False), ("bptt", True), ("gated:bptt", True),
        ("gated:adaptive", False), (str(pretrained_path(ENV, "bptt")), True),
        ("filtergym.baselines.maneuvering_target.policies:InteractingMultipleModel", False),
    ],
)  # fmt: skip
def test_a_competitor_is_learned_or_not(name, learned):
    assert find_competitor(problem_of(ENV), name).learned is learned
