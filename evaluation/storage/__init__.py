"""Storage of evaluations: atomic files, datasets, and the store of unfinished work.

It imports the rooms before ``evaluation`` and no other room of it. Begin with :mod:`.dataset`, which describes the
contents of an evaluation; :mod:`.files` writes, :mod:`.stored` checks files while reading.
"""
