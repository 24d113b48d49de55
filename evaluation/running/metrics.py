"""Records: the statistics of every competitor of an evaluation, each with its interval, in long form.

A record is one number with its 95 % bootstrap interval over episodes, or over flights where episodes fly several.
Differences and ratios are paired: numerator and denominator are resampled together.
"""

import functools
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy

from ..competitors.kinds import RANKED
from ..statistics.bootstrap import RESAMPLES, Bootstrap, IntervalEstimate, ratio, share_interval
from ..statistics.cause_split import (
    EVERYTHING,
    CauseCosts,
    cause_sums,
    compare_by_cause,
    opponent_of,
    split_by_cause,
)
from ..statistics.cause_split import VARIABLE as CAUSES
from ..statistics.predictions import correlation, stretch_interval
from ..statistics.statistic import ALL, Function, Key, Reduction, Statistic, identity, reduce_run
from ..statistics.time_blocks import FEWEST, BlockBootstrap, TimeUnits
from ..storage.dataset import (
    Losses,
    count_losses,
    groups_of,
    losses_in,
    seed_of,
    slices_of,
    windows_of,
    with_windows,
)
from .own_metrics import Measure, OwnMetrics
from .threads import one_thread
from .times import METRIC, time_of, way_of

if TYPE_CHECKING:
    import xarray

NOTHING = IntervalEstimate(math.nan, math.nan, math.nan)
NEGLIGIBLE = 5e-5
"""Relative difference of costs below which they count as equal."""


class Record(NamedTuple):
    """One statistic of one competitor over one window, with its 95 % interval: a row of the results."""

    environment: str
    control: str
    scenario: str
    policy: str
    kind: str
    """"policy", "estimator", "smoother", "reference" or "bound"."""
    metric: str
    component: str
    window: str
    value: float | None
    low: float | None
    """Lower end of the 95 % interval; None where there is none."""
    high: float | None
    unit: str
    episodes: int
    seed: int
    split: str


def squared_errors(
    run: "xarray.Dataset", component: str, groups: dict[str, tuple[str, ...]]
) -> numpy.ndarray:
    """Return squared errors of a component or group, ``(episodes, time)``; of a bound its mean square errors."""
    parts = list(groups.get(component, (component,)))
    if "mean_square" in run and not numpy.isnan(run["mean_square"].values[0, 0, 0]):
        return run["mean_square"].sel(component=parts).sum("component", skipna=False).values
    return (run["error"].sel(component=parts) ** 2).sum("component", skipna=False).values


def components_and_groups(dataset: "xarray.Dataset") -> dict[str, str]:
    """Return the unit of each component and group with known truth, by name."""
    units = dict(zip(dataset["component"].values.tolist(), dataset["unit"].values.tolist(), strict=True))
    if "truth_known" in dataset.coords:
        known = dataset["truth_known"].values > 0
        units = {name: unit for (name, unit), judged in zip(units.items(), known, strict=True) if judged}
    groups = groups_of(dataset).items()
    return units | {name: units[parts[0]] for name, parts in groups if {*parts} <= {*units}}


def sums_of_present(values: numpy.ndarray) -> numpy.ndarray:
    """Return sum and number of each episode's values that are not NaN, ``(episodes, 2)``."""
    present = ~numpy.isnan(values)
    return numpy.stack([numpy.where(present, values, 0.0).sum(axis=1), present.sum(axis=1)], axis=1)


def bootstrap_of_episodes(dataset: "xarray.Dataset", resamples: int = RESAMPLES) -> Bootstrap:
    """Return the bootstrap over the episodes of an evaluation, or over its flights."""
    clusters = tuple(dataset["flight"].values.tolist()) if "flight" in dataset.coords else None
    return cached_bootstrap(dataset.sizes["episode"], resamples, clusters)


@functools.lru_cache(maxsize=2)
def cached_bootstrap(
    episodes: int, resamples: int = RESAMPLES, clusters: tuple[str, ...] | None = None
) -> Bootstrap:
    """Return the bootstrap over episodes, or over clusters of them; the last two are cached."""
    return Bootstrap(episodes, resamples, clusters=clusters)


def time_units_of(dataset: "xarray.Dataset") -> TimeUnits | None:
    """Return the division of a single long episode into units of successive measurements; else None."""
    if dataset.sizes["episode"] == 1 and dataset.sizes["time"] >= FEWEST:
        return TimeUnits(dataset.sizes["time"])
    return None


def sums_over_time(run: "xarray.Dataset", units: TimeUnits) -> numpy.ndarray | None:
    """Return sums and numbers of costs, or else log-likelihoods, in units of time, ``(units, 2)``; None
    without both.
    """
    known = [name for name in ("cost", "log_likelihood") if name in run]
    return units.sums_of_present(run[known[0]].values) if known else None


def bootstrap_over_time(
    units: TimeUnits, series: Sequence[numpy.ndarray | None], resamples: int = RESAMPLES
) -> Bootstrap:
    """Return the bootstrap over blocks of one episode, whose length follows from the competitors' series."""
    known = [one for one in series if one is not None]
    return BlockBootstrap(units, known, resamples) if known else Bootstrap(1, resamples)


def bootstrap_of(dataset: "xarray.Dataset", resamples: int = RESAMPLES) -> Bootstrap:
    """Return the bootstrap over the episodes of an evaluation, or of a single episode over blocks of time."""
    if (units := time_units_of(dataset)) is None:
        return bootstrap_of_episodes(dataset, resamples)
    runs = (dataset.sel(policy=name) for name in dataset["policy"].values.tolist())
    return bootstrap_over_time(units, [sums_over_time(run, units) for run in runs], resamples)


class Reduced(NamedTuple):
    """Sums and samples over one competitor's episodes, from which its records follow."""

    reduction: Reduction
    units: TimeUnits | None
    """Units of time of one long episode."""
    series: numpy.ndarray | None
    """Sums of the cost or log-likelihood in units of time, from :func:`sums_over_time`."""
    predictions: list[Measure]
    run: "xarray.Dataset"
    """The competitor's part of an evaluation, of which only coordinates and attributes are needed."""

    def without_variables(self) -> "Reduced":
        """Return a copy without the dataset's values, which saves memory."""
        run = self.run.drop_vars(list(self.run.data_vars))
        return self._replace(run=run.isel(time=slice(0, 1)).copy(deep=True))


def reduce_competitor(run: "xarray.Dataset", metrics: OwnMetrics | None = None) -> Reduced:
    """Reduce one competitor's episodes to the sums and samples from which its records follow."""
    # An environment's own metrics need more of the truth than a recording contains.
    own = None if run.attrs.get("recorded") else metrics
    declare = functools.partial(record_statistics, episodes=run.sizes["episode"], metrics=own)
    units = time_units_of(run)
    series = None if units is None else sums_over_time(run, units)
    reduction = reduce_run(run, declare, units or bootstrap_of_episodes(run))
    return Reduced(reduction, units, series, list(prediction_measures(run)), run)


def bootstrap_of_reduced(reduced: Sequence[Reduced], evaluation: "xarray.Dataset") -> Bootstrap:
    """Return the bootstrap of a reduced evaluation: over episodes, or of a single episode over blocks of
    time.
    """
    if (units := reduced[0].units) is None:
        return bootstrap_of_episodes(evaluation)
    return bootstrap_over_time(units, [one.series for one in reduced])


def records_of_reduced(
    reduced: Sequence[Reduced], evaluation: "xarray.Dataset", metrics: OwnMetrics | None = None
) -> list[Record]:
    """Return all records of an evaluation from the sums and samples of its competitors."""
    own = None if evaluation.attrs.get("recorded") else metrics
    bootstrap = bootstrap_of_reduced(reduced, evaluation)
    blocks = bootstrap if isinstance(bootstrap, BlockBootstrap) else None
    contenders = []
    for one in reduced:
        contender = contender_of(one.reduction.results(blocks), one.run, bootstrap, own)
        contenders.append(contender._replace(measures=[*contender.measures, *one.predictions]))
    return records_of(contenders, evaluation, bootstrap)


def mean_over_time(run: "xarray.Dataset", values: numpy.ndarray) -> numpy.ndarray:
    """Return means over time of values ``(episodes, time)``; of flights without the NaN after their ends."""
    if "flight" not in run.coords:
        return values.mean(axis=1)
    return ratio(sums_of_present(values))


def _peak(means: numpy.ndarray) -> numpy.ndarray:
    found: numpy.ndarray = numpy.fmax.reduce(numpy.sqrt(means), axis=1)
    return found


def record_statistics(
    run: "xarray.Dataset", episodes: int, metrics: OwnMetrics | None = None
) -> Iterator[Statistic]:
    """Yield the statistics of one competitor's records as declarations, for some of its episodes."""
    groups, slices = groups_of(run), slices_of(run)
    is_bound = str(run["kind"].values) == "bound"
    judged = run.attrs.get("truth", True)

    def means(metric: str, component: str, unit: str, values: Any, function: Function = identity) -> Any:
        for window, times in slices.items():
            key, mean = ("record", metric, component, window, unit), mean_over_time(run, values[:, times])
            yield Statistic(key, mean, function, of_units=_units(values, times))

    for component, unit in components_and_groups(run).items() if judged else ():
        squares = squared_errors(run, component, groups)
        yield from means("rmse", component, unit, squares, numpy.sqrt)
        yield Statistic(("record", "peak_rmse", component, "all", unit), squares, _peak)
        if not is_bound and component not in groups:
            yield from means("mean_error", component, unit, run["error"].sel(component=component).values)
    for metric in consistency_metrics(run):
        yield from _consistency(run, metric, episodes)
        if metric == "nees":
            of_episodes = ratio(sums_of_present(_over_dimension(run, metric)[0]))
            yield Statistic(("episodes", "anees"), of_episodes, sample=ALL)
    if "mode_probability" in run and not numpy.isnan(run["mode_probability"].values).all():
        for mode in run["mode"].values.tolist():
            yield from means(
                "mean_mode_probability", mode, "1", run["mode_probability"].sel(mode=mode).values
            )
    has_likelihood = "log_likelihood" in run and not numpy.isnan(run["log_likelihood"].values).all()
    if has_likelihood or not judged:  # a user's estimator has no other statistics then
        shape = (run.sizes["episode"], run.sizes["time"])
        log_likelihood = run["log_likelihood"].values if has_likelihood else numpy.full(shape, math.nan)
        for window, times in slices.items():
            yield _mean_of_present("log_likelihood", "measurement", window, "nat", log_likelihood, times)
    if not is_bound and judged:
        yield from means("cost", "", "1", run["cost"].values)
        cost = run["compressed_cost"].values
        total = numpy.nansum(cost, axis=1) if "flight" in run.coords else cost.sum(axis=1)
        yield Statistic(("record", "return", "", "all", "1"), total, numpy.negative)
    if CAUSES in run and not is_bound and judged:
        nees = _over_dimension(run, "nees")[0] if "nees" in consistency_metrics(run) else None
        yield Statistic(("causes",), cause_sums(run, nees), of_units=functools.partial(cause_sums, run, nees))
    if "cost" in run and not is_bound:
        yield Statistic(("cost",), mean_over_time(run, run["cost"].values), sample=ALL)
    if "lost" in run and not numpy.isnan(run["lost"].values).all():
        losses = losses_in(run)
        share = (losses[:, 1] > 0.0).astype(float)
        yield Statistic(("record", "lost_episodes", "", "all", "1"), share)
        yield Statistic(("losses",), losses, count_losses, sample=ALL)
    if "missing" in run and not numpy.isnan(run["missing"].values).all():
        yield _mean_of_present("missing", "", "all", "1", run["missing"].values, slice(None))
    if metrics is not None:
        yield from metrics.statistics(run)


def _mean_of_present(
    metric: str, component: str, window: str, unit: str, values: numpy.ndarray, times: slice
) -> Statistic:
    """Declare a mean over episodes and times without NaN, optional in blocks of episodes."""
    key, sums = ("record", metric, component, window, unit), sums_of_present(values[:, times])
    return Statistic(key, sums, ratio, optional=True, of_units=_units(values, times))


def _units(values: numpy.ndarray, times: slice) -> Callable[[TimeUnits], numpy.ndarray]:
    """Return a function from units of time to sums and numbers of values ``(1, time)`` in them."""
    return functools.partial(TimeUnits.sums_of_present, values=values, times=times)


def _consistency(run: "xarray.Dataset", metric: str, episodes: int) -> Iterator[Statistic]:
    """Declare mean NEES or NIS over its dimension, and the share inside the 95 % chi-square interval.

    Bar-Shalom, Li, Kirubarajan: Estimation with Applications to Tracking and Navigation, 2001, 5.4.
    """
    component = "state" if metric == "nees" else "measurement"
    normalised, degrees = _over_dimension(run, metric)
    values = run[metric].values
    there = ~numpy.isnan(normalised)
    low, high = chi_square_band(degrees)
    inside = numpy.where(there, (values >= low) & (values <= high), numpy.nan)
    inverse = numpy.divide(1.0, degrees, out=numpy.zeros(degrees.shape), where=there)
    for window, times in slices_of(run).items():
        yield _mean_of_present(f"a{metric}", component, window, "1", normalised, times)
        yield _mean_of_present(f"{metric}_inside", component, window, "1", inside, times)
        if metric == "nis":
            sums = numpy.stack([there[:, times].sum(axis=1), inverse[:, times].sum(axis=1)], axis=1)
            key = ("record", "anis_band", component, window, "1")
            yield Statistic(key, sums, functools.partial(_band, episodes=episodes), optional=True)


def _over_dimension(run: "xarray.Dataset", metric: str) -> tuple[numpy.ndarray, numpy.ndarray]:
    """Return NEES or NIS over its dimension, and the dimension, ``(episodes, time)`` each; NaN for dimension
    zero.
    """
    degrees = consistency_degrees(run, metric)
    some = numpy.where(degrees > 0.0, degrees, 1.0)
    return numpy.where(degrees > 0.0, run[metric].values / some, numpy.nan), degrees


def _band(means: numpy.ndarray, episodes: int) -> IntervalEstimate:
    """Return the 95 % interval of ANIS (mean NIS over its dimension) for a consistent filter.

    By the chi-square distribution of the same variance, exact for equal degrees. ``means``
    ``(1 + resamples, 2)`` are those of the count of measurements and of the sum of inverse degrees.
    """
    count, inverse = episodes * means[0]
    if count == 0.0:
        return NOTHING
    total = numpy.array([count**2 / inverse])
    low, high = chi_square_band(total)
    return IntervalEstimate(1.0, float(low[0] / total[0]), float(high[0] / total[0]))


def consistency_metrics(run: "xarray.Dataset") -> list[str]:
    """Return the names among ``nees`` and ``nis`` that a run contains; ``nis`` requires ``nis_degrees``."""
    present = ["nees"] * ("nees" in run) + ["nis"] * ("nis" in run and "nis_degrees" in run)
    return [metric for metric in present if not numpy.isnan(run[metric].values).all()]


def consistency_degrees(run: "xarray.Dataset", metric: str) -> numpy.ndarray:
    """Return the degrees of freedom of ``nees`` or ``nis`` at each measurement, ``(episodes, time)``."""
    if metric == "nis":
        return numpy.nan_to_num(run["nis_degrees"].values)
    # A filter that reports all components has no degrees, though others in the same evaluation may have them.
    degrees = run["nees_degrees"].values if "nees_degrees" in run else math.nan + run["nees"].values
    return numpy.nan_to_num(degrees, nan=float(run.sizes["component"]))


def chi_square_quantile(probability: float, degrees: Any) -> numpy.ndarray:
    """Return the quantile of the chi-square distribution, for an array of degrees of freedom.

    Args:
        probability: probability of smaller numbers.
        degrees: degrees of freedom, a number or an array of any shape, larger than zero.
    """
    from scipy.special import gammaincinv  # scipy.stats has the quantile too, but takes a second to import

    # There are few different degrees, and the quantile is slow.
    different, which = numpy.unique(degrees, return_inverse=True)
    quantiles: numpy.ndarray = 2.0 * gammaincinv(0.5 * different, probability)
    return quantiles[which].reshape(numpy.shape(degrees))


def chi_square_band(degrees: numpy.ndarray, runs: int = 1) -> tuple[numpy.ndarray, numpy.ndarray]:
    """Return the ends of the 95 % interval of the mean of ``runs`` chi-square numbers, for each number of
    degrees.
    """
    low, high = (chi_square_quantile(p, runs * degrees) / runs for p in (0.025, 0.975))
    return low, high


def score(
    cost: numpy.ndarray, paper: numpy.ndarray, reference: numpy.ndarray, bootstrap: Bootstrap
) -> IntervalEstimate:
    """Return ``(C_paper - C) / (C_paper - C_reference)`` with its interval; NaN if the reference is hardly better.

    Arguments are mean costs or log costs in the data and every resample, ``(1 + resamples,)``.
    """
    room = paper - reference
    # Where the reference is not significantly better than the paper, a ratio to their difference means nothing, and
    # where it is worse, a higher cost would give a higher score.
    return bootstrap.interval((paper - cost) / room) if bootstrap.interval(room).low > 0.0 else NOTHING


class Contender(NamedTuple):
    """One competitor with its statistics and costs, for its records and comparisons with others."""

    name: str
    kind: str
    control: str
    measures: list[Measure]
    """Statistics of this competitor alone."""
    further: list[Measure]
    """Statistics that the environment defines, and those by cause."""
    costs: numpy.ndarray | None
    """Mean cost of every episode; None for bounds, and without truth."""
    losses: Losses | None
    causes: CauseCosts | None = None
    """Costs by cause; None for bounds, without truth, and for an evaluation without causes."""
    cost_over_time: numpy.ndarray | None = None
    """For one episode its mean cost in every resample of its measurements, ``(1 + resamples,)``; None for several."""


def mean_cost(dataset: "xarray.Dataset", name: str) -> numpy.ndarray:
    """Return the mean cost over time of every episode of one competitor, ``(episodes,)``."""
    return mean_over_time(dataset, dataset["cost"].sel(policy=name).values)


class _Comparisons:
    """Comparisons of every competitor's costs with the paper's algorithm, the reference and the best competitor.

    Ratios are geometric means over episodes.
    """

    def __init__(
        self, contenders: Sequence[Contender], attrs: Mapping[str, Any], bootstrap: Bootstrap
    ) -> None:
        self.costs = {c.name: c.costs for c in contenders if c.costs is not None}
        self.paper, self.reference, self.bootstrap = attrs["paper"], attrs["reference"], bootstrap
        self._compared = self.paper in self.costs
        self.bound = attrs.get("lost_cost", 0.0)
        means = bootstrap.means_of(self._columns) if self.costs else numpy.empty((1, 0))
        parts = numpy.split(means.T, 4 if self._compared else 3)
        self.means, self.logs, self.lost = (dict(zip(self.costs, part, strict=True)) for part in parts[:3])
        self.wins = dict(zip(self.costs, parts[3], strict=True)) if self._compared else {}
        for c in contenders:
            if c.name in self.costs and c.cost_over_time is not None:
                self.means[c.name], self.logs[c.name] = c.cost_over_time, numpy.log(c.cost_over_time)
        self.ranked = [c.name for c in contenders if c.kind in RANKED and c.costs is not None]
        self.smoothers = {c.name for c in contenders if c.kind == "smoother"}
        # The first of equals, and also where all are NaN, as in flights without measurements.
        own_logs = numpy.array([self.logs[name] for name in self.ranked])
        places = numpy.argmax(own_logs <= own_logs.min(axis=0) + NEGLIGIBLE, axis=0) if self.ranked else []
        self.best = self.ranked[places[0]] if self.ranked else ""
        others = places[1:]
        self.chosen = {
            name: numpy.mean(others == i) if len(others) else math.nan for i, name in enumerate(self.ranked)
        }

    def _columns(self, part: slice) -> numpy.ndarray:
        """Return cost, log cost, loss and win of every competitor for some episodes, ``(some, columns)``."""
        costs = [own[part] for own in self.costs.values()]
        with numpy.errstate(divide="ignore", invalid="ignore"):
            columns = [*costs, *map(numpy.log, costs), *(own > self.bound for own in costs)]
            if self._compared:
                columns += [_wins(own / self.costs[self.paper][part]) for own in costs]
        return numpy.stack(columns, axis=1)

    def with_best(self, name: str) -> Iterator[Measure]:
        """Yield the cost relative to the best competitor's, minus one, and the share of resamples that this one
        wins.
        """
        if name in self.ranked:
            difference = self._difference(name, self.best)
            yield Measure("behind_best", self.best, "all", difference, "1")
            share = float(self.chosen[name])
            yield Measure("best_share", "", "all", IntervalEstimate(share, math.nan, math.nan), "1")

    def _difference(self, name: str, other: str) -> IntervalEstimate:
        """Return the geometric mean of the ratios of two competitors' costs, minus one, with its interval."""
        with numpy.errstate(invalid="ignore", over="ignore"):
            return self.bootstrap.interval(numpy.expm1(self.logs[name] - self.logs[other]))

    def alone(self, name: str) -> Iterator[Measure]:
        """Yield the geometric mean cost, and the share of lost tracks if the environment defines them."""
        if name in self.logs:
            with numpy.errstate(over="ignore"):
                mean = self.bootstrap.interval(numpy.exp(self.logs[name]))
            yield Measure("geometric_cost", "", "all", mean, "1")
            if self.bound > 0.0:
                lost, bootstrap = self.lost[name], self.bootstrap
                # Whole flights are resampled: their episodes are not independent.
                of_episodes = share_interval(float(lost[0]), bootstrap.episodes)
                share = bootstrap.interval(lost) if bootstrap.ragged else of_episodes
                yield Measure("lost_tracks", "", "all", share, "1")

    def with_paper(self, name: str) -> Iterator[Measure]:
        """Yield comparisons with the paper's algorithm, such as score, win rate and paired cost differences."""
        if name not in self.wins:
            return
        bootstrap, cost, paper = self.bootstrap, self.means[name], self.means[self.paper]
        with numpy.errstate(divide="ignore", invalid="ignore"):
            ratios = self.costs[name] / self.costs[self.paper]
        found = {
            "geometric_cost_difference": self._difference(name, self.paper),
            "cost_difference": bootstrap.interval(cost - paper),
            "relative_cost_difference": bootstrap.relative_difference(cost, paper),
            "median_cost_ratio": bootstrap.interval(bootstrap.quantiles(ratios)),
            "win_rate": bootstrap.interval(self.wins[name]),
        }
        # The score compares with a causal reference, which is meaningless for a smoother.
        if self.reference in self.costs and name not in self.smoothers:
            own, none, best = (self.logs[other] for other in (name, self.paper, self.reference))
            found["score"] = score(own, none, best, bootstrap)
        for metric, estimate in found.items():
            yield Measure(metric, "", "all", estimate, "1")


def prediction_measures(run: "xarray.Dataset") -> Iterator[Measure]:
    """Yield size and lag-one correlation of one competitor's innovations, for every group of measured quantities.

    ``prediction_error`` is their root mean square in the sensor's unit, ``innovation_correlation`` zero for
    white ones.
    """
    if "prediction_error" not in run:
        return
    groups = run["measured_group"].values
    for group in dict.fromkeys(groups.tolist()):
        chosen = numpy.flatnonzero(groups == group)
        innovation = numpy.moveaxis(run["prediction_error"].values[..., chosen], -1, 0)
        squares = (innovation**2).sum(axis=0)
        there = numpy.isfinite(squares)
        if not there.any():
            continue
        values = numpy.stack([squares, numpy.ones_like(squares)], axis=-1)
        size = stretch_interval(there, values, lambda means: numpy.sqrt(ratio(means)))
        yield Measure("prediction_error", group, "all", size, str(run["measured_unit"].values[chosen[0]]))
        yield Measure("innovation_correlation", group, "all", correlation(innovation, there), "1")


def _wins(ratio: numpy.ndarray) -> numpy.ndarray:
    """Return 1 for each episode with a cost ratio below one, 0 above, 0.5 for a draw, ``(episodes,)``."""
    # A draw is half a win, so that the paper's algorithm wins half against itself; rounding decides nothing.
    draw = numpy.isclose(ratio, 1.0, rtol=0.0, atol=1e-9)
    return numpy.where(draw, 0.5, ratio < 1.0)


@one_thread()
def flight_records(dataset: "xarray.Dataset") -> list[Record]:
    """Return a record of cost, errors and differences to the paper's algorithm for every flight.

    Their scenario is the set's, a colon and the flight's name; their intervals are over the episodes of that flight.
    """
    parts = parts_by_flight(dataset)
    return [r for part in parts for r in tidy_records(part) if r.metric in PER_FLIGHT]


def parts_by_flight(dataset: "xarray.Dataset") -> "Iterator[xarray.Dataset]":
    """Yield the part of the dataset with each flight's episodes, by the flights' names."""
    for flight in sorted(set(dataset["flight"].values.tolist())):
        own = dataset["flight"].values == flight
        part = dataset if own.all() else dataset.isel(episode=numpy.flatnonzero(own))  # a copy
        part = part.isel(time=slice(int(part["length"].max())))
        windows = {name: (first, part.sizes["time"]) for name, (first, _) in windows_of(part).items()}
        yield with_windows(part.assign_attrs(scenario=f"{dataset.attrs['scenario']}: {flight}"), windows)


PER_FLIGHT = ("rmse", "cost", "geometric_cost", "geometric_cost_difference", "relative_cost_difference")
"""Names of the metrics that are reported for every flight."""


@one_thread()
def tidy_records(dataset: "xarray.Dataset", metrics: OwnMetrics | None = None) -> list[Record]:
    """Return the records of an evaluation: every metric of every competitor with its interval.

    ``rmse`` (root of the mean square over episodes and the window), ``peak_rmse`` (largest over time),
    ``mean_error``; ``anees`` and ``anis`` (mean NEES and NIS over their dimension; one if consistent),
    ``median_anees`` (median over episodes), ``nees_inside`` and ``nis_inside`` (share inside the 95 %
    chi-square interval), ``anis_band`` (95 % interval of the mean of a consistent filter); ``log_likelihood``
    (mean log-density of a measurement under its prediction); ``mean_mode_probability``; ``cost`` (uncapped
    mean), ``return`` (sum of the ``cost`` rewards); ``lost_episodes`` of estimators (share), and of estimates
    from a file ``missing``, the share of measurements without a row. Where the evaluation was timed
    ``nanoseconds``, processor time of a measurement, whose component is ``compiled`` or ``python``. Without
    truth the metrics that need it are left out. For a recording with tracks ``prediction_error`` and
    ``innovation_correlation``, whose intervals are over stretches of measurements.

    ``geometric_cost`` is the geometric mean over episodes, by which competitors are ranked, ``lost_tracks``
    the share of episodes whose mean cost is above the environment's bound. Against the paper's algorithm,
    paired, ``geometric_cost_difference`` (geometric mean of the ratios of the episodes' costs, less one),
    ``cost_difference`` and ``relative_cost_difference`` of the means, ``median_cost_ratio`` and ``win_rate``
    over episodes, ``score`` = (L_paper - L) / (L_paper - L_reference), L mean logarithms of the cost. Against
    the best ranked competitor ``behind_best`` (as the geometric difference; the component names the best) and
    ``best_share``, the share of resamples of the episodes in which this one is the best. And the
    environment's own metrics.

    Args:
        dataset: from an evaluation.
        metrics: metrics of the environment; left out for recordings.
    """
    runs = (dataset.sel(policy=name) for name in dataset["policy"].values.tolist())
    return records_of_reduced([reduce_competitor(run, metrics) for run in runs], dataset, metrics)


def contender_of(
    results: Mapping[Key, Any], run: "xarray.Dataset", bootstrap: Bootstrap, metrics: OwnMetrics | None
) -> Contender:
    """Return a competitor with its statistics, from the results of :func:`record_statistics` over all its
    episodes.
    """
    measures = []
    for (kind, *words), value in results.items():
        if kind == "record":
            metric, component, window, unit = words
            estimate = value if isinstance(value, IntervalEstimate) else bootstrap.interval(value)
            measures.append(Measure(metric, component, window, estimate, unit))
    if (nees := results.get(("episodes", "anees"))) is not None:
        middle = bootstrap.interval(bootstrap.quantiles(nees, mask=~numpy.isnan(nees)))
        measures.append(Measure("median_anees", "state", "all", middle, "1"))
    further = [] if metrics is None else metrics.measures_of(results, bootstrap, run)
    name, kind, control = (str(run[word].values) for word in ("policy", "kind", "control"))
    causes = None
    if ("causes",) in results:
        found, causes = split_by_cause(results["causes",], run, bootstrap)
        further += [Measure(m.metric, "", m.cause, m.estimate, "1") for m in found]
    if (time := time_of(run)) is not None:
        estimate = IntervalEstimate(time.nanoseconds, time.low, time.high)
        measures.append(Measure(METRIC, way_of(time), "all", estimate, "ns"))
    costs, over_time = results.get(("cost",)), None
    if costs is not None and isinstance(bootstrap, BlockBootstrap):
        over_time = results["record", "cost", "", "all", "1"]
    return Contender(
        name, kind, control, measures, further, costs, results.get(("losses",)), causes, over_time
    )


def _compare_causes(
    contender: Contender, contenders: Sequence[Contender], bootstrap: Bootstrap
) -> Iterator[Measure]:
    """Yield the ratio of the mean cost to the opponent's under each cause, which is stored as the window."""
    split = {c.name: c.causes for c in contenders if c.causes is not None}
    if contender.name not in split:
        return
    costs = {name: float(causes.of(EVERYTHING)[0]) for name, causes in split.items()}
    opponent = opponent_of(contender.name, costs, [c.name for c in contenders if c.kind in RANKED])
    if opponent:
        for m in compare_by_cause(split[contender.name], split[opponent], opponent, bootstrap):
            yield Measure(m.metric, m.opponent, m.cause, m.estimate, "1")


def records_of(
    contenders: Sequence[Contender], evaluation: "xarray.Dataset", bootstrap: Bootstrap
) -> list[Record]:
    """Return all records of an evaluation, from its competitors' statistics and comparisons between them."""
    attrs = evaluation.attrs
    against = _Comparisons(contenders, attrs, bootstrap)

    def finite(value: float) -> float | None:
        return float(value) if math.isfinite(value) else None

    records = []
    for c in contenders:
        compared = *against.alone(c.name), *against.with_paper(c.name), *against.with_best(c.name)
        measures = [*c.measures, *compared, *c.further]
        measures += _compare_causes(c, contenders, bootstrap)
        for m in measures:
            records.append(
                Record(
                    attrs["environment"],
                    c.control,
                    attrs["scenario"],
                    c.name,
                    c.kind,
                    m.metric,
                    m.component,
                    m.window,
                    finite(m.estimate.value),
                    finite(m.estimate.low),
                    finite(m.estimate.high),
                    m.unit,
                    bootstrap.episodes,
                    seed_of(evaluation),
                    attrs["split"],
                )
            )
    return records
