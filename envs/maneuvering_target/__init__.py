"""ManeuveringTarget: everything of one environment; ``task.py`` names it all."""

ID = "filtergym/ManeuveringTarget-v0"
"""Known before anything else is imported."""
