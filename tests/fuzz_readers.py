"""Coverage-guided fuzzing of every reader, with limits of time and memory for each input.

``python tests/fuzz_readers.py READER SECONDS`` runs one, ``make fuzz`` all of them; without arguments it lists them. An
input that ends in anything but a result or a ``ValueError`` of one sentence, takes longer than 20 s or more than 1 GB
stops the run, and is left in ``build/fuzz/READER/`` beside the corpus. A run begins with what the ones before have
found and ends by reducing it to the inputs that reach something of their own. Needs ``pip install atheris``. Parsers of
other libraries run in processes of their own: what is guided there is what is done with their answers.
"""

import contextlib
import gzip
import json
import shutil
import subprocess
import sys
import warnings
from pathlib import Path

ROOT = Path(__file__).parents[1]
SECONDS, MEGABYTES, LONGEST = 20, 1024, 200_000
ENVIRONMENT = "filtergym/ManeuveringTarget-v0"
TABLES = (".csv", ".json", ".json.gz", ".nc", ".parquet", ".pos", ".nmea", ".ulg", ".bag", ".db3", ".mcap")
WHOLE = ("filter.json", "safetensors", "submission", "results", "run.json", "settings.yml")
READERS = (*(f"recording{suffix}" for suffix in TABLES), *(f"flights{s}" for s in TABLES[:5]), *WHOLE)


def write_seeds(reader: str, place: Path) -> None:
    """Write honest files of a reader into a folder."""
    sys.path.insert(0, str(ROOT / "tests"))
    import numpy
    import pandas
    import test_receiver_logs as logs
    from filtergym.baselines.problem import problem_of
    from filtergym.evaluation.running.parallel import Workers

    from filtergym.submission import Card, make_submission, write_submission

    time = numpy.arange(0.0, 80.0, 2.0)
    columns = pandas.DataFrame({"time": time, "x": 2e4 + 100.0 * time, "y": 1e4 - 50.0 * time})
    path, suffix = place / "seed", reader.partition(".")[2]
    rows = [(round(1e6 * t), *map(float, p), 2.0, 3) for t, p in zip(logs.TIME, logs.places().T, strict=True)]
    pretrained = ROOT / "agents" / "pretrained" / "ManeuveringTarget-v0"
    tracked = {"track": columns.to_dict("records")}
    make = {
        "csv": lambda: columns.to_csv(path, index=False),
        "json": lambda: path.write_text(json.dumps(tracked["track"])),
        "json.gz": lambda: path.write_bytes(gzip.compress(json.dumps(tracked["track"]).encode())),
        "nc": lambda: columns.set_index("time").to_xarray().to_netcdf(path, engine="scipy"),
        "parquet": lambda: columns.to_parquet(path),
        "pos": lambda: logs.rtklib(path, logs.GEODETIC, logs.places()),
        "nmea": lambda: logs.nmea(path),
        "ulg": lambda: logs.ulog(path, logs.NEW, rows),
        "bag": lambda: logs.bag(path),
        "db3": lambda: shutil.copy(logs.bag2(place.parent / "made-db3"), path),
        "mcap": lambda: shutil.copy(logs.bag2(place.parent / "made-mcap", "MCAP", compression=True), path),
    }
    if reader in WHOLE:
        filter = {
            "environment": ENVIRONMENT,
            "filter": "constant-velocity",
            "values": {"log10_acceleration": 0.0},
        }
        make = {
            "filter.json": lambda: path.write_text(json.dumps(filter)),
            "safetensors": lambda: shutil.copy(pretrained / "bptt-small.safetensors", path),
            "submission": lambda: write_submission(
                path, make_submission(problem_of(ENVIRONMENT), "imm", "trial", Card("IMM"), Workers())
            ),
            "results": lambda: path.write_text(json.dumps({"settings": {}, "results": []})),
            "run.json": lambda: shutil.copy(pretrained / "bptt-small.json", path),
            "settings.yml": lambda: path.write_text(
                "default: &d {n_envs: 8}\nx: {<<: *d, env_kwargs: {horizon: 9}}\n"
            ),
        }
        suffix = reader
    make[suffix]()


def reading(reader: str, place: Path):
    """Return what reads bytes as a file of a reader."""
    from filtergym.agents.learned_policy import load_policy
    from filtergym.agents.settings import read_config
    from filtergym.agents.training_run import load_run
    from filtergym.baselines.fitted_filters import read_artefact
    from filtergym.baselines.problem import problem_of

    from filtergym import read_flights, read_recording
    from filtergym.reports.tables.results import read_results
    from filtergym.submission import check_submission, read_submission

    problem = problem_of(ENVIRONMENT)
    name = reader if reader.startswith(("recording", "flights")) else f"a.{reader}"
    path = place / ("run.json" if reader == "run.json" else name)

    def submission() -> None:
        found, _ = read_submission(path)
        check_submission(problem, found, path)

    whole = {
        "filter.json": lambda: read_artefact(path, problem),
        "safetensors": lambda: load_policy(problem.task, path),
        "submission": submission,
        "results": lambda: read_results(path),
        "run.json": lambda: load_run(place),
        "settings.yml": lambda: read_config(path, ENVIRONMENT),
    }
    table = read_flights if reader.startswith("flights") else lambda path: read_recording(path, ENVIRONMENT)
    read = whole.get(reader, lambda: table(path))

    def one(content: bytes) -> None:
        path.write_bytes(content)
        try:
            read()
        except ValueError as error:
            if "\n" in str(error) or len(str(error)) > 3000:
                raise RuntimeError("not one sentence") from error

    return one


def main(reader: str, seconds: str) -> None:
    """Fuzz a reader for some seconds, then reduce its corpus."""
    import atheris

    place = ROOT / "build" / "fuzz" / reader
    corpus, found = place / "corpus", place / "found"
    if "--inner" not in sys.argv:
        corpus.mkdir(parents=True, exist_ok=True)
        if not any(corpus.iterdir()):
            write_seeds(reader, corpus)
        found.mkdir(exist_ok=True)
        this = [sys.executable, __file__, reader]
        ended = subprocess.run([*this, seconds, "--inner"], check=False).returncode
        reduced = place / "reduced"
        shutil.rmtree(reduced, ignore_errors=True)
        reduced.mkdir()
        with contextlib.suppress(OSError):
            if subprocess.run([*this, "0", "--inner"], check=False).returncode == 0 and any(
                reduced.iterdir()
            ):
                shutil.rmtree(corpus)
                reduced.rename(corpus)
                shutil.rmtree(found)
        sys.exit(ended)
    warnings.simplefilter("ignore")
    with atheris.instrument_imports(include=["filtergym"]):
        one = reading(reader, place)
    limits = [
        f"-timeout={SECONDS}",
        f"-rss_limit_mb={MEGABYTES}",
        f"-max_len={LONGEST}",
        f"-artifact_prefix={place}/",
    ]
    if int(seconds):
        words = [f"-max_total_time={seconds}", str(found), str(corpus)]
    else:
        words = ["-merge=1", str(place / "reduced"), str(corpus), str(found)]
    atheris.Setup([sys.argv[0], *limits, *words], one)
    atheris.Fuzz()


if __name__ == "__main__":
    if len(sys.argv) < 3:
        print("\n".join(READERS))
    else:
        main(*sys.argv[1:3])
