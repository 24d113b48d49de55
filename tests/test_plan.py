"""The plan of benchmarks/plan.py: how items of work are given out, against a clock that ticks once a second."""

import importlib.util
import sys
from pathlib import Path

import numpy as np
import pytest

spec = importlib.util.spec_from_file_location("plan", Path(__file__).parent.parent / "benchmarks" / "plan.py")
plan = importlib.util.module_from_spec(spec)
sys.modules["plan"] = plan  # its named tuples look for their module
spec.loader.exec_module(plan)


def ticking(items, cores, start):
    """Give out items of whole seconds second by second, and take them in one after the other."""
    now = taken = start
    left, ended, waiting = {}, [], set(range(len(items)))
    while waiting or left:
        free = [i for i in waiting if items[i].after < 0 or items[i].after in ended]
        free.sort(key=lambda i: (items[i].kind == "evaluation", -items[i].seconds, i))
        for i in free[: cores - len(left)]:
            waiting.remove(i)
            left[i] = items[i].seconds
        now += 1
        left = {i: seconds - 1 for i, seconds in left.items()}
        ended += (done := sorted(i for i, seconds in left.items() if seconds == 0))
        left = {i: seconds for i, seconds in left.items() if seconds}
        for i in done:
            taken = max(taken, now) + items[i].parent
    return taken


@pytest.mark.parametrize("cores", [2, 3, 7])
def test_items_are_given_out_as_by_a_clock(cores):
    rng = np.random.default_rng(cores)
    for _ in range(20):
        items = []
        for i in range(30):
            after = int(rng.integers(-1, i)) if i and rng.random() < 0.5 else -1
            kind = "training" if rng.random() < 0.3 else "evaluation"
            items.append(plan.Item(kind, "", "", int(rng.integers(1, 9)), after, int(rng.integers(0, 3))))
        assert plan.makespan(items, cores, 5) == ticking(items, cores, 5)


def test_one_process_does_everything_one_after_the_other():
    items = [plan.Item("evaluation", "", "", 3.0, -1, 0.5), plan.Item("evaluation", "", "", 2.0, 0, 0.25)]
    assert plan.makespan(items, 1, 1.0) == 6.75


def test_who_takes_items_in_can_be_what_all_wait_for():
    items = [plan.Item("evaluation", "", "", 1.0, -1, 10.0) for _ in range(8)]
    assert plan.makespan(items, 8, 0.0) == 81.0
