"""One run of a campaign: made, judged, and put into one row.

The golden run of a setting is made once in a process and kept in its Workshop; what a run costs is its faulted part.
"""

import platform
import time
from collections.abc import Mapping
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Final

from canopen_exo.bus.node import NEVER
from canopen_exo.bus.trace import trace_hash
from canopen_exo.errors import CanopenExoError
from fi_gateway.activation import Activation
from fi_gateway.schema import build_injectors
from hlc.limits import limits_of
from joint_emulators.errors import JointEmulatorError
from testbench.campaign.outcomes import first_reaction, outcome_of, phase_at, severity
from testbench.campaign.records import FAILURES, InjectionRow, Outcome, RunRow, RunSpec
from testbench.errors import BenchError
from testbench.folder import write_folder
from testbench.golden import JointComparison
from testbench.record import RunRecord
from testbench.rig import RigParams
from testbench.run import judge_pair, result_of, rig_params, run_rig
from testbench.scenario import Scenario, parse_scenario
from testbench.summary import versions
from testbench.verdict import Judgement

GOLDEN_KEPT: Final = 4
"""Golden runs a process keeps; an axis that changes the rig or the motion needs one for each value."""

METRICS: Final = JointComparison.__slots__
"""Numbers of a joint, by the names that the document of a single run has for them; `held_cycles` is one more."""


@dataclass(frozen=True, slots=True)
class Golden:
    """A golden run. sim_ns: time simulated, from power-up to disabled drives; trace_hash: of both buses."""

    record: RunRecord
    sim_ns: int
    trace_hash: str


class Workshop:
    """What a process keeps from run to run. made: golden runs that it has made so far."""

    def __init__(self) -> None:
        self.made: int = 0
        self._golden: dict[RigParams, Golden] = {}
        self._versions: dict[str, str] = versions()
        self._machine: str = platform.node()

    @property
    def machine(self) -> str:
        """This machine's name."""
        return self._machine

    def versions(self, code_version: str) -> Mapping[str, str]:
        """What the numbers depend on, the code among them."""
        return {**self._versions, "code": code_version}

    def golden(self, params: RigParams) -> Golden:
        """The golden run of a setting, made when it is not there; it depends on nothing else. Raises NotStartedError.

        The one that was not used for longest makes room for a new one.
        """
        found = self._golden.pop(params, None)
        if found is None:
            record, sim_ns = run_rig(params, [])
            found = Golden(record, sim_ns, trace_hash(record.rows))
            self.made += 1
            while len(self._golden) >= GOLDEN_KEPT:
                del self._golden[next(iter(self._golden))]
        self._golden[params] = found
        return found


@dataclass(frozen=True, slots=True)
class Made:
    """A faulted run beside its golden run. sim_ns: time simulated for it; forked_s: motion taken over from golden."""

    golden: Golden
    record: RunRecord
    sim_ns: int
    forked_s: float


def make_run(spec: RunSpec, workshop: Workshop) -> RunRow:
    """Make one run and judge it. A run that gives nothing to judge comes back as invalid, with the reason.

    Raises FileErrors and FaultError for a scenario that cannot be run, and BenchError when a result folder cannot be
    written. Nothing here holds `time_limit_s`: whoever has started the process does.
    """
    started, wall, cpu = datetime.now(UTC), time.perf_counter(), time.process_time()
    scenario = parse_scenario(spec.scenario, f"scenario of run {spec.identity[:12]}")
    try:
        made = _made(spec, workshop, scenario)
        judgement = judge_pair(scenario, made.golden.record, made.record)
    except (BenchError, JointEmulatorError, CanopenExoError) as error:
        row = RunRow(spec.identity, spec.wanted.point, spec.wanted.number, spec.seed, Outcome.INVALID, str(error))
    else:
        row = _judged(spec, scenario, made, judgement)
        if spec.keep_traces == "always" or (spec.keep_traces == "failures" and row.outcome in FAILURES):
            _keep(Path(spec.folder), scenario, made, time.perf_counter() - wall)
    return replace(
        row,
        started=started.isoformat(timespec="milliseconds"),
        wall_s=time.perf_counter() - wall,
        cpu_s=time.process_time() - cpu,
        machine=workshop.machine,
        versions=workshop.versions(spec.code_version),
    )


def _made(spec: RunSpec, workshop: Workshop, scenario: Scenario) -> Made:
    """The faulted run. Raises NotStartedError, and what a plant or a bus that goes astray raises."""
    params = rig_params(scenario)
    golden = workshop.golden(params)
    injectors = build_injectors(scenario.injectors, params.plan, scenario.seed, 0)
    record, sim_ns = run_rig(params, injectors)
    return Made(golden, record, sim_ns, 0.0)


def _judged(spec: RunSpec, scenario: Scenario, made: Made, judgement: Judgement) -> RunRow:
    """The row of a run that could be judged; also of one that proves nothing, which has no metrics then."""
    record, wanted = made.record, spec.wanted
    starts = [(one.start_ns - record.time0_ns) / 1e9 for one in record.activations]
    start_s = min(starts, default=None)
    detected_s = None if start_s is None else first_reaction(record, start_s)
    names = tuple(joint.name for joint in scenario.plan.joints)
    worst = severity(names, {name: limits_of(name) for name in names}, record.truth, record.duration_s)
    outcome = outcome_of(judgement, record.source, detected_s)
    reasons = [*(f"golden run: {one}" for one in made.golden.record.invalid_reasons), *record.invalid_reasons]
    reasons += [f"golden run: {one.joint} leaves its range without a fault" for one in judgement.golden_failures]
    return RunRow(
        identity=spec.identity,
        point=wanted.point,
        number=wanted.number,
        seed=spec.seed,
        outcome=outcome,
        reason="; ".join(reasons),
        metrics={} if outcome is Outcome.INVALID else _metrics(judgement, record),
        first_start_s=start_s,
        first_phase=phase_at(start_s, scenario.motion.stride_ns / 1e9),
        activated=len(record.activations),
        injected=sum(one.frames_injected + one.attempts_disturbed for one in record.activations),
        manifested=sum(one.manifested for one in record.activations),
        detected_s=detected_s,
        detection_latency_s=None if detected_s is None or start_s is None else detected_s - start_s,
        failure_s=judgement.failures[0].time_s if judgement.failures else None,
        beyond_deg=worst.beyond_deg,
        beyond_s=worst.beyond_s,
        beyond_joint=worst.joint,
        ended_s=record.duration_s,
        errors=len(judgement.errors),
        failures=len(judgement.failures),
        failures_at_3deg=len(judgement.failures_at_3deg),
        golden_hash=made.golden.trace_hash,
        trace_hash=trace_hash(record.rows),
        injections=tuple(_injection(one, record.time0_ns) for one in record.activations),
        forked_s=made.forked_s,
    )


def _metrics(judgement: Judgement, record: RunRecord) -> dict[str, float]:
    """Every number of every joint."""
    found = {}
    for at, (joint, one) in enumerate(judgement.comparison.items()):
        for name in METRICS:
            found[f"{joint}.{name}"] = float(getattr(one, name))
        found[f"{joint}.held_cycles"] = float(record.held_cycles[at]) if record.held_cycles else 0.0
    return found


def _injection(one: Activation, time0_ns: int) -> InjectionRow:
    return InjectionRow(
        injector=one.injector,
        index=one.index,
        start_s=(one.start_ns - time0_ns) / 1e9,
        end_s=None if one.end_ns >= NEVER else (one.end_ns - time0_ns) / 1e9,
        duration_s=None if one.duration_ns >= NEVER else one.duration_ns / 1e9,
        frames=one.manifested,
        signal=one.signal,
        cause=one.cause,
    )


def _keep(folder: Path, scenario: Scenario, made: Made, wall_time_s: float) -> None:
    """The result folder, as `exo-hil run` writes it; its times are of the faulted run, golden made before."""
    result = result_of(
        scenario, made.golden.record, made.record, sim_time_s=made.sim_ns / 1e9, wall_time_s=wall_time_s
    )
    write_folder(folder, result)
