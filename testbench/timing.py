"""Whether a real-time run was on time: which control cycles were late and by how much, and whether a frame was lost.

A cycle is late when the drives' answers or the controller's commands miss the next SYNC. Each process records the
frames it received (time of arrival) and sent (time of sending), in the order of handling, on one clock. The way of a
cycle through the rig is cut into steps: a process handles a frame, or a frame travels from one process to the next. A
step that begins in a cycle and ends when the next SYNC was due, and already there, makes the cycle late by the
difference. A SYNC itself makes its cycle late when it is on its way later than the next one was due.
Steps between our own processes only: what foreign software does in between is not judged. It has its own clock, too:
what begins with a frame of foreign software is late when it is not at its end one cycle after that frame came.
A fault on the wire is not lateness, whatever it drops or changes: steps are followed within one hop, and a fault acts
between two of them.
Leaves out: whatever is not synchronous (SYNC, PDOs, the controller's status) when it comes to lateness; loss is looked
for among all ids but those of SDO requests, which more than one node may send.
"""

from collections.abc import Iterable
from dataclasses import dataclass, field
from itertools import chain
from typing import Final

from canopen_exo import plan as ids
from canopen_exo.bus.frame import Frame
from canopen_exo.bus.lateness import Lateness
from canopen_exo.bus.medium import Transmission
from canopen_exo.bus.node import MS, NEVER
from canopen_exo.plan import BusPlan
from testbench.parts import GatewayPart, HlcPart, JointsPart

CONTROLLER_BUS: Final = 0
DRIVE_BUS: Final = 1

_MOST_IDS: Final = 4
"""How many CAN ids a message names."""

STAMP_SLACK_NS: Final = MS
"""A stamp of arrival rarely lies this much before that of sending, which is taken when the frame is on its way
(assumed). Only where equal frames follow each other does it decide which one came first."""


@dataclass(frozen=True, slots=True)
class TimingLimits:
    """late_share: of all cycles, 0..1; late_worst_ns: of any one cycle. Beyond either a run is invalid."""

    late_share: float
    late_worst_ns: int


@dataclass(frozen=True, slots=True)
class Timing:
    """cycles: of the motion that were judged; late: cycle -> by how much [ns]; worst: where the latest was, in words.

    lost: what was lost where, in words; counted: frames that a queue, the kernel or the hub says it dropped;
    lateness: of the wake-ups, by process; latency: that the gateway added, by the bus it sent on.
    """

    cycles: int
    late: dict[int, int]
    worst: str
    lost: list[str]
    lateness: dict[str, Lateness]
    latency: dict[str, Lateness] = field(default_factory=dict)
    counted: int = 0

    @property
    def late_worst_ns(self) -> int:
        """By how much the latest cycle was late, ns; 0 when none was."""
        return max(self.late.values(), default=0)

    def reasons(self, limits: TimingLimits) -> list[str]:
        """Why the run proves nothing; empty when it was on time and complete."""
        found = list(self.lost)
        share = len(self.late) / self.cycles if self.cycles else 0.0
        if share > limits.late_share:
            found.append(
                f"{len(self.late)} of {self.cycles} cycles late ({100 * share:.1f} %), "
                f"allowed {100 * limits.late_share:g} %: {self.worst}"
            )
        if self.late_worst_ns > limits.late_worst_ns:
            worst, allowed = self.late_worst_ns / 1e6, limits.late_worst_ns / 1e6
            found.append(f"a cycle late by {worst:.1f} ms, allowed {allowed:g} ms: {self.worst}")
        return found


class _Judge:
    """Collects late cycles. zero_ns: time 0; cycles: of the motion.

    A frame belongs to the cycle whose SYNC began what made it. The number is handed on from row to row, along the way
    of the frame; where the way begins in foreign software, it is the cycle in which the row lies. When that was is
    handed on as well.
    """

    def __init__(self, zero_ns: int, cycle_ns: int, cycles: int) -> None:
        self.zero_ns: Final = zero_ns
        self.cycle_ns: Final = cycle_ns
        self.cycles: Final = cycles
        self.late: dict[int, int] = {}
        self.worst: str = ""
        self._ways: Final[dict[int, tuple[int, int]]] = {}  # by id() of the row; the parts keep the rows

    def begin(self, row: Transmission, cycle: int) -> None:
        """The way of a frame begins with this row of our controller, in that cycle."""
        self._ways[id(row)] = (cycle, NEVER)

    def follow(self, row: Transmission, before: Transmission) -> None:
        """The way of a frame, or what it began, goes on from one row to the next."""
        self._ways[id(row)] = self._way(before)

    def cycle(self, row: Transmission) -> int:
        """The cycle a row belongs to."""
        return self._way(row)[0]

    def _way(self, row: Transmission) -> tuple[int, int]:
        """(cycle, when the way began in foreign software [ns]; NEVER: in our controller, on the grid from time 0)."""
        return self._ways.get(id(row), ((row.end_ns - self.zero_ns) // self.cycle_ns, row.end_ns))

    def syncs(self, rows: list[Transmission], bus: int) -> dict[int, int]:
        """Cycle -> when its SYNC was on that bus, as one process saw or sent it [ns]."""
        found: dict[int, int] = {}
        for row in rows:
            if row.bus == bus and row.frame.can_id == ids.SYNC and row.frame.flags == 0:
                found.setdefault(self.cycle(row), row.end_ns)
        return found

    def judge(self, row: Transmission, what: str, syncs: dict[int, int]) -> None:
        """A step ended with this row. syncs: on its bus; when the next one came, a SYNC itself is judged by its due."""
        cycle, begun_ns = self._way(row)
        if not 0 <= cycle < self.cycles:
            return
        is_ours = begun_ns == NEVER
        due_ns = self.zero_ns + (cycle + 1) * self.cycle_ns if is_ours else begun_ns + self.cycle_ns
        if is_ours and row.frame.can_id != ids.SYNC:
            due_ns = max(due_ns, syncs.get(cycle + 1, due_ns))
        by_ns = row.end_ns - due_ns
        if by_ns > 0:
            if by_ns > max(self.late.values(), default=0):
                self.worst = f"cycle {cycle}, {what} {row.frame.can_id:03X}"
            if by_ns > self.late.get(cycle, 0):
                self.late[cycle] = by_ns


def judge_timing(
    plan: BusPlan,
    zero_ns: int,
    cycles: int,
    hlc: HlcPart | None,
    gateway: GatewayPart | None,
    joints: JointsPart | None,
) -> Timing:
    """Judge `cycles` cycles from time 0 [ns, loop clock]. None: that part of the rig was foreign software."""
    judge = _Judge(zero_ns, plan.cycle_ns, cycles)
    pdos = [(pdo.name[0], pdo.base + joint.node_id) for pdo in plan.pdos for joint in plan.joints]
    commands = {ids.SYNC, ids.HLC_STATUS, *(cob_id for kind, cob_id in pdos if kind == "R")}
    answers = {cob_id for kind, cob_id in pdos if kind == "T"}
    lost: list[str] = []
    controller = None if hlc is None else _End("controller", hlc.rows, 0)
    drives = None if joints is None else _End("joints", joints.rows, 0)
    left = None if gateway is None else _End("gateway", gateway.rows, CONTROLLER_BUS)
    right = None if gateway is None else _End("gateway", gateway.rows, DRIVE_BUS)
    if hlc is not None:  # in the order of the way: from the controller to the drives and back
        _controller(judge, hlc.rows, commands)
    lost += _travel(judge, "controller bus", controller, left, commands)
    if gateway is not None:
        _gateway(judge, gateway.rows, commands)
    lost += _travel(judge, "drive bus", right, drives, commands)
    if joints is not None:
        _drives(judge, joints.rows, answers)
    lost += _travel(judge, "drive bus", drives, right, answers)
    if gateway is not None:
        _gateway(judge, gateway.rows, answers)
    lost += _travel(judge, "controller bus", left, controller, answers)
    services = {
        name: part.service
        for name, part in (("hlc", hlc), ("joints", joints), ("gateway", gateway))
        if part is not None
    }
    for name, service in services.items():
        lost += [f"{name}: {count} frames {what}" for what, count in service.losses.items() if count]
    return Timing(
        cycles,
        judge.late,
        judge.worst,
        lost,
        {name: one.lateness for name, one in services.items()},
        {} if gateway is None else dict(zip(("controller", "drive"), gateway.latency, strict=True)),
        sum(sum(service.losses.values()) for service in services.values()),
    )


def sync_index_of_zero(rows: Iterable[Transmission]) -> int:
    """Place of the SYNC at time 0 among the SYNCs of a trace; -1 when the controller never said so."""
    count = 0
    for row in rows:
        frame = row.frame
        if frame.flags == 0:
            if frame.can_id == ids.SYNC:
                count += 1
            elif frame.can_id == ids.HLC_STATUS and frame.data[:3] == bytes((ids.STATUS_MOTION, 0, 0)):
                return count - 1
    return -1


def _controller(judge: _Judge, rows: list[Transmission], commands: set[int]) -> None:
    """SYNC is due on the grid; everything the controller sends until it handles the next SYNC belongs to the cycle."""
    first = sync_index_of_zero(row for row in rows if row.sender >= 0)
    if first < 0:
        return
    own = [row for row in rows if row.sender >= 0 and row.frame.flags == 0 and row.frame.can_id in commands]
    cycle = -first - 1
    for row in own:
        if row.frame.can_id == ids.SYNC:
            cycle += 1
        judge.begin(row, cycle)
    syncs = judge.syncs(own, 0)
    for row in own:
        judge.judge(row, "controller sent", syncs)


def _drives(judge: _Judge, rows: list[Transmission], answers: set[int]) -> None:
    """The answers that follow a SYNC in the order of handling are those to it."""
    syncs = judge.syncs(rows, 0)
    sync: Transmission | None = None
    for row in rows:
        frame = row.frame
        if frame.flags:
            continue
        if row.sender < 0 and frame.can_id == ids.SYNC:
            sync = row
        elif row.sender >= 0 and frame.can_id in answers and sync is not None:
            judge.follow(row, sync)
            judge.judge(row, "joints sent", syncs)


def _gateway(judge: _Judge, rows: list[Transmission], wanted: set[int]) -> None:
    """From the arrival of a frame on one bus to the sending of the next one with its id on the other."""
    came: dict[int, Transmission] = {}
    passed: list[Transmission] = []
    for row in rows:
        frame = row.frame
        if frame.flags or frame.can_id not in wanted:
            continue
        if row.sender < 0:
            came[frame.can_id] = row
        else:
            arrival = came.pop(frame.can_id, None)
            if arrival is not None and arrival.bus != row.bus:
                judge.follow(row, arrival)
                passed.append(row)
    syncs = (judge.syncs(rows, CONTROLLER_BUS), judge.syncs(rows, DRIVE_BUS))
    for row in passed:
        judge.judge(row, "gateway passed", syncs[row.bus])


@dataclass(frozen=True, slots=True)
class _End:
    """One end of a hop: a process, its rows, and the index of the bus in them."""

    name: str
    rows: list[Transmission]
    bus: int


def _travel(judge: _Judge, bus: str, sender: _End | None, receiver: _End | None, wanted: set[int]) -> list[str]:
    """Follow every frame over a hop, id by id; returns what was lost, doubled or out of order."""
    if sender is None or receiver is None:
        return []
    sent, received = _by_id(sender, own=True), _by_id(receiver, own=False)
    problems: list[str] = []
    arrived: list[Transmission] = []
    for (can_id, flags), arrivals in received.items():
        departures = sent.get((can_id, flags))
        if departures is None or ids.SDO_REQUEST < can_id < ids.HEARTBEAT:
            continue
        first = _first_departure(departures, arrivals)
        if first < 0:
            problems.append(f"{can_id:03X} ({len(departures)} sent, {len(arrivals)} received)")
        elif flags == 0 and can_id in wanted:
            for departure, arrival in zip(departures[first:], arrivals, strict=False):
                judge.follow(arrival, departure)
            arrived += arrivals
    syncs = judge.syncs(receiver.rows, receiver.bus)
    for row in arrived:
        judge.judge(row, f"{bus} carried to {receiver.name}", syncs)
    if not problems:
        return []
    more = f" and {len(problems) - _MOST_IDS} more ids" if len(problems) > _MOST_IDS else ""
    which = ", ".join(problems[:_MOST_IDS]) + more
    return [f"{bus}: frames from {sender.name} to {receiver.name} were lost, doubled or out of order: {which}"]


def _first_departure(departures: list[Transmission], arrivals: list[Transmission]) -> int:
    """Place of the departure that the first arrival is, so that all that follow agree; -1 when there is none.

    Frames sent before the receiver listened, or after it had left, were never received and are not lost.
    """
    last = len(departures) - len(arrivals)
    latest = last
    while latest >= 0 and departures[latest].end_ns > arrivals[0].end_ns + STAMP_SLACK_NS:
        latest -= 1
    frames: list[Frame] = [row.frame for row in arrivals]
    for first in chain(range(latest, -1, -1), range(latest + 1, last + 1)):  # the likeliest first
        if all(departures[first + at].frame == frame for at, frame in enumerate(frames)):
            return first
    return -1


def _by_id(end: _End, *, own: bool) -> dict[tuple[int, int], list[Transmission]]:
    """Rows that a process sent itself (own) or received on one bus, by CAN id and flags, in their order."""
    found: dict[tuple[int, int], list[Transmission]] = {}
    for row in end.rows:
        if row.bus == end.bus and (row.sender >= 0) == own:
            found.setdefault((row.frame.can_id, row.frame.flags), []).append(row)
    return found
