"""A bus with errors: those that only some see, and what is shown of them."""

import copy
from pathlib import Path

import pytest

from canopen_exo.bus.frame import FLAG_ERROR, Frame
from canopen_exo.bus.loop import Loop
from canopen_exo.bus.medium import Medium
from canopen_exo.bus.node import MS, ErrorState, Node, Out
from canopen_exo.bus.trace import trace_hash, write_candump
from canopen_exo.bus.wire import Wire
from canopen_exo.errors import CanopenExoError
from tests.canopen_exo.bus.wire_nodes import BIT, FRAME, LENGTH, Bus, Script, Talker, flip

OTHER = Frame(0x182, bytes(8))

# --- errors that only some see --------------------------------------------------------------------------------------


class Split(Talker):
    """A node with two ports that keeps them apart."""

    def __init__(self, *sends: tuple[int, Frame]) -> None:
        super().__init__(*sends)
        self.parts: list[list[int]] = []

    def receive_on(self, now: int, ports: list[int], frame: Frame, out: Out) -> None:
        self.parts.append(ports)


def test_node_is_told_which_of_its_ports_accepted_a_frame() -> None:
    """A passive receiver with an error of its own misses the frame; the node's other port has it."""
    node = Split()
    medium = Medium("bus", 0, 1_000_000)
    loop = Loop([medium])
    loop.connect(Talker((0, FRAME)), [medium])
    loop.connect(node, [medium, medium])
    wire = Wire(medium, [Script([flip(ports=1 << 1)])])
    loop.install(wire, medium)
    medium.ports[1].rec = 128
    medium.ports[1].state = ErrorState.ERROR_PASSIVE
    wire.reconsider()
    loop.run_until(MS)
    assert (node.parts, node.heard) == ([[1]], [])


def test_node_with_one_port_off_hears_with_the_other() -> None:
    """... and is told which."""
    node = Split()
    medium = Medium("bus", 0, 1_000_000)
    loop = Loop([medium])
    loop.connect(Talker((MS, FRAME)), [medium])
    loop.connect(node, [medium, medium])
    wire = Wire(medium, [])
    loop.install(wire, medium)
    wire.switch_off(0, medium.ports[1])
    loop.run_until(2 * MS)
    assert (node.parts, node.heard) == ([[1]], [])


def test_error_in_the_last_bit_of_eof_makes_a_duplicate() -> None:
    """Receivers accept at bit 6, the sender repeats."""
    receiver = Talker()
    bus = Bus([Talker((0, FRAME)), receiver], Script([flip(LENGTH - 4, 1)]))
    bus.loop.run_until(MS)
    assert [(now // BIT, frame) for now, _, frame in receiver.heard] == [
        (LENGTH, FRAME),
        (LENGTH - 3 + 6 + 8 + 3 + 1 + LENGTH, FRAME),
    ]


def test_last_bit_of_eof_at_a_receiver_makes_an_overload_frame_which_is_told_and_is_no_error() -> None:
    """It has accepted the frame; the sender sees a flag in the intermission, and nobody counts or repeats anything."""
    bus = Bus([Talker((0, FRAME), (0, OTHER)), Talker(), Talker()], Script([flip(LENGTH - 4, ports=1 << 1)]))
    bus.loop.run_until(MS)
    overload, *frames = bus.loop.trace
    assert (overload.frame.can_id, overload.frame.flags, overload.frame.data[2]) == (0x20000208, FLAG_ERROR, 0x20)
    assert overload.end_ns == (LENGTH - 3) * BIT
    assert [row.frame for row in frames] == [FRAME, OTHER]
    assert [(port.tec, port.rec) for port in bus.medium.ports] == [(0, 0)] * 3
    assert bus.medium.errors == 0
    assert frames[1].end_ns > (2 * LENGTH + 6 + 8) * BIT  # the flag, the delimiter, and intermission again


def test_error_at_eof_bit_6_of_one_receiver_makes_a_duplicate_for_the_others_only() -> None:
    """Inconsistent message duplicate: the one that saw it gets the frame once."""
    struck, other = Talker(), Talker()
    bus = Bus([Talker((0, FRAME)), struck, other], Script([flip(LENGTH - 5, 1 << 1)]))
    bus.loop.run_until(MS)
    assert (len(struck.heard), len(other.heard)) == (1, 2)


def test_error_at_eof_bit_6_and_a_sender_that_does_not_repeat_is_an_omission() -> None:
    """Inconsistent message omission."""
    struck, other = Talker(), Talker()
    bus = Bus([Talker((0, FRAME)), struck, other], Script([flip(LENGTH - 5, 1 << 1)]))
    bus.medium.ports[0].is_one_shot = True
    bus.loop.run_until(MS)
    assert (len(struck.heard), len(other.heard)) == (0, 1)


def test_wrong_frame_that_slips_through_is_heard_where_it_was_seen() -> None:
    """A double flip at one receiver; the trace shows both versions."""
    frame = Frame(0x280, bytes.fromhex("E016C19493A4765C"))
    struck, other = Talker(), Talker()
    flips = [flip(43, 1 << 1), flip(96, 1 << 1)]
    bus = Bus([Talker((0, frame)), struck, other], Script(flips))
    bus.loop.run_until(MS)
    assert [one[2].data.hex() for one in struck.heard] == ["e016c5ca49d23b2e"]
    assert [one[2] for one in other.heard] == [frame]
    assert bus.medium.errors == 0


def test_spurious_start_of_frame_is_an_error_though_nobody_sends() -> None:
    """Dominant in the last bit of the intermission: six recessive bits later it is a stuff error."""
    bus = Bus([Talker((0, FRAME)), Talker()], Script([flip(LENGTH - 1)]))
    bus.loop.run_until(MS)
    assert [text[:8] for _, text in bus.rows()] == ["181#0000", "20000288"]
    assert bus.counters() == [(0, 1), (0, 1)]
    assert bus.medium.waiting == []


def test_frame_that_waits_joins_at_a_spurious_start_of_frame() -> None:
    """It goes on with its id: the next frame begins a bit early."""
    receiver = Talker()
    bus = Bus([Talker((0, FRAME), (0, FRAME)), receiver], Script([flip(LENGTH - 1)]))
    bus.loop.run_until(MS)
    assert [now // BIT for now, _, _ in receiver.heard] == [LENGTH, 2 * LENGTH - 1]


def test_two_senders_of_one_id_fail_and_then_get_through_one_by_one() -> None:
    """Bit error for one of them; with the same id at the same time again they would collide forever."""
    bus = Bus([Talker((0, Frame(0x181, b"\1"))), Talker((0, Frame(0x181, b"\3"))), Talker()])
    bus.loop.run_until(100 * MS)
    assert bus.medium.collisions > 0
    assert bus.medium.errors > 0


# --- what is shown --------------------------------------------------------------------------------------------------


def test_trace_shows_errors_as_socketcan_error_frames(tmp_path: Path) -> None:
    """linux/can/error.h: classes, kind and location of the error, counters; also in a candump log."""
    bus = Bus([Talker((0, FRAME)), Talker()], Script([flip(LENGTH - 13)]))
    bus.loop.run_until(MS)
    first = bus.loop.trace[0]
    assert first.frame == Frame(0x20000288, bytes.fromhex("0000901800000800"), FLAG_ERROR)
    assert first.end_ns == (LENGTH - 12) * BIT
    path = tmp_path / "log"
    write_candump(path, bus.loop.trace, 0, "can0")
    assert path.read_text().splitlines()[0] == "(0000000000.000114) can0 20000288#0000901800000800"


def test_change_of_state_is_a_row_of_the_trace() -> None:
    """Controller class with the counters; bus-off and restart have classes of their own."""
    bus = Bus([Talker(), Talker()])
    bus.wire.switch_off(0, bus.medium.ports[0])
    bus.loop.run_until(200 * MS)
    assert [text for _, text in bus.rows()] == ["20000240#000000000000FF00", "20000304#0040000000000000"]


def test_error_frames_are_part_of_the_trace_hash() -> None:
    """Two traces that differ only in one are different."""
    bus = Bus([Talker((0, FRAME)), Talker()], Script([flip(LENGTH - 1)]))
    bus.loop.run_until(MS)
    rows = bus.loop.trace
    assert trace_hash(rows) != trace_hash([row for row in rows if not row.frame.flags & FLAG_ERROR])


def test_same_disturbances_give_the_same_trace() -> None:
    """Style: same scenario, same hash, in one call or in many."""

    def run(step: int) -> str:
        nodes: list[Node] = [Talker(*((at * 200 * BIT, Frame(0x100 + at % 3, bytes(8))) for at in range(100)))]
        nodes += [Talker(*((at * 300 * BIT, Frame(0x200, bytes((at,)))) for at in range(60))), Talker()]
        script = Script(*([flip(30 + at % 70, 1 << at % 3)] if at % 4 == 0 else [] for at in range(200)))
        bus = Bus(nodes, script)
        while bus.loop.now < 40 * MS:
            bus.loop.run_until(min(bus.loop.now + step, 40 * MS))
        return trace_hash(bus.loop.trace)

    assert run(40 * MS) == run(7 * BIT + 1)


def test_copy_taken_within_an_error_frame_goes_on_as_the_original() -> None:
    """Snapshots: one copy of loop, media, nodes and what disturbs them."""
    receiver = Talker()
    bus = Bus([Talker((0, FRAME), (0, FRAME)), receiver], Script([flip()], [flip()]))
    bus.wire.switch_off(0, bus.medium.ports[1])
    bus.loop.run_until(80 * BIT)
    other = copy.deepcopy(bus)
    for one in (bus, other):
        one.loop.run_until(200 * MS)
    assert trace_hash(bus.loop.trace) == trace_hash(other.loop.trace)
    assert len(bus.loop.trace) > 20


def test_cut_ends_an_error_frame_and_mending_lets_the_frame_pass() -> None:
    """The frame was not sent, so it still waits."""
    receiver = Talker()
    bus = Bus([Talker((0, FRAME)), receiver], Script([flip()]))
    bus.loop.run_until(60 * BIT)
    bus.medium.cut()
    bus.loop.run_until(MS)
    assert receiver.heard == []
    bus.medium.mend()
    bus.loop.run_until(2 * MS)
    assert [now for now, _, _ in receiver.heard] == [MS + LENGTH * BIT]


def test_error_frames_cannot_be_sent() -> None:
    """They are notices of a controller."""
    medium = Medium("bus", 0, 1_000_000)
    port = medium.attach(Node())
    with pytest.raises(CanopenExoError, match="error frame 20000004"):
        medium.queue(port, Frame(0x20000004, bytes(8), FLAG_ERROR))
