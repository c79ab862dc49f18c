"""Injectors by themselves: phases, windows, counts, records, trigger order and random streams."""

import binascii
import copy

import numpy as np
import pytest
from scipy import stats

from canopen_exo.bus.frame import Frame
from canopen_exo.bus.node import MS, NEVER
from canopen_exo.signal import Signal
from fi_gateway.effects import ConstantTime, Effect, Infinite, Once
from fi_gateway.errors import FaultError
from fi_gateway.events import At, Event, FailureProbability, Never
from fi_gateway.faults import Bias, Drop, Fault, StuckAt, StuckAtValue
from fi_gateway.injector import Injector, Target, stream
from fi_gateway.outlet import Tray
from fi_gateway.phase import Phase
from fi_gateway.trigger import Trigger

WORD = Signal("statusword", "left_hip", "left_hip_TPDO2", 0x281, 0, 16, False, 1.0, "", 0x6041, 0)
HERE = Target(True, False, (0x281,))


def injector(
    name: str = "x",
    fault: Fault | None = None,
    event: Event | None = None,
    effect: Effect | None = None,
    trigger: Trigger | None = None,
    enabled: bool = True,
) -> Injector:
    return Injector(
        name,
        HERE,
        fault if fault is not None else StuckAtValue(WORD, 0),
        event if event is not None else At((10,)),
        effect if effect is not None else ConstantTime(100),
        trigger,
        stream(1, 0, name),
        enabled,
    )


def word(value: int) -> Frame:
    return Frame(0x281, value.to_bytes(2, "little"))


def phase(one: Injector) -> Phase:
    return one.phase


def test_injector_is_inert_until_its_time_base_is_known() -> None:
    """faults.md: inert before time 0; then times count from it."""
    one = injector()
    assert (phase(one), one.next_ns) == (Phase.INERT, NEVER)
    one.start(1000)
    assert (phase(one), one.next_ns) == (Phase.ARMED, 1010)
    one.start(5000)
    assert one.next_ns == 1010


def test_disabled_injector_never_arms() -> None:
    """faults.md: each can be switched off."""
    one = injector(enabled=False)
    one.start(1000)
    assert (phase(one), one.next_ns) == (Phase.INERT, NEVER)


def test_constant_time_rearms_on_the_next_event() -> None:
    """faults.md: then the injector re-arms (constant)."""
    one = injector(event=At((10, 50, 110, 300)))
    one.start(1000)
    record = one.open(1010, "event")
    assert record is not None
    assert (phase(one), one.next_ns, record.end_ns) == (Phase.ACTIVE, 1110, 1110)
    one.close(1110)
    assert (phase(one), one.next_ns) == (Phase.ARMED, 1110)


@pytest.mark.parametrize("effect", [Once(), Infinite()])
def test_once_and_infinite_are_spent(effect: Effect) -> None:
    """faults.md: or is spent (once, infinite)."""
    one = injector(effect=effect, event=At((10, 20)))
    one.start(0)
    one.open(10, "event")
    assert one.next_ns == NEVER
    one.close(15)
    assert (phase(one), one.next_ns) == (Phase.SPENT, NEVER)


def test_once_acts_on_one_frame() -> None:
    """faults.md: once = one frame; its window ends right after it."""
    one = injector(effect=Once())
    one.start(0)
    record = one.open(10, "event")
    assert record is not None
    assert one.act(30, 1, word(5), Tray()) == word(0)
    assert (phase(one), record.end_ns, record.frames_changed) == (Phase.SPENT, 31, 1)


def test_once_is_not_used_up_by_a_frame_it_cannot_act_on() -> None:
    """A frame too short passes unchanged; the next one is the one."""
    one = injector(effect=Once())
    one.start(0)
    one.open(10, "event")
    short = Frame(0x281, b"\x01")
    assert one.act(20, 1, short, Tray()) is short
    assert one.act(30, 1, word(5), Tray()) == word(0)
    assert (one.too_short, one.injected) == (1, 1)


def test_the_three_counts_differ() -> None:
    """faults.md: injected, activated and manifested are three counts."""
    one = injector()
    one.start(0)
    record = one.open(10, "event")
    assert record is not None
    for n, frame in enumerate([word(0), word(7), Frame(0x281, b""), word(0), word(8)]):
        one.act(20 + n, 1, frame, Tray())
    assert (one.activated, one.injected, one.manifested, one.too_short) == (1, 4, 2, 1)
    assert (record.frames_seen, record.frames_unfit, record.frames_changed) == (5, 1, 2)
    assert (record.first_before, record.first_after) == (word(7), word(0))


def test_a_lost_frame_has_no_after() -> None:
    """Recorded: first changed frame before and after."""
    one = injector(fault=Drop())
    one.start(0)
    record = one.open(10, "event")
    assert record is not None
    assert one.act(20, 1, word(7), Tray()) is None
    assert (record.first_before, record.first_after, record.frames_lost, record.signal) == (word(7), None, 1, "")


@pytest.mark.parametrize(("probability", "injected"), [(0.0, 0), (1.0, 50)])
def test_a_frame_that_a_drop_spares_is_seen_and_not_injected(probability: float, injected: int) -> None:
    """faults.md: injected = frames the fault acted on; losing none of 50 is no injection."""
    one = injector(fault=Drop(probability))
    one.start(0)
    record = one.open(10, "event")
    assert record is not None
    for n in range(50):
        assert (one.act(10 + n, 1, word(n), Tray()) is None) == bool(injected)
    assert (record.frames_seen, record.frames_injected, record.frames_lost) == (50, injected, injected)
    assert (one.injected, one.manifested) == (injected, injected)


def test_a_drop_by_chance_injects_exactly_the_frames_it_loses() -> None:
    """Counted one by one, in the injector and in its record."""
    one = injector(fault=Drop(0.4), effect=Infinite())
    one.start(0)
    record = one.open(10, "event")
    assert record is not None
    lost = sum(one.act(10 + n, 1, word(n), Tray()) is None for n in range(200))
    assert 0 < lost < 200
    assert (record.frames_seen, record.frames_injected, record.frames_lost) == (200, lost, lost)
    assert (one.injected, one.manifested) == (lost, lost)


def test_a_value_that_is_replaced_by_itself_is_injected_and_not_manifested() -> None:
    """Unlike a spared frame: the fault acted, the result is the same."""
    one = injector(fault=StuckAtValue(WORD, 7))
    one.start(0)
    record = one.open(10, "event")
    assert record is not None
    for n in range(3):
        one.act(20 + n, 1, word(7), Tray())
    assert (record.frames_seen, record.frames_injected, record.frames_changed) == (3, 3, 0)


def test_record_of_whole_frames_has_the_name_of_the_target() -> None:
    """A target without a signal is named too: "right_knee.TPDO1"; a signal keeps its own name."""
    for fault, expected in ((Drop(), "left_hip.TPDO2"), (StuckAtValue(WORD, 0), "left_hip.statusword")):
        target = Target(True, False, (0x281,), "left_hip.TPDO2")
        one = Injector("x", target, fault, At((10,)), Infinite(), None, stream(1, 0, "x"))
        for each in (one, copy.deepcopy(one)):
            each.start(0)
            record = each.open(10, "event")
            assert record is not None
            assert record.signal == expected


@pytest.mark.parametrize(
    ("effect", "end"), [(ConstantTime(100), 30), (ConstantTime(15), 25), (Once(), 30), (Infinite(), NEVER)]
)
def test_stop_ends_the_window_but_does_not_invent_an_end_for_infinite(effect: Effect, end: int) -> None:
    """The record's end: as planned when that was before, the stop, or none for an effect without limit."""
    one = injector(effect=effect, event=At((10, 500)))
    one.start(0)
    record = one.open(10, "event")
    assert record is not None
    if end < 30:
        one.close(one.next_ns)
    one.stop(30)
    one.stop(40)
    assert (phase(one), one.next_ns, record.end_ns) == (Phase.SPENT, NEVER, end)
    same = word(5)
    assert one.act(31, 1, same, Tray()) is same


def test_stop_of_an_injector_that_waits_leaves_no_record() -> None:
    """It was never active."""
    one = injector(fault=StuckAt(WORD))
    one.start(0)
    assert one.open(10, "event") is None
    one.stop(30)
    assert (phase(one), one.activated) == (Phase.SPENT, 0)


def test_record_names_signal_cause_and_times() -> None:
    """Recorded per activation: sampled times, cause, signal."""
    one = injector("freeze")
    one.start(1000)
    record = one.open(1010, "trigger:other")
    assert record is not None
    assert (record.injector, record.index, record.signal) == ("freeze", 0, "left_hip.statusword")
    assert (record.cause, record.due_ns, record.start_ns, record.duration_ns) == ("trigger:other", 1010, 1010, 100)
    one.close(1110)
    again = one.open(1200, "event")
    assert again is not None
    assert again.index == 1


def test_waiting_keeps_its_cause_and_due_time() -> None:
    """stuck_at waits for a value; the window opens later, the record says when it was due."""
    one = injector(fault=StuckAt(WORD))
    one.start(0)
    assert one.open(10, "event") is None
    assert (phase(one), one.next_ns, one.activated) == (Phase.WAITING, NEVER, 0)
    one.held[0x281] = word(9)
    record = one.open(40, "frame")
    assert record is not None
    assert (record.cause, record.due_ns, record.start_ns, record.end_ns) == ("event", 10, 40, 140)


def test_a_frame_stamped_before_the_window_passes_when_it_is_read_late() -> None:
    """faults.md: the window is on the frame's arrival time."""
    one = injector()
    one.start(0)
    one.open(10, "event")
    early = word(7)
    assert one.act(9, 1, early, Tray()) is early
    assert one.injected == 0


def test_saturated_values_are_in_the_record() -> None:
    """faults.md: values that no longer fit saturate and say so once (per activation)."""
    one = injector(fault=Bias(WORD, 10))
    one.start(0)
    record = one.open(10, "event")
    assert record is not None
    one.act(20, 1, word(65530), Tray())
    one.act(21, 1, word(1), Tray())
    one.act(22, 1, word(65535), Tray())
    one.close(110)
    assert record.saturated == 2


@pytest.mark.parametrize(
    ("start", "length", "least"), [(0, 1, 1), (0, 8, 1), (0, 9, 2), (7, 1, 1), (7, 2, 2), (48, 16, 8)]
)
def test_a_frame_is_remembered_from_the_byte_with_the_last_bit(start: int, length: int, least: int) -> None:
    """A shorter frame holds no correct value of the signal."""
    signal = Signal("s", "n", "m", 0x281, start, length, False, 1.0, "", 0x2000, 0)
    assert injector(fault=StuckAt(signal)).least_bytes == least


@pytest.mark.parametrize("cob_ids", [(0x282,), (0x281, 0x282)])
def test_a_signal_is_refused_where_it_does_not_lie(cob_ids: tuple[int, ...]) -> None:
    """The message names the COB-ID that is right."""
    with pytest.raises(FaultError, match=r"injector x.*left_hip\.statusword.*0x281"):
        Injector(
            "x",
            Target(True, False, cob_ids),
            StuckAtValue(WORD, 0),
            Never(),
            Once(),
            None,
            stream(1, 0, "x"),
        )


@pytest.mark.parametrize(
    ("up", "down", "cob_ids"), [(False, False, (1,)), (True, False, ()), (True, True, (-1,)), (True, True, (0x800,))]
)
def test_target_refuses_nothing_and_what_is_no_cob_id(up: bool, down: bool, cob_ids: tuple[int, ...]) -> None:
    """Bad parameters are refused where they are made."""
    with pytest.raises(FaultError, match="allowed"):
        Target(up, down, cob_ids)


def test_stream_is_the_documented_one() -> None:
    """faults.md: SeedSequence(seed, spawn_key = (run, crc32(name))); crc32("freeze_position") by binascii."""
    expected = np.random.Generator(
        np.random.PCG64(np.random.SeedSequence(2020, spawn_key=(3, binascii.crc32(b"freeze_position"))))
    )
    assert stream(2020, 3, "freeze_position").random(5).tolist() == expected.random(5).tolist()


def test_streams_differ_by_seed_run_and_name_and_are_uncorrelated() -> None:
    """One stream per injector; Pearson correlation not significant at 1 % with fixed seeds."""
    first = stream(1, 0, "a").random(2000)
    for other in (stream(2, 0, "a"), stream(1, 1, "a"), stream(1, 0, "b")):
        second = other.random(2000)
        assert first.tolist() != second.tolist()
        assert stats.pearsonr(first, second).pvalue > 0.01


def test_a_copy_keeps_event_fault_and_injector_on_one_stream() -> None:
    """Snapshots: a copy draws what the original draws."""
    generator = stream(5, 0, "x")
    event = FailureProbability(0.01, MS, generator)
    one = Injector("x", HERE, Drop(0.5), event, ConstantTime(5 * MS), None, generator)
    one.start(0)
    one.open(one.next_ns, "event")
    one.act(one.next_ns - 1, 1, word(1), Tray())
    twin = copy.deepcopy(one)
    for each in (one, twin):
        for n in range(30):
            each.act(each.next_ns - 1, 1, word(n), Tray())
        each.close(each.next_ns)
    assert (one.next_ns, one.manifested) == (twin.next_ns, twin.manifested)
