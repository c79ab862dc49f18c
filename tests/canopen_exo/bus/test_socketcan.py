"""SocketCAN: the kernel's records, and the channel on a socket that needs no CAN (loopback UDP carries the records)."""

import errno
import socket
import struct
import sys
import time
from collections.abc import Iterator

import can
import pytest
from hypothesis import given
from hypothesis import strategies as st

from canopen_exo.bus.adapter import to_message
from canopen_exo.bus.frame import FLAG_BRS, FLAG_ESI, FLAG_EXTENDED, FLAG_FD, FLAG_REMOTE, Frame
from canopen_exo.bus.node import MS, NEVER, SECOND, ErrorState
from canopen_exo.bus.socketcan import (
    CLASSICAL_SIZE,
    FD_SIZE,
    SocketCanChannel,
    decode,
    encode,
    interface_error,
    open_can_socket,
    prepare_socket,
)
from tests.stamps import kernel_stamps

linux = pytest.mark.skipif(sys.platform != "linux", reason="SocketCAN is Linux's")

IDS = st.one_of(
    st.tuples(st.integers(0, 0x7FF), st.just(0)), st.tuples(st.integers(0, 0x1FFFFFFF), st.just(FLAG_EXTENDED))
)


@st.composite
def frames(draw: st.DrawFn, raw_dlc: bool = True) -> Frame:
    can_id, flags = draw(IDS)
    kind = draw(st.sampled_from(("data", "remote", "fd")))
    if kind == "remote":
        return Frame(can_id, b"", flags | FLAG_REMOTE, draw(st.integers(0, 15 if raw_dlc else 8)))
    if kind == "fd":
        size = draw(st.sampled_from((*range(9), 12, 16, 20, 24, 32, 48, 64)))
        flags |= FLAG_FD | draw(st.sampled_from((0, FLAG_BRS, FLAG_ESI, FLAG_BRS | FLAG_ESI)))
        return Frame(can_id, draw(st.binary(min_size=size, max_size=size)), flags)
    data = draw(st.binary(max_size=8))
    dlc = draw(st.integers(8, 15)) if raw_dlc and len(data) == 8 else -1
    return Frame(can_id, data, flags, dlc)


@given(frames())
def test_every_kind_of_frame_survives_the_round_trip(frame: Frame) -> None:
    """Extended, remote, FD, raw DLC (len8_dlc): all kinds pass unchanged."""
    record = encode(frame)
    assert len(record) == (FD_SIZE if frame.flags & FLAG_FD else CLASSICAL_SIZE)
    assert decode(record) == frame


@linux
@given(frames(raw_dlc=False))
def test_records_are_those_of_python_can(frame: Frame) -> None:
    """Compared with an implementation of the kernel's structures that is not ours."""
    from can.interfaces.socketcan.socketcan import build_can_frame

    theirs = build_can_frame(to_message(frame))
    assert decode(theirs) == frame
    ours = encode(frame)  # byte 7, len8_dlc, means something from 9 on; python-can puts smaller lengths there too
    assert (ours[:7], ours[8:]) == (theirs[:7], theirs[8:])


@pytest.mark.parametrize(
    ("frame", "record"),
    [
        (Frame(0x123, b"\xaa"), struct.pack("=I4B8s", 0x123, 1, 0, 0, 0, b"\xaa")),
        (Frame(0x123, bytes(8), 0, 15), struct.pack("=I4B8s", 0x123, 8, 0, 0, 15, b"")),
        (Frame(1, b"", FLAG_REMOTE, 4), struct.pack("=I4B8s", 0x40000001, 4, 0, 0, 0, b"")),
        (Frame(1, b"", FLAG_REMOTE, 9), struct.pack("=I4B8s", 0x40000001, 8, 0, 0, 9, b"")),
        (Frame(1, b"", FLAG_EXTENDED), struct.pack("=I4B8s", 0x80000001, 0, 0, 0, 0, b"")),
        (Frame(1, b"\1", FLAG_FD | FLAG_BRS | FLAG_ESI), struct.pack("=I4B64s", 1, 1, 7, 0, 0, b"\1")),
    ],
)
def test_record_is_the_kernels_structure(frame: Frame, record: bytes) -> None:
    """linux/can.h: can_frame (id, len, pad, reserved, len8_dlc, data), canfd_frame (id, len, flags, ...)."""
    assert encode(frame) == record
    assert decode(record) == frame


@given(st.one_of(st.binary(max_size=80), st.binary(min_size=16, max_size=16), st.binary(min_size=72, max_size=72)))
def test_any_bytes_give_a_frame_or_none(record: bytes) -> None:
    """What comes from the kernel never raises; a frame that comes out can be sent."""
    frame = decode(record)
    if frame is not None:
        assert decode(encode(frame)) == frame


@pytest.mark.parametrize("length", [9, 64, 255])
def test_classical_record_longer_than_8_bytes_is_refused(length: int) -> None:
    """A length that the structure cannot hold is no frame."""
    assert decode(struct.pack("=I4B8s", 0x123, length, 0, 0, 0, b"")) is None


@pytest.mark.parametrize(("given_length", "length"), [(8, 8), (9, 12), (13, 16), (33, 48), (49, 64), (64, 64)])
def test_fd_length_between_two_codes_is_padded(given_length: int, length: int) -> None:
    """ISO 11898-1: lengths above 8 are 12, 16, 20, 24, 32, 48 and 64."""
    frame = decode(struct.pack("=I4B64s", 0x123, given_length, 4, 0, 0, b"\xff" * given_length))
    assert frame is not None
    assert frame.data == b"\xff" * given_length + bytes(length - given_length)


def test_error_frame_is_no_frame() -> None:
    """Error frames become notices, they are never forwarded."""
    assert decode(struct.pack("=I4B8s", 0x20000004, 8, 0, 0, 0, b"")) is None


@pytest.mark.parametrize(
    ("code", "interface", "words"),
    [
        (errno.EAFNOSUPPORT, "vcan0", ("no SocketCAN", "modprobe can-raw", "hub:")),
        (errno.ENODEV, "vcan0", ("no CAN interface 'vcan0'", "ip link add dev vcan0 type vcan", "set vcan0 up")),
        (errno.ENODEV, "can1", ("no CAN interface 'can1'", "type can bitrate", "ip link set can1 up")),
        (errno.EPERM, "can0", ("no right", "run as root")),
        (errno.EINVAL, "can0", ("cannot be opened",)),
    ],
)
def test_what_is_missing_is_said_in_one_line_with_the_remedy(
    code: int, interface: str, words: tuple[str, ...]
) -> None:
    """Without SocketCAN rights: one line saying what to run."""
    message = str(interface_error(f"socketcan:{interface}", interface, OSError(code, "reason")))
    assert "\n" not in message
    assert message.startswith(f"bus socketcan:{interface}: ")
    for word in words:
        assert word in message


def test_missing_interface_is_an_os_error() -> None:
    """Here either AF_CAN is missing or the interface is: `interface_error` tells which."""
    with pytest.raises(OSError, match=r"."):
        open_can_socket("no_such_can")


class Wire:
    """A channel on one end of a UDP connection, the test on the other."""

    def __init__(self) -> None:
        self.other = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.other.bind(("127.0.0.1", 0))
        self.other.settimeout(5)
        self.sockets: list[ScriptedSocket] = []
        self.refusals = 0
        self.channel = SocketCanChannel("socketcan:test0", self.open)
        self.channel.epoch_ns = time.monotonic_ns()

    def open(self) -> socket.socket:
        if self.refusals:
            self.refusals -= 1
            raise OSError(errno.ENODEV, "No such device")
        mine = ScriptedSocket(socket.AF_INET, socket.SOCK_DGRAM)
        mine.bind(("127.0.0.1", 0))
        mine.connect(self.other.getsockname())
        self.other.connect(mine.getsockname())
        self.sockets.append(mine)
        return mine

    def feed(self, record: bytes) -> None:
        self.other.send(record)

    def close(self) -> None:
        self.channel.close()
        self.other.close()


class ScriptedSocket(socket.socket):
    """A socket whose next calls fail with the codes given. drops: what the kernel would count as dropped so far."""

    fail_send: list[int]
    fail_receive: list[int]
    drops: int

    def __init__(self, family: int, kind: int) -> None:
        super().__init__(family, kind)
        self.fail_send = []
        self.fail_receive = []
        self.drops = 0

    def send(self, data: bytes, flags: int = 0) -> int:  # type: ignore[override]
        if self.fail_send:
            raise OSError(self.fail_send.pop(0), "scripted")
        return super().send(data, flags)

    def recvmsg(
        self, size: int, ancillary: int = 0, flags: int = 0
    ) -> tuple[bytes, list[tuple[int, int, bytes]], int, object]:
        if self.fail_receive:
            raise OSError(self.fail_receive.pop(0), "scripted")
        data, controls, flags, address = super().recvmsg(size, ancillary, flags)
        if self.drops:
            controls.append((socket.SOL_SOCKET, 40, struct.pack("@I", self.drops)))  # SO_RXQ_OVFL
        return data, controls, flags, address


@pytest.fixture
def wire() -> Iterator[Wire]:
    wire = Wire()
    yield wire
    wire.close()


FRAME = Frame(0x181, bytes(range(8)))


@linux
def test_receive_drains_in_order_with_kernel_stamps(wire: Wire) -> None:
    """Drain until it would block; stamps are the kernel's, on the loop's clock."""
    sent = [Frame(0x100 + number, bytes((number,))) for number in range(20)]
    with kernel_stamps():
        before = time.monotonic_ns() - wire.channel.epoch_ns
        for frame in sent:
            wire.feed(encode(frame))
        after = time.monotonic_ns() - wire.channel.epoch_ns
        arrivals = wire.channel.receive()
    assert [arrival.frame for arrival in arrivals] == sent
    stamps = [arrival.stamp_ns for arrival in arrivals]
    assert stamps == sorted(stamps)
    # Both clocks are read one after the other: a preemption between them moves all stamps, hence a wide margin; what
    # is to be seen is that the stamps are on the loop's clock and not taken when reading.
    assert before - SECOND <= stamps[0]
    assert stamps[-1] <= after + SECOND
    assert len(set(stamps)) > 1
    assert wire.channel.receive() == []


def test_send_hands_the_record_over(wire: Wire) -> None:
    """One send per frame."""
    assert wire.channel.send(FRAME)
    assert wire.other.recv(100) == encode(FRAME)


def test_flood_is_read_in_batches(wire: Wire) -> None:
    """The loop must come to its wake-ups; what is left stays readable."""
    for _ in range(300):
        wire.feed(encode(FRAME))
    first = wire.channel.receive()
    assert len(first) == 256
    assert len(wire.channel.receive()) <= 44


def test_error_frame_becomes_a_notice_and_a_count(wire: Wire) -> None:
    """Error frames on: PortState, never a frame."""
    wire.feed(struct.pack("=I4B8s", 0x20000004, 8, 0, 0, 0, b"\0\x20"))
    wire.feed(struct.pack("=I4B8s", 0x20000040, 8, 0, 0, 0, b""))
    arrivals = wire.channel.receive()
    assert [arrival.frame for arrival in arrivals] == [None, None]
    states = [arrival.state.state for arrival in arrivals if arrival.state is not None]
    assert states == [ErrorState.ERROR_PASSIVE, ErrorState.BUS_OFF]
    assert wire.channel.errors == 2


def test_record_that_is_no_frame_is_counted(wire: Wire) -> None:
    """Bad bytes are data: count, never raise."""
    wire.feed(b"\x01\x02")
    wire.feed(encode(FRAME))
    assert [arrival.frame for arrival in wire.channel.receive()] == [FRAME]
    assert wire.channel.malformed == 1


def test_kernel_drops_are_counted_as_overruns(wire: Wire) -> None:
    """SO_RXQ_OVFL is a running total since the socket was opened; ours goes on across a reopening."""
    for drops, overruns in ((3, 3), (3, 3), (10, 10)):
        wire.sockets[0].drops = drops
        wire.feed(encode(FRAME))
        wire.channel.receive()
        assert wire.channel.overruns == overruns
    wire.sockets[0].fail_receive = [errno.ENODEV]
    wire.channel.receive()
    wire.channel.receive()
    wire.sockets[1].drops = 2
    wire.feed(encode(FRAME))
    wire.channel.receive()
    assert wire.channel.overruns == 12


def test_full_socket_would_block(wire: Wire) -> None:
    """EAGAIN: select tells when it is writable again; nothing is lost."""
    wire.sockets[0].fail_send = [errno.EAGAIN]
    assert not wire.channel.send(FRAME)
    assert (wire.channel.send_at, wire.channel.lost) == (0, 0)
    assert wire.channel.send(FRAME)


def test_full_interface_queue_names_the_time_of_the_next_attempt(wire: Wire) -> None:
    """ENOBUFS: the socket stays writable for select, the frame is offered again a little later."""
    wire.sockets[0].fail_send = [errno.ENOBUFS]
    now = time.monotonic_ns() - wire.channel.epoch_ns
    assert not wire.channel.send(FRAME)
    assert wire.channel.send_at > now
    assert wire.channel.lost == 0


def test_frame_the_interface_refuses_is_lost_and_counted(wire: Wire) -> None:
    """EINVAL: CAN FD on an interface without it; the interface itself is well."""
    wire.sockets[0].fail_send = [errno.EINVAL]
    assert wire.channel.send(FRAME)
    assert wire.channel.lost == 1
    assert wire.channel.receive() == []


def notices(channel: SocketCanChannel) -> list[tuple[ErrorState, str]]:
    found = []
    for arrival in channel.receive():
        if arrival.state is not None:
            found.append((arrival.state.state, arrival.state.cause))
    return found


def test_interface_down_is_survived_reported_once_and_back_with_the_first_frame_sent(wire: Wire) -> None:
    """ENETDOWN: frames sent meanwhile are lost and counted; the socket lives on."""
    channel = wire.channel
    wire.sockets[0].fail_receive = [errno.ENETDOWN]
    wire.sockets[0].fail_send = [errno.ENETDOWN, errno.ENETDOWN]
    assert notices(channel) == [(ErrorState.DOWN, "interface down")]
    assert channel.fileno() >= 0
    assert channel.send(FRAME)
    assert channel.send(FRAME)
    assert channel.lost == 2
    assert notices(channel) == []
    assert channel.send(FRAME)
    assert channel.poll_at <= time.monotonic_ns() - channel.epoch_ns  # the notice is asked for at once
    assert notices(channel) == [(ErrorState.ERROR_ACTIVE, "interface up")]
    assert channel.poll_at == NEVER


def test_interface_up_is_reported_before_the_first_frame_received(wire: Wire) -> None:
    """The node hears that the bus is back, then what is on it."""
    wire.sockets[0].fail_receive = [errno.ENETDOWN]
    notices(wire.channel)
    wire.feed(encode(FRAME))
    arrivals = wire.channel.receive()
    assert [arrival.frame for arrival in arrivals] == [None, FRAME]


@pytest.mark.parametrize("code", [errno.ENODEV, errno.ENXIO])
def test_interface_that_disappears_is_opened_again_with_back_off(wire: Wire, code: int) -> None:
    """20 ms, doubled at every attempt; nothing blocks and nothing raises meanwhile."""
    channel = wire.channel
    wire.refusals = 3
    wire.sockets[0].fail_receive = [code]
    assert notices(channel) == [(ErrorState.DOWN, "interface gone")]
    assert channel.fileno() == -1
    back_offs = []
    for _ in range(3):
        before = time.monotonic_ns() - channel.epoch_ns
        assert notices(channel) == []
        after = time.monotonic_ns() - channel.epoch_ns
        back_offs.append((channel.poll_at - after, channel.poll_at - before))
        assert channel.send(FRAME)
    for (least, most), expected in zip(back_offs, (20 * MS, 40 * MS, 80 * MS), strict=True):
        assert least <= expected <= most
    assert channel.lost == 3
    assert notices(channel) == []
    assert channel.fileno() == wire.sockets[1].fileno()
    assert channel.send(FRAME)
    assert notices(channel) == [(ErrorState.ERROR_ACTIVE, "interface up")]


def test_interface_gone_after_going_down_is_opened_again(wire: Wire) -> None:
    """An adapter that is pulled out: down first, then gone."""
    wire.sockets[0].fail_receive = [errno.ENETDOWN, errno.ENODEV]
    assert notices(wire.channel) == [(ErrorState.DOWN, "interface down")]
    assert notices(wire.channel) == []
    assert wire.channel.fileno() == -1
    assert wire.channel.poll_at <= time.monotonic_ns() - wire.channel.epoch_ns
    wire.channel.receive()
    assert wire.channel.fileno() >= 0


def test_closed_channel_stays_closed(wire: Wire) -> None:
    """A second close does nothing, nothing is opened again, frames count as lost."""
    wire.channel.close()
    wire.channel.close()
    assert wire.channel.receive() == []
    assert wire.channel.fileno() == -1
    assert wire.channel.poll_at == NEVER
    assert wire.channel.send(FRAME)
    assert wire.channel.lost == 1


def test_receive_buffer_is_as_large_as_allowed() -> None:
    """The kernel doubles what it grants for its own bookkeeping: never less than what the system's default is."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as ours:
        default = ours.getsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF)
        prepare_socket(ours)
        assert ours.getsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF) >= default
        assert not ours.getblocking()


def test_python_can_reads_what_we_write() -> None:
    """A message as python-can's users make it."""
    message = can.Message(arbitration_id=0x6F, is_extended_id=False, data=[1, 2, 3])
    assert to_message(Frame(0x6F, b"\1\2\3")).equals(message, timestamp_delta=None)
