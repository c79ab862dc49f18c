"""Frames as bits on the wire, and back."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from canopen_exo.bus.bit_stream import FIELDS, field_positions, frame_of, unstuffed_bits, wire_bits
from canopen_exo.bus.controller import Controller
from canopen_exo.bus.frame import FLAG_EXTENDED, FLAG_REMOTE, Frame

VECTORS = [
    (0x123, "1122334455667788", 0x4237, 99),
    (0x181, "0000000000000000", 0x4D06, 113),
    (0x7FF, "FFFFFFFFFFFFFFFF", 0x4C89, 113),
    (0x000, "", 0x0000, 40),
    (0x080, "", 0x1C05, 38),
]

FRAMES = st.one_of(
    st.builds(Frame, st.integers(0, 0x7FF), st.binary(max_size=8)),
    st.builds(Frame, st.integers(0, 0x1FFFFFFF), st.binary(max_size=8), st.just(FLAG_EXTENDED)),
    st.builds(Frame, st.integers(0, 0x7FF), st.binary(min_size=8, max_size=8), st.just(0), st.integers(8, 15)),
    st.builds(Frame, st.integers(0, 0x7FF), st.just(b""), st.just(FLAG_REMOTE), st.integers(0, 15)),
    st.builds(
        Frame, st.integers(0, 0x1FFFFFFF), st.just(b""), st.just(FLAG_REMOTE | FLAG_EXTENDED), st.integers(0, 15)
    ),
)


@pytest.mark.parametrize(("can_id", "data", "crc", "length"), VECTORS)
def test_vectors_have_the_known_crc_and_length(can_id: int, data: str, crc: int, length: int) -> None:
    """Wire rules: five frames, CRC and stuffed bits SOF..CRC."""
    frame = Frame(can_id, bytes.fromhex(data))
    assert len(wire_bits(frame)) == length
    assert int("".join(map(str, unstuffed_bits(frame)[-15:])), 2) == crc


def test_sync_frame_is_on_the_wire_as_in_the_standard_s_rules() -> None:
    """080 without data, bit by bit."""
    assert "".join(map(str, wire_bits(Frame(0x080, b"")))) == "00001000001000001000001011100000100101"


@given(frame=FRAMES)
def test_frame_comes_back_from_its_bits(frame: Frame) -> None:
    """Codec round trip; `bits` counts the same bits by its tables."""
    bits = unstuffed_bits(frame)
    assert frame_of(int("".join(map(str, bits)), 2), len(bits)) == frame
    assert len(wire_bits(frame)) + 13 == frame.measure()


@given(frame=FRAMES)
def test_receiver_takes_the_frame_that_was_sent(frame: Frame) -> None:
    """The receiving controller, fed with the bits of the sender, accepts the frame at the last but one bit of EOF."""
    receiver = Controller([1], 0, 0)
    bits = [*wire_bits(frame), 1, 0, 1, *[1] * 7, *[1] * 3]
    driven = []
    for at, bit in enumerate(bits):
        driven.append(receiver.out)
        receiver.step(at, bit)
    assert receiver.accepted == frame
    assert receiver.accepted_at == len(bits) - 5
    assert [at for at, bit in enumerate(driven) if bit == 0] == [len(bits) - 12]  # it drives the ACK slot only


@given(frame=FRAMES)
def test_fields_cover_the_frame_once(frame: Frame) -> None:
    """Every bit but stuff bits belongs to one field, in order."""
    places = [at for field in FIELDS for at in field_positions(frame, field)]
    assert places == sorted(set(places))
    assert len(places) == len(unstuffed_bits(frame)) + 10
    assert [len(field_positions(frame, field)) for field in ("sof", "rtr", "crc", "eof")] == [1, 1, 15, 7]
    assert len(field_positions(frame, "data")) == 8 * len(frame.data)
