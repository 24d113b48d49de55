"""Evaluations: competitors side by side on identical noise, their times, records, curves and summaries.

Knows the rooms before it and draws nothing. Begin with :mod:`.evaluate`; under it :mod:`.rollout` runs the episodes of
one competitor, and :mod:`.summary` reduces them as they come.
"""
