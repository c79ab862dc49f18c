"""What the frames of both buses say about a rig: drives, controller and master as any listener sees them.

Only frames are read, so that a value means the same in lock-step, on a hub and on a real interface. Scaling and places
come from the bus plan; extended, remote and FD frames, and frames too short for their content, are passed over.
Left out: SDO, block transfers, anything that is not in the plan.
"""

from enum import Enum
from typing import Final, final

from canopen_exo import plan as ids
from canopen_exo.bus.medium import Transmission
from canopen_exo.bus.node import NEVER
from canopen_exo.cia402 import DriveState, decode_statusword
from canopen_exo.emcy import NO_ERROR, Emergency, decode_emcy
from canopen_exo.master import MasterState
from canopen_exo.nmt import AFTER, NmtCommand, NmtState, decode_nmt
from canopen_exo.plan import BusPlan, JointNode
from canopen_exo.signal import Codec
from testbench.errors import BenchError
from testbench.parts import NotedEvent

BUSES: Final = ("controller", "drive")
"""Names of the buses, by their index in a trace."""

CONTROLLER_BUS: Final = 0
DRIVE_BUS: Final = 1


class ControllerState(Enum):
    """What the high-level controller says of itself (COB-ID 0x2FF); the value is its state byte, 0 for nothing."""

    SILENT = 0
    STARTING = ids.STATUS_STARTING
    MOTION = ids.STATUS_MOTION
    STOPPED = ids.STATUS_STOPPED


@final
class _Latest:
    """The newest values of one PDO of one drive."""

    def __init__(self, plan: BusPlan, name: str, drive: str, bus: str) -> None:
        pdo = plan.pdo(name)
        self.codec: Final[Codec] = pdo.codec()
        self.values: tuple[int, ...] = ()
        self._places: Final = {mapped.name: at for at, mapped in enumerate(pdo.content)}
        self._missing: Final = f"{drive}: no {name} was on the {bus} bus yet; run_until_motion() first"

    def raw(self, name: str) -> int:
        """A raw value; raises BenchError before the first frame."""
        if not self.values:
            raise BenchError(self._missing)
        return self.values[self._places[name]]


@final
class DriveView:
    """One drive as one bus shows it.

    state: CiA 402 state of the newest statusword, None before the first and after a boot-up; nmt: NMT state of the
    newest heartbeat, None before the first; emergencies: every EMCY, in order.
    The other values are those of the newest PDO and raise BenchError before there is one.
    """

    def __init__(self, plan: BusPlan, joint: JointNode, bus: str) -> None:
        self.name: Final[str] = joint.name
        self.node_id: Final[int] = joint.node_id
        self.state: DriveState | None = None
        self.nmt: NmtState | None = None
        self.emergencies: Final[list[Emergency]] = []
        self._samples: Final = _Latest(plan, "TPDO1", joint.name, bus)
        self._status: Final = _Latest(plan, "TPDO2", joint.name, bus)
        self._angle: Final[float] = plan.scale(joint, "rad")
        self._torque: Final[float] = plan.scale(joint, "N m")

    @property
    def position_rad(self) -> float:
        """Joint angle (0x6064), rad."""
        return self._samples.raw("position") * self._angle

    @property
    def velocity_rad_s(self) -> float:
        """Joint speed (0x606C), rad/s."""
        return self._samples.raw("velocity") * self._angle

    @property
    def torque_nm(self) -> float:
        """Joint torque (0x6077), N m."""
        return self._status.raw("torque") * self._torque

    @property
    def statusword(self) -> int:
        """Object 0x6041."""
        return self._status.raw("statusword")

    @property
    def error_code(self) -> int:
        """Object 0x603F, 0 for none."""
        return self._status.raw("error_code")

    def hear(self, function: int, data: bytes) -> None:
        """A frame of this drive. function: its COB-ID without the node id."""
        if function == ids.TPDO1 or function == ids.TPDO2:
            latest = self._samples if function == ids.TPDO1 else self._status
            if len(data) >= latest.codec.size:
                latest.values = latest.codec.unpack(data)
                if latest is self._status:
                    self.state = decode_statusword(self.statusword)
        elif function == ids.HEARTBEAT and len(data) == 1:
            self.nmt = _nmt_state(data[0] & 0x7F)  # bit 7 is reserved, the toggle bit of node guarding
            if self.nmt is NmtState.INITIALISING:
                self.state = None
        elif function == ids.EMCY:
            emergency = decode_emcy(self.node_id, data)
            if emergency is not None:
                self.emergencies.append(emergency)


@final
class ControllerView:
    """The high-level controller.

    state: of its newest status frame; cycle: SYNCs since time 0 (16 bits); phase: of the stride, 0..1.
    drives: as the controller sees them, with the faults of the gateway in them.
    events: what it noticed, in lock-step; on other buses the EMCYs that reached it. Times count from power-up.
    """

    def __init__(self, drives: dict[str, DriveView]) -> None:
        self.state: ControllerState = ControllerState.SILENT
        self.cycle: int = 0
        self.phase: float = 0.0
        self.drives: Final[dict[str, DriveView]] = drives
        self.events: list[NotedEvent] = []


@final
class MasterView:
    """The CANopen master by its NMT commands. failure: why the start failed, lock-step only (else the state stays)."""

    def __init__(self) -> None:
        self.state: MasterState = MasterState.RESETTING
        self.failure: str = ""


@final
class Observer:
    """Reads the frames of both buses, in the order of the trace.

    drives: by joint, as the drive bus shows them, before any fault; time_zero_ns: loop clock, NEVER before it is known:
    the SYNC of the first status frame in motion, less the cycles since.
    """

    def __init__(self, plan: BusPlan) -> None:
        self.plan: Final[BusPlan] = plan
        views = [{joint.name: DriveView(plan, joint, bus) for joint in plan.joints} for bus in BUSES]
        self.drives: Final[dict[str, DriveView]] = views[DRIVE_BUS]
        self.controller: Final[ControllerView] = ControllerView(views[CONTROLLER_BUS])
        self.master: Final[MasterView] = MasterView()
        self.time_zero_ns: int = NEVER
        self._by_node: Final = [{view.node_id: view for view in drives.values()} for drives in views]
        self._sync_ns: int = NEVER

    def hear(self, row: Transmission) -> None:
        """The next frame."""
        frame = row.frame
        if frame.flags:
            return
        can_id, data = frame.can_id, frame.data
        if row.bus == CONTROLLER_BUS and not can_id & 0x7F:
            if can_id == ids.SYNC:
                self._sync_ns = row.end_ns
            elif can_id == ids.NMT:
                self._command(data)
            return
        if row.bus == CONTROLLER_BUS and can_id == ids.HLC_STATUS:
            self._status(data)
            return
        drive = self._by_node[row.bus].get(can_id & 0x7F)
        if drive is not None:
            known = len(drive.emergencies)
            drive.hear(can_id & 0x780, data)
            if row.bus == CONTROLLER_BUS and len(drive.emergencies) > known:
                code = drive.emergencies[-1].code
                text = "errors gone" if code == NO_ERROR else f"error {code:04X}"
                self.controller.events.append(NotedEvent(row.end_ns, drive.name, "emcy", text))

    def _command(self, data: bytes) -> None:
        """An NMT command of the master."""
        command = decode_nmt(data, 0)
        if command is None:
            return
        if command is NmtCommand.START:
            self.master.state = MasterState.OPERATIONAL
        elif AFTER[command] is NmtState.INITIALISING:
            self.master.state = MasterState.BOOTING
        elif self.master.state is MasterState.OPERATIONAL:
            self.master.state = MasterState.STOPPED

    def _status(self, data: bytes) -> None:
        if len(data) < 5:
            return
        controller = self.controller
        for state in ControllerState:
            if state.value == data[0]:
                controller.state = state
        controller.cycle = data[1] | data[2] << 8
        controller.phase = (data[3] | data[4] << 8) / 65536
        if controller.state is ControllerState.MOTION and self.time_zero_ns == NEVER and self._sync_ns != NEVER:
            self.time_zero_ns = self._sync_ns - controller.cycle * self.plan.cycle_ns


def frame_name(plan: BusPlan, can_id: int) -> str:
    """What an 11-bit id means in the plan: "TPDO1 right_knee"; "" when nothing."""
    named = {
        ids.NMT: "NMT",
        ids.SYNC: "SYNC",
        ids.HLC_STATUS: "controller status",
        ids.HEARTBEAT + ids.MASTER_ID: "heartbeat of the controller",
    }
    if can_id in named:
        return named[can_id]
    services = {
        ids.EMCY: "EMCY",
        ids.SDO_ANSWER: "SDO answer",
        ids.SDO_REQUEST: "SDO request",
        ids.HEARTBEAT: "heartbeat",
    }
    for joint in plan.joints:
        if can_id & 0x7F == joint.node_id:
            names = {**services, **{pdo.base: pdo.name for pdo in plan.pdos}}
            function = can_id & 0x780
            return f"{names[function]} {joint.name}" if function in names else ""
    return ""


def _nmt_state(value: int) -> NmtState | None:
    for state in NmtState:
        if state.value == value:
            return state
    return None
