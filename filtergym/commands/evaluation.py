"""The steps of ``filtergym evaluate``: find data and competitors, run them, make tables, write and print."""

import os
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, NamedTuple

from rich.table import Table

from ..baselines.fitted_filters import SUFFIX
from ..baselines.problem import Problem, problem_of
from ..envs.contract.companions import find_companion
from ..envs.contract.log_format import LogFormat
from ..envs.data.recording import Recording
from ..envs.engine.backend import make_model
from ..envs.engine.catalogue import nearest
from ..envs.logs.flights import names_flights, read_flights
from ..envs.logs.plausibility import WARNING_PREFIX
from ..envs.logs.reading import read_recording
from ..envs.logs.recording_files import is_recording
from ..evaluation.competitors.kinds import Competitor, RandomPolicy, is_program
from ..evaluation.figures.curve_figures import evaluation_figures
from ..evaluation.figures.print_layout import check_columns, check_formats, save
from ..evaluation.running.parallel import LostProcessError, Workers
from ..evaluation.running.summary import Evaluation, EvaluationRequest, run_requests
from ..evaluation.running.supervision import is_supervised
from ..evaluation.running.times import points_of_records
from ..evaluation.statistics.cause_split import phrases_of
from ..evaluation.storage.dataset import MOST_BYTES, notes_of, write_dataset
from ..evaluation.storage.estimates import check_estimates, write_estimates
from ..evaluation.storage.files import whole_files, writable_file, writable_folder, write_text
from ..evaluation.storage.store import Store
from ..extensions import DEPARTURES, load_present
from ..names import find_competitors, ranked_names, shipped_names
from ..reports.pages.outcome import own_sentences
from ..reports.tables.benchmark import drop_smoothers_of_closed_loops, result_of
from ..reports.tables.export import LATEX_WIDTH, latex_table, records_as_csv, write_records
from ..reports.tables.reasons import reason_sentences
from ..reports.tables.recording_tables import recording_tables
from ..reports.tables.results import RESULTS, Result, WorstTrack, settings_of, write_results
from ..reports.tables.terminal_tables import flights_table, results_tables
from ..reports.tables.worst import worst_figures
from .result_output import REPORT, make_report
from .terminal import (
    check_no_recording_options,
    command_line,
    console,
    parse_pair,
    parse_renames,
    print_sentence,
    print_table,
    progress_bar,
)

LARGE = 200_000_000
"""Size of a file, bytes, above which it is written only on request."""
RESERVE = 64_000_000
"""Bytes of the disk that are reserved for the files that are written last."""
MOST_PREDICTIONS = 2_000_000
"""Largest number of measurements, over all competitors, whose estimates are stored, some 200 bytes each."""
TRACKS = ("truth", "estimate", "covariance")
"""Data of measurements that predictions need; written only if estimates are requested."""


class FileOptions(NamedTuple):
    """Options for reading flights and recordings from files."""

    site: str | None
    longest_gap: float
    speeds: str
    smoothing: float
    fewest_scans: int
    truth: Path | None = None
    """File of a recording's truth, where it is separate."""
    truth_offset: float = 0.0
    rename: str | None = None
    """New names of the columns of a recording."""
    sort: bool = False
    """Whether the rows of a recording are sorted by time."""


class Outputs(NamedTuple):
    """Files that an evaluation writes, with their formats, as requested."""

    folder: Path | None
    """Folder for records, a table, the whole result and figures."""
    netcdf: bool | None
    """Whether the whole result is written; None: unless it is large."""
    formats: Sequence[str]
    """File formats of the figures."""
    columns: int
    """Width of the figures, in columns of a page."""
    records: Path | None
    estimates: Path | None

    def check(self) -> None:
        """Raise ValueError for an output file or folder that cannot be written."""
        check_formats(list(self.formats))
        check_columns(self.columns)
        if self.folder is not None:
            writable_folder(self.folder)
        if self.records is not None:
            writable_file(self.records)
        if self.estimates is not None:
            check_estimates(self.estimates)
            (writable_folder if self.estimates.suffix == ".tum" else writable_file)(self.estimates)

    @contextmanager
    def reserve_space(self, competitors: Sequence[Competitor]) -> Iterator[None]:
        """Reserve disk space for the last outputs while programs run that could fill the disk."""
        place = self.folder or self.records or self.estimates
        if place is None or not any(is_program(one.maker) for one in competitors):
            yield
            return
        there = next(own for own in place.absolute().parents if own.is_dir())
        with tempfile.TemporaryFile(dir=there) as held:
            with suppress(OSError, AttributeError):  # a full disk, or a system that cannot
                os.posix_fallocate(held.fileno(), 0, RESERVE)
            yield


def find_data(
    environment: str | None,
    scenario: str | None,
    recording: str | None,
    options: FileOptions,
    keywords: Mapping[str, Any],
) -> tuple[Problem, Any]:
    """Return the problem, and its data: the name of a scenario; or flights or a recording, read from files.

    Raises:
        ValueError: if the environment is not named, or a file cannot be read.
    """
    if recording is not None and scenario is not None:
        raise ValueError("--recording takes the place of --scenario: leave one of them out")
    problem = problem_of(environment) if environment else None
    named = problem.task.scenarios if problem else {}
    if recording is not None or (scenario is not None and scenario not in named and is_recording(scenario)):
        speeds = parse_pair("--speeds", options.speeds)
        found = read_recording(
            recording or str(scenario),
            environment,
            speeds=speeds,
            truth=options.truth,
            truth_offset=options.truth_offset,
            rename=parse_renames(options.rename),
            sort=options.sort,
            **keywords,
        )
        if options.site is not None:
            raise _no_flights(recording or scenario)
        return problem_of(found.environment), found
    check_no_recording_options(options.truth, options.rename, options.sort)
    if problem is None:
        raise ValueError("name an environment, or a recording, which names its own: --recording FILE")
    if scenario in named or not names_flights(scenario):
        if options.site is not None:
            raise _no_flights(scenario)
        return problem, scenario
    return problem, read_flights(
        scenario,
        None if options.site is None else parse_pair("--site", options.site),
        longest_gap=options.longest_gap,
        speeds=parse_pair("--speeds", options.speeds),
        fewest_scans=options.fewest_scans,
        smoothing=options.smoothing,
    )


def _no_flights(name: str | None) -> ValueError:
    return ValueError(f"--site is for flights from files, and {name!r} is none")


def assumed_parameters(environment: str | None, names: Sequence[str]) -> dict[str, float]:
    """Return the noise levels, by parameter, that the first advised filter among the competitors assumed."""
    if environment is None:
        return {}
    advised = [name for name in names if name.endswith(SUFFIX)]
    logs = [found.log for found in find_competitors(problem_of(environment), advised)]
    return next((log.assumed for log in logs if log is not None and log.assumed), {})


def find_participants(
    problem: Problem, data: Any, policies: Sequence[str] | None, trust: bool
) -> list[Competitor]:
    """Return the competitors to evaluate: the named ones, or those of the quick benchmark.

    On a recording the default is all shipped competitors except references and bounds, which need the truth.
    """
    known = problem.baselines
    if policies:
        return find_competitors(problem, policies, trust)
    if not isinstance(data, Recording):
        return find_competitors(
            problem, drop_smoothers_of_closed_loops(problem, known.benchmark or known.names, data)
        )
    return [*causal_competitors(problem, data), *find_competitors(problem, [*known.smoothers])]


def causal_competitors(problem: Problem, recording: Recording, agents: bool = True) -> list[Competitor]:
    """Return the shipped competitors that run causally on a recording: classical, tuned and, if wanted, agents."""
    found = find_competitors(problem, ranked_names(problem))
    # Random actions show nothing of a sensor.
    return [
        one
        for one in found
        if one.maker is not RandomPolicy
        and (not one.learned or (agents and _has_fields(problem, one.maker, recording)))
    ]


def _has_fields(problem: Problem, maker: Any, recording: Recording) -> bool:
    """Return whether a recording supplies all observation fields on which an agent was trained."""
    stored = getattr(maker, "policy", maker)
    header, control = getattr(stored, "header", None), getattr(stored, "control", None)
    if header is None or control is None:
        return True
    model = make_model(problem.task, control, recording, backend="numpy")
    return {*header["fields"]} <= {field.name for field in model.fields}


def has_predictions(problem: Problem, data: Any, names: Sequence[str]) -> bool:
    """Return whether the competitors' predictions of a recording are scored: not beyond ``MOST_PREDICTIONS``."""
    log_format = find_companion(problem.task, LogFormat)
    if not isinstance(data, Recording) or log_format is None or log_format.predict is None:
        return False
    return data.seconds.size * len(set(names)) <= MOST_PREDICTIONS


def tables_of(
    problem: Problem,
    evaluation: Evaluation,
    width: int,
    user_names: Sequence[str] = (),
) -> list[Table]:
    """Return an evaluation's tables, at most ``width`` wide; rows of the user's competitors are marked."""
    tables = (
        [flights_table(evaluation.dataset, evaluation.flights, evaluation.records, width)]
        if evaluation.flights
        else []
    )
    if evaluation.has_truth:
        paper = evaluation.dataset.attrs["paper"]
        compared = results_tables(evaluation.records, problem.knows, width, paper, user_names)
        if paper not in {record.policy for record in evaluation.records}:
            compared[-1].caption = f"{_missing_comparison(problem)}\n{compared[-1].caption}"
        tables += compared
    if evaluation.recorded:
        tables += recording_tables(
            evaluation.records, evaluation.differences, evaluation.has_truth, width, user_names
        )
    return tables


def own_names(problem: Problem, policies: Sequence[str]) -> list[str]:
    """Return the given names that are not shipped with the package: the user's own competitors."""
    shipped = shipped_names(problem)
    return [name for name in dict.fromkeys(policies) if name not in shipped]


def _missing_comparison(problem: Problem) -> str:
    """Return a sentence on why costs are not compared with the paper's algorithm."""
    paper = problem.baselines.compared_paper
    if not paper:
        return "Costs are not compared: the environment names no paper's algorithm."
    return f"Costs are compared with that of {paper} where it takes part: add --policy {paper}."


def run(
    requests: Sequence[EvaluationRequest], outputs: Outputs, workers: Workers, store: Store
) -> tuple[Evaluation, str, dict[str, str]]:
    """Run the competitors of an evaluation, and return the results; a failing one loses only its own row.

    Every number of every episode is stored only on request; ``store`` holds results until all is written.

    Returns:
        The evaluation, why it is not written as a whole (empty if it is), and the errors of failed competitors.

    Raises:
        ValueError: if all of them fail, or one does and the experiment is strict.
    """
    task = requests[0].experiment.make_task()
    measurements = sum(one.measurements for one in requests)
    error = measurements * len(task.components) * 8
    # And two costs, the causes and the NEES.
    refusal = _size_warning(error + 4 * 8 * measurements, error, outputs.netcdf)
    written = outputs.folder is not None and not refusal
    whole = written or outputs.estimates is not None
    failures: dict[str, str] = {}
    found = None
    with progress_bar() as bar:
        line = bar.add_task("evaluating", total=measurements)
        while found is None:
            others = [one for one in requests if one.name not in failures]
            try:
                found = run_requests(
                    others, workers, lambda done: bar.update(line, advance=done), store, whole
                )
            except LostProcessError:
                if workers.alone or not is_supervised():
                    raise
                workers = Workers()  # a process that reports whose code ends it
                bar.update(line, completed=0)
            except ValueError as error:
                words = (f"{one.name!r} {how}" for one in others for how in ("failed", "cannot be made"))
                failed = [own.split("'")[1] for own in words if own in str(error)]
                if len(others) == 1 or not failed or requests[0].experiment.strict:
                    raise
                failures[failed[0]] = str(error)
                bar.update(line, completed=0)
    if outputs.estimates is None:
        tracks = [name for name in found.dataset if name in TRACKS or str(name).startswith("measurement_")]
        found = found._replace(dataset=found.dataset.drop_vars(tracks))
    return found, refusal, failures


def check_explained(explained: Sequence[str], names: Sequence[str]) -> None:
    """Raise ValueError if a competitor whose cost is to be explained is not among the evaluated ones."""
    for name in explained:
        if name not in names:
            raise nearest("competitor to explain", name, names)


def write(
    problem: Problem,
    evaluation: Evaluation,
    refusal: str,
    outputs: Outputs,
    learned: list[str],
    worst: Mapping[str, Sequence[WorstTrack]],
    user_names: Sequence[str],
) -> None:
    """Write the requested files of an evaluation, and print its tables, sentences and the files' paths.

    ``refusal`` is the reason, from :func:`run`, why the whole evaluation is not written.
    """
    printed, in_file = (
        tables_of(problem, evaluation, width, marked)
        for width, marked in ((console.width, user_names), (LATEX_WIDTH, ()))
    )
    sentences = (
        own_sentences(evaluation.records, user_names, evaluation.dataset.attrs["paper"])
        if evaluation.has_truth
        else []
    )
    for sentence in sentences:  # before anything is written, which can fail
        print_sentence(sentence.replace("`", ""), bold=sentence.rindex(": ") - 2)
    if sentences:
        console.print()
    for table in printed:
        print_table(table)
    records = [*evaluation.records, *evaluation.flights]
    if outputs.records is not None:
        write_records(outputs.records, records)
    if outputs.estimates is not None:
        write_estimates(outputs.estimates, evaluation.dataset)
    results: list[Result] = []
    if outputs.folder is not None and evaluation.curves is not None:
        if evaluation.has_truth:
            settings = settings_of(command_line())
            results = [result_of(problem, evaluation, learned, worst, user_names)]
        # The track is for the report alone.
        whole = evaluation.dataset.drop_dims("drawn_episode", errors="ignore")
        if not refusal:  # a summary has no variables
            largest = max(v.nbytes for v in whole.data_vars.values())
            refusal = _size_warning(whole.nbytes, largest, outputs.netcdf)
        with whole_files(outputs.folder) as place:
            write_records(place / "records.json", records)
            records_as_csv(place / "records.csv", records)
            write_text(place / "table.tex", "\n".join(map(latex_table, in_file)))
            if not refusal:
                write_dataset(place / "results.nc", whole)
            points = points_of_records(evaluation.records)
            for name, figure in evaluation_figures(
                evaluation.curves, outputs.columns, None, learned, user_names, points
            ):
                for suffix in outputs.formats:
                    save(figure, place / f"{name}.{suffix}")
            for name, figure in worst_figures(worst, phrases_of(evaluation.dataset), outputs.columns):
                for suffix in outputs.formats:
                    save(figure, place / f"{name}.{suffix}")
            if results:
                write_results(place / RESULTS, results, settings)
    phrases = phrases_of(evaluation.dataset)
    console.print()
    for name in worst:
        for sentence in reason_sentences(evaluation.records, phrases, name):
            print_sentence(sentence)
    for note in [*notes_of(evaluation.dataset), *missing_rows(evaluation.records)]:
        print_sentence(note, bold=len(note) if note.startswith(WARNING_PREFIX) else 0)
    if outputs.folder is not None:
        what = f"figures, records and {RESULTS}" if results else "figures and records"
        console.print(f"{what} in {outputs.folder}")
        if results:
            make_report(results, settings, outputs.folder / REPORT)
        if refusal:
            console.print(f"results.nc is left out: {refusal}", soft_wrap=True)
    if outputs.estimates is not None:
        console.print(f"estimates in {outputs.estimates}", soft_wrap=True)


def missing_rows(records: Sequence[Any]) -> Iterator[str]:
    """Yield a sentence for each competitor whose file of estimates lacks rows, with their share."""
    for record in records:
        if record.metric == "missing" and record.value:
            yield (
                f"{record.policy}: {100.0 * record.value:.3g} % of the measurements have no row in the file; each "
                "repeats the estimate before it, or the initial one"
            )


def departure_lines(
    problem: Problem, data: Any, learned: Sequence[Competitor], keywords: Mapping[str, Any]
) -> Iterator[str]:
    """Yield lines on the noise levels that agents observe of a log, and on how it departs from their training."""
    typical = data.typical if learned and isinstance(data, Recording) else {}
    for name in typical.keys() - keywords.keys():
        yield (
            f"{name} is {typical[name]:g}, the median of what the log states: agents observe deviations over it, and "
            f"costs have its square as unit; --set {name}=VALUE sets another"
        )
    for agent in learned:
        for departure in load_present(DEPARTURES):
            found = departure(problem.task, agent.maker, data, keywords)
            if found is not None:
                yield f"{agent.name}: {found}"


def _size_warning(size: int, largest: int, asked: bool | None) -> str:
    """Return why a dataset of ``size`` bytes is not written as NetCDF; empty if it is written."""
    if asked is False:
        return "--no-netcdf"
    if largest > MOST_BYTES:
        return (
            "it is too large for NetCDF's classic format. From Python, "
            "evaluate(...).to_netcdf(path, engine='h5netcdf') writes it"
        )
    return (
        f"it would have more than {LARGE / 1e6:.0f} MB; --netcdf writes it"
        if size > LARGE and not asked
        else ""
    )
