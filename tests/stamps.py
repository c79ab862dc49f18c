"""Both clocks of a machine as a test sets them; and kernel time stamps.

Those are a condition to wait for: the kernel begins to stamp a moment after it was first asked to, until then it stamps
when a message is read (net/core/dev.c, net_enable_timestamp: switched on by a work queue).
"""

import socket
import struct
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Final

from canopen_exo.bus.node import SECOND

_SO_TIMESTAMPNS: Final = 35
_TIME: Final = struct.Struct("@ll")
_LIMIT_S: Final = 20.0


class FakeTime:
    """Stands in for the module `time`: both clocks of the machine, ns."""

    def __init__(self, monotonic: int = 1000 * SECOND) -> None:
        self.monotonic = monotonic
        self.wall = 1_700_000_000 * SECOND

    def monotonic_ns(self) -> int:
        return self.monotonic

    def time_ns(self) -> int:
        return self.wall

    def pass_by(self, span_ns: int) -> None:
        self.monotonic += span_ns
        self.wall += span_ns


@contextmanager
def kernel_stamps() -> Iterator[None]:
    """While this lasts, the kernel stamps whatever comes in when it comes in, for every socket of the machine."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as receiver:
        receiver.bind(("127.0.0.1", 0))
        receiver.settimeout(_LIMIT_S)
        receiver.setsockopt(socket.SOL_SOCKET, _SO_TIMESTAMPNS, 1)
        limit = time.monotonic() + _LIMIT_S
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
            sender.connect(receiver.getsockname())
            while not _stamped_on_arrival(sender, receiver):
                assert time.monotonic() < limit, f"the kernel stamps nothing on arrival after {_LIMIT_S} s"
        yield


def _stamped_on_arrival(sender: socket.socket, receiver: socket.socket) -> bool:
    """Whether a message has a stamp from before it was read."""
    sender.send(b"?")
    between_ns = time.time_ns()
    _, ancillary, _, _ = receiver.recvmsg(1, 64)
    for _, kind, content in ancillary:
        if kind == _SO_TIMESTAMPNS:
            seconds, nanos = _TIME.unpack_from(content)
            return bool(seconds * 1_000_000_000 + nanos < between_ns)
    return False
