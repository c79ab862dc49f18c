"""The transmit side of the real-time loop, on a clock and on channels that the test moves."""

import pytest

from canopen_exo.bus.channel import Arrival
from canopen_exo.bus.frame import Frame
from canopen_exo.bus.losses import Losses
from canopen_exo.bus.medium import QUEUE_LENGTH
from canopen_exo.bus.node import MS, NEVER, ErrorState, Out, PortState, Relay
from tests.canopen_exo.bus.fake_world import FRAMES, Diary, Sender, World, until


def test_frames_go_to_the_interface_at_once_in_the_order_given() -> None:
    """Arbitration among frames that do not wait is the bus's matter."""
    world = World()
    world.loop(Sender(FRAMES), [0]).run(until(world, 2 * MS))
    assert world.channels[0].sent == FRAMES


def test_frames_that_must_wait_go_by_arbitration_and_keep_the_order_within_an_id() -> None:
    """A port's transmit queue: the lowest arbitration bits first, as in the medium."""
    world = World()
    channel = world.channels[0]
    channel.takes = 1
    world.at(5 * MS, lambda: setattr(channel, "takes", 9))
    world.loop(Sender(FRAMES), [0]).run(until(world, 6 * MS))
    assert channel.sent == [FRAMES[0], FRAMES[3], FRAMES[1], FRAMES[2]]
    assert channel.sent_at == [MS, 5 * MS, 5 * MS, 5 * MS]


def test_frame_sent_while_others_wait_does_not_overtake_its_own_id() -> None:
    """Writable again, but the queue first: order within an id survives."""
    world = World()
    channel = world.channels[0]
    channel.takes = 0

    class Twice(Sender):
        def wake(self, now: int, out: Out) -> None:
            super().wake(now, out)
            channel.takes = 9
            out.send(0, Frame(0x300, b"\x09"))

    world.loop(Twice(FRAMES), [0]).run(until(world, 2 * MS))
    assert [frame.data for frame in channel.sent if frame.can_id == 0x300] == [b"\x01", b"\x03", b"\x09"]


def test_blocked_interface_is_waited_for_and_not_asked_again_and_again() -> None:
    """select says when it is writable; between, no turn is spent."""
    world = World()
    world.channels[0].takes = 0
    world.loop(Sender(FRAMES), [0]).run(until(world, 201 * MS))
    assert len(world.waits) <= 6


def test_interface_that_names_a_time_is_asked_then() -> None:
    """ENOBUFS: select would call the socket writable; `send_at` says when to try again."""
    world = World()
    channel = world.channels[0]
    channel.takes = 0
    channel.send_at = MS + 300_000
    world.at(MS + 1, lambda: setattr(channel, "takes", 9))
    world.loop(Sender(FRAMES[:1]), [0]).run(until(world, 2 * MS))
    assert channel.sent_at == [MS + 300_000]


@pytest.mark.parametrize("extra", [0, 1, 3])
def test_queue_holds_64_frames_and_counts_what_it_drops(extra: int) -> None:
    """Overflow drops the newest frame, is counted per port, and shows among the losses."""
    world = World()
    channel = world.channels[0]
    channel.takes = 0
    frames = [Frame(0x200, bytes((number,))) for number in range(QUEUE_LENGTH + extra)]
    loop = world.loop(Sender(frames), [0])
    loop.run(until(world, 2 * MS))
    assert loop.dropped == [extra]
    assert loop.losses() == extra
    assert loop.losses_by_channel() == [Losses(queue_full=extra)]
    channel.takes = 1 << 30
    loop.run(until(world, 3 * MS))
    assert channel.sent == frames[:QUEUE_LENGTH]


AWAY = [ErrorState.BUS_OFF, ErrorState.DOWN]


@pytest.mark.parametrize("state", AWAY)
def test_nothing_that_waits_outlives_an_outage(state: ErrorState) -> None:
    """After bus-off or interface down no old command comes out: what waits is discarded and counted, by channel."""
    world = World()
    channel = world.channels[0]
    channel.takes = 0
    node = Sender(FRAMES)
    loop = world.loop(node, [0])
    world.at(5 * MS, lambda: channel.inbox.append(Arrival(5 * MS, None, PortState(0, state, 0, 0, ""))))
    loop.run(until(world, 6 * MS))
    assert loop.losses_by_channel() == [Losses(discarded=len(FRAMES))]
    channel.takes = 9
    loop.run(until(world, 9 * MS))
    assert (channel.sent, loop.losses()) == ([], len(FRAMES))


@pytest.mark.parametrize("state", AWAY)
@pytest.mark.parametrize("sign", [Frame(0x181, b""), PortState(0, ErrorState.ERROR_ACTIVE, 0, 0, "restarted")])
def test_nothing_waits_for_an_interface_that_is_off(state: ErrorState, sign: Frame | PortState) -> None:
    """While it is off a frame is sent at once or not at all; a notice or a received frame ends that."""
    world = World()
    channel = world.channels[0]
    channel.takes = 0
    channel.inbox.append(Arrival(0, None, PortState(0, state, 0, 0, "")))
    node = Sender(FRAMES[:2])
    loop = world.loop(node, [0])
    loop.run(until(world, 2 * MS))
    assert (loop.losses_by_channel(), channel.sent) == ([Losses(discarded=2)], [])
    arrival = Arrival(3 * MS, sign, None) if isinstance(sign, Frame) else Arrival(3 * MS, None, sign)
    channel.inbox.append(arrival)
    node.wake_at = 4 * MS
    loop.run(until(world, 5 * MS))
    channel.takes = 9
    loop.run(until(world, 6 * MS))
    assert channel.sent == [FRAMES[1], FRAMES[0]]  # waited, as ever, and went by arbitration
    assert loop.losses() == 2


def test_a_relay_keeps_the_order_of_frames_that_wait() -> None:
    """Reordering by the gateway without a fault asking for it: none, whatever the ids and however busy the bus."""

    class SendingRelay(Relay):
        def __init__(self) -> None:
            super().__init__()
            self.wake_at = MS

        def wake(self, now: int, out: Out) -> None:
            self.wake_at = NEVER
            for frame in FRAMES:
                out.send(1, frame)

    world = World(2)
    channel = world.channels[1]
    channel.takes = 1
    world.at(5 * MS, lambda: setattr(channel, "takes", 9))
    world.loop(SendingRelay(), [0, 1]).run(until(world, 6 * MS))
    assert channel.sent == FRAMES
    assert channel.sent_at == [MS, 5 * MS, 5 * MS, 5 * MS]


def test_losses_add_up_what_queues_kernel_and_interfaces_lost() -> None:
    """A frame lost anywhere makes the run invalid."""
    world = World(2)
    world.channels[0].overruns = 3
    world.channels[1].lost = 4
    world.channels[1].malformed = 5
    loop = world.loop(Diary(), [0, 1])
    assert loop.losses() == 7
    assert loop.losses_by_channel() == [Losses(overruns=3), Losses(not_taken=4, malformed=5)]


def test_own_frame_reaches_another_port_on_the_same_channel_once() -> None:
    """On a real interface all drives share a socket; frames sent by one are delivered to the others."""
    world = World()
    node = Sender(FRAMES[:1], port=0)
    world.loop(node, [0, 0, 0]).run(until(world, 2 * MS))
    assert node.heard == [(1, 0x300)]
    node = Sender(FRAMES[:1], port=2)
    world = World()
    world.loop(node, [0, 0, 0]).run(until(world, 2 * MS))
    assert node.heard == [(0, 0x300)]


def test_own_frame_comes_back_neither_on_its_port_nor_from_another_bus() -> None:
    """A gateway's ports are on different channels: nothing of its own returns to it."""
    world = World(2)
    node = Sender(FRAMES)
    world.loop(node, [0, 1]).run(until(world, 2 * MS))
    assert node.heard == []


def test_frame_that_the_interface_lost_reaches_no_other_port() -> None:
    """A bus that is away delivers to nobody."""
    world = World()
    world.channels[0].is_away = True
    node = Sender(FRAMES[:1])
    loop = world.loop(node, [0, 0], record=True)
    loop.run(until(world, 2 * MS))
    assert node.heard == []
    assert loop.trace == []
    assert loop.losses() == 1
