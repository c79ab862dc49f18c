"""The command line: `exo-hil`.

stdout carries the result, stderr the talk. Exit codes: 0 pass, 1 verdict fail, 2 usage or bad file, 3 run invalid,
130 interrupted. Everything heavy is imported by the verb that needs it.
"""

import argparse
import os
import sys
import traceback
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Final

from canopen_exo.talk import show, tell
from testbench.cli_campaign import add_campaign_verbs
from testbench.cli_rig import CONTROL_ADDRESS, HUB_ADDRESS, add_control_frames, add_rig_options, add_verbs, named_buses

if TYPE_CHECKING:
    from testbench.replay import Replay
    from testbench.scenario import Scenario

PASS: Final = 0
FAIL: Final = 1
USAGE: Final = 2
INVALID: Final = 3
INTERRUPTED: Final = 130

_SIM_MODULES: Final = ("mujoco", "matplotlib", "pyarrow")


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one verb; returns the exit code."""
    if sys.stderr is None:  # closed by whoever started it
        sys.stderr = open(os.devnull, "w", encoding="utf-8")  # noqa: SIM115 - for as long as the process lives
    options = _parser().parse_args(arguments)
    verb: Callable[[argparse.Namespace], int] = options.verb
    try:
        return verb(options)
    except (KeyboardInterrupt, Exception) as error:  # noqa: BLE001 - the last resort: exit 1 would read as a verdict
        if _is_interrupt(error):
            tell("interrupted")
            return INTERRUPTED
        if isinstance(error, ModuleNotFoundError) and (error.name or "").partition(".")[0] in _SIM_MODULES:
            tell(f"{error.name} is not installed; a run needs the extra sim: pip install 'exo-hil[sim]'")
            return USAGE
        tell(traceback.format_exc().rstrip())
        tell("exo-hil: this is a defect of the program; nothing about the scenario is proved")
        return INVALID


def _is_interrupt(error: BaseException | None) -> bool:
    """Whether Ctrl-C is behind it: compiled packages turn one that comes while they load into an ImportError."""
    while error is not None and not isinstance(error, KeyboardInterrupt):
        error = error.__cause__ or error.__context__
    return error is not None


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="exo-hil",
        description="CAN-bus hardware-in-the-loop emulator of a lower-limb exoskeleton with wire-level fault injection",
        epilog="Exit codes: 0 pass, 1 verdict fail, 2 usage or bad file, 3 run invalid, 130 interrupted.",
    )
    parser.add_argument("--version", action=_Version, nargs=0, help="print the version and leave")
    verbs = parser.add_subparsers(title="verbs", metavar="VERB", required=True, parser_class=VerbParser)

    run = verbs.add_parser("run", help="golden run + faulted run, verdict", description=_run.__doc__)
    run.add_argument("scenario", type=Path, nargs="?", metavar="SCENARIO.yaml", help="what to run; see scenarios/")
    run.add_argument("--replay", type=Path, metavar="FOLDER", help="instead: the faults of a result folder, once more")
    run.add_argument("--seed", metavar="N", help="instead of the scenario's seed")
    run.add_argument("--out", type=Path, metavar="DIR", help="result folder (default: results/NAME-SEED[-CHANGES])")
    run.add_argument(
        "--set",
        action="append",
        default=[],
        metavar="KEY=VALUE",
        dest="overrides",
        help="change the scenario, as in injectors.freeze_position.effect.duration=0.5s; may be repeated",
    )
    run.add_argument("--json", action="store_true", help="print the result as one JSON document")
    run.add_argument("--realtime", action="store_true", help="as processes against the clock, not in virtual time")
    add_rig_options(run)
    add_control_frames(run)
    run.set_defaults(verb=_run)

    check = verbs.add_parser("check", help="validate a scenario and say what it will do", description=_check.__doc__)
    check.add_argument("scenario", type=Path, metavar="FILE", help="a scenario, a campaign, or faults for a gateway")
    check.add_argument("--seed", metavar="N", help="instead of the scenario's seed")
    check.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", dest="overrides", help="as for run")
    check.set_defaults(verb=_check)

    add_campaign_verbs(verbs, show)
    add_verbs(verbs)

    export = verbs.add_parser("export", help="write files for other tools", description=_export.__doc__)
    export.add_argument("what", choices=("eds", "dbc", "schema"), help="which of them")
    export.set_defaults(verb=_export)
    return parser


class VerbParser(argparse.ArgumentParser):
    """Of a verb: refuses what it does not know itself, so that it is its own usage that is shown."""

    def parse_known_args(  # type: ignore[override] # argparse has overloads for `namespace`; of a verb it is None
        self, args: Sequence[str] | None = None, namespace: None = None
    ) -> tuple[argparse.Namespace, list[str]]:
        """See argparse; what it does not know is an error."""
        found, unknown = super().parse_known_args(args, namespace)
        if unknown:
            self.error(f"unrecognized arguments: {' '.join(unknown)}; `{self.prog} --help` lists what there is")
        return found, unknown


class _Version(argparse.Action):
    """`--version`, looking the version up only when asked."""

    def __call__(
        self,
        parser: argparse.ArgumentParser,
        namespace: argparse.Namespace,
        values: object,
        option_string: str | None = None,
    ) -> None:
        from importlib.metadata import version

        show(f"exo-hil {version('exo-hil')}\n")
        parser.exit()


def _run(options: argparse.Namespace) -> int:
    """Run a scenario: a golden run without faults, a run with them, and a verdict on the pair.

    In virtual time, or with --realtime as processes against the clock, on an own hub or on the buses named. With
    --replay the faults of a result folder act again when and as long as they did, whatever started them.
    """
    if options.realtime:
        from testbench import fork_server

        fork_server.shared()  # it imports meanwhile

    from fi_gateway.errors import FaultError
    from fi_gateway.marked_yaml import FileErrors
    from fi_gateway.schema import refuse_wire_faults
    from testbench.errors import BenchError, RefusedError
    from testbench.store import check_folder, default_folder
    from testbench.summary import summary_json, summary_text

    try:
        scenario, replay = _loaded(options)
        buses = _real_time_buses(options)
        if options.realtime:
            from testbench.gateway_process import check_control_frames
            from testbench.realtime_run import check_without
            from testbench.scenario import refuse_queues

            check_control_frames(options.control_frames, options.without, is_judged=True)
            check_without(scenario, frozenset(options.without))
            refuse_wire_faults(scenario.injectors, "exo-hil run --realtime")
            refuse_queues(scenario, "exo-hil run --realtime")
        changes = [*options.overrides, *(("replay",) if replay is not None else ())]
        folder = options.out or default_folder(scenario.name, scenario.seed, changes)
        check_folder(folder, scenario.name)
    except (FileErrors, BenchError, FaultError) as error:
        tell(_as_typed(error, options))
        return USAGE
    for warning in scenario.warnings:
        tell(f"warning: {warning}")

    from canopen_exo.errors import CanopenExoError
    from joint_emulators.errors import JointEmulatorError
    from testbench.folder import write_folder

    try:
        with _progress(scenario.name) as progress:
            if options.realtime:
                from testbench.realtime_run import run_realtime

                without = frozenset(options.without)
                places = _places(options, without)
                result = run_realtime(
                    scenario,
                    buses,
                    without,
                    fifo=options.fifo,
                    places=places,
                    control_frames=options.control_frames,
                    progress=progress,
                    announce=tell,
                )
            else:
                from testbench.run import run_scenario

                result = run_scenario(scenario, progress, None if replay is None else replay.windows)
    except RefusedError as error:
        tell(str(error))
        return USAGE
    except (BenchError, JointEmulatorError, CanopenExoError) as error:
        tell(f"{scenario.name}: run invalid: {error}")
        return INVALID
    if replay is not None:
        result.document["replay"] = replay.entry(result.document)
    try:
        written = write_folder(folder, result)
    except BenchError as error:
        tell(str(error))
        return USAGE
    show(summary_json(result.document) if options.json else summary_text(result.document))
    tell(f"result folder: {written}")
    if not result.document["valid"]:
        timing = result.document.get("realtime")
        if timing is not None and timing["late_cycles"]:
            from testbench.watch import too_busy

            tell(too_busy(scenario.plan.cycle_ns))
        return INVALID
    return PASS if result.judgement.passed else FAIL


def _places(options: argparse.Namespace, without: frozenset[str]) -> tuple[str, str]:
    """Where hub and live control listen: where foreign software looks for them, else on a free port and in a folder."""
    listen = options.listen or (HUB_ADDRESS if without else "127.0.0.1:0")
    return listen, options.control or (CONTROL_ADDRESS if "hlc" in without else "")


def _loaded(options: argparse.Namespace) -> "tuple[Scenario, Replay | None]":
    """The scenario to run, and what is replayed in it; raises FileErrors and BenchError."""
    from fi_gateway.marked_yaml import FileErrors
    from testbench.errors import BenchError
    from testbench.replay import load_replay
    from testbench.scenario import load_scenario

    overrides = list(options.overrides)
    if (options.scenario is None) == (options.replay is None):
        raise BenchError("run: give SCENARIO.yaml, or --replay FOLDER, one of the two")
    if options.replay is None:
        if options.seed is not None:
            overrides.append(f"seed={options.seed}")
        try:
            return load_scenario(options.scenario, overrides), None
        except FileErrors:
            from testbench.campaign.file.schema import is_campaign_file

            if is_campaign_file(options.scenario):
                told = f"this is a campaign; `exo-hil campaign run {options.scenario}` runs it"
                raise BenchError(f"{options.scenario}: {told}") from None
            raise
    if options.realtime or options.seed is not None:
        raise BenchError("--replay runs in virtual time and draws nothing anew; leave out --realtime and --seed")
    replay = load_replay(options.replay, overrides)
    return replay.scenario, replay


def _real_time_buses(options: argparse.Namespace) -> tuple[str, str] | None:
    """The buses named; raises BenchError when something of real time is given without --realtime."""
    from testbench.errors import BenchError

    buses = named_buses(options)
    of_real_time = ("controller_bus", "drive_bus", "without", "listen", "control", "control_frames", "fifo")
    given = [f"--{name.replace('_', '-')}" for name in of_real_time if getattr(options, name)]
    if given and not options.realtime:
        raise BenchError(f"{', '.join(given)}: {'is' if len(given) == 1 else 'are'} of real time; add --realtime")
    return buses


def _check(options: argparse.Namespace) -> int:
    """Validate a scenario, a campaign, or a file of faults for the gateway, and say in words what it will do."""
    from fi_gateway.marked_yaml import FileErrors
    from testbench.campaign.file.schema import is_campaign_file
    from testbench.cli_campaign import check_campaign
    from testbench.fault_file import FaultFile, describe_faults, load_any
    from testbench.scenario import describe

    overrides = list(options.overrides)
    if options.seed is not None:
        overrides.append(f"seed={options.seed}")
    try:
        if is_campaign_file(options.scenario):
            return check_campaign(options.scenario, options.overrides, options.seed, show)
        found = load_any(options.scenario, overrides)
    except FileErrors as error:
        tell(_as_typed(error, options))
        return USAGE
    show("\n".join(describe_faults(found) if isinstance(found, FaultFile) else describe(found)) + "\n")
    for warning in found.warnings:
        tell(f"warning: {warning}")
    return PASS


def _export(options: argparse.Namespace) -> int:
    """Print the joint controllers' EDS, the bus as DBC, or the JSON Schema of scenario files."""
    if options.what == "schema":
        import json

        from testbench.scenario import scenario_schema

        show(json.dumps(scenario_schema(), indent=2) + "\n")
        return PASS
    from importlib.resources import files

    name = {"eds": "exo_joint.eds", "dbc": "exo.dbc"}[options.what]
    show((files("dbc") / name).read_text(encoding="utf-8"))
    return PASS


@contextmanager
def _progress(name: str) -> Iterator[Callable[[float], None]]:
    """A progress bar on stderr, when that is a terminal."""
    if not sys.stderr.isatty():
        yield lambda share: None
        return
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

    percent = TextColumn("{task.percentage:3.0f} %")
    columns = (TextColumn("{task.description}"), BarColumn(), percent, TimeRemainingColumn())
    with Progress(*columns, console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task(name, total=1.0)
        yield lambda share: bar.update(task, completed=share)


def _as_typed(error: Exception, options: argparse.Namespace) -> str:
    """A complaint in the words of the command line: the seed came as --seed."""
    return str(error) if options.seed is None else str(error).replace("--set seed=", "--seed ")


if __name__ == "__main__":
    sys.exit(main())
