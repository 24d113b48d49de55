"""Figure of cost over processor time: a point for every competitor, and the Pareto front."""

import itertools
import math
from collections.abc import Collection, Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy
import xarray

from ..competitors.kinds import RANKED
from ..running.times import Point, front
from .looks import COLOURS, OWN
from .print_layout import FONT_SIZES, add_title, figure_with_axes, in_print

MOST_ABOVE = 1.0
"""Upper limit of the drawn costs, in octaves above the paper's cost. Competitors above it are only counted, except the
user's.
"""
TICKS = (
    *(-99.5, -99, -98, -95, -90, -85, -80, -75, -70, -65, -60, -55, -50, -45, -40, -35, -30, -25, -20, -15, -10, -5),
    *(0, 5, 10, 15, 20, 30, 40, 50, 70, 100),
)  # fmt: skip
"""Candidates for ticks of the cost axis, %; as many are drawn as fit."""
LEARNED, PAPER, CLASSICAL = COLOURS[1], COLOURS[0], "0.45"
TOUCHES = 3.0
"""Penalty of a label's place from which on it overlaps a line, a point or another label. There only the paper's
algorithm and the user's competitors have labels.
"""
DISTANCES = (5.0, 7.0, 9.0, 15.0, 23.0, 33.0, 45.0)
"""Distances of a label from its point, points of print; the nearest free one is used."""
NEAR = 3
"""Number of these distances for optional labels: lines to labels farther away would cross."""
DIRECTIONS = 16

Box = tuple[float, float, float, float]
"""Left, bottom, right, top of a rectangle, pixels."""


class FrontPanel(NamedTuple):
    """Competitors of one environment in one scenario, for a panel of the figure."""

    title: str
    points: Sequence[Point]
    """Cost and time of each competitor, with the cost relative to the paper's algorithm, %."""
    paper: str
    reference: str
    learned: Collection[str]
    own: Collection[str] = ()
    """Names of the user's competitors, which are always drawn and labelled."""

    @property
    def top(self) -> float:
        """Highest cost that is drawn, relative to the paper's algorithm, %."""
        ranked = [point for point in self.points if point.kind in RANKED or point.name == self.reference]
        usual = min(max((point.cost for point in ranked), default=0.0), _percent(MOST_ABOVE))
        return max([usual, *(point.cost for point in ranked if point.name in self.own)])

    @property
    def beyond(self) -> list[Point]:
        """Ranked competitors whose cost is too high to be drawn."""
        return [point for point in self.points if point.kind in RANKED and point.cost > self.top]


@in_print
def draw_front(
    curves: xarray.Dataset,
    points: Sequence[Point],
    learned: Sequence[str] = (),
    own: Sequence[str] = (),
    *,
    columns: int = 2,
) -> Any:
    """Return a figure of the cost relative to the paper's algorithm over the time of a measurement, with the front.

    Args:
        curves: curves of an evaluation with times.
        points: points of its competitors, see :func:`.times.points_of_records`.
        learned: names of learned competitors.
        own: names of the user's competitors.
        columns: width of the figure in columns of a paper, 1 or 2.
    """
    attrs = curves.attrs
    figure, (axis,) = figure_with_axes(columns=columns, height={1: 2.4, 2: 3.4}[columns])
    panel = FrontPanel("", points, attrs["paper"], attrs["reference"], learned, own)
    title = (
        f"{attrs['environment']}, scenario {attrs['scenario']}: cost and time of {attrs['episodes']} episodes"
    )
    draw_panel(axis, panel)
    add_title(figure, title, legend_of([panel]))
    name_points(figure, {axis: panel})
    return figure


def draw_panel(axis: Any, panel: FrontPanel) -> None:
    """Draw the competitors of one panel, their Pareto front and the reference, without labels."""
    axis.set_title(panel.title, loc="left")
    axis.set_xscale("log")
    axis.set_yscale("function", functions=(_octaves, _percent))
    costs = [point.cost for point in panel.points if point.kind in RANKED or point.name == panel.reference]
    top = panel.top
    low, high = _octaves(min(costs, default=0.0)), _octaves(top)
    margin = max(0.08 * (high - low), 0.01)
    axis.set_ylim(_percent(low - 1.6 * margin), _percent(high + margin))
    shown = [point for point in panel.points if point.kind in RANKED and point.cost <= top]
    times = [point.time.nanoseconds for point in shown] or [1.0]
    wide = max(max(times) / min(times), 2.0) ** 0.08
    axis.set_xlim(min(times) / wide**1.2, max(times) * wide**1.5)
    _label_axes(axis, panel)
    axis.axhline(0.0, color=PAPER, lw=0.6, zorder=1.0)
    for point in panel.points:
        if point.name == panel.reference:
            axis.axhline(point.cost, color="black", lw=0.9, ls="--", zorder=1.1)
    on_front = _on_front(panel)
    if on_front:
        x, y = ([getattr(value, name) for value in values] for values, name in (
            ([point.time for point in on_front], "nanoseconds"), (on_front, "cost"),
        ))  # fmt: skip
        # From the first point to the right end: more time never requires a higher cost.
        axis.step([*x, axis.get_xlim()[1]], [*y, y[-1]], where="post", color="0.25", lw=1.0, zorder=2.0)
    names = {point.name for point in on_front}
    for point in shown:
        axis.plot(point.time.nanoseconds, point.cost, **_marker(point, panel, point.name in names))


def legend_of(panels: Iterable[FrontPanel]) -> list[Any]:
    """Return legend handles for the kinds of competitors and lines in some panels."""
    from matplotlib.lines import Line2D

    shown = [(point, panel) for panel in panels for point in panel.points if point.kind in RANKED]
    handles: dict[str, Any] = {}
    for point, panel in shown:
        style = {**_marker(point, panel, True), "markerfacecolor": None, "linestyle": ""}
        style["markerfacecolor"] = style["color"]
        handles.setdefault(_origin(point, panel), Line2D([], [], label=_origin(point, panel), **style))
    if any(not point.time.compiled for point, _ in shown):
        style = {"marker": "o", "markersize": 4.0, "color": CLASSICAL, "markerfacecolor": "white"}
        handles["python"] = Line2D([], [], label="runs in Python", linestyle="", **style)
    handles["front"] = Line2D([], [], color="0.25", lw=1.0, label="the front")
    handles["reference"] = Line2D([], [], color="black", lw=0.9, ls="--", label="reference")
    order = ("yours", "paper's algorithm", "policy", "estimator", "learned", "python", "front", "reference")
    return [handles[name] for name in order if name in handles]


def name_points(figure: Any, panels: Mapping[Any, FrontPanel]) -> None:
    """Write the names of the paper's algorithm, the user's competitors, the front and the reference in free
    places.
    """
    figure.draw_without_rendering()
    figure.set_layout_engine("none")  # names must not move the axes
    for axis, panel in panels.items():
        _NamePlacement(figure, axis).place(panel)


class _NamePlacement:
    """Placement of competitors' names in one pair of axes, in pixels, in free places."""

    def __init__(self, figure: Any, axis: Any) -> None:
        self.figure, self.axis = figure, axis
        self.renderer = figure.canvas.get_renderer()
        self.pixels = figure.dpi / 72.0
        self.size = FONT_SIZES[1 if figure.get_figwidth() < 5.0 else 2] - 1.0
        self.window = axis.get_window_extent(self.renderer)
        self.points: list[Box] = []
        self.names: list[Box] = []
        self.lines: list[numpy.ndarray] = []
        """Points along lines, ``(n, 2)`` each, pixels."""

    def place(self, panel: FrontPanel) -> None:
        """Write all names of a panel."""
        on_front = _on_front(panel)
        low, high = self.axis.get_ylim()
        shown = [p for p in panel.points if p.kind in RANKED and low <= p.cost <= high]
        for point in shown:
            x, y = self._at(point.time.nanoseconds, point.cost)
            reach = (3.6 if point.name == panel.paper else 2.6) * self.pixels  # a star is larger
            self.points.append((x - reach, y - reach, x + reach, y + reach))
        corners = [self._at(point.time.nanoseconds, point.cost) for point in on_front]
        for (x, y), (x2, y2) in itertools.pairwise(corners):
            self._add_line((x, y), (x2, y))
            self._add_line((x2, y), (x2, y2))
        _, zero = self._at(1.0, 0.0)
        self._add_line((self.window.x0, zero), (self.window.x1, zero))
        if corners:
            self._add_line(corners[-1], (self.window.x1, corners[-1][1]))
        for point in panel.points:
            if point.name == panel.reference:
                _, y = self._at(1.0, point.cost)
                self._add_line((self.window.x0, y), (self.window.x1, y))
                self._name_line(point, y)
        names = {point.name for point in on_front}
        always = {panel.paper, *panel.own}
        others = [p for p in shown if p.name in always and p.name not in names]
        # The first name gets the best place, so several orders are tried.
        orders = [
            [*others, *on_front[i:], *on_front[:i]][::step] for i in range(len(on_front)) for step in (1, -1)
        ]
        before, best, least = (list(self.names), list(self.lines)), None, math.inf
        for order in orders or [others]:
            self.names, self.lines = list(before[0]), list(before[1])
            found = ((point, self._find_place(point, point.name in always)) for point in order)
            places = [(point, *place) for point, place in found if place is not None]
            badness = sum(bad for *_, bad in places) + 3.0 * TOUCHES * (len(order) - len(places))
            if badness < least:
                best, least = places, badness
        for point, box, _ in best or ():
            self._name(point, box, _colour(point, panel))

    def _at(self, x: float, y: float) -> tuple[float, float]:
        found = self.axis.transData.transform((x, y))
        return float(found[0]), float(found[1])

    def _add_line(self, start: tuple[float, float], end: tuple[float, float]) -> None:
        self.lines.append(numpy.linspace(start, end, 60))

    def _extent(self, text: str) -> tuple[float, float]:
        drawn = self.axis.text(0.5, 0.5, text, fontsize=self.size)
        box = drawn.get_window_extent(self.renderer)
        drawn.remove()
        return float(box.width), float(box.height)

    def _name_line(self, point: Point, y: float) -> None:
        """Write the reference's name on its line, at the less crowded end."""
        width, height = self._extent(point.name)
        gap = 2.0 * self.pixels
        boxes = [
            (left, bottom, left + width, bottom + height)
            for left in (self.window.x1 - width - gap, self.window.x0 + gap)
            for bottom in (y + 0.5 * gap, y - height - 0.5 * gap)
        ]
        best = boxes[int(numpy.argmin(self._crowding(numpy.array(boxes))))]
        self.names.append(best)
        self._write(point.name, best, "black")

    def _find_place(self, point: Point, always: bool) -> tuple[Box, float] | None:
        """Reserve the best box for a point's name; return it with its penalty, or None without a free place."""
        width, height = self._extent(point.name)
        x, y = self._at(point.time.nanoseconds, point.cost)
        k = numpy.arange(DIRECTIONS)
        # There are no points below the front: the search starts there.
        angle = math.pi * (1.25 + (k + 1) // 2 * (-1) ** k * 2.0 / DIRECTIONS)
        distances = DISTANCES if always else DISTANCES[:NEAR]
        reach = numpy.repeat(distances, DIRECTIONS) * self.pixels
        cosine, sine = (numpy.tile(f(angle), len(distances)) for f in (numpy.cos, numpy.sin))
        cx = x + reach * cosine + 0.5 * width * _unit(cosine)
        cy = y + reach * sine + 0.5 * height * _unit(sine)
        boxes = numpy.stack(
            [cx - 0.5 * width, cy - 0.5 * height, cx + 0.5 * width, cy + 0.5 * height], axis=1
        )
        touched = self._crowding(boxes) + 5.0 * (
            self._crosses((x, y), boxes) | self._is_nearer((x, y), boxes)
        )
        badness = 2.0 * touched + numpy.add.outer(0.05 * numpy.array(distances), 0.06 * k).ravel()
        best = int(numpy.argmin(badness))
        if touched[best] >= TOUCHES and not always:
            return None
        box = left, bottom, right, top = tuple(boxes[best].tolist())
        self.names.append((left, bottom, right, top))
        self._add_line((x, y), _nearest(box, (x, y)))
        return box, float(badness[best])

    def _name(self, point: Point, box: Box, colour: str) -> None:
        """Write a name into its box, with a line to its point if that is not near."""
        x, y = self._at(point.time.nanoseconds, point.cost)
        end = _nearest(box, (x, y))
        if math.dist((x, y), end) > 6.5 * self.pixels:
            line = self.axis.transData.inverted().transform(numpy.array([(x, y), end]))
            self.axis.plot(line[:, 0], line[:, 1], color=colour, lw=0.5, zorder=2.5)
        self._write(point.name, box, colour)

    def _crosses(self, start: tuple[float, float], boxes: numpy.ndarray) -> numpy.ndarray:
        """Return a mask of boxes whose line to the point crosses another name or point."""
        ends = numpy.clip(numpy.array(start), boxes[:, :2], boxes[:, 2:])
        x, y = numpy.linspace(numpy.broadcast_to(start, ends.shape), ends, 12, axis=1).T[..., None]
        a, b, c, d = numpy.array(self.points + self.names).reshape(-1, 4).T
        others = ~((a <= start[0]) & (start[0] <= c) & (b <= start[1]) & (start[1] <= d))
        found: numpy.ndarray = ((x > a) & (x < c) & (y > b) & (y < d) & others).any(axis=(0, 2))
        return found

    def _is_nearer(self, point: tuple[float, float], boxes: numpy.ndarray) -> numpy.ndarray:
        """Return a mask of boxes that are about as near to another point, so that a name there is ambiguous."""
        taken = numpy.array(self.points)
        centres = 0.5 * (taken[:, :2] + taken[:, 2:])
        apart = numpy.linalg.norm(centres - point, axis=1) > 5.0 * self.pixels
        centres = numpy.concatenate([[point], centres[apart]])[:, None]
        distances = numpy.linalg.norm(centres - numpy.clip(centres, boxes[:, :2], boxes[:, 2:]), axis=-1)
        nearer: numpy.ndarray = (distances[1:] < 1.3 * distances[0]).any(axis=0)
        return nearer

    def _crowding(self, boxes: numpy.ndarray) -> numpy.ndarray:
        """Return the weighted overlap of each box with names, points, lines and the frame."""
        left, bottom, right, top = boxes.T[..., None]
        margin = 0.8 * self.pixels
        found = numpy.zeros(len(boxes))
        for weight, taken in ((10.0, self.points), (50.0, self.names)):
            a, b, c, d = numpy.array(taken).reshape(-1, 4).T
            across = numpy.minimum(right + margin, c) - numpy.maximum(left - margin, a)
            along = numpy.minimum(top + margin, d) - numpy.maximum(bottom - margin, b)
            found += weight * numpy.count_nonzero((across > 0.0) & (along > 0.0), axis=1)
        lines = numpy.array(self.lines)
        x, y = lines.reshape(-1, 2).T
        inside = (x > left) & (x < right) & (y > bottom - margin) & (y < top + margin)
        found += 3.0 * numpy.count_nonzero(inside.reshape(len(boxes), len(lines), -1).any(axis=2), axis=1)
        window = self.window
        outside = (
            (left < window.x0 + margin)
            | (right > window.x1 - margin)
            | (bottom < window.y0 + margin)
            | (top > window.y1)
        )
        found += 100.0 * outside[:, 0]
        return found

    def _write(self, text: str, box: Box, colour: str) -> None:
        from matplotlib.patheffects import withStroke

        middle = 0.5 * (box[0] + box[2]), 0.5 * (box[1] + box[3])
        x, y = self.axis.transAxes.inverted().transform(middle)
        # A white rim separates it from the lines behind it.
        rim = [withStroke(linewidth=2.0, foreground="white")]
        style = {"fontsize": self.size, "path_effects": rim, "color": colour, "zorder": 4.0}
        self.axis.text(x, y, text, transform=self.axis.transAxes, ha="center", va="center", **style)


def _nearest(box: Box, point: tuple[float, float]) -> tuple[float, float]:
    """Return the point of a box that is nearest to another point."""
    return min(max(point[0], box[0]), box[2]), min(max(point[1], box[1]), box[3])


def _unit(cosine: numpy.ndarray) -> numpy.ndarray:
    """Return the offset of a box's centre over half its size, -1 to 1, in the direction of a cosine."""
    return numpy.clip(1.8 * cosine, -1.0, 1.0)


def _octaves(percent: Any) -> Any:
    """Return log2(cost / cost of the paper), from their relative difference in %."""
    return numpy.log2(numpy.maximum(1.0 + numpy.asarray(percent) / 100.0, 1e-6))


def _percent(octaves: Any) -> Any:
    return 100.0 * (2.0 ** numpy.asarray(octaves) - 1.0)


def _on_front(panel: FrontPanel) -> list[Point]:
    by_name = {point.name: point for point in panel.points}
    return [by_name[name] for name in front(panel.points)]


def _origin(point: Point, panel: FrontPanel) -> str:
    if point.name == panel.paper:
        return "paper's algorithm"
    if point.name in panel.own:
        return "yours"
    return "learned" if point.name in panel.learned else point.kind


def _colour(point: Point, panel: FrontPanel) -> str:
    return {"paper's algorithm": PAPER, "learned": LEARNED, "yours": OWN}.get(_origin(point, panel), "black")


MARKED = ("paper's algorithm", "learned", "yours")
"""Origins of competitors that have a colour whether on the front or not."""


def _marker(point: Point, panel: FrontPanel, on_front: bool) -> dict[str, Any]:
    where = _origin(point, panel)
    colour = _colour(point, panel) if on_front or where in MARKED else CLASSICAL
    shape = {"paper's algorithm": "*", "learned": "D", "estimator": "s", "yours": "P"}.get(where, "o")
    size = {"*": 7.0, "D": 3.8, "P": 6.0}.get(shape, 3.6) + 0.8 * on_front
    return {
        "marker": shape,
        "markersize": size,
        "color": colour,
        "markerfacecolor": colour if point.time.compiled else "white",
        "markeredgewidth": 0.9,
        "zorder": 3.7 if where in ("paper's algorithm", "yours") else 3.5 if on_front else 3.0,
    }


def _label_axes(axis: Any, panel: FrontPanel) -> None:
    """Draw ticks and titles of the axes, and the number of competitors above the upper limit."""
    from matplotlib.ticker import FixedLocator, NullLocator

    low, high = (float(_octaves(end)) for end in axis.get_ylim())
    chosen: list[float] = []
    # Zero first, then round numbers, at least a tenth of the height apart.
    for tick in sorted(TICKS, key=lambda t: (t != 0, t % 50 != 0, t % 20 != 0, t % 10 != 0, t)):
        at = float(_octaves(tick))
        if low <= at <= high and all(abs(at - float(_octaves(o))) > (high - low) / 10.0 for o in chosen):
            chosen.append(tick)
    axis.yaxis.set_major_locator(FixedLocator(sorted(chosen)))
    axis.yaxis.set_minor_locator(NullLocator())
    axis.yaxis.set_major_formatter(lambda x, _: f"{x:+g}" if x else "0")
    axis.set_xlabel("nanoseconds a measurement")
    axis.set_ylabel(f"cost against {panel.paper or 'the paper'}, %")
    if beyond := len(panel.beyond):
        axis.text(
            0.985,
            0.98,
            f"{beyond} cost more than {panel.top:+.0f} %"
            if beyond > 1
            else f"1 costs more than {panel.top:+.0f} %",
            transform=axis.transAxes,
            ha="right",
            va="top",
            fontsize=6,
            color="0.4",
        )
    axis.xaxis.set_major_formatter("{x:,.0f}")
    left, right = axis.get_xlim()
    few = right / left
    digits = "2345678" if few < 5.0 else "25" if few < 300.0 else ""
    axis.xaxis.set_minor_formatter(lambda x, _: f"{x:,.0f}" if f"{x:.0e}"[0] in digits else "")
    axis.tick_params(axis="x", which="minor", pad=5.0)  # their marks are shorter than those of decades
    axis.grid(alpha=0.25, lw=0.4)
