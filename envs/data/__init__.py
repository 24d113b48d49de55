"""What comes from outside: recordings, flights, tables, logs of receivers, truth in files of its own.

Knows the contract. Begin with :mod:`.recording`, what every log becomes; :mod:`.recorded_tables` reads tables,
:mod:`.receiver_logs` the formats of receivers, :mod:`.flights` trajectories that a simulation flies again.
"""
