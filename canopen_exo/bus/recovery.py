"""The way out of bus-off.

Source: ISO 11898-1 (Bosch CAN 2.0B, chapter 8): a node that is bus-off may become error-active, its counters 0, after
128 occurrences of 11 consecutive recessive bits, once it is asked to.
"""

from typing import Final, final

from canopen_exo.bus.medium import Port
from canopen_exo.bus.node import ErrorState

RECOVERY_SEQUENCES: Final = 128
RECESSIVE_BITS: Final = 11
"""Leaving bus-off: 128 occurrences of 11 consecutive recessive bits (ISO 11898-1). The ACK delimiter, EOF and
intermission of a frame are one, and so are the error delimiter and intermission of an error frame."""

def is_present(port: Port) -> bool:
    """It takes part: neither bus-off nor away."""
    return port.state is not ErrorState.BUS_OFF and port.state is not ErrorState.DOWN


@final
class Recovery:
    """A port on its way out of bus-off. request_ns: when it is asked to restart; left: sequences still to come."""

    __slots__ = ("left", "port", "request_ns")

    def __init__(self, port: Port, request_ns: int, left: int = RECOVERY_SEQUENCES) -> None:
        self.port: Final[Port] = port
        self.request_ns: Final[int] = request_ns
        self.left: int = left

    def _since(self, free_ns: int, bit_ns: int) -> int:
        """The bus has been recessive since then, and the port listens: its last frame was over at `free_ns`."""
        return max(free_ns - RECESSIVE_BITS * bit_ns, self.request_ns)

    def count(self, free_ns: int, now: int, bit_ns: int) -> None:
        """A frame begins at `now`: what went before counts."""
        since = self._since(free_ns, bit_ns)
        if now > since:
            self.left -= (now - since) // (RECESSIVE_BITS * bit_ns)

    def done_ns(self, free_ns: int, bit_ns: int) -> int:
        """When it is over unless another frame begins."""
        return self._since(free_ns, bit_ns) + self.left * RECESSIVE_BITS * bit_ns

    def __reduce__(self) -> tuple[type["Recovery"], tuple[Port, int, int]]:
        return Recovery, (self.port, self.request_ns, self.left)
