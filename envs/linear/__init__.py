"""Environments made from a state-space model: the world and its banks.

Imports the contract. Begin with :mod:`.state_space`; ``filtergym.state_space`` makes such an environment.
"""
