"""TightlyCoupledNavigation: everything of one environment; ``task.py`` names it all."""

ID = "filtergym/TightlyCoupledNavigation-v0"
"""Known before anything else is imported."""
