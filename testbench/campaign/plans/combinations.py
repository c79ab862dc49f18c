"""The smallest sets of injectors that bring an outcome about.

Breadth first: no injector at all, each alone, each pair, ...; a size is judged when all of its runs are known. A set
with a failing subset is left out: it is not minimal, whatever it does (it need not fail: faults can cancel each other).
A set that does not fail in so many runs may still fail rarely: its interval says how rarely.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum
from itertools import combinations

from testbench.campaign.plans.search import CombinationSearch
from testbench.campaign.records import Known, Plan, Point, Wanted
from testbench.campaign.statistics.shares import Interval, Tally, clopper_pearson, tally

__all__ = ["CombinationPlan", "CombinationResult", "SetResult", "Verdict"]

Names = tuple[str, ...]


class Verdict(Enum):
    """What the runs of a set say: fails: at least `least` of them showed the outcome; holds: fewer.

    undecided: fewer, and runs without a statement could have made the difference.
    """

    FAILS = "fails"
    HOLDS = "holds"
    UNDECIDED = "undecided"


@dataclass(frozen=True, slots=True)
class SetResult:
    """One set that was tried, in the order of the search's injectors; () is none of them.

    interval: Clopper-Pearson at 95 %, of the share with the outcome; None where no run makes a statement. minimal: it
    fails and every smaller set of its injectors holds.
    """

    injectors: Names
    tally: Tally
    verdict: Verdict
    interval: Interval | None
    minimal: bool


@dataclass(frozen=True, slots=True)
class CombinationResult:
    """What one search found. sets: all that were tried, by size, then in the order of the search's injectors.

    point: values of the other axes. pruned: sets up to size `size` left out, as a subset fails. size: largest size that
    is finished, -1 for none; complete: nothing is left to try: every set up to `most` was tried or left out.
    """

    search: CombinationSearch
    point: Point
    sets: tuple[SetResult, ...]
    pruned: int
    size: int
    complete: bool

    @property
    def minimal(self) -> tuple[Names, ...]:
        """The smallest failing sets, smallest first."""
        return tuple(one.injectors for one in self.sets if one.minimal)


class CombinationPlan(Plan):
    """Asks for the runs of all sets of a size when the smaller ones are known."""

    def __init__(self, search: CombinationSearch, others: Sequence[Point] = (Point(()),)) -> None:
        """others: the combinations of the other axes; one search each."""
        self.search = search
        self.others = tuple(others)

    def point(self, other: Point, injectors: Names) -> Point:
        """Where these injectors, and of the listed ones no other, are switched on: keys as in a scenario file."""
        switches = ((f"injectors.{name}.enabled", str(name in injectors).lower()) for name in self.search.injectors)
        return Point((*other.parameters, *switches))

    def wanted(self, known: Known) -> list[Wanted]:
        """All runs of all sizes so far."""
        return [one for other in self.others for one in self._walk(other, known)[0]]

    def results(self, known: Known) -> tuple[CombinationResult, ...]:
        """One for each of the other combinations, in their order; also of a search that is not finished yet."""
        return tuple(self._walk(other, known)[1] for other in self.others)

    def _walk(self, other: Point, known: Known) -> tuple[list[Wanted], CombinationResult]:
        wanted: list[Wanted] = []
        sets: list[SetResult] = []
        failing: list[frozenset[str]] = []
        unsure: list[frozenset[str]] = []
        pruned = 0
        for size in range(self.search.most + 1):
            all_of_size = list(combinations(self.search.injectors, size))
            tried = [names for names in all_of_size if not any(one <= set(names) for one in failing)]
            pruned += len(all_of_size) - len(tried)
            judged = []
            for names in tried:
                point = self.point(other, names)
                wanted.extend(Wanted(point, number) for number in range(self.search.runs))
                judged.append(self._judge(names, point, known, unsure))
            sets.extend(one for one in judged if one is not None)
            if None in judged:
                return wanted, CombinationResult(self.search, other, tuple(sets), pruned, size - 1, complete=False)
            failing = [frozenset(one.injectors) for one in sets if one.verdict is Verdict.FAILS]
            unsure = [frozenset(one.injectors) for one in sets if one.verdict is Verdict.UNDECIDED]
        return wanted, CombinationResult(self.search, other, tuple(sets), pruned, self.search.most, complete=True)

    def _judge(self, names: Names, point: Point, known: Known, unsure: Sequence[frozenset[str]]) -> SetResult | None:
        """None while runs are missing. unsure: smaller sets that are undecided."""
        outcomes = {row.number: row.outcome for row in known.get(point, ()) if row.number < self.search.runs}
        if len(outcomes) < self.search.runs:
            return None
        counted = tally(outcomes.values(), self.search.outcome)
        if counted.successes >= self.search.least:
            verdict = Verdict.FAILS
        elif counted.successes + counted.excluded < self.search.least:
            verdict = Verdict.HOLDS
        else:
            verdict = Verdict.UNDECIDED
        interval = clopper_pearson(counted.successes, counted.trials) if counted.trials else None
        minimal = verdict is Verdict.FAILS and not any(one < set(names) for one in unsure)
        return SetResult(names, counted, verdict, interval, minimal)
