"""Optimisers of torch without torch's compiler.

Torch's optimisers import ``torch._dynamo`` when the first one is made, and at every step, only to exclude some of their
functions from compilation. That import takes longer than an agent needs to beat the paper's algorithm, and nothing is
compiled here. This module reads private names of torch: where another version has other names, the import takes place,
and the numbers are the same either way.
"""

import types
from typing import Any

import torch

EXCLUDED = ("add_param_group", "zero_grad", "state_dict", "load_state_dict")
"""Names of an optimiser's methods that torch excludes from compilation when they are first called."""


def exclude_from_compilation() -> None:
    """Mark torch's optimiser methods as excluded from compilation, without an import of torch's compiler."""
    for name in EXCLUDED:
        method = getattr(getattr(torch.optim.Optimizer, name), "__wrapped__", None)
        if method is not None and not hasattr(method, "__dynamo_disable"):
            method.__dynamo_disable = method


def step_eagerly(optimizer: torch.optim.Optimizer) -> None:
    """Make an optimiser step without an import of torch's compiler, unless the optimiser is differentiable."""
    step: Any = getattr(type(optimizer).step, "__wrapped__", None)
    while hasattr(step, "__wrapped__"):
        step = step.__wrapped__
    if step is not None and not optimizer.defaults.get("differentiable", False):
        optimizer.step = types.MethodType(torch.no_grad()(step), optimizer)  # type: ignore[method-assign]
