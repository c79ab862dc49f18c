"""Where the processes of a rig are forked: what all of them import is imported once, so that a rig is soon up.

A process of its own, started by the first rig of a program and ended with it (end of file on their socket). It has one
thread and nothing open but that socket: a program in the middle of its work has more, and must not fork itself.
A forked process is as one started by `exo-hil` with these arguments: in a session of its own, with the environment and
the working directory of whoever asks, nothing to read and its output in a pipe. `ps` shows it by its arguments.
When this process ends, so do those that it has forked (`process.die_with`), and with the same signal.
Linux alone; elsewhere each process is started from nothing (`child.execute`).

On the socket: a request is its length (4 bytes, with the descriptor of the output) and JSON; an answer is a line of
JSON, {"pid"} for a process that was forked, {"pid", "code"} for one that has ended.
"""

import atexit
import contextlib
import ctypes
import gc
import importlib
import json
import os
import select
import signal
import socket
import struct
import subprocess
import sys
import traceback
from typing import IO, Final, Never, TypedDict, final

MODULES: Final = (
    "testbench.scenario",
    "testbench.gateway_process",
    "testbench.parts",
    "testbench.rig",
    "testbench.run",
    "joint_emulators.plant",
    "hlc.node",
    "canopen",
    "testbench.cli",
    "testbench.fault_file",
    "canopen_exo.bus.hub_client",
    "canopen_exo.bus.socketcan",
)
"""What joints, gateway and controller import, the most of it only where they need it."""

_LENGTH: Final = struct.Struct("=I")
_TITLE_ROOM: Final = 512
"""Bytes that a process has for its arguments as `ps` shows them."""

_PR_SET_NAME: Final = 15  # prctl(2)
_ARGUMENTS_AT: Final = 45  # proc(5), /proc/PID/stat: arg_start is the 48th field, the 46th after the name
_END_S: Final = 2.0
_GONE: Final = -signal.SIGHUP if sys.platform != "win32" else -1
"""Exit code of processes whose server is gone: they get that signal, and nobody can tell what became of it."""


class _Request(TypedDict):
    arguments: list[str]
    environment: dict[str, str]
    folder: str


# --- whoever asks ----------------------------------------------------------------------------------------------------


@final
class Forked:
    """A process that was forked for us. stdout: its output, to be closed by the caller."""

    def __init__(self, server: "ForkServer", pid: int, stdout: IO[bytes]) -> None:
        self.pid: Final[int] = pid
        self.stdout: Final[IO[bytes]] = stdout
        self._server: Final[ForkServer] = server

    def poll(self) -> int | None:
        """Exit code, -N when signal N killed it; None while it runs."""
        return self._server.code(self.pid, 0.0)

    def wait(self, timeout: float | None = None) -> int:
        """The same at its end; raises TimeoutExpired when that takes longer [s]."""
        code = self._server.code(self.pid, timeout)
        if code is None:
            raise subprocess.TimeoutExpired(f"process {self.pid}", timeout or 0.0)
        return code

    def send_signal(self, sig: int) -> None:
        """Nothing happens when it has ended."""
        if self.poll() is None:
            os.kill(self.pid, sig)


@final
class ForkServer:
    """The process that forks, as seen by the one that has started it. owner: that one's process id; pid: its own."""

    def __init__(self) -> None:
        self.owner: Final[int] = os.getpid()
        here, there = socket.socketpair()
        with there:
            self._running: Final = subprocess.Popen(
                [sys.executable, "-P", "-m", "testbench.fork_server", str(there.fileno()), " " * _TITLE_ROOM],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL,
                pass_fds=[there.fileno()],
                start_new_session=True,
                env={**os.environ, "OPENBLAS_NUM_THREADS": "1"},  # a process with threads must not fork
            )
        self.pid: Final[int] = self._running.pid
        self._socket: Final[socket.socket] = here
        self._rest: bytes = b""
        self._codes: Final[dict[int, int | None]] = {}
        self._newest: int = 0
        self._is_gone: bool = False

    @property
    def is_there(self) -> bool:
        """Whether it runs, and is ours."""
        self._listen(0.0)
        return not self._is_gone and self.owner == os.getpid()

    def fork(self, arguments: list[str]) -> Forked | None:
        """A process of `exo-hil` with these arguments, after the time it takes to import; None: it cannot be had."""
        request = _Request(arguments=arguments, environment=dict(os.environ), folder=os.getcwd())
        body = json.dumps(request).encode()
        reading, writing = os.pipe()
        output = open(reading, "rb", buffering=0)  # noqa: SIM115 - it goes on with the process
        self._newest = 0
        try:
            socket.send_fds(self._socket, [_LENGTH.pack(len(body))], [writing])
            self._socket.sendall(body)
        except OSError:
            self._is_gone = True
        finally:
            os.close(writing)
        while not self._newest and not self._is_gone:
            self._listen(None)
        if not self._newest:
            output.close()
            return None
        return Forked(self, self._newest, output)

    def code(self, pid: int, timeout_s: float | None) -> int | None:
        """Exit code of one it has forked, after waiting so long at most; None while that runs."""
        self._listen(0.0)
        while self._codes[pid] is None and not self._is_gone and (timeout_s is None or timeout_s > 0.0):
            self._listen(timeout_s)
            if timeout_s is not None:  # an end of another one also ends the waiting
                break
        return _GONE if self._codes[pid] is None and self._is_gone else self._codes[pid]

    def close(self) -> None:
        """End it; what it has forked ends too."""
        self._is_gone = True
        self._socket.close()
        if self.owner == os.getpid():
            with contextlib.suppress(subprocess.TimeoutExpired):
                self._running.wait(_END_S)

    def _listen(self, timeout_s: float | None) -> None:
        """Take what it answers, waiting so long for the first of it."""
        if self._is_gone or not select.select([self._socket], [], [], timeout_s)[0]:
            return
        try:
            data = self._socket.recv(1 << 16)
        except OSError:
            data = b""
        if not data:
            self._is_gone = True
        *lines, self._rest = (self._rest + data).split(b"\n")
        for line in lines:
            answer = json.loads(line)
            self._codes[answer["pid"]] = answer.get("code")
            if "code" not in answer:
                self._newest = answer["pid"]


_SHARED: Final[list[ForkServer]] = []


def shared() -> ForkServer | None:
    """That of this program, started when there is none; it imports meanwhile. None where there cannot be one."""
    if sys.platform != "linux":
        return None
    if _SHARED and not _SHARED[0].is_there:
        _SHARED.pop().close()
    if not _SHARED:
        _SHARED.append(ForkServer())
        atexit.register(_SHARED[0].close)
    return _SHARED[0]


# --- the process that forks ------------------------------------------------------------------------------------------


def serve(asking: socket.socket) -> None:
    """Fork what is asked for, and tell who has ended, until nobody asks any more."""
    for name in MODULES:
        with contextlib.suppress(ImportError):  # the process that needs it says what is missing
            importlib.import_module(name)
    gc.collect()
    gc.freeze()
    wake, waker = socket.socketpair()
    wake.setblocking(False)
    waker.setblocking(False)
    signal.set_wakeup_fd(waker.fileno(), warn_on_full_buffer=False)
    signal.signal(signal.SIGCHLD, lambda number, frame: None)
    while True:
        readable = select.select([asking, wake], [], [])[0]
        if wake in readable:
            wake.recv(1 << 10)
        if asking in readable:
            request = _received(asking)
            if request is None:
                return
            pid = os.fork()
            if pid == 0:
                for one in (asking, wake, waker):
                    one.close()
                _live(*request)
            os.close(request[1])
            _answer(asking, {"pid": pid})
        with contextlib.suppress(ChildProcessError):
            while (ended := os.waitpid(-1, os.WNOHANG))[0]:
                _answer(asking, {"pid": ended[0], "code": os.waitstatus_to_exitcode(ended[1])})


def _received(asking: socket.socket) -> tuple[_Request, int] | None:
    """What is asked for and where the output goes; None at the end."""
    head, descriptors, _, _ = socket.recv_fds(asking, _LENGTH.size, 1)
    if len(head) < _LENGTH.size or not descriptors:
        return None
    left = _LENGTH.unpack(head)[0]
    body = bytearray()
    while left > len(body):
        data = asking.recv(left - len(body))
        if not data:
            return None
        body += data
    return json.loads(body), descriptors[0]


def _answer(asking: socket.socket, answer: dict[str, int]) -> None:
    with contextlib.suppress(OSError):  # whoever asked is gone: the next look says so
        asking.sendall(json.dumps(answer).encode() + b"\n")


def _live(request: _Request, output: int) -> Never:
    """Be the process that was asked for."""
    code = 1
    try:
        signal.set_wakeup_fd(-1)
        signal.signal(signal.SIGCHLD, signal.SIG_DFL)
        os.setsid()
        for stream in (1, 2):
            os.dup2(output, stream)
        os.close(output)
        os.environ.clear()
        os.environ.update(request["environment"])
        os.chdir(request["folder"])
        _rename(request["arguments"])
        from testbench.cli import main

        code = main(request["arguments"])
    except SystemExit as error:
        code = error.code if isinstance(error.code, int) else 1
    except BaseException:  # noqa: BLE001 - as the interpreter does at the end of a program
        traceback.print_exc()
    finally:
        with contextlib.suppress(OSError, ValueError):
            sys.stdout.flush()
        with contextlib.suppress(OSError, ValueError):
            sys.stderr.flush()
        os._exit(code)


def _rename(arguments: list[str]) -> None:
    """Show what this process does: over the arguments in memory, of which proc(5) and `ps` give the words."""
    with contextlib.suppress(OSError, ValueError):
        ctypes.CDLL(None).prctl(_PR_SET_NAME, f"exo-hil {arguments[0]}".encode(), 0, 0, 0)
        with open("/proc/self/stat", "rb") as stat:
            fields = stat.read().rpartition(b")")[2].split()
        start, end = int(fields[_ARGUMENTS_AT]), int(fields[_ARGUMENTS_AT + 1])
        words = b"\0".join(os.fsencode(one) for one in ("exo-hil", *arguments))[: end - start - 1]
        if start and end - start > _TITLE_ROOM:
            ctypes.memmove(start, words.ljust(end - start, b"\0"), end - start)


if __name__ == "__main__":
    with socket.socket(fileno=int(sys.argv[1])) as asked_on:
        serve(asked_on)
