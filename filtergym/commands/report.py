"""Commands that make a page of existing results, and that run a paper's experiments again."""

from pathlib import Path
from typing import Annotated

import typer

from ..evaluation.figures.print_layout import check_formats
from ..evaluation.running.parallel import Workers
from ..evaluation.storage.files import writable_file, writable_folder
from ..reports.tables.results import read_all_results
from ..reproductions import paper_module, papers
from .result_output import REPORT, make_report, print_headline, print_outcome, report_maker
from .terminal import Cluster, Formats, Jobs, complete_from, console, progress_bar


def make(
    results: Annotated[
        list[Path],
        typer.Argument(help="Files of results, or folders that contain one; several make one report."),
    ],
    out: Annotated[Path, typer.Option(help="HTML file.")] = Path(REPORT),
) -> None:
    """Make one self-contained page of results, to open offline and to send: tables, figures, a track to look at.

    The page shows the content of the files and executes nothing, so that files from others are safe to open.

    Example: filtergym report results --out report.html
    """
    report_maker()  # reports missing packages before any work
    writable_file(out)
    found, settings = read_all_results(results)
    print_outcome(found)
    console.print()
    make_report(found, settings, out)
    console.print()
    print_headline(found)


def reproduce(
    paper: Annotated[
        str,
        typer.Argument(
            help=f"One of: {', '.join(papers()) or 'none, outside a clone'}.",
            autocompletion=complete_from(*papers()),
        ),
    ],
    out: Annotated[Path | None, typer.Option(help="Folder for report and figures.")] = None,
    episodes: Annotated[
        int | None, typer.Option(help="Monte Carlo runs instead of the module's own.")
    ] = None,
    format: Formats = None,
    jobs: Jobs = 1,
    cluster: Cluster = None,
) -> None:
    """Run a paper's experiments again and give a verdict on each of its claims, in a clone of the repository.

    Example: filtergym reproduce imm-alpha-beta --out results/imm-alpha-beta
    """
    formats = check_formats(format or ["png"])
    module = paper_module(paper)
    if out is not None:
        writable_folder(out)
    with Workers(jobs, cluster) as workers, progress_bar() as bar:
        line = bar.add_task(f"reproducing {paper}", total=module.STEPS)
        result = module.reproduce(lambda done=1: bar.update(line, advance=done), episodes, workers)
    if out is not None:
        result.save(out, formats)
    console.print(result)
    if out is not None:
        console.print(f"report and figures in {out}")
