"""A medium on which errors happen: retransmission, error states, bus-off, and who is told."""

import copy
from itertools import pairwise
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from canopen_exo.bus.disturbance import ALL, FLIP, NO_ACK, Disruption, Disturbance
from canopen_exo.bus.frame import FLAG_ERROR, Frame
from canopen_exo.bus.loop import Loop
from canopen_exo.bus.medium import Medium
from canopen_exo.bus.node import MS, NEVER, ErrorState, Node, Out, PortState
from canopen_exo.bus.trace import trace_hash, write_candump
from canopen_exo.bus.wire import Wire
from canopen_exo.errors import CanopenExoError

BIT = 1000
FRAME = Frame(0x181, bytes(8))
LENGTH = FRAME.measure()
ERROR_AT = 50
ERROR_BITS = 7 + 6 + 8 + 3


class Talker(Node):
    """Sends frames at given times on port 0 and writes down what it hears and is told."""

    def __init__(self, *sends: tuple[int, Frame]) -> None:
        super().__init__()
        self.sends = list(sends)
        self.heard: list[tuple[int, int, Frame]] = []
        self.states: list[tuple[int, ErrorState, int, int]] = []
        self._next()

    def _next(self) -> None:
        self.wake_at = self.sends[0][0] if self.sends else NEVER

    def receive(self, now: int, port: int, frame: Frame, out: Out) -> None:
        self.heard.append((now, port, frame))

    def wake(self, now: int, out: Out) -> None:
        while self.sends and self.sends[0][0] <= now:
            out.send(0, self.sends.pop(0)[1])
        self._next()

    def port_changed(self, now: int, state: PortState, out: Out) -> None:
        self.states.append((now, state.state, state.tec, state.rec))


class Script(Disturbance):
    """Gives the next of these to every attempt that sends something."""

    def __init__(self, *attempts: list[Disruption]) -> None:
        self.attempts = list(attempts)

    def errors(self, now: int, until: int, bit_ns: int, frame: Frame | None, sender: int) -> list[Disruption]:
        return self.attempts.pop(0) if self.attempts and frame is not None else []


class Every(Disturbance):
    """The same to all attempts before `until_ns`, and to those only that have this id."""

    def __init__(self, disruption: Disruption, can_id: int = -1, until_ns: int = NEVER) -> None:
        self.disruption = disruption
        self.can_id = can_id
        self.until_ns = until_ns

    def errors(self, now: int, until: int, bit_ns: int, frame: Frame | None, sender: int) -> list[Disruption]:
        if frame is None or now >= self.until_ns or (self.can_id >= 0 and frame.can_id != self.can_id):
            return []
        return [self.disruption]


def flip(at: int = ERROR_AT, ports: int = ALL) -> Disruption:
    return Disruption(FLIP, at, at + 1, ports)


class Bus:
    """Nodes on one medium with errors."""

    def __init__(self, nodes: list[Node], *disturbances: Disturbance) -> None:
        self.medium = Medium("bus", 0, 1_000_000)
        self.loop = Loop([self.medium])
        for node in nodes:
            self.loop.connect(node, [self.medium])
        self.wire = Wire(self.medium, list(disturbances))
        self.loop.install(self.wire, self.medium)

    def rows(self) -> list[tuple[int, str]]:
        return [(row.end_ns // BIT, repr(row.frame)) for row in self.loop.trace]

    def frames(self) -> list[tuple[int, int]]:
        return [(row.end_ns // BIT, row.sender) for row in self.loop.trace if not row.frame.flags]

    def counters(self) -> list[tuple[int, int]]:
        return [(port.tec, port.rec) for port in self.medium.ports]


# --- clean frames -------------------------------------------------------------------------------------------------


@settings(max_examples=40)
@given(
    sends=st.lists(
        st.tuples(st.integers(0, 3_000_000), st.integers(0, 2), st.integers(0, 0x7FF), st.binary(max_size=8)),
        max_size=25,
        unique_by=lambda one: one[2],
    )
)
def test_undisturbed_bus_gives_the_trace_of_the_ideal_one(sends: list[tuple[int, int, int, bytes]]) -> None:
    """Clean frames keep the fast path; with errors possible they pass at the same times."""

    def run(with_wire: bool) -> str:
        medium = Medium("bus", 0, 1_000_000)
        loop = Loop([medium])
        for node in range(3):
            mine = [(at, Frame(can_id, data)) for at, who, can_id, data in sorted(sends) if who == node]
            loop.connect(Talker(*mine), [medium])
        if with_wire:
            loop.install(Wire(medium, []), medium)
        loop.run_until(20 * MS)
        return trace_hash(loop.trace)

    assert run(True) == run(False)


# --- errors that all see --------------------------------------------------------------------------------------------


def test_disturbed_frame_is_repeated_after_the_error_frame() -> None:
    """Error flag, delimiter, intermission, and the frame again; it is received once."""
    receiver = Talker()
    bus = Bus([Talker((0, FRAME)), receiver], Script([flip(LENGTH - 13)]))  # CRC delimiter
    bus.loop.run_until(MS)
    again = LENGTH - 12 + 6 + 8 + 3 + LENGTH
    assert [(now // BIT, port, frame) for now, port, frame in receiver.heard] == [(again, 0, FRAME)]
    assert bus.frames() == [(again, 0)]
    assert bus.counters() == [(7, 0), (0, 0)]
    assert (bus.medium.errors, bus.wire.attempts) == (1, 1)


def test_more_urgent_frame_goes_before_the_repeated_one() -> None:
    """Retransmission is an arbitration like any other."""
    bus = Bus([Talker((0, FRAME)), Talker((10 * BIT, Frame(0x080, b"")))], Script([flip()]))
    bus.loop.run_until(MS)
    assert [sender for _, sender in bus.frames()] == [1, 0]


def test_frame_keeps_its_place_before_later_ones_of_its_id() -> None:
    """The receiver takes the later one for newer."""
    receiver = Talker()
    frames = [Frame(0x181, bytes((at,))) for at in range(4)]
    sender = Talker(*((at * BIT, frame) for at, frame in enumerate(frames)))
    bus = Bus([sender, receiver], Script([flip(25)], [flip(25)]))
    bus.loop.run_until(2 * MS)
    assert [frame for _, _, frame in receiver.heard] == frames


def test_one_shot_port_does_not_repeat() -> None:
    """The frame is lost and counted."""
    receiver = Talker()
    bus = Bus([Talker((0, FRAME)), receiver], Script([flip()]))
    bus.medium.ports[0].is_one_shot = True
    bus.loop.run_until(MS)
    assert receiver.heard == []
    assert bus.medium.ports[0].lost == 1
    assert not bus.medium.waiting


@pytest.mark.parametrize(
    ("errors", "state"),
    [
        (11, ErrorState.ERROR_ACTIVE),
        (12, ErrorState.WARNING),
        (15, ErrorState.WARNING),
        (16, ErrorState.ERROR_PASSIVE),
        (31, ErrorState.ERROR_PASSIVE),
        (32, ErrorState.BUS_OFF),
    ],
)
def test_consecutive_errors_lead_to_passive_after_16_and_bus_off_after_32(errors: int, state: ErrorState) -> None:
    """TEC +8 each; the node is told every change."""
    sender = Talker((0, FRAME))
    bus = Bus([sender, Talker()], Script(*[[flip()] for _ in range(errors)]))
    bus.medium.ports[0].restart_ns = NEVER
    while bus.medium.errors < errors:
        bus.loop.run_until(bus.loop.now + 10 * BIT)
    assert bus.medium.ports[0].state is state
    order = [ErrorState.WARNING, ErrorState.ERROR_PASSIVE, ErrorState.BUS_OFF]
    told = [] if state is ErrorState.ERROR_ACTIVE else order[: order.index(state) + 1]
    assert [one[1] for one in sender.states] == told


@pytest.mark.parametrize(("good", "tec"), [(6, 20), (7, 10), (8, 0), (9, 0)])
def test_tec_drifts_up_when_more_than_1_in_9_transmissions_fail(good: int, tec: int) -> None:
    """+8 for a failure, -1 for each success: ten rounds of one failure and so many successes."""
    script: list[list[Disruption]] = []
    for _ in range(10):
        script.append([flip()])
        script.extend([[] for _ in range(good)])
    bus = Bus([Talker(*((at * MS, FRAME) for at in range(10 * good))), Talker()], Script(*script))
    bus.loop.run_until(10 * good * MS)
    assert bus.medium.ports[0].tec == tec


def test_reception_lowers_a_rec_above_127_to_120() -> None:
    """One good frame ends the passive state of a receiver."""
    receiver = Talker()
    bus = Bus([Talker((0, FRAME)), receiver])
    bus.medium.ports[1].rec = 200
    bus.medium.ports[1].state = ErrorState.ERROR_PASSIVE
    bus.wire.reconsider()
    bus.loop.run_until(MS)
    assert bus.counters() == [(0, 0), (0, 120)]
    assert receiver.states == [(LENGTH * BIT, ErrorState.WARNING, 0, 120)]


# --- acknowledge, suspend -------------------------------------------------------------------------------------------


def test_lone_node_repeats_stops_at_128_and_never_goes_bus_off() -> None:
    """Nobody acknowledges; passive, it waits 8 bits more between attempts."""
    bus = Bus([Talker((0, FRAME))])
    bus.loop.run_until(50 * MS)
    port = bus.medium.ports[0]
    assert (port.tec, port.state) == (128, ErrorState.ERROR_PASSIVE)
    ends = [end for end, text in bus.rows() if text.startswith("200002A0")]
    attempt = LENGTH - 13 + 2 + 6 + 8 + 3
    gaps = [later - earlier for earlier, later in pairwise(ends)]
    assert set(gaps[:15]) == {attempt}
    assert set(gaps[15:]) == {attempt + 8}


def test_second_node_that_comes_back_ends_the_repetition() -> None:
    """NO_ACK while it lasts; then the frame gets through and the counter falls.

    Until then a receiver that does not acknowledge has the frame over and over: the passive flag of the sender looks
    like the end of the frame.
    """
    receiver = Talker()
    bus = Bus([Talker((0, FRAME)), receiver], Every(Disruption(NO_ACK, 0, 1), until_ns=5 * MS))
    bus.loop.run_until(6 * MS)
    assert bus.counters()[0][0] == 127
    assert receiver.heard[-1][0] - 5 * MS < 2 * (LENGTH + 14) * BIT
    assert bus.frames()[-1][0] * BIT == receiver.heard[-1][0]
    assert not bus.medium.waiting


def test_passive_sender_lets_others_go_first() -> None:
    """Suspend transmission: 8 bits in which an active node starts, whatever its id."""
    bus = Bus([Talker((0, FRAME), (0, FRAME)), Talker((10 * BIT, Frame(0x700, b"")))])
    bus.medium.ports[0].tec = 200
    bus.medium.ports[0].state = ErrorState.ERROR_PASSIVE
    bus.wire.reconsider()
    bus.loop.run_until(MS)
    assert [sender for _, sender in bus.frames()] == [0, 1, 0]


def test_passive_sender_alone_waits_8_bits() -> None:
    """Between its frames."""
    bus = Bus([Talker((0, FRAME), (0, FRAME)), Talker()])
    bus.medium.ports[0].tec = 200
    bus.medium.ports[0].state = ErrorState.ERROR_PASSIVE
    bus.wire.reconsider()
    bus.loop.run_until(MS)
    assert bus.frames() == [(LENGTH, 0), (2 * LENGTH + 8, 0)]


# --- bus-off --------------------------------------------------------------------------------------------------------


def test_bus_off_is_left_after_128_times_11_recessive_bits() -> None:
    """1408 us on an idle bus at 1 Mbit/s, counted from the restart; counters 0."""
    node = Talker()
    bus = Bus([node, Talker()])
    port = bus.medium.ports[0]
    port.restart_ns = 5 * MS
    bus.loop.run_until(MS)
    bus.wire.switch_off(MS, port)
    bus.loop.run_until(20 * MS)
    assert node.states == [(MS, ErrorState.BUS_OFF, 256, 0), (6 * MS + 1408 * BIT, ErrorState.ERROR_ACTIVE, 0, 0)]


def test_recovery_takes_longer_under_load() -> None:
    """Each frame brings one sequence of 11, however long it lasts."""
    node = Talker()
    frames = [(at * LENGTH * BIT, FRAME) for at in range(200)]
    bus = Bus([node, Talker(*frames), Talker()])
    port = bus.medium.ports[0]
    port.restart_ns = 0
    bus.wire.switch_off(0, port)
    bus.loop.run_until(100 * MS)
    assert [state for _, state, _, _ in node.states] == [ErrorState.BUS_OFF, ErrorState.ERROR_ACTIVE]
    assert node.states[1][0] == 128 * LENGTH * BIT


def test_port_without_restart_stays_off() -> None:
    """restart-ms 0 of Linux: somebody must do it."""
    node = Talker()
    bus = Bus([node, Talker()])
    bus.medium.ports[0].restart_ns = NEVER
    bus.wire.switch_off(0, bus.medium.ports[0])
    bus.loop.run_until(1000 * MS)
    assert [state for _, state, _, _ in node.states] == [ErrorState.BUS_OFF]


def test_bus_off_port_neither_sends_nor_hears_and_loses_its_queue() -> None:
    """What waits and what is sent meanwhile is lost and counted; afterwards it works again."""
    node = Talker((0, FRAME), (0, FRAME), (2 * MS, FRAME), (50 * MS, FRAME))
    other = Talker((3 * MS, Frame(0x222, b"")), (60 * MS, Frame(0x333, b"")))
    bus = Bus([node, other, Talker()])
    bus.medium.ports[0].restart_ns = 10 * MS
    bus.loop.run_until(50 * BIT)
    bus.wire.switch_off(bus.loop.now, bus.medium.ports[0])
    bus.loop.run_until(100 * MS)
    assert bus.medium.ports[0].lost == 2
    assert [frame.can_id for _, _, frame in node.heard] == [0x333]
    assert [sender for _, sender in bus.frames()] == [0, 1, 0, 1]


def test_receiver_never_goes_bus_off() -> None:
    """Only the TEC leads there."""
    receiver = Talker()
    bus = Bus([Talker((0, FRAME)), receiver, Talker()], Every(flip(ports=1 << 1), until_ns=30 * MS))
    bus.loop.run_until(30 * MS)
    assert ErrorState.BUS_OFF not in [state for _, state, _, _ in receiver.states]


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
