"""What all faults in files have in common, and how values become raw ones."""

import re
from typing import Annotated, Final, TypeAlias

from pydantic import PlainSerializer, PlainValidator, WithJsonSchema

from canopen_exo.signal import Signal
from fi_gateway.boundary import SpecError, SpecModel
from fi_gateway.faults import Fault
from fi_gateway.quantity import Dimension, QuantityError, describe_value, dimension_of, parse_quantity
from fi_gateway.target import Place, cob_id

_COUNTS: Final = {"rad": "counts", "rad/s": "counts/s", "stride": "counts"}
_WHOLE: Final = re.compile(r"([+-]?[0-9]{1,20})\s*(counts(?:/s)?)", re.ASCII)
_COUNTED: Final = re.compile(r"([+-]?[0-9]{1,20}(?:\.[0-9]{0,20})?)\s*(counts(?:/s)?)", re.ASCII)
_PER_TIME: Final = re.compile(r"(.*?)\s*/\s*(s|ms|min)", re.ASCII)
_SECONDS: Final = {"s": 1.0, "ms": 1e-3, "min": 60.0}
_SLOPES: Final = {"rad": "1 deg/s", "rad/s": "10 rpm/s", "N m": "0.5 N m/s", "stride": "10 %/s", "": "3 /s"}
_PAYLOAD: Final = re.compile(r"[0-9a-fA-F]{2}( [0-9a-fA-F]{2}){0,7}", re.ASCII)
_RATIO: Final = re.compile(r"([+-]?[0-9]{1,9}(?:\.[0-9]{0,20})?)\s*%", re.ASCII)
_MOST_RATIO: Final = 1e9


def _scalar(given: object) -> str | int | float:
    """A quantity or a plain number; which of them, the signal tells."""
    if isinstance(given, bool) or not isinstance(given, str | int | float):
        raise ValueError(f"expected a value with its unit, such as '0 rpm'; got {describe_value(given)}")
    return given


def _payload(given: object) -> str:
    if not isinstance(given, str) or not _PAYLOAD.fullmatch(given):
        got = describe_value(given)
        raise ValueError(f"expected 1 to 8 bytes in hexadecimal with spaces, in quotes, such as '00 1F A0'; got {got}")
    return given.upper()


def _payload_or_none(given: object) -> str:
    """As _payload; "" for no bytes at all."""
    return "" if given == "" else _payload(given)


def _ratio(given: object) -> float:
    """1.2 or "120 %"; may be negative."""
    number = _RATIO.fullmatch(given.strip()) if isinstance(given, str) else None
    if number is not None:
        return float(number[1]) / 100
    if isinstance(given, bool) or not isinstance(given, int | float):
        raise ValueError(f"expected a number such as 1.2, or a percentage such as '120 %'; got {describe_value(given)}")
    if not abs(given) <= _MOST_RATIO:  # also refuses NaN
        raise ValueError(f"{given} is too large; allowed up to {_MOST_RATIO:g}")
    return float(given)


Scalar: TypeAlias = Annotated[
    str | int | float, PlainValidator(_scalar), WithJsonSchema({"type": ["string", "number"]})
]
Payload: TypeAlias = Annotated[str, PlainValidator(_payload), WithJsonSchema({"type": "string"})]
AnyPayload: TypeAlias = Annotated[str, PlainValidator(_payload_or_none), WithJsonSchema({"type": "string"})]
CobId: TypeAlias = Annotated[
    int,
    PlainValidator(cob_id),
    PlainSerializer(lambda value: f"0x{value:03X}"),
    WithJsonSchema({"type": ["integer", "string"]}),
]
Ratio: TypeAlias = Annotated[
    float, PlainValidator(_ratio), WithJsonSchema({"type": ["number", "string"], "examples": [1.2, "120 %"]})
]


class FaultSpec(SpecModel):
    """Base of the fault types in files: a frozen dataclass of the keys, one of them `type`."""

    __slots__ = ()

    def build(self, place: Place) -> Fault:
        """The fault on that target; raises SpecError."""
        raise NotImplementedError

    def words(self, place: Place) -> str:
        """What happens to the target: "held at its last value"."""
        raise NotImplementedError

    def doubts(self) -> str:
        """Why it changes nothing: "factor is 1"; "" when it does."""
        return ""

    def needs_frames(self) -> bool:
        """Whether it acts with frames of the target alone, and not by its own clock."""
        return True


def raw_value(given: str | int | float, signal: Signal, key: str = "value") -> int:
    """The raw integer of a value written for that signal, not yet checked for range; raises SpecError at `key`."""
    dimension = dimension_of(signal.unit)
    if dimension is None:
        if not isinstance(given, int):
            raise SpecError((key,), f"{_name(signal)} is a plain number without unit, such as 0x27; got {given!r}")
        return given
    counts = _WHOLE.fullmatch(given.strip()) if isinstance(given, str) else None
    if counts is not None and counts[2] == _COUNTS.get(signal.unit):
        return int(counts[1])
    try:
        return signal.to_raw(parse_quantity(given, dimension))
    except QuantityError as error:
        raise SpecError((key,), f"{_name(signal)}: {error}") from None


def raw_amount(given: str | int | float, signal: Signal, key: str) -> float:
    """Raw units, not rounded, of an amount written for that signal; raises SpecError at `key` unless it is > 0."""
    amount = _raw_float(given, signal, key)
    if not 0 < amount <= signal.high - signal.low:
        raise SpecError(
            (key,), f"{given!r} is no amount of noise; allowed is more than 0, up to the whole range of {_name(signal)}"
        )
    return amount


def raw_slope(given: str | int | float, signal: Signal, key: str) -> float:
    """Raw units per second of a change written for that signal; raises SpecError at `key`."""
    text = given.strip() if isinstance(given, str) else ""
    if text.endswith("/s^2"):
        text = text.removesuffix("^2") + "/s"
    if signal.unit == "rad" and text.endswith("rpm"):
        return parse_quantity(text, Dimension.SPEED) / signal.scale
    parts = _PER_TIME.fullmatch(text)
    try:
        if parts is not None:
            change: str | int = parts[1]
            if dimension_of(signal.unit) is None and re.fullmatch(r"[+-]?[0-9]{1,18}", parts[1], re.ASCII):
                change = int(parts[1])
            return _raw_float(change, signal, key) / _SECONDS[parts[2]]
    except SpecError:
        pass
    what = f"{_name(signal)} changes in {signal.unit or 'plain numbers'} per time"
    raise SpecError((key,), f"{what}, such as '{_SLOPES.get(signal.unit, '3 /s')}'; got {given!r}")


def _raw_float(given: str | int | float, signal: Signal, key: str) -> float:
    dimension = dimension_of(signal.unit)
    if dimension is None:
        if not isinstance(given, int | float):
            raise SpecError((key,), f"{_name(signal)} is a plain number without unit, such as 3; got {given!r}")
        return float(given)
    counts = _COUNTED.fullmatch(given.strip()) if isinstance(given, str) else None
    if counts is not None and counts[2] == _COUNTS.get(signal.unit):
        return float(counts[1])
    try:
        return parse_quantity(given, dimension) / signal.scale
    except QuantityError as error:
        raise SpecError((key,), f"{_name(signal)}: {error}") from None


def value_in_range(given: str | int | float, signal: Signal) -> int:
    """The raw integer of `value`, within the range of the signal; raises SpecError."""
    raw = raw_value(given, signal)
    if not signal.low <= raw <= signal.high:
        span = f"{signal.to_si(signal.low):.6g}..{signal.to_si(signal.high):.6g} {signal.unit}".strip()
        raise SpecError(("value",), f"{given} is more than {_name(signal)} can carry; allowed {span}")
    return raw


def needed_signal(place: Place, fault: str) -> Signal:
    """The signal of the target; raises SpecError when it is a whole frame."""
    if place.signal is None:
        raise SpecError(("type",), f"{fault} acts on a signal, the target is a whole frame; add signal to the target")
    return place.signal


def no_signal(place: Place, what: str) -> None:
    """Raise SpecError when the target is not a whole frame. what: "drop loses whole frames"."""
    if place.signal is not None:
        raise SpecError(("type",), f"{what}, the target is a signal; give pdo instead of {place.signal.name}")


def one_of(given: dict[str, object], what: str) -> str:
    """The one key that is given (not None); raises SpecError. what: "noise"."""
    found = [key for key, value in given.items() if value is not None]
    if len(found) != 1:
        got = f"; got {' and '.join(found)}" if found else ""
        raise SpecError((found[1],) if found else (), f"{what} needs exactly one of {', '.join(given)}{got}")
    return found[0]


def check_positions(positions: tuple[int, ...], length: int, words: str, twice: str) -> None:
    """Raise SpecError unless the bit positions are distinct and there. twice: what is wrong with a bit given twice."""
    for number, bit in enumerate(positions):
        if not 0 <= bit < length:
            raise SpecError(("positions", number), f"there is no bit {bit}; {words} has bits 0..{length - 1}")
        if bit in positions[:number]:
            raise SpecError(("positions", number), f"bit {bit} is given twice{twice}")


def bit_length(place: Place) -> int:
    """How many bits the target has; 64 for a frame whose length the plan does not know."""
    if place.signal is not None:
        return place.signal.length
    return 8 * (place.size if place.size >= 0 else 8)


def _name(signal: Signal) -> str:
    return f"{signal.name} of {signal.node}"
