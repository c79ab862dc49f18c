"""A device with an application that writes down what it is told."""

import struct

from canopen_exo.bus.frame import Frame
from canopen_exo.bus.node import MS, Out
from canopen_exo.device import Application, Device
from canopen_exo.eds import load_eds
from canopen_exo.nmt import NmtState
from canopen_exo.od import ObjectDictionary
from canopen_exo.pdo import INVALID

PATTERN = ObjectDictionary(load_eds())
NODE = 5
PERIOD = 2 * MS
BOOT = 5 * MS

NMT, SYNC, EMCY, TPDO1, RPDO1, TPDO2, RPDO2, TPDO3, ANSWER, REQUEST, HEARTBEAT = (
    0x000, 0x080, 0x085, 0x185, 0x205, 0x285, 0x305, 0x385, 0x585, 0x605, 0x705,
)  # fmt: skip

START, STOP, PRE, RESET_NODE, RESET_COMMUNICATION = 1, 2, 128, 129, 130

TIMED_OUT, NOT_MAPPABLE, PDO_LENGTH, INCOMPATIBLE = 0x05040000, 0x06040041, 0x06040042, 0x06040043
VALUE, TOO_HIGH, DEVICE_STATE = 0x06090030, 0x06090031, 0x08000022

CONTROLWORD, MODE, TARGET_TORQUE = 0x60400010, 0x60600008, 0x60710010
STATUSWORD, POSITION, VELOCITY, TORQUE = 0x60410010, 0x60640020, 0x606C0020, 0x60770010


class Recorder(Application):
    """Writes down what the device tells it; latches a count of SYNCs as position."""

    def __init__(self, od: ObjectDictionary) -> None:
        self.od = od
        self.log: list[tuple[int, str, int]] = []
        self.latched = 0

    def reset(self, now: int) -> None:
        self.log.append((now, "reset", 0))

    def applied(self, now: int) -> None:
        self.log.append((now, "applied", self.od.value(0x607100)))

    def latch(self, now: int) -> None:
        self.latched += 1
        self.od.set(0x606400, self.latched)
        self.log.append((now, "latch", self.latched))

    def left_operational(self, now: int) -> None:
        self.log.append((now, "left", 0))

    def communication_lost(self, now: int, code: int) -> None:
        self.log.append((now, "lost", code))

    def errors_gone(self) -> None:
        self.log.append((-1, "gone", 0))

    def calls(self, name: str) -> list[tuple[int, int]]:
        return [(now, value) for now, called, value in self.log if called == name]


class Bench(Out):
    """One device, and what it sent: (time, frame). Serves its timers as a loop does: frame before wake-up."""

    def __init__(self) -> None:
        self.od = PATTERN.copy_for_node(NODE, {0x607600: 54900})
        self.application = Recorder(self.od)
        self.device = Device(self.od, NODE, self.application)
        self.application.log.clear()
        self.now = 0
        self.sent: list[tuple[int, Frame]] = []

    def send(self, port: int, frame: Frame) -> None:
        assert port == 0
        self.sent.append((self.now, frame))

    def run(self, until: int) -> "Bench":
        """Serve all timers up to and including `until`."""
        while self.device.wake_at <= until:
            now = max(self.device.wake_at, self.now)
            self.now = now
            self.device.wake(now, self)
            assert self.device.wake_at > now, "wake() must move wake_at on"
        self.now = until
        return self

    def hear(self, now: int, can_id: int, data: bytes, flags: int = 0) -> list[Frame]:
        """A frame ends at `now`; what the device sends there and then."""
        if now > self.now:
            self.run(now - 1)
            self.now = now
        count = len(self.sent)
        self.device.receive(now, 0, Frame(can_id, data, flags), self)
        return [frame for _, frame in self.sent[count:]]

    def nmt(self, command: int) -> list[Frame]:
        return self.hear(self.now, NMT, bytes((command, NODE)))

    def sync(self, now: int, counter: int = 1) -> list[Frame]:
        return self.hear(now, SYNC, bytes((counter,)))

    def write(self, index: int, sub: int, value: int, size: int) -> int:
        """Expedited download at the present time; the abort code, 0 when it was taken."""
        command = 0x23 | (4 - size) << 2
        data = value.to_bytes(size, "little", signed=value < 0).ljust(4, b"\0")
        (answer,) = self.hear(self.now, REQUEST, struct.pack("<BHB", command, index, sub) + data)
        assert answer.can_id == ANSWER
        return 0 if answer.data[0] == 0x60 else int.from_bytes(answer.data[4:], "little")

    def read(self, index: int, sub: int = 0) -> int:
        (answer,) = self.hear(self.now, REQUEST, struct.pack("<BHB4x", 0x40, index, sub))
        assert answer.data[0] & 0xE3 == 0x43, f"{index:04X}:{sub:02X} cannot be read: {answer!r}"
        return int.from_bytes(answer.data[4 : 8 - (answer.data[0] >> 2 & 3)], "little")

    def of(self, can_id: int) -> list[tuple[int, bytes]]:
        """Times and data of everything sent with this id."""
        return [(now, frame.data) for now, frame in self.sent if frame.can_id == can_id]

    def emergencies(self) -> list[tuple[int, int, int]]:
        """(time, code, register)."""
        return [(now, data[0] | data[1] << 8, data[2]) for now, data in self.of(EMCY)]

    def map(self, index: int, cob_id: int, kind: int, *entries: int) -> None:
        """The standard's procedure; index: of the communication parameters."""
        assert self.write(index, 1, INVALID | cob_id, 4) == 0
        assert self.write(index, 2, kind, 1) == 0
        assert self.write(index + 0x200, 0, 0, 1) == 0
        for sub, entry in enumerate(entries, 1):
            assert self.write(index + 0x200, sub, entry, 4) == 0
        assert self.write(index + 0x200, 0, len(entries), 1) == 0
        assert self.write(index, 1, cob_id, 4) == 0


def booted() -> Bench:
    """In Pre-operational at 10 ms."""
    return Bench().run(10 * MS)


def operational() -> Bench:
    bench = booted()
    bench.nmt(START)
    bench.sent.clear()
    bench.application.log.clear()
    return bench


def in_state(state: NmtState) -> Bench:
    bench = Bench() if state is NmtState.INITIALISING else booted()
    if state is NmtState.OPERATIONAL:
        bench.nmt(START)
    elif state is NmtState.STOPPED:
        bench.nmt(STOP)
    assert bench.device.nmt.state is state
    bench.sent.clear()
    bench.application.log.clear()
    return bench


STATES = list(NmtState)
