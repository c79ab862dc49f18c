"""What is allowed in a file's injectors and still looks like a mistake: such as one that can never act.

Left out: what only a run can tell, such as conditions that are never true though they might be.
"""

from collections.abc import Mapping
from typing import Final

from canopen_exo.plan import NMT, SDO_ANSWER, SDO_REQUEST, BusPlan
from fi_gateway.effect_specs import InfiniteSpec
from fi_gateway.event_specs import NeverSpec
from fi_gateway.schema import InjectorSpec
from fi_gateway.target import Place
from fi_gateway.trigger_specs import RISES, TriggerSpec

_FUNCTION: Final = 0x780
"""The bits of a COB-ID that are not the node id (CiA 301, 7.3.5)."""


def injector_warnings(
    specs: Mapping[str, InjectorSpec], plan: BusPlan, duration_ns: int, by_hand: bool = False, stride_ns: int = 0
) -> list[str]:
    """About injectors in a motion of that length and stride [ns], 0 for a stride that is not known.

    by_hand: people also start and end them, and what else is on the bus is not known.
    """
    warnings = []
    live = _live(specs, plan, duration_ns, by_hand)
    for name, spec in specs.items():
        if not spec.enabled:
            continue
        place = spec.place(plan)
        mute = _mute(spec.trigger, specs, plan, by_hand) if spec.trigger is not None else {}
        late = [time for time in spec.event.times() if time >= duration_ns and spec.start == "time_zero"]
        if name not in live and not late and not (by_hand and isinstance(spec.event, NeverSpec)):
            silent = spec.event.silent(plan)
            reason = f"its event never happens{'' if isinstance(spec.event, NeverSpec) else f' ({silent})'} and "
            if spec.trigger is not None:
                reason += ", ".join(mute.values()) or "nothing that triggers it can start"
            else:
                reason += "it has no trigger"
            warnings.append(f"injectors.{name}: will stay silent: {reason}")
        else:
            warnings.extend(f"injectors.{name}.trigger: {text}" for text in mute.values())
        if spec.fault.doubts():
            warnings.append(f"injectors.{name}.fault: changes nothing: {spec.fault.doubts()}")
        if _too_late(spec, place) and not by_hand:
            text = "the rig sends such frames before time 0 only; add from: power_up to meet them"
            warnings.append(f"injectors.{name}.target: {text}")
        if spec.start == "time_zero":
            for key, text in spec.timing(stride_ns).warnings(place, plan, duration_ns):
                warnings.append(f"injectors.{name}.{key}: {text}")
        if not place.known:
            cob_ids = place.name.removeprefix("frames ")
            warnings.append(f"injectors.{name}.target.cob_id: nothing in this rig sends {cob_ids}")
    return warnings


def _live(specs: Mapping[str, InjectorSpec], plan: BusPlan, duration_ns: int, by_hand: bool) -> set[str]:
    """The injectors that can start, by their event or by a chain of triggers."""
    live: set[str] = set()
    for name, spec in specs.items():
        times = spec.event.times()
        late = len(times) > 0 and times[0] >= duration_ns and spec.start == "time_zero"
        if spec.enabled and not spec.event.silent(plan) and not late:
            live.add(name)
    for _ in specs:
        for name, spec in specs.items():
            if spec.enabled and spec.trigger is not None:
                mute = _mute(spec.trigger, specs, plan, by_hand)
                if _can_trigger(spec.trigger, live.difference(mute)):
                    live.add(name)
    return live


def _can_trigger(trigger: TriggerSpec, live: set[str]) -> bool:
    if trigger.probability == 0:
        return False
    if trigger.all is not None:
        return live.issuperset(trigger.all)
    return trigger.frame is not None or not live.isdisjoint(trigger.sources)


def _mute(trigger: TriggerSpec, specs: Mapping[str, InjectorSpec], plan: BusPlan, by_hand: bool) -> dict[str, str]:
    """Why its sources, though started, never give the signal it waits for: "a never ends (its effect is infinite)"."""
    found = {}
    for source in trigger.sources:
        spec, reason = specs[source], ""
        if trigger.on == "manifested":
            reason = spec.fault.doubts()
        elif trigger.on == "ended" and not by_hand:
            reason = "its effect is infinite" if isinstance(spec.effect, InfiniteSpec) else spec.effect.doubts(plan)
        if reason:
            found[source] = f"{source} never {RISES[trigger.on]} ({reason})"
    return found


def _too_late(spec: InjectorSpec, place: Place) -> bool:
    """Whether it waits for frames of the start alone (NMT, SDO) and is itself not there before time 0."""
    starting = [cob_id == NMT or cob_id & _FUNCTION in (SDO_ANSWER, SDO_REQUEST) for cob_id in place.cob_ids]
    return spec.start == "time_zero" and place.known and spec.fault.needs_frames() and any(starting) and all(starting)
