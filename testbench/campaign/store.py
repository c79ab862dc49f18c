"""The store of a campaign: one SQLite file, one row a run.

Write-ahead log (others read while a campaign writes), and a flush to the disk with every run (`synchronous=FULL`: a
run takes a hundred times longer than the flush, and what was once counted is there after a power cut as well). One
transaction a run: a process killed at any moment leaves whole rows alone. One runner at a time holds a lock on
`STORE.lock`, which the system takes back whatever ends the process. Tables: docs/campaigns.md.
"""

import json
import sqlite3
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Final, final

from testbench.campaign.records import InjectionRow, Outcome, Point, RunRow
from testbench.campaign.values import number_of
from testbench.errors import BenchError
from testbench.lock import Lock, is_locked

FORMAT: Final = 1
"""Counts up with every change of the tables."""

APPLICATION: Final = 0x65786F68  # "exoh": SQLite's application_id

NUMBERED: Final = tuple(entry.name for entry in fields(RunRow) if entry.name not in ("identity", "point", "injections"))
"""Fields of a RunRow that are columns of `runs` by the same name."""
_JSON: Final = ("metrics", "versions")
_INJECTION: Final = tuple(entry.name for entry in fields(InjectionRow))
_TYPES: Final[Mapping[object, str]] = {int: "INTEGER NOT NULL", float: "REAL NOT NULL", float | None: "REAL"}



def _columns(model: type[RunRow] | type[InjectionRow], names: Sequence[str]) -> str:
    """Columns of a table for fields of a class: texts and JSON are TEXT."""
    types = {entry.name: _TYPES.get(entry.type, "TEXT NOT NULL") for entry in fields(model)}
    return ", ".join(f'"{name}" {types[name]}' for name in names)


_TABLES: Final = f"""
CREATE TABLE meta (key TEXT PRIMARY KEY, value TEXT NOT NULL) WITHOUT ROWID;
CREATE TABLE points (point INTEGER PRIMARY KEY, parameters TEXT NOT NULL UNIQUE);
CREATE TABLE parameters (
    point INTEGER NOT NULL REFERENCES points, axis TEXT NOT NULL, written TEXT NOT NULL, value REAL, unit TEXT NOT NULL,
    PRIMARY KEY (point, axis)
) WITHOUT ROWID;
CREATE TABLE scenarios (scenario INTEGER PRIMARY KEY, yaml TEXT NOT NULL UNIQUE);
CREATE TABLE runs (
    run INTEGER PRIMARY KEY, identity TEXT NOT NULL UNIQUE, point INTEGER NOT NULL REFERENCES points,
    scenario INTEGER NOT NULL REFERENCES scenarios, code_version TEXT NOT NULL, stop_on TEXT, grace_s REAL NOT NULL,
    wanted INTEGER NOT NULL,
    {_columns(RunRow, NUMBERED)}
);
CREATE INDEX runs_of_point ON runs (point, number);
CREATE TABLE injections (
    run INTEGER NOT NULL REFERENCES runs ON DELETE CASCADE, place INTEGER NOT NULL,
    {_columns(InjectionRow, _INJECTION)},
    PRIMARY KEY (run, place)
) WITHOUT ROWID;
CREATE TABLE invocations (
    invocation INTEGER PRIMARY KEY, started TEXT NOT NULL, ended TEXT, wall_s REAL NOT NULL, jobs INTEGER NOT NULL,
    made INTEGER NOT NULL, machine TEXT NOT NULL, code_version TEXT NOT NULL, command TEXT NOT NULL, how TEXT NOT NULL
);
CREATE VIEW results AS SELECT * FROM runs WHERE wanted;
"""


class StoreError(BenchError):
    """The store cannot be used, or no longer; what was committed before is in it."""


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
class Store:
    """An open store. Every method may raise StoreError, and leaves the store as it was then."""

    def __init__(self, path: Path, connection: sqlite3.Connection, lock: Lock | None) -> None:
        self.path: Final[Path] = path
        self.connection: Final[sqlite3.Connection] = connection
        self._lock: Final[Lock | None] = lock
        self._points: Final[dict[Point, int]] = {}
        self._scenarios: Final[dict[str, int]] = {}

    def close(self) -> None:
        """Close, also after an error."""
        self.connection.close()
        if self._lock is not None:
            self._lock.release()

    def is_held(self) -> bool:
        """Whether a runner is writing to it now."""
        return self._lock is not None or is_locked(_lock_of(self.path))

    def meta(self, key: str) -> str:
        """A text about the campaign, "" when there is none."""
        with _explained(self.path):
            row = self.connection.execute("SELECT value FROM meta WHERE key = ?", (key,)).fetchone()
            return "" if row is None else str(row[0])

    def set_meta(self, texts: Mapping[str, str]) -> None:
        """Keep texts about the campaign."""
        with _explained(self.path), self.connection:
            self.connection.executemany("INSERT OR REPLACE INTO meta VALUES (?, ?)", texts.items())

    def add_points(self, points: Iterable[Point]) -> None:
        """Give the points their numbers, in this order; those that have one keep it."""
        with _explained(self.path), self.connection:
            for point in points:
                self._point(point)

    def append(self, row: RunRow, recipe: Recipe) -> None:
        """Keep a run that is wanted, in the place of one with the same identity."""
        with _explained(self.path), self.connection:
            try:
                self._append(row, recipe)
            except BaseException:  # numbers given in a transaction that is taken back
                self._points.clear()
                self._scenarios.clear()
                raise

    def _append(self, row: RunRow, recipe: Recipe) -> None:
        self.connection.execute("DELETE FROM runs WHERE identity = ?", (row.identity,))
        values = [_column(row, name) for name in NUMBERED]
        head = (row.identity, self._point(row.point), self._scenario(recipe.scenario))
        marks = ", ".join("?" * (len(head) + 4 + len(values)))
        columns = f"identity, point, scenario, code_version, stop_on, grace_s, wanted, {', '.join(NUMBERED)}"
        cursor = self.connection.execute(
            f"INSERT INTO runs ({columns}) VALUES ({marks})",
            (*head, recipe.code_version, recipe.stop_on, recipe.grace_s, 1, *values),
        )
        run = cursor.lastrowid
        rows = [(run, place, *(getattr(one, name) for name in _INJECTION)) for place, one in enumerate(row.injections)]
        self.connection.executemany(f"INSERT INTO injections VALUES ({', '.join('?' * (2 + len(_INJECTION)))})", rows)

    def want(self, identities: Mapping[str, tuple[Point, int]]) -> None:
        """Say which runs count: identity -> its point and number; all others stay, and count no more."""
        with _explained(self.path), self.connection:
            rows = [(self._point(point), number, name) for name, (point, number) in identities.items()]
            self.connection.execute("UPDATE runs SET wanted = 0 WHERE wanted")
            self.connection.executemany("UPDATE runs SET wanted = 1, point = ?, number = ? WHERE identity = ?", rows)

    def remove(self, outcomes: Iterable[Outcome], code_version: str) -> int:
        """Forget runs of a version with one of the outcomes, so that they are made again; how many there were."""
        values = [outcome.value for outcome in outcomes]
        with _explained(self.path), self.connection:
            marks = ", ".join("?" * len(values))
            found = self.connection.execute(
                f"DELETE FROM runs WHERE code_version = ? AND outcome IN ({marks})", (code_version, *values)
            )
            return found.rowcount

    def rows(self, code_version: str = "", wanted: bool = True) -> list[RunRow]:
        """Runs, by point and number. code_version: only of that one; wanted: only those that count."""
        where = [*(["runs.wanted"] if wanted else []), *(["runs.code_version = ?"] if code_version else [])]
        text = f"WHERE {' AND '.join(where)}" if where else ""
        given = (code_version,) if code_version else ()
        with _explained(self.path), _reading(self.connection):
            points = dict(self._read_points())
            injections: dict[int, list[InjectionRow]] = {}
            quoted = ", ".join(f'injections."{name}"' for name in _INJECTION)
            asked = f"SELECT injections.run, {quoted} FROM injections JOIN runs USING (run) {text} ORDER BY run, place"
            for run, *values in self.connection.execute(asked, given):
                injections.setdefault(run, []).append(InjectionRow(*values))
            columns = ", ".join(NUMBERED)
            asked = f"SELECT run, point, identity, {columns} FROM runs {text} ORDER BY point, number, run"
            found = self.connection.execute(asked, given).fetchall()
        return [
            _row(points[point], name, values, tuple(injections.get(run, ()))) for run, point, name, *values in found
        ]

    def recipe(self, identity: str) -> Recipe:
        """How a run is made again; raises StoreError when there is no such run."""
        with _explained(self.path):
            columns = "yaml, code_version, stop_on, grace_s"
            asked = f"SELECT {columns} FROM runs JOIN scenarios USING (scenario) WHERE identity = ?"
            row = self.connection.execute(asked, (identity,)).fetchone()
        if row is None:
            raise StoreError(f"store {self.path}: there is no run {identity}")
        return Recipe(*row)

    def points(self) -> dict[int, Point]:
        """All points by their numbers, also those that the file no longer has."""
        with _explained(self.path):
            return dict(self._read_points())

    def others(self) -> dict[str, int]:
        """Runs that are kept and do not count: code version -> how many."""
        with _explained(self.path):
            text = "SELECT code_version, count(*) FROM runs WHERE NOT wanted GROUP BY code_version"
            return dict(sorted(self.connection.execute(text).fetchall()))

    def begin(self, invocation: Invocation) -> int:
        """Note that a runner has begun; returns the number under which `end` notes its end."""
        with _explained(self.path), self.connection:
            names = [entry.name for entry in fields(Invocation)]
            cursor = self.connection.execute(
                f"INSERT INTO invocations ({', '.join(names)}) VALUES ({', '.join('?' * len(names))})",
                [getattr(invocation, name) for name in names],
            )
            return cursor.lastrowid or 0

    def end(self, number: int, ended: str, wall_s: float, made: int, how: str) -> None:
        """Note how a runner goes on, or has ended."""
        with _explained(self.path), self.connection:
            self.connection.execute(
                "UPDATE invocations SET ended = ?, wall_s = ?, made = ?, how = ? WHERE invocation = ?",
                (ended, wall_s, made, how, number),
            )

    def invocations(self) -> list[Invocation]:
        """All of them, in order."""
        names = ", ".join(entry.name for entry in fields(Invocation))
        with _explained(self.path):
            found = self.connection.execute(f"SELECT {names} FROM invocations ORDER BY invocation")
            return [Invocation(*row) for row in found]

    def _read_points(self) -> Iterator[tuple[int, Point]]:
        for number, text in self.connection.execute("SELECT point, parameters FROM points ORDER BY point"):
            yield number, Point(tuple((axis, value) for axis, value in json.loads(text)))

    def _point(self, point: Point) -> int:
        number = self._points.get(point)
        if number is None:
            text = json.dumps(point.parameters, ensure_ascii=False)
            number, is_new = self._numbered("points", "parameters", text)
            for axis, written in point.parameters if is_new else ():
                found = number_of(written)
                value, unit = (None, "") if found is None else (found.value, found.unit)
                self.connection.execute(
                    "INSERT INTO parameters VALUES (?, ?, ?, ?, ?)", (number, axis, written, value, unit)
                )
            self._points[point] = number
        return number

    def _scenario(self, yaml: str) -> int:
        number = self._scenarios.get(yaml)
        if number is None:
            number, _ = self._numbered("scenarios", "yaml", yaml)
            self._scenarios[yaml] = number
        return number

    def _numbered(self, table: str, column: str, text: str) -> tuple[int, bool]:
        """The number of a text in its table, and whether it is new there."""
        found = self.connection.execute(f"SELECT rowid FROM {table} WHERE {column} = ?", (text,)).fetchone()
        if found is not None:
            return int(found[0]), False
        return self.connection.execute(f"INSERT INTO {table} ({column}) VALUES (?)", (text,)).lastrowid or 0, True


def open_store(path: Path, *, write: bool = False) -> Store:
    """A store that is there; with `write` one is made where there is none, and held against other runners.

    Raises StoreError for what is no store, or held by another runner.
    """
    if not write and not path.exists():
        raise StoreError(f"store {path}: no such file; `exo-hil campaign run` makes it")
    lock = None
    try:
        if write:
            path.parent.mkdir(parents=True, exist_ok=True)
            lock = Lock(_lock_of(path))
            holder = lock.acquire()
            if holder is not None:
                raise StoreError(
                    f"store {path}: another campaign run is writing to it (process {holder}); wait for it, or give "
                    "another place with --out"
                )
    except OSError as error:
        raise StoreError(f"store {path}: {error.strerror or error}; give another place with --out") from error
    try:
        return Store(path, _connected(path, write), lock)
    except BaseException:
        if lock is not None:
            lock.release()
        raise


def _lock_of(path: Path) -> Path:
    return path.with_name(f"{path.name}.lock")


def _connected(path: Path, write: bool) -> sqlite3.Connection:
    """A connection whose tables are those of this version."""
    with _explained(path):
        connection = sqlite3.connect(path, timeout=30)
    try:
        with _explained(path):
            version, application = (
                connection.execute(f"PRAGMA {name}").fetchone()[0] for name in ("user_version", "application_id")
            )
            empty = not connection.execute("SELECT count(*) FROM sqlite_master").fetchone()[0]
            if empty and write:
                connection.execute("PRAGMA journal_mode = WAL")
                connection.executescript(
                    f"BEGIN; {_TABLES} PRAGMA application_id = {APPLICATION}; PRAGMA user_version = {FORMAT}; COMMIT;"
                )
            elif application != APPLICATION:
                raise StoreError(f"store {path}: this is another SQLite file, not a store of a campaign")
            elif version != FORMAT:
                raise StoreError(
                    f"store {path}: its tables have format {version}, this version writes {FORMAT}; run into a new "
                    "store with --out"
                )
            connection.execute("PRAGMA synchronous = FULL")
            connection.execute("PRAGMA foreign_keys = ON")
    except BaseException:
        connection.close()
        raise
    return connection


_WORDS: Final = {
    "SQLITE_FULL": "the disk is full; make room",
    "SQLITE_READONLY": "it may not be written; change its permissions",
    "SQLITE_CANTOPEN": "it cannot be opened; look whether its folder is there and may be written",
    "SQLITE_NOTADB": "this is no SQLite file, and was left alone",
    "SQLITE_BUSY": "somebody else is writing to it; end that program",
    "SQLITE_IOERR": "the disk cannot be read or written (full, or a file-size limit reached, or broken); make room",
    "SQLITE_CORRUPT": "the file is damaged; `sqlite3 STORE .recover` gets out what can be",
}


@contextmanager
def _explained(path: Path) -> Iterator[None]:
    """SQLite's errors in our words."""
    try:
        yield
    except sqlite3.Error as error:
        name = getattr(error, "sqlite_errorname", "")
        words = next((words for code, words in _WORDS.items() if name.startswith(code)), f"{error}")
        remedy = "and start again, or give another place with --out; all runs written before are in it"
        raise StoreError(f"store {path}: {words} {remedy}") from error


@contextmanager
def _reading(connection: sqlite3.Connection) -> Iterator[None]:
    """All that is read inside is of one moment."""
    connection.execute("BEGIN")
    try:
        yield
    finally:
        connection.rollback()


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
