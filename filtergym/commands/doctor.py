"""The command that prints what a bug report should state of a machine."""

import importlib.metadata
import os
import platform
from collections.abc import Iterator

from packaging.requirements import Requirement

from ..compiler import cache, native
from .terminal import console

PACKAGE = "filtergym"
DEVELOPMENT = ("dev",)
"""Extras for developers only."""


def examine() -> None:
    """Print versions, processor, cache of compiled code and extras, for a bug report.

    Example: filtergym doctor
    """
    for what, value in (*_machine(), *_libraries()):
        console.print(f"{what:<14} {value}", highlight=False, soft_wrap=True)


def _machine() -> Iterator[tuple[str, str]]:
    yield PACKAGE, f"{importlib.metadata.version(PACKAGE)} on Python {platform.python_version()}"
    yield "system", f"{platform.platform()}, {os.cpu_count()} processors"
    if not native.AVAILABLE:
        yield "backend", "numpy: without the extra fast nothing is compiled"
        return
    name, features = native.processor()
    widest = (
        "AVX-512" if "+avx512f" in features else "AVX2" if "+avx2" in features else "neither AVX2 nor AVX-512"
    )
    yield "backend", f"compiled for {name}, {widest}"
    yield "cache", _cache()


def _cache() -> str:
    """Return a line with the folder and the size of the cache of compiled code."""
    place = cache.folder()
    if place is None:
        return f"off by {cache.SWITCH}"
    entries = [each.stat().st_size for each in place.glob(f"*{cache.SUFFIX}")] if place.is_dir() else []
    return f"{place}: {len(entries):,} programs, {sum(entries) / 2**20:.1f} of {cache.LIMIT / 2**20:.0f} MB"


def _libraries() -> Iterator[tuple[str, str]]:
    """Yield each extra, and as text the versions of its packages, or which of them are missing."""
    requirements = [Requirement(text) for text in importlib.metadata.requires(PACKAGE) or ()]
    extras = importlib.metadata.metadata(PACKAGE).get_all("Provides-Extra") or ()
    for extra in ("", *(name for name in extras if name not in DEVELOPMENT)):
        wanted = [each for each in requirements if _is_in_extra(each, extra)]
        found = [f"{each.name} {_version(each)}" for each in wanted]
        yield f"[{extra}]" if extra else "libraries", ", ".join(found)


def _is_in_extra(requirement: Requirement, extra: str) -> bool:
    """Return whether a requirement belongs to an extra; extra "" is the packages that are always required."""
    if requirement.marker is None:
        return not extra
    return bool(extra) and requirement.marker.evaluate({"extra": extra})


def _version(wanted: Requirement) -> str:
    try:
        version = importlib.metadata.version(wanted.name)
    except importlib.metadata.PackageNotFoundError:
        return "missing"
    return (
        version
        if wanted.specifier.contains(version, prereleases=True)
        else f"{version}, wants {wanted.specifier}"
    )
