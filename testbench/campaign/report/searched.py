"""The part of a report that says what a search has found: critical values as a map and a table, or failing sets."""

from collections.abc import Sequence
from typing import Final

from testbench.campaign.plans.combinations import CombinationPlan, CombinationResult
from testbench.campaign.plans.critical import Answer, CriticalPlan, CriticalResult
from testbench.campaign.plans.search import CombinationSearch, CriticalSearch
from testbench.campaign.records import Point, RunRow
from testbench.campaign.report.figures import inline_svg, map_figure
from testbench.campaign.report.markup import Content, Html, table, tag
from testbench.campaign.report.measured import by_point
from testbench.campaign.report.meta import Meta
from testbench.campaign.report.tables import Table

_ZOOM: Final = 115
"""CSS pixels per inch at most; 96 are the size it was drawn for."""
_IN_CELLS: Final = {Answer.BEYOND: ">", Answer.BELOW: "<"}


def critical_results(rows: Sequence[RunRow], meta: Meta) -> tuple[CriticalResult, ...]:
    """What the search has come to, for every combination of the other axes; empty for a campaign without one."""
    if not isinstance(meta.rule, CriticalSearch):
        return ()
    position = [axis.name for axis in meta.axes].index(meta.rule.axis)
    return CriticalPlan(meta.rule, meta.points, position).results(by_point(rows))


def search_section(rows: Sequence[RunRow], meta: Meta, figure: int) -> Html | None:
    """None without a search. figure: number of its figure on the page."""
    if isinstance(meta.rule, CombinationSearch):
        return _combinations(CombinationPlan(meta.rule, meta.points).results(by_point(rows)))
    results = critical_results(rows, meta)
    return _critical(results, figure) if results else None


def _critical(results: Sequence[CriticalResult], figure: int) -> Html:
    search = results[0].search
    others = [name for name, _ in results[0].point.parameters]
    quantile, confidence = f"{100 * search.quantile:g} %", f"{100 * search.confidence:g} %"
    said = (
        f"The {search.axis} at which {quantile} of the runs show {search.outcome}, by {search.method}, to "
        f"{search.tolerance:f} {search.unit}; in brackets its interval at {confidence}. Left out are runs that make no "
        "statement."
    )
    found = critical_table(results)
    body: list[list[Content]] = [[*cells[:-1], tag("span", cells[-1], class_="wrap")] for cells in found.body]
    return tag(
        "section",
        tag("h2", f"Critical {search.axis}"),
        tag("p", said),
        *([_map(results, others, figure)] if len(others) == 2 else []),
        table(found.caption, found.heads, body, found.texts),
        id="search",
    )


def critical_table(results: Sequence[CriticalResult]) -> Table:
    """A row for each combination of the other axes. results: at least one."""
    axis, others = results[0].search.axis, [name for name, _ in results[0].point.parameters]
    heads = (*others, f"critical {axis}", "answer", "runs", "left out", "why")
    body = [
        (
            *(text for _, text in one.point.parameters),
            one.text,
            one.answer.value.replace("_", " "),
            str(one.runs),
            str(one.excluded),
            one.reason,
        )
        for one in results
    ]
    return Table(f"Critical {axis}", heads, tuple(body), frozenset({*range(len(others) + 2), len(heads) - 1}))


def _combinations(results: Sequence[CombinationResult]) -> Html:
    """Which smallest sets of injectors bring the outcome about."""
    search = results[0].search
    said = (
        f"Which smallest sets of {', '.join(search.injectors)} lead to {search.outcome}: in at least {search.least} of "
        f"{search.runs} runs, the others switched off, up to {search.most} together. Sets with a failing subset are "
        "left out. In brackets the Clopper-Pearson interval of the share at 95 %."
    )
    parts = [part for one in results for part in (_sets_table(one), tag("p", _minimal_words(one), class_="note"))]
    return tag("section", tag("h2", "Combinations of injectors"), tag("p", said), *parts, id="search")


def _sets_table(result: CombinationResult) -> Html:
    held = ", ".join(f"{name} {text}" for name, text in result.point.parameters)
    body = [
        (
            " + ".join(one.injectors) or "none",
            one.verdict.value,
            "minimal" if one.minimal else "",
            f"{one.tally.successes} of {one.tally.trials}",
            "" if one.interval is None else f"{100 * one.interval.low:.1f} to {100 * one.interval.high:.1f} %",
            str(one.tally.excluded),
        )
        for one in result.sets
    ]
    caption = f"Sets of injectors{', ' if held else ''}{held}"
    return table(caption, ("set", "answer", "", "runs with the outcome", "share", "left out"), body, (0, 1, 2))


def _minimal_words(result: CombinationResult) -> str:
    found = "; ".join(" + ".join(names) for names in result.minimal) or "none"
    rest = "" if result.complete else f" Unfinished: sets of up to {max(result.size, 0)} are judged."
    return f"Smallest failing sets: {found}. {result.pruned} sets were left out, as a subset fails.{rest}"


def _map(results: Sequence[CriticalResult], others: Sequence[str], figure: int) -> Html:
    """The second of the two other axes to the right, the first one upwards."""
    search = results[0].search
    found = {one.point: one for one in results}
    columns = list(dict.fromkeys(one.point.parameters[1] for one in results))
    rows = list(dict.fromkeys(one.point.parameters[0] for one in results))
    cells = [[found.get(Point((row, column))) for column in columns] for row in rows]
    values = [[None if one is None else _value(one) for one in row] for row in cells]
    texts = [["" if one is None else _cell(one) for one in row] for row in cells]
    names = [text for _, text in columns], [text for _, text in rows]
    label = f"critical {search.axis}" + (f" [{search.unit}]" if search.unit else "")
    drawn = map_figure(values, texts, names, (others[1], others[0], label))
    title = f"Critical {search.axis} over {others[1]} and {others[0]}"
    svg = inline_svg(drawn, figure, title, "The numbers are in the table below.")
    note = "> and <: beyond the ends of the axis; ?: no one value, or not enough evidence, see the table."
    caption = tag("figcaption", tag("b", f"Figure {figure}. {title}. "), note)
    width = f"max-width:{_ZOOM * drawn.get_figwidth():.0f}px"
    return tag("figure", tag("div", tag("div", svg, style=width), class_="wide"), caption)


def _value(one: CriticalResult) -> float | None:
    """What colours the cell: the value, or the end of the axis beyond which it lies."""
    if one.answer is Answer.BEYOND:
        return one.low
    return one.high if one.answer is Answer.BELOW else one.value


def _cell(one: CriticalResult) -> str:
    value = _value(one)
    return "?" if value is None else f"{_IN_CELLS.get(one.answer, '')}{value:.3g}"
