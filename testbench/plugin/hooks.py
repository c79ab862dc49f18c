"""Entry point of the pytest plug-in `exo_hil`: options, markers, the fixture `exo`, failure reports, requirement ids.

It is loaded in every pytest run of an environment that has exo-hil, so it imports nothing but pytest until a test asks
for the fixture; without the extra `sim` only that test fails, saying so.
"""

import re
import warnings
from collections.abc import Generator, Iterator
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING, Final

import pytest

if TYPE_CHECKING:
    from testbench.plugin.exo import Exo
    from testbench.plugin.golden import Goldens
    from testbench.scenario import Scenario

LOCKSTEP: Final = "lockstep"
HUB: Final = "hub"
VCAN: Final = "vcan"
AUTO: Final = "auto"
_VCAN_BUSES: Final = ("socketcan:vcan0", "socketcan:vcan1")
PARTS: Final = ("joints", "gateway", "hlc")

MARKER_KEYS: Final = ("scenario", "rate", "stops", "seed", "overrides")

_BUS: Final = pytest.StashKey[str]()
"""Where the rigs of this session run: `--exo-bus`, or what `auto` stands for."""

_WHY: Final = pytest.StashKey[str]()
"""Why `auto` stands for that; "" for a bus that was named."""

_EXO: Final = pytest.StashKey["Exo"]()
_PLACES: Final = pytest.StashKey[pytest.TempPathFactory]()


class LateRigWarning(UserWarning):
    """A test whose rig was later than its scenario allows a real-time run to be."""


def pytest_addoption(parser: pytest.Parser) -> None:
    """`--exo-bus`, `--exo-scenario`, `--exo-set`, `--exo-without`, `--exo-fifo`, `--exo-control-frames`."""
    group = parser.getgroup("exo-hil", "exoskeleton rig under test (exo-hil)")
    group.addoption(
        "--exo-bus",
        default=LOCKSTEP,
        metavar="BUS",
        help="where the rig of the fixture `exo` runs: lockstep (virtual time, default), hub (processes on an emulated "
        "bus), vcan (socketcan:vcan0,vcan1), auto (vcan where it can be opened, else hub), or controller and drive bus "
        "such as socketcan:can0,socketcan:can1",
    )
    group.addoption(
        "--exo-scenario", metavar="FILE", help="scenario of tests whose marker names none (default: walking, no faults)"
    )
    group.addoption(
        "--exo-set",
        action="append",
        default=[],
        metavar="KEY=VALUE",
        help="change every scenario, on top of its marker, as in rig.rate=100Hz; may be repeated",
    )
    group.addoption(
        "--exo-without",
        action="append",
        default=[],
        choices=PARTS,
        metavar="PART",
        help="joints, gateway or hlc is foreign hardware or software on the named buses; may be repeated",
    )
    group.addoption(
        "--exo-fifo",
        action="store_true",
        help="against the clock: real-time scheduling (SCHED_FIFO) for the processes of the rig, where permitted",
    )
    group.addoption(
        "--exo-control-frames",
        default="",
        metavar="SIDE[:COMMAND,STATUS]",
        help="live control by frames on the controller or drive side of the gateway, as in drive:0x6C0,0x6C1",
    )


def pytest_configure(config: pytest.Config) -> None:
    """Register the markers; refuse a bus that is none."""
    config.addinivalue_line(
        "markers",
        "exo(scenario=FILE, rate='100 Hz', stops='on', seed=1, overrides=['key=value']): the rig of the fixture `exo`; "
        "a relative FILE is looked for beside the test",
    )
    config.addinivalue_line("markers", "requirement(id, ...): ids of the requirements that the test verifies")
    bus, why = config.getoption("--exo-bus"), ""
    if bus == AUTO:
        bus, why = best_bus(_workers(config))
    named_buses(bus)
    config.stash[_BUS] = bus
    config.stash[_WHY] = why


def pytest_report_header(config: pytest.Config) -> list[str]:
    """Where the rigs run, when that was chosen, and why there, when that was left to the plug-in."""
    bus, why = config.stash[_BUS], config.stash[_WHY]
    return [] if bus == LOCKSTEP else [f"exo-hil: bus {bus}{f' (auto: {why})' if why else ''}"]


def pytest_itemcollected(item: pytest.Item) -> None:
    """Requirement ids become properties of the test, in junit files too, whether it runs or not."""
    for marker in item.iter_markers("requirement"):
        if not marker.args or marker.kwargs or not all(isinstance(one, str) for one in marker.args):
            raise pytest.UsageError(f"{item.nodeid}: requirement: give one or more ids as texts: requirement('REQ-12')")
        for one in marker.args:
            if ("requirement", one) not in item.user_properties:
                item.user_properties.append(("requirement", one))


@pytest.fixture(scope="session")
def exo_goldens() -> "Goldens":
    """The golden runs of this session."""
    from testbench.plugin.golden import Goldens

    return Goldens()


@pytest.fixture
def exo(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Iterator["Exo"]:
    """A rig at power-up, for this test alone: see docs/pytest.md."""
    rig: Exo | None
    try:
        rig = _open(request)
    except ModuleNotFoundError as error:
        if error.name not in ("mujoco", "pyarrow", "matplotlib"):
            raise
        rig, missing = None, error.name
    if rig is None:
        pytest.fail(f"exo: {missing} is missing: pip install 'exo-hil[sim]'", pytrace=False)
    with rig:
        request.node.stash[_PLACES] = tmp_path_factory
        request.node.stash[_EXO] = rig
        yield rig
        if rig.lateness:
            warnings.warn(LateRigWarning(rig.lateness), stacklevel=1)


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(
    item: pytest.Item, call: pytest.CallInfo[None]
) -> Generator[None, pytest.TestReport, pytest.TestReport]:
    """A failed test shows the last frames of both buses and where the whole log is."""
    report = yield
    rig = item.stash.get(_EXO, None)
    if rig is not None and report.failed:
        del item.stash[_EXO]
        if call.excinfo is not None and _is_refused(call.excinfo.value):
            report.longrepr = call.excinfo.getrepr(style="value", chain=False)
        else:
            report.sections += _sections(item, rig)
    return report


def _is_refused(error: BaseException) -> bool:
    """Whether there is no rig, for a bus or an address that cannot be had: nothing but that line is of use then."""
    from testbench.errors import RefusedError

    return isinstance(error, RefusedError)


def named_buses(option: str) -> tuple[str, str] | None:
    """Controller and drive bus of `--exo-bus`; None for those that the plug-in makes itself. Raises UsageError."""
    if option in (LOCKSTEP, HUB):
        return None
    if option == VCAN:
        return _VCAN_BUSES
    from canopen_exo.bus.interfaces import parse_bus, same_bus
    from canopen_exo.errors import CanopenExoError

    names = option.split(",")
    if len(names) == 2 and ":" not in names[1]:
        names[1] = f"{names[0].partition(':')[0]}:{names[1]}"
    try:
        buses = [parse_bus(name) for name in names]
        if len(buses) != 2 or same_bus(buses[0], buses[1]):
            raise CanopenExoError("two different buses are needed, controller and drive bus")
    except CanopenExoError as error:
        raise pytest.UsageError(
            f"--exo-bus {option}: {error}; allowed: {LOCKSTEP}, {HUB}, {VCAN}, {AUTO}, or two buses such as "
            "socketcan:can0,can1"
        ) from error
    return str(buses[0]), str(buses[1])


def best_bus(workers: int) -> tuple[str, str]:
    """What `auto` stands for on this machine, and why. workers: processes that run tests side by side."""
    from canopen_exo.bus.interfaces import open_channel, parse_bus
    from canopen_exo.bus.node import ErrorState
    from canopen_exo.errors import CanopenExoError

    if workers > 1:
        return HUB, f"vcan holds one rig at a time, and {workers} processes run tests"
    try:
        for name in _VCAN_BUSES:
            with closing(open_channel(parse_bus(name))) as channel:
                for state in (arrival.state for arrival in channel.receive()):
                    if state is not None and state.state is ErrorState.DOWN:
                        return HUB, f"bus {name}: {state.cause}"
    except CanopenExoError as error:
        return HUB, str(error)
    return VCAN, "vcan0 and vcan1 can be opened"


def _workers(config: pytest.Config) -> int:
    """Of pytest-xdist, in one of them and in the process that started them."""
    started: int | None = config.getoption("numprocesses", None)
    return int(getattr(config, "workerinput", {}).get("workercount", started or 1))


def _open(request: pytest.FixtureRequest) -> "Exo":
    """The rig for one test; whatever is wrong with what was asked for fails it in one line."""
    from canopen_exo.errors import CanopenExoError
    from fi_gateway.errors import FaultError
    from testbench.errors import BenchError
    from testbench.gateway_process import check_control_frames

    config = request.config
    bus, without = config.stash[_BUS], frozenset(config.getoption("--exo-without"))
    goldens: Goldens = request.getfixturevalue("exo_goldens")
    try:
        scenario = _scenario(request.node, config)
        buses = named_buses(bus)
        if buses is not None and _workers(config) > 1:
            raise BenchError(f"--exo-bus {bus}: one rig at a time fits on it; run without -n, or with -n 1")
        if bus == HUB and without:
            raise BenchError(
                f"--exo-without {' '.join(sorted(without))}: nobody else knows where the hub of a test is; start "
                "`exo-hil hub --timed` and name its buses: --exo-bus hub:controller,drive"
            )
        frames: str = config.getoption("--exo-control-frames")
        check_control_frames(frames, without, is_judged=False)
        if bus == LOCKSTEP:
            from testbench.plugin.lockstep import open_lockstep

            return open_lockstep(scenario, goldens, without, frames)
        from testbench.plugin.realtime import RealTimeExo

        return RealTimeExo(scenario, bus, buses, without, goldens, config.getoption("--exo-fifo"), frames)
    except (BenchError, CanopenExoError, FaultError) as error:
        wrong = str(error)
    pytest.fail(f"exo: {wrong}", pytrace=False)  # out here, so that pytest does not show the same line as its cause


def _scenario(item: pytest.Item, config: pytest.Config) -> "Scenario":
    """What the marker, then the command line, then the default say. Raises BenchError, FileErrors."""
    from testbench.cli_rig import DEFAULT_SCENARIO
    from testbench.errors import BenchError
    from testbench.scenario import load_scenario, parse_scenario

    asked: dict[str, object] = {}
    for marker in item.iter_markers("exo"):  # the nearest one first
        unknown = sorted(set(marker.kwargs) - set(MARKER_KEYS))
        if marker.args or unknown:
            wrong = repr(unknown[0]) if unknown else f"{marker.args[0]!r} without a key"
            raise BenchError(f"marker exo: {wrong} given, allowed keys: {', '.join(MARKER_KEYS)}")
        asked = {**marker.kwargs, **asked}
    overrides = [
        f"{key}={_word(asked[name])}"
        for name, key in (("rate", "rig.rate"), ("stops", "rig.stops"), ("seed", "seed"))
        if name in asked
    ]
    more = asked.get("overrides", ())
    if isinstance(more, str) or not isinstance(more, list | tuple):
        raise BenchError(f"marker exo: overrides {more!r} given, allowed is a list such as ['motion.duration=3 s']")
    overrides += [*(str(one) for one in more), *config.getoption("--exo-set")]
    if "scenario" in asked:
        return load_scenario(item.path.parent / str(asked["scenario"]), overrides)
    given: str | None = config.getoption("--exo-scenario")
    if given is not None:
        return load_scenario(config.invocation_params.dir / given, overrides)
    return parse_scenario(DEFAULT_SCENARIO, "default scenario", overrides)


def _word(value: object) -> str:
    """As in a scenario file."""
    return {True: "on", False: "off"}[value] if isinstance(value, bool) else str(value)


def _sections(item: pytest.Item, rig: "Exo") -> list[tuple[str, str]]:
    """What a failure report says about the rig; a log that cannot be written is said, not raised."""
    from testbench.plugin.failure import describe

    name = re.sub(r"[^A-Za-z0-9_-]+", "_", item.name)[:40]
    try:
        folder: Path | None = item.stash[_PLACES].mktemp(f"exo_{name}")
    except OSError:
        folder = None
    sections, logs = describe(rig, folder)
    item.user_properties.extend(("exo_candump_log", str(path)) for path in logs)
    return sections
