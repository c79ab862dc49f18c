"""Values of axes: the text that the scenario file would have, and the number behind it.

A campaign compares, sorts and fits by the number, in SI, and runs and shows the text.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction
from typing import Final

from fi_gateway.errors import FaultError
from fi_gateway.marked_yaml import Data, FileErrors, flow_text, parse
from fi_gateway.quantity import UNITS, Dimension, describe_value, parse_quantity, parse_share, si_unit, split_quantity

SHARE: Final = "%"
"""What stands for a share, 0..1, where a unit is named: its numbers are plain."""


@dataclass(frozen=True, slots=True)
class Number:
    """A value in SI. unit: the SI unit, "%" for a share (0..1), "" for a plain number."""

    value: float
    unit: str

    @property
    def article(self) -> str:
        """What it measures, with its article."""
        return f"{'an' if self.what[0] in 'aeiou' else 'a'} {self.what}"

    @property
    def what(self) -> str:
        """What it measures, in words."""
        if self.unit in ("", SHARE):
            return "share" if self.unit else "number"
        return next(dimension.value for dimension in Dimension if si_unit(dimension) == self.unit)


def number_of(text: str) -> Number | None:
    """The number that a text says ("50 ms" -> 0.05 s), None for a word."""
    parts = split_quantity(text)
    if parts is None:
        return None
    number, unit = parts
    if not unit:
        return Number(float(number), "")
    try:
        if unit == SHARE:
            return Number(parse_share(text), SHARE)
        for dimension, units in UNITS.items():
            if unit in units:
                return Number(parse_quantity(text, dimension), si_unit(dimension))
    except FaultError:
        return None
    return None


def text_of(value: Data) -> str:
    """A value of the campaign file as the scenario file would say it; raises ValueError for a list or a mapping."""
    if isinstance(value, list | dict) or value is None:
        raise ValueError(f"expected a single value, such as '0.3 s', right_knee or off; got {describe_value(value)}")
    return flow_text(value)


def word_of(text: str) -> str:
    """The word that a text says: without the quotes that YAML needs around some."""
    try:
        data = parse(text, "value").data
    except FileErrors:
        return text
    return data if isinstance(data, str) else text


def with_unit(number: Fraction | float, unit: str) -> str:
    """A number of at most six significant digits, without exponent where that is short, and its unit."""
    text = f"{float(number):.6g}"
    return f"{text} {unit}" if unit else text


def common_unit(texts: Sequence[str]) -> tuple[list[Fraction], str]:
    """The numbers of several values, and the unit they are all written in; raises ValueError when it is not one."""
    numbers, units = [], []
    for text in texts:
        parts = split_quantity(text)
        if parts is None or number_of(text) is None:
            raise ValueError(f"{text!r} is not a number with or without a unit, such as 0.3 s, 20 % or 5")
        numbers.append(parts[0])
        units.append(parts[1])
    if len(set(units)) > 1:
        raise ValueError(f"{', '.join(texts)}: write all of them in one unit")
    return numbers, units[0]
