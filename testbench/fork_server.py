"""Where the processes of a rig are forked: what all of them import is imported once, so that a rig is soon up.

A process of its own, started by the first rig of a program and ended with it (end of file on their socket). It has one
thread and nothing open but that socket: a program in the middle of its work has more, and must not fork itself. One for
each program, kept for its next rigs (`shared`).
A forked process is as one started by `exo-hil` with these arguments: in a session of its own, with the environment and
the working directory of whoever asks, nothing to read and its output in a pipe. `ps` shows it by its arguments. What
else a process inherits (umask, limits, processors) is that of the time at which the server was started.
When the server ends, so do those that it has forked (`process.die_with`), and with the same signal.
Linux alone; elsewhere each process is started from nothing (`child.execute`).

On the socket: a request is its length (4 bytes, with the descriptor of the output) and JSON; an answer is a line of
JSON, {"pid"} with a pidfd (pidfd_open(2)) for a process that was forked, {"pid": 0} when there is none to be had,
{"pid", "code"} for one that has ended.
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
import time
from collections.abc import Callable
from typing import IO, Final, TypedDict, final

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
IGNORED: Final = (
    (signal.SIGINT, signal.SIGTERM) if sys.platform == "win32" else (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
)
"""A signal to all processes of a service is for those that were forked, and for whoever asked: that ends this one."""

_ANSWER_S: Final = 0.02
"""How long a look for an answer takes when there is none."""

_READY_S: Final = 30.0
"""Most that it may take to import everything, on a machine that may be busy."""

_TOLD_S: Final = 5.0
"""Most that the exit code of a process may come after its end."""

_GONE: Final = -signal.SIGHUP if sys.platform != "win32" else -1
"""Exit code of processes whose server is gone: they get that signal, and nobody can tell what became of it."""


class _Request(TypedDict):
    arguments: list[str]
    environment: dict[str, str]
    folder: str  # "" for that of the server


# --- whoever asks ----------------------------------------------------------------------------------------------------


@final
class Forked:
    """A process that was forked for us. stdout: its output, to be closed by the caller."""

    def __init__(self, server: "ForkServer", pid: int, pidfd: int, stdout: IO[bytes]) -> None:
        self.pid: Final[int] = pid
        self.stdout: Final[IO[bytes]] = stdout
        self._server: Final[ForkServer] = server
        self._pidfd: int = pidfd
        self._code: int | None = None

    def poll(self) -> int | None:
        """Exit code, -N when signal N killed it; None while it runs."""
        return self._ended(0.0)

    def wait(self, timeout: float | None = None) -> int:
        """The same at its end; raises TimeoutExpired when that takes longer [s]."""
        code = self._ended(timeout)
        if code is None:
            raise subprocess.TimeoutExpired(f"process {self.pid}", timeout or 0.0)
        return code

    def send_signal(self, sig: int) -> None:
        """Nothing happens when it has ended."""
        if self.poll() is None:
            signal.pidfd_send_signal(self._pidfd, sig)  # never to another process with its number

    def _ended(self, timeout_s: float | None) -> int | None:
        if self._code is None and select.select([self._pidfd], [], [], timeout_s)[0]:
            self._code = self._server.code(self.pid)
            os.close(self._pidfd)
        return self._code


@final
class ForkServer:
    """The process that forks, as seen by the one that has started it. owner: that one's process id; pid: its own."""

    def __init__(self) -> None:
        self.owner: Final[int] = os.getpid()
        self._switches: Final[dict[str, str]] = _switches()
        self._folder: Final[str] = _working_folder()
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
        self._codes: Final[dict[int, int]] = {}
        self._answers: Final[list[tuple[int, int]]] = []  # process id, 0 for none, and pidfd
        self._unwanted: int = 0
        self._is_gone: bool = False

    @property
    def is_there(self) -> bool:
        """Whether it is ours, has been started as it would be now, and runs."""
        return self.owner == os.getpid() and self._switches == _switches() and not self.is_gone

    @property
    def is_gone(self) -> bool:
        """Whether it has ended."""
        self._listen(0.0)
        return self._is_gone

    def obituary(self) -> str:
        """How it ended, in words."""
        code = self._running.poll()
        how = "is gone" if code is None else f"ended with exit code {code}"
        if code is not None and code < 0:
            how = f"was killed by {signal.Signals(-code).name}"
        return f"testbench.fork_server (process {self.pid}) {how}, and joints, gateway and controller end with it"

    def fork(self, arguments: list[str], idle: Callable[[], None] | None = None) -> Forked | None:
        """A process of `exo-hil` with these arguments; None: it cannot be had.

        idle: called again and again while the server imports; when it raises, there will be no such process.
        """
        reading, writing = os.pipe()
        try:
            try:
                self._ask(arguments, writing)
            finally:
                os.close(writing)
            limit = time.monotonic() + _READY_S
            while not self._answers and not self._is_gone:
                if time.monotonic() > limit:
                    self.close()
                elif idle is not None:
                    idle()
                self._listen(0.0 if idle is not None else _ANSWER_S)
        except BaseException:
            os.close(reading)
            self._unwanted += 1
            raise
        pid, pidfd = self._answers.pop() if self._answers else (0, -1)
        if pid == 0:
            os.close(reading)
            return None
        return Forked(self, pid, pidfd, open(reading, "rb", buffering=0))

    def code(self, pid: int) -> int:
        """Exit code of one that has ended."""
        limit = time.monotonic() + _TOLD_S
        while pid not in self._codes and not self._is_gone and time.monotonic() < limit:
            self._listen(_ANSWER_S)
        return self._codes.pop(pid, _GONE)

    def close(self) -> None:
        """End it; what it has forked ends too."""
        self._is_gone = True
        self._socket.close()
        if self.owner == os.getpid():
            with contextlib.suppress(KeyboardInterrupt):  # at the end of a program, too
                self._running.kill()
                self._running.wait()

    def let_go(self) -> None:
        """In a forked copy of the program: the server is that of the original alone, and ends with it."""
        self._is_gone = True
        self._socket.close()

    def _ask(self, arguments: list[str], output: int) -> None:
        folder = _working_folder()
        request = _Request(
            arguments=arguments,
            environment=dict(os.environ),
            folder="" if folder == self._folder else folder,
        )
        body = json.dumps(request).encode()
        try:
            socket.send_fds(self._socket, [_LENGTH.pack(len(body))], [output])
            self._socket.sendall(body)
        except OSError:
            self._is_gone = True

    def _listen(self, timeout_s: float) -> None:
        """Take what it answers, waiting so long for the first of it."""
        if self._is_gone or not select.select([self._socket], [], [], timeout_s)[0]:
            return
        descriptors: list[int] = []
        try:
            data, descriptors, _, _ = socket.recv_fds(self._socket, 1 << 16, 1)
        except OSError:
            data = b""
        if not data:
            self._is_gone = True
        *lines, self._rest = (self._rest + data).split(b"\n")
        for line in lines:
            answer = json.loads(line)
            if "code" in answer:
                self._codes[answer["pid"]] = answer["code"]
            else:
                self._take(answer["pid"], descriptors[0] if descriptors else -1)

    def _take(self, pid: int, pidfd: int) -> None:
        """A process that was asked for."""
        if pid:
            os.set_inheritable(pidfd, False)
        if not self._unwanted:
            self._answers.append((pid, pidfd))
            return
        self._unwanted -= 1
        if pid:
            signal.pidfd_send_signal(pidfd, signal.SIGKILL)
            os.close(pidfd)


def _working_folder() -> str:
    """The working directory; "" when it was removed."""
    try:
        return os.getcwd()
    except OSError:
        return ""


def _switches() -> dict[str, str]:
    """What an interpreter reads once, as it starts: where it finds packages, above all."""
    return {name: value for name, value in os.environ.items() if name.startswith("PYTHON")}


_SHARED: Final[list[ForkServer]] = []


def shared() -> ForkServer | None:
    """That of this program, started when there is none; it imports meanwhile. None where there cannot be one."""
    if sys.platform != "linux":
        return None
    if _SHARED and not _SHARED[0].is_there:
        last = _SHARED.pop()
        if last.is_gone:
            last.close()  # else a rig of it may run
    if not _SHARED:
        try:
            server = ForkServer()
        except OSError:  # no process or no descriptor to be had
            return None
        _SHARED.append(server)
        atexit.register(server.close)
        os.register_at_fork(after_in_child=server.let_go)
    return _SHARED[0]


# --- the process that forks ------------------------------------------------------------------------------------------


def serve(asking: socket.socket) -> _Request | None:
    """Fork what is asked for, and tell who has ended, until nobody asks any more.

    Returns None then; and in each forked process what that is to be.
    """
    _import_all()
    wake, waker = socket.socketpair()
    wake.setblocking(False)
    waker.setblocking(False)
    signal.set_wakeup_fd(waker.fileno(), warn_on_full_buffer=False)
    signal.signal(signal.SIGCHLD, lambda number, frame: None)
    with wake, waker:
        while True:
            readable = select.select([asking, wake], [], [])[0]
            if wake in readable:
                wake.recv(1 << 10)
            if asking in readable:
                asked = _received(asking)
                if asked is None:
                    return None
                request, output = asked
                pid = _forked(asking)
                if pid == 0:
                    signal.set_wakeup_fd(-1)
                    _begin(output)
                    return request
                os.close(output)
            with contextlib.suppress(ChildProcessError):
                while (ended := os.waitpid(-1, os.WNOHANG))[0]:
                    _answer(asking, {"pid": ended[0], "code": os.waitstatus_to_exitcode(ended[1])})


def _import_all() -> None:
    """And have the collector leave it alone: what it touches is copied for every process."""
    for name in MODULES:
        with contextlib.suppress(Exception):  # the process that needs it says what is missing
            importlib.import_module(name)
    gc.collect()
    gc.freeze()


def _forked(asking: socket.socket) -> int:
    """Fork, and answer; 0 in the new process, -1 when there is none to be had."""
    try:
        pid = os.fork()
    except OSError:
        _answer(asking, {"pid": 0})
        return -1
    if pid:
        try:
            pidfd = os.pidfd_open(pid)
        except OSError:  # before Linux 5.3, or no descriptor is left
            os.kill(pid, signal.SIGKILL)
            _answer(asking, {"pid": 0})
            return -1
        _answer(asking, {"pid": pid}, pidfd)
        os.close(pidfd)
    return pid


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


def _answer(asking: socket.socket, answer: dict[str, int], *descriptors: int) -> None:
    with contextlib.suppress(OSError):  # whoever asked is gone: the next look says so
        socket.send_fds(asking, [json.dumps(answer).encode() + b"\n"], list(descriptors))


def _begin(output: int) -> None:
    """Be a process of its own, with its output there, and open to signals as one that was just started."""
    os.setsid()
    for number in IGNORED:
        signal.signal(number, signal.default_int_handler if number == signal.SIGINT else signal.SIG_DFL)
    signal.signal(signal.SIGCHLD, signal.SIG_DFL)
    for stream in (1, 2):
        os.dup2(output, stream)
    os.close(output)


def live(request: _Request) -> int:
    """Be the process that was asked for; its exit code."""
    os.environ.clear()
    os.environ.update(request["environment"])
    if request["folder"]:
        os.chdir(request["folder"])
    _rename(request["arguments"])
    from testbench.cli import main

    return main(request["arguments"])


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
    for one in IGNORED:
        signal.signal(one, signal.SIG_IGN)
    with socket.socket(fileno=int(sys.argv[1])) as asked_on:
        wanted = serve(asked_on)
    if wanted is not None:
        sys.exit(live(wanted))
