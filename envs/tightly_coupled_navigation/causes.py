"""Causes of cost in TightlyCoupledNavigation: each kind of motion, and each fault of a sensor."""

from collections.abc import Callable

from ..contract.causes import Cause, Moment
from ..contract.faults import causes_of
from ..contract.observation import Array
from .disturbances import DISTURBANCES
from .parameters import LINE, REST, SINGER


def _moves_as(hypothesis: int) -> Callable[[Moment], Array | None]:
    def holds(moment: Moment) -> Array | None:
        return moment.context["mode"] == hypothesis if moment.has_context("mode") else None

    return holds


CAUSES = (
    Cause("rest", "at rest", _moves_as(REST)),
    Cause("straight", "in straight flight", _moves_as(LINE)),
    Cause("manoeuvre", "in manoeuvres", _moves_as(SINGER)),
    *causes_of(DISTURBANCES),
)
