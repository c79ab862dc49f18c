"""Parts put together where some of the rig is foreign software."""

from dataclasses import replace

import numpy as np
import pytest

from canopen_exo.bus.frame import Frame
from canopen_exo.bus.medium import Transmission
from canopen_exo.bus.node import MS, NEVER
from canopen_exo.plan import RPDO1, SYNC
from testbench.merge import GIVEN_UP, IncompleteError, add_reasons, merge
from testbench.record import RunRecord
from testbench.rig import Rig
from testbench.run import record_of
from testbench.scenario import Scenario, parse_scenario
from testbench.timing import judge_timing
from tests.testbench.run_in_parts import CYCLE, SCENARIO, Parts, delayed, parts_of, walked, without


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
