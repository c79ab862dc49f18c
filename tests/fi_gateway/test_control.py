"""Live control of a gateway: words, rows, and frames on the bus. Through the gateway's own receive() and wake()."""

import binascii
import copy
import re
import struct
from collections.abc import Callable
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from canopen_exo.bus.frame import FLAG_EXTENDED, FLAG_FD, FLAG_REMOTE, Frame
from canopen_exo.bus.lateness import Lateness
from canopen_exo.bus.losses import Losses
from canopen_exo.bus.node import MS, NEVER, SECOND, ErrorState, Out, PortState
from canopen_exo.plan import HLC_STATUS, STATUS_STOPPED
from canopen_exo.signal import Signal
from fi_gateway import bus_control as wire
from fi_gateway.bus_control import BusControl, Command, Status, read_command, read_status
from fi_gateway.control import (
    ControlRow,
    Direction,
    LiveControl,
    changes_text,
    latency_text,
    listing_text,
    perform,
    statistics,
    statistics_text,
)
from fi_gateway.effects import ConstantTime, Effect, Infinite, Once
from fi_gateway.errors import FaultError
from fi_gateway.events import At, Event, GaitPhase, Never
from fi_gateway.faults import Drop, Fault, StuckAt, StuckAtValue
from fi_gateway.gateway import CONTROLLER_PORT, DRIVE_PORT, Gateway
from fi_gateway.injector import Injector, Target, stream
from fi_gateway.trigger import Trigger

POSITION = Signal("position", "right_knee", "right_knee_TPDO1", 0x185, 0, 32, True, 1.0, "rad", 0x6064, 0)
VELOCITY = Signal("velocity", "right_knee", "right_knee_TPDO1", 0x185, 32, 32, True, 1.0, "rad/s", 0x606C, 0)
CYCLE = 2 * MS
ZERO = 100 * MS


class Sink(Out):
    """Keeps what is sent."""

    def __init__(self) -> None:
        self.sent: list[tuple[int, Frame]] = []

    def send(self, port: int, frame: Frame) -> None:
        self.sent.append((port, frame))


def injector(
    name: str = "x",
    fault: Fault | None = None,
    event: Event | None = None,
    effect: Effect | None = None,
    trigger: Trigger | None = None,
    enabled: bool = True,
    from_power_up: bool = False,
) -> Injector:
    return Injector(
        name,
        Target(True, False, (0x185,)),
        fault or Drop(),
        event or Never(),
        effect or ConstantTime(10 * MS),
        trigger,
        stream(1, 0, name),
        enabled,
        from_power_up,
    )


def live(*injectors: Injector, time_zero: bool = True) -> LiveControl:
    gateway = Gateway(list(injectors), CYCLE)
    if time_zero:
        gateway.begin(ZERO)
    return LiveControl(gateway)


def passes(control: LiveControl, now: int, data: bytes = bytes(8)) -> bool:
    """Whether a frame of the target comes out unchanged; wakes as a loop does."""
    sink, frame = Sink(), Frame(0x185, data)
    gateway = control.gateway
    while gateway.wake_at < now:
        gateway.wake(gateway.wake_at, sink)
    gateway.receive(now, DRIVE_PORT, frame, sink)
    return (CONTROLLER_PORT, frame) in sink.sent


def state(control: LiveControl) -> list[str]:
    return [row.state for row in control.listing()]


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


# ---- rows, listing, statistics ------------------------------------------------------------------------------------


def test_every_call_is_a_row_in_order() -> None:
    """design.md: each call is a trace row: time, what, name, from where."""
    control = live(injector(), time_zero=False)
    calls = [("arm", "x"), ("disarm", "x"), ("arm", "x"), ("start", ""), ("trigger", "x"), ("stop", ""), ("resume", "")]
    for number, (word, name) in enumerate(calls):
        assert perform(control, word, name, ZERO + number, "socket")
    assert control.rows == [
        ControlRow(ZERO + number, word, name, "socket") for number, (word, name) in enumerate(calls)
    ]
    with pytest.raises(FaultError, match="allowed: arm, disarm, trigger, start, stop, resume"):
        perform(control, "reset", "", ZERO, "call")


def test_listing_says_state_counts_and_what_comes_next() -> None:
    """In written order; next_ns is absolute."""
    control = live(injector("a", event=At((MS,))), injector("b", enabled=False))
    rows = control.listing()
    assert [(row.name, row.state, row.next_ns) for row in rows] == [
        ("a", "armed", ZERO + MS),
        ("b", "disarmed", NEVER),
    ]
    assert not passes(control, ZERO + MS)
    row = control.listing()[0]
    assert (row.state, row.activated, row.injected, row.manifested) == ("active", 1, 1, 1)
    assert listing_text(control.listing(), ZERO + MS).splitlines() == [
        "a  active    1 activations, 1 frames acted on, 1 changed; next in 0.010 s",
        "b  disarmed  0 activations, 0 frames acted on, 0 changed",
    ]
    assert listing_text([], 0) == "no injectors"


def test_listing_says_why_an_injector_does_not_act_by_itself() -> None:
    """One without an event to come is no more than armed, one that the end of the motion found armed never acted."""
    control = live(injector("a", event=At((MS,))), injector("b", event=Never()))
    assert control.listing()[1].state == "armed"
    assert (
        listing_text(control.listing(), ZERO)
        .splitlines()[1]
        .endswith("0 changed; no event to come, only a trigger or `exo-hil fault trigger` starts it")
    )
    control.gateway.receive(ZERO, CONTROLLER_PORT, Frame(HLC_STATUS, bytes((STATUS_STOPPED, 0, 0, 0, 0))), Sink())
    for line in listing_text(control.listing(), ZERO).splitlines():
        assert line.endswith("0 changed; the motion was over before it acted")
    with pytest.raises(FaultError, match="it is spent, the motion is over; arm it"):
        control.trigger("a", ZERO + 1)
    control.arm("a", ZERO + 2)
    assert control.trigger("a", ZERO + 3)


def test_statistics_are_by_direction() -> None:
    """Frames, lost, undelivered, notices, and the added latency on the way out."""
    control = live(injector(event=At((0,))))
    sink = Sink()
    for _ in range(3):
        control.gateway.receive(ZERO, CONTROLLER_PORT, Frame(0x205, b""), sink)
    control.gateway.receive(ZERO, DRIVE_PORT, Frame(0x185, bytes(8)), sink)
    control.gateway.port_changed(ZERO, PortState(DRIVE_PORT, ErrorState.WARNING, 96, 0, "x"), sink)
    to_controller, to_drives = Lateness(), Lateness()
    to_drives.add(130_000)
    drives, controller = statistics(control.gateway, [to_controller, to_drives])
    assert (drives.direction, drives.frames, drives.lost, drives.notices) == ("to_drives", 3, 0, 0)
    assert (controller.direction, controller.frames, controller.lost, controller.notices) == ("to_controller", 1, 1, 1)
    assert drives.latency is to_drives
    assert statistics_text([drives, controller]).splitlines() == [
        "to_drives: 3 frames, 0 lost by faults, added latency: median 130 us, 99 % 130 us, worst 130 us",
        "to_controller: 1 frames, 1 lost by faults, 1 error notice",
    ]


def test_statistics_count_what_faults_add() -> None:
    """Inserted frames are none that came in."""
    both = Direction("to_drives", 7, 1, 3, 0, 0, None)
    assert statistics_text([both]) == "to_drives: 7 frames, 1 lost by faults, 3 added"
def test_statistics_say_what_was_lost_in_each_direction_and_where() -> None:
    """On the way in at the one interface, on the way out at the other."""
    losses = [Losses(1, 2, 3, 4, 5), Losses(10, 20, 30, 40, 50)]
    drives, controller = statistics(live().gateway, None, losses)
    assert statistics_text([drives, controller]).splitlines() == [
        "to_drives: 0 frames, 0 lost by faults, 4 lost before they were read, 5 unreadable, 10 lost in a full queue, "
        "20 discarded in an outage, 30 not taken by the interface",
        "to_controller: 0 frames, 0 lost by faults, 40 lost before they were read, 50 unreadable, "
        "1 lost in a full queue, 2 discarded in an outage, 3 not taken by the interface",
    ]


def test_changes_of_the_interfaces_are_told_with_their_times() -> None:
    """The latest of each side, oldest first; notices that change nothing are only counted."""
    control, sink = live(), Sink()
    states = [
        (ZERO, DRIVE_PORT, ErrorState.BUS_OFF, "bus-off"),
        (ZERO + MS, CONTROLLER_PORT, ErrorState.DOWN, "interface gone"),
        (ZERO + 2 * MS, CONTROLLER_PORT, ErrorState.DOWN, "still gone"),
        (ZERO + 3 * MS, DRIVE_PORT, ErrorState.ERROR_ACTIVE, "controller restarted"),
    ]
    for time_ns, side, new, cause in states:
        control.gateway.port_changed(time_ns, PortState(side, new, 0, 0, cause), sink)
    assert changes_text(statistics(control.gateway, None)).splitlines() == [
        "drive side: bus off at 0.100 s: bus-off",
        "controller side: down at 0.101 s: interface gone",
        "drive side: error active at 0.103 s: controller restarted",
    ]


def test_a_bus_that_flaps_leaves_its_latest_changes() -> None:
    """Neither memory nor the answer to `list` grows without end, and what is told is not from days ago."""
    control, sink = live(), Sink()
    for number in range(5000):
        new = ErrorState.DOWN if number % 2 else ErrorState.ERROR_ACTIVE
        control.gateway.port_changed(number, PortState(DRIVE_PORT, new, 0, 0, "x" * 1000), sink)
    assert len(control.gateway.port_changes) < 5000
    _, controller = statistics(control.gateway, None)
    assert [one.time_ns for one in controller.changes] == list(range(4984, 5000))
    assert max(len(one.cause) for one in controller.changes) < 200


def test_histogram_of_the_added_latency_is_said_in_octaves() -> None:
    """For people, at the gateway's end; a direction in which nothing was measured has none."""
    to_drives = Lateness()
    for delay_ns in (0, 900, 1023, 1024, 130_000, 131_071, 131_072):
        to_drives.add(delay_ns)
    drives, controller = statistics(live().gateway, [Lateness(), to_drives])
    assert latency_text([drives, controller]) == (
        "to_drives: frames by added latency: <= 0.001 us: 1, <= 1 us: 2, <= 2 us: 1, <= 0.13 ms: 2, <= 0.26 ms: 1"
    )


# ---- frames on the bus --------------------------------------------------------------------------------------------


def on_bus(control: LiveControl, port: int = CONTROLLER_PORT) -> BusControl:
    bus = BusControl(control, port)
    control.gateway.attach(bus)
    return bus


def send(control: LiveControl, now: int, frame: Frame, port: int = CONTROLLER_PORT) -> list[tuple[int, Frame]]:
    sink = Sink()
    control.gateway.receive(now, port, frame, sink)
    return sink.sent


def answer(control: LiveControl, now: int, command: Command, port: int = CONTROLLER_PORT) -> Status:
    ((side, frame),) = [
        (side, frame)
        for side, frame in send(control, now, command.frame(0x6C0), port)
        if frame.data[1] != wire.ACTIVATED
    ]
    status = read_status(frame.data)
    assert (side, frame.can_id) == (port, 0x6C1)
    assert status is not None
    return status


def number(word: str) -> int:
    return {text: code for code, text in wire.WORDS.items()}[word]


def test_the_checksum_is_the_published_one() -> None:
    """CRC-16/IBM-3740: the check value of "123456789" is 0x29B1 (catalogue of parametrised CRC algorithms)."""
    assert binascii.crc_hqx(b"123456789", 0xFFFF) == 0x29B1
    data = Command(3, 0, 1).frame(0x6C0).data
    assert data[6:] == binascii.crc_hqx(data[:6], 0xFFFF).to_bytes(2, "big")


@given(st.integers(0, 255), st.integers(0, 255), st.integers(0, 255))
def test_commands_survive_the_wire(word: int, injector_number: int, sequence: int) -> None:
    """Round trip of every field."""
    command = Command(word, injector_number, sequence)
    assert read_command(command.frame(0x6C0).data) == command
    assert read_status(command.frame(0x6C0).data) is None


@given(
    st.integers(0, 255), st.integers(0, 255), st.integers(0, 255), st.integers(0, 7), st.sampled_from(list(wire.PHASES))
)
def test_statuses_survive_the_wire(result: int, injector_number: int, sequence: int, bits: int, phase: str) -> None:
    """Round trip of every field."""
    status = Status(result, injector_number, sequence, bits, phase)
    assert read_status(status.frame(0x6C1).data) == status
    assert read_command(status.frame(0x6C1).data) is None


@pytest.mark.parametrize("bit", range(64))
def test_one_wrong_bit_makes_a_command_none(bit: int) -> None:
    """A CRC-16 finds every single bit error; the frame is counted, not answered, not forwarded."""
    control = live(injector())
    bus = on_bus(control)
    good = int.from_bytes(Command(number("trigger"), 0, 1).frame(0x6C0).data, "big")
    assert send(control, ZERO, Frame(0x6C0, (good ^ 1 << bit).to_bytes(8, "big"))) == []
    assert (bus.bad, control.rows, control.gateway.records) == (1, [], [])


@given(st.binary(max_size=8))
def test_no_bytes_on_the_command_id_raise(data: bytes) -> None:
    """Bad bytes from the wire are data."""
    control = live(injector())
    bus = on_bus(control)
    send(control, ZERO, Frame(0x6C0, data))
    assert bus.bad == (read_command(data) is None)


@pytest.mark.parametrize("port", [CONTROLLER_PORT, DRIVE_PORT])
def test_a_command_frame_starts_a_chain_and_is_answered_on_its_side(port: int) -> None:
    """So that a real device can start a chain; the command goes no further."""
    control = live(injector("first"), injector("second", trigger=Trigger(("first",))))
    on_bus(control, port)
    status = answer(control, ZERO + 5, Command(number("trigger"), 0, 9), port)
    expected = Status(wire.DONE, 0, 9, wire.TIME_ZERO_KNOWN | wire.INJECTING, "active")
    assert status == expected
    assert [(r.injector, r.cause, r.start_ns) for r in control.gateway.records] == [
        ("first", "command", ZERO + 5),
        ("second", "trigger:first", ZERO + 5),
    ]
    assert control.rows == [ControlRow(ZERO + 5, "trigger", "first", "bus 0x6c0")]


def test_what_opens_is_reported_with_the_next_frame_or_wake_up() -> None:
    """An unasked status for each window, so that the next gateway or device in a chain learns of it."""
    control = live(injector("a", event=At((MS,))), injector("b", event=At((20 * MS,))))
    on_bus(control)
    sink = Sink()
    control.gateway.wake(ZERO + MS, sink)
    control.gateway.receive(ZERO + 20 * MS, DRIVE_PORT, Frame(0x185, bytes(8)), sink)
    control.gateway.receive(ZERO + 21 * MS, DRIVE_PORT, Frame(0x700, bytes(1)), sink)
    reports = [read_status(frame.data) for _, frame in sink.sent if frame.can_id == 0x6C1]
    bits = wire.TIME_ZERO_KNOWN | wire.INJECTING
    assert reports == [Status(wire.ACTIVATED, 0, 0, bits, "active"), Status(wire.ACTIVATED, 1, 0, bits, "active")]


def test_a_repeated_command_is_answered_and_not_done_again() -> None:
    """EN 50159 repetition; CAN doubles a frame whose last bit is disturbed."""
    control = live(injector(effect=ConstantTime(MS)))
    on_bus(control)
    command = Command(number("trigger"), 0, 1)
    assert answer(control, ZERO, command).result == wire.DONE
    assert answer(control, ZERO + 2 * MS, command).result == wire.REPEATED
    assert len(control.gateway.records) == 1
    assert answer(control, ZERO + 4 * MS, Command(number("trigger"), 0, 2)).result == wire.DONE
    assert len(control.gateway.records) == 2


@pytest.mark.parametrize(
    ("command", "result", "phase"),
    [
        (Command(1, 0, 1), wire.DONE, "armed"),
        (Command(2, 0, 1), wire.DONE, "disarmed"),
        (Command(3, 1, 1), wire.REFUSED, "disarmed"),
        (Command(4, 0xFF, 1), wire.REFUSED, ""),
        (Command(5, 0xFF, 1), wire.DONE, ""),
        (Command(5, 0, 1), wire.DONE, "held"),
        (Command(6, 0xFF, 1), wire.DONE, ""),
        (Command(7, 0, 1), wire.DONE, "armed"),
        (Command(7, 0xFF, 1), wire.DONE, ""),
        (Command(1, 2, 1), wire.UNKNOWN_INJECTOR, ""),
        (Command(3, 0xFF, 1), wire.UNKNOWN_INJECTOR, ""),
        (Command(7, 254, 1), wire.UNKNOWN_INJECTOR, ""),
        (Command(0, 0, 1), wire.UNKNOWN_WORD, "armed"),
        (Command(8, 0, 1), wire.UNKNOWN_WORD, "armed"),
    ],
)
def test_every_command_has_its_answer(command: Command, result: int, phase: str) -> None:
    """The table of docs/live_control.md."""
    control = live(injector("a"), injector("b", enabled=False))
    on_bus(control)
    status = answer(control, ZERO + 1, command)
    assert (status.result, status.injector, status.sequence, status.phase) == (result, command.injector, 1, phase)


def test_a_trigger_for_an_active_injector_is_answered_as_ignored() -> None:
    """As a trigger in the file."""
    control = live(injector())
    on_bus(control)
    answer(control, ZERO, Command(number("trigger"), 0, 1))
    assert answer(control, ZERO + 1, Command(number("trigger"), 0, 2)).result == wire.IGNORED


def test_commands_on_the_other_side_or_of_another_kind_pass() -> None:
    """Only classical 11-bit data frames on the chosen side are read."""
    control = live(injector())
    on_bus(control)
    command = Command(number("trigger"), 0, 1).frame(0x6C0)
    others = [
        Frame(0x6C0, command.data, FLAG_EXTENDED),
        Frame(0x6C0, command.data, FLAG_FD),
        Frame(0x6C0, b"", FLAG_REMOTE, 8),
    ]
    assert send(control, ZERO, command, DRIVE_PORT) == [(CONTROLLER_PORT, command)]
    for frame in others:
        assert send(control, ZERO, frame) == [(DRIVE_PORT, frame)]
    assert control.gateway.records == []


def test_bus_control_is_off_by_default() -> None:
    """A command frame is a frame like any other to a gateway that was not told."""
    control = live(injector())
    command = Command(number("trigger"), 0, 1).frame(0x6C0)
    assert send(control, ZERO, command) == [(DRIVE_PORT, command)]
    assert control.rows == []


@pytest.mark.parametrize(
    ("port", "command_id", "status_id"),
    [(2, 1, 2), (0, 0, 2), (0, 0x80, 2), (0, 1, 0x2FF), (0, 0x800, 1), (0, 1, 1), (1, 5, 0)],
)
def test_ids_that_mean_something_else_are_refused(port: int, command_id: int, status_id: int) -> None:
    """NMT, SYNC, the controller's status, one id for both, no CAN id at all."""
    with pytest.raises(FaultError, match="bus control"):
        BusControl(live(), port, command_id, status_id)


def test_a_target_of_a_fault_cannot_be_the_command_id() -> None:
    """No fault has its hands on the commands."""
    control = live(injector())
    with pytest.raises(FaultError, match="x: its target or trigger 0x185"):
        control.gateway.attach(BusControl(control, CONTROLLER_PORT, 0x185))


# ---- ports that go away -------------------------------------------------------------------------------------------


def port(gateway: Gateway, now: int, side: int, state: ErrorState) -> None:
    gateway.port_changed(now, PortState(side, state, 0, 0, "test"), Sink())


@pytest.mark.parametrize("state", [ErrorState.BUS_OFF, ErrorState.DOWN])
def test_nothing_is_queued_for_a_port_that_is_away(state: ErrorState) -> None:
    """No old command waits for the bus to come back: counted as undelivered, one probe every 20 ms."""
    control, sink = live(), Sink()
    gateway = control.gateway
    port(gateway, 0, DRIVE_PORT, state)
    for now in range(0, 50 * MS, MS):
        gateway.receive(now, CONTROLLER_PORT, Frame(0x205, now.to_bytes(8)), sink)
    assert [int.from_bytes(frame.data) for _, frame in sink.sent] == [20 * MS, 40 * MS]
    assert gateway.undelivered == [48, 0]
    port(gateway, 50 * MS, DRIVE_PORT, ErrorState.ERROR_ACTIVE)
    gateway.receive(50 * MS, CONTROLLER_PORT, Frame(0x205, b"\1"), sink)
    assert sink.sent[-1][1].data == b"\1"
    assert [(c.port, c.state) for c in gateway.port_changes] == [(1, state), (1, ErrorState.ERROR_ACTIVE)]


def test_the_other_direction_goes_on_and_ends_the_outage() -> None:
    """A frame received on a port shows that it is back."""
    control, sink = live(), Sink()
    gateway = control.gateway
    port(gateway, 0, DRIVE_PORT, ErrorState.DOWN)
    gateway.receive(1, DRIVE_PORT, Frame(0x185, bytes(8)), sink)
    gateway.receive(2, CONTROLLER_PORT, Frame(0x205, b""), sink)
    assert [side for side, _ in sink.sent] == [CONTROLLER_PORT, DRIVE_PORT]
    assert gateway.undelivered == [0, 0]


@pytest.mark.parametrize("state", [ErrorState.WARNING, ErrorState.ERROR_PASSIVE, ErrorState.ERROR_ACTIVE])
def test_a_port_in_trouble_still_gets_frames(state: ErrorState) -> None:
    """ISO 11898-1: warning and error-passive controllers take part."""
    control, sink = live(), Sink()
    port(control.gateway, 0, DRIVE_PORT, state)
    port(control.gateway, 0, DRIVE_PORT, state)
    control.gateway.receive(1, CONTROLLER_PORT, Frame(0x205, b""), sink)
    assert len(sink.sent) == 1
    assert control.gateway.notices == [0, 2]
    assert len(control.gateway.port_changes) == (state is not ErrorState.ERROR_ACTIVE)


def test_a_gateway_can_be_copied_while_a_port_is_away() -> None:
    """Snapshots carry the ports' states; what is attached stays with the original."""
    control = live(injector(event=At((0,))))
    on_bus(control)
    port(control.gateway, 0, DRIVE_PORT, ErrorState.BUS_OFF)
    control.disarm("x", ZERO + 1)
    twin = copy.deepcopy(control.gateway)
    sink = Sink()
    twin.receive(MS, CONTROLLER_PORT, Frame(0x205, b""), sink)
    assert (sink.sent, twin.undelivered, control.gateway.undelivered) == ([], [1, 0], [0, 0])
    assert not twin.injectors[0].enabled


# ---- the documentation --------------------------------------------------------------------------------------------


def test_the_example_in_the_documentation_is_what_happens() -> None:
    """docs/live_control.md: commands and answers, byte for byte."""
    text = (Path(__file__).resolve().parents[2] / "docs" / "live_control.md").read_text(encoding="utf-8")
    lines = re.findall(r"^(6C[01])#([0-9A-F]{16}) ", text, re.MULTILINE)
    assert [cob_id for cob_id, _ in lines] == ["6C0", "6C1"] * 3
    control = live(injector(enabled=False))
    on_bus(control)
    for at in range(0, len(lines), 2):
        sent = send(control, ZERO + at, Frame(0x6C0, bytes.fromhex(lines[at][1])))
        answers = [frame for _, frame in sent if frame.data[1] != wire.ACTIVATED]
        assert [repr(frame) for frame in answers] == [f"6C1#{lines[at + 1][1]}"]
