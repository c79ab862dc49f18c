"""The `injectors:` part of a scenario: read, checked against the rig, said in words, and built.

Sources: the terms are FIBlock's (Fabarisov et al., ESREL 2020): fault (type), event (when), effect (how long), trigger.
Left out: triggers with `all`, on manifested or ended, with delay or probability; `rearm`, `max_activations`.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Annotated, ClassVar, Literal

from numpy.random import Generator
from pydantic import Field

from canopen_exo.plan import BusPlan
from fi_gateway.boundary import Flag, Later, SpecError, SpecModel, Text, validate
from fi_gateway.errors import FaultError
from fi_gateway.fault_specs import FaultChoice, FaultSpec
from fi_gateway.injector import Injector, Target, Trigger, stream
from fi_gateway.marked_yaml import Data, Keys, did_you_mean, dotted
from fi_gateway.quantity import format_duration
from fi_gateway.replay import RecordedEffect, RecordedEvent, Recording, Window
from fi_gateway.target import Place, TargetSpec, resolve
from fi_gateway.timing_specs import EffectChoice, EventChoice


@dataclass(frozen=True, slots=True)
class TriggerSpec(SpecModel):
    """`trigger:` of an injector: it also starts when any of the named ones activates."""

    later: ClassVar[tuple[str, ...]] = ("all", "edge", "delay", "probability")

    any: Annotated[tuple[Text, ...], Field(min_length=1)]
    on: Annotated[Literal["activated"], Later(("manifested", "ended"))] = "activated"


@dataclass(frozen=True, slots=True)
class InjectorSpec(SpecModel):
    """One injector. start: its times count from time 0 of the motion, or from power-up (key `from`)."""

    later: ClassVar[tuple[str, ...]] = ("rearm", "max_activations")

    target: TargetSpec
    fault: FaultChoice
    event: EventChoice
    effect: EffectChoice
    trigger: TriggerSpec | None = None
    enabled: Flag = True
    start: Annotated[Literal["time_zero", "power_up"], Field(alias="from")] = "time_zero"


Report = Callable[[Keys, str], None]
"""Takes a complaint: where, counted from `injectors`, and what."""


@dataclass(frozen=True, slots=True)
class _Parts(SpecModel):
    """What of an injector can be checked against the rest of the file; None: not there, or not readable."""

    target: TargetSpec | None = None
    fault: FaultChoice | None = None
    trigger: TriggerSpec | None = None


def check_injectors(injectors: Mapping[str, Data], plan: BusPlan, report: Report) -> None:
    """Report what cannot work in injectors as read from a file, also where only parts of them can be read.

    What cannot be read is not reported: that is done by whoever reads them whole.
    """
    parts = {}
    for name, given in injectors.items():
        found = given if isinstance(given, dict) else {}
        read = [validate(_Parts, {key: found.get(key)}, (), None) or _Parts() for key in ("target", "fault", "trigger")]
        parts[name] = _Parts(read[0].target, read[1].fault, read[2].trigger)
    _check(parts, plan, report)


def _check(parts: Mapping[str, _Parts], plan: BusPlan, report: Report) -> None:
    triggers = {name: part.trigger.any for name, part in parts.items() if part.trigger is not None}
    for name, part in parts.items():
        if part.target is not None:
            _check_place(name, part.target, part.fault, plan, report)
    for name, sources in triggers.items():
        for number, source in enumerate(sources):
            if source not in parts:
                text = f"no injector is called {source!r}{did_you_mean(source, parts)} (there are {', '.join(parts)})"
                report((name, "trigger", "any", number), text)
            elif source in sources[:number]:
                report((name, "trigger", "any", number), f"{source!r} is named twice")
    for cycle in _cycles(triggers):
        report((cycle[0], "trigger", "any"), f"triggers go round in a circle: {' -> '.join((*cycle, cycle[0]))}")


def _check_place(name: str, target: TargetSpec, fault: FaultSpec | None, plan: BusPlan, report: Report) -> None:
    try:
        place = resolve(target, plan)
    except SpecError as error:
        report((name, "target", *error.keys), str(error))
        return
    try:
        if fault is not None:
            fault.build(place)
    except SpecError as error:
        report((name, "fault", *error.keys), str(error))


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


def injector_warnings(specs: Mapping[str, InjectorSpec], plan: BusPlan, duration_ns: int) -> list[str]:
    """What is allowed and still looks like a mistake: injectors that can never act in a motion of that length [ns]."""
    warnings = []
    live = _live(specs, duration_ns)
    for name, spec in specs.items():
        if not spec.enabled:
            continue
        late = [format_duration(time) for time in spec.event.times() if time >= duration_ns]
        if late and spec.start == "time_zero":
            end = format_duration(duration_ns)
            warnings.append(f"injectors.{name}.event: {', '.join(late)} comes after the motion has ended at {end}")
        elif name not in live:
            reason = "its event never happens and " + (
                "nothing that triggers it can start" if spec.trigger is not None else "it has no trigger"
            )
            warnings.append(f"injectors.{name}: will stay silent: {reason}")
        if not resolve(spec.target, plan).known:
            warnings.append(f"injectors.{name}.target.cob_id: nothing in this rig sends {spec.target.cob_id:#x}")
    return warnings


def _live(specs: Mapping[str, InjectorSpec], duration_ns: int) -> set[str]:
    """The injectors that can start, by their event or by a chain of triggers."""
    live: set[str] = set()
    for name, spec in specs.items():
        times = spec.event.times()
        late = len(times) > 0 and times[0] >= duration_ns and spec.start == "time_zero"
        if spec.enabled and spec.event.fires() and not late:
            live.add(name)
    for _ in specs:
        for name, spec in specs.items():
            if spec.enabled and spec.trigger is not None and not live.isdisjoint(spec.trigger.any):
                live.add(name)
    return live


def describe_injectors(specs: Mapping[str, InjectorSpec], plan: BusPlan, duration_ns: int) -> list[str]:
    """One sentence per injector, for a motion of that length [ns]."""
    return [_sentence(name, spec, plan, duration_ns) for name, spec in specs.items()]


def _sentence(name: str, spec: InjectorSpec, plan: BusPlan, duration_ns: int) -> str:
    place = resolve(spec.target, plan)
    starts = []
    event = spec.event.words(plan, spec.effect, duration_ns)
    if event:
        starts.append(event + (" after power-up" if spec.start == "power_up" else ""))
    if spec.trigger is not None:
        starts.append(f"when {' or '.join(spec.trigger.any)} is activated")
    when = f"starts {', and '.join(starts)}" if starts else "never starts"
    off = "" if spec.enabled else " (switched off)"
    return f"{name}{off}: {place.words} {spec.fault.words(place)} {spec.effect.words()}; {when}"


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
    parts = {name: _Parts(spec.target, spec.fault, spec.trigger) for name, spec in specs.items()}
    _check(parts, plan, lambda keys, text: problems.append(f"{dotted(('injectors', *keys))}: {text}"))
    if problems:
        raise FaultError("\n".join(problems))
    if recorded is None:
        return [_build(name, spec, plan, stream(seed, run, name)) for name, spec in specs.items()]
    return [_replay(name, spec, plan, stream(seed, run, name), recorded.get(name, ())) for name, spec in specs.items()]


def _build(name: str, spec: InjectorSpec, plan: BusPlan, rng: Generator) -> Injector:
    place = resolve(spec.target, plan)
    return Injector(
        name,
        _target(place),
        spec.fault.build(place),
        spec.event.build(plan, rng),
        spec.effect.build(),
        Trigger(spec.trigger.any, spec.trigger.on) if spec.trigger is not None else None,
        rng,
        spec.enabled,
        spec.start == "power_up",
    )


def _replay(name: str, spec: InjectorSpec, plan: BusPlan, rng: Generator, windows: tuple[Window, ...]) -> Injector:
    place, recording = resolve(spec.target, plan), Recording(windows, rng)
    return Injector(
        name,
        _target(place),
        spec.fault.build(place),
        RecordedEvent(recording),
        RecordedEffect(recording, spec.effect.build().frames),
        None,
        rng,
        from_power_up=spec.start == "power_up",
    )


def _target(place: Place) -> Target:
    return Target(place.to_controller, place.to_drives, place.cob_ids, place.name)
