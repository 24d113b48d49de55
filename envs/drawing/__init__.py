"""Pictures of a running episode.

Imports the contract and matplotlib. Begin with :mod:`.rendering`, whose general picture draws every task.
"""
