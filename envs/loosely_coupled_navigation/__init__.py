"""LooselyCoupledNavigation: everything of one environment; ``task.py`` names it all."""

ID = "filtergym/LooselyCoupledNavigation-v0"
"""Known before anything else is imported."""
