"""The hub: a CAN bus for machines without one, over TCP. Several named buses, one thread, one select.

Source: docs/hub.md. `hub_core` has the rules, `hub_wire` the bytes; here are the sockets, the clock and the signals.
Leaves out: access control; whoever reaches the address is on the bus, so it is loopback unless told otherwise.
"""

import contextlib
import ctypes
import ipaddress
import os
import select
import signal
import socket
import sys
import time
from collections.abc import Iterator
from typing import Final, final

from canopen_exo.bus.hub_core import Client, Hub, MakeBus, TimedBus
from canopen_exo.bus.hub_wire import split_address
from canopen_exo.bus.medium import Medium
from canopen_exo.bus.node import NEVER, SECOND
from canopen_exo.errors import CanopenExoError
from canopen_exo.talk import put, tell

MAX_CLIENTS: Final = 256
HELLO_NS: Final = 5 * SECOND
"""How long a connection may stay silent before it says which bus it wants."""

FAREWELL_NS: Final = SECOND
"""How long a refused client may take to read why."""

_FAST_READ: Final = 1 << 16
_TIMED_READ: Final = 4096
"""Bytes read from a client in one turn: 170 frames, so that one that babbles holds up the bus for less than a frame
time or two."""

_SEND_BUFFER: Final = 1 << 18
"""Bytes the kernel is asked to keep for a client that does not read; by itself it would take several MB."""

_SELECT_LIMIT: Final = 1024
"""FD_SETSIZE of POSIX systems: select cannot wait for a higher file descriptor."""

_REFUSALS_SHOWN: Final = 10


@final
class _Connection:
    """A client and its socket. deadline: when it is closed unless something happens before [ns], NEVER for none."""

    __slots__ = ("client", "deadline", "is_blocked", "is_finished", "link")

    def __init__(self, link: socket.socket, client: Client, deadline: int) -> None:
        self.link: Final[socket.socket] = link
        self.client: Final[Client] = client
        self.deadline: int = deadline
        self.is_blocked: bool = False
        self.is_finished: bool = False


def listen(host: str, port: int) -> socket.socket:
    """A listening socket; port 0: a free one. Raises CanopenExoError with what to do."""
    try:
        family, kind, proto, _, where = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
        listener = socket.socket(family, kind, proto)
    except OSError as error:
        raise CanopenExoError(f"hub: {host!r} is no address to listen on: {error}; the default is 127.0.0.1") from error
    try:
        if os.name == "posix":  # elsewhere it would let two hubs share the port
            listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listener.bind(where)
        listener.listen(MAX_CLIENTS)
        listener.setblocking(False)
    except OSError as error:
        listener.close()
        raise CanopenExoError(
            f"hub: cannot listen on {host}:{port}: {error.strerror}; stop what runs there, or give another port, as in "
            f"--listen {host}:0 (0: a free one)"
        ) from error
    return listener


@final
class HubServer:
    """Serves one listening socket. bitrate: bit/s of a timed hub, 0 for a fast one; make_timed: see `Hub`."""

    def __init__(self, listener: socket.socket, bitrate: int, make_timed: MakeBus | None = None) -> None:
        self.hub: Final[Hub] = Hub(bitrate, make_timed)
        self.clients: int = 0  # connections accepted so far
        self._listener: Final[socket.socket] = listener
        self._read_size: Final[int] = _TIMED_READ if bitrate else _FAST_READ
        self._connections: Final[dict[int, _Connection]] = {}
        self._readers: Final[list[int]] = [listener.fileno()]
        self._writers: Final[list[int]] = []
        self._accept_at: int = 0  # out of file descriptors: not before then
        self._deadline: int = NEVER  # the earliest of all connections

    def address(self) -> str:
        """`HOST:PORT` as it listens."""
        host, port = self._listener.getsockname()[:2]
        return f"[{host}]:{port}" if ":" in host else f"{host}:{port}"

    def serve(self, stop: socket.socket | None = None, timeout_s: float | None = None) -> bool:
        """One turn: wait until something is due, at most `timeout_s`; False when `stop` has become readable."""
        readers = self._readers
        until = min(self.hub.wake_at, self._deadline)
        if until != NEVER:
            wait = max(until - time.monotonic_ns(), 0) / SECOND
            timeout_s = wait if timeout_s is None else min(wait, timeout_s)
        extra = [] if stop is None else [stop.fileno()]
        readable, writable, _ = select.select(readers + extra, self._writers, [], timeout_s)
        now = time.monotonic_ns()
        hub = self.hub
        if hub.wake_at <= now:
            hub.wake(now)
        for number in readable:
            connection = self._connections.get(number)
            if connection is not None:
                self._read(connection)
            elif number == self._listener.fileno():
                self._accept()
        hub.settle(time.monotonic_ns())
        for number in writable:
            if number in self._connections:
                self._connections[number].is_blocked = False
        finished = False
        for connection in self._connections.values():
            if connection.client.outbox and not connection.is_blocked:
                self._write(connection)
            finished = finished or connection.is_finished
        if finished or self._deadline <= now:
            self._tidy(now)
        return not (extra and extra[0] in readable)

    def close(self) -> None:
        """Close all sockets, the listener too."""
        for connection in self._connections.values():
            connection.link.close()
        self._connections.clear()
        self._listener.close()

    def _accept(self) -> None:
        now = time.monotonic_ns()
        try:
            link, peer = self._listener.accept()
        except BlockingIOError:
            return
        except OSError as error:
            _say(f"cannot accept a client: {error.strerror}; next attempt in 1 s")
            self._accept_at = now + SECOND
            self._readers.remove(self._listener.fileno())
            self._deadline = min(self._deadline, self._accept_at)
            return
        link.setblocking(False)
        link.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        link.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _SEND_BUFFER)
        number = link.fileno()
        if os.name == "posix" and number >= _SELECT_LIMIT:
            link.close()
            _say(f"a client was turned away: more than {_SELECT_LIMIT} open files in this process")
            return
        connection = _Connection(link, Client(f"{peer[0]}:{peer[1]}"), now + HELLO_NS)
        self.clients += 1
        self._connections[number] = connection
        self._readers.append(number)
        self._deadline = min(self._deadline, connection.deadline)
        self.hub.realtime_offset_ns = time.time_ns() - now
        if len(self._connections) > MAX_CLIENTS:
            self._refuse(connection, f"the hub has {MAX_CLIENTS} clients, no more are taken; disconnect one")

    def _read(self, connection: _Connection) -> None:
        client = connection.client
        try:
            data = connection.link.recv(self._read_size)
        except BlockingIOError:
            return
        except OSError:  # reset by the peer
            data = b""
        was_refused = bool(client.refusal)
        if data:
            self.hub.received(client, data, time.monotonic_ns())
        else:
            self.hub.wake(time.monotonic_ns())
            self.hub.left(client)
            connection.is_finished = True
        if client.refusal:
            if not was_refused:
                self._farewell(connection)
        elif client.bus is not None:
            connection.deadline = NEVER

    def _refuse(self, connection: _Connection, why: str) -> None:
        self.hub.refuse(connection.client, why)
        self._farewell(connection)

    def _farewell(self, connection: _Connection) -> None:
        """The client is refused: it has a moment to read why."""
        connection.deadline = time.monotonic_ns() + FAREWELL_NS
        self._deadline = min(self._deadline, connection.deadline)
        if self.hub.refused <= _REFUSALS_SHOWN:
            _say(f"refused {connection.client.label}: {connection.client.refusal}")
        elif self.hub.refused == _REFUSALS_SHOWN + 1:
            _say("further refusals are counted only")

    def _write(self, connection: _Connection) -> None:
        client = connection.client
        outbox = client.outbox
        number = connection.link.fileno()
        try:
            while outbox:
                sent = connection.link.send(outbox)
                del outbox[:sent]
                if not outbox:
                    self.hub.drained(client)
            if client.refusal:  # no more to say; what it still sends is thrown away, so that it can read why
                connection.link.shutdown(socket.SHUT_WR)
        except BlockingIOError:
            connection.is_blocked = True
            if number not in self._writers:
                self._writers.append(number)
            return
        except OSError:  # it has gone
            outbox.clear()
            self.hub.left(client)
            connection.is_finished = True
        if number in self._writers:
            self._writers.remove(number)

    def _tidy(self, now: int) -> None:
        """Close what is finished or past its deadline, and find the next deadline."""
        self._deadline = NEVER
        if self._accept_at:
            if self._accept_at <= now:
                self._accept_at = 0
                self._readers.append(self._listener.fileno())
            else:
                self._deadline = self._accept_at
        for number, connection in list(self._connections.items()):
            if connection.deadline <= now and not connection.is_finished:
                if connection.client.bus is None and not connection.client.refusal:
                    self._refuse(connection, f"no hello within {HELLO_NS // SECOND} s")
                    self._write(connection)
                    continue
                connection.is_finished = True
            if connection.is_finished:
                del self._connections[number]
                self._readers.remove(number)
                if number in self._writers:
                    self._writers.remove(number)
                connection.link.close()
            elif connection.deadline < self._deadline:
                self._deadline = connection.deadline


def report(server: HubServer) -> list[str]:
    """What happened, one line for each bus and one for the clients."""
    lines = []
    for bus in server.hub.buses.values():
        line = (
            f"bus {bus.name}: {bus.frames} frames, at most {bus.most} clients; lost: {bus.skipped} for clients that "
            f"did not read, {bus.overflows} at full transmit queues, {bus.rejected} not carried"
        )
        if isinstance(bus, TimedBus) and bus.frames:
            late = bus.lateness
            line += (
                f"; delivered late by {late.percentile(0.5) // 1000} us (median), "
                f"{late.percentile(0.99) // 1000} us (99 %), {late.worst_ns // 1000} us (worst)"
            )
        lines.append(line)
    lines.append(f"{server.clients} clients, {server.hub.refused} refused")
    return lines


def hub_main(listen_on: str, timed: bool, bitrate: int, make_timed: MakeBus | None = None) -> int:
    """`exo-hil hub`: serve until SIGINT or SIGTERM. listen_on: HOST:PORT; bitrate: bit/s, of a timed hub.

    make_timed: see `Hub`.

    Prints `listening on HOST:PORT` on stdout when clients may come; talk goes to stderr. Returns the exit code.
    """
    try:
        host, port = split_address(listen_on)
        listener = listen(host, port)
    except CanopenExoError as error:
        tell(error)
        return 2
    try:
        if timed:
            Medium("hub", 0, bitrate)  # 0 would be a fast hub
        server = HubServer(listener, bitrate if timed else 0, make_timed)
    except CanopenExoError as error:
        listener.close()
        tell(error)
        return 2
    with contextlib.closing(server), _signals() as stop:
        if not _is_loopback(listener):
            _say(f"warning: {server.address()} can be reached from other machines, and whoever connects is on the bus")
        if timed:
            fine_timers()
        put(sys.stdout, f"listening on {server.address()}\n")
        while server.serve(stop):
            pass
    for line in report(server):
        _say(line)
    return 0


@contextlib.contextmanager
def _signals() -> Iterator[socket.socket]:
    """A socket that becomes readable with SIGINT, SIGTERM or SIGHUP."""
    stop, wake = socket.socketpair()
    wake.setblocking(False)
    before_fd = signal.set_wakeup_fd(wake.fileno(), warn_on_full_buffer=False)
    wanted = [signal.SIGINT, signal.SIGTERM]
    if sys.platform != "win32":
        wanted.append(signal.SIGHUP)
    before = [signal.signal(number, lambda *_: None) for number in wanted]
    try:
        yield stop
    finally:
        for number, handler in zip(wanted, before, strict=True):
            signal.signal(number, handler)
        signal.set_wakeup_fd(before_fd)
        stop.close()
        wake.close()


def _is_loopback(listener: socket.socket) -> bool:
    return ipaddress.ip_address(listener.getsockname()[0].partition("%")[0]).is_loopback


def fine_timers() -> None:
    """Linux: be woken within 1 us of the time asked for, not 50 us (prctl(2): PR_SET_TIMERSLACK = 29)."""
    if sys.platform == "linux":
        with contextlib.suppress(OSError, AttributeError):
            ctypes.CDLL(None).prctl(29, 1000, 0, 0, 0)


def _say(text: str) -> None:
    tell(f"hub: {text}")
