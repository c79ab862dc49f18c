"""Wire faults as the faults of injectors: the window is the injector's, what they do happens on a bus.

A fault here knows no bus. When its window has opened or closed, the gateway lets it `turn` on the bus of its name (the
gateway was told which that is, `Gateway.join`), and it tells the gateway what it does (`listen`). So a gateway that has
wire faults asks to be woken at that instant.
Leaves out: buses without a Wire, where these faults are refused before anything runs.
"""

from typing import Final, final

from mypy_extensions import mypyc_attr
from numpy.random import Generator

from canopen_exo.bus.frame import Frame
from canopen_exo.bus.loop import Loop
from canopen_exo.bus.medium import Medium
from canopen_exo.bus.wire import Wire
from fi_gateway.faults.base import Fault
from fi_gateway.outlet import Outlet
from fi_gateway.wire_faults import BabblingIdiot, WireFault, WireWatch


@mypyc_attr(allow_interpreted_subclasses=True)
class OnWire(Fault):
    """A fault on a bus. bus: "controller" or "drive".

    has_turned: its window has opened or closed, and the bus does not know.
    """

    def __init__(self, bus: str) -> None:
        super().__init__()
        self.bus: str = bus
        self.has_turned: bool = False

    @property
    def seen(self) -> int:
        """Attempts to send a frame that it could disturb, in this window or the last one."""
        return 0

    def listen(self, watch: WireWatch) -> None:
        """Have it tell what it does."""
        raise NotImplementedError

    def connect(self, loop: Loop, medium: Medium) -> None:
        """Connect what it needs on its bus, before the Wire is installed."""

    def install(self, wire: Wire) -> None:
        """Give the Wire what it needs to know."""

    def begin(self, now: int, held: dict[int, Frame], rng: Generator) -> bool:
        """See Fault."""
        self.has_turned = True
        return super().begin(now, held, rng)

    def apply(self, now: int, frame: Frame, outlet: Outlet) -> Frame | None:
        """Nothing happens to frames in the gateway."""
        return frame

    def end(self) -> None:
        """See Fault."""
        self.has_turned = True

    def turn(self, now: int, wire: Wire) -> None:
        """Its window has opened or closed: act on the bus."""
        wire.replan(now)


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

    def install(self, wire: Wire) -> None:
        """See OnWire."""
        wire.disturbances.append(self.disturbance)

    def begin(self, now: int, held: dict[int, Frame], rng: Generator) -> bool:
        """See Fault."""
        self.disturbance.draw_from(rng)
        self.disturbance.begin(now)
        return super().begin(now, held, rng)

    def bound(self, end_ns: int) -> None:
        """See Fault."""
        self.disturbance.until = end_ns

    def __reduce__(self) -> tuple[type["Disturbed"], tuple[str, WireFault], dict[str, object]]:
        return Disturbed, (self.bus, self.disturbance), {"has_turned": self.has_turned}


@final
class SwitchedOff(OnWire):
    """A controller goes bus-off when the window opens, whatever its counters (TEC = 256), or is kept there.

    It is asked to restart `restart_ns` after the end of the window, of several that overlap after that of the last.
    port: its number on that bus. A frame that is on the wire ends first.

    EN 50159: deletion (of everything from and to that node, and of what waits in its queue). FIBlock: none.
    """

    def __init__(self, bus: str, port: int, restart_ns: int) -> None:
        super().__init__(bus)
        self.port: Final[int] = port
        self.restart_ns: Final[int] = restart_ns
        self._watch: WireWatch = WireWatch()
        self._is_open: bool = False
        self._is_holding: bool = False

    def listen(self, watch: WireWatch) -> None:
        """See OnWire."""
        self._watch = watch

    def begin(self, now: int, held: dict[int, Frame], rng: Generator) -> bool:
        """See Fault."""
        self._is_open = True
        return super().begin(now, held, rng)

    def end(self) -> None:
        """See Fault."""
        self._is_open = False
        super().end()

    def turn(self, now: int, wire: Wire) -> None:
        """See OnWire."""
        port = wire.medium.ports[self.port]
        if self._is_open and not self._is_holding:
            self._is_holding = True
            wire.hold_off(now, port)
            self._watch.disturbed(now, None)
        elif self._is_holding and not self._is_open:
            self._is_holding = False
            wire.let_go(now, port, self.restart_ns)

    def __reduce__(self) -> tuple[type["SwitchedOff"], tuple[str, int, int], dict[str, object]]:
        names = ("has_turned", "_is_open", "_is_holding")
        return SwitchedOff, (self.bus, self.port, self.restart_ns), {name: getattr(self, name) for name in names}


@final
class Babbling(OnWire):
    """A further node that sends `frame` all the time while the window is open. bit_ns: of that bus."""

    def __init__(self, bus: str, frame: Frame, bit_ns: int) -> None:
        super().__init__(bus)
        self.adds = True
        self.frame: Final[Frame] = frame
        self.bit_ns: Final[int] = bit_ns
        self._idiot: BabblingIdiot = BabblingIdiot(frame, bit_ns)

    def listen(self, watch: WireWatch) -> None:
        """See OnWire."""
        self._idiot.watch = watch

    def connect(self, loop: Loop, medium: Medium) -> None:
        """See OnWire."""
        loop.connect(self._idiot, [medium])

    def begin(self, now: int, held: dict[int, Frame], rng: Generator) -> bool:
        """See Fault."""
        self._idiot.begin(now)
        return super().begin(now, held, rng)

    def bound(self, end_ns: int) -> None:
        """See Fault."""
        self._idiot.end(end_ns)

    def __reduce__(self) -> tuple[type["Babbling"], tuple[str, Frame, int], dict[str, object]]:
        state: dict[str, object] = {"has_turned": self.has_turned, "_idiot": self._idiot}
        return Babbling, (self.bus, self.frame, self.bit_ns), state
