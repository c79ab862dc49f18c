"""Held and given values: exact bytes."""

import struct

import pytest

from canopen_exo.bus.frame import FLAG_EXTENDED, Frame
from canopen_exo.signal import Signal
from fi_gateway.errors import FaultError
from fi_gateway.faults import StuckAt, StuckAtPayload, StuckAtValue, TimeDelay
from tests.fi_gateway.faults.bench import OUT, POSITION, VELOCITY, WORD, begun, joint, rng, values


def test_stuck_at_holds_the_last_value_and_leaves_the_rest() -> None:
    """faults.md: stuck_at gives the last correct value before activation; other signals pass."""
    fault = begun(StuckAt(POSITION), joint(-1000, 5))
    assert values(fault.apply(0, joint(2000, 7), OUT)) == (-1000, 7)
    assert values(fault.apply(1, joint(3000, 8), OUT)) == (-1000, 8)


def test_stuck_at_passes_the_identical_frame_when_the_value_has_not_moved() -> None:
    """A frame that does not change is no manifestation."""
    fault, frame = begun(StuckAt(POSITION), joint(-1000, 5)), joint(-1000, 6)
    assert fault.apply(0, frame, OUT) is frame


@pytest.mark.parametrize("signal", [POSITION, None])
def test_stuck_at_waits_while_no_value_has_come(signal: Signal | None) -> None:
    """faults.md: if none has reached the injector yet, it waits for one."""
    fault = StuckAt(signal)
    assert not fault.begin(0, {}, rng())
    assert fault.begin(1, {0x185: joint(1, 2)}, rng())


def test_stuck_at_payload_holds_each_cob_id_by_itself() -> None:
    """A payload is held per COB-ID; one seen for the first time is held from then on."""
    fault = StuckAt(None)
    assert fault.begin(0, {0x185: joint(1, 2), 0x186: Frame(0x186, b"\xaa")}, rng())
    assert values(fault.apply(1, joint(8, 9), OUT)) == (1, 2)
    assert fault.apply(1, Frame(0x186, b"\xbb"), OUT) == Frame(0x186, b"\xaa")
    late = Frame(0x187, b"\x01")
    assert fault.apply(1, late, OUT) is late
    assert fault.apply(2, Frame(0x187, b"\x02"), OUT) == late


@pytest.mark.parametrize(("length", "fits"), [(0, False), (7, False), (8, True)])
def test_stuck_at_payload_needs_the_held_length(length: int, fits: bool) -> None:
    """The length of a frame is never changed."""
    assert begun(StuckAt(None), joint(1, 2)).fits(Frame(0x185, bytes(length))) is fits


def test_stuck_at_payload_forgets_when_the_activation_ends() -> None:
    """The next activation holds the value from before itself."""
    fault = begun(StuckAt(None), joint(1, 2))
    fault.end()
    assert not fault.begin(5, {}, rng())


def test_stuck_at_value_gives_the_value_and_leaves_the_rest() -> None:
    """faults.md: stuck_at_value gives a given value."""
    assert values(begun(StuckAtValue(VELOCITY, 0)).apply(0, joint(5, 99), OUT)) == (5, 0)
    assert values(begun(StuckAtValue(VELOCITY, -7)).apply(0, joint(5, 99), OUT)) == (5, -7)


@pytest.mark.parametrize(
    ("signal", "raw", "allowed"),
    [
        (POSITION, -(2**31) - 1, False),
        (POSITION, -(2**31), True),
        (POSITION, 2**31 - 1, True),
        (POSITION, 2**31, False),
        (WORD, -1, False),
        (WORD, 0, True),
        (WORD, 65535, True),
        (WORD, 65536, False),
    ],
)
def test_stuck_at_value_is_refused_outside_the_range_of_the_signal(signal: Signal, raw: int, allowed: bool) -> None:
    """Nothing wraps silently."""
    if allowed:
        StuckAtValue(signal, raw)
    else:
        with pytest.raises(FaultError, match=rf"raw value {raw}.*right_knee\.{signal.name}.*{signal.low}\.\."):
            StuckAtValue(signal, raw)


def test_stuck_at_payload_gives_the_payload_to_frames_of_its_length() -> None:
    """stuck_at_value without a signal: the whole payload."""
    fault = begun(StuckAtPayload(bytes(8)))
    assert fault.apply(0, joint(5, 99), OUT) == joint(0, 0)
    assert [fault.fits(Frame(0x185, bytes(n))) for n in (0, 7, 8)] == [False, False, True]
    with pytest.raises(FaultError, match=r"9 bytes given, allowed 0\.\.8"):
        StuckAtPayload(bytes(9))


def test_raw_dlc_above_8_is_kept() -> None:
    """faults.md: id type, DLC, RTR, FD flags kept; DLC 9..15 mean 8 data bytes (ISO 11898-1)."""
    result = begun(StuckAtValue(POSITION, 3)).apply(0, Frame(0x185, bytes(8), 0, 15), OUT)
    assert result is not None
    assert (result.dlc, result.data) == (15, struct.pack("<ii", 3, 0))


def test_flags_are_kept() -> None:
    """The fault itself changes the payload only."""
    result = begun(StuckAtValue(POSITION, 3)).apply(0, Frame(0x12345678, bytes(8), FLAG_EXTENDED), OUT)
    assert result is not None
    assert (result.can_id, result.flags) == (0x12345678, FLAG_EXTENDED)


def lagging(lag_ns: int, *frames: tuple[int, int]) -> list[int]:
    """The positions that come out of a lag begun at 100 ns with 7 as the last value; frames: (arrival, position)."""
    fault = begun(TimeDelay(POSITION, lag_ns), joint(7, 0), now=100)
    return [values(fault.apply(now, joint(position, 1), OUT))[0] for now, position in frames]


def test_time_delay_stays_at_the_value_from_before_and_then_lags() -> None:
    """faults.md: the signal stays at its value from before activation, then lags: a ramp of 1 per 10 ns, lag 30 ns."""
    ramp = [(100 + 10 * k, 8 + k) for k in range(8)]
    assert lagging(30, *ramp) == [7, 7, 7, 8, 9, 10, 11, 12]


@pytest.mark.parametrize(("lag_ns", "last"), [(29, 9), (30, 9), (31, 8), (10, 10), (50, 7)])
def test_time_delay_gives_the_last_value_at_or_before_that_time(lag_ns: int, last: int) -> None:
    """in(t) is the value of the last frame that arrived at or before t; frames at 105, 110, 130 and now 140 ns."""
    assert lagging(lag_ns, (105, 8), (110, 9), (130, 10), (140, 11))[-1] == last


def test_time_delay_leaves_the_other_signals_on_time() -> None:
    """The frame is fresh, only the signal is old."""
    fault = begun(TimeDelay(POSITION, 30), joint(7, 0))
    assert [values(fault.apply(10 * k, joint(k, 50 + k), OUT))[1] for k in range(5)] == [50, 51, 52, 53, 54]


def test_time_delay_waits_while_no_value_has_come() -> None:
    """There is nothing to stay at."""
    fault = TimeDelay(POSITION, 30)
    assert not fault.begin(0, {}, rng())
    assert fault.begin(0, {0x185: joint(1, 2)}, rng())


@pytest.mark.parametrize("lag_ns", [0, -1])
def test_time_delay_needs_a_lag(lag_ns: int) -> None:
    """Bad parameters are refused where they are made."""
    with pytest.raises(FaultError, match=rf"lag {lag_ns} ns given, allowed 1 ns and more"):
        TimeDelay(POSITION, lag_ns)
