"""Frozen protocols: the file does not change, the number follows from its formula, the row repeats on any processor."""

import math
import os
import re
import subprocess
import sys

import numpy as np
import pytest

import filtergym
from filtergym import protocol as protocols
from filtergym.commands.protocol import quoted_row
from filtergym.envs.engine.catalogue import catalogue
from filtergym.evaluation.running.parallel import Workers
from filtergym.protocol import find_entries, read_protocol, run_protocol

FROZEN = {"filtergym-1": "65167198a694497c9f9f64ba2c42e2105399fed2f068f14d1f698ac6bfc93c91"}
"""SHA-256 of every protocol that was ever published. Who changes one adds a file with the next number."""
SMALL = """
name = "small"
year = 2026
split = "test"
seed = 3
episodes = 12
held_out_episodes = 6
resamples = 1000
statistic = "as of filtergym-1"
time = "as of filtergym-1"

[[environments]]
id = "filtergym/ManeuveringTarget-v0"
interface = 2
paper = "imm-steady-state"
lost_cost = 100.0
training = "random"
held_out = ["atc", "glint"]

[[environments]]
id = "filtergym/UavAutopilot-v0"
interface = 5
paper = "kalman"
lost_cost = 100.0
training = "random"
"""


@pytest.fixture(scope="module")
def small(tmp_path_factory):
    """Path of a protocol of few episodes of two environments."""
    path = tmp_path_factory.mktemp("protocol") / "small.toml"
    path.write_text(SMALL, encoding="utf-8")
    return str(path)


def entered(path, *words):
    """Run what is entered in a protocol."""
    protocol, digest = read_protocol(path)
    return run_protocol(protocol, digest, find_entries(protocol, words), Workers())


@pytest.fixture(scope="module")
def found(small):
    """What comes out for an agent."""
    return entered(small, "bptt-small")


def test_published_protocols_are_frozen():
    assert {name: read_protocol(name)[1] for name in protocols.protocol_names()} == FROZEN


def test_the_newest_protocol_has_the_highest_number(tmp_path, monkeypatch):
    for name in ("filtergym-10.toml", "filtergym-2.toml", "filtergym-9.toml", "__init__.py"):
        (tmp_path / name).touch()
    monkeypatch.setattr(protocols, "FOLDER", tmp_path)
    assert protocols.protocol_names() == ["filtergym-2", "filtergym-9", "filtergym-10"]


def test_filtergym_1_is_of_all_five_environments_and_of_scenarios_that_there_are():
    """Of every scenario that shipped with it; one that came later waits for the next protocol."""
    protocol, _ = read_protocol("filtergym-1")
    shipped = {id: task for id, task in catalogue().items() if id.startswith("filtergym/")}
    assert {own.id for own in protocol.environments} == {*shipped}
    for own in protocol.environments:
        assert {own.training, *own.held_out} <= {*shipped[own.id].scenarios}
        assert [name for name, one in shipped[own.id].scenarios.items() if one.training] == [own.training]


def test_the_number_follows_the_formula(found):
    """Against costs of episodes that ``evaluate`` gives, one environment and episode after another."""
    logarithms, lost = [], []
    for own in found.protocol.environments:
        dataset = filtergym.evaluate(own.id, ["bptt-small", own.paper], None, 12, 3)
        costs = dataset["cost"].mean("time")
        logs = [math.log(costs.values[0, i] / costs.values[1, i]) for i in range(12)]
        logarithms.append(sum(logs) / 12)
        lost.append(float((costs.values[0] > own.lost_cost).mean()))
    assert found.cost.value == pytest.approx(math.exp(sum(logarithms) / 2) - 1, rel=1e-12)
    assert found.cost.low < found.cost.value < found.cost.high
    assert found.lost == sum(lost) / 2
    for one, logarithm in zip(found.environments, logarithms, strict=True):
        assert one.cost.value == pytest.approx(math.expm1(logarithm), rel=1e-12)
    costs = {}
    for name in ("atc", "glint"):
        dataset = filtergym.evaluate("ManeuveringTarget", ["bptt-small", "imm-steady-state"], name, 6, 3)
        [costs[name]] = [
            r.value
            for r in filtergym.tidy_records(dataset)
            if (r.metric, r.policy) == ("geometric_cost_difference", "bptt-small")
        ]
    worst = max(costs, key=costs.get)
    assert found.environments[0].worst == (worst, pytest.approx(costs[worst], rel=1e-12))
    assert found.environments[1].worst is None


def test_the_interval_covers_what_many_episodes_say(found):
    """The interval of the number is that of a bootstrap of whole episodes, all environments at once."""
    values = np.stack([one.logarithms for one in found.environments])
    generator = np.random.default_rng(1)
    naive = [np.expm1(values[:, generator.integers(0, 12, 12)].mean()) for _ in range(20_000)]
    ends = np.percentile(naive, [2.5, 97.5])
    # Of a thousand resamples an end is off by about 5 % of the interval's half width.
    np.testing.assert_allclose([found.cost.low, found.cost.high], ends, atol=0.2 * (ends[1] - ends[0]) / 2)


def test_the_papers_algorithms_are_zero(small):
    found = entered(small, "imm-steady-state", "UavAutopilot=kalman")
    assert found.cost.value == found.cost.low == found.cost.high == 0.0
    assert found.title == "imm-steady-state, kalman"


def test_no_number_without_all_environments(small):
    found = entered(small, "UavAutopilot=mehra")
    assert found.cost is found.lost is found.time is None
    assert quoted_row(found)[-1].startswith("| mehra | - | - | 1 of 2 |")


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        ([], "--protocol needs a competitor"),
        (["imm", "adaptive"], "two competitors for all environments"),
        (["semi-markov"], "UavAutopilot-v0: unknown policy 'semi-markov'.*--policy UavAutopilot=NAME"),
        (["UavAutopilot=true-state"], "'true-state' is a reference: only policies and estimators"),
    ],
)
def test_what_may_not_enter(small, words, sentence):
    with pytest.raises(ValueError, match=sentence):
        find_entries(read_protocol(small)[0], words)


@pytest.mark.parametrize(
    ("old", "new", "sentence"),
    [
        (
            "interface = 5",
            "interface = 4",
            "states interface of filtergym/UavAutopilot-v0 4, and this package has 5",
        ),
        ("lost_cost = 100.0", "lost_cost = 1e9", "states lost_cost"),
        ("resamples = 1000", "resamples = 10", "states resamples 10"),
        ('"glint"', '"glimt"', "unknown scenario of filtergym/ManeuveringTarget-v0 'glimt'"),
        ('"kalman"', '"true-state"', "unknown paper of filtergym/UavAutopilot-v0 'true-state'"),
        ("seed = 3", "seeds = 3", "contains no protocol"),
        ('split = "test"', 'split = "train"', "contains no protocol"),
    ],
)
def test_what_is_no_protocol_of_this_package(tmp_path, old, new, sentence):
    path = tmp_path / "altered.toml"
    path.write_text(SMALL.replace(old, new, 1), encoding="utf-8")
    with pytest.raises(ValueError, match=sentence):
        read_protocol(str(path))


def row_of(output):
    """Return the row to quote without the time, and the digest of the bib entry."""
    row = next(line for line in output.splitlines() if line.startswith("| bptt-small"))
    return row.rpartition("|")[0].rpartition("|")[0], re.search(r"SHA-256 (\w{64})", output)[1]


BARE = {"FILTERGYM_COMPILER_PROCESSOR": "x86-64", "OPENBLAS_CORETYPE": "Prescott", "OMP_NUM_THREADS": "2"}
"""Settings of a processor that can do the least, of which libraries take two threads."""


@pytest.mark.slow
def test_the_row_does_not_depend_on_the_processor(small, tmp_path, success):
    """Nor on who shares the work, nor on whether it is compiled."""
    words = ["evaluate", "--protocol", small, "--policy", "bptt-small"]
    rows = []
    for more in ([], ["--backend", "numpy"]):
        shown = success(*words, *more)
        rows.append(row_of(shown))
    done = subprocess.run(
        [sys.executable, "-m", "filtergym", *words, "--jobs", "2"],
        env={**os.environ, **BARE, "COLUMNS": "100"},
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert rows == [row_of(done.stdout)] * 2


def test_what_the_command_prints_and_refuses(small, tmp_path, command, refusal):
    records = tmp_path / "records.json"
    words = ("--policy", "adaptive", "--policy", "UavAutopilot=mehra", "--json", records)
    code, shown, errors = command("evaluate", "--protocol", small, *words)
    assert code == 0, errors
    _, digest = read_protocol(small)
    assert "| adaptive, mehra | " in shown
    assert "vs kalman" in shown  # each environment names whom costs are compared with
    assert f"protocol SHA-256 {digest}" in shown
    assert re.search(r"@misc\{small,\n(  \w+ = \{[^\n]+\},\n)+\}", shown)
    assert "year = {2026}" in shown
    assert records.stat().st_size > 1000
    for words in (["--seed", "1"], ["--scenario", "glint"], ["--out", "x"], ["--set", "horizon=5"]):
        assert f"leave out {words[0]}" in refusal(
            "evaluate", "--protocol", small, "--policy", "adaptive", *words
        )
    assert "leave out the environment" in refusal(
        "evaluate", "filtergym/UavAutopilot-v0", "--protocol", small, "--policy", "kalman"
    )
