"""A clock and channels that a test moves, and nodes for the real-time loop on them."""

from collections.abc import Callable

from canopen_exo.bus.channel import Arrival, Channel
from canopen_exo.bus.frame import Frame
from canopen_exo.bus.node import MS, NEVER, Node, Out, PortState
from canopen_exo.bus.realtime import RealTimeLoop

EPOCH = 7_000_000_000


class FakeChannel(Channel):
    """fd: fake descriptor. takes: how many frames it accepts before it blocks. reads: times of `receive`."""

    def __init__(self, world: "World", fd: int) -> None:
        super().__init__(f"fake:{fd}")
        self.world = world
        self.fd = fd
        self.takes = 1 << 30
        self.inbox: list[Arrival] = []
        self.sent: list[Frame] = []
        self.sent_at: list[int] = []
        self.reads: list[int] = []
        self.is_away = False
        self.on_read: Callable[[], None] = lambda: None

    def fileno(self) -> int:
        return self.fd

    def receive(self) -> list[Arrival]:
        self.reads.append(self.world.now)
        self.poll_at = NEVER
        arrivals = self.inbox
        self.inbox = []
        self.on_read()
        return arrivals

    def send(self, frame: Frame) -> bool:
        if self.is_away:
            self.lost += 1
            return True
        if self.takes == 0:
            return False
        self.takes -= 1
        self.sent.append(frame)
        self.sent_at.append(self.world.now)
        return True

    def close(self) -> None:
        pass


class World:
    """A clock that only `wait` moves, and what happens when. oversleep: every wait ends this much late, ns."""

    def __init__(self, channels: int = 1) -> None:
        self.now = 0
        self.oversleep = 0
        self.channels = [FakeChannel(self, 10 + index) for index in range(channels)]
        self.events: list[tuple[int, int, Callable[[], None]]] = []
        self.waits: list[float] = []
        self.ready: list[int] = []

    def clock(self) -> int:
        return EPOCH + self.now

    def pass_by(self, time: int) -> None:
        """Something takes its time."""
        self.now += time

    def at(self, time: int, action: Callable[[], None]) -> None:
        self.events.append((time, len(self.events), action))
        self.events.sort()

    def arrive(self, time: int, channel: int, frame: Frame, stamp: int = -1) -> None:
        arrival = Arrival(time if stamp < 0 else stamp, frame, None)
        self.at(time, lambda: self.channels[channel].inbox.append(arrival))

    def wait(self, readers: list[int], writers: list[int], timeout_s: float) -> tuple[list[int], list[int]]:
        """As select does: until something is ready or the time is over; here also until the next event."""
        self.waits.append(timeout_s)
        if not any(self.ready_of(readers, writers)):
            end = self.now + round(timeout_s * 1e9)
            if self.events and self.events[0][0] < end and (readers or writers):
                end = self.events[0][0]
            self.now = max(self.now, end)
        self.now += self.oversleep
        while self.events and self.events[0][0] <= self.now:
            self.events.pop(0)[2]()
        return self.ready_of(readers, writers)

    def ready_of(self, readers: list[int], writers: list[int]) -> tuple[list[int], list[int]]:
        readable = [channel.fd for channel in self.channels if channel.inbox and channel.fd in readers]
        readable += [fd for fd in self.ready if fd in readers]
        return readable, [channel.fd for channel in self.channels if channel.takes and channel.fd in writers]

    def loop(
        self,
        node: Node,
        ports: list[int],
        record: bool = False,
        measure_latency: bool = False,
        busy_poll: bool = False,
        gather_ns: int = 0,
    ) -> RealTimeLoop:
        channels: list[Channel] = list(self.channels)
        return RealTimeLoop(
            node,
            channels,
            ports,
            EPOCH,
            record=record,
            measure_latency=measure_latency,
            busy_poll=busy_poll,
            gather_ns=gather_ns,
            clock=self.clock,
            wait=self.wait,
        )


class Diary(Node):
    """Writes down what it is called with; wakes every `period` ns."""

    def __init__(self, period: int = NEVER) -> None:
        super().__init__()
        self.period = period
        self.wake_at = period
        self.rows: list[tuple[str, int, int]] = []
        self.states: list[tuple[int, PortState]] = []

    def receive(self, now: int, port: int, frame: Frame, out: Out) -> None:
        self.rows.append(("frame", now, frame.can_id))

    def wake(self, now: int, out: Out) -> None:
        self.rows.append(("wake", now, 0))
        self.wake_at += self.period

    def port_changed(self, now: int, state: PortState, out: Out) -> None:
        self.states.append((now, state))


class Sender(Node):
    """At 1 ms sends `frames` on `port`; writes down what it hears, with its port."""

    def __init__(self, frames: list[Frame], port: int = 0) -> None:
        super().__init__()
        self.frames = frames
        self.port = port
        self.wake_at = MS
        self.heard: list[tuple[int, int]] = []

    def receive(self, now: int, port: int, frame: Frame, out: Out) -> None:
        self.heard.append((port, frame.can_id))

    def wake(self, now: int, out: Out) -> None:
        self.wake_at = NEVER
        for frame in self.frames:
            out.send(self.port, frame)


class Forwarder(Node):
    """Port 0 to port 1 and back."""

    def receive(self, now: int, port: int, frame: Frame, out: Out) -> None:
        out.send(1 - port, frame)


def until(world: World, end: int) -> Callable[[int], bool]:
    world.at(end, lambda: None)  # the wait ends there
    return lambda now: now >= end


FRAMES = [Frame(0x300, b"\x01"), Frame(0x100, b"\x02"), Frame(0x300, b"\x03"), Frame(0x080, b"\x04")]
