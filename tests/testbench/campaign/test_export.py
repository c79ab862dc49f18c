"""One flat table of all runs, for other programs."""

import csv
from pathlib import Path

import pyarrow.parquet as pq
import pytest

from testbench.campaign.file.values import number_of
from testbench.campaign.records import Outcome, RunRow
from testbench.campaign.store.export import injection_table, run_table, write_csv, write_parquet
from testbench.errors import BenchError
from tests.testbench.campaign.workers import row_of, spec

ROWS = [
    row_of(spec(1, axis="50 ms")),
    row_of(spec(2, axis="90 ms")),
    RunRow("none", spec(0, axis="50 ms").wanted.point, 3, 3, Outcome.CRASHED, 'why "so", he asked\n'),
]


def test_table_has_axes_as_written_and_in_si() -> None:
    """A run each, empty where there is nothing."""
    table = run_table(ROWS)
    assert table["axis"] == ["50 ms", "90 ms", "50 ms"]
    assert table["axis.si"] == [0.05, 0.09, 0.05]
    assert table["outcome"] == ["masked", "failure_silent", "crashed"]
    assert table["right_knee.rmse_position_rad"] == [0.25, 0.5, None]
    assert table["first_start_s"] == [0.5, 0.5, None]
    assert table["version.code"] == ["1", "1", None]
    assert {len(values) for values in table.values()} == {3}
    assert number_of("off") is None
    assert "axis.si" not in run_table([row_of(spec(1, axis="off"))])


def test_csv_reads_back(tmp_path: Path) -> None:
    """Quotes, commas and line breaks in a reason; numbers keep all their digits."""
    path = tmp_path / "new" / "runs.csv"
    table = run_table(ROWS)
    write_csv(table, path)
    with path.open(encoding="utf-8", newline="") as file:
        read = list(csv.DictReader(file))
    assert [line["reason"] for line in read] == ["", "", 'why "so", he asked\n']
    assert [line["axis.si"] for line in read] == ["0.05", "0.09", "0.05"]
    assert list(read[0]) == list(table)
    assert [entry.name for entry in path.parent.iterdir()] == ["runs.csv"]


def test_parquet_reads_back_with_units(tmp_path: Path) -> None:
    """Types and missing values stay; the unit is in a column's metadata."""
    path = tmp_path / "runs.parquet"
    table = run_table(ROWS)
    write_parquet(table, path)
    read = pq.read_table(path)
    assert read.to_pydict() == table
    units = {name: (read.schema.field(name).metadata or {}).get(b"unit") for name in table}
    assert units["axis.si"] == b"s"
    assert units["right_knee.rmse_position_rad"] == b"rad"
    assert units["beyond_deg"] == b"deg"
    assert units["outcome"] is None


def test_injections_are_a_table_of_their_own() -> None:
    """A line an activation, with the run it belongs to."""
    table = injection_table(ROWS)
    assert table["identity"] == ["50 ms-1"] * 2 + ["90 ms-2"] * 2
    assert table["signal"] == ["right_knee.position"] * 4
    assert table["end_s"] == [None] * 4


def test_place_that_cannot_be_written_is_said(tmp_path: Path) -> None:
    """And nothing is left there."""
    (tmp_path / "file").touch()
    with pytest.raises(BenchError, match=r"cannot be written: .*give another place"):
        write_csv(run_table(ROWS), tmp_path / "file" / "runs.csv")
    (tmp_path / "folder").mkdir()
    with pytest.raises(BenchError, match="cannot be written"):
        write_csv(run_table(ROWS), tmp_path / "folder")
    assert sorted(entry.name for entry in tmp_path.iterdir()) == ["file", "folder"]
