"""Submissions: a competitor and its results on a protocol in one file that any user can run again.

A file is JSON of declared types, not compressed, and names no file. An agent is its arrays
(:mod:`..agents.learned_policy`) and executes nothing. An estimator is its source text, which runs only where the reader
trusts it, in a process that receives the measurements only (:mod:`.evaluation.competitors.isolation`). A competitor of
this package is its name.

A second run of a file gives the same numbers but for rounding: the noise of an episode is a function of its seed.
Processors and libraries agree on sums and products, and differ by some units in the last place of functions, u = 2^-53
relative. Over n measurements a filter multiplies such errors by up to n times the condition number kappa of the
matrices that it inverts, so that costs differ by about n * kappa * u: of n = 3000 and kappa = 10^6, 3 * 10^-7.
:data:`TOLERANCE` is the next power of ten.

The seeds of a protocol are public, and a competitor can carry the truth of its episodes. So a verification also runs
fresh episodes, from a seed that did not exist when the file was written, and compares both results number by number.
The interval of a difference of independent numbers a in [a_l, a_u] and b in [b_l, b_u] with a > b has the half-width
sqrt((a - a_l)^2 + (b_u - b)^2) (method of variance estimates recovery: G. Y. Zou and A. Donner, Construction of
confidence limits about effect measures, Statistics in Medicine 27, 2008). The 95 % intervals are stretched to the
confidence 1 - ALARM / n of a normal distribution for n numbers (Bonferroni), so that chance rejects about the share
:data:`ALARM` of correct submissions; over 32 episodes up to six in 10,000 were rejected in the five environments. The
geometric mean of ratios of costs is compared by its logarithm.
"""

import hashlib
import inspect
import math
import secrets
import statistics
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, NamedTuple

import msgspec
import numpy

from .agents.learned_policy import load_policy, pretrained_path
from .agents.named_policies import pretrained_agents
from .agents.training_run import best_agent, training_scenarios
from .baselines.problem import Problem, problem_of
from .envs.contract.parameters import check_integer
from .envs.data.foreign_files import read_content
from .envs.engine.catalogue import import_user_module, nearest
from .envs.engine.scenario_choice import find_mixture
from .evaluation.competitors.isolation import isolate_source
from .evaluation.competitors.kinds import RANKED, kind_of
from .evaluation.running.parallel import Workers
from .evaluation.running.rollout import Progress
from .evaluation.statistics.bootstrap import CONFIDENCE
from .evaluation.storage.files import whole_file
from .protocol import Entry, Protocol, protocol_names, read_protocol, run_protocol

if TYPE_CHECKING:
    from .evaluation.running.metrics import Record

TOLERANCE = 1e-6
"""Largest relative difference of a number in a second run; of a ratio below one, the absolute difference."""
ALARM = 1e-4
"""Share of correct submissions that chance rejects on fresh episodes where estimates are normal, at most."""
SEED_BITS = 128
"""Random bits of the seed of fresh episodes: more than a competitor can try."""
NEGLIGIBLE = 5e-5
"""Relative difference of costs that is rounding."""
SMALLEST = 1e-300
"""Cost, or ratio of costs, that replaces zero under a logarithm."""
MOST_BYTES = 8_000_000
"""Largest size of a file, bytes."""
OWN = "submission"
"""Name of the submitted competitor in its evaluation."""
TIME = "nanoseconds"
"""The metric that differs from run to run: it is reported, not compared."""
RATIOS = (
    "geometric_cost_difference", "lost_tracks", "relative_cost_difference", "anees", "lost_episodes",
)  # fmt: skip
"""Metrics whose scale is one."""
FROZEN = protocol_names()[-1]
"""Name of the newest frozen protocol."""
TRIAL = "trial"
"""Name of a short protocol for trials."""
GEOMETRIC = "geometric_cost_difference"
"""A ratio of costs less one, whose logarithm is compared."""
NOT_COMPARED = "relative_cost_difference"
"""Metric of fresh episodes that is a ratio of two means. Where few lost tracks dominate both, its interval is too
short; the mean cost is compared itself.
"""
METRICS = ("cost", *RATIOS, TIME)
"""Metrics of the results, beside the one that the environment calls physical."""

Name = Annotated[str, msgspec.Meta(pattern=r"^[\w.:/+-]{1,100}\Z")]
Title = Annotated[str, msgspec.Meta(pattern=r"^[\w .,:+()/&'-]{1,80}\Z")]
"""Words without special meaning to a terminal, Markdown or HTML."""
Count = Annotated[int, msgspec.Meta(ge=0, le=2**53)]


class _Stored(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Base of the parts of a submission's file; unknown members are errors."""


class Card(_Stored, frozen=True):
    """The author's description of a submission: title and author."""

    title: Title
    author: Title = "-"


class Figure(_Stored, frozen=True, omit_defaults=True):
    """One number of a submission's results, with its 95 % interval over the episodes."""

    scenario: Name
    metric: Name
    value: float | None
    low: float | None = None
    high: float | None = None
    component: Annotated[str, msgspec.Meta(pattern=r"^[\w.:/+-]{0,100}\Z")] = ""


class Arrays(_Stored, frozen=True, tag="arrays"):
    """Competitor of a submission that is an agent: a safetensors file as ``filtergym export`` writes it."""

    safetensors: bytes


class Source(_Stored, frozen=True, tag="source"):
    """Competitor of a submission that is an estimator: one Python file, and the name of the class in it."""

    text: str
    name: Annotated[str, msgspec.Meta(pattern=r"^[A-Za-z_]\w{0,99}\Z")]


class Shipped(_Stored, frozen=True, tag="shipped"):
    """Competitor of a submission that this package ships: its name."""

    name: Name


class Submission(_Stored, frozen=True):
    """Content of a submission's file: competitor, protocol, description and results."""

    environment: Name
    """Gymnasium id."""
    filtergym: Name
    """Version of the package that made the results."""
    protocol: Name
    protocol_sha256: Annotated[str, msgspec.Meta(pattern=r"^[0-9a-f]{64}\Z")]
    """Digest of the protocol's file; of a trial, of the full protocol's file."""
    card: Card
    competitor: Arrays | Source | Shipped
    results: tuple[Figure, ...]
    format: Literal["filtergym submission 1"] = "filtergym submission 1"


def protocol_of(problem: Problem, name: str) -> tuple[Protocol, str]:
    """Return the part of a frozen protocol for one environment, and the digest of the protocol's file.

    Args:
        problem: problem of the environment.
        name: name of the protocol; or ``"trial"``: 32 episodes of the training distribution, to try.

    Raises:
        ValueError: for another name, and an environment that the protocol lacks.
    """
    names = (*protocol_names(), TRIAL)
    if name not in names:  # a file names no other file
        raise nearest("protocol", name, names)
    whole, digest = read_protocol(FROZEN if name == TRIAL else name)
    own = [one for one in whole.environments if one.id == problem.id]
    if not own:
        raise ValueError(
            f"protocol {whole.name} has no environment {problem.id}: evaluate the competitor instead"
        )
    if name == TRIAL:
        own = [msgspec.structs.replace(own[0], held_out=())]
        whole = msgspec.structs.replace(whole, name=name, episodes=32)
    return msgspec.structs.replace(whole, environments=tuple(own)), digest


# --- files


def read_submission(path: Path) -> tuple[Submission, str]:
    """Return the submission in a file, without running any of it, and the file's SHA-256 digest.

    Args:
        path: path of the file.

    Raises:
        ValueError: if the file is no submission.
    """
    content = _read(path)
    return _decode(path, content), hashlib.sha256(content).hexdigest()


def write_submission(path: Path, submission: Submission) -> str:
    """Write a submission to a file, and return the SHA-256 digest of the file.

    Args:
        path: path of the file.
        submission: submission to write.

    Raises:
        ValueError: if the file cannot be written, or is larger than a reader accepts.
    """
    content = msgspec.json.format(msgspec.json.encode(submission), indent=1) + b"\n"
    if len(content) > MOST_BYTES:
        raise ValueError(
            f"a submission is at most {MOST_BYTES / 1e6:g} MB, and this one has {len(content):,} bytes"
        )
    with whole_file(path) as partial:
        partial.write_bytes(content)
    return hashlib.sha256(content).hexdigest()


def _read(path: Path) -> bytes:
    try:
        return read_content(path, MOST_BYTES)
    except FileNotFoundError:
        raise ValueError(f"there is no file {path}") from None
    except ValueError as error:
        raise ValueError(f"{path} is no submission: {error}") from error


def _decode(path: Path, content: bytes) -> Submission:
    try:
        return msgspec.json.decode(content, type=Submission)
    except (msgspec.MsgspecError, ValueError, RecursionError) as error:
        reason = " ".join(str(error).split())  # it may quote the file
        raise ValueError(f"{path} contains no submission of filtergym: {reason:.300}") from error


# --- competitors


def pack(problem: Problem, name: str) -> Arrays | Source | Shipped:
    """Return a competitor as the part of a submission: arrays, source text, or its name if it is shipped.

    Args:
        problem: problem of the competitor.
        name: name of a shipped agent or a classical competitor; a ``.safetensors``; the folder of a run that has one;
            or ``module:Class``, of a module in one file that imports installed packages only.

    Raises:
        ValueError: for any other name.
    """
    if name in pretrained_agents(problem.id):
        return Arrays(pretrained_path(problem.id, name).read_bytes())
    if name in problem.baselines.names:
        return Shipped(name)
    path = Path(name)
    if path.is_dir():
        path = best_agent(path)
        if path.suffix != ".safetensors":
            raise ValueError(f"{name} contains a model only: filtergym export {name} writes its arrays")
    if path.suffix == ".safetensors":
        return Arrays(_read(path))
    module, colon, attribute = name.partition(":")
    if not colon:
        raise nearest(
            "competitor to submit", name, [*problem.baselines.names, *pretrained_agents(problem.id)]
        )
    found = import_user_module(module, f"cannot submit {name!r}")
    if colon and kind_of(getattr(found, attribute, None)) != "estimator":
        raise ValueError(
            f"cannot submit {name!r}: as source code an estimator can be submitted, with start and update"
        )
    try:
        text = inspect.getsource(found)
    except (OSError, TypeError) as error:
        raise ValueError(f"cannot submit {name!r}: {module} is not one file of Python") from error
    return Source(text, attribute)


def unpack(problem: Problem, submission: Submission, path: Path, trust: bool = False) -> Any:
    """Return the factory of the competitor in a submission: agent, source code or shipped filter.

    Raises:
        ValueError: if it contains source code and is not trusted; for an object that is no competitor, a competitor
            that uses the truth, or an agent that was trained on held-out data.
    """
    held = submission.competitor
    if isinstance(held, Arrays):
        return _load_agent(problem, held, path)
    if isinstance(held, Source):
        if not trust:
            raise ValueError(
                f"{path} contains source code, which a verification executes: read it (--source FILE writes it), "
                "and if you trust it add --trust"
            )
        return isolate_source(held.text, held.name, f"source of {path}")
    if held.name in problem.baselines.names:
        found = problem.competitor(held.name)
    else:
        raise nearest("competitor", held.name, problem.baselines.names)
    if kind_of(found) not in RANKED:
        raise ValueError(
            f"{path} names a {kind_of(found)}, which may know more than the sensors measure: only policies and "
            "estimators can be submitted"
        )
    return found


def _load_agent(problem: Problem, arrays: Arrays, path: Path) -> Any:
    """Return the agent of a submission, loaded from its arrays."""
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "agent.safetensors"
        file.write_bytes(arrays.safetensors)
        try:
            found = load_policy(problem.task, file)
            stored: Any = getattr(found, "policy", found)
            _check_trained(problem, stored.header["run"].get("scenario"))
        except (ValueError, TypeError, AttributeError, KeyError, RecursionError) as error:
            text = str(error).replace(str(file), "its agent")
            raise ValueError(f"{path}: {''.join(c if c.isprintable() else ' ' for c in text)}") from error
    stored.path = path  # in errors from now on; its own is gone
    return found


def _check_trained(problem: Problem, scenario: Any) -> None:
    """Raise ValueError unless an agent was trained on training scenarios of the environment alone."""
    for name in find_mixture(problem.task, scenario) or [scenario or problem.task.default_scenario]:
        if not (isinstance(name, str) and name in problem.task.scenarios):
            raise nearest("scenario", name, problem.task.scenarios)
        training_scenarios(problem.task, name)


# --- runs


def make_submission(
    problem: Problem,
    name: str,
    protocol: str,
    card: Card,
    workers: Workers,
    progress: Progress | None = None,
) -> Submission:
    """Run a protocol with a competitor, and return the submission with its results.

    Args:
        problem: problem to solve.
        name: name of the competitor, see :func:`pack`.
        protocol: name of the protocol.
        card: description by the author.
        workers: processes that share the work.
        progress: function that is called with the number of measurements done.

    Raises:
        ValueError: for a competitor that :func:`verify` would refuse.
    """
    from . import __version__

    _, digest = protocol_of(problem, protocol)
    held, path = pack(problem, name), Path(name)
    submission = Submission(problem.id, __version__, protocol, digest, card, held, ())
    submission = _decode(path, msgspec.json.encode(submission))  # of its declared types
    made = run_submission(problem, submission, path, True, workers, progress)
    return msgspec.structs.replace(submission, results=made.figures)


def check_submission(problem: Problem, submission: Submission, path: Path) -> Protocol:
    """Return a submission's protocol, after a check of its digest against this package's."""
    protocol, digest = protocol_of(problem, submission.protocol)
    if submission.protocol_sha256 != digest:
        raise ValueError(
            f"{path}: its protocol {protocol.name!r} is not that of this package, whose SHA-256 is {digest}"
        )
    return protocol


class Suspicion(NamedTuple):
    """Suspicion that a competitor knows the truth: its cost is significantly below a reference's."""

    scenario: str
    reference: str
    knows: str
    """The reference's knowledge beyond the measurements."""
    difference: float
    """Geometric mean of the ratios of the episodes' costs, less one."""


class Run(NamedTuple):
    """Results of a submission over the episodes of one seed."""

    seed: int
    figures: tuple[Figure, ...]
    suspicions: tuple[Suspicion, ...]
    """Suspicions from the references that took part."""


def run_submission(
    problem: Problem,
    submission: Submission,
    path: Path,
    trust: bool,
    workers: Workers,
    progress: Progress | None = None,
    seed: int | None = None,
    references: bool = False,
) -> Run:
    """Run the competitor of a submission over the scenarios of its protocol, and return the results.

    ``seed`` is that of other episodes than the protocol's; with ``references`` costs are compared with the
    environment's reference.

    Raises:
        ValueError: as :func:`check_submission` and :func:`unpack`.
    """
    protocol = check_submission(problem, submission, path)
    if seed is not None:
        protocol = msgspec.structs.replace(protocol, seed=seed)
    beside = [problem.baselines.score_reference] if references else []
    beside = [name for name in beside if name in problem.baselines.references]  # a bound has no cost
    maker = unpack(problem, submission, path, trust)
    entry = Entry(protocol.environments[0], OWN, maker, tuple(beside))
    found = run_protocol(protocol, submission.protocol_sha256, [entry], workers, progress)
    suspicions = _suspicions(problem, beside, found.environments[0].costs)
    return Run(protocol.seed, tuple(_figures(found.records, problem.baselines.physical)), tuple(suspicions))


def _suspicions(
    problem: Problem, references: Sequence[str], costs: Mapping[str, Mapping[str, numpy.ndarray]]
) -> Iterator[Suspicion]:
    """Yield a suspicion for each reference and scenario of significantly higher cost (paired t-test)."""
    critical = _critical(len(references) * len(costs))
    for name in references:
        for scenario, own in costs.items():
            logs = numpy.log(numpy.maximum(own[OWN], SMALLEST) / numpy.maximum(own[name], SMALLEST))
            mean, error = float(logs.mean()), float(logs.std(ddof=1)) / math.sqrt(len(logs))
            if mean + critical * error < -NEGLIGIBLE:
                yield Suspicion(scenario, name, problem.knows[name], math.expm1(mean))


def _figures(records: "Sequence[Record]", physical: tuple[str, str]) -> Iterator[Figure]:
    for r in records:
        wanted = r.metric in METRICS or (r.metric, r.component) == physical
        if r.policy == OWN and r.window == "all" and wanted:
            yield Figure(r.scenario, r.metric, r.value, r.low, r.high, r.component)


class Deviation(NamedTuple):
    """The largest deviation of a submission's results from those of a second run, over the allowed one."""

    size: float
    """Size in units of what rounding, or on fresh episodes chance, explains; infinite where one of both has
    no number.
    """
    sentence: str

    @property
    def holds(self) -> bool:
        """Whether rounding, or on fresh episodes chance, explains the deviation."""
        return self.size <= 1.0


def deviation(claimed: Sequence[Figure], repeated: Sequence[Figure]) -> Deviation:
    """Return the largest deviation of results from a second run over the same episodes, without times.

    Args:
        claimed: results of a file.
        repeated: results of the second run.
    """
    stated, known = _by_name(claimed), _by_name(repeated)
    worst = Deviation(0.0, "")
    if stated.keys() != known.keys() or len(stated) != sum(f.metric != TIME for f in claimed):
        odd = sorted(stated.keys() ^ known.keys())
        which = " ".join(odd[0]) if odd else "a number twice"
        return Deviation(float("inf"), f"its results are not those of its protocol: {which}")
    for key, own in known.items():
        for one, other, which in zip(
            _numbers(stated[key]), _numbers(own), ("", "lower end of ", "upper end of "), strict=True
        ):
            size = 0.0 if one is None and other is None and which else float("inf")
            if one is not None and other is not None:
                size = abs(one - other) / (TOLERANCE * (abs(other) + (key[1] in RATIOS)) or 1.0)
            if math.isnan(size):  # NaN never passes
                size = math.inf
            if size > worst.size:
                name = f"{which}{key[1]} {key[2]}".rstrip()
                worst = Deviation(
                    size,
                    f"{name} in scenario {key[0]!r} is {_number(other)}, and the file states {_number(one)}",
                )
    return worst


def fresh_deviation(claimed: Sequence[Figure], fresh: Sequence[Figure]) -> Deviation:
    """Return the largest deviation of results from those over other episodes, by both intervals, without times.

    Args:
        claimed: results of a file, which hold on their own episodes.
        fresh: results on fresh episodes, of the same scenarios and metrics.

    Raises:
        KeyError: for other scenarios or metrics.
    """
    stated = _by_name(claimed)
    known = {key: own for key, own in _by_name(fresh).items() if own.metric != NOT_COMPARED}
    worst, critical = Deviation(0.0, ""), _critical(len(known))
    for key, own in known.items():
        size = _errors_apart(stated[key], own) / critical
        if size > worst.size:
            name = f"{key[1]} {key[2]}".rstrip()
            worst = Deviation(
                size,
                f"{name} in scenario {key[0]!r} is {_estimate(own)}, and the file states {_estimate(stated[key])}",
            )
    return worst


def _by_name(figures: Sequence[Figure]) -> dict[tuple[str, str, str], Figure]:
    return {(f.scenario, f.metric, f.component): f for f in figures if f.metric != TIME}


def _numbers(figure: Figure) -> tuple[float | None, float | None, float | None]:
    return figure.value, figure.low, figure.high


def _critical(count: int) -> float:
    """Return how many standard errors contain all of ``count`` normal numbers, with probability 1 - ``ALARM``."""
    return statistics.NormalDist().inv_cdf(1.0 - 0.5 * ALARM / max(count, 1))


def _errors_apart(one: Figure, other: Figure) -> float:
    """Return the difference of two independent numbers in standard errors; infinite without intervals."""
    scale = []
    for figure in (one, other):
        numbers = [math.nan if number is None else number for number in _numbers(figure)]
        if figure.metric == GEOMETRIC:
            numbers = [math.log(max(1.0 + number, SMALLEST)) for number in numbers]
        scale.append(numbers)
    (a, _, a_high), (b, b_low, _) = sorted(scale)
    within = statistics.NormalDist().inv_cdf(0.5 + 0.5 * CONFIDENCE)
    error = math.hypot(a_high - a, b - b_low) / within
    if math.isnan(error) or not math.isfinite(b - a):
        return math.inf
    if b - a <= TOLERANCE * max(abs(a), abs(b)):  # also where both have no width
        return 0.0
    return (b - a) / error if error > 0.0 else math.inf


def _estimate(figure: Figure) -> str:
    return f"{_number(figure.value)} [{_number(figure.low)}, {_number(figure.high)}]"


def _number(value: float | None) -> str:
    return "not known" if value is None else f"{value:.9g}"


class Verification(NamedTuple):
    """Result of a verification of a submission: deviations on the same and on fresh episodes, suspicions."""

    submission: Submission
    digest: str
    """SHA-256 digest of the file."""
    deviation: Deviation
    """Deviation of the file's results from those over the same episodes here."""
    again: tuple[Figure, ...]
    """Results over the same episodes here."""
    fresh: Run | None
    """Results over fresh episodes, with the seed that repeats them; None where the same episodes decided."""
    fresh_deviation: Deviation
    """Deviation of the file's results from the fresh ones."""
    suspicions: tuple[Suspicion, ...]
    """Costs below the attainable one, over the fresh episodes, or over the same where there are none."""

    @property
    def holds(self) -> bool:
        """Whether the claims hold: rounding explains the deviation on the same episodes, chance that on fresh ones."""
        return self.deviation.holds and self.fresh_deviation.holds


def verify(
    path: Path,
    trust: bool = False,
    workers: Workers | None = None,
    progress: Progress | None = None,
    seed: int | None = None,
    same_seeds: bool = False,
) -> Verification:
    """Run the protocol of a submission again, on its own and on fresh episodes, and compare the results.

    Results that do not hold on their own episodes are not run on fresh ones.

    Args:
        path: path of the file.
        trust: whether to run source code.
        workers: processes that share the work; default: this process.
        progress: function that is called with the number of measurements done.
        seed: seed of the fresh episodes, to repeat a verification; default: 128 random bits.
        same_seeds: run the episodes of the protocol only. A competitor that carries their truth passes.

    Raises:
        ValueError: if it is no submission, not of this package's protocol, or contains source code and is not
            trusted; and for a seed that is invalid, is the protocol's, or is given with ``same_seeds``.
    """
    submission, digest = read_submission(path)
    problem = problem_of(submission.environment)
    if seed is not None:
        seed = check_integer("seed", seed, 0)
        if same_seeds:
            raise ValueError(f"the same seeds leave no choice of a seed: leave out seed {seed} or same_seeds")
        if seed == check_submission(problem, submission, path).seed:
            raise ValueError(
                f"seed {seed} is that of the protocol, whose episodes are public: choose another, or same_seeds"
            )
    workers = workers or Workers()
    again = run_submission(problem, submission, path, trust, workers, progress, None, same_seeds)
    found = deviation(submission.results, again.figures)
    if same_seeds or not found.holds:
        return Verification(
            submission, digest, found, again.figures, None, Deviation(0.0, ""), again.suspicions
        )
    seed = secrets.randbits(SEED_BITS) if seed is None else seed
    fresh = run_submission(problem, submission, path, trust, workers, progress, seed, True)
    apart = fresh_deviation(submission.results, fresh.figures)
    return Verification(submission, digest, found, again.figures, fresh, apart, fresh.suspicions)
