"""The torch backend: the same episodes as NumPy, differentiable, and clear about what is missing."""

import subprocess
import sys

import gymnasium
import numpy
import pytest
from models import KINDS, make_model, short_episodes
from rounding import assert_same, flown_side_by_side

from filtergym.envs.engine.catalogue import catalogue
from filtergym.envs.engine.reward import compressed_cost
from filtergym.envs.interface.vector_environment import TaskVectorEnv

torch = pytest.importorskip("torch")
xp = pytest.importorskip("array_api_compat.torch")

DECISIONS = 5
LANES = 5

CONTROLS = [(id, control) for id, task in catalogue().items() for control in task.controls]
TIGHTLY = [cell for cell in CONTROLS if "Tightly" in cell[0] and cell[1] != "gain"]
"""Of which a step takes longest."""
CONTINUOUS = {
    id: control
    for id, control in reversed(CONTROLS)
    if (id, control) not in TIGHTLY and isinstance(make_model(id, control).action_space, gymnasium.spaces.Box)
}
"""A control of each environment whose action is a box."""
MODES = [mode.value for mode in gymnasium.vector.AutoresetMode]


DEVICES = ["cpu", *(["cuda"] if torch.cuda.is_available() else [])]


def on_torch(id, device="cpu", **keywords):
    return gymnasium.make_vec(id, backend="torch", device=device, **{"num_envs": LANES, **keywords})


def compare(fly, id, device="cpu", **keywords):
    """What ``fly`` finds on torch and on NumPy, and a function that finds it there with roundings moved.

    ``fly`` is given an environment and what makes tensors, or leaves arrays as they are.
    """

    def make_reference():
        return gymnasium.make_vec(id, backend="numpy", **{"num_envs": LANES, **keywords})

    def tensor(array):
        return torch.tensor(array, device=device)

    convert = {"torch": tensor, "numpy": lambda array: array}
    return flown_side_by_side(
        lambda env: fly(env, convert[env.unwrapped.backend]),
        lambda: on_torch(id, device, **keywords),
        make_reference,
    )


def sampled(env):
    """Random actions in float64: float32 arithmetic would hide behind its own rounding of 1e-7."""
    action = env.action_space.sample()
    return action.astype(float) if action.dtype.kind == "f" else action


def assert_close(runs, name=""):
    """Tensors are the arrays of the reference; the largest of its kind counts for all."""
    found, expected, moved = runs
    assert len(found) == len(expected)
    for i, (tensor, reference) in enumerate(zip(found, expected, strict=True)):
        assert isinstance(tensor, torch.Tensor)

        def others(i=i):
            return [other[i] for other in moved()]

        lanes = tuple(range(numpy.ndim(reference)))
        assert_same(tensor.detach().cpu().numpy(), reference, others, name, lanes=lanes)


def part(runs, name):
    """Of what was found by name that of one name, as :func:`assert_close` takes it."""
    found, expected, moved = runs
    return found[name], expected[name], lambda: [other[name] for other in moved()]


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize(
    ("id", "control"),
    [pytest.param(*cell, marks=[pytest.mark.slow] if cell in TIGHTLY else []) for cell in CONTROLS],
)
def test_torch_equals_numpy(id, control, device):
    def fly(env, convert):
        env.action_space.seed(1)
        found = {"observation": [env.reset(seed=11)[0]], "reward": [], "masks": []}
        for _ in range(DECISIONS):
            observation, reward, *masks, info = env.step(convert(sampled(env)))
            assert reward.shape == (LANES,)
            found["observation"].append(observation)
            found["reward"].append(reward)
            found["masks"] += masks
            for name in sorted(info):
                found.setdefault(name, []).append(info[name])
        return found

    runs = compare(fly, id, device, detailed_info=True, control=control, **short_episodes(id))
    found, expected, _ = runs
    assert found["observation"][0].dtype == torch.float64
    assert all(shown.device.type == device for shown in found["observation"])
    for mask, values in zip(found.pop("masks"), expected.pop("masks"), strict=True):
        assert mask.dtype == torch.bool
        assert mask.device.type == device
        assert (mask.cpu().numpy() == values).all()
    for name in expected:
        assert_close(part(runs, name), name)


@pytest.mark.parametrize(("id", "mode"), list(zip(KINDS, MODES, strict=True)))
def test_autoreset_equals_numpy(id, mode):
    last = 2
    restarted = numpy.array([True, False, True, False, True])

    def fly(env, convert):
        env.action_space.seed(3)
        shown, ended, details = [env.reset(seed=7)[0]], [], []
        for _ in range(3 * last):
            observation, reward, _, truncated, info = env.step(convert(sampled(env)))
            shown += [observation, reward]
            ended.append(numpy.asarray(truncated))
            if mode == "SameStep" and truncated.any():
                finished = numpy.asarray(info["_final_obs"])
                details.append((finished.tolist(), set(info["final_info"])))
                # Arrays of objects, one row for each lane that ended, on NumPy.
                final = info["final_obs"][info["_final_obs"]]
                shown.append(final if isinstance(final, torch.Tensor) else numpy.stack(final))
            if mode == "Disabled" and truncated.any():
                with pytest.raises(gymnasium.error.ResetNeeded, match="reset_mask"):
                    env.step(convert(sampled(env)))
                # In two parts, so that a mask that is a tensor meets lanes that must not be disturbed.
                shown += [
                    env.reset(options={"reset_mask": convert(lanes)})[0] for lanes in (restarted, ~restarted)
                ]
        assert sum(mask.sum() for mask in ended) >= 2 * LANES
        return {"shown": shown, "ended": ended, "details": details}

    keywords = {"max_episode_steps": last, **short_episodes(id)}
    runs = compare(fly, id, autoreset_mode=mode, detailed_info=True, **keywords)
    for name in ("ended", "details"):
        numpy.testing.assert_equal(runs[0][name], runs[1][name])
    assert_close(part(runs, "shown"), mode)


@pytest.mark.parametrize("id", KINDS)
def test_actions_may_be_arrays_lists_or_whole_numbers(id):
    def paid(convert):
        env = on_torch(id)
        env.action_space.seed(4)
        env.reset(seed=3)
        action = sampled(env)
        return env.step(convert(numpy.round(action) if action.dtype.kind == "f" else action))[1]

    first = paid(torch.tensor)
    for convert in (lambda a: a, lambda a: a.tolist(), lambda a: torch.tensor(a.astype(numpy.int64))):
        assert torch.equal(paid(convert), first)


@pytest.mark.parametrize(("id", "control"), CONTINUOUS.items())
def test_gradient_of_an_episode_equals_finite_differences(id, control):
    """Loss: mean compressed cost of a short episode on fixed noise, through bank, mixing and update.

    Central differences with step h have an error of h^2 times the third derivative plus rounding over h:
    1e-5 balances them near 1e-10 of the loss, and 1e-5 of the largest gradient leaves room for curvature.
    A pseudorange of 2.5e7 m is rounded to 4e-9 m: there the balance lies at 1e-4.
    """
    horizon, lanes, step = 6, 8, 1e-4 if id == "filtergym/TightlyCoupledNavigation-v0" else 1e-5
    model = make_model(id, control, backend="torch")
    generator = numpy.random.default_rng(0)
    noise = model.task.noise

    uniforms = model.task.constant(generator.random((noise.uniforms, lanes)))
    normals = model.task.constant(generator.standard_normal((noise.initial_normals, lanes)))
    rows = model.task.constant(
        numpy.concatenate(
            [
                generator.standard_normal((horizon + 1, noise.normals, lanes)),
                generator.random((horizon + 1, noise.row_uniforms, lanes)),
            ],
            axis=1,
        )
    )
    space = model.action_space
    low, high = space.low[:, None] + 0.3, space.high[:, None] - 0.3  # away from where clipping has a kink
    actions = torch.tensor(
        generator.uniform(low, high, (horizon, *low.shape[:1], lanes)),
        dtype=torch.float64,
        requires_grad=True,
    )

    def loss(actions):
        state = model.measure(model.begin(uniforms, normals), rows[0])
        total = 0.0
        for k in range(horizon):
            state = model.act(state, actions[k])
            total = total + compressed_cost(model, state)
            state = model.measure(state, rows[k + 1])
        return total.mean()

    (gradient,) = torch.autograd.grad(loss(actions), actions)
    largest = gradient.abs().max()
    assert largest > 0.0
    with torch.no_grad():
        for _ in range(3):
            where = tuple(int(generator.integers(n)) for n in actions.shape)
            moved = torch.zeros_like(actions)
            moved[where] = step
            slope = (loss(actions + moved) - loss(actions - moved)) / (2.0 * step)
            assert abs(slope - gradient[where]) <= 1e-5 * largest, where


def test_gradient_through_the_vector_environment_crosses_an_autoreset():
    """What comes back to the caller is attached to the actions, also while other episodes start."""
    # Of the paper's scenario no scan misses the target: an action on one that does changes nothing.
    env = on_torch(
        "filtergym/ManeuveringTarget-v0",
        control="gain",
        scenario="paper",
        max_episode_steps=3,
        autoreset_mode="SameStep",
    )
    env.reset(seed=2)
    actions = torch.zeros((6, LANES, 1), dtype=torch.float64, requires_grad=True)
    rewards = torch.stack([env.step(action)[1] for action in actions])
    (gradient,) = torch.autograd.grad(rewards[:3].sum(), actions, retain_graph=True)
    assert torch.isfinite(gradient).all()
    assert (gradient[:3] != 0.0).all()
    # An episode's reward owes nothing to the actions of the episode before it.
    (gradient,) = torch.autograd.grad(rewards[3:].sum(), actions)
    assert (gradient[:3] == 0.0).all()
    assert (gradient[3:] != 0.0).all()


@pytest.mark.parametrize(
    ("control", "action", "message"),
    [
        ("gain", torch.full((LANES, 1), float("nan")), "expected finite actions of shape"),
        ("gain", torch.zeros(LANES + 1, 1), r"got torch.float32 of shape \(6, 1\)"),
        ("gain", torch.zeros(LANES, 1, dtype=torch.bool), "got torch.bool"),
        ("mode", torch.zeros(LANES), "expected integer actions from 0 to 1"),
        ("mode", torch.full((LANES,), 2), "expected integer actions from 0 to 1"),
        ("mode", torch.zeros(LANES, dtype=torch.bool), "expected integer actions from 0 to 1"),
    ],
)
def test_wrong_tensors_are_refused(control, action, message):
    for backend in ("auto", "torch"):
        env = gymnasium.make_vec(
            "filtergym/ManeuveringTarget-v0", num_envs=LANES, control=control, backend=backend
        )
        env.reset(seed=0)
        with pytest.raises(ValueError, match=message):
            env.step(action)


@pytest.mark.parametrize(
    ("keywords", "message"),
    [
        ({"backend": "pytorch"}, "unknown backend 'pytorch': did you mean 'torch'"),
        ({"backend": "torch", "device": "gpu"}, "device 'gpu' cannot be used"),
        ({"backend": "torch", "device": "cuda:99"}, "device 'cuda:99' cannot be used"),
        ({"backend": "numpy", "device": "cuda"}, "works on the CPU only"),
    ],
)
def test_wrong_backends_and_devices_are_refused(keywords, message):
    with pytest.raises(ValueError, match=message) as caught:
        TaskVectorEnv("filtergym/ManeuveringTarget-v0", 2, **keywords)
    assert "\n" not in str(caught.value)


def test_torch_is_imported_only_when_asked_for_and_missed_in_one_sentence():
    program = """
import sys
import gymnasium, filtergym
env = gymnasium.make_vec("filtergym/ManeuveringTarget-v0", num_envs=2)
env.reset(seed=0); env.step(env.action_space.sample())
assert "torch" not in sys.modules
sys.modules["torch"] = None   # as if it were not installed
try:
    gymnasium.make_vec("filtergym/ManeuveringTarget-v0", num_envs=2, backend="torch")
except ImportError as error:
    print(error)
"""
    result = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert result.stdout.strip().endswith("pip install 'filtergym[agents]'")
