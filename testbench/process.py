"""One process of a rig against the clock: the joints, or the high-level controller; and what all of them share.

Each serves one Node on its interfaces until it is told to end, and then leaves its part of the result. All processes
of a rig share one epoch on CLOCK_MONOTONIC, so that the grids of SYNC and of physics agree as in lock-step.
SIGTERM, SIGINT and SIGHUP end a process in order. A supervised process ends by itself when its supervisor is gone.
The gateway (testbench.gateway_process) needs neither MuJoCo nor the controller: everything heavy is imported by the
process that needs it.
"""

import ctypes
import os
import select
import shutil
import signal
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Final, final

from canopen_exo.bus.channel import Channel
from canopen_exo.bus.interfaces import BusName, open_channel, parse_bus
from canopen_exo.bus.node import MS, NEVER, SECOND, Node
from canopen_exo.bus.realtime import RealTimeLoop
from canopen_exo.bus.scheduling import release_fifo, request_fifo
from canopen_exo.errors import CanopenExoError
from canopen_exo.talk import tell
from testbench.errors import BenchError, RefusedError

if TYPE_CHECKING:  # numpy, and with it everything heavy
    from hlc.node import HighLevelController
    from joint_emulators.rack import Rack
    from testbench.parts import Service
    from testbench.scenario import Scenario

DONE: Final = 0
INVALID: Final = 3
"""What went through proves nothing."""
ENDED_EARLY: Final = 4
"""The controller gave the motion up; its part says why. No code that a crash has: 1 is the interpreter's own."""

LEAVE_NS: Final = SECOND
"""Most that the controller may take to disable the drives once told to end."""

_READ_OUT_NS: Final = SECOND // 2
"""Most that a process may take at its end for what has come by then."""

_LOOK_NS: Final = 50 * MS
"""How often a supervised process looks whether its supervisor is there."""

_PR_SET_PDEATHSIG: Final = 1  # prctl(2)

_HANG_UP: Final = signal.SIGTERM if sys.platform == "win32" else signal.SIGHUP
"""The terminal, or on Linux the supervisor, is gone. Not SIGTERM, which a supervisor sends that goes on."""


@dataclass(frozen=True, slots=True)
class ProcessOptions:
    """How a process runs. epoch_ns: time 0 of the rig on CLOCK_MONOTONIC, 0 for now; part: where to leave its part.

    fifo: ask for real-time scheduling; supervisor: its process id, 0 for none; folder: of the rig, to be removed when
    the supervisor is gone; busy_poll: as `RealTimeLoop`.
    """

    epoch_ns: int = 0
    part: Path | None = None
    fifo: bool = False
    supervisor: int = 0
    folder: Path | None = None
    busy_poll: bool = False


@final
class Orders:
    """What signals have asked for so far."""

    def __init__(self) -> None:
        self.interrupts: int = 0
        self.terminations: int = 0
        self.is_hung_up: bool = False

    @property
    def count(self) -> int:
        """Of both kinds."""
        return self.interrupts + self.terminations

    def note(self, number: int, _frame: FrameType | None) -> None:
        """A signal handler."""
        if number == signal.SIGINT:
            self.interrupts += 1
        else:
            self.terminations += 1
            self.is_hung_up = self.is_hung_up or number == _HANG_UP

    @contextmanager
    def taken(self) -> Iterator["Orders"]:
        """SIGINT, SIGTERM and SIGHUP are noted here; the handlers before are put back at the end."""
        numbers = {signal.SIGINT, signal.SIGTERM, _HANG_UP}
        before = [(number, signal.signal(number, self.note)) for number in sorted(numbers)]
        try:
            yield self
        finally:
            for number, handler in before:
                signal.signal(number, handler)


@final
class Session:
    """A node on its interfaces. start_ns, end_ns: loop time from which and until which it is served.

    has_fifo: real-time scheduling was granted, for as long as it is served.
    """

    def __init__(
        self,
        name: str,
        node: Node,
        channels: list[Channel],
        ports: list[int],
        options: ProcessOptions,
        orders: Orders,
        has_fifo: bool,
    ) -> None:
        self.name: Final[str] = name
        self.orders: Final[Orders] = orders
        self.loop: Final[RealTimeLoop] = RealTimeLoop(
            node,
            channels,
            ports,
            options.epoch_ns or time.monotonic_ns(),
            record=options.part is not None,
            measure_latency=name == "gateway",
            busy_poll=options.busy_poll,
        )
        self.start_ns: Final[int] = (self.loop.now() // MS + 1) * MS
        self.end_ns: int = self.start_ns
        self._channels: Final[list[Channel]] = channels
        self._supervisor: Final[int] = options.supervisor
        self._has_fifo: Final[bool] = has_fifo
        self._look_at: int = 0
        self._told: Final[set[str]] = set()

    def run(self, until: Callable[[int], bool]) -> None:
        """Serve until `until(now)`, or until the supervisor is gone; say what is lost when it first happens."""

        def over(now: int) -> bool:
            if now >= self._look_at:
                self._look_at = now + _LOOK_NS
                self._warn()
                if self._supervisor and os.getppid() != self._supervisor:
                    return True
            return until(now)

        self.loop.run(over)
        if self.loop.trace is not None:
            self._read_out()
        self.end_ns = self.loop.now()
        if self._has_fifo:
            release_fifo()  # what comes now, writing the part, is not to hold up the others
        self._warn()

    def _read_out(self) -> None:
        """Serve what has come already: a process that was held up would leave frames unread, and they count as lost."""
        limit = self.loop.now() + _READ_OUT_NS
        readers = [fd for fd in (channel.fileno() for channel in self._channels) if fd >= 0]
        while readers and select.select(readers, [], [], 0)[0] and self.loop.now() < limit:
            self.loop.poll()

    def losses(self) -> dict[str, int]:
        """What was lost so far, in words -> frames; empty when nothing was."""
        found: dict[str, int] = {}
        for channel, lost in zip(self._channels, self.loop.losses_by_channel(), strict=True):
            for count, what in (
                (lost.queue_full, f"dropped for {channel.name}, the transmit queue was full"),
                (lost.discarded, f"discarded, {channel.name} was off"),
                (lost.overruns, f"dropped by {channel.name} before they were read"),
                (lost.not_taken, f"not taken by {channel.name}"),
            ):
                if count:
                    found[what] = count
        return found

    def _counts(self) -> dict[str, int]:
        """What was lost, and what could not be read, in words -> frames."""
        found = self.losses()
        for channel in self._channels:
            if channel.malformed:
                found[f"unreadable from {channel.name}"] = channel.malformed
        return found

    def _warn(self) -> None:
        """The first time each kind of loss shows."""
        for what, count in self._counts().items():
            if what not in self._told:
                self._told.add(what)
                say(self.name, f"warning: {count} frames {what}; counted from now on, told at the end")

    def sum_up(self) -> None:
        """Say what was lost, at the end."""
        for what, count in self._counts().items():
            say(self.name, f"{count} frames {what}")

    def service(self) -> "Service":
        """How it was served, for its part."""
        from testbench.parts import Service

        return Service(self.start_ns, self.end_ns, self.loop.lateness, self.losses())


@contextmanager
def session(
    name: str, node: Node, buses: list[BusName], ports: list[int], options: ProcessOptions
) -> Iterator[Session]:
    """A node with its interfaces open. Raises BenchError when one cannot be opened; says what it could not get."""
    orders = Orders()
    channels: list[Channel] = []
    try:
        with orders.taken():
            if options.supervisor:
                die_with(options.supervisor)
            refusal = request_fifo() if options.fifo else None
            if refusal is not None:
                say(name, refusal)
            for bus in buses:
                channels.append(open_bus(bus))
            yield Session(name, node, channels, ports, options, orders, options.fifo and refusal is None)
    finally:
        for channel in channels:
            channel.close()
        remove_orphaned(options.folder, options.supervisor, orders.is_hung_up)


def joints_main(scenario: "Scenario", bus: BusName, options: ProcessOptions) -> int:
    """Six drives on their plant, until told to end."""
    from joint_emulators.plant import rest_stopwatch
    from testbench.rig import build_mechanics, build_rack
    from testbench.run import rig_params

    rest_stopwatch()
    params = rig_params(scenario)
    rack = build_rack(params, build_mechanics(params))
    with session("joints", rack, [bus], [0] * len(rack.devices), options) as process:
        rack.step_at = rack.wake_at = process.start_ns
        say("joints", f"{len(rack.devices)} drives on {bus}")

        def over(now: int) -> bool:
            if options.part is None:
                rack.truth.clear()
            return process.orders.count > 0

        process.run(over)
        if options.part is not None:
            _leave_joints(options.part, process, rack)
        process.sum_up()
    return DONE


def hlc_main(scenario: "Scenario", bus: BusName, options: ProcessOptions, endless: bool) -> int:
    """The high-level controller: one motion, or with `endless` until told to end. ENDED_EARLY when it gave up."""
    from hlc.node import Phase
    from testbench.rig import build_master, build_mechanics
    from testbench.run import motion_over, rig_params

    params = rig_params(scenario)
    master, controller = build_master(params, build_mechanics(params), NEVER if endless else -1)
    duration_ns = 0 if endless else params.duration_ns
    with session("hlc", master, [bus], [0], options) as process:
        master.wake_at = master.supervise_at = process.start_ns
        say("hlc", f"controller on {bus}")
        give_up_at = NEVER

        def over(now: int) -> bool:
            nonlocal give_up_at
            if options.part is None:
                controller.samples.clear()
            phase = controller.phase
            if process.orders.count == 0:
                return motion_over(controller, duration_ns, now)
            controller.leave = True
            give_up_at = min(give_up_at, now + LEAVE_NS)
            is_left = phase in (Phase.WAITING, Phase.STOPPED, Phase.FAILED)
            return is_left or now >= give_up_at or process.orders.count > 1

        process.run(over)
        if options.part is not None:
            _leave_hlc(options.part, process, controller)
        process.sum_up()
        asked = process.orders.count > 0
    for event in controller.events:
        say("hlc", f"{event.joint or 'rig'}: {event.text}")
    return DONE if controller.completed or asked else ENDED_EARLY


def _leave_joints(path: Path, process: Session, rack: "Rack") -> None:
    import numpy as np

    from testbench.parts import JointsPart, write_joints

    count = len(rack.devices)
    q, dq, tau = (
        np.array([getattr(row, name) for row in rack.truth], np.float64).reshape(-1, count)
        for name in ("q", "dq", "tau")
    )
    times = np.array([row.time_ns for row in rack.truth], np.int64)
    write_joints(path, JointsPart(process.service(), times, q, dq, tau, process.loop.trace or []))


def _leave_hlc(path: Path, process: Session, controller: "HighLevelController") -> None:
    import numpy as np

    from testbench.parts import HlcPart, NotedEvent, write_hlc

    count, samples = len(controller.plan.joints), controller.samples
    q_d, dq_d, tau = (
        np.array([getattr(sample, name) for sample in samples], np.float64).reshape(-1, count)
        for name in ("q_d", "dq_d", "tau_command")
    )
    part = HlcPart(
        process.service(),
        controller.time_zero,
        controller.completed,
        list(controller.late),
        [NotedEvent(event.time_ns, event.joint, event.kind, event.text) for event in controller.events],
        np.array([sample.cycle for sample in samples], np.int64),
        q_d,
        dq_d,
        tau,
        process.loop.trace or [],
    )
    write_hlc(path, part)


def open_bus(bus: BusName | str) -> Channel:
    """The interface of that name; raises RefusedError with one line that says what is missing."""
    try:
        return open_channel(parse_bus(bus) if isinstance(bus, str) else bus)
    except CanopenExoError as error:
        raise RefusedError(str(error)) from error


def die_with(supervisor: int) -> None:
    """Have SIGHUP sent to this process when its supervisor ends (Linux); elsewhere it only looks for it regularly."""
    if sys.platform == "linux":
        ctypes.CDLL(None, use_errno=True).prctl(_PR_SET_PDEATHSIG, _HANG_UP, 0, 0, 0)
    if os.getppid() != supervisor:
        raise BenchError(f"the supervisor (process {supervisor}) is gone; start this process by itself or with `up`")


def remove_orphaned(folder: Path | None, supervisor: int, is_hung_up: bool = False) -> None:
    """Remove the folder of a rig whose supervisor was killed; the last of its processes to end leaves nothing.

    is_hung_up: the kernel has told, which it does when the supervisor's main thread is gone: its others may linger, and
    keep its process id in getppid().
    """
    if folder is not None and supervisor and (is_hung_up or os.getppid() != supervisor):
        shutil.rmtree(folder, ignore_errors=True)


def say(name: str, text: str) -> None:
    """One line of talk, to stderr."""
    tell(f"{name}: {text}")
