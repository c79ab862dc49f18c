"""The gateway: a Node with two ports that passes every frame on, and lets injectors act on some.

Pure store-and-forward when no injector is active: the identical frame, id type, DLC, RTR and FD flags kept, in order.
When in doubt it passes frames. Injectors act on classical 11-bit data frames; extended, remote and FD frames pass.

Time 0 comes from the bus only: the high-level controller's status frame (COB-ID 0x2FF; state u8, cycle u16, phase u16,
little endian), read on the controller side as received, before any fault. With the first one whose state is MOTION,
time 0 = arrival of the latest SYNC (0x080) on that port - cycle * cycle_ns; one that comes a cycle or more after the
latest SYNC is passed over, since a SYNC was missed. Later status frames do not move time 0. (cycle is 16 bits: joining
a motion more than 65535 cycles old puts time 0 a multiple of 65536 cycles late.)
Before time 0 injectors are inert, except those that count from power-up: the first classical data frame on either port.
When the controller says that the motion is over (state STOPPED), they are inert again and open windows end.
Events that were due before time 0 was known open their windows with their true times; frames already gone stay as they
were.

Order at one instant: windows that end close, windows that are due open, triggers settle along the trigger graph, then
the faults act on the frame in the order written; a frame lost by one injector does not reach the next.
"""

from typing import Final, final

from canopen_exo.bus.frame import Frame
from canopen_exo.bus.node import NEVER, Node, Out
from canopen_exo.plan import HLC_STATUS, STATUS_MOTION, STATUS_STOPPED, SYNC
from fi_gateway.errors import FaultError
from fi_gateway.injector import ACTIVE, ARMED, WAITING, Activation, Injector, graph_order

CONTROLLER_PORT: Final = 0
DRIVE_PORT: Final = 1

_STATE: Final = (
    "wake_at",
    "frames",
    "lost",
    "malformed",
    "time_zero",
    "_last_sync",
    "_power_up",
    "_waiting",
    "_records",
)
"""What `__reduce__` copies besides the constructor arguments; the routes are laid afresh."""

_PLAIN: Final = 0
_SYNC: Final = 1
_STATUS: Final = 2


@final
class _Route:
    """What is to be done with one COB-ID in one direction. kind: what the gateway itself reads from it."""

    def __init__(self, kind: int) -> None:
        self.kind: Final[int] = kind
        self.injectors: list[Injector] = []


@final
class _Link:
    """An injector and those whose activation starts it. opened: in the present settling."""

    def __init__(self, injector: Injector, sources: list["_Link"]) -> None:
        self.injector: Final[Injector] = injector
        self.sources: Final[list[_Link]] = sources
        self.opened: bool = False


@final
class Gateway(Node):
    """Two ports: CONTROLLER_PORT and DRIVE_PORT. What comes in on one goes out on the other.

    injectors: in the order in which their faults apply; cycle_ns: SYNC period, ns.
    frames, lost: received, and lost by a fault, by the port they came in on; malformed: status frames too short to
    read. time_zero: ns, NEVER until known.
    """

    def __init__(self, injectors: list[Injector], cycle_ns: int) -> None:
        super().__init__()
        if cycle_ns <= 0:
            raise FaultError(f"gateway: SYNC period {cycle_ns} ns given, allowed 1 ns and more")
        self.injectors: Final[list[Injector]] = list(injectors)
        self.frames: list[int] = [0, 0]
        self.lost: list[int] = [0, 0]
        self.malformed: int = 0
        self.time_zero: int = NEVER
        self._cycle_ns: Final[int] = cycle_ns
        self._last_sync: int = -NEVER
        self._power_up: int = NEVER
        self._waiting: bool = False
        self._records: list[Activation] = []
        self._links: Final[list[_Link]] = _links(injectors)
        self._from_controller: Final[list[_Route | None]] = [None] * 0x800
        self._from_drives: Final[list[_Route | None]] = [None] * 0x800
        self._lay_routes()

    @property
    def records(self) -> list[Activation]:
        """The activations so far, in the order they opened; all closed after `finish`."""
        return list(self._records)

    def receive(self, now: int, port: int, frame: Frame, out: Out) -> None:
        """Pass the frame to the other port, through the injectors that it is a target of."""
        self.frames[port] += 1
        if frame.flags == 0:
            route = self._from_drives[frame.can_id] if port else self._from_controller[frame.can_id]
            if route is not None:
                left = self._through(now, route, frame)
                if left is None:
                    self.lost[port] += 1
                    return
                frame = left
        out.send(1 - port, frame)

    def wake(self, now: int, out: Out) -> None:
        """Open and close the windows that are due."""
        self._advance(now)

    def finish(self, now: int) -> None:
        """The run is over at `now`: close all windows; from now on every frame passes."""
        self._advance(now - 1)
        for injector in self.injectors:
            injector.stop(now)
        self._schedule()

    def __reduce__(self) -> tuple[type["Gateway"], tuple[list[Injector], int], dict[str, object]]:
        state = {name: getattr(self, name) for name in _STATE}
        return Gateway, (self.injectors, self._cycle_ns), state

    def _lay_routes(self) -> None:
        """One route per COB-ID and direction that is not simply passed on."""
        self._from_controller[SYNC] = _Route(_SYNC)
        self._from_controller[HLC_STATUS] = _Route(_STATUS)
        for injector in self.injectors:
            for cob_id in sorted(set(injector.target.cob_ids)):
                if injector.target.to_drives:
                    _route(self._from_controller, cob_id).injectors.append(injector)
                if injector.target.to_controller:
                    _route(self._from_drives, cob_id).injectors.append(injector)
        for injector in self.injectors:
            if injector.from_power_up:  # until then every frame is looked at
                for cob_id in range(0x800):
                    _route(self._from_controller, cob_id)
                    _route(self._from_drives, cob_id)
                return
        self._power_up = 0

    def _power_on(self, now: int) -> None:
        """The first frame: start the injectors that count from here, and free the routes that are not needed."""
        self._power_up = now
        for table in (self._from_controller, self._from_drives):
            for cob_id, route in enumerate(table):
                if route is not None and route.kind == _PLAIN and not route.injectors:
                    table[cob_id] = None
        for injector in self.injectors:
            if injector.from_power_up:
                injector.start(now)
        self._schedule()

    def _through(self, now: int, route: _Route, frame: Frame) -> Frame | None:
        """The frame after the injectors of its route; None: lost."""
        if self._power_up == NEVER:
            self._power_on(now)
        if route.kind == _STATUS or (route.kind == _SYNC and self.time_zero == NEVER):
            self._observe(now, route.kind, frame)
        if now >= self.wake_at:
            self._advance(now)
        if self._waiting:
            self._settle(now, route)
            self._schedule()
        for injector in route.injectors:
            left: Frame | None = frame
            if injector.phase is ACTIVE:
                left = injector.act(now, frame)
                if injector.counted:
                    self._schedule()
            if len(frame.data) >= injector.least_bytes:
                injector.held[frame.can_id] = frame
            if left is None:
                return None
            frame = left
        return frame

    def _observe(self, now: int, kind: int, frame: Frame) -> None:
        """Look for time 0 in SYNC and status frames from the controller, then for the end of the motion."""
        if kind == _SYNC:
            self._last_sync = now
        elif len(frame.data) < 3:
            self.malformed += 1
        elif self.time_zero != NEVER:
            if frame.data[0] == STATUS_STOPPED:
                self._advance(now - 1)
                for injector in self.injectors:
                    if not injector.from_power_up:
                        injector.stop(now)
                self._schedule()
        elif frame.data[0] == STATUS_MOTION and now - self._last_sync < self._cycle_ns:
            cycle = frame.data[1] | frame.data[2] << 8
            self.time_zero = self._last_sync - cycle * self._cycle_ns
            for injector in self.injectors:
                if not injector.from_power_up:
                    injector.start(self.time_zero)
            self._schedule()

    def _advance(self, now: int) -> None:
        """Settle every instant up to and including `now` at which something is due, in order."""
        while self.wake_at <= now:
            self._settle(self.wake_at, None)
            self._schedule()

    def _settle(self, now: int, route: _Route | None) -> None:
        """Close and open windows at `now`, sources of triggers first. route: of the frame that arrives at `now`."""
        for link in self._links:
            injector = link.injector
            link.opened = False
            if injector.phase is ACTIVE and injector.next_ns <= now:
                injector.close(injector.next_ns)
            cause = ""
            if injector.phase is ARMED:
                cause = "event" if injector.next_ns <= now else _cause(link.sources)
            elif injector.phase is WAITING and route is not None and injector in route.injectors:
                cause = "frame"
            if cause:
                opened = injector.open(now, cause)
                if opened is not None:
                    link.opened = True
                    self._records.append(opened)

    def _schedule(self) -> None:
        """Note when something is due next, and whether an injector waits for a frame."""
        self.wake_at = NEVER
        self._waiting = False
        for injector in self.injectors:
            if injector.next_ns < self.wake_at:
                self.wake_at = injector.next_ns
            if injector.phase is WAITING:
                self._waiting = True


def _route(table: list[_Route | None], cob_id: int) -> _Route:
    """The route of that COB-ID, made when it is not there."""
    route = table[cob_id]
    if route is None:
        route = _Route(_PLAIN)
        table[cob_id] = route
    return route


def _links(injectors: list[Injector]) -> list[_Link]:
    """The injectors in the order in which triggers settle, each with its sources."""
    by_name: dict[str, _Link] = {}
    links: list[_Link] = []
    for injector in graph_order(injectors):
        names = injector.trigger.any_of if injector.trigger is not None else ()
        sources: list[_Link] = []
        for name in names:
            sources.append(by_name[name])
        link = _Link(injector, sources)
        by_name[injector.name] = link
        links.append(link)
    return links


def _cause(sources: list[_Link]) -> str:
    """The trigger that fired at this instant, "" for none."""
    for source in sources:
        if source.opened:
            return f"trigger:{source.injector.name}"
    return ""
