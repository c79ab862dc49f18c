"""A rig of processes: started in order, ended in order, and what happens when one of them is killed.

At 100 Hz on the hub. Nothing here hangs on how fast the machine is: the time-outs of the drives are judged on the clock
of their own plant, and everything else by what was heard.
"""

import os
import re
import select
import signal
import struct
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import canopen
import numpy as np
import pytest

from canopen_exo.bus.node import MS, NEVER, SECOND
from canopen_exo.cia402 import DriveState
from testbench import supervisor
from testbench.errors import BenchError
from testbench.parts import GatewayPart, HlcPart, JointsPart, read_gateway, read_hlc, read_joints
from testbench.scenario import JOINT_NAMES, Scenario, parse_scenario
from testbench.supervisor import ProcessError, Setup, Supervisor

pytestmark = pytest.mark.realtime

TEXT = """\
name: rig
rig: {plant: suspended, stops: off, rate: 100 Hz}
motion: {gait: walking, stride: 1.5 s, duration: 3 s}
"""
LONG_NS = 20 * SECOND
"""Longer than anything here takes on a machine that is merely busy."""


@pytest.fixture(scope="module")
def scenario() -> Scenario:
    return parse_scenario(TEXT)


def is_alive(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    return True


def walk(rig: Supervisor, for_ns: int = 300 * MS) -> None:
    """Until some way into the motion; skips when the drives did not survive that long on this machine."""
    limit = rig.now() + LONG_NS
    rig.run(lambda now: now > min(rig.watch.time_zero + for_ns, limit))
    if rig.watch.time_zero == NEVER:
        pytest.skip("this machine is too busy for real time: the motion never began")


@contextmanager
def nothing_left(rig: Supervisor) -> Iterator[Supervisor]:
    """Run a rig and see that no process, no folder and no socket of it is there afterwards."""
    pids: list[int] = []
    with rig:
        folder = rig.part("x").parent
        try:
            yield rig
        finally:
            pids += [process.pid for process in rig.processes.values()]
    assert pids
    assert not any(is_alive(pid) for pid in pids)
    assert not folder.exists()  # with its control socket


# --- ended in order --------------------------------------------------------------------------------------------------


def test_rig_told_to_end_leaves_the_drives_disabled(scenario: Scenario) -> None:
    """Ctrl-C stops everything cleanly: controller first, so that it can disable the drives."""
    with nothing_left(Supervisor(Setup(scenario, endless=True))) as rig:
        rig.start()
        assert list(rig.processes) == ["hub", "joints", "gateway", "hlc"]
        walk(rig)
        assert set(rig.watch.states.values()) == {DriveState.OPERATION_ENABLED}
        rig.stop()
        assert {name: process.code for name, process in rig.processes.items()} == dict.fromkeys(rig.processes, 0)
        assert set(rig.watch.states.values()) == {DriveState.SWITCH_ON_DISABLED}


def children_of(pid: int) -> list[int]:
    """Process ids, from /proc."""
    found = []
    for entry in Path("/proc").glob("[0-9]*/stat"):
        try:
            fields = entry.read_text().rpartition(")")[2].split()
        except OSError:  # it ended meanwhile
            continue
        if int(fields[1]) == pid:
            found.append(int(entry.parent.name))
    return found


def ended(pid: int, timeout_s: float) -> bool:
    """Wait until a process that is not ours has ended."""
    try:
        handle = os.pidfd_open(pid)
    except ProcessLookupError:
        return True
    try:
        return bool(select.select([handle], [], [], timeout_s)[0])
    finally:
        os.close(handle)


linux = pytest.mark.skipif(sys.platform != "linux", reason="looks at /proc, and has the kernel tell")


@linux
@pytest.mark.parametrize(
    ("number", "code"), [(signal.SIGINT, 0), (signal.SIGTERM, 0), (signal.SIGKILL, -signal.SIGKILL)]
)
def test_up_ends_with_all_its_processes(tmp_path: Path, number: signal.Signals, code: int) -> None:
    """Ctrl-C and SIGTERM are the normal end of `up`; and when it is killed itself, its processes end all the same."""
    (tmp_path / "rig.yaml").write_text(TEXT)
    arguments = ["up", "rig.yaml", "--listen", "127.0.0.1:0", "--control", str(tmp_path / "control")]
    up = subprocess.Popen(
        [sys.executable, "-m", "testbench.cli", *arguments],
        cwd=tmp_path,
        env={**os.environ, "TMPDIR": str(tmp_path)},
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    try:
        assert up.stderr is not None
        said: list[str] = []
        for line in up.stderr:
            said.append(line)
            if line.startswith("running"):
                break
        children = children_of(up.pid)
        assert len(children) == 4, said
        assert any(re.match(r"controller bus: hub:127\.0\.0\.1:\d+/controller", line) for line in said)
        up.send_signal(number)
        said += up.stderr.readlines()  # until the last process that may write there has gone
        assert up.wait(LONG_NS / SECOND) == code, said
        assert all(ended(pid, LONG_NS / SECOND) for pid in children)
    finally:
        up.kill()
        up.wait()
        assert up.stderr is not None
        up.stderr.close()
    if number is not signal.SIGKILL:
        assert sorted(path.name for path in tmp_path.iterdir()) == ["rig.yaml"]
    else:
        assert not (tmp_path / "control").exists()


# --- killed ----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Aftermath:
    """What was left after one process was killed while walking. killed_ns: on the rig's clock."""

    killed_ns: int
    message: str
    alarms: set[tuple[str, int]]
    joints: JointsPart | None
    hlc: HlcPart | None
    gateway: GatewayPart | None


def kill(scenario: Scenario, name: str) -> Aftermath:
    with nothing_left(Supervisor(Setup(scenario, keep_parts=True))) as rig:
        rig.start()
        walk(rig)
        killed_ns = rig.now()
        os.kill(rig.processes[name].pid, signal.SIGKILL)
        with pytest.raises(ProcessError) as raised:
            rig.run(lambda now: now > killed_ns + LONG_NS)
        rig.stop()
        others = {other: process.code for other, process in rig.processes.items() if other != name}
        assert all(code is not None and 0 <= code <= 1 for code in others.values()), others
        joints = None if name == "joints" else read_joints(rig.part("joints"))
        hlc = None if name == "hlc" else read_hlc(rig.part("hlc"))
        gateway = None if name == "gateway" else read_gateway(rig.part("gateway"))
        assert not rig.part(name).exists()
        alarms = {(alarm.joint, alarm.code) for alarm in rig.watch.alarms}
    return Aftermath(killed_ns, str(raised.value), alarms, joints, hlc, gateway)


EDS = Path(__file__).resolve().parents[2] / "dbc" / "exo_joint.eds"
POSITION = struct.Struct("<i4x")
COMMAND = struct.Struct("<Hh")
FLEXED = 131072 * 10 // 360
"""10 deg in counts; a shank that hangs from a fixed waist needs less than the torque it gets to be there."""

SYNC_LOST, RPDO_LOST, HEARTBEAT_LOST = 0x8700, 0x8250, 0x8130


@pytest.mark.parametrize("name", ["hlc", "gateway", "joints", "hub"])
def test_killed_process_is_named_and_the_others_react_and_end(scenario: Scenario, name: str) -> None:
    """kill -9 of any one process while walking: drives stop by themselves, the others report it; nothing is left."""
    left = kill(scenario, name)
    assert left.message.startswith(f"{name} was killed by SIGKILL")
    if left.joints is not None:
        # SYNC lost after 50 ms, commands after 100 ms, heartbeat after 300 ms; the motor's current needs some ms more
        stopped = left.joints.times_ns > left.killed_ns + 400 * MS
        assert stopped.any()
        assert np.abs(left.joints.tau[~stopped]).max() > 1.0
        assert np.abs(left.joints.tau[stopped]).max() < 0.01
    if name in ("hlc", "gateway"):  # the drives can still be heard
        for code in (SYNC_LOST, RPDO_LOST, HEARTBEAT_LOST):
            assert {joint for joint, found in left.alarms if found == code} == set(JOINT_NAMES)
        assert "right_knee 8130" in left.message
    if left.hlc is not None:
        assert not left.hlc.completed
        assert {event.joint for event in left.hlc.events if event.kind == "heartbeat_lost"} == set(JOINT_NAMES)


# --- not started -----------------------------------------------------------------------------------------------------


def test_part_that_is_never_heard_is_named(scenario: Scenario, monkeypatch: pytest.MonkeyPatch) -> None:
    """Readiness by CAN traffic: a gateway that does not pass frames is not ready, whoever it is."""
    monkeypatch.setattr(supervisor, "READY_NS", 5 * SECOND)
    with nothing_left(Supervisor(Setup(scenario, without=frozenset({"gateway"})))) as rig:
        with pytest.raises(ProcessError) as raised:
            rig.start()
        assert list(rig.processes) == ["hub", "joints"]
    told = str(raised.value)
    assert told.startswith("gateway: not ready after 5 s: no SDO answer came through to the controller bus hub:")
    assert told.endswith(f"from {', '.join(JOINT_NAMES)}")


def test_hub_that_cannot_listen_is_told_with_its_last_words(scenario: Scenario) -> None:
    """Which one, why, its last lines."""
    with nothing_left(Supervisor(Setup(scenario))) as rig:
        rig.start([])
        address = rig.buses[0].removeprefix("hub:").partition("/")[0]
        with Supervisor(Setup(scenario, listen=address)) as second:
            with pytest.raises(ProcessError) as raised:
                second.start()
            assert list(second.processes) == ["hub"]
    assert "hub ended with exit code 2; its last lines:" in str(raised.value)
    assert "stop what runs there" in str(raised.value)


def test_bus_that_is_not_there_is_told_before_anything_starts(scenario: Scenario) -> None:
    """One line saying what to run."""
    with Supervisor(Setup(scenario, ("hub:127.0.0.1:1/a", "hub:127.0.0.1:1/b"))) as rig:
        with pytest.raises(BenchError, match="exo-hil hub"):
            rig.start()
        assert rig.processes == {}


# --- foreign controller ----------------------------------------------------------------------------------------------


def heard(condition: Callable[[], bool], rig: Supervisor) -> bool:
    """Listen until the condition holds."""
    limit = rig.now() + LONG_NS
    rig.run(lambda now: condition() or now > limit)
    return condition()


def test_foreign_controller_enables_the_drives_moves_them_and_reads_positions(scenario: Scenario) -> None:
    """Any part may be foreign software: here the canopen package is the master instead of our controller."""
    with nothing_left(Supervisor(Setup(scenario, without=frozenset({"hlc"})))) as rig:
        rig.start()
        assert list(rig.processes) == ["hub", "joints", "gateway"]
        booted: set[int] = set()
        positions: list[int] = []
        network = canopen.Network()
        network.connect(interface="hub", channel=rig.buses[0].removeprefix("hub:"))
        commands: list[canopen.network.PeriodicMessageTask] = []
        try:
            for node_id in range(1, 7):
                network.subscribe(0x700 + node_id, lambda can_id, data, stamp: booted.add(can_id))
            network.subscribe(0x185, lambda can_id, data, stamp: positions.append(POSITION.unpack(data)[0]))
            network.nmt.send_command(0x82)  # reset communication
            assert heard(lambda: len(booted) == 6, rig)
            for node_id in range(1, 7):
                node = canopen.RemoteNode(node_id, str(EDS))
                network.add_node(node)
                node.sdo.RESPONSE_TIMEOUT = LONG_NS / SECOND
                node.sdo[0x1019].raw = 0  # the SYNC of canopen has no counter
                node.sdo[0x6060].raw = 10  # cyclic synchronous torque
                commands.append(network.send_periodic(0x200 + node_id, COMMAND.pack(0x06, 0), 0.01))
            network.nmt.send_command(0x01)
            network.sync.start(0.01)
            for word, state in ((0x06, DriveState.READY_TO_SWITCH_ON), (0x0F, DriveState.OPERATION_ENABLED)):
                for command in commands:
                    command.update(COMMAND.pack(word, 0))
                assert heard(lambda: set(rig.watch.states.values()) == {state}, rig), state  # noqa: B023
            hanging = positions[-1]
            commands[4].update(COMMAND.pack(0x0F, -150))  # right knee: 15 % of rated torque, 8.2 N m flexion
            assert heard(lambda: positions[-1] < hanging - FLEXED, rig)
            for command in commands:
                command.update(COMMAND.pack(0x00, 0))
            assert heard(lambda: set(rig.watch.states.values()) == {DriveState.SWITCH_ON_DISABLED}, rig)
        finally:
            network.sync.stop()  # type: ignore[no-untyped-call]
            for command in commands:
                command.stop()  # type: ignore[no-untyped-call]
            network.disconnect()
