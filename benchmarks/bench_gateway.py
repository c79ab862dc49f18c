"""The gateway against python-can's can_bridge: throughput, CPU per frame, latency; and a full bus without loss.

Both forward the same frames (`forwarders`), in turn, in every round; each figure is the median of the rounds, each
ratio the median of the rounds' ratios with its quartiles, so that what the machine does to both at a time does not
count. Beside them stand the least that a Python program can do (select, recv, send), which is the floor, and the
gateway that takes a core of its own (`--busy-poll`). On a vcan (of this kernel, or of User Mode Linux) the kernel's own
forwarding, cangw, is measured with them; `--vcan vcan0,vcan1` names the interfaces.

- Throughput: frames passed on a second, both ways together, at saturation and without loss: on each bus WINDOW frames
  are always under way, and the next is sent when one has come out. That is the throughput of RFC 2544 (26.1), the
  highest rate at which nothing is lost, approached from where nothing is lost by construction.
- CPU: of the forwarder's process, all threads, kernel included, for each frame; at saturation, and in the cycle below.
- Latency: from sending a frame to the kernel's stamp of it on the other bus. In the rig's cycle, as its processes give
  it to a vcan: every 2 ms SYNC, then six TPDOs at once, then six RPDOs at once. And for frames one at a time, evenly at
  the rate of a full bus: then most of it is the time a machine takes to wake a process up, the same for every program.
  There the bare loop says what a program that sleeps can reach, and `--busy-poll`, which does not sleep, is judged too.
  A round in which a program loses a frame does not count for latency: can_bridge has room for 277, which is little
  where the machine is busy otherwise.

Before each measurement frames have passed both ways. How busy forwarder and this process were at saturation is printed;
where a forwarder did not have its core (BUSY), CPU alone is judged.
Nothing is asserted about time: the budgets stand beside the figures.

Usage: python -m benchmarks.bench_gateway [--rounds N] [--cycles N] [--saturation S] [--seconds S]
           [--full-bus-only] [--vcan A,B | --no-vcan]
"""

import argparse
import json
import math
import select
import shutil
import socket
import statistics
import struct
import sys
import tempfile
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

from benchmarks.forwarders import (
    AWAKE_GATEWAY,
    BARE,
    BRIDGE,
    CANGW,
    GATEWAY,
    PATIENCE_S,
    ROOT,
    Bench,
    forwarding,
    to_controller,
    to_drives,
    udp_pair,
)
from canopen_exo.bus.node import MS, SECOND
from canopen_exo.bus.recvmmsg import SLOTS, Receiver, Sender
from canopen_exo.bus.socketcan import CLASSICAL_SIZE

THROUGHPUT_BUDGET: Final = 4.0
CPU_BUDGET: Final = 0.5
LATENCY_BUDGET: Final = 0.6
"""Ratios to can_bridge: at least, at most, at most."""

BUSY: Final = 0.9
"""Share of its core below which a forwarder was held up by others, not by its own work."""

FULL_BUS: Final = 9009
"""Frames a second: 8-byte frames of 111 bits, no stuff bits, at 1 Mbit/s."""

CYCLE_NS: Final = 2 * MS
TPDO_NS: Final = MS // 4
RPDO_NS: Final = MS
"""When in a cycle the drives answer, and when the controller gives its commands."""

WINDOW: Final = 100
"""Frames under way on each bus; a socket holds 277 by default (net.core.rmem_default, 768 bytes a frame)."""
PAUSE_S: Final = 50e-6
"""Between two looks at the buses, at saturation: looking all the time would cost the forwarder time in the kernel. At
most 10 frames come out meanwhile."""
STAMP: Final = struct.Struct("@ll")
VCAN_LIMIT_S: Final = 300.0

Due = list[tuple[int, int, bytes]]
"""When a frame is to be sent [ns], on which side, and its record."""


@dataclass(frozen=True, slots=True)
class Figures:
    """Of one round. rate: frames/s; cpu_us, cycle_cpu_us: a frame; busy: share of the time at saturation for which the
    forwarder had a core; waited: share of this process's looks that found nothing new; latencies: median and 99 % in
    the rig's cycle, median one at a time.
    """

    rate: float
    cpu_us: float
    busy: float
    waited: float
    cycle_us: float = math.inf
    cycle_late_us: float = math.inf
    cycle_cpu_us: float = 0.0
    even_us: float = math.inf


class Lane:
    """One direction at saturation. This process must not be what limits, so it gives and takes many frames a call."""

    def __init__(self, source: socket.socket, sink: socket.socket, contents: list[bytes]) -> None:
        self.sent = 0
        self.came = 0
        self._source = source
        self._contents = contents * (SLOTS // len(contents))
        self._receiver = Receiver()
        self._receiver.attach(sink)
        self._sender = Sender()
        self._sender.attach(source)
        self._loaded = Receiver()
        there, here = udp_pair()
        with there, here:
            for content in self._contents:
                there.send(content)
            self._loaded.attach(here)
            self._loaded.read()

    def fill(self) -> None:
        """Send until WINDOW frames are under way."""
        wanted = WINDOW - (self.sent - self.came)
        while wanted > 0:
            at = self.sent % len(self._contents)
            count = self._sender.send(self._loaded, at, min(at + wanted, len(self._contents)))
            if count == 0:  # no sendmmsg here, or the bus is busy
                self._source.send(self._contents[at])
                count = 1
            self.sent += count
            wanted -= count

    def drain(self) -> None:
        """Count what has come."""
        with suppress(BlockingIOError):
            while self._receiver.read() == SLOTS:
                self.came += SLOTS
            self.came += self._receiver.count


def throughput(bench: Bench, seconds: float) -> Figures:
    """What passes at saturation."""
    for end in bench.far:
        end.setblocking(False)
    left, right = bench.far
    lanes = (Lane(left, right, to_drives()), Lane(right, left, to_controller()))
    looks = empty = 0
    cpu, start = bench.cpu_ns(), time.monotonic()
    last = now = start
    while now < start + seconds:
        looks += 1
        before = sum(lane.came for lane in lanes)
        for lane in lanes:
            lane.drain()
            lane.fill()
        if sum(lane.came for lane in lanes) > before:
            last = now
        else:
            empty += 1
        next_look = now + PAUSE_S
        while (now := time.monotonic()) < next_look:
            pass
        if now - last > PATIENCE_S:
            raise SystemExit("bench_gateway: a frame did not come out")
    passed, took = sum(lane.came for lane in lanes), time.monotonic() - start
    used = (bench.cpu_ns() - cpu) / 1e9
    deadline = time.monotonic() + PATIENCE_S
    while any(lane.came != lane.sent for lane in lanes) and time.monotonic() < deadline:
        select.select(bench.far, [], [], 0.1)
        for lane in lanes:
            lane.drain()
    if any(lane.came != lane.sent for lane in lanes):
        missing = sum(lane.sent - lane.came for lane in lanes)
        raise SystemExit(f"bench_gateway: {missing} of {sum(lane.sent for lane in lanes)} frames were lost or doubled")
    return Figures(passed / took, used / passed * 1e6, used / took, empty / looks)


def evenly(frames: int, rate: int) -> Due:
    """One frame at a time, both ways, that many a second."""
    cycle = [(0, one) for one in to_drives()] + [(1, one) for one in to_controller()]
    return [(number * SECOND // rate, *cycle[number % len(cycle)]) for number in range(frames)]


def cycles(count: int, cycle_ns: int) -> Due:
    """The rig's, from its SYNC on."""
    sync, *commands = to_drives()
    due: Due = []
    for number in range(count):
        start = number * cycle_ns
        due.append((start, 0, sync))
        due += [(start + cycle_ns * TPDO_NS // CYCLE_NS, 1, one) for one in to_controller()]
        due += [(start + cycle_ns * RPDO_NS // CYCLE_NS, 0, one) for one in commands]
    return due


def latency(bench: Bench, due: Due) -> list[float]:
    """From sending a frame to its stamp on the other bus, of every frame [us], sorted; [inf] when frames were lost."""
    sent: list[list[int]] = [[], []]
    stamps: list[list[int]] = [[], []]
    start = time.monotonic_ns()
    for offset, side, content in due:
        while time.monotonic_ns() < start + offset:
            for there in (0, 1):
                stamps[there] += arrivals(bench.far[there], 0)
        sent[side].append(time.time_ns())
        bench.far[side].send(content)
    for there in (0, 1):
        stamps[there] += arrivals(bench.far[there], len(sent[1 - there]) - len(stamps[there]))
    if any(len(sent[side]) != len(stamps[1 - side]) for side in (0, 1)):
        return [math.inf]
    pairs = [pair for side in (0, 1) for pair in zip(sent[side], stamps[1 - side], strict=True)]
    return sorted((came - went) / 1e3 for went, came in pairs)


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


def compare(programs: list[str], interfaces: list[str], options: argparse.Namespace) -> dict[str, list[Figures]]:
    """All programs in turn, in every round."""
    found: dict[str, list[Figures]] = {program: [] for program in programs}
    for _ in range(options.rounds):
        for program in programs:
            with forwarding(program, interfaces) as bench:
                figures = throughput(bench, options.saturation)
                cpu = bench.cpu_ns()
                due = cycles(options.cycles, CYCLE_NS * options.slower)
                times = latency(bench, due)
                found[program].append(
                    replace(
                        figures,
                        cycle_us=quantile(times, 0.5),
                        cycle_late_us=quantile(times, 0.99),
                        cycle_cpu_us=(bench.cpu_ns() - cpu) / len(due) / 1e3,
                        even_us=quantile(latency(bench, evenly(len(due), FULL_BUS // options.slower)), 0.5),
                    )
                )
    return found


def quantile(values: list[float], share: float) -> float:
    """Of sorted values, the one that this share does not exceed."""
    return values[min(int(share * len(values)), len(values) - 1)]


ONE_BY_ONE: Final = "latency, one by one, us"

ROWS: Final[list[tuple[str, Callable[[Figures], float], float]]] = [
    ("throughput, frames/s", lambda one: one.rate, THROUGHPUT_BUDGET),
    ("CPU at saturation, us", lambda one: one.cpu_us, CPU_BUDGET),
    ("latency, rig's cycle, us", lambda one: one.cycle_us, LATENCY_BUDGET),
    ("  99 %", lambda one: one.cycle_late_us, 0.0),
    ("  CPU, us", lambda one: one.cycle_cpu_us, 0.0),
    (ONE_BY_ONE, lambda one: one.even_us, LATENCY_BUDGET),
]
"""Name, figure, budget: of at least 1 or more, else of at most; 0 for none."""


def ratios(ours: list[Figures], theirs: list[Figures], figure: Callable[[Figures], float]) -> list[float]:
    """Round by round, where neither lost a frame, nor was too cheap for the clock of the CPU; sorted."""
    pairs = [(figure(one), figure(other)) for one, other in zip(ours, theirs, strict=True)]
    return sorted([one / other for one, other in pairs if max(one, other) < math.inf and other > 0.0] or [math.inf])


def judged(ratio: float, budget: float, is_busy: bool) -> str:
    """The budget, and what to say about it."""
    if budget == 0.0:
        return ""
    at_least = budget >= 1.0
    verdict = "" if (ratio >= budget if at_least else ratio <= budget) else "  MISSED"
    if budget != CPU_BUDGET and is_busy:
        verdict = "  not judged: the machine is busy"
    return f"  {'>=' if at_least else '<='} {budget:g}{verdict}"


def print_comparison(found: dict[str, list[Figures]], has_budget: bool) -> None:
    """One line for each figure, the ratio of the first two programs and the budget beside it."""
    print(
        f"{'':25}" + "".join(f"{program:>12}" for program in found) + "   ratio [quartiles]" + "  budget" * has_budget
    )
    ours, theirs, awake = found[GATEWAY], found[BRIDGE], found[AWAKE_GATEWAY]
    is_busy = min(statistics.median(one.busy for one in rounds) for rounds in (ours, theirs, awake)) < BUSY
    with_busy_poll = []
    for name, figure, budget in ROWS:
        medians = [statistics.median(map(figure, rounds)) for rounds in found.values()]
        each = ratios(ours, theirs, figure)
        spread = f"{statistics.median(each):6.2f} [{quantile(each, 0.25):.2f} {quantile(each, 0.75):.2f}]"
        awake_ratio = statistics.median(ratios(awake, theirs, figure))
        verdict = judged(statistics.median(each), budget, is_busy) if has_budget else ""
        if name == ONE_BY_ONE and has_budget:
            floor = statistics.median(ratios(found[BARE], theirs, figure))
            verdict += f" (bare loop {floor:.2f}); --busy-poll {awake_ratio:.2f}{judged(awake_ratio, budget, is_busy)}"
        print(f"{name:25}{''.join(f'{value:12.1f}' for value in medians)}  {spread}{verdict}")
        with_busy_poll.append(f"{name.split(', us')[0].strip()} {awake_ratio:.2f}")
    print(f"ratios with --busy-poll: {'; '.join(with_busy_poll)}")
    for name, share in (("forwarder had a core", "busy"), ("this process waited", "waited")):
        shares = [statistics.median(getattr(one, share) for one in rounds) for rounds in found.values()]
        print(f"{name:25}" + "".join(f"{value:12.0%}" for value in shares))


def print_vcan(options: argparse.Namespace) -> None:
    """The same on a vcan with cangw, in a process where there is one; or why there is none."""
    from tests.vcan import uml

    command = [sys.executable, "-m", "benchmarks.bench_gateway", "--vcan", ",".join(uml.INTERFACES)]
    is_native = uml.native_vcan_available()
    if is_native:
        command += ["--rounds", str(options.rounds), "--cycles", str(options.cycles), "--seconds", str(options.seconds)]
    else:
        command += ["--rounds", "1", "--cycles", "40", "--slower", "50", "--emulated"]
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
    parser.add_argument("--rounds", type=int, default=11, help="of all programs in turn")
    parser.add_argument("--cycles", type=int, default=200, help="in each round, for latency; 13 frames each")
    parser.add_argument("--slower", type=int, default=1, help=argparse.SUPPRESS)  # so many times, for latency
    parser.add_argument("--saturation", type=float, default=0.4, help="seconds of each round, for throughput and CPU")
    parser.add_argument("--seconds", type=float, default=5.0, help="length of the full-bus run")
    parser.add_argument("--full-bus-only", action="store_true", help="leave out the comparison")
    parser.add_argument("--vcan", metavar="A,B", help="two interfaces that are up, instead of UDP sockets")
    parser.add_argument("--no-vcan", action="store_true", help="leave out the part on a vcan")
    parser.add_argument("--emulated", action="store_true", help=argparse.SUPPRESS)  # no budgets, no full bus
    options = parser.parse_args()
    interfaces = options.vcan.split(",") if options.vcan else []
    where = f"SocketCAN {options.vcan}" if interfaces else "UDP sockets in the place of AF_CAN"
    if not options.full_bus_only:
        programs = [GATEWAY, BRIDGE, BARE, AWAKE_GATEWAY]
        if interfaces and shutil.which(CANGW):
            programs.append(CANGW)
        print(f"gateway with one active rule, {where}, median of {options.rounds} rounds", flush=True)
        print_comparison(compare(programs, interfaces, options), not options.emulated)
        if interfaces and CANGW not in programs:
            print("cangw (in the kernel): not measured; it needs can-utils")
    code = 0 if options.emulated or print_full_bus(interfaces, options.seconds) else 1
    if not (interfaces or options.full_bus_only or options.no_vcan):
        print_vcan(options)
    return code


if __name__ == "__main__":
    sys.exit(main())
