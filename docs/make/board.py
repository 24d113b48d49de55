"""The board: submissions that were verified over the episodes of a round, as one table for each environment."""

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from filtergym.baselines.problem import problem_of
from filtergym.envs.engine.catalogue import catalogue
from filtergym.evaluation.running.rollout import ProcessorTime
from filtergym.evaluation.running.times import PYTHON_MARK, time_text
from filtergym.papers.grid import markdown_table
from records import short_name

from filtergym.reports.tables.ranking import HARM
from filtergym.submission import (
    TIME,
    TOLERANCE,
    VERIFIED,
    Arrays,
    Figure,
    Shipped,
    Submission,
    Verification,
    check_submission,
    read_submission,
    read_verification,
    round_seed,
)

AGAINST_PAPER = "relative_cost_difference"
HEADER = (
    "submission", "by", "cost vs paper, %", "it said", "worst scenario, %", "harm", "ANEES", "ns", "trained for",
    "SHA-256",
)  # fmt: skip
NOTE = (
    "*cost vs paper*: in the training distribution, over the fresh episodes of the round, with 95 % intervals; every "
    "file has episodes of its own, so that rows are not paired. *it said*: over the known episodes of the protocol. "
    "*worst scenario*: where the cost is highest against the paper's. *harm*: scenarios in which it costs more "
    f"by {100 * HARM:.0f} %, the whole interval above. *ANEES*: in the training distribution; 1 if errors are as large "
    "as the covariance says. *ns*: nanoseconds a measurement on the machine that verified, of simulated world and "
    f"submission together; {PYTHON_MARK}: mostly Python's. *trained for*: decisions."
)


class Entry(NamedTuple):
    """A submission and its verification."""

    submission: Submission
    verification: Verification

    def figures(self, metric: str) -> dict[str, Figure]:
        """Numbers of the round by scenario."""
        return {
            f.scenario: f for f in self.verification.results if f.metric == metric and f.value is not None
        }

    @property
    def cost(self) -> float:
        """Against the paper's algorithm, in the training distribution."""
        return self.figures(AGAINST_PAPER)[self.submission.protocol.scenarios[0]].value or 0.0


def read_entries(folder: Path) -> list[Entry]:
    """Return what a folder holds.

    Raises:
        ValueError: for a submission that was not verified as it is, over another protocol, or without a round.
    """
    files = sorted(path for path in folder.glob("*.json") if not path.name.endswith(VERIFIED))
    if not files:
        raise ValueError(f"{folder} holds no submission")
    entries = []
    for path in files:
        submission, digest = read_submission(path)
        check_submission(problem_of(submission.environment), submission, path)
        verification = read_verification(path.with_name(path.stem + VERIFIED))
        if verification.submission != digest:
            raise ValueError(f"{path} is not the file that was verified: verify it again")
        fresh = verification.seed == round_seed(digest, verification.round)
        whole = {f.scenario for f in verification.results} == {*submission.protocol.scenarios}
        if not (fresh and whole and verification.difference <= 1.0 and submission.protocol.name == "board"):
            raise ValueError(f"{path} is not for the board: verify it with --round, under the protocol board")
        entries.append(Entry(submission, verification))
    return entries


def board_markdown(entries: Sequence[Entry]) -> str:
    """Return the board, lowest cost first."""
    lines = []
    for id in catalogue():
        own = sorted((e for e in entries if e.submission.environment == id), key=lambda entry: entry.cost)
        if own:
            protocol = own[0].submission.protocol
            lines += [f"## {short_name(id)}", ""]
            lines += [*markdown_table(HEADER, [_row(entry) for entry in own]), ""]
            lines += [f"{len(protocol.scenarios)} scenarios, {protocol.episodes} episodes of each.", ""]
    rounds = ", ".join(f"`{value}`" for value in dict.fromkeys(e.verification.round for e in entries))
    largest = max(e.verification.difference for e in entries) * TOLERANCE
    again = f"with differences of {largest:.0e} at most" if largest else "bit for bit"
    lines += [NOTE, "", f"Round {rounds}. All results of the files came out again {again}."]
    return "\n".join(lines)


def _row(entry: Entry) -> list[str]:
    submission, protocol, card = entry.submission, entry.submission.protocol, entry.submission.card
    training, found = protocol.scenarios[0], entry.figures(AGAINST_PAPER)
    worst = max(found.values(), key=lambda figure: figure.value or 0.0)
    said = next(f for f in submission.results if (f.scenario, f.metric) == (training, AGAINST_PAPER))
    time = next((f for f in entry.verification.results if f.metric == TIME and f.value is not None), None)
    anees = entry.figures("anees").get(training)
    return [
        f"{card.title} ({_kind(submission)})",
        card.author,
        _percent(found[training], interval=True),
        _percent(said),
        f"{_percent(worst)} `{worst.scenario}`",
        f"{sum((f.low or 0.0) > HARM for f in found.values())} of {len(found)}",
        "-" if anees is None else f"{anees.value:.2f}",
        "-" if time is None else time_text(ProcessorTime(time.value or 0.0, time.component == "compiled")),
        f"{card.budget:,}" if card.budget else "-",
        f"`{entry.verification.submission[:12]}`",
    ]


def _kind(submission: Submission) -> str:
    held = submission.competitor
    return "agent" if isinstance(held, Arrays) else "shipped" if isinstance(held, Shipped) else "source"


def _percent(figure: Figure, interval: bool = False) -> str:
    ends = (
        ""
        if figure.low is None or figure.high is None
        else f" [{100 * figure.low:+.1f}, {100 * figure.high:+.1f}]"
    )
    return f"{100 * (figure.value or 0.0):+.1f}{ends if interval else ''}"
