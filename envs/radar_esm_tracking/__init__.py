"""Environment RadarEsmTracking; begin with ``task.py``."""

ID = "filtergym/RadarEsmTracking-v0"
"""Id of the environment, available without further imports."""
