"""Wire faults as the faults of injectors: the window is the injector's, what they do happens on a bus.

A fault here is made without a bus; whoever builds the rig attaches it to one (`attach`), and the gateway has itself
told what it does (`listen`). It acts when its injector is woken, at the instant at which the window opens: a gateway
that has wire faults asks to be woken then, so that the loop sees what has changed on the bus.
Leaves out: buses without a Wire, where these faults are refused before anything runs.
"""

from typing import Final, final

from mypy_extensions import mypyc_attr
from numpy.random import Generator

from canopen_exo.bus.frame import Frame
from canopen_exo.bus.loop import Loop
from canopen_exo.bus.medium import Medium, Port
from canopen_exo.bus.node import NEVER
from canopen_exo.bus.wire import Wire, is_present
from fi_gateway.errors import FaultError
from fi_gateway.faults.base import Fault
from fi_gateway.outlet import Outlet
from fi_gateway.wire_faults import BabblingIdiot, BusOff, WireFault, WireWatch


@mypyc_attr(allow_interpreted_subclasses=True)
class OnWire(Fault):
    """A fault on a bus. bus: "controller" or "drive"; adds: what it does is frames of its own."""

    def __init__(self, bus: str) -> None:
        super().__init__()
        self.bus: str = bus
        self.adds: bool = False
        self._wire: Wire | None = None

    @property
    def seen(self) -> int:
        """Attempts to send a frame that it could disturb, in this window or the last one."""
        return 0

    def listen(self, watch: WireWatch) -> None:
        """Have it tell what it does."""
        raise NotImplementedError

    def add_nodes(self, loop: Loop, medium: Medium) -> None:
        """Connect what it needs there, before the Wire is installed."""

    def attach(self, wire: Wire) -> None:
        """This is its bus."""
        self._wire = wire

    def begin(self, now: int, held: dict[int, Frame], rng: Generator) -> bool:
        """Ask for `wake` at once."""
        if self._wire is None:
            raise FaultError(f"a wire fault on the {self.bus} bus is not attached to it; only an emulated bus has one")
        self.wake_at = now
        return super().begin(now, held, rng)

    def apply(self, now: int, frame: Frame, outlet: Outlet) -> Frame | None:
        """Nothing happens to frames in the gateway."""
        return frame

    def wake(self, now: int, outlet: Outlet) -> None:
        """The window has just opened: act."""
        self.wake_at = NEVER
        if self._wire is not None:
            self._act(now, self._wire)

    def _act(self, now: int, wire: Wire) -> None:
        raise NotImplementedError


@final
class Disturbed(OnWire):
    """A disturbance that begins and ends with the window."""

    def __init__(self, bus: str, disturbance: WireFault) -> None:
        super().__init__(bus)
        self.disturbance: Final[WireFault] = disturbance

    @property
    def seen(self) -> int:
        """See OnWire."""
        return self.disturbance.seen

    def listen(self, watch: WireWatch) -> None:
        """See OnWire."""
        self.disturbance.watch = watch

    def attach(self, wire: Wire) -> None:
        """See OnWire."""
        super().attach(wire)
        wire.disturbances.append(self.disturbance)

    def begin(self, now: int, held: dict[int, Frame], rng: Generator) -> bool:
        """See Fault."""
        self.disturbance.draw_from(rng)
        self.disturbance.begin(now)
        return super().begin(now, held, rng)

    def bound(self, end_ns: int) -> None:
        """See Fault."""
        self.disturbance.until = end_ns

    def _act(self, now: int, wire: Wire) -> None:
        wire.replan(now)

    def __reduce__(self) -> tuple[type["Disturbed"], tuple[str, WireFault]]:
        return Disturbed, (self.bus, self.disturbance)


@final
class SwitchedOff(OnWire):
    """A controller that goes bus-off when the window opens, and is asked to restart `restart_ns` after its end.

    port: its number on that bus.
    """

    def __init__(self, bus: str, port: int, restart_ns: int) -> None:
        super().__init__(bus)
        self.port: Final[int] = port
        self.restart_ns: Final[int] = restart_ns
        self._watch: WireWatch = WireWatch()
        self._end_ns: int = NEVER
        self._own_restart_ns: int = NEVER
        self._is_off: bool = False

    def listen(self, watch: WireWatch) -> None:
        """See OnWire."""
        self._watch = watch

    def bound(self, end_ns: int) -> None:
        """See Fault."""
        self._end_ns = end_ns

    def _act(self, now: int, wire: Wire) -> None:
        port = self._port(wire)
        if not is_present(port):
            return
        self._is_off = True
        self._own_restart_ns, port.restart_ns = port.restart_ns, NEVER
        BusOff(wire, port).begin(now)
        self._watch.disturbed(now, None)

    def end(self) -> None:
        """See Fault."""
        self.wake_at = NEVER
        if self._wire is not None and self._is_off:
            self._is_off = False
            port = self._port(self._wire)
            port.restart_ns = self._own_restart_ns
            self._wire.restart(self._end_ns, port, self.restart_ns)

    def _port(self, wire: Wire) -> Port:
        return wire.medium.ports[self.port]

    def __reduce__(self) -> tuple[type["SwitchedOff"], tuple[str, int, int]]:
        return SwitchedOff, (self.bus, self.port, self.restart_ns)


@final
class Babbling(OnWire):
    """A further node that sends `frame` all the time while the window is open. bit_ns: of that bus."""

    def __init__(self, bus: str, frame: Frame, bit_ns: int) -> None:
        super().__init__(bus)
        self.adds = True
        self.frame: Final[Frame] = frame
        self.bit_ns: Final[int] = bit_ns
        self._idiot: Final[BabblingIdiot] = BabblingIdiot(frame, bit_ns)
        self._end_ns: int = NEVER

    def listen(self, watch: WireWatch) -> None:
        """See OnWire."""
        self._idiot.watch = watch

    def add_nodes(self, loop: Loop, medium: Medium) -> None:
        """See OnWire."""
        loop.connect(self._idiot, [medium])
        self._idiot.medium_port = medium.ports[-1]

    def bound(self, end_ns: int) -> None:
        """See Fault."""
        self._end_ns = end_ns
        self._idiot.end(end_ns)

    def _act(self, now: int, wire: Wire) -> None:
        self._idiot.begin(now, self._end_ns)

    def __reduce__(self) -> tuple[type["Babbling"], tuple[str, Frame, int]]:
        return Babbling, (self.bus, self.frame, self.bit_ns)
