"""Runs to look at: the right ones, and the command that makes each again."""

import shlex

from testbench.campaign.records import Outcome
from testbench.campaign.report.notable import latest_noticed, odd, replay_command, slowest, worst
from tests.testbench.campaign.made_rows import point, row

HERE, THERE = point(duration="0.1 s"), point(duration="0.2 s")


def test_worst_runs_went_farthest_and_come_first() -> None:
    """Runs that stayed in their range are none of them."""
    rows = [row(HERE, k, Outcome.FAILURE_SILENT, beyond_deg=float(k)) for k in range(8)]
    found = worst(rows)
    assert [one.row.number for one in found] == [7, 6, 5, 4, 3]
    assert found[0].why == "7.0 deg beyond, right knee"


def test_slowest_and_last_noticed_runs() -> None:
    """By wall time; by the time from the first fault to the first reaction."""
    rows = [row(HERE, k, wall_s=1.0 + k % 4, detection_latency_s=0.1 * k if k else None) for k in range(4)]
    assert [one.row.number for one in slowest(rows)] == [3, 2, 1, 0]
    assert [one.why for one in latest_noticed(rows)] == [
        "noticed after 0.300 s",
        "noticed after 0.200 s",
        "noticed after 0.100 s",
    ]


def test_runs_without_statement_and_tried_again_are_odd() -> None:
    """Each with its reason."""
    rows = [row(HERE, 0, Outcome.HANG, reason="did not end within 120 s"), row(HERE, 1, attempts=2), row(HERE, 2)]
    assert [(one.row.number, one.why) for one in odd({HERE: rows})] == [
        (0, "hang: did not end within 120 s"),
        (1, "tried 2 times"),
    ]


def test_single_run_unlike_all_others_of_its_point_is_odd() -> None:
    """One failure among nine masked runs is what a reader wants to see; two are not odd, nor one of three runs."""
    nine = [row(HERE, k) for k in range(9)]
    lonely = row(HERE, 9, Outcome.FAILURE_SILENT)
    (found,) = odd({HERE: [*nine, lonely], THERE: [row(THERE, 0), row(THERE, 1, Outcome.ERROR), row(THERE, 2)]})
    assert (found.row, found.why) == (lonely, "the other 9 runs there: masked")
    assert odd({HERE: [*nine, lonely, row(HERE, 10, Outcome.FAILURE_SILENT)]}) == []
    assert odd({HERE: [*nine, lonely, row(HERE, 10, Outcome.ERROR)]}) == []


def test_command_survives_a_shell() -> None:
    """A store whose path has spaces and quotes is still one argument."""
    store = "my results/knee's.sqlite"
    words = shlex.split(replay_command(store, row(HERE)))
    assert words == ["exo-hil", "campaign", "replay", store, row(HERE).identity[:12]]
