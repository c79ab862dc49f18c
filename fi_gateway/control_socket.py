"""Live control over a local socket: one line of JSON in, one line of JSON out.

A request is an object with `do` (arm, disarm, trigger, start, stop, resume, list, add) and `name` for those about one
injector; add has its keys in `injector`, and `at_once` true where its times count from now. An answer has `ok`, and
`error` when that is false (docs/live_control.md). The server is a further reader of the real-time loop: a request is
handled between two frames, at most one of each client in a turn of the loop, and nothing here ever blocks. What a
client sends beyond that waits in its socket. Where one client too many comes, the one idle for longest is let go, so
that nobody can keep others from `stop`; a client that asks nothing for IDLE_NS is let go too.
Addresses: `HOST:PORT`, or a path (with a `/` in it) for a Unix socket, which only the same user can open.
Safety: on loopback any local user, and so any page in a browser, can connect to a TCP port. A connection whose line is
no JSON object is told so and closed, which ends an HTTP request at its first line; nothing is ever done for it.
Leaves out: authentication, encryption, events pushed to clients.
"""

import contextlib
import ipaddress
import json
import socket
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Final, Protocol, final

from canopen_exo.bus.lateness import Lateness
from canopen_exo.bus.losses import Losses
from canopen_exo.bus.node import NEVER, SECOND
from canopen_exo.errors import CanopenExoError
from fi_gateway.control import (
    ADD,
    NAMED,
    WORDS,
    Direction,
    InjectorRow,
    LiveControl,
    StateChange,
    changes_text,
    listing_text,
    perform,
    statistics,
    statistics_text,
)
from fi_gateway.control_address import connect, is_path, remove_left, split_address, unix_socket
from fi_gateway.errors import FaultError

LIST: Final = "list"
MAX_LINE: Final = 4096
"""Bytes of a request, its line feed included."""
MAX_CLIENTS: Final = 16
IDLE_NS: Final = 300 * SECOND
"""A connection over which nothing was asked for so long is closed."""
_BACKLOG: Final = 4
_SEND_BUFFER: Final = 1 << 20
"""A listing is about 150 bytes for each injector; a client that lets this fill up is let go."""
_MAX_ANSWER: Final = 1 << 20
_DISCARDED: Final = 1 << 16
"""Bytes taken unread from a client that is let go."""

Answer = dict[str, object]


class Readers(Protocol):
    """The part of the real-time loop that is needed here."""

    def add_reader(self, source: socket.socket, callback: Callable[[int], None]) -> None:
        """Call `callback(now)` whenever `source` is readable."""

    def remove_reader(self, source: socket.socket) -> None:
        """Wait for `source` no longer."""


@final
class _Client:
    """A connection and what has come of its next line. asked_ns: when it came or last asked for something."""

    def __init__(self, link: socket.socket, now: int) -> None:
        self.link: Final[socket.socket] = link
        self.asked_ns: int = now
        self.line: bytes = b""


@final
class ControlServer:
    """Serves live control at an address; `listen` binds, `attach` gives it to a loop, `close` leaves nothing behind.

    latency, losses: asked for the distributions of added latency, by port sent on, and for what was lost, by port.
    """

    def __init__(
        self,
        control: LiveControl,
        address: str,
        latency: Callable[[], list[Lateness]] | None = None,
        losses: Callable[[], list[Losses]] | None = None,
    ) -> None:
        self._control: Final[LiveControl] = control
        self._address: Final[str] = address
        self._latency: Final = latency
        self._losses: Final = losses
        self._listener: socket.socket | None = None
        self._path: Path | None = None
        self._readers: Readers | None = None
        self._clients: Final[list[_Client]] = []
        self._tidy_at: int = 0

    @property
    def address(self) -> str:
        """Where it listens, with the port that was free when port 0 was asked for."""
        if self._listener is None or self._path is not None:
            return self._address
        host, port = self._listener.getsockname()[:2]
        return f"[{host}]:{port}" if ":" in host else f"{host}:{port}"

    @property
    def is_exposed(self) -> bool:
        """Whether other machines can reach it: a host was given that is not loopback."""
        if self._listener is None or self._path is not None:
            return False
        return not ipaddress.ip_address(str(self._listener.getsockname()[0]).partition("%")[0]).is_loopback

    def listen(self) -> None:
        """Bind; raises FaultError, saying what to do."""
        try:
            if is_path(self._address):
                self._listen_on_path(Path(self._address))
            else:
                host, port = split_address(self._address)
                family, kind, proto, _, where = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
                self._listener = socket.socket(family, kind, proto)
                self._listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
                self._listener.bind(where)
            assert self._listener is not None
            self._listener.listen(_BACKLOG)
            self._listener.setblocking(False)
        except OSError as error:
            self.close()
            raise FaultError(
                f"live control: cannot listen at {self._address}: {error.strerror or error}; stop what runs there, or "
                "give another address with --control"
            ) from error

    def attach(self, readers: Readers) -> None:
        """Become a reader of a loop."""
        if self._listener is None:
            raise FaultError("live control: attach before listen; call listen() first")
        self._readers = readers
        readers.add_reader(self._listener, self._accept)

    def close(self) -> None:
        """Let go of all connections, the listener and its path; a second call does nothing."""
        while self._clients:
            self._drop(self._clients[-1])
        if self._listener is not None:
            if self._readers is not None:
                self._readers.remove_reader(self._listener)
            self._listener.close()
            self._listener = None
            if self._path is not None:
                self._path.unlink(missing_ok=True)

    def _listen_on_path(self, path: Path) -> None:
        """A Unix socket that is ours alone; one that a killed process has left is taken over."""
        remove_left(path)
        listener = unix_socket()
        self._listener = listener
        listener.bind(str(path))
        self._path = path
        path.chmod(0o600)  # nobody can connect before listen()

    def _accept(self, now: int) -> None:
        assert self._listener is not None
        assert self._readers is not None
        try:
            link, _ = self._listener.accept()
        except OSError:  # it has left already, or we are out of file descriptors
            return
        if len(self._clients) >= MAX_CLIENTS:
            self._drop(min(self._clients, key=_idle_since))
        link.setblocking(False)
        with contextlib.suppress(OSError):
            link.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _SEND_BUFFER)
        client = _Client(link, now)
        self._clients.append(client)
        self._readers.add_reader(link, partial(self._read, client))

    def tidy(self, now: int) -> None:
        """Let those go that have asked nothing for long; to be called now and then. now: loop clock [ns]."""
        if now >= self._tidy_at:
            for client in [one for one in self._clients if one.asked_ns + IDLE_NS <= now]:
                self._drop(client)
            self._tidy_at = now + SECOND

    def _drop(self, client: _Client) -> None:
        self._clients.remove(client)
        if self._readers is not None:
            self._readers.remove_reader(client.link)
        client.link.close()

    def _read(self, client: _Client, now: int) -> None:
        """Take the rest of one line, and answer it; further lines stay in the socket until the next turn."""
        try:
            seen = client.link.recv(MAX_LINE, socket.MSG_PEEK)
            got = client.link.recv(seen.find(b"\n") + 1 or len(seen)) if seen else seen
        except BlockingIOError:
            return
        except OSError:
            got = b""
        if not got:
            self._drop(client)
            return
        client.line += got
        if len(client.line) > MAX_LINE or (len(client.line) == MAX_LINE and not got.endswith(b"\n")):
            self._dismiss(client, f"a request has at most {MAX_LINE} bytes; closing")
        elif got.endswith(b"\n"):
            request = _object(client.line)
            client.line = b""
            client.asked_ns = now
            if request is None:
                self._dismiss(client, "not a line with one JSON object; closing")
            elif not self._send(client, answer_request(self._control, request, now, self._latency, self._losses)):
                self._drop(client)

    def _dismiss(self, client: _Client, why: str) -> None:
        """Say why, and close. What it has sent already is thrown away, or closing would reset the connection."""
        self._send(client, {"ok": False, "error": why})
        with contextlib.suppress(OSError):
            client.link.recv(_DISCARDED)
        self._drop(client)

    def _send(self, client: _Client, answer: Answer) -> bool:
        """False when the client does not take it."""
        record = json.dumps(answer, separators=(",", ":")).encode() + b"\n"
        try:
            return client.link.send(record) == len(record)
        except OSError:
            return False


def answer_request(
    control: LiveControl,
    request: dict[str, object],
    now: int,
    latency: Callable[[], list[Lateness]] | None = None,
    losses: Callable[[], list[Losses]] | None = None,
    source: str = "socket",
) -> Answer:
    """Do what a request says; now: loop clock [ns]. Whatever the request, this does not raise."""
    word, name = request.get("do"), request.get("name", "")
    allowed = (*WORDS, LIST, ADD)
    keys = ("do", "name", "injector", "at_once") if word == ADD else ("do", "name")
    unknown = sorted(set(request) - set(keys))
    error = ""
    if not isinstance(word, str) or word not in allowed:
        error = f"do: {_shown(word)} given, allowed: {', '.join(allowed)}"
    elif unknown:
        error = f"{', '.join(_shown(key) for key in unknown)}: no such key, allowed: {', '.join(keys)}"
    elif not isinstance(name, str):
        error = f"name: {_shown(name)} given, allowed is the name of an injector"
    elif bool(name) != (word == ADD or word in NAMED):
        error = f"{word}: takes no name" if name else f"{word}: needs the name of an injector"
    if error:
        return {"ok": False, "error": error}
    assert isinstance(word, str)
    assert isinstance(name, str)
    if word == LIST:
        return _listing(control, now, latency, losses)
    try:
        if word == ADD:
            control.add(name, request.get("injector"), now, source, request.get("at_once") is True)
            done = True
        else:
            done = perform(control, word, name, now, source)
    except FaultError as refused:
        return {"ok": False, "error": str(refused)}
    return {"ok": True, "done": done, "time_ns": now}


def ask_to_add(address: str, name: str, injector: object, at_once: bool) -> Answer:
    """Give a running gateway one more injector, with the keys of a scenario file. As `ask`."""
    return _ask(address, {"do": ADD, "name": name, "injector": injector, "at_once": at_once}, 2.0)


def ask(address: str, word: str, name: str = "", timeout_s: float = 2.0) -> Answer:
    """Send one request and wait for its answer, which has `ok` true. Raises FaultError for anything else."""
    return _ask(address, {"do": word, "name": name} if name else {"do": word}, timeout_s)


def _ask(address: str, request: Answer, timeout_s: float) -> Answer:
    received = b""
    try:
        with connect(address, timeout_s) as link:
            link.sendall(json.dumps(request).encode() + b"\n")
            while not received.endswith(b"\n"):
                got = link.recv(1 << 16)
                if not got or len(received) > _MAX_ANSWER:
                    break
                received += got
    except OSError as error:
        why = "no answer" if isinstance(error, TimeoutError) else error.strerror or str(error)
        raise FaultError(
            f"live control: {address}: {why}; is a gateway running with `--control {address}`?"
        ) from error
    answer = _object(received)
    if answer is None or not isinstance(answer.get("ok"), bool):
        raise FaultError(f"live control: what answers at {address} is no gateway")
    if not answer["ok"]:
        raise FaultError(str(answer.get("error")))
    return answer


@dataclass(frozen=True, slots=True)
class Listing:
    """The answer to `list`. time_ns, time_zero_ns: the gateway's clock, time_zero_ns NEVER while it is not known."""

    time_ns: int
    time_zero_ns: int
    stopped: bool
    injectors: list[InjectorRow]
    directions: list[Direction]

    def text(self) -> str:
        """For people."""
        zero = "time 0 is not known yet"
        if self.time_zero_ns < NEVER:
            zero = f"{(self.time_ns - self.time_zero_ns) / 1e9:.3f} s after time 0"
        lines = [zero + (", injection is stopped" if self.stopped else "")]
        lines += [listing_text(self.injectors, self.time_ns), statistics_text(self.directions)]
        changes = changes_text(self.directions)
        if changes:
            lines += [changes, f"now: {self.time_ns / 1e9:.3f} s on the gateway's clock"]
        return "\n".join(lines)


def ask_listing(address: str, timeout_s: float = 2.0) -> Listing:
    """What the gateway at that address says about itself; raises FaultError."""
    return _read_listing(json.dumps(ask(address, LIST, timeout_s=timeout_s)))


def _listing(
    control: LiveControl,
    now: int,
    latency: Callable[[], list[Lateness]] | None,
    losses: Callable[[], list[Losses]] | None,
) -> Answer:
    gateway = control.gateway
    directions = []
    found = statistics(gateway, None if latency is None else latency(), None if losses is None else losses())
    for one in found:
        added = None if one.latency is None else one.latency.document()
        directions.append({**asdict(replace(one, latency=None)), "latency": added})
    return {
        "ok": True,
        "time_ns": now,
        "time_zero_ns": _or_none(gateway.time_zero),
        "stopped": control.stopped,
        "injectors": [{**asdict(row), "next_ns": _or_none(row.next_ns)} for row in control.listing()],
        "directions": directions,
    }


def _or_none(time_ns: int) -> int | None:
    return None if time_ns >= NEVER else time_ns


def _or_never(time_ns: int | None) -> int:
    return NEVER if time_ns is None else time_ns


def _read_listing(text: str) -> Listing:
    """The listing in an answer; raises FaultError when it is none."""
    answer = json.loads(text)
    try:
        directions = []
        for one in answer["directions"]:
            added = one.pop("latency")
            changes = tuple(StateChange(**change) for change in one.pop("changes"))
            late = None if added is None else Lateness.from_document(added)
            directions.append(Direction(**one, latency=late, changes=changes))
        injectors = [InjectorRow(**{**row, "next_ns": _or_never(row["next_ns"])}) for row in answer["injectors"]]
        zero = _or_never(answer["time_zero_ns"])
        return Listing(answer["time_ns"], zero, answer["stopped"], injectors, directions)
    except (AttributeError, KeyError, TypeError, CanopenExoError) as error:
        raise FaultError("live control: the listing is of another version; use the gateway's own exo-hil") from error


def _object(line: bytes) -> Answer | None:
    """The JSON object in a line; None when there is none."""
    try:
        found = json.loads(line)
    except (ValueError, RecursionError):
        return None
    return found if isinstance(found, dict) else None


def _shown(given: object) -> str:
    text = repr(given)
    return text if len(text) <= 60 else f"{text[:60]}..."


def _idle_since(client: _Client) -> int:
    return client.asked_ns
