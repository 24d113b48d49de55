"""What makes a solution of TightlyCoupledNavigation costly: each kind of motion, and each fault of a sensor."""

from collections.abc import Callable

from ..contract.causes import Cause, Moment
from ..contract.observation import Array
from .parameters import LINE, REST, SINGER

PULLED = 5.0
"""m by which a pseudorange is off from which it is wrong: noise is some metres."""


def _moves_as(hypothesis: int) -> Callable[[Moment], Array | None]:
    def holds(moment: Moment) -> Array | None:
        return moment.context["mode"] == hypothesis if moment.knows("mode") else None

    return holds


def _is_noisy(moment: Moment) -> Array | None:
    if not moment.knows("noise_factor"):
        return None
    noisy: Array = moment.xp.any(moment.context["noise_factor"] > 1.0, axis=0)
    return noisy


def _is_stuck(moment: Moment) -> Array | None:
    return moment.context["stuck_now"] > 0.0 if moment.knows("stuck_now") else None


def _lacks(rates: bool) -> Callable[[Moment], Array | None]:
    def holds(moment: Moment) -> Array | None:
        count = moment.measurement.satellite_position.shape[1]
        chosen = slice(count, 2 * count) if rates else slice(0, count)
        lacking: Array = moment.xp.any(moment.measurement.available[chosen] < 0.5, axis=0)
        return lacking

    return holds


def _is_pulled(moment: Moment) -> Array | None:
    if not moment.knows("range_error"):
        return None
    pulled: Array = moment.xp.any(moment.xp.abs(moment.context["range_error"]) > PULLED, axis=0)
    return pulled


CAUSES = (
    Cause("rest", "at rest", _moves_as(REST)),
    Cause("straight", "in straight flight", _moves_as(LINE)),
    Cause("manoeuvre", "in manoeuvres", _moves_as(SINGER)),
    Cause("stuck accelerometers", "while the accelerometers are stuck", _is_stuck),
    Cause("noisy rate", "while a pseudorange rate is too noisy", _is_noisy),
    Cause("range lost", "where a pseudorange is missing", _lacks(rates=False)),
    Cause("rate lost", "where a pseudorange rate is missing", _lacks(rates=True)),
    Cause("wrong range", f"where a pseudorange is off by more than {PULLED:g} m", _is_pulled),
)
