"""Distributions of a time as a scenario file gives them (key `law`): one small class each.

Each reads its own keys, builds the engine's distribution, and says in words which it is.
"""

from dataclasses import dataclass
from typing import Annotated, Literal, TypeAlias

from pydantic import BeforeValidator, Field, PlainSerializer, PlainValidator, WithJsonSchema

from fi_gateway.boundary import Count, Share, Span, SpecModel, Time
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
from fi_gateway.quantity import describe_value, format_duration, parse_duration


def number(given: object) -> float:
    """A plain number above 0; raises ValueError."""
    if isinstance(given, bool) or not isinstance(given, int | float):
        raise ValueError(f"expected a plain number; got {describe_value(given)}")
    if not 0 < given <= 1e9:
        raise ValueError(f"{describe_value(given)} is not allowed; allowed is more than 0, up to 1e9")
    return float(given)


Positive: TypeAlias = Annotated[float, BeforeValidator(number), WithJsonSchema({"type": "number"})]

Points: TypeAlias = tuple[tuple[int, float], ...]


def _points(given: object) -> Points:
    """[[0 s, 0], [2 s, 1], ...]: times rising, weights without unit."""
    if not isinstance(given, list | tuple):
        raise ValueError(f"expected a list of points such as [[0 s, 0], [2 s, 1]]; got {describe_value(given)}")
    points: list[tuple[int, float]] = []
    for at, point in enumerate(given, 1):
        if not isinstance(point, list | tuple) or len(point) != 2:
            raise ValueError(f"point {at}: expected a time and a weight such as [2 s, 1]; got {describe_value(point)}")
        time, weight = parse_duration(point[0]), point[1]
        if isinstance(weight, bool) or not isinstance(weight, int | float) or not 0 <= weight <= 1e9:
            raise ValueError(f"point {at}: expected a weight, 0 or more without unit; got {describe_value(weight)}")
        if time < 0 or (points and time <= points[-1][0]):
            raise ValueError(f"point {at}: {point[0]!r} does not come after the point before; allowed from 0 s, rising")
        points.append((time, float(weight)))
    if len(points) < 2 or not any(weight for _, weight in points):
        raise ValueError("a curve needs at least two points, one of them with a weight above 0")
    return tuple(points)


def _show_points(points: Points) -> list[list[str | float]]:
    return [[format_duration(time), weight] for time, weight in points]


CurvePoints: TypeAlias = Annotated[
    Points,
    PlainValidator(_points),
    PlainSerializer(_show_points),
    WithJsonSchema({"type": "array", "items": {"type": "array"}, "examples": [[["0 s", 0], ["2 s", 1]]]}),
]


class DistributionSpec(SpecModel):
    """Base of the distributions in files."""

    __slots__ = ()

    def build(self) -> Distribution:
        """The engine's distribution."""
        raise NotImplementedError

    def words(self) -> str:
        """Which: "weibull (shape 2, scale 3 s)"."""
        raise NotImplementedError


@dataclass(frozen=True, slots=True)
class NormalSpec(DistributionSpec):
    """Truncated at > 0; mean and sd are those before truncation."""

    type: Literal["normal"]
    mean_ns: Annotated[Span, Field(alias="mean")]
    sd_ns: Annotated[Time, Field(alias="sd")]

    def build(self) -> Distribution:
        """See Normal."""
        return Normal(self.mean_ns, self.sd_ns)

    def words(self) -> str:
        """For people."""
        return f"normal, above 0 (mean {format_duration(self.mean_ns)}, sd {format_duration(self.sd_ns)})"


@dataclass(frozen=True, slots=True)
class WeibullSpec(DistributionSpec):
    """shape: below 1 early failures, above 1 wear-out; scale: 63 % of the times are shorter."""

    type: Literal["weibull"]
    shape: Positive
    scale_ns: Annotated[Span, Field(alias="scale")]

    def build(self) -> Distribution:
        """See Weibull."""
        return Weibull(self.shape, self.scale_ns)

    def words(self) -> str:
        """For people."""
        return f"weibull (shape {self.shape:g}, scale {format_duration(self.scale_ns)})"


@dataclass(frozen=True, slots=True)
class GammaSpec(DistributionSpec):
    """The mean is shape x scale."""

    type: Literal["gamma"]
    shape: Positive
    scale_ns: Annotated[Span, Field(alias="scale")]

    def build(self) -> Distribution:
        """See Gamma."""
        return Gamma(self.shape, self.scale_ns)

    def words(self) -> str:
        """For people."""
        return f"gamma (shape {self.shape:g}, scale {format_duration(self.scale_ns)})"


@dataclass(frozen=True, slots=True)
class ExponentialSpec(DistributionSpec):
    """Without memory."""

    type: Literal["exponential"]
    mean_ns: Annotated[Span, Field(alias="mean")]

    def build(self) -> Distribution:
        """See Exponential."""
        return Exponential(self.mean_ns)

    def words(self) -> str:
        """For people."""
        return f"exponential (mean {format_duration(self.mean_ns)})"


@dataclass(frozen=True, slots=True)
class PoissonSpec(DistributionSpec):
    """Whole periods. mean: periods, a plain number."""

    type: Literal["poisson"]
    mean: Positive
    period_ns: Annotated[Span, Field(alias="period")]

    def build(self) -> Distribution:
        """See Poisson."""
        return Poisson(self.mean, self.period_ns)

    def words(self) -> str:
        """For people."""
        return f"poisson (mean {self.mean:g} periods of {format_duration(self.period_ns)})"


@dataclass(frozen=True, slots=True)
class BinomialSpec(DistributionSpec):
    """Whole periods: the successes in n trials."""

    type: Literal["binomial"]
    n: Annotated[Count, Field(le=1_000_000_000)]
    p: Share
    period_ns: Annotated[Span, Field(alias="period")]

    def build(self) -> Distribution:
        """See Binomial."""
        return Binomial(self.n, self.p, self.period_ns)

    def words(self) -> str:
        """For people."""
        return f"binomial (n {self.n}, p {self.p:g}, periods of {format_duration(self.period_ns)})"


@dataclass(frozen=True, slots=True)
class WeibullPart(SpecModel):
    """One of the two parts of a mixture."""

    shape: Positive
    scale_ns: Annotated[Span, Field(alias="scale")]

    def words(self) -> str:
        """For people."""
        return f"shape {self.shape:g}, scale {format_duration(self.scale_ns)}"


@dataclass(frozen=True, slots=True)
class TwoWeibullSpec(DistributionSpec):
    """Early failures and wear-out, say. share: of the first."""

    type: Literal["two_weibull"]
    share: Share
    first: WeibullPart
    second: WeibullPart

    def build(self) -> Distribution:
        """See TwoWeibull."""
        first = Weibull(self.first.shape, self.first.scale_ns)
        return TwoWeibull(self.share, first, Weibull(self.second.shape, self.second.scale_ns))

    def words(self) -> str:
        """For people."""
        return f"two_weibull ({100 * self.share:g} %: {self.first.words()}; else: {self.second.words()})"


@dataclass(frozen=True, slots=True)
class CurveSpec(DistributionSpec):
    """A density by points, straight between them; its area is made 1."""

    type: Literal["curve"]
    points: CurvePoints

    def build(self) -> Distribution:
        """See Curve."""
        return Curve(tuple(time for time, _ in self.points), tuple(weight for _, weight in self.points))

    def words(self) -> str:
        """For people."""
        ends = f"{format_duration(self.points[0][0])} to {format_duration(self.points[-1][0])}"
        return f"curve ({len(self.points)} points, {ends})"


LawChoice: TypeAlias = Annotated[
    NormalSpec
    | WeibullSpec
    | GammaSpec
    | ExponentialSpec
    | PoissonSpec
    | BinomialSpec
    | TwoWeibullSpec
    | CurveSpec,
    Field(discriminator="type"),
]
