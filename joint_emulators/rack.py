"""Six drives on one plant, as one node with a port per drive.

The physics does not hang on the bus: every 1 ms the rack steps drives and plant by itself, so a lost SYNC or a stopped
bus leaves the plant falling, as in reality. The wake-up at k ms integrates (k-1, k] ms with the torques held then;
SYNC latches the last finished step.
"""

from typing import Final, final

from canopen_exo.bus.frame import Frame
from canopen_exo.bus.node import IGNORE, NEVER, NO_FILTER, TAKE, Node, Out, PortState, open_filter
from canopen_exo.device import Device
from canopen_exo.plan import SYNC
from joint_emulators.drive import Drive
from joint_emulators.plant import STEP_NS, Plant
from joint_emulators.sensors import JointSensor, sample


@final
class TruthRow:
    """The plant after a step: lists of n_joints. time_ns: loop clock; q rad, dq rad/s, tau N m after the gear."""

    __slots__ = ("dq", "q", "tau", "time_ns")

    def __init__(self, time_ns: int, q: list[float], dq: list[float], tau: list[float]) -> None:
        self.time_ns: Final[int] = time_ns
        self.q: Final[list[float]] = q
        self.dq: Final[list[float]] = dq
        self.tau: Final[list[float]] = tau


@final
class Rack(Node):
    """Drives on a plant. devices[k] sends on port k and drives joint k. truth: one row per step, from the start."""

    def __init__(self, plant: Plant, devices: list[Device], drives: list[Drive]) -> None:
        super().__init__()
        self.plant: Final[Plant] = plant
        self.devices: Final[list[Device]] = devices
        self.drives: Final[list[Drive]] = drives
        self.truth: list[TruthRow] = []
        self.step_at: int = STEP_NS
        self._timers_at: int = 0
        self._torques: Final[list[float]] = [0.0] * len(drives)
        self._sensors: Final[list[JointSensor]] = [drive.sensor for drive in drives]
        self.wake_at = 0
        self._hearing: Final[list[list[Device]]] = [[] for _ in range(NO_FILTER)]
        self._heard: Final[set[int]] = set()
        self._revision: int = -1
        self._filter: Final[bytearray] = open_filter()
        self._filter[:NO_FILTER] = bytes([IGNORE]) * NO_FILTER
        self.filters = [self._filter] * len(devices)
        self._route()
        sample(self._sensors, plant.q, plant.tau)

    def receive(self, now: int, port: int, frame: Frame, out: Out) -> None:
        """A frame on the drive bus: to the devices that listen to its id."""
        if frame.flags:
            return
        can_id = frame.can_id
        hearing = self._hearing[can_id]
        if can_id == SYNC:
            for device in hearing:
                device.synchronise(now, frame.data, out)
                if device.wake_at < self._timers_at:
                    self._note(device)
            return
        for device in hearing:
            device.receive(now, 0, frame, out)
            if device.wake_at < self._timers_at:
                self._note(device)
        if can_id == 0 or can_id >= 0x580:  # NMT and SDO may change what the devices listen to
            self._route()

    def receive_on(self, now: int, ports: list[int], frame: Frame, out: Out) -> None:
        """A frame that only some of the drives accepted, because of an error on the bus."""
        if frame.flags:
            return
        for device in self._hearing[frame.can_id]:
            if device.port in ports:
                device.receive(now, 0, frame, out)
                self._note(device)
        self._route()

    def port_changed(self, now: int, state: PortState, out: Out) -> None:
        """The CAN controller of one drive."""
        for device in self.devices:
            if device.port == state.port:
                device.port_changed(now, state, out)
                self._note(device)

    def _note(self, device: Device) -> None:
        """A device may have to be woken earlier than thought; later is seen when that time has come."""
        if device.wake_at < self._timers_at:
            self._timers_at = device.wake_at
            self.wake_at = min(self.step_at, self._timers_at)

    def wake(self, now: int, out: Out) -> None:
        """The plant's next step, and the devices' timers."""
        if now >= self.step_at:
            self._step(now)
        if now >= self._timers_at:
            at = NEVER
            for device in self.devices:
                if device.wake_at <= now:
                    device.wake(now, out)
                if device.wake_at < at:
                    at = device.wake_at
            self._timers_at = at
        self.wake_at = min(self.step_at, self._timers_at)

    def _step(self, now: int) -> None:
        torques = self._torques
        for joint, drive in enumerate(self.drives):
            torques[joint] = drive.torque_nm
        plant = self.plant
        plant.step(torques)
        sample(self._sensors, plant.q, plant.tau)
        self.truth.append(TruthRow(now, plant.q, plant.dq, plant.tau))
        self.step_at += STEP_NS

    def _route(self) -> None:
        """Which devices hear which 11-bit id."""
        revision = 0
        for device in self.devices:
            revision += device.revision
        if revision == self._revision:
            return
        self._revision = revision
        for can_id in self._heard:
            self._hearing[can_id] = []
            self._filter[can_id] = IGNORE
        self._heard.clear()
        for device in self.devices:
            for can_id in device.cob_ids():
                hearing = self._hearing[can_id]
                if device not in hearing:
                    hearing.append(device)
                self._filter[can_id] = TAKE
                self._heard.add(can_id)
