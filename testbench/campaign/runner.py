"""The loop of a campaign: ask the plan what is wanted, have it made, keep it, ask again.

Which run is which is its identity; a run that the store has is taken from there, whatever its point was called then.
A plan depends on finished runs alone, so that an interrupted campaign goes on where it was by asking once more.
"""

import platform
import time
from collections import deque
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from typing import Final, final

from testbench.campaign.file.schema import Campaign
from testbench.campaign.making.executor import Executor
from testbench.campaign.plans.plan_of import plan_of
from testbench.campaign.records import Outcome, Plan, Point, RunRow, Wanted
from testbench.campaign.store.store import Invocation, Recipe, Store
from testbench.errors import BenchError

LOOK_S: Final = 0.2
"""How often the runner looks up from waiting: for Ctrl-C, and for the progress line."""
GRACE_S: Final = 10.0
"""How long runs in flight are waited for after Ctrl-C."""
NOTED_S: Final = 10.0
"""How often the store is told how long the runner has been at it."""


@dataclass(frozen=True, slots=True)
class Progress:
    """How far a campaign is.

    done: runs that are known, of `wanted` so far (a rule or a search may come to want more); made: by this runner;
    elapsed_s: of this runner; counts: outcomes of all that are known.
    """

    done: int
    wanted: int
    made: int
    elapsed_s: float
    counts: Mapping[Outcome, int]

    @property
    def per_minute(self) -> float:
        """Runs made per minute, 0 as long as there is none."""
        return 60 * self.made / self.elapsed_s if self.elapsed_s > 0 else 0.0

    @property
    def left_s(self) -> float | None:
        """How long the rest will take, None as long as nobody knows."""
        return 60 * (self.wanted - self.done) / self.per_minute if self.made else None


@dataclass(frozen=True, slots=True)
class Finished:
    """How it ended. interrupted: by Ctrl-C; reused: runs that the store had."""

    progress: Progress
    reused: int
    interrupted: bool


Watch = Callable[[Progress], None]
Stop = Callable[[], int]
"""How often the user has asked to stop: once to begin nothing more, twice to drop what is in flight."""


@dataclass(frozen=True, slots=True)
class Way:
    """How runs are made. version: code version; folder: of result folders; fork: from snapshots of the golden run."""

    version: str
    folder: str
    fork: bool
    jobs: int
    command: str = ""


@dataclass(slots=True)
class _State:
    """What is known so far; rows without metrics and activations, of which a large campaign has gigabytes."""

    known: dict[Point, list[RunRow]] = field(default_factory=dict)
    there: set[tuple[Point, int]] = field(default_factory=set)
    counts: dict[Outcome, int] = field(default_factory=dict)
    in_flight: dict[str, Wanted] = field(default_factory=dict)

    def add(self, row: RunRow) -> None:
        if (row.point, row.number) in self.there:
            return
        self.there.add((row.point, row.number))
        rows = self.known.setdefault(row.point, [])
        rows.append(row)
        rows.sort(key=lambda one: one.number)
        self.counts[row.outcome] = self.counts.get(row.outcome, 0) + 1


@final
class Runner:
    """Runs one campaign into one store. Constructed, nothing has happened yet; `prepare`, then `run`."""

    def __init__(self, campaign: Campaign, store: Store, way: Way, plan: Plan | None = None) -> None:
        self._campaign: Final[Campaign] = campaign
        self._store: Final[Store] = store
        self._way: Final[Way] = way
        self._plan: Final[Plan] = plan_of(campaign) if plan is None else plan
        self._state: Final[_State] = _State()
        self._stored: Final[dict[str, RunRow]] = {}
        self._counted: Final[set[str]] = set()
        self._wanted: list[Wanted] = []
        self._queue: Final[deque[Wanted]] = deque()
        self._made: int = 0

    def prepare(self) -> None:
        """Take from the store what is there and still wanted, and say in it which runs count."""
        self._store.points.add(self._campaign.points)
        stored = self._store.runs.all(code_version=self._way.version, wanted=False, brief=True)
        self._stored.update({row.identity: row for row in stored})
        self._store.runs.want(self._ask(), only=True)

    def run(self, executor: Executor, watch: Watch, stop: Stop) -> Finished:
        """Make what is missing. Raises StoreError and ExecutorError; what was finished before is in the store."""
        begun, reused = time.monotonic(), len(self._state.there)
        machine, now = platform.node(), _now()
        way = self._way
        noted = Invocation(now, "", 0.0, way.jobs, 0, machine, way.version, way.command, "running")
        number, how = self._store.invocations.begin(noted), "stopped by an error"
        next_note = begun + NOTED_S
        try:
            with suppress(KeyboardInterrupt):  # a run against the clock takes Ctrl-C itself, and is dropped
                while (self._queue or self._state.in_flight) and not stop():
                    self._hand_out(executor)
                    self._take(executor.collect(LOOK_S))
                    watch(self._progress(begun))
                    if time.monotonic() >= next_note:
                        self._store.invocations.note(number, "", time.monotonic() - begun, self._made, "running")
                        next_note = time.monotonic() + NOTED_S
            self._wind_up(executor, stop)
            finished = not (self._queue or self._state.in_flight)
            how = "done" if finished else "interrupted"
        finally:
            executor.stop()
            if how != "stopped by an error":
                self._store.invocations.note(number, _now(), time.monotonic() - begun, self._made, how)
        return Finished(self._progress(begun), reused, not finished)

    def _wind_up(self, executor: Executor, stop: Stop) -> None:
        """After Ctrl-C: begin nothing more, and give runs in flight a moment."""
        until = time.monotonic() + GRACE_S
        while self._state.in_flight and stop() == 1 and time.monotonic() < until:
            self._take(executor.collect(LOOK_S))

    def _progress(self, begun: float) -> Progress:
        state = self._state
        elapsed = time.monotonic() - begun
        return Progress(len(state.there), len(self._wanted), self._made, elapsed, dict(state.counts))

    def _hand_out(self, executor: Executor) -> None:
        found = False
        while self._queue and executor.free() > 0:
            wanted = self._queue.popleft()
            if (wanted.point, wanted.number) in self._state.there:
                continue
            way = self._way
            spec = self._campaign.spec_of(wanted, way.version, way.folder, way.fork)
            if spec.identity in self._state.in_flight:  # two points of a search that are one scenario
                self._queue.append(wanted)
                return
            made = self._stored.get(spec.identity)
            if made is not None:
                self._state.add(replace(made, point=wanted.point, number=wanted.number))
                found = True
                continue
            self._state.in_flight[spec.identity] = wanted
            executor.submit(spec)
        if found and not self._queue:
            self._ask_again()

    def _take(self, rows: list[RunRow]) -> None:
        """Keep what has finished; ask the plan again when it is about to run out of what it wanted."""
        for row in rows:
            wanted = self._state.in_flight.pop(row.identity, None)
            if wanted is None:
                raise BenchError(f"run {row.identity[:12]} came back without having been asked for")
            row = replace(row, point=wanted.point, number=wanted.number)
            self._store.runs.append(row, self._recipe(wanted))
            brief = replace(row, metrics={}, injections=())
            self._stored[row.identity] = brief
            self._counted.add(row.identity)
            self._state.add(brief)
            self._made += 1
        if rows and len(self._queue) <= len(rows):
            self._ask_again()

    def _ask_again(self) -> None:
        """What is wanted now; what is found in the store counts from now on."""
        found = self._ask()
        if found:
            self._store.runs.want(found, only=False)

    def _ask(self) -> dict[str, tuple[Point, int]]:
        """What is wanted now; what of it the store has is known at once, and may make the plan want more.

        Gives the runs that were found in the store and did not count before, each for the first point that wants it.
        """
        version, state = self._way.version, self._state
        counted: dict[str, tuple[Point, int]] = {}
        while True:
            self._wanted = self._plan.wanted(state.known)
            self._store.set_meta({"wanted": str(len(self._wanted))})
            found = 0
            self._queue.clear()
            flying = {(one.point, one.number) for one in state.in_flight.values()}
            for wanted in self._wanted:
                place = (wanted.point, wanted.number)
                if place in state.there or place in flying:
                    continue
                row = self._stored.get(self._campaign.identity_of(wanted, version)) if self._stored else None
                if row is None:
                    self._queue.append(wanted)
                else:
                    state.add(replace(row, point=wanted.point, number=wanted.number))
                    found += 1
                    if row.identity not in self._counted:
                        self._counted.add(row.identity)
                        counted[row.identity] = place
            if not found:
                return counted

    def _recipe(self, wanted: Wanted) -> Recipe:
        stop = self._campaign.stop_early
        on, grace_s = (None, 0.0) if stop is None else (stop.on, stop.grace_s)
        return Recipe(self._campaign.scenario_text(wanted.point), self._way.version, on, grace_s)


def _now() -> str:
    return datetime.now(UTC).isoformat(timespec="seconds")
