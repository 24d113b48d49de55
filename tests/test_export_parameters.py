"""Parameters of exported C: what is set when a track starts is what the filter has that is made with it."""

import subprocess

import numpy as np
import pytest
from own_models import make_models
from test_exports_c import built

from filtergym.baselines.problem import problem_of
from filtergym.compiler.c_text import DOUBLE, FLOAT
from filtergym.compiler.functions import map_arrays
from filtergym.envs.contract.parameters import freeze
from filtergym.envs.engine.backend import make_model
from filtergym.evaluation.competitors.filters import as_filter
from filtergym.evaluation.running.evaluate import control_of
from filtergym.evaluation.running.rollout import start_lanes
from filtergym.evaluation.running.seeds import episode_seeds
from filtergym.exports.c_source import Writer, export_c
from filtergym.exports.replay import replay, run_filter
from filtergym.exports.request import request_export
from filtergym.exports.traced_filter import FilterSteps, trace_filter
from filtergym.names import find_competitor

SETS, MEASUREMENTS = 200, 12
DRIVER = """#include <stdio.h>
#include <string.h>
#include "rows.h"
#include "vectors.h"

/* Reads sets of parameters, and writes for each what start returns, and the estimates of the first track. */
int main(int argc, char **argv) {{
    static {own}_state state, before;
    {own}_parameters parameters;
    {own}_initial initial;
    set_initial(&initial, initials[0]);
    memset(&state, 7, sizeof state);
    while (fread(&parameters, sizeof parameters, 1, stdin) == 1) {{
        double status;
        int k;
        before = state;
        status = {own}_start(&state, &initial, argc > 1 ? NULL : &parameters);
        fwrite(&status, sizeof status, 1, stdout);
        if (status != {upper}_TAKEN) {{
            if (memcmp(&state, &before, sizeof state) != 0) return 1;
            continue;
        }}
        for (k = 0; k < MEASUREMENTS; ++k) {{
            {own}_measurement measurement;
            {own}_estimate estimate;
            set_measurement(&measurement, measurements[k]);
            if ({own}_update(&state, &measurement, &estimate) >= {upper}_REJECTED) return 2;
            fwrite(&estimate, sizeof estimate, 1, stdout);
        }}
    }}
    (void)argv;
    return 0;
}}
"""


@pytest.fixture
def state_space():
    yield from make_models({})


class Exported:
    """A competitor as C, compiled with the sanitizers, and what it is given."""

    def __init__(self, folder, problem, name, scalar=DOUBLE):
        self.problem, self.name, self.scalar = problem, name, scalar
        self.maker = find_competitor(problem, name).maker
        self.request = request_export(problem, name)
        self.traced, self.given = replay(self.request, 1, MEASUREMENTS)
        writer = Writer(name, self.traced, scalar, self.given.components)
        own = DRIVER.format(own=writer.name, upper=writer.name.upper())
        self.driver = built(folder, writer, self.given, own)
        self.header = (folder / f"{writer.name}.h").read_text()

    @property
    def declared(self):
        return self.traced.free.declared

    def answers(self, rows, *arguments):
        """Statuses of sets ``(S, numbers)``, and estimates ``(sets that are taken, T, numbers)``."""
        given = np.asarray(rows, dtype=self.scalar.dtype).tobytes()
        output = subprocess.run(
            [self.driver, *arguments], input=given, capture_output=True, check=True
        ).stdout
        statuses, estimates, size = [], [], len(self.traced.estimate)
        while output:
            statuses.append(np.frombuffer(output[:8])[0])
            output = output[8:]
            if statuses[-1] == 0.0:
                count = MEASUREMENTS * size * self.scalar.dtype().itemsize
                estimates.append(
                    np.frombuffer(output[:count], dtype=self.scalar.dtype).reshape(MEASUREMENTS, size)
                )
                output = output[count:]
        return np.array(statuses), np.array(estimates)

    def structure(self, template, rows):
        """Nested tuples of arrays ``(..., SETS)`` like others, of these numbers."""
        at = iter(rows)

        def leaf(array):
            shape = np.shape(array)[:-1]
            values = [next(at) for _ in range(int(np.prod(shape, dtype=int)))]
            return np.reshape(values, (*shape, 1)) * np.ones(SETS)

        return map_arrays(leaf, template)

    def in_lanes(self, values):
        """Estimates ``(SETS, T, numbers)`` of the filter with values ``(SETS,)`` each, side by side in NumPy."""
        tunable = self.problem.baselines.tunable[self.name.removesuffix("-tuned")]
        keywords, make = tunable.apply(values)
        model = make_model(self.problem.task, **keywords)
        own = as_filter(model.task, make(model.task))
        steps, started = FilterSteps(own, model.task.world.mask_missing), []
        seeds = episode_seeds("test", 0, 1)
        lanes = start_lanes(model, seeds, lambda episode: started.append(episode.measurement))
        state = own.start(self.structure(started[0], self.given.initial[:, 0]))
        found = []
        for row in self.given.measurements[:, :, 0]:
            state, records = steps.update(state, self.structure(lanes.state.measurement, row))
            found.append(np.concatenate([np.reshape(part, (-1, SETS)) for part in records.values()]))
        return np.moveaxis(np.array(found), -1, 0)

    def made_anew(self, keywords):
        """Estimates ``(T, numbers)`` of the filter with other parameters of the task."""
        control = control_of(self.maker, None, self.problem.task, self.name)
        own = getattr(self.maker, "task_keywords", {})
        plain = make_model(self.problem.task, control, **{**own, **keywords})
        started, seeds = [], episode_seeds("test", 0, 1)
        lanes = start_lanes(plain, seeds, lambda episode: started.append(episode.measurement))
        template = started[0], lanes.state.measurement
        traced = trace_filter(self.problem.task, control, self.maker, self.name, plain, template)
        return run_filter(traced, self.given)[:, :, 0]


def check_alike(found, expected, rtol=1e-7):
    scale = np.abs(expected).max(axis=(0, 1)) if found.ndim == 3 else np.abs(expected).max(axis=0)
    np.testing.assert_allclose(found, expected, rtol=rtol, atol=rtol * 1e-2 * np.nanmax(scale))


@pytest.mark.parametrize(
    ("environment", "name"),
    [
        ("ManeuveringTarget", "kalman-imm-turn"),
        ("LooselyCoupledNavigation", "augmented-sage-husa"),
        ("UavAutopilot", "gust-imm"),
    ],
)
def test_a_set_at_the_start_of_a_track_is_the_filter_made_with_it(environment, name, tmp_path):
    exported = Exported(tmp_path, problem_of(f"filtergym/{environment}-v0"), name)
    check_200_sets(exported)


def check_200_sets(exported):
    tuned = exported.problem.baselines.tunable[exported.name].limits
    assert {one.name for one in exported.declared} >= tuned.keys()
    usual = np.array(exported.traced.free.values)
    names = [one.name for one in exported.declared for _ in one.values]
    chosen = np.tile(usual, (SETS, 1))
    rng = np.random.default_rng(0)
    for name, (low, high) in tuned.items():
        chosen[:, names.index(name)] = rng.uniform(low, high, SETS)
    statuses, found = exported.answers(chosen)
    assert not statuses.any()
    check_alike(found, exported.in_lanes({name: chosen[:, names.index(name)] for name in tuned}))


def test_parameters_of_a_model_of_ones_own(state_space, tmp_path):
    walk = state_space(
        f=lambda x: [x[0] + x[1], x[1] - 0.1 * x[0] ** 3], h=lambda x: [x[0]], Q=[[0.01, 0.0], [0.0, 0.1]], R=[[1.0]],
        mean=[0.0, 0.0], covariance=[[1.0, 0.0], [0.0, 1.0]],
    )  # fmt: skip
    exported = Exported(tmp_path, problem_of(walk.id), "extended")
    check_200_sets(exported)
    assert "Decimal logarithm: process noise. Default 0, from -4 to 4." in exported.header


@pytest.mark.parametrize(
    ("environment", "name", "changed"),
    [
        ("ManeuveringTarget", "adaptive", ["gains", "alpha_range", "sampling_interval"]),
        ("LooselyCoupledNavigation", "time-varying", ["coloured", "white_intensity"]),
        pytest.param("RadarEsmTracking", "exact-bayes-9", ["esm_bearing_sigma"], marks=pytest.mark.slow),
        pytest.param(
            "TightlyCoupledNavigation", "singer", ["singer_alpha", "rate_sigma"], marks=pytest.mark.slow
        ),
    ],
)
def test_parameters_of_the_task(environment, name, changed, tmp_path):
    exported = Exported(tmp_path, problem_of(f"filtergym/{environment}-v0"), name)
    own = {one.name: one for one in exported.declared}
    keywords = {key: freeze(1.03 * np.reshape(own[key].values, own[key].shape)) for key in changed}
    (status,), (found,) = exported.answers([row_of(exported, keywords)])
    assert status == 0.0
    check_alike(found, exported.made_anew(keywords))
    assert not np.array_equal(found, exported.answers([exported.traced.free.values])[1][0])


def row_of(exported, keywords):
    assert keywords.keys() <= {one.name for one in exported.declared}
    return np.concatenate([np.ravel(keywords.get(one.name, one.values)) for one in exported.declared])


@pytest.mark.parametrize("scalar", [DOUBLE, FLOAT])
def test_what_is_outside_the_limits_leaves_the_state_alone(scalar, tmp_path):
    exported = Exported(tmp_path, problem_of("filtergym/ManeuveringTarget-v0"), "imm-steady-state", scalar)
    usual, refused, at = np.array(exported.traced.free.values), [], 0
    for one in exported.declared:
        for wrong in (
            one.low - 1e-3 - 1e-3 * abs(one.low),
            one.high * 1.001 if one.high < 1e38 else np.inf,
            np.nan,
        ):
            refused.append(usual.copy())
            refused[-1][at + len(one.values) - 1] = wrong
        at += len(one.values)
    # Each number is within its limits, and the row does not sum to one.
    refused.append(row_of(exported, {"transition": ((0.9, 0.05), (0.1, 0.9))}))
    statuses, _ = exported.answers(refused)
    assert (statuses == 3.0).all()  # the driver fails where the state changes
    statuses, given = exported.answers([usual])
    _, none = exported.answers([usual], "NULL")
    assert statuses == 0.0
    if scalar is DOUBLE:
        assert np.array_equal(given, none, equal_nan=True)
    else:  # what is derived in float is not quite what was derived in double
        check_alike(given, none, 1e-3)


@pytest.mark.parametrize("name", ["kalman-imm-turn", "kalman-imm-tuned", "imm", "semi-markov-3"])
def test_without_a_choice_the_bits_are_those_of_the_filter(name, tmp_path):
    exported = Exported(tmp_path, problem_of("filtergym/ManeuveringTarget-v0"), name)
    _, (found,) = exported.answers([exported.traced.free.values], "NULL")
    expected = exported.made_anew({})
    mine = run_filter(exported.traced, exported.given)[:, :, 0]
    assert np.array_equal(mine, expected, equal_nan=True)
    check_alike(found, expected, 1e-10)


def test_what_cannot_be_set_is_named(tmp_path):
    problem = problem_of("filtergym/UavAutopilot-v0")
    export_c(request_export(problem, "mehra"), tmp_path)
    text = " ".join((tmp_path / "mehra.h").read_text().split())
    assert "Parameters: this filter has none." in text
    assert "Constant here" in text
    assert "window, " in text
