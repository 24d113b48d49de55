"""Agents say where what they are shown departs from what they were trained on."""

import dataclasses

import pytest
from filtergym.agents.envelope import departure
from filtergym.baselines.problem import problem_of

import filtergym
from filtergym.names import find_competitor

TARGET = problem_of("filtergym/ManeuveringTarget-v0")
FUSION = problem_of("filtergym/LooselyCoupledNavigation-v0")
SMALL = 3.0
"""Deviation of the range, m; agents were trained with 100."""


@pytest.mark.parametrize("name", ["bptt", "ppo", "kalman-net"])
def test_in_training_nothing_is_said(name):
    assert departure(TARGET.task, find_competitor(TARGET, name), None, {}) is None
    flown = TARGET.task.scenarios["random"]  # by itself, and not by its name
    assert departure(TARGET.task, find_competitor(TARGET, name), flown, {}) is None


def test_a_parameter_that_was_another_is_named():
    found = departure(FUSION.task, find_competitor(FUSION, "bptt"), None, {"coloured_factor": (30.0, 30.0)})
    assert found.parameters["coloured_factor"][1] == (30.0, 30.0)
    assert "trained with coloured_factor" in str(found)
    assert departure(FUSION.task, find_competitor(FUSION, "bptt"), None, {"horizon": 50}) is None


@pytest.mark.parametrize("name", ["bptt", "kalman-net"])
def test_a_recording_of_another_sensor_is_outside(name):
    recording = filtergym.record(TARGET.id, "paper", 4, horizon=20, range_sigma=SMALL, bearing_sigma=0.01)
    # Whose deviation is stated with every measurement, and not as a parameter that all is scaled by.
    own = {n: v for n, v in recording.parameters.items() if n not in ("range_sigma", "bearing_sigma")}
    recording = dataclasses.replace(recording, parameters=own)
    found = departure(TARGET.task, find_competitor(TARGET, name), recording, {})
    assert found.share > 0.9
    assert "sigma" in found.field
    assert "% of" in str(found)


def test_who_learned_nothing_departs_from_nothing():
    assert departure(TARGET.task, find_competitor(TARGET, "imm"), None, {"range_sigma": SMALL}) is None


def test_the_command_says_it(command):
    code, out, err = command(
        "evaluate",
        TARGET.id,
        "--policy",
        "ppo",
        "--policy",
        "imm",
        "--episodes",
        "4",
        "--set",
        "range_sigma=3",
    )
    assert code == 0, err
    assert "ppo: trained with range_sigma 100.0, not 3" in " ".join(out.split())
