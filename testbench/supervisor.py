"""All processes of a rig: started in order, watched, and stopped in order.

Hub (when no interface is named), joints, gateway, high-level controller. Each is ready when it is heard on CAN
(testbench.watch); the hub, which is no CAN node, when it prints the address it listens on. One that ends unasked ends
the rig: the others get the time their configured time-outs need to react by themselves, then all are stopped.
On Linux the kernel ends the processes when the supervisor is killed, elsewhere they look for it themselves (the hub
does not); they then also remove the rig's folder.
Left out: starting a part again; a drive that came back would have to be configured and enabled anew.
"""

import contextlib
import os
import signal
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Final, final

from canopen_exo.bus.channel import Channel
from canopen_exo.bus.medium import Transmission
from canopen_exo.bus.node import MS, NEVER, SECOND
from canopen_exo.bus.realtime import RealTimeLoop
from canopen_exo.emcy import error_words
from fi_gateway.control_address import is_path, remove_left
from fi_gateway.schema import status_watchers
from testbench import fork_server
from testbench.child import Process, ProcessError, Running, execute
from testbench.errors import BenchError, RefusedError
from testbench.process import DONE, ENDED_EARLY, Orders, open_bus
from testbench.scenario import Scenario
from testbench.watch import CONTROLLER_PORT, DRIVE_PORT, Watch, alarms_text

PARTS: Final = ("joints", "gateway", "hlc")
"""In the order in which they are started; any of them may be foreign software instead."""

READY_NS: Final = 30 * SECOND
"""Most that a process may take to be heard: it imports MuJoCo on a machine that may be busy."""

FOREIGN_READY_NS: Final = 60 * SECOND
"""The same for foreign software, which somebody may start by hand; an endless rig waits for it until told to end."""

REACT_NS: Final = SECOND
"""How long the others are left alone when one has died: longer than any time-out of drives and controller."""

END_NS: Final = 10 * SECOND
"""Most that a process may take to end in order, its part of the result included."""

SAYS_HUB: Final = "listening on "
SAYS_CONTROL: Final = "gateway: live control at "
"""How hub and gateway say where they listen."""

REFUSED: Final = 2
"""Exit code of a process that refuses what it was given: an address in use, a bus that is not there."""

_LOOK_NS: Final = 20 * MS

_GATHER_NS: Final = 2 * MS
"""How late the supervisor may hear what is on the buses, where frames come with their times; the rig needs the time."""


@dataclass(frozen=True, slots=True)
class Setup:
    """What to start. buses: names of controller and drive bus, None for an own hub; without: PARTS that are foreign.

    faults: with the scenario's injectors; endless: walk until stopped; keep_parts: have each process leave its part;
    record: keep `rows`; listen: HOST:PORT of an own hub, port 0 for a free one; control: address of the gateway's live
    control, "" for a Unix socket in the rig's folder (where there are such sockets); control_frames: as the option of
    `exo-hil gateway`, "" for none.
    """

    scenario: Scenario
    buses: tuple[str, str] | None = None
    without: frozenset[str] = frozenset()
    faults: bool = True
    endless: bool = False
    keep_parts: bool = False
    record: bool = False
    fifo: bool = False
    listen: str = "127.0.0.1:0"
    control: str = ""
    control_frames: str = ""


def check_status_readers(setup: Setup) -> None:
    """Injectors that hang on what our controller says, where it is foreign: raises BenchError."""
    if "hlc" in setup.without and "gateway" not in setup.without and setup.faults:
        for name in status_watchers(setup.scenario.injectors, setup.scenario.plan):
            raise BenchError(
                f"injectors.{name}: waits for what our controller says on the bus (gait_phase), and it is left "
                "out; take --without hlc away, or give another event"
            )


@final
class Supervisor:
    """A rig of processes; a context manager that leaves none behind.

    watch: the listener on both buses; processes: by name.
    say: told each line that a process prints, which its obituary then leaves out;
    tick: called with the loop's time at least every 50 ms;
    announce: told what foreign software is waited for, and where, and who had to be killed;
    hub: of another supervisor, watched and not ended.
    """

    def __init__(
        self,
        setup: Setup,
        say: Callable[[str], None] | None = None,
        tick: Callable[[int], None] = lambda now: None,
        announce: Callable[[str], None] = lambda text: None,
        hub: Process | None = None,
    ) -> None:
        self.setup: Final[Setup] = setup
        self.watch: Final[Watch] = Watch(setup.scenario.plan)
        self.processes: Final[dict[str, Process]] = {}
        self.orders: Final[Orders] = Orders()
        self._say: Final[Callable[[str], None] | None] = say
        self._tick: Final[Callable[[int], None]] = tick
        self._announce: Final[Callable[[str], None]] = announce
        self._borrowed: Final[list[Process]] = [] if hub is None else [hub]
        self._temporary: Final = tempfile.TemporaryDirectory(prefix="exo-hil-")
        self._epoch_ns: Final[int] = time.monotonic_ns()
        self._cleaning: Final = contextlib.ExitStack()
        self._channels: Final[list[Channel]] = []
        self._loop: RealTimeLoop | None = None
        self._hub_address: str = ""
        self._look_at: int = 0
        self._told: int = 0
        self._known: Final[set[tuple[str, int]]] = set()
        self._is_started: bool = False
        self._forks: fork_server.ForkServer | None = None

    def __enter__(self) -> "Supervisor":
        self._cleaning.enter_context(self._temporary)
        self._cleaning.enter_context(self.orders.taken())
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        try:
            self.stop()
        finally:
            for process in reversed(self.processes.values()):
                process.close()
            self._close_channels()
            self._remove_control()
            self._cleaning.close()

    # --- what a run does -----------------------------------------------------------------------------------------

    def start(self, parts: Sequence[str] = PARTS) -> None:
        """Start hub and parts, in order; those that are foreign are waited for all the same, except the controller.

        Raises ProcessError, RefusedError for a bus that cannot be opened or an address in use, KeyboardInterrupt when
        asked to end meanwhile.
        """
        setup = self.setup
        if set(parts) - setup.without:
            fork_server.shared()  # it imports meanwhile
        self._scenario_file.write_text(setup.scenario.resolved_yaml(), encoding="utf-8")
        if setup.buses is None and not self._hub_address:
            self.start_hub()
        for bus in self.buses:
            self._channels.append(open_bus(bus))
        record = setup.record or (setup.keep_parts and "gateway" in setup.without)
        self._loop = RealTimeLoop(
            self.watch, self._channels, [0, 1], self._epoch_ns, record=record, gather_ns=_GATHER_NS
        )
        starts = {"joints": self._start_joints, "gateway": self._start_gateway, "hlc": self._start_hlc}
        for name in PARTS:
            if name in parts:
                starts[name]()
        self._is_started = True

    def start_hub(self) -> None:
        """The hub alone, without listening on its buses; `start` does it where none are named. Raises as `start`."""
        bitrate = str(self.setup.scenario.plan.bitrate)
        hub = self._spawn("hub", ["--timed", "--listen", self.setup.listen, "--bitrate", bitrate])
        limit = self.now() + READY_NS
        while not self._hub_address:
            self._check_orders()
            self._idle(hub)
            self._hub_address = hub.said(SAYS_HUB)
            if not self._hub_address and (hub.code is not None or self.now() >= limit):
                why = f"the hub does not listen: {hub.obituary()}"
                raise RefusedError(why) if hub.code == REFUSED else ProcessError(why)

    def poll(self) -> None:
        """Hear what has come on the buses, without waiting."""
        assert self._loop is not None
        self._loop.poll()

    def run(self, until: Callable[[int], bool]) -> None:
        """Listen until `until(now)`. Raises ProcessError when a process ends unasked, KeyboardInterrupt."""
        dead = self._listen(until)
        if dead is not None:
            self._mourn(dead)

    def stop(self) -> None:
        """End all that runs in order: controller, gateway, joints, hub. One that does not in time is killed and named.

        A second interrupt kills.
        """
        before = self.orders.count
        for name in ("hlc", "gateway", "joints", "hub"):
            process = self.processes.get(name)
            if process is None or process.code is not None:
                continue
            if name == "hub":
                self._close_channels()
            process.tell(signal.SIGTERM)
            limit = self.now() + END_NS
            while process.code is None and self.now() < limit and self.orders.count <= before:
                self._idle(process)
            if process.code is None:
                why = "was not waited for" if self.orders.count > before else f"did not end in {END_NS / SECOND:g} s"
                self._announce(f"{name} {why} and was killed")
                if self._loop is not None:
                    self._loop.remove_reader(process)
                process.close()

    # --- what it knows -------------------------------------------------------------------------------------------

    @property
    def buses(self) -> tuple[str, str]:
        """Names of controller and drive bus."""
        if self.setup.buses is not None:
            return self.setup.buses
        return f"hub:{self._hub_address}/controller", f"hub:{self._hub_address}/drive"

    @property
    def control_address(self) -> str:
        """Of the gateway's live control; "" when there is none."""
        if "gateway" in self.setup.without:
            return ""
        gateway = self.processes.get("gateway")
        said = "" if gateway is None else gateway.said(SAYS_CONTROL)  # the port that was free, where 0 is asked for
        if said:
            return said
        if self.setup.control or os.name != "posix":
            return self.setup.control
        return str(Path(self._temporary.name) / "control")

    @property
    def rows(self) -> list[Transmission]:
        """What was heard on both buses, kept when asked for, and when parts are kept and the gateway is foreign."""
        return [] if self._loop is None or self._loop.trace is None else self._loop.trace

    @property
    def missed(self) -> int:
        """Frames that the supervisor itself did not hear, because it was not read from in time."""
        return 0 if self._loop is None else self._loop.losses()

    def now(self) -> int:
        """The rig's clock, ns."""
        return time.monotonic_ns() - self._epoch_ns

    def part(self, name: str) -> Path:
        """Where a process leaves its part."""
        return Path(self._temporary.name) / f"{name}.npz"

    # --- inside --------------------------------------------------------------------------------------------------

    def _start_joints(self) -> None:
        if "joints" in self.setup.without:
            self._announce(f"waiting for drives on {self.buses[1]}: they must answer SDO requests")
            self.watch.ask(self.now(), DRIVE_PORT)
        else:
            self._spawn("joints", ["--bus", self.buses[1], *self._common("joints")])
        self._await("joints", lambda: not self.watch.missing(DRIVE_PORT), self._missing_drives)

    def _start_gateway(self) -> None:
        controller_bus, drive_bus = self.buses
        if "gateway" not in self.setup.without:
            arguments = ["--controller-bus", controller_bus, "--drive-bus", drive_bus, *self._common("gateway")]
            if self.control_address:
                arguments += ["--control", self.control_address]
            if self.setup.control_frames:
                arguments += ["--control-frames", self.setup.control_frames]
            self._spawn("gateway", [*arguments, *([] if self.setup.faults else ["--no-faults"])])
        else:
            both = f"{controller_bus} and {drive_bus}"
            self._announce(f"waiting for a gateway between {both}: it must pass SDO requests and answers")
        self.watch.ask(self.now(), CONTROLLER_PORT)
        self._await("gateway", lambda: not self.watch.missing(CONTROLLER_PORT), self._missing_answers)

    def _start_hlc(self) -> None:
        if "hlc" not in self.setup.without:
            arguments = ["--bus", self.buses[0], *self._common("hlc")]
            self._spawn("hlc", [*arguments, *(["--endless"] if self.setup.endless else [])])
            self._await("hlc", lambda: self.watch.master_heard, lambda: "nothing of it was heard on the controller bus")
        else:
            start = f", or `exo-hil fault start --at {self.control_address}`" if self.control_address else ""
            zero = f"time 0 is its status frame (COB-ID 0x2FF){start}"
            self._announce(f"ready for a controller on {self.buses[0]}: {zero}")

    @property
    def _scenario_file(self) -> Path:
        return Path(self._temporary.name) / "scenario.yaml"

    def _common(self, name: str) -> list[str]:
        arguments = [str(self._scenario_file), "--epoch", str(self._epoch_ns)]
        if self.setup.keep_parts:
            arguments += ["--part", str(self.part(name))]
        return arguments + (["--fifo"] if self.setup.fifo else [])

    def _spawn(self, name: str, arguments: list[str]) -> Process:
        self._check_orders()
        process = Process(name, self._launch(name, arguments), self._say)
        self.processes[name] = process
        if self._loop is not None:
            self._loop.add_reader(process, lambda now: self._hear(process))
        return process

    def _launch(self, name: str, arguments: list[str]) -> Running:
        """Forked where that can be, but for the hub, which imports little and comes first.

        It is told who its parent is, and what to remove when that is gone.
        """
        given = [name, *arguments, "--folder", self._temporary.name, "--supervisor"]
        if name != "hub":
            forks = fork_server.shared()
            forked = None if forks is None else forks.fork([*given, str(forks.pid)], lambda: self._idle(None))
            if forked is not None:
                self._forks = forks
                return forked
        return execute([*given, str(os.getpid())])

    def _hear(self, process: Process) -> None:
        if not process.listen() and self._loop is not None:
            self._loop.remove_reader(process)

    def _await(self, name: str, is_ready: Callable[[], bool], missing: Callable[[], str]) -> None:
        """Listen until that part of the rig is heard."""
        is_foreign = name in self.setup.without
        patience = FOREIGN_READY_NS if is_foreign else READY_NS
        limit = NEVER if is_foreign and self.setup.endless else self.now() + patience
        self.run(lambda now: is_ready() or now >= limit)
        if not is_ready():
            said = f"; {self.processes[name].obituary()}" if name in self.processes else ""
            raise ProcessError(f"{name}: not ready after {patience / 1e9:g} s: {missing()}{said}")

    def _missing_drives(self) -> str:
        missing = ", ".join(self.watch.missing(DRIVE_PORT))
        return f"no boot-up and no SDO answer on the drive bus {self.buses[1]} from {missing}"

    def _missing_answers(self) -> str:
        missing = ", ".join(self.watch.missing(CONTROLLER_PORT))
        return f"no SDO answer came through to the controller bus {self.buses[0]} from {missing}"

    def _listen(self, until: Callable[[int], bool]) -> Process | None:
        """Run the loop; returns a process that ended unasked."""
        loop = self._loop
        assert loop is not None
        dead: Process | None = None

        def over(now: int) -> bool:
            nonlocal dead
            if now >= self._look_at:
                self._look_at = now + _LOOK_NS
                self._tick(now)
                self._tell_alarms()
                for process in (*self.processes.values(), *self._borrowed):
                    if self._is_dead(process):
                        dead = process
                        return True
                if self.orders.count:
                    return True
            return until(now)

        loop.run(over)
        if dead is None:
            self._check_orders()
        return dead

    def _tell_alarms(self) -> None:
        """Say what drives report to a foreign controller, each error of a drive once: ours says it itself."""
        alarms = self.watch.alarms
        for alarm in alarms[self._told :] if "hlc" in self.setup.without else ():
            if alarm.code and (alarm.joint, alarm.code) not in self._known:
                self._known.add((alarm.joint, alarm.code))
                self._announce(f"{alarm.joint}: {error_words(alarm.code)}")
        self._told = len(alarms)

    def _is_dead(self, process: Process) -> bool:
        """Whether it ended unasked; the controller may when its one motion is over."""
        code = process.code
        if process.is_told:
            return False
        if process.name != "hub" and self._forks is not None and self._forks.is_gone:
            return True  # in a moment
        if code is None:
            return False
        may_end = process.name == "hlc" and self._is_started and not self.setup.endless
        return not may_end or code not in (DONE, ENDED_EARLY)

    def _check_orders(self) -> None:
        """Raise KeyboardInterrupt when a signal asked to end."""
        if self.orders.count:
            raise KeyboardInterrupt

    def _mourn(self, dead: Process) -> None:
        """Let the others react, then raise what is known about the dead; one that refused its place is no defect."""
        dead.is_told = True
        alarms = len(self.watch.alarms)
        died_at = self.now()
        others = [process for process in self.processes.values() if process is not dead]
        for process in others:
            process.is_told = True
        with contextlib.suppress(KeyboardInterrupt):  # who died is told all the same
            self._listen(lambda now: now >= died_at + REACT_NS or all(process.code is not None for process in others))
        text = dead.obituary() if self._forks is None or not self._forks.is_gone else self._forks.obituary()
        told = alarms_text(self.watch.alarms[alarms:])
        if told:
            text += f"\nthe drives then reported: {told}"
        if dead.name == "hlc":  # the death of another one makes cycles late by itself
            ended_by, timing = self.watch.ended_by, self.watch.timing_words()
            text += f"\nthe motion ended because {ended_by}" if ended_by else ""
            text += f"\n{timing}" if timing else ""
        if dead.code == REFUSED and not self._is_started:
            raise RefusedError(text)
        raise ProcessError(text)

    def _idle(self, process: Process | None) -> None:
        """One short turn of waiting for a process, None for one to come: everything open is served meanwhile."""
        if process is None:
            self._check_orders()
        loop = self._loop
        if loop is not None and self._channels:
            limit = loop.now() + _LOOK_NS
            loop.run(lambda now: now >= limit or (process is not None and process.code is not None))
        elif process is None:
            time.sleep(_LOOK_NS / SECOND)
        else:
            process.listen()
            process.wait(_LOOK_NS / SECOND)

    def _remove_control(self) -> None:
        """A gateway that was killed leaves the socket of its live control; in the rig's folder it goes with that."""
        if "gateway" in self.processes and is_path(self.setup.control):
            remove_left(Path(self.setup.control))

    def _close_channels(self) -> None:
        for channel in self._channels:
            channel.close()
        self._channels.clear()
