"""Data from outside: recordings and trajectories that take the place of a simulated world, and the one door, with
limits, for foreign files.

Knows the contract. Begin with :mod:`.recording`, what every log becomes. The readers of logs stand in :mod:`..logs`.
"""
