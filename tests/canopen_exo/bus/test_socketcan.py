"""SocketCAN: the kernel's records, and the channel on a socket that needs no CAN (loopback UDP carries the records)."""

import errno
import socket
import struct
import time
from collections.abc import Iterator

import can
import pytest
from hypothesis import given
from hypothesis import strategies as st

from canopen_exo.bus import channel, recvmmsg, socketcan
from canopen_exo.bus.adapter import to_message
from canopen_exo.bus.frame import FLAG_EXTENDED, Frame
from canopen_exo.bus.node import MS, NEVER, SECOND, ErrorState
from canopen_exo.bus.recvmmsg import SLOTS
from canopen_exo.bus.socketcan import (
    SocketCanChannel,
    encode,
    prepare_socket,
)
from tests.canopen_exo.bus.can_records import linux
from tests.stamps import FakeTime, kernel_stamps


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
def scripted(monkeypatch: pytest.MonkeyPatch) -> Iterator[Wire]:
    """Read by recvmsg, for which a ScriptedSocket can stand in."""
    monkeypatch.setattr(recvmmsg, "find_call", lambda *_: None)
    wire = Wire()
    yield wire
    wire.close()


@pytest.fixture(params=[pytest.param("recvmmsg", marks=linux), "recvmsg"])
def wire(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> Iterator[Wire]:
    """Both ways to read."""
    if request.param == "recvmsg":
        monkeypatch.setattr(recvmmsg, "find_call", lambda *_: None)
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
    assert wire.channel.receive() == []


@linux
def test_stamps_of_a_batch_differ(wire: Wire) -> None:
    """They are the kernel's, one for each frame, not the time of reading.

    The kernel begins to stamp a moment after it was first asked to (net_enable_timestamp defers it), until when stamps
    are of reading, later than now and so cut to it: hence again and again; on a busy machine that moment is long.
    """
    deadline = time.monotonic() + 60
    while time.monotonic() < deadline:
        for _ in range(20):
            wire.feed(encode(FRAME))
        if len({arrival.stamp_ns for arrival in wire.channel.receive()}) > 1:
            return
    pytest.fail("for a minute all stamps of every batch were the same")


def test_frame_is_not_stamped_earlier_than_it_came(scripted: Wire, monkeypatch: pytest.MonkeyPatch) -> None:
    """A process held up on its way to the socket reads what came meanwhile: with the kernel's stamp, no older now."""
    clocks = FakeTime(scripted.channel.epoch_ns)
    monkeypatch.setattr(channel, "time", clocks)
    monkeypatch.setattr(socketcan, "time", clocks)
    came: list[int] = []

    def held_up(*_: int) -> tuple[bytes, list[tuple[int, int, bytes]], int, object]:
        if len(came) == 2:
            raise BlockingIOError
        clocks.pass_by(30 * MS)
        came.append(clocks.monotonic - scripted.channel.epoch_ns)
        stamp = struct.pack("@ll", *divmod(clocks.wall, SECOND))
        clocks.pass_by(MS)
        return encode(FRAME), [(socket.SOL_SOCKET, 35, stamp)], 0, None  # SO_TIMESTAMPNS

    monkeypatch.setattr(scripted.sockets[0], "recvmsg", held_up)
    assert [arrival.stamp_ns for arrival in scripted.channel.receive()] == came


def test_send_hands_the_record_over(wire: Wire) -> None:
    """One send per frame."""
    assert wire.channel.send(FRAME)
    assert wire.other.recv(100) == encode(FRAME)


def test_flood_is_read_in_batches(wire: Wire) -> None:
    """The loop must come to its wake-ups; what is left stays readable."""
    for _ in range(300):
        wire.feed(encode(FRAME))
    first = wire.channel.receive()
    assert len(first) == SLOTS
    assert len(wire.channel.receive()) == SLOTS


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


def test_kernel_drops_are_counted_as_overruns(scripted: Wire) -> None:
    """SO_RXQ_OVFL is a running total since the socket was opened; ours goes on across a reopening."""
    for drops, overruns in ((3, 3), (3, 3), (10, 10)):
        scripted.sockets[0].drops = drops
        scripted.feed(encode(FRAME))
        scripted.channel.receive()
        assert scripted.channel.overruns == overruns
    scripted.sockets[0].fail_receive = [errno.ENODEV]
    scripted.channel.receive()
    scripted.channel.receive()
    scripted.sockets[1].drops = 2
    scripted.feed(encode(FRAME))
    scripted.channel.receive()
    assert scripted.channel.overruns == 12


@linux
def test_drops_after_the_last_frame_are_counted_too(wire: Wire) -> None:
    """The kernel tells them with the next frame, and when it is asked, at the end."""
    mine = wire.sockets[0]
    mine.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1)  # the kernel's minimum: a few frames
    for _ in range(200):
        wire.feed(encode(FRAME))
    received = 0
    while arrivals := wire.channel.receive():
        received += len(arrivals)
    assert received < 200
    wire.channel.count_overruns()
    assert wire.channel.overruns == 200 - received
    wire.feed(encode(FRAME))  # tells the same total again
    assert len(wire.channel.receive()) == 1
    wire.feed(encode(FRAME))
    assert len(wire.channel.receive()) == 1
    wire.channel.close()
    assert wire.channel.overruns == 200 - received


@linux
def test_drops_are_told_with_the_frames_behind_them(wire: Wire) -> None:
    """SO_RXQ_OVFL: with the next frame, without asking at the end."""
    wire.sockets[0].setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1)
    for _ in range(200):
        wire.feed(encode(FRAME))
    received = 0
    while arrivals := wire.channel.receive():
        received += len(arrivals)
    wire.feed(encode(FRAME))
    assert len(wire.channel.receive()) == 1
    assert wire.channel.overruns == 200 - received


@linux
@given(st.lists(st.binary(max_size=80), min_size=1, max_size=70))
def test_batch_holds_what_one_by_one_holds(records: list[bytes]) -> None:
    """Any bytes, of any length, alone and in a batch, read with one call or with many: the same frames and counts."""
    found = []
    for name in ("many", "one"):
        wire = Wire()
        if name == "one":
            wire.channel._receiver._read_many = None
        for record in records:
            wire.feed(record)
        arrivals = []
        while batch := wire.channel.receive():
            arrivals += [(arrival.frame, arrival.state and arrival.state.state) for arrival in batch]
        found.append((arrivals, wire.channel.malformed, wire.channel.errors))
        wire.close()
    assert found[0] == found[1]
    assert len(found[0][0]) + found[0][1] == len(records)


@linux
def test_records_are_those_that_came_and_go_out_again_unchanged(wire: Wire) -> None:
    """Base data frames with id and stamp, kept until the next reading; all else as arrivals."""
    frames = [Frame(0x100 + number, bytes(number)) for number in range(9)]
    records = [encode(frame) for frame in frames]
    for record in records:
        wire.feed(record)
    plain = wire.channel.read()
    assert wire.channel.count == 9
    if plain:  # stamped and read by recvmmsg
        wire.channel.stamp()
    assert [wire.channel.arrival(number).frame for number in range(9)] == frames
    if plain:
        assert wire.channel.ids == [frame.can_id for frame in frames]
        assert wire.channel.stamps == [wire.channel.arrival(number).stamp_ns for number in range(9)]
        other = Wire()
        assert other.channel.send_run(wire.channel, 3, 4) == 1
        assert other.channel.send_run(wire.channel, 2, 9) in (0, 7)
        assert other.other.recv(100) == records[3]
        other.close()
    wire.feed(records[0])
    wire.feed(encode(Frame(0x100, b"\1", FLAG_EXTENDED)))
    assert not wire.channel.read()
    kinds = [wire.channel.arrival(number).frame for number in range(2)]
    assert kinds == [frames[0], Frame(0x100, b"\1", FLAG_EXTENDED)]


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


def test_interface_down_is_survived_reported_once_and_back_with_the_first_frame_sent(scripted: Wire) -> None:
    """ENETDOWN: frames sent meanwhile are lost and counted; the socket lives on."""
    channel = scripted.channel
    scripted.sockets[0].fail_receive = [errno.ENETDOWN]
    scripted.sockets[0].fail_send = [errno.ENETDOWN, errno.ENETDOWN]
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


def test_interface_up_is_reported_before_the_first_frame_received(scripted: Wire) -> None:
    """The node hears that the bus is back, then what is on it."""
    scripted.sockets[0].fail_receive = [errno.ENETDOWN]
    notices(scripted.channel)
    scripted.feed(encode(FRAME))
    arrivals = scripted.channel.receive()
    assert [arrival.frame for arrival in arrivals] == [None, FRAME]


@pytest.mark.parametrize("code", [errno.ENODEV, errno.ENXIO])
def test_interface_that_disappears_is_opened_again_with_back_off(scripted: Wire, code: int) -> None:
    """20 ms, doubled at every attempt; nothing blocks and nothing raises meanwhile."""
    channel = scripted.channel
    scripted.refusals = 3
    scripted.sockets[0].fail_receive = [code]
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
    assert channel.fileno() == scripted.sockets[1].fileno()
    assert channel.send(FRAME)
    assert notices(channel) == [(ErrorState.ERROR_ACTIVE, "interface up")]


def test_interface_gone_after_going_down_is_opened_again(scripted: Wire) -> None:
    """An adapter that is pulled out: down first, then gone."""
    scripted.sockets[0].fail_receive = [errno.ENETDOWN, errno.ENODEV]
    assert notices(scripted.channel) == [(ErrorState.DOWN, "interface down")]
    assert notices(scripted.channel) == []
    assert scripted.channel.fileno() == -1
    assert scripted.channel.poll_at <= time.monotonic_ns() - scripted.channel.epoch_ns
    scripted.channel.receive()
    assert scripted.channel.fileno() >= 0


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
