"""Plans of a grid: so many runs at every point, or as many as a wanted interval takes."""

from collections.abc import Sequence
from typing import Final, final

from testbench.campaign.file.rules import FixedRuns, Until
from testbench.campaign.records import Known, Plan, Point, RunRow, Wanted
from testbench.campaign.statistics.shares import tally, wilson

BLOCK: Final = 10
"""Runs of a point that are wanted in a row: what a process keeps of one setting is used again, and yet an early look
at a campaign finds runs at all points."""


@final
class GridPlan(Plan):
    """`runs` at every point."""

    def __init__(self, points: Sequence[Point], rule: FixedRuns) -> None:
        self._all: Final[list[Wanted]] = _by_block(dict.fromkeys(points, rule.runs))

    def wanted(self, known: Known) -> list[Wanted]:
        """Always the same."""
        return list(self._all)


@final
class SequentialPlan(Plan):
    """At every point, batches until the Wilson interval of the outcome's share is narrow enough.

    After a batch the interval of all runs so far is looked at: its coverage is then a little below the nominal one,
    as a share that happens to look extreme early ends the runs of its point.
    """

    def __init__(self, points: Sequence[Point], rule: Until) -> None:
        self._points: Final[tuple[Point, ...]] = tuple(points)
        self._rule: Final[Until] = rule

    def wanted(self, known: Known) -> list[Wanted]:
        """For each point, the batches that were needed so far, and the next one where the interval is too wide."""
        return _by_block({point: self._runs(known.get(point, ())) for point in self._points})

    def _runs(self, rows: Sequence[RunRow]) -> int:
        """How many runs of a point are wanted; each batch is judged when all of it is there."""
        rule, there = self._rule, {row.number: row.outcome for row in rows}
        runs = max(rule.least, rule.batch)
        while runs < rule.most and all(number in there for number in range(runs)):
            counted = tally((there[number] for number in range(runs)), rule.outcome)
            if counted.trials and wilson(counted.successes, counted.trials).width <= rule.width:
                break
            runs = min(runs + rule.batch, rule.most)
        return runs


def _by_block(runs: dict[Point, int]) -> list[Wanted]:
    """Runs 0..BLOCK-1 of all points, then the next block, and so on."""
    most = max(runs.values(), default=0)
    return [
        Wanted(point, number)
        for start in range(0, most, BLOCK)
        for point, count in runs.items()
        for number in range(start, min(start + BLOCK, count))
    ]
