"""What a report says of a search: the value with its interval, and where there is none, why."""

from decimal import Decimal

from testbench.campaign.plans.combinations import CombinationPlan
from testbench.campaign.plans.critical import CriticalPlan
from testbench.campaign.plans.search import CombinationSearch, CriticalSearch
from testbench.campaign.records import Outcome, Point, RunRow
from testbench.campaign.report.meta import Meta
from testbench.campaign.report.page import html_text
from testbench.campaign.report.searched import critical_results, critical_table, search_section
from tests.testbench.campaign.made_rows import axis, meta, point, row
from tests.testbench.campaign.test_report import Page

SEARCH = CriticalSearch("duration", Decimal("0.1"), Decimal("0.5"), Decimal("0.1"), "s", batch=10, most=200)
EDGES = {("hip", "early"): 0.25, ("hip", "late"): 9.0, ("knee", "early"): 0.0, ("knee", "late"): 0.35}
"""By joint and phase: from which duration on every run fails."""


def searched() -> tuple[list[RunRow], Meta]:
    """All runs that the search asks for, of joints that fail sharply at a duration."""
    axes = [axis("joint", "hip", "knee"), axis("duration", "0.1 s", "0.5 s"), axis("phase", "early", "late")]
    others = [point(joint=joint, phase=phase) for joint, phase in EDGES]
    plan = CriticalPlan(SEARCH, others, 1)
    known: dict[Point, list[RunRow]] = {}
    while True:
        there = {(one.point, one.number) for rows in known.values() for one in rows}
        missing = [one for one in plan.wanted(known) if (one.point, one.number) not in there]
        if not missing:
            break
        for one in missing:
            at = dict(one.point.parameters)
            fails = float(at["duration"].split()[0]) > EDGES[at["joint"], at["phase"]]
            outcome = Outcome.FAILURE_SILENT if fails else Outcome.MASKED
            known.setdefault(one.point, []).append(row(one.point, one.number, outcome))
    for rows in known.values():
        rows.sort(key=lambda found: found.number)
    return [one for rows in known.values() for one in rows], meta(axes, others, rule=SEARCH)


def test_table_has_a_row_for_every_combination() -> None:
    """The plan's own answers: found with its interval, beyond and below the ends of the axis."""
    rows, about = searched()
    found = critical_table(critical_results(rows, about))
    said = {line[:2]: line[2:4] for line in found.body}
    assert said["hip", "late"] == ("beyond 0.5 s", "beyond")
    assert said["knee", "early"] == ("below 0.1 s", "below")
    assert said["hip", "early"][1] == said["knee", "late"][1] == "found"
    assert said["hip", "early"][0].endswith("(0.20 s to 0.30 s)")
    assert sum(int(line[4]) for line in found.body) == len(rows)


def test_map_has_a_cell_for_every_combination() -> None:
    """Critical duration over phase and joint, as a figure; ends of the axis are marked as such."""
    rows, about = searched()
    said = " ".join(Page(html_text(rows, about)).said.split())
    assert "Figure 1. Critical duration over phase and joint." in said
    section = search_section(rows, about, 1)
    assert section is not None
    for cell in (">&gt;0.5<", ">&lt;0.1<"):
        assert section.count(cell) == 1


def test_unfinished_search_says_so() -> None:
    """Half of the runs are no result."""
    rows, about = searched()
    found = critical_table(critical_results(rows[:10], about))
    assert {line[3] for line in found.body} == {"unfinished"}


def test_campaign_without_a_search_has_no_such_part() -> None:
    """A grid is no search."""
    about = meta([axis("duration", "0.1 s")], [point(duration="0.1 s")])
    assert search_section([], about, 1) is None


def test_smallest_failing_sets_are_named() -> None:
    """b alone fails, a and c only together: both sets are minimal, and nothing larger was tried."""
    search = CombinationSearch(("a", "b", "c"), runs=5, most=3)
    plan = CombinationPlan(search)
    known: dict[Point, list[RunRow]] = {}
    while len(found := plan.wanted(known)) > sum(map(len, known.values())):
        known = {}
        for one in found:
            on = {name.split(".")[1] for name, text in one.point.parameters if text == "true"}
            outcome = Outcome.FAILURE_SILENT if "b" in on or {"a", "c"} <= on else Outcome.MASKED
            known.setdefault(one.point, []).append(row(one.point, one.number, outcome))
    rows = [one for runs in known.values() for one in runs]
    said = " ".join(Page(html_text(rows, meta([], [Point(())], rule=search))).said.split())
    assert "Smallest failing sets: b; a + c." in said
    assert "a + cfailsminimal5 of 5" in said
