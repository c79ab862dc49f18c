"""The high-level controller on the bus: enables the drives, walks, and leaves them disabled.

Everything CANopen is the Master's; this is its application. In each cycle the answers of all drives (TPDO1) make the
torques of the next one; when one does not come before the deadline, its last value is used again and counted.
Time 0 is the SYNC at which the fade-in of the gait is complete; the HLC status frame tells it to the bus.
A drive that leaves Operation enabled, whose heartbeat stops or tells another NMT state than Operational, or whose EMCY
says that it drops its torque, ends the motion: all drives are disabled.
"""

import struct
from collections.abc import Callable
from enum import Enum
from math import floor
from typing import Final, final

from canopen_exo import plan as ids
from canopen_exo.bus.frame import Frame
from canopen_exo.bus.node import MS, NEVER, Out
from canopen_exo.cia402 import DriveState, decode_statusword, enabling_controlword
from canopen_exo.emcy import (
    BUS_OFF_LEFT,
    ERROR_PASSIVE,
    HEARTBEAT_LOST,
    NO_ERROR,
    OVERRUN,
    RPDO_TIMEOUT,
    SYNC_LOST,
    Emergency,
)
from canopen_exo.master import MasterApplication
from canopen_exo.plan import BusPlan, Pdo
from canopen_exo.signal import Codec
from hlc.controller import Controller

ENABLE_TIMEOUT_NS: Final = 2000 * MS
"""How long the drives may take to Operation enabled."""

DISABLE_TIMEOUT_NS: Final = 200 * MS
"""How long the drives may take at least to report that they are disabled; TPDO2 comes with every 10th SYNC."""
DISABLE_TIMEOUT_CYCLES: Final = 25

STOPPING_ERRORS: Final = (HEARTBEAT_LOST, RPDO_TIMEOUT, SYNC_LOST, BUS_OFF_LEFT, ERROR_PASSIVE, OVERRUN)
"""EMCY codes with which a drive drops its torque (its 0x6007 = 2). The statusword says so too, but needs SYNC."""

COMMANDS_KEPT: Final = 4096
"""Different torque commands of a drive that are remembered as frames."""

DEADLINE_SHARE: Final = 0.6
"""Torques are computed at the latest this share of the cycle after SYNC."""

_STATUS: Final = struct.Struct("<BHH")

_ENABLED: Final = (DriveState.SWITCHED_ON, DriveState.OPERATION_ENABLED, DriveState.QUICK_STOP_ACTIVE)


class Phase(Enum):
    """What the controller is doing."""

    WAITING = "waiting for the drives"
    ENABLING = "enabling"
    STARTING = "fading in"
    MOTION = "motion"
    STOPPING = "stopping"
    STOPPED = "stopped"
    FAILED = "failed"


# an enumeration is looked up slowly: what every cycle compares with has a name of its own
_WAITING: Final = Phase.WAITING
_ENABLING: Final = Phase.ENABLING
_STARTING: Final = Phase.STARTING
_MOTION: Final = Phase.MOTION
_STOPPING: Final = Phase.STOPPING
_STOPPED: Final = Phase.STOPPED
_FAILED: Final = Phase.FAILED
_OPERATION_ENABLED: Final = DriveState.OPERATION_ENABLED


@final
class Event:
    """Something the controller noticed. time_ns: loop clock; joint: name, "" for all; kind: one of the texts below."""

    __slots__ = ("joint", "kind", "text", "time_ns")

    def __init__(self, time_ns: int, joint: str, kind: str, text: str) -> None:
        self.time_ns: Final[int] = time_ns
        self.joint: Final[str] = joint
        self.kind: Final[str] = kind
        self.text: Final[str] = text


@final
class Sample:
    """What was wanted in a cycle of the motion: lists of n_joints; q_d rad, dq_d rad/s, tau_command N m (no clamp)."""

    __slots__ = ("cycle", "dq_d", "q_d", "tau_command")

    def __init__(self, cycle: int, q_d: list[float], dq_d: list[float], tau_command: list[float]) -> None:
        self.cycle: Final[int] = cycle
        self.q_d: Final[list[float]] = q_d
        self.dq_d: Final[list[float]] = dq_d
        self.tau_command: Final[list[float]] = tau_command


@final
class CommandFrames:
    """The RPDOs of a drive in Operation enabled: as torques recur, so do frames, which are made and measured once."""

    def __init__(self, cob_id: int, pdo: Pdo) -> None:
        self.cob_id: Final[int] = cob_id
        self.pdo: Final[Pdo] = pdo
        self._encode: Final[Callable[..., bytes]] = pdo.codec().encode
        self._values: Final[list[int]] = [0] * len(pdo.content)
        self._values[pdo.place("controlword")] = 0x0F
        self._torque_at: Final[int] = pdo.place("target_torque")
        self.known: Final[dict[int, Frame]] = {}

    def frame(self, torque: int) -> Frame:
        """The RPDO that asks for a torque [per mille of rated], not `known` yet."""
        if len(self.known) >= COMMANDS_KEPT:
            self.known.clear()
        self._values[self._torque_at] = torque
        frame = self.known[torque] = Frame(self.cob_id, self._encode(*self._values))
        return frame

    def __deepcopy__(self, memo: dict[int, object]) -> "CommandFrames":
        """Itself: what it remembers does not change what it answers."""
        return self


@final
class HighLevelController(MasterApplication):
    """Walks for a number of cycles. phase: what it is doing; time_zero: loop time of time 0 [ns], NEVER until known.

    events: what it noticed; samples: one per cycle of the motion; late: per joint, cycles of the motion whose values
    did not come before the deadline; completed: True when the whole motion was walked.
    leave: set from outside to end the motion with the next SYNC, whatever is left of it.
    """

    def __init__(self, plan: BusPlan, controller: Controller, motion_cycles: int) -> None:
        super().__init__()
        count = len(plan.joints)
        self.plan: Final[BusPlan] = plan
        self.controller: Final[Controller] = controller
        self.motion_cycles: Final[int] = motion_cycles
        self.phase: Phase = _WAITING
        self.time_zero: int = NEVER
        self.completed: bool = False
        self.leave: bool = False
        self.events: list[Event] = []
        self.samples: list[Sample] = []
        self.late: list[int] = [0] * count
        self.states: list[DriveState | None] = [None] * count
        self._names: Final[list[str]] = [joint.name for joint in plan.joints]
        self._angle: Final[list[float]] = [plan.scale(joint, "rad") for joint in plan.joints]
        self._torque: Final[list[float]] = [plan.scale(joint, "N m") for joint in plan.joints]
        tpdo1, tpdo2, rpdo1 = plan.pdo("TPDO1"), plan.pdo("TPDO2"), plan.pdo("RPDO1")
        self._rpdo: Final[list[int]] = [rpdo1.base + joint.node_id for joint in plan.joints]
        samples = tpdo1.codec()
        self._samples_size: Final[int] = samples.size
        self._unpack_samples: Final[Callable[[bytes], tuple[int, ...]]] = samples.unpack
        self._position_at: Final[int] = tpdo1.place("position")
        self._velocity_at: Final[int] = tpdo1.place("velocity")
        self._status_codec: Final[Codec] = tpdo2.codec()
        self._statusword_at: Final[int] = tpdo2.place("statusword")
        self._encode_command: Final[Callable[..., bytes]] = rpdo1.codec().encode
        self._controlword_at: Final[int] = rpdo1.place("controlword")
        self._torque_at: Final[int] = rpdo1.place("target_torque")
        self._command: Final[list[int]] = [0] * len(rpdo1.content)
        self._commands: Final[list[CommandFrames]] = [CommandFrames(cob_id, rpdo1) for cob_id in self._rpdo]
        self._disable_ns: Final[int] = max(DISABLE_TIMEOUT_NS, DISABLE_TIMEOUT_CYCLES * plan.cycle_ns)
        self._deadline_ns: Final[int] = floor(plan.cycle_ns * DEADLINE_SHARE)
        self._q: list[float] = [0.0] * count
        self._dq: list[float] = [0.0] * count
        self._everybody: Final[int] = (1 << count) - 1
        self._unheard: int = self._everybody
        self._computed: bool = True
        self._words: list[int] = [0] * count
        self._cycle: int = -1
        self._fade_in: int = 0
        self._give_up_at: int = NEVER

    # --- called by the master ------------------------------------------------------------------------------------

    def operational(self, now: int, out: Out) -> None:
        """All devices are started: enable the drives."""
        self.phase = _ENABLING
        self._give_up_at = now + ENABLE_TIMEOUT_NS

    def synchronised(self, now: int, out: Out) -> None:
        """A new cycle begins."""
        self._cycle += 1
        self._unheard = self._everybody
        self._computed = False
        self.wake_at = now + self._deadline_ns
        if self.phase is _ENABLING:
            self._try_start(now)
        if self.phase is _STARTING and self._cycle - self._fade_in >= self.controller.time_zero_cycle:
            self.phase = _MOTION
            self.time_zero = now
        if self.phase is _MOTION:
            if self._motion_cycle >= self.motion_cycles:
                self.completed = True
                self._stop(now, out)
        elif self.phase is _STOPPING:
            self._try_leave(now)
        if self.leave and self.phase is not _WAITING:
            self._stop(now, out)
        if self.phase in (_STARTING, _MOTION) and self._motion_cycle % ids.STATUS_EVERY == 0:
            self._send_status(out)

    def process_data(self, now: int, slave: int, pdo: int, data: bytes, out: Out) -> None:
        """TPDO1: samples of a drive; TPDO2: its statusword."""
        if pdo == 1:
            if len(data) < self._samples_size:
                return
            values = self._unpack_samples(data)
            angle = self._angle[slave]
            self._q[slave] = values[self._position_at] * angle
            self._dq[slave] = values[self._velocity_at] * angle
            self._unheard &= ~(1 << slave)
            if not self._unheard and not self._computed:
                self._compute(now, out)
        elif pdo == 2 and len(data) >= self._status_codec.size:
            self._status(now, slave, self._status_codec.unpack(data)[self._statusword_at], out)

    def emergency(self, now: int, slave: int, emergency: Emergency, out: Out) -> None:
        """An EMCY: noted; one with which the drive drops its torque ends the motion."""
        text = "errors gone" if emergency.code == NO_ERROR else f"error {emergency.code:04X}"
        self._note(now, slave, "emcy", f"{text}, error register {emergency.register:02X}")
        if emergency.code in STOPPING_ERRORS and self.phase in (_STARTING, _MOTION):
            self._stop(now, out)

    def node_lost(self, now: int, slave: int, out: Out) -> None:
        """A drive went silent: end the motion."""
        self._note(now, slave, "heartbeat_lost", "heartbeat lost")
        if self.phase in (_ENABLING, _STARTING, _MOTION):
            self._stop(now, out)

    def left_operational(self, now: int, slave: int, state: int, out: Out) -> None:
        """A drive takes no process data any more: end the motion."""
        self._note(now, slave, "nmt_state", f"left Operational: NMT state {state}")
        if self.phase in (_ENABLING, _STARTING, _MOTION):
            self._stop(now, out)

    def rebooted(self, now: int, slave: int, out: Out) -> None:
        """A drive restarted by itself: it is no longer configured, end the motion."""
        self._note(now, slave, "reboot", "unexpected boot-up message")
        self._stop(now, out)

    def failed(self, now: int, reason: str, out: Out) -> None:
        """The start failed."""
        self.events.append(Event(now, "", "start_failed", reason))
        self.phase = _FAILED

    def wake(self, now: int, out: Out) -> None:
        """The deadline of the cycle: compute with what there is."""
        self.wake_at = NEVER
        if not self._computed:
            if self.phase is _MOTION:
                for slave in range(len(self.late)):
                    if self._unheard >> slave & 1:
                        self.late[slave] += 1
            self._compute(now, out)

    # --- the cycle -----------------------------------------------------------------------------------------------

    @property
    def _motion_cycle(self) -> int:
        """Cycles since time 0; negative while fading in."""
        return self._cycle - self._fade_in - self.controller.time_zero_cycle

    def _compute(self, now: int, out: Out) -> None:
        """Samples -> torques -> RPDOs."""
        self._computed = True
        self.wake_at = NEVER
        phase = self.phase
        if phase is _STARTING or phase is _MOTION:
            controller = self.controller
            tau = controller.step(self._cycle - self._fade_in, self._q, self._dq)
            if phase is _MOTION:
                state = controller.state
                self.samples.append(Sample(self._motion_cycle, state.q_d, state.dq_d, state.tau_command))
            # torque in per mille of rated, within int16 because the clamp lies far below its range
            scale = self._torque
            for slave, commands in enumerate(self._commands):
                raw = floor(tau[slave] / scale[slave] + 0.5)
                out.send(0, commands.known.get(raw) or commands.frame(raw))
        elif phase is _ENABLING or phase is _STOPPING:
            for slave in range(len(self._rpdo)):
                word = 0x00
                if phase is _ENABLING:
                    word = enabling_controlword(self.states[slave])
                    if word & 0x80 and self._words[slave] & 0x80:
                        word = 0x00  # fault reset needs a rising edge
                self._words[slave] = word
                self._command[self._controlword_at] = word
                self._command[self._torque_at] = 0
                out.send(0, Frame(self._rpdo[slave], self._encode_command(*self._command)))

    def _status(self, now: int, slave: int, statusword: int, out: Out) -> None:
        state = decode_statusword(statusword)
        self.states[slave] = state
        if self.phase in (_STARTING, _MOTION) and state is not _OPERATION_ENABLED:
            words = state.name.replace("_", " ").lower() if state is not None else "an undefined state"
            self._note(now, slave, "drive_stopped", f"left Operation enabled: {words}, statusword {statusword:04X}")
            self._stop(now, out)

    def _try_start(self, now: int) -> None:
        waiting = [at for at in range(len(self.states)) if self.states[at] is not _OPERATION_ENABLED]
        if not waiting:
            self.phase = _STARTING
            self._fade_in = self._cycle
        elif now >= self._give_up_at:
            for slave in waiting:
                state = self.states[slave]
                words = state.name.replace("_", " ").lower() if state is not None else "no statusword (TPDO2) came"
                self._note(
                    now,
                    slave,
                    "start_failed",
                    f"not in Operation enabled after {ENABLE_TIMEOUT_NS / 1e9:g} s: {words}; "
                    "check the drive's error code",
                )
            self.phase = _STOPPING
            self._give_up_at = now + self._disable_ns

    def _stop(self, now: int, out: Out) -> None:
        """End the motion; the drives get "disable voltage" from the next torques on."""
        if self.phase in (_STOPPING, _STOPPED):
            return
        self.phase = _STOPPING
        self._give_up_at = now + self._disable_ns
        self._send_status(out)

    def _try_leave(self, now: int) -> None:
        enabled = [at for at in range(len(self.states)) if self.states[at] in _ENABLED]
        if enabled and now < self._give_up_at:
            return
        for slave in enabled:
            self._note(now, slave, "still_enabled", "did not report that it is disabled")
        self.phase = _STOPPED
        self._computed = True
        self.wake_at = NEVER
        self.finished = True

    def _send_status(self, out: Out) -> None:
        state, cycle, phase = ids.STATUS_STOPPED, 0, 0
        if self.phase is _STARTING:
            state = ids.STATUS_STARTING
        elif self.phase is _MOTION:
            state = ids.STATUS_MOTION
            cycle = self._motion_cycle & 0xFFFF
        if self.phase in (_STARTING, _MOTION):
            phase = floor(self.controller.phase(self._cycle - self._fade_in) * 65536) & 0xFFFF
        out.send(0, Frame(ids.HLC_STATUS, _STATUS.pack(state, cycle, phase)))

    def _note(self, now: int, slave: int, kind: str, text: str) -> None:
        self.events.append(Event(now, self._names[slave], kind, text))
