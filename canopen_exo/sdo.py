"""SDO: server and client, expedited and segmented, one transfer at a time.

Source: CiA 301, 7.2.4.3 (SDO protocols; 7.2.4.3.17 and table 22: abort codes).
Sans-IO: payloads in, payloads out; the owner puts them into frames 0x600 + id and 0x580 + id and minds `deadline`.
Leaves out: block transfer (refused with abort 05040001).

First byte (bits 7-5 command specifier; t toggle, n unused bytes, e expedited, s size given, c last segment):

    client -> server                              server -> client
    0  000 t nnn c  download segment              0  000 t nnn c  upload segment
    1  001 0 nn e s initiate download             1  001 t 0000   download segment taken
    2  010 00000    initiate upload               2  010 0 nn e s upload initiated
    3  011 t 0000   next upload segment           3  011 00000    download initiated
    4  100 00000    abort                         4  100 00000    abort
"""

import copy
import struct
from typing import Final, final

from canopen_exo.bus.node import MS, NEVER, SECOND
from canopen_exo.errors import CanopenExoError
from canopen_exo.od import ABORT_TOO_LONG, ABORT_TOO_SHORT, ObjectDictionary
from canopen_exo.plan import SDO_ANSWER, SDO_REQUEST

ABORT_TOGGLE: Final = 0x0503_0000
ABORT_TIMEOUT: Final = 0x0504_0000
ABORT_COMMAND: Final = 0x0504_0001
ABORT_MEMORY: Final = 0x0504_0005

SERVER_TIMEOUT: Final = SECOND
"""How long a server waits for the next segment [ns]; assumed: twice what clients usually wait."""
CLIENT_TIMEOUT: Final = 500 * MS
"""How long a client waits for an answer [ns]; a usual value of masters."""
LARGEST: Final = 65536
"""Bytes of the longest transfer that is taken; assumed."""

_IDLE: Final = 0
_DOWNLOAD: Final = 1
"""A segmented transfer from client to server runs."""
_UPLOAD: Final = 2
"""A segmented transfer from server to client runs."""

_MULTIPLEXER: Final = struct.Struct("<BHB4x")
_WITH_NUMBER: Final = struct.Struct("<BHBI")

ABORT_TEXTS: Final[dict[int, str]] = {
    0x0503_0000: "toggle bit not alternated",
    0x0504_0000: "SDO protocol timed out",
    0x0504_0001: "command specifier not valid or unknown",
    0x0504_0002: "invalid block size",
    0x0504_0003: "invalid sequence number",
    0x0504_0004: "CRC error",
    0x0504_0005: "out of memory",
    0x0601_0000: "unsupported access to an object",
    0x0601_0001: "attempt to read a write-only object",
    0x0601_0002: "attempt to write a read-only object",
    0x0602_0000: "object does not exist",
    0x0604_0041: "object cannot be mapped to the PDO",
    0x0604_0042: "mapped objects would exceed the PDO length",
    0x0604_0043: "general parameter incompatibility",
    0x0604_0047: "general internal incompatibility in the device",
    0x0606_0000: "access failed due to a hardware error",
    0x0607_0010: "data type does not match: length",
    0x0607_0012: "data type does not match: too long",
    0x0607_0013: "data type does not match: too short",
    0x0609_0011: "sub-index does not exist",
    0x0609_0030: "invalid value",
    0x0609_0031: "value too high",
    0x0609_0032: "value too low",
    0x0609_0036: "maximum is less than minimum",
    0x060A_0023: "resource not available",
    0x0800_0000: "general error",
    0x0800_0020: "data cannot be transferred or stored",
    0x0800_0021: "data cannot be transferred or stored: local control",
    0x0800_0022: "data cannot be transferred or stored: present device state",
    0x0800_0023: "no object dictionary, or it cannot be generated",
    0x0800_0024: "no data available",
}
"""CiA 301, table 22, in short words."""


def abort_text(code: int) -> str:
    """The abort code in words, for people."""
    return f"{code:08X} ({ABORT_TEXTS.get(code, 'not in CiA 301')})"


def _abort(index: int, sub: int, code: int) -> bytes:
    return _WITH_NUMBER.pack(0x80, index, sub, code)


@final
class SdoServer:
    """Gives clients access to one object dictionary.

    deadline: when the running segmented transfer times out [ns], NEVER without one. request_id, answer_id: COB-IDs.
    """

    def __init__(self, od: ObjectDictionary, node_id: int, timeout_ns: int = SERVER_TIMEOUT) -> None:
        self.request_id: Final[int] = SDO_REQUEST + node_id
        self.answer_id: Final[int] = SDO_ANSWER + node_id
        self.deadline: int = NEVER
        self._od: ObjectDictionary = od
        self._timeout_ns: int = timeout_ns
        self._mode: int = _IDLE
        self._index: int = 0
        self._sub: int = 0
        self._toggle: int = 0
        self._data: bytes = b""
        self._at: int = 0
        self._size: int = -1

    def request(self, now: int, data: bytes) -> bytes | None:
        """The answer to a request, 8 bytes; None after a client's abort only. Never raises, whatever the bytes."""
        if len(data) != 8:
            return self._refuse(ABORT_COMMAND, data)
        command = data[0] >> 5
        if command == 4:
            self.stop()
            return None
        if self._mode == _IDLE:
            if command == 1:
                return self._initiate_download(now, data)
            if command == 2:
                return self._initiate_upload(now, data)
        elif self._mode == _DOWNLOAD and command == 0:
            return self._download_segment(now, data)
        elif self._mode == _UPLOAD and command == 3:
            return self._upload_segment(now, data)
        return self._refuse(ABORT_COMMAND, data)

    def expire(self, now: int) -> bytes | None:
        """The abort to send when `deadline` is reached; None before."""
        if now < self.deadline:
            return None
        return self._refuse(ABORT_TIMEOUT, b"")

    def stop(self) -> None:
        """Give up a running transfer without a word: client's abort, NMT reset or stop."""
        self._mode = _IDLE
        self._data = b""
        self.deadline = NEVER

    def _refuse(self, code: int, data: bytes) -> bytes:
        """End with an abort. It names the running transfer's object, else the one in the request if one is there."""
        index, sub = 0, 0
        if self._mode != _IDLE:
            index, sub = self._index, self._sub
        elif len(data) >= 4 and data[0] >> 5 in (1, 2, 5, 6):  # segments carry no multiplexer
            index, sub = data[1] | data[2] << 8, data[3]
        self.stop()
        return _abort(index, sub, code)

    def _start(self, now: int, mode: int) -> None:
        self._mode = mode
        self._toggle = 0
        self._at = 0
        self.deadline = now + self._timeout_ns

    def _initiate_download(self, now: int, data: bytes) -> bytes:
        index, sub = data[1] | data[2] << 8, data[3]
        abort = self._od.check_access(index, sub, True)
        if abort:
            return _abort(index, sub, abort)
        fixed = self._od.entries[index << 8 | sub].size  # 0: any number of bytes
        if data[0] & 2:  # expedited; without a size the object tells it
            size = 4 - (data[0] >> 2 & 3) if data[0] & 1 else min(fixed or 4, 4)
            abort = self._od.write(index, sub, data[4 : 4 + size])
            return _abort(index, sub, abort) if abort else _MULTIPLEXER.pack(0x60, index, sub)
        self._size = int.from_bytes(data[4:8], "little") if data[0] & 1 else -1
        if self._size >= 0:
            abort = self._size_abort(fixed)
            if abort:
                return _abort(index, sub, abort)
        self._index, self._sub, self._data = index, sub, b""
        self._start(now, _DOWNLOAD)
        return _MULTIPLEXER.pack(0x60, index, sub)

    def _size_abort(self, fixed: int) -> int:
        """Abort code for the announced size of a segmented download, 0 when it is taken."""
        if fixed and self._size > fixed:
            return ABORT_TOO_LONG
        if self._size < fixed:
            return ABORT_TOO_SHORT
        return ABORT_MEMORY if self._size > LARGEST else 0

    def _download_segment(self, now: int, data: bytes) -> bytes:
        command = data[0]
        if command >> 4 & 1 != self._toggle:
            return self._refuse(ABORT_TOGGLE, data)
        self._data += data[1 : 8 - (command >> 1 & 7)]
        if self._size >= 0 and len(self._data) > self._size:
            return self._refuse(ABORT_TOO_LONG, data)
        if len(self._data) > LARGEST:
            return self._refuse(ABORT_MEMORY, data)
        if command & 1:
            if len(self._data) < self._size:
                return self._refuse(ABORT_TOO_SHORT, data)
            abort = self._od.write(self._index, self._sub, self._data)
            if abort:
                return self._refuse(abort, data)
            self.stop()
        else:
            self.deadline = now + self._timeout_ns
        answer = 0x20 | self._toggle << 4
        self._toggle ^= 1
        return bytes((answer, 0, 0, 0, 0, 0, 0, 0))

    def _initiate_upload(self, now: int, data: bytes) -> bytes:
        index, sub = data[1] | data[2] << 8, data[3]
        abort = self._od.check_access(index, sub, False)
        if abort:
            return _abort(index, sub, abort)
        value = self._od.read(index, sub)
        if 1 <= len(value) <= 4:
            command = 0x43 | (4 - len(value)) << 2
            return bytes((command, data[1], data[2], data[3])) + value.ljust(4, b"\0")
        self._index, self._sub, self._data = index, sub, value
        self._start(now, _UPLOAD)
        return _WITH_NUMBER.pack(0x41, index, sub, len(value))

    def _upload_segment(self, now: int, data: bytes) -> bytes:
        if data[0] >> 4 & 1 != self._toggle:
            return self._refuse(ABORT_TOGGLE, data)
        part = self._data[self._at : self._at + 7]
        self._at += len(part)
        command = self._toggle << 4 | (7 - len(part)) << 1
        self._toggle ^= 1
        if self._at >= len(self._data):
            command |= 1
            self.stop()
        else:
            self.deadline = now + self._timeout_ns
        return bytes((command,)) + part.ljust(7, b"\0")

    def __deepcopy__(self, memo: dict[int, object]) -> "SdoServer":
        twin = SdoServer(self._od, self.request_id - SDO_REQUEST, self._timeout_ns)
        memo[id(self)] = twin
        twin._od = copy.deepcopy(self._od, memo)
        twin.deadline, twin._mode = self.deadline, self._mode
        twin._index, twin._sub, twin._toggle = self._index, self._sub, self._toggle
        twin._data, twin._at, twin._size = self._data, self._at, self._size
        return twin


@final
class SdoClient:
    """One transfer after the other with the server of one node.

    `upload` or `download` gives the first request; every answer goes to `answer`, which gives the next request, until
    `done`. Then `abort` is 0 and `result` holds what was uploaded, or `abort` is the code of whoever gave up.
    deadline: when the answer is late [ns], NEVER when none is awaited; then call `expire`.
    """

    def __init__(self, node_id: int, timeout_ns: int = CLIENT_TIMEOUT) -> None:
        self.request_id: Final[int] = SDO_REQUEST + node_id
        self.answer_id: Final[int] = SDO_ANSWER + node_id
        self.done: bool = True
        self.result: bytes = b""
        self.abort: int = 0
        self.deadline: int = NEVER
        self._timeout_ns: int = timeout_ns
        self._mode: int = _IDLE
        self._index: int = 0
        self._sub: int = 0
        self._initiated: bool = False
        self._toggle: int = 0
        self._data: bytes = b""
        self._at: int = 0
        self._size: int = -1

    def upload(self, now: int, index: int, sub: int) -> bytes:
        """Start reading an object; the request to send. Raises CanopenExoError while another transfer runs."""
        self._start(now, _UPLOAD, index, sub, b"")
        return _MULTIPLEXER.pack(0x40, index, sub)

    def download(self, now: int, index: int, sub: int, data: bytes) -> bytes:
        """Start writing an object; the request to send. Raises CanopenExoError while another transfer runs."""
        self._start(now, _DOWNLOAD, index, sub, data)
        if 1 <= len(data) <= 4:
            command = 0x23 | (4 - len(data)) << 2
            self._at = len(data)
            return bytes((command, index & 0xFF, index >> 8, sub)) + data.ljust(4, b"\0")
        return _WITH_NUMBER.pack(0x21, index, sub, len(data))

    def answer(self, now: int, data: bytes) -> bytes | None:
        """Take an answer; the next request, or None when there is none to send. Never raises, whatever the bytes.

        Initiate answers about another object belong to an earlier transfer and are passed over.
        """
        if self._mode == _IDLE:
            return None
        if len(data) != 8:
            return self._give_up(ABORT_COMMAND)
        command = data[0] >> 5
        if command == 4:
            self._finish(int.from_bytes(data[4:8], "little") or 0x0800_0000)
            return None
        if not self._initiated:
            if data[1] | data[2] << 8 != self._index or data[3] != self._sub:
                return None
            if self._mode == _UPLOAD and command == 2:
                return self._upload_initiated(now, data)
            if self._mode == _DOWNLOAD and command == 3:
                return self._next_download(now)
        elif self._mode == _UPLOAD and command == 0:
            return self._upload_segment(now, data)
        elif self._mode == _DOWNLOAD and command == 1:
            if data[0] >> 4 & 1 != self._toggle:
                return self._give_up(ABORT_TOGGLE)
            self._toggle ^= 1
            return self._next_download(now)
        return self._give_up(ABORT_COMMAND)

    def expire(self, now: int) -> bytes | None:
        """The abort to send when `deadline` is reached; None before."""
        if now < self.deadline:
            return None
        return self._give_up(ABORT_TIMEOUT)

    def _start(self, now: int, mode: int, index: int, sub: int, data: bytes) -> None:
        if self._mode != _IDLE:
            raise CanopenExoError(
                f"SDO client of COB-ID {self.request_id:#x}: transfer of {index:04X}:{sub:02X} asked for while "
                f"{self._index:04X}:{self._sub:02X} runs; wait until `done`"
            )
        self.done, self.result, self.abort = False, b"", 0
        self.deadline = now + self._timeout_ns
        self._mode, self._index, self._sub = mode, index, sub
        self._initiated, self._toggle, self._data, self._at, self._size = False, 0, data, 0, -1

    def _finish(self, abort: int) -> None:
        self.done, self.abort = True, abort
        self.deadline = NEVER
        self._mode = _IDLE
        self._data = b""

    def _give_up(self, code: int) -> bytes:
        self._finish(code)
        return _abort(self._index, self._sub, code)

    def _upload_initiated(self, now: int, data: bytes) -> bytes | None:
        if data[0] & 2:
            self.result = data[4 : 8 - (data[0] >> 2 & 3)] if data[0] & 1 else data[4:8]
            self._finish(0)
            return None
        self._size = int.from_bytes(data[4:8], "little") if data[0] & 1 else -1
        if self._size > LARGEST:
            return self._give_up(ABORT_MEMORY)
        self._initiated = True
        self.deadline = now + self._timeout_ns
        return b"\x60\0\0\0\0\0\0\0"

    def _upload_segment(self, now: int, data: bytes) -> bytes | None:
        if data[0] >> 4 & 1 != self._toggle:
            return self._give_up(ABORT_TOGGLE)
        self._toggle ^= 1
        self._data += data[1 : 8 - (data[0] >> 1 & 7)]
        if self._size >= 0 and len(self._data) > self._size:
            return self._give_up(ABORT_TOO_LONG)
        if len(self._data) > LARGEST:
            return self._give_up(ABORT_MEMORY)
        if data[0] & 1:
            if len(self._data) < self._size:
                return self._give_up(ABORT_TOO_SHORT)
            self.result = self._data
            self._finish(0)
            return None
        self.deadline = now + self._timeout_ns
        return bytes((0x60 | self._toggle << 4, 0, 0, 0, 0, 0, 0, 0))

    def _next_download(self, now: int) -> bytes | None:
        """After the initiate answer or a segment's: the next segment; None when all was sent and taken."""
        if self._at >= len(self._data) and (self._initiated or self._data):
            self._finish(0)
            return None
        self._initiated = True
        part = self._data[self._at : self._at + 7]
        self._at += len(part)
        last = 1 if self._at >= len(self._data) else 0
        self.deadline = now + self._timeout_ns
        return bytes((self._toggle << 4 | (7 - len(part)) << 1 | last,)) + part.ljust(7, b"\0")

    def __deepcopy__(self, memo: dict[int, object]) -> "SdoClient":
        twin = SdoClient(self.request_id - SDO_REQUEST, self._timeout_ns)
        memo[id(self)] = twin
        twin.done, twin.result, twin.abort, twin.deadline = self.done, self.result, self.abort, self.deadline
        twin._mode, twin._index, twin._sub, twin._toggle = self._mode, self._index, self._sub, self._toggle
        twin._initiated, twin._data, twin._at, twin._size = self._initiated, self._data, self._at, self._size
        return twin
