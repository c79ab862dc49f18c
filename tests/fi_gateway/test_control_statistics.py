"""Live control of a gateway: rows, listing, statistics."""

import pytest

from canopen_exo.bus.frame import Frame
from canopen_exo.bus.lateness import Lateness
from canopen_exo.bus.losses import Losses
from canopen_exo.bus.node import MS, NEVER, ErrorState, PortState
from canopen_exo.plan import HLC_STATUS, STATUS_STOPPED
from fi_gateway.control import (
    ControlRow,
    Direction,
    changes_text,
    latency_text,
    listing_text,
    perform,
    statistics,
    statistics_text,
)
from fi_gateway.errors import FaultError
from fi_gateway.events import At, Never
from fi_gateway.gateway import CONTROLLER_PORT, DRIVE_PORT
from tests.fi_gateway.live_gateway import ZERO, Sink, injector, live, passes

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


@pytest.mark.long
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
