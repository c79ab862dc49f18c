"""Recorded activations, applied again: windows are given, and nothing about when and how long is drawn.

What a fault itself draws while it is active (bits to flip, frames to lose) comes from its stream, which is put where it
stood when the recorded window opened. So the same rig gives the same frames again, and another rig meets the same
faults.
Left out: the order of what happens within one nanosecond when several frames are under way in it. A frame that ends a
window (`until`) is met after all if one that a fault had put off or added was met just before it; and where two faults
add frames with one and the same frame, one of them by its own clock, a third fault meets that one's first.
"""

from dataclasses import dataclass
from typing import Final, final

from numpy.random import Generator

from canopen_exo.bus.frame import Frame
from canopen_exo.bus.node import NEVER
from fi_gateway.effects import Effect
from fi_gateway.events import Event
from fi_gateway.rng_state import restore


@dataclass(frozen=True, slots=True)
class Window:
    """One recorded activation. Times in ns from what the injector's times count from; end_ns NEVER: it had no end.

    stream: where the fault's random stream stood when it began, "" when it is not known; skipped: target frames of the
    instant start_ns that had passed before the one with which it opened.
    """

    start_ns: int
    end_ns: int
    stream: str = ""
    skipped: int = 0


@final
class Recording:
    """The windows of one injector in order, and which of them comes next. rng: the stream of its fault.

    Windows without length, as a command can leave them, met no frame and are left out.
    """

    def __init__(self, windows: tuple[Window, ...], rng: Generator) -> None:
        self.windows: Final[tuple[Window, ...]] = tuple(one for one in windows if one.end_ns > one.start_ns)
        self._rng: Final[Generator] = rng
        self._next: int = 0
        self._start_ns: int = 0
        self._passed: int = 0

    def announce(self, after: int) -> int:
        """When the next window opens by itself [ns], not before `after`; NEVER for no more."""
        while self._next < len(self.windows) and self.windows[self._next].end_ns <= after:
            self._next += 1
        self._passed = 0
        if self._next == len(self.windows):
            return NEVER
        window = self.windows[self._next]
        if window.stream:
            restore(self._rng, window.stream)
        self._start_ns = max(window.start_ns + (1 if window.skipped else 0), after)
        return self._start_ns

    def meet(self, now: int) -> bool:
        """A target frame comes at `now`; whether the announced window opens with it."""
        if self._next == len(self.windows):
            return False
        window = self.windows[self._next]
        if window.skipped == 0 or now != window.start_ns:
            return False
        self._passed += 1
        if self._passed <= window.skipped:
            return False
        self._start_ns = now
        return True

    def open(self) -> int:
        """The announced window opens: its length [ns], NEVER for no limit."""
        window = self.windows[self._next]
        self._next += 1
        return NEVER if window.end_ns >= NEVER else window.end_ns - self._start_ns

    def __reduce__(self) -> tuple[type["Recording"], tuple[tuple[Window, ...], Generator], dict[str, object]]:
        state: dict[str, object] = {"_next": self._next, "_start_ns": self._start_ns, "_passed": self._passed}
        return Recording, (self.windows, self._rng), state


@final
class RecordedEvent(Event):
    """The windows of a recording, in their order."""

    def __init__(self, recording: Recording) -> None:
        super().__init__((), any(one.skipped for one in recording.windows))
        self._recording: Final[Recording] = recording

    def next(self, after: int) -> int:
        """The start of the next window."""
        return self._recording.announce(after)

    def observe(self, now: int, frame: Frame) -> bool:
        """Whether it is the frame with which the next window opened, others of that instant having passed."""
        return self._recording.meet(now)

    def __reduce__(self) -> tuple[type["RecordedEvent"], tuple[Recording]]:
        return RecordedEvent, (self._recording,)


@final
class RecordedEffect(Effect):
    """As long as recorded. frames: as the recorded effect had it, so that of two frames at one instant one is hit."""

    def __init__(self, recording: Recording, frames: int) -> None:
        super().__init__(frames, True)
        self._recording: Final[Recording] = recording

    def duration(self) -> int:
        """The length of the window."""
        return self._recording.open()

    def __reduce__(self) -> tuple[type["RecordedEffect"], tuple[Recording, int]]:
        return RecordedEffect, (self._recording, self.frames)
