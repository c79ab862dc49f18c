"""The whole device against the `canopen` package: a CANopen master and a CiA 402 master that were not written here.

No thread, no socket, no sleeping: the bus hands every frame to the device, and its answers back, before `send` returns.
"""

# mypy: disable-error-code="no-untyped-call"
# (parts of the canopen package have no types)

import io
import struct
from importlib import resources
from typing import Protocol

import canopen
import pytest
from canopen.profiles.p402 import BaseNode402, State402
from hypothesis import given
from hypothesis import strategies as st

from canopen_exo.bus.frame import Frame
from canopen_exo.bus.node import MS, Out
from canopen_exo.cia402 import DriveState, decode_statusword
from canopen_exo.device import Application, Device
from canopen_exo.eds import load_eds
from canopen_exo.nmt import NmtState
from canopen_exo.od import ObjectDictionary
from joint_emulators.drive import Drive
from joint_emulators.sensors import ENCODER, VELOCITY

NODE = 5
RATED = {0x607600: 54900}
PATTERN = ObjectDictionary(load_eds())


class Message(Protocol):
    arbitration_id: int
    data: bytearray


class Bus(Out):
    """The bus as both sides see it, and the only clock."""

    channel_info = "in memory"

    def __init__(self, device: Device) -> None:
        self.device = device
        self.now = 0
        self.network = canopen.Network(self)  # type: ignore[arg-type] # all it needs of a bus is send(message)

    def send(self, port: int | Message, frame: Frame | None = None) -> None:
        """From the canopen package one message, from the device port and frame."""
        if frame is None:
            assert not isinstance(port, int)
            self.device.receive(self.now, 0, Frame(port.arbitration_id, bytes(port.data)), self)
        else:
            self.network.notify(frame.can_id, bytearray(frame.data), self.now / 1e9)

    def run(self, until: int) -> None:
        """Serve the device's timers up to and including `until`."""
        while self.device.wake_at <= until:
            self.now = self.device.wake_at
            self.device.wake(self.now, self)
        self.now = until


def description() -> canopen.ObjectDictionary:
    source = io.StringIO(resources.files("dbc").joinpath("exo_joint.eds").read_text(encoding="ascii"))
    source.name = "exo_joint.eds"
    return canopen.import_od(source, NODE)


DESCRIPTION = description()


def rig() -> tuple[Bus, canopen.RemoteNode]:
    """A device in Pre-operational and the canopen package's node for it."""
    od = PATTERN.copy_for_node(NODE, RATED)
    bus = Bus(Device(od, NODE, Application()))
    node = bus.network.add_node(NODE, DESCRIPTION)
    bus.run(10 * MS)
    return bus, node


# --- NMT, heartbeat ----------------------------------------------------------------------------------------------


def test_master_sees_the_boot_up() -> None:
    """The boot-up message makes the node Pre-operational, and known to the scanner."""
    bus, node = rig()
    assert node.nmt.state == "PRE-OPERATIONAL"
    assert bus.network.scanner.nodes == [NODE]


@pytest.mark.parametrize("state", ["OPERATIONAL", "STOPPED", "PRE-OPERATIONAL"])
@pytest.mark.parametrize("broadcast", [False, True])
def test_heartbeat_confirms_what_the_master_commands(state: str, broadcast: bool) -> None:
    """NMT command to one node or to all; the heartbeat, not the command, says where the node is."""
    bus, node = rig()
    heard: list[int] = []
    node.nmt.add_heartbeat_callback(heard.append)
    (bus.network.nmt if broadcast else node.nmt).state = state
    bus.run(110 * MS)
    assert heard == [{"OPERATIONAL": 5, "STOPPED": 4, "PRE-OPERATIONAL": 127}[state]]
    assert node.nmt.state == state


@pytest.mark.parametrize("command", ["RESET", "RESET COMMUNICATION"])
def test_reset_ends_with_a_boot_up(command: str) -> None:
    """Both resets: the next message of the node is its boot-up."""
    bus, node = rig()
    node.nmt.state = "OPERATIONAL"
    heard: list[int] = []
    node.nmt.add_heartbeat_callback(heard.append)
    node.nmt.state = command
    bus.run(50 * MS)
    assert heard == [0]
    assert node.nmt.state == "PRE-OPERATIONAL"
    assert bus.device.nmt.state is NmtState.PRE_OPERATIONAL


def test_heartbeat_period_written_over_sdo_is_heard() -> None:
    """Object 1017 by its name in the EDS."""
    bus, node = rig()
    node.sdo["Producer heartbeat time"].raw = 20
    heard: list[int] = []
    node.nmt.add_heartbeat_callback(heard.append)
    bus.run(111 * MS)
    assert heard == [127] * 5


def test_stopped_node_does_not_answer_sdo() -> None:
    """The canopen package times out, as on a real bus; nothing is left over for the next transfer."""
    _, node = rig()
    node.nmt.state = "STOPPED"
    node.sdo.RESPONSE_TIMEOUT = 0.0  # an answer would be there already: waiting shows nothing
    with pytest.raises(canopen.SdoCommunicationError):
        node.sdo.upload(0x1000, 0)
    node.nmt.state = "PRE-OPERATIONAL"
    assert node.sdo["Device type"].raw == 0x00020192


# --- EMCY --------------------------------------------------------------------------------------------------------


def test_emergencies_are_decoded_and_reset() -> None:
    """Code, register and the reset by 0000."""
    bus, node = rig()
    bus.device.error(bus.now, 0x2310, 0x02, bus)
    bus.device.error(bus.now, 0x8611, 0x20, bus)
    assert [(entry.code, entry.register, entry.data) for entry in node.emcy.active] == [
        (0x2310, 0x03, bytes(5)),
        (0x8611, 0x23, bytes(5)),
    ]
    assert [entry.get_desc() for entry in node.emcy.active] == ["Current", "Monitoring"]
    assert [node.sdo["Pre-defined error field"][sub].raw for sub in (1, 2)] == [0x8611, 0x2310]
    bus.device.clear_errors(bus.now, bus)
    assert node.emcy.active == []
    assert node.sdo["Error register"].raw == 0


def test_lost_heartbeat_of_the_master_is_reported() -> None:
    """Object 1016 written by the canopen package, then silence: EMCY 8130."""
    bus, node = rig()
    node.sdo[0x1016][1].raw = 127 << 16 | 50
    bus.network.send_message(0x77F, b"\5")
    bus.run(59 * MS)
    assert node.emcy.log == []
    bus.run(60 * MS)
    assert [(entry.code, entry.register) for entry in node.emcy.active] == [(0x8130, 0x11)]


# --- PDO ---------------------------------------------------------------------------------------------------------


def test_pdo_configuration_is_read_from_the_device() -> None:
    """`pdo.read()`: COB-IDs, types and mappings of the bus plan."""
    _, node = rig()
    node.pdo.read()
    assert {
        number: (pdo.enabled, pdo.cob_id & 0x7FF, pdo.trans_type, [variable.index for variable in pdo])
        for number, pdo in node.tpdo.items()
    } == {
        1: (True, 0x185, 1, [0x6064, 0x606C]),
        2: (True, 0x285, 10, [0x6041, 0x6077, 0x603F]),
        3: (False, 0x385, 1, []),
        4: (False, 0x485, 1, []),
    }
    assert {
        number: (pdo.enabled, pdo.cob_id & 0x7FF, pdo.trans_type, [variable.index for variable in pdo])
        for number, pdo in node.rpdo.items()
    } == {
        1: (True, 0x205, 1, [0x6040, 0x6071]),
        2: (False, 0x305, 255, []),
        3: (False, 0x405, 255, []),
        4: (False, 0x505, 255, []),
    }


@given(
    position=st.integers(-(2**31), 2**31 - 1),
    velocity=st.integers(-(2**31), 2**31 - 1),
    status=st.integers(0, 0xFFFF),
    torque=st.integers(-32768, 32767),
)
def test_tpdos_are_decoded_by_the_canopen_package(position: int, velocity: int, status: int, torque: int) -> None:
    """SYNC, then the values of the object dictionary come out of the other side's PDO code."""
    bus, node = rig()
    node.pdo.read()
    node.nmt.state = "OPERATIONAL"
    for key, value in ((0x606400, position), (0x606C00, velocity), (0x604100, status), (0x607700, torque)):
        bus.device.od.set(key, value)
    for counter in range(1, NODE + 1):
        bus.network.sync.transmit(counter)
    assert (node.tpdo[1][0x6064].raw, node.tpdo[1][0x606C].raw) == (position, velocity)
    assert (node.tpdo[2][0x6041].raw, node.tpdo[2][0x6077].raw, node.tpdo[2][0x603F].raw) == (status, torque, 0)


@pytest.mark.long
@given(controlword=st.integers(0, 0xFFFF), torque=st.integers(-32768, 32767))
def test_rpdo_of_the_canopen_package_reaches_the_objects_with_sync(controlword: int, torque: int) -> None:
    """Type 1: transmitted at once, applied with the next SYNC."""
    bus, node = rig()
    node.pdo.read()
    node.nmt.state = "OPERATIONAL"
    node.rpdo[1]["Controlword"].raw = controlword
    node.rpdo[1]["Target torque"].raw = torque
    node.rpdo[1].transmit()
    assert (bus.device.od.value(0x604000), bus.device.od.value(0x607100)) == (0, 0)
    bus.network.sync.transmit(1)
    assert (bus.device.od.value(0x604000), bus.device.od.value(0x607100)) == (controlword, torque)


MAPPABLE = ["Statusword", "Error code", "Position actual value", "Velocity actual value", "Torque actual value"]


@pytest.mark.parametrize("operational", [False, True])
@pytest.mark.parametrize(
    "names", [MAPPABLE[:1], MAPPABLE[:3], MAPPABLE[2:4], [*MAPPABLE[:2], MAPPABLE[3]], ["Torque actual value"] * 4]
)
@pytest.mark.parametrize("number", [1, 3])
def test_tpdo_is_remapped_by_the_canopen_package(operational: bool, names: list[str], number: int) -> None:
    """`save()`: disable, :0 = 0, entries, :0 = n, enable; in Pre-operational and in Operational; then SYNC."""
    bus, node = rig()
    node.pdo.read()
    if operational:
        node.nmt.state = "OPERATIONAL"
    pdo = node.tpdo[number]
    pdo.clear()
    for name in names:
        pdo.add_variable(name)
    pdo.cob_id, pdo.trans_type, pdo.enabled = 0x1F5, 2, True
    pdo.save()
    node.nmt.state = "OPERATIONAL"
    values = {name: -3 - at if "actual" in name else 0x1234 + at for at, name in enumerate(MAPPABLE)}
    for name, value in values.items():
        bus.device.od.set(DESCRIPTION[name].index << 8, value)
    bus.network.sync.transmit(1)
    assert not pdo.is_received
    bus.network.sync.transmit(2)
    assert pdo.is_received
    assert [variable.raw for variable in pdo] == [values[name] for name in names]


def test_rpdo_is_remapped_by_the_canopen_package() -> None:
    """A second command PDO of type 255: applied at once."""
    bus, node = rig()
    node.pdo.read()
    pdo = node.rpdo[2]
    pdo.clear()
    for name in ("Max torque", "Modes of operation"):
        pdo.add_variable(name)
    pdo.cob_id, pdo.trans_type, pdo.enabled = 0x305, 255, True
    pdo.save()
    node.nmt.state = "OPERATIONAL"
    pdo["Max torque"].raw = 700
    pdo["Modes of operation"].raw = 0
    pdo.transmit()
    assert (bus.device.od.value(0x607200), bus.device.od.value(0x606000)) == (700, 0)


def test_mapping_that_is_too_long_is_refused() -> None:
    """06040042 reaches the canopen package's caller."""
    _, node = rig()
    node.pdo.read()
    pdo = node.tpdo[1]
    pdo.clear()
    for name in ("Position actual value", "Velocity actual value", "Statusword"):
        pdo.add_variable(name)
    with pytest.raises(canopen.SdoAbortedError) as caught:
        pdo.save()
    assert caught.value.code == 0x06040042


# --- CiA 402 -----------------------------------------------------------------------------------------------------


def test_both_readings_of_the_statusword_agree() -> None:
    """All 65536 words against the masks of the canopen package; its names are ours in other letters."""
    for word in range(65536):
        found = [name for name, (mask, bits) in State402.SW_MASK.items() if word & mask == bits]
        state = decode_statusword(word)
        assert found == ([] if state is None else [state.name.replace("_", " ")]), hex(word)


def drive_rig(pdos: bool) -> tuple[Bus, Drive, BaseNode402]:
    """A drive and the canopen package's CiA 402 master, over SDO or over PDOs without SYNC for commands."""
    od = PATTERN.copy_for_node(NODE, RATED)
    drive = Drive(od, ENCODER, VELOCITY)
    bus = Bus(Device(od, NODE, drive))
    node = BaseNode402(NODE, DESCRIPTION)
    for limit in ("SWITCH_OP_MODE", "SWITCH_STATE_SINGLE", "SWITCH_STATE_FINAL", "CHECK_TPDO"):
        setattr(node, f"TIMEOUT_{limit}", 60.0)  # 0.2 to 0.8 s otherwise: a machine that is busy pauses that long
    bus.network.add_node(node)
    bus.run(10 * MS)
    node.pdo.read()
    for pdo in node.pdo.values() if not pdos else node.tpdo.values():
        pdo.enabled = False
        pdo.save()
    if pdos:
        node.rpdo[1].trans_type = 255
        node.rpdo[1].save()
        node.tpdo[2].enabled = False
    node.setup_402_state_machine(read_pdos=True)
    node.nmt.state = "OPERATIONAL"
    return bus, drive, node


@pytest.mark.parametrize("pdos", [False, True], ids=["SDO", "RPDO"])
def test_canopen_package_enables_and_disables_the_drive(pdos: bool) -> None:
    """Its state machine walks ours: up to Operation enabled, and down by each way."""
    _, drive, node = drive_rig(pdos)
    assert node.state == "SWITCH ON DISABLED"
    for target in ("READY TO SWITCH ON", "SWITCHED ON", "OPERATION ENABLED", "SWITCHED ON", "READY TO SWITCH ON"):
        node.state = target
        assert drive.machine.state.name.replace("_", " ") == node.state == target
    node.state = "OPERATION ENABLED"
    node.state = "SWITCH ON DISABLED"
    assert drive.machine.state is DriveState.SWITCH_ON_DISABLED


@pytest.mark.parametrize("pdos", [False, True], ids=["SDO", "RPDO"])
def test_canopen_package_makes_the_drive_push(pdos: bool) -> None:
    """Enabled in cyclic synchronous torque: the target torque in per mille of rated becomes N m."""
    bus, drive, node = drive_rig(pdos)
    assert node.op_mode == "CYCLIC SYNCHRONOUS TORQUE"
    node.state = "OPERATION ENABLED"
    if pdos:
        node.rpdo[1]["Target torque"].raw = -500
        node.rpdo[1].transmit()
    else:
        node.sdo["Target torque"].raw = -500
    assert drive.torque_nm == pytest.approx(-0.5 * 54.9, rel=1e-12)  # two roundings
    assert bus.device.od.value(0x607400) == -500
    node.state = "SWITCHED ON"
    assert drive.torque_nm == 0.0


def test_canopen_package_resets_a_fault() -> None:
    """Heartbeat lost with 6007 = 1: Fault, which no reset ends while the heartbeat is lost; when it is back, the
    master's own sequence resets it on the edge and enables again."""
    bus, drive, node = drive_rig(False)
    node.sdo["Abort connection option code"].raw = 1
    node.sdo[0x1016][1].raw = 127 << 16 | 50
    node.state = "OPERATION ENABLED"
    bus.network.send_message(0x77F, b"\5")
    bus.run(200 * MS)
    assert (node.state, node.is_faulted()) == ("FAULT", True)
    assert node.sdo["Error code"].raw == 0x8130
    assert drive.torque_nm == 0.0
    node.TIMEOUT_RESET_FAULT = 0.0  # it would wait for a reset that only its next step commands
    for controlword in (State402.CW_DISABLE_VOLTAGE, 0x80, State402.CW_DISABLE_VOLTAGE):
        node.controlword = controlword
        assert (node.state, node.sdo["Error code"].raw, node.sdo["Error register"].raw) == ("FAULT", 0x8130, 0x11)
    bus.network.send_message(0x77F, b"\5")
    assert (node.state, node.sdo["Error code"].raw, node.sdo["Error register"].raw) == ("FAULT", 0x8130, 0)
    node.reset_from_fault()
    assert node.state == "OPERATION ENABLED"
    assert node.sdo["Error code"].raw == 0


def test_supported_modes_are_understood() -> None:
    """Object 6502: the canopen package takes torque for supported, and refuses position before it asks the drive."""
    _, _, node = drive_rig(False)
    assert node.is_op_mode_supported("CYCLIC SYNCHRONOUS TORQUE")
    with pytest.raises(TypeError, match="not suppported"):
        node.op_mode = "PROFILED POSITION"


def test_drive_that_is_stopped_by_nmt_drops_its_torque() -> None:
    """6007 = 2 (default): leaving Operational disables the drive, whoever commands it."""
    _, drive, node = drive_rig(False)
    node.state = "OPERATION ENABLED"
    node.sdo["Target torque"].raw = 300
    assert drive.torque_nm > 0
    node.nmt.state = "PRE-OPERATIONAL"
    assert drive.torque_nm == 0.0
    assert node.sdo["Statusword"].raw & 0x6F == 0x40


def test_tpdo2_shows_the_state_of_the_drive_after_sync() -> None:
    """Statusword over the default PDO: what the drive shows is what the canopen package reads."""
    bus, drive, node = drive_rig(False)
    node.tpdo[2].enabled = True
    node.tpdo[2].save()
    node.sdo["Controlword"].raw = 6
    for counter in range(1, NODE + 1):
        bus.network.sync.transmit(counter)
    word = node.tpdo[2]["Statusword"].raw
    assert word == drive.machine.statusword
    assert struct.pack("<H", word) == bytes(node.tpdo[2].data[:2])
    assert decode_statusword(word) is DriveState.READY_TO_SWITCH_ON
