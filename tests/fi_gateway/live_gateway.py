"""Live control of a gateway, and whether frames pass it."""

from canopen_exo.bus.frame import Frame
from canopen_exo.bus.node import MS, Out
from canopen_exo.signal import Signal
from fi_gateway.control import LiveControl
from fi_gateway.effects import ConstantTime, Effect
from fi_gateway.events import Event, Never
from fi_gateway.faults import Drop, Fault
from fi_gateway.gateway import CONTROLLER_PORT, DRIVE_PORT, Gateway
from fi_gateway.injector import Injector, Target, stream
from fi_gateway.trigger import Trigger

POSITION = Signal("position", "right_knee", "right_knee_TPDO1", 0x185, 0, 32, True, 1.0, "rad", 0x6064, 0)
VELOCITY = Signal("velocity", "right_knee", "right_knee_TPDO1", 0x185, 32, 32, True, 1.0, "rad/s", 0x606C, 0)
CYCLE = 2 * MS
ZERO = 100 * MS


class Sink(Out):
    """Keeps what is sent."""

    def __init__(self) -> None:
        self.sent: list[tuple[int, Frame]] = []

    def send(self, port: int, frame: Frame) -> None:
        self.sent.append((port, frame))


def injector(
    name: str = "x",
    fault: Fault | None = None,
    event: Event | None = None,
    effect: Effect | None = None,
    trigger: Trigger | None = None,
    enabled: bool = True,
    from_power_up: bool = False,
) -> Injector:
    return Injector(
        name,
        Target(True, False, (0x185,)),
        fault or Drop(),
        event or Never(),
        effect or ConstantTime(10 * MS),
        trigger,
        stream(1, 0, name),
        enabled,
        from_power_up,
    )


def live(*injectors: Injector, time_zero: bool = True) -> LiveControl:
    gateway = Gateway(list(injectors), CYCLE)
    if time_zero:
        gateway.begin(ZERO)
    return LiveControl(gateway)


def passes(control: LiveControl, now: int, data: bytes = bytes(8)) -> bool:
    """Whether a frame of the target comes out unchanged; wakes as a loop does."""
    sink, frame = Sink(), Frame(0x185, data)
    gateway = control.gateway
    while gateway.wake_at < now:
        gateway.wake(gateway.wake_at, sink)
    gateway.receive(now, DRIVE_PORT, frame, sink)
    return (CONTROLLER_PORT, frame) in sink.sent


def state(control: LiveControl) -> list[str]:
    return [row.state for row in control.listing()]
