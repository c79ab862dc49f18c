"""Faults in files that lose frames, or let the right ones through at the wrong time."""

from dataclasses import dataclass
from typing import Annotated, Literal

from pydantic import Field

from fi_gateway.boundary import Count, Flag, Share, Span, SpecError
from fi_gateway.distribution_specs import LawChoice
from fi_gateway.fault_specs.base import FaultSpec, no_signal
from fi_gateway.faults import BurstDrop, Delay, Drop, Duplicate, Fault, Replay, Resequence
from fi_gateway.quantity import format_duration
from fi_gateway.target import Place


@dataclass(frozen=True, slots=True)
class DropSpec(FaultSpec):
    """The frame is lost: each with a `probability`, or in bursts (`p`, `r`, `loss_good`, `loss_bad`)."""

    type: Literal["drop"]
    probability: Share | None = None
    p: Share | None = None
    r: Share | None = None
    loss_good: Share | None = None
    loss_bad: Share | None = None

    def build(self, place: Place) -> Fault:
        """See Drop and BurstDrop."""
        no_signal(place, "drop loses whole frames")
        bursts = {"p": self.p, "r": self.r, "loss_good": self.loss_good, "loss_bad": self.loss_bad}
        given = [key for key, value in bursts.items() if value is not None]
        if not given:
            return Drop(self._probability())
        if self.probability is not None:
            raise SpecError(("probability",), f"losses in bursts are given by {', '.join(bursts)}; leave it out")
        if self.p is None or self.r is None:
            raise SpecError((given[0],), "losses in bursts need p (good to bad) and r (bad to good)")
        if self.p + self.r == 0:
            raise SpecError(("p",), "p and r are both 0, so that the channel never changes; give probability instead")
        good, bad = self._losses()
        return BurstDrop(self.p, self.r, good, bad)

    def words(self, place: Place) -> str:
        """For people."""
        if self.p is None or self.r is None:
            probability = self._probability()
            return "lost" if probability == 1 else f"lost with probability {probability:g} each,"
        good, bad = self._losses()
        share = (self.p * bad + self.r * good) / (self.p + self.r)
        length = f", bad for {1 / self.r:.3g} frames on average" if self.r else ""
        return f"lost in bursts ({100 * share:.3g} % of the frames{length})"

    def doubts(self) -> str:
        """Where no frame can get lost."""
        if self.p is None or self.r is None:
            return "probability is 0" if self._probability() == 0 else ""
        good, bad = self._losses()
        return "it loses no frame in either state" if self.p * bad + self.r * good == 0 else ""

    def _probability(self) -> float:
        return 1.0 if self.probability is None else self.probability

    def _losses(self) -> tuple[float, float]:
        """P(lost) while good, while bad."""
        return 0.0 if self.loss_good is None else self.loss_good, 1.0 if self.loss_bad is None else self.loss_bad


@dataclass(frozen=True, slots=True)
class DelaySpec(FaultSpec):
    """The frame goes on later, by a fixed `time`, one drawn from a `law`, or both; in order unless `reorder`."""

    type: Literal["delay"]
    time_ns: Annotated[Span | None, Field(alias="time")] = None
    law: LawChoice | None = None
    reorder: Flag = False

    def build(self, place: Place) -> Fault:
        """See Delay."""
        no_signal(place, "delay holds whole frames back (time_delay lets a signal lag)")
        if self.time_ns is None and self.law is None:
            raise SpecError((), "time or law is missing: how long frames are held back, such as time: 5 ms")
        return Delay(self.time_ns or 0, None if self.law is None else self.law.build(), self.reorder)

    def words(self, place: Place) -> str:
        """For people."""
        times = [format_duration(self.time_ns)] if self.time_ns is not None else []
        times += [f"a time drawn from {self.law.words()}"] if self.law is not None else []
        return f"delayed by {' and '.join(times)}{', in any order,' if self.reorder else ''}"


@dataclass(frozen=True, slots=True)
class ResequenceSpec(FaultSpec):
    """The frames of each span of time in another order, one span later."""

    type: Literal["resequence"]
    span_ns: Annotated[Span, Field(alias="span")]
    order: Literal["reversed", "random"] = "reversed"

    def build(self, place: Place) -> Fault:
        """See Resequence."""
        no_signal(place, "resequence changes the order of whole frames")
        return Resequence(self.span_ns, self.order == "random")

    def words(self, place: Place) -> str:
        """For people."""
        return f"put into {self.order} order within every {format_duration(self.span_ns)}"


@dataclass(frozen=True, slots=True)
class DuplicateSpec(FaultSpec):
    """The frame, and copies of it: at once, or `gap` after one another."""

    type: Literal["duplicate"]
    copies: Annotated[Count, Field(le=100)] = 1
    gap_ns: Annotated[Span | None, Field(alias="gap")] = None

    def build(self, place: Place) -> Fault:
        """See Duplicate."""
        no_signal(place, "duplicate repeats whole frames")
        return Duplicate(self.copies, self.gap_ns or 0)

    def words(self, place: Place) -> str:
        """For people."""
        often = "twice" if self.copies == 1 else f"{self.copies + 1} times"
        return f"sent {often}" + (f", {format_duration(self.gap_ns)} apart," if self.gap_ns is not None else "")


@dataclass(frozen=True, slots=True)
class ReplaySpec(FaultSpec):
    """The first `frames` of the activation are sent again and again, in place of fresh ones, or added to them."""

    type: Literal["replay"]
    frames: Annotated[Count, Field(le=100_000)]
    mode: Literal["replace", "add"] = "replace"

    def build(self, place: Place) -> Fault:
        """See Replay."""
        no_signal(place, "replay repeats whole frames")
        return Replay(self.frames, self.mode == "add")

    def words(self, place: Place) -> str:
        """For people."""
        where = "in place of" if self.mode == "replace" else "besides"
        return f"recorded for {self.frames} frame{'s' if self.frames > 1 else ''}, then replayed {where} fresh ones"
