"""Readers of users' logs: recorded flights, recorded measurements, receiver logs, and files of the truth.

Imports the engine and the state-space models. Begin with :mod:`.reading`, which detects the kind of a file;
:mod:`.recorded_tables` reads tables, :mod:`.receiver_logs` the formats of receivers, :mod:`.flights`
trajectories that a simulation flies again.
"""
