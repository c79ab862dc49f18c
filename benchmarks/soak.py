"""Millions of frames of every kind through the gateway, both ways at once: none lost, doubled, changed or out of order.

The gateway runs in a process of its own, as it does on SocketCAN (`forwarders` has how), with one rule that is active
all the time and changes one COB-ID in one direction only. Every record that comes out is compared, byte for byte, with
the one that is due. Then a tenth as many base data frames alone, which go in runs. Then as many with buses on the way
out that are busy again and again, so that frames wait in the gateway: they leave in the order in which they came. Then
the full bus: 9009 frames a second.

Usage: python -m benchmarks.soak [--frames N] [--seconds S]
"""

import argparse
import json
import select
import socket
import struct
import sys
import time
from collections import deque
from typing import Final

from benchmarks.bench_gateway import print_full_bus
from benchmarks.forwarders import BUSY_GATEWAY, GATEWAY, PATIENCE_S, Bench, forwarding, record
from canopen_exo.bus.socketcan import FD_SIZE
from canopen_exo.plan import TPDO1

WINDOW: Final = 40
"""Frames under way each way: no queue between here and there is ever full."""

BIASED: Final = TPDO1 + 5
BIAS: Final = 100
"""The rule of `forwarders`: position of the right knee, bytes 0..3, towards the controller."""

EXTENDED, REMOTE, FDF = 0x80000000, 0x40000000, 4
FD_LENGTHS: Final = (12, 16, 20, 24, 32, 48, 64)


def patterns(towards_controller: bool, base_only: bool) -> list[tuple[bytes, bytes, int]]:
    """Records as what stands before and behind a 4-byte number in the payload, and what is added to that number."""
    found = []
    kinds = 7 if base_only else 9
    for can_id in (0x000, 0x080, 0x185, 0x205, 0x585, 0x705, 0x7FF, 0x185 | EXTENDED, 0x1FFFFFFF | EXTENDED)[:kinds]:
        added = BIAS if can_id == BIASED and towards_controller else 0
        for length, raw_dlc in ((4, 0), (5, 0), (6, 0), (7, 0), (8, 0), (8, 9), (8, 15)):
            head = struct.pack("=IBBBB", can_id, length, 0, 0, raw_dlc)
            found.append((head, bytes(range(1, length - 3)).ljust(4, b"\0"), added))
        for number, length in enumerate(
            [] if base_only else FD_LENGTHS
        ):  # with and without BRS and ESI; no rule acts on FD frames
            head = struct.pack("=IBBBB", can_id, length, FDF | number % 4, 0, 0)
            found.append((head, bytes(range(1, length - 3)).ljust(60, b"\0"), 0))
    return found


REMOTES: Final = [
    struct.pack("=IBBBB8x", number | REMOTE, length, 0, 0, 0) for number in (5, 0x705) for length in (0, 1, 8)
]
"""These carry no number; one goes out after every 16 others."""


class Stream:
    """One direction: what is sent next, and what is due to come out."""

    def __init__(
        self, source: socket.socket, sink: socket.socket, towards_controller: bool, frames: int, base_only: bool = False
    ) -> None:
        self.source = source
        self.sink = sink
        self.frames = frames
        self.sent = 0
        self.received = 0
        self._patterns = patterns(towards_controller, base_only)
        self._has_remotes = not base_only
        self._due: deque[bytes] = deque()

    def send(self) -> None:
        """The next record."""
        number = self.sent
        self.sent += 1
        if number % 17 == 16 and self._has_remotes:
            content = expected = REMOTES[number % len(REMOTES)]
        else:
            head, tail, added = self._patterns[number % len(self._patterns)]
            content = head + (number & 0x0FFFFFFF).to_bytes(4, "little") + tail
            expected = content
            if added:
                expected = head + ((number & 0x0FFFFFFF) + added).to_bytes(4, "little") + tail
        self._due.append(expected)
        self.source.send(content)

    def receive(self) -> int:
        """Compare all that has come with what is due; how many frames that was."""
        count = 0
        try:
            while True:
                got = self.sink.recv(FD_SIZE)
                if not self._due or got != self._due[0]:
                    raise SystemExit(self._complaint(got))
                self._due.popleft()
                count += 1
        except BlockingIOError:
            self.received += count
            return count

    def _complaint(self, got: bytes) -> str:
        place = f"soak: frame {self.received} of {self.frames}"
        if got in self._due:
            return f"{place}: {self._due.index(got)} frames lost or overtaken before {got.hex()}"
        due = self._due[0].hex() if self._due else "nothing"
        return f"{place}: {got.hex()} came out, due was {due}: doubled or changed"


def settle(bench: Bench) -> None:
    """Take what the waiting for the forwarder has left on its way: all that comes before a frame sent now."""
    for here, there in (bench.far, bench.far[::-1]):
        here.send(record(0x7E5, b"begin"))
        while select.select([there], [], [], PATIENCE_S)[0]:
            if there.recv(FD_SIZE) == record(0x7E5, b"begin"):
                break
        else:
            raise SystemExit("soak: the first frame did not come out")


def soak(bench: Bench, frames: int, what: str, base_only: bool) -> None:
    """That many frames, half of them each way; raises SystemExit, saying which frame, when one does not come right."""
    settle(bench)
    for end in bench.far:
        end.setblocking(False)
    left, right = bench.far
    half = frames // 2
    streams = [Stream(left, right, False, frames - half, base_only), Stream(right, left, True, half, base_only)]
    started = shown = time.monotonic()
    while any(stream.received < stream.frames for stream in streams):
        idle = True
        for stream in streams:
            if stream.receive():
                idle = False
            while stream.sent < stream.frames and stream.sent - stream.received < WINDOW:
                stream.send()
                idle = False
        if idle and not select.select(bench.far, [], [], PATIENCE_S)[0]:
            missing = sum(stream.sent - stream.received for stream in streams)
            raise SystemExit(f"soak: {missing} frames did not come out")
        if time.monotonic() - shown > 10.0:
            shown = time.monotonic()
            done = sum(stream.received for stream in streams)
            print(f"soak: {done} of {frames} frames, {done / (shown - started):.0f} a second", file=sys.stderr)
    left.send(record(0x7E5, b"end"))  # a doubled last frame would come out before this one
    select.select([right], [], [], PATIENCE_S)
    if right.recv(FD_SIZE) != record(0x7E5, b"end"):
        raise SystemExit("soak: more frames came out than went in")
    took = time.monotonic() - started
    print(f"soak: {frames} frames{what} in {took:.1f} s, none lost, doubled, changed or out of order")


def account_of(program: str, frames: int, what: str, base_only: bool = False) -> dict[str, int]:
    """Soak a program; its own account afterwards."""
    with forwarding(program, []) as bench:
        soak(bench, frames, what, base_only)
        assert bench.process is not None
        assert bench.process.stdout is not None
        bench.process.terminate()
        account: dict[str, int] = json.loads(bench.process.stdout.read())
    print(f"soak: the gateway's own account: {account['frames']} received, {account['losses']} lost")
    return account


def main() -> int:
    """Run all parts; 1 when a frame was lost, or none had to wait where the buses were busy."""
    parser = argparse.ArgumentParser(description="millions of frames through the gateway, each one checked")
    parser.add_argument("--frames", type=int, default=10_000_000)
    parser.add_argument("--seconds", type=float, default=60.0, help="length of the full-bus run, 0 for none")
    options = parser.parse_args()
    some = max(options.frames // 10, 1000)
    if account_of(GATEWAY, options.frames, "")["losses"]:
        return 1
    if account_of(GATEWAY, some, " of base data frames alone", base_only=True)["losses"]:
        return 1
    account = account_of(BUSY_GATEWAY, some, " over busy buses")
    print(f"soak: refused {account['refusals']} times by a busy bus")
    if account["losses"] or not account["refusals"]:
        return 1
    return 0 if options.seconds <= 0 or print_full_bus([], options.seconds) else 1


if __name__ == "__main__":
    sys.exit(main())
