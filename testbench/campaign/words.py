"""A campaign in sentences: what it will do, and how far it is."""

from collections.abc import Mapping, Sequence
from math import isfinite
from typing import Final

from testbench.campaign.file.axes import Axis
from testbench.campaign.file.rules import Figure, FixedRuns, Rule, Until
from testbench.campaign.file.schema import Campaign
from testbench.campaign.plans.search import CriticalSearch
from testbench.campaign.records import NO_STATEMENT, Outcome, Point, RunRow
from testbench.campaign.statistics.shares import tally, wilson

SHOWN: Final = 40
"""Points of which a summary on the terminal shows a line; the report has them all."""


def asked(rule: Rule) -> str:
    """What is wanted of each point."""
    if isinstance(rule, FixedRuns):
        return f"{rule.runs} run{_s(rule.runs)} a point"
    if isinstance(rule, Until):
        return (
            f"at every point {rule.batch} runs at a time until the 95 % interval of the share of {rule.outcome} is at "
            f"most {rule.width:g} wide, {rule.least} to {rule.most} runs"
        )
    if isinstance(rule, CriticalSearch):
        ends = f"between {rule.text(0)} and {rule.text(rule.steps)}, to {rule.tolerance.normalize():f} {rule.unit}"
        return (
            f"for every combination of the other axes, the {rule.axis} {ends.rstrip()} at which {rule.outcome} has a "
            f"share of {100 * rule.quantile:g} %, by {rule.method}, at most {rule.most} runs"
        )
    return (
        f"the smallest sets of at most {rule.most} of {', '.join(rule.injectors)} that lead to {rule.outcome} in "
        f"{rule.least} of {rule.runs} runs"
    )


def interval_note(rule: Rule) -> str:
    """What has to be said beside the intervals of shares, "" for nothing: with `until` they are asked repeatedly."""
    if not isinstance(rule, Until):
        return ""
    return (
        "The runs of a point end when its interval is narrow enough, which is asked after every batch: for some shares "
        "these intervals cover less often than 95 % (at worst 90.5 %, on average 95.2 %, computed for batches of 20, "
        "at most 400 runs and a width of 0.1; docs/statistics.md)."
    )


def describe_campaign(campaign: Campaign) -> list[str]:
    """The campaign in sentences, for `exo-hil check`."""
    about = f": {campaign.description}" if campaign.description else ""
    lines = [f"{campaign.name}{about}"]
    base = campaign.settings.base.source
    lines.append(f"scenario: {'in the file itself' if base == campaign.source else base}")
    lines += [f"axis {axis.name}: {_axis(axis)}" for axis in campaign.axes]
    points, rule = len(campaign.points), campaign.rule
    what = "combination" if isinstance(rule, CriticalSearch) else "point"
    lines.append(f"{points} {what}{_s(points)}; {asked(rule)}")
    lines.append(f"runs: {_runs(rule, points)}; run k of every point has seed {campaign.seed} + k")
    lines.append("time: known when the first runs are made; `exo-hil campaign status` says then what is left")
    if campaign.stop_early is not None:
        lines.append(f"a run ends {campaign.stop_early.grace_s:g} s after its first {campaign.stop_early.on}")
    lines.append(f"result folders of single runs: {campaign.traces}; a run may take {campaign.time_limit_s:g} s")
    units = {axis.name: axis.unit for axis in campaign.axes}
    lines += [f"figure: {_figure(one, units[one.x])}" for one in campaign.figures]
    return lines


def _figure(figure: Figure, unit: str) -> str:
    """What a figure shows, and of which part of its axis."""
    ends = (("from", figure.low), ("to", figure.high))
    part = "".join(f" {word} {end:g} {unit}".rstrip() for word, end in ends if isfinite(end))
    return f"{figure.y} over {figure.x}{part}{', with a quadratic fit' if figure.fit else ''}"


def point_lines(points: Mapping[int, Point], rows: Sequence[RunRow], outcome: str = "failure") -> list[str]:
    """A table: a line a point, with the counts of outcomes and the share of one with its Wilson interval."""
    by_point: dict[Point, list[RunRow]] = {point: [] for point in points.values()}
    for row in rows:
        by_point.setdefault(row.point, []).append(row)
    shown = [(number, point) for number, point in points.items() if by_point[point]]
    outcomes = [one for one in Outcome if any(row.outcome is one for row in rows)]
    head = ["point", *dict.fromkeys(name for _, point in shown for name, _ in point.parameters), "runs"]
    axes = head[1:-1]
    table = [[*head, *(one.value for one in outcomes), f"share of {outcome}, 95 %"]]
    for number, point in shown[:SHOWN]:
        found, texts = by_point[point], dict(point.parameters)
        counts = [str(sum(row.outcome is one for row in found)) for one in outcomes]
        counted = tally((row.outcome for row in found), outcome)
        share = share_text(counted.successes, counted.trials)
        table.append([str(number), *(texts.get(axis, "") for axis in axes), str(len(found)), *counts, share])
    widths = [max(len(line[column]) for line in table) for column in range(len(table[0]))]
    lines = ["  ".join(text.ljust(width) for text, width in zip(line, widths, strict=True)).rstrip() for line in table]
    if len(shown) > SHOWN:
        lines.append(f"... and {len(shown) - SHOWN} more points")
    return lines


def share_text(part: int, whole: int) -> str:
    """`12.0 % (4.2 to 28.1 %)`: a share with its Wilson interval; none where there is nothing to take a share of."""
    if not whole:
        return "none"
    interval = wilson(part, whole)
    return f"{_percent(part / whole)} % ({_percent(interval.low)} to {_percent(interval.high)} %)"


def counts_text(counts: Mapping[Outcome, int]) -> str:
    """ "12 masked, 3 failure_silent", in the order of Outcome."""
    return ", ".join(f"{counts[one]} {one.value}" for one in Outcome if counts.get(one)) or "none yet"


def odd_lines(rows: Sequence[RunRow], points: Mapping[int, Point], most: int = 10) -> list[str]:
    """The runs that make no statement, each with its reason."""
    numbers = {point: number for number, point in points.items()}
    odd = [row for row in rows if row.outcome in NO_STATEMENT]
    lines = [f"{row.outcome.value}: {numbers[row.point]}/{row.number} (seed {row.seed}): {row.reason}" for row in odd]
    return lines if len(lines) <= most else [*lines[:most], f"... and {len(lines) - most} more"]


def time_text(seconds: float | None) -> str:
    """ "42 s", "7 min", "3 h 20 min"; "unknown" for None."""
    if seconds is None:
        return "unknown"
    minutes = round(seconds / 60)
    if seconds < 90:
        return f"{seconds:.0f} s"
    return f"{minutes} min" if minutes < 90 else f"{minutes // 60} h {minutes % 60} min"


def _axis(axis: Axis) -> str:
    texts = axis.texts if len(axis.texts) <= 8 else (*axis.texts[:4], "...", *axis.texts[-2:])
    between = f"between {axis.texts[0]} and {axis.texts[1]}" if axis.is_open else ", ".join(texts)
    many = "" if axis.is_open else f" ({len(axis.texts)} value{_s(len(axis.texts))})"
    return f"{between}{many}{', sets ' + ', '.join(axis.keys) if axis.keys else ''}"


def _runs(rule: Rule, points: int) -> str:
    if isinstance(rule, FixedRuns):
        return str(points * rule.runs)
    if isinstance(rule, Until):
        return f"{points * max(rule.least, rule.batch)} to {points * rule.most}"
    return f"at most {points * rule.most}" if isinstance(rule, CriticalSearch) else "as the search finds out"


def _percent(share: float) -> str:
    return f"{100 * share:.0f}" if share in (0, 1) else f"{100 * share:.1f}"


def _s(count: int) -> str:
    return "" if count == 1 else "s"
