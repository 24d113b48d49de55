"""Every ranked competitor as C99: compiled, run over recorded episodes, and compared with its own estimates.

A line for each: operations and bytes of state in double; bytes of the source, of code and constants with ``-Os``, and
of the largest stack of a function; the largest difference to the replay in double and in float, in reported standard
deviations; nanoseconds an update in C (double and float), in LLVM's code of the same program (a lane of 512, without a
network), and in NumPy for one track. For a competitor that cannot be exported the line gives the reason. Times are of
processor time, the least of several runs. ``--cross`` names a compiler of another processor, with which the files are
compiled only.

Example: python benchmarks/exported.py --environment ManeuveringTarget-v0 --episodes 100 --out exported.csv
"""

import argparse
import csv
import shutil
import subprocess
import sys
import tempfile
import time
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy
from peer_imm import imm_steps_per_second

from filtergym.baselines.problem import Problem, problem_of
from filtergym.compiler.c_text import DOUBLE, FLOAT, Scalar
from filtergym.compiler.functions import empty_lanes
from filtergym.compiler.native import native
from filtergym.envs.contract.filter import FilterInput
from filtergym.envs.engine.backend import make_model
from filtergym.envs.engine.catalogue import catalogue
from filtergym.evaluation.competitors.filters import as_filter
from filtergym.evaluation.competitors.kinds import kind_of, make_competitor
from filtergym.evaluation.competitors.steered_filter import steer
from filtergym.evaluation.running.evaluate import control_of
from filtergym.evaluation.running.rollout import rollout, start_lanes
from filtergym.evaluation.running.seeds import episode_seeds
from filtergym.exports.c_source import FLAGS, Writer, files_of
from filtergym.exports.replay import Replay, mean_rows, replay, run_filter
from filtergym.exports.request import ExportRequest
from filtergym.exports.traced_filter import (
    ANSWER,
    ESTIMATE,
    MEASUREMENT,
    SHOWN,
    STATE,
    TracedFilter,
    one_lane,
)
from filtergym.names import find_competitor, ranked_names

COLUMNS = (
    "environment", "competitor", "operations", "state_bytes", "weight_bytes", "source_bytes", "code_bytes",
    "stack_bytes", "cross_bytes", "cross_float_bytes", "double_sigmas", "float_sigmas", "double_ns", "float_ns",
    "llvm_ns", "numpy_ns", "refusal",
)  # fmt: skip
LANES = 512
BATCH = """#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <time.h>
#include "rows.h"
int main(int argc, char **argv) {{
    FILE *in = fopen(argv[1], "rb"), *out = fopen(argv[2], "wb");
    const long E = atol(argv[3]), T = atol(argv[4]), I = {initial}, M = {measurement}, C = {components};
    double *initials = malloc((size_t)(E * I) * sizeof *initials), *rows = malloc((size_t)(E * T * M) * sizeof *rows);
    double *means = malloc((size_t)(E * T * C) * sizeof *means);
    double best = 1e300;
    long e, k, i, again;
    if (argc < 5 || fread(initials, sizeof *initials, (size_t)(E * I), in) != (size_t)(E * I)) return 2;
    if (fread(rows, sizeof *rows, (size_t)(E * T * M), in) != (size_t)(E * T * M)) return 2;
    for (again = 0; again < 3; ++again) {{
        const clock_t begin = clock();
        for (e = 0; e < E; ++e) {{
            {own}_state state;
            {own}_initial initial;
            set_initial(&initial, initials + e * I);
            {own}_start(&state, &initial, NULL);
            for (k = 0; k < T; ++k) {{
                {own}_measurement measurement;
                {own}_estimate estimate;
                set_measurement(&measurement, rows + (e * T + k) * M);
                const int there = {own}_update(&state, &measurement, &estimate) <= 1;
                for (i = 0; i < C; ++i)
                    means[(e * T + k) * C + i] = there ? (double)estimate.mean{mean} : (double)NAN;
            }}
        }}
        best = fmin(best, (double)(clock() - begin) / CLOCKS_PER_SEC / (double)(E * T));
    }}
    fwrite(means, sizeof *means, (size_t)(E * T * C), out);
    fclose(out);
    printf("%.3f", 1e9 * best);
    return 0;
}}
"""


class Size(NamedTuple):
    """Bytes of an exported filter: source, code, stack, and code of a cross compiler."""

    source: int
    code: int
    """Bytes of code and constants."""
    stack: int
    """Bytes of the largest stack of a function."""
    cross: int | None
    """Bytes of code and constants for another processor."""


class Compilers(NamedTuple):
    """C compilers for the exported files."""

    own: str
    cross: list[str]
    """A compiler of another processor with its options, or an empty list."""


def size_of(file: Path, compilers: Compilers) -> Size:
    code = _code_bytes(file, [compilers.own, "-fstack-usage"])
    usage = file.with_suffix(".small.su").read_text(encoding="utf-8").splitlines()
    stack = max(int(line.split("\t")[1]) for line in usage)
    cross = _code_bytes(file, compilers.cross) if compilers.cross else None
    return Size(file.stat().st_size, code, stack, cross)


def _code_bytes(file: Path, compiler: list[str]) -> int:
    made = file.with_suffix(".small.o").name
    subprocess.run([*compiler, *FLAGS, "-Os", "-c", file.name, "-o", made], cwd=file.parent, check=True)
    # The tool of the same toolchain: arm-none-eabi-size of arm-none-eabi-gcc.
    tool = f"{compiler[0].removesuffix('gcc')}size" if compiler[0].endswith("gcc") else "size"
    sizes = subprocess.run([tool, made], cwd=file.parent, check=True, capture_output=True, text=True).stdout
    return int(sizes.splitlines()[1].split()[0])


def run_in_c(
    name: str, traced: TracedFilter, given: Replay, scalar: Scalar, compilers: Compilers
) -> tuple[float, float, Writer, Size]:
    """Compile a filter and run it over test vectors; return difference in deviations, ns an update, writer, size."""
    writer = Writer(name, traced, scalar, given.components)
    T, E = len(given.measurements), given.initial.shape[1]
    batch = BATCH.format(
        own=writer.name,
        initial=len(given.initial),
        measurement=given.measurements.shape[1],
        components=len(given.components),
        mean="" if len(given.components) == 1 else "[i]",
    )
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        for file, text in {**files_of(writer, given), "batch.c": batch}.items():
            (folder / file).write_text(text, encoding="ascii")
        (folder / "in").write_bytes(
            given.initial.T.tobytes() + numpy.moveaxis(given.measurements, -1, 0).astype(float).tobytes()
        )
        subprocess.run(
            [compilers.own, *FLAGS, "batch.c", f"{writer.name}.c", "-lm", "-o", "batch"],
            cwd=folder,
            check=True,
        )
        done = subprocess.run(
            [folder / "batch", "in", "out", str(E), str(T)],
            cwd=folder,
            check=True,
            capture_output=True,
            text=True,
        )
        size = size_of(folder / f"{writer.name}.c", compilers)
        means = numpy.frombuffer((folder / "out").read_bytes()).reshape(E, T, -1)
    return given.largest_difference(numpy.moveaxis(means, 0, -1)), float(done.stdout), writer, size


def llvm_nanoseconds(traced: TracedFilter, given: Replay) -> float:
    program = traced.update
    # Input and output must not be the same memory: the state after an update goes elsewhere.
    after = max(STATE, MEASUREMENT, ANSWER, ESTIMATE, SHOWN, 3) + 1
    results = [r._replace(argument=after) if r.argument == STATE else r for r in program.results]
    program = program._replace(results=results)
    rows = dict.fromkeys(range(after + 1), 64)
    rows |= {STATE: len(traced.state), after: len(traced.state), MEASUREMENT: given.measurements.shape[1]}
    rows |= {ESTIMATE: len(traced.estimate), SHOWN: max(traced.shown, 1)}
    arrays = [empty_lanes((max(rows[i], 1),), LANES) for i in range(after + 1)]
    for array in arrays:
        array[...] = 0.5
    arrays[MEASUREMENT][...] = given.measurements[0][:, numpy.arange(LANES) % given.initial.shape[1]]
    table = [program.constants.__array_interface__["data"][0]]
    for array in arrays:
        table += [array.__array_interface__["data"][0], array.strides[0] // 8]
    addresses = numpy.array(table, dtype=numpy.int64)
    code = native(program, [False] * len(arrays)).expect(LANES)
    return least_time(lambda: code(addresses.ctypes.data, 0, LANES), 5) / LANES


def numpy_nanoseconds(problem: Problem, name: str, maker: Any) -> float:
    kind = kind_of(maker)
    keywords = getattr(maker, "task_keywords", {})
    plain = make_model(problem.task, control_of(maker, None, problem.task, name), **keywords)
    seeds = episode_seeds("test", 0, 1)
    started: list[Any] = []
    start_lanes(plain, seeds, lambda episode: started.append(one_lane(episode.measurement)))
    measurement = one_lane(next(rollout(plain, maker, seeds, kind=kind, name=name))[0].measurement)
    if kind == "estimator":
        filter = as_filter(plain.task, make_competitor(maker, plain.task))
        measurement = plain.task.world.mask_missing(measurement)
    else:
        filter = steer(plain, make_competitor(maker, plain))
    state = filter.start(started[0])
    return least_time(lambda: filter.step(state, FilterInput(measurement)), 3)


def least_time(call: Any, count: int) -> float:
    """Return the nanoseconds of a call, the least mean over several runs of ``count`` calls."""
    call()
    times = []
    for _ in range(7):
        begin = time.process_time_ns()
        for _ in range(count):
            call()
        times.append((time.process_time_ns() - begin) / count)
    return min(times)


def lines(
    problem: Problem, names: list[str], episodes: int, measurements: int, compilers: Compilers
) -> Iterator[dict[str, Any]]:
    for name in names:
        maker = find_competitor(problem, name).maker
        line: dict[str, Any] = {"environment": problem.short_name, "competitor": name}
        try:
            traced, given = replay(ExportRequest(problem, name, maker), episodes, measurements)
        except ValueError as error:
            yield {**line, "refusal": str(error)}
            continue
        double, double_ns, writer, size = run_in_c(name, traced, given, DOUBLE, compilers)
        line |= {"double_sigmas": double, "double_ns": double_ns}
        line |= {"source_bytes": size.source, "code_bytes": size.code, "stack_bytes": size.stack}
        line["cross_bytes"] = size.cross
        operations, state, weights, _ = writer.sizes
        line |= {"operations": operations, "state_bytes": state, "weight_bytes": weights}
        if operations > 10_000:
            # A program that takes a compiler minutes runs in float by NumPy.
            line["float_sigmas"] = given.largest_difference(
                run_filter(traced, given, numpy.float32)[:, mean_rows(traced)]
            )
        else:
            line["float_sigmas"], line["float_ns"], _, size = run_in_c(name, traced, given, FLOAT, compilers)
            line["cross_float_bytes"] = size.cross
        with numpy.errstate(all="ignore"):
            line |= {
                "llvm_ns": llvm_nanoseconds(traced, given),
                "numpy_ns": numpy_nanoseconds(problem, name, maker),
            }
        yield line


ACCURACY = ("environment", "written", "double: median", "largest", "float: median", "largest")
COST = (
    "environment",
    "operations",
    "state, bytes",
    "code, kB",
    "stack, kB",
    "code of --cross, kB",
    "in float",
    "ns in C",
    "NumPy / C",
    "C / LLVM",
)


def summary(found: list[dict[str, Any]]) -> str:
    accuracy, cost = ([f"| {' | '.join(names)} |", f"|{'---|' * len(names)}"] for names in (ACCURACY, COST))
    for environment in dict.fromkeys(line["environment"] for line in found):
        own = [line for line in found if line["environment"] == environment]
        there = [line for line in own if line.get("double_ns")]
        numbers = {
            key: numpy.array([float(line.get(key) or "nan") for line in there])
            for key in COLUMNS[2:-1]
            if key != "float_ns"
        }
        ns = numbers["double_ns"]
        # LLVM's code of a program contains no network.
        faster = (ns / numbers["llvm_ns"])[numbers["weight_bytes"] == 0.0]
        name = environment.removesuffix("-v0")
        cells = [name, f"{len(there)} of {len(own)}"]
        for key in ("double_sigmas", "float_sigmas"):
            cells += [f"{numpy.median(numbers[key]):.0e}", f"{numbers[key].max():.0e}"]
        accuracy.append(f"| {' | '.join(cells)} |")
        cells = [name, *(_range(numbers[key]) for key in ("operations", "state_bytes"))]
        sizes = ("code_bytes", "stack_bytes", "cross_bytes", "cross_float_bytes")
        cells += [_range(numbers[key] / 1000.0) for key in sizes]
        cells += [_range(numbers["double_ns"])]
        cells += [_range(numbers["numpy_ns"] / ns), f"{numpy.median(faster):.1f}" if len(faster) else ""]
        cost.append(f"| {' | '.join(cells)} |")
    return "\n".join([*accuracy, "", *cost])


def _range(values: numpy.ndarray) -> str:
    values = values[numpy.isfinite(values)]
    return f"{numpy.median(values):,.0f} ({values.min():,.0f} to {values.max():,.0f})" if len(values) else ""


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--environment", action="append")
    parser.add_argument("--policy", action="append")
    parser.add_argument("--episodes", type=int, default=100)
    parser.add_argument("--measurements", type=int, default=200)
    parser.add_argument("--compiler", default=shutil.which("cc"))
    parser.add_argument("--cross", default="", help='such as "arm-none-eabi-gcc -mcpu=cortex-m4 -mthumb"')
    parser.add_argument("--out", type=Path)
    parser.add_argument("--read", type=Path, help="summarise the file of --out without running anything")
    args = parser.parse_args()
    if args.read is not None:
        print(summary(list(csv.DictReader(args.read.open(encoding="utf-8")))))
        return
    if args.compiler is None:
        sys.exit("no C compiler here")
    warnings.simplefilter("ignore")
    found: list[dict[str, Any]] = []
    for id in args.environment or list(catalogue()):
        problem = problem_of(id)
        names = args.policy or ranked_names(problem)
        compilers = Compilers(args.compiler, args.cross.split())
        for line in lines(problem, names, args.episodes, args.measurements, compilers):
            found.append(line)
            print(", ".join(f"{key} {_short(value)}" for key, value in line.items()), flush=True)
    if args.out is not None:
        with args.out.open("w", newline="", encoding="utf-8") as file:
            writer = csv.DictWriter(file, COLUMNS)
            writer.writeheader()
            writer.writerows({key: _short(value) for key, value in line.items()} for line in found)
    print(summary(found))
    try:
        print(
            f"filterpy's IMM of two filters of four states: {1e9 / imm_steps_per_second(2000):,.0f} ns an update"
        )
    except ImportError:
        print("filterpy is not installed")


def _short(value: Any) -> Any:
    return f"{value:.3g}" if isinstance(value, float) else value


if __name__ == "__main__":
    main()
