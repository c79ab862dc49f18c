"""The hub without sockets: who gets which frame, when, and what happens to those who do not read or send rubbish."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from canopen_exo.bus.frame import FLAG_EXTENDED, FLAG_FD, FLAG_REMOTE, Frame
from canopen_exo.bus.hub_core import (
    CONFIRM_EVERY,
    MAX_BUSES,
    OUTBOX_LIMIT,
    Client,
    Hub,
)
from canopen_exo.bus.hub_wire import (
    FLAG_ERROR,
    FLAG_OWN,
    KIND_FD_FRAME,
    KIND_FRAME,
    KIND_OVERRUN,
    KIND_REFUSED,
    KIND_SENT,
    LOST_RECEIVING,
    OPTION_CONFIRM,
    OPTION_OWN,
    pack_frame,
    pack_hello,
    pack_record,
    unpack_frame,
    unpack_record,
    unpack_welcome,
)
from canopen_exo.bus.medium import QUEUE_LENGTH
from canopen_exo.bus.node import NEVER
from tests.canopen_exo.bus.hub_clients import MBIT, frames, join, records, texts

# --- both modes ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("bitrate", [0, MBIT])
def test_welcome_tells_mode_and_clocks(bitrate: int) -> None:
    """docs/hub.md: bit rate (0: fast) and both clocks of the hub at that moment."""
    hub = Hub(bitrate)
    hub.realtime_offset_ns = 1000
    client = Client("test")
    hub.received(client, pack_hello("drive", 0), 77)
    welcome = unpack_welcome(bytes(client.outbox))
    assert (welcome.bitrate, welcome.monotonic_ns, welcome.realtime_ns) == (bitrate, 77, 1077)


@pytest.mark.parametrize("bitrate", [0, MBIT])
def test_buses_of_one_hub_do_not_mix(bitrate: int) -> None:
    """Several named buses in one hub."""
    hub = Hub(bitrate)
    sender, drive, controller = join(hub), join(hub), join(hub, "controller")
    hub.received(sender, pack_frame(Frame(1, b"")), 5)
    hub.settle(5)
    hub.wake(MBIT)
    assert len(frames(drive)) == 1
    assert not controller.outbox
    assert not sender.outbox


@pytest.mark.parametrize("bitrate", [0, MBIT])
def test_records_may_come_in_any_pieces(bitrate: int) -> None:
    """TCP keeps no record boundaries."""
    sent = [Frame(1, b"\1"), Frame(2, b"", FLAG_REMOTE, 4), Frame(0x12345678, b"\3" * 8, FLAG_EXTENDED)]
    stream = pack_hello("drive", 0) + b"".join(pack_frame(frame) for frame in sent)
    for cut in range(1, len(stream)):
        hub = Hub(bitrate)
        receiver = join(hub)
        client = Client("test")
        hub.received(client, stream[:cut], 0)
        hub.received(client, stream[cut:], 0)
        hub.settle(0)
        hub.wake(MBIT)
        assert [frame for _, frame in frames(receiver)] == sent
        assert not client.refusal


@pytest.mark.parametrize("bitrate", [0, MBIT])
def test_corrupt_record_disconnects_its_sender_only(bitrate: int) -> None:
    """A corrupt record is refused: the client is told why, disconnected and counted; what came before it was good."""
    hub = Hub(bitrate)
    sender, receiver, other = join(hub), join(hub), join(hub)
    hub.received(sender, pack_frame(Frame(1, b"")) + pack_record(0x800, 0, 0, b"") + pack_frame(Frame(2, b"")), 0)
    assert texts(sender) == [(KIND_REFUSED, "CAN id 0x800 given, allowed 0..0x7ff with flags 0x00")]
    assert hub.refused == 1
    hub.received(sender, pack_frame(Frame(3, b"")), 0)
    hub.received(other, pack_frame(Frame(4, b"")), 0)
    hub.settle(0)
    hub.wake(MBIT)
    assert [frame.can_id for _, frame in frames(receiver)] == [1, 4]
    assert not sender.outbox


@pytest.mark.parametrize("size", [1, 15, 16, 23])
def test_partial_record_at_close_is_refused(size: int) -> None:
    """A partial record at close is no frame: told, counted, not carried."""
    hub = Hub(0)
    sender, receiver = join(hub), join(hub)
    hub.received(sender, pack_frame(Frame(1, b""))[:size], 0)
    hub.left(sender)
    assert texts(sender) == [(KIND_REFUSED, f"closed within a record, after {size} of its bytes")]
    assert hub.refused == 1
    assert not receiver.outbox


def test_close_between_records_is_no_refusal() -> None:
    """A client may leave at any time."""
    hub = Hub(0)
    sender, receiver = join(hub), join(hub)
    hub.received(sender, pack_frame(Frame(1, b"")), 0)
    hub.left(sender)
    hub.left(sender)
    assert hub.refused == 0
    assert len(frames(receiver)) == 1
    assert hub.buses["drive"].clients == [receiver]


@pytest.mark.parametrize("data", [b"GET / HTTP/1.1\r\n\r\n", b"\x01", b"\x00", pack_hello("x", 0, version=2)])
def test_first_words_that_are_no_hello_are_refused(data: bytes) -> None:
    """What cannot become a hello is not waited for."""
    hub = Hub(0)
    client = Client("test")
    hub.received(client, data, 0)
    assert client.refusal
    assert texts(client) == [(KIND_REFUSED, client.refusal)]


def test_hub_keeps_a_bounded_number_of_bus_names() -> None:
    """A client cannot fill the hub's memory with names."""
    hub = Hub(0)
    for number in range(MAX_BUSES):
        hub.left(join(hub, f"b{number}"))
    client = Client("test")
    hub.received(client, pack_hello("one_more", 0), 0)
    assert "one more than the 256" in client.refusal
    join(hub, "b0")


STREAMS = st.lists(
    st.one_of(
        st.binary(min_size=1, max_size=100),
        st.builds(
            lambda can_id, data: pack_record(can_id, 0, len(data), data), st.integers(0, 0x900), st.binary(max_size=8)
        ),
        st.just(pack_hello("drive", 0)),
        st.just(pack_frame(Frame(1, bytes(64), FLAG_FD))),
        st.just(pack_record(1, FLAG_ERROR, 8, bytes(8))),
    ),
    max_size=12,
)


@given(STREAMS, st.sampled_from([0, MBIT]), st.booleans())
def test_no_bytes_harm_the_hub(stream: list[bytes], bitrate: int, is_joined: bool) -> None:
    """Any bytes in any pieces: no exception, and the others go on."""
    hub = Hub(bitrate)
    first, second = join(hub), join(hub)
    rogue = join(hub) if is_joined else Client("rogue")
    now = 0
    for data in stream:
        now += 1000
        hub.received(rogue, data, now)
        hub.settle(now)
        hub.wake(now)
    hub.left(rogue)
    hub.wake(now + 1000 * MBIT)
    first.outbox.clear()
    second.outbox.clear()
    hub.received(first, pack_frame(Frame(7, b"ok")), now + 2000 * MBIT)
    hub.settle(now + 2000 * MBIT)
    hub.wake(now + 3000 * MBIT)
    assert [frame for _, frame in frames(second)] == [Frame(7, b"ok")]
    assert bool(rogue.refusal) == bool(hub.refused)


# --- fast ----------------------------------------------------------------------------------------------------------


def test_fast_hub_gives_every_frame_to_all_others_at_once_in_order() -> None:
    """Fast mode: order of arrival, whatever the ids; the stamp is the arrival at the hub."""
    hub = Hub(0)
    first, second, third = join(hub), join(hub), join(hub)
    hub.received(first, pack_frame(Frame(5, b"a")) + pack_frame(Frame(1, b"b")), 10)
    hub.received(second, pack_frame(Frame(3, b"c")), 20)
    assert frames(third) == [(10, Frame(5, b"a")), (10, Frame(1, b"b")), (20, Frame(3, b"c"))]
    assert frames(second) == [(10, Frame(5, b"a")), (10, Frame(1, b"b"))]
    assert frames(first) == [(20, Frame(3, b"c"))]
    assert hub.wake_at == NEVER


def test_fast_hub_carries_fd_remote_and_error_frames() -> None:
    """All frame kinds pass unchanged."""
    hub = Hub(0)
    sender, receiver = join(hub), join(hub)
    sent = [
        pack_frame(Frame(0x12345678, bytes(range(64)), FLAG_FD | FLAG_EXTENDED)),
        pack_frame(Frame(1, b"", FLAG_REMOTE, 8)),
        pack_record(0x204, FLAG_ERROR, 8, bytes((0, 8, 0, 0, 0, 0, 96, 0))),
    ]
    hub.received(sender, b"".join(sent), 9)
    assert [record[:8] + record[16:] for record in records(receiver)] == [item[:8] + item[16:] for item in sent]


@pytest.mark.parametrize("bitrate", [0, MBIT])
def test_own_frames_come_back_marked_when_asked_for(bitrate: int) -> None:
    """OPTION_OWN: flag 0x40, only to the sender, with the stamp the others get."""
    hub = Hub(bitrate)
    sender, receiver = join(hub, options=OPTION_OWN), join(hub)
    hub.received(sender, pack_frame(Frame(1, b"x")) + pack_frame(Frame(2 << 18, b"y", FLAG_EXTENDED)), 3)
    hub.settle(3)
    hub.wake(MBIT)
    own = records(sender)
    assert [record[1] for record in own] == [FLAG_OWN, FLAG_OWN | FLAG_EXTENDED]
    assert [(unpack_record(record, 0)[4], unpack_frame(record, 0)) for record in own] == frames(receiver)


# --- clients that do not read --------------------------------------------------------------------------------------


def test_client_that_does_not_read_gets_a_counted_overrun_and_stalls_nobody() -> None:
    """A bounded buffer; then frames for it are dropped and counted, and it is told where they are missing."""
    hub = Hub(0)
    sender, reader, sleeper = join(hub), join(hub), join(hub)
    batch = b"".join(pack_frame(Frame(number, b"")) for number in range(1000))
    got = 0
    for _ in range(60):
        hub.received(sender, batch, 0)
        got += len(frames(reader))
    assert got == 60_000
    assert len(sleeper.outbox) <= OUTBOX_LIMIT + 24
    kept = len(sleeper.outbox) // 24
    sleeper.outbox.clear()
    hub.drained(sleeper)
    hub.received(sender, pack_frame(Frame(1, b"")), 0)
    told, after = records(sleeper)
    assert (told[0], told[1], unpack_record(told, 0)[0]) == (KIND_OVERRUN, LOST_RECEIVING, 60_000 - kept)
    assert unpack_frame(after, 0) == Frame(1, b"")
    assert hub.buses["drive"].skipped == 60_000 - kept


def test_gap_is_told_once_and_before_the_first_frame_after_it() -> None:
    """A client that reads slowly hears of one gap, not of one for each frame: nothing is kept until half is free."""
    hub = Hub(0)
    sender, sleeper = join(hub), join(hub)
    batch = b"".join(pack_frame(Frame(2, b"")) for _ in range(1000))
    for _ in range(44):
        hub.received(sender, batch, 0)
    missed = hub.buses["drive"].skipped
    assert missed
    del sleeper.outbox[:24]
    hub.received(sender, pack_frame(Frame(3, b"")), 0)
    missed += 1
    del sleeper.outbox[: OUTBOX_LIMIT // 2]
    hub.received(sender, pack_frame(Frame(4, b"")), 0)
    sleeper.outbox[:] = sleeper.outbox[-48:]
    told, after = records(sleeper)
    assert (told[0], unpack_record(told, 0)[0]) == (KIND_OVERRUN, missed)
    assert unpack_frame(after, 0) == Frame(4, b"")


@pytest.mark.long
@pytest.mark.parametrize("kind", [KIND_FRAME, KIND_FD_FRAME])
def test_rogue_that_neither_reads_nor_stops_cannot_fill_the_memory(kind: int) -> None:
    """What a client is told about its own frames is bounded too."""
    hub = Hub(MBIT)
    rogue = join(hub)
    frame = Frame(1, b"") if kind == KIND_FRAME else Frame(1, b"", FLAG_FD)
    batch = pack_frame(frame) * 200
    for _ in range(300):
        hub.received(rogue, batch, 0)
    bus = hub.buses["drive"]
    assert bus.overflows + bus.rejected >= 60_000 - QUEUE_LENGTH
    assert len(rogue.outbox) <= OUTBOX_LIMIT + 256
    rogue.outbox.clear()
    hub.drained(rogue)
    assert (rogue.overflow, len(rogue.outbox) <= 24) == (0, True)


def test_rogue_that_never_reads_what_it_has_sent_cannot_fill_the_memory() -> None:
    """Confirmations are put off while the outbox is full, and none of the frames they count is forgotten."""
    hub = Hub(MBIT)
    rogue = join(hub, options=OPTION_CONFIRM)
    filler = OUTBOX_LIMIT // 24 - 10
    assert rogue.offer(pack_frame(Frame(2, b""), 0) * filler, filler) == 0
    now = sent = 0
    for _ in range(100):
        hub.received(rogue, pack_frame(Frame(1, b"")) * (2 * CONFIRM_EVERY), now)
        hub.settle(now)
        sent += 2 * CONFIRM_EVERY
        while hub.wake_at != NEVER:
            now = hub.wake_at
            hub.wake(now)
            hub.settle(now)
    assert len(rogue.outbox) <= OUTBOX_LIMIT + 24
    told = records(rogue)[filler:]
    hub.drained(rogue)
    assert len(rogue.outbox) == 24
    told += records(rogue)
    assert {record[0] for record in told} == {KIND_SENT}
    assert sum(unpack_record(record, 0)[0] for record in told) == sent
