"""Truth of a walk against the clock beside that of lock-step, where the same commands acted at the same time.

A command that was computed from an old sample, or that acted late, moves the plant: in lock-step at 50 Hz one cycle of
held samples moves it by up to 0.012 rad, three in succession by up to 0.08 rad. Such a run is on time all the same, as
long as the commands come before the next SYNC. What is left of it decays: a third is left after about 0.18 s. Therefore
only instants are compared that had no disturbed cycle in the SETTLE_NS before them.
"""

from typing import Final

import numpy as np
from numpy.typing import NDArray

from canopen_exo import plan as ids
from canopen_exo.bus.medium import Transmission
from canopen_exo.bus.node import MS
from hlc.node import DEADLINE_SHARE
from testbench.record import RunRecord
from testbench.scenario import JOINT_NAMES

SETTLE_NS: Final = 500 * MS
"""After it less than a twentieth of a disturbance is left."""

ANSWER_SHARE: Final = 0.25
"""Of the cycle: drives that have answered by then took SYNC, and the torques that act with it, hardly late."""

BOUND_RAD: Final = 0.03
"""Two to three disturbances of one cycle's length, none of which the trace shows."""

NEEDED_SHARE: Final = 0.1
"""Of the instants: with fewer to compare nothing is learned from a walk."""

_JOINTS: Final = frozenset(range(1, len(JOINT_NAMES) + 1))


def disturbed(record: RunRecord, cycle_ns: int) -> list[int]:
    """When the cycles began [ns from time 0] in which not the same samples made the same torques act in time.

    From SETTLE_NS before time 0 to the end of the motion; by the trace of both buses.
    """
    first = -(-SETTLE_NS // cycle_ns)
    count = round(record.truth.t_s[-1] * 1e9) // cycle_ns
    cycles: list[list[Transmission]] = [[] for _ in range(first + count + 1)]
    for row in record.rows:
        at = (row.end_ns - record.time0_ns) // cycle_ns + first
        if 0 <= at < len(cycles) and row.frame.flags == 0:
            cycles[at].append(row)
    return [
        number * cycle_ns
        for number, rows in enumerate(cycles[:-1], -first)
        if not _is_punctual(rows, record.time0_ns + number * cycle_ns, cycle_ns)
    ]


def _is_punctual(rows: list[Transmission], due_ns: int, cycle_ns: int) -> bool:
    """Whether all drives answered soon, and the controller had all answers when it computed, before its deadline."""
    answered: list[set[int]] = [set(), set()]
    commanded: list[set[int]] = [set(), set()]
    for row in rows:
        base, node_id, after_ns = row.frame.can_id & 0x780, row.frame.can_id & 0x7F, row.end_ns - due_ns
        if node_id not in _JOINTS:
            continue
        if base == ids.TPDO1:
            if row.bus == 1 and after_ns > ANSWER_SHARE * cycle_ns:
                return False
            answered[row.bus].add(node_id)
        elif base == ids.RPDO1:
            if row.bus == 0 and (answered[0] != _JOINTS or after_ns >= DEADLINE_SHARE * cycle_ns):
                return False
            commanded[row.bus].add(node_id)
    return all(found == _JOINTS for found in (*answered, *commanded))


def comparable(record: RunRecord, cycle_ns: int) -> NDArray[np.bool_]:
    """Which instants of truth compare with lock-step: (n,), with no disturbed cycle in the SETTLE_NS before them."""
    times = np.rint(record.truth.t_s * 1e9)
    found = np.ones(times.shape, np.bool_)
    for begun in disturbed(record, cycle_ns):
        found &= (times < begun) | (times >= begun + SETTLE_NS)
    return found


def difference(found: RunRecord, wanted: RunRecord, where: NDArray[np.bool_]) -> str:
    """The largest difference beyond BOUND_RAD at these instants, in words; "" when there is none."""
    off = np.where(where[:, None], abs(found.truth.q - wanted.truth.q), 0.0)
    at, joint = np.unravel_index(int(off.argmax()), off.shape)
    if off[at, joint] < BOUND_RAD:
        return ""
    return (
        f"{JOINT_NAMES[joint]} off by {off[at, joint]:.4f} rad at {found.truth.t_s[at]:.3f} s: "
        f"{found.truth.q[at, joint]:.4f} rad against the clock, {wanted.truth.q[at, joint]:.4f} rad in lock-step, "
        f"allowed {BOUND_RAD} rad, with no disturbed cycle in the {SETTLE_NS / 1e9:g} s before"
    )
