"""What is said of published numbers: coverage of intervals, and numbers that are repeated, by their benchmarks."""

import importlib.util
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest


def imported(name):
    """Return a benchmark as a module."""
    spec = importlib.util.spec_from_file_location(
        name, Path(__file__).parent.parent / "benchmarks" / f"{name}.py"
    )
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    spec.loader.exec_module(module)
    return module


def test_intervals_of_a_light_tail_hold_the_truth_and_those_of_a_heavy_one_do_not():
    """Of lognormal costs the logarithm is normal, and the mean belongs to few episodes."""
    coverage, rng = imported("interval_coverage"), np.random.default_rng(0)
    paper = np.exp(rng.normal(size=4000) * 3.0)
    pool = coverage.Pool(paper, paper * np.exp(rng.normal(size=4000) * 2.0 - 0.5), 10.0)
    geometric, lost, means = (float(text.split()[0]) for text in coverage.coverage(pool, 100, 100))
    # Of a hundred intervals of 95 %, five misses, and three standard deviations of them more.
    assert geometric > 0.88
    assert lost > 0.88
    assert means < 0.88


def test_two_samples_of_a_number_agree_as_often_as_intervals_hold():
    """The difference of two independent estimates is wider than either interval by the root of two."""
    repeat, rng = imported("repeat_numbers"), np.random.default_rng(1)
    pairs = rng.normal(size=(2000, 2))
    records = [[SimpleNamespace(value=v, low=v - 1.96, high=v + 1.96) for v in pair] for pair in pairs]
    assert np.mean([repeat.agrees(*pair) for pair in records]) == pytest.approx(0.95, abs=0.015)


def test_numbers_that_are_repeated_are_those_of_the_pages():
    repeat = imported("repeat_numbers")
    found = list(repeat.published_numbers())
    assert len(found) > 40
    assert "README.md" in {one.page for one in found}
    assert {one.quantity for one in found} >= {"difference", "behind", "score"}
    assert all(one.record.low < one.record.value < one.record.high for one in found)
