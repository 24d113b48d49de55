"""The environment RadarEsmTracking; ``task.py`` declares its parts."""

ID = "filtergym/RadarEsmTracking-v0"
"""Gymnasium id, readable without importing the task."""
