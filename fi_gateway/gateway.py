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

Order at one instant: windows that end close, windows that are due open, triggers settle along the trigger graph
(`windows`), then the faults act on the frame in the order written (`passage`); a frame lost by one injector does not
reach the next.

Error frames are notices here (`port_changed`), counted and never forwarded. While the port to send on is down or
bus-off, frames for it are counted as undelivered, so that no old command waits for the bus to come back; one frame
every 20 ms is let through as a probe, and the first notice of recovery or the first received frame ends that.
Live control (`control`) calls `settle`, `begin` and `fire` between two frames.
"""

from typing import Final, final

from mypy_extensions import mypyc_attr

from canopen_exo.bus.frame import Frame
from canopen_exo.bus.medium import Medium
from canopen_exo.bus.node import LOOK, MS, NEVER, PASS_ON, TAKE, ErrorState, Out, PortState, Relay
from canopen_exo.bus.wire import Wire
from canopen_exo.plan import STATUS_MOTION, STATUS_STOPPED
from canopen_exo.sync import SyncCadence
from fi_gateway.activation import Activation
from fi_gateway.errors import FaultError
from fi_gateway.injector import Injector
from fi_gateway.on_wire import OnWire
from fi_gateway.passage import COMMAND, PLAIN, SYNC_READ, Passage, Route
from fi_gateway.wire_faults import WireWatch

CONTROLLER_PORT: Final = 0
DRIVE_PORT: Final = 1

_STATE: Final = (
    "wake_at",
    "filters",
    "frames",
    "undelivered",
    "notices",
    "port_changes",
    "malformed",
    "time_zero",
    "cadence",
    "_power_up",
    "_states",
    "_away",
    "_probe_at",
    "_is_disturbed",
    "_media",
)
"""What `__reduce__` copies besides the constructor arguments; the routes are laid afresh, and what is attached stays
with the original."""

WIRE_LATE: Final = "a wire fault acts on an emulated bus, which has to know of it before the rig runs; give it then"

_PROBE_NS: Final = 20 * MS
"""While a port is away: the distance of frames that are offered to it all the same."""

_CHANGES_KEPT: Final = 4096
"""A bus that flaps for days must not fill the memory: the latest; `notices` goes on counting."""


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
class _Watch(WireWatch):
    """What the wire fault of an injector does, told to the gateway."""

    def __init__(self, gateway: "Gateway", injector: Injector) -> None:
        self.gateway: Final[Gateway] = gateway
        self.injector: Final[Injector] = injector

    def disturbed(self, now: int, frame: Frame | None) -> None:
        self.injector.disturb(now, frame)
        self.gateway.attend(now)


@final
class Gateway(Relay):
    """Two ports: CONTROLLER_PORT and DRIVE_PORT. What comes in on one goes out on the other.

    injectors: in the order in which their faults apply; cycle_ns: SYNC period, ns; passage: for a copy, that of the
    original.
    frames, lost, inserted, undelivered: received, lost and added by faults, and not offered because the other port is
    away, by the port they came in on; waiting: frames that go on later; notices: error notices by port; port_changes:
    those that changed a port's state; malformed: status frames too short to read. time_zero: ns, NEVER until known;
    cadence: of SYNC from the controller.

    Twelve public methods: five are a Node's life and its end, five are live control's, two are for wire faults.
    """

    def __init__(self, injectors: list[Injector], cycle_ns: int, passage: Passage | None = None) -> None:
        super().__init__()
        if cycle_ns <= 0:
            raise FaultError(f"gateway: SYNC period {cycle_ns} ns given, allowed 1 ns and more")
        self.injectors: Final[list[Injector]] = list(injectors)
        self.undelivered: list[int] = [0, 0]
        self.notices: list[int] = [0, 0]
        self.port_changes: list[PortChange] = []
        self.malformed: int = 0
        self.time_zero: int = NEVER
        self.cadence: SyncCadence = SyncCadence(cycle_ns)
        self._cycle_ns: Final[int] = cycle_ns
        self._power_up: int = 0
        self._commands: CommandPort | None = None
        self._states: list[ErrorState] = [ErrorState.ERROR_ACTIVE, ErrorState.ERROR_ACTIVE]
        self._away: list[bool] = [False, False]
        self._probe_at: list[int] = [0, 0]
        self._is_disturbed: bool = False
        self._passage: Final[Passage] = passage if passage is not None else Passage(self.injectors)
        self._from_controller: Final[list[Route | None]] = self._passage.from_controller
        self._from_drives: Final[list[Route | None]] = self._passage.from_drives
        self._media: dict[str, Medium] = {}
        self._on_wire: Final[list[OnWire]] = []
        self._has_wire: bool = False
        for injector in injectors:
            if injector.from_power_up:
                self._power_up = NEVER
            if injector.wire is not None:
                injector.wire.listen(_Watch(self, injector))
                self._on_wire.append(injector.wire)
                self._has_wire = True
        self._note_passes()

    @property
    def records(self) -> list[Activation]:
        """The activations so far, in the order they opened; all closed after `finish`."""
        return list(self._passage.windows.records)

    @property
    def lost(self) -> list[int]:
        """Frames that never go on because a fault said so, by port."""
        return list(self._passage.lost)

    @property
    def inserted(self) -> list[int]:
        """Frames that faults have added, by port."""
        return list(self._passage.inserted)

    @property
    def waiting(self) -> int:
        """Frames that faults have put off."""
        return self._passage.waiting

    def receive(self, now: int, port: int, frame: Frame, out: Out) -> None:
        """Pass the frame to the other port, through the injectors that it is a target of."""
        self.frames[port] += 1
        if frame.flags == 0:
            route = self._from_drives[frame.can_id] if port else self._from_controller[frame.can_id]
            if route is not None:
                left = self._through(now, port, route, frame, out)
                if left is None:
                    return
                frame = left
        if self._is_disturbed:
            self._came_in(now, port)
            if not self._can_send(now, 1 - port):
                self.undelivered[port] += 1
                return
        out.send(1 - port, frame)

    def look(self, now: int, port: int, can_id: int) -> None:
        """A SYNC from the controller has passed: time 0 is told from it."""
        self.cadence.received(now)

    def wake(self, now: int, out: Out) -> None:
        """Open and close the windows that are due, and send what faults have put off until now."""
        passage = self._passage
        passage.advance(now)
        while self._has_wire and self._turn(now):
            passage.advance(now)
        self.wake_at = passage.next_ns
        if passage.speaks:
            self._flush(now, out)

    def port_changed(self, now: int, state: PortState, out: Out) -> None:
        """Count the notice, note what changed, and stop or resume sending there. Overruns are counted as losses."""
        port = state.port
        if not state.overrun:
            self.notices[port] += 1
        if state.state is not self._states[port]:
            self._change(now, port, state.state, state.cause)

    def finish(self, now: int) -> None:
        """The run is over at `now`: close all windows; from now on every frame passes."""
        self._passage.advance(now - 1)
        for injector in self.injectors:
            injector.stop(now)
        self.settle(now)

    def settle(self, now: int) -> None:
        """Do all that is due up to and including `now`, after injectors were armed or disarmed from outside."""
        self._passage.settle(now)
        self._arrange(now)

    def begin(self, time_zero: int) -> None:
        """Time 0 is known: on the bus, or by live control where the master does not say it. `settle` follows."""
        self.time_zero = time_zero
        for injector in self.injectors:
            if not injector.from_power_up:
                injector.start(time_zero)
        self._passage.plan()
        self.wake_at = self._passage.next_ns

    def join(self, medium: Medium) -> None:
        """This is the bus of its name, for wire faults; it has a Wire before a window of theirs opens."""
        self._media[medium.name] = medium

    def attend(self, now: int) -> None:
        """A wire fault has done something: see to it at `now` what comes of that."""
        self._passage.attend(now)
        self.wake_at = now

    def fire(self, injector: Injector, now: int) -> None:
        """Live control: open the window of an armed injector, with all that it triggers, at `now`."""
        self.settle(now)
        self._passage.windows.fire(injector, now)
        self.settle(now)

    def add(self, injector: Injector, now: int, at_once: bool = False) -> None:
        """Live control: one more injector, behind the others, as if armed at `now`.

        at_once: its times count from `now`, not from time 0. Raises FaultError for a name or trigger that does not fit,
        for the COB-ID of live control, and for times from a power-up that is over.
        """
        name, commands = injector.name, self._commands
        if commands is not None and injector.takes(commands.cob_id):
            raise FaultError(f"injector {name}: its target or trigger {commands.cob_id:#x} is that of live control")
        if injector.from_power_up and not at_once and self._power_up != NEVER:
            raise FaultError(f"injector {name}: power-up is over; give it before the rig runs, or from: time_zero")
        self.settle(now - 1)
        self._passage.add(injector)
        self._note_passes()
        self.injectors.append(injector)
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
            if injector.takes(commands.cob_id):
                raise FaultError(
                    f"injector {injector.name}: its target or trigger {commands.cob_id:#x} is the COB-ID of live "
                    "control; give another one for either"
                )
        self._commands = commands
        self._passage.windows.keeps_opened = True
        table = self._from_drives if commands.port == DRIVE_PORT else self._from_controller
        table[commands.cob_id] = Route(COMMAND)
        self._note_passes()

    def __reduce__(self) -> tuple[type["Gateway"], tuple[list[Injector], int, Passage], dict[str, object]]:
        state = {name: getattr(self, name) for name in _STATE}
        return Gateway, (self.injectors, self._cycle_ns, self._passage), state

    def _note_passes(self) -> None:
        """Say which frames need nothing from here: none while a port is away."""
        for port, table in ((CONTROLLER_PORT, self._from_controller), (DRIVE_PORT, self._from_drives)):
            filters = self.filters[port]
            for cob_id, route in enumerate(table):
                if self._is_disturbed:
                    filters[cob_id] = TAKE
                elif route is None:
                    filters[cob_id] = PASS_ON
                else:
                    filters[cob_id] = LOOK if route.kind == SYNC_READ and self._only_looks_at(route) else TAKE

    def _only_looks_at(self, route: Route) -> bool:
        """Whether frames on this route go to no injector, no trigger, and to no wire fault that is to be woken."""
        return not (route.injectors or route.watchers or self._has_wire or self._power_up == NEVER)

    def _power_on(self, now: int) -> None:
        """The first frame: start the injectors that count from here."""
        self._power_up = now
        self._passage.free()
        self._note_passes()
        for injector in self.injectors:
            if injector.from_power_up:
                injector.start(now)
        self._passage.settle(now - 1)

    def _through(self, now: int, port: int, route: Route, frame: Frame, out: Out) -> Frame | None:
        """The frame after the injectors of its route; None: it does not go on now."""
        passage = self._passage
        if self._power_up == NEVER:
            self._power_on(now)
        if route.kind != PLAIN:
            if route.kind == COMMAND:
                if self._commands is not None:
                    self._commands.command(now, frame, out)
                return None
            self._observe(now, route.kind, frame)
        if now >= passage.next_ns:
            passage.advance(now)
        if route.watchers or passage.is_waiting:
            passage.watch(now, port, route, frame)
        left = passage.through(now, port, route.injectors, frame)
        self.wake_at = now if self._has_wire else passage.next_ns  # so that the loop sees what begins on a bus
        if passage.speaks:
            self._flush(now, out)
        return left

    def _observe(self, now: int, kind: int, frame: Frame) -> None:
        """Look for time 0 in SYNC and status frames from the controller, then for the end of the motion."""
        if kind == SYNC_READ:
            self.cadence.received(now)
        elif len(frame.data) < 3:
            self.malformed += 1
        elif self.time_zero != NEVER:
            if frame.data[0] == STATUS_STOPPED:
                self._passage.advance(now - 1)
                for injector in self.injectors:
                    if not injector.from_power_up:
                        injector.stop(now)
                self._passage.settle(now)
        elif frame.data[0] == STATUS_MOTION and now - self.cadence.last < self._cycle_ns:
            cycle = frame.data[1] | frame.data[2] << 8
            self.begin(self.cadence.last - cycle * self._cycle_ns)
            self._passage.settle(now)

    def _arrange(self, now: int) -> None:
        """Ask to be woken when there is something to do, or at once to say what could not be said without an `out`."""
        passage = self._passage
        self.wake_at = now if passage.speaks or self._has_wire else passage.next_ns

    def _turn(self, now: int) -> bool:
        """Let the wire faults act whose windows have opened or closed; whether there were any."""
        turned = False
        for fault in self._on_wire:
            if fault.has_turned:
                fault.has_turned, turned = False, True
                medium = self._media.get(fault.bus)
                wire = None if medium is None else medium.wire
                if not isinstance(wire, Wire):
                    raise FaultError(
                        f"gateway: a wire fault on the {fault.bus} bus, which is no emulated bus with errors that it "
                        "was told of; join it, and install a Wire there"
                    )
                fault.turn(now, wire)
        return turned

    def _flush(self, now: int, out: Out) -> None:
        """Send what goes out besides the frame that has arrived, and say what has become active."""
        passage = self._passage
        passage.speaks = False
        if passage.windows.opened:
            opened, passage.windows.opened = passage.windows.opened, []
            if self._commands is not None:
                self._commands.report(opened, out)
        if passage.outbox:
            outbox, passage.outbox = passage.outbox, []
            for port, frame in outbox:
                if self._is_disturbed and not self._can_send(now, port):
                    self.undelivered[1 - port] += 1
                else:
                    out.send(port, frame)

    def _change(self, now: int, port: int, state: ErrorState, cause: str) -> None:
        """A port has a new state."""
        self._states[port] = state
        if len(self.port_changes) >= _CHANGES_KEPT:
            del self.port_changes[0]
        self.port_changes.append(PortChange(now, port, state, cause))
        self._away[port] = state is ErrorState.BUS_OFF or state is ErrorState.DOWN
        self._probe_at[port] = now + _PROBE_NS
        if self._is_disturbed is not (self._away[0] or self._away[1]):
            self._is_disturbed = not self._is_disturbed
            self._note_passes()

    def _came_in(self, now: int, port: int) -> None:
        """A frame has come in: the port is there."""
        if self._away[port]:
            self._change(now, port, ErrorState.ERROR_ACTIVE, "frame received")

    def _can_send(self, now: int, port: int) -> bool:
        """Whether a frame may go out on `port` at `now`."""
        if not self._away[port]:
            return True
        if now < self._probe_at[port]:
            return False
        self._probe_at[port] = now + _PROBE_NS
        return True
