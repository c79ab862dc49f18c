"""EDS files: CiA 306-1, and what this project's joint controller promises in its own."""

import sys
from importlib import metadata, resources
from subprocess import run

import pytest

from canopen_exo.eds import JOINT_EDS, load_eds, parse_eds
from canopen_exo.errors import CanopenExoError
from canopen_exo.od import VISIBLE_STRING, Entry

EDS = """\
[DeviceInfo]
VendorName=nobody
[MandatoryObjects]
SupportedObjects=1
1=0x1018
[OptionalObjects]
SupportedObjects=3
1=0x1008
2=0x1014
3=0x6071
[ManufacturerObjects]
SupportedObjects=0
[1018]
ParameterName=Identity
ObjectType=0x9
SubNumber=2
[1018sub0]
ParameterName=Highest sub-index supported
DataType=0x0005
AccessType=const
DefaultValue=1
[1018sub1]
ParameterName=Vendor-ID
DataType=0x0007
AccessType=ro
DefaultValue=0x000000AB
[1008]
ParameterName=Name
DataType=0x0009
AccessType=const
DefaultValue=a name
; a comment
[1014]
ParameterName=COB-ID EMCY
ObjectType=0x7
DataType=0x0007
AccessType=rw
DefaultValue=$NODEID+0x80
PDOMapping=0
[6071]
ParameterName=Target torque ; per mille
DataType=0x0003
LowLimit=-100
HighLimit=0x0064
AccessType=RWW
PDOMapping=1
"""


def test_every_field_of_an_entry_comes_from_the_file() -> None:
    """CiA 306-1, 4.6: names, types, limits, access, defaults, PDO mapping."""
    entries = {entry.key: entry for entry in parse_eds(EDS, "x.eds")}
    assert list(entries) == [0x100800, 0x101400, 0x101800, 0x101801, 0x607100]
    vendor, name, emcy, torque = (entries[key] for key in (0x101801, 0x100800, 0x101400, 0x607100))
    assert (vendor.name, vendor.bits, vendor.access, vendor.default) == ("Vendor-ID", 32, "ro", 0xAB)
    assert (name.type_code, name.text) == (VISIBLE_STRING, b"a name")
    assert (emcy.default, emcy.relative, emcy.high) == (0x80, True, 0xFFFFFFFF)
    assert (torque.low, torque.high, torque.signed, torque.access) == (-100, 100, True, "rww")
    assert torque.rpdo_mappable
    assert not torque.tpdo_mappable


def test_only_variables_are_plain() -> None:
    """A sub-index other than 0 on a plain variable does not exist; a record has its own."""
    assert [entry.plain for entry in parse_eds(EDS, "x.eds")] == [True, True, False, False, True]


def test_an_integer_without_default_belongs_to_the_unit() -> None:
    """CiA 306-1: DefaultValue is optional."""
    assert [entry.has_default for entry in parse_eds(EDS, "x.eds") if entry.bits] == [True, True, True, False]


@pytest.mark.parametrize(
    ("code", "text", "raw"),
    [
        ("0x0003", "-1", -1),
        ("0x0003", "0xFFFF", -1),
        ("0x0003", "0x7FFF", 32767),
        ("0x0003", "0x8000", -32768),
        ("0x0002", "0x80", -128),
        ("0x0006", "0xFFFF", 65535),
        ("0x0007", "$NODEID+0x40000180", 0x40000180),
        ("0x0007", "0x80+$NODEID", 0x80),
        ("0x0007", "$NODEID", 0),
        ("0x0001", "1", 1),
    ],
)
def test_default_values_in_every_notation(code: str, text: str, raw: int) -> None:
    """CiA 306-1, 4.6.3: decimal or hexadecimal, two's complement for signed types, $NODEID added."""
    old = "DataType=0x0007\nAccessType=rw\nDefaultValue=$NODEID+0x80"
    assert EDS.count(old) == 1
    changed = EDS.replace(old, f"DataType={code}\nAccessType=rw\nDefaultValue={text}")
    entry = next(entry for entry in parse_eds(changed, "x.eds") if entry.index == 0x1014)
    assert entry.default == raw
    assert entry.relative == ("$" in text)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("DefaultValue=0x000000AB", "DefaultValue=0xAG", r"\[1018SUB1\]: DefaultValue=0xAG given"),
        ("DefaultValue=0x000000AB", "DefaultValue=0x100000000", r"DefaultValue=0x100000000 given, allowed 0\.\."),
        ("LowLimit=-100", "LowLimit=low", r"\[6071\]: LowLimit=low given"),
        ("HighLimit=0x0064", "HighLimit=70000", r"\[6071\]: HighLimit=70000 given, allowed"),
        ("HighLimit=0x0064", "HighLimit=0x10000", r"\[6071\]: HighLimit=0x10000 given, allowed"),
        ("HighLimit=0x0064", "HighLimit=-200", r"6071:00: limits -100\.\.-200 given"),
        ("DataType=0x0009", "DataType=0x0008", r"\[1008\]: DataType=0x0008 given"),
        ("DataType=0x0009", "DataType=0x000F", r"\[1008\]: DefaultValue=a name given, allowed is none"),
        ("DataType=0x0009", "", r"\[1008\]: DataType= given"),
        ("AccessType=RWW", "AccessType=rx", r"\[6071\]: AccessType=rx given, allowed ro, rw"),
        ("AccessType=RWW", "", r"\[6071\]: AccessType= given"),
        ("PDOMapping=1", "PDOMapping=yes", r"\[6071\]: PDOMapping=yes given"),
        ("ParameterName=Name", "", r"\[1008\]: ParameterName is missing"),
        ("ObjectType=0x9", "ObjectType=0x5", r"\[1018\]: ObjectType=0x5 given"),
        ("ObjectType=0x9", "ObjectType=0x9\nCompactSubObj=3", r"\[1018\]: CompactSubObj is not supported"),
        ("SubNumber=2", "SubNumber=3", r"\[1018\]: SubNumber=3 given, the file has 2 sub-objects"),
        ("[1018sub1]", "[1019sub1]", r"\[1019SUB1\]: belongs to object 1019"),
        ("1=0x1008", "1=0x1009", r"\[OptionalObjects\]: 1=0x1009 given, but that object has no section"),
        ("3=0x6071", "", r"\[6071\]: the object is in none of the lists"),
        ("[1008]", "[1014]", "section '1014' already exists"),
        ("SupportedObjects=0", "nonsense", "Source contains parsing errors"),
    ],
)
def test_a_broken_file_is_refused_with_file_and_object(old: str, new: str, message: str) -> None:
    """Errors say what, where, got and allowed."""
    assert EDS.count(old) == 1
    with pytest.raises(CanopenExoError, match=f"broken.eds: .*{message}"):
        parse_eds(EDS.replace(old, new), "broken.eds")


def test_all_mistakes_are_told_at_once() -> None:
    """User files: all errors at once."""
    broken = EDS.replace("LowLimit=-100", "LowLimit=low").replace("AccessType=RWW", "AccessType=rx")
    with pytest.raises(CanopenExoError) as caught:
        parse_eds(broken, "broken.eds")
    assert len(str(caught.value).splitlines()) == 2


def test_an_unknown_file_is_refused_with_those_there_are() -> None:
    """The message lists the valid names."""
    with pytest.raises(CanopenExoError, match=f"'other.eds': no such file in the package dbc, allowed {JOINT_EDS}"):
        load_eds("other.eds")


def test_a_file_is_parsed_once() -> None:
    """Six devices cost one parse; the lists are each caller's own."""
    first, second = load_eds(), load_eds()
    assert first is not second
    assert all(one is two for one, two in zip(first, second, strict=True))


def test_importing_the_module_imports_no_parser() -> None:
    """Lazy imports: the canopen package and python-can come with the first file only."""
    code = "import sys, canopen_exo.eds, canopen_exo.sdo; sys.exit('canopen' in sys.modules or 'can' in sys.modules)"
    assert run([sys.executable, "-c", code], check=False).returncode == 0


def joint() -> dict[int, Entry]:
    return {entry.key: entry for entry in load_eds()}


def test_joint_controller_software_version_is_this_package() -> None:
    """Object 100A tells the version that runs."""
    assert joint()[0x100A00].text.decode() == metadata.version("exo-hil")


def test_joint_controller_keeps_to_ascii_and_short_lines() -> None:
    """CiA 306-1, 4.1: ASCII, at most 255 characters a line."""
    text = resources.files("dbc").joinpath(JOINT_EDS).read_bytes()
    assert text.isascii()
    assert max(len(line) for line in text.splitlines()) <= 255


def test_joint_controller_sub_index_0_counts_the_others() -> None:
    """CiA 301: :0 is the highest sub-index supported, constant but for mappings (4 or 8) and the error history."""
    entries = joint()
    for index in {entry.index for entry in entries.values() if not entry.plain}:
        top = max(entry.sub for entry in entries.values() if entry.index == index)
        first = entries[index << 8]
        assert first.type_code == 0x05
        assert (first.default if first.access == "const" else first.high) == top, f"{index:04X}"


@pytest.mark.parametrize("index", [0x603F, 0x6041, 0x6061, 0x6064, 0x606C, 0x6074, 0x6077])
def test_joint_controller_actual_values_go_into_tpdos_only(index: int) -> None:
    """CiA 402-2: read-only process data."""
    entry = joint()[index << 8]
    assert (entry.access, entry.tpdo_mappable, entry.rpdo_mappable) == ("ro", True, False)


@pytest.mark.parametrize("index", [0x6040, 0x6060, 0x6071, 0x6072])
def test_joint_controller_commands_go_into_rpdos_only(index: int) -> None:
    """CiA 402-2: process data the master writes."""
    entry = joint()[index << 8]
    assert (entry.access, entry.tpdo_mappable, entry.rpdo_mappable) == ("rww", False, True)


def test_joint_controller_maps_nothing_of_the_communication_area() -> None:
    """CiA 301: of 1000..1FFF only the error register may be mapped."""
    mappable = [e.index for e in load_eds() if e.index < 0x2000 and (e.rpdo_mappable or e.tpdo_mappable)]
    assert mappable == [0x1001]
