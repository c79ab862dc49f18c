"""Our own programs as processes, as a user starts them; none of them outlives its test."""

import os
import signal
import subprocess
import sys
from pathlib import Path
from typing import Final, final

import can

from tests.parity.walks import Bench
from tests.vcan.inside.peers import LIMIT_S, python_can, wait_until

VCAN: Final = Bench(("socketcan:vcan0", "socketcan:vcan1"), 50, fifo=True)
"""50 Hz, the slowest rate of the rig, and real-time scheduling: in User Mode Linux all processes share one virtual CPU,
a system call costs some 20 us, and the scheduler changes to another process 100 times a second."""

END_S: Final = 30.0
"""Most that a program may take to end in order."""


@final
class Program:
    """`exo-hil ARGUMENTS...`, running; folder: for what it prints."""

    def __init__(self, arguments: list[str], folder: Path) -> None:
        self._printed: Final = folder / f"{arguments[0]}.txt"
        environment = {**os.environ, "MPLCONFIGDIR": str(folder)}
        with self._printed.open("wb") as file:
            self._process: Final = subprocess.Popen(
                [sys.executable, "-P", "-m", "testbench.cli", *arguments],
                stdin=subprocess.DEVNULL,
                stdout=file,
                stderr=subprocess.STDOUT,
                env=environment,
            )

    @property
    def pid(self) -> int:
        """Its process id."""
        return self._process.pid

    @property
    def code(self) -> int | None:
        """Exit code; None while it runs."""
        return self._process.poll()

    @property
    def printed(self) -> str:
        """What it has printed so far."""
        return self._printed.read_text(errors="replace")

    def says(self, words: str) -> None:
        """Wait until it has said that."""
        wait_until(lambda: words in self.printed or self.code is not None, f"it says {words!r}")
        assert words in self.printed, self.printed

    def tell(self, number: int) -> None:
        """Send it a signal, unless it has ended."""
        self._process.send_signal(number)

    def end(self, number: int = signal.SIGTERM) -> int:
        """Send it a signal, wait, and give its exit code."""
        self.tell(number)
        return self.wait()

    def wait(self, limit_s: float = END_S) -> int:
        """Its exit code, when it ends by itself."""
        return self._process.wait(limit_s)

    def close(self) -> None:
        """Kill what is left of it."""
        if self.code is None:
            self._process.kill()
            self._process.wait()


def await_passage(gateway: Program, near: str, far: str) -> None:
    """Until the gateway passes frames between two interfaces: asked by frames, both ways. Leaves none behind."""
    with python_can(near) as near_bus, python_can(far) as far_bus:
        for sender, receiver in ((near_bus, far_bus), (far_bus, near_bus)):
            probe = can.Message(arbitration_id=0x7E0, is_extended_id=False)
            for _ in range(int(LIMIT_S / 0.05)):
                assert gateway.code is None, gateway.printed
                sender.send(probe)
                if receiver.recv(0.05) is not None:
                    break
            else:
                raise AssertionError(f"no frame came through: {gateway.printed}")
        flush(near_bus, far_bus)
        flush(far_bus, near_bus)


def flush(sender: can.BusABC, receiver: can.BusABC) -> list[can.Message]:
    """Send a last frame through; what the receiver has before it."""
    last = can.Message(arbitration_id=0x7E5, is_extended_id=False, data=[14])
    sender.send(last)
    found: list[can.Message] = []
    while True:
        message = receiver.recv(LIMIT_S)
        assert message is not None, f"the last frame did not come through; before it: {found}"
        if message.arbitration_id == 0x7E5:
            return found
        found.append(message)


def our_processes() -> list[str]:
    """Command lines of our programs that run in this network namespace."""
    found = []
    mine = os.readlink("/proc/self/ns/net")
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit():
            try:
                if os.readlink(entry / "ns/net") != mine:
                    continue
                words = (entry / "cmdline").read_bytes().split(b"\0")
            except OSError:  # it ended, or is not ours to look at
                continue
            if b"testbench.cli" in words or words[0] == b"exo-hil":  # as `ps` shows those that were forked
                found.append(b" ".join(words).decode(errors="replace"))
    return found
