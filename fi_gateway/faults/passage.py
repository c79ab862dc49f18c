"""Faults that let the right frames through at the wrong time: late, twice, again, in another order.

The frames themselves stay as they are. What is given to the outlet goes on from behind the injector, also after the
window has closed: a delayed frame is never lost.
"""

from typing import Final, final

from numpy.random import Generator

from canopen_exo.bus.frame import Frame
from canopen_exo.bus.node import NEVER
from fi_gateway.distributions import Distribution
from fi_gateway.errors import FaultError
from fi_gateway.faults.base import Fault
from fi_gateway.outlet import Outlet


@final
class Delay(Fault):
    """The frame goes on later: at t + d, t its arrival.

    d: time_ns, >= 0, and with a distribution a time drawn from it for every frame in addition (one that counts periods
    gives that many of them).
    is_reordering False: frames of one COB-ID keep their order; one whose time would come before that of an earlier one
    goes on with it, and frames that come after the window wait behind the last of it. True: each goes when its time has
    come, and may overtake. A time of 0 leaves the frame alone.
    EN 50159: delay (when reordering: resequencing as well). FIBlock: none; its Time delay acts on signals.
    """

    def __init__(self, time_ns: int, distribution: Distribution | None = None, is_reordering: bool = False) -> None:
        super().__init__(None)
        self._time_ns: Final[int] = _span("delay: time", time_ns)
        self._distribution: Final[Distribution | None] = distribution
        self._is_reordering: Final[bool] = is_reordering
        self._latest: dict[int, int] = {}
        self._rng: Generator | None = None

    def begin(self, now: int, held: dict[int, Frame], rng: Generator) -> bool:
        """Keep the stream."""
        self.saturated = 0
        self._rng = rng
        return True

    def apply(self, now: int, frame: Frame, outlet: Outlet) -> Frame | None:
        """None, or the frame itself when its time is 0."""
        at_ns = now + self._time_ns
        distribution = self._distribution
        if distribution is not None:
            assert self._rng is not None
            drawn = distribution.draw(self._rng)
            at_ns += drawn * distribution.period_ns if distribution.period_ns else drawn
        if not self._is_reordering:
            latest_ns = self._latest.get(frame.can_id, 0)
            if latest_ns > at_ns:
                at_ns = latest_ns
            self._latest[frame.can_id] = at_ns
        if at_ns <= now:
            return frame
        outlet.later(at_ns, frame, not self._is_reordering)
        return None

    def end(self) -> None:
        """Forget the times; the outlet keeps the order with what comes now."""
        self._latest.clear()

    def __reduce__(self) -> tuple[type["Delay"], tuple[int, Distribution | None, bool], dict[str, object]]:
        state: dict[str, object] = {"_latest": self._latest, "_rng": self._rng}
        return Delay, (self._time_ns, self._distribution, self._is_reordering), state


@final
class Resequence(Fault):
    """The frames of each span of time go on in another order, during the span after it.

    span_ns: T > 0; spans count from the start t0 of the activation: s = t0 + kT <= t < s + T for a frame that arrives
    at t. Reversed: it goes on at s + 2T - (t - s), so that the last one comes first and their distances stay.
    is_random: it goes on at s + T + U, U uniform on (0, T], so that every order is equally likely. Either way T later
    on average, and never more than 2T.
    All frames of the target are put in one order, whatever their COB-ID.
    EN 50159: resequencing. FIBlock: none.
    """

    def __init__(self, span_ns: int, is_random: bool = False) -> None:
        super().__init__(None)
        self._span_ns: Final[int] = _span("resequence: span", span_ns)
        if span_ns == 0:
            raise FaultError("resequence: span 0 ns given, allowed 1 ns and more")
        self._is_random: Final[bool] = is_random
        self._start_ns: int = 0
        self._rng: Generator | None = None

    def begin(self, now: int, held: dict[int, Frame], rng: Generator) -> bool:
        """The first span begins."""
        self.saturated = 0
        self._start_ns = now
        self._rng = rng
        return True

    def apply(self, now: int, frame: Frame, outlet: Outlet) -> Frame | None:
        """None; the frame goes on later."""
        span_ns = self._span_ns
        since_ns = (now - self._start_ns) % span_ns
        after_ns = span_ns - since_ns
        if self._is_random:
            assert self._rng is not None
            after_ns = 1 + int(self._rng.random() * span_ns)
        outlet.later(now - since_ns + span_ns + after_ns, frame, False)
        return None

    def __reduce__(self) -> tuple[type["Resequence"], tuple[int, bool], dict[str, object]]:
        state: dict[str, object] = {"_start_ns": self._start_ns, "_rng": self._rng}
        return Resequence, (self._span_ns, self._is_random), state


@final
class Duplicate(Fault):
    """The frame goes on, and copies of it besides: at once, or each `gap_ns` after the one before.

    copies: >= 1 per frame; gap_ns: >= 0.
    EN 50159: repetition. FIBlock: none.
    """

    def __init__(self, copies: int = 1, gap_ns: int = 0) -> None:
        super().__init__(None)
        if copies < 1:
            raise FaultError(f"duplicate: {copies} copies asked for, allowed 1 and more")
        self.adds = True
        self._copies: Final[int] = copies
        self._gap_ns: Final[int] = _span("duplicate: gap", gap_ns)

    def apply(self, now: int, frame: Frame, outlet: Outlet) -> Frame | None:
        """The frame itself."""
        for number in range(1, self._copies + 1):
            if self._gap_ns == 0:
                outlet.insert(frame)
            else:
                outlet.later(now + number * self._gap_ns, frame, False)
        return frame

    def __reduce__(self) -> tuple[type["Duplicate"], tuple[int, int]]:
        return Duplicate, (self._copies, self._gap_ns)


@final
class Replay(Fault):
    """The first frames of the activation are recorded, and sent again for the rest of it, round and round.

    frames: >= 1, how many are recorded of each COB-ID; they pass unchanged. After them every fresh frame is replaced by
    the next recorded one of its COB-ID or, is_adding True, comes after it.
    EN 50159: repetition (old messages sent again), and deletion of the fresh ones unless added. FIBlock: none.
    """

    def __init__(self, frames: int, is_adding: bool = False) -> None:
        super().__init__(None)
        if frames < 1:
            raise FaultError(f"replay: {frames} frames given, allowed 1 and more")
        self.spares = True
        self._frames: Final[int] = frames
        self.adds = is_adding
        self._is_adding: Final[bool] = is_adding
        self._recorded: dict[int, list[Frame]] = {}
        self._sent: dict[int, int] = {}

    def apply(self, now: int, frame: Frame, outlet: Outlet) -> Frame | None:
        """The frame itself while recording, or when adding; else a recorded one."""
        recorded = self._recorded.get(frame.can_id)
        if recorded is None:
            recorded = []
            self._recorded[frame.can_id] = recorded
        if len(recorded) < self._frames:
            recorded.append(frame)
            return frame
        sent = self._sent.get(frame.can_id, 0)
        self._sent[frame.can_id] = sent + 1
        old = recorded[sent % self._frames]
        if not self._is_adding:
            return old
        outlet.insert(old)
        return frame

    def end(self) -> None:
        """Forget the recorded frames."""
        self._recorded.clear()
        self._sent.clear()

    def __reduce__(self) -> tuple[type["Replay"], tuple[int, bool], dict[str, object]]:
        state: dict[str, object] = {"_recorded": self._recorded, "_sent": self._sent}
        return Replay, (self._frames, self._is_adding), state


def _span(what: str, time_ns: int) -> int:
    """The time; raises FaultError when it is none."""
    if not 0 <= time_ns < NEVER:
        raise FaultError(f"{what} {time_ns} ns given, allowed 0..{NEVER - 1} ns")
    return time_ns
