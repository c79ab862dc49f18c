"""Faults that put frames on the bus which nobody sent like this: added, under another identity, of another length.

Their CRC is valid and they carry no sender: no receiver can tell them from genuine ones by the frame alone.
"""

from typing import Final, final

from numpy.random import Generator

from canopen_exo.bus.frame import Frame
from canopen_exo.bus.node import NEVER
from fi_gateway.errors import FaultError
from fi_gateway.faults.base import Fault
from fi_gateway.outlet import Outlet


@final
class Insert(Fault):
    """Further frames: `frame`, at the start of the activation and then every `every_ns`, or ahead of each target frame.

    every_ns: >= 1, or 0 for one ahead of each target frame. Genuine frames pass unchanged.
    EN 50159: insertion. FIBlock: none.
    """

    def __init__(self, frame: Frame, every_ns: int = 0) -> None:
        super().__init__(None)
        if not 0 <= every_ns < NEVER:
            raise FaultError(f"insert: period {every_ns} ns given, allowed 0..{NEVER - 1} ns")
        self.spares = every_ns > 0
        self.adds = True
        self._frame: Final[Frame] = frame
        self._every_ns: Final[int] = every_ns

    def begin(self, now: int, held: dict[int, Frame], rng: Generator) -> bool:
        """The first one is due now, when it is not to wait for a target frame."""
        self.saturated = 0
        self.wake_at = now if self._every_ns else NEVER
        return True

    def apply(self, now: int, frame: Frame, outlet: Outlet) -> Frame | None:
        """The frame itself."""
        if self._every_ns == 0:
            outlet.insert(self._frame)
        return frame

    def wake(self, now: int, outlet: Outlet) -> None:
        """One frame; the next one a period after this one was due, or more whole ones if that is over."""
        outlet.insert(self._frame)
        self.wake_at += self._every_ns * (1 + max(0, now - self.wake_at) // self._every_ns)

    def end(self) -> None:
        """No more."""
        self.wake_at = NEVER

    def __reduce__(self) -> tuple[type["Insert"], tuple[Frame, int], dict[str, object]]:
        state: dict[str, object] = {"wake_at": self.wake_at}
        return Insert, (self._frame, self._every_ns), state


@final
class Masquerade(Fault):
    """The frame goes on under another COB-ID: one node's message passes for another's.

    cob_id: 0x0..0x7FF; is_copying: the genuine frame goes on as well, after it.
    EN 50159: masquerade (and deletion of the genuine message unless copied). FIBlock: none.
    """

    def __init__(self, cob_id: int, is_copying: bool = False) -> None:
        super().__init__(None)
        if not 0 <= cob_id <= 0x7FF:
            raise FaultError(f"masquerade: COB-ID {cob_id:#x} given, allowed 0x0..0x7ff")
        self.adds = True
        self._cob_id: Final[int] = cob_id
        self._is_copying: Final[bool] = is_copying

    def apply(self, now: int, frame: Frame, outlet: Outlet) -> Frame | None:
        """The forged frame or, when copying, the genuine one."""
        if frame.can_id == self._cob_id:
            return frame
        forged = Frame(self._cob_id, frame.data, frame.flags, frame.dlc if frame.dlc > 8 else -1)
        if not self._is_copying:
            return forged
        outlet.insert(forged)
        return frame

    def __reduce__(self) -> tuple[type["Masquerade"], tuple[int, bool]]:
        return Masquerade, (self._cob_id, self._is_copying)


@final
class CorruptDlc(Fault):
    """The length code is wrong: the frame goes on with another DLC, its payload cut, or filled up with 00.

    dlc: 0..15 (9..15 mean 8 bytes, ISO 11898-1), or -1: for every frame one of 0..8 other than its own length is drawn.
    EN 50159: corruption. FIBlock: none.
    """

    def __init__(self, dlc: int = -1) -> None:
        super().__init__(None)
        if not -1 <= dlc <= 15:
            raise FaultError(f"corrupt_dlc: DLC {dlc} given, allowed 0..15, or -1 for a random one")
        self._dlc: Final[int] = dlc
        self._rng: Generator | None = None

    def begin(self, now: int, held: dict[int, Frame], rng: Generator) -> bool:
        """Keep the stream."""
        self.saturated = 0
        self._rng = rng
        return True

    def apply(self, now: int, frame: Frame, outlet: Outlet) -> Frame | None:
        """The frame with the other length code."""
        dlc = self._dlc
        size = len(frame.data)
        if dlc < 0:
            assert self._rng is not None
            dlc = int(self._rng.random() * 8)
            if dlc >= size:
                dlc += 1
        if dlc == frame.dlc:
            return frame
        length = dlc if dlc < 8 else 8
        data = frame.data[:length] if length <= size else frame.data + bytes(length - size)
        return Frame(frame.can_id, data, frame.flags, dlc)

    def __reduce__(self) -> tuple[type["CorruptDlc"], tuple[int], dict[str, object]]:
        state: dict[str, object] = {"_rng": self._rng}
        return CorruptDlc, (self._dlc,), state
