"""The picture at the top of a report: cost against computing time, an image for each environment."""

import base64
import io
from collections.abc import Sequence
from typing import NamedTuple

from ...evaluation.competitors.kinds import RANKED
from ...evaluation.figures.front_figure import FrontPanel, draw_panel, name_points
from ...evaluation.figures.print_layout import DOTS_PER_INCH, figure_with_axes, in_print
from ...evaluation.running.times import front, points_of_records
from ..tables.headline import headline
from ..tables.results import Result


class FrontImage(NamedTuple):
    """Cost and time of the competitors of one environment."""

    title: str
    words: str
    """Who is on the front, the quickest first."""
    address: str
    """The image itself, as a ``data:`` address."""


def front_images(results: Sequence[Result]) -> list[FrontImage]:
    """Draw each environment of the table of the best whose competitors were timed.

    Args:
        results: as of :func:`.headline.headline`.
    """
    found = []
    for result, _ in headline(results):
        points = {point.name: point for point in points_of_records(result.records)}
        if not any(point.kind in RANKED for point in points.values()):
            continue
        on_front = [points[name] for name in front(list(points.values()))]
        words = ", ".join(f"{p.name} {p.cost:+.3g} % in {p.time.nanoseconds:.2g} ns" for p in on_front)
        title = result.short if result.default else f"{result.short}, {result.scenario}"
        panel = FrontPanel(title, list(points.values()), result.paper, result.reference, result.learned)
        encoded = base64.b64encode(_draw(panel, columns=1)).decode()
        found.append(FrontImage(title, words, f"data:image/png;base64,{encoded}"))
    return found


@in_print
def _draw(panel: FrontPanel, *, columns: int) -> bytes:
    """Return the panel as a PNG of twice the width that a page shows it in."""
    from matplotlib import rc_context

    # Names are of anybody: between two dollars they are no formulas.
    with rc_context({"text.parse_math": False}):
        figure, (axis,) = figure_with_axes(columns=columns, height=2.3)
        draw_panel(axis, panel)
        name_points(figure, {axis: panel})
        written = io.BytesIO()
        figure.savefig(written, format="png", dpi=DOTS_PER_INCH)
    return written.getvalue()
