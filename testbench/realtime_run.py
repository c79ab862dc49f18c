"""A scenario run against the clock: golden and faulted run as real processes, with the same result as in lock-step.

The two runs of a pair are not identical up to the fault, as in lock-step: threads of the machine decide when a frame
leaves, and every run has its own trace. Their plants stand on the same 1 ms grid from time 0, so that truth is compared
instant by instant all the same; the difference of two golden runs shows how much of it is the machine's.
"""

import logging
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final, TypeVar

from canopen_exo.bus.node import NEVER, SECOND
from fi_gateway.control_socket import ask_listing
from fi_gateway.errors import FaultError
from testbench.child import Process, ProcessError
from testbench.document import RealTimeEntry, RealTimeRunEntry
from testbench.errors import BenchError, RefusedError
from testbench.merge import IncompleteError, add_reasons, merge, time_zero_of
from testbench.parts import PartError, read_gateway, read_hlc, read_joints
from testbench.record import RunRecord
from testbench.run import CHUNK_NS, LEAVE_NS, START_NS, Progress, Result, result_of
from testbench.scenario import Scenario
from testbench.supervisor import Setup, Supervisor, check_status_readers
from testbench.timing import Timing, TimingLimits, judge_timing
from testbench.watch import too_busy

TAIL_NS: Final = SECOND // 2
"""How long a rig without our controller is listened to after the motion."""

FOREIGN_START_NS: Final = 60 * SECOND
"""How long a foreign controller may take to time 0."""

_LOG: Final = logging.getLogger(__name__)

P = TypeVar("P")


@dataclass(frozen=True, slots=True)
class RealTimeRun:
    """One run and how well it kept time."""

    record: RunRecord
    timing: Timing


def run_realtime(
    scenario: Scenario,
    buses: tuple[str, str] | None = None,
    without: frozenset[str] = frozenset(),
    *,
    fifo: bool = False,
    places: tuple[str, str] = ("127.0.0.1:0", ""),
    control_frames: str = "",
    progress: Progress = lambda share: None,
    announce: Callable[[str], None] = lambda text: None,
) -> Result:
    """Golden run, faulted run, verdict. buses: controller and drive bus, None for an own hub; without: foreign parts.

    places: where own hub and live control listen; control_frames: see Setup for both;
    announce: told what foreign software is waited for.
    Raises BenchError when a run gives nothing to judge: a process died, a part is missing, the motion never began;
    RefusedError when there is no run, because an address or a bus cannot be had.
    """
    check_without(scenario, without)
    started = time.perf_counter()
    listen, control = places
    setup = Setup(
        scenario,
        buses,
        without,
        faults=False,
        keep_parts=True,
        fifo=fifo,
        listen=listen,
        control=control,
        control_frames=control_frames,
    )
    if without and buses is None:  # one hub for both runs, so that foreign software stays on its buses
        with Supervisor(setup) as host:
            host.start_hub()
            setup = replace(setup, buses=host.buses)
            golden, faulted = _run_pair(setup, progress, announce, host.processes["hub"])
    else:
        golden, faulted = _run_pair(setup, progress, announce, None)
    result = pair_result(scenario, golden, faulted, time.perf_counter() - started)
    if "gateway" in without:
        result.document["injectors"] = 0  # not used
    return result


def pair_result(scenario: Scenario, golden: RealTimeRun, faulted: RealTimeRun, wall_time_s: float) -> Result:
    """The pair judged, and what is said about it."""
    sim_time_s = sum(run.record.duration_s + scenario.motion.stride_ns / 1e9 for run in (golden, faulted))
    result = result_of(scenario, golden.record, faulted.record, sim_time_s=sim_time_s, wall_time_s=wall_time_s)
    result.document["realtime"] = _timing_entry(limits_in(scenario), golden.timing, faulted.timing)
    return result


def _run_pair(
    setup: Setup, progress: Progress, announce: Callable[[str], None], hub: Process | None
) -> tuple[RealTimeRun, RealTimeRun]:
    """Golden and faulted run."""
    if "gateway" in setup.without and setup.scenario.injectors:
        announce(f"injectors {', '.join(setup.scenario.injectors)}: not used, the gateway is left out")
    golden = run_once(setup, lambda share: progress(0.5 * share), announce=announce, hub=hub)
    faulted = run_once(
        replace(setup, faults=True), lambda share: progress(0.5 + 0.5 * share), announce=announce, hub=hub
    )
    return golden, faulted


def run_once(
    setup: Setup,
    progress: Progress = lambda share: None,
    *,
    announce: Callable[[str], None] = lambda text: None,
    hub: Process | None = None,
    when_ready: Callable[[Supervisor], None] = lambda rig: None,
) -> RealTimeRun:
    """One run from power-up to disabled drives, its parts merged and its timing judged. Raises BenchError.

    announce: told what foreign software is waited for; hub: that the buses are on, where it serves more than this run;
    when_ready: called when all processes are heard, before time 0.
    """
    which = "faulted run" if setup.faults else "golden run"
    try:
        with Supervisor(setup, announce=lambda text: announce(f"{which}: {text}"), hub=hub) as rig:
            rig.start()
            when_ready(rig)
            _drive_through(rig, setup, progress)
            rig.stop()
            return _gather(rig, setup)
    except RefusedError:
        raise  # not of the run
    except BenchError as error:
        raise type(error)(f"{which}: {error}") from error


def limits_in(scenario: Scenario) -> TimingLimits:
    """The limits that stand in a scenario."""
    return TimingLimits(scenario.realtime.late_share, scenario.realtime.late_worst_ns)


def _drive_through(rig: Supervisor, setup: Setup, progress: Progress) -> None:
    """Until the controller ends, or a foreign one has walked for the time of the motion; always ends."""
    motion = setup.scenario.motion
    begun = rig.now()
    whole = motion.stride_ns + motion.duration_ns
    controller = rig.processes.get("hlc")
    start_ns = START_NS if controller is not None else FOREIGN_START_NS
    latest = begun + start_ns + whole + LEAVE_NS
    show_at = ask_at = begun

    def is_over(now: int) -> bool:
        nonlocal show_at, ask_at
        if now >= show_at:
            progress(min(1.0, (now - begun) / whole))
            show_at = now + CHUNK_NS
        if controller is not None:
            return controller.code is not None or now >= latest
        zero = rig.watch.time_zero
        if zero == NEVER and now >= ask_at:
            ask_at = now + CHUNK_NS
            zero = rig.watch.time_zero = _zero_of_gateway(rig)
        return now >= (latest if zero == NEVER else zero + motion.duration_ns + TAIL_NS)

    rig.run(is_over)
    if controller is not None and controller.code is None:
        raise ProcessError(f"the controller did not end within {(latest - begun) / 1e9:.0f} s")


def _zero_of_gateway(rig: Supervisor) -> int:
    """Time 0 as somebody told the gateway (`exo-hil fault start`); NEVER while nobody has."""
    if "gateway" not in rig.processes or not rig.control_address:
        return NEVER
    try:
        return ask_listing(rig.control_address, timeout_s=0.1).time_zero_ns
    except FaultError as error:
        _LOG.debug("%s", error)
        return NEVER


def _gather(rig: Supervisor, setup: Setup) -> RealTimeRun:
    """The parts of a rig that has ended. Raises PartError for one that is missing."""

    def read(name: str, reader: Callable[[Path], P]) -> P | None:
        if name in setup.without:
            return None
        try:
            return reader(rig.part(name))
        except PartError as error:
            raise PartError(f"{error}; {rig.processes[name].obituary()}") from error

    hlc, gateway, joints = read("hlc", read_hlc), read("gateway", read_gateway), read("joints", read_joints)
    plan, duration_ns = setup.scenario.plan, setup.scenario.motion.duration_ns
    try:
        record = merge(plan, duration_ns, hlc, gateway, joints, rig.rows)
    except IncompleteError as error:
        parts = {"hlc": hlc, "gateway": gateway, "joints": joints}
        lateness = {name: part.service.lateness for name, part in parts.items() if part is not None}
        served = [f"{name} {one.words()}" for name, one in lateness.items() if one.count]
        is_late = any(one.worst_ns >= plan.cycle_ns // 2 for one in lateness.values())
        remedy = f"; {too_busy(plan.cycle_ns)}" if is_late else ""
        raise IncompleteError(f"{error}; wake-ups served late: {'; '.join(served)}{remedy}") from error
    zero = time_zero_of(plan, hlc, gateway, rig.rows)
    cycles = duration_ns // plan.cycle_ns if hlc is None else int(hlc.cycles.size)
    timing = judge_timing(
        plan, zero, cycles, hlc, gateway, joints, rig.rows, missed=rig.missed, golden=not setup.faults
    )
    add_reasons(record, timing.reasons(limits_in(setup.scenario)), golden=not setup.faults)
    return RealTimeRun(record, timing)


def check_without(scenario: Scenario, without: frozenset[str]) -> None:
    """A foreign controller does not say what it follows, a foreign gateway not what it did: raises BenchError."""
    check_status_readers(Setup(scenario, without=without))
    for line in scenario.expect:
        needed = ""
        if "hlc" in without and line.path.startswith("golden.tracking_rmse"):
            needed = "controller"
        elif "gateway" in without and line.path in ("injections", "manifested"):
            needed = "gateway"
        if needed:
            raise BenchError(f"expect: {line.text!r} needs our {needed}, and it is left out; remove one of them")


def _timing_entry(limits: TimingLimits, golden: Timing, faulted: Timing) -> RealTimeEntry:
    return {
        "cycles": golden.cycles + faulted.cycles,
        "late_cycles": len(golden.late) + len(faulted.late),
        "worst_late_ms": max(golden.late_worst_ns, faulted.late_worst_ns) / 1e6,
        "limits": {"late_share": limits.late_share, "late_worst_ms": limits.late_worst_ns / 1e6},
        "golden": _timing_run(golden),
        "faulted": _timing_run(faulted),
    }


def _timing_run(timing: Timing) -> RealTimeRunEntry:
    return {
        "cycles": timing.cycles,
        "late_cycles": len(timing.late),
        "worst_late_ms": timing.late_worst_ns / 1e6,
        "worst": timing.worst,
        "not_judged": timing.unjudged,
        "lateness": {name: lateness.document() for name, lateness in timing.lateness.items()},
        "latency": {bus: latency.document() for bus, latency in timing.latency.items()},
    }
