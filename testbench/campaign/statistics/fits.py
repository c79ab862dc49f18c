"""A parabola through measured numbers over one parameter, such as an RMSE over the duration of a fault.

y = c0 + c1 x + c2 x^2 + e by least squares. Sources: N. R. Draper, H. Smith, Applied Regression Analysis, 3rd edition,
sections 1.4, 2.1 (lack of fit) and 5.1 (matrix form); R. M. Bell, D. F. McCaffrey, Survey Methodology 28 (2002) 169,
and A. C. Cameron, D. L. Miller, J. Human Resources 50 (2015) 317, section VI.B (jackknife over groups, "CV3").
More in docs/statistics.md.
"""

from collections.abc import Hashable, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from testbench.campaign.statistics.samples import as_sample
from testbench.campaign.statistics.shares import Interval, NotEstimableError, check_confidence

__all__ = ["QuadraticFit", "quadratic_fit"]

Array = NDArray[np.float64]
TERMS: Final = 3
LEAST_GROUPS: Final = 8
"""Below, a spread over groups says little about the groups that were not seen."""


@dataclass(frozen=True, slots=True)
class QuadraticFit:
    """A fitted parabola.

    coefficients: c0, c1, c2, in the units of y / x^k. covariance: of the coefficients, rows of three, None when the
    data leave no degree of freedom. freedom: degrees of freedom of its t quantile. sd: of the values about the curve
    (n - 3), None for n = 3. r_squared: 1 - residual / total sum of squares about the mean, None when all y are equal.
    lack_of_fit_p: how likely the means at each x lie this far from any parabola by chance (F test for independent
    runs of equal spread), None with groups, without repeated x or without a fourth x. low, high: range of x.
    grouped: whether runs of one group may depend on each other.
    """

    n: int
    coefficients: tuple[float, float, float]
    covariance: tuple[tuple[float, float, float], ...] | None
    freedom: int
    sd: float | None
    r_squared: float | None
    lack_of_fit_p: float | None
    low: float
    high: float
    grouped: bool

    def at(self, x: float) -> float:
        """The curve at x."""
        c0, c1, c2 = self.coefficients
        return c0 + x * (c1 + x * c2)

    def band(self, x: float, confidence: float = 0.95) -> Interval:
        """Confidence interval of the curve (of the mean of y, not of single runs) at this one x.

        Not simultaneous: the whole curve lies inside all of them less often. Raises NotEstimableError without a degree
        of freedom, ValueError outside of the range of x, where a parabola says nothing.
        """
        from scipy.special import stdtrit

        check_confidence(confidence)
        if not self.low <= x <= self.high:
            raise ValueError(f"x = {x} is outside of the fitted range {self.low}..{self.high}")
        if self.covariance is None:
            raise NotEstimableError(f"{self.n} values leave no degree of freedom: a parabola always fits three")
        row = np.array([1.0, x, x * x])
        variance = max(0.0, float(row @ np.array(self.covariance) @ row))
        reach = float(stdtrit(self.freedom, (1 + confidence) / 2)) * variance**0.5
        return Interval(self.at(x) - reach, self.at(x) + reach, confidence, "jackknife" if self.grouped else "t")


def quadratic_fit(x: Sequence[float], y: Sequence[float], groups: Sequence[Hashable] | None = None) -> QuadraticFit:
    """The least-squares parabola through (x, y), one value each for every run.

    groups None: the runs are independent and spread alike at every x; covariance sd^2 (X'X)^-1, n - 3 degrees of
    freedom, exact for normal values. Else runs of one group may depend on each other, and the spread may change with
    x: covariance by leaving out one of the G groups at a time, (G - 1) / G sum (c_g - c)(c_g - c)', G - 1 degrees of
    freedom. Points of a campaign share their seeds: then the seed is the group. Independent runs of unequal spread:
    each is a group. Raises NotEstimableError for fewer than three different x, fewer than 8 groups, or a group without
    which three different x are not left; ValueError for NaN or unequal lengths.
    """
    xs, ys = as_sample(x), as_sample(y)
    if xs.size != ys.size or (groups is not None and len(groups) != xs.size):
        raise ValueError("x, y and groups must have the same length")
    if np.unique(xs).size < TERMS:
        raise NotEstimableError(f"a parabola takes three different x; got {np.unique(xs).size}")
    shift, scale = (xs.min() + xs.max()) / 2, (xs.max() - xs.min()) / 2
    u = (xs - shift) / scale  # -1..1, so that the powers are nearly orthogonal
    design = np.stack([np.ones_like(u), u, u * u], axis=1)
    scaled, _, rank, _ = np.linalg.lstsq(design, ys, rcond=None)
    if rank < TERMS:
        raise NotEstimableError("the three different x lie too close together for a parabola")
    residuals = ys - design @ scaled
    residual, total = float(residuals @ residuals), float(((ys - ys.mean()) ** 2).sum())
    freedom = xs.size - TERMS
    sd = (residual / freedom) ** 0.5 if freedom else None
    covariance = None if sd is None else sd**2 * np.linalg.inv(design.T @ design)
    if groups is not None:
        covariance, freedom = _leave_one_out(design, ys, scaled, groups)
    r = shift / scale
    back = np.array([[1, -r, r * r], [0, 1 / scale, -2 * r / scale], [0, 0, 1 / scale**2]])  # powers of u -> of x
    c0, c1, c2 = (float(one) for one in back @ scaled)
    return QuadraticFit(
        n=xs.size,
        coefficients=(c0, c1, c2),
        covariance=None if covariance is None else _rows(back @ covariance @ back.T),
        freedom=freedom,
        sd=sd,
        r_squared=1 - residual / total if ys.min() < ys.max() else None,
        lack_of_fit_p=_lack_of_fit(xs, ys, residual) if groups is None else None,
        low=float(xs.min()),
        high=float(xs.max()),
        grouped=groups is not None,
    )


def _leave_one_out(design: Array, y: Array, whole: Array, groups: Sequence[Hashable]) -> tuple[Array, int]:
    """(covariance of the coefficients, degrees of freedom)."""
    number = {group: index for index, group in enumerate(dict.fromkeys(groups))}
    if len(number) < LEAST_GROUPS:
        raise NotEstimableError(f"{len(number)} groups (seeds) are too few for a band; it takes {LEAST_GROUPS}")
    of = np.array([number[group] for group in groups])
    squares = np.zeros((len(number), TERMS, TERMS))  # X'X and X'y of each group
    products = np.zeros((len(number), TERMS))
    np.add.at(squares, of, design[:, :, None] * design[:, None, :])
    np.add.at(products, of, design * y[:, None])
    rest = squares.sum(axis=0) - squares
    if (np.linalg.matrix_rank(rest, hermitian=True) < TERMS).any():
        raise NotEstimableError("without one of the groups (seeds), three different x are not left")
    change = np.linalg.solve(rest, (products.sum(axis=0) - products)[:, :, None])[:, :, 0] - whole
    return (len(number) - 1) / len(number) * change.T @ change, len(number) - 1


def _lack_of_fit(x: Array, y: Array, residual: float) -> float | None:
    from scipy.special import fdtrc

    levels, of = np.unique(x, return_inverse=True)
    lack_freedom, pure_freedom = levels.size - TERMS, x.size - levels.size
    means = np.bincount(of, weights=y) / np.bincount(of)
    pure = float(((y - means[of]) ** 2).sum())
    if lack_freedom < 1 or pure_freedom < 1 or pure == 0:
        return None
    return float(fdtrc(lack_freedom, pure_freedom, max(0.0, residual - pure) / lack_freedom / (pure / pure_freedom)))


def _rows(matrix: Array) -> tuple[tuple[float, float, float], ...]:
    return tuple((float(a), float(b), float(c)) for a, b, c in matrix)
