"""Training with Stable-Baselines3 over the vector environment, which can be stopped and resumed.

A checkpoint contains the model with its optimiser, the normalisation, the replay buffer if there is one, the
environments in the middle of their episodes, and every random generator: a resumed run equals an uninterrupted one. It
is loaded with pickle, which can execute code and so needs ``trust``. The plain arrays beside the best model need none.
"""

import contextlib
import copy
import functools
import io
import pickle
import random
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium
import numpy
import torch
from sb3_contrib import RecurrentPPO
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.vec_env import VecNormalize

from ..envs.contract.model import Model
from ..evaluation.running.seeds import episode_seeds
from .adapter import TaskVecEnv, to_sb3
from .eager_optimiser import exclude_from_compilation, step_eagerly
from .gate import Gate, PolicyMaker, wrap_as_trained
from .learned_policy import LearnedPolicy, write_arrays
from .network_arrays import network_arrays
from .residual import policy_to_correct
from .sb3_algorithms import ALGORITHMS, SPACES
from .sb3_policy import Sb3Policy
from .training_run import TrainingRun, check_trust, save_run, schedule
from .training_session import Bookkeeping, Session, Trainee, curve_writer, interruption, make_logger


class _Trainer(BaseCallback):
    """Callback of Stable-Baselines3 that validates and saves between an update and the next rollout."""

    def __init__(self, books: Bookkeeping, progress: Callable[[int], None]) -> None:
        super().__init__()
        self.books, self.progress, self.stopping = books, progress, False

    def _on_rollout_start(self) -> None:
        self.stopping = self.stopping or self.books.safe_point(self.model.num_timesteps)

    def _on_step(self) -> bool:
        self.progress(self.model.num_timesteps)
        return not self.stopping


def training_environment(run: TrainingRun) -> TaskVecEnv:
    """Return the vector environment of a training run, made for Stable-Baselines3."""
    env: Any = gymnasium.make_vec(
        run.environment,
        num_envs=run.envs,
        autoreset_mode="SameStep",
        control=run.control,
        scenario=run.scenario,
        backend=run.backend,
        **run.hyperparameters.get("env_kwargs", {}),
    )
    run.backend = env.unwrapped.backend
    inner = env.unwrapped.model
    corrected = policy_to_correct(inner, run.residual_to) if run.residual_to else None
    gate = Gate(inner, corrected) if run.gated else None
    # A rollout is shorter than an episode: without staggering it would cover one part of the episode only.
    return to_sb3(env, staggered=True, residual_to=corrected, gate=gate)


def _step_eagerly(model: BaseAlgorithm) -> None:
    found = [getattr(module, "optimizer", None) for module in model.policy.modules()]
    for optimiser in (*found, getattr(model, "ent_coef_optimizer", None)):
        if optimiser is not None:
            step_eagerly(optimiser)


def save_model(model: BaseAlgorithm, normalisation: VecNormalize | None, folder: Path) -> None:
    """Write a model as ``model.zip``, and its normalisation, if any, as ``vecnormalize.pkl``."""
    # Through memory: on a full disk torch raises its own exception.
    written = io.BytesIO()
    model.save(written)
    (folder / "model.zip").write_bytes(written.getvalue())
    if normalisation is not None:
        normalisation.save(str(folder / "vecnormalize.pkl"))


def save_agent(agent: Sb3Policy, run: TrainingRun, folder: Path) -> None:
    """Write an agent's model, and its plain arrays as ``agent.safetensors`` if a learned policy can represent it."""
    save_model(agent.model, agent.normalisation, folder)
    if run.residual_to or run.gated:
        save_run(run, folder / "run.json")  # with the policy that it corrects, and its gate
    with contextlib.suppress(ValueError):
        arrays, output, activation = network_arrays(agent, run.algorithm)
        write_arrays(folder / "agent.safetensors", arrays, run, output, activation)


def as_saved_agent(agent: Sb3Policy, algorithm: str, model: Model) -> LearnedPolicy | Sb3Policy:
    """Return an agent's network as a fast :class:`.LearnedPolicy`; an agent that it cannot represent unchanged.

    An agent that a learned policy cannot represent is returned unchanged.
    """
    try:
        return LearnedPolicy(model, *network_arrays(agent, algorithm))
    except ValueError:
        return agent


def save_checkpoint(
    model: BaseAlgorithm, env: TaskVecEnv, normalisation: VecNormalize | None, folder: Path
) -> None:
    """Write a checkpoint into a folder: model, environments, normalisation, and replay buffer if there is one."""
    save_model(model, normalisation, folder)
    if isinstance(model, OffPolicyAlgorithm):
        model.save_replay_buffer(folder / "replay_buffer.pkl")
    rest = {
        "environment": env.snapshot(),
        "returns": None if normalisation is None else normalisation.returns,
        "original": None if normalisation is None else (normalisation.old_obs, normalisation.old_reward),
        "torch": torch.get_rng_state(),
        "numpy": numpy.random.get_state(),  # noqa: NPY002 (what Stable-Baselines3 draws from)
        "python": random.getstate(),
        "action_space": model.action_space.np_random,
        "lstm": getattr(model, "_last_lstm_states", None),
    }
    (folder / "rest.pkl").write_bytes(pickle.dumps(rest))


def load_checkpoint(
    run: TrainingRun, folder: Path, trust: bool
) -> tuple[BaseAlgorithm, TaskVecEnv, VecNormalize | None]:
    """Return model, environments and normalisation of a checkpoint, to continue from."""
    check_trust(f"the checkpoint in {folder} is loaded with pickle", trust)
    adapted = training_environment(run)
    env: Any = adapted
    normalisation = None
    try:
        if (folder / "vecnormalize.pkl").exists():
            env = normalisation = VecNormalize.load(str(folder / "vecnormalize.pkl"), adapted)
        exclude_from_compilation()
        model = ALGORITHMS[run.algorithm].load(folder / "model.zip", env, device="cpu", force_reset=False)
        _step_eagerly(model)
        if isinstance(model, OffPolicyAlgorithm):
            model.load_replay_buffer(folder / "replay_buffer.pkl")
        rest = pickle.loads((folder / "rest.pkl").read_bytes())
        adapted.restore(rest["environment"])
        if normalisation is not None:
            normalisation.returns = rest["returns"]
            normalisation.old_obs, normalisation.old_reward = rest["original"]
        torch.set_rng_state(rest["torch"])
        numpy.random.set_state(rest["numpy"])  # noqa: NPY002
        random.setstate(rest["python"])
        model.action_space._np_random = rest["action_space"]
        if isinstance(model, RecurrentPPO):
            model._last_lstm_states = rest["lstm"]  # loading has set them to zero
    except Exception as error:  # for a corrupt file unpickling raises various exceptions
        raise ValueError(f"cannot read the checkpoint in {folder}: {error}") from error
    return model, adapted, normalisation


def check_algorithm(run: TrainingRun) -> None:
    """Raise ValueError if the algorithm does not fit the control's action space."""
    space = run.make_model().action_space
    if not isinstance(space, SPACES[run.algorithm]):
        fitting = [name for name, kinds in SPACES.items() if isinstance(space, kinds)]
        raise ValueError(
            f"algorithm {run.algorithm!r} does not fit control {run.control!r} of {run.environment} with "
            f"actions {space}: choose from {', '.join(fitting)}, or another control"
        )


def begin_model(run: TrainingRun) -> tuple[BaseAlgorithm, TaskVecEnv, VecNormalize | None]:
    """Return the model of a new run, its environments, and their normalisation (None: not normalised)."""
    # A deep copy: Stable-Baselines3 writes into policy_kwargs.
    values = copy.deepcopy(run.hyperparameters)
    for name in ("learning_rate", "clip_range"):
        if name in values:
            values[name] = schedule(name, values[name])
    values.pop("env_kwargs", None)
    normalize = values.pop("normalize", False)
    normalisation: VecNormalize | None = None
    adapted = training_environment(run)
    env: Any = adapted
    if normalize:
        # A Q-value of minus hundreds is learned slowly; a discounted return of order one is not.
        env = normalisation = VecNormalize(adapted, gamma=values.get("gamma", 0.99))
    exclude_from_compilation()
    model = ALGORITHMS[run.algorithm](env=env, seed=run.seed, device="cpu", **values)
    _step_eagerly(model)
    adapted.seed_episodes(episode_seeds("train", run.seed, run.envs))  # after the model, which seeds it too
    return model, adapted, normalisation


def train_sb3(run: TrainingRun, session: Session) -> TrainingRun:
    """Train an agent with Stable-Baselines3 up to ``run.steps``, or Ctrl-C or SIGTERM; return the run.

    An algorithm that does not fit the control, and a checkpoint that is corrupt or not trusted, raise
    ValueError.
    """
    if session.resume and run.is_complete:
        return run
    began = time.monotonic()
    check_algorithm(run)
    if session.resume:
        model, env, normalisation = load_checkpoint(run, session.folder / "checkpoint", session.trust)
    else:
        model, env, normalisation = begin_model(run)
    logger = make_logger(session.folder / "log", model.num_timesteps)
    model.set_logger(logger)
    policy = Sb3Policy(model, normalisation, run.control)
    trainee = Trainee(
        PolicyMaker(
            functools.partial(as_saved_agent, policy, run.algorithm),
            lambda task, agent: wrap_as_trained(task, agent, run.residual_to, run.gated),
            run.control,
        ),
        lambda place: save_checkpoint(model, env, normalisation, place),
        lambda place: save_agent(policy, run, place),
    )
    with contextlib.closing(logger), interruption() as stop:
        books = Bookkeeping(run, session, trainee, stop, curve_writer(logger), began)
        trainer = _Trainer(books, session.progress)
        remaining = run.steps - model.num_timesteps
        if remaining > 0:
            model.learn(remaining, callback=trainer, reset_num_timesteps=not session.resume)
        if not trainer.stopping:
            books.safe_point(model.num_timesteps, last=True)
    return run
