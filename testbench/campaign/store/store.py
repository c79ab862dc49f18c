"""The store of a campaign: one SQLite file, one row a run. Its tables: docs/campaigns.md.

One runner at a time holds a lock on `STORE.lock`, which the system takes back whatever ends the process.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Final, final

from testbench.campaign.store.database import Database, StoreError, open_database
from testbench.campaign.store.tables import Invocation, Invocations, Points, Recipe, Runs
from testbench.lock import Lock, is_locked

__all__ = ["Invocation", "Recipe", "Store", "StoreError", "open_store"]


@final
class Store:
    """An open store. Whatever is done with it may raise StoreError, and leaves it as it was then."""

    def __init__(self, database: Database, lock: Lock | None) -> None:
        self.path: Final[Path] = database.path
        self.database: Final[Database] = database
        self.points: Final[Points] = Points(database)
        self.runs: Final[Runs] = Runs(database)
        self.invocations: Final[Invocations] = Invocations(database)
        self._lock: Final[Lock | None] = lock

    def close(self) -> None:
        """Close, also after an error."""
        self.database.connection.close()
        if self._lock is not None:
            self._lock.release()

    def is_held(self) -> bool:
        """Whether a runner is writing to it now."""
        return self._lock is not None or is_locked(_lock_of(self.path))

    def meta(self, key: str) -> str:
        """A text about the campaign, "" when there is none."""
        with self.database.reading() as connection:
            row = connection.execute("SELECT value FROM meta WHERE key = ?", (key,)).fetchone()
            return "" if row is None else str(row[0])

    def set_meta(self, texts: Mapping[str, str]) -> None:
        """Keep texts about the campaign."""
        with self.database.writing() as connection:
            connection.executemany("INSERT OR REPLACE INTO meta VALUES (?, ?)", texts.items())


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
        return Store(open_database(path, write=write), lock)
    except BaseException:
        if lock is not None:
            lock.release()
        raise


def _lock_of(path: Path) -> Path:
    return path.with_name(f"{path.name}.lock")
