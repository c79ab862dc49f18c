"""Windows and triggers over time: who starts whom, when, why; through receive() and wake() of a gateway."""

import copy
from collections.abc import Callable

import pytest
from scipy import stats

from canopen_exo.bus.frame import Frame
from canopen_exo.bus.node import MS, NEVER
from fi_gateway.control import LiveControl
from fi_gateway.effects import ConstantTime, Effect, Frames, Infinite, Once
from fi_gateway.errors import FaultError
from fi_gateway.events import At, Every
from fi_gateway.faults import Drop, Insert, StuckAt, StuckAtValue
from fi_gateway.gateway import DRIVE_PORT, Gateway
from fi_gateway.injector import Injector
from fi_gateway.trigger import BusFrame, Report, Trigger
from fi_gateway.windows import graph_order
from tests.fi_gateway.power_up_injectors import COUNT, Sink, injector, opened, run, tpdo

# ---- the graph ----------------------------------------------------------------------------------------------------


def names(injectors: list[Injector]) -> list[str]:
    return [one.name for one in graph_order(injectors)]


def test_sources_come_before_what_they_trigger_otherwise_as_written() -> None:
    """faults.md: triggers settle in graph order; chains may branch and join."""
    join = injector("join", trigger=Trigger((), "ended", ("left", "right"), delay_ns=3))
    left = injector("left", trigger=Trigger(("root",)))
    right = injector("right", trigger=Trigger(("root",)))
    order = names([injector("z"), join, left, right, injector("root"), injector("a")])
    assert order == ["z", "root", "left", "right", "join", "a"]


def test_a_cycle_is_refused_with_the_cycle_printed() -> None:
    """faults.md: a cycle is refused with the cycle printed, in the direction in which the triggers run."""
    ring = [
        injector("in", trigger=Trigger(("c",))),
        injector("a", trigger=Trigger(("c",))),
        injector("b", trigger=Trigger((), "manifested", ("a",), delay_ns=5)),
        injector("c", trigger=Trigger(("b",))),
    ]
    with pytest.raises(FaultError, match="c -> a -> b -> c"):
        graph_order(ring)


def test_an_injector_that_triggers_itself_is_refused() -> None:
    """The shortest cycle."""
    with pytest.raises(FaultError, match="a -> a"):
        graph_order([injector("a", trigger=Trigger(("a",)))])


def test_unknown_and_double_names_are_refused() -> None:
    """The message names what is there."""
    with pytest.raises(FaultError, match="'ghost', allowed are a, b"):
        graph_order([injector("a", trigger=Trigger(("ghost",))), injector("b")])
    with pytest.raises(FaultError, match="given twice"):
        graph_order([injector("a"), injector("a")])


# ---- signals ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("on", "start"), [("activated", 100), ("manifested", 121), ("ended", 150)]
)
def test_a_trigger_listens_to_one_of_three_signals(on: str, start: int) -> None:
    """on: activated | manifested | ended. A frame that is replaced by itself has not manifested."""
    source = injector("a", At((100,)), fault=StuckAtValue(COUNT, 5))
    gateway, _ = run(1000, [source, injector("b", trigger=Trigger(("a",), on))], ((110, tpdo(5)), (121, tpdo(6))))
    assert opened(gateway) == [("a", 100, "event"), ("b", start, "trigger:a")]


def test_a_delay_0_trigger_acts_on_the_same_frame() -> None:
    """faults.md: first all triggers settle, then faults apply in written order."""
    gateway, sink = run(
        1000,
        [injector("b", trigger=Trigger(("a",))), injector("a", At((100,))), injector("c", trigger=Trigger(("b",)))],
        ((100, tpdo(5)),),
    )
    assert sink.sent[-1] == (0, tpdo(8))
    assert {one.start_ns for one in gateway.records} == {100}


def test_manifested_catches_the_same_frame_in_those_written_behind() -> None:
    """The others, past which it has gone already, start right after it, and act from the next frame on."""
    trigger = Trigger(("a",), "manifested")
    order = [injector("before", trigger=trigger), injector("a", At((50,))), injector("behind", trigger=trigger)]
    gateway, _ = run(1000, order, ((60, tpdo()), (70, tpdo())))
    assert [(one.injector, one.start_ns, one.frames_seen) for one in gateway.records] == [
        ("a", 50, 2),
        ("behind", 60, 2),
        ("before", 61, 1),
    ]


def test_a_window_that_was_put_off_holds_the_frame_that_had_passed() -> None:
    """The stuck value is the last one before the window, which begins after the frame that started it."""
    before = injector("before", trigger=Trigger(("a",), "manifested"), fault=StuckAt(COUNT))
    gateway, sink = run(1000, [before, injector("a", At((50,)), Once())], ((40, tpdo(3)), (60, tpdo(7)), (70, tpdo(9))))
    assert [(one.injector, one.due_ns, one.start_ns) for one in gateway.records] == [("a", 50, 50), ("before", 60, 61)]
    assert [frame.data for _, frame in sink.sent[1:]] == [b"\x03", b"\x08", b"\x07"]


@pytest.mark.parametrize("effect", [Once(), Frames(1), Frames(3)])
def test_frames_inserted_by_their_own_clock_are_counted_by_the_effect(effect: Effect) -> None:
    """events.md: so many frames acted on or inserted; the target frames that go past meanwhile do not count."""
    extra = Frame(0x1FF, b"\x01")
    traffic = tuple((time, tpdo()) for time in range(51, 100, 3))
    gateway, sink = run(1000, [injector("a", At((50,)), effect, fault=Insert(extra, 10))], traffic)
    (one,) = gateway.records
    assert [frame for _, frame in sink.sent].count(extra) == effect.frames == one.frames_inserted
    assert one.end_ns == 50 + 10 * (effect.frames - 1) + 1
    assert one.first_ns == 50


def test_a_frame_that_a_fault_spares_does_not_use_an_effect_up() -> None:
    """events.md: n frames the fault acted on; a drop by chance goes on until it has lost so many."""
    traffic = tuple((time, tpdo()) for time in range(60, 960))
    gateway, _ = run(9000, [injector("a", At((50,)), Frames(4), fault=Drop(0.2))], traffic)
    (one,) = gateway.records
    assert one.frames_lost == one.frames_injected == 4
    assert one.frames_seen > 4


def test_an_event_in_the_instant_with_which_a_window_ended_is_passed_over() -> None:
    """Its window [t0, t + 1) still holds then; the next one counts."""
    gateway, _ = run(1000, [injector("a", Every(1), Frames(1))], ((60, tpdo()), (60, tpdo()), (70, tpdo())))
    assert opened(gateway) == [("a", 60, "event"), ("a", 70, "event")]


def test_a_disarmed_window_ends_after_what_it_has_met_in_that_instant() -> None:
    """end_ns is the first instant outside the window."""
    one = injector("a", At((50,)))
    gateway, _ = run(60, [one], ((60, tpdo()),))
    one.disarm(60)
    assert [(record.end_ns, record.frames_seen) for record in gateway.records] == [(61, 1)]


def test_once_has_ended_after_its_frame_not_on_it() -> None:
    """The window [t0, t + 1): what starts at its end does not meet that frame, nor another one of the same instant."""
    gateway, sink = run(
        1000,
        [injector("a", At((50,)), Once()), injector("b", trigger=Trigger(("a",), "ended"))],
        ((60, tpdo()), (60, tpdo()), (61, tpdo())),
    )
    assert opened(gateway) == [("a", 50, "event"), ("b", 61, "trigger:a")]
    assert [frame.data for _, frame in sink.sent[1:]] == [b"\x06", b"\x05", b"\x06"]


@pytest.mark.parametrize(
    ("on", "start"), [("activated", 130), ("manifested", 140), ("ended", 180)]
)
def test_all_waits_for_the_last_one(on: str, start: int) -> None:
    """all: the instant at which the last of them shows the signal while the others do."""
    sources = [injector("a", At((100,))), injector("b", At((130,)))]
    join = injector("c", trigger=Trigger((), on, ("a", "b")))
    gateway, _ = run(1000, [*sources, join], ((110, tpdo()), (140, tpdo())))
    assert opened(gateway)[2:] == [("c", start, "trigger:a+b")]


def test_all_does_not_count_what_is_over() -> None:
    """activated holds while the window is open only: [100, 150) and [160, 210) have nothing in common."""
    join = injector("c", trigger=Trigger((), "activated", ("a", "b")))
    gateway, _ = run(1000, [injector("a", At((100,))), injector("b", At((160,))), join])
    assert [one.injector for one in gateway.records] == ["a", "b"]


def test_any_fires_with_each_of_them() -> None:
    """any: whichever comes; while the window is open another one is ignored."""
    sources = [injector("a", At((100, 400))), injector("b", At((120, 300)))]
    gateway, _ = run(1000, [*sources, injector("c", trigger=Trigger(("a", "b")))])
    assert [row for row in opened(gateway) if row[0] == "c"] == [
        ("c", 100, "trigger:a"), ("c", 300, "trigger:b"), ("c", 400, "trigger:a")
    ]  # fmt: skip


def test_a_trigger_comes_in_addition_to_the_event() -> None:
    """Whichever is first; the cause says which it was."""
    gateway, _ = run(1000, [injector("a", At((100,))), injector("b", At((300,)), trigger=Trigger(("a",)))])
    assert opened(gateway)[1:] == [("b", 100, "trigger:a"), ("b", 300, "event")]


# ---- edge, delay, probability -------------------------------------------------------------------------------------


@pytest.mark.parametrize(("level", "starts"), [(False, [100]), (True, [100, 120, 140])])
def test_a_level_trigger_fires_again_while_it_holds(level: bool, starts: list[int]) -> None:
    """edge: level, as the trigger input of a FIBlock: window [100, 150) of the source, windows of 20 of the other."""
    trigger = Trigger(("a",), level=level)
    gateway, _ = run(1000, [injector("a", At((100,))), injector("b", effect=ConstantTime(20), trigger=trigger)])
    assert [one.start_ns for one in gateway.records if one.injector == "b"] == starts


@pytest.mark.parametrize(
    ("length", "delay", "starts"), [(50, 30, [130]), (50, 50, [150]), (50, 70, [170]), (29, 30, [130])]
)
def test_a_rising_trigger_fires_a_delay_later_whatever_has_ended(length: int, delay: int, starts: list[int]) -> None:
    """delay: from the instant at which the signal rises."""
    trigger = Trigger(("a",), delay_ns=delay)
    gateway, _ = run(1000, [injector("a", At((100,)), ConstantTime(length)), injector("b", trigger=trigger)])
    assert [one.start_ns for one in gateway.records if one.injector == "b"] == starts
    assert [one.due_ns for one in gateway.records if one.injector == "b"] == starts


@pytest.mark.parametrize(("length", "starts"), [(30, []), (31, [130]), (50, [130, 140])])
def test_a_level_must_have_held_for_the_delay(length: int, starts: list[int]) -> None:
    """[100, 100 + length): at 130 it has held for 30, unless it ends there."""
    trigger = Trigger(("a",), level=True, delay_ns=30)
    gateway, _ = run(
        1000,
        [injector("a", At((100,)), ConstantTime(length)), injector("b", effect=ConstantTime(10), trigger=trigger)],
    )
    assert [one.start_ns for one in gateway.records if one.injector == "b"] == starts


def test_delayed_triggers_queue_and_those_that_find_it_open_are_ignored() -> None:
    """Rises at 100, 160, 200 and delay 100: 200, 260, 300; windows of 50 from 200 and 260."""
    trigger = Trigger(("a",), delay_ns=100)
    gateway, _ = run(1000, [injector("a", At((100, 160, 200)), ConstantTime(5)), injector("b", trigger=trigger)])
    assert [one.start_ns for one in gateway.records if one.injector == "b"] == [200, 260]


@pytest.mark.long
@pytest.mark.parametrize(("probability", "right"), [(0.0, True), (0.3, True), (1.0, True), (0.3, False)])
def test_a_trigger_fires_with_its_probability(probability: float, right: bool) -> None:
    """Binomial, per rise, over seeds 0..19 at 1 %: at most 2 rejections; 0.3 is not 0.25, and the same test says so."""
    rejected = 0
    for seed in range(20):
        source = injector("a", At(tuple(range(0, 2_000_000, 1000))), ConstantTime(5))
        target = injector("b", trigger=Trigger(("a",), probability=probability), effect=ConstantTime(5), seed=seed)
        run(2_000_000, [source, target])
        expected = probability if right else 0.25
        rejected += stats.binomtest(target.activated, source.activated, expected).pvalue < 0.01
    assert (rejected <= 2) == right


def test_a_trigger_draws_from_the_stream_of_its_own_injector() -> None:
    """Another injector more or less changes no draw."""

    def starts(*more: Injector) -> list[int]:
        source = injector("a", At(tuple(range(0, 100_000, 1000))), ConstantTime(5))
        target = injector("b", trigger=Trigger(("a",), probability=0.5), effect=ConstantTime(5))
        gateway, _ = run(100_000, [*more, source, target])
        return [one.start_ns for one in gateway.records if one.injector == "b"]

    alone = starts()
    assert 0 < len(alone) < 100
    assert starts(injector("c", trigger=Trigger(("a",), probability=0.5), effect=ConstantTime(5))) == alone


def test_max_activations_ends_it() -> None:
    """Then it is spent; the records say how often."""
    one = injector("a", At((100, 200, 300)), most=2)
    gateway, _ = run(1000, [one])
    assert [record.start_ns for record in gateway.records] == [100, 200]
    assert one.phase.value == "spent"


def test_a_trigger_waits_for_a_value_like_an_event() -> None:
    """stuck_at without a value yet: opens with the frame after the first; the cause stays."""
    waits = injector("b", trigger=Trigger(("a",)), fault=StuckAt(COUNT))
    gateway, _ = run(1000, [injector("a", At((100,))), waits], ((110, tpdo()), (120, tpdo())))
    record = gateway.records[1]
    assert (record.injector, record.due_ns, record.start_ns, record.cause) == ("b", 100, 120, "trigger:a")


def test_live_control_sets_off_a_chain_with_delays() -> None:
    """trigger: with everything that hangs on it, and when."""
    gateway = Gateway([injector("a"), injector("b", trigger=Trigger(("a",), "ended", delay_ns=20))], 2 * MS)
    sink = Sink()
    gateway.receive(0, DRIVE_PORT, Frame(0x7FF, b""), sink)
    control = LiveControl(gateway)
    control.trigger("a", 100)
    while gateway.wake_at < NEVER:
        gateway.wake(gateway.wake_at, sink)
    assert opened(gateway) == [("a", 100, "command"), ("b", 170, "trigger:a")]


def test_arming_finds_a_level_that_holds_already() -> None:
    """edge: level: whenever it is armed and the condition holds."""
    late = injector("b", trigger=Trigger(("a",), level=True), effect=ConstantTime(20))
    gateway, sink = Gateway([injector("a", At((100,)), Infinite()), late], 2 * MS), Sink()
    gateway.receive(0, DRIVE_PORT, Frame(0x7FF, b""), sink)
    control = LiveControl(gateway)
    control.disarm("b", 50)
    gateway.wake(gateway.wake_at, sink)
    assert [one.injector for one in gateway.records] == ["a"]
    control.arm("b", 150)
    assert opened(gateway)[1:] == [("b", 150, "trigger:a")]


@pytest.mark.long
def test_a_copy_keeps_what_triggers_have_heard() -> None:
    """Snapshots: delays that run, levels that hold, rises that were seen."""
    injectors = [
        injector("a", At((100, 400))),
        injector("b", trigger=Trigger(("a",), delay_ns=70, probability=0.5)),
        injector("c", effect=ConstantTime(7), trigger=Trigger(("a",), level=True)),
        injector("d", trigger=Trigger((), "ended", ("a", "b"))),
    ]
    gateway, sink = Gateway(injectors, 2 * MS), Sink()
    gateway.receive(0, DRIVE_PORT, Frame(0x7FF, b""), sink)
    while gateway.wake_at < 1000:
        twin = copy.deepcopy(gateway)
        while twin.wake_at < 1000:
            twin.wake(twin.wake_at, sink)
        if gateway.wake_at < 1000:
            gateway.wake(gateway.wake_at, sink)
        later = copy.deepcopy(gateway)
        while later.wake_at < 1000:
            later.wake(later.wake_at, sink)
        assert opened(twin) == opened(later)


@pytest.mark.parametrize(
    "make",
    [
        lambda: Trigger(),
        lambda: Trigger(("a",), "started"),
        lambda: Trigger(("a",), all_of=("b",)),
        lambda: Trigger(("a",), frame=BusFrame(1, b"", b"", True, True)),
        lambda: Trigger(("a",), delay_ns=-1),
        lambda: Trigger(("a",), probability=1.01),
        lambda: Trigger(frame=BusFrame(1, b"", b"", True, True), level=True),
        lambda: BusFrame(0x800, b"", b"", True, True),
        lambda: BusFrame(1, b"\x01", b"", True, True),
        lambda: BusFrame(1, bytes(9), bytes(9), True, True),
        lambda: BusFrame(1, b"", b"", False, False),
        lambda: Report(tpdo(), "started", True, True),
        lambda: Report(tpdo(), "ended", False, False),
        lambda: injector(most=-1),
    ],
)
def test_what_cannot_be_is_refused_where_it_is_made(make: Callable[[], object]) -> None:
    """The message lists what is allowed."""
    with pytest.raises(FaultError, match="allowed"):
        make()
