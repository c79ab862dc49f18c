"""Runs a reader wants to see for himself: the worst, the slowest, and those unlike the others."""

import shlex
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

from testbench.campaign.records import NO_STATEMENT, Point, RunRow
from testbench.campaign.report.measured import stating
from testbench.campaign.report.tables import words

_EACH: Final = 5
"""Most runs of one kind."""
_ENOUGH: Final = 5
"""Runs of a point from which on a single one can be unlike the others."""
_SHOWN: Final = 12
"""Digits of an identity that name a run: 48 bits, no two alike in any campaign."""


@dataclass(frozen=True, slots=True)
class Notable:
    """A run and why it is shown."""

    row: RunRow
    why: str


def replay_command(store: str, row: RunRow) -> str:
    """What to type to see that run again, as a shell reads it."""
    return f"exo-hil campaign replay {shlex.quote(store)} {row.identity[:_SHOWN]}"


def worst(rows: Sequence[RunRow]) -> list[Notable]:
    """Those in which a joint went farthest beyond its range of travel."""
    found = sorted((row for row in rows if row.beyond_deg > 0), key=lambda row: (-row.beyond_deg, row.identity))
    return [Notable(row, f"{row.beyond_deg:.1f} deg beyond, {_joint(row)}") for row in found[:_EACH]]


def slowest(rows: Sequence[RunRow]) -> list[Notable]:
    """Those that took the most wall time."""
    found = sorted((row for row in rows if row.wall_s > 0), key=lambda row: (-row.wall_s, row.identity))
    return [Notable(row, f"{row.wall_s:.2f} s") for row in found[:_EACH]]


def latest_noticed(rows: Sequence[RunRow]) -> list[Notable]:
    """Those in which the fault had been there longest when somebody reacted."""
    found = [(row.detection_latency_s, row) for row in rows if row.detection_latency_s is not None]
    found.sort(key=lambda one: (-one[0], one[1].identity))
    return [Notable(row, f"noticed after {latency:.3f} s") for latency, row in found[:_EACH]]


def odd(runs: Mapping[Point, Sequence[RunRow]]) -> list[Notable]:
    """Runs without a statement, runs that were tried again, and single runs that came out unlike all others there."""
    rows = [row for found in runs.values() for row in found]
    mute = [Notable(row, _said(row)) for row in rows if row.outcome in NO_STATEMENT]
    again = [
        Notable(row, f"tried {row.attempts} times")
        for row in rows
        if row.attempts > 1 and row.outcome not in NO_STATEMENT
    ]
    return [*mute[: 2 * _EACH], *again[:_EACH], *_alone(runs)[:_EACH]]


def _alone(runs: Mapping[Point, Sequence[RunRow]]) -> list[Notable]:
    """The only run of its outcome where all others of the point share one; points with most runs first."""
    found = []
    for rows in runs.values():
        judged = stating(rows)
        counts = Counter(row.outcome for row in judged)
        if len(judged) >= _ENOUGH and len(counts) == 2 and min(counts.values()) == 1:
            (common, _), (rare, _) = counts.most_common()
            (row,) = (row for row in judged if row.outcome is rare)
            found.append((len(judged), Notable(row, f"the other {len(judged) - 1} runs there: {words(common)}")))
    found.sort(key=lambda one: (-one[0], one[1].row.identity))
    return [notable for _, notable in found]


def _said(row: RunRow) -> str:
    return f"{words(row.outcome)}: {row.reason}" if row.reason else words(row.outcome)


def _joint(row: RunRow) -> str:
    return row.beyond_joint.replace("_", " ") or "joint not told"
