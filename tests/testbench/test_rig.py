"""The whole rig: a fault-free walk inside every limit, cut cables, lost samples, a restarting drive, copies."""

import copy
import dataclasses
import math

import numpy as np
import pytest

from canopen_exo.bus.frame import Frame
from canopen_exo.bus.medium import Medium, Transmission
from canopen_exo.bus.node import MS, NEVER, SECOND, Node, Out
from canopen_exo.master import POWER_UP_NS
from canopen_exo.nmt import NmtState
from canopen_exo.plan import (
    CONTROLWORD,
    ERROR_CODE,
    POSITION,
    STATUSWORD,
    TARGET_TORQUE,
    TORQUE,
    VELOCITY,
    BusPlan,
    Pdo,
)
from canopen_exo.signal import Signal
from fi_gateway.effects import ConstantTime
from fi_gateway.events import At, FailureProbability
from fi_gateway.faults import Drop, Fault, StuckAt
from fi_gateway.injector import Injector, Target, stream
from hlc.limits import limits_of
from hlc.node import Phase
from joint_emulators.plant import Plant
from testbench.record import RunRecord
from testbench.rig import CONTROLLER_BUS, DRIVE_BUS, Rig, RigParams, build_rig
from testbench.run import NotStartedError, drive_through, record_of, run_rig
from testbench.scenario import default_joints
from testbench.verdict import judge

pytestmark = pytest.mark.run

PLAN = BusPlan(default_joints())
NAMES = tuple(joint.name for joint in PLAN.joints)
CYCLE = 2 * MS
STRIDE = 1500 * MS
DURATION = 7 * SECOND
RIGHT_KNEE = NAMES.index("right_knee")
KNEE_POSITION: Signal = next(
    signal for signal in PLAN.signals() if (signal.node, signal.name) == ("right_knee", "position")
)

SYNC_LOST, RPDO_LATE, HEARTBEAT_LOST = 0x8700, 0x8250, 0x8130
STATUSWORD_KEY, ERROR_CODE_KEY = 0x6041 << 8, 0x603F << 8
SWITCH_ON_DISABLED = 0x0250
"""Statusword: Switch on disabled, voltage present, remote."""

Row = tuple[int, int, int, int, int, bytes]


def new_rig(injectors: list[Injector] | None = None, *, stops: bool = False, duration_ns: int = DURATION) -> Rig:
    return build_rig(RigParams(PLAN, stops, STRIDE, duration_ns), injectors if injectors is not None else [])


def run_to(rig: Rig, phase: Phase, limit: int = 12 * SECOND) -> Rig:
    """Run, cycle by cycle, until the controller is in that phase."""
    while rig.controller.phase is not phase:
        assert rig.loop.now < limit, f"still {rig.controller.phase.value} at {limit / 1e9:g} s"
        rig.loop.run_until(rig.loop.now + CYCLE)
    return rig


def finished(rig: Rig) -> Rig:
    """Run to the end, and 50 ms on."""
    run_to(rig, Phase.STOPPED)
    rig.loop.run_until(rig.loop.now + 50 * MS)
    return rig


def injector(fault: Fault, at_ns: int, duration_ns: int, cob_id: int) -> Injector:
    """From the drives to the controller, at a time of the motion."""
    target = Target(True, False, (cob_id,))
    return Injector("x", target, fault, At((at_ns,)), ConstantTime(duration_ns), None, stream(1, 0, "x"), True, False)


def dropped(
    cob_id: int,
    at_ns: int,
    duration_ns: int,
    *,
    to_drives: bool = True,
    name: str = "drop",
    from_power_up: bool = False,
) -> Injector:
    """Loses every frame of an id in one direction for a time."""
    target = Target(not to_drives, to_drives, (cob_id,), "SYNC 0x080" if cob_id == 0x080 else "")
    effect = ConstantTime(duration_ns)
    return Injector(name, target, Drop(), At((at_ns,)), effect, None, stream(1, 0, name), True, from_power_up)


def trace(rows: list[Transmission]) -> list[Row]:
    return [(row.end_ns, row.bus, row.sender, row.frame.can_id, row.frame.flags, row.frame.data) for row in rows]


def statuswords(rig: Rig) -> list[int]:
    return [device.od.values[STATUSWORD_KEY] for device in rig.rack.devices]


def error_codes(rig: Rig) -> list[int]:
    return [device.od.values[ERROR_CODE_KEY] for device in rig.rack.devices]


def torques(rig: Rig) -> list[float]:
    return [drive.torque_nm for drive in rig.rack.drives]


@pytest.fixture(scope="module")
def golden() -> Rig:
    """A fault-free run of 7 s to its end. Not to be changed."""
    return finished(new_rig())


@pytest.fixture(scope="module")
def truth(golden: Rig) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """q, dq, tau of the motion at 1 kHz, 0 to 7 s, (7001, 6) each."""
    zero = golden.controller.time_zero
    rows = [row for row in golden.rack.truth if zero <= row.time_ns <= zero + DURATION]
    assert len(rows) == 7001
    return np.array([row.q for row in rows]), np.array([row.dq for row in rows]), np.array([row.tau for row in rows])


# ---- fault-free ---------------------------------------------------------------------------------------------------


def test_golden_run_walks_to_its_end_without_a_complaint(golden: Rig) -> None:
    """3500 cycles; no value late, no event, no frame dropped, no two senders with one id."""
    controller = golden.controller
    assert controller.completed
    assert (controller.events, controller.late) == ([], [0] * 6)
    assert [sample.cycle for sample in controller.samples] == list(range(3500))
    for medium in (golden.controller_bus, golden.drive_bus):
        assert [port.dropped for port in medium.ports] == [0] * len(medium.ports)
        assert medium.collisions == 0


@pytest.mark.parametrize("joint", range(6), ids=NAMES)
def test_golden_run_tracks_the_gait_within_10_mrad(
    golden: Rig, truth: tuple[np.ndarray, np.ndarray, np.ndarray], joint: int
) -> None:
    """RMSE of reference against the plant at the SYNCs, over 7 s: 0.01 rad is a fifth of the paper's shortest fault."""
    wanted = np.array([sample.q_d[joint] for sample in golden.controller.samples])
    error = truth[0][:-1:2, joint] - wanted
    assert math.sqrt(np.mean(error**2)) < 0.01


@pytest.mark.parametrize("joint", range(6), ids=NAMES)
def test_golden_run_stays_inside_every_limit(
    golden: Rig, truth: tuple[np.ndarray, np.ndarray, np.ndarray], joint: int
) -> None:
    """Paper, table 1: torque command before the clamp; angle, speed and torque of the plant at 1 kHz."""
    limits = limits_of(NAMES[joint])
    q, dq, tau = (values[:, joint] for values in truth)
    assert max(abs(sample.tau_command[joint]) for sample in golden.controller.samples) <= limits.torque_nm
    assert np.abs(tau).max() <= limits.torque_nm
    assert np.abs(dq).max() <= limits.speed_rad_s
    assert limits.min_angle_rad <= q.min() < q.max() <= limits.max_angle_rad


@pytest.mark.parametrize(
    ("kind", "torque_nm", "speed_rpm"), [("hip", 66, 21.8), ("knee", 38, 44.9), ("ankle", 10, 26.2)]
)
def test_golden_run_reaches_the_known_peaks(
    golden: Rig, truth: tuple[np.ndarray, np.ndarray, np.ndarray], kind: str, torque_nm: float, speed_rpm: float
) -> None:
    """Stride time 1.5 s: about 66/38/10 N m and 21.8/44.9/26.2 rpm (3 %: the figures are rounded and "about")."""
    joints = [at for at, name in enumerate(NAMES) if name.endswith(kind)]
    command = max(abs(sample.tau_command[at]) for sample in golden.controller.samples for at in joints)
    assert command == pytest.approx(torque_nm, rel=0.03)
    assert np.abs(truth[1][:, joints]).max() * 30 / math.pi == pytest.approx(speed_rpm, rel=0.03)


@pytest.mark.parametrize("bus", [CONTROLLER_BUS, DRIVE_BUS])
def test_golden_run_loads_the_bus_as_planned(golden: Rig, bus: int) -> None:
    """55..85 % of 1 Mbit/s over the 7 s of motion."""
    zero = golden.controller.time_zero
    rows = [row for row in golden.loop.trace if row.bus == bus]
    load = sum(row.frame.bits * 1000 for row in rows if zero < row.end_ns <= zero + DURATION) / DURATION
    assert 0.55 < load < 0.85


def test_gateway_takes_time_zero_from_the_bus(golden: Rig) -> None:
    """The SYNC of time 0 as it arrives at the gateway: one SYNC frame (55..65 us) after its request."""
    delay = golden.gateway.time_zero - golden.controller.time_zero
    assert 55_000 <= delay <= 65_000
    assert golden.gateway.time_zero in {row.end_ns for row in golden.loop.trace if row.frame.can_id == 0x080}


def test_physics_has_a_row_for_every_millisecond_from_power_up(golden: Rig) -> None:
    """1 kHz, from the first step to the last, whatever the bus does."""
    assert [row.time_ns for row in golden.rack.truth] == [k * MS for k in range(1, golden.loop.now // MS + 1)]


def test_the_end_leaves_disabled_drives_and_a_quiet_network(golden: Rig) -> None:
    """Statuswords Switch on disabled, no torque, devices Pre-operational; only heartbeats are left on the buses."""
    assert statuswords(golden) == [SWITCH_ON_DISABLED] * 6
    assert torques(golden) == [0.0] * 6
    assert [device.nmt.state for device in golden.rack.devices] == [NmtState.PRE_OPERATIONAL] * 6
    end = max(row.end_ns for row in golden.loop.trace if row.frame.can_id == 0)
    after = {row.frame.can_id for row in golden.loop.trace if row.end_ns > end + CYCLE}
    assert after <= {0x77F, *range(0x701, 0x707)}


def test_two_builds_of_a_rig_run_alike() -> None:
    """Same scenario, same version: the same trace to the nanosecond and the same plant to the last bit."""
    first, second = (finished(new_rig(duration_ns=SECOND)) for _ in range(2))
    assert trace(first.loop.trace) == trace(second.loop.trace)
    assert [row.q for row in first.rack.truth] == [row.q for row in second.rack.truth]


def test_a_gateway_without_injectors_does_not_change_the_motion(golden: Rig) -> None:
    """An injector that never becomes active leaves the run as it is, row by row."""
    rig = new_rig([injector(Drop(), 60 * SECOND, SECOND, 0x185)], duration_ns=SECOND)
    run_to(rig, Phase.MOTION)
    rig.loop.run_until(rig.controller.time_zero + SECOND - CYCLE)
    ended = rig.loop.now
    assert trace(rig.loop.trace) == [row for row in trace(golden.loop.trace) if row[0] <= ended]


# ---- pins ---------------------------------------------------------------------------------------------------------


def knee_range_deg(rig: Rig) -> tuple[float, float]:
    zero = rig.controller.time_zero
    angles = [row.q[RIGHT_KNEE] for row in rig.rack.truth if zero <= row.time_ns <= zero + DURATION]
    return math.degrees(min(angles)), math.degrees(max(angles))


def test_pins_do_nothing_where_no_joint_reaches_them(golden: Rig) -> None:
    """The fault-free gait stays inside the range of travel: with pins the same trace."""
    pinned = finished(new_rig(stops=True))
    assert trace(pinned.loop.trace) == trace(golden.loop.trace)


@pytest.mark.parametrize("stops", [True, False])
def test_pins_hold_a_knee_that_a_frozen_encoder_drives_out_of_its_range(stops: bool) -> None:
    """Encoder frozen for 0.5 s in terminal swing: without pins the knee overextends by over 10 deg, with them < 3."""
    rig = finished(new_rig([injector(StuckAt(KNEE_POSITION), 4100 * MS, 500 * MS, 0x185)], stops=stops))
    assert rig.controller.completed
    low, high = knee_range_deg(rig)
    assert low > -93
    if stops:
        assert 0 < high < 3  # it does lean on the pin: soft contacts yield
    else:
        assert high > 10


# ---- lost samples -------------------------------------------------------------------------------------------------


def test_lost_samples_are_waited_for_held_and_counted() -> None:
    """TPDO1 of one drive lost for 20 ms: the deadline fires ten times, commands still reach the drives by 1.92 ms."""
    start = 500 * MS
    rig = finished(new_rig([injector(Drop(), start, 20 * MS, 0x185)], duration_ns=SECOND))
    assert rig.controller.completed
    assert rig.controller.late == [0, 0, 0, 0, 10, 0]
    for cycle in range(10):
        begin = rig.controller.time_zero + start + cycle * CYCLE
        rows = [row for row in rig.loop.trace if begin < row.end_ns <= begin + CYCLE]
        commands = [row for row in rows if 0x201 <= row.frame.can_id <= 0x206]
        first = min(row.end_ns - row.frame.bits * 1000 for row in commands if row.bus == CONTROLLER_BUS)
        assert 1_200_000 <= first - begin < 1_200_000 + 135_000  # a frame may be on the bus at the deadline
        arrivals = [row.end_ns - begin for row in commands if row.bus == DRIVE_BUS]
        assert len(arrivals) == 6
        assert max(arrivals) <= 1_920_000


# ---- cut cables ---------------------------------------------------------------------------------------------------


def bus_of(rig: Rig, bus: int) -> Medium:
    return rig.drive_bus if bus == DRIVE_BUS else rig.controller_bus


def cut_after_3_s(bus: int) -> tuple[Rig, int]:
    """A rig in motion whose cable breaks 3 s after time 0; it, and when."""
    rig = run_to(new_rig(), Phase.MOTION)
    cut = rig.controller.time_zero + 3 * SECOND
    rig.loop.run_until(cut)
    bus_of(rig, bus).cut()
    return rig, cut


def last_arrivals(rig: Rig, *can_ids: int) -> list[int]:
    """When each of these last came over the drive bus."""
    found = dict.fromkeys(can_ids, 0)
    for row in rig.loop.trace:
        if row.bus == DRIVE_BUS and row.frame.can_id in found:
            found[row.frame.can_id] = row.end_ns
    return list(found.values())


@pytest.mark.parametrize("bus", [CONTROLLER_BUS, DRIVE_BUS], ids=["controller", "drive"])
def test_cut_bus_stops_drives_then_controller_and_nothing_hangs(bus: int) -> None:
    """SYNC loss after 10 ms, RPDO deadline after 20 ms, heartbeats after 300 ms on both sides; then the run ends."""
    rig, cut = cut_after_3_s(bus)
    driving = torques(rig)
    assert max(abs(nm) for nm in driving) > 1

    (sync,) = last_arrivals(rig, 0x080)  # the drives have heard this one, and no other will come
    rig.loop.run_until(sync + 5 * CYCLE - 1)
    assert torques(rig) == driving  # held until the loss is certain
    rig.loop.run_until(sync + 5 * CYCLE)
    assert torques(rig) == [0.0] * 6
    assert statuswords(rig) == [SWITCH_ON_DISABLED] * 6
    assert error_codes(rig) == [SYNC_LOST] * 6
    assert sync + 5 * CYCLE <= cut + 10 * MS

    commands = last_arrivals(rig, *range(0x201, 0x207))
    rig.loop.run_until(max(commands) + 20 * MS)
    assert error_codes(rig) == [RPDO_LATE] * 6

    heard = min(last_arrivals(rig, *range(0x701, 0x707)))
    rig.loop.run_until(cut + 300 * MS)
    assert error_codes(rig) == [HEARTBEAT_LOST] * 6
    lost = [event for event in rig.controller.events if event.kind == "heartbeat_lost"]
    assert sorted(event.joint for event in lost) == sorted(NAMES)
    assert lost[0].time_ns - heard <= 300 * MS + CYCLE  # the last hop to the controller
    assert all(cut < event.time_ns <= cut + 300 * MS for event in lost)
    assert rig.controller.phase is Phase.STOPPING
    assert [device.emcy.register for device in rig.rack.devices] == [0x11] * 6
    for device in rig.rack.devices:  # newest first
        assert device.emcy.history == [HEARTBEAT_LOST, RPDO_LATE, SYNC_LOST]

    run_to(rig, Phase.STOPPED, cut + 600 * MS)
    assert not rig.controller.completed
    assert [event.kind for event in rig.controller.events[6:]] == ["still_enabled"] * 6  # nobody could tell it


@pytest.mark.parametrize("bus", [CONTROLLER_BUS, DRIVE_BUS], ids=["controller", "drive"])
def test_plant_falls_on_as_bare_physics_says_when_the_bus_is_cut(bus: int) -> None:
    """Physics does not hang on SYNC: with the drives disabled the legs swing freely, step by step as a plant alone."""
    rig, cut = cut_after_3_s(bus)
    rig.loop.run_until(cut + 20 * MS)
    alone: Plant = copy.deepcopy(rig.rack.plant)
    rows = len(rig.rack.truth)
    rig.loop.run_until(cut + 2 * SECOND)
    fall = rig.rack.truth[rows:]
    assert len(fall) == 1980
    for row in fall:
        alone.step([0.0] * 6)
        assert row.q == alone.q
    assert max(abs(q - start) for q, start in zip(fall[-1].q, fall[0].q, strict=True)) > 0.5  # rad: legs do swing


@pytest.mark.parametrize("bus", [CONTROLLER_BUS, DRIVE_BUS], ids=["controller", "drive"])
def test_mended_bus_brings_the_errors_but_no_torque(bus: int) -> None:
    """The queues empty themselves, EMCYs of every drive among them; stale commands do not move a disabled drive."""
    rig, cut = cut_after_3_s(bus)
    rig.loop.run_until(cut + SECOND)
    mended = rig.loop.now
    before = len(rig.loop.trace)
    bus_of(rig, bus).mend()
    for _ in range(500):
        rig.loop.run_until(rig.loop.now + MS)
        assert torques(rig) == [0.0] * 6
    rows = [row for row in rig.loop.trace[before:] if row.bus == CONTROLLER_BUS]
    for node in range(1, 7):
        codes = [row.frame.data[0] | row.frame.data[1] << 8 for row in rows if row.frame.can_id == 0x080 + node]
        assert codes[:3] == [SYNC_LOST, RPDO_LATE, HEARTBEAT_LOST]
    noted = {event.joint for event in rig.controller.events if event.kind == "emcy" and event.time_ns > mended}
    assert noted == set(NAMES)
    tail = {row.frame.can_id for row in rig.loop.trace if row.end_ns > mended + 200 * MS}
    assert tail == {0x77F, *range(0x701, 0x707)}  # heartbeats again, and nothing else
    assert [len(medium.waiting) for medium in rig.loop.media] == [0, 0]


def test_bus_mended_within_the_drives_patience_goes_on() -> None:
    """4 ms of cut, less than 5 SYNC periods: held commands, late values, no error, the motion is completed."""
    rig = run_to(new_rig(duration_ns=SECOND), Phase.MOTION)
    rig.loop.run_until(rig.controller.time_zero + 500 * MS)
    rig.drive_bus.cut()
    rig.loop.run_until(rig.loop.now + 2 * CYCLE)
    rig.drive_bus.mend()
    finished(rig)
    assert rig.controller.completed
    assert rig.controller.events == []
    assert all(1 <= late <= 3 for late in rig.controller.late)


# ---- a drive restarts ---------------------------------------------------------------------------------------------


class Saboteur(Node):
    """Sends one frame at one time."""

    def __init__(self, at_ns: int, frame: Frame) -> None:
        super().__init__()
        self.wake_at = at_ns
        self.frame = frame

    def wake(self, now: int, out: Out) -> None:
        out.send(0, self.frame)
        self.wake_at = NEVER


@pytest.mark.parametrize(
    ("frame", "kind", "within_ns"),
    [
        (Frame(0x000, b"\x81\x05"), "reboot", 10 * MS),  # reset node: boot-up 5 ms later
        (Frame(0x000, b"\x82\x05"), "reboot", 10 * MS),  # reset communication
        (Frame(0x205, b"\x00\x00\x00\x00"), "drive_stopped", 30 * MS),  # another master disables it: TPDO2 tells
    ],
)
def test_one_drive_out_of_service_ends_the_motion_for_all(frame: Frame, kind: str, within_ns: int) -> None:
    """Stop rule: the controller notices by itself, and disables the other five."""
    rig = new_rig(duration_ns=2 * SECOND)
    saboteur = Saboteur(2700 * MS + 1_950_000, frame)  # after the cycle's own RPDO
    rig.loop.connect(saboteur, [rig.drive_bus])
    run_to(rig, Phase.MOTION)
    rig.loop.run_until(2700 * MS)
    assert not rig.controller.events
    finished(rig)
    event = rig.controller.events[0]
    assert (event.joint, event.kind) == ("right_knee", kind)
    assert 0 < event.time_ns - 2700 * MS <= within_ns
    assert not rig.controller.completed
    assert torques(rig) == [0.0] * 6
    assert all(word & 0x6F == 0x40 for word in statuswords(rig))


@pytest.mark.parametrize(("command", "state"), [(0x80, 127), (0x02, 4)])
def test_drive_put_out_of_operational_ends_the_motion(command: int, state: int) -> None:
    """Stop rule: that drive has left Operation enabled (6007) and cannot say so by PDO; its heartbeat says 7F, or 4."""
    rig = new_rig(duration_ns=SECOND)
    rig.loop.connect(Saboteur(2000 * MS + 1_950_000, Frame(0x000, bytes((command, 5)))), [rig.drive_bus])
    run_to(rig, Phase.MOTION)
    rig.loop.run_until(2000 * MS + 150 * MS)  # a heartbeat period, and the way to the controller
    assert torques(rig)[RIGHT_KNEE] == 0.0
    assert rig.controller.phase is not Phase.MOTION
    (event,) = rig.controller.events
    assert (event.joint, event.kind) == ("right_knee", "nmt_state")
    assert f"NMT state {state}" in event.text
    finished(rig)
    assert not rig.controller.completed
    assert torques(rig) == [0.0] * 6


# ---- supervision that a fault takes away --------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("cob_id", "code", "joints", "after_ns", "within_ns"),
    [
        (0x080, SYNC_LOST, NAMES, 8 * MS, 10 * MS),  # 5 periods from the last SYNC heard, up to one before the drop
        (0x205, RPDO_LATE, ("right_knee",), 18 * MS, 20 * MS),  # 20 ms from the last command heard
        (0x77F, HEARTBEAT_LOST, NAMES, 200 * MS, 300 * MS),  # 300 ms from the last heartbeat heard
    ],
)
def test_drive_that_loses_its_master_ends_the_motion_by_its_emcy(
    cob_id: int, code: int, joints: tuple[str, ...], after_ns: int, within_ns: int
) -> None:
    """6007 = 2: the drives disable, their EMCY reaches the controller within its two hops, and all six are disabled."""
    rig = new_rig([dropped(cob_id, SECOND, SECOND)], duration_ns=2 * SECOND)
    run_to(rig, Phase.STOPPING)
    drop = rig.controller.time_zero + SECOND
    first = rig.controller.events[0]
    assert (first.joint, first.kind) == (joints[0], "emcy")
    assert f"{code:04X}" in first.text
    hops = 6 * 135_000 * 2  # six drives tell it at once, each over two buses; 135 us is the longest frame
    assert drop + after_ns <= first.time_ns <= drop + within_ns + 2 * 135_000 + hops
    finished(rig)
    rig.loop.run_until(rig.loop.now + 100 * MS)  # a heartbeat period
    assert {event.joint for event in rig.controller.events if f"{code:04X}" in event.text} == set(joints)
    assert not rig.controller.completed
    assert torques(rig) == [0.0] * 6
    assert all(word & 0x6F == 0x40 for word in statuswords(rig))
    assert error_codes(rig) == [0] * 6  # the injection ended with the motion: SYNC, commands, heartbeats came again
    after = [row for row in rig.loop.trace if row.end_ns > first.time_ns + CYCLE and 0x201 <= row.frame.can_id <= 0x206]
    assert after
    assert {row.frame.data for row in after} == {b"\x00\x00\x00\x00"}  # disable voltage, no torque


@pytest.mark.parametrize(("lost", "completed"), [(3, True), (5, False)])
def test_drives_are_patient_for_five_sync_periods(lost: int, completed: bool) -> None:
    """Three SYNCs lost for all: held for 8 ms, the motion goes on; five: 12 ms between two SYNCs, it ends."""
    rig = finished(new_rig([dropped(0x080, 500 * MS, lost * CYCLE)], duration_ns=SECOND))
    assert rig.controller.completed is completed
    assert ([event.kind for event in rig.controller.events] == []) is completed
    (record,) = rig.gateway.records
    assert record.frames_injected == lost


def test_drive_that_never_beats_is_missed_before_the_motion() -> None:
    """Every heartbeat of one drive is lost on its way but the boot-up message: 300 ms after the start command."""
    silence = dropped(0x705, 60 * MS, 10 * SECOND, to_drives=False, from_power_up=True)
    rig = new_rig([silence])
    run_to(rig, Phase.STOPPED)
    (start,) = [
        row.end_ns - row.frame.bits * 1000
        for row in rig.loop.trace
        if row.bus == CONTROLLER_BUS and row.frame.data == b"\x01\x00" and row.frame.can_id == 0
    ]
    event = rig.controller.events[0]
    assert (event.joint, event.kind) == ("right_knee", "heartbeat_lost")
    assert start - 135_000 + 300 * MS <= event.time_ns <= start + 300 * MS
    assert not rig.controller.completed
    assert torques(rig) == [0.0] * 6
    with pytest.raises(NotStartedError, match="faulted run: the motion never began: right_knee: heartbeat lost"):
        record_of(rig)


# ---- what is recorded and judged ----------------------------------------------------------------------------------

PINNED = RigParams(PLAN, True, STRIDE, DURATION)
LIMITS = {name: limits_of(name) for name in NAMES}
SOFT_PINS = math.radians(3.0)
"""How far limp legs sink into the pins: soft contacts yield."""


@pytest.fixture(scope="module")
def pinned_golden() -> RunRecord:
    """The fault-free run with pins. Not to be changed."""
    return run_rig(PINNED, [])[0]


def test_sync_lost_for_good_is_detected_and_leaves_the_legs_in_their_range(pinned_golden: RunRecord) -> None:
    """From 1 s on no SYNC reaches the drives: valid, ended early, no failure within the give of the pins."""
    faulted, _ = run_rig(PINNED, [dropped(0x080, SECOND, 60 * SECOND)])
    found = judge(NAMES, LIMITS, pinned_golden, faulted, tolerance_rad=SOFT_PINS)
    assert (found.outcome, found.passed, found.failures) == ("detected_safe", True, ())
    assert (faulted.valid, faulted.completed) == (True, False)
    (loss,) = faulted.activations
    assert loss.signal == "SYNC 0x080"
    assert loss.start_ns == faulted.time0_ns + SECOND
    assert loss.frames_seen == loss.frames_injected == loss.frames_lost == 5  # then the drives knew, and all ended
    told = [note for note in faulted.notes if "8700" in note.text]
    assert sorted(note.node for note in told) == sorted(NAMES)
    assert all(1.0 < note.time_s < 1.012 for note in told)
    last = faulted.commands.t_s[-1]
    assert 1.0 < last < 1.012  # the controller wanted nothing after that


def test_limp_legs_that_leave_their_range_are_a_failure_all_the_same(pinned_golden: RunRecord) -> None:
    """Detected is not safe by itself: without pins the legs swing past their range after the motion has ended."""
    faulted, _ = run_rig(RigParams(PLAN, False, STRIDE, DURATION), [dropped(0x080, SECOND, 60 * SECOND)])
    found = judge(NAMES, LIMITS, pinned_golden, faulted, tolerance_rad=SOFT_PINS)
    assert (found.outcome, found.passed, faulted.completed) == ("failure", False, False)
    assert all(one.time_s > 1.012 for one in found.failures)


@pytest.mark.parametrize("bus", [CONTROLLER_BUS, DRIVE_BUS], ids=["controller", "drive"])
def test_run_whose_cable_is_cut_is_valid_and_says_what_happened(pinned_golden: RunRecord, bus: int) -> None:
    """Full transmit queues are explained by the cut: the record can be judged, and names every drive that was lost."""
    rig = run_to(build_rig(PINNED, []), Phase.MOTION)
    rig.loop.run_until(rig.controller.time_zero + 3 * SECOND)
    bus_of(rig, bus).cut()
    drive_through(rig, lambda share: None)
    assert rig.loop.now > rig.controller.time_zero + DURATION
    faulted = record_of(rig)
    assert (faulted.valid, faulted.invalid_reasons, faulted.completed) == (True, [], False)
    assert faulted.buses[bus].queue_overflows > 0
    lost = [note for note in faulted.notes if note.kind == "heartbeat_lost"]
    assert sorted(note.node for note in lost) == sorted(NAMES)
    assert all(3.0 < note.time_s <= 3.3 for note in lost)
    assert [note.node for note in faulted.notes if note.kind == "still_enabled"] == list(NAMES)  # nobody could tell
    assert faulted.truth.t_s[-1] == 7.0  # the plant is watched to the end of the motion time
    assert 3.0 < faulted.commands.t_s[-1] < 3.3
    found = judge(NAMES, LIMITS, pinned_golden, faulted, tolerance_rad=SOFT_PINS)
    assert (found.outcome, found.passed) == ("detected_safe", True)
    strict = judge(NAMES, LIMITS, pinned_golden, faulted)
    assert strict.outcome == "failure"  # limp feet lean on their pins
    assert min(one.time_s for one in strict.failures) > 3.0


def test_same_loss_of_frames_without_a_cut_is_invalid() -> None:
    """A queue that overflows for no reason proves nothing; nor does a golden run that was given up."""
    rig, _ = cut_after_3_s(DRIVE_BUS)
    drive_through(rig, lambda share: None)
    rig.drive_bus.cuts = 0
    reasons = record_of(rig).invalid_reasons
    assert len(reasons) == 2
    assert "drive bus" in reasons[0]
    assert "lost in full transmit queues" in reasons[0]
    assert "given up without a fault" in reasons[1]


def test_injections_at_or_after_the_end_of_the_motion_are_not_recorded() -> None:
    """[0, duration): one ns before the end is the last start that counts, whatever an injector counts from."""
    duration = SECOND
    ends = [duration - 1, duration, duration + 1, duration + 100 * MS]
    parts = [dropped(0x185, at_ns, 10 * MS, to_drives=False, name=f"n{at_ns}") for at_ns in ends]
    late = dropped(0x186, 4 * SECOND, 10 * MS, to_drives=False, name="power up", from_power_up=True)
    rig = finished(new_rig([*parts, late], duration_ns=duration))
    rig.loop.run_until(5 * SECOND)
    rig.gateway.finish(rig.loop.now)
    record = record_of(rig)
    assert [one.injector for one in record.activations] == [f"n{duration - 1}"]
    assert record.activations[0].start_ns == record.time0_ns + duration - 1
    assert record.completed
    after = [one.injector for one in record.activations_after]
    assert after == [one.injector for one in rig.gateway.records[1:]]
    assert after[0] == f"n{duration}"
    assert after[-1] == "power up"


# ---- other bus plans ----------------------------------------------------------------------------------------------


def test_rig_walks_on_a_plan_with_other_mappings_ids_and_rates() -> None:
    """The drives are configured from the plan, whatever their defaults: order, COB-IDs, rates, a PDO more."""
    pdos = (
        Pdo("RPDO1", 0x300, 1, (TARGET_TORQUE, CONTROLWORD)),
        Pdo("TPDO1", 0x380, 1, (VELOCITY, POSITION)),
        Pdo("TPDO2", 0x400, 5, (ERROR_CODE, STATUSWORD)),
        Pdo("TPDO3", 0x480, 20, (TORQUE,)),
    )
    plan = BusPlan(default_joints(), pdos=pdos)
    rig = build_rig(RigParams(plan, False, STRIDE, 500 * MS), [])
    finished(rig)
    assert rig.controller.completed
    assert (rig.controller.events, rig.controller.late) == ([], [0] * 6)
    for joint, name in enumerate(NAMES):
        wanted = np.array([sample.q_d[joint] for sample in rig.controller.samples])
        zero = rig.controller.time_zero
        rows = {row.time_ns: row.q[joint] for row in rig.rack.truth}
        found = np.array([rows[zero + sample.cycle * CYCLE] for sample in rig.controller.samples])
        assert math.sqrt(np.mean((found - wanted) ** 2)) < 0.01, name
    zero = rig.controller.time_zero
    frames = [row.frame for row in rig.loop.trace if row.bus == DRIVE_BUS and zero < row.end_ns <= zero + 480 * MS]
    for node in range(1, 7):
        sizes = {base: [len(frame.data) for frame in frames if frame.can_id == base + node] for base in (0x300, 0x380)}
        assert sizes == {0x300: [4] * 240, 0x380: [8] * 240}
        assert [len(frame.data) for frame in frames if frame.can_id == 0x400 + node] == [4] * 48
        assert [len(frame.data) for frame in frames if frame.can_id == 0x480 + node] == [2] * 12
    assert not {frame.can_id for frame in frames} & {*range(0x181, 0x187), *range(0x201, 0x207), *range(0x281, 0x287)}


@pytest.mark.parametrize(("cycle_ns", "counter"), [(2 * MS, 240), (4 * MS, 10), (4 * MS, 0)])
def test_drives_get_period_counter_and_deadline_of_the_plan(cycle_ns: int, counter: int) -> None:
    """0x1006 in us, 0x1019, 0x1400:5 = 10 cycles in ms, 0x1016 the master's node; in each drive as the plan says."""
    plan = dataclasses.replace(PLAN, cycle_ns=cycle_ns, sync_counter=counter)
    rig = build_rig(RigParams(plan, False, STRIDE, SECOND), [])
    run_to(rig, Phase.ENABLING)
    for device in rig.rack.devices:
        values = device.od.values
        assert values[0x1006 << 8] == cycle_ns // 1000
        assert values[0x1019 << 8] == counter
        assert values[0x1400 << 8 | 5] == 10 * cycle_ns // MS
        assert values[0x1016 << 8 | 1] == 127 << 16 | 300
        assert values[0x1017 << 8] == 100
    run_to(rig, Phase.STARTING)


# ---- a start that fails -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("bus", [CONTROLLER_BUS, DRIVE_BUS], ids=["controller", "drive"])
def test_rig_whose_cable_is_broken_from_the_start_says_so(bus: int) -> None:
    """No boot-up message within 1 s: the run ends as failed, the text names drive, node, limit and what to check."""
    rig = new_rig()
    bus_of(rig, bus).cut()
    run_to(rig, Phase.FAILED)
    assert POWER_UP_NS + 1000 * MS <= rig.loop.now <= POWER_UP_NS + 1000 * MS + CYCLE
    for part in ("left_hip", "node 1", "boot-up", "1 s", "check"):
        assert part in rig.master.failure
    rig.loop.run_until(2 * SECOND)
    assert torques(rig) == [0.0] * 6
    assert not [row for row in rig.loop.trace if row.frame.can_id == 0x080]


# ---- copies -------------------------------------------------------------------------------------------------------


def chance(name: str) -> Injector:
    """Freezes the knee encoder for 10 ms, 20 times a second on the average."""
    rng = stream(7, 0, name)
    target = Target(True, False, (0x185,))
    event = FailureProbability(0.02, MS, rng)
    return Injector(name, target, StuckAt(KNEE_POSITION), event, ConstantTime(10 * MS), None, rng, True, False)


@pytest.mark.parametrize("at_ns", [10 * MS, 1000 * MS, 1608 * MS, 1800 * MS + 612_345], ids=str)
def test_a_copied_rig_goes_on_with_the_same_trace(at_ns: int) -> None:
    """Snapshot between two events (boot, fade-in, time 0, in a frame): plant, queues and random draws go on."""
    rig = new_rig([chance("x")], duration_ns=600 * MS)
    rig.loop.run_until(at_ns)
    first = copy.deepcopy(rig)
    second = copy.deepcopy(rig)
    for one in (first, rig, second):  # each alone: nothing is shared that changes
        finished(one)
    assert len(rig.gateway.records) > 3
    for twin in (first, second):
        assert trace(twin.loop.trace) == trace(rig.loop.trace)
        assert [row.q for row in twin.rack.truth] == [row.q for row in rig.rack.truth]
        assert [record.start_ns for record in twin.gateway.records] == [
            record.start_ns for record in rig.gateway.records
        ]


def test_a_copied_rig_shares_the_model_and_nothing_that_moves() -> None:
    """The copy is a rig of its own around the same MuJoCo model; its parts belong to each other."""
    rig = run_to(new_rig(duration_ns=SECOND), Phase.STARTING)
    twin = copy.deepcopy(rig)
    assert twin.rack.plant.model is rig.rack.plant.model
    assert twin.rack.plant.data is not rig.rack.plant.data
    assert twin.loop.nodes == [twin.master, twin.gateway, twin.rack]
    assert twin.master.application is twin.controller
    assert twin.loop.media == [twin.controller_bus, twin.drive_bus]
    before = trace(rig.loop.trace)
    twin.loop.run_until(twin.loop.now + 100 * MS)
    assert trace(rig.loop.trace) == before
