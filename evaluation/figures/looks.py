"""Line styles of competitors in figures, choice of the coloured lines, and detection of equal lines."""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy
import xarray

from ..competitors.kinds import RANKED

LINES = ("-", "--", "-.", ":")
# Okabe and Ito's palette: distinguishable for colour-blind readers.
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#56B4E9", "#E69F00", "#000000", "#999933")
LINES_OF_KINDS = {"policy": "-", "estimator": "-", "smoother": "-.", "reference": "--", "bound": ":"}
OWN = "#9B5DE5"
"""Colour of the user's competitor."""
GREY = "0.72"
"""Colour of lines that are not highlighted."""
MOST_HIGHLIGHTED = 6
"""Maximal number of lines that a reader can distinguish."""


def styles(names: list[str]) -> dict[str, dict[str, Any]]:
    """Return a colour and line style for each name, all different."""
    n = len(COLOURS)
    return {
        name: {"color": COLOURS[i % n], "linestyle": LINES[(i // n) % len(LINES)], "linewidth": 1.6}
        for i, name in enumerate(names)
    }


def by_cost(curves: xarray.Dataset) -> list[str]:
    """Return the names of the ranked competitors by mean cost, the lowest first.

    Without costs it is by the mean RMSE of the first quantity, without truth unchanged.
    """
    names = curves["policy"].values[numpy.isin(curves["kind"].values.astype(str), RANKED)].tolist()
    if "mean_cost" in curves:
        worth = curves["mean_cost"]
    elif "rmse" in curves:
        worth = curves["rmse"].isel(quantity=0).mean("time")
    else:
        return [str(name) for name in names]
    each = {name: float(worth.sel(policy=name)) for name in names}
    return sorted(names, key=lambda name: (numpy.isnan(each[name]), each[name]))


def choose_highlights(
    curves: xarray.Dataset,
    highlight: Sequence[str] | None = None,
    learned: Sequence[str] = (),
    own: Sequence[str] = (),
) -> list[str]:
    """Return the names of the lines to highlight, the most important first.

    Args:
        curves: curves of an evaluation.
        highlight: names to highlight; default: the user's own, the paper's algorithm, the reference, the bound, the
            best learned and the best classical competitor, and then by cost.
        learned: names of learned competitors.
        own: names of the user's competitors.

    Raises:
        ValueError: for unknown names, or too many.
    """
    present = curves["policy"].values.tolist()
    if highlight is not None:
        for name in highlight:
            if name not in present:
                raise ValueError(f"cannot highlight {name!r}: there are {', '.join(present)}")
        if len(set(highlight)) > MOST_HIGHLIGHTED:
            raise ValueError(
                f"at most {MOST_HIGHLIGHTED} lines can be highlighted, got {len(set(highlight))}"
            )
        return list(dict.fromkeys(highlight))
    ranked = by_cost(curves)
    kinds = dict(zip(present, curves["kind"].values.astype(str).tolist(), strict=True))
    classical = [name for name in ranked if name not in learned and name != curves.attrs["paper"]]
    wanted = [
        *(name for name in (*own, curves.attrs["paper"], curves.attrs["reference"]) if name in present),
        *[name for name in present if kinds[name] == "bound"][:1],
        *[name for name in ranked if name in learned][:1],
        *classical[:1],
        *ranked,
        *present,
    ]
    chosen: list[str] = []
    for name in dict.fromkeys(wanted):
        same = "rmse" in curves and any(
            _same(curves["rmse"].sel(policy=name).values, curves["rmse"].sel(policy=other).values)
            for other in chosen
        )
        if not same:
            chosen.append(name)
    return chosen[:MOST_HIGHLIGHTED]


def _same(one: numpy.ndarray, other: numpy.ndarray) -> bool:
    """Return whether two lines agree within a relative 1e-6, with NaN in the same places; False if all are
    NaN.
    """
    missing = numpy.isnan(one).all() and numpy.isnan(other).all()
    return not missing and bool(numpy.allclose(one, other, rtol=1e-6, atol=0.0, equal_nan=True))


def looks(
    curves: xarray.Dataset,
    highlight: Sequence[str] | None = None,
    learned: Sequence[str] = (),
    own: Sequence[str] = (),
) -> dict[str, dict[str, Any]]:
    """Return colour, line style and width of each highlighted line by name, in the order of the legend.

    Args:
        curves: curves of an evaluation.
        highlight: names to highlight; default: :func:`choose_highlights`.
        learned: names of learned competitors; their lines are thicker.
        own: names of the user's competitors; their lines are thicker, and the first has its own colour.
    """
    chosen = choose_highlights(curves, highlight, learned, own)
    kinds = {name: str(curves["kind"].sel(policy=name).values) for name in chosen}
    colours = {name: COLOURS[6] for name in chosen if kinds[name] not in RANKED}
    if curves.attrs["paper"] in chosen:
        colours[curves.attrs["paper"]] = COLOURS[0]
    free = [colour for colour in COLOURS[1:6] if colour not in colours.values()]
    if mine := [name for name in own if name in chosen and name not in colours][:1]:
        colours[mine[0]] = OWN
        free.remove(COLOURS[3])  # which is too similar to it
    if curves.attrs["paper"] not in chosen:
        free.insert(0, COLOURS[0])
    rest = iter(free)
    for name in chosen:
        if name not in colours:
            colours[name] = next(rest)
    # A second smoother, reference or bound differs from the first by its grey.
    for kind in ("smoother", "reference", "bound"):
        for name, shade in zip(
            [n for n in chosen if kinds[n] == kind], ("#000000", "0.4", "0.6") * 2, strict=False
        ):
            colours[name] = shade
    return {
        name: {
            "color": colours[name],
            "linestyle": LINES_OF_KINDS.get(kinds[name], "-"),
            "linewidth": 1.6 if name in learned or name in own else 1.1,
            "zorder": 3.0 - 0.01 * i,
        }
        for i, name in enumerate(chosen)
    }


def group_equal_lines(names: Iterable[str], values: Mapping[str, numpy.ndarray]) -> dict[str, list[str]]:
    """Group names whose lines are equal, by the first name of each group."""
    found: dict[str, list[str]] = {}
    for name in names:
        twin = next((first for first in found if _same(values[first], values[name])), name)
        found.setdefault(twin, []).append(name)
    return found


def distinguish_lines(
    look: Iterable[str], values: Mapping[str, numpy.ndarray]
) -> tuple[dict[str, str], list[str]]:
    """Return a label for each group of equal lines that is highlighted, by its first name, and the other
    lines' names.
    """
    chosen = list(look)
    groups = group_equal_lines(
        [*(n for n in chosen if n in values), *(n for n in values if n not in chosen)], values
    )
    labels = {first: join_names(same) for first, same in groups.items() if first in chosen}
    return labels, [first for first in groups if first not in chosen]


def join_names(names: Sequence[str], most: int = 2) -> str:
    """Return a label for equal lines: ``imm = zero``, or for more than ``most`` of them ``imm = zero = 3 more``."""
    few = len(names) <= most
    return " = ".join(names if few else [*names[:most], f"{len(names) - most} more"])
