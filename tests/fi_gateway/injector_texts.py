"""Injectors written in flow style, read, refused or built."""

from typing import Final

import pytest

from canopen_exo.bus.frame import Frame
from canopen_exo.plan import BusPlan, JointNode
from fi_gateway.boundary import validate
from fi_gateway.injector import Injector
from fi_gateway.marked_yaml import FileErrors, parse
from fi_gateway.outlet import Tray
from fi_gateway.schema import InjectorSpec, build_injectors, check_injectors

NAMES: Final = ("left_hip", "left_knee", "left_ankle", "right_hip", "right_knee", "right_ankle")
PLAN: Final = BusPlan(tuple(JointNode(name, number, 54_900, 131_072) for number, name in enumerate(NAMES, 1)))
SECOND: Final = 1_000_000_000

POSITION: Final = "{bus: to_controller, node: right_knee, signal: position}"
VELOCITY: Final = "{bus: to_controller, node: right_knee, signal: velocity}"
TPDO1: Final = "{bus: to_controller, node: right_knee, pdo: TPDO1}"


def injector(
    fault: str = "{type: stuck_at}",
    target: str = POSITION,
    event: str = "{type: never}",
    effect: str = "{type: infinite}",
    more: str = "",
) -> str:
    """One injector in flow style; fault in column 9 + len(target)."""
    return f"{{target: {target}, fault: {fault}, event: {event}, effect: {effect}{more}}}"


def read(**injectors: str) -> dict[str, InjectorSpec]:
    """Specs of injectors in flow style, checked; raises FileErrors."""
    text = "".join(f"{name}: {spec}\n" for name, spec in injectors.items())
    document = parse(text, "s.yaml")
    assert isinstance(document.data, dict)
    specs = {name: validate(InjectorSpec, spec, (name,), document) for name, spec in document.data.items()}
    check_injectors(document.data, PLAN, document.report)
    document.raise_problems()
    return {name: spec for name, spec in specs.items() if spec is not None}


def complaints(**injectors: str) -> tuple[str, ...]:
    """All messages about injectors, without the file's place."""
    with pytest.raises(FileErrors) as caught:
        read(**injectors)
    return tuple(message.partition(": ")[2] for message in caught.value.messages)


def built(fault: str, target: str = POSITION) -> Injector:
    """An injector that is active from 0 ns on."""
    specs = read(a=injector(fault, target))
    found = build_injectors(specs, PLAN, 1, 0)[0]
    found.start(0)
    found.held[0x185] = Frame(0x185, PAYLOAD)
    assert found.open(0, "test") is not None
    return found


def outcome(fault: str, target: str = POSITION, data: bytes = bytes(8)) -> bytes | None:
    """What becomes of a TPDO1 of the right knee."""
    result = built(fault, target).act(1, 1, Frame(0x185, data), Tray())
    return None if result is None else result.data


PAYLOAD: Final = bytes.fromhex("01000000 02000000")
