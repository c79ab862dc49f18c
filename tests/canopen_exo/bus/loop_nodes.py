"""Nodes for the lock-step loop."""

from hypothesis import strategies as st

from canopen_exo.bus.frame import Frame
from canopen_exo.bus.loop import Loop
from canopen_exo.bus.medium import Medium
from canopen_exo.bus.node import NEVER, Node, Out

BIT = 1000
"""ns at 1 Mbit/s."""

Call = tuple[str, str, int, int, str]
"""Node, "frame" or "wake", now, port (-1 for a wake-up), frame."""


class Script(Node):
    """Sends frames at given times, on given ports, and writes down every call."""

    def __init__(self, name: str, log: list[Call], *sends: tuple[int, int, Frame]) -> None:
        super().__init__()
        self.name = name
        self.log = log
        self.sends = sorted(sends, key=lambda item: item[0])
        self._next()

    def _next(self) -> None:
        self.wake_at = self.sends[0][0] if self.sends else NEVER

    def receive(self, now: int, port: int, frame: Frame, out: Out) -> None:
        self.log.append((self.name, "frame", now, port, repr(frame)))

    def wake(self, now: int, out: Out) -> None:
        self.log.append((self.name, "wake", now, -1, ""))
        while self.sends and self.sends[0][0] <= now:
            _, port, frame = self.sends.pop(0)
            out.send(port, frame)
        self._next()


class Echo(Script):
    """Answers every frame at once with one of another id."""

    def receive(self, now: int, port: int, frame: Frame, out: Out) -> None:
        super().receive(now, port, frame, out)
        out.send(port, Frame(frame.can_id + 0x100, frame.data))


def duration(can_id: int, size: int = 0) -> int:
    return Frame(can_id, bytes(size)).measure() * BIT


def media(count: int = 1) -> list[Medium]:
    return [Medium(f"bus {index}", index, 1_000_000) for index in range(count)]


def rows(loop: Loop) -> list[tuple[int, int, int, int]]:
    return [(row.end_ns, row.bus, row.sender, row.frame.can_id) for row in loop.trace]


SENDS = st.lists(
    st.tuples(st.integers(0, 2_000_000), st.integers(0, 2), st.integers(0, 0x7FF), st.binary(max_size=8)), max_size=40
)
