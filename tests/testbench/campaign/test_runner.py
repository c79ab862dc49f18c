"""The loop of a campaign: what is wanted is made once, kept, found again, and asked for by nobody else."""

import dataclasses
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from testbench.campaign.file.schema import Campaign
from testbench.campaign.making.executor import Executor
from testbench.campaign.records import Known, Outcome, Plan, Point, RunRow, RunSpec, Wanted
from testbench.campaign.runner import Finished, Progress, Runner, Way
from testbench.campaign.store.archive import contents, remember
from testbench.campaign.store.store import Store, StoreError, open_store
from tests.testbench.campaign.campaigns import small
from tests.testbench.campaign.workers import row_of

WAY = Way("v1", "folder", fork=True, jobs=2)


class Here(Executor):
    """Makes runs at once, the last submitted first, so that no order is the usual one."""

    def __init__(self, make: Callable[[RunSpec], RunRow] = row_of, room: int = 2) -> None:
        self.make, self.room = make, room
        self.specs: list[RunSpec] = []
        self.flying: list[RunSpec] = []
        self.is_stopped = False

    def free(self) -> int:
        return self.room - len(self.flying)

    def submit(self, spec: RunSpec) -> None:
        assert self.free() > 0
        self.specs.append(spec)
        self.flying.append(spec)

    def collect(self, timeout_s: float) -> list[RunRow]:
        return [self.make(self.flying.pop())] if self.flying else []

    def stop(self) -> None:
        self.is_stopped = True


@pytest.fixture
def store(tmp_path: Path) -> Iterator[Store]:
    made = open_store(tmp_path / "store.sqlite", write=True)
    yield made
    made.close()


def run(
    campaign: Campaign,
    store: Store,
    executor: Here | None = None,
    *,
    way: Way = WAY,
    plan: Plan | None = None,
    stop_after: int = 10_000,
) -> tuple[Finished, list[RunSpec]]:
    """Run a campaign; stop_after: Ctrl-C once so many runs were made."""
    executor = Here() if executor is None else executor
    told: list[Progress] = []
    runner = Runner(campaign, store, way, plan)
    runner.prepare()
    finished = runner.run(executor, told.append, lambda: int(bool(told) and told[-1].made >= stop_after))
    assert executor.is_stopped
    return finished, executor.specs


def rows_of(store: Store) -> list[RunRow]:
    return [dataclasses.replace(row, wall_s=0.0) for row in store.runs.all()]


def test_every_wanted_run_is_made_once(store: Store) -> None:
    """Two points, three runs each, seed k = 5 + k, the duration set in both injectors."""
    finished, specs = run(small(), store)
    assert (finished.progress.done, finished.progress.wanted, finished.interrupted) == (6, 6, False)
    assert len({spec.identity for spec in specs}) == 6
    assert [(dict(row.point.parameters)["duration"], row.number, row.seed) for row in store.runs.all()] == [
        *(("0.05 s", 0, 5), ("0.05 s", 1, 6), ("0.05 s", 2, 7)),
        *(("0.3 s", 0, 5), ("0.3 s", 1, 6), ("0.3 s", 2, 7)),
    ]
    for spec in specs:
        duration = {"0.05 s": "50 ms", "0.3 s": "0.3 s"}[dict(spec.wanted.point.parameters)["duration"]]
        assert spec.scenario.count(f"duration: {duration}\n") == 2
        assert f"\nseed: {spec.seed}\n" in spec.scenario


def test_running_again_makes_nothing(store: Store) -> None:
    """What the store has is never made again."""
    run(small(), store)
    before = store.runs.all()
    finished, specs = run(small(), store)
    assert specs == []
    assert finished.reused == 6
    assert store.runs.all() == before


def test_interrupted_campaign_goes_on_and_ends_with_the_same_rows(store: Store, tmp_path: Path) -> None:
    """Ctrl-C after some runs: runs in flight are taken in, the rest is made the next time, nothing twice."""
    finished, first = run(small(), store, stop_after=2)
    assert finished.interrupted
    assert 2 <= len(store.runs.all()) < 6
    assert store.invocations.all()[-1].how == "interrupted"
    kept = {row.identity for row in store.runs.all()}
    assert kept == {spec.identity for spec in first}
    finished, second = run(small(), store)
    assert kept.isdisjoint(spec.identity for spec in second)
    whole = open_store(tmp_path / "whole.sqlite", write=True)
    run(small(), whole)
    assert rows_of(store) == rows_of(whole)
    assert [one.how for one in store.invocations.all()] == ["interrupted", "done"]
    whole.close()


def test_changed_file_adds_what_is_new_and_counts_what_it_wants(store: Store) -> None:
    """More runs, another value: made; what is no longer wanted stays and does not count."""
    run(small(), store)
    finished, specs = run(small(("values: [0.05 s, 0.3 s]", "values: [0.3 s, 0.5 s]"), ("runs: 3", "runs: 4")), store)
    assert finished.reused == 3
    assert len(specs) == 5
    assert len(store.runs.all()) == 8
    assert {dict(row.point.parameters)["duration"] for row in store.runs.all()} == {"0.3 s", "0.5 s"}
    assert store.runs.others() == {"v1": 3}
    run(small(), store)
    assert len(store.runs.all()) == 6


def test_runs_of_another_version_are_made_anew(store: Store) -> None:
    """Rows of another code version stay in the store, and are never taken for this one's."""
    run(small(), store)
    finished, specs = run(small(), store, way=dataclasses.replace(WAY, version="v2"))
    assert (finished.reused, len(specs)) == (0, 6)
    assert len(store.runs.all()) == 6
    assert store.runs.others() == {"v1": 6}


def test_run_is_known_by_what_it_is_not_by_its_name(store: Store) -> None:
    """An axis with another name, and a value written in another unit: the same runs, under their new names."""
    run(small(), store)
    units = ("values: [0.05 s, 0.3 s]", "values: [50 ms, 300 ms]")
    renamed = small(("  duration:\n    set", "  length:\n    set"), units)
    _, specs = run(renamed, store)
    assert specs == []
    assert {row.point.parameters for row in store.runs.all()} == {(("length", "50 ms"),), (("length", "300 ms"),)}


def test_early_stop_makes_another_run() -> None:
    """stop_early is part of a run's identity, the time limit and where traces go are not."""
    wanted = Wanted(small().points[0], 0)
    plain = small().identity_of(wanted, "v1")
    stopped = {
        small(("runs: 3", f"runs: 3\nstop_early: {{on: failure, grace: {grace}}}")).identity_of(wanted, "v1")
        for grace in ("0.1 s", "0.2 s")
    }
    assert len({plain, *stopped}) == 3
    assert small(("runs: 3", "runs: 3\ntime_limit: 5 s\ntraces: always")).identity_of(wanted, "v1") == plain


@pytest.mark.parametrize("stop", ["", "stop_early: {on: failure, grace: 0.2 s}\n"])
def test_full_length_of_the_motion_is_known_for_each_point(store: Store, stop: str) -> None:
    """What a run that ended early is held against."""
    lengths = "  walk: {set: motion.duration, values: [2 s, 4 s]}\nruns: 3\n"
    campaign = small(("runs: 3\n", lengths + stop))
    remember(store, campaign)
    run(campaign, store)
    _, meta = contents(store)
    assert sorted(meta.motions.values()) == ([2.0, 2.0, 4.0, 4.0] if stop else [])
    for point, motion_s in meta.motions.items():
        assert dict(point.parameters)["walk"] == f"{motion_s:g} s"


class TwoSteps(Plan):
    """One run; and when it is known two more at another place, if it did not fail."""

    def __init__(self, points: tuple[Point, ...]) -> None:
        self.points = points

    def wanted(self, known: Known) -> list[Wanted]:
        first = Wanted(self.points[0], 0)
        rows = known.get(first.point, ())
        if not rows or rows[0].outcome is not Outcome.MASKED:
            return [first]
        return [first, Wanted(self.points[1], 0), Wanted(self.points[1], 1)]


def test_plan_is_asked_again_as_runs_come_in(store: Store) -> None:
    """A search sees what came out; on resuming it wants the same."""
    campaign = small()
    finished, specs = run(campaign, store, plan=TwoSteps(campaign.points))
    assert [spec.wanted.number for spec in specs] == [0, 0, 1]
    assert finished.progress.wanted == 3
    finished, specs = run(campaign, store, plan=TwoSteps(campaign.points))
    assert (specs, finished.reused) == ([], 3)


class Twins(Plan):
    """Two points that are one scenario, as a search may come upon them, and one more."""

    def wanted(self, known: Known) -> list[Wanted]:
        return [Wanted(Point((("duration", text),)), 0) for text in ("0.05 s", "50 ms", "0.3 s")]


@pytest.mark.parametrize("room", [1, 5])
def test_points_that_are_one_scenario_share_a_run(store: Store, room: int) -> None:
    """Never the same run twice; both points know it."""
    finished, specs = run(small(), store, Here(room=room), plan=Twins())
    assert len({spec.identity for spec in specs}) == len(specs) == 2
    assert finished.progress.done == 3
    assert not finished.interrupted


class TwinsFirst(Plan):
    """Three points that are one scenario, and another one when all three are known."""

    def wanted(self, known: Known) -> list[Wanted]:
        first = [Point((("duration", text),)) for text in ("0.05 s", "50 ms", "0.05s")]
        more = [Point((("duration", "0.3 s"),))] if all(point in known for point in first) else []
        return [Wanted(point, 0) for point in (*first, *more)]


def test_plan_is_asked_again_when_the_last_runs_it_wanted_were_there(store: Store) -> None:
    """A campaign is over when the plan wants nothing more, not when its queue has run empty."""
    finished, specs = run(small(), store, Here(room=1), plan=TwinsFirst())
    assert (finished.progress.done, finished.progress.wanted, len(specs)) == (4, 4, 2)


def test_rows_are_the_same_in_whatever_order_runs_finish(store: Store, tmp_path: Path) -> None:
    """A sequential rule on one process and on seven."""
    rule = "runs: {until: {outcome: failure, width: 0.5}, batch: 4, least: 4, most: 40}"
    campaign = small(("runs: 3", rule))
    run(campaign, store, Here(room=1))
    other = open_store(tmp_path / "other.sqlite", write=True)
    run(campaign, other, Here(room=7))
    assert rows_of(store) == rows_of(other)
    assert 8 < len(rows_of(store)) < 80
    other.close()


def test_run_made_once_more_leaves_the_later_ones_counted(store: Store) -> None:
    """`--retry` of a run of the first batch: the batches that were made after it are found again, and count."""
    campaign = small(("runs: 3", "runs: {until: {outcome: failure, width: 0.5}, batch: 4, least: 4, most: 40}"))
    run(campaign, store, Here(lambda spec: row_of(spec, Outcome.CRASHED if spec.seed == 5 else None)))
    before = [(row.point, row.number) for row in store.runs.all()]
    assert store.runs.forget((Outcome.CRASHED,), WAY.version) == 2
    finished, again = run(campaign, store)
    assert len(again) == 2
    assert len(store.runs.all()) == finished.progress.done == finished.progress.wanted
    assert {(row.point, row.number) for row in store.runs.all()} <= set(before)
    assert len(store.runs.all()) > 8


def test_failing_executor_keeps_what_was_made(store: Store) -> None:
    """An error in the middle: the processes are stopped, the rows stay."""
    made: list[RunSpec] = []

    def make(spec: RunSpec) -> RunRow:
        if len(made) == 2:
            raise RuntimeError("power failure")
        made.append(spec)
        return row_of(spec)

    executor = Here(make)
    runner = Runner(small(), store, WAY)
    runner.prepare()
    with pytest.raises(RuntimeError, match="power failure"):
        runner.run(executor, lambda progress: None, lambda: 0)
    assert executor.is_stopped
    assert len(store.runs.all()) == 2


@pytest.mark.long
def test_full_disk_stops_the_campaign_and_keeps_what_was_made(store: Store) -> None:
    """A clear message, processes stopped, and every run that was counted is there."""
    campaign = small(("runs: 3", "runs: 500"))
    runner = Runner(campaign, store, WAY)
    runner.prepare()
    pages = store.database.connection.execute("PRAGMA page_count").fetchone()[0]
    store.database.connection.execute(f"PRAGMA max_page_count = {pages + 20}")
    executor = Here()
    made: list[Progress] = []
    with pytest.raises(StoreError, match="the disk is full; make room"):
        runner.run(executor, made.append, lambda: 0)
    assert executor.is_stopped
    assert len(store.runs.all()) == made[-1].made > 1
    assert store.invocations.all()[0].how == "running"


def test_progress_tells_rate_and_time_left() -> None:
    """30 runs in a minute, 60 to go: 30 a minute, two minutes left; what was there before counts for no rate."""
    progress = Progress(done=40, wanted=100, made=30, elapsed_s=60.0, counts={})
    assert progress.per_minute == 30
    assert progress.left_s == 120
    assert Progress(10, 100, 0, 5.0, {}).left_s is None
