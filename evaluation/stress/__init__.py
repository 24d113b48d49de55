"""Crash test of filters by alterations of their measurements, as they happen in the field.

Begin with :mod:`.alterations`, the list of alterations; :mod:`.streams` records measurements, :mod:`.crash_test` runs a
filter on all alterations and rates it.
"""
