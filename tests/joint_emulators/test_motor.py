"""Motor, driver and gear as numbers."""

import math
from dataclasses import replace

import pytest

from joint_emulators.errors import JointEmulatorError
from joint_emulators.models.exoskeleton import USER_75KG
from joint_emulators.motor import (
    ANKLE,
    HIP,
    KNEE,
    MOTORS,
    MotorParams,
    electrical_time_constant,
    joint_torque,
    motor_current,
    reflected_inertia,
    terminal_voltage,
    torque_limit,
)

RPM = 2.0 * math.pi / 60.0
TABLE = [(HIP, 72.9, 23.4), (KNEE, 54.9, 65.2), (ANKLE, 128.7, 50.8)]


@pytest.mark.parametrize(("motor", "torque_nm", "speed_rpm"), TABLE)
def test_table_torque_is_reachable_with_room_to_exceed_it(
    motor: MotorParams, torque_nm: float, speed_rpm: float
) -> None:
    """The drive limit lies above the table's limit, so that too much torque can be seen in the plant."""
    assert 1.3 * torque_nm < torque_limit(motor) < 1.6 * torque_nm


@pytest.mark.parametrize(("motor", "torque_nm", "speed_rpm"), TABLE)
def test_table_torque_at_table_speed_needs_less_than_the_supply(
    motor: MotorParams, torque_nm: float, speed_rpm: float
) -> None:
    """Table torque and table speed together are inside the supply voltage, with 15 % to spare."""
    assert terminal_voltage(motor, torque_nm, speed_rpm * RPM) < 0.85 * motor.supply_v


@pytest.mark.parametrize("motor", [HIP, KNEE, ANKLE])
def test_motor_stays_below_its_peak_torque_and_the_armature_holds_its_rotor(motor: MotorParams) -> None:
    """Data sheet: 8.3 N m peak on the shaft; armature 0.1 kg m2 includes rotor inertia x gear^2."""
    assert motor.torque_constant * motor.current_limit_a <= 8.3
    assert reflected_inertia(motor) < USER_75KG.armature


def test_motors_are_hip_knee_ankle_of_both_sides() -> None:
    """Joint order: left hip, knee, ankle, right hip, knee, ankle."""
    assert MOTORS == (HIP, KNEE, ANKLE, HIP, KNEE, ANKLE)


@pytest.mark.parametrize("tau", [-128.7, -1.0, 0.0, 1e-9, 54.9])
def test_torque_to_current_and_back_is_the_same_torque(tau: float) -> None:
    """Torque constant x gear both ways; 1e-15 is double rounding."""
    assert joint_torque(KNEE, motor_current(KNEE, tau)) == pytest.approx(tau, rel=1e-15)


def test_numbers_follow_their_formulas() -> None:
    """tau = K g i, J g^2, L / R, R i + K g dq, by hand for K 0.24, R 0.323, L 0.92 mH, J 1.15e-4, g 22."""
    assert joint_torque(HIP, 10.0) == pytest.approx(52.8)
    assert reflected_inertia(HIP) == pytest.approx(0.05566)
    assert electrical_time_constant(HIP) == pytest.approx(0.0028483, rel=1e-4)
    assert terminal_voltage(HIP, 52.8, 2.0) == pytest.approx(3.23 + 10.56)


@pytest.mark.parametrize(
    "name",
    ["torque_constant", "resistance_ohm", "inductance_h", "rotor_inertia", "gear_ratio", "current_limit_a", "supply_v"],
)
@pytest.mark.parametrize("value", [0.0, -1.0, math.inf, math.nan])
def test_impossible_motor_is_refused_by_name(name: str, value: float) -> None:
    """A message names the parameter and what is allowed."""
    with pytest.raises(JointEmulatorError, match=f"{name}.*allowed"):
        replace(HIP, **{name: value})  # type: ignore[arg-type]
