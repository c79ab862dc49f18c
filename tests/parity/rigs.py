"""A rig of processes: walked, listened to, one of them killed with -9; nothing of it may be left. For any bus."""

import os
import select
import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Final, final

import numpy as np
import pytest

from canopen_exo import plan as ids
from canopen_exo.bus.node import MS, NEVER, SECOND
from testbench.child import ProcessError
from testbench.parts import HlcPart, JointsPart, read_gateway, read_hlc, read_joints
from testbench.process import ENDED_EARLY
from testbench.scenario import JOINT_NAMES
from testbench.supervisor import REACT_NS, Supervisor
from tests.parity.patience import Late, Patience, distributions, gave_up_late
from tests.parity.walks import Bench

LONG_NS: Final = 20 * SECOND
"""Longer than anything here takes on a machine that is merely busy."""

SYNC_LOST, RPDO_LOST, HEARTBEAT_LOST = 0x8700, 0x8250, 0x8130
"""Emergencies of a drive, CiA 301 and CiA 402."""

MOST_LATE_NS: Final = 100 * MS
"""Of a wake-up, in a rig whose time-outs are judged by what is heard within a second."""

_SYNC_CYCLES: Final = 5
_SETTLE_NS: Final = 50 * MS
"""The motor's current decays, in some ms."""


def is_alive(pid: int) -> bool:
    """Whether there is such a process."""
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    return True


def descendants_of(pid: int) -> list[int]:
    """Process ids, from /proc."""
    found = []
    for entry in Path("/proc").glob("[0-9]*/stat"):
        try:
            fields = entry.read_text().rpartition(")")[2].split()
        except OSError:  # it ended meanwhile
            continue
        if int(fields[1]) == pid:
            child = int(entry.parent.name)
            found += [child, *descendants_of(child)]
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
    assert all(ended(pid, 0.0) for pid in pids)
    assert not folder.exists()  # with its control socket


def walk(rig: Supervisor, for_ns: int = 300 * MS) -> Late | None:
    """Until some way into the motion. Late when the drives did not survive that long on this machine."""
    limit = rig.now() + LONG_NS
    hlc = rig.processes["hlc"]
    try:
        rig.run(lambda now: now > min(rig.watch.time_zero + for_ns, limit) or hlc.code is not None)
    except ProcessError as error:
        if hlc.code != ENDED_EARLY or not gave_up_late(str(error)):
            raise
        # it gave up and says why: drives that miss SYNC for five cycles stop
        return Late(f"{error}; {rig.watch.sync_words()}")
    if hlc.code is None and rig.watch.time_zero != NEVER:
        return None
    why = f"the motion did not go on: {hlc.obituary()}; {rig.watch.timing_words()}"
    assert gave_up_late(why), why
    return Late(f"{why}; {rig.watch.sync_words()}")


def heard(rig: Supervisor, condition: Callable[[], bool]) -> Late | None:
    """Listen until it holds. Late when it does not because drives stopped by themselves; else that is a failure."""
    limit = rig.now() + LONG_NS
    rig.run(lambda now: condition() or now > limit or _stopped(rig))
    if condition():
        return None
    assert _stopped(rig), f"not heard in {LONG_NS / SECOND:g} s; drives: {rig.watch.states}"
    codes = sorted({f"{one.code:04X}" for one in rig.watch.alarms})
    words = rig.watch.timing_words()
    assert words or not rig.watch.cycles, f"drives missed SYNC or commands ({codes}) in a rig that kept time"
    return Late(f"drives missed SYNC or commands: {codes}; {words or rig.watch.sync_words()}")


def _stopped(rig: Supervisor) -> bool:
    """Whether a drive reported that it missed something."""
    return any(alarm.code in (SYNC_LOST, RPDO_LOST, HEARTBEAT_LOST) for alarm in rig.watch.alarms)


@final
@dataclass(frozen=True, slots=True)
class Aftermath:
    """What was left after one process was killed while walking."""

    message: str
    alarms: set[tuple[str, int]]
    joints: JointsPart | None
    hlc: HlcPart | None


def kill(bench: Bench, name: str) -> Aftermath | Late:
    """Walk, kill, wait for the supervisor to notice, and end the rest. Nothing is left over, late or not."""
    with nothing_left(Supervisor(bench.setup())) as rig:
        rig.start()
        late = walk(rig)
        if late is not None:
            return late
        os.kill(rig.processes[name].pid, signal.SIGKILL)
        killed_ns = rig.now()
        with pytest.raises(ProcessError) as raised:
            rig.run(lambda now: now > killed_ns + LONG_NS)
        took_ns = rig.now() - killed_ns
        rig.stop()
        others = {other: process.code for other, process in rig.processes.items() if other != name}
        assert all(code is not None and 0 <= code <= 1 for code in others.values()), others
        joints = None if name == "joints" else read_joints(rig.part("joints"))
        hlc = None if name == "hlc" else read_hlc(rig.part("hlc"))
        gateway = None if name == "gateway" else read_gateway(rig.part("gateway"))
        assert not rig.part(name).exists()
        alarms = {(alarm.joint, alarm.code) for alarm in rig.watch.alarms}
    parts = {"hlc": hlc, "joints": joints, "gateway": gateway}
    lateness = {part: one.service.lateness for part, one in parts.items() if one is not None}
    worst_ns = max(took_ns - REACT_NS, *(one.worst_ns for one in lateness.values()))
    if worst_ns > MOST_LATE_NS:
        return Late(f"killed {name}: told after {took_ns / 1e9:.2f} s; {distributions(lateness)}")
    return Aftermath(str(raised.value), alarms, joints, hlc)


def check_killed(bench: Bench, name: str, patience: Patience) -> None:
    """Drives stop by themselves within their configured time-out, the others report it and end; nothing is left."""
    left = patience.until_punctual(lambda: kill(bench, name))
    assert left.message.startswith(f"{name} was killed by SIGKILL")
    if left.joints is not None:
        # on the plant's clock, from the last SYNC that came: the first time-out is SYNC loss after 5 cycles
        last_ns = max(row.end_ns for row in left.joints.rows if row.sender < 0 and row.frame.can_id == ids.SYNC)
        stopped = left.joints.times_ns > last_ns + _SYNC_CYCLES * bench.cycle_ns + _SETTLE_NS
        assert stopped.any()
        assert np.abs(left.joints.tau[~stopped]).max() > 1.0
        assert np.abs(left.joints.tau[stopped]).max() < 0.01
    if name in ("hlc", "gateway"):  # the drives can still be heard
        for code in (SYNC_LOST, RPDO_LOST, HEARTBEAT_LOST):
            assert {joint for joint, found in left.alarms if found == code} == set(JOINT_NAMES)
        (told,) = [part for part in left.message.split("; ") if "heartbeat lost (8130): " in part]
        assert all(joint in told for joint in JOINT_NAMES)
    if left.hlc is not None:
        assert not left.hlc.completed
        assert {event.joint for event in left.hlc.events if event.kind == "heartbeat_lost"} == set(JOINT_NAMES)
