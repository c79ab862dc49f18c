"""Frames that go on later, in addition or not at all: what holds for any traffic and any faults."""

import copy

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from canopen_exo.bus.frame import Frame
from fi_gateway.effects import ConstantTime
from fi_gateway.events import At
from fi_gateway.faults import Drop, StuckAtPayload
from fi_gateway.gateway import CONTROLLER_PORT, DRIVE_PORT
from fi_gateway.injector import Injector, Target, stream
from tests.fi_gateway.passage_faults import Beat, Bench, Rename, Sink, Slow, Twice, always

# ---- properties ---------------------------------------------------------------------------------------------------

TRAFFIC = st.lists(
    st.tuples(
        st.integers(0, 60),
        st.sampled_from([CONTROLLER_PORT, DRIVE_PORT]),
        st.sampled_from([0x080, 0x181, 0x182, 0x183]),
        st.binary(max_size=3),
    ),
    max_size=40,
)


def faults_of(kinds: list[int]) -> list[Injector]:
    """Injectors of some kinds, on 0x181 and 0x182, with windows here and there."""
    made: list[Injector] = []
    for number, kind in enumerate(kinds):
        drop, stuck = Drop(0.5), StuckAtPayload(b"\x07")
        choice = (Slow(True), Slow(False), Twice(25), Twice(0, 0x182), Rename(0x182), drop, Beat(70), stuck)
        target = Target(True, number % 2 == 0, (0x181, 0x182))
        event, rng = At(tuple(range(100 * number, 3000, 700))), stream(1, 0, f"{number}")
        made.append(Injector(f"{number}", target, choice[kind], event, ConstantTime(400), None, rng, True, True))
    return made


def served(bench: Bench, traffic: list[tuple[int, int, int, bytes]], start: int = 0) -> None:
    now = start
    for gap, port, can_id, data in traffic:
        now += gap
        bench.give(now, Frame(can_id, data), port)


@pytest.mark.long
@settings(deadline=None)
@given(TRAFFIC, st.lists(st.integers(0, 7), max_size=5))
def test_no_frame_gets_lost_or_made_without_being_counted(
    traffic: list[tuple[int, int, int, bytes]], kinds: list[int]
) -> None:
    """Frames in + inserted = frames out + lost + waiting; at the end nothing waits."""
    bench = Bench(*faults_of(kinds))
    served(bench, traffic)
    gateway = bench.gateway
    for _ in range(2):
        total = sum(gateway.frames) + sum(gateway.inserted)
        assert total == len(bench.sink.sent) + sum(gateway.lost) + gateway.waiting
        bench.until(20_000)
    assert gateway.waiting == 0
    for one in gateway.injectors:
        assert not one.lines
        records = [record for record in gateway.records if record.injector == one.name]
        assert one.manifested == sum(record.manifested for record in records)
        assert one.injected == sum(record.frames_injected for record in records)


@pytest.mark.long
@settings(deadline=None)
@given(TRAFFIC, st.lists(st.integers(0, 7), max_size=5))
def test_frames_that_are_no_target_pass_at_once_in_order(
    traffic: list[tuple[int, int, int, bytes]], kinds: list[int]
) -> None:
    """The identical frames, at the same instant, whatever happens to the others."""
    bench = Bench(*faults_of(kinds))
    served(bench, traffic)
    now, given_frames = 0, []
    for gap, port, can_id, data in traffic:
        now += gap
        if can_id not in (0x181, 0x182):
            given_frames.append((now, 1 - port, Frame(can_id, data)))
    assert [row for row in bench.sink.sent if row[2].can_id not in (0x181, 0x182)] == given_frames


@pytest.mark.long
@settings(deadline=None)
@given(TRAFFIC, st.lists(st.integers(0, 7), min_size=1, max_size=5))
def test_after_the_windows_nothing_is_left(traffic: list[tuple[int, int, int, bytes]], kinds: list[int]) -> None:
    """Activation and deactivation leave no residue: later frames pass as through an empty gateway."""
    bench = Bench(*faults_of(kinds))
    served(bench, traffic)
    bench.until(20_000)
    bench.sink.sent.clear()
    served(bench, traffic, 30_000)
    bench.until(60_000)
    plain = Bench()
    served(plain, traffic, 30_000)
    assert bench.sink.sent == plain.sink.sent


@pytest.mark.long
@settings(deadline=None)
@given(TRAFFIC, st.lists(st.integers(0, 7), max_size=4), st.integers(0, 40))
def test_a_copy_in_mid_run_goes_on_as_the_original(
    traffic: list[tuple[int, int, int, bytes]], kinds: list[int], cut: int
) -> None:
    """Snapshots: frames that wait, lines and windows are copied."""
    bench = Bench(*faults_of(kinds))
    served(bench, traffic[:cut])
    start = sum(gap for gap, _, _, _ in traffic[:cut])
    twins = [bench, copy.copy(bench)]
    twins[1].gateway = copy.deepcopy(bench.gateway)
    for twin in twins:
        twin.sink = Sink()
        served(twin, traffic[cut:], start)
        twin.until(20_000)
    assert twins[0].sink.sent == twins[1].sink.sent
    counts = [[(one.activated, one.injected, one.manifested) for one in twin.gateway.injectors] for twin in twins]
    assert counts[0] == counts[1]


@pytest.mark.long
@settings(deadline=None)
@given(TRAFFIC, st.permutations([0, 1, 2]))
def test_the_order_of_independent_injectors_does_not_matter(
    traffic: list[tuple[int, int, int, bytes]], order: list[int]
) -> None:
    """One stream per injector: on frames of their own, each draws the same whoever is written first."""

    def run(numbers: list[int]) -> list[tuple[int, int, Frame]]:
        names = ("a", "b", "c")
        bench = Bench(*(always(Drop(0.5), names[number], (0x181 + number,)) for number in numbers))
        served(bench, traffic)
        return bench.sink.sent

    assert run(order) == run([0, 1, 2])
