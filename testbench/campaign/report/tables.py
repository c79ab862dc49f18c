"""What is counted of runs, as tables of text: for the report's page, and for documents in Markdown."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

from testbench.campaign.file.rules import FAILURE
from testbench.campaign.records import NO_STATEMENT, Outcome, RunRow
from testbench.campaign.report.measured import BEYOND_3DEG, EXCEEDED, by_point, count, points_of, stating
from testbench.campaign.report.meta import Meta
from testbench.campaign.words import share_text

SHARES: Final = {
    FAILURE: "failed",
    BEYOND_3DEG: "failed by more than 3 deg",
    EXCEEDED: "any limit exceeded",
}


@dataclass(frozen=True, slots=True)
class Table:
    """heads: of the columns; texts: the columns that hold words, all others hold numbers."""

    caption: str
    heads: tuple[str, ...]
    body: tuple[tuple[str, ...], ...]
    texts: frozenset[int]

    def markdown(self) -> str:
        """As GitHub and others read it; the caption is a line above."""
        lines = [_line(self.heads), _line([":--" if k in self.texts else "--:" for k in range(len(self.heads))])]
        return "\n".join([f"{self.caption}:", "", *lines, *(_line(row) for row in self.body), ""])


def outcome_table(rows: Sequence[RunRow], meta: Meta) -> Table:
    """A row a point: outcomes, shares of failures and exceeded limits, reactions, what makes no statement."""
    runs = by_point(rows, points_of(rows, meta))
    seen = [outcome for outcome in Outcome if any(row.outcome is outcome for row in rows)]
    judged_seen = [outcome for outcome in seen if outcome not in NO_STATEMENT]
    mute = bool(set(seen) & NO_STATEMENT)
    axes = list(dict.fromkeys(name for point in runs for name, _ in point.parameters))
    body = []
    for point, found in runs.items():
        judged, values = stating(found), dict(point.parameters)
        cells = [values.get(axis, "") for axis in axes]
        cells.append(str(len(judged)))
        cells += [str(sum(row.outcome is outcome for row in judged)) for outcome in judged_seen]
        cells += [share_text(count(judged, what), len(judged)) for what in SHARES]
        cells.append(_noticed(judged))
        body.append((*cells, *([_mute(found)] if mute else [])))
    heads = (*axes, "runs", *map(words, judged_seen), *SHARES.values(), "noticed", *(["no statement"] if mute else []))
    texts = {*range(len(axes)), *([len(heads) - 1] if mute else [])}
    return Table("Outcomes by point", heads, tuple(body), frozenset(texts))


def number(value: float) -> str:
    """Three significant digits, without an exponent where it can be read without."""
    return f"{value:.0f}" if 1000 <= abs(value) < 1e6 else f"{value:.3g}"


def plain_share(part: int, whole: int) -> str:
    """Without interval, for points taken together: with the same seeds, their runs depend on each other."""
    return f"{100 * part / whole:.1f} %" if whole else "none"


def words(outcome: Outcome) -> str:
    """An outcome as prose."""
    return outcome.value.replace("_", " ")


def _noticed(rows: Sequence[RunRow]) -> str:
    latencies = sorted(row.detection_latency_s for row in rows if row.detection_latency_s is not None)
    if not latencies:
        return "0"
    middle = (latencies[(len(latencies) - 1) // 2] + latencies[len(latencies) // 2]) / 2
    return f"{len(latencies)}, {middle:.3f} s"


def _mute(rows: Sequence[RunRow]) -> str:
    counts = Counter(row.outcome for row in rows if row.outcome in NO_STATEMENT)
    return ", ".join(f"{found} {words(outcome)}" for outcome, found in counts.items())


def _line(cells: Sequence[str]) -> str:
    return f"| {' | '.join(cell.replace('|', chr(92) + '|') for cell in cells)} |"
