"""Estimation mathematics: pure functions on batches, without Gymnasium and without randomness.

Arrays carry the batch as their *last* axis: a state is ``(n, N)``, a covariance ``(n, n, N)``, a bank of M
filters ``(n, M, N)`` and ``(n, n, M, N)``. Every function works on NumPy arrays and on torch tensors and
changes nothing in place, so that it can be compiled and differentiated.
"""
