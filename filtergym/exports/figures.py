"""What is known of an exported filter: what it costs, and how far it is from the filter that was judged."""

from typing import NamedTuple


class Figures(NamedTuple):
    """What is known of an exported filter."""

    operations: int
    """Of an update, without those of a network."""
    state_bytes: int
    constant_bytes: int
    """Of a network's weights."""
    scratch_bytes: int
    """On the stack, beside the state."""
    difference: float
    """Largest one to the competitor itself, in its standard deviations, see :func:`~.replay.run_filter`."""
    replaced: tuple[float, ...]
    """Constants that float does not have."""
    network_operations: int = 0
    """Of a network, where it is asked."""
    test: str = ""
    """What the compiled test has said; empty without a compiler."""
    reads_log: bool = False
    """Whether a program reads logs of the user."""


def operation_words(figures: Figures) -> str:
    """Return how many operations an update takes, those of a network beside those of the filter."""
    network = figures.network_operations
    return f"{figures.operations:,} operations an update" + (
        f" and {network:,} of the network where it is asked" if network else ""
    )
