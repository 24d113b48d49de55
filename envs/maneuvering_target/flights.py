"""Scenarios in which every episode flies one of a user's flights."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy

from ..contract.companions import FlightScenarios
from ..contract.parameters import check, field_limits, freeze
from ..contract.task import Scenario
from ..data.trajectory import Trajectory
from ..logs.flights import Flights, flight_of
from .logs import FARTHEST_RANGE
from .parameters import ManeuveringTargetParameters

MOST_SCANS = 100_000
"""Largest number of scans of a set of flights: a week at 6 s."""


def _scenario_of_trajectory(trajectory: Trajectory, keywords: Mapping[str, Any]) -> Scenario:
    interval, _, horizon = _sampling(keywords)
    farthest = float(numpy.hypot(*trajectory.position.T).max())
    if farthest > FARTHEST_RANGE:
        raise ValueError(
            f"trajectory {trajectory.name!r} goes {farthest / 1e3:,.0f} km from the radar at the origin; "
            f"its range ends at {FARTHEST_RANGE / 1e3:,.0f} km (positions are metres)"
        )
    scans = trajectory.intervals(interval)
    if scans < 2:
        raise ValueError(
            f"trajectory {trajectory.name!r} lasts {trajectory.duration:g} s, which is less than two scans "
            f"of {interval:g} s: give a smaller sampling_interval"
        )
    horizon = scans if horizon is None else horizon
    track = trajectory.resample(interval, horizon + 2)
    return Scenario(
        trajectory.name,
        "A flight given by its positions.",
        {"flight": "track", "horizon": horizon, "track": tuple(map(tuple, track.tolist()))},
    )


def _sampling(keywords: Mapping[str, Any]) -> tuple[float, int, int | None]:
    """Return sampling interval (s), scans for which one action holds, and horizon or None, from keywords."""
    found: dict[str, Any] = {}
    for name in ("sampling_interval", "decision_interval", "horizon"):
        found[name] = getattr(ManeuveringTargetParameters, name) if name != "horizon" else None
        if name in keywords:
            found[name] = freeze(keywords[name])
            check(name, found[name], *field_limits(ManeuveringTargetParameters)[name])
    return found["sampling_interval"], found["decision_interval"], found["horizon"]


def scenario_of_flights(flights: Trajectory | Flights, keywords: Mapping[str, Any]) -> Scenario:
    """Return a scenario in which every episode flies one of a user's flights, to its end or the horizon."""
    if isinstance(flights, Trajectory):
        return _scenario_of_trajectory(flights, keywords)
    interval, held, horizon = _sampling(keywords)
    used, notes = flights.flyable(interval, FARTHEST_RANGE)
    if len(used) == 1:
        return replace(_scenario_of_trajectory(used[0], keywords), notes=tuple(notes))
    scans = [flight.intervals(interval) for flight in used]
    if horizon is not None:
        scans = [min(count, horizon) for count in scans]
    scans = [max(count - count % held, held) for count in scans]
    if sum(scans) > MOST_SCANS:
        raise ValueError(
            f"the flights of {flights.name!r} have {sum(scans):,} scans of {interval:g} s together, more than "
            f"{MOST_SCANS:,}: fly fewer, or give a smaller horizon"
        )
    tracks = [flight.resample(interval, count + 2) for flight, count in zip(used, scans, strict=True)]
    return Scenario(
        flights.name,
        "Flights given by their positions.",
        {
            "flight": "track",
            "horizon": max(scans),
            "track": tuple(map(tuple, numpy.concatenate(tracks, axis=1).tolist())),
            "track_scans": tuple(scans),
        },
        flights=tuple(map(flight_of, used)),
        notes=tuple(notes),
    )


FLIGHT_SCENARIOS = FlightScenarios(scenario_of_flights)
