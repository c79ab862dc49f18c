"""Live control of a gateway: trigger, arm, time 0, stop and resume. Through the gateway's own receive() and wake()."""

import struct
from collections.abc import Callable

import pytest

from canopen_exo.bus.frame import Frame
from canopen_exo.bus.node import MS, NEVER, SECOND
from fi_gateway.control import ControlRow, LiveControl, perform
from fi_gateway.effects import Infinite, Once
from fi_gateway.errors import FaultError
from fi_gateway.events import At, GaitPhase
from fi_gateway.faults import Drop, Fault, StuckAt, StuckAtValue
from fi_gateway.gateway import CONTROLLER_PORT, DRIVE_PORT
from fi_gateway.trigger import Trigger
from tests.fi_gateway.live_gateway import POSITION, VELOCITY, ZERO, Sink, injector, live, passes, state

# ---- trigger ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("offset", "injected"), [(-1, False), (0, True), (10 * MS - 1, True), (10 * MS, False)])
def test_trigger_opens_the_window_at_the_time_of_the_call(offset: int, injected: bool) -> None:
    """faults.md: window [t0, t0 + D); a frame stamped before the call and read after it passes."""
    control = live(injector())
    assert control.trigger("x", ZERO + SECOND)
    assert passes(control, ZERO + SECOND + offset) is not injected
    (record,) = control.gateway.records
    assert (record.cause, record.due_ns, record.start_ns) == ("command", ZERO + SECOND, ZERO + SECOND)


def test_a_triggered_injector_starts_the_chain_that_hangs_on_it() -> None:
    """A test script starts a chain: delay-0 triggers settle at the same instant."""
    control = live(
        injector("second", StuckAtValue(VELOCITY, 0), trigger=Trigger(("first",))),
        injector("first", StuckAtValue(POSITION, 0)),
        injector("other", trigger=Trigger(("second",)), event=At((5 * SECOND,))),
    )
    control.trigger("first", ZERO + 7)
    assert [(r.injector, r.cause, r.start_ns) for r in control.gateway.records] == [
        ("first", "command", ZERO + 7),
        ("second", "trigger:first", ZERO + 7),
        ("other", "trigger:second", ZERO + 7),
    ]
    assert control.gateway.wake_at == ZERO + 7 + 10 * MS


def test_a_window_that_was_due_to_end_ends_before_the_trigger_opens_the_next() -> None:
    """A call at `now` first settles what was due before."""
    control = live(injector(event=At((0,))))
    assert control.trigger("x", ZERO + 10 * MS)
    assert [(r.start_ns, r.cause) for r in control.gateway.records] == [
        (ZERO, "event"),
        (ZERO + 10 * MS, "command"),
    ]


@pytest.mark.parametrize("first", [StuckAt(POSITION), Drop()])
def test_a_trigger_for_a_waiting_or_active_injector_is_ignored(first: Fault) -> None:
    """faults.md: as any trigger that comes while waiting or active."""
    control = live(injector(fault=first))
    assert control.trigger("x", ZERO + 1)
    assert not control.trigger("x", ZERO + 2)
    assert control.rows[-1].refused.startswith("ignored")
    assert len(control.gateway.records) <= 1


def test_a_frame_stamped_before_the_trigger_gives_the_value_that_is_held() -> None:
    """StuckAt waits for a value; a window never starts before it was due."""
    control = live(injector(fault=StuckAt(POSITION)))
    control.trigger("x", ZERO + 100)
    passes(control, ZERO + 90, struct.pack("<ii", 5, 0))
    passes(control, ZERO + 95, struct.pack("<ii", 6, 0))
    (record,) = control.gateway.records
    assert (record.due_ns, record.start_ns) == (ZERO + 100, ZERO + 100)
    assert not passes(control, ZERO + 101, struct.pack("<ii", 7, 0))


@pytest.mark.parametrize(
    ("make", "why"),
    [
        (lambda: live(injector(), time_zero=False), "time 0"),
        (lambda: live(injector(from_power_up=True), time_zero=False), "first frame"),
        (lambda: live(injector(enabled=False)), "disarmed; arm it first"),
    ],
)
def test_what_is_not_armed_cannot_be_triggered(make: Callable[[], LiveControl], why: str) -> None:
    """Safe by default: the answer says what to do first."""
    control = make()
    with pytest.raises(FaultError, match=why):
        control.trigger("x", ZERO + 1)
    assert control.gateway.records == []
    assert control.rows == [ControlRow(ZERO + 1, "trigger", "x", "call", control.rows[0].refused)]


def test_a_spent_injector_can_be_triggered_once_it_is_armed_again() -> None:
    """Once = once a run, unless a person says otherwise."""
    control = live(injector(effect=Once()))
    control.trigger("x", ZERO + 1)
    assert not passes(control, ZERO + 2)
    with pytest.raises(FaultError, match="spent, its last window, or the motion, is over; arm it"):
        control.trigger("x", ZERO + 3)
    control.arm("x", ZERO + 4)
    assert control.trigger("x", ZERO + 5)
    assert not passes(control, ZERO + 6)
    assert passes(control, ZERO + 7)


@pytest.mark.parametrize("word", ["arm", "disarm", "trigger"])
def test_an_unknown_name_is_refused_with_those_there_are(word: str) -> None:
    """Errors name what is allowed; the row stays."""
    control = live(injector("a"), injector("b"))
    with pytest.raises(FaultError, match=r"'c'.*allowed: a, b"):
        perform(control, word, "c", ZERO, "call")
    assert control.rows[0].name == "c"
    assert control.rows[0].refused
    with pytest.raises(FaultError, match="no injectors"):
        perform(live(), word, "c", ZERO, "call")


# ---- arm, disarm --------------------------------------------------------------------------------------------------


def test_disarm_closes_the_window_and_nothing_opens_until_armed() -> None:
    """From the very call on, frames pass; events that come meanwhile are not made up for."""
    control = live(injector(event=At((0, 20 * MS, 40 * MS))))
    assert not passes(control, ZERO + 1)
    control.disarm("x", ZERO + 5)
    assert [passes(control, ZERO + now) for now in (5, 6, 20 * MS + 1)] == [True] * 3
    assert (control.gateway.records[0].end_ns, state(control)) == (ZERO + 5, ["disarmed"])
    control.arm("x", ZERO + 25 * MS)
    assert [passes(control, ZERO + now) for now in (25 * MS, 40 * MS - 1, 40 * MS, 50 * MS)] == [
        True,
        True,
        False,
        True,
    ]


def test_an_injector_disabled_in_the_file_waits_until_it_is_armed() -> None:
    """Never injects by default: armed only if the file or a person says so."""
    control = live(injector(event=At((0, 20 * MS)), enabled=False))
    assert passes(control, ZERO + 1)
    control.arm("x", ZERO + 2)
    assert passes(control, ZERO + 3)
    assert not passes(control, ZERO + 20 * MS)


def test_an_event_due_at_the_very_instant_of_arming_counts() -> None:
    """What was due before is over, what is due now is not."""
    control = live(injector(event=At((20 * MS,)), enabled=False))
    control.arm("x", ZERO + 20 * MS)
    assert not passes(control, ZERO + 20 * MS)


def test_armed_before_time_0_starts_with_time_0() -> None:
    """Arming does not start the clock of the events."""
    control = live(injector(event=At((MS,)), enabled=False), time_zero=False)
    control.arm("x", 5)
    assert passes(control, 6 * MS)
    control.gateway.begin(ZERO)
    assert not passes(control, ZERO + MS)


def test_disarming_does_not_wait_for_a_value_any_more() -> None:
    """A stuck_at that found no value yet is called off too."""
    control = live(injector(fault=StuckAt(POSITION), event=At((0,))))
    control.gateway.settle(ZERO)
    assert state(control) == ["waiting"]
    control.disarm("x", ZERO + 1)
    assert all(passes(control, ZERO + now, struct.pack("<ii", now, 0)) for now in (2, 3, 4))


# ---- time 0 -------------------------------------------------------------------------------------------------------


def test_start_is_time_0_for_a_rig_whose_master_does_not_say_it() -> None:
    """design.md: with a foreign master, time 0 is `exo-hil fault start`."""
    control = live(injector(event=At((MS,))), time_zero=False)
    control.start(ZERO)
    assert control.gateway.time_zero == ZERO
    assert [passes(control, ZERO + now) for now in (MS - 1, MS)] == [True, False]


def test_start_does_not_move_a_time_0_that_is_known() -> None:
    """Times in the record count from one time 0."""
    control = live(injector())
    with pytest.raises(FaultError, match=r"it was 2\.000 s ago"):
        control.start(ZERO + 2 * SECOND)
    assert control.gateway.time_zero == ZERO


def test_start_is_refused_while_an_armed_injector_waits_for_a_phase_of_the_gait() -> None:
    """design.md: with a foreign master, time 0 is `exo-hil fault start` and gait_phase is refused."""
    control = live(injector("phase", event=GaitPhase(0.3)), injector("x"), time_zero=False)
    with pytest.raises(FaultError, match=r"injector phase waits for the .* status frames .*; disarm it first"):
        control.start(ZERO)
    assert control.gateway.time_zero == NEVER
    control.disarm("phase", ZERO)
    control.start(ZERO)
    assert control.gateway.time_zero == ZERO


def test_the_bus_does_not_move_a_time_0_that_start_gave() -> None:
    """The first one counts."""
    control, sink = live(injector(), time_zero=False), Sink()
    control.start(ZERO)
    control.gateway.receive(ZERO + SECOND, CONTROLLER_PORT, Frame(0x080, b""), sink)
    control.gateway.receive(ZERO + SECOND, CONTROLLER_PORT, Frame(0x2FF, b"\2\0\0\0\0"), sink)
    assert control.gateway.time_zero == ZERO


# ---- stop and resume ----------------------------------------------------------------------------------------------


def test_pass_through_stops_all_injection_and_resume_takes_it_up() -> None:
    """SIGINT first stops injecting, then passes frames until told again."""
    control = live(
        injector("a", event=At((0, 20 * MS, 40 * MS))),
        injector("off", event=At((40 * MS,)), enabled=False),
    )
    assert not passes(control, ZERO + 1)
    control.pass_through(ZERO + 2, "signal")
    control.pass_through(ZERO + 3, "signal")  # a second one changes nothing
    assert [passes(control, ZERO + now) for now in (3, 20 * MS + 1, 21 * MS)] == [True] * 3
    assert state(control) == ["held", "disarmed"]
    with pytest.raises(FaultError, match="resume it first"):
        control.trigger("a", ZERO + 22 * MS)
    control.resume(ZERO + 25 * MS)
    control.resume(ZERO + 25 * MS)
    assert [passes(control, ZERO + now) for now in (25 * MS, 40 * MS)] == [True, False]
    assert [record.injector for record in control.gateway.records] == ["a", "a"]
    assert state(control) == ["active", "disarmed"]


def test_arming_and_disarming_while_stopped_decides_what_resume_arms() -> None:
    """Nothing is injected before resume, whoever is armed."""
    control = live(injector("a", event=At((0, SECOND))), injector("b", event=At((SECOND,)), enabled=False))
    control.pass_through(ZERO + 20 * MS)
    control.disarm("a", ZERO + 21 * MS)
    control.arm("b", ZERO + 22 * MS)
    assert state(control) == ["disarmed", "held"]
    assert control.gateway.wake_at == NEVER
    control.resume(ZERO + 23 * MS)
    assert state(control) == ["disarmed", "armed"]


def test_a_window_without_end_that_was_stopped_stays_over() -> None:
    """Infinite: spent, so that resume does not start it again by surprise."""
    control = live(injector(event=At((0,)), effect=Infinite()), injector("y", event=At((SECOND,))))
    assert not passes(control, ZERO + 1)
    control.pass_through(ZERO + 2)
    control.resume(ZERO + 3)
    assert passes(control, ZERO + 4)
    assert state(control) == ["spent", "armed"]


def test_time_0_that_comes_while_stopped_arms_nothing_before_resume() -> None:
    """Stop holds across the start of the motion."""
    control = live(injector(event=At((0, 20 * MS))), time_zero=False)
    control.pass_through(1)
    control.gateway.begin(ZERO)
    assert passes(control, ZERO + 1)
    control.resume(ZERO + 2)
    assert [passes(control, ZERO + now) for now in (3, 20 * MS)] == [True, False]


def test_frames_stay_the_same_objects_while_stopped() -> None:
    """Passing through is plain store-and-forward again."""
    control, sink = live(injector(event=At((0,)), effect=Infinite())), Sink()
    control.pass_through(ZERO)
    frames = [Frame(0x185, bytes((number,))) for number in range(5)]
    for number, frame in enumerate(frames):
        control.gateway.receive(ZERO + number, DRIVE_PORT, frame, sink)
    assert all(out is frame for (_, out), frame in zip(sink.sent, frames, strict=True))
