"""Limits of torque, speed and range of travel."""

import math

import pytest

from hlc.errors import HlcError
from hlc.limits import LIMITS, JointLimits, from_table, limits_of, split_joint

# ESREL 2020, table 1: torque N m, speed rpm, min and max angle deg; the ankle's maximum as in its text.
TABLE = {"hip": (72.9, 23.4, -30, 90), "knee": (54.9, 65.2, -90, 0), "ankle": (128.7, 50.8, -30, 30)}


@pytest.mark.parametrize("side", ["left", "right"])
@pytest.mark.parametrize("kind", TABLE)
def test_limits_are_the_papers_in_si_units(side: str, kind: str) -> None:
    """Table 1, in N m, rad/s and rad: conversions exact to rounding."""
    torque_nm, speed_rpm, low_deg, high_deg = TABLE[kind]
    limits = limits_of(f"{side}_{kind}")
    assert limits.torque_nm == torque_nm
    assert limits.speed_rad_s * 60 / math.tau == pytest.approx(speed_rpm, rel=1e-15)
    assert math.degrees(limits.min_angle_rad) == pytest.approx(low_deg, rel=1e-15)
    assert math.degrees(limits.max_angle_rad) == pytest.approx(high_deg, rel=1e-15)


def test_one_revolution_a_minute_and_one_degree_are_what_they_are() -> None:
    """60 rpm is one turn a second; 180 deg is pi."""
    limits = from_table(1.0, 60.0, -180.0, 180.0)
    assert limits == JointLimits(1.0, 2 * math.pi, -math.pi, math.pi)


@pytest.mark.parametrize("name", ["", "knee", "right", "right_", "_knee", "Right_knee", "right_elbow", "right_knee_2"])
def test_unknown_joint_names_are_refused_with_the_allowed_ones(name: str) -> None:
    """A message says what is allowed."""
    with pytest.raises(HlcError, match=r"allowed are left_ or right_ and hip, knee, ankle"):
        limits_of(name)


def test_joint_names_are_side_and_kind() -> None:
    """<left|right>_<hip|knee|ankle>."""
    assert split_joint("left_ankle") == ("left", "ankle")


@pytest.mark.parametrize(
    "numbers", [(0.0, 1.0, -1.0, 1.0), (1.0, 0.0, -1.0, 1.0), (1.0, 1.0, 1.0, 1.0), (math.nan, 1.0, -1.0, 1.0)]
)
def test_limits_that_exclude_everything_are_refused(numbers: tuple[float, float, float, float]) -> None:
    """Torque and speed above 0, min below max."""
    with pytest.raises(HlcError, match="torque and speed must be above 0"):
        JointLimits(*numbers)


def test_the_table_cannot_be_changed() -> None:
    """No module-level mutable state."""
    with pytest.raises(TypeError):
        LIMITS["hip"] = from_table(1.0, 1.0, 0.0, 1.0)  # type: ignore[index]
