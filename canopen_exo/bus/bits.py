"""Exact length of a classical CAN frame on the wire: CRC-15 and bit stuffing, 16 bits a step by tables.

Source: ISO 11898-1 (Bosch CAN 2.0 part B): frame fields, CRC polynomial 0x4599, stuffing from SOF to the last CRC bit.
Leaves out: CAN FD.
"""

from collections.abc import Callable
from struct import Struct
from typing import Final

CRC_POLYNOMIAL: Final = 0x4599
"""Bosch CAN 2.0B, 3.1.1: x15 + x14 + x10 + x8 + x7 + x4 + x3 + 1."""

UNSTUFFED_TAIL: Final = 13
"""CRC delimiter 1, ACK slot 1, ACK delimiter 1, end of frame 7, intermission 3; never stuffed."""


def _crc_of_bytes() -> list[int]:
    table = []
    for byte in range(256):
        crc = byte << 7
        for _ in range(8):
            crc = ((crc << 1) ^ CRC_POLYNOMIAL) & 0x7FFF if crc & 0x4000 else (crc << 1) & 0x7FFF
        table.append(crc)
    return table


def _crc_of_words() -> list[int]:
    """What 16 bits that arrive at an empty CRC register leave in it, times 2: so it lies as the next 16 bits meet it.

    The register is shorter than the step: XOR its content to the top of the next 16 bits and it is a look-up again.
    """
    of_byte = _crc_of_bytes()
    doubled = list(range(0, 0x10000, 2))  # equal entries share one integer
    table = []
    for first in range(256):
        high, low = of_byte[first] >> 7, of_byte[first] << 8 & 0x7FFF
        for second in range(256):
            table.append(doubled[low ^ of_byte[high ^ second]])
    return table


# Stuffing state: 2 * (run - 1) + bit for `run` (1..4) equal bits of value `bit`: 0..7. A run of 5 ends at once with the
# stuff bit inserted after it. SOF is 0, so "one bit 1" also stands for nothing sent yet.
def _after_bit(state: int, bit: int) -> tuple[int, int]:
    """The state after one data bit, and the number of stuff bits (0 or 1) it brought."""
    run = (state >> 1) + 2 if state & 1 == bit else 1
    if run == 5:  # the complement is inserted and starts the next run
        return 1 - bit, 1
    return 2 * (run - 1) + bit, 0


def _stuffing_of_bytes(state: int) -> list[tuple[int, int]]:
    """State and number of stuff bits after each byte that follows `state`."""
    table = []
    for byte in range(256):
        now, count = state, 0
        for shift in range(7, -1, -1):
            now, inserted = _after_bit(now, byte >> shift & 1)
            count += inserted
        table.append((now, count))
    return table


def _stuffing_of_words() -> list[bytes]:
    """By state and 16 bits: number of stuff bits << 3 | the state that follows, below 40."""
    of_byte = [_stuffing_of_bytes(state) for state in range(8)]
    parts = [[count << 3 | now for now, count in row] for row in of_byte]  # of the second byte
    moved = [[[entry + (count << 3) for entry in part] for part in parts] for count in range(3)]
    rows = []
    for state in range(8):
        row: list[int] = []
        for now, count in of_byte[state]:
            row.extend(moved[count][now])
        rows.append(bytes(row))
    return rows


_CRC: Final[list[int]] = _crc_of_words()
_STUFFING: Final[list[bytes]] = _stuffing_of_words()
"""Half a megabyte, which a processor's second cache holds; as lists of references they would be eight times that."""
_NEXT: Final[list[bytes]] = [_STUFFING[entry & 7] for entry in range(40)]
"""The row of the following state, by entry."""
_COUNT: Final[list[int]] = [entry >> 3 for entry in range(40)]
"""Stuff bits, by entry."""
_LAST_COUNT: Final[list[int]] = [(entry >> 3) - (entry & 1) for entry in range(40)]
"""Stuff bits of the CRC, by entry: its 15 bits were looked up with a 0 after them, which if stuffed left a 1."""

_WORDS: Final[list[Callable[[bytes], tuple[int, ...]]]] = [Struct(f">{size // 2}H").unpack for size in range(15)]
"""An even number of bytes as 16-bit words."""


def header_bits(can_id: int, extended: bool, remote: bool, dlc: int) -> int:
    """SOF to DLC as one integer, most significant bit first: 19 bits (base) or 39 bits (extended)."""
    if extended:
        return (
            (can_id >> 18) << 27  # SOF 0 and ID28-18
            | 3 << 25  # SRR, IDE
            | (can_id & 0x3FFFF) << 7
            | int(remote) << 6  # RTR, then r1 r0
            | dlc
        )
    return can_id << 7 | int(remote) << 6 | dlc  # SOF 0, ID, RTR, IDE 0, r0 0, DLC


def crc15(header: int, data: bytes) -> int:
    """CRC-15 over the unstuffed bits SOF..data; leading zero bits do not change it (initial value 0)."""
    stream = header << 8 * len(data) | int.from_bytes(data, "big")
    crc = 0
    for word in _WORDS[14](stream.to_bytes(14, "big")):
        crc = _CRC[crc ^ word]
    return crc >> 1


def _head(can_id: int, size: int) -> tuple[bytes, int, int]:
    """After the 19 header bits of a base data frame: stuffing row, CRC register, length of the frame as known so far.

    The length lacks the stuff bits of data and CRC.
    """
    first, second = can_id >> 9, (can_id & 0x1FF) << 7 | size
    # SOF and two bits of the id; the alternating bits before them bring no stuff bit and stand for an idle bus
    entry = _STUFFING[1][0x5555 << 3 & 0xFFFF | first]
    after = _NEXT[entry][second]
    return _NEXT[after], _CRC[_CRC[first] ^ second], _COUNT[after] + 34 + 8 * size + UNSTUFFED_TAIL


_HEADS: Final = [[_head(can_id, size) for can_id in range(0x800)] if size % 2 == 0 else [] for size in range(9)]
"""By payload size (even) and id."""


def base_frame_bits(can_id: int, data: bytes) -> int:
    """Bits on the wire of a base data frame, from SOF to the end of the 3-bit intermission, stuff bits included."""
    size = len(data)
    first: int
    second: int
    third: int
    fourth: int
    if size == 8:  # most frames that are not measured already: written out, without a loop
        row, crc, bits = _HEADS[8][can_id]
        first, second, third, fourth = _WORDS[8](data)
        following, counts, crcs = _NEXT, _COUNT, _CRC
        one = row[first]
        two = following[one][second]
        three = following[two][third]
        four = following[three][fourth]
        crc = crcs[crcs[crcs[crcs[crc ^ first] ^ second] ^ third] ^ fourth]
        return bits + counts[one] + counts[two] + counts[three] + counts[four] + _LAST_COUNT[following[four][crc]]
    if size % 2 == 0:
        row, crc, bits = _HEADS[size][can_id]
        for first in _WORDS[size](data):
            one = row[first]
            row = _NEXT[one]
            bits += _COUNT[one]
            crc = _CRC[crc ^ first]
        return bits + _LAST_COUNT[row[crc]]
    return frame_bits(can_id, data, False, False, size)


def frame_bits(can_id: int, data: bytes, extended: bool, remote: bool, dlc: int) -> int:
    """The same for every classical frame."""
    length = (39 if extended else 19) + 8 * len(data)
    whole = length >> 4 << 1  # bytes in whole words
    stream = header_bits(can_id, extended, remote, dlc) << 8 * len(data) | int.from_bytes(data, "big")
    first = stream >> 8 * whole
    crc = _CRC[first]
    entry = _STUFFING[1][0x5555 << (length & 15) & 0xFFFF | first]
    count = _COUNT[entry] + length + 15 + UNSTUFFED_TAIL
    word: int
    for word in _WORDS[whole]((stream & (1 << 8 * whole) - 1).to_bytes(whole, "big")):
        entry = _NEXT[entry][word]
        count += _COUNT[entry]
        crc = _CRC[crc ^ word]
    return count + _LAST_COUNT[_NEXT[entry][crc]]
