"""The room table: how much there is to win on an environment's training distribution."""

from collections.abc import Callable

from ..baselines.catalogue import baselines_of, paper_of
from ..baselines.reproduction import markdown_table
from ..baselines.tuning import tuned_names
from ..envs.catalogue import task_class
from ..evaluation.metrics import Record
from ..names import evaluate, tidy_records
from .tables import main_components, with_interval

MARKER = "room table"
"""What the markers of a page are called, between which the table stands."""


def room_policies(id: str) -> list[str]:
    """Names in the room table: best constant action, paper, tuned policies, references, bounds."""
    known = baselines_of(id)
    tuned = tuned_names(id)
    constant = f"{known.best_constant}-tuned"
    first = [constant] if constant in tuned else []
    others = [name for name in tuned if name != constant]
    return [*first, paper_of(id), *others, *known.estimators, *known.references, *known.bounds]


def measure_room(id: str, episodes: int, seed: int, progress: Callable[[int], None]) -> list[Record]:
    """Evaluate everything that the room table shows, on the test split of the default scenario."""
    return tidy_records(
        evaluate(task_class(id).id, room_policies(id), None, episodes, seed, progress=progress)
    )


def room_markdown(records: list[Record], command: str) -> str:
    """Return the room table as Markdown, with the command that makes it."""
    first = records[0]
    found = {(r.policy, r.metric, r.component, r.window): r for r in records}
    shown = main_components(records)
    units = {r.component: r.unit for r in records if r.metric == "rmse"}
    header = [
        "policy",
        "control",
        "mean cost",
        *(f"RMSE {c.replace('_', ' ')}, {units[c]}" for c in shown),
        "score",
    ]
    rows = []
    for name, kind, control in dict.fromkeys((r.policy, r.kind, r.control) for r in records):
        rows.append(
            [
                f"`{name}`",
                control if kind == "policy" else f"({kind})",
                with_interval(found.get((name, "cost", "", "all"))),
                *(with_interval(found.get((name, "rmse", c, "all"))) for c in shown),
                with_interval(found.get((name, "score", "", "all"))),
            ]
        )
    note = (
        f"Scenario `{first.scenario}`, {first.episodes} episodes of the {first.split} split, "
        f"95 % bootstrap intervals. Made by `{command}`."
    )
    return "\n".join([*markdown_table(header, rows), "", note])
