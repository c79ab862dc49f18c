"""Which control cycle every frame of a real-time run belongs to, and what each cycle owes.

The controller owes SYNC and the six commands in each cycle of the motion, a drive the answer to each SYNC that it gets
while it is Operational. (From an EMCY of its own on, or a heartbeat that tells another state, a drive owes nothing
until it has answered again: it reacts to a fault.) What is asked for less often (TPDO2) is not missed.
"""

from typing import Final

from canopen_exo import plan as ids
from canopen_exo.bus.medium import Transmission
from canopen_exo.bus.node import NEVER
from canopen_exo.plan import BusPlan
from testbench.pairing import latest_before

_START: Final = 1
"""NMT command specifier "start remote node" (CiA 301, 7.2.8.3.1.1)."""

_OPERATIONAL: Final = b"\x05"
"""Heartbeat of a node that is Operational (CiA 301, 7.2.8.3.2.2)."""


class CycleJudge:
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
        is_ours = begun_ns == NEVER
        due_ns = self.zero_ns + (cycle + 1) * self.cycle_ns if is_ours else begun_ns + self.cycle_ns
        if is_ours and row.frame.can_id != ids.SYNC:
            due_ns = max(due_ns, syncs.get(cycle + 1, due_ns))
        self._note(cycle, row.end_ns - due_ns, f"{what} COB-ID {row.frame.can_id:03X}")

    def miss(self, cycle: int, what: str) -> None:
        """Something that this cycle owes was never sent: late by a whole cycle, there is no other measure of it."""
        self._note(cycle, self.cycle_ns, what)

    def _note(self, cycle: int, by_ns: int, what: str) -> None:
        if by_ns <= 0 or not 0 <= cycle < self.cycles:
            return
        if by_ns > max(self.late.values(), default=0):
            self.worst = f"cycle {cycle}, {what}"
        if by_ns > self.late.get(cycle, 0):
            self.late[cycle] = by_ns


def judge_controller(
    judge: CycleJudge, rows: list[Transmission], commands: set[int], owed: set[int], completed: bool
) -> None:
    """SYNC is due on the grid; a command is that of the newest SYNC before it that has none.

    owed: what every cycle has; completed: whether the last one was walked to its end.
    """
    own = [row for row in rows if row.sender >= 0 and row.frame.flags == 0 and row.frame.can_id in commands]
    places = _places(own)
    syncs = places.pop(ids.SYNC, [])
    first = _sync_of_zero(own, syncs, judge.zero_ns)
    cycles = {place: at - first for at, place in enumerate(syncs)}
    for place, cycle in cycles.items():
        judge.begin(own[place], cycle)
    sent: dict[int, set[int]] = {}
    for can_id, results in places.items():
        causes = latest_before(syncs, results)
        for place in results:
            judge.begin(own[place], cycles[causes[place]] if place in causes else -first - 1)
        sent[can_id] = {judge.cycle(own[place]) for place in results}
    due = judge.syncs(own, 0)
    for row in own:
        judge.judge(row, "controller sent", due)
    for cycle in range(judge.cycles if completed else judge.cycles - 1):
        if cycle not in due:
            judge.miss(cycle, "controller sent no SYNC")
            continue
        for can_id in sorted(owed):
            if cycle not in sent.get(can_id, ()):
                judge.miss(cycle, f"controller sent no COB-ID {can_id:03X}")


def _sync_of_zero(own: list[Transmission], syncs: list[int], zero_ns: int) -> int:
    """Which of the SYNCs is that of time 0: the status frame follows it; without one, the first that is not before."""
    for place, row in enumerate(own):
        frame = row.frame
        if frame.can_id == ids.HLC_STATUS and frame.data[:3] == bytes((ids.STATUS_MOTION, 0, 0)):
            return sum(sync < place for sync in syncs) - 1
    return sum(own[sync].end_ns < zero_ns for sync in syncs)


def judge_drives(judge: CycleJudge, rows: list[Transmission], answers: set[int], plan: BusPlan) -> None:
    """An answer is that to the newest SYNC before it that has none."""
    places = _places([row if _matters(row, answers) else None for row in rows])
    received = places.pop(ids.SYNC, [])
    missing = {can_id: set(owed) for can_id, owed in _owed(rows, plan).items()}
    syncs = judge.syncs(rows, 0)
    for can_id, results in places.items():
        causes = latest_before(received, results)
        for place in results:
            if place in causes:
                judge.follow(rows[place], rows[causes[place]])
                judge.judge(rows[place], "joints sent", syncs)
        missing.get(can_id, set()).difference_update(causes.values())
    for place, can_id in sorted((place, can_id) for can_id, places in missing.items() for place in places):
        judge.miss(judge.cycle(rows[place]), f"joints sent no COB-ID {can_id:03X}")


def _matters(row: Transmission, answers: set[int]) -> bool:
    frame = row.frame
    return frame.flags == 0 and (frame.can_id == ids.SYNC if row.sender < 0 else frame.can_id in answers)


def _owed(rows: list[Transmission], plan: BusPlan) -> dict[int, list[int]]:
    """COB-ID -> places of the SYNCs that it must answer."""
    bases = [pdo.base for pdo in plan.pdos if pdo.name[0] == "T" and pdo.every == 1]
    nodes = [joint.node_id for joint in plan.joints]
    found: dict[int, list[int]] = {base + node_id: [] for base in bases for node_id in nodes}
    answering: set[int] = set()
    operational: set[int] = set()
    for place, row in enumerate(rows):
        can_id, data = row.frame.can_id, row.frame.data
        if row.frame.flags:
            continue
        if row.sender >= 0:
            if can_id in found:
                answering.add(can_id)
            elif can_id - ids.EMCY in nodes or (can_id - ids.HEARTBEAT in nodes and data != _OPERATIONAL):
                answering -= {base + (can_id & 0x7F) for base in bases}
        elif can_id == ids.NMT and len(data) == 2:
            told = set(nodes if data[1] == 0 else data[1:])
            operational = operational | told if data[0] == _START else operational - told
            if data[0] != _START:
                answering -= {base + node_id for base in bases for node_id in told}
        elif can_id == ids.SYNC and len(data) == (plan.sync_counter > 0):
            for cob_id in answering:
                if cob_id & 0x7F in operational:
                    found[cob_id].append(place)
    return found


def _places(rows: "list[Transmission] | list[Transmission | None]") -> dict[int, list[int]]:
    """CAN id -> places of its rows."""
    found: dict[int, list[int]] = {}
    for place, row in enumerate(rows):
        if row is not None:
            found.setdefault(row.frame.can_id, []).append(place)
    return found
