"""Who may compete: policies, estimators, smoothers, references, bounds, and how each is made a filter in the loop.

Knows ``storage`` and ``statistics`` and runs no episode by itself. Begin with :mod:`.kinds`; :mod:`.filters` puts each
kind into the loop, :mod:`.online` and :mod:`.stepping` take one measurement at a time.
"""
