"""Live control over a local socket: a server that is driven by hand, real sockets, no sleeping.

All tests share that server and its clients, so they stand in one module.
"""

import itertools
import json
import select
import socket
import threading
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from canopen_exo.bus.lateness import Lateness
from canopen_exo.bus.losses import Losses
from canopen_exo.bus.node import MS, NEVER, SECOND, ErrorState, Out, PortState
from canopen_exo.bus.realtime import RealTimeLoop
from fi_gateway.control import LiveControl
from fi_gateway.control_socket import IDLE_NS, MAX_CLIENTS, MAX_LINE, ControlServer, answer_request, ask, ask_listing
from fi_gateway.effects import ConstantTime
from fi_gateway.errors import FaultError
from fi_gateway.events import At
from fi_gateway.faults import Drop
from fi_gateway.gateway import DRIVE_PORT, Gateway
from fi_gateway.injector import Injector, Target, stream

PATIENCE_S = 10.0
"""How long a busy machine may take over something that takes microseconds; only a broken server needs it all."""


class Readers:
    """The part of the real-time loop that the server needs, one turn at a time."""

    def __init__(self) -> None:
        self.callbacks: dict[int, tuple[socket.socket, Callable[[int], None]]] = {}
        self.now = 0

    def add_reader(self, source: socket.socket, callback: Callable[[int], None]) -> None:
        self.callbacks[source.fileno()] = (source, callback)

    def remove_reader(self, source: socket.socket) -> None:
        del self.callbacks[source.fileno()]

    def turn(self, timeout_s: float = PATIENCE_S) -> bool:
        """Serve what is readable; False when nothing was."""
        readable, _, _ = select.select(list(self.callbacks), [], [], timeout_s)
        self.now += bool(readable)
        for fd in readable:
            if fd in self.callbacks:
                self.callbacks[fd][1](self.now)
        return bool(readable)


def control(*names: str) -> LiveControl:
    target = Target(True, False, (0x185,))
    injectors = [
        Injector(name, target, Drop(), At((MS,)), ConstantTime(MS), None, stream(1, 0, name)) for name in names
    ]
    return LiveControl(Gateway(injectors, 2 * MS))


class Bench:
    """A server at an address, and clients of it."""

    def __init__(self, address: str, live: LiveControl) -> None:
        self.live = live
        self.readers = Readers()
        losses = [Losses(queue_full=1, not_taken=2), Losses(discarded=3, overruns=4, malformed=5)]
        self.server = ControlServer(live, address, lambda: [Lateness(), Lateness()], lambda: losses)
        self.clients: list[socket.socket] = []

    def open(self) -> None:
        self.server.listen()
        self.server.attach(self.readers)

    def connect(self) -> socket.socket:
        address = self.server.address
        if "/" in address:
            link = socket.socket(socket.AF_UNIX)
            link.connect(address)
        else:
            host, _, port = address.rpartition(":")
            link = socket.create_connection((host, int(port)))
        link.settimeout(PATIENCE_S)
        self.clients.append(link)
        assert self.readers.turn()
        return link

    def say(self, link: socket.socket, data: bytes) -> list[dict[str, object]]:
        """The answers to what is sent."""
        link.sendall(data)
        self.readers.turn()
        while self.readers.turn(0.0):
            pass
        return self.read(link)

    def read(self, link: socket.socket) -> list[dict[str, object]]:
        received = b""
        while not received.endswith(b"\n"):
            got = link.recv(1 << 16)
            if not got:
                break
            received += got
        return [json.loads(line) for line in received.splitlines()]

    def close(self) -> None:
        for link in self.clients:
            link.close()
        self.server.close()


@pytest.fixture(params=["tcp", "unix"])
def bench(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Bench]:
    made = Bench("127.0.0.1:0" if request.param == "tcp" else str(tmp_path / "gateway"), control("a", "b"))
    made.open()
    yield made
    made.close()


def is_closed(link: socket.socket) -> bool:
    try:
        return link.recv(1 << 16) == b""
    except ConnectionResetError:
        return True


def test_one_request_gets_one_answer_and_is_done(bench: Bench) -> None:
    """JSON lines: what is asked for happens at the loop's time, and the row says it came from a socket."""
    link = bench.connect()
    assert bench.say(link, b'{"do": "start"}\n') == [{"ok": True, "done": True, "time_ns": 2}]
    assert bench.say(link, b'{"do": "trigger", "name": "b"}\n') == [{"ok": True, "done": True, "time_ns": 3}]
    assert bench.say(link, b'{"do": "trigger", "name": "b"}\n') == [{"ok": True, "done": False, "time_ns": 4}]
    assert [(row.time_ns, row.what, row.name, row.source) for row in bench.live.rows[:2]] == [
        (2, "start", "", "socket"),
        (3, "trigger", "b", "socket"),
    ]
    assert [record.start_ns for record in bench.live.gateway.records] == [3]


def test_requests_in_pieces_and_several_at_once_are_answered_in_order(bench: Bench) -> None:
    """A stream has no message boundaries."""
    link = bench.connect()
    link.sendall(b'{"do": "arm", ')
    bench.readers.turn()
    assert bench.live.rows == []
    answers = bench.say(link, b'"name": "a"}\n{"do": "disarm", "name": "a"}\n{"do": "li')
    assert [one["ok"] for one in answers] == [True, True]
    assert [row.what for row in bench.live.rows] == ["arm", "disarm"]
    (listing,) = bench.say(link, b'st"}\r\n')
    assert listing["ok"]


def test_list_says_everything_about_the_gateway(bench: Bench) -> None:
    """Absolute times on the gateway's clock; null for not known and never."""
    link = bench.connect()
    (before,) = bench.say(link, b'{"do":"list"}\n')
    assert (before["time_zero_ns"], before["stopped"]) == (None, False)
    bench.say(link, b'{"do":"start"}\n')
    (after,) = bench.say(link, b'{"do":"list"}\n')
    assert after["time_zero_ns"] == 3
    rows = after["injectors"]
    assert isinstance(rows, list)
    assert rows[0] == {
        "name": "a",
        "state": "armed",
        "next_ns": 3 + MS,
        "activated": 0,
        "injected": 0,
        "manifested": 0,
    }
    directions = after["directions"]
    assert isinstance(directions, list)
    assert [one["direction"] for one in directions] == ["to_drives", "to_controller"]
    assert directions[0]["latency"]["count"] == 0
    kinds = ("queue_full", "discarded", "not_taken", "overruns", "malformed")
    assert [[one[kind] for kind in kinds] for one in directions] == [[0, 3, 0, 0, 0], [1, 0, 2, 4, 5]]


def test_changes_of_the_interfaces_are_in_the_listing_with_their_times(bench: Bench) -> None:
    """Reported with its time: as data, and as lines for people."""
    state = PortState(DRIVE_PORT, ErrorState.BUS_OFF, 0, 0, "bus-off")
    bench.live.gateway.port_changed(2 * MS, state, Out())
    (answer,) = bench.say(bench.connect(), b'{"do":"list"}\n')
    directions = answer["directions"]
    assert isinstance(directions, list)
    assert [one["changes"] for one in directions] == [[], [{"time_ns": 2 * MS, "state": "bus_off", "cause": "bus-off"}]]
    (listing,) = served(bench, lambda: ask_listing(bench.server.address))
    assert "drive side: bus off at 0.002 s: bus-off" in listing.text().splitlines()  # type: ignore[attr-defined]
    assert [one.discarded for one in listing.directions] == [3, 0]  # type: ignore[attr-defined]


@pytest.mark.parametrize(
    ("request_text", "words"),
    [
        ('{"do": "trigger", "name": "c"}', ["'c'", "allowed: a, b"]),
        ('{"do": "reset"}', ["'reset'", "allowed: arm, disarm, trigger, start, stop, resume, list"]),
        ("{}", ["None", "allowed: arm"]),
        ('{"do": ["arm"]}', ["['arm']"]),
        ('{"do": "arm"}', ["needs the name"]),
        ('{"do": "arm", "name": 3}', ["3 given"]),
        ('{"do": "arm", "name": null}', ["None given"]),
        ('{"do": "stop", "name": "a"}', ["takes no name"]),
        ('{"do": "stop", "force": true}', ["'force'", "allowed: do, name"]),
        ('{"do": "arm", "name": "\\ud800"}', ["\\ud800"]),
    ],
)
def test_what_a_request_got_wrong_is_said_and_the_connection_stays(
    bench: Bench, request_text: str, words: list[str]
) -> None:
    """Errors say what was given, what is allowed."""
    link = bench.connect()
    (answer,) = bench.say(link, request_text.encode() + b"\n")
    assert answer["ok"] is False
    assert all(word in str(answer["error"]) for word in words), answer
    assert bench.say(link, b'{"do": "stop"}\n')[0]["ok"]


NONSENSE = [
    b"hello\n",
    b"\n",
    b"[]\n",
    b'"arm"\n',
    b"\xff\xfe\n",
    b"[" * 4000 + b"\n",
    b"POST / HTTP/1.1\r\nContent-Length: 15\r\n\r\n{\"do\": \"stop\"}\n",
]


@pytest.mark.parametrize("nonsense", NONSENSE)
def test_what_is_no_object_is_answered_and_the_connection_closed(bench: Bench, nonsense: bytes) -> None:
    """A web page can send bytes to a local port: an HTTP request ends at its first line, its body is never done."""
    link = bench.connect()
    (answer,) = bench.say(link, nonsense)
    assert answer["ok"] is False
    assert is_closed(link)
    assert bench.live.rows == []
    assert bench.say(bench.connect(), b'{"do": "stop"}\n')[0]["ok"]


@pytest.mark.parametrize("ending", [b"", b"\n"])
def test_the_length_of_a_line_is_bounded(bench: Bench, ending: bytes) -> None:
    """A client cannot fill the memory of the gateway."""
    link = bench.connect()
    link.sendall(b'{"do": "' + b"x" * MAX_LINE + ending)
    while bench.readers.turn(0.0):
        pass
    (answer,) = bench.read(link)
    assert answer["ok"] is False
    assert is_closed(link)


def test_a_client_that_leaves_in_mid_line_leaves_nothing(bench: Bench) -> None:
    """Connections come and go."""
    for _ in range(3 * MAX_CLIENTS):
        link = bench.connect()
        link.sendall(b'{"do": "st')
        link.close()
        bench.readers.turn()
        while len(bench.readers.callbacks) > 1:
            bench.readers.turn()
    assert bench.live.rows == []


def test_the_number_of_clients_is_bounded_and_the_longest_idle_makes_room(bench: Bench) -> None:
    """Connections that ask nothing, or never finish a request, keep nobody from `stop`."""
    links = [bench.connect() for _ in range(MAX_CLIENTS)]
    assert bench.say(links[0], b'{"do": "list"}\n')[0]["ok"]
    links[1].sendall(b'{"do": ')
    bench.readers.turn()
    newest = bench.connect()
    assert is_closed(links[1])
    assert len(bench.readers.callbacks) == 1 + MAX_CLIENTS
    assert bench.say(newest, b'{"do": "stop"}\n')[0]["ok"]
    assert bench.say(links[0], b'{"do": "resume"}\n')[0]["ok"]


def test_a_client_that_asks_nothing_for_long_is_let_go(bench: Bench) -> None:
    """Counted from its last request; what comes and goes in pieces is none."""
    silent, asking = bench.connect(), bench.connect()
    bench.readers.now = IDLE_NS // 2
    silent.sendall(b"{")
    assert bench.say(asking, b'{"do": "list"}\n')[0]["ok"]
    bench.server.tidy(IDLE_NS)
    assert len(bench.readers.callbacks) == 3
    bench.server.tidy(IDLE_NS + SECOND)
    assert is_closed(silent)
    assert bench.say(asking, b'{"do": "stop"}\n')[0]["ok"]


def test_requests_sent_at_once_are_done_one_a_turn(bench: Bench) -> None:
    """Between two of them the gateway looks at its buses: nobody stops the frames by asking much."""
    first, second = bench.connect(), bench.connect()
    words = ["start", *["stop", "resume"] * 100]
    first.sendall(b"".join(b'{"do":"%s"}\n' % word.encode() for word in words))
    second.sendall(b'{"do":"list"}\n' * 3)
    turns = [len(bench.live.rows)]
    while len(bench.live.rows) < len(words):
        assert bench.readers.turn()
        turns.append(len(bench.live.rows))
    assert max(after - before for before, after in itertools.pairwise(turns)) == 1
    assert [row.what for row in bench.live.rows] == words
    assert all(answer["ok"] for answer in (*bench.read(first), *bench.read(second)))


@pytest.mark.long
def test_a_client_that_never_reads_is_let_go_and_never_waited_for(bench: Bench) -> None:
    """Nothing here blocks the loop."""
    link = bench.connect()
    link.setblocking(False)
    request = b'{"do":"list"}\n' * 200
    while len(bench.readers.callbacks) > 1:
        try:
            link.send(request)
        except BlockingIOError:
            pass
        except (BrokenPipeError, ConnectionResetError):
            break
        bench.readers.turn(0.0)
    assert bench.say(bench.connect(), b'{"do": "stop"}\n')[0]["ok"]


@pytest.mark.long
@given(st.dictionaries(st.text(), st.recursive(st.none() | st.text() | st.integers(), st.lists, max_leaves=3)))
def test_no_object_makes_the_gateway_raise(request_object: dict[str, object]) -> None:
    """Whatever comes from the network is data."""
    answer = answer_request(control("a"), request_object, 0)
    assert json.loads(json.dumps(answer))["ok"] in (True, False)


# ---- the client ---------------------------------------------------------------------------------------------------


def served(bench: Bench, call: Callable[[], object]) -> list[object]:
    """What `call` gives or raises in a thread of its own while the server is served here."""
    results: list[object] = []

    def work() -> None:
        try:
            results.append(call())
        except FaultError as error:
            results.append(error)

    thread = threading.Thread(target=work)
    thread.start()
    while thread.is_alive():
        bench.readers.turn(0.01)
    thread.join()
    return results


def test_ask_does_it_and_gives_the_answer(bench: Bench) -> None:
    """What `exo-hil fault trigger NAME --at ADDRESS` calls."""
    address = bench.server.address
    (answer,) = served(bench, lambda: ask(address, "start"))
    assert isinstance(answer, dict)
    assert answer["done"]
    (error,) = served(bench, lambda: ask(address, "trigger", "zzz"))
    assert "allowed: a, b" in str(error)
    (listing,) = served(bench, lambda: ask_listing(address))
    assert "s after time 0" in listing.text()  # type: ignore[attr-defined]
    assert listing.injectors == bench.live.listing()  # type: ignore[attr-defined]


def test_ask_says_when_nobody_is_there(tmp_path: Path) -> None:
    """What, where, and what to do."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        address = f"127.0.0.1:{free.getsockname()[1]}"
    for where in (address, str(tmp_path / "none")):
        with pytest.raises(FaultError, match="is a gateway running"):
            ask(where, "list")
    for where in ("127.0.0.1", "127.0.0.1:x", "127.0.0.1:70000"):
        with pytest.raises(FaultError, match="allowed HOST:PORT"):
            ask(where, "list")


def test_ask_says_when_something_else_answers() -> None:
    """Another program's port."""
    with socket.create_server(("127.0.0.1", 0)) as other:
        address = f"127.0.0.1:{other.getsockname()[1]}"

        def serve() -> None:
            link, _ = other.accept()
            with link:
                link.recv(100)
                link.sendall(b"220 hello\r\n")

        thread = threading.Thread(target=serve)
        thread.start()
        with pytest.raises(FaultError, match="no gateway"):
            ask(address, "list", timeout_s=PATIENCE_S)
        thread.join()


# ---- where it listens ---------------------------------------------------------------------------------------------


def test_closing_leaves_no_socket_and_no_path(tmp_path: Path) -> None:
    """Nothing is left over."""
    path = tmp_path / "gateway"
    bench = Bench(str(path), control("a"))
    bench.open()
    assert path.stat().st_mode & 0o777 == 0o600
    bench.connect()
    bench.close()
    bench.server.close()
    assert (list(tmp_path.iterdir()), bench.readers.callbacks) == ([], {})


def test_a_path_left_by_a_killed_gateway_is_taken_over_a_used_one_is_not(tmp_path: Path) -> None:
    """Restart works without cleaning up; two gateways at one address do not."""
    path = tmp_path / "gateway"
    with socket.socket(socket.AF_UNIX) as dead:
        dead.bind(str(path))
    bench = Bench(str(path), control("a"))
    bench.open()
    second = Bench(str(path), control("a"))
    with pytest.raises(FaultError, match="cannot listen"):
        second.open()
    assert path.exists()
    bench.close()
    path.write_text("a file")
    with pytest.raises(FaultError, match="cannot listen"):
        second.open()
    assert path.read_text() == "a file"


def test_a_port_in_use_is_refused_with_the_remedy() -> None:
    """What, where, remedy."""
    first = Bench("127.0.0.1:0", control("a"))
    first.open()
    with pytest.raises(FaultError, match="give another address"):
        Bench(first.server.address, control("a")).open()
    first.close()


@pytest.mark.parametrize(
    ("address", "exposed"), [("127.0.0.1:0", False), (":0", False), ("0.0.0.0:0", True)]
)
def test_it_says_when_other_machines_can_reach_it(address: str, exposed: bool) -> None:
    """Loopback unless told otherwise."""
    server = ControlServer(control("a"), address)
    server.listen()
    assert server.is_exposed is exposed
    server.close()


def test_the_real_time_loop_serves_it_between_frames() -> None:
    """A further readable of the loop: the answer comes though no interface and no wake-up is there."""
    live = control("a")
    server = ControlServer(live, "127.0.0.1:0")
    server.listen()
    loop = RealTimeLoop(live.gateway, [], [], 0)
    server.attach(loop)
    results: list[object] = []
    thread = threading.Thread(target=lambda: results.append(ask(server.address, "stop", timeout_s=PATIENCE_S)))
    thread.start()
    loop.run(lambda now: bool(results) or not thread.is_alive())
    thread.join()
    server.close()
    assert live.stopped
    assert live.gateway.wake_at == NEVER
