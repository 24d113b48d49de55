"""Gaussian densities and small-matrix algebra against SciPy and NumPy."""

import math

import numpy as np
import pytest
from naive import positive_definite
from scipy.stats import multivariate_normal

from filtergym.filters import gaussian, small_matrices


@pytest.mark.parametrize("n", [1, 2, 3, 5])
@pytest.mark.parametrize("seed", range(3))
def test_log_density_equals_scipy(n, seed):
    rng = np.random.default_rng(seed)
    S, residual = positive_definite(rng, n, 7), rng.normal(size=(n, 7))
    log_density, squared = gaussian.log_density(residual, S)
    for b in range(7):
        expected = multivariate_normal.logpdf(residual[:, b], cov=S[:, :, b])
        assert log_density[b] == pytest.approx(expected, rel=1e-10, abs=1e-10)
        distance = residual[:, b] @ np.linalg.solve(S[:, :, b], residual[:, b])
        assert squared[b] == pytest.approx(distance, rel=1e-10)


def test_innovation_of_500_sigma_keeps_its_likelihood():
    log_density, squared = gaussian.log_density(np.array([[1000.0], [0.0]]), np.diag([4.0, 1.0])[..., None])
    assert squared[0] == 250000.0
    expected = -125000.0 - math.log(2 * math.pi) - math.log(2.0)
    assert log_density[0] == pytest.approx(expected, rel=1e-15)


@pytest.mark.parametrize("n", [1, 2, 4, 6])
def test_small_matrices_equal_numpy(n):
    rng = np.random.default_rng(n)
    A, B, x = rng.normal(size=(n, n + 1, 5)), rng.normal(size=(n + 1, n, 5)), rng.normal(size=(n + 1, 5))
    stack = lambda M: np.moveaxis(M, -1, 0)  # noqa: E731
    np.testing.assert_allclose(
        stack(small_matrices.product(A, B)), stack(A) @ stack(B), rtol=1e-12, atol=1e-13
    )
    applied = np.einsum("ijb,jb->ib", A, x)
    np.testing.assert_allclose(small_matrices.apply(A, x), applied, rtol=1e-12, atol=1e-13)
    np.testing.assert_array_equal(small_matrices.transpose(A), np.swapaxes(A, 0, 1))
    np.testing.assert_array_equal(small_matrices.outer(x, x), np.einsum("ib,jb->ijb", x, x))
    S = positive_definite(rng, n, 5)
    factor = small_matrices.cholesky(S)
    expected = np.linalg.cholesky(stack(S))
    for i in range(n):
        for j in range(i + 1):
            np.testing.assert_allclose(factor[i][j], expected[:, i, j], rtol=1e-11, atol=1e-12)
    solution = np.stack(small_matrices.solve_lower(factor, x[:n]))
    for b in range(5):
        np.testing.assert_allclose(expected[b] @ solution[:, b], x[:n, b], rtol=1e-10, atol=1e-12)


@pytest.mark.parametrize("function", ["product", "apply"])
def test_rounding_does_not_depend_on_the_batch_width(function):
    rng = np.random.default_rng(0)
    A, B = rng.normal(size=(4, 4, 13)), rng.normal(size=(4, 4, 13))
    if function == "apply":
        B = B[:, 0]
    call = getattr(small_matrices, function)
    whole = call(A, B)
    for b in range(13):
        np.testing.assert_array_equal(whole[..., b], call(A[..., b : b + 1], B[..., b : b + 1])[..., 0])
