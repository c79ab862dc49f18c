"""The three scenarios that every bus must judge alike, walked against the clock and in lock-step.

Chosen with margin: in lock-step the bias stays 2 to 3 deg inside every limit of travel, depending on the rate, and the
frozen knee goes 34 deg or more beyond it.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final, final

import pytest

from canopen_exo.bus.node import SECOND
from fi_gateway.schema import build_injectors
from hlc.limits import limits_of
from testbench.child import ProcessError
from testbench.merge import IncompleteError
from testbench.realtime_run import RealTimeRun, limits_in, run_once
from testbench.record import RunRecord
from testbench.run import rig_params, run_rig
from testbench.scenario import JOINT_NAMES, Scenario, parse_scenario
from testbench.supervisor import Setup
from testbench.verdict import Judgement, judge
from tests.parity.patience import Late, Patience, distributions, is_lateness

VERDICTS: Final = {"none": True, "bias": True, "freeze": False}
"""Whether a scenario passes."""

HELD_SHARE: Final = 0.05
"""Of all samples. A late cycle misses the next SYNC; one that only misses the controller's deadline (0.6 of the cycle)
walks on with an old sample. When many do, the walk is not that of lock-step, and nothing is to be learned from it."""

_BASE: Final = """\
name: parity
rig: {{plant: suspended, stops: off, rate: {rate_hz} Hz}}
motion: {{gait: walking, stride: 1.5 s, duration: 2.5 s}}
"""
_FAULT: Final = """\
injectors:
  fault:
    target: {bus: to_controller, node: right_knee, signal: position}
    fault: FAULT
    event: {type: at, time: 1 s}
    effect: {type: constant_time, duration: 1 s}
"""
_FAULTS: Final = {
    "none": "",
    "bias": _FAULT.replace("FAULT", "{type: bias, value: 0.05 rad}"),
    "freeze": _FAULT.replace("FAULT", "{type: stuck_at}"),
}


@final
@dataclass(frozen=True, slots=True)
class Bench:
    """Where it walks. buses: of controller and drives, None for an own hub; rate_hz: of SYNC; fifo: as Setup."""

    buses: tuple[str, str] | None
    rate_hz: int
    fifo: bool = False

    @property
    def cycle_ns(self) -> int:
        """From SYNC to SYNC."""
        return SECOND // self.rate_hz

    @property
    def cycles(self) -> int:
        """Of the motion."""
        return 5 * self.rate_hz // 2

    def text(self, name: str = "none") -> str:
        """A scenario file."""
        return _BASE.format(rate_hz=self.rate_hz) + _FAULTS[name]

    def scenario(self, name: str = "none") -> Scenario:
        """As read from that file."""
        return parse_scenario(self.text(name))

    def setup(self, name: str = "none", without: frozenset[str] = frozenset()) -> Setup:
        """A rig for it whose processes leave their parts."""
        return Setup(self.scenario(name), self.buses, without, keep_parts=True, fifo=self.fifo)

    @property
    def options(self) -> list[str]:
        """The same place on the command line of `run --realtime`, `up` and `campaign run --realtime`."""
        named = [] if self.buses is None else ["--controller-bus", self.buses[0], "--drive-bus", self.buses[1]]
        return [*named, *(["--fifo"] if self.fifo else [])]


@final
@dataclass(frozen=True, slots=True)
class Pair:
    """The same run against the clock and in lock-step."""

    real: RealTimeRun
    lock_step: RunRecord


Walks = Callable[[str], Pair]
"""By scenario."""


def attempt_run(setup: Setup) -> RealTimeRun | Late:
    """One run; late, or it must be valid. Nothing is lost in it, late or not, unless somebody counted it."""
    cycle_ms = setup.scenario.plan.cycle_ns / 1e6
    try:
        run = run_once(setup)
    except (IncompleteError, ProcessError) as error:  # drives that miss SYNC for five cycles stop by themselves
        if not is_lateness([str(error)], cycle_ms) and "not ready after " not in str(error):
            raise
        return Late(str(error))
    assert run.timing.found <= run.timing.counted, run.timing.lost
    reasons = list(dict.fromkeys([*run.timing.reasons(limits_in(setup.scenario)), *run.record.invalid_reasons]))
    held, samples = sum(run.record.held_cycles), 6 * run.timing.cycles
    if held > HELD_SHARE * samples:
        reasons.append(f"{held} of {samples} samples came after the controller's deadline")
    if not reasons:
        return run
    assert is_lateness(reasons, cycle_ms), reasons
    return Late(f"{', '.join(reasons)}; {distributions(run.timing.lateness | run.timing.latency)}")


def make_walks(bench: Bench, patience: Patience) -> Walks:
    """Each is made once, or found to be too late once."""
    made: dict[str, Pair] = {}
    skipped: dict[str, BaseException] = {}

    def walk(name: str) -> Pair:
        if name in skipped:
            raise skipped[name]
        if name not in made:
            setup = bench.setup(name)
            try:
                real = patience.until_punctual(lambda: attempt_run(setup))
            except pytest.skip.Exception as error:
                skipped[name] = error
                raise
            made[name] = Pair(real, in_lock_step(setup.scenario))
        return made[name]

    return walk


def in_lock_step(scenario: Scenario) -> RunRecord:
    """With its faults."""
    injectors = build_injectors(scenario.injectors, scenario.plan, scenario.seed, 0)
    return run_rig(rig_params(scenario), injectors)[0]


def judged(golden: RunRecord, faulted: RunRecord) -> Judgement:
    """The verdict."""
    return judge(JOINT_NAMES, {name: limits_of(name) for name in JOINT_NAMES}, golden, faulted)
