"""Parts put together, held against a lock-step run: cut into parts, it must come out of the merge as it went in."""

from dataclasses import replace

import numpy as np
import pytest

from canopen_exo.bus.frame import Frame
from canopen_exo.bus.lateness import Lateness
from canopen_exo.bus.medium import Transmission
from canopen_exo.bus.node import MS, NEVER
from testbench.merge import IncompleteError, merge
from testbench.parts import ControlNote, NotedEvent, Service
from testbench.record import RunRecord
from testbench.rig import Rig
from testbench.run import record_of
from testbench.scenario import Scenario, parse_scenario
from testbench.timing import TimingLimits
from tests.testbench.run_in_parts import SCENARIO, Parts, judged, parts_of, walked, without


@pytest.fixture(scope="module")
def scenario() -> Scenario:
    return parse_scenario(SCENARIO)


@pytest.fixture(scope="module")
def rig(scenario: Scenario) -> Rig:
    return walked(scenario)


@pytest.fixture(scope="module")
def expected(rig: Rig) -> RunRecord:
    return record_of(rig)


@pytest.fixture(scope="module")
def parts(rig: Rig) -> Parts:
    return parts_of(rig)


@pytest.mark.long
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


@pytest.mark.long
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
