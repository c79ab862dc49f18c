"""One scenario, run: the golden run, the faulted run, and what is said about the pair.

Both runs build the same rig anew in virtual time; they differ in the injectors only, so that every difference between
them comes from the faults.
"""

import gc
import time
from bisect import bisect_right
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Final

import numpy as np

from canopen_exo.bus.frame import FLAG_ERROR
from canopen_exo.bus.medium import Medium, Transmission
from canopen_exo.bus.node import MS, NEVER, SECOND
from canopen_exo.bus.wire import Wire
from fi_gateway.injector import Injector
from fi_gateway.replay import Window
from fi_gateway.schema import build_injectors
from hlc.limits import limits_of
from hlc.node import HighLevelController, Phase
from testbench.document import Summary
from testbench.errors import BenchError
from testbench.record import BusStats, Commands, RigEvent, RunRecord, Truth
from testbench.rig import Rig, RigParams, build_rig
from testbench.scenario import Scenario
from testbench.summary import summary_document
from testbench.verdict import Judgement, judge

CHUNK_NS: Final = 50 * MS
"""How far the loop runs between two looks at the rig."""

START_NS: Final = 6 * SECOND
"""Most that power-up, configuration and enabling may take; their own time-outs are shorter."""

LEAVE_NS: Final = SECOND
"""Most that disabling may take after the motion."""

Progress = Callable[[float], None]
"""Told the share 0..1 of the work that is done."""


class NotStartedError(BenchError):
    """The motion never began, so there is nothing to judge; the message says why."""


@dataclass(frozen=True, slots=True)
class Result:
    """A scenario run and judged. The document is what `exo-hil run --json` prints."""

    scenario: Scenario
    golden: RunRecord
    faulted: RunRecord
    judgement: Judgement
    document: Summary


def run_scenario(
    scenario: Scenario,
    progress: Progress = lambda share: None,
    recorded: Mapping[str, tuple[Window, ...]] | None = None,
) -> Result:
    """Golden run, faulted run, verdict. Raises NotStartedError when the motion of either never begins.

    recorded: windows by injector, in the place of all events, effects and triggers.
    """
    started = time.perf_counter()
    params = rig_params(scenario)
    golden, golden_ns = run_rig(params, [], lambda share: progress(0.5 * share))
    injectors = build_injectors(scenario.injectors, params.plan, scenario.seed, 0, recorded)
    faulted, faulted_ns = run_rig(params, injectors, lambda share: progress(0.5 + 0.5 * share))
    wall_time_s = time.perf_counter() - started
    return result_of(scenario, golden, faulted, sim_time_s=(golden_ns + faulted_ns) / 1e9, wall_time_s=wall_time_s)


def result_of(
    scenario: Scenario, golden: RunRecord, faulted: RunRecord, *, sim_time_s: float, wall_time_s: float
) -> Result:
    """The pair of runs judged, and what is said about it. sim_time_s, wall_time_s: of the runs made for it."""
    judgement = judge_pair(scenario, golden, faulted)
    document = summary_document(
        scenario.name,
        scenario.seed,
        golden,
        faulted,
        judgement,
        injectors=sum(spec.enabled for spec in scenario.injectors.values()),
        sim_time_s=sim_time_s,
        wall_time_s=wall_time_s,
    )
    return Result(scenario, golden, faulted, judgement, document)


def judge_pair(scenario: Scenario, golden: RunRecord, faulted: RunRecord) -> Judgement:
    """As the scenario wants it judged, by the table's limits of its joints."""
    names = tuple(joint.name for joint in scenario.plan.joints)
    return judge(
        names,
        {name: limits_of(name) for name in names},
        golden,
        faulted,
        tolerance_rad=scenario.tolerance_rad,
        fail_on=scenario.fail_on,
        expectations=scenario.expect,
    )


def rig_params(scenario: Scenario) -> RigParams:
    """What a scenario asks of the rig."""
    rig, motion = scenario.rig, scenario.motion
    return RigParams(scenario.plan, rig.stops, motion.stride_ns, motion.duration_ns, rig.queues == "fifo")


def run_rig(
    params: RigParams, injectors: list[Injector], progress: Progress = lambda share: None
) -> tuple[RunRecord, int]:
    """One run from power-up to disabled drives; the record and the time simulated [ns]. Raises NotStartedError."""
    rig = build_rig(params, injectors)
    with uncollected():
        drive_through(rig, progress)
        return record_of(rig), rig.loop.now


def drive_through(rig: Rig, progress: Progress) -> None:
    """Run the loop until the motion time is over and the drives are left; always ends."""
    usual_ns = rig.params.stride_ns + rig.params.duration_ns + LEAVE_NS
    for now in chunks(rig):
        progress(min(1.0, now / usual_ns))
    rig.gateway.finish(rig.loop.now)
    progress(1.0)


@contextmanager
def uncollected() -> Iterator[None]:
    """No garbage collection: nothing in a run makes cycles of references, and looking costs a fifth of the time."""
    collecting = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if collecting:
            gc.enable()


def chunks(rig: Rig, step_ns: int = CHUNK_NS) -> Iterator[int]:
    """Run the loop until the motion time is over and the drives are left; always ends, on a multiple of CHUNK_NS.

    Pauses every step_ns, of which CHUNK_NS is a multiple, and yields the loop's time.
    """
    controller, loop, params = rig.controller, rig.loop, rig.params
    latest = START_NS + params.stride_ns + params.duration_ns + LEAVE_NS
    while loop.now < latest:
        loop.run_until(loop.now + step_ns)
        if loop.now % CHUNK_NS == 0 and motion_over(controller, params.duration_ns, loop.now):
            return
        yield loop.now


def motion_over(controller: HighLevelController, duration_ns: int, now: int) -> bool:
    """Whether the start has failed, or the controller has stopped and the time of the motion is over."""
    if controller.phase is Phase.STOPPED:
        return controller.time_zero == NEVER or now > controller.time_zero + duration_ns
    return controller.phase is Phase.FAILED


def record_of(rig: Rig) -> RunRecord:
    """What a finished run leaves behind; raises NotStartedError when the motion never began."""
    controller, params = rig.controller, rig.params
    zero = controller.time_zero
    if zero == NEVER or rig.gateway.time_zero == NEVER or not controller.samples:
        reasons = "; ".join(f"{event.joint + ': ' if event.joint else ''}{event.text}" for event in controller.events)
        which = "faulted run" if rig.gateway.injectors else "golden run"
        reasons = reasons or "the bus carried no status of the controller"
        raise NotStartedError(f"{which}: the motion never began: {reasons}")
    end = rig.gateway.time_zero + params.duration_ns
    rows = [row for row in rig.rack.truth if zero <= row.time_ns <= zero + params.duration_ns]
    truth = Truth(
        np.array([row.time_ns - zero for row in rows]) / 1e9,
        np.array([row.q for row in rows]),
        np.array([row.dq for row in rows]),
        np.array([row.tau for row in rows]),
    )
    samples = controller.samples
    commands = Commands(
        np.array([sample.cycle * params.plan.cycle_ns for sample in samples]) / 1e9,
        np.array([sample.q_d for sample in samples]),
        np.array([sample.dq_d for sample in samples]),
        np.array([sample.tau_command for sample in samples]),
    )
    trace = rig.loop.trace
    return RunRecord(
        rows=trace,
        time0_ns=rig.gateway.time_zero,
        duration_ns=params.duration_ns,
        truth=truth,
        commands=commands,
        activations=[one for one in rig.gateway.records if one.start_ns < end],
        activations_after=[one for one in rig.gateway.records if one.start_ns >= end],
        buses=_stats(rig, trace),
        notes=[
            RigEvent((event.time_ns - zero) / 1e9, event.joint or "HLC", event.kind, event.text)
            for event in controller.events
        ],
        completed=controller.completed,
        held_cycles=list(controller.late),
        invalid_reasons=_invalid_reasons(rig),
    )


def _stats(rig: Rig, rows: list[Transmission]) -> tuple[BusStats, ...]:
    """Of each bus, what passed within the motion, and the share of it in which the bus was busy."""
    media = (rig.controller_bus, rig.drive_bus)
    start = rig.controller.time_zero
    end = start + rig.params.duration_ns
    return tuple(
        BusStats(medium.name, frames, busy_ns / (end - start), sum(port.dropped for port in medium.ports))
        for medium, (frames, busy_ns) in zip(media, traffic(rows, media, start, end), strict=True)
    )


def traffic(rows: list[Transmission], media: Sequence[Medium], start: int, end: int) -> list[tuple[int, int]]:
    """Of each bus, frames that ended within (start, end], and the time for which it was busy with them or with errors.

    [ns]. Of a disturbed attempt to send it is the whole span that counts, with error frames and what they broke off.
    media: by their index.
    """
    spans = [medium.wire.spans if isinstance(medium.wire, Wire) else [] for medium in media]
    busy_ns = [sum(last - first for first, last in each if start < last <= end) for each in spans]
    frames, at = [0] * len(media), [0] * len(media)
    begin = bisect_right(rows, start, key=lambda row: row.end_ns)
    for place in range(begin, bisect_right(rows, end, key=lambda row: row.end_ns)):
        row = rows[place]
        bus, each = row.bus, spans[row.bus]
        if row.frame.flags & FLAG_ERROR:
            continue
        frames[bus] += 1
        while at[bus] < len(each) and each[at[bus]][1] < row.end_ns:
            at[bus] += 1
        if at[bus] == len(each) or row.end_ns <= each[at[bus]][0]:
            busy_ns[bus] += row.frame.bits * media[bus].bit_ns
    return list(zip(frames, busy_ns, strict=True))


def _invalid_reasons(rig: Rig) -> list[str]:
    """Why the run proves nothing: frames lost without a fault, two senders with one id.

    A cut bus explains losses, and so does a fault on a wire, of frames in addition, or of frames held back, that did
    something: what waits for one bus then floods the other. The first two also explain two senders.
    """
    media = (rig.controller_bus, rig.drive_bus)
    collides = any((one.wire is not None or one.adds) and one.manifested for one in rig.gateway.injectors)
    floods = collides or any(one.frames_delayed or one.frames_inserted for one in rig.gateway.records)
    floods = floods or any(medium.cuts for medium in media)
    reasons = []
    for medium in media:
        dropped = sum(port.dropped for port in medium.ports)
        if dropped and not floods:
            reasons.append(f"{medium.name} bus: {dropped} frames lost in full transmit queues")
        if medium.collisions and not collides:
            reasons.append(f"{medium.name} bus: two senders with the same CAN id at once, {medium.collisions} times")
    cut = any(medium.cuts for medium in media)
    if not rig.gateway.injectors and not cut and not rig.controller.completed:
        reasons.append("the motion was given up without a fault")
    return reasons
