"""Events: when an injector activates of itself.

Most are times, which the injector asks for (`next`): ns after time 0 (or after power-up, for an injector that says so).
They are drawn when it is armed and never when a frame arrives, so that the bus load does not change when faults happen.
Others are frames (`observe`): the n-th one, a trial for each, one with which a condition becomes true, or the SYNC at
which the gait comes to a phase.
Source: Fabarisov et al., ESREL 2020 (FIBlock), "event".
"""

from bisect import bisect_left
from math import floor
from typing import Final, final

from mypy_extensions import mypyc_attr
from numpy.random import Generator

from canopen_exo.bus.frame import Frame
from canopen_exo.bus.node import NEVER
from canopen_exo.plan import HLC_STATUS, STATUS_MOTION, STATUS_STARTING, SYNC
from fi_gateway.conditions import Condition
from fi_gateway.distributions import Distribution
from fi_gateway.errors import FaultError

FROM_CONTROLLER: Final = 0
"""Port of the gateway on which the controller's frames come in."""
FROM_DRIVES: Final = 1
"""Port of the gateway on which the drives' frames come in."""

_STRIDE: Final = 65536
"""Phase units in a stride (HLC status frame)."""


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
class Drawn(Event):
    """The time to the next failure, from when the injector became free, has a distribution.

    One that counts periods counts them on the grid from time 0, which goes on after expiry: from the first grid point
    that is not before the moment at which the injector became free; 0 periods are that point itself.
    FIBlock: MTTF (a normal with sd 1 s, not truncated), failure distribution.
    """

    def __init__(self, distribution: Distribution, rng: Generator) -> None:
        super().__init__()
        self._distribution: Final[Distribution] = distribution
        self._rng: Final[Generator] = rng
        self._due: int = -1

    def next(self, after: int) -> int:
        """The drawn time; drawn anew when the last one is over."""
        if self._due < after:
            drawn = self._distribution.draw(self._rng)
            period_ns = self._distribution.period_ns
            if period_ns:
                self._due = ((after + period_ns - 1) // period_ns + drawn) * period_ns
            else:
                self._due = after + drawn
            self._due = min(self._due, NEVER)
        return self._due

    def __reduce__(self) -> tuple[type["Drawn"], tuple[Distribution, Generator], dict[str, object]]:
        return Drawn, (self._distribution, self._rng), {"_due": self._due}


@final
class FailureOfFrame(Event):
    """One trial per target frame from time 0 on: P(this one) = probability, 0..1, independent of all others.

    The number of frames to the next success is drawn, geometrically; a success inside an activation is passed over.
    FIBlock: Failure probability, where every execution is a trial.
    """

    def __init__(self, probability: float, rng: Generator) -> None:
        super().__init__((), True)
        if not 0.0 <= probability <= 1.0:
            raise FaultError(f"failure_probability: p {probability} given, allowed 0..1 per frame")
        self._probability: Final[float] = probability
        self._rng: Final[Generator] = rng
        self._left: int = 0

    def observe(self, now: int, frame: Frame) -> bool:
        """Whether the trial of this frame is a success."""
        if now < 0 or self._probability == 0.0:
            return False
        if self._left == 0:
            self._left = int(self._rng.geometric(self._probability))
        self._left -= 1
        return self._left == 0

    def __reduce__(self) -> tuple[type["FailureOfFrame"], tuple[float, Generator], dict[str, object]]:
        return FailureOfFrame, (self._probability, self._rng), {"_left": self._left}


@final
class Every(Event):
    """Every n-th target frame: n, 2n, ..., counted from time 0 on, also inside activations. frames: n, 1 and more.

    FIBlock: none.
    """

    def __init__(self, frames: int) -> None:
        super().__init__((), True)
        if frames < 1:
            raise FaultError(f"every: n {frames} given, allowed 1 and more")
        self._frames: Final[int] = frames
        self._seen: int = 0

    def observe(self, now: int, frame: Frame) -> bool:
        """Count; whether it is the n-th."""
        if now < 0:
            return False
        self._seen += 1
        return self._seen % self._frames == 0

    def __reduce__(self) -> tuple[type["Every"], tuple[int], dict[str, object]]:
        return Every, (self._frames,), {"_seen": self._seen}


@final
class When(Event):
    """A condition over decoded signals: with the frame that makes it true, or, not `rising`, with every watched frame
    while it is true.

    What is true at time 0 becomes true with the first watched frame after it. FIBlock: none.
    """

    def __init__(self, condition: Condition, rising: bool = True) -> None:
        super().__init__(condition.watches)
        self._condition: Final[Condition] = condition
        self._rising: Final[bool] = rising
        self._held: bool = False

    def observe(self, now: int, frame: Frame) -> bool:
        """Read the frame's signals; whether that is the moment."""
        holds = self._condition.observe(frame)
        if now < 0:
            return False
        rose = holds and not self._held
        self._held = holds
        return rose if self._rising else holds

    def __reduce__(self) -> tuple[type["When"], tuple[Condition, bool], dict[str, object]]:
        return When, (self._condition, self._rising), {"_held": self._held}


@final
class GaitPhase(Event):
    """In every stride, the SYNC nearest to a phase of the gait. phase: 0 to below 1 stride, 0 is right heel strike.

    The phase is that of the controller's status frame (COB-ID 0x2FF: state u8, cycle u16, phase u16, little endian),
    and between two of these it goes on with each SYNC as it has gone on per SYNC so far; so it is known from the
    second status frame on, which is long before time 0. A phase that is passed while SYNCs are missing is met by a
    later SYNC or status frame. Less than a stride must lie between two status frames. FIBlock: none.
    """

    def __init__(self, phase: float) -> None:
        super().__init__(((FROM_CONTROLLER, SYNC), (FROM_CONTROLLER, HLC_STATUS)))
        if not 0.0 <= phase < 1.0:
            raise FaultError(f"gait_phase: phase {phase} strides given, allowed 0 to below 1")
        self._phase: Final[float] = phase
        self._at: int = -1
        self._cycle: int = -1
        self._advance: int = 0
        self._syncs: int = 0
        self._since: int = 0
        self._met: int = -1
        self._begun: bool = False

    def observe(self, now: int, frame: Frame) -> bool:
        """Whether with this frame the phase has been reached once more."""
        if frame.can_id == SYNC:
            self._since += 1
        else:
            self._read(frame.data)
        if now < 0 or self._syncs == 0:
            return False
        rate = self._advance / self._syncs
        ahead = self._at + self._since * rate - self._phase * _STRIDE  # beyond the phase in the stride of the start
        if not self._begun:
            self._begun = True
            self._met = floor((ahead - 0.5 * rate) / _STRIDE)
        strides = floor((ahead + 0.5 * rate) / _STRIDE)
        if strides <= self._met:
            return False
        self._met = strides
        return True

    def _read(self, data: bytes) -> None:
        """A status frame. `_at` counts the phase on over the strides; the SYNCs between two are told in motion."""
        if len(data) < 5 or data[0] not in (STATUS_STARTING, STATUS_MOTION):
            return
        cycle, phase = data[1] | data[2] << 8, data[3] | data[4] << 8
        if self._at < 0:
            self._at = phase
        else:
            step = (phase - self._at) % _STRIDE
            self._at += step
            syncs = self._since
            if self._cycle >= 0 and data[0] == STATUS_MOTION:
                syncs = (cycle - self._cycle) & 0xFFFF
            if syncs:
                self._advance += step
                self._syncs += syncs
        self._cycle = cycle if data[0] == STATUS_MOTION else -1
        self._since = 0

    def __reduce__(self) -> tuple[type["GaitPhase"], tuple[float], dict[str, object]]:
        names = ("_at", "_cycle", "_advance", "_syncs", "_since", "_met", "_begun")
        return GaitPhase, (self._phase,), {name: getattr(self, name) for name in names}


@final
class Never(Event):
    """No event of its own: the injector starts by trigger only. FIBlock: Failure probability 0 with a trigger input."""
