"""The task of tightly coupled navigation, driven without an engine."""

import math

import numpy
import pytest
from models import draw
from naive import dense

from filtergym.envs.contract.causes import Causes
from filtergym.envs.contract.faults import DisturbanceInput
from filtergym.envs.contract.model import Model
from filtergym.envs.tightly_coupled_navigation.disturbances import Reception, Reflections
from filtergym.envs.tightly_coupled_navigation.parameters import (
    TightlyCoupledNavigationParameters,
)
from filtergym.envs.tightly_coupled_navigation.scenarios import SCENARIOS
from filtergym.envs.tightly_coupled_navigation.task import TightlyCoupledNavigation
from filtergym.filters import gnss_ins
from filtergym.filters.packed_covariance import unpack

ZERO = {"evidence": 3, "weights": 3, "gain": 4}


def make(scenario, control="evidence", xp=numpy, **keywords) -> Model:
    parameters = TightlyCoupledNavigationParameters(**{**SCENARIOS[scenario].parameters, **keywords})
    return Model(TightlyCoupledNavigation(parameters, xp), control)


def drive(model, N, seed, steps, action=None, kind=numpy.asarray):
    """Yield step, state after ``measure``, observation and state after ``act``."""
    uniforms, normals, rows = draw(model, N, seed, steps)
    state = model.begin(kind(uniforms), kind(normals))
    for k, row in enumerate(rows, 1):
        measured = model.measure(state, kind(row))
        observation = model.observe(measured)
        zero = kind(numpy.zeros((ZERO.get(model.control, 3), N)))
        state = model.act(measured, zero if action is None else action(k, observation, measured))
        yield k, measured, observation, state


def naive_bank(model, state, posterior):
    """Steps 1 to 8 of the paper for one lane, with dense matrices and the information form."""
    p = model.task.parameters
    means, covariances, probabilities = posterior
    pi = numpy.array(p.transition)
    predicted = probabilities @ pi
    new_means, new_covariances, log_likelihoods = [], [], []
    for i in range(3):
        weight = pi[:, i] * probabilities / predicted[i]
        mean = sum(w * m for w, m in zip(weight, means, strict=True))
        P = sum(
            w * (c + numpy.outer(m - mean, m - mean))
            for w, m, c in zip(weight, means, covariances, strict=True)
        )
        F = gnss_ins.advance(
            numpy.eye(17)[:, :, None, None],
            model.task.axis[:, :, i : i + 1],
            model.task.common.T,
            model.task.common.decay,
        )[..., 0, 0]
        mean, P = F @ mean, F @ P @ F.T + model.task.process_noise[:, :, i, 0]
        measured = state.measurement
        expected, rows = gnss_ins.observe(
            mean[:, None],
            measured.satellite_position,
            measured.satellite_velocity,
            measured.ins_angles,
            p.gravity,
        )
        H = dense(rows, mean[:, None])[..., 0]
        nu = (measured.readings - expected)[:, 0]
        R = numpy.diag(model.task.sensor_variance)
        S = H @ P @ H.T + R
        log_likelihoods.append(
            -0.5 * (nu @ numpy.linalg.solve(S, nu) + numpy.linalg.slogdet(2 * numpy.pi * S)[1])
        )
        D = numpy.linalg.inv(numpy.linalg.inv(P) + H.T @ numpy.linalg.inv(R) @ H)
        new_means.append(mean + D @ H.T @ numpy.linalg.inv(R) @ nu)
        new_covariances.append(D)
    log_posterior = numpy.log(predicted) + numpy.array(log_likelihoods)
    posterior = numpy.exp(log_posterior - log_posterior.max())
    posterior = posterior / posterior.sum()
    estimate = sum(w * m for w, m in zip(posterior, new_means, strict=True))
    return (new_means, new_covariances, posterior), estimate


@pytest.mark.parametrize(("scenario", "seed"), [("random", 0), ("paper", 2)])
def test_zero_evidence_is_the_algorithm_of_the_paper(scenario, seed):
    model = make(scenario, leg_steps=(20, 40))
    posterior = None
    for _, measured, _, state in drive(model, 1, seed, 60):
        if posterior is None:
            start = model.begin(*draw(model, 1, seed, 0)[:2]).filter
            posterior = (
                list(start.means[..., 0].T),
                [unpack(start.covariances, 17)[:, :, i, 0] for i in range(3)],
                start.probabilities[:, 0],
            )
        posterior, estimate = naive_bank(model, measured, posterior)
        # The information form inverts a covariance with a condition near 1e11; the mixture amplifies it.
        numpy.testing.assert_allclose(state.filter.mean[:, 0], estimate, rtol=1e-6, atol=1e-5)
        numpy.testing.assert_allclose(state.filter.probabilities[:, 0], posterior[2], atol=1e-5)


def test_controls_that_ask_for_the_paper_get_it_bit_for_bit():
    steps = 40
    steered, noise = make("random", "evidence"), make("random", "gain")
    *_, (*_, evidence) = drive(steered, 8, 3, steps)
    *_, (*_, gain) = drive(noise, 8, 3, steps)
    assert (steered.mean(evidence) == noise.mean(gain)).all()
    assert (steered.covariance(evidence) == noise.covariance(gain)).all()


def test_weights_that_state_the_probabilities_follow_the_paper():
    paper = make("random")
    probabilities = [s.filter.probabilities for *_, s in drive(paper, 8, 3, 30)]
    weighted = make("random", "weights")
    by_weights = [s.filter.mean for *_, s in drive(weighted, 8, 3, 30, lambda k, o, s: probabilities[k - 1])]
    for estimate, (*_, state) in zip(by_weights, drive(paper, 8, 3, 30), strict=True):
        # Normalising weights that already sum to one moves the last digit.
        numpy.testing.assert_allclose(estimate, state.filter.mean, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("control", ["evidence", "gain"])
def test_tracking_loops_lose_what_the_feedback_does_not_expect(control):
    model = make("paper", control)
    *_, (_, _, _, state) = drive(model, 8, 7, 5)
    expected = model.feedback(state.filter, state.measurement)
    row = numpy.zeros((model.task.noise.normals, 8))
    far = expected.copy()
    far[7, :4] += 10.0  # clock drift, m/s: more than the rates' aperture
    far[3, 4:] += 300.0  # clock bias, m: more than the ranges' aperture
    for feedback, rates, ranges in ((None, 1.0, 1.0), (expected, 1.0, 1.0), (far, 0.0, 0.0)):
        _, measured = model.task.world.advance(state.truth, row, feedback)
        assert (measured.available[4:8, :4] == rates).all()
        assert (measured.available[:4, 4:] == ranges).all()
        assert (measured.available[:4, :4] == 1.0).all()
        assert (measured.available[4:8, 4:] == 1.0).all()
        assert (measured.available[8:] == 1.0).all()
    assert not make("matched", control).task.closes_loop


def test_innovations_are_read_in_their_units():
    model = make("paper")
    for _, measured, observation, _ in drive(model, 8, 8, 5):
        innovation = measured.filter.range_innovation * measured.measurement.available[:8]
        for part, name in (
            (slice(0, 4), "pseudorange_innovation_in_metres"),
            (slice(4, 8), "rate_innovation_in_metres_per_second"),
        ):
            # Through a logarithm and back.
            read = model.reader(name)(observation.T)
            numpy.testing.assert_allclose(read.T, innovation[part], rtol=1e-13, atol=1e-15)


@pytest.mark.parametrize("slots", [(19,), (1, 2, 11, 19, 20)])
def test_other_numbers_of_satellites(slots):
    model = make("random", satellites=slots, satellites_outage_probability=0.0)
    *_, (*_, observation, state) = drive(model, 8, 9, 60)
    assert observation.shape[0] == len(model.fields)
    assert numpy.isfinite(model.cost(state)).all()
    sigma = numpy.sqrt(numpy.einsum("iin->in", model.covariance(state))[:3]).mean()
    whole = make("random", satellites_outage_probability=0.0)
    *_, (*_, reference) = drive(whole, 8, 9, 60)
    better = sigma < numpy.sqrt(numpy.einsum("iin->in", whole.covariance(reference))[:3]).mean()
    assert better == (len(slots) > 4)


@pytest.mark.parametrize(
    ("keywords", "message"),
    [
        ({"satellites": (1, 1, 11, 19)}, "different slots"),
        ({"satellites": ()}, "at least one"),
        ({"satellites": (19,), "satellites_outage_probability": 0.2}, "two satellites, got .*: set it to 0"),
        ({"satellites": (1, 10, 11, 19)}, "satellite 10 stands at .* below elevation_mask"),
        ({"satellites": (1, 11, 19, 25)}, "1 to 24"),
        ({"satellites": (1, 2, 11, 19), "epoch": 505.292}, "degenerate geometry"),
        ({"transition": ((0.9, 0.2, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))}, "must sum to 1"),
        ({"initial_probabilities": (0.5, 0.5)}, "3 numbers"),
        ({"pseudorange_sigma": 0.0}, "pseudorange_sigma must be a finite number above 0"),
        ({"singer_sigma": -1.0}, "singer_sigma"),
        ({"course": "loop"}, "course must be one of"),
        ({"leg_steps": (2000, 1000)}, "ascending"),
        ({"leg_duration": (3.0, 1.0)}, "ascending"),
        ({"horizon": 0}, "horizon"),
    ],
)
def test_bad_parameters_are_refused_with_the_reason(keywords, message):
    with pytest.raises(ValueError, match=message):
        TightlyCoupledNavigationParameters(**keywords)


def test_a_likelihood_far_below_the_smallest_float_leaves_probabilities():
    model = make("random", stick_probability=0.0, rate_fault_probability=0.0)
    *_, (_, measured, _, _) = drive(model, 8, 10, 5)
    thrown = measured.measurement.readings.copy()
    thrown[4:8] += 8.0  # 80 sigma of four rates
    bank = model.filter.predict(measured.filter, measured.measurement._replace(readings=thrown))
    assert (bank.log_likelihood < -2800.0).any()
    probabilities = model.filter.act(bank, measured.measurement, numpy.zeros((3, 8))).probabilities
    numpy.testing.assert_allclose(probabilities.sum(axis=0), 1.0, rtol=1e-15)
    winner = (bank.log_predicted + bank.log_likelihood).argmax(axis=0)
    assert (probabilities.argmax(axis=0) == winner).all()
    assert (probabilities.max(axis=0) > 0.5).all()


UNMIXED = {"urban": False, "aperture": False, "undisturbed": 0.0}
"""Without what only some episodes of ``random`` have."""


def test_some_episodes_are_undisturbed_between_houses_steered_or_one_manoeuvre():
    model, N = make("random", horizon=300), 4000
    uniforms, normals, _ = draw(model, N, 21, 0)
    truth = model.begin(uniforms, normals).truth
    found, p = truth.disturbances, model.task.parameters
    urban, aperture = found["reflections"].urban, found["aperture"]
    four = 4.0 * math.sqrt(0.25 / N)
    names = "noisy", "stuck", "no_rates", "hidden", "ramp"
    happens = {name: found[name].window[1] >= 0.0 for name in names}
    hidden, reported = (p.undisturbed, happens), (0.0, {**happens, "urban": urban, "aperture": aperture})
    for without, parts, shares in (
        (*hidden, {"noisy": 0.3, "stuck": 0.3}),
        (*reported, {"no_rates": 0.15, "hidden": 0.2, "urban": 0.15, "aperture": 0.2}),
    ):
        for name, share in shares.items():
            assert abs(parts[name].mean() - (1 - without) * share) < four, name
    assert (found["ramp"].window == -1.0).all()
    throughout = (truth.legs.kind == 2.0).all(axis=0)
    assert abs(throughout.mean() - 0.15) < four
    assert (truth.legs.start[1:, throughout] > p.horizon + 1).all()
    strength = numpy.linalg.norm(truth.legs.acceleration, axis=0)
    assert strength[:, urban > 0.0].max() <= 4.0 + 1e-12
    assert strength.max() > 39.0
    speed = numpy.linalg.norm(truth.state[4:7], axis=0)
    assert 10.0 < speed[urban > 0.0].max() <= 15.0 + 1e-9
    assert speed.max() > 290.0
    assert (found["reflections"].cn0[:, urban == 0.0] == p.clear_cn0).all()


def test_only_some_tracking_loops_have_an_aperture_and_only_some_receivers_reflections():
    model = make(
        "random", aperture_probability=0.5, urban_probability=0.5, undisturbed=0.0, rate_aperture=0.1,
        pseudorange_coloured=(0.0, 0.0),
    )  # fmt: skip
    lost, off = numpy.zeros(16), numpy.zeros(16)
    for _, state, _, _ in drive(model, 16, 22, 60):
        found = state.truth.disturbances
        excused = (found["no_rates"].now > 0.0) | (found["hidden"].now > 0.0)
        lost += (state.measurement.available[4:8] == 0.0).any(axis=0) & ~excused
        off += (state.truth.range_error != 0.0).any(axis=0)
    aperture, urban = found["aperture"], found["reflections"].urban
    assert (lost[aperture == 0.0] == 0.0).all()
    assert (lost[aperture == 1.0] > 0.0).all()
    assert 0 < aperture.sum() < 16
    assert (off[urban == 0.0] == 0.0).all()
    assert (off[urban == 1.0] > 0.0).all()
    assert 0 < urban.sum() < 16


def test_a_pseudorange_drifts_off_as_stated():
    quiet = make("satellite-ramp", pseudorange_sigma=1e-4, ramp_jump=(10.0, 50.0))
    for k, state, _, _ in drive(quiet, 8, 23, 350):
        s = state.truth
        ramp = s.disturbances["ramp"]
        place, first = ramp.satellites[0].astype(int), ramp.window[0]
        expected = numpy.where(k >= first, ramp.own[0] + 10.0 * 0.01 * (k - first + 1.0), 0.0)
        error = numpy.zeros((4, 8))
        error[place, numpy.arange(8)] = expected
        assert s.range_error == pytest.approx(error, abs=1e-12)
        ranges, _ = gnss_ins.observe(
            s.state,
            *quiet.task.satellites_at(s.step),
            state.measurement.ins_angles,
            quiet.task.parameters.gravity,
        )
        # Ranges of 2e7 m are rounded by 4e-9, the noise is 1e-4: ten sigma.
        assert state.measurement.readings[:4] - ranges[:4] == pytest.approx(error, abs=1e-3)
    assert ((first >= 101) & (first <= 301)).all()
    assert ((ramp.own[0] >= 10.0) & (ramp.own[0] <= 50.0)).all()
    assert (error > 0.0).sum(axis=0).all()


def test_coloured_errors_have_the_deviation_and_the_correlation_that_are_drawn():
    model = make("coloured-ranges", pseudorange_correlation_time=(0.1, 0.5))
    errors = []
    for _, state, _, _ in drive(model, 200, 25, 60):
        errors.append(state.truth.disturbances["coloured"].level)
    coloured = state.truth.disturbances["coloured"]
    errors, decay = numpy.array(errors) / coloured.deviation, coloured.process.decay
    assert (state.truth.range_error == coloured.level).all()
    assert ((coloured.deviation >= 3.0) & (coloured.deviation <= 8.0)).all()
    assert (decay >= math.exp(-0.1)).all()
    # 800 errors at a time: standard error of a variance 0.05; stationary from the start.
    assert abs((errors[[0, -1]] ** 2).mean(axis=(1, 2)) - 1.0).max() < 4 * 0.05
    kicks = errors[1:] - decay * errors[:-1]
    scaled = kicks / numpy.sqrt(1.0 - decay**2)
    assert abs((scaled**2).mean() - 1.0) < 4 * math.sqrt(2.0 / scaled.size)
    assert abs((scaled * errors[:-1]).mean()) < 4 / math.sqrt(scaled.size)


def test_undisturbed_episodes_have_no_coloured_errors():
    model = make("random", undisturbed=0.5)
    *_, (_, state, _, _) = drive(model, 32, 26, 3)
    coloured = state.truth.disturbances["coloured"]
    assert 0 < (coloured.deviation == 0.0).sum() < 32
    assert ((coloured.level != 0.0).all(axis=0) == (coloured.deviation > 0.0)).all()


def test_heading_is_drawn_but_on_the_courses_of_the_paper():
    *_, (_, state, _, _) = drive(make("random"), 200, 27, 1)
    heading = numpy.degrees(state.truth.heading)
    assert ((heading >= 0.0) & (heading < 360.0)).all()
    assert numpy.ptp(heading) > 300.0
    shown = state.measurement.ins_angles[0] - state.truth.state[11]
    assert shown == pytest.approx(state.truth.heading, abs=1e-12)
    *_, (_, state, _, _) = drive(make("kinematic"), 3, 27, 1)
    assert numpy.degrees(state.truth.heading) == pytest.approx([45.0] * 3, abs=1e-12)


def test_faults_and_outages_happen_when_and_where_they_are_drawn():
    model = make(
        "random",
        stick_probability=1.0,
        rate_fault_probability=1.0,
        rates_outage_probability=0.0,
        satellites_outage_probability=1.0,
        satellites_outage_duration=(2.0, 2.0),
        stick_duration=(0.3, 1.0),
        rate_fault_duration=(1.0, 3.0),
        horizon=320,
        **UNMIXED,
    )
    previous, noisy, stuck, out = None, 0, 0, 0
    for k, state, _, _ in drive(model, 8, 11, 320):
        s, measured = state.truth, state.measurement
        assert ((s.noise_factor[4:8] == 1.0) | (s.noise_factor[4:8] == s.disturbances["noisy"].own)).all()
        noisy = noisy + (s.noise_factor[4:8] > 1.0).sum(axis=0)
        assert (s.noise_factor[:4] == 1.0).all()
        first, last = s.disturbances["stuck"].window
        held = (s.step >= first) & (s.step <= last) & (k > 1)
        assert (held == (s.disturbances["stuck"].now == 1.0)).all()
        causes = {
            c.name: model.causes(state) // 2.0**i % 2.0 for i, c in enumerate(Causes.of(model.task).causes)
        }
        assert (causes["stuck accelerometers"] == held).all()
        assert (causes["noisy rate"] == (s.noise_factor > 1.0).any(axis=0)).all()
        if previous is not None:
            same = (measured.readings[8:11] == previous.readings[8:11]).all(axis=0)
            assert (same == held).all()
        stuck = stuck + held
        missing = 4 - measured.available[:4].sum(axis=0)
        assert (measured.available[:4] == measured.available[4:8]).all()
        assert set(missing) <= {0.0, 2.0}
        out = out + (missing == 2.0)
        previous = measured
    assert (out == 200).all()
    assert ((noisy >= 100) & (noisy <= 300)).all()
    assert ((stuck >= 29) & (stuck <= 100)).all()
    assert ((s.disturbances["noisy"].own > 2.0) & (s.disturbances["noisy"].own < 10.0)).all()
    assert numpy.ptp(s.disturbances["noisy"].own) > 2.0


def test_rates_are_lost_when_it_is_drawn():
    model = make(
        "random", satellites_outage_probability=0.0, rates_outage_probability=0.5, horizon=250, **UNMIXED
    )
    lost, drawn = 0, 0
    for _, state, _, _ in drive(model, 16, 11, 250):
        (first, last), step = state.truth.disturbances["no_rates"].window, state.truth.step
        inside = (first <= step) & (step <= last)
        assert (state.measurement.available[4:8] == ~inside).all()
        assert (state.measurement.available[:4] == 1.0).all()
        lost, drawn = lost + inside, numpy.where(first < 0.0, 0.0, last - first + 1.0)
    assert (lost == drawn).all()
    assert 0 < (drawn > 0).sum() < 16


def test_urban_errors_have_the_stated_quantiles():
    model = make("urban")
    rng = numpy.random.default_rng(12)
    N = 40000
    reflections = Reflections(model.task)
    wide, between = numpy.zeros((4, N)), numpy.ones(N)

    def noise():
        normals = numpy.concatenate([wide, rng.standard_normal((4, N))])
        return DisturbanceInput(between, 0.01, normals, rng.random((4, N)))

    for cn0, median, upper in ((25.0, 50.0, 152.0), (34.0, 25.0, 79.0), (41.0, 7.0, 49.0), (47.0, 0.0, 19.0)):
        s = reflections.advance(Reception(between, wide + cn0, wide, wide), noise())
        assert (s.multipath >= 0.0).all()
        # 160,000 draws: four standard errors of the quantiles.
        assert numpy.median(s.multipath) == pytest.approx(median, abs=0.02 * median + 0.15)
        assert numpy.quantile(s.multipath, 0.95) == pytest.approx(upper, rel=0.03)
        assert s.hold.min() >= 48.0
        assert s.hold.max() <= 199.0
        held = reflections.advance(s, noise())
        assert (held.multipath == s.multipath).all()


def test_the_papers_course_rests_goes_along_and_then_flies_across():
    model = make("paper", heading=(10.0, 80.0))
    p, rng = model.task.parameters, numpy.random.default_rng(3)
    truth = model.begin(
        rng.random((model.task.noise.uniforms, 16)),
        rng.standard_normal((model.task.noise.initial_normals, 16)),
    ).truth
    legs, heading = truth.legs, truth.heading
    numpy.testing.assert_array_equal(legs.kind, numpy.array([0.0, 1.0, 2.0])[:, None] + numpy.zeros(16))
    numpy.testing.assert_array_equal(legs.start, numpy.array([0, *p.leg_steps])[:, None] + numpy.zeros(16))
    assert numpy.ptp(heading) > 0.1
    for n, angle in enumerate(heading):
        forward = p.leg_acceleration * numpy.array([math.sin(angle), math.cos(angle), 0.0])
        # A turn to the right by 90 degrees, seen from above.
        across = numpy.array([forward[1], -forward[0], 0.0])
        numpy.testing.assert_allclose(
            legs.acceleration[..., n], numpy.stack([0.0 * forward, forward, across], axis=1), atol=1e-12
        )


def test_random_course_has_every_leg_and_bounded_strength():
    model = make("random", manoeuvre_throughout=0.0, **UNMIXED)
    rng = numpy.random.default_rng(13)
    legs = model.begin(
        rng.random((model.task.noise.uniforms, 512)), rng.standard_normal((17, 512))
    ).truth.legs
    kinds = legs.kind
    assert set(numpy.unique(kinds[0])) == {0.0, 1.0}
    assert set(numpy.unique(kinds[1:])) == {1.0, 2.0}
    strength = numpy.linalg.norm(legs.acceleration, axis=0)
    assert ((strength <= 40.0 + 1e-12) & ((strength >= 0.5 - 1e-12) == (kinds == 2.0))).all()
    lengths = numpy.diff(legs.start, axis=0)
    assert lengths.min() >= 100
    assert lengths.max() <= 300
