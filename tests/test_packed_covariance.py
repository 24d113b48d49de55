from typing import Any

import numpy
import pytest

from filtergym.filters import kalman, packed_covariance


def system(seed: int, n: int = 5, N: int = 16) -> tuple[numpy.ndarray, numpy.ndarray, numpy.ndarray]:
    rng = numpy.random.default_rng(seed)
    C = rng.standard_normal((n, n, N))
    return rng.standard_normal((n, n)), numpy.einsum("ijn,kjn->ikn", C, C), rng.standard_normal((n, N))


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("n", [1, 2, 5])
def test_packing_and_prediction(seed: int, n: int) -> None:
    F, P, _ = system(seed, n)
    packed = packed_covariance.pack(P)
    numpy.testing.assert_array_equal(packed_covariance.unpack(packed, n), P)
    numpy.testing.assert_array_equal(packed[packed_covariance.diagonal(n)], numpy.diagonal(P).T)
    moved = packed_covariance.propagator(F) @ packed
    expected = numpy.einsum("ab,bcn,dc->adn", F, P, F)
    # Sums of n^2 products in another order.
    numpy.testing.assert_allclose(
        packed_covariance.unpack(moved, n), expected, rtol=0, atol=1e-12 * abs(expected).max()
    )


@pytest.mark.parametrize("seed", range(5))
def test_one_after_the_other_is_the_joint_update_of_the_sensors_that_answered(seed: int) -> None:
    _, P, mean = system(seed)
    rng = numpy.random.default_rng(seed + 100)
    coordinates, R = (2, 1, 4), numpy.array([0.3, 1.0, 0.2])
    z, available = 3 * rng.standard_normal((3, 16)), (rng.random((3, 16)) < 0.6).astype(float)
    available[:, 0], available[:, 1] = 1.0, 0.0
    done = packed_covariance.update_coordinates(mean, packed_covariance.pack(P), z, coordinates, R, available)
    covariance = packed_covariance.unpack(done.covariance, 5)
    for k in range(16):
        rows = [i for i in range(3) if available[i, k]]
        if rows:
            H = numpy.eye(5)[[coordinates[i] for i in rows]]
            joint = kalman.update(mean[:, [k]], P[:, :, [k]], z[rows][:, [k]], H, numpy.diag(R[rows]))
            expected = (
                joint.mean[:, 0],
                joint.covariance[..., 0],
                joint.log_likelihood[0],
                joint.squared_distance[0],
            )
        else:
            expected = (mean[:, k], P[:, :, k], 0.0, 0.0)
        found = (done.mean[:, k], covariance[..., k], done.log_likelihood[k], done.squared_distance[k])
        for a, b in zip(found, expected, strict=True):
            # Cholesky with Joseph form against scalar steps; condition numbers up to 1e4.
            numpy.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-9)
        assert numpy.linalg.eigvalsh(covariance[..., k]).min() > 0.0


@pytest.mark.parametrize("seed", range(5))
def test_the_gain_of_another_model_is_that_of_its_joint_update_in_josephs_form(seed: int) -> None:
    _, P, mean = system(seed)
    _, M, _ = system(seed + 50)
    rng = numpy.random.default_rng(seed + 100)
    coordinates, R, cautious = (2, 1, 4), rng.uniform(0.1, 1.0, (3, 16)), rng.uniform(0.1, 1.0, (3, 16))
    z, available = 3 * rng.standard_normal((3, 16)), (rng.random((3, 16)) < 0.6).astype(float)
    model = packed_covariance.GainModel(packed_covariance.pack(M), cautious)
    found = packed_covariance.update_coordinates_with_gain(
        mean, packed_covariance.pack(P), z, coordinates, R, available, model
    )
    covariance, of_gain = (packed_covariance.unpack(part, 5) for part in found[1:])
    for k in range(16):
        rows = [i for i in range(3) if available[i, k]]
        H = numpy.eye(5)[[coordinates[i] for i in rows]]
        K = M[:, :, k] @ H.T @ numpy.linalg.inv(H @ M[:, :, k] @ H.T + numpy.diag(cautious[rows, k]))
        rest = numpy.eye(5) - K @ H
        joseph = rest @ P[:, :, k] @ rest.T + K @ numpy.diag(R[rows, k]) @ K.T
        # Scalar steps against an inverse; condition numbers up to 1e4.
        numpy.testing.assert_allclose(
            found.mean[:, k], mean[:, k] + K @ (z[rows, k] - H @ mean[:, k]), rtol=1e-9, atol=1e-9
        )
        numpy.testing.assert_allclose(of_gain[..., k], rest @ M[:, :, k], rtol=1e-9, atol=1e-9)
        numpy.testing.assert_allclose(covariance[..., k], joseph, rtol=1e-9, atol=1e-9)


def test_torch_agrees_and_differentiates(torch: Any) -> None:
    _, P, mean = system(3)
    packed, z = packed_covariance.pack(P), numpy.ones((2, 16))
    arguments = (mean, packed, z, (0, 3), (0.5, 2.0), numpy.ones((2, 16)))
    tensors = [torch.asarray(a) if isinstance(a, numpy.ndarray) else a for a in arguments]
    for a, b in zip(
        packed_covariance.update_coordinates(*arguments),
        packed_covariance.update_coordinates(*tensors),
        strict=True,
    ):
        numpy.testing.assert_allclose(a, b.numpy(), rtol=1e-13, atol=1e-13)
    two = [torch.asarray(a[..., :2]).clone().requires_grad_() for a in (mean, packed, z)]
    assert torch.autograd.gradcheck(
        lambda m, c, r: packed_covariance.update_coordinates(m, c, r, (0, 3), (0.5, 2.0), torch.ones_like(r)),
        two,
    )
