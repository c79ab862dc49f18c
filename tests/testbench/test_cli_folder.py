"""The command line: a result folder is replaced or refused, and a run that is broken off leaves none."""

import json
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import pytest

import testbench.cli
import testbench.run
from testbench.cli import main
from testbench.store import FILES
from tests.testbench.command_line import GOLDEN, PROGRAM, forbid_runs, names


@pytest.fixture
def place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty working directory."""
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture
def nothing_runs(monkeypatch: pytest.MonkeyPatch) -> None:
    forbid_runs(monkeypatch)


@pytest.mark.run
def test_next_result_replaces_the_previous_one(place: Path) -> None:
    """The same place twice: the second result, whole, and nothing left of the first."""
    for seed in ("1", "2"):
        assert main(["run", GOLDEN, "--set", "motion.duration=0.1s", "--seed", seed, "--out", "r"]) == 0
        document = json.loads((place / "r" / "summary.json").read_text(encoding="utf-8"))
        assert document["seed"] == int(seed)
    assert names(place) == ["r"]


def refused(capsys: pytest.CaptureFixture[str], out: str) -> str:
    assert main(["run", GOLDEN, "--out", out]) == 2
    captured = capsys.readouterr()
    assert captured.out == ""
    assert captured.err.startswith("result folder ")
    assert "--out" in captured.err  # the remedy
    return captured.err


@pytest.mark.usefixtures("nothing_runs")
def test_folder_of_somebody_else_is_refused_before_the_run(place: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Only a previous result is replaced; what else stands there is named, and stays."""
    (place / "thesis").mkdir()
    (place / "thesis" / "chapter1.tex").write_text("mine")
    assert "it holds 'chapter1.tex'" in refused(capsys, "thesis")
    assert (place / "thesis" / "chapter1.tex").read_text() == "mine"
    assert names(place / "thesis") == ["chapter1.tex"]


@pytest.mark.usefixtures("nothing_runs")
def test_result_of_another_scenario_is_refused_before_the_run(place: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Its numbers would be gone for a slip of the hand; whose it is, is said."""
    (place / "r").mkdir()
    (place / "r" / "summary.json").write_text('{"scenario": "weeks_of_work"}')
    (place / "r" / "scenario.yaml").write_text("name: weeks_of_work\n")
    said = refused(capsys, "r")
    assert "it holds a result of the scenario 'weeks_of_work', not of 'golden'; nothing was changed" in said
    assert (place / "r" / "summary.json").read_text() == '{"scenario": "weeks_of_work"}'


@pytest.mark.usefixtures("nothing_runs")
@pytest.mark.parametrize("out", ["file", "file/below", "file/far/below"])
def test_place_that_cannot_be_a_folder_is_refused_before_the_run(
    place: Path, capsys: pytest.CaptureFixture[str], out: str
) -> None:
    """A file where the folder, or one above it, should be: told before minutes of simulation, not after."""
    (place / "file").write_text("mine")
    assert "file" in refused(capsys, out)
    assert (place / "file").read_text() == "mine"
    assert names(place) == ["file"]


@pytest.mark.usefixtures("nothing_runs")
def test_place_without_permission_is_refused_before_the_run(place: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A parent one may not write in: told before the run."""
    (place / "locked").mkdir(mode=0o500)
    with suppress(OSError):
        (place / "locked" / "probe").mkdir()
        pytest.skip("permissions do not hold this user back")  # root may write anywhere: nothing to see
    assert "no permission to write" in refused(capsys, "locked/r")


# --- broken off ----------------------------------------------------------------------------------------------------


@contextmanager
def writing(folder: Path) -> Iterator[subprocess.Popen[str]]:
    """A run whose result is just being written; ended at the latest when the test is."""
    arguments = ["run", GOLDEN, "--set", "motion.duration=0.1s", "--out", "r"]
    command = [sys.executable, "-c", PROGRAM, *arguments]
    process = subprocess.Popen(command, cwd=folder, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    try:
        while not list(folder.glob(".r.*.part")):
            with suppress(subprocess.TimeoutExpired):
                process.wait(timeout=0.002)
                raise AssertionError(f"ended before anything was written: {process.communicate()}")
        yield process
    finally:
        process.kill()
        process.communicate()


@pytest.mark.run
@pytest.mark.skipif(sys.platform == "win32", reason="no signals to send")
def test_killed_run_leaves_no_result_and_the_next_one_no_rubbish(
    place: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """kill -9 in the middle of writing: no result folder; a rerun works and clears away what the killed one left."""
    with writing(place) as process:
        process.kill()
        process.wait()
    assert process.returncode == -signal.SIGKILL
    assert not (place / "r").exists()
    assert [name[:3] for name in names(place)] == [".r."]  # hidden, and known by its name
    assert main(["run", GOLDEN, "--set", "motion.duration=0.1s", "--out", "r", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["valid"] is True
    assert names(place) == ["r"]
    assert set(names(place / "r")) == FILES - {"triggers.png"}  # nothing is triggered


@pytest.mark.run
@pytest.mark.skipif(sys.platform == "win32", reason="no signals to send")
def test_run_that_is_still_writing_is_not_disturbed(place: Path) -> None:
    """Two runs into one place at once: what a living process has written so far is no rubbish, and stays."""
    with writing(place) as process:
        process.send_signal(signal.SIGSTOP)
        others = names(place)
        assert main(["run", GOLDEN, "--set", "motion.duration=0.1s", "--out", "r"]) == 0
        assert names(place) == sorted([*others, "r"])
        process.send_signal(signal.SIGCONT)
        assert process.wait(timeout=60) == 0
    assert names(place) == ["r"]


@pytest.mark.run
@pytest.mark.skipif(sys.platform == "win32", reason="no signals to send")
def test_interrupt_while_writing_leaves_nothing(place: Path) -> None:
    """Ctrl-C: one line on stderr, nothing on stdout or on the disk, an exit code that is no verdict."""
    with writing(place) as process:
        process.send_signal(signal.SIGINT)
        out, err = process.communicate(timeout=60)
    assert (out, err) == ("", "interrupted\n")
    assert process.returncode == 130
    assert names(place) == []


@pytest.mark.run
@pytest.mark.parametrize("share", [0.0, 0.3, 0.9])
def test_interrupt_while_simulating_leaves_nothing(
    place: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, share: float
) -> None:
    """Ctrl-C in the golden run or in the faulted one: gone at once, without a trace."""

    @contextmanager
    def interrupted(name: str) -> Iterator[Callable[[float], None]]:
        def progress(done: float) -> None:
            if done >= share:
                signal.raise_signal(signal.SIGINT)

        before = signal.signal(signal.SIGINT, signal.default_int_handler)
        try:
            yield progress
        finally:
            signal.signal(signal.SIGINT, before)

    monkeypatch.setattr(testbench.cli, "_progress", interrupted)
    assert main(["run", GOLDEN, "--set", "motion.duration=0.1s"]) == 130
    captured = capsys.readouterr()
    assert (captured.out, captured.err) == ("", "interrupted\n")
    assert names(place) == []


def test_interrupt_while_a_package_loads_is_an_interrupt(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Compiled packages turn Ctrl-C into an ImportError; a package that is really missing is named, with the remedy."""

    def load(interrupted: bool) -> Callable[[object], int]:
        def verb(options: object) -> int:
            try:
                if interrupted:
                    raise KeyboardInterrupt
            except KeyboardInterrupt as error:
                raise ImportError("initialization failed") from error
            raise ModuleNotFoundError("No module named 'mujoco'", name="mujoco")

        return verb

    monkeypatch.setattr(testbench.cli, "_check", load(True))
    assert main(["check", GOLDEN]) == 130
    assert capsys.readouterr().err == "interrupted\n"
    monkeypatch.setattr(testbench.cli, "_check", load(False))
    assert main(["check", GOLDEN]) == 2
    assert capsys.readouterr().err == "mujoco is not installed; a run needs the extra sim: pip install 'exo-hil[sim]'\n"


def test_defect_of_the_program_is_no_verdict(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Exit 1 means that a verdict failed; a crash has the exit code of a run that proves nothing."""

    def verb(options: object) -> int:
        raise ZeroDivisionError("no number")

    monkeypatch.setattr(testbench.cli, "_check", verb)
    assert main(["check", GOLDEN]) == 3
    assert "defect of the program" in capsys.readouterr().err
