"""Declarations of the author of an environment: task, world, filter, measurement, observation, parameters, causes.

Imports ``filters`` only. Begin with :mod:`.task`; then read :mod:`.world` (truth and sensors), :mod:`.filter`
(estimators) and :mod:`.model` (both together, one step at a time).
"""
