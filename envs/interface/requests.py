"""Checks of the arguments of an environment: constructor options, seeds, reset options, actions."""

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import gymnasium
import numpy

from ...filters.array_namespace import host_array, is_tensor
from ..contract.observation import Array
from ..contract.parameters import ParameterLimits, check
from ..engine.catalogue import nearest

DTYPES = ("float64", "float32")
"""Types of observations and rewards; inside everything is float64."""
OBSERVATIONS = ("measured", "asymmetric")
"""Kinds of observation: measured values, or these with privileged values, for critics in training."""


def check_seed(seed: Any) -> int | None:
    """Return the seed of a reset as an int or None; raise ValueError if it is invalid."""
    if seed is None:
        return None
    if isinstance(seed, bool) or not isinstance(seed, int | numpy.integer) or seed < 0:
        raise ValueError(f"a seed is None or an integer of at least 0, got {seed!r}")
    return int(seed)


def check_options(options: Any, known: Iterable[str]) -> Mapping[str, Any]:
    """Return the options of a reset as a mapping; raise ValueError for another type or an unknown name."""
    if options is None:
        return {}
    if not isinstance(options, Mapping):
        raise ValueError(f"options of a reset are a dictionary or None, got {options!r}")
    for name in options:
        if name not in known:
            raise nearest("option of a reset", name, known)
    return options


FEW = 16
"""Largest count of numbers for which a check one by one is faster than NumPy."""


def _all_finite(values: Array) -> bool:
    if isinstance(values, numpy.ndarray) and values.size <= FEW:
        return all(map(math.isfinite, values.ravel().tolist()))
    # The sum is finite unless an entry is not, and costs a third of a check of every entry. It may overflow.
    with numpy.errstate(over="ignore", invalid="ignore"):
        return math.isfinite(values.sum()) or all(map(math.isfinite, values.reshape(-1).tolist()))


def check_action(space: gymnasium.Space[Any], action: Any, count: int | None) -> Array:
    """Return the action as an array or tensor; raise an error unless it lies in the action space."""
    if is_tensor(action):
        array, values = action, action.detach()
        floating, real = (
            values.is_floating_point(),
            str(values.dtype) != "torch.bool" and not values.is_complex(),
        )
    else:
        array = values = numpy.asarray(action)
        floating, real = values.dtype.kind == "f", values.dtype.kind in "fiu"
    if isinstance(space, gymnasium.spaces.Discrete):
        shape: tuple[int, ...] = () if count is None else (count,)
        n = int(space.n)
        if array.shape != shape or floating or not real or (values < 0).any() or (values >= n).any():
            raise _action_error(f"integer actions from 0 to {n - 1} of shape {shape}", values)
        return array
    assert space.shape is not None
    shape = space.shape if count is None else (count, *space.shape)
    if array.shape != shape or not real or not _all_finite(values):
        raise _action_error(f"finite actions of shape {shape}", values)
    return array


def _action_error(expected: str, action: Array) -> ValueError:
    shown = " ".join(numpy.array2string(host_array(action), threshold=8).split())
    return ValueError(f"expected {expected}, got {action.dtype} of shape {tuple(action.shape)}: {shown}")


@dataclass(frozen=True)
class EnvOptions:
    """Options of both Gymnasium environments beside task and parameters; see :class:`.TaskEnv`.

    Raises:
        ValueError: for a value that is not allowed.
    """

    reward: str | None
    """Kind of reward; None: the environment's own."""
    detailed_info: bool
    dtype: str
    context: bool
    observation: str

    def __post_init__(self) -> None:
        if not isinstance(self.dtype, str) or self.dtype not in DTYPES:  # a NumPy dtype equals its name
            raise nearest("dtype", self.dtype, DTYPES)
        if self.observation not in OBSERVATIONS:
            raise nearest("observation", self.observation, OBSERVATIONS)
        check("detailed_info", self.detailed_info, bool, ParameterLimits())
        check("context", self.context, bool, ParameterLimits())

    @property
    def privileged(self) -> bool:
        """Whether observations contain privileged values."""
        return self.observation == "asymmetric"
