"""SocketCanChannel, and python-can's adapter beside it, on a real SocketCAN."""

import errno
import select
import socket
import time
from collections.abc import Callable, Iterator

import can
import pytest

from canopen_exo.bus.adapter import PythonCanChannel
from canopen_exo.bus.channel import Channel
from canopen_exo.bus.frame import Frame
from canopen_exo.bus.interfaces import open_channel, parse_bus
from canopen_exo.bus.node import MS, SECOND, ErrorState, Node, Out
from canopen_exo.bus.realtime import RealTimeLoop
from canopen_exo.bus.socketcan import encode
from canopen_exo.errors import CanopenExoError
from tests.stamps import kernel_stamps
from tests.vcan import uml
from tests.vcan.inside.peers import (
    BUS_OFF,
    EIGHT,
    KINDS,
    PASSIVE,
    RAW_DLC,
    RESTARTED,
    Kind,
    fields,
    frames,
    next_message,
    python_can,
    receive,
    run,
    send_error,
    wait_until,
)

each_kind = pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.name)


@pytest.fixture(params=["socketcan", "python-can"])
def either(request: pytest.FixtureRequest, opened: Callable[[str], Channel]) -> Iterator[Channel]:
    """Our own socket, and the way by python-can, on vcan0."""
    if request.param == "socketcan":
        yield opened("socketcan:vcan0")
        return
    adapter = PythonCanChannel("socketcan:vcan0", lambda: can.Bus("vcan0", "socketcan", fd=True))
    adapter.epoch_ns = time.monotonic_ns()
    yield adapter
    adapter.close()


# --- frames ----------------------------------------------------------------------------------------------------------


@each_kind
def test_every_kind_of_frame_is_received_as_it_was_sent(either: Channel, peer: can.BusABC, kind: Kind) -> None:
    """Extended, remote, FD: id type, DLC and flags kept; the sender is python-can."""
    peer.send(kind.of_python_can())
    assert frames(receive(either, 1)) == [kind.frame]


@each_kind
def test_every_kind_of_frame_is_sent_as_it_was_given(either: Channel, peer: can.BusABC, kind: Kind) -> None:
    """As above, the receiver is python-can."""
    assert either.send(kind.frame)
    assert fields(next_message(peer)) == fields(kind.of_python_can())
    assert either.lost == 0


@pytest.mark.parametrize("frame", RAW_DLC, ids=lambda frame: f"{frame.can_id:X}-dlc-{frame.dlc}")
def test_raw_dlc_above_8_passes_the_kernel(opened: Callable[[str], Channel], frame: Frame) -> None:
    """len8_dlc: a classical frame of 8 bytes may say 9..15 on the wire (ISO 11898-1)."""
    sender, receiver = opened("socketcan:vcan0"), opened("socketcan:vcan0")
    assert sender.send(frame)
    assert frames(receive(receiver, 1)) == [frame]


def test_own_frames_are_not_received(either: Channel, peer: can.BusABC) -> None:
    """CAN_RAW_RECV_OWN_MSGS off: what is sent comes back to the others only."""
    assert either.send(Frame(0x181, EIGHT))
    peer.send(can.Message(arbitration_id=0x182, is_extended_id=False))
    assert frames(receive(either, 1)) == [Frame(0x182, b"")]
    assert next_message(peer).arbitration_id == 0x181


def test_order_is_kept_and_nothing_is_lost(either: Channel, peer: can.BusABC) -> None:
    """More than one batch of them, read when all are there."""
    sent = [Frame(0x100 + number % 7, number.to_bytes(4, "big")) for number in range(600)]
    for frame in sent:
        peer.send(can.Message(arbitration_id=frame.can_id, is_extended_id=False, data=frame.data))
    if isinstance(either, PythonCanChannel):
        arrived = receive(either, 1)  # python-can asks for no larger buffer: only that the order is kept
        assert frames(arrived) == sent[: len(arrived)]
        return
    assert frames(receive(either, len(sent))) == sent
    assert either.overruns == 0


def test_stamp_is_of_arrival_and_not_of_reading(either: Channel, peer: can.BusABC) -> None:
    """Kernel time stamps: frames read together keep the distance at which they came."""
    with kernel_stamps():
        before = time.monotonic_ns() - either.epoch_ns
        peer.send(KINDS[1].of_python_can())
        select.select([], [], [], 0.05)
        peer.send(KINDS[2].of_python_can())
        after = time.monotonic_ns() - either.epoch_ns
        select.select([], [], [], 0.05)
        first, second = receive(either, 2)
    # Both clocks run at the same rate to 500 ppm (adjtimex); 1 ms for the resolution of a wall clock set meanwhile.
    assert second.stamp_ns - first.stamp_ns >= 49 * MS
    # The offset of the clocks is read in two calls, between which this process may be interrupted for a while.
    assert before - SECOND < first.stamp_ns <= second.stamp_ns < after + SECOND


# --- errors ----------------------------------------------------------------------------------------------------------


def test_error_frames_become_notices_and_are_counted(either: Channel, peer: can.BusABC) -> None:
    """CAN_RAW_ERR_FILTER: error frames are on, and never pass as frames."""
    for error in (PASSIVE, BUS_OFF, RESTARTED):
        send_error(peer, error)
    peer.send(KINDS[1].of_python_can())
    *notices, last = receive(either, 4)
    states = [arrival.state.state for arrival in notices if arrival.state is not None]
    assert states == [ErrorState.ERROR_PASSIVE, ErrorState.BUS_OFF, ErrorState.ERROR_ACTIVE]
    assert last.frame == KINDS[1].frame
    assert either.errors == 3


def test_frames_the_kernel_drops_are_counted(channel: Channel) -> None:
    """SO_RXQ_OVFL: what was received and what was dropped make up all that was sent."""
    count = 40_000  # the receive buffer holds about 20,000
    record = encode(Frame(0x181, EIGHT))
    with socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW) as flood:
        flood.bind(("vcan0",))
        for _ in range(count):
            flood.send(record)
        received = 0
        while arrivals := channel.receive():
            received += len(arrivals)
        flood.send(record)  # the count of drops comes with the next frame
    received += len(receive(channel, 1))
    assert channel.overruns > 0
    assert received + channel.overruns == count + 1


class Burst(Node):
    """Sends 60 frames when woken, and counts nothing but its own wake-up."""

    def __init__(self) -> None:
        super().__init__()
        self.wake_at = 0

    def wake(self, now: int, out: Out) -> None:
        self.wake_at = 1 << 61
        for number in range(60):
            out.send(0, Frame(0x181, bytes((number,))))

    def receive(self, now: int, port: int, frame: Frame, out: Out) -> None:
        """Nothing is done about it."""


def refusal(sender: socket.socket, record: bytes) -> int | None:
    """Send until it is refused; why."""
    try:
        for _ in range(1000):
            sender.send(record)
    except OSError as error:
        return error.errno
    return None


@pytest.mark.parametrize("room", [3, 40], ids=["ENOBUFS", "EAGAIN"])
def test_frames_wait_where_the_interface_is_full(channel: Channel, peer: can.BusABC, room: int) -> None:
    """An interface that takes 1000 frames/s and has room for a few: it refuses, and nothing is lost or out of order.

    Room for 3 frames: the interface's queue is full first (ENOBUFS). Room for 40: the socket's send buffer is (EAGAIN).
    """
    run("tc", "qdisc", "add", "dev", "vcan0", "root", "tbf",
        "rate", "128kbit", "burst", "160", "limit", str(16 * room))  # 16 bytes a frame
    try:
        record = encode(Frame(0x181, b"\0"))
        with socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW) as probe:
            probe.bind(("vcan0",))
            probe.setblocking(False)
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 1)
            assert refusal(probe, record) == (errno.ENOBUFS if room == 3 else errno.EAGAIN)
        while peer.recv(0.2) is not None:
            pass
        loop = RealTimeLoop(Burst(), [channel], [0], channel.epoch_ns)
        came: list[int] = []

        def is_over(now: int) -> bool:
            while (message := peer.recv(0)) is not None:
                came.append(message.data[0])
            return len(came) >= 60 or now > 10 * SECOND

        loop.run(is_over)
    finally:
        run("tc", "qdisc", "del", "dev", "vcan0", "root")
    assert came == list(range(60))
    assert (loop.losses(), loop.dropped) == (0, [0])


# --- interface down, gone, missing -----------------------------------------------------------------------------------


def notice(channel: Channel) -> tuple[ErrorState, str]:
    (arrival,) = receive(channel, 1)
    assert arrival.state is not None
    return arrival.state.state, arrival.state.cause


def test_interface_that_goes_down_is_reported_and_comes_back(channel: Channel, peer: can.BusABC) -> None:
    """Down: one notice, what is sent is lost and counted. Up: a notice before the first frame; the socket lives on."""
    uml.set_link("vcan0", up=False)
    assert notice(channel) == (ErrorState.DOWN, "interface down")
    assert channel.send(KINDS[1].frame)
    assert channel.send(KINDS[2].frame)
    assert channel.lost == 2
    uml.set_link("vcan0")
    with python_can("vcan0") as fresh:
        fresh.send(KINDS[2].of_python_can())
        up, first = receive(channel, 2)
        assert up.state is not None
        assert up.state.state is ErrorState.ERROR_ACTIVE
        assert first.frame == KINDS[2].frame
        assert channel.send(KINDS[1].frame)
        assert fields(next_message(fresh)) == fields(KINDS[1].of_python_can())
    assert channel.lost == 2


def test_first_frame_sent_shows_that_the_interface_is_up_again(channel: Channel, peer: can.BusABC) -> None:
    """Nobody else need speak."""
    uml.set_link("vcan0", up=False)
    notice(channel)
    uml.set_link("vcan0")
    assert channel.send(KINDS[1].frame)
    assert notice(channel) == (ErrorState.ERROR_ACTIVE, "interface up")


def test_interface_that_disappears_is_opened_again(opened: Callable[[str], Channel], spare: str) -> None:
    """An adapter pulled out and put back: reported, opened again with back-off, frames pass both ways."""
    channel = opened(f"socketcan:{spare}")
    uml.delete_link(spare)
    causes = []
    while "interface gone" not in causes:
        causes.append(notice(channel)[1])
    assert causes in (["interface gone"], ["interface down", "interface gone"])
    assert channel.fileno() == -1
    assert channel.send(KINDS[1].frame)
    assert channel.lost == 1
    wait_until(lambda: not channel.receive() and channel.fileno() == -1, "it is still away")
    uml.set_link(spare, create_kind="vcan")
    limit = time.monotonic() + 10  # back-off is 1 s at most
    while channel.fileno() < 0:
        assert time.monotonic() < limit
        select.select([], [], [], 0.02)
        if channel.poll_at <= time.monotonic_ns() - channel.epoch_ns:
            assert channel.receive() == []
    with python_can(spare) as back:
        back.send(KINDS[2].of_python_can())
        up, first = receive(channel, 2)
        assert up.state is not None
        assert (up.state.state, first.frame) == (ErrorState.ERROR_ACTIVE, KINDS[2].frame)
        assert channel.send(KINDS[1].frame)
        assert next_message(back).arbitration_id == KINDS[1].frame.can_id


@pytest.mark.parametrize(("interface", "remedy"), [("vcan9", "type vcan"), ("can9", "type can bitrate"), ("lo", "")])
def test_interface_that_is_not_there_is_one_line_that_says_what_to_run(interface: str, remedy: str) -> None:
    """Without it: one line saying what to run; `lo` is there and is no CAN interface."""
    with pytest.raises(CanopenExoError) as error:
        open_channel(parse_bus(f"socketcan:{interface}"))
    assert str(error.value).startswith(f"bus socketcan:{interface}: ")
    assert remedy in str(error.value)
    assert "\n" not in str(error.value)
