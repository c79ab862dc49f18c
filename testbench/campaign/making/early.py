"""Early stop: a run that has failed goes on for a grace time only.

The truth of the plant is looked at every LOOK_NS of the loop's clock; the run ends at the first of these instants that
is the grace time or more after the first failure, whatever else pauses the loop. That a failure is one is said by the
scenario: an angle beyond its limit by more than the tolerance, within the motion.
"""

from typing import Final

from canopen_exo.bus.node import MS, NEVER
from hlc.limits import limits_of
from testbench.rig import Rig

LOOK_NS: Final = 10 * MS
"""The loop's chunks (`run.CHUNK_NS`) and the distance of snapshots are multiples of it."""


class FailureStop:
    """Watches one run. at_ns: when it ends early [ns, loop's clock], NEVER while there is no reason."""

    def __init__(self, joints: tuple[str, ...], tolerance_rad: float, grace_ns: int) -> None:
        limits = [limits_of(joint) for joint in joints]
        self._low: Final = [one.min_angle_rad - tolerance_rad for one in limits]
        self._high: Final = [one.max_angle_rad + tolerance_rad for one in limits]
        self._grace_ns: Final = grace_ns
        self._looked: int = 0
        self.at_ns: int = NEVER

    def reached(self, rig: Rig) -> bool:
        """Whether the run ends now; to be asked every LOOK_NS. One that is nearly over is left to end by itself."""
        if self.at_ns == NEVER:
            failed_ns = self._first_failure(rig)
            if failed_ns != NEVER:
                self.at_ns = -(-(failed_ns + self._grace_ns) // LOOK_NS) * LOOK_NS
        end_ns = rig.controller.time_zero + rig.params.duration_ns
        return self.at_ns <= rig.loop.now and self.at_ns < end_ns

    def _first_failure(self, rig: Rig) -> int:
        """When a joint first left its range, among the samples not looked at yet; NEVER for not at all."""
        zero, truth = rig.controller.time_zero, rig.rack.truth
        first, self._looked = self._looked, len(truth)
        if zero == NEVER:
            return NEVER
        for at in range(first, len(truth)):
            row = truth[at]
            if zero <= row.time_ns <= zero + rig.params.duration_ns:
                for angle, low, high in zip(row.q, self._low, self._high, strict=True):
                    if angle < low or angle > high:
                        return row.time_ns
        return NEVER
