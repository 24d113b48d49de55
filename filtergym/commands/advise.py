"""The command that recommends a filter for a log."""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Annotated, Any

import typer

from ..baselines.advice import FittedLog, advise, fit_all
from ..baselines.fitted_filters import SUFFIX, families_of, log_setup, own_family, write_advised
from ..baselines.onboard import judge_onboard
from ..baselines.problem import Problem, problem_of
from ..envs.data.recording import Recording
from ..envs.engine.catalogue import check_names, nearest, short_name
from ..envs.engine.scenario_choice import make_task
from ..envs.logs.onboard import read_onboard
from ..envs.logs.reading import read_recording
from ..evaluation.storage.files import writable_file, write_text
from ..names import find_competitor, find_competitors
from ..reports.tables.advice import (
    advice_lines,
    advice_rows,
    advice_table,
    further_sentences,
    held_out_numbers,
    parameter_lines,
    price_table,
    reading_lines,
)
from ..reports.tables.results import settings_of
from .evaluation import causal_competitors, departure_lines
from .result_output import report_maker
from .terminal import (
    Parameters,
    RenameOption,
    SortOption,
    Speeds,
    TruthOffset,
    TruthOption,
    command_line,
    console,
    parse_pair,
    parse_renames,
    parse_settings,
    progress_bar,
)

OWN = "The class is your own: put these values into it. A file that names a module would run its code."


def price_words(price: Mapping[str, int] | None) -> str:
    """Return the cost of an update of a filter in C as text: operations and bytes; empty where unknown."""
    if price is None:
        return ""
    return (
        f" ({price['operations']:,} operations an update in C, {price['state_bytes']:,} bytes of state, about "
        f"{price['stack_bytes']:,} of stack)"
    )


def update_prices(problem: Problem, recording: Recording) -> Callable[[str, Any], Mapping[str, int] | None]:
    """Return a function from a competitor's name and factory to the cost of its update in C."""
    parameters = log_setup(problem, recording).parameters

    def price(name: str, maker: Any) -> Mapping[str, int] | None:
        from ..exports.c_source import price_of
        from ..exports.request import ExportRequest

        return price_of(ExportRequest(problem, name, maker, keywords=parameters))

    return price


def fit_to_recording(problem: Problem, name: str, recording: Recording, folder: Path, seed: int) -> None:
    """Fit one filter to a whole recording, print its parameters, and write them to a file in ``folder``.

    ``name`` is a filter that can be fitted, or ``module:Class``.
    """
    families = families_of(problem, recording)
    if ":" not in name and name not in families:
        raise nearest("filter that can be fitted to a recording", name, families)
    family = families[name] if name in families else own_family(name, find_competitor(problem, name).maker)
    out = folder / f"{short_name(problem.id)}.{name}{SUFFIX}"
    if name in families:
        writable_file(out)
    tunable, fitted, intervals = fit_all(FittedLog(problem, recording, seed=seed), family)
    likelihood = fitted.log_likelihood / fitted.measurements
    console.print(
        f"{name}, fitted to {fitted.measurements:,} measurements, {likelihood:.3f} nats per measurement:",
        highlight=False,
    )
    for line in parameter_lines(tunable, fitted, intervals):
        console.print(f"  {line}", highlight=False, soft_wrap=True)
    if name not in families:
        console.print(OWN)
        return
    write_advised(out, problem, name, recording, fitted, intervals, command_line())
    console.print(f"saved in {out}; filtergym evaluate {problem.name} --policy {out} runs it", soft_wrap=True)


def advise_on_log(
    recording: Annotated[
        str,
        typer.Argument(
            help="Measurements of real sensors, NetCDF or tables (CSV): a file, a folder, or a pattern in quotes."
        ),
    ],
    environment: Annotated[
        str, typer.Option(help="Environment of the measurements; a NetCDF file names its own.")
    ] = "filtergym/ManeuveringTarget-v0",
    out: Annotated[
        Path | None,
        typer.Option(help=f"File for the advised filter, *{SUFFIX}, for evaluate, online and export."),
    ] = None,
    report: Annotated[
        Path | None,
        typer.Option(
            help="HTML file for a page of it: sentences, tables, the track, innovations and NIS over time."
        ),
    ] = None,
    truth: TruthOption = None,
    truth_offset: TruthOffset = 0.0,
    rename: RenameOption = None,
    sort: SortOption = False,
    policy: Annotated[
        list[str] | None,
        typer.Option(
            help="Estimator of your own, module:Class, whose attribute parameters gives limits; repeat for several."
        ),
    ] = None,
    settings: Parameters = None,
    noise: Annotated[bool, typer.Option(help="Fit the scale of the measurement noise, too.")] = True,
    seed: Annotated[int, typer.Option(help="Seed of the starts of the fits.")] = 0,
    speeds: Speeds = "0.01,1000",
    agents: Annotated[
        bool, typer.Option("--agents", help="Compare the shipped learned agents, too; it takes longer.")
    ] = False,
) -> None:
    """Fit every family of filters to a log, and recommend one with its parameters.

    Example: filtergym advise log.csv --out mine.filter.json
    """
    keywords = parse_settings(settings)
    if out is not None:
        if not out.name.endswith(SUFFIX):
            raise ValueError(f"the name of a fitted filter ends in {SUFFIX}, got {str(out)!r}")
        writable_file(out)
    make_page = None if report is None else _advice_maker()  # reports missing packages before any work
    if report is not None:
        writable_file(report)
    found = read_recording(
        recording,
        environment,
        speeds=parse_pair("--speeds", speeds),
        truth=truth,
        truth_offset=truth_offset,
        rename=parse_renames(rename),
        sort=sort,
        **keywords,
    )
    problem = problem_of(found.environment)
    check_names(problem.task, keywords)
    for line in reading_lines(found):
        console.print(line, highlight=False, soft_wrap=True)
    shipped = causal_competitors(problem, found, agents)
    makers = {one.name: one.maker for one in shipped}
    learned = sorted(one.name for one in shipped if one.learned)
    own = {one.name: own_family(one.name, one.maker) for one in find_competitors(problem, policy or [])}
    with progress_bar() as bar:
        fits = bar.add_task("advising", total=1.0)

        def progress(what: str, share: float) -> None:
            bar.update(fits, completed=share)
            if what:
                bar.write_line(what)

        prices = update_prices(problem, found)
        advice = advise(FittedLog(problem, found, noise, seed, keywords), makers, own, progress, prices)
        if (track := read_onboard(recording)) is not None:
            names = [row.name for row in advice_rows(advice, learned)]
            every = {**makers, **advice.make_fitted()}
            shown = {name: every[name] for name in names}
            onboard = judge_onboard(problem, found, keywords, advice.share, shown, track)
            advice = advice._replace(onboard=onboard)
        costs = price_table(advice, learned)
    console.print(advice_table(advice, learned))
    if costs is not None:
        console.print(costs)
    departures = list(departure_lines(problem, found, [one for one in shipped if one.learned], keywords))
    for sentence in [*advice_lines(advice, learned), *departures]:
        console.print(sentence, highlight=False, soft_wrap=True)
    name = advice.advised.name
    if out is not None and name in own:
        console.print(OWN)
    elif out is not None:
        fit = advice.fits[name] if advice.advised.fitted else None
        write_advised(
            out,
            problem,
            name,
            found,
            fit,
            advice.intervals if fit is not None else {},
            command_line(),
            held_out=held_out_numbers(advice),
            price=advice.prices[name],
        )
        costs_words = price_words(advice.prices[name])
        console.print(
            f"{name} is saved{costs_words}: filtergym evaluate {problem.name} --policy {out} runs it",
            soft_wrap=True,
        )
    if report is not None and make_page is not None:
        task = make_task(problem.task, found, **keywords)
        further = [*further_sentences(advice, learned), *departures]
        write_text(report, make_page(advice, task, further, learned, settings_of(command_line())))
        console.print(
            f"report: {report} ({report.stat().st_size / 1e6:.1f} MB), opens in a browser", soft_wrap=True
        )


def _advice_maker() -> Callable[..., str]:
    """Return the function that makes a page of advice; raise ValueError if its packages are not installed."""
    report_maker()
    from ..reports.pages.advice_report import advice_html

    return advice_html
