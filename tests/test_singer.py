"""Singer's model against golden numbers, quadrature, and the limits where closed forms cancel."""

import math

import numpy
import pytest
from scipy.integrate import quad
from scipy.linalg import expm

from filtergym.filters import singer


def van_loan(alpha, sigma, T):
    """Phi and Q from one matrix exponential (Van Loan, 1978)."""
    A = numpy.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [0.0, 0.0, -alpha]])
    W = numpy.diag([0.0, 0.0, 2.0 * alpha * sigma**2])
    block = expm(T * numpy.block([[-A, W], [numpy.zeros((3, 3)), A.T]]))
    Phi = block[3:, 3:].T
    return Phi, Phi @ block[:3, 3:]


def test_golden_process_noise():
    Q = singer.process_noise(1 / 20, 1.0, 1.0)
    golden = [0.0048635570, 0.0120918768, 0.0158558056, 0.0321119868, 0.0475713807, 0.0951625820]
    # The golden numbers have ten decimals.
    assert Q[numpy.triu_indices(3)] == pytest.approx(golden, abs=6e-11)


def test_no_cancellation_for_a_short_interval():
    # alpha T = 1e-4: the closed form loses all digits and gives -1e-9.
    q11 = singer.process_noise(0.01, 1.0, 0.01)[0, 0]
    assert q11 == pytest.approx(2 * 0.01 * 0.01**5 / 20, rel=1e-4)
    assert singer.transition(1e-9, 0.5)[0, 2] == pytest.approx(0.125, rel=1e-9)


@pytest.mark.parametrize("x", [1e-8, 1e-3, 0.0125, 0.3, 0.999, 1.0, 1.7, 6.0])
def test_agrees_with_the_matrix_exponential(x):
    T, sigma = 0.5, 3.0
    Phi, Q = van_loan(x / T, sigma, T)
    # The numbers of the exponential that Phi is cut from grow as e^x, and its rounding is relative to the largest.
    rounding = 8.0 * numpy.finfo(float).eps * math.exp(x)
    assert singer.transition(x / T, T) == pytest.approx(Phi, rel=0.0, abs=rounding)
    # Relative to the largest numbers that Van Loan's product subtracts.
    assert singer.process_noise(x / T, sigma, T) == pytest.approx(Q, rel=1e-9, abs=1e-13 * Q.max())


@pytest.mark.parametrize("x", [1e-6, 0.01, 0.5, 0.9999, 1.0, 3.0])
def test_is_the_integral_that_defines_it(x):
    T = 2.0
    alpha = x / T
    Q = singer.process_noise(alpha, 1.5, T)
    for i in range(3):
        for j in range(3):
            value = quad(
                lambda u, i=i, j=j: (
                    singer.acceleration_response(alpha, u)[i] * singer.acceleration_response(alpha, u)[j]
                ),
                0.0,
                T,
                epsabs=0.0,
                epsrel=1e-12,
            )[0]
            # Above alpha T = 1 the closed form subtracts numbers up to 40 times its result.
            assert Q[i, j] == pytest.approx(2 * alpha * 1.5**2 * value, rel=1e-12)


def test_constant_acceleration_is_the_limit():
    assert singer.transition(0.0, 2.0) == pytest.approx(
        numpy.array([[1.0, 2.0, 2.0], [0.0, 1.0, 2.0], [0.0, 0.0, 1.0]]), abs=0.0
    )
    assert not singer.process_noise(0.0, 1.0, 2.0).any()


def test_singer_rule_and_refusals():
    sigmas = [singer.acceleration_sigma(g * 9.81, 0.05, 0.5) for g in (0.5, 2.0, 5.0)]
    assert sigmas == pytest.approx([2.369, 9.477, 23.693], abs=6e-4)
    with pytest.raises(ValueError, match="2 P_max"):
        singer.acceleration_sigma(1.0, 0.5, 0.5)
    with pytest.raises(ValueError, match=r"alpha must be .* got -1"):
        singer.transition(-1.0, 1.0)
    with pytest.raises(ValueError, match=r"sigma must be .* got nan"):
        singer.process_noise(1.0, float("nan"), 1.0)
