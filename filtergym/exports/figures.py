"""Figures of an exported filter: its cost, and its difference to the evaluated filter."""

from typing import NamedTuple


class Figures(NamedTuple):
    """Figures of an exported filter: operations, bytes, difference to Python, and test output."""

    operations: int
    """Operations of an update, without those of a network."""
    state_bytes: int
    constant_bytes: int
    """Bytes of a network's weights."""
    scratch_bytes: int
    """Bytes on the stack, beside the state."""
    difference: float
    """Largest difference of the mean to the Python competitor's, in its standard deviations."""
    replaced: tuple[float, ...]
    """Constants that float cannot represent."""
    network_operations: int = 0
    """Operations of a network, where it is evaluated."""
    test: str = ""
    """Output of the compiled test; empty without a compiler."""
    reads_log: bool = False
    """Whether a program reads the user's logs."""


def operation_words(figures: Figures) -> str:
    """Return the number of operations of an update as text, those of a network apart."""
    network = figures.network_operations
    return f"{figures.operations:,} operations an update" + (
        f" and {network:,} of the network where it is evaluated" if network else ""
    )
