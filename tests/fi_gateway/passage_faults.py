"""Faults that make frames late, double or rename them, and a gateway that has them."""

from typing import final

from numpy.random import Generator

from canopen_exo.bus.frame import Frame
from canopen_exo.bus.node import MS, Out
from canopen_exo.signal import Signal
from fi_gateway.effects import Infinite
from fi_gateway.events import At
from fi_gateway.faults import Fault
from fi_gateway.gateway import CONTROLLER_PORT, DRIVE_PORT, Gateway
from fi_gateway.injector import Injector, Target, stream
from fi_gateway.outlet import Outlet

COUNT = Signal("count", "left_hip", "left_hip_TPDO1", 0x181, 0, 8, False, 1.0, "", 0x2000, 0)


class Sink(Out):
    """Keeps what is sent, with the time of the call."""

    def __init__(self) -> None:
        self.now = 0
        self.sent: list[tuple[int, int, Frame]] = []

    def send(self, port: int, frame: Frame) -> None:
        self.sent.append((self.now, port, frame))


class Slow(Fault):
    """Every frame later by a time that its first byte gives [10 ns]; 0: goes on at once."""

    def __init__(self, in_order: bool, step: int = 10) -> None:
        super().__init__()
        self.in_order = in_order
        self.step = step

    def apply(self, now: int, frame: Frame, outlet: Outlet) -> Frame | None:
        wait = self.step * frame.data[0] if frame.data else 0
        if wait == 0:
            return frame
        outlet.later(now + wait, frame, self.in_order)
        return None

    def __reduce__(self) -> tuple[type["Slow"], tuple[bool, int]]:
        return Slow, (self.in_order, self.step)


class Twice(Fault):
    """Each frame, and before it a further one; after `later` ns (0 for none) a third."""

    def __init__(self, later: int = 0, can_id: int = -1) -> None:
        super().__init__()
        self.later = later
        self.can_id = can_id

    def apply(self, now: int, frame: Frame, outlet: Outlet) -> Frame | None:
        outlet.insert(Frame(self.can_id if self.can_id >= 0 else frame.can_id, frame.data))
        if self.later:
            outlet.later(now + self.later, frame, False)
        return frame

    def __reduce__(self) -> tuple[type["Twice"], tuple[int, int]]:
        return Twice, (self.later, self.can_id)


class Rename(Fault):
    """Another COB-ID, or an extended one."""

    def __init__(self, can_id: int, flags: int = 0) -> None:
        super().__init__()
        self.can_id = can_id
        self.flags = flags

    def apply(self, now: int, frame: Frame, outlet: Outlet) -> Frame | None:
        return Frame(self.can_id, frame.data, self.flags)

    def __reduce__(self) -> tuple[type["Rename"], tuple[int, int]]:
        return Rename, (self.can_id, self.flags)


class Beat(Fault):
    """Inserts a frame every `period` ns while active, from the start on."""

    def __init__(self, period: int, can_id: int = 0x181) -> None:
        super().__init__()
        self.period = period
        self.can_id = can_id

    def begin(self, now: int, held: dict[int, Frame], rng: Generator) -> bool:
        self.wake_at = now
        return True

    def apply(self, now: int, frame: Frame, outlet: Outlet) -> Frame | None:
        return frame

    def wake(self, now: int, outlet: Outlet) -> None:
        self.wake_at = now + self.period
        outlet.insert(Frame(self.can_id, b"\xbe"))

    def __reduce__(self) -> tuple[type["Beat"], tuple[int, int], dict[str, object]]:
        return Beat, (self.period, self.can_id), {"wake_at": self.wake_at}


class Stuck(Beat):
    """Does not move on."""

    def wake(self, now: int, outlet: Outlet) -> None:
        self.wake_at = now


def always(fault: Fault, name: str = "x", ids: tuple[int, ...] = (0x181,), both: bool = False) -> Injector:
    """Active from power-up on."""
    target = Target(True, both, ids)
    return Injector(name, target, fault, At((0,)), Infinite(), None, stream(1, 0, name), True, True)


@final
class Bench:
    """A gateway and what has come out, served as a loop does."""

    def __init__(self, *injectors: Injector) -> None:
        self.gateway = Gateway(list(injectors), 2 * MS)
        self.sink = Sink()

    def until(self, now: int) -> None:
        """Serve all wake-ups up to and including `now`."""
        while self.gateway.wake_at <= now:
            self.sink.now = self.gateway.wake_at
            self.gateway.wake(self.gateway.wake_at, self.sink)
            assert self.gateway.wake_at > self.sink.now

    def give(self, now: int, frame: Frame, port: int = DRIVE_PORT) -> None:
        """A frame ends at `now`."""
        self.until(now - 1)
        self.sink.now = now
        self.gateway.receive(now, port, frame, self.sink)

    def came(self) -> list[tuple[int, bytes]]:
        """Time and payload of all that has come out to the controller."""
        return [(at, frame.data) for at, port, frame in self.sink.sent if port == CONTROLLER_PORT]


def tpdo(*data: int) -> Frame:
    return Frame(0x181, bytes(data))
