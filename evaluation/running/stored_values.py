"""Values at every measurement of an episode that an evaluation stores."""

import math
from dataclasses import dataclass
from typing import Any

from ...envs.contract.model import Episode, Model
from ...envs.engine.reward import compressed_cost
from ...filters.gaussian import log_density

DRAWN_PREFIX = "drawn_"
"""Prefix of the names of values that are stored for the first episodes only, for pictures."""


def _normalised_error(model: Model, error: Any, covariance: Any) -> dict[str, Any]:
    """Return ``nees`` of the components with known truth, ``(N,)``, in a dictionary, and their number if it
    varies.
    """
    if model.task.has_whole_truth and model.filter.stated is None:
        return {"nees": log_density(error, covariance)[1]}
    xp = model.task.xp
    known = error == error  # no number differs from itself
    if model.filter.stated is not None:
        variance = xp.stack([covariance[i, i] for i in range(len(error))])
        known = known & (variance == variance)
    # Unknown components become independent with error zero: the rest is the quadratic form of the marginal covariance.
    pairs = known[:, None] & known[None]
    apart = xp.eye(len(model.task.components), dtype=error.dtype, device=error.device)[:, :, None]
    squared = log_density(xp.where(known, error, 0.0), xp.where(pairs, covariance, apart))[1]
    degrees = xp.sum(xp.where(known, 1.0, 0.0), axis=0)
    return {"nees": xp.where(degrees > 0.0, squared, math.nan), "nees_degrees": degrees}


@dataclass(frozen=True)
class StoredValues:
    """Function that returns the values to store at a measurement of a policy, estimator or reference."""

    tracks: bool = False
    """Whether to include the data for plots of tracks."""
    drawings: bool = False
    """Whether to include the data for pictures of tracks, under names that begin with :data:`DRAWN_PREFIX`."""

    def __call__(self, model: Model, episode: Episode) -> dict[str, Any]:
        """Return the values to store at a measurement by name, ``(..., N)``; errors and costs only with
        truth.
        """
        found = {}
        if model.task.has_truth:
            error = model.error(episode)
            found = {
                "error": error,
                "cost": model.cost(episode),
                "compressed_cost": compressed_cost(model, episode),
                "causes": model.causes(episode),
                **_normalised_error(model, error, model.covariance(episode)),
            }
        found |= model.records(episode)
        if self.drawings:
            shown = model.picture_track(episode)
            found |= {f"{DRAWN_PREFIX}{name}": values for name, values in shown.items()}
        return {**found, **model.track(episode)} if self.tracks else found


def bound_values(model: Model, episode: Episode) -> dict[str, Any]:
    """Return the values to store at a measurement of a bound by name, ``(..., N)``."""
    return model.filter.records(episode.filter, episode.measurement)
