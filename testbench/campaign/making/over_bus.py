"""Runs against the clock, one after another: on an own hub, on vcan or on real interfaces, also with foreign parts.

Each run is a rig of processes of its own. Its gateway has the injectors of the run, all of them disarmed; they are
armed over live control once everything is heard, before time 0. The golden run of a setting is made once for a campaign
that is under way, and is the measure of all its runs. A run that proves nothing (late, frames lost) is made again,
twice at most, then recorded as invalid.
No two runs against the clock are alike: here the same identity says what was asked for, not that every bit comes again.
"""

import platform
import time
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from typing import Final, final

from canopen_exo.bus.node import NEVER
from canopen_exo.bus.trace import trace_hash
from fi_gateway.control_socket import ask, ask_listing
from fi_gateway.errors import FaultError
from fi_gateway.schema import refuse_wire_faults
from testbench.campaign.making.execute import Pair, judged, keeps, write_kept
from testbench.campaign.making.executor import ATTEMPTS, Executor, FolderError, given_up
from testbench.campaign.records import IN_REAL_TIME, Outcome, RunRow, RunSpec
from testbench.errors import BenchError, RefusedError
from testbench.realtime_run import RealTimeRun, check_without, limits_in, pair_result, run_once
from testbench.record import RunRecord
from testbench.rig import RigParams
from testbench.run import judge_pair, rig_params
from testbench.scenario import Scenario, parse_scenario, refuse_queues
from testbench.summary import versions
from testbench.supervisor import Setup
from testbench.timing import TimingLimits


@dataclass(frozen=True, slots=True)
class Rigging:
    """Where the runs are made, as in Setup. buses: None for an own hub; listen, control: "" for any free place."""

    buses: tuple[str, str] | None = None
    without: frozenset[str] = frozenset()
    fifo: bool = False
    listen: str = "127.0.0.1:0"
    control: str = ""

    def words(self) -> str:
        """For code versions and reports: what the runs were made on."""
        where = "an own hub" if self.buses is None else f"{self.buses[0]} and {self.buses[1]}"
        foreign = f" without {', '.join(sorted(self.without))}" if self.without else ""
        return f"{IN_REAL_TIME} on {where}{foreign}"


def check_scenario(scenario: Scenario, rigging: Rigging) -> None:
    """Raise BenchError or FaultError for what cannot be done over a bus, before anything runs."""
    what = "exo-hil campaign run --realtime"
    if "gateway" in rigging.without:
        raise BenchError(f"{what}: --without gateway leaves nothing to inject with; take it away")
    check_without(scenario, rigging.without)
    refuse_wire_faults(scenario.injectors, what)
    refuse_queues(scenario, what)
    for name, spec in scenario.injectors.items():
        if spec.enabled and spec.start == "power_up":
            raise BenchError(
                f"injectors.{name}.from: power_up is over when a campaign over the bus arms its injectors; allowed is "
                "time_zero there"
            )


@final
class OverBus(Executor):
    """One run at a time, made while `collect` is called."""

    def __init__(self, rigging: Rigging) -> None:
        self._rigging: Final[Rigging] = rigging
        self._waiting: Final[deque[RunSpec]] = deque()
        self._golden: Final[dict[tuple[RigParams, TimingLimits], RealTimeRun]] = {}
        self._versions: Final[dict[str, str]] = versions()

    def free(self) -> int:
        """One, while none waits."""
        return 0 if self._waiting else 1

    def submit(self, spec: RunSpec) -> None:
        """Take a run."""
        self._waiting.append(spec)

    def collect(self, timeout_s: float) -> list[RunRow]:
        """Make the run that waits, however long it takes; Ctrl-C ends it with KeyboardInterrupt.

        Raises FolderError, and RefusedError for an address or a bus that cannot be had.
        """
        return [self._row(self._waiting.popleft())] if self._waiting else []

    def stop(self) -> None:
        """Drop what waits; no process outlives `collect`."""
        self._waiting.clear()

    def _row(self, spec: RunSpec) -> RunRow:
        """The first valid try, or the last one."""
        scenario = parse_scenario(spec.scenario, f"scenario of run {spec.identity[:12]}")
        for attempt in range(1, ATTEMPTS + 1):
            started, wall = datetime.now(UTC).isoformat(timespec="milliseconds"), time.perf_counter()
            try:
                row = self._made(spec, scenario)
            except (FolderError, RefusedError):
                raise  # not of the run: nobody may take it for one that proves nothing
            except (BenchError, FaultError) as error:
                row = given_up(spec, Outcome.INVALID, str(error), attempt, 0.0, started)
            row = replace(
                row,
                attempts=attempt,
                started=started,
                wall_s=time.perf_counter() - wall,
                machine=platform.node(),
                versions={**self._versions, "code": spec.code_version},
            )
            if row.outcome is not Outcome.INVALID:
                break
        return row

    def _made(self, spec: RunSpec, scenario: Scenario) -> RunRow:
        """One try. Raises BenchError and FaultError when it gives nothing to judge."""
        begun = time.perf_counter()
        golden = self._golden_of(scenario)
        disarmed = {name: replace(one, enabled=False) for name, one in scenario.injectors.items()}
        armed = [name for name, one in scenario.injectors.items() if one.enabled]

        setup = replace(self._setup(scenario), scenario=replace(scenario, injectors=disarmed), faults=True)
        faulted = run_once(setup, when_ready=lambda rig: arm(rig.control_address, armed))
        record = _ended(faulted.record, spec, scenario, golden.record)
        judgement = judge_pair(scenario, golden.record, record)
        pair = Pair(golden.record, trace_hash(golden.record.rows), record, trace_hash(record.rows))
        row = judged(spec, scenario, pair, judgement)
        if keeps(spec, row.outcome):
            write_kept(spec, pair_result(scenario, golden, faulted, time.perf_counter() - begun))
        timing = faulted.timing
        kept = {"timing.late_cycles": float(len(timing.late)), "timing.worst_late_ms": timing.late_worst_ns / 1e6}
        return replace(row, metrics={**row.metrics, **kept})

    def _golden_of(self, scenario: Scenario) -> RealTimeRun:
        """Made once for a setting; one that proves nothing is not kept."""
        key = (rig_params(scenario), limits_in(scenario))
        if key not in self._golden:
            golden = run_once(self._setup(scenario))
            if golden.record.invalid_reasons:
                raise BenchError(f"golden run: {'; '.join(golden.record.invalid_reasons)}")
            self._golden[key] = golden
        return self._golden[key]

    def _setup(self, scenario: Scenario) -> Setup:
        one = self._rigging
        return Setup(
            scenario,
            one.buses,
            one.without,
            faults=False,
            keep_parts=True,
            fifo=one.fifo,
            listen=one.listen,
            control=one.control,
        )


def arm(address: str, injectors: Sequence[str]) -> None:
    """Arm them over live control. Raises BenchError when time 0 was before: what was due since then is lost."""
    for name in injectors:
        ask(address, "arm", name)
    if injectors and ask_listing(address).time_zero_ns != NEVER:
        raise BenchError(
            "the injectors were armed after time 0, so that some faults may be missing: the machine was too slow, or a "
            "foreign controller was walking before the rig was heard"
        )


def _ended(record: RunRecord, spec: RunSpec, scenario: Scenario, golden: RunRecord) -> RunRecord:
    """Judged as if it had ended early where the campaign says so: it walks on, what comes later does not count."""
    failures = judge_pair(scenario, golden, record).failures if spec.stop_on is not None else ()
    if not failures:
        return record
    end_ns = min(record.duration_ns, round((min(one.time_s for one in failures) + spec.grace_s) * 1e9))
    acted = [one for one in record.activations if one.start_ns < record.time0_ns + end_ns]
    return replace(record, duration_ns=end_ns, activations=acted)
