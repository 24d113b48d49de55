"""Python estimators in a process of their own, which receives the measurements and nothing else.

This module composes the request for :mod:`.isolated_estimator`: the text of the estimator, which this process never
executes, the paths that the other process may read (Python's library, the installed packages but this one, and the
folder of the estimator), and the texts of this package's modules for estimators.
"""

import json
import os
import sys
import sysconfig
from collections.abc import Iterable, Iterator
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from ...envs.engine.catalogue import find_user_module
from ..storage.code import package_folders
from .kinds import Competitor
from .programs import LIMITS, Program

ISOLATED = "isolated:"
"""Prefix of ``module:Class`` for an estimator in a process of its own."""
SHARED = ("adapters", "evaluation.competitors.adapters", "evaluation.competitors.stone_soup")
"""Modules of this package that an isolated estimator may import: they contain no world and no seed."""
INIT = "__init__.py"
"""Name of the file in each folder of this package."""
SYSTEM = (
    "/lib",
    "/lib64",
    "/usr/lib",
    "/usr/lib64",
    "/etc/ld.so.cache",
    "/etc/localtime",
    "/dev/null",
    "/dev/urandom",
)
"""Files and folders that libraries read."""
ONE_THREAD = tuple((name, "1") for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"))
"""Variables for one thread: no thread starts before the restrictions, and products round as in this process."""


def isolate_estimator(name: str) -> Program:
    """Return the program that runs the estimator of a user's module in a process of its own.

    Args:
        name: ``module:Class``, of a module in one file.

    Raises:
        ValueError: if there is no such file, or it cannot be read.
    """
    module, colon, attribute = name.partition(":")
    if not colon or not attribute.isidentifier():
        raise ValueError(f"{ISOLATED} takes module:Class of an estimator, got {name!r}")
    file = find_user_module(module, f"cannot isolate {name!r}")
    try:
        text = file.read_text(encoding="utf-8")
    except (OSError, ValueError) as error:
        raise ValueError(f"cannot isolate {name!r}: {error}") from None
    return isolate_source(text, attribute, ISOLATED + name, file)


def isolate_source(text: str, attribute: str, name: str, file: Path | None = None) -> Program:
    """Return the program that runs the estimator of a source text in a process of its own.

    Args:
        text: source text of its module.
        attribute: name of its class.
        name: its name in errors.
        file: file of the text, if there is one; its folder may be read.
    """
    folder = [] if file is None else [str(file.parent.absolute())]
    libraries = _libraries()
    # Some editable installations hold links to files, so the folders of these count, too.
    forbidden = [
        own.resolve() for place in package_folders() for own in (place, (place / INIT).resolve().parent)
    ]
    allowed = [Path(place) for place in (*SYSTEM, *libraries, sys.base_prefix + "/lib", *folder)]
    allowed += [place for library in libraries for place in Path(library).glob("*") if place.is_symlink()]
    request = {
        "source": text,
        "file": name if file is None else str(file.absolute()),
        "module": "isolated" if file is None else file.stem,
        "name": attribute,
        "path": [*libraries, *folder],
        "readable": sorted({path for place in allowed for path in _without(place, forbidden)}),
        # An import needs the names in the folder that holds a library; some installations have this package there, too.
        "listable": [*libraries, *folder],
        "shared": _shared_modules(),
    }
    return Program(
        name,
        LIMITS.get(),
        (),
        json.dumps(request).encode() + b"\n",
        (*ONE_THREAD, ("PATH", os.defpath), ("LANG", "C.UTF-8")),
    )


def _libraries() -> list[str]:
    """Return the folders of Python's library and of installed packages, in the order in which they are searched."""
    own = [sysconfig.get_path("stdlib"), sysconfig.get_path("platstdlib")]
    extensions = [str(Path(place) / "lib-dynload") for place in own]
    packages = [path for path in sys.path if Path(path).name in ("site-packages", "dist-packages")]
    return list(dict.fromkeys([*own, *extensions, *packages]))


def _shared_modules() -> dict[str, str]:
    """Return the texts of the modules that an isolated estimator may import, by their names."""
    package = __name__.partition(".")[0]
    specs = [find_spec(f"{package}.{name}") for name in SHARED]
    return {spec.name: Path(str(spec.origin)).read_text(encoding="utf-8") for spec in specs if spec}


def _without(place: Path, forbidden: Iterable[Path]) -> Iterator[str]:
    """Yield a folder, or where it contains forbidden paths, all other paths in it, at any depth."""
    real = place.resolve()
    if not real.exists() or any(real.is_relative_to(other) for other in forbidden):
        return
    if not any(other.is_relative_to(real) for other in forbidden):
        yield str(real)
        return
    for inner in real.iterdir():
        yield from _without(inner, forbidden)


def find_isolated(name: str, inner: str, problem: Any, find: Any) -> Competitor:
    """Return the competitor of ``isolated:module:Class``."""
    return Competitor(name, isolate_estimator(inner))
