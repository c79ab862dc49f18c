"""Shares over the gait phase: which run belongs to which bin, around the circle."""

import math

import pytest

from testbench.campaign.records import Outcome
from testbench.campaign.statistics.phases import by_phase
from testbench.campaign.statistics.shares import Tally, clopper_pearson, wilson

FAIL, PASS, LOST = Outcome.FAILURE_SILENT, Outcome.MASKED, Outcome.INVALID


def test_each_bin_counts_its_runs() -> None:
    """Two of three fail in the first quarter, none of one in the second; an invalid run is counted apart."""
    runs = [(0.0, FAIL), (0.1, PASS), (0.249, FAIL), (0.25, PASS), (0.8, LOST)]
    bins = by_phase(runs, "failure", bins=4)
    assert [(one.low, one.high) for one in bins] == [(0, 0.25), (0.25, 0.5), (0.5, 0.75), (0.75, 1)]
    assert [one.tally for one in bins] == [Tally(2, 3), Tally(0, 1), Tally(0, 0), Tally(0, 0, 1)]
    assert bins[0].wilson == wilson(2, 3)
    assert bins[0].clopper_pearson == clopper_pearson(2, 3)
    assert bins[2].wilson is None
    assert bins[3].clopper_pearson is None


def test_the_end_of_a_stride_is_the_start_of_the_next() -> None:
    """Phase 1 is phase 0."""
    bins = by_phase([(1.0, FAIL), (0.0, PASS)], "failure", bins=10)
    assert bins[0].tally == Tally(1, 2)


def test_the_last_bin_wraps_around() -> None:
    """Edges at 0.05, 0.15, ..., 0.95: a phase of 0.02 and one of 0.97 lie in the last bin."""
    bins = by_phase([(0.02, FAIL), (0.97, PASS), (1.0, PASS), (0.05, FAIL)], "failure", bins=10, first=0.05)
    assert (bins[-1].low, bins[-1].high) == pytest.approx((0.95, 1.05))
    assert bins[-1].tally == Tally(1, 3)
    assert bins[0].tally == Tally(1, 1)


@pytest.mark.parametrize("bins", [1, 3, 7, 10, 20, 100])
@pytest.mark.parametrize("part", [0.0, 0.3, 0.5])
def test_every_phase_lies_in_the_bin_whose_edges_hold_it(bins: int, part: float) -> None:
    """Lower edge included, upper not, as stated and whatever the rounding; every run in one bin only."""
    first = part / bins
    edges = [first + number / bins for number in range(bins)]
    for phase in (*edges, *(math.nextafter(edge, 0) for edge in edges if edge > 0), 0.0, math.nextafter(1, 0)):
        found = [one for one in by_phase([(phase, FAIL)], "failure", bins, first) if one.tally.trials]
        assert len(found) == 1
        assert found[0].low <= phase < found[0].high or found[0].low <= phase + 1 <= found[0].high


@pytest.mark.parametrize("phase", [-0.01, 1.01, math.nan, math.inf])
def test_a_phase_is_a_part_of_a_stride(phase: float) -> None:
    """0..1; a run in which no fault began has none, and is left out by the caller."""
    with pytest.raises(ValueError, match="phase"):
        by_phase([(phase, FAIL)], "failure")


def test_bins_that_are_none_are_refused() -> None:
    """At least one; the first begins within the first 1 / bins."""
    for bins, first in ((0, 0.0), (10, 0.1), (10, -0.1), (10, math.nan)):
        with pytest.raises(ValueError, match="bins"):
            by_phase([], "failure", bins, first)
