"""EDS files -> entries of an object dictionary.

Source: CiA 306-1 (electronic data sheet). The file is parsed by the `canopen` package, imported only when a file is
loaded (about 0.15 s). What that parser would pass over in silence (unreadable limits and defaults, missing
sub-objects) is refused here first, with every mistake named.
An integer without DefaultValue belongs to the unit (rated torque, say) and is given when its dictionary is made.
Leaves out: CompactSubObj, floats, DCF values (ParameterValue).
"""

import re
from configparser import Error as ConfigError
from configparser import RawConfigParser
from functools import cache
from importlib.resources import files
from io import StringIO
from typing import TYPE_CHECKING, Final

from canopen_exo.errors import CanopenExoError
from canopen_exo.od import ACCESS, BITS, BYTE_TYPES, SIGNED, VISIBLE_STRING, Entry

if TYPE_CHECKING:
    from canopen.objectdictionary import ODVariable

JOINT_EDS: Final = "exo_joint.eds"
"""The joint controller, in the package `dbc`."""

_OBJECT: Final = re.compile(r"^([0-9A-F]{4})(?:SUB([0-9A-F]{1,2}))?$", re.IGNORECASE)
_NODE_ID: Final = re.compile(r"\$NODEID\s*\+?|\+?\s*\$NODEID", re.IGNORECASE)
_LISTS: Final = ("MandatoryObjects", "OptionalObjects", "ManufacturerObjects")
_VARIABLE: Final = 7
_ARRAY, _RECORD = 8, 9


def load_eds(resource: str = JOINT_EDS) -> list[Entry]:
    """The entries of an EDS file in the package `dbc`; each file is parsed once in a process."""
    return list(_load(resource))


@cache
def _load(resource: str) -> tuple[Entry, ...]:
    folder = files("dbc")
    path = folder / resource
    if not path.is_file():
        known = sorted(item.name for item in folder.iterdir() if item.name.endswith(".eds"))
        raise CanopenExoError(f"EDS {resource!r}: no such file in the package dbc, allowed {', '.join(known)}")
    return tuple(parse_eds(path.read_text(encoding="utf-8"), resource))


def parse_eds(text: str, where: str) -> list[Entry]:
    """The entries of an EDS text, by index and sub-index; `where` names it in messages.

    Raises CanopenExoError naming the file, the objects and what is wrong with them, all mistakes at once.
    """
    problems = _problems(text)
    if problems:
        raise CanopenExoError("\n".join(f"{where}: {problem}" for problem in problems))
    from canopen import import_od
    from canopen.objectdictionary import ODVariable

    source = StringIO(text)
    source.name = "device.eds"  # the parser goes by the ending of this name
    entries: list[Entry] = []
    try:
        for item in import_od(source).values():
            if isinstance(item, ODVariable):
                entries.append(_entry(item, True))
            else:
                entries.extend(_entry(member, False) for member in item.subindices.values())
    except (ConfigError, KeyError, ValueError, CanopenExoError) as error:
        raise CanopenExoError(f"{where}: {error}") from error
    return entries


def _entry(var: "ODVariable", plain: bool) -> Entry:
    raw = str(getattr(var, "default_raw", "")).strip()
    code = int(var.data_type or 0)
    if code in BYTE_TYPES:
        text = raw.encode("utf-8") if code == VISIBLE_STRING else b""
        return Entry(var.index, var.subindex, var.name, code, var.access_type, text=text, plain=plain)
    return Entry(
        var.index,
        var.subindex,
        var.name,
        code,
        var.access_type,
        default=_number(raw, code) if raw else 0,
        low=var.min,
        high=var.max,
        pdo=var.pdo_mappable,
        relative="$NODEID" in raw.upper(),
        has_default=bool(raw),
        plain=plain,
    )


def _number(text: str, type_code: int) -> int:
    """A number of an EDS; hexadecimal ones of a signed type are two's complement. Raises ValueError."""
    number = int(_NODE_ID.sub("", text).strip() or "0", 0)
    if type_code in SIGNED and "0x" in text.lower() and number >> (BITS[type_code] - 1) == 1:
        number -= 1 << BITS[type_code]
    return number


class _Parser(RawConfigParser):
    """Keeps the case of keys."""

    def optionxform(self, optionstr: str) -> str:
        return optionstr


def _problems(text: str) -> list[str]:
    """What is wrong with an EDS, object by object."""
    parser = _Parser(inline_comment_prefixes=(";",))
    try:
        parser.read_string(text)
    except ConfigError as error:
        return [" ".join(str(error).split())]
    sections: dict[str, dict[str, str]] = {name.upper(): dict(parser[name]) for name in parser.sections()}
    found = _list_problems(sections)
    members: dict[str, int] = {}
    for name, keys in sections.items():
        match = _OBJECT.match(name)
        if match is None:
            continue
        if match.group(2) is not None:
            members[match.group(1)] = members.get(match.group(1), 0) + 1
            if match.group(1) not in sections:
                found.append(f"[{name}]: belongs to object {match.group(1)}, which has no section")
        found.extend(f"[{name}]: {problem}" for problem in _object_problems(keys))
    for name, keys in sections.items():
        if keys.get("SubNumber") and _is_number(keys["SubNumber"]):
            expected, there = int(keys["SubNumber"], 0), members.get(name, 0)
            if expected != there:
                found.append(f"[{name}]: SubNumber={expected} given, the file has {there} sub-objects")
    return found


def _list_problems(sections: dict[str, dict[str, str]]) -> list[str]:
    """Lists of objects against the sections there are, both ways."""
    found, listed = [], []
    for name in _LISTS:
        for key, value in sections.get(name.upper(), {}).items():
            if not key.isdigit():
                continue
            if not _is_number(value) or f"{int(value, 0):04X}" not in sections:
                found.append(f"[{name}]: {key}={value} given, but that object has no section")
            else:
                listed.append(f"{int(value, 0):04X}")
    for name in sections:
        if len(name) == 4 and _OBJECT.match(name) and name not in listed:
            found.append(f"[{name}]: the object is in none of the lists {', '.join(_LISTS)}")
    return found


def _object_problems(keys: dict[str, str]) -> list[str]:
    if "ParameterName" not in keys:
        return ["ParameterName is missing"]
    kind = keys.get("ObjectType", "7")
    if not _is_number(kind) or int(kind, 0) not in (_VARIABLE, _ARRAY, _RECORD):
        return [f"ObjectType={kind} given, allowed 0x7 (VAR), 0x8 (ARRAY), 0x9 (RECORD)"]
    if int(kind, 0) != _VARIABLE:
        return ["CompactSubObj is not supported; write the sub-objects out"] if "CompactSubObj" in keys else []
    found = []
    if keys.get("AccessType", "").lower() not in ACCESS:
        found.append(f"AccessType={keys.get('AccessType', '')} given, allowed {', '.join(ACCESS)}")
    if keys.get("PDOMapping", "0") not in ("0", "1", "0x0", "0x1"):
        found.append(f"PDOMapping={keys['PDOMapping']} given, allowed 0 or 1")
    code = keys.get("DataType", "")
    if not _is_number(code) or (int(code, 0) not in BITS and int(code, 0) not in BYTE_TYPES):
        return [*found, f"DataType={code} given, allowed are integers, strings and DOMAIN (CiA 301, table 44)"]
    if int(code, 0) in BYTE_TYPES:
        if keys.get("DefaultValue") and int(code, 0) != VISIBLE_STRING:
            found.append(f"DefaultValue={keys['DefaultValue']} given, allowed is none for this type (DataType={code})")
        return found
    for key in ("DefaultValue", "LowLimit", "HighLimit"):
        value = keys.get(key, "")
        plain = _NODE_ID.sub("", value).strip() or "0" if key == "DefaultValue" else value
        if value and not _is_number(plain):
            found.append(f"{key}={value} given, allowed is a number such as 10, -3 or 0x1F")
        elif value:
            raw, bits = _number(plain, int(code, 0)), BITS[int(code, 0)]
            low, high = (-(1 << (bits - 1)), (1 << (bits - 1)) - 1) if int(code, 0) in SIGNED else (0, (1 << bits) - 1)
            if not low <= raw <= high:
                found.append(f"{key}={value} given, allowed {low}..{high} for DataType={code}")
    return found


def _is_number(text: str) -> bool:
    try:
        int(text, 0)
    except ValueError:
        return False
    return True
