"""Environments from a state-space model in a few lines: the world and its banks.

Knows the contract. Begin with :mod:`.state_space`; ``filtergym.state_space`` is the door to it.
"""
