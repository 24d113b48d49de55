"""Every environment of the catalogue, for the tests that hold for all of them.

A test that asks for ``env_id`` runs once for every environment, unless it names some; one that asks for ``control``
too, once for every control of every environment. A new environment is covered without an edit.
"""

import ctypes
import functools
import gc
import importlib
import os
import re
import sys
import tempfile
from pathlib import Path

import hypothesis
import pytest
from models import random_actions, short_episodes
from own_models import make_models

from filtergym.__main__ import main
from filtergym.commands.terminal import console, output_width
from filtergym.envs.engine import compiled
from filtergym.envs.engine.catalogue import catalogue

# The process that spreads the tests has imported readline, which exports the width of its terminal to its children.
os.environ.pop("COLUMNS", None)
console.width = output_width()

# The same examples in every run, and no stored ones: a run can be repeated anywhere.
hypothesis.settings.register_profile("repeatable", derandomize=True, deadline=None, database=None)
hypothesis.settings.load_profile("repeatable")

# Test after test goes through every control of every environment: more than a process usually remembers.
compiled._trace_once = functools.lru_cache(32)(compiled._trace)


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config, log):
    """Give whole files to the processes, and all that is of TightlyCoupledNavigation to one of them.

    Its programs take seconds to compile, and a process traces them once.
    """
    if config.getvalue("dist") != "loadfile":
        return None
    from xdist.scheduler import LoadScopeScheduling

    class Scheduling(LoadScopeScheduling):
        def _split_scope(self, nodeid):
            if re.search("tightly_?coupled", nodeid, re.IGNORECASE):
                return "TightlyCoupledNavigation"
            return nodeid.split("::", 1)[0]

    return Scheduling(config, log)


def pytest_collectstart(collector):
    """Let the garbage collector wait until all tests are there."""
    gc.disable()


def pytest_collection_finish(session):
    """Spare the garbage collector what stays to the end, libraries and tests; it would look through it many times."""
    gc.enable()
    gc.collect()
    gc.freeze()


LARGEST, GROWN = 700, 100
"""Resident memory in MB beyond which a process forgets its traces before it takes the next file, and by how much more
it may grow then: what stays are libraries, and to look through everything takes half a second."""
_remained = [0]


@pytest.hookimpl(trylast=True)
def pytest_runtest_teardown(item, nextitem):
    """Forget what was traced for one file before the next, where that has grown large."""
    if nextitem is None or nextitem.path == item.path or _resident() < max(LARGEST, _remained[0] + GROWN):
        return
    compiled._make_once.cache_clear()
    compiled._trace_once.cache_clear()
    gc.collect()
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
    if trim:  # gives back to the system what the C library keeps
        trim(0)
    _remained[0] = _resident()


def _resident():
    """Resident memory of this process, MB; 0 where Linux does not tell it."""
    status = Path("/proc/self/statm")
    return int(status.read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") // 2**20 if status.is_file() else 0


@pytest.fixture(scope="session", autouse=True)
def _temporary_folder(tmp_path_factory):
    """Give this process a temporary folder of its own, and fail if something is left in it after the last test.

    Its name is short, since the path of a socket in it must be.
    """
    tmp_path_factory.getbasetemp()  # made where it would be otherwise
    with tempfile.TemporaryDirectory(prefix="filtergym-") as place, pytest.MonkeyPatch.context() as patch:
        own, of_libraries = Path(place, "own"), Path(place, "libraries")
        own.mkdir()
        patch.setenv("TMPDIR", str(own))
        patch.setattr(tempfile, "tempdir", None)  # from the variable at its next use
        # Stable-Baselines3 leaves a folder for each model without a logger, Torch a cache, Ray and Dask their logs.
        for variable in ("SB3_LOGDIR", "TORCHINDUCTOR_CACHE_DIR", "RAY_TMPDIR", "DASK_TEMPORARY_DIRECTORY"):
            patch.setenv(variable, str(of_libraries))
        yield
        left = sorted(path.name for path in own.iterdir())
        assert not left, f"tests have left these in the temporary folder: {left}"


def pytest_generate_tests(metafunc):
    """Fill in the catalogue."""
    own = [mark.args[0] for mark in metafunc.definition.iter_markers("parametrize")]
    if "env_id" not in metafunc.fixturenames or "env_id" in own:
        return
    paired = metafunc.definition.get_closest_marker("with_controls")
    if paired:
        names, cases = paired.args
        metafunc.parametrize(("env_id", "control", *names), mark_slow(paired_controls(cases)))
        return
    if "control" in metafunc.fixturenames:
        cases = [(id, control) for id, cls in catalogue().items() for control in cls.controls]
        metafunc.parametrize(("env_id", "control"), mark_slow(cases))
    else:
        metafunc.parametrize("env_id", list(catalogue()))


SLOW_CONTROLS = {("filtergym/TightlyCoupledNavigation-v0", "hypotheses")}
"""Controls whose programs take ten seconds to compile."""


def mark_slow(rows):
    """Mark the rows ``(env_id, control, ...)`` of slow controls."""
    return [pytest.param(*row, marks=pytest.mark.slow) if row[:2] in SLOW_CONTROLS else row for row in rows]


def paired_controls(cases):
    """Every case under the first control of every environment, and the cases in turn under its other controls.

    Args:
        cases: lists of further parameters of a test.

    Returns:
        rows ``(env_id, control, *case)`` for ``parametrize``.
    """
    rows = []
    for id, cls in catalogue().items():
        first, *others = cls.controls
        rows += [(id, first, *case) for case in cases]
        rows += [(id, control, *cases[i % len(cases)]) for i, control in enumerate(others)]
    return rows


@pytest.fixture
def short(env_id):
    """Keywords that make episodes of an environment five decisions long, of two measurements at most."""
    return short_episodes(env_id)


@pytest.fixture(name="random_actions")
def _random_actions():
    return random_actions


@pytest.fixture
def make(request):
    """Make a state-space environment with a name of its own, forgotten afterwards.

    Keywords that all of a file's environments have are its ``COMMON``.
    """
    yield from make_models(getattr(request.module, "COMMON", {}))


@pytest.fixture
def command(monkeypatch, capsys):
    """Run the command line; returns exit code, output and errors."""
    # As the command finds modules: not where the tests were started, where a reader may have written README's mine.py.
    root = str(Path(__file__).parent.parent)
    monkeypatch.setattr("sys.path", [place for place in sys.path if place != root])

    def run(*words, program=main):
        monkeypatch.setattr("sys.argv", ["filtergym", *map(str, words)])
        with pytest.raises(SystemExit) as ended:
            program()
        return ended.value.code, *capsys.readouterr()

    return run


@pytest.fixture
def success(command):
    """Run the command line, which must succeed; returns its output."""

    def run(*words, **keywords):
        code, shown, errors = command(*words, **keywords)
        assert code == 0, errors
        return shown

    return run


@pytest.fixture
def refusal(command):
    """Run the command line, which must refuse the words in one sentence; returns the sentence."""

    def run(*words, **keywords):
        code, _, errors = command(*words, **keywords)
        assert (code, errors.count("\n")) == (2, 1), errors
        return errors

    return run


@pytest.fixture
def without_figures(monkeypatch):
    """Let `evaluate --out` draw no figures, which takes seconds, for tests that look at the other files."""
    for name in ("evaluation_figures", "worst_figures"):
        monkeypatch.setattr(f"filtergym.commands.evaluation.{name}", lambda *_, **__: ())


@pytest.fixture
def make_page(command):
    """Run ``python docs/make``; returns exit code, output and errors."""
    import commands

    return functools.partial(command, program=commands.main)


@pytest.fixture
def torch():
    """Torch with the functions of the array API standard; tests that ask for it are skipped without it.

    Files of which every test needs a library say ``pytest.importorskip`` at their head.
    """
    pytest.importorskip("torch")
    return importlib.import_module("array_api_compat.torch")
