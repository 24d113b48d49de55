"""Two hundred broken inputs through the command line: every one is taken, or refused in one sentence."""

import json
import random
import warnings

import commands
import numpy as np
import pytest
from made_results import results_of
from scipy.io import netcdf_file

from filtergym.__main__ import main
from filtergym.agents.learned_policy import PRETRAINED
from filtergym.baselines.catalogue import baselines_of
from filtergym.reports.tables.results import settings_of, write_results

ID = "filtergym/ManeuveringTarget-v0"
WHOLE = 10
"""Of so many inputs one runs to the end, if it is taken; the others are refused for zero episodes, after the input was
read."""
ODD = (
    "", "NaN", "-Infinity", "1e999", "null", "true", "[]", "{}", '"x"', "-1", "0", "\\", "\x00", "[[[[", "é", "1e-300",
)  # fmt: skip
WORDS = (
    "gains=(0.3,0.7)", "transition=((0.9,0.1),(0.1,0.9))", "range_sigma=100.0", "polar_measurements=True",
    "flight=random", "legs=((10,3),)", "maneuver_steps=(50,55)", "decision_interval=1",
)  # fmt: skip


@pytest.fixture
def command(monkeypatch, capsys):
    """Run the command line; it prints at most one sentence, which asks for no report."""

    def run(*words, program=main):
        monkeypatch.setattr("sys.argv", ["filtergym", *map(str, words)])
        warnings.simplefilter("ignore", RuntimeWarning)  # outside the tests, one of NumPy is no error
        with pytest.raises(SystemExit) as ended:
            program()
        errors = capsys.readouterr().err
        assert ended.value.code in (0, 2), (words, errors)
        assert errors.count("\n") == (0 if ended.value.code == 0 else 1), (words, errors)
        assert errors.startswith("Error: ") or not errors, (words, errors)
        return ended.value.code

    return run


def mutated(content, rng):
    """Return bytes of which some were changed, cut, doubled, or replaced by an odd word."""
    content = bytearray(content)
    for _ in range(rng.choice((1, 1, 2, 5))):
        at, length = rng.randrange(len(content) or 1), rng.choice((1, 1, 4, 30))
        new = (
            bytes(rng.randrange(256) for _ in range(length)),
            b"",
            content[at : at + length] * 2,
            rng.choice(ODD).encode(),
        )
        content[at : at + length] = rng.choice(new)
    return bytes(content[: rng.randrange(len(content))] if rng.random() < 0.1 else content)


def replaced(value, rng):
    """Return JSON in which one value or key has become something else."""
    if isinstance(value, dict | list) and value and rng.random() < 0.9:
        key = rng.choice(list(value) if isinstance(value, dict) else range(len(value)))
        changed = dict(value) if isinstance(value, dict) else list(value)
        if rng.random() < 0.1:
            del changed[key]
        else:
            changed[key] = replaced(changed[key], rng)
        return changed
    return rng.choice(
        (None, True, -1, 0, 1.5, float("nan"), 10**400, "", "x", [], {}, [1, "x"], {"x": 1}, [[[]]])
    )


def broken_json(path, rng):
    text = path.read_bytes()
    return mutated(text, rng) if rng.random() < 0.4 else json.dumps(replaced(json.loads(text), rng)).encode()


def flight(path):
    time = np.arange(0.0, 120.0, 2.0)
    columns = {"time": time, "x": 2e4 + 100.0 * time, "y": 1e4 - 50.0 * time}
    if path.suffix == ".csv":
        rows = np.column_stack(list(columns.values()))
        np.savetxt(path, rows, delimiter=",", header=",".join(columns), comments="")
        return
    with netcdf_file(path, "w") as file:
        file.createDimension("time", len(time))
        for name, values in columns.items():
            file.createVariable(name, "d", ("time",))[:] = values


def episodes(i):
    return "--episodes", 0 if i % WHOLE else 1


def test_learned_policies(tmp_path, command):
    rng, file = random.Random(0), tmp_path / "agent.safetensors"
    content = (PRETRAINED / "ManeuveringTarget-v0" / "ppo.safetensors").read_bytes()
    size = int.from_bytes(content[:8], "little")
    for i in range(50):
        header = mutated(content[8 : 8 + size], rng)
        if rng.random() < 0.5:
            table = json.loads(content[8 : 8 + size])
            header = json.dumps(replaced(table, rng)).encode()
        if rng.random() < 0.5:  # words of the header that are JSON of their own
            table["__metadata__"] = json.loads(content[8 : 8 + size])["__metadata__"] | {
                rng.choice(("fields", "run", "control", "output")): rng.choice(ODD)
            }
            header = json.dumps(table).encode()
        file.write_bytes(len(header).to_bytes(8, "little") + header + content[8 + size :])
        command("evaluate", ID, "--policy", file, *episodes(i))


def test_tuned_values(tmp_path, monkeypatch, command):
    monkeypatch.chdir(tmp_path)
    rng, file = random.Random(1), tmp_path / "tuned" / "ManeuveringTarget-v0.json"
    file.parent.mkdir()
    limits = baselines_of(ID).tunable["imm"].limits
    whole = json.dumps({"imm": {"values": {name: 0.5 * sum(ends) for name, ends in limits.items()}}})
    for i in range(40):
        file.write_text(whole)
        file.write_bytes(broken_json(file, rng))
        command("evaluate", ID, "--policy", "imm-tuned", *episodes(i))


@pytest.mark.parametrize("suffix", [".csv", ".nc"])
def test_trajectories(suffix, tmp_path, command):
    rng, file = random.Random(2), tmp_path / f"flight{suffix}"
    flight(file)
    whole = file.read_bytes()
    for i in range(25):
        file.write_bytes(mutated(whole, rng))
        command("evaluate", ID, "--scenario", file, "--policy", "imm", *episodes(i), "--set", "horizon=10")


def test_results(tmp_path, command):
    rng, file = random.Random(3), tmp_path / "results.json"
    found = results_of(ID, ["imm", "imm-tuned"], None, 2, horizon=5)
    records = [r for r in found.records if r.window == "all" and "cost" in r.metric + r.component]
    write_results(file, [found._replace(records=records)], settings_of("filtergym benchmark"))
    whole = file.read_bytes()
    for i in range(15):
        file.write_bytes(whole)
        file.write_bytes(broken_json(file, rng))
        command("record", file, "--into", tmp_path / "records", program=commands.main)
        if i % 3 == 0:
            command("report", file, "--out", tmp_path / "report.html")


def test_settings(command):
    rng = random.Random(5)
    for name in ("scenario", "seed", "episodes", "control", "xp", "device", "trust", "id", "progress"):
        assert command("evaluate", ID, "--policy", "imm", "--set", f"{name}=1") == 2
    numbers = (
        "1" + "0" * 400,
        "-" * 5000 + "1",
        "1j",
        "...",
        "b'x'",
        "{[]: 1}",
        "(" * 300,
        "[" * 90 + "]" * 90,
    )
    for text in numbers:
        assert command("evaluate", ID, "--policy", "imm", "--set", f"range_sigma={text}") == 2
    for _ in range(20):
        setting = mutated(rng.choice(WORDS).encode(), rng).decode(errors="replace")
        command("evaluate", ID, "--policy", "imm", "--episodes", 1, "--set", "horizon=10", f"--set={setting}")
