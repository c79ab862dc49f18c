"""The records that hub and clients exchange: sizes, checks, packing. Pure functions; no socket, no clock.

Source: this project (docs/hub.md has the byte table). Every record starts with the same 16 bytes and its first byte
says how long it is, so a stream is cut into records without looking further. Integers are little-endian.
Leaves out: CAN XL; encryption and access control (the hub listens on loopback unless told otherwise).
"""

import struct
from typing import Final

from canopen_exo.bus.frame import FLAG_BRS, FLAG_ESI, FLAG_EXTENDED, FLAG_FD, FLAG_REMOTE, Frame
from canopen_exo.errors import CanopenExoError

DEFAULT_HOST: Final = "127.0.0.1"
DEFAULT_PORT: Final = 29536
MAGIC: Final = b"EXO-HUB\x00"
VERSION: Final = 1
MAX_NAME: Final = 32
"""Characters of a bus name."""

KIND_FRAME: Final = 1
KIND_FD_FRAME: Final = 2
KIND_SENT: Final = 3
KIND_OVERRUN: Final = 4
KIND_REJECTED: Final = 5
KIND_REFUSED: Final = 6
KIND_WELCOME: Final = 7
KIND_HELLO: Final = 8

FLAG_ERROR: Final = 32
"""An error frame: id and data as in linux/can/error.h. Beside the FLAG_ of frame.py."""
FLAG_OWN: Final = 64
"""Set by the hub only: the client's own frame, given back to it because it asked for its own frames."""

OPTION_OWN: Final = 1
"""Of a hello: give me my own frames too."""
OPTION_CONFIRM: Final = 2
"""Of a hello: tell me when my frames have left the transmit queue (timed hub)."""

LOST_RECEIVING: Final = 1
"""Of an overrun: frames for the client, which did not read."""
LOST_SENDING: Final = 2
"""Of an overrun: frames of the client, whose transmit queue was full."""

SHORT: Final = 24
LONG: Final = 80
TEXT: Final = 256
DATA_AT: Final = 16
"""Where the payload of a record starts."""

RECORD_SIZE: Final[list[int]] = [0, SHORT, LONG, SHORT, SHORT, TEXT, TEXT, LONG, LONG] + [0] * 247
"""Bytes of a record by its kind; 0: there is no such kind."""

FD_LENGTH: Final = (0, 1, 2, 3, 4, 5, 6, 7, 8, 12, 16, 20, 24, 32, 48, 64)
"""Payload bytes of a CAN FD frame by its DLC (ISO 11898-1)."""

STAMP: Final = struct.Struct("<q")
STAMP_AT: Final = 8

_HEAD: Final = struct.Struct("<BBBBIq")
SHORT_RECORD: Final = struct.Struct("<BBBBIq8s")
"""Kind, flags, DLC, size, id, stamp and payload of a record of `SHORT` bytes."""
_LONG: Final = struct.Struct("<BBBBIq64s")
_TEXT: Final = struct.Struct("<BBBBIq240s")
_WORDS: Final = struct.Struct("<II")
_HELLO: Final = struct.Struct("<8sHH48s")
_WELCOME: Final = struct.Struct("<8sHHIq")
_ZEROS: Final = bytes(64)


class HubRecordError(CanopenExoError):
    """Bytes that are no record of this protocol."""


def _highest_ids() -> dict[int, int]:
    """Highest CAN id allowed, by the first four bytes (kind, flags, DLC, size) of a valid frame record."""
    found: dict[int, int] = {}
    for wide in (0, FLAG_EXTENDED):
        top = 0x1FFFFFFF if wide else 0x7FF
        for dlc in range(16):
            found[_word(KIND_FRAME, wide, dlc, min(dlc, 8))] = top
            found[_word(KIND_FRAME, wide | FLAG_REMOTE, dlc, 0)] = top
            found[_word(KIND_FRAME, wide | FLAG_ERROR, dlc, min(dlc, 8))] = 0x1FFFFFFF
            for extra in (0, FLAG_BRS, FLAG_ESI, FLAG_BRS | FLAG_ESI):
                found[_word(KIND_FD_FRAME, wide | FLAG_FD | extra, dlc, FD_LENGTH[dlc])] = top
    return found


def _word(kind: int, flags: int, dlc: int, size: int) -> int:
    return kind | flags << 8 | dlc << 16 | size << 24


_HIGHEST_ID: Final = _highest_ids()
_OWN_BIT: Final = FLAG_OWN << 8


def frame_fault(buffer: bytes, at: int, from_hub: bool = False) -> str:
    """Why the complete frame record at `at` is none, or "" when it is one. from_hub: FLAG_OWN is allowed."""
    word, can_id = _WORDS.unpack_from(buffer, at)
    top = _HIGHEST_ID.get(word & ~_OWN_BIT if from_hub else word, -1)
    if can_id > top:
        return _explain(buffer, at, top)
    size = word >> 24
    end = LONG if word & 0xFF == KIND_FD_FRAME else SHORT
    if DATA_AT + size != end and buffer[at + DATA_AT + size : at + end] != _ZEROS[: end - DATA_AT - size]:
        return f"unused payload bytes after the first {size} are not zero"
    return ""


def _explain(buffer: bytes, at: int, top: int) -> str:
    kind, flags, dlc, size, can_id, _ = _HEAD.unpack_from(buffer, at)
    if kind not in (KIND_FRAME, KIND_FD_FRAME):
        return f"kind {kind} given, allowed is {KIND_FRAME} (frame) or {KIND_FD_FRAME} (CAN FD frame)"
    if top >= 0:
        return f"CAN id {can_id:#x} given, allowed 0..{top:#x} with flags {flags:#04x}"
    return f"flags {flags:#04x}, DLC {dlc} and {size} data bytes do not make a frame of kind {kind}"


def pack_record(can_id: int, flags: int, dlc: int, data: bytes, stamp: int = 0) -> bytes:
    """A frame record. The caller answers for the parts; what is not a frame is refused by the other end."""
    if flags & FLAG_FD:
        return _LONG.pack(KIND_FD_FRAME, flags, dlc, len(data), can_id, stamp, data)
    return SHORT_RECORD.pack(KIND_FRAME, flags, dlc, len(data), can_id, stamp, data)


def pack_frame(frame: Frame, stamp: int = 0) -> bytes:
    """A frame as a record."""
    return pack_record(frame.can_id, frame.flags, frame.dlc, frame.data, stamp)


def unpack_frame(buffer: bytes, at: int) -> Frame:
    """The frame of the record at `at`, checked before with `frame_fault`; not for error frames."""
    _, flags, dlc, size, can_id, _ = _HEAD.unpack_from(buffer, at)
    data = buffer[at + DATA_AT : at + DATA_AT + size]
    flags &= ~FLAG_OWN
    if dlc == size and flags == 0:
        return Frame(can_id, data)
    return Frame(can_id, data, flags, dlc)


def unpack_record(buffer: bytes, at: int) -> tuple[int, int, int, bytes, int]:
    """Id, flags, DLC, payload and stamp [ns, the hub's clock] of the record at `at`, whatever kind it is."""
    _, flags, dlc, size, can_id, stamp = _HEAD.unpack_from(buffer, at)
    return can_id, flags, dlc, buffer[at + DATA_AT : at + DATA_AT + size], stamp


def pack_count(kind: int, flags: int, count: int) -> bytes:
    """A sent or overrun record: how many frames."""
    return SHORT_RECORD.pack(kind, flags, 0, 0, min(count, 0xFFFFFFFF), 0, b"")


def pack_text(kind: int, text: str) -> bytes:
    """A rejected or refused record: why, in at most 240 bytes of UTF-8."""
    data = text.encode()[:240].decode(errors="ignore").encode()
    return _TEXT.pack(kind, 0, 0, len(data), 0, 0, data)


def unpack_text(buffer: bytes, at: int) -> str:
    """The text of the rejected or refused record at `at`."""
    return buffer[at + DATA_AT : at + DATA_AT + min(buffer[at + 3], 240)].decode(errors="replace")


def pack_hello(bus: str, options: int, version: int = VERSION) -> bytes:
    """What a client says first: the bus it wants, and its options. Raises HubRecordError for a name that is none."""
    fault = name_fault(bus)
    if fault:
        raise HubRecordError(fault)
    return _LONG.pack(KIND_HELLO, 0, 0, 60, 0, 0, _HELLO.pack(MAGIC, version, options, bus.encode()))


def unpack_hello(buffer: bytes) -> tuple[str, int]:
    """Bus and options of a hello of `LONG` bytes; raises HubRecordError, in words for the client."""
    if buffer[0] != KIND_HELLO or buffer[DATA_AT : DATA_AT + len(MAGIC)] != MAGIC:
        raise HubRecordError(f"no hello of an exo-hil hub client: starts with {buffer[:4].hex(' ')}")
    _, version, options, name = _HELLO.unpack_from(buffer, DATA_AT)
    if version != VERSION:
        raise HubRecordError(f"version {version} of the protocol given, this hub speaks {VERSION}; use one exo-hil")
    if options & ~(OPTION_OWN | OPTION_CONFIRM):
        raise HubRecordError(f"options {options:#06x} given, allowed are {OPTION_OWN | OPTION_CONFIRM:#06x}")
    bus = name.rstrip(b"\x00").decode(errors="replace")
    fault = name_fault(bus)
    if fault:
        raise HubRecordError(fault)
    return bus, options


def name_fault(bus: str) -> str:
    """Why `bus` is no bus name, or ""."""
    letters = bus.replace("_", "a").replace("-", "a").replace(".", "a")
    if len(bus) <= MAX_NAME and letters.isascii() and letters.isalnum():
        return ""
    return f"bus name {bus[:MAX_NAME]!r} given, allowed are 1..{MAX_NAME} of letters, digits, '_', '-', '.'"


class Welcome:
    """The hub's answer to a hello. bitrate: bit/s of a timed hub, 0: fast; monotonic_ns, realtime_ns: its clocks."""

    __slots__ = ("bitrate", "monotonic_ns", "realtime_ns")

    def __init__(self, bitrate: int, monotonic_ns: int, realtime_ns: int) -> None:
        self.bitrate: Final[int] = bitrate
        self.monotonic_ns: Final[int] = monotonic_ns
        self.realtime_ns: Final[int] = realtime_ns

    def pack(self) -> bytes:
        """As a record."""
        data = _WELCOME.pack(MAGIC, VERSION, 0, self.bitrate, self.realtime_ns)
        return _LONG.pack(KIND_WELCOME, 0, 0, len(data), 0, self.monotonic_ns, data)


def unpack_welcome(buffer: bytes) -> Welcome:
    """The welcome in the first `LONG` bytes; raises HubRecordError when they are something else."""
    if buffer[0] != KIND_WELCOME or buffer[DATA_AT : DATA_AT + len(MAGIC)] != MAGIC:
        raise HubRecordError(f"the other end is no exo-hil hub: it says {buffer[:16].hex(' ')}")
    _, version, _, bitrate, realtime_ns = _WELCOME.unpack_from(buffer, DATA_AT)
    if version != VERSION:
        raise HubRecordError(f"the hub speaks version {version} of the protocol, this client {VERSION}")
    (monotonic_ns,) = STAMP.unpack_from(buffer, STAMP_AT)
    return Welcome(bitrate, monotonic_ns, realtime_ns)


def split_address(text: str) -> tuple[str, int]:
    """`HOST:PORT`, `HOST`, `PORT`, `:PORT` or `[IPv6]:PORT` to host and port, with the defaults.

    A number alone is a port: as a host, 0 would be all interfaces of the machine. Raises CanopenExoError.
    """
    host, colon, port = text.rpartition(":")
    if text.endswith("]") or not (colon or text.isdigit()):
        host, port = text, ""
    if host.startswith("[") and host.endswith("]"):
        host = host[1:-1]
    if port and not (port.isascii() and port.isdigit() and int(port) < 65536):
        raise CanopenExoError(f"hub address {text!r}: port {port!r} given, allowed 0..65535 (0: a free one)")
    return host or DEFAULT_HOST, int(port) if port else DEFAULT_PORT


def split_channel(channel: str) -> tuple[str, int, str]:
    """`HOST:PORT/NAME`, or `NAME` on the default address, to host, port and bus name; raises CanopenExoError."""
    address, slash, bus = channel.rpartition("/")
    host, port = split_address(address) if slash else (DEFAULT_HOST, DEFAULT_PORT)
    fault = name_fault(bus)
    if fault:
        raise CanopenExoError(f"hub channel {channel!r}: {fault}; write NAME or HOST:PORT/NAME")
    return host, port, bus
