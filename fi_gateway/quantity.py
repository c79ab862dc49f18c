"""Quantities as people write them ("0.3 s", "-60 deg", "5 N m") <-> SI values.

A number without a unit is refused wherever a unit is needed: 5 could be degrees or radians, and nobody would notice.
Durations become whole nanoseconds by exact arithmetic; everything else becomes an SI float. Sources: SI brochure, 9th
edition; 1 rpm = 2 pi / 60 rad/s, 1 deg = pi / 180 rad. Left out: derived units and SI prefixes not in the tables.
"""

import math
import re
from decimal import Decimal
from enum import Enum
from fractions import Fraction
from typing import Final

from fi_gateway.errors import FaultError

_DEGREE: Final = math.pi / 180
_RPM: Final = math.pi / 30
_ONE: Final = Fraction(1)
_MILLI: Final = Fraction(1, 1000)

_QUANTITY: Final = re.compile(
    r"([+-]?(?:[0-9]+(?:\.[0-9]*)?|\.[0-9]+)(?:[eE][+-]?[0-9]{1,3})?)\s*(.*)", re.ASCII | re.DOTALL
)
_MAX_TEXT: Final = 60
_MAX_EXPONENT: Final = 30
_MAX_DURATION_S: Final = 10**9  # below NEVER (1 << 61 ns)


class QuantityError(FaultError, ValueError):
    """A text that is not a quantity of the wanted kind."""


class Dimension(Enum):
    """What a quantity measures; the value is its name in messages."""

    TIME = "duration"
    FREQUENCY = "frequency"
    RATE = "rate"
    ANGLE = "angle"
    SPEED = "angular velocity"
    TORQUE = "torque"
    PHASE = "gait phase"


UNITS: Final[dict[Dimension, dict[str, Fraction | float]]] = {
    Dimension.TIME: {
        "s": _ONE,
        "ms": _MILLI,
        "us": Fraction(1, 10**6),
        "ns": Fraction(1, 10**9),
        "min": Fraction(60),
        "h": Fraction(3600),
    },
    Dimension.FREQUENCY: {"Hz": _ONE, "kHz": Fraction(1000)},
    Dimension.RATE: {"1/s": _ONE, "1/min": Fraction(1, 60), "1/h": Fraction(1, 3600)},
    Dimension.ANGLE: {"rad": _ONE, "mrad": _MILLI, "deg": _DEGREE},
    Dimension.SPEED: {"rad/s": _ONE, "deg/s": _DEGREE, "rpm": _RPM},
    Dimension.TORQUE: {"N m": _ONE, "mN m": _MILLI},
    Dimension.PHASE: {"stride": _ONE, "%": Fraction(1, 100)},
}
"""Unit -> SI per unit; the first unit of each dimension is the SI one. Exact where a fraction."""

_SPELLINGS: Final = {
    "Nm": "N m",
    "mNm": "mN m",
    "µs": "us",  # micro sign
    "μs": "us",  # Greek mu
    "/s": "1/s",
    "/min": "1/min",
    "/h": "1/h",
}
_EXAMPLES: Final = {
    Dimension.TIME: "0.3 s",
    Dimension.FREQUENCY: "500 Hz",
    Dimension.RATE: "0.5 1/s",
    Dimension.ANGLE: "5 deg",
    Dimension.SPEED: "65.2 rpm",
    Dimension.TORQUE: "5 N m",
    Dimension.PHASE: "25 %",
}


def parse_quantity(given: object, dimension: Dimension) -> float:
    """SI value of `given` ("20 deg" -> 0.349 rad); raises QuantityError saying which units are allowed."""
    number, factor = _parse(given, dimension)
    if isinstance(factor, Fraction):
        return float(number * factor)
    return float(number) * factor


def parse_duration(given: object) -> int:
    """Whole nanoseconds of `given` ("0.3 s" -> 300000000), exactly; raises QuantityError."""
    number, factor = _parse(given, Dimension.TIME)
    exact = number * Fraction(factor) * 10**9
    if exact.denominator != 1:
        raise QuantityError(f"{given!r} is not a whole number of nanoseconds, the resolution of time here")
    if abs(exact) > _MAX_DURATION_S * 10**9:
        raise QuantityError(f"{given!r} is longer than the longest duration, {_MAX_DURATION_S:.0e} s")
    return exact.numerator


def parse_hertz(given: object) -> Fraction:
    """Exact frequency in Hz ("0.5 kHz" -> 500); raises QuantityError."""
    number, factor = _parse(given, Dimension.FREQUENCY)
    return number * Fraction(factor)


def parse_share(given: object) -> float:
    """A probability: a plain number 0..1, or "0 %".."100 %"; raises QuantityError."""
    share: float
    if isinstance(given, str):
        match = _match(given)
        if match is None or match[2] != "%":
            raise QuantityError(f"expected a number 0..1 or a percentage such as '20 %', got {given!r}")
        share = float(_number(match[1], given) / 100)
    elif isinstance(given, bool) or not isinstance(given, int | float):
        raise QuantityError(f"expected a number 0..1 or a percentage such as '20 %', got {describe_value(given)}")
    else:
        share = given
    if not 0 <= share <= 1:  # also refuses NaN
        raise QuantityError(f"{describe_value(given)} is not a probability; allowed 0..1 or 0 %..100 %")
    return float(share)


def format_duration(ns: int) -> str:
    """The shortest exact text that `parse_duration` turns back into `ns`: 300000000 -> "0.3 s", 1000000 -> "1 ms"."""
    unit, size = "ns", 1
    for name, one, least in (("us", 10**3, 10**3), ("ms", 10**6, 10**6), ("s", 10**9, 10**8)):
        if abs(ns) >= least or ns == 0:
            unit, size = name, one
    return f"{_plain(Fraction(ns, size))} {unit}"


def format_hertz(hertz: Fraction) -> str:
    """Text that `parse_hertz` turns back: 500 -> "500 Hz"; the number must have a finite decimal form."""
    return f"{_plain(hertz)} Hz"


def format_quantity(value: float, dimension: Dimension) -> str:
    """Exact SI text of `value`: `parse_quantity` gives the same float back."""
    number = repr(float(value))
    return f"{number.removesuffix('.0')} {si_unit(dimension)}"


def split_quantity(text: str) -> tuple[Fraction, str] | None:
    """Number, exactly, and unit of a text such as "0.3 s" or "5", whatever the unit; None when it is no such text."""
    match = _match(text)
    if match is None or Decimal(match[1]).adjusted() > _MAX_EXPONENT:
        return None
    unit = " ".join(match[2].split())
    return Fraction(Decimal(match[1])), _SPELLINGS.get(unit, unit)


def format_number(number: Fraction) -> str:
    """Exact decimal notation without exponent and trailing zeros; raises QuantityError when there is none."""
    return _plain(number)


def si_unit(dimension: Dimension) -> str:
    """The unit of what `parse_quantity` returns."""
    return next(iter(UNITS[dimension]))


def dimension_of(unit: str) -> Dimension | None:
    """What an SI unit measures, None for a unit that is not the first of a dimension ("" for a plain number)."""
    return next((dimension for dimension in Dimension if si_unit(dimension) == unit), None)


def allowed_units(dimension: Dimension) -> str:
    """The units of a dimension, for a message: "rad, mrad, deg"."""
    return ", ".join(UNITS[dimension])


def describe_value(given: object) -> str:
    """What was given, in the words of the file rather than of Python."""
    if given is None:
        return "nothing"
    if isinstance(given, bool):
        return "true" if given else "false"
    if isinstance(given, dict):
        return "a mapping"
    if isinstance(given, list):
        return "a list"
    text = repr(given)
    return text if len(text) <= _MAX_TEXT else text[:_MAX_TEXT] + "..."


def _parse(given: object, dimension: Dimension) -> tuple[Fraction, Fraction | float]:
    """(number as written, SI per unit)."""
    example = f"units: {allowed_units(dimension)}; for example '{_EXAMPLES[dimension]}'"
    kind = _article(dimension)
    if isinstance(given, int | float) and not isinstance(given, bool):
        raise QuantityError(f"{given!r} has no unit; {kind} needs one ({example})")
    if not isinstance(given, str):
        raise QuantityError(f"expected {kind}, got {describe_value(given)} ({example})")
    match = _match(given)
    if match is None:
        raise QuantityError(f"{describe_value(given)} is not {kind} ({example})")
    unit = " ".join(match[2].split())
    unit = _SPELLINGS.get(unit, unit)
    if not unit:
        raise QuantityError(f"{given!r} has no unit; {kind} needs one ({example})")
    if unit not in UNITS[dimension]:
        for other, units in UNITS.items():
            if unit in units and unit != "%":  # of a stride, or of anything
                raise QuantityError(f"{given!r} is {_article(other)}; {kind} is wanted ({example})")
        raise QuantityError(f"unknown unit {unit!r} in {given!r}; {kind} is wanted ({example})")
    return _number(match[1], given), UNITS[dimension][unit]


def _article(dimension: Dimension) -> str:
    return f"{'an' if dimension.value[0] in 'aeiou' else 'a'} {dimension.value}"


def _match(text: str) -> re.Match[str] | None:
    return _QUANTITY.fullmatch(text.strip()) if len(text) <= _MAX_TEXT else None


def _number(text: str, given: str) -> Fraction:
    number = Decimal(text)
    if number and number.adjusted() > _MAX_EXPONENT:
        raise QuantityError(f"{given!r} is too large; allowed up to 1e{_MAX_EXPONENT}")
    return Fraction(number)


def _plain(number: Fraction) -> str:
    """Exact decimal notation without exponent and trailing zeros."""
    digits = 0
    while (number * 10**digits).denominator != 1:
        digits += 1
        if digits > 40:
            raise QuantityError(f"{number} has no finite decimal form")
    scaled = number * 10**digits
    return f"{Decimal(scaled.numerator).scaleb(-digits):f}" if digits else str(number)
