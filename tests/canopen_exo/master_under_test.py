"""A master with an application that writes down what it is told, and devices for it."""

from canopen_exo.bus.frame import Frame
from canopen_exo.bus.loop import Loop
from canopen_exo.bus.medium import Medium
from canopen_exo.bus.node import MS, NEVER, Node, Out
from canopen_exo.device import Application, Device
from canopen_exo.eds import load_eds
from canopen_exo.emcy import Emergency
from canopen_exo.master import Expected, Master, MasterApplication, SlaveConfig, Write
from canopen_exo.od import ObjectDictionary
from canopen_exo.plan import BusPlan, JointNode

PATTERN = ObjectDictionary(load_eds())
NAMES = ("left_hip", "left_knee", "left_ankle", "right_hip", "right_knee", "right_ankle")
CYCLE = 2 * MS
HEARTBEAT_TIMEOUT = 300 * MS
RATED = 50_000


class Recorder(MasterApplication):
    """Writes down what the master tells it: (time, what, details)."""

    def __init__(self) -> None:
        super().__init__()
        self.log: list[tuple[int, str, tuple[object, ...]]] = []

    def operational(self, now: int, out: Out) -> None:
        self.log.append((now, "operational", ()))

    def synchronised(self, now: int, out: Out) -> None:
        self.log.append((now, "sync", ()))

    def process_data(self, now: int, slave: int, pdo: int, data: bytes, out: Out) -> None:
        self.log.append((now, "pdo", (slave, pdo, data)))

    def emergency(self, now: int, slave: int, emergency: Emergency, out: Out) -> None:
        self.log.append((now, "emergency", (slave, emergency.code, emergency.register)))

    def node_lost(self, now: int, slave: int, out: Out) -> None:
        self.log.append((now, "lost", (slave,)))

    def left_operational(self, now: int, slave: int, state: int, out: Out) -> None:
        self.log.append((now, "left", (slave, state)))

    def rebooted(self, now: int, slave: int, out: Out) -> None:
        self.log.append((now, "rebooted", (slave,)))

    def failed(self, now: int, reason: str, out: Out) -> None:
        self.log.append((now, "failed", (reason,)))

    def of(self, what: str) -> list[tuple[int, tuple[object, ...]]]:
        return [(now, details) for now, name, details in self.log if name == what]


class Talker(Node):
    """Sends one frame at a time of our choosing."""

    def __init__(self) -> None:
        super().__init__()
        self.frames: list[tuple[int, Frame]] = []

    def say(self, when: int, frame: Frame) -> None:
        self.frames = sorted([*self.frames, (when, frame)], key=lambda item: item[0])
        self.wake_at = self.frames[0][0]

    def wake(self, now: int, out: Out) -> None:
        while self.frames and self.frames[0][0] <= now:
            out.send(0, self.frames.pop(0)[1])
        self.wake_at = self.frames[0][0] if self.frames else NEVER


class BootOnly(Node):
    """A device that boots and then answers nothing."""

    def __init__(self, node_id: int, when: int) -> None:
        super().__init__()
        self.node_id = node_id
        self.wake_at = when

    def wake(self, now: int, out: Out) -> None:
        out.send(0, Frame(0x700 + self.node_id, b"\0"))
        self.wake_at = NEVER


def plan_of(count: int) -> BusPlan:
    return BusPlan(tuple(JointNode(name, number, RATED, 131_072) for number, name in enumerate(NAMES[:count], 1)))


def slave(name: str, node_id: int, *more: Write) -> SlaveConfig:
    return SlaveConfig(
        name,
        node_id,
        (
            Expected(0x1000, 0, 0x00020192, "device type"),
            Expected(0x1018, 2, 1, "product code"),
            Expected(0x6076, 0, RATED, "rated torque [mN m]"),
        ),
        (Write(0x1006, 0, 2000, 4), Write(0x6072, 0, 900 + node_id, 2), *more),
        HEARTBEAT_TIMEOUT,
    )


class Rig:
    """A master and real devices on one bus."""

    def __init__(
        self,
        count: int = 6,
        missing: tuple[int, ...] = (),
        rated: dict[int, int] | None = None,
        more: dict[int, tuple[Write, ...]] | None = None,
    ) -> None:
        self.plan = plan_of(count)
        self.application = Recorder()
        configs = tuple(
            slave(joint.name, joint.node_id, *(more or {}).get(joint.node_id, ())) for joint in self.plan.joints
        )
        self.master = Master(self.plan, configs, self.application)
        self.talker = Talker()
        self.bus = Medium("bus", 0, 1_000_000)
        self.loop = Loop([self.bus])
        self.loop.connect(self.master, [self.bus])
        self.loop.connect(self.talker, [self.bus])
        self.devices: dict[int, Device] = {}
        for joint in self.plan.joints:
            if joint.node_id not in missing:
                od = PATTERN.copy_for_node(joint.node_id, {0x607600: (rated or {}).get(joint.node_id, RATED)})
                self.devices[joint.node_id] = Device(od, joint.node_id, Application())
                self.loop.connect(self.devices[joint.node_id], [self.bus])

    def run(self, until: int) -> "Rig":
        self.loop.run_until(until)
        return self

    def ends(self, can_id: int) -> list[int]:
        return [row.end_ns for row in self.loop.trace if row.frame.can_id == can_id]

    def frames(self, can_id: int) -> list[bytes]:
        return [row.frame.data for row in self.loop.trace if row.frame.can_id == can_id]


class Sink(Out):
    def send(self, port: int, frame: Frame) -> None:
        assert port == 0
