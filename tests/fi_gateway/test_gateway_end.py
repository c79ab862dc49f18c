"""The gateway as a Node: the end of injection, chance, copies, any frames, faults and effects of users."""

import copy
import pickle
from collections.abc import Callable

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from canopen_exo.bus.frame import FLAG_EXTENDED, FLAG_REMOTE, Frame
from canopen_exo.bus.node import MS, NEVER, SECOND
from fi_gateway.effects import ConstantTime, Effect, Infinite, Once
from fi_gateway.events import At, FailureProbability, Never
from fi_gateway.faults import Bias, BitFlip, Drop, Fault, StuckAt, StuckAtPayload
from fi_gateway.gateway import CONTROLLER_PORT, DRIVE_PORT, Gateway
from fi_gateway.injector import Injector, Target, stream
from fi_gateway.outlet import Outlet
from fi_gateway.trigger import Trigger
from tests.fi_gateway.gateway_at_zero import (
    CYCLE,
    POSITION,
    VELOCITY,
    ZERO,
    at,
    injector,
    joint,
    pass_through,
    status,
    values,
)

# ---- the end, and chance ------------------------------------------------------------------------------------------


def test_finish_closes_every_window_and_then_passes_frames() -> None:
    """records are closed at finish(now); an event at that very instant opens nothing."""
    parts = [
        injector(Drop(), At((0,)), Infinite(), "infinite"),
        injector(Bias(POSITION, 1), At((50,)), ConstantTime(100), "cut"),
        injector(Bias(POSITION, 1), At((100,)), ConstantTime(100), "late"),
    ]
    gateway, _ = at(ZERO, parts)
    gateway.finish(ZERO + 100)
    gateway.finish(ZERO + 100)
    found = [(r.injector, r.start_ns - ZERO, r.end_ns) for r in gateway.records]
    assert found == [("infinite", 0, NEVER), ("cut", 50, ZERO + 100)]
    frame = joint(1, 2)
    assert pass_through(gateway, ZERO + 101, frame) is frame
    assert gateway.wake_at == NEVER


STOPPED = status(3, 0)


def test_the_end_of_the_motion_ends_every_injection() -> None:
    """design.md: faults belong to the motion: with the controller's status STOPPED open windows end, no other opens."""
    parts = [
        injector(Drop(), At((0,)), Infinite(), "infinite", target=Target(True, False, (0x186,))),
        injector(Bias(POSITION, 1), At((50,)), ConstantTime(1000), "cut"),
        injector(Bias(POSITION, 2), At((10, 100)), ConstantTime(20), "over and due"),
        injector(Bias(POSITION, 4), At((200,)), ConstantTime(100), "late"),
        injector(StuckAt(VELOCITY), At((0,)), Infinite(), "waiting"),
        injector(Drop(), At((60,)), Once(), "once", target=Target(True, False, (0x187,))),
    ]
    gateway, sink = at(ZERO, parts)
    assert pass_through(gateway, ZERO + 99, Frame(0x186, b"")) is None
    gateway.receive(ZERO + 100, CONTROLLER_PORT, STOPPED, sink)
    assert sink.sent == [(DRIVE_PORT, STOPPED)]
    assert gateway.wake_at == NEVER
    for now in (100, 101, 200, 250, SECOND):
        for frame in (joint(1, 2), Frame(0x186, b""), Frame(0x187, b"")):
            assert pass_through(gateway, ZERO + now, frame) is frame
    found = [(r.injector, r.start_ns - ZERO, r.end_ns) for r in gateway.records]
    assert found == [
        ("infinite", 0, NEVER),  # its effect had no end
        ("over and due", 10, ZERO + 30),
        ("cut", 50, ZERO + 100),
        ("once", 60, ZERO + 100),
    ]
    gateway.finish(ZERO + SECOND)
    assert [(r.injector, r.start_ns - ZERO, r.end_ns) for r in gateway.records] == found


@pytest.mark.parametrize(("offset", "inside"), [(-1, True), (0, False), (1, False)])
def test_an_injection_that_the_stop_ends_is_half_open_too(offset: int, inside: bool) -> None:
    """faults.md: window [t0, t0 + D): the instant of the status frame is the first outside."""
    gateway, sink = at(ZERO, [injector(Drop(), At((0,)), ConstantTime(SECOND))])
    if not inside:
        gateway.receive(ZERO + 100, CONTROLLER_PORT, STOPPED, sink)
    frame = joint(1, 2)
    assert pass_through(gateway, ZERO + 100 + offset, frame) is (None if inside else frame)


def test_injectors_that_count_from_power_up_outlast_the_motion() -> None:
    """`from: power_up` is for what happens around the motion: its windows go on, and others open."""
    parts = [
        injector(Drop(), At((0, 500 * MS)), ConstantTime(300 * MS), "boot", from_power_up=True),
        injector(Bias(POSITION, 1), Never(), Infinite(), "motion", Trigger(("boot",))),
    ]
    gateway, sink = at(ZERO, parts)  # its first frame, at ZERO, is power-up here
    gateway.receive(ZERO + 200 * MS, CONTROLLER_PORT, STOPPED, sink)
    out = [pass_through(gateway, ZERO + now * MS, joint(1, 2)) for now in (200, 299, 300, 499, 500, 799, 800)]
    assert [frame is None for frame in out] == [True, True, False, False, True, True, False]
    assert [values(frame) for frame in out if frame is not None] == [(1, 2)] * 3  # and it triggers nothing any more
    assert [(r.injector, r.start_ns - ZERO) for r in gateway.records] == [("boot", 0), ("boot", 500 * MS)]


@pytest.mark.parametrize(
    ("port", "frame", "malformed"),
    [
        (CONTROLLER_PORT, status(2, 10), 0),
        (CONTROLLER_PORT, status(1, 0), 0),
        (CONTROLLER_PORT, status(0, 0), 0),
        (CONTROLLER_PORT, status(4, 0), 0),
        (DRIVE_PORT, STOPPED, 0),
        (CONTROLLER_PORT, Frame(0x2FF, b"\x03\x00"), 1),
        (CONTROLLER_PORT, Frame(0x2FF, b"\x03\x00\x00\x00\x00", FLAG_EXTENDED), 0),
        (CONTROLLER_PORT, Frame(0x2FE, STOPPED.data), 0),
    ],
)
def test_nothing_else_ends_the_injection(port: int, frame: Frame, malformed: int) -> None:
    """Starting, motion, unknown states, the wrong side, too short, another format, another id."""
    gateway, sink = at(ZERO, [injector(Drop(), At((0,)), Infinite())])
    gateway.receive(ZERO + 100, port, frame, sink)
    assert pass_through(gateway, ZERO + 101, joint(1, 2)) is None
    assert gateway.malformed == malformed


def test_the_gateway_reads_the_end_before_any_fault() -> None:
    """As received: an injector that drops the status frame does not blind the gateway; this one it still loses not."""
    target = Target(False, True, (0x2FF,))
    gateway, _ = at(ZERO, [injector(Drop(), At((0,)), Infinite(), target=target)])
    assert pass_through(gateway, ZERO + 50, status(2, 10), CONTROLLER_PORT) is None
    assert pass_through(gateway, ZERO + 100, STOPPED, CONTROLLER_PORT) is STOPPED


def test_a_motion_that_begins_again_is_not_injected() -> None:
    """One motion a run: time 0 stays, and spent injectors stay spent."""
    gateway, sink = at(ZERO, [injector(Drop(), At((0, SECOND)), ConstantTime(100 * MS))])
    gateway.receive(ZERO + 50 * MS, CONTROLLER_PORT, STOPPED, sink)
    gateway.receive(ZERO + SECOND - CYCLE, CONTROLLER_PORT, Frame(0x080, b"\x01"), sink)
    gateway.receive(ZERO + SECOND - CYCLE, CONTROLLER_PORT, status(2, 0), sink)
    frame = joint(1, 2)
    assert pass_through(gateway, ZERO + SECOND + 1, frame) is frame
    assert gateway.time_zero == ZERO


@pytest.mark.parametrize("copier", [copy.deepcopy, lambda gateway: pickle.loads(pickle.dumps(gateway))])
def test_a_copy_of_a_stopped_gateway_stays_stopped(copier: Callable[[Gateway], Gateway]) -> None:
    """Snapshots after the motion: nothing opens again."""
    gateway, sink = at(ZERO, [injector(Drop(), At((0, SECOND)), ConstantTime(100 * MS))])
    gateway.receive(ZERO + 50 * MS, CONTROLLER_PORT, STOPPED, sink)
    twin = copier(gateway)
    frame = joint(1, 2)
    assert pass_through(twin, ZERO + SECOND + 1, frame) is frame
    assert facts(twin) == facts(gateway)


def activations(probability: float, duration: int, until: int, seed: int) -> int:
    rng = stream(seed, 0, "x")
    event = FailureProbability(probability, MS, rng)
    one = Injector("x", Target(True, False, (0x185,)), Drop(), event, ConstantTime(duration), None, rng)
    gateway, sink = at(ZERO, [one])
    while gateway.wake_at <= ZERO + until:
        gateway.wake(gateway.wake_at, sink)
    return one.activated


@pytest.mark.long
def test_number_of_activations_is_the_renewal_count_with_dead_time() -> None:
    """5e-4 per 1 ms, 0.3 s, 7 s: n-th start = sum of n geometric gaps + 300 (n-1) ms, negative binomial (scipy).

    Mean within the 1 % two-sided normal limits and chi-squared of the counts at 1 %, over 2000 fixed seeds.
    """
    p, dead, total, runs = 5e-4, 300, 7000, 2000
    at_least = [1.0] + [float(stats.nbinom.cdf(total - dead * (n - 1) - n, n, p)) for n in range(1, 30)]
    pmf = [a - b for a, b in zip(at_least, [*at_least[1:], 0.0], strict=True)]
    mean = sum(n * q for n, q in enumerate(pmf))
    variance = sum((n - mean) ** 2 * q for n, q in enumerate(pmf))
    counts = [activations(p, dead * MS, total * MS, seed) for seed in range(runs)]
    assert abs(sum(counts) / runs - mean) < stats.norm.ppf(0.995) * (variance / runs) ** 0.5
    cells = 8
    observed = [counts.count(n) for n in range(cells)] + [sum(count >= cells for count in counts)]
    expected = [runs * q for q in pmf[:cells]] + [runs * at_least[cells]]
    assert min(expected) >= 5
    assert stats.chisquare(observed, expected).pvalue > 0.01


def noisy(name: str, cob_id: int, fault: Fault) -> Injector:
    rng = stream(7, 0, name)
    event = FailureProbability(0.05, MS, rng)
    return Injector(name, Target(True, False, (cob_id,)), fault, event, ConstantTime(11 * MS), None, rng)


def test_adding_an_injector_changes_no_other() -> None:
    """faults.md: one stream per injector; same times, same bits, on another target or after it on the same."""
    alone, _ = at(ZERO, [noisy("a", 0x185, BitFlip(POSITION, 3))])
    more, _ = at(
        ZERO,
        [
            noisy("b", 0x186, Drop(0.5)),
            noisy("a", 0x185, BitFlip(POSITION, 3)),
            noisy("c", 0x185, BitFlip(VELOCITY, 1)),
        ],
    )
    for now in range(0, 500 * MS, CYCLE):
        first = pass_through(alone, ZERO + now, joint(now, 0))
        pass_through(more, ZERO + now, Frame(0x186, bytes(8)))
        second = pass_through(more, ZERO + now, joint(now, 0))
        assert first is not None
        assert second is not None
        assert values(first)[0] == values(second)[0]
    mine = [(r.start_ns, r.end_ns, r.frames_changed) for r in alone.records]
    assert len(mine) > 5
    assert [(r.start_ns, r.end_ns, r.frames_changed) for r in more.records if r.injector == "a"] == mine


def everything() -> list[Injector]:
    return [
        noisy("flip", 0x185, BitFlip(POSITION, 2)),
        noisy("fixed", 0x185, BitFlip(None, 2, None, True)),
        noisy("drop", 0x186, Drop(0.5)),
        noisy("stuck", 0x186, StuckAt(None)),
        noisy("hold", 0x185, StuckAt(POSITION)),
        injector(Bias(VELOCITY, 2**30), Never(), ConstantTime(5 * MS), "bias", Trigger(("flip", "drop"))),
        injector(StuckAtPayload(b"\x01"), At((MS,)), Once(), "sync", target=Target(False, True, (0x080,))),
        injector(Drop(0.1), At((0,)), Infinite(), "boot", target=Target(True, True, (0x2FF, 0x0)), from_power_up=True),
    ]


def facts(gateway: Gateway) -> list[tuple[object, ...]]:
    return [
        (r.injector, r.index, r.cause, r.start_ns, r.end_ns, r.frames_seen, r.frames_changed, r.saturated)
        for r in gateway.records
    ]


@pytest.mark.parametrize("when", [0, 3, 41, 150])
def test_a_copy_taken_in_mid_run_goes_on_identically(when: int) -> None:
    """Snapshots: frames, records and draws of the copies equal those of the original, which they do not disturb."""

    def step(gateway: Gateway, n: int) -> list[Frame | None]:
        now = ZERO + n * MS
        other = Frame(0x186, (n * 77).to_bytes(4, "little"))
        return [pass_through(gateway, now, joint(n * 1000, -n)), pass_through(gateway, now, other)]

    reference, _ = at(ZERO, everything())
    whole = [step(reference, n) for n in range(200)]
    original, _ = at(ZERO, everything())
    head = [step(original, n) for n in range(when)]
    for twin in (copy.deepcopy(original), pickle.loads(pickle.dumps(original))):
        assert head + [step(twin, n) for n in range(when, 200)] == whole
        assert facts(twin) == facts(reference)
        assert twin.frames == reference.frames
    assert head + [step(original, n) for n in range(when, 200)] == whole
    assert len(facts(reference)) > 10


frames = st.one_of(
    st.builds(Frame, st.sampled_from([0x000, 0x080, 0x185, 0x186, 0x2FF, 0x7FF]), st.binary(max_size=8)),
    st.builds(Frame, st.integers(0, 0x1FFFFFFF), st.binary(max_size=8), st.just(FLAG_EXTENDED)),
    st.builds(Frame, st.sampled_from([0x080, 0x185, 0x2FF]), st.just(b""), st.just(FLAG_REMOTE), st.integers(0, 15)),
    st.builds(lambda: status(2, 0)),
    st.builds(lambda: status(3, 0)),
)


@pytest.mark.long
@settings(max_examples=200, deadline=None)
@given(st.lists(st.tuples(st.integers(0, 3 * MS), st.sampled_from([0, 1]), frames), max_size=60))
def test_no_frame_makes_the_gateway_raise(traffic: list[tuple[int, int, Frame]]) -> None:
    """Must not raise whatever the bytes; flagged frames pass; what is not out was lost by a fault."""
    gateway, now, out = Gateway(everything(), CYCLE), 0, 0
    for gap, port, frame in traffic:
        now += gap
        result = pass_through(gateway, now, frame, port)
        out += result is not None
        if frame.flags:
            assert result is frame
        elif result is not None:
            assert (result.can_id, result.dlc) == (frame.can_id, frame.dlc)
    assert out + sum(gateway.lost) == sum(gateway.frames) == len(traffic)
    gateway.finish(now)
    for record in gateway.records:
        assert record.start_ns <= record.end_ns <= now + 1 or record.duration_ns >= NEVER


class Reverse(Fault):
    """A fault as a user writes it."""

    def apply(self, now: int, frame: Frame, outlet: Outlet) -> Frame | None:
        return Frame(frame.can_id, frame.data[::-1])


def test_users_can_bring_their_own_fault() -> None:
    """One small class per fault; an equal frame that is another object is no manifestation."""
    one = injector(Reverse(None), At((0,)), Infinite())
    gateway, _ = at(ZERO, [one])
    out = pass_through(gateway, ZERO, Frame(0x185, b"\x01\x02"))
    assert out is not None
    assert out.data == b"\x02\x01"
    pass_through(gateway, ZERO, Frame(0x185, b"\x03\x03"))
    assert (one.injected, one.manifested) == (2, 1)


class TwoFrames(Effect):
    """An effect as a user writes it: two frames, then armed again."""

    def __init__(self) -> None:
        super().__init__(2, True)


def test_an_effect_counted_in_frames_can_arm_again() -> None:
    """faults.md: then the injector re-arms (frames); the next event is on time although a frame ended the window."""
    gateway, _ = at(ZERO, [injector(Drop(), At((10, 100)), TwoFrames())])
    times = (9, 10, 20, 30, 99, 100, 101, 102)
    out = [pass_through(gateway, ZERO + now, joint(1, 2)) is None for now in times]
    assert out == [False, True, True, False, False, True, True, False]
    assert gateway.wake_at == NEVER
