"""The headline: the best competitor of every origin in each environment, with a word on consistency."""

from collections.abc import Sequence

from rich.table import Table
from rich.text import Text

from .ranking import best_of_origins
from .results import Result
from .terminal_tables import HEADLINE, consistency_word, with_interval

SHORT = {"slightly overconfident": "slightly over", "slightly cautious": "slightly under"}
"""Abbreviated words on a covariance for a narrow column."""


def headline(results: Sequence[Result]) -> list[tuple[Result, list[tuple[str, str, str, str]]]]:
    """Return for each environment the best competitor of every origin (paper, classical, learned ...).

    Results of training distributions are used; of an environment without one all.

    Returns:
        Result and rows: origin, name, cost against the paper's in percent (geometric), and a word on consistency.
    """
    usual = {result.environment for result in results if result.default}
    found = []
    for result in results:
        if not result.default and result.environment in usual:
            continue
        by_name = {(r.policy, r.metric, r.component): r for r in result.records if r.window == "all"}
        rows = []
        for origin, name in best_of_origins(result):
            difference = by_name.get((name, HEADLINE, ""))
            nees = by_name.get((name, "anees", "state"))
            cost = "0" if origin == "paper" else with_interval(difference, 100.0, negligible=0.005)
            rows.append((origin, name, cost, consistency_word(nees)))
        found.append((result, rows))
    return found


def headline_table(results: Sequence[Result]) -> Table:
    """Return a table of the best of every origin in each environment, at most 80 columns wide."""
    table = Table(box=None, pad_edge=False, padding=(0, 1), title_justify="left", caption_justify="left")
    table.title = "Best of every origin, cost against the paper's algorithm (95 % intervals)"
    table.add_column("")
    table.add_column("competitor", overflow="fold")
    table.add_column("cost, %", justify="right", no_wrap=True)
    table.add_column("covariance", no_wrap=True)
    for i, (result, rows) in enumerate(headline(results)):
        if i:
            table.add_row()
        opponent = f", vs {result.paper}" if result.paper else ""
        table.add_row("", Text(f"{result.short} {result.scenario}{opponent}", style="bold"))
        for *row, word in rows:
            table.add_row(*row, SHORT.get(word, word))
    table.caption = (
        "Learned and classical policies steer a filter of the environment. An estimator is a classical filter of its "
        "own. The reference knows something of the truth. A covariance is consistent if it is as large as the errors, "
        "and slightly over or under if it is overconfident or cautious by less than a factor of two."
    )
    return table
