"""Optimisers of torch without torch's compiler.

Torch's optimisers import ``torch._dynamo`` when the first one is made, and at every step, only to keep the compiler
away from some of their functions. That import takes longer than an agent needs to beat the paper's algorithm. Nothing
here is compiled by torch, so they can do without it. This reads names that torch keeps for itself: where another
version has others, the import happens as ever, and the numbers are the same either way.
"""

import types
from typing import Any

import torch

EXCLUDED = ("add_param_group", "zero_grad", "state_dict", "load_state_dict")
"""Methods of an optimiser that torch excludes from compilation when they are first called."""


def exclude_from_compilation() -> None:
    """Note for these methods that nothing is to be compiled, which torch otherwise asks its compiler to note."""
    for name in EXCLUDED:
        method = getattr(getattr(torch.optim.Optimizer, name), "__wrapped__", None)
        if method is not None and not hasattr(method, "__dynamo_disable"):
            method.__dynamo_disable = method


def step_eagerly(optimizer: torch.optim.Optimizer) -> None:
    """Let this optimiser step without asking the compiler to look away; not where it is to be differentiated."""
    step: Any = getattr(type(optimizer).step, "__wrapped__", None)
    while hasattr(step, "__wrapped__"):
        step = step.__wrapped__
    if step is not None and not optimizer.defaults.get("differentiable", False):
        optimizer.step = types.MethodType(torch.no_grad()(step), optimizer)  # type: ignore[method-assign]
