"""What runs a task: episodes side by side, steps in NumPy or compiled, noise by counter, Gymnasium's classes.

Knows the contract, the data and the drawing. Begin with :mod:`.environment`, the Gymnasium classes; under them
:mod:`.lanes` runs N episodes, and :mod:`.compiled` makes their steps code of the processor.
"""
