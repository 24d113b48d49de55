"""Figures of an evaluation: distinguished competitors, looks of kinds, contents of files, and labels of axes."""

import itertools
import re

import numpy as np
import pytest
import xarray
from front import draw_fronts, panels_of
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import to_hex
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from pictures import draw_learning_curves
from records import read_benchmark, recorded_environments

from filtergym import evaluate
from filtergym.evaluation.figures.curve_figures import (
    draw_error_over_time,
    draw_mode_probabilities,
    evaluation_figures,
    varying_modes,
)
from filtergym.evaluation.figures.front_figure import FrontPanel, name_points
from filtergym.evaluation.figures.looks import (
    COLOURS,
    MOST_HIGHLIGHTED,
    OWN,
    by_cost,
    choose_highlights,
    group_equal_lines,
    join_names,
    looks,
)
from filtergym.evaluation.figures.print_layout import WIDTHS, logarithmic, save, sensible_limits
from filtergym.evaluation.running.curves import curves_of
from filtergym.evaluation.running.times import Point, ProcessorTime

ENV, UAV = "filtergym/ManeuveringTarget-v0", "filtergym/UavAutopilot-v0"
NAMES = [
    "fixed-low",
    "adaptive",
    "imm",
    "zero",  # the IMM by another control: the same line
    "known-turn",
    "known-input-bound",
    "kalman-imm",
    "fixed-high",
    "adaptive-rearm",
    "bptt",
]


@pytest.fixture(scope="module")
def curves() -> xarray.Dataset:
    return curves_of(evaluate(ENV, NAMES, "paper", 12, horizon=80))


def lines(axis):
    """Lines drawn in data coordinates, by label; grey ones have none."""
    return [
        line for line in axis.lines if line.get_transform() == axis.transData and len(line.get_xdata()) > 2
    ]


def named(axis):
    return {line.get_label(): line for line in lines(axis) if not line.get_label().startswith("_")}


def texts(figure):
    return [text.get_text() for axis in figure.axes for text in axis.texts]


def test_six_lines_are_distinguished_the_most_important_first(curves):
    chosen = choose_highlights(curves, learned=["bptt"])
    assert len(chosen) == MOST_HIGHLIGHTED
    assert chosen[:4] == ["imm", "known-turn", "known-input-bound", "bptt"]
    ranked = by_cost(curves)
    classical = [name for name in ranked if name not in ("imm", "zero", "bptt")]
    assert chosen[4] == classical[0]
    assert "zero" not in chosen  # it is the IMM's line
    cost = curves["mean_cost"].sel(policy=ranked).values
    assert (np.diff(cost) >= 0.0).all()
    assert "known-turn" not in ranked
    figure = draw_error_over_time(curves, looks(curves, learned=["bptt"]))
    for axis in figure.axes[:2]:
        labels = named(axis)
        assert len(labels) == MOST_HIGHLIGHTED
        grey = [line for line in lines(axis) if to_hex(line.get_color()) == to_hex("0.72")]
        # Every line once, and fewer than there are policies, since two are the same; all but six grey, without a name.
        different = len(np.unique(curves["rmse"].values.reshape(len(NAMES), -1).round(6), axis=0))
        assert MOST_HIGHLIGHTED < different < len(NAMES)
        assert len(lines(axis)) == different
        assert len(grey) == different - MOST_HIGHLIGHTED
        assert all(line.get_label().startswith("_") for line in grey)
    assert "grey: others" in figure.get_suptitle()


def test_lines_that_are_the_same_share_a_name_and_are_drawn_once(curves):
    figure = draw_error_over_time(curves)
    assert "imm = zero" in named(figure.axes[0])
    assert "imm = zero" in texts(figure)
    assert join_names(["a", "b", "c", "d"]) == "a = b = 2 more"
    nan = np.full(3, np.nan)
    values = {"a": np.ones(3), "b": np.ones(3) * 1.001, "c": np.ones(3), "d": nan, "e": nan}
    assert group_equal_lines("abcde", values) == {"a": ["a", "c"], "b": ["b"], "d": ["d"], "e": ["e"]}


def test_kinds_always_look_the_same(curves):
    dashes = {"imm": "-", "kalman-imm": "-", "bptt": "-", "known-turn": "--", "known-input-bound": ":"}
    look = looks(curves, list(dashes), ["bptt"])
    assert {name: style["linestyle"] for name, style in look.items()} == dashes
    colours = [style["color"] for style in look.values()]
    assert len({*zip(colours, dashes.values(), strict=True)}) == len(dashes)
    assert look["imm"]["color"] == COLOURS[0]
    assert look["bptt"]["linewidth"] > look["imm"]["linewidth"]
    # With any other competitors, the paper's algorithm, references and bounds keep their looks.
    for other in (["adaptive", "known-turn", "imm"], ["known-input-bound", "imm", "adaptive-rearm"]):
        assert all(
            looks(curves, other)[name][key] == look[name][key]
            for name in set(other) & set(look)
            for key in ("color", "linestyle")
        )
    drawn = {
        label.partition(" = ")[0]: line.get_linestyle()
        for label, line in named(draw_error_over_time(curves, look).axes[0]).items()
    }
    assert drawn == dashes


def test_what_a_user_brings_has_a_colour_and_the_first_place(curves):
    look = looks(curves, learned=["bptt"], own=["adaptive"])
    assert next(iter(look)) == "adaptive"
    assert [name for name, style in look.items() if style["color"] == OWN] == ["adaptive"]
    assert look["adaptive"]["linewidth"] > look["imm"]["linewidth"]
    points = [Point(name, "policy", ProcessorTime(100.0 + i, True), 5.0 * i) for i, name in enumerate(NAMES)]
    figures = dict(evaluation_figures(curves, own=["adaptive"], points=points))
    drawn = [text for text in figures["cost_and_time"].axes[0].texts if text.get_text() == "adaptive"]
    assert [text.get_color() for text in drawn] == [OWN]
    assert "cost_and_time" not in dict(evaluation_figures(curves))


def test_distinguished_competitors_may_be_chosen(curves):
    assert choose_highlights(curves, ["adaptive", "imm"]) == ["adaptive", "imm"]
    with pytest.raises(ValueError, match="cannot highlight 'mine': there are fixed-low"):
        choose_highlights(curves, ["mine"])
    with pytest.raises(ValueError, match="at most 6 lines can be highlighted, got 7"):
        choose_highlights(curves, NAMES[:7])


def test_figures_are_as_wide_as_columns_and_legible(curves):
    assert draw_error_over_time(curves).get_figwidth() == WIDTHS[2]
    narrow = dict(evaluation_figures(curves, 1))
    assert list(narrow) == [
        "rmse_over_time", "error_distribution", "cost_difference", "consistency", "mode_probabilities",
    ]  # fmt: skip
    for figure in narrow.values():
        assert figure.get_figwidth() == WIDTHS[1]
        figure.draw_without_rendering()
        box = figure.get_tightbbox().padded(-0.05)
        assert box.x0 >= -0.01
        assert box.x1 <= WIDTHS[1] + 0.01
        for axis in figure.axes:
            labels = [axis.xaxis.label, axis.yaxis.label, *axis.get_xticklabels()]
            assert min(label.get_fontsize() for label in labels) >= 6.0
    with pytest.raises(ValueError, match="1 or 2 columns wide, got 3"):
        dict(evaluation_figures(curves, 3))


def test_seconds_below_and_measurements_above(curves):
    figure = draw_error_over_time(curves)
    assert figure.axes[1].get_xlabel() == "time, s"
    line = next(iter(named(figure.axes[0]).values()))
    np.testing.assert_allclose(line.get_xdata(), 6.0 * np.arange(1, 81))
    # Numbers stand below the lowest panel alone.
    shown = [any(label.get_visible() for label in axis.get_xticklabels()) for axis in figure.axes]
    assert shown == [False, True]
    above = figure.axes[0].child_axes[0]
    assert above.get_xlabel() == "measurement"
    figure.draw_without_rendering()
    assert np.ptp(above.get_xlim()) == pytest.approx(np.ptp(figure.axes[0].get_xlim()) / 6.0)
    figure = draw_error_over_time(curves.drop_vars("elapsed"))
    assert figure.axes[1].get_xlabel() == "measurement"
    assert not figure.axes[0].child_axes
    np.testing.assert_array_equal(next(iter(named(figure.axes[0]).values())).get_xdata(), np.arange(1, 81))


def test_labels_stand_at_the_ends_of_lines_and_never_on_each_other(curves):
    figure = draw_error_over_time(curves)
    figure.draw_without_rendering()
    renderer = figure.canvas.get_renderer()
    for axis in figure.axes[:2]:
        distinguished = named(axis)
        boxes = {
            t.get_text(): t.get_window_extent(renderer) for t in axis.texts if t.get_text() in distinguished
        }
        assert set(boxes) == set(distinguished)
        ordered = sorted(boxes.values(), key=lambda box: box.y0)
        assert all(low.y1 <= high.y0 + 0.5 for low, high in itertools.pairwise(ordered))
        for text in axis.texts:
            if text.get_text() in distinguished:
                assert text.get_color() == distinguished[text.get_text()].get_color()
    # Long names leave too little of a narrow figure: a legend then, and nothing beside the lines.
    long = curves.assign_coords(policy=[f"{name}-with-very-much-to-tell" for name in curves["policy"].values])
    figure = draw_error_over_time(long, columns=1)
    assert not [t for t in texts(figure) if "tell" in t]
    labels = [text.get_text() for text in figure.legends[0].get_texts()]
    assert labels[-1] == "others"
    assert labels.count("others") == 1
    assert len(labels) == MOST_HIGHLIGHTED + 1


def test_many_modes_are_named_in_a_legend(curves):
    modes = [f"m{i}" for i in range(9)]
    several = curves.sel(policy=["imm"]).isel(mode=[0, 1] * 4 + [0]).assign_coords(mode=modes)
    figure = draw_mode_probabilities(several)
    assert not set(modes) & set(texts(figure))
    assert [text.get_text() for text in figure.legends[0].get_texts()] == modes
    figure = draw_mode_probabilities(curves)
    assert {"mode 1", "mode 2"} <= set(texts(figure))
    assert not figure.legends


def test_a_logarithmic_axis_of_less_than_half_a_decade_has_a_few_round_numbers():
    axis = Figure().add_subplot(yscale="log")
    axis.set_ylim(1.0, 3.0)
    logarithmic(axis.yaxis)
    assert axis.yaxis.get_majorticklocs().tolist() == [1.0, 1.5, 2.0, 2.5, 3.0]
    assert axis.yaxis.get_minorticklocs().size == 0


def test_one_line_cannot_squash_the_others(curves):
    good = [np.full(50, value) for value in (1.0, 2.0, 3.0)]
    low, high = sensible_limits([*good, np.full(50, 1e6)])
    assert low < 1.0
    assert 3.0 < high < 30.0
    assert sensible_limits([*good, np.full(50, 1e6)], [np.full(50, 1e6)])[1] > 1e6
    assert sensible_limits([np.full(5, np.nan)]) == (0.1, 10.0)
    assert 0.1 < sensible_limits(good, bounds=[np.full(50, 1e-6)])[0] < 1.0 / 6.0
    assert 0.4 < sensible_limits(good, bounds=[np.full(50, 0.5)])[0] < 0.5
    wild = curves.copy(deep=True)
    wild["rmse"].loc[{"policy": "kalman-imm"}] = 1e9
    for band in ("rmse_low", "rmse_high"):
        wild[band].loc[{"policy": "adaptive"}] = {"rmse_low": 1e-9, "rmse_high": 1e9}[band]
    look = looks(curves, ["imm", "adaptive", "kalman-imm", "known-turn"])
    figure = draw_error_over_time(wild, look)
    assert figure.axes[0].get_ylim()[1] < 1e4
    assert "none where they fill the axis" in figure.get_suptitle().replace("\n", " ")
    assert len(figure.axes[0].collections) < len(draw_error_over_time(curves, look).axes[0].collections)


def test_modes_that_do_not_vary_are_not_drawn(curves):
    still = curves.sel(policy=["imm"]).copy(deep=True)
    assert "imm" in varying_modes(still, ["imm"])
    still["mode_probability"][:] = np.where(np.isnan(still["mode_probability"]), np.nan, 0.5)
    assert not varying_modes(still, ["imm"])


def test_svg_holds_text_and_pdf_its_fonts(curves, tmp_path):
    few = curves.sel(policy=["imm", "zero", "known-turn"])
    for name in ("a", "b"):
        figure = draw_error_over_time(few)
        for suffix in ("svg", "pdf"):
            save(figure, tmp_path / f"{name}.{suffix}")
    text = (tmp_path / "a.svg").read_text()
    assert re.search(r"<text[^>]*font-family: [^>]*sans-serif[^>]*>known-turn</text>", text)
    assert "imm = zero</text>" in text
    pdf = (tmp_path / "a.pdf").read_bytes()
    assert b"/FontFile2" in pdf
    assert b"/Type3" not in pdf.replace(b" ", b"")
    for suffix in ("svg", "pdf"):
        assert (tmp_path / f"a.{suffix}").read_bytes() == (tmp_path / f"b.{suffix}").read_bytes()
    with pytest.raises(ValueError, match="written as png, svg or pdf, got 'gif'"):
        save(figure, tmp_path / "a.gif")
    assert not (tmp_path / "a.gif").exists()


def test_learning_curves_are_median_and_range_over_runs():
    steps = [100_000, 200_000, 400_000]
    runs = [(steps, [0.5, 0.0, -0.3]), (steps, [0.1, -0.2, -0.4]), (steps, [0.3, -0.5, -0.1])]
    # A run that went on longer, and was validated elsewhere, counts as far as all go.
    longer = [(steps, [0.0, 0.0, 0.0]), ([100_000, 300_000, 500_000], [0.2, 0.4, 0.6])]
    [axis] = draw_learning_curves({"ppo": runs, "bptt": longer}, "title", "imm").axes
    first, second = named(axis).values()
    assert (first.get_label(), second.get_label()) == ("ppo, 3 runs", "bptt, 2 runs")
    np.testing.assert_allclose(first.get_xdata(), [0.1, 0.2, 0.4])
    np.testing.assert_allclose(first.get_ydata(), [30.0, -20.0, -30.0])
    np.testing.assert_allclose(second.get_xdata(), [0.1, 0.2, 0.3, 0.4])
    np.testing.assert_allclose(second.get_ydata(), [10.0, 15.0, 20.0, 25.0])
    bands = [collection.get_paths()[0].vertices for collection in axis.collections]
    for step, low, high in ((0.1, 10.0, 50.0), (0.2, -50.0, 0.0), (0.4, -40.0, -10.0)):
        ends = bands[0][np.isclose(bands[0][:, 0], step), 1]
        assert (ends.min(), ends.max()) == pytest.approx((low, high))
    assert "millions" in axis.get_xlabel()
    assert "%" in axis.get_ylabel()


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize(
    ("env", "names", "length"),
    [(ENV, ["imm", "known-input-bound"], 1), (UAV, ["true-state"], 3)],
)
def test_little_to_draw_is_drawn(env, names, length):
    """One measurement of one episode, and errors of zero, which a logarithmic axis does not have."""
    found = curves_of(evaluate(env, names, episodes=1, horizon=length))
    figures = dict(evaluation_figures(found, 1))
    assert "rmse_over_time" in figures
    assert "1 episode" in figures["rmse_over_time"].get_suptitle()
    assert "1 episodes" not in figures["rmse_over_time"].get_suptitle()
    for figure in figures.values():
        figure.draw_without_rendering()
        for axis in figure.axes:
            assert np.isfinite([*axis.get_xlim(), *axis.get_ylim()]).all()


def test_names_leave_the_line_of_the_papers_cost_free():
    figure = Figure(figsize=(3.4, 2.4), layout="constrained")
    FigureCanvasAgg(figure)
    axis = figure.add_subplot(xscale="log", xlim=(10.0, 1e4), ylim=(-10.0, 30.0))
    costs = {33.0: 2.4, 878.0: 1.8}  # a name beneath either would lie on the line
    points = [
        Point(f"of {time:.0f} ns", "estimator", ProcessorTime(time, True), cost)
        for time, cost in costs.items()
    ]
    name_points(figure, {axis: FrontPanel("", points, "", "", ())})
    assert len(axis.texts) == 2
    # It would move the axes under the names.
    assert not isinstance(figure.get_layout_engine(), ConstrainedLayoutEngine)
    _, zero = axis.transData.transform((10.0, 0.0))
    for name in axis.texts:
        box = name.get_window_extent(figure.canvas.get_renderer())
        assert not box.y0 < zero < box.y1, name


def test_names_of_the_fronts_lie_on_no_other():
    """As the records have them, in the picture of README."""
    figure = draw_fronts(panels_of([read_benchmark(name)[0] for name in recorded_environments()[:1]]))
    for axis in figure.axes:
        names = [text for text in axis.texts if "beyond" not in text.get_text()]
        boxes = {name.get_text(): name.get_window_extent(figure.canvas.get_renderer()) for name in names}
        assert not [
            (one, other)
            for one, other in itertools.combinations(boxes, 2)
            if boxes[one].overlaps(boxes[other])
        ]
