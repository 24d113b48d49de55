"""Random numbers by counter: published answers, exact definitions, and the same bits from compiled code."""

import math

import numpy as np
import pytest

from filtergym.compiler.counter_code import bind_numbers
from filtergym.compiler.counter_numbers import (
    ARRAYS,
    LOW,
    UNIFORM_PAIRS,
    C,
    P,
    S,
    logarithm,
    normal_pair,
    numbers,
    pair_of_bits,
    philox,
    uniform,
)

WHOLE = np.uint64
EDGES = np.array(
    [0, 1, 2, 3, 0xFFF, 0x1000, 1 << 31, LOW, 1 << 32, 1 << 63, (1 << 63) - 1, 2**64 - 4096, 2**64 - 1], WHOLE
)


def identities_of(count, first=0):
    """Identities one after another: no two bits but the lowest differ from one to the next."""
    episodes = np.arange(first, first + count, dtype=WHOLE)
    return np.stack([np.full(count, 12345, dtype=WHOLE), episodes])


@pytest.mark.parametrize(
    ("counter", "key", "answer"),
    [
        ((0, 0, 0, 0), (0, 0), "6627e8d5 e169c58d bc57ac4c 9b00dbd8"),
        ((LOW, LOW, LOW, LOW), (LOW, LOW), "408f276d 41c83b0e a20bc7c6 6d5451fd"),
        (
            (0x243F6A88, 0x85A308D3, 0x13198A2E, 0x03707344),
            (0xA4093822, 0x299F31D0),
            "d16cfe09 94fdcceb 5001e420 24126ea1",
        ),
    ],
)
def test_philox_gives_the_published_answers(counter, key, answer):
    words = philox(*(tuple(np.array([word], WHOLE) for word in words) for words in (counter, key)))
    assert " ".join(f"{int(word[0]):08x}" for word in words) == answer


def test_which_words_name_a_number():
    given = np.array([0x0123456789ABCDEF], WHOLE), np.array([0xFEDCBA9876543210], WHOLE)
    first, second = pair_of_bits(*given, np.array([7], WHOLE), np.array([3], WHOLE))
    words = philox(
        *(
            tuple(np.array([word], WHOLE) for word in words)
            for words in ((3, 7, 0x76543210, 0xFEDCBA98), (0x89ABCDEF, 0x01234567))
        )
    )
    found = [int(word[0]) for word in words]
    assert (int(first[0]), int(second[0])) == (found[0] << 32 | found[1], found[2] << 32 | found[3])


def test_uniform_is_exact_symmetrical_and_never_at_an_end():
    found = uniform(ARRAYS, EDGES)
    expected = [((int(bits) >> 12) + 0.5) / 2**52 for bits in EDGES]  # exact: 53 bits
    assert found.tolist() == expected
    assert (found > 0.0).all()
    assert (found < 1.0).all()
    np.testing.assert_array_equal(uniform(ARRAYS, ~EDGES), 1.0 - found)


def test_coefficients_interpolate_in_chebyshev_nodes():
    mp = pytest.importorskip("mpmath")
    edge = (mp.sqrt(2) - 1) / (mp.sqrt(2) + 1)

    def of_logarithm(y):
        s = mp.sqrt(y)
        return ((mp.log((1 + s) / (1 - s))) / s - 2) / y

    cases = (
        (P, of_logarithm, edge**2),
        (S, lambda y: mp.sin(mp.pi / 2 * mp.sqrt(y)) / mp.sqrt(y), mp.mpf(1) / 4),
        (C, lambda y: mp.cos(mp.pi / 2 * mp.sqrt(y)), mp.mpf(1) / 4),
    )
    with mp.workdps(50):
        for coefficients, function, end in cases:
            n = len(coefficients)
            nodes = [end / 2 * (1 + mp.cos(mp.pi * (2 * i + 1) / (2 * n))) for i in range(n)]
            matrix = mp.matrix([[node**power for power in range(n)] for node in nodes])
            solved = mp.lu_solve(matrix, mp.matrix([function(node) for node in nodes]))
            assert [float(c) for c in solved] == list(coefficients)


def test_logarithm_near_every_place_where_it_changes():
    rng = np.random.default_rng(0)
    near = [0.5, math.sqrt(0.5), 1.0, 2.0**-53, 0.25, 0.75]
    close = [x * (1.0 + d * 2.0**-52) for x in near for d in (-2, -1, 0, 1, 2)]
    u = np.array([x for x in close if 0.0 < x < 1.0] + (2.0 ** -rng.uniform(0.0, 53.0, 20_000)).tolist())
    # Either term is at most twice the sum; each, the quotient in it and the product are rounded by 2^-53.
    np.testing.assert_allclose(logarithm(ARRAYS, u), np.log(u), rtol=2.0**-50, atol=0.0)


def test_normals_are_those_of_box_and_muller():
    rng = np.random.default_rng(1)
    first, second = rng.integers(0, 2**64, size=(2, 20_000), dtype=WHOLE)
    first, second = (
        np.append(first, np.repeat(EDGES, len(EDGES))),
        np.append(second, np.tile(EDGES, len(EDGES))),
    )
    found = np.array(normal_pair(ARRAYS, first, second))
    radius = np.sqrt(-2.0 * np.log(uniform(ARRAYS, first)))
    angle = 0.5 * math.pi * (uniform(ARRAYS, second) - 0.5)
    low = second & WHOLE(3)
    angle = np.where(low & WHOLE(2), 0.5 * math.pi - angle, angle) + math.pi * (low & WHOLE(1))
    # The angle, up to 4, is rounded to 2^-51, and the radius is at most 8.6.
    expected = radius * np.array([np.cos(angle), np.sin(angle)])
    np.testing.assert_allclose(found, expected, rtol=0.0, atol=9.0 * 2.0**-50)
    assert np.abs(found).max() <= math.sqrt(106.0 * math.log(2.0))


LAYOUTS = [(2, 2), (5, 3), (0, 1), (1, 0), (39, 4)]


@pytest.mark.processors
@pytest.mark.parametrize(("normals", "uniforms"), LAYOUTS)
def test_compiled_code_gives_the_same_bits(normals, uniforms):
    pytest.importorskip("llvmlite")
    rng = np.random.default_rng(normals)
    width = 4096
    identities = rng.integers(0, 2**64, size=(2, width), dtype=WHOLE)
    identities[0, : len(EDGES)], identities[1, -len(EDGES) :] = EDGES, EDGES
    t = rng.integers(-1, 2**32 - 20, size=width)
    t[:4] = [-1, 0, 2**31 - 2, 2**32 - 20]
    rows = np.full((normals + uniforms + 1, width), np.nan)
    run = bind_numbers(identities, t, rows[:-1], normals)
    for _ in range(10):
        before = t.copy()
        run(8, width - 8)
        np.testing.assert_array_equal(t[8:-8], before[8:-8] + 1)
        np.testing.assert_array_equal(t[[*range(8), *range(-8, 0)]], before[[*range(8), *range(-8, 0)]])
        expected = numbers(identities, t, normals, uniforms)[:, 8:-8]
        np.testing.assert_array_equal(rows[:-1, 8:-8].view(WHOLE), expected.view(WHOLE))
        assert np.isnan(rows[-1]).all(), "nothing is written beyond the last row"
        assert np.isnan(rows[:, [*range(8), *range(-8, 0)]]).all(), "nor beside the lanes"


def test_numbers_are_those_of_the_pairs_that_their_places_name():
    identity = np.array([[7], [2**63 + 5]], WHOLE)
    found = numbers(identity, np.array([3]), 5, 3)[:, 0]
    expected = []
    for place in range(5):
        pair = pair_of_bits(*identity, np.array([3], WHOLE), np.array([place // 2], WHOLE))
        expected.append(normal_pair(ARRAYS, *pair)[place % 2][0])
    for place in range(3):
        pair = pair_of_bits(*identity, np.array([3], WHOLE), np.array([UNIFORM_PAIRS + place // 2], WHOLE))
        expected.append(uniform(ARRAYS, pair[place % 2])[0])
    assert found.tolist() == expected


def test_numbers_do_not_depend_on_what_else_is_asked_for():
    identities, t = identities_of(16), np.arange(16)
    many = numbers(identities, t, 7, 5)
    np.testing.assert_array_equal(numbers(identities, t, 4, 5)[4:], many[7:])
    np.testing.assert_array_equal(numbers(identities, t, 3, 0), many[:3])
    np.testing.assert_array_equal(numbers(identities[:, 5:6], t[5:6], 7, 5), many[:, 5:6])
    at_many_times = numbers(identities, t + np.arange(3)[:, None], 7, 5)
    assert at_many_times.shape == (3, 12, 16)
    np.testing.assert_array_equal(at_many_times[2], numbers(identities, t + 2, 7, 5))


def test_no_two_names_have_the_same_bits():
    key = np.arange(8, dtype=WHOLE)[:, None, None, None]
    episode = np.arange(32, dtype=WHOLE)[:, None, None]
    t = np.arange(64, dtype=WHOLE)[:, None]
    pairs = np.array([0, 1, 2, 3, UNIFORM_PAIRS, UNIFORM_PAIRS + 1], WHOLE)
    found = np.concatenate([bits.ravel() for bits in pair_of_bits(key, episode, t, pairs)])
    # Of so many numbers of 64 bits two would be equal with a probability of 1e-9.
    assert len(np.unique(found)) == found.size
