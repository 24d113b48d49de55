"""An advice in words and as a table: which filter, which numbers, and why."""

import math
import textwrap
from collections.abc import Iterator, Mapping, Sequence

from rich.table import Table

from ..baselines.advice import APART, Advice, Competitor
from ..baselines.fitting import IDENTIFIABLE, NOISE_SCALE, Fit, Interval
from ..baselines.table import Tunable
from ..evaluation.bootstrap import Estimate

MOST_ROWS = 12
LEAST_CORRELATION = 0.1
"""Of successive prediction errors, from which on it is spoken of."""
SMALL_SCALE = 0.3
"""Of the noise, below which most of the error must last longer than a measurement, or is not as stated."""
LARGE_SCALE = 5.0
"""Above which what was measured may be no motion."""
NAME_WIDTH = 16
"""Columns of a name; longer ones go on below."""
COLUMNS = {"nats": 6, "less": 8, "RMSE": 6, "against, %": 8, "NIS": 4, "correl-\nation": 8}
"""Of the table, and how wide they are at least, so that no number is cut."""
FEW = 80
"""Measurements below which an advice warns."""


def advice_table(advice: Advice, learned: Sequence[str]) -> Table:
    """Compare the advised filter with the other fitted ones, the best shipped and whoever follows.

    Args:
        advice: of :func:`~..baselines.advice.advise`.
        learned: names of shipped agents.
    """
    recording = advice.recording
    has_truth = recording.truth is not None
    judged = sum(span.last - span.first for span in advice.share.judged)
    table = Table(
        title=f"{recording.name}: {judged:,} measurements that judge (95 % intervals)", title_justify="left"
    )
    table.add_column("filter", no_wrap=True)
    for title, width in COLUMNS.items():
        table.add_column(title, justify="right", min_width=width)
    keep = [advice.advised, *(c for c in advice.competitors[1:] if c.fitted or c.name == advice.best_shipped)]
    room = MOST_ROWS - len(keep)
    rest = [c for c in advice.competitors if c not in keep]
    agents = [c for c in rest if c.name in learned]
    keep += [*agents, *[c for c in rest if c not in agents][: max(room - len(agents), 0)]]
    for one in [c for c in advice.competitors if c in keep]:
        table.add_row(
            "\n".join(textwrap.wrap(_label(advice, one), NAME_WIDTH)),
            _number(one.log_likelihood),
            _interval(one.difference, "+.3f"),
            _number(one.error if has_truth else one.prediction),
            _interval(_percent(one.relative_error), "+.1f"),
            _number(one.nis, ".2f"),
            _interval(one.correlation, "+.2f"),
        )
    what = "estimates" if has_truth else "predictions"
    table.caption = (
        "nats: log-likelihood per measurement where filters were chosen, less one nat in all for each fitted parameter."
        f"\nless, against: paired with {advice.best_shipped}, the best shipped, on the measurements that judge; "
        f"RMSE: of {what}.\nNIS: mean, 1 where innovations are as large as predicted; correlation: of successive "
        "prediction errors, 0 where they are white."
    )
    table.caption_justify = "left"
    return table


def _label(advice: Advice, one: Competitor) -> str:
    """Name of a filter, and what it is here."""
    role = "advised" if one is advice.advised else "fitted" if one.fitted else ""
    return f"{one.name} ({role})" if role else one.name


def _percent(estimate: Estimate) -> Estimate:
    return Estimate(*(100.0 * value for value in estimate))


def _number(value: float, form: str = ".4g") -> str:
    return "-" if math.isnan(value) else format(value, form)


def _interval(estimate: Estimate, form: str) -> str:
    if math.isnan(estimate.value):
        return "-"
    if math.isnan(estimate.low) or estimate.low == estimate.high:
        return format(estimate.value, form)
    return f"{estimate.value:{form}} [{estimate.low:{form}}, {estimate.high:{form}}]"


def advice_lines(advice: Advice, learned: Sequence[str]) -> Iterator[str]:
    """Say what is advised, with which numbers, how sure that is, and what cannot be known.

    Args:
        advice: of :func:`~..baselines.advice.advise`.
        learned: names of shipped agents.
    """
    one = advice.fitted
    yield _verdict(advice)
    if one is not advice.advised:
        lag = advice.advised.log_likelihood - one.log_likelihood
        yield f"Of what was fitted {one.name} comes closest, {lag:.3f} nats per measurement behind, with"
    for line in parameter_lines(advice.tunables[one.name], advice.fits[one.name], advice.intervals):
        yield f"  {line}"
    if not advice.tunables[one.name].anchored:
        yield from _noise(advice)
    yield from _anchor(advice)
    yield from _warnings(advice)
    yield from _agents(advice, learned)


def parameter_lines(tunable: Tunable, found: Fit, intervals: Mapping[str, Interval]) -> Iterator[str]:
    """Say what was fitted, parameter by parameter, with units and intervals.

    Args:
        tunable: what was fitted.
        found: the values.
        intervals: of the parameters.
    """
    for name, value in found.values.items():
        yield _parameter(name, value, intervals.get(name), tunable.units)


def _verdict(advice: Advice) -> str:
    """First sentence."""
    one, judged = advice.advised, sum(span.last - span.first for span in advice.share.judged)
    name = f"{one.name}, with the parameters below" if one.fitted else f"{one.name}, as it is shipped"
    where = (
        f"on {judged:,} measurements that it was not fitted to"
        if advice.share.apart
        else (f"on the same {judged:,} measurements that it was fitted to, which flatters it")
    )
    best = advice.best_shipped
    if one.name == best:
        return f"Take {name}: nothing that was fitted predicts better, and no shipped filter does better {where}."
    relative = _percent(one.relative_error)
    if advice.anchor is not None and one.name == advice.anchor.name and math.isnan(relative.value):
        return f"Take {name}, by the second sensor: there is no truth to say how much it gains."
    if math.isnan(relative.value):
        return f"Take {name}: {one.difference.value:+.3f} nats per measurement against {best}, {where}."
    kind = "error" if advice.recording.truth is not None else "error of prediction"
    amount = f"{abs(relative.value):.1f} % {'less' if relative.value <= 0.0 else 'more'} {kind}"
    sure = ""
    if not math.isnan(relative.low):
        low, high = (
            sorted((-relative.low, -relative.high))
            if relative.value <= 0.0
            else (relative.low, relative.high)
        )
        sure = f" [{low:.1f}, {high:.1f}]"
    text = f"Take {name}: {amount}{sure} than the best shipped filter there, {best}, {where}."
    if not math.isnan(relative.low) and relative.low <= 0.0 <= relative.high:
        text += f" The difference may be chance: {best} is good enough."
    return text


def _size(name: str, value: float) -> float:
    return 10.0**value if name.startswith("log10_") else value


def _parameter(name: str, value: float, interval: Interval | None, units: Mapping[str, str]) -> str:
    """A fitted parameter with its interval, and whether it can be known."""
    plain = name.removeprefix("log10_")
    unit = f" {units[plain]}" if plain in units else ""
    text = f"{plain.replace('_', ' ')} {_size(name, value):.3g}"
    if interval is None:
        return text + unit
    low, high = _size(name, interval.low), _size(name, interval.high)
    flat = (interval.open_low and interval.open_high) or (
        name.startswith("log10_") and high > IDENTIFIABLE * low
    )
    if flat:
        return f"{text}{unit}: not identifiable, the likelihood is flat over {low:.2g} to {high:.2g}{unit}"
    ends = [f"{'<' * interval.open_low}{low:.3g}", f"{'>' * interval.open_high}{high:.3g}"]
    return f"{text} [{', '.join(ends)}]{unit}"


def _noise(advice: Advice) -> Iterator[str]:
    """What the scale of the noise says, and what it does not."""
    one = advice.fitted
    if NOISE_SCALE in advice.fits[one.name].values:
        scale = 10.0 ** advice.fits[one.name].values[NOISE_SCALE]
        yield (
            f"The measurements' errors are {scale:.2f} times as large as stated, if they are white: errors that last "
            "longer than the motion are invisible without a second sensor, whatever the NIS."
        )
        if scale > LARGE_SCALE:
            yield (
                "That is far more than stated: the stated deviations are wrong, or what was measured moves like "
                "nothing that was fitted."
            )
        if scale < SMALL_SCALE:
            yield (
                "That is far less than stated: either the stated deviations are wrong, or most of the error lasts "
                "from one measurement to the next. Then no filter of this sensor alone comes closer to the truth."
            )
    else:
        yield (
            "NIS and likelihood say nothing of errors that last longer than the motion: those are invisible without a "
            "second sensor."
        )


def _anchor(advice: Advice) -> Iterator[str]:
    """Why a filter with a second sensor is advised or not, and what its likelihood says."""
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
        f"The second sensor tells errors that last from motion: measurements {APART:g} s apart are likelier by "
        f"{anchor.gain:.2f} nats each than by {anchor.other}, both fitted to such. From one measurement to the next "
        "filters without it may predict better, because they follow these errors: there likelihoods of both kinds do "
        "not compare, nor does NIS, and deviations are taken as they are stated."
    )
    yield "An error that never changes, or lasts longer than this recording, remains invisible."


def _warnings(advice: Advice) -> Iterator[str]:
    """What makes the advice less than it looks."""
    one, count = advice.advised, int(advice.recording.rows.sum())
    if count < FEW:
        yield f"{count} measurements are few: below {FEW} the parameters are known badly, and so is who is best."
    correlation = one.correlation
    sure = not math.isnan(correlation.low) and not correlation.low <= 0.0 <= correlation.high
    if sure and abs(correlation.value) > LEAST_CORRELATION:
        yield (
            f"Successive prediction errors are correlated ({correlation.value:+.2f}): the errors of measurements are "
            "not white, or the motion is none of the models'. The likelihood then misleads."
        )
    wide = [
        name.removeprefix("log10_").replace("_", " ")
        for name, interval in advice.intervals.items()
        if interval.open_low and interval.open_high
    ]
    if wide:
        yield f"Nothing in this recording tells the size of: {', '.join(wide)}. It lacks the motion that would."


def _agents(advice: Advice, learned: Sequence[str]) -> Iterator[str]:
    """What the learned agents did, which were trained on other data."""
    found: list[Competitor] = [
        c for c in advice.competitors if c.name in learned and not math.isnan(c.relative_error.value)
    ]
    worse = [c for c in found if c.relative_error.low > 0.0]
    if worse:
        each = ", ".join(f"{c.name} {100.0 * c.relative_error.value:+.0f} %" for c in worse)
        yield f"The learned agents were never trained on such data: {each} error against {advice.best_shipped}."
