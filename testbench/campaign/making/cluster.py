"""Runs on the workers of a dask.distributed cluster, on this machine or on many (extra `cluster`).

The campaign stays here: plan, store and report are the client's, workers get a RunSpec and give a row. Every worker is
asked for its code version before it gets anything, and again with every run, as workers come and go: one with other
code ends the campaign with an error, because its rows would be of another program. A worker makes one run at a time, in
a thread of its own process. When it dies the scheduler gives its run to another one; that is tried again
`distributed.scheduler.allowed-failures` times (3 by default, so four tries in all); then the row says crashed, or hang
when the worker ended itself because the run took longer than it may. The address is the user's: nothing here listens.
"""

import os
import threading
import time
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from functools import cache
from typing import Final, final

import distributed

from testbench.campaign.making.executor import Executor, ExecutorError, given_up
from testbench.campaign.making.identity import code_version
from testbench.campaign.making.worker import DEFAULT, Failed, MakeRun, made_or_failed, maker_named
from testbench.campaign.records import Outcome, RunRow, RunSpec

_LOST: Final = "scheduler-connection-lost"
"""Why the client cancels all that was asked for, in distributed's words."""

CONNECT_S: Final = 10.0
"""Most that the scheduler may take to answer."""
WORKERS_S: Final = 60.0
"""Most that a cluster may be without any worker: one that died is started again by its nanny."""
LOOK_S: Final = 2.0
"""How often workers are counted: they come and go."""
FLUSH_S: Final = 1.0
"""How long a worker waits before it ends itself, so that its last word reaches the scheduler."""
HUNG: Final = "exo-hil-hung"
"""Topic under which workers say which run took too long."""

_BUSY: Final = threading.Lock()
"""One run at a time in a process: a Workshop belongs to one thread."""


@cache
def _maker(name: str) -> MakeRun:
    """The function that makes runs, once in every process."""
    return maker_named(name)


@dataclass(frozen=True, slots=True)
class OtherCode:
    """A worker has another code version than the client; it made nothing."""

    worker: str
    version: str


def make_there(spec: RunSpec, maker: str, version: str) -> RunRow | Failed | OtherCode:
    """Make a run on a worker; when it takes longer than it may, the process says so and ends."""
    worker = distributed.get_worker()
    if code_version() != version:
        return OtherCode(worker.address, code_version())
    with _BUSY:
        watch = threading.Timer(spec.time_limit_s, _end_hung, (worker, spec.identity))
        watch.daemon = True
        watch.start()
        try:
            return made_or_failed(_maker(maker), spec)
        finally:
            watch.cancel()


def _end_hung(worker: distributed.Worker, identity: str) -> None:
    worker.log_event(HUNG, identity)
    time.sleep(FLUSH_S)
    os._exit(1)  # the thread that hangs cannot be ended alone


def complaints(found: Mapping[str, object], version: str) -> list[str]:
    """Why workers cannot make runs of this code version, one line each.

    found: by address, what each said when asked for its code version, an exception where it could not say.
    """
    lines = []
    for address, said in sorted(found.items()):
        if isinstance(said, str) and said != version:
            lines.append(f"worker {address} has code {said}, needed is {version}: install the same commit there")
        elif said != version:
            lines.append(f"worker {address} could not say which code it has: {said!r}: install exo-hil there")
    return lines


@final
class Cluster(Executor):
    """Workers behind the scheduler at `address`, such as tcp://127.0.0.1:8786.

    maker: where they get the function that makes runs, MODULE:FUNCTION. Raises ExecutorError when there is no scheduler
    there, no worker, or a worker with other code.
    """

    def __init__(self, address: str, maker: str = DEFAULT, version: str | None = None) -> None:
        self._address: Final[str] = address
        self._maker: Final[str] = maker
        self._version: Final[str] = code_version() if version is None else version
        self._flying: Final[dict[distributed.Future, RunSpec]] = {}
        self._workers: int = 0
        self._looked: float = 0.0
        self._seen: float = time.monotonic()
        try:
            self._client = distributed.Client(address, timeout=CONNECT_S, set_as_default=False, name="exo-hil")
        except (OSError, ValueError, TimeoutError) as error:
            raise ExecutorError(
                f"--cluster {address}: no scheduler of dask.distributed answers there ({error}); start one with "
                "'dask scheduler --host 127.0.0.1', or name where it is, as in tcp://127.0.0.1:8786"
            ) from error
        try:
            self._heard_before = self._last_heard()
            self._client.wait_for_workers(1, timeout=WORKERS_S)
            wrong = complaints(self._client.run(code_version, on_error="return"), self._version)
            if wrong:
                raise ExecutorError(f"--cluster {address}: {'; '.join(wrong)}")
        except TimeoutError as error:
            self._client.close()
            raise self._no_worker() from error
        except BaseException:
            self._client.close()
            raise

    def free(self) -> int:
        """One run a worker: one that waited at a worker that dies would count as tried too.

        Raises ExecutorError when there has been no worker for a while.
        """
        if time.monotonic() >= self._looked + LOOK_S:
            self._looked = time.monotonic()
            self._workers = len(self._client.scheduler_info(n_workers=-1)["workers"])
            if self._workers:
                self._seen = self._looked
            elif self._looked >= self._seen + WORKERS_S:
                raise self._no_worker()
        return self._workers - len(self._flying)

    def submit(self, spec: RunSpec) -> None:
        """Hand a run to the scheduler."""
        key = f"exo-hil-{spec.identity}"
        future = self._client.submit(make_there, spec, self._maker, self._version, key=key, pure=False)
        self._flying[future] = spec

    def collect(self, timeout_s: float) -> list[RunRow]:
        """What has finished.

        Raises ExecutorError when the scheduler is gone, or a worker has other code, or none that can make runs.
        """
        if self._flying:
            try:
                with suppress(TimeoutError), self._client.as_current():
                    distributed.wait(list(self._flying), timeout=timeout_s, return_when="FIRST_COMPLETED")
            except distributed.client.FuturesCancelledError as error:
                if any(group.reason == _LOST for group in error.error_groups):
                    raise self._gone() from error
        elif timeout_s:
            time.sleep(timeout_s)
        if self._client.status not in ("running", "connecting"):
            raise self._gone()
        done = [future for future in self._flying if future.status in ("finished", "error", "cancelled", "lost")]
        return [self._row(future, self._flying.pop(future)) for future in done]

    def stop(self) -> None:
        """Drop what is not finished. The cluster stays: it is not ours."""
        with suppress(OSError, TimeoutError):
            self._client.cancel(list(self._flying))
        self._flying.clear()
        self._client.close()

    def _last_heard(self) -> float:
        """When a worker last said that a run took too long, by the scheduler's clock: of a campaign before this one."""
        return max((float(time_s) for time_s, _ in self._client.get_events(HUNG)), default=0.0)

    def _gone(self) -> ExecutorError:
        return ExecutorError(
            f"--cluster {self._address}: the scheduler is gone; what was finished is in the store: start the scheduler "
            "and its workers again, and the same command goes on"
        )

    def _no_worker(self) -> ExecutorError:
        return ExecutorError(
            f"--cluster {self._address}: no worker there for {WORKERS_S:g} s; start one on each machine: "
            f"dask worker {self._address} --nthreads 1"
        )

    def _row(self, future: distributed.Future, spec: RunSpec) -> RunRow:
        if future.status == "finished":
            said = future.result()
            if isinstance(said, RunRow):
                return said
            if isinstance(said, OtherCode):
                wrong = complaints({said.worker: said.version}, self._version)
                raise ExecutorError(f"--cluster {self._address}: {wrong[0]}")
            if said.ends:
                raise ExecutorError(f"--cluster {self._address}: worker's machine: {said.text}")
            return given_up(spec, Outcome.CRASHED, said.text, 1, 0.0, "")
        if future.status != "error":
            raise ExecutorError(f"--cluster {self._address}: run {spec.identity[:12]} was {future.status} there")
        error = future.exception()
        if not isinstance(error, distributed.KilledWorker):
            raise ExecutorError(
                f"--cluster {self._address}: a worker cannot make runs ({type(error).__name__}: {error}); install the "
                "same commit of exo-hil, with its extras, on every worker"
            )
        attempts = error.allowed_failures + 1
        if spec.identity in {said for time_s, said in self._client.get_events(HUNG) if time_s > self._heard_before}:
            reason = f"not finished after {spec.time_limit_s:g} s; its worker ended itself, {attempts} times in a row"
            return given_up(spec, Outcome.HANG, reason, attempts, spec.time_limit_s, "")
        return given_up(spec, Outcome.CRASHED, f"the worker died, {attempts} times in a row", attempts, 0.0, "")
