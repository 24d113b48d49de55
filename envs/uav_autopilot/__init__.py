"""The environment UavAutopilot; ``task.py`` declares its parts."""

ID = "filtergym/UavAutopilot-v0"
"""Gymnasium id, readable without importing the task."""
