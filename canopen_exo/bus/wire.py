"""A bus on which errors happen: disturbed attempts, retransmission, error states of the ports, bus-off and restart.

Source: ISO 11898-1 (Bosch CAN 2.0B), fault confinement; `controller` has the bits, `confinement` the counters.
An attempt to send goes through the bit engine only when something disturbs it, two nodes send the same arbitration
bits, nobody is there to acknowledge, or a controller has not come to rest after an earlier error. All others are as on
the ideal bus, with the counters brought up to date where one is not 0.

Deviations. An attempt is worked out when it starts, and again from there on when something begins or ends to disturb it
(`replan`). A frame that is queued while error frames pass waits for their end, as it would, but one queued within the
few bits in which an undisturbed node could already start waits with the others.
A frame is received at the end of its intermission, as everywhere in this project, also where a receiver accepts it and
an error frame follows.
Where an undisturbed frame is worked out again within its arbitration, those that lose it later count as receivers.
Of the error frames of one attempt the trace shows the first error that somebody noticed, and of the overload frames the
first. Lost arbitration is no error and not told.
"""

from typing import Final, final

from canopen_exo.bus.attempt import COUNT, END, ERROR, Step, controllers_of, put_back, steps_of
from canopen_exo.bus.bit_engine import run, split
from canopen_exo.bus.confinement import RX_SUCCESS, TX_SUCCESS, count, is_passive
from canopen_exo.bus.controller import IDLE, OFF, OVERLOAD, SUSPEND_LENGTH, Controller
from canopen_exo.bus.disturbance import NO_ACK, Disruption, Disturbance, joined
from canopen_exo.bus.error_frame import write_bus_error
from canopen_exo.bus.error_states import ErrorStates
from canopen_exo.bus.frame import FLAG_ERROR, Frame
from canopen_exo.bus.medium import Medium, Port, WireEvent, Wiring
from canopen_exo.bus.node import NEVER, Out
from canopen_exo.bus.recovery import RECESSIVE_BITS, is_present

MARGIN: Final = 64
"""Bits after the length of a frame that disturbances are asked about: for two error frames of the longest kind."""

LIMIT: Final = 4096
"""Bits worked out at once; a bus that is held dominant for longer goes on from there."""

_LONGEST_REST: Final = 32
"""Recessive bits after which every controller that sends nothing is at rest."""

_STATE: Final = (
    "disturbances", "sink", "wake_at", "attempts", "spans", "_started_ns", "_disruptions", "_initial", "_engaged",
    "_steps", "_done", "_unsettled", "_free_ns", "_states", "_suspects", "_sent", "_is_noticed", "_is_charged",
    "_is_calm", "_is_stale", "_is_held",
)  # fmt: skip
"""What `__reduce__` copies besides the medium, which need not be whole yet."""


@final
class Wire(Wiring):
    """Errors on one medium. disturbances: what disturbs it, asked in this order; may be added to between two calls.

    attempts: those that went through the bit engine; spans: when each of them began and ended [ns], its error frames
    included.
    """

    def __init__(self, medium: Medium, disturbances: list[Disturbance]) -> None:
        super().__init__()
        self.medium: Final[Medium] = medium
        self.disturbances: Final[list[Disturbance]] = disturbances
        self.attempts: int = 0
        self.spans: list[tuple[int, int]] = []
        self._started_ns: int = 0
        self._disruptions: list[Disruption] = []
        self._initial: list[Controller] = []
        self._engaged: list[Controller] = []
        self._steps: list[Step] = []
        self._done: int = 0
        self._unsettled: list[Controller] = []
        self._free_ns: int = 0
        self._states: ErrorStates = ErrorStates(medium)
        self._suspects: list[tuple[Disturbance, int]] = []
        self._sent: Frame | None = None
        self._is_noticed: bool = False
        self._is_charged: bool = False
        self._is_calm: bool = True
        self._is_stale: bool = False
        self._is_held: bool = False
        for disturbance in disturbances:
            self.wake_at = min(self.wake_at, disturbance.next_ns(1))

    # --- begin ---------------------------------------------------------------------------------------------------

    def start(self, now: int) -> None:
        """Begin the next attempt, or put it off while those who want to send have to wait."""
        waiting = self.medium.waiting
        if self._is_calm:
            self._begin(now, waiting[0], 0)
            return
        self._settle(now)
        for offer in self._offers(now):
            self._begin(now, offer, waiting.index(offer))
            return
        if self.medium.is_restless:
            self._attempt(now, [], self._ask(now, now + MARGIN * self.medium.bit_ns, None, -1))
        else:
            self._plan_wake(now + 1)

    def _begin(self, now: int, first: tuple[Frame, Port], at: int) -> None:
        """An attempt that the frame wins which waits at place `at`: nearly always one that nothing disturbs."""
        medium = self.medium
        frame, port = first
        bits = frame.bits or frame.measure()
        bit_ns = medium.bit_ns
        disruptions: list[Disruption] = []
        if self.disturbances:
            disruptions = self._ask(now, now + (bits + MARGIN) * bit_ns, frame, port.number)
        if disruptions or self._unsettled or self._is_contested(now, frame, port):
            self._attempt(now, self._offers(now), disruptions)
            return
        medium.waiting.pop(at)
        medium.on_wire = first
        medium.end = now + bits * bit_ns
        self._is_held = False
        medium.is_watched = self._is_charged or not self._is_calm or medium.has_order
        self._started_ns = now

    def _ask(self, now: int, until: int, frame: Frame | None, sender: int) -> list[Disruption]:
        """What disturbs the next attempt; who does is noted, and from which bit on."""
        disruptions: list[Disruption] = []
        self._suspects = []
        for disturbance in self.disturbances:
            found = disturbance.errors(now, until, self.medium.bit_ns, frame, sender)
            if found:
                disruptions.extend(found)
                self._suspects.append((disturbance, min([one.first for one in found])))
        return disruptions

    def _is_contested(self, now: int, frame: Frame, port: Port) -> bool:
        """Nobody is there to acknowledge, or another port begins with the same arbitration bits."""
        medium = self.medium
        if len(medium.ports) - self._states.absent - self._states.late(now).bit_count() < 2:
            return True
        waiting = medium.waiting
        if len(waiting) == 1 or (self._is_calm and waiting[1][0].arbitration != frame.arbitration):
            return False
        for other, rival in waiting:
            if other.arbitration > frame.arbitration:
                break
            if rival is not port and rival.ready_ns <= port.ready_ns:
                medium.collisions += 1
                return True
        return False

    def _offers(self, now: int) -> list[tuple[Frame, Port]]:
        """What each controller that may send now would send, in order of arbitration."""
        offers: list[tuple[Frame, Port]] = []
        seen = 0
        for waiting in self.medium.waiting:
            port = waiting[1]
            if not seen >> port.number & 1:
                seen |= 1 << port.number
                if port.ready_ns <= now and self._is_ready(port):
                    offers.append(waiting)
        return offers

    def _is_ready(self, port: Port) -> bool:
        """It is at rest, or has just seen the SOF of somebody else."""
        for controller in self._unsettled:
            if port.number in controller.ports:
                return controller.may_join
        return True

    def _settle(self, now: int) -> None:
        """The bus was idle until `now`: what came of it for those who had to wait for that."""
        bit_ns = self.medium.bit_ns
        self._states.hear(self._free_ns, now)
        idle = min((now - self._free_ns) // bit_ns, _LONGEST_REST)
        unsettled: list[Controller] = []
        for controller in self._unsettled:
            for _ in range(idle):
                controller.step(-1, 1)
            if controller.state != IDLE:
                unsettled.append(controller)
        self._unsettled = unsettled
        calm = not unsettled and not self._states.recoveries
        for port in self.medium.ports:
            calm = calm and port.ready_ns <= now
        self._is_calm = calm

    # --- an attempt that the bit engine works out ------------------------------------------------------------------

    def _attempt(self, now: int, offers: list[tuple[Frame, Port]], disruptions: list[Disruption]) -> None:
        medium = self.medium
        self.attempts += 1
        self._initial = controllers_of(offers, self._unsettled, medium.ports, self._states.late(now))
        self._sent = offers[0][0] if offers else None
        self._started_ns = now
        self._done = 0
        self._is_noticed = False
        if offers:
            medium.on_wire = offers[0]
        medium.is_watched = True
        medium.is_restless = False
        self._work_out(disruptions)
        medium.end = self._time(self._steps[0])

    def _work_out(self, disruptions: list[Disruption]) -> None:
        """The attempt from its start, so disturbed; of its steps those are left that have not happened yet."""
        self._disruptions = disruptions
        self._engaged = split([one.part(one.ports) for one in self._initial], disruptions)
        bits = run(self._engaged, disruptions, LIMIT)
        self._steps = steps_of(self._engaged, bits, self.medium.ports)[self._done :]

    def _work_out_again(self, now: int) -> None:
        """Something has begun or ended to disturb the bus: what is under way may go on in another way from here."""
        medium = self.medium
        is_plain = not self._steps
        frame, port = medium.on_wire
        if medium.end == NEVER or (is_plain and not is_present(port)):
            return
        known = self._suspects
        until = max(self._started_ns + frame.bits * medium.bit_ns, now) + MARGIN * medium.bit_ns
        sends = is_plain or self._sent is not None
        found = self._ask(self._started_ns, until, frame if sends else None, port.number if sends else -1)
        self._suspects = known + [one for one in self._suspects if one not in known]
        before = [] if is_plain else self._disruptions
        found = joined(before, found, (now - self._started_ns) // medium.bit_ns)
        if found == before:
            return
        if is_plain:
            put_back(medium.waiting, frame, port)
            self._attempt(self._started_ns, [(frame, port)], found)
        else:
            self._work_out(found)
        medium.end = max(self._time(self._steps[0]), now)

    def _time(self, step: Step) -> int:
        return self._started_ns + (step.at + 1) * self.medium.bit_ns

    # --- what comes of it ------------------------------------------------------------------------------------------

    def advance(self, now: int) -> None:
        """What has happened by `now`."""
        medium = self.medium
        events: list[WireEvent] = []
        if not self._steps:
            self._passed(now, events)
        while self._steps and self._time(self._steps[0]) <= now:
            step = self._steps.pop(0)
            self._done += 1
            if step.kind == COUNT:
                self._states.count(now, step.port, step.tec, step.rec, events)
            elif step.kind == ERROR and step.error is not None:
                medium.errors += 0 if step.error.kind == OVERLOAD else 1
                self._blame(now)
                can_id, data = write_bus_error(step.error)
                events.append(WireEvent(Frame(can_id, data, FLAG_ERROR), step.port, []))
            elif step.frame is not None:
                if step.frame != self._sent:
                    self._blame(now)
                events.append(WireEvent(step.frame, step.port, step.ports))
            elif step.kind == END:
                self._ended(now)
        if self._steps:
            medium.end = self._time(self._steps[0])
        else:
            medium.is_watched = False
            # the last 11 bits of an attempt were recessive, unless it was broken off at LIMIT: they are yet to come
            self._free_ns = now + RECESSIVE_BITS * medium.bit_ns if self._is_held else now
            self._states.finish(now, self._free_ns, events)
            self._plan_wake(now)
        self.sink.happened(now, events)

    def _blame(self, now: int) -> None:
        """Tell those that disrupted bits of this attempt that it was noticed, once."""
        suspects, self._suspects = self._suspects, []
        if not self._is_noticed:
            self._is_noticed = True
            told: list[Disturbance] = []
            for disturbance, first in suspects:
                if self._started_ns + first * self.medium.bit_ns < now and disturbance not in told:
                    told.append(disturbance)
                    disturbance.disturbed(now, self._sent)

    def _passed(self, now: int, events: list[WireEvent]) -> None:
        """A frame has passed undisturbed: the counters fall."""
        medium = self.medium
        frame, sender = medium.on_wire
        for port in medium.ports:
            if port is sender:
                if port.tec:
                    tec, rec = count(TX_SUCCESS, port.tec, port.rec)
                    self._states.count(now, port, tec, rec, events)
                if is_passive(port.tec, port.rec):
                    port.ready_ns = now + SUSPEND_LENGTH * medium.bit_ns
                    self._is_calm = False
            elif port.rec and is_present(port):
                tec, rec = count(RX_SUCCESS, port.tec, port.rec)
                self._states.count(now, port, tec, rec, events)
        self._weigh()
        sender.follow()
        events.append(WireEvent(frame, sender, None))

    def _ended(self, now: int) -> None:
        """The attempt is over: frames that were sent leave their queues, the others stay."""
        medium = self.medium
        self.spans.append((self._started_ns, now))
        unsettled: list[Controller] = []
        for controller in self._engaged:
            port = medium.ports[controller.ports[0]]
            frame = controller.frame
            if frame is not None and controller.sent_at >= 0:
                self._forget(frame, port)
            elif frame is not None and controller.has_failed and port.is_one_shot and self._forget(frame, port):
                port.lost += 1
            rest = 0
            if controller.state != IDLE and controller.state != OFF:
                unsettled.append(controller.part(controller.ports))
                rest = controller.idle_in
                medium.is_restless = medium.is_restless or controller.will_drive
            if controller.suspends or (rest and controller.transmitter and is_passive(controller.tec, controller.rec)):
                rest += SUSPEND_LENGTH
            for number in controller.ports:
                medium.ports[number].ready_ns = now + rest * medium.bit_ns
        self._is_held = len(unsettled) == len(self._engaged)
        if self._is_held:  # LIMIT: nobody has come to rest
            medium.is_restless = True
        self._unsettled = unsettled
        self._engaged = []
        self._is_calm = False
        self._weigh()

    def _forget(self, frame: Frame, port: Port) -> bool:
        """Take a frame out of the queue; False when it is no longer there."""
        waiting = self.medium.waiting
        for at, (other, owner) in enumerate(waiting):
            if other is frame and owner is port:
                del waiting[at]
                port.follow()
                return True
        return False

    def _weigh(self) -> None:
        """Whether any counter is above 0."""
        self._is_charged = False
        for port in self.medium.ports:
            self._is_charged = self._is_charged or port.tec + port.rec > 0

    # --- error states and disturbances, from outside ----------------------------------------------------------------

    @property
    def is_plain(self) -> bool:
        """What is on the wire, if anything, is not worked out by the bit engine."""
        return not self._steps

    def hears(self, port: Port) -> bool:
        """It took part in the bus from the beginning of what is, or was last, on the wire."""
        return self._states.takes_part(port, self._started_ns)

    def reconsider(self) -> None:
        """Counters or states of ports were set from outside."""
        self._weigh()
        self._is_calm = False

    def switch_off(self, now: int, port: Port) -> None:
        """Make a port bus-off, whatever its counters; it restarts as from any bus-off."""
        if is_present(port):
            events: list[WireEvent] = []
            self._states.switch_off(now, port, events)
            self._is_calm = False
            self.medium.is_watched = self.medium.end != NEVER
            self._plan_wake(now + 1)
            self.sink.happened(now, events)

    def hold_off(self, now: int, port: Port) -> None:
        """Make a port bus-off and keep it so, whatever its counters, until `let_go` was called as often as this."""
        self.switch_off(now, port)
        self._states.hold(port)
        self._plan_wake(now + 1)

    def let_go(self, now: int, port: Port, delay_ns: int = 0) -> None:
        """Ask a port that nobody holds off any more to restart in `delay_ns`, whatever its `restart_ns`."""
        self._states.let_go(port, now + delay_ns)
        self._is_calm = False
        self._plan_wake(now + 1)

    def replan(self, now: int) -> None:
        """A disturbance has begun or ended: look at it as soon as the nodes are woken at `now`.

        Whoever calls sees to it that the loop notices.
        """
        self._is_stale = True
        self.wake_at = now

    def disconnect(self, now: int, port: Port) -> None:
        """Its node is unplugged: what waits is lost, and nobody acknowledges there any more."""
        self._states.unplug(port)
        self._is_calm = False
        self._plan_wake(now + 1)

    def connect(self, now: int, port: Port) -> None:
        """A node is plugged in."""
        self._states.plug(now, port)
        self._is_calm = False
        self._plan_wake(now + 1)

    # --- timers ----------------------------------------------------------------------------------------------------

    def wake(self, now: int, out: Out) -> None:
        """A port leaves bus-off, a frame was put off until now, or something disturbs an idle bus."""
        medium = self.medium
        events: list[WireEvent] = []
        if self._is_stale:
            self._is_stale = False
            self._work_out_again(now)
        if medium.end == NEVER:
            self._states.finish(now, self._free_ns, events)
            if not medium.waiting and not medium.is_restless and not medium.is_cut:
                self._disturb(now)
        self._plan_wake(now + 1)
        if events:
            self.sink.happened(now, events)

    def _disturb(self, now: int) -> None:
        """Nothing is sent, but something may be seen."""
        bit_ns = self.medium.bit_ns
        disruptions = self._ask(now, now + MARGIN * bit_ns, None, -1)
        for disruption in disruptions:
            is_now = disruption.kind != NO_ACK and disruption.first == 0
            if is_now and len(self.medium.ports) > self._states.absent:
                self._settle(now)
                self._attempt(now, [], disruptions)
                return

    def _plan_wake(self, first: int) -> None:
        """Ask to be woken at `first` or later."""
        medium = self.medium
        if self._is_stale:
            return
        at = NEVER
        if medium.end == NEVER:
            at = self._states.next_ns(self._free_ns)
            if not self._is_calm:
                for _, port in medium.waiting:
                    at = min(at, port.ready_ns if port.ready_ns >= first else NEVER)
        after = first if medium.end == NEVER else medium.end
        for disturbance in self.disturbances:
            at = min(at, disturbance.next_ns(after))
        self.wake_at = max(at, first)

    def abort(self) -> None:
        """The attempt under way leads to nothing more; who had not come to rest does so while the bus is cut."""
        self._steps = []
        self._engaged = []
        self._unsettled = []
        self.medium.is_restless = False

    def __reduce__(self) -> tuple[type["Wire"], tuple[Medium, list[Disturbance]], dict[str, object]]:
        return Wire, (self.medium, []), {name: getattr(self, name) for name in _STATE}
