"""The gateway as a Node: windows, and triggers."""

import pytest

from canopen_exo.bus.frame import Frame
from canopen_exo.bus.node import MS, NEVER, SECOND
from fi_gateway.effects import ConstantTime, Infinite, Once
from fi_gateway.errors import FaultError
from fi_gateway.events import At, Event, Never
from fi_gateway.faults import Bias, BitFlip, Drop, StuckAt, StuckAtValue
from fi_gateway.gateway import Gateway
from fi_gateway.injector import Injector
from fi_gateway.trigger import Trigger
from tests.fi_gateway.gateway_at_zero import CYCLE, POSITION, VELOCITY, ZERO, at, injector, joint, pass_through, values

# ---- windows ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("woken", [False, True])
@pytest.mark.parametrize(
    ("offset", "inside"),
    [(-MS, False), (-1, False), (0, True), (1, True), (300 * MS - 1, True), (300 * MS, False), (300 * MS + 1, False)],
)
def test_window_is_half_open_on_the_arrival_time(offset: int, inside: bool, woken: bool) -> None:
    """faults.md: window [t0, t0 + D) on the frame's arrival; at the same ns, frame before wake-up or after it."""
    gateway, sink = at(ZERO, [injector(Drop(), At((3 * SECOND,)), ConstantTime(300 * MS))])
    now = ZERO + 3 * SECOND + offset
    if woken:
        while gateway.wake_at <= now:
            gateway.wake(gateway.wake_at, sink)
    frame = joint(1, 2)
    out = pass_through(gateway, now, frame)
    assert out is (None if inside else frame)


def test_wake_at_is_exactly_the_next_opening_or_closing() -> None:
    """Injectors advance at exact event times; wake moves wake_at on."""
    gateway, sink = at(ZERO, [injector(Drop(), At((5, 100)), ConstantTime(20))])
    seen = []
    while gateway.wake_at != NEVER:
        seen.append(gateway.wake_at - ZERO)
        gateway.wake(gateway.wake_at, sink)
    assert seen == [5, 25, 100, 120]
    assert sink.sent == []


def test_an_event_while_active_is_ignored_and_one_at_the_end_counts() -> None:
    """At 0, 50 (inside), 100 (the very end): two windows, back to back."""
    gateway, sink = at(ZERO, [injector(Drop(), At((0, 50, 100)), ConstantTime(100))])
    while gateway.wake_at != NEVER:
        gateway.wake(gateway.wake_at, sink)
    assert [(r.start_ns - ZERO, r.end_ns - ZERO) for r in gateway.records] == [(0, 100), (100, 200)]


def test_once_takes_the_first_frame_after_the_event_and_no_other() -> None:
    """faults.md: once = one frame, once a run."""
    gateway, _ = at(ZERO, [injector(Drop(), At((10, 500)), Once())])
    out = [pass_through(gateway, ZERO + now, joint(1, 2)) is None for now in (9, 300, 301, 500, 501)]
    assert out == [False, True, False, False, False]
    assert (gateway.records[0].start_ns, gateway.records[0].end_ns) == (ZERO + 10, ZERO + 301)


def test_disabled_injector_injects_nothing() -> None:
    """faults.md: each can be switched off."""
    gateway, _ = at(ZERO, [injector(Drop(), At((0,)), Infinite(), enabled=False)])
    frame = joint(1, 2)
    assert pass_through(gateway, ZERO + 5, frame) is frame
    assert (gateway.records, gateway.wake_at) == ([], NEVER)


def test_frames_outside_the_windows_are_the_identical_objects() -> None:
    """Outside every window nothing changes, byte for byte; inside, every frame of the target does."""
    gateway, _ = at(ZERO, [injector(BitFlip(POSITION, 2), At((10 * MS, 50 * MS)), ConstantTime(7 * MS))])
    for now in range(0, 100 * MS, MS // 2):
        frame = joint(now, -now)
        inside = 10 * MS <= now < 17 * MS or 50 * MS <= now < 57 * MS
        assert (pass_through(gateway, ZERO + now, frame) is frame) is not inside
    assert [record.frames_changed for record in gateway.records] == [14, 14]


def test_stuck_at_holds_the_last_frame_before_t0_not_the_one_at_t0() -> None:
    """faults.md: the last value that reached this injector before t0."""
    gateway, _ = at(ZERO, [injector(StuckAt(POSITION), At((10,)), ConstantTime(10))])
    out = [pass_through(gateway, ZERO + now, joint(now, now)) for now in (4, 8, 10, 12, 19, 20)]
    assert [values(frame)[0] for frame in out if frame is not None] == [4, 8, 8, 8, 8, 20]


def test_stuck_at_ignores_a_short_frame_when_it_looks_for_the_last_correct_value() -> None:
    """A frame that does not hold the signal has no value."""
    gateway, _ = at(ZERO, [injector(StuckAt(VELOCITY), At((10,)), ConstantTime(10))])
    pass_through(gateway, ZERO + 4, joint(4, 4))
    pass_through(gateway, ZERO + 8, Frame(0x185, bytes(5)))
    out = pass_through(gateway, ZERO + 12, joint(12, 12))
    assert out is not None
    assert values(out) == (12, 4)


def test_stuck_at_holds_what_reached_this_injector() -> None:
    """Not what the gateway received: an earlier injector's output counts."""
    gateway, _ = at(
        ZERO,
        [
            injector(Bias(POSITION, 1000), At((0,)), ConstantTime(10), "bias"),
            injector(StuckAt(POSITION), At((10,)), ConstantTime(10), "stuck"),
        ],
    )
    out = [pass_through(gateway, ZERO + now, joint(now, 0)) for now in (8, 12)]
    assert [values(frame)[0] for frame in out if frame is not None] == [1008, 1008]


def test_stuck_at_without_a_value_waits_for_one() -> None:
    """faults.md: if none has yet, it waits for one; the window opens with the frame after it."""
    gateway, _ = at(ZERO, [injector(StuckAt(POSITION), At((10,)), ConstantTime(100))])
    out = [pass_through(gateway, ZERO + now, joint(now, 0)) for now in (500, 502, 601, 602)]
    assert [values(frame)[0] for frame in out if frame is not None] == [500, 500, 500, 602]
    (record,) = gateway.records
    assert (record.due_ns, record.start_ns, record.end_ns) == (ZERO + 10, ZERO + 502, ZERO + 602)


# ---- triggers -----------------------------------------------------------------------------------------------------


def knee_freeze(order: tuple[str, str], event: Event) -> list[Injector]:
    both = {
        "freeze_position": injector(StuckAt(POSITION), event, ConstantTime(300 * MS), "freeze_position"),
        "zero_velocity": injector(
            StuckAtValue(VELOCITY, 0),
            Never(),
            ConstantTime(300 * MS),
            "zero_velocity",
            Trigger(("freeze_position",)),
        ),
    }
    return [both[name] for name in order]


@pytest.mark.parametrize(
    "order", [("freeze_position", "zero_velocity"), ("zero_velocity", "freeze_position")]
)
def test_knee_freeze_holds_position_and_zeroes_velocity_in_the_same_frame(order: tuple[str, str]) -> None:
    """faults.md: delay-0 triggers take effect on the same frame, whatever the order written."""
    gateway, _ = at(ZERO, knee_freeze(order, At((20 * MS,))))
    for now in range(0, 400 * MS, CYCLE):
        out = pass_through(gateway, ZERO + now, joint(now + 1, 5))
        assert out is not None
        frozen = 20 * MS <= now < 320 * MS
        assert values(out) == ((18 * MS + 1, 0) if frozen else (now + 1, 5))
    gateway.finish(ZERO + 400 * MS)
    found = [(r.injector, r.cause, r.start_ns - ZERO, r.end_ns - ZERO, r.frames_changed) for r in gateway.records]
    assert found == [
        ("freeze_position", "event", 20 * MS, 320 * MS, 150),
        ("zero_velocity", "trigger:freeze_position", 20 * MS, 320 * MS, 150),
    ]


def test_a_trigger_from_a_waiting_injector_comes_with_its_first_frame() -> None:
    """An injector that waits for a value is not active: what it triggers starts with it, in the same frame."""
    gateway, _ = at(ZERO, knee_freeze(("zero_velocity", "freeze_position"), At((0,))))
    out = [pass_through(gateway, ZERO + now, joint(now, 5)) for now in (10, 20)]
    assert [values(frame) for frame in out if frame is not None] == [(10, 5), (10, 0)]
    assert [record.start_ns - ZERO for record in gateway.records] == [20, 20]


def test_triggers_branch_and_join() -> None:
    """faults.md: chains may branch and join; the joined one starts once."""
    parts = [
        injector(Bias(POSITION, 1), Never(), ConstantTime(50), "join", Trigger(("left", "right"))),
        injector(Bias(POSITION, 10), Never(), ConstantTime(50), "right", Trigger(("root",))),
        injector(Bias(POSITION, 100), Never(), ConstantTime(50), "left", Trigger(("root",))),
        injector(Bias(POSITION, 1000), At((7,)), ConstantTime(50), "root"),
    ]
    gateway, _ = at(ZERO, parts)
    out = pass_through(gateway, ZERO + 7, joint(0, 0))
    assert out is not None
    assert values(out)[0] == 1111
    assert [(r.injector, r.cause) for r in gateway.records] == [
        ("root", "event"),
        ("left", "trigger:root"),
        ("right", "trigger:root"),
        ("join", "trigger:left"),
    ]


def test_a_trigger_while_active_is_ignored() -> None:
    """It neither restarts nor prolongs the window."""
    parts = [
        injector(Bias(POSITION, 1), At((0, 30, 120)), ConstantTime(10), "a"),
        injector(Bias(VELOCITY, 1), Never(), ConstantTime(100), "b", Trigger(("a",))),
    ]
    gateway, sink = at(ZERO, parts)
    while gateway.wake_at != NEVER:
        gateway.wake(gateway.wake_at, sink)
    windows = [(r.start_ns - ZERO, r.end_ns - ZERO) for r in gateway.records if r.injector == "b"]
    assert windows == [(0, 100), (120, 220)]


def test_a_trigger_at_the_end_of_a_window_opens_the_next() -> None:
    """At the very end the injector is free again."""
    parts = [
        injector(Bias(POSITION, 1), At((0, 100)), ConstantTime(10), "a"),
        injector(Bias(VELOCITY, 1), Never(), ConstantTime(100), "b", Trigger(("a",))),
    ]
    gateway, sink = at(ZERO, parts)
    while gateway.wake_at != NEVER:
        gateway.wake(gateway.wake_at, sink)
    windows = [(r.start_ns - ZERO, r.end_ns - ZERO) for r in gateway.records if r.injector == "b"]
    assert windows == [(0, 100), (100, 200)]


def test_a_trigger_in_addition_to_an_own_event() -> None:
    """faults.md: in addition to or instead of its own event."""
    parts = [
        injector(Bias(POSITION, 1), At((50,)), ConstantTime(10), "a"),
        injector(Bias(VELOCITY, 1), At((10, 55, 200)), ConstantTime(20), "b", Trigger(("a",))),
    ]
    gateway, sink = at(ZERO, parts)
    while gateway.wake_at != NEVER:
        gateway.wake(gateway.wake_at, sink)
    found = [(r.start_ns - ZERO, r.cause) for r in gateway.records if r.injector == "b"]
    assert found == [(10, "event"), (50, "trigger:a"), (200, "event")]


def test_a_disabled_injector_triggers_nothing() -> None:
    """Switched off means as if it were not there."""
    parts = [
        injector(Drop(), At((0,)), Infinite(), "a", enabled=False),
        injector(Drop(), Never(), Infinite(), "b", Trigger(("a",))),
    ]
    gateway, _ = at(ZERO, parts)
    assert pass_through(gateway, ZERO + 5, joint(1, 2)) is not None


def test_bad_sets_of_injectors_are_refused() -> None:
    """Unknown trigger, cycle and double name are found before the run."""
    ring = [
        injector(Drop(), Never(), Infinite(), "a", Trigger(("b",))),
        injector(Drop(), Never(), Infinite(), "b", Trigger(("a",))),
    ]
    with pytest.raises(FaultError, match="a -> b -> a"):
        Gateway(ring, CYCLE)
    with pytest.raises(FaultError, match="SYNC period 0"):
        Gateway([], 0)
