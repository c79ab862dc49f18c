"""The CAN frame, as it is queued, carried and traced.

Source: ISO 11898-1. Classical frames are complete; the FD flags are carried but the emulated medium refuses them.
"""

from typing import Final, final

from canopen_exo.bus.bits import base_frame_bits, frame_bits
from canopen_exo.errors import CanopenExoError

FLAG_EXTENDED: Final = 1
FLAG_REMOTE: Final = 2
FLAG_FD: Final = 4
FLAG_BRS: Final = 8
FLAG_ESI: Final = 16
FLAG_ERROR: Final = 32
"""A notice in the form of an error frame (`error_frame`): in traces and records, never queued."""

_FD_SIZES: Final = (12, 16, 20, 24, 32, 48, 64)


_BASE_ARBITRATION: Final[list[int]] = [can_id << 21 for can_id in range(0x800)]
"""Of base data frames (ID, RTR 0, IDE 0), so that nothing is computed, and no integer made, per frame."""


@final
class Frame:
    """One CAN frame; never changed after it is made.

    can_id: 11-bit, or 29-bit with FLAG_EXTENDED; 0x20000000 | classes with FLAG_ERROR.
    data: 0..8 bytes (up to 64 with FLAG_FD), empty for a remote frame.
    flags: the FLAG_ constants. dlc: as on the wire; equals len(data) unless given (remote frames, raw DLC 9..15).
    arbitration: the bits that compete for the bus, as one integer; the lower one wins.
    bits: length on the wire, stuffing and 3-bit intermission included; 0 until `measure` has worked it out.
    """

    __slots__ = ("arbitration", "bits", "can_id", "data", "dlc", "flags")

    def __init__(self, can_id: int, data: bytes, flags: int = 0, dlc: int = -1) -> None:
        self.can_id: Final[int] = can_id
        self.data: Final[bytes] = data
        self.flags: Final[int] = flags
        wire_dlc = len(data)
        if flags == 0 and dlc < 0 and wire_dlc <= 8 and 0 <= can_id <= 0x7FF:  # the frames of nearly every cycle
            arbitration = _BASE_ARBITRATION[can_id]
        else:
            check_frame(can_id, data, flags, dlc)
            wire_dlc = dlc if dlc >= 0 else _wire_dlc(wire_dlc)
            remote = 1 if flags & FLAG_REMOTE else 0
            if flags & FLAG_EXTENDED:  # ID28-18, SRR 1, IDE 1, ID17-0, RTR
                arbitration = (can_id >> 18) << 21 | 3 << 19 | (can_id & 0x3FFFF) << 1 | remote
            else:  # ID, RTR, IDE 0
                arbitration = can_id << 21 | remote << 20
        self.dlc: Final[int] = wire_dlc
        self.arbitration: Final[int] = arbitration
        self.bits: int = 0

    def measure(self) -> int:
        """Work out `bits`; once is enough, both hops of a gateway use it."""
        flags = self.flags
        if flags or self.dlc > 8:
            bits = frame_bits(self.can_id, self.data, flags & FLAG_EXTENDED != 0, flags & FLAG_REMOTE != 0, self.dlc)
        else:
            bits = base_frame_bits(self.can_id, self.data)
        self.bits = bits
        return bits

    def with_data(self, data: bytes) -> "Frame":
        """The same frame with another payload of the same length."""
        return Frame(self.can_id, data, self.flags, self.dlc)

    def __eq__(self, other: object) -> bool:
        return (
            isinstance(other, Frame)
            and self.can_id == other.can_id
            and self.data == other.data
            and self.flags == other.flags
            and self.dlc == other.dlc
        )

    def __hash__(self) -> int:
        return hash((self.can_id, self.data, self.flags, self.dlc))

    def __deepcopy__(self, memo: dict[int, object]) -> "Frame":
        """Itself: it never changes."""
        return self

    def __reduce__(self) -> tuple[type["Frame"], tuple[int, bytes, int, int]]:
        return Frame, (self.can_id, self.data, self.flags, self.dlc)

    def __repr__(self) -> str:
        width = 8 if self.flags & (FLAG_EXTENDED | FLAG_ERROR) else 3
        return f"{self.can_id:0{width}X}#{'R' if self.flags & FLAG_REMOTE else self.data.hex().upper()}"


def _wire_dlc(size: int) -> int:
    return size if size <= 8 else 9 + _FD_SIZES.index(size)


def check_frame(can_id: int, data: bytes, flags: int, dlc: int) -> None:
    """Raise CanopenExoError when the parts do not make a CAN frame."""
    top = 0x1FFFFFFF if flags & FLAG_EXTENDED else 0x7FF
    if flags & FLAG_ERROR:
        if flags != FLAG_ERROR or len(data) != 8 or not 0x20000000 <= can_id <= 0x3FFFFFFF:
            raise CanopenExoError(
                f"frame: error frame {can_id:#x} with {len(data)} data bytes and flags {flags:#x} given, "
                "allowed 0x20000000 | classes with 8 data bytes and no other flag"
            )
        return
    if not 0 <= can_id <= top:
        raise CanopenExoError(f"frame: CAN id {can_id:#x} given, allowed 0..{top:#x}; use FLAG_EXTENDED for 29-bit ids")
    if flags & FLAG_FD:
        if len(data) > 8 and len(data) not in _FD_SIZES:
            raise CanopenExoError(f"frame: {len(data)} data bytes given, a CAN FD frame has 0..8 or one of {_FD_SIZES}")
        return
    if len(data) > 8:
        raise CanopenExoError(f"frame: {len(data)} data bytes given, a classical frame has 0..8; FLAG_FD allows 64")
    if flags & FLAG_REMOTE and data:
        raise CanopenExoError("frame: a remote frame carries no data; give its length as dlc")
    if dlc > 15 or (dlc >= 0 and not flags & FLAG_REMOTE and min(dlc, 8) != len(data)):
        raise CanopenExoError(f"frame: dlc {dlc} given with {len(data)} data bytes; allowed {len(data)} (9..15 with 8)")
