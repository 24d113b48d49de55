"""The papers' algorithms as policies, reference estimators and bounds, and Monte Carlo evaluation."""

import importlib
from typing import Any

__all__ = ["evaluate", "tidy_records"]
_HOMES = {"evaluate": "evaluation", "tidy_records": "metrics"}


def __getattr__(name: str) -> Any:
    # On first use: evaluation brings xarray, and importing filtergym needs only the environments.
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f".{_HOMES[name]}", __name__), name)
