"""Ordered sums against plain loops, one lane at a time."""

import numpy as np
import pytest

from filtergym.filters.ordered_sums import ordered_sum, weighted_sum

M, N = 9, 67  # NumPy's own sum groups its terms from eight on


def unequal(*shape):
    """Numbers of many magnitudes, whose sum shows the order of the additions in its last bits."""
    rng = np.random.default_rng(0)
    return rng.normal(size=shape) * 10.0 ** rng.integers(-8, 8, size=shape)


def naive(terms):
    total = terms[0]
    for term in terms[1:]:
        total = total + term
    return total


@pytest.mark.parametrize("width", [1, 2, 5, 67])
def test_sum_has_the_bits_of_a_loop_over_one_lane(width):
    values = unequal(M, N)
    result = ordered_sum(values[:, :width])
    assert result.shape == (width,)
    for lane in range(width):
        assert result[lane] == naive([float(values[j, lane]) for j in range(M)])


def test_sum_takes_any_series_of_arrays():
    values = unequal(M, N)
    np.testing.assert_array_equal(ordered_sum([values[0]]), values[0])
    np.testing.assert_array_equal(ordered_sum(value for value in values), ordered_sum(values))
    assert np.signbit(ordered_sum(np.array([[-0.0], [-0.0]]))).all()  # no zero is put before the first term


@pytest.mark.parametrize("leading", [(), (4,), (4, 3)], ids=str)
@pytest.mark.parametrize("width", [1, 2, 67])
def test_weighted_sum_has_the_bits_of_a_loop_over_one_lane(leading, width):
    weights, values = unequal(M, N)[:, :width], unequal(*leading, M, N)[..., :width]
    result = weighted_sum(weights, values)
    assert result.shape == (*leading, width)
    for at in np.ndindex(*leading, width):
        *row, lane = at
        expected = naive([float(weights[j, lane]) * float(values[(*row, j, lane)]) for j in range(M)])
        assert result[at] == expected


def test_weighted_sum_of_a_mixture_for_every_filter():
    weights, values = unequal(M, M, N), unequal(4, M, N)
    result = weighted_sum(weights, values[:, :, None])
    assert result.shape == (4, M, N)
    for i in range(M):
        np.testing.assert_array_equal(result[:, i], weighted_sum(weights[:, i], values))
