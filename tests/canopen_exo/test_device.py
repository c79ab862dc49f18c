"""A whole device through receive() and wake(): services per state, resets, errors, configuration over SDO."""

import struct

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from canopen_exo.bus.frame import FLAG_EXTENDED, FLAG_FD, FLAG_REMOTE, Frame
from canopen_exo.bus.loop import Loop
from canopen_exo.bus.medium import Medium
from canopen_exo.bus.node import MS, NEVER, ErrorState, Node, Out, PortState
from canopen_exo.device import BOOT_NS, Application, Device
from canopen_exo.eds import load_eds
from canopen_exo.nmt import NmtState
from canopen_exo.od import ObjectDictionary
from canopen_exo.pdo import INVALID, key_of

PATTERN = ObjectDictionary(load_eds())
NODE = 5
PERIOD = 2 * MS
BOOT = 5 * MS

NMT, SYNC, EMCY, TPDO1, RPDO1, TPDO2, RPDO2, TPDO3, ANSWER, REQUEST, HEARTBEAT = (
    0x000, 0x080, 0x085, 0x185, 0x205, 0x285, 0x305, 0x385, 0x585, 0x605, 0x705,
)  # fmt: skip

START, STOP, PRE, RESET_NODE, RESET_COMMUNICATION = 1, 2, 128, 129, 130

TIMED_OUT, NOT_MAPPABLE, PDO_LENGTH, INCOMPATIBLE = 0x05040000, 0x06040041, 0x06040042, 0x06040043
VALUE, TOO_HIGH, DEVICE_STATE = 0x06090030, 0x06090031, 0x08000022

CONTROLWORD, MODE, TARGET_TORQUE = 0x60400010, 0x60600008, 0x60710010
STATUSWORD, POSITION, VELOCITY, TORQUE = 0x60410010, 0x60640020, 0x606C0020, 0x60770010


class Recorder(Application):
    """Writes down what the device tells it; latches a count of SYNCs as position."""

    def __init__(self, od: ObjectDictionary) -> None:
        self.od = od
        self.log: list[tuple[int, str, int]] = []
        self.latched = 0

    def reset(self, now: int) -> None:
        self.log.append((now, "reset", 0))

    def applied(self, now: int) -> None:
        self.log.append((now, "applied", self.od.value(0x607100)))

    def latch(self, now: int) -> None:
        self.latched += 1
        self.od.set(0x606400, self.latched)
        self.log.append((now, "latch", self.latched))

    def left_operational(self, now: int) -> None:
        self.log.append((now, "left", 0))

    def communication_lost(self, now: int, code: int) -> None:
        self.log.append((now, "lost", code))

    def errors_gone(self) -> None:
        self.log.append((-1, "gone", 0))

    def calls(self, name: str) -> list[tuple[int, int]]:
        return [(now, value) for now, called, value in self.log if called == name]


class Bench(Out):
    """One device, and what it sent: (time, frame). Serves its timers as a loop does: frame before wake-up."""

    def __init__(self) -> None:
        self.od = PATTERN.copy_for_node(NODE, {0x607600: 54900})
        self.application = Recorder(self.od)
        self.device = Device(self.od, NODE, self.application)
        self.application.log.clear()
        self.now = 0
        self.sent: list[tuple[int, Frame]] = []

    def send(self, port: int, frame: Frame) -> None:
        assert port == 0
        self.sent.append((self.now, frame))

    def run(self, until: int) -> "Bench":
        """Serve all timers up to and including `until`."""
        while self.device.wake_at <= until:
            now = max(self.device.wake_at, self.now)
            self.now = now
            self.device.wake(now, self)
            assert self.device.wake_at > now, "wake() must move wake_at on"
        self.now = until
        return self

    def hear(self, now: int, can_id: int, data: bytes, flags: int = 0) -> list[Frame]:
        """A frame ends at `now`; what the device sends there and then."""
        if now > self.now:
            self.run(now - 1)
            self.now = now
        count = len(self.sent)
        self.device.receive(now, 0, Frame(can_id, data, flags), self)
        return [frame for _, frame in self.sent[count:]]

    def nmt(self, command: int) -> list[Frame]:
        return self.hear(self.now, NMT, bytes((command, NODE)))

    def sync(self, now: int, counter: int = 1) -> list[Frame]:
        return self.hear(now, SYNC, bytes((counter,)))

    def write(self, index: int, sub: int, value: int, size: int) -> int:
        """Expedited download at the present time; the abort code, 0 when it was taken."""
        command = 0x23 | (4 - size) << 2
        data = value.to_bytes(size, "little", signed=value < 0).ljust(4, b"\0")
        (answer,) = self.hear(self.now, REQUEST, struct.pack("<BHB", command, index, sub) + data)
        assert answer.can_id == ANSWER
        return 0 if answer.data[0] == 0x60 else int.from_bytes(answer.data[4:], "little")

    def read(self, index: int, sub: int = 0) -> int:
        (answer,) = self.hear(self.now, REQUEST, struct.pack("<BHB4x", 0x40, index, sub))
        assert answer.data[0] & 0xE3 == 0x43, f"{index:04X}:{sub:02X} cannot be read: {answer!r}"
        return int.from_bytes(answer.data[4 : 8 - (answer.data[0] >> 2 & 3)], "little")

    def of(self, can_id: int) -> list[tuple[int, bytes]]:
        """Times and data of everything sent with this id."""
        return [(now, frame.data) for now, frame in self.sent if frame.can_id == can_id]

    def emergencies(self) -> list[tuple[int, int, int]]:
        """(time, code, register)."""
        return [(now, data[0] | data[1] << 8, data[2]) for now, data in self.of(EMCY)]

    def map(self, index: int, cob_id: int, kind: int, *entries: int) -> None:
        """The standard's procedure; index: of the communication parameters."""
        assert self.write(index, 1, INVALID | cob_id, 4) == 0
        assert self.write(index, 2, kind, 1) == 0
        assert self.write(index + 0x200, 0, 0, 1) == 0
        for sub, entry in enumerate(entries, 1):
            assert self.write(index + 0x200, sub, entry, 4) == 0
        assert self.write(index + 0x200, 0, len(entries), 1) == 0
        assert self.write(index, 1, cob_id, 4) == 0


def booted() -> Bench:
    """In Pre-operational at 10 ms."""
    return Bench().run(10 * MS)


def operational() -> Bench:
    bench = booted()
    bench.nmt(START)
    bench.sent.clear()
    bench.application.log.clear()
    return bench


def in_state(state: NmtState) -> Bench:
    bench = Bench() if state is NmtState.INITIALISING else booted()
    if state is NmtState.OPERATIONAL:
        bench.nmt(START)
    elif state is NmtState.STOPPED:
        bench.nmt(STOP)
    assert bench.device.nmt.state is state
    bench.sent.clear()
    bench.application.log.clear()
    return bench


STATES = list(NmtState)


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


# --- configuration over SDO --------------------------------------------------------------------------------------


def test_counter_may_change_only_while_there_is_no_period() -> None:
    """CiA 301, object 1019: 08000022 while object 1006 is not 0; values 0, 2..240."""
    bench = booted()
    assert bench.write(0x1006, 0, 2000, 4) == 0
    assert bench.write(0x1019, 0, 10, 1) == DEVICE_STATE
    assert bench.write(0x1006, 0, 0, 4) == 0
    aborts = {value: bench.write(0x1019, 0, value, 1) for value in (0, 1, 2, 240, 241, 255)}
    assert aborts == {0: 0, 1: VALUE, 2: 0, 240: 0, 241: TOO_HIGH, 255: TOO_HIGH}
    assert bench.read(0x1019) == 240


def test_two_entries_for_one_producer_are_refused() -> None:
    """CiA 301, object 1016: 06040043; an entry with node id 0 or time 0 is unused and does not count."""
    bench = booted()
    assert bench.write(0x1016, 1, 127 << 16 | 300, 4) == 0
    assert bench.write(0x1016, 2, 127 << 16 | 100, 4) == INCOMPATIBLE
    assert bench.write(0x1016, 2, 127 << 16, 4) == 0
    assert bench.write(0x1016, 1, 127 << 16 | 200, 4) == 0
    assert bench.write(0x1016, 2, 126 << 16 | 100, 4) == 0
    assert bench.write(0x1016, 1, 126 << 16 | 200, 4) == INCOMPATIBLE
    assert bench.read(0x1016, 1) == 127 << 16 | 200


@pytest.mark.parametrize("word", [0, 300, 127 << 16, 128 << 16 | 300, 255 << 16 | 300])
def test_unused_consumer_entries_watch_nobody(word: int) -> None:
    """CiA 301, object 1016: time 0, node id 0 or above 127: the entry is not used."""
    bench = booted()
    assert bench.write(0x1016, 1, word, 4) == 0
    assert sorted(bench.device.cob_ids()) == [NMT, SYNC, RPDO1, REQUEST]


@pytest.mark.parametrize(
    ("index", "kind", "abort"),
    [
        *[(0x1800, 1, 0), (0x1800, 240, 0), (0x1800, 241, VALUE), (0x1800, 251, VALUE), (0x1800, 0, VALUE)],
        *[(0x1400, 0, 0), (0x1400, 1, 0), (0x1400, 240, 0), (0x1400, 241, VALUE), (0x1400, 253, VALUE)],
        *[(0x1400, 254, 0), (0x1400, 255, 0)],
    ],
)
def test_transmission_types_that_are_not_there_are_refused(index: int, kind: int, abort: int) -> None:
    """CiA 301, 14xx:2 and 18xx:2: 06090030 for reserved and unsupported types."""
    assert booted().write(index, 2, kind, 1) == abort


def test_start_value_may_change_only_while_the_pdo_does_not_exist() -> None:
    """CiA 301, 18xx:6: 08000022 while the PDO is valid."""
    bench = booted()
    assert bench.write(0x1801, 6, 3, 1) == DEVICE_STATE
    assert bench.write(0x1801, 1, INVALID | TPDO2, 4) == 0
    assert bench.write(0x1801, 6, 3, 1) == 0
    assert bench.write(0x1801, 1, TPDO2, 4) == 0
    assert bench.device.tpdos[1].start == 3


@pytest.mark.parametrize("state", [NmtState.PRE_OPERATIONAL, NmtState.OPERATIONAL])
def test_mapping_procedure_changes_what_is_sent(state: NmtState) -> None:
    """CiA 301, 7.2.2: disable, :0 = 0, entries, :0 = n, enable; also while Operational, as real masters do it."""
    bench = in_state(state)
    bench.map(0x1800, 0x1C5, 2, STATUSWORD, TORQUE, POSITION)
    bench.od.set(0x604100, 0x1234)
    bench.od.set(0x607700, -2)
    if state is NmtState.PRE_OPERATIONAL:
        bench.nmt(START)
    assert bench.sync(12 * MS, 1) == []
    assert bench.sync(14 * MS, 2) == [Frame(0x1C5, struct.pack("<Hhi", 0x1234, -2, 2))]


def test_mapping_procedure_changes_what_is_received() -> None:
    """The same for an RPDO: new id, new content; the old id is no longer heard."""
    bench = operational()
    bench.map(0x1400, 0x245, 255, TARGET_TORQUE, MODE)
    bench.hear(11 * MS, RPDO1, struct.pack("<Hh", 1, 1))
    assert bench.application.calls("applied") == []
    bench.hear(11 * MS, 0x245, struct.pack("<hb", -5, 0))
    assert (bench.od.value(0x607100), bench.od.value(0x606000), bench.od.value(0x604000)) == (-5, 0, 0)


def test_mapping_errors_have_the_aborts_of_the_standard() -> None:
    """CiA 301, 7.2.2 and table 22: 08000022 with :0 > 0, 06040041 not mappable, 06040042 too long; nothing changes."""
    bench = booted()
    assert bench.write(0x1A00, 1, STATUSWORD, 4) == DEVICE_STATE
    assert bench.write(0x1A00, 0, 0, 1) == 0
    assert bench.write(0x1A00, 1, CONTROLWORD, 4) in (0, NOT_MAPPABLE)  # at the entry, or when it is counted
    assert bench.write(0x1A00, 0, 1, 1) == NOT_MAPPABLE
    assert bench.write(0x1A00, 1, POSITION, 4) == 0
    assert bench.write(0x1A00, 2, VELOCITY, 4) == 0
    assert bench.write(0x1A00, 3, TORQUE, 4) == 0
    assert bench.write(0x1A00, 0, 3, 1) == PDO_LENGTH
    assert bench.read(0x1A00, 0) == 0
    assert bench.write(0x1A00, 0, 9, 1) == TOO_HIGH
    assert bench.write(0x1A00, 0, 2, 1) == 0


def test_enabled_pdo_without_entries_sends_nothing() -> None:
    """Device rules: an enabled PDO with 0 entries is legal."""
    bench = operational()
    assert bench.write(0x1A00, 0, 0, 1) == 0
    assert bench.sync(12 * MS) == []
    assert bench.write(0x1A00, 0, 2, 1) == 0
    assert [frame.can_id for frame in bench.sync(14 * MS, 2)] == [TPDO1]


@pytest.mark.parametrize("cob_id", [0x000, 0x001, 0x07F, 0x101, 0x180, 0x581, 0x605, 0x6E0, 0x705, 0x7FF])
@pytest.mark.parametrize("index", [0x1400, 0x1800])
def test_restricted_ids_are_refused_for_pdos(index: int, cob_id: int) -> None:
    """CiA 301, 7.3.5, restricted CAN-IDs: a PDO on the id of NMT or SDO would make the device deaf to it."""
    bench = booted()
    assert bench.write(index, 1, INVALID | cob_id, 4) in (0, VALUE)
    assert bench.write(index, 1, cob_id, 4) == VALUE
    assert bench.read(0x1000) == 0x00020192
    bench.nmt(START)
    assert bench.device.operational


def test_29_bit_ids_are_refused_for_pdos() -> None:
    """CiA 301, 14xx:1: 06090030 for bit 29 where a device does not support extended frames."""
    assert booted().write(0x1800, 1, 0x20000185, 4) == VALUE


def test_configuring_one_pdo_leaves_the_others_alone() -> None:
    """Real masters remap in Operational: counts, pending values and deadlines of the other PDOs go on."""
    bench = operational()
    bench.write(0x1400, 5, 20, 2)
    for number in range(7):
        bench.sync((12 + 2 * number) * MS, number + 1)
    bench.hear(25 * MS, RPDO1, struct.pack("<Hh", 15, 77))
    bench.map(0x1802, TPDO3, 1, TORQUE)
    for number in range(7, 16):
        bench.sync((12 + 2 * number) * MS, number + 1)
    assert bench.application.calls("applied") == [(26 * MS, 77)]
    assert [(now - 12 * MS) // PERIOD + 1 for now, _ in bench.of(TPDO2)] == [5, 15]
    assert [now for now, code, _ in bench.emergencies() if code == 0x8250] == []
    bench.run(45 * MS)
    assert [now for now, code, _ in bench.emergencies() if code == 0x8250] == [45 * MS]


# --- on a bus, and any bytes -------------------------------------------------------------------------------------


def test_device_runs_in_the_loop() -> None:
    """A Device is a Node: boot-up, NMT start and SYNC over an emulated bus."""

    class Starter(Node):
        def __init__(self) -> None:
            super().__init__()
            self.heard: list[int] = []

        def receive(self, now: int, port: int, frame: Frame, out: Out) -> None:
            self.heard.append(frame.can_id)
            if frame.can_id == HEARTBEAT and frame.data == b"\0":
                out.send(0, Frame(NMT, b"\1\0"))
                self.wake_at = now + PERIOD

        def wake(self, now: int, out: Out) -> None:
            out.send(0, Frame(SYNC, b"\1"))
            self.wake_at = NEVER

    bench, starter = Bench(), Starter()
    loop = Loop([Medium("bus", 0, 1_000_000)])
    loop.connect(starter, loop.media)
    loop.connect(bench.device, loop.media)
    loop.run_until(20 * MS)
    assert starter.heard == [HEARTBEAT, TPDO1]
    assert [row.frame.can_id for row in loop.trace] == [HEARTBEAT, NMT, SYNC, TPDO1]


KNOWN_IDS = [NMT, SYNC, EMCY, TPDO1, RPDO1, TPDO2, RPDO2, ANSWER, REQUEST, REQUEST, REQUEST, HEARTBEAT, 0x77F, 0x7FF]
OBJECTS = sorted({key >> 8 for key in PATTERN.entries})

SDO_WRITE = st.builds(
    lambda index, sub, size, data: struct.pack("<BHB", 0x23 | (4 - size) << 2, index, sub) + data,
    st.sampled_from(OBJECTS),
    st.integers(0, 8),
    st.integers(1, 4),
    st.binary(min_size=4, max_size=4),
)

FRAMES = st.one_of(
    st.tuples(st.sampled_from(KNOWN_IDS), st.binary(max_size=8), st.just(0)),
    st.tuples(st.integers(0, 0x7FF), st.binary(max_size=8), st.just(0)),
    st.tuples(st.just(NMT), st.sampled_from([bytes((c, NODE)) for c in (1, 1, 1, 2, 128, 129, 130)]), st.just(0)),
    st.tuples(st.just(SYNC), st.integers(0, 255).map(lambda counter: bytes((counter,))), st.just(0)),
    st.tuples(st.just(RPDO1), st.binary(min_size=4, max_size=4), st.just(0)),
    st.tuples(st.just(REQUEST), SDO_WRITE, st.just(0)),
    st.tuples(st.just(REQUEST), st.binary(min_size=8, max_size=8), st.just(0)),
    st.tuples(st.sampled_from(KNOWN_IDS), st.just(b""), st.sampled_from([FLAG_REMOTE, FLAG_EXTENDED])),
)

GAPS = st.sampled_from([0, 0, 1, PERIOD, 7 * MS, 400 * MS])


@settings(max_examples=300)
@given(frames=st.lists(st.tuples(GAPS, FRAMES), min_size=1, max_size=25))
def test_no_frames_make_a_device_raise_or_break_its_rules(
    frames: list[tuple[int, tuple[int, bytes, int]]],
) -> None:
    """Any bytes on any id, in any state: no exception, timers move on, and each state sends only what it may."""
    bench = booted()
    bench.write(0x1016, 1, 127 << 16 | 300, 4)
    bench.write(0x1400, 5, 20, 2)
    bench.write(0x1006, 0, 2000, 4)
    now = bench.now
    for gap, (can_id, data, flags) in frames:
        now += gap
        before = len(bench.sent)
        bench.run(now - 1 if gap else now)
        state = bench.device.nmt.state
        sent = bench.hear(now, can_id, data, flags)
        kinds = {frame.can_id & 0x780 for frame in sent}
        if state is NmtState.INITIALISING:
            assert sent == []
        if state is NmtState.STOPPED and bench.device.nmt.state is NmtState.STOPPED:
            assert sent == []
        if state is NmtState.PRE_OPERATIONAL:
            assert kinds <= {0x580, 0x080}
        assert all(frame.can_id == ANSWER for frame in sent if frame.can_id & 0x780 == 0x580)
        assert len(bench.sent) - before < 200
    bench.run(now + 2000 * MS)


# --- the CAN controller ------------------------------------------------------------------------------------------


def changed(bench: Bench, now: int, state: ErrorState, *, overrun: bool = False) -> None:
    """A notice about the device's port at `now`."""
    bench.run(now - 1)
    bench.now = now
    bench.device.port_changed(now, PortState(0, state, 0, 0, "test", overrun), bench)


def test_error_passive_is_8120_until_the_controller_is_active_again() -> None:
    """Device rules: 8120, register 11, reaction of 6007; told once, and 0000 afterwards."""
    bench = operational()
    changed(bench, 12 * MS, ErrorState.WARNING)
    assert bench.emergencies() == []
    changed(bench, 13 * MS, ErrorState.ERROR_PASSIVE)
    changed(bench, 14 * MS, ErrorState.ERROR_PASSIVE)
    assert bench.emergencies() == [(13 * MS, 0x8120, 0x11)]
    assert bench.application.calls("lost") == [(13 * MS, 0x8120)]
    changed(bench, 15 * MS, ErrorState.WARNING)
    assert bench.emergencies()[1:] == [(15 * MS, 0x0000, 0x00)]


def test_bus_off_acts_at_once_and_is_told_when_it_is_left() -> None:
    """Device rules: 8140 for bus-off left; CiA 402: the reaction of 6007 belongs to bus-off itself."""
    bench = operational()
    changed(bench, 12 * MS, ErrorState.ERROR_PASSIVE)
    changed(bench, 13 * MS, ErrorState.BUS_OFF)
    assert [code for _, code, _ in bench.emergencies()] == [0x8120]
    assert bench.application.calls("lost") == [(12 * MS, 0x8120), (13 * MS, 0x8140)]
    changed(bench, 113 * MS, ErrorState.ERROR_ACTIVE)
    assert bench.emergencies()[1:] == [(113 * MS, 0x8140, 0x11)]
    assert len(bench.application.calls("lost")) == 2
    assert bench.device.od.value(key_of(0x1003, 1)) == 0x8140
    bench.hear(114 * MS, HEARTBEAT + 1, b"\x05")
    assert bench.emergencies()[2:] == [(114 * MS, 0x0000, 0x00)]  # a frame came through


def test_bus_off_changes_the_nmt_state_as_1029_says() -> None:
    """CiA 301, object 0x1029:1: bus-off is a communication error; 0: Pre-operational if Operational."""
    bench = operational()
    assert bench.write(0x1029, 1, 0, 1) == 0
    changed(bench, 12 * MS, ErrorState.BUS_OFF)
    assert bench.device.nmt.state is NmtState.PRE_OPERATIONAL


def test_interface_that_is_down_is_no_bus_off() -> None:
    """Its loss is noticed by SYNC, RPDO and heartbeat."""
    bench = operational()
    changed(bench, 12 * MS, ErrorState.DOWN)
    changed(bench, 13 * MS, ErrorState.ERROR_ACTIVE)
    assert bench.emergencies() == []
    assert bench.application.calls("lost") == []


def test_lost_objects_are_8110_until_a_frame_comes() -> None:
    """Device rules: overrun 8110, register 11, reaction of 6007."""
    bench = operational()
    changed(bench, 12 * MS, ErrorState.ERROR_ACTIVE, overrun=True)
    assert bench.emergencies() == [(12 * MS, 0x8110, 0x11)]
    assert bench.application.calls("lost") == [(12 * MS, 0x8110)]
    bench.sync(14 * MS)
    assert bench.emergencies()[1:] == [(14 * MS, 0x0000, 0x00)]
