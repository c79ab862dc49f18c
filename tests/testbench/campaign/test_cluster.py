"""Runs on a cluster of dask.distributed: a scheduler and two workers as processes of their own, on loopback."""

import json
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path

import distributed
import pytest

from testbench.campaign.making.cluster import Cluster, OtherCode, complaints, make_there
from testbench.campaign.making.execute import Workshop, make_run
from testbench.campaign.making.executor import Executor, ExecutorError
from testbench.campaign.making.identity import code_version
from testbench.campaign.records import Outcome, RunRow, RunSpec
from testbench.campaign.store.store import open_store
from tests.testbench.campaign.campaigns import written
from tests.testbench.campaign.specs import spec

ROOT = Path(__file__).parents[3]
MAKERS = "tests.testbench.campaign.cluster_makers"
WORKERS = 2


@dataclass(frozen=True)
class Dask:
    """A cluster of this machine. address: of its scheduler; scheduler: the process."""

    address: str
    scheduler: subprocess.Popen[bytes]


@contextmanager
def dask_cluster(folder: Path, workers: int) -> Iterator[Dask]:
    """A scheduler and workers; one that dies is started again by its nanny, and its run is tried three times."""
    place = folder / "scheduler.json"
    environment = {
        **os.environ,
        "PYTHONPATH": str(ROOT),
        "DASK_DISTRIBUTED__SCHEDULER__ALLOWED_FAILURES": "2",
        "DASK_TEMPORARY_DIRECTORY": str(folder),
    }
    dask = (sys.executable, "-m", "dask")
    scheduler = ("scheduler", "--host", "127.0.0.1", "--port", "0", "--no-dashboard", "--scheduler-file", str(place))
    worker = ("worker", "--scheduler-file", str(place), "--host", "127.0.0.1", "--nthreads", "1", "--no-dashboard")
    processes = []
    with (folder / "log").open("wb") as log:
        try:
            for command in (scheduler, *[worker] * workers):
                processes.append(
                    subprocess.Popen([*dask, *command], cwd=folder, env=environment, stderr=log, start_new_session=True)
                )
                while not place.exists():
                    with suppress(subprocess.TimeoutExpired):
                        pytest.fail(f"scheduler left with {processes[0].wait(0.05)}: {(folder / 'log').read_text()}")
            yield Dask(str(json.loads(place.read_text())["address"]), processes[0])
        finally:
            for process in reversed(processes):
                with suppress(ProcessLookupError):
                    os.killpg(process.pid, signal.SIGKILL)
                process.wait()


@pytest.fixture(scope="module")
def address(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """Of a cluster with two workers that are ready."""
    with dask_cluster(tmp_path_factory.mktemp("cluster"), WORKERS) as found:
        with distributed.Client(found.address, set_as_default=False) as client:
            client.wait_for_workers(WORKERS, timeout=120)
        yield found.address


def rows_of(executor: Executor, specs: list[RunSpec]) -> dict[str, RunRow]:
    """All of them made, by identity."""
    waiting, rows = list(specs), list[RunRow]()
    try:
        while len(rows) < len(specs):
            while waiting and executor.free() > 0:
                executor.submit(waiting.pop())
            rows += executor.collect(1.0)
    finally:
        executor.stop()
    return {row.identity: row for row in rows}


def plain(row: RunRow) -> RunRow:
    """Without what differs from time to time."""
    return replace(row, started="", wall_s=0.0, cpu_s=0.0, attempts=1)


@pytest.mark.run
def test_rows_are_those_of_this_machine(address: str) -> None:
    """The same campaign on a cluster: identical rows, but for times."""
    specs = [spec("knee_freeze_at", "motion.duration=1.5s", seed=seed) for seed in (1, 2)]
    specs = [replace(one, identity=f"{one.identity}{one.seed}") for one in specs]
    workshop = Workshop()
    here = {one.identity: make_run(one, workshop) for one in specs}
    there = rows_of(Cluster(address), specs)
    assert {name: plain(row) for name, row in there.items()} == {name: plain(row) for name, row in here.items()}


@pytest.mark.run
def test_campaign_from_the_command_line_is_that_of_this_machine(address: str, tmp_path: Path) -> None:
    """`campaign run FILE --cluster tcp://HOST:PORT`: plan and store here, runs there; again, it has nothing to make."""
    file = written(tmp_path, ("runs: 3", "runs: 2"))
    command = [sys.executable, "-m", "testbench.cli", "campaign", "run", str(file), "--no-report", "--json", "--out"]
    stores = {"cluster": ["--cluster", address], "jobs": ["--jobs", "1"], "again": ["--cluster", address]}
    documents, rows = {}, {}
    for name, where in stores.items():
        store = tmp_path / ("cluster.sqlite" if name == "again" else f"{name}.sqlite")
        done = subprocess.run([*command, str(store), *where], capture_output=True, text=True, timeout=300)
        assert done.returncode == 0, done.stderr
        documents[name] = json.loads(done.stdout)
        rows[name] = [replace(plain(row), versions={}) for row in stored(store)]
    assert [documents[name]["made"] for name in stores] == [4, 4, 0]
    assert rows["cluster"] == rows["jobs"] == rows["again"]
    assert len(rows["jobs"]) == 4


def stored(path: Path) -> list[RunRow]:
    store = open_store(path)
    try:
        return list(store.runs.all())
    finally:
        store.close()


@pytest.mark.run
def test_scheduler_that_is_gone_ends_the_campaign(tmp_path: Path) -> None:
    """In the middle of a run: said within the patience of the client, and what was finished is there."""
    with dask_cluster(tmp_path, 1) as dask:
        executor = Cluster(dask.address, f"{MAKERS}:hanging")
        executor.submit(replace(spec("golden"), identity="under way", time_limit_s=600.0))
        assert executor.collect(0.5) == []
        os.killpg(dask.scheduler.pid, signal.SIGKILL)
        try:
            with pytest.raises(ExecutorError, match="the scheduler is gone; what was finished is in the store"):
                executor.collect(60.0)
        finally:
            executor.stop()


@pytest.mark.run
def test_killed_worker_costs_its_run_only_and_that_is_made_again(address: str, tmp_path: Path) -> None:
    specs = [replace(spec("golden"), identity=f"killed-{at}", folder=str(tmp_path)) for at in range(3)]
    rows = rows_of(Cluster(address, f"{MAKERS}:dying_once"), specs)
    assert len(list(tmp_path.iterdir())) == 3, "a worker died under every run"
    assert {row.outcome for row in rows.values()} == {Outcome.MASKED}


@pytest.mark.run
def test_run_that_never_ends_is_a_hang_and_others_go_on(address: str) -> None:
    stuck = replace(spec("golden"), identity="stuck", time_limit_s=0.5)
    row = rows_of(Cluster(address, f"{MAKERS}:hanging"), [stuck])["stuck"]
    assert row.outcome is Outcome.HANG
    assert row.reason == "not finished after 0.5 s; its worker ended itself, 3 times in a row"
    after = [replace(spec("golden"), identity=f"after-{at}") for at in range(4)]
    assert len(rows_of(Cluster(address, f"{MAKERS}:at_once"), after)) == 4


@pytest.mark.run
def test_hang_of_an_earlier_campaign_is_none_of_this_one(address: str) -> None:
    """The scheduler keeps what was said; a run of the same identity that crashes now did not hang."""
    one = replace(spec("golden"), identity="hung before", time_limit_s=0.5)
    assert rows_of(Cluster(address, f"{MAKERS}:hanging"), [one])[one.identity].outcome is Outcome.HANG
    again = replace(one, time_limit_s=60.0)
    assert rows_of(Cluster(address, f"{MAKERS}:dying"), [again])[one.identity].outcome is Outcome.CRASHED


@pytest.mark.run
def test_result_folder_that_cannot_be_written_there_ends_the_campaign(address: str) -> None:
    with pytest.raises(ExecutorError, match="worker's machine: result folder there: cannot be written"):
        rows_of(Cluster(address, f"{MAKERS}:no_folder"), [replace(spec("golden"), identity="full")])


@pytest.mark.run
def test_defect_in_a_run_is_recorded_with_its_traceback(address: str) -> None:
    row = rows_of(Cluster(address, f"{MAKERS}:raising"), [replace(spec("golden"), identity="broken")])["broken"]
    assert row.outcome is Outcome.CRASHED
    assert "ZeroDivisionError: broken" in row.reason


@pytest.mark.run
def test_worker_with_other_code_is_refused_before_it_gets_a_run(address: str) -> None:
    with pytest.raises(ExecutorError, match=r"worker tcp://127.* has code .*, needed is 9\.9\+other: install the same"):
        Cluster(address, version="9.9+other")


@pytest.mark.run
def test_worker_that_joined_later_with_other_code_makes_no_row(address: str) -> None:
    """It is asked again with every run."""
    with distributed.Client(address, set_as_default=False) as client:
        said = client.submit(make_there, spec("golden"), f"{MAKERS}:at_once", "9.9+other", pure=False).result()
    assert isinstance(said, OtherCode)
    assert said.version == code_version()


@pytest.mark.run
def test_worker_that_cannot_make_runs_ends_the_campaign_and_makes_no_row(address: str) -> None:
    """Such a worker is done at once with every run: recorded as crashed, they would be all of the campaign."""
    with pytest.raises(ExecutorError, match=r"a worker cannot make runs \(AttributeError: .*\); install the same"):
        rows_of(Cluster(address, f"{MAKERS}:not_there"), [replace(spec("golden"), identity="nowhere")])


@pytest.mark.long
def test_no_scheduler_at_the_address_is_said_with_its_remedy(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("testbench.campaign.making.cluster.CONNECT_S", 0.5)
    with pytest.raises(ExecutorError, match=r"--cluster tcp://127\.0\.0\.1:9: no scheduler .* 'dask scheduler --host"):
        Cluster("tcp://127.0.0.1:9")


@pytest.mark.run
def test_cluster_without_workers_is_said_with_its_remedy(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("testbench.campaign.making.cluster.WORKERS_S", 0.2)
    with (
        dask_cluster(tmp_path, 0) as empty,
        pytest.raises(ExecutorError, match=r"no worker there for 0\.2 s; .* dask worker tcp://127"),
    ):
        Cluster(empty.address)


def test_complaints_about_workers_name_the_remedy() -> None:
    said = {"tcp://a": "1+x", "tcp://b": "1+y", "tcp://c": ModuleNotFoundError("testbench")}
    assert complaints(said, "1+x") == [
        "worker tcp://b has code 1+y, needed is 1+x: install the same commit there",
        "worker tcp://c could not say which code it has: ModuleNotFoundError('testbench'): install exo-hil there",
    ]
