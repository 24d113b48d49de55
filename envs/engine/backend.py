"""Choice of the backend that computes the steps of a task: compiled code, NumPy, or torch on a device."""

from types import ModuleType
from typing import Any

import numpy

from ...compiler.namespace import NotTraceable
from ..contract.companions import trained_banks
from ..contract.model import Model
from ..contract.parameters import ParameterLimits, check
from ..contract.task import Task
from .catalogue import nearest
from .compiled import AVAILABLE, compiled_model, warn_not_compiled
from .scenario_choice import find_scenario

BACKENDS = ("auto", "compiled", "numpy", "torch")


def make_model(
    cls: type[Task],
    control: str | None = None,
    scenario: Any = None,
    *,
    backend: str = "numpy",
    device: Any = None,
    threads: int = 1,
    **keywords: Any,
) -> Model:
    """Return the :class:`Model` of a task with one of its controls, on the chosen backend.

    Args:
        cls: the task.
        control: name of a control; default: the first of the task.
        scenario: as :func:`~.scenario_choice.find_scenario` takes it.
        backend: "compiled", "numpy", "torch", or "auto": compiled where llvmlite is installed and the task can be
            traced, else NumPy.
        device: of torch, such as "cuda:1".
        threads: number of threads of the compiled backend.
        **keywords: parameters of the task. A keyword wins over the scenario, the scenario over the default.

    Raises:
        ValueError: for an unknown name or backend, a parameter out of its limits, a device that is not there, less
            than one thread, or the compiled backend for a task that cannot be compiled.
        ImportError: if the backend needs a library that is not installed.
    """
    check("threads", threads, int, ParameterLimits(at_least=1))
    xp, device = array_backend(backend, device)
    control = cls.controls[0] if control is None else control
    if not isinstance(control, str) or control not in (*cls.controls, *trained_banks(cls)):
        raise nearest("control", control, cls.controls)
    chosen = find_scenario(cls, scenario, keywords)
    parameters = cls.Parameters(**{**chosen.parameters, **keywords})
    if backend == "compiled" or (backend == "auto" and AVAILABLE):
        try:
            return compiled_model(cls, parameters, control, chosen.recording, threads)
        except NotTraceable as error:
            if backend == "compiled":
                raise ValueError(f"{cls.id} cannot be compiled: {error}") from error
            warn_not_compiled(cls.id, error)
    return Model(cls(parameters, xp, device, chosen.recording), control)


def array_backend(backend: str, device: Any = None) -> tuple[ModuleType, Any]:
    """Return the array namespace (NumPy or torch) and the device of a backend.

    Args:
        backend: one of ``BACKENDS``; all but "torch" compute on NumPy arrays.
        device: argument of ``torch.device``, such as "cuda:1"; None: the default (the CPU).

    Raises:
        ValueError: for an unknown backend, a device that NumPy does not have, or a device that is not there.
        ImportError: for the torch backend without torch.
    """
    if not isinstance(backend, str) or backend not in BACKENDS:
        raise nearest("backend", backend, BACKENDS)
    if backend != "torch":
        if device not in (None, "cpu"):
            raise ValueError(
                f"backend {backend!r} works on the CPU only, got device {device!r}; use backend='torch'"
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
        # Only an allocation tests every kind of device, also for float64.
        torch.zeros(1, dtype=torch.float64, device=chosen)
    except (RuntimeError, AssertionError, TypeError, NotImplementedError) as error:
        there = ["cpu", *(f"cuda:{i}" for i in range(torch.cuda.device_count()))]
        reason = str(error).strip().splitlines()[0].rstrip(".")
        raise ValueError(
            f"device {device!r} cannot be used ({reason}): choose from {', '.join(there)}"
        ) from error
    return xp, chosen
