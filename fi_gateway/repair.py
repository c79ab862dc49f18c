"""Repair of what an application itself puts into a payload against wrong content: a counter, a checksum.

A fault above such a check (in the sensor, in the control law) comes out with a valid checksum and a running counter; a
fault below it (in memory, on the way) does not. Without a repair an injector stands below, with it above.
Checksums: CRC-8 SAE J1850 (polynomial 0x1D, start 0xFF, final XOR 0xFF), also the one of AUTOSAR's
Crc_CalculateCRC8; and the XOR of all bytes. The counter keeps the value with which the frame arrived.
Leaves out: checksums of other widths, and those over bytes that are not in the frame, except a start value.
"""

from typing import Final, final

from canopen_exo.bus.frame import Frame
from canopen_exo.signal import read_bits, write_bits
from fi_gateway.errors import FaultError

CRC8_J1850: Final = "crc8_j1850"
XOR: Final = "xor"
CHECKSUMS: Final = (CRC8_J1850, XOR)


def _table() -> bytes:
    table = bytearray()
    for byte in range(256):
        crc = byte
        for _ in range(8):
            crc = (crc << 1 ^ 0x1D if crc & 0x80 else crc << 1) & 0xFF
        table.append(crc)
    return bytes(table)


_CRC8: Final = _table()


def crc8_j1850(data: bytes) -> int:
    """CRC-8 SAE J1850; 0x4B over the ASCII digits 1 to 9."""
    crc = 0xFF
    for byte in data:
        crc = _CRC8[crc ^ byte]
    return crc ^ 0xFF


def xor_of(data: bytes) -> int:
    """The XOR of all bytes; 0 of none."""
    result = 0
    for byte in data:
        result ^= byte
    return result


@final
class Repair:
    """Puts right counter and checksum of a changed payload; frames too short for them stay as they are.

    checksum: one of CHECKSUMS, "" for none; byte: where it lies; prefix: bytes it covers besides, before the others (a
    data ID that is not sent). It covers all other bytes of the payload, in order. counter_start, counter_length: bits,
    little endian, 0 long for none.
    """

    def __init__(
        self, checksum: str = "", byte: int = 0, prefix: bytes = b"", counter_start: int = 0, counter_length: int = 0
    ) -> None:
        if checksum and checksum not in CHECKSUMS:
            raise FaultError(f"repair: checksum {checksum!r} given, allowed: {', '.join(CHECKSUMS)}")
        if not checksum and not counter_length:
            raise FaultError("repair: neither checksum nor counter given, allowed are one of them or both")
        if not 0 <= byte <= 7:
            raise FaultError(f"repair: checksum in byte {byte} given, allowed 0..7")
        if counter_start < 0 or counter_length < 0 or counter_start + counter_length > 64:
            raise FaultError(
                f"repair: counter of {counter_length} bits from bit {counter_start} given, allowed within bits 0..63"
            )
        if checksum and counter_length and counter_start < 8 * byte + 8 and 8 * byte < counter_start + counter_length:
            raise FaultError(f"repair: the counter lies in byte {byte}, where the checksum is; each needs its own bits")
        self._checksum: Final[str] = checksum
        self._byte: Final[int] = byte
        self._prefix: Final[bytes] = prefix
        self._counter_start: Final[int] = counter_start
        self._counter_length: Final[int] = counter_length

    def frame(self, arrived: Frame | None, changed: Frame) -> Frame:
        """`changed`, put right where its payload is not that of the frame that arrived; None: there was none."""
        if arrived is not None and changed.data == arrived.data:
            return changed
        data, end = changed.data, (self._counter_start + self._counter_length + 7) // 8
        if self._counter_length and arrived is not None and len(data) >= end and len(arrived.data) >= end:
            counter = read_bits(arrived.data, self._counter_start, self._counter_length, False)
            data = write_bits(data, self._counter_start, self._counter_length, counter)
        if self._checksum and len(data) > self._byte:
            covered = self._prefix + data[: self._byte] + data[self._byte + 1 :]
            value = crc8_j1850(covered) if self._checksum == CRC8_J1850 else xor_of(covered)
            data = data[: self._byte] + bytes((value,)) + data[self._byte + 1 :]
        if data == changed.data:
            return changed
        return Frame(changed.can_id, data, changed.flags, changed.dlc if changed.flags or changed.dlc > 8 else -1)

    def __deepcopy__(self, memo: dict[int, object]) -> "Repair":
        return self  # it never changes: copies share it

    def __reduce__(self) -> tuple[type["Repair"], tuple[str, int, bytes, int, int]]:
        return Repair, (self._checksum, self._byte, self._prefix, self._counter_start, self._counter_length)
