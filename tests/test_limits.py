"""Whether references are limits, by benchmarks/limits.py over few episodes."""

import importlib.util
import sys
from dataclasses import replace
from pathlib import Path

from filtergym.baselines.problem import problem_of

spec = importlib.util.spec_from_file_location(
    "limits", Path(__file__).parent.parent / "benchmarks" / "limits.py"
)
limits = importlib.util.module_from_spec(spec)
sys.modules["limits"] = limits
spec.loader.exec_module(limits)


def test_a_reference_that_knows_less_than_a_competitor_is_no_limit():
    """A reference that is beaten is named as beaten, and by whom."""
    problem = problem_of("filtergym/ManeuveringTarget-v0")
    weak = replace(problem, baselines=replace(problem.baselines, score_reference="fixed-low"))
    found = limits.nearest(weak, "random", 100, 1, ["kalman-imm", "imm", "fixed-high"])
    assert found.name == "kalman-imm"
    assert {"kalman-imm", "imm"} <= set(found.below)
    assert found.relative < 0.0
    assert found.verdict.startswith("beaten by")
