"""The right frames at the wrong time: what goes on when, exactly."""

import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from canopen_exo.bus.frame import Frame
from fi_gateway.distributions import Exponential, Normal, Poisson
from fi_gateway.errors import FaultError
from fi_gateway.faults import Delay, Duplicate, Replay, Resequence
from tests.fi_gateway.faults.bench import OUT, Taken, begun, joint, rng


def frame(cob_id: int, number: int) -> Frame:
    return Frame(cob_id, bytes([number]))


def test_a_constant_delay_sends_the_frame_later_in_order() -> None:
    """faults.md: sent later by a constant, order kept."""
    fault, out = begun(Delay(500)), Taken()
    assert [fault.apply(now, frame(0x185, now), out) for now in (0, 100)] == [None, None]
    assert out.late == [(500, frame(0x185, 0), True), (600, frame(0x185, 100), True)]
    assert out.inserted == []


@pytest.mark.parametrize(("reorder", "in_order"), [(False, True), (True, False)])
def test_reordering_is_said_to_the_outlet(reorder: bool, in_order: bool) -> None:
    """With `reorder` each frame goes when its time has come."""
    fault, out = begun(Delay(500, None, reorder)), Taken()
    fault.apply(0, frame(0x185, 1), out)
    assert out.late == [(500, frame(0x185, 1), in_order)]


def test_a_delay_of_nothing_leaves_the_frame_alone() -> None:
    """It goes on at once."""
    fault, one = begun(Delay(0)), frame(0x185, 1)
    assert fault.apply(5, one, OUT) is one


@given(st.integers(0, 2**32), st.lists(st.tuples(st.integers(0, 3), st.integers(0, 400)), max_size=40), st.booleans())
def test_a_drawn_delay_keeps_the_order_of_each_cob_id_unless_told_not_to(
    seed: int, steps: list[tuple[int, int]], reorder: bool
) -> None:
    """Each at now + draw, or with the one before it when that is later; never before it came, never lost."""
    law = Normal(1000.0, 800.0)
    fault, out, now, sent = begun(Delay(50, law, reorder), seed=seed), Taken(), 0, []
    for number, (which, after) in enumerate(steps):
        now += after
        sent.append((now, frame(0x181 + which, number)))
        assert fault.apply(*sent[-1], out) is None
    assert [one for _, one, _ in out.late] == [one for _, one in sent]
    stream, latest = rng(seed), dict.fromkeys(range(0x181, 0x185), 0)
    for (arrived, one), (at, _, _) in zip(sent, out.late, strict=True):
        wanted = arrived + 50 + law.draw(stream)
        if not reorder:
            wanted = latest[one.can_id] = max(wanted, latest[one.can_id])
        assert at == wanted


def test_a_law_in_periods_gives_whole_periods() -> None:
    """A distribution with a period counts periods."""
    fault, out = begun(Delay(7, Poisson(2.0, 1000), True)), Taken()
    left = [fault.apply(0, frame(0x185, 1), out) for _ in range(200)]
    assert left == [None] * 200  # 7 ns at least
    assert {(at - 7) % 1000 for at, _, _ in out.late} == {0}
    assert {(at - 7) // 1000 for at, _, _ in out.late} >= {0, 1, 2, 3}


@pytest.mark.long
def test_a_drawn_delay_has_the_law_that_was_asked_for() -> None:
    """KS at 1 % over seeds 0..19, at most 2 rejections; another mean is rejected."""
    rejected = [0, 0]
    for seed in range(20):
        fault, out = begun(Delay(0, Exponential(1e6), True), seed=seed), Taken()
        for _ in range(2000):
            fault.apply(0, frame(0x185, 1), out)
        times = [at for at, _, _ in out.late]
        for number, mean in enumerate((1e6, 1.1e6)):
            rejected[number] += stats.kstest(times, stats.expon(0, mean).cdf).pvalue < 0.01
    assert rejected[0] <= 2
    assert rejected[1] > 10


@pytest.mark.parametrize("time_ns", [-1, 1 << 61])
def test_a_delay_must_be_a_time(time_ns: int) -> None:
    """Bad parameters are refused where they are made."""
    with pytest.raises(FaultError, match=rf"delay: time {time_ns} ns given, allowed 0\.\."):
        Delay(time_ns)


def test_reversed_spans_mirror_the_arrivals() -> None:
    """Spans of 100 ns from 1000 ns on: a frame at s + x goes on at s + 200 - x; both spans, their edges included."""
    fault, out = begun(Resequence(100), now=1000), Taken()
    for now in (1000, 1001, 1030, 1099, 1100, 1150):
        assert fault.apply(now, joint(now, 0), out) is None
    assert [at for at, _, _ in out.late] == [1200, 1199, 1170, 1101, 1300, 1250]
    assert [one for _, one, _ in sorted(out.late, key=lambda row: row[0])] == [
        joint(now, 0) for now in (1099, 1030, 1001, 1000, 1150, 1100)
    ]
    assert not any(in_order for _, _, in_order in out.late)


@given(st.lists(st.integers(0, 99), min_size=1, unique=True), st.integers(0, 5), st.booleans(), st.integers(0, 2**32))
def test_no_frame_leaves_its_span(offsets: list[int], spans: int, is_random: bool, seed: int) -> None:
    """What came in one span goes on in the next one, so that spans never mix."""
    fault, out = begun(Resequence(100, is_random), seed=seed, now=7), Taken()
    start = 7 + 100 * spans
    for offset in sorted(offsets):
        assert fault.apply(start + offset, joint(offset, 0), out) is None
    assert all(start + 100 < at <= start + 200 for at, _, _ in out.late)


def test_every_random_order_is_equally_likely() -> None:
    """Chi-squared over the 6 orders of 3 frames at 1 %, seeds 0..19, at most 2 rejections; the reversed one is not."""
    rejected = 0
    for seed in range(20):
        fault, counts = Resequence(1_000_000, True), dict.fromkeys(["012", "021", "102", "120", "201", "210"], 0)
        stream = rng(seed)
        for _ in range(1200):
            fault.begin(0, {}, stream)
            out = Taken()
            for number in range(3):
                fault.apply(1000 * number, frame(0x185, number), out)
            fault.end()
            order = sorted(out.late, key=lambda row: row[0])
            counts["".join(str(one.data[0]) for _, one, _ in order)] += 1
        rejected += stats.chisquare(list(counts.values())).pvalue < 0.01
    assert rejected <= 2
    assert stats.chisquare([0, 0, 0, 0, 0, 1200]).pvalue < 0.01


@pytest.mark.parametrize("span_ns", [0, -1, 1 << 61])
def test_a_span_must_be_a_length_of_time(span_ns: int) -> None:
    """Bad parameters are refused where they are made."""
    with pytest.raises(FaultError, match=rf"resequence: span {span_ns} ns given, allowed"):
        Resequence(span_ns)


def test_duplicates_come_at_once_or_apart() -> None:
    """faults.md, EN 50159 repetition: the frame, and copies."""
    one, out = joint(1, 2), Taken()
    assert begun(Duplicate()).apply(5, one, out) is one
    assert (out.inserted, out.late) == ([one], [])
    out = Taken()
    assert begun(Duplicate(3, 100)).apply(5, one, out) is one
    assert (out.inserted, out.late) == ([], [(105, one, False), (205, one, False), (305, one, False)])


@pytest.mark.parametrize(("copies", "gap_ns"), [(0, 0), (-1, 0), (1, -1)])
def test_a_duplicate_needs_a_copy(copies: int, gap_ns: int) -> None:
    """Bad parameters are refused where they are made."""
    with pytest.raises(FaultError, match=r"duplicate: .*allowed"):
        Duplicate(copies, gap_ns)


def test_replay_records_and_then_repeats_each_cob_id() -> None:
    """The first frames pass, then the same ones come again, round and round."""
    fault = begun(Replay(2))
    sent = [frame(0x185, 1), frame(0x186, 9), frame(0x185, 2), frame(0x185, 3), frame(0x186, 8), frame(0x185, 4)]
    left = [fault.apply(n, one, OUT) for n, one in enumerate([*sent, frame(0x185, 5), frame(0x186, 7)])]
    assert left == [
        frame(0x185, 1), frame(0x186, 9), frame(0x185, 2), frame(0x185, 1), frame(0x186, 8), frame(0x185, 2),
        frame(0x185, 1), frame(0x186, 9),
    ]  # fmt: skip


def test_replay_may_add_old_frames_to_the_fresh_ones() -> None:
    """`mode: add`: the fresh frame goes on as well, after the old one."""
    fault, out = begun(Replay(1, True)), Taken()
    fresh = [frame(0x185, n) for n in range(3)]
    assert [fault.apply(n, one, out) for n, one in enumerate(fresh)] == fresh
    assert out.inserted == [fresh[0], fresh[0]]


def test_replay_needs_a_frame() -> None:
    """Bad parameters are refused where they are made."""
    with pytest.raises(FaultError, match="replay: 0 frames given"):
        Replay(0)
