"""The fully learned estimator student: its equations, its symmetry, its teacher and its training."""

import numpy as np
import pytest
from models import Asked, make_model
from test_kalman_net import AIRCRAFT, RADAR, episodes, network

from filtergym.agents.learned_estimator import EstimatorMaker
from filtergym.agents.learned_policy import LearnedPolicy
from filtergym.baselines.problem import problem_of
from filtergym.envs.contract.draws import Draws
from filtergym.envs.contract.filter import Initial
from filtergym.envs.contract.model import Episode
from filtergym.envs.engine import reward
from filtergym.envs.maneuvering_target import student_bank as student
from filtergym.envs.maneuvering_target.kalman_net import LEAST_SPEED, STANDING
from filtergym.envs.maneuvering_target.student import ACCELERATION_REACH

NAME = "student"


def test_weights_for_a_radar_follow_the_description():
    """The equations at the head of the two modules, one lane after the other, with matrices of NumPy."""
    model, initial, measurements = episodes(RADAR, 16, 3, NAME, undisturbed=0.0)
    rng, bank = np.random.default_rng(0), model.filter
    state, before_motion = bank.start(initial), np.zeros((2, 16))
    logits = np.log([1.0, 1.0, 1.0 / 3.0, 1.0 / 3.0])
    for measurement in measurements:
        before, predicted = state, bank.predict(state, measurement)
        action = rng.uniform(-1.2, 1.2, (bank.action_space.shape[0], 16))
        state = bank.act(predicted, measurement, action)
        assert len(action) == 8 + 4 + 4 + 6 + 2
        for i, a in enumerate(np.clip(action, -1.0, 1.0).T):
            T, v = measurement.interval[i], before.mean[2:, i]
            along, across = ACCELERATION_REACH * before_motion[:, i] / np.hypot(np.hypot(*v), LEAST_SPEED)
            # A turn at constant rate, integrated by its closed form about the centre of the circle.
            heading = np.arctan2(v[1], v[0])
            moved = (
                np.hypot(*v)
                / across
                * np.array(
                    [
                        np.sin(heading + across * T) - np.sin(heading),
                        np.cos(heading) - np.cos(heading + across * T),
                    ]
                )
                if across
                else v * T
            )
            turned = np.hypot(*v) * np.array([np.cos(heading + across * T), np.sin(heading + across * T)])
            x = np.append(before.mean[:2, i] + (1.0 + 0.5 * along * T) * moved, (1.0 + along * T) * turned)
            c, s = x[2:] / np.hypot(np.hypot(*x[2:]), STANDING)
            turn = np.array([[c, s], [-s, c]])
            U = np.kron(np.eye(2), turn)
            sigma = np.sqrt(np.diag(turn @ np.diag(measurement.variance[:, i]) @ turn.T))
            unit = np.append(sigma, sigma / model.task.parameters.sampling_interval)
            nu = measurement.available[i] * turn @ (measurement.position[:, i] - x[:2]) / sigma
            G = 1.0 / (1.0 + np.exp(-logits - student.GAIN_REACH * a[[0, 3, 4, 7]]))
            coupled = np.array(
                [nu[0] + a[1] * nu[1], nu[1] + a[2] * nu[0], nu[0] + a[5] * nu[1], nu[1] + a[6] * nu[0]]
            )
            mean = x + U.T @ (unit * G * (coupled + student.OFFSET_REACH * a[8:12]))
            L = np.diag(student.DEVIATION_RANGE ** a[12:16])
            L[np.tril_indices(4, -1)] = student.COUPLING_REACH * a[16:22]
            L[np.tril_indices(4, -1)] *= np.diag(L)[np.tril_indices(4, -1)[0]]
            factor = U.T @ np.diag(unit) @ L
            P = factor @ factor.T
            np.testing.assert_allclose(state.mean[:, i], mean, rtol=1e-9, atol=1e-7)
            scale = np.sqrt(np.outer(np.diag(P), np.diag(P)))
            np.testing.assert_allclose(state.covariance[:, :, i] / scale, P / scale, atol=1e-9)
            before_motion[:, i] = G[2:] * a[22:]
            np.testing.assert_allclose(state.motion[:, i], before_motion[:, i], rtol=1e-12)


def tame(model):
    """A network whose answers are small: one that loses the track would let rounding grow."""
    arrays = network(model, "random").arrays
    return LearnedPolicy(model, arrays | {"weight_0": 0.2 * arrays["weight_0"]}, "tanh")


def turned_about(angle, centre, initial, measurements):
    """The same flights seen by somebody who has turned and moved; all errors are as large in all directions."""
    c, s = np.cos(angle), np.sin(angle)
    turn = np.array([[c, -s], [s, c]])
    both = np.kron(np.eye(2), turn)
    there = np.append(centre, [0.0, 0.0])[:, None]
    covariance = np.einsum("ij,jkn,lk->iln", both, initial.covariance, both)
    others = [m._replace(position=turn @ m.position + np.array(centre)[:, None]) for m in measurements]
    return both, there, Initial(both @ initial.mean + there, covariance), others


@pytest.mark.parametrize("angle", [0.3, 2.0])
def test_of_a_radar_a_turned_and_moved_problem_has_turned_and_moved_estimates(angle):
    model, initial, measurements = episodes(RADAR, 8, 40, NAME)
    ones = np.ones((2, 8))
    measurements = [m._replace(variance=1e4 * ones, available=ones[0]) for m in measurements]
    both, there, *other = turned_about(angle, (3e4, -2e4), initial, measurements)
    # Where nothing was received the position is zero, which would turn with the others: here all is.
    estimator, found = Asked(EstimatorMaker(NAME, tame)(model.task)), []
    for start, seen in ((initial, measurements), other):
        memory, track = estimator.start(start, 8), []
        for measurement in seen:
            mean, covariance, memory, _ = estimator.update(memory, measurement)
            track.append((mean, covariance))
        found.append(track)
    for (mean, P), (turned_mean, turned_P) in zip(*found, strict=True):
        # Positions of 1e5 m, to some digits less than sixteen after forty scans.
        np.testing.assert_allclose(turned_mean, both @ mean + there, rtol=1e-9, atol=1e-5)
        expected = np.einsum("ij,jkn,lk->iln", both, P, both)
        np.testing.assert_allclose(turned_P, expected, rtol=1e-7, atol=1e-7 * abs(expected).max())
    assert abs(found[0][-1][0] - found[1][-1][0]).max() > 1e3


def test_a_student_in_c_answers_as_on_numpy():
    pytest.importorskip("llvmlite")
    from test_exports_c import FLAGS, compile_and_test, compiler, mean_rows, run_filter, writer_of

    writer, given = writer_of("ManeuveringTarget", EstimatorMaker(NAME, tame))
    assert given.largest_difference(run_filter(writer.traced, given)[:, mean_rows(writer.traced)]) < 1e-9
    compile_and_test(writer, given, compiler(), FLAGS)


def test_the_value_of_a_teacher_is_the_expected_reward(monkeypatch):
    """Against the mean over truths that are drawn from the teacher's estimate; differences, for the constant."""
    monkeypatch.setattr(reward, "COMPRESSED_BEYOND", 1e9)
    model, rng, draws, kind = (
        make_model(RADAR, NAME),
        np.random.default_rng(3),
        100_000,
        "cost-and-likelihood",
    )
    task, world = model.task, model.task.world
    uniforms = rng.random((task.noise.uniforms, 1))
    truth, _ = world.begin(Draws(uniforms, np), rng.normal(size=(task.noise.initial_normals, 1)))
    root = rng.normal(size=(4, 4))
    S, m = 1e4 * (root @ root.T + np.eye(4)), np.array([2e4, -1e4, 150.0, 20.0])
    expected, found = [], []
    for offset, scale in ((30.0, 1.0), (-300.0, 2.0)):
        own = rng.normal(size=(4, 4))
        P = scale * 1e4 * (own @ own.T + np.eye(4))
        true = m[:, None] + np.linalg.cholesky(S) @ rng.normal(size=(4, draws))
        x = (m + offset)[:, None]
        state = model.filter.start(Initial(x + 0.0 * true, P[..., None] + 0.0 * true[0]))
        drawn = truth._replace(position=true[:2], velocity=true[2:])
        episode = Episode(drawn, None, state)
        np.testing.assert_allclose(world.state(drawn), true)
        own_reward = reward.REWARD_FUNCTIONS[kind](model, episode)
        error = own_reward.std() / np.sqrt(draws)
        expected.append((own_reward.mean(), error))
        state = model.filter.start(Initial(x, P[..., None]))
        teacher = m[:, None], S[..., None]
        # Wherever the truth of the episode is, which the teacher's share does not look at.
        found.append(reward.teacher_reward(kind, model, Episode(truth, None, state), *teacher)[0])
    (first, error_1), (second, error_2) = expected
    assert abs((found[0] - found[1]) - (first - second)) < 5.0 * np.hypot(error_1, error_2)
    assert abs(first - second) > 20.0 * np.hypot(error_1, error_2)


def test_the_gradient_of_a_student_with_a_teacher_is_that_of_its_cost():
    """Against differences of the cost, which is that of a window of twelve scans, over the same episodes."""
    torch = pytest.importorskip("torch")
    pytest.importorskip("llvmlite")
    from filtergym.agents.bptt import NetworkPolicy
    from filtergym.agents.unrolled import Teacher, Unrolled
    from filtergym.envs.engine.rollout import TrainingObjective
    from filtergym.envs.interface.vector_environment import TaskVectorEnv

    keywords = {"control": NAME, "backend": "compiled", "autoreset_mode": "Disabled", "max_episode_steps": 12}
    env = TaskVectorEnv(RADAR, 5, **keywords)
    torch.manual_seed(0)
    policy = NetworkPolicy(len(env.model.fields), env.model.action_space, 6).double()
    teacher = Teacher(env, "kalman-imm")
    found = {}
    for share in (0.0, 0.7, 1.0):
        reward_of_it = TrainingObjective("cost-and-likelihood", share)
        unrolled = Unrolled(env, policy, 12, reward_of_it, teacher if share else None)

        def cost(unrolled=unrolled):
            env.reset(seed=3)  # and the next episodes are those that are flown
            policy.zero_grad()
            return unrolled.descend_episodes(lambda: None)

        found[share] = cost()
        if share != 0.7:  # the share between is made of both
            continue
        gradients = [parameter.grad.clone() for parameter in policy.parameters()]
        for parameter, gradient in zip(policy.parameters(), gradients, strict=True):
            place = int(gradient.abs().argmax())
            flat, step = parameter.data.view(-1), 1e-5
            before = float(flat[place])
            ends = []
            for sign in (1.0, -1.0):
                flat[place] = before + sign * step
                ends.append(cost())
            flat[place] = before
            slope = (ends[0] - ends[1]) / (2.0 * step)
            # The error of central differences, of the second order in the step.
            assert slope == pytest.approx(float(gradient.view(-1)[place]), rel=1e-4)
    assert found[0.7] == pytest.approx(0.3 * found[0.0] + 0.7 * found[1.0], rel=1e-12)
    assert found[0.0] != pytest.approx(found[1.0], rel=1e-3)


@pytest.mark.parametrize(
    ("id", "overrides", "message"),
    [
        (RADAR, {"teacher": "semi-marko"}, "unknown policy 'semi-marko': did you mean 'semi-markov'"),
        (RADAR, {"teacher": "imm"}, "a teacher is an estimator or a reference, but 'imm' is of kind policy"),
        (RADAR, {"teacher": "semi-markov", "teacher_share": 0.0}, "teacher_share must be"),
        (
            AIRCRAFT,
            {"teacher": "level-bank"},
            "cannot teach in .*: the measurements depend on its own estimates",
        ),
    ],
)
def test_who_cannot_teach_is_refused(id, overrides, message):
    pytest.importorskip("torch")
    pytest.importorskip("llvmlite")
    from filtergym.agents.bptt import Descent
    from filtergym.agents.training_run import RunOptions, new_run

    algorithm = NAME if id == RADAR else "bptt"
    run = new_run(problem_of(id), RunOptions(algorithm, envs=2, overrides=overrides))
    with pytest.raises(ValueError, match=message):
        Descent(run).episode_function()


def test_units_of_a_memory_forget_over_one_to_the_longest_number_of_decisions():
    """What is left after a decision in which nothing is shown, of a memory whose weights are zero."""
    torch = pytest.importorskip("torch")
    from filtergym.agents.bptt import NetworkPolicy

    space = make_model(RADAR, NAME).action_space
    policy = NetworkPolicy(3, space, 5, longest_memory=16.0)
    with torch.no_grad():
        for each in (policy.gru.weight_ih, policy.gru.weight_hh, policy.gru.bias_hh):
            each.zero_()
        policy.gru.bias_ih[10:] = 0.0
        left = policy.forward(torch.zeros(1, 3), torch.ones(1, 5))[1][0].numpy()
    over = np.array([1.0, 2.0, 4.0, 8.0, 16.0])
    np.testing.assert_allclose(left, over / (1.0 + over), rtol=1e-6)
    with pytest.raises(ValueError, match="longest_memory"):
        NetworkPolicy(3, space, 5, longest_memory=1.0)
