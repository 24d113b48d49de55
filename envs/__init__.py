"""Tasks, their scenarios, and the Gymnasium classes over them.

The contract stands in :mod:`.task`. A new environment is a module in :mod:`.tasks` and a table of scenarios
in :mod:`.scenarios`; nothing else in this folder changes.
"""
