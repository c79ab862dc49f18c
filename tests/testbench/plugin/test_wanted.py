"""Frame expectations: which frame is the wanted one."""

import pytest

from canopen_exo.bus.frame import FLAG_EXTENDED, FLAG_FD, FLAG_REMOTE, Frame
from canopen_exo.bus.medium import Transmission
from testbench.errors import BenchError
from testbench.plugin.wanted import Search, Wanted


def row(frame: Frame, bus: int = 1, end_ns: int = 0) -> Transmission:
    return Transmission(end_ns, bus, frame, -1)


@pytest.mark.parametrize(
    ("data", "fits"),
    [
        (None, True),
        (b"\x50\x82", True),
        (b"\x50\x83", False),
        (b"\x50", False),
        ("5082", True),
        ("50 82", True),
        (".. 82", True),
        ("50 ..", True),
        ("....", True),
        ("..", False),
        (".. .. ..", False),
        ("", False),
    ],
)
def test_the_whole_payload_is_compared(data: bytes | str | None, fits: bool) -> None:
    """docs/pytest.md: `..` is any byte, one byte; no data given is any payload."""
    assert Wanted(0x085, data, 1).fits(row(Frame(0x085, b"\x50\x82"))) is fits


@pytest.mark.parametrize(
    ("data", "words"),
    [
        (None, ""),
        (b"\x01\x02", ""),
        (b"\x50\x82\x00", "length 2, data has 3"),
        (".. .. ..", "length 2, data has 3"),
        ("50", "length 2, data has 1"),
        ("", "length 2, data has 0"),
    ],
)
def test_another_length_is_said(data: bytes | str | None, words: str) -> None:
    """Zeros at the end, or a byte too few, are not seen at a glance."""
    wanted = Wanted(0x085, data, 1)
    assert wanted.length_words(Frame(0x085, b"\x50\x82")) == words
    assert wanted.length_words(Frame(0x085, b"", FLAG_REMOTE)) == ""


@pytest.mark.parametrize(
    "other",
    [
        row(Frame(0x086, b"")),
        row(Frame(0x085, b""), bus=0),
        row(Frame(0x085, b"", FLAG_EXTENDED)),
        row(Frame(0x085, b"", FLAG_REMOTE, 0)),
        row(Frame(0x085, b"", FLAG_FD)),
    ],
)
def test_other_ids_buses_and_kinds_of_frames_do_not_fit(other: Transmission) -> None:
    """A classical 11-bit data frame on that bus is wanted."""
    assert Wanted(0x085, None, 1).fits(row(Frame(0x085, b"")))
    assert not Wanted(0x085, None, 1).fits(other)


@pytest.mark.parametrize("data", ["5", "5 0 8", "0x50", "...", "zz", bytes(9), "00" * 9])
def test_a_payload_that_cannot_be_is_refused(data: bytes | str) -> None:
    """A test that expects the impossible is wrong, and is told so instead of waiting."""
    with pytest.raises(BenchError, match=r"allowed are up to 8 bytes, or a text such as '27 06 \.\. \.\.'"):
        Wanted(0x085, data, 1)


@pytest.mark.parametrize("cob_id", [-1, 0x800])
def test_an_id_that_cannot_be_is_refused(cob_id: int) -> None:
    """11 bits."""
    with pytest.raises(BenchError, match=r"allowed 0x0\.\.0x7ff"):
        Wanted(cob_id, None, 1)


def test_a_search_finds_the_first_new_frame_by_the_limit() -> None:
    """Frames before the call, and those that end after the limit, are not meant; the limit itself is."""
    frame = Frame(0x085, b"")
    rows = [row(frame, end_ns=5)]
    search = Search(Wanted(0x085, None, 1), rows, 5, 10)
    assert not search.is_over()
    rows.append(row(frame, end_ns=4))
    assert not search.is_over()
    rows += [row(Frame(0x086, b""), end_ns=5), row(frame, end_ns=10), row(frame, end_ns=10)]
    assert search.is_over()
    assert search.found is rows[3]


def test_a_frame_after_the_limit_is_too_late() -> None:
    """`within` includes its end and nothing behind it."""
    rows: list[Transmission] = []
    search = Search(Wanted(0x085, None, 1), rows, 0, 10)
    rows.append(row(Frame(0x085, b""), end_ns=11))
    assert not search.is_over()
