"""Parts put together, held against a lock-step run: cut into parts, it must come out of the merge as it went in."""

from dataclasses import replace

import numpy as np
import pytest

from canopen_exo.bus.frame import FLAG_REMOTE, Frame
from canopen_exo.bus.lateness import Lateness
from canopen_exo.bus.medium import Transmission
from canopen_exo.bus.node import MS, NEVER
from canopen_exo.plan import RPDO1, SYNC
from fi_gateway.injector import Injector
from fi_gateway.schema import build_injectors
from testbench.merge import GIVEN_UP, IncompleteError, add_reasons, merge
from testbench.parts import ControlNote, GatewayPart, HlcPart, JointsPart, NotedEvent, Service, reach_of
from testbench.record import RunRecord
from testbench.rig import CONTROLLER_BUS, DRIVE_BUS, Rig, build_rig
from testbench.run import drive_through, record_of, rig_params
from testbench.scenario import Scenario, parse_scenario
from testbench.timing import Timing, TimingLimits, judge_timing

SCENARIO = """\
name: parts
rig: {plant: suspended, stops: off, rate: 100 Hz}
motion: {gait: walking, stride: 1.5 s, duration: 1 s}
injectors:
  bias:
    target: {bus: to_controller, node: right_knee, signal: position}
    fault: {type: bias, value: 0.05 rad}
    event: {type: at, time: 0.3 s}
    effect: {type: constant_time, duration: 0.2 s}
  lost:
    target: {bus: to_drives, node: left_hip, pdo: RPDO1}
    fault: {type: drop}
    event: {type: at, time: 0.6 s}
    effect: {type: constant_time, duration: 0.05 s}
"""

Parts = tuple[HlcPart, GatewayPart, JointsPart]


def service() -> Service:
    return Service(0, NEVER, Lateness(), {})


def seen_by(rig: Rig, bus: int, index: int, own: dict[int, int]) -> list[tuple[int, Transmission]]:
    """Rows of one bus as a process saw them. own: its senders on the medium -> the port it sent on."""
    return [
        (place, Transmission(row.end_ns, index, row.frame, own.get(row.sender, -1)))
        for place, row in enumerate(rig.loop.trace)
        if row.bus == bus
    ]


def parts_of(rig: Rig) -> Parts:
    """A lock-step run, as its processes would have left it."""
    controller, count = rig.controller, len(rig.rack.devices)
    table = {
        name: np.array([getattr(sample, name) for sample in controller.samples])
        for name in ("q_d", "dq_d", "tau_command")
    }
    truth = {name: np.array([getattr(row, name) for row in rig.rack.truth]) for name in ("q", "dq", "tau")}
    hlc = HlcPart(
        service(),
        controller.time_zero,
        controller.completed,
        list(controller.late),
        [NotedEvent(one.time_ns, one.joint, one.kind, one.text) for one in controller.events],
        np.array([sample.cycle for sample in controller.samples]),
        table["q_d"],
        table["dq_d"],
        table["tau_command"],
        [row for _, row in seen_by(rig, CONTROLLER_BUS, 0, {0: 0})],
    )
    gateway_rows = seen_by(rig, CONTROLLER_BUS, 0, {1: 0}) + seen_by(rig, DRIVE_BUS, 1, {0: 1})
    gateway = GatewayPart(
        service(),
        rig.gateway.time_zero,
        {one.name: reach_of(one) for one in rig.gateway.injectors},
        list(rig.gateway.frames),
        list(rig.gateway.lost),
        [Lateness(), Lateness()],
        rig.gateway.records,
        [],
        [row for _, row in sorted(gateway_rows, key=lambda pair: pair[0])],
    )
    joints = JointsPart(
        service(),
        np.array([row.time_ns for row in rig.rack.truth]),
        truth["q"],
        truth["dq"],
        truth["tau"],
        [row for _, row in seen_by(rig, DRIVE_BUS, 0, {port + 1: port for port in range(count)})],
    )
    return hlc, gateway, joints


@pytest.fixture(scope="module")
def scenario() -> Scenario:
    return parse_scenario(SCENARIO)


@pytest.fixture(scope="module")
def rig(scenario: Scenario) -> Rig:
    injectors: list[Injector] = build_injectors(scenario.injectors, scenario.plan, scenario.seed, 0)
    made = build_rig(rig_params(scenario), injectors)
    drive_through(made, lambda share: None)
    return made


@pytest.fixture(scope="module")
def expected(rig: Rig) -> RunRecord:
    return record_of(rig)


@pytest.fixture(scope="module")
def parts(rig: Rig) -> Parts:
    return parts_of(rig)


def test_parts_of_a_run_make_its_record(scenario: Scenario, rig: Rig, expected: RunRecord, parts: Parts) -> None:
    """Design: `run --realtime` gives the same result document as lock-step."""
    found = merge(scenario.plan, expected.duration_ns, *parts, [])
    for name in ("t_s", "q", "dq", "tau"):
        assert np.array_equal(getattr(found.truth, name), getattr(expected.truth, name))
    for name in ("t_s", "q_ref", "dq_ref", "tau_command"):
        assert np.array_equal(getattr(found.commands, name), getattr(expected.commands, name))
    assert found.time0_ns == expected.time0_ns
    assert found.notes == expected.notes
    assert (found.completed, found.held_cycles, found.source) == (True, expected.held_cycles, "plant")
    assert len(found.activations) == 2
    assert [*found.activations, *found.activations_after] == parts[1].activations
    for one, other in zip(found.buses, expected.buses, strict=True):
        assert (one.name, one.frames, one.queue_overflows) == (other.name, other.frames, 0)
        assert one.load == pytest.approx(other.load, rel=1e-12)  # sums of the same bits, in another unit
    assert sorted(row.end_ns for row in found.rows) == sorted(row.end_ns for row in expected.rows)
    assert {(row.bus, row.frame) for row in found.rows} == {(row.bus, row.frame) for row in expected.rows}


def judged(scenario: Scenario, hlc: HlcPart | None, gateway: GatewayPart | None, joints: JointsPart | None) -> Timing:
    assert hlc is not None
    return judge_timing(scenario.plan, hlc.time_zero, hlc.cycles.size, hlc, gateway, joints)


def test_lock_step_run_has_no_late_cycle_and_lost_nothing(scenario: Scenario, parts: Parts) -> None:
    """Neither simulated bus time nor a fault (frames changed and dropped) counts as lateness or loss."""
    timing = judged(scenario, *parts)
    assert timing.cycles == 100
    assert timing.late == {}
    assert timing.lost == []
    assert timing.reasons(TimingLimits(0.0, 0)) == []


def test_what_one_process_lost_is_named(scenario: Scenario, parts: Parts) -> None:
    """Invalid when a frame was lost: queues, kernel, hub."""
    hlc, gateway, joints = parts
    losing = replace(gateway, service=Service(0, NEVER, Lateness(), {"dropped by vcan0 before they were read": 4}))
    timing = judged(scenario, hlc, losing, joints)
    assert timing.lost == ["gateway: 4 frames dropped by vcan0 before they were read"]
    assert timing.counted == 4


@pytest.mark.parametrize(
    ("bus", "cob_id", "sent_by"),
    [(0, 0x201, "controller"), (0, 0x181, "gateway"), (1, 0x201, "gateway"), (1, 0x186, "joints")],
)
@pytest.mark.parametrize("change", ["lost", "doubled", "swapped"])
def test_frame_that_does_not_travel_as_it_was_sent_is_found(
    scenario: Scenario, parts: Parts, bus: int, cob_id: int, sent_by: str, change: str
) -> None:
    """Loss, repetition and a wrong order between two of our processes, on either bus, either way."""
    hlc, gateway, joints = parts
    rows = {"gateway": gateway.rows, "controller": hlc.rows, "joints": joints.rows}
    receiver = "gateway" if sent_by != "gateway" else ("controller" if bus == 0 else "joints")
    index = bus if receiver == "gateway" else 0
    changed = list(rows[receiver])
    places = [
        at
        for at, row in enumerate(changed)
        if row.bus == index and row.frame.can_id == cob_id and row.sender < 0 and row.end_ns > hlc.time_zero
    ]
    first, second = places[50], places[51]
    assert changed[first].frame != changed[second].frame
    if change == "lost":
        del changed[first]
    elif change == "doubled":
        changed.insert(first, changed[first])
    else:
        changed[first], changed[second] = changed[second], changed[first]
    if receiver == "gateway":
        gateway = replace(gateway, rows=changed)
    elif receiver == "controller":
        hlc = replace(hlc, rows=changed)
    else:
        joints = replace(joints, rows=changed)
    timing = judged(scenario, hlc, gateway, joints)
    name = "drive bus" if bus else "controller bus"
    what = {
        "lost": f"lost: {cob_id:03X} (1)",
        "doubled": f"doubled or out of order: {cob_id:03X} (1)",
        "swapped": f"lost: {cob_id:03X} (1); doubled or out of order: {cob_id:03X} (1)",
    }[change]
    assert f"{name}, frames from {sent_by} to {receiver}: {what}" in timing.lost
    assert timing.late == {}  # a loss is called a loss


def test_frames_before_the_receiver_listened_and_after_it_left_are_not_lost(scenario: Scenario, parts: Parts) -> None:
    """Processes start and end one after the other."""
    hlc, gateway, joints = parts
    zero = hlc.time_zero
    start, end = zero - 5 * MS, zero + 900 * MS
    hlc, gateway, joints = (
        replace(hlc, rows=[row for row in hlc.rows if row.sender >= 0 or start < row.end_ns < end]),
        replace(gateway, rows=[row for row in gateway.rows if start < row.end_ns < end]),
        replace(joints, rows=[row for row in joints.rows if row.sender >= 0 or start < row.end_ns < end]),
    )
    listened = replace(gateway, service=Service(start, end, Lateness(), {}))
    assert judged(scenario, hlc, listened, joints).lost == []
    controller_bus, drive_bus = judged(scenario, hlc, gateway, joints).lost
    assert controller_bus.startswith("controller bus, frames from controller to gateway: lost: ")
    assert drive_bus.startswith("drive bus, frames from joints to gateway: lost: ")


def without(
    rows: list[Transmission], cob_id: int, span: range, *, own: bool = False, bus: int = -1
) -> list[Transmission]:
    """Rows that a process did not receive (own: did not send) in that span."""
    return [
        row
        for row in rows
        if row.frame.can_id != cob_id or (row.sender >= 0) != own or row.end_ns not in span or bus not in (-1, row.bus)
    ]


@pytest.mark.parametrize("ends", ["in the motion", "with the run"])
@pytest.mark.parametrize("begins", ["from the first on", "from half of the motion on"])
@pytest.mark.parametrize("cob_id", [0x185, 0x285, 0x705, 0x2FF, 0x205, 0x080])
def test_all_frames_of_an_id_that_no_longer_arrive_are_lost(
    scenario: Scenario, parts: Parts, cob_id: int, begins: str, ends: str
) -> None:
    """Not only a gap between two that did arrive: the tail of the run, and ids that never came at all."""
    hlc, gateway, joints = parts
    zero = hlc.time_zero
    half = zero + 500 * MS
    span = range(0 if begins == "from the first on" else half, half + 300 * MS if ends == "in the motion" else NEVER)
    if cob_id in (0x205, 0x2FF, 0x080):
        timing = judged(scenario, hlc, gateway, replace(joints, rows=without(joints.rows, cob_id, span)))
        hop = "drive bus, frames from gateway to joints"
    else:
        timing = judged(scenario, replace(hlc, rows=without(hlc.rows, cob_id, span)), gateway, joints)
        hop = "controller bus, frames from gateway to controller"
    assert any(reason.startswith(f"{hop}: lost: {cob_id:03X} (") for reason in timing.lost)
    assert timing.found > 0


def test_lost_frames_that_all_say_the_same_are_counted_and_make_nothing_late(scenario: Scenario, parts: Parts) -> None:
    """A joint that stands still sends equal bytes in every cycle: which of them are missing is told by their times."""
    hlc, gateway, joints = parts

    def still(rows: list[Transmission]) -> list[Transmission]:
        return [
            Transmission(row.end_ns, row.bus, Frame(0x186, bytes(8)), row.sender) if row.frame.can_id == 0x186 else row
            for row in rows
        ]

    gateway, joints = replace(gateway, rows=still(gateway.rows)), replace(joints, rows=still(joints.rows))
    assert judged(scenario, replace(hlc, rows=still(hlc.rows)), gateway, joints).lost == []
    span = range(hlc.time_zero + 200 * MS, hlc.time_zero + 700 * MS)
    timing = judged(scenario, replace(hlc, rows=without(still(hlc.rows), 0x186, span)), gateway, joints)
    assert timing.lost == ["controller bus, frames from gateway to controller: lost: 186 (50)"]
    assert (timing.late, timing.found) == ({}, 50)


# --- inside the gateway ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("cob_id", "bus", "way"), [(0x186, 0, "to the controller"), (0x206, 1, "to the drives")])
def test_frame_that_comes_to_the_gateway_and_does_not_leave_it_is_lost(
    scenario: Scenario, parts: Parts, cob_id: int, bus: int, way: str
) -> None:
    """Unless a fault took it, there and then: none is at this joint, or at any after the windows of this run."""
    hlc, gateway, joints = parts
    span = range(hlc.time_zero + 400 * MS, hlc.time_zero + 500 * MS)
    kept = without(gateway.rows, cob_id, span, own=True, bus=bus)
    receiver = hlc if bus == 0 else joints
    rows = without(receiver.rows, cob_id, span)
    timing = judged(
        scenario,
        replace(hlc, rows=rows) if bus == 0 else hlc,
        replace(gateway, rows=kept),
        joints if bus == 0 else replace(joints, rows=rows),
    )
    assert timing.lost == [f"gateway, frames {way} that no fault was at: lost: {cob_id:03X} (10)"]


def test_frames_that_a_fault_takes_are_not_lost_and_others_meanwhile_are(scenario: Scenario, parts: Parts) -> None:
    """The window of the drop at the left hip, RPDO1, is from 600 to 650 ms."""
    hlc, gateway, joints = parts
    dropped = [one for one in gateway.activations if one.injector == "lost"]
    assert dropped[0].frames_lost == 5
    timing = judged(scenario, hlc, replace(gateway, activations=[]), joints)
    assert timing.lost[0].startswith("gateway, frames to the drives that no fault was at: lost: 201 (5)")


def drop_from(gateway: GatewayPart, hlc: HlcPart, cob_id: int, bus: int, start_ms: int, end_ms: int) -> GatewayPart:
    """The gateway lost frames on their way out on that bus."""
    span = range(hlc.time_zero + start_ms * MS, hlc.time_zero + end_ms * MS)
    return replace(gateway, rows=without(gateway.rows, cob_id, span, own=True, bus=bus))


@pytest.mark.parametrize(
    ("cob_id", "bus", "start_ms", "end_ms", "lost"),
    [
        (0x281, 0, 600, 650, 1),  # another PDO of the joint that the drop is at, at the same time
        (0x181, 0, 600, 650, 5),  # and the other way
        (0x202, 1, 600, 650, 5),  # another joint
        (0x2FF, 1, 560, 690, 1),  # of no joint
        (0x201, 1, 700, 750, 5),  # its target, after the window
        (0x201, 1, 560, 580, 2),  # and before it
        (0x285, 0, 300, 500, 2),  # the bias is at TPDO1
        (0x185, 0, 600, 650, 5),  # the target of the bias in the window of the drop
    ],
)
def test_loss_is_excused_only_where_and_when_an_injector_was_at_that_cob_id(
    scenario: Scenario, parts: Parts, cob_id: int, bus: int, start_ms: int, end_ms: int, lost: int
) -> None:
    """A fault at one PDO is no reason for the loss of another, of the same joint or not."""
    hlc, gateway, joints = parts
    losing = drop_from(gateway, hlc, cob_id, bus, start_ms, end_ms)
    sent = len(gateway.rows) - len(losing.rows)
    assert sent == lost
    timing = judged(scenario, hlc, losing, joints)
    way = "to the drives" if bus else "to the controller"
    assert f"gateway, frames {way} that no fault was at: lost: {cob_id:03X} ({lost})" in timing.lost


def test_remote_and_extended_frames_are_no_target(scenario: Scenario, parts: Parts) -> None:
    """Injectors see base data frames only; whatever else has the same number is to pass."""
    hlc, gateway, joints = parts
    during = hlc.time_zero + 620 * MS
    at = next(at for at, row in enumerate(gateway.rows) if row.end_ns >= during)
    rows = list(gateway.rows)
    rows.insert(at, Transmission(during, 0, Frame(0x201, b"", FLAG_REMOTE, 4), -1))
    timing = judged(scenario, hlc, replace(gateway, rows=rows), joints)
    assert "gateway, frames to the drives that no fault was at: lost: 201 (1)" in timing.lost


@pytest.mark.parametrize(("cob_id", "found"), [(0x281, True), (0x186, True), (0x201, False)])
def test_doubled_frame_is_excused_only_where_a_fault_has_been(
    scenario: Scenario, parts: Parts, cob_id: int, found: bool
) -> None:
    """Neither bias nor drop adds frames of another id; what one at 201 put off may come later."""
    hlc, gateway, joints = parts
    bus = 1 if cob_id == 0x201 else 0
    rows = list(gateway.rows)
    at = next(
        at
        for at, row in enumerate(rows)
        if row.frame.can_id == cob_id and row.sender >= 0 and row.bus == bus and row.end_ns > hlc.time_zero + 800 * MS
    )
    rows.insert(at, rows[at])
    timing = judged(scenario, hlc, replace(gateway, rows=rows), joints)
    where = "gateway, frames to the drives" if bus else "gateway, frames to the controller"
    assert any(reason.startswith(where) for reason in timing.lost) == found


DELAYS = """\
  slow:
    target: {bus: to_controller, node: right_knee, pdo: TPDO1}
    fault: {type: delay, time: 100 ms}
    event: {type: at, times: [0.2 s, 0.6 s]}
    effect: {type: constant_time, duration: 0.05 s}
"""


@pytest.fixture(scope="module")
def put_off() -> tuple[Scenario, Parts]:
    """A run in which the TPDO1 of the right knee are 100 ms late, twice."""
    scenario = parse_scenario(SCENARIO.partition("injectors:\n")[0] + "injectors:\n" + DELAYS)
    rig = build_rig(rig_params(scenario), build_injectors(scenario.injectors, scenario.plan, scenario.seed, 0))
    drive_through(rig, lambda share: None)
    return scenario, parts_of(rig)


def test_frames_behind_those_that_a_fault_put_off_are_not_late(put_off: tuple[Scenario, Parts]) -> None:
    """In order they wait, also after the window; the run is as valid as any."""
    scenario, (hlc, gateway, joints) = put_off
    assert [one.frames_delayed for one in gateway.activations] == [5, 5]
    timing = judged(scenario, hlc, gateway, joints)
    assert (timing.lost, timing.late) == ([], {})


@pytest.mark.parametrize(("at_ms", "cob_id"), [(450, 0x185), (380, 0x185), (270, 0x186)])
def test_frame_that_waits_for_no_such_frame_is_late(put_off: tuple[Scenario, Parts], at_ms: int, cob_id: int) -> None:
    """Between two windows, when all that was put off has left; and one of another joint."""
    scenario, (hlc, gateway, joints) = put_off
    start = hlc.time_zero + at_ms * MS
    at = next(
        at
        for at, row in enumerate(gateway.rows)
        if row.frame.can_id == cob_id and row.sender >= 0 and row.end_ns >= start
    )
    row = gateway.rows[at]
    late = row.end_ns + 8 * MS + CYCLE
    rows = [*gateway.rows[:at], *gateway.rows[at + 1 :]]
    to = next(to for to, one in enumerate(rows) if one.end_ns >= late)
    rows.insert(to, Transmission(late, 0, row.frame, row.sender))
    following = next(
        to
        for to, one in enumerate(rows)
        if to >= at and one.frame.can_id == cob_id and one.bus == 0 and one.sender >= 0
    )
    assert following < to  # one overtakes it, unless it waits too
    rows.insert(to, rows.pop(following))
    timing = judged(scenario, hlc, replace(gateway, rows=rows), joints)
    assert timing.late


def test_frame_that_waits_in_the_gateway_is_late_from_when_it_came(scenario: Scenario, parts: Parts) -> None:
    """Its transmit queue stands still for three cycles while newer frames of that id come in behind it."""
    hlc, gateway, joints = parts
    start = hlc.time_zero + 70 * CYCLE
    end = start + 3 * CYCLE + CYCLE // 2

    def waits(row: Transmission) -> bool:
        return row.frame.can_id == 0x186 and start <= row.end_ns < end

    held = [row for row in gateway.rows if waits(row) and row.sender >= 0]
    assert len(held) == 4
    rows = [row for row in gateway.rows if row not in held]
    at = next(at for at, row in enumerate(rows) if row.end_ns >= end)
    rows[at:at] = [Transmission(end, 0, row.frame, row.sender) for row in held]
    heard = [
        Transmission(end + MS // 5, 0, row.frame, row.sender) if waits(row) and row.sender < 0 else row
        for row in hlc.rows
    ]
    timing = judged(scenario, replace(hlc, rows=heard), replace(gateway, rows=rows), joints)
    assert timing.lost == []
    assert sorted(timing.late) == [70, 71, 72]
    assert timing.late[70] == pytest.approx(2.5 * CYCLE, abs=MS)  # it was due when the next SYNC came
    assert timing.late[72] == pytest.approx(0.5 * CYCLE, abs=MS)


# --- what a cycle owes -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("who", ["controller", "joints"])
def test_answer_or_command_that_was_never_sent_makes_its_cycle_late(scenario: Scenario, parts: Parts, who: str) -> None:
    """Nothing was lost, and nothing that was sent was late: it is just not there."""
    hlc, gateway, joints = parts
    span = range(hlc.time_zero + 70 * CYCLE, hlc.time_zero + 73 * CYCLE)
    cob_id = 0x206 if who == "controller" else 0x186
    rows = {
        name: [row for row in part.rows if row.frame.can_id != cob_id or row.end_ns not in span]
        for name, part in (("hlc", hlc), ("gateway", gateway), ("joints", joints))
    }
    timing = judged(
        scenario,
        replace(hlc, rows=rows["hlc"]),
        replace(gateway, rows=rows["gateway"]),
        replace(joints, rows=rows["joints"]),
    )
    assert timing.lost == []
    assert timing.late == {70: CYCLE, 71: CYCLE, 72: CYCLE}
    assert timing.worst == f"cycle 70, {who} sent no COB-ID {cob_id:03X}"


def test_drives_owe_no_answer_to_a_sync_that_a_fault_took(scenario: Scenario, parts: Parts) -> None:
    """They answer what they get; and one that reported an error owes nothing until it answers again."""
    hlc, _, joints = parts
    span = range(hlc.time_zero + 70 * CYCLE, hlc.time_zero + 80 * CYCLE)
    rows = [row for row in joints.rows if row.end_ns not in span]
    assert judged(scenario, hlc, None, replace(joints, rows=rows)).late == {}
    ill = [row for row in joints.rows if row.frame.can_id != 0x186 or row.end_ns not in span]
    assert len(judged(scenario, hlc, None, replace(joints, rows=ill)).late) == 10
    at = next(at for at, row in enumerate(ill) if row.end_ns >= span.start)
    ill.insert(at, Transmission(span.start, 0, Frame(0x086, bytes((0x30, 0x81, 0x11, 0, 0, 0, 0, 0))), 5))
    assert judged(scenario, hlc, None, replace(joints, rows=ill)).late == {}


# --- lateness --------------------------------------------------------------------------------------------------------


def delayed(rows: list[Transmission], start_ns: int, end_ns: int, by_ns: int, sent: bool | None) -> list[Transmission]:
    """Rows of a span moved later; sent: own ones only, or received ones only, None for both."""
    return [
        Transmission(
            row.end_ns + (by_ns if start_ns <= row.end_ns < end_ns and sent in (None, row.sender >= 0) else 0),
            row.bus,
            row.frame,
            row.sender,
        )
        for row in rows
    ]


CYCLE = 10 * MS


@pytest.mark.parametrize(
    ("by_ns", "late"),
    [(0, 0), (3 * MS, 0), (8 * MS, 0), (13 * MS, 1), (23 * MS, 1)],
    ids=["not at all", "within the cycle", "still before the next SYNC", "after it", "more than 20 ms"],
)
def test_commands_late_by_more_than_the_cycle_has_left_make_it_late(
    scenario: Scenario, parts: Parts, by_ns: int, late: int
) -> None:
    """A cycle is late when the controller's commands miss the next SYNC (sent 1 ms after theirs, 100 Hz)."""
    hlc, gateway, joints = parts
    start = hlc.time_zero + 40 * CYCLE
    rows = [
        row if not (row.sender >= 0 and row.frame.can_id > 0x200) else moved
        for row, moved in zip(hlc.rows, delayed(hlc.rows, start, start + CYCLE, by_ns, sent=True), strict=True)
    ]
    timing = judged(scenario, replace(hlc, rows=rows), gateway, joints)
    assert list(timing.late) == [40] * late
    if late:
        assert timing.worst.startswith("cycle 40, controller sent COB-ID 2")
        assert by_ns - 9 * MS < timing.late_worst_ns < by_ns - 7 * MS


@pytest.mark.parametrize("who", ["controller", "joints", "gateway"])
def test_process_that_stands_still_for_three_cycles_makes_them_late(scenario: Scenario, parts: Parts, who: str) -> None:
    """Whoever stands still: what it sends in that time goes out at its end, 30 ms late at most."""
    hlc, gateway, joints = parts
    start = hlc.time_zero + 40 * CYCLE
    end = start + 3 * CYCLE
    first = {"controller": 0, "gateway": 2, "joints": 4}[who]

    def stopped(rows: list[Transmission], places: dict[tuple[int, bool], int]) -> list[Transmission]:
        """places: on the way from the controller (0) to the drives and back, by bus and whether sent."""
        return [
            Transmission(end, row.bus, row.frame, row.sender)
            if places[row.bus, row.sender >= 0] >= first and start <= row.end_ns < end
            else row
            for row in rows
        ]

    timing = judged(
        scenario,
        replace(hlc, rows=stopped(hlc.rows, {(0, True): 0, (0, False): 7})),
        replace(gateway, rows=stopped(gateway.rows, {(0, False): 1, (1, True): 2, (1, False): 5, (0, True): 6})),
        replace(joints, rows=stopped(joints.rows, {(0, False): 3, (0, True): 4})),
    )
    assert set(timing.late) >= {40, 41}
    assert set(timing.late) <= {40, 41, 42}
    # cycle 40: its next SYNC was due one cycle after its own, and came to the joints one frame time later
    assert timing.late_worst_ns == pytest.approx(2 * CYCLE, abs=MS // 5)
    if who != "joints":  # behind them the next SYNC had been there for a frame time longer
        assert who in timing.worst


@pytest.mark.parametrize("direction", ["to the gateway", "to the joints"])
def test_bus_that_delays_frames_makes_their_cycles_late(scenario: Scenario, parts: Parts, direction: str) -> None:
    """A hub that stands still: the processes were on time, what they sent arrives after the next SYNC."""
    hlc, gateway, joints = parts
    start = hlc.time_zero + 40 * CYCLE + MS // 2  # behind the SYNC
    end = start + CYCLE // 2
    if direction == "to the gateway":
        moved = [
            new if old.bus == CONTROLLER_BUS else old
            for old, new in zip(gateway.rows, delayed(gateway.rows, start, end, 15 * MS, sent=False), strict=True)
        ]
        timing = judged(scenario, hlc, replace(gateway, rows=moved), joints)
    else:
        moved = delayed(joints.rows, start, end, 15 * MS, sent=False)
        timing = judged(scenario, hlc, gateway, replace(joints, rows=moved))
    assert list(timing.late) == [40]
    assert "bus carried" in timing.worst


@pytest.mark.parametrize(
    ("late", "reasons"),
    [
        ({}, 0),
        ({7: MS}, 0),  # 1 of 100 is 1 %: allowed
        ({7: MS, 8: MS}, 1),
        ({7: 20 * MS}, 0),
        ({7: 20 * MS + 1}, 1),
        ({7: 21 * MS, 8: MS}, 2),
    ],
)
def test_limits_are_one_percent_of_cycles_and_20_ms(late: dict[int, int], reasons: int) -> None:
    """Invalid when more than 1 % of the cycles are late, or one is late by more than 20 ms."""
    timing = Timing(100, late, "cycle 7, joints sent 181", [], {})
    assert len(timing.reasons(TimingLimits(0.01, 20 * MS))) == reasons


def test_lost_frame_makes_a_run_invalid_however_punctual() -> None:
    """Invalid when a frame was lost."""
    assert Timing(100, {}, "", ["drive bus: ..."], {}).reasons(TimingLimits(1.0, 1 << 60)) == ["drive bus: ..."]


# --- foreign software ------------------------------------------------------------------------------------------------


def test_truth_of_foreign_drives_comes_from_their_frames(scenario: Scenario, expected: RunRecord, parts: Parts) -> None:
    """Without our plant the metrics come from frames (source: bus), before any fault acts on them."""
    hlc, gateway, _ = parts
    found = merge(scenario.plan, expected.duration_ns, hlc, gateway, None, [])
    assert found.source == "bus"
    assert np.array_equal(found.truth.t_s, expected.truth.t_s)
    inner = slice(20, -20)  # the ends have no frame on one side
    error = np.abs(found.truth.q - expected.truth.q)[inner]
    # a straight line between samples 10 ms apart is off by curvature * h^2 / 8; the stamp of SYNC on the drive bus lies
    # up to two frame times (0.2 ms) behind the step that was latched; and the encoder has its resolution
    curvature = np.abs(np.diff(expected.truth.dq, axis=0)).max() * 1000
    speed = np.abs(expected.truth.dq).max()
    assert error.max() < curvature * 0.01**2 / 8 + speed * 0.0002 + 2 * np.pi / 131072
    assert error.max() > 0
    # TPDO2 comes every tenth SYNC only: the torque is some value of the last 0.1 s
    assert np.abs(found.truth.tau).max() <= np.abs(expected.truth.tau).max() * 1.05


def test_drive_that_never_spoke_is_named(scenario: Scenario, expected: RunRecord, parts: Parts) -> None:
    """Nothing stands for values that are not there."""
    hlc, gateway, _ = parts
    rows = [row for row in gateway.rows if row.frame.can_id != 0x186]
    with pytest.raises(IncompleteError, match="right_ankle sent no TPDO1"):
        merge(scenario.plan, expected.duration_ns, hlc, replace(gateway, rows=rows), None, [])


def test_commands_of_a_foreign_controller_come_from_its_frames(
    scenario: Scenario, expected: RunRecord, parts: Parts
) -> None:
    """Its torques as sent, before any fault; what it follows is not known."""
    _, gateway, joints = parts
    found = merge(scenario.plan, expected.duration_ns, None, gateway, joints, [])
    assert not found.commands.has_reference
    assert found.time0_ns == expected.time0_ns
    assert np.array_equal(found.commands.t_s, expected.commands.t_s[: found.commands.t_s.size])
    rated = np.array([scenario.plan.scale(joint, "N m") for joint in scenario.plan.joints])
    wanted = np.clip(expected.commands.tau_command, -1000 * rated, 1000 * rated)  # the clamp is at rated torque
    assert np.all(np.abs(found.commands.tau_command - wanted) <= rated)  # per mille of rated torque on the wire
    assert np.array_equal(found.truth.q, expected.truth.q)


def test_foreign_controller_at_another_rate_makes_a_run_invalid(
    scenario: Scenario, expected: RunRecord, parts: Parts
) -> None:
    """Cycles, commands and lateness are told by the scenario's: nothing of it would be right."""
    _, gateway, joints = parts
    zero = expected.time0_ns
    rows = [row for row in gateway.rows if row.frame.can_id != SYNC or round((row.end_ns - zero) / (10 * MS)) % 2 == 0]
    found = merge(scenario.plan, expected.duration_ns, None, replace(gateway, rows=rows), joints, [])
    said = "SYNC comes every 20.00 ms, rig.rate here says 10 ms (100 Hz); give all processes of a rig the same rig.rate"
    assert found.invalid_reasons == [said]
    assert merge(scenario.plan, expected.duration_ns, None, gateway, joints, []).invalid_reasons == []


def test_foreign_controller_that_walks_to_the_end_has_completed(
    scenario: Scenario, expected: RunRecord, parts: Parts
) -> None:
    """Commands to the end, drives enabled to the end."""
    _, gateway, joints = parts
    assert merge(scenario.plan, expected.duration_ns, None, gateway, joints, []).completed


@pytest.mark.parametrize(("silent_ms", "completed"), [(90, True), (200, False), (990, False)])
def test_foreign_controller_that_falls_silent_has_given_up(
    scenario: Scenario, expected: RunRecord, parts: Parts, silent_ms: int, completed: bool
) -> None:
    """A master that crashed proves nothing in a golden run, also where the drives do not notice."""
    _, gateway, joints = parts
    end = expected.time0_ns + expected.duration_ns
    rows = [row for row in gateway.rows if row.frame.can_id & 0x780 != RPDO1 or row.end_ns < end - silent_ms * MS]
    found = merge(scenario.plan, expected.duration_ns, None, replace(gateway, rows=rows), joints, [])
    assert found.completed == completed
    add_reasons(found, [], golden=True)
    if completed:
        assert found.invalid_reasons == []
    else:
        (reason,) = found.invalid_reasons
        assert reason.startswith("the motion was given up without a fault: HLC at ")
        assert reason.endswith(" s: no command for more than 10 cycles after this one")


def test_gap_in_a_foreign_controllers_commands_counts_as_its_end(
    scenario: Scenario, expected: RunRecord, parts: Parts
) -> None:
    """At the time of the last command before it."""
    _, gateway, joints = parts
    gap = range(expected.time0_ns + 300 * MS, expected.time0_ns + 450 * MS)
    rows = [row for row in gateway.rows if row.frame.can_id & 0x780 != RPDO1 or row.end_ns not in gap]
    found = merge(scenario.plan, expected.duration_ns, None, replace(gateway, rows=rows), joints, [])
    (end,) = [note for note in found.notes if note.kind == GIVEN_UP]
    assert (found.completed, end.node) == (False, "HLC")
    assert 0.29 <= end.time_s <= 0.3


@pytest.mark.parametrize("word", [0x0650, 0x0618])
def test_drive_that_leaves_operation_enabled_ends_a_foreign_controllers_motion(
    scenario: Scenario, expected: RunRecord, parts: Parts, word: int
) -> None:
    """The drive is named with its new state; after the motion it may do so."""
    _, gateway, joints = parts

    def merged(from_ns: int) -> RunRecord:
        rows = [
            Transmission(row.end_ns, row.bus, Frame(0x285, word.to_bytes(2, "little") + row.frame.data[2:]), -1)
            if row.frame.can_id == 0x285 and row.bus == 1 and row.end_ns >= from_ns
            else row
            for row in gateway.rows
        ]
        return merge(scenario.plan, expected.duration_ns, None, replace(gateway, rows=rows), joints, [])

    found = merged(expected.time0_ns + 500 * MS)
    (end,) = [note for note in found.notes if note.kind == GIVEN_UP]
    assert (found.completed, end.node) == (False, "right_knee")
    assert end.text == f"left Operation enabled, now {'switch on disabled' if word == 0x0650 else 'fault'}"
    assert 0.5 <= end.time_s <= 0.6  # TPDO2 comes with every 10th SYNC
    assert merged(expected.time0_ns + expected.duration_ns + 1).completed
    assert merged(0).completed  # it was never enabled: not part of this motion


def shifted(rows: list[Transmission], by_ns: int) -> list[Transmission]:
    return [Transmission(row.end_ns + by_ns, row.bus, row.frame, row.sender) for row in rows]


@pytest.mark.parametrize("phase_ms", range(0, 10, 3))
def test_foreign_controller_is_on_time_by_its_own_clock(scenario: Scenario, parts: Parts, phase_ms: int) -> None:
    """Where its SYNC lies on the grid from time 0 (which somebody may have said by hand) makes nothing late."""
    hlc, gateway, joints = parts
    timing = judge_timing(
        scenario.plan,
        hlc.time_zero,
        hlc.cycles.size,
        None,
        replace(gateway, rows=shifted(gateway.rows, phase_ms * MS)),
        replace(joints, rows=shifted(joints.rows, phase_ms * MS)),
    )
    assert (timing.late, timing.lost) == ({}, [])


def test_our_part_of_a_foreign_frames_way_may_take_one_cycle(scenario: Scenario, parts: Parts) -> None:
    """The joints stand still for 35 ms: the cycles of what they got late are late, by what is beyond one cycle."""
    hlc, gateway, joints = parts
    start = hlc.time_zero + 400 * MS
    late = delayed(joints.rows, start, start + 10 * MS, 35 * MS, None)
    timing = judge_timing(scenario.plan, hlc.time_zero, hlc.cycles.size, None, gateway, replace(joints, rows=late))
    assert timing.late
    assert 25 * MS < timing.late_worst_ns < 36 * MS


def test_without_gateway_the_supervisors_ears_count(scenario: Scenario, expected: RunRecord, parts: Parts) -> None:
    """A foreign gateway leaves no part: the supervisor has heard both buses."""
    hlc, _, joints = parts
    heard = [Transmission(row.end_ns, row.bus, row.frame, -1) for row in expected.rows]
    found = merge(scenario.plan, expected.duration_ns, hlc, None, joints, heard)
    assert [bus.frames for bus in found.buses] == [bus.frames for bus in expected.buses]
    assert found.activations == []
    foreign = merge(scenario.plan, expected.duration_ns, None, None, joints, heard)
    assert foreign.time0_ns == hlc.time_zero  # on the grid of the plant


def test_time_zero_of_gateway_and_controller_must_be_one(scenario: Scenario, expected: RunRecord, parts: Parts) -> None:
    """Faults count from the one, truth from the other: a cycle apart, every instant of an injection is wrong."""
    hlc, gateway, joints = parts

    def reasons(apart_ns: int) -> list[str]:
        moved = replace(gateway, time_zero=hlc.time_zero + apart_ns)
        return merge(scenario.plan, expected.duration_ns, hlc, moved, joints, []).invalid_reasons

    assert reasons(0) == reasons(CYCLE - 1) == reasons(1 - CYCLE) == []
    (late,), (early,) = reasons(CYCLE), reasons(-500 * MS)
    assert late.startswith("the gateway's time 0, from which faults count, is 10.0 ms late of the controller's")
    assert "500.0 ms early" in early
    (never,) = reasons(NEVER - hlc.time_zero)
    assert never.startswith("the gateway never learned time 0")


@pytest.mark.parametrize(
    ("at", "cob_id", "where"),
    [
        ("left", 0x186, "controller bus, frames from supervisor to controller: lost: "),
        ("right", 0x206, "drive bus, frames from supervisor to joints: lost: "),
        ("inside", 0x186, "foreign gateway, frames to the controller: lost: "),
        ("inside", 0x206, "foreign gateway, frames to the drives: lost: "),
    ],
)
def test_frame_lost_at_or_in_a_foreign_gateway_is_found_by_the_supervisors_ears(
    scenario: Scenario, expected: RunRecord, parts: Parts, at: str, cob_id: int, where: str
) -> None:
    """It is one end of each hop; what the gateway itself loses counts in a golden run only."""
    hlc, _, joints = parts
    heard = [Transmission(row.end_ns, row.bus, row.frame, -1) for row in expected.rows]
    span = range(hlc.time_zero + 700 * MS, hlc.time_zero + 800 * MS)
    if at == "left":
        hlc = replace(hlc, rows=without(hlc.rows, cob_id, span))
    elif at == "right":
        joints = replace(joints, rows=without(joints.rows, cob_id, span))
    else:
        out = 0 if cob_id == 0x186 else 1
        heard = without(heard, cob_id, span, bus=out)
        hlc = replace(hlc, rows=without(hlc.rows, cob_id, span)) if out == 0 else hlc
        joints = replace(joints, rows=without(joints.rows, cob_id, span)) if out else joints
    given = (scenario.plan, hlc.time_zero, hlc.cycles.size, hlc, None, joints, heard)

    def is_found(golden: bool) -> bool:
        lost = judge_timing(*given, golden=golden).lost
        return any(one.startswith(where) and f"{cob_id:03X} (10)" in one for one in lost)

    assert is_found(golden=True)
    assert is_found(golden=False) == (at != "inside")


def test_frames_the_supervisor_did_not_hear_count_where_nobody_else_listens(
    scenario: Scenario, expected: RunRecord, parts: Parts
) -> None:
    """Without gateway its ears are the record of both buses; with one they are not used."""
    hlc, gateway, joints = parts
    heard = [Transmission(row.end_ns, row.bus, row.frame, -1) for row in expected.rows]
    given = (scenario.plan, hlc.time_zero, hlc.cycles.size, hlc)
    without_gateway = judge_timing(*given, None, joints, heard, missed=7)
    assert without_gateway.lost == ["supervisor: 7 frames of both buses not heard, and nobody else heard them all"]
    assert without_gateway.counted == 7
    assert judge_timing(*given, gateway, joints, heard, missed=7).lost == []


def test_what_is_foreign_is_said_not_to_be_judged(scenario: Scenario, parts: Parts) -> None:
    """A run of foreign software alone proves nothing about time, and says so."""
    hlc, gateway, joints = parts
    given = (scenario.plan, hlc.time_zero, hlc.cycles.size)
    assert judge_timing(*given, hlc, gateway, joints).unjudged == []
    (no_hlc,) = judge_timing(*given, None, gateway, joints).unjudged
    assert no_hlc.startswith("hlc: foreign: ")
    assert judge_timing(*given, hlc, None, joints, []).unjudged == ["gateway: foreign: what it loses, delays and adds"]
    (nothing,) = judge_timing(*given, None, None, None, []).unjudged
    assert nothing.startswith("everything: no part of the rig is ours")


def test_motion_that_never_began_is_told_with_its_reasons(scenario: Scenario, parts: Parts) -> None:
    """The controller's own words."""
    hlc, gateway, joints = parts
    events = [NotedEvent(1, "left_hip", "start_failed", "no boot-up message")]
    with pytest.raises(IncompleteError, match="never began: left_hip: no boot-up message"):
        merge(scenario.plan, 1000 * MS, replace(hlc, time_zero=NEVER, events=events), gateway, joints, [])
    with pytest.raises(IncompleteError, match="never began: no status frame"):
        merge(scenario.plan, 1000 * MS, None, replace(gateway, time_zero=NEVER), joints, [])


def test_plant_that_ended_before_the_motion_is_no_truth(scenario: Scenario, expected: RunRecord, parts: Parts) -> None:
    """Golden and faulted run are compared instant by instant: none may be missing."""
    hlc, gateway, joints = parts
    q, dq, tau = (one[:-500] for one in (joints.q, joints.dq, joints.tau))
    short = replace(joints, times_ns=joints.times_ns[:-500], q=q, dq=dq, tau=tau)
    with pytest.raises(IncompleteError, match="ended before the motion did"):
        merge(scenario.plan, expected.duration_ns, hlc, gateway, short, [])


def test_live_control_is_an_event_of_the_result(scenario: Scenario, expected: RunRecord, parts: Parts) -> None:
    """Each call is a row, refused ones with their reason."""
    hlc, gateway, joints = parts
    controls = [
        ControlNote(hlc.time_zero + 500 * MS, "trigger", "bias", "socket", ""),
        ControlNote(hlc.time_zero + 600 * MS, "arm", "x", "bus 0x6c0", "no such injector"),
    ]
    found = merge(scenario.plan, expected.duration_ns, hlc, replace(gateway, controls=controls), joints, [])
    assert [(note.time_s, note.node, note.text) for note in found.notes if note.kind == "control"] == [
        (0.5, "gateway", "trigger bias, by socket"),
        (0.6, "gateway", "arm x, by bus 0x6c0: no such injector"),
    ]
