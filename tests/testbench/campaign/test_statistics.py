"""Intervals of shares: against scipy, by exact coverage, and against an interval that is known to be wrong."""

import math
from collections.abc import Callable, Sequence

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import stats

from testbench.campaign.records import FAILURES, NO_STATEMENT, Outcome
from testbench.campaign.statistics.shares import (
    Interval,
    NotEstimableError,
    Tally,
    bound_without_events,
    clopper_pearson,
    outcomes_named,
    runs_for_width,
    runs_without_events,
    tally,
    wilson,
)

Method = Callable[[int, int, float], Interval]
COUNTS = [(k, n) for n in (1, 2, 3, 7, 10, 30, 100, 1000) for k in sorted({0, 1, n // 3, n // 2, n - 1, n})]


def wald(successes: int, trials: int, confidence: float = 0.95) -> Interval:
    """The interval of the textbooks that is wrong: p +- z sqrt(p (1 - p) / n)."""
    share = successes / trials
    reach = float(stats.norm.ppf((1 + confidence) / 2)) * math.sqrt(share * (1 - share) / trials)
    return Interval(share - reach, share + reach, confidence, "Wald")


def coverages(method: Method, shares: Sequence[float], trials: int, confidence: float) -> NDArray[np.float64]:
    """Exactly, for every share: the sum of the binomial probabilities of all counts whose interval holds it."""
    intervals = [method(count, trials, confidence) for count in range(trials + 1)]
    low, high = np.array([one.low for one in intervals]), np.array([one.high for one in intervals])
    p = np.asarray(shares)[:, None]
    chances = stats.binom.pmf(np.arange(trials + 1), trials, p)
    return np.asarray((chances * ((low <= p) & (p <= high))).sum(axis=1))


def mean_coverage_is_near(method: Method, trials: int, confidence: float) -> bool:
    """Averaged over all shares, at most 0.3 % below and 1 % above what is claimed."""
    mean = float(coverages(method, list((np.arange(400) + 0.5) / 400), trials, confidence).mean())
    return confidence - 0.003 <= mean <= confidence + 0.01


@pytest.mark.parametrize("confidence", [0.5, 0.8, 0.95, 0.99])
@pytest.mark.parametrize(("successes", "trials"), COUNTS)
def test_intervals_are_those_of_scipy(successes: int, trials: int, confidence: float) -> None:
    """wilson and clopper_pearson equal scipy's binomtest().proportion_ci, to the last digits."""
    for method, name in ((wilson, "wilson"), (clopper_pearson, "exact")):
        expected = stats.binomtest(successes, trials).proportion_ci(confidence, method=name)
        found = method(successes, trials, confidence)
        assert (found.low, found.high) == pytest.approx((expected.low, expected.high), rel=1e-9, abs=1e-12)


@pytest.mark.parametrize("method", [wilson, clopper_pearson])
def test_ends_are_exact_where_all_runs_came_out_alike(method: Method) -> None:
    """0 of n reaches down to exactly 0, n of n up to exactly 1; and never outside of the share itself."""
    for trials in range(1, 200):
        assert method(0, trials, 0.95).low == 0
        assert method(trials, trials, 0.95).high == 1
        for successes in range(trials + 1):
            found = method(successes, trials, 0.95)
            assert 0 <= found.low <= successes / trials <= found.high <= 1


@pytest.mark.parametrize("confidence", [0.8, 0.95, 0.99])
@pytest.mark.parametrize("trials", [1, 5, 20, 100])
def test_clopper_pearson_covers_every_share(trials: int, confidence: float) -> None:
    """Exact coverage is at least what is claimed, for every share of a grid that holds the ends of the intervals."""
    found = [clopper_pearson(k, trials, confidence) for k in range(trials + 1)]
    ends = {end for one in found for end in (one.low, one.high)} - {0.0, 1.0}
    beside = {end * (1 + change) for end in ends for change in (-1e-9, 1e-9)}  # the worst is just outside of an end
    shares = sorted({*np.linspace(0.0005, 0.9995, 500), *ends, *beside})
    assert (coverages(clopper_pearson, shares, trials, confidence) >= confidence - 1e-8).all()


@pytest.mark.parametrize("trials", [20, 50, 100])
def test_wilson_covers_on_average_what_it_claims_and_wald_does_not(trials: int) -> None:
    """Mean coverage over shares 0..1 within (-0.3 %, +1 %) of 95 %; the same test refuses Wald's interval."""
    assert mean_coverage_is_near(wilson, trials, 0.95)
    assert not mean_coverage_is_near(wald, trials, 0.95)


def test_wilson_covers_less_than_claimed_for_some_shares() -> None:
    """docs/statistics.md: below 0.95 near the ends, never below 0.83 from 20 runs on."""
    shares = list(np.linspace(0.001, 0.999, 999))
    worst = min(float(coverages(wilson, shares, trials, 0.95).min()) for trials in (20, 50, 100))
    assert 0.83 < worst < 0.86


@pytest.mark.parametrize("share", [0.02, 0.3, 0.5, 0.9])
def test_drawn_shares_are_covered_as_often_as_computed(share: float) -> None:
    """4000 campaigns of 60 runs, each with its seed: covered as computed, within 4 standard errors."""
    drawn = [int(np.random.default_rng(seed).binomial(60, share)) for seed in range(4000)]
    for method in (wilson, clopper_pearson):
        intervals = {count: method(count, 60) for count in set(drawn)}
        covered = sum(intervals[count].low <= share <= intervals[count].high for count in drawn) / 4000
        (exact,) = coverages(method, [share], 60, 0.95)
        assert abs(covered - exact) < 4 * math.sqrt(exact * (1 - exact) / 4000)


@pytest.mark.parametrize("method", ["wilson", "clopper_pearson"])
@pytest.mark.parametrize("confidence", [0.9, 0.95])
@pytest.mark.parametrize("width", [0.05, 0.1, 0.2, 0.37])
def test_runs_for_a_width_suffice_whatever_comes_out_and_one_less_does_not(
    width: float, confidence: float, method: str
) -> None:
    """share None: with n runs every count has an interval of at most the width; with n - 1 some count has not."""
    interval = wilson if method == "wilson" else clopper_pearson
    runs = runs_for_width(width, confidence=confidence, method=method)
    assert max(interval(k, runs, confidence).width for k in range(runs + 1)) <= width
    assert max(interval(k, runs - 1, confidence).width for k in range(runs)) > width


@pytest.mark.parametrize("method", ["wilson", "clopper_pearson"])
def test_runs_for_a_width_are_the_smallest_number_also_by_counting_up(method: str) -> None:
    """From two runs on the width falls with every further run, so that the search may halve."""
    interval = wilson if method == "wilson" else clopper_pearson
    widths = {n: max(interval(k, n).width for k in range(n + 1)) for n in range(1, 150)}
    assert all(widths[n + 1] < widths[n] for n in range(2, 149))
    for width in (0.95, 0.8, 0.5, 0.2):
        assert runs_for_width(width, method=method) == 1 + max((n for n in widths if widths[n] > width), default=0)


@pytest.mark.parametrize("share", [0.0, 0.01, 0.1, 0.25, 0.5, 0.75, 1.0])
def test_runs_for_a_width_at_a_share_agree_with_the_interval_at_its_count(share: float) -> None:
    """Where n x share is a count, the interval of that count has the width; shares p and 1 - p need the same."""
    for method, interval in (("wilson", wilson), ("clopper_pearson", clopper_pearson)):
        runs = runs_for_width(0.1, share, method=method)
        assert runs == runs_for_width(0.1, 1 - share, method=method)
        assert runs <= runs_for_width(0.1, 0.5, method=method)
        step = 100 if share in (0.01,) else 20
        enough, few = -(-runs // step) * step, (runs - 1) // step * step
        assert interval(round(enough * share), enough).width <= 0.1
        if few:
            assert interval(round(few * share), few).width > 0.1


def test_runs_for_a_width_are_known_numbers() -> None:
    """95 %, width 0.1: 381 by Wilson (z^2 / width^2 - z^2, rounded up), 402 by Clopper-Pearson at worst."""
    z = 1.959963984540054
    assert runs_for_width(0.1) == math.ceil(z * z / 0.1**2 - z * z) == 381
    assert runs_for_width(0.1, method="clopper_pearson") == 402
    assert runs_for_width(0.1, 0.0) == math.ceil(z * z / 0.1 - z * z)


@pytest.mark.parametrize("trials", [30, 60, 100, 3000])
def test_no_event_in_n_runs_bounds_the_share_by_three_over_n(trials: int) -> None:
    """Rule of three: 1 - 0.05^(1/n) is below 3 / n, by less than 6 % from 30 runs on; it solves (1 - p)^n = 0.05."""
    bound = bound_without_events(trials)
    assert (1 - bound) ** trials == pytest.approx(0.05)
    assert 0.94 * 3 / trials < bound < 3 / trials
    assert bound == pytest.approx(clopper_pearson(0, trials, 0.9).high)  # 90 % two-sided is 95 % one-sided


@pytest.mark.parametrize("share", [0.9, 0.5, 0.05, 0.01, 0.001, 1e-5])
def test_runs_without_events_are_the_smallest_number_that_bounds_the_share(share: float) -> None:
    """59 runs without a failure bound its share by 5 %, 58 do not."""
    runs = runs_without_events(share)
    assert bound_without_events(runs) <= share
    assert runs == 1 or bound_without_events(runs - 1) > share
    assert runs_without_events(0.05) == 59


@pytest.mark.parametrize("method", [wilson, clopper_pearson])
def test_no_run_has_no_interval(method: Method) -> None:
    """n = 0: refused, not (0, 1) and not 0."""
    with pytest.raises(NotEstimableError, match="no run makes a statement"):
        method(0, 0, 0.95)


@pytest.mark.parametrize("counts", [(-1, 5), (6, 5), (1, 0), (0, -1), (0.5, 5), (True, 5), (math.nan, 5)])
@pytest.mark.parametrize("method", [wilson, clopper_pearson])
def test_impossible_counts_are_refused(method: Callable[[float, float], Interval], counts: tuple[float, float]) -> None:
    """Counts are whole numbers, successes at most trials."""
    with pytest.raises(ValueError, match=r"no share|whole number"):
        method(*counts)


@pytest.mark.parametrize("confidence", [0.0, 1.0, 95.0, -0.1, math.nan])
def test_confidence_is_a_share(confidence: float) -> None:
    """0.95, not 95."""
    for refused in (
        lambda: wilson(1, 2, confidence),
        lambda: clopper_pearson(1, 2, confidence),
        lambda: runs_for_width(0.1, confidence=confidence),
        lambda: bound_without_events(3, confidence),
        lambda: runs_without_events(0.1, confidence),
    ):
        with pytest.raises(ValueError, match="confidence"):
            refused()


def test_widths_and_shares_out_of_range_are_refused() -> None:
    """No number of runs makes a width of 0; a width of 1 needs none."""
    for width in (0.0, 1.0, -0.1, math.nan, 1e-6):
        with pytest.raises(ValueError, match="width"):
            runs_for_width(width)
    for share in (-0.1, 1.1, math.nan):
        with pytest.raises(ValueError, match="share"):
            runs_for_width(0.1, share)
    for share in (0.0, 1.0, math.nan, 1e-12):
        with pytest.raises(ValueError, match="share"):
            runs_without_events(share)
    with pytest.raises(ValueError, match="wilson, clopper_pearson"):
        runs_for_width(0.1, method="wald")
    with pytest.raises(NotEstimableError):
        bound_without_events(0)


def test_failure_means_any_failure_and_runs_without_a_statement_are_apart() -> None:
    """Shares are over runs that make a statement; the others are counted beside."""
    outcomes = list(Outcome)
    assert outcomes_named("failure") == FAILURES
    assert tally(outcomes, "failure") == Tally(3, 8, 3)
    assert tally(outcomes, "failure_silent") == Tally(1, 8, 3)
    assert tally([], "failure") == Tally(0, 0, 0)
    assert Tally(0, 0, 4).share is None
    assert Tally(1, 4).share == 0.25
    for name in (*(one.value for one in NO_STATEMENT), "failed", ""):
        with pytest.raises(ValueError, match="allowed: not_activated"):
            outcomes_named(name)


def test_an_interval_is_in_order() -> None:
    """NaN and low above high are refused."""
    for low, high in ((1.0, 0.0), (math.nan, 1.0), (0.0, math.nan)):
        with pytest.raises(ValueError, match="low must not be above high"):
            Interval(low, high, 0.95, "")


@pytest.mark.long
def test_stopping_when_the_interval_is_narrow_costs_little_coverage() -> None:
    """docs/statistics.md: batches of 20, at most 400, width 0.1: exactly summed, mean 95.2 %, at worst 90.5 %."""
    shares, found = np.linspace(0.0025, 0.9975, 200), []
    intervals = {n: [wilson(k, n) for k in range(n + 1)] for n in range(20, 401, 20)}
    for share in shares:
        going, covered = np.ones(1), 0.0
        for n, ends in intervals.items():
            going = np.convolve(going, stats.binom.pmf(np.arange(21), 20, share))
            stops = np.array([one.width <= 0.1 or n == 400 for one in ends])
            holds = np.array([one.low <= share <= one.high for one in ends])
            covered += float(going[stops & holds].sum())
            going = np.where(stops, 0, going)
        found.append(covered)
    assert float(np.mean(found)) == pytest.approx(0.952, abs=0.0005)
    assert min(found) == pytest.approx(0.905, abs=0.0005)
