"""One emulated CAN bus: transmit queues, arbitration, exact frame time.

Source: ISO 11898-1: the frame with the dominant (lowest) arbitration bits wins, the next one starts at
max(end of the previous frame, arrival); a frame lasts its stuffed bits and the 3-bit intermission.
The time stamp of a frame is the end of its intermission: receivers could act 3 bit times earlier, which moves no
arbitration, because nobody may start before the bus is idle.
Leaves out: bit errors, error frames and fault confinement; CAN FD is refused.
Two nodes that offer the same arbitration bits at once would see a bit error; here both frames pass one after the
other, in the order of their arrival, and `collisions` counts it.
"""

from typing import Final, final

from canopen_exo.bus.frame import FLAG_FD, Frame
from canopen_exo.bus.node import NEVER, SECOND, Node, Out
from canopen_exo.errors import CanopenExoError

QUEUE_LENGTH: Final = 64
"""Frames one transmit queue holds; one more is dropped and counted."""


_NOTHING: Final = Frame(0, b"")  # on the wire of a bus that was never used


@final
class Transmission:
    """A frame that has passed a bus: a row of the trace. end_ns: loop clock; bus: index; sender: port on that bus."""

    __slots__ = ("bus", "end_ns", "frame", "sender")

    def __init__(self, end_ns: int, bus: int, frame: Frame, sender: int) -> None:
        self.end_ns: Final[int] = end_ns
        self.bus: Final[int] = bus
        self.frame: Final[Frame] = frame
        self.sender: Final[int] = sender


@final
class Port:
    """One CAN controller on the medium. number: its place there; dropped: frames its full transmit queue refused.

    listeners: who hears what it sends: node, the number of the port that hears it, and what the node answers through.
    """

    __slots__ = ("dropped", "listeners", "medium", "node", "number", "waiting")

    def __init__(self, medium: "Medium", node: Node, number: int) -> None:
        self.medium: Final[Medium] = medium
        self.node: Final[Node] = node
        self.number: Final[int] = number
        self.listeners: list[tuple[Node, int, Out]] = []
        self.dropped: int = 0
        self.waiting: Final[list[tuple[Frame, Port]]] = medium.waiting

    @property
    def queued(self) -> int:
        """Frames in its transmit queue: counted when asked for, which is rare, not kept for every frame."""
        count = 0
        for _, sender in self.waiting:
            if sender is self:
                count += 1
        return count


@final
class Medium:
    """A bus of a given bit rate. name: for traces and results; index: place in the loop's order.

    end: when the frame on the wire ends, NEVER while idle. on_wire: that frame and its sender, or the last ones.
    waiting: the frames of all transmit queues, each with its sender, in the order in which they will win. Each
    controller offers its lowest arbitration bits first, so one list in order of arbitration (then of arrival) holds all
    queues. busy_ns, frames, collisions: totals so far.
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
        self.waiting: Final[list[tuple[Frame, Port]]] = []
        self.end: int = NEVER
        self.on_wire: tuple[Frame, Port] = (_NOTHING, Port(self, Node(), -1))
        self.is_cut: bool = False
        self.cuts: int = 0
        self.busy_ns: int = 0
        self.frames: int = 0
        self.collisions: int = 0

    def attach(self, node: Node) -> Port:
        """A new port for `node`."""
        port = Port(self, node, len(self.ports))
        self.ports.append(port)
        return port

    def queue(self, port: Port, frame: Frame) -> None:
        """Put a frame into a port's transmit queue; a full queue drops it and counts it in `Port.dropped`."""
        if frame.flags & FLAG_FD:
            raise CanopenExoError(f"medium {self.name!r}: CAN FD frame {frame!r} given; this bus is classical CAN")
        waiting = self.waiting
        at = len(waiting)
        if at >= QUEUE_LENGTH and port.queued >= QUEUE_LENGTH:
            port.dropped += 1
            return
        arbitration = frame.arbitration
        while at:
            other, rival = waiting[at - 1]
            if other.arbitration <= arbitration:
                if other.arbitration == arbitration and rival is not port:
                    self.collisions += 1
                break
            at -= 1
        waiting.insert(at, (frame, port))

    def arbitrate(self, now: int) -> None:
        """Start the winning frame. The bus must be idle and a frame must wait; a cut bus starts nothing."""
        if self.is_cut:
            return
        self.on_wire = self.waiting.pop(0)
        frame = self.on_wire[0]
        bits = frame.bits
        if bits == 0:
            bits = frame.measure()
        duration = bits * self.bit_ns
        self.frames += 1
        self.busy_ns += duration
        self.end = now + duration

    def cut(self) -> None:
        """Break the cable: the frame on the wire is lost, queues fill up, nothing passes until `mend`."""
        self.is_cut = True
        self.cuts += 1
        self.end = NEVER

    def mend(self) -> None:
        """Join the cable again; queued frames compete at the next instant."""
        self.is_cut = False
