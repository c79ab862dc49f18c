"""A listener on both buses: who is there, how the drives are, whether cycles are on time, how full the buses are.

It is how the supervisor knows that a part of the rig is ready: by what it says on CAN. Where nothing is said by itself
(drives that run already; a gateway, which never speaks), it asks: an SDO upload of 0x1000 (device type, CiA 301,
mandatory) to each drive. An answer on the drive bus shows the drive; one to a question on the controller bus shows that
the gateway passes frames both ways. Once the rig is ready it sends nothing.
"""

from collections.abc import Iterable
from typing import Final, final

from canopen_exo import plan as ids
from canopen_exo.bus.frame import Frame
from canopen_exo.bus.lateness import Lateness
from canopen_exo.bus.node import MS, NEVER, ErrorState, Node, Out, PortState
from canopen_exo.cia402 import DriveState, decode_statusword
from canopen_exo.emcy import HEARTBEAT_LOST, RPDO_TIMEOUT, SYNC_LOST, error_words
from canopen_exo.plan import BusPlan

CONTROLLER_PORT: Final = 0
DRIVE_PORT: Final = 1

ASK_EVERY_NS: Final = 100 * MS

_DEVICE_TYPE: Final = bytes((0x40, 0x00, 0x10, 0x00, 0, 0, 0, 0))
"""SDO initiate upload of 0x1000:00 (CiA 301, 7.2.4.3.5)."""


_DROPS_TORQUE: Final = (HEARTBEAT_LOST, RPDO_TIMEOUT, SYNC_LOST)
"""Errors with which a drive drops its torque (its 0x6007)."""


@final
class Alarm:
    """An EMCY of a drive. time_ns: loop clock; code: CiA 301 error code, 0 when all errors are gone."""

    __slots__ = ("code", "joint", "time_ns")

    def __init__(self, time_ns: int, joint: str, code: int) -> None:
        self.time_ns: Final[int] = time_ns
        self.joint: Final[str] = joint
        self.code: Final[int] = code


def too_busy(cycle_ns: int) -> str:
    """What to do about a rig that was late, in words."""
    rate = 1e9 / cycle_ns
    lower = 100 if rate > 100 else rate / 2
    return (
        f"this machine is too busy for {rate:g} Hz, where nothing held a process up: end what else runs on it, lower "
        f"rig.rate (as with --set rig.rate={lower:g}Hz), or try --fifo"
    )


@final
class Watch(Node):
    """Port CONTROLLER_PORT and port DRIVE_PORT.

    heard: by port, the drives heard there since the last `ask`; master_heard: the controller's boot-up or SYNC came;
    states: of the drives, by TPDO2, None before the first; alarms: every EMCY, in order; time_zero: loop clock, from
    the controller's status frame, NEVER before it; motion: last state in that frame; phase: of the stride, 0..1.
    ended_by: the error after which the controller ended the motion, in words, "" for none.
    cycles, late: SYNCs on the controller bus since answers and commands were first complete, and those before whose
    successor they were not; offsets: how much a SYNC's distance to the one before differed from the cycle.
    ports: state of both interfaces; bits: by port, carried so far.
    """

    def __init__(self, plan: BusPlan) -> None:
        super().__init__()
        self.plan: Final[BusPlan] = plan
        self.heard: Final[list[set[str]]] = [set(), set()]
        self.master_heard: bool = False
        self.states: Final[dict[str, DriveState | None]] = {joint.name: None for joint in plan.joints}
        self.alarms: Final[list[Alarm]] = []
        self.time_zero: int = NEVER
        self.motion: int = 0
        self.ended_by: str = ""
        self.phase: float = 0.0
        self.cycles: int = 0
        self.late: int = 0
        self.offsets: Final[Lateness] = Lateness()
        self.ports: Final[list[ErrorState]] = [ErrorState.ERROR_ACTIVE, ErrorState.ERROR_ACTIVE]
        self.bits: Final[list[int]] = [0, 0]
        self._names: Final[dict[int, str]] = {joint.node_id: joint.name for joint in plan.joints}
        tpdo2 = plan.pdo("TPDO2")
        self._status_codec: Final = tpdo2.codec()
        self._statusword_at: Final[int] = tpdo2.place("statusword")
        self._started: int = 0
        self._asking: int = -1
        self._sync_ns: int = NEVER
        self._answers: Final[set[int]] = set()
        self._commands: Final[set[int]] = set()
        self._complete: bool = False

    # --- readiness -----------------------------------------------------------------------------------------------

    def ask(self, now: int, port: int) -> None:
        """Ask for the drives on that port until `missing` names none; forgets who was heard there."""
        self.heard[port].clear()
        self._asking = port
        self.wake_at = now

    def missing(self, port: int) -> list[str]:
        """The drives not heard on a port."""
        return [name for name in self._names.values() if name not in self.heard[port]]

    def wake(self, now: int, out: Out) -> None:
        """Ask those that are still missing."""
        port = self._asking
        missing = self.missing(port) if port >= 0 else []
        if not missing:
            self._asking = -1
            self.wake_at = NEVER
            return
        for node_id, name in self._names.items():
            if name in missing:
                out.send(port, Frame(ids.SDO_REQUEST + node_id, _DEVICE_TYPE))
        self.wake_at = now + ASK_EVERY_NS

    def timing_words(self) -> str:
        """What was late, for people; "" for a rig that kept time: no late cycle, no SYNC off by half a cycle."""
        if not self.late and self.offsets.worst_ns <= self.plan.cycle_ns // 2:
            return ""
        remedy = too_busy(self.plan.cycle_ns)
        return f"the rig was late: {self.late} of {self.cycles} cycles, {self.sync_words()}; {remedy}"

    def sync_words(self) -> str:
        """How regular SYNC was, for people: the worst, and what half and 99 % of the cycles did not exceed."""
        median_ns, most_ns = self.offsets.percentile(0.5), self.offsets.percentile(0.99)
        shares = f"(50 %: {median_ns / 1e6:.1f}, 99 %: {most_ns / 1e6:.1f})"
        return f"SYNC off by at most {self.offsets.worst_ns / 1e6:.1f} ms {shares}"

    # --- listening -----------------------------------------------------------------------------------------------

    def receive(self, now: int, port: int, frame: Frame, out: Out) -> None:
        """Any frame of either bus."""
        if frame.flags == 0:
            self.bits[port] += frame.bits or frame.measure()
            if port == CONTROLLER_PORT:
                self._controller_bus(now, frame)
            node_id = frame.can_id & 0x7F
            name = self._names.get(node_id)
            if name is not None:
                self._drive(now, port, name, frame.can_id - node_id, frame.data)

    def port_changed(self, now: int, state: PortState, out: Out) -> None:
        """An interface went down, off the bus, or came back."""
        self.ports[state.port] = state.state

    def _drive(self, now: int, port: int, name: str, function: int, data: bytes) -> None:
        """A frame with a drive's node id."""
        if function == ids.SDO_ANSWER or (function == ids.HEARTBEAT and port == DRIVE_PORT):
            self.heard[port].add(name)
        if port != DRIVE_PORT:
            return
        if function == ids.TPDO2 and len(data) >= self._status_codec.size:
            self.states[name] = decode_statusword(self._status_codec.unpack(data)[self._statusword_at])
        elif function == ids.EMCY and len(data) >= 2:
            self.alarms.append(Alarm(now, name, data[0] | data[1] << 8))
        elif function == ids.HEARTBEAT and data == b"\x00":
            self.states[name] = None

    def _controller_bus(self, now: int, frame: Frame) -> None:
        can_id = frame.can_id
        if can_id == ids.SYNC:
            self._sync(now)
        elif can_id == ids.HLC_STATUS:
            self._status(frame.data)
        elif can_id == ids.HEARTBEAT + ids.MASTER_ID:
            self.master_heard = True
        else:
            node_id = can_id & 0x7F
            if node_id in self._names:
                if can_id - node_id == ids.TPDO1:
                    self._answers.add(node_id)
                elif can_id - node_id == ids.RPDO1:
                    self._commands.add(node_id)

    def _sync(self, now: int) -> None:
        self.master_heard = True
        full = len(self._names)
        complete = len(self._answers) == full and len(self._commands) == full
        if self._complete:
            self.cycles += 1
            if not complete:
                self.late += 1
            self.offsets.add(abs(now - self._sync_ns - self.plan.cycle_ns))
        self._complete = self._complete or complete
        self._sync_ns = now
        self._answers.clear()
        self._commands.clear()

    def _status(self, data: bytes) -> None:
        if len(data) < 5:
            return
        if data[0] == ids.STATUS_STOPPED != self.motion:
            dropped = [alarm for alarm in self.alarms[self._started :] if alarm.code in _DROPS_TORQUE]
            self.ended_by = f"{dropped[0].joint} dropped its torque: {error_words(dropped[0].code)}" if dropped else ""
        elif data[0] == ids.STATUS_STARTING != self.motion:
            self._started = len(self.alarms)
        self.motion = data[0]
        if data[0] == ids.STATUS_MOTION:
            if self.time_zero == NEVER:
                self.time_zero = self._sync_ns - (data[1] | data[2] << 8) * self.plan.cycle_ns
        elif data[0] == ids.STATUS_STOPPED:
            self._complete = False
        self.phase = (data[3] | data[4] << 8) / 65536


def alarms_text(alarms: Iterable[Alarm]) -> str:
    """Errors in words, with the drives that told them: "SYNC lost (8700): left_hip, left_knee"; "" for none."""
    found: dict[int, list[str]] = {}
    for alarm in alarms:
        joints = found.setdefault(alarm.code, [])
        if alarm.joint not in joints:
            joints.append(alarm.joint)
    return "; ".join(f"{error_words(code)}: {', '.join(joints)}" for code, joints in sorted(found.items()) if code)


def states_text(states: Iterable[DriveState | None]) -> str:
    """Drive states in words, equal ones together: "6 operation enabled"."""
    counts: dict[str, int] = {}
    for state in states:
        words = "no status" if state is None else state.name.replace("_", " ").lower()
        counts[words] = counts.get(words, 0) + 1
    return ", ".join(f"{count} {words}" for words, count in counts.items())
