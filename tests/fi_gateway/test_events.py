"""Events: times on the grid, against the geometric distribution of scipy."""

import copy

import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.random import PCG64, Generator
from scipy import stats

from canopen_exo.bus.node import MS, NEVER
from fi_gateway.errors import FaultError
from fi_gateway.events import At, FailureProbability, Never


def rng(seed: int = 1) -> Generator:
    return Generator(PCG64(seed))


@pytest.mark.parametrize(
    ("after", "due"),
    [(0, 10), (9, 10), (10, 10), (11, 20), (20, 20), (21, 30), (30, 30), (31, NEVER), (NEVER, NEVER)],
)
def test_at_gives_the_first_time_not_before(after: int, due: int) -> None:
    """A time inside an activation is passed over; at the very end of one the injector is free again."""
    assert At((30, 10, 20, 20)).next(after) == due


def test_at_may_name_time_0() -> None:
    """The first moment of the motion can be hit."""
    assert At((0, 5)).first() == 0


@pytest.mark.parametrize("times", [(), (-1,), (5, -1), (NEVER,)])
def test_at_refuses_times_outside_the_run(times: tuple[int, ...]) -> None:
    """Time 0 is the start of the motion."""
    with pytest.raises(FaultError, match="one or more times"):
        At(times)


def test_never_never_comes() -> None:
    """faults.md: never (trigger only)."""
    assert (Never().first(), Never().next(5)) == (NEVER, NEVER)


@pytest.mark.parametrize(
    ("after", "due"),
    [(0, 1 * MS), (1, 1 * MS), (MS - 1, 1 * MS), (MS, 2 * MS), (MS + 1, 2 * MS), (7 * MS + 1, 8 * MS)],
)
def test_trials_lie_on_the_grid_from_time_0_and_strictly_after(after: int, due: int) -> None:
    """p = 1: every grid point k >= 1 is an event; none at time 0, none at the end of an activation."""
    assert FailureProbability(1.0, MS, rng()).next(after) == due


@given(
    st.floats(1e-6, 1.0),
    st.integers(1, 10**9),
    st.lists(st.integers(0, 10**10), min_size=1, max_size=20).map(sorted),
    st.integers(0, 2**32),
)
def test_the_grid_goes_on_after_expiry(probability: float, period: int, ends: list[int], seed: int) -> None:
    """faults.md: a geometric gap on a grid from time 0; the grid goes on after expiry."""
    event = FailureProbability(probability, period, rng(seed))
    for end in ends:
        due = event.next(end)
        assert due == NEVER or (due > end and due % period == 0)


def test_gaps_are_geometric() -> None:
    """P(gap = k periods) = p (1 - p)^(k-1): chi-squared over 4000 seeds, 1 %, cells of at least 5 expected."""
    p, n, cells = 0.2, 4000, 24
    gaps = [FailureProbability(p, MS, rng(seed)).first() // MS for seed in range(n)]
    observed = [gaps.count(k) for k in range(1, cells)] + [sum(gap >= cells for gap in gaps)]
    expected = [n * stats.geom.pmf(k, p) for k in range(1, cells)] + [n * stats.geom.sf(cells - 1, p)]
    assert min(expected) >= 5
    assert stats.chisquare(observed, expected).pvalue > 0.01


def test_gaps_after_an_end_off_the_grid_are_geometric_too() -> None:
    """The first trial after an end between two grid points is the next grid point, with full probability."""
    p, n = 0.2, 4000
    hits = sum(FailureProbability(p, MS, rng(seed)).next(5 * MS + 7) == 6 * MS for seed in range(n))
    assert stats.binomtest(hits, n, p).pvalue > 0.01


def test_rate_is_per_stated_period() -> None:
    """faults.md: 5e-4 per 1 ms = 0.5 faults/s; the mean gap is 2 s, within 1 % two-sided (mean of 4000)."""
    gaps = [FailureProbability(5e-4, MS, rng(seed)).first() / 1e9 for seed in range(4000)]
    mean, sd = stats.geom.stats(5e-4)
    z = (sum(gaps) / len(gaps) - mean * 1e-3) / (float(sd) ** 0.5 * 1e-3 / len(gaps) ** 0.5)
    assert abs(z) < stats.norm.ppf(0.995)


def test_an_announced_event_not_used_up_stays_valid() -> None:
    """An activation by trigger that ends before the drawn time neither redraws nor moves it."""
    event = FailureProbability(0.01, MS, rng())
    due = event.first()
    state = copy.deepcopy(event)
    assert event.next(due - 1) == due
    assert event.next(due - 1) == due
    assert event.next(due) == state.next(due) > due


@pytest.mark.parametrize("probability", [0.0, 1e-300])
def test_probability_0_never_comes(probability: float) -> None:
    """No gap overflows."""
    assert FailureProbability(probability, MS, rng()).first() == NEVER


@pytest.mark.parametrize(
    ("probability", "period", "message"),
    [
        (-1e-9, MS, r"0\.\.1"),
        (1.0000001, MS, r"0\.\.1"),
        (float("nan"), MS, r"0\.\.1"),
        (0.5, 0, "1 ns and more"),
        (0.5, -1, "1 ns and more"),
    ],
)
def test_bad_parameters_are_refused(probability: float, period: int, message: str) -> None:
    """The message names what is allowed."""
    with pytest.raises(FaultError, match=message):
        FailureProbability(probability, period, rng())
