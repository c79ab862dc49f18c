"""A drive behind its CANopen device, on a bus, with sensors that a test feeds."""

import struct

import pytest

from canopen_exo.bus.frame import Frame
from canopen_exo.bus.node import MS, Out
from canopen_exo.device import Device
from canopen_exo.eds import load_eds
from canopen_exo.od import ObjectDictionary
from canopen_exo.pdo import key_of
from joint_emulators.drive import Drive
from joint_emulators.sensors import ENCODER, VELOCITY

NODE = 3
RATED_MNM = 72_900
NM = RATED_MNM * 1e-6
"""One per mille of the rated torque [N m]."""
CYCLE = 2 * MS
ENTRIES = load_eds()

ENABLE = (0x06, 0x07, 0x0F)
DISABLED, READY, SWITCHED_ON, ENABLED, FAULT = 0x40, 0x21, 0x23, 0x27, 0x08
"""State coding of CiA 402-2, statusword bits 0-3, 5, 6."""

SYNC_LOST, RPDO_LATE, HEARTBEAT_LOST = 0x8700, 0x8250, 0x8130


class Sink(Out):
    def __init__(self) -> None:
        self.sent: list[Frame] = []

    def send(self, port: int, frame: Frame) -> None:
        self.sent.append(frame)


class Joint:
    """A drive on the bus, Operational, with a SYNC every 2 ms when asked for; sensors are fed by hand."""

    def __init__(self, *, operational: bool = True) -> None:
        unit = {key_of(0x6076, 0): RATED_MNM, key_of(0x608F, 1): 131_072}
        od = ObjectDictionary(ENTRIES).copy_for_node(NODE, unit)
        self.drive = Drive(od, ENCODER, VELOCITY)
        self.device = Device(od, NODE, self.drive)
        self.sink = Sink()
        self.now = 0
        self.counter = 0
        self.pass_time(10 * MS)
        if operational:
            self.nmt(0x01)

    def pass_time(self, duration: int) -> None:
        """Let timers run up to and including `duration` ns from now."""
        self.now += duration
        while self.device.wake_at <= self.now:
            self.device.wake(self.device.wake_at, self.sink)

    def hear(self, can_id: int, data: bytes) -> list[Frame]:
        """Give it a frame; what it answers."""
        before = len(self.sink.sent)
        self.device.receive(self.now, 0, Frame(can_id, data), self.sink)
        return self.sink.sent[before:]

    def nmt(self, command: int) -> None:
        self.hear(0x000, bytes((command, NODE)))

    def answer(self, request: bytes) -> Frame:
        """The one answer to an SDO request."""
        (answer,) = [frame for frame in self.hear(0x600 + NODE, request) if frame.can_id == 0x580 + NODE]
        return answer

    def write(self, index: int, raw: int, size: int, sub: int = 0) -> int:
        """Expedited SDO download; the abort code, 0 when it was done."""
        head = bytes((0x23 | (4 - size) << 2,)) + struct.pack("<HB", index, sub)
        data = head + (raw % (1 << 8 * size)).to_bytes(size, "little")
        answer = self.answer(data.ljust(8, b"\x00"))
        return int.from_bytes(answer.data[4:], "little") if answer.data[0] == 0x80 else 0

    def read(self, index: int, sub: int = 0, *, signed: bool = False) -> int:
        """Expedited SDO upload."""
        answer = self.answer(struct.pack("<BHBI", 0x40, index, sub, 0))
        assert answer.data[0] & 0xE3 == 0x43, answer
        return int.from_bytes(answer.data[4 : 8 - (answer.data[0] >> 2 & 3)], "little", signed=signed)

    def rpdo(self, controlword: int, torque: int = 0) -> None:
        """RPDO1; it acts with the next SYNC."""
        self.hear(0x200 + NODE, struct.pack("<Hh", controlword, torque))

    def sync(self) -> list[Frame]:
        """A cycle later, the next SYNC; what it sends."""
        self.pass_time(CYCLE)
        self.counter = self.counter % 240 + 1
        return self.hear(0x080, bytes((self.counter,)))

    def command(self, *controlwords: int, torque: int = 0) -> None:
        """Controlwords with a target torque, one a cycle."""
        for controlword in controlwords:
            self.rpdo(controlword, torque)
            self.sync()

    @property
    def state(self) -> int:
        """Statusword bits of the state (CiA 402-2, state coding): mask 0x4F, or 0x6F where bit 5 counts."""
        word = self.read(0x6041)
        return word & 0x4F if word & 0x4F in (0x00, 0x40, 0x0F, 0x08) else word & 0x6F

    @property
    def limited(self) -> bool:
        """Statusword bit 11, internal limit active."""
        return bool(self.read(0x6041) & 1 << 11)


def enabled_joint() -> Joint:
    """In Operation enabled, with a torque of 500 per mille."""
    joint = Joint()
    joint.command(*ENABLE, torque=500)
    assert joint.drive.torque_nm == pytest.approx(500 * NM)
    return joint
