"""Which SDO writes to its communication objects a running device takes.

Source: CiA 301, 7.5.2 (objects 0x1016, 0x1019, 0x14xx to 0x1Axx), and its procedures for changing a PDO.
Leaves out: what the object dictionary itself refuses (size, access, range), and the application's own objects.
"""

from typing import Final

from canopen_exo.od import ABORT_DEVICE_STATE, ABORT_VALUE, ObjectDictionary
from canopen_exo.pdo import INVALID, PDO_COUNT, is_restricted, key_of, mapping_abort

ABORT_INCOMPATIBLE: Final = 0x06040043


def check_write(od: ObjectDictionary, key: int, raw: int) -> int:
    """The abort code, 0 when nothing in the standard is against it. key: index and sub-index as of `pdo.key_of`."""
    index, sub = key >> 8, key & 0xFF
    values = od.values
    if index == 0x1019 and values[key_of(0x1006, 0)]:
        return ABORT_DEVICE_STATE  # CiA 301, object 0x1019: not while the communication cycle period is set
    if index == 0x1019 and (raw == 1 or raw > 240):
        return ABORT_VALUE
    if index == 0x1016 and sub and raw >> 16 & 0xFF and raw & 0xFFFF:
        for other in range(1, values[key_of(0x1016, 0)] + 1):
            word = values[key_of(0x1016, other)]
            if other != sub and word & 0xFFFF and word >> 16 & 0xFF == raw >> 16 & 0xFF:
                return ABORT_INCOMPATIBLE
    if 0x1400 <= index < 0x1400 + PDO_COUNT or 0x1800 <= index < 0x1800 + PDO_COUNT:
        return _check_communication(od, index, sub, raw)
    if 0x1600 <= index < 0x1600 + PDO_COUNT or 0x1A00 <= index < 0x1A00 + PDO_COUNT:
        return _check_mapping(od, index, sub, raw)
    return 0


def _check_communication(od: ObjectDictionary, index: int, sub: int, raw: int) -> int:
    if sub == 1 and not raw & INVALID and is_restricted(raw & 0x3FFFFFFF):
        return ABORT_VALUE
    if sub == 2 and index >= 0x1800 and not 1 <= raw <= 240:
        return ABORT_VALUE  # transmit types other than synchronous cyclic are not there
    if sub == 2 and index < 0x1800 and 240 < raw < 254:
        return ABORT_VALUE
    if sub == 6 and not od.values[key_of(index, 1)] & INVALID:
        return ABORT_DEVICE_STATE  # CiA 301, 18xx:6: only while the PDO is not valid
    return 0


def _check_mapping(od: ObjectDictionary, index: int, sub: int, raw: int) -> int:
    """The standard procedure: clear :0, write the entries, set :0 to their number."""
    if sub == 0:
        return mapping_abort(od, index, raw)
    return ABORT_DEVICE_STATE if od.values[key_of(index, 0)] else 0
