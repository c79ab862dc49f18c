"""Signals and codecs, with cantools and the canopen package as readers that were not written here."""

import io
import math
import struct
from collections.abc import Sequence
from importlib import resources

import canopen
import pytest
from cantools.database.can import Message
from cantools.database.can import Signal as DbcSignal
from hypothesis import given
from hypothesis import strategies as st

from canopen_exo.errors import CanopenExoError
from canopen_exo.signal import Signal, compile_codec, read_bits, write_bits


def signal(start: int, length: int, signed: bool, scale: float = 1.0) -> Signal:
    return Signal("position", "right_knee", "right_knee_TPDO1", 0x185, start, length, signed, scale, "rad", 0x6064, 0)


def limits(length: int, signed: bool) -> tuple[int, int]:
    return (-(1 << (length - 1)), (1 << (length - 1)) - 1) if signed else (0, (1 << length) - 1)


@st.composite
def placed(draw: st.DrawFn) -> tuple[Signal, bytes]:
    """A signal and a payload that holds it."""
    length = draw(st.integers(1, 64))
    start = draw(st.integers(0, 64 - length))
    size = draw(st.integers((start + length + 7) // 8, 8))
    return signal(start, length, draw(st.booleans())), draw(st.binary(min_size=size, max_size=size))


@st.composite
def mappings(draw: st.DrawFn) -> tuple[list[tuple[int, bool]], list[int]]:
    """Mapped objects of up to 64 bits and a value for each."""
    fields: list[tuple[int, bool]] = []
    lengths = st.one_of(st.sampled_from([8, 16, 32, 64]), st.integers(1, 64))
    for length in draw(st.lists(lengths, max_size=8)):
        if sum(bits for bits, _ in fields) + length <= 64:
            fields.append((length, draw(st.booleans())))
    return fields, [draw(st.integers(*limits(length, signed))) for length, signed in fields]


def dbc_message(fields: Sequence[tuple[int, bool]], size: int) -> Message:
    """The mapping as cantools sees it."""
    at, signals = 0, []
    for number, (length, signed) in enumerate(fields):
        signals.append(DbcSignal(f"s{number}", at, length, "little_endian", signed))
        at += length
    return Message(0x181, "m", size, signals, strict=True)


# --- one signal --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("length", "signed", "low", "high"),
    [
        (1, False, 0, 1),
        (1, True, -1, 0),
        (8, False, 0, 255),
        (8, True, -128, 127),
        (16, True, -32768, 32767),
        (32, True, -(2**31), 2**31 - 1),
        (64, False, 0, 2**64 - 1),
        (64, True, -(2**63), 2**63 - 1),
    ],
)
def test_range_is_that_of_the_integer(length: int, signed: bool, low: int, high: int) -> None:
    """CiA 301, 7.1.4: UNSIGNEDn and INTEGERn, two's complement."""
    found = signal(0, length, signed)
    assert (found.low, found.high) == (low, high)


@given(where=placed(), data=st.data())
def test_value_written_is_the_value_read(where: tuple[Signal, bytes], data: st.DataObject) -> None:
    """Round trip, and every other bit of the payload keeps its value."""
    found, payload = where
    raw = data.draw(st.integers(found.low, found.high))
    written = found.write(payload, raw)
    assert found.read(written) == raw
    mask = ~(((1 << found.length) - 1) << found.start)
    assert int.from_bytes(written, "little") & mask == int.from_bytes(payload, "little") & mask
    assert len(written) == len(payload)


@given(where=placed())
def test_writing_back_what_was_read_changes_nothing(where: tuple[Signal, bytes]) -> None:
    """Round trip the other way, over any payload."""
    found, payload = where
    assert found.write(payload, found.read(payload)) == payload


@given(where=placed())
def test_signal_reads_what_cantools_reads(where: tuple[Signal, bytes]) -> None:
    """DBC little endian: start bit and length mean the same to both."""
    found, payload = where
    layout = [DbcSignal("s", found.start, found.length, "little_endian", found.signed)]
    decoded = Message(0x185, "m", len(payload), layout, strict=True).decode(payload)
    assert isinstance(decoded, dict)
    assert decoded["s"] == found.read(payload)


@pytest.mark.parametrize("beyond", [1, 2, 1 << 40])
@pytest.mark.parametrize(("length", "signed"), [(1, False), (7, True), (16, False), (16, True), (32, True)])
def test_value_out_of_range_saturates(length: int, signed: bool, beyond: int) -> None:
    """Module: raw values that do not fit saturate; nothing wraps."""
    found = signal(3, length, signed)
    assert found.read(found.write(bytes(8), found.high + beyond)) == found.high
    assert found.read(found.write(bytes(8), found.low - beyond)) == found.low


@pytest.mark.parametrize(("start", "length", "size"), [(0, 8, 1), (0, 9, 2), (7, 1, 1), (7, 2, 2), (32, 32, 8)])
def test_signal_fits_from_its_last_bit_on(start: int, length: int, size: int) -> None:
    """`fits`: a payload shorter by one byte does not hold it."""
    found = signal(start, length, False)
    assert found.fits(bytes(size))
    assert not found.fits(bytes(size - 1))


@pytest.mark.parametrize(
    ("value", "raw"),
    [(0.0, 0), (0.24, 0), (0.25, 1), (0.74, 1), (0.75, 2), (-0.24, 0), (-0.25, 0), (-0.26, -1), (-0.75, -1)],
)
def test_si_value_becomes_the_nearest_raw_integer(value: float, raw: int) -> None:
    """Half a unit is rounded up (design: floor(x + 0.5)); scale 0.5 is exact in binary."""
    assert signal(0, 16, True, 0.5).to_raw(value) == raw


def test_conversion_to_raw_does_not_saturate() -> None:
    """`low`..`high` tells whether it fits: a fault may want to know before it writes."""
    assert signal(0, 8, True, 0.5).to_raw(1000.0) == 2000


@given(raw=st.integers(-(2**31), 2**31 - 1))
def test_raw_survives_the_way_to_si_and_back(raw: int) -> None:
    """32-bit counts of a 17-bit encoder: a double has 53 bits, so no count is lost."""
    found = signal(0, 32, True, 2 * math.pi / 131072)
    assert found.to_raw(found.to_si(raw)) == raw


def test_first_mapped_object_is_at_the_lowest_bits() -> None:
    """CiA 301, 7.4.7: little endian; worked out by hand."""
    data = bytes.fromhex("0102030405060708")
    assert read_bits(data, 0, 8, False) == 0x01
    assert read_bits(data, 0, 32, False) == 0x04030201
    assert read_bits(data, 4, 8, False) == 0x20
    assert write_bits(bytes(8), 8, 16, -2) == bytes.fromhex("00feff0000000000")


# --- codecs ------------------------------------------------------------------------------------------------------


@given(mapping=mappings())
def test_codec_round_trip(mapping: tuple[list[tuple[int, bool]], list[int]]) -> None:
    """What is packed is unpacked; the payload is as long as the bits need."""
    fields, values = mapping
    codec = compile_codec(fields)
    data = codec.pack(values)
    assert codec.size == len(data) == (sum(length for length, _ in fields) + 7) // 8
    assert list(codec.unpack(data)) == values


@given(mapping=mappings())
def test_cantools_reads_what_the_codec_packs(mapping: tuple[list[tuple[int, bool]], list[int]]) -> None:
    """Any mapping, byte-aligned or not, signed or not."""
    fields, values = mapping
    codec = compile_codec(fields)
    decoded = dbc_message(fields, codec.size).decode(codec.pack(values))
    assert isinstance(decoded, dict)
    assert [decoded[f"s{number}"] for number in range(len(fields))] == values


@given(mapping=mappings(), extra=st.binary(max_size=8))
def test_codec_ignores_further_bytes(mapping: tuple[list[tuple[int, bool]], list[int]], extra: bytes) -> None:
    """CiA 301: a PDO that is too long is processed with its first bytes."""
    fields, values = mapping
    codec = compile_codec(fields)
    assert list(codec.unpack(codec.pack(values) + extra)) == values


ALIGNED = [
    [(8, False)],
    [(8, True), (8, False)],
    [(16, False), (16, True)],
    [(32, True), (32, True)],
    [(16, False), (16, True), (16, False)],
    [(8, False), (16, True), (32, False)],
    [(64, True)],
    [(64, False)],
]


@pytest.mark.long
@pytest.mark.parametrize("fields", ALIGNED)
@given(data=st.data())
def test_struct_and_bit_codec_agree(data: st.DataObject, fields: list[tuple[int, bool]]) -> None:
    """Two implementations of one layout: whole objects against the same ones cut into halves of half the bits."""
    values = [data.draw(st.integers(*limits(length, signed))) for length, signed in fields]
    halves: list[tuple[int, bool]] = []
    parts: list[int] = []
    for (length, signed), value in zip(fields, values, strict=True):
        low = length // 2 - 1  # odd sizes keep the second codec from being byte-aligned
        halves += [(low, False), (length - low, signed)]
        parts += [value & ((1 << low) - 1), value >> low]
    whole, cut = compile_codec(fields), compile_codec(halves)
    assert type(whole) is not type(cut)
    payload = whole.pack(values)
    assert cut.pack(parts) == payload
    assert list(cut.unpack(payload)) == parts


def test_mapping_without_objects_packs_nothing() -> None:
    """CiA 301: a PDO with 0 entries is legal."""
    codec = compile_codec([])
    assert (codec.size, codec.pack([]), codec.unpack(b"\1\2")) == (0, b"", ())


@pytest.mark.parametrize(("fields", "bits"), [([(64, False), (1, False)], 65), ([(32, True)] * 3, 96)])
def test_more_than_64_bits_are_refused(fields: list[tuple[int, bool]], bits: int) -> None:
    """CiA 301: a PDO has up to 8 bytes; the message says how many bits were given."""
    with pytest.raises(CanopenExoError, match=f"{bits} bits given, allowed 0..64"):
        compile_codec(fields)


def test_64_bits_are_taken() -> None:
    """The bound itself is allowed."""
    assert compile_codec([(1, False)] * 64).size == 8


def description() -> canopen.ObjectDictionary:
    source = io.StringIO(resources.files("dbc").joinpath("exo_joint.eds").read_text(encoding="ascii"))
    source.name = "exo_joint.eds"
    return canopen.import_od(source, 5)


DESCRIPTION = description()


OBJECTS = [(0x6041, 16, False), (0x6064, 32, True), (0x606C, 32, True), (0x6077, 16, True), (0x1001, 8, False)]
MAPPINGS = [(0,), (1, 2), (0, 3, 0), (4, 1, 3), (4, 4, 0, 2), (3, 1, 0)]


@pytest.mark.parametrize("chosen", MAPPINGS)
@given(data=st.data())
def test_canopen_package_reads_and_writes_the_same_payload(data: st.DataObject, chosen: tuple[int, ...]) -> None:
    """The PDO code of the canopen package as reader and as writer of byte-aligned mappings."""
    pdo = canopen.RemoteNode(5, DESCRIPTION).tpdo[1]
    pdo.clear()
    objects = [OBJECTS[at] for at in chosen]
    for index, _, _ in objects:
        pdo.add_variable(index)
    values = [data.draw(st.integers(*limits(length, signed))) for _, length, signed in objects]
    codec = compile_codec([(length, signed) for _, length, signed in objects])
    packed = codec.pack(values)
    pdo.data = bytearray(packed)
    assert [variable.raw for variable in pdo] == values
    pdo.data = bytearray(codec.size)
    for variable, value in zip(pdo, values, strict=True):
        variable.raw = value
    assert bytes(pdo.data) == packed


def test_default_tpdo_is_a_known_payload() -> None:
    """Bus plan: position i32 then velocity i32, little endian; worked out with struct."""
    assert compile_codec([(32, True), (32, True)]).pack([-1, 65536]) == struct.pack("<ii", -1, 65536)
