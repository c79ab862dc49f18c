"""Frames on their way through the injectors of a gateway: at once, later, in addition, or not at all.

A frame passes the injectors that it is a target of in written order. What a fault sends besides goes on from behind its
injector: further frames at once, before the frame itself; late ones when their time has come, through the injectors
written after it as they are then. A frame that a fault has given another COB-ID goes on as a target of those behind.
Frames in order wait in a line: one that arrives while frames of its COB-ID wait behind the injector waits behind them.

At one instant: windows (`windows`), then faults that asked to be woken, in written order, then late frames, in the
order of their times, those of one time as they were sent; then the frame that arrives. What a fault does to a frame is
settled (windows that open by it, faults woken by that) before what it has inserted goes on.
Nothing is lost without a fault that says so: frames in + inserted = frames out + lost + waiting.
"""

from bisect import insort
from typing import Final, final

from canopen_exo.bus.frame import Frame
from canopen_exo.bus.node import NEVER
from canopen_exo.plan import HLC_STATUS, SYNC
from fi_gateway.errors import FaultError
from fi_gateway.injector import Injector
from fi_gateway.outlet import Later, Line, Tray
from fi_gateway.phase import ACTIVE
from fi_gateway.trigger import Report
from fi_gateway.windows import Windows

PLAIN: Final = 0
SYNC_READ: Final = 1
STATUS_READ: Final = 2
COMMAND: Final = 3

_STATE: Final = ("windows", "lost", "inserted", "outbox", "speaks", "next_ns", "is_waiting", "_waiting", "_sequence")
"""What `__reduce__` copies besides the constructor arguments; routes are laid afresh."""

_Waiting = tuple[int, int, int, int, bool, Frame]
"""When it goes on, sequence, port it came in on, number of the injector it waits behind, whether in a line, itself."""


@final
class Route:
    """What is to be done with one COB-ID in one direction.

    kind: what the gateway itself reads from it; injectors: that it is a target of, in written order; watchers: numbers
    of those that look at it as it comes in.
    """

    def __init__(self, kind: int) -> None:
        self.kind: Final[int] = kind
        self.injectors: list[Injector] = []
        self.watchers: list[int] = []


@final
class Passage:
    """The way through a gateway, both ways. Ports are those a frame came in on; tables by port, then COB-ID.

    lost: frames that a fault lost, inserted: that one added, by port; outbox: (port to send on, frame) of what is to go
    out at once, besides the frame that has arrived; speaks: there is something in it, or a window has opened that live
    control is to hear of; next_ns: when there is something to do, NEVER for nothing; is_waiting: for a frame.
    """

    def __init__(self, injectors: list[Injector]) -> None:
        self.windows: Windows = Windows(injectors)
        self.lost: list[int] = [0, 0]
        self.inserted: list[int] = [0, 0]
        self.outbox: list[tuple[int, Frame]] = []
        self.speaks: bool = False
        self.next_ns: int = NEVER
        self.is_waiting: bool = False
        self.from_controller: Final[list[Route | None]] = [None] * 0x800
        self.from_drives: Final[list[Route | None]] = [None] * 0x800
        self._injectors: Final[list[Injector]] = []
        self._waiting: list[_Waiting] = []
        self._sequence: int = 0
        self._tray: Final[Tray] = Tray()
        self.from_controller[SYNC] = Route(SYNC_READ)
        self.from_controller[HLC_STATUS] = Route(STATUS_READ)
        for injector in injectors:
            self._lay(injector)
            if injector.from_power_up:  # until then every frame is looked at
                for cob_id in range(0x800):
                    route_of(self.from_controller, cob_id)
                    route_of(self.from_drives, cob_id)

    @property
    def waiting(self) -> int:
        """Frames that go on later."""
        return len(self._waiting)

    def add(self, injector: Injector) -> None:
        """One more, behind the others. Raises FaultError, having done nothing."""
        self.windows.extend([*self._injectors, injector])
        self._lay(injector)

    def free(self) -> None:
        """The first frame has come: pass on what nobody looks at."""
        for table in (self.from_controller, self.from_drives):
            for cob_id, route in enumerate(table):
                if route is not None and route.kind == PLAIN and not route.injectors and not route.watchers:
                    table[cob_id] = None

    def plan(self) -> None:
        """Note when something is due next."""
        self.windows.plan()
        self.next_ns = self.windows.next_ns
        self.is_waiting = self.windows.is_waiting
        if self._waiting and self._waiting[0][0] < self.next_ns:
            self.next_ns = self._waiting[0][0]

    def advance(self, now: int) -> None:
        """Do all that is due up to and including `now`, instant by instant."""
        while self.next_ns <= now:
            at = self.next_ns
            if self.windows.next_ns <= at:
                self._settle(at, [])
            while self._waiting and self._waiting[0][0] <= at:
                self._release(at)
            self.plan()

    def attend(self, now: int) -> None:
        """Something has happened to an injector from outside: look at `now` what comes of it."""
        self.windows.next_ns = self.next_ns = now

    def settle(self, now: int) -> None:
        """Do all that is due up to and including `now`, after something was armed, disarmed or started from outside."""
        self.plan()
        self.advance(now)
        self._settle(now, [])
        self.plan()

    def watch(self, now: int, port: int, route: Route, frame: Frame) -> None:
        """Let events, effects and triggers look at a frame as it comes in, and windows open that wait for one."""
        happens = self.is_waiting
        for number in route.watchers:
            if self.windows.link(number).watch(now, port, frame):
                happens = True
        if happens:
            self._settle(now, route.injectors)
            self.plan()

    def through(self, now: int, port: int, injectors: list[Injector], frame: Frame) -> Frame | None:
        """What goes on at once after these injectors in place of a frame at the first of them; None: lost, or later."""
        for injector in injectors:
            left: Frame | None = frame
            is_held = False
            if injector.watches_target and injector.observe_target(now, frame):
                self._settle(now, [], injector)
                self.plan()
            injector.arrive(now)
            if injector.phase is ACTIVE:
                left = injector.act(now, port, frame, self._tray)
            if len(frame.data) >= injector.least_bytes:
                injector.held[frame.can_id] = frame
            if injector.has_news:
                is_held = self._carry_out(now, port, injector, left is None)
            if injector.lines and left is not None:
                is_held = self._queue(port, injector, frame, left)
                left = None if is_held else left
            if left is not frame:
                if left is None:
                    if not is_held:
                        self.lost[port] += 1
                    return None
                if left.can_id != frame.can_id or left.flags != frame.flags:
                    return self._go_on(now, port, injector.number, left)
                frame = left
        return frame

    def _go_on(self, now: int, port: int, number: int, frame: Frame) -> Frame | None:
        """The frame after the injectors written behind the one with that number."""
        if frame.flags:
            return frame
        route = self._table(port)[frame.can_id]
        if route is None:
            return frame
        behind = [injector for injector in route.injectors if injector.number > number]
        return self.through(now, port, behind, frame)

    def _send(self, now: int, port: int, number: int, frame: Frame) -> None:
        """Let a frame that did not just arrive go on from behind an injector."""
        left = self._go_on(now, port, number, frame)
        if left is not None:
            self.outbox.append((1 - port, left))
            self.speaks = True

    def _carry_out(self, now: int, port: int, injector: Injector, is_gone: bool) -> bool:
        """What acting has left to be done. is_gone: a frame has arrived and does not go on at once; whether it will."""
        injector.has_news = False
        tray = self._tray
        late, inserted = tray.late, tray.inserted
        is_held = is_gone and len(late) > 0
        tray.clear()
        if injector.has_turned:
            injector.has_turned = False
            self._settle(now, [])
            self.plan()
        for one in late:
            self._hold(now, port, injector, one)
        self.inserted[port] += len(inserted) + len(late) - (1 if is_held else 0)
        for frame in inserted:
            self._send(now, port, injector.number, frame)
        return is_held

    def _hold(self, now: int, port: int, injector: Injector, later: Later) -> None:
        """Keep a frame until its time."""
        if later.at_ns < now:
            raise FaultError(
                f"injector {injector.name}: its fault sends {later.frame} at {later.at_ns} ns, it is {now} ns; "
                "allowed is now and later"
            )
        at_ns = later.at_ns
        if later.in_order:
            key = later.frame.can_id << 1 | port
            line = injector.lines.get(key)
            if line is None:
                line = Line(at_ns)
                injector.lines[key] = line
            line.at_ns = at_ns = max(at_ns, line.at_ns)
            line.waiting += 1
        self._put(at_ns, port, injector, later.in_order, later.frame)

    def _queue(self, port: int, injector: Injector, arrived: Frame, left: Frame) -> bool:
        """Put a frame behind those of its COB-ID that wait there; False when there are none."""
        line = injector.lines.get(left.can_id << 1 | port)
        if line is None:
            return False
        line.waiting += 1
        injector.count_wait(arrived, left)
        self._put(line.at_ns, port, injector, True, left)
        return True

    def _put(self, at_ns: int, port: int, injector: Injector, in_order: bool, frame: Frame) -> None:
        self._sequence += 1
        insort(self._waiting, (at_ns, self._sequence, port, injector.number, in_order, frame))
        if at_ns < self.next_ns:
            self.next_ns = at_ns

    def _release(self, now: int) -> None:
        """The first of the frames that wait goes on."""
        _, _, port, number, in_order, frame = self._waiting.pop(0)
        injector = self._injectors[number]
        key = frame.can_id << 1 | port
        if in_order:
            line = injector.lines[key]
            line.waiting -= 1
            if line.waiting == 0:
                del injector.lines[key]
        self._send(now, port, number, frame)

    def _wake(self, now: int) -> None:
        """The faults that asked for it insert what they have to insert."""
        for injector in self._injectors:
            if injector.wake_ns <= now and injector.phase is ACTIVE:
                injector.wake(now, self._tray)
                if injector.has_news:
                    self._carry_out(now, injector.port, injector, False)

    def _settle(self, now: int, arriving: list[Injector], met: Injector | None = None) -> None:
        """Windows, the faults that want to be woken now, and what is to be said about them on the bus."""
        windows = self.windows
        windows.settle(now, arriving, met)
        said, windows.said = windows.said, []
        if windows.opened or said:
            self.speaks = True
        self._wake(now)
        for report in said:
            self._say(report)

    def _say(self, report: Report) -> None:
        if report.to_drives:
            self.outbox.append((1, report.frame))
        if report.to_controller:
            self.outbox.append((0, report.frame))

    def _lay(self, injector: Injector) -> None:
        """The routes of one more injector."""
        self._injectors.append(injector)
        passes = injector.wire is not None and not injector.watches_target
        for cob_id in () if passes else sorted(set(injector.target.cob_ids)):
            if injector.target.to_drives:
                route_of(self.from_controller, cob_id).injectors.append(injector)
            if injector.target.to_controller:
                route_of(self.from_drives, cob_id).injectors.append(injector)
        watches = set(injector.watches())
        if injector.trigger is not None and injector.trigger.frame is not None:
            pattern = injector.trigger.frame
            watches |= {(0, pattern.cob_id)} if pattern.to_drives else set()
            watches |= {(1, pattern.cob_id)} if pattern.to_controller else set()
        for port, cob_id in sorted(watches):
            route_of(self._table(port), cob_id).watchers.append(injector.number)

    def _table(self, port: int) -> list[Route | None]:
        return self.from_drives if port else self.from_controller

    def __reduce__(self) -> tuple[type["Passage"], tuple[list[Injector]], dict[str, object]]:
        return Passage, (self._injectors,), {name: getattr(self, name) for name in _STATE}


def route_of(table: list[Route | None], cob_id: int) -> Route:
    """The route of that COB-ID, made when it is not there."""
    route = table[cob_id]
    if route is None:
        route = Route(PLAIN)
        table[cob_id] = route
    return route
