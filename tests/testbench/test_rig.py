"""The whole rig: a fault-free walk inside every limit, pins, lost samples, other bus plans, copies."""

import copy
import dataclasses
import math

import numpy as np
import pytest

from canopen_exo.bus.node import MS, SECOND
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
from fi_gateway.effects import ConstantTime
from fi_gateway.events import FailureProbability
from fi_gateway.faults import Drop, StuckAt
from fi_gateway.injector import Injector, Target, stream
from hlc.limits import limits_of
from hlc.node import Phase
from testbench.rig import CONTROLLER_BUS, DRIVE_BUS, Rig, RigParams, build_rig
from testbench.scenario import default_joints
from tests.testbench.whole_rig import (
    CYCLE,
    DURATION,
    KNEE_POSITION,
    NAMES,
    PLAN,
    RIGHT_KNEE,
    STRIDE,
    SWITCH_ON_DISABLED,
    bus_of,
    finished,
    injector,
    new_rig,
    run_to,
    statuswords,
    torques,
    trace,
)

pytestmark = pytest.mark.run


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
