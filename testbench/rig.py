"""The composition root: bus plan, plant, drives, gateway and controller put together as one rig.

Two buses: the controller bus (high-level controller and the gateway's controller port) and the drive bus (the gateway's
drive port and the six drives). Everything here is wiring and the default configuration of the drives.
"""

from dataclasses import dataclass
from typing import Final

from canopen_exo.bus.loop import Loop
from canopen_exo.bus.medium import Medium
from canopen_exo.bus.wire import Wire
from canopen_exo.device import Device
from canopen_exo.eds import load_eds
from canopen_exo.master import Expected, Master, SlaveConfig, Write
from canopen_exo.od import ObjectDictionary
from canopen_exo.pdo import INVALID, key_of
from canopen_exo.plan import MASTER_ID, BusPlan, JointNode, Pdo
from fi_gateway.gateway import Gateway
from fi_gateway.injector import Injector
from hlc.controller import build_controller, paper_params
from hlc.gait import packaged_recording
from hlc.node import HighLevelController
from joint_emulators.drive import Drive
from joint_emulators.models.exoskeleton import USER_75KG, build_mjcf
from joint_emulators.motor import MOTORS
from joint_emulators.plant import Plant
from joint_emulators.rack import Rack
from joint_emulators.sensors import VELOCITY, EncoderParams

CONTROLLER_BUS: Final = 0
"""Index of the bus between high-level controller and gateway."""
DRIVE_BUS: Final = 1
"""Index of the bus between gateway and joints."""

RPDO_DEADLINE_CYCLES: Final = 10
"""Cycles without a command after which a drive drops its torque (0x1400:5)."""
HEARTBEAT_TIMEOUT_MS: Final = 300
"""Silence after which controller and drives take each other for lost (0x1016)."""


@dataclass(frozen=True, slots=True)
class RigParams:
    """What a rig is built from. stops: mechanical pins; stride_ns, duration_ns: of the motion, whole control cycles.

    has_order: transmit queues are first in, first out.
    """

    plan: BusPlan
    stops: bool
    stride_ns: int
    duration_ns: int
    has_order: bool = False


@dataclass(frozen=True, slots=True)
class Rig:
    """A rig, ready to run: the loop and the parts a bench looks at."""

    params: RigParams
    loop: Loop
    controller_bus: Medium
    drive_bus: Medium
    master: Master
    controller: HighLevelController
    gateway: Gateway
    rack: Rack


def build_rig(params: RigParams, injectors: list[Injector]) -> Rig:
    """A rig at power-up, time 0 of its loop."""
    plan = params.plan
    mjcf = build_mechanics(params)
    master, controller = build_master(params, mjcf)
    gateway = Gateway(injectors, plan.cycle_ns)
    rack = build_rack(params, mjcf)
    controller_bus = Medium("controller", CONTROLLER_BUS, plan.bitrate)
    drive_bus = Medium("drive", DRIVE_BUS, plan.bitrate)
    loop = Loop([controller_bus, drive_bus])
    loop.connect(master, [controller_bus])
    loop.connect(gateway, [controller_bus, drive_bus])
    loop.connect(rack, [drive_bus] * len(plan.joints))
    for medium in (controller_bus, drive_bus):
        for port in medium.ports if params.has_order else ():
            port.keep_order()
        gateway.join(medium)
        _install_wire(loop, medium, injectors)
    return Rig(params, loop, controller_bus, drive_bus, master, controller, gateway, rack)


def _install_wire(loop: Loop, medium: Medium, injectors: list[Injector]) -> None:
    """Let errors happen on a bus for which there are wire faults, or on which two nodes may send the same COB-ID.

    Any other one stays ideal.
    """
    faults = [one.wire for one in injectors if one.wire is not None and one.wire.bus == medium.name]
    if not faults and not any(one.adds for one in injectors):
        return
    for fault in faults:
        fault.connect(loop, medium)
    wire = Wire(medium, [])
    loop.install(wire, medium)
    for fault in faults:
        fault.install(wire)


def build_mechanics(params: RigParams) -> str:
    """The MJCF text of exoskeleton and user, which plant and controller both read."""
    return build_mjcf(USER_75KG, MOTORS, params.stops)


def build_master(params: RigParams, mjcf: str, cycles: int = -1) -> tuple[Master, HighLevelController]:
    """The high-level controller on the bus. cycles: of the motion; -1 for the duration in `params`."""
    plan = params.plan
    names = tuple(joint.name for joint in plan.joints)
    law = build_controller(paper_params(names, plan.cycle_ns, params.stride_ns), names, packaged_recording(), mjcf)
    controller = HighLevelController(plan, law, params.duration_ns // plan.cycle_ns if cycles < 0 else cycles)
    return Master(plan, tuple(_slave(plan, joint) for joint in plan.joints), controller), controller


def build_rack(params: RigParams, mjcf: str) -> Rack:
    """The drives on their plant; drive k sends on port k."""
    plan = params.plan
    pattern = ObjectDictionary(load_eds())
    devices, drives = [], []
    for port, joint in enumerate(plan.joints):
        unit = {key_of(0x6076, 0): joint.rated_torque_mnm, key_of(0x608F, 1): joint.encoder_counts}
        od = pattern.copy_for_node(joint.node_id, unit)
        drive = Drive(od, EncoderParams(joint.encoder_counts, 0, 1), VELOCITY)
        drives.append(drive)
        devices.append(Device(od, joint.node_id, drive, port))
    return Rack(Plant(mjcf, tuple(joint.name for joint in plan.joints)), devices, drives)


def _pdo_writes(plan: BusPlan, pdo: Pdo, joint: JointNode) -> list[Write]:
    """A PDO as the plan has it, by the standard procedure: not valid, no entries, entries, their number, valid.

    A PDO that goes with every n-th SYNC is staggered over the drives: its SYNC start value is the node id.
    """
    number, cob_id = int(pdo.name[4:]) - 1, pdo.base + joint.node_id
    transmits = pdo.name.startswith("T")
    comm, mapping = (0x1800, 0x1A00) if transmits else (0x1400, 0x1600)
    writes = [Write(comm + number, 1, INVALID | cob_id, 4), Write(comm + number, 2, pdo.every, 1)]
    if transmits:
        writes.append(Write(comm + number, 6, joint.node_id if pdo.every > 1 else 0, 1))
    else:
        writes.append(Write(comm + number, 5, max(1, RPDO_DEADLINE_CYCLES * plan.cycle_ns // 1_000_000), 2))
    writes.append(Write(mapping + number, 0, 0, 1))
    for sub, mapped in enumerate(pdo.content, 1):
        writes.append(Write(mapping + number, sub, mapped.index << 16 | mapped.sub << 8 | mapped.length, 4))
    writes.append(Write(mapping + number, 0, len(pdo.content), 1))
    writes.append(Write(comm + number, 1, cob_id, 4))
    return writes


def _slave(plan: BusPlan, joint: JointNode) -> SlaveConfig:
    """What the controller expects of a drive, and how it configures it."""
    pattern = ObjectDictionary(load_eds()).values
    heartbeat_ms = plan.heartbeat_ns // 1_000_000
    cycle_us = plan.cycle_ns // 1000
    return SlaveConfig(
        joint.name,
        joint.node_id,
        (
            Expected(0x1000, 0, pattern[key_of(0x1000, 0)], "device type"),
            Expected(0x1018, 1, pattern[key_of(0x1018, 1)], "vendor id"),
            Expected(0x1018, 2, pattern[key_of(0x1018, 2)], "product code"),
            Expected(0x6076, 0, joint.rated_torque_mnm, "rated torque [mN m]"),
            Expected(0x608F, 1, joint.encoder_counts, "encoder counts per revolution"),
        ),
        (
            Write(0x1017, 0, heartbeat_ms, 2),
            Write(0x1016, 1, MASTER_ID << 16 | HEARTBEAT_TIMEOUT_MS, 4),
            Write(0x1006, 0, 0, 4),  # 0x1019 may only change while 0x1006 is 0
            Write(0x1019, 0, plan.sync_counter, 1),
            Write(0x1006, 0, cycle_us, 4),
            *(write for pdo in plan.pdos for write in _pdo_writes(plan, pdo, joint)),
            Write(0x1029, 1, 1, 1),
            Write(0x6007, 0, 2, 2),
            Write(0x6060, 0, 10, 1),
        ),
        HEARTBEAT_TIMEOUT_MS * 1_000_000,
    )
