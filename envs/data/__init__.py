"""Data from outside: recordings and trajectories that replace a simulated world, and safe reading of foreign files.

Imports the contract. Begin with :mod:`.recording`, the form of every log. The readers of logs are in :mod:`..logs`.
"""
