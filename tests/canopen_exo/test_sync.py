"""SYNC: the counter, and how a device checks and watches it (CiA 301, 7.2.5; object 1019)."""

from copy import deepcopy

import pytest
from hypothesis import given
from hypothesis import strategies as st

from canopen_exo.bus.node import MS, NEVER
from canopen_exo.sync import SyncCadence, SyncConsumer, SyncProducer

PERIOD = 2 * MS


# --- producer ----------------------------------------------------------------------------------------------------


def test_counter_wraps_from_240_to_1() -> None:
    """CiA 301, object 1019: the counter runs 1..overflow and never shows 0."""
    producer = SyncProducer(240)
    counters = [producer.next().data for _ in range(482)]
    assert counters == [bytes((number % 240 + 1,)) for number in range(482)]
    assert counters[239:241] == [b"\xf0", b"\x01"]


@pytest.mark.parametrize("overflow", [2, 3, 10, 239, 240])
def test_counter_wraps_at_every_overflow_value(overflow: int) -> None:
    """CiA 301, object 1019: 2..240; three rounds."""
    producer = SyncProducer(overflow)
    assert [producer.next().data[0] for _ in range(3 * overflow)] == [*range(1, overflow + 1)] * 3


def test_sync_without_counter_has_no_data() -> None:
    """CiA 301, object 1019: 0 is SYNC of length 0."""
    producer = SyncProducer(0)
    frames = [producer.next() for _ in range(3)]
    assert {(frame.can_id, frame.data, frame.flags) for frame in frames} == {(0x080, b"", 0)}


def test_sync_has_cob_id_80() -> None:
    """CiA 301, 7.3.5: predefined connection set."""
    assert SyncProducer(240).next().can_id == 0x080


# --- consumer ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("overflow", [0, 2, 240])
@pytest.mark.parametrize("size", range(9))
def test_length_must_fit_the_counter_setting(overflow: int, size: int) -> None:
    """CiA 301, 7.2.5: one byte with a counter, none without; else EMCY 8240 and no service."""
    consumer = SyncConsumer(overflow, 5 * PERIOD)
    fits = size == (1 if overflow else 0)
    assert consumer.received(0, bytes(size)) == fits
    assert (consumer.deadline != NEVER) == fits


def woken_through(consumer: SyncConsumer, until: int) -> list[int]:
    """Wake the consumer whenever it asks for it; the times at which it reported a loss."""
    losses = []
    while consumer.deadline <= until:
        now = consumer.deadline
        if consumer.wake(now):
            losses.append(now)
        assert consumer.deadline > now
    return losses


@pytest.mark.parametrize("count", [1, 2, 3, 5, 6, 7, 50])
def test_loss_is_reported_exactly_the_time_out_after_the_last_sync(count: int) -> None:
    """Design: SYNC loss after 5 cycles, to the nanosecond, however many came before."""
    consumer = SyncConsumer(0, 5 * PERIOD)
    last = 0
    for number in range(count):
        last = 123 + number * PERIOD
        assert woken_through(consumer, last - 1) == []
        consumer.received(last, b"")
    assert woken_through(consumer, last + 5 * PERIOD - 1) == []
    assert not consumer.lost
    assert woken_through(consumer, last + 100 * PERIOD) == [last + 5 * PERIOD]
    assert consumer.lost


def test_sync_at_the_last_moment_prevents_the_loss() -> None:
    """Loop order: the frame comes before the wake-up of the same instant."""
    consumer = SyncConsumer(0, 5 * PERIOD)
    consumer.received(0, b"")
    consumer.received(5 * PERIOD, b"")
    assert woken_through(consumer, 10 * PERIOD - 1) == []
    assert woken_through(consumer, 10 * PERIOD) == [10 * PERIOD]


def test_watching_starts_with_the_first_sync() -> None:
    """A device started before its master's SYNC is not at fault."""
    assert SyncConsumer(0, 5 * PERIOD).deadline == NEVER


def test_sync_that_comes_back_is_watched_again() -> None:
    """After a loss the next SYNC ends it and starts a new watch."""
    consumer = SyncConsumer(0, 5 * PERIOD)
    consumer.received(0, b"")
    assert woken_through(consumer, 100 * PERIOD) == [5 * PERIOD]
    assert consumer.received(100 * PERIOD, b"")
    assert not consumer.lost
    assert woken_through(consumer, 200 * PERIOD) == [105 * PERIOD]


def test_sync_of_the_wrong_length_does_not_end_a_loss() -> None:
    """It is not served, so it is not a SYNC that came back."""
    consumer = SyncConsumer(0, 5 * PERIOD)
    consumer.received(0, b"")
    woken_through(consumer, 100 * PERIOD)
    assert not consumer.received(100 * PERIOD, b"\1")
    assert consumer.lost


def test_stopped_consumer_watches_no_more() -> None:
    """A device that leaves Operational does not wait for SYNC."""
    consumer = SyncConsumer(0, 5 * PERIOD)
    consumer.received(0, b"")
    consumer.stop()
    assert woken_through(consumer, 100 * PERIOD) == []
    assert not consumer.lost


def test_nothing_is_watched_without_a_period() -> None:
    """Object 1006 = 0: the period is not known, so no SYNC can be late."""
    consumer = SyncConsumer(0, 0)
    assert consumer.received(0, b"")
    assert consumer.deadline == NEVER


@given(gaps=st.lists(st.integers(1, 20 * MS), min_size=1, max_size=30))
def test_losses_are_the_gaps_longer_than_the_time_out(gaps: list[int]) -> None:
    """Against the plain rule, for any times of SYNC: a gap of more than 5 periods is one loss, at its 5th period."""
    consumer = SyncConsumer(240, 5 * PERIOD)
    now, losses, expected = 0, [], []
    consumer.received(now, b"\1")
    for gap in gaps:
        if gap > 5 * PERIOD:
            expected.append(now + 5 * PERIOD)
        now += gap
        losses += woken_through(consumer, now - 1)
        consumer.received(now, b"\1")
    assert losses == expected


# --- how often it comes ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("told_ms", range(1, 21))
@pytest.mark.parametrize("real_ms", range(1, 21))
def test_another_rate_than_was_told_shows_within_five_seconds(told_ms: int, real_ms: int) -> None:
    """Processes of a rig that were told different rates: any two of the rates there are."""
    cadence = SyncCadence(told_ms * MS)
    for now in range(7 * MS, 5_000 * MS, real_ms * MS):
        cadence.received(now)
    assert cadence.other_ns == (0 if told_ms == real_ms else real_ms * MS)
    assert (f"SYNC comes every {real_ms:.2f} ms, rig.rate here says {told_ms} ms" in cadence.words()) == (
        told_ms != real_ms
    )


def test_late_lost_and_missing_sync_is_no_other_rate() -> None:
    """A machine that stands still for 150 ms, SYNC that is lost here and there, a controller that starts again."""
    cadence = SyncCadence(2 * MS)
    for number in range(1000):
        if number % 100 != 50:
            cadence.received(number * 2 * MS + (150 * MS if 200 <= number < 275 else 0))
        assert cadence.other_ns == 0
    for number in range(1000):
        cadence.received(3_456 * MS + number * 2 * MS)
        assert cadence.other_ns == 0


def test_cadence_that_is_copied_goes_on_as_the_original() -> None:
    """Snapshots copy it in mid-run."""
    cadence = SyncCadence(2 * MS)
    for number in range(50):
        cadence.received(number * 10 * MS)
    twin = deepcopy(cadence)
    cadence.received(500 * MS)
    twin.received(500 * MS)
    assert twin.other_ns == cadence.other_ns == 10 * MS
    assert twin.last == cadence.last == 500 * MS
