"""Environment UavAutopilot; begin with ``task.py``."""

ID = "filtergym/UavAutopilot-v0"
"""Id of the environment, available without further imports."""
