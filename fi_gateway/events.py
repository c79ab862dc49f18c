"""Events: when an injector activates of itself.

Times are int ns after time 0 (or after power-up, for an injector that says so); nothing is drawn when a frame arrives,
so that the bus load does not change when faults happen.
Source: Fabarisov et al., ESREL 2020 (FIBlock), "event". Left out: events per frame, conditions, other distributions.
"""

from bisect import bisect_left
from typing import Final, final

from mypy_extensions import mypyc_attr
from numpy.random import Generator

from canopen_exo.bus.frame import Frame
from canopen_exo.bus.node import NEVER
from fi_gateway.errors import FaultError


@mypyc_attr(allow_interpreted_subclasses=True)
class Event:
    """When an injector activates; belongs to one injector.

    watches: (port, COB-ID) of the frames it wants to observe, as they come in on that port, before any fault;
    watches_target: it wants to observe the frames of its injector's target, as they reach that injector.
    """

    def __init__(self, watches: tuple[tuple[int, int], ...] = (), watches_target: bool = False) -> None:
        self.watches: tuple[tuple[int, int], ...] = watches
        self.watches_target: bool = watches_target

    def first(self) -> int:
        """The first activation, ns, NEVER for none."""
        return self.next(0)

    def next(self, after: int) -> int:
        """The next activation, ns, for an injector that became free at `after` [ns]; NEVER for none of itself.

        `after` does not fall from call to call; an event that was announced and not used up stays valid.
        """
        return NEVER

    def observe(self, now: int, frame: Frame) -> bool:
        """A watched frame has come in at `now`; True: an armed injector activates now, so that this frame is met.

        now: ns after time 0 (or power-up) like the times of `next`, negative while that has not come. Called for every
        such frame, whatever the injector is doing, so that nothing is missed; unless it is armed, True means nothing.
        """
        return False


@final
class At(Event):
    """Given times, ns, >= 0, in any order. A time inside an activation is passed over, one at its very end counts.

    FIBlock: Deterministic; there the time must equal a sample time.
    """

    def __init__(self, times_ns: tuple[int, ...]) -> None:
        super().__init__()
        self._times: Final[list[int]] = sorted(set(times_ns))
        if not self._times or self._times[0] < 0 or self._times[-1] >= NEVER:
            raise FaultError(f"at: times {times_ns} ns given, allowed are one or more times 0..{NEVER - 1} ns")

    def next(self, after: int) -> int:
        """The first time not before `after`."""
        index = bisect_left(self._times, after)
        return self._times[index] if index < len(self._times) else NEVER

    def __reduce__(self) -> tuple[type["At"], tuple[tuple[int, ...]]]:
        return At, (tuple(self._times),)


@final
class FailureProbability(Event):
    """One trial per period: P(event at k * period) = probability, k = 1, 2, ...

    probability: 0..1 per period; period_ns: > 0. Trial k stands for the period that ends at k * period_ns, so there is
    none at time 0, and a period that ends inside an activation, or just with it, has no trial. The mean distance
    of activations of length D on the grid is therefore period / probability + D. The gap to the next success is drawn
    once, geometrically, on the grid from time 0, which goes on after expiry.
    FIBlock: Failure probability; that draws at every execution of the block, so its rate hangs on the sample time.
    """

    def __init__(self, probability: float, period_ns: int, rng: Generator) -> None:
        super().__init__()
        if not 0.0 <= probability <= 1.0:
            raise FaultError(f"failure_probability: p {probability} given, allowed 0..1 per period")
        if period_ns <= 0:
            raise FaultError(f"failure_probability: period {period_ns} ns given, allowed 1 ns and more")
        self._probability: Final[float] = probability
        self._period_ns: Final[int] = period_ns
        self._rng: Final[Generator] = rng
        self._due: int = -1

    def next(self, after: int) -> int:
        """The first success on the grid points after `after`."""
        if self._due <= after:
            self._due = NEVER
            if self._probability > 0.0:
                trial = after // self._period_ns + int(self._rng.geometric(self._probability))
                self._due = min(trial * self._period_ns, NEVER)
        return self._due

    def __reduce__(
        self,
    ) -> tuple[type["FailureProbability"], tuple[float, int, Generator], dict[str, object]]:
        state: dict[str, object] = {"_due": self._due}
        return FailureProbability, (self._probability, self._period_ns, self._rng), state


@final
class Never(Event):
    """No event of its own: the injector starts by trigger only. FIBlock: Failure probability 0 with a trigger input."""

    def next(self, after: int) -> int:
        """NEVER."""
        return NEVER
