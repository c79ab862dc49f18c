"""Single bits: which ones, and no other."""

import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from canopen_exo.bus.frame import Frame
from canopen_exo.signal import Signal
from fi_gateway.errors import FaultError
from fi_gateway.faults import BitFlip, BitStuck, distinct_bits
from tests.fi_gateway.faults.bench import ODD, OUT, POSITION, VELOCITY, begun, joint, rng, values, word


@given(st.integers(1, 11), st.binary(min_size=8, max_size=8), st.booleans(), st.integers(0, 2**32))
def test_bit_flip_inverts_exactly_n_distinct_bits_of_the_signal(
    count: int, data: bytes, fixed: bool, seed: int
) -> None:
    """faults.md: n distinct random bits inverted; none outside the signal."""
    fault, frame = begun(BitFlip(ODD, count, None, fixed), seed=seed), Frame(0x185, data)
    changed = word(fault.apply(0, frame, OUT)) ^ word(frame)
    assert changed.bit_count() == count
    assert changed & ~(0x7FF << 13) == 0


@given(st.binary(min_size=1, max_size=8), st.data())
def test_bit_flip_on_a_payload_stays_inside_it(data: bytes, more: st.DataObject) -> None:
    """Without a signal every payload bit can be hit, and only those."""
    count = more.draw(st.integers(1, 8 * len(data)))
    frame = Frame(0x185, data)
    fault = begun(BitFlip(None, count))
    assert fault.fits(frame)
    result = fault.apply(0, frame, OUT)
    assert result is not None
    assert len(result.data) == len(data)
    assert (word(result) ^ word(frame)).bit_count() == count


@pytest.mark.parametrize("fault", [BitFlip(ODD, 1, (0, 10)), BitFlip(None, 3, None, True), BitFlip(ODD, 2, None, True)])
def test_bit_flip_of_the_same_bits_twice_gives_the_frame_back(fault: BitFlip) -> None:
    """out = in XOR mask is its own inverse."""
    frame = joint(123456, -98765)
    begun(fault)
    once = fault.apply(0, frame, OUT)
    assert once is not None
    assert once != frame
    assert fault.apply(1, once, OUT) == frame


def test_given_bits_count_from_the_lowest_bit_of_the_signal() -> None:
    """Bit 31 of a signed 32-bit count is its sign."""
    fault = begun(BitFlip(VELOCITY, 1, (31,)))
    assert values(fault.apply(0, joint(5, 0), OUT)) == (5, -(2**31))
    assert word(begun(BitFlip(None, 1, (0, 63))).apply(0, joint(0, 0), OUT)) == 1 | 1 << 63


def test_bit_flip_takes_new_bits_for_every_frame_unless_fixed() -> None:
    """faults.md: bit_flip takes new bits for every frame unless fixed, which lasts for one activation."""
    frame = joint(0, 0)
    free, fixed = begun(BitFlip(POSITION, 1)), begun(BitFlip(POSITION, 1, None, True))
    assert len({word(free.apply(n, frame, OUT)) for n in range(50)}) > 10
    assert len({word(fixed.apply(n, frame, OUT)) for n in range(50)}) == 1
    stream, seen = rng(), set()
    for _ in range(50):
        assert fixed.begin(0, {}, stream)
        seen.add(word(fixed.apply(0, frame, OUT)))
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
    ("signal", "bits", "level", "data", "out"),
    [
        (VELOCITY, (0, 31), 1, "11111111 00000000", "11111111 01000080"),
        (VELOCITY, (0, 31), 0, "11111111 FFFFFFFF", "11111111 FEFFFF7F"),
        (ODD, (0, 10), 1, "00000000 00000000", "00208000 00000000"),
        (None, (0, 63), 1, "00000000 00000000", "01000000 00000080"),
        (None, (8, 9, 10), 0, "FFFF", "FFF8"),
        (None, (8,), 0, "FFFE", "FFFE"),
    ],
)
def test_bit_stuck_holds_the_given_bits_and_no_other(
    signal: Signal | None, bits: tuple[int, ...], level: int, data: str, out: str
) -> None:
    """faults.md: given bits held at 0 or 1; positions count from the lowest bit of the signal or payload."""
    frame = Frame(0x185, bytes.fromhex(data))
    result = begun(BitStuck(signal, bits, level)).apply(0, frame, OUT)
    assert result == Frame(0x185, bytes.fromhex(out))
    assert (result is frame) == (data == out)


@given(st.sets(st.integers(0, 10), min_size=1), st.integers(0, 1), st.binary(min_size=3, max_size=8))
def test_bit_stuck_at_every_level_and_position(positions: set[int], level: int, data: bytes) -> None:
    """Held bits read the level, all others are what they were."""
    frame = Frame(0x185, data)
    held = word(begun(BitStuck(ODD, tuple(positions), level)).apply(0, frame, OUT))
    mask = sum(1 << 13 + bit for bit in positions)
    assert held & mask == mask * level
    assert held & ~mask == word(frame) & ~mask


@pytest.mark.parametrize(
    ("bits", "level", "message"),
    [
        ((), 0, "no bits given"),
        ((11,), 0, r"0\.\.10"),
        ((-1,), 1, r"0\.\.10"),
        ((3, 3), 1, "distinct"),
        ((3,), 2, "level 2 given, allowed 0 or 1"),
    ],
)
def test_bit_stuck_refuses_bits_that_are_not_there(bits: tuple[int, ...], level: int, message: str) -> None:
    """The message names what is allowed."""
    with pytest.raises(FaultError, match=message):
        BitStuck(ODD, bits, level)
