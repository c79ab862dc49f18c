"""A CANopen device: time-outs."""

import pytest

from canopen_exo.bus.node import MS
from canopen_exo.nmt import NmtState
from tests.canopen_exo.device_under_test import (
    MODE,
    PERIOD,
    PRE,
    RPDO1,
    RPDO2,
    START,
    STOP,
    SYNC,
    TOO_HIGH,
    Bench,
    booted,
    in_state,
    operational,
)

# --- time-outs ---------------------------------------------------------------------------------------------------


def test_rpdo_deadline_is_reported_exactly_when_it_passes() -> None:
    """14xx:5 (20 ms); device rules: 8250, register 11, reaction of 6007, to the nanosecond; then 0000."""
    bench = booted()
    assert bench.write(0x1400, 5, 20, 2) == 0
    bench.nmt(START)
    bench.hear(11 * MS, RPDO1, bytes(4))
    bench.hear(13 * MS + 1, RPDO1, bytes(4))
    bench.run(33 * MS)
    assert bench.emergencies() == []
    bench.run(33 * MS + 1)
    assert bench.emergencies() == [(33 * MS + 1, 0x8250, 0x11)]
    assert bench.application.calls("lost") == [(33 * MS + 1, 0x8250)]
    assert bench.read(0x1001) == 0x11
    bench.run(90 * MS)
    assert len(bench.emergencies()) == 1
    bench.hear(91 * MS, RPDO1, bytes(4))
    assert bench.emergencies()[1:] == [(91 * MS, 0x0000, 0x00)]
    assert bench.read(0x1001) == 0


def test_rpdo_at_the_last_moment_is_in_time() -> None:
    """Loop order: frame before wake-up at the same nanosecond."""
    bench = booted()
    bench.write(0x1400, 5, 20, 2)
    bench.nmt(START)
    bench.hear(11 * MS, RPDO1, bytes(4))
    bench.hear(31 * MS, RPDO1, bytes(4))
    bench.run(51 * MS - 1)
    assert bench.emergencies() == []
    bench.run(51 * MS)
    assert bench.emergencies() == [(51 * MS, 0x8250, 0x11)]


def test_short_rpdo_does_not_end_the_loss() -> None:
    """A PDO that is not processed is no sign of life."""
    bench = booted()
    bench.write(0x1400, 5, 20, 2)
    bench.nmt(START)
    bench.hear(11 * MS, RPDO1, bytes(4))
    bench.run(40 * MS)
    bench.hear(41 * MS, RPDO1, bytes(2))
    assert 0x0000 not in [code for _, code, _ in bench.emergencies()]
    assert bench.read(0x1001) == 0x11


def test_one_of_two_late_rpdos_that_comes_back_is_not_all_well() -> None:
    """0000 only when the last error is gone."""
    bench = booted()
    bench.map(0x1401, RPDO2, 1, MODE)
    bench.write(0x1400, 5, 20, 2)
    bench.write(0x1401, 5, 30, 2)
    bench.nmt(START)
    bench.hear(11 * MS, RPDO1, bytes(4))
    bench.hear(11 * MS, RPDO2, b"\x0a")
    bench.run(60 * MS)
    assert bench.application.calls("lost") == [(31 * MS, 0x8250), (41 * MS, 0x8250)]
    bench.hear(61 * MS, RPDO1, bytes(4))
    assert bench.read(0x1001) == 0x11
    bench.hear(62 * MS, RPDO2, b"\x0a")
    assert bench.emergencies() == [(31 * MS, 0x8250, 0x11), (62 * MS, 0x0000, 0x00)]


def with_sync_watch(period_us: int = 2000) -> Bench:
    bench = booted()
    assert bench.write(0x1006, 0, period_us, 4) == 0
    bench.nmt(START)
    bench.sent.clear()
    bench.application.log.clear()
    return bench


@pytest.mark.parametrize("count", [1, 2, 7])
def test_sync_loss_is_reported_after_exactly_five_periods(count: int) -> None:
    """Design: SYNC loss after 5 cycles; device rules: 8700, register 11, reaction of 6007."""
    bench = with_sync_watch()
    last = 0
    for number in range(count):
        last = 12 * MS + number * PERIOD + 3
        bench.sync(last, number + 1)
    bench.run(last + 5 * PERIOD - 1)
    assert bench.emergencies() == []
    bench.run(last + 5 * PERIOD)
    assert bench.emergencies() == [(last + 5 * PERIOD, 0x8700, 0x11)]
    assert bench.application.calls("lost") == [(last + 5 * PERIOD, 0x8700)]
    bench.run(last + 100 * PERIOD)
    assert len(bench.emergencies()) == 1


def test_sync_that_comes_back_is_told_at_once() -> None:
    """0000 with the SYNC that ends the loss; object 1001 is clear again; the next loss is reported again."""
    bench = with_sync_watch()
    bench.sync(12 * MS, 1)
    bench.sync(40 * MS, 2)
    bench.run(49 * MS)
    assert bench.emergencies() == [(22 * MS, 0x8700, 0x11), (40 * MS, 0x0000, 0x00)]
    assert bench.read(0x1001) == 0
    bench.run(60 * MS)
    assert bench.emergencies()[2:] == [(50 * MS, 0x8700, 0x11)]


def test_sync_of_the_wrong_length_does_not_end_the_loss() -> None:
    """It is not served: the loss goes on, and no 0000 is sent."""
    bench = with_sync_watch()
    bench.sync(12 * MS, 1)
    bench.run(30 * MS)
    bench.hear(31 * MS, SYNC, b"")
    assert [code for _, code, _ in bench.emergencies()] == [0x8700, 0x8240]
    assert bench.read(0x1001) == 0x11


def test_sync_loss_is_reported_again_after_a_stop_and_a_start() -> None:
    """With 1029:1 = 0 the loss itself ends Operational; a later loss must not be hidden by the earlier one."""
    bench = with_sync_watch()
    assert bench.write(0x1029, 1, 0, 1) == 0
    bench.sync(12 * MS, 1)
    bench.run(30 * MS)
    assert bench.device.nmt.state is NmtState.PRE_OPERATIONAL
    bench.nmt(START)
    bench.sync(32 * MS, 1)
    assert bench.emergencies() == [(22 * MS, 0x8700, 0x11), (32 * MS, 0x0000, 0x00)]
    bench.run(60 * MS)
    assert bench.emergencies()[2:] == [(42 * MS, 0x8700, 0x11)]


def test_no_sync_loss_without_a_period() -> None:
    """Object 1006 = 0: unknown period, nothing to miss."""
    bench = operational()
    bench.sync(12 * MS)
    bench.run(1000 * MS)
    assert bench.emergencies() == []


def test_device_that_left_operational_waits_for_nothing() -> None:
    """SYNC and RPDO deadlines end with Operational."""
    bench = with_sync_watch()
    bench.write(0x1400, 5, 20, 2)
    bench.sync(12 * MS)
    bench.hear(12 * MS, RPDO1, bytes(4))
    bench.nmt(PRE)
    bench.run(1000 * MS)
    assert bench.emergencies() == []


@pytest.mark.parametrize("state", [NmtState.PRE_OPERATIONAL, NmtState.OPERATIONAL])
def test_heartbeat_loss_is_reported_exactly_after_the_time_out(state: NmtState) -> None:
    """Object 1016 (300 ms); device rules: 8130, register 11; from the first heartbeat on, in any state."""
    bench = in_state(state)
    assert bench.write(0x1016, 1, 127 << 16 | 300, 4) == 0
    bench.run(500 * MS)
    assert bench.emergencies() == []
    bench.hear(510 * MS, 0x77F, b"\5")
    bench.hear(600 * MS + 7, 0x77F, b"\5")
    bench.run(900 * MS + 6)
    assert bench.emergencies() == []
    bench.run(900 * MS + 7)
    assert bench.emergencies() == [(900 * MS + 7, 0x8130, 0x11)]
    assert bench.application.calls("lost") == [(900 * MS + 7, 0x8130)]
    bench.hear(1000 * MS, 0x77F, b"\5")
    assert bench.emergencies()[1:] == [(1000 * MS, 0x0000, 0x00)]


def test_heartbeats_of_others_do_not_count() -> None:
    """Only the node of the entry is watched."""
    bench = booted()
    bench.write(0x1016, 1, 127 << 16 | 300, 4)
    bench.hear(20 * MS, 0x77F, b"\5")
    for now in range(30, 320, 10):
        bench.hear(now * MS, 0x701, b"\5")
    bench.run(320 * MS)
    assert bench.emergencies() == [(320 * MS, 0x8130, 0x11)]


def test_one_of_two_lost_producers_that_comes_back_is_not_all_well() -> None:
    """0000 only when the last error is gone."""
    bench = booted()
    bench.write(0x1016, 1, 127 << 16 | 300, 4)
    bench.write(0x1016, 2, 126 << 16 | 300, 4)
    bench.hear(20 * MS, 0x77F, b"\5")
    bench.hear(20 * MS, 0x77E, b"\5")
    bench.run(400 * MS)
    bench.hear(410 * MS, 0x77F, b"\5")
    assert bench.read(0x1001) == 0x11
    bench.hear(420 * MS, 0x77E, b"\5")
    assert bench.emergencies() == [(320 * MS, 0x8130, 0x11), (420 * MS, 0x0000, 0x00)]


@pytest.mark.parametrize("state", [NmtState.PRE_OPERATIONAL, NmtState.OPERATIONAL])
@pytest.mark.parametrize("behaviour", [0, 1, 2])
def test_error_behaviour_is_that_of_object_1029(state: NmtState, behaviour: int) -> None:
    """CiA 301, object 1029:1: 0 Pre-operational (if Operational), 1 no change, 2 Stopped; the EMCY comes first."""
    bench = in_state(state)
    bench.write(0x1016, 1, 127 << 16 | 300, 4)
    assert bench.write(0x1029, 1, behaviour, 1) == 0
    bench.hear(20 * MS, 0x77F, b"\5")
    bench.run(1000 * MS)
    after = {0: NmtState.PRE_OPERATIONAL, 1: state, 2: NmtState.STOPPED}[behaviour]
    assert bench.device.nmt.state is after
    assert bench.emergencies() == [(320 * MS, 0x8130, 0x11)]
    assert bench.application.calls("lost") == [(320 * MS, 0x8130)]


@pytest.mark.parametrize("behaviour", [0, 1, 2])
def test_error_behaviour_does_not_lead_out_of_stopped(behaviour: int) -> None:
    """CiA 301, object 1029:1: Pre-operational only from Operational; the EMCY waits until it may be sent."""
    bench = booted()
    bench.write(0x1016, 1, 127 << 16 | 300, 4)
    bench.write(0x1029, 1, behaviour, 1)
    bench.hear(20 * MS, 0x77F, b"\5")
    bench.nmt(STOP)
    bench.run(1000 * MS)
    assert (bench.device.nmt.state, bench.emergencies()) == (NmtState.STOPPED, [])
    bench.nmt(PRE)
    assert bench.emergencies() == [(1000 * MS, 0x8130, 0x11)]


def test_error_behaviour_has_three_values() -> None:
    """CiA 301, object 1029: 3 is reserved."""
    assert booted().write(0x1029, 1, 3, 1) == TOO_HIGH
