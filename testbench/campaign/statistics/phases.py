"""Shares over the gait phase: the stride in equal bins, in each the share of runs that showed an outcome.

Phase 0 is right heel strike, 1 the next one, so that 1 is 0 again. Each bin holds its lower edge and not its upper one.
The bins are judged one by one: with 20 bins at 95 %, one interval in twenty misses.
"""

from bisect import bisect_right
from collections.abc import Iterable
from dataclasses import dataclass
from itertools import pairwise

from testbench.campaign.records import Outcome
from testbench.campaign.statistics.shares import Interval, Tally, clopper_pearson, tally, wilson

__all__ = ["PhaseBin", "by_phase"]


@dataclass(frozen=True, slots=True)
class PhaseBin:
    """The runs whose phase lies in low <= phase < high; in the bin that wraps around, high is more than 1.

    wilson, clopper_pearson: intervals of the share, None where no run makes a statement.
    """

    low: float
    high: float
    tally: Tally
    wilson: Interval | None
    clopper_pearson: Interval | None


def by_phase(
    runs: Iterable[tuple[float, Outcome]], outcome: str, bins: int = 20, first: float = 0.0, confidence: float = 0.95
) -> tuple[PhaseBin, ...]:
    """Share of `outcome` by the phase of each run, such as (RunRow.first_phase, RunRow.outcome).

    first: lower edge of the first bin, 0 <= first < 1 / bins; with half a bin below 0 wanted, take 1 / (2 bins), and
    the last bin wraps around 0. Runs without a phase (no fault began) belong to no bin: leave them out and say how many
    there were. Raises ValueError for a phase outside of 0..1, NaN included.
    """
    if bins < 1 or not 0 <= first < 1 / bins:
        raise ValueError(f"{bins} bins from {first} given; allowed: bins from 1 up, first from 0 to below 1 / bins")
    edges = [first + number / bins for number in range(bins)] + [first + 1]
    inside: list[list[Outcome]] = [[] for _ in range(bins)]
    for phase, found in runs:
        if not 0 <= phase <= 1:
            raise ValueError(f"a phase of {phase} given; allowed 0..1 of a stride")
        start = phase % 1
        place = start if start >= first else start + 1
        inside[min(bisect_right(edges, place), bins) - 1].append(found)
    return tuple(
        _judged(low, high, found, outcome, confidence)
        for (low, high), found in zip(pairwise(edges), inside, strict=True)
    )


def _judged(low: float, high: float, found: list[Outcome], outcome: str, confidence: float) -> PhaseBin:
    counted = tally(found, outcome)
    if not counted.trials:
        return PhaseBin(low, high, counted, None, None)
    counts = (counted.successes, counted.trials, confidence)
    return PhaseBin(low, high, counted, wilson(*counts), clopper_pearson(*counts))
