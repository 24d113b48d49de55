"""The report on a recommended filter as one self-contained page: sentences, tables, checks of the log, pictures.

Time in pictures is in seconds since the first row of the log.
"""

import math
from collections.abc import Iterator, Sequence
from typing import Any

import numpy
import xarray

from ...baselines.advice import Advice
from ...baselines.fitting import DROP
from ...envs.contract.companions import find_companion
from ...envs.contract.log_format import LogFormat
from ...envs.contract.task import Task
from ...evaluation.competitors.likelihood import Span
from ...evaluation.running.metrics import chi_square_band
from ...evaluation.statistics.innovations import measured_quantities
from ..tables.advice import (
    PRICES,
    ParameterText,
    advice_columns,
    advice_rows,
    parameter_name,
    parameter_size,
    parameter_text,
    price_rows,
    reading_lines,
    verdict,
)
from ..tables.results import Settings
from .html_page import pack, render_page

MOST_EPISODES = 12
"""Largest number of drawn episodes."""
MOST_POINTS = 4000
"""Largest number of points of a line; of longer recordings every second, third ... is drawn."""
WINDOWS_OF_NIS = 40
"""Largest number of windows of a recording for its mean NIS, and least number of measurements in one."""
SHORTEST_WINDOW = 10
DIGITS = 6
ROLES = {"fitted": "fitted to", "chosen": "chosen by", "judged": "judged by"}


def advice_html(
    advice: Advice, task: Task, sentences: Sequence[str], learned: Sequence[str], settings: Settings
) -> str:
    """Return the HTML report on the filter that is recommended for a recording."""
    replay = advice.replay()
    return render_page(
        "advice.html.jinja",
        "advice.js",
        name=advice.recording.name,
        verdict=verdict(advice),
        sentences=sentences,
        fitted=advice.fitted.name,
        advised=advice.advised.name,
        parameters=list(_parameters(advice, advice.fitted.name)),
        rows=list(advice_rows(advice, learned)),
        columns=[title.replace("-\n", "") for title in advice_columns(advice)],
        price_columns=list(PRICES),
        prices=price_rows(advice, learned),
        families=[
            (name, list(_parameters(advice, name))) for name in advice.fits if name not in advice.diverging
        ],
        has_truth=advice.recording.truth is not None,
        rival=advice.rival,
        diverging=advice.diverging,
        log=list(_log_lines(advice)),
        noted=bool(advice.recording.notes),
        settings=settings,
        figures=pack(
            {
                "names": _drawn_names(advice),
                "episodes": list(_episodes(advice, replay, task)),
                "profiles": list(_profiles(advice)),
                "drop": DROP,
            }
        ),
        has_track=measured_quantities(replay.isel(policy=0), task) is not None,
        has_innovations="prediction_error" in replay,
        has_nis="nis" in replay,
        has_onboard=advice.onboard is not None,
    )


def _drawn_names(advice: Advice) -> list[str]:
    """Return the filters drawn in pictures, by name, the advised one first."""
    return list(dict.fromkeys([advice.advised.name, advice.fitted.name, advice.rival]))


def _parameters(advice: Advice, name: str) -> Iterator[tuple[str, ParameterText]]:
    """Yield each parameter of a fitted filter as name and text, with its interval if computed."""
    tunable, found, profiles = advice.tunables[name], advice.fits[name], advice.profiles.get(name, {})
    for key, value in found.values.items():
        interval = profiles[key].interval if key in profiles else None
        yield parameter_name(key), parameter_text(key, value, interval, tunable, key in found.at_limit)


def _log_lines(advice: Advice) -> Iterator[str]:
    yield from reading_lines(advice.recording)
    share = advice.share
    counts = [
        sum(span.last - span.first for span in spans) for spans in (share.fitted, share.chosen, share.judged)
    ]
    yield (
        "Measurements for fit, choice and judgement: {:,} / {:,} / {:,}.".format(*counts)
        if share.apart
        else "Too few measurements to divide: all serve fit, choice and judgement."
    )


# --- pictures


def _episodes(advice: Advice, replay: xarray.Dataset, task: Task) -> Iterator[dict[str, Any]]:
    """Yield for each track of the recording the data that the page draws, by name."""
    recording = advice.recording
    for episode in range(min(replay.sizes["episode"], MOST_EPISODES)):
        rows = min(int(recording.rows[episode]), replay.sizes["time"])
        run = replay.isel(episode=[episode], time=slice(0, rows))
        seconds = recording.seconds[episode, :rows] + recording.started[episode]
        step = -(-rows // MOST_POINTS)
        found = {
            "name": recording.names[episode],
            "seconds": _numbers(seconds[::step]),
            "outlier_seconds": _numbers(seconds[advice.outliers[episode, :rows]]),
            "spans": list(_spans(advice, episode, seconds)),
            **_track(run, task, _drawn_names(advice), step, advice.outliers[episode, :rows]),
            **_innovations(run, advice.advised.name, step),
            **_onboard(advice, episode, rows, step),
        }
        if "nis" in run:
            found["nis"] = [_mean_nis(run, name, seconds) for name in _drawn_names(advice)]
        yield found


def _numbers(values: numpy.ndarray) -> list[float | None]:
    """Return an array as a list of rounded floats, None for values that are not finite."""
    return [float(f"{value:.{DIGITS}g}") if math.isfinite(value) else None for value in values]


def _spans(advice: Advice, episode: int, seconds: numpy.ndarray) -> Iterator[tuple[str, float, float]]:
    """Yield role ("fitted to", "chosen by", "judged by"), first and last second of an episode's stretches."""
    share = advice.share
    if not share.apart:
        return
    spans: list[tuple[str, Span]] = [
        (role, span) for role in ROLES for span in getattr(share, role) if span.episode == episode
    ]
    for role, span in spans:
        first, last = min(span.first, len(seconds) - 1), min(span.last, len(seconds) - 1)
        yield ROLES[role], float(seconds[first]), float(seconds[last])


def _track(
    run: xarray.Dataset, task: Task, names: Sequence[str], step: int, is_outlier: numpy.ndarray
) -> dict[str, Any]:
    """Return a track's measurements, estimates, truth and outliers by name, as lists of x and y."""
    measured = measured_quantities(run.isel(policy=0), task)
    log_format = find_companion(task, LogFormat)
    if measured is None or log_format is None:
        return {}
    group = log_format.predicted[0].group
    components = list(task.groups.get(group, (group,)))[:2]
    if not {*components} <= {one.name for one in task.components}:
        return {}  # a sensor of a model of one's own need not be named as a component
    units = [component.unit for component in task.components if component.name in components]
    chosen = run.sel(component=components).isel(episode=0, time=slice(None, None, step))
    found: dict[str, Any] = {
        "components": [
            f"{name.replace('_', ' ')}, {unit}" for name, unit in zip(components, units, strict=True)
        ],
        "measured": [_numbers(values[0, ::step]) for values in measured[: len(components)]],
        "outliers": [_numbers(values[0][is_outlier]) for values in measured[: len(components)]],
        "outlier_numbers": (numpy.flatnonzero(is_outlier) + 1).tolist(),
        "estimates": [
            [
                _numbers(values)
                for values in chosen["estimate"].sel(policy=name).transpose("component", "time").values
            ]
            for name in names
        ],
    }
    if "truth" in chosen:
        true = chosen["truth"].isel(policy=0).transpose("component", "time").values
        found["truth"] = [_numbers(values) for values in true]
    return found


def _onboard(advice: Advice, episode: int, rows: int, step: int) -> dict[str, Any]:
    """Return the positions by the vehicle's own filter at every ``step``-th fix; empty without one."""
    if advice.onboard is None:
        return {}
    places = advice.onboard.positions[episode, :rows:step]
    return {"onboard": [_numbers(axis) for axis in places.T]}


def _innovations(run: xarray.Dataset, name: str, step: int) -> dict[str, Any]:
    """Return a competitor's normalised innovations, at each time scaled to squares that sum to the NIS."""
    if "prediction_error" not in run or "nis" not in run:
        return {}
    groups = run["measured_group"].values
    one = run.sel(policy=name).isel(episode=0, measured=groups == groups[0])
    values, nis = one["prediction_error"].values, one["nis"].values
    length = numpy.sqrt((values**2).sum(axis=-1))
    with numpy.errstate(divide="ignore", invalid="ignore"):
        scaled = values * (numpy.sqrt(nis) / length)[:, None]
    return {
        "measured_names": [str(each) for each in one["measured"].values],
        "innovations": [_numbers(each[::step]) for each in scaled.T],
    }


def _mean_nis(run: xarray.Dataset, name: str, seconds: numpy.ndarray) -> dict[str, Any]:
    """Return the mean NIS per degree of freedom in windows of a track, with times, s, and chi-square band."""
    nis, degrees = (run[key].sel(policy=name).values[0] for key in ("nis", "nis_degrees"))
    there = numpy.flatnonzero(numpy.isfinite(nis) & (degrees > 0.0))
    size = max(SHORTEST_WINDOW, -(-len(there) // WINDOWS_OF_NIS))
    windows = [there[i : i + size] for i in range(0, len(there) - size + 1, size)]
    total = numpy.array([degrees[window].sum() for window in windows])
    low, high = chi_square_band(total) if len(total) else (total, total)
    return {
        "size": size,
        "seconds": _numbers(numpy.array([seconds[window].mean() for window in windows])),
        "mean": _numbers(numpy.array([nis[window].sum() / degrees[window].sum() for window in windows])),
        "low": _numbers(low / total),
        "high": _numbers(high / total),
    }


def _profiles(advice: Advice) -> Iterator[dict[str, Any]]:
    """Yield the profile likelihood of each parameter of the fitted filter, as data of the page."""
    name = advice.fitted.name
    for key, profile in advice.profiles[name].items():
        plain = key.removeprefix("log10_")
        unit = advice.tunables[name].units.get(plain, "")
        values = numpy.array([parameter_size(key, value) for value in profile.values])
        yield {
            "title": parameter_name(key) + (f", {unit}" if unit else ""),
            "is_log": key.startswith("log10_"),
            "values": _numbers(values),
            "drops": _numbers(profile.drops),
            "ends": [parameter_size(key, profile.interval.low), parameter_size(key, profile.interval.high)],
            "best": parameter_size(key, advice.fits[name].values[key]),
        }
