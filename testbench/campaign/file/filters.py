"""Filters: which points of the grid are kept.

    filter     = or
    or         = and { "or" and }
    and        = not { "and" not }
    not        = "not" not | "(" or ")" | comparison
    comparison = AXIS ( < | <= | > | >= | == | != ) VALUE   |   AXIS "in" "[" VALUE { "," VALUE } "]"
    VALUE      = another AXIS, a number with or without its unit, a word, or 'a text in quotes'

Everything is checked when the file is read: names, kinds and units, and that an axis can have a word it is compared
with. There is no arithmetic; a case or a list of values says what a formula would.
"""

import operator
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Final

from fi_gateway.marked_yaml import did_you_mean
from fi_gateway.quantity import UNITS
from testbench.campaign.file.values import SHARE, Number, number_of, word_of

Texts = Mapping[str, str]
"""Axis -> value, of one point."""

_UNITS: Final = "|".join(
    re.escape(unit) for unit in sorted({SHARE, "Nm", "mNm", *(u for us in UNITS.values() for u in us)}, key=len)[::-1]
)
_TOKEN: Final = re.compile(
    r"\s*(?:(?P<number>[+-]?(?:[0-9]+(?:\.[0-9]*)?|\.[0-9]+)(?:[eE][+-]?[0-9]{1,3})?"
    rf"(?:\s*(?:{_UNITS})(?![A-Za-z0-9_/]))?)(?![A-Za-z0-9_])"
    r"|(?P<word>[A-Za-z_][A-Za-z0-9_.-]*)|(?P<quoted>'[^']*'|\"[^\"]*\")|(?P<sign><=|>=|==|!=|<|>|[()\[\],]))",
    re.ASCII,
)
_ORDER: Final[Mapping[str, Callable[[float, float], bool]]] = {
    "<": operator.lt,
    "<=": operator.le,
    ">": operator.gt,
    ">=": operator.ge,
    "==": operator.eq,
    "!=": operator.ne,
}
_RESERVED: Final = ("and", "or", "not", "in")

Test = Callable[[Texts], bool]


@dataclass(frozen=True, slots=True)
class Filter:
    """A filter that was read. text: as written."""

    text: str
    holds: Test


@dataclass(frozen=True, slots=True)
class _Value:
    """A side of a comparison. axis: its name, "" for a value as written."""

    axis: str
    text: str
    number: Number | None

    def text_at(self, texts: Texts) -> str:
        return texts[self.axis] if self.axis else self.text


def parse_filter(text: object, axes: Mapping[str, tuple[str, ...]]) -> Filter:
    """A filter over axes (name -> its values); raises ValueError saying what is wrong and allowed."""
    if not isinstance(text, str) or not text.strip():
        raise ValueError("expected a comparison over axes, such as 'duration <= 0.5 s or stops == off'")
    return Filter(text, _Parser(text, axes).whole())


class _Parser:
    """Recursive descent, one method a rule of the grammar."""

    def __init__(self, text: str, axes: Mapping[str, tuple[str, ...]]) -> None:
        self._axes = axes
        self._tokens = _tokens(text)
        self._at = 0

    def whole(self) -> Test:
        test = self._or()
        if self._kind:
            raise ValueError(f"expected and, or, or the end before {self._word!r}")
        return test

    @property
    def _kind(self) -> str:
        return self._tokens[self._at][0] if self._at < len(self._tokens) else ""

    @property
    def _word(self) -> str:
        return self._tokens[self._at][1] if self._at < len(self._tokens) else "the end"

    def _take(self, *words: str) -> bool:
        """Step over one of the words or signs, if it is there."""
        if self._kind in ("word", "sign") and self._word in words:
            self._at += 1
            return True
        return False

    def _need(self, word: str) -> None:
        if not self._take(word):
            raise ValueError(f"expected {word!r}, found {self._word!r}")

    def _or(self) -> Test:
        parts = [self._and()]
        while self._take("or"):
            parts.append(self._and())
        return parts[0] if len(parts) == 1 else lambda texts: any(part(texts) for part in parts)

    def _and(self) -> Test:
        parts = [self._not()]
        while self._take("and"):
            parts.append(self._not())
        return parts[0] if len(parts) == 1 else lambda texts: all(part(texts) for part in parts)

    def _not(self) -> Test:
        if self._take("not"):
            inner = self._not()
            return lambda texts: not inner(texts)
        if self._take("("):
            inner = self._or()
            self._need(")")
            return inner
        return self._comparison()

    def _comparison(self) -> Test:
        left = self._axis()
        if self._take("in"):
            self._need("[")
            tests = [_compared(left, "==", self._value(left), self._axes)]
            while self._take(","):
                tests.append(_compared(left, "==", self._value(left), self._axes))
            self._need("]")
            return lambda texts: any(test(texts) for test in tests)
        sign = self._word
        if not self._take(*_ORDER):
            raise ValueError(f"expected {' '.join(_ORDER)} or in after {left.axis}, found {self._word!r}")
        return _compared(left, sign, self._value(left), self._axes)

    def _axis(self) -> _Value:
        name = self._word
        if self._kind != "word" or name in _RESERVED:
            raise ValueError(f"expected an axis, found {name!r} (axes: {', '.join(self._axes) or 'none'})")
        if name not in self._axes:
            known = ", ".join(self._axes) or "none"
            raise ValueError(f"there is no axis {name!r}{did_you_mean(name, self._axes)} (axes: {known})")
        self._at += 1
        return _Value(name, "", number_of(self._axes[name][0]))

    def _value(self, left: _Value) -> _Value:
        kind, word = self._kind, self._word
        if kind == "word" and word in self._axes and word not in self._axes[left.axis]:
            return self._axis()
        if kind not in ("word", "number", "quoted") or word in _RESERVED:
            raise ValueError(f"expected a value to compare {left.axis} with, found {word!r}")
        self._at += 1
        text = word[1:-1] if kind == "quoted" else word
        return _Value("", text, number_of(text) if kind == "number" else None)


def _compared(left: _Value, sign: str, right: _Value, axes: Mapping[str, tuple[str, ...]]) -> Test:
    """The comparison; raises ValueError when the two sides cannot be compared."""
    told = right.axis or right.text
    if left.number is not None and right.number is not None:
        if left.number.unit != right.number.unit:
            raise ValueError(f"{left.axis} is {left.number.article}, {told} is {right.number.article}")
        order = _ORDER[sign]
        return lambda texts: order(_si(left.text_at(texts)), _si(right.text_at(texts)))
    if left.number is not None or right.number is not None:
        kinds = [side.number.article if side.number else "a word" for side in (left, right)]
        raise ValueError(f"{left.axis} is {kinds[0]}, {told} is {kinds[1]}: they cannot be compared")
    if sign not in ("==", "!="):
        raise ValueError(f"{left.axis} is a word and has no order; allowed are == != in")
    words = [word_of(text) for text in axes[left.axis]]
    if not right.axis and right.text not in words:
        raise ValueError(f"{left.axis} is never {right.text!r}{did_you_mean(right.text, words)} ({', '.join(words)})")
    wanted = sign == "=="
    return lambda texts: (word_of(left.text_at(texts)) == word_of(right.text_at(texts))) is wanted


def _si(text: str) -> float:
    number = number_of(text)
    assert number is not None  # all values of an axis are of one kind
    return float(f"{number.value:.12g}")


def _tokens(text: str) -> list[tuple[str, str]]:
    found, at = [], 0
    text = text.rstrip()
    while at < len(text):
        match = _TOKEN.match(text, at)
        if match is None:
            raise ValueError(f"not understood from {text[at:].strip()[:20]!r} on")
        kind = match.lastgroup or ""
        found.append((kind, match[kind]))
        at = match.end()
    return found
