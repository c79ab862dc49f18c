"""The figures a campaign file asks for: which runs go into each, the figure, and the table of its numbers.

What is not the axis of a figure is held: each combination of the other axes gets a figure of its own, with the same
units beside the same paper's numbers; where there are too many, all are taken together, and the figure says so.
"""

import itertools
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from testbench.campaign.file.axes import Axis
from testbench.campaign.file.rules import Figure
from testbench.campaign.records import Point, RunRow
from testbench.campaign.report.figures import (
    Column,
    Curve,
    Share,
    inline_svg,
    metric_figure,
    share_figure,
)
from testbench.campaign.report.markup import Html, table, tag
from testbench.campaign.report.measured import (
    by_point,
    count,
    ended_early,
    is_share,
    number_at,
    quantity,
    stating,
    values_of,
)
from testbench.campaign.report.meta import Meta
from testbench.campaign.report.tables import Table, number
from testbench.campaign.statistics.fits import QuadraticFit, quadratic_fit
from testbench.campaign.statistics.samples import Summary, mean_interval, median_interval, summary
from testbench.campaign.statistics.shares import Interval, NotEstimableError, wilson
from testbench.campaign.words import interval_note

if TYPE_CHECKING:
    from matplotlib.figure import Figure as DrawnFigure

_MOST_PANELS: Final = 6
_CURVE_POINTS: Final = 60
_LEAST_FOR_FIT: Final = 4
"""Places on x; through three a parabola always goes."""
_APART: Final = 0.3
"""Of the least distance of two x: how far to either side dots stand."""
_NO_INTERVALS: Final = " Without intervals: runs with the same seeds are taken together, and depend on each other."
_GOLDEN_RATIO: Final = 0.618034
"""Its multiples, modulo 1, lie far apart."""


@dataclass(frozen=True, slots=True)
class Panel:
    """A figure wanted, for one combination of the other axes (`held`, in words), with its runs by rising x.

    motions: as in Meta. together: for all combinations instead; runs at one x then share seeds
    and depend on each other, so that there are no intervals.
    """

    wanted: Figure
    axis: Axis
    held: str
    together: bool
    motions: Mapping[Point, float]
    columns: tuple[tuple[float, tuple[RunRow, ...]], ...]

    @property
    def rows(self) -> list[RunRow]:
        """All runs of it."""
        return [row for _, rows in self.columns for row in rows]

    @property
    def x_label(self) -> str:
        """Name and unit of the axis."""
        return f"{self.axis.name} [{self.axis.unit}]" if self.axis.unit else self.axis.name


def panels(rows: Sequence[RunRow], meta: Meta) -> list[Panel]:
    """Every figure that is to be drawn, in the order of the file."""
    return [panel for wanted in meta.figures for panel in _panels(stating(rows), meta, wanted)]


def _panels(rows: Sequence[RunRow], meta: Meta, wanted: Figure) -> Iterator[Panel]:
    (axis,) = (axis for axis in meta.axes if axis.name == wanted.x)
    inside: dict[tuple[tuple[str, str], ...], dict[float, list[RunRow]]] = {}
    for point, found in by_point(rows, meta.points).items():
        x = number_at(point, axis)
        if x is not None and wanted.low <= x <= wanted.high:
            held = tuple(pair for pair in point.parameters if pair[0] != axis.name)
            inside.setdefault(held, {}).setdefault(x, []).extend(found)
    if len(inside) > _MOST_PANELS:
        pooled: dict[float, list[RunRow]] = {}
        for columns in inside.values():
            for x, found in columns.items():
                pooled.setdefault(x, []).extend(found)
        names = " and ".join(one.name for one in meta.axes if one is not axis)
        yield Panel(wanted, axis, f"all values of {names} together", True, meta.motions, _by_x(pooled))
        return
    for held, columns in inside.items():
        words = ", ".join(f"{name} {text}" for name, text in held)
        yield Panel(wanted, axis, words, False, meta.motions, _by_x(columns))


def _by_x(columns: dict[float, list[RunRow]]) -> tuple[tuple[float, tuple[RunRow, ...]], ...]:
    return tuple((x, tuple(columns[x])) for x in sorted(columns))


def figure_section(rows: Sequence[RunRow], meta: Meta) -> tuple[Html | None, int]:
    """The figures with their captions, None without any, and how many there are."""
    drawn = [_figure(panel, k) for k, panel in enumerate(panels(rows, meta), 1)]
    found = [one for one in drawn if one is not None]
    if not found:
        return None, 0
    note = interval_note(meta.rule) if any(is_share(one.y) for one in meta.figures) else ""
    said = [tag("p", note, class_="note")] if note else []
    return tag("section", tag("h2", "Figures"), tag("div", *found, class_="figures"), *said, id="figures"), len(drawn)


def _figure(panel: Panel, k: int) -> Html | None:
    """One figure with its caption; None without a run that has a number for it."""
    drawn = _of_shares(panel) if is_share(panel.wanted.y) else _of_metric(panel)
    if drawn is None:
        return None
    figure, said = drawn
    said += _NO_INTERVALS if panel.together else ""
    title, paper = panel_title(panel), "; ".join(f"{x:g}: {y:g}" for x, y in panel.wanted.paper)
    description = f"{said} The numbers are in the tables below." + (f" The paper: {paper}." if paper else "")
    svg = inline_svg(figure, k, title, description)
    return tag("figure", svg, tag("figcaption", tag("b", f"Figure {k}. {title}. "), said))


def _of_shares(panel: Panel) -> tuple["DrawnFigure", str] | None:
    """(figure, what is said below it)."""
    y, shares = panel.wanted.y, []
    for x, rows in panel.columns:
        if rows:
            part = count(rows, y)
            share, interval = part / len(rows), wilson(part, len(rows))
            low, high = (share, share) if panel.together else (interval.low, interval.high)
            shares.append(Share(x, share, low, high))
    if not shares:
        return None
    labels = (panel.x_label, f"{y.replace('_', ' ')} [% of runs]")
    interval_words = "" if panel.together else ", with its Wilson interval at 95 %"
    return share_figure(shares, panel.wanted.paper, labels), f"Share of {len(panel.rows)} runs{interval_words}."


def _of_metric(panel: Panel) -> tuple["DrawnFigure", str] | None:
    """(figure, what is said below it)."""
    described = described_columns(panel)
    if not described:
        return None
    dots, fits = _dots(panel), fits_of(panel)
    labels = (panel.x_label, quantity(panel.wanted.y).label)
    columns = [_column(one) for one in described]
    figure = metric_figure(dots, columns, _curve(fits), panel.wanted.paper, labels)
    return figure, f"{len(dots)} runs, each a dot.{_fit_words(fits)}{f' {cut}.' if (cut := _cut_words(panel)) else ''}"


def _dots(panel: Panel) -> list[tuple[float, float]]:
    """A dot a run; those of one x a little beside each other, so that they do not hide under the mean."""
    xs = [x for x, _ in panel.columns]
    nearest = min((b - a for a, b in itertools.pairwise(xs)), default=0.0)
    reach = min(_APART * nearest, 0.02 * (xs[-1] - xs[0]))
    return [
        (x + reach * (2 * (k * _GOLDEN_RATIO % 1) - 1 if len(rows) > 1 else 0), value)
        for x, rows in panel.columns
        for k, value in enumerate(values_of(rows, panel.wanted.y))
    ]


def panel_title(panel: Panel) -> str:
    """`right knee, position RMSE over duration, stops off`."""
    y = panel.wanted.y
    named = f"share of runs: {y.replace('_', ' ')}" if is_share(y) else quantity(y).words
    return f"{named[0].upper()}{named[1:]} over {panel.axis.name}{', ' if panel.held else ''}{panel.held}"


@dataclass(frozen=True, slots=True)
class Described:
    """The values of y at one x.

    mean, median: their intervals, None for too few values, for equal ones, for dependent runs.
    """

    x: float
    values: Summary
    mean: Interval | None
    median: Interval | None


def described_columns(panel: Panel) -> list[Described]:
    """What is said about the values at every x with runs that have one."""
    found = ((x, values_of(rows, panel.wanted.y)) for x, rows in panel.columns)
    return [
        Described(
            x,
            summary(values),
            None if panel.together else _interval(mean_interval, values),
            None if panel.together else _interval(median_interval, values),
        )
        for x, values in found
        if values
    ]


def _interval(of: Callable[[Sequence[float]], Interval], values: Sequence[float]) -> Interval | None:
    """None where there is none; equal values, whose spread of 0 would claim a number without doubt, have none."""
    try:
        return of(values) if min(values) < max(values) else None
    except NotEstimableError:
        return None


@dataclass(frozen=True, slots=True)
class Fits:
    """The parabola through all runs, and the one through their means, for the R squared of both."""

    runs: QuadraticFit
    means: QuadraticFit

    @property
    def equation(self) -> str:
        """`y = 0.01 + 0.5 x - 0.02 x²`."""
        a, b, c = self.runs.coefficients
        signs = ["-" if value < 0 else "+" for value in (b, c)]
        return f"y = {number(a)} {signs[0]} {number(abs(b))} x {signs[1]} {number(abs(c))} x²"


def fits_of(panel: Panel) -> Fits | None:
    """None where no fit is wanted, or where there are too few places on x for one that says anything."""
    described = described_columns(panel)
    if panel.wanted.fit != "quadratic" or len(described) < _LEAST_FOR_FIT:
        return None
    pairs = [(x, value) for x, rows in panel.columns for value in values_of(rows, panel.wanted.y)]
    runs = quadratic_fit([x for x, _ in pairs], [value for _, value in pairs])
    return Fits(runs, quadratic_fit([one.x for one in described], [one.values.mean for one in described]))


def values_section(rows: Sequence[RunRow], meta: Meta) -> Html | None:
    """A table of each figure's numbers, the paper's beside ours; None when no figure shows a metric."""
    found = values_tables(rows, meta)
    tables = [table(one.caption, one.heads, one.body, one.texts) for one in found]
    if not tables:
        return None
    note = (
        "Mean with its 95 % interval (Student's t), median with its own (between order statistics, from six runs up): "
        "where a few runs lie far above all others, the interval of the mean is too narrow on their side, that of the "
        "median holds. Quartiles: a quarter of the runs below the first, a quarter above the second. Behind a "
        "published number stands whether it is inside the interval of our mean, below or above it."
    )
    heading = tag("h2", "Numbers of the figures")
    return tag("section", heading, *tables, tag("p", note, class_="note"), id="values")


def values_tables(rows: Sequence[RunRow], meta: Meta) -> list[Table]:
    """One for each figure that shows a metric."""
    shown = [panel for panel in panels(rows, meta) if not is_share(panel.wanted.y)]
    return [_values_table(panel, described) for panel in shown if (described := described_columns(panel))]


def _values_table(panel: Panel, described: Sequence[Described]) -> Table:
    paper = dict(panel.wanted.paper)
    heads = [panel.x_label, "runs", "mean", "median", "quartiles", "lowest", "highest"]
    body = []
    for one in described:
        found = one.values
        cells = [
            f"{one.x:g}",
            str(found.n),
            f"{number(found.mean)}{_ends(one.mean)}",
            f"{number(found.median)}{_ends(one.median)}",
            f"{number(found.q1)}, {number(found.q3)}",
            number(found.low),
            number(found.high),
        ]
        body.append((*cells, *([_beside(paper.get(one.x), one.mean)] if paper else [])))
    unit = quantity(panel.wanted.y).unit
    cut = _cut_words(panel)
    caption = f"{panel_title(panel)}{f', in {unit}' if unit else ''}{f' ({cut})' if cut else ''}"
    return Table(caption, (*heads, *(["the paper"] if paper else [])), tuple(body), frozenset())


def _beside(paper: float | None, ours: Interval | None) -> str:
    """A published number, and where it lies beside the interval of our mean."""
    if paper is None or ours is None:
        return "" if paper is None else f"{paper:g}"
    return f"{paper:g} ({'below' if paper < ours.low else 'above' if paper > ours.high else 'inside'})"


def _ends(interval: Interval | None) -> str:
    return "" if interval is None else f" ({number(interval.low)} to {number(interval.high)})"


def _column(one: Described) -> Column:
    found = one.values
    low, high = (found.mean, found.mean) if one.mean is None else (one.mean.low, one.mean.high)
    return Column(one.x, found.mean, low, high, found.median, (found.q1, found.q3))


def _curve(fits: Fits | None) -> Curve | None:
    if fits is None:
        return None
    fit = fits.runs
    steps = [fit.low + (fit.high - fit.low) * k / _CURVE_POINTS for k in range(_CURVE_POINTS + 1)]
    return Curve(steps, [fit.at(x) for x in steps])


def _cut_words(panel: Panel) -> str:
    """What has to be said under numbers of runs that were cut short, "" for none."""
    early = ended_early(panel.rows, panel.motions)
    if not early:
        return ""
    subject, their = ("1 run", "its") if early == 1 else (f"{early} runs", "their")
    return f"{subject} ended early: {their} numbers cover a part of the motion"


def _fit_words(fits: Fits | None) -> str:
    if fits is None:
        return ""
    squares = [f"{found:.3f}" for found in (fits.runs.r_squared, fits.means.r_squared) if found is not None]
    if len(squares) < 2:
        return f" Quadratic fit: {fits.equation}."
    return f" Quadratic fit: {fits.equation}; R² = {squares[0]} of the runs, {squares[1]} of the means."
