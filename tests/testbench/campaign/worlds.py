"""Worlds in which the share of failures is known, and plans that are played in them."""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from testbench.campaign.plans.critical import CriticalPlan, CriticalResult
from testbench.campaign.plans.search import CriticalSearch
from testbench.campaign.records import Known, Outcome, Plan, Point, RunRow, Wanted

Draw = Callable[[Wanted], Outcome]


@dataclass(frozen=True)
class Logistic:
    """P = 1 / (1 + exp(-slope (x - middle)))."""

    middle: float
    slope: float

    def __call__(self, x: float) -> float:
        return (1 + math.tanh(self.slope * (x - self.middle) / 2)) / 2

    def at(self, q: float) -> float:
        return self.middle + math.log(q / (1 - q)) / self.slope


def row(wanted: Wanted, outcome: Outcome) -> RunRow:
    return RunRow(f"{wanted.point}/{wanted.number}", wanted.point, wanted.number, wanted.number + 1, outcome)


def play(plan: Plan, draw: Draw) -> dict[Point, list[RunRow]]:
    """Every run that the plan wants, until it wants no more."""
    known: dict[Point, list[RunRow]] = {}
    made: set[Wanted] = set()
    while True:
        wanted = [one for one in plan.wanted(known) if one not in made]
        if not wanted:
            return known
        for one in wanted:
            known.setdefault(one.point, []).append(row(one, draw(one)))
            made.add(one)


def failing(world: Callable[[float], float], seed: int, axis: str = "duration") -> Draw:
    """Run k fails with the world's share at its value of the axis; each run has a draw of its own."""

    def draw(wanted: Wanted) -> Outcome:
        value = float(dict(wanted.point.parameters)[axis].split()[0])
        chance = np.random.default_rng((seed, wanted.number)).random()
        return Outcome.FAILURE_SILENT if chance < world(value) else Outcome.MASKED

    return draw


def searched(search: CriticalSearch, world: Callable[[float], float], seed: int) -> CriticalResult:
    """What the search comes to in a world."""
    plan = CriticalPlan(search)
    known: Known = play(plan, failing(world, seed))
    (result,) = plan.results(known)
    return result
