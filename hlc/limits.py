"""What the wearer and the exoskeleton must not exceed, per joint.

Source: "Model-based Fault Injection Experiments for the Safety Analysis of Exoskeleton System" (ESREL 2020), table 1.
The table prints -30 deg as the ankle's maximum; its text says 30 deg, which is used here.
Signs: hip flexion +, knee flexion -, ankle dorsiflexion +. Whether a value beyond a limit is an error or a failure is
judged elsewhere; the controller uses only the torque, as its clamp.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Final

from hlc.errors import HlcError


@dataclass(frozen=True, slots=True)
class JointLimits:
    """Limits of one joint, after the gear: |torque| [N m], |speed| [rad/s], angle [rad] from min to max."""

    torque_nm: float
    speed_rad_s: float
    min_angle_rad: float
    max_angle_rad: float

    def __post_init__(self) -> None:
        """Refuse limits that exclude everything; raises HlcError."""
        if not (self.torque_nm > 0 and self.speed_rad_s > 0 and self.min_angle_rad < self.max_angle_rad):
            raise HlcError(f"joint limits: {self} given; torque and speed must be above 0 and min below max angle")


def from_table(torque_nm: float, speed_rpm: float, min_angle_deg: float, max_angle_deg: float) -> JointLimits:
    """Limits in the units tables are printed in: N m, revolutions a minute, degrees."""
    return JointLimits(
        torque_nm, math.tau * (speed_rpm / 60), math.radians(min_angle_deg), math.radians(max_angle_deg)
    )


LIMITS: Final[Mapping[str, JointLimits]] = MappingProxyType(
    {
        "hip": from_table(72.9, 23.4, -30.0, 90.0),  # table 1
        "knee": from_table(54.9, 65.2, -90.0, 0.0),  # table 1
        "ankle": from_table(128.7, 50.8, -30.0, 30.0),  # table 1 and its text
    }
)
"""The limits by kind of joint."""


def split_joint(name: str) -> tuple[str, str]:
    """("right", "knee") of "right_knee"; raises HlcError for a name that is not <left|right>_<hip|knee|ankle>."""
    side, _, kind = name.partition("_")
    if side not in ("left", "right") or kind not in LIMITS:
        raise HlcError(
            f"joint name {name!r} given, allowed are left_ or right_ and {', '.join(LIMITS)}, as in 'right_knee'"
        )
    return side, kind


def limits_of(joint_name: str) -> JointLimits:
    """The limits of a joint by its name, such as "right_knee"; raises HlcError for an unknown name."""
    return LIMITS[split_joint(joint_name)[1]]
