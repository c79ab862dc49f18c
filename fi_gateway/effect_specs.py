"""Effects as a scenario file gives them: one small class each.

Each reads its own keys, builds the engine's effect, and says in words for how long. Durations are ns.
Further ones come from other packages, see `fi_gateway.kinds`.
"""

from dataclasses import dataclass
from typing import Annotated, Final, Literal, TypeAlias

from numpy.random import Generator
from pydantic import Field

from canopen_exo.plan import BusPlan
from fi_gateway.boundary import Count, Span, SpecModel, Time
from fi_gateway.condition_specs import ConditionText, resolve_condition
from fi_gateway.distribution_specs import LawChoice
from fi_gateway.distributions import Normal
from fi_gateway.effects import ConstantTime, DrawnTime, Effect, Frames, Infinite, Once, Until
from fi_gateway.kinds import Kinds
from fi_gateway.quantity import format_duration


class EffectSpec(SpecModel):
    """Base of the effect types in files."""

    __slots__ = ()

    def build(self, plan: BusPlan, rng: Generator) -> Effect:
        """The engine's effect, drawing from `rng`; raises SpecError for what does not fit the rig."""
        raise NotImplementedError

    def stand_in(self, plan: BusPlan, rng: Generator, frame_ns: int) -> Effect | None:
        """One of the same length that needs no frames, to reckon with; None when nobody can tell.

        frame_ns: mean distance of the target's frames, 0 when not known.
        """
        return self.build(plan, rng)

    def doubts(self, plan: BusPlan) -> str:
        """Why it will not end as it should: "ends never: ..."; "" for no reason."""
        return ""

    def words(self) -> str:
        """How long: "for 0.3 s"."""
        raise NotImplementedError


@dataclass(frozen=True, slots=True)
class OnceSpec(EffectSpec):
    """One frame, once a run."""

    type: Literal["once"]

    def build(self, plan: BusPlan, rng: Generator) -> Effect:
        """See Once."""
        return Once()

    def words(self) -> str:
        """For people."""
        return "in one frame, once a run"


@dataclass(frozen=True, slots=True)
class FramesSpec(EffectSpec):
    """So many frames; then the injector arms again."""

    type: Literal["frames"]
    n: Count

    def build(self, plan: BusPlan, rng: Generator) -> Effect:
        """See Frames."""
        return Frames(self.n)

    def stand_in(self, plan: BusPlan, rng: Generator, frame_ns: int) -> Effect | None:
        """To the end of the last frame: from 0 (the frame that starts it) to n distances, n - 1/2 in the mean."""
        return ConstantTime(max(1, (2 * self.n - 1) * frame_ns // 2)) if frame_ns else None

    def words(self) -> str:
        """For people."""
        return f"in {self.n} frame{'s' if self.n > 1 else ''}"


@dataclass(frozen=True, slots=True)
class ConstantTimeSpec(EffectSpec):
    """A fixed time; then the injector arms again."""

    type: Literal["constant_time"]
    duration_ns: Annotated[Span, Field(alias="duration")]

    def build(self, plan: BusPlan, rng: Generator) -> Effect:
        """See ConstantTime."""
        return ConstantTime(self.duration_ns)

    def words(self) -> str:
        """For people."""
        return f"for {format_duration(self.duration_ns)}"


@dataclass(frozen=True, slots=True)
class InfiniteSpec(EffectSpec):
    """Until the end of the run."""

    type: Literal["infinite"]

    def build(self, plan: BusPlan, rng: Generator) -> Effect:
        """See Infinite."""
        return Infinite()

    def words(self) -> str:
        """For people."""
        return "until the end of the run"


@dataclass(frozen=True, slots=True)
class MttrSpec(EffectSpec):
    """Mean time to repair: a normal, truncated at > 0; mean and sd are those before truncation."""

    type: Literal["mttr"]
    mean_ns: Annotated[Span, Field(alias="mean")]
    sd_ns: Annotated[Time, Field(alias="sd")]

    def build(self, plan: BusPlan, rng: Generator) -> Effect:
        """See DrawnTime and Normal."""
        return DrawnTime(Normal(self.mean_ns, self.sd_ns), rng)

    def words(self) -> str:
        """For people."""
        return f"until repaired (mean {format_duration(self.mean_ns)}, sd {format_duration(self.sd_ns)})"


@dataclass(frozen=True, slots=True)
class DistributedEffectSpec(EffectSpec):
    """A time drawn for each activation; then the injector arms again."""

    type: Literal["distribution"]
    law: LawChoice

    def build(self, plan: BusPlan, rng: Generator) -> Effect:
        """See DrawnTime."""
        return DrawnTime(self.law.build(), rng)

    def words(self) -> str:
        """For people."""
        return f"for a drawn time: {self.law.words()}"


@dataclass(frozen=True, slots=True)
class UntilSpec(EffectSpec):
    """Until a condition holds; then the injector arms again."""

    type: Literal["until"]
    condition: ConditionText

    def build(self, plan: BusPlan, rng: Generator) -> Effect:
        """See Until."""
        return Until(resolve_condition(self.condition, plan).condition)

    def stand_in(self, plan: BusPlan, rng: Generator, frame_ns: int) -> Effect | None:
        """Nobody can tell."""
        return None

    def doubts(self, plan: BusPlan) -> str:
        """A condition that its signals cannot fulfil."""
        if resolve_condition(self.condition, plan).can_hold:
            return ""
        return f"lasts until the end of the run: its signals never reach {self.condition}"

    def words(self) -> str:
        """For people."""
        return f"until {self.condition}"


EFFECTS: Final[Kinds[EffectSpec]] = Kinds(
    "effect",
    "exo_hil.effects",
    EffectSpec,
    (OnceSpec, FramesSpec, ConstantTimeSpec, InfiniteSpec, MttrSpec, DistributedEffectSpec, UntilSpec),
)

EffectChoice: TypeAlias = Annotated[EffectSpec, EFFECTS]
