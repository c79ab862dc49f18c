"""The lock-step loop: media and nodes in virtual time, in one written total order.

At each instant: frames that end (by bus; each bus ends at most one), then nodes that are due (by index), then idle
buses arbitrate. No clock is read: the same nodes give the same trace on every machine.

A frame goes to the nodes whose acceptance filter takes it (`Node.filters`). What a Relay only passes on is put into the
queue of its other port here, which is what its `receive` would do.
"""

import copy
from typing import Final, final

from canopen_exo.bus.frame import Frame
from canopen_exo.bus.medium import QUEUE_LENGTH, Listener, Medium, Port, Transmission, WireEvent, WireSink, Wiring
from canopen_exo.bus.node import NEVER, NO_FILTER, PASS_ON, SECOND, ErrorState, Node, Out, PortState, Relay
from canopen_exo.errors import CanopenExoError


@final
class MediumOut(Out):
    """The transmit side of a node: its ports by number."""

    def __init__(self) -> None:
        self.ports: Final[list[Port]] = []

    def send(self, port: int, frame: Frame) -> None:
        """Put `frame` into the transmit queue of the node's port."""
        sender = self.ports[port]
        waiting = sender.waiting
        # in a burst the ids mostly rise, so the frame goes behind all others
        contends = waiting and (waiting[-1][0].arbitration >= frame.arbitration or len(waiting) >= QUEUE_LENGTH)
        if contends or frame.flags:
            sender.medium.queue(sender, frame)
        else:
            waiting.append((frame, sender))


@final
class Loop:
    """Carries frames between nodes over media. trace: every frame that passed a bus, in loop order; now: ns."""

    def __init__(self, media: list[Medium]) -> None:
        self.media: Final[list[Medium]] = media
        self.nodes: list[Node] = []
        self.outs: list[MediumOut] = []
        self.now: int = 0
        self._ends: Final[list[int]] = []
        self._frames: Final[list[Frame]] = []
        self._senders: Final[list[Port]] = []
        self._rows: Final[list[Transmission]] = []
        self._recalled: int = 0
        self._nowhere: Final[Medium] = Medium("none", -1, SECOND)

    @property
    def trace(self) -> list[Transmission]:
        """Every frame that passed a bus so far, in loop order."""
        rows = self._rows
        for at in range(len(rows) - self._recalled, len(self._ends)):
            sender = self._senders[at]
            rows.append(Transmission(self._ends[at], sender.medium.index, self._frames[at], sender.number))
        return rows

    def forget(self) -> None:
        """Leave the trace so far to somebody else who has it, and may give it back (`resume`)."""
        self._rows.clear()
        self._ends.clear()
        self._frames.clear()
        self._senders.clear()
        self._recalled = 0

    def resume(self, rows: list[Transmission]) -> None:
        """Of a copy that has forgotten: the trace so far. Nodes that have taken another one's place are heard."""
        self._rows.extend(rows)
        self._recalled = len(rows)
        for medium in self.media:
            self._listen(medium)

    def __deepcopy__(self, memo: dict[int, object]) -> "Loop":
        """The same state between two instants; the rows of the trace are shared."""
        twin = Loop([])
        memo[id(self)] = twin  # first: a Wire on a medium leads back here
        twin.media.extend(copy.deepcopy(self.media, memo))
        twin.nodes = copy.deepcopy(self.nodes, memo)
        twin.outs = copy.deepcopy(self.outs, memo)
        twin.now = self.now
        twin._rows.extend(self.trace)
        twin._recalled = len(twin._rows)
        return twin

    def connect(self, node: Node, media: list[Medium]) -> None:
        """Add a node; its port k is attached to media[k]. Order of adding is the order of waking."""
        out = MediumOut()
        for medium in media:
            out.ports.append(medium.attach(node))
        self.nodes.append(node)
        self.outs.append(out)
        for medium in self.media:
            self._listen(medium)

    def _listen(self, medium: Medium) -> None:
        """Who hears each sender: every node once, on the first of its ports there that is neither it nor bus-off."""
        for sender in medium.ports:
            listeners: list[Listener] = []
            for node, out in zip(self.nodes, self.outs, strict=True):
                hearing: list[int] = []
                deaf = False
                for port, own in enumerate(out.ports):
                    if own.medium is medium and own is not sender:
                        if own.state is ErrorState.BUS_OFF:
                            deaf = True
                        else:
                            hearing.append(port)
                if hearing and deaf:
                    listeners.append(Listener(_Part(node, hearing), hearing[0], out, sender))
                elif hearing:
                    onward = out.ports[1 - hearing[0]] if isinstance(node, Relay) else sender
                    listeners.append(Listener(node, hearing[0], out, onward))
            sender.listeners = listeners

    def install(self, wire: Wiring, medium: Medium) -> None:
        """Let errors happen on a medium; to be called after its nodes are connected. Its timers wake as a node's."""
        medium.install(wire)
        wire.sink = _Sink(self)
        self.nodes.append(wire)
        self.outs.append(MediumOut())

    def run_until(self, until: int) -> None:
        """Serve every instant up to and including `until` [ns].

        Longer than a function should be: nearly all instants are the end of one frame, and each call for one counts.
        """
        if until < self.now:
            raise CanopenExoError(f"loop: run until {until} ns given, it is {self.now} ns; time does not go back")
        now = self.now
        wake = self._first_wake()
        if wake < now:
            raise CanopenExoError(f"loop: a node asks to be woken at {wake} ns, it is {now} ns; wake_at must move on")
        media = self.media
        ends, frames, senders = self._ends, self._frames, self._senders
        first = self._nowhere
        is_shared = is_due = False
        bound = wake if wake <= until else until + 1  # frames that end before it come next
        while True:
            # idle buses arbitrate (at first: what was queued between two calls); then it shows which frame ends first
            end = NEVER
            for medium in media:
                at = medium.end
                if at == NEVER:
                    waiting = medium.waiting
                    if medium.is_special:
                        if waiting or medium.is_restless:
                            medium.arbitrate(now)
                            if medium.is_watched or medium.end == NEVER:  # then its Wiring may want to be woken
                                wake = self._first_wake()
                                bound = wake if wake <= until else until + 1
                        at = medium.end
                        if at == NEVER:
                            continue
                    elif waiting:  # as Medium.arbitrate, without the call
                        medium.on_wire = row = waiting.pop(0)
                        frame = row[0]
                        medium.end = at = now + (frame.bits or frame.measure()) * medium.bit_ns
                    else:
                        continue
                if at < end:
                    end = at
                    first = medium
                elif at == end:
                    is_shared = True
            if end < bound and not first.is_watched:  # nearly always: a plain frame, and nobody to be woken
                now = end
                first.end = NEVER
                frame, sender = first.on_wire
                ends.append(now)
                frames.append(frame)
                senders.append(sender)
                can_id = NO_FILTER if frame.flags else frame.can_id
                for listener in sender.listeners:
                    action = listener.filter[can_id]
                    if action == PASS_ON:
                        listener.counts[listener.port] += 1
                        onward = listener.onward
                        waiting = onward.waiting
                        if waiting:
                            listener.out.send(1 - listener.port, frame)
                        else:
                            waiting.append((frame, onward))
                    elif action:
                        node = listener.node
                        node.receive(now, listener.port, frame, listener.out)
                        if node.wake_at < wake:
                            wake = node.wake_at
                            is_due = wake <= now
                            bound = wake if wake <= until else until + 1
                if not is_due and not is_shared:
                    continue
            else:
                now = end if end < wake else wake
                if now > until:
                    break
                is_shared = end == now
            if is_shared:  # the other frames of this instant
                for medium in media:
                    if medium.end == now:
                        medium.end = NEVER
                        self._end(now, medium)
                wake = self._first_wake()
            is_shared = is_due = False
            if wake <= now:
                wake = self._wake(now)
            bound = wake if wake <= until else until + 1
        self.now = until

    def _end(self, now: int, medium: Medium) -> None:
        """The end of a frame that is watched, or of no base data frame: nothing is taken for granted."""
        wire = medium.wire
        if medium.is_watched and wire is not None:
            wire.advance(now)
            return
        frame, sender = medium.on_wire
        self._write(now, frame, sender)
        self._hear(now, frame, sender)

    def _write(self, now: int, frame: Frame, sender: Port) -> None:
        """A row of the trace."""
        self._ends.append(now)
        self._frames.append(frame)
        self._senders.append(sender)

    def _hear(self, now: int, frame: Frame, sender: Port) -> None:
        """A frame has passed: everybody who listens takes it."""
        for listener in sender.listeners:
            listener.node.receive(now, listener.port, frame, listener.out)

    def serve(self, now: int, events: list[WireEvent]) -> None:
        """What a Wiring says has happened: rows of the trace, frames to those who accepted them, notices."""
        for event in events:
            self._write(now, event.frame, event.sender)
            if event.state is not None:
                self._notify(now, event.sender, event.state)
            elif event.ports is None:
                self._hear(now, event.frame, event.sender)
            elif event.ports:
                self._deliver(now, event.frame, event.sender, event.ports)

    def _deliver(self, now: int, frame: Frame, sender: Port, ports: list[Port]) -> None:
        """To the nodes of these ports, each once."""
        for node, out in zip(self.nodes, self.outs, strict=True):
            hearing: list[int] = []
            deaf = False
            for number, port in enumerate(out.ports):
                if port in ports:
                    hearing.append(number)
                elif port.medium is sender.medium and port is not sender:
                    deaf = True
            if hearing and deaf:
                node.receive_on(now, hearing, frame, out)
            elif hearing:
                node.receive(now, hearing[0], frame, out)

    def _notify(self, now: int, port: Port, state: PortState) -> None:
        """Tell the node of a port, by the node's own number of it; who hears whom may have changed."""
        for medium in self.media:
            if medium is port.medium:
                self._listen(medium)
        for node, out in zip(self.nodes, self.outs, strict=True):
            for number, own in enumerate(out.ports):
                if own is port:
                    notice = PortState(number, state.state, state.tec, state.rec, state.cause, state.overrun)
                    node.port_changed(now, notice, out)

    def _first_wake(self) -> int:
        wake = NEVER
        for node in self.nodes:
            if node.wake_at < wake:
                wake = node.wake_at
        return wake

    def _wake(self, now: int) -> int:
        """Wake the nodes that are due, by index; returns when the next one is."""
        for index, node in enumerate(self.nodes):
            if node.wake_at <= now:
                node.wake(now, self.outs[index])
                if node.wake_at <= now:
                    raise CanopenExoError(
                        f"loop: node {index} ({type(node).__name__}) asks to be woken at {node.wake_at} ns again, "
                        f"it is {now} ns; wake() must move wake_at on"
                    )
        return self._first_wake()


@final
class _Part(Node):
    """A node of which only these ports hear, because the others are bus-off."""

    def __init__(self, node: Node, ports: list[int]) -> None:
        super().__init__()
        self.node: Final[Node] = node
        self.ports: Final[list[int]] = ports

    def receive(self, now: int, port: int, frame: Frame, out: Out) -> None:
        self.node.receive_on(now, self.ports, frame, out)
        self.wake_at = self.node.wake_at


@final
class _Sink(WireSink):
    """The loop as its Wirings see it."""

    def __init__(self, loop: Loop) -> None:
        self.loop: Final[Loop] = loop

    def happened(self, now: int, events: list[WireEvent]) -> None:
        self.loop.serve(now, events)
