"""The critical value of an axis, such as a fault duration: where an outcome has a given share of the runs.

One search for every combination of the other axes, so that the results are a map. Each run of a search has a number,
and so a seed, of its own, whatever value it is made at: the fits take the runs as independent. Searches of different
combinations use the same seeds, and can be compared.
The methods and their guarantees: testbench.campaign.plans.probing; more in docs/statistics.md.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import Enum
from typing import Final

import numpy as np

from testbench.campaign.plans.probing import Batch, Tried, bracket, crossing, levels_of, next_batches, tried_values
from testbench.campaign.plans.search import BISECTION, CriticalSearch
from testbench.campaign.records import Known, Outcome, Plan, Point, Wanted
from testbench.campaign.statistics.logistic import LogisticFit, curve_misfit, fall_misfit, logistic_fit
from testbench.campaign.statistics.shares import Interval, NotEstimableError, tally

__all__ = ["Answer", "CriticalPlan", "CriticalResult"]

DOUBT: Final = 0.01
"""p-value below which a fall, or a misfit of the curve, is taken for real."""
SEED: Final = 2020
"""Of the simulations behind p-values, so that the same runs give the same report."""


class Answer(Enum):
    """What a search came to.

    found: a value with its interval; beyond, below: it lies outside of the axis, above `high` or below `low`;
    not_monotone: the share falls again, there is no one value; misfit: the shares do not follow a logistic curve;
    undecided: too little evidence for any of these; unfinished: runs are missing.
    """

    FOUND = "found"
    BEYOND = "beyond"
    BELOW = "below"
    NOT_MONOTONE = "not_monotone"
    MISFIT = "misfit"
    UNDECIDED = "undecided"
    UNFINISHED = "unfinished"


@dataclass(frozen=True, slots=True)
class CriticalResult:
    """What one search found, and what it rests on.

    point: values of the other axes. value, low, high: estimate and confidence interval in the unit of the search; None
    where the data give none, at low and high: open on that side. reason: why so, in words, "" where there is nothing
    to say. tried: by rising value. fit: of the logistic method, None where there is no curve. fall_p: p-value of a
    share that never falls; misfit_p: of the curve; None where not looked at.
    """

    search: CriticalSearch
    point: Point
    answer: Answer
    value: float | None
    low: float | None
    high: float | None
    reason: str
    tried: tuple[Tried, ...]
    fit: LogisticFit | None = None
    fall_p: float | None = None
    misfit_p: float | None = None

    @property
    def runs(self) -> int:
        """All that were made, those without a statement included."""
        return sum(one.runs for one in self.tried)

    @property
    def excluded(self) -> int:
        """Runs without a statement."""
        return sum(one.tally.excluded for one in self.tried)

    @property
    def text(self) -> str:
        """The answer in words: "0.14 s (0.12 s to 0.15 s)", "beyond 3 s", "between 0.1 s and 0.4 s"."""
        search = self.search
        if self.answer is Answer.BEYOND:
            return f"beyond {search.text(search.steps)}"
        if self.answer is Answer.BELOW:
            return f"below {search.text(0)}"
        low = None if self.low is None else self._text(self.low)
        high = None if self.high is None else self._text(self.high)
        if low is None and high is None:
            return self.answer.value.replace("_", " ") if self.value is None else f"{self._text(self.value)} (open)"
        if self.value is None:
            return f"between {low} and {high}" if low and high else f"above {low}" if low else f"below {high}"
        return f"{self._text(self.value)} ({low or 'open'} to {high or 'open'})"

    def _text(self, value: float) -> str:
        """With one digit more than the tolerance has."""
        exponent = self.search.tolerance.normalize().as_tuple().exponent
        digits = max(0, 1 - exponent) if isinstance(exponent, int) else 0
        return f"{value:.{digits}f} {self.search.unit}".rstrip()


class CriticalPlan(Plan):
    """Asks for the runs of all searches; `results` says what they have come to so far."""

    def __init__(self, search: CriticalSearch, others: Sequence[Point] = (Point(()),), position: int = 0) -> None:
        """others: the combinations of the other axes; position: place of the searched axis among all axes."""
        self.search = search
        self.others = tuple(others)
        self.position = position
        self._start = _Step(search, ())

    def point(self, other: Point, index: int) -> Point:
        """The place on the grid of value number `index` of a search."""
        before, after = other.parameters[: self.position], other.parameters[self.position :]
        return Point((*before, (self.search.axis, self.search.text(index)), *after))

    def wanted(self, known: Known) -> list[Wanted]:
        """All runs of all searches so far; a batch is looked at when all of its runs are known."""
        return [one for other in self.others for one in self._walk(other, known)[0]]

    def results(self, known: Known) -> tuple[CriticalResult, ...]:
        """One for each of the other combinations, in their order; also of a search that is not finished yet."""
        found = []
        for other in self.others:
            _, batches, over = self._walk(other, known)
            found.append(_result(self.search, other, batches, over))
        return tuple(found)

    def _walk(self, other: Point, known: Known) -> tuple[list[Wanted], tuple[Batch, ...], bool]:
        """(runs wanted, batches that are complete, whether the search is over)."""
        wanted: list[Wanted] = []
        outcomes: dict[Point, dict[int, Outcome]] = {}
        step = self._start
        while step.next:
            complete: list[Batch] = []
            for index in step.next:
                point = self.point(other, index)
                if point not in outcomes:
                    outcomes[point] = {row.number: row.outcome for row in known.get(point, ())}
                numbers = range(len(wanted), len(wanted) + self.search.batch)
                wanted.extend(Wanted(point, number) for number in numbers)
                if all(number in outcomes[point] for number in numbers):
                    found = [outcomes[point][number] for number in numbers]
                    complete.append(Batch(index, tally(found, self.search.outcome)))
            if len(complete) < len(step.next):
                return wanted, step.batches, False
            step = step.after(complete)
        return wanted, step.batches, True


class _Step:
    """Where a search stands after some batches, and, remembered, where it went from there: a pure function of them."""

    def __init__(self, search: CriticalSearch, batches: tuple[Batch, ...]) -> None:
        self.search = search
        self.batches = batches
        self.next = next_batches(search, batches)
        self._after: dict[tuple[Batch, ...], _Step] = {}

    def after(self, complete: Sequence[Batch]) -> "_Step":
        """Where it stands when these batches are known as well."""
        found = tuple(complete)
        if found not in self._after:
            self._after[found] = _Step(self.search, (*self.batches, *found))
        return self._after[found]


def _result(search: CriticalSearch, point: Point, batches: tuple[Batch, ...], over: bool) -> CriticalResult:
    tried = tried_values(search, batches)
    listed = tuple(tried.values())
    if not over:
        return _none(search, point, Answer.UNFINISHED, "runs are missing: go on with the campaign", listed)
    if not any(one.tally.trials for one in listed):
        return _none(search, point, Answer.UNDECIDED, "no run makes a statement", listed)
    fall_p = fall_misfit(levels_of(search, listed), np.random.default_rng(SEED))
    below, above = bracket(search, tried)
    if below > above or (fall_p < DOUBT and (search.method != BISECTION or _against(search, listed, below, above))):
        reason = f"the share of {search.outcome} falls again as {search.axis} rises (p = {fall_p:.2g}): no one value"
        return _none(search, point, Answer.NOT_MONOTONE, reason, listed, fall_p=fall_p)
    if below == search.steps or above == 0:
        found = _outside(search, point, listed, fall_p, beyond=below == search.steps)
    elif search.method == BISECTION:
        found = _bisected(search, point, tried, fall_p)
    else:
        return _fitted(search, point, listed, fall_p)
    against = _against(search, listed, below, above)
    reasons = [found.reason] if found.reason else []
    if against:
        reasons.append(f"against one crossing, by chance or not (p = {fall_p:.2g}): {', '.join(against)}")
    return replace(found, reason="; ".join(reasons))


def _none(
    search: CriticalSearch,
    point: Point,
    answer: Answer,
    reason: str,
    tried: tuple[Tried, ...],
    fit: LogisticFit | None = None,
    fall_p: float | None = None,
    misfit_p: float | None = None,
) -> CriticalResult:
    return CriticalResult(search, point, answer, None, None, None, reason, tried, fit, fall_p, misfit_p)


def _against(search: CriticalSearch, tried: Sequence[Tried], below: int, above: int) -> list[str]:
    """Counts beyond the bracket on the wrong side of the quantile: only there does a fall touch the answer."""
    return [
        f"{one.tally.successes} of {one.tally.trials} at {search.text(one.index)}"
        for one in tried
        if one.tally.trials
        and (
            (one.index > above and one.tally.successes < search.quantile * one.tally.trials)
            or (one.index < below and one.tally.successes > search.quantile * one.tally.trials)
        )
    ]


def _outside(
    search: CriticalSearch, point: Point, tried: tuple[Tried, ...], fall_p: float, *, beyond: bool
) -> CriticalResult:
    end = tried[-1] if beyond else tried[0]
    reason = (
        f"at {search.text(end.index)}, {end.tally.successes} of {end.tally.trials} runs showed {search.outcome}: on "
        f"evidence {'less' if beyond else 'more'} than {search.quantile:.4g} of all"
    )
    low, high = (float(search.high), None) if beyond else (None, float(search.low))
    answer = Answer.BEYOND if beyond else Answer.BELOW
    return CriticalResult(search, point, answer, None, low, high, reason, tried, fall_p=fall_p)


def _bisected(search: CriticalSearch, point: Point, tried: dict[int, Tried], fall_p: float) -> CriticalResult:
    below, above = bracket(search, tried)
    listed = tuple(tried.values())
    low = float(search.value(below)) if below >= 0 else None
    high = float(search.value(above)) if above <= search.steps else None
    if low is None or high is None:
        side = "low" if low is None else "high"
        reason = f"too little evidence for the {side} end within {sum(one.runs for one in listed)} runs"
        return CriticalResult(search, point, Answer.UNDECIDED, None, low, high, reason, listed, fall_p=fall_p)
    place = max(float(below), min(float(above), crossing(search, tried) or 0.0))
    left = math.floor(place)
    right = min(left + 1, search.steps)
    x0, x1 = float(search.value(left)), float(search.value(right))
    value = x0 + (place - left) * (x1 - x0)
    reason = "" if above - below == 1 else "more runs would narrow it: `most` is reached"
    return CriticalResult(search, point, Answer.FOUND, value, low, high, reason, listed, fall_p=fall_p)


def _fitted(search: CriticalSearch, point: Point, tried: tuple[Tried, ...], fall_p: float) -> CriticalResult:
    try:
        fit = logistic_fit(levels_of(search, tried))
    except NotEstimableError as none:
        return _none(search, point, Answer.UNDECIDED, str(none), tried, fall_p=fall_p)
    misfit_p = curve_misfit(fit, np.random.default_rng(SEED))
    if misfit_p < DOUBT:
        reason = f"the shares do not follow a logistic curve (p = {misfit_p:.2g}): search by bisection"
        return _none(search, point, Answer.MISFIT, reason, tried, fit, fall_p, misfit_p)
    interval = fit.quantile_interval(search.quantile, search.confidence)
    if math.isinf(interval.width):
        reason = f"the runs do not show that {search.outcome} depends on {search.axis}"
        return _none(search, point, Answer.UNDECIDED, reason, tried, fit, fall_p, misfit_p)
    if fit.b < 0:
        reason = f"the share of {search.outcome} falls as {search.axis} rises"
        return _none(search, point, Answer.NOT_MONOTONE, reason, tried, fit, fall_p, misfit_p)
    value, low, high = _inside(search, fit.quantile(search.quantile), interval)
    answer, reason = (
        (Answer.UNDECIDED, "the estimate lies outside of the axis") if value is None else (Answer.FOUND, "")
    )
    if value is not None and interval.width > float(search.tolerance):
        reason = "more runs would narrow it: `most` is reached"
    return CriticalResult(search, point, answer, value, low, high, reason, tried, fit, fall_p, misfit_p)


def _inside(
    search: CriticalSearch, value: float, interval: Interval
) -> tuple[float | None, float | None, float | None]:
    """(value, low, high), None for a value outside of the axis, where nothing was tried, and for an end beyond it."""
    first, last = float(search.low), float(search.high)
    low = None if interval.low < first else min(interval.low, last)
    high = None if interval.high > last else max(interval.high, first)
    return value if first <= value <= last else None, low, high
