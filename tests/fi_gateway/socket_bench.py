"""Records made by hand from linux/can.h, and a gateway between two interfaces made of socket pairs."""

import socket
import struct
import time
from collections.abc import Callable
from contextlib import AbstractContextManager
from typing import Final

from canopen_exo.bus.node import SECOND
from canopen_exo.bus.realtime import RealTimeLoop
from canopen_exo.bus.socketcan import SocketCanChannel
from fi_gateway.effects import Infinite
from fi_gateway.events import At
from fi_gateway.faults import BitFlip, Drop
from fi_gateway.gateway import Gateway
from fi_gateway.injector import Injector, Target, stream

EXTENDED, REMOTE, ERROR = 0x80000000, 0x40000000, 0x20000000
FDF, BRS, ESI = 4, 1, 2
FD_LENGTHS = (0, 1, 2, 3, 4, 5, 6, 7, 8, 12, 16, 20, 24, 32, 48, 64)
PATIENCE_NS = 20 * SECOND
"""A busy machine; only a gateway that loses a frame makes a test wait this long."""


def classical(can_id: int, data: bytes = b"", raw_dlc: int = 0, length: int | None = None) -> bytes:
    """struct can_frame: id, len, pad, reserved, len8_dlc, 8 data bytes."""
    return struct.pack("=IBBBB8s", can_id, len(data) if length is None else length, 0, 0, raw_dlc, data)


def fd(can_id: int, data: bytes, flags: int) -> bytes:
    """struct canfd_frame: id, len, flags, 2 reserved, 64 data bytes; FDF as kernels set it on what they receive."""
    return struct.pack("=IBBBB64s", can_id, len(data), flags | FDF, 0, 0, data)


def kinds() -> list[bytes]:
    """Every kind of frame there is, each with its own content."""
    numbers = (0, 1, 0x80, 0x185, 0x2FF, 0x6C0, 0x7FF)
    data = bytes(range(0xA1, 0xA1 + 64))
    found = [classical(number, data[:length]) for number in numbers for length in range(9)]
    found += [classical(number, data[:8], raw) for number in numbers for raw in range(9, 16)]
    found += [classical(number | REMOTE, length=length) for number in numbers for length in range(9)]
    found += [classical(number | REMOTE, raw_dlc=raw, length=8) for number in numbers for raw in range(9, 16)]
    for number in (0, 0x185, 0x7FF, 0x800, 0x1FFFFFFF):
        found += [classical(number | EXTENDED, data[:length]) for length in range(9)]
        found += [classical(number | EXTENDED, data[:8], 15), classical(number | EXTENDED | REMOTE, length=3)]
    for number in (0, 0x185, 0x7FF, 0x185 | EXTENDED, 0x1FFFFFFF | EXTENDED):
        for flags in (0, BRS, ESI, BRS | ESI):
            found += [fd(number, data[:length], flags) for length in FD_LENGTHS]
    return found


def injector(name: str, cob_id: int, fault: Drop | BitFlip) -> Injector:
    return Injector(
        name, Target(True, True, (cob_id,)), fault, At((0,)), Infinite(), None, stream(1, 0, name), True, True
    )


Pair = tuple[socket.socket, socket.socket]


def unix_pair() -> Pair:
    """Without the kernel's stamps."""
    return socket.socketpair(socket.AF_UNIX, socket.SOCK_DGRAM)


def udp_pair() -> Pair:
    """With the kernel's stamps, as SocketCAN has them."""
    ends = socket.socket(socket.AF_INET, socket.SOCK_DGRAM), socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    for end in ends:
        end.bind(("127.0.0.1", 0))
    for end, other in zip(ends, reversed(ends), strict=True):
        end.connect(other.getsockname())
    return ends


class Bench:
    """A gateway between two interfaces, and the far ends of both. far[p]: what is connected to the gateway's port p."""

    def __init__(self, injectors: list[Injector], record: bool, pair: Callable[[], Pair]) -> None:
        self.gateway = Gateway(injectors, 2_000_000)
        self.record = record
        self.far: list[socket.socket] = []
        self.channels: list[SocketCanChannel] = []
        self.came: list[list[bytes]] = [[], []]
        for name in ("controller", "drive"):
            near, far = pair()
            far.setblocking(False)
            self.far.append(far)
            self.channels.append(SocketCanChannel(f"socketcan:{name}", near.dup))
            near.close()
        self.loop = RealTimeLoop(
            self.gateway, list(self.channels), [0, 1], time.monotonic_ns(), record=record, measure_latency=True
        )

    def pass_all(self, given: list[list[bytes]], expected: list[int]) -> None:
        """Offer four records of each side a turn, until the expected numbers have come out, then a few turns more."""
        at, turns = [0, 0], 0

        def feed(now: int) -> bool:
            nonlocal turns
            for port in (0, 1):
                for record in given[port][at[port] : at[port] + 4]:
                    self.far[port].send(record)
                at[port] += 4
                self._drain(port)
            if all(at[port] >= len(given[port]) and len(self.came[port]) >= expected[port] for port in (0, 1)):
                turns += 1
            return now > limit or turns > 3

        limit = self.loop.now() + PATIENCE_NS
        self.loop.run(feed)

    def _drain(self, port: int) -> None:
        try:
            while True:
                self.came[port].append(self.far[port].recv(72))
        except BlockingIOError:
            pass

    def close(self) -> None:
        for channel in self.channels:
            channel.close()
        for far in self.far:
            far.close()


MakeBench = Callable[..., AbstractContextManager[Bench]]

WAYS: Final = {"frames": (True, unix_pair), "records": (False, unix_pair), "stamped-records": (False, udp_pair)}
