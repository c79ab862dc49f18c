"""What one run came to: its outcome, who noticed the fault and when, how bad it was.

A reaction is what a drive or the high-level controller does about something it found wrong: an EMCY of a drive with an
error code, its CAN controller going bus-off (it drops its torque then, and can say so only later), or the controller
noticing an EMCY, a lost heartbeat, a drive that left Operational or Operation enabled, or an unexpected boot-up. What a
drive does because a falsified command told it to is not its own reaction; that the controller notices it is one.
Reactions count from the start of the first activation to the end of the motion that is judged.

failure_detected against failure_silent: a failure is detected when somebody had reacted at the latest in the instant in
which the first joint left its range. A reaction that comes after that prevents nothing, so it does not make a
failure a detected one; `detected_s` still holds it, and being after `failure_s` says that it came too late. So an early
stop, or its grace time, changes no outcome; how many late reactions are seen does hang on them.
"""

from bisect import bisect_left
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import degrees
from typing import Final

import numpy as np

from canopen_exo.bus.error_frame import read_error_frame
from canopen_exo.bus.frame import FLAG_ERROR
from canopen_exo.bus.medium import Transmission
from canopen_exo.bus.node import ErrorState
from canopen_exo.bus.realtime import RECEIVED
from canopen_exo.emcy import NO_ERROR, decode_emcy
from canopen_exo.plan import EMCY
from hlc.limits import JointLimits
from testbench.campaign.records import Outcome
from testbench.golden import check_joints, clip
from testbench.record import RunRecord, Truth
from testbench.rig import DRIVE_BUS
from testbench.verdict import Judgement

NOTICED: Final = frozenset({"emcy", "heartbeat_lost", "nmt_state", "reboot", "drive_stopped"})
"""Kinds of the controller's events that are a reaction; that all errors are gone is none."""

ERRORS_GONE: Final = "errors gone"
"""How the text of an EMCY event begins that reports no error."""


@dataclass(frozen=True, slots=True)
class Severity:
    """How far beyond its range of travel: by how much at most, for how long any joint was, and which was the worst.

    The range is the table's, whatever the scenario tolerates. 0, 0 and "" for a run in which no joint left it.
    """

    beyond_deg: float
    beyond_s: float
    joint: str


def outcome_of(judgement: Judgement, source: str, detected_s: float | None) -> Outcome:
    """The outcome of a judged run. source: of its truth (`RunRecord`); detected_s: first reaction, None for nobody.

    With foreign drives a failure stays a plain one: nobody there can say what they have noticed.
    """
    if judgement.outcome != Outcome.FAILURE.value:
        return Outcome(judgement.outcome)
    if source != "plant":
        return Outcome.FAILURE
    is_late = detected_s is None or detected_s > judgement.failures[0].time_s
    return Outcome.FAILURE_SILENT if is_late else Outcome.FAILURE_DETECTED


def first_reaction(record: RunRecord, after_s: float) -> float | None:
    """When a drive or the controller first reacted, at or after `after_s`, within the motion [s]; None for nobody."""
    found = [
        note.time_s
        for note in record.notes
        if note.kind in NOTICED and not note.text.startswith(ERRORS_GONE) and note.time_s >= after_s
    ]
    rows, drives = record.rows, record.truth.q.shape[1]
    first_row = bisect_left(rows, record.time0_ns + round(after_s * 1e9), key=lambda row: row.end_ns)
    for at in range(first_row, len(rows)):
        if rows[at].bus == DRIVE_BUS and _is_drives_reaction(rows[at], drives):
            found.append((rows[at].end_ns - record.time0_ns) / 1e9)
            break
    first = min(found, default=None)
    return first if first is not None and first <= record.duration_s else None


def _is_drives_reaction(row: Transmission, drives: int) -> bool:
    """An EMCY that a drive sent, or its bus-off. Port 0 of the drive bus is the gateway, whose forgeries are none.

    Against the clock the trace is the gateway's: what it has received on the drive bus is from the drives.
    """
    frame = row.frame
    if not (1 <= row.sender <= drives or row.sender == RECEIVED):
        return False
    if frame.flags == 0:
        if not EMCY < frame.can_id <= EMCY + 0x7F:
            return False
        emergency = decode_emcy(frame.can_id - EMCY, frame.data)
        return emergency is not None and emergency.code != NO_ERROR
    is_notice = frame.flags == FLAG_ERROR
    return is_notice and read_error_frame(frame.can_id, frame.data, None).state is ErrorState.BUS_OFF


def severity(
    joints: Sequence[str], limits: Mapping[str, JointLimits], truth: Truth, duration_s: float
) -> Severity:
    """How bad it was, over the motion [0, duration]."""
    names = tuple(joints)
    check_joints(names, truth.q)
    truth = clip(truth, duration_s)
    low = np.array([limits[name].min_angle_rad for name in names])
    high = np.array([limits[name].max_angle_rad for name in names])
    excess = np.maximum(truth.q - high, low - truth.q)
    worst = excess.max(axis=0)
    if worst.max() <= 0:
        return Severity(0.0, 0.0, "")
    span = float(truth.t_s[-1] - truth.t_s[0])
    step_s = span / (truth.t_s.size - 1) if truth.t_s.size > 1 else 0.0
    beyond = int(np.count_nonzero((excess > 0).any(axis=1)))
    return Severity(degrees(float(worst.max())), round(beyond * step_s, 9), names[int(np.argmax(worst))])


def phase_at(time_s: float | None, stride_s: float) -> float | None:
    """Phase of the gait at a time of the motion, 0..1 of a stride, 0 is right heel strike; None before time 0."""
    return None if time_s is None or time_s < 0 else time_s / stride_s % 1.0
