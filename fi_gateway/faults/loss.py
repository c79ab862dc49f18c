"""Faults that lose whole frames. EN 50159 class of all: deletion."""

from typing import Final, final

from numpy.random import Generator

from canopen_exo.bus.frame import Frame
from fi_gateway.errors import FaultError
from fi_gateway.faults.base import Fault
from fi_gateway.outlet import Outlet


@final
class Drop(Fault):
    """The frame is lost, each with the given probability (0..1), drawn per frame.

    EN 50159: deletion. FIBlock: none; its Package drop replaces a value and loses no frame.
    """

    def __init__(self, probability: float = 1.0) -> None:
        super().__init__(None)
        if not 0.0 <= probability <= 1.0:
            raise FaultError(f"drop: probability {probability} given, allowed 0..1")
        self.spares = True
        self._probability: Final[float] = probability
        self._rng: Generator | None = None

    def begin(self, now: int, held: dict[int, Frame], rng: Generator) -> bool:
        """Keep the stream."""
        self.saturated = 0
        self._rng = rng
        return True

    def apply(self, now: int, frame: Frame, outlet: Outlet) -> Frame | None:
        """None, or the frame itself when the draw spares it."""
        if self._probability >= 1.0:
            return None
        assert self._rng is not None
        return None if self._rng.random() < self._probability else frame

    def __reduce__(self) -> tuple[type["Drop"], tuple[float], dict[str, object]]:
        state: dict[str, object] = {"_rng": self._rng}
        return Drop, (self._probability,), state


@final
class BurstDrop(Fault):
    """Frames are lost in bursts: a channel that is good or bad loses a frame with loss_good or loss_bad, then changes.

    p: P(good -> bad), r: P(bad -> good), after each frame; loss_good, loss_bad: P(lost) in the state; all 0..1, and not
    both p and r zero. One channel for all frames of the target. It is met in its steady state, bad with probability
    p / (p + r), so that the mean loss (p loss_bad + r loss_good) / (p + r) holds from the first frame of a window on;
    with loss_good 0 and loss_bad 1 bursts are 1 / r frames long on average.
    Source: E. N. Gilbert, "Capacity of a burst-noise channel", Bell Syst. Tech. J. 39 (1960) 1253; E. O. Elliott, same
    journal 42 (1963) 1977.
    EN 50159: deletion. FIBlock: none.
    """

    def __init__(self, p: float, r: float, loss_good: float = 0.0, loss_bad: float = 1.0) -> None:
        super().__init__(None)
        for name, value in (("p", p), ("r", r), ("loss_good", loss_good), ("loss_bad", loss_bad)):
            if not 0.0 <= value <= 1.0:
                raise FaultError(f"drop: {name} {value} given, allowed 0..1")
        if p + r <= 0.0:
            raise FaultError("drop: p and r are both 0, so that the channel has no steady state; give one more than 0")
        self.spares = True
        self._p: Final[float] = p
        self._r: Final[float] = r
        self._loss_good: Final[float] = loss_good
        self._loss_bad: Final[float] = loss_bad
        self._is_bad: bool = False
        self._rng: Generator | None = None

    def begin(self, now: int, held: dict[int, Frame], rng: Generator) -> bool:
        """Keep the stream, and draw the state in which the channel is met."""
        self.saturated = 0
        self._rng = rng
        self._is_bad = rng.random() < self._p / (self._p + self._r)
        return True

    def apply(self, now: int, frame: Frame, outlet: Outlet) -> Frame | None:
        """None, or the frame itself when it gets through."""
        rng = self._rng
        assert rng is not None
        lost = rng.random() < (self._loss_bad if self._is_bad else self._loss_good)
        if rng.random() < (self._r if self._is_bad else self._p):
            self._is_bad = not self._is_bad
        return None if lost else frame

    def __reduce__(self) -> tuple[type["BurstDrop"], tuple[float, float, float, float], dict[str, object]]:
        state: dict[str, object] = {"_is_bad": self._is_bad, "_rng": self._rng}
        return BurstDrop, (self._p, self._r, self._loss_good, self._loss_bad), state
