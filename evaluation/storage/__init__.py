"""Storage of evaluations: atomic files, datasets, and the store of unfinished work.

Begin with :mod:`.dataset`, which describes the contents of an evaluation; :mod:`.files` writes,
:mod:`.stored` checks files while reading.
"""
