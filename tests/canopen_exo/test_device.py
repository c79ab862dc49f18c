"""A whole device through receive() and wake(): services per state, resets, errors, configuration over SDO."""

import struct

import pytest

from canopen_exo.bus.frame import FLAG_EXTENDED, FLAG_FD, FLAG_REMOTE, Frame
from canopen_exo.bus.node import MS, NEVER
from canopen_exo.device import BOOT_NS
from canopen_exo.nmt import NmtState
from tests.canopen_exo.device_under_test import (
    BOOT,
    CONTROLWORD,
    EMCY,
    HEARTBEAT,
    MODE,
    NMT,
    NODE,
    PERIOD,
    PRE,
    REQUEST,
    RESET_COMMUNICATION,
    RESET_NODE,
    RPDO1,
    RPDO2,
    START,
    STATES,
    STOP,
    SYNC,
    TARGET_TORQUE,
    TPDO1,
    TPDO2,
    Bench,
    booted,
    in_state,
    operational,
)

# --- boot-up and heartbeat ---------------------------------------------------------------------------------------


def test_device_sends_nothing_but_its_boot_up_message_at_first() -> None:
    """CiA 301, 7.3.2.2.1: Initialising ends with the boot-up message, then Pre-operational."""
    bench = Bench()
    bench.run(BOOT - 1)
    assert (bench.sent, bench.device.nmt.state) == ([], NmtState.INITIALISING)
    bench.run(BOOT)
    assert bench.of(HEARTBEAT) == [(BOOT, b"\0")]
    assert bench.device.nmt.state is NmtState.PRE_OPERATIONAL
    assert BOOT_NS == BOOT


def test_heartbeat_follows_every_period_with_the_state() -> None:
    """Object 1017 (100 ms): counted from the boot-up; the state byte is that of the time."""
    bench = Bench().run(BOOT + 150 * MS)
    bench.nmt(START)
    bench.run(BOOT + 250 * MS)
    bench.nmt(STOP)
    bench.run(BOOT + 300 * MS)
    assert bench.of(HEARTBEAT) == [
        (BOOT, b"\0"),
        (BOOT + 100 * MS, b"\x7f"),
        (BOOT + 200 * MS, b"\x05"),
        (BOOT + 300 * MS, b"\x04"),
    ]


@pytest.mark.parametrize(("period_ms", "times"), [(50, [60, 110]), (1, list(range(11, 111))), (0, [])])
def test_heartbeat_period_can_be_written(period_ms: int, times: list[int]) -> None:
    """Object 1017: acts at once; 0 switches it off."""
    bench = booted()
    bench.sent.clear()
    assert bench.write(0x1017, 0, period_ms, 2) == 0
    bench.run(110 * MS)
    assert [now for now, _ in bench.of(HEARTBEAT)] == [time * MS for time in times]


def test_device_sleeps_when_there_is_nothing_to_do() -> None:
    """`wake_at` is NEVER without a timer."""
    bench = booted()
    bench.write(0x1017, 0, 0, 2)
    assert bench.device.wake_at == NEVER


# --- services per NMT state --------------------------------------------------------------------------------------


@pytest.mark.parametrize("state", STATES)
def test_sdo_is_answered_where_the_table_allows(state: NmtState) -> None:
    """CiA 301, table 38: SDO in Pre-operational and Operational; no answer in Stopped or Initialising."""
    answers = state in (NmtState.PRE_OPERATIONAL, NmtState.OPERATIONAL)
    bench = in_state(state)
    assert len(bench.hear(bench.now, REQUEST, b"\x40\x00\x10\x00\0\0\0\0")) == answers


@pytest.mark.parametrize("state", STATES)
def test_process_data_is_served_in_operational_only(state: NmtState) -> None:
    """CiA 301, table 38: PDO and SYNC'd PDO only in Operational."""
    bench = in_state(state)
    bench.hear(bench.now, RPDO1, struct.pack("<Hh", 6, 100))
    sent = bench.sync(bench.now, 5)
    served = state is NmtState.OPERATIONAL
    assert [frame.can_id for frame in sent] == ([TPDO1, TPDO2] if served else [])
    assert bench.od.value(0x607100) == (100 if served else 0)
    assert [called for _, called, _ in bench.application.log] == (["applied", "latch"] if served else [])


@pytest.mark.parametrize("before", STATES)
@pytest.mark.parametrize("command", [START, STOP, PRE, RESET_NODE, RESET_COMMUNICATION])
def test_nmt_command_is_served_in_every_state_but_initialising(before: NmtState, command: int) -> None:
    """CiA 301, figure 46; addressed to this node, to all, and to another."""
    after = {START: 5, STOP: 4, PRE: 127, RESET_NODE: 0, RESET_COMMUNICATION: 0}[command]
    for address in (NODE, 0, NODE + 1):
        bench = in_state(before)
        bench.hear(bench.now, NMT, bytes((command, address)))
        moves = before is not NmtState.INITIALISING and address != NODE + 1
        assert bench.device.nmt.state is (NmtState(after) if moves else before)


@pytest.mark.parametrize("data", [b"", b"\1", b"\1\5\0"])
def test_malformed_nmt_messages_are_counted(data: bytes) -> None:
    """Style: bad bytes from the wire are data: counted, no effect."""
    bench = booted()
    bench.hear(bench.now, NMT, data)
    assert (bench.device.malformed, bench.device.nmt.state) == (1, NmtState.PRE_OPERATIONAL)


@pytest.mark.parametrize("state", STATES)
def test_emergency_is_sent_where_the_table_allows(state: NmtState) -> None:
    """CiA 301, table 38: EMCY in Pre-operational and Operational; else it waits for one of them."""
    bench = in_state(state)
    bench.device.error(bench.now, 0x2310, 0x02, bench)
    allowed = state in (NmtState.PRE_OPERATIONAL, NmtState.OPERATIONAL)
    assert bench.emergencies() == ([(bench.now, 0x2310, 0x03)] if allowed else [])
    bench.run(bench.now + 50 * MS)
    if state is NmtState.STOPPED:
        assert bench.emergencies() == []
        bench.nmt(PRE)
        assert bench.emergencies() == [(bench.now, 0x2310, 0x03)]
    if state is NmtState.INITIALISING:
        assert bench.emergencies() == [(BOOT, 0x2310, 0x03)]


@pytest.mark.parametrize("flags", [FLAG_EXTENDED, FLAG_REMOTE, FLAG_FD, FLAG_EXTENDED | FLAG_REMOTE])
def test_frames_of_other_kinds_are_passed_over(flags: int) -> None:
    """11-bit data frames only: an extended id that looks like NMT, SYNC, SDO or RPDO is another's."""
    bench = operational()
    for can_id, data in ((NMT, b"\x81\0"), (SYNC, b"\1"), (REQUEST, b"\x40" + bytes(7)), (RPDO1, bytes(4))):
        assert bench.hear(bench.now, can_id, b"" if flags & FLAG_REMOTE else data, flags) == []
    assert (bench.device.operational, bench.application.log) == (True, [])


def test_device_names_the_ids_it_listens_to() -> None:
    """For acceptance filters: NMT, SYNC, SDO request, RPDOs that exist, consumed heartbeats."""
    bench = booted()
    assert sorted(bench.device.cob_ids()) == [NMT, SYNC, RPDO1, REQUEST]
    revision = bench.device.revision
    bench.map(0x1401, 0x355, 255, MODE)
    bench.write(0x1016, 1, 127 << 16 | 300, 4)
    assert sorted(bench.device.cob_ids()) == [NMT, SYNC, RPDO1, 0x355, REQUEST, 0x77F]
    assert bench.device.revision > revision


# --- SYNC and PDO ------------------------------------------------------------------------------------------------


def test_sync_applies_then_latches_then_sends() -> None:
    """Design, one control cycle: apply the RPDO values received since the last SYNC, latch, then TPDO bytes."""
    bench = operational()
    bench.hear(11 * MS, RPDO1, struct.pack("<Hh", 15, -321))
    assert bench.application.log == []
    sent = bench.sync(12 * MS, 1)
    assert bench.application.log == [(12 * MS, "applied", -321), (12 * MS, "latch", 1)]
    assert sent == [Frame(TPDO1, struct.pack("<ii", 1, 0))]
    bench.sync(14 * MS, 2)
    assert bench.application.calls("applied") == [(12 * MS, -321)]
    assert bench.of(TPDO1)[-1] == (14 * MS, struct.pack("<ii", 2, 0))


def test_rpdo_that_comes_after_sync_counts_for_the_next_one() -> None:
    """CiA 301, 14xx:2, synchronous types."""
    bench = operational()
    bench.sync(12 * MS)
    bench.hear(12 * MS + 1, RPDO1, struct.pack("<Hh", 0, 5))
    assert bench.application.calls("applied") == []
    bench.sync(14 * MS)
    assert bench.application.calls("applied") == [(14 * MS, 5)]


@pytest.mark.parametrize("kind", [254, 255])
def test_event_driven_rpdo_is_applied_at_once(kind: int) -> None:
    """CiA 301, 14xx:2 = 254, 255: without SYNC."""
    bench = booted()
    bench.map(0x1400, RPDO1, kind, CONTROLWORD, TARGET_TORQUE)
    bench.nmt(START)
    bench.hear(11 * MS, RPDO1, struct.pack("<Hh", 0, 7))
    assert bench.application.calls("applied") == [(11 * MS, 7)]


@pytest.mark.parametrize("kind", [1, 255])
def test_value_received_before_the_start_is_not_applied(kind: int) -> None:
    """CiA 301, table 38: no PDO in Pre-operational, neither at once nor with the first SYNC after the start."""
    bench = booted()
    bench.map(0x1400, RPDO1, kind, CONTROLWORD, TARGET_TORQUE)
    bench.hear(11 * MS, RPDO1, struct.pack("<Hh", 15, 99))
    bench.nmt(START)
    bench.sync(12 * MS)
    assert (bench.application.calls("applied"), bench.od.value(0x607100)) == ([], 0)


def test_pending_value_is_forgotten_on_leaving_operational() -> None:
    """What was received before must not act after the next start."""
    bench = operational()
    bench.hear(11 * MS, RPDO1, struct.pack("<Hh", 15, 99))
    bench.nmt(PRE)
    bench.nmt(START)
    bench.sync(12 * MS)
    assert bench.application.calls("applied") == []


def test_tpdo_counting_starts_with_operational() -> None:
    """Entering Operational: TPDO2 waits for its start value again, then every tenth SYNC."""
    bench = operational()
    for number in range(30):
        bench.sync((12 + 2 * number) * MS, number + 1)
    assert [(now - 12 * MS) // PERIOD + 1 for now, _ in bench.of(TPDO2)] == [5, 15, 25]
    bench.nmt(PRE)
    bench.nmt(START)
    bench.sent.clear()
    for number in range(30, 300):
        bench.sync((12 + 2 * number) * MS, number % 240 + 1)
    assert (bench.of(TPDO2)[0][0] - 12 * MS) // PERIOD + 1 == 245  # counter 5 of the second round


def test_start_in_operational_changes_nothing() -> None:
    """NMT start is no event in Operational: the count goes on."""
    bench = operational()
    for number in range(30):
        bench.sync((12 + 2 * number) * MS, number + 1)
        bench.nmt(START)
    assert [(now - 12 * MS) // PERIOD + 1 for now, _ in bench.of(TPDO2)] == [5, 15, 25]
    assert bench.application.calls("left") == []


@pytest.mark.parametrize(("command", "before", "left"), [
    (STOP, NmtState.OPERATIONAL, True),
    (PRE, NmtState.OPERATIONAL, True),
    (RESET_NODE, NmtState.OPERATIONAL, True),
    (RESET_COMMUNICATION, NmtState.OPERATIONAL, True),
    (START, NmtState.OPERATIONAL, False),
    (STOP, NmtState.PRE_OPERATIONAL, False),
    (PRE, NmtState.STOPPED, False),
    (RESET_NODE, NmtState.PRE_OPERATIONAL, False),
])  # fmt: skip
def test_application_is_told_when_process_data_ends(command: int, before: NmtState, left: bool) -> None:
    """`left_operational`: once, on the way out of Operational."""
    bench = in_state(before)
    bench.nmt(command)
    assert bench.application.calls("left") == ([(bench.now, 0)] if left else [])


@pytest.mark.parametrize("size", [0, 2, 8])
def test_sync_of_the_wrong_length_is_not_served(size: int) -> None:
    """CiA 301, 7.2.5; device rules: EMCY 8240 with register 11, no reaction."""
    bench = operational()
    bench.hear(11 * MS, RPDO1, struct.pack("<Hh", 15, 99))
    sent = bench.hear(12 * MS, SYNC, bytes(size))
    assert [frame.can_id for frame in sent] == [EMCY]
    assert bench.emergencies() == [(12 * MS, 0x8240, 0x11)]
    assert bench.application.log == []


def test_sync_without_counter_is_served_when_configured() -> None:
    """Object 1019 = 0: SYNC has no data, and one byte is wrong."""
    bench = booted()
    assert bench.write(0x1019, 0, 0, 1) == 0
    bench.nmt(START)
    assert [frame.can_id for frame in bench.hear(12 * MS, SYNC, b"")] == [TPDO1]
    assert [frame.can_id for frame in bench.sync(14 * MS)] == [EMCY]


@pytest.mark.parametrize(("size", "code", "applied"), [(0, 0x8210, 0), (3, 0x8210, 0), (5, 0x8220, 1), (8, 0x8220, 1)])
def test_rpdo_of_the_wrong_length_is_reported(size: int, code: int, applied: int) -> None:
    """Device rules: 8210 not processed, 8220 processed; register 11, no reaction."""
    bench = operational()
    bench.hear(11 * MS, RPDO1, bytes(size))
    assert bench.emergencies() == [(11 * MS, code, 0x11)]
    bench.sync(12 * MS)
    assert len(bench.application.calls("applied")) == applied
    assert bench.application.calls("lost") == []


@pytest.mark.parametrize(("can_id", "wrong", "right", "code"), [
    (RPDO1, bytes(3), bytes(4), 0x8210),
    (RPDO1, bytes(5), bytes(4), 0x8220),
    (SYNC, b"", b"\1", 0x8240),
])  # fmt: skip
def test_error_of_a_wrong_length_ends_with_the_right_one(can_id: int, wrong: bytes, right: bytes, code: int) -> None:
    """CiA 301, 7.2.7.1: told once while it lasts, 0000 when all is well again, and told anew the next time."""
    bench = operational()
    for now, data in ((11, wrong), (12, wrong), (13, right), (14, right), (15, wrong)):
        bench.hear(now * MS, can_id, data)
        assert bench.read(0x1001) == (0x11 if data == wrong else 0)
    assert bench.emergencies() == [(11 * MS, code, 0x11), (13 * MS, 0x0000, 0x00), (15 * MS, code, 0x11)]


def test_good_rpdo_does_not_end_the_error_of_another() -> None:
    """0000 only when the last error is gone: each RPDO answers for itself."""
    bench = booted()
    bench.map(0x1401, RPDO2, 1, MODE)
    bench.nmt(START)
    bench.hear(11 * MS, RPDO1, b"\0")
    bench.hear(12 * MS, RPDO2, b"\x0a")
    bench.hear(13 * MS, RPDO1, b"\0")
    assert bench.emergencies() == [(11 * MS, 0x8210, 0x11)]
    bench.hear(14 * MS, RPDO1, bytes(4))
    assert bench.emergencies()[1:] == [(14 * MS, 0x0000, 0x00)]


def test_rpdo_may_change_from_too_short_to_too_long() -> None:
    """Two errors of one PDO: the new one is told, the old one is gone, and 0000 comes after both."""
    bench = operational()
    for now, size in ((11, 3), (12, 5), (13, 4)):
        bench.hear(now * MS, RPDO1, bytes(size))
    assert [item[1:] for item in bench.emergencies()] == [(0x8210, 0x11), (0x8220, 0x11), (0x0000, 0x00)]
