"""Heartbeat: producer and consumer (CiA 301, 7.2.8.2.2)."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from canopen_exo.bus.node import MS, NEVER
from canopen_exo.heartbeat import HeartbeatConsumer, HeartbeatProducer, heartbeat_frame
from canopen_exo.nmt import NmtState


@pytest.mark.parametrize("state", list(NmtState))
@pytest.mark.parametrize("node_id", [1, 6, 127])
def test_heartbeat_carries_the_state(node_id: int, state: NmtState) -> None:
    """CiA 301, 7.2.8.3.2.2: COB-ID 700h + node id, one byte; state 0 is the boot-up message."""
    frame = heartbeat_frame(node_id, state)
    assert (frame.can_id, frame.data) == (0x700 + node_id, bytes((state.value,)))


# --- producer ----------------------------------------------------------------------------------------------------


def test_producer_is_off_until_started() -> None:
    """Object 1017: 0 switches it off."""
    producer = HeartbeatProducer(1)
    assert producer.due == NEVER
    producer.start(5 * MS, 0)
    assert producer.due == NEVER


def test_producer_keeps_its_period_without_drift() -> None:
    """Object 1017: every period, counted from the start, whatever a wake-up was late by."""
    producer = HeartbeatProducer(1)
    producer.start(5 * MS, 100 * MS)
    for number in range(1, 6):
        assert producer.due == (5 + 100 * number) * MS
        producer.beat(producer.due + (number % 2) * 99 * MS, NmtState.OPERATIONAL)


def test_new_period_counts_from_when_it_was_written() -> None:
    """Object 1017: a write starts the timer anew; 0 stops it."""
    producer = HeartbeatProducer(1)
    producer.start(0, 100 * MS)
    producer.start(30 * MS, 50 * MS)
    assert producer.due == 80 * MS
    producer.start(60 * MS, 0)
    assert producer.due == NEVER


@pytest.mark.parametrize("late", [100, 101, 199, 1000])
def test_producer_woken_very_late_does_not_catch_up_in_a_burst(late: int) -> None:
    """On a real clock a period may pass unserved: one message, and the next one period later."""
    producer = HeartbeatProducer(1)
    producer.start(0, 100 * MS)
    now = (100 + late) * MS
    producer.beat(now, NmtState.OPERATIONAL)
    assert producer.due == now + 100 * MS


# --- consumer ----------------------------------------------------------------------------------------------------


def test_consumer_waits_for_the_first_heartbeat() -> None:
    """Object 1016: monitoring starts with the first heartbeat, not before."""
    consumer = HeartbeatConsumer(127, 300 * MS)
    assert (consumer.deadline, consumer.lost) == (NEVER, False)


def test_consumer_can_watch_before_the_first_heartbeat() -> None:
    """A master that has started a device waits no longer for its first heartbeat than for any other."""
    consumer = HeartbeatConsumer(5, 300 * MS)
    consumer.watch(70 * MS)
    assert (consumer.deadline, consumer.lost) == (370 * MS, False)
    consumer.received(100 * MS, b"\5")
    assert consumer.deadline == 400 * MS


@pytest.mark.parametrize(("heard", "deadline"), [(0, 300), (69, 369), (70, 370)])
def test_watching_gives_no_respite_to_a_producer_heard_before(heard: int, deadline: int) -> None:
    """The time-out still counts from its last heartbeat."""
    consumer = HeartbeatConsumer(5, 300 * MS)
    consumer.received(heard * MS, b"\x7f")
    consumer.watch(70 * MS)
    assert consumer.deadline == deadline * MS


def test_watching_begins_anew_after_a_loss() -> None:
    """Lost before the start, and started all the same: it has the time-out to come back."""
    consumer = HeartbeatConsumer(5, 300 * MS)
    consumer.received(0, b"\x7f")
    consumer.lose()
    consumer.watch(500 * MS)
    assert (consumer.deadline, consumer.lost) == (800 * MS, True)
    assert consumer.received(600 * MS, b"\5")


@pytest.mark.parametrize("state", [0, 4, 5, 127])
def test_each_heartbeat_moves_the_deadline(state: int) -> None:
    """Object 1016: the time-out counts from the last heartbeat, whatever its state."""
    consumer = HeartbeatConsumer(127, 300 * MS)
    for now in (0, 100 * MS, 399 * MS):
        assert not consumer.received(now, bytes((state,)))
        assert (consumer.deadline, consumer.state) == (now + 300 * MS, state)


def test_toggle_bit_is_no_part_of_the_state() -> None:
    """CiA 301, 7.2.8.3.2: bit 7 belongs to node guarding."""
    consumer = HeartbeatConsumer(127, 300 * MS)
    consumer.received(0, b"\x85")
    assert consumer.state == 5


@pytest.mark.parametrize("data", [b"", b"\5\0", bytes(8)])
def test_message_of_another_length_is_no_heartbeat(data: bytes) -> None:
    """CiA 301, 7.2.8.3.2.2: one byte; anything else must not keep a dead node alive."""
    consumer = HeartbeatConsumer(127, 300 * MS)
    consumer.received(0, b"\5")
    assert not consumer.received(200 * MS, data)
    assert (consumer.deadline, consumer.state) == (300 * MS, 5)


def test_loss_is_noticed_once_and_ends_with_the_next_heartbeat() -> None:
    """The time-out passes once; the next heartbeat starts monitoring again and says so."""
    consumer = HeartbeatConsumer(127, 300 * MS)
    consumer.received(0, b"\5")
    consumer.lose()
    assert (consumer.lost, consumer.deadline) == (True, NEVER)
    assert consumer.received(900 * MS, b"\5")
    assert (consumer.lost, consumer.deadline) == (False, 1200 * MS)
    assert not consumer.received(1000 * MS, b"\5")


@given(messages=st.lists(st.binary(max_size=8), max_size=20))
def test_no_bytes_make_the_consumer_raise(messages: list[bytes]) -> None:
    """Style: bad bytes from the wire are data; only one-byte messages count."""
    consumer = HeartbeatConsumer(1, 10)
    for now, data in enumerate(messages):
        consumer.received(now, data)
    times = [now for now, data in enumerate(messages) if len(data) == 1]
    assert consumer.deadline == (times[-1] + 10 if times else NEVER)
