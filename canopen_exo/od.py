"""The object dictionary of one device: typed entries, their values, and access to them from the bus.

Source: CiA 301, 7.4 (object dictionary; table 44: data types, 7.4.6: access), 7.2.4.3.17 (SDO abort codes, table 22).
Values are raw integers (booleans too); strings and domains are bytes. Entries come from an EDS (`canopen_exo.eds`).
Leaves out: REAL32 and REAL64, and the TIME types.
"""

import copy
from typing import Final, final

from mypy_extensions import mypyc_attr

from canopen_exo.errors import CanopenExoError

ABORT_NONE: Final = 0
"""Not an abort: the access is allowed, or was done."""
ABORT_UNSUPPORTED_ACCESS: Final = 0x0601_0000
ABORT_WRITE_ONLY: Final = 0x0601_0001
ABORT_READ_ONLY: Final = 0x0601_0002
ABORT_NO_OBJECT: Final = 0x0602_0000
ABORT_LENGTH: Final = 0x0607_0010
ABORT_TOO_LONG: Final = 0x0607_0012
ABORT_TOO_SHORT: Final = 0x0607_0013
ABORT_NO_SUB_INDEX: Final = 0x0609_0011
ABORT_VALUE: Final = 0x0609_0030
ABORT_VALUE_HIGH: Final = 0x0609_0031
ABORT_VALUE_LOW: Final = 0x0609_0032
ABORT_DEVICE_STATE: Final = 0x0800_0022
ABORT_NO_DATA: Final = 0x0800_0024

BOOLEAN: Final = 0x01
VISIBLE_STRING: Final = 0x09
OCTET_STRING: Final = 0x0A
UNICODE_STRING: Final = 0x0B
DOMAIN: Final = 0x0F

BITS: Final[dict[int, int]] = {
    BOOLEAN: 1, 0x02: 8, 0x03: 16, 0x04: 32, 0x05: 8, 0x06: 16, 0x07: 32,
    0x10: 24, 0x12: 40, 0x13: 48, 0x14: 56, 0x15: 64, 0x16: 24, 0x18: 40, 0x19: 48, 0x1A: 56, 0x1B: 64,
}  # fmt: skip
"""Bits of each integer type, by its code (CiA 301, table 44)."""

SIGNED: Final = (0x02, 0x03, 0x04, 0x10, 0x12, 0x13, 0x14, 0x15)
"""Codes of INTEGER8, 16, 32, 24, 40, 48, 56, 64."""

BYTE_TYPES: Final = (VISIBLE_STRING, OCTET_STRING, UNICODE_STRING, DOMAIN)
"""Types whose value is bytes of any number."""

ACCESS: Final = ("ro", "rw", "wo", "const", "rww", "rwr")
"""CiA 306: rww is read and write, a PDO may write it; rwr is read and write, a PDO may read it."""

_HISTORY: Final = 0x1003

_KEYS: Final[dict[int, int]] = {}


def key_of(index: int, sub: int) -> int:
    """The key of an object, index << 8 | sub. Equal keys are one integer: a dictionary finds it without comparing."""
    key = index << 8 | sub
    return _KEYS.setdefault(key, key)


@final
class Entry:
    """One value of the dictionary, as its EDS describes it; never changed.

    key: index << 8 | sub. type_code, access: see BITS, BYTE_TYPES, ACCESS. bits: 0 for bytes. default: raw, without the
    node id where `relative`; has_default: False when the EDS leaves it to the unit. low, high: raw, the type's range
    unless narrower. text: default of a string or domain. plain: the object is a variable without sub-indexes.
    """

    __slots__ = (
        "access", "bits", "default", "has_default", "high", "index", "key", "low", "name", "plain", "readable",
        "relative", "rpdo_mappable", "signed", "size", "sub", "text", "tpdo_mappable", "type_code", "writable",
    )  # fmt: skip

    def __init__(
        self,
        index: int,
        sub: int,
        name: str,
        type_code: int,
        access: str,
        default: int = 0,
        low: int | None = None,
        high: int | None = None,
        pdo: bool = False,
        relative: bool = False,
        has_default: bool = True,
        text: bytes = b"",
        plain: bool = True,
    ) -> None:
        if type_code not in BITS and type_code not in BYTE_TYPES:
            allowed = ", ".join(f"{code:#06x}" for code in sorted([*BITS, *BYTE_TYPES]))
            raise CanopenExoError(f"object {index:04X}:{sub:02X}: data type {type_code:#06x} given, allowed {allowed}")
        if access not in ACCESS:
            raise CanopenExoError(
                f"object {index:04X}:{sub:02X}: access {access!r} given, allowed {', '.join(ACCESS)} (CiA 306)"
            )
        self.index: Final[int] = index
        self.sub: Final[int] = sub
        self.key: Final[int] = key_of(index, sub)
        self.name: Final[str] = name
        self.type_code: Final[int] = type_code
        self.bits: Final[int] = BITS.get(type_code, 0)
        self.size: Final[int] = (self.bits + 7) // 8
        self.signed: Final[bool] = type_code in SIGNED
        self.access: Final[str] = access
        self.readable: Final[bool] = access != "wo"
        self.writable: Final[bool] = access in ("rw", "wo", "rww", "rwr")
        self.rpdo_mappable: Final[bool] = pdo and access in ("rw", "wo", "rww")
        self.tpdo_mappable: Final[bool] = pdo and access in ("ro", "const", "rw", "rwr")
        bottom = -(1 << (self.bits - 1)) if self.signed else 0
        top = (1 << (self.bits - 1)) - 1 if self.signed else (1 << self.bits) - 1
        self.low: Final[int] = bottom if low is None else low
        self.high: Final[int] = top if high is None else high
        self.default: Final[int] = default
        self.relative: Final[bool] = relative
        self.has_default: Final[bool] = has_default
        self.text: Final[bytes] = text
        self.plain: Final[bool] = plain
        if self.bits and not (bottom <= self.low <= self.high <= top):
            raise CanopenExoError(
                f"object {index:04X}:{sub:02X}: limits {self.low}..{self.high} given, "
                f"allowed is a range within {bottom}..{top}"
            )
        if self.bits and has_default and not self.low <= default <= self.high:
            raise CanopenExoError(
                f"object {index:04X}:{sub:02X}: default {default} given, allowed {self.low}..{self.high}"
            )


@mypyc_attr(allow_interpreted_subclasses=True)
class WriteObserver:
    """Sees every write from the bus: may refuse it, and acts on it. This base class allows all and does nothing."""

    def check(self, key: int, raw: int) -> int:
        """Abort code for writing `raw`, 0 to allow it; type, access and limits are checked already. No side effect."""
        return ABORT_NONE

    def written(self, key: int, raw: int) -> None:
        """`raw` is stored now."""


@final
class ObjectDictionary:
    """The values of one device.

    entries, values, texts: by key (index << 8 | sub); values may be read directly where speed matters.
    observer: asked and told about writes from the bus, never about `set` and `reset`.
    A dictionary made from entries is the pattern of a device type; `copy_for_node` makes the one of a unit.
    """

    def __init__(self, entries: list[Entry]) -> None:
        self.node_id: int = 0
        self.entries: dict[int, Entry] = {}
        self.values: dict[int, int] = {}
        self.texts: dict[int, bytes] = {}
        self.observer: WriteObserver = WriteObserver()
        self._plain: dict[int, bool] = {}
        self._defaults: dict[int, int] = {}
        for entry in entries:
            if entry.key in self.entries:
                raise CanopenExoError(
                    f"object {entry.index:04X}:{entry.sub:02X}: given twice ({self.entries[entry.key].name!r} and "
                    f"{entry.name!r}); an object dictionary has one entry per index and sub-index"
                )
            self.entries[entry.key] = entry
            self._plain[entry.index] = entry.plain
            if entry.bits:
                self._defaults[entry.key] = entry.default
        self.reset()

    def copy_for_node(self, node_id: int, unit: dict[int, int] | None = None) -> "ObjectDictionary":
        """The dictionary of one unit: $NODEID resolved, values at their defaults, its own observer.

        unit: key -> raw value that this unit has from its factory (rated torque, encoder counts); it takes the place
        of the EDS default, also after a reset. Objects without a default in the EDS must be given here.
        Raises CanopenExoError when the node id, an object or a value is not allowed, or one is missing.
        """
        if not 1 <= node_id <= 127:
            raise CanopenExoError(f"object dictionary: node id {node_id} given, allowed 1..127 (CiA 301)")
        given: dict[int, int] = {} if unit is None else unit
        twin = self._twin()
        twin.node_id = node_id
        twin.observer = WriteObserver()
        for key, raw in given.items():
            known = self.entries.get(key)
            if known is None or not known.bits:
                raise CanopenExoError(_unknown(key))
            if not known.low <= raw <= known.high:
                raise CanopenExoError(
                    f"object {key >> 8:04X}:{key & 0xFF:02X} ({known.name}): unit value {raw} given, "
                    f"allowed {known.low}..{known.high}"
                )
        for key, entry in self.entries.items():
            if key in given:
                twin._defaults[key] = given[key]
            elif not entry.has_default:
                raise CanopenExoError(
                    f"object {entry.index:04X}:{entry.sub:02X} ({entry.name}): no value given for node {node_id} and "
                    f"the EDS has no default; give it as unit={{0x{key:06X}: ...}}"
                )
            elif entry.relative:
                twin._defaults[key] = _relative_default(entry, node_id)
        twin.reset()
        return twin

    def value(self, key: int) -> int:
        """The raw value; raises CanopenExoError when there is no such object."""
        try:
            return self.values[key]
        except KeyError:
            raise CanopenExoError(_unknown(key)) from None

    def set(self, key: int, raw: int) -> None:
        """The device's own write: clipped to the limits, no access check, no observer."""
        entry = self.entries.get(key)
        if entry is None or not entry.bits:
            raise CanopenExoError(_unknown(key))
        if raw < entry.low:
            raw = entry.low
        elif raw > entry.high:
            raw = entry.high
        self.values[key] = raw

    def reset(self, communication_only: bool = False) -> None:
        """Power-on values for all objects (NMT reset node) or for 1000..1FFF only (reset communication)."""
        for key, raw in self._defaults.items():
            if not communication_only or 0x1000 <= key >> 8 <= 0x1FFF:
                self.values[key] = raw
        for key, entry in self.entries.items():
            if not entry.bits and (not communication_only or 0x1000 <= entry.index <= 0x1FFF):
                self.texts[key] = entry.text

    def check_access(self, index: int, sub: int, writing: bool) -> int:
        """Abort code for reading or writing an object from the bus, 0 when it is allowed."""
        entry = self.entries.get(index << 8 | sub)
        if entry is None:
            return ABORT_NO_SUB_INDEX if index in self._plain else ABORT_NO_OBJECT
        if writing:
            return ABORT_NONE if entry.writable else ABORT_READ_ONLY
        if not entry.readable:
            return ABORT_WRITE_ONLY
        if index == _HISTORY and sub > self.values[_HISTORY << 8]:
            return ABORT_NO_DATA  # CiA 301, object 1003: entries above :0 hold no error
        return ABORT_NONE

    def read(self, index: int, sub: int) -> bytes:
        """The value as SDO carries it, little endian; raises CanopenExoError where `check_access` has an abort code."""
        abort = self.check_access(index, sub, False)
        if abort:
            raise CanopenExoError(f"object {index:04X}:{sub:02X}: not readable, SDO abort {abort:08X}")
        entry = self.entries[index << 8 | sub]
        if not entry.bits:
            return self.texts[entry.key]
        return self.values[entry.key].to_bytes(entry.size, "little", signed=entry.signed)

    def write(self, index: int, sub: int, data: bytes) -> int:
        """Write from the bus; the abort code, 0 when it is done. Never raises."""
        abort = self.check_access(index, sub, True)
        if abort:
            return abort
        entry = self.entries[index << 8 | sub]
        if not entry.bits:
            abort = self.observer.check(entry.key, 0)
            if not abort:
                self.texts[entry.key] = bytes(data)
                self.observer.written(entry.key, 0)
            return abort
        if len(data) != entry.size:
            return ABORT_TOO_LONG if len(data) > entry.size else ABORT_TOO_SHORT
        raw = int.from_bytes(data, "little", signed=entry.signed)
        abort = _range_abort(entry, raw)
        if not abort:
            abort = self.observer.check(entry.key, raw)
        if not abort:
            self.values[entry.key] = raw
            self.observer.written(entry.key, raw)
        return abort

    def _twin(self) -> "ObjectDictionary":
        """The same entries, shared, and the same values; the observer is left to the caller."""
        twin = ObjectDictionary([])
        twin.node_id = self.node_id
        twin.entries = self.entries
        twin.values = self.values.copy()
        twin.texts = self.texts.copy()
        twin._plain = self._plain
        twin._defaults = self._defaults.copy()
        return twin

    def __deepcopy__(self, memo: dict[int, object]) -> "ObjectDictionary":
        twin = self._twin()
        memo[id(self)] = twin
        twin.observer = copy.deepcopy(self.observer, memo)
        return twin


def _unknown(key: int) -> str:
    return (
        f"object {key >> 8:04X}:{key & 0xFF:02X}: not in the object dictionary (or not an integer); "
        "the key is index << 8 | sub, the objects are those of the EDS"
    )


def _relative_default(entry: Entry, node_id: int) -> int:
    raw = entry.default + node_id
    if raw > entry.high:
        raise CanopenExoError(
            f"object {entry.index:04X}:{entry.sub:02X} ({entry.name}): default $NODEID+{entry.default:#x} is {raw:#x} "
            f"for node {node_id}, allowed {entry.low:#x}..{entry.high:#x}"
        )
    return raw


def _range_abort(entry: Entry, raw: int) -> int:
    if entry.key == _HISTORY << 8:  # CiA 301, object 1003: only 0, which clears the history
        return ABORT_VALUE if raw else ABORT_NONE
    if raw > entry.high:
        return ABORT_VALUE_HIGH
    return ABORT_VALUE_LOW if raw < entry.low else ABORT_NONE
