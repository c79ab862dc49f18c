"""The windows of a gateway's injectors over time: what opens and closes at an instant, and when the next instant is.

At one instant, for each injector, those that start others first (graph order): its window ends if its time is over, its
trigger looks at what has happened, and it opens if its event, its trigger or live control says so. So a trigger without
delay opens its window on the frame that opened the other one. Circles of triggers are refused, also with delays.
"""

from typing import Final, final

from canopen_exo.bus.frame import Frame
from canopen_exo.bus.node import NEVER
from fi_gateway.activation import Activation
from fi_gateway.errors import FaultError
from fi_gateway.injector import Injector
from fi_gateway.phase import ACTIVE, ARMED, WAITING
from fi_gateway.trigger import ACTIVATED, ENDED, MANIFESTED, Report, Trigger

_LINK_STATE: Final = ("_seen", "_said", "_waiting", "_holds")
_WINDOWS_STATE: Final = (
    "records",
    "keeps_opened",
    "opened",
    "said",
    "next_ns",
    "is_waiting",
    "_links",
    "_by_number",
    "_settled_ns",
)


@final
class _Due:
    """A trigger that has fired, and opens at `at_ns`."""

    def __init__(self, at_ns: int, cause: str) -> None:
        self.at_ns: Final[int] = at_ns
        self.cause: Final[str] = cause

    def __reduce__(self) -> tuple[type["_Due"], tuple[int, str]]:
        return _Due, (self.at_ns, self.cause)


@final
class Link:
    """An injector, those that its trigger listens to, and what it has heard. fired: by live control."""

    def __init__(self, injector: Injector, sources: list[Injector]) -> None:
        self.injector: Final[Injector] = injector
        self.sources: Final[list[Injector]] = sources
        self.fired: bool = False
        self._trigger: Final[Trigger | None] = injector.trigger
        self._seen: list[int] = [0] * len(sources)
        self._said: list[int] = [0] * len(injector.reports)
        self._waiting: list[_Due] = []
        self._holds: bool = False

    def watch(self, now: int, port: int, frame: Frame) -> bool:
        """A frame has come in that event, effect or trigger look at; whether something happens with it."""
        happens = self.injector.observe(now, port, frame)
        trigger = self._trigger
        if trigger is not None and trigger.frame is not None and frame.can_id == trigger.frame.cob_id:
            pattern = trigger.frame
            if (pattern.to_controller if port else pattern.to_drives) and pattern.matches(frame):
                self._fire(now, trigger, f"frame:0x{frame.can_id:03X}")
                happens = True
        return happens

    def look(self, now: int) -> None:
        """See which of the sources' signals have risen, and which hold."""
        trigger = self._trigger
        if trigger is None or not self.sources:
            return
        rose = ""
        holding = 0
        for at, source in enumerate(self.sources):
            count = _count(source, trigger.on, now)
            if count != self._seen[at]:
                self._seen[at] = count
                rose = rose or source.name
            if _holds(source, trigger.on, now):
                holding += 1
        holds = holding == len(self.sources) if trigger.all_of else holding > 0
        cause = f"trigger:{'+'.join(trigger.all_of) if trigger.all_of else rose}"
        if not trigger.level:
            if rose and (holds or not trigger.all_of):
                self._fire(now, trigger, cause)
        elif not holds:
            self._holds, self._waiting = False, []
        elif not self._holds:
            self._holds = True
            self._fire(now, trigger, cause)

    def due(self, now: int) -> str:
        """Why the trigger opens the window at `now`, "" for nothing."""
        for one in self._waiting:
            if one.at_ns <= now:
                return one.cause
        return ""

    def forget(self, now: int) -> None:
        """What was due up to `now` is over, whether it was used or not; a level stays."""
        if self._waiting and self._trigger is not None and not self._trigger.level:
            self._waiting = [one for one in self._waiting if one.at_ns > now]

    def say(self, now: int, said: list[Report]) -> None:
        """Append the reports of the signals that have risen."""
        for at, report in enumerate(self.injector.reports):
            count = _count(self.injector, report.on, now)
            while self._said[at] < count:
                self._said[at] += 1
                said.append(report)

    def next_ns(self, settled_ns: int) -> int:
        """When there is something to do after `settled_ns`: of injector, fault and trigger, and of what has ended."""
        injector = self.injector
        first = injector.next_ns if injector.next_ns < injector.wake_ns else injector.wake_ns
        for one in self._waiting:
            if settled_ns < one.at_ns < first:
                first = one.at_ns
        if settled_ns < injector.end_ns < first:
            first = injector.end_ns
        return first

    def _fire(self, now: int, trigger: Trigger, cause: str) -> None:
        """The condition has come true at `now`."""
        if trigger.probability >= 1.0 or self.injector.draw() < trigger.probability:
            self._waiting.append(_Due(min(now + trigger.delay_ns, NEVER), cause))

    def __reduce__(self) -> tuple[type["Link"], tuple[Injector, list[Injector]], dict[str, object]]:
        return Link, (self.injector, self.sources), {name: getattr(self, name) for name in _LINK_STATE}


@final
class Windows:
    """All windows of a gateway. injectors: in written order.

    records: the activations so far, as they opened; opened: those that live control was not told yet, kept when
    `keeps_opened`; said: reports not sent yet; next_ns: when there is something to do, NEVER for nothing; is_waiting:
    an injector waits for a frame.
    """

    def __init__(self, injectors: list[Injector]) -> None:
        self.records: list[Activation] = []
        self.keeps_opened: bool = False
        self.opened: list[Activation] = []
        self.said: list[Report] = []
        self.next_ns: int = NEVER
        self.is_waiting: bool = False
        self._links: list[Link] = []
        self._by_number: list[Link] = []
        self._settled_ns: int = -NEVER
        self.extend(injectors)

    def extend(self, injectors: list[Injector]) -> None:
        """All injectors in written order, new ones behind those there are. Raises FaultError, having done nothing."""
        order = graph_order(injectors)
        known = {link.injector.name: link for link in self._links}
        by_name = {injector.name: injector for injector in injectors}
        links: list[Link] = []
        for injector in order:
            names = injector.trigger.sources if injector.trigger is not None else ()
            links.append(known.get(injector.name) or Link(injector, [by_name[name] for name in names]))
        self._links = links
        self._by_number = []
        for number, injector in enumerate(injectors):
            injector.number = number
            for link in links:
                if link.injector is injector:
                    self._by_number.append(link)

    def link(self, number: int) -> Link:
        """Of the injector with that number."""
        return self._by_number[number]

    def fire(self, injector: Injector, now: int) -> None:
        """Live control: open the window of an armed injector, with all that it triggers."""
        link = self._by_number[injector.number]
        link.fired = True
        self.settle(now, [])
        link.fired = False

    def settle(self, now: int, arriving: list[Injector], met: Injector | None = None) -> None:
        """Close and open what is due at `now`.

        arriving: the injectors that the frame of this instant will reach; met: the one that it has just reached.
        """
        self._settled_ns = now
        for link in self._links:
            injector = link.injector
            if injector.phase is ACTIVE and injector.next_ns <= now:
                injector.close(injector.next_ns)
            link.look(now)
            cause = ""
            if injector.phase is ARMED:
                cause = "event" if injector.next_ns <= now else "command" if link.fired else link.due(now)
            elif injector.phase is WAITING and injector in arriving:
                cause = "frame"
            link.forget(now)
            if cause:
                opened = injector.open(now, cause, injector is met)
                if opened is not None:
                    self.records.append(opened)
                    if self.keeps_opened:
                        self.opened.append(opened)
            if injector.reports:
                link.say(now, self.said)

    def plan(self) -> None:
        """Note when something is due next, and whether an injector waits for a frame."""
        self.next_ns = NEVER
        self.is_waiting = False
        for link in self._links:
            first = link.next_ns(self._settled_ns)
            if first < self.next_ns:
                self.next_ns = first
            if link.injector.phase is WAITING:
                self.is_waiting = True

    def __reduce__(self) -> tuple[type["Windows"], tuple[list[Injector]], dict[str, object]]:
        injectors = [link.injector for link in self._by_number]
        return Windows, (injectors,), {name: getattr(self, name) for name in _WINDOWS_STATE}


def _count(source: Injector, on: str, now: int) -> int:
    """How often the signal has risen up to and including `now`."""
    if on == ACTIVATED:
        return source.activated
    if on == MANIFESTED:
        return source.manifested_windows
    return source.ended if source.end_ns <= now else source.ended - 1


def _holds(source: Injector, on: str, now: int) -> bool:
    """Whether the signal holds at `now`."""
    if on == ACTIVATED:
        return source.phase is ACTIVE
    if on == MANIFESTED:
        return source.has_manifested
    return source.phase is not ACTIVE and _count(source, ENDED, now) > 0


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
    for name in injector.trigger.sources if injector.trigger is not None else ():
        if name not in by_name:
            raise FaultError(
                f"injector {injector.name}: trigger names {name!r}, allowed are {', '.join(sorted(by_name))}"
            )
        _visit(by_name[name], by_name, order, path)
    path.pop()
    order.append(injector)
