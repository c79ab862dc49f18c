"""What a campaign searches for, as its file says it: plain data, checked where it is made.

The searches themselves are beside this: `critical` (the value of an axis at which an outcome has a given share) and
`combinations` (the smallest sets of injectors that bring an outcome about).
"""

import math
from dataclasses import dataclass
from decimal import Decimal
from fractions import Fraction
from typing import Final

from testbench.campaign.statistics.shares import check_confidence, outcomes_named

BISECTION: Final = "bisection"
LOGISTIC: Final = "logistic"
METHODS: Final = (BISECTION, LOGISTIC)
SCANNED: Final = 5
"""Values, from end to end of the axis, of which each gets one batch before the search proper begins."""
MAX_STEPS: Final = 1_000_000
"""Most values on the grid of a search; 2^20 of them are 20 halvings."""


@dataclass(frozen=True, slots=True)
class CriticalSearch:
    """Which value of `axis` has an `outcome` in a share `quantile` of the runs, for every combination of other axes.

    low, high: range of the axis; tolerance: how wide the answer may be, and the grid of values tried: low,
    low + tolerance, ..., and high itself; all three in `unit` ("" for none). outcome: as a rule names it; its share
    rises with the axis. quantile: 0..1, without the ends. method: "bisection" (decides value by value on evidence,
    assumes nothing of the curve but one crossing) or "logistic" (a fitted curve; fewer runs, wrong if the curve is).
    batch: runs at a value at a time; most: runs of one search, those without a statement included. confidence: of the
    answer. Raises ValueError.
    """

    axis: str
    low: Decimal
    high: Decimal
    tolerance: Decimal
    unit: str
    outcome: str = "failure"
    quantile: float = 0.5
    method: str = BISECTION
    batch: int = 10
    most: int = 400
    confidence: float = 0.95

    def __post_init__(self) -> None:
        outcomes_named(self.outcome)
        check_confidence(self.confidence)
        if not all(number.is_finite() for number in (self.low, self.high, self.tolerance)):
            raise ValueError("from, to and tolerance: finite numbers are allowed")
        if not self.low < self.high:
            raise ValueError(f"from {self.low} to {self.high} {self.unit}: `from` must be below `to`")
        if not 0 < self.tolerance <= self.high - self.low:
            raise ValueError(
                f"tolerance: {self.tolerance} {self.unit} given; allowed is more than 0, and at most the range of the "
                f"axis, {self.high - self.low} {self.unit}"
            )
        if (self.high - self.low) / self.tolerance > MAX_STEPS:
            raise ValueError(f"tolerance: {self.tolerance} {self.unit} makes more than {MAX_STEPS} values of the axis")
        if not 0 < self.quantile < 1:
            raise ValueError(f"quantile: {self.quantile} given; allowed is more than 0 % and less than 100 %")
        if self.method not in METHODS:
            raise ValueError(f"method: {self.method!r} given; allowed: {', '.join(METHODS)}")
        if self.batch < 1:
            raise ValueError(f"batch: {self.batch} given; allowed from 1 up")
        if self.most < SCANNED * self.batch:
            raise ValueError(f"most: {self.most} given; allowed from {SCANNED} batches ({SCANNED * self.batch}) up")

    @property
    def steps(self) -> int:
        """Number of the last value of the grid; the first is 0."""
        return math.ceil(Fraction(self.high - self.low) / Fraction(self.tolerance))

    def value(self, index: int) -> Decimal:
        """Value number `index` of the grid, exactly, in `unit`."""
        return min(self.low + index * self.tolerance, self.high)

    def text(self, index: int) -> str:
        """The same as a scenario file says it: "0.1375 s"."""
        return f"{self.value(index).normalize():f} {self.unit}".rstrip()


@dataclass(frozen=True, slots=True)
class CombinationSearch:
    """Which smallest sets of `injectors` bring `outcome` about, the other listed ones being switched off.

    runs: of every set; a set brings the outcome about if at least `least` of its runs show it. most: largest size of a
    set that is tried. Injectors of the scenario that are not listed stay as they are. Raises ValueError.
    """

    injectors: tuple[str, ...]
    outcome: str = "failure"
    runs: int = 5
    most: int = 2
    least: int = 1

    def __post_init__(self) -> None:
        outcomes_named(self.outcome)
        if not self.injectors:
            raise ValueError("injectors: none given; name those that may be combined")
        twice = sorted({name for name in self.injectors if self.injectors.count(name) > 1})
        if twice:
            raise ValueError(f"injectors: {', '.join(twice)} given twice")
        if self.runs < 1:
            raise ValueError(f"runs: {self.runs} given; allowed from 1 up")
        if not 1 <= self.most <= len(self.injectors):
            raise ValueError(f"most: {self.most} given; allowed 1..{len(self.injectors)}, the number of injectors")
        if not 1 <= self.least <= self.runs:
            raise ValueError(f"least: {self.least} given; allowed 1..{self.runs}, the number of runs")
