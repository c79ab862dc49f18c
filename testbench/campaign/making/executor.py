"""Where runs are made: in other processes, on other machines, on buses. The runner knows no more than this."""

from typing import Final

from mypy_extensions import mypyc_attr

from testbench.campaign.records import Outcome, RunRow, RunSpec
from testbench.errors import BenchError

ATTEMPTS: Final = 3
"""A run that was lost with its process is tried again, twice at most."""


class ExecutorError(BenchError):
    """No run can be made at all; the message says why."""


class FolderError(ExecutorError):
    """The result folder of a run cannot be written: the campaign ends, the run is not recorded, and made again."""


@mypyc_attr(allow_interpreted_subclasses=True)
class Executor:
    """Makes runs. Every run that was submitted comes back as one row, also one that crashed or hung."""

    def free(self) -> int:
        """How many runs it would take at once now."""
        raise NotImplementedError

    def submit(self, spec: RunSpec) -> None:
        """Take a run; only when `free()` is more than 0."""
        raise NotImplementedError

    def collect(self, timeout_s: float) -> list[RunRow]:
        """What has finished since, after at most so long a wait; raises ExecutorError when nothing ever will."""
        raise NotImplementedError

    def stop(self) -> None:
        """Drop what is not finished, and leave no process behind."""
        raise NotImplementedError


def given_up(spec: RunSpec, outcome: Outcome, reason: str, attempts: int, wall_s: float, started: str) -> RunRow:
    """The row of a run without a result."""
    return RunRow(
        identity=spec.identity,
        point=spec.wanted.point,
        number=spec.wanted.number,
        seed=spec.seed,
        outcome=outcome,
        reason=reason,
        attempts=attempts,
        wall_s=wall_s,
        started=started,
        versions={"code": spec.code_version},
    )
