"""`exo-hil up`: a rig that walks until it is told to stop, with a status line where there is a terminal."""

import sys
from typing import Final

from canopen_exo.talk import tell
from testbench.child import ProcessError
from testbench.gateway_process import active_faults
from testbench.status import StatusLine
from testbench.supervisor import Setup, Supervisor, check_status_readers

PASS: Final = 0


def run_up(setup: Setup) -> int:
    """Start the rig and keep it until Ctrl-C or SIGTERM, which is its normal end (0). Raises BenchError."""
    check_status_readers(setup)
    line: StatusLine | None = None

    is_over = False

    def announce(text: str) -> None:
        if line is not None:
            line.clear()
        tell(text)

    def say(text: str) -> None:
        if not is_over:
            announce(text)

    def show(now: int) -> None:
        if line is not None:
            line.show(now)

    try:
        with Supervisor(setup, say, show, announce=announce) as rig:
            rig.start()
            for what, bus in zip(("controller bus", "drive bus"), rig.buses, strict=True):
                say(f"{what}: {bus}")
            address = rig.control_address
            if address:
                say(f"live control: exo-hil fault list --at {address}")
            say("running; Ctrl-C stops")
            line = StatusLine(rig.watch, sys.stderr, lambda: active_faults(address) if address else [])
            try:
                rig.run(lambda now: False)
            except ProcessError:
                is_over = True  # who died and why comes last, and not before pages of statistics
                raise
    except KeyboardInterrupt:
        if line is not None:
            line.clear()
        tell("stopped")
    return PASS
