"""Python estimators in a sandboxed process, which receives only the measurements.

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
"""Prefix of the name ``module:Class`` of an estimator that runs in its own process."""
SHARED = ("adapters", "evaluation.competitors.adapters", "evaluation.competitors.stone_soup")
"""Modules of this package that an isolated estimator can import: they contain neither the world nor a seed."""
INIT = "__init__.py"
"""Name of the file in the folder of each package."""
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
"""Files and folders of the system that libraries read."""
ONE_THREAD = tuple((name, "1") for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"))
"""Environment variables for one thread: no thread starts before the restrictions, and matrix products round as in this
process.
"""


def isolate_estimator(name: str) -> Program:
    """Return a program that runs the estimator class of a user's module in a sandboxed process.

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
    """Return a program that runs an estimator class, given as source text, in a sandboxed process."""
    folder = [] if file is None else [str(file.parent.absolute())]
    libraries = _library_folders()
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
        "readable": sorted({path for place in allowed for path in _allowed_paths(place, forbidden)}),
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


def _library_folders() -> list[str]:
    own = [sysconfig.get_path("stdlib"), sysconfig.get_path("platstdlib")]
    extensions = [str(Path(place) / "lib-dynload") for place in own]
    packages = [path for path in sys.path if Path(path).name in ("site-packages", "dist-packages")]
    return list(dict.fromkeys([*own, *extensions, *packages]))


def _shared_modules() -> dict[str, str]:
    """Return the source texts of the modules that an isolated estimator can import, by their names."""
    package = __name__.partition(".")[0]
    specs = [find_spec(f"{package}.{name}") for name in SHARED]
    return {spec.name: Path(str(spec.origin)).read_text(encoding="utf-8") for spec in specs if spec}


def _allowed_paths(place: Path, forbidden: Iterable[Path]) -> Iterator[str]:
    """Yield the paths below a folder, as high as possible, that contain no forbidden path."""
    real = place.resolve()
    if not real.exists() or any(real.is_relative_to(other) for other in forbidden):
        return
    if not any(other.is_relative_to(real) for other in forbidden):
        yield str(real)
        return
    for inner in real.iterdir():
        yield from _allowed_paths(inner, forbidden)


def find_isolated(name: str, inner: str, problem: Any, find: Any) -> Competitor:
    """Return the competitor named ``isolated:module:Class``, an estimator in a sandboxed process."""
    return Competitor(name, isolate_estimator(inner))
