"""Pictures of a running episode, for ``render_mode`` "rgb_array" and "human".

An :class:`EpisodePicture` stores the history of one episode and draws it into one figure. A :class:`Picture`
determines the content: that of the problem's :class:`~.companions.PictureMaker`, or the base class, which can draw
every task.

Pictures show the truth, also that of the scans to come (the limits of the axes, marked manoeuvres). An agent
observes none of it.

This module imports matplotlib; the environment imports it only for a render mode.
"""

import copy
import math
import time
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import gymnasium
import matplotlib
import numpy
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from ...compiler.functions import map_arrays, round_up_lanes
from ...filters.array_namespace import host_array
from ..contract.model import Model

BLUE, VERMILLION, GREEN, SKY, ORANGE, PURPLE, BLACK, GREY = (
    "#0072B2", "#D55E00", "#009E73", "#56B4E9", "#E69F00", "#CC79A7", "#000000", "#8A8A8A",
)  # fmt: skip
"""Colours that stay apart for colour-blind readers (Okabe and Ito, 2008), and a grey."""
PALE = "#EBEBEB"
"""Ground of marked stretches, and lines of a grid."""
COLOURS = (BLACK, BLUE, VERMILLION, GREEN, SKY, ORANGE, PURPLE, PALE)
"""Colours of all pictures: animations have these and their shades."""
CURVES = ((BLUE, "-"), (VERMILLION, "--"), (GREEN, "-."), (PURPLE, ":"), (ORANGE, "-"), (SKY, "--"))
"""Colour and line style of the curves of a strip: two ways to distinguish them."""
FIGURE_SIZE = (12.0, 7.6)
"""Width and height, inches."""
DOTS_PER_INCH = 80.0
"""960 by 608 pixels: multiples of 16, as video encoders like them."""
BAND_SIGMAS = 2.0
"""Half the width of the shaded band, reported standard deviations."""
MAX_PICTURES = 4
"""Largest number of sub-environments that are drawn."""
MOST_COMPONENTS = 8
"""Largest number of error components in the general picture."""
LADDER = (1.0, 2.0, 5.0)
"""Limits grow by these factors and their multiples by ten: seldom, and by enough to be noticed."""

History = Mapping[str, numpy.ndarray]
"""Values of every series, one for each measurement acted on, ``(k,)``."""


class Strip(NamedTuple):
    """Panel of curves over the number of the measurement (a time series)."""

    title: str
    """Title, with the unit."""
    curves: Mapping[str, str]
    """Name in the legend -> name of the series."""
    limits: tuple[float, float]
    """Lowest and highest value shown; they grow when a curve leaves them."""
    band: str | None = None
    """Series of the reported standard deviation: a shaded band of plus and minus two of it."""
    guides: tuple[float, ...] = ()
    """Levels of thin lines."""
    steps: bool = False
    """Whether values are constant during a measurement and then jump, like choices."""


def error_strip(title: str, component: str, limit: float) -> Strip:
    """Return the time-series panel of a component's error with its reported band; its limits begin at +-``limit``."""
    return Strip(
        title, {"error": f"error.{component}"}, (-limit, limit), band=f"sigma.{component}", guides=(0.0,)
    )


def widen_limits(limits: tuple[float, float], low: float, high: float) -> tuple[float, float]:
    """Return axis limits widened about zero by a factor of 1, 2, 5, 10, ... until they contain low and high."""
    lowest, highest = limits
    # A value on the far side of a limit at zero cannot be reached by stretching, and is cut off.
    needed = max(
        [1.0]
        + [
            value / limit
            for value, limit in ((low, lowest), (high, highest))
            if limit and math.isfinite(value)
        ]
    )
    decade = 10.0 ** math.floor(math.log10(needed))
    factor = decade * next((step for step in LADDER if step * decade >= needed * (1.0 - 1e-9)), 10.0)
    return lowest * factor, highest * factor


class Picture:
    """Picture of an episode; this base class draws errors, actions and observations of any task.

    A subclass declares additions to the history (:meth:`records`) and time series (:meth:`strips`), and may draw
    further panels into the figure's left part (:meth:`open`, :meth:`begin`, :meth:`draw`).

    Args:
        model: of the episodes; its states contain lane 0 of a batch that is padded to several.
    """

    clock = "measurement"
    """Word for a measurement on the time axis and in the title."""
    strips_left: float = 0.065
    """Left edge of the strips, as a share of the figure's width; the panels are left of it."""
    strip_columns = 0
    """Columns of strips; 0: chosen by the number of strips."""
    steered = True
    """Whether an action steers the filter; the title then names its control."""

    def __init__(self, model: Model) -> None:
        self.model = model
        self.task: Any = model.task

    def records(self, state: Any) -> dict[str, float]:
        """Return further values for the history, beside errors, sigmas and actions, by name; by default none."""
        return {}

    def strips(self) -> Sequence[Strip]:
        """Return the time series of the picture: the error of each component with its reported band, and the action."""
        shown = self.model.task.components[:MOST_COMPONENTS]
        errors = [
            error_strip(f"error of {component.name.replace('_', ' ')}, {component.unit}", component.name, 1.0)
            for component in shown
        ]
        space = self.model.action_space
        discrete = isinstance(space, gymnasium.spaces.Discrete)
        if isinstance(space, gymnasium.spaces.Discrete):
            count, limits = 1, (-0.2, float(space.n) - 0.8)
        else:
            assert isinstance(space, gymnasium.spaces.Box)
            count = int(numpy.prod(space.shape))
            margin = 0.05 * float(space.high.max() - space.low.min())
            limits = float(space.low.min()) - margin, float(space.high.max()) + margin
        named = {f"{i + 1}" if count > 1 else "action": f"action.{i}" for i in range(min(count, len(CURVES)))}
        return [*errors, Strip(f"action, {self.model.control}", named, limits, steps=discrete)]

    def shows_observation(self) -> bool:
        """Return whether the picture's last panel shows the observation as colours; by default True."""
        return True

    def open(self, figure: Figure) -> None:
        """Create the panels that a subclass draws beside the time series, once for a figure; by default none."""

    def begin(self, state: Any) -> None:
        """Prepare the picture for a new episode, whose first measurement has arrived; by default do nothing."""

    def shading(self) -> Sequence[tuple[float, float]]:
        """Return intervals of measurements that every time series shades grey, first and last; by default none."""
        return ()

    def arrange(self) -> None:
        """Set the picture's axis limits for a new episode, before its first drawing; by default do nothing."""

    def draw(self, history: History, state: Any) -> None:
        """Update the panels of :meth:`open` to the current measurement; by default do nothing.

        ``history`` is of the measurements acted on; ``state`` is after the last measurement, not yet acted on.
        """


def picture_of(model: Model) -> Picture:
    """Return the picture that a model's task declares, or the general one."""
    return model.picture() or Picture(model)


class _StripPanel:
    def __init__(self, axes: Axes, strip: Strip) -> None:
        self.axes, self.strip = axes, strip
        axes.set_title(strip.title, loc="left", fontsize=9, pad=4)
        for level in strip.guides:
            axes.axhline(level, color=GREY, linewidth=0.8, linestyle=(0, (1, 2)), zorder=1)
        self.band = None
        if strip.band is not None:
            self.band = axes.fill_between([0.0], 0.0, 0.0, color=SKY, alpha=0.4, linewidth=0.0, zorder=2)
            self.band.set_label(f"±{BAND_SIGMAS:g}σ reported")
        drawstyle = "steps-mid" if strip.steps else "default"
        self.lines = [
            axes.plot(
                [],
                [],
                color=color,
                linestyle=style,
                linewidth=1.4,
                label=name,
                zorder=3,
                drawstyle=drawstyle,
                marker="o",
                markersize=3.5,
                markevery=slice(-1, None),
            )[0]
            for name, (color, style) in zip(strip.curves, CURVES, strict=False)
        ]
        if self.band is not None or len(self.lines) > 1:
            # Above the axes, where no curve can run beneath it.
            axes.legend(
                loc="lower right", bbox_to_anchor=(1.0, 1.005), ncols=len(CURVES), fontsize=8, frameon=False,
                borderpad=0.0, borderaxespad=0.2, handlelength=2.8, columnspacing=1.0, handletextpad=0.4,
            )  # fmt: skip

    def draw(self, history: History, count: int) -> None:
        times = numpy.arange(1, count + 1)
        low, high = numpy.inf, -numpy.inf
        for line, series in zip(self.lines, self.strip.curves.values(), strict=False):
            values = history.get(series, numpy.empty(0))
            line.set_data(times[: len(values)], values)
            finite = values[numpy.isfinite(values)]
            if len(finite):
                low, high = min(low, float(finite.min())), max(high, float(finite.max()))
        if self.band is not None and self.strip.band is not None:
            half = BAND_SIGMAS * history.get(self.strip.band, numpy.empty(0))
            self.band.set_data(times[: len(half)], -half, half)
        # The band alone does not stretch the limits: at the start it is far wider than all that follows.
        if low <= high:
            self.axes.set_ylim(*widen_limits(self.strip.limits, low, high))


class _ObservationPanel:
    """Panel of the observation as colours, one row for each component."""

    def __init__(self, axes: Axes, fields: int, horizon: int) -> None:
        self.axes = axes
        self.values = numpy.full((fields, horizon), numpy.nan)
        self.image = axes.imshow(
            self.values, aspect="auto", origin="upper", interpolation="nearest", cmap="PuOr_r",
            vmin=-3.0, vmax=3.0, extent=(0.5, horizon + 0.5, fields + 0.5, 0.5),
        )  # fmt: skip
        axes.set_title("observation by component (colour: -3 to 3)", loc="left", fontsize=9, pad=4)
        axes.yaxis.set_major_locator(MaxNLocator(integer=True))

    def draw(self, observations: Sequence[numpy.ndarray]) -> None:
        self.values[:] = numpy.nan
        if observations:
            self.values[:, : len(observations)] = numpy.stack(observations, axis=1)
        self.image.set_data(self.values)


_NO_FIGURE: Mapping[str, Any] = {"_figure": None, "_ground": None, "_limits": (), "_fresh": True}
"""Attributes of an episode's picture before its first drawing."""
_FIGURE = (*_NO_FIGURE, "_title", "_panels", "_observation", "_shades")
"""Attributes that belong to the figure."""


class EpisodePicture:
    """History and picture of one running episode.

    Args:
        mode: "rgb_array" or "human".
        frames_per_second: largest frame rate of a window.
        picture: content; default: the picture of the model's task, or the general one.

    If "human" cannot open a window, the episode continues without one, with a warning of Gymnasium.
    """

    def __init__(
        self,
        model: Model,
        scenario: str,
        mode: str,
        frames_per_second: float,
        picture: Picture | None = None,
    ) -> None:
        self.model = model
        self.scenario = scenario
        self.mode = mode
        self.frames_per_second = frames_per_second
        self.caption = ""
        """Part of the title beside environment, scenario and control, such as the policy's name."""
        self.picture: Picture = picture_of(model) if picture is None else picture
        self.history: dict[str, list[float]] = {}
        self.observations: list[numpy.ndarray] = []
        self.count: int = 0
        self._figure: Figure | None = None
        self._limits: Sequence[tuple[float, ...]] = ()
        self._ground: Any = None
        self._fresh = True
        self._last_shown = 0.0
        self._artists: set[str] = set()
        """Attributes of the picture that are parts of the figure."""
        self._unseen = False
        """Whether no window can be opened: the episode continues without one."""
        if mode == "human" and (problem := _missing_display()):
            self._go_on_unseen(problem)

    def __getstate__(self) -> dict[str, Any]:
        picture = copy.copy(self.picture)
        for name in self._artists & vars(picture).keys():
            delattr(picture, name)
        attributes = {name: value for name, value in vars(self).items() if name not in _FIGURE}
        return {**attributes, "picture": picture, **_NO_FIGURE}

    # --- history

    def begin(self, state: Any) -> None:
        """Delete the picture's history and start a new episode, whose first measurement has arrived."""
        self.history, self.observations, self.count = {}, [], 0
        self.picture.begin(state)
        self._fresh = True

    def keep(self, state: Any, action: numpy.ndarray, observation: numpy.ndarray) -> None:
        """Append a measurement, the action and the observation before it to the picture's history.

        ``state`` is after the action, of which lane 0 is stored; ``observation``, ``(fields,)``, is before it.
        """
        nothing = numpy.full(len(self.model.task.components), numpy.nan)
        error = self.model.error(state)[:, 0] if self.model.task.has_truth else nothing
        variance = numpy.diagonal(self.model.covariance(state)[:, :, 0])
        sigma = numpy.sqrt(numpy.maximum(variance, 0.0))
        names = [component.name for component in self.model.task.components]
        values = {
            **{f"error.{name}": value for name, value in zip(names, error, strict=True)},
            **{f"sigma.{name}": value for name, value in zip(names, sigma, strict=True)},
            **{f"action.{i}": value for i, value in enumerate(numpy.ravel(action))},
            **self.picture.records(state),
        }
        self.observations.append(observation)
        self.append(values)

    def append(self, values: Mapping[str, float]) -> None:
        """Append the values of a measurement, by series name, to the picture's history."""
        for name, value in values.items():
            self.history.setdefault(name, []).append(float(value))
        self.count += 1

    # --- drawing

    def frame(self, state: Any) -> numpy.ndarray:
        """Return the picture of the episode as an image, ``(height, width, 3)`` bytes."""
        figure = self._draw(state)
        canvas = figure.canvas
        assert isinstance(canvas, FigureCanvasAgg)
        moving = [_moving(axes) for axes in figure.axes]
        # Frames, ticks and letters take nine tenths of the time, so they are drawn again only when they change.
        limits = [tuple(axes.viewLim.extents) for axes in figure.axes]
        if limits != self._limits:
            for artist in [self._title, *(artist for artists in moving for artist in artists)]:
                artist.set_animated(True)
            canvas.draw()
            self._ground, self._limits = canvas.copy_from_bbox(figure.bbox), limits
        canvas.restore_region(self._ground)
        for axes, artists in zip(figure.axes, moving, strict=True):
            for artist in artists:
                axes.draw_artist(artist)
        figure.draw_artist(self._title)
        return numpy.asarray(canvas.buffer_rgba())[:, :, :3].copy()

    def show(self, state: Any) -> None:
        """Draw the picture into its window, at most ``frames_per_second`` times a second; do nothing without one."""
        if self._unseen:
            return
        from matplotlib import pyplot

        opened = self._figure is not None
        try:
            figure = self._draw(state)
        except _WindowError as error:
            self._go_on_unseen(str(error))
            return
        if not opened:
            figure.show()
        elif not pyplot.fignum_exists(figure.number):
            return  # the user has closed the window: the episode continues without it
        figure.canvas.draw_idle()
        due = self._last_shown + 1.0 / self.frames_per_second
        # The event loop draws, so it must run even when no time is left to wait.
        figure.canvas.start_event_loop(max(due - time.monotonic(), 0.001))
        self._last_shown = time.monotonic()

    def _go_on_unseen(self, problem: str) -> None:
        gymnasium.logger.warn(f"render_mode 'human' shows nothing: {problem}, or use render_mode='rgb_array'")
        self._unseen = True

    def close(self) -> None:
        """Close the window and delete the figure."""
        if self._figure is not None and self.mode == "human":
            from matplotlib import pyplot

            pyplot.close(self._figure)
        vars(self).update(_NO_FIGURE)

    def _draw(self, state: Any) -> Figure:
        figure = self._figure if self._figure is not None else self._open()
        if self._fresh:
            self._arrange()
        history = {name: numpy.asarray(values) for name, values in self.history.items()}
        for panel in self._panels:
            panel.draw(history, self.count)
        if self._observation is not None:
            self._observation.draw(self.observations)
        self.picture.draw(history, state)
        self._title.set_text(self.title)
        return figure

    @property
    def title(self) -> str:
        """Title of the picture: environment, scenario, control, number of the last measurement acted on."""
        name = self.model.task.id.rpartition("/")[2]
        control = [f"control {self.model.control}"] if self.picture.steered else []
        parts = [name, f"scenario {self.scenario}", *control]
        if self.caption:
            parts.append(self.caption)
        return " · ".join([*parts, f"{self.picture.clock} {self.count} of {self.model.task.horizon}"])

    def _open(self) -> Figure:
        if self.mode == "human":
            figure = _window(f"filtergym: {self.model.task.id}")
        else:
            figure = Figure(figsize=FIGURE_SIZE, dpi=DOTS_PER_INCH)
            FigureCanvasAgg(figure)
        self._figure = figure
        self._title = figure.text(0.5, 0.975, "", ha="center", va="top", fontsize=12)
        before = set(vars(self.picture))
        self.picture.open(figure)
        self._artists |= set(vars(self.picture)) - before
        strips = self.picture.strips()
        with_observation = self.picture.shows_observation()
        cells = len(strips) + with_observation
        columns = self.picture.strip_columns or -(-cells // 4)
        rows = -(-cells // columns)
        grid = figure.add_gridspec(
            rows, columns, left=self.picture.strips_left, right=0.985, bottom=0.075, top=0.9,
            hspace=0.09 * rows, wspace=0.2,
        )  # fmt: skip
        # Column by column, so that related strips are above each other.
        axes = [figure.add_subplot(grid[i % rows, i // rows]) for i in range(cells)]
        for i, one in enumerate(axes):
            one.tick_params(labelsize=8)
            bottom = i % rows == rows - 1 or i == cells - 1
            one.tick_params(labelbottom=bottom)
            if bottom:
                one.set_xlabel(self.picture.clock, fontsize=9)
        self._panels = [_StripPanel(one, strip) for one, strip in zip(axes, strips, strict=False)]
        self._observation = None
        if with_observation:
            self._observation = _ObservationPanel(axes[-1], len(self.model.fields), self.model.task.horizon)
        self._shades: list[Any] = []
        return figure

    def _arrange(self) -> None:
        self._fresh = False
        for shade in self._shades:
            shade.remove()
        self._shades = []
        for panel in self._panels:
            panel.axes.set_xlim(0.5, self.model.task.horizon + 0.5)
            panel.axes.set_ylim(*panel.strip.limits)
            for first, last in self.picture.shading():
                self._shades.append(panel.axes.axvspan(first, last, color=PALE, linewidth=0.0, zorder=0))
        self.picture.arrange()


class EpisodePictures:
    """Pictures of the first few of many parallel episodes.

    Args:
        model: of the episodes, on any backend.
        frames_per_second: frame rate of a video.
    """

    def __init__(self, model: Model, scenario: str, count: int, frames_per_second: float) -> None:
        self.count = count
        if model.backend == "torch":
            model = model.on_numpy()
        self.pictures: list[EpisodePicture] = [
            EpisodePicture(model, scenario, "rgb_array", frames_per_second)
            for _ in range(min(count, MAX_PICTURES))
        ]
        for i, picture in enumerate(self.pictures):
            picture.caption = f"sub-environment {i}"

    def begin(self, state: Any, lanes: Sequence[int]) -> None:
        """Start new episodes in some lanes (parallel episodes) of the pictures, after their first measurement."""
        for i, picture in enumerate(self.pictures):
            if i in lanes:
                picture.begin(_single_lane(state, i))

    def keep(self, state: Any, actions: numpy.ndarray, observations: numpy.ndarray) -> None:
        """Append a measurement, actions and the observations before them to the histories of the pictures.

        ``state`` is that of all episodes after the actions; ``observations``, ``(count, fields)``, are before them.
        """
        for i, picture in enumerate(self.pictures):
            picture.keep(_single_lane(state, i), actions[i], observations[i].copy())

    def frames(self, state: Any) -> tuple[numpy.ndarray, ...]:
        """Return an image for each episode, ``(height, width, 3)``, the same blank one beyond the first few."""
        drawn = [picture.frame(_single_lane(state, i)) for i, picture in enumerate(self.pictures)]
        return (*drawn, *[numpy.full_like(drawn[0], 255)] * (self.count - len(drawn)))

    def close(self) -> None:
        """Close the figures of all pictures."""
        for picture in self.pictures:
            picture.close()


def _single_lane(state: Any, lane: int) -> Any:
    """Return the episode of one lane (parallel episode) on the CPU, padded with copies, for a picture."""
    return map_arrays(lambda values: host_array(values)[..., [lane] * round_up_lanes(1)], state)


def _moving(axes: Axes) -> list[Artist]:
    return sorted(
        [*axes.images, *axes.collections, *axes.patches, *axes.lines], key=lambda artist: artist.get_zorder()
    )


class _WindowError(Exception):
    """Error for a window that cannot be opened; its message contains the reason and the remedy."""


def _missing_display() -> str:
    """Return why matplotlib cannot open a window, and the remedy; empty if no reason is known."""
    from matplotlib.backends.registry import BackendFilter, backend_registry

    try:
        # Without a display pyplot falls back to "agg" when imported, or refuses, regardless of MPLBACKEND.
        from matplotlib import pyplot

        backend = str(pyplot.get_backend())
    except ImportError as error:
        backend = f"unusable: {error}"
    windowed = [name.lower() for name in backend_registry.list_builtin(BackendFilter.INTERACTIVE)]
    if backend.lower() in windowed or "ipympl" in backend:
        return ""
    return (
        "it needs a display and a matplotlib backend that opens windows, but the "
        f"backend here is {backend!r}; install PyQt6 or tkinter, check DISPLAY and MPLBACKEND"
    )


def _window(title: str) -> Figure:
    from matplotlib import pyplot

    try:
        figure = pyplot.figure(figsize=FIGURE_SIZE, dpi=DOTS_PER_INCH)
    except Exception as error:  # each toolkit has exceptions of its own for a missing display
        raise _WindowError(
            f"the backend {matplotlib.get_backend()!r} cannot open a window ({error}); check DISPLAY and MPLBACKEND"
        ) from error
    if figure.canvas.manager is not None:
        figure.canvas.manager.set_window_title(title)
    return figure
