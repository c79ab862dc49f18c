"""The real-time loop: one process, one thread, one select, one node, on real interfaces.

The node is the same as in lock-step. The loop's clock counts nanoseconds of CLOCK_MONOTONIC from an epoch that all
processes of a rig share; only this module and the channels read it. Between two waits the loop

1. drains every channel and serves what came in the order of (stamp, channel, order of arrival), each frame with
   now = its stamp; wake-ups due before a stamp are served first, each with now = its `wake_at`;
2. serves the wake-ups that are due; 3. delivers own frames to the node's other ports on a shared channel;
4. sends what had to wait; 5. calls the further readers (live control).

A Relay between two channels that carry records (SocketCAN) is served in the same order, but frames it would only pass
on go as the records that came (`realtime_relay`). With a trace to keep, every frame is made and handled.

`now` never goes back for a frame: one whose stamp is older than what was served already gets that time (its trace row
keeps the stamp). Deviation from the lock-step order: within one channel frames keep the order in which they came, also
where stamps are equal; on a real bus no two frames end at once.
Automatic garbage collection rests while the loop runs: one full collection over a long trace takes tens of
milliseconds, and the core makes no reference cycles. The thread's timer slack is set to 1 us.
Leaves out: signals (the caller's matter, `until` is asked at least every 50 ms, with the time at which the turn began),
and when a sent frame really left
the controller: its trace row has the time at which it was handed over.
"""

import gc
import logging
import select
import time
from collections.abc import Callable
from typing import Final, Protocol, final

from canopen_exo.bus.channel import Arrival, Channel, RecordChannel
from canopen_exo.bus.lateness import Lateness
from canopen_exo.bus.losses import Losses
from canopen_exo.bus.medium import Transmission
from canopen_exo.bus.node import MS, NEVER, SECOND, Node, PortState, Relay
from canopen_exo.bus.realtime_out import Line, RealTimeOut
from canopen_exo.bus.realtime_relay import ShortCut
from canopen_exo.bus.scheduling import sharpen_timers
from canopen_exo.errors import CanopenExoError

__all__ = ["RECEIVED", "Lateness", "Readable", "RealTimeLoop", "RealTimeOut"]

RECEIVED: Final = -1
"""`Transmission.sender` of a frame that came from outside; own frames have the node's port there."""

_CHECK_NS: Final = 50 * MS
"""`until` is asked at least this often."""

_AWAKE_NS: Final = 10 * MS
"""How long a loop that polls busily stays awake after the last thing to read: a cycle of a 100 Hz rig."""

_FLOOD: Final = 32
"""Frames in one turn that say that they come faster than one by one: many at a time are served with less effort, and a
loop that polls busily would only serve fewer."""

_RETRY_NS: Final = MS
"""How soon a frame is offered again to an interface that select cannot watch."""

_LOG: Final = logging.getLogger(__name__)

Wait = Callable[[list[int], list[int], float], tuple[list[int], list[int]]]
"""Waits for descriptors to read, descriptors to write, at most some seconds; returns those that are ready."""


class Readable(Protocol):
    """Something select can wait for."""

    def fileno(self) -> int:
        """Its file descriptor."""


def wait_select(readers: list[int], writers: list[int], timeout_s: float) -> tuple[list[int], list[int]]:
    """The operating system's select; microseconds, where poll and epoll round up to milliseconds."""
    if not readers and not writers:  # refused by select on Windows
        time.sleep(timeout_s)
        return [], []
    readable, writable, _ = select.select(readers, writers, [], timeout_s)
    return readable, writable


@final
class RealTimeLoop:
    """Serves one node on real interfaces.

    channels: the interfaces, numbers in the trace; ports[k]: index of the channel of the node's port k, several ports
    may share one. epoch_ns: time 0 on CLOCK_MONOTONIC. record: keep the trace. measure_latency: keep `latency`.
    gather_ns: sleep so long before looking at what has come, for a node that is in no hurry; not where a channel stamps
    frames when they are read.
    busy_poll: do not sleep until 10 ms after the last thing to read, unless frames come in floods; takes a core while
    frames come: waking up takes a machine longer than passing a frame on. clock, wait: for tests.
    trace: every frame in the order served, received ones with their stamp and sender RECEIVED, own ones with the time
    of sending and the node's port. lateness: time served - wake_at of every wake-up. dropped: frames a full transmit
    queue refused, by port.
    """

    def __init__(
        self,
        node: Node,
        channels: list[Channel],
        ports: list[int],
        epoch_ns: int,
        *,
        record: bool = False,
        measure_latency: bool = False,
        gather_ns: int = 0,
        busy_poll: bool = False,
        clock: Callable[[], int] = time.monotonic_ns,
        wait: Wait = wait_select,
    ) -> None:
        for port, index in enumerate(ports):
            if not 0 <= index < len(channels):
                raise CanopenExoError(
                    f"real-time loop: port {port} is to use channel {index}, allowed 0..{len(channels) - 1}; "
                    "open a channel for it"
                )
        self.epoch_ns: Final[int] = epoch_ns
        self.trace: Final[list[Transmission] | None] = [] if record else None
        self.lateness: Final[Lateness] = Lateness()
        self._node: Final[Node] = node
        self._clock: Final = clock
        self._wait: Final = wait
        self._out: Final[RealTimeOut] = RealTimeOut(
            clock, epoch_ns, self.trace, measure_latency, isinstance(node, Relay)
        )
        self._lines: Final[list[Line]] = []
        self._readers: Final[dict[int, Callable[[int], None]]] = {}
        self._descriptors: list[int] = []
        self._gather_ns: Final[int] = gather_ns if all(channel.is_stamped for channel in channels) else 0
        self._busy_poll: Final[bool] = busy_poll
        self._awake_until: int = -NEVER
        for index, channel in enumerate(channels):
            channel.epoch_ns = epoch_ns
            self._lines.append(Line(index, channel))
        for port, index in enumerate(ports):
            self._lines[index].ports.append(port)
            self._out.lines.append(self._lines[index])
            self._out.dropped.append(0)
        self.dropped: Final[list[int]] = self._out.dropped
        self._short_cut: Final[ShortCut | None] = self._find_short_cut(node, ports, measure_latency)

    @property
    def latency(self) -> list[Lateness]:
        """By channel sent on: time of sending - stamp of the frame that made the node send (not for wake-ups), ns."""
        return [line.latency for line in self._lines]

    def now(self) -> int:
        """The loop's clock, ns."""
        return self._clock() - self.epoch_ns

    def losses(self) -> int:
        """Frames lost so far, either way: in full queues, by the kernel or the hub, at an absent interface."""
        lost = 0
        for one in self.losses_by_channel():
            lost += one.queue_full + one.discarded + one.not_taken + one.overruns
        return lost

    def losses_by_channel(self) -> list[Losses]:
        """The same, and what was no frame, by channel; asks the kernel, so not for every frame."""
        found: list[Losses] = []
        for line in self._lines:
            channel = line.channel
            channel.count_overruns()
            full = sum(self.dropped[port] for port in line.ports)
            found.append(Losses(full, line.discarded, channel.lost, channel.overruns, channel.malformed))
        return found

    def add_reader(self, source: Readable, callback: Callable[[int], None]) -> None:
        """Call `callback(now)`, between two calls of the node, whenever `source` is readable."""
        self._readers[source.fileno()] = callback
        self._watch()

    def remove_reader(self, source: Readable) -> None:
        """Wait for `source` no longer; to be called before it is closed."""
        self._readers.pop(source.fileno(), None)
        self._watch()

    def run(self, until: Callable[[int], bool]) -> None:
        """Serve the node until `until(now)` is true. Channels stay open, they are the caller's."""
        sharpen_timers()
        collecting = gc.isenabled()
        gc.disable()
        try:
            now = self._clock() - self.epoch_ns
            while not until(now):
                now = self._turn(now, NEVER)
        finally:
            for line in self._lines:
                line.channel.count_overruns()
            if collecting:
                gc.enable()

    def poll(self) -> None:
        """Serve once what is due and what has come, without waiting."""
        now = self._clock() - self.epoch_ns
        self._turn(now, now)

    def _turn(self, now: int, latest: int) -> int:
        """Wait once, until `latest` and 50 ms at most, then serve everything that is due; returns when that began.

        now: of the turn before. Where nothing is due for a second the clock need not be asked how long to wait.
        """
        node = self._node
        if self._gather_ns and latest == NEVER:
            now = self._clock() - self.epoch_ns
            self._wait([], [], max(min(self._gather_ns, node.wake_at - now), 0) / SECOND)
        writers: list[int] = []
        check_at = now + _CHECK_NS
        until = self._prepare(now, min(check_at, latest), writers)
        if until != check_at or node.wake_at < now + SECOND:
            now = self._clock() - self.epoch_ns
        readable, writable = self._wait(self._descriptors, writers, max(until - now, 0) / SECOND)
        now = self._clock() - self.epoch_ns
        left = self._drain(now, readable) if self._short_cut is None else self._short_cut.serve(now, readable)
        if readable and self._busy_poll:
            came = sum(map(len, left)) if self._short_cut is None else self._short_cut.came
            self._awake_until = now + _AWAKE_NS if came < _FLOOD else -NEVER
        if left:
            self._serve_arrivals(left, now)
        if node.wake_at <= now:
            self._serve_wakes(now, -NEVER if readable or left else now)
        if self._out.echoes:
            self._serve_echoes()
        for line in self._lines:
            if line.waiting and (line.fd in writable or line.fd < 0 or 0 < line.channel.send_at <= now):
                self._out.flush(line)
        if self._readers:
            for fd in readable:
                callback = self._readers.get(fd)
                if callback is not None:
                    callback(self.now())
        return now

    def _prepare(self, now: int, latest: int, writers: list[int]) -> int:
        """Fill in what to wait for; returns until when, `latest` at most."""
        at = self._node.wake_at
        if at > latest:
            at = latest
        if self._out.echoes or now < self._awake_until:
            at = now
        for line in self._lines:
            channel = line.channel
            fd = channel.fileno()
            if fd != line.fd:
                line.fd = fd
                self._watch()
            if channel.poll_at < at:
                at = channel.poll_at
            if line.waiting:
                send_at = channel.send_at
                if send_at == 0 and fd >= 0:
                    writers.append(fd)
                else:
                    at = min(at, send_at if send_at > now else now + _RETRY_NS)
        return at if at > now else now

    def _watch(self) -> None:
        """What to wait for has changed."""
        self._descriptors = [*self._readers, *[line.fd for line in self._lines if line.fd >= 0]]

    def _drain(self, now: int, readable: list[int]) -> list[list[Arrival]]:
        """What has come, by channel."""
        found: list[list[Arrival]] = []
        for line in self._lines:
            channel = line.channel
            is_due = (line.fd >= 0 and line.fd in readable) or channel.poll_at <= now
            found.append(channel.receive() if is_due else [])
        return found

    def _serve_arrivals(self, found: list[list[Arrival]], now: int) -> None:
        """Serve what came on each channel in order. now: before it was read."""
        first_line = -1
        batches: list[tuple[int, int, int, Arrival]] = []
        for index, arrivals in enumerate(found):
            if not arrivals:
                continue
            if first_line < 0:  # one channel alone needs no merging
                first_line = index
                continue
            if not batches:
                _number(batches, first_line, found[first_line])
            _number(batches, index, arrivals)
        if first_line < 0:
            return
        latest = now
        if any(arrivals[-1].stamp_ns > now for arrivals in found if arrivals):
            latest = self.now()
        if batches:
            batches.sort()
            for _, index, _, arrival in batches:
                self._deliver(self._lines[index], arrival, latest)
        else:
            line = self._lines[first_line]
            for arrival in found[first_line]:
                self._deliver(line, arrival, latest)

    def _find_short_cut(self, node: Node, ports: list[int], measure: bool) -> ShortCut | None:
        """For a Relay, where records can go from one channel to the other and no trace wants frames."""
        if not isinstance(node, Relay) or self.trace is not None or ports != [0, 1] or len(self._lines) != 2:
            return None
        channels = [line.channel for line in self._lines]
        found = [channel for channel in channels if isinstance(channel, RecordChannel)]
        if len(found) < 2 or type(found[0]) is not type(found[1]):
            return None
        return ShortCut(node, found, self._lines, self._out, self._deliver, self.now, measure)

    def _deliver(self, line: Line, arrival: Arrival, latest: int) -> None:
        """Give one arrival to the node. latest: no stamp counts as later than this, the time at which all had come."""
        now = arrival.stamp_ns
        if now > latest:
            now = latest
        if now < self._out.served_ns:
            now = self._out.served_ns
        if self._node.wake_at < now:
            self._serve_wakes(now - 1)
        self._out.served_ns = now
        frame = arrival.frame
        if frame is not None:
            if self.trace is not None:
                self.trace.append(Transmission(arrival.stamp_ns, line.index, frame, RECEIVED))
            line.is_away = False
            if line.ports:
                self._out.handled_ns = arrival.stamp_ns
                self._node.receive(now, line.ports[0], frame, self._out)
                self._out.handled_ns = NEVER
        elif arrival.state is not None:
            self._notify(line, arrival.state, now)

    def _notify(self, line: Line, state: PortState, now: int) -> None:
        """Every port of the node on this channel shares its state."""
        changed = state.state is not line.state
        line.note(state.state)
        _LOG.log(
            logging.WARNING if changed else logging.DEBUG,
            "%s: %s%s at %.3f s: %s",
            line.channel.name,
            state.state.value.replace("_", " "),
            f" (TEC {state.tec}, REC {state.rec})" if state.tec or state.rec else "",
            now / SECOND,
            state.cause,
        )
        for port in line.ports:
            self._node.port_changed(now, PortState(port, state.state, state.tec, state.rec, state.cause), self._out)

    def _serve_wakes(self, limit: int, now: int = -NEVER) -> None:
        """Serve every wake-up due up to and including `limit`. now: the time, where it has just been asked for."""
        node = self._node
        at = node.wake_at
        while at <= limit:
            self.lateness.add((self.now() if now == -NEVER else now) - at)
            now = -NEVER
            if at > self._out.served_ns:
                self._out.served_ns = at
            node.wake(at, self._out)
            if node.wake_at <= at:
                raise CanopenExoError(
                    f"real-time loop: {type(node).__name__} woken at {at} ns asks to be woken at {node.wake_at} ns; "
                    "wake() must move wake_at on"
                )
            at = node.wake_at

    def _serve_echoes(self) -> None:
        """Own frames to the other ports; what those send in turn waits for the next turn."""
        echoes = self._out.echoes
        self._out.echoes = []
        for echo in echoes:
            now = max(echo.sent_ns, self._out.served_ns)
            self._serve_wakes(now - 1)
            self._out.served_ns = now
            self._node.receive(now, echo.port, echo.frame, self._out)


def _number(batches: list[tuple[int, int, int, Arrival]], index: int, arrivals: list[Arrival]) -> None:
    """Add one channel's arrivals with what they are sorted by; a stamp that goes back counts as the one before it."""
    stamp = -NEVER
    for order, arrival in enumerate(arrivals):
        if arrival.stamp_ns > stamp:
            stamp = arrival.stamp_ns
        batches.append((stamp, index, order, arrival))
