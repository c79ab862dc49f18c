"""The rig as a test sees it, whatever bus it runs on.

    def test_drives_stop_without_commands(exo):
        exo.run_until_motion()
        exo.gateway.inject(target={"bus": "to_drives", "pdo": "RPDO1"}, fault={"type": "drop"})
        exo.expect(0x085, within="100 ms", data="50 82 .. .. .. .. .. ..")

Nothing moves unless the test lets it (`run_for`, `run_until`, `expect`) in lock-step; on any other bus time goes on by
itself, and the frames of meanwhile are read at the next of these calls. Frames count by their time, however late they
are read: those that end after the call. An `expect` behind a `send`, or a fault that was begun or ended, counts from
there, for the answer may be on the bus before the next line of the test runs. Durations are texts with a unit, "0.3 s",
or control cycles, "15 cycles".
"""

import re
from collections.abc import Callable
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Final, Self

from canopen_exo.bus.frame import Frame
from canopen_exo.bus.medium import Transmission
from canopen_exo.bus.node import NEVER, SECOND
from canopen_exo.bus.trace import write_candump
from canopen_exo.master import MasterState
from canopen_exo.plan import BusPlan
from fi_gateway.quantity import parse_duration
from testbench.errors import BenchError
from testbench.plugin.injection import GatewayControl
from testbench.plugin.observer import (
    BUSES,
    ControllerState,
    ControllerView,
    DriveView,
    MasterView,
    Observer,
    frame_name,
)
from testbench.plugin.wanted import Search, Wanted
from testbench.scenario import Scenario

if TYPE_CHECKING:
    from joint_emulators.plant import Plant
    from testbench.golden import JointComparison
    from testbench.plugin.golden import Goldens
    from testbench.record import RunRecord, Truth
    from testbench.rig import Rig

START_NS: Final = 10 * SECOND
"""Most that the rig may take to the fade-in; its own time-outs are shorter."""

SHOWN: Final = 20
"""Frames of each bus in a failure report."""

_CYCLES: Final = re.compile(r"([0-9]{1,9}) cycles?", re.ASCII)


class Exo:
    """A rig under test: base class, one for each kind of rig; a context manager that leaves nothing behind.

    scenario: what it was made from; bus: as on the command line; gateway: for faults; observer: what its frames say.

    More than seven public methods: they are the words of a test, which has one object to say them to.
    """

    def __init__(self, scenario: Scenario, bus: str, gateway: GatewayControl, goldens: "Goldens") -> None:
        self.scenario: Final[Scenario] = scenario
        self.bus: Final[str] = bus
        self.gateway: Final[GatewayControl] = gateway
        self.observer: Final[Observer] = Observer(scenario.plan)
        self._goldens: Final = goldens

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    # --- what it shows -------------------------------------------------------------------------------------------

    @property
    def plan(self) -> BusPlan:
        """COB-IDs, mappings and rates."""
        return self.scenario.plan

    @property
    def drives(self) -> dict[str, DriveView]:
        """The drives by joint, as the drive bus shows them: before any fault on the way to the controller."""
        return self.observer.drives

    @property
    def controller(self) -> ControllerView:
        """The high-level controller."""
        return self.observer.controller

    @property
    def master(self) -> MasterView:
        """The CANopen master."""
        return self.observer.master

    @property
    def rig(self) -> "Rig":
        """Every part of the rig, lock-step only."""
        raise BenchError(f"on {self.bus} the rig is in other processes; only lock-step shows it to a test")

    @property
    def plant(self) -> "Plant":
        """The body itself, lock-step only: q rad, dq rad/s, tau N m, in the order of the plan's joints."""
        return self.rig.rack.plant

    @property
    def golden(self) -> "RunRecord":
        """The fault-free run of this rig, in lock-step; made at the first use, once a session for each kind of rig."""
        return self._goldens.of(self.scenario)

    @property
    def time_s(self) -> float:
        """Since power-up, s."""
        return self.time_ns / 1e9

    @property
    def motion_s(self) -> float:
        """Since time 0 of the motion, s; raises BenchError before it."""
        if self.observer.time_zero_ns == NEVER:
            raise BenchError(f"the motion has not begun at {self.time_s:.3f} s; run_until_motion() first")
        return (self.time_ns - self.observer.time_zero_ns) / 1e9

    @property
    def time_ns(self) -> int:
        """Since power-up, ns."""
        raise NotImplementedError

    @property
    def rows(self) -> list[Transmission]:
        """Every frame of both buses so far."""
        raise NotImplementedError

    @property
    def timing(self) -> str:
        """How well it keeps time, in words; "" where time is virtual."""
        return ""

    @property
    def lateness(self) -> str:
        """What a run would be invalid for, in words; "" for a rig that kept time, and where time is virtual."""
        return ""

    def frames(self, bus: str, last: int = 50) -> list[Transmission]:
        """The last frames of bus "controller" or "drive", oldest first."""
        index = bus_index(bus)
        found: list[Transmission] = []
        for row in reversed(self.rows):
            if len(found) >= last:
                break
            if row.bus == index:
                found.append(row)
        found.reverse()
        return found

    def deviation(self, joint: str) -> "JointComparison":
        """The joint against the golden run, from time 0 to now, or to the end of the motion.

        In lock-step both are the plant's truth; elsewhere this side is what the drive's frames say.
        Raises BenchError before time 0, and for a joint that there is not.
        """
        from testbench.golden import compare

        names = tuple(one.name for one in self.plan.joints)
        if joint not in names:
            raise BenchError(f"deviation: joint {joint!r} given; this rig has {', '.join(names)}")
        if self.motion_s <= 0:
            raise BenchError("deviation: the motion has only begun; let it run for 1 ms at least")
        truth, elapsed_s = self._truth()
        return compare(names, self.golden.truth, truth, elapsed_s)[joint]

    @property
    def missed(self) -> int:
        """Frames that were on a bus and not heard, because the test did not read in time; 0 where time is virtual."""
        return 0

    # --- what a test does ----------------------------------------------------------------------------------------

    def run_for(self, duration: str) -> None:
        """Let the rig run: `exo.run_for("1.5 s")`."""
        _, limit = self._window(duration)
        self._advance(limit, None)

    def run_until(self, condition: Callable[[], bool], *, within: str) -> None:
        """Let the rig run until the condition, asked every 1 ms at least; AssertionError when it never holds."""
        __tracebackhide__ = True
        _, limit = self._window(within)
        if not condition() and not self._advance(limit, condition):
            raise AssertionError(f"the condition did not hold within {within}, until {self.time_s:.3f} s")

    def run_until_motion(self) -> None:
        """Let the rig run until the controller says on its bus that time 0 has come: the gait has faded in.

        AssertionError when that does not happen, with what is known of the reason.
        """
        __tracebackhide__ = True

        controller = self.controller

        def is_over() -> bool:
            is_decided = controller.state in (ControllerState.MOTION, ControllerState.STOPPED)
            return is_decided or self.master.state in (MasterState.FAILED, MasterState.STOPPED)

        self._start()
        self._catch_up()
        if not is_over():
            self._advance(self.time_ns + START_NS + self.scenario.motion.stride_ns, is_over)
        if controller.state is not ControllerState.MOTION:
            said = "; ".join(f"{event.joint or 'rig'}: {event.text}" for event in controller.events)
            reason = self.master.failure or said or f"the controller is {controller.state.name.lower()}"
            self._check()
            raise AssertionError(f"the motion has not begun until {self.time_s:.3f} s: {reason}")

    def expect(self, cob_id: int, *, within: str, data: bytes | str | None = None, bus: str = "drive") -> Transmission:
        """Let the rig run until such a frame ends on the bus, and return it; AssertionError when none comes in time.

        data: the whole payload; as text in hexadecimal, `..` stands for any byte: "50 82 .. .. .. .. .. ..".
        """
        __tracebackhide__ = True
        wanted = Wanted(cob_id, data, bus_index(bus))
        from_ns, limit_ns = self._window(within)
        found, missed = self._await(wanted, self._since(from_ns), limit_ns)
        if found is None:
            when = f"within {within}, until {self.time_s:.6f} s"
            if missed:
                when += f" ({missed} frames of that time were not heard, the test did not read for too long)"
            raise AssertionError(f"no {self._words(wanted)} {when}{self._near(wanted)}")
        return found

    def expect_none(self, cob_id: int, *, within: str, data: bytes | str | None = None, bus: str = "drive") -> None:
        """Let the rig run for that time; AssertionError when such a frame ends on the bus meanwhile.

        Raises BenchError when frames of that time were lost on the way to the test: it can have been among them.
        """
        __tracebackhide__ = True
        wanted = Wanted(cob_id, data, bus_index(bus))
        found, missed = self._await(wanted, *self._window(within))
        if found is None and missed:
            raise BenchError(
                f"expect_none: {missed} frames were not heard within {within}, {wanted.words} can be one of them; the "
                "test did not read for too long: expect less at once, or run it on a machine that is less busy"
            )
        if found is not None:
            raise AssertionError(f"{self._words(wanted)} was not to come within {within}:\n{self.text_of(found)}")

    def send(self, cob_id: int, data: bytes, *, bus: str = "controller") -> None:
        """Put a frame with an 11-bit id on bus "controller" or "drive", as one more node on it."""
        self._start()
        self._send(bus_index(bus), Frame(cob_id, data))

    def close(self) -> None:
        """End the rig; a second call does nothing."""

    # --- for failure reports -------------------------------------------------------------------------------------

    def write_logs(self, folder: Path) -> list[Path]:
        """Both buses as candump logs; returns their paths. Raises OSError."""
        paths = [folder / f"{name}.log" for name in BUSES]
        for index, path in enumerate(paths):
            write_candump(path, self.rows, index, BUSES[index])
        return paths

    def text_of(self, row: Transmission) -> str:
        """One frame in one line."""
        frame = row.frame
        name = "" if frame.flags else frame_name(self.plan, frame.can_id)
        data = "remote" if not frame.data and frame.dlc else frame.data.hex(" ").upper()
        return f"{row.end_ns / 1e9:12.6f} s  {frame.can_id:03X}  {data:<23}  {name}".rstrip()

    # --- inside --------------------------------------------------------------------------------------------------

    def _start(self) -> None:
        """Put the rig together and power it up, when that is not done yet."""
        raise NotImplementedError

    def _catch_up(self) -> None:
        """Take in what has come while the test did something else; nothing where time is virtual."""

    def _check(self) -> None:
        """Raise what a rig raises that is broken: no failure of what is tested; nothing where it cannot be."""

    def _advance(self, limit_ns: int, is_over: Callable[[], bool] | None, every_frame: bool = False) -> bool:
        """Run until `is_over()`, asked every 1 ms at least, or after every frame, and give True; False at the limit.

        Frames count by the time at which they ended, not by that at which they are read.
        """
        raise NotImplementedError

    def _send(self, bus: int, frame: Frame) -> None:
        raise NotImplementedError

    def _truth(self) -> tuple["Truth", float]:
        """What the joints did from time 0 to the end of the motion or to now, and how long that is [s]."""
        raise NotImplementedError

    def _window(self, duration: str) -> tuple[int, int]:
        """Now and the instant that long from now, in the time of the started rig [ns]; what came before is read."""
        if not isinstance(duration, str):  # a number of what? tests are not all type-checked
            raise BenchError(f"duration {duration!r} given, allowed is text with a unit: '0.1 s', '15 cycles'")
        cycles = _CYCLES.fullmatch(duration)
        span = int(cycles[1]) * self.plan.cycle_ns if cycles else parse_duration(duration)
        if span < 0:
            raise BenchError(f"duration {duration!r} given, allowed 0 s and more")
        self._start()
        now = self.time_ns
        self._catch_up()
        return now, now + span

    def _since(self, now: int) -> int:
        """From when on a frame may be the answer to what the test did last: `now` where time is virtual."""
        return now

    def _await(self, wanted: Wanted, from_ns: int, limit_ns: int) -> tuple[Transmission | None, int]:
        """Run until the first such frame that ends in that time; also how many frames were not heard meanwhile."""
        missed = self.missed
        search = Search(wanted, self.rows, from_ns, limit_ns)
        self._advance(limit_ns, search.is_over, every_frame=True)
        return search.found, self.missed - missed

    def _words(self, wanted: Wanted) -> str:
        name = frame_name(self.plan, wanted.cob_id)
        return f"{wanted.words}{f' ({name})' if name else ''} on the {BUSES[wanted.bus]} bus"

    def _near(self, wanted: Wanted) -> str:
        """The last frames with that id, for a message."""
        same = [row for row in self.frames(BUSES[wanted.bus], 2000) if row.frame.can_id == wanted.cob_id][-3:]
        if not same:
            return "; none with that id is among the last frames there"
        lines = [f"{self.text_of(row)}  {wanted.length_words(row.frame)}".rstrip() for row in same]
        return "; the last with that id there:\n" + "\n".join(lines)


def bus_index(name: str) -> int:
    """Of "controller" or "drive"; raises BenchError."""
    if name not in BUSES:
        raise BenchError(f"bus {name!r} given, allowed: {', '.join(BUSES)}")
    return BUSES.index(name)
