"""What all faults have in common.

Raw values are the integers on the wire; SI units end at the signal.
Every fault can be copied and pickled in mid-run, compiled or not: `__reduce__` gives its arguments and state.
"""

from mypy_extensions import mypyc_attr
from numpy.random import Generator

from canopen_exo.bus.frame import Frame
from canopen_exo.bus.node import NEVER
from canopen_exo.signal import Signal
from fi_gateway.outlet import Outlet


@mypyc_attr(allow_interpreted_subclasses=True)
class Fault:
    """What happens to the frames of an active injector.

    signal: what it acts on, None for the whole payload or frame; saturated: frames of the current or last activation
    whose value was cut at the signal's range; spares: whether `apply` giving the frame itself means it was left alone;
    adds: it sends frames that would not be there without it, or under another COB-ID, so that two nodes may send the
    same id: set by the subclass.
    wake_at: absolute ns while active: when it wants `wake`, to insert frames without being asked; NEVER for not at all.
    Values here are made for one injector and not shared. A subclass that keeps state defines `__reduce__`.
    """

    def __init__(self, signal: Signal | None = None) -> None:
        self.signal: Signal | None = signal
        self.saturated: int = 0
        self.spares: bool = False
        self.adds: bool = False
        self.wake_at: int = NEVER

    def begin(self, now: int, held: dict[int, Frame], rng: Generator) -> bool:
        """The injector activates at `now` [ns]; False: cannot act yet, ask again at the next frame.

        held: the last frame of each target COB-ID that reached the injector before `now` and was long enough for the
        signal, not to be changed or kept; rng: the injector's stream, may be kept.
        """
        self.saturated = 0
        return True

    def fits(self, frame: Frame) -> bool:
        """Whether the fault can act on this frame; if not, it passes unchanged and is counted."""
        return self.signal is None or self.signal.fits(frame.data)

    def apply(self, now: int, frame: Frame, outlet: Outlet) -> Frame | None:
        """The frame that goes on now instead, `frame` itself when nothing changes. It `fits`.

        None: it does not go on now: lost, unless it was given to `outlet.later`.
        """
        raise NotImplementedError

    def wake(self, now: int, outlet: Outlet) -> None:
        """`wake_at` has come: insert what is due and move `wake_at` on."""
        raise NotImplementedError

    def bound(self, end_ns: int) -> None:
        """The window ends at `end_ns`, NEVER when that is not known yet: said after `begin`, and again before `end`."""

    def end(self) -> None:
        """The activation is over: forget what belongs to it."""


def with_payload(frame: Frame, data: bytes) -> Frame:
    """The frame with another payload of the same length; id, flags and raw DLC kept; itself when nothing changes."""
    if data == frame.data:
        return frame
    return Frame(frame.can_id, data, frame.flags, frame.dlc if frame.flags or frame.dlc > 8 else -1)
