"""A medium on which errors happen: retransmission, error states, bus-off, and who is told."""

from itertools import pairwise

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from canopen_exo.bus.disturbance import NO_ACK, Disruption
from canopen_exo.bus.frame import Frame
from canopen_exo.bus.loop import Loop
from canopen_exo.bus.medium import Medium
from canopen_exo.bus.node import MS, NEVER, ErrorState
from canopen_exo.bus.trace import trace_hash
from canopen_exo.bus.wire import Wire
from tests.canopen_exo.bus.wire_nodes import BIT, FRAME, LENGTH, Bus, Every, Script, Talker, flip

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


def test_port_is_held_off_until_it_is_let_go_as_often() -> None:
    """Windows that overlap: the first to end does not bring it back, nor does a restart that was asked for before."""
    node = Talker()
    bus = Bus([node, Talker()])
    port = bus.medium.ports[0]
    port.restart_ns = MS
    bus.wire.switch_off(0, port)
    bus.loop.run_until(MS)
    bus.wire.hold_off(MS, port)
    bus.wire.hold_off(MS, port)
    bus.loop.run_until(20 * MS)
    bus.wire.let_go(20 * MS, port)
    bus.loop.run_until(40 * MS)
    assert [state for _, state, _, _ in node.states] == [ErrorState.BUS_OFF]
    bus.wire.let_go(40 * MS, port, 2 * MS)
    bus.loop.run_until(60 * MS)
    assert [(at, state) for at, state, _, _ in node.states[1:]] == [
        (42 * MS + 128 * 11 * BIT, ErrorState.ERROR_ACTIVE)
    ]


def test_frame_that_is_repeated_keeps_its_place_in_a_queue_that_keeps_the_order() -> None:
    """Disturbed from the start, or found out to be while it is on the wire; bus-off empties the queue."""
    urgent = Frame(0x001, b"")
    bus = Bus([Talker((0, FRAME), (20 * BIT, urgent)), Talker(), Talker()], Script([flip(50)], [flip(50)]))
    bus.medium.ports[0].keep_order()
    bus.loop.run_until(2 * MS)
    assert [row.frame for row in bus.loop.trace if not row.frame.flags] == [FRAME, urgent]
    again = Bus([Talker((0, FRAME), (0, FRAME), (0, urgent)), Talker()])
    port = again.medium.ports[0]
    port.keep_order()
    again.loop.run_until(20 * BIT)
    again.wire.switch_off(again.loop.now, port)
    assert (port.queued, port.lost) == (0, 2)
    again.loop.run_until(300 * MS)
    again.medium.queue(port, urgent)
    again.loop.run_until(301 * MS)
    assert [row.frame for row in again.loop.trace if not row.frame.flags] == [FRAME, urgent]


def test_queue_that_keeps_the_order_empties_where_errors_are_possible_and_none_happens() -> None:
    """All frames of a controller go, one after the other."""
    frames = [Frame(can_id, b"") for can_id in (5, 3, 4, 9)]
    bus = Bus([Talker(*[(0, frame) for frame in frames]), Talker()])
    bus.medium.ports[0].keep_order()
    bus.loop.run_until(MS)
    assert [row.frame for row in bus.loop.trace] == frames
    assert bus.medium.ports[0].queued == 0


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
