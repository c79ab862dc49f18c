"""Faults that act on single bits of a signal or payload.

Source: Fabarisov et al., ESREL 2020 (FIBlock), for bit flips.
The CRC of the changed frame is valid: a flip in the sender's memory, not on the line (there, a flip that all nodes see
costs time, not data: ISO 11898-1).
"""

from typing import Final, final

from numpy.random import Generator

from canopen_exo.bus.frame import Frame
from canopen_exo.signal import Signal
from fi_gateway.errors import FaultError
from fi_gateway.faults.base import Fault, with_payload
from fi_gateway.outlet import Outlet


@final
class BitFlip(Fault):
    """Bits are inverted: out = in XOR mask.

    signal: bit positions count from its lowest bit; None: from bit 0 of byte 0 of the payload (little endian).
    count: how many distinct bits are drawn, >= 1; bits: given positions instead (count is then not used);
    fixed: drawn bits stay for the whole activation, otherwise every frame gets new ones.
    A payload with fewer bits than asked for passes unchanged and is counted.
    EN 50159: corruption, above the CRC. FIBlock: Bit flips; that draws with replacement (a bit drawn twice cancels) and
    reaches only the 32 low mantissa bits of a double, here every bit of the wire value can be hit.
    """

    def __init__(
        self, signal: Signal | None, count: int = 1, bits: tuple[int, ...] | None = None, fixed: bool = False
    ) -> None:
        super().__init__(signal)
        length = 64 if signal is None else signal.length
        if bits is None and not 1 <= count <= length:
            raise FaultError(f"bit_flip: {count} bits asked for, allowed 1..{length}")
        given = 0 if bits is None else given_bits("bit_flip", bits, length)
        self._start: Final[int] = 0 if signal is None else signal.start
        self._length: Final[int] = 0 if signal is None else signal.length
        self._count: Final[int] = count
        self._bits: Final[tuple[int, ...] | None] = bits
        self._given: Final[int] = given
        self._fixed: Final[bool] = fixed
        self._mask: int = given
        self._rng: Generator | None = None

    def begin(self, now: int, held: dict[int, Frame], rng: Generator) -> bool:
        """Keep the stream; fixed bits are drawn with the first frame, whose length they need."""
        self.saturated = 0
        self._mask = self._given
        self._rng = rng
        return True

    def fits(self, frame: Frame) -> bool:
        """The frame holds the signal, or for a payload all the bits to invert."""
        if self.signal is not None:
            return self.signal.fits(frame.data)
        need = self._mask.bit_length() if self._mask else self._count
        return need <= 8 * len(frame.data)

    def apply(self, now: int, frame: Frame, outlet: Outlet) -> Frame | None:
        """The frame with its bits inverted."""
        size = len(frame.data)
        mask = self._mask
        if mask == 0:
            assert self._rng is not None
            mask = distinct_bits(self._rng, self._count, self._length if self._length else 8 * size)
            if self._fixed:
                self._mask = mask
        word = int.from_bytes(frame.data, "little") ^ mask << self._start
        return with_payload(frame, word.to_bytes(size, "little"))

    def __reduce__(
        self,
    ) -> tuple[type["BitFlip"], tuple[Signal | None, int, tuple[int, ...] | None, bool], dict[str, object]]:
        state: dict[str, object] = {"_mask": self._mask, "_rng": self._rng}
        return BitFlip, (self.signal, self._count, self._bits, self._fixed), state


@final
class BitStuck(Fault):
    """Bits are held: out = in OR mask (level 1), or in AND NOT mask (level 0).

    signal: bit positions count from its lowest bit; None: from bit 0 of byte 0 of the payload (little endian).
    bits: one or more distinct positions; level: 0 or 1. A payload without all of these bits passes unchanged, counted.
    EN 50159: corruption, above the CRC. FIBlock: none (its Stuck-at holds whole values).
    """

    def __init__(self, signal: Signal | None, bits: tuple[int, ...], level: int) -> None:
        super().__init__(signal)
        if level not in (0, 1):
            raise FaultError(f"bit_stuck: level {level} given, allowed 0 or 1")
        self._bits: Final[tuple[int, ...]] = bits
        self._level: Final[int] = level
        given = given_bits("bit_stuck", bits, 64 if signal is None else signal.length)
        self._mask: Final[int] = given if signal is None else given << signal.start

    def fits(self, frame: Frame) -> bool:
        """The frame holds the signal, or for a payload all the bits to hold."""
        if self.signal is not None:
            return self.signal.fits(frame.data)
        return self._mask.bit_length() <= 8 * len(frame.data)

    def apply(self, now: int, frame: Frame, outlet: Outlet) -> Frame | None:
        """The frame with its bits held."""
        word = int.from_bytes(frame.data, "little") | self._mask
        if self._level == 0:
            word ^= self._mask
        return with_payload(frame, word.to_bytes(len(frame.data), "little"))

    def __reduce__(self) -> tuple[type["BitStuck"], tuple[Signal | None, tuple[int, ...], int]]:
        return BitStuck, (self.signal, self._bits, self._level)


def given_bits(what: str, bits: tuple[int, ...], length: int) -> int:
    """The mask of given positions; raises FaultError unless they are one or more, distinct, and below `length`."""
    mask = 0
    for bit in bits:
        if not 0 <= bit < length or mask >> bit & 1:
            raise FaultError(f"{what}: bits {bits} given, allowed are distinct positions 0..{length - 1}")
        mask |= 1 << bit
    if not mask:
        raise FaultError(f"{what}: no bits given, allowed are one or more positions 0..{length - 1}")
    return mask


def distinct_bits(rng: Generator, count: int, length: int) -> int:
    """A mask of `count` distinct bits below `length`, every set equally likely.

    Source: R. Floyd, in J. Bentley, "Programming pearls: a sample of brilliance", CACM 30 (1987) 754.
    """
    mask = 0
    for top in range(length - count, length):
        bit = 1 << int(rng.random() * (top + 1))
        mask |= 1 << top if mask & bit else bit
    return mask
