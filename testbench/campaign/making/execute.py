"""One run of a campaign: made, judged, and put into one row.

The golden run of a setting is made once in a process and kept in its Workshop; what a run costs is its faulted part.
"""

import gc
import platform
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import Final

from canopen_exo.bus.node import NEVER
from canopen_exo.bus.trace import TraceHash
from canopen_exo.errors import CanopenExoError
from fi_gateway.activation import Activation
from fi_gateway.schema import build_injectors
from hlc.limits import limits_of
from hlc.node import Phase
from joint_emulators.errors import JointEmulatorError
from testbench.campaign.making.early import LOOK_NS, FailureStop
from testbench.campaign.making.executor import FolderError
from testbench.campaign.making.fork import Trunk
from testbench.campaign.making.outcomes import first_reaction, outcome_of, phase_at, severity
from testbench.campaign.records import FAILURES, InjectionRow, Outcome, RunRow, RunSpec
from testbench.errors import BenchError
from testbench.folder import write_folder
from testbench.golden import JointComparison
from testbench.record import RunRecord
from testbench.rig import Rig, RigParams, build_rig
from testbench.run import CHUNK_NS, Result, chunks, judge_pair, record_of, result_of, rig_params, uncollected
from testbench.scenario import Scenario, parse_scenario
from testbench.summary import versions
from testbench.verdict import Judgement, limit_failures

GOLDEN_KEPT: Final = 4
"""Golden runs a process keeps; an axis that changes the rig or the motion needs one for each value."""

METRICS: Final = JointComparison.__slots__
"""Numbers of a joint, by the names that the document of a single run has for them; `held_cycles` is one more."""


class Workshop:
    """What a process keeps from run to run. made: golden runs that it has made so far."""

    def __init__(self) -> None:
        self.made: int = 0
        self._golden: dict[RigParams, Trunk] = {}
        self._versions: dict[str, str] = versions()
        self._machine: str = platform.node()

    @property
    def machine(self) -> str:
        """This machine's name."""
        return self._machine

    def versions(self, code_version: str) -> Mapping[str, str]:
        """What the numbers depend on, the code among them."""
        return {**self._versions, "code": code_version}

    def golden(self, params: RigParams, fork: bool = False) -> Trunk:
        """The golden run of a setting, made when it is not there; it depends on nothing else. Raises NotStartedError.

        fork: with snapshots; a run that was made without is made again. The one that was not used for longest makes
        room for a new one.
        """
        found = self._golden.pop(params, None)
        if found is None or (fork and not found.has_snapshots):
            found = Trunk(params, fork)
            self.made += 1
            while len(self._golden) >= GOLDEN_KEPT:
                del self._golden[next(iter(self._golden))]
            gc.unfreeze()
            gc.collect()
            gc.freeze()  # a million objects that stay: not to be looked through again after every run
        self._golden[params] = found
        return found


@dataclass(frozen=True, slots=True)
class Made:
    """A faulted run beside its golden run. sim_ns: time simulated for it; forked_s: time taken over from golden."""

    golden: Trunk
    record: RunRecord
    trace_hash: str
    sim_ns: int
    forked_s: float


def make_run(spec: RunSpec, workshop: Workshop, kept: Callable[[Result], None] = lambda result: None) -> RunRow:
    """Make one run and judge it. A run that gives nothing to judge comes back as invalid, with the reason.

    kept: told of a result that has got a folder.
    Raises FileErrors and FaultError for a scenario that cannot be run, and FolderError when a result folder cannot be
    written. Nothing here holds `time_limit_s`: whoever has started the process does.
    """
    started, wall, cpu = datetime.now(UTC), time.perf_counter(), time.process_time()
    scenario = parse_scenario(spec.scenario, f"scenario of run {spec.identity[:12]}")
    try:
        with uncollected():
            made = _made(spec, workshop, scenario)
        judgement = judge_pair(scenario, made.golden.record, made.record)
    except (BenchError, JointEmulatorError, CanopenExoError) as error:
        row = RunRow(spec.identity, spec.wanted.point, spec.wanted.number, spec.seed, Outcome.INVALID, str(error))
    else:
        pair = Pair(made.golden.record, made.golden.trace_hash, made.record, made.trace_hash, made.forked_s)
        row = judged(spec, scenario, pair, judgement)
        if keeps(spec, row.outcome):
            sim_s, wall_s = made.sim_ns / 1e9, time.perf_counter() - wall  # of the faulted run, golden made before
            result = result_of(scenario, made.golden.record, made.record, sim_time_s=sim_s, wall_time_s=wall_s)
            write_kept(spec, result)
            kept(result)
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
    golden = workshop.golden(params, spec.fork)
    if not _is_measure(golden.record, scenario):
        return Made(golden, golden.record, "", 0, 0.0)
    make = partial(build_injectors, scenario.injectors, params.plan, scenario.seed, 0)
    injectors, snapshot = make(), None
    if spec.fork and not any(one.wire is not None for one in injectors):
        first_ns = golden.first_activation(make(), params.plan.cycle_ns)
        if first_ns == NEVER:
            return Made(golden, golden.record, golden.trace_hash, 0, golden.end_ns / 1e9)
        snapshot = golden.before(first_ns)
    rig = build_rig(params, injectors) if snapshot is None else golden.branch(snapshot, injectors)
    record, end_ns = _driven(rig, _stop_of(spec, scenario))
    digest, known = (TraceHash(), 0) if snapshot is None else (snapshot.digest.copy(), snapshot.rows)
    digest.update(record.rows[known:])
    forked_ns = 0 if snapshot is None else snapshot.now
    return Made(golden, record, digest.hexdigest(), end_ns - forked_ns, forked_ns / 1e9)


def _is_measure(golden: RunRecord, scenario: Scenario) -> bool:
    """Whether a golden run proves something; if not, its faulted runs need not be made."""
    names = tuple(joint.name for joint in scenario.plan.joints)
    limits = {name: limits_of(name) for name in names}
    return golden.valid and not limit_failures(
        names, limits, golden.truth, golden.duration_s, scenario.tolerance_rad
    )


def _stop_of(spec: RunSpec, scenario: Scenario) -> FailureStop | None:
    """What ends the run early. Raises BenchError for an outcome on which no run can end."""
    if spec.stop_on is None:
        return None
    if spec.stop_on != Outcome.FAILURE.value:
        raise BenchError(f"stop_early: on {spec.stop_on!r} given, allowed is {Outcome.FAILURE.value!r}")
    names = tuple(joint.name for joint in scenario.plan.joints)
    return FailureStop(names, scenario.tolerance_rad, round(spec.grace_s * 1e9))


def _driven(rig: Rig, stop: FailureStop | None) -> tuple[RunRecord, int]:
    """The run to its end, early or not; the record, and when it was over [ns, loop's clock]."""
    is_early = False
    for _ in chunks(rig, CHUNK_NS if stop is None else LOOK_NS):
        is_early = stop is not None and stop.reached(rig)
        if is_early:
            break
    rig.gateway.finish(rig.loop.now)
    if not is_early:
        return record_of(rig), rig.loop.now
    duration_ns = rig.loop.now - rig.controller.time_zero
    record = record_of(replace(rig, params=replace(rig.params, duration_ns=duration_ns)))
    return replace(record, completed=rig.controller.phase is Phase.MOTION), rig.loop.now


@dataclass(frozen=True, slots=True)
class Pair:
    """Golden and faulted run, one record where no fault acted; hashes of traces; time not simulated for it [s]."""

    golden: RunRecord
    golden_hash: str
    faulted: RunRecord
    trace_hash: str
    forked_s: float = 0.0


def judged(spec: RunSpec, scenario: Scenario, pair: Pair, judgement: Judgement) -> RunRow:
    """The row of a run that could be judged; also of one that proves nothing, which has no metrics then."""
    record, wanted = pair.faulted, spec.wanted
    starts = [(one.start_ns - record.time0_ns) / 1e9 for one in record.activations]
    start_s = min(starts, default=None)
    detected_s = None if start_s is None else first_reaction(record, start_s)
    names = tuple(joint.name for joint in scenario.plan.joints)
    worst = severity(names, {name: limits_of(name) for name in names}, record.truth, record.duration_s)
    outcome = outcome_of(judgement, record.source, detected_s)
    reasons = [f"golden run: {one}" for one in pair.golden.invalid_reasons]
    if record is not pair.golden:
        reasons += record.invalid_reasons
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
        golden_hash=pair.golden_hash,
        trace_hash=pair.trace_hash,
        injections=tuple(_injection(one, record.time0_ns) for one in record.activations),
        forked_s=pair.forked_s,
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


def keeps(spec: RunSpec, outcome: Outcome) -> bool:
    """Whether a run of that outcome leaves a result folder."""
    return spec.keep_traces == "always" or (spec.keep_traces == "failures" and outcome in FAILURES)


def write_kept(spec: RunSpec, result: Result) -> None:
    """The result folder, as `exo-hil run` writes it. Raises FolderError."""
    try:
        write_folder(Path(spec.folder), result)
    except BenchError as error:
        raise FolderError(str(error)) from error
