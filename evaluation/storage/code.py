"""Digest of the package's code, by which stored unfinished work is recognised as that of the same code."""

import functools
import hashlib
from collections.abc import Iterable
from importlib import metadata
from importlib.util import find_spec
from pathlib import Path
from platform import python_version

ROOMS = ("", ".filters", ".compiler", ".envs", ".evaluation", ".baselines", ".agents")
"""Endings of the names of the packages that contain the code."""
SUFFIXES = frozenset((".py", ".json", ".yml", ".safetensors"))
"""Suffixes of files on which results depend."""
LIBRARIES = ("numpy", "scipy", "xarray", "llvmlite", "torch", "stable-baselines3")


def package_folders() -> list[Path]:
    """Return the package's source folders."""
    package = __name__.partition(".")[0]
    specs = [find_spec(package + room) for room in ROOMS]
    return [Path(place) for spec in specs if spec for place in spec.submodule_search_locations or ()]


def files_digest(folders: Iterable[Path]) -> str:
    """Return the SHA-256 digest of the names and contents of the code and data files in some folders."""
    digest = hashlib.sha256()
    for folder in folders:
        for path in sorted(path for path in folder.rglob("*") if path.suffix in SUFFIXES):
            content = path.read_bytes()
            digest.update(f"{path.relative_to(folder).as_posix()} {len(content)}\n".encode())
            digest.update(content)
    return digest.hexdigest()


def library_versions(libraries: Iterable[str]) -> dict[str, str]:
    """Return the versions of the installed libraries among some, by name."""
    versions = {}
    for library in libraries:
        try:
            versions[library] = metadata.version(library)
        except metadata.PackageNotFoundError:
            continue
    return versions


@functools.cache
def code_digest() -> str:
    """Return the cached SHA-256 digest of the package's files and the versions of Python and numerical
    libraries.
    """
    installed = library_versions(LIBRARIES)
    versions = [python_version(), *(installed.get(library, "") for library in LIBRARIES)]
    return hashlib.sha256(f"{versions} {files_digest(package_folders())}".encode()).hexdigest()
