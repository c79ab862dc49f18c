"""Faults on the bits of an emulated bus: windows, what they hit, and the statistics of noise."""

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from canopen_exo.bus.bit_stream import field_positions
from canopen_exo.bus.disturbance import DOMINANT, FLIP, NO_ACK
from canopen_exo.bus.frame import Frame
from canopen_exo.bus.loop import Loop
from canopen_exo.bus.medium import Medium
from canopen_exo.bus.node import MS, NEVER, ErrorState, Node, Out
from canopen_exo.bus.trace import trace_hash
from canopen_exo.bus.wire import Wire
from fi_gateway.errors import FaultError
from fi_gateway.wire_faults import (
    BabblingIdiot,
    BitError,
    BitErrorRate,
    GilbertElliott,
    NoAck,
    Noise,
    StuckDominant,
    WireFault,
    mask_of,
)

BIT = 1000
FRAME = Frame(0x181, bytes(8))
SPAN = FRAME.measure() * BIT


class Ticker(Node):
    """Sends the same frame every period, and counts what it hears."""

    def __init__(self, period_ns: int = 0) -> None:
        super().__init__()
        self.period_ns = period_ns
        self.heard = 0
        self.wake_at = 0 if period_ns else NEVER

    def receive(self, now: int, port: int, frame: Frame, out: Out) -> None:
        self.heard += frame == FRAME

    def wake(self, now: int, out: Out) -> None:
        out.send(0, FRAME)
        self.wake_at = now + self.period_ns


def bus_of(nodes: list[Node], faults: list[WireFault]) -> tuple[Loop, Medium, Wire]:
    medium = Medium("bus", 0, 1_000_000)
    loop = Loop([medium])
    for node in nodes:
        loop.connect(node, [medium])
    wire = Wire(medium, list(faults))
    loop.install(wire, medium)
    return loop, medium, wire


def errors(fault: WireFault, now: int, frame: Frame | None = FRAME) -> list[tuple[int, int, int, int]]:
    found = fault.errors(now, now + SPAN, BIT, frame, 0)
    return [(one.kind, one.first, one.end, one.ports) for one in found]


def rng(seed: int = 1) -> np.random.Generator:
    return np.random.default_rng(seed)


# --- windows --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("fault", "bit"),
    [
        (BitError("data", 0), field_positions(FRAME, "data")[0]),
        (NoAck(), field_positions(FRAME, "ack")[0]),
        (StuckDominant(), 0),
        (StuckDominant(), 70),
    ],
)
def test_fault_acts_on_the_bits_that_its_window_touches(fault: WireFault, bit: int) -> None:
    """[t0, t0 + D), D one bit: whatever the attempt began at, the bit within is hit, those before and after are not."""
    assert errors(fault, 0) == []
    fault.begin(10 * MS, 10 * MS + BIT)
    met = 10 * MS - bit * BIT

    def hits(start: int) -> bool:
        return any(first <= bit < end for _, first, end, _ in errors(fault, start))

    assert [hits(met + late) for late in (-BIT, -BIT + 1, 0, BIT - 1, BIT)] == [False, True, True, True, False]
    fault.begin(30 * MS)
    fault.end(30 * MS + 1)
    assert errors(fault, 30 * MS - bit * BIT) != []
    assert errors(fault, 31 * MS) == []


@pytest.mark.parametrize("noise", [BitErrorRate(0.5, BIT, rng()), GilbertElliott(0.5, 0.5, 0.5, 0.5, BIT, rng())])
def test_noise_acts_within_its_window_only(noise: Noise) -> None:
    """Also where the window begins or ends within a frame."""
    assert errors(noise, 0) == []
    assert noise.next_ns(0) == NEVER
    noise.begin(10 * MS, 20 * MS)
    first = errors(noise, 10 * MS - 50 * BIT)
    assert first
    assert all(one[1] >= 50 for one in first)
    last = errors(noise, 20 * MS - 50 * BIT)
    assert last
    assert all(one[1] < 50 for one in last)
    assert errors(noise, 20 * MS) == []
    assert noise.next_ns(20 * MS) == NEVER


# --- what they hit --------------------------------------------------------------------------------------------------


def test_bit_error_hits_the_bit_of_the_field() -> None:
    """Stuff bits are not counted; the mask says who sees it."""
    fault = BitError("data", 12, mask_of([2, 5]))
    fault.begin(0)
    at = field_positions(FRAME, "data")[12]
    assert errors(fault, 0) == [(FLIP, at, at + 1, 0b100100)]


@pytest.mark.parametrize(
    ("fault", "hit"),
    [
        (BitError("data", 64), False),
        (BitError("data", 63), True),
        (BitError("data", 0, cob_ids=(0x182,)), False),
        (BitError("data", 0, cob_ids=(0x182, 0x181)), True),
    ],
)
def test_bit_error_passes_frames_it_is_not_for(fault: BitError, hit: bool) -> None:
    """A field that is too short, or another COB-ID."""
    fault.begin(0)
    assert bool(errors(fault, 0)) is hit
    assert errors(fault, 0, None) == []


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: BitError("payload", 0), "field 'payload' given, allowed sof, id"),
        (lambda: BitError("data", -1), "bit -1"),
        (lambda: BitErrorRate(0, BIT, rng()), "bit_error_rate: rate 0 given, allowed above 0"),
        (lambda: BitErrorRate(1.5, BIT, rng()), "bit_error_rate: rate 1.5"),
        (lambda: GilbertElliott(0, 0.1, 0, 0.5, BIT, rng()), "gilbert_elliott: enter 0"),
        (lambda: GilbertElliott(0.1, 0.1, -1, 0.5, BIT, rng()), "gilbert_elliott: rate_good -1"),
        (lambda: mask_of([-1]), "port -1 given"),
    ],
)
def test_wrong_parameters_are_refused(make: object, message: str) -> None:
    """What, where, got, allowed."""
    assert callable(make)
    with pytest.raises(FaultError, match=message):
        make()


def test_no_ack_and_stuck_dominant_say_who() -> None:
    """Their disruptions."""
    fault = NoAck(mask_of([1]))
    fault.begin(0)
    slot = field_positions(FRAME, "ack")[0]
    assert errors(fault, 0) == [(NO_ACK, slot, slot + 1, 2)]
    stuck = StuckDominant()
    stuck.begin(30 * BIT, 40 * BIT)
    assert errors(stuck, 0) == [(DOMINANT, 30, 40, -1)]
    assert (stuck.next_ns(0), stuck.next_ns(35 * BIT), stuck.next_ns(40 * BIT)) == (30 * BIT, 35 * BIT, NEVER)


# --- on a bus -------------------------------------------------------------------------------------------------------


def test_stuck_dominant_bus_stops_everything_and_comes_back() -> None:
    """All become passive, and a sender may go bus-off; then traffic goes on."""
    fault = StuckDominant()
    receiver = Ticker()
    loop, medium, _ = bus_of([Ticker(MS), receiver], [fault])
    fault.begin(5 * MS + 500_000, 15 * MS)
    loop.run_until(15 * MS)
    assert receiver.heard == 6
    assert [port.state for port in medium.ports] == [ErrorState.ERROR_PASSIVE] * 2
    loop.run_until(30 * MS)
    assert receiver.heard == 31 - 1  # what waited is sent; the frame of this instant is under way


def test_frame_under_way_when_the_bus_sticks_takes_its_sender_off() -> None:
    """TEC +8 for every 8 dominant bits."""
    fault = StuckDominant()
    loop, medium, _ = bus_of([Ticker(MS), Ticker()], [fault])
    fault.begin(5 * MS + 50 * BIT, 15 * MS)
    loop.run_until(10 * MS)
    assert [port.state for port in medium.ports] == [ErrorState.BUS_OFF, ErrorState.ERROR_PASSIVE]


def test_bus_off_takes_one_port_off() -> None:
    """It restarts as set."""
    receiver = Ticker()
    loop, medium, wire = bus_of([Ticker(MS), receiver], [])
    medium.ports[0].restart_ns = 10 * MS
    loop.run_until(MS // 2)
    wire.switch_off(loop.now, medium.ports[0])
    loop.run_until(9 * MS)
    assert receiver.heard == 1
    loop.run_until(30 * MS)
    assert receiver.heard > 15


@pytest.mark.long
@pytest.mark.parametrize("restart_ns", [0, 50 * MS])
def test_port_does_not_leave_bus_off_while_the_bus_is_dominant(restart_ns: int) -> None:
    """There is no recessive bit, so none of the 128 sequences of 11, until the bus is free."""
    fault = StuckDominant()
    loop, medium, wire = bus_of([Ticker(MS), Ticker()], [fault])
    port = medium.ports[0]
    port.restart_ns = restart_ns
    fault.begin(5 * MS + 500 * BIT, 1000 * MS)
    loop.run_until(6 * MS)
    wire.switch_off(loop.now, port)
    states = []
    for until in (1000 * MS + 128 * 11 * BIT - 1, 1000 * MS + 129 * 11 * BIT):
        loop.run_until(until)
        states.append(port.state)
    assert states == [ErrorState.BUS_OFF, ErrorState.ERROR_ACTIVE]


def test_babbling_idiot_with_id_0_starves_the_others() -> None:
    """It wins every arbitration; when it stops they go on."""
    receiver, idiot = Ticker(), BabblingIdiot(Frame(0, b""), BIT)
    loop, _, _ = bus_of([Ticker(MS), receiver, idiot], [])
    idiot.begin(5 * MS + 200 * BIT, 20 * MS)
    loop.run_until(5 * MS + 300 * BIT)
    before = receiver.heard
    passed = len(loop.trace)
    loop.run_until(20 * MS)
    assert receiver.heard == before == 6
    assert sum(row.frame.bits for row in loop.trace[passed:]) * BIT > 0.99 * (15 * MS - 300 * BIT)
    loop.run_until(25 * MS - 1)
    assert receiver.heard == 25


def test_babbling_idiot_needs_an_emulated_bus() -> None:
    """It looks into its transmit queue, which only a loop in virtual time has."""
    idiot = BabblingIdiot(Frame(0, b""), BIT)
    idiot.begin(0)
    with pytest.raises(FaultError, match="no emulated bus"):
        idiot.wake(0, Out())


def test_noise_is_the_same_with_the_same_stream() -> None:
    """One stream per name; the trace follows from it."""

    def run(seed: int, step: int) -> str:
        noise = BitErrorRate(1e-3, BIT, rng(seed))
        noise.begin(0)
        loop, _, _ = bus_of([Ticker(200 * BIT), Ticker()], [noise])
        while loop.now < 100 * MS:
            loop.run_until(min(loop.now + step, 100 * MS))
        return trace_hash(loop.trace)

    assert run(1, 100 * MS) == run(1, 333_333)
    assert run(1, 100 * MS) != run(2, 100 * MS)


def test_noise_costs_time_but_no_data() -> None:
    """All see the same: what is received is what was sent, once, unless the last bit of EOF was hit."""
    noise = BitErrorRate(5e-4, BIT, rng())
    noise.begin(0)
    receiver = Ticker()
    loop, medium, _ = bus_of([Ticker(500 * BIT), receiver], [noise])
    loop.run_until(1000 * MS)
    sent = [row for row in loop.trace if not row.frame.flags]
    assert all(row.frame == FRAME for row in sent)
    assert medium.errors > 100
    assert receiver.heard == len(sent) >= 2000


# --- statistics -----------------------------------------------------------------------------------------------------


def flips_of(noise: Noise, bits: int) -> list[int]:
    """Bits that are hit, asked in windows of a frame."""
    noise.begin(0)
    found: list[int] = []
    for now in range(0, bits * BIT, 200 * BIT):
        found += [now // BIT + one.first for one in noise.errors(now, now + 200 * BIT, BIT, FRAME, 0)]
    return found


def test_bit_error_rate_is_kept() -> None:
    """2000 expected in 2 million bits; the standard deviation is 45, five of them are allowed."""
    flips = flips_of(BitErrorRate(1e-3, BIT, rng()), 2_000_000)
    assert abs(len(flips) - 2000) < 5 * 45
    assert flips == sorted(set(flips))


def test_bursts_have_the_share_and_the_length_of_the_chain() -> None:
    """Share of bad bits enter / (enter + leave), here 1/11 and all of them hit: 1e5 / 11 = 9091.

    A burst lasts 20 bits on average, so there are about 455; five standard deviations of either are allowed (bursts:
    5 * sqrt(455) = 107; bits: 20 * 107 and as much again for their lengths).
    """
    flips = flips_of(GilbertElliott(0.005, 0.05, 0.0, 1.0, BIT, rng()), 100_000)
    bursts = 1 + sum(later - earlier > 1 for earlier, later in pairwise(flips))
    assert abs(bursts - 455) < 107
    assert abs(len(flips) - 9091) < 3000


@pytest.mark.parametrize("rate_bad", [1e-9, 1e-3])
def test_next_time_of_rare_noise_is_looked_for_in_steps(rate_bad: float) -> None:
    """The next flip may be years away: no call draws much further than asked for, and none passes over a flip."""
    noise = GilbertElliott(1e-3, 0.5, 0.0, rate_bad, BIT, rng())
    noise.begin(0)
    at, until = 0, 2000 * MS
    while at < until:
        upcoming = noise.next_ns(at)
        assert at <= upcoming < at + 30 * MS  # 1 ms, and the good state that it ends in: 1 ms on average
        assert all(flip.first * BIT + at >= upcoming for flip in noise.errors(at, upcoming, BIT, None, -1))
        at = upcoming + 1


def test_next_time_is_that_of_the_next_flip() -> None:
    """So that an idle bus is disturbed as well."""
    noise = BitErrorRate(1e-3, BIT, rng())
    noise.begin(0)
    at = noise.next_ns(0)
    assert noise.errors(at, at + BIT, BIT, None, -1)[0].first == 0
    assert noise.next_ns(at + 1) > at


# --- windows that open and close within an attempt ------------------------------------------------------------------


class Switch(Node):
    """Opens and closes the window of a fault at its times, as an injector does: the bus is told then, not before."""

    def __init__(self, wire: Wire, fault: WireFault, opens_ns: int, closes_ns: int) -> None:
        super().__init__()
        self.wire = wire
        self.fault = fault
        self.closes_ns = closes_ns
        self.wake_at = opens_ns

    def wake(self, now: int, out: Out) -> None:
        if now < self.closes_ns:
            self.fault.begin(now)
            self.wake_at = self.closes_ns
        else:
            self.fault.end(now)
            self.wake_at = NEVER
        self.wire.replan(now)


def make_fault(kind: int) -> WireFault:
    """One of each, noise with a stream of its own."""
    makers = (
        lambda: StuckDominant(),
        lambda: NoAck(),
        lambda: NoAck(mask_of([1])),
        lambda: BitError("data", 37),
        lambda: BitError("eof", 5, mask_of([1])),
        lambda: BitError("crc", 3, mask_of([0, 2])),
        lambda: BitErrorRate(0.02, BIT, rng(kind), mask_of([2])),
        lambda: BitErrorRate(0.02, BIT, rng(kind)),
        lambda: GilbertElliott(0.01, 0.1, 0.0, 0.5, BIT, rng(kind)),
    )
    return makers[kind]()


def trace_of(windows: list[tuple[int, int, int]], told_before: bool) -> tuple[list[str], list[tuple[int, int]]]:
    """What a sender, two receivers and faults with these windows leave: frames and errors, counters.

    Changes of state are left out: a success counts 3 bits later for a frame that is not worked out bit by bit.
    """
    loop, medium, wire = bus_of([Ticker(200 * BIT), Ticker(), Ticker()], [])
    for kind, opens_ns, length_ns in windows:
        fault = make_fault(kind)
        wire.disturbances.append(fault)
        if told_before:
            fault.begin(opens_ns, opens_ns + length_ns)
        else:
            switch = Switch(wire, fault, opens_ns, opens_ns + length_ns)
            loop.nodes.insert(0, switch)
            loop.outs.insert(0, loop.outs[0])
    wire.replan(0)
    loop.run_until(4 * MS)
    rows = [f"{row.end_ns} {row.frame}" for row in loop.trace if row.frame.can_id & 0x20000004 != 0x20000004]
    return rows, [(port.tec, port.rec) for port in medium.ports]


@pytest.mark.long
@settings(max_examples=60, deadline=None)
@given(
    st.lists(
        st.tuples(st.integers(0, 8), st.integers(0, 1_500_000), st.integers(1, 3000) | st.integers(1, 400_000)),
        min_size=1,
        max_size=3,
        unique_by=lambda one: one[0],
    )
)
def test_a_window_that_opens_within_an_attempt_acts_as_one_known_before(windows: list[tuple[int, int, int]]) -> None:
    """However short: the bits that it touches are hit, those that have passed stay as they were."""
    assert trace_of(windows, False) == trace_of(windows, True)
