"""A rig in virtual time, in the test's own process: nothing moves unless the test lets it, and every run is the same.

The rig is the one of `exo-hil run`; the test's own node on both buses comes last and is silent until `send`, so that
the trace is that of the same scenario run from the command line. The rig is put together at the first call that
needs it: faults given before that are there from power-up.
"""

from collections.abc import Callable
from typing import Final, final

import numpy as np

from canopen_exo.bus.frame import Frame
from canopen_exo.bus.loop import Loop
from canopen_exo.bus.medium import Transmission
from canopen_exo.bus.node import MS, NEVER, Node
from canopen_exo.master import MasterState
from fi_gateway.bus_control import BusControl
from fi_gateway.control import InjectorRow, LiveControl, perform
from fi_gateway.errors import FaultError
from testbench.errors import BenchError
from testbench.gateway_process import ControlFrames, control_frames
from testbench.parts import NotedEvent
from testbench.plugin.exo import Exo
from testbench.plugin.golden import Goldens
from testbench.plugin.injection import NOT_RUN, GatewayControl, Part
from testbench.record import Truth
from testbench.rig import Rig, build_rig
from testbench.run import rig_params
from testbench.scenario import Scenario

NAME: Final = "lockstep"


@final
class LockStepGateway(GatewayControl):
    """The gateway of a lock-step rig. frames: live control over the bus, None for none."""

    def __init__(self, scenario: Scenario, frames: ControlFrames | None) -> None:
        super().__init__(scenario)
        self._frames: Final = frames
        self._loop: Loop | None = None
        self._control: LiveControl | None = None

    def connect(self, rig: Rig) -> None:
        """The rig is there: from now on calls reach its gateway."""
        self._loop, self._control = rig.loop, LiveControl(rig.gateway, self.additions)
        frames = self._frames
        if frames is not None:
            rig.gateway.attach(BusControl(self._control, frames.port, frames.command_id, frames.status_id))

    def listing(self) -> list[InjectorRow]:
        """As they are now; empty before the rig runs."""
        return [] if self._control is None else self._control.listing()

    def command(self, word: str, name: str) -> None:
        """A word of live control at the present time. Raises FaultError."""
        if self._loop is None or self._control is None:
            raise FaultError(NOT_RUN.format(what=f"{word} {name}".strip()))
        perform(self._control, word, name, self._loop.now, "test")

    def _add(self, name: str, given: Part, at_once: bool) -> None:
        if self._loop is None or self._control is None:
            self.additions.read(name, given)
        else:
            self._control.add(name, given, self._loop.now, "test", at_once)


@final
class LockStepExo(Exo):
    """A rig in virtual time."""

    def __init__(self, scenario: Scenario, goldens: Goldens, frames: ControlFrames | None = None) -> None:
        self._injectors: Final = LockStepGateway(scenario, frames)
        super().__init__(scenario, NAME, self._injectors, goldens)
        self._rig: Rig | None = None
        self._heard: int = 0

    @property
    def rig(self) -> Rig:
        """Its parts; put together now when that is not done yet."""
        self._start()
        assert self._rig is not None
        return self._rig

    @property
    def time_ns(self) -> int:
        """Of the loop; 0 before the rig has run."""
        return 0 if self._rig is None else self._rig.loop.now

    @property
    def rows(self) -> list[Transmission]:
        """The loop's trace."""
        return [] if self._rig is None else self._rig.loop.trace

    def _start(self) -> None:
        if self._rig is None:
            rig = build_rig(rig_params(self.scenario), self._injectors.additions.built())
            rig.loop.connect(Node(), [rig.controller_bus, rig.drive_bus])
            self._rig = rig
            self._injectors.connect(rig)

    def _advance(self, limit_ns: int, is_over: Callable[[], bool] | None, every_frame: bool = False) -> bool:
        rig = self.rig
        loop = rig.loop
        while loop.now < limit_ns:
            to_ns = limit_ns
            if is_over is not None:
                to_ns = min(limit_ns, _next_instant(rig) if every_frame else (loop.now // MS + 1) * MS)
            loop.run_until(to_ns)
            self._listen(rig)
            if is_over is not None and is_over():
                return True
        return False

    def _listen(self, rig: Rig) -> None:
        """Take in what was on the buses, and what only the controller itself knows."""
        trace, observer = rig.loop.trace, self.observer
        while self._heard < len(trace):
            observer.hear(trace[self._heard])
            self._heard += 1
        controller, master = rig.controller, rig.master
        observer.time_zero_ns = controller.time_zero
        if master.state is MasterState.FAILED:
            observer.master.state, observer.master.failure = master.state, master.failure
        if len(controller.events) != len(observer.controller.events):
            observer.controller.events = [
                NotedEvent(event.time_ns, event.joint, event.kind, event.text) for event in controller.events
            ]

    def _send(self, bus: int, frame: Frame) -> None:
        self.rig.loop.outs[-1].send(bus, frame)

    def _truth(self) -> tuple[Truth, float]:
        rig = self.rig
        zero = rig.controller.time_zero
        elapsed_ns = min(rig.loop.now - zero, rig.params.duration_ns)
        rows = [row for row in rig.rack.truth if zero <= row.time_ns <= zero + elapsed_ns]
        truth = Truth(
            np.array([row.time_ns - zero for row in rows]) / 1e9,
            np.array([row.q for row in rows]),
            np.array([row.dq for row in rows]),
            np.array([row.tau for row in rows]),
        )
        return truth, elapsed_ns / 1e9


def _next_instant(rig: Rig) -> int:
    """When something happens next: a frame ends, or a node is due."""
    at = NEVER
    for medium in rig.loop.media:
        at = min(at, medium.end)
    for node in rig.loop.nodes:
        at = min(at, node.wake_at)
    return at if at > rig.loop.now else rig.loop.now + 1


def open_lockstep(scenario: Scenario, goldens: Goldens, without: frozenset[str], frames: str = "") -> LockStepExo:
    """A rig in virtual time; raises BenchError when a part is to be foreign. frames: as `gateway --control-frames`."""
    if without:
        parts = ", ".join(sorted(without))
        raise BenchError(f"--exo-without {parts}: in lock-step no part is foreign; name a bus with --exo-bus")
    return LockStepExo(scenario, goldens, control_frames(frames) if frames else None)
