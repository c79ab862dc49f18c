"""`exo-hil run --replay`: the faults of a result folder, once more."""

import csv
import json
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

from testbench.cli import main

pytestmark = pytest.mark.run

RANDOM = """\
name: random
description: faults that draw when, how long and what, chained, before and after the motion
rig: {plant: suspended, stops: on, rate: 500 Hz}
motion: {gait: walking, stride: 1.5 s, duration: 0.5 s}
seed: 11
injectors:
  flips:
    target: {bus: to_controller, node: right_knee, signal: velocity}
    fault: {type: bit_flip, count: 2}
    event: {type: failure_probability, p: 0.05, per: 1 ms}
    effect: {type: constant_time, duration: 20 ms}
  losses:
    target: {bus: both, pdo: TPDO1}
    fault: {type: drop, probability: 30 %}
    event: {type: never}
    effect: {type: constant_time, duration: 11 ms}
    trigger: {any: [flips]}
  command:
    target: {bus: to_drives, node: left_hip, signal: target_torque}
    fault: {type: bit_flip, count: 1}
    event: {type: at, time: 0.2 s}
    effect: {type: once}
  early:
    target: {bus: to_controller, node: left_knee, signal: statusword}
    fault: {type: stuck_at}
    event: {type: failure_probability, p: 0.004, per: 1 ms}
    effect: {type: constant_time, duration: 30 ms}
    from: power_up
"""

Runner = Callable[..., dict[str, object]]


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The result folder of a run in which everything is random."""
    folder = tmp_path_factory.mktemp("recorded")
    (folder / "random.yaml").write_text(RANDOM)
    assert main(["run", str(folder / "random.yaml"), "--out", str(folder / "result")]) in (0, 1)
    return folder / "result"


@pytest.fixture
def again(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> Runner:
    """Replays a folder; returns the document."""

    def run(folder: Path, *arguments: str) -> dict[str, object]:
        code = main(["run", "--replay", str(folder), "--json", "--out", str(tmp_path / "again"), *arguments])
        out, err = capsys.readouterr()
        assert code in (0, 1), err
        document = json.loads(out)
        assert isinstance(document, dict)
        return document

    return run


def document_of(folder: Path) -> dict[str, object]:
    found = json.loads((folder / "summary.json").read_text())
    assert isinstance(found, dict)
    return found


def rows_of(folder: Path, *left_out: str) -> list[dict[str, str]]:
    with (folder / "injections.csv").open(newline="") as file:
        rows = [{key: value for key, value in row.items() if key not in left_out} for row in csv.DictReader(file)]
    return sorted(rows, key=lambda row: (row["injector"], int(row["index"])))


def test_replay_gives_the_same_frames_and_the_same_judgement(recorded: Path, again: Runner, tmp_path: Path) -> None:
    """Same windows, no draws of events: same trace hash, and everything that follows from it."""
    before, after = document_of(recorded), again(recorded)
    assert after["trace_hash"] == before["trace_hash"]
    hashes = before["trace_hash"]
    assert isinstance(hashes, dict)
    assert hashes["golden"] != hashes["faulted"]
    assert after["replay"] == {"trace_hash": hashes["faulted"], "same": True}
    for key in ("verdict", "outcome", "counts", "joints", "errors", "failures", "time0_s", "power_up_s"):
        assert after[key] == before[key]
    planned = ("cause", "due_s", "duration_s")  # what was meant; of a replay that is what was recorded
    rows = rows_of(recorded, *planned)
    assert rows == rows_of(tmp_path / "again", *planned)
    assert {row["injector"] for row in rows} == {"flips", "losses", "command", "early"}
    assert {row["cause"] for row in rows_of(recorded)} == {"event", "trigger:flips"}
    assert {row["cause"] for row in rows_of(tmp_path / "again")} == {"event"}


def test_record_reaches_from_power_up_to_the_end_of_the_run(recorded: Path) -> None:
    """What began before time 0, or after the motion, made frames of the trace as well."""
    starts = [float(row["start_s"]) for row in rows_of(recorded)]
    document = document_of(recorded)
    assert min(starts) < 0
    assert max(starts) >= 0.5
    injections = document["injections"]
    assert isinstance(injections, list)
    assert len(injections) < len(starts)  # those after the motion are not judged


def test_other_rig_meets_the_same_faults(recorded: Path, again: Runner, tmp_path: Path) -> None:
    """--set changes the rig and not the windows; that the frames differ is said."""
    after = again(recorded, "--set", "motion.stride=1.6s")
    replay = after["replay"]
    assert isinstance(replay, dict)
    assert replay["same"] is False
    columns = ("injector", "start_s", "end_s")
    wanted = [tuple(row[key] for key in columns) for row in rows_of(recorded) if row["injector"] == "command"]
    found = [tuple(row[key] for key in columns) for row in rows_of(tmp_path / "again") if row["injector"] == "command"]
    assert found == wanted


def test_rows_taken_out_are_not_applied(recorded: Path, again: Runner, tmp_path: Path) -> None:
    """Which of many faults did it: the record can be cut down by hand."""
    folder = tmp_path / "fewer"
    shutil.copytree(recorded, folder)
    head, *rows = (folder / "injections.csv").read_text().splitlines()
    (one,) = (row for row in rows if row.startswith("command,"))
    (folder / "injections.csv").write_text(f"{head}\n{one}\n")
    after = again(folder)
    injections = after["injections"]
    assert isinstance(injections, list)
    assert [entry["injector"] for entry in injections] == ["command"]
    (kept,) = (row for row in rows_of(tmp_path / "again") if row["injector"] == "command")
    assert kept["stream"] == one.rpartition(",")[2]


def refused(capsys: pytest.CaptureFixture[str], *arguments: str) -> str:
    assert main(["run", *arguments]) == 2
    out, err = capsys.readouterr()
    assert out == ""
    return err


def test_command_line_needs_a_scenario_or_a_folder(
    capsys: pytest.CaptureFixture[str], recorded: Path, tmp_path: Path
) -> None:
    """One of the two, and nothing that a replay has not got."""
    assert "one of the two" in refused(capsys)
    assert "one of the two" in refused(capsys, "x.yaml", "--replay", str(recorded))
    assert "leave out --realtime" in refused(capsys, "--replay", str(recorded), "--realtime")
    assert "leave out --realtime" in refused(capsys, "--replay", str(recorded), "--seed", "3")
    assert "there is no scenario.yaml in it" in refused(capsys, "--replay", str(tmp_path))


@pytest.mark.parametrize(
    ("name", "change", "words"),
    [
        ("injections.csv", lambda text: text.replace("\ncommand,", "\nother,"), "'other' is not in the scenario"),
        ("injections.csv", lambda text: text[:-3] + "zz\n", "no state|random stream"),
        ("summary.json", lambda text: "{}", "is no summary of a result"),
        ("summary.json", lambda text: "[" + text, "is no summary of a result"),
        ("scenario.yaml", lambda text: text.replace("500 Hz", "501 Hz"), "scenario.yaml:"),
    ],
)
def test_damaged_folder_is_refused_before_anything_runs(
    capsys: pytest.CaptureFixture[str],
    recorded: Path,
    tmp_path: Path,
    name: str,
    change: Callable[[str], str],
    words: str,
) -> None:
    """Exit code 2, and the file by name."""
    folder = tmp_path / "damaged"
    shutil.copytree(recorded, folder)
    (folder / name).write_text(change((folder / name).read_text()))
    err = refused(capsys, "--replay", str(folder), "--out", str(tmp_path / "out"))
    assert any(word in err for word in words.split("|")), err
    assert name in err
    assert not (tmp_path / "out").exists()
