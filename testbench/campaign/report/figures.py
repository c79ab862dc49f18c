"""Figures of a report, as SVG that stands inside an HTML page: no address, no script, no name that a second one has.

Sizes are such that the text can be read on a phone, where a figure is about 8 cm wide. Colours are those of Okabe and
Ito, which do not depend on telling red from green. Drawn without pyplot; the same rows give the same bytes.
"""

import io
import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from testbench.campaign.report.markup import Html, tag

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_BLUE: Final = "#0072B2"
_ORANGE: Final = "#D55E00"
_GREEN: Final = "#009E73"
_BLACK: Final = "#222222"
_SIZE: Final = (4.7, 4.3)
"""Width and height of a figure over an axis [in]."""
_CELLS: Final = (400, 300)
"""Of the dots that fall into one cell of this grid over the figure, the lowest and the highest are drawn."""
_MOST_DOTS: Final = 4000
_TALL: Final = 4.0
"""A figure ends at so many times the largest mean, when single runs lie above that; how many do is written on it."""


@dataclass(frozen=True, slots=True)
class Column:
    """What is drawn at one x: the mean with its interval, the median, the quartiles. Without runs there is none."""

    x: float
    mean: float
    low: float
    high: float
    median: float
    quartiles: tuple[float, float]


@dataclass(frozen=True, slots=True)
class Curve:
    """Points on a fitted curve."""

    xs: Sequence[float]
    ys: Sequence[float]


@dataclass(frozen=True, slots=True)
class Share:
    """A share of runs at one x (0..1) with its interval."""

    x: float
    share: float
    low: float
    high: float


Marks = Sequence[tuple[float, float]]
"""(x, y) of numbers that others have published."""


def metric_figure(
    dots: Marks, columns: Sequence[Column], curve: Curve | None, paper: Marks, labels: tuple[str, str]
) -> "Figure":
    """Every run a dot, and what is said about them. labels: of x and y. Imports matplotlib."""
    figure, axes = _sheet(labels)
    xs = [column.x for column in columns]
    top = _top(dots, columns, paper)
    shown = decimated([dot for dot in dots if dot[1] <= top], _CELLS)
    axes.plot(*_split(shown), "o", ms=3.4, mew=0, color=_BLUE, alpha=0.4, label="single runs", zorder=2)
    lows, highs = [column.quartiles[0] for column in columns], [column.quartiles[1] for column in columns]
    axes.fill_between(xs, lows, highs, color=_BLUE, alpha=0.15, lw=0, label="middle half of the runs", zorder=1)
    axes.plot(xs, [column.median for column in columns], color=_BLUE, lw=1.6, label="median", zorder=3)
    spread = [[c.mean - c.low for c in columns], [c.high - c.mean for c in columns]]
    axes.errorbar(
        xs,
        [column.mean for column in columns],
        yerr=spread,
        fmt="o",
        ms=4.5,
        color=_BLACK,
        lw=1.2,
        capsize=2.5,
        label="mean, and its interval",
        zorder=4,
    )
    if curve is not None:
        axes.plot(curve.xs, curve.ys, color=_ORANGE, lw=1.6, ls=(0, (5, 2)), label="quadratic fit", zorder=3.5)
    _paper(axes, paper)
    axes.set_ylim(min(0.0, min((dot[1] for dot in dots), default=0.0)), top)
    above = [dot[1] for dot in dots if dot[1] > top]
    if above:
        text = f"{len(above)} run{'s' if len(above) > 1 else ''} above, up to {max(above):.3g}"
        axes.text(0.01, 1.02, text, transform=axes.transAxes, fontsize=9, parse_math=False)
    _legend(figure, axes)
    return figure


def share_figure(shares: Sequence[Share], paper: Marks, labels: tuple[str, str]) -> "Figure":
    """A share of the runs over x, with its interval. labels: of x and y. Imports matplotlib."""
    figure, axes = _sheet(labels)
    spread = [
        [100 * max(0.0, found) for found in ends]
        for ends in zip(*((one.share - one.low, one.high - one.share) for one in shares), strict=True)
    ]
    axes.errorbar(
        [one.x for one in shares],
        [100 * one.share for one in shares],
        yerr=spread,
        fmt="o-",
        ms=4.5,
        color=_BLUE,
        lw=1.3,
        capsize=2.5,
        label="share of the runs",
    )
    _paper(axes, [(x, 100 * y) for x, y in paper])
    axes.set_ylim(-3, 103)
    _legend(figure, axes)
    return figure


def map_figure(
    values: Sequence[Sequence[float | None]],
    texts: Sequence[Sequence[str]],
    names: tuple[Sequence[str], Sequence[str]],
    labels: tuple[str, str, str],
) -> "Figure":
    """Cells coloured by value, their text in them. values: a row for each of names[1]; labels: of x, y and the colour.

    Imports matplotlib.
    """
    from matplotlib.figure import Figure

    columns, rows = len(names[0]), len(names[1])
    figure = Figure(figsize=(max(5.4, 0.34 * columns + 1.8), max(2.4, 0.42 * rows + 1.5)), layout="constrained")
    axes = figure.subplots()
    numbers = [[math.nan if value is None else value for value in row] for row in values]
    image = axes.pcolormesh(numbers, cmap="cividis", edgecolors="white", linewidth=0.6)
    low, high = image.get_clim()
    for y, row in enumerate(texts):
        for x, text in enumerate(row):
            value = numbers[y][x]
            dark = not math.isnan(value) and value < (low + high) / 2
            colour = "white" if dark else "black"
            size = 8 if columns > 12 else 9
            axes.text(x + 0.5, y + 0.5, text, ha="center", va="center", fontsize=size, color=colour, parse_math=False)
    axes.set_xticks([k + 0.5 for k in range(columns)], names[0], rotation=90 if columns > 8 else 0, parse_math=False)
    axes.set_yticks([k + 0.5 for k in range(rows)], names[1], parse_math=False)
    axes.set_xlabel(labels[0], parse_math=False)
    axes.set_ylabel(labels[1], parse_math=False)
    figure.colorbar(image, label=labels[2])
    return figure


def decimated(dots: Marks, cells: tuple[int, int]) -> list[tuple[float, float]]:
    """The lowest and the highest dot of every cell of a grid over all of them, in fewer cells until they are few.

    So the extremes at every x stay where they are.
    """
    xs, ys = _split(dots)
    left, width = min(xs, default=0.0), (max(xs, default=0.0) - min(xs, default=0.0)) or 1.0
    bottom, height = min(ys, default=0.0), (max(ys, default=0.0) - min(ys, default=0.0)) or 1.0
    while True:
        kept: dict[tuple[int, int], tuple[tuple[float, float], tuple[float, float]]] = {}
        for dot in dots:
            cell = int((dot[0] - left) / width * cells[0]), int((dot[1] - bottom) / height * cells[1])
            low, high = kept.get(cell, (dot, dot))
            kept[cell] = min(low, dot, key=_height), max(high, dot, key=_height)
        found = sorted({dot for pair in kept.values() for dot in pair})
        if len(found) <= _MOST_DOTS or cells == (1, 1):
            return found
        cells = max(1, cells[0] // 2), max(1, cells[1] // 2)


def inline_svg(figure: "Figure", number: int, title: str, description: str) -> Html:
    """The figure as an element of a page. number: of the figure on the page, part of every id in it."""
    import matplotlib

    buffer = io.StringIO()
    with matplotlib.rc_context({"svg.fonttype": "none", "svg.hashsalt": f"figure {number}"}):
        figure.savefig(buffer, format="svg", metadata=dict.fromkeys(("Creator", "Date", "Format", "Type")))
    text = buffer.getvalue()
    text = text[text.index("<svg") :]
    view = re.search(r'viewBox="([^"]+)"', text)
    if view is None:
        raise ValueError(
            f"figure {number}: matplotlib wrote no viewBox; is a newer version in use than the pinned one?"
        )
    body = text[text.index(">") + 1 : text.rindex("</svg>")]
    body = re.sub(r"<metadata>.*?</metadata>\s*", "", body, flags=re.DOTALL)
    body = re.sub(r"<!--.*?-->\s*", "", body, flags=re.DOTALL)
    body = re.sub(r"<defs>\s*<style.*?</style>\s*</defs>", "", body, flags=re.DOTALL)  # it would act on the whole page
    referenced = set(re.findall(r'(?:href="#|url\(#)([^")]+)', body))
    body = re.sub(r' id="([^"]+)"', lambda found: f' id="f{number}-{found[1]}"' if found[1] in referenced else "", body)
    body = re.sub(r'(href="#|url\(#)', rf"\g<1>f{number}-", body)
    body = re.sub(r"\s*\n\s*", "\n", body)
    heads = (tag("title", title, id=f"f{number}-title"), tag("desc", description, id=f"f{number}-desc"))
    return tag(
        "svg",
        *heads,
        Html(body),
        viewBox=view[1],
        role="img",
        aria_labelledby=f"f{number}-title",
        aria_describedby=f"f{number}-desc",
    )


def _sheet(labels: tuple[str, str]) -> tuple["Figure", "Axes"]:
    from matplotlib.figure import Figure

    figure = Figure(figsize=_SIZE, layout="constrained")
    axes = figure.subplots()
    axes.set_xlabel(labels[0], parse_math=False)
    axes.set_ylabel(labels[1], parse_math=False)
    axes.grid(color="#dddddd", lw=0.6)
    axes.set_axisbelow(True)
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)
    return figure, axes


def _paper(axes: "Axes", paper: Marks) -> None:
    if not paper:
        return
    axes.plot(*_split(paper), "*", ms=12, mec=_BLACK, mew=0.7, color=_GREEN, label="the paper", zorder=5)
    for x, y in paper:
        axes.annotate(f"{y:g}", (x, y), (0, 8), textcoords="offset points", ha="center", fontsize=9, zorder=6)


def _top(dots: Marks, columns: Sequence[Column], paper: Marks) -> float:
    """Where a figure ends: above everything, unless single runs lie far above all means."""
    highest = max((dot[1] for dot in dots), default=0.0)
    needed = max([max(column.high, column.quartiles[1]) for column in columns] + [y for _, y in paper], default=0.0)
    ceiling = max([_TALL * column.mean for column in columns], default=highest)
    return 1.07 * max(needed, min(highest, ceiling)) or 1.0


def _legend(figure: "Figure", axes: "Axes") -> None:
    handles, _ = axes.get_legend_handles_labels()
    figure.legend(handles=handles, loc="outside lower center", ncols=min(2, len(handles)), frameon=False, fontsize=9)


def _split(dots: Marks) -> tuple[list[float], list[float]]:
    return [x for x, _ in dots], [y for _, y in dots]


def _height(dot: tuple[float, float]) -> float:
    return dot[1]
