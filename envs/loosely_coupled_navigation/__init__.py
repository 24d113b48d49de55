"""The environment LooselyCoupledNavigation; ``task.py`` declares its parts."""

ID = "filtergym/LooselyCoupledNavigation-v0"
"""Gymnasium id, readable without importing the task."""
