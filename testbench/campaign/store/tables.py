"""What a store holds, table by table: points of the grid, runs with their activations, and who ran them when."""

import json
import sqlite3
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Final, final

from testbench.campaign.file.values import number_of
from testbench.campaign.records import InjectionRow, Outcome, Point, RunRow
from testbench.campaign.store.database import INJECTION, NUMBERED, Database, StoreError

_JSON: Final = ("metrics", "versions")


@dataclass(frozen=True, slots=True)
class Recipe:
    """How a run is made again. scenario: resolved YAML with seed 0; the rest as in RunSpec."""

    scenario: str
    code_version: str
    stop_on: str | None
    grace_s: float


@dataclass(frozen=True, slots=True)
class Invocation:
    """One `campaign run` on the store. started, ended: UTC, "" while it runs; how: "done", "interrupted", ..."""

    started: str
    ended: str
    wall_s: float
    jobs: int
    made: int
    machine: str
    code_version: str
    command: str
    how: str


@final
class Points:
    """Points by their numbers, 1, 2, ... in the order in which they came; a number is never given twice."""

    def __init__(self, database: Database) -> None:
        self._database: Final[Database] = database

    def add(self, points: Iterable[Point]) -> None:
        """Give the points their numbers; those that have one keep it."""
        with self._database.writing() as connection:
            for point in points:
                number_in(connection, point)

    def all(self) -> dict[int, Point]:
        """Also those that the file no longer has."""
        with self._database.reading() as connection:
            return dict(_read_points(connection))


@final
class Runs:
    """Runs, each once by its identity."""

    def __init__(self, database: Database) -> None:
        self._database: Final[Database] = database

    def append(self, row: RunRow, recipe: Recipe) -> None:
        """Keep a run that is wanted, in the place of one with the same identity."""
        values = [_column(row, name) for name in NUMBERED]
        columns = f"identity, point, scenario, code_version, stop_on, grace_s, wanted, {', '.join(NUMBERED)}"
        with self._database.writing() as connection:
            connection.execute("DELETE FROM runs WHERE identity = ?", (row.identity,))
            scenario, _ = _numbered(connection, "scenarios", "yaml", recipe.scenario)
            how = (recipe.code_version, recipe.stop_on, recipe.grace_s)
            head = (row.identity, number_in(connection, row.point), scenario, *how, 1)
            marks = ", ".join("?" * (len(head) + len(values)))
            run = connection.execute(f"INSERT INTO runs ({columns}) VALUES ({marks})", (*head, *values)).lastrowid
            marks = ", ".join("?" * (2 + len(INJECTION)))
            rows = [(run, at, *(getattr(one, name) for name in INJECTION)) for at, one in enumerate(row.injections)]
            connection.executemany(f"INSERT INTO injections VALUES ({marks})", rows)

    def want(self, identities: Mapping[str, tuple[Point, int]], *, only: bool) -> None:
        """Say which runs count: identity -> its point and number. only: all others stay, and count no more."""
        with self._database.writing() as connection:
            rows = [(number_in(connection, point), number, name) for name, (point, number) in identities.items()]
            if only:
                connection.execute("UPDATE runs SET wanted = 0 WHERE wanted")
            connection.executemany("UPDATE runs SET wanted = 1, point = ?, number = ? WHERE identity = ?", rows)

    def forget(self, outcomes: Iterable[Outcome], code_version: str) -> int:
        """Remove runs of a version with one of the outcomes, so that they are made again; how many there were."""
        values = [outcome.value for outcome in outcomes]
        marks = ", ".join("?" * len(values))
        with self._database.writing() as connection:
            asked = f"DELETE FROM runs WHERE code_version = ? AND outcome IN ({marks})"
            return connection.execute(asked, (code_version, *values)).rowcount

    def all(self, *, code_version: str = "", wanted: bool = True, brief: bool = False) -> list[RunRow]:
        """Runs, by point and number.

        code_version: only of that one; wanted: only those that count; brief: without metrics and activations, which
        are most of what a run takes.
        """
        where = [*(["runs.wanted"] if wanted else []), *(["runs.code_version = ?"] if code_version else [])]
        text = f"WHERE {' AND '.join(where)}" if where else ""
        given = (code_version,) if code_version else ()
        columns = ", ".join("'{}'" if brief and name == "metrics" else name for name in NUMBERED)
        with self._database.reading() as connection:
            points = dict(_read_points(connection))
            injections = {} if brief else _read_injections(connection, text, given)
            asked = f"SELECT run, point, identity, {columns} FROM runs {text} ORDER BY point, number, run"
            found = connection.execute(asked, given).fetchall()
        return [_row(points[point], name, values, injections.get(run, ())) for run, point, name, *values in found]

    def recipe(self, identity: str) -> Recipe:
        """How a run is made again; raises StoreError when there is no such run."""
        columns = "yaml, code_version, stop_on, grace_s"
        asked = f"SELECT {columns} FROM runs JOIN scenarios USING (scenario) WHERE identity = ?"
        with self._database.reading() as connection:
            row = connection.execute(asked, (identity,)).fetchone()
        if row is None:
            raise StoreError(f"store {self._database.path}: there is no run {identity}")
        return Recipe(*row)

    def others(self) -> dict[str, int]:
        """Runs that are kept and do not count: code version -> how many."""
        with self._database.reading() as connection:
            text = "SELECT code_version, count(*) FROM runs WHERE NOT wanted GROUP BY code_version"
            return dict(sorted(connection.execute(text).fetchall()))


@final
class Invocations:
    """Who ran the campaign when."""

    def __init__(self, database: Database) -> None:
        self._database: Final[Database] = database

    def begin(self, invocation: Invocation) -> int:
        """Note that a runner has begun; returns the number under which `note` notes how it goes on."""
        names = [entry.name for entry in fields(Invocation)]
        asked = f"INSERT INTO invocations ({', '.join(names)}) VALUES ({', '.join('?' * len(names))})"
        with self._database.writing() as connection:
            return connection.execute(asked, [getattr(invocation, name) for name in names]).lastrowid or 0

    def note(self, number: int, ended: str, wall_s: float, made: int, how: str) -> None:
        """Note how a runner goes on, or has ended."""
        asked = "UPDATE invocations SET ended = ?, wall_s = ?, made = ?, how = ? WHERE invocation = ?"
        with self._database.writing() as connection:
            connection.execute(asked, (ended, wall_s, made, how, number))

    def all(self) -> list[Invocation]:
        """In order."""
        names = ", ".join(entry.name for entry in fields(Invocation))
        with self._database.reading() as connection:
            found = connection.execute(f"SELECT {names} FROM invocations ORDER BY invocation")
            return [Invocation(*row) for row in found]


def number_in(connection: sqlite3.Connection, point: Point) -> int:
    """The number of a point, which is new if there is none."""
    number, is_new = _numbered(connection, "points", "parameters", json.dumps(point.parameters, ensure_ascii=False))
    for axis, written in point.parameters if is_new else ():
        found = number_of(written)
        value, unit = (None, "") if found is None else (found.value, found.unit)
        connection.execute("INSERT INTO parameters VALUES (?, ?, ?, ?, ?)", (number, axis, written, value, unit))
    return number


def _numbered(connection: sqlite3.Connection, table: str, column: str, text: str) -> tuple[int, bool]:
    """The number of a text in its table, and whether it is new there."""
    found = connection.execute(f"SELECT rowid FROM {table} WHERE {column} = ?", (text,)).fetchone()
    if found is not None:
        return int(found[0]), False
    return connection.execute(f"INSERT INTO {table} ({column}) VALUES (?)", (text,)).lastrowid or 0, True


def _read_points(connection: sqlite3.Connection) -> Iterator[tuple[int, Point]]:
    for number, text in connection.execute("SELECT point, parameters FROM points ORDER BY point"):
        yield number, Point(tuple((axis, value) for axis, value in json.loads(text)))


def _read_injections(
    connection: sqlite3.Connection, where: str, given: tuple[str, ...]
) -> dict[int, tuple[InjectionRow, ...]]:
    """The activations of each run."""
    columns = ", ".join(f'injections."{name}"' for name in INJECTION)
    asked = f"SELECT injections.run, {columns} FROM injections JOIN runs USING (run) {where} ORDER BY run, place"
    found: dict[int, list[InjectionRow]] = {}
    for run, *values in connection.execute(asked, given):
        found.setdefault(run, []).append(InjectionRow(*values))
    return {run: tuple(rows) for run, rows in found.items()}


def _column(row: RunRow, name: str) -> object:
    value = getattr(row, name)
    if name in _JSON:
        return json.dumps(dict(value), ensure_ascii=False, allow_nan=False, sort_keys=True)
    return value.value if isinstance(value, Outcome) else value


def _row(point: Point, identity: str, values: Sequence[object], injections: tuple[InjectionRow, ...]) -> RunRow:
    found = dict(zip(NUMBERED, values, strict=True))
    for name in _JSON:
        found[name] = json.loads(str(found[name]))
    found["outcome"] = Outcome(found["outcome"])
    return RunRow(identity=identity, point=point, injections=injections, **found)  # type: ignore[arg-type]
