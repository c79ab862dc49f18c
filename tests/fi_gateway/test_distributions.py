"""Every event and effect that is drawn has the distribution it is named after: against scipy, an independent reference.

For each: a test at 1 % for seeds 0..19. A right distribution is rejected by at most 2 of them (0.2 expected, 3 or more
once in a thousand); a wrong one of the same kind by more.
"""

import copy
import pickle
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from numpy.random import PCG64, Generator
from scipy import stats

from canopen_exo.bus.frame import Frame
from canopen_exo.bus.node import MS, NEVER
from canopen_exo.plan import BusPlan, JointNode
from fi_gateway.boundary import SpecModel, validate
from fi_gateway.distributions import (
    Binomial,
    Curve,
    Distribution,
    Exponential,
    Gamma,
    Normal,
    Poisson,
    TwoWeibull,
    Weibull,
)
from fi_gateway.effect_specs import DistributedEffectSpec, EffectSpec, MttrSpec
from fi_gateway.errors import FaultError
from fi_gateway.event_specs import DistributedEventSpec, EventSpec, FailureProbabilitySpec, MttfSpec, RateSpec
from fi_gateway.marked_yaml import parse

PLAN: Final = BusPlan((JointNode("right_knee", 5, 54_900, 131_072),))
SECOND: Final = 1_000_000_000
SEEDS: Final = range(20)
DRAWS: Final = 1000
LEVEL: Final = 0.01
ALLOWED: Final = 2


class Mixture:
    """A mixture of two frozen scipy distributions, as far as a test of fit needs it."""

    def __init__(self, share: float, first: Any, second: Any) -> None:
        self.share, self.first, self.second = share, first, second

    def cdf(self, x: Any) -> Any:
        return self.share * self.first.cdf(x) + (1 - self.share) * self.second.cdf(x)


def above_zero(mean: float, sd: float) -> Any:
    """The normal truncated at 0."""
    return stats.truncnorm(-mean / sd, np.inf, mean, sd)


@dataclass(frozen=True)
class Law:
    """A distribution in a file, that of scipy [s, or periods], and one that is not it. period_s: 0 when continuous."""

    text: str
    right: Any
    wrong: Any
    period_s: float = 0.0


LAWS: Final = {
    "normal": Law("{type: normal, mean: 2 s, sd: 0.5 s}", above_zero(2, 0.5), above_zero(2, 0.6)),
    "truncated_normal": Law("{type: normal, mean: 0.3 s, sd: 1 s}", above_zero(0.3, 1), stats.halfnorm(0, 1)),
    "weibull": Law("{type: weibull, shape: 1.5, scale: 2 s}", stats.weibull_min(1.5, scale=2), stats.expon(scale=1.8)),
    "gamma": Law("{type: gamma, shape: 2, scale: 0.5 s}", stats.gamma(2, scale=0.5), stats.weibull_min(2, scale=1.13)),
    "exponential": Law("{type: exponential, mean: 2 s}", stats.expon(scale=2), stats.expon(scale=2.4)),
    "poisson": Law("{type: poisson, mean: 3, period: 10 ms}", stats.poisson(3), stats.geom(0.25, -1), 0.01),
    "binomial": Law("{type: binomial, n: 10, p: 0.3, period: 20 ms}", stats.binom(10, 0.3), stats.poisson(3), 0.02),
    "two_weibull": Law(
        "{type: two_weibull, share: 20 %, first: {shape: 0.7, scale: 0.1 s}, second: {shape: 4, scale: 5 s}}",
        Mixture(0.2, stats.weibull_min(0.7, scale=0.1), stats.weibull_min(4, scale=5)),
        Mixture(0.3, stats.weibull_min(0.7, scale=0.1), stats.weibull_min(4, scale=5)),
    ),
    "triangle": Law(
        "{type: curve, points: [[0 s, 0], [1 s, 2], [3 s, 0]]}",
        stats.triang(1 / 3, 0, 3),
        stats.triang(1 / 2, 0, 3),
    ),
    "trapezoid": Law(
        "{type: curve, points: [[1 s, 0], [2 s, 0.7], [4 s, 0.7], [5 s, 0]]}",
        stats.trapezoid(0.25, 0.75, 1, 4),
        stats.uniform(1, 4),
    ),
}
"""Keys `law` of events and effects."""

EVENTS: Final = {
    "failure_probability": (
        FailureProbabilitySpec,
        Law("{type: failure_probability, p: 0.2, per: 1 ms}", stats.geom(0.2), stats.geom(0.25), 1e-3),
    ),
    "failure_probability_per_sync": (
        FailureProbabilitySpec,
        Law("{type: failure_probability, p: 0.2, per: sync}", stats.geom(0.2), stats.poisson(4, 1), 2e-3),
    ),
    "rate": (RateSpec, Law("{type: rate, lambda: 0.5/s}", stats.expon(scale=2), stats.expon(scale=1.6))),
    "mttf": (MttfSpec, Law("{type: mttf, mean: 2 s, sd: 0.5 s}", above_zero(2, 0.5), above_zero(2.1, 0.5))),
    **{
        name: (
            DistributedEventSpec,
            Law(f"{{type: distribution, law: {law.text}}}", law.right, law.wrong, law.period_s),
        )
        for name, law in LAWS.items()
    },
}
EFFECTS: Final = {
    "mttr": (MttrSpec, Law("{type: mttr, mean: 0.3 s, sd: 1 s}", above_zero(0.3, 1), stats.norm(0.3, 1))),
    **{
        name: (
            DistributedEffectSpec,
            Law(f"{{type: distribution, law: {law.text}}}", law.right, law.wrong, law.period_s),
        )
        for name, law in LAWS.items()
    },
}


def spec(model: type[SpecModel], text: str) -> Any:
    found = validate(model, parse(f"x: {text}", "s.yaml").data["x"], (), None)  # type: ignore[index, call-overload]
    assert found is not None
    return found


def rejections(samples: Callable[[int], list[float]], law: Any, is_discrete: bool) -> int:
    """How many of the seeds speak against the law at the level."""
    count = 0
    for seed in SEEDS:
        test = _chi_squared if is_discrete else _kolmogorov_smirnov
        count += test(samples(seed), law) < LEVEL
    return count


def _kolmogorov_smirnov(found: list[float], law: Any) -> float:
    return float(stats.kstest(found, law.cdf).pvalue)


def _chi_squared(found: list[float], law: Any) -> float:
    """Cells of one value each where 5 or more are expected; both tails are one cell each."""
    n = len(found)
    values = [k for k in range(1000) if n * law.pmf(k) >= 5]
    low, high = values[0], values[-1]
    expected = [n * law.cdf(low), *(n * law.pmf(k) for k in range(low + 1, high)), n * law.sf(high - 1)]
    observed = [
        sum(k <= low for k in found),
        *(found.count(k) for k in range(low + 1, high)),
        sum(k >= high for k in found),
    ]
    return float(stats.chisquare(observed, expected).pvalue)


def gaps(event: EventSpec, period_s: float, seed: int) -> list[float]:
    """Times to the next failure, each from the end of an activation that lasts a third of a second or of a period.

    [s], or grid points from the first one that can be: strictly after the end for a trial per period, at the end or
    after it for a counting distribution.
    """
    found, end = [], 0
    source = event.build(PLAN, Generator(PCG64(seed)))
    period = round(period_s * SECOND)
    length = SECOND // 3 if not period else period // 3
    for _ in range(DRAWS):
        due = source.next(end)
        if not period:
            found.append((due - end) / SECOND)
        else:
            assert due % period == 0
            strictly = isinstance(event, FailureProbabilitySpec)
            first = end // period if strictly else -(-end // period)
            found.append((due // period) - first)
        end = due + length
    return found


def lengths(effect: EffectSpec, period_s: float, seed: int) -> list[float]:
    """Durations [s], or in periods (the shortest window, 1 ns, is 0 of them)."""
    built = effect.build(PLAN, Generator(PCG64(seed)))
    drawn = [built.duration() for _ in range(DRAWS)]
    if not period_s:
        return [one / SECOND for one in drawn]
    period = round(period_s * SECOND)
    assert all(one == 1 or one % period == 0 for one in drawn)
    return [one // period for one in drawn]


@pytest.mark.long
@pytest.mark.parametrize("name", EVENTS)
def test_an_event_has_the_distribution_it_is_named_after(name: str) -> None:
    """Each event distribution is the one named; the grid of those that count periods goes on after expiry."""
    model, law = EVENTS[name]
    event = spec(model, law.text)
    drawn = {seed: gaps(event, law.period_s, seed) for seed in SEEDS}
    assert rejections(drawn.__getitem__, law.right, law.period_s > 0) <= ALLOWED
    assert rejections(drawn.__getitem__, law.wrong, law.period_s > 0) > ALLOWED


@pytest.mark.long
@pytest.mark.parametrize("name", EFFECTS)
def test_an_effect_has_the_distribution_it_is_named_after(name: str) -> None:
    """Each effect distribution is the one named."""
    model, law = EFFECTS[name]
    effect = spec(model, law.text)
    drawn = {seed: lengths(effect, law.period_s, seed) for seed in SEEDS}
    assert rejections(drawn.__getitem__, law.right, law.period_s > 0) <= ALLOWED
    assert rejections(drawn.__getitem__, law.wrong, law.period_s > 0) > ALLOWED


@pytest.mark.long
def test_every_frame_has_its_own_trial() -> None:
    """failure_probability per frame: the number of frames to the next one is geometric, whatever their times."""
    law = spec(FailureProbabilitySpec, "{type: failure_probability, p: 20 %, per: frame}")

    def frames(seed: int) -> list[float]:
        event = law.build(PLAN, Generator(PCG64(seed)))
        found: list[float] = []
        count = 0
        while len(found) < DRAWS:
            count += 1
            if event.observe(7 * count, Frame(0x185, bytes(8))):
                found.append(float(count))
                count = 0
        return found

    drawn = {seed: frames(seed) for seed in SEEDS}
    assert rejections(drawn.__getitem__, stats.geom(0.2), True) <= ALLOWED
    assert rejections(drawn.__getitem__, stats.geom(0.25), True) > ALLOWED


DISTRIBUTIONS: Final = (
    Normal(0.3e9, 1e9),
    Weibull(0.5, 1e9),
    Gamma(0.1, 1e9),
    Exponential(1.0),
    Poisson(0.1, MS),
    Binomial(3, 0.01, MS),
    TwoWeibull(0.5, Weibull(0.1, 1e9), Weibull(1, 1)),
    Curve((0, 1, 5 * MS), (1.0, 0.0, 2.0)),
)


@pytest.mark.parametrize("distribution", DISTRIBUTIONS, ids=lambda one: type(one).__name__)
def test_every_time_goes_on_and_copies_draw_the_same(distribution: Distribution) -> None:
    """At least 1 ns, so that no two things happen for ever at one instant; 0 only for counted periods."""
    rng = Generator(PCG64(3))
    least = 0 if distribution.period_ns else 1
    drawn = [distribution.draw(rng) for _ in range(500)]
    assert all(least <= one <= NEVER for one in drawn)
    for copied in (copy.deepcopy(distribution), pickle.loads(pickle.dumps(distribution))):
        rng = Generator(PCG64(3))
        assert [copied.draw(rng) for _ in range(500)] == drawn
        assert copied.period_ns == distribution.period_ns


def test_a_time_beyond_all_time_is_never() -> None:
    """A Weibull of a very small shape overflows; nothing wraps."""
    rng = Generator(PCG64(0))
    assert NEVER in {Weibull(1e-3, 1e9).draw(rng) for _ in range(20)}


def test_a_normal_without_spread_is_its_mean() -> None:
    """sd 0."""
    assert Normal(5e8, 0.0).draw(Generator(PCG64(0))) == 500_000_000


@given(
    st.lists(st.tuples(st.integers(1, 10**9), st.floats(0, 1e9)), min_size=2, max_size=8),
    st.integers(0, 10**9),
    st.integers(0, 2**32),
)
def test_a_curve_draws_where_its_density_is(steps: list[tuple[int, float]], start: int, seed: int) -> None:
    """Never before the first point, after the last, or (but for rounding to ns) in a stretch where both ends are 0."""
    times = [start]
    for step, _ in steps[1:]:
        times.append(times[-1] + step)
    weights = tuple(weight for _, weight in steps)
    assume(max(weights) >= 1e-6)
    curve = Curve(tuple(times), weights)
    rng = Generator(PCG64(seed))
    for _ in range(20):
        time = curve.draw(rng)
        assert max(1, times[0]) <= time <= max(1, times[-1])
        at = next(at for at in range(1, len(times)) if time <= times[at] or at == len(times) - 1)
        near = weights[max(0, at - 2) : at + 2]
        assert max(near) > 0


@pytest.mark.parametrize(
    ("build", "message"),
    [
        (lambda: Normal(0, 1), "mean"),
        (lambda: Normal(float("nan"), 1), "mean"),
        (lambda: Normal(1, -1), "sd"),
        (lambda: Normal(1, float("inf")), "sd"),
        (lambda: Weibull(0, 1), "shape"),
        (lambda: Weibull(1, 0), "scale"),
        (lambda: Gamma(-1, 1), "shape"),
        (lambda: Gamma(1, float("nan")), "scale"),
        (lambda: Exponential(0), "mean"),
        (lambda: Poisson(0, 1), "mean"),
        (lambda: Poisson(1e10, 1), "mean"),
        (lambda: Poisson(1, 0), "period"),
        (lambda: Binomial(0, 0.5, 1), "trials"),
        (lambda: Binomial(1, 1.1, 1), "p 1.1"),
        (lambda: Binomial(1, 0.5, 0), "period"),
        (lambda: TwoWeibull(1.5, Weibull(1, 1), Weibull(1, 1)), "share"),
        (lambda: Curve((0,), (1.0,)), "1 times"),
        (lambda: Curve((0, 1), (1.0,)), "1 weights"),
        (lambda: Curve((0, 0), (1.0, 1.0)), "rising"),
        (lambda: Curve((-1, 1), (1.0, 1.0)), "rising"),
        (lambda: Curve((0, NEVER), (1.0, 1.0)), "rising"),
        (lambda: Curve((0, 1), (0.0, 0.0)), "not all 0"),
        (lambda: Curve((0, 1), (-1.0, 2.0)), "0 and more"),
        (lambda: Curve((0, 1), (float("nan"), 2.0)), "0 and more"),
    ],
)
def test_a_distribution_that_cannot_be_is_refused(build: Callable[[], Distribution], message: str) -> None:
    """The message names what is allowed."""
    with pytest.raises(FaultError, match=message) as caught:
        build()
    assert "allowed" in str(caught.value)


def complaint(text: str) -> str:
    """The one message about a law in a file."""
    document = parse(f"law: {text}\ntype: distribution\n", "s.yaml")
    validate(DistributedEventSpec, document.data, (), document)
    (problem,) = document.problems
    return document.line(problem)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("{type: normal, mean: 2, sd: 1 s}", "s.yaml:1:27: law.mean: 2 has no unit; a duration needs one"),
        ("{type: normal, mean: 2 s}", "law.sd: missing; needed: type, mean, sd"),
        ("{type: weibull, shape: 2 s, scale: 1 s}", "law.shape: expected a plain number; got '2 s'"),
        ("{type: weibull, shape: 0, scale: 1 s}", "law.shape: 0 is not allowed; allowed is more than 0"),
        ("{type: weibul, shape: 2, scale: 1 s}", "law.type: unknown law 'weibul'; did you mean 'weibull'?"),
        ("{type: poisson, mean: 3}", "law.period: missing; needed: type, mean, period"),
        ("{type: binomial, n: 0, p: 0.1, period: 1 s}", "law.n: 0 is too small; allowed from 1 up"),
        ("{type: two_weibull, share: 2, first: {shape: 1, scale: 1 s}, second: {shape: 1, scale: 1 s}}",
         "law.share: 2 is not a probability"),
        ("{type: two_weibull, share: 0.2, first: {shape: 1}, second: {shape: 1, scale: 1 s}}",
         "law.first.scale: missing; needed: shape, scale"),
        ("{type: curve, points: [[0 s, 0], [0 s, 1]]}", "law.points: point 2: '0 s' does not come after"),
        ("{type: curve, points: [[0 s, 0], [1, 1]]}", "law.points: 1 has no unit"),
        ("{type: curve, points: [[0 s, 0], [1 s, -1]]}", "law.points: point 2: expected a weight"),
        ("{type: curve, points: [[0 s, 1]]}", "law.points: a curve needs at least two points"),
        ("{type: curve, points: [0 s, 1 s]}", "law.points: point 1: expected a time and a weight"),
        ("{type: curve, points: 3}", "law.points: expected a list of points"),
    ],
)  # fmt: skip
def test_a_law_in_a_file_that_cannot_be_is_refused(text: str, message: str) -> None:
    """file:line:col, what, got, allowed."""
    assert message in complaint(text)
