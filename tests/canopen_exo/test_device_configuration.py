"""A CANopen device: configuration over SDO, any bytes, the CAN controller."""

import struct

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from canopen_exo.bus.frame import FLAG_EXTENDED, FLAG_REMOTE, Frame
from canopen_exo.bus.loop import Loop
from canopen_exo.bus.medium import Medium
from canopen_exo.bus.node import MS, NEVER, ErrorState, Node, Out, PortState
from canopen_exo.nmt import NmtState
from canopen_exo.pdo import INVALID, key_of
from tests.canopen_exo.device_under_test import (
    ANSWER,
    CONTROLWORD,
    DEVICE_STATE,
    EMCY,
    HEARTBEAT,
    INCOMPATIBLE,
    MODE,
    NMT,
    NODE,
    NOT_MAPPABLE,
    PATTERN,
    PDO_LENGTH,
    PERIOD,
    POSITION,
    REQUEST,
    RPDO1,
    RPDO2,
    START,
    STATUSWORD,
    SYNC,
    TARGET_TORQUE,
    TOO_HIGH,
    TORQUE,
    TPDO1,
    TPDO2,
    TPDO3,
    VALUE,
    VELOCITY,
    Bench,
    booted,
    in_state,
    operational,
)

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


@pytest.mark.long
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
