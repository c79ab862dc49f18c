"""A classical frame as the bits on the wire, SOF to the last CRC bit, and back.

Source: ISO 11898-1 (Bosch CAN 2.0 part B): fields, CRC-15, bit stuffing. `bits` counts the same bits by tables; here
they are made, for frames that something happens to.
Leaves out: CAN FD; CRC delimiter to end of frame, which are the same for every frame.
"""

from typing import Final

from canopen_exo.bus.bits import crc15, header_bits
from canopen_exo.bus.frame import FLAG_EXTENDED, FLAG_REMOTE, Frame

BASE_HEADER: Final = 19
"""Unstuffed bits SOF..DLC of a base frame."""
EXTENDED_HEADER: Final = 39
"""The same of an extended frame."""
CRC_BITS: Final = 15
STUFF_AFTER: Final = 5

FIELDS: Final = ("sof", "id", "rtr", "control", "data", "crc", "crc_delimiter", "ack", "ack_delimiter", "eof")
"""Fields of a frame by name, for faults; `control` is IDE, the reserved bits and the DLC. SRR and IDE of an extended
frame belong to its id, as they compete in arbitration."""

_TAIL_LENGTHS: Final = (("crc_delimiter", 1), ("ack", 1), ("ack_delimiter", 1), ("eof", 7))


def unstuffed_bits(frame: Frame) -> list[int]:
    """SOF to the last CRC bit without stuff bits."""
    extended = frame.flags & FLAG_EXTENDED != 0
    header = header_bits(frame.can_id, extended, frame.flags & FLAG_REMOTE != 0, frame.dlc)
    data = frame.data
    length = (EXTENDED_HEADER if extended else BASE_HEADER) + 8 * len(data)
    value = header << 8 * len(data) | int.from_bytes(data, "big")
    value = value << CRC_BITS | crc15(header, data)
    length += CRC_BITS
    return [value >> shift & 1 for shift in range(length - 1, -1, -1)]


def stuff(bits: list[int]) -> tuple[list[int], list[int]]:
    """The bits with stuff bits, and where each given bit stands among them."""
    wire: list[int] = []
    places: list[int] = []
    last, run = 1, 0
    for bit in bits:
        places.append(len(wire))
        wire.append(bit)
        run = run + 1 if bit == last else 1
        last = bit
        if run == STUFF_AFTER:
            last = 1 - bit
            run = 1
            wire.append(last)
    return wire, places


def wire_bits(frame: Frame) -> list[int]:
    """SOF to the last CRC bit as sent, stuff bits included (also the one that may follow the last CRC bit)."""
    return stuff(unstuffed_bits(frame))[0]


def field_positions(frame: Frame, field: str) -> list[int]:
    """Positions on the wire (0: SOF) of the bits of a field, without stuff bits; empty when the frame has none."""
    wire, places = stuff(unstuffed_bits(frame))
    at = len(wire)
    for name, length in _TAIL_LENGTHS:
        if name == field:
            return list(range(at, at + length))
        at += length
    extended = frame.flags & FLAG_EXTENDED != 0
    header = EXTENDED_HEADER if extended else BASE_HEADER
    rtr = 32 if extended else 12
    bounds = {
        "sof": (0, 1),
        "id": (1, rtr),
        "rtr": (rtr, rtr + 1),
        "control": (rtr + 1, header),
        "data": (header, len(places) - CRC_BITS),
        "crc": (len(places) - CRC_BITS, len(places)),
    }
    first, end = bounds[field]
    return places[first:end]


def frame_of(value: int, count: int) -> Frame:
    """The frame in `count` unstuffed bits SOF..CRC, most significant first; the CRC is taken as right."""
    value >>= CRC_BITS
    count -= CRC_BITS
    extended = value >> (count - 14) & 1
    header = EXTENDED_HEADER if extended else BASE_HEADER
    size = (count - header) // 8
    head = value >> 8 * size
    data = (value & (1 << 8 * size) - 1).to_bytes(size, "big")
    dlc = head & 0xF
    flags = FLAG_REMOTE if head >> 6 & 1 else 0
    if extended:
        return Frame((head >> 27 & 0x7FF) << 18 | head >> 7 & 0x3FFFF, data, flags | FLAG_EXTENDED, dlc)
    return Frame(head >> 7 & 0x7FF, data, flags, dlc)
