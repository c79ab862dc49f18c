"""The whole rig: cut cables, a restarting drive, supervision that a fault takes away."""

import copy

import pytest

from canopen_exo.bus.frame import Frame
from canopen_exo.bus.node import MS, NEVER, SECOND, Node, Out
from hlc.node import Phase
from joint_emulators.plant import Plant
from testbench.rig import CONTROLLER_BUS, DRIVE_BUS, Rig
from testbench.run import NotStartedError, record_of
from tests.testbench.whole_rig import (
    CYCLE,
    HEARTBEAT_LOST,
    NAMES,
    RIGHT_KNEE,
    RPDO_LATE,
    SWITCH_ON_DISABLED,
    SYNC_LOST,
    bus_of,
    cut_after_3_s,
    dropped,
    error_codes,
    finished,
    new_rig,
    run_to,
    statuswords,
    torques,
)

pytestmark = pytest.mark.run


# ---- cut cables ---------------------------------------------------------------------------------------------------


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
