"""UavAutopilot: everything of one environment; ``task.py`` names it all."""

ID = "filtergym/UavAutopilot-v0"
"""Known before anything else is imported."""
