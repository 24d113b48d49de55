"""Causes of costs of RadarEsmTracking: each class, a change of it, silence, a second emitter, outliers."""

from collections.abc import Callable, Sequence

from ..contract.causes import OUTLIER, Cause, Moment, bins
from ..contract.faults import causes_of as of_disturbances
from ..contract.observation import Array
from .world import DISTURBANCES

AFTERMATH = 20.0
"""Number of scans that count as after a change of class: 10 s."""
RANGE_EDGES = (50.0, 100.0)
"""Edges of the classes of range, km."""


def _is_of_class(number: int) -> Callable[[Moment], Array | None]:
    def holds(moment: Moment) -> Array | None:
        return moment.context["target_class"] == number if moment.has_context("target_class") else None

    return holds


def _has_changed(moment: Moment) -> Array | None:
    if not moment.has_context("change_scan"):
        return None
    change, scan = moment.context["change_scan"], moment.measurement.scan
    return (change >= 0.0) & (scan >= change) & (scan < change + AFTERMATH)


def _is_silent(moment: Moment) -> Array | None:
    return moment.context["radiating"] <= 0.0 if moment.has_context("radiating") else None


def _has_second_emitter(moment: Moment) -> Array | None:
    return moment.context["second_emitter"] > 0.0 if moment.has_context("second_emitter") else None


def causes_of(classes: Sequence[str]) -> tuple[Cause, ...]:
    """Return the causes of cost of the task as one tuple, among them one for each class of target."""
    return (
        *(
            Cause(f"class {name}", f"on targets of class {name}", _is_of_class(s))
            for s, name in enumerate(classes)
        ),
        Cause("class change", f"in the {AFTERMATH:g} scans after a change of class", _has_changed),
        Cause("silence", "while the target is silent", _is_silent),
        Cause("second emitter", "beside a second emitter", _has_second_emitter),
        OUTLIER,
        *bins("range", "km", "at ranges", RANGE_EDGES, lambda moment: moment.state[0] / 1e3),
        *of_disturbances(DISTURBANCES),
    )
