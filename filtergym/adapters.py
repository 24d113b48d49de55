"""Adapters that make estimators of filters of other libraries, and of a user's filters of a single track.

See docs/own_estimator.md. ``pip install 'filtergym[adapters]'`` brings filterpy and Stone Soup.
"""

import importlib
import importlib.util
from typing import TYPE_CHECKING, Any

from .evaluation.competitors.adapters import SingleTrackEstimator

if TYPE_CHECKING:
    from .evaluation.competitors.adapters import FilterpyEstimator
    from .evaluation.competitors.stone_soup import StoneSoupEstimator

__all__ = ["FilterpyEstimator", "SingleTrackEstimator", "StoneSoupEstimator"]

LIBRARIES = {"FilterpyEstimator": ("filterpy", "adapters"), "StoneSoupEstimator": ("stonesoup", "stone_soup")}
"""Library that an adapter needs, and the module of the adapter."""


def __getattr__(name: str) -> Any:
    # On first use: a user of one library does not need the other.
    if name not in LIBRARIES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    library, module = LIBRARIES[name]
    if importlib.util.find_spec(library) is None:
        raise ImportError(f"{name} needs {library}: pip install {library}, or 'filtergym[adapters]'")
    return getattr(importlib.import_module(f".evaluation.competitors.{module}", __package__), name)
