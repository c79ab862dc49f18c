"""One emulated CAN bus: transmit queues, arbitration, exact frame time.

Source: ISO 11898-1: the frame with the dominant (lowest) arbitration bits wins, the next one starts at
max(end of the previous frame, arrival); a frame lasts its stuffed bits and the 3-bit intermission.
The time stamp of a frame is the end of its intermission: receivers could act 3 bit times earlier, which moves no
arbitration, because nobody may start before the bus is idle.
Leaves out: bit errors, error frames and fault confinement; CAN FD is refused.
Two nodes that send the same arbitration bits at once would see a bit error; here both frames pass one after the
other, in the order of their ports, and `collisions` counts it.
"""

from typing import Final, final

from canopen_exo.bus.frame import FLAG_FD, Frame
from canopen_exo.bus.node import NEVER, SECOND, Node, Out
from canopen_exo.errors import CanopenExoError

QUEUE_LENGTH: Final = 64
"""Frames one transmit queue holds; one more is dropped and counted."""


@final
class Transmission:
    """A frame that passed a bus: one row of the trace. end_ns: loop clock; bus: index; sender: port on that bus."""

    __slots__ = ("bus", "end_ns", "frame", "sender")

    def __init__(self, end_ns: int, bus: int, frame: Frame, sender: int) -> None:
        self.end_ns: Final[int] = end_ns
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
    """One CAN controller on the medium: its transmit queue, lowest arbitration bits first."""

    __slots__ = ("dropped", "listeners", "node", "queue")

    def __init__(self, node: Node) -> None:
        self.node: Final[Node] = node
        self.queue: list[Frame] = []
        self.listeners: list[Listener] = []
        self.dropped: int = 0


@final
class Medium:
    """A bus of a given bit rate. name: for traces and results; index: place in the loop's order.

    end: when the frame on the wire ends, NEVER while idle. busy_ns, frames: totals so far.
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
        self.waiting: int = 0
        self.end: int = NEVER
        self.frame: Frame | None = None
        self.sender: int = 0
        self.is_cut: bool = False
        self.busy_ns: int = 0
        self.frames: int = 0
        self.collisions: int = 0

    def attach(self, node: Node) -> int:
        """A new port for `node`; returns its number on this medium."""
        self.ports.append(Port(node))
        return len(self.ports) - 1

    def queue(self, port: int, frame: Frame) -> None:
        """Put a frame into a port's transmit queue; a full queue drops it and counts it in `Port.dropped`."""
        if frame.flags & FLAG_FD:
            raise CanopenExoError(f"medium {self.name!r}: CAN FD frame {frame!r} given; this bus is classical CAN")
        sender = self.ports[port]
        queue = sender.queue
        if len(queue) >= QUEUE_LENGTH:
            sender.dropped += 1
            return
        at = len(queue)
        arbitration = frame.arbitration
        while at and queue[at - 1].arbitration > arbitration:
            at -= 1
        queue.insert(at, frame)
        self.waiting += 1

    def arbitrate(self, now: int) -> None:
        """Start the winning frame, when the bus is idle, whole, and a frame waits."""
        if self.end != NEVER or self.is_cut:
            return
        best = 1 << 40
        winner = -1
        number = 0
        for port in self.ports:
            if port.queue:
                arbitration = port.queue[0].arbitration
                if arbitration < best:
                    best = arbitration
                    winner = number
                elif arbitration == best:
                    self.collisions += 1
            number += 1
        if winner < 0:
            return
        frame = self.ports[winner].queue.pop(0)
        self.waiting -= 1
        self.frame = frame
        self.sender = winner
        duration = frame.bits * self.bit_ns
        self.busy_ns += duration
        self.frames += 1
        self.end = now + duration

    def finish(self) -> Frame:
        """Take the frame that ends now off the wire."""
        frame = self.frame
        if frame is None:
            raise CanopenExoError(f"medium {self.name!r}: no frame is on the wire")
        self.frame = None
        self.end = NEVER
        return frame

    def cut(self) -> None:
        """Break the cable: the frame on the wire is lost, queues fill up, nothing passes until `mend`."""
        self.is_cut = True
        self.frame = None
        self.end = NEVER

    def mend(self) -> None:
        """Join the cable again; queued frames compete at the next instant."""
        self.is_cut = False
