"""Reproductions of papers, which a clone of the repository contains and an installed package lacks."""

import importlib.util
import pkgutil
from types import ModuleType

from .envs.engine.catalogue import nearest

PAPERS = f"{__package__}.papers"


def papers() -> dict[str, str]:
    """Return the module of every reproducible paper, by its name on the command line."""
    spec = importlib.util.find_spec(PAPERS)
    folders = (spec and spec.submodule_search_locations) or ()
    return {
        found.name.replace("_", "-"): f"{PAPERS}.{found.name}"
        for found in pkgutil.iter_modules(folders)
        if found.ispkg
    }


def paper_module(name: str) -> ModuleType:
    """Return the module that reproduces a paper, imported.

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
