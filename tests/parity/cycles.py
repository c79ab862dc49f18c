"""The frames of a run by control cycle, so that runs on different buses compare."""

from collections import Counter
from typing import Final

from canopen_exo import plan as ids
from canopen_exo.bus.node import SECOND
from testbench.record import RunRecord
from testbench.scenario import JOINT_NAMES

SENDERS: Final = ("controller", *JOINT_NAMES)

_TPDO2_EVERY: Final = 10
"""SYNCs (the bus plan in docs and design)."""


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
                cycles[-1] += _not_asked(counter)
            counter = frame.data[0]
            cycles.append([])
        if cycles:
            cycles[-1].append(frame.can_id)
            if frame.can_id == ids.HLC_STATUS and frame.data[0] == ids.STATUS_MOTION and zero < 0:
                zero = len(cycles) - 1 - int.from_bytes(frame.data[1:3], "little")
    assert zero >= 0, "the controller's status frame never said that the motion is on"
    return cycles[zero:]


def _not_asked(counter: int) -> list[int]:
    """TPDO2 comes with every tenth SYNC, of drive n when the counter is n, n + 10 and so on."""
    return [ids.TPDO2 + node_id for node_id in range(1, 7) if (counter - node_id) % _TPDO2_EVERY]


def heartbeats(record: RunRecord, second: int) -> Counter[int]:
    """By COB-ID, in one second of the motion, on the drive bus."""
    start = record.time0_ns + second * SECOND
    rows = [row for row in record.rows if row.bus == 1 and start <= row.end_ns < start + SECOND]
    return Counter(row.frame.can_id for row in rows if row.frame.can_id & 0x780 == ids.HEARTBEAT)
