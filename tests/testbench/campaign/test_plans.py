"""Plans are functions of what is known: a grid wants everything, a rule wants batch after batch."""

import random

import pytest

from testbench.campaign.file.rules import FixedRuns, Until
from testbench.campaign.plans.grid import BLOCK, GridPlan, SequentialPlan
from testbench.campaign.records import Outcome, Plan, Point, RunRow, Wanted
from testbench.campaign.statistics.shares import wilson

A, B = Point((("x", "1"),)), Point((("x", "2"),))


def row(wanted: Wanted, outcome: Outcome) -> RunRow:
    return RunRow(f"{wanted}", wanted.point, wanted.number, wanted.number, outcome)


def driven(plan: Plan, outcome: dict[Point, list[Outcome]], order: random.Random | None = None) -> dict[Point, int]:
    """Ask and answer until nothing is missing: how many runs of each point were made."""
    known: dict[Point, list[RunRow]] = {}
    while True:
        missing = [one for one in plan.wanted(known) if one.number not in [r.number for r in known.get(one.point, [])]]
        if not missing:
            return {point: len(rows) for point, rows in known.items()}
        one = missing[0] if order is None else order.choice(missing)
        rows = known.setdefault(one.point, [])
        rows.append(row(one, outcome[one.point][one.number]))
        rows.sort(key=lambda found: found.number)


def test_grid_wants_all_runs_block_by_block() -> None:
    """Each run once; an early look finds runs at all points, and each point's come in blocks."""
    wanted = GridPlan([A, B], FixedRuns(BLOCK + 2)).wanted({})
    assert len(wanted) == len(set(wanted)) == 2 * (BLOCK + 2)
    assert [one.point for one in wanted[: 2 * BLOCK]] == [A] * BLOCK + [B] * BLOCK
    assert [one.number for one in wanted[2 * BLOCK :]] == [BLOCK, BLOCK + 1] * 2


FAIL, MASKED, INVALID = Outcome.FAILURE_SILENT, Outcome.MASKED, Outcome.INVALID
RULE = Until("failure", width=0.3, batch=10, least=20, most=200)


def test_rule_ends_a_point_when_its_interval_is_narrow() -> None:
    """No failure at A, every other run at B: A needs few runs, B as many as its interval takes, no batch more."""
    outcomes = {A: [MASKED] * 200, B: [FAIL, MASKED] * 100}
    made = driven(SequentialPlan([A, B], RULE), outcomes)
    assert made[A] == 20
    assert wilson(0, 20).width <= RULE.width
    narrow = next(runs for runs in range(20, 201, 10) if wilson(runs // 2, runs).width <= RULE.width)
    assert made[B] == narrow > 20


def test_rule_counts_runs_that_make_a_statement() -> None:
    """Invalid runs narrow nothing, and count against `most`."""
    outcomes = {A: [INVALID] * 30 + [MASKED] * 170, B: [INVALID] * 200}
    made = driven(SequentialPlan([A, B], RULE), outcomes)
    assert wilson(0, 10).width <= RULE.width
    assert made == {A: 40, B: 200}


@pytest.mark.parametrize("seed", range(5))
def test_rule_wants_the_same_in_whatever_order_runs_finish(seed: int) -> None:
    """A batch is judged when all of it is there."""
    rng = random.Random(seed)
    outcomes = {point: [FAIL if rng.random() < 0.2 else MASKED for _ in range(200)] for point in (A, B)}
    plan = SequentialPlan([A, B], RULE)
    assert driven(plan, outcomes, random.Random(seed)) == driven(plan, outcomes)


def test_rule_never_wants_more_than_most() -> None:
    """The last batch is cut."""
    outcomes = {A: [FAIL, MASKED] * 100}
    assert driven(SequentialPlan([A], Until("failure", 0.01, 30, 20, 100)), outcomes) == {A: 100}
