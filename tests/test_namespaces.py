"""Every public function of the filters on torch float64 tensors: the same numbers as on NumPy arrays."""

import numpy as np
import pytest
from naive import positive_definite

from filtergym.filters import (
    alpha_beta,
    bounds,
    coordinated_turn,
    gaussian,
    imm,
    kalman,
    noise_adaptation,
    ordered_sums,
    polar,
    small_matrices,
    unscented,
)

torch = pytest.importorskip("torch")

rng = np.random.default_rng(0)


N = 5
P2 = alpha_beta.Covariance(*(np.abs(rng.normal(size=(2, N))) + least for least in (2.0, 0.0, 2.0)))
MU = rng.dirichlet(np.ones(3), size=N).T
TRANSITION = rng.dirichlet(np.ones(3), size=3)
MIXING = imm.predict_mode_probabilities(TRANSITION, MU).mixing
MEANS, COVARIANCES = rng.normal(size=(4, 3, N)), positive_definite(rng, 4, 3, N)
GAIN = np.array([[0.2], [0.5], [0.8]])
S2, X4, P4, Z2 = (
    positive_definite(rng, 2, N),
    rng.normal(size=(4, N)),
    positive_definite(rng, 4, N),
    rng.normal(size=(2, N)),
)
F4, Q4, H24, R2 = (
    rng.normal(size=(4, 4)),
    positive_definite(rng, 4),
    rng.normal(size=(2, 4)),
    positive_definite(rng, 2),
)
X5, P5 = rng.normal(size=(5, N)), positive_definite(rng, 5, N)
ALPHA, BETA = rng.uniform(0.1, 0.9, N), rng.uniform(0.1, 0.9, N)
LEVEL = noise_adaptation.Level(np.abs(Z2) + 0.5, np.abs(Z2) + 1.0)
WINDOW = rng.normal(size=(3, 2, N))
THERE = np.array([1.0, 0.0, 1.0, 1.0, 0.0])

CALLS = [
    (alpha_beta.benedict_bordner_beta, (ALPHA,)),
    (alpha_beta.predict, (Z2, Z2, 6.0)),
    (alpha_beta.update, (Z2, Z2, Z2, ALPHA, BETA, 6.0)),
    (alpha_beta.predict_covariance, (P2, 6.0)),
    (alpha_beta.update_covariance, (P2, np.abs(Z2), ALPHA, BETA, 6.0)),
    (alpha_beta.add_acceleration_error, (P2, np.abs(Z2), ALPHA, BETA, 6.0)),
    (alpha_beta.predict_joint_covariance, (COVARIANCES, 6.0)),
    (alpha_beta.update_joint_covariance, (COVARIANCES, np.abs(Z2)[:, None], GAIN, GAIN, 6.0)),
    (bounds.predict_bound, (P4, F4[..., None], Q4[..., None])),
    (bounds.posterior_cramer_rao_bound, (P4, H24, R2)),
    (coordinated_turn.propagate, (X5, 0.7)),
    (coordinated_turn.jacobian, (X5, 0.7)),
    (coordinated_turn.predict, (X5, P5, 0.7, P5)),
    (coordinated_turn.augment_turn_rate, (X4, P4, 0.1)),
    (gaussian.log_density, (Z2, S2)),
    (imm.predict_mode_probabilities, (TRANSITION, MU)),
    (imm.predict_mode_probabilities, (np.array([[1.0, 0.0, 0.0]] * 3), MU)),
    (imm.mix, (MEANS, COVARIANCES, MIXING)),
    (imm.combine, (MEANS, COVARIANCES, MU)),
    (imm.log_probabilities, (np.array([[0.0], [1.0]]),)),
    (imm.log_sum, (MEANS[:, 0],)),
    (imm.softmax, (MEANS[:, 0],)),
    (imm.mode_posterior, (np.log(MU), -1e5 + MEANS[0])),
    (imm.log_mixture_density, (np.log(MU), -1e5 + MEANS[0])),
    (kalman.constant_acceleration, (X4[0], 2)),
    (kalman.predict, (X4, P4, F4, Q4, X4)),
    (kalman.update, (X4, P4, Z2, H24, R2)),
    (noise_adaptation.fading_mean, (LEVEL, Z2, 0.9, THERE)),
    (noise_adaptation.sage_husa, (LEVEL, Z2, LEVEL.value, 0.9, 0.1, THERE)),
    (noise_adaptation.process_noise_factor, (Z2, LEVEL.value, LEVEL.weight, LEVEL.value)),
    (noise_adaptation.start_window, (Z2, 3)),
    (noise_adaptation.mehra, (WINDOW, Z2, LEVEL.value, 0.1, THERE)),
    (noise_adaptation.mehra, (WINDOW, Z2, LEVEL.value, 0.1)),
    (noise_adaptation.forget, (noise_adaptation.InverseGamma(*LEVEL), 0.9, THERE)),
    (
        noise_adaptation.variational_bayes,
        (noise_adaptation.InverseGamma(*LEVEL), lambda R: (R, R, R), 2, THERE),
    ),
    (ordered_sums.ordered_sum, (MU,)),
    (ordered_sums.weighted_sum, (MU, COVARIANCES)),
    (polar.cartesian_variances, (1e4 * Z2, 100.0, 0.004)),
    (small_matrices.product, (P4, P4)),
    (small_matrices.apply, (P4, X4)),
    (small_matrices.transpose, (P4,)),
    (small_matrices.outer, (X4, X4)),
    (small_matrices.cholesky, (P4,)),
    (small_matrices.mirror_lower, (P4,)),
    (small_matrices.solve_lower, (small_matrices.cholesky(P4), X4)),
    (small_matrices.solve_definite, (P4, X4)),
    (unscented.sigma_points, (X5, P5)),
    (unscented.transform, (X5, P5, lambda points: points * points)),
]


def converted(value, change):
    """The same structure with every array changed."""
    if isinstance(value, np.ndarray | torch.Tensor):
        return change(value)
    if isinstance(value, tuple) and hasattr(value, "_fields"):
        return type(value)(*(converted(part, change) for part in value))
    if isinstance(value, list | tuple):
        return type(value)(converted(part, change) for part in value)
    return value


def leaves(value):
    return [leaf for part in value for leaf in leaves(part)] if isinstance(value, list | tuple) else [value]


@pytest.mark.parametrize(("function", "arguments"), CALLS, ids=lambda value: getattr(value, "__name__", ""))
def test_torch_equals_numpy(function, arguments):
    before = converted(arguments, np.copy)
    expected = leaves(function(*arguments))
    for one, other in zip(leaves(arguments), leaves(before), strict=True):
        np.testing.assert_array_equal(one, other, err_msg="an argument was changed in place")
    result = leaves(function(*converted(arguments, lambda a: torch.from_numpy(a.copy()))))
    assert len(result) == len(expected)
    for one, other in zip(result, expected, strict=True):
        assert one.dtype == torch.float64
        # Elementwise arithmetic is the same; exp and log of the two libraries differ in the last bit.
        np.testing.assert_allclose(one.numpy(), other, rtol=1e-12, atol=1e-13)


def test_gradients_pass_through_every_function():
    for function, arguments in CALLS:
        tensors = []

        def watched(array, tensors=tensors):
            tensors.append(torch.from_numpy(array.copy()).requires_grad_())
            return tensors[-1]

        result = leaves(function(*converted(arguments, watched)))
        sum(part.sum() for part in result).backward()
        gradients = [tensor.grad for tensor in tensors if tensor.grad is not None]
        assert gradients, function.__name__
        assert all(torch.isfinite(gradient).all() for gradient in gradients), function.__name__
