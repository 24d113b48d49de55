"""Tolerances that follow from conditioning: how far rounding may take a result.

Processors and libraries agree on the sum or product of two numbers. They differ in functions, by up to four units in
the last place, in the order of longer sums, and in products and sums made by one instruction. What that does to a
result is found in the test: the reference computation is repeated with its inputs, and with all that one part of it
hands to the next, moved by up to one unit in the last place. The largest change of the result, times :data:`SAFETY`,
is its tolerance.

A number is moved by giving it another last bit, which follows from its other bits and a pattern: equal numbers stay
equal, and what is only handed on is moved once. Numbers that single precision holds, such as counts and limits, come
from operations that are exact and stay.
"""

import dataclasses
import functools

import numpy as np

from filtergym.compiler.functions import map_arrays

SAFETY = 32.0
"""Eight, because two libraries may be off by four units each in opposite directions, and sums of some ten terms by as
many in two orders. Four, because the largest of a few changes falls short of the worst."""
REPETITIONS = (0, 1)
"""Numbers of the repetitions that a test makes of several lanes."""
LOOSEST = 1e-4
"""A result, or one, times this is the largest tolerance: results that rounding moves further are not compared."""
PARTS = {"world": ("begin", "advance"), "filter": ("start", "predict", "act")}
"""Methods of the parts of a task that are called within a step."""


def moved(part, pattern):
    """Return nested tuples of arrays or tensors with numbers moved; in a tensor also what flows back in a gradient.

    Args:
        part: arrays ``(..., N)``.
        pattern: an integer, or one for each lane, ``(N,)``.
    """
    return map_arrays(lambda leaf: _moved(leaf, pattern), part)


def _moved(leaf, pattern):
    plain = leaf if isinstance(leaf, np.ndarray) else leaf.detach().cpu().numpy()
    if plain.dtype != np.float64:
        return leaf
    changes = _changes_of_last_bits(plain, pattern)
    if plain is leaf:
        return leaf + changes
    other = leaf + leaf.new_tensor(changes)
    if other.requires_grad:
        other.register_hook(lambda gradient: _moved(gradient.detach(), pattern))
    return other


def _changes_of_last_bits(values, pattern):
    others = np.ascontiguousarray(values).view(np.uint64) >> np.uint64(1)
    mixed = (others + np.asarray(pattern, dtype=np.uint64)) * np.uint64(0x9E3779B97F4A7C15)
    changed = (others << np.uint64(1) | mixed >> np.uint64(63)).view(np.float64)
    with np.errstate(over="ignore", under="ignore"):
        inexact = np.isfinite(values) & (values.astype(np.float32) != values)
    return np.subtract(changed, values, out=np.zeros_like(values), where=inexact)


def move_roundings(env, repetition=0):
    """Let the parts of the steps of an environment move what they return, in every lane otherwise; return it.

    Args:
        env: on NumPy or torch, before its first reset; others are not touched.
        repetition: another number gives other patterns.
    """
    lanes = env.unwrapped.fleet.only
    pattern = 1000 * repetition + np.arange(lanes.width)
    beside = lanes.baseline.model if lanes.baseline else lanes.model
    for model in {id(model): model for model in (lanes.model, beside)}.values():
        parts = ((model.task.world, "world"), (model.filter, "filter"))
        for owner, names in (
            (model, ("observe", "counted_cost", "feedback")),
            *((part, PARTS[p]) for part, p in parts),
        ):
            for name in names:
                setattr(owner, name, _that_moves(getattr(owner, name), pattern))
    return env


def moved_parameters(parameters, pattern=0):
    """Return the parameters of a task that are real numbers, moved, as keywords for its environments."""
    named = {field.name: getattr(parameters, field.name) for field in dataclasses.fields(parameters)}
    return {
        name: float(moved(np.array([value]), pattern)[0])
        for name, value in named.items()
        if type(value) is float
    }


def _that_moves(function, pattern):
    return lambda *arguments: moved(function(*arguments), pattern)


def tolerance(reference, repetitions, lanes=None, time=None):
    """Tolerance of a result, an array.

    Args:
        reference: the result, of any shape.
        repetitions: the same with roundings moved, arrays of that shape.
        lanes: axis of the lanes; the largest change in any of them counts for all.
        time: axis of the steps; the largest change up to a step counts for it.
    """
    changes = np.max([np.abs(np.asarray(other) - reference) for other in repetitions], axis=0)
    sizes = np.abs(reference)
    if lanes is not None:
        changes, sizes = (
            np.nanmax(part, axis=lanes, keepdims=True, initial=0.0) for part in (changes, sizes)
        )
    if time is not None:
        changes = np.maximum.accumulate(changes, axis=time)
    allowed = SAFETY * (changes + np.spacing(np.abs(reference)))
    loosest = np.nanmax(allowed / (1.0 + sizes), initial=0.0)
    assert loosest <= LOOSEST, f"rounding leaves nothing to compare: it explains {loosest:.2g}"
    return allowed


def assert_near(found, expected, allowed, name=""):
    """Assert that a result differs from an expected one by what is allowed at most; NaN stands where NaN stands."""
    found, expected = np.asarray(found), np.asarray(expected)
    assert found.shape == expected.shape, name
    if expected.dtype.kind != "f":
        np.testing.assert_array_equal(found, expected, err_msg=name)
        return
    same = (found == expected) | (np.isnan(found) & np.isnan(expected))
    with np.errstate(invalid="ignore"):
        off = np.where(same, 0.0, np.abs(found - expected) / allowed)
    worst = np.unravel_index(np.argmax(off), off.shape) if off.size else ()
    assert np.all(off <= 1.0), (
        f"{name} {found[worst]!r} at {worst} is not {expected[worst]!r}: "
        f"{off[worst]:.2g} times what rounding explains"
    )


def assert_same(found, reference, repetitions, name="", **axes):
    """Assert that a result is that of a reference computation within its :func:`tolerance`.

    Args:
        found: the result.
        reference: of the reference computation.
        repetitions: the same with roundings moved, or a function that returns them, which is called only where the
            least that a tolerance can be does not suffice.
        name: of the result.
        axes: of :func:`tolerance`.
    """
    reference, allowed = np.asarray(reference), 0.0
    if reference.dtype.kind == "f":
        least = SAFETY * np.spacing(np.abs(reference))
        if callable(repetitions):
            with np.errstate(invalid="ignore"):
                off = np.abs(np.asarray(found) - reference)
            explained = np.all((off <= least) | (np.isnan(found) & np.isnan(reference)))
            repetitions = None if explained else repetitions()
        allowed = least if repetitions is None else tolerance(reference, repetitions, **axes)
    assert_near(found, reference, allowed, name)


def flown_side_by_side(fly, make, make_reference):
    """What is found in an environment, in its reference, and a function that finds it with roundings moved.

    Args:
        fly: returns what is found in an environment.
        make: the environment.
        make_reference: the same on NumPy.
    """
    moved = functools.cache(lambda: [fly(move_roundings(make_reference(), r)) for r in REPETITIONS])
    return fly(make()), fly(make_reference()), moved
