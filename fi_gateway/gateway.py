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

Error frames are notices here (`port_changed`), counted and never forwarded. While the port to send on is down or
bus-off, frames for it are counted as undelivered, so that no old command waits for the bus to come back; one frame
every 20 ms is let through as a probe, and the first notice of recovery or the first received frame ends that.
Live control (`control`) calls `settle`, `begin` and `fire` between two frames.
"""

from typing import Final, final

from mypy_extensions import mypyc_attr

from canopen_exo.bus.frame import Frame
from canopen_exo.bus.node import MS, NEVER, ErrorState, Out, PortState, Relay
from canopen_exo.plan import HLC_STATUS, STATUS_MOTION, STATUS_STOPPED, SYNC
from fi_gateway.errors import FaultError
from fi_gateway.injector import ACTIVE, ARMED, WAITING, Activation, Injector, graph_order

CONTROLLER_PORT: Final = 0
DRIVE_PORT: Final = 1

_STATE: Final = (
    "wake_at",
    "frames",
    "lost",
    "undelivered",
    "notices",
    "port_changes",
    "malformed",
    "time_zero",
    "_last_sync",
    "_power_up",
    "_waiting",
    "_records",
    "_states",
    "_away",
    "_probe_at",
    "is_disturbed",
)
"""What `__reduce__` copies besides the constructor arguments; the routes are laid afresh, and what is attached stays
with the original."""

_PLAIN: Final = 0
_SYNC: Final = 1
_STATUS: Final = 2
_COMMAND: Final = 3

_PROBE_NS: Final = 20 * MS
"""While a port is away: the distance of frames that are offered to it all the same."""

_CHANGES_KEPT: Final = 4096
"""A bus that flaps for days must not fill the memory: the latest; `notices` goes on counting."""


@final
class _Route:
    """What is to be done with one COB-ID in one direction. kind: what the gateway itself reads from it."""

    def __init__(self, kind: int) -> None:
        self.kind: Final[int] = kind
        self.injectors: list[Injector] = []


@final
class _Link:
    """An injector and those whose activation starts it. opened: in the present settling; fired: by live control."""

    def __init__(self, injector: Injector, sources: list["_Link"]) -> None:
        self.injector: Final[Injector] = injector
        self.sources: Final[list[_Link]] = sources
        self.opened: bool = False
        self.fired: bool = False


@final
class PortChange:
    """A port's new error state. time_ns: loop clock; cause: from the driver or the medium."""

    __slots__ = ("cause", "port", "state", "time_ns")

    def __init__(self, time_ns: int, port: int, state: ErrorState, cause: str) -> None:
        self.time_ns: Final[int] = time_ns
        self.port: Final[int] = port
        self.state: Final[ErrorState] = state
        self.cause: Final[str] = cause

    def __reduce__(self) -> tuple[type["PortChange"], tuple[int, int, ErrorState, str]]:
        return PortChange, (self.time_ns, self.port, self.state, self.cause)


@mypyc_attr(allow_interpreted_subclasses=True)
class CommandPort:
    """Live control over the bus: who reads the frames with one COB-ID that come in on one port of the gateway."""

    def __init__(self, port: int, cob_id: int) -> None:
        self.port: int = port
        self.cob_id: int = cob_id

    def command(self, now: int, frame: Frame, out: Out) -> None:
        """A frame with that COB-ID; it goes no further. Must not raise whatever its bytes."""
        raise NotImplementedError

    def report(self, opened: list[Activation], out: Out) -> None:
        """These windows have opened since the last call."""
        raise NotImplementedError


@final
class Gateway(Relay):
    """Two ports: CONTROLLER_PORT and DRIVE_PORT. What comes in on one goes out on the other.

    injectors: in the order in which their faults apply; cycle_ns: SYNC period, ns.
    frames, lost, undelivered: received, lost by a fault, and not offered because the other port is away, by the port
    they came in on; notices: error notices by port; port_changes: those that changed a port's state; malformed: status
    frames too short to read. time_zero: ns, NEVER until known.

    Nine public methods: four are a Node's life and its end, five are what live control is made of.
    """

    def __init__(self, injectors: list[Injector], cycle_ns: int) -> None:
        super().__init__()
        if cycle_ns <= 0:
            raise FaultError(f"gateway: SYNC period {cycle_ns} ns given, allowed 1 ns and more")
        self.injectors: Final[list[Injector]] = list(injectors)
        self.lost: list[int] = [0, 0]
        self.undelivered: list[int] = [0, 0]
        self.notices: list[int] = [0, 0]
        self.port_changes: list[PortChange] = []
        self.malformed: int = 0
        self.time_zero: int = NEVER
        self._cycle_ns: Final[int] = cycle_ns
        self._last_sync: int = -NEVER
        self._power_up: int = NEVER
        self._waiting: bool = False
        self._records: list[Activation] = []
        self._commands: CommandPort | None = None
        self._unreported: list[Activation] = []
        self._states: list[ErrorState] = [ErrorState.ERROR_ACTIVE, ErrorState.ERROR_ACTIVE]
        self._away: list[bool] = [False, False]
        self._probe_at: list[int] = [0, 0]
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
                if route.kind == _COMMAND and self._commands is not None:
                    self._commands.command(now, frame, out)
                    return
                left = self._through(now, route, frame)
                if left is None:
                    self.lost[port] += 1
                    return
                frame = left
        if self.is_disturbed and not self._can_send(now, port, out):
            self.undelivered[port] += 1
            return
        out.send(1 - port, frame)

    def wake(self, now: int, out: Out) -> None:
        """Open and close the windows that are due."""
        self._advance(now)
        if self._unreported:
            self._report(out)

    def port_changed(self, now: int, state: PortState, out: Out) -> None:
        """Count the notice, note what changed, and stop or resume sending there."""
        port = state.port
        self.notices[port] += 1
        if state.state is not self._states[port]:
            self._change(now, port, state.state, state.cause)

    def finish(self, now: int) -> None:
        """The run is over at `now`: close all windows; from now on every frame passes."""
        self._advance(now - 1)
        for injector in self.injectors:
            injector.stop(now)
        self._schedule()

    def settle(self, now: int) -> None:
        """Do all that is due up to and including `now`, after injectors were armed or disarmed from outside."""
        self._schedule()
        self._advance(now)

    def begin(self, time_zero: int) -> None:
        """Time 0 is known: on the bus, or by live control where the master does not say it."""
        self.time_zero = time_zero
        for injector in self.injectors:
            if not injector.from_power_up:
                injector.start(time_zero)
        self._schedule()

    def fire(self, injector: Injector, now: int) -> None:
        """Live control: open the window of an armed injector, with all that it triggers, at `now`."""
        self.settle(now)
        for link in self._links:
            link.fired = link.injector is injector
        self._settle(now, None)
        for link in self._links:
            link.fired = False
        self._schedule()

    def add(self, injector: Injector, now: int, at_once: bool = False) -> None:
        """Live control: one more injector, behind the others, as if armed at `now`.

        at_once: its times count from `now`, not from time 0. Raises FaultError for a name or trigger that does not fit,
        for the COB-ID of live control, and for times from a power-up that is over.
        """
        name, commands = injector.name, self._commands
        if commands is not None and commands.cob_id in injector.target.cob_ids:
            raise FaultError(f"injector {name}: its target {commands.cob_id:#x} is the COB-ID of live control")
        if injector.from_power_up and not at_once and self._power_up != NEVER:
            raise FaultError(f"injector {name}: power-up is over; give it before the rig runs, or from: time_zero")
        links = _links([*self.injectors, injector])
        self.settle(now - 1)
        self.injectors.append(injector)
        self._links[:] = links
        self._lay_route(injector)
        self._note_passes()
        base_ns = now if at_once else self.time_zero
        if base_ns != NEVER:
            enabled, injector.enabled = injector.enabled, False
            injector.start(base_ns)
            if enabled:
                injector.arm(now)
        self.settle(now)

    def attach(self, commands: CommandPort) -> None:
        """Let `commands` read the frames of its COB-ID; no fault may have its hands on them. Raises FaultError."""
        for injector in self.injectors:
            if commands.cob_id in injector.target.cob_ids:
                raise FaultError(
                    f"injector {injector.name}: its target {commands.cob_id:#x} is the COB-ID of live control; "
                    "give another one for either"
                )
        self._commands = commands
        table = self._from_drives if commands.port == DRIVE_PORT else self._from_controller
        table[commands.cob_id] = _Route(_COMMAND)
        self._note_passes()

    def __reduce__(self) -> tuple[type["Gateway"], tuple[list[Injector], int], dict[str, object]]:
        state = {name: getattr(self, name) for name in _STATE}
        return Gateway, (self.injectors, self._cycle_ns), state

    def _lay_routes(self) -> None:
        """One route per COB-ID and direction that is not simply passed on."""
        self._from_controller[SYNC] = _Route(_SYNC)
        self._from_controller[HLC_STATUS] = _Route(_STATUS)
        for injector in self.injectors:
            self._lay_route(injector)
        for injector in self.injectors:
            if injector.from_power_up:  # until then every frame is looked at
                for cob_id in range(0x800):
                    _route(self._from_controller, cob_id)
                    _route(self._from_drives, cob_id)
                return
        self._power_up = 0
        self._note_passes()

    def _note_passes(self) -> None:
        """Say which frames need nothing from here."""
        for port, table in ((CONTROLLER_PORT, self._from_controller), (DRIVE_PORT, self._from_drives)):
            for cob_id, route in enumerate(table):
                self.passes[port][cob_id] = 1 if route is None else 0

    def _lay_route(self, injector: Injector) -> None:
        for cob_id in sorted(set(injector.target.cob_ids)):
            if injector.target.to_drives:
                _route(self._from_controller, cob_id).injectors.append(injector)
            if injector.target.to_controller:
                _route(self._from_drives, cob_id).injectors.append(injector)

    def _power_on(self, now: int) -> None:
        """The first frame: start the injectors that count from here, and free the routes that are not needed."""
        self._power_up = now
        for table in (self._from_controller, self._from_drives):
            for cob_id, route in enumerate(table):
                if route is not None and route.kind == _PLAIN and not route.injectors:
                    table[cob_id] = None
        self._note_passes()
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
            self.begin(self._last_sync - cycle * self._cycle_ns)

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
                cause = "event" if injector.next_ns <= now else _cause(link)
            elif injector.phase is WAITING and route is not None and injector in route.injectors:
                cause = "frame"
            if cause:
                opened = injector.open(now, cause)
                if opened is not None:
                    link.opened = True
                    self._records.append(opened)
                    if self._commands is not None:
                        self._unreported.append(opened)
                        self.is_disturbed = True

    def _schedule(self) -> None:
        """Note when something is due next, and whether an injector waits for a frame."""
        self.wake_at = NEVER
        self._waiting = False
        for injector in self.injectors:
            if injector.next_ns < self.wake_at:
                self.wake_at = injector.next_ns
            if injector.phase is WAITING:
                self._waiting = True

    def _change(self, now: int, port: int, state: ErrorState, cause: str) -> None:
        """A port has a new state."""
        self._states[port] = state
        if len(self.port_changes) >= _CHANGES_KEPT:
            del self.port_changes[0]
        self.port_changes.append(PortChange(now, port, state, cause))
        self._away[port] = state is ErrorState.BUS_OFF or state is ErrorState.DOWN
        self._probe_at[port] = now + _PROBE_NS
        self.is_disturbed = self._away[0] or self._away[1] or len(self._unreported) > 0

    def _can_send(self, now: int, port: int, out: Out) -> bool:
        """Whether a frame that came in on `port` at `now` may go out on the other; says first what is unreported."""
        if self._unreported:
            self._report(out)
        if self._away[port]:
            self._change(now, port, ErrorState.ERROR_ACTIVE, "frame received")
        other = 1 - port
        if not self._away[other]:
            return True
        if now < self._probe_at[other]:
            return False
        self._probe_at[other] = now + _PROBE_NS
        return True

    def _report(self, out: Out) -> None:
        """Say on the bus what has become active."""
        if self._commands is not None:
            self._commands.report(self._unreported, out)
        self._unreported = []
        self.is_disturbed = self._away[0] or self._away[1]


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


def _cause(link: _Link) -> str:
    """What starts this injector at this instant besides its event, "" for nothing."""
    if link.fired:
        return "command"
    for source in link.sources:
        if source.opened:
            return f"trigger:{source.injector.name}"
    return ""
