"""Tasks, their scenarios, and the Gymnasium classes over them.

The contract stands in :mod:`.task`, :mod:`.world` and :mod:`.filter`. A new environment is a folder of its own beside
them, found by its name; nothing else in this folder changes.
"""
