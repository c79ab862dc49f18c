"""What disturbs the bits of a bus, as the medium asks for it.

A Disturbance is asked once for every attempt to send a frame, and answers with what happens to which bits, and to whom.
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
    """Bits [first, end) of an attempt, counted from its SOF. ports: mask of those who see it, bit k for port k."""

    __slots__ = ("end", "first", "kind", "ports")

    def __init__(self, kind: int, first: int, end: int, ports: int = ALL) -> None:
        self.kind: Final[int] = kind
        self.first: Final[int] = first
        self.end: Final[int] = end
        self.ports: Final[int] = ports


@mypyc_attr(allow_interpreted_subclasses=True)
class Disturbance:
    """Something that acts on a bus."""

    def errors(self, now: int, until: int, bit_ns: int, frame: Frame | None, sender: int) -> list[Disruption]:
        """What happens from `now` to `until` [ns], a little more than the frame lasts, bit 0 beginning at `now`.

        frame: what port number `sender` is about to send; None: nothing is sent. Time does not go back. A disruption
        may end after `until`; then it is not given again for the same attempt.
        """
        return []

    def disturbed(self, now: int, frame: Frame | None) -> None:
        """Somebody noticed an error in an attempt to send `frame` in which it had disrupted bits (None: an idle bus).

        Said once an attempt, when the first error is noticed, or a frame accepted that is not the one sent.
        """

    def next_ns(self, after: int) -> int:
        """When it acts at the earliest at or after `after` [ns] on a bus on which nothing is sent."""
        return NEVER
