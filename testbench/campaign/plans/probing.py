"""Where to run next, to find the value of an axis at which an outcome has a given share q.

Both methods begin with a scan, one batch at five values from end to end, and then add a batch at a time; both are
functions of the batches so far alone.
Bisection decides value by value whether P is below or above q, and closes in between. A decision is made when the
evidence, a likelihood ratio mixed over all P on the other side of q, reaches 1 / e: under P <= q the evidence for
P > q is a supermartingale of mean at most 1, so that it ever reaches 1 / e with probability e at most, however often
one looks (Ville's inequality). e is (1 - confidence) / (number of values that may be tried), so that with probability
`confidence` all decisions are right. A value too near the quantile to be decided is closed in from both sides.
Logistic runs where the fitted curve leaves most doubt: at the lower end of the interval, at the estimate, at the upper.
Sources: J. Ville, Étude critique de la notion de collectif (1939), chapter V; H. Robbins, Ann. Math. Stat. 41 (1970)
1397, sections 2 and 5 (mixtures, tests of power one); R. Waeber, P. I. Frazier, S. G. Henderson, SIAM J. Control
Optim. 51 (2013) 2261 (bisection with tests of power one). More in docs/statistics.md.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import Enum
from typing import Final

from testbench.campaign.plans.search import BISECTION, SCANNED, CriticalSearch
from testbench.campaign.statistics.logistic import Level, logistic_fit, rising_shares
from testbench.campaign.statistics.shares import NotEstimableError, Tally

__all__ = ["Batch", "Side", "Tried", "crossing", "next_batches", "scan", "tried_values"]

TURNS: Final = 3
"""One value gets at most this part of all runs before others get their turn."""


class Side(Enum):
    """On which side of q the share at a value is, on evidence."""

    BELOW = "below"
    ABOVE = "above"
    UNDECIDED = "undecided"


@dataclass(frozen=True, slots=True)
class Batch:
    """What came out of one batch at value number `index` of the grid."""

    index: int
    tally: Tally


@dataclass(frozen=True, slots=True)
class Tried:
    """All batches at one value. side: the first decision that its batches led to, one by one; it stands."""

    index: int
    tally: Tally
    side: Side

    @property
    def runs(self) -> int:
        """Those without a statement included."""
        return self.tally.trials + self.tally.excluded


def scan(search: CriticalSearch) -> list[int]:
    """The values of the scan: both ends and what lies evenly between, each once."""
    return sorted({round(number * search.steps / (SCANNED - 1)) for number in range(SCANNED)})


def most_values(search: CriticalSearch) -> int:
    """How many values a bisection may try: the scan, then halvings of two gaps of the scan at most."""
    gap = max(1, -(-search.steps // (SCANNED - 1)))
    return SCANNED + 2 * ((gap - 1).bit_length() + 1)


def tried_values(search: CriticalSearch, batches: Sequence[Batch]) -> dict[int, Tried]:
    """What is known of each value, by rising index."""
    needed = math.log(most_values(search) / (1 - search.confidence))
    tried: dict[int, Tried] = {}
    for batch in batches:
        before = tried.get(batch.index, Tried(batch.index, Tally(0, 0), Side.UNDECIDED))
        counts = Tally(
            before.tally.successes + batch.tally.successes,
            before.tally.trials + batch.tally.trials,
            before.tally.excluded + batch.tally.excluded,
        )
        side = before.side
        if side is Side.UNDECIDED:
            side = next(
                (one for one in (Side.BELOW, Side.ABOVE) if evidence(counts, search.quantile, one) >= needed), side
            )
        tried[batch.index] = Tried(batch.index, counts, side)
    return dict(sorted(tried.items()))


def evidence(tally: Tally, quantile: float, side: Side) -> float:
    """Natural logarithm of the mean likelihood of all shares on `side` of the quantile, over the likelihood of it."""
    from scipy.special import betainc, betaincc, betaln

    above = side is Side.ABOVE
    a, b = tally.successes + 1, tally.trials - tally.successes + 1
    part = float(betaincc(a, b, quantile) if above else betainc(a, b, quantile))
    if part <= 0:
        return -math.inf
    mean = math.log(part) + float(betaln(a, b)) - math.log(1 - quantile if above else quantile)
    return mean - (a - 1) * math.log(quantile) - (b - 1) * math.log1p(-quantile)


def next_batches(search: CriticalSearch, batches: Sequence[Batch]) -> list[int]:
    """The values that get a batch next; none when the search is over, or `most` would be passed."""
    if not batches:
        return scan(search)
    tried = tried_values(search, batches)
    made = sum(one.runs for one in tried.values())
    if made + search.batch > search.most:
        return []
    method = _next_of_bisection if search.method == BISECTION else _next_of_curve
    index = method(search, tried, len(batches))
    return [] if index is None else [index]


def bracket(search: CriticalSearch, tried: Mapping[int, Tried]) -> tuple[int, int]:
    """The highest value decided as below, or -1, and the lowest one decided as above, or the number of values."""
    below = max((one.index for one in tried.values() if one.side is Side.BELOW), default=-1)
    above = min((one.index for one in tried.values() if one.side is Side.ABOVE), default=search.steps + 1)
    return below, above


def crossing(search: CriticalSearch, tried: Mapping[int, Tried]) -> float | None:
    """Where the likeliest never falling shares come to q, between the values as a straight line, in steps of the grid.

    None where no value has a trial; an end of the axis where they stay on one side of q.
    """
    used = [one for one in tried.values() if one.tally.trials]
    if not used:
        return None
    shares = (
        rising_shares(levels_of(search, used)) if len(used) > 1 else (used[0].tally.successes / used[0].tally.trials,)
    )
    after = next((place for place, share in enumerate(shares) if share >= search.quantile), None)
    if after is None:
        return float(search.steps)
    if after == 0:
        return 0.0
    rise = (search.quantile - shares[after - 1]) / (shares[after] - shares[after - 1])
    return used[after - 1].index + rise * (used[after].index - used[after - 1].index)


def levels_of(search: CriticalSearch, tried: Sequence[Tried]) -> list[Level]:
    """The same for fits, x in the unit of the search."""
    return [Level(float(search.value(one.index)), one.tally) for one in tried]


def _next_of_bisection(search: CriticalSearch, tried: Mapping[int, Tried], _: int) -> int | None:
    below, above = bracket(search, tried)
    if above - below <= 1:  # closed in, beyond an end, or contradicting each other
        return None
    inside = [one for one in tried.values() if below < one.index < above]
    fresh = [one for one in inside if one.runs < max(3 * search.batch, search.most // TURNS)]
    if fresh:
        near = crossing(search, tried) or 0.0
        return min(fresh, key=lambda one: (abs(one.index - near), one.index)).index
    edges = [below, *(one.index for one in inside), above]
    low, high = max(((edges[0], edges[1]), (edges[-2], edges[-1])), key=lambda gap: gap[1] - gap[0])
    if high - low > 1 and len(tried) < most_values(search):
        return (low + high) // 2
    if not inside:
        return None
    return max((inside[0], inside[-1]), key=lambda one: _clearest(one.tally, search.quantile)).index


def _clearest(tally: Tally, quantile: float) -> float:
    return max(evidence(tally, quantile, Side.BELOW), evidence(tally, quantile, Side.ABOVE))


def _next_of_curve(search: CriticalSearch, tried: Mapping[int, Tried], batches: int) -> int | None:
    first, last = tried[0], tried[search.steps]
    if first.side is Side.ABOVE or last.side is Side.BELOW:
        return None
    try:
        fit = logistic_fit(levels_of(search, list(tried.values())))
    except NotEstimableError:  # all alike so far: is the end of the axis like that as well?
        return 0 if any(one.tally.successes for one in tried.values()) else search.steps
    interval = fit.quantile_interval(search.quantile, search.confidence)
    if interval.width <= float(search.tolerance):
        return None
    if math.isinf(interval.width):
        return min((last, first), key=lambda one: one.runs).index
    x = (interval.low, fit.quantile(search.quantile), interval.high)[batches % 3]
    place = round((x - float(search.low)) / float(search.tolerance))
    return max(0, min(search.steps, place))
