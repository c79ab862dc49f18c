"""The short way through the real-time loop: what a Relay only passes on goes as the record that came.

Two channels that carry records, and a node that says which COB-IDs it has nothing to do with (`Relay`): runs of
such frames go out of the buffers they were read into, many with one call, and nothing is made of them. A frame between
them is made and given to the node. What the node sees, and when, is as if it had been given all of them, and so is what
goes out on each bus; only what the node adds to one direction because of a frame from the other one may go before
frames that had come in the same turn.
As soon as something is in the way, the loop serves what is left frame by frame: another kind of frame or a notice has
come, a wake-up is due among the frames, the relay filters otherwise than before, or a channel takes no more.
"""

from collections.abc import Callable
from typing import Final, final

from canopen_exo.bus.channel import Arrival, RecordChannel
from canopen_exo.bus.node import NEVER, PASS_ON, Relay
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
        self._ways: Final = [(place, lines[place], channels[place]) for place in _PLACES]
        self._out: Final[RealTimeOut] = out
        self._deliver: Final = deliver
        self._clock: Final = clock
        self._at: Final[list[int]] = [0, 0]  # by place: how many of those that came have been served
        self._ends: Final[list[int]] = [0, 0]

    def serve(self, now: int, readable: list[int]) -> list[list[Arrival]]:
        """Read what has come and serve it; what is left, by place."""
        at, ends = self._at, self._ends
        at[0] = at[1] = 0
        is_plain = True
        for place, line, channel in self._ways:
            if line.fd in readable or channel.poll_at <= now:
                if not channel.read():
                    is_plain = False
                ends[place] = channel.count
            else:
                ends[place] = 0
        if is_plain:
            if ends[0] + ends[1] == 1:
                self._serve_one(ends[1])
                return _NOTHING
            self._serve_runs()
            if at == ends:
                return _NOTHING
        left: list[list[Arrival]] = []
        for place in _PLACES:
            left.append([self._channels[place].arrival(number) for number in range(at[place], ends[place])])
        return left

    def _serve_one(self, place: int) -> None:
        """A base data frame alone, which is what a bus that is not crowded gives."""
        relay, source, line = self._relay, self._channels[place], self._lines[1 - place]
        stamp = source.stamps[0]
        if (
            relay.filters[place][source.ids[0]] == PASS_ON
            and relay.wake_at >= stamp
            and not line.waiting
            and self._channels[1 - place].send_run(source, 0, 1)
        ):
            relay.frames[place] += 1
            if stamp > self._out.served_ns:
                self._out.served_ns = stamp
            if self._clock is not None:
                line.latency.add(self._clock() - stamp)
        else:
            self._deliver(self._lines[place], source.arrival(0), stamp)

    def _serve_runs(self) -> None:
        """Base data frames alone, until all are served or something is in the way."""
        at, ends = self._at, self._ends
        filters = [bytearray(one) for one in self._relay.filters]
        latest = -NEVER
        stops: list[tuple[int, int, int]] = []  # stamp, place and number of those that do not only pass
        for place, _, channel in self._ways:
            if ends[place]:
                table, stamps = filters[place], channel.stamps
                if stamps[-1] > latest:
                    latest = stamps[-1]
                stops += [
                    (stamps[number], place, number) for number, one in enumerate(channel.ids) if table[one] != PASS_ON
                ]
        if ends[0] and ends[1]:
            stops.sort()
        for stamp, place, number in stops:
            if not self._is_free(latest, filters) or (at[place] < number and not self._pass_on(place, number)):
                return
            at[place] = number + 1
            self._deliver(self._lines[place], self._channels[place].arrival(number), stamp)
        for place in _PLACES:
            if at[place] < ends[place] and not (self._is_free(latest, filters) and self._pass_on(place, ends[place])):
                return
        if latest > self._out.served_ns:
            self._out.served_ns = latest

    def _is_free(self, latest: int, filters: list[bytearray]) -> bool:
        """Whether nothing is in the way of frames up to the stamp `latest`, and what passes is what passed before."""
        relay, lines = self._relay, self._lines
        if relay.wake_at < latest or lines[0].waiting or lines[1].waiting:
            return False
        return relay.filters == filters

    def _pass_on(self, place: int, limit: int) -> bool:
        """Send what came on a channel up to `limit` on the other one; False when that did not take all of it."""
        source = self._channels[place]
        start = self._at[place]
        end = start + self._channels[1 - place].send_run(source, start, limit)
        self._at[place] = end
        self._relay.frames[place] += end - start
        if self._clock is not None:
            self._lines[1 - place].latency.add_since(source.stamps[start:end], self._clock())
        return end == limit
