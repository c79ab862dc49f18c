"""The one interface between a loop and what is connected to a bus.

Cores receive `now` as an argument and never read a clock; all times are integer nanoseconds on the loop's clock.
Source: ISO 11898-1 (node, error states); the pull-style timer is this project's (`wake_at` is read before every wait).
"""

from enum import Enum
from typing import Final, final

from mypy_extensions import mypyc_attr

from canopen_exo.bus.frame import Frame

NEVER: Final = 1 << 61
"""A `wake_at` that never comes."""

MS: Final = 1_000_000
"""One millisecond in nanoseconds."""

SECOND: Final = 1_000_000_000
"""One second in nanoseconds."""


class ErrorState(Enum):
    """State of a CAN controller (ISO 11898-1, fault confinement), and what a driver adds to it."""

    ERROR_ACTIVE = "error_active"
    WARNING = "warning"
    ERROR_PASSIVE = "error_passive"
    BUS_OFF = "bus_off"
    DOWN = "down"


@final
class PortState:
    """The only error notice to Nodes: the new state of a port with its counters and why it changed.

    overrun: frames were lost on their way through the controller or its driver; the state may be as before.
    """

    __slots__ = ("cause", "overrun", "port", "rec", "state", "tec")

    def __init__(self, port: int, state: ErrorState, tec: int, rec: int, cause: str, overrun: bool = False) -> None:
        self.port: Final[int] = port
        self.state: Final[ErrorState] = state
        self.tec: Final[int] = tec
        self.rec: Final[int] = rec
        self.cause: Final[str] = cause
        self.overrun: Final[bool] = overrun


@mypyc_attr(allow_interpreted_subclasses=True)
class Out:
    """What a node sends through: `send(port, frame)` puts a frame into that port's transmit queue."""

    def send(self, port: int, frame: Frame) -> None:
        """Queue `frame` on `port`; a full queue drops the newest frame and counts it."""
        raise NotImplementedError


IGNORE: Final = 0
TAKE: Final = 1
PASS_ON: Final = 2
LOOK: Final = 3
"""What becomes of a frame at an acceptance filter (`Node.filters`)."""

NO_FILTER: Final = 0x800
"""Place in a filter of all frames but base data frames: TAKE."""


def open_filter() -> bytearray:
    """An acceptance filter that takes everything."""
    return bytearray([TAKE]) * (NO_FILTER + 1)


@mypyc_attr(allow_interpreted_subclasses=True)
class Node:
    """Something on a bus: a controller, a device, a rack of devices, a gateway.

    wake_at: absolute time [ns] of the next call to `wake`, NEVER for none; read afresh before every wait.
    filters: acceptance filters, as a CAN controller has them: by port and 11-bit id, IGNORE where `receive` does
    nothing with a base data frame, so that a loop need not call it, else TAKE. Without any the node takes everything.
    The node may change what stands in them at any time, but not take others.
    """

    def __init__(self) -> None:
        self.wake_at: int = NEVER
        self.filters: list[bytearray] = []

    def receive(self, now: int, port: int, frame: Frame, out: Out) -> None:
        """A frame ended at `now` on `port`. Must not raise whatever its bytes."""

    def receive_on(self, now: int, ports: list[int], frame: Frame, out: Out) -> None:
        """The same where only these of its ports accepted the frame, because of an error on the bus.

        A fifth member: only a node that keeps its ports apart (a rack of devices) has anything to do here.
        """
        self.receive(now, ports[0], frame, out)

    def wake(self, now: int, out: Out) -> None:
        """`wake_at` is reached; `now` is that time. Must move `wake_at` on."""

    def port_changed(self, now: int, state: PortState, out: Out) -> None:
        """A port changed its error state."""


@mypyc_attr(allow_interpreted_subclasses=True)
class Relay(Node):
    """A node with two ports, 0 and 1, that passes most frames on from one to the other, at once and unchanged.

    frames: received so far, by port. filters: PASS_ON where all that `receive` does with a base data frame is to count
    it in `frames` and send it on the other port; a loop may do that in its stead, without making a Frame. LOOK where
    `receive` also does what `look` does, and nothing else.
    """

    def __init__(self) -> None:
        super().__init__()
        self.frames: list[int] = [0, 0]
        self.filters = [open_filter(), open_filter()]

    def look(self, now: int, port: int, can_id: int) -> None:
        """A base data frame with this id came on `port` at `now`, and the loop has passed it on. Must ask for nothing:
        no other `wake_at`, no other filters. In the order of the frames of a port; of two ports, perhaps not.
        """
