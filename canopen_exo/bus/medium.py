"""One emulated CAN bus: transmit queues, arbitration, exact frame time.

Source: ISO 11898-1: the frame with the dominant (lowest) arbitration bits wins, the next one starts at
max(end of the previous frame, arrival); a frame lasts its stuffed bits and the 3-bit intermission.
A controller offers the frame of its queue with the lowest id, or (`Port.keep_order`) the one that came first: real ones
differ.
The time stamp of a frame is the end of its intermission: receivers could act 3 bit times earlier, which moves no
arbitration, because nobody may start before the bus is idle.
By itself the bus is ideal: no error ever happens, and nobody is needed to acknowledge. With a Wiring (`wire`) frames
can be disturbed, and everything follows from it: error frames, retransmission, error states, missing acknowledgement.
Two nodes that offer the same arbitration bits at once see a bit error then; on the ideal bus both frames pass one after
the other, in the order of their arrival, and `collisions` counts it.
Leaves out: CAN FD, which is refused.
"""

from typing import Final, final

from mypy_extensions import mypyc_attr

from canopen_exo.bus.frame import FLAG_ERROR, FLAG_EXTENDED, FLAG_FD, FLAG_REMOTE, Frame
from canopen_exo.bus.node import MS, NEVER, SECOND, ErrorState, Node, Out, PortState, Relay, open_filter
from canopen_exo.errors import CanopenExoError

QUEUE_LENGTH: Final = 64
"""Frames one transmit queue holds; one more is dropped and counted."""


RESTART_NS: Final = 100 * MS
"""From bus-off to the request to restart (assumed; a common setting of `restart-ms` of Linux)."""

_NOTHING: Final = Frame(0, b"")  # on the wire of a bus that was never used
_EVERYTHING: Final = open_filter()
_BUS_OFF: Final = ErrorState.BUS_OFF  # an enumeration is looked up slowly
_DOWN: Final = ErrorState.DOWN


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
class Listener:
    """Who hears a port: a node, on one of its own ports, with the filter there and what it answers through.

    Of a Relay: counts: its `frames`; onward: the port on which it passes frames on. Not used with another node.
    """

    __slots__ = ("counts", "filter", "node", "onward", "out", "port")

    def __init__(self, node: Node, port: int, out: Out, onward: "Port") -> None:
        self.node: Final[Node] = node
        self.port: Final[int] = port
        self.out: Final[Out] = out
        self.filter: Final[bytearray] = node.filters[port] if port < len(node.filters) else _EVERYTHING
        self.counts: Final[list[int]] = node.frames if isinstance(node, Relay) else []
        self.onward: Final[Port] = onward


@final
class Port:
    """One CAN controller on the medium. number: its place there; dropped: frames its full transmit queue refused.

    listeners: who hears what it sends. waiting: where its frames are queued; backlog: of one that keeps the order, the
    frames behind the one that it offers.
    The rest means something with a Wiring only. tec, rec, state: fault confinement; restart_ns: from bus-off to the
    request to restart, NEVER: it stays off; is_one_shot: a disturbed frame is not sent again; lost: frames that were
    not sent because of that or of bus-off; ready_ns: it may not send before then.
    """

    __slots__ = (
        "backlog", "dropped", "is_fifo", "is_one_shot", "listeners", "lost", "medium", "node", "number", "ready_ns",
        "rec", "restart_ns", "state", "tec", "waiting",
    )  # fmt: skip

    def __init__(self, medium: "Medium", node: Node, number: int) -> None:
        self.medium: Final[Medium] = medium
        self.node: Final[Node] = node
        self.number: Final[int] = number
        self.listeners: list[Listener] = []
        self.dropped: int = 0
        self.waiting: list[tuple[Frame, Port]] = medium.waiting
        self.is_fifo: bool = False
        self.backlog: Final[list[Frame]] = []
        self.tec: int = 0
        self.rec: int = 0
        self.state: ErrorState = ErrorState.ERROR_ACTIVE
        self.restart_ns: int = RESTART_NS
        self.is_one_shot: bool = False
        self.lost: int = 0
        self.ready_ns: int = 0

    @property
    def queued(self) -> int:
        """Frames in its transmit queue: counted when asked for, which is rare, not kept for every frame."""
        count = len(self.backlog)
        for _, sender in self.medium.waiting:
            if sender is self:
                count += 1
        return count

    def keep_order(self) -> None:
        """From now on it sends first in, first out. To be called while nothing waits."""
        self.is_fifo = True
        self.medium.has_order = self.medium.is_special = True
        self.open()

    def open(self) -> None:
        """Its queue takes frames. In the place of one that keeps the order lies what nothing can be put behind."""
        self.waiting = CLOSED if self.is_fifo else self.medium.waiting

    def follow(self) -> None:
        """The next frame competes, unless the one before does so still."""
        if self.backlog and self.queued == len(self.backlog):
            self.medium.insert(self.backlog.pop(0), self)


@final
class WireEvent:
    """What a Wiring tells the loop. Of three kinds, each a row of the trace (frame, sender):

    a frame that has passed, with the ports that accepted it (None: everybody who listens); an error frame that somebody
    sent, with no ports; the new state of a port, as `state` (port number on the medium), which is then the sender.
    """

    __slots__ = ("frame", "ports", "sender", "state")

    def __init__(self, frame: Frame, sender: Port, ports: list[Port] | None, state: PortState | None = None) -> None:
        self.frame: Final[Frame] = frame
        self.sender: Final[Port] = sender
        self.ports: Final[list[Port] | None] = ports
        self.state: Final[PortState | None] = state


@mypyc_attr(allow_interpreted_subclasses=True)
class WireSink:
    """Where a Wiring says what happened: a loop, or a hub."""

    def happened(self, now: int, events: list[WireEvent]) -> None:
        """In this order, at `now`."""
        raise NotImplementedError


class Wiring(Node):
    """What makes a medium more than ideal; it takes the place of arbitration and of the end of watched frames.

    A node only for its timers. sink: set by whoever carries the frames.
    """

    def __init__(self) -> None:
        super().__init__()
        self.sink: WireSink = WireSink()

    def start(self, now: int) -> None:
        """The bus is idle and something waits: begin what comes next, or put it off (then `wake_at` says to when)."""
        raise NotImplementedError

    def advance(self, now: int) -> None:
        """`Medium.end` has come while `is_watched`; sets `end` anew while there is more to come."""
        raise NotImplementedError

    def abort(self) -> None:
        """The cable is cut: what is under way ends without a result."""
        raise NotImplementedError


@final
class Medium:
    """A bus of a given bit rate. name: for traces and results; index: place in the loop's order.

    end: when the frame on the wire ends, NEVER while idle. on_wire: that frame and its sender, or the last ones.
    waiting: the frames of all transmit queues, each with its sender, in the order in which they will win. Each
    controller offers its lowest arbitration bits first, so one list in order of arbitration (then of arrival) holds all
    queues, of those that keep the order the first frame. collisions, errors: totals so far, errors being error frames.
    wire: what can go wrong, None: nothing. is_watched: what is on the wire ends through `wire`. is_restless: a
    controller will send an error flag though nothing waits. has_order: a controller keeps the order of its frames.
    is_special: there is a wire, or the cable is cut, or has_order.
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
        self.collisions: int = 0
        self.errors: int = 0
        self.wire: Wiring | None = None
        self.is_watched: bool = False
        self.is_restless: bool = False
        self.has_order: bool = False
        self.is_special: bool = False

    def install(self, wire: Wiring) -> None:
        """From now on errors can happen."""
        self.wire = wire
        self.is_special = True

    def attach(self, node: Node) -> Port:
        """A new port for `node`."""
        port = Port(self, node, len(self.ports))
        self.ports.append(port)
        return port

    def queue(self, port: Port, frame: Frame) -> None:
        """Put a frame into a port's transmit queue; a full queue drops it and counts it in `Port.dropped`."""
        if frame.flags & (FLAG_FD | FLAG_ERROR):
            kind = "CAN FD frame" if frame.flags & FLAG_FD else "error frame"
            raise CanopenExoError(f"medium {self.name!r}: {kind} {frame!r} given; this bus is classical CAN")
        if port.state is _BUS_OFF or port.state is _DOWN:
            port.lost += 1
            return
        if (port.is_fifo or len(self.waiting) >= QUEUE_LENGTH) and port.queued >= QUEUE_LENGTH:
            port.dropped += 1
        elif port.is_fifo and (port.queued or self._may_return(port)):
            port.backlog.append(frame)
        else:
            self.insert(frame, port)

    def _may_return(self, port: Port) -> bool:
        """Its frame is on the wire, and may be disturbed yet."""
        return self.wire is not None and self.end != NEVER and self.on_wire[1] is port

    def insert(self, frame: Frame, port: Port) -> None:
        """A frame that competes, among those that wait."""
        waiting = self.waiting
        at = len(waiting)
        arbitration = frame.arbitration
        while at and waiting[at - 1][0].arbitration > arbitration:
            at -= 1
        if at:
            other, rival = waiting[at - 1]
            if other.arbitration == arbitration and rival is not port:
                self.collisions += 1
        waiting.insert(at, (frame, port))

    def arbitrate(self, now: int) -> None:
        """Start the winning frame. The bus must be idle and a frame must wait; a cut bus starts nothing."""
        if self.is_cut:
            return
        if self.wire is not None:
            self.wire.start(now)
            return
        self.on_wire = self.waiting.pop(0)
        frame, port = self.on_wire
        self.end = now + (frame.bits or frame.measure()) * self.bit_ns
        port.follow()

    def cut(self) -> None:
        """Break the cable: the frame on the wire is lost, queues fill up, nothing passes until `mend`."""
        self.is_cut = self.is_special = True
        self.cuts += 1
        self.end = NEVER
        self.is_watched = False
        if self.wire is not None:
            self.wire.abort()
        self.on_wire[1].follow()

    def mend(self) -> None:
        """Join the cable again; queued frames compete at the next instant."""
        self.is_cut = False
        self.is_special = self.wire is not None or self.has_order


CLOSED: Final = [(Frame(0x1FFFFFFF, b"", FLAG_EXTENDED | FLAG_REMOTE), Port(Medium("none", 0, 1), Node(), 0))]
"""In the place of the queue of a port that keeps the order, or is bus-off: nothing can be put behind what is in it."""
