"""Parts put together: what comes to the gateway leaves it, or a fault has taken it or put it off."""

from dataclasses import replace

import pytest

from canopen_exo.bus.frame import FLAG_REMOTE, Frame
from canopen_exo.bus.medium import Transmission
from canopen_exo.bus.node import MS
from fi_gateway.schema import build_injectors
from testbench.parts import GatewayPart, HlcPart
from testbench.rig import Rig, build_rig
from testbench.run import drive_through, rig_params
from testbench.scenario import Scenario, parse_scenario
from tests.testbench.run_in_parts import CYCLE, SCENARIO, Parts, judged, parts_of, walked, without


@pytest.fixture(scope="module")
def scenario() -> Scenario:
    return parse_scenario(SCENARIO)


@pytest.fixture(scope="module")
def rig(scenario: Scenario) -> Rig:
    return walked(scenario)


@pytest.fixture(scope="module")
def parts(rig: Rig) -> Parts:
    return parts_of(rig)


# --- inside the gateway ----------------------------------------------------------------------------------------------


@pytest.mark.long
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


@pytest.mark.long
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
