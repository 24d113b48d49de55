"""How competitors are run and what their episodes come to: takes objects and knows no names.

Its rooms, in this order: ``storage``, ``statistics``, ``competitors``, ``running``, ``figures``.
"""
