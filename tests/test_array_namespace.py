"""Nested numbers and arrays: stacked and chosen lane by lane, as loops do it."""

from typing import NamedTuple

import numpy as np

from filtergym.filters.array_namespace import lane_arrays, namespace, select_nested, stack_nested


class Pair(NamedTuple):
    """What travels together."""

    first: np.ndarray
    others: dict


def test_namespaces_are_those_of_the_arrays(torch):
    assert namespace(np.zeros(2)) is namespace(np.float64(1.0)) is np
    assert namespace(torch.zeros(2)) is torch


def test_lists_of_numbers_and_arrays_are_stacked_with_a_lane_axis():
    lanes = np.arange(3.0)
    nested = [[1.0, lanes], [2.0 * lanes, 4]]
    found = stack_nested(nested, np.zeros(3), np)
    for n in range(3):
        np.testing.assert_array_equal(found[..., n], [[1.0, n], [2.0 * n, 4.0]])
    assert [array is lanes for array in lane_arrays([[1.0, lanes], (np.float64(3.0), 2, lanes)])] == [
        True
    ] * 2


def test_lanes_are_chosen_from_nested_parts():
    def pair(start):
        rows = start + np.arange(6.0).reshape(2, 3)
        return Pair(rows, {"row": rows[0], "plain": (rows[1], None)})

    one, other, which = pair(0.0), pair(100.0), np.array([True, False, True])
    found = select_nested(which, one, other)
    assert type(found) is Pair
    assert found.others["plain"][1] is None
    for n, source in enumerate((one, other, one)):
        np.testing.assert_array_equal(found.first[:, n], source.first[:, n])
        assert found.others["row"][n] == source.others["row"][n]
        assert found.others["plain"][0][n] == source.others["plain"][0][n]
