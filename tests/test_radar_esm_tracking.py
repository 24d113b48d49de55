"""RadarEsmTracking: what is shown, the printed recursion, no truth in sight, the frequencies of its world."""

import math
from types import SimpleNamespace

import models
import numpy
import pytest

from filtergym.envs.contract.causes import Moment
from filtergym.envs.contract.model import Model
from filtergym.envs.radar_esm_tracking.causes import causes_of
from filtergym.envs.radar_esm_tracking.picture import RadarEsmTrackingPicture
from filtergym.envs.radar_esm_tracking.task import TASK
from filtergym.filters import class_fusion, imm

LEAKY = ((0.9, 0.08, 0.02), (0.0, 0.7, 0.3), (0.25, 0.05, 0.7))


def make(scenario="paper", control="evidence", xp=numpy, **keywords) -> Model:
    keywords = {**TASK.scenarios[scenario].parameters, "decision_interval": 1, **keywords}
    parameters = TASK.Parameters(**keywords)
    return Model(TASK(parameters, xp), control)


def draw(model, N, seed):
    return models.draw(model, N, seed, model.task.horizon + 1)


def roll(model, noise, policy=None):
    """States after every ``measure`` and after every ``act``, the latter with its observation."""
    uniforms, normals, rows = noise
    state = model.begin(uniforms, normals)
    zero = numpy.zeros((model.task.classes, uniforms.shape[-1]))
    for row in rows:
        measured = model.measure(state, row)
        observation = model.observe(measured)
        state = model.act(measured, zero if policy is None else policy(observation))
        yield measured, observation, state


def leaves(value):
    if isinstance(value, dict):
        value = tuple(value.values())
    if isinstance(value, tuple):
        for item in value:
            yield from leaves(item)
    else:
        yield value


def test_observation_shows_what_it_names():
    model = make("random", averaging_measurements=1.0, second_emitter_probability=(0.0, 0.0))
    noise = draw(model, 64, 3)
    decided = refused = 0
    for k, (state, observation, _) in enumerate(roll(model, noise), start=1):
        shown = {f.name: observation[i] for i, f in enumerate(model.fields)}
        one_hot = numpy.stack([shown[f"decision_{j}"] for j in range(4)])
        assert (one_hot.sum(axis=0) + shown["decision_none"] == 1.0).all()
        if k % 4:
            assert (shown["decision_none"] == 1.0).all()
        outside = (numpy.abs(shown["bearing_difference"]) > 1.0).astype(float)
        assert (outside == shown["decision_refused"]).all()
        decided, refused = decided + one_hot.sum(), refused + shown["decision_refused"].sum()
        counts = sum(shown[f"{kind}_count_{j}"] for kind in ("used", "refused") for j in range(4))
        assert (counts * 10.0).round(9).max() <= k // 4 + 1
        read = {
            name: model.reader(name)(observation.T) for name in ("innovation_range", "innovation_range_rate")
        }
        nis = sum(innovation[:, 1] ** 2 for innovation in read.values())
        assert numpy.log1p(nis) == pytest.approx(shown["log_squared_innovation_S1"], rel=1e-12)
        assert model.reader("log_squared_innovation")(observation.T)[:, 1] == pytest.approx(nis, rel=1e-11)
        degrees = model.reader("bearing_difference")(observation.T)[:, 0]
        assert degrees == pytest.approx(state.measurement.bearing_difference, rel=1e-12)
        assert shown["time"] == pytest.approx(k * 0.5 / 60.0)
    assert decided > 500
    # association_error 0.2, binomial.
    assert refused / decided == pytest.approx(0.2, abs=4.0 * math.sqrt(0.16 / decided))


def test_first_observation_holds_the_decision_at_scan_0():
    model = make()
    _, observation, _ = next(roll(model, draw(model, 512, 1)))
    p = model.task.parameters
    counts = observation[model.columns([f"used_count_{j}" for j in range(4)])] * 10.0
    assert set(counts.sum(axis=0).round(12)) == {0.0, 1.0}
    pi = class_fusion.decision_probabilities(numpy.array(p.recognition), numpy.array(p.composition))
    posterior = numpy.where(counts.sum(axis=0) > 0.5, pi @ counts, 1.0 + 0.0 * counts[:3])
    posterior = posterior / posterior.sum(axis=0)
    weights = observation[model.columns([f"last_weight_S{s}" for s in range(3)])]
    assert weights == pytest.approx(posterior, rel=1e-12)


@pytest.mark.parametrize("transition", [None, LEAKY], ids=["constant", "jumping"])
def test_zero_evidence_is_the_recursion(transition):
    """The paper's algorithm as a policy equals the plain filter fed with the measurements alone."""
    more = {} if transition is None else {"class_transition": transition}
    model = make("random", **more)
    p = model.task.parameters
    models, start = model.task.design_models(p)
    q = numpy.array(p.class_transition)
    pi = class_fusion.decision_probabilities(numpy.array(p.recognition), numpy.array(p.composition))
    pi = numpy.concatenate([pi, numpy.ones((3, 1))], axis=1)
    gate = class_fusion.bearing_gate(p.radar_bearing_sigma, p.esm_bearing_sigma, p.association_error)

    def likelihood(measurement):
        passes = numpy.abs(measurement.bearing_difference) <= gate
        return pi[:, numpy.where(passes, measurement.decision, 4)]

    uniforms, normals, rows = draw(model, 16, 4)
    state = model.begin(uniforms, normals)
    first = state.measurement.first
    mean = numpy.stack([numpy.concatenate([first.radar, numpy.zeros((1, 16))])] * 3, axis=1)
    covariance = start[..., None] + numpy.zeros(16)
    P = numpy.full((3, 16), 1 / 3) * likelihood(first)
    P = P / P.sum(axis=0)
    for row in rows:
        state = model.measure(state, row)
        step = class_fusion.advance(P, mean, covariance, state.measurement.radar, models, q)
        P = imm.mode_posterior(step.log_predicted, numpy.log(likelihood(state.measurement)))
        mean, covariance = step.mean, step.covariance
        estimate, reported = imm.combine(mean, covariance, P)
        state = model.act(state, numpy.zeros((3, 16), dtype=numpy.float32))
        assert model.mean(state) == pytest.approx(estimate, rel=1e-10, abs=1e-8)
        assert model.covariance(state) == pytest.approx(reported, rel=1e-9, abs=1e-9)
        assert state.filter.probabilities == pytest.approx(P, rel=1e-8, abs=1e-14)


@pytest.mark.parametrize("transition", [None, LEAKY], ids=["constant", "jumping"])
def test_evidence_acts_on_the_weights_of_its_scan_only(transition):
    keywords = {} if transition is None else {"class_transition": transition}
    model = make("random", horizon=60, evidence_scale=3.0, **keywords)
    rng = numpy.random.default_rng(3)
    actions = rng.uniform(-1.2, 1.2, (61, 3, 8))
    paper = list(roll(model, draw(model, 8, 4)))
    chosen = iter(actions)
    for (measured, _, state), (paper_measured, _, paper_state), action in zip(
        roll(model, draw(model, 8, 4), lambda _: next(chosen)), paper, actions, strict=True
    ):
        # All that is known before the action is as without the actions before, but for the weights that were reported.
        kept = measured.filter._replace(probabilities=paper_measured.filter.probabilities)
        for one, other in zip(leaves(kept), leaves(paper_measured.filter), strict=True):
            numpy.testing.assert_array_equal(one, other)
        moved = paper_state.filter.probabilities * numpy.exp(3.0 * numpy.clip(action, -1.0, 1.0))
        numpy.testing.assert_allclose(state.filter.probabilities, moved / moved.sum(axis=0), rtol=1e-9)


@pytest.mark.parametrize("control", ["mode", "weights"])
def test_weights_that_are_stated_are_the_prior_of_the_next_scan(control):
    model = make("random", control, horizon=20)
    stated = numpy.full(8, 2) if control == "mode" else numpy.tile([[0.0], [0.0], [1.0]], 8)
    for _, _, state in roll(model, draw(model, 8, 4), lambda _: stated):
        numpy.testing.assert_array_equal(state.filter.posterior, [[0.0] * 8, [0.0] * 8, [1.0] * 8])


def test_every_filter_receives_the_first_measurement_with_its_covariance():
    model = make("fixed-type", prior=(0.2, 0.3, 0.5))
    uniforms, normals, _ = draw(model, 40000, 15)
    episode = model.begin(uniforms, normals)
    measured, error = episode.measurement, episode.measurement.mean - episode.truth.motion
    assert numpy.array_equal(measured.mean[:2], measured.first.radar)
    assert measured.first.looked.all()
    assert (measured.mean[2] == 0.0).all()
    # 40000 lanes: the mean of squares has a standard error of 0.7 %, more where the classes mix.
    assert (error**2).mean(axis=1) == pytest.approx(measured.covariance[..., 0].diagonal(), rel=0.03)
    assert (measured.covariance[..., 0] == numpy.diag(measured.covariance[..., 0].diagonal())).all()


WORLDS = {
    "true_class": "S2", "emitter": "fixed", "initial_range": (1e3, 2e3), "closing_speed": (-50.0, -40.0),
    "class_change": (2.0, 3.0), "class_change_probability": 0.9, "silence_start": (0.4, 0.5), "silence_end": (0.5, 0.6),
    "second_emitter_probability": (0.8, 0.9), "second_emitter_separation": (90.0, 91.0), "glint_probability": 0.3,
    "undisturbed": 0.1,
}  # fmt: skip
"""Parameters of what is and nothing else; no filter may know them."""


@pytest.mark.parametrize("scenario", ["random", "glint"])
def test_nothing_but_the_measurement_reaches_the_bank(scenario):
    """A bank made for another world shows and estimates the same from the same measurements."""
    more = {"horizon": 20, "class_transition": LEAKY}
    model, other = make(scenario, **more), make(scenario, **{**more, **WORLDS})
    uniforms, normals, rows = draw(model, 8, 11)
    episode = model.begin(uniforms, normals)
    theirs = other.filter.start(episode.measurement)
    rng = numpy.random.default_rng(0)
    for row in rows:
        episode = model.measure(episode, row)
        measurement = episode.measurement
        theirs = other.filter.predict(theirs, measurement)
        shown = other.observe(episode._replace(truth=None, filter=theirs))
        assert numpy.array_equal(model.observe(episode), shown)
        action = rng.uniform(-1.0, 1.0, (3, 8))
        episode, theirs = model.act(episode, action), other.filter.act(theirs, measurement, action)
        assert numpy.array_equal(model.mean(episode), other.filter.mean(theirs))
        assert numpy.array_equal(model.covariance(episode), other.filter.covariance(theirs))


def test_other_emitter_is_heard_as_often_as_stated():
    model = make("crowded", radar_bearing_sigma=0.01, esm_bearing_sigma=0.01)
    *_, (_, _, state) = roll(model, draw(model, 500, 9))
    refused = state.filter.refused_counts.sum(axis=0).mean()
    # 31 or so looks, half at least 2 degrees off a gate of 0.02, a tenth of the others refused by chance.
    looks = state.measurement.scan[0] // model.task.parameters.esm_period + 1
    assert refused / looks == pytest.approx(0.5 + 0.05, abs=4.0 * 0.5 / math.sqrt(500 * looks))
    assert (state.truth.other_class != state.truth.target_class).all()


def test_class_changes_once_within_its_limits():
    model = make("class-change")
    classes = numpy.stack([m.truth.target_class for m, _, _ in roll(model, draw(model, 400, 10))])
    changes = numpy.diff(classes, axis=0) != 0
    assert (changes.sum(axis=0) == 1).all()
    scans = changes.argmax(axis=0) + 2
    assert scans.min() >= 30
    assert scans.max() <= 90
    assert scans.std() == pytest.approx(60 / math.sqrt(12), rel=0.1)


def test_random_targets_are_silent_crowded_or_change_or_none_of_it():
    model, N = make("random"), 8000
    uniforms, normals, _ = draw(model, N, 14)
    truth = model.begin(uniforms, normals).truth
    four = 4.0 * math.sqrt(0.25 / N)
    calm = truth.second_emitter == 0.0
    assert abs(calm.mean() - 1 / 6) < four
    changes = truth.change_scan <= model.task.horizon
    assert not changes[calm].any()
    assert abs(changes[~calm].mean() - 1 / 3) < four
    assert truth.change_scan[changes].min() >= 10
    assert truth.change_scan[changes].max() <= 110
    share = truth.silence_end / (truth.silence_start + truth.silence_end)
    assert abs(truth.radiating.mean() - share.mean()) < four
    for drawn, low, high in (
        (truth.silence_start, 0.0, 0.5),
        (truth.silence_end, 0.05, 1.0),
        (truth.second_emitter[~calm], 0.0, 0.6),
    ):
        assert low <= drawn.min() < low + 0.01
        assert high - 0.01 < drawn.max() <= high
        assert drawn.mean() == pytest.approx(
            0.5 * (low + high), abs=4.0 * (high - low) / math.sqrt(12 * drawn.size)
        )


def test_glint_is_as_frequent_and_as_large_as_stated():
    model = make("glint", horizon=20)
    uniforms, normals, rows = draw(model, 1000, 15)
    state, factors = model.begin(uniforms, normals), []
    for row in rows:
        state = model.measure(state, row)
        error = state.measurement.radar - state.truth.motion[:2]
        factor = error / (numpy.array([[3000.0], [20.0]]) * row[3:5])
        # The error is what is left of a range of 1e5 m; normal numbers near zero magnify its rounding.
        sure = (numpy.abs(row[3:5]) > 1e-3).all(axis=0)
        assert factor[0, sure] == pytest.approx(factor[1, sure], rel=1e-6)
        factors.append(factor[0, sure].round(6))
    factors = numpy.concatenate(factors)
    assert set(factors.tolist()) == {1.0, 5.0}
    assert abs((factors == 5.0).mean() - 0.1) < 4.0 * math.sqrt(0.09 / factors.size)


def test_silent_targets_radiate_in_bursts():
    model = make("silent")
    *_, (_, _, state) = roll(model, draw(model, 1000, 13))
    looks = state.measurement.scan[0] // model.task.parameters.esm_period + 1
    heard = (state.filter.used_counts + state.filter.refused_counts).sum(axis=0).mean() / looks
    assert heard == pytest.approx(0.08 / 0.48, abs=0.02)


@pytest.mark.parametrize(
    ("keywords", "reason"),
    [
        ({"composition": ((0.5, 0.5, 0.5, 0.0),) * 3}, r"composition\[0\] must sum to 1"),
        ({"class_transition": ((1.0, 0.0), (0.0, 1.0))}, "class_transition must have 3 rows"),
        ({"association_error": 1.0}, "association_error must be .* below 1"),
        ({"second_emitter_probability": (0.0, 1.5)}, r"second_emitter_probability\[1\] must be .* at most 1"),
        ({"silence_start": (0.0, 0.1), "silence_end": (0.0, 0.1)}, "must not both be 0"),
        ({"acceleration_sigma": (1.0, 2.0)}, "acceleration_sigma must be 3 numbers"),
    ],
)
def test_bad_parameters_are_refused_with_the_reason(keywords, reason):
    with pytest.raises(ValueError, match=reason):
        TASK.Parameters(**keywords)


def test_causes_are_read_from_the_context():
    context = {
        "target_class": [0, 2, 2],
        "change_scan": [40, 10, -1],
        "radiating": [1, 0, 1],
        "second_emitter": [0, 0, 0.1],
    }
    moment = Moment(
        numpy,
        {name: numpy.array(values, dtype=float) for name, values in context.items()},
        numpy.full((3, 3), 6e4),
        SimpleNamespace(scan=numpy.array([39.0, 29.0, 29.0])),
        None,
        None,
    )
    causes = {cause.name: cause.holds for cause in causes_of(("S0", "S1", "S2"))}
    for name, expected in (
        ("class S2", [False, True, True]),
        ("class change", [False, True, False]),
        ("silence", [False, True, False]),
        ("second emitter", [False, False, True]),
    ):
        assert causes[name](moment).tolist() == expected, name


def test_accelerations_of_a_picture_reach_two_deviations_of_the_class_that_is_flown():
    model = make()
    uniforms, normals, _ = draw(model, 8, 0)
    episode = model.begin(uniforms, normals)
    picture = RadarEsmTrackingPicture(model)
    for target_class, sigma in enumerate(model.task.parameters.acceleration_sigma):
        truth = episode.truth._replace(
            target_class=numpy.full(8, target_class), change_scan=numpy.full(8, model.task.horizon + 1)
        )
        picture.begin(episode._replace(truth=truth))
        assert picture.height == max(15.0, 2.0 * sigma)
        assert picture.change is None
