"""Lost frames: against scipy."""

from itertools import groupby

import pytest
from scipy import stats

from fi_gateway.errors import FaultError
from fi_gateway.faults import BurstDrop, Drop
from tests.fi_gateway.faults.bench import OUT, begun, joint, rng


@pytest.mark.parametrize(("probability", "lost"), [(0.0, 0), (1.0, 200)])
def test_drop_with_certainty(probability: float, lost: int) -> None:
    """faults.md: the frame is lost with probability p."""
    fault, frame = begun(Drop(probability)), joint(1, 2)
    assert [fault.apply(n, frame, OUT) for n in range(200)].count(None) == lost


def test_drop_follows_the_binomial_distribution() -> None:
    """P(lost) = p, tested two-sided at 1 % with a fixed seed."""
    fault, frame = begun(Drop(0.3)), joint(1, 2)
    results = [fault.apply(n, frame, OUT) for n in range(5000)]
    assert all(result is None or result is frame for result in results)
    assert stats.binomtest(results.count(None), 5000, 0.3).pvalue > 0.01


@pytest.mark.parametrize("probability", [-0.1, 1.1, float("nan")])
def test_drop_refuses_what_is_no_probability(probability: float) -> None:
    """Bad parameters are refused where they are made."""
    with pytest.raises(FaultError, match=r"allowed 0\.\.1"):
        Drop(probability)


def losses(seed: int, p: float, r: float, good: float, bad: float, number: int) -> list[bool]:
    """Which frames of one activation are lost."""
    fault, frame = begun(BurstDrop(p, r, good, bad), seed=seed), joint(1, 2)
    return [fault.apply(n, frame, OUT) is None for n in range(number)]


def runs(lost: list[bool], which: bool) -> list[int]:
    """Lengths of the runs of lost (or passed) frames, without the first and the last, which may be cut."""
    found = [(value, len(list(group))) for value, group in groupby(lost)]
    return [length for value, length in found[1:-1] if value == which]


def geometric_pvalue(lengths: list[int], p: float) -> float:
    """Chi-squared of lengths against P(k) = p (1-p)^(k-1), with as many classes as have 10 expected."""
    classes = max(k for k in range(1, 50) if len(lengths) * p * (1 - p) ** (k - 1) >= 10)
    seen = [lengths.count(k) for k in range(1, classes + 1)]
    share = [p * (1 - p) ** (k - 1) for k in range(1, classes + 1)]
    expected = [len(lengths) * x for x in (*share, 1 - sum(share))]
    return float(stats.chisquare([*seen, len(lengths) - sum(seen)], expected).pvalue)


@pytest.mark.long
@pytest.mark.parametrize(("lost", "given", "wrong"), [(True, 0.25, 0.3), (False, 0.1, 0.12)], ids=["bursts", "gaps"])
def test_bursts_and_gaps_of_a_gilbert_channel_are_geometric(lost: bool, given: float, wrong: float) -> None:
    """P(bad -> good) = r gives bursts of 1 / r frames, p gaps of 1 / p. Chi-squared at 1 %, seeds 0..19, at most 2."""
    samples = [runs(losses(seed, 0.1, 0.25, 0.0, 1.0, 30_000), lost) for seed in range(20)]
    assert sum(geometric_pvalue(sample, given) < 0.01 for sample in samples) <= 2
    assert sum(geometric_pvalue(sample, wrong) < 0.01 for sample in samples) > 10


def pattern_shares(p: float, r: float, loss: tuple[float, float], start_bad: float) -> list[float]:
    """P(lost, lost), P(lost, passed), P(passed, lost), P(passed, passed) of the first two frames. loss: (good, bad)."""
    start, change = (1 - start_bad, start_bad), ((1 - p, p), (r, 1 - r))
    return [
        sum(
            start[i] * (loss[i] if first else 1 - loss[i]) * change[i][j] * (loss[j] if second else 1 - loss[j])
            for i in (0, 1)
            for j in (0, 1)
        )
        for first in (True, False)
        for second in (True, False)
    ]


def test_a_gilbert_elliott_channel_is_met_in_its_steady_state() -> None:
    """Of every window the first two frames: all four patterns, chi-squared at 1 %, seeds 0..19, at most 2 rejections.

    Independent losses of the same mean, and a channel that always begins good, must be rejected.
    """
    p, r, good, bad = 0.1, 0.3, 0.05, 0.8
    mean = (p * bad + r * good) / (p + r)
    laws = [
        pattern_shares(p, r, (good, bad), p / (p + r)),
        [mean * mean, mean * (1 - mean), (1 - mean) * mean, (1 - mean) ** 2],
        pattern_shares(p, r, (good, bad), 0.0),
    ]
    rejected = [0, 0, 0]
    for seed in range(20):
        fault, stream, frame = BurstDrop(p, r, good, bad), rng(seed), joint(1, 2)
        seen = [0, 0, 0, 0]
        for _ in range(4000):
            fault.begin(0, {}, stream)
            first, second = (fault.apply(n, frame, OUT) is None for n in (0, 1))
            seen[2 * (not first) + (not second)] += 1
            fault.end()
        for number, law in enumerate(laws):
            rejected[number] += stats.chisquare(seen, [4000 * share for share in law]).pvalue < 0.01
    assert rejected[0] <= 2
    assert min(rejected[1:]) > 10


@pytest.mark.parametrize(
    ("p", "r", "good", "bad", "lost"),
    [(0.0, 1.0, 0.0, 1.0, 0), (0.0, 0.5, 1.0, 0.0, 100), (1.0, 0.0, 0.0, 1.0, 100), (1.0, 1.0, 0.0, 1.0, 50)],
)
def test_burst_drop_with_certainty(p: float, r: float, good: float, bad: float, lost: int) -> None:
    """Never bad; never bad but losing all; always bad; every other frame."""
    assert sum(losses(1, p, r, good, bad, 100)) == lost


@pytest.mark.parametrize("name", ["p", "r", "loss_good", "loss_bad"])
@pytest.mark.parametrize("value", [-0.1, 1.1, float("nan")])
def test_burst_drop_refuses_what_is_no_probability(name: str, value: float) -> None:
    """Bad parameters are refused where they are made."""
    with pytest.raises(FaultError, match=rf"drop: {name} .* allowed 0\.\.1"):
        BurstDrop(**{"p": 0.1, "r": 0.1, "loss_good": 0.0, "loss_bad": 1.0, name: value})


def test_a_channel_that_never_changes_is_refused() -> None:
    """It has no steady state."""
    with pytest.raises(FaultError, match="both 0"):
        BurstDrop(0.0, 0.0)
