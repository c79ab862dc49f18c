"""Processes that are forked are as those started from nothing, and end with whoever has asked for them."""

import json
import os
import select
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from testbench import fork_server
from testbench.child import Process, Running, execute
from testbench.cli_rig import DEFAULT_SCENARIO
from testbench.fork_server import ForkServer
from tests.parity.rigs import descendants_of, ended, is_alive

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="processes are forked on Linux alone")

PATIENCE_S = 60.0

EXAMPLE = Path(__file__).parents[2] / "scenarios" / "golden.yaml"


@pytest.fixture(scope="module")
def server() -> Iterator[ForkServer]:
    server = ForkServer()
    yield server
    server.close()


def forked(server: ForkServer, *arguments: str) -> Running:
    running = server.fork(list(arguments))
    assert running is not None
    return running


def outcome(running: Running) -> tuple[str, int]:
    """What it prints, and how it ends."""
    assert running.stdout is not None
    with running.stdout as stdout:
        return stdout.read().decode(), running.wait(PATIENCE_S)


@pytest.mark.parametrize(
    ("arguments", "code"), [(["export", "dbc"], 0), (["--version"], 0), (["run"], 2), (["check", "missing.yaml"], 2)]
)
def test_it_says_and_ends_as_one_started_from_nothing(server: ForkServer, arguments: list[str], code: int) -> None:
    given = outcome(forked(server, *arguments))
    assert given == outcome(execute(arguments))
    assert given[0]
    assert given[1] == code


def test_folder_and_environment_are_those_of_whoever_asks(
    server: ForkServer, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Not those of the time at which the server was started."""
    (tmp_path / "here.yaml").write_text(DEFAULT_SCENARIO)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("CAN_INTERFACE", "socketcan")
    monkeypatch.setenv("CAN_CHANNEL", "no_such_can")
    assert outcome(forked(server, "check", "here.yaml"))[1] == 0
    said, code = outcome(forked(server, "hlc"))
    assert (code, "no_such_can" in said) == (2, True)


def hub(server: ForkServer) -> Process:
    """A process that runs until it is told to end."""
    process = Process("hub", forked(server, "hub", "--listen", "127.0.0.1:0"), None)
    while not process.said("listening on "):
        assert select.select([process], [], [], PATIENCE_S)[0]
        assert process.listen(), process.obituary()
    return process


def test_it_runs_until_it_is_told_or_killed(server: ForkServer) -> None:
    told, killed = hub(server), hub(server)
    assert (told.code, killed.code) == (None, None)
    told.wait(0.01)
    told.tell(signal.SIGTERM)
    killed.tell(signal.SIGKILL)
    for process in (told, killed):
        while process.code is None:
            process.wait(PATIENCE_S)
        process.tell(signal.SIGTERM)  # nothing happens
        process.close()
    assert (told.code, killed.code) == (0, -signal.SIGKILL)


def test_it_has_a_session_of_its_own_and_shows_its_arguments(server: ForkServer) -> None:
    process = hub(server)
    words = Path(f"/proc/{process.pid}/cmdline").read_bytes().rstrip(b"\0").split(b"\0")
    assert words == [b"exo-hil", b"hub", b"--listen", b"127.0.0.1:0"]
    assert Path(f"/proc/{process.pid}/comm").read_text() == "exo-hil hub\n"
    assert os.getsid(process.pid) == process.pid
    process.close()
    assert not is_alive(process.pid)


def test_nothing_is_open_in_it_but_its_output(server: ForkServer) -> None:
    """Descriptors that a process inherits stay open as long as it lives: buses, control sockets, pipes of others."""
    first, second = hub(server), hub(server)
    places = [os.readlink(f"/proc/{second.pid}/fd/{number}") for number in (0, 1, 2)]
    assert places[0] == "/dev/null"
    assert places[1] == places[2]
    assert places[1].startswith("pipe:")
    pipes = {os.readlink(one.path) for one in os.scandir(f"/proc/{first.pid}/fd")}
    assert places[1] not in pipes
    others = [os.readlink(one.path) for one in os.scandir(f"/proc/{second.pid}/fd")]
    assert not [place for place in others if place.startswith("pipe:") and place != places[1]]
    first.close()
    second.close()


def test_the_process_that_forks_has_one_thread(server: ForkServer) -> None:
    """What else threads hold at that moment, locks above all, a forked process would never get."""
    outcome(forked(server, "--version"))
    assert "\nThreads:\t1\n" in Path(f"/proc/{server.pid}/status").read_text()


def test_a_server_that_is_killed_is_followed_by_another_one(monkeypatch: pytest.MonkeyPatch) -> None:
    """What it has forked counts as running for as long as it does; how it has ended nobody can tell then."""
    monkeypatch.setattr(fork_server, "_SHARED", [])
    first = fork_server.shared()
    assert first is not None
    assert fork_server.shared() is first
    process, other = hub(first), hub(first)
    os.kill(first.pid, signal.SIGKILL)
    process.wait(0.1)
    codes = [process.code]  # told to end is one that has --supervisor
    os.kill(process.pid, signal.SIGTERM)
    process.wait(PATIENCE_S)
    assert [*codes, process.code] == [None, -signal.SIGHUP]
    process.close()
    other.close()
    assert other.code is not None
    assert first.fork(["--version"]) is None
    second = fork_server.shared()
    assert second is not None
    assert second is not first
    assert outcome(forked(second, "--version"))[1] == 0
    second.close()


def test_a_server_that_would_find_other_packages_is_replaced(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Where an interpreter looks for packages is settled as it starts: fault types of users are among them."""
    monkeypatch.setattr(fork_server, "_SHARED", [])
    first = fork_server.shared()
    assert first is not None
    process = hub(first)
    (tmp_path / "numpy.py").write_text("raise ImportError('there is no numpy here')\n")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    second = fork_server.shared()
    assert second is not None
    assert second is not first
    said, code = outcome(forked(second, "check", str(EXAMPLE)))
    assert (code, "there is no numpy here" in said) == (3, True)
    assert process.code is None  # of a rig that was there before
    for server in (first, second):
        server.close()
    process.close()


def test_signals_to_everybody_are_not_for_the_server(server: ForkServer) -> None:
    """As a service manager sends them to all processes of a service: each of the others ends by itself, in order."""
    outcome(forked(server, "--version"))
    for number in (signal.SIGTERM, signal.SIGINT, signal.SIGHUP):
        os.kill(server.pid, number)
    process = hub(server)
    assert server.is_there
    process.tell(signal.SIGINT)
    process.wait(PATIENCE_S)
    process.close()
    assert process.code == 0


def test_who_is_interrupted_while_he_waits_gets_no_process(server: ForkServer) -> None:
    """The server may take its time: a signal to whoever asks is heard meanwhile."""
    outcome(forked(server, "--version"))
    os.kill(server.pid, signal.SIGSTOP)

    def interrupt() -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        server.fork(["hub", "--listen", "127.0.0.1:0"], interrupt)
    os.kill(server.pid, signal.SIGCONT)
    assert outcome(forked(server, "--version"))[1] == 0
    deadline = time.monotonic() + PATIENCE_S
    while descendants_of(server.pid) and time.monotonic() < deadline:
        time.sleep(0.01)
    assert descendants_of(server.pid) == []


def test_all_end_with_the_program_that_asked() -> None:
    """Also when it is killed, and a forked copy of it lives on: the kernel closes its socket, the server ends, and that
    is told to what it has forked.
    """
    program = (
        "import os, sys, time; from testbench.fork_server import shared; server = shared()\n"
        "given = ['hub', '--listen', '127.0.0.1:0', '--supervisor', str(server.pid)]\n"
        "one = server.fork(given); said = one.stdout.readline().decode().split()[0]\n"
        "copy = os.fork()\n"
        "if copy: print(said); print(server.pid, one.pid, copy)\n"
        "else: assert shared() is not server\n"
        "sys.stdout.flush(); time.sleep(600)"
    )
    with subprocess.Popen([sys.executable, "-c", program], stdout=subprocess.PIPE, text=True) as asking:
        assert asking.stdout is not None
        assert asking.stdout.readline() == "listening\n"
        pids = [int(word) for word in asking.stdout.readline().split()]
        assert all(map(is_alive, pids))
        asking.kill()
        left = [pid for pid in pids[:2] if not ended(pid, PATIENCE_S)]
        for pid in (*left, pids[2]):
            os.kill(pid, signal.SIGKILL)
    assert not left


def test_a_request_that_is_cut_off_ends_the_server() -> None:
    server = ForkServer()
    server._socket.sendall(b"\1\0")
    server._socket.shutdown(1)
    assert server._running.wait(PATIENCE_S) == 0
    assert not server.is_there
    assert server.fork(["--version"]) is None
    server.close()


def test_a_working_directory_that_was_removed_is_no_obstacle(
    server: ForkServer, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = tmp_path / "gone"
    folder.mkdir()
    monkeypatch.chdir(folder)
    folder.rmdir()
    assert outcome(forked(server, "--version"))[1] == 0


def test_what_takes_longest_to_import_has_been_imported() -> None:
    """Else each of the processes would take its time for it."""
    program = (
        "import importlib, json, sys; from testbench.fork_server import MODULES\n"
        "for name in MODULES: importlib.import_module(name)\n"
        "print(json.dumps(sorted(sys.modules)))"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    found = set(json.loads(done.stdout))
    assert {"mujoco", "numpy", "yaml", "canopen", "testbench.cli_rig", "testbench.process"} <= found
