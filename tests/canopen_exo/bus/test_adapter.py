"""Any python-can bus as a channel: on python-can's own virtual bus, and on one that fails as told."""

import errno
import os
import time
from collections.abc import Iterator

import can
import pytest
from hypothesis import given
from hypothesis import strategies as st

from canopen_exo.bus import adapter
from canopen_exo.bus import channel as bus_channel
from canopen_exo.bus.adapter import PythonCanChannel, from_message, open_python_can, to_message
from canopen_exo.bus.frame import FLAG_BRS, FLAG_ESI, FLAG_EXTENDED, FLAG_FD, FLAG_REMOTE, Frame
from canopen_exo.bus.node import MS, NEVER, SECOND, ErrorState, Node, Out
from canopen_exo.bus.realtime import RealTimeLoop
from canopen_exo.errors import CanopenExoError
from tests.stamps import FakeTime

KINDS = [
    Frame(0x123, b"\1\2"),
    Frame(0x7FF, b""),
    Frame(0, bytes(8)),
    Frame(0x1FFFFFFF, b"abc", FLAG_EXTENDED),
    Frame(5, b"", FLAG_EXTENDED),
    Frame(0x123, b"", FLAG_REMOTE, 5),
    Frame(0x123, b"", FLAG_REMOTE | FLAG_EXTENDED, 0),
    Frame(0x123, bytes(64), FLAG_FD | FLAG_BRS),
    Frame(0x123, bytes(3), FLAG_FD | FLAG_ESI | FLAG_EXTENDED),
]


class ScriptedBus(can.BusABC):
    """What `recv` gives: messages, then None; exceptions are raised. fails: errors for the next sends."""

    def __init__(self, fd: int = -1) -> None:
        super().__init__(channel="scripted")
        self._is_shutdown = True  # nothing to complain of when it is collected
        self.fd = fd
        self.given: list[can.Message | Exception] = []
        self.fails: list[Exception] = []
        self.sent: list[can.Message] = []
        self.timeouts: list[float | None] = []
        self.is_open = True

    def fileno(self) -> int:
        return self.fd

    def recv(self, timeout: float | None = None) -> can.Message | None:
        self.timeouts.append(timeout)
        if not self.given:
            return None
        item = self.given.pop(0)
        if isinstance(item, Exception):
            raise item
        return item

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        self.timeouts.append(timeout)
        if self.fails:
            raise self.fails.pop(0)
        self.sent.append(msg)

    def shutdown(self) -> None:
        super().shutdown()
        self.is_open = False


def opened(bus: ScriptedBus) -> PythonCanChannel:
    channel = PythonCanChannel("scripted:0", lambda: bus)
    channel.epoch_ns = time.monotonic_ns() - SECOND
    return channel


def now_of(channel: PythonCanChannel) -> int:
    return time.monotonic_ns() - channel.epoch_ns


def notices(channel: PythonCanChannel) -> list[tuple[ErrorState, str]]:
    found = []
    for arrival in channel.receive():
        if arrival.state is not None:
            found.append((arrival.state.state, arrival.state.cause))
    return found


@pytest.mark.parametrize("frame", KINDS, ids=repr)
def test_every_kind_of_frame_survives_the_round_trip(frame: Frame) -> None:
    """All frame kinds pass unchanged, as messages that python-can itself finds valid."""
    message = to_message(frame)
    message._check()
    assert from_message(message) == frame


def test_raw_dlc_is_read_and_goes_as_8() -> None:
    """python-can's SocketCAN tells the raw DLC; its other interfaces fail on more than 8."""
    message = can.Message(arbitration_id=1, is_extended_id=False, data=bytes(8), dlc=13)
    assert from_message(message) == Frame(1, bytes(8), 0, 13)
    assert to_message(Frame(1, bytes(8), 0, 13)).dlc == 8


@pytest.mark.long
@given(
    st.integers(0, 1 << 32),
    st.binary(max_size=70),
    st.integers(0, 255),
    st.lists(st.booleans(), min_size=5, max_size=5),
)
def test_any_message_gives_a_frame_or_none(can_id: int, data: bytes, dlc: int, kinds: list[bool]) -> None:
    """What an adapter delivers never raises."""
    extended, remote, error, fd, switched = kinds
    message = can.Message(
        arbitration_id=can_id,
        is_extended_id=extended,
        is_remote_frame=remote,
        is_error_frame=error,
        is_fd=fd,
        bitrate_switch=switched,
        data=data,
        dlc=dlc,
    )
    frame = from_message(message)
    assert frame is None or not error


@pytest.fixture
def pair() -> Iterator[tuple[PythonCanChannel, can.BusABC]]:
    """A channel and a plain python-can bus on one virtual channel."""
    with can.Bus(interface="virtual", channel="test_adapter", ignore_config=True) as other:
        channel = PythonCanChannel("virtual:a", lambda: open_python_can("virtual", "test_adapter", None))
        channel.epoch_ns = time.monotonic_ns() - SECOND
        yield channel, other
        channel.close()


def test_frames_pass_both_ways_over_a_python_can_bus(pair: tuple[PythonCanChannel, can.BusABC]) -> None:
    """Every kind, in order; own frames do not come back."""
    channel, other = pair
    for frame in KINDS:
        assert channel.send(frame)
        message = other.recv(timeout=0)
        assert message is not None
        assert from_message(message) == frame
        other.send(message)
    assert [arrival.frame for arrival in channel.receive()] == KINDS
    assert channel.receive() == []


def test_own_frames_stay_away_whatever_is_configured(monkeypatch: pytest.MonkeyPatch) -> None:
    """`receive_own_messages` in python-can's configuration would make a gateway forward its own frames for ever."""
    monkeypatch.setenv("CAN_CONFIG", '{"receive_own_messages": true}')
    with open_python_can("virtual", "test_adapter_own", None) as bus:
        bus.send(to_message(Frame(0x205, b"\1")))
        assert bus.recv(timeout=0) is None


def test_frames_of_other_programs_on_this_machine_are_received() -> None:
    """On SocketCAN `Message.is_rx` is False for them as well; that a frame is our own it does not say."""
    bus = ScriptedBus()
    bus.given = [can.Message(arbitration_id=0x205, is_extended_id=False, data=b"\1", is_rx=False)]
    (arrival,) = opened(bus).receive()
    assert arrival.frame == Frame(0x205, b"\1")


def test_loop_serves_a_bus_that_has_no_descriptor(pair: tuple[PythonCanChannel, can.BusABC]) -> None:
    """A reader with a short poll: the virtual bus has no fileno."""
    channel, other = pair

    class Echo(Node):
        def receive(self, now: int, port: int, frame: Frame, out: Out) -> None:
            out.send(port, Frame(frame.can_id + 1, frame.data))

    loop = RealTimeLoop(Echo(), [channel], [0], channel.epoch_ns)
    other.send(to_message(Frame(0x100, b"\7")))
    answers: list[can.Message] = []

    def answered(_: int) -> bool:
        message = other.recv(timeout=0)
        if message is not None:
            answers.append(message)
        return bool(answers)

    loop.run(answered)
    assert from_message(answers[0]) == Frame(0x101, b"\7")
    assert loop.losses() == 0


def test_bus_without_descriptor_is_polled_every_millisecond() -> None:
    """`poll_at` after each reading."""
    channel = opened(ScriptedBus())
    assert channel.fileno() == -1
    assert channel.poll_at == 0  # it may hold something already
    before = now_of(channel)
    channel.receive()
    assert before + MS <= channel.poll_at <= now_of(channel) + MS


def test_bus_with_descriptor_is_not_polled() -> None:
    """select says when."""
    read_end, write_end = os.pipe()
    try:
        channel = opened(ScriptedBus(read_end))
        channel.receive()
        assert (channel.fileno(), channel.poll_at) == (read_end, NEVER)
    finally:
        os.close(read_end)
        os.close(write_end)


def test_no_call_of_the_bus_waits() -> None:
    """Every recv and send has a timeout of 0."""
    bus = ScriptedBus()
    channel = opened(bus)
    channel.receive()
    channel.send(KINDS[0])
    assert set(bus.timeouts) == {0}


def test_stamp_of_the_wall_clock_is_mapped_to_the_loop_clock() -> None:
    """Most adapters stamp with the wall clock, as a float in seconds."""
    bus = ScriptedBus()
    channel = opened(bus)
    bus.given = [can.Message(timestamp=time.time() - 0.4, arbitration_id=1)]
    (arrival,) = channel.receive()
    # 0.1 s each way: clocks are read one after the other on a busy machine
    assert abs(arrival.stamp_ns - (now_of(channel) - 400 * MS)) < 100 * MS


def test_message_is_not_stamped_earlier_than_it_came(monkeypatch: pytest.MonkeyPatch) -> None:
    """A process held up on its way to the bus reads what came meanwhile: with its own stamp, not an older now."""
    bus = ScriptedBus()
    channel = opened(bus)
    clocks = FakeTime(channel.epoch_ns)
    monkeypatch.setattr(bus_channel, "time", clocks)
    monkeypatch.setattr(adapter, "time", clocks)

    def held_up(timeout: float | None = None) -> can.Message | None:
        if clocks.monotonic != channel.epoch_ns:
            return None
        clocks.pass_by(30 * MS)
        return can.Message(timestamp=clocks.wall / SECOND, arbitration_id=1)

    monkeypatch.setattr(bus, "recv", held_up)
    (arrival,) = channel.receive()
    assert abs(arrival.stamp_ns - 30 * MS) < 1000  # python-can stamps with a float, whose steps are 238 ns


@pytest.mark.parametrize("stamp", [0.0, 12.5, 4e9])
def test_stamp_of_a_device_clock_is_replaced_by_the_time_of_reading(stamp: float) -> None:
    """An adapter's own clock starts anywhere."""
    bus = ScriptedBus()
    channel = opened(bus)
    channel.receive()
    before = now_of(channel)
    bus.given = [can.Message(timestamp=stamp, arbitration_id=1)]
    (arrival,) = channel.receive()
    assert before - MS <= arrival.stamp_ns <= now_of(channel)


def test_error_frames_become_notices() -> None:
    """is_error_frame: with 8 bytes as SocketCAN's, otherwise the state stays as it was."""
    bus = ScriptedBus()
    channel = opened(bus)
    bus.given = [
        can.Message(is_error_frame=True, arbitration_id=0x40, is_extended_id=False, data=bytes(8)),
        can.Message(is_error_frame=True, arbitration_id=0x100, data=b"\1\2\3\4"),
    ]
    assert notices(channel) == [(ErrorState.BUS_OFF, "bus-off"), (ErrorState.BUS_OFF, "error frame")]
    assert channel.errors == 2


def test_message_that_is_no_frame_is_counted() -> None:
    """Bad data is counted, the next frame is read."""
    bus = ScriptedBus()
    channel = opened(bus)
    bus.given = [can.Message(data=bytes(9)), to_message(KINDS[0])]
    assert [arrival.frame for arrival in channel.receive()] == [KINDS[0]]
    assert channel.malformed == 1


def test_flood_is_read_in_batches() -> None:
    """The loop must come to its wake-ups; the rest is asked for at once."""
    bus = ScriptedBus()
    channel = opened(bus)
    bus.given = [to_message(KINDS[0])] * 300
    assert len(channel.receive()) == 256
    assert channel.poll_at <= now_of(channel)
    assert len(channel.receive()) == 44


def test_full_transmit_buffer_is_tried_again_a_millisecond_later() -> None:
    """python-can has no way to wait for room."""
    bus = ScriptedBus()
    channel = opened(bus)
    bus.fails = [can.CanOperationError("Transmit buffer full")]
    before = now_of(channel)
    assert not channel.send(KINDS[0])
    assert before + MS <= channel.send_at <= now_of(channel) + MS
    assert channel.send(KINDS[0])
    assert (len(bus.sent), channel.lost) == (1, 0)
    assert channel.receive() == []


def test_bus_that_fails_to_send_for_long_loses_frames_and_counts_as_down() -> None:
    """After 100 ms the frame is lost, the node is told once, and told again when frames go."""
    bus = ScriptedBus()
    channel = opened(bus)
    bus.fails = [can.CanOperationError("no\nway")] * 4
    assert not channel.send(KINDS[0])
    channel.epoch_ns -= 99 * MS  # time passes
    assert not channel.send(KINDS[0])
    channel.epoch_ns -= MS
    assert channel.send(KINDS[0])
    assert channel.send(KINDS[0])
    assert channel.lost == 2
    assert notices(channel) == [(ErrorState.DOWN, "cannot send: no way")]
    assert channel.send(KINDS[0])
    assert notices(channel) == [(ErrorState.ERROR_ACTIVE, "sending again")]


def test_frame_the_interface_cannot_send_is_lost_at_once() -> None:
    """Such as CAN FD on a classical adapter: ValueError, and nothing to wait for."""
    bus = ScriptedBus()
    channel = opened(bus)
    bus.fails = [ValueError("no FD")]
    assert channel.send(KINDS[0])
    assert channel.lost == 1


@pytest.mark.parametrize(
    ("protocol", "error", "is_lost"),
    [
        (can.CanProtocol.CAN_20, can.CanOperationError("Failed to transmit"), True),
        (can.CanProtocol.CAN_20, OSError(errno.ENOBUFS, "No buffer space available"), True),
        (can.CanProtocol.CAN_FD, can.CanOperationError("Failed to transmit", errno.EINVAL), True),
        (can.CanProtocol.CAN_FD, OSError(errno.EINVAL, "Invalid argument"), True),
        (can.CanProtocol.CAN_FD, can.CanOperationError("Transmit buffer full"), False),
        (can.CanProtocol.CAN_FD, OSError(errno.ENOBUFS, "No buffer space available"), False),
    ],
)
def test_fd_frame_its_bus_cannot_carry_is_lost_at_once(
    protocol: can.CanProtocol, error: Exception, is_lost: bool
) -> None:
    """Nothing behind it waits, and the interface does not count as down; a full queue is another matter."""
    bus = ScriptedBus()
    bus._can_protocol = protocol
    channel = opened(bus)
    bus.fails = [error]
    assert channel.send(Frame(0x123, bytes(64), FLAG_FD)) is is_lost
    assert channel.lost == int(is_lost)
    assert channel.receive() == []
    bus.fails = [error]
    assert not channel.send(Frame(0x123, bytes(8)))  # a classical frame may go later


def test_bus_that_fails_to_read_is_opened_again_with_back_off() -> None:
    """An adapter pulled out: shut down, reported once, looked for after 0.1 s, 0.2 s ..."""
    first, second = ScriptedBus(), ScriptedBus()
    plan: list[ScriptedBus | None] = [first, None, None, second]

    def open_bus() -> can.BusABC:
        bus = plan.pop(0)
        if bus is None:
            raise CanopenExoError("not there")
        return bus

    channel = PythonCanChannel("scripted:0", open_bus)
    channel.epoch_ns = time.monotonic_ns() - SECOND
    first.given = [to_message(KINDS[0]), can.CanOperationError("gone")]
    arrivals = channel.receive()
    assert [arrival.frame for arrival in arrivals] == [KINDS[0], None]
    assert not first.is_open
    assert channel.send(KINDS[0])
    assert channel.lost == 1
    for expected in (100 * MS, 200 * MS):
        before = now_of(channel)
        assert notices(channel) == []
        assert before + expected <= channel.poll_at <= now_of(channel) + expected
    assert notices(channel) == [(ErrorState.ERROR_ACTIVE, "open again")]
    assert channel.send(KINDS[0])
    assert len(second.sent) == 1


def test_closed_channel_stays_closed() -> None:
    """The bus is shut down once; nothing is opened again."""
    bus = ScriptedBus()
    channel = opened(bus)
    channel.close()
    channel.close()
    assert not bus.is_open
    assert channel.receive() == []
    assert channel.poll_at == NEVER


def test_unknown_interface_lists_those_of_python_can() -> None:
    """Unknown name: what was given, what is allowed."""
    with pytest.raises(CanopenExoError, match=r"no interface 'nope'; python-can has .*\bsocketcan\b.*\bvirtual\b"):
        open_python_can("nope", "0", None)


def test_interface_that_hears_itself_is_refused() -> None:
    """A gateway would pass its own frames on for ever; the hub does the same over the same network."""
    with pytest.raises(CanopenExoError, match=r"hears itself.*use `hub:`"):
        open_python_can("udp_multicast", "239.74.163.2", None)


def test_interface_that_cannot_be_opened_is_one_line() -> None:
    """A serial adapter that is not there, or whose driver is missing."""
    with pytest.raises(CanopenExoError) as failure:
        open_python_can("slcan", "/dev/no_such_adapter", 500_000)
    assert str(failure.value).startswith("bus slcan:/dev/no_such_adapter: python-can cannot open it: ")
    assert "\n" not in str(failure.value)
