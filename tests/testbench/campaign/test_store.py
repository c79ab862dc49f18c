"""The store: whole rows or none, readable while it is written, and clear words when it cannot be used."""

import dataclasses
import resource
import signal
import sqlite3
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from testbench.campaign.records import Outcome, Point, RunRow
from testbench.campaign.store.store import Invocation, Recipe, Store, StoreError, open_store
from tests.testbench.campaign.workers import row_of, spec

RECIPE = Recipe("name: x\nseed: 0\n", "1", "failure", 0.25)


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "deep" / "store.sqlite"


@pytest.fixture
def store(path: Path) -> Iterator[Store]:
    made = open_store(path, write=True)
    yield made
    made.close()


def full_row() -> RunRow:
    """A row in which every field differs from its default."""
    row = dataclasses.replace(
        row_of(spec(3, axis="0.05 s")),
        reason="because",
        first_phase=0.125,
        injected=4,
        manifested=5,
        detected_s=0.75,
        detection_latency_s=0.25,
        failure_s=0.5,
        beyond_s=0.0625,
        beyond_joint="left_hip",
        ended_s=1.5,
        errors=1,
        failures=2,
        failures_at_3deg=3,
        golden_hash="cd" * 32,
        attempts=2,
        started="2026-01-01T00:00:00.000+00:00",
        cpu_s=0.0625,
        forked_s=0.375,
    )
    defaults = {entry.name: entry.default for entry in dataclasses.fields(RunRow)}
    assert not [name for name, default in defaults.items() if getattr(row, name) == default]
    return row


def test_row_comes_back_as_it_was_kept(store: Store, path: Path) -> None:
    """Every field, and the activations in their order, also through another connection."""
    row = full_row()
    store.runs.append(row, RECIPE)
    assert store.runs.all() == [row]
    reader = open_store(path)
    assert reader.runs.all() == [row]
    assert reader.runs.recipe(row.identity) == RECIPE
    reader.close()


def test_rows_come_by_point_and_number(store: Store) -> None:
    """Points in the order in which they were given, whatever order the runs finished in."""
    points = [spec(0, axis=axis).wanted.point for axis in ("0.2 s", "0.1 s")]
    store.points.add(points)
    for number, axis in ((1, "0.1 s"), (0, "0.2 s"), (0, "0.1 s")):
        store.runs.append(row_of(spec(number, axis=axis)), RECIPE)
    assert [(row.point, row.number) for row in store.runs.all()] == [(points[0], 0), (points[1], 0), (points[1], 1)]
    assert store.points.all() == {1: points[0], 2: points[1]}


def test_parameters_are_kept_in_si_as_well(store: Store) -> None:
    """Table parameters: as written, SI value and unit; a word has no value."""
    point = Point((("duration", "50 ms"), ("angle", "90 deg"), ("share", "20 %"), ("count", "3"), ("stops", "off")))
    store.points.add([point])
    asked = "SELECT axis, written, value, unit FROM parameters ORDER BY axis"
    found = store.database.connection.execute(asked).fetchall()
    assert found == [
        ("angle", "90 deg", pytest.approx(1.5707963267948966), "rad"),
        ("count", "3", 3.0, ""),
        ("duration", "50 ms", 0.05, "s"),
        ("share", "20 %", 0.2, "%"),
        ("stops", "off", None, ""),
    ]


def test_same_identity_is_kept_once(store: Store) -> None:
    """A run that is made again takes the place of the one before, its activations too."""
    row = row_of(spec(1))
    store.runs.append(row, RECIPE)
    again = dataclasses.replace(row, wall_s=9.0, injections=row.injections[:1])
    store.runs.append(again, RECIPE)
    assert store.runs.all() == [again]
    assert store.database.connection.execute("SELECT count(*) FROM injections").fetchone() == (1,)


def test_runs_that_are_not_wanted_stay_and_do_not_count(store: Store) -> None:
    """want: those named count, at the place named; all others are told by their version."""
    rows = [row_of(spec(number)) for number in range(3)]
    for row in rows:
        store.runs.append(row, RECIPE)
    elsewhere = Point((("axis", "2"),))
    store.runs.want({rows[1].identity: (elsewhere, 7)}, only=True)
    assert store.runs.all() == [dataclasses.replace(rows[1], point=elsewhere, number=7)]
    assert len(store.runs.all(wanted=False)) == 3
    assert store.runs.others() == {"1": 2}
    assert store.runs.all(code_version="2", wanted=False) == []


def test_runs_can_be_read_while_others_are_written(store: Store, path: Path) -> None:
    """WAL: a reader in the middle of a read sees one moment, and hinders no writer."""
    store.runs.append(row_of(spec(0)), RECIPE)
    reader = sqlite3.connect(path)
    reader.execute("BEGIN")
    assert reader.execute("SELECT count(*) FROM results").fetchone() == (1,)
    store.runs.append(row_of(spec(1)), RECIPE)
    assert reader.execute("SELECT count(*) FROM results").fetchone() == (1,)
    reader.rollback()
    assert reader.execute("SELECT count(*) FROM results").fetchone() == (2,)
    reader.close()


def test_second_runner_is_refused(store: Store, path: Path) -> None:
    """One runner a store; readers are welcome. What the first one gives back, the next one gets."""
    with pytest.raises(StoreError, match=r"another campaign run is writing to it \(process \d+\).*--out"):
        open_store(path, write=True)
    reader = open_store(path)
    assert reader.is_held()
    store.close()
    assert not reader.is_held()
    reader.close()
    open_store(path, write=True).close()


def fill(store: Store, most: int = 100_000) -> tuple[int, str]:
    """Append until it fails: how many rows were kept, and what was said."""
    for number in range(most):
        try:
            store.runs.append(row_of(spec(number)), RECIPE)
        except StoreError as error:
            return number, str(error)
    raise AssertionError("it never failed")


def test_full_disk_is_said_and_what_was_written_is_kept(store: Store, path: Path) -> None:
    """Nothing half-written; the store opens afterwards, with every row, and goes on when there is room."""
    pages = store.database.connection.execute("PRAGMA page_count").fetchone()[0]
    store.database.connection.execute(f"PRAGMA max_page_count = {pages + 20}")
    kept, said = fill(store)
    assert kept > 1
    assert "the disk is full; make room and start again" in said
    assert str(path) in said
    assert len(store.runs.all()) == kept
    store.close()
    again = open_store(path, write=True)
    assert len(again.runs.all()) == kept
    again.runs.append(row_of(spec(kept)), RECIPE)
    assert again.runs.all() == [row_of(spec(number)) for number in range(kept + 1)]
    again.close()


LIMITED = """
import resource, signal, sys
from pathlib import Path
from testbench.campaign.store.store import open_store
from tests.testbench.campaign.test_store import fill
store = open_store(Path(sys.argv[1]), write=True)
resource.setrlimit(resource.RLIMIT_FSIZE, (300_000, 300_000))
kept, said = fill(store)
print(kept)
print(said)
"""


def test_file_that_may_not_grow_is_said_and_opens_afterwards(path: Path) -> None:
    """The system's own limit on the size of a file, and the process ends without closing anything."""
    assert signal.getsignal(signal.SIGXFSZ) == signal.SIG_IGN  # as Python has it
    done = subprocess.run([sys.executable, "-c", LIMITED, str(path)], capture_output=True, text=True, check=True)
    kept, said = done.stdout.splitlines()
    assert resource.getrlimit(resource.RLIMIT_FSIZE)[0] != 300_000
    assert "make room and start again, or give another place with --out; all runs written before are in it" in said
    store = open_store(path, write=True)
    assert store.runs.all() == [row_of(spec(number)) for number in range(int(kept))]
    assert store.database.connection.execute("PRAGMA integrity_check").fetchone() == ("ok",)
    store.close()


def test_what_is_no_store_is_left_alone(tmp_path: Path) -> None:
    """A text, another program's SQLite file, tables of another version, a folder, nothing."""
    text = tmp_path / "text.sqlite"
    text.write_text("not a database, and longer than a header of one hundred bytes would be, so that it is read\n" * 9)
    other = tmp_path / "other.sqlite"
    connection = sqlite3.connect(other)
    connection.executescript("CREATE TABLE theirs (x)")
    connection.close()
    later = tmp_path / "later.sqlite"
    open_store(later, write=True).close()
    connection = sqlite3.connect(later)
    connection.execute("PRAGMA user_version = 99")
    connection.close()
    expected = {
        text: "this is no SQLite file",
        other: "another SQLite file, not a store",
        later: r"format 99, this version writes 1",
        tmp_path: "cannot be opened",
    }
    for path, words in expected.items():
        before = None if path.is_dir() else path.read_bytes()
        for write in (False, True):
            with pytest.raises(StoreError, match=words) as refused:
                open_store(path, write=write)
            assert "runs written before are in it" not in str(refused.value), "there are none"
            assert ("--out" in str(refused.value)) is write, "where a store is only read there is no such option"
        assert before is None or path.read_bytes() == before
    with pytest.raises(StoreError, match="no such file; `exo-hil campaign run` makes it"):
        open_store(tmp_path / "nothing.sqlite")
    with pytest.raises(StoreError, match=r"Not a directory|File exists"):
        open_store(text / "store.sqlite", write=True)


def test_outcomes_are_forgotten_on_request(store: Store) -> None:
    """What crashed or hung can be made again; other versions keep theirs."""
    outcomes = (Outcome.CRASHED, Outcome.MASKED, Outcome.HANG, Outcome.INVALID)
    for number, outcome in enumerate(outcomes):
        store.runs.append(row_of(spec(number), outcome), RECIPE)
    store.runs.append(row_of(spec(9), Outcome.HANG), dataclasses.replace(RECIPE, code_version="0"))
    assert store.runs.forget((Outcome.CRASHED, Outcome.HANG), "1") == 2
    assert [row.number for row in store.runs.all()] == [1, 3, 9]


def test_invocations_are_noted(store: Store) -> None:
    """Who ran when, with how many processes, and how it ended."""
    begun = Invocation("t0", "", 0.0, 2, 0, "here", "1", "exo-hil campaign run x.yaml", "running")
    number = store.invocations.begin(begun)
    assert store.invocations.all() == [begun]
    store.invocations.note(number, "t1", 2.5, 7, "done")
    assert store.invocations.all() == [dataclasses.replace(begun, ended="t1", wall_s=2.5, made=7, how="done")]
