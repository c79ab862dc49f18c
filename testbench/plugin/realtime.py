"""A rig against the clock: the processes of `exo-hil up` on an own hub or on named interfaces, the test beside them.

Frames are those the supervisor hears. Time goes on while the test computes; what came meanwhile is read with the next
call, and what the interface had no more room for is counted and said in the failure report; `expect_none` then fails,
for nobody knows what it missed. A test process that had no turn for a while judges the same frames as one that had:
those that ended within the time asked for, by the stamps of hub or kernel. `run_for` may end up to 50 ms late on a
silent bus, the others up to 150 ms.
A frame of `send` goes out on a connection of its own, as from one more node.
"""

import contextlib
from collections.abc import Callable
from dataclasses import replace
from typing import Final, final

from canopen_exo.bus.channel import Channel
from canopen_exo.bus.frame import Frame
from canopen_exo.bus.medium import Transmission
from canopen_exo.bus.node import MS, NEVER, SECOND
from fi_gateway.control import InjectorRow
from fi_gateway.control_socket import Answer, ask, ask_listing, ask_to_add
from fi_gateway.errors import FaultError
from fi_gateway.schema import refuse_wire_faults
from testbench.errors import BenchError
from testbench.merge import merge
from testbench.plugin.exo import Exo
from testbench.plugin.golden import Goldens
from testbench.plugin.injection import NOT_RUN, GatewayControl, Part
from testbench.process import open_bus
from testbench.record import Truth
from testbench.scenario import Scenario, refuse_queues
from testbench.supervisor import Setup, Supervisor

_WHAT: Final = "a rig of processes"

_GRACE_NS: Final = 100 * MS
"""How long after its limit a call waits for frames from before it, which a busy hub brings late; while a bus is silent
only, since a later frame of the same bus says that there will be none."""

_BROKEN_NS: Final = 100 * MS
"""Most that it takes until a process that has ended is found."""

_SENDING_NS: Final = SECOND
"""Most that a frame of the test may wait for its interface."""


@final
class RealTimeGateway(GatewayControl):
    """The gateway process of a real-time rig, by its live control. acted_ns: when it last did a word, rig's clock."""

    def __init__(self, scenario: Scenario) -> None:
        refuse_wire_faults(scenario.injectors, _WHAT)
        refuse_queues(scenario, _WHAT)
        super().__init__(scenario)
        self.acted_ns: int = 0
        self._address: str = ""

    def connect(self, rig: Supervisor) -> None:
        """The rig runs: from now on calls reach its gateway."""
        self._address = rig.control_address

    def listing(self) -> list[InjectorRow]:
        """As they are now; empty before the rig runs."""
        return ask_listing(self._address).injectors if self._address else []

    def command(self, word: str, name: str) -> None:
        """A word of live control. Raises FaultError."""
        if not self._address:
            raise FaultError(NOT_RUN.format(what=f"{word} {name}".strip()))
        self._note(ask(self._address, word, name))

    def _add(self, name: str, given: Part, at_once: bool) -> None:
        before = self.additions.specs
        self.additions.read(name, given)
        try:
            refuse_wire_faults(self.additions.specs, _WHAT)
        except FaultError:
            self.additions.specs = before
            raise
        if self._address:
            try:
                self._note(ask_to_add(self._address, name, given, at_once))
            except FaultError:
                self.additions.specs = before
                raise

    def _note(self, answer: Answer) -> None:
        """Processes of a rig share their clock."""
        time_ns = answer.get("time_ns")
        if isinstance(time_ns, int):
            self.acted_ns = time_ns


@final
class RealTimeExo(Exo):
    """A rig of processes. buses: of controller and drives, None for an own hub; the rest: as Setup."""

    def __init__(
        self,
        scenario: Scenario,
        bus: str,
        buses: tuple[str, str] | None,
        without: frozenset[str],
        goldens: Goldens,
        fifo: bool = False,
        control_frames: str = "",
    ) -> None:
        self._injectors: Final = RealTimeGateway(scenario)
        super().__init__(scenario, bus, self._injectors, goldens)
        self._setup: Final[Setup] = Setup(
            scenario, buses, without, record=True, fifo=fifo, control_frames=control_frames
        )
        self._stack: Final = contextlib.ExitStack()
        self._rig: Supervisor | None = None
        self._rows: list[Transmission] = []
        self._heard: int = 0
        self._sent_ns: int = 0
        self._waited_ns: int = 0  # when the last wait for frames ended
        self._seen: int = 0
        self._newest: Final[list[int]] = [0, 0]  # latest end of a frame among the rows seen, by bus [ns]
        self._senders: Final[dict[int, Channel]] = {}

    @property
    def time_ns(self) -> int:
        """Since the rig was started; 0 before."""
        return 0 if self._rig is None else self._rig.now()

    @property
    def rows(self) -> list[Transmission]:
        """What the supervisor heard."""
        return self._rows

    @property
    def missed(self) -> int:
        """Lost in the supervisor's queues, by the hub or the kernel."""
        return 0 if self._rig is None else self._rig.missed

    @property
    def timing(self) -> str:
        """Late cycles and frames that were not heard."""
        rig = self._rig
        if rig is None:
            return ""
        watch = rig.watch
        late = f"{watch.late} of {watch.cycles} cycles late"
        return f"timing: {late}, {watch.sync_words()}; {rig.missed} frames not heard"

    @property
    def lateness(self) -> str:
        """Beyond the limits of the scenario, as far as the supervisor hears it.

        Answers may also be late or missing because of a fault: cycles are judged where none has acted, SYNC always.
        """
        rig, limits = self._rig, self.scenario.realtime
        if rig is None:
            return ""
        watch = rig.watch
        is_late = watch.late > limits.late_share * watch.cycles and not self._has_acted()
        if not is_late and watch.offsets.worst_ns <= limits.late_worst_ns:
            return ""
        allowed = f"allowed {100 * limits.late_share:g} %, {limits.late_worst_ns / 1e6:g} ms"
        return f"the rig was late, {allowed}: {self.timing.removeprefix('timing: ')}"

    def close(self) -> None:
        """Stop all processes in order."""
        for channel in self._senders.values():
            channel.close()
        self._senders.clear()
        self._stack.close()

    def _has_acted(self) -> bool:
        """Whether a fault has, or may have."""
        try:
            return any(row.activated for row in self._injectors.listing())
        except FaultError:  # the gateway is gone
            return True

    def _start(self) -> None:
        if self._rig is None:
            scenario = replace(self.scenario, injectors=self._injectors.additions.specs)
            rig = Supervisor(replace(self._setup, scenario=scenario))
            self._stack.enter_context(rig)
            try:
                rig.start()
            finally:
                self._rows = rig.rows  # a start that failed is reported with what was heard
            self._rig = rig
            if "gateway" not in self._setup.without:
                self._injectors.connect(rig)
            self._listen()

    def _check(self) -> None:
        """The processes of a rig that breaks do not end in the same instant."""
        rig = self._started()
        limit = rig.now() + _BROKEN_NS
        rig.run(lambda now: now >= limit)

    def _started(self) -> Supervisor:
        self._start()
        assert self._rig is not None
        return self._rig

    def _advance(self, limit_ns: int, is_over: Callable[[], bool] | None, every_frame: bool = False) -> bool:
        rig = self._started()
        asked = None if every_frame else is_over  # a search looks at every row by itself
        found = False

        def look() -> bool:
            nonlocal found
            found = self._listen(limit_ns, asked) or (is_over is not None and is_over())
            return found

        rig.run(lambda now: look() or now >= limit_ns)
        if not found and is_over is not None:
            self._read_to(limit_ns, look)
        if not found:
            self._catch_up()
        self._waited_ns = rig.now()
        return found

    def _since(self, now: int) -> int:
        acted_ns = max(self._sent_ns, self._injectors.acted_ns)
        return min(now, acted_ns) if acted_ns >= self._waited_ns else now

    def _read_to(self, limit_ns: int, look: Callable[[], bool]) -> None:
        """Read what ended by the limit and has not come yet, until `look()` gives True."""
        rig = self._started()
        rig.poll()  # once at least, however long this process had no turn
        patience = rig.now() + _GRACE_NS
        rig.run(lambda now: look() or now >= patience or self._is_read_to(limit_ns + 1))

    def _catch_up(self) -> None:
        rig = self._rig
        if rig is None:
            return
        begin = rig.now()
        known = -1
        while known != len(self._rows) and not self._is_read_to(begin):
            known = len(self._rows)
            rig.poll()
        self._listen()

    def _is_read_to(self, time_ns: int) -> bool:
        """Whether a frame of both buses has come that ended then or later: no earlier one is still to come."""
        rows, newest = self._rows, self._newest
        while self._seen < len(rows):
            row = rows[self._seen]
            self._seen += 1
            newest[row.bus] = max(newest[row.bus], row.end_ns)
        return min(newest) >= time_ns

    def _listen(self, limit_ns: int = NEVER, is_over: Callable[[], bool] | None = None) -> bool:
        """Take in what was heard, up to the first frame later than the limit.

        `is_over` is asked every 1 ms of the frames' time, so that what was the case for a moment is not passed by when
        many are read at once; True, and the rest is left for later, as soon as it holds.
        """
        rows, observer = self._rows, self.observer
        asked_ns = rows[self._heard].end_ns if self._heard < len(rows) else 0
        while self._heard < len(rows):
            row = rows[self._heard]
            if row.end_ns > limit_ns:
                break
            if is_over is not None and row.end_ns >= asked_ns + MS:
                asked_ns = row.end_ns
                if is_over():
                    return True
            observer.hear(row)
            self._heard += 1
        return False

    def _send(self, bus: int, frame: Frame) -> None:
        rig = self._started()
        channel = self._senders.get(bus)
        if channel is None:
            channel = self._senders[bus] = open_bus(rig.buses[bus])
        channel.receive()  # nobody else reads from it
        self._sent_ns = rig.now()
        lost = channel.lost
        limit = rig.now() + _SENDING_NS
        if not channel.send(frame):
            rig.run(lambda now: channel.send(frame) or now >= limit)
        if channel.lost != lost or rig.now() >= limit:
            raise BenchError(f"send: {channel.name} does not take frame {frame}; is it up and connected?")

    def _truth(self) -> tuple[Truth, float]:
        """What the drives' frames say, up to the last whole cycle."""
        rows = self._rows
        latest_ns = rows[-1].end_ns - self.plan.cycle_ns - self.observer.time_zero_ns
        elapsed_ns = min(latest_ns, self.scenario.motion.duration_ns) // MS * MS
        if elapsed_ns <= 0:
            raise BenchError("deviation: the motion has only begun; let it run for two cycles at least")
        return merge(self.plan, elapsed_ns, None, None, None, rows).truth, elapsed_ns / 1e9
