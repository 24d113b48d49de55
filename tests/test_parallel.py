"""Work in several processes: the bits of one process, one sentence for what goes wrong, and what was begun goes on."""

import importlib
import inspect
import os
import shutil
import signal
import subprocess
import sys
import threading
import tracemalloc
import urllib.error
import urllib.request
import weakref
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from models import KINDS

import filtergym
from filtergym import evaluate, tidy_records
from filtergym.agents.named_policies import pretrained_agents
from filtergym.baselines import maneuvering_target, tuning
from filtergym.baselines.catalogue import baselines_of
from filtergym.baselines.problem import problem_of
from filtergym.baselines.tuned_values import TunedValues
from filtergym.envs.engine import registration
from filtergym.envs.engine.catalogue import task_class
from filtergym.evaluation.running import summary
from filtergym.evaluation.running.evaluate import run_piece
from filtergym.evaluation.running.metrics import record_statistics
from filtergym.evaluation.running.parallel import Workers
from filtergym.evaluation.running.summary import Summary, combine_summaries, run_requests, summaries
from filtergym.evaluation.storage import code
from filtergym.evaluation.storage.store import Store
from filtergym.functions import requests_of
from filtergym.names import find_competitors
from filtergym.reports.tables import benchmark

ENV = "filtergym/ManeuveringTarget-v0"
NAMES = ["imm", "imm-tuned", "known-turn", "known-input-bound", "ppo"]


@pytest.fixture(scope="module")
def two():
    with Workers(2) as workers:
        yield workers


class Wrong:
    """An estimator that cannot go on; found by the other process in this file's code."""

    def start(self, initial, N):
        return initial.mean, initial.covariance

    def update(self, memory, measurement):
        raise KeyError("nothing")


def test_an_evaluation_has_the_same_bits(two, monkeypatch):
    monkeypatch.setattr(
        "filtergym.evaluation.statistics.bootstrap.BLOCK", 16
    )  # several pieces of few episodes
    one = evaluate(ENV, NAMES, episodes=40, drawn_episodes=1)
    assert one.identical(evaluate(ENV, NAMES, episodes=40, drawn_episodes=1, workers=two))


def requests(env, names, **fields):
    problem = problem_of(env)
    return requests_of(problem, problem.experiment(**fields), find_competitors(problem, names))


@pytest.mark.parametrize("env_id", KINDS)
def test_summaries_tell_what_the_evaluation_does(env_id, short):
    """One of each kind after the other: some lack what others have, as bounds, and estimators without a bank."""
    known = baselines_of(env_id)
    kinds = (
        [known.score_paper],
        known.estimators,
        known.smoothers,
        known.references,
        known.bounds,
        pretrained_agents(env_id),
    )
    names = list(dict.fromkeys(name for kind in kinds for name in list(kind)[:1]))
    shorter = {} if env_id == ENV else short
    dataset = evaluate(env_id, names, episodes=6, drawn_episodes=1, **shorter)
    asked = requests(env_id, names, episodes=6, drawn_episodes=1, keywords=shorter)
    assert [one.episodes for one in asked] == [6] * len(names)
    summarised, kept = (run_requests(asked, Workers(), whole=whole) for whole in (False, True))
    assert kept.dataset.identical(dataset)
    assert summarised.records == kept.records == tidy_records(dataset)
    assert set(summarised.costs) == set(kept.costs)
    for name, costs in kept.costs.items():
        np.testing.assert_array_equal(summarised.costs[name], costs, err_msg=name)
    assert set(summarised.curves.variables) == set(kept.curves.variables)
    for name, expected in kept.curves.variables.items():
        np.testing.assert_array_equal(summarised.curves[name].values, expected.values, err_msg=name)
    result, whole = (
        benchmark.result_of(problem_of(env_id), one, pretrained_agents(env_id)) for one in (summarised, kept)
    )
    assert result.records == whole.records
    assert set(result.track.variables) == set(whole.track.variables)
    for name in whole.track.variables:
        np.testing.assert_array_equal(result.track[name].values, whole.track[name].values, err_msg=name)


@pytest.mark.parametrize("kind", ["one episode", "one track", "several tracks", "without truth"])
def test_competitors_in_turn_tell_what_all_at_once_do(kind, two):
    """Of flights, recordings and one episode there is no piece of some episodes: a competitor runs over all."""
    names, scenario = ["imm", "adaptive", "kalman-smoother"], None
    if kind != "one episode":
        scenario = filtergym.record(ENV, episodes=3 if kind == "several tracks" else 1, horizon=60)
    if kind == "without truth":
        scenario = replace(scenario, truth=None)
    asked = requests(ENV, names, scenario=scenario, episodes=1, drawn_episodes=1, keywords={"horizon": 60})
    whole = run_requests(asked, Workers(), whole=True)
    assert len({r.scenario for r in whole.flights}) == {"one track": 1, "several tracks": 3}.get(kind, 0)
    assert set(whole.differences) == (set() if kind == "one episode" else {"imm", "adaptive"})
    for workers in (Workers(), two) if kind == "several tracks" else (Workers(),):
        found = run_requests(asked, workers)
        assert [name for name in found.dataset if not name.startswith("drawn_")] == []
        assert found.records == whole.records == tidy_records(whole.dataset)
        assert found.flights == whole.flights
        assert found.differences == whole.differences
        assert found.dataset.attrs == whole.dataset.attrs
        assert found.costs.keys() == whole.costs.keys()
        assert set(found.curves.variables) == set(whole.curves.variables)
        for name, expected in whole.curves.variables.items():
            np.testing.assert_array_equal(found.curves[name].values, expected.values, err_msg=name)


def test_memory_does_not_grow_with_measurements_times_competitors(monkeypatch):
    monkeypatch.setattr("filtergym.evaluation.statistics.time_blocks.UNITS", 64)
    monkeypatch.setattr(summary, "DRAWN_TIMES", 64)
    recording, names = (
        filtergym.record(ENV, episodes=1, horizon=10_000),
        ["imm", "fixed-low", "adaptive", "fixed-best"],
    )
    asked = [one._replace(curves=False) for one in requests(ENV, names, scenario=recording, episodes=1)]
    run_requests(asked, Workers())  # compiles
    peaks = []
    for number in (1, 4):
        tracemalloc.start()
        run_requests(asked[:number], Workers())
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    assert peaks[1] < 1.1 * peaks[0]


def numbers_in(part):
    """How many numbers are kept of some episodes."""
    sums, samples = part.reduction.sums.values(), part.reduction.samples.values()
    return (
        sum(v.size for v in sums) + sum(v.size for pieces in samples for v in pieces) + part.head.nbytes // 8
    )


def test_of_an_episode_a_few_numbers_are_kept_and_of_a_block_nothing_else(monkeypatch):
    """Memory grows by less than one measurement an episode, and the arrays of a block go before the next is run."""
    monkeypatch.setattr("filtergym.evaluation.statistics.bootstrap.BLOCK", 8)
    problem = problem_of(ENV)
    kept, held = [], []
    for episodes in (16, 32, 64):
        [asked] = requests(ENV, problem.baselines.score_paper, episodes=episodes)
        asked = asked._replace(curves=False)
        blocks = []

        def run(*given, blocks=blocks):
            held.append(sum(block() is not None for block in blocks))
            return run_piece(*given)

        def declare(run, asked=asked, blocks=blocks):
            values = run["error"].values
            while values.base is not None:
                values = values.base
            blocks.append(weakref.ref(values))
            yield from record_statistics(run, asked.episodes, asked.metrics)

        monkeypatch.setattr(summary, "run_piece", run)
        kept.append(numbers_in(summary.reduce_episodes(asked, declare, lambda _: None)))
        assert len(blocks) == episodes // 8
    assert held == [0] * len(held)
    each = (kept[2] - kept[1]) / 32
    assert each == (kept[1] - kept[0]) / 16
    whole = evaluate(ENV, problem.baselines.score_paper, episodes=1).nbytes / 8
    assert 1 <= each < whole / 10


def shuffled(run):
    """Let pieces of work come back in another order."""

    def other(self, *arguments):
        yield from sorted(run(self, *arguments), key=lambda found: -found[0] % 7)

    return other


def test_many_episodes_are_reduced_piece_by_piece_with_the_same_bits_in_any_order(monkeypatch):
    names = ["imm", "known-turn", "known-input-bound"]
    dataset = evaluate(ENV, names, episodes=40)
    whole, expected = tidy_records(dataset), filtergym.evaluation.running.curves.curves_of(dataset)
    monkeypatch.setattr("filtergym.evaluation.statistics.bootstrap.BLOCK", 8)
    monkeypatch.setattr(summary, "TOGETHER", 16)
    asked = requests(ENV, names, episodes=40)
    assert len(asked[0].pieces()) == 3
    in_turn = dict(summaries(asked, Workers()))
    monkeypatch.setattr(Workers, "run", shuffled(Workers.run))
    in_any = dict(summaries(asked, Workers()))
    first, other = ([found[i] for i in range(3)] for found in (in_turn, in_any))
    (_, records, curves, *_), again = combine_summaries(first), combine_summaries(other)
    assert records == again.records
    assert curves.identical(again.curves)
    # Sums of blocks are rounded otherwise than those of all episodes at once.
    for own, other in zip(records, whole, strict=True):
        assert own[:8] == other[:8]
        numbers = [np.array([r.value, r.low, r.high], dtype=float) for r in (own, other)]
        np.testing.assert_allclose(*numbers, rtol=1e-9, atol=1e-12, err_msg=str(own))
    for name in expected.data_vars:
        np.testing.assert_allclose(
            curves[name].values, expected[name].values, rtol=1e-9, atol=1e-12, err_msg=name
        )


def test_distributions_are_of_so_many_measurements_however_they_come(monkeypatch):
    monkeypatch.setattr("filtergym.evaluation.running.curves.DISTRIBUTION_LIMIT", 3000)
    monkeypatch.setattr("filtergym.evaluation.statistics.bootstrap.BLOCK", 16)
    names = ["imm"]
    curves = filtergym.evaluation.running.curves.curves_of(evaluate(ENV, names, episodes=100))
    few = filtergym.evaluation.running.curves.curves_of(evaluate(ENV, names, episodes=30))
    for name in ("error_exceeded", "action", "action_low"):
        np.testing.assert_array_equal(curves[name].values, few[name].values, err_msg=name)
    assert (curves["rmse"].values != few["rmse"].values).any()


def test_a_benchmark_has_the_same_bits(two, tmp_path, monkeypatch):
    names = ("random", "imm", "ppo", "known-turn")
    cells = [benchmark.Cell(problem_of(ENV), scenario, 12, names) for scenario in ("paper", "random")]
    monkeypatch.setattr(benchmark, "cells", lambda *_: cells)
    options = benchmark.BenchmarkOptions(timed=False)
    for folder, workers in (("one", None), ("two", two)):
        benchmark.run_benchmark(tmp_path / folder, options, workers=workers)
    one, other = (tmp_path / folder / "results.json" for folder in ("one", "two"))
    assert one.read_text() == other.read_text()


def test_what_waits_is_made_again_when_it_depends_on_something_else(tmp_path, monkeypatch):
    [asked] = requests(ENV, ["imm-tuned"], episodes=4)
    store = Store(tmp_path / "unfinished")

    def read(other):
        return store.read(other.work(), Summary)

    [(_, found)] = summaries([asked], Workers(), None, store)
    assert read(asked).contender.measures == found.contender.measures
    for changed in ({"keywords": {"horizon": 50}}, {"backend": "numpy"}):
        assert read(asked._replace(experiment=replace(asked.experiment, **changed))) is None
    values = {name: 1.1 * value for name, value in problem_of(ENV).tuned_values.values("imm")[0].items()}
    monkeypatch.setattr(TunedValues, "values", lambda self, name: (values, ""))
    assert read(requests(ENV, ["imm-tuned"], episodes=4)[0]) is None
    assert requests(ENV, {"mine": Wrong}, episodes=4)[0].work() is None
    # Whether the code of an environment of one's own is what it was is not known.
    monkeypatch.setitem(registration.USER_TASKS, ENV, task_class(ENV))
    assert requests(ENV, ["imm-tuned"], episodes=4)[0].work() is None
    store.clear()
    assert not (tmp_path / "unfinished").exists()


@pytest.fixture
def edit(tmp_path, monkeypatch):
    """Write into a copy of a package, as whose code what is kept was made."""
    copy = tmp_path / "package"
    shutil.copytree(Path(maneuvering_target.__file__).parent, copy)
    monkeypatch.setattr(code, "package_folders", lambda: [copy])
    code.code_digest.cache_clear()

    def write(name, text):
        with (copy / name).open("a") as file:
            file.write(text)
        code.code_digest.cache_clear()  # another process reads it anew

    yield write
    code.code_digest.cache_clear()


@pytest.mark.parametrize(
    ("file", "same"),
    [("notes.txt", True), ("policies.py", False), ("tuned.json", False)],
)
def test_what_other_code_has_kept_is_made_again(tmp_path, edit, monkeypatch, file, same):
    """The version stays while one works on a policy, and the old one's numbers must not stand in the table."""
    [asked] = requests(ENV, ["imm"], episodes=4)
    store = Store(tmp_path / "unfinished")
    list(summaries([asked], Workers(), None, store))
    calls = []
    monkeypatch.setattr(tuning, "episode_costs", lambda *given: calls.append(1) or np.ones(8))

    def interrupted(steps):
        raise KeyboardInterrupt

    def search():
        with suppress(KeyboardInterrupt):
            tuning.tune(
                problem_of(ENV), "fixed-best", tuning.Search(20_000, episodes=8), interrupted, store=store
            )
        return len(calls)

    assert (search(), search()) == (1, 1)
    edit(file, " ")
    assert (store.read(asked.work(), Summary) is not None) is same
    assert search() == (1 if same else 2)


def test_an_error_elsewhere_is_the_same_sentence(two):
    with pytest.raises(ValueError, match="estimator 'mine' failed at measurement 1") as there:
        evaluate(ENV, {"mine": Wrong}, episodes=4, workers=two)
    assert "update" in str(there.value.__cause__)  # where it happened
    locked = Wrong()
    locked.lock = threading.Lock()
    with pytest.raises(ValueError, match="'mine' cannot be sent to another process"):
        evaluate(ENV, {"mine": locked}, episodes=4, workers=two)


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (("--jobs", "0"), "jobs must be at least 1, or -1 for all cores, got 0"),
        (
            ("--cluster", "slurm"),
            "cluster must be ray, ray://HOST:PORT, ray://auto, dask, tcp://HOST:PORT or tls://HOST:PORT, got 'slurm'",
        ),
        (("--cluster", "dask://here"), "got 'dask://here'"),
        (("--cluster", "ray://nowhere:1", "--jobs", "2"), "leave out jobs"),
    ],
)
def test_wrong_words_are_refused_before_the_work(refusal, words, sentence):
    errors = refusal("evaluate", ENV, "--policy", "imm", "--episodes", 2, *words)
    assert sentence in errors


def warned(item, tick):
    import warnings

    warnings.warn(f"beware of {item}", UserWarning, stacklevel=1)
    return item


def ended(item, tick):
    import os

    os._exit(3)


def test_warnings_come_home_once(two):
    with pytest.warns(UserWarning, match="beware of 1") as seen:
        assert sorted(two.run(warned, [1, 1, 1])) == [(0, 1), (1, 1), (2, 1)]
    assert len(seen) == 1


BEGINNER = """
import time
from filtergym.evaluation.running.parallel import Workers

def work(seconds, tick):
    if seconds:
        print("busy", flush=True)
    time.sleep(seconds)

if __name__ == "__main__":
    for _ in Workers(2).run(work, [600, 0]):
        print("idle", flush=True)
"""


@pytest.mark.skipif(sys.platform == "win32", reason="groups of processes are ended otherwise")
def test_workers_end_with_a_process_that_is_killed(tmp_path):
    """The processes that hold the pipe open: workers, busy and idle, and the tracker of their resources."""
    (tmp_path / "beginner.py").write_text(BEGINNER)
    words = [sys.executable, tmp_path / "beginner.py"]
    with subprocess.Popen(words, stdout=subprocess.PIPE, start_new_session=True) as process:
        try:
            assert {process.stdout.readline(), process.stdout.readline()} == {b"busy\n", b"idle\n"}
            process.kill()
            assert process.communicate(timeout=30)[0] == b""
        finally:
            with suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)


def test_paths_of_this_process_are_found(two, tmp_path, monkeypatch):
    (tmp_path / "mine_there.py").write_text("def double(item, tick):\n    return 2 * item\n")
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    import mine_there

    assert two.results(mine_there.double, [1, 2, 3]) == [2, 4, 6]


def lost_once(item, tick):
    """End the process at the first call; the next one finds the file."""
    import os

    if not item.exists():
        item.touch()
        os._exit(3)
    return "done"


@pytest.fixture(scope="module", params=["ray", "dask"])
def clustered(request):
    pytest.importorskip(
        {"dask": "distributed"}.get(request.param, "ray"), reason="a cluster needs filtergym[cluster]"
    )
    with Workers(2, request.param) as workers:
        yield workers


STRANGER = """
import sys
engine, address = sys.argv[1:]
if engine == "ray":
    import ray
    print("connecting", flush=True)
    ray.init(address, log_to_driver=False)
    print("executed", ray.get(ray.remote(abs).remote(-1), timeout=20))
else:
    from distributed import Client
    print("connecting", flush=True)
    print("executed", Client(address, timeout=5).submit(abs, -1).result(timeout=20))
"""


@pytest.mark.slow
def test_a_cluster_admits_only_its_own_workers(clustered):
    """Another process, of another user where there can be one, whatever it sends."""
    assert clustered.results(warned_not, [1, 2]) == [1, 2]
    if clustered.engine == "ray":
        address = sys.modules["ray"].get_runtime_context().gcs_address
        addresses, mode = [address], {"RAY_AUTH_MODE": "token", "RAY_AUTH_TOKEN": "0" * 64}
    else:
        address = clustered._dask.scheduler.address
        assert address.startswith("tls://127.0.0.1:")
        addresses, mode = [address, address.replace("tls", "tcp")], {}
        with pytest.raises(urllib.error.HTTPError, match="404"):
            urllib.request.urlopen("http://127.0.0.1:8787/info/main/workers.html", timeout=5)
    own = ("RAY_AUTH", "RAY_TMPDIR", "TMPDIR")  # folders of this user
    inherited = {name: value for name, value in os.environ.items() if not name.startswith(own)}
    other = ["setpriv", "--reuid=65534", "--regid=65534", "--clear-groups"]
    if os.getuid() != 0 or shutil.which("setpriv") is None:
        other = []
    for address in addresses:
        done = subprocess.run(
            [*other, sys.executable, "-c", STRANGER, clustered.engine, address],
            env={**inherited, "HOME": "/tmp", **mode},
            cwd="/tmp",
            capture_output=True,
            text=True,
            check=False,
        )
        assert done.returncode != 0
        assert done.stdout.split() == ["connecting"]


def warned_not(item, tick):
    return item


@pytest.mark.slow
def test_a_cluster_has_the_same_bits_and_loses_nothing(clustered, tmp_path, monkeypatch):
    names = ["imm", "imm-tuned", "known-turn"]
    one = evaluate(ENV, names, episodes=10)
    assert one.identical(evaluate(ENV, names, episodes=10, workers=clustered))
    with pytest.raises(ValueError, match="estimator 'mine' failed at measurement 1"):
        evaluate(ENV, {"mine": Wrong}, episodes=4, workers=clustered)
    (tmp_path / "elsewhere.py").write_text(inspect.getsource(lost_once))
    monkeypatch.syspath_prepend(tmp_path)
    elsewhere = importlib.import_module("elsewhere")
    flags = [tmp_path / "first", tmp_path / "second"]
    assert clustered.results(elsewhere.lost_once, flags) == ["done", "done"]
    sys.modules.pop("elsewhere")


def test_tuning_finds_the_same_values(two):
    from filtergym.baselines.tuning import Search, tune

    tunable = baselines_of(ENV).tunable["fixed-best"]
    budget = 2 * (4 * len(tunable.limits) + 4) * 40 * 100
    asked = (problem_of(ENV), "fixed-best", Search(budget, episodes=40))
    assert tune(*asked) == tune(*asked, workers=two)


def test_tuning_goes_on_where_it_ended(tmp_path, monkeypatch):
    tunable = baselines_of(ENV).tunable["fixed-best"]
    budget = 2 * (4 * len(tunable.limits) + 4) * 8 * 100
    asked = (problem_of(ENV), "fixed-best", tuning.Search(budget, episodes=8))
    calls, own, last = [], tuning.episode_costs, 0

    def counted(*arguments):
        calls.append(arguments)
        if len(calls) == last:
            raise KeyboardInterrupt
        return own(*arguments)

    monkeypatch.setattr(tuning, "episode_costs", counted)
    # A candidate that the search comes back to is kept, so that the budget does not say how many are run.
    whole, all_calls = tuning.tune(*asked, store=Store(tmp_path / "first")), len(calls)
    assert all_calls >= whole.environment_steps // 800
    calls.clear()
    last = 10
    folder = tmp_path / "unfinished"
    with pytest.raises(KeyboardInterrupt):
        tuning.tune(*asked, store=Store(folder))
    kept = sorted(folder.iterdir())
    assert len(kept) == 9
    kept[0].write_bytes(b"half")  # what a crash may leave
    assert tuning.tune(*asked, store=Store(folder)) == whole
    assert len(calls) == 10 + 1 + all_calls - 9
    assert not folder.exists()


def test_units_of_a_reproduction_stand_in_their_places(two):
    from filtergym.evaluation.running.threads import one_thread
    from filtergym.papers.imm_alpha_beta.experiment import run_policy, squares_of
    from filtergym.papers.reproduction import compute_units, later

    asked = {
        ("imm", 1): [later(run_policy, "imm", 8), 3.0],
        "few": (later(squares_of, "adaptive", 8, gains=(0.3, 0.8)),),
    }
    counts = []
    one, other = (compute_units(asked, counts.append, workers) for workers in (None, two))
    assert counts == [1] * 4
    assert one["imm", 1][1] == 3.0
    with one_thread():  # as units run; two threads of BLAS may add up in another order
        alone = squares_of("adaptive", 8, gains=(0.3, 0.8))
    np.testing.assert_array_equal(one["few"][0], alone)
    np.testing.assert_array_equal(one["few"][0], other["few"][0])
    for name, values in one["imm", 1][0]._asdict().items():
        np.testing.assert_array_equal(values, getattr(other["imm", 1][0], name))


def test_a_lost_process_is_one_sentence(two):
    """The last one with these workers, as the next test begins others."""
    with pytest.raises(ValueError, match="ended from outside"):
        list(two.run(ended, [1]))
    assert list(two.run(warned, [])) == []
