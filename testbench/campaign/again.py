"""One run of a store, made again: the same scenario and seed, with everything that a single run leaves."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from fi_gateway.errors import FaultError
from testbench.campaign.file.settings import describe_point
from testbench.campaign.making.execute import Workshop, make_run
from testbench.campaign.making.identity import code_version, with_seed
from testbench.campaign.records import IN_REAL_TIME, NO_STATEMENT, RunRow, RunSpec, Wanted
from testbench.campaign.store.archive import remembered
from testbench.campaign.store.store import Store
from testbench.errors import BenchError
from testbench.run import Result
from testbench.scenario import parse_scenario
from testbench.store import check_folder
from testbench.summary import summary_text


@dataclass(frozen=True, slots=True)
class Again:
    """The run in the store, the one made now, and where its folder is.

    name: POINT/NUMBER and campaign; changes: what the campaign changed in its scenario for this run, as for --set;
    result: None where there was nothing to judge.
    """

    name: str
    changes: tuple[str, ...]
    before: RunRow
    now: RunRow
    result: Result | None
    folder: Path

    @property
    def same(self) -> bool:
        """Whether both runs are the same, frame by frame."""
        return self.before.trace_hash == self.now.trace_hash and self.before.outcome is self.now.outcome

    def document(self) -> dict[str, object]:
        """As JSON."""
        return {
            "run": self.name.partition(" ")[0],
            "identity": self.before.identity,
            "seed": self.before.seed,
            "parameters": dict(self.before.point.parameters),
            "changes": list(self.changes),
            "outcome": {"store": self.before.outcome.value, "now": self.now.outcome.value},
            "trace_hash": {"store": self.before.trace_hash, "now": self.now.trace_hash},
            "same": self.same,
            "folder": str(self.folder),
        }

    def text(self) -> str:
        """In words: what was made, what came out as `exo-hil run` prints it, and whether it is the same."""
        lines = [f"run {self.name}, seed {self.before.seed}: {describe_point(self.before.point)}"]
        lines += [f"      {change}" for change in self.changes]
        if self.result is not None:
            lines += summary_text(self.result.document).splitlines()
        lines.append(f"outcome: {self.now.outcome.value}{f': {self.now.reason}' if self.now.reason else ''}")
        if self.same:
            lines.append(f"the same as in the store: trace hash {self.now.trace_hash}")
        else:
            was = f"{self.before.outcome.value}, trace hash {self.before.trace_hash or 'none'}"
            lines.append(f"NOT the same as in the store ({was}): trace hash {self.now.trace_hash or 'none'}")
        return "\n".join(lines) + "\n"


def find_run(store: Store, name: str) -> RunRow:
    """The run of a name: POINT/NUMBER, or the first letters of its identity. Raises BenchError."""
    rows = store.runs.all(wanted=False)
    point, slash, number = name.partition("/")
    if slash:
        points = store.points.all()
        if not (point.isdecimal() and number.isdecimal()) or int(point) not in points:
            raise BenchError(f"run {name!r}: allowed is POINT/NUMBER, as in 1/0; points 1..{max(points, default=0)}")
        here = [row for row in rows if row.point == points[int(point)]]
        found = [row for row in here if row.number == int(number)]
        found = found if len(found) < 2 else [row for row in store.runs.all() if row in found]
        if not found:
            have = f"it has numbers up to {max(row.number for row in here)}" if here else "it has none"
            raise BenchError(f"run {name!r}: there is no such run of that point; {have}")
    else:
        found = [row for row in rows if row.identity.startswith(name.lower())]
    if len(found) != 1:
        raise BenchError(
            f"run {name!r}: {len(found)} runs of the store {store.path} have that name; give "
            f"{'more letters' if found else 'POINT/NUMBER or the first letters of an identity'}"
        )
    return found[0]


def changes_of(store: Store, row: RunRow) -> tuple[str, ...]:
    """`key=value` of all that was set in the scenario for a run, by --set or by its point.

    () when that is not known: the campaign as run last does not make this run, or cannot be read by this version.
    """
    try:
        campaign = remembered(store)
        if campaign.scenario_text(row.point) != store.runs.recipe(row.identity).scenario:
            return ()
        return (*campaign.changes, *(f"{key}={value}" for key, value in campaign.settings.changes(row.point)))
    except (BenchError, FaultError, KeyError):
        return ()


def make_again(store: Store, name: str, out: Path | None, say: Callable[[str], None]) -> Again:
    """Make the run; says what stands in the way of its being the same. Raises BenchError."""
    before = find_run(store, name)
    recipe = store.runs.recipe(before.identity)
    if IN_REAL_TIME in recipe.code_version:
        raise BenchError(
            f"run {name!r}: it was made {recipe.code_version.partition(' ')[2]}, and no run against the clock comes "
            "again bit for bit; `traces: always` in the campaign file keeps a result folder of every run"
        )
    number = next(number for number, point in store.points.all().items() if point == before.point)
    campaign = store.meta("name")
    folder = out or Path("results") / f"{campaign}-{number}-{before.number}"
    check_folder(folder, parse_scenario(recipe.scenario).name)
    version = code_version()
    if version != recipe.code_version:
        say(f"warning: the run was made by version {recipe.code_version}, this is {version}: it may come out otherwise")
    if before.outcome in NO_STATEMENT:
        say(f"in the store the run is {before.outcome.value}: {before.reason}")
    spec = RunSpec(
        identity=before.identity,
        wanted=Wanted(before.point, before.number),
        seed=before.seed,
        scenario=with_seed(recipe.scenario, before.seed),
        code_version=version,
        stop_on=recipe.stop_on,
        grace_s=recipe.grace_s,
        keep_traces="always",
        folder=str(folder),
        time_limit_s=float("inf"),
        fork=False,
    )
    results: list[Result] = []
    now = make_run(spec, Workshop(), results.append)
    if results:
        say(f"result folder: {folder.resolve()}")
    name, result = f"{number}/{before.number} of {campaign}", results[0] if results else None
    return Again(name, changes_of(store, before), before, now, result, folder)
