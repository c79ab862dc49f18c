"""A CANopen master: boots the devices, makes SYNC, hears PDOs, heartbeats and emergencies.

Source: CiA 301 (NMT master, SYNC producer, SDO client, heartbeat); the order of the start follows CiA 302-2
(reset communication, boot-up, identity, configuration, start). What the master is for is its MasterApplication.
"""

from dataclasses import dataclass
from enum import Enum
from typing import Final, final

from mypy_extensions import mypyc_attr

from canopen_exo.bus.frame import FLAG_EXTENDED, FLAG_FD, FLAG_REMOTE, Frame
from canopen_exo.bus.node import MS, NEVER, Node, Out
from canopen_exo.emcy import Emergency, decode_emcy
from canopen_exo.heartbeat import HeartbeatConsumer, HeartbeatProducer, heartbeat_frame
from canopen_exo.nmt import ALL_NODES, NmtCommand, NmtState, nmt_frame
from canopen_exo.plan import EMCY, HEARTBEAT, MASTER_ID, SDO_ANSWER, SDO_REQUEST, BusPlan
from canopen_exo.sdo import SdoClient, abort_text
from canopen_exo.sync import SyncProducer

POWER_UP_NS: Final = 20 * MS
"""When the master starts: later than devices powered up with it, which hear no reset before their boot-up."""

BOOT_TIMEOUT_NS: Final = 1000 * MS
"""How long a device may take to its boot-up message."""

SDO_TIMEOUT_NS: Final = 500 * MS
"""How long a device may take to an SDO answer."""


@dataclass(frozen=True, slots=True)
class Expected:
    """What an object must read before the device is accepted. what: words for the message."""

    index: int
    sub: int
    value: int
    what: str


@dataclass(frozen=True, slots=True)
class Write:
    """One configuration step: an expedited download of `size` bytes."""

    index: int
    sub: int
    value: int
    size: int


@dataclass(frozen=True, slots=True)
class SlaveConfig:
    """A device as the master wants it. heartbeat_timeout_ns: silence after which it counts as lost."""

    name: str
    node_id: int
    identity: tuple[Expected, ...]
    writes: tuple[Write, ...]
    heartbeat_timeout_ns: int


class MasterState(Enum):
    """Where the start has come to."""

    RESETTING = "resetting"
    BOOTING = "booting"
    OPERATIONAL = "operational"
    FAILED = "failed"
    STOPPED = "stopped"


_OPERATIONAL: Final = MasterState.OPERATIONAL  # compared with for every PDO; an enumeration is looked up slowly


@mypyc_attr(allow_interpreted_subclasses=True)
class MasterApplication:
    """What a master does beyond communication.

    wake_at: its own timer, as a Node's. finished: set to leave: SYNC ends and the devices go to Pre-operational.
    """

    def __init__(self) -> None:
        self.wake_at: int = NEVER
        self.finished: bool = False

    def operational(self, now: int, out: Out) -> None:
        """All devices are configured and started; SYNC begins."""

    def synchronised(self, now: int, out: Out) -> None:
        """A SYNC was just queued."""

    def process_data(self, now: int, slave: int, pdo: int, data: bytes, out: Out) -> None:
        """A transmit PDO of a device came (index in the plan; 1 for TPDO1, 2 for TPDO2)."""

    def emergency(self, now: int, slave: int, emergency: Emergency, out: Out) -> None:
        """A device reported an error, or with code 0 that all are gone."""

    def node_lost(self, now: int, slave: int, out: Out) -> None:
        """A device's heartbeat stopped."""

    def left_operational(self, now: int, slave: int, state: int, out: Out) -> None:
        """A device's heartbeat tells another NMT state (CiA 301: 4 stopped, 127 pre-operational) than Operational."""

    def rebooted(self, now: int, slave: int, out: Out) -> None:
        """A device sent its boot-up message while the master took it for started."""

    def failed(self, now: int, reason: str, out: Out) -> None:
        """The start failed; the reason says which device and what to do."""

    def wake(self, now: int, out: Out) -> None:
        """`wake_at` is reached; must move it on."""


@final
class _Slave:
    """The start of one device: boot-up, identity, configuration, step by step over SDO."""

    def __init__(self, config: SlaveConfig) -> None:
        self.config: Final[SlaveConfig] = config
        self.client: SdoClient = SdoClient(config.node_id, SDO_TIMEOUT_NS)
        self.consumer: Final[HeartbeatConsumer] = HeartbeatConsumer(config.node_id, config.heartbeat_timeout_ns)
        self.booted: bool = False
        self.ready: bool = False
        self.failure: str = ""
        self._step: int = 0

    @property
    def where(self) -> str:
        return f"{self.config.name} (node {self.config.node_id})"

    def boot_up(self, now: int) -> bytes | None:
        """The boot-up message came: the first SDO request. A second one starts over, the device has forgotten all."""
        self.booted, self.ready = True, False
        self.client = SdoClient(self.config.node_id, SDO_TIMEOUT_NS)
        self._step = 0
        return self._request(now)

    def answer(self, now: int, data: bytes) -> bytes | None:
        """An SDO answer came: the next request; None when none is due (`ready`, `failure` or still waiting)."""
        if not self.booted or self.ready or self.failure:
            return None
        following = self.client.answer(now, data)
        if not self.client.done:
            return following
        if self.client.abort:
            self.failure = (
                f"{self.where}: {self._doing()} ended with SDO abort {abort_text(self.client.abort)}; "
                "check the device's EDS and state"
            )
            return following
        identity = self.config.identity
        if self._step < len(identity):
            found = int.from_bytes(self.client.result, "little")
            wanted = identity[self._step]
            if found != wanted.value:
                self.failure = (
                    f"{self.where}: {wanted.what} ({wanted.index:04X}:{wanted.sub:02X}) is {found:#010x}, "
                    f"expected {wanted.value:#010x}: another device answers at this node id"
                )
                return None
        self._step += 1
        return self._request(now)

    def _request(self, now: int) -> bytes | None:
        identity, writes = self.config.identity, self.config.writes
        if self._step < len(identity):
            wanted = identity[self._step]
            return self.client.upload(now, wanted.index, wanted.sub)
        at = self._step - len(identity)
        if at < len(writes):
            write = writes[at]
            return self.client.download(now, write.index, write.sub, write.value.to_bytes(write.size, "little"))
        self.ready = True
        return None

    def _doing(self) -> str:
        identity = self.config.identity
        if self._step < len(identity):
            wanted = identity[self._step]
            return f"reading {wanted.what} ({wanted.index:04X}:{wanted.sub:02X})"
        write = self.config.writes[self._step - len(identity)]
        return f"writing {write.value:#x} to {write.index:04X}:{write.sub:02X}"

    def wake(self, now: int, boot_deadline: int) -> bytes | None:
        """Notice time-outs; the SDO abort to send, if any."""
        if self.ready or self.failure:
            return None
        if not self.booted:
            if now >= boot_deadline:
                self.failure = (
                    f"{self.where}: no boot-up message within {BOOT_TIMEOUT_NS / 1e9:g} s of reset communication; "
                    "check power, wiring, bit rate and node id"
                )
            return None
        abort = self.client.expire(now)
        if abort is not None:
            self.failure = (
                f"{self.where}: no SDO answer within {SDO_TIMEOUT_NS / 1e9:g} s while {self._doing()}; "
                "check the device and the bus"
            )
        return abort

    @property
    def deadline(self) -> int:
        """When `wake` must be called next."""
        if self.failure:
            return NEVER
        if self.ready:
            return self.consumer.deadline
        return min(self.client.deadline, self.consumer.deadline) if self.booted else NEVER


@final
class Master(Node):
    """The master on its port 0. state: how far the start is; failure: why it failed, else empty.

    sync_at: when the next SYNC goes [ns]; SYNCs lie on whole multiples of the cycle from the loop's time 0.
    """

    def __init__(self, plan: BusPlan, slaves: tuple[SlaveConfig, ...], application: MasterApplication) -> None:
        super().__init__()
        self.plan: Final[BusPlan] = plan
        self.application: Final[MasterApplication] = application
        self.slaves: Final[list[_Slave]] = [_Slave(config) for config in slaves]
        self.sync: Final[SyncProducer] = SyncProducer(plan.sync_counter)
        self.heartbeat: Final[HeartbeatProducer] = HeartbeatProducer(MASTER_ID)
        self.state: MasterState = MasterState.RESETTING
        self.failure: str = ""
        self.boot_deadline: int = NEVER
        self.sync_at: int = NEVER
        self.supervise_at: int = POWER_UP_NS
        self.wake_at = POWER_UP_NS
        self._by_node: Final[dict[int, int]] = {config.node_id: at for at, config in enumerate(slaves)}
        self._pdo_source: Final[dict[int, tuple[int, int]]] = {}  # slave and PDO number by id
        for pdo in plan.pdos:
            if pdo.name.startswith("TPDO"):
                for at, config in enumerate(slaves):
                    self._pdo_source[pdo.base + config.node_id] = (at, int(pdo.name[4:]))

    def receive(self, now: int, port: int, frame: Frame, out: Out) -> None:
        """Any frame of the bus."""
        if frame.flags and frame.flags & (FLAG_EXTENDED | FLAG_REMOTE | FLAG_FD):
            return
        can_id = frame.can_id
        source = self._pdo_source.get(can_id)
        if source is not None:
            if self.state is _OPERATIONAL:
                application = self.application
                before = application.wake_at
                application.process_data(now, source[0], source[1], frame.data, out)
                if application.wake_at != before:
                    self._plan_wake()
            return
        at = self._by_node.get(can_id & 0x7F, -1)
        if at < 0 or self.state is MasterState.RESETTING:  # nothing is planned before the first wake-up
            return
        function = can_id & 0x780
        if function == SDO_ANSWER:
            self._send(at, self.slaves[at].answer(now, frame.data), out)
            self._advance(now, out)
        elif function == HEARTBEAT:
            self._heartbeat(now, at, frame.data, out)
        elif function == EMCY:
            emergency = decode_emcy(can_id & 0x7F, frame.data)
            if emergency is not None:
                self.application.emergency(now, at, emergency, out)
        self._plan_supervision()
        self._plan_wake()

    def wake(self, now: int, out: Out) -> None:
        """Serve every timer that is due; SYNC first, or in its place the end of a finished application."""
        application = self.application
        if now >= self.sync_at:
            if application.finished:
                self._stop(out)
            else:
                out.send(0, self.sync.next())
                self.sync_at += self.plan.cycle_ns
                application.synchronised(now, out)
        if now >= application.wake_at:
            application.wake(now, out)
        if now >= self.supervise_at:
            self._supervise(now, out)
        self._plan_wake()

    def _supervise(self, now: int, out: Out) -> None:
        """Everything slower than SYNC: heartbeats both ways, time-outs of the start."""
        if self.state is MasterState.RESETTING:
            self._reset(now, out)
        if now >= self.heartbeat.due:
            out.send(0, self.heartbeat.beat(now, NmtState.OPERATIONAL))
        if self.state is not MasterState.FAILED:
            for at, slave in enumerate(self.slaves):
                self._send(at, slave.wake(now, self.boot_deadline), out)
                if now >= slave.consumer.deadline:
                    slave.consumer.lose()
                    self.application.node_lost(now, at, out)
            self._advance(now, out)
        self._plan_supervision()

    def _stop(self, out: Out) -> None:
        """Leave: no more SYNC, all devices to Pre-operational."""
        self.sync_at = NEVER
        self.state = MasterState.STOPPED
        out.send(0, nmt_frame(NmtCommand.ENTER_PRE_OPERATIONAL, ALL_NODES))

    def _reset(self, now: int, out: Out) -> None:
        out.send(0, heartbeat_frame(MASTER_ID, NmtState.INITIALISING))
        out.send(0, nmt_frame(NmtCommand.RESET_COMMUNICATION, ALL_NODES))
        self.heartbeat.start(now, self.plan.heartbeat_ns)
        self.boot_deadline = now + BOOT_TIMEOUT_NS
        self.state = MasterState.BOOTING

    def _heartbeat(self, now: int, at: int, data: bytes, out: Out) -> None:
        slave = self.slaves[at]
        if data == b"\x00":
            if self.state is MasterState.BOOTING:
                self._send(at, slave.boot_up(now), out)
            elif self.state is MasterState.OPERATIONAL:
                self.application.rebooted(now, at, out)
            return
        before = slave.consumer.state
        slave.consumer.received(now, data)
        state = slave.consumer.state
        started = self.state is _OPERATIONAL and before == NmtState.OPERATIONAL.value
        if started and state != NmtState.OPERATIONAL.value:
            self.application.left_operational(now, at, state, out)

    def _send(self, at: int, request: bytes | None, out: Out) -> None:
        if request is not None:
            out.send(0, Frame(SDO_REQUEST + self.slaves[at].config.node_id, request))

    def _advance(self, now: int, out: Out) -> None:
        """Start everything once all devices are ready; give up when one failed."""
        if self.state is not MasterState.BOOTING:
            return
        ready = True
        for slave in self.slaves:
            if slave.failure:
                self.failure = slave.failure
                self.state = MasterState.FAILED
                self.application.failed(now, slave.failure, out)
                return
            ready = ready and slave.ready
        if ready:
            self.state = MasterState.OPERATIONAL
            out.send(0, nmt_frame(NmtCommand.START, ALL_NODES))
            for slave in self.slaves:
                slave.consumer.watch(now)
            cycle = self.plan.cycle_ns
            self.sync_at = (now // cycle + 2) * cycle  # every device has had the start command by then
            self.application.operational(now, out)

    def _plan_supervision(self) -> None:
        if self.state is MasterState.RESETTING:  # a frame came before the first wake-up: that is still to come
            return
        at = self.heartbeat.due
        if self.state is MasterState.BOOTING:
            for slave in self.slaves:
                at = min(at, slave.deadline if slave.booted else self.boot_deadline)
        elif self.state is not MasterState.FAILED:
            for slave in self.slaves:
                at = min(at, slave.consumer.deadline)
        self.supervise_at = at

    def _plan_wake(self) -> None:
        at = self.sync_at
        if self.supervise_at < at:
            at = self.supervise_at
        if self.application.wake_at < at:
            at = self.application.wake_at
        self.wake_at = at
