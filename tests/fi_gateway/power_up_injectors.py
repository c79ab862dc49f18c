"""Injectors that count from power-up, and a gateway run with them."""

from canopen_exo.bus.frame import Frame
from canopen_exo.bus.node import MS, Out
from canopen_exo.signal import Signal
from fi_gateway.effects import ConstantTime, Effect
from fi_gateway.events import Event, Never
from fi_gateway.faults import Bias, Fault
from fi_gateway.gateway import DRIVE_PORT, Gateway
from fi_gateway.injector import Injector, Target, stream
from fi_gateway.trigger import Report, Trigger

COUNT = Signal("count", "left_hip", "left_hip_TPDO1", 0x181, 0, 8, False, 1.0, "", 0x2000, 0)
HERE = Target(True, False, (0x181,))


class Sink(Out):
    """Keeps what is sent."""

    def __init__(self) -> None:
        self.sent: list[tuple[int, Frame]] = []

    def send(self, port: int, frame: Frame) -> None:
        self.sent.append((port, frame))


def injector(
    name: str = "x",
    event: Event | None = None,
    effect: Effect | None = None,
    trigger: Trigger | None = None,
    fault: Fault | None = None,
    target: Target = HERE,
    reports: tuple[Report, ...] = (),
    seed: int = 1,
    most: int = 0,
) -> Injector:
    """Counts from power-up; adds 1."""
    return Injector(
        name,
        target,
        fault if fault is not None else Bias(COUNT, 1),
        event if event is not None else Never(),
        effect if effect is not None else ConstantTime(50),
        trigger,
        stream(seed, 0, name),
        True,
        True,
        None,
        most,
        None,
        reports,
    )


def run(until: int, injectors: list[Injector], frames: tuple[tuple[int, Frame], ...] = ()) -> tuple[Gateway, Sink]:
    """Power-up with a frame that is no target at 0, then these frames from the drives, all wake-ups up to `until`."""
    gateway, sink = Gateway(injectors, 2 * MS), Sink()
    for now, frame in ((0, Frame(0x7FF, b"")), *frames, (until + 1, None)):
        while gateway.wake_at < now:
            gateway.wake(gateway.wake_at, sink)
        if frame is not None:
            gateway.receive(now, DRIVE_PORT, frame, sink)
    return gateway, sink


def opened(gateway: Gateway) -> list[tuple[str, int, str]]:
    return [(one.injector, one.start_ns, one.cause) for one in gateway.records]


def tpdo(value: int = 5) -> Frame:
    return Frame(0x181, bytes((value,)))
