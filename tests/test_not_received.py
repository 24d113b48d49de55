"""What sensors did not receive is NaN to an estimator, in every environment; the shipped ones predict without it."""

import re

import numpy as np
import pytest
from models import make_model

from filtergym import evaluate, record
from filtergym.agents.named_policies import pretrained_agents
from filtergym.baselines.catalogue import baselines_of
from filtergym.envs.contract.companions import trained_banks
from filtergym.envs.contract.task import named_arrays
from filtergym.envs.engine.catalogue import catalogue
from filtergym.evaluation.running.rollout import rollout
from filtergym.evaluation.storage.dataset import notes_of

RADAR = "filtergym/ManeuveringTarget-v0"
UNRELIABLE = {  # scenario, horizon, and what may not be received
    RADAR: ("missed-detections", 40, "position"),
    "filtergym/LooselyCoupledNavigation-v0": ("outage", 400, "fix"),
    "filtergym/RadarEsmTracking-v0": ("random", 40, "bearing_difference"),
    "filtergym/TightlyCoupledNavigation-v0": ("rates-lost", 40, "readings"),
    "filtergym/UavAutopilot-v0": ("random", 80, "reading"),
}


class Watch:
    """Stays where the track starts, and keeps what it is given."""

    def __init__(self):
        self.given = []

    def start(self, initial, N):
        shape = np.eye(len(initial.mean))[:, :, None] + 0.0 * initial.mean[0]
        return initial.mean, shape

    def update(self, memory, measurement):
        self.given.append(measurement)
        return *memory, memory


class Careless:
    """The filter that the README had: two gains, and no thought of a missed scan."""

    def start(self, initial, N):
        return initial.mean, initial.covariance

    def update(self, memory, measurement):
        mean, covariance = memory
        position, velocity = mean[:2] + 6.0 * mean[2:], mean[2:]
        innovation = measurement.position - position
        mean = np.concatenate([position + 0.7 * innovation, velocity + 0.4 / 6.0 * innovation])
        return mean, covariance, (mean, covariance)


class Careful(Careless):
    """The same, with the innovation of a missed scan left out."""

    def update(self, memory, measurement):
        missed = measurement.available == 0
        predicted = memory[0][:2] + 6.0 * memory[0][2:]
        position = np.where(missed, predicted, measurement.position)
        return super().update(memory, measurement._replace(position=position))


def received(task, measurement, field):
    """Whether each value of a field was received, by the other fields of the measurement."""
    there = (
        measurement.available > 0 if hasattr(measurement, "available") else measurement.decision < task.types
    )
    return np.broadcast_to(there, getattr(measurement, field).shape)


CASES = [(id, replayed) for id in UNRELIABLE for replayed in (False, True) if "Uav" not in id or not replayed]
"""A closed loop cannot be replayed."""


@pytest.mark.parametrize(("id", "replayed"), CASES)
def test_what_is_not_received_is_nan(id, replayed):
    scenario, horizon, field = UNRELIABLE[id]
    if replayed:
        model = make_model(id, scenario=record(id, scenario, episodes=4, horizon=horizon))
    else:
        model = make_model(id, scenario=scenario, horizon=horizon)
    watch = Watch()
    for _ in rollout(model, watch, range(4)):
        pass
    values = np.stack([getattr(m, field) for m in watch.given])
    there = np.stack([received(model.task, m, field) for m in watch.given])
    assert 0 < (~there).sum() < there.size
    np.testing.assert_array_equal(np.isnan(values), ~there)
    for m in watch.given:
        others = [values for name, values in named_arrays(m) if name != field]
        assert all(np.isfinite(values).all() for values in others)


def test_an_estimator_that_overlooks_a_missed_scan_is_warned_of():
    sentence = r"not finite after a missed measurement .* in episode \d+ at measurement \d+"
    with pytest.raises(ValueError, match=sentence):
        evaluate(RADAR, {"mine": Careless}, episodes=8, strict=True)
    (note,) = notes_of(evaluate(RADAR, {"mine": Careless}, episodes=8))
    assert re.match(rf"mine: \d of 8 episodes lost: the estimate is {sentence}", note)
    result = evaluate(RADAR, {"mine": Careful}, episodes=8)
    assert np.abs(result["error"].sel(component="position_x")).max() < 10e3  # of a target 50 km away


@pytest.mark.parametrize("id", [id for id in UNRELIABLE if baselines_of(id).estimators])
def test_shipped_estimators_never_use_what_was_not_received(id, monkeypatch):
    """Whether it is NaN or the number that the environment's own filters weigh by zero, the answers have the same
    bits.
    """
    names, (scenario, horizon, _) = [*baselines_of(id).estimators], UNRELIABLE[id]
    names += [name for name in trained_banks(catalogue()[id]) if name in pretrained_agents(id)]
    keywords = {"episodes": 4, "horizon": horizon, "backend": "numpy" if "Tightly" in id else "auto"}
    found = evaluate(id, names, scenario, **keywords)
    monkeypatch.setattr(catalogue()[id].World, "mask_missing", lambda world, measurement: measurement)
    known = evaluate(id, names, scenario, **keywords)
    assert np.isfinite(found["error"].values).all()
    for name in ("error", "nees"):
        np.testing.assert_array_equal(found[name].values, known[name].values)
