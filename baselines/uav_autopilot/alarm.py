"""When something is wrong in UavAutopilot: gusts, sensors or the plant are not as designed."""

from ..alarm import InnovationAlarm


class AutopilotAlarm(InnovationAlarm):
    """Innovations of a sensor that are larger, smaller or to one side. A dropout is none: the filter is told of it."""

    window = 100
