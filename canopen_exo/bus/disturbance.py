"""What disturbs the bits of a bus, as the medium asks for it.

A Disturbance is asked for every attempt to send a frame, and answers with what happens to which bits, and to whom; and
again within the attempt when something has begun or ended to disturb it.
Nothing here knows chance or scenarios: noise and faults are made of it in `fi_gateway.wire_faults`.
"""

from typing import Final, final

from mypy_extensions import mypyc_attr

from canopen_exo.bus.frame import Frame
from canopen_exo.bus.node import NEVER

ALL: Final = -1
"""Every port, as a mask."""

FLIP: Final = 0
"""The ports see the complement of what is on the wire."""
DOMINANT: Final = 1
"""The ports see dominant, whatever is sent."""
NO_ACK: Final = 2
"""The ports do not acknowledge; the bits do not matter."""


@final
class Disruption:
    """Bits [first, end) of an attempt, counted from its SOF. ports: mask of those who see it, bit k for port k.

    NO_ACK: the bit is the ACK slot.
    """

    __slots__ = ("end", "first", "kind", "ports")

    def __init__(self, kind: int, first: int, end: int, ports: int = ALL) -> None:
        self.kind: Final[int] = kind
        self.first: Final[int] = first
        self.end: Final[int] = end
        self.ports: Final[int] = ports

    def __eq__(self, other: object) -> bool:
        return (
            isinstance(other, Disruption)
            and (self.kind, self.first, self.end, self.ports) == (other.kind, other.first, other.end, other.ports)
        )

    def __hash__(self) -> int:
        return hash((self.kind, self.first, self.end, self.ports))

    def __reduce__(self) -> tuple[type["Disruption"], tuple[int, int, int, int]]:
        return Disruption, (self.kind, self.first, self.end, self.ports)


def joined(before: list[Disruption], after: list[Disruption], at: int) -> list[Disruption]:
    """What disturbs an attempt: up to bit `at` the first ones, from there on the others."""
    found: list[Disruption] = []
    for one in before:
        if one.end <= at:
            found.append(one)
        elif one.first < at:
            found.append(Disruption(one.kind, one.first, at, one.ports))
    for one in after:
        if one.first >= at:
            found.append(one)
        elif one.end > at:
            found.append(Disruption(one.kind, at, one.end, one.ports))
    return found


@mypyc_attr(allow_interpreted_subclasses=True)
class Disturbance:
    """Something that acts on a bus."""

    def errors(self, now: int, until: int, bit_ns: int, frame: Frame | None, sender: int) -> list[Disruption]:
        """What happens from `now` to `until` [ns], a little more than the frame lasts, bit 0 beginning at `now`.

        frame: what port number `sender` sends; None: nothing is sent. From attempt to attempt `now` rises; asked again
        for the same one, with the same `now`, it answers as it knows then, and what it says of bits that have passed
        does not matter. A disruption may end after `until`; then it is not given again for that attempt.
        """
        return []

    def disturbed(self, now: int, frame: Frame | None) -> None:
        """Somebody noticed an error in an attempt to send `frame` after it had disrupted bits (None: an idle bus).

        Said once an attempt, when the first error is noticed, or a frame accepted that is not the one sent.
        """

    def next_ns(self, after: int) -> int:
        """When it acts at the earliest at or after `after` [ns] on a bus on which nothing is sent."""
        return NEVER
