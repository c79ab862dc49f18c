"""Triggers, reports and repairs as a scenario file gives them: one small class each.

Each reads its own keys, builds the engine's object, and says in words what it does.
"""

from dataclasses import dataclass
from typing import Annotated, Final, Literal, TypeAlias

from pydantic import Field

from canopen_exo.bus.frame import Frame
from fi_gateway.boundary import Count, Share, SpecError, SpecModel, Text, Time, Whole
from fi_gateway.fault_specs import CobId, Payload
from fi_gateway.quantity import format_duration
from fi_gateway.repair import Repair
from fi_gateway.target import TO_CONTROLLER, TO_DRIVES, BitsSpec, Place
from fi_gateway.trigger import BusFrame, Report, Trigger

Names: TypeAlias = Annotated[tuple[Text, ...], Field(min_length=1)]
Way: TypeAlias = Literal["to_controller", "to_drives", "both"]
Signal: TypeAlias = Literal["activated", "manifested", "ended"]

RISES: Final = {"activated": "is activated", "manifested": "manifests", "ended": "ends"}
"""The signals of an injector, as verbs: when each rises."""
_HOLDS: Final = {"activated": "is active", "manifested": "has manifested", "ended": "has ended"}


def _hex(data: str) -> str:
    return f" {data}" if data else ""


@dataclass(frozen=True, slots=True)
class PatternSpec(SpecModel):
    """`frame:` of a trigger. mask: bits of the payload that count, all by default; bus: the direction of travel."""

    cob_id: CobId
    data: Payload | None = None
    mask: Payload | None = None
    bus: Way = "both"

    def __post_init__(self) -> None:
        """A mask is as long as the data; raises ValueError."""
        if self.mask is not None and len(self.mask) != len(self.data or ""):
            raise ValueError(f"mask '{self.mask}' and data '{self.data or ''}' must have as many bytes")

    def build(self) -> BusFrame:
        """See BusFrame."""
        data = bytes.fromhex(self.data or "")
        mask = bytes.fromhex(self.mask) if self.mask is not None else b"\xff" * len(data)
        return BusFrame(self.cob_id, data, mask, self.bus != TO_DRIVES, self.bus != TO_CONTROLLER)

    def words(self) -> str:
        """For people: "frame 0x6F0 01 00 (mask FF 00)"."""
        mask = f" (mask {self.mask})" if self.mask is not None else ""
        way = "" if self.bus == "both" else f" {self.bus}"
        return f"frame 0x{self.cob_id:03X}{_hex(self.data or '')}{mask}{way}"


@dataclass(frozen=True, slots=True)
class TriggerSpec(SpecModel):
    """`trigger:` of an injector: what starts it besides its event. One of any, all and frame.

    on: the signal of the named injectors; edge: when it rises, or while it holds; delay: that much later; probability:
    of starting, each time.
    """

    any: Names | None = None
    all: Names | None = None
    frame: PatternSpec | None = None
    on: Signal = "activated"
    edge: Literal["rising", "level"] = "rising"
    delay_ns: Annotated[Time, Field(alias="delay", json_schema_extra={"default": "0 s"})] = 0
    probability: Share = 1.0

    def __post_init__(self) -> None:
        """Exactly one source; raises ValueError."""
        given = [key for key in ("any", "all", "frame") if getattr(self, key) is not None]
        if len(given) != 1:
            got = ", ".join(given) or "none"
            raise ValueError(f"give any (one of), all (of) or frame, one of the three; got {got}")
        if self.frame is not None and self.edge == "level":
            raise ValueError("edge: level needs any or all; a frame comes and is over")
        if self.frame is not None and self.on != "activated":
            raise ValueError(f"on: {self.on} is a signal of injectors; leave it out with frame")

    @property
    def key(self) -> str:
        """The key of the sources: any or all; frame."""
        return "any" if self.any is not None else "all" if self.all is not None else "frame"

    @property
    def sources(self) -> tuple[str, ...]:
        """The injectors it listens to."""
        return (self.any or ()) + (self.all or ())

    def build(self) -> Trigger:
        """See Trigger."""
        pattern = self.frame.build() if self.frame is not None else None
        level = self.edge == "level"
        return Trigger(self.any or (), self.on, self.all or (), level, self.delay_ns, self.probability, pattern)

    def words(self) -> str:
        """For people: "when a or b is activated, 10 ms later"."""
        if self.frame is not None:
            text = f"with {self.frame.words()}"
        else:
            verb = (_HOLDS if self.edge == "level" else RISES)[self.on]
            if self.all is not None and len(self.all) > 1:
                verb = f"{'are all' if self.on == 'activated' else 'have all'} {self.on}"
            names = (" and " if self.all is not None else " or ").join(self.sources)
            text = f"{'while' if self.edge == 'level' else 'when'} {names} {verb}"
        return f"{text}{self.rest()}"

    def rest(self) -> str:
        """Delay and probability: ", 10 ms later, with probability 0.5"."""
        delay = f", {format_duration(self.delay_ns)} later" if self.delay_ns else ""
        chance = f", with probability {self.probability:g}" if self.probability < 1 else ""
        return delay + chance


@dataclass(frozen=True, slots=True)
class ReportFrameSpec(SpecModel):
    """`frame:` of a report. bus: the side it goes to, as a direction of travel."""

    cob_id: CobId
    data: Payload | None = None
    bus: Way = "both"


@dataclass(frozen=True, slots=True)
class ReportSpec(SpecModel):
    """`report:` of an injector: a frame that goes out each time its signal rises."""

    frame: ReportFrameSpec
    on: Signal = "activated"

    def build(self) -> Report:
        """See Report."""
        frame = Frame(self.frame.cob_id, bytes.fromhex(self.frame.data or ""))
        return Report(frame, self.on, self.frame.bus != TO_DRIVES, self.frame.bus != TO_CONTROLLER)

    def words(self) -> str:
        """For people."""
        way = "both ways" if self.frame.bus == "both" else self.frame.bus
        return f"sends 0x{self.frame.cob_id:03X}{_hex(self.frame.data or '')} {way} when it {RISES[self.on]}"


@dataclass(frozen=True, slots=True)
class ChecksumSpec(SpecModel):
    """`checksum:` of a repair. byte: where it lies; prefix: bytes it covers besides, before the others."""

    type: Literal["crc8_j1850", "xor"]
    byte: Annotated[Whole, Field(ge=0, le=7)]
    prefix: Payload | None = None


@dataclass(frozen=True, slots=True)
class CounterSpec(SpecModel):
    """`counter:` of a repair: its bits, little endian."""

    start: Annotated[Whole, Field(ge=0, le=63)]
    length: Annotated[Count, Field(le=64)]


@dataclass(frozen=True, slots=True)
class RepairSpec(SpecModel):
    """`repair:` of an injector: what the application puts into a payload against wrong content, put right again."""

    checksum: ChecksumSpec | None = None
    counter: CounterSpec | None = None

    def build(self, place: Place) -> Repair:
        """See Repair; raises SpecError when the target has no such bits."""
        checksum, counter = self.checksum, self.counter
        if checksum is None and counter is None:
            raise SpecError((), "give checksum, counter or both")
        bits = 8 * place.size if place.size >= 0 else 64
        if checksum is not None and 8 * checksum.byte + 8 > bits:
            raise SpecError(("checksum", "byte"), f"there is no byte {checksum.byte}; {place.words} has {bits // 8}")
        start, length = (counter.start, counter.length) if counter is not None else (0, 0)
        if start + length > bits:
            raise SpecError(("counter",), f"there is no bit {start + length - 1}; {place.words} has {bits}")
        if checksum is None:
            return Repair("", 0, b"", start, length)
        if length and start < 8 * checksum.byte + 8 and 8 * checksum.byte < start + length:
            raise SpecError(("counter",), f"the counter lies in byte {checksum.byte}, where the checksum is")
        return Repair(checksum.type, checksum.byte, bytes.fromhex(checksum.prefix or ""), start, length)

    def words(self) -> str:
        """For people."""
        parts = [f"{self.checksum.type} in byte {self.checksum.byte}"] if self.checksum is not None else []
        if self.counter is not None:
            parts.append(f"counter in {BitsSpec(self.counter.start, self.counter.length).words()}")
        return f"{' and '.join(parts)} put right"
