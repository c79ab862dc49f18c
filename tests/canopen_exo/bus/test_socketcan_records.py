"""The kernel's records of frames, and what is said of interfaces that are not there."""

import errno
import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from canopen_exo.bus.adapter import to_message
from canopen_exo.bus.frame import FLAG_BRS, FLAG_ESI, FLAG_EXTENDED, FLAG_FD, FLAG_REMOTE, Frame
from canopen_exo.bus.socketcan import (
    CLASSICAL_SIZE,
    FD_SIZE,
    decode,
    encode,
    interface_error,
    open_can_socket,
)
from tests.canopen_exo.bus.can_records import frames, linux


@given(frames())
def test_every_kind_of_frame_survives_the_round_trip(frame: Frame) -> None:
    """Extended, remote, FD, raw DLC (len8_dlc): all kinds pass unchanged."""
    record = encode(frame)
    assert len(record) == (FD_SIZE if frame.flags & FLAG_FD else CLASSICAL_SIZE)
    assert decode(record) == frame


@linux
@given(frames(raw_dlc=False))
def test_records_are_those_of_python_can(frame: Frame) -> None:
    """Compared with an implementation of the kernel's structures that is not ours."""
    from can.interfaces.socketcan.socketcan import build_can_frame

    theirs = build_can_frame(to_message(frame))
    assert decode(theirs) == frame
    ours = encode(frame)  # byte 7, len8_dlc, means something from 9 on; python-can puts smaller lengths there too
    assert (ours[:7], ours[8:]) == (theirs[:7], theirs[8:])


@pytest.mark.parametrize(
    ("frame", "record"),
    [
        (Frame(0x123, b"\xaa"), struct.pack("=I4B8s", 0x123, 1, 0, 0, 0, b"\xaa")),
        (Frame(0x123, bytes(8), 0, 15), struct.pack("=I4B8s", 0x123, 8, 0, 0, 15, b"")),
        (Frame(1, b"", FLAG_REMOTE, 4), struct.pack("=I4B8s", 0x40000001, 4, 0, 0, 0, b"")),
        (Frame(1, b"", FLAG_REMOTE, 9), struct.pack("=I4B8s", 0x40000001, 8, 0, 0, 9, b"")),
        (Frame(1, b"", FLAG_EXTENDED), struct.pack("=I4B8s", 0x80000001, 0, 0, 0, 0, b"")),
        (Frame(1, b"\1", FLAG_FD | FLAG_BRS | FLAG_ESI), struct.pack("=I4B64s", 1, 1, 7, 0, 0, b"\1")),
    ],
)
def test_record_is_the_kernels_structure(frame: Frame, record: bytes) -> None:
    """linux/can.h: can_frame (id, len, pad, reserved, len8_dlc, data), canfd_frame (id, len, flags, ...)."""
    assert encode(frame) == record
    assert decode(record) == frame


@given(st.one_of(st.binary(max_size=80), st.binary(min_size=16, max_size=16), st.binary(min_size=72, max_size=72)))
def test_any_bytes_give_a_frame_or_none(record: bytes) -> None:
    """What comes from the kernel never raises; a frame that comes out can be sent."""
    frame = decode(record)
    if frame is not None:
        assert decode(encode(frame)) == frame


@pytest.mark.parametrize("length", [9, 64, 255])
def test_classical_record_longer_than_8_bytes_is_refused(length: int) -> None:
    """A length that the structure cannot hold is no frame."""
    assert decode(struct.pack("=I4B8s", 0x123, length, 0, 0, 0, b"")) is None


@pytest.mark.parametrize(("given_length", "length"), [(8, 8), (9, 12), (13, 16), (33, 48), (49, 64), (64, 64)])
def test_fd_length_between_two_codes_is_padded(given_length: int, length: int) -> None:
    """ISO 11898-1: lengths above 8 are 12, 16, 20, 24, 32, 48 and 64."""
    frame = decode(struct.pack("=I4B64s", 0x123, given_length, 4, 0, 0, b"\xff" * given_length))
    assert frame is not None
    assert frame.data == b"\xff" * given_length + bytes(length - given_length)


def test_error_frame_is_no_frame() -> None:
    """Error frames become notices, they are never forwarded."""
    assert decode(struct.pack("=I4B8s", 0x20000004, 8, 0, 0, 0, b"")) is None


@pytest.mark.parametrize(
    ("code", "interface", "words"),
    [
        (errno.EAFNOSUPPORT, "vcan0", ("no SocketCAN", "modprobe can-raw", "hub:")),
        (errno.ENODEV, "vcan0", ("no CAN interface 'vcan0'", "ip link add dev vcan0 type vcan", "set vcan0 up")),
        (errno.ENODEV, "can1", ("no CAN interface 'can1'", "type can bitrate", "ip link set can1 up")),
        (errno.EPERM, "can0", ("no right", "run as root")),
        (errno.EINVAL, "can0", ("cannot be opened",)),
    ],
)
def test_what_is_missing_is_said_in_one_line_with_the_remedy(code: int, interface: str, words: tuple[str, ...]) -> None:
    """Without SocketCAN rights: one line saying what to run."""
    message = str(interface_error(f"socketcan:{interface}", interface, OSError(code, "reason")))
    assert "\n" not in message
    assert message.startswith(f"bus socketcan:{interface}: ")
    for word in words:
        assert word in message


def test_missing_interface_is_an_os_error() -> None:
    """Here either AF_CAN is missing or the interface is: `interface_error` tells which."""
    with pytest.raises(OSError, match=r"."):
        open_can_socket("no_such_can")
