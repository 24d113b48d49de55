"""Counter-based random numbers: each is a function of episode, measurement and index, with the same bits everywhere.

**Names.** Episode ``(key, episode)``, two 64-bit integers; measurement ``t``; pair ``p``. Earlier draws have no effect.

**Bits.** Philox4x32-10 makes four words of 32 bits of the counter ``(p, t, episode low, episode high)`` under the key
``(key low, key high)``. Ten times, with ``M`` and ``W`` of the paper::

    (c0, c1, c2, c3) <- (high(M1 c2) ^ c1 ^ k0, low(M1 c2), high(M0 c0) ^ c3 ^ k1, low(M0 c0))
    (k0, k1) <- (k0 + W0, k1 + W1)

Two words make a number of 64 bits, ``first`` and ``second``. Pairs of normal numbers are counted from 0, pairs of
uniform ones from 2^31, so that the count of one kind does not affect the other.

**Uniform.** The upper 52 bits n of 64 give ``(n + 1/2) / 2^52``, exactly: between 2^-53 and 1 - 2^-53, symmetrical, and
never 0 or 1.

**Normal** (Box and Muller). With ``r = sqrt(-2 log u)``, u of ``first``, and an angle of ``second``: its upper 52 bits
give the angle ``pi/2 x`` between -45 and 45 degrees, ``x = u - 1/2``, bit 1 reflects it about the diagonal, and bit 0
adds half a circle. The largest normal number is ``sqrt(106 log 2) = 8.57``; of 10^16 numbers none is larger.

**The same bits everywhere.** Only ``+ - * / sqrt`` of float64, which every processor rounds alike, and operations on
bits; nothing fused, no function of a library. The functions are written out::

    log u = e log 2 + log m,  sqrt(1/2) <= m < sqrt(2),  s = (m - 1) / (m + 1)
    log m = 2 s + s y P(y),   y = s^2 <= 0.0295
    sin(pi/2 x) = x S(x^2),   cos(pi/2 x) = C(x^2),   x^2 <= 1/4

Each of P, S and C has seven coefficients. It interpolates its function in the seven Chebyshev nodes of its
interval, and the coefficients are rounded to float64. The remaining error is below the rounding of the
operations: 2^-51.5 of P, of which 0.015 at most counts in the logarithm; 2^-53.9 of S; 2^-53.1 of C. A test
derives the coefficients again.

The algorithm is written once, for operands with ``+ - * / & | ^ << >>``: arrays of NumPy here, text of LLVM in
:mod:`.counter_code`.

Sources: J. K. Salmon, M. A. Moraes, R. O. Dror, D. E. Shaw, "Parallel random numbers: as easy as 1, 2, 3", SC'11
(2011), with the answers in Random123's ``kat_vectors``. G. E. P. Box, M. E. Muller, "A note on the generation of random
normal deviates", Annals of Mathematical Statistics 29 (1958). L. N. Trefethen, "Approximation theory and approximation
practice" (2013), chapter 16, on interpolation in Chebyshev nodes.
"""

from typing import Any, Protocol

import numpy

ROUNDS = 10
MULTIPLIERS = (0xD2511F53, 0xCD9E8D57)
KEY_STEPS = (0x9E3779B9, 0xBB67AE85)
LOW = 0xFFFFFFFF
UNIFORM_PAIRS = 1 << 31
"""Number of the first pair of uniform numbers."""
ONE = 0x3FF0000000000000
"""Bits of the float64 1."""
ROOT_HALF = 0x3FE6A09E667F3BCD
"""Bits of the float64 sqrt(1/2)."""
FRACTION = 0x000FFFFFFFFFFFFF
"""Bit mask of the fraction of a float64."""
RAISED = 1024
"""Offset that makes exponents nonnegative."""
POWER_52 = 0x4330000000000000
"""Bits of the float64 2^52, whose unit in the last place is 1."""
LOG_2 = float.fromhex("0x1.62e42fefa39efp-1")
P = tuple(
    map(
        float.fromhex,
        (
            "0x1.5555555555558p-1",
            "0x1.99999999952e2p-2",
            "0x1.2492492df148dp-2",
            "0x1.c71c62e5800a1p-3",
            "0x1.7462b4ab2ef6bp-3",
            "0x1.39fe606542ddep-3",
            "0x1.2b584aae78a57p-3",
        ),
    )
)
S = tuple(
    map(
        float.fromhex,
        (
            "0x1.921fb54442d18p+0",
            "-0x1.4abbce625be41p-1",
            "0x1.466bc677587f8p-4",
            "-0x1.32d2cce2e5b19p-8",
            "0x1.50782fda12d96p-13",
            "-0x1.e30071afc3e59p-19",
            "0x1.e3f38399551bfp-25",
        ),
    )
)
C = tuple(
    map(
        float.fromhex,
        (
            "0x1.0000000000000p+0",
            "-0x1.3bd3cc9be458bp+0",
            "0x1.03c1f081b0780p-2",
            "-0x1.55d3c7dbfd139p-6",
            "0x1.e1f4fb60281f6p-11",
            "-0x1.a6c9c1be9eb49p-16",
            "0x1.f3dbcea61b1a4p-22",
        ),
    )
)


class Machine(Protocol):
    """Protocol of the operations on numbers and bits that have no Python operator."""

    def bits(self, number: Any) -> Any:
        """Return the bits of a float64 as a 64-bit integer."""

    def number(self, bits: Any) -> Any:
        """Return the float64 with the bits of a 64-bit integer."""

    def sqrt(self, number: Any) -> Any:
        """Return the square root of a float64."""

    def choose(self, condition: Any, one: Any, other: Any) -> Any:
        """Return ``one`` where an integer is not zero, else ``other``."""


def philox(counter: tuple[Any, Any, Any, Any], key: tuple[Any, Any]) -> tuple[Any, Any, Any, Any]:
    """Return the four 32-bit words that Philox4x32-10 makes of a counter under a key, in 64-bit integers."""
    (c0, c1, c2, c3), (k0, k1) = counter, key
    for number in range(ROUNDS):
        if number > 0:
            k0, k1 = (k0 + KEY_STEPS[0]) & LOW, (k1 + KEY_STEPS[1]) & LOW
        a, b = c0 * MULTIPLIERS[0], c2 * MULTIPLIERS[1]
        c0, c1, c2, c3 = (b >> 32) ^ c1 ^ k0, b & LOW, (a >> 32) ^ c3 ^ k1, a & LOW
    return c0, c1, c2, c3


def pair_of_bits(key: Any, episode: Any, t: Any, pair: Any) -> tuple[Any, Any]:
    """Return two 64-bit random integers, a function of episode key and number, measurement and pair index."""
    c0, c1, c2, c3 = philox((pair, t, episode & LOW, episode >> 32), (key & LOW, key >> 32))
    return (c0 << 32) | c1, (c2 << 32) | c3


def uniform(machine: Machine, bits: Any) -> Any:
    """Return a uniform number in (0, 1) from the upper 52 of 64 random bits."""
    return machine.number((bits >> 12) | ONE) - (1.0 - 2.0**-53)


def polynomial(coefficients: tuple[float, ...], x: Any) -> Any:
    """Return the sum of ``coefficients[i] x^i``, by Horner's rule."""
    total = x * coefficients[-1] + coefficients[-2]
    for coefficient in coefficients[-3::-1]:
        total = total * x + coefficient
    return total


def logarithm(machine: Machine, u: Any) -> Any:
    """Return the natural logarithm of numbers from 2^-1000 to 2^1000."""
    bits = machine.bits(u) + ((RAISED << 52) - ROOT_HALF)
    m = machine.number((bits & FRACTION) + ROOT_HALF)
    e = machine.number((bits >> 52) | POWER_52) - (2.0**52 + RAISED)
    s = (m - 1.0) / (m + 1.0)
    y = s * s
    return e * LOG_2 + s * (y * polynomial(P, y) + 2.0)


def normal_pair(machine: Machine, first: Any, second: Any) -> tuple[Any, Any]:
    """Return two standard normal numbers from two 64-bit random integers (Box and Muller)."""
    r = machine.sqrt(logarithm(machine, uniform(machine, first)) * -2.0)
    x = uniform(machine, second) - 0.5
    y = x * x
    sine, cosine = x * polynomial(S, y), polynomial(C, y)
    r = machine.number(machine.bits(r) ^ ((second & 1) << 63))
    reflected = second & 2
    return r * machine.choose(reflected, sine, cosine), r * machine.choose(reflected, cosine, sine)


def uniform_pair(machine: Machine, first: Any, second: Any) -> tuple[Any, Any]:
    """Return two uniform numbers in (0, 1) from two 64-bit random integers."""
    return uniform(machine, first), uniform(machine, second)


class _Arrays:
    def bits(self, number: numpy.ndarray) -> numpy.ndarray:
        return number.view(numpy.uint64)

    def number(self, bits: numpy.ndarray) -> numpy.ndarray:
        return bits.view(numpy.float64)

    def sqrt(self, number: numpy.ndarray) -> numpy.ndarray:
        return numpy.sqrt(number)

    def choose(self, condition: numpy.ndarray, one: numpy.ndarray, other: numpy.ndarray) -> numpy.ndarray:
        return numpy.where(condition != 0, one, other)


ARRAYS = _Arrays()


def numbers(identities: numpy.ndarray, t: numpy.ndarray, normals: int, uniforms: int) -> numpy.ndarray:
    """Return the random numbers of N episodes at given measurements, ``(..., normals + uniforms, N)``.

    Standard normal numbers come first, then uniform ones. Identities are ``(2, N)`` uint64, ``t`` ``(..., N)``
    integers from 0 to 2^32 - 1.
    """
    key, episode = identities
    t = numpy.asarray(t).astype(numpy.uint64)[..., None, :]
    found = numpy.empty((*t.shape[:-2], normals + uniforms, t.shape[-1]))
    kinds = ((0, normals, 0, normal_pair), (normals, normals + uniforms, UNIFORM_PAIRS, uniform_pair))
    for start, stop, first_pair, make in kinds:
        pairs = numpy.arange(first_pair, first_pair + (stop - start + 1) // 2, dtype=numpy.uint64)[:, None]
        if len(pairs):
            one, other = make(ARRAYS, *pair_of_bits(key, episode, t, pairs))
            found[..., start:stop:2, :] = one
            found[..., start + 1 : stop : 2, :] = other[..., : (stop - start) // 2, :]
    return found
