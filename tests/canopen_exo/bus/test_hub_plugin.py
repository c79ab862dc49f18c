"""The hub as an interface of python-can, and what builds on it: Notifier, Logger, canopen."""

import select
import threading
import time

import can
import pytest
from hypothesis import given
from hypothesis import strategies as st

from canopen_exo.bus import hub_plugin
from canopen_exo.bus.hub_wire import pack_record
from canopen_exo.bus.medium import QUEUE_LENGTH
from tests.canopen_exo.bus.hub_buses import PATIENCE_S, StartHub, bus_on, got, message


def test_interface_is_found_by_its_name() -> None:
    """Entry point `can.interface`: no import needed, and the error for an unknown interface lists it."""
    assert "hub" in can.VALID_INTERFACES


@pytest.mark.parametrize(
    "sent",
    [
        message(0x181, b"12345678"),
        message(0x7FF),
        can.Message(arbitration_id=0x1FFFFFFF, data=b"\1"),
        can.Message(arbitration_id=0, data=b""),
        can.Message(arbitration_id=0x100, is_extended_id=False, is_remote_frame=True, dlc=5),
        can.Message(arbitration_id=0x204, is_extended_id=False, is_error_frame=True, dlc=8, data=bytes(range(8))),
        can.Message(arbitration_id=0x123, is_extended_id=False, is_fd=True, dlc=64, data=bytes(range(64))),
        can.Message(
            arbitration_id=0x123, is_fd=True, bitrate_switch=True, error_state_indicator=True, dlc=12, data=bytes(12)
        ),
    ],
)
def test_every_kind_of_message_passes_unchanged(start_hub: StartHub, sent: can.Message) -> None:
    """Base, extended, remote, error and FD; python-can's own comparison, but for time and channel."""
    hub = start_hub()
    with bus_on(hub) as first, bus_on(hub) as second:
        before = time.time()
        first.send(sent)
        received = got(second)
        assert received.equals(sent, timestamp_delta=None, check_channel=False)
        assert received.channel == second.channel
        # 1 s: the wall clock may be corrected between the welcome, which ties both clocks together, and now
        assert before - 1 <= received.timestamp <= time.time() + 1


@given(
    st.integers(0, 0x900), st.binary(max_size=9), st.integers(0, 15), st.sampled_from(("", "extended", "remote", "fd"))
)
def test_short_way_for_plain_messages_is_the_long_way(can_id: int, data: bytes, dlc: int, kind: str) -> None:
    """Base data frames are packed and unpacked apart; the bytes and the message are those of the way for all kinds."""
    sent = can.Message(
        arbitration_id=can_id,
        is_extended_id=kind == "extended",
        is_remote_frame=kind == "remote",
        is_fd=kind == "fd",
        data=None if kind == "remote" else data,
        dlc=dlc if kind == "remote" else None,
    )
    short = hub_plugin._pack_plain(sent)
    is_plain = kind == "" and can_id <= 0x7FF and len(data) <= 8
    assert bool(short) == is_plain
    record = short or pack_record(can_id & 0x7FF, 0, min(dlc, 8), data[: min(dlc, 8)], 5)
    if is_plain:
        assert short == hub_plugin._pack(sent)
    received = hub_plugin._unpack_plain(record, 0, 7, "here")
    assert (received is None) == (record[2] != record[3])
    if received is not None:
        long_way = hub_plugin._unpack(record, 0, 7, "here")
        assert received.equals(long_way, timestamp_delta=0)


def test_plain_record_with_rubbish_behind_its_data_is_none() -> None:
    """It is looked at more closely, and refused."""
    record = bytearray(pack_record(0x181, 0, 4, b"1234"))
    assert hub_plugin._unpack_plain(bytes(record), 0, 0, "here") is not None
    record[23] = 1
    assert hub_plugin._unpack_plain(bytes(record), 0, 0, "here") is None


@pytest.mark.parametrize("bitrate", [0, 1_000_000])
def test_own_messages_come_back_when_asked_for(start_hub: StartHub, bitrate: int) -> None:
    """receive_own_messages: marked as transmitted; not given otherwise."""
    hub = start_hub(bitrate)
    with bus_on(hub, own=True) as first, bus_on(hub) as second:
        first.send(message(1))
        assert (got(first).is_rx, got(second).is_rx) == (False, True)
        second.send(message(2))
        assert (got(first).arbitration_id, second.recv(0)) == (2, None)


def test_filters_are_kept(start_hub: StartHub) -> None:
    """python-can's filters, set at the start and later."""
    hub = start_hub()
    with bus_on(hub) as first, bus_on(hub) as second:
        second.set_filters([{"can_id": 0x180, "can_mask": 0x780, "extended": False}])
        for can_id in (0x080, 0x181, 0x201):
            first.send(message(can_id))
        assert got(second).arbitration_id == 0x181
        second.set_filters(None)
        assert got(second).arbitration_id == 0x201


def test_recv_without_news_returns_none(start_hub: StartHub) -> None:
    """recv(0) does not wait, recv(t) waits no longer than t."""
    with bus_on(start_hub()) as bus:
        assert bus.recv(0) is None
        assert bus.recv(0.001) is None


def test_missing_hub_is_an_initialization_error() -> None:
    """One line with the remedy, as python-can's own exception."""
    with pytest.raises(can.CanInitializationError, match=r"127\.0\.0\.1:1/drive: .*refused; start one with"):
        can.Bus(interface="hub", channel="127.0.0.1:1/drive")


def test_channel_that_is_none_is_an_initialization_error() -> None:
    """The message says how a channel is written."""
    with pytest.raises(can.CanInitializationError, match="write NAME or HOST:PORT/NAME"):
        can.Bus(interface="hub", channel="a/b c")


def test_hub_that_goes_away_ends_recv_and_send(start_hub: StartHub) -> None:
    """What has come before is given first; then both raise, also for one that waits already."""
    hub = start_hub()
    with bus_on(hub) as first, bus_on(hub) as second:
        first.send(message(1))
        assert got(second).arbitration_id == 1
        ended = threading.Thread(target=hub.stop)
        ended.start()
        with pytest.raises(can.CanOperationError, match=r"the hub has closed the connection|reset"):
            second.recv(PATIENCE_S)
        ended.join()
        with pytest.raises(can.CanOperationError, match=r"the hub has closed the connection|reset"):
            second.send(message(1))


@pytest.mark.parametrize(
    ("bad", "words"),
    [
        (can.Message(arbitration_id=1, is_fd=True, dlc=8, data=bytes(8)), "classical CAN"),
        (can.Message(arbitration_id=1, is_error_frame=True, dlc=8, data=bytes(8)), "classical CAN"),
    ],
)
def test_timed_hub_refuses_what_it_cannot_carry(start_hub: StartHub, bad: can.Message, words: str) -> None:
    """Refused with a clear error where it is sent; the bus stays usable."""
    hub = start_hub(1_000_000)
    with bus_on(hub) as first, bus_on(hub) as second:
        with pytest.raises(can.CanOperationError, match=words):
            first.send(bad)
        first.send(message(5))
        assert got(second).arbitration_id == 5


def test_message_that_is_no_frame_is_refused_before_it_is_sent(start_hub: StartHub) -> None:
    """It would disconnect this client."""
    with bus_on(start_hub()) as bus:
        for bad in (can.Message(arbitration_id=0x800, is_extended_id=False), can.Message(dlc=3, data=b"\1")):
            with pytest.raises(can.CanOperationError, match="not sent"):
                bus.send(bad)
        fd = can.Message(is_fd=True, dlc=9, data=bytes(9))
        with pytest.raises(can.CanOperationError, match="9 data bytes given"):
            bus.send(fd)


def test_burst_on_a_timed_hub_waits_and_loses_nothing(start_hub: StartHub) -> None:
    """`send` waits while 64 frames are under way, as a driver with a full buffer does; order and number are kept."""
    hub = start_hub(1_000_000)
    count = 5 * QUEUE_LENGTH
    with bus_on(hub) as first, bus_on(hub) as second:
        for number in range(count):
            first.send(message(0x100, number.to_bytes(2, "little")))
        assert [int.from_bytes(got(second).data, "little") for _ in range(count)] == list(range(count))
        assert (first.overflows, second.overruns) == (0, 0)


def test_send_gives_up_at_its_timeout(start_hub: StartHub) -> None:
    """At 100 bit/s a frame takes a second: 64 are taken, the next finds no room."""
    hub = start_hub(100)
    with bus_on(hub) as bus:
        for _ in range(QUEUE_LENGTH):
            bus.send(message(1, bytes(8)), timeout=PATIENCE_S)
        with pytest.raises(can.CanOperationError, match="transmit queue"):
            bus.send(message(1, bytes(8)), timeout=0)


@pytest.mark.long
def test_frames_missed_show_as_an_error_frame(start_hub: StartHub) -> None:
    """linux/can/error.h: controller, receive buffer overflow; `overruns` has the number."""
    hub = start_hub()
    count = 150_000
    with bus_on(hub) as sleeper, bus_on(hub) as sender:
        fd = can.Message(arbitration_id=1, is_fd=True, dlc=64, data=bytes(64), is_extended_id=False)
        for _ in range(count):
            sender.send(fd)
        kept = 0
        while kept + sleeper.overruns < count:
            received = got(sleeper)
            if received.is_error_frame:
                assert (received.arbitration_id, received.data[1]) == (4, 1)
            else:
                kept += 1
        assert kept + sleeper.overruns == count


def test_several_threads_may_send_while_one_receives(start_hub: StartHub) -> None:
    """As canopen uses a bus: a Notifier reads, whoever wants writes; records never mix."""
    hub = start_hub(1_000_000)
    per_thread = 100
    with bus_on(hub) as first, bus_on(hub) as second:
        received: list[can.Message] = []
        enough = threading.Event()

        def keep(item: can.Message) -> None:
            received.append(item)
            if len(received) == 3 * per_thread:
                enough.set()

        def send(can_id: int) -> None:
            for number in range(per_thread):
                first.send(message(can_id, bytes((number,))))

        with can.Notifier([first, second], [keep], timeout=0.05):
            threads = [threading.Thread(target=send, args=(can_id,)) for can_id in (1, 2, 3)]
            for thread in threads:
                thread.start()
            for thread in threads:
                thread.join()
            assert enough.wait(PATIENCE_S)
        for can_id in (1, 2, 3):
            assert [item.data[0] for item in received if item.arbitration_id == can_id] == list(range(per_thread))


def test_file_descriptor_is_readable_as_long_as_messages_wait(start_hub: StartHub) -> None:
    """select sees also what was read from the socket together with an earlier message."""
    hub = start_hub()
    with bus_on(hub) as first, bus_on(hub) as second:
        number = second.fileno()
        for can_id in range(10):
            first.send(message(can_id))
        seen: list[int] = []
        while len(seen) < 10:
            assert select.select([number], [], [], PATIENCE_S)[0]
            received = second.recv(0)
            if received is not None:
                seen.append(received.arbitration_id)
        assert seen == list(range(10))
        assert select.select([number], [], [], 0)[0] == []


def test_file_descriptor_asked_for_late_is_readable_too(start_hub: StartHub) -> None:
    """Messages that were read from the socket before anybody asked for the descriptor are waiting as well."""
    hub = start_hub()
    with bus_on(hub) as first, bus_on(hub) as second, bus_on(hub) as third:
        first.send(message(1))
        first.send(message(2))
        while got(third).arbitration_id != 2:  # the hub writes to the second before it writes to the third
            pass
        assert got(second).arbitration_id == 1
        assert select.select([second.fileno()], [], [], PATIENCE_S)[0]
        assert got(second).arbitration_id == 2
