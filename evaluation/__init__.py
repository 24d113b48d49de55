"""Evaluation of competitors: runs, statistics and figures of their episodes.

It takes objects, not names of competitors. Its rooms, in this order: ``storage``, ``statistics``, ``competitors``,
``running``, ``figures``.
"""
