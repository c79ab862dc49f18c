"""Conditions as a scenario file gives them: read, resolved against the rig, and built.

    condition  := all { "or" all }                 and binds more closely than or
    all        := part { "and" part }
    part       := "(" condition ")" | comparison
    comparison := SIGNAL [ "&" MASK ] OPERATOR VALUE

SIGNAL: `right_knee.position`, `right_knee.0x6064`, or as in the DBC, `right_knee_TPDO1.position`, `HLC_status.phase`;
OPERATOR: < <= > >= == !=; VALUE: in a unit of the signal, or in its counts; MASK: bits of a signal without unit, such
as `statusword & 0x6F == 0x27`.
Left out: `not`, arithmetic, signals compared with each other, values of SDOs.
"""

import math
import re
from dataclasses import dataclass
from typing import Annotated, Final, TypeAlias

from pydantic import PlainValidator, WithJsonSchema

from canopen_exo.plan import BusPlan
from canopen_exo.signal import Signal
from fi_gateway.boundary import SpecError
from fi_gateway.conditions import AllOf, AnyOf, Condition, Reading, Term, Within
from fi_gateway.events import FROM_CONTROLLER, FROM_DRIVES
from fi_gateway.marked_yaml import did_you_mean
from fi_gateway.quantity import QuantityError, describe_value, dimension_of, parse_quantity
from fi_gateway.target import TO_CONTROLLER, direction_of, service_signals, signal_names

_MAX_TEXT: Final = 1000
_MAX_DEPTH: Final = 16
_EXAMPLE: Final = "'right_knee.position < -60 deg and right_knee.velocity < 0 rpm'"

_WORD: Final = re.compile(r"\s*(\(|\)|(?:and|or)\b)", re.ASCII)
_SIGNAL: Final = r"[A-Za-z_][A-Za-z0-9_]*\.[A-Za-z0-9_]+"
_COMPARISON: Final = re.compile(
    rf"\s*({_SIGNAL})\s*(?:&\s*(0x[0-9a-fA-F]{{1,16}}|[0-9]{{1,20}})\s*)?(<=|>=|==|!=|<|>)"
    r"\s*([+-]?[.0-9][^()<>=!&]*?)(?=\s*(?:[()]|\band\b|\bor\b|$))",
    re.ASCII,
)
_WHOLE: Final = re.compile(r"([+-]?[0-9]{1,20}|0x[0-9a-fA-F]{1,16})\s*(counts|counts/s)?", re.ASCII)
_COUNTS: Final = {"rad": "counts", "rad/s": "counts/s", "stride": "counts", "": None}
_FAR: Final = 1 << 80
"""Beyond every raw value."""


@dataclass(frozen=True, slots=True)
class Comparison:
    """As written. at: character of the condition, from 1; mask: None for all bits."""

    at: int
    signal: str
    mask: int | None
    operator: str
    value: str


@dataclass(frozen=True, slots=True)
class Group:
    """Parts joined by `and` or `or`."""

    word: str
    parts: "tuple[Syntax, ...]"


Syntax: TypeAlias = Comparison | Group


@dataclass(frozen=True, slots=True)
class Resolved:
    """A condition on a rig. can_hold: False when its values lie outside what its signals can carry."""

    condition: Condition
    can_hold: bool


def parse_condition(given: object) -> Syntax:
    """The form of a condition; raises ValueError that says at which character what was expected."""
    if not isinstance(given, str) or not given.strip():
        raise ValueError(f"expected a condition such as {_EXAMPLE}; got {describe_value(given)}")
    if len(given) > _MAX_TEXT:
        raise ValueError(f"the condition is {len(given)} characters long; allowed up to {_MAX_TEXT}")
    found, at = _any(given, 0, 0)
    if given[at:].strip():
        raise _expected(given, at, "and, or, or the end")
    return found


def resolve_condition(text: str, plan: BusPlan) -> Resolved:
    """A fresh condition of the engine; raises SpecError for a signal or value that does not fit the rig."""
    readings: dict[tuple[str, str], Reading] = {}
    term, can_hold = _build(parse_condition(text), plan, readings)
    return Resolved(Condition(term, list(readings.values())), can_hold)


def _condition(given: object) -> str:
    parse_condition(given)
    return " ".join(str(given).split())


ConditionText: TypeAlias = Annotated[
    str,
    PlainValidator(_condition),
    WithJsonSchema({"type": "string", "examples": ["right_knee.position < -60 deg"]}),
]
"""Checked for its form only; `resolve_condition` knows the rig."""


def _expected(text: str, at: int, what: str) -> ValueError:
    at += len(text[at:]) - len(text[at:].lstrip())
    got = repr(text[at : at + 20]) if text[at:] else "the end"
    return ValueError(f"character {at + 1}: expected {what}; got {got} (for example {_EXAMPLE})")


def _any(text: str, at: int, depth: int) -> tuple[Syntax, int]:
    parts, at = _all(text, at, depth)
    found = [parts]
    while (word := _WORD.match(text, at)) and word[1] == "or":
        part, at = _all(text, word.end(), depth)
        found.append(part)
    return (found[0] if len(found) == 1 else Group("or", tuple(found))), at


def _all(text: str, at: int, depth: int) -> tuple[Syntax, int]:
    part, at = _part(text, at, depth)
    found = [part]
    while (word := _WORD.match(text, at)) and word[1] == "and":
        part, at = _part(text, word.end(), depth)
        found.append(part)
    return (found[0] if len(found) == 1 else Group("and", tuple(found))), at


def _part(text: str, at: int, depth: int) -> tuple[Syntax, int]:
    opening = _WORD.match(text, at)
    if opening is not None and opening[1] == "(":
        if depth == _MAX_DEPTH:
            raise ValueError(f"character {opening.end()}: more than {_MAX_DEPTH} brackets in each other")
        found, at = _any(text, opening.end(), depth + 1)
        closing = _WORD.match(text, at)
        if closing is None or closing[1] != ")":
            raise _expected(text, at, "and, or, or a closing bracket")
        return found, closing.end()
    match = _COMPARISON.match(text, at)
    if match is None:
        raise _expected(text, at, "SIGNAL OPERATOR VALUE, operators < <= > >= == !=")
    mask = None if match[2] is None else int(match[2], 0 if match[2].startswith("0x") else 10)
    return Comparison(match.start(1) + 1, match[1], mask, match[3], match[4]), match.end()


def _build(syntax: Syntax, plan: BusPlan, readings: dict[tuple[str, str], Reading]) -> tuple[Term, bool]:
    """The term, and whether it can ever hold. readings: by (message, signal); those made are added."""
    if isinstance(syntax, Comparison):
        return _compare(syntax, plan, readings)
    built = [_build(part, plan, readings) for part in syntax.parts]
    terms = [term for term, _ in built]
    if syntax.word == "or":
        return AnyOf(terms), any(can_hold for _, can_hold in built)
    return AllOf(terms), all(can_hold for _, can_hold in built) and _agree(terms)


def _agree(terms: list[Term]) -> bool:
    """Whether some value of each signal is within all that is asked of it side by side."""
    spans: dict[tuple[Reading, int], tuple[int, int]] = {}
    for term in terms:
        if isinstance(term, Within) and not term.outside:
            low, high = spans.get((term.reading, term.mask), (term.low, term.high))
            spans[term.reading, term.mask] = max(low, term.low), min(high, term.high)
    return all(low <= high for low, high in spans.values())


def _compare(part: Comparison, plan: BusPlan, readings: dict[tuple[str, str], Reading]) -> tuple[Term, bool]:
    signal = _find(part, plan)
    port = FROM_DRIVES if direction_of(signal.cob_id, plan) == TO_CONTROLLER else FROM_CONTROLLER
    reading = readings.setdefault((signal.message, signal.name), Reading(port, signal))
    limit = _limit(part, signal)
    low, high = {
        "<": (-_FAR, math.ceil(limit) - 1),
        "<=": (-_FAR, math.floor(limit)),
        ">": (math.floor(limit) + 1, _FAR),
        ">=": (math.ceil(limit), _FAR),
    }.get(part.operator, (math.ceil(limit), math.floor(limit)))
    outside = part.operator == "!="
    if part.mask is None:
        can_hold = outside or (low <= signal.high and high >= signal.low)
    elif part.operator == "==":
        can_hold = low >= 0 and low & ~part.mask == 0
    else:
        can_hold = outside or (low <= part.mask and high >= 0)
    return Within(reading, low, high, -1 if part.mask is None else part.mask, outside), can_hold


def _find(part: Comparison, plan: BusPlan) -> Signal:
    """The signal that is meant; raises SpecError."""
    owner, _, name = part.signal.partition(".")
    if name.startswith("0x"):
        try:
            name = f"0x{int(name, 16):04X}"
        except ValueError:
            raise _error(part, f"{name!r} is not an object such as 0x6064") from None
    signals = [*plan.signals(), *service_signals(plan)]
    around = [signal for signal in signals if owner in (signal.node, signal.message)]
    if not around:
        nodes = dict.fromkeys(signal.node for signal in signals)
        hint = did_you_mean(owner, [*nodes, *dict.fromkeys(signal.message for signal in signals)])
        text = f"unknown joint or message {owner!r}{hint} (this rig has {', '.join(nodes)}, and the messages of the DBC"
        raise _error(part, f"{text}, such as {signals[-1].message}; what is in SDOs cannot be used)")
    found = [signal for signal in around if name in signal_names(signal)]
    if not found:
        names = list(dict.fromkeys(signal.name for signal in around))
        hint = did_you_mean(name, names)
        text = f"no signal {name!r} of {owner}{hint} (allowed: {', '.join(names)}; what is in SDOs cannot be used)"
        raise _error(part, text)
    if len(found) > 1:
        names = [f"{signal.message}.{signal.name}" for signal in found]
        raise _error(part, f"{part.signal} is in several PDOs; write one of {', '.join(names)}")
    return found[0]


def _limit(part: Comparison, signal: Signal) -> float | int:
    """The value in raw units, not rounded; raises SpecError."""
    dimension, counts = dimension_of(signal.unit), _WHOLE.fullmatch(part.value)
    if part.mask is not None and dimension is not None:
        raise _error(part, f"{part.signal} is measured in {signal.unit}; a mask is for signals without unit")
    if counts is not None and counts[2] == _COUNTS.get(signal.unit, ""):
        return int(counts[1], 0 if counts[1].startswith("0x") else 10)
    if dimension is None:
        raise _error(part, f"{part.signal} is a whole number without unit, such as 0x27; got {part.value!r}")
    try:
        limit = parse_quantity(part.value, dimension) / signal.scale
    except QuantityError as error:
        raise _error(part, str(error)) from None
    if part.operator in ("==", "!="):
        raise _error(part, f"{part.signal} is a measured value and never exactly equal; use < <= > or >=")
    whole = math.floor(limit + 0.5)
    return whole if abs(limit - whole) <= 1e-9 * max(1.0, abs(limit)) else limit  # 90 deg is a quarter turn exactly


def _error(part: Comparison, text: str) -> SpecError:
    return SpecError(("condition",), f"character {part.at}: {text}")
