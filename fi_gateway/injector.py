"""Injectors: target + fault + event + effect (+ trigger), each with its windows over time.

The gateway tells an injector the time and shows it the frames; `windows` opens and closes it, `passage` carries out
what its fault asks for. A few lines beyond the usual length: all that an injector is made of and copied with is here.
"""

import zlib
from typing import Final, final

from numpy.random import PCG64, Generator, SeedSequence

from canopen_exo.bus.frame import Frame
from canopen_exo.bus.node import NEVER
from fi_gateway.activation import Activation
from fi_gateway.effects import Effect
from fi_gateway.errors import FaultError
from fi_gateway.events import Event
from fi_gateway.faults.base import Fault
from fi_gateway.on_wire import OnWire
from fi_gateway.outlet import Line, Tray
from fi_gateway.phase import ACTIVE, ARMED, INERT, SPENT, WAITING, Phase
from fi_gateway.repair import Repair
from fi_gateway.rng_state import state_of
from fi_gateway.trigger import Report, Trigger

_INJECTOR_STATE: Final = (
    "phase",
    "next_ns",
    "wake_ns",
    "end_ns",
    "held",
    "lines",
    "has_news",
    "has_turned",
    "has_manifested",
    "activated",
    "injected",
    "manifested",
    "manifested_windows",
    "ended",
    "too_short",
    "_base_ns",
    "_cause",
    "_due_ns",
    "_left",
    "_port",
    "_current",
    "_recent",
    "_instant_ns",
    "_arrived",
    "_used_ns",
    "_is_put_off",
)
"""What `__reduce__` copies besides the constructor arguments."""


@final
class Target:
    """Which frames an injector sees: classical 11-bit data frames of these COB-IDs, in these directions.

    name: what records call them, such as "right_knee.TPDO1"; a signal has its own name. on_bus: it is a bus, which may
    be without COB-IDs.
    """

    def __init__(
        self, to_controller: bool, to_drives: bool, cob_ids: tuple[int, ...], name: str = "", on_bus: bool = False
    ) -> None:
        if not (to_controller or to_drives):
            raise FaultError("target: no direction given, allowed: to_controller, to_drives or both")
        if (not cob_ids and not on_bus) or min(cob_ids, default=0) < 0 or max(cob_ids, default=0) > 0x7FF:
            raise FaultError(f"target: COB-IDs {[hex(i) for i in cob_ids]} given, allowed one or more of 0x0..0x7ff")
        self.to_controller: Final[bool] = to_controller
        self.to_drives: Final[bool] = to_drives
        self.cob_ids: Final[tuple[int, ...]] = cob_ids
        self.name: Final[str] = name
        self.on_bus: Final[bool] = on_bus

    def __deepcopy__(self, memo: dict[int, object]) -> "Target":
        return self  # it never changes: copies share it

    def __reduce__(self) -> tuple[type["Target"], tuple[bool, bool, tuple[int, ...], str, bool]]:
        return Target, (self.to_controller, self.to_drives, self.cob_ids, self.name, self.on_bus)


@final
class Injector:
    """One injector; the gateway tells it the time and shows it the frames. phase: see `phase`.

    An event or trigger that comes while waiting or active is ignored. enabled False: never leaves inert until armed.
    from_power_up: its times count from power-up instead of time 0. rng: the stream of this injector alone (`stream`);
    fault_rng: that of its fault, so that what a fault does to frames does not hang on what decides when (None: rng).
    rearms: whether it arms again after a window, None: as the effect says; max_activations: spent after so many, 0 for
    no limit. repair: what is put right in a payload that the fault has changed. reports: what it says on the bus.
    next_ns: when it acts by itself next (event, or end of the window), NEVER for not at all; wake_ns: when its fault
    wants to be woken; end_ns: end of the last window that is over; held: the last frame of each target COB-ID that
    reached it, if it had the least_bytes that the signal needs. number: its place in written order.
    lines: frames that wait behind it, by COB-ID x 2 + port.
    has_news: acting has left something to be carried out; has_turned: so that windows may open or close, or the fault
    is woken at another time; has_manifested: the open window has;
    manifested_windows, ended: windows that have manifested, that are over. too_short: frames that did not hold what the
    fault acts on. wire: its fault, if that acts on a bus: then attempts to send are what counts, and target frames that
    pass the gateway are left alone.
    """

    def __init__(
        self,
        name: str,
        target: Target,
        fault: Fault,
        event: Event,
        effect: Effect,
        trigger: Trigger | None,
        rng: Generator,
        enabled: bool = True,
        from_power_up: bool = False,
        rearms: bool | None = None,
        max_activations: int = 0,
        repair: Repair | None = None,
        reports: tuple[Report, ...] = (),
        fault_rng: Generator | None = None,
    ) -> None:
        signal = fault.signal
        if signal is not None and target.cob_ids != (signal.cob_id,):
            raise FaultError(
                f"injector {name}: target COB-IDs {[hex(i) for i in target.cob_ids]} given for signal "
                f"{signal.node}.{signal.name}, allowed is {[hex(signal.cob_id)]}, where it lies"
            )
        if max_activations < 0:
            raise FaultError(f"injector {name}: max_activations {max_activations} given, allowed 0 (no limit) and more")
        self.name: Final[str] = name
        self.target: Final[Target] = target
        self.trigger: Final[Trigger | None] = trigger
        self.reports: Final[tuple[Report, ...]] = reports
        self.enabled: bool = enabled
        self.from_power_up: Final[bool] = from_power_up
        self.watches_target: Final[bool] = event.watches_target
        self.wire: Final[OnWire | None] = fault if isinstance(fault, OnWire) else None
        self.least_bytes: Final[int] = 0 if signal is None else (signal.start + signal.length + 7) // 8
        self.number: int = 0
        self.phase: Phase = INERT
        self.next_ns: int = NEVER
        self.wake_ns: int = NEVER
        self.end_ns: int = -NEVER
        self.held: dict[int, Frame] = {}
        self.lines: dict[int, Line] = {}
        self.has_news: bool = False
        self.has_turned: bool = False
        self.has_manifested: bool = False
        self.activated: int = 0
        self.injected: int = 0
        self.manifested: int = 0
        self.manifested_windows: int = 0
        self.ended: int = 0
        self.too_short: int = 0
        self._signal: Final[str] = target.name if signal is None else f"{signal.node}.{signal.name}"
        self._fault: Final[Fault] = fault
        self._event: Final[Event] = event
        self._effect: Final[Effect] = effect
        self._rng: Final[Generator] = rng
        self._fault_rng: Final[Generator] = rng if fault_rng is None else fault_rng
        self._given_rearms: Final[bool | None] = rearms
        self._rearms: Final[bool] = effect.rearms if rearms is None else rearms
        self._max_activations: Final[int] = max_activations
        self._repair: Final[Repair | None] = repair
        self._base_ns: int = NEVER
        self._cause: str = ""
        self._due_ns: int = NEVER
        self._left: int = 0
        self._port: int = 0 if target.to_drives else 1
        self._current: Activation | None = None
        self._recent: Activation | None = None
        self._instant_ns: int = -NEVER
        self._arrived: int = 0
        self._used_ns: int = -NEVER
        self._is_put_off: bool = False

    @property
    def port(self) -> int:
        """Where the last target frame came in; before one has, a side from which the target travels."""
        return self._port

    @property
    def adds(self) -> bool:
        """Whether it sends frames of its own, or under another COB-ID (see Fault), reports included."""
        return self._fault.adds or len(self.reports) > 0

    def takes(self, cob_id: int) -> bool:
        """Whether frames with that COB-ID are its target, or fire it."""
        trigger = self.trigger
        fires = trigger is not None and trigger.frame is not None and trigger.frame.cob_id == cob_id
        return fires or cob_id in self.target.cob_ids

    def watches(self) -> list[tuple[int, int]]:
        """(port, COB-ID) of the frames that event and effect want to observe as they come in."""
        return sorted({*self._event.watches, *self._effect.watches})

    def start(self, base_ns: int) -> None:
        """Time 0 (or power-up) is `base_ns`: arm."""
        if self.phase is INERT:
            self._base_ns = base_ns
            if self.enabled:
                self._arm(self._event.first())

    def arm(self, now: int) -> None:
        """Live control: wait for event and trigger, also when disabled or spent; what was due before `now` is over."""
        self.enabled = True
        if self.phase is SPENT:
            self.phase = INERT
        if self.phase is INERT and self._base_ns != NEVER:
            relative_ns = now - self._base_ns
            self._arm(self._event.next(relative_ns) if relative_ns > 0 else self._event.first())

    def disarm(self, now: int) -> None:
        """Live control: no more injection until armed again; an open window ends at `now`."""
        self.enabled = False
        self.close(now)
        self._is_put_off = False
        if self.phase is not SPENT:
            self.phase, self.next_ns = INERT, NEVER

    def open(self, now: int, cause: str, is_met: bool = False) -> Activation | None:
        """Open the window at `now`; None when it has to wait. For a waiting one the first cause stays.

        It waits for a value that the fault needs, and for the next instant when the last window has met a frame in this
        one, or when a target frame has passed in it. is_met: with the one that has just reached the injector, though.
        """
        if self.phase is not WAITING and not self._is_put_off:
            self._cause, self._due_ns = cause, now
        start_ns = now if now > self._due_ns else self._due_ns  # a frame stamped before a command, read after it
        passed = self._arrived if self._instant_ns == start_ns else 0
        self._is_put_off = start_ns < self.end_ns or (passed > 0 and not is_met)
        if self._is_put_off:
            self.phase, self.next_ns = ARMED, start_ns + 1
            return None
        stream = state_of(self._fault_rng)
        if not self._fault.begin(start_ns, self.held, self._fault_rng):
            self.phase, self.next_ns = WAITING, NEVER
            return None
        opened = Activation(
            self.name, self.activated, self._signal, self._cause, self._due_ns, start_ns, self._effect.duration()
        )
        opened.skipped, opened.stream = passed, stream
        self.phase, self.next_ns, self._current = ACTIVE, opened.end_ns, opened
        self.activated += 1
        self.has_manifested = False
        self._fault.bound(opened.end_ns)
        self.wake_ns = self._fault.wake_at
        self._left = self._effect.frames
        return opened

    def observe(self, now: int, port: int, frame: Frame) -> bool:
        """A frame of `watches` has come in; whether the window opens, or ends, with it."""
        key, relative_ns = (port, frame.can_id), now - self._base_ns
        starts = key in self._event.watches and self._event.observe(relative_ns, frame)
        ends = key in self._effect.watches and self._effect.observe(relative_ns, frame)
        return self._is_due(now, starts, ends)

    def observe_target(self, now: int, frame: Frame) -> bool:
        """A target frame has reached this injector, whose event looks at each; whether the window opens with it."""
        return self._is_due(now, self._event.observe(now - self._base_ns, frame), False)

    def arrive(self, now: int) -> None:
        """Count a target frame that has reached this injector, whether or not it acts on it."""
        if now == self._instant_ns:
            self._arrived += 1
        else:
            self._instant_ns, self._arrived = now, 1

    def act(self, now: int, port: int, frame: Frame, tray: Tray) -> Frame | None:
        """What becomes of a target frame that arrives at `now` while active; None: lost, or later (in the tray)."""
        current = self._current
        if current is None or now < current.start_ns:  # stamped before the window, read after it opened
            return frame
        if self.wire is not None:
            return frame
        current.frames_seen += 1
        self._used_ns = now
        fault = self._fault
        if not fault.fits(frame):
            current.frames_unfit += 1
            self.too_short += 1
            return frame
        self._port = port
        result = fault.apply(now, frame, tray)
        if fault.wake_at != self.wake_ns:
            self.wake_ns, self.has_news, self.has_turned = fault.wake_at, True, True
        if result is not frame or tray.used:
            if self._repair is not None:
                result = self._repaired(frame, result, tray)
            self.injected += 1
            current.frames_injected += 1
            if tray.used or result is None:
                self.manifested += current.count_passage(frame, result, len(tray.late), len(tray.inserted))
                self.has_news = self.has_news or tray.used
                if not self.has_manifested:
                    self._first(now, current, frame, _shown(frame, result, tray))
            elif result != frame:
                self.manifested += 1
                current.frames_changed += 1
                if not self.has_manifested:
                    self._first(now, current, frame, result)
            self._use_up(now, 1)
        elif not fault.spares:
            self.injected += 1
            current.frames_injected += 1
            self._use_up(now, 1)
        return result

    def wake(self, now: int, tray: Tray) -> None:
        """The time that the fault asked for has come. Raises FaultError for one that asks for it again."""
        current, fault = self._current, self._fault
        if current is None:
            return
        fault.wake(now, tray)
        if fault.wake_at <= now:
            raise FaultError(
                f"injector {self.name}: its fault {type(fault).__name__} asks to be woken at {fault.wake_at} ns again, "
                f"it is {now} ns; wake() must move wake_at on"
            )
        self.wake_ns = fault.wake_at
        if not tray.used:
            return
        self._used_ns = now
        if self._repair is not None:
            self._repaired(None, None, tray)
        count = len(tray.inserted) + len(tray.late)
        self.manifested += count
        current.frames_inserted += count
        if not self.has_manifested:
            self._first(now, current, None, tray.inserted[0] if tray.inserted else tray.late[0].frame)
        self.has_news = True
        self._use_up(now, count)

    def disturb(self, now: int, frame: Frame | None) -> None:
        """Its wire fault has disturbed an attempt to send a frame (None: an idle bus), or added one.

        An error may be noticed after the window has closed; it belongs to the window all the same.
        """
        current, wire = self._current or self._recent, self.wire
        if current is None or wire is None:
            return
        is_first = current.manifested == 0
        self.injected += 1
        self.manifested += 1
        if wire.adds:
            current.frames_inserted += 1
        else:
            current.attempts_disturbed += 1
        if is_first:
            self._first(now, current, None if wire.adds else frame, frame if wire.adds else None)
            self.has_manifested = self._current is not None
        if self._left and self._current is not None:
            self._left -= 1
            if self._left == 0:
                self.close(now + 1)
                self.has_news = self.has_turned = True

    def count_wait(self, arrived: Frame, left: Frame) -> None:
        """A frame has to wait behind others here; one that the fault has left alone is delayed by that."""
        current = self._current
        if current is not None and left is arrived:
            self.manifested += 1
            current.frames_delayed += 1

    def draw(self) -> float:
        """For its trigger: a number 0..1 of its own stream."""
        return float(self._rng.random())

    def close(self, end_ns: int) -> None:
        """The window ends; `end_ns` is the first instant outside it."""
        current = self._current
        if current is None:
            return
        self._fault.bound(end_ns)
        self._fault.end()
        end_ns = end_ns if end_ns > current.start_ns else current.start_ns
        if end_ns == self._used_ns:  # it has met, or inserted, a frame in that very instant
            end_ns += 1
        current.end_ns = end_ns
        current.saturated = self._fault.saturated
        if self.wire is not None:
            current.attempts_seen = self.wire.seen
            self._recent = current
        self._current = None
        self.has_manifested = False
        self.wake_ns = NEVER
        self.end_ns = end_ns
        self.ended += 1
        if self._rearms and (self._max_activations == 0 or self.activated < self._max_activations):
            self._arm(self._event.next(end_ns - self._base_ns))
        else:
            self.phase, self.next_ns = SPENT, NEVER

    def stop(self, now: int) -> None:
        """No more injection; an open window ends at `now`, one without limit keeps its end NEVER."""
        current = self._current
        self.close(now)
        if current is not None and current.duration_ns >= NEVER and self._effect.frames == 0:
            current.end_ns = NEVER
        self.phase, self.next_ns, self._is_put_off = SPENT, NEVER, False

    def __reduce__(self) -> tuple[type["Injector"], tuple[object, ...], dict[str, object]]:
        given = (self.name, self.target, self._fault, self._event, self._effect, self.trigger, self._rng)
        state = {name: getattr(self, name) for name in _INJECTOR_STATE}
        more = (self._given_rearms, self._max_activations, self._repair, self.reports, self._fault_rng)
        return Injector, (*given, self.enabled, self.from_power_up, *more), state

    def _arm(self, relative_ns: int) -> None:
        self.phase, self._is_put_off = ARMED, False
        self.next_ns = NEVER if relative_ns >= NEVER else min(self._base_ns + relative_ns, NEVER)

    def _is_due(self, now: int, starts: bool, ends: bool) -> bool:
        """Note that the window opens, or ends, at `now`; whether it does."""
        if (starts and self.phase is ARMED and now >= self.end_ns) or (ends and self.phase is ACTIVE):
            self.next_ns = now if now < self.next_ns else self.next_ns
            return True
        return False

    def _use_up(self, now: int, frames: int) -> None:
        """The fault has acted on, or inserted, so many frames; the window ends after the last one of its effect."""
        if self._left:
            self._left -= min(frames, self._left)
            if self._left == 0:
                self.close(now + 1)
                self.has_news = self.has_turned = True

    def _first(self, now: int, current: Activation, before: Frame | None, after: Frame | None) -> None:
        """The window has manifested."""
        current.first_ns, current.first_before, current.first_after = now, before, after
        self.has_manifested = True
        self.manifested_windows += 1
        self.has_news = self.has_turned = True

    def _repaired(self, frame: Frame | None, result: Frame | None, tray: Tray) -> Frame | None:
        """What the fault made of `frame`, with checksum and counter put right where its payload is another one."""
        assert self._repair is not None
        tray.repair(self._repair, frame)
        return None if result is None else self._repair.frame(frame, result)


def _shown(frame: Frame, result: Frame | None, tray: Tray) -> Frame | None:
    """What a record shows for a frame that is lost, late, or did not stay alone; None: lost."""
    if result is not None and result != frame:
        return result
    if result is not None and tray.inserted:
        return tray.inserted[0]
    return tray.late[0].frame if tray.late else None


def stream(seed: int, run: int, name: str) -> Generator:
    """The random stream of one injector in one run: another injector more or less changes none."""
    return Generator(PCG64(SeedSequence(seed, spawn_key=(run, zlib.crc32(name.encode())))))
