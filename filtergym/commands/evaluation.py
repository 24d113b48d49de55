"""The steps of ``filtergym evaluate``: find what is evaluated, run it, make tables, write and print."""

import math
import warnings
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy
import xarray
from rich.table import Table

from ..agents.envelope import departure
from ..agents.named_policies import pretrained_agents
from ..baselines.problem import Problem, problem_of
from ..envs.contract.companions import find_companion
from ..envs.contract.log_format import LogFormat
from ..envs.data.flights import names_flights, read_flights
from ..envs.data.plausibility import LOUD
from ..envs.data.recording import Recording
from ..envs.data.recording_files import is_recording
from ..envs.engine.backend import make_model
from ..envs.engine.catalogue import nearest
from ..envs.engine.scenario_choice import make_task, read_recording
from ..evaluation.competitors.kinds import RandomPolicy
from ..evaluation.figures.curve_figures import evaluation_figures
from ..evaluation.figures.print_layout import check_columns, check_formats, save
from ..evaluation.running.curves import curves_of
from ..evaluation.running.evaluate import Experiment, run_experiment
from ..evaluation.running.metrics import flight_records, mean_cost
from ..evaluation.running.parallel import Workers
from ..evaluation.running.summary import combine_summaries, summaries
from ..evaluation.statistics.bootstrap import Estimate
from ..evaluation.statistics.cause_split import phrases_of
from ..evaluation.statistics.predictions import Predictions, mean_of
from ..evaluation.storage.dataset import MOST_BYTES, notes_of, write_dataset
from ..evaluation.storage.estimates import check_estimates, write_estimates
from ..evaluation.storage.files import whole_files, writable_file, writable_folder, write_text
from ..evaluation.storage.store import UNFINISHED, Store
from ..names import competitors_of, evaluation_requests, find_competitor, tidy_records
from ..reports.tables.benchmark import result_of, without_smoothers_of_closed_loops
from ..reports.tables.export import LATEX_WIDTH, latex_table, records_as_csv, write_records
from ..reports.tables.reasons import explained_by_default, reason_sentences
from ..reports.tables.recording_tables import recording_tables
from ..reports.tables.results import RESULTS, Result, WorstTrack, settings_of, write_results
from ..reports.tables.terminal_tables import flights_table, results_tables
from ..reports.tables.work import work_of
from ..reports.tables.worst import worst_figures
from .shown import REPORT, make_report
from .terminal import (
    check_no_recording_options,
    command_line,
    console,
    pair,
    print_sentence,
    print_table,
    progress_bar,
    renamed,
)

LARGE = 200_000_000
"""Bytes of a file that nobody expects without having asked for it."""
MOST_PREDICTIONS = 2_000_000
"""Measurements of all competitors whose estimates are kept, some 200 bytes each."""
TRACKS = ("truth", "estimate", "covariance")
"""What is kept of measurements for predictions, and not written unless estimates are asked for."""
MOST_RECORDINGS = 40
"""Of which a table tells one by one."""


class FileOptions(NamedTuple):
    """How flights and recordings are read from files, as options of a command."""

    site: str | None
    longest_gap: float
    speeds: str
    smoothing: float
    fewest_scans: int
    truth: Path | None = None
    """Of a recording, in a file of its own."""
    truth_offset: float = 0.0
    rename: str | None = None
    """Of the columns of a recording."""


class Outputs(NamedTuple):
    """What an evaluation writes, and where."""

    folder: Path | None
    """For records, a table, the whole result and figures."""
    netcdf: bool | None
    """Whether the whole result is written; None: unless it is large."""
    formats: Sequence[str]
    """Of figures."""
    columns: int
    """Of a page, that figures are wide."""
    records: Path | None
    estimates: Path | None

    def check(self) -> None:
        """Raise ValueError for what cannot be written."""
        check_formats(list(self.formats))
        check_columns(self.columns)
        if self.folder is not None:
            writable_folder(self.folder)
        if self.records is not None:
            writable_file(self.records)
        if self.estimates is not None:
            check_estimates(self.estimates)
            (writable_folder if self.estimates.suffix == ".tum" else writable_file)(self.estimates)


def find_data(
    environment: str | None,
    scenario: str | None,
    recording: str | None,
    options: FileOptions,
    keywords: Mapping[str, Any],
) -> tuple[Problem, Any]:
    """Return the problem, and the scenario: its name, flights, or a recording.

    Raises:
        ValueError: if nothing names the environment, or a file cannot be read.
    """
    if recording is not None and scenario is not None:
        raise ValueError("--recording takes the place of --scenario: leave one of them out")
    problem = problem_of(environment) if environment else None
    named = problem.task.scenarios if problem else {}
    if recording is not None or (scenario is not None and scenario not in named and is_recording(scenario)):
        speeds = pair("--speeds", options.speeds)
        found = read_recording(
            recording or str(scenario),
            environment,
            speeds=speeds,
            truth=options.truth,
            truth_offset=options.truth_offset,
            rename=renamed(options.rename),
            **keywords,
        )
        if options.site is not None:
            raise _no_flights(recording or scenario)
        return problem_of(found.environment), found
    check_no_recording_options(options.truth, options.rename)
    if problem is None:
        raise ValueError("name an environment, or a recording, which names its own: --recording FILE")
    if scenario in named or not names_flights(scenario):
        if options.site is not None:
            raise _no_flights(scenario)
        return problem, scenario
    return problem, read_flights(
        scenario,
        None if options.site is None else pair("--site", options.site),
        longest_gap=options.longest_gap,
        speeds=pair("--speeds", options.speeds),
        fewest_scans=options.fewest_scans,
        smoothing=options.smoothing,
    )


def _no_flights(name: str | None) -> ValueError:
    return ValueError(f"--site is for flights from files, and {name!r} is none")


def find_names(problem: Problem, data: Any, policies: Sequence[str] | None) -> list[str]:
    """Return the names of who is evaluated: those that are given, or those of the quick benchmark.

    Args:
        problem: whose they are.
        data: of :func:`find_data`. To a recording all that could run on it is asked, tuned and learned ones, too;
            references and bounds are told what it does not hold.
        policies: names that are given.
    """
    known = problem.baselines
    if policies:
        return list(policies)
    if not isinstance(data, Recording):
        return list(without_smoothers_of_closed_loops(problem, known.benchmark or known.names, data))
    return [*causal_names(problem, data), *known.smoothers]


def causal_names(problem: Problem, recording: Recording) -> list[str]:
    """Return the names of all that can run on a recording as it comes: classical, tuned and learned."""
    # What is drawn by lot says nothing of anybody's sensors.
    known = problem.baselines
    classical = [name for name in known.policies if problem.competitor(name) is not RandomPolicy]
    return [
        *classical,
        *known.estimators,
        *problem.tuned_policies,
        *(name for name in pretrained_agents(problem.id) if _knows_fields(problem, name, recording)),
    ]


def _knows_fields(problem: Problem, name: str, recording: Recording) -> bool:
    """Whether an agent was trained on fields that are shown of a recording: one of other axes shows others."""
    maker = find_competitor(problem, name)
    stored = getattr(maker, "policy", maker)
    header, control = getattr(stored, "header", None), getattr(stored, "control", None)
    if header is None or control is None:
        return True
    model = make_model(problem.task, control, recording, backend="numpy")
    return {*header["fields"]} <= {field.name for field in model.fields}


def keeps_predictions(problem: Problem, data: Any, names: Sequence[str]) -> bool:
    """Whether estimates are kept to say what they predicted: of recordings that are not huge.

    Args:
        problem: that is evaluated.
        data: of :func:`find_data`.
        names: of competitors.
    """
    log_format = find_companion(problem.task, LogFormat)
    if not isinstance(data, Recording) or log_format is None or log_format.predict is None:
        return False
    return data.seconds.size * len(set(names)) <= MOST_PREDICTIONS


class Outcome(NamedTuple):
    """What an evaluation has found."""

    dataset: xarray.Dataset
    records: list[Any]
    curves: Any
    """For figures; None where none are drawn."""
    refusal: str
    """Why the whole result is not written; empty where it is."""
    store: Store
    """Keeps what is done until all is written."""
    costs: Mapping[str, numpy.ndarray]
    """Mean cost of every episode by name, of all whose cost is known."""

    @property
    def has_truth(self) -> bool:
        """Whether errors and costs are known."""
        return bool(self.dataset.attrs["truth"])

    @property
    def flights(self) -> list[Any]:
        """Records of every flight, where few enough are told apart."""
        each = "flight" in self.dataset.coords and self.has_truth
        if each and self.dataset.attrs["recorded"]:
            each = self.dataset.sizes["episode"] <= MOST_RECORDINGS
        return flight_records(self.dataset) if each else []

    def explained(self, names: Sequence[str], wanted: Sequence[str]) -> list[str]:
        """Return whose cost is explained.

        Args:
            names: that the user wants evaluated.
            wanted: names that the user wants explained; none: see :func:`.reports.tables.reasons.explained_by_default`.
        """
        return list(wanted) or explained_by_default(self.records, names, self.dataset.attrs["paper"])

    def differences(self, problem: Problem) -> dict[str, Estimate]:
        """Log-likelihood per measurement less that of the best, by name."""
        predictions = Predictions(self.dataset, make_task(problem.task))
        everywhere = numpy.ones(predictions.shape, dtype=bool)
        means = {name: mean_of(predictions.log_likelihood(name), everywhere) for name in predictions.names}
        known = [name for name, mean in means.items() if not math.isnan(mean)]
        best = max(known, key=means.__getitem__, default=None)
        return {} if best is None else {name: predictions.difference(name, best) for name in known}

    def tables(
        self, problem: Problem, flights: list[Any], differences: Mapping[str, Estimate], width: int
    ) -> list[Table]:
        """Return what is printed in so many columns, widest first."""
        tables = [flights_table(self.dataset, flights, self.records, width)] if flights else []
        if self.has_truth:
            compared = results_tables(self.records, problem.knows, width)
            paper = self.dataset.attrs["paper"]
            if paper not in {record.policy for record in self.records}:
                compared[-1].caption = f"{_without_comparison(paper)}\n{compared[-1].caption}"
            tables += compared
        if self.dataset.attrs["recorded"]:
            tables += recording_tables(self.records, differences, self.has_truth, width)
        return tables


def _without_comparison(paper: str) -> str:
    """Explain why costs are compared with none, where the paper's algorithm of this name did not take part."""
    if not paper:
        return "Costs are not compared: the environment names no paper's algorithm."
    return f"Costs are compared with that of {paper} where it takes part: add --policy {paper}."


def run(
    problem: Problem,
    experiment: Experiment,
    names: Sequence[str],
    outputs: Outputs,
    workers: Workers,
    trust: bool,
) -> Outcome:
    """Run the competitors of these names.

    Every number of every episode is kept only where it is asked for, or must be: flights are told one by one.

    Args:
        problem: whose they are.
        experiment: over what they run.
        names: of competitors.
        outputs: what will be written.
        workers: who share the work.
        trust: load models that can execute code.
    """
    task = experiment.make_task()
    measurements = len(set(names)) * experiment.episodes * task.horizon
    size = measurements * len(task.components) * 8
    refusal = _size_warning(size, size, outputs.netcdf)
    store = Store(None if outputs.folder is None else outputs.folder / UNFINISHED)
    whole = outputs.folder is not None and not refusal
    with progress_bar() as bar:
        line = bar.add_task("evaluating", total=measurements)

        def tick(done: int) -> None:
            bar.update(line, advance=done)

        if task.flights or outputs.estimates is not None or whole:
            makers = competitors_of(problem, names, trust)
            named = replace(experiment, paper=problem.paper_among(makers))
            dataset = run_experiment(named, makers, tick, workers)
            records = tidy_records(dataset)
            if outputs.estimates is None:
                tracks = [name for name in dataset if name in TRACKS or str(name).startswith("measurement_")]
                dataset = dataset.drop_vars(tracks)
            curves = None if outputs.folder is None else curves_of(dataset)
            return Outcome(dataset, records, curves, refusal, store, _episode_costs(dataset))
        requests = evaluation_requests(problem, experiment, names, trust, curves=outputs.folder is not None)
        work = [] if outputs.folder is None else [work_of(problem, one) for one in requests]
        found = dict(summaries(requests, workers, tick, store, work))
    records, summary_curves, dataset = combine_summaries([found[i] for i in range(len(found))])
    contenders = [one.contender for one in found.values()]
    costs = {c.name: c.costs for c in contenders if c.costs is not None}
    return Outcome(dataset, records, summary_curves, refusal, store, costs)


def _episode_costs(dataset: xarray.Dataset) -> dict[str, numpy.ndarray]:
    """Mean cost of every episode by name; of bounds and without truth there is none."""
    if "cost" not in dataset:
        return {}
    costs = {str(name): mean_cost(dataset, name) for name in dataset["policy"].values.tolist()}
    return {name: own for name, own in costs.items() if not numpy.isnan(own).all()}


def check_explained(wanted: Sequence[str], names: Sequence[str]) -> None:
    """Raise ValueError for a name to explain that is not evaluated."""
    for name in wanted:
        if name not in names:
            raise nearest("competitor to explain", name, names)


def write(
    problem: Problem,
    outcome: Outcome,
    outputs: Outputs,
    learned: list[str],
    worst: Mapping[str, Sequence[WorstTrack]],
) -> None:
    """Write what was asked for, print the tables and the largest reasons, and say where the files are.

    Args:
        problem: that was evaluated.
        outcome: of :func:`run`.
        outputs: what is written.
        learned: names that are learned.
        worst: by the names of those whose cost is explained their worst episodes.
    """
    flights = outcome.flights
    differences = outcome.differences(problem) if outcome.dataset.attrs["recorded"] else {}
    printed, in_file = (
        outcome.tables(problem, flights, differences, width) for width in (console.width, LATEX_WIDTH)
    )
    records = [*outcome.records, *flights]
    if outputs.estimates is not None:
        write_estimates(outputs.estimates, outcome.dataset)
    if outputs.records is not None:
        write_records(outputs.records, records)
    results: list[Result] = []
    refusal = outcome.refusal
    if outputs.folder is not None and outcome.curves is not None:
        if outcome.has_truth:
            settings = settings_of(command_line())
            results = [result_of(problem, outcome.dataset, outcome.records, outcome.curves, learned, worst)]
        whole = outcome.dataset.drop_dims(
            "drawn_episode", errors="ignore"
        )  # the track is for the report alone
        if not refusal:  # a summary has no variables
            largest = max(v.nbytes for v in whole.data_vars.values())
            refusal = _size_warning(whole.nbytes, largest, outputs.netcdf)
        with whole_files(outputs.folder) as place:
            write_records(place / "records.json", records)
            records_as_csv(place / "records.csv", records)
            write_text(place / "table.tex", "\n".join(map(latex_table, in_file)))
            if not refusal:
                write_dataset(place / "results.nc", whole)
            for name, figure in evaluation_figures(outcome.curves, outputs.columns, learned=learned):
                for suffix in outputs.formats:
                    save(figure, place / f"{name}.{suffix}")
            for name, figure in worst_figures(worst, phrases_of(outcome.dataset), outputs.columns):
                for suffix in outputs.formats:
                    save(figure, place / f"{name}.{suffix}")
            if results:
                write_results(place / RESULTS, results, settings)
        outcome.store.clear()
    for table in printed:
        print_table(table)
    phrases = phrases_of(outcome.dataset)
    console.print()
    for name in worst:
        for sentence in reason_sentences(outcome.records, phrases, name):
            print_sentence(sentence)
    for note in [*notes_of(outcome.dataset), *missing_rows(outcome.records)]:
        print_sentence(note, bold=len(note) if note.startswith(LOUD) else 0)
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
    """Say in a sentence how much of what was measured a file of estimates says nothing of."""
    for record in records:
        if record.metric == "missing" and record.value:
            yield (
                f"{record.policy}: {100.0 * record.value:.3g} % of the measurements have no row in the file; the last "
                "estimate before each, or the initial one, is held"
            )


def departure_lines(
    problem: Problem, data: Any, learned: Sequence[str], keywords: Mapping[str, Any], trust: bool = False
) -> Iterator[str]:
    """Say what agents are shown follows from a log, and how it departs from what each was trained on, in a line.

    Args:
        problem: whose agents they are.
        data: scenario, flights or recording.
        learned: their names.
        keywords: parameters of the task.
        trust: load models that can execute code.
    """
    typical = data.typical if learned and isinstance(data, Recording) else {}
    for name in typical.keys() - keywords.keys():
        yield (
            f"{name} is {typical[name]:g}, the median of what the log states: agents are shown deviations over it, and "
            f"costs count in its square; --set {name}=VALUE names another"
        )
    for name in learned:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # it was loaded before, and has warned
            maker = find_competitor(problem, name, trust)
        found = departure(problem.task, maker, data, keywords)
        if found is not None:
            yield f"{name}: {found}"


def _size_warning(size: int, largest: int, asked: bool | None) -> str:
    """Say why a dataset of so many bytes, and so many in its largest variable, is no NetCDF file; empty if it is."""
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
