"""The parts of a report that count runs: headline, outcomes by point, runs to look at."""

from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Final

from testbench.campaign.markup import Content, Html, table, tag
from testbench.campaign.measured import EXCEEDED, FAILURE, by_point, count, ended_early, stating, words_of
from testbench.campaign.meta import Meta
from testbench.campaign.notable import Notable, latest_noticed, odd, replay_command, slowest, words, worst
from testbench.campaign.records import NO_STATEMENT, Outcome, RunRow
from testbench.campaign.statistics import wilson

_MOST_ROWS: Final = 240

COLOURS: Final = {
    Outcome.NOT_ACTIVATED: "#f0f0f0",
    Outcome.NOT_MANIFESTED: "#d9d9d9",
    Outcome.MASKED: "#9ecae1",
    Outcome.ERROR: "#f3c55b",
    Outcome.DETECTED_SAFE: "#4a8fc4",
    Outcome.FAILURE_DETECTED: "#d9785a",
    Outcome.FAILURE_SILENT: "#9e1b32",
    Outcome.FAILURE: "#b8442f",
}
"""Of the bars; the same order as the outcomes, worst last and darkest."""


def number(value: float) -> str:
    """Three significant digits, without an exponent where it can be read without."""
    return f"{value:.0f}" if 1000 <= abs(value) < 1e6 else f"{value:.3g}"


def share_text(part: int, whole: int) -> str:
    """`12 % (4 to 28 %)`: a share with its Wilson interval; none where there is nothing to take a share of."""
    if not whole:
        return "none"
    interval = wilson(part, whole)
    return f"{_percent(part / whole)} % ({_percent(interval.low)} to {_percent(interval.high)} %)"


def headline(rows: Sequence[RunRow], meta: Meta) -> Html:
    """What was asked, how many runs there are, and how they came out."""
    judged = stating(rows)
    mute = Counter(row.outcome for row in rows if row.outcome in NO_STATEMENT)
    missing = meta.wanted - len(rows)
    lines: list[str] = [
        f"{meta.asked}, at {len(meta.points)} point{_s(len(meta.points))}: {len(rows)} runs made",
        f", {missing} of {meta.wanted} still missing. " if missing > 0 else ". ",
    ]
    if mute:
        parts = ", ".join(f"{found} {words(outcome)}" for outcome, found in mute.items())
        makes, is_ = ("makes", "is") if mute.total() == 1 else ("make", "are")
        lines.append(f"{mute.total()} of them {makes} no statement ({parts}) and {is_} in no share below. ")
    failing = count(judged, FAILURE)
    summary = tag(
        "p",
        tag("strong", f"{failing} of {len(judged)} runs failed"),
        f": {share_text(failing, len(judged))} over all points together. In {count(judged, EXCEEDED)} runs a limit of "
        "torque, speed or angle was exceeded.",
    )
    counts = Counter(row.outcome for row in rows)
    body = [
        (_swatch(outcome), str(counts[outcome]), share_text(counts[outcome], len(judged)) if said else "no statement")
        for outcome in Outcome
        if counts[outcome]
        for said in (outcome not in NO_STATEMENT,)
    ]
    return tag("section", tag("p", lines), summary, table("Outcomes of all runs", ("outcome", "runs", "share"), body))


def outcome_table(rows: Sequence[RunRow], meta: Meta) -> Html:
    """A row a point: outcomes, shares of failures and exceeded limits, reactions, what makes no statement."""
    runs = by_point(rows, meta.points)
    seen = [outcome for outcome in Outcome if any(row.outcome is outcome for row in rows)]
    judged_seen = [outcome for outcome in seen if outcome not in NO_STATEMENT]
    mute = bool(set(seen) & NO_STATEMENT)
    axes = [axis.name for axis in meta.axes]
    head = [*axes, "runs", "outcomes", *(words(one) for one in judged_seen), "failed", "any limit exceeded", "noticed"]
    body = []
    for point, found in list(runs.items())[:_MOST_ROWS]:
        judged = stating(found)
        values = dict(point.parameters)
        cells: list[Content] = [values.get(axis, "") for axis in axes]
        cells += [str(len(judged)), bar(judged)]
        cells += [str(sum(row.outcome is outcome for row in judged)) for outcome in judged_seen]
        cells += [share_text(count(judged, what), len(judged)) for what in (FAILURE, EXCEEDED)]
        cells.append(_noticed(judged))
        if mute:
            cells.append(_mute(found))
        body.append(cells)
    if mute:
        head.append("no statement")
    left_out = len(runs) - len(body)
    note = f"{left_out} further points are in the export of the store." if left_out > 0 else ""
    texts = [*range(len(axes)), len(axes) + 1, *([len(head) - 1] if mute else [])]
    shown = table("Outcomes by point", head, body, texts)
    explained = tag(
        "p",
        "Shares are over the runs that make a statement; in brackets the Wilson interval at 95 %. A limit is exceeded "
        "when a torque, a speed or an angle is beyond it. Noticed: drive or controller reacted after the first fault "
        f"began; the median time it took them. {note}",
        class_="note",
    )
    return tag("section", tag("h2", "Outcomes by point"), _legend(judged_seen), shown, explained, id="outcomes")


def notable_runs(rows: Sequence[RunRow], meta: Meta) -> Html:
    """The runs to look at, each with what replays it."""
    kinds: Mapping[str, list[Notable]] = {
        "Worst runs": worst(rows),
        "Odd runs": odd(by_point(rows, meta.points)),
        "Noticed last": latest_noticed(rows),
        "Slowest runs": slowest(rows),
    }
    parts = [
        part
        for kind, found in kinds.items()
        if found
        for part in (tag("h3", kind), tag("ul", [_notable(one, meta.store) for one in found], class_="runs"))
    ]
    said = "Each command makes that run again, with all traces and plots, and says whether the frames are the same."
    return tag("section", tag("h2", "Runs to look at"), tag("p", said, class_="note"), *parts, id="runs")


def _notable(one: Notable, store: str) -> Html:
    row = one.row
    where = f"{words_of(row.point)}; run {row.number}, seed {row.seed}; {words(row.outcome)}"
    return tag("li", tag("strong", one.why), f": {where}", tag("br"), tag("code", replay_command(store, row)))


def motion_note(rows: Sequence[RunRow]) -> str:
    """What has to be said under numbers of runs that were cut short, "" for none."""
    early = ended_early(rows)
    if not early:
        return ""
    return (
        f" {early} run{_s(early)} ended early: {'its' if early == 1 else 'their'} numbers cover a part of the motion."
    )


def _percent(share: float) -> str:
    return f"{100 * share:.0f}" if share in (0, 1) else f"{100 * share:.1f}"


def _noticed(rows: Sequence[RunRow]) -> str:
    latencies = sorted(row.detection_latency_s for row in rows if row.detection_latency_s is not None)
    if not latencies:
        return "0"
    middle = (latencies[(len(latencies) - 1) // 2] + latencies[len(latencies) // 2]) / 2
    return f"{len(latencies)}, {middle:.3f} s"


def _mute(rows: Sequence[RunRow]) -> str:
    counts = Counter(row.outcome for row in rows if row.outcome in NO_STATEMENT)
    return ", ".join(f"{found} {words(outcome)}" for outcome, found in counts.items())


def bar(rows: Sequence[RunRow]) -> Html:
    """Outcomes of runs as a bar; the numbers stand beside it in the table."""
    counts = Counter(row.outcome for row in rows)
    parts = [
        tag("i", style=f"flex:{counts[outcome]};background:{colour}")
        for outcome, colour in COLOURS.items()
        if counts[outcome]
    ]
    said = ", ".join(f"{counts[outcome]} {words(outcome)}" for outcome in COLOURS if counts[outcome])
    return tag("span", *parts, class_="bar", role="img", aria_label=said or "no runs", title=said)


def _legend(outcomes: Sequence[Outcome]) -> Html:
    return tag("p", *(part for outcome in outcomes for part in (_swatch(outcome), " ")), class_="legend")


def _swatch(outcome: Outcome) -> Html:
    colour = COLOURS.get(outcome, "transparent")
    return tag("span", tag("i", style=f"background:{colour}"), words(outcome), class_="swatch")


def _s(found: int) -> str:
    return "" if found == 1 else "s"
