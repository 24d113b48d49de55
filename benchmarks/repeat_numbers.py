"""Published numbers drawn at random and repeated on fresh episodes: how many intervals hold what comes out.

    python benchmarks/repeat_numbers.py --numbers 40 --seed 2026

Drawn are numbers that README and the pages name by a path into a record of the benchmark, and that have an interval.
Each is measured again, of as many episodes of the test split and of an experiment of its own (from ``--seed`` on): on
shared episodes all numbers of a scenario would miss together. A published interval is for the truth and not for another
sample, so the two are compared: they agree where the difference of both values is within the root of the sum of the
squares of both half widths, which for independent 95 % intervals holds in 95 % too.
Printed in Markdown; it ends with status 1 where fewer agree than one in a thousand would by chance.
"""

import argparse
import math
import re
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy
from filtergym.baselines.problem import problem_of
from filtergym.evaluation.running.metrics import Record
from filtergym.evaluation.running.parallel import check_workers
from filtergym.evaluation.running.summary import combine_summaries, summaries
from filtergym.papers.grid import markdown_table
from scipy.stats import binom

from filtergym.names import evaluation_requests

ROOT = Path(__file__).parent.parent
sys.path.insert(0, str(ROOT / "docs" / "make"))

from records import environment_id, read_benchmark  # noqa: E402  (of the folder that has just been named)
from sentence_numbers import QUANTITIES  # noqa: E402

PATH = re.compile(
    r"(?:\{(?:number|value)\}`|<!-- (?:number|value): )([A-Z]\w+)/([\w-]+)/([\w:-]+)/([\w ]+?)(?:`| -->)"
)
UNLIKELY = 1e-3
"""Probability of so few agreements by chance, below which something is wrong."""


class Published(NamedTuple):
    """A number of a page."""

    page: str
    environment: str
    scenario: str
    competitor: str
    quantity: str
    record: Record
    """What the record of the benchmark says."""


def published_numbers() -> Iterator[Published]:
    """Return every number of README and the pages with an interval, each once."""
    seen = set()
    pages = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
    found: dict[str, dict[Any, Record]] = {}
    for page in pages:
        for environment, scenario, competitor, quantity in PATH.findall(page.read_text(encoding="utf-8")):
            key = environment, scenario, competitor, quantity
            if key in seen:
                continue
            seen.add(key)
            if environment not in found:
                records = read_benchmark(environment)[0].records
                found[environment] = {
                    (r.scenario, r.policy, f"{r.metric} {r.component}".strip()): r for r in records
                }
            metric = QUANTITIES.get(quantity, (quantity,))[0]
            record = next(
                (
                    r
                    for (s, p, m), r in found[environment].items()
                    if (s, p) == (scenario, competitor) and (m == metric or m.startswith(f"{metric} "))
                ),
                None,
            )
            if record is not None and record.low is not None and record.low != record.high:
                yield Published(str(page.relative_to(ROOT)), *key, record)


def repeat(one: Published, seed: int) -> Record:
    """Measure a number again on the episodes of another experiment.

    Whom it is compared with takes part: the paper's algorithm, the reference, and the one that was best.
    """
    problem = problem_of(environment_id(one.environment))
    known, metric = problem.baselines, one.record.metric
    best = one.record.component if metric == "behind_best" else ""
    names = [known.compared_paper, known.score_reference, one.competitor, best]
    experiment = problem.experiment(one.scenario, one.record.episodes, seed)
    wanted = list(dict.fromkeys(filter(None, names)))
    requests = evaluation_requests(problem, experiment, wanted, curves=False)
    summary = dict(summaries(requests, check_workers(None)))
    records = combine_summaries([summary[i] for i in range(len(requests))])[0]
    return next(
        r
        for r in records
        if (r.policy, r.metric, r.window) == (one.competitor, metric, "all")
        if best or r.component == one.record.component
    )


def agrees(one: Record, other: Record) -> bool:
    """Whether two values differ by no more than both intervals allow, of each the half that faces the other."""
    if one.value is None or other.value is None:
        return one.value == other.value
    lower, upper = sorted((one, other), key=lambda record: record.value or 0.0)
    up = 0.0 if lower.high is None else lower.high - (lower.value or 0.0)
    down = 0.0 if upper.low is None else (upper.value or 0.0) - upper.low
    return (upper.value or 0.0) - (lower.value or 0.0) <= math.hypot(up, down)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--numbers", type=int, default=40)
    parser.add_argument(
        "--seed", type=int, default=2026, help="of the draw, and number of the first experiment"
    )
    asked = parser.parse_args()
    every = list(published_numbers())
    chosen = numpy.random.default_rng(asked.seed).permutation(len(every))[: asked.numbers]
    rows, held = [], 0
    for number, i in enumerate(chosen):
        one = every[int(i)]
        fresh = repeat(one, asked.seed + number)
        held += (good := agrees(one.record, fresh))
        texts = [
            "-" if r.value is None else f"{r.value:.4g} [{r.low or 0.0:.4g}, {r.high or 0.0:.4g}]"
            for r in (one.record, fresh)
        ]
        where = f"`{one.environment}/{one.scenario}/{one.competitor}/{one.quantity}`"
        rows.append([one.page, where, *texts, "yes" if good else "no"])
        print(*rows[-1][1:], f"({held} of {len(rows)})", file=sys.stderr, flush=True)
    print("\n".join(markdown_table(["page", "number", "published", "fresh", "agree"], rows)))
    print(f"\n{held} of {len(rows)} agree; 95 % are {0.95 * len(rows):.0f}.")
    if binom.cdf(held, len(rows), 0.95) < UNLIKELY:
        sys.exit(1)


if __name__ == "__main__":
    main()
