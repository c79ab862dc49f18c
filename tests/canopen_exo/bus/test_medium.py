"""One emulated bus: who wins, how long a frame takes, what a full queue and a cut cable do."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from canopen_exo.bus.frame import FLAG_EXTENDED, FLAG_FD, FLAG_REMOTE, Frame
from canopen_exo.bus.medium import QUEUE_LENGTH, Medium
from canopen_exo.bus.node import NEVER, Node
from canopen_exo.errors import CanopenExoError

FRAMES = st.one_of(
    st.builds(Frame, st.integers(0, 0x7FF), st.binary(max_size=8)),
    st.builds(Frame, st.integers(0, 0x1FFFFFFF), st.binary(max_size=8), st.just(FLAG_EXTENDED)),
    st.builds(Frame, st.integers(0, 0x7FF), st.just(b""), st.just(FLAG_REMOTE)),
)


def bus(ports: int = 2, bitrate: int = 1_000_000) -> Medium:
    medium = Medium("drive", 0, bitrate)
    for _ in range(ports):
        medium.attach(Node())
    return medium


def carried(medium: Medium, now: int = 0) -> list[tuple[int, int, Frame]]:
    """Start one frame after the other until none waits: (end, sender, frame)."""
    found = []
    while medium.waiting:
        medium.arbitrate(now)
        now = medium.end
        frame, sender = medium.on_wire
        found.append((now, sender.number, frame))
        medium.end = NEVER
    return found


def test_ports_are_numbered_in_order() -> None:
    """`attach` returns a port that knows its number on this medium."""
    medium = Medium("drive", 0, 1_000_000)
    assert [medium.attach(Node()).number for _ in range(3)] == [0, 1, 2]


@pytest.mark.parametrize("bitrate", [1_000_000, 800_000, 500_000, 250_000, 125_000, 50_000, 20_000, 10_000])
def test_frame_takes_its_bits_at_the_bit_rate(bitrate: int) -> None:
    """ISO 11898-1: SOF to the end of the intermission; at 1 Mbit/s one bit is 1 us."""
    medium = bus(bitrate=bitrate)
    medium.queue(medium.ports[0], Frame(0x181, bytes(8)))
    medium.arbitrate(1_000)
    assert medium.end == 1_000 + (113 + 13) * (1_000_000_000 // bitrate)


@pytest.mark.parametrize("bitrate", [0, -1, 300_000, 333_333, 2_000_000_000])
def test_bit_rate_without_a_whole_bit_time_is_refused(bitrate: int) -> None:
    """Times are whole nanoseconds."""
    with pytest.raises(CanopenExoError, match=f"medium 'drive': bit rate {bitrate} given"):
        Medium("drive", 0, bitrate)


@pytest.mark.parametrize("first", [0, 1])
def test_lowest_id_wins_whoever_was_first(first: int) -> None:
    """ISO 11898-1: arbitration between controllers."""
    medium = bus()
    frames = [Frame(0x200, b""), Frame(0x1FF, b"")]
    medium.queue(medium.ports[first], frames[first])
    medium.queue(medium.ports[1 - first], frames[1 - first])
    assert [frame for _, _, frame in carried(medium)] == [frames[1], frames[0]]


def test_controller_sends_its_lowest_id_first() -> None:
    """Wire rules: the transmit queue of a controller is ordered by id."""
    medium = bus(1)
    for can_id in (5, 3, 4, 1, 2):
        medium.queue(medium.ports[0], Frame(can_id, b""))
    assert [frame.can_id for _, _, frame in carried(medium)] == [1, 2, 3, 4, 5]


def test_frames_of_one_id_leave_in_the_order_they_were_queued() -> None:
    """A controller never swaps two frames of the same id: the receiver takes the later one for newer."""
    medium = bus(1)
    frames = [Frame(7, bytes((at,))) for at in range(10)]
    for frame in frames:
        medium.queue(medium.ports[0], frame)
    assert [frame for _, _, frame in carried(medium)] == frames


@pytest.mark.parametrize(
    ("winner", "loser"),
    [
        (Frame(0x123, b""), Frame(0x123 << 18, b"", FLAG_EXTENDED)),
        (Frame(0x123, b"", FLAG_REMOTE), Frame(0x123 << 18, b"", FLAG_EXTENDED)),
        (Frame(0x123 << 18, b"", FLAG_EXTENDED), Frame(0x124, b"")),
        (Frame(0x123, b""), Frame(0x123, b"", FLAG_REMOTE)),
        (Frame(0x123, b"", FLAG_EXTENDED), Frame(0x123, b"", FLAG_EXTENDED | FLAG_REMOTE)),
        (Frame(0x123, b"", FLAG_EXTENDED | FLAG_REMOTE), Frame(0x124, b"", FLAG_EXTENDED)),
        (Frame(0x000, bytes(8)), Frame(0x001, b"")),
        (Frame(0x7FE, bytes(8)), Frame(0x7FF, b"")),
    ],
)
def test_base_before_extended_and_data_before_remote(winner: Frame, loser: Frame) -> None:
    """ISO 11898-1: recessive SRR, IDE and RTR lose."""
    medium = bus()
    medium.queue(medium.ports[0], loser)
    medium.queue(medium.ports[1], winner)
    assert [frame for _, _, frame in carried(medium)] == [winner, loser]


@given(queued=st.lists(st.tuples(st.integers(0, 3), FRAMES), max_size=60))
def test_all_frames_pass_once_lowest_arbitration_first(queued: list[tuple[int, Frame]]) -> None:
    """Whatever is queued where: sorted by arbitration bits, then by arrival, back to back, none lost or doubled."""
    medium = bus(4)
    for port, frame in queued:
        medium.queue(medium.ports[port], frame)
    passed = carried(medium)
    expected = sorted(queued, key=lambda item: item[1].arbitration)  # stable: arrival decides the rest
    assert [(sender, frame) for _, sender, frame in passed] == expected
    now = 0
    for end, _, frame in passed:
        now += frame.measure() * 1000
        assert end == now
    assert [port.queued for port in medium.ports] == [0, 0, 0, 0]


def test_controller_that_keeps_the_order_sends_what_came_first() -> None:
    """Its urgent frame waits behind its slow one (priority inversion); others pass both of them."""
    medium = bus()
    ordered, other = medium.ports
    ordered.keep_order()
    for port, can_id in ((ordered, 0x300), (ordered, 0x100), (other, 0x200), (ordered, 0x400), (other, 0x380)):
        medium.queue(port, Frame(can_id, b""))
    assert (ordered.queued, other.queued) == (3, 2)
    assert [frame.can_id for _, _, frame in carried(medium)] == [0x200, 0x300, 0x100, 0x380, 0x400]


@given(st.lists(st.tuples(st.integers(0, 2), st.integers(0, 0x7FF)), max_size=40, unique_by=lambda one: one[1]))
def test_queues_that_keep_the_order_pass_as_a_merge_of_them(queued: list[tuple[int, int]]) -> None:
    """At each idle bus the lowest of what the controllers offer wins; ports 0 and 1 offer their oldest frame."""
    medium = bus(3)
    for port in medium.ports[:2]:
        port.keep_order()
    queues: list[list[int]] = [[], [], []]
    for number, can_id in queued:
        medium.queue(medium.ports[number], Frame(can_id, b""))
        queues[number].append(can_id)
    queues[2].sort()
    expected = []
    while any(queues):
        won = min(queue[0] for queue in queues if queue)
        expected.append(won)
        next(queue for queue in queues if queue and queue[0] == won).pop(0)
    assert [frame.can_id for _, _, frame in carried(medium)] == expected


def test_queue_that_keeps_the_order_holds_64_frames() -> None:
    """One more is dropped and counted."""
    medium = bus()
    medium.ports[0].keep_order()
    for _ in range(QUEUE_LENGTH + 2):
        medium.queue(medium.ports[0], Frame(0x100, b""))
    assert (medium.ports[0].queued, medium.ports[0].dropped) == (QUEUE_LENGTH, 2)
    assert len(carried(medium)) == QUEUE_LENGTH


def test_queue_that_keeps_the_order_goes_on_after_a_cut() -> None:
    """The frame on the wire is lost, the next ones wait."""
    medium = bus()
    medium.ports[0].keep_order()
    for can_id in (0x300, 0x100, 0x200):
        medium.queue(medium.ports[0], Frame(can_id, b""))
    medium.arbitrate(0)
    medium.cut()
    medium.arbitrate(0)
    assert medium.end == NEVER
    medium.mend()
    assert [frame.can_id for _, _, frame in carried(medium)] == [0x100, 0x200]


def test_two_nodes_with_the_same_id_at_once_are_counted() -> None:
    """ISO 11898-1 makes this a bit error; it is counted, and both frames pass."""
    medium = bus(3)
    medium.queue(medium.ports[1], Frame(0x181, b"\1"))
    medium.queue(medium.ports[0], Frame(0x181, b"\2"))
    medium.queue(medium.ports[2], Frame(0x182, b"\3"))
    assert len(carried(medium)) == 3
    assert medium.collisions == 1


def test_two_frames_of_one_id_from_one_node_are_no_collision() -> None:
    """A controller offers one frame at a time."""
    medium = bus()
    medium.queue(medium.ports[0], Frame(0x181, b"\1"))
    medium.queue(medium.ports[0], Frame(0x181, b"\2"))
    medium.queue(medium.ports[1], Frame(0x182, b""))
    carried(medium)
    assert medium.collisions == 0


# --- queues ------------------------------------------------------------------------------------------------------


def test_queue_holds_64_frames_and_drops_the_newest() -> None:
    """Design: a port's transmit queue holds 64 frames; overflow drops the newest and is counted."""
    assert QUEUE_LENGTH == 64
    medium = bus()
    frames = [Frame(0x100, bytes((at,))) for at in range(67)]
    for frame in frames[:64]:
        medium.queue(medium.ports[0], frame)
    assert medium.ports[0].dropped == 0
    for frame in frames[64:]:
        medium.queue(medium.ports[0], frame)
    assert medium.ports[0].dropped == 3
    assert [frame for _, _, frame in carried(medium)] == frames[:64]


def test_full_queue_drops_even_the_most_important_frame() -> None:
    """The newest goes, not the one that would win last."""
    medium = bus(1)
    for _ in range(64):
        medium.queue(medium.ports[0], Frame(0x700, b""))
    medium.queue(medium.ports[0], Frame(0x000, b""))
    assert medium.ports[0].dropped == 1
    assert {frame.can_id for _, _, frame in carried(medium)} == {0x700}


def test_full_queue_of_one_port_leaves_the_others_alone() -> None:
    """Each controller has a queue of its own."""
    medium = bus()
    for _ in range(65):
        medium.queue(medium.ports[0], Frame(0x700, b""))
    medium.queue(medium.ports[1], Frame(0x701, b""))
    assert [port.dropped for port in medium.ports] == [1, 0]
    assert len(carried(medium)) == 65


def test_frame_on_the_wire_has_left_its_queue() -> None:
    """64 frames wait besides the one being sent."""
    medium = bus()
    medium.queue(medium.ports[0], Frame(0x100, b""))
    medium.arbitrate(0)
    for _ in range(65):
        medium.queue(medium.ports[0], Frame(0x100, b""))
    assert (medium.ports[0].queued, medium.ports[0].dropped) == (64, 1)


def test_queue_has_room_again_after_a_frame_started() -> None:
    """The limit is of what waits, not of what was ever queued."""
    medium = bus(1)
    for _ in range(200):
        medium.queue(medium.ports[0], Frame(0x100, b""))
        assert len(carried(medium)) == 1
    assert (medium.ports[0].queued, medium.ports[0].dropped) == (0, 0)


@pytest.mark.parametrize("size", [0, 8, 64])
def test_fd_frame_is_refused(size: int) -> None:
    """Design: the medium refuses FD with an error until it can do it; nothing is queued."""
    medium = bus()
    with pytest.raises(CanopenExoError, match=r"medium 'drive': CAN FD frame .* given; this bus is classical CAN"):
        medium.queue(medium.ports[0], Frame(0x123, bytes(size), FLAG_FD))
    assert not medium.waiting


# --- a broken cable ----------------------------------------------------------------------------------------------


def test_nothing_starts_on_a_cut_bus() -> None:
    """A cut bus carries nothing; queues fill up."""
    medium = bus()
    medium.cut()
    for _ in range(65):
        medium.queue(medium.ports[0], Frame(0x100, b""))
    medium.arbitrate(0)
    assert (medium.end, medium.ports[0].queued, medium.ports[0].dropped) == (NEVER, 64, 1)


def test_cut_loses_the_frame_on_the_wire() -> None:
    """The frame under way never ends; the next one starts after mending."""
    medium = bus()
    medium.queue(medium.ports[0], Frame(0x100, b""))
    medium.queue(medium.ports[0], Frame(0x101, b""))
    medium.arbitrate(0)
    medium.cut()
    assert medium.end == NEVER
    medium.mend()
    assert [frame.can_id for _, _, frame in carried(medium, 5_000)] == [0x101]
