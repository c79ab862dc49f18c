"""The hub as a channel of the real-time loop: frames and notices with a time, nothing raised, back after the hub is."""

import contextlib
import itertools
import select
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from typing import Protocol

import pytest

from canopen_exo.bus import hub_client
from canopen_exo.bus.channel import Arrival
from canopen_exo.bus.frame import FLAG_BRS, FLAG_EXTENDED, FLAG_FD, FLAG_REMOTE, Frame
from canopen_exo.bus.hub_client import HubChannel, HubError
from canopen_exo.bus.hub_core import OUTBOX_LIMIT
from canopen_exo.bus.hub_wire import (
    FLAG_ERROR,
    KIND_REFUSED,
    LONG,
    Welcome,
    pack_frame,
    pack_record,
    pack_text,
)
from canopen_exo.bus.medium import QUEUE_LENGTH
from canopen_exo.bus.node import MS, NEVER, SECOND, ErrorState
from canopen_exo.errors import CanopenExoError
from tests.stamps import FakeTime

PATIENCE_S = 20.0
"""How long a test waits for what must come; on a busy machine it only has to come at all."""


class Running(Protocol):
    """What the fixture gives."""

    address: str

    def stop(self) -> None: ...


StartHub = Callable[..., Running]


@contextlib.contextmanager
def opened(address: str, bus: str = "drive") -> Iterator[HubChannel]:
    """A channel that has joined."""
    channel = HubChannel(f"{address}/{bus}")
    try:
        channel.open()
        yield channel
    finally:
        channel.close()


def wait(channel: HubChannel, enough: Callable[[list[Arrival]], bool]) -> list[Arrival]:
    """Serve the channel as the loop does until `enough` of what has come."""
    found: list[Arrival] = []
    deadline = time.monotonic() + PATIENCE_S
    while not enough(found):
        assert time.monotonic() < deadline, found
        readers = [channel] if channel.fileno() >= 0 else []
        assert readers or channel.poll_at != NEVER, "the loop would never ask again"
        due_ns = channel.poll_at + channel.epoch_ns
        left = 1.0 if channel.poll_at == NEVER else max((due_ns - time.monotonic_ns()) / SECOND, 0.0)
        if not select.select(readers, [], [], left)[0] and time.monotonic_ns() < due_ns:
            continue
        found += channel.receive()
    return found


def frames(arrivals: list[Arrival]) -> list[Frame]:
    """The frames among them."""
    return [arrival.frame for arrival in arrivals if arrival.frame is not None]


def causes(arrivals: list[Arrival]) -> list[tuple[ErrorState, str]]:
    """The notices among them."""
    return [(arrival.state.state, arrival.state.cause) for arrival in arrivals if arrival.state is not None]


def told_as_overrun(arrivals: list[Arrival]) -> list[bool]:
    """Of each notice: whether it tells of lost frames, and of no other state than before."""
    states = [arrival.state for arrival in arrivals if arrival.state is not None]
    return [state.overrun and state.state is ErrorState.ERROR_ACTIVE for state in states]


EVERY_KIND = [
    Frame(0x181, b"12345678"),
    Frame(0x12345678, b"", FLAG_EXTENDED),
    Frame(0x100, b"", FLAG_REMOTE, 5),
    Frame(0x101, b"12345678", 0, 15),
    Frame(0x102, bytes(range(64)), FLAG_FD | FLAG_BRS),
]


def test_every_kind_of_frame_passes_unchanged_with_a_stamp_on_the_loops_clock(start_hub: StartHub) -> None:
    """Extended, remote, raw DLC and FD; the hub's stamp lies between sending and now."""
    hub = start_hub()
    with opened(hub.address) as sender, opened(hub.address) as receiver:
        receiver.epoch_ns = time.monotonic_ns() - 5 * SECOND
        before = time.monotonic_ns() - receiver.epoch_ns
        for frame in EVERY_KIND:
            assert sender.send(frame)
        found = wait(receiver, lambda found: len(found) == len(EVERY_KIND))
        assert frames(found) == EVERY_KIND
        stamps = [arrival.stamp_ns for arrival in found]
        assert before <= stamps[0]
        assert stamps == sorted(stamps)
        assert stamps[-1] <= time.monotonic_ns() - receiver.epoch_ns
        assert sender.receive() == []


def test_timed_hub_stamps_the_end_of_the_frame(start_hub: StartHub) -> None:
    """Frames of one burst follow each other without a gap: 126 bits of 1 us for id 181 with 8 zero bytes."""
    hub = start_hub(1_000_000)
    with opened(hub.address) as sender, opened(hub.address) as receiver:
        for _ in range(QUEUE_LENGTH):
            sender.send(Frame(0x181, bytes(8)))
        found = wait(receiver, lambda found: len(found) == QUEUE_LENGTH)
        gaps = {later.stamp_ns - earlier.stamp_ns for earlier, later in itertools.pairwise(found)}
        # at least once the hub had a frame waiting when another ended; it never starts one before the other's end
        assert min(gaps) == 126_000


@pytest.mark.parametrize("channel", ["127.0.0.1:1/drive"])
def test_missing_hub_is_one_line_with_the_remedy(channel: str) -> None:
    """What, where, remedy; and no socket left."""
    with pytest.raises(HubError, match=r"hub 127\.0\.0\.1:1/drive: .*refused; start one with `exo-hil hub`"):
        HubChannel(channel).open()


def test_channel_that_is_none_is_refused_at_once() -> None:
    """A usage error, before any socket."""
    with pytest.raises(CanopenExoError, match="write NAME or HOST:PORT/NAME"):
        HubChannel("127.0.0.1:1/")


def test_error_frames_become_notices(start_hub: StartHub) -> None:
    """PortState is the only error notice to nodes; error frames never pass as frames."""
    hub = start_hub()
    with opened(hub.address) as channel, socket_joined(hub.address) as other:
        other.sendall(pack_record(0x204, FLAG_ERROR, 8, bytes((0, 0x20, 0, 0, 0, 0, 130, 7))))
        (arrival,) = wait(channel, lambda found: bool(found))
        assert arrival.frame is None
        assert arrival.state is not None
        assert (arrival.state.state, arrival.state.tec, arrival.state.rec) == (ErrorState.ERROR_PASSIVE, 130, 7)
        assert channel.errors == 1


@contextlib.contextmanager
def socket_joined(address: str) -> Iterator[socket.socket]:
    """A client of bare bytes."""
    with opened(address) as channel, socket.socket(fileno=channel.fileno()) as link:
        link.setblocking(True)
        yield link
        link.detach()


def test_timed_hub_rejects_fd_and_the_channel_counts_it_lost(
    start_hub: StartHub, caplog: pytest.LogCaptureFixture
) -> None:
    """A frame that is not carried makes a run invalid: counted, and the first one told with the reason."""
    hub = start_hub(1_000_000)
    with opened(hub.address) as channel:
        for _ in range(3):
            assert channel.send(Frame(0x123, bytes(12), FLAG_FD))
        found = wait(channel, lambda _: channel.lost == 3)
        assert causes(found) == []  # nothing is wrong with the bus
        (told,) = caplog.messages
        assert "the hub rejected a frame: frame 123 not carried: CAN FD" in told


def test_overflow_of_the_hubs_transmit_queue_is_counted_lost(start_hub: StartHub) -> None:
    """64 frames wait at most; the rest is dropped and counted, which is no notice about the state of the bus."""
    hub = start_hub(10_000)  # 11 ms for a frame: the queue is full long before one has left
    with opened(hub.address) as channel:
        surplus = 10
        with socket.socket(fileno=channel.fileno()) as link:
            link.send(pack_frame(Frame(1, bytes(8))) * (QUEUE_LENGTH + surplus))  # one piece: nothing leaves meanwhile
            link.detach()
        found = wait(channel, lambda _: channel.lost == surplus)
        assert all(told_as_overrun(found))


@pytest.mark.long
def test_frames_missed_are_counted(start_hub: StartHub) -> None:
    """A channel that was not read for long: what is missing is counted in `overruns`, kept + missed = sent."""
    hub = start_hub()
    # more than the hub keeps and the kernel keeps on both sides as a rule
    sent = (OUTBOX_LIMIT + (9 << 20)) // LONG
    with opened(hub.address) as sleeper, socket_joined(hub.address) as sender:
        record = pack_frame(Frame(1, bytes(64), FLAG_FD))
        sender.sendall(record * sent)
        found = wait(sleeper, lambda found: len(frames(found)) + sleeper.overruns == sent)
        assert all(told_as_overrun(found))


def test_lost_hub_is_noticed_once_and_found_again(start_hub: StartHub) -> None:
    """Interface away: a notice, file descriptor -1, frames counted lost; then back by itself with another notice."""
    hub = start_hub()
    port = int(hub.address.rpartition(":")[2])
    with opened(hub.address) as channel:
        hub.stop()
        found = wait(channel, lambda found: bool(found))
        assert causes(found)[0][0] is ErrorState.DOWN
        assert channel.send(Frame(1, b""))
        assert channel.lost == 1
        again = start_hub(0, port)
        found = wait(channel, lambda found: bool(found))
        assert causes(found) == [(ErrorState.ERROR_ACTIVE, "the hub is back")]
        with opened(again.address) as other:
            other.send(Frame(2, b""))
            assert frames(wait(channel, lambda found: bool(found))) == [Frame(2, b"")]


def test_closed_channel_stays_closed(start_hub: StartHub) -> None:
    """A second close does nothing, and nothing is looked for any more."""
    with opened(start_hub().address) as channel:
        channel.close()
        channel.close()
        assert (channel.fileno(), channel.poll_at, channel.receive()) == (-1, NEVER, [])


class FakeHub:
    """A listener that says what a test wants."""

    def __init__(self) -> None:
        self.listener = socket.create_server(("127.0.0.1", 0))
        self.address = f"127.0.0.1:{self.listener.getsockname()[1]}"

    def welcome(self, channel: HubChannel, monotonic_ns: int) -> socket.socket:
        """Let `channel` join; the hub's clock shows `monotonic_ns`."""
        opening = threading.Thread(target=channel.open)
        opening.start()
        link, _ = self.listener.accept()
        hello = b""
        while len(hello) < LONG:
            hello += link.recv(LONG - len(hello))
        link.sendall(Welcome(0, monotonic_ns, 0).pack())
        opening.join()
        return link


@pytest.fixture
def fake_hub() -> Iterator[FakeHub]:
    hub = FakeHub()
    yield hub
    hub.listener.close()


@pytest.mark.parametrize("apart_s", [-3600, 3600])
def test_stamps_of_a_hub_on_another_machine_are_moved_to_our_clock(fake_hub: FakeHub, apart_s: int) -> None:
    """Its clock started at another time; the difference is found in the handshake, to within the round trip."""
    channel = HubChannel(f"{fake_hub.address}/drive")
    before = time.monotonic_ns()
    its_now = before + apart_s * SECOND
    with fake_hub.welcome(channel, its_now) as link:
        after = time.monotonic_ns()
        link.sendall(pack_frame(Frame(1, b""), its_now))
        (arrival,) = wait(channel, lambda found: bool(found))
        assert before <= arrival.stamp_ns <= after
    channel.close()


def test_flood_is_read_in_batches(fake_hub: FakeHub, monkeypatch: pytest.MonkeyPatch) -> None:
    """The loop must come to its wake-ups, however fast others send; nothing of it is lost."""
    channel = HubChannel(f"{fake_hub.address}/drive")
    flood = pack_frame(Frame(1, b"12345678")) * 10_000
    taken = 0

    def read() -> bytes:
        nonlocal taken
        rest, channel._link.rest = channel._link.rest, b""
        more = flood[taken % 24 :][: 1 << 16]
        taken += len(more)
        assert taken < 100 << 16, "it never stops to read"
        return rest + more

    with fake_hub.welcome(channel, time.monotonic_ns()):
        monkeypatch.setattr(channel._link, "read", read)
        found = [len(channel.receive()) for _ in range(5)]
    assert sum(found) == taken // 24
    assert max(found) <= 4 * (1 << 16) // 24 + 1
    channel.close()


def test_frame_is_not_stamped_earlier_than_it_came(fake_hub: FakeHub, monkeypatch: pytest.MonkeyPatch) -> None:
    """A process held up on its way to the socket reads what came meanwhile: with the hub's stamp, not an older now."""
    channel = HubChannel(f"{fake_hub.address}/drive")
    with fake_hub.welcome(channel, time.monotonic_ns()) as link:
        clocks = FakeTime(time.monotonic_ns())
        monkeypatch.setattr(hub_client, "time", clocks)

        def held_up() -> bytes:
            clocks.pass_by(30 * MS)
            return pack_frame(Frame(1, b""), clocks.monotonic)

        monkeypatch.setattr(channel._link, "read", held_up)
        channel._link.offset_ns = 0
        (arrival,) = channel.receive()
        assert arrival.stamp_ns == clocks.monotonic
        link.close()
    channel.close()


@pytest.mark.parametrize(
    ("data", "words"),
    [
        (b"\xff" * 24, "a record of unknown kind 255 came"),
        (b"\x00" * 24, "a record of unknown kind 0 came"),
        (pack_record(0x800, 0, 0, b""), "a corrupt record came: CAN id 0x800"),
        (pack_text(KIND_REFUSED, "because"), "refused: because"),
        (b"", "the hub has closed the connection"),
    ],
)
def test_what_comes_from_the_wire_is_never_raised(fake_hub: FakeHub, data: bytes, words: str) -> None:
    """A corrupt record ends the connection with a notice; good frames before it are kept."""
    channel = HubChannel(f"{fake_hub.address}/drive")
    with fake_hub.welcome(channel, 0) as link:
        link.sendall(pack_frame(Frame(1, b"")) + data)
    found = wait(channel, lambda found: bool(causes(found)))
    assert frames(found) == [Frame(1, b"")]
    ((state, cause),) = causes(found)
    assert state is ErrorState.DOWN
    assert words in cause
    channel.close()


def test_channel_needs_no_python_can() -> None:
    """The light path: python-can is in the plug-in only."""
    code = "import sys; import canopen_exo.bus.hub, canopen_exo.bus.hub_client; sys.exit('can' in sys.modules)"
    subprocess.run([sys.executable, "-c", code], check=True)
