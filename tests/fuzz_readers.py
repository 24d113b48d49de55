"""Coverage-guided fuzzing of every reader, with limits of time and memory for each input.

``python tests/fuzz_readers.py READER SECONDS [INPUTS [SEED]]`` runs one until the seconds or the inputs are over,
``make fuzz`` all of them; without arguments it lists them. An input fails that ends in anything but a result or a
``ValueError`` of one sentence, whose result holds what no reader may hand on (:func:`check_result`), or that takes
longer than 20 s or more than 1 GB; it is left in ``build/fuzz/READER/failed/``, and the others go on. A run begins
with what the ones before have found and, if only its seconds end it, reduces that to the inputs that reach something of
their own. Needs
``pip install atheris``. Parsers of other libraries run in processes of their own: what is guided there is what is done
with their answers.
"""

import contextlib
import gzip
import hashlib
import json
import os
import random
import shutil
import subprocess
import sys
import time
import traceback
import warnings
import zlib
from pathlib import Path

import numpy as np

ROOT = Path(__file__).parents[1]
SECONDS, MEGABYTES, LONGEST = 20, 1024, 200_000
ENVIRONMENT = "filtergym/ManeuveringTarget-v0"
MODEL = "fuzzed/Model-v0"
TABLES = (
    ".csv",
    ".json",
    ".json.gz",
    ".nc",
    ".parquet",
    ".pos",
    ".nmea",
    ".ulg",
    ".bin",
    ".bag",
    ".db3",
    ".mcap",
)
WHOLE = (
    "measured.nc", "truth.csv", "imu.csv", "model.csv", "tuned.json", "filter.json", "safetensors", "submission",
    "results", "run.json", "settings.yml", "kept",
)  # fmt: skip
READERS = (*(f"recording{suffix}" for suffix in TABLES), *(f"flights{s}" for s in TABLES[:5]), *WHOLE)
FAILED, TAKEN, REFUSED = range(3)


def track():
    """Rows of a track, as a table has them."""
    import pandas

    seconds = np.arange(0.0, 80.0, 2.0)
    return pandas.DataFrame({"time": seconds, "x": 2e4 + 100.0 * seconds, "y": 1e4 - 50.0 * seconds})


def write_table_seeds(suffix: str, place: Path) -> None:
    """Write honest tables and logs of a kind into a folder."""
    import test_onboard
    import test_receiver_logs as logs

    table, path = track(), place / "seed"
    dates = [f"2026-05-01T12:{int(t) // 60:02d}:{int(t) % 60:02d}Z" for t in table["time"]]
    place_names = {"latitude": 48.0 + table["y"] / 1.1e5, "longitude": 2.0 + table["x"] / 7e4}
    known = table.assign(truth_position_x=table["x"], truth_position_y=table["y"], sigma_x=100.0, sigma_y=9.0)
    wordy = table.assign(time=dates, **place_names, icao24="abc", onground=False, altitude=3000.0)
    rows = [(round(1e6 * t), *map(float, p), 2.0, 3) for t, p in zip(logs.TIME, logs.places().T, strict=True)]
    several = {"": table, "-known": known, "-words": wordy.drop(columns=["x", "y"])}
    text = {name: json.dumps(table.to_dict("records")) for name, table in several.items()}

    def each(write) -> None:
        for name in several:
            write(name, place / f"seed{name}")

    def netcdf() -> None:
        data = known.set_index("time").to_xarray()
        data.to_netcdf(path, engine="scipy")
        data.to_netcdf(place / "seed4", engine="h5netcdf")

    kinds = ("sensor_msgs/msg/NavSatFix", "nav_msgs/msg/Odometry")
    {
        ".csv": lambda: each(lambda name, path: several[name].to_csv(path, index=False)),
        ".json": lambda: each(lambda name, path: path.write_text(text[name])),
        ".json.gz": lambda: each(lambda name, path: path.write_bytes(gzip.compress(text[name].encode()))),
        ".nc": netcdf,
        ".parquet": lambda: each(lambda name, path: several[name].to_parquet(path)),
        ".pos": lambda: logs.rtklib(path, logs.GEODETIC, logs.places()),
        ".nmea": lambda: logs.nmea(path),
        ".ulg": lambda: logs.ulog(path, logs.NEW, rows),
        ".bin": lambda: test_onboard.flight(path, 10.0),
        ".bag": lambda: logs.bag(path),
        ".db3": lambda: shutil.copy(logs.bag2(place.parent / "made-db3", kinds=kinds), path),
        ".mcap": lambda: shutil.copy(logs.bag2(place.parent / "made-mcap", "MCAP", compression=True), path),
    }[suffix]()


def write_whole_seeds(reader: str, place: Path) -> None:
    """Write honest files of another kind into a folder."""
    import made_results
    import test_inertial_logs as inertial

    import filtergym
    from filtergym.baselines.catalogue import baselines_of
    from filtergym.baselines.fitted_filters import families_of
    from filtergym.baselines.problem import problem_of
    from filtergym.evaluation.running.parallel import Workers
    from filtergym.reports.tables.results import settings_of, write_results
    from filtergym.submission import Card, make_submission, write_submission

    path, problem = place / "seed", problem_of(ENVIRONMENT)
    pretrained = ROOT / "agents" / "pretrained" / "ManeuveringTarget-v0"

    def middle(limits) -> dict[str, float]:
        return {name: 0.5 * (ends[0] + ends[-1]) for name, ends in limits.items()}

    def measured() -> None:
        for name in ("ManeuveringTarget", "RadarEsmTracking", "LooselyCoupledNavigation"):
            recorded = filtergym.record(f"filtergym/{name}-v0", None, 2, horizon=20)
            recorded.write(place.parent / "seed.nc")
            shutil.move(place.parent / "seed.nc", place / f"seed-{name}")

    def imu() -> None:
        inertial.write_log(place.parent)
        lines = (place.parent / "imu.csv").read_text().splitlines(keepends=True)
        path.write_text("".join(lines[:2000]))

    def artefacts() -> None:
        for name, family in families_of(problem).items():
            filter = {"environment": ENVIRONMENT, "filter": name, "values": middle(family.limits)}
            (place / name).write_text(json.dumps(filter))

    def agents() -> None:
        for name in ("bptt-small", "ppo"):
            shutil.copy(pretrained / f"{name}.safetensors", place / name)

    def submission() -> None:
        for name in ("imm", "bptt-small"):
            made = make_submission(problem, name, "trial", Card("IMM"), Workers())
            write_submission(place / name, made)

    def results() -> None:
        found = made_results.results_of(ENVIRONMENT, ["imm", "imm-tuned"], None, 2, horizon=5)
        records = [r for r in found.records if r.window == "all" and "cost" in r.metric + r.component]
        write_results(path, [found._replace(records=records)], settings_of("filtergym benchmark"))

    def kept() -> None:
        store, work = stored(place.parent)
        store.write(work, np.arange(6.0).reshape(2, 3))
        shutil.move(next(place.parent.glob("trial.*")), path)

    tuned = {"imm": {"values": middle(baselines_of(ENVIRONMENT).tunable["imm"].limits)}}
    yaml = "default: &d {n_envs: 8}\nx: {<<: *d, env_kwargs: {horizon: 9}}\n"
    {
        "measured.nc": measured,
        "truth.csv": lambda: track().to_csv(path, index=False),
        "imu.csv": imu,
        "model.csv": lambda: path.write_text("time,gps,odometry\n0,3,10\n0.5,,9.8\n1,14,\n1.5,20,10\n"),
        "tuned.json": lambda: path.write_text(json.dumps(tuned)),
        "filter.json": artefacts,
        "safetensors": agents,
        "submission": submission,
        "results": results,
        "run.json": lambda: shutil.copy(pretrained / "bptt-small.json", path),
        "settings.yml": lambda: path.write_text(yaml),
        "kept": kept,
    }[reader]()


def stored(place: Path):
    """A folder of finished parts, and one of them."""
    from filtergym.evaluation.storage.store import Store, Work

    return Store(place), Work("trial", "x")


def reading(reader: str, place: Path):
    """Return the path of a reader's files, and what reads one."""
    import test_inertial_logs as inertial

    import filtergym
    from filtergym import read_flights, read_recording
    from filtergym.agents.settings import read_config
    from filtergym.agents.training_run import load_run
    from filtergym.baselines.problem import problem_of
    from filtergym.baselines.tuned_values import table_path
    from filtergym.envs.loosely_coupled_navigation.inertial import inertial_recording
    from filtergym.names import find_competitor
    from filtergym.reports.tables.results import read_results
    from filtergym.submission import check_submission, read_submission, unpack

    problem = problem_of(ENVIRONMENT)
    path = place / (f"a.{reader}" if reader == "filter.json" or "." not in reader else reader)
    work = None
    if reader == "truth.csv":
        track().assign(x=lambda t: t["x"] + 5.0 * np.cos(t["time"])).to_csv(place / "log.csv", index=False)
    elif reader == "imu.csv":
        inertial.write_log(place)
    elif reader == "tuned.json":
        os.chdir(place)
        path = place / table_path(ENVIRONMENT)
        path.parent.mkdir(exist_ok=True)
    elif reader == "kept":
        store, work = stored(place)
        store.write(work, 0)
        path = next(place.glob("trial.*"))
    elif reader == "model.csv":
        filtergym.state_space(
            MODEL, f=[[1.0, 0.5], [0.0, 1.0]], Q=[[0.1, 0.2], [0.2, 0.5]], sampling_interval=0.5,
            h=[[1, 0], [0, 1]], R=[[25.0, 0.0], [0.0, 0.25]], mean=[0, 10], covariance=[[100, 0], [0, 25]],
            names=["position", "velocity"], units=["m", "m/s"], measured=["gps", "odometry"],
        )  # fmt: skip

    def submission():
        found, _ = read_submission(path)
        check_submission(problem, found, path)
        return unpack(problem, found, path)

    whole = {
        "measured.nc": lambda: read_recording(path),
        "truth.csv": lambda: read_recording(place / "log.csv", ENVIRONMENT, truth=path),
        "imu.csv": lambda: inertial_recording(path, place / "fixes.csv", **inertial.WINDOWS),
        "model.csv": lambda: read_recording(path, MODEL),
        "tuned.json": lambda: find_competitor(problem, "imm-tuned").maker,
        "filter.json": lambda: find_competitor(problem, path).maker,
        "safetensors": lambda: find_competitor(problem, path).maker,
        "submission": submission,
        "results": lambda: read_results(path),
        "run.json": lambda: load_run(place),
        "settings.yml": lambda: read_config(path, ENVIRONMENT),
        "kept": lambda: store.read(work, np.ndarray),
    }
    table = read_flights if reader.startswith("flights") else lambda path: read_recording(path, ENVIRONMENT)
    return path, whole.get(reader, lambda: table(path))


def check_result(result) -> None:
    """Raise AssertionError for a result that no reader may hand on: a recording whose replay is not finite, a
    competitor that answers in what is no number.
    """
    from filtergym import evaluate
    from filtergym.envs.data.recording import Recording

    found = {}
    if isinstance(result, Recording):
        P = np.asarray(result.initial.get("covariance", np.eye(1)))
        least = 0.0 if result.environment == ENVIRONMENT else -1e-9 * np.abs(P).max()
        assert (np.linalg.eigvalsh(P)[..., 0] >= least).all(), "an initial covariance is indefinite"
        if result.environment in (ENVIRONMENT, MODEL):
            name = "imm" if result.environment == ENVIRONMENT else "kalman"
            found = evaluate(result.environment, name, result, 1, horizon=min(3, int(result.lengths[0])))
    elif callable(result):
        found = evaluate(ENVIRONMENT, {"read": result}, None, 1, horizon=3)
        assert np.isfinite(found["cost"]).all(), "its cost is not finite"
    for name in ("log_likelihood", "nis", "mode_probability"):
        if name in found:
            assert not np.isinf(found[name]).any(), f"{name} of a replay is infinite"


def change_structure(reader: str, content: bytes, rng: random.Random) -> bytes:
    """Return a file whose form is right, and of which a value is odd; the file itself where it has no form."""
    import test_fuzz

    if reader == "safetensors":
        size = int.from_bytes(content[:8], "little")
        header = json.loads(content[8 : 8 + size])
        metadata = header["__metadata__"]
        name = rng.choice([*metadata])
        if name in ("run", "fields"):
            metadata[name] = json.dumps(test_fuzz.replaced(json.loads(metadata[name]), rng))
        else:
            metadata[name] = rng.choice(test_fuzz.ODD)
        text = json.dumps(header).encode()
        return len(text).to_bytes(8, "little") + text + content[8 + size :]
    if reader.endswith(".json.gz"):
        return gzip.compress(
            json.dumps(test_fuzz.replaced(json.loads(gzip.decompress(content)), rng)).encode(), 1
        )
    if reader.endswith(".json") or reader in ("submission", "results"):
        return json.dumps(test_fuzz.replaced(json.loads(content), rng)).encode()
    if reader.endswith((".csv", ".pos", ".nmea")):
        separator = "," if b"," in content else " "
        rows = [line.split(separator) for line in content.decode().splitlines()]
        for _ in range(rng.choice((1, 2, 5))):
            row = rng.choice(rows)
            row[rng.randrange(len(row))] = rng.choice((*test_fuzz.ODD, *CELLS))
        return "\n".join(map(separator.join, rows)).encode()
    if reader == "measured.nc":
        return change_netcdf(content, rng)
    return content


CELLS = (
    "inf", "1e308", "-1e308", "1e-320", "1_0", "0x1", "１２", "12:00:00", "2026-01-01", "9" * 20, "time", "x",
)  # fmt: skip


def change_netcdf(content: bytes, rng: random.Random) -> bytes:
    """Return a recording of which a variable or attribute is odd."""
    import io

    import xarray

    with xarray.open_dataset(io.BytesIO(content), engine="scipy", decode_times=False) as read:
        data = read.load()
    name = rng.choice([*data.data_vars])
    values = data[name].values.copy()
    kind = rng.randrange(7)
    if kind == 0 and values.size:
        values.flat[rng.randrange(values.size)] = rng.choice((-1, 0, 2**31 - 1))
        if values.dtype.kind == "f":
            values.flat[rng.randrange(values.size)] = rng.choice((np.nan, np.inf, -1e300, 1e-320))
    elif kind == 1:
        values = values * rng.choice((0, -1, 1e300, 1e-300))
    elif kind == 2:
        data = data.drop_vars(name)
    elif kind == 3:
        data = data.isel({rng.choice([*data.dims]): slice(0, rng.choice((0, 1)))})
    elif kind == 4:
        odd = (
            '{"horizon": 1e99}',
            "[]",
            '{"no": 1}',
            '{"sampling_interval": 0}',
            '{"range_sigma": NaN}',
            "[" * 500,
        )
        data.attrs[rng.choice(("parameters", "environment"))] = rng.choice(
            (*odd, "x", "os:path", ENVIRONMENT)
        )
    elif kind == 5:
        data = data.rename({name: rng.choice(("zzz", "truth", "length", "started", "initial_x"))})
    else:
        data = data.rename_dims({rng.choice([*data.dims]): "other"})
    if kind < 2:
        data[name] = (data[name].dims, values)
    return bytes(data.to_netcdf(engine="scipy", format="NETCDF3_64BIT"))


def run_inner(reader: str, place: Path, flags: list[str]) -> None:
    """Fuzz in this process, which libFuzzer ends."""
    import atheris

    warnings.simplefilter("ignore")
    with atheris.instrument_imports(include=["filtergym"]):
        path, read = reading(reader, place)
    # What the first file compiles, with Numba 7 s of processor time, is not the time of any input.
    path.write_bytes(min((place / "corpus").iterdir()).read_bytes())
    with contextlib.suppress(ValueError):
        read()
    counts = np.memmap(place / "counts", np.int64, "r+", shape=3)
    failed = place / "failed"

    def one(content: bytes) -> None:
        path.write_bytes(content)
        try:
            check_result(read())
            counts[TAKEN] += 1
        except ValueError as error:
            counts[REFUSED] += 1
            if "\n" in str(error) or len(str(error)) > 3000:
                keep(content, "not one sentence", error)
        except Exception as error:
            keep(content, type(error).__name__, error)

    def keep(content: bytes, what: str, error: Exception) -> None:
        """Keep the first input that fails in a way."""
        counts[FAILED] += 1
        frames = traceback.extract_tb(error.__traceback__)
        where = [f"{Path(f.filename).name}:{f.lineno}" for f in frames]
        digest = hashlib.sha256(f"{what} {where}".encode()).hexdigest()[:12]
        if not (failed / digest).exists():
            (failed / digest).write_bytes(content)
            print(
                f"{reader}: {failed / digest}: {what}: {error!s:.200} at {' '.join(where[-3:])}", flush=True
            )

    def mutate(content: bytes, longest: int, seed: int) -> bytes:
        rng = random.Random(seed)
        if rng.random() < 0.5:
            # It may have lost its form before.
            with contextlib.suppress(ValueError, LookupError, TypeError, OSError, EOFError, zlib.error):
                return change_structure(reader, content, rng)[:longest]
        return atheris.Mutate(content, longest)

    # libFuzzer starts itself again when it reduces a corpus, with the words that it has got, in a shell.
    again = f"{sys.executable} {__file__} {reader} --inner"
    atheris.Setup([again, *flags], one, custom_mutator=mutate)
    atheris.Fuzz()


def main(reader: str, seconds: float, inputs: int = 0, seed: int | None = None) -> int:
    """Fuzz a reader, reduce its corpus, and return how many inputs failed."""
    seed = int(time.time()) if seed is None else seed
    place = ROOT / "build" / "fuzz" / reader
    corpus, found, failed, reduced = (place / name for name in ("corpus", "found", "failed", "reduced"))
    corpus.mkdir(parents=True, exist_ok=True)
    if not any(corpus.iterdir()):
        if reader in WHOLE:
            write_whole_seeds(reader, corpus)
        else:
            write_table_seeds(f".{reader.partition('.')[2]}", corpus)
    for folder in (found, failed, reduced):
        if folder != failed:
            shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir(exist_ok=True)
    counts = np.memmap(place / "counts", np.int64, "w+", shape=3)
    limits = [
        f"-timeout={SECONDS}", f"-rss_limit_mb={MEGABYTES}", f"-max_len={LONGEST}", f"-artifact_prefix={failed}/",
        "-mutate_depth=1",
    ]  # fmt: skip
    this = [sys.executable, __file__, reader, "--inner", *limits]
    until, broken = time.monotonic() + seconds, 0
    while True:
        left, more = until - time.monotonic(), inputs - int(counts.sum()) if inputs else -1
        if left < 1.0 or (inputs and more <= 0):
            break
        words = [f"-max_total_time={left:.0f}", f"-runs={more}", f"-seed={seed + broken + 1}"]
        with (place / "log").open("w") as log:
            ended = subprocess.run([*this, *words, str(found), str(corpus)], check=False, stderr=log)
        if ended.returncode == 0:
            break
        broken += 1  # over a limit: the input is kept
    tried = [int(count) for count in counts]
    if not inputs:
        merged = [*this, "-merge=1", str(reduced), str(corpus), str(found)]
        if subprocess.run(merged, check=False, capture_output=True).returncode == 0 and any(
            reduced.iterdir()
        ):
            shutil.rmtree(corpus)
            reduced.rename(corpus)
            shutil.rmtree(found)
    print(
        f"{reader}: {sum(tried):,} inputs, {tried[TAKEN]:,} taken, {tried[REFUSED]:,} refused, {tried[FAILED]} failed, "
        f"{broken} over a limit; corpus {len([*corpus.iterdir()])}",
        flush=True,
    )
    return tried[FAILED] + broken


if __name__ == "__main__":
    sys.path[:0] = [str(ROOT / "tests"), str(ROOT / "docs" / "make")]
    if len(sys.argv) < 3:
        print("\n".join(READERS))
    elif "--inner" in sys.argv:
        run_inner(sys.argv[1], ROOT / "build" / "fuzz" / sys.argv[1], sys.argv[3:])
    else:
        sys.exit(min(main(sys.argv[1], float(sys.argv[2]), *map(int, sys.argv[3:5])), 1))
