"""The lock-step loop: media and nodes in virtual time, in one written total order.

At each instant: frames that end (by bus; each bus ends at most one), then nodes that are due (by index), then idle
buses arbitrate. No clock is read: the same nodes give the same trace on every machine.
"""

from typing import Final, final

from canopen_exo.bus.medium import Listener, Medium, Transmission
from canopen_exo.bus.node import NEVER, Node, Out
from canopen_exo.errors import CanopenExoError
from canopen_exo.bus.frame import Frame


@final
class MediumOut(Out):
    """The transmit side of a node: its ports by number."""

    def __init__(self) -> None:
        self.media: list[Medium] = []
        self.ports: list[int] = []

    def send(self, port: int, frame: Frame) -> None:
        """Put `frame` into the transmit queue of the node's port."""
        self.media[port].queue(self.ports[port], frame)


@final
class Loop:
    """Carries frames between nodes over media. trace: every frame that passed a bus, in loop order; now: ns."""

    def __init__(self, media: list[Medium]) -> None:
        self.media: Final[list[Medium]] = media
        self.nodes: list[Node] = []
        self.outs: list[MediumOut] = []
        self.trace: list[Transmission] = []
        self.now: int = 0

    def connect(self, node: Node, media: list[Medium]) -> None:
        """Add a node; its port k is attached to media[k]. Order of adding is the order of waking."""
        out = MediumOut()
        for medium in media:
            out.media.append(medium)
            out.ports.append(medium.attach(node))
        self.nodes.append(node)
        self.outs.append(out)
        for medium in self.media:
            self._listen(medium)

    def _listen(self, medium: Medium) -> None:
        """Who hears each sender: every other node once, on the first of its ports that is not the sender."""
        for number in range(len(medium.ports)):
            listeners: list[Listener] = []
            for node, out in zip(self.nodes, self.outs, strict=True):
                for port in range(len(out.ports)):
                    if out.media[port] is medium and out.ports[port] != number:
                        listeners.append(Listener(node, port, out))
                        break
            medium.ports[number].listeners = listeners

    def run_until(self, until: int) -> None:
        """Serve every instant up to and including `until` [ns]."""
        media, nodes, outs = self.media, self.nodes, self.outs
        trace = self.trace
        while True:
            now = NEVER
            for medium in media:
                if medium.end < now:
                    now = medium.end
                if medium.waiting and medium.end == NEVER and not medium.is_cut:
                    now = self.now  # queued from outside the loop, or the cable was mended
            for node in nodes:
                if node.wake_at < now:
                    now = node.wake_at
            if now > until:
                self.now = until
                return
            if now < self.now:
                raise CanopenExoError(f"loop: an event at {now} ns lies before {self.now} ns; wake_at must move on")
            self.now = now
            for medium in media:
                if medium.end == now:
                    frame = medium.finish()
                    sender = medium.sender
                    trace.append(Transmission(now, medium.index, frame, sender))
                    for listener in medium.ports[sender].listeners:
                        listener.node.receive(now, listener.port, frame, listener.out)
            index = 0
            for node in nodes:
                if node.wake_at <= now:
                    node.wake(now, outs[index])
                    if node.wake_at <= now:
                        raise CanopenExoError(
                            f"loop: node {index} ({type(node).__name__}) asks to be woken at {node.wake_at} ns again, "
                            f"it is {now} ns; wake() must move wake_at on"
                        )
                index += 1
            for medium in media:
                if medium.waiting and medium.end == NEVER:
                    medium.arbitrate(now)
