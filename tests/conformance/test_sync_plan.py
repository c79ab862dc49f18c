"""The traffic of a whole fault-free run against the bus plan: every frame counted, placed and read by other eyes.

What is expected here follows from the plan and from frame lengths (ISO 11898-1: 47 + 8 n bits without stuffing, at most
55 + 10 n, intermission included), not from the code that makes the frames. Signals are read with cantools.
"""

import struct
from collections import Counter
from importlib import resources

import pytest
from cantools.database import load_string
from cantools.database.can import Database

from canopen_exo.bus.medium import Transmission
from canopen_exo.bus.node import MS, SECOND
from canopen_exo.master import POWER_UP_NS
from canopen_exo.plan import BusPlan
from hlc.node import Phase
from testbench.rig import CONTROLLER_BUS, DRIVE_BUS, Rig, RigParams, build_rig
from testbench.scenario import default_joints

pytestmark = pytest.mark.run

PLAN = BusPlan(default_joints())
CYCLE = 2 * MS
DURATION = 7 * SECOND
CYCLES = 3500
NODES = range(1, 7)
BUSES = [CONTROLLER_BUS, DRIVE_BUS]
SYNC, STATUS, MASTER_HEARTBEAT = 0x080, 0x2FF, 0x77F
BIT_NS = 1000


@pytest.fixture(scope="module")
def rig() -> Rig:
    """A fault-free run of 7 s to its end. Not to be changed."""
    rig = build_rig(RigParams(PLAN, False, 1500 * MS, DURATION), [])
    while rig.controller.phase not in (Phase.STOPPED, Phase.FAILED):
        rig.loop.run_until(rig.loop.now + 100 * MS)
    assert rig.controller.completed
    return rig


@pytest.fixture(scope="module")
def motion(rig: Rig) -> tuple[list[Transmission], list[Transmission]]:
    """The frames of both buses over the motion: ended later than time 0 and not later than 7 s after it."""
    zero = rig.controller.time_zero
    rows = [row for row in rig.loop.trace if zero < row.end_ns <= zero + DURATION]
    return [row for row in rows if row.bus == CONTROLLER_BUS], [row for row in rows if row.bus == DRIVE_BUS]


@pytest.fixture(scope="module")
def cycles(rig: Rig) -> tuple[list[list[Transmission]], list[list[Transmission]]]:
    """The frames of each bus by cycle of the motion: from one SYNC request to the next."""
    found: tuple[list[list[Transmission]], ...] = tuple([[] for _ in range(CYCLES)] for _ in BUSES)
    for row in rig.loop.trace:
        cycle = (row.end_ns - rig.controller.time_zero - 1) // CYCLE
        if 0 <= cycle < CYCLES:
            found[row.bus][cycle].append(row)
    return found[0], found[1]


Cycles = tuple[list[list[Transmission]], list[list[Transmission]]]
Motion = tuple[list[Transmission], list[Transmission]]


def ids(rows: list[Transmission], low: int, high: int) -> list[int]:
    return [row.frame.can_id for row in rows if low <= row.frame.can_id <= high]


# ---- how many -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("bus", BUSES)
def test_frames_of_the_motion_are_those_of_the_plan_and_no_others(motion: Motion, bus: int) -> None:
    """7 s at 500 Hz: SYNC, RPDO1 and TPDO1 each cycle, TPDO2 and status every 10th, heartbeats every 100 ms."""
    expected = {SYNC: CYCLES, STATUS: CYCLES // 10, MASTER_HEARTBEAT: DURATION // (100 * MS)}
    for node in NODES:
        expected[0x200 + node] = CYCLES
        expected[0x180 + node] = CYCLES
        expected[0x280 + node] = CYCLES // 10
        expected[0x700 + node] = DURATION // (100 * MS)
    assert Counter(row.frame.can_id for row in motion[bus]) == expected


def heartbeat_clock(rig: Rig, node: int) -> int:
    """When a producer's period began: with the write to 0x1017 for a drive, with its start for the master (127)."""
    if node == 127:
        return POWER_UP_NS
    for row in rig.loop.trace:
        frame = row.frame
        if row.bus == DRIVE_BUS and frame.can_id == 0x600 + node and frame.data[1:4] == b"\x17\x10\x00":
            return row.end_ns
    raise AssertionError(f"node {node}: 0x1017 was not written")


@pytest.mark.parametrize("bus", BUSES)
@pytest.mark.parametrize("node", [*NODES, 127])
def test_every_heartbeat_comes_in_its_time(rig: Rig, node: int, bus: int) -> None:
    """0x1017 = 100 ms from the write on, all run long: the n-th frame at n periods, within the cycle that it waits."""
    begun = heartbeat_clock(rig, node)
    beats = [
        row.end_ns
        for row in rig.loop.trace
        if row.bus == bus and row.frame.can_id == 0x700 + node and row.frame.data != b"\x00"
    ]
    assert len(beats) >= (DURATION + 1500 * MS) // (100 * MS)
    for number, end in enumerate(beats, 1):
        assert 0 < end - (begun + number * 100 * MS) <= CYCLE


@pytest.mark.parametrize("bus", BUSES)
def test_frame_lengths_and_data_lengths_are_those_of_the_plan(motion: Motion, bus: int) -> None:
    """SYNC 1 byte (counter), RPDO1 4, TPDO1 8, TPDO2 6, status 5, heartbeat 1; 47 + 8 n .. 55 + 10 n bits each."""
    sizes = {SYNC: 1, STATUS: 5, MASTER_HEARTBEAT: 1}
    for node in NODES:
        sizes |= {0x200 + node: 4, 0x180 + node: 8, 0x280 + node: 6, 0x700 + node: 1}
    for row in motion[bus]:
        size = len(row.frame.data)
        assert size == sizes[row.frame.can_id]
        assert 47 + 8 * size <= row.frame.bits <= 55 + 10 * size


@pytest.mark.parametrize("bus", BUSES)
def test_load_lies_between_the_bounds_the_plan_computes(motion: Motion, bus: int) -> None:
    """The plan's bounds (63 % without stuff bits, 77 % worst-stuffed) are those of what passed; load lies between."""
    sizes = [len(row.frame.data) for row in motion[bus]]
    low = sum(47 + 8 * size for size in sizes) * BIT_NS / DURATION
    high = sum(55 + 10 * size for size in sizes) * BIT_NS / DURATION
    assert PLAN.load() == pytest.approx((low, high), rel=1e-12)  # the same sum, another order
    load = sum(row.frame.bits for row in motion[bus]) * BIT_NS / DURATION
    assert low < load < high
    assert 0.55 < load < 0.85


@pytest.mark.parametrize("bus", BUSES)
def test_frames_of_one_bus_never_overlap(rig: Rig, bus: int) -> None:
    """One frame at a time: each begins when the one before it is over, intermission included."""
    free = 0
    for row in rig.loop.trace:
        if row.bus == bus:
            begin = row.end_ns - row.frame.bits * BIT_NS
            assert begin >= free
            free = row.end_ns


# ---- when, in a cycle ---------------------------------------------------------------------------------------------


def test_sync_is_requested_on_the_grid_and_counts_1_to_240(rig: Rig) -> None:
    """SYNC every 2 ms from the first one on, delayed at most by a frame that is on the bus; counter wraps 240 -> 1."""
    rows = [row for row in rig.loop.trace if row.bus == CONTROLLER_BUS and row.frame.can_id == SYNC]
    first = rows[0].end_ns // CYCLE * CYCLE
    for number, row in enumerate(rows):
        delay = row.end_ns - row.frame.bits * BIT_NS - (first + number * CYCLE)
        assert 0 <= delay < (55 + 10 * 8) * BIT_NS
        assert row.frame.data == bytes((number % 240 + 1,))


def test_each_cycle_has_samples_then_commands_in_node_order(cycles: Cycles) -> None:
    """On either bus: SYNC, six TPDO1, six RPDO1, all before the next SYNC; lowest id first where they wait together."""
    for bus in BUSES:
        for rows in cycles[bus]:
            order = [can_id for can_id in ids(rows, SYNC, 0x206) if can_id == SYNC or can_id > 0x180]
            assert order == [SYNC, *range(0x181, 0x187), *range(0x201, 0x207)]


def test_commands_start_after_the_last_sample_is_in(rig: Rig, cycles: Cycles) -> None:
    """Never together with SYNC, never before the TPDOs: the controller answers what it has heard in this cycle."""
    assert rig.controller.late == [0] * 6  # by the samples, not by the deadline
    for rows in cycles[CONTROLLER_BUS]:
        last = max(row.end_ns for row in rows if 0x181 <= row.frame.can_id <= 0x186)
        first = min(row.end_ns - row.frame.bits * BIT_NS for row in rows if 0x201 <= row.frame.can_id <= 0x206)
        assert first >= last


def test_last_sample_reaches_the_controller_as_early_as_its_frames_allow(rig: Rig, cycles: Cycles) -> None:
    """Two hops of SYNC, six TPDO1 on the drive bus, one more hop: 0.89 ms without stuffing .. 1.08 ms; deadline 1.2."""
    low = (2 * (47 + 8) + 7 * (47 + 64)) * BIT_NS
    high = (2 * (55 + 10) + 7 * (55 + 80)) * BIT_NS
    assert (low, high) == (887_000, 1_075_000)
    for cycle, rows in enumerate(cycles[CONTROLLER_BUS]):
        zero = rig.controller.time_zero + cycle * CYCLE
        last = max(row.end_ns for row in rows if 0x181 <= row.frame.can_id <= 0x186) - zero
        assert low <= last <= high < 1_200_000


def test_last_command_reaches_the_drives_well_before_the_next_sync(rig: Rig, cycles: Cycles) -> None:
    """Design: 1.44 .. 1.76 ms after SYNC, with one TPDO2 or status frame in the way."""
    low = (2 * (47 + 8) + 7 * (47 + 64) + 7 * (47 + 32)) * BIT_NS
    for cycle, rows in enumerate(cycles[DRIVE_BUS]):
        zero = rig.controller.time_zero + cycle * CYCLE
        last = max(row.end_ns for row in rows if 0x201 <= row.frame.can_id <= 0x206) - zero
        assert low <= last <= 1_760_000 < CYCLE


@pytest.mark.parametrize("bus", BUSES)
def test_tpdo2_is_staggered_by_node_id(cycles: Cycles, bus: int) -> None:
    """0x1801:6 = node id, type 10: with SYNC counters node, node + 10, ...; never two in a cycle."""
    for rows in cycles[bus]:
        counter = next(row.frame.data[0] for row in rows if row.frame.can_id == SYNC)
        expected = [0x280 + counter % 10] if counter % 10 in NODES else []
        assert ids(rows, 0x281, 0x286) == expected


@pytest.mark.parametrize("bus", BUSES)
def test_status_comes_with_every_tenth_cycle(cycles: Cycles, bus: int) -> None:
    """0x2FF: motion, cycle, phase in 1/65536 of the stride of 750 cycles, floor."""
    for cycle, rows in enumerate(cycles[bus]):
        found = [struct.unpack("<BHH", row.frame.data) for row in rows if row.frame.can_id == STATUS]
        assert found == ([(2, cycle, cycle % 750 * 65536 // 750)] if cycle % 10 == 0 else [])


# ---- through the gateway ------------------------------------------------------------------------------------------


def test_gateway_passes_every_frame_once_and_in_order(rig: Rig) -> None:
    """Golden run, no injector: for each COB-ID both buses carry the same sequence of data."""
    passed: dict[int, tuple[list[bytes], list[bytes]]] = {}
    for row in rig.loop.trace:
        passed.setdefault(row.frame.can_id, ([], []))[row.bus].append(row.frame.data)
    for one, other in passed.values():
        shorter = min(len(one), len(other))
        assert one[:shorter] == other[:shorter]
        assert abs(len(one) - len(other)) <= 1  # the run may end with a frame half way


def test_store_and_forward_costs_at_least_the_frame_itself(rig: Rig) -> None:
    """A frame begins on the far bus not before it has ended on the near one."""
    waiting: dict[int, list[Transmission]] = {}
    for row in rig.loop.trace:
        queue = waiting.setdefault(row.frame.can_id, [])
        if queue and queue[0].bus != row.bus:
            near = queue.pop(0)
            assert row.end_ns - row.frame.bits * BIT_NS >= near.end_ns
        else:
            queue.append(row)


# ---- the beginning and the end ------------------------------------------------------------------------------------


def test_start_follows_the_standards_order(rig: Rig) -> None:
    """CiA 302-2: all booted, reset communication, boot-up of all again, SDO, start; only then SYNC and PDOs, then time
    0; at the end Pre-operational, and no SYNC after it."""
    rows = [row for row in rig.loop.trace if row.bus == DRIVE_BUS]
    first: dict[str, int] = {}
    last: dict[str, int] = {}
    for at, row in enumerate(rows):
        can_id, data = row.frame.can_id, row.frame.data
        what = {0x000: f"nmt {data[0]:02X}", SYNC: "sync", STATUS: "status"}.get(can_id)
        if what is None and 0x701 <= can_id <= 0x706 and data == b"\x00":
            what = "boot-up"
        if what is None:
            kinds = {0x180: "tpdo", 0x200: "rpdo", 0x280: "tpdo", 0x580: "sdo", 0x600: "sdo"}
            what = kinds.get(can_id & 0x780, "other")
        first.setdefault(what, at)
        last[what] = at
    boot_ups = [(at, row.frame.can_id) for at, row in enumerate(rows) if row.frame.data == b"\x00"]
    before = [can_id for at, can_id in boot_ups if at < first["nmt 82"]]
    after = [can_id for at, can_id in boot_ups if at > first["nmt 82"]]
    drives = list(range(0x701, 0x707))
    assert sorted(before) == drives  # powered up with the master, they hear the reset
    assert sorted(after) == [*drives, MASTER_HEARTBEAT]  # and each of them serves it
    assert first["nmt 82"] == last["nmt 82"] == 6
    assert last["boot-up"] < first["nmt 01"]
    for node in NODES:
        again = next(at for at, can_id in boot_ups if at > first["nmt 82"] and can_id == 0x700 + node)
        assert again < next(at for at, row in enumerate(rows) if row.frame.can_id == 0x600 + node)
    assert last["sdo"] < first["nmt 01"] < first["sync"] < first["tpdo"] < first["rpdo"] < first["status"]
    assert max(last["sync"], last["rpdo"], last["status"]) < first["nmt 80"]
    assert len({row.frame.can_id for row in rows[first["nmt 80"] :]} - {0x000, MASTER_HEARTBEAT, *drives}) == 0


@pytest.mark.parametrize("node", NODES)
def test_master_writes_every_pdo_of_the_plan_by_the_standard_procedure(rig: Rig, node: int) -> None:
    """CiA 301, 7.5.2.36 and .38: not valid, parameters, no entries, entries, their number, valid; numbers by hand."""
    writes = []
    for row in rig.loop.trace:
        frame = row.frame
        if row.bus == DRIVE_BUS and frame.can_id == 0x600 + node and frame.data[0] & 0xF3 == 0x23:
            index, sub = struct.unpack("<HB", frame.data[1:4])
            size = 4 - (frame.data[0] >> 2 & 3)
            if 0x1400 <= index < 0x1C00:
                writes.append((index, sub, int.from_bytes(frame.data[4 : 4 + size], "little"), size))
    off = 1 << 31
    assert writes == [
        (0x1400, 1, off | 0x200 + node, 4), (0x1400, 2, 1, 1), (0x1400, 5, 20, 2), (0x1600, 0, 0, 1),
        (0x1600, 1, 0x60400010, 4), (0x1600, 2, 0x60710010, 4), (0x1600, 0, 2, 1), (0x1400, 1, 0x200 + node, 4),
        (0x1800, 1, off | 0x180 + node, 4), (0x1800, 2, 1, 1), (0x1800, 6, 0, 1), (0x1A00, 0, 0, 1),
        (0x1A00, 1, 0x60640020, 4), (0x1A00, 2, 0x606C0020, 4), (0x1A00, 0, 2, 1), (0x1800, 1, 0x180 + node, 4),
        (0x1801, 1, off | 0x280 + node, 4), (0x1801, 2, 10, 1), (0x1801, 6, node, 1), (0x1A01, 0, 0, 1),
        (0x1A01, 1, 0x60410010, 4), (0x1A01, 2, 0x60770010, 4), (0x1A01, 3, 0x603F0010, 4), (0x1A01, 0, 3, 1),
        (0x1801, 1, 0x280 + node, 4),
    ]  # fmt: skip


def test_no_emcy_in_a_fault_free_run(rig: Rig) -> None:
    """From power-up to the end nothing is wrong: no EMCY, no SDO abort."""
    assert not [row for row in rig.loop.trace if 0x081 <= row.frame.can_id <= 0x086]
    assert not [row for row in rig.loop.trace if 0x580 <= row.frame.can_id < 0x700 and row.frame.data[0] == 0x80]


# ---- what the frames say ------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def dbc() -> Database:
    database = load_string(resources.files("dbc").joinpath("exo.dbc").read_text(encoding="utf-8"), "dbc")
    assert isinstance(database, Database)
    return database


def test_samples_read_by_the_dbc_are_the_plants_angles(rig: Rig, cycles: Cycles, dbc: Database) -> None:
    """TPDO1 position [rad] through cantools = the truth of the step at the SYNC, to half a count of 48 microradians."""
    truth = {row.time_ns: row for row in rig.rack.truth}
    for cycle in range(0, CYCLES, 35):
        step = truth[rig.controller.time_zero + cycle * CYCLE]
        for row in cycles[CONTROLLER_BUS][cycle]:
            if 0x181 <= row.frame.can_id <= 0x186:
                decoded = dbc.decode_message(row.frame.can_id, row.frame.data)
                assert isinstance(decoded, dict)
                assert decoded["position"] == pytest.approx(step.q[row.frame.can_id - 0x181], abs=24.1e-6)


def test_commands_read_by_the_dbc_are_the_controllers_torques(rig: Rig, cycles: Cycles, dbc: Database) -> None:
    """RPDO1 target torque [N m] through cantools = the torque before the clamp, to half a per mille of rated torque."""
    samples = {sample.cycle: sample for sample in rig.controller.samples}
    for cycle in range(0, CYCLES, 35):
        for row in cycles[DRIVE_BUS][cycle]:
            if 0x201 <= row.frame.can_id <= 0x206:
                joint = row.frame.can_id - 0x201
                decoded = dbc.decode_message(row.frame.can_id, row.frame.data)
                assert isinstance(decoded, dict)
                half = PLAN.joints[joint].rated_torque_mnm * 0.5e-6 + 1e-9  # rounding, and that of the division
                assert decoded["target_torque"] == pytest.approx(samples[cycle].tau_command[joint], abs=half)
                assert decoded["controlword"] == 0x0F


def test_statuswords_of_the_motion_say_operation_enabled_without_error(motion: Motion, dbc: Database) -> None:
    """TPDO2: bits 0-6 = Operation enabled with voltage, remote set, no limit active, error code 0."""
    for row in motion[DRIVE_BUS]:
        if 0x281 <= row.frame.can_id <= 0x286:
            decoded = dbc.decode_message(row.frame.can_id, row.frame.data)
            assert isinstance(decoded, dict)
            assert (decoded["statusword"], decoded["error_code"]) == (0x0237, 0)
