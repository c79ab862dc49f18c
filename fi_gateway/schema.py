"""The `injectors:` part of a scenario: read, checked against the rig, said in words, and built.

Sources: the terms are FIBlock's (Fabarisov et al., ESREL 2020): fault (type), event (when), effect (how long), trigger.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Annotated, Final, Literal

from numpy.random import Generator
from pydantic import Field

from canopen_exo.plan import HLC_STATUS, BusPlan
from fi_gateway.boundary import Count, Flag, SpecError, SpecModel, Text, tag, validate
from fi_gateway.chain import draw_chains
from fi_gateway.effect_specs import InfiniteSpec
from fi_gateway.errors import FaultError
from fi_gateway.events import FROM_CONTROLLER
from fi_gateway.fault_specs import FAULTS, FaultChoice, FaultSpec, WireFaultSpec
from fi_gateway.injector import Injector, Target, stream
from fi_gateway.marked_yaml import Data, Keys, did_you_mean, dotted
from fi_gateway.repair import Repair
from fi_gateway.replay import RecordedEffect, RecordedEvent, Recording, Window
from fi_gateway.target import Place, TargetSpec, resolve, resolve_wire
from fi_gateway.timing_specs import EffectChoice, EventChoice, Timing
from fi_gateway.trigger import Report
from fi_gateway.trigger_specs import RepairSpec, ReportSpec, TriggerSpec
from fi_gateway.unplaced import complaint, meant

WIRE_NEEDS: Final = "a run in virtual time (`exo-hil run`) can, and noise `exo-hil hub --timed --errors`"
"""Who can do wire faults."""


@dataclass(frozen=True, slots=True)
class InjectorSpec(SpecModel):
    """One injector. start: its times count from time 0 of the motion, or from power-up (key `from`).

    rearm: whether it waits again after a window, by default as the effect says; max_activations: then it is spent.
    """

    target: TargetSpec
    fault: FaultChoice
    event: EventChoice
    effect: EffectChoice
    trigger: TriggerSpec | None = None
    enabled: Flag = True
    start: Annotated[Literal["time_zero", "power_up"], Field(alias="from")] = "time_zero"
    rearm: Flag | None = None
    max_activations: Count | None = None
    repair: RepairSpec | None = None
    report: ReportSpec | None = None

    def __post_init__(self) -> None:
        """The keys about the number of windows agree; raises ValueError."""
        text = _windows_text(self.effect, self.rearm, self.max_activations)
        if text:
            raise ValueError(text)

    def rearms(self) -> bool | None:
        """As the engine takes it; None: as the effect says."""
        return True if self.rearm is None and (self.max_activations or 0) > 1 else self.rearm

    def place(self, plan: BusPlan) -> Place:
        """Where the fault acts; raises SpecError."""
        return _place(self.target, self.fault, plan)

    def timing(self, stride_ns: int = 0) -> Timing:
        """Event and effect together. stride_ns: of the gait, 0 when not known."""
        return Timing(self.event, self.effect, self.rearms(), self.max_activations or 0, stride_ns)


def _windows_text(effect: EffectChoice | None, rearm: bool | None, most: int | None) -> str:
    """What is wrong with the number of windows, "" for nothing. effect: None when it cannot be read."""
    if rearm is False and most is not None and most > 1:
        return f"rearm: false allows one activation, max_activations {most}; leave one of them out"
    if rearm is True and most == 1:
        return "max_activations: 1 leaves nothing to rearm for; leave one of them out"
    if isinstance(effect, InfiniteSpec) and (rearm or (most is not None and most > 1)):
        return "an infinite effect never ends, so that nothing comes after it; give another effect"
    return ""


Complain = Callable[[Keys, str], None]
"""Takes a complaint: where, counted from `injectors`, and what."""


@dataclass(frozen=True, slots=True)
class _Parts(SpecModel):
    """What of an injector can be checked against the rest of the file; None: not there, or not readable.

    meant: what can be read of a target that cannot be read as a whole; word: the type of the fault as written.
    """

    target: TargetSpec | None = None
    fault: FaultChoice | None = None
    trigger: TriggerSpec | None = None
    repair: RepairSpec | None = None
    event: EventChoice | None = None
    effect: EffectChoice | None = None
    rearm: Flag | None = None
    max_activations: Count | None = None
    meant: TargetSpec | None = None
    word: Text | None = None


def check_injectors(injectors: Mapping[str, Data], plan: BusPlan, report: Complain) -> None:
    """Report what cannot work in injectors as read from a file, also where only parts of them can be read.

    What cannot be read is not reported: that is done by whoever reads them whole.
    """
    parts = {}
    for name, given in injectors.items():
        found = given if isinstance(given, dict) else {}
        known = _readable(_Parts, found)
        if "target" not in known:
            known["meant"] = _readable(TargetSpec, found.get("target"))
        sources = _readable(TriggerSpec, found.get("trigger"), ("any", "all"))
        if "trigger" not in known and len(sources) == 1:
            known["trigger"] = sources
        fault = found.get("fault")
        word = fault.get("type") if isinstance(fault, dict) else None
        if isinstance(word, str):
            known["word"] = word
        parts[name] = validate(_Parts, known, (), None) or _Parts()
    _check(parts, plan, report)


def _readable(model: type[SpecModel], given: Data, keys: tuple[str, ...] = ()) -> dict[str, Data]:
    """Those keys of a mapping that can be read each by itself; keys: which, () for all."""
    found = given if isinstance(given, dict) else {}
    return {
        key: value
        for key, value in found.items()
        if (not keys or key in keys) and validate(model, {key: value}, (), None) is not None
    }


def _check(parts: Mapping[str, _Parts], plan: BusPlan, report: Complain) -> None:
    triggers = {name: part.trigger for name, part in parts.items() if part.trigger is not None}
    for name, part in parts.items():
        if part.target is not None:
            _check_place(name, part.target, part, plan, report)
        elif part.meant is not None:
            _check_unplaced(name, part.meant, part, plan, report)
        for key, timed in (("event", part.event), ("effect", part.effect)):
            if timed is not None:
                _check_timed(name, key, timed, plan, report)
        windows = _windows_text(part.effect, part.rearm, part.max_activations)
        if windows:
            report((name,), windows)
    for name, trigger in triggers.items():
        sources = trigger.sources
        for number, source in enumerate(sources):
            if source not in parts:
                text = f"no injector is called {source!r}{did_you_mean(source, parts)} (there are {', '.join(parts)})"
                report((name, "trigger", trigger.key, number), text)
            elif source in sources[:number]:
                report((name, "trigger", trigger.key, number), f"{source!r} is named twice")
    for cycle in _cycles({name: trigger.sources for name, trigger in triggers.items()}):
        keys = (cycle[0], "trigger", triggers[cycle[0]].key)
        report(keys, f"triggers go round in a circle: {' -> '.join((*cycle, cycle[0]))}")


def _check_place(name: str, target: TargetSpec, part: _Parts, plan: BusPlan, report: Complain) -> None:
    try:
        place = _place(target, part.fault, plan, part.word)
    except SpecError as error:
        report((name, "target", *error.keys), str(error))
        _check_unplaced(name, target, part, plan, report)
        return
    repair = part.repair
    if place.wire and repair is not None:
        report((name, "repair"), "a wire fault changes no payload: there is nothing to repair; leave repair out")
        repair = None
    if place.wire and not place.cob_ids and part.event is not None:
        _check_wire_event(name, part.event, plan, report)
    for key, spec in (("fault", part.fault), ("repair", repair)):
        try:
            if spec is not None:
                spec.build(place)
        except FaultError as error:
            report((name, key, *_keys(error)), str(error))


def _check_unplaced(name: str, target: TargetSpec, part: _Parts, plan: BusPlan, report: Complain) -> None:
    """What is wrong beside a wrong target, whatever was meant by that."""
    if isinstance(part.fault, WireFaultSpec) or target.wire is not None:
        return
    places = meant(target, plan)
    for key, spec in (("fault", part.fault), ("repair", part.repair)):
        error = complaint(spec, places) if spec is not None else None
        if error is not None:
            report((name, key, *_keys(error)), str(error))


def _check_wire_event(name: str, event: EventChoice, plan: BusPlan, report: Complain) -> None:
    try:
        if event.build(plan, stream(0, 0, name)).watches_target:
            text = "counts target frames as they pass the gateway; name some in the target, by pdo, kind or cob_id"
            report((name, "event"), text)
    except FaultError:
        pass  # reported where the event itself is checked


def _place(target: TargetSpec, fault: FaultSpec | None, plan: BusPlan, word: str | None = None) -> Place:
    """Of a target on a bus when the fault is one of the wire; where it is not readable, when its word or the target
    says so.
    """
    kind = FAULTS.built_in.get(word or "") if fault is None else type(fault)
    on_wire = issubclass(kind, WireFaultSpec) if kind is not None else target.wire is not None
    return resolve_wire(target, plan) if on_wire else resolve(target, plan)


def refuse_wire_faults(specs: Mapping[str, InjectorSpec], what: str) -> None:
    """Raise FaultError when there are wire faults. what: has no emulated bus, "exo-hil gateway"."""
    for name, spec in specs.items():
        if isinstance(spec.fault, WireFaultSpec):
            raise FaultError(
                f"injectors.{name}.fault: {what} cannot do {tag(type(spec.fault))}: bits, acknowledgement and error "
                f"counters are out of its reach, they are the CAN controllers' own; {WIRE_NEEDS}"
            )


def _keys(error: FaultError) -> Keys:
    """Which value is wrong; () when the engine's object of a type from elsewhere has refused it."""
    return error.keys if isinstance(error, SpecError) else ()


def _check_timed(name: str, key: str, timed: EventChoice | EffectChoice, plan: BusPlan, report: Complain) -> None:
    try:
        timed.build(plan, stream(0, 0, name))
    except FaultError as error:
        report((name, key, *_keys(error)), str(error))


def _cycles(triggers: Mapping[str, tuple[str, ...]]) -> list[tuple[str, ...]]:
    """Each circle of triggers once, in the direction of cause, from its first injector as written.

    triggers: injector -> those that start it.
    """
    found: list[tuple[str, ...]] = []
    for first in triggers:
        path = _way_back(first, triggers)
        if path and not any(set(path) == set(cycle) for cycle in found):
            found.append(path)
    return found


def _way_back(first: str, triggers: Mapping[str, tuple[str, ...]]) -> tuple[str, ...]:
    """The shortest chain of triggers from an injector back to itself; () when there is none."""
    chains: list[tuple[str, ...]] = [(first,)]
    seen: set[str] = set()
    while chains:
        chain = chains.pop(0)
        for name, sources in triggers.items():
            if chain[-1] in sources and name == first:
                return chain
            if chain[-1] in sources and name not in seen:
                seen.add(name)
                chains.append((*chain, name))
    return ()


def status_watchers(specs: Mapping[str, InjectorSpec], plan: BusPlan) -> list[str]:
    """The injectors whose event or effect reads the status frames (COB-ID 0x2FF) that our controller alone sends."""
    status, found = (FROM_CONTROLLER, HLC_STATUS), []
    for name, spec in specs.items():
        rng = stream(0, 0, name)
        if status in spec.event.build(plan, rng).watches or status in spec.effect.build(plan, rng).watches:
            found.append(name)
    return found


def describe_injectors(
    specs: Mapping[str, InjectorSpec], plan: BusPlan, duration_ns: int, stride_ns: int = 0
) -> list[str]:
    """One sentence per injector, for a motion of that length and stride [ns]; then who starts whom, drawn."""
    chains = draw_chains({name: spec.trigger for name, spec in specs.items() if spec.trigger is not None})
    lines = [_sentence(name, spec, plan, duration_ns, stride_ns) for name, spec in specs.items()]
    return [*lines, "triggers:", *(f"  {line}" for line in chains)] if chains else lines


def _sentence(name: str, spec: InjectorSpec, plan: BusPlan, duration_ns: int, stride_ns: int) -> str:
    place = spec.place(plan)
    starts = []
    event = spec.timing(stride_ns).words(name, place, plan, duration_ns)
    if event:
        starts.append(event + (" after power-up" if spec.start == "power_up" else ""))
    if spec.trigger is not None:
        starts.append(spec.trigger.words())
    when = f"starts {', and '.join(starts)}" if starts else "never starts"
    off = "" if spec.enabled else " (switched off)"
    more = "".join(f"; {part.words()}" for part in (spec.repair, spec.report) if part is not None)
    return f"{name}{off}: {place.words} {spec.fault.words(place)} {_how_long(spec)}; {when}{more}"


def _how_long(spec: InjectorSpec) -> str:
    """The effect, and how often."""
    words, most = spec.effect.words(), spec.max_activations
    if spec.rearm is None and most is None:
        return words
    often = "once a run" if spec.rearm is False or most == 1 else "again and again"
    if most is not None and most > 1:
        often = f"at most {most} times a run"
    return f"{words.removesuffix(', once a run')}, {often}"


def build_injectors(
    specs: Mapping[str, InjectorSpec],
    plan: BusPlan,
    seed: int,
    run: int,
    recorded: Mapping[str, tuple[Window, ...]] | None = None,
) -> list[Injector]:
    """The engine's injectors in written order, each with its own random stream; raises FaultError for bad specs.

    recorded: windows by injector; they then take the place of all events, effects and triggers, and of `enabled`.
    """
    problems: list[str] = []
    parts = {
        name: _Parts(spec.target, spec.fault, spec.trigger, spec.repair, spec.event, spec.effect)
        for name, spec in specs.items()
    }
    _check(parts, plan, lambda keys, text: problems.append(f"{dotted(('injectors', *keys))}: {text}"))
    if problems:
        raise FaultError("\n".join(problems))
    if recorded is None:
        return [build_injector(name, spec, plan, seed, run) for name, spec in specs.items()]
    return [_replay(name, spec, plan, stream(seed, run, name), recorded.get(name, ())) for name, spec in specs.items()]


def build_injector(name: str, spec: InjectorSpec, plan: BusPlan, seed: int, run: int) -> Injector:
    """One that has been checked together with the others, see `check_injectors`."""
    rng = stream(seed, run, name)
    place = spec.place(plan)
    return Injector(
        name,
        _target(place),
        spec.fault.build(place),
        spec.event.build(plan, rng),
        spec.effect.build(plan, rng),
        spec.trigger.build() if spec.trigger is not None else None,
        rng,
        spec.enabled,
        spec.start == "power_up",
        spec.rearms(),
        spec.max_activations or 0,
        _repair(spec, place),
        _reports(spec),
        _fault_stream(rng),
    )


def _replay(name: str, spec: InjectorSpec, plan: BusPlan, rng: Generator, windows: tuple[Window, ...]) -> Injector:
    """With the recorded windows; what it does to frames, and says about it on the bus, stays."""
    place, fault_rng = spec.place(plan), _fault_stream(rng)
    recording = Recording(windows, fault_rng)
    return Injector(
        name,
        _target(place),
        spec.fault.build(place),
        RecordedEvent(recording),
        RecordedEffect(recording, spec.effect.build(plan, rng).frames),
        None,
        rng,
        from_power_up=spec.start == "power_up",
        repair=_repair(spec, place),
        reports=_reports(spec),
        fault_rng=fault_rng,
    )


def _repair(spec: InjectorSpec, place: Place) -> Repair | None:
    return spec.repair.build(place) if spec.repair is not None else None


def _reports(spec: InjectorSpec) -> tuple[Report, ...]:
    return (spec.report.build(),) if spec.report is not None else ()


def _fault_stream(rng: Generator) -> Generator:
    """The stream of the fault, a branch of the injector's; nothing is drawn for it."""
    return rng.spawn(1)[0]


def _target(place: Place) -> Target:
    return Target(place.to_controller, place.to_drives, place.cob_ids, place.name, place.wire != "")
