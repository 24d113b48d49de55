"""No competitor costs significantly less than its reference, by benchmarks/limits.py over few episodes."""

import importlib.util
import sys
from dataclasses import replace
from pathlib import Path

import pytest
from filtergym.baselines.problem import problem_of

from filtergym.reports.benchmark import affordable_episodes, benchmark_policies, ranked_names

spec = importlib.util.spec_from_file_location(
    "limits", Path(__file__).parent.parent / "benchmarks" / "limits.py"
)
limits = importlib.util.module_from_spec(spec)
sys.modules["limits"] = limits
spec.loader.exec_module(limits)


@pytest.mark.slow
def test_no_competitor_is_significantly_better_than_its_reference(env_id):
    problem = problem_of(env_id)
    strongest = [name for name in benchmark_policies(problem, False) if name in ranked_names(problem)]
    for scenario in problem.task.scenarios:
        found = limits.nearest(problem, scenario, affordable_episodes(problem, scenario, 100), 1, strongest)
        assert not found.below, f"{scenario}: {found.reference} is {found.verdict}"


def test_who_is_told_less_than_a_competitor_is_no_limit():
    """A reference that is beaten is named as beaten, and by whom."""
    problem = problem_of("filtergym/ManeuveringTarget-v0")
    weak = replace(problem, baselines=replace(problem.baselines, score_reference="hard-imm"))
    found = limits.nearest(weak, "random", 100, 1, ["kalman-imm", "imm", "fixed-low"])
    assert found.name == "kalman-imm"
    assert {"kalman-imm", "imm"} <= set(found.below)
    assert found.relative < 0.0
    assert found.verdict.startswith("beaten by")
