"""`exo-hil export`: what other tools get is what this one uses, and they can read it."""

import json
from pathlib import Path

import canopen
import cantools
import pytest
from cantools.database.can import Database

from canopen_exo.plan import BusPlan
from fi_gateway.marked_yaml import Data, load
from testbench.cli import main
from testbench.scenario import default_joints

SCENARIOS = Path(__file__).parents[2] / "scenarios"
KNEE = SCENARIOS / "knee_freeze_at.yaml"


def exported(capsys: pytest.CaptureFixture[str], what: str) -> str:
    assert main(["export", what]) == 0
    captured = capsys.readouterr()
    assert captured.err == ""
    return captured.out


def test_exported_eds_loads_in_canopen(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """`export eds`: an object dictionary other tools can read, with what the bus plan maps."""
    (tmp_path / "joint.eds").write_text(exported(capsys, "eds"), encoding="utf-8")
    od = canopen.import_od(str(tmp_path / "joint.eds"))
    for pdo in BusPlan(default_joints()).pdos:
        for mapped in pdo.content:
            assert variable(od, mapped.index).data_type in canopen.objectdictionary.datatypes.INTEGER_TYPES
            assert len(variable(od, mapped.index)) == mapped.length
    device_type = variable(od, 0x1000).default
    assert device_type is not None
    assert device_type & 0xFFFF == 402  # CiA 301: the profile that the device follows


def variable(od: canopen.ObjectDictionary, index: int) -> canopen.objectdictionary.ODVariable:
    found = od[index]
    assert isinstance(found, canopen.objectdictionary.ODVariable)
    return found


def test_exported_dbc_loads_in_cantools(capsys: pytest.CaptureFixture[str]) -> None:
    """`export dbc`: every PDO of every joint, in SI."""
    dbc = cantools.database.load_string(exported(capsys, "dbc"), "dbc")
    assert isinstance(dbc, Database)
    for signal_ in BusPlan(default_joints()).signals():
        there = dbc.get_message_by_frame_id(signal_.cob_id).get_signal_by_name(signal_.name)
        assert (there.start, there.length, there.is_signed) == (signal_.start, signal_.length, signal_.signed)
        assert there.scale == pytest.approx(signal_.scale, rel=1e-12)  # printed with 12 digits and more


TYPES: dict[str, type | tuple[type, ...]] = {
    "object": dict,
    "array": list,
    "string": str,
    "boolean": bool,
    "number": (int, float),
    "integer": int,
    "null": type(None),
}
SILENT = {"title", "description", "default", "examples", "discriminator", "$defs"}


def fits(schema: dict[str, object], value: Data, root: dict[str, object]) -> bool:
    """Whether a value fits a JSON Schema; of the keywords, those that occur, any other is refused."""
    results = [_fits(keyword, wanted, schema, value, root) for keyword, wanted in schema.items()]
    return all(results)


def _fits(keyword: str, wanted: object, schema: dict[str, object], value: Data, root: dict[str, object]) -> bool:
    def one(inner: object, item: Data) -> bool:
        assert isinstance(inner, dict)
        return fits(inner, item, root)

    if keyword in SILENT:
        return True
    if keyword == "$ref":
        definitions = root["$defs"]
        assert isinstance(definitions, dict)
        return one(definitions[str(wanted).removeprefix("#/$defs/")], value)
    if keyword == "type":
        kinds = [str(kind) for kind in wanted] if isinstance(wanted, list) else [str(wanted)]
        return any(isinstance(value, TYPES[kind]) and (kind == "boolean") == isinstance(value, bool) for kind in kinds)
    if keyword == "const":
        return value == wanted
    if keyword == "minimum":
        assert isinstance(wanted, int)
        return not isinstance(value, int) or value >= wanted
    if keyword == "maximum":
        assert isinstance(wanted, int)
        return not isinstance(value, int) or value <= wanted
    if keyword == "required":
        assert isinstance(wanted, list)
        return not isinstance(value, dict) or set(wanted) <= set(value)
    if keyword == "minItems":
        assert isinstance(wanted, int)
        return not isinstance(value, list) or len(value) >= wanted
    if keyword == "items":
        return not isinstance(value, list) or all(one(wanted, item) for item in value)
    if keyword == "properties":
        assert isinstance(wanted, dict)
        return not isinstance(value, dict) or all(one(wanted[key], value[key]) for key in value if key in wanted)
    if keyword == "additionalProperties":
        known = schema.get("properties", {})
        assert isinstance(known, dict)
        others = [item for key, item in value.items() if key not in known] if isinstance(value, dict) else []
        return not others if wanted is False else all(one(wanted, item) for item in others)
    assert isinstance(wanted, list), f"keyword {keyword} is new to this test"
    if keyword == "enum":
        return value in wanted
    assert keyword in ("anyOf", "oneOf"), f"keyword {keyword} is new to this test"
    number = sum(one(inner, value) for inner in wanted)
    return number == 1 if keyword == "oneOf" else number > 0


@pytest.mark.parametrize("path", sorted(SCENARIOS.glob("*.yaml")), ids=lambda path: path.stem)
def test_exported_schema_accepts_the_shipped_scenarios(capsys: pytest.CaptureFixture[str], path: Path) -> None:
    """`export schema`: what an editor underlines must not be what the program accepts."""
    schema = json.loads(exported(capsys, "schema"))
    assert fits(schema, load(path).data, schema)


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("seed:", "sede:"),
        ("name: knee_freeze_at\n", ""),
        ("stride: 1.5 s", "stride: 1.5"),
        ("node: right_knee", "nod: right_knee"),
        ("type: stuck_at}", "type: stuckat}"),
        ("stops: off", "stops: maybe"),
        ("any: [freeze_position]", "any: []"),
        ("injectors:\n", "fail_on: never\ninjectors:\n"),
    ],
)
def test_exported_schema_refuses_what_the_program_refuses(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], old: str, new: str
) -> None:
    """Misspelt keys, missing ones, wrong types and unknown words show in an editor already."""
    schema = json.loads(exported(capsys, "schema"))
    text = KNEE.read_text(encoding="utf-8")
    assert old in text
    (tmp_path / "bad.yaml").write_text(text.replace(old, new, 1), encoding="utf-8")
    assert not fits(schema, load(tmp_path / "bad.yaml").data, schema)
    assert main(["check", str(tmp_path / "bad.yaml")]) == 2


def test_defaults_in_the_exported_schema_fit_it(capsys: pytest.CaptureFixture[str]) -> None:
    """A default that an editor fills in is one the program reads: "500 Hz", not nanoseconds."""
    schema = json.loads(exported(capsys, "schema"))
    found = 0
    for part in (schema, *schema["$defs"].values()):
        for key, value in part["properties"].items():
            if "default" in value:
                found += 1
                assert fits(value, value["default"], schema), key
    assert found >= 5
