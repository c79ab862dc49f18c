"""Location and spread of measured numbers: hand-made samples, scipy, and coverage over many seeds."""

import math
from collections.abc import Sequence

import numpy as np
import pytest
from scipy import stats

from testbench.campaign.statistics.samples import bootstrap_interval, mean_interval, median_interval, summary
from testbench.campaign.statistics.shares import Interval, NotEstimableError

CAMPAIGNS = 2000
"""Seeds: four standard errors of a coverage of 95 % are 2 %."""


def covered(intervals: Sequence[Interval], true: float) -> float:
    return sum(one.low <= true <= one.high for one in intervals) / len(intervals)


def test_a_sample_in_numbers() -> None:
    """By hand: 1 2 3 4 10: mean 4, squares 50 / 4, quartiles 2 and 4, deviations from 3: 2 1 0 1 7, their median 1."""
    found = summary([4, 1, 10, 2, 3])
    assert (found.n, found.mean, found.low, found.q1, found.median, found.q3, found.high) == (5, 4, 1, 2, 3, 4, 10)
    assert found.sd == pytest.approx(math.sqrt(50 / 4))
    assert found.mad == 1


def test_quartiles_lie_linearly_between_order_statistics() -> None:
    """Type 7: of 1 2 3 4, q1 is 1.75."""
    assert summary([1, 2, 3, 4]).q1 == 1.75


def test_one_value_has_no_spread_and_equal_values_one_of_zero() -> None:
    """sd is None for n = 1: 0 would be a claim."""
    assert summary([2.5]).sd is None
    assert summary([2.5, 2.5]).sd == 0


@pytest.mark.parametrize("confidence", [0.5, 0.9, 0.95])
def test_the_interval_of_the_mean_is_that_of_scipy(confidence: float) -> None:
    """Student's t with n - 1 degrees of freedom, sd with n - 1."""
    values = np.random.default_rng(1).normal(3, 2, 17)
    expected = stats.t.interval(confidence, 16, loc=values.mean(), scale=stats.sem(values))
    found = mean_interval(list(values), confidence)
    assert (found.low, found.high) == pytest.approx(expected)


@pytest.mark.parametrize("n", [2, 5, 30])
def test_the_interval_of_the_mean_covers_normal_means(n: int) -> None:
    """Exactly 95 % for normal values; with the normal quantile in place of t it would be 67 % for n = 2."""
    draws = np.random.default_rng(2).normal(1, 3, (CAMPAIGNS, n))
    assert abs(covered([mean_interval(list(row)) for row in draws], 1) - 0.95) < 0.02


@pytest.mark.parametrize("confidence", [0.5, 0.9, 0.95, 0.99])
def test_the_interval_of_the_median_is_the_narrowest_pair_of_order_statistics(confidence: float) -> None:
    """By the binomial sum: the pair covers at least `confidence`, the next inner pair does not."""
    for n in range(1, 60):
        values = [float(value) for value in range(n)]
        widest = 1 - 2 * 0.5**n
        if widest < confidence - 1e-12:
            with pytest.raises(NotEstimableError, match="too few for an interval of the median"):
                median_interval(values, confidence)
            continue
        found = median_interval(values, confidence)
        rank = int(found.low)
        assert found.high == n - 1 - rank
        assert 1 - 2 * stats.binom.cdf(rank, n, 0.5) >= confidence - 1e-12
        inner = 1 - 2 * stats.binom.cdf(rank + 1, n, 0.5)
        assert inner < confidence or rank + 1 > n - 2 - rank


def test_the_median_of_six_values_is_the_first_with_an_interval() -> None:
    """1 - 2 / 2^6 = 96.9 %, 1 - 2 / 2^5 = 93.8 %: the message says how many it takes."""
    with pytest.raises(NotEstimableError, match="it takes 6"):
        median_interval([1, 2, 3, 4, 5])
    found = median_interval([1, 2, 3, 4, 5, 6])
    assert (found.low, found.high) == (1, 6)


@pytest.mark.parametrize("law", ["cauchy", "lognormal", "two values"])
def test_the_interval_of_the_median_covers_whatever_the_distribution(law: str) -> None:
    """At least 95 % for heavy tails, skew and ties, n = 30 (exactly 95.7 % for continuous laws)."""
    generator = np.random.default_rng(3)
    draws = {
        "cauchy": generator.standard_cauchy((CAMPAIGNS, 30)),
        "lognormal": np.exp(2 * generator.normal(size=(CAMPAIGNS, 30))) - 1,
        "two values": (generator.random((CAMPAIGNS, 30)) < 0.4).astype(float),
    }[law]
    assert covered([median_interval(list(row)) for row in draws], 0) > 0.957 - 0.02


def test_the_bootstrap_is_that_of_scipy_and_of_its_generator() -> None:
    """The same generator gives the same interval, another one nearly the same."""
    values = list(np.random.default_rng(4).lognormal(size=40))
    found = bootstrap_interval(values, np.random.default_rng(5))
    assert found == bootstrap_interval(values, np.random.default_rng(5))
    other = bootstrap_interval(values, np.random.default_rng(6))
    assert other != found
    assert (other.low, other.high) == pytest.approx((found.low, found.high), rel=0.03)
    means = np.random.default_rng(7).choice(values, (20_000, 40)).mean(axis=1)
    assert (found.low, found.high) == pytest.approx(tuple(np.quantile(means, (0.025, 0.975))), rel=0.03)


@pytest.mark.long
def test_the_bootstrap_covers_what_docs_say() -> None:
    """docs/statistics.md: mean of 30 normal values 92 to 96 %; of a lognormal law with sigma 1 only 82 to 91 %."""
    generator = np.random.default_rng(8)
    for draws, true, low, high in (
        (generator.normal(size=(600, 30)), 0.0, 0.92, 0.96),
        (generator.lognormal(size=(600, 30)), math.exp(0.5), 0.82, 0.91),
    ):
        found = covered([bootstrap_interval(list(row), generator, resamples=999) for row in draws], true)
        assert low < found < high
    skewed = generator.lognormal(size=(CAMPAIGNS, 30))
    assert 0.82 < covered([mean_interval(list(row)) for row in skewed], math.exp(0.5)) < 0.91


@pytest.mark.parametrize("values", [[], [1.0]])
def test_too_few_values_give_no_interval(values: list[float]) -> None:
    """None where none is due."""
    for refused in (mean_interval, median_interval):
        with pytest.raises(NotEstimableError):
            refused(values)
    with pytest.raises(NotEstimableError):
        bootstrap_interval(values, np.random.default_rng(1))


def test_equal_values_give_no_interval_of_the_mean() -> None:
    """A width of 0 would claim a mean without doubt; the median's interval is right for ties."""
    with pytest.raises(NotEstimableError, match="all 12 values are 2"):
        mean_interval([2.0] * 12)
    with pytest.raises(NotEstimableError, match="all 12 values are 2"):
        bootstrap_interval([2.0] * 12, np.random.default_rng(1))
    found = median_interval([2.0] * 12)
    assert (found.low, found.high) == (2, 2)
    with pytest.raises(NotEstimableError, match="it takes 10"):
        bootstrap_interval([1.0, 2.0] * 4, np.random.default_rng(1))
    with pytest.raises(ValueError, match="resamples"):
        bootstrap_interval([1.0, 2.0] * 6, np.random.default_rng(1), resamples=10)


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
def test_what_could_not_be_measured_is_refused(bad: float) -> None:
    """NaN would make every number NaN, or be dropped in silence; the message names the place."""
    values = [1.0, bad, 2.0, 3.0, 4.0, 5.0]
    for refused in (lambda: summary(values), lambda: mean_interval(values), lambda: median_interval(values)):
        with pytest.raises(ValueError, match="value 1 of the sample"):
            refused()
    with pytest.raises(NotEstimableError, match="no value was measured"):
        summary([])
    with pytest.raises(ValueError, match="confidence"):
        mean_interval([1.0, 2.0], 95)
