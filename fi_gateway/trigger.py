"""Triggers: what starts an injector besides its event, and what an injector says on the bus.

Every injector has three signals. activated: rises when its window opens, holds while it is open; manifested: rises with
the first frame of the window that really comes out different, late, twice or not at all, holds until the window ends;
ended: rises when the window ends, holds until the next one opens.
A rising trigger starts its injector once per rise, a level trigger whenever it is armed and the condition holds, as the
trigger input of a FIBlock does (Fabarisov et al., ESREL 2020).
Over the bus: a frame with a given COB-ID and payload is a trigger too, and a signal can be reported by a frame, so that
gateways, or a gateway and a device, make one chain.
"""

from typing import Final, final

from canopen_exo.bus.frame import Frame
from canopen_exo.bus.node import NEVER
from fi_gateway.errors import FaultError

ACTIVATED: Final = "activated"
MANIFESTED: Final = "manifested"
ENDED: Final = "ended"
SIGNALS: Final = (ACTIVATED, MANIFESTED, ENDED)


@final
class BusFrame:
    """A pattern of frames: classical 11-bit data frames of one COB-ID with as many bytes as `data`.

    mask: bits that must be as in `data`, as many bytes; travelling to_drives: seen on the controller side.
    """

    def __init__(self, cob_id: int, data: bytes, mask: bytes, to_controller: bool, to_drives: bool) -> None:
        if not 0 <= cob_id <= 0x7FF:
            raise FaultError(f"trigger: frame with COB-ID {cob_id:#x} given, allowed 0x0..0x7ff")
        if len(data) > 8 or len(mask) != len(data):
            raise FaultError(
                f"trigger: frame with {len(data)} bytes and a mask of {len(mask)} given, allowed 0..8 of each, as many"
            )
        if not (to_controller or to_drives):
            raise FaultError("trigger: frame without direction given, allowed: to_controller, to_drives or both")
        self.cob_id: Final[int] = cob_id
        self.data: Final[bytes] = data
        self.mask: Final[bytes] = mask
        self.to_controller: Final[bool] = to_controller
        self.to_drives: Final[bool] = to_drives
        self._mask: Final[int] = int.from_bytes(mask, "little")
        self._value: Final[int] = int.from_bytes(data, "little") & int.from_bytes(mask, "little")

    def matches(self, frame: Frame) -> bool:
        """Whether the frame, whose COB-ID is the right one, has the payload."""
        return len(frame.data) == len(self.data) and int.from_bytes(frame.data, "little") & self._mask == self._value

    def __deepcopy__(self, memo: dict[int, object]) -> "BusFrame":
        return self  # it never changes: copies share it

    def __reduce__(self) -> tuple[type["BusFrame"], tuple[int, bytes, bytes, bool, bool]]:
        return BusFrame, (self.cob_id, self.data, self.mask, self.to_controller, self.to_drives)


@final
class Trigger:
    """Starts the injector when one of `any_of`, or the last of `all_of`, shows the signal `on`, or with a bus frame.

    level: while the condition holds, not only when it comes true. delay_ns: that much later; a level must have held for
    so long. probability: 0..1, drawn for each time the condition comes true.
    """

    def __init__(
        self,
        any_of: tuple[str, ...] = (),
        on: str = ACTIVATED,
        all_of: tuple[str, ...] = (),
        level: bool = False,
        delay_ns: int = 0,
        probability: float = 1.0,
        frame: BusFrame | None = None,
    ) -> None:
        if on not in SIGNALS:
            raise FaultError(f"trigger: on {on!r} given, allowed: {', '.join(SIGNALS)}")
        if (len(any_of) > 0) + (len(all_of) > 0) + (frame is not None) != 1:
            raise FaultError(
                f"trigger: {len(any_of)} injectors in any, {len(all_of)} in all and {0 if frame is None else 1} frames "
                "given, allowed are one or more of one kind"
            )
        if frame is not None and level:
            raise FaultError("trigger: a frame with edge: level given; a frame has no level, allowed is rising")
        if not 0 <= delay_ns < NEVER:
            raise FaultError(f"trigger: delay {delay_ns} ns given, allowed 0..{NEVER - 1} ns")
        if not 0.0 <= probability <= 1.0:
            raise FaultError(f"trigger: probability {probability} given, allowed 0..1")
        self.any_of: Final[tuple[str, ...]] = any_of
        self.on: Final[str] = on
        self.all_of: Final[tuple[str, ...]] = all_of
        self.level: Final[bool] = level
        self.delay_ns: Final[int] = delay_ns
        self.probability: Final[float] = probability
        self.frame: Final[BusFrame | None] = frame

    @property
    def sources(self) -> tuple[str, ...]:
        """The injectors that it listens to."""
        return self.any_of + self.all_of

    def __deepcopy__(self, memo: dict[int, object]) -> "Trigger":
        return self  # it never changes: copies share it

    def __reduce__(
        self,
    ) -> tuple[type["Trigger"], tuple[tuple[str, ...], str, tuple[str, ...], bool, int, float, BusFrame | None]]:
        given = (self.any_of, self.on, self.all_of, self.level, self.delay_ns, self.probability, self.frame)
        return Trigger, given


@final
class Report:
    """Says a signal of its injector on the bus: `frame` goes out each time it rises, behind all faults."""

    def __init__(self, frame: Frame, on: str, to_controller: bool, to_drives: bool) -> None:
        if on not in SIGNALS:
            raise FaultError(f"report: on {on!r} given, allowed: {', '.join(SIGNALS)}")
        if not (to_controller or to_drives):
            raise FaultError("report: no direction given, allowed: to_controller, to_drives or both")
        self.frame: Final[Frame] = frame
        self.on: Final[str] = on
        self.to_controller: Final[bool] = to_controller
        self.to_drives: Final[bool] = to_drives

    def __deepcopy__(self, memo: dict[int, object]) -> "Report":
        return self  # it never changes: copies share it

    def __reduce__(self) -> tuple[type["Report"], tuple[Frame, str, bool, bool]]:
        return Report, (self.frame, self.on, self.to_controller, self.to_drives)
