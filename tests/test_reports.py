"""Reports of a measurement (stated noise, times, what was received) must not show which hidden disturbances an episode
has: their distribution is compared between the episodes with and without each of them.
"""

import numpy as np
import pytest
from scipy import stats

from filtergym.envs.contract import draws
from filtergym.envs.engine.backend import make_model
from filtergym.envs.engine.catalogue import catalogue

REPORTS = {
    "LooselyCoupledNavigation": lambda m, truth: [m.reported_deviation, m.available],
    "ManeuveringTarget": lambda m, truth: [m.interval, m.elapsed, m.available],
    "UavAutopilot": lambda m, truth: [*m.available, m.command],
    # A second emitter is heard in silences of the target, so emissions of the target stand for what is heard.
    "RadarEsmTracking": lambda m, truth: [m.looked, truth.radiating],
    "TightlyCoupledNavigation": lambda m, truth: [*m.available, *m.cn0],
}
"""What a measurement reports, by environment: all that is no reading."""
SOONER = {
    "LooselyCoupledNavigation": {"outage_start": (0.0, 0.05), "change_start": (0.0, 0.05)},
    "RadarEsmTracking": {"esm_period": 1},
    "TightlyCoupledNavigation": {"horizon": 60},
    "UavAutopilot": {"dropout_period": 30},
}
"""Parameters that bring events of ``random`` into the first measurements."""
SEEN = {"urban", "hidden", "no_rates", "aperture", "outage"}
"""Events that change what the sensors receive: between houses C/N0 falls, in an outage nothing arrives."""
SHIPPED = [cls for id, cls in catalogue().items() if id.startswith("filtergym/")]
EPISODES, MEASUREMENTS = 2000, 3
LEAST = 200
"""Episodes of a kind from which on it is compared."""
SIGNIFICANT = 1e-7
"""Some 2,000 comparisons in all: one in 5,000 runs of other seeds fails by chance."""


def simulate(cls, scenario, monkeypatch, **keywords):
    """Hidden events by name, and the reports of the first measurements, one row each."""
    made = []

    class Kept(draws.Draws):
        def __init__(self, *arguments):
            super().__init__(*arguments)
            made.append(self)

    monkeypatch.setattr("filtergym.envs.contract.model.Draws", Kept)
    model = make_model(cls, scenario=scenario, **keywords)
    rng, noise = np.random.default_rng(5), model.task.noise
    start = rng.random((noise.uniforms, EPISODES)), rng.standard_normal((noise.initial_normals, EPISODES))
    episode, rows = model.begin(*start), []
    events = {
        f"{name} {place}": one
        for name, values in made[-1].drawn.items()
        if values.dtype == bool and name not in SEEN
        for place, one in enumerate(np.atleast_2d(values))
        if LEAST <= one.sum() <= EPISODES - LEAST
    }
    for _ in range(MEASUREMENTS if events else 0):
        row = [rng.standard_normal((noise.normals, EPISODES)), rng.random((noise.row_uniforms, EPISODES))]
        episode = model.measure(episode, np.concatenate(row))
        rows += REPORTS[cls.__name__](episode.measurement, episode.truth)
        episode = model.act(episode, np.zeros((*model.action_space.shape, EPISODES)))
    return events, [np.asarray(row, dtype=float) for row in rows]


def differences(events, rows):
    """Comparisons that are significant: event, number of the report, and the probability of such a difference."""
    found, compared = [], 0
    for name, event in events.items():
        for number, row in enumerate(rows):
            compared += 1
            probability = stats.ks_2samp(row[event], row[~event], method="asymp").pvalue
            # A value of its own: one number that is usual in one kind of episode only.
            (values, counts) = np.unique(row, return_counts=True)
            usual = row == values[counts.argmax()]
            table = [[(usual & kind).sum(), (~usual & kind).sum()] for kind in (event, ~event)]
            if 0 < usual.sum() < EPISODES:
                probability = min(probability, stats.fisher_exact(table).pvalue)
            if probability < SIGNIFICANT:
                found.append((name, number, probability))
    return found, compared


@pytest.mark.parametrize("cls", SHIPPED, ids=lambda cls: cls.__name__)
def test_reports_have_one_law_whatever_is_hidden(cls, monkeypatch):
    compared = 0
    for scenario in cls.scenarios:
        sooner = SOONER.get(cls.__name__, {}) if scenario == "random" else {}
        found, count = differences(*simulate(cls, scenario, monkeypatch, **sooner))
        assert not found, scenario
        compared += count
    assert compared >= MEASUREMENTS


def test_a_value_that_only_one_kind_of_episode_reports_is_found():
    rng = np.random.default_rng(0)
    calm = rng.random(EPISODES) < 1 / 6
    row = rng.uniform(1.0, 3.0, EPISODES)
    assert not differences({"calm": calm}, [row])[0]
    assert differences({"calm": calm}, [np.where(calm, 2.0, row)])[0]
