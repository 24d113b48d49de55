"""The picture at the top of a report: cost against computing time, an image for each environment."""

import base64
import io
from collections.abc import Sequence
from typing import NamedTuple

from ...evaluation.competitors.kinds import RANKED
from ...evaluation.figures.front_figure import FrontPanel, draw_panel, name_points
from ...evaluation.figures.print_layout import figure_with_axes, in_print
from ...evaluation.running.times import Point, front, points_of_records
from ..tables.headline import headline
from ..tables.results import Result


class FrontImage(NamedTuple):
    """Picture of cost against time in one environment: title, words, and the image as a data address."""

    title: str
    words: str
    """Sentences on the front, the quickest first, on the user's own competitors, and on those outside the picture."""
    address: str
    """The image as a ``data:`` address."""


def front_images(results: Sequence[Result]) -> list[FrontImage]:
    """Return a picture of cost against time for each environment whose competitors were timed."""
    found = []
    for result, _ in headline(results):
        points = {point.name: point for point in points_of_records(result.records)}
        if not any(point.kind in RANKED for point in points.values()):
            continue
        on_front = [points[name] for name in front(list(points.values()))]
        title = result.short if result.default else f"{result.short}, {result.scenario}"
        panel = FrontPanel(
            title, list(points.values()), result.paper, result.reference, result.learned, result.own
        )
        lists = {
            "Yours": [points[name] for name in result.own if name in points],
            "On the front, the quickest first": on_front,
            "Not drawn": panel.beyond,
        }
        words = " ".join(
            f"{what}: {', '.join(map(_place, listed))}." for what, listed in lists.items() if listed
        )
        encoded = base64.b64encode(_panel_svg(panel, columns=1)).decode()
        found.append(FrontImage(title, words, f"data:image/svg+xml;base64,{encoded}"))
    return found


def _place(point: Point) -> str:
    cost = f"{point.cost:+,.0f}" if round(point.cost) else "0"
    return f"{point.name} {cost}\xa0% in {float(f'{point.time.nanoseconds:.2g}'):,.0f}\xa0ns"


@in_print
def _panel_svg(panel: FrontPanel, *, columns: int) -> bytes:
    """Draw a panel of cost against time, and return its SVG: the same bytes every time."""
    from matplotlib import rc_context

    # Names are of anybody: between two dollars they are no formulas.
    with rc_context({"text.parse_math": False, "svg.fonttype": "path", "svg.hashsalt": "filtergym"}):
        figure, (axis,) = figure_with_axes(columns=columns, height=2.3)
        draw_panel(axis, panel)
        name_points(figure, {axis: panel})
        written = io.BytesIO()
        figure.savefig(written, format="svg", metadata={"Date": None})
    return written.getvalue()
