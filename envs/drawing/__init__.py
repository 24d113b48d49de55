"""Pictures of a running episode.

Knows the contract, and imports matplotlib. Begin with :mod:`.rendering`, whose general picture draws every task.
"""
