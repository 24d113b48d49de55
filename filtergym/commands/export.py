"""The command that writes what leaves the package: agents as arrays, filters as programs."""

from pathlib import Path
from typing import Annotated

import typer

from ..agents.export import export_run
from ..baselines.fitted_filters import SUFFIX
from ..baselines.problem import Problem, problem_of
from ..envs.catalogue import check_names, nearest
from ..names import find_competitor
from .terminal import (
    Parameters,
    ScenarioName,
    Trust,
    command_line,
    complete_environment,
    complete_policy,
    console,
    import_environments,
    one_of,
    parse_settings,
)

FORMS = ("safetensors", "c")
"""What can be written."""


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
            help="What is written: safetensors, an agent's arrays; or c, a whole filter as C99.",
            autocompletion=one_of(*FORMS),
        ),
    ] = "safetensors",
    out: Annotated[
        Path | None,
        typer.Option(
            help="Of arrays the file, default: agent.safetensors in the run; of C the folder, default: the filter's "
            "name."
        ),
    ] = None,
    single: Annotated[
        bool, typer.Option("--float", help="Of C: float in place of double; refused where it is wrong.")
    ] = False,
    scenario: ScenarioName = None,
    settings: Parameters = None,
    trust: Trust = False,
) -> None:
    """Write a filter as C99, or a run's best agent as plain arrays.

    Arrays evaluate without torch and cannot execute anything. Nothing is executed either: training has left them beside
    the model. A folder with the model only takes --trust.

    C needs nothing but math.h. What is written was run beside the filter itself, measurement by measurement, over
    episodes of the scenario, which may be a recording.

    Example: filtergym export runs/ppo, then filtergym evaluate ENV --policy runs/ppo/agent.safetensors

    Example: filtergym export filtergym/ManeuveringTarget-v0 imm --to c --out imm
    """
    if to not in FORMS:
        raise nearest("form of an export", to, FORMS)
    if to == "safetensors":
        for given, option in (
            (name, "a filter's name"),
            (single, "--float"),
            (scenario, "--scenario"),
            (settings, "--set"),
        ):
            if given:
                raise ValueError(f"{option} is of a filter as a program: add --to c")
        _export_arrays(Path(environment), out, trust)
        return
    if name is None:
        raise ValueError(f"name the filter: filtergym export {environment} NAME --to {to}")
    problem = problem_of(environment)
    keywords = parse_settings(settings or [])
    check_names(problem.task, keywords)
    maker = find_competitor(problem, name, trust)
    words = _own_name(problem, name)
    from ..exports.c_source import export_c, file_stem

    own = file_stem(words)
    folder = out or Path(own)
    figures = export_c(
        problem, words, maker, folder, "float" if single else "double", scenario, keywords, command_line()
    )
    console.print(f"saved in {folder}: {own}.h, {own}.c", soft_wrap=True)
    console.print(
        f"{figures.operations:,} operations an update, {figures.state_bytes:,} bytes of state; largest difference to "
        f"{words} {figures.difference:.1e} standard deviations",
        highlight=False,
        soft_wrap=True,
    )
    console.print(
        f"compiled here: {figures.test}" if figures.test else "not compiled: no C compiler here",
        highlight=False,
        soft_wrap=True,
    )
    console.print(
        f"try it: cd {folder} && cc -std=c99 -O2 test.c {own}.c -lm -o test && ./test", soft_wrap=True
    )


def _own_name(problem: Problem, name: str) -> str:
    """Name of a competitor; of a file its own, without folder and ending, and without that of the environment."""
    for ending in (SUFFIX, ".safetensors", ".zip"):
        if name.endswith(ending):
            return Path(name).name.removesuffix(ending).removeprefix(f"{problem.short_name}.")
    return Path(name).name if Path(name).is_dir() else name


def _export_arrays(folder: Path, out: Path | None, trust: bool) -> None:
    """Write a run's best agent as arrays."""
    path = out or folder / "agent.safetensors"
    run = export_run(folder, path, trust)
    console.print(f"{run.algorithm} for {run.environment}, control {run.control}: {path}")
