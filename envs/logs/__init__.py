"""Logs of users: recorded flights, recorded measurements, logs of receivers, and truth in files of its own.

Knows the engine and the models of one's own. Begin with :mod:`.reading`, which finds what a file holds;
:mod:`.recorded_tables` reads tables, :mod:`.receiver_logs` the formats of receivers, :mod:`.flights`
trajectories that a simulation flies again.
"""
