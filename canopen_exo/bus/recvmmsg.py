"""Many records with one system call: recvmmsg(2) and sendmmsg(2), which Python's socket module does not have.

Source: recvmmsg(2), sendmmsg(2), recvmsg(2), cmsg(3); socket(7) for SO_TIMESTAMPNS and SO_RXQ_OVFL. ctypes lays the
structures out for the machine at hand. Where the C library or the kernel has no recvmmsg, recvmsg gives the same, one
record a call; without sendmmsg nothing goes out from here, and the caller sends as it can.
Leaves out: the senders' addresses, and what a datagram has beyond the 72 bytes of the longest CAN record.
"""

import ctypes
import errno
import os
import socket
import struct
import sys
from collections.abc import Callable
from functools import partial
from typing import Final, final

SLOTS: Final = 64
"""Records read at a time: the cost of a call is shared by them, and a flood does not keep a loop from its wake-ups."""

RECORD_SIZE: Final = 72
"""linux/can.h: struct canfd_frame, the longest record."""

SO_TIMESTAMPNS: Final = 35  # asm-generic/socket.h, as on all but alpha, mips, parisc and sparc
SO_RXQ_OVFL: Final = 40

_PLAIN_SIZE: Final = 16
"""linux/can.h: struct can_frame."""

_LENGTH_AT: Final = 4
"""linux/can.h: of the data length in both."""

_CONTROL_SIZE: Final = 64
"""Bytes for control messages: a stamp (16 + 16) and a drop count (16 + 8), which comes only after a drop."""

_CONTROL_HEAD: Final = struct.Struct("@Nii")  # struct cmsghdr: length with this head, level, type
_ALIGNED: Final = struct.calcsize("N")
_TIME: Final = struct.Struct("@ll")  # timespec
_COUNT: Final = struct.Struct("@I")
_STAMP_SIZE: Final = _CONTROL_HEAD.size + _TIME.size
_PLACE_SIZE: Final = RECORD_SIZE + _CONTROL_SIZE
"""Where one message is read to: its record, its control messages behind it."""

_FIRST: Final = struct.Struct(f"@IB{RECORD_SIZE - _LENGTH_AT - 1}x{_CONTROL_HEAD.size}xll").unpack_from
_WORDS: Final = _PLACE_SIZE // struct.calcsize("I")
_LONGS: Final = _PLACE_SIZE // struct.calcsize("l")
_SECONDS_AT: Final = (RECORD_SIZE + _CONTROL_HEAD.size) // struct.calcsize("l")
_SECOND: Final = 1_000_000_000

_MISSING: Final = (errno.ENOSYS, errno.EPERM)
"""A kernel without the call, or a sandbox that refuses it."""

_NOW: Final = getattr(socket, "MSG_DONTWAIT", 0)  # Windows has none, nor these calls

Stamped = tuple[int, bytes]
"""The kernel's stamp [ns] on CLOCK_REALTIME, -1 without one; the record."""


class _Vector(ctypes.Structure):
    """struct iovec."""

    _fields_ = (("base", ctypes.c_void_p), ("size", ctypes.c_size_t))


class _Message(ctypes.Structure):
    """struct msghdr."""

    _fields_ = (
        ("name", ctypes.c_void_p),
        ("name_size", ctypes.c_uint),
        ("vectors", ctypes.c_void_p),
        ("vector_count", ctypes.c_size_t),
        ("control", ctypes.c_void_p),
        ("control_size", ctypes.c_size_t),
        ("flags", ctypes.c_int),
    )


class _Slot(ctypes.Structure):
    """struct mmsghdr."""

    _fields_ = (("message", _Message), ("size", ctypes.c_uint))


_SLOT_SIZE: Final = ctypes.sizeof(_Slot)


@final
class Receiver:
    """Reads from sockets that stamp what comes (SO_TIMESTAMPNS) and count what they drop (SO_RXQ_OVFL).

    count: records of the last `read`. is_plain: all of them are classical (16 bytes), stamped, and told of no drop;
    `record`, `ids`, `seconds` and `nanos` have them then, `stamped` in any case. views: of each plain record; outgoing:
    the same for sendmmsg. drops: the running total last told, -1 for none.
    is_untold: with a record that was not plain there was more to tell, of drops, than there was room for.
    """

    def __init__(self) -> None:
        self.count: int = 0
        self.is_plain: bool = False
        self.drops: int = -1
        self.is_untold: bool = False
        self._socket: socket.socket | None = None
        self._read_many: Callable[[], int] | None = None
        self._found: list[Stamped] = []  # of records that are not plain
        self._error: OSError | None = None
        self._places: Final[bytearray] = bytearray(SLOTS * _PLACE_SIZE)
        self._words: Final = memoryview(self._places).cast("I")
        self._longs: Final = memoryview(self._places).cast("l")
        self.views: Final = [
            memoryview(self._places)[at : at + _PLAIN_SIZE] for at in range(0, SLOTS * _PLACE_SIZE, _PLACE_SIZE)
        ]
        self._slots: Final = (_Slot * SLOTS)()
        self._vectors: Final = (_Vector * SLOTS)()
        self._outgoing: Final = (_Slot * SLOTS)()
        self._cut: Final = (_Vector * SLOTS)()
        self._slots_at: Final = ctypes.c_void_p(ctypes.addressof(self._slots))
        heads = memoryview(self._slots).cast("B")
        fresh = self._lay_out()
        self.outgoing: Final = self._lay_out_again()
        # by the number of records: the heads; as they have to be before a call, and as plain records leave them, from
        # a bus and (MSG_DONTROUTE) from a socket of this machine
        self._heads: Final = [heads[: number * _SLOT_SIZE] for number in range(SLOTS + 1)]
        self._fresh: Final = _beginnings(fresh)
        self._plain: Final = _beginnings(_as_plain(fresh, 0))
        self._plain_local: Final = _beginnings(_as_plain(fresh, socket.MSG_DONTROUTE))

    def attach(self, can: socket.socket) -> None:
        """Read from this socket from now on; no drop of it has been told yet."""
        self.drops = -1
        self._socket = can
        self._error = None
        call = find_call("recvmmsg", True)
        # all arguments made beforehand: converting them costs as much as the call
        many = None if call is None else partial(call, can.fileno(), self._slots_at, SLOTS, _NOW, None)
        self._read_many = many

    def read(self) -> int:
        """Take up to `SLOTS` records without waiting; how many. Raises OSError, BlockingIOError when there is none."""
        many = self._read_many
        if many is None:
            return self._read_singly()
        count = many()
        if count < 0:
            return self._fail()
        self.count = count
        heads = self._heads[count].tobytes()
        if heads == self._plain[count] or heads == self._plain_local[count]:
            self.is_plain = True  # and room is left for a stamp only: a drop count shows as truncated (MSG_CTRUNC)
        else:
            self.is_plain = False
            self._heads[count][:] = self._fresh[count]
            self._take_apart(heads)
        return count

    def first(self) -> tuple[int, int, int, int]:
        """Of the first of plain records: id, data length, and its stamp, seconds and nanoseconds of CLOCK_REALTIME."""
        return _FIRST(self._places)

    def ids(self) -> list[int]:
        """The first word of every plain record: id and flags."""
        return self._words[: self.count * _WORDS : _WORDS].tolist()

    def longest(self) -> int:
        """The largest data length that a plain record claims to have."""
        return max(self._places[_LENGTH_AT : self.count * _PLACE_SIZE : _PLACE_SIZE])

    def record(self, number: int) -> bytes:
        """One of the plain records."""
        return self.views[number].tobytes()

    def seconds(self) -> list[int]:
        """Of the stamps of the plain records, on CLOCK_REALTIME."""
        return self._longs[_SECONDS_AT : self.count * _LONGS : _LONGS].tolist()

    def nanos(self) -> list[int]:
        """The rest of these stamps."""
        return self._longs[_SECONDS_AT + 1 : self.count * _LONGS : _LONGS].tolist()

    def stamped(self) -> list[Stamped]:
        """All records of the last `read`, of whatever size."""
        if not self.is_plain:
            return self._found
        found = []
        for number, (seconds, nanos) in enumerate(zip(self.seconds(), self.nanos(), strict=True)):
            found.append((seconds * _SECOND + nanos, self.record(number)))
        return found

    def _lay_out(self) -> bytes:
        """Point every slot at its place; the heads as they have to be before a call."""
        places = (ctypes.c_char * len(self._places)).from_buffer(self._places)
        for number in range(SLOTS):
            vector = self._vectors[number]
            vector.base = ctypes.addressof(places) + number * _PLACE_SIZE
            vector.size = RECORD_SIZE
            message = self._slots[number].message
            message.vectors = ctypes.addressof(vector)
            message.vector_count = 1
            message.control = vector.base + RECORD_SIZE
            message.control_size = _CONTROL_SIZE
        return bytes(self._slots)

    def _lay_out_again(self) -> list[ctypes.c_void_p]:
        """The same places for sending: 16 bytes of each, no control messages."""
        for number in range(SLOTS):
            self._cut[number].base = self._vectors[number].base
            self._cut[number].size = _PLAIN_SIZE
            message = self._outgoing[number].message
            message.vectors = ctypes.addressof(self._cut[number])
            message.vector_count = 1
        return [ctypes.c_void_p(ctypes.addressof(slot)) for slot in self._outgoing]

    def _take_apart(self, heads: bytes) -> None:
        """Records of any size, with any control messages."""
        self._found = []
        self.is_untold = False
        for number in range(self.count):
            slot = _Slot.from_buffer_copy(heads, number * _SLOT_SIZE)
            if slot.message.flags & socket.MSG_CTRUNC:
                self.is_untold = True
            at = number * _PLACE_SIZE
            controls_at = at + RECORD_SIZE
            size = min(slot.message.control_size, _CONTROL_SIZE)
            stamp = self._controls_in(self._places[controls_at : controls_at + size])
            self._found.append((stamp, bytes(self._places[at : at + slot.size])))

    def _controls_in(self, controls: bytes | bytearray) -> int:
        """Note the drops told in these control messages (cmsg(3)); the stamp."""
        stamp = -1
        at = 0
        while at + _CONTROL_HEAD.size < len(controls):
            size, level, kind = _CONTROL_HEAD.unpack_from(controls, at)
            if level == socket.SOL_SOCKET:
                stamp = self._note(kind, controls[at + _CONTROL_HEAD.size : at + size], stamp)
            at += max(size + -size % _ALIGNED, _CONTROL_HEAD.size)
        return stamp

    def _note(self, kind: int, content: bytes | bytearray, stamp: int) -> int:
        if kind == SO_TIMESTAMPNS and len(content) >= _TIME.size:
            seconds, nanos = _TIME.unpack_from(content)
            return int(seconds) * _SECOND + int(nanos)
        if kind == SO_RXQ_OVFL and len(content) >= _COUNT.size:
            self.drops = _COUNT.unpack_from(content)[0]
        return stamp

    def _fail(self) -> int:
        """What the call says when it gives nothing."""
        self.count = 0
        code = ctypes.get_errno()
        if code in _MISSING:
            self._read_many = None
            return self._read_singly()
        raise OSError(code, os.strerror(code))

    def _read_singly(self) -> int:
        can = self._socket
        self._found = []
        self.count = 0
        self.is_plain = False
        if self._error is not None:
            error, self._error = self._error, None
            raise error
        try:
            while can is not None and len(self._found) < SLOTS:
                record, controls, _, _ = can.recvmsg(RECORD_SIZE, _CONTROL_SIZE, socket.MSG_DONTWAIT)
                stamp = -1
                for level, kind, content in controls:
                    if level == socket.SOL_SOCKET:
                        stamp = self._note(kind, content, stamp)
                self._found.append((stamp, record))
        except OSError as error:
            if not self._found:
                raise
            if not isinstance(error, BlockingIOError):
                self._error = error  # what was read comes first
        self.count = len(self._found)
        return self.count


@final
class Sender:
    """Sends plain records out of the buffers of a Receiver."""

    def __init__(self) -> None:
        self._send_many: Callable[..., int] | None = None

    def attach(self, can: socket.socket) -> None:
        """Send on this socket from now on. One of a class of its own may have its own way of sending, so none there."""
        call = find_call("sendmmsg", False) if type(can) is socket.socket else None
        self._send_many = None if call is None else partial(call, can.fileno())

    def send(self, source: Receiver, start: int, end: int) -> int:
        """Those of the plain records last read, without waiting; how many went. What stopped the next is not told."""
        many = self._send_many
        if many is None:
            return 0
        count = many(source.outgoing[start], end - start, _NOW)
        return count if count > 0 else 0


def _as_plain(fresh: bytes, flags: int) -> bytes:
    """The heads after a call that filled every slot with a plain record. flags: as the kernel sets them."""
    slots = (_Slot * SLOTS).from_buffer_copy(fresh)
    for slot in slots:
        slot.message.control_size = _STAMP_SIZE
        slot.message.flags = flags
        slot.size = _PLAIN_SIZE
    return bytes(slots)


def _beginnings(heads: bytes) -> list[bytes]:
    """The first heads, for every number of them."""
    return [heads[: number * _SLOT_SIZE] for number in range(SLOTS + 1)]


def find_call(name: str, tells_why: bool) -> Callable[..., int] | None:
    """A function of the C library, None where it is not; it is not to wait, so it keeps the interpreter's lock.

    tells_why: it leaves its error for `ctypes.get_errno`.
    """
    if sys.platform != "linux":
        return None
    return getattr(ctypes.PyDLL(None, use_errno=tells_why), name, None)
