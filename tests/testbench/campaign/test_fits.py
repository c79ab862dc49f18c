"""The parabola through measured numbers: hand-made data, numpy's polyfit, and coverage of its band."""

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from testbench.campaign.statistics.fits import quadratic_fit
from testbench.campaign.statistics.shares import NotEstimableError

DURATIONS = [0.05 * step for step in range(1, 11)] + [0.5 + 0.25 * step for step in range(1, 11)]
"""Those of the paper's first experiment, s."""


def curve(x: NDArray[np.float64]) -> NDArray[np.float64]:
    return 0.02 + 0.9 * x - 0.15 * x**2


def campaigns(count: int, seeds: int, shared: float, own: float) -> NDArray[np.float64]:
    """(count, seeds, durations): the curve, what a seed does at all durations, and what each run does by itself."""
    generator = np.random.default_rng(11)
    x = np.array(DURATIONS)
    common = shared * x * generator.normal(size=(count, seeds, 1))
    return np.asarray(curve(x) + common + own * x * generator.normal(size=(count, seeds, x.size)))


def test_a_parabola_is_found_again() -> None:
    """Exact data: coefficients to 12 digits, R^2 of 1, a band of no width."""
    x = np.array(DURATIONS)
    found = quadratic_fit(DURATIONS, list(curve(x)))
    assert found.coefficients == pytest.approx((0.02, 0.9, -0.15), abs=1e-12)
    assert found.r_squared == pytest.approx(1, abs=1e-12)
    assert found.sd == pytest.approx(0, abs=1e-12)
    assert found.band(1.0).width == pytest.approx(0, abs=1e-11)
    assert found.at(2.0) == pytest.approx(0.02 + 1.8 - 0.6)


def test_by_hand() -> None:
    """y = 0 0 1 0 0 at -2..2: c0 = 17/35, c2 = -1/7 (Savitzky and Golay's 5 points), residual 18/35, total 4/5."""
    found = quadratic_fit([-2, -1, 0, 1, 2], [0, 0, 1, 0, 0])
    assert found.coefficients == pytest.approx((17 / 35, 0, -1 / 7), abs=1e-14)
    assert found.r_squared == pytest.approx(1 - (18 / 35) / (4 / 5))
    assert found.sd == pytest.approx(math.sqrt(18 / 35 / 2))
    assert found.freedom == 2
    # variance of the curve at 0: sd^2 17/35; t(0.975; 2) = 4.3027
    assert found.band(0).width / 2 == pytest.approx(4.302652729911275 * math.sqrt(18 / 35 / 2 * 17 / 35))


@pytest.mark.parametrize("offset", [0.0, 10.0, -3.0])
def test_fit_and_covariance_are_those_of_numpy(offset: float) -> None:
    """polyfit with its scaled covariance, also where x lies far from 0."""
    generator = np.random.default_rng(12)
    x = np.repeat(DURATIONS, 4) + offset
    y = curve(x) + generator.normal(size=x.size)
    expected, covariance = np.polyfit(x, y, 2, cov=True)
    found = quadratic_fit(list(x), list(y))
    assert found.coefficients == pytest.approx(tuple(expected[::-1]), rel=1e-8)
    assert np.array(found.covariance) == pytest.approx(covariance[::-1, ::-1], rel=1e-6)


@pytest.mark.long
def test_known_noise_is_covered() -> None:
    """Independent runs of equal spread: the band at one x holds the curve in 95 % of 2000 campaigns, as does its sd."""
    generator = np.random.default_rng(13)
    x = np.repeat(DURATIONS, 2)
    inside, variances = 0, []
    for _ in range(2000):
        found = quadratic_fit(list(x), list(curve(x) + 0.3 * generator.normal(size=x.size)))
        inside += bool(found.band(0.4).low <= curve(np.array(0.4)) <= found.band(0.4).high)
        assert found.sd is not None
        variances.append(found.sd**2)
    assert abs(inside / 2000 - 0.95) < 0.02
    assert np.mean(variances) == pytest.approx(0.09, rel=0.02)


@pytest.mark.parametrize("seeds", [8, 30])
def test_the_band_over_seeds_covers_where_the_plain_one_does_not(seeds: int) -> None:
    """Runs that share seeds and spread more at long durations: 93 to 98 % with seeds as groups, below 80 % without."""
    x = np.tile(DURATIONS, seeds)
    seed_of = [seed for seed in range(seeds) for _ in DURATIONS]
    inside = {True: 0, False: 0}
    runs = campaigns(400, seeds, shared=0.3, own=0.1)
    for grouped in inside:
        for one in runs:
            band = quadratic_fit(list(x), list(one.ravel()), seed_of if grouped else None).band(2.0)
            inside[grouped] += bool(band.low <= curve(np.array(2.0)) <= band.high)
    assert 0.93 < inside[True] / 400 < 0.98
    assert inside[False] / 400 < 0.8


def test_leaving_out_groups_is_what_it_says() -> None:
    """(G - 1) / G times the sum of squared changes when a group is left out and the parabola fitted again."""
    runs = campaigns(1, 9, shared=0.3, own=0.1)[0]
    x, seed_of = np.tile(DURATIONS, 9), np.repeat(np.arange(9), len(DURATIONS))
    whole = quadratic_fit(list(x), list(runs.ravel()), [int(seed) for seed in seed_of])
    changes = []
    for group in range(9):
        keep = seed_of != group
        left = quadratic_fit(list(x[keep]), list(runs.ravel()[keep]))
        changes.append(np.array(left.coefficients) - np.array(whole.coefficients))
    expected = 8 / 9 * np.array(changes).T @ np.array(changes)
    assert np.array(whole.covariance) == pytest.approx(expected, rel=1e-6)
    assert (whole.freedom, whole.grouped, whole.lack_of_fit_p) == (8, True, None)


def test_means_of_equally_many_runs_have_the_same_parabola_and_another_r_squared() -> None:
    """docs/statistics.md: R^2 of the means says how well the curve meets them, not how far single runs spread."""
    runs = campaigns(1, 20, shared=0.3, own=0.3)[0]
    single = quadratic_fit(list(np.tile(DURATIONS, 20)), list(runs.ravel()))
    means = quadratic_fit(DURATIONS, list(runs.mean(axis=0)))
    assert single.coefficients == pytest.approx(means.coefficients)
    assert single.r_squared is not None
    assert means.r_squared is not None
    assert single.r_squared < means.r_squared


def test_lack_of_fit_tells_a_parabola_from_another_curve() -> None:
    """F test of the means about the parabola: evenly spread p-values for a parabola, near 0 for a step."""
    generator = np.random.default_rng(14)
    x = np.repeat(DURATIONS, 5)
    right = []
    for _ in range(1000):
        p = quadratic_fit(list(x), list(curve(x) + generator.normal(size=x.size))).lack_of_fit_p
        assert p is not None
        right.append(p)
    assert abs(np.mean(np.array(right) < 0.05) - 0.05) < 0.03
    assert np.mean(right) == pytest.approx(0.5, abs=0.04)
    wrong = quadratic_fit(list(x), list((x > 1) + 0.1 * generator.normal(size=x.size))).lack_of_fit_p
    assert wrong is not None
    assert wrong < 1e-6


def test_three_points_have_a_curve_and_no_band() -> None:
    """No degree of freedom: nothing is known of the spread."""
    found = quadratic_fit([0, 1, 2], [0, 1, 4])
    assert found.coefficients == pytest.approx((0, 0, 1), abs=1e-14)
    assert found.sd is None
    assert found.lack_of_fit_p is None
    with pytest.raises(NotEstimableError, match="no degree of freedom"):
        found.band(1)


def test_equal_values_have_no_r_squared() -> None:
    """0 / 0: None, neither 0 nor 1."""
    assert quadratic_fit([0, 1, 2, 3], [5, 5, 5, 5]).r_squared is None


def test_what_makes_no_parabola_is_refused() -> None:
    """Fewer than three x, NaN, unequal lengths, few groups, x outside of the range."""
    with pytest.raises(NotEstimableError, match="three different x; got 2"):
        quadratic_fit([0, 1, 0, 1], [1, 2, 3, 4])
    with pytest.raises(NotEstimableError, match="7 groups"):
        quadratic_fit(list(range(7)), list(range(7)), list(range(7)))
    with pytest.raises(NotEstimableError, match="without one of the groups"):
        quadratic_fit([0, 1, 2, *[0, 1] * 4], list(range(11)), list(range(11)))
    with pytest.raises(ValueError, match="value 2"):
        quadratic_fit([0, 1, math.nan, 2], [1, 2, 3, 4])
    with pytest.raises(ValueError, match="same length"):
        quadratic_fit([0, 1, 2], [1, 2])
    with pytest.raises(ValueError, match="outside of the fitted range"):
        quadratic_fit([0, 1, 2, 3], [1, 2, 1, 3]).band(3.1)
