"""The short way through the real-time loop: what a Relay only passes on goes as the record that came.

Two channels that carry records, and a node that says which COB-IDs it has nothing to do with (`Relay.passes`): runs of
such frames go out of the buffers they were read into, many with one call, and nothing is made of them. A frame between
them is made and given to the node, at its place in the order of (stamp, channel, order of arrival). What the node sees,
and what goes out on either bus, is as if it had been given all of them; only frames that pass in opposite directions
may go in another order than they came in.
As soon as something is in the way, the loop serves what is left frame by frame: another kind of frame or a notice has
come, a wake-up is due among the frames, the relay has more to do with all of them, or a channel takes no more.
"""

from bisect import bisect_left, bisect_right
from collections.abc import Callable
from typing import Final, final

from canopen_exo.bus.channel import Arrival, RecordChannel
from canopen_exo.bus.node import NEVER, Relay
from canopen_exo.bus.realtime_out import Line, RealTimeOut

_PLACES: Final = (0, 1)
_NOTHING: Final[list[list[Arrival]]] = []

Deliver = Callable[[Line, Arrival, int], None]
"""Gives an arrival to the node; no stamp counts as later than the time given."""


@final
class ShortCut:
    """Serves what comes on two channels. deliver: the loop's; clock: loop time, of sending, for the line's latency."""

    def __init__(
        self,
        relay: Relay,
        channels: list[RecordChannel],
        lines: list[Line],
        out: RealTimeOut,
        deliver: Deliver,
        clock: Callable[[], int] | None,
    ) -> None:
        self._relay: Final[Relay] = relay
        self._channels: Final[list[RecordChannel]] = channels
        self._lines: Final[list[Line]] = lines
        self._out: Final[RealTimeOut] = out
        self._deliver: Final = deliver
        self._clock: Final = clock
        self._at: Final[list[int]] = [0, 0]  # by place: how many of those that came have been served
        self._ends: Final[list[int]] = [0, 0]
        self._tables: Final[list[bytearray | None]] = [None, None]  # by place: what `_passing` was made with
        self._passing: Final[list[bytes]] = [b"", b""]

    def serve(self, now: int, readable: list[int]) -> list[list[Arrival]]:
        """Read what has come and serve it; what is left, by place."""
        at, ends = self._at, self._ends
        at[0] = at[1] = 0
        is_plain = True
        for place in _PLACES:
            channel = self._channels[place]
            if self._lines[place].fd in readable or channel.poll_at <= now:
                if not channel.read():
                    is_plain = False
                ends[place] = channel.count
            else:
                ends[place] = 0
        if is_plain:
            if ends[0] + ends[1] == 1 and self._pass_one(ends[1]):
                return _NOTHING
            self._serve_runs()
            if at == ends:
                return _NOTHING
        left: list[list[Arrival]] = []
        for place in _PLACES:
            left.append([self._channels[place].arrival(number) for number in range(at[place], ends[place])])
        return left

    def _pass_one(self, place: int) -> bool:
        """As `_serve_runs` for one frame, which is what a bus that is not crowded gives."""
        relay, source, line = self._relay, self._channels[place], self._lines[1 - place]
        stamp = source.stamps[0]
        if (
            relay.passes[place][source.ids[0]]
            and relay.wake_at >= stamp
            and not relay.is_disturbed
            and not line.waiting
            and self._channels[1 - place].send_run(source, 0, 1)
        ):
            relay.frames[place] += 1
            if stamp > self._out.served_ns:
                self._out.served_ns = stamp
            if self._clock is not None:
                line.latency.add(self._clock() - stamp)
            return True
        return False

    def _serve_runs(self) -> None:
        """Base data frames alone."""
        at, ends, relay, lines = self._at, self._ends, self._relay, self._lines
        latest = -NEVER
        for place in _PLACES:
            self._tables[place] = None
            if ends[place] and self._channels[place].stamps[-1] > latest:
                latest = self._channels[place].stamps[-1]
        while at != ends:
            if relay.is_disturbed or relay.wake_at < latest or lines[0].waiting or lines[1].waiting:
                return
            stop_place, limits = self._find_stop()
            for place in _PLACES:
                if at[place] < limits[place] and not self._pass_on(place, limits[place]):
                    return
            if stop_place >= 0:
                number = at[stop_place]
                at[stop_place] += 1
                arrival = self._channels[stop_place].arrival(number)
                self._deliver(lines[stop_place], arrival, arrival.stamp_ns)

    def _find_stop(self) -> tuple[int, list[int]]:
        """Where the next frame that does not only pass came, -1 for none, and up to where frames pass before it."""
        at, ends = self._at, self._ends
        found = -1
        first = NEVER
        limits = [ends[0], ends[1]]
        for place in _PLACES:
            if at[place] == ends[place]:
                continue
            channel = self._channels[place]
            table = self._relay.passes[place]
            if table is not self._tables[place]:
                self._tables[place] = table
                self._passing[place] = bytes([table[can_id] for can_id in channel.ids])
            number = self._passing[place].find(0, at[place])
            if number >= 0 and channel.stamps[number] < first:
                found = place
                first = channel.stamps[number]
                limits[place] = number
        if found >= 0 and at[1 - found] < ends[1 - found]:  # where stamps are equal, what came on the first goes first
            before = bisect_right if found else bisect_left
            limits[1 - found] = before(self._channels[1 - found].stamps, first, at[1 - found], ends[1 - found])
        return found, limits

    def _pass_on(self, place: int, limit: int) -> bool:
        """Send what came on a channel up to `limit` on the other one; False when that did not take all of it."""
        source = self._channels[place]
        start = self._at[place]
        end = start + self._channels[1 - place].send_run(source, start, limit)
        if end > start:
            self._at[place] = end
            self._relay.frames[place] += end - start
            if source.stamps[end - 1] > self._out.served_ns:
                self._out.served_ns = source.stamps[end - 1]
            if self._clock is not None:
                self._lines[1 - place].latency.add_since(source.stamps[start:end], self._clock())
        return end == limit
