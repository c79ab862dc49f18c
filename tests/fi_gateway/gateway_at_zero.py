"""A gateway whose time 0 is known, with frames of one joint and injectors for them."""

import struct

from canopen_exo.bus.frame import Frame
from canopen_exo.bus.node import MS, Out
from canopen_exo.signal import Signal
from fi_gateway.effects import Effect
from fi_gateway.events import Event
from fi_gateway.faults import Fault
from fi_gateway.gateway import CONTROLLER_PORT, DRIVE_PORT, Gateway
from fi_gateway.injector import Injector, Target, stream
from fi_gateway.trigger import Trigger

POSITION = Signal("position", "right_knee", "right_knee_TPDO1", 0x185, 0, 32, True, 1.0, "rad", 0x6064, 0)
VELOCITY = Signal("velocity", "right_knee", "right_knee_TPDO1", 0x185, 32, 32, True, 1.0, "rad/s", 0x606C, 0)
CYCLE = 2 * MS
ZERO = 100 * MS
"""Time 0 in these tests."""


class Sink(Out):
    """Keeps what is sent."""

    def __init__(self) -> None:
        self.sent: list[tuple[int, Frame]] = []

    def send(self, port: int, frame: Frame) -> None:
        self.sent.append((port, frame))


def joint(position: int, velocity: int) -> Frame:
    return Frame(0x185, struct.pack("<ii", position, velocity))


def values(frame: Frame) -> tuple[int, int]:
    position, velocity = struct.unpack("<ii", frame.data)
    return position, velocity


def status(state: int, cycle: int, phase: int = 0) -> Frame:
    return Frame(0x2FF, struct.pack("<BHH", state, cycle, phase))


def injector(
    fault: Fault,
    event: Event,
    effect: Effect,
    name: str = "x",
    trigger: Trigger | None = None,
    target: Target | None = None,
    enabled: bool = True,
    from_power_up: bool = False,
    seed: int = 1,
) -> Injector:
    where = target if target is not None else Target(True, False, (0x185,))
    return Injector(name, where, fault, event, effect, trigger, stream(seed, 0, name), enabled, from_power_up)


def at(time_zero: int, injectors: list[Injector]) -> tuple[Gateway, Sink]:
    """A gateway that knows time 0, and has seen nothing else."""
    gateway, sink = Gateway(injectors, CYCLE), Sink()
    gateway.receive(time_zero, CONTROLLER_PORT, Frame(0x080, b"\x01"), sink)
    gateway.receive(time_zero, CONTROLLER_PORT, status(2, 0), sink)
    sink.sent.clear()
    return gateway, sink


def pass_through(gateway: Gateway, now: int, frame: Frame, port: int = DRIVE_PORT) -> Frame | None:
    """What comes out for one frame; wakes before it as a loop does (wake-ups due before now first)."""
    sink = Sink()
    while gateway.wake_at < now:
        gateway.wake(gateway.wake_at, sink)
    gateway.receive(now, port, frame, sink)
    assert all(side == 1 - port for side, _ in sink.sent)
    assert len(sink.sent) <= 1
    return sink.sent[0][1] if sink.sent else None
