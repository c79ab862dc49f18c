"""Runs in supervised processes on this machine, one at a time in each.

A process that dies or takes longer than a run may is replaced, and its run is tried again, twice at most; then its row
says crashed or hang. An exception is a defect and comes again: it is recorded at once, and the process replaced, as
nobody knows what the exception left behind. A new process whose code is not this one's, because somebody has changed it
meanwhile, is an error: its rows would be of another program. Processes are started afresh (spawn), never forked: the
same everywhere.
"""

import multiprocessing
import signal
import sys
import time
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from multiprocessing.connection import Connection, wait
from multiprocessing.context import SpawnProcess
from typing import Final, final

from testbench.campaign.making.executor import ATTEMPTS, Executor, ExecutorError, given_up
from testbench.campaign.making.identity import code_version
from testbench.campaign.making.worker import DEFAULT, Failed, worker_main
from testbench.campaign.records import Outcome, RunRow, RunSpec
from testbench.errors import BenchError

START_S: Final = 300.0
"""Most that a process may take to get ready; on a machine that is very busy, importing everything takes a while."""
STARTS: Final = 3
"""So many processes in a row that never get ready, and it is no accident."""
LEAVE_S: Final = 2.0
"""Most that processes may take to leave when told to."""


@dataclass(slots=True)
class _Task:
    """A run in the pool. attempts: begun so far; begun: of the last one, on the monotonic clock; started: in UTC."""

    spec: RunSpec
    attempts: int = 0
    begun: float = 0.0
    started: str = ""


@contextmanager
def _without_interrupts() -> Iterator[None]:
    """A process started inside never sees Ctrl-C, from its first instruction; this one gets it afterwards."""
    if sys.platform == "win32":
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


@final
class _Worker:
    """One process, its end of the pipe, and what it is at."""

    def __init__(self, maker: str) -> None:
        context = multiprocessing.get_context("spawn")
        here, other = context.Pipe()
        self.pipe: Final[Connection] = here
        self.process: Final[SpawnProcess] = context.Process(target=worker_main, args=(other, maker), daemon=True)
        self.is_ready: bool = False
        self.task: _Task | None = None
        self.begun: float = time.monotonic()
        with _without_interrupts():
            self.process.start()
        other.close()

    def give(self, task: _Task) -> None:
        """Let it make a run. A process that has died meanwhile is found out by its sentinel."""
        task.attempts += 1
        task.begun, task.started = time.monotonic(), datetime.now(UTC).isoformat(timespec="milliseconds")
        self.task = task
        with suppress(OSError):
            self.pipe.send(task.spec)

    def deadline(self) -> float:
        """When it is hung, on the monotonic clock."""
        if self.task is not None:
            return self.task.begun + self.task.spec.time_limit_s
        return self.begun + START_S if not self.is_ready else float("inf")

    def kill(self) -> None:
        """End it, whatever it is doing."""
        self.process.kill()
        self.process.join()
        self.pipe.close()
        self.process.close()


@final
class Pool(Executor):
    """`jobs` processes. maker: where they get the function that makes runs, MODULE:FUNCTION."""

    def __init__(self, jobs: int, maker: str = DEFAULT) -> None:
        if jobs < 1:
            raise BenchError(f"jobs: {jobs} given; allowed from 1 up")
        self._jobs: Final[int] = jobs
        self._maker: Final[str] = maker
        self._version: Final[str] = code_version()
        self._workers: Final[list[_Worker]] = []
        self._waiting: Final[deque[_Task]] = deque()
        self._finished: Final[list[RunRow]] = []
        self._failed_starts: int = 0

    def free(self) -> int:
        """Runs that can be begun at once, or as soon as a process is ready."""
        busy = sum(worker.task is not None for worker in self._workers)
        return self._jobs - busy - len(self._waiting)

    def submit(self, spec: RunSpec) -> None:
        """Take a run, and start a process for it if there is none."""
        self._waiting.append(_Task(spec))
        self._hand_out()

    def collect(self, timeout_s: float) -> list[RunRow]:
        """What has finished."""
        until = time.monotonic() + timeout_s
        while not self._finished and self._workers:
            deadline = min(worker.deadline() for worker in self._workers)
            left = min(until, deadline) - time.monotonic()
            if not self._listen(max(left, 0.0)) and time.monotonic() >= until:
                break
        found = list(self._finished)
        self._finished.clear()
        return found

    def stop(self) -> None:
        """Tell idle processes to leave, and end the others."""
        for worker in self._workers:
            if worker.task is None:
                with suppress(OSError):
                    worker.pipe.send(None)
        until = time.monotonic() + LEAVE_S
        for worker in self._workers:
            if worker.task is None:
                worker.process.join(max(until - time.monotonic(), 0.0))
            worker.kill()
        self._workers.clear()
        self._waiting.clear()

    def _hand_out(self) -> None:
        """Runs to processes that are ready; a new process while there are more runs than processes to come."""
        for worker in self._workers:
            if worker.is_ready and worker.task is None and self._waiting:
                worker.give(self._waiting.popleft())
        coming = sum(not worker.is_ready for worker in self._workers)
        while coming < len(self._waiting) and len(self._workers) < self._jobs:
            self._workers.append(_Worker(self._maker))
            coming += 1

    def _listen(self, timeout_s: float) -> bool:
        """Wait for something to happen, and take it in; whether anything did."""
        pipes = {worker.pipe: worker for worker in self._workers}
        sentinels = {worker.process.sentinel: worker for worker in self._workers}
        happened = wait([*pipes, *sentinels], timeout_s)
        for worker in [pipes[thing] for thing in happened if isinstance(thing, Connection)]:
            self._hear(worker)
        for worker in [sentinels[thing] for thing in happened if isinstance(thing, int)]:
            if worker in self._workers:
                self._hear(worker)  # what it said before it died counts
                self._died(worker)
        now = time.monotonic()
        late = [worker for worker in self._workers if now >= worker.deadline()]
        for worker in late:
            self._hung(worker)
        self._hand_out()
        return bool(happened or late)

    def _hear(self, worker: _Worker) -> None:
        """All that a process has to say."""
        try:
            while worker in self._workers and worker.pipe.poll():
                self._heard(worker, worker.pipe.recv())
        except (EOFError, OSError):
            return  # it is dead, or as good as: its sentinel says so

    def _heard(self, worker: _Worker, said: object) -> None:
        task, worker.task = worker.task, None
        if task is None:
            if said != self._version:
                raise ExecutorError(
                    f"the program was changed while it ran: a new process has code {said}, this one {self._version}; "
                    "what was finished is in the store; start again, which makes all runs anew"
                )
            worker.is_ready = True
            self._failed_starts = 0
        elif isinstance(said, RunRow):
            self._finish(task, said)
        elif isinstance(said, Failed) and said.ends:
            raise ExecutorError(said.text)
        else:
            text = said.text if isinstance(said, Failed) else f"the process answered {said!r}"
            self._give_up(task, Outcome.CRASHED, text)
            self._drop(worker)

    def _finish(self, task: _Task, row: RunRow) -> None:
        self._finished.append(replace(row, attempts=task.attempts))

    def _died(self, worker: _Worker) -> None:
        worker.process.join(LEAVE_S)  # its pipes are closed, which is the last thing before the system knows its code
        code = worker.process.exitcode
        how = f"exit code {code}"
        if code is not None and code < 0:
            with suppress(ValueError):
                how = f"signal {-code}, {signal.Signals(-code).name}"
        self._lost(worker, Outcome.CRASHED, f"the process died ({how})")

    def _hung(self, worker: _Worker) -> None:
        limit = START_S if worker.task is None else worker.task.spec.time_limit_s
        self._lost(worker, Outcome.HANG, f"not finished after {limit:g} s")

    def _lost(self, worker: _Worker, outcome: Outcome, how: str) -> None:
        """Replace a process; its run is tried again, or given up."""
        task = worker.task
        self._drop(worker)
        if task is None:
            self._failed_starts += not worker.is_ready
            if self._failed_starts >= STARTS:
                raise ExecutorError(
                    f"{STARTS} processes in a row did not get ready: {how}; what they printed stands above"
                )
        elif task.attempts < ATTEMPTS:
            self._waiting.appendleft(task)
        else:
            self._give_up(task, outcome, f"{how}, {task.attempts} times in a row")

    def _give_up(self, task: _Task, outcome: Outcome, reason: str) -> None:
        wall_s = time.monotonic() - task.begun
        self._finished.append(given_up(task.spec, outcome, reason, task.attempts, wall_s, task.started))

    def _drop(self, worker: _Worker) -> None:
        worker.task = None
        worker.kill()
        self._workers.remove(worker)
