"""The record of one activation of an injector: when, why, and what became of the frames.

Three counts are kept apart, as in fault-injection practice: activated (windows that opened), injected (target frames
the fault acted on, attempts to send that a wire fault disturbed) and manifested (frames changed, lost, delayed or
inserted, and those attempts). A frame that is inserted, or waits behind a late one, manifests and is not injected.
"""

from typing import Final, final

from canopen_exo.bus.frame import Frame
from canopen_exo.bus.node import NEVER

_STATE: Final = (
    "end_ns",
    "frames_seen",
    "frames_unfit",
    "frames_injected",
    "frames_changed",
    "frames_lost",
    "frames_delayed",
    "frames_inserted",
    "attempts_seen",
    "attempts_disturbed",
    "saturated",
    "first_before",
    "first_after",
    "first_ns",
    "skipped",
    "stream",
)
"""What `__reduce__` copies besides the constructor arguments."""


@final
class Activation:
    """One activation. Times in ns on the loop's clock.

    injector, index: name, and number of the activation from 0; signal: "node.name", for whole frames the target's name;
    cause: "event", "trigger:<name>" ("trigger:<a>+<b>" for all of them), "frame:0x6F0" or "command"; due_ns: the time
    drawn, given, triggered (delay included) or commanded;
    start_ns: first instant of the window, later than due_ns when the fault had to wait for a value, and 1 ns later when
    a target frame had passed the injector in that instant already;
    duration_ns: as drawn or given, NEVER for no limit;
    end_ns: first instant outside the window, as planned until it closes; a window without limit keeps NEVER.
    frames_seen: target frames that reached it; frames_unfit: of those, too short to act on; frames_injected: acted on
    (a drop that spares a frame does not act on it); of those seen, each at most once: frames_changed: went on at once
    with other content; frames_lost; frames_delayed: went on later, changed or not, or waited behind one that did.
    frames_inserted: further frames. Of a wire fault, attempts_seen: attempts to send a target frame while the window
    was open, a retransmission being one of its own; attempts_disturbed: those, or idle times, in which somebody noticed
    an error, or the bus-off that it made.
    saturated: values cut at the signal's range; first_before, first_after: the first frame hit (first_after None: it
    was lost, or disturbed on its way; first_before None: it was inserted without one arriving); first_ns: when that
    was, NEVER while there is none.
    For a replay: skipped: target frames of the instant start_ns that had passed before the one with which it opened;
    stream: where the fault's random stream stood when it began (`rng_state`).
    """

    def __init__(
        self, injector: str, index: int, signal: str, cause: str, due_ns: int, start_ns: int, duration_ns: int
    ) -> None:
        self.injector: Final[str] = injector
        self.index: Final[int] = index
        self.signal: Final[str] = signal
        self.cause: Final[str] = cause
        self.due_ns: Final[int] = due_ns
        self.start_ns: Final[int] = start_ns
        self.duration_ns: Final[int] = duration_ns
        self.end_ns: int = min(start_ns + duration_ns, NEVER)
        self.frames_seen: int = 0
        self.frames_unfit: int = 0
        self.frames_injected: int = 0
        self.frames_changed: int = 0
        self.frames_lost: int = 0
        self.frames_delayed: int = 0
        self.frames_inserted: int = 0
        self.attempts_seen: int = 0
        self.attempts_disturbed: int = 0
        self.saturated: int = 0
        self.first_before: Frame | None = None
        self.first_after: Frame | None = None
        self.first_ns: int = NEVER
        self.skipped: int = 0
        self.stream: str = ""

    @property
    def manifested(self) -> int:
        """Frames changed, lost, delayed or inserted, and attempts disturbed."""
        frames = self.frames_changed + self.frames_lost + self.frames_delayed + self.frames_inserted
        return frames + self.attempts_disturbed

    def count_passage(self, frame: Frame, result: Frame | None, late: int, inserted: int) -> int:
        """Count a frame that is lost, late, or did not stay alone; late, inserted: frames; how many have manifested."""
        if result is None and late:
            late -= 1
            self.frames_delayed += 1
        elif result is None:
            self.frames_lost += 1
        elif result != frame:
            self.frames_changed += 1
        self.frames_inserted += late + inserted
        return late + inserted + (1 if result is None or result != frame else 0)

    def __reduce__(
        self,
    ) -> tuple[type["Activation"], tuple[str, int, str, str, int, int, int], dict[str, object]]:
        given = (self.injector, self.index, self.signal, self.cause, self.due_ns, self.start_ns, self.duration_ns)
        return Activation, given, {name: getattr(self, name) for name in _STATE}
