"""Linux SocketCAN, straight on the socket: CAN_RAW, classical and FD frames, kernel time stamps, error frames on.

Source: the kernel's Documentation/networking/can.rst; linux/can.h, linux/can/raw.h; socket(7). Records are the kernel's
structures: can_frame (16 bytes) and canfd_frame (72 bytes), in the machine's byte order.
All that waits, at most 64 frames, is read with one system call (`recvmmsg`); select is the loop's. Base data frames can
go from interface to interface as the records that came, without a Frame made of them, and with one system call for many
in a row; any other frame sent costs one more.
An interface that goes down is reported, what is sent meanwhile is lost and counted, and the socket lives on by itself;
one that disappears is opened again with a back-off of 20 ms to 1 s.
The kernel begins to stamp a moment after the first socket of the machine asked for it; until then it stamps what is
read, so that the first frames of a machine may count as having come with the reading, never later than that.
Leaves out: setting the bit rate and bringing interfaces up (`ip link`), filters in the kernel, hardware time stamps.
"""

import contextlib
import errno
import socket
import struct
import time
from collections.abc import Callable
from typing import Final, final

from canopen_exo.bus.channel import Arrival, RecordChannel, StampClock
from canopen_exo.bus.error_frame import ERROR_FLAG, read_error_frame
from canopen_exo.bus.frame import FLAG_BRS, FLAG_ESI, FLAG_EXTENDED, FLAG_FD, FLAG_REMOTE, Frame
from canopen_exo.bus.node import MS, NEVER, SECOND, ErrorState, PortState
from canopen_exo.bus.recvmmsg import SO_RXQ_OVFL, SO_TIMESTAMPNS, Receiver, Sender
from canopen_exo.errors import CanopenExoError

CLASSICAL_SIZE: Final = 16
FD_SIZE: Final = 72

_EXTENDED: Final = 0x80000000  # CAN_EFF_FLAG
_REMOTE: Final = 0x40000000  # CAN_RTR_FLAG
_FD_BRS: Final = 1  # CANFD_BRS
_FD_ESI: Final = 2  # CANFD_ESI
_FD_FDF: Final = 4  # CANFD_FDF
_FD_LENGTHS: Final = (0, 1, 2, 3, 4, 5, 6, 7, 8, 12, 16, 20, 24, 32, 48, 64)

_HEAD: Final = struct.Struct("=IBBBB")  # id and flags, length, FD flags, reserved, len8_dlc
_HEAD_SIZE: Final = 8
_CLASSICAL: Final = struct.Struct("=IBBBB8s")
_FLEXIBLE: Final = struct.Struct("=IBBBB64s")

# Not all of these are in Python's socket module; the values are those of asm-generic/socket.h (all but alpha, mips,
# parisc and sparc), linux/sock_diag.h and linux/can/raw.h.
_SO_RCVBUFFORCE: Final = 33
_SO_MEMINFO: Final = 55
_MEMINFO: Final = struct.Struct("@9I")
_MEMINFO_DROPS: Final = 8
_SOL_CAN_RAW: Final = 101
_CAN_RAW_ERR_FILTER: Final = 2
_CAN_RAW_FD_FRAMES: Final = 5
_CAN_ERR_MASK: Final = 0x1FFFFFFF

_RECEIVE_BUFFER: Final = 8 << 20
"""Bytes asked for; the kernel counts about 0.8 kB a frame: a second of a full bus, where it grants all of it."""

_SEND_BUFFER: Final = 1
"""Asks for the kernel's minimum (4.6 kB, some six frames on their way): a full bus then shows as "not writable" before
the interface's own queue is full (txqueuelen, 10 by default), for which select cannot wait."""

_MANY: Final = 4
"""From so many records on one call for all of them costs less than a call for each."""

_AGAIN_NS: Final = MS // 4
"""When an interface's queue was full (ENOBUFS): two frame times at 1 Mbit/s."""

_FIRST_BACK_OFF_NS: Final = 20 * MS
_LAST_BACK_OFF_NS: Final = SECOND

_GONE: Final = (errno.ENODEV, errno.ENXIO, errno.EBADF, errno.ENOTCONN)


def encode(frame: Frame) -> bytes:
    """The kernel's record of a frame: 16 bytes, or 72 for CAN FD."""
    flags = frame.flags
    data = frame.data
    dlc = frame.dlc
    if flags == 0:
        return _CLASSICAL.pack(frame.can_id, len(data), 0, 0, dlc if dlc > 8 else 0, data)
    can_id = frame.can_id
    if flags & FLAG_EXTENDED:
        can_id |= _EXTENDED
    if flags & FLAG_FD:
        fd_flags = _FD_FDF | (_FD_BRS if flags & FLAG_BRS else 0) | (_FD_ESI if flags & FLAG_ESI else 0)
        return _FLEXIBLE.pack(can_id, len(data), fd_flags, 0, 0, data)
    if flags & FLAG_REMOTE:
        can_id |= _REMOTE
    return _CLASSICAL.pack(can_id, dlc if dlc <= 8 else 8, 0, 0, dlc if dlc > 8 else 0, data)


def decode(record: bytes) -> Frame | None:
    """The frame in a kernel's record; None for bytes that are none, and for error frames (see `read_error_frame`)."""
    size = len(record)
    if size != CLASSICAL_SIZE and size != FD_SIZE:
        return None
    can_id, length, fd_flags, _, raw = _HEAD.unpack_from(record)
    if size == CLASSICAL_SIZE and can_id <= 0x7FF and length <= 8 and raw <= 8:  # the frames of nearly every cycle
        return Frame(can_id, record[_HEAD_SIZE : _HEAD_SIZE + length])
    if can_id & ERROR_FLAG:
        return None
    flags = 0
    if can_id & _EXTENDED:
        flags = FLAG_EXTENDED
    number = can_id & (0x1FFFFFFF if flags else 0x7FF)
    if size == FD_SIZE:
        if length > 64:
            return None
        flags |= FLAG_FD | (FLAG_BRS if fd_flags & _FD_BRS else 0) | (FLAG_ESI if fd_flags & _FD_ESI else 0)
        for allowed in _FD_LENGTHS:  # any other length was padded with zeros by whoever put it on a wire
            if allowed >= length:
                length = allowed
                break
        return Frame(number, record[_HEAD_SIZE : _HEAD_SIZE + length], flags)
    if length > 8:
        return None
    dlc = raw if length == 8 and 9 <= raw <= 15 else length
    if can_id & _REMOTE:
        return Frame(number, b"", flags | FLAG_REMOTE, dlc)
    return Frame(number, record[_HEAD_SIZE : _HEAD_SIZE + length], flags, dlc)


def open_can_socket(interface: str) -> socket.socket:
    """A bound CAN_RAW socket. Raises OSError; `interface_error` says what to do about it."""
    if not hasattr(socket, "AF_CAN"):
        raise OSError(errno.EAFNOSUPPORT, "this Python knows no AF_CAN")
    can = socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW)
    try:
        can.setsockopt(_SOL_CAN_RAW, _CAN_RAW_ERR_FILTER, _CAN_ERR_MASK)
        with contextlib.suppress(OSError):  # a kernel older than 3.6: no FD
            can.setsockopt(_SOL_CAN_RAW, _CAN_RAW_FD_FRAMES, 1)
        can.bind((interface,))
    except OSError:
        can.close()
        raise
    return can


def prepare_socket(can: socket.socket) -> None:
    """Never block; stamps and drop counts with every message; a large receive buffer, a small send buffer."""
    can.setblocking(False)
    try:
        can.setsockopt(socket.SOL_SOCKET, _SO_RCVBUFFORCE, _RECEIVE_BUFFER)  # beyond net.core.rmem_max: root only
    except OSError:
        can.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _RECEIVE_BUFFER)
    can.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _SEND_BUFFER)
    can.setsockopt(socket.SOL_SOCKET, SO_TIMESTAMPNS, 1)
    with contextlib.suppress(OSError):  # without it overruns show at the end only
        can.setsockopt(socket.SOL_SOCKET, SO_RXQ_OVFL, 1)


def interface_error(name: str, interface: str, error: OSError) -> CanopenExoError:
    """One line: what is missing and what to run."""
    if error.errno in (errno.EAFNOSUPPORT, errno.EPROTONOSUPPORT, errno.ESOCKTNOSUPPORT):
        remedy = "run `sudo modprobe can-raw` where the kernel has it, or use the emulated bus, `hub:`"
        return CanopenExoError(f"bus {name}: this machine has no SocketCAN ({error.strerror}); {remedy}")
    if error.errno in (errno.ENODEV, errno.ENXIO):
        if interface.startswith("vcan"):
            make = f"sudo modprobe vcan && sudo ip link add dev {interface} type vcan"
        else:
            make = f"sudo ip link set {interface} type can bitrate 1000000"
        remedy = f"`{make} && sudo ip link set {interface} up`; `ip link` lists what there is"
        return CanopenExoError(f"bus {name}: there is no CAN interface {interface!r}; run {remedy}")
    if error.errno in (errno.EPERM, errno.EACCES):
        return CanopenExoError(
            f"bus {name}: no right to open a CAN socket ({error.strerror}); run as root, or in a container with "
            "`--cap-add=NET_RAW --network=host`"
        )
    return CanopenExoError(f"bus {name}: interface {interface!r} cannot be opened: {error.strerror or error}")


@final
class SocketCanChannel(RecordChannel):
    """One SocketCAN interface. open_socket: gives a socket whose messages are the kernel's CAN records.

    The socket is opened at once; OSError passes to the caller then, later failures become notices.
    """

    def __init__(self, name: str, open_socket: Callable[[], socket.socket]) -> None:
        super().__init__(name)
        self.is_stamped = True
        self._open_socket: Final = open_socket
        self._stamps: Final = StampClock()
        self._receiver: Final = Receiver()
        self._sender: Final = Sender()
        self._found: list[Arrival] = []
        self._notices: list[PortState] = []
        self._state: PortState | None = None
        self._is_down: bool = False
        self._is_closed: bool = False
        self._drops: int = 0
        self._back_off_ns: int = _FIRST_BACK_OFF_NS
        self._fd: int = -1
        self._socket: socket.socket | None = open_socket()
        self._attach(self._socket)

    def fileno(self) -> int:
        """The socket; -1 while the interface is away."""
        return self._fd

    def receive(self) -> list[Arrival]:
        """What the kernel holds, at most 64 frames at once (the rest stays readable); opens again what was away."""
        if self.read():
            self.stamp()
        return [self.arrival(number) for number in range(self.count)]

    def read(self) -> bool:
        """As `receive`, kept."""
        if self._found:
            self._found = []
        self.count = 0
        if self._socket is None and not self._is_closed:
            self._reopen(time.monotonic_ns() - self.epoch_ns)
        receiver = self._receiver
        count = 0
        failure: OSError | None = None
        if self._socket is not None:
            try:
                count = receiver.read()
            except BlockingIOError:
                pass
            except OSError as error:
                failure = error
        if count and receiver.is_plain and not self._is_down and not self._notices and self._take_base(count):
            self.count = count
            return True
        now = self._stamps.begin(self.epoch_ns)  # not before reading: no stamp is later than now
        if count:
            self._take_all(now)
        elif failure is not None:
            self._fail(failure, now)
        if self._notices:
            self._hand_out(now)
        if self._socket is not None:
            self.poll_at = NEVER
        self.count = len(self._found)
        return self.count == 0

    def stamp(self) -> None:
        """The kernel's stamps on the loop's clock."""
        if self.count == 0:
            return
        receiver = self._receiver
        self._stamps.begin(self.epoch_ns)
        if self.count == 1:  # a frame alone, what a bus that is not crowded gives
            _, _, seconds, nanos = receiver.first()
            self.stamps = [self._stamps.at(seconds * SECOND + nanos)]
        else:
            self.stamps = self._stamps.many(receiver.seconds(), receiver.nanos())

    def arrival(self, number: int) -> Arrival:
        """One of those that `read` kept."""
        if self._found:
            return self._found[number]
        return Arrival(self.stamps[number], decode(self._receiver.record(number)), None)

    def send_run(self, source: RecordChannel, start: int, end: int) -> int:
        """Straight from where `source` has read them to."""
        can = self._socket
        if can is None or self._is_down or not isinstance(source, SocketCanChannel):
            return 0
        sent = start
        if end - start >= _MANY:
            sent += self._sender.send(source._receiver, start, end)
        try:
            while sent < end:
                can.send(source._receiver.views[sent])
                sent += 1
        except OSError:
            pass
        return sent - start

    def send(self, frame: Frame) -> bool:
        """Hand a frame to the kernel; False when its queue is full."""
        can = self._socket
        if can is None:
            self.lost += 1
            return True
        try:
            can.send(encode(frame))
        except BlockingIOError:
            self.send_at = 0
            return False
        except OSError as error:
            now = time.monotonic_ns() - self.epoch_ns
            if error.errno == errno.ENOBUFS:
                self.send_at = now + _AGAIN_NS
                return False
            self.lost += 1
            self._fail(error, now)
            return True
        if self._is_down:
            self._note(ErrorState.ERROR_ACTIVE, "interface up", time.monotonic_ns() - self.epoch_ns)
        return True

    def count_overruns(self) -> None:
        """Ask the kernel what it has dropped; with a frame it tells only what it dropped before that."""
        if self._socket is None:
            return
        with contextlib.suppress(OSError):  # Linux before 4.12: what the frames told has to do
            counts = self._socket.getsockopt(socket.SOL_SOCKET, _SO_MEMINFO, _MEMINFO.size)
            if len(counts) == _MEMINFO.size:
                self._count_drops(_MEMINFO.unpack(counts)[_MEMINFO_DROPS])

    def close(self) -> None:
        """Close the socket for good."""
        self._is_closed = True
        self.poll_at = NEVER
        if self._socket is not None:
            self.count_overruns()
            self._socket.close()
            self._socket = None
            self._fd = -1

    def _attach(self, can: socket.socket) -> None:
        """Read and send here from now on."""
        prepare_socket(can)
        self._receiver.attach(can)
        self._sender.attach(can)
        self._fd = can.fileno()

    def _take_base(self, count: int) -> bool:
        """Plain records that are base data frames, as nearly all are; False for any other."""
        receiver = self._receiver
        if count == 1:
            can_id, length, _, _ = receiver.first()
            if can_id > 0x7FF or length > 8:
                return False
            self.ids = [can_id]
            return True
        ids = receiver.ids()
        if max(ids) > 0x7FF or receiver.longest() > 8:
            return False
        self.ids = ids
        return True

    def _take_all(self, now: int) -> None:
        """A batch of any kind."""
        receiver = self._receiver
        for realtime_ns, record in receiver.stamped():
            stamp = now if realtime_ns < 0 else self._stamps.at(realtime_ns)
            if self._is_down:
                self._note(ErrorState.ERROR_ACTIVE, "interface up", now)
                self._hand_out(stamp)
            self._take(record, stamp)
        if receiver.drops >= 0:
            self._count_drops(receiver.drops)
        if receiver.is_untold:
            self.count_overruns()

    def _take(self, record: bytes, stamp: int) -> None:
        """One record of any kind."""
        frame = decode(record)
        if frame is not None:
            self._found.append(Arrival(stamp, frame, None))
            return
        if len(record) == CLASSICAL_SIZE:
            can_id = _HEAD.unpack_from(record)[0]
            if can_id & ERROR_FLAG:
                self.errors += 1
                self._state = read_error_frame(can_id, record[_HEAD_SIZE:], self._state)
                self._found.append(Arrival(stamp, None, self._state))
                return
        self.malformed += 1

    def _count_drops(self, total: int) -> None:
        """total: of this socket, modulo 2**32. A frame may tell an older total than the kernel did when asked."""
        new = (total - self._drops) & 0xFFFFFFFF
        if new < 1 << 31:
            self.overruns += new
            self._drops = total

    def _fail(self, error: OSError, now: int) -> None:
        """The socket reported `error`: down, gone, or a frame that this interface refuses (counted by the caller)."""
        if error.errno == errno.ENETDOWN:
            self._note(ErrorState.DOWN, "interface down", now)
        elif error.errno in _GONE:
            self._note(ErrorState.DOWN, "interface gone", now)
            if self._socket is not None:
                self.count_overruns()
                self._socket.close()
                self._socket = None
                self._fd = -1
            self._back_off_ns = _FIRST_BACK_OFF_NS
            self.poll_at = now

    def _note(self, state: ErrorState, cause: str, now: int) -> None:
        """Tell the node with the next `receive`, which is asked for at once."""
        is_down = state is ErrorState.DOWN
        if self._is_down and is_down:
            return
        self._is_down = is_down
        self._state = PortState(0, state, 0, 0, cause)
        self._notices.append(self._state)
        self.poll_at = now

    def _hand_out(self, stamp: int) -> None:
        """The notices so far, as arrivals."""
        for state in self._notices:
            self._found.append(Arrival(stamp, None, state))
        self._notices = []

    def _reopen(self, now: int) -> None:
        """Try once; the next attempt comes after a longer time."""
        try:
            can = self._open_socket()
            self._attach(can)
        except OSError:
            self.poll_at = now + self._back_off_ns
            self._back_off_ns = min(2 * self._back_off_ns, _LAST_BACK_OFF_NS)
            return
        self._socket = can
        self._drops = 0
