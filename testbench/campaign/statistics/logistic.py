"""A logistic curve through shares: P(outcome | x) = 1 / (1 + exp(-(a + b x))), and where it takes a given value.

Fitted by the likelihood with Firth's penalty, l(a, b) + 1/2 log det I(a, b), I the Fisher information, maximised by
Newton's method: it has a finite maximum also where outcomes are separated (none below some x, all above), where plain
maximum likelihood has none. The interval of the x at which P = q is the profile one: all x at which twice the drop of
the penalised likelihood, with P(x) = q held, is at most the chi-squared quantile (1 degree of freedom).
Sources: D. Firth, Biometrika 80 (1993) 27; G. Heinze, M. Schemper, Stat. Med. 21 (2002) 2409, sections 2 and 3;
D. J. Venzon, S. H. Moolgavkar, Appl. Stat. 37 (1988) 87 (profile likelihood). More in docs/statistics.md.
Left out: x on a log scale, other curves, runs that depend on each other.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from statistics import NormalDist
from typing import Final

import numpy as np
from numpy.typing import NDArray

from testbench.campaign.statistics.shares import Interval, NotEstimableError, Tally, check_confidence

__all__ = ["Level", "LogisticFit", "curve_misfit", "fall_misfit", "logistic_fit", "rising_shares"]

Array = NDArray[np.float64]

STEPS: Final = 100
"""Newton takes some ten, and a step some halvings."""
SMALL: Final = 1e-8
"""Of a log-likelihood: what is nothing."""
SIMULATED: Final = 499


@dataclass(frozen=True, slots=True)
class Level:
    """What came out at one x."""

    x: float
    tally: Tally


@dataclass(frozen=True, slots=True)
class LogisticFit:
    """A fitted curve. a: log odds at x = 0; b: their rise per unit of x."""

    levels: tuple[Level, ...]
    a: float
    b: float

    def share(self, x: float) -> float:
        """P(outcome | x), 0..1."""
        return float(_share(np.array(self.a + self.b * x)))

    def quantile(self, q: float) -> float:
        """The x at which P = q; raises NotEstimableError for a curve without slope."""
        if self.b == 0:
            raise NotEstimableError("the fitted curve is level: no x belongs to a share")
        return (_log_odds(q) - self.a) / self.b

    def quantile_interval(self, q: float, confidence: float = 0.95) -> Interval:
        """Profile interval of `quantile(q)`; both ends are infinite where the data do not show that x matters."""
        from scipy.optimize import brentq

        limit = NormalDist().inv_cdf((1 + check_confidence(confidence)) / 2) ** 2  # chi-squared, 1 degree of freedom
        data = _Data.of(self.levels)
        best = _maximum(
            data, np.zeros(data.u.size), data.columns, np.array([self.a + self.b * data.shift, self.b * data.scale])
        )
        level = _maximum(data, np.zeros(data.u.size), data.columns[:, :1], np.zeros(1))
        if self.b == 0 or 2 * (best.value - level.value) <= limit:
            return Interval(-math.inf, math.inf, confidence, "profile likelihood")
        offset = np.full(data.u.size, _log_odds(q))
        middle = (self.quantile(q) - data.shift) / data.scale

        def beyond(u: float) -> float:
            """How far the drop at P(u) = q is beyond the limit."""
            held = _maximum(data, offset, data.columns[:, 1:] - u, best.free[1:])
            return 2 * (best.value - held.value) - limit

        reach = _standard_error(data, best, middle)
        ends = []
        for side in (-1.0, 1.0):
            inner, outer = 0.0, side * reach
            while beyond(middle + outer) <= 0:
                inner, outer = outer, 2 * outer
            ends.append(
                float(brentq(beyond, middle + inner, middle + outer, xtol=1e-6 * reach)) * data.scale + data.shift
            )
        return Interval(ends[0], ends[1], confidence, "profile likelihood")


def logistic_fit(levels: Sequence[Level]) -> LogisticFit:
    """The curve through the levels, those without a trial left out.

    Raises NotEstimableError for fewer than two x, or when all runs came out alike.
    """
    used = tuple(sorted((level for level in levels if level.tally.trials), key=lambda level: level.x))
    if not all(math.isfinite(level.x) for level in used):
        raise ValueError("an x is not a finite number")
    if len({level.x for level in used}) < 2:
        raise NotEstimableError("a curve takes runs at two values at least")
    successes = sum(level.tally.successes for level in used)
    trials = sum(level.tally.trials for level in used)
    if successes in (0, trials):
        raise NotEstimableError(f"{successes} of {trials} runs showed the outcome: all alike, they show no curve")
    data = _Data.of(used)
    best = _curve(data, np.array([_log_odds((successes + 0.5) / (trials + 1)), 0.0]))
    b = float(best.free[1]) / data.scale
    return LogisticFit(used, float(best.free[0]) - b * data.shift, b)


def curve_misfit(fit: LogisticFit, generator: np.random.Generator, simulated: int = SIMULATED) -> float:
    """How likely shares as far from a logistic curve as these are by chance, if the fitted one is true (p-value)."""
    data = _Data.of(fit.levels)
    start = np.array([fit.a + fit.b * data.shift, fit.b * data.scale])
    return _misfit(data, lambda one: _share(one.columns @ _curve(one, start).free), generator, simulated)


def fall_misfit(levels: Sequence[Level], generator: np.random.Generator, simulated: int = SIMULATED) -> float:
    """How likely shares that fall as much as these are by chance, if the closest never falling ones are true (p-value).

    Small: the share falls again as x rises. Levels without a trial are left out; 1 for fewer than two others.
    """
    used = tuple(sorted((level for level in levels if level.tally.trials), key=lambda level: level.x))
    if len({level.x for level in used}) < 2:
        return 1.0
    return _misfit(_Data.of(used), _rising, generator, simulated)


def rising_shares(levels: Sequence[Level]) -> tuple[float, ...]:
    """The likeliest shares that never fall as x rises (isotonic regression); levels sorted by x, all with trials."""
    return tuple(float(share) for share in _rising(_Data.of(levels)))


@dataclass(frozen=True, slots=True)
class _Data:
    """Counts over u = (x - shift) / scale, in -1..1; columns: 1 and u."""

    u: Array
    successes: Array
    trials: Array
    columns: Array
    shift: float
    scale: float

    @classmethod
    def of(cls, levels: Sequence[Level]) -> "_Data":
        x = np.array([level.x for level in levels])
        shift, scale = float(x.min() + x.max()) / 2, float(x.max() - x.min()) / 2
        u = (x - shift) / scale
        successes = np.array([float(level.tally.successes) for level in levels])
        trials = np.array([float(level.tally.trials) for level in levels])
        return cls(u, successes, trials, np.stack([np.ones_like(u), u], axis=1), shift, scale)


@dataclass(frozen=True, slots=True)
class _Best:
    free: Array
    value: float


def _maximum(data: _Data, offset: Array, columns: Array, start: Array) -> _Best:
    """The penalised likelihood of log odds offset + columns @ free at its maximum over free.

    Whatever is free, the penalty is that of the whole curve; its gradient turns into successes + h / 2 of trials + h,
    h the leverage of each level.
    """
    free = start
    value, share, leverage = _penalised(data, offset + columns @ free)
    if math.isinf(value):  # so steep that every share is 0 or 1 to the last digit
        free = np.zeros_like(start)
        value, share, leverage = _penalised(data, offset + columns @ free)
    for _ in range(STEPS):
        trials = data.trials + leverage
        gradient = columns.T @ (data.successes + leverage / 2 - trials * share)
        curvature = columns.T @ ((trials * share * (1 - share))[:, None] * columns)
        step = np.linalg.solve(curvature, gradient)
        if float(gradient @ step) < SMALL:
            return _Best(free, value)
        length, there = _along(data, offset + columns @ free, columns @ step, value)
        if there - value < SMALL * SMALL:
            return _Best(free, value)
        free = free + length * step
        value, share, leverage = _penalised(data, offset + columns @ free)
    raise NotEstimableError("the fit of the curve did not settle")


def _along(data: _Data, odds: Array, change: Array, value: float) -> tuple[float, float]:
    """(length, value there) of a step that is doubled while that helps, or halved until it does."""

    def value_at(length: float) -> float:
        return _penalised(data, odds + length * change)[0]

    length, there = 1.0, value_at(1.0)
    for _ in range(STEPS):
        if there >= value:
            break
        length /= 2
        there = value_at(length)
    while length >= 1 and (further := value_at(2 * length)) > there:
        length, there = 2 * length, further
    return length, there


def _penalised(data: _Data, odds: Array) -> tuple[float, Array, Array]:
    """(log-likelihood with penalty, share and leverage of every level) for the log odds of every level."""
    share = _share(odds)
    weight = data.trials * share * (1 - share)
    s0, s1, s2 = float(weight.sum()), float(weight @ data.u), float(weight @ (data.u * data.u))
    determinant = s0 * s2 - s1 * s1
    if not determinant > 0:
        return -math.inf, share, np.zeros_like(share)
    leverage = weight * (s2 - 2 * s1 * data.u + s0 * data.u * data.u) / determinant
    value = data.successes @ odds - data.trials @ np.logaddexp(0, odds)
    return float(value) + math.log(determinant) / 2, share, leverage


def _curve(data: _Data, start: Array) -> _Best:
    return _maximum(data, np.zeros(data.u.size), data.columns, start)


def _rising(data: _Data) -> Array:
    from scipy.optimize import isotonic_regression

    return np.asarray(isotonic_regression(data.successes / data.trials, weights=data.trials).x)


def _misfit(data: _Data, fit: Callable[[_Data], Array], generator: np.random.Generator, simulated: int) -> float:
    """Parametric bootstrap of the deviance: data simulated from the fit, fitted again, `simulated` times."""
    shares = fit(data)
    found = _deviance(data, shares)
    worse = 0
    for _ in range(simulated):
        drawn = generator.binomial(data.trials.astype(np.int64), shares).astype(np.float64)
        again = replace(data, successes=drawn)
        worse += _deviance(again, fit(again)) >= found - SMALL
    return (1 + worse) / (1 + simulated)


def _deviance(data: _Data, shares: Array) -> float:
    """Twice the log-likelihood ratio of the counted shares against these."""
    from scipy.special import rel_entr

    failed, missing = data.successes, data.trials - data.successes
    expected = data.trials * shares
    return 2 * float(rel_entr(failed, expected).sum() + rel_entr(missing, data.trials - expected).sum())


def _standard_error(data: _Data, best: _Best, u: float) -> float:
    """Of the u at which the curve takes its value there (delta method): where to begin to look for the ends."""
    share = _share(data.columns @ best.free)
    information = data.columns.T @ ((data.trials * share * (1 - share))[:, None] * data.columns)
    row = np.array([1.0, u])
    return math.sqrt(float(row @ np.linalg.solve(information, row))) / abs(float(best.free[1]))


def _share(odds: Array) -> Array:
    return np.asarray((1 + np.tanh(odds / 2)) / 2)  # of the log odds; no overflow


def _log_odds(share: float) -> float:
    if not 0 < share < 1:
        raise ValueError(f"a share of {share} given; allowed is more than 0 and less than 1")
    return math.log(share / (1 - share))
