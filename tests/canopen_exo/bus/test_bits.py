"""Wire length and CRC of classical frames, against the vectors of the standard's rules and a naive reference."""

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from canopen_exo.bus.bits import UNSTUFFED_TAIL, crc15, frame_bits, header_bits

VECTORS = [
    (0x123, "1122334455667788", 0x4237, 99),
    (0x181, "0000000000000000", 0x4D06, 113),
    (0x7FF, "FFFFFFFFFFFFFFFF", 0x4C89, 113),
    (0x000, "", 0x0000, 40),
    (0x080, "", 0x1C05, 38),
]
"""Base data frames: id, data, CRC, bits SOF..CRC with stuff bits."""

STUFFED_080 = "00001000001000001000001011100000100101"
"""SOF..CRC of the empty frame 080, as it is on the wire."""

TAIL = 1 + 1 + 1 + 7 + 3
"""CRC delimiter, ACK slot, ACK delimiter, end of frame, intermission."""

RUNS = st.sampled_from(b"\x00\xff\x0f\xf0\x1f\xf8\x07\xe0\x83\x7c\x3e\xc1\x55\xaa\x21\xde")
"""Bytes that make, end or just miss runs of five."""

PAYLOADS = st.one_of(st.binary(max_size=8), st.lists(RUNS, max_size=8).map(bytes))


# --- the reference: one character a bit, one rule a line ---------------------------------------------------------


def unstuffed(can_id: int, data: bytes, extended: bool, remote: bool, dlc: int) -> str:
    """SOF to the last data bit."""
    if extended:
        head = "0" + f"{can_id >> 18:011b}" + "11" + f"{can_id & 0x3FFFF:018b}" + f"{remote:b}" + "00"
    else:
        head = "0" + f"{can_id:011b}" + f"{remote:b}" + "00"
    return head + f"{dlc:04b}" + "".join(f"{byte:08b}" for byte in data)


def remainder(bits: str) -> int:
    """The CRC as polynomial division: bits x^15 modulo x^15 + x^14 + x^10 + x^8 + x^7 + x^4 + x^3 + 1."""
    divisor = sum(1 << power for power in (15, 14, 10, 8, 7, 4, 3, 0))
    rest = int(bits, 2) << 15
    while rest.bit_length() > 15:
        rest ^= divisor << (rest.bit_length() - 16)
    return rest


def stuffed(bits: str) -> str:
    """After five equal bits the complement; it counts as the first bit of the next run."""
    wire = ""
    for bit in bits:
        wire += bit
        if wire.endswith(("00000", "11111")):
            run = len(wire) - len(wire.rstrip(bit))
            if run == 5:
                wire += "1" if bit == "0" else "0"
    return wire


def reference_wire(can_id: int, data: bytes, extended: bool, remote: bool, dlc: int) -> str:
    bits = unstuffed(can_id, data, extended, remote, dlc)
    return stuffed(bits + f"{remainder(bits):015b}")


# --- vectors -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("can_id", "data", "crc", "length"), VECTORS)
def test_vectors_have_the_known_crc_and_length(can_id: int, data: str, crc: int, length: int) -> None:
    """Bosch CAN 2.0B, 3.1.1: CRC and stuffed bits SOF..CRC of five frames."""
    payload = bytes.fromhex(data)
    assert crc15(header_bits(can_id, False, False, len(payload)), payload) == crc
    assert frame_bits(can_id, payload, False, False, len(payload)) == length + TAIL


@pytest.mark.parametrize(("can_id", "data", "crc", "length"), VECTORS)
def test_reference_agrees_with_the_vectors(can_id: int, data: str, crc: int, length: int) -> None:
    """The reference below every other test here is right itself."""
    payload = bytes.fromhex(data)
    assert remainder(unstuffed(can_id, payload, False, False, len(payload))) == crc
    assert len(reference_wire(can_id, payload, False, False, len(payload))) == length


def test_reference_gives_the_known_bits_of_080() -> None:
    """The vector with its bits written out."""
    assert reference_wire(0x080, b"", False, False, 0) == STUFFED_080


def test_tail_is_thirteen_bits() -> None:
    """ISO 11898-1: what follows the CRC is never stuffed."""
    assert UNSTUFFED_TAIL == TAIL


# --- against the reference ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("remote", [False, True])
def test_every_base_id_without_data_has_the_reference_length(remote: bool) -> None:
    """All 2048 ids: the run that begins with SOF, and stuffing up to the last CRC bit."""
    for can_id in range(2048):
        expected = len(reference_wire(can_id, b"", False, remote, 0)) + TAIL
        assert frame_bits(can_id, b"", False, remote, 0) == expected, hex(can_id)


@pytest.mark.parametrize("can_id", [0x000, 0x07F, 0x080, 0x181, 0x70F, 0x7FF])
def test_every_single_byte_has_the_reference_length(can_id: int) -> None:
    """All 256 bytes: the run over the border of DLC and data, data and CRC."""
    for value in range(256):
        data = bytes((value,))
        expected = len(reference_wire(can_id, data, False, False, 1)) + TAIL
        assert frame_bits(can_id, data, False, False, 1) == expected, hex(value)


def test_a_run_may_end_with_the_last_crc_bit() -> None:
    """ISO 11898-1: also after the last CRC bit a stuff bit follows; such frames exist and are measured right."""
    found = 0
    for can_id in range(2048):
        bits = unstuffed(can_id, b"", False, False, 0)
        whole = bits + f"{remainder(bits):015b}"
        if len(stuffed(whole)) > len(stuffed(whole[:-1])) + 1:
            found += 1
            assert frame_bits(can_id, b"", False, False, 0) == len(stuffed(whole)) + TAIL
    assert found > 0


@pytest.mark.long
@settings(max_examples=400)
@given(can_id=st.integers(0, 0x7FF), data=PAYLOADS)
def test_base_data_frame_has_the_reference_crc_and_length(can_id: int, data: bytes) -> None:
    """ISO 11898-1: base format, 0..8 data bytes."""
    bits = unstuffed(can_id, data, False, False, len(data))
    assert crc15(header_bits(can_id, False, False, len(data)), data) == remainder(bits)
    expected = len(reference_wire(can_id, data, False, False, len(data))) + TAIL
    assert frame_bits(can_id, data, False, False, len(data)) == expected


@given(
    can_id=st.one_of(
        st.integers(0, 0x1FFFFFFF), st.sampled_from([0, 1, 0x3FFFF, 0x40000, 0x7C0000, 0x1FFC0000, 0x1FFFFFFF])
    ),
    data=PAYLOADS,
)
def test_extended_data_frame_has_the_reference_crc_and_length(can_id: int, data: bytes) -> None:
    """ISO 11898-1: extended format, SRR and IDE recessive, r1 and r0 dominant."""
    bits = unstuffed(can_id, data, True, False, len(data))
    assert header_bits(can_id, True, False, len(data)) << 8 * len(data) | int.from_bytes(data, "big") == int(bits, 2)
    assert crc15(header_bits(can_id, True, False, len(data)), data) == remainder(bits)
    expected = len(reference_wire(can_id, data, True, False, len(data))) + TAIL
    assert frame_bits(can_id, data, True, False, len(data)) == expected


@given(extended=st.booleans(), can_id=st.integers(0, 0x1FFFFFFF), dlc=st.integers(0, 15))
def test_remote_frame_has_the_reference_length(extended: bool, can_id: int, dlc: int) -> None:
    """ISO 11898-1: a remote frame has no data whatever its DLC."""
    can_id = can_id if extended else can_id & 0x7FF
    expected = len(reference_wire(can_id, b"", extended, True, dlc)) + TAIL
    assert frame_bits(can_id, b"", extended, True, dlc) == expected


@given(can_id=st.integers(0, 0x7FF), data=st.binary(min_size=8, max_size=8), dlc=st.integers(8, 15))
def test_dlc_above_eight_counts_as_sent(can_id: int, data: bytes, dlc: int) -> None:
    """ISO 11898-1: DLC 9..15 mean 8 data bytes, and enter CRC and stuffing as they are."""
    expected = len(reference_wire(can_id, data, False, False, dlc)) + TAIL
    assert frame_bits(can_id, data, False, False, dlc) == expected


# --- bounds ------------------------------------------------------------------------------------------------------


@given(can_id=st.integers(0, 0x7FF), data=PAYLOADS)
def test_base_frame_length_is_within_the_bounds(can_id: int, data: bytes) -> None:
    """47 + 8n bits without stuffing, at most 55 + 10n: one stuff bit per four of the 34 + 8n after the first."""
    size = len(data)
    assert 47 + 8 * size <= frame_bits(can_id, data, False, False, size) <= 55 + 10 * size


@given(can_id=st.integers(0, 0x1FFFFFFF), data=PAYLOADS)
def test_extended_frame_length_is_within_the_bounds(can_id: int, data: bytes) -> None:
    """20 more bits are stuffable than in the base format: 67 + 8n to 67 + 8n + (54 + 8n - 1) / 4."""
    size = len(data)
    assert 67 + 8 * size <= frame_bits(can_id, data, True, False, size) <= 80 + 10 * size


@pytest.mark.parametrize("size", range(9))
def test_shortest_base_frame_exists(size: int) -> None:
    """47 + 8n is reached from 4 bytes on; below, RTR, IDE, r0 and the DLC are five zeros: one stuff bit at least."""
    shortest = min(frame_bits(can_id, b"\x55" * size, False, False, size) for can_id in range(2048))
    assert shortest == 47 + 8 * size + (size < 4)
