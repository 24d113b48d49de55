"""The environment ManeuveringTarget; ``task.py`` declares its parts."""

ID = "filtergym/ManeuveringTarget-v0"
"""Gymnasium id, readable without importing the task."""
