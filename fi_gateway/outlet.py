"""Where an active fault sends what does not simply go on: later, or in addition.

The gateway gives an `Outlet` with each call of a fault, and carries out what was asked when the call is over.
Leaves out: a way back; what was sent later cannot be called off.
"""

from typing import Final, final

from mypy_extensions import mypyc_attr

from canopen_exo.bus.frame import Frame
from fi_gateway.repair import Repair


@mypyc_attr(allow_interpreted_subclasses=True)
class Outlet:
    """Where an active fault sends what does not simply go on; given per call, never kept."""

    def later(self, at_ns: int, frame: Frame, in_order: bool) -> None:
        """`frame` goes on at `at_ns` (>= now) from behind this injector: those written after it act on it then.

        in_order: frames of its COB-ID that arrive until then wait behind it, also after the window has closed.
        """
        raise NotImplementedError

    def insert(self, frame: Frame) -> None:
        """A further frame, at once, before whatever `apply` returns; from behind this injector as well."""
        raise NotImplementedError


@final
class Later:
    """A frame that goes on at `at_ns`."""

    def __init__(self, at_ns: int, frame: Frame, in_order: bool) -> None:
        self.at_ns: Final[int] = at_ns
        self.frame: Final[Frame] = frame
        self.in_order: Final[bool] = in_order


@final
class Line:
    """Frames of one COB-ID that wait behind an injector in the order they came. at_ns: when the last one goes on."""

    def __init__(self, at_ns: int) -> None:
        self.at_ns: int = at_ns
        self.waiting: int = 0

    def __reduce__(self) -> tuple[type["Line"], tuple[int], dict[str, object]]:
        return Line, (self.at_ns,), {"waiting": self.waiting}


@final
class Tray(Outlet):
    """Keeps what one call of a fault has sent, in order, until it is taken. used: there is something."""

    def __init__(self) -> None:
        self.used: bool = False
        self.late: list[Later] = []
        self.inserted: list[Frame] = []

    def later(self, at_ns: int, frame: Frame, in_order: bool) -> None:
        """Keep it."""
        self.used = True
        self.late.append(Later(at_ns, frame, in_order))

    def insert(self, frame: Frame) -> None:
        """Keep it."""
        self.used = True
        self.inserted.append(frame)

    def repair(self, repair: Repair, arrived: Frame | None) -> None:
        """Put right what lies here and is not the frame that arrived (None: there was none)."""
        for at, one in enumerate(self.late):
            self.late[at] = Later(one.at_ns, repair.frame(arrived, one.frame), one.in_order)
        for at, frame in enumerate(self.inserted):
            self.inserted[at] = repair.frame(arrived, frame)

    def clear(self) -> None:
        """Empty; the lists themselves stay with whoever took them."""
        self.used = False
        self.late = []
        self.inserted = []
