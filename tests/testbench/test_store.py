"""The result folder: whole, or not there; nobody else's files are touched."""

import errno
import os
import stat
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
from can.io.canutils import CanutilsLogReader

from hlc.limits import limits_of
from testbench.errors import BenchError
from testbench.record import RunRecord
from testbench.store import FILES, Writer, check_folder, default_folder, result_files, write_result
from testbench.summary import summary_document
from testbench.verdict import judge

RunMaker = Callable[..., RunRecord]

SIX = ("left_hip", "left_knee", "left_ankle", "right_hip", "right_knee", "right_ankle")


def text_writer(text: str) -> Writer:
    def write(path: Path) -> None:
        path.write_text(text)

    return write


def small(text: str = "one") -> dict[str, Writer]:
    """The two files that make a folder a result."""
    return {"scenario.yaml": text_writer("name: x\n"), "summary.json": text_writer(text)}


@pytest.fixture(scope="module")
def runs(run_maker: RunMaker) -> tuple[RunRecord, RunRecord]:
    return run_maker(duration_s=0.5, start_s=0.1, end_s=0.2), run_maker(
        duration_s=0.5, start_s=0.1, end_s=0.2, bump_rad=0.5
    )


@pytest.fixture
def files(runs: tuple[RunRecord, RunRecord]) -> dict[str, Writer]:
    golden, faulted = runs
    judgement = judge(SIX, {joint: limits_of(joint) for joint in SIX}, golden, faulted)
    summary = summary_document("x", 1, golden, faulted, judgement, injectors=0, sim_time_s=1.0, wall_time_s=1.0)
    return result_files("name: x\n", summary, SIX, golden, faulted)


def names(folder: Path) -> list[str]:
    return sorted(entry.name for entry in folder.iterdir())


def fail_with(error: BaseException) -> Writer:
    def write(path: Path) -> None:
        path.write_text("half a file")
        raise error

    return write


def test_folder_holds_what_the_design_lists(tmp_path: Path, files: dict[str, Writer]) -> None:
    """Design: scenario as run, summary.json, a candump log per bus, joint traces as Parquet; no other files."""
    folder = write_result(tmp_path / "results" / "x-1", files)
    assert set(names(folder)) == FILES - {"fault.png", "joints.png", "triggers.png"}
    assert names(folder.parent) == ["x-1"]
    assert (folder / "scenario.yaml").read_text() == "name: x\n"
    assert b"\r" not in (folder / "summary.json").read_bytes()


def test_each_log_has_the_frames_of_its_bus_and_run(
    tmp_path: Path, files: dict[str, Writer], runs: tuple[RunRecord, RunRecord]
) -> None:
    """A candump log per bus, named after it."""
    folder = write_result(tmp_path / "r", files)
    for name in ("controller", "drive"):
        for log in (f"{name}.log", f"golden_{name}.log"):
            messages = list(CanutilsLogReader(folder / log))
            assert len(messages) == len(runs[0].rows) // 2
            assert {message.channel for message in messages} == {name}


def test_parquet_gives_back_every_number_with_its_unit(
    tmp_path: Path, files: dict[str, Writer], runs: tuple[RunRecord, RunRecord]
) -> None:
    """Joint traces survive to the last bit; each column says its unit."""
    folder = write_result(tmp_path / "r", files)
    for name, run in zip(("golden", "faulted"), runs, strict=True):
        table = pq.read_table(folder / f"{name}.parquet")
        assert np.array_equal(table["time_s"].to_numpy(), run.truth.t_s)
        for k, joint in enumerate(SIX):
            for column, values in (("q", run.truth.q), ("dq", run.truth.dq), ("tau", run.truth.tau)):
                assert np.array_equal(table[f"{joint}.{column}"].to_numpy(), values[:, k])
        units = {field.name: field.metadata[b"unit"].decode() for field in table.schema}
        assert units["time_s"] == "s"
        assert (units["left_hip.q"], units["left_hip.dq"], units["left_hip.tau"]) == ("rad", "rad/s", "N m")
        said = pq.read_table(folder / f"{name}_commands.parquet")
        assert np.array_equal(said["right_knee.tau_command"].to_numpy(), run.commands.tau_command[:, 4])
        assert np.array_equal(said["right_ankle.q_ref"].to_numpy(), run.commands.q_ref[:, 5])


def test_previous_result_is_replaced_whole(tmp_path: Path) -> None:
    """The old result goes when the new one is complete; none of its files stay."""
    folder = tmp_path / "r"
    write_result(folder, small("old") | {"drive.log": text_writer("old")})
    write_result(folder, small("new"))
    assert names(folder) == ["scenario.yaml", "summary.json"]
    assert (folder / "summary.json").read_text() == "new"
    assert names(tmp_path) == ["r"]


def test_empty_folder_is_used(tmp_path: Path) -> None:
    """`--out` may name a folder made for it."""
    (tmp_path / "r").mkdir()
    write_result(tmp_path / "r", small())
    assert names(tmp_path / "r") == ["scenario.yaml", "summary.json"]
    assert names(tmp_path) == ["r"]


@pytest.mark.parametrize(
    "content",
    [
        ["thesis.tex"],
        ["summary.json"],
        ["scenario.yaml"],
        ["scenario.yaml", "summary.json", "notes.md"],
        ["scenario.yaml", "summary.json", "my_plot.png"],
        ["scenario.yaml", "summary.json", ".git"],
        ["drive.log"],
    ],
)
def test_folder_with_anything_of_somebody_elses_is_refused_untouched(tmp_path: Path, content: list[str]) -> None:
    """Only a previous result and nothing else is ever replaced."""
    folder = tmp_path / "r"
    folder.mkdir()
    for name in content:
        (folder / name).write_text("mine")
    for attempt in (lambda: check_folder(folder), lambda: write_result(folder, small())):
        with pytest.raises(BenchError, match=r"previous result.*--out"):
            attempt()
    assert names(folder) == sorted(content)
    assert all((folder / name).read_text() == "mine" for name in content)
    assert names(tmp_path) == ["r"]


@pytest.mark.parametrize(
    ("summary", "is_refused"),
    [
        ('{"scenario": "y", "seed": 1}', True),
        ('{"scenario": "x", "seed": 1}', False),
        ("{}", False),
        ("[1]", False),
        ('{"scenario": 5}', False),
        ("half of a", False),
    ],
)
def test_result_of_another_scenario_is_refused(tmp_path: Path, summary: str, is_refused: bool) -> None:
    """A previous result is one of the same scenario, whatever its seed, or one that does not say of which."""
    write_result(tmp_path / "r", small(summary))
    check_folder(tmp_path / "r")
    if is_refused:
        with pytest.raises(BenchError, match=r"scenario 'y', not of 'x'.*--out"):
            check_folder(tmp_path / "r", "x")
    else:
        check_folder(tmp_path / "r", "x")


def test_file_in_the_way_is_refused_untouched(tmp_path: Path) -> None:
    """A file is no folder, neither at the place nor above it."""
    (tmp_path / "r").write_text("mine")
    for folder in (tmp_path / "r", tmp_path / "r" / "deeper" / "x"):
        with pytest.raises(BenchError, match="file"):
            check_folder(folder)
        with pytest.raises(BenchError, match="file"):
            write_result(folder, small())
    assert (tmp_path / "r").read_text() == "mine"


@pytest.mark.skipif(os.name == "nt" or os.geteuid() == 0, reason="permissions do not hold this user back")
def test_place_without_permission_is_refused_before_the_run(tmp_path: Path) -> None:
    """check_folder tells before minutes of simulation, not after."""
    tmp_path.chmod(stat.S_IRUSR | stat.S_IXUSR)
    try:
        with pytest.raises(BenchError, match="permission"):
            check_folder(tmp_path / "r")
    finally:
        tmp_path.chmod(stat.S_IRWXU)


def test_name_too_long_for_the_system_is_told(tmp_path: Path) -> None:
    """What the system cannot do is an error of ours, not a traceback."""
    with pytest.raises(BenchError, match="--out"):
        write_result(tmp_path / ("x" * 300), small())
    assert names(tmp_path) == []


@pytest.mark.parametrize("before", [False, True], ids=["new place", "previous result"])
@pytest.mark.parametrize(
    ("error", "raised"),
    [
        (OSError(errno.ENOSPC, "No space left on device"), BenchError),
        (KeyboardInterrupt(), KeyboardInterrupt),
        (BenchError("from a writer"), BenchError),
    ],
    ids=["disk full", "interrupt", "error"],
)
def test_what_fails_while_writing_leaves_nothing(
    tmp_path: Path, before: bool, error: BaseException, raised: type[BaseException]
) -> None:
    """Complete or not at all: no half folder, no new parents; a previous result is as it was."""
    folder = tmp_path / "a" / "b" / "r"
    if before:
        write_result(folder, small("old"))
    with pytest.raises(raised) as caught:
        write_result(folder, small("new") | {"drive.log": fail_with(error)})
    if isinstance(error, OSError):
        assert "No space left on device" in str(caught.value)
        assert str(folder) in str(caught.value)
    if before:
        assert names(folder.parent) == ["r"]
        assert (folder / "summary.json").read_text() == "old"
    else:
        assert names(tmp_path) == []


def test_limit_of_the_system_is_met_by_every_kind_of_writer(tmp_path: Path, files: dict[str, Writer]) -> None:
    """A real refusal by the kernel (no file beyond 2 kB), at a text and at a Parquet file."""
    resource = pytest.importorskip("resource")
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    for name in ("faulted.parquet", "summary.json"):
        resource.setrlimit(resource.RLIMIT_FSIZE, (2048, hard))
        try:
            with pytest.raises(BenchError, match="cannot be written"):
                write_result(tmp_path / "r", small() | {name: files[name]})
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
        assert names(tmp_path) == []


def test_failure_to_put_the_new_folder_in_place_brings_the_old_one_back(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Between the two renames the previous result stands aside; it comes back."""
    folder = tmp_path / "r"
    write_result(folder, small("old"))
    rename = Path.rename

    def refuse(self: Path, target: Path) -> Path:
        if self.name.endswith(".part"):
            raise OSError(errno.EIO, "Input/output error")
        return rename(self, target)

    monkeypatch.setattr(Path, "rename", refuse)
    with pytest.raises(BenchError, match="Input/output error"):
        write_result(folder, small("new"))
    assert names(tmp_path) == ["r"]
    assert (folder / "summary.json").read_text() == "old"


def test_left_over_of_another_writer_is_not_touched(tmp_path: Path) -> None:
    """Two runs into one place at once do not mix their files: each has its own folder until the end."""
    (tmp_path / ".r.0.part").mkdir()
    (tmp_path / ".r.0.part" / "summary.json").write_text("another's")
    write_result(tmp_path / "r", small())
    assert names(tmp_path / "r") == ["scenario.yaml", "summary.json"]
    assert names(tmp_path / ".r.0.part") == ["summary.json"]


def test_link_to_a_result_stays_a_link(tmp_path: Path) -> None:
    """`latest -> x-1` goes on naming the result that was replaced."""
    write_result(tmp_path / "x-1", small("old"))
    (tmp_path / "latest").symlink_to("x-1")
    assert write_result(tmp_path / "latest", small("new")) == (tmp_path / "x-1").resolve()
    assert (tmp_path / "latest").is_symlink()
    assert (tmp_path / "x-1" / "summary.json").read_text() == "new"


@pytest.mark.skipif(os.name == "nt", reason="permission bits")
def test_folder_has_the_usual_permissions(tmp_path: Path) -> None:
    """A result is readable by whoever may read what this user makes."""
    (tmp_path / "plain").mkdir()
    folder = write_result(tmp_path / "r", small())
    assert stat.S_IMODE(folder.stat().st_mode) == stat.S_IMODE((tmp_path / "plain").stat().st_mode)


def test_file_the_folder_could_not_be_recognised_by_is_refused(tmp_path: Path) -> None:
    """What is written must be known, or the next run would refuse to replace it."""
    with pytest.raises(BenchError, match=r"'extra.txt' given, allowed are"):
        write_result(tmp_path / "r", small() | {"extra.txt": text_writer("x")})
    assert names(tmp_path) == []


@pytest.mark.parametrize(
    ("name", "folder"),
    [
        ("knee_freeze", "knee_freeze-7"),
        ("../../etc", "_.._etc-7"),
        ("a/b c", "a_b_c-7"),
        ("..", "scenario-7"),
        ("", "scenario-7"),
        ("x" * 500, "x" * 100 + "-7"),
    ],
)
def test_default_folder_never_leaves_results(name: str, folder: str) -> None:
    """The scenario's name is a name, not a path."""
    assert default_folder(name, 7) == Path("results") / folder
