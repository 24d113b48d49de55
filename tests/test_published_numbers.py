"""Coverage of published intervals, by its benchmark."""

import importlib.util
import sys
from pathlib import Path

import numpy as np


def test_intervals_of_a_light_tail_hold_the_truth_and_those_of_a_heavy_one_do_not():
    """Of lognormal costs the logarithm is normal, and the mean belongs to few episodes."""
    file = Path(__file__).parent.parent / "benchmarks" / "interval_coverage.py"
    spec = importlib.util.spec_from_file_location(file.stem, file)
    sys.modules[file.stem] = coverage = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(coverage)
    rng = np.random.default_rng(0)
    paper = np.exp(rng.normal(size=4000) * 3.0)
    pool = coverage.Pool(paper, paper * np.exp(rng.normal(size=4000) * 2.0 - 0.5), 10.0)
    geometric, lost, means = (float(text.split()[0]) for text in coverage.coverage(pool, 100, 100))
    # Of a hundred intervals of 95 %, five misses, and three standard deviations of them more.
    assert geometric > 0.88
    assert lost > 0.88
    assert means < 0.88
