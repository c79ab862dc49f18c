"""A process of the rig as its supervisor sees it: started, heard, told, and mourned with its last words.

Each is a session of its own, so that Ctrl-C reaches the supervisor alone. (testbench.process is what runs in it.)
"""

import contextlib
import os
import signal
import subprocess
import sys
from collections import deque
from collections.abc import Callable
from typing import IO, Final, Protocol, final

from testbench.errors import BenchError

_LAST_LINES: Final = 12


class ProcessError(BenchError):
    """A process did not become ready, or ended unasked; the message has its last lines."""


class Running(Protocol):
    """What there is to a process that was started, as in `subprocess.Popen`."""

    @property
    def pid(self) -> int:
        """Its process id."""

    @property
    def stdout(self) -> IO[bytes] | None:
        """Its output."""

    def poll(self) -> int | None:
        """Exit code, -N when signal N killed it; None while it runs."""

    def wait(self, timeout: float | None = None) -> int:
        """The same at its end; raises TimeoutExpired when that takes longer [s]."""

    def send_signal(self, sig: int) -> None:
        """Nothing happens when it has ended."""


def execute(arguments: list[str]) -> Running:
    """`exo-hil` with these arguments, from nothing."""
    return subprocess.Popen(
        [sys.executable, "-P", "-m", "testbench.cli", *arguments],
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        start_new_session=True,
    )


@final
class Process:
    """A running process. name: hub or one of PARTS; lines: the last ones it printed. Its output is read by `listen`.

    say: told each line as it comes, None where nobody shows them.
    """

    def __init__(self, name: str, running: Running, say: Callable[[str], None] | None) -> None:
        self.name: Final[str] = name
        self.lines: Final[deque[str]] = deque(maxlen=_LAST_LINES)
        self.is_told: bool = False
        self._first: Final[list[str]] = []
        self._say: Final[Callable[[str], None] | None] = say
        self._rest: bytes = b""
        self._is_closed: bool = False
        self._running: Final[Running] = running
        os.set_blocking(self.fileno(), False)

    @property
    def pid(self) -> int:
        """Its process id."""
        return self._running.pid

    def wait(self, timeout_s: float) -> None:
        """Until it ends, at most that long."""
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._running.wait(timeout_s)

    @property
    def code(self) -> int | None:
        """Exit code, -N when signal N killed it; None while it runs."""
        return self._running.poll()

    def fileno(self) -> int:
        """Of its output."""
        assert self._running.stdout is not None
        return self._running.stdout.fileno()

    def listen(self) -> bool:
        """Take what it has printed; False when there will be no more."""
        while not self._is_closed:
            try:
                data = os.read(self.fileno(), 1 << 14)
            except BlockingIOError:
                return True
            *lines, self._rest = (self._rest + data).split(b"\n")
            if not data and self._rest:
                lines.append(self._rest)
                self._rest = b""
            for line in lines:
                text = line.decode(errors="replace").rstrip()
                self.lines.append(text)
                if len(self._first) < _LAST_LINES:
                    self._first.append(text)
                if self._say is not None:
                    self._say(text)
            if not data:
                return False
        return False

    def said(self, start: str) -> str:
        """The rest of the first line it printed with that start; "" when none of its first and last lines has it."""
        for line in (*self._first, *self.lines):
            if line.startswith(start):
                return line.removeprefix(start)
        return ""

    def tell(self, number: int) -> None:
        """Send it a signal; from now on its end is expected."""
        self.is_told = True
        with contextlib.suppress(ProcessLookupError):
            self._running.send_signal(number)

    def close(self) -> None:
        """Kill what is left of it."""
        if self.code is None:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(self.pid, signal.SIGKILL)
            self._running.send_signal(signal.SIGKILL)  # also when it has no session of its own yet
        self._running.wait()
        self.listen()
        self._is_closed = True
        assert self._running.stdout is not None
        self._running.stdout.close()

    def obituary(self) -> str:
        """How it ended, and what it said last, unless that was shown when it was said."""
        code = self.code
        if not self._is_closed:
            self.listen()
        if code is None:
            how = "is running"
        elif code < 0:
            how = f"was killed by {signal.Signals(-code).name}"
        else:
            how = f"ended with exit code {code}"
        said = "" if self._say is not None else "".join(f"\n  {line}" for line in self.lines)
        return f"{self.name} {how}{'; its last lines:' + said if said else ''}"
