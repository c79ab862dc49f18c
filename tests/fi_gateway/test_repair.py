"""Checksums and counters of an application, against published vectors and cantools."""

import pytest
from cantools.database import load_string
from cantools.database.can import Database
from hypothesis import given
from hypothesis import strategies as st

from canopen_exo.bus.frame import Frame
from fi_gateway.errors import FaultError
from fi_gateway.repair import Repair, crc8_j1850, xor_of

AUTOSAR: tuple[tuple[str, int], ...] = (
    ("00000000", 0x59),
    ("F20183", 0x37),
    ("0FAA0055", 0x79),
    ("00FF5511", 0xB8),
    ("332255AABBCCDDEEFF", 0xCB),
    ("926B55", 0x8C),
    ("FFFFFFFF", 0x74),
)
"""AUTOSAR, Specification of CRC Routines, 7.2.1.1 (8-bit SAE J1850): data and result."""


@pytest.mark.parametrize(("data", "value"), [*AUTOSAR, (b"123456789".hex(), 0x4B)])
def test_crc8_gives_the_published_values(data: str, value: int) -> None:
    """SAE J1850 by AUTOSAR's table, and the check value of the catalogues over 123456789."""
    assert crc8_j1850(bytes.fromhex(data)) == value


def divided(data: bytes) -> int:
    """Polynomial division, bit by bit, as the standard defines it: x^8 + x^4 + x^3 + x^2 + 1."""
    rest = 0xFF
    for byte in data:
        rest ^= byte
        for _ in range(8):
            rest <<= 1
            if rest & 0x100:
                rest ^= 0x11D
    return rest ^ 0xFF


@given(st.binary(max_size=12))
def test_crc8_by_table_is_the_division(data: bytes) -> None:
    """Every payload."""
    assert crc8_j1850(data) == divided(data)


def test_xor_is_that_of_all_bytes() -> None:
    """0 of nothing."""
    assert (xor_of(b""), xor_of(b"\x5a"), xor_of(b"\x01\x02\x04\x81")) == (0, 0x5A, 0x86)


ARRIVED = Frame(0x185, bytes.fromhex("1122334455663700"))
CHANGED = Frame(0x185, bytes.fromhex("1122334455660000"))


@pytest.mark.parametrize(
    ("repair", "expected"),
    [
        (Repair("xor", 7), "1122334455660077"),
        (Repair("xor", 0), "6622334455660000"),
        (Repair("xor", 7, b"\x12\x34"), "1122334455660051"),
        (Repair("crc8_j1850", 7), "11223344556600" + f"{divided(bytes.fromhex('11223344556600')):02X}"),
        (Repair("", counter_start=48, counter_length=4), "1122334455660700"),
        (Repair("xor", 7, counter_start=48, counter_length=4), "1122334455660770"),
    ],
)
def test_a_changed_payload_is_put_right(repair: Repair, expected: str) -> None:
    """The counter first, with which the frame arrived; then the checksum over all other bytes."""
    assert repair.frame(ARRIVED, CHANGED).data == bytes.fromhex(expected)


def test_a_counter_lies_where_a_dbc_has_it() -> None:
    """Bit numbers are those of a DBC, little endian: cantools reads back the counter that arrived."""
    text = 'VERSION ""\nBU_: A\nBO_ 389 m: 8 A\n SG_ counter : 52|4@1+ (1,0) [0|15] "" A\n'
    database = load_string(text, "dbc")
    assert isinstance(database, Database)
    result = Repair("xor", 7, counter_start=52, counter_length=4).frame(ARRIVED, CHANGED)
    decoded, arrived = (database.decode_message(389, frame.data) for frame in (result, ARRIVED))
    assert isinstance(decoded, dict)
    assert isinstance(arrived, dict)
    assert decoded["counter"] == arrived["counter"] == 3


@pytest.mark.parametrize("size", range(9))
def test_what_is_unchanged_or_too_short_stays(size: int) -> None:
    """A payload that is the same is not touched, even with a wrong checksum; nothing is written past the end."""
    repair = Repair("xor", 7, counter_start=48, counter_length=8)
    same = Frame(0x185, bytes(range(size)))
    assert repair.frame(same, same) is same
    other = repair.frame(same, Frame(0x185, bytes(size)))
    assert len(other.data) == size
    if size <= 6:
        assert other.data == bytes(size)


def test_a_raw_dlc_is_kept() -> None:
    """DLC 9..15 with 8 bytes."""
    result = Repair("xor", 7).frame(Frame(0x185, bytes(8), 0, 12), Frame(0x185, b"\x01" + bytes(7), 0, 12))
    assert (result.data, result.dlc) == (b"\x01" + bytes(6) + b"\x01", 12)


@pytest.mark.parametrize(
    "make",
    [
        lambda: Repair(),
        lambda: Repair("md5"),
        lambda: Repair("xor", 8),
        lambda: Repair("", counter_start=60, counter_length=5),
        lambda: Repair("xor", 1, counter_start=12, counter_length=4),
        lambda: Repair("xor", 1, counter_start=4, counter_length=8),
    ],
)
def test_a_repair_that_cannot_be_is_refused(make: type[Repair]) -> None:
    """Nothing to repair, unknown, outside the payload, one on the other."""
    with pytest.raises(FaultError, match=r"allowed|each needs"):
        make()
