"""The hub on real sockets and as a process: rubbish, silence, clients that do not read, signals."""

import contextlib
import signal
import socket
import subprocess
import sys
from collections.abc import Callable, Iterator
from typing import IO, Protocol

import pytest

from canopen_exo.bus import hub as hub_module
from canopen_exo.bus.frame import Frame
from canopen_exo.bus.hub import HubServer, hub_main, listen, report
from canopen_exo.bus.hub_wire import (
    KIND_OVERRUN,
    KIND_REFUSED,
    KIND_WELCOME,
    RECORD_SIZE,
    pack_frame,
    pack_hello,
    pack_record,
    unpack_record,
    unpack_text,
)
from canopen_exo.errors import CanopenExoError

PATIENCE_S = 20.0
"""How long a test waits for what must come; on a busy machine it only has to come at all."""


class Running(Protocol):
    """What the fixture gives."""

    server: HubServer
    address: str

    def stop(self) -> None: ...


StartHub = Callable[..., Running]


class Raw:
    """A client of bare bytes. receive_buffer: bytes the kernel keeps for it, 0: as usual."""

    def __init__(self, address: str, receive_buffer: int = 0) -> None:
        host, _, port = address.rpartition(":")
        self.link = socket.socket()
        self.link.settimeout(PATIENCE_S)
        if receive_buffer:
            self.link.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, receive_buffer)
        self.link.connect((host, int(port)))
        self.rest = b""

    def __enter__(self) -> "Raw":
        return self

    def __exit__(self, *_: object) -> None:
        self.link.close()

    def join(self, bus: str = "drive") -> "Raw":
        self.link.sendall(pack_hello(bus, 0))
        assert self.record()[0] == KIND_WELCOME
        return self

    def record(self) -> bytes:
        """The next record; b"" when the hub has closed."""
        while not self.rest or len(self.rest) < RECORD_SIZE[self.rest[0]]:
            data = self.link.recv(65536)
            if not data:
                assert not self.rest
                return b""
            self.rest += data
        size = RECORD_SIZE[self.rest[0]]
        record, self.rest = self.rest[:size], self.rest[size:]
        return record

    def refusal(self) -> str:
        """The hub's last words: a refused record, then the end."""
        record = self.record()
        assert record[0] == KIND_REFUSED
        assert self.record() == b""
        return unpack_text(record, 0)


def test_something_else_than_a_client_is_told_and_disconnected(start_hub: StartHub) -> None:
    """A corrupt record is refused: the client is told why and disconnected."""
    hub = start_hub()
    with Raw(hub.address) as browser:
        browser.link.sendall(b"GET / HTTP/1.1\r\nHost: x\r\n\r\n")
        assert browser.refusal().startswith("no hello of an exo-hil hub client: starts with 47 45 54 20")
    hub.stop()
    assert hub.server.hub.refused == 1


def test_corrupt_record_after_the_hello_is_told_while_more_comes(start_hub: StartHub) -> None:
    """The reason is readable though the client has sent more, which a plain close would answer with a reset."""
    hub = start_hub()
    with Raw(hub.address) as rogue, Raw(hub.address).join() as other:
        rogue.join()
        rogue.link.sendall(pack_frame(Frame(1, b"")) + b"\xff" * 1000)
        rogue.link.sendall(b"\xff" * 100_000)
        assert rogue.refusal().startswith("record of kind 255 given")
        assert unpack_record(other.record(), 0)[0] == 1


def test_partial_record_at_close_is_told(start_hub: StartHub) -> None:
    """A partial record at close is refused: the client is told, if it still listens."""
    hub = start_hub()
    with Raw(hub.address).join() as client:
        client.link.sendall(pack_frame(Frame(1, b""))[:10])
        client.link.shutdown(socket.SHUT_WR)
        assert client.refusal() == "closed within a record, after 10 of its bytes"


def test_reset_connection_harms_nobody(start_hub: StartHub) -> None:
    """A client that is killed is gone, the others go on."""
    hub = start_hub()
    with Raw(hub.address).join() as first, Raw(hub.address).join() as second:
        with Raw(hub.address).join() as killed:
            killed.link.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, b"\1\0\0\0\0\0\0\0")  # close sends a reset
            first.link.sendall(pack_frame(Frame(1, b"")))
            assert second.record()
        first.link.sendall(pack_frame(Frame(2, b"")))
        assert unpack_record(second.record(), 0)[0] == 2


def test_silent_connection_is_closed(start_hub: StartHub, monkeypatch: pytest.MonkeyPatch) -> None:
    """Who does not say which bus it wants does not keep a place."""
    monkeypatch.setattr(hub_module, "HELLO_NS", 10_000_000)
    hub = start_hub()
    with Raw(hub.address) as silent:
        assert silent.refusal() == "no hello within 0 s"


def test_one_client_too_many_is_told(start_hub: StartHub, monkeypatch: pytest.MonkeyPatch) -> None:
    """Connections are bounded; who was there first stays."""
    monkeypatch.setattr(hub_module, "MAX_CLIENTS", 1)
    hub = start_hub()
    with Raw(hub.address).join() as first:
        with Raw(hub.address) as second:
            assert second.refusal().startswith("the hub has 1 clients")
        first.link.sendall(pack_frame(Frame(1, b"")))


@pytest.mark.parametrize("bitrate", [0, 1_000_000])
def test_client_that_does_not_read_loses_counted_frames_and_stalls_nobody(start_hub: StartHub, bitrate: int) -> None:
    """An overrun record says how many; frames kept + frames told = frames sent, and the reader beside it has all."""
    frames, batch = (100_000, 1_000) if bitrate == 0 else (64, 64)
    data = pack_frame(Frame(1, b"12345678")) * batch
    hub = start_hub(bitrate)
    with (
        Raw(hub.address).join() as sender,
        Raw(hub.address).join() as reader,
        Raw(hub.address, receive_buffer=4096).join() as sleeper,
    ):
        for _ in range(frames // batch):
            sender.link.sendall(data)
            for _ in range(batch):
                assert reader.record()
        sender.link.sendall(pack_record(0x7FF, 0, 0, b""))
        assert unpack_record(reader.record(), 0)[0] == 0x7FF
        kept = missed = 0
        while kept + missed < frames + 1:
            record = sleeper.record()
            if record[0] == KIND_OVERRUN:
                missed += unpack_record(record, 0)[0]
            else:
                kept += 1
        assert kept + missed == frames + 1
        assert bool(missed) == (bitrate == 0)
    hub.stop()
    assert hub.server.hub.buses["drive"].skipped == missed


def test_report_has_a_line_for_each_bus(start_hub: StartHub) -> None:
    """Statistics on exit: frames, losses by kind, clients, and the lateness of a timed hub."""
    hub = start_hub(1_000_000)
    with Raw(hub.address).join("drive") as first, Raw(hub.address).join("drive") as second:
        first.link.sendall(pack_frame(Frame(1, b"")))
        second.record()
    hub.stop()
    bus, clients = report(hub.server)
    assert bus.startswith("bus drive: 1 frames, at most 2 clients; lost: 0 for clients that did not read, 0 at full")
    assert "delivered late by" in bus
    assert clients == "2 clients, 0 refused"


# --- as a process --------------------------------------------------------------------------------------------------


@contextlib.contextmanager
def process(listen_on: str, timed: bool, bitrate: int) -> Iterator[tuple[subprocess.Popen[str], IO[str]]]:
    """`hub_main` in a process of its own; killed if the test leaves it."""
    call = f"hub_main({listen_on!r}, {timed}, {bitrate})"
    code = f"import sys; from canopen_exo.bus.hub import hub_main; sys.exit({call})"
    with subprocess.Popen(
        [sys.executable, "-c", code], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as running:
        try:
            assert running.stdout is not None
            yield running, running.stdout
        finally:
            running.kill()


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_process_says_where_it_listens_and_ends_cleanly(number: signal.Signals) -> None:
    """`listening on HOST:PORT` on stdout when ready; SIGINT and SIGTERM end it with 0 and statistics on stderr."""
    with process("127.0.0.1:0", True, 1_000_000) as (running, output):
        words = output.readline().split()
        assert words[:2] == ["listening", "on"]
        with Raw(words[2]).join() as client:
            running.send_signal(number)
            assert client.record() == b""
        rest, talk = running.communicate(timeout=PATIENCE_S)
    assert (running.returncode, rest) == (0, "")
    assert talk.splitlines()[-1] == "hub: 1 clients, 0 refused"
    assert "warning" not in talk


def test_listening_to_other_machines_is_warned_of() -> None:
    """It binds to loopback unless told otherwise, and says so when told."""
    with process("0.0.0.0:0", False, 0) as (running, output):
        assert output.readline().startswith("listening on 0.0.0.0:")
        running.terminate()
        _, talk = running.communicate(timeout=PATIENCE_S)
    assert talk.startswith("hub: warning: 0.0.0.0:")


def test_process_whose_talk_nobody_reads_goes_on() -> None:
    """A client that is refused is told of; when that goes nowhere, the others stay on their bus."""
    with process("127.0.0.1:0", False, 0) as (running, output):
        address = output.readline().split()[-1]
        assert running.stderr is not None
        running.stderr.close()
        with Raw(address) as junk, Raw(address).join() as client:
            junk.link.sendall(b"GET / HTTP/1.0\r\n\r\n")
            assert junk.refusal()
            running.terminate()
            assert client.record() == b""
        assert running.wait(PATIENCE_S) == 0


def test_port_in_use_ends_with_what_to_do(capsys: pytest.CaptureFixture[str]) -> None:
    """Exit code 2 and one line."""
    with contextlib.closing(listen("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        assert hub_main(f"127.0.0.1:{port}", False, 0) == 2
    captured = capsys.readouterr()
    assert captured.out == ""
    assert captured.err.startswith(f"hub: cannot listen on 127.0.0.1:{port}: ")
    assert captured.err.count("\n") == 1


@pytest.mark.parametrize(
    ("listen_on", "timed", "bitrate", "words"),
    [
        ("127.0.0.1:99999", False, 0, "port '99999' given"),
        ("no such host:0", False, 0, "is no address to listen on"),
        ("127.0.0.1:0", True, 0, "bit rate 0 given"),
        ("127.0.0.1:0", True, 333, "bit rate 333 given"),
        ("127.0.0.1:0", True, -1, "bit rate -1 given"),
    ],
)
def test_bad_arguments_end_with_the_reason(
    listen_on: str, timed: bool, bitrate: int, words: str, capsys: pytest.CaptureFixture[str]
) -> None:
    """Exit code 2: usage."""
    assert hub_main(listen_on, timed, bitrate) == 2
    assert words in capsys.readouterr().err


def test_listen_names_the_address_it_cannot_have() -> None:
    """What, where, remedy."""
    with pytest.raises(CanopenExoError, match="is no address to listen on"):
        listen("256.256.256.256", 0)
