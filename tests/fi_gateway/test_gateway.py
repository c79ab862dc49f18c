"""The gateway as a Node: passing, and time 0. Through receive() and wake() only."""

import copy

import pytest

from canopen_exo.bus.frame import FLAG_BRS, FLAG_EXTENDED, FLAG_FD, FLAG_REMOTE, Frame
from canopen_exo.bus.node import LOOK, MS, NEVER, PASS_ON, SECOND, TAKE, ErrorState, PortState
from canopen_exo.plan import SYNC
from fi_gateway.effects import ConstantTime, Infinite
from fi_gateway.events import At, Never
from fi_gateway.faults import Bias, Drop, StuckAtValue
from fi_gateway.gateway import CONTROLLER_PORT, DRIVE_PORT, CommandPort, Gateway
from fi_gateway.injector import Injector, Target
from fi_gateway.on_wire import Disturbed
from fi_gateway.trigger import BusFrame, Trigger
from fi_gateway.wire_faults import StuckDominant
from tests.fi_gateway.gateway_at_zero import (
    CYCLE,
    POSITION,
    VELOCITY,
    ZERO,
    Sink,
    at,
    injector,
    joint,
    pass_through,
    status,
    values,
)

# ---- passing ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("port", [CONTROLLER_PORT, DRIVE_PORT])
@pytest.mark.parametrize("can_id", [0x000, 0x080, 0x185, 0x2FF, 0x7FF])
def test_without_injectors_every_frame_comes_out_on_the_other_port(port: int, can_id: int) -> None:
    """Pure store-and-forward: the identical frame."""
    gateway, frame = Gateway([], CYCLE), Frame(can_id, b"\x01\x02")
    assert pass_through(gateway, 5, frame, port) is frame
    assert gateway.frames[port] == 1


def sync_filters(gateway: Gateway) -> tuple[int, int]:
    """What becomes of a SYNC from the controller, and of one from the drives."""
    return gateway.filters[CONTROLLER_PORT][SYNC], gateway.filters[DRIVE_PORT][SYNC]


AT_SYNC = Target(False, True, (SYNC,))


@pytest.mark.parametrize(
    ("injectors", "filters"),
    [
        ([], (LOOK, PASS_ON)),
        ([injector(Drop(), At((0,)), Infinite())], (LOOK, PASS_ON)),
        ([injector(Drop(), At((0,)), Infinite(), target=AT_SYNC)], (TAKE, PASS_ON)),
        ([injector(Drop(), At((0,)), Infinite(), target=Target(True, False, (SYNC,)))], (LOOK, TAKE)),
        ([injector(Drop(), Never(), Infinite(), trigger=Trigger(frame=BusFrame(SYNC, b"", b"", False, True)))],
         (TAKE, PASS_ON)),
        ([injector(Disturbed("drive", StuckDominant()), At((0,)), ConstantTime(MS))], (TAKE, PASS_ON)),
    ],
)  # fmt: skip
def test_a_sync_that_is_only_read_for_its_time_need_not_be_handled(
    injectors: list[Injector], filters: tuple[int, int]
) -> None:
    """It is handled where an injector, a trigger or a wire fault waits for what happens at that time."""
    gateway = Gateway(injectors, CYCLE)
    assert sync_filters(gateway) == filters
    assert sync_filters(copy.deepcopy(gateway)) == filters


def test_a_sync_that_is_looked_at_tells_time_0_as_one_that_is_handled() -> None:
    handled, looked_at = Gateway([], CYCLE), Gateway([], CYCLE)
    for number in range(3):
        handled.receive(ZERO + number * CYCLE, CONTROLLER_PORT, Frame(SYNC, b"\x01"), Sink())
        looked_at.look(ZERO + number * CYCLE, CONTROLLER_PORT, SYNC)
    for gateway in (handled, looked_at):
        gateway.receive(ZERO + 2 * CYCLE + 5, CONTROLLER_PORT, status(2, 2), Sink())
    assert looked_at.time_zero == handled.time_zero == ZERO
    assert vars(looked_at.cadence) == vars(handled.cadence)


def test_from_power_up_a_sync_is_handled_while_it_may_be_the_first_frame() -> None:
    gateway = Gateway([injector(Drop(), At((0,)), Infinite(), from_power_up=True)], CYCLE)
    assert sync_filters(gateway) == (TAKE, TAKE)
    gateway.receive(5, CONTROLLER_PORT, Frame(SYNC, b""), Sink())
    assert sync_filters(gateway) == (LOOK, PASS_ON)


def test_a_sync_is_handled_from_when_something_wants_it_on() -> None:
    """While a port is away; when live control adds an injector there, or reads its commands there."""
    gateway = Gateway([], CYCLE)
    for state, filters in ((ErrorState.BUS_OFF, (TAKE, TAKE)), (ErrorState.ERROR_ACTIVE, (LOOK, PASS_ON))):
        gateway.port_changed(5, PortState(DRIVE_PORT, state, 0, 0, "test"), Sink())
        assert sync_filters(gateway) == filters
    gateway.attach(CommandPort(DRIVE_PORT, SYNC))
    assert sync_filters(gateway) == (LOOK, TAKE)
    gateway = Gateway([], CYCLE)
    gateway.attach(CommandPort(CONTROLLER_PORT, SYNC))
    assert sync_filters(gateway) == (TAKE, PASS_ON)
    gateway, _ = at(ZERO, [])
    gateway.add(injector(Drop(), At((0,)), Infinite(), target=AT_SYNC), ZERO + 5)
    assert sync_filters(gateway) == (TAKE, PASS_ON)


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
