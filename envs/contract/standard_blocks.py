"""Blocks that several problems show, each with its name, words, scale and bounds written once.

What a problem adds is the value where its state keeps that under another name, the endings of the rows, and words where
they say more than the usual ones.
"""

from collections.abc import Callable, Sequence
from types import ModuleType
from typing import Any, Literal

from ...filters import imm
from .observation import (
    ACTION,
    AVERAGE_OF_LOG1P,
    BOUNDED_LOG,
    KEPT_AS_LOG,
    KEPT_AS_LOG1P,
    LOG1P,
    SHARE,
    SIGNED_LOG,
    Array,
    Block,
    Compression,
    within,
)

Value = Callable[[Any, Any], Array]
"""From the bank's state and the measurement to the rows of a block."""
Interval = Literal["last", "mean"]
"""How a block is shown where one action holds for several measurements, see :class:`.Field`."""


def innovation_block(
    parts: Sequence[str] = (),
    value: Value = lambda f, _: f.innovation,
    text: str = "the innovation over its predicted sigma",
    name: str = "innovation",
    shown: Compression = SIGNED_LOG,
    over_interval: Interval = "last",
) -> Block:
    """Innovation over a deviation; by default the ``innovation`` that the state keeps."""
    return Block(name, value, text, parts, shown, over_interval=over_interval)


def average_block(name: str, value: Value, text: str, parts: Sequence[str] = ()) -> Block:
    """Average over the last measurements of what has both signs, such as an innovation."""
    return Block(name, value, text, parts, SIGNED_LOG)


def nis_block(parts: Sequence[str] = ()) -> Block:
    """Normalised innovation squared, ``nis`` of the state."""
    return Block("nis", lambda f, _: f.nis, "normalised innovation squared", parts, LOG1P)


def log_squared_block(parts: Sequence[str] = ()) -> Block:
    """Normalised innovation squared, of which the state keeps the logarithm ``log_squared``."""
    return Block(
        "log_squared_innovation",
        lambda f, _: f.log_squared,
        "the normalised innovation squared",
        parts,
        KEPT_AS_LOG1P,
    )


def average_log_squared_block(average: str, parts: Sequence[str] = ()) -> Block:
    """Average of :func:`log_squared_block`, ``average_log_squared`` of the state.

    Args:
        average: over which measurements, in words.
        parts: endings of the rows.
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
    """Normalised innovation squared that a bank of hypotheses expects; zero where nothing was received.

    Args:
        xp: array namespace.
        received: from a measurement to booleans, ``(N,)``.
        text: what it is.
        over_interval: how it is shown over several measurements.
    """
    return Block(
        "squared_innovation",
        lambda f, measurement: xp.where(received(measurement), f.likelihood.nis, 0.0),
        text,
        shown=LOG1P,
        over_interval=over_interval,
    )


def relative_likelihood_block(
    xp: ModuleType,
    parts: Sequence[str],
    text: str = "the log-likelihood minus the largest one, nats",
    shown: Compression = SIGNED_LOG,
    name: str = "log_likelihood",
    value: Callable[[Any], Array] = lambda f: f.log_likelihood,
) -> Block:
    """Log-likelihoods of the hypotheses, less the largest; by default ``log_likelihood`` of the state."""
    return Block(name, lambda f, _: value(f) - xp.max(value(f), axis=0), text, parts, shown)


def log_density_block(
    value: Value, text: str, name: str = "log_likelihood", over_interval: Interval = "last"
) -> Block:
    """Log-density of a measurement in its usual units."""
    return Block(name, value, text, shown=BOUNDED_LOG, over_interval=over_interval)


def log_predicted_block(
    parts: Sequence[str], text: str = "the logarithm of the predicted probability"
) -> Block:
    """Logarithms of the predicted probabilities, ``log_predicted`` of the state."""
    return Block("log_predicted", lambda f, _: f.log_predicted, text, parts, SIGNED_LOG)


def predicted_block(parts: Sequence[str], measurement: str = "measurement", of: str = "") -> Block:
    """Logarithms of the probabilities ``predicted`` by a bank of hypotheses.

    Args:
        parts: endings of the rows.
        measurement: what a measurement is called.
        of: of what they are probabilities, such as " of the level".
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
    """Probabilities of hypotheses, by default ``probabilities`` of the state; rounding may not leave 0 to 1."""
    return Block(name, lambda f, _: xp.clip(value(f), 0.0, 1.0), text, parts, SHARE)


def entropy_block(xp: ModuleType) -> Block:
    """Entropy of the hypotheses, ``entropy`` of the state."""
    return Block(
        "entropy",
        lambda f, _: xp.clip(f.entropy, 0.0, 1.0),
        "entropy of the hypotheses then over the largest possible",
        shown=SHARE,
    )


def prior_block(
    parts: Sequence[str] = (),
    text: str = "the sigma of the predicted position over that of the measurement",
    value: Value = lambda f, _: f.prior,
) -> Block:
    """Deviation of the prediction over that of the measurement; the state keeps the logarithm ``prior``."""
    return Block("prior", value, text, parts, KEPT_AS_LOG)


def last_action_block(
    parts: Sequence[str] = (), name: str = "last_action", shown: Compression = ACTION
) -> Block:
    """Action that was applied before, ``action`` of the state."""
    return Block(name, lambda f, _: f.action, "action applied before", parts, shown)


def last_weight_block(
    parts: Sequence[str],
    value: Callable[[Any], Array] = lambda f: f.probabilities,
    text: str = "weight in force before this scan",
) -> Block:
    """Weights of the hypotheses that were in force before; by default ``probabilities`` of the state."""
    return Block("last_weight", lambda f, _: value(f), text, parts, SHARE)


def availability_block(
    text: str = "1 where a value was received", parts: Sequence[str] = (), over_interval: Interval = "last"
) -> Block:
    """Whether a measurement was received, its ``available``."""
    return Block(
        "available",
        lambda _, measurement: measurement.available,
        text,
        parts,
        SHARE,
        over_interval=over_interval,
    )


def clock_block(xp: ModuleType, horizon: int, unit: str = "1") -> Block:
    """Share of the horizon that has passed, from the ``number`` of a measurement."""
    return Block(
        "time",
        lambda _, measurement: xp.astype(measurement.number, xp.float64) / horizon,
        "measurements so far over the horizon",
        shown=within(0.0, (horizon + 1) / horizon),
        unit=unit,
    )
