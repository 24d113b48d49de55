"""What makes a fusion of LooselyCoupledNavigation costly: outages, jamming, spoofing, unreported noise, outliers."""

from collections.abc import Callable

from ..contract.causes import MISSED, OUTLIER, Cause, Moment
from ..contract.observation import Array
from ..contract.schedules import within

UNREPORTED = 1.2
"""Noise of the receiver over what it reports, from which it is not reported."""


def _is_in(window: str) -> Callable[[Moment], Array | None]:
    def holds(moment: Moment) -> Array | None:
        return within(moment.measurement.number, moment.context[window]) if moment.knows(window) else None

    return holds


def _follows_outage(moment: Moment) -> Array | None:
    if not moment.knows("outage"):
        return None
    end = moment.context["outage"][1]
    since = moment.measurement.number - end
    return (end >= 0.0) & (since >= 0.0) & (since < AFTERMATH)


def _is_unreported(moment: Moment) -> Array | None:
    if not moment.knows("receiver_deviation"):
        return None
    return moment.context["receiver_deviation"] > UNREPORTED * moment.measurement.reported_deviation


AFTERMATH = 25.0
"""Measurements after an outage: a quarter of a second."""

CAUSES = (
    MISSED._replace(name="outage", phrase="in outages of the receiver"),
    Cause("after outage", f"in the {AFTERMATH:g} measurements after an outage", _follows_outage),
    Cause("jamming", "under jamming", _is_in("jamming")),
    Cause("spoofing", "under spoofing", _is_in("spoofing")),
    Cause("unreported noise", "where the receiver is noisier than it reports", _is_unreported),
    OUTLIER,
)
