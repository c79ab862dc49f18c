"""docs/faults.md: every example in it is read and built; every type has a line with all its keys, and an example."""

import re
from dataclasses import fields
from pathlib import Path
from typing import Final, get_args, get_type_hints

import pytest
from pydantic.fields import FieldInfo

import fi_gateway.faults
import fi_gateway.on_wire
import fi_gateway.wire_faults
from canopen_exo.plan import BusPlan, JointNode
from fi_gateway.boundary import validate
from fi_gateway.effect_specs import EFFECTS
from fi_gateway.event_specs import EVENTS
from fi_gateway.fault_specs import FAULTS
from fi_gateway.marked_yaml import parse
from fi_gateway.schema import InjectorSpec, build_injectors, check_injectors

TEXT: Final = (Path(__file__).parents[2] / "docs" / "faults.md").read_text(encoding="utf-8")
EXAMPLES: Final = [line for block in re.findall(r"```yaml\n(.*?)```", TEXT, re.DOTALL) for line in block.splitlines()]
ROWS: Final = [row for row in re.findall(r"^\| `(\w+)` \|(.*)\|$", TEXT, re.MULTILINE) if row[0] != "type"]
ENGINES: Final = (fi_gateway.faults, fi_gateway.wire_faults, fi_gateway.on_wire)
NAMES: Final = ("left_hip", "left_knee", "left_ankle", "right_hip", "right_knee", "right_ankle")
PLAN: Final = BusPlan(tuple(JointNode(name, number, 54_900, 131_072) for number, name in enumerate(NAMES, 1)))


@pytest.mark.parametrize("line", EXAMPLES)
def test_every_example_is_read_and_built(line: str) -> None:
    """On the right knee's position in the first table's block, on its TPDO1 in the second one's; then on a bus."""
    if TEXT.index(line) > TEXT.index("## On a bus"):
        kind = line.removeprefix("fault: {type: ").split(",")[0].rstrip("}")
        others = {"bit_error": "pdo: TPDO1", "no_ack": "kind: sync", "bus_off": "node: left_hip"}
        target = others.get(kind, "wire: drive")
    elif TEXT.index(line) < TEXT.index("## On whole frames"):
        target = "bus: to_controller, node: right_knee, signal: position"
    else:
        target = "bus: to_controller, node: right_knee, pdo: TPDO1"
    text = f"x:\n  target: {{{target}}}\n  {line}\n"
    document = parse(f"{text}  event: {{type: never}}\n  effect: {{type: infinite}}\n", "s.yaml")
    assert isinstance(document.data, dict)
    spec = validate(InjectorSpec, document.data["x"], ("x",), document)
    check_injectors(document.data, PLAN, document.report)
    document.raise_problems()
    assert spec is not None
    assert build_injectors({"x": spec}, PLAN, 1, 0)


def test_every_type_has_a_line_and_an_example() -> None:
    """No type without a line, no line without a type."""
    examples = {match[1] for line in EXAMPLES if (match := re.match(r"fault: {type: (\w+)", line))}
    assert examples == {name for name, _ in ROWS} == set(FAULTS.built_in)


@pytest.mark.parametrize("name", FAULTS.built_in)
def test_every_key_of_a_type_is_in_its_lines(name: str) -> None:
    """As it is written in a file."""
    spec = FAULTS.built_in[name]
    hints = get_type_hints(spec, include_extras=True)
    lines = " ".join(line for one, line in ROWS if one == name)
    for field in fields(spec):  # type: ignore[arg-type]
        marks = [mark for mark in get_args(hints[field.name]) if isinstance(mark, FieldInfo) and mark.alias]
        key = marks[0].alias if marks else field.name
        assert key == "type" or f"`{key}`" in lines, key


CLASSES: Final = ("corruption", "deletion", "delay", "insertion", "masquerade", "repetition", "resequencing")
"""EN 50159:2010, threats to a message."""


@pytest.mark.parametrize(("name", "line"), ROWS)
def test_the_docstring_of_a_fault_names_the_same_en_50159_class(name: str, line: str) -> None:
    """Every fault names its class in its docstring: that of the table, and no other word for it."""
    named = re.findall(r"[A-Z]\w+", (FAULTS.built_in[name].build.__doc__ or "").removeprefix("See "))
    cells = [cell.strip() for cell in line.split(" | ")]
    wanted = cells[-2 if TEXT.index(line) < TEXT.index("## On whole frames") else -1]
    for one in named:
        engine = next(found for found in map(vars, ENGINES) if one in found)[one]
        said = engine.__doc__.replace("\n", " ").partition("EN 50159: ")[2].partition("FIBlock")[0]
        classes = [word for word in re.findall(r"\w+", said) if word in CLASSES]
        assert classes[0] == re.findall(r"\w+", wanted)[0]
        assert {word for word in re.findall(r"\w+", wanted) if word in CLASSES} <= set(classes)


@pytest.mark.parametrize("kinds", [FAULTS, EVENTS, EFFECTS], ids=lambda kinds: kinds.what)
def test_every_registry_is_named(kinds: object) -> None:
    """Its entry-point group and its base class."""
    assert isinstance(kinds, type(FAULTS))
    assert f"`{kinds.group}`" in TEXT
    assert kinds.base.__name__ in TEXT
