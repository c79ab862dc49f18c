"""Runs the tests of the folder `inside` where vcan0 and vcan1 exist, and reports each of them as if it had run here.

They are collected and selected like all others. When the first of them is due, all that are selected run in one inner
pytest (see `uml`: a network namespace of this kernel, or User Mode Linux); what it reports is handed on test by test.
With pytest-xdist the worker that comes first runs them for all, the others wait for it.
Where there is no SocketCAN to be had they are skipped, and the reason says what helps.
"""

import json
import os
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Final, NoReturn, final

import pytest

from tests.parity.patience import BUSY
from tests.vcan import uml

INSIDE: Final = Path(__file__).resolve().parent / "inside"
CACHE: Final = Path(__file__).resolve().parents[2] / ".cache" / "vcan"

REPORTS_TO: Final = "EXO_HIL_VCAN_REPORTS"
"""Set for the inner pytest: the file that it appends its reports to, one JSON document a line."""

HANGS_S: Final = 180.0
"""A test that takes so long hangs: more than anything inside waits for."""

LIMIT_S: Final = 540.0
"""For all of them; alone on a machine they take two thirds of it, what waits for a clock may be repeated twice."""


@final
@dataclass(frozen=True, slots=True)
class InnerRun:
    """reports: of the inner pytest, by node id and phase; output: what it printed; refusal: why it could not be run.

    stopped_s: when it was stopped at its limit, s since 1970; 0 when it came to its end.
    """

    reports: dict[tuple[str, str], pytest.TestReport]
    output: str
    refusal: str
    stopped_s: float

    def missing(self, node_id: str) -> NoReturn:
        """There is no report of this test: fails, unless it had no time left."""
        begun = self.reports.get((node_id, "setup"))
        if self.stopped_s and (begun is None or self.stopped_s - begun.stop < HANGS_S):
            pytest.skip(f"{BUSY}: {LIMIT_S:g} s were not enough for all tests on SocketCAN")
        pytest.fail(f"no report from inside:\n{self.output[-5000:]}", pytrace=False)


@final
class ReportWriter:
    """The inner pytest's side."""

    def __init__(self, config: pytest.Config, path: Path) -> None:
        self._config = config
        self._path = path
        path.touch()

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        document = self._config.hook.pytest_report_to_serializable(config=self._config, report=report)
        with self._path.open("a", encoding="utf-8") as file:
            file.write(json.dumps(document) + "\n")


def pytest_configure(config: pytest.Config) -> None:
    if REPORTS_TO in os.environ:
        config.pluginmanager.register(ReportWriter(config, Path(os.environ[REPORTS_TO])))


def pytest_collection_finish(session: pytest.Session) -> None:
    """What these tests need is there inside only; here they need the inner run and nothing else."""
    for item in session.items:
        if is_borrowed(item):
            assert isinstance(item, pytest.Function)
            item.fixturenames = ["inner_run"]


@pytest.hookimpl(tryfirst=True)
def pytest_pyfunc_call(pyfuncitem: pytest.Function) -> bool | None:
    """It has run inside; one that left no report did not come to its end there."""
    if not is_borrowed(pyfuncitem):
        return None
    run = inner_run_of(pyfuncitem)
    if (pyfuncitem.nodeid, "call") not in run.reports:
        run.missing(pyfuncitem.nodeid)
    return True


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_makereport(item: pytest.Item, call: pytest.CallInfo[None]) -> pytest.TestReport | None:
    """The report from inside, unless there is something to report about this side."""
    if call.excinfo is not None or not is_borrowed(item):
        return None
    if "inner_run" not in getattr(item, "funcargs", {}):  # there was none: the teardown of a skipped test
        return None
    return inner_run_of(item).reports.get((item.nodeid, call.when))


@pytest.fixture(scope="session")
def inner_run(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> InnerRun:
    """All tests of `inside` that are selected, run."""
    if sys.platform != "linux":
        pytest.skip("SocketCAN is a part of Linux; elsewhere the emulated bus, hub:, is what there is")
    folder = tmp_path_factory.getbasetemp()
    if "PYTEST_XDIST_WORKER" in os.environ:
        folder = folder.parent  # of all workers
    folder = folder / "vcan"
    folder.mkdir(exist_ok=True)
    with locked(folder / "lock"):
        ended = folder / "ended"
        if not ended.exists():
            told = run_inside([item.nodeid for item in request.session.items if is_borrowed(item)],
                              request.config, folder)
            ended.write_text(json.dumps(told), encoding="utf-8")
        output, refusal, stopped_s = json.loads(ended.read_text(encoding="utf-8"))
    if refusal:
        pytest.skip(refusal)
    return InnerRun(read_reports(request.config, folder / "reports"), output, refusal, stopped_s)


def run_inside(node_ids: list[str], config: pytest.Config, folder: Path) -> tuple[str, str, float]:
    """One inner pytest over these tests; the last three fields of InnerRun."""
    reports = folder / "reports"
    root = config.rootpath
    command = [sys.executable, "-P", "-m", "pytest", "-p", "no:xdist", "--rootdir", str(root)]
    command += ["-c", str(config.inipath or root / "pyproject.toml"), *(f"{root}/{node_id}" for node_id in node_ids)]
    environment = {REPORTS_TO: str(reports), "PYTHONDONTWRITEBYTECODE": "1", "PYTEST_ADDOPTS": ""}
    try:
        return uml.run(command, folder, LIMIT_S, environment, cache=CACHE)[1], "", 0.0
    except uml.CommandTimeoutError as error:
        return str(error), "", time.time()
    except uml.VcanError as error:
        return str(error), "" if reports.exists() else f"no SocketCAN for this test: {error}", 0.0


def read_reports(config: pytest.Config, path: Path) -> dict[tuple[str, str], pytest.TestReport]:
    """The reports in the file that a ReportWriter wrote; the last line may be cut off when the run was."""
    found: dict[tuple[str, str], pytest.TestReport] = {}
    for line in path.read_text(encoding="utf-8").splitlines() if path.exists() else ():
        try:
            document = json.loads(line)
        except json.JSONDecodeError:
            continue
        for name in ("location", "longrepr"):  # tuples, for which JSON has lists
            if isinstance(document.get(name), list):
                document[name] = tuple(document[name])
        report = config.hook.pytest_report_from_serializable(config=config, data=document)
        assert isinstance(report, pytest.TestReport)
        found[report.nodeid, str(report.when)] = report
    return found


def is_borrowed(item: pytest.Item) -> bool:
    """Whether it is a test that runs inside, and this is not inside."""
    return REPORTS_TO not in os.environ and item.path.is_relative_to(INSIDE)


def inner_run_of(item: pytest.Item) -> InnerRun:
    """The run it was part of."""
    assert isinstance(item, pytest.Function)
    run = item.funcargs["inner_run"]
    assert isinstance(run, InnerRun)
    return run


@contextmanager
def locked(path: Path) -> Iterator[None]:
    """Held by one process at a time."""
    import fcntl  # here, because this module is imported where there is none, too

    with path.open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        yield
