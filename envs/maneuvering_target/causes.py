"""Causes of cost in ManeuveringTarget: manoeuvres, scans that miss the target, outliers, range."""

from ..contract.causes import MISSED, OUTLIER, Cause, Moment, bins, context_flag
from ..contract.faults import causes_of
from ..contract.observation import Array
from .disturbances import DISTURBANCES

AFTERMATH = 5.0
"""Number of scans in which a filter recovers from a manoeuvre."""
RANGE_EDGES = (30.0, 60.0, 120.0)
"""Limits of range classes, km; the error across the beam grows with the range."""


def _recovers(moment: Moment) -> Array | None:
    if not moment.has_context("maneuver_last"):
        return None
    since = moment.measurement.scan - moment.context["maneuver_last"]
    ended = (moment.context["maneuver_last"] >= 0.0) & (since > 0.0) & (since <= AFTERMATH)
    over: Array = moment.xp.any(ended, axis=0) & (moment.context["maneuvering"] <= 0.0)
    return over


def _flies_straight(moment: Moment) -> Array | None:
    if not moment.has_context("maneuvering"):
        return None
    straight, recovering = moment.context["maneuvering"] <= 0.0, _recovers(moment)
    return straight if recovering is None else straight & ~recovering


def _range(moment: Moment) -> Array:
    x, y = moment.state[0], moment.state[1]
    distance: Array = moment.xp.sqrt(x * x + y * y) / 1e3
    return distance


CAUSES = (
    Cause("manoeuvre", "in turns and other manoeuvres", context_flag("maneuvering")),
    Cause("recovery", f"in the {AFTERMATH:g} scans after a manoeuvre", _recovers),
    Cause("straight", "on straight legs", _flies_straight),
    MISSED._replace(phrase="where a scan misses the target"),
    OUTLIER,
    *bins("range", "km", "at ranges", RANGE_EDGES, _range),
    *causes_of(DISTURBANCES),
)
