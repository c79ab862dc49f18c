"""The verbs of the command line that run against the clock: the processes of a rig, and `up`, which runs them all.

Nothing heavy is imported before a verb needs it.
"""

import argparse
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Final, Protocol

from canopen_exo.talk import tell
from testbench.errors import BenchError

if TYPE_CHECKING:
    from canopen_exo.bus.hub_core import MakeBus
    from canopen_exo.bus.interfaces import BusName
    from testbench.fault_file import FaultFile
    from testbench.process import ProcessOptions
    from testbench.scenario import Scenario

PASS: Final = 0
USAGE: Final = 2
INVALID: Final = 3

PARTS: Final = ("joints", "gateway", "hlc")

HUB_ADDRESS: Final = "127.0.0.1:29536"
HUB_BITRATE: Final = 1_000_000
CONTROL_ADDRESS: Final = "127.0.0.1:29537"
NAMED: Final = ("arm", "disarm", "trigger")
UNNAMED: Final = ("start", "stop", "resume")
"""Words of live control; a test holds that they are those of the gateway."""

DEFAULT_SCENARIO: Final = """\
name: rig
description: the default rig, walking
rig: {plant: suspended, stops: off, rate: 500 Hz}
motion: {gait: walking, stride: 1.5 s, duration: 7 s}
"""
"""What the processes run without a scenario file."""

_BUS_HELP: Final = "INTERFACE:CHANNEL[@bitrate], such as socketcan:can0 or hub:127.0.0.1:29536/drive"


class Verbs(Protocol):
    """Where verbs are added: what argparse's add_subparsers returns."""

    def add_parser(self, name: str, *, help: str, description: str | None) -> argparse.ArgumentParser:
        """A parser for one verb."""


def add_verbs(verbs: Verbs) -> None:
    """Add the verbs of this module."""
    up = verbs.add_parser("up", help="the whole rig as real-time processes until Ctrl-C", description=_up.__doc__)
    _add_scenario(up)
    add_rig_options(up)
    add_control_frames(up)
    up.add_argument("--no-faults", action="store_true", help="without the scenario's injectors")
    up.set_defaults(verb=_up)

    joints = verbs.add_parser("joints", help="six drives on their plant, one process", description=_joints.__doc__)
    _add_scenario(joints)
    _add_process(joints)
    joints.add_argument("--bus", metavar="BUS", help=f"drive bus: {_BUS_HELP} (default: hub:drive)")
    joints.set_defaults(verb=_joints)

    hlc = verbs.add_parser("hlc", help="the high-level controller, one process", description=_hlc.__doc__)
    _add_scenario(hlc)
    _add_process(hlc)
    hlc.add_argument("--bus", metavar="BUS", help=f"controller bus: {_BUS_HELP} (default: hub:controller)")
    hlc.add_argument("--endless", action="store_true", help="walk until told to end, not for the scenario's duration")
    hlc.set_defaults(verb=_hlc)

    gateway = verbs.add_parser("gateway", help="the fault-injecting gateway, one process", description=_gateway.__doc__)
    gateway.add_argument(
        "scenario",
        type=Path,
        nargs="?",
        metavar="FAULTS.yaml",
        help="injectors, or a whole scenario (default: none, every frame passes)",
    )
    _add_overrides(gateway)
    _add_process(gateway)
    gateway.add_argument("--controller-bus", metavar="BUS", help=f"{_BUS_HELP} (default: hub:controller)")
    gateway.add_argument("--drive-bus", metavar="BUS", help=f"{_BUS_HELP} (default: hub:drive)")
    gateway.add_argument("--no-faults", action="store_true", help="without the scenario's injectors")
    gateway.add_argument(
        "--control", metavar="ADDRESS", default="", help=f"live control at HOST:PORT or a path: {CONTROL_ADDRESS}"
    )
    add_control_frames(gateway)
    gateway.set_defaults(verb=_gateway)

    fault = verbs.add_parser("fault", help="live control of a running gateway", description=_fault.__doc__)
    fault.add_argument("word", choices=("list", *NAMED, *UNNAMED), help="what to do")
    fault.add_argument("name", nargs="?", default="", metavar="INJECTOR", help=f"for {', '.join(NAMED)}")
    fault.add_argument("--at", default=CONTROL_ADDRESS, metavar="ADDRESS", help="of the gateway (default: %(default)s)")
    fault.set_defaults(verb=_fault)

    hub = verbs.add_parser("hub", help="an emulated bus for machines without CAN", description=_hub.__doc__)
    hub.add_argument(
        "--listen", metavar="HOST:PORT", default=HUB_ADDRESS, help="port 0: a free one (default: %(default)s)"
    )
    hub.add_argument("--timed", action="store_true", help="with bit time and arbitration of a real bus")
    hub.add_argument("--bitrate", type=int, metavar="N", help=f"with --timed, bit/s (default: {HUB_BITRATE})")
    hub.add_argument("--errors", action="store_true", help="with --timed: acknowledgement, error frames, error states")
    hub.add_argument("--bit-error-rate", type=float, metavar="R", help="with --errors: noise, flips per bit")
    hub.add_argument("--seed", type=int, default=1, metavar="N", help="of the noise (default: %(default)s)")
    _add_supervisor(hub)
    hub.set_defaults(verb=_hub)


def add_rig_options(parser: argparse.ArgumentParser) -> None:
    """Which buses and which processes: of `up`, and of `run --realtime`."""
    parser.add_argument("--controller-bus", metavar="BUS", help=f"{_BUS_HELP} (default: an own hub)")
    parser.add_argument("--drive-bus", metavar="BUS", help="as --controller-bus; give both or none")
    parser.add_argument(
        "--without",
        action="append",
        default=[],
        choices=PARTS,
        metavar="PART",
        help="leave joints, gateway or hlc to foreign software on the same buses; may be repeated",
    )
    known = "for `up`, and where others must find it; else any free one"
    parser.add_argument("--listen", metavar="HOST:PORT", help=f"of the own hub (default: {HUB_ADDRESS} {known})")
    parser.add_argument("--control", metavar="ADDRESS", help=f"of the gateway (default: {CONTROL_ADDRESS} {known})")
    parser.add_argument("--fifo", action="store_true", help="real-time scheduling (SCHED_FIFO), where permitted")


def add_control_frames(parser: argparse.ArgumentParser) -> None:
    """Live control over the bus: of the gateway, and of what starts one."""
    parser.add_argument(
        "--control-frames",
        metavar="SIDE[:COMMAND,STATUS]",
        default="",
        help="live control by frames on the controller or drive side, as in drive:0x6C0,0x6C1",
    )


def named_buses(options: argparse.Namespace) -> tuple[str, str] | None:
    """The two buses, None when none is named; raises BenchError for one without the other, or for one twice."""
    controller, drive = options.controller_bus, options.drive_bus
    if controller is None and drive is None:
        return None
    if controller is None or drive is None:
        given, missing = ("--controller-bus", "--drive-bus") if drive is None else ("--drive-bus", "--controller-bus")
        raise BenchError(f"{given} is given without {missing}: the gateway stands between two buses; give both or none")
    from canopen_exo.bus.interfaces import parse_bus
    from canopen_exo.errors import CanopenExoError

    try:
        check_two(parse_bus(controller), parse_bus(drive))
    except CanopenExoError as error:
        raise BenchError(str(error)) from error
    return controller, drive


def check_two(controller: "BusName", drive: "BusName") -> None:
    """Refuse one bus under two names; raises BenchError."""
    from canopen_exo.bus.interfaces import same_bus

    if same_bus(controller, drive):
        raise BenchError(
            f"controller bus {controller} and drive bus {drive} are one bus: frames would go round for ever; name "
            "two buses"
        )


def _add_scenario(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "scenario", type=Path, nargs="?", metavar="SCENARIO.yaml", help="rig and faults (default: 500 Hz, no faults)"
    )
    _add_overrides(parser)


def _add_overrides(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", dest="overrides", help="as for run")


def _add_process(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--epoch", type=int, default=0, metavar="NS", help="CLOCK_MONOTONIC at time 0 of the rig")
    parser.add_argument("--part", type=Path, metavar="FILE", help="leave this process's part of the result there")
    parser.add_argument("--fifo", action="store_true", help="real-time scheduling (SCHED_FIFO), where permitted")
    parser.add_argument("--busy-poll", action="store_true", help="do not sleep between frames: takes a core of its own")
    _add_supervisor(parser)


def _add_supervisor(parser: argparse.ArgumentParser) -> None:
    """For processes of a supervised rig: who that is, and the rig's folder, which goes when he is gone."""
    parser.add_argument("--supervisor", type=int, default=0, help=argparse.SUPPRESS)
    parser.add_argument("--folder", type=Path, default=None, help=argparse.SUPPRESS)


def _joints(options: argparse.Namespace) -> int:
    """Six drives on their plant on the drive bus, until SIGTERM or Ctrl-C."""
    from testbench.process import joints_main

    def serve(how: "ProcessOptions") -> int:
        scenario = read_scenario(options)
        return USAGE if scenario is None else joints_main(scenario, _bus(options.bus, "drive"), how)

    return _served(serve, options)


def _hlc(options: argparse.Namespace) -> int:
    """The high-level controller on the controller bus: boots the drives, walks, disables them; exit 4 if it gave up."""
    from testbench.process import hlc_main

    def serve(how: "ProcessOptions") -> int:
        scenario = read_scenario(options)
        if scenario is None:
            return USAGE
        return hlc_main(scenario, _bus(options.bus, "controller"), how, options.endless)

    return _served(serve, options)


def _gateway(options: argparse.Namespace) -> int:
    """The gateway between two buses. The first Ctrl-C ends all faults, frames pass on; the second one ends it."""
    from testbench.gateway_process import GatewayOptions, control_frames, gateway_main

    def serve(how: "ProcessOptions") -> int:
        faults = _read_faults(options)
        if faults is None:
            return USAGE
        buses = (_bus(options.controller_bus, "controller"), _bus(options.drive_bus, "drive"))
        check_two(*buses)
        frames = control_frames(options.control_frames) if options.control_frames else None
        return gateway_main(faults, buses, how, GatewayOptions(not options.no_faults, options.control, frames))

    return _served(serve, options)


def _served(serve: Callable[["ProcessOptions"], int], options: argparse.Namespace) -> int:
    """Serve, and say what went wrong in one line."""
    from canopen_exo.errors import CanopenExoError
    from fi_gateway.errors import FaultError
    from testbench.process import ProcessOptions

    try:
        given = (options.epoch, options.part, options.fifo, options.supervisor, options.folder, options.busy_poll)
        return serve(ProcessOptions(*given))
    except (BenchError, CanopenExoError, FaultError) as error:
        tell(error)
        return USAGE


def _read_faults(options: argparse.Namespace) -> "FaultFile | None":
    """The faults in the file named, or none of them; None when the file is wrong, which is said."""
    from fi_gateway.marked_yaml import FileErrors
    from testbench.fault_file import faults_of, load_faults, no_faults

    try:
        if options.scenario is not None:
            faults = load_faults(options.scenario, options.overrides)
        elif options.overrides:
            scenario = read_scenario(options)
            return None if scenario is None else faults_of(scenario)
        else:
            faults = no_faults()
    except FileErrors as error:
        tell(error)
        return None
    for warning in [] if options.no_faults or options.supervisor else faults.warnings:
        tell(f"warning: {warning}")
    return faults


def read_scenario(options: argparse.Namespace) -> "Scenario | None":
    """The scenario named, or the default one; None when its file is wrong, which is said."""
    from fi_gateway.marked_yaml import FileErrors
    from testbench.scenario import load_scenario, parse_scenario

    try:
        if options.scenario is not None:
            return load_scenario(options.scenario, options.overrides)
        return parse_scenario(DEFAULT_SCENARIO, "default scenario", options.overrides)
    except FileErrors as error:
        tell(error)
        return None


def _bus(given: str | None, role: str) -> "BusName":
    """The bus given; else that of python-can's configuration, with its section; else the one on the default hub."""
    from canopen_exo.bus.interfaces import configured_bus, parse_bus

    if given is not None:
        return parse_bus(given)
    configured = configured_bus(role)
    return configured if configured is not None else parse_bus(f"hub:{role}")


def _hub(options: argparse.Namespace) -> int:
    """A CAN bus over TCP: everything that connects to the same name is on the same bus. Prints where it listens."""
    from canopen_exo.bus.hub import hub_main
    from testbench.process import die_with, remove_orphaned

    try:
        if options.supervisor:
            die_with(options.supervisor)
        bitrate = options.bitrate
        if bitrate is not None and not options.timed:
            raise BenchError(f"--bitrate {bitrate} is given without --timed: a fast hub has no bit time; add --timed")
        bitrate = HUB_BITRATE if bitrate is None else bitrate
        return hub_main(options.listen, options.timed, bitrate, _bus_maker(options))
    except BenchError as error:
        tell(f"hub: {error}")
        return USAGE
    finally:
        remove_orphaned(options.folder, options.supervisor)


def _bus_maker(options: argparse.Namespace) -> "MakeBus | None":
    """What makes the buses on which errors happen; None without --errors. Raises BenchError."""
    rate = options.bit_error_rate
    if (options.errors and not options.timed) or (rate is not None and not options.errors):
        raise BenchError("--errors needs --timed, and --bit-error-rate needs --errors")
    if rate is not None and not 0 < rate <= 1:
        raise BenchError(f"--bit-error-rate {rate:g} given, allowed above 0 up to 1 per bit")
    if not options.errors:
        return None
    from testbench.noisy_hub import bus_maker

    return bus_maker(rate, options.seed)


def _fault(options: argparse.Namespace) -> int:
    """List the injectors of a running gateway, or arm, disarm or trigger one.

    start: time 0 is now, for a controller that does not say it on the bus; stop: inject nothing until resume.
    """
    from fi_gateway.errors import FaultError
    from testbench.gateway_process import fault_main

    word, name = options.word, options.name
    if word in NAMED and not name:
        tell(f"fault {word}: which injector? `exo-hil fault list` names them")
        return USAGE
    if name and word not in NAMED:
        tell(f"fault {word}: {name!r} given, allowed is nothing: it is about the whole gateway")
        return USAGE
    try:
        return fault_main(options.word, options.name, options.at)
    except FaultError as error:
        tell(error)
        return USAGE


def _up(options: argparse.Namespace) -> int:
    """Start hub, joints, gateway and controller, walk until Ctrl-C, and stop them in order."""
    from testbench import fork_server

    fork_server.shared()  # it imports meanwhile

    from canopen_exo.errors import CanopenExoError
    from fi_gateway.errors import FaultError
    from fi_gateway.schema import refuse_wire_faults
    from testbench.child import ProcessError
    from testbench.gateway_process import check_control_frames
    from testbench.live import run_up
    from testbench.scenario import refuse_queues
    from testbench.supervisor import Setup

    scenario = read_scenario(options)
    if scenario is None:
        return USAGE
    try:
        refuse_queues(scenario, "exo-hil up")
        if not options.no_faults:
            refuse_wire_faults(scenario.injectors, "exo-hil up")
        check_control_frames(options.control_frames, options.without, is_judged=False)
        setup = Setup(
            scenario,
            named_buses(options),
            frozenset(options.without),
            faults=not options.no_faults,
            endless=True,
            fifo=options.fifo,
            listen=options.listen or HUB_ADDRESS,
            control=options.control or CONTROL_ADDRESS,
            control_frames=options.control_frames,
        )
        return run_up(setup)
    except ProcessError as error:
        tell(error)
        return INVALID
    except (BenchError, CanopenExoError, FaultError) as error:
        tell(error)
        return USAGE
