"""Observations: a list of blocks, from which fields, values and their decoding follow.

A :class:`Block` is one quantity of the observation: a function of the state of the filters, and the
:class:`Compression` of its values. The base class of the banks derives from the list the observation, and a
:class:`Reader` that inverts it.
"""

import functools
import math
from collections.abc import Callable, Sequence
from types import ModuleType
from typing import Any, Literal, NamedTuple

import numpy

from ...filters import imm

Array = Any


class Field(NamedTuple):
    """One component of the observation: name, unit and description."""

    name: str
    unit: str
    """Unit of the value in the observation; "1" for a pure number."""
    description: str
    """Meaning and scale."""
    over_interval: Literal["last", "mean"] = "last"
    """Value of the component when one action applies to several measurements: that at the last one, or the mean
    over all of them."""


class Compression(NamedTuple):
    """An invertible compression of observed values."""

    text: str
    """Text in front of the description of a block."""
    forward: Callable[[Array, ModuleType], Array] | None
    """Function from the value to the observation; None: no compression."""
    inverse: Callable[[numpy.ndarray], numpy.ndarray] | None
    """Function from the observation to the value; None where they are equal."""
    limits: tuple[float, float] = (-math.inf, math.inf)
    """Bounds of the observation space, for any state of the filters."""


def symlog(value: Array, xp: ModuleType) -> Array:
    """Return the symmetric logarithm ``sign(x) log(1 + |x|)``, close to x near zero."""
    return xp.sign(value) * xp.log1p(xp.abs(value))


def symexp(value: Array, xp: ModuleType) -> Array:
    """Return the inverse of :func:`symlog`: ``sign(y) (exp(|y|) - 1)``."""
    return xp.sign(value) * xp.expm1(xp.abs(value))


PLAIN = Compression("", None, None)
"""No compression and no limits."""


def limited(low: float, high: float) -> Compression:
    """Return the identity as a :class:`Compression`, for values within these limits."""
    return Compression("", None, None, (low, high))


SHARE = limited(0.0, 1.0)
ACTION = limited(-1.0, 1.0)
LARGEST_LOG = 710.0
"""Largest logarithm of a finite number; only that of zero is below the negative of :data:`SMALLEST_LOG`."""
SMALLEST_LOG = 746.0
SIGNED_LOG = Compression(
    "sign(x) log(1 + |x|) of ", symlog, lambda shown: symexp(shown, numpy), (-LARGEST_LOG, LARGEST_LOG)
)
LIMIT = 8.0
"""Upper bound of a bounded logarithm."""


def bounded_logarithm(value: Array, xp: ModuleType) -> Array:
    """Return ``y / (1 + |y| / 8)`` of ``y = symlog(value)``; its magnitude stays below 8."""
    logarithm = symlog(value, xp)
    return logarithm / (1.0 + (1.0 / LIMIT) * xp.abs(logarithm))


def bounded_exponential(compressed: numpy.ndarray) -> numpy.ndarray:
    """Return the inverse of :func:`bounded_logarithm`."""
    return symexp(compressed / (1.0 - numpy.abs(compressed) / LIMIT), numpy)


BOUNDED_LOG = Compression(
    "y / (1 + |y| / 8) with y = sign(x) log(1 + |x|) of ",
    bounded_logarithm,
    bounded_exponential,
    (-LIMIT, LIMIT),
)
"""Compression of values that a wrong hypothesis can make arbitrarily large."""
STORED_AS_LOG1P = Compression("log(1 + x) of ", None, numpy.expm1, (0.0, LARGEST_LOG))
"""The block's function returns log(1 + x) already, because the filters store that; reading gives x."""
LOG1P = Compression("log(1 + x) of ", lambda value, xp: xp.log1p(value), numpy.expm1, STORED_AS_LOG1P.limits)
AVERAGE_OF_LOG1P = limited(*STORED_AS_LOG1P.limits)
STORED_AS_LOG = Compression("log of ", None, numpy.exp, (-SMALLEST_LOG, LARGEST_LOG))
"""The block's function returns the logarithm already; reading gives the value."""


def linear_scale(
    factor: float, offset: float = 0.0, limits: tuple[float, float] = (-math.inf, math.inf)
) -> Compression:
    """Return the :class:`Compression` ``factor (x - offset)``, for values x within limits.

    Args:
        factor: above zero.
        offset: value that becomes zero.
        limits: of x.
    """
    low, high = (factor * (value - offset) for value in limits)
    return Compression(
        "", lambda value, xp: factor * (value - offset), lambda shown: shown / factor + offset, (low, high)
    )


class Block(NamedTuple):
    """One quantity of the observation, in one row or several."""

    name: str
    value: Callable[[Any, Any], Array]
    """Function from the bank's state and the measurement to ``(parts, N)``, or ``(..., N)`` with the parts in the order
    of their rows, or ``(N,)`` where there is only one."""
    text: str
    """Meaning, in words."""
    parts: Sequence[str] = ()
    """Suffixes of its rows: the fields are ``name_part``. Empty where one row is the field ``name``."""
    compression: Compression = PLAIN
    unit: str = "1"
    """Unit of the values in the observation."""
    over_interval: Literal["last", "mean"] = "last"


class Quantity(NamedTuple):
    """Quantity that a policy can compute from an observation, such as an innovation in metres."""

    name: str
    unit: str
    text: str
    value: Callable[[Callable[[str], numpy.ndarray]], numpy.ndarray]
    """Function that computes ``(N, parts)``; its argument reads blocks and other quantities by name."""


Reader = Callable[[numpy.ndarray], numpy.ndarray]
"""Function from observations ``(N, fields)`` to the values of one block or quantity, ``(N, parts)``."""


class Blocks:
    """Observation made of blocks, and the functions that decode it.

    Args:
        quantities: further quantities that can be read from it.

    Raises:
        ValueError: if two fields, or two blocks or quantities, have the same name.
    """

    def __init__(self, blocks: Sequence[Block], quantities: Sequence[Quantity], xp: ModuleType) -> None:
        self.blocks: tuple[Block, ...] = tuple(blocks)
        self.quantities: dict[str, Quantity] = {quantity.name: quantity for quantity in quantities}
        self.xp = xp
        self.fields: tuple[Field, ...] = tuple(
            Field(name, block.unit, block.compression.text + block.text, block.over_interval)
            for block in self.blocks
            for name in _field_names(block)
        )
        limits = [block.compression.limits for block in self.blocks for _ in _field_names(block)]
        self.limits: numpy.ndarray = numpy.array(limits).reshape(-1, 2).T
        """Lower and upper bounds of the observation, ``(2, fields)``."""
        names = [field.name for field in self.fields]
        known = [*(block.name for block in self.blocks), *self.quantities]
        for table in (names, known):
            if len(set(table)) != len(table):
                raise ValueError(f"names of an observation must differ, got {table}")
        # One call of a compression for all blocks that share it: calls cost more than numbers.
        shared: dict[Callable[[Array, ModuleType], Array], list[int]] = {}
        for i, block in enumerate(self.blocks):
            if block.compression.forward is not None:
                shared.setdefault(block.compression.forward, []).append(i)
        self._shared = [
            (forward, members, [len(_field_names(self.blocks[i])) for i in members])
            for forward, members in shared.items()
        ]
        self._values = [block.value for block in self.blocks]

    def observe(self, state: Any, measurement: Any) -> Array:
        """Return the observation, ``(fields, N)``, of a filter's state and a measurement."""
        xp = self.xp
        values = []
        for function in self._values:
            value = function(state, measurement)
            if value.ndim != 2:
                value = value[None] if value.ndim == 1 else xp.reshape(value, (-1, value.shape[-1]))
            values.append(value)
        for forward, members, widths in self._shared:
            if len(members) == 1:
                values[members[0]] = forward(values[members[0]], xp)
                continue
            together = forward(xp.concat([values[i] for i in members]), xp)
            first = 0
            for i, width in zip(members, widths, strict=True):
                values[i] = together[first : first + width]
                first += width
        return xp.concat(values)

    def columns(self, names: Sequence[str]) -> list[int]:
        """Return the positions of fields in the observation, by their names; ValueError for a name that is no field."""
        positions = {field.name: i for i, field in enumerate(self.fields)}
        missing = [name for name in names if name not in positions]
        if missing:
            raise ValueError(
                f"the observation has no field {', '.join(map(repr, missing))}: choose from {', '.join(positions)}"
            )
        return [positions[name] for name in names]

    @functools.cached_property
    def _slices(self) -> dict[str, slice]:
        slices, first = {}, 0
        for block in self.blocks:
            width = len(_field_names(block))
            slices[block.name] = slice(first, first + width)
            first += width
        return slices

    @functools.cached_property
    def _inverses(self) -> dict[str, Callable[[numpy.ndarray], numpy.ndarray] | None]:
        return {block.name: block.compression.inverse for block in self.blocks}

    def reader(self, name: str) -> Reader:
        """Return a function that computes a named block or quantity, uncompressed, from observations.

        Raises:
            ValueError: for a name that is neither.
        """
        if name in self._slices:
            return functools.partial(_read, part=self._slices[name], inverse=self._inverses[name])
        if name in self.quantities:
            value = self.quantities[name].value
            return lambda observation: value(lambda other: self.reader(other)(observation))
        raise ValueError(
            f"unknown quantity {name!r} of the observation: choose from "
            f"{', '.join([*self._slices, *self.quantities])}"
        )


class DecisionMeans:
    """Averages of observation fields over the measurements for which one action holds.

    Args:
        interval: measurements of a decision.

    Attributes:
        columns: positions of these fields; none where a decision has one measurement.
    """

    def __init__(self, fields: Sequence[Field], interval: int) -> None:
        self.interval = interval
        self.columns: list[int] = [
            i for i, f in enumerate(fields) if interval > 1 and f.over_interval == "mean"
        ]

    def add(self, total: Array, observation: Array) -> Array:
        """Return the sum of the averaged fields since the last decision with those of an observation added."""
        return total + observation[self.columns]

    def write(self, observation: numpy.ndarray, total: numpy.ndarray) -> None:
        """Replace the averaged fields of an observation, in place, by ``total`` divided by the interval."""
        observation[self.columns] = total / self.interval

    def show(self, observation: Array, total: Array, xp: ModuleType) -> Array:
        """Return a copy of an observation, ``(fields, N)``, with the averaged fields replaced by their means."""
        if isinstance(observation, numpy.ndarray):
            shown = observation.copy()
            self.write(shown, total)
            return shown
        means = {column: total[i] / self.interval for i, column in enumerate(self.columns)}
        rows = range(observation.shape[0])
        return xp.stack([means.get(i, observation[i]) for i in rows]) if means else observation


def _field_names(block: Block) -> list[str]:
    return [f"{block.name}_{part}" for part in block.parts] if block.parts else [block.name]


def _read(
    observation: numpy.ndarray, part: slice, inverse: Callable[[numpy.ndarray], numpy.ndarray] | None
) -> numpy.ndarray:
    shown = observation[:, part]
    return shown if inverse is None else inverse(shown)


# --- blocks of several problems, each with its name, words, scale and bounds; a problem adds the value where its state
# has another name for it, the suffixes of the rows, and words where they are more precise than the usual ones


Value = Callable[[Any, Any], Array]
"""Function from the bank's state and the measurement to the rows of a block."""
Interval = Literal["last", "mean"]
"""Value of a block where one action applies to several measurements, see :class:`.Field`."""


def innovation_block(
    parts: Sequence[str] = (),
    value: Value = lambda f, _: f.innovation,
    text: str = "the innovation over its predicted sigma",
    name: str = "innovation",
    compression: Compression = SIGNED_LOG,
    over_interval: Interval = "last",
) -> Block:
    """Return the observation block of the innovation divided by its predicted standard deviation."""
    return Block(name, value, text, parts, compression, over_interval=over_interval)


def average_block(name: str, value: Value, text: str, parts: Sequence[str] = ()) -> Block:
    """Return the observation block of a running average of a signed value, such as an innovation."""
    return Block(name, value, text, parts, SIGNED_LOG)


def nis_block(parts: Sequence[str] = ()) -> Block:
    """Return the observation block of the normalised innovation squared (NIS)."""
    return Block("nis", lambda f, _: f.nis, "normalised innovation squared", parts, LOG1P)


def log_squared_block(parts: Sequence[str] = ()) -> Block:
    """Return the observation block of ``log(1 + NIS)``."""
    return Block(
        "log_squared_innovation",
        lambda f, _: f.log_squared,
        "the normalised innovation squared",
        parts,
        STORED_AS_LOG1P,
    )


def average_log_squared_block(average: str, parts: Sequence[str] = ()) -> Block:
    """Return the observation block of the running average of ``log(1 + NIS)``.

    ``average`` names the measurements of the average, in words.
    """
    return Block(
        "average_log_squared_innovation",
        lambda f, _: f.average_log_squared,
        f"{average} of log_squared_innovation",
        parts,
        AVERAGE_OF_LOG1P,
    )


def expected_nis_block(
    xp: ModuleType,
    received: Callable[[Any], Array],
    text: str = "the hypotheses' mean normalised innovation squared",
    over_interval: Interval = "last",
) -> Block:
    """Return the observation block of a bank's NIS averaged over its hypotheses; 0 without a measurement.

    ``received`` is a function from a measurement to booleans, ``(N,)``; for ``over_interval`` see :class:`Field`.
    """
    return Block(
        "squared_innovation",
        lambda f, measurement: xp.where(received(measurement), f.likelihood.nis, 0.0),
        text,
        compression=LOG1P,
        over_interval=over_interval,
    )


def relative_likelihood_block(
    xp: ModuleType,
    parts: Sequence[str],
    text: str = "the log-likelihood minus the largest one, nats",
    compression: Compression = SIGNED_LOG,
    name: str = "log_likelihood",
    value: Callable[[Any], Array] = lambda f: f.log_likelihood,
) -> Block:
    """Return the observation block of each hypothesis' log-likelihood minus the largest one."""
    return Block(name, lambda f, _: value(f) - xp.max(value(f), axis=0), text, parts, compression)


def log_density_block(
    value: Value, text: str, name: str = "log_likelihood", over_interval: Interval = "last"
) -> Block:
    """Return the observation block of the log-density of a measurement under its prediction."""
    return Block(name, value, text, compression=BOUNDED_LOG, over_interval=over_interval)


def log_predicted_block(
    parts: Sequence[str], text: str = "the logarithm of the predicted probability"
) -> Block:
    """Return the observation block of log-predicted mode probabilities that the state stores."""
    return Block("log_predicted", lambda f, _: f.log_predicted, text, parts, SIGNED_LOG)


def predicted_block(parts: Sequence[str], measurement: str = "measurement", of: str = "") -> Block:
    """Return the observation block of a bank's predicted probabilities, as logarithms.

    ``measurement`` is the word for one, ``of`` words for the hypotheses, such as " of the level".
    """
    return Block(
        "log_predicted",
        lambda f, _: imm.log_probabilities(f.predicted),
        f"the logarithm of the probability{of} before the {measurement}",
        parts,
        SIGNED_LOG,
    )


def probability_block(
    xp: ModuleType,
    parts: Sequence[str],
    text: str,
    name: str = "probability",
    value: Callable[[Any], Array] = lambda f: f.probabilities,
) -> Block:
    """Return the observation block of the hypotheses' probabilities, clipped to [0, 1]."""
    return Block(name, lambda f, _: xp.clip(value(f), 0.0, 1.0), text, parts, SHARE)


def entropy_block(xp: ModuleType) -> Block:
    """Return the observation block of the entropy of the hypotheses' probabilities."""
    return Block(
        "entropy",
        lambda f, _: xp.clip(f.entropy, 0.0, 1.0),
        "entropy of the hypotheses then over the largest possible",
        compression=SHARE,
    )


def prior_block(
    parts: Sequence[str] = (),
    text: str = "the sigma of the predicted position over that of the measurement",
    value: Value = lambda f, _: f.prior,
) -> Block:
    """Return the observation block of the predicted over the measured standard deviation, as a logarithm."""
    return Block("prior", value, text, parts, STORED_AS_LOG)


def last_action_block(
    parts: Sequence[str] = (), name: str = "last_action", compression: Compression = ACTION
) -> Block:
    """Return the observation block of the previous action."""
    return Block(name, lambda f, _: f.action, "action applied before", parts, compression)


def last_weight_block(
    parts: Sequence[str],
    value: Callable[[Any], Array] = lambda f: f.probabilities,
    text: str = "weight before this scan",
) -> Block:
    """Return the observation block of the hypotheses' weights before this measurement."""
    return Block("last_weight", lambda f, _: value(f), text, parts, SHARE)


def availability_block(
    text: str = "1 where a value was received", parts: Sequence[str] = (), over_interval: Interval = "last"
) -> Block:
    """Return the observation block that is one where a measurement was received, else zero."""
    return Block(
        "available",
        lambda _, measurement: measurement.available,
        text,
        parts,
        SHARE,
        over_interval=over_interval,
    )


def clock_block(xp: ModuleType, horizon: int, unit: str = "1") -> Block:
    """Return the observation block of the share of the episode that has passed."""
    return Block(
        "time",
        lambda _, measurement: xp.astype(measurement.number, xp.float64) / horizon,
        "measurements so far over the horizon",
        compression=limited(0.0, (horizon + 1) / horizon),
        unit=unit,
    )
