"""Live control: what people, scripts and devices may do to a running gateway, between two frames.

docs/live_control.md has the words and their exact meaning. Each call is a row, also one that is refused. A call at
`now` first settles everything that was due before; what was due while an injector was disarmed is not made up for.
A local socket (`control_socket`) and a pair of CAN frames (`bus_control`) come here; nothing else listens.
Leaves out: changing the parameters of an injector.
"""

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, final

from canopen_exo.bus.lateness import Lateness
from canopen_exo.bus.losses import Losses
from canopen_exo.bus.node import NEVER
from canopen_exo.plan import HLC_STATUS
from fi_gateway.errors import FaultError
from fi_gateway.gateway import CONTROLLER_PORT, DRIVE_PORT, Gateway
from fi_gateway.injector import Injector
from fi_gateway.phase import ACTIVE, ARMED, INERT, SPENT, WAITING

if TYPE_CHECKING:  # pydantic
    from fi_gateway.addition import Additions

ARM: Final = "arm"
DISARM: Final = "disarm"
TRIGGER: Final = "trigger"
START: Final = "start"
STOP: Final = "stop"
RESUME: Final = "resume"
ADD: Final = "add"

WORDS: Final = (ARM, DISARM, TRIGGER, START, STOP, RESUME)
NAMED: Final = (ARM, DISARM, TRIGGER)
"""The words that are about one injector; the others are about the gateway."""

CHANGES_SHOWN: Final = 16
"""Of each port, the latest; the cause is cut to the length after it."""
_CAUSE_SHOWN: Final = 160

DISARMED: Final = "disarmed"
HELD: Final = "held"


@dataclass(frozen=True, slots=True)
class ControlRow:
    """One call. time_ns: loop clock; name: the injector, "" for all; source: "call", "socket", "bus 0x6c0", "signal".

    refused: why nothing was done, "" when it was.
    """

    time_ns: int
    what: str
    name: str
    source: str
    refused: str = ""


@dataclass(frozen=True, slots=True)
class InjectorRow:
    """One line of the listing. state: a Phase's word, DISARMED, or HELD while injection is stopped.

    next_ns: when it acts by itself next (event, or end of the window), loop clock, NEVER for not at all.
    """

    name: str
    state: str
    next_ns: int
    activated: int
    injected: int
    manifested: int


@final
class LiveControl:
    """Live control of one gateway. rows: every call; stopped: nothing is injected until `resume`.

    source, in every call: where it came from. Raises FaultError for a name that there is not, naming those there are,
    and for what the injector's state does not allow, with the remedy.
    additions: reads what `add` is given; None for a gateway that takes nothing new.
    """

    def __init__(self, gateway: Gateway, additions: "Additions | None" = None) -> None:
        self.gateway: Final[Gateway] = gateway
        self._additions: Final = additions
        self.rows: Final[list[ControlRow]] = []
        self.stopped: bool = False
        self._held: Final[list[Injector]] = []

    def arm(self, name: str, now: int, source: str = "call") -> None:
        """Let the injector wait for its event and trigger, also one disabled in the file, or spent.

        While injection is stopped it is armed by `resume`; before time 0 it waits for that.
        """
        injector = self._find(name, ARM, now, source)
        self.gateway.settle(now - 1)
        if not self.stopped:
            injector.arm(now)
        elif injector not in self._held:
            self._held.append(injector)
        self._done(now, ARM, name, source)

    def disarm(self, name: str, now: int, source: str = "call") -> None:
        """Close the injector's window, if it is open, and open none until it is armed."""
        injector = self._find(name, DISARM, now, source)
        self.gateway.settle(now - 1)
        injector.disarm(now)
        if injector in self._held:
            self._held.remove(injector)
        self._done(now, DISARM, name, source)

    def trigger(self, name: str, now: int, source: str = "call") -> bool:
        """Open the window of an armed injector now, with all that it triggers.

        False: ignored, because it is active or waits for a value already (as a trigger in the file would be).
        """
        injector = self._find(name, TRIGGER, now, source)
        self.gateway.settle(now)
        if injector.phase is ACTIVE or injector.phase is WAITING:
            self.rows.append(ControlRow(now, TRIGGER, name, source, f"ignored: {injector.phase.value} already"))
            return False
        if injector.phase is not ARMED:
            raise self._refused(now, TRIGGER, name, source, self._why_not(injector))
        self.gateway.fire(injector, now)
        self._done(now, TRIGGER, name, source)
        return True

    def start(self, now: int, source: str = "call") -> None:
        """Time 0 is now, for a rig whose master does not say it on the bus. Refused when it is known already.

        And while an injector is armed that hangs on what such a master does not say either.
        """
        zero = self.gateway.time_zero
        if zero != NEVER:
            ago_s = (now - zero) / 1e9
            why = f"time 0 is known already, it was {ago_s:.3f} s ago, and does not move; restart the gateway"
            raise self._refused(now, START, "", source, why)
        for injector in self.gateway.injectors:
            if injector.enabled and (CONTROLLER_PORT, HLC_STATUS) in injector.watches():
                why = (
                    f"injector {injector.name} waits for the controller's status frames (gait_phase), and one that "
                    "sends them says time 0 itself; disarm it first"
                )
                raise self._refused(now, START, "", source, why)
        self.gateway.settle(now - 1)
        self.gateway.begin(now)
        self._done(now, START, "", source)

    def pass_through(self, now: int, source: str = "call") -> None:
        """Stop injecting: close all windows, and pass every frame on until `resume`."""
        self.gateway.settle(now - 1)
        if not self.stopped:
            self.stopped = True
            for injector in self.gateway.injectors:
                if injector.enabled and injector.phase is not SPENT:
                    injector.disarm(now)
                    self._held.append(injector)
        self._done(now, STOP, "", source)

    def resume(self, now: int, source: str = "call") -> None:
        """Inject again: arm what `pass_through` held back. A window without end that it closed is over: spent."""
        self.gateway.settle(now - 1)
        if self.stopped:
            self.stopped = False
            for injector in self._held:
                if injector.phase is SPENT:
                    injector.enabled = True
                else:
                    injector.arm(now)
            self._held.clear()
        self._done(now, RESUME, "", source)

    def add(self, name: str, given: object, now: int, source: str = "call", at_once: bool = False) -> None:
        """One more injector, behind the others, see `Gateway.add`. given: its keys, as in a scenario file."""
        try:
            if self._additions is None:
                raise FaultError("add: this gateway takes no injectors while it runs; give them in its scenario")
            if self.stopped:
                raise FaultError("add: injection is stopped; resume it first")
            self._additions.extend(self.gateway, name, given, now, at_once)
        except FaultError as error:
            self.rows.append(ControlRow(now, ADD, name, source, str(error)))
            raise
        self._done(now, ADD, name, source)

    def listing(self) -> list[InjectorRow]:
        """The injectors as they are, in written order."""
        return [
            InjectorRow(one.name, self._state(one), one.next_ns, one.activated, one.injected, one.manifested)
            for one in self.gateway.injectors
        ]

    def _state(self, injector: Injector) -> str:
        """As in the listing."""
        if injector in self._held:
            return HELD
        if not injector.enabled:
            return DISARMED
        return injector.phase.value

    def _why_not(self, injector: Injector) -> str:
        """Why an injector that is not armed cannot be triggered, and what to do."""
        if self.stopped:
            return "injection is stopped; resume it first"
        if injector.phase is INERT and injector.enabled:
            what = "the first frame" if injector.from_power_up else "time 0: the controller's status frame, or start"
            return f"it waits for {what}"
        if injector.phase is SPENT and injector.enabled:
            over = "the motion" if injector.activated == 0 else "its last window, or the motion,"
            return f"it is spent, {over} is over; arm it to let it act all the same"
        return f"it is {self._state(injector)}; arm it first"

    def _find(self, name: str, what: str, now: int, source: str) -> Injector:
        for injector in self.gateway.injectors:
            if injector.name == name:
                return injector
        known = ", ".join(injector.name for injector in self.gateway.injectors)
        why = f"no such injector; allowed: {known}" if known else "this gateway has no injectors"
        raise self._refused(now, what, name, source, why)

    def _refused(self, now: int, what: str, name: str, source: str, why: str) -> FaultError:
        """The error to raise; its row is left here."""
        self.rows.append(ControlRow(now, what, name, source, why))
        return FaultError(f"{what} {name!r}: {why}" if name else f"{what}: {why}")

    def _done(self, now: int, what: str, name: str, source: str) -> None:
        self.gateway.settle(now)
        self.rows.append(ControlRow(now, what, name, source))


def perform(control: LiveControl, word: str, name: str, now: int, source: str) -> bool:
    """Do one of WORDS; name: only for those in NAMED. False: ignored. Raises FaultError."""
    if word == TRIGGER:
        return control.trigger(name, now, source)
    if word == ARM:
        control.arm(name, now, source)
    elif word == DISARM:
        control.disarm(name, now, source)
    elif word == START:
        control.start(now, source)
    elif word == STOP:
        control.pass_through(now, source)
    elif word == RESUME:
        control.resume(now, source)
    else:
        raise FaultError(f"live control: {word!r} given, allowed: {', '.join(WORDS)}")
    return True


@dataclass(frozen=True, slots=True)
class StateChange:
    """An interface's new error state. time_ns: loop clock; state: an ErrorState's word; cause: from its driver."""

    time_ns: int
    state: str
    cause: str


@dataclass(frozen=True, slots=True)
class Direction:
    """What went one way through a gateway, in frames.

    lost, inserted: by a fault; undelivered: not offered, because the interface they were for was away; notices: error
    notices of the interface they came in on; latency: from the stamp of a frame to its sending [ns], None when not
    measured. overruns, malformed: at the interface they came in on; queue_full, discarded, not_taken: at the one they
    were for, see Losses. changes: of the state of the interface they came in on, the latest CHANGES_SHOWN.
    """

    direction: str
    frames: int
    lost: int
    inserted: int
    undelivered: int
    notices: int
    latency: Lateness | None
    queue_full: int = 0
    discarded: int = 0
    not_taken: int = 0
    overruns: int = 0
    malformed: int = 0
    changes: tuple[StateChange, ...] = ()


def statistics(
    gateway: Gateway, latency: list[Lateness] | None, losses: list[Losses] | None = None
) -> list[Direction]:
    """To the drives, then to the controller. latency, losses: by port, as the real-time loop measures them."""
    lost = losses or [Losses(), Losses()]
    return [
        Direction(
            name,
            gateway.frames[port],
            gateway.lost[port],
            gateway.inserted[port],
            gateway.undelivered[port],
            gateway.notices[port],
            None if latency is None else latency[1 - port],
            lost[1 - port].queue_full,
            lost[1 - port].discarded,
            lost[1 - port].not_taken,
            lost[port].overruns,
            lost[port].malformed,
            _changes(gateway, port),
        )
        for port, name in ((CONTROLLER_PORT, "to_drives"), (DRIVE_PORT, "to_controller"))
    ]


def _changes(gateway: Gateway, port: int) -> tuple[StateChange, ...]:
    """The latest of one port."""
    found = [one for one in gateway.port_changes if one.port == port][-CHANGES_SHOWN:]
    return tuple(StateChange(one.time_ns, one.state.value, one.cause[:_CAUSE_SHOWN]) for one in found)


def statistics_text(directions: list[Direction]) -> str:
    """One line for each direction, for people."""
    lines = []
    for one in directions:
        parts = [f"{one.direction}: {one.frames} frames, {one.lost} lost by faults"]
        if one.inserted:
            parts.append(f"{one.inserted} added")
        if one.undelivered:
            parts.append(f"{one.undelivered} not delivered")
        for count, what in (
            (one.overruns, "lost before they were read"),
            (one.malformed, "unreadable"),
            (one.queue_full, "lost in a full queue"),
            (one.discarded, "discarded in an outage"),
            (one.not_taken, "not taken by the interface"),
        ):
            if count:
                parts.append(f"{count} {what}")
        if one.notices:
            parts.append("1 error notice" if one.notices == 1 else f"{one.notices} error notices")
        late = one.latency
        if late is not None and late.count:
            median, most, worst = late.percentile(0.5) / 1e3, late.percentile(0.99) / 1e3, late.worst_ns / 1e3
            parts.append(f"added latency: median {median:.0f} us, 99 % {most:.0f} us, worst {worst:.0f} us")
        lines.append(", ".join(parts))
    return "\n".join(lines)


def changes_text(directions: list[Direction]) -> str:
    """One line for each change of an interface's state, for people, oldest first; times on the gateway's clock."""
    sides = {"to_drives": "controller side", "to_controller": "drive side"}
    found = [(change.time_ns, sides[one.direction], change) for one in directions for change in one.changes]
    return "\n".join(
        f"{side}: {change.state.replace('_', ' ')} at {time_ns / 1e9:.3f} s: {change.cause}"
        for time_ns, side, change in sorted(found, key=lambda row: row[0])
    )


def latency_text(directions: list[Direction]) -> str:
    """Histogram of the added latency, one line for each direction that has one: octaves of ns, told by upper edge."""
    lines = []
    for one in directions:
        octaves: dict[int, int] = {}
        for lower, number in one.latency.document()["bins"] if one.latency is not None else ():
            octaves[lower.bit_length()] = octaves.get(lower.bit_length(), 0) + number
        if octaves:
            parts = [f"<= {_edge_text(2**bits)}: {number}" for bits, number in sorted(octaves.items())]
            lines.append(f"{one.direction}: frames by added latency: {', '.join(parts)}")
    return "\n".join(lines)


def _edge_text(edge_ns: int) -> str:
    """An edge of the histogram, in two digits; never as a power of ten."""
    value, unit = (edge_ns / 1e3, "us") if edge_ns < 100_000 else (edge_ns / 1e6, "ms")
    return f"{float(f'{value:.2g}'):g} {unit}"


def listing_text(rows: list[InjectorRow], now: int) -> str:
    """One line for each injector, for people. now: loop clock, ns."""
    width = max((len(row.name) for row in rows), default=0)
    lines = []
    for row in rows:
        counts = f"{row.activated} activations, {row.injected} frames acted on, {row.manifested} changed"
        lines.append(f"{row.name:{width}}  {row.state:8}  {counts}{_next_text(row, now)}")
    return "\n".join(lines) or "no injectors"


def _next_text(row: InjectorRow, now: int) -> str:
    """When it acts next, or why it does not, where the state alone does not say it."""
    if row.next_ns < NEVER:
        return f"; next in {(row.next_ns - now) / 1e9:.3f} s"
    if row.state == ARMED.value:
        return "; no event to come, only a trigger or `exo-hil fault trigger` starts it"
    if row.state == SPENT.value and row.activated == 0:
        return "; the motion was over before it acted"
    return ""
