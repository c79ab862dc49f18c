"""The short way through the real-time loop: what a Relay only passes on goes as the record that came.

Two channels that carry records, and a node that says which COB-IDs it has nothing to do with (`Relay`): runs of
such frames go out of the buffers they were read into, many with one call, and nothing is made of them. Those that it
only looks at go with them, and it is told when they came. Any other frame is made and given to the node. What the node
sees of a port, and when, is as if it had been given all of them, and so is what goes out on each bus; only what the
node adds to one direction because of a frame from the other one may go before frames that had come in the same turn.
As soon as something is in the way, the loop serves what is left frame by frame: another kind of frame or a notice has
come, a wake-up is due among the frames, the relay filters otherwise than before, or a channel takes no more.
"""

from collections.abc import Callable
from typing import Final, final

from canopen_exo.bus.channel import Arrival, RecordChannel
from canopen_exo.bus.node import LOOK, NEVER, PASS_ON, Relay
from canopen_exo.bus.realtime_out import Line, RealTimeOut

_PLACES: Final = (0, 1)
_NOTHING: Final[list[list[Arrival]]] = []

_NEAR_NS: Final = 200_000
"""A stamp may be off by what it takes to compare two clocks (`StampClock`): some microseconds."""

Deliver = Callable[[Line, Arrival, int], None]
"""Gives an arrival to the node; no stamp counts as later than the time given."""


@final
class ShortCut:
    """Serves what comes on two channels. deliver: the loop's; clock: loop time; measure: keep the lines' latency."""

    def __init__(
        self,
        relay: Relay,
        channels: list[RecordChannel],
        lines: list[Line],
        out: RealTimeOut,
        deliver: Deliver,
        clock: Callable[[], int],
        measure: bool,
    ) -> None:
        self._relay: Final[Relay] = relay
        self._channels: Final[list[RecordChannel]] = channels
        self._lines: Final[list[Line]] = lines
        self._ways: Final = [(place, lines[place], channels[place]) for place in _PLACES]
        self._out: Final[RealTimeOut] = out
        self._deliver: Final = deliver
        self._clock: Final = clock
        self._measure: Final[bool] = measure
        self._passed: Final[list[tuple[int, int, int, int]]] = []  # place, first, end, and when: not accounted for yet
        self._since: int = -NEVER  # served_ns as this turn began
        self._at: Final[list[int]] = [0, 0]  # by place: how many of those that came have been served
        self._ends: Final[list[int]] = [0, 0]

    @property
    def came(self) -> int:
        """How many frames have come in the last turn."""
        return self._ends[0] + self._ends[1]

    def serve(self, now: int, readable: list[int]) -> list[list[Arrival]]:
        """Read what has come and serve it; what is left, by place."""
        at, ends = self._at, self._ends
        at[0] = at[1] = 0
        self._since = self._out.served_ns
        is_plain = True
        plain: list[RecordChannel] = []
        for place, line, channel in self._ways:
            ends[place] = 0
            if line.fd in readable or channel.poll_at <= now:
                is_base = channel.read()
                ends[place] = channel.count
                if not is_base:
                    is_plain = False
                elif channel.count:
                    plain.append(channel)
        if is_plain and len(plain) == 1:
            self._lead(0 if ends[0] else 1)
        latest = -NEVER
        for channel in plain:
            channel.stamp()
            latest = max(latest, channel.stamps[-1])
        for place in _PLACES:
            if at[place]:
                self._look(place, 0, at[place])
        if is_plain:
            if at != ends:
                self._serve_runs(latest)
            self._account()
            if at == ends:
                self._out.served_ns = max(self._out.served_ns, latest)
                return _NOTHING
        left: list[list[Arrival]] = []
        for place in _PLACES:
            left.append([self._channels[place].arrival(number) for number in range(at[place], ends[place])])
        return left

    def _lead(self, place: int) -> None:
        """Send what only passes, up to the first other frame, before anything else is done with what came here alone.

        Without stamps: no wake-up is near enough to be due among these frames.
        """
        relay = self._relay
        table = relay.filters[place]
        limit = 0
        for one in self._channels[place].ids:
            if table[one] < PASS_ON:
                break
            limit += 1
        if limit and not self._lines[1 - place].waiting and relay.wake_at > self._clock() + _NEAR_NS:
            self._send(place, limit)

    def _serve_runs(self, latest: int) -> None:
        """Base data frames alone, until all are served or something is in the way. latest: of their stamps."""
        at, ends = self._at, self._ends
        filters = [bytearray(one) for one in self._relay.filters]
        stops: list[tuple[int, int, int]] = []  # stamp, place and number of those that do not only pass
        for place, _, channel in self._ways:
            if at[place] < ends[place]:
                for number, action in enumerate(map(filters[place].__getitem__, channel.ids)):
                    if action < PASS_ON and number >= at[place]:
                        stops.append((channel.stamps[number], place, number))
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

    def _is_free(self, latest: int, filters: list[bytearray]) -> bool:
        """Whether nothing is in the way of frames up to the stamp `latest`, and what passes is what passed before."""
        relay, lines = self._relay, self._lines
        if relay.wake_at < latest or lines[0].waiting or lines[1].waiting:
            return False
        return relay.filters == filters

    def _pass_on(self, place: int, limit: int) -> bool:
        """Send what came on a channel up to `limit`, and let the node look; False when not all of it has gone."""
        start = self._at[place]
        self._send(place, limit)
        self._look(place, start, self._at[place])
        return self._at[place] == limit

    def _look(self, place: int, start: int, end: int) -> None:
        """Tell the node of those frames that it wants to know of."""
        table = self._relay.filters[place]
        channel = self._channels[place]
        for number, can_id in enumerate(channel.ids[start:end], start):
            if table[can_id] == LOOK:
                self._relay.look(max(channel.stamps[number], self._since), place, can_id)

    def _send(self, place: int, limit: int) -> None:
        """Send what came on a channel up to `limit` on the other one, as far as that takes it."""
        source = self._channels[place]
        start = self._at[place]
        end = start + self._channels[1 - place].send_run(source, start, limit)
        self._at[place] = end
        self._relay.frames[place] += end - start
        if self._measure:
            self._passed.append((place, start, end, self._clock()))

    def _account(self) -> None:
        """Note how long what has passed was under way; no frame waits for this."""
        for place, start, end, now in self._passed:
            self._lines[1 - place].latency.add_since(self._channels[place].stamps[start:end], now)
        self._passed.clear()
