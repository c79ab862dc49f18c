"""Which frames, and which bits in them, an injector's `target:` means on a given bus plan.

Directions: TPDOs, EMCY, heartbeats and SDO answers of the joints travel to the controller; SYNC, NMT, RPDOs, SDO
requests and the controller's own status and heartbeat to the drives (CiA 301, 7.3.5).
Left out: extended ids.
"""

import re
from dataclasses import dataclass, replace
from typing import Annotated, Final, Literal, TypeAlias

from pydantic import Field, PlainSerializer, PlainValidator, WithJsonSchema

from canopen_exo.bus.node import SECOND
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
from fi_gateway.boundary import Count, Flag, SpecError, SpecModel, Text, Whole
from fi_gateway.marked_yaml import did_you_mean
from fi_gateway.quantity import describe_value

TO_CONTROLLER: Final = "to_controller"
TO_DRIVES: Final = "to_drives"

_HEX: Final = re.compile(r"0x[0-9a-fA-F]{1,8}", re.ASCII)
ALL_BITS: Final = 0x7FF

CONTROLLER: Final = "controller"
"""`node` of the controller's own heartbeat."""

GATEWAY: Final = "gateway"
WIRE_CONTROLLER: Final = "controller"
WIRE_DRIVE: Final = "drive"
"""`wire` of a target: the bus between high-level controller and gateway, and that between gateway and drives."""

WIRE_WORDS: Final = "bit_error, stuck_dominant, no_ack, bit_error_rate, gilbert_elliott, bus_off, babbling_idiot"

KINDS: Final = {
    "sdo_request": (SDO_REQUEST, TO_DRIVES, 8, "SDO request"),
    "sdo_answer": (SDO_ANSWER, TO_CONTROLLER, 8, "SDO answer"),
    "emcy": (EMCY, TO_CONTROLLER, 8, "EMCY"),
    "heartbeat": (HEARTBEAT, TO_CONTROLLER, 1, "heartbeat"),
}
"""Services of each joint: COB-ID without node id, direction, payload bytes, name (CiA 301, 7.3.5)."""


def cob_id(given: object) -> int:
    """0x185, as a number or a text; raises ValueError."""
    if isinstance(given, str) and _HEX.fullmatch(given):
        given = int(given, 16)
    if not isinstance(given, int) or isinstance(given, bool):
        raise ValueError(f"expected a COB-ID such as 0x185; got {describe_value(given)}")
    if not 0 <= given <= ALL_BITS:
        raise ValueError(f"COB-ID {given:#x} is outside 0x0..0x7ff, the 11-bit ids")
    return given


def _masked(given: object) -> tuple[int, int]:
    """0x185, or with a mask 0x180/0x780: (COB-ID, mask)."""
    if isinstance(given, str) and "/" in given:
        number, _, mask = given.partition("/")
        if not (_HEX.fullmatch(number) and _HEX.fullmatch(mask)):
            raise ValueError(f"expected a COB-ID with a mask such as 0x180/0x780; got {given!r}")
        found = cob_id(number), cob_id(mask)
        if found[0] & ~found[1]:
            raise ValueError(f"{given}: bits {found[0] & ~found[1]:#x} are not in the mask, so no COB-ID has them")
        return found
    return cob_id(given), ALL_BITS


def _show_masked(value: tuple[int, int]) -> str:
    return f"0x{value[0]:03X}" if value[1] == ALL_BITS else f"0x{value[0]:03X}/0x{value[1]:03X}"


def _signal_name(given: object) -> str:
    """position, right_knee_TPDO1.position, or an object: 0x6064."""
    if isinstance(given, int) and not isinstance(given, bool):
        return f"0x{given:04X}"
    if not isinstance(given, str) or not given:
        raise ValueError(f"expected a signal such as position or 0x6064; got {describe_value(given)}")
    return f"0x{int(given, 16):04X}" if _HEX.fullmatch(given) else given


CobIds: TypeAlias = Annotated[
    tuple[int, int],
    PlainValidator(_masked),
    PlainSerializer(_show_masked),
    WithJsonSchema({"type": ["integer", "string"]}),
]
SignalName: TypeAlias = Annotated[str, PlainValidator(_signal_name), WithJsonSchema({"type": ["string", "integer"]})]


@dataclass(frozen=True, slots=True)
class BitsSpec(SpecModel):
    """`bits:` of a target: a raw range, little endian, bit 0 is the lowest of byte 0."""

    start: Annotated[Whole, Field(ge=0, le=63)]
    length: Annotated[Count, Field(le=64)]
    signed: Flag = False

    def words(self) -> str:
        """For people."""
        last = self.start + self.length - 1
        return f"bit {last}" if self.length == 1 else f"bits {self.start}..{last}"


@dataclass(frozen=True, slots=True)
class TargetSpec(SpecModel):
    """`target:` of an injector. bus: the direction of travel.

    Then which frames: node with signal or pdo, pdo alone, kind with or without node, or cob_id; and which bits in them:
    signal, bits, or all.
    For a wire fault: the bus on which it acts (default: the drives'), and who sends what it acts on: frames as above,
    all frames of a node, or with neither whatever is sent; a direction of travel may be given and need not.
    """

    bus: Literal["to_controller", "to_drives", "both"] | None = None
    wire: Literal["controller", "drive"] | None = None
    node: Text | None = None
    pdo: Text | None = None
    kind: Literal["sdo_request", "sdo_answer", "emcy", "heartbeat", "sync", "nmt"] | None = None
    cob_id: CobIds | None = None
    signal: SignalName | None = None
    bits: BitsSpec | None = None


@dataclass(frozen=True, slots=True)
class Place:
    """A target on the bus. signal: None for whole frames; size: payload bytes, -1 when the plan does not know.

    words: for people, such as "position of right_knee (0x185, to_controller)"; name: for records, such as
    "right_knee.TPDO1"; known: whether the plan has such frames.
    wire: the bus on which a wire fault acts, "" for other faults; nodes: on that bus, by number of their port; node:
    the one named, "" for none; senders: ports whose frames are meant, as a mask; bit_ns: one bit.
    """

    to_controller: bool
    to_drives: bool
    cob_ids: tuple[int, ...]
    signal: Signal | None
    size: int
    words: str
    name: str
    known: bool = True
    wire: str = ""
    nodes: tuple[str, ...] = ()
    node: str = ""
    senders: int = -1
    bit_ns: int = 0


def wire_nodes(wire: str, plan: BusPlan) -> tuple[str, ...]:
    """Who is on that bus, by number of the port."""
    if wire == WIRE_CONTROLLER:
        return CONTROLLER, GATEWAY
    return GATEWAY, *(joint.name for joint in plan.joints)


def resolve_wire(target: TargetSpec, plan: BusPlan) -> Place:
    """The attempts to send that a wire fault's target means; raises SpecError."""
    for key in ("signal", "bits"):
        if getattr(target, key) is not None:
            raise SpecError((key,), f"wire faults act on frames, not on what is in them; leave {key} out")
    wire = target.wire or WIRE_DRIVE
    nodes = wire_nodes(wire, plan)
    on_bus = f"on the {wire} bus"
    if target.pdo is None and target.kind is None and target.cob_id is None:
        node = target.node or ""
        if node and node not in nodes:
            hint = did_you_mean(node, nodes)
            raise SpecError(("node",), f"{node!r} is not {on_bus}{hint} (there are {', '.join(nodes)})")
        words, name = (f"{node} {on_bus}", f"{node}.{wire} bus") if node else (f"the {wire} bus", f"{wire} bus")
        place = Place(True, True, (), None, -1, words, name)
        place = replace(place, node=node, senders=1 << nodes.index(node) if node else -1)
    else:
        place = resolve(replace(target, bus=target.bus or "both", wire=None), plan)
        place = replace(place, words=f"{place.words} {on_bus}", name=f"{place.name}@{wire}", node=target.node or "")
    if target.bus in (TO_DRIVES, TO_CONTROLLER):
        # on both buses port 0 is the side of the controller
        place = replace(place, senders=place.senders & (1 if target.bus == TO_DRIVES else ~1))
        if not place.senders:
            raise SpecError(("bus",), f"{place.words} sends nothing {target.bus}; leave bus out")
    return replace(place, wire=wire, nodes=nodes, bit_ns=SECOND // plan.bitrate)


def resolve(target: TargetSpec, plan: BusPlan) -> Place:
    """The frames and bits a target means; raises SpecError when there is none, more than one, or the other way."""
    if target.wire is not None:
        raise SpecError(("wire",), f"only wire faults ({WIRE_WORDS}) act on a bus; other faults act in the gateway")
    if target.bus is None:
        raise SpecError(("bus",), f"missing; needed: bus, which is {TO_CONTROLLER}, {TO_DRIVES} or both")
    if target.node is not None and not (target.node == CONTROLLER and target.kind == "heartbeat"):
        _joint(target.node, plan)
    if target.pdo is not None:
        _pdo(target.pdo, plan)
    chosen = [key for key in ("cob_id", "kind", "pdo") if getattr(target, key) is not None]
    if target.cob_id is not None and target.node is not None:
        raise SpecError(("node",), "give either cob_id or node, not both")
    if len(chosen) > 1:
        raise SpecError((chosen[1],), f"give either {chosen[0]} or {chosen[1]}, not both")
    if target.signal is not None and target.bits is not None:
        raise SpecError(("bits",), "give either signal or bits, not both")
    if target.signal is not None:
        return _signal_place(target, plan)
    if target.cob_id is not None:
        place = _cob_id_place(target, target.cob_id, plan)
    elif target.kind is not None:
        place = _kind_place(target, target.kind, plan)
    elif target.pdo is not None:
        place = _pdo_place(target, target.pdo, plan)
    else:
        names = ", ".join(dict.fromkeys(mapped.name for pdo in plan.pdos for mapped in pdo.content))
        pdos = ", ".join(pdo.name for pdo in plan.pdos)
        raise SpecError((), f"which frames? add signal ({names}), pdo ({pdos}), kind or cob_id")
    return place if target.bits is None else _bits_place(target.bits, place)


def _bits_place(bits: BitsSpec, place: Place) -> Place:
    """That range of bits in frames of one COB-ID."""
    if len(place.cob_ids) != 1:
        raise SpecError(
            ("bits",),
            f"bits are those of one COB-ID, {place.name} has {len(place.cob_ids)}; add node, or give one cob_id",
        )
    last = bits.start + bits.length - 1
    most = 8 * place.size if place.size >= 0 else 64
    if last >= most:
        raise SpecError(
            ("bits",), f"there is no bit {last}; {place.words} has {f'bits 0..{most - 1}' if most else 'no bits'}"
        )
    name = bits.words()
    signal = Signal(name, place.name, "", place.cob_ids[0], bits.start, bits.length, bits.signed, 1.0, "", 0, 0)
    return replace(place, signal=signal, words=f"{name} of {place.words}", name=f"{place.name}.{name}")


def _pdo_place(target: TargetSpec, name: str, plan: BusPlan) -> Place:
    """A PDO of one joint, or of every one."""
    pdo = _pdo(name, plan)
    direction = TO_CONTROLLER if pdo.name.startswith("T") else TO_DRIVES
    joints = (plan.joint(target.node),) if target.node is not None else plan.joints
    cob_ids = tuple(pdo.base + one.node_id for one in joints)
    what = f"{pdo.name} of {target.node if target.node is not None else 'every joint'}"
    return _place(target, direction, cob_ids, None, _pdo_size(pdo), what)


def _kind_place(target: TargetSpec, kind: str, plan: BusPlan) -> Place:
    """A service of one node, or of every joint; SYNC and NMT are the controller's."""
    if kind in ("sync", "nmt"):
        if target.node is not None:
            raise SpecError(("node",), f"kind: {kind} is the controller's alone; leave node out")
        return _cob_id_place(target, (SYNC if kind == "sync" else NMT, ALL_BITS), plan)
    base, direction, size, name = KINDS[kind]
    if target.node == CONTROLLER:
        return _cob_id_place(target, (HEARTBEAT + MASTER_ID, ALL_BITS), plan)
    joints = (plan.joint(target.node),) if target.node is not None else plan.joints
    cob_ids = tuple(base + one.node_id for one in joints)
    what = f"{name} of {target.node if target.node is not None else 'every joint'}"
    return _place(target, direction, cob_ids, None, size, what)


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
    frames = None
    if target.kind is not None:
        frames = _kind_place(replace(target, bus="both"), target.kind, plan).cob_ids
    around = [
        signal
        for signal in (*plan.signals(), *service_signals(plan))
        if (target.node is None or signal.node == target.node)
        and (target.pdo is None or signal.message == f"{signal.node}_{target.pdo}")
        and (target.cob_id is None or signal.cob_id & target.cob_id[1] == target.cob_id[0])
        and (frames is None or signal.cob_id in frames)
    ]
    found = [signal for signal in around if wanted in signal_names(signal)]
    if not found:
        names = list(dict.fromkeys(signal.name for signal in around))
        if not names and target.cob_id is not None:
            raise SpecError(
                ("cob_id",), f"no signals are mapped into COB-ID {_show_masked(target.cob_id)}; give bits, or the frame"
            )
        raise SpecError(
            ("signal",),
            f"unknown signal {wanted!r}{did_you_mean(wanted, names)} (allowed: {', '.join(names) or 'none'})",
        )
    if len(found) > 1:
        nodes = list(dict.fromkeys(signal.node for signal in found))
        if len(nodes) > 1:
            raise SpecError(("signal",), f"{wanted} of which joint? add node: {' | '.join(nodes)}")
        pdos = [signal.message.removeprefix(f"{signal.node}_") for signal in found]
        raise SpecError(("signal",), f"{wanted} is in several PDOs of {nodes[0]}; add pdo: {' | '.join(pdos)}")
    signal = found[0]
    direction, size, _ = _frame(signal.cob_id, plan)
    return _place(target, direction, (signal.cob_id,), signal, size, f"{signal.name} of {signal.node}")


def signal_names(signal: Signal) -> tuple[str, ...]:
    """What a signal may be called in a file."""
    names = signal.name, f"{signal.message}.{signal.name}"
    return (*names, f"0x{signal.index:04X}") if signal.index else names


def service_signals(plan: BusPlan) -> list[Signal]:
    """What lies in the frames that are no PDOs, named as in the DBC (`canopen_exo.dbc`)."""
    found = [
        *_signals("NMT", CONTROLLER, NMT, (("nmt_command", 0, 8), ("nmt_node", 8, 8))),
        *_signals("SYNC", CONTROLLER, SYNC, (("sync_counter", 0, 8),) if plan.sync_counter else ()),
        *_signals("HLC_status", CONTROLLER, HLC_STATUS, (("state", 0, 8), ("cycle", 8, 16))),
        Signal("phase", CONTROLLER, "HLC_status", HLC_STATUS, 24, 16, False, 1 / 65536, "stride", 0, 0),
        *_signals("HLC_heartbeat", CONTROLLER, HEARTBEAT + MASTER_ID, (("nmt_state", 0, 8),)),
    ]
    emergency = (("emcy_error_code", 0, 16), ("emcy_error_register", 16, 8), ("emcy_manufacturer", 24, 40))
    for joint in plan.joints:
        found += _signals(f"{joint.name}_EMCY", joint.name, EMCY + joint.node_id, emergency)
        found += _signals(f"{joint.name}_heartbeat", joint.name, HEARTBEAT + joint.node_id, (("nmt_state", 0, 8),))
    return found


def _signals(message: str, node: str, number: int, fields: tuple[tuple[str, int, int], ...]) -> list[Signal]:
    """Plain numbers. fields: name, first bit, length."""
    return [Signal(name, node, message, number, start, length, False, 1.0, "", 0, 0) for name, start, length in fields]


def _cob_id_place(target: TargetSpec, given: tuple[int, int], plan: BusPlan) -> Place:
    """Frames of one COB-ID, or of all that a mask leaves."""
    number, mask = given
    if mask == ALL_BITS:
        direction, size, what = _frame(number, plan)
        return _place(target, direction, (number,), None, size, what)
    cob_ids = tuple(one for one in range(ALL_BITS + 1) if one & mask == number)
    known = [frame for frame in (_frame(one, plan) for one in cob_ids) if frame[0]]
    ways = {direction for direction, _, _ in known}
    sizes = {size for _, size, _ in known} if len(known) == len(cob_ids) else set()
    direction, size = ways.pop() if len(ways) == 1 else "", sizes.pop() if len(sizes) == 1 else -1
    place = _place(target, direction, cob_ids, None, size, "frames", _show_masked(given))
    return replace(place, known=bool(known))


def direction_of(number: int, plan: BusPlan) -> str:
    """Which way the frames of one COB-ID travel: TO_CONTROLLER or TO_DRIVES, "" when the plan has none."""
    return _frame(number, plan)[0]


def _frame(number: int, plan: BusPlan) -> tuple[str, int, str]:
    """(direction, "" when unknown; payload bytes, -1 when unknown; name) of the frames of one COB-ID."""
    fixed = {NMT: "NMT", SYNC: "SYNC", HLC_STATUS: "HLC status", HEARTBEAT + MASTER_ID: "heartbeat of the controller"}
    sizes = {NMT: 2, SYNC: 1 if plan.sync_counter else 0, HLC_STATUS: 5, HEARTBEAT + MASTER_ID: 1}
    if number in fixed:
        return TO_DRIVES, sizes[number], fixed[number]
    for joint in plan.joints:
        for pdo in plan.pdos:
            if number == pdo.base + joint.node_id:
                direction = TO_CONTROLLER if pdo.name.startswith("T") else TO_DRIVES
                return direction, _pdo_size(pdo), f"{pdo.name} of {joint.name}"
        for base, direction, size, name in KINDS.values():
            if number == base + joint.node_id:
                return direction, size, f"{name} of {joint.name}"
    return "", -1, "frames"


def _place(
    target: TargetSpec,
    direction: str,
    cob_ids: tuple[int, ...],
    signal: Signal | None,
    size: int,
    what: str,
    ids: str = "",
) -> Place:
    if direction and target.bus not in (direction, "both"):
        raise SpecError(("bus",), f"{what} does not travel {target.bus}; write bus: {direction}")
    if not ids:
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
