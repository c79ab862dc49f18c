"""The hub against python-can-remote, and the timed hub against the bit rate; prints the figures beside their budgets.

Each figure: a server, a sender and a receiver, three processes on loopback; 8-byte frames as fast as the server takes
them; the receiver says when a frame is missing or out of order. Both servers are measured in turns, so that both see
the same machine; the median of the turns counts. Two figures each:

- forwarding: the throughput of the server, at saturation with clients that are not what is waited for. The sender
  writes bytes that its own client library has made beforehand, the receiver reads bytes and looks at them afterwards.
- through python-can: what two programs get that make, send, receive and read one `can.Message` after the other. Making
  and reading messages costs the same with both, which the ratio contains.

Usage: python benchmarks/bench_hub.py [--frames N] [--turns N] [--seconds S]
"""

import argparse
import contextlib
import multiprocessing
import os
import resource
import socket
import statistics
import time
from collections.abc import Callable
from importlib.util import find_spec
from multiprocessing.connection import Connection
from typing import Final

import can

from canopen_exo.bus.bits import frame_bits
from canopen_exo.bus.frame import Frame
from canopen_exo.bus.hub import HubServer, fine_timers, listen, report
from canopen_exo.bus.hub_client import HubChannel
from canopen_exo.bus.hub_wire import pack_frame

PATIENCE_S: Final = 10.0
BUDGET_RATIO: Final = 10.0
BUDGET_TIMED: Final = 0.995
BITRATE: Final = 1_000_000
STEADY: Final = 200
"""Frames at the start that are not counted: two transmit queues and more are full by then."""

_SPAWN: Final = multiprocessing.get_context("spawn")


def cpu_s() -> float:
    """CPU time of this process so far, s."""
    usage = resource.getrusage(resource.RUSAGE_SELF)
    return usage.ru_utime + usage.ru_stime


# --- servers -------------------------------------------------------------------------------------------------------


def hub_server(pipe: Connection, bitrate: int) -> None:
    """A hub until the pipe says stop; then its report and CPU time."""
    server = HubServer(listen("127.0.0.1", 0), bitrate)
    fine_timers()
    pipe.send(server.address())
    start = cpu_s()
    while not pipe.poll():
        server.serve(timeout_s=0.05)
        for _ in range(200):
            server.serve(timeout_s=0.05)
            if not server.hub.buses or not any(bus.clients for bus in server.hub.buses.values()):
                break
    pipe.send((report(server)[0] if server.hub.buses else "", cpu_s() - start))
    server.close()


def remote_server(pipe: Connection, _: int) -> None:
    """python-can-remote's server in front of python-can's virtual bus."""
    from threading import Thread

    # the package ships no types
    from can_remote.server import RemoteServer  # type: ignore[import-untyped]

    server = RemoteServer("127.0.0.1", 0, interface="virtual", channel="bench")
    pipe.send(f"ws://127.0.0.1:{server.server_port}/")
    start = cpu_s()
    Thread(target=server.serve_forever, daemon=True).start()
    pipe.recv()
    pipe.send(("", cpu_s() - start))


# --- clients -------------------------------------------------------------------------------------------------------


def numbered(number: int) -> can.Message:
    """A message that carries its number."""
    return can.Message(arbitration_id=0x181, is_extended_id=False, data=number.to_bytes(8, "little"))


class Recorder:
    """Stands in for a socket, to have the bytes a client library would send."""

    def __init__(self) -> None:
        self.data = bytearray()

    def sendall(self, data: bytes | bytearray) -> None:
        self.data += data


def ready_made(bus: can.BusABC, interface: str, frames: int) -> tuple[socket.socket, bytes]:
    """The bus's socket, set to block, and the bytes of `frames` numbered messages as its own client makes them."""
    if interface == "hub":
        # the raw link under the python-can class: reached into on purpose, to time forwarding alone
        link = socket.socket(fileno=os.dup(bus._link.fileno()))  # type: ignore[attr-defined]
        link.setblocking(True)
        return link, b"".join(pack_frame(Frame(0x181, number.to_bytes(8, "little"))) for number in range(frames))
    # as above, for the other side of the comparison
    websocket = bus.remote_protocol._ws  # type: ignore[attr-defined]
    link, recorder = websocket.socket, Recorder()
    websocket.socket = recorder
    for number in range(frames):
        bus.send(numbered(number))
    websocket.socket = link
    return link, bytes(recorder.data)


def receiver(pipe: Connection, interface: str, channel: str, frames: int) -> None:
    """Receive `frames` messages numbered from 0; says when the last one came, how many, in order or not, CPU."""
    with can.Bus(interface=interface, channel=channel) as bus:
        pipe.send("ready")
        start = cpu_s()
        got = 0
        last = time.monotonic()
        is_in_order = True
        while got < frames:
            message = bus.recv(PATIENCE_S)
            if message is None:
                break
            last = time.monotonic()
            is_in_order = is_in_order and int.from_bytes(message.data, "little") == got
            got += 1
        pipe.send((last, got, is_in_order, cpu_s() - start))
        pipe.recv()


def sender(pipe: Connection, interface: str, channel: str, frames: int) -> None:
    """Send `frames` messages; says when it began, and CPU time."""
    with can.Bus(interface=interface, channel=channel) as bus:
        pipe.send("ready")
        pipe.recv()
        start = cpu_s()
        first = time.monotonic()
        for number in range(frames):
            bus.send(numbered(number))
        pipe.send((first, cpu_s() - start))
        pipe.recv()


def byte_receiver(pipe: Connection, interface: str, channel: str, frames: int) -> None:
    """As `receiver`, on bytes: a hub's record has 24, the payload at 16; a WebSocket message 25, the payload at 17."""
    size, payload_at = (24, 16) if interface == "hub" else (25, 17)
    with can.Bus(interface=interface, channel=channel) as bus:
        link, _ = ready_made(bus, interface, 0)
        link.settimeout(PATIENCE_S)
        pipe.send("ready")
        start = cpu_s()
        data = bytearray()
        last = time.monotonic()
        with contextlib.suppress(TimeoutError):
            while len(data) < frames * size:
                data += link.recv(1 << 16)
                last = time.monotonic()
        cpu = cpu_s() - start
        got = len(data) // size
        numbers = [int.from_bytes(data[at : at + 8], "little") for at in range(payload_at, got * size, size)]
        pipe.send((last, got, numbers == list(range(frames)), cpu))
        pipe.recv()
        link.settimeout(None)


def byte_sender(pipe: Connection, interface: str, channel: str, frames: int) -> None:
    """As `sender`, with bytes made beforehand."""
    with can.Bus(interface=interface, channel=channel) as bus:
        link, data = ready_made(bus, interface, frames)
        pipe.send("ready")
        pipe.recv()
        start = cpu_s()
        first = time.monotonic()
        link.sendall(data)
        pipe.send((first, cpu_s() - start))
        pipe.recv()


def started(target: Callable[..., None], *arguments: object) -> tuple[multiprocessing.process.BaseProcess, Connection]:
    """A process with a pipe to it."""
    ours, theirs = _SPAWN.Pipe()
    process = _SPAWN.Process(target=target, args=(theirs, *arguments), daemon=True)
    process.start()
    theirs.close()
    return process, ours


class Figures:
    """One turn. rate: frames/s from the first send to the last receive; cpu_us, server_us: CPU time a frame."""

    def __init__(self, rate: float, cpu_us: float, server_us: float, fault: str) -> None:
        self.rate = rate
        self.cpu_us = cpu_us
        self.server_us = server_us
        self.fault = fault

    def __str__(self) -> str:
        return (
            f"{self.rate:11,.0f} frames/s; CPU {self.server_us:5.1f} us a frame in the server, "
            f"{self.cpu_us:5.1f} in all three processes {self.fault}"
        )


def throughput(interface: str, is_bytes: bool, frames: int) -> Figures:
    """One turn with one server."""
    server, server_pipe = started(hub_server if interface == "hub" else remote_server, 0)
    channel = server_pipe.recv() + ("/bench" if interface == "hub" else "")
    taking, taking_pipe = started(byte_receiver if is_bytes else receiver, interface, channel, frames)
    taking_pipe.recv()
    giving, giving_pipe = started(byte_sender if is_bytes else sender, interface, channel, frames)
    giving_pipe.recv()
    giving_pipe.send("go")
    first, giving_cpu = giving_pipe.recv()
    last, got, is_in_order, taking_cpu = taking_pipe.recv()
    server_pipe.send("stop")
    _, server_cpu = server_pipe.recv()
    for process in (server, giving, taking):  # python-can-remote's client may wait long when it leaves
        process.kill()
        process.join()
    fault = f"({frames - got} frames missing)" if got != frames else "" if is_in_order else "(frames out of order)"
    micros = 1e6 / max(got, 1)
    return Figures(got / (last - first), (giving_cpu + taking_cpu + server_cpu) * micros, server_cpu * micros, fault)


# --- timed ---------------------------------------------------------------------------------------------------------


def flood(pipe: Connection, channel: str, can_id: int, frames: int) -> None:
    """Keep the transmit queue of one client full."""
    with can.Bus(interface="hub", channel=channel) as bus:
        pipe.send("ready")
        pipe.recv()
        for number in range(frames):
            bus.send(can.Message(arbitration_id=can_id, is_extended_id=False, data=number.to_bytes(8, "little")))
        pipe.recv()


def timed_share(seconds: float) -> tuple[float, float, int, str]:
    """Two saturating clients on a timed hub: share of the ideal rate by arrival at a third, frames/s, lost, report.

    Ideal: every frame starts when the one before it ends; the frames' exact lengths are those that came.
    """
    frames = int(seconds * BITRATE / 130 / 2)
    server, server_pipe = started(hub_server, BITRATE)
    channel = server_pipe.recv() + "/bench"
    listener = HubChannel(channel)
    listener.open()
    floods = [started(flood, channel, can_id, frames) for can_id in (0x181, 0x182)]
    for _, pipe in floods:
        pipe.recv()
    for _, pipe in floods:
        pipe.send("go")
    arrived: list[tuple[int, Frame]] = []
    deadline = time.monotonic() + 3 * seconds + PATIENCE_S
    while len(arrived) < 2 * frames and time.monotonic() < deadline:
        time.sleep(0.001)  # a listener that does not get in the way of those it measures
        now = time.monotonic_ns()
        for arrival in listener.receive():
            if arrival.frame is not None:
                arrived.append((now, arrival.frame))
    steady = arrived[STEADY : len(arrived) - STEADY]  # at the end one of the two has nothing left to send
    bits = sum(frame_bits(frame.can_id, frame.data, False, False, frame.dlc) for _, frame in steady[1:])
    took_ns = steady[-1][0] - steady[0][0]
    for _, pipe in floods:
        pipe.send("end")
    for process, _ in floods:
        process.join(PATIENCE_S)
    lost = listener.overruns + 2 * frames - len(arrived)
    listener.close()
    server_pipe.send("stop")
    line, _ = server_pipe.recv()
    server.join(PATIENCE_S)
    return bits * 1e9 / BITRATE / took_ns, (len(steady) - 1) * 1e9 / took_ns, lost, line


def compare(title: str, is_bytes: bool, frames: int, turns: int, has_remote: bool) -> float:
    """Print both servers' figures, in turns; the ratio of their medians, 0 without python-can-remote."""
    rates: dict[str, list[float]] = {"hub": [], "remote": []}
    for _ in range(turns):
        for interface, found in rates.items():
            if interface == "remote" and not has_remote:
                continue
            figures = throughput(interface, is_bytes, frames if interface == "hub" else frames // 10)
            found.append(figures.rate)
            print(f"{title}, {'hub, fast' if interface == 'hub' else 'python-can-remote':17} {figures}", flush=True)
    return statistics.median(rates["hub"]) / statistics.median(rates["remote"]) if has_remote else 0.0


def main() -> int:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--frames", type=int, default=200_000, help="through the hub, each turn")
    parser.add_argument("--turns", type=int, default=3)
    parser.add_argument("--seconds", type=float, default=10.0, help="of saturation, timed")
    options = parser.parse_args()

    has_remote = find_spec("can_remote") is not None
    ratio = compare("forwarding", True, options.frames, options.turns, has_remote)
    through = compare("through python-can", False, options.frames, options.turns, has_remote)
    if has_remote:
        print(f"hub / python-can-remote, forwarding: {ratio:.1f}x (budget: >= {BUDGET_RATIO:.0f}x)")
        print(f"hub / python-can-remote, through python-can on both ends: {through:.1f}x (for information)")
    else:
        print("hub / python-can-remote: not measured; pip install python-can-remote (it is in the extra `dev`)")
    share, rate, lost, line = timed_share(options.seconds)
    print(
        f"hub, timed, saturated at {BITRATE:,} bit/s: {share:.2%} of the ideal rate (budget: >= {BUDGET_TIMED:.1%}), "
        f"{rate:,.0f} frames/s, {lost} lost"
    )
    print(f"  {line}")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
