"""Frames that nobody sent like this: exact bytes, identities and lengths."""

import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from canopen_exo.bus.frame import Frame
from canopen_exo.bus.node import NEVER
from fi_gateway.errors import FaultError
from fi_gateway.faults import CorruptDlc, Insert, Masquerade
from tests.fi_gateway.faults.bench import OUT, Taken, begun, joint

STOP = Frame(0x000, b"\x02\x05")


def test_insert_sends_its_frame_at_the_start_and_then_every_period() -> None:
    """EN 50159 insertion: without being asked, on a grid from the start of the activation."""
    fault, out = begun(Insert(STOP, 100), now=50), Taken()
    times = []
    for _ in range(3):
        times.append(fault.wake_at)
        fault.wake(fault.wake_at, out)
    assert times == [50, 150, 250]
    assert out.inserted == [STOP, STOP, STOP]


@pytest.mark.parametrize(("now", "following"), [(50, 150), (149, 150), (150, 250), (349, 350), (350, 450)])
def test_insert_keeps_to_its_grid_when_it_is_woken_late(now: int, following: int) -> None:
    """One frame per call, and never a time that is over."""
    fault, out = begun(Insert(STOP, 100), now=50), Taken()
    fault.wake(now, out)
    assert (fault.wake_at, len(out.inserted)) == (following, 1)


def test_insert_leaves_genuine_frames_alone_and_stops_with_the_window() -> None:
    """A further frame changes no other."""
    fault, one = begun(Insert(STOP, 100)), joint(1, 2)
    assert fault.apply(5, one, OUT) is one
    assert fault.spares
    fault.end()
    assert fault.wake_at == NEVER


def test_insert_may_come_ahead_of_each_target_frame() -> None:
    """Without a period."""
    fault, one, out = begun(Insert(STOP)), joint(1, 2), Taken()
    assert fault.wake_at == NEVER
    assert fault.apply(5, one, out) is one
    assert out.inserted == [STOP]
    assert not fault.spares


@pytest.mark.parametrize("every_ns", [-1, NEVER])
def test_insert_needs_a_period(every_ns: int) -> None:
    """Bad parameters are refused where they are made."""
    with pytest.raises(FaultError, match=rf"insert: period {every_ns} ns given, allowed 0\.\."):
        Insert(STOP, every_ns)


def test_masquerade_passes_a_message_off_as_anothers() -> None:
    """EN 50159 masquerade: the same payload under another COB-ID."""
    one = joint(1, 2)
    assert begun(Masquerade(0x182)).apply(0, one, OUT) == Frame(0x182, one.data)
    assert begun(Masquerade(0x185)).apply(0, one, OUT) is one
    raw = begun(Masquerade(0x182)).apply(0, Frame(0x185, bytes(8), 0, 13), OUT)
    assert raw == Frame(0x182, bytes(8), 0, 13)


def test_masquerade_may_let_the_genuine_frame_go_on() -> None:
    """`copy`: the forged one comes first."""
    one, out = joint(1, 2), Taken()
    assert begun(Masquerade(0x182, True)).apply(0, one, out) is one
    assert out.inserted == [Frame(0x182, one.data)]


@pytest.mark.parametrize("cob_id", [-1, 0x800])
def test_masquerade_needs_an_11_bit_id(cob_id: int) -> None:
    """Bad parameters are refused where they are made."""
    with pytest.raises(FaultError, match=r"allowed 0x0\.\.0x7ff"):
        Masquerade(cob_id)


@pytest.mark.parametrize(
    ("dlc", "data", "out", "wire"),
    [
        (0, "0102030405060708", "", 0),
        (4, "0102030405060708", "01020304", 4),
        (7, "0102030405060708", "01020304050607", 7),
        (8, "0102", "0102000000000000", 8),
        (3, "0102", "010200", 3),
        (9, "0102030405060708", "0102030405060708", 9),
        (15, "0102", "0102000000000000", 15),
        (1, "", "00", 1),
    ],
)
def test_corrupt_dlc_cuts_or_fills_the_payload(dlc: int, data: str, out: str, wire: int) -> None:
    """ISO 11898-1: DLC 0..8 are lengths, 9..15 mean 8 bytes; what is missing is filled with 00."""
    result = begun(CorruptDlc(dlc)).apply(0, Frame(0x185, bytes.fromhex(data)), OUT)
    assert result is not None
    assert (result.can_id, result.data.hex(), result.dlc) == (0x185, out, wire)


@pytest.mark.parametrize(("given_dlc", "dlc"), [(8, -1), (2, -1), (8, 15)])
def test_corrupt_dlc_leaves_a_frame_that_has_it_already(given_dlc: int, dlc: int) -> None:
    """Nothing changes, nothing is made."""
    one = Frame(0x185, bytes(given_dlc), 0, dlc)
    assert begun(CorruptDlc(one.dlc)).apply(0, one, OUT) is one


@given(st.binary(max_size=8), st.integers(0, 2**32))
def test_a_random_dlc_is_another_length(data: bytes, seed: int) -> None:
    """0..8, never the right one."""
    result = begun(CorruptDlc(), seed=seed).apply(0, Frame(0x185, data), OUT)
    assert result is not None
    assert len(result.data) == result.dlc != len(data)
    assert result.data[: len(data)] == data[: result.dlc]


@pytest.mark.parametrize("size", [0, 3, 8])
def test_every_wrong_length_is_equally_likely(size: int) -> None:
    """Chi-squared over 8 lengths at 1 %, seeds 0..19, at most 2 rejections."""
    rejected = 0
    for seed in range(20):
        fault, counts = begun(CorruptDlc(), seed=seed), dict.fromkeys([n for n in range(9) if n != size], 0)
        for _ in range(1600):
            result = fault.apply(0, Frame(0x185, bytes(size)), OUT)
            assert result is not None
            counts[result.dlc] += 1
        rejected += stats.chisquare(list(counts.values())).pvalue < 0.01
    assert rejected <= 2
    assert stats.chisquare([400, 200, 200, 200, 200, 200, 100, 100]).pvalue < 0.01


@pytest.mark.parametrize("dlc", [-2, 16])
def test_corrupt_dlc_needs_four_bits(dlc: int) -> None:
    """Bad parameters are refused where they are made."""
    with pytest.raises(FaultError, match=rf"corrupt_dlc: DLC {dlc} given, allowed 0\.\.15"):
        CorruptDlc(dlc)
