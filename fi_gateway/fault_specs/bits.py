"""Faults in files that act on single bits."""

from dataclasses import dataclass
from typing import Annotated, Literal

from pydantic import Field

from fi_gateway.boundary import Count, SpecError, Whole
from fi_gateway.fault_specs.base import FaultSpec, bit_length, check_positions
from fi_gateway.faults import BitFlip, BitStuck, Fault
from fi_gateway.target import Place


@dataclass(frozen=True, slots=True)
class BitFlipSpec(FaultSpec):
    """Bits inverted: `count` distinct random ones (new for every frame, or fixed for the activation), or `positions`.

    Positions count from the lowest bit of the signal, or from bit 0 of byte 0 of the payload.
    """

    type: Literal["bit_flip"]
    count: Count | None = None
    positions: Annotated[tuple[Whole, ...], Field(min_length=1)] | None = None
    bits: Literal["random", "fixed"] | None = None

    def build(self, place: Place) -> Fault:
        """See BitFlip."""
        length = bit_length(place)
        if self.positions is None:
            count = self.count if self.count is not None else 1
            if count > length:
                raise SpecError(("count",), f"{count} bits asked for; {place.words} has {length}")
            return BitFlip(place.signal, count, None, self.bits == "fixed")
        for key, given in (("count", self.count), ("bits", self.bits)):
            if given is not None:
                raise SpecError((key,), f"positions say which bits; leave {key} out, or leave positions out")
        check_positions(self.positions, length, place.words, "; flipped twice it would not change")
        return BitFlip(place.signal, len(self.positions), self.positions, True)

    def words(self, place: Place) -> str:
        """For people."""
        if self.positions is not None:
            return f"has {_bits(self.positions)} inverted"
        count = self.count or 1
        again = "the same for the whole activation" if self.bits == "fixed" else "drawn anew for every frame"
        return f"has {count} random bit{'s' if count > 1 else ''} inverted ({again})"


@dataclass(frozen=True, slots=True)
class BitStuckSpec(FaultSpec):
    """Given bits held at 0 or 1; positions as for `bit_flip`."""

    type: Literal["bit_stuck"]
    positions: Annotated[tuple[Whole, ...], Field(min_length=1)]
    level: Literal[0, 1]

    def build(self, place: Place) -> Fault:
        """See BitStuck."""
        check_positions(self.positions, bit_length(place), place.words, "")
        return BitStuck(place.signal, self.positions, self.level)

    def words(self, place: Place) -> str:
        """For people."""
        return f"has {_bits(self.positions)} held at {self.level}"


def _bits(positions: tuple[int, ...]) -> str:
    return f"bit{'s' if len(positions) > 1 else ''} {', '.join(map(str, positions))}"
