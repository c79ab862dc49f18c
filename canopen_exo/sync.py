"""SYNC: producer and consumer.

Source: CiA 301, 7.2.5 (synchronisation object), objects 0x1005, 0x1006 (communication cycle period) and 0x1019
(synchronous counter overflow value: the counter runs 1..overflow).
The loss of SYNC after a number of periods is a drive's own supervision (no CiA 301 object states it).
"""

from typing import Final, final

from canopen_exo.bus.frame import Frame
from canopen_exo.bus.node import MS, NEVER
from canopen_exo.plan import SYNC

_PAUSE_NS: Final = 100 * MS
"""Five of the longest cycles: a SYNC after such a silence begins anew."""

_CERTAIN_NS: Final = 200 * MS
_CERTAIN_SHARE: Final = 50
"""No lateness makes as much, and no two clocks are 1/50 apart: the producer has another cycle."""


@final
class SyncProducer:
    """Makes the SYNC frames. counter: the last one sent, 0 before the first; overflow 0: SYNC without data.

    There are only so many different ones: each is made, and measured, once.
    """

    def __init__(self, overflow: int) -> None:
        self.overflow: Final[int] = overflow
        self.counter: int = 0
        self._frames: Final[list[Frame]] = [Frame(SYNC, b"")]
        for counter in range(1, overflow + 1):
            self._frames.append(Frame(SYNC, bytes((counter,))))

    def next(self) -> Frame:
        """The next SYNC frame."""
        if self.overflow:
            self.counter = self.counter % self.overflow + 1
        return self._frames[self.counter]


@final
class SyncConsumer:
    """Checks and watches SYNC for one device.

    overflow: 0x1019; size: bytes of a SYNC. timeout_ns: silence after which SYNC counts as lost, 0 = not watched.
    is_steady: the next SYNC of that size does no more than move `last`.
    Watching starts with the first SYNC and is lazy: `last` moves with every SYNC, `deadline` only when it is reached.
    """

    def __init__(self, overflow: int, timeout_ns: int) -> None:
        self.overflow: Final[int] = overflow
        self.timeout_ns: Final[int] = timeout_ns
        self.size: Final[int] = 1 if overflow else 0
        self.last: int = NEVER
        self.deadline: int = NEVER
        self.lost: bool = False
        self.is_steady: bool = False

    def received(self, now: int, data: bytes) -> bool:
        """Take a SYNC; False when its length does not fit 0x1019 (EMCY 8240), and it is not served."""
        if len(data) != self.size:
            return False
        self.last = now
        if self.deadline == NEVER and self.timeout_ns:
            self.deadline = now + self.timeout_ns
        self.lost = False
        self.is_steady = True
        return True

    def stop(self) -> None:
        """Watch no more until the next SYNC."""
        self.deadline = NEVER
        self.lost = False
        self.is_steady = False

    def wake(self, now: int) -> bool:
        """True once, when SYNC has been silent for the time-out. Looking early moves the deadline on."""
        if self.deadline == NEVER:
            return False
        self.deadline = self.last + self.timeout_ns
        if now < self.deadline:
            return False
        self.deadline = NEVER
        self.lost = True
        self.is_steady = False
        return True


@final
class SyncCadence:
    """Whether SYNC comes as often as was said. cycle_ns: that; last: when the last one came, ns."""

    def __init__(self, cycle_ns: int, first: int = -NEVER, last: int = -NEVER, count: int = 0) -> None:
        self.cycle_ns: Final[int] = cycle_ns
        self.last: int = last
        self._first: int = first
        self._count: int = count

    def received(self, now: int) -> None:
        """A SYNC came."""
        if now - self.last > _PAUSE_NS:
            self._first = now
            self._count = 0
        else:
            self._count += 1
        self.last = now

    @property
    def other_ns(self) -> int:
        """The producer's cycle, when it is certainly not `cycle_ns`; 0: it is, or too few have come to tell."""
        due_ns = self._count * self.cycle_ns
        off_ns = abs(self.last - self._first - due_ns)
        if off_ns <= _CERTAIN_NS or off_ns * _CERTAIN_SHARE <= due_ns:
            return 0
        return (self.last - self._first) // self._count

    def words(self) -> str:
        """That it is another, and what to do; "" when it is not."""
        other_ns = self.other_ns
        if not other_ns:
            return ""
        return (
            f"SYNC comes every {other_ns / 1e6:.2f} ms, rig.rate here says {self.cycle_ns / 1e6:g} ms "
            f"({1e9 / self.cycle_ns:g} Hz); give all processes of a rig the same rig.rate"
        )

    def __reduce__(self) -> tuple[type["SyncCadence"], tuple[int, int, int, int]]:
        return SyncCadence, (self.cycle_ns, self._first, self.last, self._count)
