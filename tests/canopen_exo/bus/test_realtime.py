"""The real-time loop, on a clock and on channels that the test moves: nothing here sleeps."""

import gc
import socket

import pytest
from hypothesis import given
from hypothesis import strategies as st

from canopen_exo.bus.channel import Arrival
from canopen_exo.bus.frame import Frame
from canopen_exo.bus.node import MS, NEVER, ErrorState, Out, PortState
from canopen_exo.bus.realtime import RECEIVED, RealTimeLoop
from canopen_exo.errors import CanopenExoError
from tests.canopen_exo.bus.fake_world import FRAMES, Diary, Forwarder, Sender, World, until


def test_wake_ups_before_a_stamp_come_first_with_their_own_time() -> None:
    """Order, both loops: wake-ups due before now are served first, each with now = its wake_at, however late."""
    world = World()
    world.oversleep = 2_300_000
    node = Diary(MS)
    world.arrive(1_500_000, 0, Frame(0x10, b""))
    world.loop(node, [0]).run(until(world, 3 * MS))
    assert node.rows[:4] == [("wake", MS, 0), ("frame", 1_500_000, 0x10), ("wake", 2 * MS, 0), ("wake", 3 * MS, 0)]


@pytest.mark.parametrize(("stamp", "first"), [(MS - 1, "frame"), (MS, "frame"), (MS + 1, "wake")])
def test_frame_comes_before_a_wake_up_of_the_same_nanosecond(stamp: int, first: str) -> None:
    """Order, both loops: at the same ns frame before wake-up."""
    world = World()
    world.oversleep = 10
    node = Diary(MS)
    world.arrive(stamp, 0, Frame(0x10, b""))
    world.loop(node, [0]).run(until(world, MS + 1))
    assert node.rows[0][0] == first
    assert {row[0] for row in node.rows} == {"frame", "wake"}


def test_frames_of_two_channels_are_served_by_stamp_then_channel() -> None:
    """Order, both loops: time, then bus."""
    world = World(2)
    world.oversleep = 100
    for channel, stamp, can_id in [(1, 50, 1), (0, 60, 2), (0, 70, 4), (1, 70, 3), (1, 80, 5)]:
        world.arrive(50, channel, Frame(can_id, b""), stamp)
    node = Diary()
    world.loop(node, [0, 1]).run(until(world, 200))
    assert node.rows == [("frame", 50, 1), ("frame", 60, 2), ("frame", 70, 4), ("frame", 70, 3), ("frame", 80, 5)]


@pytest.mark.parametrize("other", [False, True])
def test_one_channel_keeps_its_order_whatever_its_stamps(other: bool) -> None:
    """No reordering without a fault: equal stamps and stamps that go back do not change the order of arrival."""
    world = World(2)
    world.oversleep = 100
    for stamp, can_id in [(70, 9), (70, 3), (65, 1), (80, 2)]:
        world.arrive(10, 0, Frame(can_id, b""), stamp)
    if other:
        world.arrive(10, 1, Frame(0x700, b""), 71)
    node = Diary()
    world.loop(node, [0, 1]).run(until(world, 200))
    assert [row[2] for row in node.rows if row[2] != 0x700] == [9, 3, 1, 2]


def test_time_never_goes_back_for_the_node_and_the_trace_keeps_the_stamp() -> None:
    """A frame that comes after a later wake-up was served gets that time; its row says when it was stamped."""
    world = World()
    node = Diary(MS)
    world.arrive(MS + 500, 0, Frame(0x10, b""), stamp=MS - 20)
    loop = world.loop(node, [0], record=True)
    loop.run(until(world, MS + 500))
    assert node.rows == [("wake", MS, 0), ("frame", MS, 0x10)]
    assert loop.trace is not None
    assert [(row.end_ns, row.bus, row.sender) for row in loop.trace] == [(MS - 20, 0, RECEIVED)]


def test_stamp_in_the_future_does_not_wake_the_node_early() -> None:
    """A clock elsewhere that is wrong must not drive this node's timers."""
    world = World()
    node = Diary(MS)
    world.arrive(100, 0, Frame(0x10, b""), stamp=5 * MS)
    world.loop(node, [0]).run(until(world, 200))
    assert node.rows == [("frame", 100, 0x10)]


@pytest.mark.long
@given(
    st.lists(
        st.tuples(st.integers(0, 5000), st.integers(0, 1), st.integers(0, 2000)),
        max_size=40,
    ),
    st.integers(1, 900),
    st.integers(0, 3000),
)
def test_any_traffic_is_served_once_in_order(plan: list[tuple[int, int, int]], period: int, oversleep: int) -> None:
    """Nothing lost, time never back for frames, wake-ups each at their time, each channel's order kept."""
    world = World(2)
    world.oversleep = oversleep
    plan.sort(key=lambda entry: entry[0])
    for number, (time, channel, age) in enumerate(plan):
        world.arrive(time, channel, Frame(number, b""), stamp=max(time - age, 0))
    node = Diary(period)
    world.loop(node, [0, 1]).run(until(world, 20_000))
    times = [row[1] for row in node.rows]
    assert times == sorted(times)
    wakes = [row[1] for row in node.rows if row[0] == "wake"]
    assert wakes == [period * (index + 1) for index in range(len(wakes))]
    for channel in (0, 1):
        expected = [number for number, entry in enumerate(plan) if entry[1] == channel]
        assert [row[2] for row in node.rows if row[0] == "frame" and row[2] in expected] == expected


def test_lateness_is_time_served_minus_wake_at() -> None:
    """Lateness is measured and reported as a distribution."""
    world = World()
    world.oversleep = 1_250_000
    node = Diary(MS)
    loop = world.loop(node, [0])
    loop.run(until(world, 2 * MS))
    assert node.rows == [("wake", MS, 0), ("wake", 2 * MS, 0)]
    assert (loop.lateness.count, loop.lateness.worst_ns) == (2, 1_250_000)
    assert loop.lateness.percentile(0.5) < 300_000  # the second was 250 us late; a bin is 12.5 % wide


@pytest.mark.parametrize("fd", [10, -1])
def test_lateness_counts_the_time_that_reading_took(fd: int) -> None:
    """Also where a channel has no descriptor, and nothing was said to be readable."""
    world = World()
    channel = world.channels[0]
    channel.fd = fd
    node = Diary(5 * MS)

    def arrive() -> None:
        channel.inbox.append(Arrival(5 * MS, FRAMES[0], None))
        channel.on_read = lambda: world.pass_by(700_000)

    channel.poll_at = 5 * MS if fd < 0 else NEVER
    world.at(5 * MS, arrive)
    loop = world.loop(node, [0])
    loop.run(until(world, 5 * MS))
    assert node.rows[-1] == ("wake", 5 * MS, 0)
    assert loop.lateness.worst_ns == 700_000


def test_wait_ends_on_time_whatever_the_turn_before_took() -> None:
    """What is due counts from the clock and not from the last turn: nothing is served late by the time of serving."""
    world = World()
    channel = world.channels[0]
    channel.fd = -1
    reads = [MS, 2 * MS, 3 * MS, 4 * MS]

    def again() -> None:
        world.pass_by(700_000)
        channel.poll_at = reads[len(channel.reads)] if len(channel.reads) < len(reads) else NEVER

    channel.poll_at = reads[0]
    channel.on_read = again
    world.loop(Diary(), [0]).run(until(world, 6 * MS))
    assert channel.reads == reads


def test_wake_up_after_a_long_turn_is_on_time() -> None:
    """It was not due soon when the turn began."""
    world = World()

    class Slow(Diary):
        def receive(self, now: int, port: int, frame: Frame, out: Out) -> None:
            world.pass_by(80 * MS)
            self.wake_at = 110 * MS

    world.arrive(MS, 0, FRAMES[0])
    loop = world.loop(Slow(), [0])
    loop.run(until(world, 110 * MS))
    assert (loop.lateness.count, loop.lateness.worst_ns) == (1, 0)


def test_listener_in_no_hurry_reads_what_came_meanwhile_at_once() -> None:
    """Every 2 ms at most, and its wake-ups are on time; it handles each frame with its stamp."""
    world = World()
    world.channels[0].is_stamped = True
    node = Diary(7 * MS)
    for number in range(20):
        world.arrive(10 * MS + number * 100_000, 0, FRAMES[0])
    loop = world.loop(node, [0], gather_ns=2 * MS)
    loop.run(until(world, 30 * MS))
    assert [row[1] for row in node.rows if row[0] == "frame"] == [10 * MS + number * 100_000 for number in range(20)]
    assert len(world.channels[0].reads) <= 3
    assert loop.lateness.worst_ns == 0


def test_listener_reads_at_once_what_gets_its_time_by_reading() -> None:
    """Gathering would change the times of frames there."""
    world = World()
    for number in range(5):
        world.arrive(10 * MS + number * 100_000, 0, FRAMES[0])
    world.loop(Diary(), [0], gather_ns=2 * MS).run(until(world, 20 * MS))
    assert world.channels[0].reads == [10 * MS + number * 100_000 for number in range(5)]


def test_until_is_asked_every_50_ms() -> None:
    """A stop is noticed although nothing happens on the bus."""
    world = World()
    asked: list[int] = []

    def stop(now: int) -> bool:
        asked.append(now)
        return now >= 200 * MS

    world.loop(Diary(), [0]).run(stop)
    assert asked == [0, 50 * MS, 100 * MS, 150 * MS, 200 * MS]


def test_node_that_does_not_move_its_wake_at_is_refused() -> None:
    """A programming error raises, it does not spin."""
    world = World()
    with pytest.raises(CanopenExoError, match="must move wake_at on"):
        world.loop(Diary(0), [0]).run(until(world, MS))


def test_port_without_channel_is_refused() -> None:
    """The message says which port, which channel and what is allowed."""
    with pytest.raises(CanopenExoError, match=r"port 1 is to use channel 2, allowed 0\.\.1"):
        World(2).loop(Diary(), [0, 2])


def test_received_frame_goes_to_the_first_port_of_its_channel() -> None:
    """One call per frame, whatever the number of ports on the channel."""
    world = World(2)
    node = Sender([])
    world.arrive(10, 1, Frame(0x55, b""))
    world.loop(node, [0, 1, 1]).run(until(world, MS))
    assert node.heard == [(1, 0x55)]


def test_notice_reaches_every_port_of_the_channel_with_its_number() -> None:
    """PortState(port, ...) is the only error notice to nodes."""
    world = World(2)
    node = Diary()
    notice = Arrival(300, None, PortState(0, ErrorState.BUS_OFF, 255, 3, "bus-off"))
    world.at(300, lambda: world.channels[1].inbox.append(notice))
    world.loop(node, [0, 1, 1]).run(until(world, MS))
    assert [(now, state.port, state.state, state.tec, state.rec, state.cause) for now, state in node.states] == [
        (300, port, ErrorState.BUS_OFF, 255, 3, "bus-off") for port in (1, 2)
    ]


def test_channel_without_descriptor_is_polled_when_it_asks() -> None:
    """Reopening with a back-off is the channel's matter; the loop calls it at `poll_at`."""
    world = World()
    channel = world.channels[0]
    channel.fd = -1
    channel.poll_at = 20 * MS
    world.loop(Diary(), [0]).run(until(world, 30 * MS))
    assert channel.reads == [20 * MS]


def test_frame_for_a_channel_without_descriptor_is_offered_again_soon() -> None:
    """select cannot tell when it is writable."""
    world = World()
    channel = world.channels[0]
    channel.fd = -1
    channel.takes = 0
    world.at(3 * MS, lambda: setattr(channel, "takes", 1))
    world.loop(Sender(FRAMES[:1]), [0]).run(until(world, 9 * MS))
    assert len(channel.sent) == 1
    assert channel.sent_at[0] <= 4 * MS


def test_trace_holds_own_frames_with_port_and_time_of_sending() -> None:
    """Received frames with their stamp, sent frames with the time of sending; bus = channel."""
    world = World(2)
    loop = world.loop(Forwarder(), [1, 0], record=True)
    world.oversleep = 40
    world.arrive(1000, 0, Frame(0x123, b"\x01"))
    loop.run(until(world, 2000))
    assert loop.trace is not None
    rows = [(row.end_ns, row.bus, row.sender, row.frame.can_id) for row in loop.trace]
    assert rows == [(1000, 0, RECEIVED, 0x123), (1040, 1, 0, 0x123)]


def test_trace_is_kept_only_when_asked_for() -> None:
    """A gateway that runs for days does not grow."""
    world = World()
    loop = world.loop(Sender(FRAMES), [0])
    loop.run(until(world, 2 * MS))
    assert loop.trace is None


def test_latency_is_from_stamp_to_sending_by_channel() -> None:
    """Added latency of a gateway, waiting in its queue included; frames sent by a timer do not count."""
    world = World(2)
    world.oversleep = 250
    loop = world.loop(Forwarder(), [0, 1], measure_latency=True)
    world.arrive(1000, 0, Frame(0x123, b"\x01"))
    loop.run(until(world, 2000))
    assert [latency.count for latency in loop.latency] == [0, 1]
    assert loop.latency[1].worst_ns == 250
    world.channels[0].takes = 0
    world.arrive(10_000, 1, Frame(0x123, b"\x01"))
    world.at(50_000, lambda: setattr(world.channels[0], "takes", 1))
    loop.run(until(world, 60_000))
    assert loop.latency[0].worst_ns == 40_250
    timed = world.loop(Sender(FRAMES), [1], measure_latency=True)
    timed.run(until(world, 2 * MS))
    assert timed.latency[1].count == 0


def test_further_reader_is_called_with_the_time_until_removed() -> None:
    """Live control calls between two calls of the node; the loop's select takes further readable files."""
    world = World()
    loop = world.loop(Diary(), [0])
    calls: list[int] = []
    left, right = socket.socketpair()
    with left, right:

        def answer(now: int) -> None:
            calls.append(now)
            loop.remove_reader(left)
            world.ready.clear()

        loop.add_reader(left, answer)
        world.at(3 * MS, lambda: world.ready.append(left.fileno()))
        world.at(6 * MS, lambda: world.ready.append(left.fileno()))
        loop.run(until(world, 10 * MS))
    assert calls == [3 * MS]


def test_real_select_serves_a_reader_and_ends() -> None:
    """The same on the machine's own clock and select: no fake in between."""
    calls: list[int] = []
    left, right = socket.socketpair()
    with left, right:
        loop = RealTimeLoop(Diary(), [], [], 0)
        loop.add_reader(left, lambda now: calls.append(len(left.recv(10))))
        right.send(b"abc")
        loop.run(lambda now: bool(calls))
    assert calls == [3]


def test_garbage_collection_is_as_before_after_a_run() -> None:
    """It rests while the loop runs, also when the node raises."""
    assert gc.isenabled()
    seen: list[bool] = []
    world = World()

    def stop(now: int) -> bool:
        seen.append(gc.isenabled())
        return True

    world.loop(Diary(), [0]).run(stop)
    assert seen == [False]
    assert gc.isenabled()
    with pytest.raises(CanopenExoError):
        World().loop(Diary(0), [0]).run(lambda now: False)
    assert gc.isenabled()


def test_busy_poll_sleeps_only_when_nothing_has_come_for_10_ms() -> None:
    """docs/real_time.md: with `--busy-poll` a core is taken while frames come, and given back soon after the last."""
    world = World()
    world.oversleep = MS  # else no time would pass
    world.arrive(5 * MS, 0, Frame(0x181, b""))
    node = Diary()
    at: list[int] = []

    def over(now: int) -> bool:
        at.append(now)
        return now > 40 * MS

    world.loop(node, [0], busy_poll=True).run(over)
    assert [row[0] for row in node.rows] == ["frame"]
    seen = node.rows[0][1] + world.oversleep
    awake = [now for now, timeout_s in zip(at, world.waits, strict=False) if timeout_s == 0.0]
    assert awake == [now for now in at if seen <= now < seen + 10 * MS]
    assert len(awake) == 10


@pytest.mark.parametrize(("many", "is_awake"), [(31, True), (32, False)])
def test_busy_poll_sleeps_in_a_flood(many: int, is_awake: bool) -> None:
    """Frames that wait together are served with less effort than one by one."""
    world = World(2)
    world.oversleep = MS
    for number in range(many):
        world.arrive(5 * MS, number % 2, Frame(0x181, b""))
    world.loop(Diary(), [0, 1], busy_poll=True).run(lambda now: now > 12 * MS)
    assert (0.0 in world.waits) == is_awake


def test_readers_that_come_and_go_are_waited_for() -> None:
    """Live control: a reader added while the loop runs is served, one removed is not."""
    world = World()
    heard: list[int] = []

    class File:
        def fileno(self) -> int:
            return 77

    def remove(now: int) -> None:
        heard.append(now)
        loop.remove_reader(File())

    loop = world.loop(Diary(), [0])
    world.at(2 * MS, lambda: loop.add_reader(File(), remove))
    world.at(2 * MS, lambda: world.ready.append(77))
    loop.run(lambda now: now > 200 * MS)
    assert len(heard) == 1
