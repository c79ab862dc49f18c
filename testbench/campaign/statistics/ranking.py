"""Which parameters matter: how much of the ranks of a result each parameter explains, by itself.

Numbers: Spearman's rank correlation rho (ties at their mean rank), which sees what rises or falls. Numbers with
repeated values, and names: eta squared of the ranks, from Kruskal-Wallis H, which sees any difference between values.
Sources: M. G. Kendall, Rank Correlation Methods, 4th edition, chapters 2 and 3 (ties); W. H. Kruskal, W. A. Wallis,
J. Am. Stat. Assoc. 47 (1952) 583; M. Tomczak, E. Tomczak, Trends Sport Sci. 1 (2014) 19 (eta squared from H).
Left out: effects that show only in combination (interactions); two parameters that cancel each other look like nothing.
"""

import math
from collections.abc import Hashable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Final

import numpy as np
from numpy.typing import NDArray

from testbench.campaign.statistics.samples import as_sample
from testbench.campaign.statistics.shares import Interval, NotEstimableError, check_confidence

__all__ = ["Effect", "Ranking", "Together", "rank_parameters", "spearman"]

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]
LEAST_RUNS: Final = 10
"""Below, neither the approximate p-values nor the interval are worth their names."""
LEAST_GROUPS: Final = 8
NOT_SEPARABLE: Final = 0.5
"""Share of the ranks of one parameter that another explains, from which on their effects cannot be told apart."""
MOST_BLOCKS: Final = 200
"""Groups are put together, in turn, into so many blocks: the interval would change little with more."""


@dataclass(frozen=True, slots=True)
class Effect:
    """What one parameter explains of the ranks of the result.

    numeric: its values are numbers. levels: how many different ones. strength: share of the rank variance explained,
    corrected for chance, so that it is about 0 (and may be negative) for a parameter without effect, 1 for one that
    decides the order alone; the larger one of rho squared and eta squared. rho: Spearman, None for names; interval: of
    rho, None where |rho| is 1. eta_squared: corrected, None for numbers that are all but never repeated, and for
    values of which each is found in one group alone: it would be that of the groups. p_value: of no dependence, of
    whichever strength is from; None for runs in groups. reason: why there is no strength, "" otherwise.
    """

    parameter: str
    numeric: bool
    levels: int
    strength: float | None
    rho: float | None = None
    interval: Interval | None = None
    eta_squared: float | None = None
    p_value: float | None = None
    reason: str = ""


@dataclass(frozen=True, slots=True)
class Together:
    """Two parameters that vary together in these runs; share: of the ranks of one explained by the other."""

    first: str
    second: str
    share: float


@dataclass(frozen=True, slots=True)
class Ranking:
    """effects: strongest first, those without strength last. not_separable: whose effects cannot be told apart."""

    n: int
    effects: tuple[Effect, ...]
    not_separable: tuple[Together, ...]


def spearman(x: Sequence[float], y: Sequence[float]) -> float:
    """Spearman's rho: Pearson correlation of mean ranks; NotEstimableError if all of x or y are equal."""
    xs, ys = as_sample(x), as_sample(y)
    if xs.size != ys.size:
        raise ValueError("x and y must have the same length")
    if xs.min() == xs.max() or ys.min() == ys.max():
        raise NotEstimableError("all values of x or of y are equal: there is no order to compare")
    return _correlation(_ranks(xs), _ranks(ys))


def rank_parameters(
    parameters: Mapping[str, Sequence[float] | Sequence[str]],
    result: Sequence[float],
    groups: Sequence[Hashable] | None = None,
    confidence: float = 0.95,
) -> Ranking:
    """The parameters by how much of the order of `result` each explains.

    parameters: name -> one value for every run, all numbers or all names. result: a metric, or an outcome as 1 and 0.
    groups: as in fits.quadratic_fit; None for independent runs. Each p-value looks at one parameter: of twenty without
    effect, one is below 0.05. Raises NotEstimableError for fewer than 10 runs, a result that is always the same, or
    fewer than 8 groups; ValueError for columns of unequal length, NaN, or values of mixed kinds.
    """
    check_confidence(confidence)
    ys = as_sample(result)
    for name, column in parameters.items():
        if len(column) != ys.size:
            raise ValueError(f"{name}: {len(column)} values for {ys.size} runs")
    if groups is not None and len(groups) != ys.size:
        raise ValueError(f"{len(groups)} groups for {ys.size} runs")
    if ys.size < LEAST_RUNS:
        raise NotEstimableError(f"{ys.size} runs are too few to rank parameters; it takes {LEAST_RUNS}")
    if ys.min() == ys.max():
        raise NotEstimableError(f"the result is {ys[0]:g} in all {ys.size} runs: nothing depends on any parameter")
    blocks = _blocks(range(ys.size) if groups is None else groups)
    effects = [_effect(name, column, ys, groups, blocks, confidence) for name, column in parameters.items()]
    effects.sort(key=lambda effect: -math.inf if effect.strength is None else effect.strength, reverse=True)
    pairs = (
        Together(one, other, _explained(parameters[one], parameters[other]))
        for one, other in combinations(parameters, 2)
    )
    return Ranking(ys.size, tuple(effects), tuple(pair for pair in pairs if pair.share >= NOT_SEPARABLE))


def _effect(
    name: str,
    column: Sequence[float] | Sequence[str],
    ys: Array,
    groups: Sequence[Hashable] | None,
    blocks: IntArray,
    confidence: float,
) -> Effect:
    from scipy.special import chdtrc, stdtr

    codes, levels = _codes(column)
    numeric = _is_numeric(name, column)
    if levels < 2:
        return Effect(name, numeric, levels, None, reason="it has the same value in every run")
    n, ranks = ys.size, _ranks(ys)
    chances: list[float] = []
    found: list[float] = []
    rho: float | None = None
    interval: Interval | None = None
    eta_squared: float | None = None
    if numeric:
        xs = as_sample([float(value) for value in column])
        rho = _correlation(_ranks(xs), ranks)
        interval = _jackknife(xs, ys, blocks, confidence) if abs(rho) < 1 else None
        found.append(1 - (1 - rho * rho) * (n - 1) / (n - 2))
        t = abs(rho) * math.sqrt((n - 2) / max(1 - rho * rho, 1e-300))
        chances.append(2 * float(stdtr(n - 2, -t)))
    is_of_groups = groups is not None and len(set(zip(column, groups, strict=True))) == levels
    if 2 * levels <= n and not is_of_groups:
        between = _between(codes, ranks[:, None])
        eta_squared = 1 - (1 - between) * (n - 1) / (n - levels)
        found.append(eta_squared)
        chances.append(float(chdtrc(levels - 1, (n - 1) * between)))
    if not found:
        why = "each in one group (seed) alone" if is_of_groups else "too few runs for each"
        return Effect(name, numeric, levels, None, reason=f"{levels} names in {n} runs: {why}")
    p_value = min(1.0, len(chances) * min(chances)) if groups is None else None
    return Effect(name, numeric, levels, max(found), rho, interval, eta_squared, p_value)


def _is_numeric(name: str, column: Sequence[float] | Sequence[str]) -> bool:
    kinds = {isinstance(value, str) for value in column}
    if len(kinds) > 1:
        raise ValueError(f"{name}: numbers and names mixed; give all of them as names")
    return kinds == {False}


def _codes(column: Sequence[float] | Sequence[str]) -> tuple[IntArray, int]:
    number = {value: index for index, value in enumerate(dict.fromkeys(column))}
    return np.array([number[value] for value in column]), len(number)


def _ranks(values: Array) -> Array:
    """1 for the smallest; equal values have the mean of their ranks."""
    _, of, counts = np.unique(values, return_inverse=True, return_counts=True)
    last = np.cumsum(counts)
    return ((2 * last - counts + 1) / 2)[of]


def _correlation(x: Array, y: Array) -> float:
    dx, dy = x - x.mean(), y - y.mean()
    return max(-1.0, min(1.0, float(dx @ dy) / math.sqrt(float(dx @ dx) * float(dy @ dy))))


def _between(codes: IntArray, columns: Array) -> float:
    """Share of the variance of the columns (n, k) between the levels; of ranks it is H / (n - 1), ties corrected."""
    counts = np.bincount(codes)
    within = total = 0.0
    for column in columns.T:
        means = np.bincount(codes, weights=column) / counts
        within += float(((column - means[codes]) ** 2).sum())
        total += float(((column - column.mean()) ** 2).sum())
    return max(0.0, 1 - within / total)


def _blocks(groups: Iterable[Hashable]) -> IntArray:
    """A block for every run, whole groups, at most MOST_BLOCKS of nearly the same number of groups."""
    listed = list(groups)
    number = {group: index for index, group in enumerate(dict.fromkeys(listed))}
    if len(number) < LEAST_GROUPS:
        raise NotEstimableError(f"{len(number)} groups (seeds) are too few to rank parameters; it takes {LEAST_GROUPS}")
    return np.array([number[group] % MOST_BLOCKS for group in listed])


def _jackknife(xs: Array, ys: Array, blocks: IntArray, confidence: float) -> Interval | None:
    """Of rho, by leaving out one block at a time on Fisher's scale z = atanh(rho); None where rho becomes +-1."""
    from scipy.special import stdtrit

    count = int(blocks.max()) + 1
    left = []
    for block in range(count):
        keep = blocks != block
        x, y = xs[keep], ys[keep]
        if x.min() == x.max() or y.min() == y.max():
            return None
        left.append(_correlation(_ranks(x), _ranks(y)))
    if max(abs(rho) for rho in left) >= 1:
        return None
    z = math.atanh(_correlation(_ranks(xs), _ranks(ys)))
    error = math.sqrt((count - 1) / count * sum((math.atanh(rho) - z) ** 2 for rho in left))
    reach = float(stdtrit(count - 1, (1 + confidence) / 2)) * error
    return Interval(math.tanh(z - reach), math.tanh(z + reach), confidence, "jackknife")


def _explained(one: Sequence[float] | Sequence[str], other: Sequence[float] | Sequence[str]) -> float:
    """Share of one parameter (of its ranks; of its names, each as 0 and 1) that the other explains, the larger way."""
    codes, shares = [_codes(column) for column in (one, other)], [0.0]
    if min(levels for _, levels in codes) < 2:
        return 0.0
    n, columns = len(one), [_columns(column) for column in (one, other)]
    for (of, levels), target in ((codes[0], columns[1]), (codes[1], columns[0])):
        if 2 * levels <= n:
            shares.append(1 - (1 - _between(of, target)) * (n - 1) / (n - levels))
    if not any(isinstance(column[0], str) for column in (one, other)):
        shares.append(_correlation(columns[0][:, 0], columns[1][:, 0]) ** 2)
    return max(shares)


def _columns(column: Sequence[float] | Sequence[str]) -> Array:
    if not isinstance(column[0], str):
        return _ranks(as_sample([float(value) for value in column]))[:, None]
    codes, levels = _codes(column)
    return np.eye(levels)[codes]
