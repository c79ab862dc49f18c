"""docs/events.md: every example in it is read, and every type there is has one."""

import re
from collections.abc import Collection
from pathlib import Path
from typing import Final, get_args

import pytest

from canopen_exo.plan import BusPlan, JointNode
from fi_gateway.boundary import validate
from fi_gateway.distribution_specs import LawChoice
from fi_gateway.effect_specs import EFFECTS
from fi_gateway.event_specs import EVENTS
from fi_gateway.marked_yaml import parse
from fi_gateway.schema import InjectorSpec, build_injectors

TEXT: Final = (Path(__file__).parents[2] / "docs" / "events.md").read_text(encoding="utf-8")
EXAMPLES: Final = [line for block in re.findall(r"```yaml\n(.*?)```", TEXT, re.DOTALL) for line in block.splitlines()]
NAMES: Final = ("left_hip", "left_knee", "left_ankle", "right_hip", "right_knee", "right_ankle")
PLAN: Final = BusPlan(tuple(JointNode(name, number, 54_900, 131_072) for number, name in enumerate(NAMES, 1)))
LAWS: Final = [get_args(model.__annotations__["type"])[0] for model in get_args(get_args(LawChoice)[0])]


@pytest.mark.parametrize("line", EXAMPLES)
def test_every_example_is_read_and_built(line: str) -> None:
    """What stands in the document works."""
    given = {"event": "{type: never}", "effect": "{type: infinite}"}
    key, _, value = line.partition(": ")
    if key in given:
        given[key] = value
    elif key == "law":
        given = dict.fromkeys(given, f"{{type: distribution, law: {value}}}")
    else:
        given = {"event": f"{{type: when, condition: {value}}}", "effect": f"{{type: until, condition: {value}}}"}
    text = "target: {bus: to_controller, pdo: TPDO1}\nfault: {type: drop}\n"
    document = parse(text + "".join(f"{name}: {one}\n" for name, one in given.items()), "s.yaml")
    spec = validate(InjectorSpec, document.data, (), document)
    document.raise_problems()
    assert spec is not None
    assert build_injectors({"x": spec}, PLAN, 1, 0)


@pytest.mark.parametrize(("key", "choice"), [("event", EVENTS.built_in), ("effect", EFFECTS.built_in), ("law", LAWS)])
def test_every_type_is_in_a_table_and_has_an_example(key: str, choice: Collection[str]) -> None:
    """No type without a line, no line without a type."""
    types = set(choice)
    examples = {match[1] for line in EXAMPLES if (match := re.match(rf"{key}: {{type: (\w+)", line))}
    assert examples == types
    assert all(f"\n| `{name}` |" in TEXT for name in types)
