"""Agents say where what they are shown departs from what they were trained on."""

import dataclasses
import shutil

import numpy as np
import pytest
from models import make_model

import filtergym
from filtergym.agents.envelope import EnvelopeAlarm, TrainingRange, departure, training_range
from filtergym.agents.learned_policy import load_policy, pretrained_path, write_envelope
from filtergym.baselines.problem import problem_of
from filtergym.evaluation.running.rollout import start_lanes
from filtergym.evaluation.running.seeds import episode_seeds
from filtergym.names import find_competitor

TARGET = problem_of("filtergym/ManeuveringTarget-v0")
FUSION = problem_of("filtergym/LooselyCoupledNavigation-v0")
SMALL = 3.0
"""Deviation of the range, m; agents were trained with 100."""


@pytest.mark.parametrize("name", ["ppo", "kalman-net"])
def test_within_the_training_range_there_is_no_warning(name):
    assert departure(TARGET.task, find_competitor(TARGET, name).maker, None, {}) is None
    flown = TARGET.task.scenarios["random"]  # by itself, and not by its name
    assert departure(TARGET.task, find_competitor(TARGET, name).maker, flown, {}) is None


def test_a_parameter_that_was_another_is_named():
    found = departure(
        FUSION.task, find_competitor(FUSION, "bptt").maker, None, {"coloured_factor": (30.0, 30.0)}
    )
    assert found.parameters["coloured_factor"][1] == (30.0, 30.0)
    assert "trained with coloured_factor" in str(found)
    assert departure(FUSION.task, find_competitor(FUSION, "bptt").maker, None, {"horizon": 50}) is None


@pytest.mark.parametrize("name", ["bptt", "kalman-net"])
def test_a_recording_of_another_sensor_is_outside(name):
    recording = filtergym.record(TARGET.id, "paper", 4, horizon=20, range_sigma=SMALL, bearing_sigma=0.01)
    # Whose deviation is stated with every measurement, and not as a parameter that all is scaled by.
    own = {n: v for n, v in recording.parameters.items() if n not in ("range_sigma", "bearing_sigma")}
    recording = dataclasses.replace(recording, parameters=own)
    found = departure(TARGET.task, find_competitor(TARGET, name).maker, recording, {})
    assert found.share > 0.9
    assert "sigma" in found.field
    assert "% of" in str(found)


def test_who_learned_nothing_departs_from_nothing():
    assert departure(TARGET.task, find_competitor(TARGET, "imm").maker, None, {"range_sigma": SMALL}) is None


def test_the_command_prints_the_departure(success):
    words = ("evaluate", TARGET.id, "--policy", "ppo", "--policy", "imm", "--episodes", 2)
    out = success(*words, "--set", "range_sigma=3")
    assert "ppo: trained with range_sigma 100.0, not 3" in " ".join(out.split())


def test_an_agent_carries_its_envelope_in_its_file(tmp_path):
    file = tmp_path / "ppo.safetensors"
    shutil.copyfile(pretrained_path(TARGET.id, "ppo"), file)
    flown = training_range(TARGET.task, load_policy(TARGET.task, file))
    write_envelope(file, flown.low, flown.high)
    stored = load_policy(TARGET.task, file)
    carried = training_range(TARGET.task, stored)
    assert carried.fields == flown.fields
    np.testing.assert_allclose(carried.low, flown.low, rtol=1e-6, atol=1e-30)
    assert (carried.low <= flown.low).all()
    assert (carried.high >= flown.high).all()
    names = {"carried": file, "ppo": "ppo"}
    cost = filtergym.evaluate(TARGET.id, names, "random", 4)["cost"].values
    np.testing.assert_array_equal(cost[0], cost[1])


class OneField(EnvelopeAlarm):
    """Of one field between zero and one, without a task."""

    def __init__(self):
        self.range, self.columns, self.decisions = TrainingRange(("x",), np.zeros(1), np.ones(1)), [0], 100


def test_the_envelope_speaks_soon_and_not_for_one_value():
    shown = np.full((40, 3), 0.5)
    shown[10, 1] = 2.0  # once
    shown[10:20, 2] = -2.0  # for a while
    alarm, memory, spoken = OneField(), None, []
    for i, row in enumerate(shown):
        heard, memory = alarm.update(row[:, None], memory, np.full(3, i == 0))
        spoken.append(heard)
    spoken = np.array(spoken)
    assert not spoken[:, :2].any()
    assert spoken[12:20, 2].all()
    assert not spoken[20:, 2].any()


def test_what_is_no_number_was_not_seen():
    assert TrainingRange(("x",), np.zeros(1), np.ones(1)).is_outside(np.array([[np.nan]])).all()


def test_an_agent_is_inside_of_its_envelope_in_training_and_outside_of_it_elsewhere():
    """Of episodes that were not flown for it; and with a deviation of the range that is a thirtieth of the usual."""
    maker = find_competitor(TARGET, "bptt").maker
    alarmed = []
    for keywords in ({}, {"range_sigma": SMALL}):
        model = make_model(TARGET.id, maker.control, **keywords)
        alarm = EnvelopeAlarm(model, training_range(TARGET.task, maker))
        policy, seeds = maker(model), episode_seeds("test", 0, 100)
        lanes, state, memory, spoken = start_lanes(model, seeds), None, None, np.zeros(100, dtype=bool)
        for step in range(lanes.decisions_per_episode):
            shown = lanes.observe()
            heard, memory = alarm.update(shown, memory, np.full(100, step == 0))
            spoken |= heard
            action, state = policy.predict(shown, state)
            lanes.decide(action)
        alarmed.append(spoken.mean())
    assert alarmed[0] < 0.1
    assert alarmed[1] > 0.9
