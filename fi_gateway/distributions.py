"""Distributions of a time: to the next failure (events), or of an activation (effects).

Times are ns. A distribution with a `period_ns` counts whole periods instead: it is discrete, and its user puts it on a
grid. Draws come from numpy's Generator; the truncated normal, the mixture and the curve are made here of its draws.
Sources: Fabarisov et al., ESREL 2020 (FIBlock), "failure distribution"; IEC 61703:2016 for mean times; the mixture of
two Weibulls is the usual model of early failures and wear-out. Left out: location parameters, censoring.
"""

from bisect import bisect_right
from math import sqrt
from typing import Final, final

from mypy_extensions import mypyc_attr
from numpy.random import Generator

from canopen_exo.bus.node import NEVER
from fi_gateway.errors import FaultError


def _whole(time: float) -> int:
    """A drawn time as whole ns: at least 1, so that time goes on, at most NEVER."""
    if time < 1.0:
        return 1
    return NEVER if time >= NEVER else int(time + 0.5)


def _positive(what: str, value: float) -> None:
    """Refuse what is not a finite number above 0; what: "weibull: shape"."""
    if not 0.0 < value < NEVER:  # also refuses NaN
        raise FaultError(f"{what} {value} given, allowed more than 0, up to {NEVER - 1}")


@mypyc_attr(allow_interpreted_subclasses=True)
class Distribution:
    """Of a time. period_ns: > 0 when draws are whole periods of that length, 0 when they are ns."""

    def __init__(self, period_ns: int = 0) -> None:
        self.period_ns: int = period_ns

    def draw(self, rng: Generator) -> int:
        """The next time: ns, 1..NEVER; or, with a period, periods, 0 and more."""
        raise NotImplementedError

    def __deepcopy__(self, memo: dict[int, object]) -> "Distribution":
        return self  # it never changes: copies share it


@final
class Normal(Distribution):
    """Normal, truncated at > 0: mean_ns (> 0) and sd_ns (>= 0) are those before truncation.

    FIBlock: MTTF and MTTR, with sd 1 s and not truncated there (MTTR 0.3 s gives 38 % zero-length faults).
    """

    def __init__(self, mean_ns: float, sd_ns: float) -> None:
        super().__init__()
        _positive("normal: mean [ns]", mean_ns)
        if not 0.0 <= sd_ns < NEVER:
            raise FaultError(f"normal: sd {sd_ns} ns given, allowed 0..{NEVER - 1} ns")
        self._mean_ns: Final[float] = mean_ns
        self._sd_ns: Final[float] = sd_ns

    def draw(self, rng: Generator) -> int:
        """Draws until one is above 0; at least half of them are, as the mean is."""
        time = 0.0
        while time <= 0.0:
            time = float(rng.normal(self._mean_ns, self._sd_ns))
        return _whole(time)

    def __reduce__(self) -> tuple[type["Normal"], tuple[float, float]]:
        return Normal, (self._mean_ns, self._sd_ns)


@final
class Weibull(Distribution):
    """Density k/s (t/s)^(k-1) exp(-(t/s)^k).

    shape: k > 0, below 1 early failures, above 1 wear-out; scale_ns: s > 0, 63 % of the times are shorter.
    """

    def __init__(self, shape: float, scale_ns: float) -> None:
        super().__init__()
        _positive("weibull: shape", shape)
        _positive("weibull: scale [ns]", scale_ns)
        self._shape: Final[float] = shape
        self._scale_ns: Final[float] = scale_ns

    def draw(self, rng: Generator) -> int:
        """Scale times a standard Weibull draw."""
        return _whole(self._scale_ns * float(rng.weibull(self._shape)))

    def __reduce__(self) -> tuple[type["Weibull"], tuple[float, float]]:
        return Weibull, (self._shape, self._scale_ns)


@final
class Gamma(Distribution):
    """Density t^(k-1) exp(-t/s) / (Gamma(k) s^k). shape: k > 0; scale_ns: s > 0; the mean is k s."""

    def __init__(self, shape: float, scale_ns: float) -> None:
        super().__init__()
        _positive("gamma: shape", shape)
        _positive("gamma: scale [ns]", scale_ns)
        self._shape: Final[float] = shape
        self._scale_ns: Final[float] = scale_ns

    def draw(self, rng: Generator) -> int:
        """One gamma draw."""
        return _whole(float(rng.gamma(self._shape, self._scale_ns)))

    def __reduce__(self) -> tuple[type["Gamma"], tuple[float, float]]:
        return Gamma, (self._shape, self._scale_ns)


@final
class Exponential(Distribution):
    """Without memory: density exp(-t/m) / m. mean_ns: m > 0; as an event a Poisson process of 1/m failures per ns."""

    def __init__(self, mean_ns: float) -> None:
        super().__init__()
        _positive("exponential: mean [ns]", mean_ns)
        self._mean_ns: Final[float] = mean_ns

    def draw(self, rng: Generator) -> int:
        """One exponential draw."""
        return _whole(float(rng.exponential(self._mean_ns)))

    def __reduce__(self) -> tuple[type["Exponential"], tuple[float]]:
        return Exponential, (self._mean_ns,)


@final
class Poisson(Distribution):
    """Whole periods: P(k) = m^k exp(-m) / k!, k = 0, 1, ... mean: m > 0 periods, up to 1e9; period_ns: > 0."""

    def __init__(self, mean: float, period_ns: int) -> None:
        super().__init__(period_ns)
        if not 0.0 < mean <= 1e9:
            raise FaultError(f"poisson: mean {mean} periods given, allowed more than 0, up to 1e9")
        _positive("poisson: period [ns]", period_ns)
        self._mean: Final[float] = mean

    def draw(self, rng: Generator) -> int:
        """One Poisson draw, periods."""
        return int(rng.poisson(self._mean))

    def __reduce__(self) -> tuple[type["Poisson"], tuple[float, int]]:
        return Poisson, (self._mean, self.period_ns)


@final
class Binomial(Distribution):
    """Whole periods: P(k) = C(n, k) p^k (1-p)^(n-k), k = 0..n.

    trials: n, 1..1e9; probability: p, 0..1; period_ns: > 0.
    """

    def __init__(self, trials: int, probability: float, period_ns: int) -> None:
        super().__init__(period_ns)
        if not 1 <= trials <= 1_000_000_000:
            raise FaultError(f"binomial: {trials} trials given, allowed 1..1000000000")
        if not 0.0 <= probability <= 1.0:
            raise FaultError(f"binomial: p {probability} given, allowed 0..1")
        _positive("binomial: period [ns]", period_ns)
        self._trials: Final[int] = trials
        self._probability: Final[float] = probability

    def draw(self, rng: Generator) -> int:
        """One binomial draw, periods."""
        return int(rng.binomial(self._trials, self._probability))

    def __reduce__(self) -> tuple[type["Binomial"], tuple[int, float, int]]:
        return Binomial, (self._trials, self._probability, self.period_ns)


@final
class TwoWeibull(Distribution):
    """Mixture: with probability `share` the first Weibull, else the second. share: 0..1."""

    def __init__(self, share: float, first: Weibull, second: Weibull) -> None:
        super().__init__()
        if not 0.0 <= share <= 1.0:
            raise FaultError(f"two_weibull: share {share} given, allowed 0..1")
        self._share: Final[float] = share
        self._first: Final[Weibull] = first
        self._second: Final[Weibull] = second

    def draw(self, rng: Generator) -> int:
        """One draw chooses, one draw of the chosen."""
        chosen = self._first if float(rng.random()) < self._share else self._second
        return chosen.draw(rng)

    def __reduce__(self) -> tuple[type["TwoWeibull"], tuple[float, Weibull, Weibull]]:
        return TwoWeibull, (self._share, self._first, self._second)


@final
class Curve(Distribution):
    """A density given by points, straight between them and 0 outside; only its form counts, the area is made 1.

    times_ns: two and more, rising, from 0 up; weights: as many, >= 0, not all 0.
    """

    def __init__(self, times_ns: tuple[int, ...], weights: tuple[float, ...]) -> None:
        super().__init__()
        if len(times_ns) < 2 or len(times_ns) != len(weights):
            raise FaultError(f"curve: {len(times_ns)} times, {len(weights)} weights given, allowed 2 and more, as many")
        areas = [0.0]
        for at in range(1, len(times_ns)):
            length = times_ns[at] - times_ns[at - 1]
            if length <= 0 or times_ns[0] < 0 or times_ns[at] >= NEVER:
                raise FaultError(f"curve: times {times_ns} ns given, allowed are rising ones, 0..{NEVER - 1}")
            areas.append(areas[at - 1] + 0.5 * length * (weights[at - 1] + weights[at]))
        if not (min(weights) >= 0.0 and 0.0 < areas[-1] < 1e300):
            raise FaultError(f"curve: weights {weights} given, allowed 0 and more, not all 0")
        self._times_ns: Final[tuple[int, ...]] = times_ns
        self._weights: Final[tuple[float, ...]] = weights
        self._areas: Final[list[float]] = areas

    def draw(self, rng: Generator) -> int:
        """Inverse of the distribution function: the segment by its area, then the root of a parabola in it."""
        areas = self._areas
        wanted = float(rng.random()) * areas[-1]
        at = min(bisect_right(areas, wanted), len(areas) - 1) - 1
        rest = wanted - areas[at]
        start, low = self._times_ns[at], self._weights[at]
        slope = (self._weights[at + 1] - low) / (self._times_ns[at + 1] - start)
        root = low + sqrt(max(low * low + 2.0 * slope * rest, 0.0))  # max: rounding at a far end that falls to 0
        return _whole(start + (2.0 * rest / root if root > 0.0 else 0.0))

    def __reduce__(self) -> tuple[type["Curve"], tuple[tuple[int, ...], tuple[float, ...]]]:
        return Curve, (self._times_ns, self._weights)
