"""Injectors: target + fault + event + effect (+ trigger), and the record of what each activation did.

Three counts are kept apart, as in fault-injection practice: activated (windows opened), injected (frames the fault
acted on) and manifested (frames that really came out different, or not at all).
Left out: `all` triggers, triggers on manifested and ended, delays and probabilities of triggers.
"""

import zlib
from enum import Enum
from typing import Final, final

from numpy.random import PCG64, Generator, SeedSequence

from canopen_exo.bus.frame import Frame
from canopen_exo.bus.node import NEVER
from fi_gateway.effects import Effect
from fi_gateway.errors import FaultError
from fi_gateway.events import Event
from fi_gateway.faults import Fault
from fi_gateway.rng_state import state_of


class Phase(Enum):
    """State of an injector; its docstring has the transitions."""

    INERT = "inert"
    ARMED = "armed"
    WAITING = "waiting"
    ACTIVE = "active"
    SPENT = "spent"


INERT: Final = Phase.INERT
ARMED: Final = Phase.ARMED
WAITING: Final = Phase.WAITING
ACTIVE: Final = Phase.ACTIVE
SPENT: Final = Phase.SPENT

_TRIGGER_ON: Final = ("activated",)

_ACTIVATION_STATE: Final = (
    "end_ns",
    "frames_seen",
    "frames_unfit",
    "frames_injected",
    "frames_changed",
    "saturated",
    "first_before",
    "first_after",
    "stream",
)
_INJECTOR_STATE: Final = (
    "phase",
    "next_ns",
    "held",
    "activated",
    "injected",
    "manifested",
    "too_short",
    "_base_ns",
    "_cause",
    "_due_ns",
    "_left",
    "_current",
)
"""What `__reduce__` copies besides the constructor arguments."""


@final
class Target:
    """Which frames an injector sees: classical 11-bit data frames of these COB-IDs, in these directions.

    name: what records call them, such as "right_knee.TPDO1"; a signal has its own name.
    """

    def __init__(self, to_controller: bool, to_drives: bool, cob_ids: tuple[int, ...], name: str = "") -> None:
        if not (to_controller or to_drives):
            raise FaultError("target: no direction given, allowed: to_controller, to_drives or both")
        if not cob_ids or min(cob_ids) < 0 or max(cob_ids) > 0x7FF:
            raise FaultError(f"target: COB-IDs {[hex(i) for i in cob_ids]} given, allowed one or more of 0x0..0x7ff")
        self.to_controller: Final[bool] = to_controller
        self.to_drives: Final[bool] = to_drives
        self.cob_ids: Final[tuple[int, ...]] = cob_ids
        self.name: Final[str] = name

    def __reduce__(self) -> tuple[type["Target"], tuple[bool, bool, tuple[int, ...], str]]:
        return Target, (self.to_controller, self.to_drives, self.cob_ids, self.name)


@final
class Trigger:
    """Starts the injector when one of the named ones activates (`on: activated`), at the same instant."""

    def __init__(self, any_of: tuple[str, ...], on: str = "activated") -> None:
        if on not in _TRIGGER_ON:
            raise FaultError(f"trigger: on {on!r} given, allowed: {', '.join(_TRIGGER_ON)}")
        if not any_of:
            raise FaultError("trigger: no injector named in any, allowed are one or more")
        self.any_of: Final[tuple[str, ...]] = any_of
        self.on: Final[str] = on

    def __reduce__(self) -> tuple[type["Trigger"], tuple[tuple[str, ...], str]]:
        return Trigger, (self.any_of, self.on)


@final
class Activation:
    """One activation. Times in ns on the loop's clock.

    injector, index: name, and number of the activation from 0; signal: "node.name", for whole frames the target's name;
    cause: "event", "trigger:<name>" or "command"; due_ns: the time drawn, given, triggered or commanded;
    start_ns: when the window opened, later than due_ns only when the fault had to wait for a value;
    duration_ns: as drawn or given, NEVER for no limit;
    end_ns: first instant outside the window, as planned until it closes; a window without limit keeps NEVER.
    frames_seen: target frames that reached it; frames_unfit: of those, too short to act on; frames_injected: acted on
    (a drop that spares a frame does not act on it); frames_changed: of those, changed or lost; saturated: values cut at
    the signal's range; first_before, first_after: the first changed frame (first_after None: it was lost).
    stream: where the injector's random stream stood before the fault began (`rng_state`), and after a "/" once the
    window was open, if something was drawn between; with it the fault's own draws can be had again.
    """

    def __init__(
        self, injector: str, index: int, signal: str, cause: str, due_ns: int, start_ns: int, duration_ns: int
    ) -> None:
        self.injector: Final[str] = injector
        self.index: Final[int] = index
        self.signal: Final[str] = signal
        self.cause: Final[str] = cause
        self.due_ns: Final[int] = due_ns
        self.start_ns: Final[int] = start_ns
        self.duration_ns: Final[int] = duration_ns
        self.end_ns: int = min(start_ns + duration_ns, NEVER)
        self.frames_seen: int = 0
        self.frames_unfit: int = 0
        self.frames_injected: int = 0
        self.frames_changed: int = 0
        self.saturated: int = 0
        self.first_before: Frame | None = None
        self.first_after: Frame | None = None
        self.stream: str = ""

    def __reduce__(
        self,
    ) -> tuple[type["Activation"], tuple[str, int, str, str, int, int, int], dict[str, object]]:
        given = (self.injector, self.index, self.signal, self.cause, self.due_ns, self.start_ns, self.duration_ns)
        return Activation, given, {name: getattr(self, name) for name in _ACTIVATION_STATE}


@final
class Injector:
    """One injector; the gateway tells it the time and shows it the frames.

    inert --start--> armed --open--> active --close--> armed, or spent (once, infinite)
    armed --open, no value yet--> waiting --open at the next frame--> active; any --stop--> spent
    any but spent --disarm--> inert; inert or spent --arm--> armed, or inert while its start has not come

    An event or trigger that comes while waiting or active is ignored. enabled False: never leaves inert until armed.
    from_power_up: its times count from power-up instead of time 0. rng: the stream of this injector alone (`stream`).
    next_ns: when it acts by itself next (event, or end of the window), NEVER for not at all; held: the last frame of
    each target COB-ID that reached it, if it had the least_bytes that the signal needs. counted: the effect ends after
    a number of frames. too_short: frames that did not hold what the fault acts on.
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
    ) -> None:
        signal = fault.signal
        if signal is not None and target.cob_ids != (signal.cob_id,):
            raise FaultError(
                f"injector {name}: target COB-IDs {[hex(i) for i in target.cob_ids]} given for signal "
                f"{signal.node}.{signal.name}, allowed is {[hex(signal.cob_id)]}, where it lies"
            )
        self.name: Final[str] = name
        self.target: Final[Target] = target
        self.trigger: Final[Trigger | None] = trigger
        self.enabled: bool = enabled
        self.from_power_up: Final[bool] = from_power_up
        self.counted: Final[bool] = effect.frames > 0
        self.least_bytes: Final[int] = 0 if signal is None else (signal.start + signal.length + 7) // 8
        self.phase: Phase = INERT
        self.next_ns: int = NEVER
        self.held: dict[int, Frame] = {}
        self.activated: int = 0
        self.injected: int = 0
        self.manifested: int = 0
        self.too_short: int = 0
        self._signal: Final[str] = target.name if signal is None else f"{signal.node}.{signal.name}"
        self._fault: Final[Fault] = fault
        self._event: Final[Event] = event
        self._effect: Final[Effect] = effect
        self._rng: Final[Generator] = rng
        self._base_ns: int = NEVER
        self._cause: str = ""
        self._due_ns: int = NEVER
        self._left: int = 0
        self._current: Activation | None = None

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
        if self.phase is not SPENT:
            self.phase, self.next_ns = INERT, NEVER

    def open(self, now: int, cause: str) -> Activation | None:
        """Open the window at `now`; None when the fault has to wait. For a waiting one the first cause stays."""
        if self.phase is not WAITING:
            self._cause, self._due_ns = cause, now
        start_ns = now if now > self._due_ns else self._due_ns  # a frame stamped before a command, read after it
        stood = state_of(self._rng)
        if not self._fault.begin(start_ns, self.held, self._rng):
            self.phase, self.next_ns = WAITING, NEVER
            return None
        opened = Activation(
            self.name, self.activated, self._signal, self._cause, self._due_ns, start_ns, self._effect.duration()
        )
        stands = state_of(self._rng)
        opened.stream = stood if stands == stood else f"{stood}/{stands}"
        self.phase, self.next_ns, self._current = ACTIVE, opened.end_ns, opened
        self.activated += 1
        self._left = self._effect.frames
        return opened

    def act(self, now: int, frame: Frame) -> Frame | None:
        """What becomes of a target frame that arrives at `now` while active; None: lost."""
        current = self._current
        if current is None or now < current.start_ns:  # stamped before the window, read after it opened
            return frame
        current.frames_seen += 1
        if not self._fault.fits(frame):
            current.frames_unfit += 1
            self.too_short += 1
            return frame
        result = self._fault.apply(now, frame)
        if not (result is frame and self._fault.spares):
            self.injected += 1
            current.frames_injected += 1
        if result is not frame and result != frame:
            self.manifested += 1
            if current.frames_changed == 0:
                current.first_before, current.first_after = frame, result
            current.frames_changed += 1
        if self._left:
            self._left -= 1
            if self._left == 0:
                self.close(now + 1)
        return result

    def close(self, end_ns: int) -> None:
        """The window ends; `end_ns` is the first instant outside it."""
        current = self._current
        if current is None:
            return
        self._fault.end()
        current.end_ns = end_ns
        current.saturated = self._fault.saturated
        self._current = None
        if self._effect.rearms:
            self._arm(self._event.next(end_ns - self._base_ns))
        else:
            self.phase, self.next_ns = SPENT, NEVER

    def stop(self, now: int) -> None:
        """No more injection; an open window ends at `now`, one without limit keeps its end NEVER."""
        current = self._current
        self.close(now)
        if current is not None and current.duration_ns >= NEVER and self._effect.frames == 0:
            current.end_ns = NEVER
        self.phase, self.next_ns = SPENT, NEVER

    def __reduce__(self) -> tuple[type["Injector"], tuple[object, ...], dict[str, object]]:
        given = (self.name, self.target, self._fault, self._event, self._effect, self.trigger, self._rng)
        state = {name: getattr(self, name) for name in _INJECTOR_STATE}
        return Injector, (*given, self.enabled, self.from_power_up), state

    def _arm(self, relative_ns: int) -> None:
        self.phase = ARMED
        self.next_ns = NEVER if relative_ns >= NEVER else min(self._base_ns + relative_ns, NEVER)


def graph_order(injectors: list[Injector]) -> list[Injector]:
    """The injectors with every trigger's source before those it starts, otherwise as written.

    Raises FaultError for a name that is there twice, a trigger that names no injector, and a cycle (printed).
    """
    by_name: dict[str, Injector] = {}
    for injector in injectors:
        if injector.name in by_name:
            raise FaultError(f"injector {injector.name}: the name is given twice, every injector needs its own")
        by_name[injector.name] = injector
    order: list[Injector] = []
    for injector in injectors:
        _visit(injector, by_name, order, [])
    return order


def _visit(injector: Injector, by_name: dict[str, Injector], order: list[Injector], path: list[str]) -> None:
    """Append what starts `injector`, then itself. path: the injectors that wait for this one."""
    if injector.name in path:
        cycle = [*path[path.index(injector.name) :], injector.name]
        cycle.reverse()
        raise FaultError(f"injector {injector.name}: its trigger leads back to itself: {' -> '.join(cycle)}")
    if injector in order:
        return
    path.append(injector.name)
    for name in injector.trigger.any_of if injector.trigger is not None else ():
        if name not in by_name:
            raise FaultError(
                f"injector {injector.name}: trigger names {name!r}, allowed are {', '.join(sorted(by_name))}"
            )
        _visit(by_name[name], by_name, order, path)
    path.pop()
    order.append(injector)


def stream(seed: int, run: int, name: str) -> Generator:
    """The random stream of one injector in one run: another injector more or less changes none."""
    return Generator(PCG64(SeedSequence(seed, spawn_key=(run, zlib.crc32(name.encode())))))
