"""Competitors: policies, estimators, smoothers, references and bounds, and their adapters to filters in the loop.

It does not run episodes. Begin with :mod:`.kinds`; :mod:`.filters` adapts each kind to the loop,
:mod:`.online` and :mod:`.stepping` process one measurement at a time.
"""
