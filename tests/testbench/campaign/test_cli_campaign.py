"""`exo-hil campaign` seen from outside: what is printed where, exit codes, interruption, death.

One module, although long: all its words are tried on the same small campaign.
"""

import dataclasses
import json
import os
import signal
import sqlite3
import subprocess
import sys
from collections.abc import Callable
from contextlib import closing, suppress
from pathlib import Path

import pytest

import testbench.campaign.making.pool
import testbench.cli_campaign
from testbench.campaign.again import changes_of
from testbench.campaign.records import Outcome, RunRow
from testbench.campaign.store.store import open_store
from testbench.cli import main
from testbench.summary import summary_text
from tests.testbench.campaign.campaigns import written
from tests.testbench.campaign.test_runner import Here
from tests.testbench.campaign.workers import HERE, row_of

# The program with workers of a test, and with the interrupt key at work also in the background of a shell.
PROGRAM = """
import signal, sys
import testbench.campaign.making.pool as pool
from testbench.cli import main
if __name__ == "__main__":
    signal.signal(signal.SIGINT, signal.default_int_handler)
    if sys.argv[1]:
        pool.Pool.__init__.__defaults__ = (sys.argv[1],)
    sys.exit(main(sys.argv[2:]))
"""

GOLDEN = str(Path(__file__).parents[3] / "scenarios" / "golden.yaml")
TIMES = {"started": "", "wall_s": 0.0, "cpu_s": 0.0, "attempts": 1}


def exo_hil(folder: Path, *arguments: str, maker: str = "") -> subprocess.Popen[str]:
    """The program in a process of its own, in `folder`."""
    name = f"{HERE}:{maker}" if maker else ""
    return subprocess.Popen(
        [sys.executable, "-c", PROGRAM, name, *arguments],
        cwd=folder,
        env={**os.environ, "WORKER_FOLDER": str(folder)},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )


def interrupt(process: subprocess.Popen[str]) -> None:
    """Ctrl-C as a terminal has it: for the program and all of its processes."""
    os.killpg(process.pid, signal.SIGINT)


def rows_in(path: Path) -> list[RunRow]:
    store = open_store(path)
    try:
        return [dataclasses.replace(row, **TIMES) for row in store.runs.all()]  # type: ignore[arg-type]
    finally:
        store.close()


def once(process: subprocess.Popen[str], condition: Callable[[], bool]) -> None:
    """Wait until something is so, as long as the process runs."""
    while not condition():
        with suppress(subprocess.TimeoutExpired):
            process.wait(0.05)
            raise AssertionError(process.communicate())


def has_rows(path: Path, count: int) -> bool:
    """Whether the store has so many rows, through a connection of one's own."""
    if not path.exists():
        return False
    with closing(sqlite3.connect(path)) as connection, suppress(sqlite3.OperationalError):
        return bool(connection.execute("SELECT count(*) FROM runs").fetchone()[0] >= count)
    return False


def is_alive(process: int) -> bool:
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    try:  # ended, and not yet taken note of by whoever adopted it, is ended
        return Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


@pytest.fixture
def fake(monkeypatch: pytest.MonkeyPatch) -> Callable[[str], None]:
    """Have this process's pools make runs by a function of tests.testbench.campaign.workers."""
    made = testbench.campaign.making.pool.Pool.__init__
    return lambda maker: monkeypatch.setattr(made, "__defaults__", (f"{HERE}:{maker}",))


@pytest.mark.long
def test_run_prints_a_table_and_says_where_it_is(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    fake: Callable[[str], None],
) -> None:
    """A line a point with its share of failures; store and report in results/campaigns."""
    fake("quick")
    monkeypatch.chdir(tmp_path)
    assert main(["campaign", "run", str(written(tmp_path)), "--jobs", "2"]) == 0
    out, err = capsys.readouterr()
    lines = out.splitlines()
    assert lines[0].split("  ")[0] == "point"
    assert "  0.05 s    3     " in lines[1]
    assert "66.7 % (20.8 to 93.9 %)" in lines[1] or "33.3 % (6.1 to 79.2 %)" in lines[1]
    assert "6 of 6 runs; 6 made in " in out
    assert "store: results/campaigns/small.sqlite" in out
    assert "report: results/campaigns/small.html, results/campaigns/small.xml" in err
    assert (tmp_path / "results" / "campaigns" / "small.html").read_text(encoding="utf-8").startswith("<!DOCTYPE html>")
    assert main(["campaign", "run", str(written(tmp_path)), "--jobs", "2"]) == 0
    assert "0 made in 0 s (nothing was missing)" in capsys.readouterr().out


def test_json_is_one_document(tmp_path: Path, capsys: pytest.CaptureFixture[str], fake: Callable[[str], None]) -> None:
    """Of run and of status: counts, points, shares."""
    fake("quick")
    store = str(tmp_path / "s.sqlite")
    options = ["--out", store, "--runs", "4", "--json", "--no-report"]
    assert main(["campaign", "run", str(written(tmp_path)), *options]) == 0
    document = json.loads(capsys.readouterr().out)
    assert (document["campaign"], document["done"], document["wanted"], document["made"]) == ("small", 8, 8, 8)
    assert sum(document["outcomes"].values()) == 8
    assert [point["parameters"] for point in document["points"]] == [{"duration": "0.05 s"}, {"duration": "0.3 s"}]
    first = document["points"][0]
    low, high = first["failure_interval"]
    assert low < first["failure_share"] < high
    assert main(["campaign", "status", store, "--json"]) == 0
    status = json.loads(capsys.readouterr().out)
    assert (status["state"], status["done"], status["wanted"]) == ("done", 8, 8)
    assert status["points"] == document["points"]


@pytest.mark.long
def test_runs_without_a_statement_are_told_and_exit_3(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], fake: Callable[[str], None]
) -> None:
    """A defect in every run: each with its reason, in the table and in status; --retry makes them once more."""
    fake("raises")
    store = tmp_path / "s.sqlite"
    (tmp_path / "s-runs").mkdir()
    arguments = ["campaign", "run", str(written(tmp_path)), "--out", str(store), "--jobs", "1", "--no-report"]
    assert main([*arguments, "--runs", "1"]) == 3
    out = capsys.readouterr().out
    assert "crashed: 1/0 (seed 5): " in out
    assert "ZeroDivisionError" in out
    assert main([*arguments, "--runs", "1"]) == 3
    assert "0 made" in capsys.readouterr().out
    fake("quick")
    assert main([*arguments, "--runs", "1", "--retry"]) == 0
    assert "2 made" in capsys.readouterr().out
    assert main(["campaign", "status", str(store)]) == 0
    assert "crashed" not in capsys.readouterr().out


@pytest.mark.long
def test_result_folder_that_cannot_be_written_ends_the_campaign(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], fake: Callable[[str], None]
) -> None:
    """As a store that cannot be written does: exit code 2, the message, no row; the same command goes on from there."""
    fake("no_folder")
    store = tmp_path / "s.sqlite"
    arguments = ["campaign", "run", str(written(tmp_path)), "--out", str(store), "--jobs", "1", "--no-report"]
    assert main(arguments) == 2
    assert "result folder there: cannot be written" in capsys.readouterr().err
    assert rows_in(store) == []
    fake("quick")
    assert main(arguments) == 0
    assert len(rows_in(store)) == 6


def test_table_of_a_rule_that_asks_repeatedly_says_what_its_intervals_are_worth(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], fake: Callable[[str], None]
) -> None:
    """Not plain 95 %."""
    fake("quick")
    rule = "runs: {until: {outcome: failure, width: 0.9}, batch: 4, least: 4, most: 8}"
    file = written(tmp_path, ("runs: 3", rule))
    options = ["--out", str(tmp_path / "s.sqlite"), "--jobs", "1", "--no-report"]
    assert main(["campaign", "run", str(file), *options]) == 0
    assert "cover less often than 95 % (at worst 90.5 %" in capsys.readouterr().out


@pytest.mark.parametrize("realtime", [True, False])
def test_retry_makes_invalid_runs_again_where_they_may_come_out_otherwise(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, realtime: bool
) -> None:
    """Late runs over a bus are an accident; in lock-step the same scenario and seed prove nothing again."""
    outcomes = iter([Outcome.INVALID] * 2 + [Outcome.MASKED] * 4)
    monkeypatch.setattr(testbench.cli_campaign, "_executor", lambda *_: Here(lambda one: row_of(one, next(outcomes))))
    store = tmp_path / "s.sqlite"
    arguments = ["campaign", "run", str(written(tmp_path)), "--out", str(store), "--no-report", "--runs", "1"]
    arguments += ["--realtime"] if realtime else []
    assert main(arguments) == 3
    assert main(arguments) == 3, "not by itself"
    assert main([*arguments, "--retry"]) == (0 if realtime else 3)
    assert {row.outcome for row in rows_in(store)} == {Outcome.MASKED if realtime else Outcome.INVALID}


@pytest.mark.long
def test_changes_are_another_experiment(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, fake: Callable[[str], None]
) -> None:
    """--set: a store of its own by default, so that pins on and pins off are not mixed."""
    fake("quick")
    monkeypatch.chdir(tmp_path)
    for changes in ([], ["--set", "rig.stops=on"]):
        assert main(["campaign", "run", str(written(tmp_path)), "--no-report", "--runs", "1", *changes]) == 0
    plain, changed = sorted((tmp_path / "results" / "campaigns").glob("*.sqlite"), key=lambda path: len(path.name))
    assert plain.name == "small.sqlite"
    assert changed.name.startswith("small-")
    assert {row.identity for row in rows_in(plain)}.isdisjoint(row.identity for row in rows_in(changed))


@pytest.mark.long
def test_report_is_written_where_asked(tmp_path: Path, fake: Callable[[str], None]) -> None:
    """Of a store alone: the campaign file and its scenario may be gone."""
    fake("quick")
    store, path = tmp_path / "s.sqlite", written(tmp_path)
    assert main(["campaign", "run", str(path), "--out", str(store), "--no-report"]) == 0
    path.unlink()
    html, junit = tmp_path / "a" / "r.html", tmp_path / "b" / "r.xml"
    assert main(["campaign", "report", str(store), "--html", str(html), "--junit", str(junit)]) == 0
    assert "two durations" in html.read_text(encoding="utf-8")
    assert junit.read_text(encoding="utf-8").startswith("<?xml")


@pytest.mark.long
def test_export_writes_all_runs(tmp_path: Path, fake: Callable[[str], None]) -> None:
    fake("quick")
    store = str(tmp_path / "s.sqlite")
    assert main(["campaign", "run", str(written(tmp_path)), "--out", store, "--no-report"]) == 0
    table, activations = tmp_path / "runs.csv", tmp_path / "injections.csv"
    assert main(["campaign", "export", store, "--csv", str(table), "--parquet", str(tmp_path / "runs.parquet")]) == 0
    assert main(["campaign", "export", store, "--csv", str(activations), "--injections"]) == 0
    assert len(table.read_text(encoding="utf-8").splitlines()) == 7
    assert len(activations.read_text(encoding="utf-8").splitlines()) == 13
    assert (tmp_path / "runs.parquet").stat().st_size > 0


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["run", "nothing.yaml"], "nothing.yaml: no such file"),
        (["status", "nothing.sqlite"], "no such file; `exo-hil campaign run` makes it"),
        (["status", "small.yaml"], "name a store that `exo-hil campaign run` has written"),
        (["export", "nothing.sqlite"], "give --csv FILE, --parquet FILE, or both"),
        (["replay", "nothing.sqlite", "1/0"], "no such file"),
        (["report", "nothing.sqlite"], "no such file"),
        (["run", "small.yaml", "--out", "small.yaml/s.sqlite"], "give another place with --out"),
        (["run", "small.yaml", "--set", "rig.stop=on"], "--set rig.stop=on: "),
        (["run", GOLDEN], "golden.yaml: this is a scenario; `exo-hil run "),
    ],
)
def test_bad_usage_exits_2_with_one_clear_line(
    arguments: list[str],
    words: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """No traceback, nothing run, nothing written."""
    monkeypatch.chdir(tmp_path)
    written(tmp_path)
    assert main(["campaign", *arguments]) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert words in err
    assert "Traceback" not in err
    assert [entry.name for entry in tmp_path.iterdir()] == ["small.yaml"]


def test_bad_file_writes_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Before the first run, before the store."""
    monkeypatch.chdir(tmp_path)
    path = written(tmp_path, ("values: [0.05 s, 0.3 s]", "values: [0.05 s, 0 s]"))
    assert main(["campaign", "run", str(path)]) == 2
    assert [entry.name for entry in tmp_path.iterdir()] == ["small.yaml"]


def test_store_of_another_campaign_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], fake: Callable[[str], None]
) -> None:
    fake("quick")
    store = str(tmp_path / "s.sqlite")
    assert main(["campaign", "run", str(written(tmp_path)), "--out", store, "--no-report"]) == 0
    other = written(tmp_path, ("name: small", "name: large"))
    assert main(["campaign", "run", str(other), "--out", store]) == 2
    assert "it is of campaign 'small', not 'large'" in capsys.readouterr().err


def test_check_says_what_a_campaign_will_do(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Points, runs, seeds, in words; mistakes as for a scenario."""
    path = written(tmp_path)
    assert main(["check", str(path)]) == 0
    out = capsys.readouterr().out
    assert "axis duration: 0.05 s, 0.3 s (2 values), sets injectors.freeze.effect.duration, inj" in out
    assert "2 points; 3 runs a point\nruns: 6; run k of every point has seed 5 + k\ntime: known when" in out
    figures = "report: {figures: [{x: duration, y: failure, to: 100 ms}, {x: duration, y: failure, from: 100 ms}]}"
    assert main(["check", str(written(tmp_path, ("seed: 5", f"seed: 5\n{figures}")))]) == 0
    shown = [line for line in capsys.readouterr().out.splitlines() if line.startswith("figure: ")]
    assert shown == ["figure: failure over duration to 0.1 s", "figure: failure over duration from 0.1 s"]
    written(tmp_path)
    assert main(["check", str(path), "--set", "rig.stops=maybe"]) == 2
    assert main(["check", str(path), "--seed", "3"]) == 2
    assert main(["check", str(written(tmp_path, ("runs: 3", "runs: 0")))]) == 2
    assert ":24:7: runs: " in capsys.readouterr().err


def test_help_of_campaign_imports_nothing_heavy() -> None:
    """Lazy imports: no numpy, mujoco, pydantic, matplotlib after --help."""
    program = (
        "import sys\nfrom testbench.cli import main\n"
        "try:\n main(['campaign', 'run', '--help'])\nexcept SystemExit:\n"
        " heavy = {'numpy', 'mujoco', 'pydantic', 'can', 'sqlite3', 'matplotlib', 'multiprocessing'}\n"
        " print(sorted(heavy & set(sys.modules)))\n"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stdout.splitlines()[-1] == "[]"


def worker_numbers(folder: Path) -> list[int]:
    return [int(path.stem) for path in folder.glob("*.pid")]


@pytest.mark.long
def test_ctrl_c_keeps_what_was_made_and_leaves_nobody(tmp_path: Path) -> None:
    """Exit 130, a line that says how to go on, every row that was made; the second one drops runs in flight."""
    store, path = tmp_path / "s.sqlite", written(tmp_path, ("runs: 3", "runs: 6"))
    arguments = ("campaign", "run", str(path), "--out", str(store), "--jobs", "2")
    process = exo_hil(tmp_path, *arguments, maker="hangs_from_3")
    once(process, lambda: has_rows(store, 3) and len(worker_numbers(tmp_path)) == 2)
    interrupt(process)
    assert process.stderr is not None
    for line in process.stderr:
        if "Ctrl-C again drops them" in line:
            break
    interrupt(process)
    out, err = process.communicate(timeout=300)
    if process.poll() is None or process.returncode != 130:
        raise AssertionError((process.returncode, out, err))
    assert "interrupted; the same command goes on from here: 3 runs are in" in err
    assert "Traceback" not in err
    assert len(rows_in(store)) == 3
    assert not [number for number in worker_numbers(tmp_path) if is_alive(number)]
    process = exo_hil(tmp_path, *arguments, "--no-report", maker="quick")
    out, err = process.communicate(timeout=300)
    assert process.returncode == 0, err
    assert "12 of 12 runs; 9 made" in out


@pytest.mark.long
def test_workers_leave_when_the_runner_is_killed(tmp_path: Path) -> None:
    """kill -9: the workers end by themselves in the middle of their runs, the lock is free, the rows are there."""
    store, path = tmp_path / "s.sqlite", written(tmp_path, ("runs: 3", "runs: 6"))
    process = exo_hil(tmp_path, "campaign", "run", str(path), "--out", str(store), "--jobs", "2", maker="hangs_from_3")
    once(process, lambda: has_rows(store, 3) and len(worker_numbers(tmp_path)) == 2)
    workers = worker_numbers(tmp_path)
    assert all(is_alive(number) for number in workers)
    process.kill()
    process.communicate(timeout=300)  # ends when nobody holds its pipes any more: the workers are gone, too
    assert not [number for number in workers if is_alive(number)]
    done = exo_hil(tmp_path, "campaign", "status", str(store))
    out, err = done.communicate(timeout=300)
    assert "small: broken off; 3 of 12 runs" in out, err
    assert len(rows_in(store)) == 3


@pytest.mark.run
def test_one_process_two_processes_and_resumed_after_kill_give_the_same_rows(tmp_path: Path) -> None:
    """Two points with three runs each, by the real rig: identical rows but for times, whoever made them how."""
    path = written(tmp_path)
    stores = [tmp_path / f"{name}.sqlite" for name in ("one", "two", "killed")]

    def command(store: Path, jobs: int) -> tuple[str, ...]:
        return ("campaign", "run", str(path), "--out", str(store), "--jobs", str(jobs), "--no-report")

    for store, jobs in zip(stores[:2], (1, 2), strict=True):
        done = exo_hil(tmp_path, *command(store, jobs))
        out, err = done.communicate(timeout=500)
        assert done.returncode == 0, out + err
    process = exo_hil(tmp_path, *command(stores[2], 2))
    once(process, lambda: has_rows(stores[2], 2))
    process.kill()
    process.communicate(timeout=300)
    kept = {row.identity for row in rows_in(stores[2])}
    assert 2 <= len(kept) < 6
    done = exo_hil(tmp_path, *command(stores[2], 2))
    out, err = done.communicate(timeout=500)
    assert done.returncode == 0, out + err
    assert f"{6 - len(kept)} made in" in out
    one, two, resumed = (rows_in(store) for store in stores)
    assert len(one) == 6
    assert one == two == resumed
    assert {row.outcome for row in one} - {Outcome.INVALID, Outcome.CRASHED, Outcome.HANG}


@pytest.mark.run
def test_replay_makes_a_run_again_with_everything(tmp_path: Path) -> None:
    """The same trace hash, in a result folder as `exo-hil run` writes it."""
    store, folder = tmp_path / "s.sqlite", tmp_path / "again"
    path = written(tmp_path, ("seed: 5", "seed: 5\ntraces: always"))
    assert main(["campaign", "run", str(path), "--out", str(store), "--runs", "1", "--no-report"]) == 0
    kept = {entry.name for entry in (tmp_path / "s-runs").iterdir()}
    assert kept == {row.identity[:16] for row in rows_in(store)}
    done = exo_hil(tmp_path, "campaign", "replay", str(store), "2/0", "--out", str(folder), "--json")
    out, err = done.communicate(timeout=300)
    assert done.returncode == 0, err
    document = json.loads(out)
    (row,) = [row for row in rows_in(store) if row.point.parameters == (("duration", "0.3 s"),)]
    assert document["same"] is True
    assert (document["run"], document["parameters"]) == ("2/0", {"duration": "0.3 s"})
    assert "injectors.freeze.effect.duration=0.3 s" in document["changes"]
    assert document["trace_hash"]["now"] == row.trace_hash
    summary = json.loads((folder / "summary.json").read_text(encoding="utf-8"))
    assert summary["trace_hash"]["faulted"] == row.trace_hash
    assert {"fault.png", "faulted.parquet", "drive.log"} <= {entry.name for entry in folder.iterdir()}
    there = tmp_path / "s-runs" / row.identity[:16]
    assert (there / "injections.csv").read_bytes() == (folder / "injections.csv").read_bytes()
    assert (there / "drive.log").read_bytes() == (folder / "drive.log").read_bytes()
    done = exo_hil(tmp_path, "campaign", "replay", str(store), "2/0", "--out", str(folder))
    out, err = done.communicate(timeout=300)
    first, *lines = out.splitlines()
    assert first == "run 2/0 of small, seed 5: duration = 0.3 s"
    changes = ("injectors.freeze.effect.duration=0.3 s", "injectors.zero.effect.duration=0.3 s")
    assert lines[:2] == [f"      {change}" for change in changes]
    kept = json.loads((folder / "summary.json").read_text(encoding="utf-8"))
    assert summary_text(kept) in out
    assert lines[-2:] == [f"outcome: {row.outcome.value}", f"the same as in the store: trace hash {row.trace_hash}"]
    assert f"result folder: {folder}" in err
    opened = open_store(store, write=True)
    assert changes_of(opened, row) == changes
    opened.set_meta({"changes": '["motion.duration=1 s"]'})  # the campaign as run last: another one
    assert changes_of(opened, row) == ()
    opened.close()
    done = exo_hil(tmp_path, "campaign", "replay", str(store), "9/0")
    assert "points 1..2" in done.communicate(timeout=300)[1]
    assert done.returncode == 2
