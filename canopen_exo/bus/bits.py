"""Exact length of a classical CAN frame on the wire: CRC-15 and bit stuffing by byte tables.

Source: ISO 11898-1 (Bosch CAN 2.0 part B): frame fields, CRC polynomial 0x4599, stuffing from SOF to the last CRC bit.
Leaves out: CAN FD.
"""

from typing import Final

CRC_POLYNOMIAL: Final = 0x4599
"""Bosch CAN 2.0B, 3.1.1: x15 + x14 + x10 + x8 + x7 + x4 + x3 + 1."""

UNSTUFFED_TAIL: Final = 13
"""CRC delimiter 1, ACK slot 1, ACK delimiter 1, end of frame 7, intermission 3; never stuffed."""


def _crc_table() -> list[int]:
    table = []
    for byte in range(256):
        crc = byte << 7
        for _ in range(8):
            crc = ((crc << 1) ^ CRC_POLYNOMIAL) & 0x7FFF if crc & 0x4000 else (crc << 1) & 0x7FFF
        table.append(crc)
    return table


# Stuffing state: 0 = nothing sent yet; 2 * run + bit - 1 for `run` (1..5) equal bits of value `bit`: 1..10.
# A run of 5 lives only until the stuff bit that ends it is inserted, so the states kept between bits are 0..8.
def _after_bit(state: int, bit: int) -> tuple[int, int]:
    """The state after one data bit, and the number of stuff bits (0 or 1) it brought."""
    run = 1
    if state and (state - 1) & 1 == bit:
        run = (state + 1) // 2 + 1
    if run == 5:  # the complement is inserted and starts the next run
        return 2 + (1 - bit) - 1, 1
    return 2 * run + bit - 1, 0


def _stuff_tables() -> tuple[list[int], list[int]]:
    after, stuffed = [0] * (9 * 256), [0] * (9 * 256)
    for state in range(9):
        for byte in range(256):
            now, count = state, 0
            for shift in range(7, -1, -1):
                now, inserted = _after_bit(now, byte >> shift & 1)
                count += inserted
            # kept multiplied by 256, so that `row + byte` is the next index
            after[state << 8 | byte] = now << 8
            stuffed[state << 8 | byte] = count
    return after, stuffed


def _head_tables(bits: int) -> tuple[list[int], list[int]]:
    """State row and stuff count after the first `bits` bits of a frame, by their value."""
    rows, counts = [], []
    for value in range(1 << bits):
        state, count = 0, 0
        for shift in range(bits - 1, -1, -1):
            state, inserted = _after_bit(state, value >> shift & 1)
            count += inserted
        rows.append(state << 8)
        counts.append(count)
    return rows, counts


_CRC: Final[list[int]] = _crc_table()
_AFTER, _STUFFED = _stuff_tables()
_HEAD2_ROW, _ = _head_tables(2)
_HEAD6_ROW, _HEAD6_STUFFED = _head_tables(6)


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
    crc = 0
    table = _CRC
    for byte in header.to_bytes(5, "big"):
        crc = ((crc << 8) & 0x7FFF) ^ table[(crc >> 7) ^ byte]
    for byte in data:
        crc = ((crc << 8) & 0x7FFF) ^ table[(crc >> 7) ^ byte]
    return crc


def frame_bits(can_id: int, data: bytes, extended: bool, remote: bool, dlc: int) -> int:
    """Bits on the wire from SOF to the end of the 3-bit intermission, stuff bits included."""
    table = _CRC
    size = len(data)
    if extended:
        header = header_bits(can_id, True, remote, dlc)
        crc = crc15(header, data)
        stream = header << (8 * size + 15) | int.from_bytes(data, "big") << 15 | crc
        rest = 48 + 8 * size  # 39 + 8n + 15 = 6 + (48 + 8n)
        head = stream >> rest
        row = _HEAD6_ROW[head]
        count = _HEAD6_STUFFED[head] + 54 + 8 * size + UNSTUFFED_TAIL
    else:
        header = can_id << 7 | remote << 6 | dlc
        crc = table[header >> 16]
        crc = ((crc << 8) & 0x7FFF) ^ table[(crc >> 7) ^ (header >> 8 & 0xFF)]
        crc = ((crc << 8) & 0x7FFF) ^ table[(crc >> 7) ^ (header & 0xFF)]
        for byte in data:
            crc = ((crc << 8) & 0x7FFF) ^ table[(crc >> 7) ^ byte]
        stream = header << (8 * size + 15) | int.from_bytes(data, "big") << 15 | crc
        rest = 32 + 8 * size  # 19 + 8n + 15 = 2 + (32 + 8n)
        row = _HEAD2_ROW[stream >> rest]
        count = 34 + 8 * size + UNSTUFFED_TAIL
    after, stuffed = _AFTER, _STUFFED
    for byte in (stream & ((1 << rest) - 1)).to_bytes(rest >> 3, "big"):
        index = row + byte
        count += stuffed[index]
        row = after[index]
    return count
