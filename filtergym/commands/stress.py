"""The command that runs filters through the faults of measurements in the field."""

from pathlib import Path
from typing import Annotated

import typer

from ..baselines.problem import problem_of
from ..evaluation.running.threads import one_thread
from ..evaluation.storage.files import writable_file, write_text
from ..evaluation.stress.alterations import ALTERATIONS
from ..evaluation.stress.crash_test import CrashTest, Finding
from ..names import find_competitor, find_competitors
from ..reports.pages.crash_report import crash_page, crash_table
from ..reports.tables.export import write_records
from .terminal import (
    Backend,
    Environment,
    Experiment,
    Parameters,
    ScenarioName,
    Split,
    Trust,
    command_line,
    complete_policy,
    console,
    parse_settings,
    print_sentence,
    print_table,
    progress_bar,
)

NOTE = (
    "Errors are roots of mean squares over components, in units of the paper's algorithm's, and ratios geometric means "
    "over episodes. Degraded: errors more than 25 % larger than without, or more than twice overconfident. Failed: an "
    "invalid estimate, or errors three times as large in a tenth of the episodes 50 measurements after it is over."
)


@one_thread()
def stress(
    environment: Environment,
    policy: Annotated[
        list[str],
        typer.Argument(
            help="Policies and estimators, each a name, a file, the folder of a training run, or module:Class.",
            autocompletion=complete_policy,
        ),
    ],
    scenario: ScenarioName = None,
    episodes: Annotated[int, typer.Option(help="Tracks side by side, under every alteration.")] = 32,
    seed: Experiment = 0,
    split: Split = "test",
    settings: Parameters = None,
    steps: Annotated[
        int, typer.Option(help="Measurements of the long run; a million takes minutes, 0 leaves it out.")
    ] = 10_000,
    json: Annotated[Path | None, typer.Option(help="File for the findings, a record each.")] = None,
    html: Annotated[Path | None, typer.Option(help="File for the tables as a page.")] = None,
    backend: Backend = "auto",
    trust: Trust = False,
) -> None:
    """Crash test: run filters on measurements that are late, wrong, missing or repeated, and report failures.

    Each line states passed, degraded (how much, beside the paper's algorithm), or failed (how). The exit code is 1 if
    anything failed.

    Example: filtergym stress filtergym/ManeuveringTarget-v0 kalman-imm --steps 0
    """
    problem = problem_of(environment)
    keywords = parse_settings(settings, problem.task)
    for name in policy:
        if name.startswith("file:"):
            raise ValueError(f"{name!r} is a file of estimates, and a crash test runs filters: name a filter")
    for path in (json, html):
        if path is not None:
            writable_file(path)
    competitors = find_competitors(problem, policy, trust)
    experiment = problem.experiment(scenario, episodes, seed, split, backend=backend, keywords=keywords)
    paper = problem.baselines.score_paper
    reference = (paper, find_competitor(problem, paper).maker) if paper else None
    tested: list[list[Finding]] = []
    with progress_bar() as bar:
        line = bar.add_task("recording", total=len(competitors) * (len(ALTERATIONS) + 2))
        test = CrashTest(experiment, steps, reference)
        for one in competitors:
            bar.update(line, description=f"testing {one.name}")
            found = test.findings(one.name, one.maker, lambda done: bar.update(line, advance=done))
            tested.append(list(found))
    findings = [finding for own in tested for finding in own]
    for own in tested:
        print_table(crash_table(own))
    print_sentence(NOTE)
    if json is not None:
        write_records(json, findings)
        console.print(f"findings in {json}", soft_wrap=True)
    if html is not None:
        write_text(html, crash_page(command_line(), [crash_table(own, True) for own in tested], [NOTE]))
        console.print(f"page in {html}", soft_wrap=True)
    if any(finding.verdict == "failed" for finding in findings):
        raise typer.Exit(1)
