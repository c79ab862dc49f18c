"""The trace hash and the candump log, read back by python-can, which is not ours."""

import hashlib
import re
import struct
from pathlib import Path

import can
import pytest
from can.io.canutils import CanutilsLogReader
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from canopen_exo.bus.frame import FLAG_BRS, FLAG_ESI, FLAG_EXTENDED, FLAG_FD, FLAG_REMOTE, Frame
from canopen_exo.bus.medium import Transmission
from canopen_exo.bus.trace import candump_frame, trace_hash, write_candump
from canopen_exo.errors import CanopenExoError

FRAMES = {
    "base": (Frame(0x185, bytes.fromhex("0102030405060708")), "185#0102030405060708"),
    "lowest id, empty": (Frame(0, b""), "000#"),
    "highest base id": (Frame(0x7FF, b"\xff"), "7FF#FF"),
    "extended": (Frame(0x1ABCDEF0, b"\x0a", FLAG_EXTENDED), "1ABCDEF0#0A"),
    "extended, small id": (Frame(0x12, b"\x0a", FLAG_EXTENDED), "00000012#0A"),
    "remote without length": (Frame(0x701, b"", FLAG_REMOTE, 0), "701#R"),
    "remote": (Frame(0x701, b"", FLAG_REMOTE, 1), "701#R1"),
    "remote, raw DLC above 8": (Frame(0x701, b"", FLAG_REMOTE, 15), "701#R8"),
    "extended remote": (Frame(0x18FF, b"", FLAG_REMOTE | FLAG_EXTENDED, 8), "000018FF#R8"),
    "raw DLC above 8": (Frame(0x55, bytes(8), 0, 12), "055#0000000000000000"),
    "FD": (Frame(0x55, bytes(12), FLAG_FD), "055##0" + "00" * 12),
    "FD with flags": (Frame(0x55, b"\x01", FLAG_FD | FLAG_BRS | FLAG_ESI), "055##301"),
}


def read_back(path: Path) -> list[can.Message]:
    return list(CanutilsLogReader(path))


def frame_of(message: can.Message) -> Frame:
    """The Frame python-can understood; a raw DLC above 8 is not in the file."""
    flags = (
        (FLAG_EXTENDED if message.is_extended_id else 0)
        | (FLAG_REMOTE if message.is_remote_frame else 0)
        | (FLAG_FD if message.is_fd else 0)
        | (FLAG_BRS if message.bitrate_switch else 0)
        | (FLAG_ESI if message.error_state_indicator else 0)
    )
    return Frame(message.arbitration_id, bytes(message.data), flags, message.dlc if message.is_remote_frame else -1)


@pytest.mark.parametrize(("frame", "text"), FRAMES.values(), ids=FRAMES.keys())
def test_frame_is_written_in_compact_notation(frame: Frame, text: str) -> None:
    """can-utils: compact notation of base, extended, remote and FD frames."""
    assert candump_frame(frame) == text


def test_log_line_is_that_of_candump(tmp_path: Path) -> None:
    """can-utils, `candump -L`: ten digits of seconds, six of microseconds, channel, frame."""
    path = tmp_path / "controller.log"
    write_candump(path, [Transmission(12_003_950_999, 0, Frame(0x80, b"\x01"), 0)], 0, "controller")
    assert path.read_bytes() == b"(0000000012.003950) controller 080#01\n"


@pytest.mark.parametrize("frame", [frame for frame, _ in FRAMES.values()], ids=FRAMES.keys())
def test_python_can_reads_every_kind_of_frame_back(tmp_path: Path, frame: Frame) -> None:
    """A log can be replayed with python-can: id, kind, length and data survive."""
    path = tmp_path / "bus.log"
    write_candump(path, [Transmission(1_500_000_000, 0, frame, 0)], 0, "drive")
    (message,) = read_back(path)
    known = {"raw DLC above 8": Frame(0x55, bytes(8)), "remote, raw DLC above 8": Frame(0x701, b"", FLAG_REMOTE, 8)}
    name = next(name for name, (known_frame, _) in FRAMES.items() if known_frame is frame)
    assert frame_of(message) == known.get(name, frame)
    assert message.timestamp == 1.5
    assert message.channel == "drive"


@pytest.mark.long
@settings(max_examples=100, suppress_health_check=[HealthCheck.function_scoped_fixture], deadline=None)
@given(
    rows=st.lists(
        st.tuples(
            st.integers(0, 10**13),
            st.booleans(),
            st.one_of(
                st.builds(Frame, st.integers(0, 0x7FF), st.binary(max_size=8)),
                st.builds(Frame, st.integers(0, 0x1FFFFFFF), st.binary(max_size=8), st.just(FLAG_EXTENDED)),
                st.builds(Frame, st.integers(0, 0x7FF), st.just(b""), st.just(FLAG_REMOTE), st.integers(0, 8)),
                st.builds(Frame, st.integers(0, 0x7FF), st.binary(max_size=8), st.just(FLAG_FD)),
            ),
        ),
        max_size=8,
    )
)
def test_round_trip_keeps_order_and_times_of_one_bus(tmp_path: Path, rows: list[tuple[int, bool, Frame]]) -> None:
    """Only the rows of the bus asked for, in order, to the microsecond."""
    path = tmp_path / "bus.log"
    trace = [Transmission(time_ns, int(bus), frame, 0) for time_ns, bus, frame in rows]
    write_candump(path, trace, 1, "can1")
    wanted = [row for row in trace if row.bus == 1]
    messages = read_back(path)
    assert [frame_of(message) for message in messages] == [row.frame for row in wanted]
    # python-can holds the stamp as a float64: 1e4 s are exact to 2e-12 s, far below the microsecond kept
    assert [round(message.timestamp * 1e6) for message in messages] == [row.end_ns // 1000 for row in wanted]


def test_every_line_has_the_published_shape(tmp_path: Path) -> None:
    """No line of a log is anything but stamp, channel, frame."""
    path = tmp_path / "bus.log"
    write_candump(path, [Transmission(k, 0, frame, 0) for k, (frame, _) in enumerate(FRAMES.values())], 0, "can0")
    shape = re.compile(r"\(\d{10}\.\d{6}\) can0 ([0-9A-F]{3}|[0-9A-F]{8})#(R[1-8]?|#[0-3][0-9A-F]*|[0-9A-F]{0,16})")
    lines = path.read_text().splitlines()
    assert len(lines) == len(FRAMES)
    assert all(shape.fullmatch(line) for line in lines)


@pytest.mark.parametrize("name", ["", "two words", "tab\t"])
def test_channel_name_the_format_cannot_hold_is_refused(tmp_path: Path, name: str) -> None:
    """The columns of a log are separated by blanks."""
    with pytest.raises(CanopenExoError, match="channel name"):
        write_candump(tmp_path / "bus.log", [], 0, name)
    assert not (tmp_path / "bus.log").exists()


def test_hash_is_sha256_over_the_documented_bytes() -> None:
    """The hash can be worked out by anyone: little-endian i64, u8, u32, u8, u8, u8, data; rows in order."""
    rows = [
        Transmission(55_000, 0, Frame(0x80, b"\x01"), 3),
        Transmission(120_000, 1, Frame(0x1ABCDEF0, b"", FLAG_EXTENDED | FLAG_REMOTE, 4), 0),
    ]
    expected = struct.pack("<q", 55_000) + b"\x00" + b"\x80\x00\x00\x00" + b"\x00" + b"\x01" + b"\x01" + b"\x01"
    expected += struct.pack("<q", 120_000) + b"\x01" + b"\xf0\xde\xbc\x1a" + b"\x03" + b"\x04" + b"\x00"
    assert trace_hash(rows) == hashlib.sha256(expected).hexdigest()


def test_hash_of_nothing_is_that_of_no_bytes() -> None:
    """An empty trace has a hash too."""
    assert trace_hash([]) == hashlib.sha256(b"").hexdigest()


BASE = (1000, 0, 0x181, b"\x01\x02", 0, -1)


@pytest.mark.parametrize(
    "changed",
    [
        (1001, 0, 0x181, b"\x01\x02", 0, -1),
        (1000, 1, 0x181, b"\x01\x02", 0, -1),
        (1000, 0, 0x182, b"\x01\x02", 0, -1),
        (1000, 0, 0x181, b"\x01\x03", 0, -1),
        (1000, 0, 0x181, b"\x01\x02\x00", 0, -1),
        (1000, 0, 0x181, b"\x01\x02", FLAG_EXTENDED, -1),
        (1000, 0, 0x181, b"\x01\x02", FLAG_FD, -1),
    ],
    ids=["time", "bus", "id", "data", "length", "extended", "FD"],
)
def test_hash_sees_every_part_of_a_row(changed: tuple[int, int, int, bytes, int, int]) -> None:
    """Design: SHA-256 over time, bus, id, flags and data; any difference shows."""

    def row(parts: tuple[int, int, int, bytes, int, int]) -> Transmission:
        time_ns, bus, can_id, data, flags, dlc = parts
        return Transmission(time_ns, bus, Frame(can_id, data, flags, dlc), 0)

    assert trace_hash([row(BASE)]) != trace_hash([row(changed)])


def test_hash_sees_raw_dlc_and_order_but_not_the_sender() -> None:
    """Rows are hashed in loop order; who sent is known to the loop only."""
    first, second = Transmission(1, 0, Frame(1, bytes(8)), 0), Transmission(1, 0, Frame(2, b""), 0)
    assert trace_hash([first, second]) != trace_hash([second, first])
    assert trace_hash([Transmission(1, 0, Frame(1, bytes(8), 0, 9), 0)]) != trace_hash([first])
    assert trace_hash([Transmission(1, 0, Frame(1, bytes(8)), 5)]) == trace_hash([first])
