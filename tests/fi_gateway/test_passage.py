"""Frames that go on later, in addition or not at all: order, counts and copies, through receive() and wake()."""

import pickle

import pytest

from canopen_exo.bus.frame import FLAG_EXTENDED, Frame
from canopen_exo.bus.node import NEVER
from canopen_exo.signal import Signal
from fi_gateway.effects import ConstantTime, Infinite
from fi_gateway.errors import FaultError
from fi_gateway.events import At, Never
from fi_gateway.faults import Bias, Drop, Fault
from fi_gateway.gateway import CONTROLLER_PORT, DRIVE_PORT
from fi_gateway.injector import Injector, Target, stream
from fi_gateway.outlet import Outlet
from fi_gateway.repair import Repair
from fi_gateway.trigger import Trigger
from tests.fi_gateway.passage_faults import COUNT, Beat, Bench, Rename, Slow, Stuck, Twice, always, tpdo


def test_a_late_frame_goes_on_at_its_time() -> None:
    """Outlet.later: at_ns, not before and not after."""
    bench = Bench(always(Slow(True)))
    bench.give(100, tpdo(3, 1))
    assert (bench.gateway.wake_at, bench.gateway.waiting, bench.came()) == (130, 1, [])
    bench.until(130)
    assert (bench.came(), bench.gateway.waiting, bench.gateway.lost) == ([(130, b"\x03\x01")], 0, [0, 0])
    record = bench.gateway.records[0]
    assert (record.frames_delayed, record.frames_lost, record.frames_changed, record.manifested) == (1, 0, 0, 1)
    assert (record.first_before, record.first_after) == (tpdo(3, 1), tpdo(3, 1))


def test_frames_in_order_wait_behind_the_late_one() -> None:
    """in_order: also frames with a shorter time, and those that the fault lets pass."""
    bench = Bench(always(Slow(True)))
    for now, first in ((100, 9), (101, 1), (102, 0), (103, 0)):
        bench.give(now, tpdo(first, now))
    bench.until(1000)
    assert bench.came() == [(190, bytes((9, 100))), (190, b"\x01\x65"), (190, b"\x00\x66"), (190, b"\x00\x67")]
    record = bench.gateway.records[0]
    assert (record.frames_seen, record.frames_delayed, record.manifested) == (4, 4, 4)


def test_frames_overtake_when_order_is_not_kept() -> None:
    """in_order False: each at its own time; equal times as sent."""
    bench = Bench(always(Slow(False)))
    for now, first in ((100, 9), (110, 1), (111, 0), (120, 7)):
        bench.give(now, tpdo(first, now))
    bench.until(1000)
    assert bench.came() == [(111, b"\x00\x6f"), (120, b"\x01\x6e"), (190, b"\x09\x64"), (190, b"\x07\x78")]


def test_the_line_outlives_the_window_and_then_is_gone() -> None:
    """in_order: also after the window has closed; afterwards frames pass the same instant."""
    target = Target(True, False, (0x181,))
    slow = Injector("x", target, Slow(True), At((0,)), ConstantTime(50), None, stream(1, 0, "x"), True, True)
    bench = Bench(slow)
    bench.give(100, tpdo(9, 0))
    bench.give(160, tpdo(9, 1))
    bench.give(189, tpdo(0, 2))
    bench.give(190, tpdo(0, 3))
    bench.until(190)
    bench.give(191, tpdo(0, 4))
    times = [190, 190, 190, 190, 191]
    assert bench.came() == list(zip(times, (b"\x09\x00", b"\x09\x01", b"\0\x02", b"\0\x03", b"\0\x04"), strict=True))
    assert not slow.lines
    assert (bench.gateway.records[0].frames_seen, bench.gateway.records[0].frames_delayed) == (1, 1)


def test_other_cob_ids_and_the_other_direction_do_not_wait() -> None:
    """The line is that of one COB-ID in one direction."""
    bench = Bench(always(Slow(True), ids=(0x181, 0x182), both=True))
    bench.give(100, tpdo(9, 0))
    bench.give(101, Frame(0x182, b"\x00"))
    bench.give(102, tpdo(0), CONTROLLER_PORT)
    bench.give(103, Frame(0x183, b"\x00"))
    assert [(at, port, frame.can_id) for at, port, frame in bench.sink.sent] == [
        (101, 0, 0x182),
        (102, 1, 0x181),
        (103, 0, 0x183),
    ]


def test_a_late_frame_meets_the_injectors_written_behind_as_they_are_then() -> None:
    """Those written after it act on it then; those written before do not act again."""
    target = Target(True, False, (0x181,))
    before = always(Bias(COUNT, 1), "before")
    event, effect = At((80,)), ConstantTime(15)
    behind = Injector("behind", target, Bias(COUNT, 100), event, effect, None, stream(1, 0, "b"), True, True)
    bench = Bench(before, always(Slow(True), "slow"), behind)
    bench.give(100, tpdo(7))
    bench.give(102, tpdo(9))
    bench.until(1000)
    assert bench.came() == [(180, bytes((108,))), (202, b"\x0a")]
    seen = {one.injector: one.frames_seen for one in bench.gateway.records}
    assert seen == {"before": 2, "slow": 2, "behind": 1}


def test_a_late_frame_can_be_lost_behind() -> None:
    """And is counted once."""
    bench = Bench(always(Slow(True), "slow"), always(Drop(), "drop"))
    bench.give(100, tpdo(5))
    assert bench.gateway.lost == [0, 0]
    bench.until(1000)
    assert (bench.came(), bench.gateway.lost, bench.gateway.waiting) == ([], [0, 1], 0)


def test_an_inserted_frame_comes_before_the_one_that_arrived() -> None:
    """Outlet.insert: at once, before what apply returns, through the injectors behind."""
    bench = Bench(always(Twice(40), "twice"), always(Bias(COUNT, 1), "bias"))
    bench.give(100, tpdo(5))
    bench.until(1000)
    assert bench.came() == [(100, b"\x06"), (100, b"\x06"), (140, b"\x06")]
    twice, bias = bench.gateway.records
    assert (twice.frames_seen, twice.frames_inserted, twice.frames_delayed, twice.manifested) == (1, 2, 0, 2)
    assert (bias.frames_seen, bench.gateway.inserted, bench.gateway.lost) == (3, [0, 2], [0, 0])
    assert (twice.first_before, twice.first_after) == (tpdo(5), tpdo(5))


@pytest.mark.parametrize(("can_id", "flags", "expected"), [(0x182, 0, 25), (0x183, 0, 5), (0x182, FLAG_EXTENDED, 5)])
def test_a_renamed_frame_is_a_target_of_those_behind_by_its_new_name(can_id: int, flags: int, expected: int) -> None:
    """Masquerade: injectors behind see what is on the wire, not what it was."""
    signal = Signal("count", "left_knee", "m", 0x182, 0, 8, False, 1.0, "", 0x2000, 0)
    rename = always(Rename(can_id, flags), "rename")
    bench = Bench(rename, always(Bias(COUNT, 10), "old"), always(Bias(signal, 20), "new", (0x182,)))
    bench.give(100, tpdo(5))
    assert [(frame.can_id, frame.data, frame.flags) for _, _, frame in bench.sink.sent] == [
        (can_id, bytes((expected,)), flags)
    ]


def test_a_fault_inserts_by_itself_while_its_window_is_open() -> None:
    """Fault.wake: at wake_at, from the start of the window to its end."""
    target = Target(True, False, (0x181,))
    beat = Injector("x", target, Beat(30), At((20,)), ConstantTime(70), None, stream(1, 0, "x"), True, True)
    bench = Bench(beat, always(Bias(COUNT, 1), "behind"))
    bench.give(100, tpdo(1))
    bench.until(1000)
    assert bench.came() == [(100, b"\x02"), (120, b"\xbf"), (150, b"\xbf"), (180, b"\xbf")]
    record = next(one for one in bench.gateway.records if one.injector == "x")
    assert (record.frames_seen, record.frames_inserted, record.manifested, record.end_ns) == (0, 3, 3, 190)
    assert (record.first_before, record.first_after) == (None, Frame(0x181, b"\xbe"))
    assert bench.gateway.inserted == [0, 3]


@pytest.mark.parametrize(("to_drives", "port"), [(False, CONTROLLER_PORT), (True, DRIVE_PORT)])
def test_what_a_fault_inserts_travels_as_its_target(to_drives: bool, port: int) -> None:
    """bus: to_drives or to_controller."""
    target = Target(not to_drives, to_drives, (0x181,))
    beat = Injector("x", target, Beat(1000), At((0,)), Infinite(), None, stream(1, 0, "x"), True, True)
    bench = Bench(beat)
    bench.give(100, Frame(0x7FF, b""), CONTROLLER_PORT)
    bench.until(100)
    assert [(side, frame.can_id) for _, side, frame in bench.sink.sent if frame.can_id == 0x181] == [(port, 0x181)]


def test_a_fault_that_stays_awake_is_refused() -> None:
    """It would never end."""
    bench = Bench(always(Stuck(1)))
    with pytest.raises(FaultError, match=r"injector x: its fault Stuck asks to be woken at 100 ns again"):
        bench.give(100, tpdo(1))


def test_a_fault_that_sends_into_the_past_is_refused() -> None:
    """The message says when it is."""
    bench = Bench(always(Slow(True, -1)))
    with pytest.raises(FaultError, match=r"injector x.*at 97 ns, it is 100 ns"):
        bench.give(100, tpdo(3))


def test_finish_and_stop_leave_late_frames_on_their_way() -> None:
    """A frame that was put off is not lost by the end of the window."""
    bench = Bench(always(Slow(True)))
    bench.give(100, tpdo(9))
    bench.gateway.finish(150)
    assert bench.gateway.wake_at == 190
    bench.until(1000)
    assert (bench.came(), bench.gateway.wake_at) == ([(190, b"\x09")], NEVER)


def test_a_repair_covers_late_and_inserted_frames() -> None:
    """Whatever leaves the injector changed has a valid checksum; what is unchanged is not touched."""
    target = Target(True, False, (0x181,))

    class Both(Fault):
        def apply(self, now: int, frame: Frame, outlet: Outlet) -> Frame | None:
            outlet.insert(Frame(0x181, b"\x11\x00"))
            outlet.later(now + 10, Frame(0x181, b"\x22\x00"), False)
            outlet.later(now + 20, frame, False)
            return None

    one = Injector(
        "x", target, Both(), At((0,)), Infinite(), None, stream(1, 0, "x"), True, True, repair=Repair("xor", 1)
    )
    bench = Bench(one)
    bench.give(100, tpdo(5, 9))
    bench.until(1000)
    assert bench.came() == [(100, b"\x11\x11"), (110, b"\x22\x22"), (120, b"\x05\x09")]


def test_a_gateway_with_frames_that_wait_can_be_pickled() -> None:
    """As copies are; Drop is of the package, so that its class is found again."""
    bench = Bench(always(Slow(True)))
    bench.give(100, tpdo(9))
    twin = Bench()
    twin.gateway = pickle.loads(pickle.dumps(bench.gateway))
    twin.until(1000)
    assert twin.came() == [(190, b"\x09")]


def test_a_trigger_starts_what_waits_behind_a_late_frame_when_it_manifests() -> None:
    """manifested of a delay: the instant at which the frame did not go on."""
    target = Target(True, False, (0x182,))
    trigger, rng = Trigger(("slow",), "manifested"), stream(1, 0, "d")
    drop = Injector("drop", target, Drop(), Never(), ConstantTime(50), trigger, rng, True, True)
    bench = Bench(always(Slow(True), "slow"), drop)
    bench.give(100, tpdo(0))
    bench.give(110, tpdo(9))
    record = bench.gateway.records[1]
    assert (record.injector, record.start_ns, record.cause) == ("drop", 110, "trigger:slow")
