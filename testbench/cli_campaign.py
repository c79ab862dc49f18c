"""The verbs of campaigns: run one, see how far it is, report it, make one of its runs again, hand its runs on.

Nothing heavy is imported before a verb needs it. Exit codes: 0 done, 2 usage, bad file or store, 3 some runs make no
statement, 130 interrupted.
"""

import argparse
import json
import os
import shlex
import sys
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Final

from canopen_exo.talk import tell
from testbench.cli_rig import HUB_ADDRESS, INVALID, PASS, USAGE, Verbs, add_rig_options, named_buses
from testbench.errors import BenchError

if TYPE_CHECKING:
    from testbench.campaign.file.schema import Campaign
    from testbench.campaign.making.executor import Executor
    from testbench.campaign.making.over_bus import Rigging
    from testbench.campaign.records import RunRow
    from testbench.campaign.runner import Finished
    from testbench.campaign.store.store import Store
    from testbench.process import Orders

INTERRUPTED: Final = 130
_ABOUT: Final = (
    "Run one scenario many times, over a grid of values, and keep what came out in a store; see docs/campaigns.md. "
    "Exit codes: 0 done, 2 usage, bad file or store, 3 some runs make no statement, 130 interrupted."
)
_RETRY: Final = (
    "make runs that crashed or hung once more, with --realtime invalid ones too (they may come out otherwise)"
)


def add_campaign_verbs(verbs: Verbs, show: Callable[[str], None]) -> None:
    """Add `campaign` and its words; show: prints a result to stdout."""
    campaign = verbs.add_parser("campaign", help="many runs: grids, statistics, reports", description=_ABOUT)
    words = campaign.add_subparsers(title="words", metavar="WORD", required=True)

    run = words.add_parser("run", help="run a campaign, or go on with it", description=_run.__doc__)
    run.add_argument("campaign", type=Path, metavar="CAMPAIGN.yaml", help="what to run; see docs/campaigns.md")
    run.add_argument("--runs", type=_count, metavar="N", help="runs per point, instead of the file's")
    run.add_argument("--jobs", type=_count, metavar="N", help="processes (default: one for each core)")
    run.add_argument("--out", type=Path, metavar="STORE", help="default: results/campaigns/NAME[-CHANGES].sqlite")
    run.add_argument(
        "--set",
        action="append",
        default=[],
        metavar="KEY=VALUE",
        dest="overrides",
        help="change the scenario of every run, as for `exo-hil run`; may be repeated",
    )
    run.add_argument("--no-fork", action="store_true", help="every run from power-up, not from the golden run's middle")
    run.add_argument("--retry", action="store_true", help=_RETRY)
    run.add_argument("--no-report", action="store_true", help="write no report at the end")
    run.add_argument("--cluster", metavar="ADDRESS", help="on the workers of dask.distributed, as in tcp://HOST:8786")
    run.add_argument("--realtime", action="store_true", help="one after another as processes against the clock")
    add_rig_options(run)
    _add_json(run)
    run.set_defaults(verb=_told(_run, show))

    status = words.add_parser("status", help="how far a campaign is, also while it runs", description=_status.__doc__)
    _add_store(status)
    _add_json(status)
    status.set_defaults(verb=_told(_status, show))

    report = words.add_parser("report", help="HTML report and JUnit file of a store", description=_report.__doc__)
    _add_store(report)
    report.add_argument("--html", type=Path, metavar="FILE", help="default: beside the store")
    report.add_argument("--junit", type=Path, metavar="FILE", help="default: beside the store")
    report.set_defaults(verb=_told(_report, show))

    replay = words.add_parser("replay", help="make one run again, with everything", description=_replay.__doc__)
    _add_store(replay)
    replay.add_argument("run", metavar="RUN", help="POINT/NUMBER, or the first letters of the run's identity")
    replay.add_argument("--out", type=Path, metavar="DIR", help="default: results/NAME-POINT-NUMBER")
    _add_json(replay)
    replay.set_defaults(verb=_told(_replay, show))

    export = words.add_parser("export", help="all runs as one table", description=_export.__doc__)
    _add_store(export)
    export.add_argument("--csv", type=Path, metavar="FILE", help="comma-separated values")
    export.add_argument("--parquet", type=Path, metavar="FILE", help="Parquet, with units in the metadata")
    export.add_argument("--injections", action="store_true", help="a line an activation instead of a line a run")
    export.add_argument("--all", action="store_true", help="also runs that are kept and not counted")
    export.set_defaults(verb=_told(_export, show))


def check_campaign(path: Path, overrides: list[str], seed: str | None, show: Callable[[str], None]) -> int:
    """`exo-hil check` for a campaign; raises FileErrors."""
    from testbench.campaign.file.schema import load_campaign
    from testbench.campaign.words import describe_campaign

    if seed is not None:
        tell(f"--seed {seed}: a campaign has one seed for all its runs, in its file; leave the option out")
        return USAGE
    show("\n".join(describe_campaign(load_campaign(path, overrides))) + "\n")
    return PASS


def _add_store(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("store", type=Path, metavar="STORE.sqlite", help="what `campaign run` has written")


def _add_json(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--json", action="store_true", help="print one JSON document")


def _count(text: str) -> int:
    if not text.isdecimal() or not 1 <= int(text) <= 1_000_000:
        raise argparse.ArgumentTypeError(f"{text!r} given; allowed is a whole number from 1 up")
    return int(text)


def _told(
    verb: Callable[[argparse.Namespace, Callable[[str], None]], int], show: Callable[[str], None]
) -> Callable[[argparse.Namespace], int]:
    """The verb, with what is wrong with files and stores said in their own words."""

    def told(options: argparse.Namespace) -> int:
        from fi_gateway.errors import FaultError

        try:
            return verb(options, show)
        except (BenchError, FaultError) as error:
            tell(str(error))
            return USAGE

    return told


def _run(options: argparse.Namespace, show: Callable[[str], None]) -> int:
    """Make the runs that a campaign wants and its store does not have, in supervised processes.

    With --cluster on the workers of dask.distributed; with --realtime one after another against the clock, on an own
    hub or on the buses named, the gateway armed over live control for each run. Started again, it goes on where it was,
    whatever ended it. Ctrl-C once: nothing more is begun, runs in flight get a moment; twice: they are dropped.
    """
    from testbench.campaign.file.schema import load_campaign
    from testbench.campaign.making.identity import code_version
    from testbench.campaign.progress import shown
    from testbench.campaign.records import NO_STATEMENT, Outcome
    from testbench.campaign.runner import Runner, Way
    from testbench.campaign.store.archive import remember
    from testbench.campaign.store.store import open_store
    from testbench.process import Orders

    campaign = load_campaign(options.campaign, options.overrides, options.runs)
    path = options.out or _default_store(campaign.name, options.overrides)
    rigging = _rigging(options)
    version = code_version() if rigging is None else f"{code_version()} {rigging.words()}"
    jobs = 1 if rigging is not None else options.jobs or _cores()
    fork = not options.no_fork and rigging is None
    way = Way(version, str(path.with_suffix("")) + "-runs", fork, jobs, _command())
    executor = _executor(options, campaign, rigging, jobs)
    store = open_store(path, write=True)
    try:
        remember(store, campaign)
        if options.retry:
            again = (Outcome.CRASHED, Outcome.HANG, *([] if rigging is None else [Outcome.INVALID]))
            store.runs.forget(again, version)
        runner = Runner(campaign, store, way)
        with Orders().taken() as orders, shown(campaign.name) as watch:
            runner.prepare()
            finished = runner.run(executor, watch, _stopping(orders))
        rows = store.runs.all(brief=True)
        show(_run_json(campaign, store, rows, finished) if options.json else _run_text(campaign, store, rows, finished))
        if finished.interrupted:
            tell(f"interrupted; the same command goes on from here: {len(rows)} runs are in {path}")
            return INTERRUPTED
        if not options.no_report:
            _write_report(store, None, None)
    finally:
        store.close()
    return INVALID if any(row.outcome in NO_STATEMENT for row in rows) else PASS


def _rigging(options: argparse.Namespace) -> "Rigging | None":
    """Buses and parts of runs against the clock, None for virtual time; raises BenchError for what does not fit."""
    of_real_time = ("controller_bus", "drive_bus", "without", "listen", "control", "fifo")
    given = [f"--{name.replace('_', '-')}" for name in of_real_time if getattr(options, name)]
    if not options.realtime:
        if given:
            raise BenchError(f"{', '.join(given)}: {'is' if len(given) == 1 else 'are'} of real time; add --realtime")
        return None
    others = [name for name in ("cluster", "jobs") if getattr(options, name)]
    if others:
        raise BenchError(f"--{others[0]}: runs against the clock are made one after another, here; leave it out")
    from testbench.campaign.making.over_bus import Rigging

    without = frozenset(options.without)
    listen = options.listen or (HUB_ADDRESS if without else "127.0.0.1:0")
    return Rigging(named_buses(options), without, options.fifo, listen, options.control or "")


def _executor(
    options: argparse.Namespace, campaign: "Campaign", rigging: "Rigging | None", jobs: int
) -> "Executor":
    """Where the runs are made. Raises BenchError and FaultError for runs that cannot be made there."""
    if rigging is not None:
        from testbench.campaign.making.over_bus import OverBus, check_scenario

        for point in campaign.points:
            check_scenario(campaign.settings.scenario(point), rigging)
        return OverBus(rigging)
    if options.cluster is not None:
        try:
            from testbench.campaign.making.cluster import Cluster
        except ModuleNotFoundError as error:
            raise BenchError(
                f"--cluster: {error.name} is not installed; it comes with the extra: pip install 'exo-hil[cluster]'"
            ) from error
        return Cluster(options.cluster)
    from testbench.campaign.making.pool import Pool

    return Pool(jobs)


def _default_store(name: str, overrides: list[str]) -> Path:
    """Changes give a store of its own: they make it another experiment."""
    changes = f"-{zlib.crc32(' '.join(overrides).encode()):08x}" if overrides else ""
    return Path("results") / "campaigns" / f"{name}{changes}.sqlite"


def _stopping(orders: "Orders") -> Callable[[], int]:
    """How often the user has asked to stop; says what comes of it when he first does."""
    told: list[str] = []

    def count() -> int:
        if orders.count and not told:
            told.append("stopping: no run is begun any more, those in flight get 10 s; Ctrl-C again drops them")
            tell(told[0])
        return orders.count

    return count


def _cores() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0)) if sys.platform == "linux" else os.cpu_count() or 1


def _command() -> str:
    return shlex.join(["exo-hil", *sys.argv[1:]])


def _run_text(campaign: "Campaign", store: "Store", rows: "list[RunRow]", finished: "Finished") -> str:
    """What `campaign run` prints at its end."""
    from testbench.campaign.words import interval_note, point_lines, time_text

    far = finished.progress
    lines = point_lines(store.points.all(), rows)
    lines += [note] if (note := interval_note(campaign.rule)) else []
    rate = f"{far.per_minute:.1f} runs/min" if far.made else "nothing was missing"
    lines.append(f"{far.done} of {far.wanted} runs; {far.made} made in {time_text(far.elapsed_s)} ({rate})")
    return "\n".join([*lines, *_asides(store, rows), f"store: {store.path}"]) + "\n"


def _asides(store: "Store", rows: "list[RunRow]") -> list[str]:
    """What does not count, and why."""
    from testbench.campaign.words import odd_lines

    lines = odd_lines(rows, store.points.all())
    for version, count in store.runs.others().items():
        lines.append(f"not counted: {count} runs of version {version} that the campaign as run last does not want")
    return lines


def _run_json(campaign: "Campaign", store: "Store", rows: "list[RunRow]", finished: "Finished") -> str:
    far = finished.progress
    document = {
        **_counts(store, rows),
        "wanted": far.wanted,
        "made": far.made,
        "reused": finished.reused,
        "interrupted": finished.interrupted,
        "wall_time_s": far.elapsed_s,
        "runs_per_min": far.per_minute,
        "points": _points(store, rows),
    }
    return json.dumps({"campaign": campaign.name, **document}, indent=2, allow_nan=False) + "\n"


def _counts(store: "Store", rows: "list[RunRow]") -> dict[str, object]:
    from testbench.campaign.records import Outcome

    counts = {one.value: sum(row.outcome is one for row in rows) for one in Outcome}
    return {
        "store": str(store.path),
        "done": len(rows),
        "outcomes": {name: count for name, count in counts.items() if count},
        "not_counted": store.runs.others(),
    }


def _points(store: "Store", rows: "list[RunRow]") -> list[dict[str, object]]:
    """A point each: parameters as written, runs, outcomes, share of failures with its 95 % Wilson interval."""
    from testbench.campaign.records import Outcome, Point
    from testbench.campaign.statistics.shares import tally, wilson

    found: dict[Point, list[Outcome]] = {}
    for row in rows:
        found.setdefault(row.point, []).append(row.outcome)
    entries: list[dict[str, object]] = []
    for number, point in store.points.all().items():
        outcomes = found.get(point, [])
        if not outcomes:
            continue
        counted = tally(outcomes, "failure")
        interval = wilson(counted.successes, counted.trials) if counted.trials else None
        entries.append(
            {
                "point": number,
                "parameters": dict(point.parameters),
                "runs": len(outcomes),
                "outcomes": {one.value: outcomes.count(one) for one in Outcome if one in outcomes},
                "failure_share": counted.share,
                "failure_interval": None if interval is None else [interval.low, interval.high],
            }
        )
    return entries


def _status(options: argparse.Namespace, show: Callable[[str], None]) -> int:
    """How far a campaign is: counts, rate, and the runs that make no statement with their reasons; nothing is run."""
    from testbench.campaign.store.store import open_store
    from testbench.campaign.words import counts_text, time_text

    store = open_store(options.store)
    try:
        rows, made = store.runs.all(brief=True), store.invocations.all()
        wanted = int(store.meta("wanted") or len(rows))
        last = made[-1] if made else None
        rate = 60 * last.made / last.wall_s if last is not None and last.wall_s > 0 else 0.0
        how = "never run" if last is None else last.how if last.how != "running" or store.is_held() else "broken off"
        document = {"campaign": store.meta("name"), "state": how, **_counts(store, rows)}
        document |= {"wanted": wanted, "runs_per_min": rate, "points": _points(store, rows)}
        if options.json:
            show(json.dumps(document, indent=2, allow_nan=False) + "\n")
            return PASS
        left = f", {time_text(60 * (wanted - len(rows)) / rate)} left" if how == "running" and rate else ""
        counts = {one: sum(row.outcome is one for row in rows) for one in {row.outcome for row in rows}}
        lines = [f"{store.meta('name')}: {how}; {len(rows)} of {wanted} runs{left}", counts_text(counts)]
        if last is not None:
            lines.append(f"last run: {last.made} made in {time_text(last.wall_s)}, {rate:.1f} runs/min, {last.command}")
        show("\n".join([*lines, *_asides(store, rows)]) + "\n")
    finally:
        store.close()
    return PASS


def _report(options: argparse.Namespace, show: Callable[[str], None]) -> int:
    """Write the report of a store: one HTML file that needs nothing else, and a JUnit file; also of a part of it."""
    from testbench.campaign.store.store import open_store

    store = open_store(options.store)
    try:
        _write_report(store, options.html, options.junit)
    finally:
        store.close()
    return PASS


def _write_report(store: "Store", html: Path | None, junit: Path | None) -> None:
    from testbench.campaign.report.page import write_report
    from testbench.campaign.store.archive import contents

    html = html or store.path.with_suffix(".html")
    junit = junit or store.path.with_suffix(".xml")
    rows, meta = contents(store)
    try:
        write_report(rows, meta, html, junit)
    except OSError as error:
        reason = error.strerror or error
        raise BenchError(f"report {html}, {junit}: {reason}; the runs are safe in {store.path}") from error
    tell(f"report: {html}, {junit}")


def _replay(options: argparse.Namespace, show: Callable[[str], None]) -> int:
    """Make one run again with its full result folder, as `exo-hil run` writes it, and say whether it is the same."""
    from testbench.campaign.again import make_again
    from testbench.campaign.store.store import open_store

    store = open_store(options.store)
    try:
        again = make_again(store, options.run, options.out, tell)
    finally:
        store.close()
    if options.json:
        show(json.dumps(again.document(), indent=2, allow_nan=False) + "\n")
    else:
        show(again.text())
    return PASS if again.same else INVALID


def _export(options: argparse.Namespace, show: Callable[[str], None]) -> int:
    """Write the runs as one flat table: axes as written and in SI, outcome, numbers, metrics."""
    from testbench.campaign.store.export import injection_table, run_table, write_csv, write_parquet
    from testbench.campaign.store.store import open_store

    if options.csv is None and options.parquet is None:
        raise BenchError("export: where to? give --csv FILE, --parquet FILE, or both")
    store = open_store(options.store)
    try:
        rows = store.runs.all(wanted=not options.all)
    finally:
        store.close()
    table = injection_table(rows) if options.injections else run_table(rows)
    for path, write in ((options.csv, write_csv), (options.parquet, write_parquet)):
        if path is not None:
            write(table, path)
            tell(f"{path}: {len(next(iter(table.values()), []))} lines")
    return PASS
