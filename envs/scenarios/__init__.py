"""One module for each environment: its immutable table of scenarios, ``SCENARIOS``."""
