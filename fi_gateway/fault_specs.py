"""Faults as a scenario file gives them: one small class each.

Each reads its own keys, builds the engine's fault, and says in words what it does. `build` raises SpecError when the
values do not fit the target.
"""

import re
from dataclasses import dataclass
from typing import Annotated, Final, Literal, TypeAlias

from pydantic import Field, PlainValidator, WithJsonSchema

from canopen_exo.signal import Signal
from fi_gateway.boundary import Count, Later, Share, SpecError, SpecModel, Whole
from fi_gateway.faults import Bias, BitFlip, Drop, Fault, StuckAt, StuckAtPayload, StuckAtValue
from fi_gateway.quantity import Dimension, QuantityError, describe_value, parse_quantity
from fi_gateway.target import Place

_DIMENSIONS: Final = {"rad": Dimension.ANGLE, "rad/s": Dimension.SPEED, "N m": Dimension.TORQUE}
_COUNTS: Final = {"rad": "counts", "rad/s": "counts/s"}
_WHOLE: Final = re.compile(r"([+-]?[0-9]{1,20})\s*(counts(?:/s)?)", re.ASCII)
_NOT_ZERO: Final = re.compile(r"\s*[+-]?[0.]*[1-9]", re.ASCII)
_PAYLOAD: Final = re.compile(r"[0-9a-fA-F]{2}( [0-9a-fA-F]{2}){0,7}", re.ASCII)


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


Scalar: TypeAlias = Annotated[
    str | int | float, PlainValidator(_scalar), WithJsonSchema({"type": ["string", "number"]})
]
Payload: TypeAlias = Annotated[str, PlainValidator(_payload), WithJsonSchema({"type": "string"})]


def raw_value(given: str | int | float, signal: Signal) -> int:
    """The raw integer of a value written for that signal, not yet checked for range; raises SpecError."""
    name = f"{signal.name} of {signal.node}"
    dimension = _DIMENSIONS.get(signal.unit)
    if dimension is None:
        if not isinstance(given, int):
            raise SpecError(("value",), f"{name} is a plain number without unit, such as 0x27; got {given!r}")
        return given
    counts = _WHOLE.fullmatch(given.strip()) if isinstance(given, str) else None
    if counts is not None and counts[2] == _COUNTS.get(signal.unit):
        return int(counts[1])
    try:
        return signal.to_raw(parse_quantity(given, dimension))
    except QuantityError as error:
        raise SpecError(("value",), f"{name}: {error}") from None


def _signal(place: Place, fault: str) -> Signal:
    if place.signal is None:
        raise SpecError(("type",), f"{fault} acts on a signal, the target is a whole frame; add signal to the target")
    return place.signal


class FaultSpec(SpecModel):
    """Base of the fault types in files."""

    __slots__ = ()

    def build(self, place: Place) -> Fault:
        """The fault on that target; raises SpecError."""
        raise NotImplementedError

    def words(self, place: Place) -> str:
        """What happens to the target: "held at its last value"."""
        raise NotImplementedError


@dataclass(frozen=True, slots=True)
class StuckAtSpec(FaultSpec):
    """The last value before activation."""

    type: Literal["stuck_at"]

    def build(self, place: Place) -> Fault:
        """See StuckAt."""
        return StuckAt(place.signal)

    def words(self, place: Place) -> str:
        """For people."""
        return "held at its last value" if place.signal is not None else "held at its last payload"


@dataclass(frozen=True, slots=True)
class StuckAtValueSpec(FaultSpec):
    """A given value (with a signal: `value`, in its unit), or given bytes (whole frame: `payload`)."""

    type: Literal["stuck_at_value"]
    value: Scalar | None = None
    payload: Payload | None = None

    def build(self, place: Place) -> Fault:
        """See StuckAtValue and StuckAtPayload."""
        signal = place.signal
        if signal is None:
            if self.value is not None:
                raise SpecError(("value",), "the target is a whole frame: give its bytes as payload, or add a signal")
            if self.payload is None:
                raise SpecError((), "payload is missing: the bytes to send instead, such as '00 00 00 00'")
            data = bytes.fromhex(self.payload)
            if place.size >= 0 and len(data) != place.size:
                raise SpecError(("payload",), f"{len(data)} bytes given; {place.words} carries {place.size}")
            return StuckAtPayload(data)
        if self.payload is not None:
            raise SpecError(("payload",), "the target is a signal: give its value, or leave signal out of the target")
        if self.value is None:
            raise SpecError((), f"value is missing: what {signal.name} shall read, in {signal.unit or 'plain numbers'}")
        raw = raw_value(self.value, signal)
        if not signal.low <= raw <= signal.high:
            span = f"{signal.to_si(signal.low):.6g}..{signal.to_si(signal.high):.6g} {signal.unit}".strip()
            raise SpecError(
                ("value",), f"{self.value} is more than {signal.name} of {signal.node} can carry; allowed {span}"
            )
        return StuckAtValue(signal, raw)

    def words(self, place: Place) -> str:
        """For people."""
        return f"reads {self.value}" if place.signal is not None else f"replaced by {self.payload}"


@dataclass(frozen=True, slots=True)
class BiasSpec(FaultSpec):
    """A constant added to a signal, in its unit."""

    type: Literal["bias"]
    value: Scalar

    def build(self, place: Place) -> Fault:
        """See Bias."""
        signal = _signal(place, "bias")
        raw = raw_value(self.value, signal)
        span = signal.high - signal.low
        if abs(raw) > span:
            most = f"{signal.to_si(span):.6g} {signal.unit}".strip()
            raise SpecError(
                ("value",), f"{self.value} is more than the whole range of {signal.name} of {signal.node}, {most}"
            )
        if raw == 0 and _NOT_ZERO.match(str(self.value)):
            one = f"{signal.scale:.3g} {signal.unit}"
            raise SpecError(("value",), f"{self.value} is less than half of one count ({one}) and would change nothing")
        return Bias(signal, raw)

    def words(self, place: Place) -> str:
        """For people."""
        return f"shifted by {self.value}"


@dataclass(frozen=True, slots=True)
class DropSpec(FaultSpec):
    """The frame is lost, each with a probability."""

    type: Literal["drop"]
    probability: Share = 1.0

    def build(self, place: Place) -> Fault:
        """See Drop."""
        if place.signal is not None:
            name = place.signal.name
            raise SpecError(("type",), f"drop loses whole frames, the target is a signal; give pdo instead of {name}")
        return Drop(self.probability)

    def words(self, place: Place) -> str:
        """For people."""
        return "lost" if self.probability == 1 else f"lost with probability {self.probability:g} each,"


@dataclass(frozen=True, slots=True)
class BitFlipSpec(FaultSpec):
    """Bits inverted: `count` distinct random ones (new for every frame, or fixed for the activation), or `positions`.

    Positions count from the lowest bit of the signal, or from bit 0 of byte 0 of the payload.
    """

    type: Literal["bit_flip"]
    count: Count | None = None
    positions: Annotated[tuple[Whole, ...], Field(min_length=1)] | None = None
    bits: Literal["random", "fixed"] | None = None

    def build(self, place: Place) -> Fault:
        """See BitFlip."""
        length = place.signal.length if place.signal is not None else 8 * (place.size if place.size >= 0 else 8)
        if self.positions is None:
            count = self.count if self.count is not None else 1
            if count > length:
                raise SpecError(("count",), f"{count} bits asked for; {place.words} has {length}")
            return BitFlip(place.signal, count, None, self.bits == "fixed")
        for key, given in (("count", self.count), ("bits", self.bits)):
            if given is not None:
                raise SpecError((key,), f"positions say which bits; leave {key} out, or leave positions out")
        for number, bit in enumerate(self.positions):
            if not 0 <= bit < length:
                raise SpecError(("positions", number), f"there is no bit {bit}; {place.words} has bits 0..{length - 1}")
            if bit in self.positions[:number]:
                raise SpecError(("positions", number), f"bit {bit} is given twice; flipped twice it would not change")
        return BitFlip(place.signal, len(self.positions), self.positions, True)

    def words(self, place: Place) -> str:
        """For people."""
        if self.positions is not None:
            return f"has bit{'s' if len(self.positions) > 1 else ''} {', '.join(map(str, self.positions))} inverted"
        count = self.count or 1
        again = "the same for the whole activation" if self.bits == "fixed" else "drawn anew for every frame"
        return f"has {count} random bit{'s' if count > 1 else ''} inverted ({again})"


FaultChoice: TypeAlias = Annotated[
    StuckAtSpec | StuckAtValueSpec | BiasSpec | DropSpec | BitFlipSpec,
    Field(discriminator="type"),
    Later(
        (
            *("gain", "drift", "noise", "bit_stuck", "package_drop", "delay", "time_delay", "duplicate", "replay"),
            *("insert", "masquerade", "corrupt_dlc", "resequence", "bit_error", "stuck_dominant", "no_ack"),
            *("babbling_idiot", "bus_off"),
        )
    ),
]
