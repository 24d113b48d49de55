"""Declarations of the author of an environment: task, world, filter, measurement, observation, parameters, causes.

Knows the room of ``filters`` and nothing of how episodes are run, stored or drawn. Begin with :mod:`.task`; then read
:mod:`.world` (what happens), :mod:`.filter` (what estimates) and :mod:`.model` (both together, one step at a time).
"""
