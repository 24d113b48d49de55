"""Completion by the shell: through ``main``, with the words of the environment named so far, and without torch."""

import os
import subprocess
import sys

import pytest

from filtergym.__main__ import main
from filtergym.agents.named_policies import pretrained_agents
from filtergym.baselines.problem import problem_of
from filtergym.envs.engine.catalogue import catalogue

TARGET = "filtergym/ManeuveringTarget-v0"


@pytest.fixture
def complete(monkeypatch, capsys):
    """What bash is offered for words, of which the last is completed."""

    def offered(*words):
        monkeypatch.setattr(sys, "argv", ["/somewhere/bin/filtergym"])
        monkeypatch.setenv("_FILTERGYM_COMPLETE", "complete_bash")
        monkeypatch.setenv("COMP_WORDS", " ".join(["filtergym", *words]))
        monkeypatch.setenv("COMP_CWORD", str(len(words)))
        with pytest.raises(SystemExit) as ended:
            main()
        assert ended.value.code == 0
        shown = capsys.readouterr()
        assert shown.err == ""
        return shown.out.split()

    return offered


def test_commands_and_environments(complete):
    assert complete("ev") == ["evaluate"]
    assert complete("evaluate", "") == list(catalogue())
    assert complete("list", "filtergym/M") == [TARGET]
    assert complete("train", "Uav") == ["UavAutopilot-v0"]
    assert complete("benchmark", "--environment", "filtergym/R") == ["filtergym/RadarEsmTracking-v0"]


def test_scenarios_of_the_environment(complete):
    assert complete("evaluate", TARGET, "--scenario", "") == list(catalogue()[TARGET].scenarios)
    training = [s.name for s in catalogue()[TARGET].scenarios.values() if s.training]
    assert complete("train", TARGET, "--scenario", "") == training
    assert training != list(catalogue()[TARGET].scenarios)
    # Before anybody has named the environment, those of all.
    assert {"cruise", "silent"} <= set(complete("evaluate", "--scenario", ""))


def test_policies_of_the_environment(complete):
    expected = {
        name for name in [*problem_of(TARGET).names, *pretrained_agents(TARGET)] if name.startswith("k")
    }
    assert set(complete("evaluate", TARGET, "--policy", "k")) == expected
    assert "kalman-imm" in expected
    assert complete("tune", "ManeuveringTarget", "--policy", "imm", "--policy", "known-t") == ["known-turn"]


def test_few_words_and_nothing(complete):
    assert complete("evaluate", TARGET, "--format", "p") == ["png", "pdf"]
    assert complete("evaluate", TARGET, "--backend", "") == ["auto", "compiled", "numpy"]
    assert complete("reproduce", "imm") == ["imm-alpha-beta"]
    assert complete("evaluate", TARGET, "--policy", "missing") == []
    # A module is a program, and the user has not asked to run it.
    assert complete("evaluate", "no_module:mine/Own-v0", "--scenario", "paper")[:1] == ["paper"]


def test_the_script_for_a_shell():
    """Asked for by name, as where the shell cannot be found among the processes."""
    run = subprocess.run(
        [sys.executable, "-m", "filtergym", "--show-completion", "zsh"],
        capture_output=True,
        text=True,
        check=False,
        env={**os.environ, "_TYPER_COMPLETE_TEST_DISABLE_SHELL_DETECTION": "1"},
    )
    assert run.returncode == 0, run.stderr
    assert "#compdef filtergym" in run.stdout
    assert "_FILTERGYM_COMPLETE=complete_zsh" in run.stdout


def test_other_shells(monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["filtergym"])
    monkeypatch.setenv("_FILTERGYM_COMPLETE", "complete_zsh")
    monkeypatch.setenv("_TYPER_COMPLETE_ARGS", f"filtergym evaluate {TARGET} --scenario c")
    with pytest.raises(SystemExit):
        main()
    shown = capsys.readouterr().out
    assert "cruise" in shown
    assert "crowded" not in shown  # of another environment
