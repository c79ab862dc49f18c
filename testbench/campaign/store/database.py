"""The file under a store: one SQLite database, its tables, and its errors in our words.

Write-ahead log (others read while a campaign writes), and a flush to the disk with every run (`synchronous=FULL`: a
run takes a hundred times longer than the flush, and what was once counted is there after a power cut as well). One
transaction a run: a process killed at any moment leaves whole rows alone.
"""

import sqlite3
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import fields
from pathlib import Path
from typing import Final, final

from testbench.campaign.records import InjectionRow, RunRow
from testbench.errors import BenchError

FORMAT: Final = 1
"""Counts up with every change of the tables."""

APPLICATION: Final = 0x65786F68  # "exoh": SQLite's application_id

NUMBERED: Final = tuple(entry.name for entry in fields(RunRow) if entry.name not in ("identity", "point", "injections"))
"""Fields of a RunRow that are columns of `runs` by the same name."""
INJECTION: Final = tuple(entry.name for entry in fields(InjectionRow))
"""Fields of an InjectionRow, all of them columns of `injections`."""
_TYPES: Final[Mapping[object, str]] = {int: "INTEGER NOT NULL", float: "REAL NOT NULL", float | None: "REAL"}
_NAME_ONE: Final = "name a store that `exo-hil campaign run` has written"
_ELSEWHERE: Final = ", or give another place with --out"


class StoreError(BenchError):
    """The store cannot be used, or no longer; what was committed before is in it."""


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
    {_columns(InjectionRow, INJECTION)},
    PRIMARY KEY (run, place)
) WITHOUT ROWID;
CREATE TABLE invocations (
    invocation INTEGER PRIMARY KEY, started TEXT NOT NULL, ended TEXT, wall_s REAL NOT NULL, jobs INTEGER NOT NULL,
    made INTEGER NOT NULL, machine TEXT NOT NULL, code_version TEXT NOT NULL, command TEXT NOT NULL, how TEXT NOT NULL
);
CREATE VIEW results AS SELECT * FROM runs WHERE wanted;
"""


@final
class Database:
    """An open file with the tables. What is done inside of `reading` and `writing` may raise StoreError."""

    def __init__(self, path: Path, connection: sqlite3.Connection, *, write: bool) -> None:
        self.path: Final[Path] = path
        self.connection: Final[sqlite3.Connection] = connection
        self._write: Final[bool] = write

    @contextmanager
    def reading(self) -> Iterator[sqlite3.Connection]:
        """All that is read inside is of one moment."""
        with explained(self.path, write=self._write):
            self.connection.execute("BEGIN")
            try:
                yield self.connection
            finally:
                self.connection.rollback()

    @contextmanager
    def writing(self) -> Iterator[sqlite3.Connection]:
        """All that is written inside is kept, or nothing of it."""
        with explained(self.path, write=True), self.connection:
            yield self.connection


def open_database(path: Path, *, write: bool) -> Database:
    """A file with the tables of this version; with `write` they are made in a new one. Raises StoreError."""
    with explained(path, write=write):
        connection = sqlite3.connect(path, timeout=30)
    try:
        with explained(path, write=write):
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
                told = f"this is another SQLite file, not a store of a campaign; {_NAME_ONE}"
                raise StoreError(f"store {path}: {told}{_ELSEWHERE if write else ''}")
            elif version != FORMAT:
                remedy = "run into a new store with --out" if write else "the version that wrote it reads it"
                told = f"its tables have format {version}, this version writes {FORMAT}; {remedy}"
                raise StoreError(f"store {path}: {told}")
            connection.execute("PRAGMA synchronous = FULL")
            connection.execute("PRAGMA foreign_keys = ON")
    except BaseException:
        connection.close()
        raise
    return Database(path, connection, write=write)


_KEPT: Final = "; all runs written before are in it"
_WORDS: Final = {
    "SQLITE_FULL": ("the disk is full; make room and start again", _KEPT),
    "SQLITE_READONLY": ("it may not be written; change its permissions and start again", _KEPT),
    "SQLITE_CANTOPEN": ("it cannot be opened; look whether it is a file in a folder that may be written", ""),
    "SQLITE_NOTADB": (f"this is no SQLite file, and was left alone; {_NAME_ONE}", ""),
    "SQLITE_BUSY": ("somebody else is writing to it; end that program and start again", _KEPT),
    "SQLITE_IOERR": (
        "the disk cannot be read or written (full, or a file-size limit reached, or broken); make room and start again",
        _KEPT,
    ),
    "SQLITE_CORRUPT": ("the file is damaged; `sqlite3 STORE .recover` gets out what can be", ""),
}
"""Error of SQLite -> what it is and what to do, and what is said after the remedy of a runner: another place."""


@contextmanager
def explained(path: Path, *, write: bool) -> Iterator[None]:
    """SQLite's errors in our words. write: for a runner, who may give another place."""
    try:
        yield
    except sqlite3.Error as error:
        name = getattr(error, "sqlite_errorname", "")
        words, after = next((found for code, found in _WORDS.items() if name.startswith(code)), (str(error), ""))
        raise StoreError(f"store {path}: {words}{_ELSEWHERE if write else ''}{after}") from error
