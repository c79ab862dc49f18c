"""The parts of a report that count runs: headline, outcomes by point, runs to look at."""

from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Final

from testbench.campaign.file.rules import FAILURE
from testbench.campaign.records import NO_STATEMENT, Outcome, RunRow
from testbench.campaign.report.markup import Content, Html, table, tag
from testbench.campaign.report.measured import EXCEEDED, by_point, count, is_search, points_of, stating, words_of
from testbench.campaign.report.meta import Meta
from testbench.campaign.report.notable import Notable, latest_noticed, odd, replay_command, slowest, worst
from testbench.campaign.report.tables import outcome_table, plain_share, words
from testbench.campaign.words import interval_note

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


def headline(rows: Sequence[RunRow], meta: Meta) -> Html:
    """What was asked, how many runs there are, and how they came out."""
    judged = stating(rows)
    mute = Counter(row.outcome for row in rows if row.outcome in NO_STATEMENT)
    missing = meta.wanted - len(rows)
    where = "" if is_search(meta) else f", at {len(meta.points)} point{_s(len(meta.points))}"
    lines: list[str] = [
        f"{meta.asked}{where}: {len(rows)} runs made",
        f", {missing} of {meta.wanted} still missing. " if missing > 0 else ". ",
    ]
    if mute:
        parts = ", ".join(f"{found} {words(outcome)}" for outcome, found in mute.items())
        makes, is_ = ("makes", "is") if mute.total() == 1 else ("make", "are")
        lines.append(f"{mute.total()} of them {makes} no statement ({parts}) and {is_} in no share below. ")
    failing = count(judged, FAILURE)
    over = (
        "; a search looks where it expects to learn most, so that this is no share of anything"
        if is_search(meta)
        else f", {plain_share(failing, len(judged))} over all points together"
    )
    summary = tag(
        "p",
        tag("strong", f"{failing} of {len(judged)} runs failed"),
        f"{over}. In {count(judged, EXCEEDED)} runs a limit of torque, speed or angle was exceeded.",
    )
    counts = Counter(row.outcome for row in rows)
    heads = ["outcome", "runs"]
    body: list[list[Content]] = [[_swatch(outcome), str(counts[outcome])] for outcome in Outcome if counts[outcome]]
    if not is_search(meta):
        heads.append("share")
        for cells, outcome in zip(body, (one for one in Outcome if counts[one]), strict=True):
            cells.append(_share_of_all(outcome, counts[outcome], len(judged)))
    return tag("section", tag("p", lines), summary, table("Outcomes of all runs", heads, body))


def _share_of_all(outcome: Outcome, found: int, judged: int) -> str:
    return "no statement" if outcome in NO_STATEMENT else plain_share(found, judged)


def outcome_section(rows: Sequence[RunRow], meta: Meta) -> Html:
    """Outcomes by point, each with a bar."""
    counted = outcome_table(rows, meta)
    at = next(column for column in range(len(counted.heads)) if column not in counted.texts) + 1  # behind the runs
    runs = list(by_point(rows, points_of(rows, meta)).values())
    body: list[list[Content]] = [
        [*cells[:at], bar(stating(found)), *cells[at:]]
        for cells, found in list(zip(counted.body, runs, strict=True))[:_MOST_ROWS]
    ]
    texts = {column + (column >= at) for column in counted.texts} | {at}
    shown = table(counted.caption, [*counted.heads[:at], "outcomes", *counted.heads[at:]], body, texts)
    left_out = len(runs) - len(body)
    note = f" {left_out} further points are in the export of the store." if left_out > 0 else ""
    explained = tag(
        "p",
        "Shares are over the runs that make a statement; in brackets the Wilson interval at 95 %. A limit is exceeded "
        "when a torque, a speed or an angle is beyond it. Noticed: drive or controller reacted after the first fault "
        f"began; the median time it took them.{note} {interval_note(meta.rule)}".rstrip(),
        class_="note",
    )
    seen = [outcome for outcome in COLOURS if any(row.outcome is outcome for row in rows)]
    return tag("section", tag("h2", "Outcomes by point"), _legend(seen), shown, explained, id="outcomes")


def notable_runs(rows: Sequence[RunRow], meta: Meta) -> Html:
    """The runs to look at, each with what replays it."""
    kinds: Mapping[str, list[Notable]] = {
        "Worst runs": worst(rows),
        "Odd runs": odd(by_point(rows, points_of(rows, meta))),
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
