"""Fault types: what comes out of each, against struct, closed forms and scipy."""

import copy
import pickle
import struct
from collections.abc import Callable

import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.random import PCG64, Generator
from scipy import stats

from canopen_exo.bus.frame import FLAG_EXTENDED, Frame
from canopen_exo.signal import Signal
from fi_gateway.errors import FaultError
from fi_gateway.faults import Bias, BitFlip, Drop, Fault, StuckAt, StuckAtPayload, StuckAtValue, distinct_bits
from fi_gateway.outlet import Tray

POSITION = Signal("position", "right_knee", "right_knee_TPDO1", 0x185, 0, 32, True, 1.0, "rad", 0x6064, 0)
VELOCITY = Signal("velocity", "right_knee", "right_knee_TPDO1", 0x185, 32, 32, True, 1.0, "rad/s", 0x606C, 0)
WORD = Signal("statusword", "right_knee", "right_knee_TPDO2", 0x285, 0, 16, False, 1.0, "", 0x6041, 0)
ODD = Signal("odd", "right_knee", "odd", 0x185, 13, 11, True, 1.0, "", 0x2000, 1)


def rng(seed: int = 1) -> Generator:
    return Generator(PCG64(seed))


def joint(position: int, velocity: int) -> Frame:
    return Frame(0x185, struct.pack("<ii", position, velocity))


def values(frame: Frame | None) -> tuple[int, int]:
    assert frame is not None
    position, velocity = struct.unpack("<ii", frame.data)
    return position, velocity


def begun(fault: Fault, last: Frame | None = None, seed: int = 1) -> Fault:
    assert fault.begin(0, {} if last is None else {last.can_id: last}, rng(seed))
    return fault


def word(frame: Frame | None) -> int:
    assert frame is not None
    return int.from_bytes(frame.data, "little")


def test_stuck_at_holds_the_last_value_and_leaves_the_rest() -> None:
    """faults.md: stuck_at gives the last correct value before activation; other signals pass."""
    fault = begun(StuckAt(POSITION), joint(-1000, 5))
    assert values(fault.apply(0, joint(2000, 7), Tray())) == (-1000, 7)
    assert values(fault.apply(1, joint(3000, 8), Tray())) == (-1000, 8)


def test_stuck_at_passes_the_identical_frame_when_the_value_has_not_moved() -> None:
    """A frame that does not change is no manifestation."""
    fault, frame = begun(StuckAt(POSITION), joint(-1000, 5)), joint(-1000, 6)
    assert fault.apply(0, frame, Tray()) is frame


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
    assert values(fault.apply(1, joint(8, 9), Tray())) == (1, 2)
    assert fault.apply(1, Frame(0x186, b"\xbb"), Tray()) == Frame(0x186, b"\xaa")
    late = Frame(0x187, b"\x01")
    assert fault.apply(1, late, Tray()) is late
    assert fault.apply(2, Frame(0x187, b"\x02"), Tray()) == late


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
    assert values(begun(StuckAtValue(VELOCITY, 0)).apply(0, joint(5, 99), Tray())) == (5, 0)
    assert values(begun(StuckAtValue(VELOCITY, -7)).apply(0, joint(5, 99), Tray())) == (5, -7)


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
    assert fault.apply(0, joint(5, 99), Tray()) == joint(0, 0)
    assert [fault.fits(Frame(0x185, bytes(n))) for n in (0, 7, 8)] == [False, False, True]
    with pytest.raises(FaultError, match=r"9 bytes given, allowed 0\.\.8"):
        StuckAtPayload(bytes(9))


@pytest.mark.parametrize(
    ("signal", "value", "offset", "out", "saturated"),
    [
        (POSITION, 5, 7, 12, 0),
        (POSITION, 2**31 - 3, 2, 2**31 - 1, 0),
        (POSITION, 2**31 - 3, 3, 2**31 - 1, 1),
        (POSITION, -(2**31) + 3, -3, -(2**31), 0),
        (POSITION, -(2**31) + 3, -4, -(2**31), 1),
        (POSITION, 0, 2**40, 2**31 - 1, 1),
        (WORD, 65534, 1, 65535, 0),
        (WORD, 65535, 1, 65535, 1),
        (WORD, 1, -1, 0, 0),
        (WORD, 1, -2, 0, 1),
        (ODD, 1023, 1, 1023, 1),
        (ODD, -1024, -1, -1024, 1),
        (ODD, -1, 2, 1, 0),
    ],
)
def test_bias_adds_and_saturates_at_the_range(
    signal: Signal, value: int, offset: int, out: int, saturated: int
) -> None:
    """faults.md: value + bias; values that no longer fit saturate, nothing wraps."""
    fault = begun(Bias(signal, offset))
    frame = Frame(signal.cob_id, signal.write(b"\xa5" * 8, value))
    result = fault.apply(0, frame, Tray())
    assert result is not None
    assert signal.read(result.data) == out
    mask = ((1 << signal.length) - 1) << signal.start
    assert word(result) & ~mask == word(frame) & ~mask
    assert fault.saturated == saturated


def test_saturation_is_counted_per_activation() -> None:
    """faults.md: they say so; the count starts anew with each activation."""
    fault = begun(Bias(WORD, 1))
    for _ in range(3):
        fault.apply(0, Frame(0x285, b"\xff\xff"), Tray())
    assert fault.saturated == 3
    begun(fault)
    assert fault.saturated == 0


@pytest.mark.parametrize(("probability", "lost"), [(0.0, 0), (1.0, 200)])
def test_drop_with_certainty(probability: float, lost: int) -> None:
    """faults.md: the frame is lost with probability p."""
    fault, frame = begun(Drop(probability)), joint(1, 2)
    assert [fault.apply(n, frame, Tray()) for n in range(200)].count(None) == lost


def test_drop_follows_the_binomial_distribution() -> None:
    """P(lost) = p, tested two-sided at 1 % with a fixed seed."""
    fault, frame = begun(Drop(0.3)), joint(1, 2)
    results = [fault.apply(n, frame, Tray()) for n in range(5000)]
    assert all(result is None or result is frame for result in results)
    assert stats.binomtest(results.count(None), 5000, 0.3).pvalue > 0.01


@pytest.mark.parametrize("probability", [-0.1, 1.1, float("nan")])
def test_drop_refuses_what_is_no_probability(probability: float) -> None:
    """Bad parameters are refused where they are made."""
    with pytest.raises(FaultError, match=r"allowed 0\.\.1"):
        Drop(probability)


@given(st.integers(1, 11), st.binary(min_size=8, max_size=8), st.booleans(), st.integers(0, 2**32))
def test_bit_flip_inverts_exactly_n_distinct_bits_of_the_signal(
    count: int, data: bytes, fixed: bool, seed: int
) -> None:
    """faults.md: n distinct random bits inverted; none outside the signal."""
    fault, frame = begun(BitFlip(ODD, count, None, fixed), seed=seed), Frame(0x185, data)
    changed = word(fault.apply(0, frame, Tray())) ^ word(frame)
    assert changed.bit_count() == count
    assert changed & ~(0x7FF << 13) == 0


@given(st.binary(min_size=1, max_size=8), st.data())
def test_bit_flip_on_a_payload_stays_inside_it(data: bytes, more: st.DataObject) -> None:
    """Without a signal every payload bit can be hit, and only those."""
    count = more.draw(st.integers(1, 8 * len(data)))
    frame = Frame(0x185, data)
    fault = begun(BitFlip(None, count))
    assert fault.fits(frame)
    result = fault.apply(0, frame, Tray())
    assert result is not None
    assert len(result.data) == len(data)
    assert (word(result) ^ word(frame)).bit_count() == count


@pytest.mark.parametrize("fault", [BitFlip(ODD, 1, (0, 10)), BitFlip(None, 3, None, True), BitFlip(ODD, 2, None, True)])
def test_bit_flip_of_the_same_bits_twice_gives_the_frame_back(fault: BitFlip) -> None:
    """out = in XOR mask is its own inverse."""
    frame = joint(123456, -98765)
    begun(fault)
    once = fault.apply(0, frame, Tray())
    assert once is not None
    assert once != frame
    assert fault.apply(1, once, Tray()) == frame


def test_given_bits_count_from_the_lowest_bit_of_the_signal() -> None:
    """Bit 31 of a signed 32-bit count is its sign."""
    fault = begun(BitFlip(VELOCITY, 1, (31,)))
    assert values(fault.apply(0, joint(5, 0), Tray())) == (5, -(2**31))
    assert word(begun(BitFlip(None, 1, (0, 63))).apply(0, joint(0, 0), Tray())) == 1 | 1 << 63


def test_bit_flip_takes_new_bits_for_every_frame_unless_fixed() -> None:
    """faults.md: bit_flip takes new bits for every frame unless fixed, which lasts for one activation."""
    frame = joint(0, 0)
    free, fixed = begun(BitFlip(POSITION, 1)), begun(BitFlip(POSITION, 1, None, True))
    assert len({word(free.apply(n, frame, Tray())) for n in range(50)}) > 10
    assert len({word(fixed.apply(n, frame, Tray())) for n in range(50)}) == 1
    stream, seen = rng(), set()
    for _ in range(50):
        assert fixed.begin(0, {}, stream)
        seen.add(word(fixed.apply(0, frame, Tray())))
    assert len(seen) > 10


def test_every_set_of_bits_is_equally_likely() -> None:
    """Chi-squared over the 10 pairs of 5 bits, 1 % with a fixed seed."""
    generator, counts = rng(3), dict.fromkeys([1 << a | 1 << b for a in range(5) for b in range(a)], 0)
    for _ in range(5000):
        counts[distinct_bits(generator, 2, 5)] += 1
    assert stats.chisquare(list(counts.values())).pvalue > 0.01


@pytest.mark.parametrize(
    ("signal", "count", "bits", "message"),
    [
        (ODD, 0, None, r"allowed 1\.\.11"),
        (ODD, 12, None, r"allowed 1\.\.11"),
        (None, 65, None, r"allowed 1\.\.64"),
        (ODD, 1, (), r"no bits given"),
        (ODD, 1, (-1,), r"0\.\.10"),
        (ODD, 1, (11,), r"0\.\.10"),
        (ODD, 2, (3, 3), "distinct"),
    ],
)
def test_bit_flip_refuses_bits_that_are_not_there(
    signal: Signal | None, count: int, bits: tuple[int, ...] | None, message: str
) -> None:
    """The message names what is allowed."""
    with pytest.raises(FaultError, match=message):
        BitFlip(signal, count, bits)


@pytest.mark.parametrize(
    ("fault", "shortest"),
    [
        (StuckAtValue(POSITION, 0), 4),
        (Bias(VELOCITY, 1), 8),
        (StuckAt(ODD), 3),
        (BitFlip(ODD, 1), 3),
        (BitFlip(None, 9), 2),
        (BitFlip(None, 1, (15,)), 2),
        (BitFlip(None, 1, (16,)), 3),
        (Drop(), 0),
    ],
)
def test_a_frame_fits_from_the_byte_that_holds_the_last_bit(fault: Fault, shortest: int) -> None:
    """A frame too short passes unchanged: `fits` says which is."""
    fault.begin(0, {}, rng())
    assert [fault.fits(Frame(0x185, bytes(n))) for n in range(9)] == [n >= shortest for n in range(9)]


def test_raw_dlc_above_8_is_kept() -> None:
    """faults.md: id type, DLC, RTR, FD flags kept; DLC 9..15 mean 8 data bytes (ISO 11898-1)."""
    result = begun(StuckAtValue(POSITION, 3)).apply(0, Frame(0x185, bytes(8), 0, 15), Tray())
    assert result is not None
    assert (result.dlc, result.data) == (15, struct.pack("<ii", 3, 0))


def test_flags_are_kept() -> None:
    """The fault itself changes the payload only."""
    result = begun(StuckAtValue(POSITION, 3)).apply(0, Frame(0x12345678, bytes(8), FLAG_EXTENDED), Tray())
    assert result is not None
    assert (result.can_id, result.flags) == (0x12345678, FLAG_EXTENDED)


EVERY: list[Callable[[], Fault]] = [
    lambda: StuckAt(POSITION),
    lambda: StuckAt(None),
    lambda: StuckAtValue(WORD, 7),
    lambda: StuckAtPayload(bytes(8)),
    lambda: Bias(ODD, 100),
    lambda: Drop(0.5),
    lambda: BitFlip(ODD, 2),
    lambda: BitFlip(None, 3, None, True),
    lambda: BitFlip(VELOCITY, 1, (3,)),
]


@given(st.sampled_from(EVERY), st.binary(max_size=8), st.binary(max_size=8))
def test_no_fault_raises_or_changes_length_or_id(make: Callable[[], Fault], last: bytes, data: bytes) -> None:
    """Bytes from the wire are data, whatever they are."""
    fault: Fault = make()
    frame, before = Frame(0x185, data), Frame(0x185, last)
    fits = fault.signal is None or fault.signal.fits(last)
    if fault.begin(0, {0x185: before} if fits else {}, rng()) and fault.fits(frame):
        result = fault.apply(0, frame, Tray())
        assert result is None or (result.can_id == 0x185 and len(result.data) == len(data))
    fault.end()


@pytest.mark.parametrize("make", EVERY)
def test_only_a_drop_gives_back_a_frame_that_it_left_alone(make: Callable[[], Fault]) -> None:
    """faults.md: injected counts frames acted on: for a drop the same frame means spared, for others the same value."""
    fault: Fault = make()
    assert fault.spares == isinstance(fault, Drop)
    assert copy.deepcopy(fault).spares == fault.spares


@pytest.mark.parametrize("make", EVERY)
def test_a_copy_in_mid_activation_goes_on_identically(make: Callable[[], Fault]) -> None:
    """Snapshots: deepcopy and pickle keep held values, drawn bits and the stream."""
    fault: Fault = make()
    fault.begin(0, {0x185: joint(4, 5)}, rng())
    for n in range(3):
        fault.apply(n, joint(n, n), Tray())
    copies = [copy.deepcopy(fault), pickle.loads(pickle.dumps(fault))]
    on = [fault.apply(n, joint(n, -n), Tray()) for n in range(20)]
    for twin in copies:
        assert [twin.apply(n, joint(n, -n), Tray()) for n in range(20)] == on
        assert twin.saturated == fault.saturated
