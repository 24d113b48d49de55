"""RadarEsmTracking: everything of one environment; ``task.py`` names it all."""

ID = "filtergym/RadarEsmTracking-v0"
"""Known before anything else is imported."""
