"""Which frames, and which bits in them, an injector's `target:` means on a given bus plan.

Directions: TPDOs, EMCY, heartbeats and SDO answers of the joints travel to the controller; SYNC, NMT, RPDOs, SDO
requests and the controller's own status and heartbeat to the drives (CiA 301, 7.3.5).
Left out: masks, `kind`, extended ids.
"""

import re
from dataclasses import dataclass
from typing import Annotated, ClassVar, Final, Literal, TypeAlias

from pydantic import BeforeValidator, PlainSerializer, PlainValidator, WithJsonSchema

from canopen_exo.plan import (
    EMCY,
    HEARTBEAT,
    HLC_STATUS,
    MASTER_ID,
    NMT,
    SDO_ANSWER,
    SDO_REQUEST,
    SYNC,
    BusPlan,
    JointNode,
    Pdo,
)
from canopen_exo.signal import Signal
from fi_gateway.boundary import SpecError, SpecModel, Text
from fi_gateway.marked_yaml import did_you_mean
from fi_gateway.quantity import describe_value

TO_CONTROLLER: Final = "to_controller"
TO_DRIVES: Final = "to_drives"

_HEX: Final = re.compile(r"0x[0-9a-fA-F]{1,8}", re.ASCII)


def _cob_id(given: object) -> int:
    """0x185, as a number or a text."""
    if isinstance(given, str) and "/" in given:
        raise ValueError(f"masks ({given!r}) are not available yet; give one COB-ID, such as 0x185")
    if isinstance(given, str) and _HEX.fullmatch(given):
        given = int(given, 16)
    if not isinstance(given, int) or isinstance(given, bool):
        raise ValueError(f"expected a COB-ID such as 0x185; got {describe_value(given)}")
    if not 0 <= given <= 0x7FF:
        raise ValueError(f"COB-ID {given:#x} is outside 0x0..0x7ff, the 11-bit ids")
    return given


def _signal_name(given: object) -> str:
    """position, right_knee_TPDO1.position, or an object: 0x6064."""
    if isinstance(given, int) and not isinstance(given, bool):
        return f"0x{given:04X}"
    if not isinstance(given, str) or not given:
        raise ValueError(f"expected a signal such as position or 0x6064; got {describe_value(given)}")
    return f"0x{int(given, 16):04X}" if _HEX.fullmatch(given) else given


CobId: TypeAlias = Annotated[
    int, BeforeValidator(_cob_id), PlainSerializer(lambda value: f"0x{value:03X}"), WithJsonSchema({"type": "integer"})
]
SignalName: TypeAlias = Annotated[str, PlainValidator(_signal_name), WithJsonSchema({"type": ["string", "integer"]})]


@dataclass(frozen=True, slots=True)
class TargetSpec(SpecModel):
    """`target:` of an injector. bus: the direction of travel; then node with signal or pdo, pdo alone, or cob_id."""

    later: ClassVar[tuple[str, ...]] = ("kind",)

    bus: Literal["to_controller", "to_drives", "both"]
    node: Text | None = None
    pdo: Text | None = None
    cob_id: CobId | None = None
    signal: SignalName | None = None


@dataclass(frozen=True, slots=True)
class Place:
    """A target on the bus. signal: None for whole frames; size: payload bytes, -1 when the plan does not know.

    words: for people, such as "position of right_knee (0x185, to_controller)"; name: for records, such as
    "right_knee.TPDO1"; known: whether the plan has such frames.
    """

    to_controller: bool
    to_drives: bool
    cob_ids: tuple[int, ...]
    signal: Signal | None
    size: int
    words: str
    name: str
    known: bool = True


def resolve(target: TargetSpec, plan: BusPlan) -> Place:
    """The frames and bits a target means; raises SpecError when there is none, more than one, or the other way."""
    joint = None
    if target.node is not None:
        joint = _joint(target.node, plan)
    pdo = _pdo(target.pdo, plan) if target.pdo is not None else None
    if target.cob_id is not None and (joint is not None or pdo is not None):
        key = "node" if joint is not None else "pdo"
        raise SpecError((key,), f"give either cob_id or {key}, not both")
    if target.signal is not None:
        return _signal_place(target, plan)
    if target.cob_id is not None:
        return _frame_place(target, target.cob_id, plan)
    if pdo is None:
        names = ", ".join(dict.fromkeys(mapped.name for pdo in plan.pdos for mapped in pdo.content))
        pdos = ", ".join(pdo.name for pdo in plan.pdos)
        raise SpecError((), f"which frames? add signal ({names}), pdo ({pdos}) or cob_id")
    direction = TO_CONTROLLER if pdo.name.startswith("T") else TO_DRIVES
    joints = (joint,) if joint is not None else plan.joints
    cob_ids = tuple(pdo.base + one.node_id for one in joints)
    what = f"{pdo.name} of {joint.name if joint is not None else 'every joint'}"
    return _place(target, direction, cob_ids, None, _pdo_size(pdo), what)


def _joint(name: str, plan: BusPlan) -> JointNode:
    names = [joint.name for joint in plan.joints]
    if name not in names:
        hint = did_you_mean(name, names)
        raise SpecError(("node",), f"unknown joint {name!r}{hint} (this rig has {', '.join(names)})")
    return plan.joint(name)


def _pdo(name: str, plan: BusPlan) -> Pdo:
    for pdo in plan.pdos:
        if pdo.name == name:
            return pdo
    names = [pdo.name for pdo in plan.pdos]
    raise SpecError(("pdo",), f"unknown PDO {name!r}{did_you_mean(name, names)} (this rig has {', '.join(names)})")


def _pdo_size(pdo: Pdo) -> int:
    return (sum(mapped.length for mapped in pdo.content) + 7) // 8


def _signal_place(target: TargetSpec, plan: BusPlan) -> Place:
    wanted = target.signal or ""
    around = [
        signal
        for signal in plan.signals()
        if (target.node is None or signal.node == target.node)
        and (target.pdo is None or signal.message == f"{signal.node}_{target.pdo}")
        and (target.cob_id is None or signal.cob_id == target.cob_id)
    ]
    found = [signal for signal in around if wanted in _names(signal)]
    if not found:
        names = list(dict.fromkeys(signal.name for signal in around))
        if not names:
            raise SpecError(("cob_id",), f"no signals are mapped into COB-ID {target.cob_id:#x}; leave signal out")
        raise SpecError(
            ("signal",), f"unknown signal {wanted!r}{did_you_mean(wanted, names)} (allowed: {', '.join(names)})"
        )
    if len(found) > 1:
        nodes = list(dict.fromkeys(signal.node for signal in found))
        if len(nodes) > 1:
            raise SpecError(("signal",), f"{wanted} of which joint? add node: {' | '.join(nodes)}")
        pdos = [signal.message.removeprefix(f"{signal.node}_") for signal in found]
        raise SpecError(("signal",), f"{wanted} is in several PDOs of {nodes[0]}; add pdo: {' | '.join(pdos)}")
    signal = found[0]
    pdo = next(pdo for pdo in plan.pdos if signal.message == f"{signal.node}_{pdo.name}")
    direction = TO_CONTROLLER if pdo.name.startswith("T") else TO_DRIVES
    return _place(target, direction, (signal.cob_id,), signal, _pdo_size(pdo), f"{signal.name} of {signal.node}")


def _names(signal: Signal) -> tuple[str, ...]:
    """What a signal may be called in a file."""
    return signal.name, f"{signal.message}.{signal.name}", f"0x{signal.index:04X}"


def _frame_place(target: TargetSpec, cob_id: int, plan: BusPlan) -> Place:
    direction, size, what = _frame(cob_id, plan)
    return _place(target, direction, (cob_id,), None, size, what)


def _frame(cob_id: int, plan: BusPlan) -> tuple[str, int, str]:
    """(direction, "" when unknown; payload bytes, -1 when unknown; name) of the frames of one COB-ID."""
    fixed = {NMT: "NMT", SYNC: "SYNC", HLC_STATUS: "HLC status", HEARTBEAT + MASTER_ID: "heartbeat of the controller"}
    sizes = {NMT: 2, SYNC: 1 if plan.sync_counter else 0, HLC_STATUS: 5, HEARTBEAT + MASTER_ID: 1}
    if cob_id in fixed:
        return TO_DRIVES, sizes[cob_id], fixed[cob_id]
    for joint in plan.joints:
        for pdo in plan.pdos:
            if cob_id == pdo.base + joint.node_id:
                direction = TO_CONTROLLER if pdo.name.startswith("T") else TO_DRIVES
                return direction, _pdo_size(pdo), f"{pdo.name} of {joint.name}"
        services = (
            (EMCY, TO_CONTROLLER, 8, "EMCY"),
            (SDO_ANSWER, TO_CONTROLLER, 8, "SDO answer"),
            (SDO_REQUEST, TO_DRIVES, 8, "SDO request"),
            (HEARTBEAT, TO_CONTROLLER, 1, "heartbeat"),
        )
        for base, direction, size, name in services:
            if cob_id == base + joint.node_id:
                return direction, size, f"{name} of {joint.name}"
    return "", -1, "frames"


def _place(
    target: TargetSpec, direction: str, cob_ids: tuple[int, ...], signal: Signal | None, size: int, what: str
) -> Place:
    if direction and target.bus not in (direction, "both"):
        raise SpecError(("bus",), f"{what} does not travel {target.bus}; write bus: {direction}")
    ids = f"0x{cob_ids[0]:03X}" if len(cob_ids) == 1 else f"0x{cob_ids[0]:03X}..0x{cob_ids[-1]:03X}"
    way = "both ways" if target.bus == "both" else target.bus
    thing, _, owner = what.partition(" of ")
    return Place(
        target.bus != TO_DRIVES,
        target.bus != TO_CONTROLLER,
        cob_ids,
        signal,
        size,
        f"{what} ({ids}, {way})",
        f"{owner.removeprefix('the ')}.{thing}" if owner and owner != "every joint" else f"{thing} {ids}",
        direction != "",
    )
