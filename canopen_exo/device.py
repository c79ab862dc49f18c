"""A CANopen device: the state machines of CiA 301 put together around one object dictionary.

Source: CiA 301, 7.3.2.2 (services per NMT state, table 38). What the device is for (a drive) is its Application.
Leaves out: LSS, node guarding, block SDO, TIME, store and restore.
"""

from typing import Final, final

from mypy_extensions import mypyc_attr

from canopen_exo.bus.frame import FLAG_EXTENDED, FLAG_FD, FLAG_REMOTE, Frame
from canopen_exo.bus.node import MS, NEVER, ErrorState, Node, Out, PortState
from canopen_exo.emcy import (
    BUS_OFF_LEFT,
    COMMUNICATION_BIT,
    ERROR_PASSIVE,
    HEARTBEAT_LOST,
    OVERRUN,
    PDO_TOO_LONG,
    PDO_TOO_SHORT,
    RPDO_TIMEOUT,
    SYNC_LENGTH,
    SYNC_LOST,
    EmcyProducer,
)
from canopen_exo.heartbeat import HeartbeatConsumer, HeartbeatProducer, heartbeat_frame
from canopen_exo.nmt import NmtCommand, NmtSlave, NmtState, decode_nmt
from canopen_exo.od import ObjectDictionary, WriteObserver
from canopen_exo.pdo import PDO_COUNT, ReceivePdo, TransmitPdo, key_of
from canopen_exo.plan import HEARTBEAT, SDO_ANSWER, SDO_REQUEST, SYNC
from canopen_exo.sdo import SdoServer
from canopen_exo.sync import SyncConsumer
from canopen_exo.write_rules import check_write

BOOT_NS: Final = 5 * MS
"""Time from reset to the boot-up message (assumed)."""

SYNC_LOSS_CYCLES: Final = 5
"""SYNC periods (0x1006) of silence after which SYNC counts as lost (this project's drives)."""

ERROR_REGISTER: Final = key_of(0x1001, 0)


@mypyc_attr(allow_interpreted_subclasses=True)
class Application(WriteObserver):
    """What a device does beyond communication; `check` and `written` see every SDO write to its objects."""

    def reset(self, now: int) -> None:
        """Power-up or NMT reset: start from the object dictionary's defaults."""

    def applied(self, now: int) -> None:
        """Process data reached the object dictionary (with SYNC, or at once)."""

    def latch(self, now: int) -> None:
        """SYNC: put the present inputs into the object dictionary, before the transmit PDOs read them."""

    def left_operational(self, now: int) -> None:
        """The device is no longer Operational: process data no longer comes."""

    def communication_lost(self, now: int, code: int) -> None:
        """A communication error (EMCY code) that the device must react to; object 0x6007 says how."""

    def errors_gone(self) -> None:
        """The last error is gone (EMCY 0000)."""


@final
class Device(Node):
    """One CANopen device on its port 0. Serves everything by `receive` and `wake`; never raises on received bytes.

    port: the port it sends on (a rack of devices gives each its own). malformed: NMT messages of a wrong length.
    revision: counts changes of what it listens to. is_off: its controller is bus-off.
    """

    def __init__(self, od: ObjectDictionary, node_id: int, application: Application, port: int = 0) -> None:
        super().__init__()
        self.port: Final[int] = port
        self.revision: int = 0
        self.is_off: bool = False
        self.now: int = 0
        self.od: Final[ObjectDictionary] = od
        self.node_id: Final[int] = node_id
        self.application: Final[Application] = application
        self.nmt: NmtSlave = NmtSlave()
        self.sdo: SdoServer = SdoServer(od, node_id)
        self.emcy: Final[EmcyProducer] = EmcyProducer(node_id)
        self.heartbeat: Final[HeartbeatProducer] = HeartbeatProducer(node_id)
        self._all_tpdos: Final[list[TransmitPdo]] = [TransmitPdo(od, number) for number in range(PDO_COUNT)]
        self._all_rpdos: Final[list[ReceivePdo]] = [ReceivePdo(od, number) for number in range(PDO_COUNT)]
        self.tpdos: list[TransmitPdo] = []
        self.rpdos: list[ReceivePdo] = []
        self.rpdo_by_id: dict[int, ReceivePdo] = {}
        self.consumers: list[HeartbeatConsumer] = []
        self.sync_consumer: SyncConsumer = SyncConsumer(0, 0)
        self.operational: bool = False
        self.malformed: int = 0
        self.boot_at: int = 0
        self.wake_at = 0
        od.observer = _Rules(self)
        self._reset(0, NmtCommand.RESET_NODE)

    # --- receiving -----------------------------------------------------------------------------------------------

    def cob_ids(self) -> list[int]:
        """Ids this device listens to at present: NMT, SYNC, SDO request, RPDOs, consumed heartbeats."""
        ids = [0, SYNC, SDO_REQUEST + self.node_id, *self.rpdo_by_id]
        for consumer in self.consumers:
            ids.append(HEARTBEAT + consumer.node_id)
        return ids

    def receive(self, now: int, port: int, frame: Frame, out: Out) -> None:
        """Any frame of the bus."""
        if frame.flags and frame.flags & (FLAG_EXTENDED | FLAG_REMOTE | FLAG_FD):
            return
        can_id, data = frame.can_id, frame.data
        rpdo = self.rpdo_by_id.get(can_id)
        if rpdo is not None:
            if not rpdo.is_steady or len(data) != rpdo.size or self.emcy.active or not rpdo.synchronous:
                self._process_data(now, rpdo, data, out)
            else:  # as nearly always
                rpdo.pending = data
                rpdo.last = now
            return
        if can_id == SYNC:
            self.synchronise(now, data, out)
            return
        self.now = now
        if self.nmt.state is NmtState.INITIALISING:
            return
        if can_id == SDO_REQUEST + self.node_id:
            if self.nmt.state is not NmtState.STOPPED:
                answer = self.sdo.request(now, data)
                if answer is not None:
                    out.send(self.port, Frame(SDO_ANSWER + self.node_id, answer))
        elif can_id == 0:
            self._command(now, data, out)
        elif can_id >= HEARTBEAT:
            self._heartbeat(now, can_id - HEARTBEAT, data)
        self._interface_works()
        self._send_emcy(now, out)
        self._plan_wake()

    def _heartbeat(self, now: int, node_id: int, data: bytes) -> None:
        """A heartbeat came; the error is gone when no producer is lost any more."""
        lost = False
        for consumer in self.consumers:
            if consumer.node_id == node_id:
                consumer.received(now, data)
            lost = lost or consumer.lost
        if not lost:
            self.emcy.vanish(HEARTBEAT_LOST)

    def synchronise(self, now: int, data: bytes, out: Out) -> None:
        """SYNC came (as by `receive`): apply what pends, latch, send the PDOs that are due."""
        if not self.operational:
            return
        consumer = self.sync_consumer
        if consumer.is_steady and len(data) == consumer.size:
            consumer.last = now
        elif not consumer.received(now, data):
            self.emcy.occur(SYNC_LENGTH, COMMUNICATION_BIT)
            self._send_emcy(now, out)
            self._plan_wake()
            return
        elif consumer.deadline < self.wake_at:
            self.wake_at = consumer.deadline
        if self.emcy.active:
            self.emcy.vanish(SYNC_LENGTH)
            self.emcy.vanish(SYNC_LOST)
            self._interface_works()
            self._send_emcy(now, out)
            self._plan_wake()
        applied = False
        for rpdo in self.rpdos:
            if rpdo.pending is not None and rpdo.apply(self.od):
                applied = True
        application = self.application
        if applied:
            application.applied(now)
        application.latch(now)
        counter = data[0] if data else 0
        values = self.od.values
        for tpdo in self.tpdos:
            if tpdo.always or tpdo.on_sync(counter):
                out.send(self.port, tpdo.frame(values))

    def _process_data(self, now: int, rpdo: ReceivePdo, data: bytes, out: Out) -> None:
        """An RPDO came."""
        if not self.operational:
            return
        code = rpdo.received(now, data)
        if code:
            self.emcy.occur(code, COMMUNICATION_BIT)
        if self.emcy.active:
            self._rpdo_errors_gone()
            self._send_emcy(now, out)
            self._plan_wake()
        if not rpdo.synchronous and rpdo.apply(self.od):
            self.application.applied(now)
        if rpdo.deadline < self.wake_at:
            self.wake_at = rpdo.deadline

    def _rpdo_errors_gone(self) -> None:
        """An error of RPDOs is gone when none of them has it any more."""
        late, short, long = False, False, False
        for rpdo in self.rpdos:
            late = late or rpdo.late
            short = short or rpdo.wrong == PDO_TOO_SHORT
            long = long or rpdo.wrong == PDO_TOO_LONG
        if not late:
            self.emcy.vanish(RPDO_TIMEOUT)
        if not short:
            self.emcy.vanish(PDO_TOO_SHORT)
        if not long:
            self.emcy.vanish(PDO_TOO_LONG)

    # --- the CAN controller ------------------------------------------------------------------------------------------

    def port_changed(self, now: int, state: PortState, out: Out) -> None:
        """Error states of the controller: bus-off acts at once and is told when it is left (8140).

        Error passive is 8120, objects lost are 8110; 0x6007 and 0x1029 say what they lead to.
        """
        self.now = now
        off = state.state is ErrorState.BUS_OFF or (self.is_off and state.state is ErrorState.DOWN)
        if off and not self.is_off:
            self._react(now, BUS_OFF_LEFT, out)
        elif self.is_off and not off:
            self.emcy.occur(BUS_OFF_LEFT, COMMUNICATION_BIT)
        self.is_off = off
        if state.state is ErrorState.ERROR_PASSIVE:
            if ERROR_PASSIVE not in self.emcy.active:
                self._communication_error(now, ERROR_PASSIVE, out)
        elif not off:
            self.emcy.vanish(ERROR_PASSIVE)
        if state.overrun and OVERRUN not in self.emcy.active:
            self._communication_error(now, OVERRUN, out)
        if not off:
            self._send_emcy(now, out)
        self._plan_wake()

    def _interface_works(self) -> None:
        """A frame has come: what was lost through the controller is over."""
        if self.emcy.active:
            self.emcy.vanish(BUS_OFF_LEFT)
            self.emcy.vanish(OVERRUN)

    # --- time ----------------------------------------------------------------------------------------------------

    def wake(self, now: int, out: Out) -> None:
        """Serve every timer that is due."""
        if now >= self.boot_at:
            self.boot_at = NEVER
            out.send(self.port, heartbeat_frame(self.node_id, NmtState.INITIALISING))
            self.nmt.initialised()
            self.heartbeat.start(now, self.od.values[key_of(0x1017, 0)] * MS)
        if now >= self.heartbeat.due:
            out.send(self.port, self.heartbeat.beat(now, self.nmt.state))
        for consumer in self.consumers:
            if now >= consumer.deadline:
                consumer.lose()
                self._communication_error(now, HEARTBEAT_LOST, out)
        if self.sync_consumer.wake(now):
            self._communication_error(now, SYNC_LOST, out)
        for rpdo in self.rpdos:
            if rpdo.wake(now):
                self._communication_error(now, RPDO_TIMEOUT, out)
        if now >= self.sdo.deadline:
            answer = self.sdo.expire(now)
            if answer is not None:
                out.send(self.port, Frame(SDO_ANSWER + self.node_id, answer))
        if self.emcy.queue:
            self._send_emcy(now, out)
        self._plan_wake()

    def _plan_wake(self) -> None:
        at = min(self.boot_at, self.heartbeat.due, self.sync_consumer.deadline, self.sdo.deadline)
        if self.emcy.queue and self._may_send_emcy():
            at = min(at, self.emcy.due)
        for consumer in self.consumers:
            if consumer.deadline < at:
                at = consumer.deadline
        for rpdo in self.rpdos:
            if rpdo.deadline < at:
                at = rpdo.deadline
        self.wake_at = at

    # --- errors --------------------------------------------------------------------------------------------------

    def error(self, now: int, code: int, class_bit: int, out: Out) -> None:
        """The application reports an error: EMCY, error register, history."""
        if self.emcy.occur(code, class_bit):
            self._send_emcy(now, out)
            self._plan_wake()

    def clear_errors(self, now: int, out: Out) -> None:
        """All errors are gone (fault reset)."""
        self.emcy.clear()
        self._send_emcy(now, out)
        self._plan_wake()

    def _communication_error(self, now: int, code: int, out: Out) -> None:
        """EMCY, the reaction of 0x6007 (application) and of 0x1029:1 (NMT state)."""
        self.emcy.occur(code, COMMUNICATION_BIT)
        self._send_emcy(now, out)  # before 1029 may stop the device
        self._react(now, code, out)

    def _react(self, now: int, code: int, out: Out) -> None:
        """What the objects 0x6007 (application) and 0x1029:1 (NMT state) say."""
        self.application.communication_lost(now, code)
        behaviour = self.od.values[key_of(0x1029, 1)]
        if behaviour == 0 and self.operational:
            self._apply_command(now, NmtCommand.ENTER_PRE_OPERATIONAL, out)
        elif behaviour == 2:
            self._apply_command(now, NmtCommand.STOP, out)

    def _may_send_emcy(self) -> bool:
        """CiA 301, table 38: in Pre-operational and Operational; else messages wait."""
        return self.nmt.state is not NmtState.INITIALISING and self.nmt.state is not NmtState.STOPPED

    def _send_emcy(self, now: int, out: Out) -> None:
        if not self._may_send_emcy():
            return
        while self.emcy.due <= now:
            frame = self.emcy.wake(now)
            if frame is not None:
                out.send(self.port, frame)
        self._publish_errors()

    def _publish_errors(self) -> None:
        """Objects 0x1001 and 0x1003 show what the EMCY producer knows."""
        register = self.emcy.register
        if register == 0 and self.od.values[ERROR_REGISTER]:
            self.application.errors_gone()
        self.od.set(ERROR_REGISTER, register)
        history = self.emcy.history
        self.od.set(key_of(0x1003, 0), len(history))
        for at in range(len(history)):
            self.od.set(key_of(0x1003, at + 1), history[at])

    # --- NMT and configuration -----------------------------------------------------------------------------------

    def _command(self, now: int, data: bytes, out: Out) -> None:
        command = decode_nmt(data, self.node_id)
        if command is None:
            if len(data) != 2:
                self.malformed += 1
            return
        self._apply_command(now, command, out)

    def _apply_command(self, now: int, command: NmtCommand, out: Out) -> None:
        was_operational = self.operational
        if not self.nmt.command(command):
            return
        self.operational = self.nmt.state is NmtState.OPERATIONAL
        if was_operational and not self.operational:
            for rpdo in self.rpdos:
                rpdo.stop()
            self.sync_consumer.stop()
            self.application.left_operational(now)
        if self.nmt.state is NmtState.INITIALISING:
            self._reset(now, command)
        elif self.nmt.state is NmtState.STOPPED:
            self.sdo.stop()
        elif self.operational:
            for tpdo in self.tpdos:
                tpdo.restart()

    def _reset(self, now: int, command: NmtCommand) -> None:
        """Reset node: all objects; reset communication: 0x1000..0x1FFF. The boot-up message ends it."""
        self.emcy.active.clear()
        self.emcy.queue.clear()
        self.emcy.history.clear()
        self._publish_errors()
        if command is NmtCommand.RESET_NODE:
            self.od.reset()
            self.application.reset(now)
        else:
            self.od.reset(communication_only=True)
        self.emcy.inhibit_ns = self.od.values[key_of(0x1015, 0)] * 100_000  # multiples of 100 us
        self.sdo = SdoServer(self.od, self.node_id)
        self.nmt = NmtSlave()
        self.heartbeat.start(now, 0)
        self.boot_at = now + BOOT_NS
        self.configure_sync()
        self.configure_pdos()
        self.configure_consumers()
        self._plan_wake()

    def configure_sync(self) -> None:
        """Read 0x1019 and 0x1006 anew."""
        period_ns = self.od.values[key_of(0x1006, 0)] * 1000
        self.sync_consumer = SyncConsumer(self.od.values[key_of(0x1019, 0)], SYNC_LOSS_CYCLES * period_ns)

    def configure_pdos(self, index: int = 0) -> None:
        """Read the PDO that has this object anew, all with 0; `tpdos` and `rpdos` are the active ones."""
        for number in range(PDO_COUNT):
            if index in (0, 0x1800 + number, 0x1A00 + number):
                self._all_tpdos[number] = TransmitPdo(self.od, number)
            if index in (0, 0x1400 + number, 0x1600 + number):
                self._all_rpdos[number] = ReceivePdo(self.od, number)
        self.tpdos = [tpdo for tpdo in self._all_tpdos if tpdo.active]
        self.rpdos = [rpdo for rpdo in self._all_rpdos if rpdo.active]
        self.rpdo_by_id = {rpdo.cob_id: rpdo for rpdo in self.rpdos}
        self.revision += 1

    def configure_consumers(self) -> None:
        """Read 0x1016 anew: node id in bits 16-23, time [ms] in bits 0-15."""
        self.consumers = []
        for sub in range(1, self.od.values[key_of(0x1016, 0)] + 1):
            word = self.od.values[key_of(0x1016, sub)]
            if 1 <= word >> 16 & 0xFF <= 127 and word & 0xFFFF:
                self.consumers.append(HeartbeatConsumer(word >> 16 & 0xFF, (word & 0xFFFF) * MS))
        self.revision += 1


@final
class _Rules(WriteObserver):
    """What an SDO write may do to a running device, and what follows from it; the application is asked too."""

    def __init__(self, device: Device) -> None:
        self.device: Final[Device] = device

    def check(self, key: int, raw: int) -> int:
        """The abort code, 0 when the write may happen."""
        return check_write(self.device.od, key, raw) or self.device.application.check(key, raw)

    def written(self, key: int, raw: int) -> None:
        """Carry the new value to where it acts."""
        device, index = self.device, key >> 8
        if index == 0x1017:
            if device.nmt.state is not NmtState.INITIALISING:
                device.heartbeat.start(device.now, raw * MS)
        elif index == 0x1015:
            device.emcy.inhibit_ns = raw * 100_000  # multiples of 100 us
        elif index == 0x1003:
            device.emcy.history.clear()
        elif index in (0x1006, 0x1019):
            device.configure_sync()
        elif index == 0x1016:
            device.configure_consumers()
        elif 0x1400 <= index < 0x1C00:
            device.configure_pdos(index)
        else:
            device.application.written(key, raw)
