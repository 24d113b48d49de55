"""Policies that an evaluation finds by name or file: shipped agents, exported ones, and models' zips."""

from pathlib import Path
from typing import Any

from .learned_policy import pretrained_path, stored_policy


def shipped_agents(id: str) -> list[str]:
    """Names of the agents that are shipped for an environment."""
    return sorted(path.stem for path in pretrained_path(id, "").parent.glob("*.safetensors"))


def learned_policy(id: str, name: str, trust: bool = False) -> Any:
    """Return what makes a learned policy for a task, or None if the name means nothing here.

    Args:
        id: environment id.
        name: of a shipped agent (``ppo``, ``bptt``), or a file: ``.safetensors``, or the ``.zip`` of a
            Stable-Baselines3 model, which can execute code while it is loaded.
        trust: load such a zip.

    Raises:
        ValueError: if the file is not what its name says, or takes ``trust``.
    """
    if name.endswith(".safetensors"):
        return stored_policy(id, Path(name))
    if name.endswith(".zip"):
        try:
            from .sb3_training import load_sb3_policy
        except ImportError as error:
            raise ValueError(
                f"policy {name!r} needs more packages: pip install 'filtergym[agents]'"
            ) from error
        return load_sb3_policy(Path(name), trust=trust)
    shipped = pretrained_path(id, name)
    return stored_policy(id, shipped) if shipped.exists() else None
