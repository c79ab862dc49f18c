"""Effects: how long an activation lasts, and whether the injector arms itself again.

Source: Fabarisov et al., ESREL 2020 (FIBlock), "effect". Durations are int ns; windows are half-open [t0, t0 + D).
"""

from typing import Final, final

from mypy_extensions import mypyc_attr
from numpy.random import Generator

from canopen_exo.bus.frame import Frame
from canopen_exo.bus.node import NEVER
from fi_gateway.conditions import Condition
from fi_gateway.distributions import Distribution
from fi_gateway.errors import FaultError


@mypyc_attr(allow_interpreted_subclasses=True)
class Effect:
    """How long an activation lasts.

    frames: it ends after this many frames the fault acted on, or inserted by itself, 0 for no limit; rearms: whether
    the injector waits for its event or trigger again afterwards, or is spent for the run; watches: (port, COB-ID) of
    the frames it wants to observe.
    """

    def __init__(self, frames: int = 0, rearms: bool = False, watches: tuple[tuple[int, int], ...] = ()) -> None:
        self.frames: int = frames
        self.rearms: bool = rearms
        self.watches: tuple[tuple[int, int], ...] = watches

    def duration(self) -> int:
        """Length of the activation that starts now, ns, NEVER for no limit; drawn anew for each activation."""
        return NEVER

    def observe(self, now: int, frame: Frame) -> bool:
        """A watched frame has come in at `now`, see `Event.observe`; True: an open window ends at `now`.

        Called for every one of them, window or not: what is true between activations ends none.
        """
        return False


@final
class Once(Effect):
    """One frame, once a run. FIBlock: Once."""

    def __init__(self) -> None:
        super().__init__(1, False)


@final
class Frames(Effect):
    """So many frames the fault acted on, or inserted by itself, 1 and more; then the injector arms again.

    FIBlock: Constant time, whose window is a number of samples; its last one is clean.
    """

    def __init__(self, frames: int) -> None:
        super().__init__(frames, True)
        if frames < 1:
            raise FaultError(f"frames: n {frames} given, allowed 1 and more")

    def __reduce__(self) -> tuple[type["Frames"], tuple[int]]:
        return Frames, (self.frames,)


@final
class ConstantTime(Effect):
    """A fixed time, ns, > 0; then the injector arms again.

    FIBlock: Constant time; there the window is a number of samples, and its last one is clean.
    """

    def __init__(self, duration_ns: int) -> None:
        super().__init__(0, True)
        if not 0 < duration_ns < NEVER:
            raise FaultError(f"constant_time: duration {duration_ns} ns given, allowed 1..{NEVER - 1} ns")
        self._duration_ns: Final[int] = duration_ns

    def duration(self) -> int:
        """The fixed time, ns."""
        return self._duration_ns

    def __reduce__(self) -> tuple[type["ConstantTime"], tuple[int]]:
        return ConstantTime, (self._duration_ns,)


@final
class DrawnTime(Effect):
    """A time drawn from a distribution for each activation; then the injector arms again.

    A distribution that counts periods gives that many of them from the start of the window; 0 of them is 1 ns, the
    shortest window, which a frame arriving right then still meets.
    FIBlock: MTTR (a normal with sd 1 s, not truncated).
    """

    def __init__(self, distribution: Distribution, rng: Generator) -> None:
        super().__init__(0, True)
        self._distribution: Final[Distribution] = distribution
        self._rng: Final[Generator] = rng

    def duration(self) -> int:
        """The next draw, ns."""
        drawn = self._distribution.draw(self._rng)
        if self._distribution.period_ns:
            drawn *= self._distribution.period_ns
        return max(1, min(drawn, NEVER))

    def __reduce__(self) -> tuple[type["DrawnTime"], tuple[Distribution, Generator]]:
        return DrawnTime, (self._distribution, self._rng)


@final
class Infinite(Effect):
    """Until the end of the run. FIBlock: Infinite time."""

    def __init__(self) -> None:
        super().__init__(0, False)


@final
class Until(Effect):
    """Until a frame comes with which the condition holds; that frame is outside the window. Then it arms again.

    The condition is looked at with each frame it watches, so one that holds already when the window opens ends it with
    the next of them. FIBlock: none.
    """

    def __init__(self, condition: Condition) -> None:
        super().__init__(0, True, condition.watches)
        self._condition: Final[Condition] = condition

    def observe(self, now: int, frame: Frame) -> bool:
        """Whether the condition holds with this frame."""
        return self._condition.observe(frame)

    def __reduce__(self) -> tuple[type["Until"], tuple[Condition]]:
        return Until, (self._condition,)
