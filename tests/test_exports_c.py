"""Filters as C99: they are what was judged, compile without a warning, and nothing gets in that is no number."""

import io
import json
import re
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from filtergym import evaluate
from filtergym.agents.learned_policy import LearnedPolicy
from filtergym.baselines.problem import problem_of
from filtergym.compiler import c_source as compiler_source
from filtergym.envs.contract.filter import Initial
from filtergym.envs.tightly_coupled_navigation.banks import HypothesisBank
from filtergym.evaluation.competitors.programs import Program
from filtergym.exports import c_source
from filtergym.exports.c_filter import file_stem
from filtergym.exports.c_source import FLAGS, Writer, compile_and_test, export_c, files_of
from filtergym.exports.replay import mean_rows, replay, run_filter
from filtergym.exports.request import ExportRequest, request_export
from filtergym.filters import kalman
from filtergym.names import find_competitor

EVIL = 'x */ #include "/etc/passwd" \n// \\ ??/ "; system("true"); /* µ\u202e'
SANITIZERS = ("-O0", "-fsanitize=address,undefined", "-fno-sanitize-recover=all")


def replayed(environment, name, keywords=None, scenario=None, **options):
    problem = problem_of(f"filtergym/{environment}-v0")
    maker = name if not isinstance(name, str) else find_competitor(problem, name).maker
    return replay(ExportRequest(problem, str(name), maker, scenario, keywords or {}), **options)


# --- programs


@pytest.mark.parametrize(
    ("environment", "name", "keywords"),
    [
        ("ManeuveringTarget", "kalman-net", {}),
        ("ManeuveringTarget", "gated:ppo", {}),
        ("LooselyCoupledNavigation", "time-varying", {"decision_interval": 5}),
        ("UavAutopilot", "raw-sensors", {}),
        ("UavAutopilot", "ppo", {"decision_interval": 3}),
        ("UavAutopilot", "mehra", {}),  # a window that moves is traced in a few rounds
    ],
)
def test_programs_of_a_filter_answer_what_it_answers(environment, name, keywords):
    traced, given = replayed(environment, name, keywords=keywords, episodes=8, measurements=20)
    found = run_filter(traced, given)
    # A sum in another order is all that may differ.
    assert given.largest_difference(found[:, mean_rows(traced)]) < 1e-11
    C = given.mean.shape[1]
    covariance = found[:, C : C + C * C].reshape(len(found), C, C, -1)
    np.testing.assert_allclose(covariance, given.covariance, rtol=1e-7, atol=1e-9)


class Symmetric:
    """An estimator whose memory holds numbers twice, constants, and unread values."""

    kind, traceable = "estimator", True

    def __init__(self, task):
        self.xp = task.xp

    def start(self, initial, N):
        own = initial.covariance[0, 0]
        zero = 0.0 * own
        return {
            "P": self.xp.stack([own, zero, zero, own]),
            "counted": zero,
            "of": zero + 2.0,
            "apart": (own, own),
        }

    def update(self, memory, measurement):
        P = 0.5 * memory["P"] + memory["of"]
        first, second = memory["apart"]
        mean = self.xp.stack([P[0], P[3], first, second])
        covariance = self.xp.eye(4)[:, :, None] * (1.0 + 0.0 * mean)
        apart = (first + measurement.interval, second + 2.0 * measurement.interval)
        after = {
            "P": P - P[1] * self.xp.asarray([[0.0], [1.0], [0.0], [0.0]]),
            "counted": memory["counted"] + 1.0,
        }
        return mean, covariance, after | {"of": memory["of"], "apart": apart}


def test_a_state_keeps_each_number_once_and_nothing_that_is_never_read():
    traced, given = replayed("ManeuveringTarget", Symmetric, episodes=2, measurements=5)
    assert [(member.name, member.place) for member in traced.state] == [
        ("memory_P", 0),
        ("memory_apart_0", 0),
        ("memory_apart_1", 0),
    ]
    # Deviations are one, means some ten thousand: the last bit.
    assert given.largest_difference(run_filter(traced, given)[:, mean_rows(traced)]) < 1e-11


@pytest.mark.parametrize(
    ("name", "sentence"),
    [
        ("known-turn", "of kind reference: only estimators and policies can be exported"),
        ("imm-smoother", "of kind smoother"),
        ("random", "no straight line of array arithmetic .its actions are drawn"),
    ],
)
def test_what_cannot_be_exported_is_refused_by_name(name, sentence):
    with pytest.raises(ValueError, match=f"'{name}'.*{sentence}"):
        replayed("ManeuveringTarget", name, episodes=1, measurements=1)


def test_an_estimator_in_python_is_refused(monkeypatch):
    monkeypatch.setattr(Symmetric, "traceable", False)
    with pytest.raises(ValueError, match=r"cannot be exported.*does not set traceable"):
        replayed("ManeuveringTarget", Symmetric, episodes=1, measurements=1)


# --- C


def test_what_float_does_not_hold_normally_is_beyond_it():
    tiny, largest = (float(getattr(np.finfo(np.float32), name)) for name in ("tiny", "max"))
    for size, beyond in (
        (0.0, False),
        (tiny, False),
        (0.5 * tiny, True),
        (largest, False),
        (1.1 * largest, True),
    ):
        for value in (size, -size):
            assert compiler_source.is_beyond(value, c_source.FLOAT) == beyond, value
            assert not compiler_source.is_beyond(value, c_source.DOUBLE), value


def writer_of(environment, name, scalar=c_source.DOUBLE, **options):
    traced, given = replayed(environment, name, episodes=3, measurements=30, **options)
    return Writer(str(name), traced, scalar, given.components), given


def compiler():
    found = shutil.which("cc")
    if found is None:
        pytest.skip("no C compiler here")
    return found


def built(folder, writer, given, program="", flags=SANITIZERS):
    """Write the files of a filter, and a program of its own in place of theirs; compile it and return its path."""
    for file, text in {**files_of(writer, given), **({"main.c": program} if program else {})}.items():
        (folder / file).write_text(text, encoding="ascii")
    words = [compiler(), *FLAGS, *flags, "main.c", f"{writer.name}.c", "-lm", "-o", "run"]
    subprocess.run(words, cwd=folder, check=True)
    return folder / "run"


@pytest.mark.parametrize(
    ("environment", "name", "scalar"),
    [
        ("ManeuveringTarget", "sage-husa", c_source.DOUBLE),
        ("LooselyCoupledNavigation", "ppo", c_source.FLOAT),
        ("UavAutopilot", "bptt", c_source.DOUBLE),
    ],
)
def test_c_compiles_without_a_warning_and_answers_what_the_filter_answers(
    environment, name, scalar, tmp_path
):
    writer, given = writer_of(environment, name, scalar)
    output = compile_and_test(writer, given, compiler(), (*FLAGS, "-O0"))
    # Measured 4e-13 of all agents, their networks in double; the other figure is that of float.
    assert float(output.split()[2]) < (1e-9 if scalar is c_source.DOUBLE else 1e-2)
    program = built(tmp_path, writer, given)
    table = subprocess.run([program, "measurements.csv"], cwd=tmp_path, check=True, capture_output=True)
    estimates = pd.read_csv(io.BytesIO(table.stdout))
    assert estimates[["track", "measurement"]].iloc[-1].tolist() == [3, 30]
    own = estimates.filter(like="estimate_").to_numpy().reshape(3, 30, -1)
    assert given.largest_difference(np.moveaxis(own, 0, -1)) < 1e-2
    sigma = estimates.filter(like="sigma_").to_numpy().reshape(3, 30, -1)
    np.testing.assert_allclose(np.moveaxis(sigma, 0, -1), given.sigma, rtol=1e-3)
    # The same program; a table has nine digits of a float.
    np.testing.assert_allclose(converse(program, given), np.moveaxis(own, 0, -1), rtol=1e-8)


def converse(program, given):
    """Means ``(T, C, E)`` that a program answers in the protocol of a competitor, docs/programs.md."""
    T, C, E = given.mean.shape
    numbers = {"initial": len(given.initial), "measurement": given.measurements.shape[1], "answer": C + C * C}
    hello = {
        "filtergym": 1,
        "tracks": E,
        "numbers": numbers,
        "environment": 3000 * "x",
    }  # longer than its buffer
    rows = [given.initial.T, *np.moveaxis(given.measurements, -1, 1)]
    frames = b"".join(np.ascontiguousarray(row, dtype="<f8").tobytes() for row in rows)
    spoken = json.dumps(hello).encode() + b"\n"
    output = subprocess.run([program], input=spoken + frames, capture_output=True, check=True).stdout
    answer, _, content = output.partition(b"\n")
    assert json.loads(answer) == {"filtergym": 1, "format": "float64"}
    refused = subprocess.run(
        [program], input=spoken.replace(b": 1,", b": 2,"), capture_output=True, check=False
    )
    assert "exported from another" in json.loads(refused.stdout)["error"]
    return np.moveaxis(np.frombuffer(content, dtype="<f8").reshape(T, E, -1)[..., :C], 1, -1)


@pytest.mark.parametrize(
    ("environment", "name", "scenario", "keywords"),
    [
        # 1e13 m away
        ("LooselyCoupledNavigation", "plain-reduced", "random", {"manoeuvre_rate": (1e-6, 1e-6)}),
        ("ManeuveringTarget", "kalman-imm", "glint", {"glint_factor": 1e3, "range_sigma": 1e-6}),
    ],
)
def test_at_the_ends_of_parameters_c_differs_by_the_last_digit(environment, name, scenario, keywords):
    keywords = {"horizon": 30, **keywords}
    traced, given = replayed(environment, name, keywords, scenario, episodes=2, measurements=12)
    largest = max(np.nanmax(np.abs(given.measurements)), np.abs(given.mean).max())
    writer = Writer(name, traced, c_source.DOUBLE, given.components)
    writer.limit = 1e-8 + 4.0 * np.spacing(largest) / given.sigma.min()
    compile_and_test(writer, given, compiler())  # which fails beyond that


@pytest.mark.parametrize(
    ("environment", "name", "scenario", "horizon"),
    [
        ("UavAutopilot", "bptt-small", None, 120),  # is shown readings that sensors hold in dropouts
        # Bearings are given where an emitter is heard.
        ("RadarEsmTracking", "forgetting-joint-type", None, 60),
    ],
)
def test_an_exported_policy_competes_as_what_it_was(environment, name, scenario, horizon, tmp_path):
    own, program = costs_of(environment, name, tmp_path, scenario, horizon=horizon)
    np.testing.assert_allclose(program, own, rtol=1e-9)


def costs_of(environment, name, folder, scenario=None, **keywords):
    """Costs of the episodes of a policy, and of the program that it is exported as, ``(2, episodes)``."""
    problem = problem_of(f"filtergym/{environment}-v0")
    export_c(request_export(problem, name, scenario, **keywords), folder)
    words = [compiler(), "-std=c99", "-O0", "main.c", f"{file_stem(name)}.c", "-lm", "-o", "run"]
    subprocess.run(words, cwd=folder, check=True)
    both = {"own": name, "program": Program(str(folder / "run"))}
    found = evaluate(problem.id, both, scenario, 16, backend="numpy", **keywords)
    assert not np.nan_to_num(found["lost"]).any()
    return found["cost"].mean("time").values


@pytest.mark.slow
def test_an_exported_bank_steers_the_tracking_loops(tmp_path, monkeypatch):
    """From its first answer on; before it they follow the initial estimate, here of both."""
    feedback = HypothesisBank.feedback

    def after_the_start(self, state, measurement):
        return None if isinstance(measurement, Initial) else feedback(self, state, measurement)

    monkeypatch.setattr(HypothesisBank, "feedback", after_the_start)
    keywords = {"aperture_probability": 1.0, "rate_aperture": 2.0, "horizon": 60}
    own, program = costs_of("TightlyCoupledNavigation", "multi-hypothesis", tmp_path, **keywords)
    np.testing.assert_allclose(program, own, rtol=1e-9)
    # The loops lose rates here: by the estimate alone others, and the costs are others.
    monkeypatch.setattr(HypothesisBank, "feedback", lambda *given: None)
    name = "multi-hypothesis"
    other = evaluate("filtergym/TightlyCoupledNavigation-v0", name, None, 16, backend="numpy", **keywords)
    (other,) = other["cost"].mean("time").values
    assert np.abs(other / own - 1.0).max() > 1e-3


class OwnNetwork:
    """Makes a network with random weights."""

    kind = "policy"

    def __init__(self, control, unit, output, activation, answers):
        self.control, self.output, self.activation = control, output, activation
        rng = np.random.default_rng(0)
        fields, units = 14, 5
        gates = {"gru": 3, "lstm": 4}.get(unit, 0) * units
        shapes = {
            "weight_0": (6, units if unit else fields),
            "bias_0": (6,),
            "weight_1": (answers, 6),
            "bias_1": (answers,),
        }
        if unit:
            shapes |= {f"{unit}_input_weight": (gates, fields), f"{unit}_input_bias": (gates,)}
            shapes |= {f"{unit}_memory_weight": (gates, units), f"{unit}_memory_bias": (gates,)}
        arrays = {name: 0.5 * rng.normal(size=shape) for name, shape in shapes.items()}
        arrays |= {
            "observation_mean": rng.normal(size=fields),
            "observation_scale": rng.uniform(0.5, 2.0, fields),
        }
        self.arrays = {name: values.astype(np.float32) for name, values in arrays.items()}

    def __call__(self, model):
        fields = [field.name for field in model.fields][:14]
        return LearnedPolicy(model, self.arrays, self.output, self.activation, fields)


@pytest.mark.parametrize(
    "own", [("gain", "lstm", "clip", "relu", 1), ("mode", "", "argmax", "tanh", 2)], ids=["lstm", "argmax"]
)
def test_networks_of_every_form_are_written(own):
    writer, given = writer_of("ManeuveringTarget", OwnNetwork(*own))
    assert given.largest_difference(run_filter(writer.traced, given)[:, mean_rows(writer.traced)]) < 1e-11
    compile_and_test(writer, given, compiler(), (*FLAGS, *SANITIZERS))


REJECTION = """#include <math.h>
#include <string.h>
#include "rows.h"
#include "vectors.h"
int main(void) {{
    static {own}_state state, before;
    {own}_initial initial;
    {own}_measurement measurement;
    {own}_estimate estimate;
    set_initial(&initial, initials[0]);
    {own}_start(&state, &initial, NULL);
    before = state;
    set_measurement(&measurement, measurements[0]);
    measurement.position[1] = NAN;
    if ({own}_update(&state, &measurement, &estimate) != {upper}_REJECTED) return 1;
    if (memcmp(&state, &before, sizeof state) != 0) return 2;
    set_measurement(&measurement, measurements[0]);
    if ({own}_update(&state, &measurement, &estimate) != {upper}_TAKEN) return 3;
    return memcmp(&state, &before, sizeof state) != 0 ? 0 : 4;
}}
"""


def test_a_measurement_that_makes_the_estimate_no_number_leaves_the_state_alone(tmp_path):
    writer, given = writer_of("ManeuveringTarget", "kalman-imm")
    own = REJECTION.format(own=writer.name, upper=writer.name.upper())
    assert subprocess.run([built(tmp_path, writer, given, own)], check=False).returncode == 0


def test_a_table_of_another_form_is_refused(tmp_path):
    writer, given = writer_of("ManeuveringTarget", "fixed-low")
    program = built(tmp_path, writer, given)
    header, first, *_ = (tmp_path / "measurements.csv").read_text().splitlines()
    for table, sentence in (
        ("x,y\n1,2\n", "the first line must be initial_mean_0"),
        (f"{header}\n1,2\n", "line 2 must have"),
        (f"{header}\n{',' * header.count(',')}\n", "must begin a track"),
        ("", "the first line must be"),
    ):
        done = subprocess.run([program], input=table, capture_output=True, text=True, check=False)
        assert done.returncode == 2
        assert sentence in done.stderr
    windows = subprocess.run(
        [program], input=f"{header}\r\n{first}\r\n\r\n", capture_output=True, text=True, check=True
    )
    assert len(windows.stdout.splitlines()) == 2


def test_the_program_of_the_page_follows_a_track(tmp_path):
    page = (Path(__file__).parent.parent / "docs" / "device.md").read_text(encoding="utf-8")
    own = re.search(r"```c\n(.*?)```", page, re.DOTALL)[1]
    writer, given = writer_of("ManeuveringTarget", "kalman-imm-tuned")
    program = built(tmp_path, writer, given, own, ["-O0"])
    plots = "".join(f"{6 * k},{40000 - 900 * k},{12000 + 120 * k}\n" for k in range(1, 20))
    done = subprocess.run([program], input=plots, capture_output=True, text=True, check=True)
    last = [float(x) for x in re.findall(r"-?[\d.]+(?= m)", done.stdout.splitlines()[-1])]
    np.testing.assert_allclose(last, [40000 - 900 * 19, 12000 + 120 * 19, -150.0, 20.0], rtol=0.02)


class Stranger:
    """Filter */ #include "/etc/passwd"."""

    kind, traceable = "estimator", True

    def __init__(self, task):
        self.task = task
        self.H = task.constant([[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0]])

    def start(self, initial, N):
        return {EVIL: initial.mean, "int": initial.covariance, "": 0.0 * initial.mean[0]}

    def update(self, memory, measurement):
        mean, covariance, _ = memory.values()
        R = self.task.constant([[1.0, 0.0], [0.0, 1.0]])[:, :, None] * measurement.variance
        there = measurement.available > 0.0
        updated = kalman.update(mean, covariance, measurement.position, self.H, R)
        after = Initial(
            *(self.task.xp.where(there, a, b) for a, b in zip(updated[:2], (mean, covariance), strict=True))
        )
        count = memory[""] + 1.0
        return (
            after.mean + 0.0 * count,
            after.covariance,
            {EVIL: after.mean, "int": after.covariance, "": count},
        )


def test_a_strangers_words_cannot_get_into_the_text(tmp_path):
    problem = problem_of("filtergym/ManeuveringTarget-v0")
    request = ExportRequest(problem, EVIL, Stranger, keywords={"range_sigma": 50.0})
    traced, given = replay(request, episodes=1, measurements=5)
    named = given._replace(components=[(EVIL, EVIL), ("for", "*/"), ("", "\\"), ("1", "??/")])
    writer = Writer(EVIL, traced, c_source.DOUBLE, named.components)
    writer.about = c_source._about(request._replace(keywords={"range_sigma": EVIL}), writer, "double", EVIL)
    files = files_of(writer, named, [EVIL])
    for file, text in files.items():
        assert text.isascii()
        assert re.fullmatch(r"\w+\.(h|c|csv)", file)
        bare = re.sub(r"/\*.*?\*/", "", text, flags=re.DOTALL)
        assert "passwd" not in re.sub(r'"[\w,]*"', "", bare).replace("etc_passwd", "")
        assert set(re.findall(r'^\s*#\s*include\s+["<](\S+)[">]', bare, re.MULTILINE)) <= {
            *files, "math.h", "float.h", "stdio.h", "stdlib.h", "string.h", "time.h",
        }  # fmt: skip
        assert bare.count('"') % 2 == 0
        assert "system" not in re.sub(r"\w*_system_\w*", "", bare)
    compile_and_test(writer, named, flags=(*FLAGS, "-O0"))


# --- the export


def test_an_export_is_described_also_without_a_compiler(tmp_path, monkeypatch):
    monkeypatch.setattr(c_source.shutil, "which", lambda _: None)
    problem = problem_of("filtergym/ManeuveringTarget-v0")
    folder = tmp_path / "new" / "imm"
    request = request_export(problem, "kalman-imm", horizon=20)
    figures = export_c(request, folder, "float", "as typed")
    assert figures.test == ""
    assert figures.replaced == (1e-300,)
    assert 1e-8 < figures.difference < 1e-3
    text = (folder / "kalman_imm.h").read_text()
    for words in (
        "in float",
        "as typed",
        "horizon = 20",
        "1e-300",
        f"{figures.operations:,} operations",
        "velocity_y [m/s]",
    ):
        assert words in text
    assert "double" not in (folder / "kalman_imm.c").read_text()


def test_the_time_of_an_update_is_of_optimised_code_and_labelled(tmp_path, monkeypatch):
    seen = []
    monkeypatch.setattr(
        c_source, "compile_and_test", lambda *_, flags: seen.append(flags[-1]) or "5 ns an update"
    )
    request = request_export(problem_of("filtergym/ManeuveringTarget-v0"), "kalman-imm")
    short = export_c(request, tmp_path / "short")
    monkeypatch.setattr(c_source, "MOST_OPTIMISED", 100)
    long = export_c(request, tmp_path / "long")
    assert seen == ["-O2", "-O1"]
    assert [short.test, long.test] == [f"5 ns an update with cc {level}" for level in seen]


def test_the_operations_of_a_network_stand_beside_those_of_the_filter(tmp_path, monkeypatch):
    monkeypatch.setattr(c_source.shutil, "which", lambda _: None)
    problem = problem_of("filtergym/ManeuveringTarget-v0")
    # 14 numbers are shown, 6 units, 2 answers: a product and a sum for each weight, and the biases.
    request = ExportRequest(problem, "own", OwnNetwork("mode", "", "argmax", "tanh", 2))
    figures = export_c(request, tmp_path / "own")
    assert figures.network_operations == 2 * (14 * 6 + 6 * 2) + 6 + 2
    words = " ".join((tmp_path / "own" / "own.h").read_text().split())
    assert (
        f"{figures.operations:,} operations an update and 200 of the network where it is evaluated" in words
    )


def test_files_of_a_filter_are_not_those_of_the_programs_around_it():
    taken = {"test", "main", "rows", "vectors", "time", "int"}
    assert not taken & {file_stem(name) for name in taken}


def test_a_precision_in_which_a_filter_is_wrong_is_refused(tmp_path, monkeypatch):
    monkeypatch.setitem(c_source.WORST, "float", 1e-9)
    problem = problem_of("filtergym/ManeuveringTarget-v0")
    with pytest.raises(
        ValueError, match=r"'fixed-low' in float is off by .*more than 1e-09.*export it in double"
    ):
        export_c(request_export(problem, "fixed-low"), tmp_path / "new", "float")
    assert not (tmp_path / "new").exists()


def test_the_command_writes_a_filter(success, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    words = ("filtergym/ManeuveringTarget-v0", "fixed-low", "--to", "c", "--set", "horizon=12")
    assert "fixed_low.h" in success("export", *words)
    assert {path.name for path in (tmp_path / "fixed_low").iterdir()} == {
        "fixed_low.h", "fixed_low.c", "rows.h", "main.c", "vectors.h", "test.c", "measurements.csv",
    }  # fmt: skip


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (("filtergym/ManeuveringTarget-v0", "imm", "--to", "d"), "unknown form of an export 'd'"),
        (("filtergym/ManeuveringTarget-v0", "--to", "c"), "name the filter"),
        (("filtergym/ManeuveringTarget-v0", "imm"), "add --to c"),
        (("runs", "--float"), "--float is not for --to safetensors of a run: add --to c"),
        (
            ("filtergym/ManeuveringTarget-v0", "bptt", "--to", "onnx", "--float"),
            "--float is not for --to onnx",
        ),
        (
            ("filtergym/ManeuveringTarget-v0", "bptt", "--to", "onnx", "--set", "horizon=9"),
            "--set is not for --to onnx",
        ),
        (("filtergym/ManeuveringTarget-v0", "missing", "--to", "c"), "unknown policy 'missing'"),
        (("filtergym/ManeuveringTarget-v0", "imm", "--to", "c", "--set", "gians=1"), "gains"),
    ],
)
def test_what_the_command_refuses(words, sentence, refusal, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert sentence in refusal("export", *words)
    assert list(tmp_path.iterdir()) == []
