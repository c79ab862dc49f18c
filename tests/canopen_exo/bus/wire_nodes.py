"""Nodes on a bus with errors."""

from canopen_exo.bus.disturbance import ALL, FLIP, Disruption, Disturbance
from canopen_exo.bus.frame import Frame
from canopen_exo.bus.loop import Loop
from canopen_exo.bus.medium import Medium
from canopen_exo.bus.node import NEVER, ErrorState, Node, Out, PortState
from canopen_exo.bus.wire import Wire

BIT = 1000
FRAME = Frame(0x181, bytes(8))
LENGTH = FRAME.measure()
ERROR_AT = 50
ERROR_BITS = 7 + 6 + 8 + 3


class Talker(Node):
    """Sends frames at given times on port 0 and writes down what it hears and is told."""

    def __init__(self, *sends: tuple[int, Frame]) -> None:
        super().__init__()
        self.sends = list(sends)
        self.heard: list[tuple[int, int, Frame]] = []
        self.states: list[tuple[int, ErrorState, int, int]] = []
        self._next()

    def _next(self) -> None:
        self.wake_at = self.sends[0][0] if self.sends else NEVER

    def receive(self, now: int, port: int, frame: Frame, out: Out) -> None:
        self.heard.append((now, port, frame))

    def wake(self, now: int, out: Out) -> None:
        while self.sends and self.sends[0][0] <= now:
            out.send(0, self.sends.pop(0)[1])
        self._next()

    def port_changed(self, now: int, state: PortState, out: Out) -> None:
        self.states.append((now, state.state, state.tec, state.rec))


class Script(Disturbance):
    """Gives the next of these to every attempt that sends something."""

    def __init__(self, *attempts: list[Disruption]) -> None:
        self.attempts = list(attempts)

    def errors(self, now: int, until: int, bit_ns: int, frame: Frame | None, sender: int) -> list[Disruption]:
        return self.attempts.pop(0) if self.attempts and frame is not None else []


class Every(Disturbance):
    """The same to all attempts before `until_ns`, and to those only that have this id."""

    def __init__(self, disruption: Disruption, can_id: int = -1, until_ns: int = NEVER) -> None:
        self.disruption = disruption
        self.can_id = can_id
        self.until_ns = until_ns

    def errors(self, now: int, until: int, bit_ns: int, frame: Frame | None, sender: int) -> list[Disruption]:
        if frame is None or now >= self.until_ns or (self.can_id >= 0 and frame.can_id != self.can_id):
            return []
        return [self.disruption]


def flip(at: int = ERROR_AT, ports: int = ALL) -> Disruption:
    return Disruption(FLIP, at, at + 1, ports)


class Bus:
    """Nodes on one medium with errors."""

    def __init__(self, nodes: list[Node], *disturbances: Disturbance) -> None:
        self.medium = Medium("bus", 0, 1_000_000)
        self.loop = Loop([self.medium])
        for node in nodes:
            self.loop.connect(node, [self.medium])
        self.wire = Wire(self.medium, list(disturbances))
        self.loop.install(self.wire, self.medium)

    def rows(self) -> list[tuple[int, str]]:
        return [(row.end_ns // BIT, repr(row.frame)) for row in self.loop.trace]

    def frames(self) -> list[tuple[int, int]]:
        return [(row.end_ns // BIT, row.sender) for row in self.loop.trace if not row.frame.flags]

    def counters(self) -> list[tuple[int, int]]:
        return [(port.tec, port.rec) for port in self.medium.ports]
