"""Reproductions of papers, in a clone of the repository; no installed package holds them.

They are the folder ``papers/``, beside the rooms of the package. This module gives it a name inside the package, so
that this process and every worker import ``filtergym.papers.NAME``, whatever folder they run in.
"""

import importlib
import pkgutil
from pathlib import Path
from types import ModuleType

from .. import envs
from ..envs.engine.catalogue import nearest

# Of an installed package this is the folder of this file, which holds no paper.
__path__ = [str(Path(envs.__path__[0]).parent / "papers")]


def papers() -> dict[str, str]:
    """Return the module of every paper that can be reproduced, by its name on the command line."""
    return {
        found.name.replace("_", "-"): f"{__name__}.{found.name}"
        for found in pkgutil.iter_modules(__path__)
        if found.ispkg
    }


def paper_module(name: str) -> ModuleType:
    """Import the reproduction of a paper.

    Raises:
        ValueError: if there is none of that name, or the package is installed without the repository.
    """
    known = papers()
    if not known:
        raise ValueError(
            f"cannot reproduce {name!r}: reproductions are part of the repository, not of the package; in a clone, "
            "installed with pip install --editable ., the command finds them"
        )
    if name not in known:
        raise nearest("paper", name, known)
    return importlib.import_module(known[name])
