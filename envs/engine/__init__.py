"""Engine of tasks: episodes side by side, steps in NumPy or compiled, noise by counter, names and scenarios of tasks.

Imports the contract and the data. Begin with :mod:`.lanes`, which runs N episodes; :mod:`.compiled` compiles their
steps, and :mod:`.backend` chooses between compiled code, NumPy and torch.
"""
