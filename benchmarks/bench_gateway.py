"""The gateway against python-can's can_bridge: throughput, CPU per frame, latency; and a full bus without loss.

Both forward the same frames in a process of their own, one after the other, several rounds; this process is what is
connected to the two buses. The gateway has one rule that is active all the time. Where AF_CAN is not at hand, connected
loopback UDP sockets take its place in both programs; everything else in them is as on SocketCAN. With
`--vcan vcan0,vcan1` both use these interfaces instead, and the kernel's own forwarding (cangw) is printed beside them.
Nothing is asserted about time: the budgets stand beside the figures.

Usage: python -m benchmarks.bench_gateway [--rounds N] [--bursts N] [--frames N] [--seconds S] [--vcan A,B]
"""

import argparse
import json
import os
import select
import shutil
import signal
import socket
import statistics
import struct
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import FrameType
from typing import Final

from canopen_exo.bus.node import SECOND
from canopen_exo.bus.realtime import RealTimeLoop
from canopen_exo.bus.socketcan import CLASSICAL_SIZE, FD_SIZE, SocketCanChannel, open_can_socket
from canopen_exo.plan import RPDO1, SYNC, TPDO1, BusPlan
from fi_gateway.effects import Infinite
from fi_gateway.events import At
from fi_gateway.faults import Bias
from fi_gateway.gateway import Gateway
from fi_gateway.injector import Injector, Target, stream
from testbench.scenario import default_joints

ROOT: Final = Path(__file__).resolve().parent.parent

THROUGHPUT_BUDGET: Final = 4.0
CPU_BUDGET: Final = 0.5
LATENCY_BUDGET: Final = 0.6
"""Ratios to can_bridge: at least, at most, at most."""

FULL_BUS: Final = 9009
"""Frames a second: 8-byte frames of 111 bits, no stuff bits, at 1 Mbit/s."""

BURST: Final = 200
"""Frames on each bus in a burst; a socket holds 277 by default (net.core.rmem_default, 768 bytes a frame)."""
BURST_S: Final = 0.02
"""Longer than any of the programs takes over a burst."""
STAMP: Final = struct.Struct("@ll")
SO_TIMESTAMPNS: Final = 35  # asm-generic/socket.h
SO_RCVBUFFORCE: Final = 33
FAR_BUFFER: Final = 8 << 20
"""Bytes for what this process has not read yet: on a busy machine it may not run for a second."""
PATIENCE_S: Final = 10.0
PROBE: Final = struct.pack("=IBBBB8s", 0x7E5, 1, 0, 0, 0, b"?")

GATEWAY: Final = "gateway"
BRIDGE: Final = "can_bridge"
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


def serve_gateway(ends: list[str]) -> None:
    """Our gateway until SIGTERM; then its own account of it, as JSON."""
    stopped = False

    def stop(number: int, frame: FrameType | None) -> None:
        nonlocal stopped
        stopped = True

    signal.signal(signal.SIGTERM, stop)
    # mypy cannot infer a lambda whose default argument binds the loop variable
    channels = [SocketCanChannel(f"socketcan:{end}", lambda end=end: near_socket(end)) for end in ends]  # type: ignore[misc]
    epoch_ns = time.monotonic_ns()
    for channel in channels:
        channel.epoch_ns = epoch_ns
        channel.receive()  # probes from before this process was ready would spoil the worst latency
    gateway = Gateway([rule()], 2_000_000)
    loop = RealTimeLoop(gateway, list(channels), [0, 1], epoch_ns, measure_latency=True)
    loop.run(lambda now: stopped)
    latency = loop.latency[0]
    latency.merge(loop.latency[1])
    account = {
        "losses": loop.losses(),
        "frames": gateway.frames,
        "changed": gateway.injectors[0].manifested,
        "latency": latency.document(),
    }
    print(json.dumps(account))


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

    def freeze(self) -> None:
        """Stop the process, and wait until it has stopped."""
        if self.process is not None:
            self.process.send_signal(signal.SIGSTOP)
            os.waitid(os.P_PID, self.process.pid, os.WSTOPPED | os.WNOWAIT)

    def thaw(self) -> None:
        """Let it go on."""
        if self.process is not None:
            self.process.send_signal(signal.SIGCONT)


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
        command = [sys.executable, "-m", "benchmarks.bench_gateway", "--serve", program, *ends]
        inherited = [end.fileno() for end in near]
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


def cangw_rules(interfaces: list[str], what: str) -> None:
    """Add (-A) or delete (-D) the kernel's forwarding both ways, with one rule that changes a frame, as ours has."""
    there, back = interfaces
    changed = ["-f", "185:7FF", "-m", "XOR:D:185.8.6400000000000000"]
    for source, sink, rest in ((there, back, []), (back, there, changed), (back, there, ["-f", "185~7FF"])):
        subprocess.run(["cangw", what, "-s", source, "-d", sink, "-e", *rest], check=True)


def wait_ready(bench: Bench) -> None:
    """Until a frame comes through both ways."""
    for here, there in ((0, 1), (1, 0)):
        deadline = time.monotonic() + PATIENCE_S
        while not select.select([bench.far[there]], [], [], 0.2)[0]:
            bench.far[here].send(PROBE)
            if time.monotonic() > deadline or (bench.process is not None and bench.process.poll() is not None):
                raise SystemExit("bench_gateway: the forwarder does not forward, see above")
        while select.select([bench.far[there]], [], [], 0.1)[0]:
            bench.far[there].recv(FD_SIZE)


def throughput(bench: Bench, bursts: int) -> tuple[float, float]:
    """Frames a second, and CPU time a frame [us], medians of the bursts.

    A burst: the forwarder is stopped, BURST frames are put before it on each bus, and it goes on; timed from there to
    the kernel's stamp of the last frame that comes out. So this process does not set the pace.
    """
    there, back = to_drives(), to_controller()
    rates, costs = [], []
    for _ in range(bursts):
        bench.freeze()
        start = time.time_ns()
        for number in range(BURST):
            bench.far[0].send(there[number % 7])
            bench.far[1].send(back[number % 6])
        cpu = bench.cpu_ns()
        if bench.process is not None:  # the kernel has done it while we sent
            start = time.time_ns()
        bench.thaw()
        time.sleep(BURST_S)  # keep out of its way
        stamps = [*arrivals(bench.far[0], BURST), *arrivals(bench.far[1], BURST)]
        rates.append(len(stamps) / (max(stamps) - start) * 1e9)
        costs.append((bench.cpu_ns() - cpu) / len(stamps) / 1e3)
    return statistics.median(rates), statistics.median(costs)


def latency(bench: Bench, frames: int) -> float:
    """From sending a frame to its stamp on the other bus, median [us]; FULL_BUS frames a second, evenly, both ways."""
    cycle = [(0, one) for one in to_drives()] + [(1, one) for one in to_controller()]
    sent: list[list[int]] = [[], []]
    stamps: list[list[int]] = [[], []]
    start = time.monotonic_ns()
    for number in range(frames):
        due = start + number * SECOND // FULL_BUS
        side, content = cycle[number % len(cycle)]
        for there in (0, 1):
            stamps[there] += arrivals(bench.far[there], 0)
        while time.monotonic_ns() < due:
            pass
        sent[side].append(time.time_ns())
        bench.far[side].send(content)
    for there in (0, 1):
        stamps[there] += arrivals(bench.far[there], len(sent[1 - there]) - len(stamps[there]))
    times = [came - went for side in (0, 1) for went, came in zip(sent[side], stamps[1 - side], strict=True)]
    return statistics.median(times) / 1e3


def arrivals(far: socket.socket, wanted: int) -> list[int]:
    """The kernel's stamps [ns] of what has come, after waiting until that are at least `wanted` frames."""
    stamps: list[int] = []
    while True:
        try:
            _, ancillary, _, _ = far.recvmsg(CLASSICAL_SIZE, 64, socket.MSG_DONTWAIT)
        except BlockingIOError:
            if len(stamps) >= wanted:
                return stamps
            if not select.select([far], [], [], PATIENCE_S)[0]:
                raise SystemExit(f"bench_gateway: {wanted - len(stamps)} frames did not come out") from None
            continue
        seconds, nanos = STAMP.unpack_from(ancillary[0][2])
        stamps.append(seconds * SECOND + nanos)


def full_bus(bench: Bench, seconds: float) -> tuple[int, int, float]:
    """FULL_BUS frames a second over both buses, cycle by cycle both ways: frames sent, lost, and the rate reached."""
    cycle = [(0, one) for one in to_drives()] + [(1, one) for one in to_controller()]
    sent = received = 0
    start = time.monotonic()
    for end in bench.far:
        end.setblocking(False)
    end_s = start + seconds
    while (now := time.monotonic()) < end_s:
        due = int((now - start) * FULL_BUS)
        while sent < due:
            side, content = cycle[sent % len(cycle)]
            bench.far[side].send(content)
            sent += 1
        received += drain(bench)
        time.sleep(0.0005)
    rate = sent / (time.monotonic() - start)
    deadline = time.monotonic() + 2.0
    while received < sent and time.monotonic() < deadline:
        select.select(bench.far, [], [], 0.1)
        received += drain(bench)
    return sent, sent - received, rate


def drain(bench: Bench) -> int:
    """Read what has come on both buses; how many frames that were."""
    count = 0
    for end in bench.far:
        try:
            while True:
                end.recv(CLASSICAL_SIZE)
                count += 1
        except BlockingIOError:
            pass
    return count


# --- the account ---------------------------------------------------------------------------------------------------


def compare(programs: list[str], interfaces: list[str], options: argparse.Namespace) -> dict[str, list[float]]:
    """Per program the medians over the rounds: throughput [frames/s], CPU [us a frame], latency [us]."""
    found: dict[str, list[list[float]]] = {program: [[], [], []] for program in programs}
    for _ in range(options.rounds):
        for program in programs:
            with forwarding(program, interfaces) as bench:
                rate, cpu_us = throughput(bench, options.bursts)
                for place, value in enumerate((rate, cpu_us, latency(bench, options.frames))):
                    found[program][place].append(value)
    return {program: [statistics.median(one) for one in values] for program, values in found.items()}


def print_comparison(programs: list[str], medians: dict[str, list[float]]) -> None:
    """One line for each figure, the budget beside it."""
    rows: list[tuple[str, str, Callable[[float], bool]]] = [
        ("throughput, frames/s", f">= {THROUGHPUT_BUDGET:g}", lambda ratio: ratio >= THROUGHPUT_BUDGET),
        ("CPU, us a frame", f"<= {CPU_BUDGET:g}", lambda ratio: ratio <= CPU_BUDGET),
        ("latency, us", f"<= {LATENCY_BUDGET:g}", lambda ratio: ratio <= LATENCY_BUDGET),
    ]
    print(f"{'':22}" + "".join(f"{program:>12}" for program in programs) + "   ratio  budget")
    for place, (name, budget, met) in enumerate(rows):
        values = [medians[program][place] for program in programs]
        ratio = values[0] / values[1]
        numbers = "".join(f"{value:12.1f}" for value in values)
        print(f"{name:22}{numbers}  {ratio:6.2f}  {budget}{'' if met(ratio) else '  MISSED'}")


def print_full_bus(interfaces: list[str], seconds: float) -> bool:
    """The gateway under a full bus; False when a frame was lost."""
    with forwarding(GATEWAY, interfaces) as bench:
        sent, lost, rate = full_bus(bench, seconds)
        assert bench.process is not None
        assert bench.process.stdout is not None
        bench.process.terminate()
        account = json.loads(bench.process.stdout.read())
    late = account["latency"]
    print(
        f"full bus: {sent} frames in {seconds:g} s ({rate:.0f} a second), {lost} lost (budget 0), "
        f"{account['losses']} counted as lost by the gateway; added latency median {late['p50_ns'] / 1e3:.0f} us, "
        f"99 % {late['p99_ns'] / 1e3:.0f} us, worst {late['worst_ns'] / 1e3:.0f} us"
    )
    return lost == 0


def main() -> int:
    """Measure and print; 1 when a frame was lost."""
    parser = argparse.ArgumentParser(description="the gateway against python-can's can_bridge")
    parser.add_argument("--rounds", type=int, default=3, help="of all programs in turn; medians count")
    parser.add_argument("--bursts", type=int, default=50, help="of 400 frames, for throughput and CPU")
    parser.add_argument("--frames", type=int, default=9_009, help="for latency")
    parser.add_argument("--seconds", type=float, default=5.0, help="length of the full-bus run")
    parser.add_argument("--full-bus-only", action="store_true", help="leave out the comparison")
    parser.add_argument("--vcan", metavar="A,B", help="two interfaces that are up, instead of UDP sockets")
    parser.add_argument("--serve", nargs=3, metavar=("PROGRAM", "A", "B"), help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.serve is not None:
        program, *ends = options.serve
        (serve_gateway if program == GATEWAY else serve_bridge)(ends)
        return 0
    interfaces = options.vcan.split(",") if options.vcan else []
    where = f"SocketCAN {options.vcan}" if interfaces else "UDP sockets in the place of AF_CAN"
    if not options.full_bus_only:
        programs = [GATEWAY, BRIDGE]
        if interfaces and shutil.which(CANGW):
            programs.append(CANGW)
        print(f"gateway with one active rule, {where}, medians of {options.rounds} rounds")
        print_comparison(programs, compare(programs, interfaces, options))
        if CANGW not in programs:
            print("cangw (in the kernel): not measured; it needs --vcan vcan0,vcan1 and can-utils")
    return 0 if print_full_bus(interfaces, options.seconds) else 1


if __name__ == "__main__":
    sys.exit(main())
