"""The crash test: what happens to measurements in the field, and what filters make of it.

Begin with :mod:`.alterations`, the list of what is done to measurements; :mod:`.streams` records them,
:mod:`.crash_test` runs a filter over all and judges it.
"""
