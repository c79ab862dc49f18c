"""One emulated CAN bus: transmit queues, arbitration, exact frame time.

Source: ISO 11898-1: the frame with the dominant (lowest) arbitration bits wins, the next one starts at
max(end of the previous frame, arrival); a frame lasts its stuffed bits and the 3-bit intermission.
The time stamp of a frame is the end of its intermission: receivers could act 3 bit times earlier, which moves no
arbitration, because nobody may start before the bus is idle.
Leaves out: bit errors, error frames and fault confinement; CAN FD is refused.
Two nodes that send the same arbitration bits at once would see a bit error; here both frames pass one after the
other, in the order of their arrival, and `collisions` counts it.
"""

from typing import Final, final

from canopen_exo.bus.frame import FLAG_FD, Frame
from canopen_exo.bus.node import NEVER, SECOND, Node, Out
from canopen_exo.errors import CanopenExoError

QUEUE_LENGTH: Final = 64
"""Frames one transmit queue holds; one more is dropped and counted."""


@final
class Transmission:
    """A frame on its way over a bus: made when it is queued, a row of the trace when it has passed.

    end_ns: loop clock, 0 until it has won the bus; bus: index; sender: port on that bus.
    """

    __slots__ = ("bus", "end_ns", "frame", "sender")

    def __init__(self, end_ns: int, bus: int, frame: Frame, sender: int) -> None:
        self.end_ns: int = end_ns
        self.bus: Final[int] = bus
        self.frame: Final[Frame] = frame
        self.sender: Final[int] = sender


@final
class Listener:
    """Who hears the frames of a sender: a node, the port it hears them on, and its Out."""

    __slots__ = ("node", "out", "port")

    def __init__(self, node: Node, port: int, out: Out) -> None:
        self.node: Final[Node] = node
        self.port: Final[int] = port
        self.out: Final[Out] = out


@final
class Port:
    """One CAN controller on the medium. number: its place there; dropped: frames its full transmit queue refused."""

    __slots__ = ("_waiting", "dropped", "listeners", "node", "number")

    def __init__(self, node: Node, number: int, waiting: list[Transmission]) -> None:
        self.node: Final[Node] = node
        self.number: Final[int] = number
        self.listeners: list[Listener] = []
        self.dropped: int = 0
        self._waiting: Final[list[Transmission]] = waiting

    @property
    def queued(self) -> int:
        """Frames in its transmit queue: counted when asked for, which is rare, not kept for every frame."""
        count = 0
        for row in self._waiting:
            if row.sender == self.number:
                count += 1
        return count


@final
class Medium:
    """A bus of a given bit rate. name: for traces and results; index: place in the loop's order.

    end: when the frame on the wire ends, NEVER while idle. on_wire: that frame, None while idle.
    waiting: the frames of all transmit queues in the order in which they will win; busy_ns, frames: totals so far.
    Each controller offers its lowest arbitration bits first, so one list in order of arbitration (then of arrival)
    holds all queues.
    """

    def __init__(self, name: str, index: int, bitrate: int) -> None:
        if bitrate <= 0 or SECOND % bitrate:
            raise CanopenExoError(
                f"medium {name!r}: bit rate {bitrate} given; its bit time must be a whole number of nanoseconds, "
                "such as 1000000, 500000, 250000 or 125000 bit/s"
            )
        self.name: Final[str] = name
        self.index: Final[int] = index
        self.bit_ns: Final[int] = SECOND // bitrate
        self.ports: list[Port] = []
        self.waiting: Final[list[Transmission]] = []
        self.end: int = NEVER
        self.on_wire: Transmission | None = None
        self.is_cut: bool = False
        self.cuts: int = 0
        self.busy_ns: int = 0
        self.frames: int = 0
        self.collisions: int = 0

    @property
    def frame(self) -> Frame | None:
        """The frame of `on_wire`."""
        return self.on_wire.frame if self.on_wire is not None else None

    @property
    def sender(self) -> int:
        """The port of `on_wire`, 0 for none."""
        return self.on_wire.sender if self.on_wire is not None else 0

    def attach(self, node: Node) -> int:
        """A new port for `node`; returns its number on this medium."""
        number = len(self.ports)
        self.ports.append(Port(node, number, self.waiting))
        return number

    def queue(self, port: int, frame: Frame) -> None:
        """Put a frame into a port's transmit queue; a full queue drops it and counts it in `Port.dropped`."""
        if frame.flags and frame.flags & FLAG_FD:
            raise CanopenExoError(f"medium {self.name!r}: CAN FD frame {frame!r} given; this bus is classical CAN")
        waiting = self.waiting
        at = len(waiting)
        if at:
            if at >= QUEUE_LENGTH and self.ports[port].queued >= QUEUE_LENGTH:
                self.ports[port].dropped += 1
                return
            arbitration = frame.arbitration
            while at and waiting[at - 1].frame.arbitration > arbitration:
                at -= 1
        waiting.insert(at, Transmission(0, self.index, frame, port))

    def arbitrate(self, now: int) -> None:
        """Start the winning frame. The bus must be idle and a frame must wait; a cut bus starts nothing."""
        if self.is_cut:
            return
        waiting = self.waiting
        row = waiting.pop(0)
        frame = row.frame
        if waiting:
            other = waiting[0]
            if other.frame.arbitration == frame.arbitration and other.sender != row.sender:
                self.collisions += 1
        bits = frame.bits
        if bits == 0:
            bits = frame.measure()
        duration = bits * self.bit_ns
        self.frames += 1
        self.busy_ns += duration
        self.end = row.end_ns = now + duration
        self.on_wire = row

    def cut(self) -> None:
        """Break the cable: the frame on the wire is lost, queues fill up, nothing passes until `mend`."""
        self.is_cut = True
        self.cuts += 1
        self.on_wire = None
        self.end = NEVER

    def mend(self) -> None:
        """Join the cable again; queued frames compete at the next instant."""
        self.is_cut = False
