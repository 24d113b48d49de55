"""Figures of evaluations: error over time, the front of cost and time, animations, the worst episodes.

Begin with :mod:`.looks`, the style of each competitor; then :mod:`.curve_figures`.
"""
