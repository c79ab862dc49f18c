"""The gateway as a Node: passing, time 0, windows, triggers, records, snapshots. Through receive() and wake() only."""

import copy
import pickle
import struct
from collections.abc import Callable

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from canopen_exo.bus.frame import FLAG_BRS, FLAG_EXTENDED, FLAG_FD, FLAG_REMOTE, Frame
from canopen_exo.bus.node import MS, NEVER, SECOND, Out
from canopen_exo.signal import Signal
from fi_gateway.effects import ConstantTime, Effect, Infinite, Once
from fi_gateway.errors import FaultError
from fi_gateway.events import At, Event, FailureProbability, Never
from fi_gateway.faults import Bias, BitFlip, Drop, Fault, StuckAt, StuckAtPayload, StuckAtValue
from fi_gateway.gateway import CONTROLLER_PORT, DRIVE_PORT, Gateway
from fi_gateway.injector import Injector, Target, stream
from fi_gateway.outlet import Outlet
from fi_gateway.trigger import Trigger

POSITION = Signal("position", "right_knee", "right_knee_TPDO1", 0x185, 0, 32, True, 1.0, "rad", 0x6064, 0)
VELOCITY = Signal("velocity", "right_knee", "right_knee_TPDO1", 0x185, 32, 32, True, 1.0, "rad/s", 0x606C, 0)
CYCLE = 2 * MS
ZERO = 100 * MS
"""Time 0 in these tests."""


class Sink(Out):
    """Keeps what is sent."""

    def __init__(self) -> None:
        self.sent: list[tuple[int, Frame]] = []

    def send(self, port: int, frame: Frame) -> None:
        self.sent.append((port, frame))


def joint(position: int, velocity: int) -> Frame:
    return Frame(0x185, struct.pack("<ii", position, velocity))


def values(frame: Frame) -> tuple[int, int]:
    position, velocity = struct.unpack("<ii", frame.data)
    return position, velocity


def status(state: int, cycle: int, phase: int = 0) -> Frame:
    return Frame(0x2FF, struct.pack("<BHH", state, cycle, phase))


def injector(
    fault: Fault,
    event: Event,
    effect: Effect,
    name: str = "x",
    trigger: Trigger | None = None,
    target: Target | None = None,
    enabled: bool = True,
    from_power_up: bool = False,
    seed: int = 1,
) -> Injector:
    where = target if target is not None else Target(True, False, (0x185,))
    return Injector(name, where, fault, event, effect, trigger, stream(seed, 0, name), enabled, from_power_up)


def at(time_zero: int, injectors: list[Injector]) -> tuple[Gateway, Sink]:
    """A gateway that knows time 0, and has seen nothing else."""
    gateway, sink = Gateway(injectors, CYCLE), Sink()
    gateway.receive(time_zero, CONTROLLER_PORT, Frame(0x080, b"\x01"), sink)
    gateway.receive(time_zero, CONTROLLER_PORT, status(2, 0), sink)
    sink.sent.clear()
    return gateway, sink


def pass_through(gateway: Gateway, now: int, frame: Frame, port: int = DRIVE_PORT) -> Frame | None:
    """What comes out for one frame; wakes before it as a loop does (wake-ups due before now first)."""
    sink = Sink()
    while gateway.wake_at < now:
        gateway.wake(gateway.wake_at, sink)
    gateway.receive(now, port, frame, sink)
    assert all(side == 1 - port for side, _ in sink.sent)
    assert len(sink.sent) <= 1
    return sink.sent[0][1] if sink.sent else None


# ---- passing ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("port", [CONTROLLER_PORT, DRIVE_PORT])
@pytest.mark.parametrize("can_id", [0x000, 0x080, 0x185, 0x2FF, 0x7FF])
def test_without_injectors_every_frame_comes_out_on_the_other_port(port: int, can_id: int) -> None:
    """Pure store-and-forward: the identical frame."""
    gateway, frame = Gateway([], CYCLE), Frame(can_id, b"\x01\x02")
    assert pass_through(gateway, 5, frame, port) is frame
    assert gateway.frames[port] == 1


FLAGGED = [
    Frame(0x185, b"", FLAG_REMOTE, 8),
    Frame(0x185, bytes(8), FLAG_EXTENDED),
    Frame(0x18500185, bytes(8), FLAG_EXTENDED),
    Frame(0x185, bytes(8), FLAG_FD),
    Frame(0x185, bytes(64), FLAG_FD | FLAG_BRS),
]


@pytest.mark.parametrize("frame", FLAGGED)
def test_extended_remote_and_fd_frames_pass_unchanged(frame: Frame) -> None:
    """faults.md: anything else passes unchanged, with id type, DLC, RTR, FD flags kept; even with the same id."""
    gateway, _ = at(ZERO, [injector(Drop(), At((0,)), Infinite())])
    assert pass_through(gateway, ZERO + 5, frame) is frame
    assert pass_through(gateway, ZERO + 5, joint(1, 2)) is None


@pytest.mark.parametrize(
    ("to_controller", "to_drives", "lost"),
    [(True, False, [0, 1]), (False, True, [1, 0]), (True, True, [1, 1])],
)
def test_injectors_act_in_their_direction_only(to_controller: bool, to_drives: bool, lost: list[int]) -> None:
    """faults.md: bus: to_controller | to_drives | both."""
    gateway, _ = at(ZERO, [injector(Drop(), At((0,)), Infinite(), target=Target(to_controller, to_drives, (0x185,)))])
    pass_through(gateway, ZERO + 5, joint(1, 2), CONTROLLER_PORT)
    pass_through(gateway, ZERO + 5, joint(1, 2), DRIVE_PORT)
    assert gateway.lost == lost


def test_other_cob_ids_are_not_touched() -> None:
    """An injector sees its targets only."""
    gateway, _ = at(ZERO, [injector(Drop(), At((0,)), Infinite(), target=Target(True, False, (0x185, 0x187)))])
    out = [pass_through(gateway, ZERO + 5, Frame(can_id, b"")) for can_id in (0x184, 0x185, 0x186, 0x187, 0x188)]
    assert [frame is None for frame in out] == [False, True, False, True, False]


def test_faults_apply_in_the_order_written() -> None:
    """faults.md: several injectors on one target apply in the order written: +7 then stuck, and stuck then +7."""
    bias = injector(Bias(POSITION, 7), At((0,)), Infinite(), "bias")
    zero = injector(StuckAtValue(POSITION, 100), At((0,)), Infinite(), "zero")
    for order, expected in (([bias, zero], 100), ([zero, bias], 107)):
        gateway, _ = at(ZERO, copy.deepcopy(order))
        out = pass_through(gateway, ZERO + 5, joint(1, 2))
        assert out is not None
        assert values(out) == (expected, 2)


def test_a_lost_frame_does_not_reach_the_next_injector() -> None:
    """Recorded: number of frames that reached it."""
    gateway, _ = at(
        ZERO,
        [
            injector(Drop(), At((0,)), Infinite(), "drop"),
            injector(StuckAtValue(POSITION, 1), At((0,)), Infinite(), "s"),
        ],
    )
    pass_through(gateway, ZERO + 5, joint(1, 2))
    assert [(record.injector, record.frames_seen) for record in gateway.records] == [("drop", 1), ("s", 0)]


def test_a_frame_too_short_for_the_signal_passes_and_is_counted() -> None:
    """Bad bytes from the wire are data: never raise."""
    one = injector(StuckAtValue(VELOCITY, 0), At((0,)), Infinite())
    gateway, _ = at(ZERO, [one])
    short = Frame(0x185, bytes(7))
    assert pass_through(gateway, ZERO + 5, short) is short
    assert (one.too_short, gateway.records[0].frames_unfit) == (1, 1)


# ---- time 0 -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("cycle", "delay"), [(0, 0), (0, 250_000), (10, 250_000), (0, CYCLE - 1)])
def test_time_0_is_the_sync_of_the_first_status_in_motion_less_its_cycles(cycle: int, delay: int) -> None:
    """design.md: a gateway takes time 0 from the status frame only; the SYNC of cycle 0."""
    gateway, sink = Gateway([], CYCLE), Sink()
    gateway.receive(ZERO + cycle * CYCLE, CONTROLLER_PORT, Frame(0x080, b"\x07"), sink)
    gateway.receive(ZERO + cycle * CYCLE + delay, CONTROLLER_PORT, status(2, cycle), sink)
    assert gateway.time_zero == ZERO


def test_later_status_frames_do_not_move_time_0() -> None:
    """Only the first one with state MOTION counts."""
    gateway, sink = at(ZERO, [])
    gateway.receive(ZERO + 21 * CYCLE, CONTROLLER_PORT, Frame(0x080, b""), sink)
    gateway.receive(ZERO + 21 * CYCLE, CONTROLLER_PORT, status(2, 20), sink)
    assert gateway.time_zero == ZERO


@pytest.mark.parametrize(
    ("port", "frame", "malformed"),
    [
        (CONTROLLER_PORT, status(1, 0), 0),
        (CONTROLLER_PORT, status(3, 0), 0),
        (CONTROLLER_PORT, status(0, 0), 0),
        (DRIVE_PORT, status(2, 0), 0),
        (CONTROLLER_PORT, Frame(0x2FF, b"\x02\x00"), 1),
        (CONTROLLER_PORT, Frame(0x2FF, b""), 1),
        (CONTROLLER_PORT, Frame(0x2FF, b"", FLAG_REMOTE, 5), 0),
        (CONTROLLER_PORT, Frame(0x2FF, b"\x02\x00\x00\x00\x00", FLAG_EXTENDED), 0),
    ],
)
def test_nothing_else_gives_time_0(port: int, frame: Frame, malformed: int) -> None:
    """Starting, stopped, the wrong side, too short, another frame format."""
    gateway, sink = Gateway([injector(Drop(), At((0,)), Infinite())], CYCLE), Sink()
    gateway.receive(ZERO, CONTROLLER_PORT, Frame(0x080, b""), sink)
    gateway.receive(ZERO, port, frame, sink)
    assert (gateway.time_zero, gateway.malformed, gateway.wake_at) == (NEVER, malformed, NEVER)
    assert pass_through(gateway, ZERO + 5, joint(1, 2)) is not None


@pytest.mark.parametrize("sync_before", [None, CYCLE, 5 * CYCLE])
def test_a_status_frame_without_its_sync_is_passed_over(sync_before: int | None) -> None:
    """When the SYNC was missed, time 0 would be wrong by a cycle: wait for the next status frame."""
    gateway, sink = Gateway([], CYCLE), Sink()
    if sync_before is not None:
        gateway.receive(ZERO - sync_before, CONTROLLER_PORT, Frame(0x080, b""), sink)
    gateway.receive(ZERO, CONTROLLER_PORT, status(2, 0), sink)
    assert gateway.time_zero == NEVER
    gateway.receive(ZERO + 10 * CYCLE, CONTROLLER_PORT, Frame(0x080, b""), sink)
    gateway.receive(ZERO + 10 * CYCLE, CONTROLLER_PORT, status(2, 10), sink)
    assert gateway.time_zero == ZERO


def test_the_gateway_reads_time_0_before_any_fault() -> None:
    """As received: an injector that drops SYNC and status does not blind the gateway."""
    target = Target(False, True, (0x080, 0x2FF))
    drop = injector(Drop(), At((0,)), Infinite(), target=target, from_power_up=True)
    gateway, sink = Gateway([drop], CYCLE), Sink()
    gateway.receive(ZERO, CONTROLLER_PORT, Frame(0x080, b""), sink)
    gateway.receive(ZERO, CONTROLLER_PORT, status(2, 0), sink)
    assert sink.sent == []
    assert gateway.time_zero == ZERO


def test_before_time_0_injectors_are_inert() -> None:
    """design.md: faults are inert before time 0."""
    gateway, sink = Gateway([injector(Drop(), At((0,)), Infinite())], CYCLE), Sink()
    frame = joint(1, 2)
    for now in range(0, ZERO, 10 * MS):
        assert pass_through(gateway, now, frame) is frame
    gateway.receive(ZERO, CONTROLLER_PORT, Frame(0x080, b""), sink)
    assert pass_through(gateway, ZERO + 1, frame) is frame
    gateway.receive(ZERO + 200_000, CONTROLLER_PORT, status(2, 0), sink)
    assert pass_through(gateway, ZERO + 200_001, frame) is None
    assert gateway.records[0].start_ns == ZERO


def test_a_window_that_was_over_before_time_0_was_known_injects_nothing() -> None:
    """A gateway that joins late opens windows at their true times."""
    gateway, sink = Gateway([injector(Drop(), At((SECOND,)), ConstantTime(300 * MS))], CYCLE), Sink()
    gateway.receive(ZERO + 2 * SECOND, CONTROLLER_PORT, Frame(0x080, b""), sink)
    gateway.receive(ZERO + 2 * SECOND, CONTROLLER_PORT, status(2, 1000), sink)
    assert pass_through(gateway, ZERO + 2 * SECOND + 1, joint(1, 2)) is not None
    (record,) = gateway.records
    assert (record.start_ns, record.end_ns, record.frames_seen) == (ZERO + SECOND, ZERO + 1300 * MS, 0)


def test_from_power_up_counts_from_the_first_frame() -> None:
    """design.md: unless `from: power_up`; power-up is the first data frame on either port."""
    power_up = injector(Drop(), At((0, 50)), ConstantTime(10), from_power_up=True)
    gateway = Gateway([power_up, injector(Drop(), At((0,)), Infinite(), "later")], CYCLE)
    remote, boot = Frame(0x705, b"", FLAG_REMOTE, 1), Frame(0x705, b"\x00")
    assert pass_through(gateway, 900, remote) is remote
    assert pass_through(gateway, 1000, boot) is boot
    out = [pass_through(gateway, now, joint(1, 2)) is None for now in (1000, 1009, 1010, 1049, 1050, 1059, 1060)]
    assert out == [True, True, False, False, True, True, False]


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
