"""The trace of a run: its hash, and its log file in the format of `candump -L`.

A trace is the list of Transmission rows in loop order, kept by the loop itself; nothing here runs per frame.
Source of the log format: can-utils, the compact notation of `candump -L`, which `canplayer`, `log2asc` and python-can
read: `(seconds.microseconds) channel ID#DATA`, extended ids with 8 digits, `ID#R<dlc>` for a remote frame,
`ID##<flags><data>` for CAN FD (flags: 1 bit rate switch, 2 error state indicator), error frames with their 8-digit id
0x20000000 | classes, as the socket gives them.
Leaves out: the raw DLC 9..15 of a classical frame (readers of the format reject it); the hash has it.
"""

import hashlib
import struct
from collections.abc import Iterable
from pathlib import Path
from typing import Final

from canopen_exo.bus.frame import FLAG_BRS, FLAG_ERROR, FLAG_ESI, FLAG_EXTENDED, FLAG_FD, FLAG_REMOTE, Frame
from canopen_exo.bus.medium import Transmission
from canopen_exo.errors import CanopenExoError

_ROW: Final = struct.Struct("<qBIBBB")
"""Time [ns] i64, bus u8, CAN id u32, flags u8, DLC on the wire u8, payload bytes u8; the payload follows."""


class TraceHash:
    """SHA-256 over time, bus, id, flags, DLC, length and data of every row, in the order given.

    Each row says how long it is, so two different traces never give the same bytes. The sender is not in it: a row is
    what anyone on the bus could have seen.
    """

    def __init__(self) -> None:
        self._digest = hashlib.sha256()

    def update(self, rows: Iterable[Transmission]) -> None:
        """Further rows."""
        pack, parts = _ROW.pack, []
        for row in rows:
            frame = row.frame
            data = frame.data
            parts.append(pack(row.end_ns, row.bus, frame.can_id, frame.flags, frame.dlc, len(data)))
            parts.append(data)
        self._digest.update(b"".join(parts))

    def copy(self) -> "TraceHash":
        """One that has seen the same rows, and goes its own way."""
        twin = TraceHash()
        twin._digest = self._digest.copy()
        return twin

    def hexdigest(self) -> str:
        """Of the rows so far."""
        return self._digest.hexdigest()


def trace_hash(rows: Iterable[Transmission]) -> str:
    """The TraceHash (hex) of a whole trace."""
    digest = TraceHash()
    digest.update(rows)
    return digest.hexdigest()


def candump_frame(frame: Frame) -> str:
    """One frame in the compact notation: `185#0011223344556677`."""
    flags = frame.flags
    can_id = f"{frame.can_id:08X}" if flags & (FLAG_EXTENDED | FLAG_ERROR) else f"{frame.can_id:03X}"
    if flags & FLAG_FD:
        fd_flags = (1 if flags & FLAG_BRS else 0) | (2 if flags & FLAG_ESI else 0)
        return f"{can_id}##{fd_flags}{frame.data.hex().upper()}"
    if flags & FLAG_REMOTE:
        length = min(frame.dlc, 8)
        return f"{can_id}#R{length}" if length else f"{can_id}#R"
    return f"{can_id}#{frame.data.hex().upper()}"


def write_candump(path: Path, rows: Iterable[Transmission], bus_index: int, channel_name: str) -> None:
    """Write the rows of one bus to `path`. Time 0 of the file is the start of the simulation (power-up).

    channel_name: what stands in the interface column; `canplayer can0=<channel_name>` replays it on can0.
    Raises CanopenExoError for a name the format cannot hold, OSError when the file cannot be written.
    """
    if not channel_name or any(letter.isspace() for letter in channel_name):
        raise CanopenExoError(
            f"candump log {path}: channel name {channel_name!r} given; allowed is a name without white space"
        )
    with path.open("w", encoding="ascii", newline="\n") as file:
        for row in rows:
            if row.bus == bus_index:
                micros = row.end_ns // 1000  # complete microseconds, as a kernel stamps them
                stamp = f"({micros // 1_000_000:010d}.{micros % 1_000_000:06d})"
                file.write(f"{stamp} {channel_name} {candump_frame(row.frame)}\n")
