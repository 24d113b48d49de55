"""A frozen protocol with a name: one number for a competitor over several environments.

A protocol is one file, ``protocols/NAME.toml``: environments, scenarios, split, seed, episodes and statistic. Its
digest stands in every row of results: rows with the same digest can be compared. With c_e the mean cost of episode e
and p_e that of the paper's algorithm in the same episode, the ratio in an environment of M episodes is

    r = exp(1/M sum_e log(c_e / p_e)),

and the number of a competitor that entered all K environments is ``(r_1 ... r_K)^(1/K) - 1``.
"""

import hashlib
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from importlib.resources import files
from pathlib import Path
from typing import Any, Literal, NamedTuple

import msgspec
import numpy

from .baselines.problem import problem_of
from .envs.contract.companions import lost_cost
from .envs.data.foreign_files import read_content
from .envs.engine.catalogue import bare_name, nearest
from .evaluation.competitors.kinds import RANKED, kind_of
from .evaluation.running.metrics import Record
from .evaluation.running.parallel import Workers
from .evaluation.running.rollout import Progress
from .evaluation.running.summary import EvaluationRequest, Summary, combine_summaries, summaries
from .evaluation.running.times import ProcessorTime, times_of_records
from .evaluation.statistics.bootstrap import RESAMPLES, Bootstrap, IntervalEstimate, share_interval
from .names import find_competitor

FOLDER = files(__name__.rpartition(".")[0]) / "protocols"
SUFFIX = ".toml"
MOST_BYTES = 100_000
"""Largest size of a file, bytes."""


class ProtocolEnvironment(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """One environment of a protocol: its id and version, paper's algorithm and scenarios."""

    id: str
    """Gymnasium id."""
    interface: int
    """Version of the agent's observation and reward."""
    paper: str
    """Name of the paper's algorithm, in the reading of lower cost."""
    lost_cost: float
    """Mean cost of an episode beyond which its track is lost."""
    training: str
    """Training scenario, on which the protocol's number is measured."""
    held_out: tuple[str, ...] = ()
    """Held-out scenarios, of which the one of highest cost is reported."""

    @property
    def short(self) -> str:
        """Id without namespace and version."""
        return bare_name(self.id)


class Protocol(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Content of a protocol file: environments, split, seed and episodes."""

    name: str
    year: int
    split: Literal["test", "validation"]
    seed: int
    episodes: int
    """Number of episodes of the training distribution."""
    held_out_episodes: int
    """Number of episodes of every other scenario."""
    resamples: int
    """Resamples of the bootstrap."""
    statistic: str
    time: str
    environments: tuple[ProtocolEnvironment, ...]


def protocol_names() -> list[str]:
    """Return the names of this package's protocols, by number, the newest last."""
    found = [file.name.removesuffix(SUFFIX) for file in FOLDER.iterdir() if file.name.endswith(SUFFIX)]
    return sorted(found, key=lambda name: int(name.rpartition("-")[2]))


def read_protocol(name: str) -> tuple[Protocol, str]:
    """Return a protocol, read from its file and checked, and the SHA-256 digest of the file.

    Args:
        name: name of one of this package, or the path of a ``.toml``.

    Raises:
        ValueError: for another name, a file that is no protocol, or one with another interface, bound, bootstrap or
            scenario than this package.
    """
    if name.endswith(SUFFIX):
        try:
            content = read_content(Path(name), MOST_BYTES)
        except FileNotFoundError:
            raise ValueError(f"there is no file {name}") from None
    elif name in protocol_names():
        content = (FOLDER / f"{name}{SUFFIX}").read_bytes()
    else:
        raise nearest("protocol", name, protocol_names())
    try:
        protocol = msgspec.toml.decode(content, type=Protocol)
    except (msgspec.MsgspecError, ValueError, RecursionError) as error:
        reason = " ".join(str(error).split())
        raise ValueError(f"{name} contains no protocol of filtergym: {reason:.300}") from error
    _check(protocol)
    return protocol, hashlib.sha256(content.replace(b"\r\n", b"\n")).hexdigest()


def _check(protocol: Protocol) -> None:
    """Raise ValueError if this package's version would run another experiment than the protocol states."""
    if not protocol.environments:
        raise ValueError(f"protocol {protocol.name} names no environment")
    pairs: list[tuple[str, Any, Any]] = [("resamples", protocol.resamples, RESAMPLES)]
    for own in protocol.environments:
        problem = problem_of(own.id)
        pairs.append((f"interface of {own.id}", own.interface, problem.task.interface))
        pairs.append((f"lost_cost of {own.id}", own.lost_cost, lost_cost(problem.task)))
        for scenario in (own.training, *own.held_out):
            if scenario not in problem.task.scenarios:
                raise nearest(f"scenario of {own.id}", scenario, problem.task.scenarios)
        if own.paper not in problem.baselines.policies:
            raise nearest(f"paper of {own.id}", own.paper, problem.baselines.policies)
    for what, stated, here in pairs:
        if stated != here:
            raise ValueError(
                f"protocol {protocol.name} states {what} {stated}, and this package has {here}: install the release "
                "that the protocol is of"
            )


class Entry(NamedTuple):
    """A competitor in one environment of a protocol."""

    environment: ProtocolEnvironment
    name: str
    maker: Any
    references: tuple[str, ...] = ()
    """Names of references of the environment that run over the same episodes."""


def find_entries(
    protocol: Protocol, words: Sequence[str], trust: bool = False, rename: Any = None
) -> list[Entry]:
    """Return the competitor entered in each environment of a protocol, from words of the command line.

    Args:
        protocol: protocol to run.
        words: ``NAME`` for all environments, at most once, and ``ENVIRONMENT=NAME`` for one of them.
        trust: whether to load models that can execute code.
        rename: function of a problem and names that returns names; see :func:`.names.isolate_names`.

    Raises:
        ValueError: if nothing is entered, or two for one environment; for unknown names; and for those that may not
            compete.
    """
    short = {own.short: own for own in protocol.environments}
    named: dict[str, str] = {}
    for word in words:
        where, equals, name = word.partition("=")
        if not (equals and where in short):
            where, name = "", word
        if where in named:
            raise ValueError(
                f"--policy names two competitors for {where or 'all environments'}: run them one by one"
            )
        named[where] = name
    if not named:
        raise ValueError(
            "--protocol needs a competitor: --policy NAME, or --policy ENVIRONMENT=NAME for each"
        )
    entries = []
    for own in protocol.environments:
        name = named.get(own.short, named.get("", ""))
        if name:
            entries.append(_find_entry(own, name, trust, rename))
    return entries


def _find_entry(own: ProtocolEnvironment, name: str, trust: bool, rename: Any) -> Entry:
    problem = problem_of(own.id)
    if rename is not None:
        [name] = rename(problem, [name])
    try:
        maker = find_competitor(problem, name, trust).maker
    except ValueError as error:
        raise ValueError(
            f"{own.id}: {error}. --policy {own.short}=NAME enters another competitor there"
        ) from error
    if kind_of(maker) not in RANKED:
        raise ValueError(f"{name!r} is a {kind_of(maker)}: only policies and estimators enter a protocol")
    return Entry(own, name, maker)


class EnvironmentResult(NamedTuple):
    """Result of a competitor in one environment of a protocol: cost, lost tracks, ANEES, time."""

    entry: Entry
    cost: IntervalEstimate
    """Geometric mean of the cost ratios, less one, in the training distribution."""
    lost: IntervalEstimate
    """Share of the episodes whose track is lost."""
    anees: Record | None
    worst: tuple[str, float] | None
    """Held-out scenario with the highest cost against the paper, and that cost; None where there is none."""
    time: ProcessorTime | None
    paper_time: ProcessorTime | None
    costs: Mapping[str, Mapping[str, numpy.ndarray]]
    """Mean cost of every episode, ``(episodes,)``, by scenario and by the name of the competitor, the paper's algorithm
    or a reference.
    """

    @property
    def logarithms(self) -> numpy.ndarray:
        """Logarithms of the cost ratios to the paper's algorithm in the training distribution, ``(episodes,)``."""
        own = self.entry.environment
        costs = self.costs[own.training]
        return numpy.log(costs[self.entry.name] / costs[own.paper])


class ProtocolResult(NamedTuple):
    """Result of the competitors entered in a protocol, in each environment and as one number."""

    protocol: Protocol
    digest: str
    """SHA-256 of its file."""
    environments: list[EnvironmentResult]
    records: list[Record]
    """Records of all scenarios."""

    @property
    def title(self) -> str:
        """Names of the entered competitors, each once, separated by commas."""
        return ", ".join(dict.fromkeys(one.entry.name for one in self.environments))

    @property
    def is_complete(self) -> bool:
        """Whether every environment of the protocol has an entry, without which there is no overall number."""
        return len(self.environments) == len(self.protocol.environments)

    @property
    def cost(self) -> IntervalEstimate | None:
        """Geometric mean over the environments of the cost ratios, less one, with interval; None if not complete."""
        if not self.is_complete:
            return None
        bootstrap = Bootstrap(self.protocol.episodes, self.protocol.resamples)
        logarithms = numpy.stack([one.logarithms for one in self.environments], axis=1)
        return bootstrap.estimate(logarithms, lambda means: numpy.expm1(means.mean(axis=1)))

    @property
    def lost(self) -> float | None:
        """Mean over the environments of the share of lost tracks; None if not complete."""
        return float(numpy.mean([one.lost.value for one in self.environments])) if self.is_complete else None

    @property
    def time(self) -> ProcessorTime | None:
        """Geometric mean over the environments of the time of a measurement; None if it is unknown in any of them."""
        times = [one.time for one in self.environments if one.time is not None]
        if not self.is_complete or len(times) < len(self.environments):
            return None
        mean = math.exp(sum(math.log(time.nanoseconds) for time in times) / len(times))
        return ProcessorTime(mean, all(time.compiled for time in times), any(time.own for time in times))


def run_protocol(
    protocol: Protocol,
    digest: str,
    entries: Sequence[Entry],
    workers: Workers,
    progress: Progress | None = None,
    **options: Any,
) -> ProtocolResult:
    """Run the entries of a protocol and the papers' algorithms, and return the results.

    Args:
        protocol: protocol from :func:`read_protocol`.
        digest: SHA-256 digest of its file.
        entries: entries from :func:`find_entries`.
        workers: processes that share the work.
        progress: function that is called with the number of measurements done.
        **options: ``backend`` and ``threads`` of :class:`.evaluate.Experiment`.

    Raises:
        ValueError: as :func:`.evaluate.run_experiment`.
    """
    requests = [one for entry in entries for cell in _cells(protocol, entry, options) for one in cell]
    found = dict(summaries(requests, workers, progress))
    place = 0
    results, records = [], []
    for entry in entries:
        cells = {}
        for cell in _cells(protocol, entry, options):
            cells[cell[0].experiment.scenario] = [found[place + i] for i in range(len(cell))]
            place += len(cell)
        result, own = _result(entry, cells)
        results.append(result)
        records += own
    return ProtocolResult(protocol, digest, results, records)


def measurements_of(protocol: Protocol, entries: Sequence[Entry]) -> int:
    """Return the number of measurements that a run of a protocol simulates, over all competitors."""
    return sum(one.measurements for e in entries for cell in _cells(protocol, e, {}) for one in cell)


def _cells(protocol: Protocol, entry: Entry, options: Mapping[str, Any]) -> Iterator[list[EvaluationRequest]]:
    """Yield the evaluation requests of each scenario of an entry: paper's algorithm, references, competitor."""
    own = entry.environment
    problem = problem_of(own.id)
    makers = {name: problem.competitor(name) for name in (own.paper, *entry.references)}
    makers[entry.name] = entry.maker
    for scenario in (own.training, *own.held_out):
        usual = scenario == own.training
        episodes = protocol.episodes if usual else protocol.held_out_episodes
        experiment = replace(
            problem.experiment(scenario, episodes, protocol.seed, protocol.split, timed=usual, **options),
            paper=own.paper,
        )
        horizon = experiment.make_task().horizon
        yield [
            EvaluationRequest(experiment, name, maker, problem.baselines.metrics, horizon, curves=False)
            for name, maker in makers.items()
        ]


def _result(entry: Entry, cells: Mapping[str, list[Summary]]) -> tuple[EnvironmentResult, list[Record]]:
    own, name = entry.environment, entry.name
    records = {scenario: combine_summaries(found).records for scenario, found in cells.items()}
    tables = {
        scenario: {(r.policy, r.metric, r.component): r for r in each if r.window == "all"}
        for scenario, each in records.items()
    }

    def estimate(scenario: str, metric: str) -> IntervalEstimate:
        record = tables[scenario][name, metric, ""]
        return IntervalEstimate(
            *(math.nan if v is None else v for v in (record.value, record.low, record.high))
        )

    held = {scenario: estimate(scenario, "geometric_cost_difference").value for scenario in own.held_out}
    worst = max(held, key=held.__getitem__, default=None)
    times = times_of_records(records[own.training])
    costs = {scenario: dict(_costs(each)) for scenario, each in cells.items()}
    # A count over a number: sums over blocks differ in the last bit from processor to processor, which a tie shows.
    episodes = len(costs[own.training][name])
    lost = round(estimate(own.training, "lost_tracks").value * episodes) / episodes
    return EnvironmentResult(
        entry,
        estimate(own.training, "geometric_cost_difference"),
        share_interval(lost, episodes),
        tables[own.training].get((name, "anees", "state")),
        None if worst is None else (worst, held[worst]),
        times.get(name),
        times.get(own.paper),
        costs,
    ), [record for each in records.values() for record in each]


def _costs(found: Sequence[Summary]) -> Iterator[tuple[str, numpy.ndarray]]:
    for one in found:
        assert one.contender.costs is not None  # simulated episodes have a truth, and no bound takes part
        yield one.contender.name, one.contender.costs


def bib_entry(result: ProtocolResult, version: str) -> str:
    """Return a BibTeX entry that cites the protocol of a result, and the version of the package."""
    protocol = result.protocol
    ids = ", ".join(own.short for own in protocol.environments)
    fields = {
        "title": f"{{{protocol.name}}}: a frozen protocol for adaptive filters ({ids})",
        "author": "{The filtergym developers}",
        "year": str(protocol.year),
        "note": f"filtergym {version}, protocol SHA-256 {result.digest}",
    }
    lines = [f"  {key} = {{{value}}}," for key, value in fields.items()]
    return "\n".join([f"@misc{{{protocol.name},", *lines, "}"])
