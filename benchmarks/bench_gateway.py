"""The gateway against python-can's can_bridge: throughput, CPU per frame, latency; and a full bus without loss.

Both forward the same frames in a process of their own, one after the other, several rounds; this process is what is
connected to the two buses. The gateway has one rule that is active all the time. Where AF_CAN is not at hand, connected
loopback UDP sockets take its place in both programs; everything else in them is as on SocketCAN. Beside them stands the
least that a Python program can do: select, recv, send. On a vcan (of this kernel, or of User Mode Linux) the kernel's
own forwarding, cangw, is measured with them; `--vcan vcan0,vcan1` names the interfaces.

- Throughput: frames passed on a second, both ways together, at saturation and without loss: on each bus WINDOW frames
  are always under way, and the next is sent when one has come out. That is the throughput of RFC 2544 (26.1), the
  highest rate at which nothing is lost, approached from where nothing is lost by construction.
- CPU: of the forwarder's process, all threads, kernel included, for each of these frames.
- Latency: from sending a frame to the kernel's stamp of it on the other bus, median, at the rate of a full bus; a round
  in which a program loses a frame does not count for it.

The forwarder has one core to itself and this process another, where there are two. More cores would not help
can_bridge: its two threads share the interpreter's lock and cost more on two. Of the rounds the best counts, for
every program and figure: what others on the machine take away is not the program's. How busy forwarder and this process
were at saturation is printed; where a forwarder did not have its core (BUSY), CPU alone is judged.
Nothing is asserted about time: the budgets stand beside the figures.

Usage: python -m benchmarks.bench_gateway [--rounds N] [--frames N] [--rate N] [--saturation S] [--seconds S]
           [--full-bus-only] [--vcan A,B | --no-vcan]
"""

import argparse
import errno
import json
import math
import os
import select
import shutil
import signal
import socket
import statistics
import struct
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Final

from canopen_exo.bus.node import SECOND
from canopen_exo.bus.realtime import RealTimeLoop
from canopen_exo.bus.recvmmsg import SLOTS
from canopen_exo.bus.socketcan import CLASSICAL_SIZE, FD_SIZE, SocketCanChannel, open_can_socket
from canopen_exo.plan import RPDO1, SYNC, TPDO1, BusPlan
from fi_gateway.effects import Infinite
from fi_gateway.events import At
from fi_gateway.faults import Bias
from fi_gateway.gateway import Gateway
from fi_gateway.injector import Injector, Target, stream
from testbench.scenario import default_joints

if TYPE_CHECKING:
    from _typeshed import ReadableBuffer

ROOT: Final = Path(__file__).resolve().parent.parent

THROUGHPUT_BUDGET: Final = 4.0
CPU_BUDGET: Final = 0.5
LATENCY_BUDGET: Final = 0.6
"""Ratios to can_bridge: at least, at most, at most."""

BUSY: Final = 0.9
"""Share of its core below which a forwarder was held up by others, not by its own work."""

FULL_BUS: Final = 9009
"""Frames a second: 8-byte frames of 111 bits, no stuff bits, at 1 Mbit/s."""

WINDOW: Final = 100
"""Frames under way on each bus; a socket holds 277 by default (net.core.rmem_default, 768 bytes a frame)."""
STAMP: Final = struct.Struct("@ll")
SO_TIMESTAMPNS: Final = 35  # asm-generic/socket.h
SO_RCVBUFFORCE: Final = 33
FAR_BUFFER: Final = 8 << 20
"""Bytes for what this process has not read yet: on a busy machine it may not run for a second."""
PATIENCE_S: Final = 10.0
VCAN_LIMIT_S: Final = 300.0
PROBE: Final = struct.pack("=IBBBB8s", 0x7E5, 1, 0, 0, 0, b"?")

GATEWAY: Final = "gateway"
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


def serve_gateway(ends: list[str]) -> None:
    """Our gateway."""
    print(json.dumps(served([lambda: near_socket(ends[0]), lambda: near_socket(ends[1])])))


def served(openers: list[Callable[[], socket.socket]]) -> dict[str, object]:
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
    loop = RealTimeLoop(gateway, list(channels), [0, 1], epoch_ns, measure_latency=True)
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


SERVE: Final = {GATEWAY: serve_gateway, BUSY_GATEWAY: serve_busy_gateway, BRIDGE: serve_bridge, BARE: serve_bare}


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
        command = [sys.executable, "-m", "benchmarks.bench_gateway", "--serve", program, *ends]
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
    """Until a frame comes through both ways."""
    for here, there in ((0, 1), (1, 0)):
        deadline = time.monotonic() + PATIENCE_S
        while not select.select([bench.far[there]], [], [], 0.2)[0]:
            bench.far[here].send(PROBE)
            if time.monotonic() > deadline or (bench.process is not None and bench.process.poll() is not None):
                raise SystemExit("bench_gateway: the forwarder does not forward, see above")
        while select.select([bench.far[there]], [], [], 0.1)[0]:
            bench.far[there].recv(FD_SIZE)


@dataclass(frozen=True, slots=True)
class Figures:
    """rate: frames/s; cpu_us: a frame; busy, own: share of the time at which the forwarder, this process had a core."""

    rate: float
    cpu_us: float
    busy: float
    own: float
    latency_us: float = 0.0


def throughput(bench: Bench, seconds: float) -> Figures:
    """What passes at saturation; its latency is measured elsewhere."""
    for end in bench.far:
        end.setblocking(False)
    left, right = bench.far
    lanes = ((left, right, to_drives()), (right, left, to_controller()))
    sent, came = [0, 0], [0, 0]
    cpu, busy, start = bench.cpu_ns(), time.process_time(), time.monotonic()
    last = start
    while (now := time.monotonic()) < start + seconds:
        before = came[0] + came[1]
        for lane, (source, sink, contents) in enumerate(lanes):
            came[lane] += drained(sink)
            while sent[lane] - came[lane] < WINDOW:
                source.send(contents[sent[lane] % len(contents)])
                sent[lane] += 1
        if came[0] + came[1] > before:
            last = now
        elif now - last > PATIENCE_S or not select.select(bench.far, [], [], PATIENCE_S)[0]:
            raise SystemExit("bench_gateway: a frame did not come out")
    passed, took = came[0] + came[1], time.monotonic() - start
    used, own = (bench.cpu_ns() - cpu) / 1e9, time.process_time() - busy
    deadline = time.monotonic() + PATIENCE_S
    while came != sent and time.monotonic() < deadline:
        select.select(bench.far, [], [], 0.1)
        came = [came[0] + drained(right), came[1] + drained(left)]
    if came != sent:
        raise SystemExit(f"bench_gateway: {sum(sent) - sum(came)} of {sum(sent)} frames were lost or doubled")
    return Figures(passed / took, used / passed * 1e6, used / took, own / took)


def latency(bench: Bench, frames: int, rate: int) -> float:
    """From sending a frame to its stamp on the other bus, median [us]; `rate` frames a second, evenly, both ways.

    Infinite when frames were lost: can_bridge has room for 277, which is little where the machine is busy otherwise.
    """
    cycle = [(0, one) for one in to_drives()] + [(1, one) for one in to_controller()]
    sent: list[list[int]] = [[], []]
    stamps: list[list[int]] = [[], []]
    start = time.monotonic_ns()
    for number in range(frames):
        due = start + number * SECOND // rate
        side, content = cycle[number % len(cycle)]
        for there in (0, 1):
            stamps[there] += arrivals(bench.far[there], 0)
        while time.monotonic_ns() < due:
            pass
        sent[side].append(time.time_ns())
        bench.far[side].send(content)
    for there in (0, 1):
        stamps[there] += arrivals(bench.far[there], len(sent[1 - there]) - len(stamps[there]))
    if any(len(sent[side]) != len(stamps[1 - side]) for side in (0, 1)):
        return math.inf
    times = [came - went for side in (0, 1) for went, came in zip(sent[side], stamps[1 - side], strict=True)]
    return statistics.median(times) / 1e3


def arrivals(far: socket.socket, wanted: int) -> list[int]:
    """The kernel's stamps [ns] of what has come, after waiting for `wanted` frames: for those lost, a second."""
    stamps: list[int] = []
    while True:
        try:
            _, ancillary, _, _ = far.recvmsg(CLASSICAL_SIZE, 64, socket.MSG_DONTWAIT)
        except BlockingIOError:
            if len(stamps) >= wanted:
                return stamps
            if not select.select([far], [], [], 1.0)[0]:
                return stamps
            continue
        seconds, nanos = STAMP.unpack_from(ancillary[0][2])
        stamps.append(seconds * SECOND + nanos)


def full_bus(bench: Bench, seconds: float) -> tuple[int, int, float, float]:
    """FULL_BUS frames a second over both buses, cycle by cycle both ways.

    Frames sent, lost, the rate reached, and the share of a core that the forwarder took.
    """
    cycle = [(0, one) for one in to_drives()] + [(1, one) for one in to_controller()]
    sent = received = 0
    start, cpu = time.monotonic(), bench.cpu_ns()
    for end in bench.far:
        end.setblocking(False)
    end_s = start + seconds
    while (now := time.monotonic()) < end_s:
        due = int((now - start) * FULL_BUS)
        while sent < due:
            side, content = cycle[sent % len(cycle)]
            bench.far[side].send(content)
            sent += 1
        received += drained(bench.far[0]) + drained(bench.far[1])
        time.sleep(0.0005)
    took = time.monotonic() - start
    share = (bench.cpu_ns() - cpu) / took / 1e9
    deadline = time.monotonic() + 2.0
    while received < sent and time.monotonic() < deadline:
        select.select(bench.far, [], [], 0.1)
        received += drained(bench.far[0]) + drained(bench.far[1])
    return sent, sent - received, sent / took, share


def drained(end: socket.socket) -> int:
    """Read what has come on a bus; how many frames that were."""
    count = 0
    try:
        while True:
            end.recv(CLASSICAL_SIZE)
            count += 1
    except BlockingIOError:
        return count


# --- the account ---------------------------------------------------------------------------------------------------


def compare(programs: list[str], interfaces: list[str], options: argparse.Namespace) -> dict[str, Figures]:
    """Per program the best of the rounds, figure by figure; how busy it was in the round with the highest rate."""
    found: dict[str, list[Figures]] = {program: [] for program in programs}
    for _ in range(options.rounds):
        for program in programs:
            with forwarding(program, interfaces) as bench:
                figures = throughput(bench, options.saturation)
                found[program].append(replace(figures, latency_us=latency(bench, options.frames, options.rate)))
    best = {}
    for program, rounds in found.items():
        fastest = max(rounds, key=lambda one: one.rate)
        cpu_us, latency_us = min(one.cpu_us for one in rounds), min(one.latency_us for one in rounds)
        best[program] = replace(fastest, cpu_us=cpu_us, latency_us=latency_us)
    return best


def print_comparison(best: dict[str, Figures], has_budget: bool) -> None:
    """One line for each figure, the ratio of the first two programs and the budget beside it."""
    rows: list[tuple[str, Callable[[Figures], float], float, int]] = [
        ("throughput, frames/s", lambda one: one.rate, THROUGHPUT_BUDGET, 1),
        ("CPU, us a frame", lambda one: one.cpu_us, CPU_BUDGET, -1),
        ("latency, us", lambda one: one.latency_us, LATENCY_BUDGET, -1),
    ]
    print(f"{'':22}" + "".join(f"{program:>12}" for program in best) + "   ratio" + "  budget" * has_budget)
    for name, figure, budget, sign in rows:
        values = [figure(one) for one in best.values()]
        ratio = values[0] / values[1]
        verdict = "" if (ratio - budget) * sign >= 0 else "  MISSED"
        if budget != CPU_BUDGET and min(one.busy for one in list(best.values())[:2]) < BUSY:
            verdict = "  not judged: the machine is busy"
        verdict = f"  {'>=' if sign > 0 else '<='} {budget:g}{verdict}"
        print(f"{name:22}{''.join(f'{value:12.1f}' for value in values)}  {ratio:6.2f}{verdict * has_budget}")
    print(f"{'forwarder had a core':22}" + "".join(f"{one.busy:12.0%}" for one in best.values()))
    print(f"{'this process had one':22}" + "".join(f"{one.own:12.0%}" for one in best.values()))


def print_vcan(options: argparse.Namespace) -> None:
    """The same on a vcan with cangw, in a process where there is one; or why there is none."""
    from tests.vcan import uml

    command = [sys.executable, "-m", "benchmarks.bench_gateway", "--vcan", ",".join(uml.INTERFACES)]
    is_native = uml.native_vcan_available()
    if is_native:
        command += ["--rounds", str(options.rounds), "--frames", str(options.frames), "--seconds", str(options.seconds)]
    else:
        command += ["--rounds", "1", "--frames", "500", "--rate", "200", "--emulated"]
    try:
        with tempfile.TemporaryDirectory() as folder:
            code, text = uml.run(
                command, Path(folder), VCAN_LIMIT_S, {"PYTHONPATH": str(ROOT)}, cache=ROOT / ".cache" / "vcan"
            )
    except uml.VcanError as error:
        print(f"cangw and SocketCAN: not measured, no vcan to be had: {' '.join(str(error).split())[:400]}")
        return
    print(text.rstrip() if code == 0 else f"cangw and SocketCAN: the run on vcan failed:\n{text.rstrip()[-2000:]}")
    if not is_native:
        print("(User Mode Linux, one CPU and slow system calls: shows that it works, not what it costs natively)")


def print_full_bus(interfaces: list[str], seconds: float) -> bool:
    """The gateway under a full bus; False when a frame was lost."""
    with forwarding(GATEWAY, interfaces) as bench:
        sent, lost, rate, share = full_bus(bench, seconds)
        assert bench.process is not None
        assert bench.process.stdout is not None
        bench.process.terminate()
        account = json.loads(bench.process.stdout.read())
    late = account["latency"]
    print(
        f"full bus: {sent} frames in {seconds:g} s ({rate:.0f} a second), {lost} lost (budget 0), "
        f"{account['losses']} counted as lost by the gateway, which took {share:.0%} of a core; "
        f"added latency median {late['p50_ns'] / 1e3:.0f} us, 99 % {late['p99_ns'] / 1e3:.0f} us, "
        f"worst {late['worst_ns'] / 1e3:.0f} us"
    )
    return lost == 0


def main() -> int:
    """Measure and print; 1 when a frame was lost."""
    parser = argparse.ArgumentParser(description="the gateway against python-can's can_bridge")
    parser.add_argument("--rounds", type=int, default=5, help="of all programs in turn; the best counts")
    parser.add_argument("--frames", type=int, default=9_009, help="for latency")
    parser.add_argument("--rate", type=int, default=FULL_BUS, help="frames a second, for latency")
    parser.add_argument("--saturation", type=float, default=1.0, help="seconds of each round, for throughput and CPU")
    parser.add_argument("--seconds", type=float, default=5.0, help="length of the full-bus run")
    parser.add_argument("--full-bus-only", action="store_true", help="leave out the comparison")
    parser.add_argument("--vcan", metavar="A,B", help="two interfaces that are up, instead of UDP sockets")
    parser.add_argument("--no-vcan", action="store_true", help="leave out the part on a vcan")
    parser.add_argument("--emulated", action="store_true", help=argparse.SUPPRESS)  # no budgets, no full bus
    parser.add_argument("--serve", nargs=3, metavar=("PROGRAM", "A", "B"), help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.serve is not None:
        program, *ends = options.serve
        SERVE[program](ends)
        return 0
    interfaces = options.vcan.split(",") if options.vcan else []
    where = f"SocketCAN {options.vcan}" if interfaces else "UDP sockets in the place of AF_CAN"
    if not options.full_bus_only:
        programs = [GATEWAY, BRIDGE, BARE]
        if interfaces and shutil.which(CANGW):
            programs.append(CANGW)
        print(f"gateway with one active rule, {where}, best of {options.rounds} rounds", flush=True)
        print_comparison(compare(programs, interfaces, options), not options.emulated)
        if interfaces and CANGW not in programs:
            print("cangw (in the kernel): not measured; it needs can-utils")
    code = 0 if options.emulated or print_full_bus(interfaces, options.seconds) else 1
    if not (interfaces or options.full_bus_only or options.no_vcan):
        print_vcan(options)
    return code


if __name__ == "__main__":
    sys.exit(main())
