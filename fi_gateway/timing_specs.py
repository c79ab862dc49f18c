"""How event and effect of an injector work out together in a motion: what `exo-hil check` says, and warns of.

The number of activations is found by playing the engine's own event and effect through many motions, with a generator
of a fixed seed, so that the dead time of each activation and the end of the motion are in it; frames are taken to come
at their mean distance. There are enough motions for a standard error of 1 % or so of the number.
Left out: triggers, and conditions, which only the run itself can tell.
"""

from dataclasses import dataclass
from typing import Final

from numpy.random import PCG64, Generator

from canopen_exo.plan import HEARTBEAT, HLC_STATUS, STATUS_EVERY, SYNC, BusPlan
from fi_gateway.effect_specs import ConstantTimeSpec, EffectChoice, EffectSpec
from fi_gateway.event_specs import EventChoice, EventSpec
from fi_gateway.events import Never
from fi_gateway.quantity import format_duration
from fi_gateway.target import Place

__all__ = ["EffectChoice", "EventChoice", "Timing"]

_SEED: Final = 1
_ACTIVATIONS: Final = 10_000
_MOTIONS: Final = 10_000
"""Played until there are as many activations, or motions."""

_RARE: Final = 0.01
"""An event that comes in fewer of the motions is warned of."""


@dataclass(frozen=True, slots=True)
class Forecast:
    """activations: mean number in a motion, None when their lengths are not known; share: of the motions with any."""

    activations: float | None
    share: float


@dataclass(frozen=True, slots=True)
class Timing:
    """Event and effect of one injector. rearm: as the injector has it, None for as the effect has it;
    max_activations: 0 for no limit; stride_ns: of the gait, 0 when not known.
    """

    event: EventSpec
    effect: EffectSpec
    rearm: bool | None = None
    max_activations: int = 0
    stride_ns: int = 0

    def forecast(self, plan: BusPlan, cob_ids: tuple[int, ...], duration_ns: int) -> Forecast | None:
        """What its event brings in motions of that length; None when nobody can tell. cob_ids: of the target."""
        frame_ns = frame_distance(plan, cob_ids)
        rng = Generator(PCG64(_SEED))
        activations, motions, hit = 0, 0, 0
        while activations < _ACTIVATIONS and motions < _MOTIONS:
            count = self._play(plan, rng, frame_ns, duration_ns)
            if count is None:
                return None
            motions += 1
            activations += count
            hit += count > 0
        known = self.effect.stand_in(plan, rng, frame_ns) is not None
        return Forecast(activations / motions if known else None, hit / motions)

    def _play(self, plan: BusPlan, rng: Generator, frame_ns: int, duration_ns: int) -> int | None:
        """The activations in one motion, up to one whose length is not known; None for an event that is not known."""
        event = self.event.stand_in(plan, rng, frame_ns, self.stride_ns)
        effect = self.effect.stand_in(plan, rng, frame_ns)
        if event is None:
            return None
        count, time = 0, event.first()
        end_ns = duration_ns + 1 if self.event.counts_frames() else duration_ns  # a last frame comes before the end
        while time < end_ns:
            count += 1
            if effect is None or count == self.max_activations or not self._rearms(effect.rearms):
                break
            if count == _ACTIVATIONS:
                return max(count, count * duration_ns // max(1, time))
            length = effect.duration() if effect.frames == 0 else max(1, frame_ns)
            time = event.next(time + length)
        return count

    def _rearms(self, usual: bool) -> bool:
        return usual if self.rearm is None else self.rearm

    def words(self, name: str, place: Place, plan: BusPlan, duration_ns: int) -> str:
        """When, in a motion of that length: "at 3 s"; "" when its event never comes of itself."""
        text = self.event.words(plan)
        if not text or self.event.times():
            return text
        if self.event.silent(plan):
            return f"{text}: never"
        found = self.forecast(plan, place.cob_ids, duration_ns)
        if found is None:
            return text
        motion = format_duration(duration_ns)
        if found.activations is None or found.activations == found.share or found.share < 0.5:
            share = f"{100 * found.share:.0f} %" if found.share >= _RARE else f"fewer than {100 * _RARE:.0f} %"
            return f"{text}, activated in {share} of the runs of {motion}"
        number = f"{found.activations:.1f}" if found.activations < 10 else f"{found.activations:.0f}"
        return f"{text}, about {number} activations of {name} expected in {motion}, dead time included"

    def warnings(self, place: Place, plan: BusPlan, duration_ns: int) -> list[tuple[str, str]]:
        """(key, what looks like a mistake), for times that count from time 0 of a motion of that length."""
        found = []
        end = format_duration(duration_ns)
        late = [format_duration(time) for time in self.event.times() if time >= duration_ns]
        if late:
            found.append(("event", f"{', '.join(late)} comes after the motion has ended at {end}"))
        elif not self.event.silent(plan) and not self.event.times():
            forecast = self.forecast(plan, place.cob_ids, duration_ns)
            if forecast is not None and forecast.share < _RARE:
                found.append(("event", f"comes in fewer than {100 * _RARE:.0f} % of the runs of {end}"))
        doubts = self.effect.doubts(plan) or self._misses(place, plan)
        if doubts:
            found.append(("effect", doubts))
        return found

    def _misses(self, place: Place, plan: BusPlan) -> str:
        """Why a window that opens at any time may meet no frame; "" when it meets one, or opens with one."""
        distance_ns = frame_distance(plan, place.cob_ids)
        if not isinstance(self.effect, ConstantTimeSpec) or self.effect.duration_ns >= distance_ns:
            return ""
        event = self.event.build(plan, Generator(PCG64(_SEED)))
        if event.watches or event.watches_target or isinstance(event, Never):
            return ""
        lasts, apart = format_duration(self.effect.duration_ns), format_duration(distance_ns)
        return f"{lasts} is less than the {apart} between two frames of the target, so that a window may meet none"


def frame_distance(plan: BusPlan, cob_ids: tuple[int, ...]) -> int:
    """Mean distance of the frames with these COB-IDs in steady motion [ns], 0 when the plan does not know."""
    sync = 1e9 / plan.cycle_ns
    rates = {SYNC: sync, HLC_STATUS: sync / STATUS_EVERY}
    for joint in plan.joints:
        rates[HEARTBEAT + joint.node_id] = 1e9 / plan.heartbeat_ns
        for pdo in plan.pdos:
            rates[pdo.base + joint.node_id] = sync / pdo.every
    total = sum(rates.get(cob_id, 0.0) for cob_id in set(cob_ids))
    return round(1e9 / total) if total else 0
