"""Causes of costs of UavAutopilot: commands, gusts, noisy sensors, dropouts."""

from ..contract.causes import Cause, Moment
from ..contract.faults import causes_of
from ..contract.observation import Array
from .disturbances import DISTURBANCES, RAISED

SETTLING = 20.0
"""Number of measurements that the loop needs to follow a new command."""


def _has_new_command(moment: Moment) -> Array | None:
    if not moment.has_context("command_times"):
        return None
    since = moment.measurement.number - moment.context["command_times"]
    recent: Array = moment.xp.any((since >= 0.0) & (since < SETTLING), axis=0)
    return recent


def _is_gusty(moment: Moment) -> Array | None:
    return moment.context["level"] >= RAISED if moment.has_context("level") else None


def _is_calm(moment: Moment) -> Array | None:
    if not moment.has_context("level", "sensor_level"):
        return None
    worst = moment.xp.max(moment.context["sensor_level"], axis=0)
    calm: Array = (moment.context["level"] < RAISED) & (worst < RAISED)
    return calm


CAUSES = (
    Cause("command", f"in the {SETTLING:g} measurements after a command", _has_new_command),
    Cause("disturbance", f"where the disturbance is at least {RAISED:g} times the nominal one", _is_gusty),
    Cause("calm", "where all noise is near its nominal level", _is_calm),
    *causes_of(DISTURBANCES),
)
