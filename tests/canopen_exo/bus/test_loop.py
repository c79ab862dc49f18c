"""The lock-step loop: one written total order, to the nanosecond."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from canopen_exo.bus.frame import FLAG_EXTENDED, Frame
from canopen_exo.bus.loop import Loop
from canopen_exo.bus.node import IGNORE, NEVER, PASS_ON, TAKE, Out, Relay, open_filter
from canopen_exo.bus.trace import trace_hash
from tests.canopen_exo.bus.loop_nodes import BIT, SENDS, Call, Echo, Script, duration, media, rows

# --- times -------------------------------------------------------------------------------------------------------


def test_frame_is_received_when_it_ends() -> None:
    """Design: `now` in receive is the end of the frame; it starts when it is sent on an idle bus."""
    log: list[Call] = []
    loop = Loop(media())
    loop.connect(Script("a", log, (700, 0, Frame(0x123, b"\1\2"))), loop.media)
    loop.connect(Script("b", log), loop.media)
    loop.run_until(1_000_000)
    end = 700 + Frame(0x123, b"\1\2").measure() * BIT
    assert log == [("a", "wake", 700, -1, ""), ("b", "frame", end, 0, "123#0102")]
    assert rows(loop) == [(end, 0, 0, 0x123)]


def test_next_frame_starts_at_the_end_of_the_previous_one() -> None:
    """Wire rules: next start = max(end of previous, arrival), here the end."""
    loop = Loop(media())
    loop.connect(Script("a", [], (0, 0, Frame(2, b"")), (1, 0, Frame(1, b"")), (2, 0, Frame(3, b""))), loop.media)
    loop.run_until(1_000_000)
    first = duration(2)
    assert rows(loop) == [
        (first, 0, 0, 2),
        (first + duration(1), 0, 0, 1),
        (first + duration(1) + duration(3), 0, 0, 3),
    ]


@pytest.mark.parametrize("late", [0, 1, 999])
def test_frame_that_arrives_on_an_idle_bus_starts_at_once(late: int) -> None:
    """Wire rules: next start = max(end of previous, arrival), here the arrival; no bit grid."""
    loop = Loop(media())
    arrival = duration(5) + late
    loop.connect(Script("a", [], (0, 0, Frame(5, b"")), (arrival, 0, Frame(6, b""))), loop.media)
    loop.run_until(1_000_000)
    assert rows(loop) == [(duration(5), 0, 0, 5), (arrival + duration(6), 0, 0, 6)]


def test_frames_of_one_instant_compete_whoever_spoke_first() -> None:
    """Design: per instant deliver, wake, then arbitrate: the last node to be woken may win."""
    loop = Loop(media())
    for name, can_id in (("a", 9), ("b", 8), ("c", 7)):
        loop.connect(Script(name, [], (50, 0, Frame(can_id, b""))), loop.media)
    loop.run_until(1_000_000)
    assert [row[3] for row in rows(loop)] == [7, 8, 9]


def test_answer_competes_with_what_waits() -> None:
    """A frame sent in receive() is there when the bus becomes idle at that instant."""
    loop = Loop(media())
    loop.connect(Script("a", [], (0, 0, Frame(0x10, b"")), (10, 0, Frame(0x111, b""))), loop.media)
    loop.connect(Echo("b", []), loop.media)
    loop.run_until(190_000)
    assert [row[3] for row in rows(loop)] == [0x10, 0x110, 0x111]


def reference(sends: list[tuple[int, int, int, bytes]]) -> list[tuple[int, int, int]]:
    """One bus, worked out frame by frame: (end, sender, id)."""
    pending = sorted(sends, key=lambda item: (item[0], item[1]))
    found = []
    free_at = 0
    while pending:
        start = max(free_at, pending[0][0])
        arrived = [item for item in pending if item[0] <= start]
        winner = min(arrived, key=lambda item: item[2])  # the first of equal ids
        pending.remove(winner)
        free_at = start + Frame(winner[2], winner[3]).measure() * BIT
        found.append((free_at, winner[1], winner[2]))
    return found


@given(sends=SENDS)
def test_one_bus_carries_frames_as_the_rule_says(sends: list[tuple[int, int, int, bytes]]) -> None:
    """Wire rules: lowest id wins, losers retry at the next bus idle, next start = max(end, arrival)."""
    loop = Loop(media())
    for node in range(3):
        mine = [(time, 0, Frame(can_id, data)) for time, sender, can_id, data in sends if sender == node]
        loop.connect(Script(str(node), [], *mine), loop.media)
    loop.run_until(20_000_000)
    assert [(end, sender, can_id) for end, _, sender, can_id in rows(loop)] == reference(sends)


# --- order -------------------------------------------------------------------------------------------------------


def test_frame_comes_before_the_wake_up_of_the_same_nanosecond() -> None:
    """Design: at the same ns, frame before wake-up."""
    log: list[Call] = []
    loop = Loop(media())
    end = duration(1)
    loop.connect(Script("a", log, (end, 0, Frame(2, b""))), loop.media)  # woken first by index, but after the frame
    loop.connect(Script("b", log, (0, 0, Frame(1, b""))), loop.media)
    loop.run_until(end)
    assert [call[:3] for call in log] == [("b", "wake", 0), ("a", "frame", end), ("a", "wake", end)]


@pytest.mark.parametrize("early", [1, 2])
def test_wake_up_before_the_frame_comes_first(early: int) -> None:
    """One nanosecond is enough."""
    log: list[Call] = []
    loop = Loop(media())
    end = duration(1)
    loop.connect(Script("a", log, (end - early, 0, Frame(2, b""))), loop.media)
    loop.connect(Script("b", log, (0, 0, Frame(1, b""))), loop.media)
    loop.run_until(end)
    assert [call[:3] for call in log] == [("b", "wake", 0), ("a", "wake", end - early), ("a", "frame", end)]


def test_frames_of_one_nanosecond_come_in_bus_order() -> None:
    """Design: at the same ns by bus; the order of connecting and of ids does not matter."""
    log: list[Call] = []
    loop = Loop(media(3))
    ids = [0x155, 0x0AA, 0x2AA]
    ends = [duration(can_id, 4) for can_id in ids]
    starts = [max(ends) - end for end in ends]
    loop.connect(Script("listener", log), [loop.media[2], loop.media[0], loop.media[1]])
    for bus in (1, 2, 0):
        loop.connect(Script(f"talker {bus}", [], (starts[bus], 0, Frame(ids[bus], bytes(4)))), [loop.media[bus]])
    loop.run_until(max(ends))
    assert [row[:2] for row in rows(loop)] == [(max(ends), 0), (max(ends), 1), (max(ends), 2)]
    assert [call[3] for call in log] == [1, 2, 0]  # the listener's port on bus 0, 1, 2


def test_nodes_hear_a_frame_in_the_order_they_were_connected() -> None:
    """Same instant, same frame: order of connecting."""
    log: list[Call] = []
    loop = Loop(media())
    for name in ("c", "a", "b"):
        loop.connect(Script(name, log), loop.media)
    loop.connect(Script("talker", [], (0, 0, Frame(1, b""))), loop.media)
    loop.run_until(1_000_000)
    assert [call[0] for call in log] == ["c", "a", "b"]


def test_nodes_are_woken_in_the_order_they_were_connected() -> None:
    """Same instant: order of connecting."""
    log: list[Call] = []
    loop = Loop(media())
    for name in ("c", "a", "b"):
        loop.connect(Script(name, log, (5, 0, Frame(1, b""))), loop.media)
    loop.run_until(5)
    assert [call[:3] for call in log] == [("c", "wake", 5), ("a", "wake", 5), ("b", "wake", 5)]


def test_node_made_due_by_a_frame_is_woken_in_the_same_instant() -> None:
    """`wake_at` is read afresh before every wait."""

    class Prompt(Script):
        def receive(self, now: int, port: int, frame: Frame, out: Out) -> None:
            super().receive(now, port, frame, out)
            self.wake_at = now

    log: list[Call] = []
    loop = Loop(media())
    loop.connect(Prompt("a", log), loop.media)
    loop.connect(Script("b", [], (0, 0, Frame(1, b""))), loop.media)
    loop.run_until(duration(1))
    assert [call[:3] for call in log] == [("a", "frame", duration(1)), ("a", "wake", duration(1))]


def test_node_that_puts_off_its_wake_up_is_not_woken() -> None:
    """`wake_at` is read afresh before every wait, also when a frame moved it to later."""

    class Watchdog(Script):
        def receive(self, now: int, port: int, frame: Frame, out: Out) -> None:
            super().receive(now, port, frame, out)
            self.wake_at = now + 100_000

        def wake(self, now: int, out: Out) -> None:
            super().wake(now, out)
            self.wake_at = NEVER

    log: list[Call] = []
    loop = Loop(media())
    watchdog = Watchdog("dog", log)
    watchdog.wake_at = 100_000
    loop.connect(watchdog, loop.media)
    loop.connect(Script("b", [], (0, 0, Frame(1, b"")), (90_000, 0, Frame(1, b""))), loop.media)
    loop.run_until(1_000_000)
    last = 90_000 + duration(1)
    assert [call[1:3] for call in log] == [("frame", duration(1)), ("frame", last), ("wake", last + 100_000)]


# --- who hears what ----------------------------------------------------------------------------------------------


def test_sender_does_not_hear_its_own_frame() -> None:
    """A CAN controller does not receive what it sends."""
    log: list[Call] = []
    loop = Loop(media())
    loop.connect(Script("a", log, (0, 0, Frame(1, b""))), loop.media)
    loop.run_until(1_000_000)
    assert [call[1] for call in log] == ["wake"]
    assert len(loop.trace) == 1


def test_node_with_several_ports_on_a_bus_is_called_once() -> None:
    """Design: one rack call per SYNC, not six; it hears on the first of its ports."""
    log: list[Call] = []
    loop = Loop(media())
    loop.connect(Script("rack", log), [loop.media[0]] * 6)
    loop.connect(Script("master", [], (0, 0, Frame(0x80, b"\1"))), loop.media)
    loop.run_until(1_000_000)
    assert log == [("rack", "frame", Frame(0x80, b"\1").measure() * BIT, 0, "080#01")]


@pytest.mark.parametrize(("sends_on", "hears_on"), [(0, 1), (1, 0), (5, 0)])
def test_frame_of_one_port_is_heard_on_the_first_other_port_of_the_node(sends_on: int, hears_on: int) -> None:
    """Design: frames sent by one of six drives are delivered to the other five; the rack is called once."""
    log: list[Call] = []
    loop = Loop(media())
    loop.connect(Script("rack", log, (0, sends_on, Frame(0x181, b""))), [loop.media[0]] * 6)
    loop.connect(Script("master", log), loop.media)
    loop.run_until(1_000_000)
    assert [(call[0], call[3]) for call in log if call[1] == "frame"] == [("rack", hears_on), ("master", 0)]


def test_node_on_two_buses_is_told_the_port() -> None:
    """Port k of a node is attached to the k-th medium given."""
    log: list[Call] = []
    loop = Loop(media(2))
    loop.connect(Script("gateway", log), [loop.media[1], loop.media[0]])
    loop.connect(Script("a", log, (0, 0, Frame(1, b""))), [loop.media[0]])
    loop.connect(Script("b", log, (0, 0, Frame(2, bytes(8)))), [loop.media[1]])
    loop.run_until(1_000_000)
    heard = [(call[0], call[3], call[4][:3]) for call in log if call[1] == "frame"]
    assert heard == [("gateway", 1, "001"), ("gateway", 0, "002")]


@pytest.mark.parametrize(
    ("frame", "hears"), [(Frame(5, b""), 0), (Frame(6, b""), 1), (Frame(5, b"", FLAG_EXTENDED), 1)]
)
def test_node_is_not_called_for_what_its_filter_ignores(frame: Frame, hears: int) -> None:
    """Node.filters: IGNORE is said of base data frames only."""
    log: list[Call] = []
    loop = Loop(media())
    listener = Script("listener", log)
    listener.filters = [open_filter()]
    listener.filters[0][5] = IGNORE
    loop.connect(listener, loop.media)
    loop.connect(Script("talker", [], (0, 0, frame)), loop.media)
    loop.run_until(1_000_000)
    assert (len(log), len(loop.trace)) == (hears, 1)


def test_filter_that_a_node_changes_acts_on_the_next_frame() -> None:
    """What stands in a filter may change at any time."""
    log: list[Call] = []
    loop = Loop(media())

    class Fickle(Script):
        def receive(self, now: int, port: int, frame: Frame, out: Out) -> None:
            super().receive(now, port, frame, out)
            self.filters[0][5] = IGNORE

    listener = Fickle("listener", log)
    listener.filters = [open_filter()]
    loop.connect(listener, loop.media)
    loop.connect(Script("talker", [], *((at, 0, Frame(5, b"")) for at in range(3))), loop.media)
    loop.run_until(1_000_000)
    assert (len(log), len(loop.trace)) == (1, 3)


class Repeater(Relay):
    """Passes everything on; `passes`: leaves that to the loop for ids below 0x400."""

    def __init__(self, passes: bool) -> None:
        super().__init__()
        self.calls = 0
        for table in self.filters:
            for can_id in range(0x400):
                table[can_id] = PASS_ON if passes else TAKE

    def receive(self, now: int, port: int, frame: Frame, out: Out) -> None:
        self.calls += 1
        self.frames[port] += 1
        out.send(1 - port, frame)


CROSSING = st.lists(
    st.tuples(
        st.integers(0, 2_000) | st.integers(0, 20).map(lambda at: at * 100),
        st.integers(0, 3),
        st.integers(0, 0x7FF),
        st.binary(max_size=8),
        st.sampled_from([0, 0, 0, FLAG_EXTENDED]),
    ),
    max_size=60,
)


@pytest.mark.long
@given(sends=CROSSING)
def test_loop_passes_on_for_a_relay_as_the_relay_itself_would(sends: list[tuple[int, int, int, bytes, int]]) -> None:
    """Relay: the same trace, calls of others and counts, whoever passes a frame on, also at one instant on both."""

    def run(passes: bool) -> tuple[str, list[Call], list[int], int]:
        log: list[Call] = []
        loop = Loop(media(2))
        repeater = Repeater(passes)
        ends = [
            Script(
                str(node),
                log,
                *(
                    (at * BIT, 0, Frame(can_id, data, flags))
                    for at, sender, can_id, data, flags in sends
                    if sender == node
                ),
            )
            for node in range(4)
        ]
        loop.connect(ends[0], [loop.media[0]])
        loop.connect(repeater, loop.media)
        for node in (1, 2, 3):
            loop.connect(ends[node], [loop.media[node % 2]])
        loop.run_until(50_000_000)
        return trace_hash(loop.trace), log, repeater.frames, repeater.calls

    alone, helped = run(False), run(True)
    assert alone[:3] == helped[:3]
    assert alone[3] == len(sends)
    if len(sends) == 1:  # nothing ends at the same time
        assert helped[3] == (0 if sends[0][2] < 0x400 and not sends[0][4] else 1)
