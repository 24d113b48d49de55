"""Where the arrays of a vector environment live: NumPy, or torch on a device."""

from types import ModuleType
from typing import Any

import numpy

from .catalogue import nearest
from .observation import Array

BACKENDS = ("numpy", "torch")


def array_backend(backend: str, device: Any = None) -> tuple[ModuleType, Any]:
    """Return the array namespace of a backend, and its device.

    torch is imported here and only when asked for.

    Args:
        backend: "numpy" or "torch".
        device: None for the backend's default (the CPU), or what ``torch.device`` takes, such as "cuda:1".

    Returns:
        Namespace and device; the device is None for NumPy.

    Raises:
        ValueError: for an unknown backend, a device that NumPy does not have, or a device that is not there.
        ImportError: if torch is asked for and not installed.
    """
    if backend not in BACKENDS:
        raise nearest("backend", backend, BACKENDS)
    if backend == "numpy":
        if device not in (None, "cpu"):
            raise ValueError(
                f"backend 'numpy' works on the CPU only, got device {device!r}; use backend='torch'"
            )
        return numpy, None
    try:
        import torch
    except ImportError as error:
        raise ImportError(
            "backend 'torch' needs torch, which is not installed: pip install 'filtergym[agents]'"
        ) from error
    import array_api_compat.torch as xp

    try:
        chosen = torch.device("cpu" if device is None else device)
        # An allocation is the only question that every kind of device answers, also whether it has float64.
        torch.zeros(1, dtype=torch.float64, device=chosen)
    except (RuntimeError, AssertionError, TypeError, NotImplementedError) as error:
        there = ["cpu", *(f"cuda:{i}" for i in range(torch.cuda.device_count()))]
        reason = str(error).strip().splitlines()[0].rstrip(".")
        raise ValueError(
            f"device {device!r} cannot be used ({reason}): choose from {', '.join(there)}"
        ) from error
    return xp, chosen


def is_tensor(values: Any) -> bool:
    """Whether this is a torch tensor; does not import torch."""
    return type(values).__module__.partition(".")[0] == "torch"


def host_array(values: Any) -> numpy.ndarray:
    """Return an array or tensor of any device as a NumPy array, without its gradient."""
    return values.detach().cpu().numpy() if is_tensor(values) else numpy.asarray(values)


def tensor_on(values: Any, device: Any) -> Array:
    """Return a tensor on ``device``: a tensor keeps its gradient and precision, anything else is copied."""
    import torch

    return values.to(device) if is_tensor(values) else torch.tensor(values, device=device)
