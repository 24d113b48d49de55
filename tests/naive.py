"""Naive oracles that several test files share."""

import numpy


def dense(rows, like):
    """Full Jacobian ``(m, n, ...)`` of rows given by their non-zero parts; ``like`` is a state ``(n, ...)``."""
    matrix = numpy.zeros((len(rows), *like.shape))
    for row, (columns, values) in zip(matrix, rows, strict=True):
        for column, value in zip(columns, values, strict=True):
            row[column] = value
    return matrix
