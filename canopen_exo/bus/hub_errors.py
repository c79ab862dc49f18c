"""A timed bus of the hub on which errors happen: a Wire on its Medium, and clients that hear of it.

Source: docs/hub.md, docs/wire.md. Every client is a node with a CAN controller of its own: alone it is not
acknowledged, and one that goes bus-off neither sends nor hears until its restart.
An error on the bus is told to every client, as the one tells it that noticed first, but without its counters to the
others; a new error state is told to the client whose it is.
"""

from typing import Final, final

from canopen_exo.bus.disturbance import Disturbance
from canopen_exo.bus.error_frame import ERROR_FLAG, of_another
from canopen_exo.bus.frame import FLAG_ERROR, Frame
from canopen_exo.bus.hub_core import Client, TimedBus
from canopen_exo.bus.hub_wire import FLAG_OWN, KIND_SENT, OPTION_CONFIRM, OPTION_OWN, pack_count, pack_record
from canopen_exo.bus.medium import Port, WireEvent, WireSink
from canopen_exo.bus.node import NEVER, Out
from canopen_exo.bus.wire import Wire


@final
class ErrorBus(TimedBus):
    """A timed bus with a Wire. disturbances: what disturbs it. errors: error frames told so far."""

    def __init__(self, name: str, index: int, bitrate: int, disturbances: list[Disturbance]) -> None:
        super().__init__(name, index, bitrate)
        self.wire: Final[Wire] = Wire(self.medium, disturbances)
        self.medium.install(self.wire)
        self.wire.sink = _Sink(self)
        self._out: Final[Out] = Out()
        self._now: int = 0
        self._taken: Final[dict[int, int]] = {}  # by port: frames of this client that its queue took
        self._confirmed: Final[dict[int, int]] = {}

    def join(self, client: Client, now: int) -> None:
        """Connect a client: one more that acknowledges."""
        super().join(client, now)
        self.wire.connect(now, self.medium.ports[client.port])
        self._taken[client.port] = self._confirmed[client.port] = 0

    def leave(self, client: Client) -> None:
        """Disconnect a client: what it still wanted to send is gone with it."""
        super().leave(client)
        self.wire.disconnect(self._now, self.medium.ports[client.port])

    def queue_frame(self, client: Client, data: bytes, at: int) -> None:
        """Count what the queue takes, to confirm it when it has left."""
        port = self.medium.ports[client.port]
        before = port.dropped + self.rejected
        super().queue_frame(client, data, at)
        if port.dropped + self.rejected == before:
            self._taken[client.port] += 1

    def wake(self, now: int) -> None:
        """Serve the bus and its timers up to `now`, in order."""
        medium, wire = self.medium, self.wire
        while True:
            at = min(medium.end, wire.wake_at)
            if at > now:
                break
            self._now = at
            if medium.end == at:
                medium.end = NEVER
                self.lateness.add(now - at)
                if medium.is_watched:
                    wire.advance(at)
                else:
                    frame, sender = medium.on_wire
                    self.happened(at, [WireEvent(frame, sender, None)])
            else:
                wire.wake(at, self._out)
            self._start(at)
        self._now = now
        self._confirm()
        self.wake_at = min(medium.end, wire.wake_at)

    def settle(self, now: int) -> None:
        """An idle bus starts the winner of all that waits."""
        self._now = now
        self._start(now)
        self._confirm()
        self.wake_at = min(self.medium.end, self.wire.wake_at)

    def happened(self, now: int, events: list[WireEvent]) -> None:
        """Tell the clients whom it concerns."""
        for event in events:
            frame = event.frame
            if frame.flags & FLAG_ERROR:
                self._tell(now, frame, event.sender, event.state is not None)
                continue
            self.frames += 1
            record = pack_record(frame.can_id, frame.flags, frame.dlc, frame.data, now)
            for client in self.clients:
                port = self.medium.ports[client.port]
                if port is event.sender:
                    if client.options & OPTION_OWN:
                        own = pack_record(frame.can_id, frame.flags | FLAG_OWN, frame.dlc, frame.data, now)
                        self.skipped += client.offer(own, 1)
                elif port in event.ports if event.ports is not None else self.wire.hears(port):
                    self.skipped += client.offer(record, 1)

    def _tell(self, now: int, frame: Frame, whose: Port, is_state: bool) -> None:
        """An error frame: to its own client, and an error on the bus to the others."""
        for client in self.clients:
            can_id, data = frame.can_id, frame.data
            if self.medium.ports[client.port] is not whose:
                if is_state:
                    continue
                can_id, data = of_another(can_id, data)
            self.skipped += client.offer(pack_record(can_id & ~ERROR_FLAG, FLAG_ERROR, 8, data, now), 1)

    def _start(self, now: int) -> None:
        medium = self.medium
        if medium.end == NEVER and (medium.waiting or medium.is_restless):
            medium.arbitrate(now)

    def _confirm(self) -> None:
        """Tell who asked for it how many of its frames have left its queue, by whatever way."""
        medium = self.medium
        for client in self.clients:
            if client.options & OPTION_CONFIRM:
                port = medium.ports[client.port]
                under_way = medium.end != NEVER and medium.on_wire[1] is port and self.wire.is_plain
                gone = self._taken[client.port] - port.queued - (1 if under_way else 0)
                count = gone - self._confirmed[client.port]
                if count > 0:
                    client.outbox.extend(pack_count(KIND_SENT, 0, count))
                    self._confirmed[client.port] = gone


@final
class _Sink(WireSink):
    """The bus as its Wire sees it."""

    def __init__(self, bus: ErrorBus) -> None:
        self.bus: Final[ErrorBus] = bus

    def happened(self, now: int, events: list[WireEvent]) -> None:
        self.bus.happened(now, events)
