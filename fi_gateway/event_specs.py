"""Events as a scenario file gives them: one small class each.

Each reads its own keys, builds the engine's event, and says in words when. Durations are ns. Further ones come from
other packages, see `fi_gateway.kinds`.
"""

from dataclasses import dataclass
from typing import Annotated, Final, Literal, TypeAlias

from numpy.random import Generator
from pydantic import BeforeValidator, Field, PlainSerializer, WithJsonSchema

from canopen_exo.plan import BusPlan
from fi_gateway.boundary import Count, Share, Span, SpecModel, Time
from fi_gateway.condition_specs import ConditionText, resolve_condition
from fi_gateway.distribution_specs import LawChoice
from fi_gateway.distributions import Exponential, Normal
from fi_gateway.events import (
    At,
    Drawn,
    Event,
    Every,
    FailureOfFrame,
    FailureProbability,
    GaitPhase,
    Never,
    When,
)
from fi_gateway.kinds import Kinds
from fi_gateway.quantity import Dimension, format_duration, format_quantity, parse_duration, parse_quantity


class EventSpec(SpecModel):
    """Base of the event types in files."""

    __slots__ = ()

    def build(self, plan: BusPlan, rng: Generator) -> Event:
        """The engine's event, drawing from `rng`; raises SpecError for what does not fit the rig."""
        raise NotImplementedError

    def stand_in(self, plan: BusPlan, rng: Generator, frame_ns: int, stride_ns: int = 0) -> Event | None:
        """One that comes as often and needs no frames, to reckon with; None when nobody can tell.

        frame_ns: mean distance of the target's frames; stride_ns: of the gait; 0 when not known.
        """
        return self.build(plan, rng)

    def counts_frames(self) -> bool:
        """Whether it comes with frames of the target; its stand-in has the k-th frame at k times their distance."""
        return False

    def counts_cycles(self) -> bool:
        """Whether it hangs on how long a control cycle is."""
        return False

    def times(self) -> tuple[int, ...]:
        """The times at which it happens [ns], in order, where the file gives them; else ()."""
        return ()

    def silent(self, plan: BusPlan) -> str:
        """Why it never happens of itself: "p is 0"; "" when it does."""
        return ""

    def words(self, plan: BusPlan) -> str:
        """When: "at 3 s"; "" for never."""
        raise NotImplementedError


@dataclass(frozen=True, slots=True)
class AtSpec(EventSpec):
    """One time, or several, after time 0."""

    type: Literal["at"]
    time_ns: Annotated[Time | None, Field(alias="time")] = None
    times_ns: Annotated[Annotated[tuple[Time, ...], Field(min_length=1)] | None, Field(alias="times")] = None

    def __post_init__(self) -> None:
        """Exactly one of the two keys; raises ValueError."""
        if (self.time_ns is None) == (self.times_ns is None):
            raise ValueError("give time (one) or times (a list), one of the two")
        if self.times_ns is not None and len(set(self.times_ns)) != len(self.times_ns):
            raise ValueError("the same time is given twice")

    def times(self) -> tuple[int, ...]:
        """The times in order."""
        return (self.time_ns,) if self.time_ns is not None else tuple(sorted(self.times_ns or ()))

    def build(self, plan: BusPlan, rng: Generator) -> Event:
        """See At."""
        return At(self.times())

    def words(self, plan: BusPlan) -> str:
        """For people."""
        return "at " + ", ".join(format_duration(time) for time in self.times())


def _period(given: object) -> str:
    """`1 ms`, `sync` for one control cycle, or `frame`."""
    if given == "sync" or given == "frame":
        return str(given)
    span = parse_duration(given)
    if span <= 0:
        raise ValueError(f"{given!r} is not a period; allowed is more than 0 s, or sync, or frame")
    return format_duration(span)


@dataclass(frozen=True, slots=True)
class FailureProbabilitySpec(EventSpec):
    """One trial per period, on a grid from time 0, or per target frame. p: 0..1; per: a duration, `sync` or `frame`."""

    type: Literal["failure_probability"]
    p: Share
    per: Annotated[str, BeforeValidator(_period)]

    def build(self, plan: BusPlan, rng: Generator) -> Event:
        """See FailureProbability and FailureOfFrame."""
        if self.per == "frame":
            return FailureOfFrame(self.p, rng)
        return FailureProbability(self.p, self._period_ns(plan), rng)

    def stand_in(self, plan: BusPlan, rng: Generator, frame_ns: int, stride_ns: int = 0) -> Event | None:
        """Per frame: a grid of the mean distance of frames."""
        if self.per != "frame":
            return self.build(plan, rng)
        return FailureProbability(self.p, frame_ns, rng) if frame_ns else None

    def counts_frames(self) -> bool:
        """Per frame it does."""
        return self.per == "frame"

    def counts_cycles(self) -> bool:
        """Per `sync` it does."""
        return self.per == "sync"

    def silent(self, plan: BusPlan) -> str:
        """With p = 0."""
        return "p is 0" if self.p == 0 else ""

    def words(self, plan: BusPlan) -> str:
        """For people."""
        text = f"with probability {self.p:g} per {self.per}"
        return text if self.per == "frame" else f"{text} ({self.p * 1e9 / self._period_ns(plan):g}/s)"

    def _period_ns(self, plan: BusPlan) -> int:
        return plan.cycle_ns if self.per == "sync" else parse_duration(self.per)


def _rate(given: object) -> float:
    """A rate [1/s], more than 0."""
    value = parse_quantity(given, Dimension.RATE)
    if not 1e-12 <= value <= 1e9:
        raise ValueError(f"{given!r} is not a rate of failures; allowed is 1e-12 1/s to 1e9 1/s")
    return value


def _show_rate(value: float) -> str:
    return format_quantity(value, Dimension.RATE)


Rate: TypeAlias = Annotated[
    float,
    BeforeValidator(_rate),
    PlainSerializer(_show_rate),
    WithJsonSchema({"type": "string", "examples": ["0.5 1/s"]}),
]


@dataclass(frozen=True, slots=True)
class RateSpec(EventSpec):
    """Lambda failures per second, without memory."""

    type: Literal["rate"]
    lambda_per_s: Annotated[Rate, Field(alias="lambda")]

    def build(self, plan: BusPlan, rng: Generator) -> Event:
        """See Drawn and Exponential."""
        return Drawn(Exponential(1e9 / self.lambda_per_s), rng)

    def words(self, plan: BusPlan) -> str:
        """For people."""
        return f"at a rate of {self.lambda_per_s:g}/s"


@dataclass(frozen=True, slots=True)
class MttfSpec(EventSpec):
    """Mean time to failure: a normal, truncated at > 0; mean and sd are those before truncation."""

    type: Literal["mttf"]
    mean_ns: Annotated[Span, Field(alias="mean")]
    sd_ns: Annotated[Time, Field(alias="sd")]

    def build(self, plan: BusPlan, rng: Generator) -> Event:
        """See Drawn and Normal."""
        return Drawn(Normal(self.mean_ns, self.sd_ns), rng)

    def words(self, plan: BusPlan) -> str:
        """For people."""
        return f"after a time to failure (mean {format_duration(self.mean_ns)}, sd {format_duration(self.sd_ns)})"


@dataclass(frozen=True, slots=True)
class DistributedEventSpec(EventSpec):
    """The time to the next failure has a distribution."""

    type: Literal["distribution"]
    law: LawChoice

    def build(self, plan: BusPlan, rng: Generator) -> Event:
        """See Drawn."""
        return Drawn(self.law.build(), rng)

    def words(self, plan: BusPlan) -> str:
        """For people."""
        return f"after a drawn time: {self.law.words()}"


@dataclass(frozen=True, slots=True)
class EverySpec(EventSpec):
    """Every n-th frame of the target, from time 0."""

    type: Literal["every"]
    n: Count

    def build(self, plan: BusPlan, rng: Generator) -> Event:
        """See Every."""
        return Every(self.n)

    def stand_in(self, plan: BusPlan, rng: Generator, frame_ns: int, stride_ns: int = 0) -> Event | None:
        """A certain event on a grid of n mean distances of frames."""
        return FailureProbability(1.0, self.n * frame_ns, rng) if frame_ns else None

    def counts_frames(self) -> bool:
        """It does."""
        return True

    def words(self, plan: BusPlan) -> str:
        """For people."""
        return f"with every {self.n}. frame" if self.n > 1 else "with every frame"


class _EveryStride(Event):
    """Once a stride, at times of its own. first_ns: in the first one."""

    def __init__(self, first_ns: int, stride_ns: int) -> None:
        super().__init__()
        self._first_ns: Final[int] = first_ns
        self._stride_ns: Final[int] = stride_ns

    def next(self, after: int) -> int:
        """The first one not before `after`."""
        strides = -((self._first_ns - after) // self._stride_ns)
        return self._first_ns + max(0, strides) * self._stride_ns


@dataclass(frozen=True, slots=True)
class GaitPhaseSpec(EventSpec):
    """At a phase of every stride. phase: 0 to below 1, or 0 % to below 100 %; 0 is right heel strike."""

    type: Literal["gait_phase"]
    phase: Share

    def __post_init__(self) -> None:
        """100 % is 0 % of the next stride; raises ValueError."""
        if self.phase >= 1:
            raise ValueError("phase: 100 % is 0 % of the next stride; allowed 0 % to below 100 %")

    def build(self, plan: BusPlan, rng: Generator) -> Event:
        """See GaitPhase."""
        return GaitPhase(self.phase)

    def stand_in(self, plan: BusPlan, rng: Generator, frame_ns: int, stride_ns: int = 0) -> Event | None:
        """At that phase of every stride from time 0 on, in the nearest control cycle."""
        if not stride_ns:
            return None
        cycles = stride_ns // plan.cycle_ns
        return _EveryStride(round(self.phase * cycles) % cycles * plan.cycle_ns, stride_ns)

    def words(self, plan: BusPlan) -> str:
        """For people."""
        return f"at {100 * self.phase:g} % of every stride"


@dataclass(frozen=True, slots=True)
class WhenSpec(EventSpec):
    """A condition over signals. edge: rising (when it becomes true), or level (at once again while it is true)."""

    type: Literal["when"]
    condition: ConditionText
    edge: Literal["rising", "level"] = "rising"

    def build(self, plan: BusPlan, rng: Generator) -> Event:
        """See When."""
        return When(resolve_condition(self.condition, plan).condition, self.edge == "rising")

    def stand_in(self, plan: BusPlan, rng: Generator, frame_ns: int, stride_ns: int = 0) -> Event | None:
        """Nobody can tell."""
        return None

    def silent(self, plan: BusPlan) -> str:
        """A condition that its signals cannot fulfil."""
        can_hold = resolve_condition(self.condition, plan).can_hold
        return "" if can_hold else f"its signals never reach {self.condition}"

    def words(self, plan: BusPlan) -> str:
        """For people."""
        return f"{'whenever' if self.edge == 'rising' else 'while'} {self.condition}"


@dataclass(frozen=True, slots=True)
class NeverSpec(EventSpec):
    """By trigger only."""

    type: Literal["never"]

    def build(self, plan: BusPlan, rng: Generator) -> Event:
        """See Never."""
        return Never()

    def silent(self, plan: BusPlan) -> str:
        """Never."""
        return "it is never"

    def words(self, plan: BusPlan) -> str:
        """For people."""
        return ""


EVENTS: Final[Kinds[EventSpec]] = Kinds(
    "event",
    "exo_hil.events",
    EventSpec,
    (
        AtSpec,
        FailureProbabilitySpec,
        RateSpec,
        MttfSpec,
        DistributedEventSpec,
        EverySpec,
        GaitPhaseSpec,
        WhenSpec,
        NeverSpec,
    ),
)

EventChoice: TypeAlias = Annotated[EventSpec, EVENTS]
