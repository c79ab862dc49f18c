"""The transmit side of the real-time loop: what a node sends, to the channels at once, or into their queues.

A queue has the length of a controller's (`medium`), 64 frames, and its order: lowest arbitration bits first. That of a
relay is first in, first out: what comes from one bus is not to change its order on the way to the other.
Nothing waits for an interface that is bus-off or down: no command is to come out after an outage that was given before.
Leaves out: waiting until a channel takes frames again, which is the loop's.
"""

from collections.abc import Callable
from typing import Final, final

from canopen_exo.bus.channel import Channel
from canopen_exo.bus.frame import Frame
from canopen_exo.bus.lateness import Lateness
from canopen_exo.bus.medium import QUEUE_LENGTH, Transmission
from canopen_exo.bus.node import NEVER, ErrorState, Out


@final
class Waiting:
    """A frame that could not be sent yet. handled_ns: as `RealTimeOut.handled_ns` when it was given."""

    __slots__ = ("frame", "handled_ns", "port")

    def __init__(self, frame: Frame, port: int, handled_ns: int) -> None:
        self.frame: Final[Frame] = frame
        self.port: Final[int] = port
        self.handled_ns: Final[int] = handled_ns


@final
class Echo:
    """A frame of ours on its way to the node's other port on the same channel."""

    __slots__ = ("frame", "port", "sent_ns")

    def __init__(self, sent_ns: int, port: int, frame: Frame) -> None:
        self.sent_ns: Final[int] = sent_ns
        self.port: Final[int] = port
        self.frame: Final[Frame] = frame


@final
class Line:
    """A channel with the node's ports on it and the frames that wait for it, in the order in which they will go.

    is_away: bus-off or down, until a notice or a received frame says otherwise; discarded: frames lost for that.
    """

    __slots__ = ("channel", "discarded", "fd", "index", "is_away", "latency", "ports", "state", "waiting")

    def __init__(self, index: int, channel: Channel) -> None:
        self.index: Final[int] = index
        self.channel: Final[Channel] = channel
        self.ports: Final[list[int]] = []
        self.waiting: Final[list[Waiting]] = []
        self.latency: Final[Lateness] = Lateness()
        self.state: ErrorState = ErrorState.ERROR_ACTIVE
        self.is_away: bool = False
        self.discarded: int = 0
        self.fd: int = -1

    def note(self, state: ErrorState) -> None:
        """The interface has this state; what waits for one that is away is discarded and counted."""
        self.state = state
        self.is_away = state is ErrorState.BUS_OFF or state is ErrorState.DOWN
        if self.is_away:
            self.discarded += len(self.waiting)
            self.waiting.clear()


@final
class RealTimeOut(Out):
    """The transmit side of the node. handled_ns: stamp of the frame being handled, NEVER outside of `receive`.

    served_ns: the latest time that the node has been given, or that of a frame passed on in its stead.
    relay: what waits keeps its order, whatever its ids.
    """

    def __init__(
        self, clock: Callable[[], int], epoch_ns: int, trace: list[Transmission] | None, measure: bool, relay: bool
    ) -> None:
        self.lines: Final[list[Line]] = []
        self.echoes: list[Echo] = []
        self.dropped: Final[list[int]] = []
        self.handled_ns: int = NEVER
        self.served_ns: int = -NEVER
        self._clock: Final = clock
        self._epoch_ns: Final[int] = epoch_ns
        self._trace: Final = trace
        self._measure: Final[bool] = measure
        self._is_fifo: Final[bool] = relay

    def send(self, port: int, frame: Frame) -> None:
        """To the channel at once; into the queue of 64 while it would block; a full queue drops and counts it.

        While the channel is away, at once or not at all.
        """
        line = self.lines[port]
        if line.waiting or not self._try(line, port, frame, self.handled_ns):
            if line.is_away:
                line.discarded += 1
                return
            waiting = line.waiting
            at = len(waiting)
            if at >= QUEUE_LENGTH:
                self.dropped[port] += 1
                return
            if not self._is_fifo:
                arbitration = frame.arbitration
                while at and waiting[at - 1].frame.arbitration > arbitration:
                    at -= 1
            waiting.insert(at, Waiting(frame, port, self.handled_ns))

    def flush(self, line: Line) -> None:
        """Offer what waits, until it would block again."""
        waiting = line.waiting
        while waiting:
            first = waiting[0]
            if not self._try(line, first.port, first.frame, first.handled_ns):
                return
            waiting.pop(0)

    def _try(self, line: Line, port: int, frame: Frame, handled_ns: int) -> bool:
        channel = line.channel
        lost = channel.lost
        shared = len(line.ports) > 1
        now = 0
        if shared or self._trace is not None:  # before the call: afterwards the frame may have arrived long ago
            now = self._clock() - self._epoch_ns
        if not channel.send(frame):
            return False
        if channel.lost != lost:
            return True
        if self._trace is not None:
            self._trace.append(Transmission(now, line.index, frame, port))
        if self._measure and handled_ns != NEVER:
            line.latency.add(self._clock() - self._epoch_ns - handled_ns)
        if shared:
            self.echoes.append(Echo(now, line.ports[1] if line.ports[0] == port else line.ports[0], frame))
        return True
