"""What is kept of evaluations: files that are whole or as they were, datasets, the store of unfinished work.

Knows the rooms before ``evaluation`` and no other room of it. Begin with :mod:`.dataset`, which says what an evaluation
holds; :mod:`.files` writes, :mod:`.stored` checks what is read.
"""
