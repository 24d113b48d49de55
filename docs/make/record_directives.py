"""Directives and roles that render records, and tables of the code, where a page names them (Sphinx, MyST).

A mistake in a name is a warning, with which a build under ``-W`` ends. CONTRIBUTING.md shows how to write them.
"""

import os
import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, ClassVar

import comparison
from command_line import command_line_markdown
from docutils import nodes
from docutils.parsers.rst import directives
from docutils.statemachine import StringList
from environment_page import causes_table, environment_table
from front import budgets_markdown, draw_fronts, panels_of
from pictures import draw_public_problems, draw_update_times
from playground import page_script, read_modules
from records import (
    BENCHMARK,
    SEEDS,
    BenchmarkRecords,
    ResultRecord,
    environment_id,
    read_benchmark,
    read_record,
    record_file,
    recorded_environments,
)
from results_table import chosen_markdown, results_markdown
from seed_profiles import interquartile_table, profile_figure, recorded_scores
from sentence_numbers import number_text, record_of
from sphinx.addnodes import download_reference
from sphinx.util.docutils import SphinxDirective, SphinxRole
from training_seeds import learning_curves, seeds_markdown, seeds_overview

from filtergym.baselines.problem import problem_of
from filtergym.evaluation.figures.print_layout import save
from filtergym.evaluation.storage.files import write_text
from filtergym.papers.grid import markdown_table


def _words(text: str) -> list[str]:
    return [word.strip() for word in text.split(",")]


class _Rendered(SphinxDirective):
    """Base of directives that render the text of :meth:`markdown` and the picture of :meth:`figure`."""

    required_arguments = 0
    optional_arguments = 1
    final_argument_whitespace = True

    @property
    def argument_text(self) -> str:
        return self.arguments[0].strip() if self.arguments else ""

    def markdown(self) -> str:
        return ""

    def figure(self) -> tuple[str, str, Any] | None:
        """Return a file name, an alternative text, and the Matplotlib figure; None: no figure."""
        return None

    def run(self) -> list[nodes.Node]:
        """Return the rendered nodes; a ValueError becomes a warning at the directive's line."""
        try:
            text, drawn = self.markdown(), self.figure()
        except ValueError as error:
            return [self.state.document.reporter.warning(str(error), line=self.lineno)]
        shown = nodes.section() if self.with_headings else nodes.Element()
        lines = StringList(text.splitlines(), source=self.get_source_info()[0])
        self.state.nested_parse(lines, self.content_offset, shown, match_titles=self.with_headings)
        found: list[nodes.Node] = [*shown.children]
        if drawn is not None:
            found.append(self._image(*drawn))
        return found

    with_headings: ClassVar[bool] = False

    def benchmark(self, name: str) -> tuple[BenchmarkRecords, ResultRecord]:
        """Return a benchmark's record by the environment's name, and register it as a dependency of the page."""
        self.env.note_dependency(record_file(f"{BENCHMARK}/{name}"))
        return read_benchmark(name)

    def record(self, name: str) -> ResultRecord:
        """Return a record, and register it as a dependency of the page."""
        self.env.note_dependency(record_file(name))
        return read_record(name)

    def _image(self, name: str, words: str, figure: Any) -> nodes.Node:
        folder = Path(self.env.app.doctreedir) / "figures"
        folder.mkdir(parents=True, exist_ok=True)
        save(figure, folder / f"{name}.svg")
        page = Path(self.env.doc2path(self.env.docname)).parent
        return nodes.image(uri=os.path.relpath(folder / f"{name}.svg", page), alt=words)


class ResultsTable(_Rendered):
    """``{results-table} ENVIRONMENT``: all competitors in its training distribution; several, or some, by options."""

    option_spec: ClassVar[Any] = {
        "scenario": directives.unchanged,
        "policies": directives.unchanged,
        "columns": directives.unchanged,
    }

    def markdown(self) -> str:
        """Return the table of results in Markdown."""
        names = self.argument_text.split() or recorded_environments()
        scenario = self.options.get("scenario", "")
        policies, columns = (
            _words(self.options[key]) if key in self.options else () for key in ("policies", "columns")
        )
        if len(names) == 1 and not policies and not columns:
            return results_markdown(*self.benchmark(names[0]), scenario)
        return chosen_markdown({name: self.benchmark(name) for name in names}, scenario, policies, columns)


class ComparisonTables(_Rendered):
    """``{comparison} ENVIRONMENT``: every scenario, in sentences, tables and a figure."""

    def markdown(self) -> str:
        """Return sentences and tables of the comparison in Markdown."""
        measured, record = self.benchmark(self.argument_text)
        self.compared = comparison.compare_environment(measured)
        return comparison.comparison_markdown(self.compared, measured, record)

    def figure(self) -> tuple[str, str, Any]:
        """Return file name, alternative text and figure of the cost in every scenario."""
        words = f"Cost against the paper's algorithm in every scenario, {self.argument_text}"
        return f"comparison_{self.argument_text}", words, self.compared.figure


class ComparisonOverview(_Rendered):
    """``{comparison-overview} best`` or ``harm``: over all environments."""

    def markdown(self) -> str:
        """Return the overview table in Markdown."""
        found = [self.benchmark(name)[0] for name in recorded_environments()]
        return comparison.overview_markdown(found, self.argument_text)


class FrontFigure(_Rendered):
    """``{front-figure} ENVIRONMENT ...``: accuracy against time; default: all environments."""

    def figure(self) -> tuple[str, str, Any]:
        """Return file name, alternative text and figure of the cost-time fronts."""
        names = self.argument_text.split() or recorded_environments()
        panels = panels_of([self.benchmark(name)[0] for name in names])
        if not panels:
            raise ValueError(f"the records of {', '.join(names)} hold no times")
        words = f"Cost against processor time of every competitor: {', '.join(names)}"
        return "_".join(["front", *self.argument_text.split()]), words, draw_fronts(panels)


class PublicFigure(_Rendered):
    """``{public-figure}``: KalmanNet's problems, with rivals that are tuned."""

    def figure(self) -> tuple[str, str, Any]:
        """Return file name, alternative text and figure of the errors on all problems."""
        figures = {name: self.record(f"public_{name}").data for name in ("problems", "optimised", "drives")}
        rows = [row for name in ("problems", "optimised") for row in figures[name]["figures"]["rows"]]
        drives = {
            re.sub("(, architecture 1)?, of filternet", " (filternet)", name): [
                float(error) for error in errors
            ]
            for whose, name, *errors in (row[:5] for row in figures["drives"]["rows"])
            if not name.startswith("wheels")
        }
        words = "Errors of filters on the problems that learned Kalman filters are published on"
        return "public_problems", words, draw_public_problems(rows, drives)


class UpdateTimes(_Rendered):
    """``{update-times}``: the time of an update of running filters, beside those of other libraries."""

    def figure(self) -> tuple[str, str, Any]:
        """Return file name, alternative text and figure of the bars of update times."""
        rows = self.record("online_time").data["rows"]
        return "update_times", "Bars: median time of an update of each filter", draw_update_times(rows)


class BudgetsTable(_Rendered):
    """``{budgets-table}``: the lowest error cost within a time, of classical and learned competitors, everywhere."""

    def markdown(self) -> str:
        """Return the table of lowest costs within each time in Markdown."""
        return budgets_markdown([self.benchmark(name)[0] for name in recorded_environments()])


class SeedsTables(_Rendered):
    """``{seeds} ENVIRONMENT``: every training run, and the spread of each algorithm; without a name, means of all."""

    def markdown(self) -> str:
        """Return the tables of training seeds in Markdown."""
        if not self.argument_text:
            return seeds_overview([self.record(f"{SEEDS}/{name}") for name in recorded_environments(SEEDS)])
        environment_id(self.argument_text)
        return seeds_markdown(self.record(f"{SEEDS}/{self.argument_text}"))


class SeedProfiles(_Rendered):
    """``{seed-profiles} ALGORITHM ...``: interquartile means and performance profiles; default: all algorithms."""

    def markdown(self) -> str:
        """Return the table of interquartile means in Markdown."""
        records = [self.record(f"{SEEDS}/{name}") for name in recorded_environments(SEEDS)]
        self.scores = recorded_scores(records, self.argument_text.split())
        return interquartile_table(self.scores)

    def figure(self) -> tuple[str, str, Any]:
        """Return file name, alternative text and figure of the performance profiles."""
        words = f"Share of training runs above each score: {', '.join(self.scores)}"
        return "_".join(["profiles", *self.scores]), words, profile_figure(self.scores)


class TrainingCurves(_Rendered):
    """``{training-curves} ENVIRONMENT``: validation cost over training, of those runs whose curves the record has."""

    @property
    def data(self) -> dict[str, Any]:
        """Data of the record of training seeds, without runs that have no curve."""
        environment_id(self.argument_text)
        data = self.record(f"{SEEDS}/{self.argument_text}").data
        return {**data, "runs": [run for run in data["runs"] if run[0] in data.get("curves", {})]}

    def markdown(self) -> str:
        """Return a sentence on the algorithms whose curves the record lacks; empty if it has them all."""
        shown = {run[1] for run in self.data["runs"]}
        every = dict.fromkeys(run[1] for run in self.record(f"{SEEDS}/{self.argument_text}").data["runs"])
        missing = ", ".join(f"`{name}`" for name in every if name not in shown)
        return f"Curves of {missing} were not kept." if missing else ""

    def figure(self) -> tuple[str, str, Any] | None:
        """Return file name, alternative text and figure of the training curves; None without curves."""
        if not self.data["runs"]:
            return None
        words = f"Validation cost over training, median and range over training seeds, {self.argument_text}"
        return f"training_{self.argument_text}", words, learning_curves(self.data)


class RecordTable(_Rendered):
    """``{record-table} NAME``: a table of text, or some of its columns."""

    option_spec: ClassVar[Any] = {"columns": directives.unchanged, "bare": directives.flag}

    def markdown(self) -> str:
        """Return the record's table in Markdown, with a sentence on its origin unless the option ``bare`` is set."""
        record = self.record(self.argument_text)
        titles, rows = record.data["columns"], record.data["rows"]
        if "columns" in self.options:
            places = [titles.index(title) for title in _words(self.options["columns"])]
            titles, rows = [titles[i] for i in places], [[row[i] for i in places] for row in rows]
        table = markdown_table(titles, rows)
        return "\n".join([*table, *(["", record.origin] if "bare" not in self.options else [])])


class EnvironmentTable(_Rendered):
    """``{environment-table} NAME``: a table from the code, such as actions, of an environment; or ``causes`` of all."""

    option_spec: ClassVar[Any] = {"environment": directives.unchanged_required}

    def markdown(self) -> str:
        """Return the named table of an environment, or that of causes, in Markdown."""
        if self.argument_text == "causes":
            return causes_table()
        if "environment" not in self.options:
            raise ValueError("the option environment is missing, such as `:environment: ManeuveringTarget`")
        return environment_table(problem_of(environment_id(self.options["environment"])), self.argument_text)


class CommandLine(_Rendered):
    """``{command-line}``: all commands, from the code."""

    with_headings: ClassVar[bool] = True

    def markdown(self) -> str:
        """Return the ``--help`` of all commands in Markdown."""
        return command_line_markdown()


class NumberRole(SphinxRole):
    """``{number}`PATH```: a number of a record with its interval; ``{value}`PATH``` without."""

    def __init__(self, interval: bool) -> None:
        self.interval = interval

    def run(self) -> tuple[list[nodes.Node], list[nodes.system_message]]:
        """Return the text node of a record's number, or that of an error."""
        return _in_sentence(
            self, lambda: [nodes.Text(number_text(self.text, self.interval))], record_of(self.text)
        )


class RecordRole(SphinxRole):
    """``{record}`NAME```: the record of a section's numbers, as a link."""

    def run(self) -> tuple[list[nodes.Node], list[nodes.system_message]]:
        """Return the node of a link to the record, with its command."""
        return _in_sentence(self, self._link, self.text)

    def _link(self) -> Sequence[nodes.Node]:
        record = read_record(self.text)
        target = os.path.relpath(record_file(self.text), Path(self.env.doc2path(self.env.docname)).parent)
        link = download_reference(
            "", "", reftarget=target, refdoc=self.env.docname, refdomain="", reftype="download", refexplicit=True,
            refwarn=True,
        )  # fmt: skip
        link += nodes.literal("", self.text)
        return [nodes.Text("record "), link, nodes.Text(" of "), nodes.literal("", record.command)]


class Playground(SphinxDirective):
    """``{playground} IMAGE``: filters that follow the pointer, and a picture where scripts are off."""

    required_arguments = 1

    def run(self) -> list[nodes.Node]:
        """Return the nodes of the playground: its element, scripts, and a picture where scripts are off."""
        page = Path(self.env.doc2path(self.env.docname)).parent
        static = os.path.relpath(Path(self.env.srcdir) / "_static", page)
        picture = nodes.image(uri=self.arguments[0], alt="Tracks of four filters, their errors and weights")
        return [
            nodes.raw("", PLAYGROUND.format(static=static), format="html"),
            picture,
            nodes.raw("", "</noscript></div>", format="html"),
        ]


PLAYGROUND = """\
<link rel="stylesheet" href="{static}/playground.css">
<script defer src="{static}/playground_filters.js"></script>
<script defer src="{static}/playground.js"></script>
<div id="playground"><noscript>"""


def _in_sentence(
    role: SphinxRole, make: Callable[[], Sequence[nodes.Node]], record: str
) -> tuple[list[nodes.Node], list[nodes.system_message]]:
    try:
        role.env.note_dependency(record_file(record))
        return [*make()], []
    except ValueError as error:
        return [nodes.Text("?")], [role.inliner.reporter.warning(str(error), line=role.lineno)]


DIRECTIVES = {
    "results-table": ResultsTable,
    "comparison": ComparisonTables,
    "comparison-overview": ComparisonOverview,
    "front-figure": FrontFigure,
    "public-figure": PublicFigure,
    "update-times": UpdateTimes,
    "budgets-table": BudgetsTable,
    "seeds": SeedsTables,
    "seed-profiles": SeedProfiles,
    "training-curves": TrainingCurves,
    "record-table": RecordTable,
    "environment-table": EnvironmentTable,
    "command-line": CommandLine,
    "playground": Playground,
}


def _write_playground(app: Any) -> None:
    write_text(Path(app.outdir) / "_static" / "playground_filters.js", page_script(read_modules()))


def setup(app: Any) -> dict[str, bool]:
    """Register all directives and roles of this module with Sphinx."""
    for name, directive in DIRECTIVES.items():
        app.add_directive(name, directive)
    app.add_role("number", NumberRole(interval=True))
    app.add_role("value", NumberRole(interval=False))
    app.add_role("record", RecordRole())
    app.connect("builder-inited", _write_playground)
    return {"parallel_read_safe": True}
