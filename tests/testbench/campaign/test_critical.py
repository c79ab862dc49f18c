"""Searches for a critical value: in worlds that are known, with both methods; and what they say when there is none."""

import math
from collections.abc import Callable
from dataclasses import replace
from decimal import Decimal

import numpy as np
import pytest
from scipy import integrate, stats

from testbench.campaign.plans.critical import Answer, CriticalPlan, CriticalResult
from testbench.campaign.plans.probing import Side, evidence, most_values
from testbench.campaign.plans.search import METHODS, SCANNED, CriticalSearch
from testbench.campaign.records import Outcome, Point, RunRow, Wanted
from testbench.campaign.statistics.shares import Tally, wilson
from tests.testbench.campaign.worlds import Logistic, failing, play, row, searched

SEARCH = CriticalSearch("duration", Decimal("0.05"), Decimal("3"), Decimal("0.05"), "s", batch=10, most=200)
STEP = 0.7321


def step(x: float) -> float:
    return float(x > STEP)


def holds(result: CriticalResult, true: float) -> bool:
    return (result.low is None or result.low <= true) and (result.high is None or true <= result.high)


# what is searched


def test_values_are_written_as_the_scenario_file_says_them() -> None:
    """Exact decimals on the grid from `low` in steps of the tolerance, `high` the last whatever the tolerance."""
    search = replace(SEARCH, tolerance=Decimal("0.0125"))
    assert [search.text(index) for index in (0, 1, 7, search.steps)] == ["0.05 s", "0.0625 s", "0.1375 s", "3 s"]
    odd = replace(SEARCH, tolerance=Decimal("0.7"))
    assert [odd.text(index) for index in range(odd.steps + 1)] == [
        "0.05 s",
        "0.75 s",
        "1.45 s",
        "2.15 s",
        "2.85 s",
        "3 s",
    ]
    hundreds = CriticalSearch("n", Decimal("0"), Decimal("1e3"), Decimal("100"), "")
    assert [hundreds.text(index) for index in (0, 1, 10)] == ["0", "100", "1000"]


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"low": Decimal(3)}, "must be below"),
        ({"low": Decimal("NaN")}, "finite"),
        ({"tolerance": Decimal(0)}, "tolerance"),
        ({"tolerance": Decimal(4)}, "tolerance"),
        ({"tolerance": Decimal("1e-9")}, "more than 1000000 values"),
        ({"quantile": 0.0}, "quantile"),
        ({"quantile": 1.0}, "quantile"),
        ({"quantile": math.nan}, "quantile"),
        ({"method": "guess"}, "bisection, logistic"),
        ({"batch": 0}, "batch"),
        ({"most": 49}, "from 5 batches"),
        ({"confidence": 95.0}, "confidence"),
        ({"outcome": "crashed"}, "no outcome"),
    ],
)
def test_a_search_that_is_none_is_refused(wrong: dict[str, object], message: str) -> None:
    """What was given, what is allowed."""
    with pytest.raises(ValueError, match=message):
        replace(SEARCH, **wrong)  # type: ignore[arg-type]


# evidence


@pytest.mark.parametrize(
    ("successes", "trials", "q"), [(0, 0, 0.5), (3, 10, 0.5), (0, 12, 0.1), (9, 10, 0.5), (40, 60, 0.9)]
)
def test_evidence_is_the_mean_likelihood_ratio(successes: int, trials: int, q: float) -> None:
    """Against numerical integration over the shares on each side of q."""

    def ratio(p: float) -> float:
        return float(stats.binom.pmf(successes, trials, p) / stats.binom.pmf(successes, trials, q))

    for side, low, high in ((Side.BELOW, 0, q), (Side.ABOVE, q, 1)):
        mean = integrate.quad(ratio, low, high)[0] / (high - low)
        assert evidence(Tally(successes, trials), q, side) == pytest.approx(math.log(mean), abs=1e-7)


def wrong_decisions(decided: Callable[[int, int], bool], p: float, runs: int) -> float:
    """Exactly: the probability that a rule, asked after every run, ever decides, where it should not."""
    chances = {0: 1.0}  # successes -> probability, of the courses that are not decided
    total = 0.0
    for trials in range(1, runs + 1):
        after: dict[int, float] = {}
        for successes, chance in chances.items():
            after[successes] = after.get(successes, 0) + chance * (1 - p)
            after[successes + 1] = after.get(successes + 1, 0) + chance * p
        total += sum(chance for successes, chance in after.items() if decided(successes, trials))
        chances = {successes: chance for successes, chance in after.items() if not decided(successes, trials)}
    return total


@pytest.mark.parametrize("q", [0.1, 0.5])
def test_decisions_are_wrong_as_seldom_as_promised_however_often_one_looks(q: float) -> None:
    """P(ever decided as above | P = q) <= e over 150 looks; the Wilson interval, asked as often, breaks the promise."""
    error = 0.05

    def on_evidence(successes: int, trials: int) -> bool:
        return evidence(Tally(successes, trials), q, Side.ABOVE) >= math.log(1 / error)

    def by_wilson(successes: int, trials: int) -> bool:
        return wilson(successes, trials, 1 - 2 * error).low > q

    assert 0.005 < wrong_decisions(on_evidence, q, 150) <= error
    assert wrong_decisions(by_wilson, q, 150) > 2 * error


# what is found


def test_bisection_closes_in_on_a_step() -> None:
    """To one step of the grid, in a scan and two batches at each halving; the estimate lies inside."""
    for seed in range(3):
        result = searched(replace(SEARCH, tolerance=Decimal("0.01"), most=400), step, seed)
        assert result.answer is Answer.FOUND
        assert (result.low, result.high) == (0.73, 0.74)
        assert result.value is not None
        assert 0.73 <= result.value <= 0.74
        assert result.runs <= 5 * 10 + 2 * 10 + 7 * 20
        assert result.reason == ""
        assert result.text == f"{result.value:.3f} s (0.730 s to 0.740 s)"


@pytest.mark.long
@pytest.mark.parametrize("quantile", [0.5, 0.2])
@pytest.mark.parametrize("method", METHODS)
def test_the_interval_holds_the_true_value(method: str, quantile: float) -> None:
    """Eight searches in a logistic world: bisection misses none (it promises more than 95 %), the curve two at most."""
    world = Logistic(1.0, 12)
    results = [searched(replace(SEARCH, method=method, quantile=quantile), world, seed) for seed in range(8)]
    claims = [one for one in results if one.low is not None or one.high is not None]
    assert len(claims) >= 7
    missed = sum(not holds(one, world.at(quantile)) for one in claims)
    assert missed <= (0 if method == "bisection" else 2)
    assert all(one.runs <= SEARCH.most for one in results)
    errors = [one.value - world.at(quantile) for one in results if one.value is not None]
    assert len(errors) >= 6
    assert math.sqrt(float(np.mean(np.square(errors)))) < 0.15


@pytest.mark.parametrize("method", METHODS)
def test_a_value_outside_of_the_axis_is_a_result(method: str) -> None:
    """Never failing: beyond 3 s; always: below 0.05 s; both in a few batches, saying on what."""
    never = searched(replace(SEARCH, method=method), lambda x: 0.0, 1)
    assert (never.answer, never.value, never.low, never.high) == (Answer.BEYOND, None, 3.0, None)
    assert never.text == "beyond 3 s"
    assert never.reason == "at 3 s, 0 of 20 runs showed failure: on evidence less than 0.5 of all"
    always = searched(replace(SEARCH, method=method), lambda x: 1.0, 1)
    assert (always.answer, always.value, always.low, always.high) == (Answer.BELOW, None, None, 0.05)
    assert always.text == "below 0.05 s"
    assert max(never.runs, always.runs) == 60


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize(
    "world", [lambda x: float(0.4 < x < 1.7), lambda x: 1 - step(x), lambda x: 0.95 if 0.6 < x < 1.2 else 0.05]
)
def test_a_share_that_falls_again_has_no_critical_value(method: str, world: Callable[[float], float]) -> None:
    """A hump, a fall: said so, without a number."""
    result = searched(replace(SEARCH, method=method), world, 2)
    assert result.answer is Answer.NOT_MONOTONE
    assert (result.value, result.low, result.high) == (None, None, None)
    assert "falls again as duration rises" in result.reason
    assert result.text == "not monotone"


def test_a_fall_that_stays_above_the_quantile_is_none_for_bisection_and_a_misfit_for_a_curve() -> None:
    """0, then 1, then 0.75: there is one crossing of 50 %, and no logistic curve."""

    def world(x: float) -> float:
        return 0.0 if x < 0.6 else 1.0 if x < 2 else 0.75

    found = searched(SEARCH, world, 3)
    assert found.answer is Answer.FOUND
    assert holds(found, 0.6)
    fitted = searched(replace(SEARCH, method="logistic"), world, 3)
    assert fitted.answer in (Answer.NOT_MONOTONE, Answer.MISFIT)
    assert fitted.value is None


@pytest.mark.parametrize("method", METHODS)
def test_half_of_the_runs_everywhere_decide_nothing(method: str) -> None:
    """P = q at every value: undecided after `most` runs, not a number."""
    result = searched(replace(SEARCH, method=method), lambda x: 0.5, 4)
    assert (result.answer, result.value) == (Answer.UNDECIDED, None)
    assert result.reason != ""


def test_counts_that_speak_against_one_crossing_are_named() -> None:
    """Beyond 3 s by the last value, though half of the runs failed in the middle of the axis: the reason says so."""

    def draw(wanted: Wanted) -> Outcome:
        middle = ("duration", "1.55 s") in wanted.point.parameters
        return Outcome.FAILURE if middle and wanted.number % 10 < 5 else Outcome.MASKED

    plan = CriticalPlan(replace(SEARCH, quantile=0.45))
    (result,) = plan.results(play(plan, draw))
    if result.answer is Answer.BEYOND:
        assert "5 of 10 at 1.55 s" in result.reason
    else:
        assert result.answer is Answer.NOT_MONOTONE


# runs


@pytest.mark.long
def test_runs_have_numbers_of_their_own_within_a_search() -> None:
    """No seed twice in one search, whatever the value: fits take runs as independent. 0, 1, 2, ... without a gap."""
    for method in METHODS:
        plan = CriticalPlan(replace(SEARCH, method=method))
        known = play(plan, failing(Logistic(1.0, 12), 5))
        numbers = sorted(one.number for rows in known.values() for one in rows)
        assert numbers == list(range(len(numbers)))
        assert len(numbers) <= SEARCH.most


def test_the_first_runs_are_a_scan_from_end_to_end() -> None:
    """One batch at each of five values."""
    wanted = CriticalPlan(SEARCH).wanted({})
    assert len(wanted) == SCANNED * SEARCH.batch
    values = dict.fromkeys(dict(one.point.parameters)["duration"] for one in wanted)
    assert list(values) == ["0.05 s", "0.8 s", "1.55 s", "2.25 s", "3 s"]
    narrow = replace(SEARCH, low=Decimal("2.9"), tolerance=Decimal("0.1"))
    assert len(CriticalPlan(narrow).wanted({})) == 2 * SEARCH.batch


@pytest.mark.long
@pytest.mark.parametrize("method", METHODS)
def test_a_search_goes_on_where_it_was_and_in_any_order(method: str) -> None:
    """After every number of finished runs a new plan wants the same; rows added backwards change nothing."""
    search = replace(SEARCH, method=method)
    plan = CriticalPlan(search)
    known = play(plan, failing(Logistic(1.0, 12), 6))
    wanted = plan.wanted(known)
    rows = {one.number: one for of_point in known.values() for one in of_point}
    for done in (0, 7, 50, 55, 60, 117):
        part: dict[Point, list[RunRow]] = {}
        for number in sorted(rows, reverse=True):
            if number < done:
                part.setdefault(rows[number].point, []).append(rows[number])
        again = CriticalPlan(search).wanted(part)
        assert again == wanted[: len(again)]
        assert len(again) == (50 if done < 50 else 10 * (done // 10) + 10)
        assert plan.wanted(part) == again
    assert CriticalPlan(search).results(known) == plan.results(known)


def test_a_search_that_is_not_finished_says_so() -> None:
    """Runs are missing: no value yet, what was tried so far is shown."""
    plan = CriticalPlan(SEARCH)
    known: dict[Point, list[RunRow]] = {}
    for one in plan.wanted({}):
        known.setdefault(one.point, []).append(row(one, Outcome.MASKED))
    (result,) = plan.results(known)
    assert (result.answer, result.value, result.runs) == (Answer.UNFINISHED, None, 50)
    assert plan.results({})[0].answer is Answer.UNFINISHED


@pytest.mark.long
@pytest.mark.parametrize("method", METHODS)
def test_runs_without_a_statement_are_in_no_share_and_end_the_search_at_its_most(method: str) -> None:
    """All invalid: undecided after `most` runs. One in four: the answer rests on the others, the rest is counted."""
    plan = CriticalPlan(replace(SEARCH, method=method))
    (none,) = plan.results(play(plan, lambda wanted: Outcome.INVALID))
    assert (none.answer, none.runs, none.excluded) == (Answer.UNDECIDED, SEARCH.most, SEARCH.most)
    assert none.reason == "no run makes a statement"
    fail = failing(step, 7)
    known = play(plan, lambda wanted: Outcome.HANG if wanted.number % 4 == 0 else fail(wanted))
    (some,) = plan.results(known)
    assert some.answer is Answer.FOUND
    assert holds(some, STEP)
    assert some.excluded == sum(one.tally.excluded for one in some.tried) == -(-some.runs // 4)


def test_a_map_has_one_search_for_each_combination_of_the_other_axes() -> None:
    """In their order, the searched axis at its place among them; the same seeds for each."""
    others = [Point((("phase", phase), ("joint", "knee"))) for phase in ("0 %", "50 %")]
    plan = CriticalPlan(SEARCH, others, position=1)

    def draw(wanted: Wanted) -> Outcome:
        assert [axis for axis, _ in wanted.point.parameters] == ["phase", "duration", "joint"]
        later = wanted.point.parameters[0] == ("phase", "50 %")
        return failing(lambda x: float(x > (2.1 if later else 0.31)), 8)(wanted)

    early, late = plan.results(play(plan, draw))
    assert (early.point, late.point) == tuple(others)
    assert (early.answer, late.answer) == (Answer.FOUND, Answer.FOUND)
    assert holds(early, 0.31)
    assert holds(late, 2.1)


@pytest.mark.long
def test_no_more_values_are_tried_than_the_promise_allows_for() -> None:
    """Each value tried has its part of the probability of error."""
    search = replace(SEARCH, tolerance=Decimal("0.01"), most=400, batch=1, confidence=0.5)  # decides soon, and wrongly
    for seed in range(3):
        assert len(searched(search, Logistic(1.0, 30), seed).tried) <= most_values(search)
