"""Axes: what a campaign varies, and the grid that they span.

An axis sets one or several keys of the scenario to the same value, or goes through named cases, each with settings of
its own. Axes named in `together` go in step, all others are combined; filters take points out. The order is that of
the file, the last axis fastest. Random values are drawn once, when the file is read: from a stream that hangs on the
campaign's seed and the axis's name alone (`random.Random` with a text as its seed is the same on every platform and
version of Python), so that another axis changes nothing about them.
"""

import itertools
import math
import random
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from fractions import Fraction
from statistics import NormalDist
from typing import Annotated, Final

from pydantic import BeforeValidator, Field, WithJsonSchema

from fi_gateway.boundary import Count, SpecModel, validate
from fi_gateway.marked_yaml import Data, Document, Keys, did_you_mean, flow_text
from fi_gateway.quantity import describe_value, format_number
from testbench.campaign.file.filters import Filter
from testbench.campaign.file.values import Number, common_unit, number_of, text_of, with_unit
from testbench.campaign.records import Point

MOST_VALUES: Final = 10_000
"""Of one axis."""

_Scalar = Annotated[str, BeforeValidator(text_of), WithJsonSchema({"type": ["string", "number", "boolean"]})]

_FROM: Final = Field(alias="from")


@dataclass(frozen=True, slots=True)
class RangeSpec(SpecModel):
    """From `low` to `high`, both included, in steps."""

    low: Annotated[_Scalar, _FROM]
    high: Annotated[_Scalar, Field(alias="to")]
    step: _Scalar

    def texts(self, stream: random.Random) -> list[str]:
        """The values; raises ValueError."""
        (low, high, step), unit = common_unit((self.low, self.high, self.step))
        if step <= 0 or high < low:
            raise ValueError(f"{self.low} to {self.high} in steps of {self.step}: allowed is a step above 0, upwards")
        steps = (high - low) / step
        if steps > MOST_VALUES:
            raise ValueError(f"that is {math.floor(steps) + 1} values; allowed are {MOST_VALUES} on an axis")
        if steps.denominator != 1:
            last = format_number(low + math.floor(steps) * step)
            text = f"steps of {self.step} from {self.low} do not meet {self.high}; the last one below it is"
            raise ValueError(f"{text} {last} {unit}".strip())
        numbers = [low + index * step for index in range(int(steps) + 1)]
        return [f"{format_number(number)} {unit}".strip() for number in numbers]


@dataclass(frozen=True, slots=True)
class LinearSpec(SpecModel):
    """`points` values at equal distances, both ends included."""

    low: Annotated[_Scalar, _FROM]
    high: Annotated[_Scalar, Field(alias="to")]
    points: Annotated[Count, Field(ge=2, le=MOST_VALUES)]

    def texts(self, stream: random.Random) -> list[str]:
        """The values; raises ValueError."""
        (low, high), unit = common_unit((self.low, self.high))
        if high <= low:
            raise ValueError(f"{self.low} to {self.high}: allowed is upwards")
        step = (high - low) / (self.points - 1)
        return [with_unit(low + index * step, unit) for index in range(self.points)]


@dataclass(frozen=True, slots=True)
class LogSpec(SpecModel):
    """`points` values at equal ratios, both ends included."""

    low: Annotated[_Scalar, _FROM]
    high: Annotated[_Scalar, Field(alias="to")]
    points: Annotated[Count, Field(ge=2, le=MOST_VALUES)]

    def texts(self, stream: random.Random) -> list[str]:
        """The values; raises ValueError."""
        (low, high), unit = common_unit((self.low, self.high))
        _check_log(low, high, self.low, self.high)
        ratio = math.log(high / low) / (self.points - 1)
        return [with_unit(float(low) * math.exp(index * ratio), unit) for index in range(self.points)]


@dataclass(frozen=True, slots=True)
class BetweenSpec(SpecModel):
    """Two ends; a search finds its own values between them."""

    low: Annotated[_Scalar, _FROM]
    high: Annotated[_Scalar, Field(alias="to")]

    def texts(self, stream: random.Random) -> list[str]:
        """Both ends; raises ValueError."""
        (low, high), _ = common_unit((self.low, self.high))
        if high <= low:
            raise ValueError(f"{self.low} to {self.high}: allowed is upwards")
        return [self.low, self.high]


@dataclass(frozen=True, slots=True)
class NormalSpec(SpecModel):
    """A normal distribution: mean and standard deviation."""

    mean: _Scalar
    sd: _Scalar


@dataclass(frozen=True, slots=True)
class RandomSpec(SpecModel):
    """`points` values drawn from one of the distributions."""

    points: Annotated[Count, Field(le=MOST_VALUES)]
    uniform: BetweenSpec | None = None
    log_uniform: BetweenSpec | None = None
    normal: NormalSpec | None = None

    def texts(self, stream: random.Random) -> list[str]:
        """The values; raises ValueError."""
        given = [one for one in (self.uniform, self.log_uniform, self.normal) if one is not None]
        if len(given) != 1:
            raise ValueError(f"{len(given)} distributions given; allowed is one of uniform, log_uniform, normal")
        draw, unit = self._draw()
        texts: dict[str, None] = {}
        for _ in range(10 * self.points):  # what is drawn twice, to six digits, is one value; one more is drawn then
            texts.setdefault(with_unit(draw(stream.random()), unit))
            if len(texts) == self.points:
                return list(texts)
        raise ValueError(f"there are not {self.points} different values of six digits; allowed are fewer points")

    def _draw(self) -> tuple[Callable[[float], float], str]:
        """From a uniform share 0..1 to a value, and the unit."""
        if self.normal is not None:
            (mean, sd), unit = common_unit((self.normal.mean, self.normal.sd))
            if sd <= 0:
                raise ValueError(f"sd {self.normal.sd} given; allowed is more than 0")
            shape = NormalDist(float(mean), float(sd))
            return lambda share: shape.inv_cdf(min(max(share, 1e-12), 1 - 1e-12)), unit
        span = self.uniform or self.log_uniform
        assert span is not None
        (low, high), unit = common_unit((span.low, span.high))
        if self.uniform is not None:
            if high <= low:
                raise ValueError(f"{span.low} to {span.high}: allowed is upwards")
            return lambda share: float(low) + share * float(high - low), unit
        _check_log(low, high, span.low, span.high)
        return lambda share: float(low) * math.exp(share * math.log(high / low)), unit


Generator = RangeSpec | LinearSpec | LogSpec | BetweenSpec | RandomSpec

GENERATORS: Final[Mapping[str, type[Generator]]] = {
    "range": RangeSpec,
    "linear": LinearSpec,
    "log": LogSpec,
    "between": BetweenSpec,
    "random": RandomSpec,
}
_WAYS: Final = ("values", "cases", *GENERATORS)
_KEYS: Final = ("set", *_WAYS)


@dataclass(frozen=True, slots=True)
class Axis:
    """What is varied. texts: its values, or the names of its cases, in order.

    keys: of the scenario, which all get the value; cases: name -> what it sets, for an axis of cases; places: where
    in the campaign file each value came from; open: only the ends are given.
    """

    name: str
    keys: tuple[str, ...]
    texts: tuple[str, ...]
    cases: Mapping[str, tuple[tuple[str, str], ...]] = field(default_factory=dict)
    places: tuple[Keys, ...] = ()
    is_open: bool = False

    def settings(self, text: str) -> tuple[tuple[str, str], ...]:
        """(key of the scenario, value) for one value of the axis; KeyError for a case there is none of."""
        return self.cases[text] if self.cases else tuple((key, text) for key in self.keys)

    @property
    def unit(self) -> str:
        """The SI unit of its values, "" for plain numbers and for words."""
        first = self.number(self.texts[0])
        return "" if first is None else first.unit

    def number(self, text: str) -> Number | None:
        """The value in SI, None for a word or a case."""
        return None if self.cases else number_of(text)


def read_axis(name: str, data: Data, at: Keys, document: Document, seed: int) -> Axis | None:
    """One axis of a campaign file, which stands at `at`; None when it is wrong, which the document is told."""
    if not isinstance(data, dict):
        document.report(at, f"expected a mapping with set and one of {', '.join(_WAYS)}; got {describe_value(data)}")
        return None
    for key in data:
        if key not in _KEYS:
            hint = did_you_mean(key, _KEYS)
            document.report((*at, key), f"unknown key{hint} (allowed: {', '.join(_KEYS)})", at_key=True)
    ways = [way for way in _WAYS if way in data]
    if len(ways) != 1:
        got = f"got {', '.join(ways)}" if ways else "none is given"
        document.report(at, f"expected one of {', '.join(_WAYS)}; {got}", at_key=True)
        return None
    if ways[0] == "cases":
        return _read_cases(name, data, at, document)
    keys = _read_keys(data.get("set"), at, document)
    stream = random.Random(f"{seed}/{name}")
    found = list(_values(data[ways[0]], (*at, ways[0]), ways[0], document, stream))
    if not keys or not found:
        return None
    _report_doubles(found, document)
    texts, places = zip(*found, strict=True)
    kinds = {number.what if (number := number_of(text)) is not None else "word" for text in texts}
    if len(kinds) > 1:
        document.report((*at, ways[0]), f"the values are of different kinds: {', '.join(sorted(kinds))}")
        return None
    return Axis(name, keys, texts, places=places, is_open=ways[0] == "between")


def _read_keys(data: Data, at: Keys, document: Document) -> tuple[str, ...]:
    """`set`: one key or several."""
    place = (*at, "set")
    if data is None:
        document.report(place, "missing; needed: the key of the scenario that the axis sets", at_key=True)
        return ()
    found = data if isinstance(data, list) else [data]
    if not found or not all(isinstance(key, str) and all(key.split(".")) for key in found):
        document.report(place, f"expected a key such as rig.stops, or a list of keys; got {describe_value(data)}")
        return ()
    return tuple(str(key) for key in found)


def _values(data: Data, at: Keys, way: str, document: Document, stream: random.Random) -> Iterator[tuple[str, Keys]]:
    """(text, place in the campaign file) of each value; what is wrong is reported and left out."""
    if way != "values":
        for text in _generated(data, at, way, document, stream):
            yield text, at
        return
    items = data if isinstance(data, list) else [data]
    if not items:
        document.report(at, "the list is empty, and with it the grid; give at least one value")
    for index, item in enumerate(items):
        place = (*at, index) if isinstance(data, list) else at
        inner = next(iter(item)) if isinstance(item, dict) and len(item) == 1 else ""
        if isinstance(item, dict) and inner in GENERATORS and inner != "between":
            for text in _generated(item[inner], (*place, inner), inner, document, stream):
                yield text, place
            continue
        try:
            yield text_of(item), place
        except ValueError as error:
            document.report(place, f"{error}, or {{range: ...}}, {{linear: ...}}, {{log: ...}}, {{random: ...}}")


def _generated(data: Data, at: Keys, way: str, document: Document, stream: random.Random) -> list[str]:
    spec = validate(GENERATORS[way], data, at, document)
    if spec is None:
        return []
    try:
        return spec.texts(stream)
    except ValueError as error:
        document.report(at, str(error))
        return []


def _report_doubles(found: Sequence[tuple[str, Keys]], document: Document) -> None:
    """Report values that are the same, however written: they would count twice."""
    seen: dict[object, str] = {}
    for text, place in found:
        number = number_of(text)
        same = text if number is None else (round_off(number.value), number.unit)
        if same in seen:
            document.report(place, f"{text} is there twice (as {seen[same]}); leave one out")
        seen.setdefault(same, text)


def round_off(value: float) -> float:
    """To twelve significant digits: what is closer is the same value."""
    return float(f"{value:.12g}")


def _read_cases(name: str, data: Mapping[str, Data], at: Keys, document: Document) -> Axis | None:
    """An axis of named cases: name -> {key of the scenario: value}."""
    cases, places = {}, []
    given, at_cases = data["cases"], (*at, "cases")
    if "set" in data:
        document.report((*at, "set"), "each of the cases says itself what it sets; leave set out", at_key=True)
    if not isinstance(given, dict) or not given:
        document.report(at_cases, "expected a mapping of names, each with what it sets, as in {pins: {rig.stops: on}}")
        return None
    for case, settings in given.items():
        if not isinstance(settings, dict):
            document.report((*at_cases, case), f"expected {{KEY: VALUE, ...}}; got {describe_value(settings)}")
            continue
        cases[case] = read_settings(settings)
        places.append((*at_cases, case))
    return Axis(name, (), tuple(cases), cases, tuple(places)) if cases else None


def read_settings(data: Mapping[str, Data]) -> tuple[tuple[str, str], ...]:
    """{key of the scenario: any value} as (key, value in YAML's flow style)."""
    return tuple((key, flow_text(value)) for key, value in data.items())


def grid(axes: Sequence[Axis], together: Sequence[Sequence[str]], filters: Sequence[Filter]) -> Iterator[Point]:
    """The points, in order. together: groups of axes, of equal length, that go in step."""
    group = {name: index for index, names in enumerate(together) for name in names}
    bundles: dict[object, list[Axis]] = {}
    for axis in axes:
        bundles.setdefault(group.get(axis.name, axis.name), []).append(axis)
    order = [axis.name for axis in axes]
    steps = [list(zip(*(axis.texts for axis in bundle), strict=True)) for bundle in bundles.values()]
    names = [axis.name for bundle in bundles.values() for axis in bundle]
    for chosen in itertools.product(*steps):
        texts = dict(zip(names, itertools.chain.from_iterable(chosen), strict=True))
        if all(one.holds(texts) for one in filters):
            yield Point(tuple((name, texts[name]) for name in order))


def size(axes: Sequence[Axis], together: Sequence[Sequence[str]]) -> int:
    """The number of points before filters."""
    later = {name for names in together for name in names[1:]}
    return math.prod(len(axis.texts) for axis in axes if axis.name not in later)


def _check_log(low: Fraction, high: Fraction, low_text: str, high_text: str) -> None:
    if low <= 0 or high <= low:
        raise ValueError(f"{low_text} to {high_text}: allowed are ends above 0, upwards")
