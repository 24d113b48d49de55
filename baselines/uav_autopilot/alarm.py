"""Alarm of UavAutopilot: gusts, sensors or the plant are not as designed."""

from ..alarm import InnovationAlarm


class AutopilotAlarm(InnovationAlarm):
    """Alarm for innovations of a sensor that are larger, smaller or to one side."""

    window = 100
