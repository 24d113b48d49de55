"""What is kept of every measurement of an episode, and of the first episodes only."""

import math
from typing import Any

from ...envs.contract.model import Episode, Model
from ...envs.engine.programs import Report
from ...envs.engine.reward import charge
from ...filters.gaussian import log_density

DRAWN_PREFIX = "drawn_"
"""Begins the names of what is kept of the first episodes only."""


def measurement_report(model: Model, episode: Episode) -> dict[str, Any]:
    """What is kept of every measurement, arrays ``(..., N)``."""
    error = model.error(episode)
    return {
        "error": error,
        "cost": model.cost(episode),
        "charge": charge(model, episode),
        "causes": model.causes(episode),
        **_normalised_error(model, error, model.covariance(episode)),
        **model.records(episode),
    }


def _normalised_error(model: Model, error: Any, covariance: Any) -> dict[str, Any]:
    """Normalised squared error of the components whose truth is known, with their marginal covariance.

    Args:
        model: task with a filter.
        error: estimate minus truth, ``(C, N)``; NaN where the truth is not known.
        covariance: reported for it, ``(C, C, N)``.

    Returns:
        ``nees``, ``(N,)``; where some truth is not known, NaN where none is, and beside it how many components are
        known, ``nees_degrees``.
    """
    if model.task.has_whole_truth:
        return {"nees": log_density(error, covariance)[1]}
    xp = model.task.xp
    known = error == error  # no number differs from itself
    # A component of its own, with error zero: what remains is the quadratic form of the marginal covariance.
    pairs = known[:, None] & known[None]
    apart = xp.eye(len(model.task.components), dtype=error.dtype, device=error.device)[:, :, None]
    squared = log_density(xp.where(known, error, 0.0), xp.where(pairs, covariance, apart))[1]
    degrees = xp.sum(xp.where(known, 1.0, 0.0), axis=0)
    return {"nees": xp.where(degrees > 0.0, squared, math.nan), "nees_degrees": degrees}


def _expectation_report(model: Model, episode: Episode) -> dict[str, Any]:
    """What is kept where the truth is not known."""
    return model.records(episode)


def _expectation_and_track(model: Model, episode: Episode) -> dict[str, Any]:
    return {**_expectation_report(model, episode), **model.track(episode)}


def measurement_and_track(model: Model, episode: Episode) -> dict[str, Any]:
    """What is kept of every measurement, with what a track is drawn from."""
    return {**measurement_report(model, episode), **model.track(episode)}


def measurement_and_drawing(model: Model, episode: Episode) -> dict[str, Any]:
    """What is kept of every measurement, and what is kept of the first episodes only."""
    kept = measurement_report(model, episode) if model.task.has_truth else _expectation_report(model, episode)
    return {
        **kept,
        **{f"{DRAWN_PREFIX}{name}": values for name, values in model.picture_track(episode).items()},
    }


def track_and_drawing(model: Model, episode: Episode) -> dict[str, Any]:
    """What is kept of the first episodes, with what a track is drawn from."""
    return {**measurement_and_drawing(model, episode), **model.track(episode)}


def limits(model: Model, episode: Episode) -> dict[str, Any]:
    """What is kept of a bound."""
    return model.filter.records(episode.filter, episode.measurement)


def report_of(model: Model, tracks: bool) -> Report:
    """What is kept of every measurement of a task."""
    if model.task.has_truth:
        return measurement_and_track if tracks else measurement_report
    return _expectation_and_track if tracks else _expectation_report
