"""What a campaign asks for, as plain data: how many runs, what is searched, which figures; read by testbench.campaign.schema."""

from dataclasses import dataclass
from typing import Final, Literal

from testbench.campaign.records import FAILURES, NO_STATEMENT, Outcome

FAILURE: Final = "failure"

OUTCOMES: Final = tuple(outcome.value for outcome in Outcome if outcome not in NO_STATEMENT)
"""What a rule may name; `failure` stands for all failures."""


def counts_as(outcome: Outcome, name: str) -> bool:
    """Whether a run of that outcome counts for a rule about `name`."""
    return outcome in FAILURES if name == FAILURE else outcome.value == name


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


@dataclass(frozen=True, slots=True)
class Critical:
    """The value of an axis at which `quantile` of the runs have the outcome; for every point of the other axes.

    low, high: the ends between which it is looked for, tolerance: how exactly, as texts with their unit.
    """

    axis: str
    low: str
    high: str
    outcome: str
    quantile: float
    method: Literal["bisection", "logistic"]
    batch: int
    most: int
    tolerance: str


@dataclass(frozen=True, slots=True)
class Combinations:
    """The smallest sets of injectors that lead to the outcome: `runs` a set, at most `most` injectors in one.

    Its points have the axis `injectors`, with values such as "a + b"; see testbench.campaign.settings.
    """

    injectors: tuple[str, ...]
    outcome: str
    runs: int
    most: int


Rule = FixedRuns | Until | Critical | Combinations


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
