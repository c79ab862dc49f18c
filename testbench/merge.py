"""The parts of a real-time run put together: the same RunRecord as of a lock-step run.

Truth is the plant's (part of the joints), commands and events are the controller's; the trace of both buses,
activations and time 0 on the bus are the gateway's. Where one was foreign software, frames stand in for it, taken where
they come to the gateway, before any fault; without gateway, as the supervisor heard them:
joints: position and velocity of TPDO1 at the instant of their SYNC, straight lines between; torque of TPDO2, held.
controller: torques of RPDO1 as sent, so after whatever limit the controller has; its reference is not known. It gave
the motion up when it falls silent, or a drive that was enabled at time 0 says in TPDO2 that it no longer is.
"""

from collections.abc import Callable
from typing import Final

import numpy as np

from canopen_exo import plan as ids
from canopen_exo.bus.frame import FLAG_FD
from canopen_exo.bus.medium import Transmission
from canopen_exo.bus.node import MS, NEVER
from canopen_exo.cia402 import DriveState, decode_statusword
from canopen_exo.plan import BusPlan, Pdo
from canopen_exo.signal import Codec
from canopen_exo.sync import SyncCadence
from testbench.errors import BenchError
from testbench.parts import GatewayPart, HlcPart, JointsPart
from testbench.record import Array, BusStats, Commands, RigEvent, RunRecord, Truth
from testbench.timing import CONTROLLER_BUS, DRIVE_BUS

BUS_NAMES: Final = ("controller", "drive")

_MOST_REASONS: Final = 6

GIVEN_UP: Final = "given_up"
"""Kind of the event that ended the motion of a foreign controller."""

SILENT_CYCLES: Final = 10
"""A controller that sends no RPDO1 for longer has given up: the deadline that our own sets in the drives."""

PLANT: Final = "plant"
BUS: Final = "bus"


class IncompleteError(BenchError):
    """There is not enough to judge: the motion never began, or a drive was never heard."""


def merge(
    plan: BusPlan,
    duration_ns: int,
    hlc: HlcPart | None,
    gateway: GatewayPart | None,
    joints: JointsPart | None,
    heard: list[Transmission],
) -> RunRecord:
    """One run. None: that part of the rig was foreign. heard: by the supervisor, used without gateway.

    Raises IncompleteError.
    """
    rows = heard if gateway is None else gateway.rows
    zero = time_zero_of(plan, hlc, gateway, rows)
    on_bus = zero if gateway is None or gateway.time_zero == NEVER else gateway.time_zero
    rows = sorted(rows, key=lambda row: row.end_ns)  # sent and received frames of a bus as they were on it
    end = zero + duration_ns
    activations = [] if gateway is None else gateway.activations
    given_up = None if hlc is not None else _given_up(plan, rows, zero, end)
    truth = _truth_of(joints, zero, end) if joints is not None else _truth_from_frames(plan, rows, zero, end)
    return RunRecord(
        rows=rows,
        time0_ns=on_bus,
        duration_ns=duration_ns,
        truth=truth,
        commands=_commands_of(plan, hlc) if hlc is not None else _commands_from_frames(plan, rows, zero, end),
        activations=[one for one in activations if one.start_ns < on_bus + duration_ns],
        activations_after=[one for one in activations if one.start_ns >= on_bus + duration_ns],
        buses=tuple(_stats(plan, rows, index, zero, end) for index in (CONTROLLER_BUS, DRIVE_BUS)),
        notes=_notes(plan, zero, hlc, gateway, rows, given_up),
        completed=given_up is None if hlc is None else hlc.completed,
        held_cycles=[0] * len(plan.joints) if hlc is None else list(hlc.held),
        source=PLANT if joints is not None else BUS,
        invalid_reasons=_zeros_apart(plan, hlc, gateway) + _other_rate(plan, rows, zero, end),
    )


def _zeros_apart(plan: BusPlan, hlc: HlcPart | None, gateway: GatewayPart | None) -> list[str]:
    """Faults count from the gateway's time 0, truth and commands from the controller's: why they are not the same."""
    if hlc is None or gateway is None:
        return []
    if gateway.time_zero == NEVER:
        return ["the gateway never learned time 0: no status frame of the controller (COB-ID 0x2FF) came to it"]
    apart_ns = gateway.time_zero - hlc.time_zero
    if abs(apart_ns) < plan.cycle_ns:
        return []
    which = "late" if apart_ns > 0 else "early"
    return [
        f"the gateway's time 0, from which faults count, is {abs(apart_ns) / 1e6:.1f} ms {which} of the controller's, "
        f"allowed is less than a cycle ({plan.cycle_ns / 1e6:g} ms): it missed a SYNC or a status frame, or somebody "
        "said `exo-hil fault start` although the controller tells time 0"
    ]


def _other_rate(plan: BusPlan, rows: list[Transmission], zero: int, end: int) -> list[str]:
    """Cycles are judged and counted by the plan: why they are not those of the controller."""
    cadence = SyncCadence(plan.cycle_ns)
    for row in rows:
        is_sync = row.frame.can_id == ids.SYNC and row.frame.flags == 0
        if is_sync and row.bus == CONTROLLER_BUS and row.sender < 0 and zero <= row.end_ns <= end:
            cadence.received(row.end_ns)
    return [text for text in (cadence.words(),) if text]


def time_zero_of(plan: BusPlan, hlc: HlcPart | None, gateway: GatewayPart | None, heard: list[Transmission]) -> int:
    """Time 0 [ns]: the controller's own; of a foreign one the gateway's or the bus's, on the 1 ms grid of the plant."""
    if hlc is not None:
        if hlc.time_zero == NEVER or hlc.cycles.size == 0:
            telling = [event for event in hlc.events if event.kind != "emcy"] or hlc.events
            reasons = "; ".join(f"{one.joint + ': ' if one.joint else ''}{one.text}" for one in telling[:_MOST_REASONS])
            raise IncompleteError(f"the motion never began: {reasons or 'the controller gives no reason'}")
        return hlc.time_zero
    zero = gateway.time_zero if gateway is not None else _zero_on_bus(plan, heard)
    if zero == NEVER:
        raise IncompleteError(
            "the motion never began: no status frame of the controller (COB-ID 0x2FF, state 2) was on the bus, and "
            "nobody said `exo-hil fault start`"
        )
    return (zero + MS // 2) // MS * MS


def add_reasons(record: RunRecord, reasons: list[str], golden: bool) -> None:
    """Enter why the run proves nothing."""
    record.invalid_reasons.extend(reasons)
    if golden and not record.completed:
        ends = [note for note in record.notes if note.kind == GIVEN_UP]
        why = f": {ends[0].node} at {ends[0].time_s:.3f} s: {ends[0].text}" if ends else ""
        record.invalid_reasons.append(f"the motion was given up without a fault{why}")


def _zero_on_bus(plan: BusPlan, rows: list[Transmission]) -> int:
    sync = NEVER
    for row in rows:
        if row.bus == CONTROLLER_BUS and row.frame.flags == 0:
            if row.frame.can_id == ids.SYNC:
                sync = row.end_ns
            elif row.frame.can_id == ids.HLC_STATUS and row.frame.data[:1] == bytes((ids.STATUS_MOTION,)):
                return sync - int.from_bytes(row.frame.data[1:3], "little") * plan.cycle_ns
    return NEVER


def _truth_of(joints: JointsPart, zero: int, end: int) -> Truth:
    """The plant's own rows, on its 1 kHz grid."""
    wanted = (joints.times_ns >= zero) & (joints.times_ns <= end)
    times = joints.times_ns[wanted]
    if times.size != (end - zero) // MS + 1:
        raise IncompleteError(
            f"joints: {times.size} steps of the plant in the motion, expected {(end - zero) // MS + 1}: "
            "they ended before the motion did"
        )
    return Truth((times - zero) / 1e9, joints.q[wanted], joints.dq[wanted], joints.tau[wanted])


def _commands_of(plan: BusPlan, hlc: HlcPart) -> Commands:
    return Commands(hlc.cycles * plan.cycle_ns / 1e9, hlc.q_d, hlc.dq_d, hlc.tau_command)


# --- frames instead of a part ----------------------------------------------------------------------------------------


def _truth_from_frames(plan: BusPlan, rows: list[Transmission], zero: int, end: int) -> Truth:
    """What the drives said of themselves, brought to the 1 ms grid from time 0."""
    grid = np.arange(zero, end + 1, MS, dtype=np.int64)
    shape = (grid.size, len(plan.joints))
    q, dq, tau = np.zeros(shape), np.zeros(shape), np.zeros(shape)
    samples, status = plan.pdo("TPDO1"), plan.pdo("TPDO2")
    position, velocity, torque = samples.place("position"), samples.place("velocity"), status.place("torque")
    for k, joint in enumerate(plan.joints):
        times, values = _process_data(rows, DRIVE_BUS, ids.TPDO1 + joint.node_id, samples)
        if times.size == 0:
            cob_id = f"{ids.TPDO1 + joint.node_id:03X}"
            raise IncompleteError(f"joints: {joint.name} sent no TPDO1 ({cob_id}) on the drive bus")
        angle = plan.scale(joint, "rad")
        q[:, k] = np.interp(grid, times, values[:, position] * angle)
        dq[:, k] = np.interp(grid, times, values[:, velocity] * angle)
        times, values = _process_data(rows, DRIVE_BUS, ids.TPDO2 + joint.node_id, status)
        latest = np.searchsorted(times, grid, side="right") - 1
        known = latest >= 0
        tau[known, k] = values[latest[known], torque] * plan.scale(joint, "N m")
    return Truth((grid - zero) / 1e9, q, dq, tau)


def _commands_from_frames(plan: BusPlan, rows: list[Transmission], zero: int, end: int) -> Commands:
    """The torques that were asked for, held to the cycle of the plan."""
    grid = np.arange(zero, end, plan.cycle_ns, dtype=np.int64)
    tau = np.zeros((grid.size, len(plan.joints)))
    pdo = plan.pdo("RPDO1")
    torque = pdo.place("target_torque")
    for k, joint in enumerate(plan.joints):
        times, values = _process_data(rows, CONTROLLER_BUS, ids.RPDO1 + joint.node_id, pdo)
        latest = np.searchsorted(times, grid + plan.cycle_ns, side="right") - 1  # sent within the cycle
        known = latest >= 0
        tau[known, k] = values[latest[known], torque] * plan.scale(joint, "N m")
    nothing = np.zeros((grid.size, 0))
    return Commands((grid - zero) / 1e9, nothing, nothing, tau)


def _given_up(plan: BusPlan, rows: list[Transmission], zero: int, end: int) -> RigEvent | None:
    """What first ended the motion of a foreign controller, by its frames and those of the drives; None: nothing did."""
    pdo = plan.pdo("TPDO2")
    codec, statusword = pdo.codec(), pdo.place("statusword")
    drives = {ids.TPDO2 + joint.node_id: joint.name for joint in plan.joints}
    commands = {ids.RPDO1 + joint.node_id for joint in plan.joints}
    silence_ns = SILENT_CYCLES * plan.cycle_ns
    enabled: set[int] = set()
    commanded = NEVER
    for row in rows:
        frame, now = row.frame, row.end_ns
        if now > end:
            break
        if commanded < NEVER and now > zero and now - commanded > silence_ns:
            return _silence(commanded - zero)
        if row.bus == CONTROLLER_BUS and frame.can_id in commands and frame.flags == 0:
            commanded = now
        elif row.bus == DRIVE_BUS and row.sender < 0 and frame.can_id in drives and len(frame.data) >= codec.size:
            state = decode_statusword(codec.unpack(frame.data)[statusword])
            if state is DriveState.OPERATION_ENABLED:
                enabled.add(frame.can_id)
            elif frame.can_id in enabled and now > zero and state is not None:
                text = f"left Operation enabled, now {state.name.replace('_', ' ').lower()}"
                return RigEvent((now - zero) / 1e9, drives[frame.can_id], GIVEN_UP, text)
            else:
                enabled.discard(frame.can_id)
    return _silence(commanded - zero) if commanded < NEVER and end - commanded > silence_ns else None


def _silence(since_ns: int) -> RigEvent:
    return RigEvent(since_ns / 1e9, "HLC", GIVEN_UP, f"no command for more than {SILENT_CYCLES} cycles after this one")


def _process_data(rows: list[Transmission], bus: int, cob_id: int, pdo: Pdo) -> tuple[Array, Array]:
    """(n,) ns: when the SYNC before each frame came; (n, values) raw. Frames received on that bus."""
    codec: Codec = pdo.codec()
    sync = -NEVER
    times: list[int] = []
    values: list[list[int]] = []
    for row in rows:
        frame = row.frame
        if row.bus != bus or frame.flags:
            continue
        if frame.can_id == ids.SYNC:
            sync = row.end_ns
        elif frame.can_id == cob_id and row.sender < 0 and len(frame.data) >= codec.size:
            at = sync if sync > -NEVER else row.end_ns
            if times and at <= times[-1]:  # a second one in the cycle: its own time
                at = max(row.end_ns, times[-1] + 1)
            times.append(at)
            values.append(list(codec.unpack(frame.data)))
    return np.array(times, np.float64), np.array(values, np.float64).reshape(-1, len(pdo.content))


# --- what is said about the buses ------------------------------------------------------------------------------------


def _stats(plan: BusPlan, rows: list[Transmission], index: int, zero: int, end: int) -> BusStats:
    """Frames within the motion, and the share of it that they last at the plan's bit rate (CAN FD not counted)."""
    frames, bits = 0, 0
    for row in rows:
        if row.bus == index and zero < row.end_ns <= end:
            frames += 1
            if not row.frame.flags & FLAG_FD:
                bits += row.frame.bits or row.frame.measure()
    return BusStats(BUS_NAMES[index], frames, bits * 1e9 / plan.bitrate / (end - zero))


def _notes(
    plan: BusPlan,
    zero: int,
    hlc: HlcPart | None,
    gateway: GatewayPart | None,
    rows: list[Transmission],
    given_up: RigEvent | None,
) -> list[RigEvent]:
    """Events from time 0, in order; without our controller the EMCYs of the drives, and what ended the motion."""
    notes: list[RigEvent] = []
    after: Callable[[int], float] = lambda time_ns: (time_ns - zero) / 1e9  # noqa: E731
    if hlc is not None:
        notes += [RigEvent(after(one.time_ns), one.joint or "HLC", one.kind, one.text) for one in hlc.events]
    else:
        names = {ids.EMCY + joint.node_id: joint.name for joint in plan.joints}
        for row in rows:
            frame = row.frame
            if row.bus == DRIVE_BUS and row.sender < 0 and frame.flags == 0 and frame.can_id in names:
                code = int.from_bytes(frame.data[:2], "little")
                text = f"error {code:04X}" if code else "errors gone"
                notes.append(RigEvent(after(row.end_ns), names[frame.can_id], "emcy", text))
    if given_up is not None:
        notes.append(given_up)
    if gateway is not None:
        for control in gateway.controls:
            refused = f": {control.refused}" if control.refused else ""
            text = f"{control.what} {control.name}".strip() + f", by {control.source}{refused}"
            notes.append(RigEvent(after(control.time_ns), "gateway", "control", text))
    return sorted(notes, key=lambda note: note.time_s)
