"""The hub's records: the byte table of docs/hub.md, and that nothing else passes for one."""

import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from canopen_exo.bus.frame import FLAG_BRS, FLAG_ESI, FLAG_EXTENDED, FLAG_FD, FLAG_REMOTE, Frame
from canopen_exo.bus.hub_wire import (
    FD_LENGTH,
    FLAG_ERROR,
    FLAG_OWN,
    KIND_FD_FRAME,
    KIND_FRAME,
    KIND_HELLO,
    KIND_OVERRUN,
    KIND_REFUSED,
    LONG,
    LOST_RECEIVING,
    OPTION_CONFIRM,
    OPTION_OWN,
    RECORD_SIZE,
    SHORT,
    TEXT,
    HubRecordError,
    Welcome,
    frame_fault,
    pack_count,
    pack_frame,
    pack_hello,
    pack_record,
    pack_text,
    split_address,
    split_channel,
    unpack_frame,
    unpack_hello,
    unpack_record,
    unpack_text,
    unpack_welcome,
)
from canopen_exo.errors import CanopenExoError

BASE_IDS = st.integers(0, 0x7FF)
LONG_IDS = st.integers(0, 0x1FFFFFFF)
FD_DATA = st.sampled_from(FD_LENGTH).flatmap(lambda size: st.binary(min_size=size, max_size=size))
FRAMES = st.one_of(
    st.builds(Frame, BASE_IDS, st.binary(max_size=8)),
    st.builds(Frame, LONG_IDS, st.binary(max_size=8), st.just(FLAG_EXTENDED)),
    st.builds(Frame, BASE_IDS, st.just(b""), st.just(FLAG_REMOTE), st.integers(0, 15)),
    st.builds(Frame, LONG_IDS, st.just(b""), st.just(FLAG_REMOTE | FLAG_EXTENDED), st.integers(0, 15)),
    st.builds(Frame, BASE_IDS, st.binary(min_size=8, max_size=8), st.just(0), st.integers(9, 15)),
    st.builds(Frame, BASE_IDS, FD_DATA, st.sampled_from([FLAG_FD, FLAG_FD | FLAG_BRS, FLAG_FD | FLAG_BRS | FLAG_ESI])),
    st.builds(Frame, LONG_IDS, FD_DATA, st.just(FLAG_FD | FLAG_EXTENDED)),
)


@given(FRAMES, st.integers(0, 1 << 62))
def test_every_kind_of_frame_survives_the_record(frame: Frame, stamp: int) -> None:
    """docs/hub.md: a frame record carries base, extended, remote and FD frames, and the raw DLC."""
    record = pack_frame(frame, stamp)
    assert len(record) == RECORD_SIZE[record[0]]
    assert frame_fault(record, 0) == ""
    assert unpack_frame(record, 0) == frame
    assert unpack_record(record, 0) == (frame.can_id, frame.flags, frame.dlc, frame.data, stamp)


def test_record_lies_as_the_byte_table_says() -> None:
    """docs/hub.md: kind, flags, DLC, size, id u32, stamp i64, payload and zeros."""
    record = pack_frame(Frame(0x12345678, b"\xaa\xbb\xcc", FLAG_EXTENDED), 0x0102030405060708)
    assert record.hex(" ") == "01 01 03 03 78 56 34 12 08 07 06 05 04 03 02 01 aa bb cc 00 00 00 00 00"


def test_fd_record_lies_as_the_byte_table_says() -> None:
    """docs/hub.md: the same head, 64 bytes of payload."""
    record = pack_frame(Frame(0x7FF, bytes(range(12)), FLAG_FD | FLAG_BRS), 1)
    assert record[:28].hex(" ") == "02 0c 09 0c ff 07 00 00 01 00 00 00 00 00 00 00 " + bytes(range(12)).hex(" ")
    assert record[28:] == bytes(52)


@pytest.mark.parametrize("flags", [FLAG_ERROR, FLAG_ERROR | FLAG_EXTENDED])
def test_error_frame_is_a_record(flags: int) -> None:
    """linux/can/error.h: the id holds classes beyond 11 bits."""
    record = pack_record(0x1FFFFFFF, flags, 8, bytes(8))
    assert frame_fault(record, 0) == ""


def test_own_frame_comes_from_the_hub_only() -> None:
    """docs/hub.md: flag 0x40 is set by the hub; a client that sets it is refused."""
    record = pack_record(0x100, FLAG_OWN, 1, b"\x01")
    assert frame_fault(record, 0, from_hub=True) == ""
    assert "flags 0x40" in frame_fault(record, 0)
    assert unpack_frame(record, 0) == Frame(0x100, b"\x01")


def head(kind: int, flags: int, dlc: int, size: int, can_id: int, data: bytes = b"") -> bytes:
    """A record with anything in its head."""
    return struct.pack("<BBBBIq", kind, flags, dlc, size, can_id, 0) + data.ljust(64, b"\0")


@pytest.mark.parametrize(
    ("record", "words"),
    [
        (head(KIND_FRAME, 0, 0, 0, 0x800), "CAN id 0x800 given, allowed 0..0x7ff"),
        (head(KIND_FRAME, FLAG_EXTENDED, 0, 0, 0x20000000), "CAN id 0x20000000 given, allowed 0..0x1fffffff"),
        (head(KIND_FRAME, 0, 0, 0, 0xFFFFFFFF), "CAN id 0xffffffff given"),
        (head(KIND_FRAME, 0, 16, 8, 1), "DLC 16"),
        (head(KIND_FRAME, 0, 8, 9, 1), "9 data bytes"),
        (head(KIND_FRAME, 0, 3, 2, 1), "DLC 3 and 2 data bytes"),
        (head(KIND_FRAME, 0, 9, 9, 1), "DLC 9 and 9 data bytes"),
        (head(KIND_FRAME, FLAG_REMOTE, 2, 2, 1), "flags 0x02, DLC 2 and 2 data bytes"),
        (head(KIND_FRAME, FLAG_REMOTE | FLAG_ERROR, 0, 0, 1), "flags 0x22"),
        (head(KIND_FRAME, FLAG_FD, 1, 1, 1), "flags 0x04"),
        (head(KIND_FRAME, FLAG_BRS, 1, 1, 1), "flags 0x08"),
        (head(KIND_FRAME, 0x80, 1, 1, 1), "flags 0x80"),
        (head(KIND_FD_FRAME, 0, 1, 1, 1), "flags 0x00"),
        (head(KIND_FD_FRAME, FLAG_FD, 9, 8, 1), "DLC 9 and 8 data bytes"),
        (head(KIND_FD_FRAME, FLAG_FD, 15, 65, 1), "65 data bytes"),
        (head(KIND_FD_FRAME, FLAG_FD | FLAG_REMOTE, 0, 0, 1), "flags 0x06"),
        (head(KIND_FRAME, 0, 2, 2, 1, b"\1\2\3"), "unused payload bytes after the first 2 are not zero"),
        (head(KIND_FD_FRAME, FLAG_FD, 0, 0, 1, bytes(63) + b"\1"), "unused payload bytes after the first 0"),
        (head(KIND_OVERRUN, 1, 0, 0, 1), "kind 4 given"),
        (head(0, 0, 0, 0, 0), "kind 0 given"),
        (head(255, 0, 0, 0, 0), "kind 255 given"),
    ],
)
def test_record_that_is_no_frame_is_named(record: bytes, words: str) -> None:
    """A corrupt record is refused, and the client is told why."""
    assert words in frame_fault(record, 0)


@given(st.binary(min_size=LONG, max_size=LONG), st.sampled_from([0, KIND_FRAME, KIND_FD_FRAME]), st.booleans())
def test_any_bytes_are_a_frame_or_a_fault(data: bytes, kind: int, from_hub: bool) -> None:
    """What passes the check can be made a frame without an exception."""
    if kind:
        data = bytes((kind,)) + data[1:]
    if frame_fault(data, 0, from_hub) == "" and not data[1] & FLAG_ERROR:
        frame = unpack_frame(data, 0)
        size = RECORD_SIZE[data[0]]
        assert pack_frame(frame)[16:] == data[16:size]


@pytest.mark.parametrize("options", [0, OPTION_OWN, OPTION_CONFIRM, OPTION_OWN | OPTION_CONFIRM])
@pytest.mark.parametrize("name", ["d", "drive", "can0", "A.b-c_9", "x" * 32])
def test_hello_survives(name: str, options: int) -> None:
    """docs/hub.md: the hello names bus and options."""
    assert unpack_hello(pack_hello(name, options)) == (name, options)


@pytest.mark.parametrize("name", ["", "x" * 33, "a b", "a/b", "a\0b", "é", "²", "drive\n", "::", "\ud800"])
def test_bus_name_of_other_letters_is_refused(name: str) -> None:
    """A bus name stands in channel strings, messages and logs."""
    with pytest.raises(HubRecordError, match="bus name"):
        pack_hello(name, 0)


@pytest.mark.parametrize(
    ("at", "value", "words"),
    [
        (0, b"G", "no hello of an exo-hil hub client: starts with 47 00 00 3c"),
        (16, b"e", "no hello"),
        (24, b"\x02", "version 2 of the protocol given, this hub speaks 1"),
        (26, b"\x04", "options 0x0004 given"),
        (28, bytes(48), "bus name ''"),
        (28, b"a\0b" + bytes(45), "bus name"),
        (28, b"\xff" * 48, "bus name"),
    ],
)
def test_hello_that_is_none_is_named(at: int, value: bytes, words: str) -> None:
    """What is not understood is refused with the reason, not guessed."""
    hello = bytearray(pack_hello("drive", 0))
    hello[at : at + len(value)] = value
    with pytest.raises(HubRecordError) as error:
        unpack_hello(bytes(hello))
    assert words in str(error.value)


@given(st.binary(min_size=LONG, max_size=LONG), st.booleans())
def test_any_bytes_are_a_hello_or_an_error(data: bytes, is_close: bool) -> None:
    """No other exception, whatever comes."""
    if is_close:
        data = pack_hello("drive", 0)[:24] + data[24:]
    try:
        name, _ = unpack_hello(data)
    except HubRecordError:
        return
    assert 0 < len(name) <= 32


def test_welcome_survives() -> None:
    """docs/hub.md: bit rate and both clocks of the hub."""
    record = Welcome(500_000, 123_456_789, 1_700_000_000_123_456_789).pack()
    welcome = unpack_welcome(record)
    assert len(record) == LONG
    assert (welcome.bitrate, welcome.monotonic_ns) == (500_000, 123_456_789)
    assert welcome.realtime_ns == 1_700_000_000_123_456_789


def test_answer_of_something_else_is_named() -> None:
    """A client on the wrong port says so."""
    with pytest.raises(HubRecordError, match="no exo-hil hub"):
        unpack_welcome(b"HTTP/1.1 400 Bad Request\r\n".ljust(LONG))
    later = bytearray(Welcome(0, 0, 0).pack())
    later[24] = 9
    with pytest.raises(HubRecordError, match="version 9"):
        unpack_welcome(bytes(later))


@pytest.mark.parametrize("text", ["", "why", "x" * 240, "x" * 241, "é" * 121, "x" * 239 + "é"])
def test_text_is_cut_between_letters(text: str) -> None:
    """docs/hub.md: at most 240 bytes of UTF-8."""
    record = pack_text(KIND_REFUSED, text)
    got = unpack_text(record, 0)
    assert len(record) == TEXT
    assert text.startswith(got)
    assert len(got.encode()) >= min(len(text.encode()), 239)


@pytest.mark.parametrize(("count", "told"), [(1, 1), (0xFFFFFFFF, 0xFFFFFFFF), (1 << 32, 0xFFFFFFFF)])
def test_count_is_told_as_u32(count: int, told: int) -> None:
    """A count beyond 32 bits is told as the highest, never as a small one."""
    record = pack_count(KIND_OVERRUN, LOST_RECEIVING, count)
    assert len(record) == SHORT
    assert unpack_record(record, 0)[:2] == (told, LOST_RECEIVING)


def test_kinds_have_the_sizes_of_the_table() -> None:
    """docs/hub.md: 24, 80 or 256 bytes; kind 0 and 9..255 are none."""
    assert RECORD_SIZE[:9] == [0, 24, 80, 24, 24, 256, 256, 80, 80]
    assert len(RECORD_SIZE) == 256
    assert not any(RECORD_SIZE[9:])
    assert len(pack_hello("drive", 0)) == RECORD_SIZE[KIND_HELLO]


@pytest.mark.parametrize(
    ("text", "address"),
    [
        ("127.0.0.1:29536", ("127.0.0.1", 29536)),
        ("localhost", ("localhost", 29536)),
        (":0", ("127.0.0.1", 0)),
        ("0", ("127.0.0.1", 0)),
        ("29540", ("127.0.0.1", 29540)),
        ("", ("127.0.0.1", 29536)),
        ("[::1]:5", ("::1", 5)),
        ("[::1]", ("::1", 29536)),
        ("0.0.0.0:65535", ("0.0.0.0", 65535)),
    ],
)
def test_address_is_split_with_the_defaults(text: str, address: tuple[str, int]) -> None:
    """The hub listens on loopback unless told otherwise."""
    assert split_address(text) == address


@pytest.mark.parametrize("text", ["localhost:x", "localhost:65536", "99999", "localhost:-1", "localhost:²"])
def test_port_that_is_none_is_refused(text: str) -> None:
    """The message has the value and what is allowed."""
    with pytest.raises(CanopenExoError, match=r"port '.*' given, allowed 0\.\.65535"):
        split_address(text)


@pytest.mark.parametrize(
    ("text", "parts"),
    [
        ("drive", ("127.0.0.1", 29536, "drive")),
        ("127.0.0.1:4000/drive", ("127.0.0.1", 4000, "drive")),
        ("host/can0", ("host", 29536, "can0")),
        ("[::1]:4000/can0", ("::1", 4000, "can0")),
    ],
)
def test_channel_is_address_and_bus(text: str, parts: tuple[str, int, str]) -> None:
    """`hub:NAME` is the default address, `hub:HOST:PORT/NAME` any."""
    assert split_channel(text) == parts


@pytest.mark.parametrize("text", ["", "127.0.0.1:4000", "host:1/", "a/b/c d"])
def test_channel_without_a_bus_name_is_refused(text: str) -> None:
    """The message says how a channel is written."""
    with pytest.raises(CanopenExoError, match="write NAME or HOST:PORT/NAME"):
        split_channel(text)
