"""Whose emitter was heard, against sums over all histories; the exact-Bayes filter against Bayes' rule written out."""

import itertools
import math

import numpy
import pytest
from models import make_model

from filtergym import evaluate
from filtergym.baselines.radar_esm_tracking.references import Ideal
from filtergym.envs.radar_esm_tracking.exact_bayes import TRAINING, VAGUE, ExactBayes
from filtergym.evaluation.running.rollout import rollout
from filtergym.evaluation.running.seeds import episode_seeds
from filtergym.filters import class_fusion, emitter_association

ID = "filtergym/RadarEsmTracking-v0"
CONFUSION = numpy.array([[0.7, 0.2, 0.1], [0.1, 0.6, 0.3], [0.25, 0.15, 0.6]])
RATES = [(0.3, 0.2, 0.6, 0.5), (0.1, 0.5, 0.3, 0.3), (0.0, 0.0, 1.0, 0.2)]


def normal(x, sigma):
    return math.exp(-0.5 * (x / sigma) ** 2)


def test_the_table_is_the_sum_over_all_histories_of_silence_and_source():
    sigma, looks = 3.0, [(0, 1.0), (3, 0.0), (2, -7.0), (1, 2.0)]
    grid = emitter_association.surroundings(3, (2.0, 12.0), 2, RATES)
    table = emitter_association.start_table(grid, 3) * numpy.ones(1)
    one = numpy.ones(1, bool)
    for k, (decision, apart) in enumerate(looks):
        if k:
            table = emitter_association.predict_silence(table, grid, one)
        table = table * emitter_association.look_likelihood(
            grid,
            CONFUSION,
            CONFUSION,
            emitter_association.Look(one, numpy.array([decision]), numpy.array([apart])),
            sigma,
        )
    for j, v in itertools.product(range(3), range(len(grid.other_type))):
        i, delta, q, f, g, weight = (float(part.ravel()[v]) for part in grid)
        total = numpy.zeros(2)
        # Who radiates at each look, and whether the second emitter is heard.
        for radiates in itertools.product((0, 1), repeat=4):
            for other in itertools.product((False, True), repeat=4):
                P = weight * (g if radiates[0] else f) / (f + g)
                for before, now in itertools.pairwise(radiates):
                    on = (1.0 - f) if before else g
                    P *= on if now else 1.0 - on
                for (decision, apart), r, is_other in zip(looks, radiates, other, strict=True):
                    P *= q if is_other else 1.0 - q
                    if is_other and decision < 3:
                        P *= CONFUSION[int(i), decision] * normal(apart + delta, sigma)
                    elif not is_other and r and decision < 3:
                        P *= CONFUSION[j, decision] * normal(apart, sigma)
                    elif is_other or r or decision < 3:
                        P = 0.0
                total[radiates[-1]] += P
        # Sums of 256 products in another order.
        assert table[j, :, v, 0] == pytest.approx(total, rel=1e-12, abs=1e-18)


def test_without_a_look_nothing_changes():
    grid = emitter_association.surroundings(3, (2.0, 12.0), 2, RATES)
    table = emitter_association.start_table(grid, 3) * numpy.ones(2)
    none = numpy.zeros(2, bool)
    look = emitter_association.Look(none, numpy.array([3, 3]), numpy.zeros(2))
    factor = emitter_association.look_likelihood(grid, CONFUSION, CONFUSION, look, 3.0)
    assert (factor == 1.0).all()
    assert (emitter_association.predict_silence(table, grid, none) == table).all()
    assert table[0].sum() == pytest.approx(2 * 3, rel=1e-12)  # two lanes, three types of the second emitter


def test_coloured_errors_are_added_and_taken_away():
    """Moments of the augmented state by the plain one, after three scans without measurements."""
    task = make_model(ID).task
    models, start = task.design_models(task.parameters)
    augmented, P = class_fusion.add_coloured_errors(models, start, 0.25, 0.9)
    for s in range(3):
        plain, whole, mean = start[..., s], P[..., s], numpy.arange(5.0)
        x, e = numpy.array([0.0 - 3.0, 1.0 - 4.0, 2.0]), mean[3:]
        for _ in range(3):
            plain = models.Phi[..., s] @ plain @ models.Phi[..., s].T + models.Q[..., s]
            whole = augmented.Phi[..., s] @ whole @ augmented.Phi[..., s].T + augmented.Q[..., s]
            mean, x, e = augmented.Phi[..., s] @ mean, models.Phi[..., s] @ x, 0.9 * e
        assert mean[:2] == pytest.approx(x[:2] + e, rel=1e-12)
        found, covariance = class_fusion.remove_coloured_errors(mean[:, None], whole[..., None])
        assert found[:, 0] == pytest.approx(x, rel=1e-12)
        # The coloured errors stay stationary; at the start the state holds them, and position their propagation.
        assert numpy.diagonal(whole)[3:] == pytest.approx(0.25 * numpy.diagonal(models.R), rel=1e-12)
        assert covariance[2, 2, 0] == pytest.approx(plain[2, 2], rel=1e-12)


# --- the filter


def flown(make, scenario, episodes, **keywords):
    """Initial, measurements and answers of an estimator in NumPy."""
    kept = []

    class Kept(make):
        def start(self, initial):
            kept.append(initial)
            return super().start(initial)

        def update(self, state, given):
            found = super().update(state, given)
            kept.append((given.measurement, found))
            return found

    model = make_model(ID, None, scenario, **keywords)
    estimator = Kept(model.task)
    for _ in rollout(model, estimator, episode_seeds("validation", 3, episodes)):
        pass
    return model, estimator, kept[0], kept[1:]


def bayes_written_out(task, found, prior, initial, steps, lane):
    """Mean of the state after every scan, of a target of constant class: each class, type, surroundings alone."""
    p = task.parameters
    models, start = task.design_models(p)
    composition, recognition = numpy.array(p.composition), numpy.array(p.recognition)
    states = [(initial.mean[:, lane], start[..., s]) for s in range(3)]
    radar = numpy.ones(3)
    tables = {}
    grid = found.grid
    for v in range(len(grid.other_type)):
        i, _, _, f, g, weight = (float(part.ravel()[v]) for part in grid)
        for s, j in itertools.product(range(3), range(4)):
            others = [composition[c, int(i)] for c in range(3) if c != s]
            share = composition[s, j] * sum(others) / 2.0 * weight / 3.0
            tables[s, j, v] = share * numpy.array([f, g]) / (f + g)
    sigma = math.hypot(p.radar_bearing_sigma, p.esm_bearing_sigma)

    def listen(measurement, first):
        if not measurement.looked[lane]:
            return
        rho, apart = int(measurement.decision[lane]), float(measurement.bearing_difference[lane])
        for (s, j, v), (off, on) in tables.items():
            i, delta, q, f, g, _ = (float(part.ravel()[v]) for part in grid)
            if not first:
                off, on = (1.0 - g) * off + f * on, g * off + (1.0 - f) * on
            if rho < 4:
                other = q * recognition[int(i), rho] * normal(apart + delta, sigma)
                own = (1.0 - q) * recognition[j, rho] * normal(apart, sigma)
                tables[s, j, v] = numpy.array([other * off, (other + own) * on])
            else:
                tables[s, j, v] = numpy.array([(1.0 - q) * off, 0.0])

    listen(initial.first, True)
    means = []
    for measurement, _ in steps:
        z = measurement.radar[:, lane]
        for s in range(3):
            x, P = states[s]
            Phi = models.Phi[..., s]
            x, P = Phi @ x, Phi @ P @ Phi.T + models.Q[..., s]
            S = models.H @ P @ models.H.T + models.R
            nu = z - models.H @ x
            K = P @ models.H.T @ numpy.linalg.inv(S)
            radar[s] *= math.exp(-0.5 * nu @ numpy.linalg.solve(S, nu)) / math.sqrt(numpy.linalg.det(S))
            states[s] = x + K @ nu, P - K @ models.H @ P
        radar /= radar.max()
        listen(measurement, False)
        esm = [sum(T.sum() for (c, _, _), T in tables.items() if c == s) for s in range(3)]
        weights = radar * esm
        means.append(sum(w * x for w, (x, _) in zip(weights / weights.sum(), states, strict=True)))
    return numpy.array(means)


def test_with_a_constant_class_the_filter_is_bayes_written_out():
    class Constant(ExactBayes):
        def __init__(self, task):
            super().__init__(task, TRAINING, change_rate=0.0, coloured=0.0, sides=1)

    model, found, initial, steps = flown(
        Constant, "crowded", 3, silence_start=(0.2, 0.2), silence_end=(0.5, 0.5), horizon=40
    )
    for lane in range(3):
        expected = bayes_written_out(model.task, found, TRAINING, initial, steps, lane)
        mean = numpy.array([answer[0][:, lane] for _, answer in steps])
        # Hypotheses of a change keep the least probability, 1e-30; 40 scans of rounding.
        assert mean == pytest.approx(expected, rel=1e-8, abs=1e-6)


@pytest.mark.parametrize("prior", [TRAINING, VAGUE])
def test_probabilities_sum_to_one_and_covariances_are_positive(prior):
    class Watched(ExactBayes):
        def __init__(self, task):
            super().__init__(task, prior)

    _, _, _, steps = flown(Watched, "random", 16, horizon=60)
    for _, (_, covariance, memory, _) in steps:
        assert memory.weights.sum(axis=(0, 1)) == pytest.approx(numpy.ones(16), rel=1e-12)
        assert memory.first.sum(axis=(0, 1, 2)) == pytest.approx(numpy.ones(16), rel=1e-12)
        assert numpy.linalg.eigvalsh(numpy.moveaxis(covariance, -1, 0)).min() > 0.0


def test_a_change_moves_the_weight_to_its_class():
    """From the calmest class to the most agile one: the filter is sure soon after the change and was not before."""

    class Watched(ExactBayes):
        def __init__(self, task):
            super().__init__(task, TRAINING)

    model = make_model(ID, None, "class-change", true_class="S0", class_change=(20.0, 20.0))
    weights, classes = [], []

    class Kept(Watched):
        def update(self, state, given):
            found = super().update(state, given)
            weights.append(found.tracks.weights.sum(axis=1))
            return found

    def target_class(model, episode):
        classes.append(episode.truth.target_class)

    for _ in rollout(model, Kept(model.task), episode_seeds("validation", 5, 60), target_class):
        pass
    weights, classes = numpy.array(weights)[..., :60], numpy.array(classes)[..., :60]
    to_agile = classes[-1] == 2
    assert to_agile.sum() > 15
    agile = weights[:, 2, to_agile].mean(axis=1)
    # Scans 30 and 80: 5 s before the change and 20 s after it.
    assert agile[29] < 0.2
    assert agile[79] > 0.75  # silences leave the share of targets that never change


def test_ideal_is_consistent_where_errors_are_coloured_correlated_and_glint():
    """Mean NEES over the dimension of a reference that knows all of it."""
    for scenario, keywords in (
        ("random", {"radar_coloured": (0.5, 0.5), "radar_correlation": (-0.6, -0.6), "undisturbed": 0.0}),
        ("glint", {"radar_correlation": (0.7, 0.7)}),
    ):
        dataset = evaluate(ID, {"ideal": Ideal}, scenario, 400, seed=5, **keywords)
        nees = dataset["nees"].values[0].mean(axis=1) / 3.0
        assert abs(nees.mean() - 1.0) < 4.0 * nees.std() / math.sqrt(400), scenario
