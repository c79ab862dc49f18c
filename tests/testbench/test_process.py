"""Processes of a rig: their command line, what they say when they cannot run, how they take signals.

Real processes against the clock are in test_supervisor.py and test_realtime.py. One module, although long: each
verb is held to the same rules.
"""

import argparse
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, ClassVar

import can.util
import pytest
from can.interfaces.virtual import VirtualBus

from canopen_exo.bus.channel import Arrival, Channel
from canopen_exo.bus.frame import Frame
from canopen_exo.bus.interfaces import BusName, parse_bus
from canopen_exo.bus.node import MS, NEVER, SECOND, ErrorState, Node, PortState
from fi_gateway.control import NAMED, WORDS
from fi_gateway.control_address import DEFAULT_ADDRESS
from fi_gateway.gateway import CONTROLLER_PORT, DRIVE_PORT
from testbench import cli_rig, gateway_process, process, supervisor
from testbench.cli import main
from testbench.errors import BenchError
from testbench.fault_file import faults_of
from testbench.gateway_process import ControlFrames, GatewayOptions, control_frames, gateway_main
from testbench.parts import read_gateway, read_hlc, read_joints
from testbench.process import ENDED_EARLY, Orders, ProcessOptions, die_with, hlc_main, joints_main, session
from testbench.scenario import Scenario, parse_scenario


@pytest.fixture
def scenario() -> Scenario:
    return parse_scenario(cli_rig.DEFAULT_SCENARIO)


class DeadChannel(Channel):
    """An interface on which nothing comes but what is there already, and that takes everything; nothing to wait on."""

    there_already: ClassVar[list[Arrival]] = []

    def __init__(self, name: str) -> None:
        super().__init__(name)
        self.poll_at = 0
        self.sent: list[Frame] = []
        self.closed = False

    def fileno(self) -> int:
        return -1

    def receive(self) -> list[Arrival]:
        first = self.poll_at == 0
        self.poll_at = NEVER
        return self.there_already if first else []

    def send(self, frame: Frame) -> bool:
        self.sent.append(frame)
        return True

    def close(self) -> None:
        self.closed = True


@pytest.fixture
def channels(monkeypatch: pytest.MonkeyPatch) -> list[DeadChannel]:
    """Every interface that is opened is one of these."""
    opened: list[DeadChannel] = []

    def open_dead(bus: BusName) -> Channel:
        opened.append(DeadChannel(str(bus)))
        return opened[-1]

    monkeypatch.setattr(process, "open_bus", open_dead)
    return opened


@pytest.fixture
def signalled(monkeypatch: pytest.MonkeyPatch) -> Iterator[list[int]]:
    """Signals that each process finds as soon as it begins, in place of somebody who sends them."""
    numbers: list[int] = []
    before = Orders.__init__

    def begin(orders: Orders) -> None:
        before(orders)
        for number in numbers:
            orders.note(number, None)

    monkeypatch.setattr(Orders, "__init__", begin)
    return iter([numbers])


# --- told to end -----------------------------------------------------------------------------------------------------


def test_joints_told_to_end_leave_their_part(
    scenario: Scenario, channels: list[DeadChannel], signalled: Iterator[list[int]], tmp_path: Path
) -> None:
    """SIGTERM ends a process in order, part and all, and its interface is closed."""
    next(signalled).append(signal.SIGTERM)
    part = tmp_path / "joints.npz"
    assert joints_main(scenario, parse_bus("hub:drive"), ProcessOptions(part=part)) == 0
    assert read_joints(part).q.shape[1] == 6
    assert [(channel.name, channel.closed) for channel in channels] == [("hub:drive", True)]


def test_controller_told_to_end_before_it_began_leaves_at_once(
    scenario: Scenario, channels: list[DeadChannel], signalled: Iterator[list[int]], tmp_path: Path
) -> None:
    """Asked for, so no failure: exit 0."""
    next(signalled).append(signal.SIGTERM)
    part = tmp_path / "hlc.npz"
    assert hlc_main(scenario, parse_bus("hub:controller"), ProcessOptions(part=part), endless=True) == 0
    assert not read_hlc(part).completed


@pytest.mark.long
def test_controller_without_drives_gives_up_and_says_why(
    scenario: Scenario, channels: list[DeadChannel], tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    """Its own exit code, which no crash has: no boot-up message within 1 s; nothing hangs."""
    part = tmp_path / "hlc.npz"
    assert hlc_main(scenario, parse_bus("hub:controller"), ProcessOptions(part=part), endless=False) == ENDED_EARLY
    (event,) = read_hlc(part).events
    assert "no boot-up message" in event.text
    assert event.text in capfd.readouterr().err
    assert channels[0].sent[0] == Frame(0x77F, b"\x00")


@pytest.mark.long
def test_frame_that_is_there_before_the_controller_begins_does_not_keep_it_from_beginning(
    scenario: Scenario, channels: list[DeadChannel], monkeypatch: pytest.MonkeyPatch
) -> None:
    """A bus is never silent when a process joins it: here the late answer to somebody's SDO request."""
    answer = Arrival(0, Frame(0x581, bytes.fromhex("4300100092010200")), None)
    monkeypatch.setattr(DeadChannel, "there_already", [answer])
    assert hlc_main(scenario, parse_bus("hub:controller"), ProcessOptions(), endless=False) == ENDED_EARLY
    assert Frame(0x77F, b"\x00") in channels[0].sent  # and gave up for want of drives


def test_gateway_first_stops_injecting_and_ends_with_the_second_interrupt(
    scenario: Scenario, channels: list[DeadChannel], signalled: Iterator[list[int]], tmp_path: Path
) -> None:
    """SIGINT first stops injecting, then passes frames until told again; live control has a row of it."""
    next(signalled).extend([signal.SIGINT, signal.SIGINT])
    part = tmp_path / "gateway.npz"
    options = ProcessOptions(part=part)
    buses = (parse_bus("virtual:controller"), parse_bus("virtual:drive"))
    assert gateway_main(faults_of(scenario), buses, options, GatewayOptions()) == 0
    (row,) = read_gateway(part).controls
    assert (row.what, row.name, row.source, row.refused) == ("stop", "", "signal", "")
    assert [channel.name for channel in channels] == ["virtual:controller", "virtual:drive"]


class FullChannel(DeadChannel):
    """Like an interface in whose buffer frames wait, of which one is read at a time."""

    def __init__(self, name: str) -> None:
        super().__init__(name)
        self.unread = [Frame(0x181, bytes((number,))) for number in range(3)] if name.endswith("drive") else []
        self._ours, self._theirs = socket.socketpair()
        self._theirs.send(bytes(len(self.unread)))

    def fileno(self) -> int:
        return self._ours.fileno()

    def receive(self) -> list[Arrival]:
        self.poll_at = NEVER
        if not self.unread:
            return []
        self._ours.recv(1)
        return [Arrival(0, self.unread.pop(0), None)]

    def close(self) -> None:
        super().close()
        self._ours.close()
        self._theirs.close()


def test_what_has_come_before_the_end_is_served(
    scenario: Scenario, monkeypatch: pytest.MonkeyPatch, signalled: Iterator[list[int]], tmp_path: Path
) -> None:
    """A gateway that was held up when it is told to end loses nothing of what came before."""
    opened: list[FullChannel] = []

    def open_full(bus: BusName) -> Channel:
        opened.append(FullChannel(str(bus)))
        return opened[-1]

    monkeypatch.setattr(process, "open_bus", open_full)
    next(signalled).append(signal.SIGTERM)
    part = tmp_path / "gateway.npz"
    buses = (parse_bus("virtual:controller"), parse_bus("virtual:drive"))
    assert gateway_main(faults_of(scenario), buses, ProcessOptions(part=part), GatewayOptions()) == 0
    assert [frame.data for frame in opened[0].sent] == [b"\0", b"\1", b"\2"]
    assert len(read_gateway(part).rows) == 6


@pytest.mark.parametrize("address", ["127.0.0.1:TAKEN", "/no/such/folder/control"])
def test_gateway_that_cannot_listen_is_told_in_one_line(
    channels: list[DeadChannel], address: str, capsys: pytest.CaptureFixture[str]
) -> None:
    """Exit 2: a second rig at the default address, a folder that is not there; no defect of the program."""
    with socket.create_server(("127.0.0.1", 0)) as taken:
        address = address.replace("TAKEN", str(taken.getsockname()[1]))
        assert main(["gateway", "--control", address]) == 2
    said = capsys.readouterr().err
    assert said.startswith(f"live control: cannot listen at {address}: ")
    assert len(said.strip().splitlines()) == 1
    assert [channel.closed for channel in channels] == [True, True]


FAULTS = """\
injectors:
  silence:
    target: {bus: to_controller, cob_id: 0x185}
    fault: {type: drop}
    event: {type: at, time: 1 s}
    effect: {type: infinite}
"""


def test_gateway_needs_no_more_than_injectors_and_says_what_it_does(
    channels: list[DeadChannel], signalled: Iterator[list[int]], tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    """On real buses nothing is simulated: no motion, no plant; what it stands between, and at its end what passed."""
    next(signalled).extend([signal.SIGINT, signal.SIGINT])
    (tmp_path / "faults.yaml").write_text(FAULTS)
    assert main(["gateway", str(tmp_path / "faults.yaml"), "--controller-bus", "hub:a", "--drive-bus", "hub:b"]) == 0
    assert capfd.readouterr().err.splitlines() == [
        "gateway: between hub:a (controller) and hub:b (drives); injectors: silence",
        "gateway: injection is stopped, frames pass on; nothing resumes it without --control, Ctrl-C ends",
        "gateway: to_drives: 0 frames, 0 lost by faults",
        "gateway: to_controller: 0 frames, 0 lost by faults",
    ]


PER_SYNC = """\
injectors:
  rare:
    target: {bus: to_controller, cob_id: 0x185}
    fault: {type: drop}
    event: {type: failure_probability, p: 0.001, per: sync}
    effect: {type: once}
"""


@pytest.mark.parametrize(
    ("faults", "cycle_ms", "status", "code"),
    [(PER_SYNC, 10, False, 3), (PER_SYNC, 2, True, 0), (FAULTS, 10, True, 3), (FAULTS, 10, False, 0)],
)
def test_gateway_whose_faults_count_by_another_rate_than_the_controllers_says_so(
    channels: list[DeadChannel],
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
    capfd: pytest.CaptureFixture[str],
    faults: str,
    cycle_ms: int,
    status: bool,
    code: int,
) -> None:
    """Processes told different `rig.rate`: a clear error and exit 3, where a fault hangs on the length of a cycle.

    It does with `per: sync`, and with our controller, whose status frames count cycles.
    """
    syncs = [Arrival(at * cycle_ms * MS, Frame(0x080, b""), None) for at in range(200)]
    syncs.insert(1, Arrival(0, Frame(0x2FF, bytes((2, 0, 0, 0, 0)) if status else b""), None))

    def receive(channel: DeadChannel) -> list[Arrival]:
        if channel.name == "hub:a":
            signal.raise_signal(signal.SIGTERM)
            return syncs
        channel.poll_at = NEVER
        return []

    monkeypatch.setattr(DeadChannel, "receive", receive)
    (tmp_path / "faults.yaml").write_text(faults)
    begun = time.monotonic_ns() - 10 * SECOND
    arguments = ["gateway", str(tmp_path / "faults.yaml"), "--controller-bus", "hub:a", "--drive-bus", "hub:b"]
    assert main([*arguments, "--epoch", str(begun)]) == code
    errors = [line for line in capfd.readouterr().err.splitlines() if "error" in line]
    said = "gateway: error: SYNC comes every 10.00 ms, rig.rate here says 2 ms (500 Hz); give all processes of a rig"
    assert errors == ([f"{said} the same rig.rate"] if code else [])


def test_signal_handlers_of_the_caller_are_put_back() -> None:
    """A library call leaves the process as it was."""
    before = signal.getsignal(signal.SIGTERM)
    with Orders().taken() as orders:
        signal.raise_signal(signal.SIGTERM)
        signal.raise_signal(signal.SIGINT)
        assert (orders.terminations, orders.interrupts, orders.count) == (1, 1, 2)
    assert signal.getsignal(signal.SIGTERM) is before


@pytest.mark.skipif(sys.platform == "win32", reason="has no such signal")
@pytest.mark.parametrize(("number", "stays"), [(signal.SIGTERM, True), (signal.SIGHUP, False)])
def test_folder_of_the_rig_goes_when_the_supervisor_is_gone_and_not_when_it_tells_to_end(
    channels: list[DeadChannel], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, number: signal.Signals, stays: bool
) -> None:
    """The kernel tells with SIGHUP, a supervisor with SIGTERM; it still needs the parts that are in there."""
    monkeypatch.setattr(process, "die_with", lambda supervisor: None)
    folder = tmp_path / "rig"
    folder.mkdir()
    (folder / "scenario.yaml").touch()
    options = ProcessOptions(supervisor=os.getppid(), folder=folder)  # which is there, as far as anyone can see
    with session("joints", Node(), [parse_bus("hub:drive")], [0], options) as served:
        signal.raise_signal(number)
        served.run(lambda now: served.orders.count > 0)
    assert folder.exists() == stays


def test_process_whose_supervisor_is_gone_does_not_start(monkeypatch: pytest.MonkeyPatch) -> None:
    """Nothing is left over when the supervisor dies between start and now."""
    monkeypatch.setattr(sys, "platform", "other")  # pytest itself is not to end with its parent
    with pytest.raises(BenchError, match=r"supervisor .* is gone"):
        die_with(2**22 + 1)


def test_process_ends_when_its_supervisor_is_gone(
    channels: list[DeadChannel], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Where the kernel does not tell, the process looks by itself."""
    monkeypatch.setattr(process, "die_with", lambda supervisor: None)
    with session("joints", Node(), [parse_bus("hub:drive")], [0], ProcessOptions(supervisor=2**22 + 1)) as served:
        served.run(lambda now: False)


def test_nodes_begin_on_the_next_whole_millisecond(channels: list[DeadChannel]) -> None:
    """All processes share one epoch, so that the grids of physics and SYNC agree."""
    with session("joints", Node(), [parse_bus("hub:drive")], [0], ProcessOptions(epoch_ns=1)) as served:
        assert served.start_ns % MS == 0
        assert 0 < served.start_ns - served.loop.now() + MS <= 2 * MS or served.start_ns <= served.loop.now()
        assert served.loop.epoch_ns == 1


# --- what is lost ----------------------------------------------------------------------------------------------------


def test_each_kind_of_loss_is_told_when_it_first_shows_and_left_in_the_part(
    channels: list[DeadChannel], capsys: pytest.CaptureFixture[str]
) -> None:
    """A process without a part has nobody else to tell it to; a flood of losses is no flood of lines."""
    with session("joints", Node(), [parse_bus("virtual:drive")], [0], ProcessOptions()) as served:
        (channel,) = channels
        channel.overruns = 2
        served.run(lambda now: True)
        channel.overruns, channel.lost, channel.malformed = 5, 3, 1
        served.run(lambda now: True)
        served.run(lambda now: True)
        assert served.losses() == {"dropped by virtual:drive before they were read": 5, "not taken by virtual:drive": 3}
        assert served.service().losses == served.losses()
    told = [line for line in capsys.readouterr().err.splitlines() if "warning" in line]
    assert [line.partition("; ")[0] for line in told] == [
        "joints: warning: 2 frames dropped by virtual:drive before they were read",
        "joints: warning: 3 frames not taken by virtual:drive",
        "joints: warning: 1 frames unreadable from virtual:drive",
    ]


def test_gateway_says_by_direction_what_was_lost_and_when_an_interface_was_off(
    scenario: Scenario,
    channels: list[DeadChannel],
    signalled: Iterator[list[int]],
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """At its end, also without a part: losses on the way in and on the way out, changes with their time."""
    next(signalled).append(signal.SIGTERM)
    state = PortState(0, ErrorState.BUS_OFF, 0, 0, "bus-off")
    monkeypatch.setattr(DeadChannel, "there_already", [Arrival(-1_500_000_000, None, state)])
    monkeypatch.setattr(DeadChannel, "__init__", dead_with_losses(DeadChannel.__init__))
    buses = (parse_bus("virtual:controller"), parse_bus("virtual:drive"))

    def serve_once(
        served: process.Session, control: object, server: object, can_resume: bool, additions: object
    ) -> bool:
        turns = iter((False, True))
        served.run(lambda now: next(turns))
        return True

    monkeypatch.setattr(gateway_process, "_serve", serve_once)
    assert gateway_main(faults_of(scenario), buses, ProcessOptions(), GatewayOptions()) == 0
    said = capsys.readouterr().err.splitlines()
    lost = "0 lost by faults, 2 lost before they were read, 1 unreadable, 3 not taken by the interface, 1 error notice"
    assert f"gateway: to_drives: 0 frames, {lost}" in said
    assert f"gateway: to_controller: 0 frames, {lost}" in said
    assert "gateway: controller side: bus off at -1.500 s: bus-off" in said
    assert "gateway: drive side: bus off at -1.500 s: bus-off" in said


@pytest.mark.parametrize("name", ["joints", "hlc"])
def test_drives_and_controller_say_at_their_end_what_was_lost(
    name: str,
    scenario: Scenario,
    channels: list[DeadChannel],
    signalled: Iterator[list[int]],
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """As the warning promises when the first frame of a kind is lost, whether a part is left or not."""
    next(signalled).append(signal.SIGTERM)
    monkeypatch.setattr(DeadChannel, "__init__", dead_with_losses(DeadChannel.__init__))
    bus = parse_bus("virtual:x")
    if name == "joints":
        joints_main(scenario, bus, ProcessOptions())
    else:
        hlc_main(scenario, bus, ProcessOptions(), endless=False)
    assert [line for line in capsys.readouterr().err.splitlines() if "frames" in line and "warning" not in line] == [
        f"{name}: 2 frames dropped by virtual:x before they were read",
        f"{name}: 3 frames not taken by virtual:x",
        f"{name}: 1 frames unreadable from virtual:x",
    ]


def dead_with_losses(begin: Callable[[DeadChannel, str], None]) -> Callable[[DeadChannel, str], None]:
    """A channel that has lost frames already."""

    def begin_so(channel: DeadChannel, name: str) -> None:
        begin(channel, name)
        channel.overruns, channel.lost, channel.malformed = 2, 3, 1

    return begin_so


# --- two buses, and one gateway between them -------------------------------------------------------------------------


@pytest.mark.skipif(sys.platform != "linux", reason="needs abstract Unix sockets")
def test_a_second_gateway_between_the_same_buses_is_refused(
    scenario: Scenario, channels: list[DeadChannel], signalled: Iterator[list[int]]
) -> None:
    """With two, every frame would go round for ever; whichever way round and however the buses are written."""
    next(signalled).append(signal.SIGTERM)
    one, other = (parse_bus(f"hub:127.0.0.1:1/{name}{os.getpid()}") for name in "ab")
    again = parse_bus(f"hub:127.0.0.1:1/b{os.getpid()}@500000")
    third = parse_bus(f"hub:127.0.0.1:1/c{os.getpid()}")
    options, given = ProcessOptions(), GatewayOptions()
    with gateway_process.claimed((one, other)):
        with pytest.raises(BenchError, match=r"another one stands between .* already"):
            gateway_main(faults_of(scenario), (again, one), options, given)
        assert channels == []  # before any interface was opened
        assert gateway_main(faults_of(scenario), (other, third), options, given) == 0  # a chain of gateways
    assert gateway_main(faults_of(scenario), (again, one), options, given) == 0


@pytest.mark.parametrize(
    ("controller", "drive"),
    [
        ("hub:drive", "hub:127.0.0.1:29536/drive"),
        ("hub:0.0.0.0:29536/drive", "hub:drive"),
        ("socketcan:can0", "socketcan:can0@500000"),
        ("pcan:PCAN_USBBUS1@1000000", "pcan:PCAN_USBBUS1@500000"),
    ],
)
def test_one_bus_under_two_names_is_refused(
    controller: str,
    drive: str,
    capsys: pytest.CaptureFixture[str],
    channels: list[DeadChannel],
    signalled: Iterator[list[int]],
) -> None:
    """Between a bus and itself every frame would go round for ever: by `gateway`, and by `up` and `run --realtime`."""
    next(signalled).append(signal.SIGTERM)
    complaint = f"controller bus {controller} and drive bus {drive} are one bus"
    assert main(["gateway", "--controller-bus", controller, "--drive-bus", drive]) == cli_rig.USAGE
    assert complaint in capsys.readouterr().err
    assert channels == []
    with pytest.raises(BenchError, match=complaint):
        cli_rig.named_buses(argparse.Namespace(controller_bus=controller, drive_bus=drive))


@pytest.mark.parametrize("verb", ["joints", "hlc", "gateway"])
def test_section_of_can_conf_reaches_the_interface(
    verb: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path, signalled: Iterator[list[int]]
) -> None:
    """What else an adapter needs (here: FD) stands in the section of its bus; the name alone would lose it."""
    for key in list(os.environ):
        if key.startswith("CAN_"):
            monkeypatch.delenv(key)
    path = tmp_path / "can.conf"
    sections = [f"[{role}]\ninterface = virtual\nchannel = {role}\nfd = True\n" for role in ("controller", "drive")]
    path.write_text("[default]\n" + "".join(sections))
    monkeypatch.setattr(can.util, "CONFIG_FILES", [str(path)])
    next(signalled).append(signal.SIGTERM)
    opened: list[tuple[str, bool]] = []
    begin = VirtualBus.__init__

    def note(bus: VirtualBus, channel: str, **given: Any) -> None:
        opened.append((channel, given.get("fd", False)))
        begin(bus, channel=channel, **given)

    monkeypatch.setattr(VirtualBus, "__init__", note)
    assert main([verb]) == 0
    expected = {"joints": ["drive"], "hlc": ["controller"], "gateway": ["controller", "drive"]}[verb]
    assert opened == [(role, True) for role in expected]


# --- command line ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["run", "x.yaml", "--without", "hlc"], "--realtime"),
        (["up", "--controller-bus", "hub:a"], "--drive-bus"),
        (["up", "--drive-bus", "hub:a"], "--controller-bus"),
        (["up", "--controller-bus", "hub:a", "--drive-bus", "hub:a"], "round for ever"),
        (["gateway", "--controller-bus", "hub:a", "--drive-bus", "hub:a"], "round for ever"),
        (["gateway", "--control-frames", "middle"], "controller or drive"),
        (["gateway", "--control-frames", "drive:1,0x900"], "allowed 0x1..0x7ff"),
        (["up", "--control-frames", "middle"], "controller or drive"),
        (["up", "--control-frames", "drive", "--without", "gateway"], "our gateway reads them, and it is left out"),
        (["run", "x.yaml", "--control-frames", "drive"], "--control-frames: is of real time; add --realtime"),
        (["run", "x.yaml", "--realtime", "--control-frames", "drive:0x123,0x124"], "allowed in a run that is judged"),
        (["gateway", "missing.yaml"], "missing.yaml"),
        (["fault", "trigger"], "which injector?"),
        (["fault", "list", "x"], "'x' given, allowed is nothing"),
        (["joints", "--bus", "nonsense"], "INTERFACE:CHANNEL"),
        (["hlc", "--bus", "hub:127.0.0.1:1/x"], "exo-hil hub"),
        (["joints", "--set", "rig.rate=3 Hz"], "allowed: 500, 250"),
        (["hlc", "missing.yaml"], "missing.yaml"),
        (["fault", "list", "--at", "127.0.0.1:1"], "is a gateway running"),
    ],
)
def test_wrong_command_line_is_told_in_one_line(
    arguments: list[str],
    words: str,
    capsys: pytest.CaptureFixture[str],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Exit 2 for usage; what is wrong, and what to do. Without SocketCAN rights: one line saying what to run."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "x.yaml").write_text(cli_rig.DEFAULT_SCENARIO)
    assert main(arguments) == 2
    said = capsys.readouterr().err
    assert words in said
    assert len(said.strip().splitlines()) == 1


@pytest.mark.parametrize(
    ("text", "wanted"),
    [
        ("controller", ControlFrames(CONTROLLER_PORT)),
        ("drive", ControlFrames(DRIVE_PORT)),
        ("drive:0x6C2,1731", ControlFrames(DRIVE_PORT, 0x6C2, 0x6C3)),
    ],
)
def test_control_frames_are_named_by_side_and_ids(text: str, wanted: ControlFrames) -> None:
    """Off by default, COB-IDs configurable."""
    assert control_frames(text) == wanted


@pytest.mark.parametrize("text", ["", "drive:", "drive:1", "drive:1,2,3", "drive:a,b", "1"])
def test_wrong_control_frames_are_refused(text: str) -> None:
    """With the form that is allowed."""
    with pytest.raises(BenchError, match="drive:0x6C0,0x6C1"):
        control_frames(text)


def test_command_line_has_the_words_and_the_address_of_live_control() -> None:
    """They are written again in the command line, so that its help imports nothing."""
    assert cli_rig.NAMED == NAMED
    assert set(cli_rig.NAMED + cli_rig.UNNAMED) == set(WORDS)
    assert cli_rig.CONTROL_ADDRESS == DEFAULT_ADDRESS
    assert cli_rig.PARTS == supervisor.PARTS


@pytest.mark.long
def test_gateway_and_hub_need_neither_mujoco_nor_the_controller() -> None:
    """Design: `exo-hil gateway` and `exo-hil hub` work without the extra `sim`."""
    code = (
        "import sys\n"
        "import testbench.gateway_process, testbench.cli_rig, canopen_exo.bus.hub\n"
        "from testbench.parts import write_gateway\n"
        "from testbench.scenario import parse_scenario\n"
        "parse_scenario(testbench.cli_rig.DEFAULT_SCENARIO)\n"
        "sys.exit(' '.join({'mujoco', 'pyarrow', 'matplotlib', 'hlc.node', 'can'} & set(sys.modules)) or 0)\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")
