"""Stress test of a filter: it runs under every alteration of its measurements, with a verdict for each.

It checks that estimates are valid at every measurement, compares the error with that of the same filter on
unaltered measurements, and checks recovery after temporary alterations, ANEES, and the time of updates.

The size of an error is the root of the mean over components of (error / scale)^2, with the RMS error of the
paper's algorithm on unaltered measurements as scale.
"""

import dataclasses
import math
import textwrap
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy

from ...envs.contract.model import Model
from ...envs.data.recorded_world import Feed
from ...envs.engine.backend import make_model
from ...envs.engine.scenario_choice import find_scenario
from ...filters.gaussian import log_density
from ..competitors.adapters import select_lanes
from ..competitors.filters import find_fault
from ..competitors.online import OnlineFilter
from ..running.evaluate import Experiment, control_of
from ..running.seeds import episode_seeds
from ..statistics.bootstrap import Bootstrap, IntervalEstimate
from ..storage.dataset import FAULTS
from .alterations import AFTERWARDS, ALTERATIONS, SETTLED, Alteration
from .streams import Stream, record_streams

RECOVERY = 50
"""Number of measurements after a temporary alteration within which the errors must return to those without it."""
BACK = 3.0
"""Ratio of errors below which an episode counts as recovered."""
FEW = 0.1
"""Largest permitted share of episodes that do not recover."""
HARM = 1.25
"""Ratio of errors above which a filter counts as degraded."""
INCONSISTENT = 2.0
"""Factor by which ANEES may differ from one, or from that without alteration."""
SLOW, SLOW_SECONDS, HICCUPS = 50.0, 0.1, 3
"""Limits for slow updates: multiple of the median time, time in s, and number of exceptions."""
MOST_WORDS = 160
"""Maximal number of characters of an error message in a report."""
CHUNK = 1000
"""Number of measurements of a long run in memory at a time."""
LONG_EPISODES = 8
MOST_KEPT = 20_000
"""Maximal number of measurements of a long run that are stored for all filters."""
UNALTERED, RESTORE, LONG = ALTERATIONS[0].name, "restore", "long-run"
DESCRIPTIONS: Mapping[str, str] = {
    **{one.name: one.description for one in ALTERATIONS},
    RESTORE: "the state is saved, and restored in another filter",
    LONG: "many measurements, one after another",
}
NOT_CONTAINED = "the measurement does not contain it"
PASSED, DEGRADED, FAILED, NOTHING = "passed", "degraded", "failed", "does not apply"


class Finding(NamedTuple):
    """Verdict on a filter under one alteration, with its errors."""

    competitor: str
    alteration: str
    verdict: str
    """"passed", "degraded", "failed", or "does not apply"."""
    reason: str
    """One sentence; for a passed test empty, or a remark."""
    error: float | None
    """Error over that without alteration, geometric mean over episodes; for unaltered measurements over that of the
    reference.
    """
    reference_error: float | None
    """The same ratio of the reference filter."""
    anees: float | None
    """Mean NEES over its dimension, from the alteration on."""
    anees_low: float | None
    anees_high: float | None
    lost: int
    """Number of episodes with an invalid estimate."""
    episodes: int


class Run(NamedTuple):
    """Errors, faults and times of a filter on a stream of N episodes."""

    size: numpy.ndarray
    """Normalised size of the error, ``(K, N)``."""
    nees: numpy.ndarray
    """NEES over its dimension, ``(K, N)``."""
    fault: numpy.ndarray
    """Number among ``FAULTS`` of the reason why an estimate is invalid, ``(K, N)``; 0 where it is valid."""
    slow: float
    """Time of the slowest update without a few exceptions, s."""
    median: float
    """Median time of an update, s."""
    error: str = ""
    """Message of the error that the filter raised; empty without one."""


class StreamFilter(OnlineFilter):
    """Online filter that receives the task's measurements without checks."""

    def begin(self, initial: Any) -> None:
        """Start the tracks with the task's initial estimate."""
        self._set_state(self._begin(initial, {}))

    def _check_input(self, memory: Any) -> None: ...

    def take(self, measurement: Any) -> dict[str, numpy.ndarray]:
        """Update with a measurement; return mean, covariance and statistics by name, arrays ``(..., N)``."""
        if self.tracks > 1:
            return self._advance(measurement, {})
        found = self._advance(select_lanes(measurement, 0), {})
        return {name: numpy.asarray(values)[..., None] for name, values in found.items()}


def _subtract(stream: Stream, means: numpy.ndarray) -> numpy.ndarray:
    """Return errors ``(K, C, N)`` of means at the first K measurements, angles as shortest differences."""
    means, truth = (numpy.moveaxis(values, 1, 0) for values in (means, stream.truth[: len(means)]))
    return numpy.moveaxis(stream.task.subtract(means, truth), 0, 1)


class CrashTest:
    """Streams with every alteration for an experiment, and the verdicts on filters.

    Args:
        experiment: environment, scenario, seed, split and parameters; its episodes are the streams.
        steps: number of measurements of the long run.
        reference: name of the reference filter and its maker; None in an environment without one.
        alterations: alterations to apply; the first must change nothing.

    Raises:
        ValueError: if the environment does not declare the readings of its sensors.

    Attributes:
        streams: streams by the name of the alteration; None where it does not apply.
    """

    def __init__(
        self,
        experiment: Experiment,
        steps: int,
        reference: tuple[str, Any] | None = None,
        alterations: Sequence[Alteration] = ALTERATIONS,
    ) -> None:
        self.experiment = experiment
        self.steps = steps
        self.reference_name: str = "" if reference is None else reference[0]
        self._seeds = episode_seeds(experiment.split, experiment.seed, experiment.episodes)
        length = max(one.length for one in alterations)
        world = experiment.task.World
        if not world.reading_field and not world.received_field:
            raise ValueError(
                f"{experiment.task.id} does not declare the readings of its sensors: give its World reading_field, and "
                "stated_field or reading_deviations"
            )
        (whole,) = self._record(self._seeds, length, length)
        self.streams: dict[str, Stream | None] = {}
        for one in alterations:
            generator = numpy.random.default_rng([experiment.seed, *one.name.encode()])
            altered = one.function(whole, generator)
            self.streams[one.name] = None if altered is None else altered.mark_missing()
        self.scale: numpy.ndarray = numpy.ones(len(whole.task.components))
        self._bootstrap = Bootstrap(experiment.episodes)
        self._kept: list[Stream] = []
        self._reference: dict[str, Run] = {}
        if reference is not None:
            filter = self.filter_of(*reference, experiment.episodes)
            errors = self._errors(filter, self._stream(UNALTERED))
            self.scale = numpy.sqrt((errors[SETTLED:] ** 2).mean(axis=(0, 2)))
            self.scale[self.scale == 0.0] = 1.0
            self._reference = {
                name: self._run(filter, s) for name, s in self.streams.items() if s is not None
            }

    def _record(self, seeds: Sequence[int], length: int, chunk: int) -> Iterator[Stream]:
        task, keywords = self.experiment.task, dict(self.experiment.keywords)
        usual = self.experiment.make_task()
        interval = usual.decision_interval
        keywords["horizon"] = interval * -(-length // interval)
        control = usual.paper_policy.control
        model = make_model(
            task, control, self.experiment.scenario, backend=self.experiment.backend, **keywords
        )
        return record_streams(model, seeds, length, chunk)

    def filter_of(self, name: str, maker: Any, tracks: int) -> StreamFilter:
        """Make an online filter of a competitor, without checks of its input."""
        experiment = self.experiment
        keywords = {**getattr(maker, "task_keywords", {}), **experiment.keywords}
        chosen = dataclasses.replace(
            find_scenario(experiment.task, experiment.scenario, keywords), flights=(), recording=Feed()
        )
        control = control_of(maker, experiment.control, experiment.task, name)
        model: Model = make_model(experiment.task, control, chosen, backend=experiment.backend, **keywords)
        return StreamFilter(model, maker, name, tracks)

    def _stream(self, name: str) -> Stream:
        stream = self.streams[name]
        assert stream is not None
        return stream

    # --- running

    def _errors(self, filter: StreamFilter, stream: Stream) -> numpy.ndarray:
        filter.begin(stream.initial)
        means = numpy.stack([filter.take(stream.at(k))["mean"] for k in range(len(stream))])
        return _subtract(stream, means)

    def _run(self, filter: StreamFilter, stream: Stream, begin: bool = True) -> Run:
        found: list[dict[str, numpy.ndarray]] = []
        spent: list[float] = []
        error = ""
        try:
            if begin:
                filter.begin(stream.initial)
            for k in range(len(stream)):
                measurement, began = stream.at(k), time.perf_counter()
                with numpy.errstate(all="ignore"):
                    found.append(filter.take(measurement))
                spent.append(time.perf_counter() - began)
        except Exception as raised:  # a user's filter can raise any error
            error = _shortened(raised)
        if not found:
            none = numpy.empty((0, stream.episodes))
            return Run(none, none, none, 0.0, 0.0, error)
        mean, covariance = (numpy.stack([one[name] for one in found]) for name in ("mean", "covariance"))
        deviation = _subtract(stream, mean)
        with numpy.errstate(all="ignore"):
            size = numpy.sqrt(((deviation / self.scale[:, None]) ** 2).mean(axis=1))
            flat = numpy.moveaxis(deviation, 1, 0), numpy.moveaxis(covariance, 0, 2)
            normalised = log_density(flat[0], flat[1])[1] / len(self.scale)
        if "lost" in found[0]:
            fault = numpy.stack([one["lost"] for one in found])
        else:
            nothing = numpy.zeros(len(found) * stream.episodes)
            means, covariances = (
                values.reshape(*values.shape[:-2], -1) for values in (numpy.moveaxis(mean, 1, 0), flat[1])
            )
            fault = find_fault(means, covariances, nothing, nothing, numpy).reshape(size.shape)
        slow = sorted(spent)[max(len(spent) - HICCUPS, 0)]
        return Run(size, normalised, fault, slow, float(numpy.median(spent)), error)

    # --- verdicts

    def findings(
        self, name: str, maker: Any, tick: Callable[[int], None] = lambda done: None
    ) -> Iterator[Finding]:
        """Run a competitor under all alterations, save and restore it, and run it long; yield a verdict on
        each.

        Raises:
            ValueError: for a competitor that needs the truth or later measurements, or cannot be made.
        """
        filter = self.filter_of(name, maker, self.experiment.episodes)
        plain = self._run(filter, self._stream(UNALTERED))
        for alteration, stream in self.streams.items():
            if stream is None:
                yield self._finding(name, alteration, NOTHING, NOT_CONTAINED)
            else:
                run = plain if alteration == UNALTERED else self._run(filter, stream)
                yield self._judge(name, alteration, stream, run, plain)
            tick(1)
        yield self._restore(name, maker)
        tick(1)
        if self.steps:
            yield self._long_run(name, maker)
        tick(1)

    def _finding(self, name: str, alteration: str, verdict: str, reason: str = "", **fields: Any) -> Finding:
        numbers: dict[str, Any] = dict.fromkeys(
            ("error", "reference_error", "anees", "anees_low", "anees_high")
        )
        numbers["lost"] = 0
        numbers |= {key: value if math.isfinite(value) else None for key, value in fields.items()}
        return Finding(name, alteration, verdict, reason, **numbers, episodes=self.experiment.episodes)

    def _judge(self, name: str, alteration: str, stream: Stream, run: Run, plain: Run) -> Finding:
        """Judge a filter under one alteration, from its run and its run without alteration."""
        reference = self._reference.get(alteration)
        if alteration == UNALTERED:
            ratio = self._ratio(run, reference, stream, slice(SETTLED, None))
            others = numpy.full(stream.episodes, math.nan)
        else:
            ratio = self._ratio(run, plain, stream, slice(stream.begin, None))
            others = self._ratio(reference, self._reference.get(UNALTERED), stream, slice(stream.begin, None))
        lost = numpy.asarray((run.fault > 0.0).any(axis=0))
        begin = stream.begin
        if stream.end is not None:  # errors during a temporary alteration do not count
            begin = stream.end + RECOVERY
        anees = self._mean(run.nees[begin:])
        fields = {
            "error": _geometric_mean(ratio),
            "reference_error": _geometric_mean(others),
            "anees": anees.value,
            "anees_low": anees.low,
            "anees_high": anees.high,
            "lost": int(lost.sum()),
        }
        failed = self._failure(run, plain, stream, lost)
        if failed:
            return self._finding(name, alteration, FAILED, failed, **fields)
        words = [*self._harm(alteration, fields), *self._inconsistency(alteration, anees, plain)]
        if not words and alteration == UNALTERED and not anees.low <= 1.0 <= anees.high:
            remark = f"slightly {'overconfident' if anees.value > 1.0 else 'cautious'}, {_anees_text(anees)}"
            return self._finding(name, alteration, PASSED, remark, **fields)
        if run.slow > max(SLOW_SECONDS, SLOW * run.median):
            words.append(f"updates take up to {run.slow:.2g} s, the median one {run.median:.2g} s")
        return self._finding(name, alteration, DEGRADED if words else PASSED, "; ".join(words), **fields)

    def _failure(self, run: Run, plain: Run, stream: Stream, lost: numpy.ndarray) -> str:
        """Explain in a sentence why the filter failed; empty if it did not."""
        count = stream.episodes
        if run.error:
            return f"stops at measurement {len(run.size) + 1}: {run.error}"
        if lost.any():
            first = int((run.fault > 0.0).any(axis=1).argmax())
            reason = FAULTS[int(run.fault[first].max()) - 1]
            after = first - stream.begin
            since = f"{after} measurement{'s' * (after > 1)} after it" if after > 0 else "before it"
            since = "at it" if after == 0 else since
            return f"{reason}, in {int(lost.sum())} of {count} episodes, first {since}"
        if stream.end is not None:
            late = slice(stream.end + RECOVERY, stream.end + AFTERWARDS)
            ratio = self._ratio(run, plain, stream, late)
            away = ~(ratio <= BACK)
            if away.sum() > FEW * count:
                return (
                    f"is not back after {RECOVERY} measurements in {int(away.sum())} of {count} episodes, error "
                    f"{_text(_geometric_mean(ratio[away]))} times that without"
                )
        return ""

    def _harm(self, alteration: str, fields: Mapping[str, Any]) -> Iterator[str]:
        """Yield a sentence if the competitor's error increased by more than the limit ``HARM``."""
        error, other = fields["error"], fields["reference_error"]
        if not error > HARM:
            return
        if alteration == UNALTERED:
            yield f"error {_text(error)} times that of {self.reference_name}"
        else:
            beside = f", of {self.reference_name} {_text(other)} times" if math.isfinite(other) else ""
            yield f"error {_text(error)} times that without{beside}"

    def _inconsistency(self, alteration: str, anees: IntervalEstimate, plain: Run) -> Iterator[str]:
        """Yield a sentence if the covariance is inconsistent by ANEES."""
        usual = 1.0 if alteration == UNALTERED else max(1.0, float(numpy.nanmean(plain.nees[SETTLED:])))
        if anees.low > INCONSISTENT * usual:
            yield f"overconfident, {_anees_text(anees)}"
        elif alteration == UNALTERED and anees.high < 1.0 / INCONSISTENT:
            yield f"cautious, {_anees_text(anees)}"

    def _ratio(self, run: Run | None, other: Run | None, stream: Stream, part: slice) -> numpy.ndarray:
        """Return the ratio of each episode's RMS error in two runs, at the same measurements, ``(N,)``."""
        if run is None or other is None:
            return numpy.full(stream.episodes, numpy.nan)
        chosen = numpy.arange(len(stream))[part]
        chosen = chosen[chosen < len(run.size)]
        places = stream.source[chosen]
        there = places < len(other.size)
        if not there.any():
            return numpy.full(stream.episodes, numpy.nan)
        pair = run.size[chosen[there]], other.size[places[there]]
        with numpy.errstate(all="ignore"):
            own, theirs = (numpy.sqrt((each**2).mean(axis=0)) for each in pair)
            ratio: numpy.ndarray = own / theirs
        return ratio

    def _mean(self, values: numpy.ndarray) -> IntervalEstimate:
        """Return the mean over measurements and episodes ``(K, N)``, with its bootstrap interval over
        episodes.
        """
        with numpy.errstate(all="ignore"):
            each = values.mean(axis=0) if len(values) else numpy.full(values.shape[1], numpy.nan)
            return self._bootstrap.estimate(each)

    def _restore(self, name: str, maker: Any) -> Finding:
        """Judge whether a state saved in the middle and restored in another filter gives the same estimates."""
        count, stream = self.experiment.episodes, self._stream(UNALTERED)
        first = self.filter_of(name, maker, count)
        second = self.filter_of(name, maker, count)
        try:
            first.begin(stream.initial)
            for k in range(SETTLED):
                first.take(stream.at(k))
            second.restore(first.save())
            for k in range(SETTLED, min(2 * SETTLED, len(stream))):
                one, other = first.take(stream.at(k)), second.take(stream.at(k))
                if any(not numpy.array_equal(one[part], other[part]) for part in ("mean", "covariance")):
                    after = k - SETTLED + 1
                    return self._finding(
                        name,
                        RESTORE,
                        FAILED,
                        f"another estimate {after} measurement{'s' * (after > 1)} after it was restored",
                    )
        except Exception as raised:  # a user's filter can raise any error
            return self._finding(
                name, RESTORE, NOTHING, f"cannot be saved and restored: {_shortened(raised)}"
            )
        return self._finding(name, RESTORE, PASSED)

    def _long_streams(self) -> Iterable[Stream]:
        """Return the streams of the long run; short ones are stored for the next filter."""
        streams = self._record(self._seeds[:LONG_EPISODES], self.steps, CHUNK)
        if self.steps > MOST_KEPT:
            return streams
        self._kept = self._kept or list(streams)
        return self._kept

    def _long_run(self, name: str, maker: Any) -> Finding:
        filter = self.filter_of(name, maker, LONG_EPISODES)
        first: Run | None = None
        run: Run | None = None
        done = 0
        for stream in self._long_streams():
            run = self._run(filter, stream, begin=done == 0)
            done += len(run.size)
            lost = (run.fault > 0.0).any(axis=0)
            if run.error or lost.any():
                why = run.error or FAULTS[int(run.fault.max()) - 1]
                return self._finding(
                    name, LONG, FAILED, f"{why}, within {done:,} measurements", lost=int(lost.sum())
                )
            first = first or run
        assert first is not None
        assert run is not None
        early, late = (float(numpy.nanmean(one.nees[SETTLED:])) for one in (first, run))
        fields: dict[str, Any] = {"anees": late}
        if late > INCONSISTENT * INCONSISTENT * max(1.0, early):
            words = f"overconfident after {done:,} measurements, ANEES {_text(late)}, at first {_text(early)}"
            return self._finding(name, LONG, DEGRADED, words, **fields)
        return self._finding(name, LONG, PASSED, **fields)


def _geometric_mean(ratio: Any) -> float:
    """Return the geometric mean of the finite values; NaN without any."""
    with numpy.errstate(all="ignore"):
        logs = numpy.log(numpy.atleast_1d(ratio))
    logs = logs[numpy.isfinite(logs)]
    return float(numpy.exp(logs.mean())) if len(logs) else math.nan


def _anees_text(anees: IntervalEstimate) -> str:
    return f"ANEES {_text(anees.value)} [{_text(anees.low)}, {_text(anees.high)}]"


def _shortened(raised: Exception) -> str:
    return textwrap.shorten(str(raised) or type(raised).__name__, MOST_WORDS, placeholder=" ...")


def _text(value: float) -> str:
    return f"{value:.3g}" if value < 1e4 else f"{value:.1e}"
