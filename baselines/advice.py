"""Choice of the best filter for a recording, with its fitted parameters and its gain over the shipped filters.

The recording is cut into blocks. Every family of filters is fitted to half of them by maximum likelihood. One
is chosen by its likelihood on these and on a quarter more, less one nat for each fitted parameter (Akaike,
IEEE Trans. AC 19, 1974): the simplest that the likeliest does not beat beyond chance. It is fitted to all
three quarters. Its rival among the shipped filters is the paper's algorithm, unless another is likelier
beyond chance; then it is the cheapest that is as good as the likeliest. The fitted one is advised where its
gain over the rival is beyond chance, or where it is as good and cheaper, unless it errs more, beyond chance,
on the last quarter. The best filter there in hindsight is reported separately.
"""

import dataclasses
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import cached_property
from typing import Any, NamedTuple

import numpy
import xarray

from ..envs.contract.companions import find_companion
from ..envs.contract.log_format import LogFormat
from ..envs.contract.task import Task
from ..envs.data.recorded_world import fill_arrays, measure_once
from ..envs.data.recording import Recording
from ..envs.engine.scenario_choice import make_task
from ..evaluation.competitors.likelihood import Span, WindowLikelihood, Windows, cut_windows
from ..evaluation.statistics.bootstrap import IntervalEstimate
from ..filters.array_namespace import select_nested
from .fitted_filters import families_of
from .fitting import (
    DROP,
    NOISE_SCALE,
    OUTLIER_SHARE,
    Fit,
    Interval,
    Profile,
    ScaledNoise,
    fit,
    fit_profiles,
    fit_stretches,
    with_noise_scale,
    with_outliers,
)
from .judgement import (
    AS_GOOD,
    FEWEST,
    JudgedFilter,
    Judgement,
    Share,
    likeliest_of,
    roles_of,
    split_recording,
)
from .log_scores import replay_log, score_log
from .onboard import OnboardJudgement
from .problem import Problem
from .table import Tunable
from .tuned_values import make_tuned_policy

FITTED, RUN, REFITTED = 0.35, 0.7, 0.97
"""Share of the work of :func:`advise` that is done when all families are fitted, all competitors have run over the log,
and the chosen one is fitted again; of logs of some ten thousand measurements.
"""
APART = 10.0
"""Time between the measurements to which anchored filters are fitted, s. Over shorter times the fixes reflect the
receiver's own filter: one-step predictions then contain much of it and little of errors that last.
"""
COARSE = 4096
"""Measurements, of stretches of all blocks, to which families are fitted first where the blocks contain twice as many:
a parameter is estimated to 2 % by then, and families that are far behind need not be fitted to the rest.
"""
MEMORY = 8
"""Part of a recording by which the windows of anchored filters begin earlier: an eighth."""


@dataclasses.dataclass(frozen=True)
class FittedLog:
    """A recording to which filters are fitted, and the options of the fits."""

    problem: Problem
    recording: Recording
    """Recording, with truth or without."""
    noise: bool = True
    """Whether to fit the scale of the measurement noise, too, where measurements state one."""
    seed: int = 0
    """Seed of the starts of the fits."""
    keywords: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    """Parameters of the task."""

    @cached_property
    def task(self) -> Task:
        """Task with the parameters of the recording, but without its measurements."""
        scenario = self.recording.scenario(self.problem.task, self.keywords)
        scenario = dataclasses.replace(scenario, recording=None)
        return make_task(self.problem.task, scenario, **{**self.keywords, "horizon": 1})

    @cached_property
    def share(self) -> Share:
        """Blocks of the recording for the fit, the choice and the judgement."""
        return split_recording(self.recording)

    @cached_property
    def interval(self) -> float:
        """Median time between the recording's measurements, s."""
        return float(numpy.nanmedian(numpy.diff(self.recording.seconds, axis=1)))

    def with_noise(self, family: Tunable, is_own: bool = False, robust: bool = False) -> Tunable:
        """Return a filter family with the measurement noise's scale, and with ``robust`` outliers, as more
        parameters.

        A family with a second sensor is returned unchanged; the scale is added if ``noise`` is set, the share
        of outliers not to a user's family (``is_own``).
        """
        log_format = find_companion(self.problem.task, LogFormat)
        if family.anchored or log_format is None or log_format.scale_noise is None:
            return family
        if robust and not is_own:
            family = with_outliers(family, log_format.scale_noise)
        return with_noise_scale(family, log_format.scale_noise) if self.noise else family

    @cached_property
    def stretches(self) -> list[Span] | None:
        """Spans of the first part of each block, ``COARSE`` measurements in all; None for a short recording."""
        total = sum(span.last - span.first for span in self.share.fitted)
        if total < 2 * COARSE:
            return None
        return [
            span._replace(last=span.first + -(-COARSE * (span.last - span.first) // total))
            for span in self.share.fitted
        ]

    @cached_property
    def _cut(self) -> dict[Any, Windows]:
        """Cache of the windows cut from the recording, by their spans."""
        return {}

    def windows(self, spans: Sequence[Span], anchored: bool = False) -> Windows:
        """Cut spans of the recording into windows; for ``anchored`` filters with measurements ``APART`` seconds
        apart.
        """
        every, warm_up = 1, self.share.warm_up
        if anchored:
            warm_up = max(warm_up, int(self.recording.rows.sum()) // MEMORY)
            every = max(1, round(APART / self.interval))
        key = tuple(spans), warm_up, every
        if key not in self._cut:
            self._cut[key] = cut_windows(self.recording, self.task, spans, warm_up, every)
        return self._cut[key]

    def likelihood(self, spans: Sequence[Span], tunable: Tunable, thinned: bool = False) -> WindowLikelihood:
        """Return the likelihood function of a filter family's parameters on spans of the recording.

        For an anchored family, or with ``thinned``, its measurements are ``APART`` seconds apart.
        """
        windows = self.windows(spans, tunable.anchored or thinned)
        return WindowLikelihood(self.task, windows, tunable.start, tunable.apply, tunable.in_lanes)

    def fit(self, tunable: Tunable) -> tuple[Fit, WindowLikelihood]:
        """Fit a family to the blocks for the fit; return the fit and the likelihood function."""
        if self.stretches is None or tunable.anchored:
            likelihood = self.likelihood(self.share.fitted, tunable)
            return fit(likelihood, tunable, self.seed), likelihood
        coarse = self.likelihood(self.stretches, tunable)
        likelihood = coarse.on(self.windows(self.share.fitted))
        return fit_stretches(coarse, tunable, likelihood, self.seed), likelihood


class Fits(NamedTuple):
    """Families of filters fitted to a recording, by name: fits, tunable values and likelihood functions."""

    found: dict[str, Fit]
    tunables: dict[str, Tunable]
    likelihoods: dict[str, WindowLikelihood]

    @property
    def anchored(self) -> list[str]:
        """Names of the fitted families that use a second sensor."""
        return [name for name, tunable in self.tunables.items() if tunable.anchored]

    def make(self, name: str) -> Any:
        """Return the maker of a fitted filter."""
        return make_tuned_policy(f"fitted {name}", self.tunables[name], self.found[name].values)


class Anchor(NamedTuple):
    """Comparison of a filter with a second sensor to the best one without, on measurements ``APART`` seconds apart."""

    name: str
    other: str
    gain: float
    """Mean log-likelihood less the other's on the measurements of the choice that are ``APART``, nats; both are fitted
    to such measurements.
    """


class Prices(Mapping[str, Mapping[str, int] | None]):
    """Costs of an update of each competitor, by name, computed at first use; None where the cost is unknown."""

    def __init__(
        self, makers: Mapping[str, Any], price_of: Callable[[str, Any], Mapping[str, int] | None]
    ) -> None:
        self.makers = makers
        self.price_of = price_of
        self._known: dict[str, Mapping[str, int] | None] = {}

    def __getitem__(self, name: str) -> Mapping[str, int] | None:
        if name not in self._known:
            self._known[name] = self.price_of(name, self.makers[name])
        return self._known[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self.makers)

    def __len__(self) -> int:
        return len(self.makers)

    def operations(self, name: str) -> float:
        """Return the arithmetic operations of a competitor's update; infinite where they are unknown."""
        price = self[name]
        return math.inf if price is None else float(price["operations"])


class Advice(NamedTuple):
    """Recommendation of a filter for a recording, with the comparison on which it rests."""

    recording: Recording
    share: Share
    competitors: list[JudgedFilter]
    """All compared filters, the advised one first, then by log-likelihood."""
    fitted: JudgedFilter
    """The simplest fitted filter that the likeliest fitted one does not beat beyond chance."""
    rival: str
    """Shipped filter chosen without the judged measurements."""
    best_shipped: str
    """Shipped filter of smallest judged error in hindsight; of smallest prediction error where there is no truth."""
    hindsight: IntervalEstimate
    """Ratio of the judged errors of the advised filter and ``best_shipped``, less one."""
    diverging: tuple[str, ...]
    """Fitted filters that lose the track in the whole recording; they do not compete."""
    replay: Callable[[], xarray.Dataset]
    """Runs the fitted one, its rival and the best in hindsight over the whole recording, with tracks."""
    fits: dict[str, Fit]
    tunables: dict[str, Tunable]
    profiles: dict[str, dict[str, Profile]]
    """Profile likelihood of each parameter of ``fitted``, by filter and parameter."""
    anchor: Anchor | None
    """Comparison with the filter that uses a second sensor; None without one."""
    outliers: numpy.ndarray
    """Whether ``fitted`` treats each measurement as an outlier, ``(E, T)``."""
    likeliest: tuple[str, IntervalEstimate] | None
    """Likeliest filter of all, and its gain on the measurements of the choice, nats per measurement, less one nat in
    all for each parameter; None where it is the advised one.
    """
    prices: "Prices"
    """Costs of an update of each filter."""
    onboard: OnboardJudgement | None = None
    """Results of the vehicle's own filter on withheld fixes, for a log of an autopilot."""

    @property
    def intervals(self) -> dict[str, Interval]:
        """95 % intervals of the parameters of ``fitted``."""
        return {name: each.interval for name, each in self.profiles[self.fitted.name].items()}

    def make_fitted(self) -> dict[str, Any]:
        """Return the maker of each fitted filter, by name."""
        return {name: Fits(self.fits, self.tunables, {}).make(name) for name in self.fits}

    @property
    def advised(self) -> JudgedFilter:
        """Advised filter, the first of the competitors."""
        return self.competitors[0]


def advise(
    log: FittedLog,
    shipped: Mapping[str, Any],
    user_families: Mapping[str, Tunable] | None = None,
    progress: Callable[[str, float], None] = lambda what, share: None,
    price_of: Callable[[str, Any], Mapping[str, int] | None] = lambda name, maker: None,
) -> Advice:
    """Fit every family of filters to a recording, and recommend a fitted or a shipped filter for it.

    Args:
        log: the recording, with the options of the fits.
        shipped: competitors that are not fitted, by name.
        user_families: further families, such as a user's estimator with limits of its parameters.
        progress: function called with a description of the work done, or empty text, and the share of all
            work.
        price_of: function from a competitor's name and maker to the costs of an update, such as
            ``operations``; None where they are unknown, which ranks it as the most expensive.

    Raises:
        ValueError: if no family can be fitted, or the recording is too short.
    """
    problem, recording = log.problem, log.recording
    fits = _fit_families(log, user_families or {}, progress)
    makers = {**shipped, **{name: fits.make(name) for name in fits.found}}
    prices = Prices(makers, price_of)
    counts = {name: len(found.values) for name, found in fits.found.items()}

    experiment = problem.experiment(recording, keywords=log.keywords)
    roles = roles_of(log.share, recording.seconds.shape)

    def between(first: float, last: float) -> Callable[[float], None]:
        return lambda share: progress("", first + (last - first) * share)

    def judge(makers: Mapping[str, Any], tick: Callable[[float], None]) -> Judgement:
        scores = score_log(experiment, makers, roles, tick)
        return Judgement(scores, log.share, counts, problem.baselines.score_paper, fits.anchored)

    progress(_first_verdict(fits, len(shipped)), FITTED)
    judgement = all_judged = judge(makers, between(FITTED, RUN))
    diverging = judgement.find_diverging(
        {name: found for name, found in fits.found.items() if name not in fits.anchored}
    )
    progress("computing intervals", RUN)
    rival, best = judgement.rival(prices.operations), judgement.best_shipped()
    competitors = [judgement.competitor(name, rival) for name in makers if name not in diverging]
    chosen, anchor = _choose(log, fits, judgement, competitors)
    name, tunable = chosen.name, fits.tunables[chosen.name]
    takes_fitted = tunable.anchored or judgement.is_worthwhile(chosen, rival, prices.operations)
    profiles = _fit_again(log, fits, name, between(RUN, REFITTED))
    if log.share.apart:
        judgement = judge(
            {name: fits.make(name), rival: shipped[rival], best: shipped[best]}, between(REFITTED, 1.0)
        )
        before, refitted = chosen, judgement.competitor(name, rival)
        chosen = refitted._replace(log_likelihood=before.log_likelihood, gain=before.gain)
        competitors = [chosen if c is before else c for c in competitors]
    if not tunable.anchored and chosen.relative_error.low > 0.0:
        takes_fitted = False  # the likelihood misleads
    advised = chosen if takes_fitted else next(c for c in competitors if c.name == rival)
    likeliest, brought = likeliest_of([c for c in competitors if c.name not in fits.anchored]), None
    if not tunable.anchored and likeliest.name != advised.name:
        brought = likeliest.name, all_judged.difference(likeliest.name, advised.name)
    progress("done", 1.0)
    drawn = {each: fits.make(each) if each in fits.found else shipped[each] for each in (name, rival, best)}
    others = sorted(
        (c for c in competitors if c is not advised),
        key=lambda c: (math.isnan(c.log_likelihood), -c.log_likelihood),
    )
    return Advice(
        recording,
        log.share,
        [advised, *others],
        chosen,
        rival,
        best,
        judgement.relative_error(advised.name, best),
        diverging,
        lambda: replay_log(experiment, drawn),
        fits.found,
        fits.tunables,
        {name: profiles},
        anchor,
        find_outliers(log.task, recording, tunable, fits.found[name]),
        brought,
        prices,
    )


def _fit_families(log: FittedLog, own: Mapping[str, Tunable], progress: Callable[[str, float], None]) -> Fits:
    """Fit every family of filters, without and then with outliers; keep the likelier fit of each."""
    families = {**families_of(log.problem, log.recording), **own}
    if int(log.recording.rows.sum()) * log.interval < FEWEST * APART:  # too few measurements ``APART``
        families = {name: family for name, family in families.items() if not family.anchored}
    fits = Fits({}, {}, {})
    outliers = True
    for i, (name, family) in enumerate(families.items()):
        tried = [log.with_noise(family, name in own, robust) for robust in (False, True)]
        for tunable in tried if outliers and tried[1] != tried[0] else tried[:1]:
            begin = tunable
            if name in fits.found:
                begin = dataclasses.replace(tunable, start={**tunable.start, **fits.found[name].values})
            found, likelihood = log.fit(begin)
            if name not in fits.found or found.log_likelihood > fits.found[name].log_likelihood + DROP:
                fits.found[name], fits.tunables[name], fits.likelihoods[name] = found, tunable, likelihood
        mean = fits.found[name].log_likelihood / fits.found[name].measurements
        progress(f"fitted {name}: {mean:.3f} nats per measurement", FITTED * (i + 1) / len(families))
        if i == 0:  # where the simplest family finds no outliers, the others have fewer reasons to
            outliers = OUTLIER_SHARE in fits.found[name].values
    if log.stretches is not None:
        _fit_finalists(log, fits)
    return fits


def _fit_finalists(log: FittedLog, fits: Fits) -> None:
    """Improve the fits of families near the best by fits to all blocks, started at the values from stretches."""
    means = {name: found.log_likelihood / found.measurements for name, found in fits.found.items()}
    known = {name: mean for name, mean in means.items() if name not in fits.anchored}
    for name, mean in known.items():
        if mean > max(known.values()) - AS_GOOD:
            found, tunable = fits.found[name], fits.tunables[name]
            begin = dataclasses.replace(tunable, start=found.values)
            whole = fit(fits.likelihoods[name], begin, log.seed, starts=1)
            if whole.log_likelihood > found.log_likelihood:
                gain = whole.log_likelihood - found.log_likelihood
                fits.found[name] = whole._replace(spread=found.spread + gain)


def _choose(
    log: FittedLog, fits: Fits, judgement: Judgement, competitors: Sequence[JudgedFilter]
) -> tuple[JudgedFilter, Anchor | None]:
    """Return the chosen fitted filter, and its comparison with the one that uses a second sensor, or None."""
    anchored, anchor = fits.anchored, None
    chosen = judgement.simplest([c for c in competitors if c.fitted and c.name not in anchored])
    for name in anchored:
        both = {each: fits.tunables[each] for each in (name, chosen.name)}
        anchor = _compare_anchored(log, both, fits.found[name])
        if anchor.gain > 0.0:
            chosen = next(c for c in competitors if c.name == name)
    return chosen, anchor


def _fit_again(
    log: FittedLog, fits: Fits, name: str, tick: Callable[[float], None] = lambda share: None
) -> dict[str, Profile]:
    """Fit the chosen family to all measurements before the judgement; return the profiles of its parameters."""
    tunable, found = fits.tunables[name], fits.found[name]
    if log.share.apart:
        begin = dataclasses.replace(tunable, start=found.values)
        fits.likelihoods[name] = log.likelihood([*log.share.fitted, *log.share.chosen], begin)
        found = fit(fits.likelihoods[name], begin, log.seed, starts=1)._replace(spread=found.spread)
    fits.found[name], profiles = fit_profiles(fits.likelihoods[name], tunable, found, tick)
    return profiles


def _first_verdict(fits: Fits, shipped: int) -> str:
    """Return a sentence on the fitted family of highest penalised likelihood."""
    known = {
        name: (found.log_likelihood - len(found.values)) / found.measurements
        for name, found in fits.found.items()
        if name not in fits.anchored
    }
    first, *rest = sorted(known, key=known.__getitem__, reverse=True)
    against = f", {known[first] - known[rest[0]]:.3f} more than {rest[0]}" if rest else ""
    values = fits.found[first].values
    noise = f", noise {10.0 ** values[NOISE_SCALE]:.2f} times as stated" if NOISE_SCALE in values else ""
    outliers = f", {100.0 * 10.0 ** values[OUTLIER_SHARE]:.1f} % outliers" if OUTLIER_SHARE in values else ""
    return (
        f"First verdict, of the fitted ones: {first}, {known[first]:.3f} nats per measurement{against}{noise}{outliers}"
        f". Next, {shipped} shipped filter{'s' * (shipped != 1)} on the same log"
    )


def fit_all(log: FittedLog, family: Tunable) -> tuple[Tunable, Fit, dict[str, Interval]]:
    """Fit one filter to all of a recording; return family, fit, and the intervals of the parameters by name."""
    share, rows = log.share, log.recording.rows
    spans = [Span(i, min(share.warm_up, int(each) - 1), int(each)) for i, each in enumerate(rows)]
    if share.apart:  # side by side it takes a fraction of the time
        spans = [*share.fitted, *share.chosen, *share.judged]
    tunable = log.with_noise(family)
    likelihood = log.likelihood(spans, tunable)
    found = fit(likelihood, tunable, log.seed)
    robust = log.with_noise(family, robust=True)
    if robust != tunable:
        begin = dataclasses.replace(robust, start={**robust.start, **found.values})
        other = log.likelihood(spans, begin)
        again = fit(other, begin, log.seed)
        if again.log_likelihood > found.log_likelihood + DROP:
            tunable, likelihood, found = robust, other, again
    found, profiles = fit_profiles(likelihood, tunable, found)
    return tunable, found, {name: each.interval for name, each in profiles.items()}


def find_outliers(task: Task, recording: Recording, tunable: Tunable, result: Fit) -> numpy.ndarray:
    """Run a fitted filter over a recording; return a mask ``(E, T)`` of measurements treated as outliers."""
    is_outlier: numpy.ndarray = numpy.zeros(recording.seconds.shape, dtype=bool)
    if OUTLIER_SHARE not in result.values:
        return is_outlier
    template, like = measure_once(type(task)(task.parameters), recording.measurements)
    initial = {name: numpy.moveaxis(values, 0, -1) for name, values in recording.initial.items()}
    estimator = tunable.apply(result.values)[1](task)
    # The scale of the noise is outside, the choice between two updates within.
    scaled = estimator if isinstance(estimator, ScaledNoise) else ScaledNoise(estimator, lambda m, _: m, 1.0)
    robust: Any = scaled.own
    state = scaled.start(fill_arrays(template, initial.__getitem__, numpy))
    for k in range(recording.seconds.shape[1]):
        row = {name: numpy.moveaxis(values[:, k], 0, -1) for name, values in recording.measurements.items()}
        measurement = task.world.mask_missing(fill_arrays(like, row.__getitem__, numpy))
        with numpy.errstate(all="ignore"):
            taken = scaled.scaled(measurement, scaled.factor)
            usual, wide, is_outlier[:, k], _ = robust.compare(taken, state.own)
        state = state._replace(own=select_nested(is_outlier[:, k], wide[0], usual[0]))
    return is_outlier & (numpy.arange(is_outlier.shape[1]) < recording.rows[:, None])


def _compare_anchored(log: FittedLog, tunables: Mapping[str, Tunable], fitted: Fit) -> Anchor:
    """Compare a filter with a second sensor to another one by likelihood, on measurements ``APART`` seconds
    apart.

    It is the first of the two ``tunables``, with the fit ``fitted``; the other one is fitted here.
    """
    (name, anchored), (other, best) = tunables.items()
    rival = fit(log.likelihood(log.share.fitted, best, thinned=True), best, log.seed)
    means = []
    for tunable, found in ((anchored, fitted), (best, rival)):
        begin = dataclasses.replace(tunable, start=found.values)
        chosen = log.likelihood(log.share.chosen, begin, thinned=True)
        values = numpy.array([[value] for value in found.values.values()])
        means.append(float(chosen(values)[0]) / chosen.count)
    return Anchor(name, other, means[0] - means[1])
