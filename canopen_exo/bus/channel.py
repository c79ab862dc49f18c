"""One real interface as the real-time loop sees it: frames and notices with a time, a way to send, nothing that blocks.

A channel is a leaf: SocketCAN (`socketcan`), any python-can bus (`adapter`) or the hub's client. Its times are on the
loop's clock: nanoseconds of CLOCK_MONOTONIC since `epoch_ns`, which the loop sets before its first call.
Error frames never pass as frames: the channel turns them into PortState notices (`error_frame`), whose port is 0 until
the loop puts in the node's own.
Leaves out: hardware time stamps (an adapter's own clock is not the loop's).
"""

import time
from typing import Final, final

from mypy_extensions import mypyc_attr

from canopen_exo.bus.frame import Frame
from canopen_exo.bus.node import MS, NEVER, SECOND, PortState

_COMPARISONS: Final = 5
_COMPARED_WITHIN_NS: Final = 5_000
"""A process that is interrupted between two clocks compares them again, four times at most; the closest counts."""

_COMPARED_FOR_NS: Final = MS
"""How long a comparison holds: a wall clock that is being slewed drifts by 0.5 us in it (500 ppm, adjtimex(2))."""

_COMPARED_FOR_TIMES: Final = 100
_COMPARED_FOR_MOST_NS: Final = 10 * MS
"""Where clocks are dear it holds that many times as long as the fastest one took, at most 10 ms and then 5 us: it takes
1 % of the time."""


@final
class Arrival:
    """A frame that came, or a notice about the interface; exactly one of the two. stamp_ns: end of the frame."""

    __slots__ = ("frame", "stamp_ns", "state")

    def __init__(self, stamp_ns: int, frame: Frame | None, state: PortState | None) -> None:
        self.stamp_ns: Final[int] = stamp_ns
        self.frame: Final[Frame | None] = frame
        self.state: Final[PortState | None] = state


@mypyc_attr(allow_interpreted_subclasses=True)
class Channel:
    """One interface. Never blocks and, once open, never raises: what goes wrong becomes a notice and a count.

    name: as on the command line, "socketcan:vcan0". epoch_ns: time 0 of its stamps on CLOCK_MONOTONIC.
    overruns: frames the kernel or the hub says it dropped before we read them; malformed: records that are no frame.
    errors: error frames seen; lost: frames given to `send` that the interface could not take (away, or refused).
    poll_at: loop time [ns] at which `receive` is to be called though nothing is readable (to reopen, to hand out a
    notice, or because the interface has no file descriptor); NEVER for none.
    send_at: after a `send` that gave False, loop time [ns] of the next attempt; 0 for as soon as it is writable.
    is_stamped: its stamps say when a frame came, however late it is read.
    """

    def __init__(self, name: str) -> None:
        self.name: Final[str] = name
        self.epoch_ns: int = 0
        self.overruns: int = 0
        self.malformed: int = 0
        self.errors: int = 0
        self.lost: int = 0
        self.poll_at: int = NEVER
        self.send_at: int = 0
        self.is_stamped: bool = False

    def fileno(self) -> int:
        """What select waits on; -1 while the interface is away or when it has no file descriptor."""
        raise NotImplementedError

    def receive(self) -> list[Arrival]:
        """All that has come, oldest first: drained until it would block."""
        raise NotImplementedError

    def send(self, frame: Frame) -> bool:
        """Hand a frame over. False: it would block now, offer it again; True: taken, or counted in `lost`."""
        raise NotImplementedError

    def close(self) -> None:
        """Let the interface go; a second call does nothing."""
        raise NotImplementedError

    def count_overruns(self) -> None:
        """Bring `overruns` up to date, where it is told with the next frame only; for statistics, not per frame."""


@mypyc_attr(allow_interpreted_subclasses=True)
class RecordChannel(Channel):
    """A channel whose base data frames (11-bit id, 0..8 bytes) can go, as the bytes that came, to another one.

    Of the last `read` - count: what it found; ids, and after `stamp` stamps: of each, when it found nothing but base
    data frames. The stamps never go back.
    """

    def __init__(self, name: str) -> None:
        super().__init__(name)
        self.count: int = 0
        self.ids: list[int] = []
        self.stamps: list[int] = []

    def read(self) -> bool:
        """As `receive`, but keep what came until the next call; False when it is not base data frames alone."""
        raise NotImplementedError

    def stamp(self) -> None:
        """Work out `stamps`, once after a `read` that gave True: it takes about as long as passing frames on."""
        raise NotImplementedError

    def arrival(self, number: int) -> Arrival:
        """One of those that the last `read` found."""
        raise NotImplementedError

    def send_run(self, source: "RecordChannel", start: int, end: int) -> int:
        """Hand over base data frames that the last `read` of `source`, of the same class, found, from start up to end.

        How many were taken; the next one is to be given to `send`, which sees to what is in its way.
        """
        raise NotImplementedError


@final
class StampClock:
    """Stamps of CLOCK_REALTIME (the kernel's, python-can's) on the loop's clock.

    Both clocks are compared anew for every batch, at most once a millisecond (where clocks are dear more rarely, every
    10 ms at least), so a corrected wall clock does little harm: a stamp lies between the one before it and now,
    whatever the wall clock did meanwhile. `begin` comes after the reading: what arrives between the two, while the
    process is held up, would count as earlier than it was sent. The difference found holds until a comparison
    contradicts it, so one that was interrupted does not spoil it.
    now: of the last `begin`; offset: what to take from a stamp, ns; last: the stamp given last.
    """

    def __init__(self) -> None:
        self.now: int = 0
        self.offset: int = 0
        self.last: int = -NEVER
        self._epoch_ns: int = 0
        self._compare_at: int = -NEVER
        self._cost_ns: int = NEVER

    def begin(self, epoch_ns: int) -> int:
        """Compare the clocks when it is time to; returns now on the loop's clock [ns]."""
        after = time.monotonic_ns()
        if after >= self._compare_at or epoch_ns != self._epoch_ns:
            after = self._compare(epoch_ns, after)
        self.now = after - epoch_ns
        return self.now

    def _compare(self, epoch_ns: int, began: int) -> int:
        """Find the difference of the clocks, unless the known one will do. began: CLOCK_MONOTONIC; returns it anew."""
        is_known = epoch_ns == self._epoch_ns and self._compare_at != -NEVER
        tightest = NEVER
        after = began
        for _ in range(_COMPARISONS):
            before = after
            wall = time.time_ns()
            after = time.monotonic_ns()
            self._cost_ns = min(self._cost_ns, after - before)
            least, most = wall - after + epoch_ns, wall - before + epoch_ns
            if is_known and least <= self.offset <= most:
                break
            is_known = False
            if most - least < tightest:
                tightest = most - least
                self.offset = (least + most) // 2
            if tightest < _COMPARED_WITHIN_NS:
                break
        self._epoch_ns = epoch_ns
        held = max(_COMPARED_FOR_NS, min(_COMPARED_FOR_TIMES * self._cost_ns, _COMPARED_FOR_MOST_NS))
        self._compare_at = after + held
        return after

    def at(self, realtime_ns: int) -> int:
        """A stamp of CLOCK_REALTIME [ns] on the loop's clock."""
        stamp = realtime_ns - self.offset
        if stamp > self.now:
            stamp = self.now
        if stamp < self.last:
            stamp = self.last
        self.last = stamp
        return stamp

    def many(self, seconds: list[int], nanos: list[int]) -> list[int]:
        """As `at` for at least one stamp of CLOCK_REALTIME, in two parts."""
        if seconds.count(seconds[0]) == len(seconds):
            start = seconds[0] * SECOND - self.offset
            stamps = [start + nano for nano in nanos]
        else:
            stamps = [second * SECOND + nano - self.offset for second, nano in zip(seconds, nanos, strict=True)]
        if stamps[0] < self.last or stamps[-1] > self.now or stamps != sorted(stamps):
            return [self.at(stamp + self.offset) for stamp in stamps]
        self.last = stamps[-1]
        return stamps
