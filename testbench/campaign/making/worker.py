"""A process that makes one run after another, for whoever started it, and ends with him.

What it is told comes over a pipe: a RunSpec, or None to end; what it answers is its code version once, when it is
ready, and then a row, or the text of an exception, for every RunSpec. It ignores Ctrl-C, which is for the one who
started it. When that one is gone, however, it ends at once, in the middle of a run: nobody would read the row.
"""

import importlib
import os
import signal
import sys
import threading
import traceback
from collections.abc import Callable
from dataclasses import dataclass
from multiprocessing import parent_process
from multiprocessing.connection import Connection, wait
from typing import Final

from testbench.campaign.making.executor import FolderError
from testbench.campaign.making.identity import code_version
from testbench.campaign.records import RunRow, RunSpec

MakeRun = Callable[[RunSpec], RunRow]

DEFAULT: Final = "testbench.campaign.making.worker:run_maker"
"""Where the function that makes runs comes from: MODULE:FUNCTION, which is called once in every process."""

ONE_THREAD: Final = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "VECLIB_MAXIMUM_THREADS")
"""What linear algebra libraries read: the processes are the parallelism, threads in them would only be in the way."""

LINES: Final = 6
"""Of a traceback, from its end."""


@dataclass(frozen=True, slots=True)
class Failed:
    """An exception while a run was made: a defect of the program. ends: not of the run, and it ends the campaign."""

    text: str
    ends: bool = False


def run_maker() -> MakeRun:
    """Makes runs by this project's rig, in virtual time."""
    from testbench.campaign.making.execute import Workshop, make_run

    workshop = Workshop()
    return lambda spec: make_run(spec, workshop)


def maker_named(name: str) -> MakeRun:
    """The function that makes runs, by the name of what gives it."""
    module, _, function = name.partition(":")
    made: MakeRun = getattr(importlib.import_module(module), function)()
    return made


def made_or_failed(make: MakeRun, spec: RunSpec) -> RunRow | Failed:
    """The row, or what went wrong: last lines of the traceback in one."""
    try:
        return make(spec)
    except FolderError as error:
        return Failed(str(error), ends=True)
    except Exception:  # noqa: BLE001 - the last resort of this process: what it was becomes the reason in the row
        lines = traceback.format_exc().strip().splitlines()
        return Failed(" | ".join(line.strip() for line in lines[-LINES:]))


def worker_main(pipe: Connection, name: str) -> None:
    """Make runs until told to end."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    for variable in ONE_THREAD:
        os.environ.setdefault(variable, "1")
    threading.Thread(target=_end_with_parent, daemon=True).start()
    try:
        make = maker_named(name)
        pipe.send(code_version())
        while (spec := pipe.recv()) is not None:
            pipe.send(made_or_failed(make, spec))
    except (EOFError, BrokenPipeError, ConnectionResetError):
        sys.exit(0)


def _end_with_parent() -> None:
    parent = parent_process()
    if parent is not None:
        wait([parent.sentinel])
        os._exit(0)  # nothing here needs to be put in order, and the main thread may be deep in a run
