"""Comparison of a vehicle's own filter with fitted and shipped filters on fixes withheld from the latter.

Every fifth fix of a log is withheld; filters run over the others and predict it. The estimates of the
vehicle's own filter come from the log, at the delay with the best agreement on the other fixes.

Leak: in flight that filter had every earlier fix, the withheld ones too, and an inertial sensor. So its error is an
optimistic bound of its error without the withheld fixes.
"""

import dataclasses
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy

from ..envs.data.recording import Recording
from ..envs.logs.onboard import OnboardTrack
from ..evaluation.statistics.bootstrap import IntervalEstimate
from ..evaluation.statistics.predictions import stretches_of
from ..filters.geodesy import PlaneOrigin
from .judgement import Share, roles_of
from .log_scores import PairSums, replay_log
from .problem import Problem

ONBOARD = "on-board"
"""Name of the vehicle's own filter in tables."""
ONE_IN = 5
"""Number of fixes of which one is withheld."""
DELAYS = numpy.arange(0.0, 1.0, 0.02)
"""Delays that are tried, s."""


class OnboardJudgement(NamedTuple):
    """Errors of the vehicle's own filter and of others on the withheld fixes of the judgement."""

    source: str
    """Name of the vehicle's filter: autopilot and topic."""
    delay: float
    """Delay of the fixes, s."""
    fixes: int
    errors: Mapping[str, float]
    """Root mean square of the distance from the fixes, m, by name."""
    relative: IntervalEstimate
    """Error of the advised filter over that of the vehicle's own, less one, paired."""
    positions: numpy.ndarray
    """Positions estimated by the vehicle's own filter at the fixes, m, ``(E, T, 2)``."""


def judge_onboard(
    problem: Problem,
    recording: Recording,
    keywords: Mapping[str, Any],
    share: Share,
    makers: Mapping[str, Any],
    track: OnboardTrack,
) -> OnboardJudgement | None:
    """Compare a vehicle's own filter with others on withheld fixes; None without its estimates at them."""
    times = recording.log_time
    if not recording.origin or times is None or times.dtype.kind != "f":
        return None
    measured, judged = recording.measurements, roles_of(share, recording.seconds.shape).judged
    there = (measured["available"] > 0.0) & (numpy.arange(judged.shape[1]) < recording.rows[:, None])
    withheld = there & (numpy.cumsum(there, axis=1) % ONE_IN == 0)
    origin, fixes = PlaneOrigin(**recording.origin), measured["position"]

    def squares(delay: float, where: numpy.ndarray) -> tuple[numpy.ndarray, numpy.ndarray]:
        positions = numpy.full_like(fixes, numpy.nan)
        positions[where] = track.at(times[where] - delay, origin)
        return ((positions - fixes) ** 2).sum(axis=-1), positions

    means = [
        numpy.nanmean(numpy.append(squares(delay, there & ~withheld)[0], numpy.inf)[:-1]) for delay in DELAYS
    ]
    if not numpy.isfinite(means).any():
        return None
    delay = float(DELAYS[numpy.nanargmin(means)])
    own, positions = squares(delay, there)
    mask = withheld & judged & numpy.isfinite(own)
    if not mask.any():
        return None
    replay = replay_log(problem.experiment(_withhold(recording, withheld), keywords=keywords), makers)
    found = replay["estimate"].sel(policy=list(makers), component=["position_x", "position_y"])
    estimates = found.transpose("policy", "episode", "time", "component").values
    stretches = stretches_of(mask)[:, : estimates.shape[2]]
    sums = PairSums(1 + len(makers), stretches)
    errors = ((estimates - fixes[:, : estimates.shape[2]]) ** 2).sum(axis=-1)
    sums.add(numpy.concatenate([errors, own[None, :, : estimates.shape[2]]]), 0)
    root_means = {name: float(numpy.sqrt(sums.mean(i))) for i, name in enumerate([*makers, ONBOARD])}
    relative = sums.relative_root(0, len(makers))
    return OnboardJudgement(track.source, delay, int((stretches >= 0).sum()), root_means, relative, positions)


def _withhold(recording: Recording, withheld: numpy.ndarray) -> Recording:
    """Return a copy of a recording in which some fixes are missed measurements."""
    measured = dict(recording.measurements)
    measured["available"] = numpy.where(withheld, 0.0, measured["available"])
    measured["position"] = numpy.where(withheld[..., None], 0.0, measured["position"])
    seen = numpy.where(measured["available"] > 0.0, recording.seconds, 0.0)
    before = numpy.maximum.accumulate(numpy.pad(seen, ((0, 0), (1, 0))), axis=1)[:, :-1]
    if "elapsed" in measured:  # since the last fix
        measured["elapsed"] = recording.seconds - before
    return dataclasses.replace(recording, measurements=measured)
