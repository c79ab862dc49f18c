"""Parts put together: what a cycle owes, and when it is late."""

from dataclasses import replace

import pytest

from canopen_exo.bus.frame import Frame
from canopen_exo.bus.medium import Transmission
from canopen_exo.bus.node import MS
from testbench.rig import CONTROLLER_BUS, Rig
from testbench.scenario import Scenario, parse_scenario
from testbench.timing import Timing, TimingLimits
from tests.testbench.run_in_parts import CYCLE, SCENARIO, Parts, delayed, judged, parts_of, walked


@pytest.fixture(scope="module")
def scenario() -> Scenario:
    return parse_scenario(SCENARIO)


@pytest.fixture(scope="module")
def rig(scenario: Scenario) -> Rig:
    return walked(scenario)


@pytest.fixture(scope="module")
def parts(rig: Rig) -> Parts:
    return parts_of(rig)


# --- what a cycle owes -----------------------------------------------------------------------------------------------


@pytest.mark.long
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
