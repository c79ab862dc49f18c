"""Faults in files that act on a bus below the frames: bits, acknowledgement, error states, a node that babbles.

They need an emulated bus with errors (`canopen_exo.bus.wire`), so a run in virtual time; what has no such bus refuses
them before it starts (`fi_gateway.schema.refuse_wire_faults`).
"""

from dataclasses import dataclass
from typing import Annotated, Literal

from pydantic import Field

from canopen_exo.bus.bit_stream import field_positions
from canopen_exo.bus.disturbance import ALL
from canopen_exo.bus.frame import Frame
from fi_gateway.boundary import Share, SpecError, Text, Time, Whole
from fi_gateway.fault_specs.base import AnyPayload, CobId, FaultSpec
from fi_gateway.marked_yaml import did_you_mean
from fi_gateway.on_wire import Babbling, Disturbed, OnWire, SwitchedOff
from fi_gateway.quantity import format_duration
from fi_gateway.target import Place
from fi_gateway.wire_faults import BitError, BitErrorRate, GilbertElliott, NoAck, StuckDominant, mask_of


class WireFaultSpec(FaultSpec):
    """Base of the wire faults in files. Their place is on a bus (`fi_gateway.target.resolve_wire`)."""

    __slots__ = ()

    def build(self, place: Place) -> OnWire:
        """The fault on that bus; raises SpecError."""
        raise NotImplementedError


@dataclass(frozen=True, slots=True)
class BitErrorSpec(WireFaultSpec):
    """One bit of a field seen inverted, by all nodes or by `receivers` only; stuff bits are not counted."""

    type: Literal["bit_error"]
    field: Literal["sof", "id", "rtr", "control", "data", "crc", "crc_delimiter", "ack", "ack_delimiter", "eof"]
    bit: Annotated[Whole, Field(ge=0)] = 0
    receivers: Annotated[tuple[Text, ...] | None, Field(min_length=1)] = None

    def build(self, place: Place) -> OnWire:
        """See BitError."""
        size = place.size if place.size >= 0 else 8
        bits = len(field_positions(Frame(0, bytes(size)), self.field))
        if self.bit >= bits:
            there = f"bits 0..{bits - 1}" if bits else "no bits"
            raise SpecError(("bit",), f"there is no bit {self.bit}; {self.field} of {place.words} has {there}")
        receivers = _mask(self.receivers, place)
        return Disturbed(place.wire, BitError(self.field, self.bit, receivers, place.cob_ids, place.senders))

    def words(self, place: Place) -> str:
        """For people."""
        return f"has bit {self.bit} of its {self.field} seen inverted{_by(self.receivers)}"


@dataclass(frozen=True, slots=True)
class StuckDominantSpec(WireFaultSpec):
    """The bus held dominant, whoever sends what."""

    type: Literal["stuck_dominant"]

    def build(self, place: Place) -> OnWire:
        """See StuckDominant."""
        _whole_bus(place, "stuck_dominant")
        return Disturbed(place.wire, StuckDominant())

    def words(self, place: Place) -> str:
        """For people."""
        return "is held dominant"


@dataclass(frozen=True, slots=True)
class NoAckSpec(WireFaultSpec):
    """The frames are not acknowledged: by nobody, or not by `receivers`."""

    type: Literal["no_ack"]
    receivers: Annotated[tuple[Text, ...] | None, Field(min_length=1)] = None

    def build(self, place: Place) -> OnWire:
        """See NoAck."""
        return Disturbed(place.wire, NoAck(_mask(self.receivers, place), place.cob_ids, place.senders))

    def words(self, place: Place) -> str:
        """For people."""
        who = "anybody" if self.receivers is None else " or ".join(self.receivers)
        return f"is not acknowledged by {who}"


@dataclass(frozen=True, slots=True)
class BitErrorRateSpec(WireFaultSpec):
    """Every bit on the bus is inverted with the same small probability."""

    type: Literal["bit_error_rate"]
    rate: Share
    receivers: Annotated[tuple[Text, ...] | None, Field(min_length=1)] = None

    def build(self, place: Place) -> OnWire:
        """See BitErrorRate."""
        _whole_bus(place, "bit_error_rate")
        _rate("rate", self.rate)
        return Disturbed(place.wire, BitErrorRate(self.rate, place.bit_ns, None, _mask(self.receivers, place)))

    def words(self, place: Place) -> str:
        """For people."""
        return f"has each bit seen inverted with probability {self.rate:g}{_by(self.receivers)}"


@dataclass(frozen=True, slots=True)
class GilbertElliottSpec(WireFaultSpec):
    """Noise in bursts: a good and a bad state with a bit error rate each, and the probabilities of change per bit."""

    type: Literal["gilbert_elliott"]
    enter: Share
    leave: Share
    rate_bad: Share
    rate_good: Share = 0.0
    receivers: Annotated[tuple[Text, ...] | None, Field(min_length=1)] = None

    def build(self, place: Place) -> OnWire:
        """See GilbertElliott."""
        _whole_bus(place, "gilbert_elliott")
        for key, rate in (("enter", self.enter), ("leave", self.leave), ("rate_bad", self.rate_bad)):
            _rate(key, rate)
        mask = _mask(self.receivers, place)
        chain = GilbertElliott(self.enter, self.leave, self.rate_good, self.rate_bad, place.bit_ns, None, mask)
        return Disturbed(place.wire, chain)

    def words(self, place: Place) -> str:
        """For people."""
        share = self.enter / (self.enter + self.leave)
        return (
            f"has bits seen inverted in bursts of {1 / self.leave:g} bits on average, {100 * share:g} % of the time, "
            f"with probability {self.rate_bad:g} in them and {self.rate_good:g} else{_by(self.receivers)}"
        )


@dataclass(frozen=True, slots=True)
class BusOffSpec(WireFaultSpec):
    """The controller of a node goes bus-off; it is asked to restart that long after the window."""

    type: Literal["bus_off"]
    restart_ns: Annotated[Time | None, Field(alias="restart")] = None

    def build(self, place: Place) -> OnWire:
        """See SwitchedOff."""
        if not place.node or place.cob_ids:
            raise SpecError((), f"bus_off acts on a node; give node alone in the target: {' | '.join(place.nodes)}")
        return SwitchedOff(place.wire, place.nodes.index(place.node), self.restart_ns or 0)

    def words(self, place: Place) -> str:
        """For people."""
        after = f" (and asked to restart {format_duration(self.restart_ns)} after that)" if self.restart_ns else ""
        return f"is bus-off{after}"


@dataclass(frozen=True, slots=True)
class BabblingIdiotSpec(WireFaultSpec):
    """A further node that always has a frame to send; by default the one that wins every arbitration."""

    type: Literal["babbling_idiot"]
    cob_id: CobId = 0
    payload: AnyPayload = ""

    def build(self, place: Place) -> OnWire:
        """See BabblingIdiot."""
        _whole_bus(place, "babbling_idiot")
        return Babbling(place.wire, Frame(self.cob_id, bytes.fromhex(self.payload)), place.bit_ns)

    def words(self, place: Place) -> str:
        """For people."""
        return f"is kept busy with frames {self.cob_id:03X}#{self.payload.replace(' ', '')} of a further node"


def _whole_bus(place: Place, fault: str) -> None:
    """Raise SpecError for a target that is a part of the traffic."""
    if place.cob_ids or place.node or place.senders != ALL:
        raise SpecError((), f"{fault} acts on a whole bus, the target is {place.words}; leave wire alone in the target")


def _mask(names: tuple[str, ...] | None, place: Place) -> int:
    """The ports of these nodes; raises SpecError at `receivers`."""
    if names is None:
        return ALL
    for number, name in enumerate(names):
        if name not in place.nodes:
            hint = did_you_mean(name, place.nodes)
            text = f"{name!r} is not on the {place.wire} bus{hint} (there are {', '.join(place.nodes)})"
            raise SpecError(("receivers", number), text)
    return mask_of([place.nodes.index(name) for name in names])


def _by(receivers: tuple[str, ...] | None) -> str:
    return "" if receivers is None else f" by {' and '.join(receivers)} alone"


def _rate(key: str, rate: float) -> None:
    if rate <= 0:
        raise SpecError((key,), f"{rate:g} given; allowed is more than 0, up to 1 per bit")
