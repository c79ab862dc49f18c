"""The whole rig as processes over vcan0 (controller side) and vcan1 (drive side); parity is in test_parity.py."""

import json
import shutil
import signal
from collections import Counter
from importlib.resources import as_file, files
from pathlib import Path
from typing import Any

import can
import canopen
import pytest

from canopen_exo import plan as ids
from canopen_exo.cia402 import DriveState
from testbench.cli import FAIL, INVALID, PASS
from testbench.supervisor import Supervisor
from tests.parity.patience import Late, Patience, gave_up_late, is_lateness, why_invalid
from tests.parity.rigs import check_killed, heard
from tests.vcan.inside.peers import wait_until
from tests.vcan.inside.programs import VCAN, Program, our_processes

pytestmark = [pytest.mark.realtime, pytest.mark.usefixtures("nothing_left")]


# --- the command line ------------------------------------------------------------------------------------------------


def test_run_realtime_on_vcan_with_a_fault_gives_verdict_and_result_folder(
    tmp_path: Path, patience: Patience
) -> None:
    """`exo-hil run --realtime`: as in lock-step, exit 1 for the verdict fail, and logs that python-can reads."""
    scenario, out = tmp_path / "freeze.yaml", tmp_path / "result"
    scenario.write_text(VCAN.text("freeze"))

    def attempt() -> Program | Late:
        shutil.rmtree(out, ignore_errors=True)
        program = Program(["run", str(scenario), "--realtime", *VCAN.options, "--out", str(out)], tmp_path)
        try:
            code = program.wait(90)
        finally:
            program.close()
        if code != INVALID:
            return program
        found: dict[str, Any] = {}
        if (out / "summary.json").exists():
            found = json.loads((out / "summary.json").read_text())
        # else drives that missed SYNC for five cycles have stopped by themselves
        reasons = found.get("invalid_reasons") or program.printed.strip().splitlines()[-1:]
        is_late = is_lateness(reasons, VCAN.cycle_ns / 1e6) or "not ready after " in program.printed
        assert is_late, (reasons, program.printed)
        return Late(why_invalid(found) or ", ".join(reasons))

    program = patience.until_punctual(attempt)
    assert program.code == FAIL, program.printed
    document = json.loads((out / "summary.json").read_text())
    assert (document["valid"], document["verdict"], document["source"]) == (True, "fail", "plant")
    assert [(one["injector"], one["signal"]) for one in document["injections"]] == [("fault", "right_knee.position")]
    assert {one["joint"] for one in document["failures"]} == {"right_knee"}
    assert document["realtime"]["cycles"] == 2 * VCAN.cycles
    for bus in ("controller", "drive"):
        messages = Counter(message.arbitration_id for message in can.LogReader(out / f"{bus}.log"))
        assert messages[ids.SYNC] >= VCAN.cycles + 75  # the motion, and the stride before it
        assert all(messages[ids.TPDO1 + node_id] >= VCAN.cycles for node_id in range(1, 7))


def test_rig_on_vcan_ends_in_order_with_ctrl_c(tmp_path: Path, patience: Patience) -> None:
    """`exo-hil up`: ready when it says so; SIGINT is its normal end, and leaves nothing behind."""
    scenario, control = tmp_path / "rig.yaml", tmp_path / "control"
    scenario.write_text(VCAN.text())

    def attempt() -> Program | Late:
        rig = Program(["up", str(scenario), *VCAN.options, "--control", str(control)], tmp_path)
        try:
            wait_until(lambda: "running; Ctrl-C stops" in rig.printed or rig.code is not None, "it runs", 60)
            running, is_there = our_processes(), control.exists()
            code = rig.end(signal.SIGINT)
        finally:
            rig.close()
        assert not control.exists()
        if code == INVALID:  # drives that missed SYNC for five cycles have stopped by themselves
            assert gave_up_late(rig.printed), rig.printed
            return Late("; ".join(rig.printed.strip().splitlines()[-3:]))
        assert (len(running), is_there) == (4, True), rig.printed
        return rig

    rig = patience.until_punctual(attempt)
    assert rig.code == PASS, rig.printed


# --- killed ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["hlc", "gateway", "joints"])
def test_killed_process_is_named_and_the_others_react_and_end(name: str, patience: Patience) -> None:
    """kill -9 of any one process while walking: drives stop by themselves, the others report it; nothing is left."""
    check_killed(VCAN, name, patience)


# --- foreign controller ----------------------------------------------------------------------------------------------


def test_canopen_master_on_vcan_moves_a_knee(patience: Patience) -> None:
    """The canopen package in place of our controller: it reads the PDO mapping from the drives and works by names."""

    def attempt() -> Late | None:
        setup = VCAN.setup(without=frozenset({"hlc"}))
        with as_file(files("dbc") / "exo_joint.eds") as eds, Supervisor(setup) as rig:
            rig.start()
            late = move_the_knee(rig, str(eds))
            rig.stop()
            assert {name: process.code for name, process in rig.processes.items()} == {"joints": 0, "gateway": 0}
            return late

    patience.until_punctual(attempt)


def move_the_knee(rig: Supervisor, eds: str) -> Late | None:
    """Boot, configure, enable, flex. Late when drives stopped by themselves because SYNC or commands came too late."""
    network = canopen.Network()
    network.connect(interface="socketcan", channel="vcan0")
    nodes = []
    try:
        booted: set[int] = set()
        for node_id in range(1, 7):
            network.subscribe(0x700 + node_id, lambda can_id, data, stamp: booted.add(can_id))
        network.nmt.send_command(0x82)  # reset communication: what drives answered to others before is over with it
        assert heard(rig, lambda: len(booted) == 6) is None
        for node_id in range(1, 7):
            node = network.add_node(node_id, eds)
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
            late = heard(rig, lambda: set(rig.watch.states.values()) == {state})  # noqa: B023
            if late is not None:
                return late
        knee = nodes[4]
        hanging = knee.tpdo[1]["Position actual value"].raw
        knee.rpdo[1]["Target torque"].raw = -150  # per mille: 8 N m flexion
        knee.rpdo[1].update()
        flexed = hanging - 131072 * 10 // 360  # 10 deg; a shank that hangs needs less than that torque for it
        return heard(rig, lambda: knee.tpdo[1]["Position actual value"].raw < flexed)
    finally:
        network.sync.stop()  # type: ignore[no-untyped-call]
        for node in nodes:
            node.rpdo[1].stop()
        network.disconnect()
