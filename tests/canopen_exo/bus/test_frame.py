"""The Frame: what makes one, what it compares equal to, and who wins arbitration."""

import copy
import pickle

import pytest
from hypothesis import given
from hypothesis import strategies as st

from canopen_exo.bus.bits import frame_bits
from canopen_exo.bus.frame import FLAG_BRS, FLAG_ESI, FLAG_EXTENDED, FLAG_FD, FLAG_REMOTE, Frame
from canopen_exo.errors import CanopenExoError

CLASSICAL = st.one_of(
    st.builds(Frame, st.integers(0, 0x7FF), st.binary(max_size=8)),
    st.builds(Frame, st.integers(0, 0x1FFFFFFF), st.binary(max_size=8), st.just(FLAG_EXTENDED)),
    st.builds(Frame, st.integers(0, 0x7FF), st.just(b""), st.just(FLAG_REMOTE), st.integers(0, 15)),
    st.builds(
        Frame, st.integers(0, 0x1FFFFFFF), st.just(b""), st.just(FLAG_REMOTE | FLAG_EXTENDED), st.integers(0, 15)
    ),
    st.builds(Frame, st.integers(0, 0x7FF), st.binary(min_size=8, max_size=8), st.just(0), st.integers(8, 15)),
)


@pytest.mark.parametrize("can_id", [0, 1, 0x7FE, 0x7FF])
@pytest.mark.parametrize("size", [0, 1, 7, 8])
def test_base_frame_takes_every_11_bit_id_and_up_to_8_bytes(can_id: int, size: int) -> None:
    """ISO 11898-1: base format."""
    frame = Frame(can_id, bytes(size))
    assert (frame.can_id, frame.data, frame.flags, frame.dlc, frame.bits) == (can_id, bytes(size), 0, size, 0)


@pytest.mark.parametrize("can_id", [0, 0x7FF, 0x800, 0x1FFFFFFF])
def test_extended_frame_takes_every_29_bit_id(can_id: int) -> None:
    """ISO 11898-1: extended format."""
    assert Frame(can_id, b"\1", FLAG_EXTENDED).can_id == can_id


@pytest.mark.parametrize(
    ("can_id", "flags", "top"),
    [
        (-1, 0, "0x7ff"),
        (0x800, 0, "0x7ff"),
        (0x20000000, 0, "0x7ff"),
        (0x800, FLAG_REMOTE, "0x7ff"),
        (-1, FLAG_EXTENDED, "0x1fffffff"),
        (0x20000000, FLAG_EXTENDED, "0x1fffffff"),
    ],
)
def test_id_out_of_range_is_refused(can_id: int, flags: int, top: str) -> None:
    """Style: the message says what was given and what is allowed."""
    with pytest.raises(CanopenExoError, match="CAN id") as caught:
        Frame(can_id, b"", flags)
    assert f"{can_id:#x} given, allowed 0..{top}" in str(caught.value)


@pytest.mark.parametrize("flags", [0, FLAG_EXTENDED])
def test_nine_bytes_are_refused(flags: int) -> None:
    """ISO 11898-1: a classical frame has 0..8 data bytes."""
    with pytest.raises(CanopenExoError, match=r"9 data bytes given, a classical frame has 0\.\.8"):
        Frame(1, bytes(9), flags)


def test_remote_frame_with_data_is_refused() -> None:
    """ISO 11898-1: a remote frame has no data field."""
    with pytest.raises(CanopenExoError, match="a remote frame carries no data; give its length as dlc"):
        Frame(1, b"\0", FLAG_REMOTE)


@pytest.mark.parametrize("dlc", range(16))
def test_remote_frame_takes_every_dlc(dlc: int) -> None:
    """ISO 11898-1: the DLC of a remote frame is that of the data frame asked for, raw 0..15."""
    frame = Frame(0x701, b"", FLAG_REMOTE, dlc)
    assert (frame.dlc, frame.data) == (dlc, b"")


def test_remote_frame_without_a_dlc_asks_for_none() -> None:
    """The default is the length of the data, which a remote frame has none of."""
    assert Frame(0x701, b"", FLAG_REMOTE).dlc == 0


@pytest.mark.parametrize("dlc", range(8, 16))
def test_data_frame_of_8_bytes_takes_the_raw_dlc_above(dlc: int) -> None:
    """ISO 11898-1: DLC 9..15 mean 8 data bytes."""
    assert Frame(1, bytes(8), 0, dlc).dlc == dlc


@pytest.mark.parametrize(
    ("size", "flags", "dlc"), [(8, 0, 7), (8, 0, 16), (7, 0, 8), (0, 0, 1), (7, FLAG_EXTENDED, 9), (0, FLAG_REMOTE, 16)]
)
def test_dlc_that_does_not_fit_is_refused(size: int, flags: int, dlc: int) -> None:
    """ISO 11898-1: the DLC says the length of the data field, and has four bits."""
    with pytest.raises(CanopenExoError, match=f"dlc {dlc} given with {size} data bytes"):
        Frame(1, bytes(size), flags, dlc)


@pytest.mark.parametrize(
    ("size", "dlc"), [(0, 0), (8, 8), (12, 9), (16, 10), (20, 11), (24, 12), (32, 13), (48, 14), (64, 15)]
)
def test_fd_frame_has_the_coded_dlc(size: int, dlc: int) -> None:
    """ISO 11898-1, CAN FD: DLC 9..15 mean 12, 16, 20, 24, 32, 48 and 64 bytes."""
    frame = Frame(1, bytes(size), FLAG_FD | FLAG_BRS | FLAG_ESI)
    assert (frame.dlc, len(frame.data)) == (dlc, size)


@pytest.mark.parametrize("size", [9, 11, 13, 63, 65])
def test_fd_frame_of_an_odd_size_is_refused(size: int) -> None:
    """ISO 11898-1, CAN FD: there are no other lengths."""
    with pytest.raises(CanopenExoError, match=f"{size} data bytes given, a CAN FD frame has"):
        Frame(1, bytes(size), FLAG_FD)


@given(frame=CLASSICAL)
def test_measure_gives_the_length_on_the_wire_and_keeps_it(frame: Frame) -> None:
    """Design: a frame works out its bit count once and carries it over both hops."""
    expected = frame_bits(
        frame.can_id, frame.data, bool(frame.flags & FLAG_EXTENDED), bool(frame.flags & FLAG_REMOTE), frame.dlc
    )
    assert frame.bits == 0
    assert frame.measure() == expected
    assert frame.bits == expected


@given(frame=CLASSICAL)
def test_copies_are_equal(frame: Frame) -> None:
    """Design: values can be copied and pickled, for snapshots and for other processes."""
    for twin in (copy.copy(frame), copy.deepcopy(frame), pickle.loads(pickle.dumps(frame))):
        assert twin == frame
        assert hash(twin) == hash(frame)
        assert (twin.dlc, twin.arbitration) == (frame.dlc, frame.arbitration)


DIFFERENT = [
    Frame(1, b""),
    Frame(2, b""),
    Frame(1, b"\0"),
    Frame(1, b"", FLAG_EXTENDED),
    Frame(1, b"", FLAG_REMOTE),
    Frame(1, b"", FLAG_REMOTE, 1),
    Frame(1, b"", FLAG_FD),
    Frame(1, bytes(8)),
    Frame(1, bytes(8), 0, 9),
]


def test_frames_that_differ_in_one_part_are_not_equal() -> None:
    """Equal means the same id, data, flags and DLC; nothing else equals a frame."""
    for at, frame in enumerate(DIFFERENT):
        for other, twin in enumerate(copy.deepcopy(DIFFERENT)):
            assert (frame == twin) == (at == other)
    assert Frame(1, b"") != (1, b"", 0, 0)


def test_measuring_a_frame_does_not_change_what_it_equals() -> None:
    """The bit count is a result, not a part of the frame."""
    frame = Frame(1, b"\1")
    frame.measure()
    assert frame == Frame(1, b"\1")


@given(frame=CLASSICAL, fill=st.binary(min_size=8, max_size=8))
def test_another_payload_leaves_the_rest_alone(frame: Frame, fill: bytes) -> None:
    """`with_data`: the same id, flags and DLC, and a length on the wire of its own."""
    frame.measure()
    twin = frame.with_data(fill[: len(frame.data)])
    assert (twin.can_id, twin.flags, twin.dlc) == (frame.can_id, frame.flags, frame.dlc)
    assert twin.data == fill[: len(frame.data)]
    assert twin.bits == 0


@pytest.mark.parametrize(
    ("frame", "text"),
    [
        (Frame(0x80, b"\x01"), "080#01"),
        (Frame(0x7FF, b""), "7FF#"),
        (Frame(0x80, b"\xab", FLAG_EXTENDED), "00000080#AB"),
        (Frame(0x701, b"", FLAG_REMOTE), "701#R"),
    ],
)
def test_frame_shows_itself_in_compact_notation(frame: Frame, text: str) -> None:
    """For messages and test reports."""
    assert repr(frame) == text


# --- arbitration -------------------------------------------------------------------------------------------------


def arbitration_bits(frame: Frame) -> str:
    """ID, RTR, IDE, and in the extended format the rest of the id and its RTR; one character a bit, as sent."""
    remote = "1" if frame.flags & FLAG_REMOTE else "0"
    if frame.flags & FLAG_EXTENDED:
        return f"{frame.can_id >> 18:011b}11{frame.can_id & 0x3FFFF:018b}{remote}"
    return f"{frame.can_id:011b}{remote}0"


def wins(one: Frame, other: Frame) -> bool:
    """Bit by bit: who sends the first dominant bit (0) against a recessive one."""
    for a, b in zip(arbitration_bits(one), arbitration_bits(other), strict=False):
        if a != b:
            return a == "0"
    return False


@given(one=CLASSICAL, other=CLASSICAL)
def test_lower_arbitration_field_wins(one: Frame, other: Frame) -> None:
    """ISO 11898-1: dominant bits win, bit by bit, over all kinds of frames."""
    assert (one.arbitration < other.arbitration) == wins(one, other)


@given(top=st.integers(0, 0x7FF), rest=st.integers(0, 0x3FFFF), remote=st.booleans())
def test_base_frame_wins_against_the_extended_one_with_the_same_first_bits(top: int, rest: int, remote: bool) -> None:
    """ISO 11898-1: SRR and IDE are recessive; even a base remote frame wins against extended data."""
    base = Frame(top, b"", FLAG_REMOTE if remote else 0)
    assert base.arbitration < Frame(top << 18 | rest, b"", FLAG_EXTENDED).arbitration


@given(can_id=st.integers(0, 0x1FFFFFFF), extended=st.booleans())
def test_data_frame_wins_against_the_remote_frame_of_its_id(can_id: int, extended: bool) -> None:
    """ISO 11898-1: RTR is dominant in a data frame."""
    flags = FLAG_EXTENDED if extended else 0
    can_id = can_id if extended else can_id & 0x7FF
    assert Frame(can_id, b"\1", flags).arbitration < Frame(can_id, b"", flags | FLAG_REMOTE).arbitration


@given(low=st.integers(0, 0x7FE), data=st.binary(max_size=8))
def test_data_takes_no_part_in_arbitration(low: int, data: bytes) -> None:
    """ISO 11898-1: only the arbitration field decides."""
    assert Frame(low, data).arbitration == Frame(low, b"").arbitration < Frame(low + 1, b"").arbitration
