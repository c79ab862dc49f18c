"""Recorded activations, applied again: windows are given, and nothing about when and how long is drawn.

What a fault itself draws while it is active (bits to flip, frames to lose) comes from its stream, which is put where it
stood when the recorded window opened. So the same rig gives the same frames again, and another rig meets the same
faults.
"""

from dataclasses import dataclass
from typing import Final, final

from numpy.random import Generator

from canopen_exo.bus.node import NEVER
from fi_gateway.effects import Effect
from fi_gateway.events import Event
from fi_gateway.rng_state import restore


@dataclass(frozen=True, slots=True)
class Window:
    """One recorded activation. Times in ns from what the injector's times count from; end_ns NEVER: it had no end.

    stream: where the injector's random stream stood before the fault began, and, after a "/", once the window was open,
    if something was drawn between; "" when it is not known.
    """

    start_ns: int
    end_ns: int
    stream: str = ""


@final
class Recording:
    """The windows of one injector in order, and which of them comes next. rng: the injector's stream.

    Windows without length, as a command can leave them, met no frame and are left out.
    """

    def __init__(self, windows: tuple[Window, ...], rng: Generator) -> None:
        self._windows: Final[tuple[Window, ...]] = tuple(one for one in windows if one.end_ns > one.start_ns)
        self._rng: Final[Generator] = rng
        self._next: int = 0
        self._start_ns: int = 0

    def announce(self, after: int) -> int:
        """When the next window opens [ns], not before `after`; NEVER for no more."""
        while self._next < len(self._windows) and self._windows[self._next].end_ns <= after:
            self._next += 1
        if self._next == len(self._windows):
            return NEVER
        window = self._windows[self._next]
        before, _, _ = window.stream.partition("/")
        if before:
            restore(self._rng, before)
        self._start_ns = max(window.start_ns, after)
        return self._start_ns

    def open(self) -> int:
        """The announced window opens: its length [ns], NEVER for no limit."""
        window = self._windows[self._next]
        _, _, after = window.stream.partition("/")
        if after:
            restore(self._rng, after)
        self._next += 1
        return NEVER if window.end_ns >= NEVER else window.end_ns - self._start_ns

    def __reduce__(self) -> tuple[type["Recording"], tuple[tuple[Window, ...], Generator], dict[str, object]]:
        state: dict[str, object] = {"_next": self._next, "_start_ns": self._start_ns}
        return Recording, (self._windows, self._rng), state


@final
class RecordedEvent(Event):
    """The windows of a recording, in their order."""

    def __init__(self, recording: Recording) -> None:
        self._recording: Final[Recording] = recording

    def next(self, after: int) -> int:
        """The start of the next window."""
        return self._recording.announce(after)

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
