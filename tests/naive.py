"""Naive oracles that several test files share."""

import gymnasium
import numpy
from filtergym.compiler.counter_numbers import numbers


def dense(rows, like):
    """Full Jacobian ``(m, n, ...)`` of rows given by their non-zero parts; ``like`` is a state ``(n, ...)``."""
    matrix = numpy.zeros((len(rows), *like.shape))
    for row, (columns, values) in zip(matrix, rows, strict=True):
        for column, value in zip(columns, values, strict=True):
            row[column] = value
    return matrix


def episode_numbers(seed, normals, uniforms, row_normals, row_uniforms, rows):
    """Random numbers of the episode of a seed, as the contract names them.

    Returns normals and uniforms of its start, and those of the measurements, ``(rows, ...)`` each.
    """
    identity = gymnasium.utils.seeding.np_random(seed)[0].bit_generator.random_raw(2)[:, None]
    start = numbers(identity, numpy.zeros(1, dtype=int), normals, uniforms)[:, 0]
    later = numbers(identity, numpy.arange(1, rows + 1)[:, None], row_normals, row_uniforms)[..., 0]
    return start[:normals], start[normals:], later[:, :row_normals], later[:, row_normals:]
