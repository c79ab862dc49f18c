"""Whether a real-time run was on time: which control cycles were late and by how much, and whether a frame was lost.

A cycle is late when the drives' answers or the controller's commands miss the next SYNC. Each process records the
frames it received (time of arrival) and sent (time of sending), in the order of handling, on one clock. The way of a
cycle through the rig is cut into steps: a process handles a frame, or a frame travels from one process to the next. A
step that begins in a cycle and ends when the next SYNC was due, and already there, makes the cycle late by the
difference. A SYNC itself makes its cycle late when it is on its way later than the next one was due. An answer or a
command that its process never sent makes the cycle late by a whole one.
Where a frame was sent and did not arrive, or came to the gateway and did not leave it, it is lost: in the motion, and
before it from when the receiver listened. The record of each process is compared with that of the next one.
Steps between our own processes only: what foreign software does in between is not judged, and `Timing.unjudged` says
so; for a foreign gateway the supervisor's ears on both buses are one end of each hop. Foreign software has its own
clock, too: what begins with one of its frames is late when it is not at its end one cycle after that frame came.
A fault on the wire is neither lateness nor loss, whatever it drops, changes, delays or adds: steps are followed within
one hop, and a fault acts between two of them. In the gateway, frames of the node that a fault is at meanwhile are
followed only where they leave it at once, and none of them is lost.
Leaves out: whatever is not synchronous (SYNC, PDOs, the controller's status) when it comes to lateness; loss is looked
for among all ids but those of SDO requests, which more than one node may send.
"""

from dataclasses import dataclass, field
from typing import Final

from canopen_exo import plan as ids
from canopen_exo.bus.lateness import Lateness
from canopen_exo.bus.medium import Transmission
from canopen_exo.bus.node import MS, NEVER
from canopen_exo.plan import BusPlan
from testbench.cycles import CycleJudge, judge_controller, judge_drives
from testbench.pairing import Key, Pairing, Place, count, differences, pair, travel
from testbench.parts import GatewayPart, HlcPart, JointsPart, Service
from testbench.passing import pass_through

CONTROLLER_BUS: Final = 0
DRIVE_BUS: Final = 1

STAMP_SLACK_NS: Final = MS
"""A stamp of arrival rarely lies this much before that of sending, which is taken when the frame is on its way
(assumed); at most a quarter of the cycle. Only where equal frames follow each other does it decide which is which."""


@dataclass(frozen=True, slots=True)
class TimingLimits:
    """late_share: of all cycles, 0..1; late_worst_ns: of any one cycle. Beyond either a run is invalid."""

    late_share: float
    late_worst_ns: int


@dataclass(frozen=True, slots=True)
class Timing:
    """cycles: of the motion that were judged; late: cycle -> by how much [ns]; worst: where the latest was, in words.

    lost: what was lost where, in words; found: frames lost, doubled or out of order by the records of two processes;
    counted: frames that a queue, the kernel or the hub says it dropped; lateness: of the wake-ups, by process;
    latency: that the gateway added, by the bus it sent on; unjudged: what was not looked at, in words.
    """

    cycles: int
    late: dict[int, int]
    worst: str
    lost: list[str]
    lateness: dict[str, Lateness]
    latency: dict[str, Lateness] = field(default_factory=dict)
    counted: int = 0
    found: int = 0
    unjudged: list[str] = field(default_factory=list)

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


def judge_timing(
    plan: BusPlan,
    zero_ns: int,
    cycles: int,
    hlc: HlcPart | None,
    gateway: GatewayPart | None,
    joints: JointsPart | None,
    heard: list[Transmission] | None = None,
    *,
    missed: int = 0,
    golden: bool = False,
) -> Timing:
    """Judge `cycles` cycles from time 0 [ns, loop clock]. None: that part of the rig was foreign software.

    heard: by the supervisor on both buses, used without gateway; missed: frames that it did not hear; golden: in this
    run not even a foreign gateway has reason to lose a frame.
    """
    judge = CycleJudge(zero_ns, plan.cycle_ns, cycles)
    parts = {"hlc": hlc, "joints": joints, "gateway": gateway}
    services = {name: part.service for name, part in parts.items() if part is not None}
    lost, found = _Rig(judge, plan, hlc, gateway, joints, heard or [], golden).follow()
    for name, service in services.items():
        lost += [f"{name}: {count} frames {what}" for what, count in service.losses.items() if count]
    uses_heard = gateway is None
    if uses_heard and missed:
        lost.append(f"supervisor: {missed} frames of both buses not heard, and nobody else heard them all")
    return Timing(
        cycles,
        judge.late,
        judge.worst,
        lost,
        {name: one.lateness for name, one in services.items()},
        {} if gateway is None else dict(zip(("controller", "drive"), gateway.latency, strict=True)),
        sum(sum(service.losses.values()) for service in services.values()) + (missed if uses_heard else 0),
        found,
        _unjudged(hlc, gateway, joints, golden),
    )


def _unjudged(hlc: HlcPart | None, gateway: GatewayPart | None, joints: JointsPart | None, golden: bool) -> list[str]:
    """What nobody looked at because it is foreign."""
    if hlc is None and gateway is None and joints is None:
        return ["everything: no part of the rig is ours, so neither lateness nor loss between its parts was judged"]
    words = "foreign: what it owes in a cycle, how late that is, and what is lost on the way"
    found = [f"{name}: {words}" for name, part in (("hlc", hlc), ("joints", joints)) if part is None]
    if gateway is None:
        which = "delays and adds" if golden else "loses, delays and adds"
        found.append(f"gateway: foreign: what it {which}")
    return found


class _Rig:
    """Follows the frames of a run from the controller to the drives and back. Without gateway `heard` stands in."""

    def __init__(
        self,
        judge: CycleJudge,
        plan: BusPlan,
        hlc: HlcPart | None,
        gateway: GatewayPart | None,
        joints: JointsPart | None,
        heard: list[Transmission],
        golden: bool,
    ) -> None:
        self.judge: Final = judge
        self.plan: Final = plan
        self.hlc: Final = hlc
        self.gateway: Final = gateway
        self.joints: Final = joints
        self.golden: Final = golden
        self.until_ns: Final = judge.zero_ns + judge.cycles * judge.cycle_ns
        self.slack_ns: Final = min(STAMP_SLACK_NS, plan.cycle_ns // 4)
        self.lost: Final[list[str]] = []
        self.found: int = 0
        self.controller: Final = None if hlc is None else _place("controller", hlc.rows, 0, hlc.service)
        self.drives: Final = None if joints is None else _place("joints", joints.rows, 0, joints.service)
        name = "gateway" if gateway is not None else "supervisor"
        rows, service = (gateway.rows, gateway.service) if gateway is not None else (heard, None)
        self.left: Final = _place(name, rows, CONTROLLER_BUS, service)
        self.right: Final = _place(name, rows, DRIVE_BUS, service)

    def follow(self) -> tuple[list[str], int]:
        """Judge every step in the order of the way; returns what was lost in words, and how many frames."""
        pdos = [(pdo, pdo.base + joint.node_id) for pdo in self.plan.pdos for joint in self.plan.joints]
        commands = {ids.SYNC, ids.HLC_STATUS, *(cob_id for pdo, cob_id in pdos if pdo.name[0] == "R")}
        answers = {cob_id for pdo, cob_id in pdos if pdo.name[0] == "T"}
        passed = self._pass()
        if self.hlc is not None:
            owed = {cob_id for pdo, cob_id in pdos if pdo.name[0] == "R" and pdo.every == 1}
            judge_controller(self.judge, self.hlc.rows, commands, owed, self.hlc.completed)
        self._travel("controller bus", self.controller, self.left, commands)
        self._steps(passed, CONTROLLER_BUS, commands)
        self._travel("drive bus", self.right, self.drives, commands)
        if self.joints is not None:
            judge_drives(self.judge, self.joints.rows, answers, self.plan)
        self._travel("drive bus", self.drives, self.right, answers)
        self._steps(passed, DRIVE_BUS, answers)
        self._travel("controller bus", self.left, self.controller, answers)
        if self.gateway is None and self.golden:
            self._foreign_gateway(commands, answers)
        return self.lost, self.found

    def _travel(self, bus: str, sender: Place | None, receiver: Place | None, wanted: set[int]) -> None:
        """Follow every frame over a hop, id by id."""
        if sender is None or receiver is None:
            return
        sent = sender.by_id(own=True)
        if sender.name == "supervisor":  # what others put on the bus, as it heard them
            own = receiver.by_id(own=True)
            sent = {key: rows for key, rows in sender.by_id(own=False).items() if key not in own}
        found = travel(sent, receiver, self.until_ns, self.plan.cycle_ns, self.slack_ns)
        pairs = [both for (can_id, flags), one in found.items() if can_id in wanted and not flags for both in one.pairs]
        self._go_on(pairs, f"{bus} carried to {receiver.name}", receiver)
        self._tell(f"{bus}, frames from {sender.name} to {receiver.name}", found)

    def _pass(self) -> dict[tuple[int, Key], Pairing]:
        """What our gateway did with what came to it."""
        if self.gateway is None:
            return {}
        passed = pass_through(self.gateway, self.plan, self.until_ns, self.slack_ns)
        for bus, where in ((CONTROLLER_BUS, "to the drives"), (DRIVE_BUS, "to the controller")):
            found = {key: one for (came_on, key), one in passed.items() if came_on == bus}
            self._tell(f"gateway, frames {where} that no fault was at", found)
        return passed

    def _steps(self, passed: dict[tuple[int, Key], Pairing], bus: int, wanted: set[int]) -> None:
        """The gateway's own part of the way, of what came in on that bus."""
        pairs: list[tuple[Transmission, Transmission]] = []
        for (came_on, (can_id, flags)), one in passed.items():
            if came_on == bus and can_id in wanted and not flags:
                pairs += one.pairs
        self._go_on(pairs, "gateway passed", self.right if bus == CONTROLLER_BUS else self.left)

    def _go_on(self, pairs: list[tuple[Transmission, Transmission]], what: str, place: Place) -> None:
        for before, row in pairs:
            self.judge.follow(row, before)
        syncs = self.judge.syncs(place.rows, place.bus)
        for _, row in pairs:
            self.judge.judge(row, what, syncs)

    def _foreign_gateway(self, commands: set[int], answers: set[int]) -> None:
        """Where there is no fault, what goes in on one side comes out on the other."""
        left, right = self.left.by_id(own=False), self.right.by_id(own=False)
        for where, source, came, went, usual in (
            ("to the drives", self.controller, left, right, commands),
            ("to the controller", self.drives, right, left, answers),
        ):
            keys = source.by_id(own=True).keys() if source is not None else {(can_id, 0) for can_id in usual}
            found = {key: pair(came[key], went.get(key, []), self.slack_ns) for key in keys if key in came}
            for one in found.values():
                one.missing = [row for row in one.missing if self.judge.zero_ns <= row.end_ns < self.until_ns]
                one.extra = []
            self._tell(f"foreign gateway, frames {where}", found)

    def _tell(self, where: str, found: dict[Key, Pairing]) -> None:
        text = differences(found)
        if text:
            self.lost.append(f"{where}: {text}")
            self.found += count(found.values())


def _place(name: str, rows: list[Transmission], bus: int, service: Service | None) -> Place:
    """None: it listened all the time."""
    start, end = (service.start_ns, service.end_ns) if service is not None else (-NEVER, NEVER)
    return Place(name, rows, bus, start, end)
