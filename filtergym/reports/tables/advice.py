"""Tables and sentences on a recommended filter, its parameters, and the reasons."""

import math
import textwrap
from collections.abc import Iterator, Mapping, Sequence
from typing import NamedTuple

import numpy
from rich.table import Table

from ...baselines.advice import APART, Advice
from ...baselines.fitting import DROP, IDENTIFIABLE, NOISE_SCALE, OUTLIER_SHARE, STARTS, WIDE, Fit, Interval
from ...baselines.judgement import JudgedFilter
from ...baselines.onboard import ONBOARD, ONE_IN
from ...baselines.table import Tunable
from ...envs.contract.log_format import deviation_words, is_assumed
from ...envs.data.recording import Recording
from ...evaluation.statistics.bootstrap import IntervalEstimate

MOST_OUTLIERS = 12
"""Largest number of outliers in a sentence."""
MOST_ROWS = 12
LEAST_CORRELATION = 0.1
"""Correlation of successive prediction errors from which a sentence mentions it."""
SMALL_SCALE = 0.3
"""Scale of the noise below which most of the error lasts longer than a measurement, or the stated
deviations are wrong.
"""
LARGE_SCALE = 5.0
"""Scale of the noise above which the measured motion may fit no model."""
NAME_WIDTH = 16
"""Columns of a name; longer ones are broken."""
COLUMNS = {"nats": 6, "less": 8, "RMSE": 6, "against, %": 8, "NIS": 4, "correl-\nation": 8}
"""Columns of the table, and their least widths, so that no number is cut."""
WITHHELD = {"with-\nheld": 6}
"""Column of the errors at withheld fixes, where a log contains the estimate of the vehicle's own filter."""
PRICES = {
    "operations": "operations",
    "state, bytes": "state_bytes",
    "weights, bytes": "weight_bytes",
    "stack, bytes": "stack_bytes",
}
"""Columns of the cost of an update, and the parts of a price."""
NEGLIGIBLE = 5e-4
"""Difference of errors that is zero in the digits of a sentence."""
FEW = 80
"""Number of measurements below which a sentence warns."""
FEWEST_MEASUREMENTS = 30
"""Least number of measurements of an informative log; a choice: six for each of some five parameters."""


def advice_table(advice: Advice, learned: Sequence[str]) -> Table:
    """Return a table of the advised filter, the other fitted ones, its rival and the next best filters."""
    recording = advice.recording
    has_truth = recording.truth is not None
    judged = sum(span.last - span.first for span in advice.share.judged)
    table = Table(
        title=f"{recording.name}: {judged:,} test measurements (95 % intervals)", title_justify="left"
    )
    table.add_column("filter", no_wrap=True)
    for title, width in advice_columns(advice).items():
        table.add_column(title, justify="right", min_width=width)
    for row in advice_rows(advice, learned):
        table.add_row("\n".join(textwrap.wrap(row.label, NAME_WIDTH)), *row.cells)
    what = "estimates" if has_truth else "predictions"
    table.caption = (
        "nats: log-likelihood per measurement where filters were chosen, less one nat in all for each fitted parameter."
        f"\nless, against: paired with {advice.rival}, the rival (the shipped filter chosen on the same measurements), "
        f"on the test measurements; RMSE: of {what}.\nNIS: mean, 1 where innovations are as large as predicted; "
        "correlation: of successive prediction errors, 0 where they are white."
    )
    if advice.onboard is not None:
        table.caption += f"\nwithheld: RMSE at {advice.onboard.fixes:,} withheld fixes, m."
    table.caption_justify = "left"
    return table


class Row(NamedTuple):
    """A row of the table that compares the recommended filter with others: name, label, cells."""

    name: str
    label: str
    cells: tuple[str, ...]
    """Cells in the order of :func:`advice_columns`."""


def advice_columns(advice: Advice) -> dict[str, int]:
    """Return the titles of the columns of :func:`advice_table`, with their least widths."""
    return {**COLUMNS, **({} if advice.onboard is None else WITHHELD)}


def advice_rows(advice: Advice, learned: Sequence[str]) -> Iterator[Row]:
    """Yield the rows of :func:`advice_table`: the advised filter first, the vehicle's own filter last."""
    errors = None if advice.onboard is None else advice.onboard.errors
    has_truth = advice.recording.truth is not None
    known = advice.rival, advice.best_shipped
    keep = [advice.advised, *(c for c in advice.competitors[1:] if c.fitted or c.name in known)]
    room = MOST_ROWS - len(keep)
    rest: list[JudgedFilter] = []
    for each in advice.competitors:  # a filter whose results on this log equal another's needs no row
        if each not in keep and not any(_has_same_results(each, other) for other in [*keep, *rest]):
            rest.append(each)
    agents = [c for c in rest if c.name in learned]
    keep += [*agents, *[c for c in rest if c not in agents][: max(room - len(agents), 0)]]
    for one in [c for c in advice.competitors if c in keep]:
        cells = (
            _number(one.log_likelihood),
            _interval(one.difference, "+.3f"),
            _number(one.error if has_truth else one.prediction),
            _interval(_percent(one.relative_error), "+.1f"),
            _number(one.nis, ".2f"),
            _interval(one.correlation, "+.2f"),
        )
        withheld = () if errors is None else (_number(errors.get(one.name, math.nan)),)
        yield Row(one.name, _label(advice, one), (*cells, *withheld))
    if errors is not None:
        yield Row(ONBOARD, ONBOARD, (*["-"] * len(COLUMNS), _number(errors[ONBOARD])))


def price_rows(advice: Advice, learned: Sequence[str]) -> list[tuple[str, tuple[str, ...]]]:
    """Return name and costs of an update of each filter of :func:`advice_table`; empty if none is known."""
    names = [row.name for row in advice_rows(advice, learned) if row.name != ONBOARD]
    prices = {name: advice.prices[name] for name in names}
    cells = {
        name: tuple("-" if price is None else f"{price[key]:,}" for key in PRICES.values())
        for name, price in prices.items()
    }
    return list(cells.items()) if any(prices.values()) else []


def price_table(advice: Advice, learned: Sequence[str]) -> Table | None:
    """Return a table of the cost of an update of each compared filter; None if none is known."""
    rows = price_rows(advice, learned)
    if not rows:
        return None
    table = Table(title="Cost of an update in C, in double precision", title_justify="left")
    table.add_column("filter", no_wrap=True)
    for title in PRICES:
        table.add_column(title, justify="right")
    for name, cells in rows:
        table.add_row(name, *cells)
    return table


def _has_same_results(one: JudgedFilter, other: JudgedFilter) -> bool:
    """Return whether two filters give the same numbers on a log; unknown likelihoods count as different."""
    compared = "log_likelihood", "gain", "difference", "prediction"
    return all(getattr(one, name) == getattr(other, name) for name in compared)


def reading_lines(recording: Recording) -> Iterator[str]:
    """Yield sentences on a log as it was read: size, deviations of its measurements, and notes."""
    seconds = recording.seconds
    steps = numpy.diff(seconds, axis=1)
    missed = ""
    if "available" in recording.measurements:
        there = numpy.arange(seconds.shape[1]) < recording.rows[:, None]
        count = int((recording.measurements["available"][there] == 0.0).sum())
        missed = f", {count:,} of them missed" if count else ""
    yield (
        f"{recording.name}: read {int(recording.rows.sum()):,} measurements after the start of "
        f"{len(recording.names)} track{'s' * (len(recording.names) > 1)}{missed}, {numpy.nanmedian(steps):.3g} s apart"
        f"{', with truth' if recording.truth is not None else ''}."
    )
    yield from _extent(recording)
    if int(recording.rows.sum()) < FEWEST_MEASUREMENTS:
        yield (
            f"Fewer than {FEWEST_MEASUREMENTS} measurements separate filters by chance alone: the advice below is a "
            "guess, and a longer log is better."
        )
    if recording.deviations:
        listed, source = deviation_words(recording.deviations), recording.deviations_from
        if is_assumed(source):
            yield f"Errors: {source}: {listed}. Their scale is fitted."
        else:
            yield f"Errors as stated: {listed} (median of {source})."
    yield from (note for note in recording.notes if not is_assumed(note))


def _extent(recording: Recording) -> Iterator[str]:
    """Yield a sentence on span and speeds of a log's positions, which reveals a wrong unit."""
    position = recording.measurements.get("position")
    if position is None:
        return
    there = numpy.isfinite(position).all(axis=-1) & (recording.measurements["available"] > 0.0)
    found = []
    for own, seconds, known in zip(position, recording.seconds, there, strict=True):
        step = max(1, int(known.sum()) // 20)  # far apart, noise is no speed
        moved = numpy.linalg.norm(numpy.diff(own[known][::step], axis=0), axis=-1)
        found.append(moved / numpy.diff(seconds[known][::step]))
    speeds = numpy.concatenate(found)
    if len(speeds):
        width, height = (
            f"{x:,.0f}" if x >= 100.0 else f"{x:.3g}" for x in numpy.ptp(position[there], axis=0)
        )
        yield f"Positions span {width} m by {height} m, at {numpy.median(speeds):.3g} m/s in the median."


def held_out_numbers(advice: Advice) -> dict[str, float | str | None]:
    """Return the advised filter's results on measurements withheld for judgement, by name; None: unknown."""
    one = advice.advised
    numbers = {
        "measurements": float(sum(span.last - span.first for span in advice.share.judged)),
        "rmse_of_estimates": one.error,
        "rmse_of_predictions": one.prediction,
        "nis": one.nis,
        "relative_error": one.relative_error.value,
        "relative_error_low": one.relative_error.low,
        "relative_error_high": one.relative_error.high,
    }
    rounded = {key: None if math.isnan(value) else float(f"{value:.6g}") for key, value in numbers.items()}
    return {**rounded, "relative_to": advice.rival}


def _label(advice: Advice, one: JudgedFilter) -> str:
    role = "fitted" if one.fitted else "rival" if one.name == advice.rival else ""
    role = "advised" if one is advice.advised else role
    return f"{one.name} ({role})" if role else one.name


def _percent(estimate: IntervalEstimate) -> IntervalEstimate:
    return IntervalEstimate(*(100.0 * value for value in estimate))


def _number(value: float, form: str = ".4g") -> str:
    return "-" if math.isnan(value) else format(value, form)


def _interval(estimate: IntervalEstimate, form: str) -> str:
    if math.isnan(estimate.value):
        return "-"
    if math.isnan(estimate.low) or estimate.low == estimate.high:
        return format(estimate.value, form)
    return f"{estimate.value:{form}} [{estimate.low:{form}}, {estimate.high:{form}}]"


def advice_lines(advice: Advice, learned: Sequence[str]) -> Iterator[str]:
    """Yield the lines of a recommendation: advised filter, its parameters, certainty, and unknown quantities."""
    one = advice.fitted
    yield verdict(advice)
    if one is not advice.advised:
        yield f"Of the fitted filters {one.name} comes closest, with"
    for line in parameter_lines(advice.tunables[one.name], advice.fits[one.name], advice.intervals):
        yield f"  {line}"
    yield from further_sentences(advice, learned)


def further_sentences(advice: Advice, learned: Sequence[str]) -> Iterator[str]:
    """Yield the sentences of :func:`advice_lines` after the parameters: certainty, and unknown quantities."""
    yield from _onboard(advice)
    yield from _hindsight(advice)
    yield from _fits(advice)
    yield from _likeliest(advice)
    yield from _outliers(advice)
    if not advice.tunables[advice.fitted.name].anchored:
        yield from _noise(advice)
    yield from _anchor(advice)
    yield from _warnings(advice)
    yield from _agents(advice, learned)


def parameter_lines(tunable: Tunable, fit: Fit, intervals: Mapping[str, Interval]) -> Iterator[str]:
    """Yield a line for each fitted parameter of a filter, with unit and interval."""
    for name, value in fit.values.items():
        text = parameter_text(name, value, intervals.get(name), tunable, name in fit.at_limit)
        line = " ".join(part for part in (parameter_name(name), *text[:3]) if part)
        yield line + (f": {text.remark}" if text.remark else "")


def verdict(advice: Advice) -> str:
    """Return the first sentence of a recommendation: a filter, and its error against its rival's."""
    one, rival = advice.fitted, advice.rival
    judged = sum(span.last - span.first for span in advice.share.judged)
    where = (
        f"on {judged:,} measurements on which neither was chosen"
        if advice.share.apart
        else f"on the same {judged:,} measurements to which it was fitted, where its error is underestimated"
    )
    if one is not advice.advised and one.relative_error.low > 0.0 and one.gain.value > 0.0:
        return (
            f"Take {rival}, as it is shipped: {one.name}, fitted, predicts more likely and has "
            f"{_amount(advice, one.relative_error)} than it, {where}. The likelihood misleads here."
        )
    if one is not advice.advised:
        what = _interval(one.gain, "+.3f")
        text = (
            f"Take {rival}, as it is shipped: no fitted filter predicts better beyond chance "
            f"({one.name}: {what} nats per measurement, less the cost of its parameters)."
        )
        if not math.isnan(one.relative_error.value):
            text += f" {one.name} has {_amount(advice, one.relative_error)} than it, {where}."
            if one.relative_error.high < 0.0:
                text += " That is beyond chance: a longer log may turn the choice."
        return text
    name = f"Take {one.name}, with the parameters below"
    if one.gain.low <= 0.0 and not advice.tunables[one.name].anchored:
        name += f", as good as {rival} and cheaper"
    if math.isnan(one.relative_error.value) and advice.anchor is not None and one.name == advice.anchor.name:
        return f"{name}, by the second sensor: without a truth its gain is unknown."
    if math.isnan(one.relative_error.value):
        return f"{name}: {one.difference.value:+.3f} nats per measurement against {rival}, {where}."
    text = (
        f"{name}: {_amount(advice, one.relative_error)} than {rival}, the shipped filter chosen on the same "
        f"measurements, {where}."
    )
    if one.relative_error.low <= 0.0 <= one.relative_error.high:
        costs = _operations(advice, rival, one.name)
        is_dearer = advice.prices.operations(rival) > advice.prices.operations(one.name)
        text += " The difference may be chance"
        text += f"; {rival} {costs}." if costs and is_dearer else f": {rival} is good enough."
    return text


def _operations(advice: Advice, name: str, other: str) -> str:
    """Return a clause that compares the operations of an update of two filters; empty if one is unknown."""
    one, two = (advice.prices.operations(each) for each in (name, other))
    return f"takes {one:,.0f} operations an update for {two:,.0f}" if max(one, two) < math.inf else ""


def _amount(advice: Advice, relative: IntervalEstimate) -> str:
    """Return a relative error as text: ``3.1 % less error [1.0, 5.2]``."""
    value, low, high = _percent(relative)
    kind = "error" if advice.recording.truth is not None else "error of prediction"
    less = value <= 0.0
    text = f"{abs(value):.1f} % {'less' if less else 'more'} {kind}"
    if math.isnan(low):
        return text
    low, high = (-high, -low) if less else (low, high)
    return f"{text} [{low:.1f}, {high:.1f}]"


def _hindsight(advice: Advice) -> Iterator[str]:
    """Yield a sentence on the shipped filter of least error on the measurements withheld for judgement."""
    best, relative = advice.best_shipped, advice.hindsight
    if best in (advice.advised.name, advice.rival) or not abs(relative.value) >= NEGLIGIBLE:
        return
    count = sum(not c.fitted for c in advice.competitors)
    yield (
        f"In hindsight {best} is the best of the {count} shipped ones there: {advice.advised.name} has "
        f"{_amount(advice, relative)}. The best of many is best partly by luck."
    )


def _onboard(advice: Advice) -> Iterator[str]:
    """Yield a sentence on the errors of the vehicle's own filter, if the log has its estimates."""
    found = advice.onboard
    if found is None:
        return
    name, relative = advice.advised.name, _interval(_percent(found.relative), "+.1f")
    yield (
        f"One in {ONE_IN} of the fixes was withheld. At {found.fixes:,} of these, among the test measurements, the "
        f"estimates of {name} are off by {found.errors[name]:.3g} m, and those of the vehicle's own filter "
        f"({found.source}), {found.delay:.2f} s before, by {found.errors[ONBOARD]:.3g} m: {relative} %. That filter "
        "has used the earlier withheld fixes, which the others have not, and an inertial sensor: its row is an "
        "optimistic bound. Where errors of fixes last, filters that follow them come closer to the fixes, and no "
        "closer to the truth."
    )


def parameter_name(key: str) -> str:
    """Return a parameter's name in words, from its name in the search, such as ``log10_process_noise``."""
    return key.removeprefix("log10_").replace("_", " ")


def parameter_size(key: str, value: float) -> float:
    """Return a parameter's value, from its value in the search, which may be a decimal logarithm."""
    return float(10.0**value) if key.startswith("log10_") else float(value)


class ParameterText(NamedTuple):
    """A fitted parameter as texts: value, interval, unit and remark."""

    value: str
    interval: str
    unit: str
    remark: str
    """Meaning of an interval without two ends."""


def parameter_text(
    key: str, value: float, interval: Interval | None, tunable: Tunable, is_at_limit: bool
) -> ParameterText:
    """Return a fitted parameter as texts: value, interval, unit, and a remark if it is not identifiable.

    Args:
        key: name in the search.
        value: value in the search.
        interval: its interval, if computed.
        tunable: filter of the parameter.
        is_at_limit: whether it ended at a limit of the search.
    """
    unit = tunable.units.get(key.removeprefix("log10_"), "")
    text = ParameterText(f"{parameter_size(key, value):.3g}", "", unit, "")
    if interval is None:
        return text
    low, high = parameter_size(key, interval.low), parameter_size(key, interval.high)
    after = f" {unit}" if unit and " " not in unit else ""  # a unit with words stands once
    flat = (interval.open_low and interval.open_high) or (
        key.startswith("log10_") and high > IDENTIFIABLE * low
    )
    if flat:
        return text._replace(
            remark=f"not identifiable, the likelihood is flat over {low:.2g} to {high:.2g}{after}"
        )
    if is_at_limit:
        first, last = tunable.limits[key]
        if value - first < last - value:
            return text._replace(
                remark=f"at the lower limit of the search, the log supports at most {high:.3g}{after}"
            )
        return text._replace(
            remark=f"at the upper limit of the search, the log supports at least {low:.3g}{after}"
        )
    ends = [f"{'<' * interval.open_low}{low:.3g}", f"{'>' * interval.open_high}{high:.3g}"]
    return text._replace(interval=f"[{', '.join(ends)}]")


def _fits(advice: Advice) -> Iterator[str]:
    one = advice.fitted
    spread = advice.fits[one.name].spread
    if spread > DROP:
        yield (
            f"The likelihood of {one.name} has several maxima: the worst of its {STARTS} starts ended {spread:,.1f} "
            "nats below the best, whose values these are."
        )
    if advice.diverging:
        lose, diverge = ("loses", "it diverges") if len(advice.diverging) == 1 else ("lose", "they diverge")
        yield (
            f"Left out: {', '.join(advice.diverging)}, fitted, {lose} the track in the whole recording: {diverge}."
        )


def _likeliest(advice: Advice) -> Iterator[str]:
    """Yield a sentence on the filter of highest likelihood, where a cheaper one is advised."""
    if advice.likeliest is None or math.isnan(advice.likeliest[1].value):
        return
    name, gain = advice.likeliest
    costs = _operations(advice, name, advice.advised.name)
    yield (
        f"{name} is likelier where filters were chosen: it would bring {_interval(gain, '+.3f')} nats per measurement"
        f"{' and ' * bool(costs)}{costs}."
    )


def _outliers(advice: Advice) -> Iterator[str]:
    """Yield a sentence on the share of outliers, and where they are in the log."""
    found, recording = advice.outliers, advice.recording
    count = int(found.sum())
    if OUTLIER_SHARE not in advice.fits[advice.fitted.name].values:
        return
    share = 10.0 ** advice.fits[advice.fitted.name].values[OUTLIER_SHARE]
    text = (
        f"{advice.fitted.name} takes {100.0 * share:.1f} % of the measurements for outliers, with errors {WIDE:g} "
        "times as large"
    )
    if not count:
        yield f"{text}; in this log none is certain."
        return
    places = []
    for episode, k in numpy.argwhere(found)[:MOST_OUTLIERS]:
        track = f"{recording.names[episode]}: " if len(recording.names) > 1 else ""
        time = recording.seconds[episode, k] if recording.log_time is None else recording.log_time[episode, k]
        written = time if isinstance(time, str) else numpy.format_float_positional(float(time), trim="-")
        places.append(f"{track}{k + 1} (time {written})")
    more = f" and {count - len(places)} more" if count > len(places) else ""
    yield f"{text}: {count} here, measurements after the start {', '.join(places)}{more}."


def _noise(advice: Advice) -> Iterator[str]:
    """Yield sentences on the meaning of the fitted scale of the measurement noise."""
    one = advice.fitted
    if NOISE_SCALE in advice.fits[one.name].values:
        scale = 10.0 ** advice.fits[one.name].values[NOISE_SCALE]
        yield (
            f"The measurements' errors are {scale:.2f} times as large as stated, if they are white: errors that last "
            "longer than the motion are invisible without a second sensor, whatever the NIS."
        )
        if scale > LARGE_SCALE:
            yield (
                "That is far more than stated: the stated deviations are wrong, or the motion fits "
                "no fitted model."
            )
        if scale < SMALL_SCALE:
            yield (
                "That is far less than stated: either the stated deviations are wrong, or most of the error lasts "
                "from one measurement to the next. Then no filter of this sensor alone comes closer to the truth."
            )
    else:
        yield (
            "NIS and likelihood do not show errors that last longer than the motion: those are invisible without a "
            "second sensor."
        )


def _anchor(advice: Advice) -> Iterator[str]:
    """Yield sentences on whether a filter that uses a second sensor helps."""
    anchor = advice.anchor
    if anchor is None:
        return
    if anchor.name != advice.fitted.name:
        yield (
            f"The second sensor does not help here: by {anchor.name} measurements {APART:g} s apart are less likely by "
            f"{-anchor.gain:.2f} nats each than by {anchor.other}, both fitted to such."
        )
        return
    yield (
        f"The second sensor separates lasting errors from motion: measurements {APART:g} s apart are likelier by "
        f"{anchor.gain:.2f} nats each than by {anchor.other}, both fitted to such. From one measurement to the next "
        "filters without it may predict better, because they follow these errors: there likelihoods of both kinds do "
        "not compare, nor does NIS, and deviations are taken as they are stated."
    )
    yield "An error that never changes, or lasts longer than this recording, remains invisible."


def _warnings(advice: Advice) -> Iterator[str]:
    one, count = advice.advised, int(advice.recording.rows.sum())
    if count < FEW:
        yield f"{count} measurements are few: below {FEW} the parameters and the choice of a filter are uncertain."
    correlation = one.correlation
    sure = not math.isnan(correlation.low) and not correlation.low <= 0.0 <= correlation.high
    if sure and abs(correlation.value) > LEAST_CORRELATION:
        yield (
            f"Successive prediction errors are correlated ({correlation.value:+.2f}): the errors of measurements are "
            "not white, or the motion is none of the models'. The likelihood then misleads."
        )
    each = {name: of for name, of in one.correlations.items() if not math.isnan(of.low)}
    if each:
        shown = ", ".join(f"{name} {_interval(of, '+.2f')}" for name, of in each.items())
        yield f"Correlation of successive prediction errors, 0 where they are white, by sensor: {shown}."
    wide = [
        parameter_name(name)
        for name, interval in advice.intervals.items()
        if interval.open_low and interval.open_high
    ]
    if wide:
        yield (
            f"This recording does not determine: {', '.join(wide)}. It lacks the necessary motion, or is too short."
        )


def _agents(advice: Advice, learned: Sequence[str]) -> Iterator[str]:
    """Yield a sentence on learned agents with a larger error than the rival's."""
    found: list[JudgedFilter] = [
        c for c in advice.competitors if c.name in learned and not math.isnan(c.relative_error.value)
    ]
    worse = [c for c in found if c.relative_error.low > 0.0]
    if worse:
        each = ", ".join(f"{c.name} {100.0 * c.relative_error.value:+.0f} %" for c in worse)
        yield f"The learned agents were never trained on such data: {each} error against {advice.rival}."
