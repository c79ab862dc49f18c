"""A rig of processes: started in order, ended in order, and what happens when one of them is killed.

At 100 Hz on the hub. Nothing here hangs on how fast the machine is: the time-outs of the drives are judged on the clock
of their own plant, and everything else by what was heard.
"""

import os
import re
import signal
import socket
import struct
import subprocess
import sys
from pathlib import Path

import can
import canopen
import pytest

from canopen_exo.bus.node import SECOND
from canopen_exo.cia402 import DriveState
from fi_gateway.bus_control import DEFAULT_COMMAND_ID, DEFAULT_STATUS_ID, Command, Status, read_status
from fi_gateway.bus_control import DONE as DONE_OVER_BUS
from testbench import fork_server, supervisor
from testbench.child import Process, ProcessError
from testbench.cli import INVALID, USAGE, main
from testbench.errors import BenchError
from testbench.fork_server import ForkServer
from testbench.process import DONE, ENDED_EARLY, LEAVE_NS
from testbench.scenario import JOINT_NAMES, Scenario
from testbench.supervisor import Setup, Supervisor
from tests.parity.patience import Late, Patience, gave_up_late
from tests.parity.rigs import LONG_NS, check_killed, descendants_of, ended, heard, nothing_left, walk
from tests.parity.walks import Bench

pytestmark = pytest.mark.realtime

HUB = Bench(None, 100)
TEXT = HUB.text()


@pytest.fixture(scope="module")
def scenario() -> Scenario:
    return HUB.scenario()


# --- ended in order --------------------------------------------------------------------------------------------------


def test_rig_told_to_end_leaves_the_drives_disabled(scenario: Scenario, patience: Patience) -> None:
    """Ctrl-C stops everything cleanly: controller first, so that it can disable the drives."""

    def attempt() -> set[DriveState | None] | Late:
        with nothing_left(Supervisor(Setup(scenario, endless=True))) as rig:
            rig.start()
            assert list(rig.processes) == ["hub", "joints", "gateway", "hlc"]
            late = walk(rig)
            if late is not None:
                return late
            assert set(rig.watch.states.values()) == {DriveState.OPERATION_ENABLED}
            told_ns = rig.now()
            rig.stop()
            assert {name: process.code for name, process in rig.processes.items()} == dict.fromkeys(rig.processes, 0)
            states = set(rig.watch.states.values())
            if states != {DriveState.SWITCH_ON_DISABLED} and rig.now() > told_ns + LEAVE_NS:
                words = rig.watch.sync_words()
                return Late(f"the controller did not get the drives disabled in {LEAVE_NS / 1e9:g} s; {words}")
            return states

    assert patience.until_punctual(attempt) == {DriveState.SWITCH_ON_DISABLED}


linux = pytest.mark.skipif(sys.platform != "linux", reason="looks at /proc, and has the kernel tell")


@linux
@pytest.mark.parametrize(
    ("number", "code"), [(signal.SIGINT, 0), (signal.SIGTERM, 0), (signal.SIGKILL, -signal.SIGKILL)]
)
def test_up_ends_with_all_its_processes(tmp_path: Path, number: signal.Signals, code: int, patience: Patience) -> None:
    """Ctrl-C and SIGTERM are the normal end of `up`; and when it is killed itself, its processes end all the same."""
    (tmp_path / "rig.yaml").write_text(TEXT)
    assert patience.until_punctual(lambda: attempt_up(tmp_path, number)) == code
    assert sorted(path.name for path in tmp_path.iterdir()) == ["rig.yaml"]  # neither control socket nor folder


def attempt_up(folder: Path, number: signal.Signals) -> int | Late:
    """Start `up`, send it a signal when it runs, see all its processes end; its exit code."""
    control = "127.0.0.1:0" if number is signal.SIGINT else str(folder / "control")
    arguments = ["up", "rig.yaml", "--listen", "127.0.0.1:0", "--control", control]
    up = subprocess.Popen(
        [sys.executable, "-m", "testbench.cli", *arguments],
        cwd=folder,
        env={**os.environ, "TMPDIR": str(folder)},
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    try:
        assert up.stderr is not None
        said: list[str] = []
        for line in up.stderr:
            said.append(line)
            if line.startswith("running"):
                break
        children = descendants_of(up.pid)
        up.send_signal(number)
        said += up.stderr.readlines()  # until the last process that may write there has gone
        code = up.wait(LONG_NS / SECOND)
        assert all(ended(pid, LONG_NS / SECOND) for pid in children)
    finally:
        up.kill()
        up.wait()
        assert up.stderr is not None
        up.stderr.close()
    if code == INVALID:  # drives that missed SYNC for five cycles have stopped by themselves before they were told
        assert gave_up_late("".join(said)), said
        return Late("".join(said)[-600:])
    assert len(children) == (5 if sys.platform == "linux" else 4), said  # one forks the others
    assert any(re.match(r"controller bus: hub:127\.0\.0\.1:\d+/controller", line) for line in said)
    where = control.replace(":0", r":[1-9]\d*")  # the port that was free
    assert any(re.match(rf"live control: exo-hil fault list --at {where}$", line) for line in said)
    return code


# --- killed ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["hlc", "gateway", "joints", "hub"])
def test_killed_process_is_named_and_the_others_react_and_end(name: str, patience: Patience) -> None:
    """kill -9 of any one process while walking: drives stop by themselves, the others report it; nothing is left."""
    check_killed(HUB, name, patience)


@linux
def test_process_that_hangs_is_killed_and_named_and_the_others_end_in_order(
    scenario: Scenario, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A stopped process does not hear SIGTERM: it is waited for as long as any other, and no longer."""
    monkeypatch.setattr(supervisor, "END_NS", 3 * SECOND)
    told: list[str] = []
    with nothing_left(Supervisor(Setup(scenario), announce=told.append)) as rig:
        rig.start(["joints", "gateway"])
        os.kill(rig.processes["gateway"].pid, signal.SIGSTOP)
        rig.stop()
        codes = {name: process.code for name, process in rig.processes.items()}
    assert told == ["gateway did not end in 3 s and was killed"]
    assert codes == {"hub": 0, "joints": 0, "gateway": -signal.SIGKILL}


def test_interrupt_after_a_death_does_not_hide_it(scenario: Scenario, patience: Patience) -> None:
    """A rig that stands still is when people press Ctrl-C."""
    rigs: list[Supervisor] = []

    def interrupt(now: int) -> None:
        for rig in rigs:
            if rig.processes["joints"].is_told:
                rig.orders.note(signal.SIGINT, None)

    def attempt() -> str | Late:
        with nothing_left(Supervisor(Setup(scenario), tick=interrupt)) as rig:
            rig.start()
            late = walk(rig)
            if late is not None:
                return late
            rigs.append(rig)
            os.kill(rig.processes["joints"].pid, signal.SIGKILL)
            with pytest.raises(ProcessError) as raised:
                rig.run(lambda now: False)
            assert rig.orders.count > 0
            return str(raised.value)

    assert patience.until_punctual(attempt).startswith("joints was killed by SIGKILL")


@pytest.mark.skipif(sys.platform != "linux", reason="processes are forked on Linux alone")
def test_killed_process_that_forks_ends_the_rig_and_is_named(scenario: Scenario, patience: Patience) -> None:
    """Those that it has forked hear of it from the kernel; the next rig has another one."""

    def attempt() -> str | Late:
        with nothing_left(Supervisor(Setup(scenario))) as rig:
            rig.start()
            forks = fork_server.shared()
            assert forks is not None
            late = walk(rig)
            if late is not None:
                return late
            os.kill(forks.pid, signal.SIGKILL)
            with pytest.raises(ProcessError) as raised:
                rig.run(lambda now: False)
            return str(raised.value)

    said = patience.until_punctual(attempt).splitlines()
    assert re.fullmatch(
        r"testbench\.fork_server \(process \d+\) was killed by SIGKILL, and joints, gateway and controller end with it",
        said[0],
    )


@pytest.mark.parametrize("how", ["no server", "no process"])
def test_processes_are_started_from_nothing_where_they_cannot_be_forked(
    scenario: Scenario, monkeypatch: pytest.MonkeyPatch, how: str
) -> None:
    """On other systems than Linux; without pidfd_open(2), or when there are too many processes."""
    if how == "no server":
        monkeypatch.setattr(fork_server, "shared", lambda: None)
    else:
        monkeypatch.setattr(ForkServer, "fork", lambda *_: None)
    with nothing_left(Supervisor(Setup(scenario))) as rig:
        rig.start()
        words = [Path(f"/proc/{process.pid}/cmdline").read_bytes().split(b"\0") for process in rig.processes.values()]
        assert all(b"testbench.cli" in one for one in words)
        rig.stop()
        assert {process.code for process in rig.processes.values()} <= {DONE, ENDED_EARLY}  # the machine may be busy


# --- not started -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("code", "is_crash"), [(DONE, False), (ENDED_EARLY, False), (1, True), (2, True), (3, True)])
def test_controller_that_crashes_is_not_one_that_gave_up(
    scenario: Scenario, monkeypatch: pytest.MonkeyPatch, code: int, is_crash: bool
) -> None:
    """1 is what the interpreter itself ends with, 2 and 3 what our programs say of files and runs."""
    monkeypatch.setattr(Supervisor, "_start_joints", lambda self: None)
    monkeypatch.setattr(Supervisor, "_start_gateway", lambda self: None)
    program = f"import sys; sys.exit({code})"
    ended = subprocess.Popen([sys.executable, "-c", program], stdout=subprocess.PIPE, stderr=subprocess.STDOUT)
    ended.wait()

    def start(rig: Supervisor) -> None:
        rig.processes["hlc"] = Process("hlc", ended, lambda line: None)

    monkeypatch.setattr(Supervisor, "_start_hlc", start)
    with Supervisor(Setup(scenario)) as rig:
        rig.start()
        if is_crash:
            with pytest.raises(ProcessError, match=f"hlc ended with exit code {code}"):
                rig.run(lambda now: True)
        else:
            rig.run(lambda now: rig.processes["hlc"].code is not None)


def test_part_that_is_never_heard_is_named(scenario: Scenario, monkeypatch: pytest.MonkeyPatch) -> None:
    """Readiness by CAN traffic: a gateway that does not pass frames is not ready, whoever it is."""
    with nothing_left(Supervisor(Setup(scenario, without=frozenset({"gateway"})))) as rig:
        ask = rig.watch.ask

        def ask_in_vain(now: int, port: int) -> None:  # the joints had all the time they needed
            monkeypatch.setattr(supervisor, "FOREIGN_READY_NS", SECOND)
            ask(now, port)

        monkeypatch.setattr(rig.watch, "ask", ask_in_vain)
        with pytest.raises(ProcessError) as raised:
            rig.start()
        assert list(rig.processes) == ["hub", "joints"]
    told = str(raised.value)
    assert told.startswith("gateway: not ready after 1 s: no SDO answer came through to the controller bus hub:")
    assert told.endswith(f"from {', '.join(JOINT_NAMES)}")


def test_hub_that_cannot_listen_is_told_with_its_last_words(scenario: Scenario) -> None:
    """Which one, why, its last lines; no process has failed, the place given is taken."""
    with nothing_left(Supervisor(Setup(scenario))) as rig:
        rig.start([])
        address = rig.buses[0].removeprefix("hub:").partition("/")[0]
        with Supervisor(Setup(scenario, listen=address)) as second:
            with pytest.raises(BenchError) as raised:
                second.start()
            assert not isinstance(raised.value, ProcessError)
            assert list(second.processes) == ["hub"]
    assert "hub ended with exit code 2; its last lines:" in str(raised.value)
    assert "stop what runs there" in str(raised.value)


@pytest.mark.parametrize("verb", [["up"], ["run", "--realtime"], ["campaign", "run", "--realtime"]], ids=" ".join)
@pytest.mark.parametrize("option", ["--listen", "--control"])
def test_an_address_in_use_is_refused_like_any_wrong_argument(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str], verb: list[str], option: str
) -> None:
    """Exit code 2, the reason once, and nothing that looks like the result of a run."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "rig.yaml").write_text(TEXT)
    (tmp_path / "campaign.yaml").write_text("name: many\nscenario: rig.yaml\nruns: 1\n")
    file = "campaign.yaml" if "campaign" in verb else "rig.yaml"
    with socket.create_server(("127.0.0.1", 0)) as taken:
        address = f"127.0.0.1:{taken.getsockname()[1]}"
        assert main([*verb, file, option, address]) == USAGE
    out, err = capfd.readouterr()
    assert out == ""
    assert err.count(f"cannot listen {'on' if option == '--listen' else 'at'} {address}: ") == 1
    assert err.count("stop what runs there") == 1
    assert err.count("ended with exit code 2") == 1
    assert "invalid" not in err


def test_a_bus_that_cannot_be_opened_is_no_invalid_run(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    """Nobody listens at port 1: exit code 2, one line."""
    (tmp_path / "rig.yaml").write_text(TEXT)
    buses = ["--controller-bus", "hub:127.0.0.1:1/controller", "--drive-bus", "hub:127.0.0.1:1/drive"]
    for verb in (["up"], ["run", "--realtime", "--out", str(tmp_path / "result")]):
        assert main([*verb, str(tmp_path / "rig.yaml"), *buses]) == USAGE
        (line,) = capfd.readouterr().err.splitlines()
        assert line.startswith("hub 127.0.0.1:1/controller: Connection refused; start one with ")


@linux
def test_control_socket_of_a_killed_gateway_is_removed(scenario: Scenario, tmp_path: Path) -> None:
    """At a path that was given too; nothing of a rig is left."""
    path = tmp_path / "control"
    with nothing_left(Supervisor(Setup(scenario, control=str(path)))) as rig:
        rig.start(["joints", "gateway"])
        gateway = rig.processes["gateway"]
        limit = rig.now() + LONG_NS
        while not path.exists() and rig.now() < limit:
            rig.poll()
        gateway.tell(signal.SIGKILL)
        gateway.wait(LONG_NS / SECOND)
        assert path.exists()
    assert list(tmp_path.iterdir()) == []


def test_bus_that_is_not_there_is_told_before_anything_starts(scenario: Scenario) -> None:
    """One line saying what to run."""
    with Supervisor(Setup(scenario, ("hub:127.0.0.1:1/a", "hub:127.0.0.1:1/b"))) as rig:
        with pytest.raises(BenchError, match="exo-hil hub"):
            rig.start()
        assert rig.processes == {}


# --- live control over the bus ---------------------------------------------------------------------------------------


def test_gateway_of_a_rig_takes_commands_over_the_bus() -> None:
    """docs/live_control.md: `--control-frames` of `up` and `run --realtime` reaches the gateway of the rig."""
    with nothing_left(Supervisor(Setup(HUB.scenario("bias"), control_frames="controller"))) as rig:
        rig.start(["joints", "gateway"])
        with can.Bus(rig.buses[0].removeprefix("hub:"), "hub") as tester:
            command = Command(7, 0, 1).frame(DEFAULT_COMMAND_ID)  # a question
            tester.send(can.Message(arbitration_id=command.can_id, data=command.data, is_extended_id=False))
            tester.set_filters([{"can_id": DEFAULT_STATUS_ID, "can_mask": 0x7FF, "extended": False}])
            answer = tester.recv(LONG_NS / SECOND)
    assert answer is not None
    assert read_status(bytes(answer.data)) == Status(DONE_OVER_BUS, 0, 1, 0, "inert")


@pytest.mark.parametrize("verb", ["up", "run"])
def test_command_line_hands_control_frames_to_the_rig(
    verb: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What is given becomes part of the Setup; no rig is started here."""
    (tmp_path / "rig.yaml").write_text(TEXT)
    asked: list[Setup] = []

    def refuse(setup: Setup, *given: object) -> int:
        asked.append(setup)
        raise BenchError("enough")

    monkeypatch.setattr("testbench.live.run_up", refuse)
    monkeypatch.setattr("testbench.realtime_run._run_pair", refuse)
    options = [] if verb == "up" else ["--realtime", "--out", str(tmp_path / "result")]
    main([verb, str(tmp_path / "rig.yaml"), "--control-frames", "drive:0x6C2,0x6C3", *options])
    assert [setup.control_frames for setup in asked] == ["drive:0x6C2,0x6C3"]


# --- foreign controller ----------------------------------------------------------------------------------------------


EDS = Path(__file__).resolve().parents[2] / "dbc" / "exo_joint.eds"
POSITION = struct.Struct("<i4x")
COMMAND = struct.Struct("<Hh")
FLEXED = 131072 * 10 // 360
"""10 deg in counts; a shank that hangs from a fixed waist needs less than the torque it gets to be there."""


def test_foreign_controller_enables_the_drives_moves_them_and_reads_positions(
    scenario: Scenario, patience: Patience
) -> None:
    """Any part may be foreign software: here the canopen package is the master instead of our controller."""

    def attempt() -> Late | None:
        with nothing_left(Supervisor(Setup(scenario, without=frozenset({"hlc"})))) as rig:
            rig.start()
            assert list(rig.processes) == ["hub", "joints", "gateway"]
            return move_the_knee(rig)

    patience.until_punctual(attempt)


def move_the_knee(rig: Supervisor) -> Late | None:
    """Boot, enable, flex, disable. Late when drives stopped by themselves: the master was too slow."""
    booted: set[int] = set()
    positions: list[int] = []
    network = canopen.Network()
    network.connect(interface="hub", channel=rig.buses[0].removeprefix("hub:"))
    commands: list[canopen.network.PeriodicMessageTask] = []
    try:
        for node_id in range(1, 7):
            network.subscribe(0x700 + node_id, lambda can_id, data, stamp: booted.add(can_id))
        network.subscribe(0x185, lambda can_id, data, stamp: positions.append(POSITION.unpack(data)[0]))
        network.nmt.send_command(0x82)  # reset communication
        assert heard(rig, lambda: len(booted) == 6) is None
        for node_id in range(1, 7):
            node = canopen.RemoteNode(node_id, str(EDS))
            network.add_node(node)
            node.sdo.RESPONSE_TIMEOUT = LONG_NS / SECOND
            node.sdo[0x1019].raw = 0  # the SYNC of canopen has no counter
            node.sdo[0x6060].raw = 10  # cyclic synchronous torque
            commands.append(network.send_periodic(0x200 + node_id, COMMAND.pack(0x06, 0), 0.01))
        network.nmt.send_command(0x01)
        network.sync.start(0.01)
        for word, state in ((0x06, DriveState.READY_TO_SWITCH_ON), (0x0F, DriveState.OPERATION_ENABLED)):
            for command in commands:
                command.update(COMMAND.pack(word, 0))
            late = heard(rig, lambda: set(rig.watch.states.values()) == {state})  # noqa: B023
            if late is not None:
                return late
        hanging = positions[-1]
        commands[4].update(COMMAND.pack(0x0F, -150))  # right knee: 15 % of rated torque, 8.2 N m flexion
        late = heard(rig, lambda: positions[-1] < hanging - FLEXED)
        if late is not None:
            return late
        for command in commands:
            command.update(COMMAND.pack(0x00, 0))
        return heard(rig, lambda: set(rig.watch.states.values()) == {DriveState.SWITCH_ON_DISABLED})
    finally:
        network.sync.stop()  # type: ignore[no-untyped-call]
        for command in commands:
            command.stop()  # type: ignore[no-untyped-call]
        network.disconnect()
