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
    """One CAN controller on the medium. queued: frames in its transmit queue; dropped: frames a full queue refused."""

    __slots__ = ("dropped", "listeners", "node", "queued")

    def __init__(self, node: Node) -> None:
        self.node: Final[Node] = node
        self.listeners: list[Listener] = []
        self.queued: int = 0
        self.dropped: int = 0


@final
class Medium:
    """A bus of a given bit rate. name: for traces and results; index: place in the loop's order.

    end: when the frame on the wire ends, NEVER while idle. frame, sender: what is on the wire and whose it is.
    waiting: the frames of all transmit queues in the order in which they will win; busy_ns, frames: totals so far.
    Each controller offers its lowest arbitration bits first, so one list in order of arbitration (then of arrival)
    holds all queues; `senders` goes with it.
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
        self.waiting: list[Frame] = []
        self.senders: list[int] = []
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
        if sender.queued >= QUEUE_LENGTH:
            sender.dropped += 1
            return
        sender.queued += 1
        waiting = self.waiting
        if waiting and waiting[-1].arbitration > frame.arbitration:
            at = len(waiting) - 1
            arbitration = frame.arbitration
            while at and waiting[at - 1].arbitration > arbitration:
                at -= 1
            waiting.insert(at, frame)
            self.senders.insert(at, port)
        else:
            waiting.append(frame)
            self.senders.append(port)

    def arbitrate(self, now: int) -> None:
        """Start the winning frame. The bus must be idle and a frame must wait; a cut bus starts nothing."""
        if self.is_cut:
            return
        frame = self.waiting.pop(0)
        sender = self.senders.pop(0)
        self.ports[sender].queued -= 1
        if self.waiting and self.waiting[0].arbitration == frame.arbitration and self.senders[0] != sender:
            self.collisions += 1
        bits = frame.bits
        if bits == 0:
            bits = frame.measure()
        self.frame = frame
        self.sender = sender
        self.frames += 1
        duration = bits * self.bit_ns
        self.busy_ns += duration
        self.end = now + duration

    def cut(self) -> None:
        """Break the cable: the frame on the wire is lost, queues fill up, nothing passes until `mend`."""
        self.is_cut = True
        self.frame = None
        self.end = NEVER

    def mend(self) -> None:
        """Join the cable again; queued frames compete at the next instant."""
        self.is_cut = False
