"""Events and effects as a scenario file gives them: one small class each.

Each reads its own keys, builds the engine's object, and says in words when, or for how long. Durations are ns.
"""

from dataclasses import dataclass
from typing import Annotated, Final, Literal, TypeAlias

from numpy.random import Generator
from pydantic import BeforeValidator, Field

from canopen_exo.plan import BusPlan
from fi_gateway.boundary import Later, Share, Span, SpecModel, Time
from fi_gateway.effects import ConstantTime, Effect, Infinite, Once
from fi_gateway.events import At, Event, FailureProbability, Never
from fi_gateway.quantity import format_duration, parse_duration


class EffectSpec(SpecModel):
    """Base of the effect types in files."""

    __slots__ = ()

    def build(self) -> Effect:
        """The engine's effect."""
        raise NotImplementedError

    def words(self) -> str:
        """How long: "for 0.3 s"."""
        raise NotImplementedError

    def mean_ns(self) -> int | None:
        """Mean length of an activation after which the injector arms again; None when it does not."""
        return None


@dataclass(frozen=True, slots=True)
class OnceSpec(EffectSpec):
    """One frame, once a run."""

    type: Literal["once"]

    def build(self) -> Effect:
        """See Once."""
        return Once()

    def words(self) -> str:
        """For people."""
        return "in one frame, once a run"


@dataclass(frozen=True, slots=True)
class ConstantTimeSpec(EffectSpec):
    """A fixed time; then the injector arms again."""

    type: Literal["constant_time"]
    duration_ns: Annotated[Span, Field(alias="duration")]

    def build(self) -> Effect:
        """See ConstantTime."""
        return ConstantTime(self.duration_ns)

    def words(self) -> str:
        """For people."""
        return f"for {format_duration(self.duration_ns)}"

    def mean_ns(self) -> int | None:
        """The fixed time."""
        return self.duration_ns


@dataclass(frozen=True, slots=True)
class InfiniteSpec(EffectSpec):
    """Until the end of the run."""

    type: Literal["infinite"]

    def build(self) -> Effect:
        """See Infinite."""
        return Infinite()

    def words(self) -> str:
        """For people."""
        return "until the end of the run"


class EventSpec(SpecModel):
    """Base of the event types in files."""

    __slots__ = ()

    def build(self, plan: BusPlan, rng: Generator) -> Event:
        """The engine's event, drawing from `rng`."""
        raise NotImplementedError

    def fires(self) -> bool:
        """Whether it ever happens by itself."""
        return True

    def times(self) -> tuple[int, ...]:
        """The times at which it happens [ns], in order, where the file gives them; else ()."""
        return ()

    def words(self, plan: BusPlan, effect: EffectSpec, duration_ns: int) -> str:
        """When, in a motion of that length: "at 3 s"."""
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

    def words(self, plan: BusPlan, effect: EffectSpec, duration_ns: int) -> str:
        """For people."""
        return "at " + ", ".join(format_duration(time) for time in self.times())


def _period(given: object) -> str:
    """`1 ms`, or `sync` for one control cycle."""
    if given == "sync":
        return "sync"
    if given == "frame":
        raise ValueError("per: frame is not available yet; available: a duration such as 1 ms, or sync")
    span = parse_duration(given)
    if span <= 0:
        raise ValueError(f"{given!r} is not a period; allowed is more than 0 s, or sync")
    return format_duration(span)


@dataclass(frozen=True, slots=True)
class FailureProbabilitySpec(EventSpec):
    """One draw per period, on a grid from time 0. p: 0..1; per: a duration, or `sync` for the control cycle."""

    type: Literal["failure_probability"]
    p: Share
    per: Annotated[str, BeforeValidator(_period)]

    def build(self, plan: BusPlan, rng: Generator) -> Event:
        """See FailureProbability."""
        return FailureProbability(self.p, self.period_ns(plan), rng)

    def period_ns(self, plan: BusPlan) -> int:
        """The period in ns."""
        return plan.cycle_ns if self.per == "sync" else parse_duration(self.per)

    def fires(self) -> bool:
        """Not with p = 0."""
        return self.p > 0

    def words(self, plan: BusPlan, effect: EffectSpec, duration_ns: int) -> str:
        """For people, with the number of activations to expect."""
        period_ns = self.period_ns(plan)
        text = f"with probability {self.p:g} per {self.per} ({self.p * 1e9 / period_ns:g}/s"
        motion = format_duration(duration_ns)
        length_ns = effect.mean_ns()
        if self.p == 0:
            return f"{text}: never)"
        if length_ns is None:
            chance = 1 - (1 - self.p) ** (duration_ns // period_ns)
            return f"{text}, activated in {100 * chance:.0f} % of the runs of {motion})"
        number = duration_ns / (period_ns / self.p + length_ns)
        return f"{text}, about {number:.1f} activations expected in {motion}, dead time included)"


@dataclass(frozen=True, slots=True)
class NeverSpec(EventSpec):
    """By trigger only."""

    type: Literal["never"]

    def build(self, plan: BusPlan, rng: Generator) -> Event:
        """See Never."""
        return Never()

    def fires(self) -> bool:
        """Never."""
        return False

    def words(self, plan: BusPlan, effect: EffectSpec, duration_ns: int) -> str:
        """For people."""
        return ""


_DISTRIBUTIONS: Final = ("normal", "weibull", "gamma", "exponential", "poisson", "binomial")
EventChoice: TypeAlias = Annotated[
    AtSpec | FailureProbabilitySpec | NeverSpec,
    Field(discriminator="type"),
    Later(("rate", "mttf", "distribution", "every", "gait_phase", "when", *_DISTRIBUTIONS)),
]
EffectChoice: TypeAlias = Annotated[
    OnceSpec | ConstantTimeSpec | InfiniteSpec,
    Field(discriminator="type"),
    Later(("frames", "mttr", "distribution", "until", *_DISTRIBUTIONS)),
]
