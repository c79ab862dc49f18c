"""The lock-step loop: running it, and a broken cable."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from canopen_exo.bus.frame import Frame
from canopen_exo.bus.loop import Loop
from canopen_exo.bus.medium import Medium
from canopen_exo.bus.node import Node, Out
from canopen_exo.bus.trace import trace_hash
from canopen_exo.errors import CanopenExoError
from tests.canopen_exo.bus.loop_nodes import SENDS, Call, Echo, Script, duration, media, rows

# --- running -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("until", "served"), [(-1, 0), (0, 1), (1, 1)])
def test_run_until_is_inclusive_for_wake_ups(until: int, served: int) -> None:
    """`run_until` serves every instant up to and including the one given."""
    log: list[Call] = []
    loop = Loop(media())
    loop.connect(Script("a", log, (1_000, 0, Frame(1, b""))), loop.media)
    loop.run_until(1_000 + until)
    assert len(log) == served
    assert loop.now == 1_000 + until


@pytest.mark.parametrize(("until", "served"), [(-1, 0), (0, 1), (1, 1)])
def test_run_until_is_inclusive_for_frames(until: int, served: int) -> None:
    """The same for a frame that ends then."""
    log: list[Call] = []
    loop = Loop(media())
    loop.connect(Script("a", [], (0, 0, Frame(1, b""))), loop.media)
    loop.connect(Script("b", log), loop.media)
    loop.run_until(duration(1) + until)
    assert len(log) == served
    assert len(loop.trace) == served


@given(sends=SENDS, stops=st.lists(st.integers(0, 3_000_000), max_size=10))
def test_stopping_in_between_changes_nothing(sends: list[tuple[int, int, int, bytes]], stops: list[int]) -> None:
    """Many calls of `run_until` give the trace of one."""

    def run(times: list[int]) -> str:
        loop = Loop(media(2))
        for node in range(3):
            mine = [(time, node % 2, Frame(can_id, data)) for time, sender, can_id, data in sends if sender == node]
            loop.connect(Script(str(node), [], *mine), loop.media)
        for time in times:
            loop.run_until(time)
        return trace_hash(loop.trace)

    assert run([*sorted(stops), 20_000_000]) == run([20_000_000])


def test_same_nodes_give_the_same_trace_and_the_same_calls() -> None:
    """Style: same scenario, same trace hash."""

    def run() -> tuple[str, list[Call]]:
        log: list[Call] = []
        loop = Loop(media(2))
        for node in range(4):
            sends = [(time * 37_001 * (node + 1), 0, Frame(0x100 + node, bytes((time,)))) for time in range(50)]
            loop.connect(Echo(str(node), log, *sends) if node == 0 else Script(str(node), log, *sends), loop.media)
        loop.run_until(10_000_000)
        return trace_hash(loop.trace), log

    assert run() == run()


def test_frame_queued_between_two_calls_starts_at_the_present_time() -> None:
    """What is queued from outside competes at the instant the loop stands at."""
    loop = Loop(media())
    loop.connect(Script("a", []), loop.media)
    loop.run_until(5_000)
    loop.outs[0].send(0, Frame(1, b""))
    loop.run_until(1_000_000)
    assert rows(loop) == [(5_000 + duration(1), 0, 0, 1)]


def test_running_backwards_is_refused() -> None:
    """Time does not go back: a call with an earlier time is a programming error."""
    loop = Loop(media())
    loop.run_until(10)
    loop.run_until(10)
    with pytest.raises(CanopenExoError, match="run until 9 ns given, it is 10 ns"):
        loop.run_until(9)
    assert loop.now == 10


def test_node_that_does_not_move_its_wake_up_is_refused() -> None:
    """`wake` must move `wake_at` on; the message says which node, and the loop does not hang."""

    class Stuck(Node):
        def wake(self, now: int, out: Out) -> None:
            pass

    loop = Loop(media())
    loop.connect(Script("fine", []), loop.media)
    stuck = Stuck()
    stuck.wake_at = 42
    loop.connect(stuck, loop.media)
    with pytest.raises(CanopenExoError, match=r"node 1 \(Stuck\) asks to be woken at 42 ns again, it is 42 ns"):
        loop.run_until(100)


@pytest.mark.parametrize("asks", [-1, 0, 9])
def test_node_that_asks_for_the_past_is_refused(asks: int) -> None:
    """A wake-up that is over cannot be served at its time."""
    loop = Loop(media())
    node = Node()
    loop.connect(node, loop.media)
    loop.run_until(10)
    node.wake_at = asks
    with pytest.raises(CanopenExoError, match=f"asks to be woken at {asks} ns, it is 10 ns"):
        loop.run_until(100)


# --- a broken cable ----------------------------------------------------------------------------------------------


def test_cut_bus_carries_nothing_until_it_is_mended() -> None:
    """The frame on the wire is lost, time goes on, the queue empties after mending, and the other bus never noticed."""
    log: list[Call] = []
    loop = Loop(media(2))
    sends = [(at * 100_000, port, Frame(0x100 + at, b"")) for at in range(6) for port in range(2)]
    loop.connect(Script("a", [], *sends), loop.media)
    loop.connect(Script("b", log), loop.media)
    loop.run_until(110_000)  # 101 is on both wires
    loop.media[0].cut()
    loop.run_until(310_000)
    loop.media[0].mend()
    loop.run_until(1_000_000)
    assert [row[3] for row in rows(loop) if row[1] == 0] == [0x100, 0x102, 0x103, 0x104, 0x105]
    assert [row[3] for row in rows(loop) if row[1] == 1] == [0x100, 0x101, 0x102, 0x103, 0x104, 0x105]
    first = next(row for row in rows(loop) if row[1:] == (0, 0, 0x102))
    assert first[0] == 310_000 + duration(0x102)


def test_node_may_cut_the_bus_while_it_is_called() -> None:
    """A cut from inside takes effect at once: what was sent in that instant waits."""

    class Cutter(Script):
        def __init__(self, medium: Medium) -> None:
            super().__init__("cutter", [])
            self.medium = medium

        def receive(self, now: int, port: int, frame: Frame, out: Out) -> None:
            self.medium.cut()
            out.send(port, Frame(3, b""))

    loop = Loop(media())
    loop.connect(Cutter(loop.media[0]), loop.media)
    loop.connect(Script("a", [], (0, 0, Frame(1, b"")), (1, 0, Frame(2, b""))), loop.media)
    loop.run_until(1_000_000)
    assert [row[3] for row in rows(loop)] == [1]
    assert [port.queued for port in loop.media[0].ports] == [1, 1]
