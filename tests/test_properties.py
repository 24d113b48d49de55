"""Properties that hold for any improbable mode and any flight; examples by hypothesis.

The profile in ``conftest.py`` draws the same examples in every run.
"""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from filtergym.envs.data.trajectory import Trajectory
from filtergym.envs.radar_esm_tracking.task import RadarEsmTracking, RadarEsmTrackingParameters
from filtergym.filters import class_fusion, imm

# --- modes of no probability

MODELS, _ = RadarEsmTracking.design_models(RadarEsmTrackingParameters())
MODES, BATCH = 3, 4
CHANCES = st.sampled_from([0.0, 0.0, 5e-324, 1e-300, 1e-9, 0.3, 1.0])


def simplex(columns):
    """Columns of probabilities, many of them zero or nearly, ``(MODES, columns)``."""
    column = st.lists(CHANCES, min_size=MODES, max_size=MODES).filter(lambda c: sum(c) > 1e-10)
    return st.lists(column, min_size=columns, max_size=columns).map(
        lambda drawn: np.array([np.array(c) / sum(c) for c in drawn]).T
    )


TRANSITIONS = simplex(MODES).map(lambda columns: columns.T)
PROBABILITIES = simplex(BATCH)
LOG_LIKELIHOODS = st.lists(
    st.floats(-1e6, 1e3) | st.sampled_from([0.0, -1e300, -np.inf]),
    min_size=MODES * BATCH,
    max_size=MODES * BATCH,
).map(lambda values: np.reshape(values, (MODES, BATCH)))


def assert_probabilities(values):
    assert np.isfinite(values).all()
    assert (values >= 0.0).all()
    # One rounding for each of three terms.
    np.testing.assert_allclose(values.sum(axis=0), 1.0, rtol=0, atol=1e-15 * MODES)


def assert_bank(mean, covariance):
    assert np.isfinite(mean).all()
    assert np.isfinite(covariance).all()
    np.testing.assert_array_equal(covariance, covariance.swapaxes(0, 1))
    assert np.linalg.eigvalsh(np.moveaxis(covariance, (0, 1), (-2, -1))).min() > 0.0


def random_bank(n, scale=1.0):
    rng = np.random.default_rng(0)
    root = rng.normal(size=(n, n, MODES, BATCH))
    covariance = np.einsum("ijmb,kjmb->ikmb", root, root) + 0.1 * np.eye(n)[:, :, None, None]
    return scale * rng.normal(size=(n, MODES, BATCH)), covariance


@settings(max_examples=40)
@given(TRANSITIONS, PROBABILITIES, LOG_LIKELIHOODS)
def test_impossible_modes_leave_the_imm_finite(transition, probabilities, log_likelihood):
    prediction = imm.predict_mode_probabilities(transition, probabilities)
    assert_probabilities(prediction.probabilities)
    assert_probabilities(prediction.mixing)
    mean, covariance = random_bank(4)
    assert_bank(*imm.mix(mean, covariance, prediction.mixing))
    # A measurement that no mode allows is not to be judged.
    log_likelihood[0] = np.maximum(log_likelihood[0], -1e300)
    posterior = imm.mode_posterior(imm.log_probabilities(prediction.probabilities), log_likelihood)
    assert_probabilities(posterior)
    assert (posterior[np.isneginf(log_likelihood)] == 0.0).all()
    assert_bank(*imm.combine(mean, covariance, posterior))
    even = imm.mode_posterior(np.zeros((MODES, BATCH)), np.zeros((MODES, BATCH)))
    np.testing.assert_allclose(even, 1.0 / MODES, rtol=1e-15)


@settings(max_examples=25)
@given(TRANSITIONS, PROBABILITIES, st.sampled_from([0.0, 1e2, 1e6]))
def test_impossible_classes_leave_the_fusion_finite(transition, probabilities, distance):
    mean, covariance = random_bank(MODELS.Phi.shape[0])
    z = distance * np.random.default_rng(1).normal(size=(MODELS.H.shape[0], BATCH))
    step = class_fusion.advance(probabilities, mean, covariance, z, MODELS, transition)
    assert np.isfinite(step.mean).all()
    assert np.isfinite(step.covariance).all()
    assert (np.diagonal(step.covariance) > 0.0).all()
    assert np.isfinite(step.log_likelihood).all()
    log_predicted = imm.mode_posterior(step.log_predicted, np.zeros((MODES, BATCH)))
    np.testing.assert_allclose(np.exp(step.log_predicted), log_predicted, rtol=1e-12, atol=1e-299)
    assert_probabilities(log_predicted)


# --- flights


@st.composite
def flights(draw):
    """Times on a grid, positions, perhaps velocities, the grid's interval and the places of the times."""
    gaps = draw(st.lists(st.integers(1, 20), min_size=1, max_size=7))
    places = np.concatenate([[0], np.cumsum(gaps)])
    interval, start = draw(st.floats(0.1, 10.0)), draw(st.floats(-1e4, 1e4))
    numbers = st.floats(-1e6, 1e6, allow_subnormal=False)
    rows = st.lists(st.tuples(numbers, numbers), min_size=len(places), max_size=len(places)).map(np.array)
    velocity = draw(st.none() | rows)
    return start + interval * places, draw(rows), velocity, interval, places


@settings(max_examples=40)
@given(flights(), st.integers(0, 50))
def test_valid_flights_resample_to_finite_states_through_every_row(flight, beyond):
    time, position, velocity, interval, places = flight
    states = Trajectory(time, position, velocity).resample(interval, places[-1] + 1 + beyond)
    assert states.shape == (4, places[-1] + 1 + beyond)
    assert np.isfinite(states).all()
    # The terms of a spline are larger than its values by the unevenness of the times.
    np.testing.assert_allclose(states[:2, places], position.T, rtol=0, atol=1e-9 * (1.0 + abs(states).max()))
    if velocity is not None:
        scale = 1.0 + abs(velocity).max() + abs(position).max() / interval
        np.testing.assert_allclose(states[2:, places], velocity.T, rtol=0, atol=1e-9 * scale)
    # Straight on beyond the end.
    np.testing.assert_array_equal(
        states[2:, places[-1] :], states[2:, places[-1] :][:, :1].repeat(beyond + 1, 1)
    )
