"""Programs that forward frames between two buses, each in a process of its own, and what is connected to the buses.

Ours with one rule that is active all the time, python-can's `can.bridge`, the least that a Python program can do, and
on a vcan the kernel's own forwarding, cangw. Without interfaces connected loopback UDP sockets take the place of AF_CAN
in every program alike; everything else in them is as on SocketCAN.
The forwarder has one core to itself and this process another, where there are two. More cores would not help
can_bridge: its two threads share the interpreter's lock and cost more on two.
"""

import errno
import json
import os
import select
import signal
import socket
import struct
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Final

from canopen_exo.bus.realtime import RealTimeLoop
from canopen_exo.bus.recvmmsg import SLOTS
from canopen_exo.bus.socketcan import FD_SIZE, SocketCanChannel, open_can_socket
from canopen_exo.plan import HLC_STATUS, RPDO1, STATUS_MOTION, SYNC, TPDO1, BusPlan
from fi_gateway.effects import Infinite
from fi_gateway.events import At
from fi_gateway.faults import Bias
from fi_gateway.gateway import Gateway
from fi_gateway.injector import Injector, Target, stream
from testbench.scenario import default_joints

if TYPE_CHECKING:
    from _typeshed import ReadableBuffer

ROOT: Final = Path(__file__).resolve().parent.parent

SO_TIMESTAMPNS: Final = 35  # asm-generic/socket.h
SO_RCVBUFFORCE: Final = 33
FAR_BUFFER: Final = 8 << 20
"""Bytes for what this process has not read yet: on a busy machine it may not run for a second."""
PATIENCE_S: Final = 10.0
PROBE: Final = struct.pack("=IBBBB8s", 0x7E5, 1, 0, 0, 0, b"?")
WALKING: Final = struct.pack("<BHH", STATUS_MOTION, 0, 0)
"""What the controller says at time 0: then the gateway knows it, as in every motion."""

GATEWAY: Final = "gateway"
AWAKE_GATEWAY: Final = "--busy-poll"
"""Ours with that option."""
BUSY_GATEWAY: Final = "gateway-on-busy-buses"
"""For the soak: its sockets refuse again and again, as those of busy interfaces do."""
BRIDGE: Final = "can_bridge"
BARE: Final = "bare loop"
CANGW: Final = "cangw"


def record(can_id: int, data: bytes) -> bytes:
    """The kernel's struct can_frame."""
    return struct.pack("=IBBBB8s", can_id, len(data), 0, 0, 0, data)


def to_drives() -> list[bytes]:
    """What the controller sends in a cycle."""
    return [record(SYNC, b"\1"), *(record(RPDO1 + node, b"\x0f\0\x34\x12") for node in range(1, 7))]


def to_controller() -> list[bytes]:
    """What the drives send in a cycle."""
    return [record(TPDO1 + node, struct.pack("<ii", 1000 * node, -node)) for node in range(1, 7)]


# --- the programs under test, each in a process of its own ---------------------------------------------------------


def near_socket(end: str) -> socket.socket:
    """One of the forwarder's two sockets: an inherited descriptor, or an interface."""
    return socket.socket(fileno=int(end)) if end.isdigit() else open_can_socket(end)


def rule() -> Injector:
    """The one active rule: a bias on what the right knee says about its position."""
    plan = BusPlan(default_joints())
    signal_ = next(one for one in plan.signals() if (one.node, one.name) == ("right_knee", "position"))
    target = Target(True, False, (signal_.cob_id,))
    return Injector("bias", target, Bias(signal_, 100), At((0,)), Infinite(), None, stream(1, 0, "bias"), True, True)


class BusySocket(socket.socket):
    """Refuses one to seven sends in a row out of every 50, as a full interface queue (ENOBUFS) or socket (EAGAIN)."""

    def __init__(self, fileno: int) -> None:
        super().__init__(fileno=fileno)
        self.sends = 0
        self.refusals = 0

    def send(self, data: "ReadableBuffer", flags: int = 0, /) -> int:
        """Hand over, or refuse."""
        self.sends += 1
        rounds, place = divmod(self.sends, 50)
        if place <= rounds % 7:
            self.refusals += 1
            if rounds % 2:
                raise OSError(errno.ENOBUFS, "No buffer space available")
            raise BlockingIOError(errno.EAGAIN, "Resource temporarily unavailable")
        return super().send(data, flags)


def serve_busy_gateway(ends: list[str]) -> None:
    """Our gateway with sockets that refuse."""
    busy = [BusySocket(int(end)) for end in ends]
    account = served([lambda: busy[0], lambda: busy[1]])
    print(json.dumps({**account, "refusals": busy[0].refusals + busy[1].refusals}))


def serve_gateway(ends: list[str], busy_poll: bool = False) -> None:
    """Our gateway."""
    print(json.dumps(served([lambda: near_socket(ends[0]), lambda: near_socket(ends[1])], busy_poll)))


def serve_awake_gateway(ends: list[str]) -> None:
    """Our gateway with `--busy-poll`."""
    serve_gateway(ends, busy_poll=True)


def served(openers: list[Callable[[], socket.socket]], busy_poll: bool = False) -> dict[str, object]:
    """Our gateway until SIGTERM; then its own account of it."""
    stopped = False

    def stop(number: int, frame: FrameType | None) -> None:
        nonlocal stopped
        stopped = True

    signal.signal(signal.SIGTERM, stop)
    channels = [SocketCanChannel(f"socketcan:{place}", opener) for place, opener in enumerate(openers)]
    epoch_ns = time.monotonic_ns()
    for channel in channels:
        channel.epoch_ns = epoch_ns
        channel.receive()  # probes from before this process was ready would spoil the worst latency
    gateway = Gateway([rule()], 2_000_000)
    loop = RealTimeLoop(gateway, list(channels), [0, 1], epoch_ns, measure_latency=True, busy_poll=busy_poll)
    loop.run(lambda now: stopped)
    latency = loop.latency[0]
    latency.merge(loop.latency[1])
    return {
        "losses": loop.losses(),
        "frames": gateway.frames,
        "changed": gateway.injectors[0].manifested,
        "latency": latency.document(),
    }


def serve_bridge(ends: list[str]) -> None:
    """`python -m can.bridge`, unchanged but for where its sockets come from."""
    import logging

    from can import bridge
    from can.interfaces.socketcan import socketcan

    if ends[0].isdigit():
        logging.getLogger("can").propagate = False  # it would say that UDP sockets have no CAN filters
        logging.getLogger("can").addHandler(logging.NullHandler())
        left = list(ends)

        def next_socket() -> socket.socket:
            return near_socket(left.pop(0))

        def bind_nothing(sock: socket.socket, channel: str = "") -> None:
            pass

        socketcan.create_socket = next_socket
        socketcan.bind_socket = bind_nothing
    sys.argv = ["can.bridge"]
    for number, end in enumerate(ends, 1):
        sys.argv += [f"--bus{number}-interface", "socketcan", f"--bus{number}-channel", end]
    bridge.main()


def serve_bare(ends: list[str]) -> None:
    """The least: what is readable is read and sent, until SIGTERM."""
    here, there = (near_socket(end) for end in ends)
    here.setblocking(False)
    there.setblocking(False)
    while True:
        readable, _, _ = select.select([here, there], [], [])
        for source in readable:
            sink = there if source is here else here
            try:
                for _ in range(SLOTS):
                    sink.send(source.recv(FD_SIZE))
            except BlockingIOError:
                pass


SERVE: Final = {
    GATEWAY: serve_gateway,
    AWAKE_GATEWAY: serve_awake_gateway,
    BUSY_GATEWAY: serve_busy_gateway,
    BRIDGE: serve_bridge,
    BARE: serve_bare,
}


# --- what is connected to both buses -------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Bench:
    """far: the sockets on the controller's and the drives' bus. process: what forwards between them, if one does."""

    far: tuple[socket.socket, socket.socket]
    process: subprocess.Popen[str] | None

    def cpu_ns(self) -> int:
        """CPU time of the process so far, all threads [ns]; 0 for the kernel."""
        if self.process is None:
            return 0
        clock = ~self.process.pid << 3 | 2  # CPUCLOCK_SCHED of a process: linux/posix-timers.h
        return time.clock_gettime_ns(clock)


def udp_pair() -> tuple[socket.socket, socket.socket]:
    """Two sockets connected to each other."""
    ends = [socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in range(2)]
    for end in ends:
        end.bind(("127.0.0.1", 0))
    ends[0].connect(ends[1].getsockname())
    ends[1].connect(ends[0].getsockname())
    return ends[0], ends[1]


@contextmanager
def forwarding(program: str, interfaces: list[str]) -> Iterator[Bench]:
    """A program that forwards, with what is connected to it. interfaces: two, or none for UDP sockets."""
    near: list[socket.socket] = []
    if interfaces:
        far = (open_can_socket(interfaces[0]), open_can_socket(interfaces[1]))
        ends = interfaces
    else:
        pairs = (udp_pair(), udp_pair())
        near = [pair[0] for pair in pairs]
        far = (pairs[0][1], pairs[1][1])
        ends = [str(end.fileno()) for end in near]
    process = None
    if program == CANGW:
        cangw_rules(interfaces, "-A")
    else:
        command = [sys.executable, "-m", "benchmarks.forwarders", program, *ends]
        inherited = [end.fileno() for end in near]
        with on_core(0):
            process = subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, text=True, pass_fds=inherited)
    for end in near:
        end.close()
    for end in far:
        end.setsockopt(socket.SOL_SOCKET, SO_TIMESTAMPNS, 1)
        try:
            end.setsockopt(socket.SOL_SOCKET, SO_RCVBUFFORCE, FAR_BUFFER)
        except OSError:  # not root: what the system allows; then a loss may be ours
            end.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, FAR_BUFFER)
    bench = Bench(far, process)
    try:
        with on_core(-1):
            wait_ready(bench)
            yield bench
    finally:
        if process is None:
            cangw_rules(interfaces, "-D")
        elif process.poll() is None:
            process.terminate()
        for end in far:
            end.close()
        if process is not None:
            process.wait()


@contextmanager
def on_core(place: int) -> Iterator[None]:
    """Run on one core, with what is started meanwhile. place: in the list of those allowed; nothing where it is one."""
    allowed = os.sched_getaffinity(0)
    if len(allowed) > 1:
        os.sched_setaffinity(0, {sorted(allowed)[place]})
    try:
        yield
    finally:
        os.sched_setaffinity(0, allowed)


def cangw_rules(interfaces: list[str], what: str) -> None:
    """Add (-A) or delete (-D) the kernel's forwarding both ways, with one rule that changes a frame, as ours has."""
    there, back = interfaces
    changed = ["-f", "185:7FF", "-m", "XOR:D:185.8.6400000000000000"]
    for source, sink, rest in ((there, back, []), (back, there, changed), (back, there, ["-f", "185~7FF"])):
        subprocess.run(["cangw", what, "-s", source, "-d", sink, "-e", *rest], check=True)


def wait_ready(bench: Bench) -> None:
    """Until a frame comes through both ways; then the motion begins."""
    for here, there in ((0, 1), (1, 0)):
        deadline = time.monotonic() + PATIENCE_S
        while not select.select([bench.far[there]], [], [], 0.2)[0]:
            bench.far[here].send(PROBE)
            if time.monotonic() > deadline or (bench.process is not None and bench.process.poll() is not None):
                raise SystemExit("benchmark: the forwarder does not forward, see above")
        if here == 0:
            bench.far[0].send(record(SYNC, b"\1"))
            bench.far[0].send(record(HLC_STATUS, WALKING))
        while select.select([bench.far[there]], [], [], 0.1)[0]:
            bench.far[there].recv(FD_SIZE)


if __name__ == "__main__":
    SERVE[sys.argv[1]](sys.argv[2:])
