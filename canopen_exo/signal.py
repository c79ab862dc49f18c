"""Signals: bits in a payload <-> raw integer <-> SI value.

Bit numbering is CANopen's and DBC's little endian (CiA 301, 7.4.7: the first mapped object starts at bit 0 of byte 0).
SI floats become raw integers only here, once at each end. Raw values that do not fit saturate; nothing wraps.
"""

import math
import struct
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final, final

from canopen_exo.errors import CanopenExoError


@dataclass(frozen=True, slots=True)
class Signal:
    """One value in the frames of one COB-ID.

    name: as in scenarios ("position"); node: as in scenarios ("right_knee"); message: DBC message name;
    cob_id: 11-bit id; start, length: bits, little endian; scale: SI per raw unit; unit: SI unit ("rad", "rad/s",
    "N m", "" for a plain number); index, sub: the object behind it.
    """

    name: str
    node: str
    message: str
    cob_id: int
    start: int
    length: int
    signed: bool
    scale: float
    unit: str
    index: int
    sub: int

    def __deepcopy__(self, memo: dict[int, object]) -> "Signal":
        return self  # it never changes: copies share it

    @property
    def low(self) -> int:
        """Lowest raw value."""
        return -(1 << (self.length - 1)) if self.signed else 0

    @property
    def high(self) -> int:
        """Highest raw value."""
        return (1 << (self.length - 1)) - 1 if self.signed else (1 << self.length) - 1

    def fits(self, data: bytes) -> bool:
        """Whether the payload is long enough to hold the signal."""
        return self.start + self.length <= 8 * len(data)

    def read(self, data: bytes) -> int:
        """The raw value; the payload must hold the signal (`fits`)."""
        return read_bits(data, self.start, self.length, self.signed)

    def write(self, data: bytes, raw: int) -> bytes:
        """The payload with the raw value in it, saturated at the signal's range."""
        return write_bits(data, self.start, self.length, min(max(raw, self.low), self.high))

    def to_raw(self, value: float) -> int:
        """Nearest raw integer of an SI value, not saturated: `low`..`high` tells whether it fits."""
        return math.floor(value / self.scale + 0.5)

    def to_si(self, raw: int) -> float:
        """SI value of a raw integer."""
        return raw * self.scale


def read_bits(data: bytes, start: int, length: int, signed: bool) -> int:
    """Raw integer at bit `start` (little endian), two's complement when `signed`."""
    raw = (int.from_bytes(data, "little") >> start) & ((1 << length) - 1)
    if signed and raw >> (length - 1):
        raw -= 1 << length
    return raw


def write_bits(data: bytes, start: int, length: int, raw: int) -> bytes:
    """The payload with `raw` (two's complement, must fit) at bit `start`; all other bits unchanged."""
    mask = ((1 << length) - 1) << start
    word = int.from_bytes(data, "little") & ~mask | (raw << start) & mask
    return word.to_bytes(len(data), "little")


class Codec:
    """Packs and unpacks all values of one mapping, in mapping order. `size`: bytes of the payload.

    encode: the payload of raw values, one argument each; each must fit (the object dictionary clips on writing).
    unpack: the raw values of a payload of at least `size` bytes; further bytes are ignored.
    Both are functions kept as values: so those of `struct` are called directly, without a method of ours in between.
    """

    def __init__(self, size: int, encode: Callable[..., bytes], unpack: Callable[[bytes], tuple[int, ...]]) -> None:
        self.size: Final[int] = size
        self.encode: Final[Callable[..., bytes]] = encode
        self.unpack: Final[Callable[[bytes], tuple[int, ...]]] = unpack

    def pack(self, values: Sequence[int]) -> bytes:
        """Payload of raw values."""
        return self.encode(*values)


@final
class _StructCodec(Codec):
    """Byte-aligned objects of 8, 16, 32 or 64 bits: one compiled struct."""

    def __init__(self, layout: struct.Struct) -> None:
        super().__init__(layout.size, layout.pack, layout.unpack_from)


@final
class _BitCodec(Codec):
    """Any other mapping: shifts."""

    def __init__(self, fields: list[tuple[int, bool]]) -> None:
        super().__init__((sum(length for length, _ in fields) + 7) // 8, self._encode, self._unpack)
        self._fields: Final = fields

    def _encode(self, *values: int) -> bytes:
        word, at = 0, 0
        for (length, _), value in zip(self._fields, values, strict=True):
            word |= (value & ((1 << length) - 1)) << at
            at += length
        return word.to_bytes(self.size, "little")

    def _unpack(self, data: bytes) -> tuple[int, ...]:
        values, at = [], 0
        for length, signed in self._fields:
            values.append(read_bits(data, at, length, signed))
            at += length
        return tuple(values)


_LETTERS: Final = {8: "b", 16: "h", 32: "i", 64: "q"}


def compile_codec(fields: list[tuple[int, bool]]) -> Codec:
    """The codec of a mapping. fields: (length in bits, signed) of each mapped object, in mapping order.

    Raises CanopenExoError when the objects need more than 64 bits.
    """
    if sum(length for length, _ in fields) > 64:
        raise CanopenExoError(f"PDO mapping: {sum(length for length, _ in fields)} bits given, allowed 0..64")
    if all(length in _LETTERS for length, _ in fields):
        letters = "".join(_LETTERS[length] if signed else _LETTERS[length].upper() for length, signed in fields)
        return _StructCodec(struct.Struct("<" + letters))
    return _BitCodec(fields)
