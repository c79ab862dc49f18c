"""What workers of a test's cluster make instead of runs: rows at once, or nothing ever."""

import os
import threading
from pathlib import Path

from testbench.campaign.making.executor import FolderError
from testbench.campaign.making.worker import MakeRun
from testbench.campaign.records import Outcome, RunRow, RunSpec


def row_of(spec: RunSpec) -> RunRow:
    return RunRow(spec.identity, spec.wanted.point, spec.wanted.number, spec.seed, Outcome.MASKED)


def at_once() -> MakeRun:
    return row_of


def hanging() -> MakeRun:
    def make(spec: RunSpec) -> RunRow:
        threading.Event().wait()
        return row_of(spec)

    return make


def dying_once() -> MakeRun:
    """The first run of each identity kills its process; `folder` remembers."""

    def make(spec: RunSpec) -> RunRow:
        mark = Path(spec.folder) / spec.identity
        if not mark.exists():
            mark.touch()
            os._exit(1)
        return row_of(spec)

    return make


def dying() -> MakeRun:
    """Every run kills its process, every time."""

    def make(spec: RunSpec) -> RunRow:
        os._exit(1)

    return make


def no_folder() -> MakeRun:
    """The result folder of every run cannot be written."""

    def make(spec: RunSpec) -> RunRow:
        raise FolderError("result folder there: cannot be written")

    return make


def raising() -> MakeRun:
    def make(spec: RunSpec) -> RunRow:
        raise ZeroDivisionError(spec.identity)

    return make
