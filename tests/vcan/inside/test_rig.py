"""The whole rig as processes over vcan0 (controller side) and vcan1 (drive side), held against the same in lock-step.

At 50 Hz, the slowest rate of the rig: in User Mode Linux all processes share one virtual CPU and a system call costs
some 30 us. A run that is late all the same is repeated twice at most, and then skipped with what was late; what does
not hang on time (nothing lost, order, orderly end) is asserted even then.
"""

import json
import shutil
import signal
import time
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from importlib.resources import as_file, files
from pathlib import Path
from typing import Final, TypeVar, final

import can
import canopen
import pytest

from canopen_exo import plan as ids
from canopen_exo.bus.lateness import Lateness
from canopen_exo.bus.node import MS, SECOND
from canopen_exo.cia402 import DriveState
from fi_gateway.schema import build_injectors
from hlc.limits import limits_of
from testbench.cli import FAIL, INVALID, PASS
from testbench.merge import IncompleteError
from testbench.realtime_run import RealTimeRun, limits_in, run_once
from testbench.record import RunRecord
from testbench.run import rig_params, run_rig
from testbench.scenario import JOINT_NAMES, parse_scenario
from testbench.supervisor import Setup, Supervisor
from testbench.verdict import judge
from tests.vcan.inside.peers import wait_until
from tests.vcan.inside.programs import Program, our_processes

pytestmark = pytest.mark.realtime

BUSES: Final = ("socketcan:vcan0", "socketcan:vcan1")
TRIES: Final = 3
PATIENCE_S: Final = 80.0

CYCLE_NS: Final = 20 * MS
CYCLES: Final = 125

BASE: Final = """\
name: parity
rig: {plant: suspended, stops: off, rate: 50 Hz}
motion: {gait: walking, stride: 1.5 s, duration: 2.5 s}
"""
FAULT: Final = """\
injectors:
  fault:
    target: {bus: to_controller, node: right_knee, signal: position}
    fault: FAULT
    event: {type: at, time: 1 s}
    effect: {type: constant_time, duration: 1 s}
"""
SCENARIOS: Final = {
    "none": BASE,
    "bias": BASE + FAULT.replace("FAULT", "{type: bias, value: 0.05 rad}"),
    "freeze": BASE + FAULT.replace("FAULT", "{type: stuck_at}"),
}
VERDICTS: Final = {"none": True, "bias": True, "freeze": False}
"""In lock-step the bias stays 2 deg inside every limit of travel, the frozen knee goes 34 deg beyond it."""


@pytest.fixture(autouse=True)
def nothing_left() -> Iterator[None]:
    """No process of ours outlives its test."""
    yield
    wait_until(lambda: our_processes() == [], f"all processes have ended: {our_processes()}")


# --- parity ----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Pair:
    """The same run on vcan and in lock-step."""

    on_vcan: RealTimeRun
    lock_step: RunRecord


@dataclass(frozen=True, slots=True)
class Late:
    """An attempt that was late, and why."""

    why: str


Runs = Callable[[str], Pair]
T = TypeVar("T")


@final
class Patience:
    """How often a run that was late may be tried again: twice; when that did not help, no other test tries again.

    Nor does any when all of them together have taken long already.
    """

    def __init__(self) -> None:
        self._tries = TRIES
        self._until = time.monotonic() + PATIENCE_S

    def until_punctual(self, attempt: Callable[[], T | Late]) -> T:
        """What an attempt gives that is not late; skips when all were."""
        told: list[str] = []
        for _ in range(self._tries):
            got = attempt()
            if not isinstance(got, Late):
                return got
            told.append(got.why)
            if time.monotonic() > self._until:
                break
        self._tries = 1
        pytest.skip("this machine is too busy for real time: " + "; again: ".join(told))


@pytest.fixture(scope="module")
def patience() -> Patience:
    """Of all tests here."""
    return Patience()


def attempt_run(setup: Setup) -> RealTimeRun | Late:
    """One run; nothing may be lost in it even when it is late."""
    try:
        run = run_once(setup)
    except IncompleteError as error:  # drives that missed SYNC for five cycles have stopped by themselves
        return Late(str(error)[:300])
    assert run.timing.lost == []
    late = run.timing.reasons(limits_in(setup.scenario))
    if not late and run.record.valid:
        return run
    late += [f"{name}: {distribution(one)}" for name, one in run.timing.lateness.items() if one.count]
    return Late(", ".join(late or run.record.invalid_reasons))


def distribution(lateness: Lateness) -> str:
    """In words, for the reason of a skip."""
    shares = ", ".join(f"{share:g} % within {lateness.percentile(share / 100) / 1e6:.1f} ms" for share in (50, 90, 99))
    return f"{lateness.count} wake-ups, {shares}, the latest {lateness.worst_ns / 1e6:.1f} ms late"


@pytest.fixture(scope="module")
def runs(patience: Patience) -> Runs:
    """By scenario; each is made once, or found to be too late once."""
    made: dict[str, Pair] = {}
    skipped: dict[str, BaseException] = {}

    def run(name: str) -> Pair:
        if name in skipped:
            raise skipped[name]
        if name not in made:
            scenario = parse_scenario(SCENARIOS[name])
            try:
                on_vcan = patience.until_punctual(lambda: attempt_run(Setup(scenario, BUSES, keep_parts=True)))
            except pytest.skip.Exception as error:
                skipped[name] = error
                raise
            injectors = build_injectors(scenario.injectors, scenario.plan, scenario.seed, 0)
            made[name] = Pair(on_vcan, run_rig(rig_params(scenario), injectors)[0])
        return made[name]

    return run


@pytest.mark.parametrize("name", list(SCENARIOS))
def test_verdict_on_vcan_is_that_of_lock_step(runs: Runs, name: str) -> None:
    """Parity: the same verdicts for no fault, 0.05 rad bias, and a freeze of 1 s."""
    limits = {joint: limits_of(joint) for joint in JOINT_NAMES}
    golden, faulted = runs("none"), runs(name)
    on_vcan = judge(JOINT_NAMES, limits, golden.on_vcan.record, faulted.on_vcan.record)
    lock_step = judge(JOINT_NAMES, limits, golden.lock_step, faulted.lock_step)
    assert on_vcan.passed == lock_step.passed == VERDICTS[name]
    assert len(faulted.on_vcan.record.activations) == len(faulted.lock_step.activations) == (name != "none")


def sender(can_id: int) -> str:
    """Who sends a synchronous COB-ID; "" for one that is not synchronous."""
    base, node_id = can_id & 0x780, can_id & 0x7F
    if can_id in (ids.SYNC, ids.HLC_STATUS) or (base == ids.RPDO1 and 1 <= node_id <= 6):
        return "controller"
    return JOINT_NAMES[node_id - 1] if base in (ids.TPDO1, ids.TPDO2) and 1 <= node_id <= 6 else ""


def by_cycle(record: RunRecord, bus: int) -> list[list[int]]:
    """Synchronous COB-IDs from one SYNC to the next, on that bus, from the one that the controller calls cycle 0.

    Each is completed with the ids of the TPDO2s that a SYNC with that counter does not ask for, at the end, so that
    cycles compare that have different counters: time 0 may be at any.
    """
    cycles: list[list[int]] = []
    zero = -1
    counter = 0
    for row in record.rows:
        frame = row.frame
        if row.bus != bus or frame.flags or not sender(frame.can_id):
            continue
        if frame.can_id == ids.SYNC:
            if cycles:
                cycles[-1] += not_asked(counter)
            counter = frame.data[0]
            cycles.append([])
        if cycles:
            cycles[-1].append(frame.can_id)
            if frame.can_id == ids.HLC_STATUS and frame.data[0] == ids.STATUS_MOTION and zero < 0:
                zero = len(cycles) - 1 - int.from_bytes(frame.data[1:3], "little")
    return cycles[zero:]


def not_asked(counter: int) -> list[int]:
    """TPDO2 comes with every tenth SYNC, of drive n when the counter is n, n + 10 and so on."""
    return [ids.TPDO2 + node_id for node_id in range(1, 7) if (counter - node_id) % 10]


@pytest.mark.parametrize("bus", [0, 1], ids=["vcan0", "vcan1"])
@pytest.mark.parametrize("name", ["none", "freeze"])
def test_frames_of_each_cycle_on_vcan_are_those_of_lock_step(runs: Runs, name: str, bus: int) -> None:
    """Parity: per cycle that was not late, the same multiset of synchronous COB-IDs and the same order per sender."""
    pair = runs(name)
    found, wanted = by_cycle(pair.on_vcan.record, bus), by_cycle(pair.lock_step, bus)
    late = pair.on_vcan.timing.late
    compared = 0
    for cycle in range(CYCLES - 1):
        if late.keys() & {cycle - 1, cycle, cycle + 1}:  # a late frame is missing in its cycle and extra in the next
            continue
        assert Counter(found[cycle]) == Counter(wanted[cycle]), f"cycle {cycle}"
        for who in ("controller", *JOINT_NAMES):
            order = [can_id for can_id in found[cycle] if sender(can_id) == who]
            assert order == [can_id for can_id in wanted[cycle] if sender(can_id) == who], f"cycle {cycle}"
        compared += 1
    assert compared >= 0.9 * CYCLES  # at most 1 % of the cycles are late, and each takes three out


def heartbeats(record: RunRecord, second: int) -> Counter[int]:
    """By COB-ID, in one second of the motion, on the drive bus."""
    start = record.time0_ns + second * SECOND
    rows = [row for row in record.rows if row.bus == 1 and start <= row.end_ns < start + SECOND]
    return Counter(row.frame.can_id for row in rows if row.frame.can_id & 0x780 == ids.HEARTBEAT)


@pytest.mark.parametrize("second", [0, 1])
def test_heartbeats_on_vcan_are_those_of_lock_step(runs: Runs, second: int) -> None:
    """Parity: heartbeats by count, +-1 a second."""
    pair = runs("none")
    found, wanted = heartbeats(pair.on_vcan.record, second), heartbeats(pair.lock_step, second)
    assert set(found) == set(wanted) == {0x701, 0x702, 0x703, 0x704, 0x705, 0x706, 0x77F}
    assert all(abs(found[can_id] - count) <= 1 for can_id, count in wanted.items())


# --- the command line ------------------------------------------------------------------------------------------------


BUS_OPTIONS: Final = ("--controller-bus", BUSES[0], "--drive-bus", BUSES[1])


def test_run_realtime_on_vcan_with_a_fault_gives_verdict_and_result_folder(
    tmp_path: Path, patience: Patience
) -> None:
    """`exo-hil run --realtime`: as in lock-step, exit 1 for the verdict fail, and logs that python-can reads."""
    scenario, out = tmp_path / "freeze.yaml", tmp_path / "result"
    scenario.write_text(SCENARIOS["freeze"])

    def attempt() -> Program | Late:
        shutil.rmtree(out, ignore_errors=True)
        program = Program(["run", str(scenario), "--realtime", *BUS_OPTIONS, "--out", str(out)], tmp_path)
        try:
            code = program.wait(90)
        finally:
            program.close()
        if code != INVALID:
            return program
        if not (out / "summary.json").exists():  # drives that missed SYNC for five cycles have stopped by themselves
            return Late(program.printed[-300:].strip())
        document = json.loads((out / "summary.json").read_text())
        assert not [reason for reason in document["invalid_reasons"] if "were lost" in reason]
        return Late(", ".join(document["invalid_reasons"]))

    program = patience.until_punctual(attempt)
    assert program.code == FAIL, program.printed
    document = json.loads((out / "summary.json").read_text())
    assert (document["valid"], document["verdict"], document["source"]) == (True, "fail", "plant")
    assert [(one["injector"], one["signal"]) for one in document["injections"]] == [("fault", "right_knee.position")]
    assert {one["joint"] for one in document["failures"]} == {"right_knee"}
    assert document["realtime"]["cycles"] == 2 * CYCLES
    for bus in ("controller", "drive"):
        messages = Counter(message.arbitration_id for message in can.LogReader(out / f"{bus}.log"))
        assert messages[ids.SYNC] >= CYCLES + 75  # the motion, and the stride before it
        assert all(messages[ids.TPDO1 + node_id] >= CYCLES for node_id in range(1, 7))


def test_rig_on_vcan_ends_in_order_with_ctrl_c(tmp_path: Path, patience: Patience) -> None:
    """`exo-hil up`: ready when it says so; SIGINT is its normal end, and leaves nothing behind."""
    scenario, control = tmp_path / "rig.yaml", tmp_path / "control"
    scenario.write_text(BASE)

    def attempt() -> Program | Late:
        rig = Program(["up", str(scenario), *BUS_OPTIONS, "--control", str(control)], tmp_path)
        try:
            wait_until(lambda: "running; Ctrl-C stops" in rig.printed or rig.code is not None, "it runs", 60)
            running, is_there = our_processes(), control.exists()
            code = rig.end(signal.SIGINT)
        finally:
            rig.close()
        assert not control.exists()
        if code == INVALID:  # drives that missed SYNC for five cycles have stopped by themselves
            return Late(rig.printed[-300:].strip())
        assert (len(running), is_there) == (4, True), rig.printed
        return rig

    rig = patience.until_punctual(attempt)
    assert rig.code == PASS, rig.printed


# --- foreign controller ----------------------------------------------------------------------------------------------


def test_canopen_master_on_vcan_moves_a_knee() -> None:
    """The canopen package in place of our controller: it reads the PDO mapping from the drives and works by names."""
    scenario = parse_scenario(BASE)
    with as_file(files("dbc") / "exo_joint.eds") as eds, Supervisor(
        Setup(scenario, BUSES, without=frozenset({"hlc"}))
    ) as rig:
        rig.start()

        def heard(condition: Callable[[], bool]) -> bool:
            limit = rig.now() + 20 * SECOND
            rig.run(lambda now: condition() or now > limit)
            return condition()

        network = canopen.Network()
        network.connect(interface="socketcan", channel="vcan0")
        nodes = []
        try:
            for node_id in range(1, 7):
                node = network.add_node(node_id, str(eds))
                nodes.append(node)
                node.sdo.RESPONSE_TIMEOUT = 20.0
                assert node.sdo[0x1000].raw == 0x00020192  # CiA 402 servo drive
                node.sdo[0x1019].raw = 0  # the SYNC of canopen has no counter
                node.sdo[0x6060].raw = 10  # cyclic synchronous torque
                node.rpdo[1].read()
                node.tpdo[1].read()
                node.rpdo[1]["Controlword"].raw = 0x06
                node.rpdo[1]["Target torque"].raw = 0
                node.rpdo[1].start(0.02)
            network.nmt.state = "OPERATIONAL"
            network.sync.start(0.02)
            for word, state in ((0x06, DriveState.READY_TO_SWITCH_ON), (0x0F, DriveState.OPERATION_ENABLED)):
                for node in nodes:
                    node.rpdo[1]["Controlword"].raw = word
                    node.rpdo[1].update()
                assert heard(lambda: set(rig.watch.states.values()) == {state}), (state, rig.watch.states)  # noqa: B023
            knee = nodes[4]
            hanging = knee.tpdo[1]["Position actual value"].raw
            knee.rpdo[1]["Target torque"].raw = -150  # per mille: 8 N m flexion
            knee.rpdo[1].update()
            flexed = hanging - 131072 * 10 // 360  # 10 deg; a shank that hangs needs less than that torque for it
            assert heard(lambda: knee.tpdo[1]["Position actual value"].raw < flexed)
        finally:
            network.sync.stop()  # type: ignore[no-untyped-call]
            for node in nodes:
                node.rpdo[1].stop()
            network.disconnect()
        rig.stop()
        assert {name: process.code for name, process in rig.processes.items()} == {"joints": 0, "gateway": 0}
