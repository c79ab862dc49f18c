"""Events: times on the grid, against the geometric distribution of scipy; and frames with which something begins.

The distributions of all the others: test_distributions.
"""

import copy
import pickle
import struct
from math import floor

import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.random import PCG64, Generator
from scipy import stats

from canopen_exo.bus.frame import Frame
from canopen_exo.bus.node import MS, NEVER
from canopen_exo.plan import HLC_STATUS, POSITION, SYNC, TPDO1
from canopen_exo.signal import Signal
from fi_gateway.conditions import Condition, Reading, Within
from fi_gateway.distributions import Binomial, Exponential, Poisson
from fi_gateway.errors import FaultError
from fi_gateway.events import (
    FROM_CONTROLLER,
    FROM_DRIVES,
    At,
    Drawn,
    Event,
    Every,
    FailureOfFrame,
    FailureProbability,
    GaitPhase,
    Never,
    When,
)


def rng(seed: int = 1) -> Generator:
    return Generator(PCG64(seed))


@pytest.mark.parametrize(
    ("after", "due"),
    [(0, 10), (9, 10), (10, 10), (11, 20), (20, 20), (21, 30), (30, 30), (31, NEVER), (NEVER, NEVER)],
)
def test_at_gives_the_first_time_not_before(after: int, due: int) -> None:
    """A time inside an activation is passed over; at the very end of one the injector is free again."""
    assert At((30, 10, 20, 20)).next(after) == due


def test_at_may_name_time_0() -> None:
    """The first moment of the motion can be hit."""
    assert At((0, 5)).first() == 0


@pytest.mark.parametrize("times", [(), (-1,), (5, -1), (NEVER,)])
def test_at_refuses_times_outside_the_run(times: tuple[int, ...]) -> None:
    """Time 0 is the start of the motion."""
    with pytest.raises(FaultError, match="one or more times"):
        At(times)


def test_never_never_comes() -> None:
    """faults.md: never (trigger only)."""
    assert (Never().first(), Never().next(5)) == (NEVER, NEVER)


@pytest.mark.parametrize(
    ("after", "due"),
    [(0, 1 * MS), (1, 1 * MS), (MS - 1, 1 * MS), (MS, 2 * MS), (MS + 1, 2 * MS), (7 * MS + 1, 8 * MS)],
)
def test_trials_lie_on_the_grid_from_time_0_and_strictly_after(after: int, due: int) -> None:
    """p = 1: every grid point k >= 1 is an event; none at time 0, none at the end of an activation."""
    assert FailureProbability(1.0, MS, rng()).next(after) == due


@given(
    st.floats(1e-6, 1.0),
    st.integers(1, 10**9),
    st.lists(st.integers(0, 10**10), min_size=1, max_size=20).map(sorted),
    st.integers(0, 2**32),
)
def test_the_grid_goes_on_after_expiry(probability: float, period: int, ends: list[int], seed: int) -> None:
    """faults.md: a geometric gap on a grid from time 0; the grid goes on after expiry."""
    event = FailureProbability(probability, period, rng(seed))
    for end in ends:
        due = event.next(end)
        assert due == NEVER or (due > end and due % period == 0)


def test_gaps_are_geometric() -> None:
    """P(gap = k periods) = p (1 - p)^(k-1): chi-squared over 4000 seeds, 1 %, cells of at least 5 expected."""
    p, n, cells = 0.2, 4000, 24
    gaps = [FailureProbability(p, MS, rng(seed)).first() // MS for seed in range(n)]
    observed = [gaps.count(k) for k in range(1, cells)] + [sum(gap >= cells for gap in gaps)]
    expected = [n * stats.geom.pmf(k, p) for k in range(1, cells)] + [n * stats.geom.sf(cells - 1, p)]
    assert min(expected) >= 5
    assert stats.chisquare(observed, expected).pvalue > 0.01


def test_gaps_after_an_end_off_the_grid_are_geometric_too() -> None:
    """The first trial after an end between two grid points is the next grid point, with full probability."""
    p, n = 0.2, 4000
    hits = sum(FailureProbability(p, MS, rng(seed)).next(5 * MS + 7) == 6 * MS for seed in range(n))
    assert stats.binomtest(hits, n, p).pvalue > 0.01


def test_rate_is_per_stated_period() -> None:
    """faults.md: 5e-4 per 1 ms = 0.5 faults/s; the mean gap is 2 s, within 1 % two-sided (mean of 4000)."""
    gaps = [FailureProbability(5e-4, MS, rng(seed)).first() / 1e9 for seed in range(4000)]
    mean, sd = stats.geom.stats(5e-4)
    z = (sum(gaps) / len(gaps) - mean * 1e-3) / (float(sd) ** 0.5 * 1e-3 / len(gaps) ** 0.5)
    assert abs(z) < stats.norm.ppf(0.995)


def test_an_announced_event_not_used_up_stays_valid() -> None:
    """An activation by trigger that ends before the drawn time neither redraws nor moves it."""
    event = FailureProbability(0.01, MS, rng())
    due = event.first()
    state = copy.deepcopy(event)
    assert event.next(due - 1) == due
    assert event.next(due - 1) == due
    assert event.next(due) == state.next(due) > due


@pytest.mark.parametrize("probability", [0.0, 1e-300])
def test_probability_0_never_comes(probability: float) -> None:
    """No gap overflows."""
    assert FailureProbability(probability, MS, rng()).first() == NEVER


@pytest.mark.parametrize(
    ("probability", "period", "message"),
    [
        (-1e-9, MS, r"0\.\.1"),
        (1.0000001, MS, r"0\.\.1"),
        (float("nan"), MS, r"0\.\.1"),
        (0.5, 0, "1 ns and more"),
        (0.5, -1, "1 ns and more"),
    ],
)
def test_bad_parameters_are_refused(probability: float, period: int, message: str) -> None:
    """The message names what is allowed."""
    with pytest.raises(FaultError, match=message):
        FailureProbability(probability, period, rng())


# --- drawn times -----------------------------------------------------------------------------------------------------


@given(
    st.sampled_from([Exponential(3e6), Poisson(0.7, MS), Poisson(4, 7), Binomial(5, 0.5, MS)]),
    st.lists(st.integers(0, 10**8), min_size=1, max_size=20).map(sorted),
    st.integers(0, 2**32),
)
def test_a_drawn_time_does_not_lie_in_the_past_and_stays_until_it_is_over(
    distribution: Exponential | Poisson | Binomial, ends: list[int], seed: int
) -> None:
    """An announced event is not drawn again; those that count periods lie on the grid from time 0."""
    event = Drawn(distribution, rng(seed))
    for end in ends:
        due = event.next(end)
        assert due >= end
        assert event.next(due) == due
        assert not distribution.period_ns or due % distribution.period_ns == 0


def test_no_periods_are_the_next_grid_point() -> None:
    """binomial with p = 0: at once, on the grid; at its end an injector on the grid is hit again."""
    event = Drawn(Binomial(3, 0.0, MS), rng())
    assert [event.next(after) for after in (0, 1, MS, MS + 1)] == [0, MS, MS, 2 * MS]


def test_a_drawn_time_beyond_all_time_is_never() -> None:
    """Nothing overflows."""
    assert Drawn(Poisson(1e9, NEVER // 2), rng()).first() == NEVER


# --- frames ----------------------------------------------------------------------------------------------------------

TARGET = Frame(0x185, bytes(8))


def test_every_nth_frame_is_counted_from_time_0() -> None:
    """every {n} frames: n, 2n, 3n ..., whatever the injector does meanwhile."""
    event = Every(3)
    assert event.watches_target
    assert event.first() == NEVER
    times = [-2, -1, 0, *range(1, 20)]
    assert [now for now in times if event.observe(now, TARGET)] == [2, 5, 8, 11, 14, 17]


def test_frames_before_time_0_have_no_trial() -> None:
    """p = 1: from the first frame after time 0 on every one; p = 0: none, and nothing is drawn."""
    event = FailureOfFrame(1.0, rng())
    assert event.watches_target
    assert event.first() == NEVER
    assert [event.observe(now, TARGET) for now in (-5, -1, 0, 1, 7)] == [False, False, True, True, True]
    unused, source = rng(4), rng(4)
    never = FailureOfFrame(0.0, source)
    assert not any(never.observe(now, TARGET) for now in range(1000))
    assert source.random() == unused.random()


@pytest.mark.parametrize("build", [lambda: Every(0), lambda: FailureOfFrame(1.1, rng()), lambda: GaitPhase(1.0)])
def test_bad_frame_events_are_refused(build: type[Event]) -> None:
    """The message names what is allowed."""
    with pytest.raises(FaultError, match="allowed"):
        build()


def knee(limit: int) -> Condition:
    """position of node 5 below a number of counts."""
    signal = Signal("position", "knee", "knee_TPDO1", TPDO1 + 5, 0, 32, True, 1.0, "rad", POSITION.index, 0)
    reading = Reading(FROM_DRIVES, signal)
    return Condition(Within(reading, -(1 << 40), limit - 1), [reading])


def at_position(counts: int) -> Frame:
    return Frame(TPDO1 + 5, struct.pack("<ii", counts, 0))


def test_a_condition_starts_when_it_becomes_true() -> None:
    """Rising edge: once, with the frame that makes it true; what is true at time 0 becomes true then."""
    event = When(knee(0))
    assert event.watches == ((FROM_DRIVES, 0x185),)
    assert event.first() == NEVER
    given_ = [(-9, -5), (-3, -5), (1, -5), (3, -5), (5, 2), (7, 0), (9, -1), (11, -1)]
    assert [now for now, counts in given_ if event.observe(now, at_position(counts))] == [1, 9]


def test_a_condition_may_also_be_a_level() -> None:
    """With every frame while it is true; before time 0 none."""
    event = When(knee(0), rising=False)
    given_ = [(-3, -5), (1, -5), (3, -5), (5, 2), (7, 0), (9, -1), (11, -1)]
    assert [now for now, counts in given_ if event.observe(now, at_position(counts))] == [1, 3, 9, 11]


# --- gait phase ------------------------------------------------------------------------------------------------------

CYCLES = 750  # of a stride of 1.5 s at 500 Hz
FADE_IN = 750


def walk(event: GaitPhase, last: int, stride: int = CYCLES, lost: frozenset[int] = frozenset()) -> list[int]:
    """Cycles from time 0 at which the event comes, as the controller says them on the bus. lost: cycles without SYNC.

    The gateway knows time 0 with the status frame of cycle 0; phase: floor of 1/65536 stride.
    """
    found = []
    for cycle in range(-FADE_IN, last + 1):
        due = False
        if cycle not in lost:
            due = event.observe(2 * MS * cycle if cycle > 0 else -1, Frame(SYNC, b"\x01"))
        if cycle % 10 == 0:
            state, phase = (1, 0) if cycle < 0 else (2, cycle), floor(cycle % stride / stride * 65536)
            frame = Frame(HLC_STATUS, struct.pack("<BHH", *state, phase))
            due = event.observe(2 * MS * cycle + 1 if cycle >= 0 else -1, frame) or due
        if due:
            found.append(cycle)
    return found


@pytest.mark.long
@given(st.integers(0, 65535), st.sampled_from([750, 749, 100, 250, 1001]))
def test_gait_phase_is_the_sync_nearest_to_it_in_every_stride(raw: int, stride: int) -> None:
    """Taken from the status frame and SYNC only; right on a SYNC, or within a cycle's half of it."""
    phase = raw / 65536
    last = 3 * stride + stride // 2
    found = walk(GaitPhase(phase), last, stride)
    exact = [(phase + turn) * stride for turn in range(-1, 4)]
    wanted = [cycle for cycle in exact if -0.49 < cycle < last - 0.51]
    near = [cycle for cycle in exact if -0.51 < cycle < last + 0.51]
    assert len(wanted) <= len(found) <= len(near)
    assert all(min(abs(cycle - one) for one in exact) <= 0.51 for cycle in found)  # 0.01: rounding of phase


@pytest.mark.parametrize(
    ("phase", "cycles"),
    [(0.0, [0, 750, 1500]), (0.5, [375, 1125]), (0.3, [225, 975]), (1 / 750, [1, 751, 1501]), (749 / 750, [749, 1499])],
)
def test_a_phase_on_a_cycle_is_met_in_that_cycle(phase: float, cycles: list[int]) -> None:
    """Also between two status frames, and at time 0 with the status frame that says it."""
    assert walk(GaitPhase(phase), 1505) == cycles


def test_a_phase_passed_without_sync_is_met_late_and_once() -> None:
    """0.5 is cycle 375: the next SYNC, whose own phase is one too low for that, or the next status frame."""
    assert walk(GaitPhase(0.5), 1200, lost=frozenset({375})) == [376, 1125]
    assert walk(GaitPhase(0.5), 1200, lost=frozenset(range(371, 381))) == [380, 1125]


def test_missing_syncs_do_not_change_the_pace() -> None:
    """A third of the SYNCs of the first stride is lost: phases of the second are met in their cycles all the same."""
    lost = frozenset(cycle for cycle in range(1, 700) if cycle % 3 == 1)
    for cycle in (801, 805, 809, 1499):
        assert walk(GaitPhase(cycle % CYCLES / CYCLES), 1499, lost=lost)[-1] == cycle


def test_a_status_frame_said_twice_changes_nothing() -> None:
    """No SYNC between them, in motion or before it."""
    for state in (1, 2):
        event = GaitPhase(0.5)
        for number in range(0, 360, 10):
            frame = Frame(HLC_STATUS, struct.pack("<BHH", state, number if state == 2 else 0, number * 65536 // 750))
            assert not any(event.observe(1, one) for one in (*[Frame(SYNC, b"")] * 10, frame, frame))
        met = [number for number in range(351, 400) if event.observe(1, Frame(SYNC, b""))]
        assert met == [375]


def test_a_phase_is_not_met_before_it_is_known() -> None:
    """Joined in mid-stride: from the second status frame on, and not for what lies behind."""
    event = GaitPhase(0.5)
    assert not event.observe(5, Frame(SYNC, b""))
    assert not event.observe(6, Frame(HLC_STATUS, struct.pack("<BHH", 2, 390, 390 * 65536 // 750)))
    assert not any(event.observe(7, Frame(SYNC, b"")) for _ in range(10))
    assert not event.observe(8, Frame(HLC_STATUS, struct.pack("<BHH", 2, 400, 400 * 65536 // 750)))
    assert not any(event.observe(9, Frame(SYNC, b"")) for _ in range(700))


@given(st.lists(st.tuples(st.sampled_from([SYNC, HLC_STATUS]), st.binary(max_size=8)), max_size=60))
def test_no_bytes_break_the_gait_phase_and_copies_go_on_alike(frames: list[tuple[int, bytes]]) -> None:
    """Bad bytes are data; short, starting and stopped status frames."""
    event = copied = GaitPhase(0.25)
    for cob_id, data in frames:
        copied = copy.deepcopy(copied)
        assert event.observe(3, Frame(cob_id, data)) == copied.observe(3, Frame(cob_id, data))
    assert event.watches == ((FROM_CONTROLLER, SYNC), (FROM_CONTROLLER, HLC_STATUS))


@pytest.mark.parametrize(
    "event",
    [Drawn(Exponential(1e6), rng()), FailureOfFrame(0.3, rng()), Every(4), When(knee(50)), When(knee(50), False)],
    ids=lambda one: type(one).__name__,
)
def test_a_copied_event_goes_on_alike(event: Event) -> None:
    """Snapshots: interpreted or compiled, in mid-run."""
    for now in range(200):
        event = pickle.loads(pickle.dumps(event))
        copied = copy.deepcopy(event)
        frame = at_position(now * 37 % 100)
        assert event.observe(now, frame) == copied.observe(now, frame)
        assert event.next(now * MS) == copied.next(now * MS)
        assert (event.watches, event.watches_target) == (copied.watches, copied.watches_target)
