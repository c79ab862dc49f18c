"""A Relay served by records: what goes out, and what the node sees of it, is as if every frame had been handled."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from canopen_exo.bus.channel import Arrival, RecordChannel
from canopen_exo.bus.frame import FLAG_EXTENDED, Frame
from canopen_exo.bus.node import LOOK, NEVER, PASS_ON, TAKE, ErrorState, Out, PortState, Relay
from canopen_exo.bus.realtime import RealTimeLoop

TAKEN, CALMING, GLANCED_AT = 1, 2, 3
"""Ids the node wants to see. It takes all while a port is bus-off, up to the next frame with the second one."""


class FakeRecordChannel(RecordChannel):
    """inbox: what comes with the next reading. takes: how many frames it accepts before it blocks. records: sent so."""

    def __init__(self, fd: int, takes: int) -> None:
        super().__init__(f"fake:{fd}")
        self.fd = fd
        self.takes = takes
        self.inbox: list[tuple[int, Frame | PortState]] = []
        self.sent: list[Frame] = []
        self.records = 0
        self.found: list[Arrival] = []

    def fileno(self) -> int:
        return self.fd

    def receive(self) -> list[Arrival]:
        found = [
            Arrival(stamp, None, one) if isinstance(one, PortState) else Arrival(stamp, one, None)
            for stamp, one in self.inbox
        ]
        self.inbox = []
        return found

    def read(self) -> bool:
        self.found = self.receive()
        self.count = len(self.found)
        frames = [arrival.frame for arrival in self.found]
        self.ids = [frame.can_id for frame in frames if frame is not None and not frame.flags]
        self.stamps = [arrival.stamp_ns for arrival in self.found]
        return len(self.ids) == self.count

    def stamp(self) -> None:
        pass

    def arrival(self, number: int) -> Arrival:
        return self.found[number]

    def send(self, frame: Frame) -> bool:
        if self.takes == 0:
            return False
        self.takes -= 1
        self.sent.append(frame)
        return True

    def send_run(self, source: RecordChannel, start: int, end: int) -> int:
        assert isinstance(source, FakeRecordChannel)
        taken = 0
        for arrival in source.found[start:end]:
            if arrival.frame is None or not self.send(arrival.frame):
                break
            taken += 1
        self.records += taken
        return taken

    def close(self) -> None:
        pass


class Diarist(Relay):
    """Passes frames on, writes down what it takes, and is woken at `wake_at` and every 10 ns from then.

    seen: what it took, by port and then in all; of what it looks at the first alone.
    """

    def __init__(self, wake_at: int) -> None:
        super().__init__()
        self.wake_at = wake_at
        self.seen: list[list[tuple[int, int]]] = [[], [], []]
        self.takes_all = False
        self.filter()

    def filter(self) -> None:
        for port in (0, 1):
            for can_id in range(0x10):
                is_taken = self.takes_all or can_id in (TAKEN, CALMING)
                passing = LOOK if can_id == GLANCED_AT else PASS_ON
                self.filters[port][can_id] = TAKE if is_taken else passing

    def look(self, now: int, port: int, can_id: int) -> None:
        assert can_id == GLANCED_AT
        self.seen[port].append((now, can_id))

    def receive(self, now: int, port: int, frame: Frame, out: Out) -> None:
        self.frames[port] += 1
        if frame.can_id == GLANCED_AT and not frame.flags:
            self.seen[port].append((now, frame.can_id))
        elif self.takes_all or frame.can_id in (TAKEN, CALMING) or frame.flags:
            for seen in (self.seen[port], self.seen[2]):
                seen.append((now, frame.can_id))
        if frame.can_id == CALMING:
            self.takes_all = False
            self.filter()
        out.send(1 - port, frame)

    def wake(self, now: int, out: Out) -> None:
        self.seen[2].append((now, -1))
        self.wake_at += 10

    def port_changed(self, now: int, state: PortState, out: Out) -> None:
        self.seen[2].append((now, -2 - state.port))
        self.takes_all = state.state is ErrorState.BUS_OFF
        self.filter()


things = st.one_of(
    st.builds(Frame, st.integers(0, 12), st.binary(max_size=8)),
    st.builds(Frame, st.integers(0, 12), st.binary(max_size=8), st.just(FLAG_EXTENDED)),
    st.sampled_from([PortState(0, state, 96, 0, "") for state in (ErrorState.WARNING, ErrorState.BUS_OFF)]),
)
plain_traffic = st.lists(
    st.tuples(st.integers(0, 1), st.integers(0, 9), st.builds(Frame, st.integers(0, 12), st.binary(max_size=8))),
    max_size=40,
)
traffic = st.lists(st.tuples(st.integers(0, 1), st.integers(0, 9), things), max_size=40)
"""Port, ns since the one before it, and what comes."""


def served(
    first: list[tuple[int, int, Frame | PortState]],
    second: list[tuple[int, int, Frame | PortState]],
    takes: int,
    record: bool,
    wake_at: int = 10,
) -> list[object]:
    """All that shows of a run: `first` comes at once, then `second`, when the channels take all that waits again."""
    now = 0
    channels = [FakeRecordChannel(10, takes), FakeRecordChannel(11, takes)]

    def come(given_traffic: list[tuple[int, int, Frame | PortState]]) -> None:
        nonlocal now
        for port, later, thing in given_traffic:
            now += later
            channels[port].inbox.append((now, thing))

    come(first)
    node = Diarist(wake_at)
    loop = RealTimeLoop(
        node,
        list(channels),
        [0, 1],
        0,
        record=record,
        measure_latency=True,
        clock=lambda: now,
        wait=lambda readers, writers, _: (readers, writers),
    )
    turns = iter((False, True))
    loop.run(lambda _: next(turns))
    come(second)
    for channel in channels:
        channel.takes = 1 << 30
    turns = iter((False, True))
    loop.run(lambda _: next(turns))
    assert not record or [channel.records for channel in channels] == [0, 0]
    sent = [[(frame, frame.flags) for frame in channel.sent] for channel in channels]
    latencies = [(one.count, one.worst_ns) for one in loop.latency]
    return [sent, latencies, node.seen, node.frames, loop.dropped, loop.lateness.document()]


@pytest.mark.long
@given(traffic, traffic, st.sampled_from((0, 1, 5, 1 << 30)))
def test_records_are_served_as_frames_are(
    first: list[tuple[int, int, Frame | PortState]], second: list[tuple[int, int, Frame | PortState]], takes: int
) -> None:
    """Order on both channels, wake-ups between, notices, queues, counts and latencies: the same either way."""
    assert served(first, second, takes, record=False) == served(first, second, takes, record=True)


@pytest.mark.long
@given(plain_traffic, plain_traffic, st.sampled_from((0, 1, 5, 1 << 30)))
def test_runs_of_records_are_served_as_frames_are(
    first: list[tuple[int, int, Frame | PortState]], second: list[tuple[int, int, Frame | PortState]], takes: int
) -> None:
    """The same where base data frames come alone and no wake-up is due, so that they go in runs."""
    assert served(first, second, takes, False, NEVER) == served(first, second, takes, True, NEVER)


def outcome(kinds: list[Frame], wake_at: int, takes_all: bool = False) -> tuple[int, int]:
    """How many of those that come at 0, 1, ... ns go out on the other channel, and how many of them as records."""
    channels = [FakeRecordChannel(10, 100), FakeRecordChannel(11, 100)]
    channels[0].inbox = list(enumerate(kinds))
    node = Diarist(wake_at)
    node.takes_all = takes_all
    node.filter()
    loop = RealTimeLoop(
        node, list(channels), [0, 1], 0, clock=lambda: 12, wait=lambda readers, writers, _: (readers, writers)
    )
    turns = iter((False, True))
    loop.run(lambda _: next(turns))
    return len(channels[1].sent), channels[1].records


def base(*ids: int) -> list[Frame]:
    return [Frame(can_id, b"") for can_id in ids]


@pytest.mark.parametrize(
    ("kinds", "wake_at", "records"),
    [
        (base(7, 8), NEVER, 2),
        (base(7), NEVER, 1),
        (base(TAKEN), NEVER, 0),
        (base(GLANCED_AT, 7), NEVER, 2),
        (base(TAKEN, GLANCED_AT), NEVER, 1),
        (base(7, TAKEN, 7, 8), NEVER, 3),
        (base(7, CALMING, 7, 8), NEVER, 3),
        (base(7, 8), 1, 2),  # at one instant a frame comes before a wake-up
        (base(7, 8), 0, 0),  # a wake-up that is due between them
        ([*base(7), Frame(7, b"", FLAG_EXTENDED)], NEVER, 0),
    ],
)
def test_only_what_the_node_does_not_want_goes_as_a_record(kinds: list[Frame], wake_at: int, records: int) -> None:
    """What is looked at, of another kind or comes with a wake-up that is due is handled; or all are."""
    assert outcome(kinds, wake_at) == (len(kinds), records)
    if CALMING not in [frame.can_id for frame in kinds]:
        assert outcome(kinds, wake_at, takes_all=True) == (len(kinds), 0)


def test_time_does_not_go_back_for_what_is_looked_at() -> None:
    """A frame that was stamped before those of the turn before were served, but was read after them."""
    channels = [FakeRecordChannel(10, 100), FakeRecordChannel(11, 100)]
    node = Diarist(NEVER)
    loop = RealTimeLoop(
        node, list(channels), [0, 1], 0, clock=lambda: 200, wait=lambda readers, writers, _: (readers, writers)
    )
    for port, stamp in ((0, 100), (1, 50), (1, 150)):
        channels[port].inbox.append((stamp, Frame(GLANCED_AT, b"")))
        turns = iter((False, True))
        loop.run(lambda _: next(turns))  # noqa: B023 - it runs before the next turn
    assert node.seen == [[(100, GLANCED_AT)], [(100, GLANCED_AT), (150, GLANCED_AT)], []]
