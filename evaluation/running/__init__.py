"""Evaluations: competitors side by side on identical noise, their times, records, curves and summaries.

Begin with :mod:`.evaluate`; below it :mod:`.rollout` runs the episodes of one competitor, and :mod:`.summary`
reduces them block by block.
"""
