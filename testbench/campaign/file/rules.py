"""What a campaign file asks for, as plain data: how many runs, when they end, which figures."""

from dataclasses import dataclass
from typing import Final

from testbench.campaign.plans.search import CombinationSearch, CriticalSearch
from testbench.campaign.records import NO_STATEMENT, Outcome

FAILURE: Final = "failure"
"""Where a rule, a figure or a share names it: any of the failures."""

OUTCOMES: Final = tuple(outcome.value for outcome in Outcome if outcome not in NO_STATEMENT)
"""What a rule may name."""


@dataclass(frozen=True, slots=True)
class FixedRuns:
    """So many runs a point."""

    runs: int


@dataclass(frozen=True, slots=True)
class Until:
    """Runs in batches, until the 95 % Wilson interval of the share of `outcome` is at most `width` wide.

    A point gets at least `least` and at most `most` runs, those that make no statement included.
    """

    outcome: str
    width: float
    batch: int
    least: int
    most: int


Rule = FixedRuns | Until | CriticalSearch | CombinationSearch


@dataclass(frozen=True, slots=True)
class StopEarly:
    """When a run is not carried on: `grace_s` after the outcome `on`."""

    on: str
    grace_s: float


@dataclass(frozen=True, slots=True)
class Figure:
    """y over x. x: an axis; y: a metric, a number of a run, or an outcome, whose share is drawn.

    low, high: the part of x that is shown and fitted (SI), both included; fit: "quadratic" or ""; paper: (x in SI,
    published number).
    """

    x: str
    y: str
    low: float
    high: float
    fit: str
    paper: tuple[tuple[float, float], ...]
