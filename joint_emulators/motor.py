"""Brushless motor, its current-controlled driver and the gear, as numbers for MuJoCo's `dcmotor` actuator.

The equations of a DC motor hold for a commutated brushless one (MuJoCo technical note "DC Motor Model"):
v = R i + L di/dt + K w and torque = K i on the motor's shaft; joint torque = gear x K i, shaft speed = gear x dq.

What the actuator with `input="ff"` does, measured with MuJoCo 4.0.1 and held by tests/joint_emulators/test_plant.py:

- ctrl is a torque on the motor's shaft [N m], before the gear. The joint receives gear x that torque.
- With an inductance each motor has one activation, the current [A]. It follows ctrl / K as a first-order lag of L / R,
  stepped exactly: n steps h after a step command i = i_end (1 - exp(-n h R / L)). The torque of a step already uses
  the current at the end of that step. Back-EMF is compensated, so the torque does not depend on speed.
- `ctrlrange` clips the commanded torque, and so the current: the driver's current limit.
- `saturation` clips the torque only; the current behind it grows on. It is set to the same limit, for the one case
  where the driver does not rule the current: above the speed at which back-EMF exceeds the supply.
- `controller` with Vmax (its last number) clips the terminal voltage: the supply. Under full torque the speed then
  settles at V / (K g + R D / (K g)) for gear g and joint damping D. A joint driven faster than V / (K g) brakes itself.

A disabled drive is a command of zero: after the lag the current is zero and the joint swings freely, held only by the
joint damping and by the rotor's inertia through the gear. It is not a short-circuited winding, which would brake.

Left out: gear efficiency and backlash (the joint damping is the only loss), cogging, friction, winding temperature,
phases as such, and the reactance that limits the current of a motor turning above its no-load speed (there, the torque
limit stands in).
"""

from dataclasses import dataclass, fields
from typing import Final

from joint_emulators.errors import JointEmulatorError


@dataclass(frozen=True, slots=True)
class MotorParams:
    """One joint's motor, driver and gear; all values positive.

    torque_constant: N m/A on the shaft, equal to the back-EMF constant in V s/rad; resistance_ohm, inductance_h:
    between terminals; rotor_inertia: kg m2 on the shaft; pole_pairs: electrical turns per shaft turn; gear_ratio:
    shaft turns per joint turn; current_limit_a, supply_v: of the driver.
    """

    torque_constant: float
    resistance_ohm: float
    inductance_h: float
    rotor_inertia: float
    pole_pairs: int
    gear_ratio: float
    current_limit_a: float
    supply_v: float

    def __post_init__(self) -> None:
        """Refuse values that are no motor; raises JointEmulatorError."""
        for item in fields(self):
            value = getattr(self, item.name)
            if not 0.0 < value < float("inf"):
                raise JointEmulatorError(f"motor: {item.name} {value!r} given, allowed are finite values above 0")


def reflected_inertia(motor: MotorParams) -> float:
    """Rotor inertia seen at the joint [kg m2]: J gear^2."""
    return motor.rotor_inertia * motor.gear_ratio**2


def joint_torque(motor: MotorParams, current_a: float) -> float:
    """Joint torque after the gear [N m] of a motor current [A]."""
    return current_a * motor.torque_constant * motor.gear_ratio


def motor_current(motor: MotorParams, tau: float) -> float:
    """Motor current [A] of a joint torque after the gear [N m]."""
    return tau / (motor.torque_constant * motor.gear_ratio)


def terminal_voltage(motor: MotorParams, tau: float, dq: float) -> float:
    """Steady terminal voltage [V] for a joint torque [N m] at a joint speed [rad/s]: R i + K gear dq."""
    return motor.resistance_ohm * motor_current(motor, tau) + motor.torque_constant * motor.gear_ratio * dq


def torque_limit(motor: MotorParams) -> float:
    """Largest joint torque [N m] the driver's current limit allows."""
    return joint_torque(motor, motor.current_limit_a)


def electrical_time_constant(motor: MotorParams) -> float:
    """Lag of the current behind the command [s]: L / R."""
    return motor.inductance_h / motor.resistance_ohm


def _frameless_85(current_limit_a: float) -> MotorParams:
    """A frameless motor of 85 mm diameter behind a one-stage gear, as powered prostheses use it.

    Motor: TQ RoboDrive ILM85x26 data sheet values, as tabulated second-hand in public design studies (torque constant
    0.24 N m/A, 323 mOhm, 0.92 mH, rotor 1.15 kg cm2, 10 pole pairs, 48 V, 8.3 N m peak = 34.6 A).
    Gear 22 : 1, after Elery et al., "Design and Validation of a Powered Knee-Ankle Prosthesis with High-Torque,
    Low-Impedance Actuators", IEEE Transactions on Robotics 36(6), 2020. The pairing with this exoskeleton is assumed.
    """
    return MotorParams(
        torque_constant=0.24,
        resistance_ohm=0.323,
        inductance_h=0.92e-3,
        rotor_inertia=1.15e-4,
        pole_pairs=10,
        gear_ratio=22.0,
        current_limit_a=current_limit_a,
        supply_v=48.0,
    )


# Current limits are assumed: about 1.4 times the torque of the paper's table 1 (72.9, 54.9, 128.7 N m), so that too
# much torque can be seen in the plant, and below the motor's 34.6 A peak.
HIP: Final = _frameless_85(20.0)
"""105.6 N m at the joint."""
KNEE: Final = _frameless_85(15.0)
"""79.2 N m at the joint."""
ANKLE: Final = _frameless_85(34.0)
"""179.5 N m at the joint."""
MOTORS: Final = (HIP, KNEE, ANKLE, HIP, KNEE, ANKLE)
"""In joint order: left hip, knee, ankle, right hip, knee, ankle."""
