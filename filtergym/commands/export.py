"""The command that exports agents as arrays or networks and filters as programs."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from ..agents.export import export_run
from ..baselines.problem import problem_of
from ..envs.engine.catalogue import nearest
from ..envs.logs.reading import read_recording
from ..evaluation.storage.files import writable_file, writable_folder
from .terminal import (
    Parameters,
    RenameOption,
    ScenarioName,
    SortOption,
    Speeds,
    Trust,
    command_line,
    complete_environment,
    complete_from,
    complete_policy,
    console,
    import_environments,
    parse_pair,
    parse_renames,
    parse_settings,
)

if TYPE_CHECKING:
    from ..exports.request import ExportRequest

FORMS = ("safetensors", "c", "onnx")
"""Formats of an export."""


def export(
    environment: Annotated[
        str,
        typer.Argument(
            metavar="ENVIRONMENT | RUN",
            help="Environment id, of a filter; or the folder of a training run, of an agent's arrays.",
            autocompletion=complete_environment,
            callback=import_environments,
        ),
    ],
    name: Annotated[
        str | None,
        typer.Argument(
            help="Filter of the environment: a policy, an estimator, an agent; or a file of one, as advise, tune and "
            "train write them.",
            autocompletion=complete_policy,
        ),
    ] = None,
    to: Annotated[
        str,
        typer.Option(
            help="Format: safetensors, an agent's arrays; c, a whole filter as C99; onnx, the "
            "network of an agent.",
            autocompletion=complete_from(*FORMS),
        ),
    ] = "safetensors",
    out: Annotated[
        Path | None,
        typer.Option(
            help="File, default: agent.safetensors in the run, or the filter's name with the ending of its form; of C "
            "the folder, default: the filter's name."
        ),
    ] = None,
    single: Annotated[
        bool,
        typer.Option("--float", help="Of C: float in place of double; an error where its results are wrong."),
    ] = False,
    scenario: ScenarioName = None,
    recording: Annotated[
        Path | None,
        typer.Option(
            help="In place of a scenario: a log, NetCDF or a table (CSV), whose parameters the filter has and whose "
            "measurements it is compared on. A filter with a second sensor needs a log of both."
        ),
    ] = None,
    speeds: Speeds = "1,1000",
    rename: RenameOption = None,
    sort: SortOption = False,
    settings: Parameters = None,
    trust: Trust = False,
) -> None:
    """Write a filter as C99, an agent's network as ONNX, or a run's agent as plain arrays.

    Arrays evaluate without torch and execute nothing. Training writes them beside the model; a folder that contains the
    model only needs --trust.

    C needs math.h only. Before it is written, it is compared with the filter itself, measurement by measurement, over
    episodes of the scenario, or over a log.

    Example: filtergym export runs/ppo, then filtergym evaluate ENV --policy runs/ppo/agent.safetensors

    Example: filtergym export filtergym/ManeuveringTarget-v0 imm --to c --out imm
    """
    if to not in FORMS:
        raise nearest("form of an export", to, FORMS)
    options: dict[str, Any] = {"a filter's name": name, "--float": single, "--scenario": scenario}
    options |= {"--recording": recording, "--set": settings}
    allowed = {"safetensors": (), "onnx": ("a filter's name",)}
    for option, given in options.items():
        if given and option not in allowed.get(to, options):
            raise ValueError(
                f"{option} is not for --to {to}" + " of a run: add --to c" * (to == "safetensors")
            )
    if to == "safetensors":
        _export_arrays(Path(environment), out, trust)
        return
    if name is None:
        raise ValueError(f"name the filter: filtergym export {environment} NAME --to {to}")
    problem = problem_of(environment)
    keywords = parse_settings(settings, problem.task)
    data: Any = scenario
    if recording is not None:
        if scenario is not None:
            raise ValueError("--recording takes the place of --scenario: leave one of them out")
        data = read_recording(
            recording,
            problem.id,
            speeds=parse_pair("--speeds", speeds),
            rename=parse_renames(rename),
            sort=sort,
            **keywords,
        )
    from ..exports.request import request_export

    request = request_export(problem, name, data, trust=trust, **keywords)
    if to == "c":
        _export_c(request, out, "float" if single else "double")
        return
    from ..exports.onnx_network import export_onnx

    path = writable_file(out or Path(request.name.replace(":", "_") + ".onnx"))
    export_onnx(request, path)
    console.print(f"saved in {path}", soft_wrap=True)


def _export_c(request: "ExportRequest", out: Path | None, precision: str) -> None:
    from ..exports.c_filter import file_stem
    from ..exports.c_source import export_c
    from ..exports.figures import operation_words

    stem = file_stem(request.name)
    folder = out or Path(stem)
    writable_folder(folder)  # reports an unusable folder before the comparison
    figures = export_c(request, folder, precision, command_line())
    for line in (
        f"saved in {folder}: {stem}.h, {stem}.c",
        f"{operation_words(figures)}, {figures.state_bytes:,} bytes of state; largest difference to "
        f"{request.name} {figures.difference:.1e} standard deviations",
        f"compiled here: {figures.test}" if figures.test else "not compiled: no C compiler here",
        f"try it: cd {folder} && cc -std=c99 -O2 test.c {stem}.c -lm -o test && ./test",
        *(
            [f"your log: cc -std=c99 -O2 log.c {stem}.c -lm -o log && ./log LOG.csv"]
            if figures.reads_log
            else []
        ),
        *(
            [
                "no log.c, which reads tables: write what this log holds as CSV (docs/own_data.md) and advise on that"
            ]
            if request.log is not None and not figures.reads_log
            else []
        ),
    ):
        console.print(line, highlight=False, soft_wrap=True)


def _export_arrays(folder: Path, out: Path | None, trust: bool) -> None:
    path = out or folder / "agent.safetensors"
    run = export_run(folder, path, trust)
    console.print(f"{run.algorithm} for {run.environment}, control {run.control}: {path}")
