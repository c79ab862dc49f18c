"""The runs of a store as one flat table, for other programs: CSV, or Parquet with the units in its metadata.

A line a run: its place on the grid (each axis as written, and as a number in SI where it is one), outcome, numbers,
metrics. Cells without a value are empty. Injections: a table of their own, joined by `identity`.
"""

import csv
import os
from collections.abc import Callable, Sequence
from dataclasses import fields
from pathlib import Path
from typing import Final

from testbench.campaign.file.values import number_of
from testbench.campaign.records import UNITS, InjectionRow, Outcome, RunRow
from testbench.errors import BenchError

Cell = str | int | float | None
Table = dict[str, list[Cell]]

_FLAT: Final = tuple(
    entry.name for entry in fields(RunRow) if entry.name not in ("point", "metrics", "injections", "versions")
)


def run_table(rows: Sequence[RunRow]) -> Table:
    """Column -> values, all of equal length; axes are `axis` (as written) and `axis.si`."""
    axes = dict.fromkeys(name for row in rows for name, _ in row.point.parameters)
    metrics = dict.fromkeys(name for row in rows for name in row.metrics)
    versions = dict.fromkeys(name for row in rows for name in row.versions)
    table: Table = {}
    for name in axes:
        written = [dict(row.point.parameters).get(name) for row in rows]
        numbers = [None if text is None else number_of(text) for text in written]
        table[name] = list(written)
        if any(number is not None for number in numbers):
            table[f"{name}.si"] = [None if number is None else number.value for number in numbers]
    for name in _FLAT:
        table[name] = [_cell(getattr(row, name)) for row in rows]
    for name in metrics:
        table[name] = [row.metrics.get(name) for row in rows]
    for name in versions:
        table[f"version.{name}"] = [row.versions.get(name) for row in rows]
    return table


def injection_table(rows: Sequence[RunRow]) -> Table:
    """Column -> values: a line an activation, with the identity of its run."""
    pairs = [(row.identity, one) for row in rows for one in row.injections]
    table: Table = {"identity": [identity for identity, _ in pairs]}
    for entry in fields(InjectionRow):
        table[entry.name] = [_cell(getattr(one, entry.name)) for _, one in pairs]
    return table


def write_csv(table: Table, path: Path) -> None:
    """As RFC 4180 has it, UTF-8, a head line; whole or not at all. Raises BenchError."""

    def write(unfinished: Path) -> None:
        with unfinished.open("w", encoding="utf-8", newline="") as file:
            writer = csv.writer(file)
            writer.writerow(table)
            writer.writerows(zip(*table.values(), strict=True))

    _whole(path, write)


def write_parquet(table: Table, path: Path) -> None:
    """With the unit of each column in its metadata; whole or not at all. Raises BenchError. Imports pyarrow."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    arrays = [pa.array(values) for values in table.values()]
    units = [_unit(name, values, table) for name, values in table.items()]
    columns = [
        pa.field(name, array.type, True, {"unit": unit} if unit else None)
        for name, array, unit in zip(table, arrays, units, strict=True)
    ]
    made = pa.Table.from_arrays(arrays, schema=pa.schema(columns))
    _whole(path, lambda unfinished: pq.write_table(made, unfinished, compression="zstd"))


def _whole(path: Path, write: Callable[[Path], None]) -> None:
    unfinished = path.with_name(f".{path.name}.{os.getpid()}.unfinished")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        try:
            write(unfinished)
            unfinished.replace(path)
        finally:
            unfinished.unlink(missing_ok=True)
    except OSError as error:
        raise BenchError(f"{path}: cannot be written: {error.strerror or error}; give another place") from error


def _cell(value: object) -> Cell:
    if isinstance(value, Outcome):
        return value.value
    assert value is None or isinstance(value, str | int | float)
    return value


def _unit(name: str, values: Sequence[Cell], table: Table) -> str:
    """The unit of a column: of an axis that of its values, else what its name ends with."""
    axis = name.removesuffix(".si")
    if axis != name:
        first = next((number_of(str(text)) for text in table[axis] if text is not None), None)
        return "" if first is None else first.unit
    numeric = any(isinstance(value, float) for value in values)
    return next((unit for ending, unit in UNITS if numeric and name.endswith(ending)), "")
