"""Supervised processes: whatever happens to one, every run comes back as one row, and no process is left over."""

import multiprocessing
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from testbench.campaign.making.executor import ATTEMPTS, ExecutorError
from testbench.campaign.making.pool import Pool
from testbench.campaign.records import Outcome, RunRow, RunSpec
from testbench.errors import BenchError
from tests.testbench.campaign.workers import HERE, row_of, spec


@contextmanager
def pool(maker: str, jobs: int = 1) -> Iterator[Pool]:
    made = Pool(jobs, f"{HERE}:{maker}")
    try:
        yield made
    finally:
        made.stop()
        assert multiprocessing.active_children() == []


def all_of(executor: Pool, specs: list[RunSpec]) -> dict[int, RunRow]:
    """Number -> row, of all the runs."""
    waiting, rows = list(specs), dict[int, RunRow]()
    while len(rows) < len(specs):
        while waiting and executor.free():
            executor.submit(waiting.pop(0))
        for row in executor.collect(10.0):
            assert row.number not in rows
            rows[row.number] = row
    return rows


def test_every_run_comes_back_once_on_two_processes() -> None:
    """As many rows as runs, each its own."""
    with pool("quick", 2) as executor:
        assert executor.free() == 2
        rows = all_of(executor, [spec(number) for number in range(20)])
        assert rows == {number: row_of(spec(number)) for number in range(20)}
        assert executor.free() == 2


def test_run_is_tried_again_when_its_process_dies(tmp_path: Path) -> None:
    """A process killed once costs nothing but the try, which is counted."""
    with pool("dies_once", 2) as executor:
        rows = all_of(executor, [spec(number, tmp_path) for number in range(3)])
    assert {row.attempts for row in rows.values()} == {2}
    assert {row.outcome for row in rows.values()} == {Outcome.MASKED, Outcome.FAILURE_SILENT}


@pytest.mark.long
def test_run_is_crashed_when_its_process_dies_three_times(tmp_path: Path) -> None:
    """Tried again twice at most, then recorded; the runs beside it are made."""
    with pool("dies_for_odd", 2) as executor:
        rows = all_of(executor, [spec(number, tmp_path) for number in range(4)])
    assert [rows[number].outcome for number in range(4)] == [
        *(Outcome.FAILURE_SILENT, Outcome.CRASHED, Outcome.FAILURE_SILENT, Outcome.CRASHED)
    ]
    assert rows[1].attempts == ATTEMPTS
    assert (tmp_path / "1-1.tried").read_bytes() == b"xxx"
    assert rows[1].reason == "the process died (exit code 7), 3 times in a row"
    assert (rows[1].identity, rows[1].seed, rows[1].metrics) == ("1-1", 1, {})


@pytest.mark.long
def test_hung_process_is_killed_and_its_run_recorded(tmp_path: Path) -> None:
    """time_limit: a run that does not end is tried again twice, then counts as hung."""
    with pool("hangs_for_odd") as executor:
        rows = all_of(executor, [spec(0, tmp_path), spec(1, tmp_path, limit_s=0.05), spec(2, tmp_path)])
    assert rows[1].outcome is Outcome.HANG
    assert rows[1].reason == "not finished after 0.05 s, 3 times in a row"
    assert (tmp_path / "1-1.tried").read_bytes() == b"xxx"
    assert [rows[0].outcome, rows[2].outcome] == [Outcome.FAILURE_SILENT] * 2


def test_exception_is_recorded_at_once_with_where_it_came_from(tmp_path: Path) -> None:
    """A defect comes again: no second try, and the last lines of the traceback are the reason."""
    with pool("raises") as executor:
        rows = all_of(executor, [spec(0, tmp_path), spec(1, tmp_path)])
    assert rows[0].outcome is Outcome.CRASHED
    assert rows[0].attempts == 1
    assert (tmp_path / "1-0.tried").read_bytes() == b"x"
    assert rows[0].reason.endswith("ZeroDivisionError: run 1-0")
    assert "workers.py" in rows[0].reason


def test_processes_that_never_get_ready_are_an_error(capfd: pytest.CaptureFixture[str]) -> None:
    """A program that cannot start is said, not tried for ever."""
    with pool("never_ready", 2) as executor:
        executor.submit(spec(0))
        with pytest.raises(ExecutorError, match=r"3 processes in a row did not get ready.*exit code 3"):
            all_of(executor, [spec(1)])


def test_program_that_was_changed_meanwhile_is_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    """A process that is started later reads the changed files: its rows would have the version of the old ones."""
    monkeypatch.setattr("testbench.campaign.making.pool.code_version", lambda: "0.1.0+before")
    with pool("quick") as executor:
        executor.submit(spec(0))
        with pytest.raises(ExecutorError, match=r"changed while it ran: .* has code .*, this one 0\.1\.0\+before"):
            all_of(executor, [spec(1)])


def test_libraries_are_told_to_use_one_thread(monkeypatch: pytest.MonkeyPatch) -> None:
    """The processes are the parallelism."""
    monkeypatch.delenv("OMP_NUM_THREADS", raising=False)
    with pool("threads") as executor:
        assert all_of(executor, [spec(0)])[0].reason == "1"


def test_stop_drops_what_is_in_flight(tmp_path: Path) -> None:
    """A hung run does not keep its process alive beyond the pool; stopping twice is allowed."""
    with pool("hangs_for_odd", 2) as executor:
        executor.submit(spec(1, tmp_path))
        executor.submit(spec(3, tmp_path))
        while not ((tmp_path / "1-1.tried").exists() and (tmp_path / "1-3.tried").exists()):
            assert executor.collect(0.05) == []
        executor.stop()
        assert multiprocessing.active_children() == []


def test_no_jobs_are_refused() -> None:
    with pytest.raises(BenchError, match="0 given; allowed from 1 up"):
        Pool(0)
