"""Pictures of evaluations: error over time, the front of cost and time, animations, the worst episodes.

Knows all other rooms of ``evaluation``. Begin with :mod:`.looks`, how each competitor is drawn; then
:mod:`.curve_figures`.
"""
