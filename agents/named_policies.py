"""Policies by name, file or folder: shipped agents, exported agents, zips of models, and training runs."""

import hashlib
from pathlib import Path
from typing import Any

from ..baselines.problem import Problem
from ..envs.contract.companions import action_reach
from ..envs.contract.task import Task
from ..envs.data.foreign_files import is_folder
from ..evaluation.competitors.kinds import Competitor, CompetitorFiles
from .gate import PolicyMaker, wrap_as_trained
from .learned_policy import load_policy, pretrained_path
from .training_run import TrainingRun, best_agent, load_run


def pretrained_agents(id: str) -> list[str]:
    """Return the names of the agents shipped for the environment of a Gymnasium id."""
    return sorted(path.stem for path in pretrained_path(id, "").parent.glob("*.safetensors"))


def find_learned_policy(cls: type[Task], name: str, trust: bool = False) -> Any:
    """Return the factory of the learned policy of a name, file or folder; None for another name.

    Args:
        cls: the environment.
        name: name of a shipped agent (``ppo``, ``bptt``); a ``.safetensors`` file, or the ``.zip`` of a
            Stable-Baselines3 model, which can execute code while it is loaded; or the folder of a training run, for its
            best agent.
        trust: whether to load a zip.
    """
    if name in pretrained_agents(cls.id):
        return load_policy(cls, pretrained_path(cls.id, name))
    path = Path(name)
    if is_folder(path):
        return _agent_of_run(cls, path, trust)
    if name.endswith(".safetensors"):
        return load_policy(cls, path)
    if not name.endswith(".zip"):
        return None
    model = load_zipped_model(cls, path, None, trust)
    # A run.json beside the model describes the policy that it corrects, and its gate.
    return (
        _wrap_as_in_run(model, load_run(path.parent, trust))
        if (path.parent / "run.json").is_file()
        else model
    )


def load_zipped_model(cls: type[Task], path: Path, control: str | None, trust: bool) -> Any:
    """Return a Stable-Baselines3 model from its zip, without residual policy or gate."""
    try:
        from .sb3_policy import load_sb3_policy
    except ImportError as error:
        raise ValueError(f"policy '{path}' needs more packages: pip install 'filtergym[agents]'") from error
    return load_sb3_policy(path, cls.id, control, trust=trust)


def _agent_of_run(cls: type[Task], folder: Path, trust: bool) -> Any:
    """Return the best agent of a run of ``filtergym train`` or rl-zoo3, from plain arrays where they exist."""
    if not (folder / "run.json").exists():
        # rl-zoo3: ENV_1/best_model.zip if there was an evaluation, and ENV_1/ENV.zip at the end.
        for name in ("best_model", folder.absolute().name.rpartition("_")[0]):
            if (folder / f"{name}.zip").is_file():
                return load_zipped_model(cls, folder / f"{name}.zip", None, trust)
    run = load_run(folder, trust)
    agent = best_agent(folder)
    if agent.suffix == ".safetensors":
        return load_policy(cls, agent)
    own = run.environment.rpartition(":")[2]
    if own != cls.id:
        raise ValueError(f"{folder} contains a run of {own}, not of {cls.id}")
    return _wrap_as_in_run(load_zipped_model(cls, agent, run.control, trust), run)


def _wrap_as_in_run(model: Any, run: TrainingRun) -> Any:
    """Return the factory of a model's policy as in its run: with corrected policy, gate, and range of actions."""
    reach = action_reach(run.problem.task, run.control)
    model.task_keywords = {name: run.task_keywords[name] for name in reach if name in run.task_keywords}
    if not (run.residual_to or run.gated):
        return model
    return PolicyMaker(
        model, lambda task, agent: wrap_as_trained(task, agent, run.residual_to, run.gated), run.control
    )


def with_normalisation(found: Any) -> Any:
    """Return a model of Stable-Baselines3 with the normalisation of its training; other objects unchanged."""
    if isinstance(found, type) or not hasattr(found, "get_vec_normalize_env"):
        return found
    from .sb3_policy import Sb3Policy

    return Sb3Policy(found)


def _find_learned(name: str, problem: Problem, trust: bool, find_shipped: Any) -> Competitor | None:
    """Return the competitor of a shipped agent, or of one in a file or folder; None for another name."""
    maker = find_learned_policy(problem.task, name, trust)
    if maker is None:
        return None
    shipped = problem.is_shipped and name in pretrained_agents(problem.id)
    content = pretrained_path(problem.id, name).read_bytes() if shipped else b""
    return Competitor(name, maker, True, hashlib.sha256(content).hexdigest() if shipped else None)


LEARNED = CompetitorFiles(_find_learned, (".zip", ".safetensors"), pretrained_agents, with_normalisation)
