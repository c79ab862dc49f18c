"""Foreign software on the other side of a bus: python-can, can-utils, a bare socket; and the frames they exchange."""

import os
import select
import shutil
import subprocess
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final, final

import can
import pytest

from canopen_exo.bus.channel import Arrival, Channel
from canopen_exo.bus.frame import FLAG_BRS, FLAG_ESI, FLAG_EXTENDED, FLAG_FD, FLAG_REMOTE, Frame
from canopen_exo.bus.node import SECOND

LIMIT_S: Final = 20.0
"""For anything that should happen at once; only a test that fails waits that long."""


@final
@dataclass(frozen=True, slots=True)
class Kind:
    """A kind of frame as three programs write it: ours, cansend, python-can (keywords of can.Message)."""

    name: str
    frame: Frame
    text: str
    message: dict[str, object] = field(default_factory=dict)

    def of_python_can(self) -> can.Message:
        """What a user of python-can would send."""
        given: dict[str, object] = {"is_extended_id": False, "check": True, **self.message}
        return can.Message(**given)  # type: ignore[arg-type]


def _fd(length: int) -> bytes:
    return bytes(range(length))


EIGHT: Final = bytes.fromhex("0123456789ABCDEF")

KINDS: Final = (
    Kind("base-lowest", Frame(0, b""), "000#", {"arbitration_id": 0}),
    Kind("base-1-byte", Frame(0x181, b"\xa5"), "181#A5", {"arbitration_id": 0x181, "data": b"\xa5"}),
    Kind("base-highest", Frame(0x7FF, EIGHT), "7FF#0123456789ABCDEF", {"arbitration_id": 0x7FF, "data": EIGHT}),
    Kind("extended-lowest", Frame(0, b"\x01", FLAG_EXTENDED), "00000000#01",
         {"arbitration_id": 0, "is_extended_id": True, "data": b"\x01"}),
    Kind("extended-small", Frame(0x181, EIGHT, FLAG_EXTENDED), "00000181#0123456789ABCDEF",
         {"arbitration_id": 0x181, "is_extended_id": True, "data": EIGHT}),
    Kind("extended-highest", Frame(0x1FFFFFFF, b"", FLAG_EXTENDED), "1FFFFFFF#",
         {"arbitration_id": 0x1FFFFFFF, "is_extended_id": True}),
    Kind("remote-0", Frame(0x181, b"", FLAG_REMOTE, 0), "181#R", {"arbitration_id": 0x181, "is_remote_frame": True}),
    Kind("remote-8", Frame(0x701, b"", FLAG_REMOTE, 8), "701#R8",
         {"arbitration_id": 0x701, "is_remote_frame": True, "dlc": 8}),
    Kind("remote-extended", Frame(0x1ABCDEF0, b"", FLAG_REMOTE | FLAG_EXTENDED, 3), "1ABCDEF0#R3",
         {"arbitration_id": 0x1ABCDEF0, "is_extended_id": True, "is_remote_frame": True, "dlc": 3}),
    Kind("fd-empty", Frame(0x181, b"", FLAG_FD), "181##0", {"arbitration_id": 0x181, "is_fd": True}),
    Kind("fd-8", Frame(0x181, EIGHT, FLAG_FD), "181##00123456789ABCDEF",
         {"arbitration_id": 0x181, "is_fd": True, "data": EIGHT}),
    Kind("fd-12-brs", Frame(0x200, _fd(12), FLAG_FD | FLAG_BRS), "200##1" + _fd(12).hex().upper(),
         {"arbitration_id": 0x200, "is_fd": True, "bitrate_switch": True, "data": _fd(12)}),
    Kind("fd-48-esi", Frame(0x7FF, _fd(48), FLAG_FD | FLAG_ESI), "7FF##2" + _fd(48).hex().upper(),
         {"arbitration_id": 0x7FF, "is_fd": True, "error_state_indicator": True, "data": _fd(48)}),
    Kind("fd-64-extended-brs-esi", Frame(0x12345678, _fd(64), FLAG_FD | FLAG_BRS | FLAG_ESI | FLAG_EXTENDED),
         "12345678##3" + _fd(64).hex().upper(),
         {"arbitration_id": 0x12345678, "is_extended_id": True, "is_fd": True, "bitrate_switch": True,
          "error_state_indicator": True, "data": _fd(64)}),
)

RAW_DLC: Final = (
    *(Frame(0x100 + dlc, EIGHT, 0, dlc) for dlc in range(9, 16)),
    Frame(0x1ABCDEF0, EIGHT, FLAG_EXTENDED, 12),
    Frame(0x7F, b"", FLAG_REMOTE, 15),
)
"""Classical frames whose DLC on the wire is above 8; python-can and can-utils of 2020 do not know them."""

BUS_OFF: Final = (0x040, bytes(8))
PASSIVE: Final = (0x004, bytes((0, 0x20, 0, 0, 0, 0, 0, 0)))
RESTARTED: Final = (0x100, bytes(8))
"""Error frames as drivers make them (linux/can/error.h): class and data."""


def fields(message: can.Message) -> tuple[object, ...]:
    """What makes a frame, of a python-can message."""
    return (
        message.arbitration_id,
        message.is_extended_id,
        message.is_remote_frame,
        message.is_error_frame,
        message.is_fd,
        message.bitrate_switch,
        message.error_state_indicator,
        message.dlc,
        bytes(message.data),
    )


@contextmanager
def python_can(interface: str) -> Iterator[can.BusABC]:
    """A node made with python-can; large frames on."""
    with can.Bus(interface="socketcan", channel=interface, fd=True) as bus:
        yield bus


def next_message(bus: can.BusABC) -> can.Message:
    """The next one, which must come."""
    message = bus.recv(LIMIT_S)
    assert message is not None, f"nothing came in {LIMIT_S} s"
    return message


def send_error(bus: can.BusABC, error: tuple[int, bytes]) -> None:
    """An error frame, as if the controller of that interface had made it (the kernel passes it on as one)."""
    bus.send(can.Message(arbitration_id=error[0], is_extended_id=False, is_error_frame=True, data=error[1]))


def receive(channel: Channel, count: int) -> list[Arrival]:
    """What comes, until there are `count` arrivals; a channel's own wishes (poll_at) are met."""
    arrivals: list[Arrival] = []
    limit = time.monotonic() + LIMIT_S
    while len(arrivals) < count:
        assert time.monotonic() < limit, f"{count} arrivals wanted, in {LIMIT_S} s came {len(arrivals)}"
        fd = channel.fileno()
        due_s = max(0, channel.poll_at - (time.monotonic_ns() - channel.epoch_ns)) / SECOND
        select.select([] if fd < 0 else [fd], [], [], min(due_s, 0.05))
        arrivals += channel.receive()
    return arrivals


def frames(arrivals: list[Arrival]) -> list[Frame]:
    """The frames of arrivals that are all frames."""
    found = [arrival.frame for arrival in arrivals if arrival.frame is not None]
    assert len(found) == len(arrivals), [arrival.state and arrival.state.cause for arrival in arrivals]
    return found


def program(name: str) -> str:
    """A program of can-utils or iproute2; the test is skipped where it is missing."""
    path = shutil.which(name)
    if path is None:
        pytest.skip(f"{name} is not on PATH; install can-utils and iproute2")
    return path


def run(*command: str) -> None:
    """One of those programs, to its end."""
    done = subprocess.run([program(command[0]), *command[1:]], capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, f"{command}: {done.returncode}: {done.stdout}{done.stderr}"


@final
class Candump:
    """A running `candump -L` on one interface; `text` of frames is that of the kinds above."""

    def __init__(self, interface: str) -> None:
        self.interface: Final = interface
        self._rest = b""
        self._lines: Final[deque[bytes]] = deque()
        before = receivers(interface)
        # Many seconds of a full bus in the kernel's buffer: it may come to run late.
        command = [program("candump"), "-L", "-r", "8000000", interface]
        self._process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT)
        wait_until(lambda: receivers(interface) > before, f"candump listens on {interface}")

    def until(self, last: str) -> list[str]:
        """The frames up to the one that reads `last`, without it."""
        found: list[str] = []
        while True:
            stamp, interface, text = self._line().split(" ", 2)
            assert stamp.startswith("(")
            assert interface == self.interface
            text = plain(text)
            if text == last:
                return found
            found.append(text)

    def close(self) -> None:
        """End it."""
        self._process.kill()
        self._process.wait()
        assert self._process.stdout is not None
        self._process.stdout.close()

    def _line(self) -> str:
        assert self._process.stdout is not None
        fd = self._process.stdout.fileno()
        while not self._lines:
            assert select.select([fd], [], [], LIMIT_S)[0], f"candump on {self.interface}: nothing more came"
            data = os.read(fd, 1 << 16)
            assert data, f"candump on {self.interface} ended: {self._rest!r}"
            *lines, self._rest = (self._rest + data).split(b"\n")
            self._lines.extend(lines)
        return self._lines.popleft().decode()


def plain(text: str) -> str:
    """Frame text without the kernel's mark "this is CAN FD" (CANFD_FDF, since Linux 6.x), which `##` says already."""
    head, mark, rest = text.partition("##")
    return f"{head}##{int(rest[0], 16) & 3:X}{rest[1:]}" if mark else text


def receivers(interface: str) -> int:
    """How many sockets are listening for all frames of an interface."""
    lines = Path("/proc/net/can/rcvlist_all").read_text().splitlines()
    return sum(line.split()[0] == interface for line in lines if line.strip())


def wait_until(condition: Callable[[], bool], what: str, limit_s: float = LIMIT_S) -> None:
    """Until it is so; looks a hundred times a second."""
    limit = time.monotonic() + limit_s
    while not condition():
        assert time.monotonic() < limit, f"not so after {limit_s} s: {what}"
        select.select([], [], [], 0.01)
