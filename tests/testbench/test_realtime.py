"""Whole runs against the clock on the hub, held against the same runs in lock-step.

At 100 Hz, so that a busy machine is late rarely. A run that is late all the same is repeated twice at most, and then
skipped with what was late; what does not hang on time (nothing lost, order, orderly end) is asserted even then.
"""

import json
from collections import Counter
from collections.abc import Callable
from pathlib import Path

import pytest

from canopen_exo import plan as ids
from canopen_exo.bus.lateness import Lateness
from canopen_exo.bus.medium import Transmission
from fi_gateway.schema import build_injectors
from hlc.limits import limits_of
from testbench.cli import INVALID, main
from testbench.merge import IncompleteError
from testbench.realtime_run import RealTimeRun, limits_in, run_once
from testbench.record import RunRecord
from testbench.run import NotStartedError, rig_params, run_rig
from testbench.scenario import JOINT_NAMES, Scenario, parse_scenario
from testbench.supervisor import Setup, Supervisor
from testbench.verdict import Judgement, judge

pytestmark = pytest.mark.realtime

TRIES = 3

BASE = """\
name: parity
rig: {plant: suspended, stops: off, rate: 100 Hz}
motion: {gait: walking, stride: 1.5 s, duration: 2.5 s}
"""
FAULT = """\
injectors:
  fault:
    target: {bus: to_controller, node: right_knee, signal: position}
    fault: FAULT
    event: {type: at, time: 1 s}
    effect: {type: constant_time, duration: 1 s}
"""
SCENARIOS = {
    "none": BASE,
    "bias": BASE + FAULT.replace("FAULT", "{type: bias, value: 0.05 rad}"),
    "freeze": BASE + FAULT.replace("FAULT", "{type: stuck_at}"),
}
VERDICTS = {"none": True, "bias": True, "freeze": False}
"""In lock-step the bias stays 3 deg inside every limit of travel, the frozen knee goes 41 deg beyond it."""

Runner = Callable[[Setup], RealTimeRun]


def nothing_lost_silently(run: RealTimeRun) -> bool:
    """Holds on the busiest machine: no frame is lost, doubled or out of order unless somebody has counted it.

    A process that stands still for 0.1 s overruns a transmit queue of 64 frames with what it catches up.
    """
    return not run.timing.lost or run.timing.counted > 0


def distributions(run: RealTimeRun) -> list[tuple[str, Lateness]]:
    """Of wake-ups by process, and of what the gateway added."""
    return [*run.timing.lateness.items(), *((f"gateway to {bus}", one) for bus, one in run.timing.latency.items())]


def punctual(setup: Setup) -> RealTimeRun:
    """A run within the limits of its scenario; skips when three were not."""
    told: list[str] = []
    waits: dict[str, str] = {}
    for _ in range(TRIES):
        try:
            run = run_once(setup)
        except IncompleteError as error:  # drives that missed SYNC for 50 ms have stopped by themselves
            told.append(str(error))
            continue
        assert nothing_lost_silently(run), run.timing.lost
        late = run.timing.reasons(limits_in(setup.scenario))
        if not late and run.record.valid:
            return run
        told += run.record.invalid_reasons
        for name, one in distributions(run):
            waits[name] = f"{one.percentile(0.99) / 1e6:.1f}, {one.worst_ns / 1e6:.1f}"
    pytest.skip(f"this machine is too busy for real time: {'; '.join(told)}; late by (99 %, worst) [ms]: {waits}")


@pytest.fixture(scope="module")
def runs() -> Callable[[str, bool], RealTimeRun]:
    """Real-time run of a scenario, with or without its faults; each is made once."""
    made: dict[tuple[str, bool], RealTimeRun] = {}
    skipped: dict[tuple[str, bool], str] = {}

    def run(name: str, faults: bool) -> RealTimeRun:
        key = (name if faults else "none", faults and name != "none")
        if key in skipped:
            pytest.skip(skipped[key])
        if key not in made:
            scenario = parse_scenario(SCENARIOS[key[0]])
            try:
                made[key] = punctual(Setup(scenario, faults=key[1], keep_parts=True))
            except pytest.skip.Exception as skip:
                skipped[key] = str(skip)
                raise
        return made[key]

    return run


def lock_step(name: str, faults: bool) -> RunRecord:
    scenario = parse_scenario(SCENARIOS[name])
    chosen = build_injectors(scenario.injectors, scenario.plan, scenario.seed, 0) if faults else []
    return run_rig(rig_params(scenario), chosen)[0]


def judged(golden: RunRecord, faulted: RunRecord) -> Judgement:
    return judge(JOINT_NAMES, {name: limits_of(name) for name in JOINT_NAMES}, golden, faulted)


# --- parity ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", list(SCENARIOS))
def test_verdict_on_the_hub_is_that_of_lock_step(runs: Callable[[str, bool], RealTimeRun], name: str) -> None:
    """Parity: the same verdicts for no fault, 0.05 rad bias, and a freeze of 1 s."""
    found = judged(runs(name, False).record, runs(name, True).record)
    wanted = judged(lock_step(name, False), lock_step(name, True))
    assert found.passed == wanted.passed == VERDICTS[name]
    assert len(runs(name, True).record.activations) == (0 if name == "none" else 1)


SYNCHRONOUS = (ids.SYNC, ids.HLC_STATUS)
PROCESS_DATA = (ids.TPDO1, ids.TPDO2, ids.RPDO1)


def sender(can_id: int) -> str:
    """Who sends a synchronous COB-ID; "" for one that is not synchronous."""
    if can_id in SYNCHRONOUS:
        return "controller"
    base, node_id = can_id & 0x780, can_id & 0x7F
    if base not in PROCESS_DATA or not 1 <= node_id <= 6:
        return ""
    return "controller" if base == ids.RPDO1 else JOINT_NAMES[node_id - 1]


def by_cycle(record: RunRecord, bus: int, zero_ns: int) -> list[list[int]]:
    """Synchronous COB-IDs of each cycle of the motion, as on that bus: from one SYNC to the next."""
    cycles: list[list[int]] = []
    found: list[int] = []
    for row in record.rows:
        frame = row.frame
        if row.bus != bus or frame.flags or not sender(frame.can_id):
            continue
        if frame.can_id == ids.SYNC:
            found = []
            if row.end_ns >= zero_ns:
                cycles.append(found)
        found.append(frame.can_id)
    return cycles


@pytest.mark.parametrize("bus", [0, 1], ids=["controller bus", "drive bus"])
@pytest.mark.parametrize("name", ["none", "freeze"])
def test_frames_of_each_cycle_on_the_hub_are_those_of_lock_step(
    runs: Callable[[str, bool], RealTimeRun], name: str, bus: int
) -> None:
    """Parity: per cycle that was not late, the same multiset of synchronous COB-IDs and the same order per sender."""
    run, wanted = runs(name, True), lock_step(name, True)
    cycle_ns, count = 10_000_000, 250
    found = by_cycle(run.record, bus, run.record.time0_ns - cycle_ns // 2)
    reference = by_cycle(wanted, bus, wanted.time0_ns - cycle_ns // 2)
    compared = 0
    for cycle in range(1, count - 1):  # whether the one before time 0 was late is not judged
        # a late frame is missing in its own cycle and one too many in the one after
        if not {cycle - 1, cycle, cycle + 1} & set(run.timing.late):
            assert Counter(found[cycle]) == Counter(reference[cycle]), f"cycle {cycle}"
            for who in ("controller", *JOINT_NAMES):
                order = [can_id for can_id in found[cycle] if sender(can_id) == who]
                assert order == [can_id for can_id in reference[cycle] if sender(can_id) == who], f"cycle {cycle}"
            compared += 1
    assert compared > 0.9 * count


def heartbeats(record: RunRecord, second: int) -> Counter[int]:
    """By COB-ID, in one second of the motion, on the drive bus."""
    start = record.time0_ns + second * 1_000_000_000
    rows = [row for row in record.rows if row.bus == 1 and start <= row.end_ns < start + 1_000_000_000]
    return Counter(row.frame.can_id for row in rows if row.frame.can_id & 0x780 == ids.HEARTBEAT)


@pytest.mark.parametrize("second", [0, 1])
def test_heartbeats_on_the_hub_are_those_of_lock_step(runs: Callable[[str, bool], RealTimeRun], second: int) -> None:
    """Parity: heartbeats by count, +-1 a second."""
    found, wanted = heartbeats(runs("none", True).record, second), heartbeats(lock_step("none", True), second)
    assert set(found) == set(wanted) == {0x701, 0x702, 0x703, 0x704, 0x705, 0x706, 0x77F}
    for can_id, count in wanted.items():
        assert abs(found[can_id] - count) <= 1


def test_truth_of_golden_run_is_that_of_lock_step(runs: Callable[[str, bool], RealTimeRun]) -> None:
    """The same plant, the same gait, on the same 1 kHz grid from time 0."""
    found, wanted = runs("none", False).record.truth, lock_step("none", False).truth
    assert found.t_s.tolist() == wanted.t_s.tolist()
    # a cycle whose answers came after the deadline repeats old samples: some mrad where nothing else is wrong
    assert abs(found.q - wanted.q).max() < 0.03


# --- the result ------------------------------------------------------------------------------------------------------


def test_run_realtime_gives_the_document_of_lock_step_and_how_well_it_kept_time(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Design: the same result document; additional keys say source, late cycles, and the limits in force."""
    file = tmp_path / "scenario.yaml"
    file.write_text(SCENARIOS["none"] + "realtime: {late_share: 2 %, late_worst: 15 ms}\n")
    shorter = ["--set", "motion.duration=1s", "--json", "--out", str(tmp_path / "result")]
    code = INVALID
    for _ in range(TRIES):
        code = main(["run", "--realtime", str(file), *shorter])
        output = capsys.readouterr()
        if code != INVALID:
            break
    if code == INVALID:
        pytest.skip(f"this machine is too busy for real time: {output.err}{output.out[:2000]}")
    assert code == 0, output.err
    document = json.loads(output.out)
    assert main(["run", str(file), *shorter]) == 0
    reference = json.loads(capsys.readouterr().out)
    assert list(document) == [*(key for key in reference if key != "versions"), "versions", "realtime"]
    assert (document["verdict"], document["outcome"], document["source"]) == ("pass", "not_activated", "plant")
    timing = document["realtime"]
    assert timing["limits"] == {"late_share": 0.02, "late_worst_ms": 15.0}
    assert timing["cycles"] == 200
    for name in ("golden", "faulted"):
        assert set(timing[name]["lateness"]) == {"hlc", "joints", "gateway"}
        assert timing[name]["lateness"]["joints"]["count"] > 1000  # a wake-up each ms
        assert set(timing[name]["latency"]) == {"controller", "drive"}
        assert timing[name]["latency"]["drive"]["count"] > 1000  # SYNC and six commands a cycle
    files = {path.name for path in (tmp_path / "result").iterdir()}
    assert files >= {"summary.json", "scenario.yaml", "controller.log", "drive.log", "golden.parquet", "joints.png"}


def test_limits_that_nothing_can_keep_make_a_run_invalid() -> None:
    """The limits stand in the scenario: with none allowed, one late cycle is one too many."""
    limits = "realtime={late_share: 0, late_worst: 0 s}"
    scenario = parse_scenario(SCENARIOS["none"], overrides=["motion.duration=0.5s", limits])
    try:
        run = run_once(Setup(scenario, faults=False, keep_parts=True))
    except IncompleteError as error:
        pytest.skip(f"this machine is too busy for real time: {error}")
    assert run.record.valid == (not run.timing.late and run.record.completed and not run.timing.lost)
    assert nothing_lost_silently(run), run.timing.lost


# --- foreign drives --------------------------------------------------------------------------------------------------


def test_metrics_of_foreign_drives_come_from_frames(runs: Callable[[str, bool], RealTimeRun], tmp_path: Path) -> None:
    """Without our plant the metrics come from frames and say `source: bus`; our own joints play the foreign ones."""
    scenario: Scenario = parse_scenario(SCENARIOS["none"], overrides=["motion.duration=1s"])
    with Supervisor(Setup(scenario)) as foreign:
        foreign.start(["joints"])
        setup = Setup(scenario, foreign.buses, frozenset({"joints"}), faults=False, keep_parts=True)
        try:
            run = run_once(setup)
        except (IncompleteError, NotStartedError) as error:
            pytest.skip(f"this machine is too busy for real time: {error}")
    assert run.record.source == "bus"
    assert nothing_lost_silently(run), run.timing.lost
    wanted = lock_step("none", False).truth
    assert run.record.truth.t_s.tolist() == wanted.t_s[:1001].tolist()
    if run.record.valid:
        # straight lines between samples 10 ms apart, stamped up to a frame time late, and what real time adds
        assert abs(run.record.truth.q[20:-20] - wanted.q[20:981]).max() < 0.04


def rows_of(record: RunRecord, bus: int) -> list[Transmission]:
    return [row for row in record.rows if row.bus == bus]


def test_log_of_each_bus_rises_in_time_and_has_every_frame(runs: Callable[[str, bool], RealTimeRun]) -> None:
    """What the gateway received and what it sent, together: all frames of the bus, in order of time."""
    record = runs("none", True).record
    for bus in (0, 1):
        times = [row.end_ns for row in rows_of(record, bus)]
        assert times == sorted(times)
        found = Counter(row.frame.can_id for row in rows_of(record, bus))
        assert found[ids.SYNC] >= 250 + 150
        assert all(found[ids.TPDO1 + node_id] >= 250 for node_id in range(1, 7))
