"""Disturbances of sensors compose: each takes its own numbers and acts in its turn, and a world runs any of them."""

import types
from typing import NamedTuple

import numpy as np
import pytest
from models import make_model

from filtergym.baselines.maneuvering_target.references import KnownTurn
from filtergym.compiler.functions import leaves
from filtergym.envs.contract.draws import Draws
from filtergym.envs.contract.faults import Disturbance, Disturbances
from filtergym.envs.maneuvering_target import world
from filtergym.envs.maneuvering_target.disturbances import DISTURBANCES
from filtergym.evaluation.competitors.filters import close_loop

ID = "filtergym/ManeuveringTarget-v0"


class Shift(Disturbance):
    """Adds what it has drawn and a normal number."""

    name = "shift"
    initial_normals, normals = 1, 2

    @classmethod
    def is_enabled(cls, parameters):
        return parameters.shifted

    def begin(self, draws, normals, zero):
        return zero + draws.unit("shift") + normals[0]

    def advance(self, state, step):
        return state + step.interval * step.normals[1]

    def change_errors(self, state, errors):
        return errors + state

    def context(self, state):
        return {"shift": state}


class Scale(Disturbance):
    """Multiplies by what it has drawn, and counts the readings that it has changed."""

    name = "scale"
    initial_normals, row_uniforms = 2, 1

    @classmethod
    def is_enabled(cls, parameters):
        return True

    def begin(self, draws, normals, zero):
        return normals[1], 0.0 * zero

    def change_errors(self, state, errors):
        return errors * state[0]

    def change_reading(self, state, reading):
        return (state[0], state[1] + 1.0), -reading

    def change_measurement(self, state, measurement, step):
        return state, measurement + step.uniforms[0] + step.feedback

    def records(self, state):
        return {"changed": state[1]}


def test_each_takes_its_own_numbers_and_acts_in_its_turn():
    task = types.SimpleNamespace(parameters=types.SimpleNamespace(shifted=True), xp=np)
    both = Disturbances.of(task, (Shift, Scale))
    assert (both.initial_normals, both.normals, both.row_uniforms) == (3, 2, 1)
    drawn, start = np.array([[0.25, 0.5]]), np.array([[1.0, 2.0], [3.0, 4.0], [5.0, 6.0]])
    states = both.begin(Draws(drawn, np), start, np.array([100.0, 200.0]))
    np.testing.assert_array_equal(states["shift"], [101.25, 202.5])
    steps = both.split_noise(
        np.array([1.0, 1.0]), 2.0, np.array([[7.0, 7.0], [8.0, 9.0]]), np.array([[0.1, 0.2]]), 10.0
    )
    states = both.advance(states, steps)
    np.testing.assert_array_equal(both.context(states)["shift"], [117.25, 220.5])
    errors = both.change_errors(states, np.array([1.0, 1.0]))
    np.testing.assert_array_equal(errors, [118.25 * 5.0, 221.5 * 6.0])
    states, reading = both.change_reading(states, np.array([1.0, 2.0]))
    np.testing.assert_array_equal(reading, [-1.0, -2.0])
    np.testing.assert_array_equal(both.records(states)["changed"], [1.0, 1.0])
    _, measurement = both.change_measurement(states, np.array([1.0, 2.0]), steps)
    np.testing.assert_array_equal(measurement, [11.1, 12.2])
    task.parameters.shifted = False
    assert [part.name for part in Disturbances.of(task, (Shift, Scale)).parts] == ["scale"]


class Held(NamedTuple):
    number: np.ndarray
    reading: np.ndarray


class Frozen(Disturbance):
    """Repeats the reading of every fourth scan until the next fourth."""

    name = "frozen"
    row_uniforms = 1

    @classmethod
    def is_enabled(cls, parameters):
        return True

    def begin(self, draws, normals, zero):
        return Held(zero, self.xp.stack([zero, zero]))

    def advance(self, state, step):
        return state._replace(number=step.number)

    def change_reading(self, state, reading):
        fresh = state.number - 4.0 * self.xp.floor(state.number / 4.0) == 1.0
        reading = self.xp.where(fresh, reading, state.reading)
        return state._replace(reading=reading), reading


@pytest.mark.parametrize("backend", ["numpy", "compiled"])
def test_a_world_runs_a_further_one_that_stands_in_its_list(backend, monkeypatch):
    """The others take the numbers that they took without it."""
    if backend == "compiled":
        pytest.importorskip("llvmlite")
    settings = {"scenario": "random", "glint_probability": 0.2, "bias": 1.0, "horizon": 6}
    plain = make_model(ID, **settings)
    monkeypatch.setattr(world, "DISTURBANCES", (*DISTURBANCES, Frozen))
    model = make_model(ID, **settings, backend=backend)
    assert model.task.noise.row_uniforms == plain.task.noise.row_uniforms + 1
    rng, layout = np.random.default_rng(0), plain.task.noise
    start = rng.random((layout.uniforms, 8)), rng.normal(size=(layout.initial_normals, 8))
    one, other, frozen = plain.begin(*start), model.begin(*start), 0
    for k in range(1, 7):
        row = np.concatenate([rng.normal(size=(layout.normals, 8)), rng.random((layout.row_uniforms, 8))])
        one, other = plain.measure(one, row), model.measure(other, np.concatenate([row, row[:1]]))
        for name, state in one.truth.disturbances.items():
            np.testing.assert_allclose(
                np.vstack(leaves(state)), np.vstack(leaves(other.truth.disturbances[name])), atol=1e-12
            )
        there = one.measurement.available > 0.0
        same = (abs(one.measurement.position - other.measurement.position) < 1e-6).all(axis=0)
        assert (same[there] == (k % 4 == 1)).all()
        frozen += (~same).sum()
        zero = np.zeros((len(plain.action_space.low), 8))
        one, other = plain.act(one, zero), model.act(other, zero)
    assert frozen > 20


def test_a_reference_that_does_not_know_what_may_happen_is_refused(monkeypatch):
    monkeypatch.setattr(world, "DISTURBANCES", (*DISTURBANCES, Frozen))
    with pytest.raises(
        ValueError, match="'known-turn' does not know the disturbance 'frozen' of filtergym/Man"
    ):
        close_loop(make_model(ID), KnownTurn, "reference", "known-turn", 1)
