"""The logistic curve: closed forms, brute force, separated outcomes, coverage, and shares that follow none."""

import math
from collections.abc import Callable, Sequence

import numpy as np
import pytest
from scipy import optimize, stats

from testbench.campaign.statistics.logistic import Level, curve_misfit, fall_misfit, logistic_fit, rising_shares
from testbench.campaign.statistics.shares import NotEstimableError, Tally
from tests.testbench.campaign.worlds import Logistic

XS = [0.1 * step for step in range(1, 10)]


def levels(xs: Sequence[float], counts: Sequence[tuple[int, int]]) -> list[Level]:
    return [Level(x, Tally(*count)) for x, count in zip(xs, counts, strict=True)]


def drawn(world: Callable[[float], float], trials: int, generator: np.random.Generator) -> list[Level]:
    return [Level(x, Tally(int(generator.binomial(trials, world(x))), trials)) for x in XS]


def penalised(data: Sequence[Level], a: float, b: float) -> float:
    """l(a, b) + 1/2 log det I, written out."""
    x = np.array([one.x for one in data])
    k, n = (
        np.array([float(v) for v in vs])
        for vs in zip(*((o.tally.successes, o.tally.trials) for o in data), strict=True)
    )
    p = 1 / (1 + np.exp(-(a + b * x)))
    w = n * p * (1 - p)
    information = np.array([[w.sum(), (w * x).sum()], [(w * x).sum(), (w * x * x).sum()]])
    return float((k * np.log(p) + (n - k) * np.log1p(-p)).sum()) + 0.5 * math.log(np.linalg.det(information))


@pytest.mark.parametrize("counts", [[(0, 10), (10, 10)], [(3, 7), (5, 20)], [(0, 1), (1, 1)], [(0, 4), (1, 4)]])
def test_two_levels_have_half_a_success_and_half_a_failure_more(counts: list[tuple[int, int]]) -> None:
    """Firth 1993, section 3: of a saturated model, the penalty is 1/2 added to each count; finite when separated."""
    fit = logistic_fit(levels([2.0, 5.0], counts))
    for x, (successes, trials) in zip([2.0, 5.0], counts, strict=True):
        assert fit.share(x) == pytest.approx((successes + 0.5) / (trials + 1), abs=1e-5)


def test_the_fit_is_at_the_maximum() -> None:
    """Brute force (Nelder and Mead) on the penalised likelihood written out finds the same a and b."""
    data = drawn(Logistic(0.4, 12), 8, np.random.default_rng(31))
    fit = logistic_fit(data)
    found = optimize.minimize(
        lambda f: -penalised(data, f[0], f[1]), (0, 1), method="Nelder-Mead", options={"fatol": 1e-10, "xatol": 1e-8}
    )
    assert (fit.a, fit.b) == pytest.approx(tuple(found.x), rel=1e-3)
    assert fit.quantile(0.5) == pytest.approx(-fit.a / fit.b)
    assert fit.share(fit.quantile(0.2)) == pytest.approx(0.2)


@pytest.mark.parametrize("q", [0.1, 0.5])
def test_the_interval_is_where_the_profile_drops(q: float) -> None:
    """At both ends 2 (l_max - l_profile) is the chi-squared quantile, by brute force over the slope."""
    data = drawn(Logistic(0.4, 12), 8, np.random.default_rng(32))
    fit = logistic_fit(data)
    interval = fit.quantile_interval(q, 0.9)
    assert interval.low < fit.quantile(q) < interval.high
    odds = math.log(q / (1 - q))
    for end in (interval.low, interval.high):
        held = optimize.minimize_scalar(
            lambda b, end=end: -penalised(data, odds - b * end, b),
            bounds=(0.1, 40),
            method="bounded",
            options={"xatol": 1e-9},
        )
        drop = 2 * (penalised(data, fit.a, fit.b) + held.fun)
        assert drop == pytest.approx(stats.chi2.ppf(0.9, 1), rel=1e-3)


def test_separated_outcomes_leave_the_gap_and_something_beside_it() -> None:
    """None of ten below, all of ten above: the median is in the middle of the gap, its interval about the gap."""
    data = levels([0, 0.25, 0.5, 0.75, 1], [(0, 10), (0, 10), (10, 10), (10, 10), (10, 10)])
    fit = logistic_fit(data)
    interval = fit.quantile_interval(0.5)
    assert fit.quantile(0.5) == pytest.approx(0.375, abs=1e-3)
    assert 0.25 < interval.low < 0.35
    assert 0.40 < interval.high < 0.5


@pytest.mark.long
@pytest.mark.parametrize("q", [0.1, 0.5, 0.9])
def test_the_interval_of_the_quantile_covers(q: float) -> None:
    """100 campaigns of nine values, ten runs each: the interval holds the true quantile; half as wide, it does not."""
    world, generator = Logistic(0.5, 10), np.random.default_rng(33)
    inside = halved = 0
    for _ in range(100):
        fit = logistic_fit(drawn(world, 10, generator))
        interval, middle = fit.quantile_interval(q), fit.quantile(q)
        inside += interval.low <= world.at(q) <= interval.high
        halved += (interval.low + middle) / 2 <= world.at(q) <= (interval.high + middle) / 2
    assert 89 <= inside <= 100  # of 95 +- 2.2, within 3 standard errors
    assert halved < 80


def test_without_a_slope_that_shows_both_ends_are_open() -> None:
    """Half of the runs fail at every value: any x may be the one."""
    interval = logistic_fit(levels([0, 1, 2], [(5, 10), (6, 10), (5, 10)])).quantile_interval(0.5)
    assert (interval.low, interval.high) == (-math.inf, math.inf)


def test_the_interval_does_not_depend_on_the_unit() -> None:
    """Seconds or milliseconds, and any origin."""
    counts = [(0, 10), (2, 10), (7, 10), (10, 10)]
    one = logistic_fit(levels([0.1, 0.2, 0.3, 0.4], counts)).quantile_interval(0.3)
    other = logistic_fit(levels([5100, 5200, 5300, 5400], counts)).quantile_interval(0.3)
    assert ((other.low - 5000) / 1000, (other.high - 5000) / 1000) == pytest.approx((one.low, one.high), abs=1e-6)


@pytest.mark.parametrize(("successes", "x"), [(0, [1, 2]), (10, [1, 2]), (5, [1, 1])])
def test_what_shows_no_curve_has_none(successes: int, x: list[float]) -> None:
    """All alike, or one value only: refused with the reason."""
    with pytest.raises(NotEstimableError):
        logistic_fit(levels(x, [(successes, 10), (successes, 10)]))
    with pytest.raises(NotEstimableError, match="two values"):
        logistic_fit([*levels([1], [(5, 10)]), Level(2, Tally(0, 0, 5))])
    with pytest.raises(ValueError, match="finite"):
        logistic_fit(levels([1, math.nan], [(5, 10), (6, 10)]))


def test_rising_shares_pool_what_falls() -> None:
    """By hand: 0.1 0.5 0.3 0.9 of 10, 10, 30, 10: the middle ones become (5 + 9) / 40."""
    found = rising_shares(levels([0, 1, 2, 3], [(1, 10), (5, 10), (9, 30), (9, 10)]))
    assert found == pytest.approx((0.1, 0.35, 0.35, 0.9))


@pytest.mark.long
def test_a_fall_is_told_from_chance() -> None:
    """p below 0.05 in at most 14 of 100 level or rising worlds (5 + 4 standard errors); below 0.01 for a hump."""
    generator = np.random.default_rng(34)
    for world in (lambda x: 0.5, Logistic(0.5, 8)):
        low = sum(fall_misfit(drawn(world, 10, generator), generator, 39) < 0.05 for _ in range(100))
        assert low <= 14
    hump = drawn(lambda x: 0.9 if 0.25 < x < 0.65 else 0.1, 10, generator)
    assert fall_misfit(hump, generator) < 0.01
    assert fall_misfit(hump[:1], generator) == 1


@pytest.mark.long
def test_another_curve_is_told_from_chance() -> None:
    """p below 0.05 in at most 9 of 60 logistic worlds (3 + 3.5 standard errors); below 0.01 for two steps."""
    generator = np.random.default_rng(35)
    low = sum(
        curve_misfit(logistic_fit(drawn(Logistic(0.5, 8), 10, generator)), generator, 39) < 0.05 for _ in range(60)
    )
    assert low <= 9
    steps = drawn(lambda x: 0.02 if x < 0.35 else 0.5 if x < 0.85 else 0.98, 60, generator)
    assert curve_misfit(logistic_fit(steps), generator) < 0.01
