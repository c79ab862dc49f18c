"""Emergency messages: error register, history, inhibit time (CiA 301, 7.2.7; objects 1001, 1003, 1014, 1015)."""

import itertools
import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from canopen_exo.bus.node import MS, NEVER
from canopen_exo.emcy import (
    COMMUNICATION_BIT,
    GENERIC_BIT,
    HEARTBEAT_LOST,
    NO_ERROR,
    PDO_TOO_LONG,
    PDO_TOO_SHORT,
    QUEUE_LENGTH,
    RPDO_TIMEOUT,
    SYNC_LENGTH,
    SYNC_LOST,
    EmcyProducer,
    decode_emcy,
)

CURRENT, VOLTAGE, TEMPERATURE, PROFILE = 0x02, 0x04, 0x08, 0x20
"""CiA 301, object 1001: further bits of the error register."""


def sent(producer: EmcyProducer, now: int) -> list[tuple[int, int]]:
    """All messages that may go now: (code, error register)."""
    found = []
    while producer.due <= now:
        frame = producer.wake(now)
        assert frame is not None
        assert frame.can_id == 0x080 + producer.node_id
        code, register, rest = struct.unpack("<HB5s", frame.data)
        assert rest == bytes(5)
        found.append((code, register))
    return found


def test_codes_are_those_of_the_standards() -> None:
    """CiA 301, table 26, and CiA 402-2."""
    assert (NO_ERROR, PDO_TOO_SHORT, PDO_TOO_LONG, SYNC_LENGTH) == (0x0000, 0x8210, 0x8220, 0x8240)
    assert (HEARTBEAT_LOST, RPDO_TIMEOUT, SYNC_LOST) == (0x8130, 0x8250, 0x8700)
    assert (GENERIC_BIT, COMMUNICATION_BIT) == (0x01, 0x10)


@pytest.mark.parametrize(
    ("code", "bits", "register"),
    [
        (HEARTBEAT_LOST, COMMUNICATION_BIT, 0x11),
        (0x7305, PROFILE, 0x21),
        (0x2310, CURRENT, 0x03),
        (0x3210, VOLTAGE, 0x05),
        (0x4310, TEMPERATURE, 0x09),
    ],
)
def test_error_is_told_with_its_class_and_the_generic_bit(code: int, bits: int, register: int) -> None:
    """Device rules: code and error register of each kind of fault."""
    producer = EmcyProducer(5)
    assert producer.occur(code, bits)
    assert producer.register == register
    assert sent(producer, 0) == [(code, register)]


def test_error_that_stays_is_told_once() -> None:
    """CiA 301, 7.2.7.1: an emergency is sent once per error event."""
    producer = EmcyProducer(5)
    assert producer.occur(HEARTBEAT_LOST, COMMUNICATION_BIT)
    assert not producer.occur(HEARTBEAT_LOST, COMMUNICATION_BIT)
    assert sent(producer, 0) == [(HEARTBEAT_LOST, 0x11)]
    assert producer.history == [HEARTBEAT_LOST]


def test_register_collects_all_active_errors() -> None:
    """CiA 301, object 1001: one bit per class; each message shows the register as it was then."""
    producer = EmcyProducer(5)
    producer.occur(0x4310, TEMPERATURE)
    producer.occur(HEARTBEAT_LOST, COMMUNICATION_BIT)
    producer.occur(0x2310, CURRENT)
    assert sent(producer, 0) == [(0x4310, 0x09), (HEARTBEAT_LOST, 0x19), (0x2310, 0x1B)]
    producer.vanish(HEARTBEAT_LOST)
    assert producer.register == 0x0B


def test_no_error_is_told_when_the_last_one_is_gone() -> None:
    """CiA 301, 7.2.7.1: code 0000 and register 0 when all is well again, and only then."""
    producer = EmcyProducer(5)
    producer.occur(0x4310, TEMPERATURE)
    producer.occur(0x2310, CURRENT)
    sent(producer, 0)
    producer.vanish(0x4310)
    assert sent(producer, 0) == []
    producer.vanish(0x2310)
    assert sent(producer, 0) == [(NO_ERROR, 0x00)]
    assert producer.register == 0


def test_error_that_was_not_there_cannot_vanish() -> None:
    """No 0000 out of the blue."""
    producer = EmcyProducer(5)
    producer.vanish(0x2310)
    assert producer.due == NEVER


def test_clearing_tells_no_error_once() -> None:
    """Fault reset: all errors go at once; without errors there is nothing to tell."""
    producer = EmcyProducer(5)
    producer.clear()
    assert sent(producer, 0) == []
    producer.occur(0x4310, TEMPERATURE)
    producer.occur(0x2310, CURRENT)
    sent(producer, 0)
    producer.clear()
    assert sent(producer, 0) == [(NO_ERROR, 0x00)]


def test_error_that_comes_again_is_told_again() -> None:
    """After it was gone it is a new event."""
    producer = EmcyProducer(5)
    for _ in range(2):
        producer.occur(0x2310, CURRENT)
        producer.vanish(0x2310)
    assert sent(producer, 0) == [(0x2310, 0x03), (NO_ERROR, 0), (0x2310, 0x03), (NO_ERROR, 0)]


def test_history_has_the_newest_first_and_eight_at_most() -> None:
    """CiA 301, object 1003: sub-index 1 is the newest; 0000 is no error and is not kept."""
    producer = EmcyProducer(5)
    for code in range(0x1001, 0x100B):
        producer.occur(code, CURRENT)
    producer.clear()
    assert producer.history == [*range(0x100A, 0x1002, -1)]


# --- inhibit time ------------------------------------------------------------------------------------------------


def test_messages_keep_the_inhibit_time() -> None:
    """Object 1015: at least that long between two messages; the first one goes at once."""
    producer = EmcyProducer(5)
    producer.inhibit_ns = 10 * MS
    producer.occur(0x4310, TEMPERATURE)
    producer.occur(0x2310, CURRENT)
    assert sent(producer, 3 * MS) == [(0x4310, 0x09)]
    assert producer.due == 13 * MS
    assert producer.wake(13 * MS - 1) is None
    assert sent(producer, 13 * MS) == [(0x2310, 0x0B)]
    assert producer.due == NEVER
    producer.vanish(0x4310)
    producer.vanish(0x2310)
    assert producer.due == 23 * MS


def test_messages_follow_each_other_without_an_inhibit_time() -> None:
    """Object 1015 = 0: no waiting."""
    producer = EmcyProducer(5)
    for code in (0x1001, 0x1002, 0x1003):
        producer.occur(code, CURRENT)
    assert len(sent(producer, 0)) == 3


# --- a bounded queue ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("events", [1, 15, 16, 17, 18, 40, 1000])
def test_messages_that_wait_are_bounded_and_what_finds_no_room_is_counted(events: int) -> None:
    """A drive whose errors come and go faster than the inhibit time: 16 wait at most, the oldest; nothing grows."""
    producer = EmcyProducer(5)
    producer.inhibit_ns = 100 * MS
    for number in range(events):
        producer.occur(0x1000 + number, CURRENT)
    assert QUEUE_LENGTH == 16
    assert len(producer.queue) == min(events, 16)
    assert producer.dropped == max(0, events - 16)
    assert producer.register == 0x03  # the register knows of all of them
    told = [code for k in range(20) for code, _ in sent(producer, k * 100 * MS)]
    assert told == list(range(0x1000, 0x1000 + min(events, 16)))
    assert producer.due == NEVER


def test_queue_takes_messages_again_when_one_has_gone() -> None:
    """Room for one: the next event is told, the one after it is not."""
    producer = EmcyProducer(5)
    producer.inhibit_ns = 100 * MS
    for number in range(16):
        producer.occur(0x1000 + number, CURRENT)
    assert producer.wake(0) is not None
    producer.occur(0x2000, CURRENT)
    assert producer.dropped == 0
    producer.occur(0x2001, CURRENT)
    assert producer.dropped == 1
    told = [code for k in range(1, 30) for code, _ in sent(producer, k * 100 * MS)]
    assert told == [*range(0x1001, 0x1010), 0x2000]


def test_no_error_that_finds_no_room_is_dropped_and_counted_too() -> None:
    """Object 0x1001 still tells that all is well."""
    producer = EmcyProducer(5)
    producer.inhibit_ns = 100 * MS
    for number in range(16):
        producer.occur(0x1000 + number, CURRENT)
    producer.clear()
    assert (producer.dropped, producer.register) == (1, 0)
    assert NO_ERROR not in [code for k in range(20) for code, _ in sent(producer, k * 100 * MS)]


@pytest.mark.long
@given(
    inhibit=st.integers(0, 50),
    events=st.lists(st.tuples(st.integers(0, 30), st.integers(0, 3), st.booleans()), max_size=20)
    | st.lists(st.tuples(st.integers(0, 3), st.integers(0, 3), st.booleans()), min_size=20, max_size=60),
)
def test_every_event_is_told_in_order_and_in_time(inhibit: int, events: list[tuple[int, int, bool]]) -> None:
    """Whatever happens when: nothing is swapped, nothing lost but what finds 16 messages waiting, and two messages
    are never closer than the inhibit time."""
    producer = EmcyProducer(5)
    producer.inhibit_ns = inhibit
    now, active, times = 0, set[int](), list[int]()
    expected, found, lost = list[int](), list[int](), 0

    def serve(until: int) -> None:
        while producer.due <= until:
            at = max(producer.due, now)
            frame = producer.wake(at)
            assert frame is not None
            times.append(at)
            found.append(struct.unpack("<H", frame.data[:2])[0])

    for gap, number, occurs in events:
        serve(now + gap)
        now += gap
        code = 0x2000 + number
        if occurs:
            assert producer.occur(code, CURRENT) == (code not in active)
            told = [] if code in active else [code]
            active.add(code)
        else:
            producer.vanish(code)
            told = [NO_ERROR] if active == {code} else []
            active.discard(code)
        if len(expected) - len(found) < QUEUE_LENGTH:
            expected += told
        else:
            lost += len(told)
        assert len(producer.queue) <= QUEUE_LENGTH
    serve(now + 100 * (inhibit + 1))
    assert (found, producer.dropped) == (expected, lost)
    assert all(late - early >= inhibit for early, late in itertools.pairwise(times))


# --- consumer ----------------------------------------------------------------------------------------------------


def test_message_is_decoded() -> None:
    """CiA 301, 7.2.7.3.1: error code u16, error register u8, five bytes of the manufacturer."""
    found = decode_emcy(5, bytes.fromhex("3081110102030405"))
    assert found is not None
    assert (found.node_id, found.code, found.register) == (5, 0x8130, 0x11)


@given(data=st.binary(max_size=8))
def test_only_messages_of_eight_bytes_are_emergencies(data: bytes) -> None:
    """Style: bad bytes from the wire are data."""
    assert (decode_emcy(5, data) is not None) == (len(data) == 8)
