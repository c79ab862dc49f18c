"""Ranking of parameters: against scipy, and in worlds where it is known what matters."""

import math

import numpy as np
import pytest
from scipy import stats

from testbench.campaign.statistics.ranking import Effect, Ranking, rank_parameters, spearman
from testbench.campaign.statistics.shares import NotEstimableError

N = 200


def effect(ranking: Ranking, name: str) -> Effect:
    return next(one for one in ranking.effects if one.parameter == name)


def test_spearman_is_that_of_scipy_ties_included() -> None:
    """Mean ranks for ties: also against an outcome of 0 and 1."""
    generator = np.random.default_rng(21)
    for _ in range(20):
        x, y = generator.integers(0, 5, 40).astype(float), generator.integers(0, 2, 40).astype(float)
        assert spearman(list(x), list(y)) == pytest.approx(stats.spearmanr(x, y).statistic)
    assert spearman([1, 2, 3], [10, 100, 1000]) == pytest.approx(1)
    assert spearman([1, 2, 3], [3, 2, 1]) == pytest.approx(-1)


def test_effects_are_those_of_scipy() -> None:
    """rho squared, corrected, with scipy's p-value; (H - k + 1) / (n - k) with that of Kruskal and Wallis."""
    generator = np.random.default_rng(22)
    x, names = generator.random(N), generator.choice(["a", "b", "c"], N)
    y = x + (names == "b") + generator.normal(size=N)
    ranking = rank_parameters({"x": list(x), "name": [str(one) for one in names]}, list(y))
    rho, p = stats.spearmanr(x, y)
    number = effect(ranking, "x")
    assert number.rho == pytest.approx(rho)
    assert number.p_value == pytest.approx(p)
    assert number.strength == pytest.approx(1 - (1 - rho**2) * (N - 1) / (N - 2))
    assert number.eta_squared is None
    h, p = stats.kruskal(*[y[names == one] for one in "abc"])
    name = effect(ranking, "name")
    assert name.strength == pytest.approx((h - 2) / (N - 3))
    assert name.p_value == pytest.approx(p)
    assert (name.rho, name.interval, name.numeric, name.levels) == (None, None, False, 3)


def test_what_matters_more_comes_first() -> None:
    """y = 3 a + b + noise; c is without effect, d always the same and last."""
    generator = np.random.default_rng(23)
    a, b, c = generator.random((3, N))
    y = 3 * a + b + 0.3 * generator.normal(size=N)
    parameters = {"d": [1.0] * N, "c": list(c), "b": list(b), "a": list(a)}
    ranking = rank_parameters(parameters, list(y))
    assert [one.parameter for one in ranking.effects] == ["a", "b", "c", "d"]
    assert effect(ranking, "d").strength is None
    assert "same value" in effect(ranking, "d").reason
    c_strength = effect(ranking, "c").strength
    assert c_strength is not None
    assert abs(c_strength) < 0.03
    assert ranking.not_separable == ()


def test_a_parameter_that_matters_without_rising_or_falling_is_found() -> None:
    """A phase with a bad middle: rho is about 0, the ranks between its values are not."""
    phase = np.tile([0.0, 0.25, 0.5, 0.75], 50)
    y = (phase == 0.25) + (phase == 0.5) + 0.2 * np.random.default_rng(24).normal(size=N)
    found = effect(rank_parameters({"phase": list(phase)}, list(y)), "phase")
    assert found.rho is not None
    assert abs(found.rho) < 0.15
    assert found.strength == found.eta_squared
    assert found.strength is not None
    assert found.strength > 0.7
    assert found.p_value is not None
    assert found.p_value < 1e-6


@pytest.mark.long
@pytest.mark.parametrize("kind", ["metric", "outcome"])
def test_p_values_and_strengths_are_right_where_nothing_matters(kind: str) -> None:
    """300 campaigns: p below 0.05 in 5 % (twice the smaller one: at most that); mean strength about 0."""
    generator = np.random.default_rng(25)
    low, strengths = {"x": 0, "level": 0}, []
    for _ in range(300):
        y = generator.random(20) if kind == "metric" else (generator.random(20) < 0.4).astype(float)
        ranking = rank_parameters(
            {"x": list(generator.random(20)), "level": [float(one) for one in generator.integers(0, 3, 20)]}, list(y)
        )
        for name in low:
            found = effect(ranking, name)
            assert found.p_value is not None
            low[name] += found.p_value < 0.05
        x = effect(ranking, "x")
        strengths.append(x.strength)
    assert 0.015 < low["x"] / 300 < 0.09
    assert 0 < low["level"] / 300 < 0.085
    assert np.mean(np.array(strengths, dtype=float)) == pytest.approx(0, abs=0.02)  # 4 standard errors


@pytest.mark.long
@pytest.mark.parametrize("rho", [0.0, 0.5, 0.8])
def test_the_interval_of_rho_covers(rho: float) -> None:
    """150 campaigns of 40 binormal runs: 90 to 99 %; the true rank correlation is 6 / pi asin(rho / 2)."""
    generator = np.random.default_rng(26)
    true = 6 / math.pi * math.asin(rho / 2)
    inside = 0
    for _ in range(150):
        x, other = generator.normal(size=(2, 40))
        y = rho * x + math.sqrt(1 - rho**2) * other
        interval = effect(rank_parameters({"x": list(x)}, list(y)), "x").interval
        assert interval is not None
        inside += interval.low <= true <= interval.high
    assert 0.90 <= inside / 150 <= 0.99


def test_runs_that_share_seeds_widen_the_interval_and_have_no_p_value() -> None:
    """Twenty seeds, each in ten runs of one x: what a seed does looks like an effect of x, unless seeds are groups."""
    generator = np.random.default_rng(27)
    x = np.repeat(generator.random(20), 10)
    y = np.repeat(generator.normal(size=20), 10) + 0.1 * generator.normal(size=200)
    seeds = [seed for seed in range(20) for _ in range(10)]
    alone = effect(rank_parameters({"x": list(x)}, list(y)), "x")
    grouped = effect(rank_parameters({"x": list(x)}, list(y), seeds), "x")
    assert alone.interval is not None
    assert grouped.interval is not None
    assert grouped.interval.width > 2 * alone.interval.width
    assert alone.p_value is not None
    assert grouped.p_value is None


def test_what_a_seed_does_is_not_put_down_to_what_comes_with_the_seed() -> None:
    """A phase drawn once a seed: eta squared of its values would be that of the seeds, whatever the phase does."""
    generator = np.random.default_rng(30)
    seeds, runs = np.repeat(np.arange(30), 20), np.tile(np.arange(20.0), 30)
    phase, of_seed = generator.random(30), generator.normal(size=30)
    y = of_seed[seeds] + 0.05 * runs + 0.3 * generator.normal(size=600)
    ranking = rank_parameters({"phase": list(phase[seeds]), "run": list(runs)}, list(y), list(seeds))
    found = effect(ranking, "phase")
    assert found.eta_squared is None
    assert found.strength is not None
    assert found.strength < 0.15
    assert effect(ranking, "run").eta_squared is not None
    names = rank_parameters({"draw": [f"draw {seed}" for seed in seeds]}, list(y), list(seeds))
    assert effect(names, "draw").reason == "30 names in 600 runs: each in one group (seed) alone"


def test_parameters_that_vary_together_are_named() -> None:
    """Two copies, a name that follows a number, two names that follow each other; not what is independent."""
    generator = np.random.default_rng(28)
    x, z = generator.random((2, N))
    level = ["low" if value < 0.5 else "high" for value in x]
    other = ["left" if one == "low" else "right" for one in level]
    parameters = {"x": list(x), "twice": list(2 * x), "level": level, "other": other, "z": list(z)}
    pairs = rank_parameters(parameters, list(generator.random(N))).not_separable
    assert {(one.first, one.second) for one in pairs} == {
        ("x", "twice"),
        ("x", "level"),
        ("x", "other"),
        ("twice", "level"),
        ("twice", "other"),
        ("level", "other"),
    }
    assert next(one.share for one in pairs if one.first == "level") == pytest.approx(1)


def test_parameters_of_a_grid_are_separable() -> None:
    """Every combination equally often: nothing of one is explained by another."""
    grid = [(a, b) for a in (1.0, 2.0, 3.0) for b in ("p", "q") for _ in range(5)]
    ranking = rank_parameters(
        {"a": [a for a, _ in grid], "b": [b for _, b in grid]}, list(np.random.default_rng(1).random(len(grid)))
    )
    assert ranking.not_separable == ()


def test_an_order_that_is_complete_has_no_interval() -> None:
    """|rho| = 1: the data show no spread to judge by."""
    found = effect(rank_parameters({"x": list(range(20))}, list(range(20))), "x")
    assert found.rho == pytest.approx(1)
    assert found.interval is None
    assert found.strength == pytest.approx(1)


def test_names_without_repetition_have_no_strength() -> None:
    """As many names as runs explain everything and nothing."""
    found = effect(rank_parameters({"n": [str(k) for k in range(20)]}, list(range(20))), "n")
    assert (found.strength, found.p_value) == (None, None)
    assert "too few runs" in found.reason


def test_what_cannot_be_ranked_is_refused() -> None:
    """Too few runs, a constant result, few seeds, NaN, mixed kinds, unequal lengths."""
    x = [float(value) for value in range(20)]
    with pytest.raises(NotEstimableError, match="it takes 10"):
        rank_parameters({"x": x[:9]}, x[:9])
    with pytest.raises(NotEstimableError, match="in all 20 runs"):
        rank_parameters({"x": x}, [1.0] * 20)
    with pytest.raises(NotEstimableError, match="it takes 8"):
        rank_parameters({"x": x}, x, [0, 1] * 10)
    with pytest.raises(NotEstimableError, match="no order"):
        spearman([1, 1], [1, 2])
    with pytest.raises(ValueError, match="value 0"):
        rank_parameters({"x": [math.nan, *x[1:]]}, x)
    with pytest.raises(ValueError, match="mixed"):
        rank_parameters({"x": ["a", *x[1:]]}, x)  # type: ignore[dict-item]
    with pytest.raises(ValueError, match="x: 19 values for 20 runs"):
        rank_parameters({"x": x[1:]}, x)
