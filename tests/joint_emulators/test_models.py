"""The MJCF of the exoskeleton: masses, geometry, signs, stops."""

import math
from dataclasses import replace

import mujoco
import pytest

from joint_emulators.errors import JointEmulatorError
from joint_emulators.models.exoskeleton import (
    JOINT_NAMES,
    USER_75KG,
    WINTER,
    build_mjcf,
    foot_inertial,
    shank_inertial,
    thigh_inertial,
    waist_inertial,
)
from joint_emulators.motor import HIP, MOTORS

G = 9.81


def load(stops: bool = False, q: tuple[float, ...] = (0.0,) * 6) -> tuple[mujoco.MjModel, mujoco.MjData]:
    model = mujoco.MjModel.from_xml_string(build_mjcf(USER_75KG, MOTORS, stops))
    data = mujoco.MjData(model)
    data.qpos[:] = q
    mujoco.mj_forward(model, data)
    return model, data


def test_joints_bodies_and_actuators_are_in_the_given_order() -> None:
    """Seven bodies, six joints: left hip, knee, ankle, right hip, knee, ankle; one actuator each, in that order."""
    model, _ = load()
    assert tuple(model.joint(i).name for i in range(model.njnt)) == JOINT_NAMES
    assert tuple(model.actuator(i).name for i in range(model.nu)) == JOINT_NAMES
    assert model.actuator_trnid[:, 0].tolist() == list(range(6))
    assert model.nbody - 1 == 7
    assert model.nq == model.nv == model.nu == model.na == 6


def test_step_is_1_ms_implicitfast_dense_without_contacts() -> None:
    """Plant clause: step 1 ms, implicitfast; dense Jacobian; nothing to touch when suspended."""
    model, _ = load()
    assert model.opt.timestep == 0.001
    assert model.opt.integrator == mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    assert model.opt.jacobian == mujoco.mjtJacobian.mjJAC_DENSE
    assert model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_CONTACT
    assert model.ngeom == 0


def test_armature_and_damping_are_the_assumed_values() -> None:
    """Joint side: armature 0.1 kg m2, damping 1 N m s/rad."""
    model, _ = load()
    assert model.dof_armature.tolist() == [0.1] * 6
    assert model.dof_damping.tolist() == [1.0] * 6


@pytest.mark.parametrize("side", ["left", "right"])
def test_upright_standing_has_a_straight_leg_down_to_the_sole(side: str) -> None:
    """q = 0: hip, knee and ankle above each other, ankle 0.039 x 1.75 m above the ground; left is +y."""
    _, data = load()
    hip, knee, ankle = (data.body(f"{side}_{part}").xpos for part in ("thigh", "shank", "foot"))
    assert [hip[0], knee[0], ankle[0]] == [0.0, 0.0, 0.0]
    assert ankle[2] == pytest.approx(0.039 * 1.75, abs=1e-12)
    assert hip[2] - knee[2] == pytest.approx(0.245 * 1.75)
    assert knee[2] - ankle[2] == pytest.approx(0.246 * 1.75)
    assert (hip[1] > 0.0) == (side == "left")


@pytest.mark.parametrize("side", [0, 3])
def test_hip_flexion_lifts_the_knee_forward(side: int) -> None:
    """Signs: hip flexion +."""
    q = [0.0] * 6
    q[side] = math.pi / 2
    _, data = load(q=tuple(q))
    hip, knee = (data.body(side + body).xpos for body in (2, 3))
    assert knee - hip == pytest.approx([0.245 * 1.75, 0.0, 0.0], abs=1e-12)


@pytest.mark.parametrize("side", [0, 3])
def test_knee_flexion_moves_the_foot_backward(side: int) -> None:
    """Signs: knee flexion -."""
    q = [0.0] * 6
    q[side + 1] = -math.pi / 2
    _, data = load(q=tuple(q))
    knee, ankle = (data.body(side + body).xpos for body in (3, 4))
    assert ankle - knee == pytest.approx([-0.246 * 1.75, 0.0, 0.0], abs=1e-12)


@pytest.mark.parametrize("side", [0, 3])
def test_dorsiflexion_raises_the_toes(side: int) -> None:
    """Signs: ankle dorsiflexion +; the toes point to +x of the foot."""
    q = [0.0] * 6
    q[side + 2] = math.radians(20.0)
    _, data = load(q=tuple(q))
    toes = data.body(side + 4).xmat.reshape(3, 3)[:, 0]
    assert toes[2] == pytest.approx(math.sin(math.radians(20.0)))
    assert toes[0] > 0.0


def test_masses_are_user_share_plus_exoskeleton() -> None:
    """Winter: thigh 0.100, shank 0.0465, foot 0.0145 of 75 kg; exoskeleton thigh 2.5, shank 2, foot 1.5, waist 6 kg."""
    model, _ = load()
    for side in ("left", "right"):
        assert model.body(f"{side}_thigh").mass[0] == pytest.approx(7.5 + 2.5)
        assert model.body(f"{side}_shank").mass[0] == pytest.approx(3.4875 + 2.0)
        assert model.body(f"{side}_foot").mass[0] == pytest.approx(1.0875 + 1.5)
    assert model.body_mass.sum() == pytest.approx(75.0 + 18.0)


def test_thigh_and_shank_follow_the_table() -> None:
    """Winter: centre of mass 0.433 of the length from above; radius of gyration 0.323 and 0.302."""
    thigh, shank = thigh_inertial(USER_75KG), shank_inertial(USER_75KG)
    assert (thigh.x, shank.x) == (0.0, 0.0)
    assert thigh.z == pytest.approx(-0.433 * 0.245 * 1.75)
    assert shank.z == pytest.approx(-0.433 * 0.246 * 1.75)
    assert thigh.inertia == pytest.approx(10.0 * (0.323 * 0.245 * 1.75) ** 2)
    assert shank.inertia == pytest.approx(5.4875 * (0.302 * 0.246 * 1.75) ** 2)


def test_foot_balances_in_front_of_and_below_the_ankle() -> None:
    """Half of the foot length, less the quarter behind the ankle; half-way down to the sole; gyration 0.475."""
    foot = foot_inertial(USER_75KG)
    assert foot.x == pytest.approx(0.25 * 0.152 * 1.75)
    assert foot.z == pytest.approx(-0.5 * 0.039 * 1.75)
    assert foot.inertia == pytest.approx(2.5875 * (0.475 * 0.152 * 1.75) ** 2)


def test_waist_is_trunk_and_exoskeleton_waist_together() -> None:
    """Two point-like parts: total mass, common centre of mass, inertia by the parallel-axis theorem."""
    waist = waist_inertial(USER_75KG)
    trunk, at = 0.678 * 75.0, 0.626 * 0.288 * 1.75
    assert waist.mass_kg == pytest.approx(trunk + 6.0)
    assert waist.z == pytest.approx(trunk * at / (trunk + 6.0))
    about_hips = trunk * ((0.496 * 0.288 * 1.75) ** 2 + at * at)
    assert waist.inertia + waist.mass_kg * waist.z**2 == pytest.approx(about_hips)


def test_horizontal_leg_needs_the_sum_of_its_weight_moments() -> None:
    """Static: straight leg at 90 deg hip flexion: sum of m g x over the segments, by hand from the table."""
    _, data = load(q=(math.pi / 2, 0.0, 0.0, 0.0, 0.0, 0.0))
    thigh, shank, foot = 0.245 * 1.75, 0.246 * 1.75, 0.152 * 1.75
    lever = 0.5 * 0.039 * 1.75  # the foot points up: its centre of mass is this far beyond the ankle
    moment = G * (10.0 * 0.433 * thigh + 5.4875 * (thigh + 0.433 * shank) + 2.5875 * (thigh + shank + lever))
    assert data.qfrc_bias[0] == pytest.approx(moment, rel=1e-12)
    assert data.qfrc_bias[2] == pytest.approx(2.5875 * G * lever, rel=1e-9)
    assert data.qfrc_bias[5] == pytest.approx(2.5875 * G * 0.25 * foot, rel=1e-9)  # right leg stands: toes pulled down


def test_inertia_of_the_straight_leg_is_the_sum_over_segments_and_armature() -> None:
    """Diagonal of the mass matrix at q = 0: I + m r^2 of all that hangs on the joint, + 0.1 kg m2."""
    model, data = load()
    dense = [[0.0] * 6 for _ in range(6)]
    for i in range(6):
        unit = [0.0] * 6
        unit[i] = 1.0
        mujoco.mj_mulM(model, data, row := data.qacc.copy(), data.qacc * 0.0 + unit)
        dense[i] = row.tolist()
    parts = [thigh_inertial(USER_75KG), shank_inertial(USER_75KG), foot_inertial(USER_75KG)]
    heights = [0.0, -0.245 * 1.75, -(0.245 + 0.246) * 1.75]
    for joint in range(3):
        expected = 0.1
        for part, height in list(zip(parts, heights, strict=True))[joint:]:
            expected += part.inertia + part.mass_kg * (part.x**2 + (height - heights[joint] + part.z) ** 2)
        assert dense[joint][joint] == pytest.approx(expected, rel=1e-12)
    assert dense[0][3] == 0.0  # the waist is fixed: the legs do not feel each other


def test_stops_are_pins_at_the_range_of_travel() -> None:
    """Paper, table 1: hip -30..90, knee -90..0, ankle -30..30 deg."""
    model, _ = load(stops=True)
    expected = [(-30, 90), (-90, 0), (-30, 30)] * 2
    assert model.jnt_limited.tolist() == [True] * 6
    for row, (low, high) in zip(model.jnt_range.tolist(), expected, strict=True):
        assert row == pytest.approx([math.radians(low), math.radians(high)])


def test_without_stops_joints_turn_freely() -> None:
    """Stops are a parameter: on or off."""
    model, _ = load(stops=False)
    assert model.jnt_limited.tolist() == [False] * 6


def test_text_is_the_same_every_time() -> None:
    """The composition root builds the text once and hands it to plant and controller."""
    assert build_mjcf(USER_75KG, MOTORS, True) == build_mjcf(USER_75KG, MOTORS, True)


def test_missing_motor_is_refused() -> None:
    """One motor for each joint."""
    with pytest.raises(JointEmulatorError, match=r"5 motors given.*right_ankle"):
        build_mjcf(USER_75KG, MOTORS[:5], False)


def test_rotor_heavier_than_the_armature_is_refused() -> None:
    """Armature includes rotor inertia x gear^2: a gear of 30 would make that 0.1035 kg m2."""
    motors = (HIP, replace(HIP, gear_ratio=30.0), *MOTORS[2:])
    with pytest.raises(JointEmulatorError, match=r"left_knee.*0\.1035.*armature 0\.1"):
        build_mjcf(USER_75KG, motors, False)


@pytest.mark.parametrize(
    ("name", "value"), [("mass_kg", 0.0), ("height_m", -1.0), ("damping", -0.1), ("armature", math.nan)]
)
def test_impossible_body_is_refused_by_name(name: str, value: float) -> None:
    """A message names the parameter, the value and what is allowed."""
    with pytest.raises(JointEmulatorError, match=f"{name}.*allowed"):
        replace(USER_75KG, **{name: value})  # type: ignore[arg-type]


@pytest.mark.parametrize("share", [0.0, 1.0, -0.1, math.nan])
def test_share_outside_0_to_1_is_no_segment(share: float) -> None:
    """Segment values are shares of mass, height or length."""
    with pytest.raises(JointEmulatorError, match="segment"):
        replace(WINTER.thigh, com=share)
