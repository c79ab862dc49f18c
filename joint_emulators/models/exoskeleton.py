"""MJCF of a user in the lower-limb exoskeleton, suspended: the waist is fixed and the feet are free.

Seven bodies (waist, thighs, shanks, feet) and six hinges in the sagittal plane. World and body frames: x forward,
y to the left, z up; every body frame sits in the joint that moves it, and at q = 0 the user stands upright with
straight legs and horizontal feet. Joint axes are 0 -1 0: hip flexion +, knee flexion -, ankle dorsiflexion +.

Source: segment table of D. A. Winter, "Biomechanics and Motor Control of Human Movement", 4th ed. 2009: masses, centres
of mass and radii of gyration from table 4.1 (after Dempster), lengths as fractions of the height from figure 4.1 (after
Drillis and Contini). Exoskeleton masses, joint damping and armature are assumed.

The same text serves the controller's inverse dynamics: it carries armature and damping, which mj_rne leaves out.
Left out: everything outside the sagittal plane (segments get the same inertia about all axes), contacts, geometry to
look at, soft tissue and straps (user and exoskeleton segment are one rigid body), gear losses.
"""

import math
from dataclasses import dataclass
from typing import Final

from joint_emulators.errors import JointEmulatorError
from joint_emulators.motor import MotorParams, reflected_inertia

JOINT_NAMES: Final = ("left_hip", "left_knee", "left_ankle", "right_hip", "right_knee", "right_ankle")

RANGE_OF_TRAVEL_DEG: Final = ((-30.0, 90.0), (-90.0, 0.0), (-30.0, 30.0))
"""Hip, knee, ankle [deg]: the paper's table 1 (its ankle maximum "-30" read as 30, as its text has it)."""

STEP_S: Final = 0.001

STOP_SOLREF: Final = (0.02, 1.0)
"""Pins: time constant [s] and damping ratio of MuJoCo's soft limit; its default, assumed. A knee that swings down
freely from 60 deg flexion, the foot with it, passes its pin by 1.4 deg."""


@dataclass(frozen=True, slots=True)
class SegmentParams:
    """One row of a segment table.

    mass: share of body mass; length: share of height; com: from the proximal end, share of length; gyration: radius
    about the centre of mass, share of length.
    """

    mass: float
    length: float
    com: float
    gyration: float

    def __post_init__(self) -> None:
        """Refuse values that are no segment; raises JointEmulatorError."""
        for value in (self.mass, self.length, self.com, self.gyration):
            if not 0.0 < value < 1.0:
                raise JointEmulatorError(f"segment: {self} given, allowed are shares between 0 and 1")


@dataclass(frozen=True, slots=True)
class AnthropometricParams:
    """Segment table. foot: along the sole, from the heel.

    foot_height: ankle above the sole; hip_width: between the hip joints (shares of height); ankle_from_heel: share of
    foot length.
    """

    trunk: SegmentParams
    thigh: SegmentParams
    shank: SegmentParams
    foot: SegmentParams
    foot_height: float
    hip_width: float
    ankle_from_heel: float


WINTER: Final = AnthropometricParams(
    trunk=SegmentParams(0.678, 0.288, 0.626, 0.496),  # head, arms and trunk; greater trochanter to glenohumeral joint
    thigh=SegmentParams(0.100, 0.245, 0.433, 0.323),  # greater trochanter to femoral condyles
    shank=SegmentParams(0.0465, 0.246, 0.433, 0.302),  # femoral condyles to medial malleolus
    # The table counts com and gyration of the foot from malleolus to metatarsal II, without giving that length;
    # here they count over the whole foot (assumed), which makes its inertia the larger one.
    foot=SegmentParams(0.0145, 0.152, 0.5, 0.475),
    foot_height=0.039,
    hip_width=0.191,
    ankle_from_heel=0.25,  # assumed
)


@dataclass(frozen=True, slots=True)
class BodyParams:
    """User, exoskeleton and joints. Masses in kg, height_m in m.

    exo_*: exoskeleton mass of the waist and of one thigh, shank, foot, spread like the user's segment (the waist part
    at hip height). armature: inertia of everything that turns with the gear, rotor inertia x gear^2 included [kg m2 at
    the joint]. damping: viscous loss of joint and gear [N m s/rad at the joint].
    """

    mass_kg: float
    height_m: float
    table: AnthropometricParams
    exo_waist_kg: float
    exo_thigh_kg: float
    exo_shank_kg: float
    exo_foot_kg: float
    armature: float
    damping: float

    def __post_init__(self) -> None:
        """Refuse bodies that do not exist; raises JointEmulatorError."""
        for name in ("mass_kg", "height_m"):
            value = getattr(self, name)
            if not 0.0 < value < math.inf:
                raise JointEmulatorError(f"body: {name} {value!r} given, allowed are finite values above 0")
        for name in ("exo_waist_kg", "exo_thigh_kg", "exo_shank_kg", "exo_foot_kg", "armature", "damping"):
            value = getattr(self, name)
            if not 0.0 <= value < math.inf:
                raise JointEmulatorError(f"body: {name} {value!r} given, allowed are finite values from 0")


USER_75KG: Final = BodyParams(
    mass_kg=75.0,
    height_m=1.75,
    table=WINTER,
    exo_waist_kg=6.0,  # this and the rest: assumed; 18 kg in all
    exo_thigh_kg=2.5,
    exo_shank_kg=2.0,
    exo_foot_kg=1.5,
    armature=0.1,
    damping=1.0,
)


@dataclass(frozen=True, slots=True)
class Inertial:
    """User and exoskeleton segment as one: centre of mass (x, z) in the body frame [m], inertia about it [kg m2]."""

    mass_kg: float
    x: float
    z: float
    inertia: float


def thigh_inertial(body: BodyParams) -> Inertial:
    """Thigh in the frame of the hip joint."""
    return _hanging(body, body.table.thigh, body.exo_thigh_kg)


def shank_inertial(body: BodyParams) -> Inertial:
    """Shank in the frame of the knee joint."""
    return _hanging(body, body.table.shank, body.exo_shank_kg)


def foot_inertial(body: BodyParams) -> Inertial:
    """Foot in the frame of the ankle joint."""
    table, foot, length = body.table, body.table.foot, body.table.foot.length * body.height_m
    mass = foot.mass * body.mass_kg + body.exo_foot_kg
    x = (foot.com - table.ankle_from_heel) * length
    z = -0.5 * table.foot_height * body.height_m  # half-way to the sole: assumed
    return Inertial(mass, x, z, mass * (foot.gyration * length) ** 2)


def waist_inertial(body: BodyParams) -> Inertial:
    """Trunk with head and arms, and the exoskeleton's waist at hip height; in a frame between the hip joints."""
    trunk = body.table.trunk
    user, length = trunk.mass * body.mass_kg, trunk.length * body.height_m
    mass = user + body.exo_waist_kg
    z = user * trunk.com * length / mass
    about_com = user * ((trunk.gyration * length) ** 2 + (trunk.com * length - z) ** 2) + body.exo_waist_kg * z * z
    return Inertial(mass, 0.0, z, about_com)


def _hanging(body: BodyParams, segment: SegmentParams, exo_kg: float) -> Inertial:
    mass, length = segment.mass * body.mass_kg + exo_kg, segment.length * body.height_m
    return Inertial(mass, 0.0, -segment.com * length, mass * (segment.gyration * length) ** 2)


def build_mjcf(body: BodyParams, motors: tuple[MotorParams, ...], stops: bool) -> str:
    """MJCF text of the suspended set-up.

    motors: one a joint, in the order of JOINT_NAMES; stops: pins at the range of travel.
    Raises JointEmulatorError when motors are missing or a rotor alone has more inertia than the armature holds.
    """
    if len(motors) != len(JOINT_NAMES):
        names = ", ".join(JOINT_NAMES)
        raise JointEmulatorError(f"exoskeleton: {len(motors)} motors given, needed one for each of {names}")
    for name, motor in zip(JOINT_NAMES, motors, strict=True):
        if reflected_inertia(motor) > body.armature:
            raise JointEmulatorError(
                f"exoskeleton: {name}: rotor inertia x gear^2 is {reflected_inertia(motor):.4g} kg m2, but armature "
                f"{body.armature:.4g} kg m2 must include it; raise the armature or lower gear ratio or rotor inertia"
            )
    table = body.table
    hip_height = (table.thigh.length + table.shank.length + table.foot_height) * body.height_m
    return f"""<mujoco model="exoskeleton_suspended">
  <compiler angle="radian"/>
  <option timestep="{STEP_S}" integrator="implicitfast" jacobian="dense" gravity="0 0 -9.81">
    <flag contact="disable" autoreset="disable"/>
  </option>
  <worldbody>
    <body name="waist" pos="0 0 {hip_height!r}">
      {_inertial(waist_inertial(body))}
{_leg(body, "left", 0.5 * table.hip_width * body.height_m, stops)}
{_leg(body, "right", -0.5 * table.hip_width * body.height_m, stops)}
    </body>
  </worldbody>
  <actuator>
{chr(10).join(_actuator(name, motor) for name, motor in zip(JOINT_NAMES, motors, strict=True))}
  </actuator>
</mujoco>
"""


def _leg(body: BodyParams, side: str, y: float, stops: bool) -> str:
    knee = -body.table.thigh.length * body.height_m
    ankle = -body.table.shank.length * body.height_m
    joints = [
        _joint(body, f"{side}_{part}", RANGE_OF_TRAVEL_DEG[i], stops) for i, part in enumerate(("hip", "knee", "ankle"))
    ]
    return f"""      <body name="{side}_thigh" pos="0 {y!r} 0">
        {joints[0]}
        {_inertial(thigh_inertial(body))}
        <body name="{side}_shank" pos="0 0 {knee!r}">
          {joints[1]}
          {_inertial(shank_inertial(body))}
          <body name="{side}_foot" pos="0 0 {ankle!r}">
            {joints[2]}
            {_inertial(foot_inertial(body))}
          </body>
        </body>
      </body>"""


def _joint(body: BodyParams, name: str, travel_deg: tuple[float, float], stops: bool) -> str:
    text = f'<joint name="{name}" type="hinge" axis="0 -1 0" armature="{body.armature!r}" damping="{body.damping!r}"'
    if stops:
        low, high = math.radians(travel_deg[0]), math.radians(travel_deg[1])
        text += f' limited="true" range="{low!r} {high!r}" solreflimit="{STOP_SOLREF[0]} {STOP_SOLREF[1]}"'
    return text + "/>"


def _inertial(part: Inertial) -> str:
    inertia = " ".join([repr(part.inertia)] * 3)
    return f'<inertial pos="{part.x!r} 0 {part.z!r}" mass="{part.mass_kg!r}" diaginertia="{inertia}"/>'


def _actuator(name: str, motor: MotorParams) -> str:
    """The dcmotor of one joint; what its attributes do is written in joint_emulators.motor."""
    limit = motor.torque_constant * motor.current_limit_a
    return (
        f'    <dcmotor name="{name}" joint="{name}" input="ff" gear="{motor.gear_ratio!r}" '
        f'motorconst="{motor.torque_constant!r} {motor.torque_constant!r}" resistance="{motor.resistance_ohm!r}" '
        f'inductance="{motor.inductance_h!r}" ctrllimited="true" ctrlrange="{-limit!r} {limit!r}" '
        f'saturation="{limit!r}" controller="0 0 0 0 0 {motor.supply_v!r}"/>'
    )
