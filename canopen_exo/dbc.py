"""The bus plan as a DBC file, for tools that show decoded frames (SavvyCAN, Kayak, python-can viewers, cantools).

One message per PDO with its signals in SI units, and the frames around them: SYNC, NMT, EMCY, heartbeats, HLC status.
Sources: CiA 301 (7.2.8 NMT and heartbeat, 7.2.5 SYNC, 7.2.7 EMCY) for the layouts; the plan for everything else.
Signal and message names are those of `canopen_exo.signal.Signal`, so `right_knee_TPDO1.position` means the same here,
in a scenario and in the file. Leaves out: SDO, whose eight bytes have no fixed meaning a DBC could give.
"""

from collections import OrderedDict
from typing import TYPE_CHECKING, Final

from canopen_exo import plan as ids
from canopen_exo.plan import BusPlan, JointNode, Pdo
from canopen_exo.signal import Signal

if TYPE_CHECKING:
    from cantools.database.can import Message
    from cantools.database.can import Signal as DbcSignal

CONTROLLER: Final = "HLC"
"""DBC node name of the high-level controller."""

NMT_STATES: Final = ((0, "boot_up"), (4, "stopped"), (5, "operational"), (127, "pre_operational"))
"""CiA 301, heartbeat: state byte."""

NMT_COMMANDS: Final = (
    (1, "start"),
    (2, "stop"),
    (128, "enter_pre_operational"),
    (129, "reset_node"),
    (130, "reset_communication"),
)
"""CiA 301, NMT: command byte."""

HLC_STATES: Final = ((ids.STATUS_STARTING, "starting"), (ids.STATUS_MOTION, "motion"), (ids.STATUS_STOPPED, "stopped"))

Choices = tuple[tuple[int, str], ...]


def dbc_text(plan: BusPlan) -> str:
    """The DBC file of a plan, with line feeds as line ends. Imports cantools."""
    from cantools.database.can import Database, Node

    messages = _services(plan)
    signals = plan.signals()
    for joint in plan.joints:
        for pdo in plan.pdos:
            name = f"{joint.name}_{pdo.name}"
            messages.append(_pdo(plan, joint, pdo, [signal for signal in signals if signal.message == name]))
    nodes = [Node(CONTROLLER, "high-level controller, CANopen master")]
    nodes += [Node(joint.name, f"drive, node id {joint.node_id}") for joint in plan.joints]
    database = Database(messages=messages, nodes=nodes, version="")
    text: str = database.as_dbc_string(sort_signals=_by_start)
    return text.replace("\r\n", "\n").rstrip("\n") + "\n"


def _by_start(signals: list["DbcSignal"]) -> list["DbcSignal"]:
    return sorted(signals, key=lambda signal: signal.start)


def _pdo(plan: BusPlan, joint: JointNode, pdo: Pdo, signals: list[Signal]) -> "Message":
    """The message of one PDO of one joint."""
    to_drive = pdo.name.startswith("R")
    receivers = [joint.name if to_drive else CONTROLLER]
    bits = sum(signal.length for signal in signals)
    every = "every SYNC" if pdo.every == 1 else f"every {pdo.every}th SYNC"
    return _message(
        pdo.base + joint.node_id,
        f"{joint.name}_{pdo.name}",
        (bits + 7) // 8,
        CONTROLLER if to_drive else joint.name,
        [
            _signal(
                signal.name,
                signal.start,
                signal.length,
                receivers,
                signed=signal.signed,
                scale=signal.scale,
                unit=signal.unit,
                comment=f"object {signal.index:04X}:{signal.sub:02X}",
            )
            for signal in signals
        ],
        f"{pdo.name} of node {joint.node_id}, {every} ({plan.cycle_ns * pdo.every / 1e6:g} ms)",
    )


def _services(plan: BusPlan) -> list["Message"]:
    """NMT, SYNC, HLC status, and EMCY and heartbeat of every node."""
    drives = [joint.name for joint in plan.joints]
    counter = [_signal("sync_counter", 0, 8, drives, comment="object 1019: counts 1..overflow")]
    messages = [
        _message(
            ids.NMT,
            "NMT",
            2,
            CONTROLLER,
            [
                _signal("nmt_command", 0, 8, drives, choices=NMT_COMMANDS),
                _signal("nmt_node", 8, 8, drives, comment="node id, 0 for all"),
            ],
            "network management command",
        ),
        _message(
            ids.SYNC,
            "SYNC",
            1 if plan.sync_counter else 0,
            CONTROLLER,
            counter if plan.sync_counter else [],
            f"every {plan.cycle_ns / 1e6:g} ms",
        ),
        _message(
            ids.HLC_STATUS,
            "HLC_status",
            5,
            CONTROLLER,
            [
                _signal("state", 0, 8, drives, choices=HLC_STATES),
                _signal("cycle", 8, 16, drives, comment="SYNCs since time 0, modulo 65536"),
                _signal("phase", 24, 16, drives, scale=1 / 65536, unit="stride", comment="gait phase"),
            ],
            f"at time 0 and with every {ids.STATUS_EVERY}th SYNC",
        ),
        _heartbeat(CONTROLLER, ids.MASTER_ID, drives, plan),
    ]
    for joint in plan.joints:
        messages.append(
            _message(
                ids.EMCY + joint.node_id,
                f"{joint.name}_EMCY",
                8,
                joint.name,
                [
                    _signal("emcy_error_code", 0, 16, [CONTROLLER], comment="object 603F"),
                    _signal("emcy_error_register", 16, 8, [CONTROLLER], comment="object 1001"),
                    _signal("emcy_manufacturer", 24, 40, [CONTROLLER]),
                ],
                "emergency; error code 0: no error any more",
            )
        )
        messages.append(_heartbeat(joint.name, joint.node_id, [CONTROLLER], plan))
    return messages


def _heartbeat(sender: str, node_id: int, receivers: list[str], plan: BusPlan) -> "Message":
    return _message(
        ids.HEARTBEAT + node_id,
        f"{sender}_heartbeat",
        1,
        sender,
        [_signal("nmt_state", 0, 8, receivers, choices=NMT_STATES)],
        f"every {plan.heartbeat_ns / 1e6:g} ms; boot-up once",
    )


def _message(can_id: int, name: str, size: int, sender: str, signals: list["DbcSignal"], comment: str) -> "Message":
    from cantools.database.can import Message

    return Message(can_id, name, size, signals, comment=comment, senders=[sender])


def _signal(
    name: str,
    start: int,
    length: int,
    receivers: list[str],
    *,
    signed: bool = False,
    scale: float = 1,
    unit: str = "",
    comment: str | None = None,
    choices: Choices = (),
) -> "DbcSignal":
    from cantools.database.can import Signal as DbcSignal
    from cantools.database.conversion import BaseConversion

    scale = int(scale) if scale == int(scale) else scale  # a plain number has whole limits
    low = -(1 << (length - 1)) if signed else 0
    high = (1 << (length - (1 if signed else 0))) - 1
    return DbcSignal(
        name,
        start,
        length,
        "little_endian",
        signed,
        conversion=BaseConversion.factory(scale, 0, OrderedDict(choices) if choices else None),
        minimum=low * scale,
        maximum=high * scale,
        unit=unit or None,
        comment=comment,
        receivers=receivers,
    )
