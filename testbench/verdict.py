"""Errors, failures, outcome and verdict of a faulted run.

Source: ESREL 2020, table 1. Beyond a torque or speed is an error, beyond an angle is a failure:
torque: |command of the high-level controller before its clamp|, each cycle (after the clamp it could not occur);
speed and angle: the plant's truth at 1 kHz. Any single sample counts, for every joint, in [0, duration] only. "Beyond"
is strict: a value that equals its limit is inside. A failure is an angle beyond its limit by more than `tolerance`.
Comparisons are made in rad and rad/s; entries are written in the table's units: N m, rpm, deg.
"""

import math
import operator
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from hlc.limits import JointLimits
from testbench.errors import BenchError
from testbench.expect import Expectation
from testbench.golden import JointComparison, check_joints, clip, compare, tracking_rmse
from testbench.record import Array, Commands, RunRecord, Truth, motion_rows

UNITS: Final = {"torque": "N m", "speed": "rpm", "min_angle": "deg", "max_angle": "deg"}
"""Kind of entry -> unit of its value and limit."""

SOFT_PINS_RAD: Final = math.radians(3.0)
"""Failures are counted at this tolerance too, because soft pins yield (about 3 deg)."""

FAIL_ON: Final = ("failure", "error")

_RAD_TO_DEG: Final = 180 / math.pi
_RAD_S_TO_RPM: Final = 30 / math.pi

_OPERATORS: Final[Mapping[str, Callable[[float, float], bool]]] = {
    "<": operator.lt,
    "<=": operator.le,
    ">": operator.gt,
    ">=": operator.ge,
    "==": operator.eq,
    "!=": operator.ne,
}


@dataclass(frozen=True, slots=True)
class Violation:
    """One joint beyond one limit. kind: a key of UNITS, which gives the unit of value and limit.

    time_s: first sample beyond it, from time 0; value: the worst of the run (a magnitude for torque and speed);
    limit: the table's, without tolerance.
    """

    joint: str
    kind: str
    time_s: float
    value: float
    limit: float


@dataclass(frozen=True, slots=True)
class ExpectationResult:
    """An `expect:` line and what was found. found, value: SI, or a count."""

    text: str
    value: float
    found: float
    met: bool


@dataclass(frozen=True, slots=True)
class Judgement:
    """What is said about a pair of runs.

    outcome: invalid, failure, detected_safe (drive or controller ended the motion before a failure), error,
    not_activated, not_manifested (no frame really changed) or masked, the first of these that holds; passed: the
    verdict.
    golden_errors, golden_failures: of the golden run itself; a golden run with a failure makes the pair invalid.
    """

    comparison: dict[str, JointComparison]
    tracking_rmse_rad: dict[str, float]
    errors: tuple[Violation, ...]
    failures: tuple[Violation, ...]
    failures_at_3deg: tuple[Violation, ...]
    golden_errors: tuple[Violation, ...]
    golden_failures: tuple[Violation, ...]
    expectations: tuple[ExpectationResult, ...]
    tolerance_deg: float
    outcome: str
    passed: bool


def judge(
    joints: tuple[str, ...],
    limits: Mapping[str, JointLimits],
    golden: RunRecord,
    faulted: RunRecord,
    *,
    tolerance_rad: float = 0.0,
    fail_on: str = "failure",
    expectations: Sequence[Expectation] = (),
) -> Judgement:
    """Judge the faulted run. limits: by joint name; tolerance_rad: how far beyond an angle is no failure yet.

    The verdict fails for any failure, for an expectation that is not met, for an invalid run, and, with
    fail_on "error", for any error. Raises BenchError for an unknown fail_on, joint or quantity.
    """
    if fail_on not in FAIL_ON:
        raise BenchError(f"fail_on: {fail_on!r} given, allowed are {' and '.join(FAIL_ON)}")
    if not (math.isfinite(tolerance_rad) and tolerance_rad >= 0):
        raise BenchError(f"tolerance: {tolerance_rad} rad given, allowed is 0 or more")
    duration_s = faulted.duration_s
    comparison = compare(joints, golden.truth, faulted.truth, duration_s)
    tracking = tracking_rmse(joints, golden.truth, golden.commands, duration_s)
    errors = limit_errors(joints, limits, faulted.truth, faulted.commands, duration_s)
    failures = limit_failures(joints, limits, faulted.truth, duration_s, tolerance_rad)
    found = quantities(comparison, tracking, len(errors), len(failures), faulted)
    results = tuple(evaluate(expectation, found) for expectation in expectations)
    golden_failures = limit_failures(joints, limits, golden.truth, duration_s, tolerance_rad)
    outcome = _outcome(golden.valid and faulted.valid and not golden_failures, errors, failures, faulted)
    passed = (
        outcome not in ("invalid", "failure")
        and not (errors and fail_on == "error")
        and all(result.met for result in results)
    )
    return Judgement(
        comparison=comparison,
        tracking_rmse_rad=tracking,
        errors=errors,
        failures=failures,
        failures_at_3deg=limit_failures(joints, limits, faulted.truth, duration_s, SOFT_PINS_RAD),
        golden_errors=limit_errors(joints, limits, golden.truth, golden.commands, duration_s),
        golden_failures=golden_failures,
        expectations=results,
        tolerance_deg=table_value(math.degrees(tolerance_rad)),
        outcome=outcome,
        passed=passed,
    )


def _outcome(valid: bool, errors: tuple[Violation, ...], failures: tuple[Violation, ...], faulted: RunRecord) -> str:
    """The worst that can be said, worst first."""
    if not valid:
        return "invalid"
    if failures:
        return "failure"
    if not faulted.completed:
        return "detected_safe"
    if errors:
        return "error"
    if not faulted.activations:
        return "not_activated"
    return "masked" if any(one.manifested for one in faulted.activations) else "not_manifested"


def limit_errors(
    joints: tuple[str, ...], limits: Mapping[str, JointLimits], truth: Truth, commands: Commands, duration_s: float
) -> tuple[Violation, ...]:
    """Commands beyond a torque, joints beyond a speed: one entry a joint and kind, in order of their first sample."""
    check_joints(joints, commands.tau_command)
    check_joints(joints, truth.dq)
    truth = clip(truth, duration_s)
    rows = motion_rows(commands.t_s, duration_s)
    t_command, torque = commands.t_s[rows], np.abs(commands.tau_command[rows])
    speed = np.abs(truth.dq)
    found: list[Violation | None] = []
    for k, joint in enumerate(joints):
        limit = _limits_of(joint, limits)
        beyond = torque[:, k] > limit.torque_nm
        found.append(_beyond(joint, "torque", t_command, torque[:, k], beyond, limit.torque_nm, 1.0))
        beyond = speed[:, k] > limit.speed_rad_s
        found.append(_beyond(joint, "speed", truth.t_s, speed[:, k], beyond, limit.speed_rad_s, _RAD_S_TO_RPM))
    return _in_order(found)


def limit_failures(
    joints: tuple[str, ...], limits: Mapping[str, JointLimits], truth: Truth, duration_s: float, tolerance_rad: float
) -> tuple[Violation, ...]:
    """Joints beyond an angle by more than the tolerance: one entry a joint and side, in order of their first sample."""
    check_joints(joints, truth.q)
    truth = clip(truth, duration_s)
    found: list[Violation | None] = []
    for k, joint in enumerate(joints):
        limit, q = _limits_of(joint, limits), truth.q[:, k]
        low, high = limit.min_angle_rad, limit.max_angle_rad
        found.append(_beyond(joint, "min_angle", truth.t_s, q, q < low - tolerance_rad, low, _RAD_TO_DEG))
        found.append(_beyond(joint, "max_angle", truth.t_s, q, q > high + tolerance_rad, high, _RAD_TO_DEG))
    return _in_order(found)


def _limits_of(joint: str, limits: Mapping[str, JointLimits]) -> JointLimits:
    if joint not in limits:
        raise BenchError(f"limits: none given for joint {joint!r}; there are limits for {', '.join(limits)}")
    return limits[joint]


def _beyond(
    joint: str, kind: str, t_s: Array, values: Array, beyond: NDArray[np.bool_], limit: float, to_unit: float
) -> Violation | None:
    """The entry of one joint and kind, or None when no sample is beyond."""
    if not np.any(beyond):
        return None
    worst = values[beyond].min() if kind == "min_angle" else values[beyond].max()
    first = float(t_s[int(np.argmax(beyond))])
    return Violation(joint, kind, first, float(worst) * to_unit, table_value(limit * to_unit))


def table_value(value: float) -> float:
    """A limit as the table prints it: 65.2 rpm, not 65.20000000000002 after the way through rad/s."""
    return round(value, 9)


def _in_order(found: list[Violation | None]) -> tuple[Violation, ...]:
    return tuple(sorted((entry for entry in found if entry is not None), key=lambda entry: entry.time_s))


def quantities(
    comparison: Mapping[str, JointComparison],
    tracking_rmse_rad: Mapping[str, float],
    errors: int,
    failures: int,
    faulted: RunRecord,
) -> dict[str, float]:
    """Everything an `expect:` line may name, in SI: rad, rad/s, N m, or a count. No tracking without a reference.

    `golden.tracking_rmse` is that of the worst joint; with `.right_knee` behind it, that of one joint.
    """
    found: dict[str, float] = {
        "errors": float(errors),
        "failures": float(failures),
        "injections": float(len(faulted.activations)),
        "manifested": float(sum(one.manifested for one in faulted.activations)),
        "completed": float(faulted.completed),
    }
    if tracking_rmse_rad:
        found["golden.tracking_rmse"] = max(tracking_rmse_rad.values())
    for joint, value in tracking_rmse_rad.items():
        found[f"golden.tracking_rmse.{joint}"] = value
    for joint, one in comparison.items():
        found[f"joints.{joint}.rmse_position"] = one.rmse_position_rad
        found[f"joints.{joint}.rmse_velocity"] = one.rmse_velocity_rad_s
        found[f"joints.{joint}.rmse_torque"] = one.rmse_torque_nm
        found[f"joints.{joint}.min_angle"] = one.min_angle_deg / _RAD_TO_DEG
        found[f"joints.{joint}.max_angle"] = one.max_angle_deg / _RAD_TO_DEG
        found[f"joints.{joint}.max_speed"] = one.max_speed_rpm / _RAD_S_TO_RPM
        found[f"joints.{joint}.max_torque"] = one.max_torque_nm
    return found


def evaluate(expectation: Expectation, found: Mapping[str, float]) -> ExpectationResult:
    """Whether one `expect:` line holds; raises BenchError for a quantity or an operator that does not exist."""
    if expectation.path not in found:
        raise BenchError(f"expect: unknown quantity {expectation.path!r}, allowed are {', '.join(sorted(found))}")
    if expectation.operator not in _OPERATORS:
        raise BenchError(f"expect: operator {expectation.operator!r} given, allowed are {' '.join(_OPERATORS)}")
    value = found[expectation.path]
    met = _OPERATORS[expectation.operator](value, expectation.value)
    return ExpectationResult(expectation.text, expectation.value, value, met)
