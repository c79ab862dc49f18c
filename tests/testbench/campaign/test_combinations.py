"""The smallest failing sets of injectors: found breadth first, supersets left out, nothing claimed that was not run."""

from collections.abc import Callable

import pytest

from testbench.campaign.plans.combinations import CombinationPlan, Verdict
from testbench.campaign.plans.search import CombinationSearch
from testbench.campaign.records import Outcome, Point, RunRow, Wanted
from testbench.campaign.statistics.shares import Tally, clopper_pearson
from tests.testbench.campaign.worlds import play, row

FAIL, PASS, LOST = Outcome.FAILURE_SILENT, Outcome.MASKED, Outcome.INVALID
ABCD = ("a", "b", "c", "d")


def switched_on(wanted: Wanted) -> frozenset[str]:
    return frozenset(
        key.split(".")[1] for key, value in wanted.point.parameters if key.endswith(".enabled") and value == "true"
    )


def world(*causes: str) -> Callable[[Wanted], Outcome]:
    """Fails whenever all injectors of one of the causes ("ab") are on."""

    def draw(wanted: Wanted) -> Outcome:
        return FAIL if any(set(cause) <= switched_on(wanted) for cause in causes) else PASS

    return draw


@pytest.mark.parametrize(
    ("causes", "minimal"),
    [
        (("a",), [("a",)]),
        (("ab", "bc"), [("a", "b"), ("b", "c")]),
        (("d", "abc"), [("d",), ("a", "b", "c")]),
        (("ab", "abc"), [("a", "b")]),
        (("",), [()]),
        (("abcd",), []),
        ((), []),
    ],
)
def test_minimal_sets_are_found_and_only_these(causes: tuple[str, ...], minimal: list[tuple[str, ...]]) -> None:
    """Up to three of four injectors; a failure without any injector is the smallest set there is."""
    plan = CombinationPlan(CombinationSearch(ABCD, runs=2, most=3))
    (result,) = plan.results(play(plan, world(*causes)))
    assert list(result.minimal) == minimal
    assert (result.complete, result.size) == (True, 3)
    tried = {one.injectors for one in result.sets}
    assert not any(set(small) < set(names) for small in minimal for names in tried)
    assert len(tried) + result.pruned == 1 + 4 + 6 + 4


def test_a_point_says_what_is_on_as_the_scenario_file_does() -> None:
    """`injectors.NAME.enabled` for every listed injector, after the other axes."""
    plan = CombinationPlan(CombinationSearch(("a", "b")), [Point((("gain", "0.5"),))])
    point = plan.point(plan.others[0], ("b",))
    assert point.parameters == (("gain", "0.5"), ("injectors.a.enabled", "false"), ("injectors.b.enabled", "true"))


def test_larger_sets_wait_for_all_smaller_ones() -> None:
    """With one run of a single injector missing, no pair is wanted; the result is unfinished."""
    plan = CombinationPlan(CombinationSearch(ABCD, runs=2, most=2))
    first = plan.wanted({})
    assert {len(switched_on(one)) for one in first} == {0}
    known: dict[Point, list[RunRow]] = {}
    for one in first:
        known.setdefault(one.point, []).append(row(one, PASS))
    singles = [one for one in plan.wanted(known) if one not in first]
    assert {len(switched_on(one)) for one in singles} == {1}
    for one in singles[:-1]:
        known.setdefault(one.point, []).append(row(one, PASS))
    assert plan.wanted(known) == [*first, *singles]
    (result,) = plan.results(known)
    assert (result.complete, result.size, len(result.sets)) == (False, 0, 4)


def test_the_order_in_which_runs_finish_changes_nothing() -> None:
    """Rows added backwards give the same wanted runs and results."""
    plan = CombinationPlan(CombinationSearch(ABCD, runs=3, most=3))
    known = play(plan, world("ab", "c"))
    backwards = {point: list(reversed(rows)) for point, rows in reversed(known.items())}
    assert plan.wanted(backwards) == plan.wanted(known)
    assert plan.results(backwards) == plan.results(known)


def test_a_set_fails_from_the_stated_number_of_runs_on() -> None:
    """least 3 of 5: two failures hold, three fail; the interval says what five runs are worth."""

    def draw(wanted: Wanted) -> Outcome:
        count = {frozenset("a"): 2, frozenset("b"): 3}.get(switched_on(wanted), 0)
        return FAIL if wanted.number < count else PASS

    plan = CombinationPlan(CombinationSearch(("a", "b"), runs=5, most=1, least=3))
    (result,) = plan.results(play(plan, draw))
    of = {one.injectors: one for one in result.sets}
    assert (of["a",].verdict, of["b",].verdict) == (Verdict.HOLDS, Verdict.FAILS)
    assert of["a",].tally == Tally(2, 5)
    assert of[()].interval == clopper_pearson(0, 5)
    assert result.minimal == (("b",),)


def test_runs_without_a_statement_leave_a_set_undecided_and_its_supersets_not_minimal() -> None:
    """Nothing is claimed of what an invalid run could have shown; the search goes on."""

    def draw(wanted: Wanted) -> Outcome:
        on = switched_on(wanted)
        return LOST if on == {"a"} and wanted.number == 0 else FAIL if on == {"a", "b"} else PASS

    plan = CombinationPlan(CombinationSearch(("a", "b"), runs=2, most=2))
    (result,) = plan.results(play(plan, draw))
    of = {one.injectors: one for one in result.sets}
    assert of["a",].verdict is Verdict.UNDECIDED
    assert of["a",].tally == Tally(0, 1, 1)
    assert (of["a", "b"].verdict, of["a", "b"].minimal) == (Verdict.FAILS, False)
    assert result.minimal == ()


def test_each_combination_of_the_other_axes_has_its_search() -> None:
    """Results in the order of the points."""
    others = [Point((("stops", "on"),)), Point((("stops", "off"),))]
    plan = CombinationPlan(CombinationSearch(("a", "b"), runs=1, most=1), others)

    def draw(wanted: Wanted) -> Outcome:
        return FAIL if "a" in switched_on(wanted) and ("stops", "off") in wanted.point.parameters else PASS

    on, off = plan.results(play(plan, draw))
    assert (on.point, on.minimal) == (others[0], ())
    assert (off.point, off.minimal) == (others[1], (("a",),))


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"injectors": ()}, "none given"),
        ({"injectors": ("a", "a")}, "a given twice"),
        ({"outcome": "hang"}, "no outcome"),
        ({"runs": 0}, "runs"),
        ({"most": 5}, r"allowed 1\.\.4"),
        ({"most": 0}, "most"),
        ({"least": 6}, r"allowed 1\.\.5"),
    ],
)
def test_a_search_that_is_none_is_refused(wrong: dict[str, object], message: str) -> None:
    """What was given, what is allowed."""
    with pytest.raises(ValueError, match=message):
        CombinationSearch(**{"injectors": ABCD, **wrong})  # type: ignore[arg-type]
