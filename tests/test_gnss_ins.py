"""Geometry, satellites, the 17-state models and the update by scalar observations."""

import itertools
import math

import numpy
import pytest
import scipy.optimize
from naive import dense

from filtergym.filters import extended_kalman, geodesy, gnss_ins, satellites, singer

SITE = (math.radians(53.9), math.radians(27.5667), 220.0)
SLOTS = (1, 11, 19, 20)
SENSOR_SIGMA = numpy.array([3.0] * 4 + [0.1] * 4 + [0.05] * 3 + [math.radians(0.5)] * 3)


def random_states(rng, *batch):
    scale = numpy.array([100.0] * 3 + [30.0] + [200.0] * 3 + [1.0] + [20.0] * 3 + [0.02] * 6)
    return scale.reshape(17, *[1] * len(batch)) * rng.standard_normal((17, *batch))


def observed(state, ins):
    position, velocity = satellites.local_orbits(SLOTS, numpy.zeros(1), *SITE)
    shape = (3, 4, *[1] * (state.ndim - 1))
    return gnss_ins.observe(state, position.reshape(shape), velocity.reshape(shape), ins, 9.81)


def test_earth_fixed_on_the_axes_of_the_ellipsoid():
    # Rounding of numbers of 6.4e6 m.
    numpy.testing.assert_allclose(geodesy.earth_fixed(0.0, 0.0, 10.0), [6378147.0, 0.0, 0.0], atol=1e-8)
    pole = geodesy.earth_fixed(math.pi / 2, 0.3, 0.0)
    numpy.testing.assert_allclose(pole, [0.0, 0.0, 6356752.314245], atol=1e-6)


@pytest.mark.parametrize("seed", range(3))
def test_east_north_up_is_the_gradient_of_the_site(seed):
    rng = numpy.random.default_rng(seed)
    b, lon = rng.uniform(-1.5, 1.5), rng.uniform(-3.0, 3.0)
    rotation, h = geodesy.east_north_up(b, lon), 1e-6
    numpy.testing.assert_allclose(rotation @ rotation.T, numpy.eye(3), atol=1e-15)
    steps = [(0.0, h, 0.0), (h, 0.0, 0.0), (0.0, 0.0, 1.0)]
    for row, (db, dl, dh) in zip(rotation, steps, strict=True):
        d = geodesy.earth_fixed(b + db, lon + dl, dh) - geodesy.earth_fixed(b - db, lon - dl, -dh)
        # Differences of 12 m between numbers with a rounding of 1e-9 m.
        numpy.testing.assert_allclose(d / numpy.linalg.norm(d), row, atol=1e-8)


def test_nominal_satellites_over_minsk():
    """Reference table of slots, look angles, positions and velocities; printed to 0.01 deg, 1 m, 0.01 m/s."""
    position, velocity = satellites.local_orbits(SLOTS, numpy.zeros(1), *SITE)
    azimuth, elevation = satellites.look_angles(position[..., 0])
    numpy.testing.assert_allclose(numpy.degrees(azimuth), [212.90, 341.79, 228.37, 143.18], atol=0.006)
    numpy.testing.assert_allclose(numpy.degrees(elevation), [17.75, 14.05, 85.60, 32.68], atol=0.006)
    table = [
        [-11804.633, -18250.041, 6958.610],
        [-7041.411, 21398.146, 5638.484],
        [-1098.382, -976.221, 19100.482],
        [10841.744, -14480.735, 11603.193],
    ]
    numpy.testing.assert_allclose(position[..., 0].T / 1e3, table, atol=6e-4)
    table = [
        [-156.87, 2173.61, 2841.78],
        [-3052.53, -613.22, -698.58],
        [1393.52, -2958.95, -55.70],
        [294.52, -2667.64, -2330.69],
    ]
    numpy.testing.assert_allclose(velocity[..., 0].T, table, atol=0.0061)
    assert satellites.orbit_radius() == pytest.approx(25508.04e3, abs=5.0)


def test_velocity_is_the_derivative_of_position():
    time = numpy.array([100.0 - 0.5, 100.0, 100.0 + 0.5])
    position, velocity = satellites.local_orbits((3, 9, 24), time, *SITE)
    # Third derivative a n^3 (0.5 s)^2 / 6: 4e-6 m/s.
    numpy.testing.assert_allclose(position[..., 2] - position[..., 0], velocity[..., 1], atol=5e-6)


def geometric_dilution(unit, chosen):
    return satellites.dilution_of_precision(unit[:, list(chosen)]).geometric


def test_the_four_satellites_of_smallest_gdop():
    local = satellites.local_orbits(range(1, 25), numpy.zeros(1), *SITE)[0][..., 0]
    visible = numpy.flatnonzero(satellites.look_angles(local)[1] > math.radians(10.0))
    assert len(visible) == 7
    unit = local / numpy.linalg.norm(local, axis=0)
    chosen = min(itertools.combinations(visible, 4), key=lambda four: geometric_dilution(unit, four))
    assert tuple(i + 1 for i in chosen) == SLOTS
    dop = satellites.dilution_of_precision(unit[:, list(chosen)])
    assert dop.geometric == pytest.approx(2.7168, abs=5e-5)
    for value, printed in zip(
        (dop.east, dop.north, dop.up, dop.time), (1.458, 0.760, 1.840, 1.137), strict=True
    ):
        assert value == pytest.approx(printed, abs=5.1e-4)


def test_golden_dilution_of_precision():
    angles = numpy.radians([(0, 0), (0, 90), (45, 180), (45, 270), (90, 0)]).T
    elevation, azimuth = angles
    unit = numpy.stack(
        [
            numpy.cos(elevation) * numpy.sin(azimuth),
            numpy.cos(elevation) * numpy.cos(azimuth),
            numpy.sin(elevation),
        ]
    )
    assert satellites.dilution_of_precision(unit).geometric == pytest.approx(math.sqrt(23 / 3), rel=1e-14)


def test_degenerate_geometry_is_refused():
    azimuth = numpy.radians([0.0, 90.0, 180.0, 270.0])
    cone = numpy.stack([0.8 * numpy.sin(azimuth), 0.8 * numpy.cos(azimuth), 0.6 + 0.0 * azimuth])
    with pytest.raises(ValueError, match="degenerate"):
        satellites.dilution_of_precision(cone)
    with pytest.raises(ValueError, match="four"):
        satellites.dilution_of_precision(cone[:, :3])
    with pytest.raises(ValueError, match="24"):
        satellites.earth_fixed_orbits((25,), numpy.zeros(1))


def test_singer_model_of_the_experiment():
    axis = gnss_ins.singer_model(0.01, 0.05, 18.0)
    printed = [1.61955e-10, 4.04865e-08, 5.39730e-06, 1.07960e-05, 1.61919e-03, 0.323838]
    numpy.testing.assert_allclose(axis.noise[numpy.triu_indices(3)], printed, rtol=5e-6)  # six digits
    assert singer.acceleration_sigma(30.0, 0.1, 0.32) == pytest.approx(18.0, rel=1e-14)


def test_clock_keeps_its_correlation_and_rates_are_stationary():
    common = gnss_ins.common_model(0.01, 0.009, 0.036, 1e-4, 3e-4, 100.0)
    T = 0.01
    expected = [[0.009 * T + 0.036 * T**3 / 3, 0.036 * T**2 / 2], [0.036 * T**2 / 2, 0.036 * T]]
    numpy.testing.assert_allclose(common.clock_noise, expected, rtol=1e-15)
    stationary = common.attitude_rate_variance / (1.0 - common.decay**2)
    # 1 - decay^2 is a difference of 2e-4 from 1.
    assert stationary == pytest.approx(9e-8, rel=1e-11)


@pytest.mark.parametrize("seed", range(3))
def test_advance_is_the_sparse_transition(seed):
    rng = numpy.random.default_rng(seed)
    axis = numpy.stack(
        [
            gnss_ins.rest_model(0.1, 0.01, 0.05).transition,
            gnss_ins.constant_velocity_model(0.1, 0.3, 0.05).transition,
            singer.transition(0.5, 0.1),
        ],
        axis=-1,
    )[..., None]
    x, P = random_states(rng, 3, 5), rng.standard_normal((17, 17, 3, 5))
    P = P + P.swapaxes(0, 1)
    Q = rng.standard_normal((17, 17, 3, 1))
    mean, covariance = gnss_ins.predict(x, P, axis, 0.1, 0.9, Q)
    for i in range(3):
        F = numpy.zeros((17, 17))
        for a in range(3):
            places = [a, 4 + a, 8 + a]
            F[numpy.ix_(places, places)] = axis[:, :, i, 0]
            F[11 + a, [11 + a, 14 + a]] = 1.0, 0.1
            F[14 + a, 14 + a] = 0.9
        F[3, [3, 7]] = 1.0, 0.1
        F[7, 7] = 1.0
        numpy.testing.assert_allclose(mean[:, i], F @ x[:, i], rtol=1e-14, atol=1e-13)
        for n in range(5):
            numpy.testing.assert_allclose(
                covariance[:, :, i, n], F @ P[:, :, i, n] @ F.T + Q[:, :, i, 0], rtol=1e-13, atol=1e-13
            )


def test_readings_of_a_level_aircraft():
    """Heading east: a push to the east is forward, gravity a specific force upwards, down is negative."""
    state = numpy.zeros((17, 1))
    state[8] = 2.0
    observation, _ = observed(state, numpy.array([[math.pi / 2], [0.0], [0.0]]))
    numpy.testing.assert_allclose(observation[8:11, 0], [2.0, 0.0, -9.81], atol=1e-14)
    nose_up, _ = observed(0.0 * state, numpy.array([[0.0], [math.radians(30)], [0.0]]))
    numpy.testing.assert_allclose(nose_up[8:11, 0], [4.905, 0.0, -9.81 * math.cos(math.pi / 6)], atol=1e-14)
    right_down, _ = observed(0.0 * state, numpy.array([[0.0], [0.0], [math.radians(30)]]))
    numpy.testing.assert_allclose(
        right_down[8:11, 0], [0.0, -4.905, -9.81 * math.cos(math.pi / 6)], atol=1e-14
    )


@pytest.mark.parametrize("seed", range(2))
def test_jacobian_by_finite_differences(seed):
    rng = numpy.random.default_rng(seed)
    state, ins = random_states(rng, 1), rng.uniform(-1.4, 1.4, (3, 1))
    exact = dense(observed(state, ins)[1], state)[..., 0]
    numeric = numpy.zeros((14, 17))
    for i in range(17):
        h = 1e-2 if i < 11 else 1e-5
        e = numpy.zeros((17, 1))
        e[i] = h
        numeric[:, i] = (observed(state + e, ins)[0] - observed(state - e, ins)[0])[:, 0] / (2 * h)
    # Two ranges of 2e7 m, each rounded by up to 1.75 times 4e-9 m (sum of squares, root, clock), over 2 cm; the other
    # rows are limited by h^2 and 1e-15 / h.
    numpy.testing.assert_allclose(exact[:4], numeric[:4], atol=7e-7)
    numpy.testing.assert_allclose(exact[4:], numeric[4:], atol=3e-9)
    # The tiny derivatives of rates by position are resolved too.
    numpy.testing.assert_allclose(exact[4:8, :3], numeric[4:8, :3], atol=1e-10)
    assert abs(exact[4:8, :3]).max() > 1e-5


def random_update(seed):
    rng = numpy.random.default_rng(seed)
    batch = (3, 4)
    state = random_states(rng, *batch)
    _, rows = observed(state, rng.uniform(-1.0, 1.0, (3, *batch)))
    root = rng.standard_normal((17, 17, *batch)) * numpy.array(
        [3.0] * 3 + [9.0] + [0.5] * 3 + [0.5] + [0.5] * 3 + [0.02] * 3 + [3e-4] * 3
    ).reshape(17, 1, 1, 1)
    P = numpy.einsum("ik...,jk...->ij...", root, root)
    residual = SENSOR_SIGMA.reshape(14, 1, 1) * rng.standard_normal((14, *batch))
    return state, P, residual, rows


def gain_form(mean, P, residual, H, R):
    """Update of one lane by the Kalman gain and Joseph's form."""
    K = P @ H.T @ numpy.linalg.inv(H @ P @ H.T + R)
    rest = numpy.eye(len(mean)) - K @ H
    return mean + K @ residual, rest @ P @ rest.T + K @ R @ K.T


def information_form(mean, P, residual, H, R):
    """Update of one lane by step 6 of the paper."""
    weighted = H.T @ numpy.linalg.inv(R)
    posterior = numpy.linalg.inv(numpy.linalg.inv(P) + weighted @ H)
    return mean + posterior @ weighted @ residual, posterior


def lane_by_lane(form, state, P, residual, H):
    mean, covariance, R = numpy.empty_like(state), numpy.empty_like(P), numpy.diag(SENSOR_SIGMA**2)
    for lane in numpy.ndindex(state.shape[1:]):
        at = (..., *lane)
        mean[at], covariance[at] = form(state[at], P[at], residual[at], H[at], R)
    return mean, covariance


@pytest.mark.parametrize("seed", range(2))
def test_three_forms_of_the_update_are_one(seed):
    state, P, residual, rows = random_update(seed)
    H = dense(rows, state)
    gain = lane_by_lane(gain_form, state, P, residual, H)
    information = lane_by_lane(information_form, state, P, residual, H)
    scalar = extended_kalman.update_one_by_one(state, P, residual, rows, SENSOR_SIGMA**2, numpy.ones(14))
    sigma = numpy.sqrt(numpy.einsum("ii...->i...", gain[1]))
    # The inverse of the prediction costs the information form the condition of P, up to 1e9 unscaled.
    for other, tolerance in ((information, 1e-6), ((scalar.mean, scalar.covariance), 1e-9)):
        assert (abs(other[0] - gain[0]) / sigma).max() < tolerance
        assert abs((other[1] - gain[1]) / (sigma[:, None] * sigma[None])).max() < tolerance
    assert (scalar.covariance == scalar.covariance.swapaxes(0, 1)).all()


@pytest.mark.parametrize("seed", range(3))
def test_scalar_updates_give_the_joint_likelihood(seed):
    state, P, residual, rows = random_update(seed)
    H = dense(rows, state)
    result = extended_kalman.update_one_by_one(state, P, residual, rows, SENSOR_SIGMA**2, numpy.ones(14))
    for i in range(3):
        h, p, nu = H[..., i, 1], P[..., i, 1], residual[:, i, 1]
        S = h @ p @ h.T + numpy.diag(SENSOR_SIGMA**2)
        nis = nu @ numpy.linalg.solve(S, nu)
        log_density = -0.5 * (nis + numpy.linalg.slogdet(2 * math.pi * S)[1])
        assert sum(r[i, 1] for r in result.squared_residuals) == pytest.approx(nis, rel=1e-9)
        assert result.log_likelihood[i, 1] == pytest.approx(log_density, rel=1e-9)


def test_what_is_not_available_changes_nothing():
    state, P, residual, rows = random_update(0)
    some = numpy.ones(14)
    some[[1, 5, 9]] = 0.0
    kept = [j for j in range(14) if some[j]]
    masked = extended_kalman.update_one_by_one(state, P, residual, rows, SENSOR_SIGMA**2, some)
    short = extended_kalman.update_one_by_one(
        state, P, residual[kept], [rows[j] for j in kept], SENSOR_SIGMA[kept] ** 2, numpy.ones(11)
    )
    assert (masked.mean == short.mean).all()
    assert (masked.covariance == short.covariance).all()
    assert (masked.log_likelihood == short.log_likelihood).all()
    nothing = extended_kalman.update_one_by_one(state, P, residual, rows, SENSOR_SIGMA**2, numpy.zeros(14))
    assert (nothing.mean == state).all()
    assert (nothing.covariance == P).all()
    assert (nothing.log_likelihood == 0.0).all()


def test_a_cautious_gain_is_that_of_a_noisier_reading_with_the_covariance_of_the_true_one():
    """Each observation in its turn, in Joseph's form; one in three is missing."""
    state, P, residual, rows = random_update(0)
    H, r = dense(rows, state), SENSOR_SIGMA**2
    cautions, available = numpy.linspace(0.25, 4.0, 14), (numpy.arange(14) % 3 > 0).astype(float)
    result = extended_kalman.update_one_by_one(state, P, residual, rows, r, available, None, cautions)
    for lane in numpy.ndindex(state.shape[1:]):
        at = (..., *lane)
        x, C = numpy.zeros(17), P[at].copy()
        for j, h in enumerate(H[at]):
            k = available[j] * C @ h / (h @ C @ h + cautions[j] * r[j])
            x = x + k * (residual[at][j] - h @ x)
            rest = numpy.eye(17) - numpy.outer(k, h)
            C = rest @ C @ rest.T + r[j] * numpy.outer(k, k)
        sigma = numpy.sqrt(numpy.diag(C))
        assert (abs(result.mean[at] - state[at] - x) / sigma).max() < 1e-9
        assert abs((result.covariance[at] - C) / numpy.outer(sigma, sigma)).max() < 1e-9
    assert (result.covariance == result.covariance.swapaxes(0, 1)).all()


@pytest.mark.parametrize("seed", range(2))
def test_robust_update_is_the_minimum_of_hubers_cost(seed):
    """Each observation in its turn: where the derivative of prediction's and Huber's cost along P h is zero."""
    state, P, residual, rows = random_update(seed)
    P, residual = 0.01 * P, 5.0 * residual
    H, r, k = dense(rows, state), SENSOR_SIGMA**2, numpy.linspace(0.5, 3.0, 14)
    result = extended_kalman.update_one_by_one(state, P, residual, rows, r, numpy.ones(14), k)
    beyond = 0
    for lane in list(numpy.ndindex(state.shape[1:]))[:4]:
        at = (..., *lane)
        x, C, log_likelihood = numpy.zeros(17), P[at].copy(), 0.0
        for j, h in enumerate(H[at]):
            p, nu, root = h @ C @ h, residual[at][j] - h @ x, math.sqrt(r[j])

            def slope(t, p=p, nu=nu, root=root, k=k[j]):
                return t - max(-k, min(k, (nu - p * t) / root)) / root

            t = scipy.optimize.brentq(slope, -k[j] / root - 1.0, k[j] / root + 1.0, xtol=1e-300, rtol=1e-14)
            beyond += abs(nu - p * t) > k[j] * root * (1.0 + 1e-9)
            s = nu / t
            x, C = x + C @ h * t, C - numpy.outer(C @ h, C @ h) / s
            log_likelihood -= 0.5 * (nu**2 / s + math.log(2.0 * math.pi * s))
        sigma = numpy.sqrt(numpy.diag(C))
        # The same rounding as between the forms of the plain update.
        assert (abs(result.mean[at] - state[at] - x) / sigma).max() < 1e-8
        assert abs((result.covariance[at] - C) / numpy.outer(sigma, sigma)).max() < 1e-8
        assert result.log_likelihood[at] == pytest.approx(log_likelihood, rel=1e-8)
    assert 5 < beyond < 50
