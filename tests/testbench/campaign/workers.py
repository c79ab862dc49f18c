"""Functions that make runs for tests: without a rig, and with every way to go wrong."""

import os
import signal
import threading
from pathlib import Path

from testbench.campaign.making.executor import FolderError
from testbench.campaign.making.worker import MakeRun
from testbench.campaign.records import InjectionRow, Outcome, Point, RunRow, RunSpec, Wanted

HERE = "tests.testbench.campaign.workers"


def spec(number: int = 0, folder: Path | str = "nowhere", limit_s: float = 60.0, axis: str = "1") -> RunSpec:
    """A run without a scenario."""
    wanted = Wanted(Point((("axis", axis),)), number)
    name = f"{axis}-{number}"
    return RunSpec(
        name, wanted, number, "", "1", None, 0.0, "never", str(Path(folder) / name), time_limit_s=limit_s, fork=False
    )


def row_of(given: RunSpec, outcome: Outcome | None = None) -> RunRow:
    """A row with everything in it, a function of the run alone."""
    wanted = given.wanted
    activation = InjectionRow("a", 0, 0.5, None, 0.1, 3, "right_knee.position", "event")
    return RunRow(
        identity=given.identity,
        point=wanted.point,
        number=wanted.number,
        seed=given.seed,
        outcome=outcome or (Outcome.MASKED if given.seed % 2 else Outcome.FAILURE_SILENT),
        metrics={"right_knee.rmse_position_rad": 0.25 * given.seed, "right_knee.max_angle_deg": -1.5},
        first_start_s=0.5,
        activated=1,
        beyond_deg=1.5,
        trace_hash="ab" * 32,
        injections=(activation, activation),
        wall_s=0.125,
        machine="here",
        versions={"code": given.code_version},
    )


def quick() -> MakeRun:
    """Every run at once."""
    return row_of


def tried(given: RunSpec) -> int:
    """How often the run was begun before; counts this time."""
    path = Path(f"{given.folder}.tried")
    times = len(path.read_bytes()) if path.exists() else 0
    path.write_bytes(b"x" * (times + 1))
    return times


def dies_once() -> MakeRun:
    """The process of a run is killed the first time."""

    def make(given: RunSpec) -> RunRow:
        if not tried(given):
            os.kill(os.getpid(), signal.SIGKILL)
        return row_of(given)

    return make


def dies_for_odd() -> MakeRun:
    """The process of every odd run ends, every time."""

    def make(given: RunSpec) -> RunRow:
        tried(given)
        if given.wanted.number % 2:
            os._exit(7)
        return row_of(given)

    return make


def hangs_for_odd() -> MakeRun:
    """Every odd run never ends."""

    def make(given: RunSpec) -> RunRow:
        if given.wanted.number % 2:
            tried(given)
            threading.Event().wait()
        return row_of(given)

    return make


def hangs_from_3() -> MakeRun:
    """Runs 0, 1 and 2 end at once, all others never; each process leaves its number."""
    Path(os.environ["WORKER_FOLDER"], f"{os.getpid()}.pid").touch()

    def make(given: RunSpec) -> RunRow:
        if given.wanted.number >= 3:
            threading.Event().wait()
        return row_of(given)

    return make


def raises() -> MakeRun:
    """A defect in every run."""

    def make(given: RunSpec) -> RunRow:
        tried(given)
        raise ZeroDivisionError(f"run {given.identity}")

    return make


def no_folder() -> MakeRun:
    """The result folder of every run cannot be written."""

    def make(given: RunSpec) -> RunRow:
        raise FolderError("result folder there: cannot be written")

    return make


def threads() -> MakeRun:
    """The reason of every run is what the libraries of linear algebra are told."""
    from dataclasses import replace

    return lambda given: replace(row_of(given), reason=os.environ.get("OMP_NUM_THREADS", ""))


def never_ready() -> MakeRun:
    """The process ends before it can make a run."""
    os._exit(3)
