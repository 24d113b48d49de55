"""The environment TightlyCoupledNavigation; ``task.py`` declares its parts."""

ID = "filtergym/TightlyCoupledNavigation-v0"
"""Gymnasium id, readable without importing the task."""
