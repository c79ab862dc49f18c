"""The golden run as the measure: how far the faulted run is from it, and how well it tracks the gait itself.

Source: ESREL 2020, experiment 1 (RMSE of position, velocity, torque, faulted against golden). RMSE is the square root
of the mean square difference over all samples of the motion, [0, duration] at 1 kHz, from the plant's truth.
Angles are compared by plain difference: a knee that has been spun through a whole turn is 2 pi away from where it was,
not back; nothing is wrapped.
"""

from dataclasses import dataclass

import numpy as np

from canopen_exo.bus.medium import Transmission
from testbench.errors import BenchError
from testbench.record import Array, Commands, Truth, motion_rows

_ROUNDING_S = 0.5e-9  # instants are whole nanoseconds held as float64 seconds


@dataclass(frozen=True, slots=True)
class JointComparison:
    """One joint, faulted run. rmse_*: against the golden run; the rest: extremes reached by the faulted run itself."""

    rmse_position_rad: float
    rmse_velocity_rad_s: float
    rmse_torque_nm: float
    min_angle_deg: float
    max_angle_deg: float
    max_speed_rpm: float
    max_torque_nm: float


def rmse(a: Array, b: Array) -> Array:
    """Root mean square difference of two (n, joints) arrays over their rows; (joints,)."""
    return np.asarray(np.sqrt(np.mean(np.square(a - b), axis=0)), dtype=np.float64)


def compare(joints: tuple[str, ...], golden: Truth, faulted: Truth, duration_s: float) -> dict[str, JointComparison]:
    """The faulted run against the golden run, by joint.

    Raises BenchError when the two were not sampled at the same instants.
    """
    golden, faulted = clip(golden, duration_s), clip(faulted, duration_s)
    if golden.t_s.shape != faulted.t_s.shape or np.max(np.abs(golden.t_s - faulted.t_s)) > _ROUNDING_S:
        raise BenchError(
            f"golden and faulted run: sampled at different instants ({golden.t_s.size} and {faulted.t_s.size} samples "
            f"in {duration_s:g} s); both must be recorded on the same 1 kHz grid from time 0"
        )
    check_joints(joints, faulted.q)
    check_joints(joints, golden.q)
    position, velocity = rmse(golden.q, faulted.q), rmse(golden.dq, faulted.dq)
    torque = rmse(golden.tau, faulted.tau)
    low, high = np.degrees(faulted.q.min(axis=0)), np.degrees(faulted.q.max(axis=0))
    speed = np.abs(faulted.dq).max(axis=0) * 30 / np.pi
    peak = np.abs(faulted.tau).max(axis=0)
    return {
        joint: JointComparison(
            float(position[k]),
            float(velocity[k]),
            float(torque[k]),
            float(low[k]),
            float(high[k]),
            float(speed[k]),
            float(peak[k]),
        )
        for k, joint in enumerate(joints)
    }


def tracking_rmse(joints: tuple[str, ...], truth: Truth, commands: Commands, duration_s: float) -> dict[str, float]:
    """Reference against truth [rad], by joint, over the control instants of the motion.

    Each reference is compared with the sample the drives latch at that SYNC: the last finished plant step at or before
    the instant. Raises BenchError when no control instant of the motion has a sample. Empty without a reference.
    """
    if not commands.has_reference:
        return {}
    check_joints(joints, truth.q)
    check_joints(joints, commands.q_ref)
    latest = np.searchsorted(truth.t_s, commands.t_s + _ROUNDING_S, side="right") - 1
    wanted = motion_rows(commands.t_s, duration_s) & (latest >= 0)
    if not np.any(wanted):
        raise BenchError("tracking: no control instant of the motion has a plant sample; record both from time 0 on")
    errors = rmse(commands.q_ref[wanted], truth.q[latest[wanted]])
    return {joint: float(errors[k]) for k, joint in enumerate(joints)}


def clip(truth: Truth, duration_s: float) -> Truth:
    """The part of a truth that lies in the motion, [0, duration]; raises BenchError when there is none."""
    rows = motion_rows(truth.t_s, duration_s)
    if not np.any(rows):
        raise BenchError(f"truth: no sample in the motion, 0..{duration_s:g} s; t_s must count from time 0")
    return Truth(truth.t_s[rows], truth.q[rows], truth.dq[rows], truth.tau[rows])


def check_joints(joints: tuple[str, ...], values: Array) -> None:
    """Raise BenchError unless the array has one column a joint."""
    if values.shape[1] != len(joints):
        raise BenchError(f"joints: {len(joints)} names given ({', '.join(joints)}) for {values.shape[1]} columns")


@dataclass(frozen=True, slots=True)
class Difference:
    """Where two traces part. index: of the first row that differs; time_ns: the earlier of the two rows, loop's clock.

    golden, faulted: the rows; None for a trace that ends there.
    """

    index: int
    time_ns: int
    golden: Transmission | None
    faulted: Transmission | None


def first_difference(golden: list[Transmission], faulted: list[Transmission]) -> Difference | None:
    """The first row in which two traces differ (time, bus, sender or frame); None when they are equal.

    Up to the first fault that manifests, a faulted run is its golden run, row by row.
    """
    for index, (a, b) in enumerate(zip(golden, faulted, strict=False)):
        if a.end_ns != b.end_ns or a.bus != b.bus or a.sender != b.sender or a.frame != b.frame:
            return Difference(index, min(a.end_ns, b.end_ns), a, b)
    index = min(len(golden), len(faulted))
    if len(golden) > index:
        return Difference(index, golden[index].end_ns, golden[index], None)
    if len(faulted) > index:
        return Difference(index, faulted[index].end_ns, None, faulted[index])
    return None
