"""A Relay served by records: what goes out, and what the node sees of it, is as if every frame had been handled."""

from hypothesis import given
from hypothesis import strategies as st

from canopen_exo.bus.channel import Arrival, RecordArrival, RecordChannel
from canopen_exo.bus.frame import FLAG_EXTENDED, Frame
from canopen_exo.bus.node import NEVER, PASS_ON, TAKE, ErrorState, Out, PortState, Relay
from canopen_exo.bus.realtime import RealTimeLoop
from canopen_exo.bus.socketcan import decode, encode

LOOKED_AT, DISTURBING, CALMING = 1, 2, 3
"""Ids the node wants to see; after the last but one it wants to see all, up to the last one."""


class FakeRecordChannel(RecordChannel):
    """inbox: what comes with the next reading. takes: how many frames it accepts before it blocks. records: sent so."""

    def __init__(self, fd: int, takes: int) -> None:
        super().__init__(f"fake:{fd}")
        self.fd = fd
        self.takes = takes
        self.inbox: list[tuple[int, Frame | PortState]] = []
        self.sent: list[Frame] = []
        self.records = 0

    def fileno(self) -> int:
        return self.fd

    def receive(self) -> list[Arrival]:
        found = [
            Arrival(stamp, None, one) if isinstance(one, PortState) else Arrival(stamp, one, None)
            for stamp, one in self.inbox
        ]
        self.inbox = []
        return found

    def receive_records(self, place: int) -> list[RecordArrival]:
        found: list[RecordArrival] = []
        for arrival in self.receive():
            frame = arrival.frame
            if frame is None or frame.flags:
                found.append((arrival.stamp_ns, place, -1, b"", arrival))
            else:
                found.append((arrival.stamp_ns, place, frame.can_id, encode(frame), None))
        return found

    def frame_in(self, record: bytes) -> Frame:
        frame = decode(record)
        assert frame is not None
        return frame

    def send(self, frame: Frame) -> bool:
        if self.takes == 0:
            return False
        self.takes -= 1
        self.sent.append(frame)
        return True

    def send_record(self, record: bytes) -> bool:
        taken = self.send(self.frame_in(record))
        self.records += taken
        return taken

    def close(self) -> None:
        pass


class Diarist(Relay):
    """Passes frames on, writes down what it has to look at, and is woken every 10 ns."""

    def __init__(self) -> None:
        super().__init__()
        self.wake_at = 10
        self.seen: list[tuple[int, int]] = []
        self.sees_all = False
        self.filter()

    def filter(self) -> None:
        for port in (0, 1):
            for can_id in range(0x10):
                is_looked_at = self.sees_all or can_id in (LOOKED_AT, DISTURBING, CALMING)
                self.filters[port][can_id] = TAKE if is_looked_at else PASS_ON

    def receive(self, now: int, port: int, frame: Frame, out: Out) -> None:
        self.frames[port] += 1
        if self.sees_all or frame.can_id in (LOOKED_AT, DISTURBING, CALMING) or frame.flags:
            self.seen.append((now, frame.can_id))
        if frame.can_id in (DISTURBING, CALMING):
            self.sees_all = frame.can_id == DISTURBING
            self.filter()
        out.send(1 - port, frame)

    def wake(self, now: int, out: Out) -> None:
        self.seen.append((now, -1))
        self.wake_at += 10

    def port_changed(self, now: int, state: PortState, out: Out) -> None:
        self.seen.append((now, -2 - state.port))


things = st.one_of(
    st.builds(Frame, st.integers(0, 12), st.binary(max_size=8)),
    st.builds(Frame, st.integers(0, 12), st.binary(max_size=8), st.just(FLAG_EXTENDED)),
    st.just(PortState(0, ErrorState.WARNING, 96, 0, "")),
)
traffic = st.lists(st.tuples(st.integers(0, 1), st.integers(0, 9), things), max_size=40)
"""Port, ns since the one before it, and what comes."""


def served(
    first: list[tuple[int, int, Frame | PortState]],
    second: list[tuple[int, int, Frame | PortState]],
    takes: int,
    record: bool,
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
    node = Diarist()
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


@given(traffic, traffic, st.sampled_from((0, 1, 5, 1 << 30)))
def test_records_are_served_as_frames_are(
    first: list[tuple[int, int, Frame | PortState]], second: list[tuple[int, int, Frame | PortState]], takes: int
) -> None:
    """Order on both channels, wake-ups between, notices, queues, counts and latencies: the same either way."""
    assert served(first, second, takes, record=False) == served(first, second, takes, record=True)


def test_only_what_the_node_does_not_want_goes_as_a_record() -> None:
    """A wake-up that is due comes first; what is looked at, disturbed or of another kind is handled."""
    channels = [FakeRecordChannel(10, 100), FakeRecordChannel(11, 100)]
    kinds = (LOOKED_AT, 7, DISTURBING, 7, CALMING, 7, 8)
    channels[0].inbox = [(stamp, Frame(can_id, b"")) for stamp, can_id in enumerate(kinds)]
    channels[0].inbox.append((8, Frame(7, b"", FLAG_EXTENDED)))
    channels[0].inbox.append((11, Frame(7, b"")))  # behind the wake-up at 10
    node = Diarist()
    loop = RealTimeLoop(
        node, list(channels), [0, 1], 0, clock=lambda: 12, wait=lambda readers, writers, _: (readers, writers)
    )
    turns = iter((False, True))
    loop.run(lambda _: next(turns))
    assert len(channels[1].sent) == 9
    assert channels[1].records == 3
    assert node.wake_at == 20
    assert node.wake_at < NEVER
