"""A CANopen device: errors and resets."""

import struct

import pytest

from canopen_exo.bus.frame import Frame
from canopen_exo.bus.node import MS
from canopen_exo.nmt import NmtState
from tests.canopen_exo.device_under_test import (
    ANSWER,
    HEARTBEAT,
    POSITION,
    PRE,
    REQUEST,
    RESET_COMMUNICATION,
    RESET_NODE,
    RPDO1,
    START,
    STATUSWORD,
    STOP,
    SYNC,
    TIMED_OUT,
    TPDO1,
    VALUE,
    booted,
    in_state,
    operational,
)

# --- errors ------------------------------------------------------------------------------------------------------


def test_error_of_the_application_shows_everywhere() -> None:
    """EMCY, object 1001 and history 1003; then 0000 on clearing."""
    bench = booted()
    bench.device.error(11 * MS, 0x2310, 0x02, bench)
    bench.device.error(11 * MS, 0x7305, 0x20, bench)
    bench.device.error(11 * MS, 0x2310, 0x02, bench)
    assert [item[1:] for item in bench.emergencies()] == [(0x2310, 0x03), (0x7305, 0x23)]
    assert [bench.read(0x1003, sub) for sub in (0, 1, 2)] == [2, 0x7305, 0x2310]
    assert bench.read(0x1001) == 0x23
    bench.device.clear_errors(12 * MS, bench)
    assert bench.emergencies()[2:][0][1:] == (0x0000, 0x00)
    assert bench.read(0x1001) == 0
    assert bench.read(0x1003, 0) == 2  # the history stays


def test_application_is_told_once_when_the_last_error_is_gone() -> None:
    """Of two errors the first one that goes is no news; EMCY 0000 is."""
    bench = operational()
    bench.hear(11 * MS, RPDO1, bytes(3))
    bench.hear(12 * MS, SYNC, b"")
    bench.sync(13 * MS)
    assert (bench.read(0x1001), bench.application.calls("gone")) == (0x11, [])
    bench.hear(14 * MS, RPDO1, bytes(4))
    assert (bench.read(0x1001), len(bench.application.calls("gone"))) == (0, 1)
    bench.sync(15 * MS)
    bench.run(100 * MS)
    assert len(bench.application.calls("gone")) == 1


def test_application_is_not_told_of_the_end_of_errors_that_were_not_there() -> None:
    """Boot, start, process data: nothing was wrong."""
    bench = booted()
    bench.nmt(START)
    for now in range(12, 40, 2):
        bench.hear(now * MS - 1, RPDO1, bytes(4))
        bench.sync(now * MS)
    assert bench.application.calls("gone") == []


@pytest.mark.parametrize("how", ["clear", RESET_NODE, RESET_COMMUNICATION])
def test_application_is_told_when_errors_are_cleared_or_forgotten(how: str | int) -> None:
    """Fault reset and both NMT resets end every error, so none may stay in the application's objects."""
    bench = booted()
    bench.device.error(11 * MS, 0x2310, 0x02, bench)
    bench.application.log.clear()
    if isinstance(how, str):
        bench.device.clear_errors(12 * MS, bench)
    else:
        bench.nmt(how)
    assert len(bench.application.calls("gone")) == 1


def test_error_that_ends_while_nothing_may_be_sent_is_told_afterwards() -> None:
    """CiA 301, table 38: no EMCY in Stopped; register, history and application follow with the messages."""
    bench = booted()
    bench.write(0x1016, 1, 127 << 16 | 300, 4)
    bench.hear(20 * MS, 0x77F, b"\5")
    bench.run(330 * MS)
    bench.nmt(STOP)
    bench.hear(340 * MS, 0x77F, b"\5")
    assert bench.application.calls("gone") == []
    bench.nmt(PRE)
    assert len(bench.application.calls("gone")) == 1
    assert [item[1:] for item in bench.emergencies()] == [(0x8130, 0x11), (0x0000, 0x00)]
    assert bench.read(0x1001) == 0


def test_messages_of_a_stopped_device_are_bounded() -> None:
    """An error that comes and goes all night in Stopped: 16 messages wait, the rest is counted; then all is told."""
    bench = in_state(NmtState.STOPPED)
    for number in range(50):
        bench.device.error(20 * MS + number, 0x2310, 0x02, bench)
        bench.device.clear_errors(20 * MS + number, bench)
    assert bench.emergencies() == []
    assert bench.device.emcy.dropped == 100 - 16
    bench.nmt(PRE)
    assert [code for _, code, _ in bench.emergencies()] == [0x2310, 0x0000] * 8
    assert bench.read(0x1001) == 0


def test_history_is_cleared_by_writing_0() -> None:
    """CiA 301, object 1003: only 0 may be written to :0; then old entries cannot be read, new ones can."""
    bench = booted()
    bench.device.error(11 * MS, 0x2310, 0x02, bench)
    assert bench.write(0x1003, 0, 1, 1) == VALUE
    assert bench.write(0x1003, 0, 0, 1) == 0
    assert bench.read(0x1003, 0) == 0
    (answer,) = bench.hear(bench.now, REQUEST, b"\x40\x03\x10\x01\0\0\0\0")
    assert answer.data[4:] == bytes.fromhex("24000008")
    bench.device.error(12 * MS, 0x7305, 0x20, bench)
    assert (bench.read(0x1003, 0), bench.read(0x1003, 1)) == (1, 0x7305)


def test_emergencies_keep_the_inhibit_time() -> None:
    """Object 1015 in 100 us: 50 is 5 ms; the device wakes for the next one by itself."""
    bench = booted()
    assert bench.write(0x1015, 0, 50, 2) == 0
    bench.sent.clear()
    for code in (0x2310, 0x3210, 0x4310):
        bench.device.error(10 * MS, code, 0x02, bench)
    bench.run(100 * MS)
    assert [(now, code) for now, code, _ in bench.emergencies()] == [
        (10 * MS, 0x2310),
        (15 * MS, 0x3210),
        (20 * MS, 0x4310),
    ]


def test_inhibited_emergency_goes_when_the_time_is_over() -> None:
    """Object 1015 again, for errors that come with process data: nothing else has to wake the device."""
    bench = booted()
    bench.write(0x1015, 0, 50, 2)
    bench.write(0x1017, 0, 0, 2)
    bench.nmt(START)
    bench.hear(11 * MS, RPDO1, bytes(3))
    bench.hear(12 * MS, RPDO1, bytes(4))
    bench.hear(13 * MS, SYNC, b"")
    bench.sync(14 * MS)
    bench.run(100 * MS)
    assert [(now, code) for now, code, _ in bench.emergencies()] == [
        (11 * MS, 0x8210),
        (16 * MS, 0x0000),
        (21 * MS, 0x8240),
        (26 * MS, 0x0000),
    ]


# --- resets ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("command", [RESET_NODE, RESET_COMMUNICATION])
@pytest.mark.parametrize("state", [NmtState.PRE_OPERATIONAL, NmtState.OPERATIONAL, NmtState.STOPPED])
def test_reset_ends_with_the_boot_up_message(command: int, state: NmtState) -> None:
    """CiA 301, 7.3.2.2.1: Initialising, boot-up message, Pre-operational; heartbeats count from there."""
    bench = in_state(state)
    bench.run(50 * MS)
    bench.nmt(command)
    bench.run(160 * MS)
    assert bench.sent == [(55 * MS, Frame(HEARTBEAT, b"\0")), (155 * MS, Frame(HEARTBEAT, b"\x7f"))]


@pytest.mark.parametrize(("command", "application_value"), [(RESET_NODE, 1390), (RESET_COMMUNICATION, 555)])
def test_reset_restores_defaults(command: int, application_value: int) -> None:
    """CiA 301, 7.3.2.2.1: reset node restores everything, reset communication 1000..1FFF only; then they act."""
    bench = booted()
    bench.write(0x1017, 0, 7, 2)
    bench.write(0x1016, 1, 127 << 16 | 300, 4)
    bench.write(0x6072, 0, 555, 2)
    bench.map(0x1800, 0x1FF, 1, STATUSWORD)
    bench.nmt(command)
    bench.run(30 * MS)
    bench.sent.clear()
    assert (bench.read(0x1017), bench.read(0x1016, 1), bench.read(0x1800, 1)) == (100, 0, 0x40000000 | TPDO1)
    assert (bench.read(0x1A00, 0), bench.read(0x1A00, 1), bench.read(0x6072)) == (2, POSITION, application_value)
    assert len(bench.application.calls("reset")) == (command == RESET_NODE)
    bench.nmt(START)
    bench.sent.clear()
    assert [(frame.can_id, len(frame.data)) for frame in bench.sync(32 * MS)] == [(TPDO1, 8)]
    assert 0x77F not in bench.device.cob_ids()


@pytest.mark.parametrize("command", [RESET_NODE, RESET_COMMUNICATION])
def test_reset_forgets_errors_and_their_history(command: int) -> None:
    """A fresh start: register and history are empty, and the same error is reported again."""
    bench = booted()
    bench.device.error(11 * MS, 0x2310, 0x02, bench)
    bench.nmt(command)
    bench.run(30 * MS)
    bench.sent.clear()
    assert (bench.read(0x1001), bench.read(0x1003)) == (0, 0)
    bench.device.error(31 * MS, 0x2310, 0x02, bench)
    assert [item[1:] for item in bench.emergencies()] == [(0x2310, 0x03)]


@pytest.mark.parametrize("command", [RESET_NODE, RESET_COMMUNICATION])
def test_reset_restores_the_inhibit_time(command: int) -> None:
    """Object 1015 is 0 again, and that is how emergencies are sent."""
    bench = booted()
    bench.write(0x1015, 0, 10000, 2)
    bench.nmt(command)
    bench.run(30 * MS)
    for code in (0x2310, 0x3210):
        bench.device.error(30 * MS, code, 0x02, bench)
    assert len(bench.emergencies()) == 2


@pytest.mark.parametrize("command", [RESET_NODE, RESET_COMMUNICATION, STOP])
def test_running_sdo_transfer_ends_without_a_word(command: int) -> None:
    """CiA 301, table 38: no SDO in Initialising and Stopped, so no time-out abort comes from there either."""
    bench = booted()
    (answer,) = bench.hear(10 * MS, REQUEST, b"\x40\x08\x10\x00\0\0\0\0")  # the name, in segments
    assert answer.data[0] == 0x41
    bench.nmt(command)
    bench.run(3000 * MS)
    bench.nmt(PRE)
    (answer,) = bench.hear(bench.now, REQUEST, b"\x60" + bytes(7))
    assert int.from_bytes(answer.data[4:], "little") == 0x05040001  # no transfer runs
    assert [now for now, _ in bench.of(ANSWER)] == [10 * MS, 3000 * MS]


def test_sdo_transfer_times_out_with_an_abort() -> None:
    """CiA 301, table 22: 05040000 when the client does not go on; the device wakes for it."""
    bench = booted()
    bench.hear(10 * MS, REQUEST, b"\x40\x08\x10\x00\0\0\0\0")
    bench.run(1009 * MS)
    assert len(bench.of(ANSWER)) == 1
    bench.run(1010 * MS)
    assert bench.of(ANSWER)[1:] == [(1010 * MS, struct.pack("<BHBI", 0x80, 0x1008, 0, TIMED_OUT))]
