"""Shares: how many of the runs showed an outcome, and between which bounds the true share lies.

A share is estimated from runs that are independent draws of the same experiment, such as the runs of one point, each
with a seed of its own. All intervals are two-sided with equal tails unless the name says otherwise.
Sources: E. B. Wilson, J. Am. Stat. Assoc. 22 (1927) 209; C. J. Clopper and E. S. Pearson, Biometrika 26 (1934) 404;
L. D. Brown, T. T. Cai, A. DasGupta, Stat. Sci. 16 (2001) 101, sections 3.1.1 and 4.2.1 (what to use when);
J. A. Hanley, A. Lippman-Hand, J. Am. Med. Assoc. 249 (1983) 1743 (rule of three). More in docs/statistics.md.
Left out: shares of runs that depend on each other (several points on the same seeds taken together).
"""

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from statistics import NormalDist
from typing import Final

from testbench.campaign.records import FAILURES, NO_STATEMENT, Outcome
from testbench.errors import BenchError

__all__ = [
    "Interval",
    "NotEstimableError",
    "Tally",
    "bound_without_events",
    "check_confidence",
    "clopper_pearson",
    "outcomes_named",
    "runs_for_width",
    "runs_without_events",
    "tally",
    "wilson",
]

MAX_RUNS: Final = 10**9
"""Beyond this, a number of runs is no plan."""


class NotEstimableError(BenchError):
    """The data at hand do not give the number that was asked for; the message says why and what would."""


@dataclass(frozen=True, slots=True)
class Interval:
    """Where a true value lies, both ends included. confidence: two-sided, 0..1; method: in words."""

    low: float
    high: float
    confidence: float
    method: str

    def __post_init__(self) -> None:
        if not self.low <= self.high:  # also refuses NaN
            raise ValueError(f"an interval from {self.low} to {self.high}; low must not be above high")

    @property
    def width(self) -> float:
        """From end to end."""
        return self.high - self.low


@dataclass(frozen=True, slots=True)
class Tally:
    """What was counted. trials: runs that make a statement; successes: of them those with the outcome asked for.

    excluded: runs that make no statement (hang, invalid, crashed); a report shows them beside the share.
    """

    successes: int
    trials: int
    excluded: int = 0

    @property
    def share(self) -> float | None:
        """successes / trials; None without trials."""
        return self.successes / self.trials if self.trials else None


def outcomes_named(name: str) -> frozenset[Outcome]:
    """What a rule means by `name`: "failure" is any failure, another outcome itself; raises ValueError otherwise.

    Outcomes that make no statement cannot be asked for: their runs are in no share.
    """
    if name == Outcome.FAILURE.value:
        return FAILURES
    allowed = [outcome.value for outcome in Outcome if outcome not in NO_STATEMENT]
    if name not in allowed:
        raise ValueError(f"{name!r} is no outcome of which a share can be taken; allowed: {', '.join(allowed)}")
    return frozenset({Outcome(name)})


def tally(outcomes: Iterable[Outcome], name: str) -> Tally:
    """How many of the outcomes are `name`; raises ValueError for a name that `outcomes_named` refuses."""
    wanted = outcomes_named(name)
    successes = trials = excluded = 0
    for outcome in outcomes:
        if outcome in NO_STATEMENT:
            excluded += 1
        else:
            trials += 1
            successes += outcome in wanted
    return Tally(successes, trials, excluded)


def wilson(successes: int, trials: int, confidence: float = 0.95) -> Interval:
    """Wilson score interval of a share: all p with |successes/trials - p| <= z sqrt(p (1 - p) / trials).

    z is the (1 + confidence) / 2 quantile of the normal distribution; without continuity correction. Its mean coverage
    is near `confidence`, but for single p it can be below: where at least `confidence` must be held, take
    clopper_pearson. Raises NotEstimableError for no trials, ValueError for impossible counts.
    """
    _check_counts(successes, trials)
    low, high = _wilson_ends(successes, trials, check_confidence(confidence))
    return Interval(low, high, confidence, "Wilson")


def clopper_pearson(successes: int, trials: int, confidence: float = 0.95) -> Interval:
    """Clopper-Pearson ("exact") interval of a share: quantiles of two beta distributions, equal tails.

    Covers every p with at least `confidence`, usually more. Raises NotEstimableError for no trials, ValueError for
    impossible counts.
    """
    _check_counts(successes, trials)
    low, high = _clopper_pearson_ends(successes, trials, check_confidence(confidence))
    return Interval(low, high, confidence, "Clopper-Pearson")


def runs_for_width(width: float, share: float | None = None, confidence: float = 0.95, method: str = "wilson") -> int:
    """The smallest number of runs from which on the interval is at most `width` wide (0 < width < 1).

    share None: whatever comes out, that is, at the widest interval a count can give, which is that of n // 2 of n.
    Else the interval at an observed share of exactly `share`: n x share is not rounded to a count, both formulas hold
    between the counts and fall with n. What is observed will differ from `share`: this plans, it promises nothing.
    method: "wilson" or "clopper_pearson". Raises ValueError for arguments out of range.
    """
    level = check_confidence(confidence)
    if not 0 < width < 1:
        raise ValueError(f"a width of {width} given; allowed is more than 0 and less than 1")
    if share is not None and not 0 <= share <= 1:
        raise ValueError(f"a share of {share} given; allowed 0..1, or None for whatever comes out")
    if method not in _ENDS:
        raise ValueError(f"method {method!r} given; allowed: {', '.join(_ENDS)}")
    ends = _ENDS[method]

    def too_wide(trials: int) -> bool:
        low, high = ends(trials // 2 if share is None else share * trials, trials, level)
        return high - low > width

    least, most = 0, 2  # not 1: one run has a narrower interval than one of two
    while too_wide(most):
        least, most = most, 2 * most
        if most > MAX_RUNS:
            raise ValueError(f"a width of {width} takes more than {MAX_RUNS:.0e} runs")
    while most - least > 1:
        middle = (least + most) // 2
        least, most = (middle, most) if too_wide(middle) else (least, middle)
    return most


def bound_without_events(trials: int, confidence: float = 0.95) -> float:
    """One-sided upper bound of a share after `trials` runs that all came out without the event: 1 - (1 - c)^(1/n).

    For 95 % it is just below 3 / trials, the rule of three. Raises NotEstimableError for no trials.
    """
    _check_counts(0, trials)
    return -math.expm1(math.log1p(-check_confidence(confidence)) / trials)


def runs_without_events(share: float, confidence: float = 0.95) -> int:
    """The smallest number of runs which, all without the event, bound its share to at most `share` (one-sided)."""
    if not 0 < share < 1:
        raise ValueError(f"a share of {share} given; allowed is more than 0 and less than 1")
    estimate = math.log1p(-check_confidence(confidence)) / math.log1p(-share)
    if estimate > MAX_RUNS:
        raise ValueError(f"a share of {share} takes more than {MAX_RUNS:.0e} runs")
    runs = max(1, math.floor(estimate) - 1)  # below by rounding at most; the bound itself decides
    while bound_without_events(runs, confidence) > share:
        runs += 1
    return runs


def check_confidence(confidence: float) -> float:
    """The confidence level itself; raises ValueError unless it is above 0 and below 1 (0.95, not 95)."""
    if not 0 < confidence < 1:
        raise ValueError(f"a confidence of {confidence} given; allowed is more than 0 and less than 1, such as 0.95")
    return confidence


def _check_counts(successes: int, trials: int) -> None:
    for count in (successes, trials):
        if isinstance(count, bool) or not isinstance(count, int):
            raise ValueError(f"{count!r} given; a count is a whole number")
    if trials == 0 and successes == 0:
        raise NotEstimableError("no run makes a statement: there is no share, and no interval of it; make runs")
    if not 0 <= successes <= trials:
        raise ValueError(f"{successes} of {trials} is no share; allowed 0..trials")


def _wilson_ends(successes: float, trials: int, confidence: float) -> tuple[float, float]:
    square = NormalDist().inv_cdf((1 + confidence) / 2) ** 2
    middle = successes + square / 2
    reach = math.sqrt(square * (successes * (trials - successes) / trials + square / 4))
    low = (middle - reach) / (trials + square) if successes > 0 else 0.0  # exactly 0 and 1 at the ends
    high = (middle + reach) / (trials + square) if successes < trials else 1.0
    return max(0.0, low), min(1.0, high)


def _clopper_pearson_ends(successes: float, trials: int, confidence: float) -> tuple[float, float]:
    from scipy.special import betaincinv  # slow to load, and Wilson does without

    tail = (1 - confidence) / 2
    low = float(betaincinv(successes, trials - successes + 1, tail)) if successes > 0 else 0.0
    high = float(betaincinv(successes + 1, trials - successes, 1 - tail)) if successes < trials else 1.0
    return low, high


_ENDS: Final[dict[str, Callable[[float, int, float], tuple[float, float]]]] = {
    "wilson": _wilson_ends,
    "clopper_pearson": _clopper_pearson_ends,
}
