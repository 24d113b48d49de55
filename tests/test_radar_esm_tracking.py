"""RadarEsmTracking: the paper's numbers by Monte Carlo, no truth in sight, NumPy and torch alike."""

import math

import numpy
import pytest
from filtergym.envs.contract.model import Model
from filtergym.envs.radar_esm_tracking.picture import RadarEsmTrackingPicture
from filtergym.envs.radar_esm_tracking.task import TASK
from filtergym.filters import class_fusion, imm

SCENARIOS = tuple(TASK.scenarios)
LEAKY = ((0.9, 0.08, 0.02), (0.0, 0.7, 0.3), (0.25, 0.05, 0.7))


def make(scenario="paper", control="evidence", xp=numpy, **keywords) -> Model:
    keywords = {**TASK.scenarios[scenario].parameters, "decision_interval": 1, **keywords}
    parameters = TASK.Parameters(**keywords)
    return Model(TASK(parameters, xp), control)


def draw(model, N, seed):
    """Noise of an episode for N lanes: uniforms, normals, rows."""
    rng, layout = numpy.random.default_rng(seed), model.task.noise
    start = rng.random((layout.uniforms, N)), rng.standard_normal((layout.initial_normals, N))
    rows = (
        numpy.concatenate([rng.standard_normal((layout.normals, N)), rng.random((layout.row_uniforms, N))])
        for _ in range(model.task.horizon + 1)
    )
    return *start, rows


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


# --- the paper's numbers


@pytest.fixture(scope="module")
def monte_carlo():
    """Squared errors, reported variances and P(true class) of 6000 targets of each class, 120 scans."""
    results = []
    for s in range(3):
        model = make(true_class=f"S{s}")
        errors, variances, probabilities = [], [], []
        for _, _, state in roll(model, draw(model, 6000, 2008 + s)):
            covariance = model.covariance(state)
            errors.append(model.error(state) ** 2)
            variances.append(numpy.stack([covariance[i, i] for i in range(3)]))
            probabilities.append(state.filter.probabilities[s])
        results.append((numpy.stack(errors), numpy.stack(variances), numpy.stack(probabilities)))
    return results


@pytest.mark.claims
def test_errors_of_the_paper_policy(monte_carlo):
    """The table of adaptive RMSE (M = 20000), within four standard errors of the difference."""
    table = {
        (0, 1): ((9.04, 0.02), (7.06, 0.02), (6.85, 0.01)),
        (0, 2): ((2.83, 0.01), (1.33, 0.005), (1.29, 0.005)),
        (1, 1): ((11.22, 0.02), (9.91, 0.02), (9.84, 0.01)),
        (1, 2): ((6.06, 0.02), (4.17, 0.01), (4.12, 0.01)),
        (2, 1): ((13.80, 0.02), (13.19, 0.02), (13.13, 0.01)),
        (2, 2): ((13.46, 0.03), (11.75, 0.01), (11.72, 0.01)),
        **{(s, 0): ((1091.0, 4.0), (492.3, 2.0), (325.3, 1.5)) for s in range(3)},
    }
    for (s, component), row in table.items():
        for (first, last), (expected, published) in zip(((1, 20), (20, 60), (60, 120)), row, strict=True):
            means = monte_carlo[s][0][first - 1 : last, component].mean(axis=0)
            rmse = math.sqrt(means.mean())
            own = means.std() / math.sqrt(means.size) / (2.0 * rmse)
            assert abs(rmse - expected) < 4.0 * math.hypot(own, published), (s, component, first, rmse)


@pytest.mark.claims
def test_recognition_of_the_paper_policy(monte_carlo):
    table = (
        (0.747, 0.862, 0.963, 0.996, 0.999),
        (0.628, 0.738, 0.897, 0.980, 0.996),
        (0.668, 0.785, 0.917, 0.985, 0.997),
    )
    for s, row in enumerate(table):
        for seconds, expected in zip((2, 5, 10, 20, 30), row, strict=True):
            P = monte_carlo[s][2][2 * seconds - 1]
            # The published one has M = 20000; 0.0005 is its rounding.
            error = math.hypot(P.std() / math.sqrt(P.size), P.std() / math.sqrt(20000)) + 0.0005
            assert abs(P.mean() - expected) < 4.0 * error, (s, seconds, P.mean())
        first = 0.5 * ((monte_carlo[s][2] >= 0.9).argmax(axis=0) + 1)
        assert abs(numpy.median(first) - (4.0, 5.5, 4.0)[s]) <= 0.5


@pytest.mark.claims
def test_the_paper_filter_is_bayesian(monte_carlo):
    """Uniform classes, redrawn types: mean squared error over mean reported variance is 1 within 3 %."""
    squared = sum(result[0] for result in monte_carlo)
    reported = sum(result[1] for result in monte_carlo)
    for first, last in ((1, 20), (20, 60), (60, 120)):
        ratio = squared[first - 1 : last].mean(axis=(0, 2)) / reported[first - 1 : last].mean(axis=(0, 2))
        assert ratio == pytest.approx(numpy.ones(3), abs=0.03)


@pytest.mark.claims
def test_class_probabilities_are_calibrated():
    model = make(horizon=20)
    states = [state for *_, state in roll(model, draw(model, 20000, 5))]
    P = numpy.concatenate([states[k].filter.probabilities.ravel() for k in (4, 9)])
    true = numpy.concatenate(
        [(states[k].truth.target_class == numpy.arange(3)[:, None]).ravel() for k in (4, 9)]
    )
    for low in numpy.arange(0.0, 1.0, 0.1):
        chosen = (low <= P) & (low + 0.1 > P)
        # Three entries of a lane and two times share a draw: count each lane once.
        error = 0.5 / math.sqrt(chosen.sum() / 2.0)
        assert abs(true[chosen].mean() - P[chosen].mean()) < 4.0 * error


@pytest.mark.claims
def test_one_type_makes_the_printed_rule_sure_and_wrong_and_the_joint_posterior_repairs_it():
    model = make("fixed-type")
    p = model.task.parameters
    *_, (_, _, state) = roll(model, draw(model, 4000, 7))
    floor = numpy.array(p.composition)
    joint = class_fusion.constant_class_log_likelihood(
        state.filter.used_counts, numpy.log(numpy.array(p.recognition)), numpy.log(floor)
    )
    repaired = imm.softmax(state.filter.accumulated + joint)
    wrong = state.truth.target_class != numpy.arange(3)[:, None]

    def sure_and_wrong(P):
        return ((P >= 0.9) & wrong).any(axis=0).mean()

    assert sure_and_wrong(state.filter.probabilities) > 0.1
    # A posterior is wrong in at most a tenth of the runs in which it is sure at 0.9.
    assert sure_and_wrong(repaired) < 0.04


# --- the task's contract


def test_fields_and_shapes():
    for control in TASK.controls:
        model = make("random", control)
        uniforms, normals, rows = draw(model, 8, 0)
        state = model.measure(model.begin(uniforms, normals), next(rows))
        observation = model.observe(state)
        assert observation.shape == (len(model.fields), 8)
        assert len({f.name for f in model.fields}) == len(model.fields)
        assert observation.dtype == numpy.float64
        action = numpy.zeros(8, dtype=int) if control == "mode" else numpy.zeros((3, 8))
        state = model.act(state, action)
        assert model.error(state).shape == (3, 8)
        assert model.covariance(state).shape == (3, 3, 8)
        assert model.cost(state).shape == (8,)
        assert model.records(state)["mode_probability"].shape == (3, 8)


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
        numpy.testing.assert_array_equal(state.filter.believed, [[0.0] * 8, [0.0] * 8, [1.0] * 8])


def test_everyone_is_told_the_first_measurement_and_how_good_it_is():
    model = make("fixed-type", prior=(0.2, 0.3, 0.5))
    uniforms, normals, _ = draw(model, 40000, 15)
    episode = model.begin(uniforms, normals)
    told, error = episode.measurement, episode.measurement.mean - episode.truth.motion
    assert numpy.array_equal(told.mean[:2], told.first.radar)
    assert told.first.looked.all()
    assert (told.mean[2] == 0.0).all()
    # 40000 lanes: the mean of squares has a standard error of 0.7 %, more where the classes mix.
    assert (error**2).mean(axis=1) == pytest.approx(told.covariance[..., 0].diagonal(), rel=0.03)
    assert (told.covariance[..., 0] == numpy.diag(told.covariance[..., 0].diagonal())).all()


WORLDS = {
    "true_class": "S2", "emitter": "fixed", "initial_range": (1e3, 2e3), "closing_speed": (-50.0, -40.0),
    "class_change": (2.0, 3.0), "class_change_probability": 0.9, "silence_start": (0.4, 0.5), "silence_end": (0.5, 0.6),
    "second_emitter_probability": (0.8, 0.9), "second_emitter_separation": (90.0, 91.0), "glint_probability": 0.3,
    "undisturbed": 0.1,
}  # fmt: skip
"""Parameters of what is and nothing else; no filter may know them."""


@pytest.mark.parametrize("scenario", SCENARIOS)
@pytest.mark.parametrize("transition", [None, LEAKY], ids=["constant", "jumping"])
def test_nothing_but_the_measurement_reaches_the_bank(scenario, transition):
    """A bank made for another world shows and estimates the same from the same measurements."""
    more = {"horizon": 40, **({} if transition is None else {"class_transition": transition})}
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


@pytest.mark.parametrize("scenario", SCENARIOS)
def test_lanes_do_not_know_their_neighbours(scenario):
    """A lane gives the same bits in any batch, also next to lanes at other times."""
    model = make(scenario, horizon=30)
    uniforms, normals, rows = draw(model, 16, 2)
    rows = list(rows)
    wide = model.begin(uniforms, normals)
    narrow = model.begin(uniforms[:, :8], normals[:, :8])
    for row in rows[:9]:
        wide = model.act(model.measure(wide, row), numpy.zeros((3, 16)))
    # Lanes 0 to 7 start again at scan 0 beside lanes 8 to 15 at scan 9.
    fresh = model.begin(uniforms, normals)
    first = numpy.arange(16) < 8

    def merged(a, b):
        if isinstance(a, dict):
            return {name: merged(x, b[name]) for name, x in a.items()}
        if isinstance(a, tuple):
            return type(a)(*(merged(x, y) for x, y in zip(a, b, strict=True)))
        return numpy.where(first, a, b)

    wide = wide._replace(truth=merged(fresh.truth, wide.truth), filter=merged(fresh.filter, wide.filter))
    for row in rows[9:]:
        wide, narrow = model.measure(wide, row), model.measure(narrow, row[:, :8])
        assert numpy.array_equal(model.observe(wide)[:, :8], model.observe(narrow))
        wide, narrow = model.act(wide, numpy.zeros((3, 16))), model.act(narrow, numpy.zeros((3, 8)))
        assert numpy.array_equal(model.cost(wide)[:8], model.cost(narrow))


@pytest.mark.parametrize("scenario", ["paper", "crowded", "silent", "class-change"])
@pytest.mark.parametrize("transition", [None, LEAKY], ids=["constant", "jumping"])
def test_torch_plays_the_same_episode(torch, scenario, transition):
    more = {"horizon": 50, **({} if transition is None else {"class_transition": transition})}
    ours, theirs = make(scenario, **more), make(scenario, xp=torch, **more)
    uniforms, normals, rows = draw(ours, 8, 6)
    a = ours.begin(uniforms, normals)
    b = theirs.begin(torch.asarray(uniforms), torch.asarray(normals))
    rng = numpy.random.default_rng(1)
    for row in rows:
        action = rng.uniform(-1.0, 1.0, (3, 8))
        a, b = ours.measure(a, row), theirs.measure(b, torch.asarray(row))
        # Recursions of 50 scans; exp and log differ in the last digit between the libraries.
        assert theirs.observe(b).numpy() == pytest.approx(ours.observe(a), rel=1e-8, abs=1e-9)
        a, b = ours.act(a, action), theirs.act(b, torch.asarray(action))
        assert theirs.cost(b).numpy() == pytest.approx(ours.cost(a), rel=1e-8)
    assert [tuple(x.shape) for x in leaves(b)] == [x.shape for x in leaves(a)]


def test_gradient_from_cost_to_evidence(torch):
    """Derivative of the summed cost by torch against central differences."""
    model = make("random", xp=torch, horizon=6)
    uniforms, normals, rows = draw(model, 8, 8)
    rows = [torch.asarray(row) for row in rows]

    def total(action):
        state = model.begin(torch.asarray(uniforms), torch.asarray(normals))
        result = 0.0
        for row in rows:
            state = model.act(model.measure(state, row), action)
            result = result + model.cost(state).sum()
        return result

    action = torch.asarray(numpy.random.default_rng(0).uniform(-0.3, 0.3, (3, 8)))
    assert torch.autograd.gradcheck(
        total, (action.clone().requires_grad_(True),), eps=1e-6, rtol=1e-6, atol=1e-7
    )


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
    calm = (truth.silence_start == 0.0) & (truth.silence_end == 1.0) & (truth.second_emitter == 0.0)
    assert abs(calm.mean() - 1 / 6) < four
    changes = truth.change_scan <= model.task.horizon
    assert not changes[calm].any()
    assert abs(changes[~calm].mean() - 1 / 3) < four
    assert truth.change_scan[changes].min() >= 10
    assert truth.change_scan[changes].max() <= 110
    assert truth.radiating[calm].all()
    share = truth.silence_end / (truth.silence_start + truth.silence_end)
    assert abs(truth.radiating.mean() - share.mean()) < four
    for values, low, high in (
        (truth.silence_start, 0.0, 0.5),
        (truth.silence_end, 0.05, 1.0),
        (truth.second_emitter, 0.0, 0.6),
    ):
        drawn = values[~calm]
        assert low <= drawn.min() < low + 0.01
        assert high - 0.01 < drawn.max() <= high
        assert drawn.mean() == pytest.approx(
            0.5 * (low + high), abs=4.0 * (high - low) / math.sqrt(12 * drawn.size)
        )


def test_glint_is_as_frequent_and_as_large_as_stated():
    model = make("glint", horizon=60)
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
    *_, (_, _, state) = roll(model, draw(model, 2000, 13))
    looks = state.measurement.scan[0] // model.task.parameters.esm_period + 1
    heard = (state.filter.used_counts + state.filter.refused_counts).sum(axis=0).mean() / looks
    assert heard == pytest.approx(0.08 / 0.48, abs=0.015)


@pytest.mark.parametrize(
    ("keywords", "reason"),
    [
        ({"composition": ((0.5, 0.5, 0.5, 0.0),) * 3}, r"composition\[0\] must sum to 1"),
        ({"recognition": ((1.0, 0.1), (0.0, 1.0))}, r"recognition\[0\] must sum to 1"),
        ({"prior": (0.5, 0.6, -0.1)}, r"prior\[2\] must be .* got -0.1"),
        ({"class_transition": ((1.0, 0.0), (0.0, 1.0))}, "class_transition must have 3 rows"),
        ({"true_class": "S3"}, "true_class must be one of 'random', 'S0', 'S1', 'S2', got 'S3'"),
        ({"emitter": "sometimes"}, "emitter must be one of"),
        ({"association_error": 1.0}, "association_error must be .* below 1"),
        ({"second_emitter_probability": (0.0, 1.5)}, r"second_emitter_probability\[1\] must be .* at most 1"),
        ({"silence_start": (0.0, 0.1), "silence_end": (0.0, 0.1)}, "must not both be 0"),
        ({"acceleration_sigma": (1.0, 2.0)}, "acceleration_sigma must be 3 numbers"),
        ({"range_sigma": 0.0}, "range_sigma must be .* above 0"),
        ({"initial_range": (2e5, 1e5)}, "initial_range must be in ascending order"),
        ({"horizon": 0}, "horizon must be an integer of at least 1"),
        ({"decision_interval": 0}, "decision_interval must be an integer of at least 1"),
        ({"esm_period": 2.5}, "esm_period must be an integer"),
    ],
)
def test_bad_parameters_are_refused_with_the_reason(keywords, reason):
    with pytest.raises(ValueError, match=reason):
        TASK.Parameters(**keywords)


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
