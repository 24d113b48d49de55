"""Engine of tasks: episodes side by side, steps in NumPy or compiled, noise by counter, names and scenarios of tasks.

Knows the contract and the data. Begin with :mod:`.lanes`, which runs N episodes; :mod:`.compiled` makes their steps
code of the processor, and :mod:`.backend` chooses between that, NumPy and torch.
"""
