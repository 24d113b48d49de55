"""Reports over environments: benchmark, comparison, room for improvement, training seeds, and their tables.

Its rooms, in this order: ``tables``, ``pages``.
"""
