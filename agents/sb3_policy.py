"""Trained models of Stable-Baselines3 and sb3-contrib as policies, with the normalisation of their training.

The zip of a model trained under ``VecNormalize`` lacks the statistics: they are in a file of their own. With raw
observations such a model runs without an error, but badly.
"""

import pickle
import re
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import gymnasium
import numpy
from sb3_contrib import ARS, QRDQN, TQC, TRPO, CrossQ, RecurrentPPO
from stable_baselines3 import A2C, DQN, PPO, SAC, TD3
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.save_util import load_from_zip_file
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from ..envs.contract.companions import action_reach
from ..envs.interface.environment import TaskEnv
from ..envs.interface.vector_environment import TaskVectorEnv
from .eager_optimiser import exclude_from_compilation
from .training_run import check_trust

POLICY_CLASSES: tuple[tuple[type[BaseAlgorithm], str, str], ...] = (
    (RecurrentPPO, "RecurrentActorCriticPolicy", ""),
    (PPO, "ActorCriticPolicy", "clip_range"),
    (TRPO, "ActorCriticPolicy", "cg_max_steps"),
    (A2C, "ActorCriticPolicy", ""),
    (SAC, "SACPolicy", ""),
    (TD3, "TD3Policy", ""),
    (DQN, "DQNPolicy", ""),
    (ARS, "ARSPolicy", ""),
    (CrossQ, "CrossQPolicy", ""),
    (QRDQN, "QRDQNPolicy", ""),
    (TQC, "TQCPolicy", ""),
)
"""Algorithms of a zip, which does not name its own; the first match counts. Each entry is the algorithm, the class that
the stored policy is or inherits from, and a value that the zip must contain ("" for none). DDPG is loaded as TD3.
"""
NAMES = "PPO, RecurrentPPO, A2C, TRPO, SAC, TD3, DDPG, TQC, CrossQ, DQN, QR-DQN and ARS"


class Sb3Policy:
    """A trained model with the normalisation of its observations, as a policy.

    Args:
        model: model of Stable-Baselines3 or sb3-contrib.
        normalisation: the normalisation of its training; default: the environment that the model contains, if that is
            a ``VecNormalize``.
        control: control of the model; default: the one that fits its action space.
        name: name of the model in warnings.

    Raises:
        ValueError: if the statistics are of observations of another shape than the model's.

    Warns:
        UserWarning: if the model was trained on normalised observations, and the statistics are missing.
    """

    def __init__(
        self,
        model: BaseAlgorithm,
        normalisation: VecNormalize | None = None,
        control: str | None = None,
        name: str = "",
    ) -> None:
        self.model = model
        self.observation_space: Any = model.observation_space
        self.action_space: Any = model.action_space
        self.normalisation = model.get_vec_normalize_env() if normalisation is None else normalisation
        self.task_keywords: dict[str, Any] = _action_range(model)
        if control is not None:
            self.control = control
        name = name or f"this model of {type(model).__name__}"
        if self.normalisation is not None:
            _check_shape(self.normalisation, model)
        elif was_trained_normalised(model):
            warnings.warn(
                f"{name} was trained under VecNormalize, and its statistics are missing, so it receives raw "
                "observations and its score is not the model's: keep vecnormalize.pkl beside the zip, or in Python "
                "pass Sb3Policy(model, normalisation)",
                stacklevel=2,
            )
        if _is_wrapped(model):
            warnings.warn(
                f"{name} was trained on the output of Gymnasium's NormalizeObservation, and receives raw observations, "
                "so its score is not the model's: train under VecNormalize instead",
                stacklevel=2,
            )

    def predict(
        self,
        observation: numpy.ndarray,
        state: Any = None,
        episode_start: numpy.ndarray | None = None,
        deterministic: bool = True,
    ) -> tuple[numpy.ndarray, Any]:
        """Return a model's actions for raw observations, which it normalises as in training, and its memory."""
        if self.normalisation is not None:
            normalised: Any = self.normalisation.normalize_obs(observation)
            observation = normalised
        return self.model.predict(observation, state, episode_start, deterministic)


def _action_range(model: BaseAlgorithm) -> dict[str, Any]:
    """Return the task parameters that set the range of actions in a model's environment, where not default."""
    held = model.get_env()
    inner: Any = None if held is None else held.unwrapped
    env = inner.envs[0].unwrapped if isinstance(inner, DummyVecEnv) else getattr(inner, "env", None)
    if not isinstance(env, TaskEnv | TaskVectorEnv):
        return {}
    own, names = env.task.parameters, action_reach(env.task, env.model.control)
    defaults = type(own)()
    return {name: getattr(own, name) for name in names if getattr(own, name) != getattr(defaults, name)}


def _check_shape(normalisation: VecNormalize, model: BaseAlgorithm) -> None:
    statistics: Any = normalisation.obs_rms if normalisation.norm_obs else None
    if statistics is not None and statistics.mean.shape != model.observation_space.shape:
        raise ValueError(
            f"the statistics are of observations of shape {statistics.mean.shape}, the model takes "
            f"{model.observation_space.shape}: they are another model's"
        )


def was_trained_normalised(model: BaseAlgorithm) -> bool:
    """Return whether a model was trained on normalised observations, as far as its stored observations show.

    A model stores its last observation and, under ``VecNormalize``, the original of the float32 one.
    So with float64 observations the two types decide. With float32 an algorithm without replay buffer is
    detected, even if only rewards were normalised; one with a replay buffer stores an earlier observation there without
    ``VecNormalize``, too, and is not detected, nor is a model without training.
    """
    shown, original = model._last_obs, model._last_original_obs
    if not isinstance(original, numpy.ndarray):
        return False
    if isinstance(shown, numpy.ndarray) and original.dtype != numpy.float32:
        return bool(shown.dtype == numpy.float32)
    return not isinstance(model, OffPolicyAlgorithm)


def _is_wrapped(model: BaseAlgorithm) -> bool:
    """Return whether the environment of a model contains Gymnasium's ``NormalizeObservation``."""
    env = model.get_env()
    inner = None if env is None else env.unwrapped
    wrapper = gymnasium.wrappers.NormalizeObservation
    return isinstance(inner, DummyVecEnv) and any(inner.env_is_wrapped(wrapper))


def statistics_places(path: Path, environment: str | None = None) -> Iterator[Path]:
    """Yield the paths of files that may contain the normalisation of a model's zip, most specific first."""
    steps = re.fullmatch(r"(.+)_(\d+)_steps", path.stem)
    if steps:  # as Stable-Baselines3's CheckpointCallback names them
        yield path.with_name(f"{steps[1]}_vecnormalize_{steps[2]}_steps.pkl")
    yield path.parent / "vecnormalize.pkl"
    # rl-zoo3: ENV_1/ENV.zip, ENV_1/best_model.zip and ENV_1/ENV/vecnormalize.pkl.
    folders = [path.stem, path.absolute().parent.name.rpartition("_")[0]]
    if environment is not None:
        folders.append(environment.replace("/", "-"))
    for folder in dict.fromkeys(filter(None, folders)):
        yield path.parent / folder / "vecnormalize.pkl"


def load_sb3_policy(
    path: Path | str, environment: str | None = None, control: str | None = None, *, trust: bool = False
) -> Sb3Policy:
    """Return a policy from a model's zip, with the statistics of its ``VecNormalize`` if there are any.

    The statistics may be in ``vecnormalize.pkl`` beside the zip, in rl-zoo3's place (``ENV/vecnormalize.pkl`` below the
    folder), or beside a checkpoint of Stable-Baselines3's ``CheckpointCallback``, under its name for them.

    Args:
        path: path of the zip.
        environment: id of the model's environment, by which rl-zoo3 names a folder.
        control: control of the model; default: the one that fits its action space.
        trust: load both files, which can execute code while they are loaded.

    Raises:
        ValueError: if the file does not exist, is not trusted, or is not a model.

    Warns:
        UserWarning: if the model was trained on normalised observations, and the statistics are missing.
    """
    path = Path(path)
    if not path.is_file():
        raise ValueError(f"no model at {path}")
    check_trust(f"model {path} is loaded with pickle", trust)
    places = list(statistics_places(path, environment))
    found = next((place for place in places if place.is_file()), None)
    try:
        model = _load_model(path)
        normalisation = None
        if found is not None:
            with found.open("rb") as file:
                normalisation = pickle.load(file)
            normalisation.training = False
        searched = ", ".join(place.relative_to(path.parent).as_posix() for place in places)
        return Sb3Policy(model, normalisation, control, f"model {path} (no file {searched} beside it)")
    except Exception as error:  # for a corrupt file unpickling raises various exceptions
        raise ValueError(f"cannot read the model {path}: {error}") from error


def _load_model(path: Path) -> BaseAlgorithm:
    """Return the model in a zip, loaded with the class of its algorithm."""
    data = load_from_zip_file(path, device="cpu")[0] or {}
    names = {cls.__name__ for cls in data["policy_class"].__mro__}
    for algorithm, policy, stored in POLICY_CLASSES:
        if policy in names and (not stored or stored in data):
            exclude_from_compilation()
            return algorithm.load(path, device="cpu")
    raise ValueError(
        f"its policy, {data['policy_class'].__name__}, belongs to none of the supported algorithms: {NAMES}"
    )
