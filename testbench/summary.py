"""The result of a scenario as one JSON document, and as a short text for the terminal.

The document is the contract of `exo-hil run --json` and of summary.json in the result folder; keys may be added, none
changes its meaning. It is strict JSON: a number that is not finite raises, it is never written as NaN or null.
Its types are in testbench.document.
"""

import json
import platform
from collections.abc import Sequence
from importlib import metadata
from math import isfinite
from typing import Final

from canopen_exo.bus.frame import Frame
from canopen_exo.bus.node import NEVER
from canopen_exo.bus.trace import candump_frame, trace_hash
from fi_gateway.activation import Activation
from testbench.document import CountEntry, EventEntry, InjectionEntry, JointEntry, Summary, ViolationEntry
from testbench.errors import BenchError
from testbench.golden import JointComparison
from testbench.record import RunRecord
from testbench.verdict import UNITS, Judgement, Violation

MOST_LINES: Final = 28
"""Lines of `summary_text`: what fits on a small terminal with the prompt."""


def summary_document(
    scenario: str,
    seed: int,
    golden: RunRecord,
    faulted: RunRecord,
    judgement: Judgement,
    *,
    injectors: int,
    sim_time_s: float,
    wall_time_s: float,
) -> Summary:
    """The document of a judged pair of runs. injectors: how many could act; sim_time_s, wall_time_s: of all runs made.

    Raises BenchError when any number is not finite.
    """
    document: Summary = {
        "scenario": scenario,
        "seed": seed,
        "valid": judgement.outcome != "invalid",
        "invalid_reasons": [
            *(f"golden run: {reason}" for reason in golden.invalid_reasons),
            *(f"golden run: {one.joint} leaves its range without a fault" for one in judgement.golden_failures),
            *(f"faulted run: {reason}" for reason in faulted.invalid_reasons),
        ],
        "verdict": "pass" if judgement.passed else "fail",
        "outcome": judgement.outcome,
        "completed": faulted.completed,
        "sim_time_s": sim_time_s,
        "wall_time_s": wall_time_s,
        "x_realtime": sim_time_s / wall_time_s if wall_time_s > 0 else 0.0,
        "time0_s": faulted.time0_ns / 1e9,
        "power_up_s": (faulted.power_up_ns - faulted.time0_ns) / 1e9,
        "duration_s": faulted.duration_s,
        "tolerance_deg": judgement.tolerance_deg,
        "bus": {
            bus.name: {"frames": bus.frames, "load": bus.load, "queue_overflows": bus.queue_overflows}
            for bus in faulted.buses
        },
        "trace_hash": {"golden": trace_hash(golden.rows), "faulted": trace_hash(faulted.rows)},
        "injectors": injectors,
        "counts": _counts(faulted.activations),
        "injections": [_injection(activation, faulted.time0_ns) for activation in faulted.activations],
        "joints": {
            joint: _joint(one, held)
            for (joint, one), held in zip(judgement.comparison.items(), _held(faulted, judgement), strict=True)
        },
        "golden": {
            "tracking_rmse_rad": dict(judgement.tracking_rmse_rad),
            "errors": _violations(judgement.golden_errors),
            "failures": _violations(judgement.golden_failures),
        },
        "errors": _violations(judgement.errors),
        "failures": _violations(judgement.failures),
        "failures_at_3deg": _violations(judgement.failures_at_3deg),
        "expectations": [{"text": one.text, "found": one.found, "met": one.met} for one in judgement.expectations],
        "events": [
            {"time_s": one.time_s, "node": one.node, "kind": one.kind, "text": one.text} for one in faulted.notes
        ],
        "source": faulted.source,
        "versions": versions(),
    }
    check_finite(document)
    return document


def summary_json(document: Summary) -> str:
    """The document as strict JSON, two spaces a level, keys in the order of the contract."""
    return json.dumps(document, indent=2, allow_nan=False, ensure_ascii=False) + "\n"


def check_finite(value: object, path: str = "") -> None:
    """Raise BenchError naming the first number of a document that JSON cannot hold."""
    if isinstance(value, dict):
        for key, item in value.items():
            check_finite(item, f"{path}.{key}" if path else str(key))
    elif isinstance(value, list | tuple):
        for index, item in enumerate(value):
            check_finite(item, f"{path}[{index}]")
    elif isinstance(value, float) and not isfinite(value):
        raise BenchError(f"summary: {path} is {value}, allowed are finite numbers; the run went wrong before it")


def versions() -> dict[str, str]:
    """What the numbers depend on: this project, Python, and the packages that compute; those installed."""
    found = {"python": platform.python_version()}
    for name in ("exo-hil", "numpy", "mujoco", "mujoco-core"):
        try:
            found[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            continue
    return found


def _counts(activations: Sequence[Activation]) -> CountEntry:
    return {
        "activated": len(activations),
        "injected": sum(one.frames_injected + one.attempts_disturbed for one in activations),
        "manifested": sum(one.manifested for one in activations),
    }


def _injection(one: Activation, time0_ns: int) -> InjectionEntry:
    return {
        "injector": one.injector,
        "index": one.index,
        "due_s": (one.due_ns - time0_ns) / 1e9,
        "start_s": (one.start_ns - time0_ns) / 1e9,
        "duration_s": None if one.duration_ns >= NEVER else one.duration_ns / 1e9,
        "end_s": None if one.end_ns >= NEVER else (one.end_ns - time0_ns) / 1e9,
        "frames": one.manifested,
        "frames_changed": one.frames_changed,
        "frames_lost": one.frames_lost,
        "frames_delayed": one.frames_delayed,
        "frames_inserted": one.frames_inserted,
        "frames_injected": one.frames_injected,
        "frames_seen": one.frames_seen,
        "frames_unfit": one.frames_unfit,
        "attempts_seen": one.attempts_seen,
        "attempts_disturbed": one.attempts_disturbed,
        "saturated": one.saturated,
        "signal": one.signal,
        "cause": one.cause,
        "first_frame_s": None if one.first_ns >= NEVER else (one.first_ns - time0_ns) / 1e9,
        "first_before": _frame(one.first_before),
        "first_after": _frame(one.first_after),
    }


def _frame(frame: Frame | None) -> str | None:
    return None if frame is None else candump_frame(frame)


def _held(faulted: RunRecord, judgement: Judgement) -> list[int]:
    return faulted.held_cycles or [0] * len(judgement.comparison)


def _joint(one: JointComparison, held_cycles: int) -> JointEntry:
    return {
        "rmse_position_rad": one.rmse_position_rad,
        "rmse_velocity_rad_s": one.rmse_velocity_rad_s,
        "rmse_torque_nm": one.rmse_torque_nm,
        "min_angle_deg": one.min_angle_deg,
        "max_angle_deg": one.max_angle_deg,
        "max_speed_rpm": one.max_speed_rpm,
        "max_torque_nm": one.max_torque_nm,
        "held_cycles": held_cycles,
    }


def _violations(found: Sequence[Violation]) -> list[ViolationEntry]:
    return [
        {"joint": one.joint, "kind": one.kind, "time_s": one.time_s, "value": one.value, "limit": one.limit}
        for one in found
    ]


def summary_text(document: Summary) -> str:
    """The document for people: at most MOST_LINES lines of plain text for six joints, columns aligned."""
    load = ", ".join(f"{name} bus {100 * bus['load']:.0f} %" for name, bus in document["bus"].items())
    heading = document["verdict"].upper() if document["valid"] else "INVALID"
    hollow = _hollow_lines(document)
    heading += " (no fault acted)" if hollow else ""
    head = [
        f"{heading}  {document['scenario']}, seed {document['seed']}: {_outcome_text(document)}{_unmet_text(document)}",
        *hollow,
        f"      {document['sim_time_s']:.1f} s simulated in {document['wall_time_s']:.2f} s "
        f"({document['x_realtime']:.1f} x real time); {load}",
        *_real_time_lines(document),
        *_replay_lines(document),
        *_few([f"      {reason}" for reason in document["invalid_reasons"]], 2, "reasons"),
        *_overflow_lines(document),
        *_few([_event_line(event) for event in document["events"]], 3, "events"),
    ]
    tail = [
        *_joint_lines(document),
        _tracking_line(document["golden"]["tracking_rmse_rad"]),
        *_few(_violation_lines("golden error", document["golden"]["errors"]), 2, "golden errors"),
        *_few(_violation_lines("failure", document["failures"]), 3, "failures"),
        *_few(_violation_lines("error", document["errors"]), 3, "errors"),
        *_expectation_lines(document),
    ]
    injections = _injection_lines(document)
    room = max(MOST_LINES - len(head) - len(tail) - 1, 1)
    return "\n".join([*head, injections[0], *_few(injections[1:], room, "injections"), *tail]) + "\n"


def _overflow_lines(document: Summary) -> list[str]:
    """Frames that full queues have dropped because of a fault; without one they are a reason why a run is invalid."""
    if not document["valid"]:
        return []
    return [
        f"      {name} bus: {bus['queue_overflows']} frames lost in full transmit queues, as faults had it"
        for name, bus in document["bus"].items()
        if bus["queue_overflows"]
    ]


def _hollow_lines(document: Summary) -> list[str]:
    """Why a pass says nothing of faults, unless an `expect:` line has decided on that, and which line would fail it."""
    counts, injectors = document["counts"], document["injectors"]
    if not injectors or counts["manifested"] or document["verdict"] != "pass" or not document["valid"]:
        return []
    quantity = "manifested" if counts["activated"] else "injections"
    if any(entry["text"].split()[0] == quantity for entry in document["expectations"]):
        return []
    why = "no activation changed a frame" if counts["activated"] else f"injectors: {injectors}, none was activated"
    return [f"      {why}; `expect: [{quantity} >= 1]` makes that a failed verdict"]


def _unmet_text(document: Summary) -> str:
    """What fails a run in which nothing else did."""
    unmet = sum(not entry["met"] for entry in document["expectations"])
    if not unmet or document["failures"] or not document["valid"]:
        return ""
    return f"; {unmet} of {len(document['expectations'])} expectations not met"


def _real_time_lines(document: Summary) -> list[str]:
    lines = []
    timing = document.get("realtime")
    if timing is not None:
        lines.append(
            f"      real time: {timing['late_cycles']} of {timing['cycles']} cycles late, "
            f"the latest by {timing['worst_late_ms']:.1f} ms"
        )
    if document["source"] != "plant":
        lines.append("      angles, speeds and torques are what the drives' frames said (source: bus)")
    return lines


def _replay_lines(document: Summary) -> list[str]:
    replay = document.get("replay")
    if replay is None:
        return []
    return [f"      replay: {'the same frames as' if replay['same'] else 'other frames than'} in the recorded run"]


def _tracking_line(golden: dict[str, float]) -> str:
    if not golden:
        return "golden run: tracking unknown, the controller is foreign"
    worst = max(golden, key=lambda joint: golden[joint])
    return f"golden run: tracking RMSE at most {golden[worst]:.4f} rad ({worst})"


def _outcome_text(document: Summary) -> str:
    return {
        "invalid": "the run is invalid and proves nothing",
        "failure": "failure, a joint went beyond its range of travel",
        "detected_safe": "detected, drives or controller ended the motion before a failure",
        "error": "no failure, but a torque or speed limit was exceeded",
        "masked": "masked, faults were injected and every limit was kept",
        "not_manifested": "faults were activated but changed no frame",
        "not_activated": "no fault was activated",
    }[document["outcome"]]


def _event_line(event: EventEntry) -> str:
    line = f"      at {event['time_s']:.3f} s  {event['node']}: {event['text']}"
    return line if len(line) <= 100 else f"{line[:97]}..."


def _injection_lines(document: Summary) -> list[str]:
    counts, injections = document["counts"], document["injections"]
    if not injections:
        return ["injections: none"]
    name = max(len(one["injector"]) for one in injections)
    signal = max(len(one["signal"] or "whole frame") for one in injections)
    seen = sum(one["frames_seen"] for one in injections)
    lines = []
    for one in injections:
        end = "   to the end" if one["end_s"] is None else f"..{one['end_s']:8.3f} s "
        added = f", {one['frames_inserted']} inserted" if one["frames_inserted"] else ""
        cut = f", {one['saturated']} cut at the range" if one["saturated"] else ""
        lines.append(
            f"  {one['injector']:<{name}}  {one['signal'] or 'whole frame':<{signal}}  {one['start_s']:8.3f} {end}"
            f"  {_hit(one)}{added}{cut}  {one['cause']}"
        )
    inserted = sum(one["frames_inserted"] for one in injections)
    more = f", {inserted} inserted" if inserted else ""
    disturbed = sum(one["attempts_disturbed"] for one in injections)
    more += f", {disturbed} attempts disturbed" if disturbed else ""
    hit = counts["manifested"] - inserted - disturbed
    return [f"injections: {counts['activated']} activated, {hit} of {seen} frames hit{more}", *lines]


def _hit(one: InjectionEntry) -> str:
    """How many frames, or attempts to send one, were hit."""
    if one["attempts_seen"]:
        return f"{one['attempts_disturbed']:5d} of {one['attempts_seen']} attempts disturbed"
    if one["attempts_disturbed"]:
        return f"{one['attempts_disturbed']:5d} times disturbed"
    hit = one["frames"] - one["frames_inserted"]
    return f"{hit:5d} of {one['frames_seen']} frames {_what(one)}"


def _what(one: InjectionEntry) -> str:
    """What became of the frames that came, in one word."""
    words = ("changed", "lost", "delayed")
    counts = (one["frames_changed"], one["frames_lost"], one["frames_delayed"])
    happened = [word for word, count in zip(words, counts, strict=True) if count]
    return "changed" if not happened else happened[0] if len(happened) == 1 else "hit"


def _joint_lines(document: Summary) -> list[str]:
    width = max(len(joint) for joint in (*document["joints"], "against golden"))
    lines = [
        f"{'against golden':<{width}}  RMSE:  rad    rad/s      N m  |  extremes: deg            rpm      N m",
    ]
    for joint, one in document["joints"].items():
        lines.append(
            f"  {joint:<{width - 2}}  {one['rmse_position_rad']:10.4f} {one['rmse_velocity_rad_s']:8.3f} "
            f"{one['rmse_torque_nm']:8.2f}  |  {one['min_angle_deg']:7.1f} .. {one['max_angle_deg']:6.1f}  "
            f"{one['max_speed_rpm']:8.1f} {one['max_torque_nm']:8.1f}"
        )
    return lines


def _violation_lines(what: str, entries: list[ViolationEntry]) -> list[str]:
    if not entries:
        return []
    joint = max(len(one["joint"]) for one in entries)
    return [
        f"{what + ':':<8} {one['joint']:<{joint}}  {one['kind'].replace('_', ' '):<9}  from {one['time_s']:6.3f} s, "
        f"worst {one['value']:.1f} {UNITS[one['kind']]}, limit {one['limit']:g} {UNITS[one['kind']]}"
        for one in entries
    ]


def _expectation_lines(document: Summary) -> list[str]:
    entries = document["expectations"]
    if not entries:
        return []
    unmet = [f"  not met: {one['text']} (found {one['found']:.4g})" for one in entries if not one["met"]]
    return [f"expected: {len(entries) - len(unmet)} of {len(entries)} met", *_few(unmet, 2, "expectations not met")]


def _few(lines: list[str], most: int, what: str) -> list[str]:
    """At most `most` lines; the last one says how many are left out, when there are more."""
    if len(lines) <= most:
        return lines
    shown = most - 1
    return [*lines[:shown], f"  and {len(lines) - shown} more {what}, see summary.json"]
