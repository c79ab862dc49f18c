"""The plant: what MuJoCo's dcmotor does, closed forms of mechanics, and what the plant refuses."""

import copy
import math
import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import mujoco
import pytest

from joint_emulators.errors import JointEmulatorError
from joint_emulators.models.exoskeleton import JOINT_NAMES, USER_75KG, build_mjcf
from joint_emulators.motor import (
    HIP,
    MOTORS,
    MotorParams,
    electrical_time_constant,
    motor_current,
    torque_limit,
)
from joint_emulators.plant import Plant

STAND = [0.0] * 6
BENT = [0.4, -0.6, 0.1, -0.2, -0.3, -0.1]
G = 9.81


def exoskeleton(
    stops: bool = False, armature: float = 0.1, damping: float = 1.0, motors: tuple[MotorParams, ...] = MOTORS
) -> Plant:
    body = replace(USER_75KG, armature=armature, damping=damping)
    return Plant(build_mjcf(body, motors, stops), JOINT_NAMES)


def one_joint(motor: str, gravity: float = 0.0, damping: float = 0.0, mass: float = 2.0, length: float = 0.4) -> Plant:
    """A point-like mass on a massless rod; I = m l^2 + 0.001 + armature 0.1."""
    return Plant(
        f"""<mujoco><option timestep="0.001" integrator="implicitfast" gravity="0 0 {-gravity}"/>
        <worldbody><body><joint name="j" type="hinge" axis="0 -1 0" armature="0.1" damping="{damping}"/>
        <inertial pos="0 0 {-length}" mass="{mass}" diaginertia="0.001 0.001 0.001"/></body></worldbody>
        <actuator><dcmotor name="j" joint="j" {motor}/></actuator></mujoco>""",
        ("j",),
    )


MOTOR = 'input="ff" motorconst="0.2 0.2" resistance="0.5"'
INERTIA = 2.0 * 0.4**2 + 0.001 + 0.1


# What the dcmotor actuator does


@pytest.mark.parametrize("gear", [1.0, 22.0])
def test_command_is_joint_torque_whatever_the_gear(gear: float) -> None:
    """ctrl is torque on the shaft: gear x ctrl reaches the joint; Plant divides by the gear."""
    plant = one_joint(f'{MOTOR} gear="{gear}"')
    plant.step([5.0])
    assert plant.data.ctrl[0] == pytest.approx(5.0 / gear)
    assert plant.tau == pytest.approx([5.0])
    assert plant.dq == pytest.approx([0.001 * 5.0 / INERTIA])


def test_torque_follows_a_step_command_with_the_exact_lag_of_the_winding() -> None:
    """tau_n = tau (1 - exp(-n h R / L)): the pole is discretised exactly; a step sees the current at its end."""
    plant = exoskeleton()
    command = [10.0, -20.0, 30.0, -5.0, 6.0, -7.0]
    lag = electrical_time_constant(HIP)
    for n in range(1, 30):
        plant.step(command)
        expected = [value * (1.0 - math.exp(-0.001 * n / lag)) for value in command]
        assert plant.tau == pytest.approx(expected, rel=1e-9)


def test_command_holds_until_it_changes_also_through_a_reset_and_a_copy() -> None:
    """The inputs are written when the command changes: the same list with other values, after a reset, in a copy."""
    held, written = exoskeleton(), exoskeleton()
    command = [10.0, -20.0, 30.0, -5.0, 6.0, -7.0]
    for n in range(12):
        if n % 4 == 3:
            command[n % 6] = float(n)  # in place
        if n == 6:
            held.reset([0.1] * 6)
            written.reset([0.1] * 6)
        if n == 9:
            held = copy.deepcopy(held)
        held.step(command)
        written.data.ctrl[:] = 0.0
        written._command = []  # forgets what it has written
        written.step(command)
        assert (held.q, held.dq, held.tau) == (written.q, written.dq, written.tau)


def test_activation_is_the_motor_current() -> None:
    """One activation a motor: the current, torque / (K gear)."""
    plant = exoskeleton()
    for _ in range(10):
        plant.step([20.0, -10.0, 5.0, 0.0, 0.0, 0.0])
    currents = [motor_current(motor, tau) for motor, tau in zip(MOTORS, plant.tau, strict=True)]
    assert plant.data.act.tolist() == pytest.approx(currents, rel=1e-9)


def test_back_emf_is_compensated_below_the_supply_voltage() -> None:
    """The driver controls the current: the same command makes the same torque at rest and at 5 rad/s."""
    torques = []
    for speed in (0.0, 5.0):
        plant = exoskeleton()
        plant.data.qvel[:] = speed
        plant.step([20.0] * 6)
        torques.append(plant.tau)
    assert torques[0] == pytest.approx(torques[1], rel=1e-12)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_command_beyond_the_current_limit_gives_the_limit(sign: float) -> None:
    """ctrlrange clips the command: torque and current end at the driver's limit."""
    plant = exoskeleton()
    plant.reset([0.0, -0.8, 0.0, 0.0, -0.8, 0.0])
    for _ in range(40):  # 14 lags: e^-14 = 8e-7 of the step is left
        plant.data.qvel[:] = 0.0  # hold still, so that back-EMF plays no part
        plant.step([sign * 1000.0] * 6)
    assert plant.tau == pytest.approx([sign * torque_limit(motor) for motor in MOTORS], rel=2e-6)
    assert plant.data.act.tolist() == pytest.approx([sign * motor.current_limit_a for motor in MOTORS], rel=2e-6)


def test_supply_voltage_limits_the_speed() -> None:
    """Steady state by hand: K g i = D w and R i + K g w = V give w = V / (K g + R D / (K g))."""
    plant = one_joint(f'{MOTOR} gear="22" inductance="0.001" controller="0 0 0 0 0 48"', damping=1.0)
    for _ in range(2000):
        plant.step([60.0])
    constant = 0.2 * 22.0
    assert plant.dq[0] == pytest.approx(48.0 / (constant + 0.5 * 1.0 / constant), rel=1e-6)


@pytest.mark.parametrize("speed", [-60.0, -12.0, 12.0, 20.0, 60.0])
def test_joint_driven_above_the_no_load_speed_brakes_within_the_torque_limit(speed: float) -> None:
    """Back-EMF beyond the supply drives a braking current; saturation bounds its torque; nothing runs away."""
    plant = exoskeleton()
    plant.data.qvel[1] = speed
    plant.step(STAND)
    assert plant.tau[1] * speed < 0.0
    for _ in range(200):
        plant.step(STAND)
        assert abs(plant.tau[1]) <= torque_limit(MOTORS[1]) * (1.0 + 1e-12)
    assert abs(plant.dq[1]) < abs(speed)


def test_disabled_drive_swings_like_a_joint_without_a_motor() -> None:
    """Torque off: command 0 leaves only damping and armature; compared with the same model without actuators."""
    text = build_mjcf(USER_75KG, MOTORS, False)
    bare = mujoco.MjModel.from_xml_string(re.sub(r"<actuator>.*</actuator>", "", text, flags=re.DOTALL))
    data = mujoco.MjData(bare)
    data.qpos[:] = BENT
    plant = Plant(text, JOINT_NAMES)
    plant.reset(BENT)
    for _ in range(1000):
        plant.step(STAND)
        mujoco.mj_step(bare, data)
    assert max(abs(value) for value in plant.dq) > 0.1  # it did swing
    assert plant.tau == pytest.approx(STAND, abs=1e-12)  # rounding of the back-EMF compensation
    assert plant.q == pytest.approx(data.qpos.tolist(), abs=1e-12)


# Closed forms of mechanics


def test_pendulum_has_its_small_angle_period() -> None:
    """T = 2 pi sqrt(I / (m g l)); amplitude 0.01 rad adds 6e-6, the 1 ms step (w h)^2 / 24 = 1e-6."""
    plant = one_joint(MOTOR, gravity=G)
    plant.reset([0.01])
    crossings, before = [], plant.q[0]
    for n in range(1, 6000):
        plant.step([0.0])
        if before > 0.0 >= plant.q[0]:
            crossings.append(0.001 * (n - 1 + before / (before - plant.q[0])))
        before = plant.q[0]
    period = (crossings[-1] - crossings[0]) / (len(crossings) - 1)
    assert len(crossings) >= 3
    assert period == pytest.approx(2.0 * math.pi * math.sqrt(INERTIA / (2.0 * G * 0.4)), rel=2e-5)


def test_released_horizontal_rod_falls_with_gravity_over_inertia() -> None:
    """Free fall from 90 deg: ddq = -m g l / I in the first step."""
    plant = one_joint(MOTOR, gravity=G)
    plant.reset([math.pi / 2])
    plant.step([0.0])
    assert plant.dq[0] / 0.001 == pytest.approx(-2.0 * G * 0.4 / INERTIA, rel=1e-9)


def test_horizontal_rod_is_held_by_m_g_l() -> None:
    """Static: m g l at 90 deg holds it still (no inductance, so there is no lag); 1e-9 rad is rounding."""
    plant = one_joint(f'{MOTOR} gear="22"', gravity=G)
    plant.reset([math.pi / 2])
    for _ in range(100):
        plant.step([2.0 * G * 0.4])
    assert plant.q[0] == pytest.approx(math.pi / 2, abs=1e-9)


def test_speed_decays_with_damping_over_inertia() -> None:
    """dq = dq0 exp(-D t / I); the implicit step makes h D / (2 I) = 0.1 % of the decay rate slower."""
    plant = one_joint(MOTOR, damping=1.0)
    plant.data.qvel[0] = 2.0
    for _ in range(500):
        plant.step([0.0])
    assert math.log(2.0 / plant.dq[0]) == pytest.approx(0.5 * 1.0 / INERTIA, rel=2e-3)


def test_energy_is_kept_without_damping() -> None:
    """Free swing of both legs without damping for 3 s: a first-order symplectic step keeps energy within 1 %.

    With the 48 V supply it would not: the knee swings faster than its no-load speed, and there the motor brakes.
    """
    plant = exoskeleton(damping=0.0, motors=tuple(replace(motor, supply_v=1e4) for motor in MOTORS))
    plant.model.opt.enableflags |= mujoco.mjtEnableBit.mjENBL_ENERGY
    plant.reset([1.0, -1.0, 0.2, -0.4, -0.5, 0.0])
    start = float(plant.data.energy.sum())
    kinetic, drift = 0.0, 0.0
    for _ in range(3000):
        plant.step(STAND)
        kinetic = max(kinetic, float(plant.data.energy[1]))
        drift = max(drift, abs(float(plant.data.energy.sum()) - start))
    assert kinetic > 10.0
    assert drift < 0.01 * kinetic  # 0.55 % seen


def inverse_dynamics(model: mujoco.MjModel, q: list[float], dq: list[float], ddq: list[float]) -> list[float]:
    """tau = mj_rne(q, dq, ddq) + armature ddq + damping dq, on data of its own."""
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:], data.qacc[:] = q, dq, ddq
    mujoco.mj_fwdPosition(model, data)
    mujoco.mj_fwdVelocity(model, data)
    mujoco.mj_rne(model, data, 1, tau := data.qacc.copy())
    return [float(x) for x in tau + model.dof_armature * ddq + model.dof_damping * dq]


def test_inverse_dynamics_torque_makes_the_acceleration_it_was_made_for() -> None:
    """Without lag (1 nH), M ddq of one step; the implicit damping divides by M + h D instead of M: exact to 1e-9."""
    fast = tuple(replace(motor, inductance_h=1e-9) for motor in MOTORS)
    plant = exoskeleton(motors=fast)
    dq, ddq = [0.5, -1.0, 0.3, -0.4, 1.2, -0.2], [3.0, -8.0, 5.0, -2.0, 6.0, -4.0]
    plant.reset(BENT)
    plant.data.qvel[:] = dq
    plant.step(inverse_dynamics(plant.model, BENT, dq, ddq))
    made = [(after - before) / 0.001 for after, before in zip(plant.dq, dq, strict=True)]
    checker = mujoco.MjData(plant.model)
    checker.qpos[:] = BENT
    mujoco.mj_forward(plant.model, checker)
    mujoco.mj_mulM(plant.model, checker, wanted := checker.qacc.copy(), checker.qacc * 0.0 + ddq)
    mujoco.mj_mulM(plant.model, checker, got := checker.qacc.copy(), checker.qacc * 0.0 + made)
    got += 0.001 * plant.model.dof_damping * made
    assert got.tolist() == pytest.approx(wanted.tolist(), rel=1e-9)
    assert made == pytest.approx(ddq, rel=0.02)  # h D / M: 0.7 % for the lightest joint, the ankle


def test_inverse_dynamics_along_a_motion_is_tracked_within_the_motor_lag() -> None:
    """q = A (1 - cos w t) by torque alone for 0.5 s: the lag L / R late in torque, so 2.8 ms x A w in angle at most."""
    plant = exoskeleton()
    amplitude, w = [0.2, -0.3, 0.1, -0.1, -0.2, -0.1], 2.0 * math.pi
    worst = 0.0
    for n in range(500):
        t = 0.001 * n
        q = [a * (1.0 - math.cos(w * t)) for a in amplitude]
        dq = [a * w * math.sin(w * t) for a in amplitude]
        ddq = [a * w * w * math.cos(w * t) for a in amplitude]
        worst = max(worst, max(abs(x - y) for x, y in zip(plant.q, q, strict=True)))
        plant.step(inverse_dynamics(plant.model, q, dq, ddq))
    assert max(abs(value) for value in plant.q) > 0.2
    assert worst < 2.0 * electrical_time_constant(HIP) * 0.3 * w  # twice: the torque's lag also costs speed


@pytest.mark.parametrize("stops", [True, False])
def test_pin_stops_a_falling_knee_softly_and_only_when_it_is_there(stops: bool) -> None:
    """A knee swinging down from 60 deg flexion passes its pin at 0 deg by 1.4 deg; without it, it swings through."""
    plant = exoskeleton(stops=stops)
    plant.reset([0.0, -math.radians(60.0), 0.0, 0.0, 0.0, 0.0])
    highest = -math.pi
    for _ in range(1000):
        plant.step(STAND)
        highest = max(highest, plant.q[1])
    if stops:
        assert math.degrees(highest) == pytest.approx(1.4, abs=0.1)
    else:
        assert math.degrees(highest) > 10.0


# The plant as an object


def test_values_are_plain_floats_in_joint_order() -> None:
    """q, dq, tau after a step: lists of Python floats; the list of the step before is not changed."""
    plant = exoskeleton()
    plant.reset(BENT)
    assert plant.q == BENT
    before = plant.q
    plant.step(STAND)
    assert before == BENT
    for values in (plant.q, plant.dq, plant.tau):
        assert [type(value) for value in values] == [float] * 6


def test_step_is_exactly_1_ms() -> None:
    """One mj_step a ms."""
    plant = exoskeleton()
    for _ in range(250):
        plant.step(STAND)
    assert plant.data.time == pytest.approx(0.25, abs=1e-12)


def test_reset_forgets_everything() -> None:
    """After reset the same commands give the same motion, bit for bit: no speed, no current is left."""
    plant = exoskeleton()
    runs = []
    for _ in range(2):
        plant.reset(BENT)
        assert (plant.dq, plant.tau, plant.data.time) == (STAND, STAND, 0.0)
        for n in range(100):
            plant.step([10.0 * math.sin(0.05 * n)] * 6)
        runs.append((plant.q, plant.dq, plant.tau))
    assert runs[0] == runs[1]


@pytest.mark.parametrize("stops", [True, False])
def test_copy_continues_identically_and_on_its_own(stops: bool) -> None:
    """Snapshot: model shared, state copied; the twin goes the same way bit for bit and the original does not move."""
    plant = exoskeleton(stops=stops)
    plant.reset(BENT)
    for n in range(100):
        plant.step([20.0 * math.sin(0.1 * n)] * 6)
    twin = copy.deepcopy(plant)
    assert twin.model is plant.model
    assert (twin.q, twin.dq, twin.tau) == (plant.q, plant.dq, plant.tau)
    path = []
    for n in range(200):
        twin.step([15.0 * math.cos(0.07 * n)] * 6)
        path.append((twin.q, twin.dq, twin.tau))
    assert plant.data.time == pytest.approx(0.1)
    for n, expected in enumerate(path):
        plant.step([15.0 * math.cos(0.07 * n)] * 6)
        assert (plant.q, plant.dq, plant.tau) == expected


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
def test_command_that_is_not_finite_is_refused_before_it_acts(bad: float) -> None:
    """MuJoCo would set all commands to zero with a warning; the plant says which joint and when."""
    plant = exoskeleton()
    plant.step(STAND)
    before = plant.q
    with pytest.raises(JointEmulatorError, match=r"torque command of right_hip is not finite at 0\.001 s"):
        plant.step([0.0, 0.0, 0.0, bad, 0.0, 0.0])
    assert plant.q == before
    assert plant.data.time == pytest.approx(0.001)


@pytest.mark.parametrize("bad", [math.nan, math.inf, 1e200])
def test_diverged_state_is_an_error_not_a_silent_reset(
    bad: float, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """MuJoCo's automatic reset is off; NaN never passes: the message says joint and time."""
    monkeypatch.chdir(tmp_path)  # MuJoCo writes its warning to a log file in the working directory
    plant = exoskeleton()
    for _ in range(7):
        plant.step(STAND)
    plant.data.qvel[1] = bad
    with pytest.raises(JointEmulatorError, match=r"left_knee.* not finite at 0\.008 s"):
        plant.step(STAND)


def test_model_text_that_asks_for_reset_does_not_get_it() -> None:
    """The plant itself switches the automatic reset off, whatever the text says."""
    plant = one_joint(MOTOR)
    assert plant.model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_AUTORESET


@pytest.mark.parametrize(
    ("names", "said"),
    [
        (("left_hip", "elbow"), "elbow"),
        ((), "none"),
        (("left_knee", "left_hip"), "order"),
        (("left_hip", "left_ankle"), "order"),
        (("left_hip", "left_knee"), "actuators"),
    ],
)
def test_joints_that_do_not_fit_the_model_are_refused(names: tuple[str, ...], said: str) -> None:
    """A message says what the model has."""
    with pytest.raises(JointEmulatorError, match=f"{said}.*left_hip"):
        Plant(build_mjcf(USER_75KG, MOTORS, False), names)


def test_other_time_step_is_refused() -> None:
    """Physics steps every 1 ms."""
    text = build_mjcf(USER_75KG, MOTORS, False).replace('timestep="0.001"', 'timestep="0.002"')
    with pytest.raises(JointEmulatorError, match=r"0\.002 s, needed is 0\.001 s"):
        Plant(text, JOINT_NAMES)


def test_reset_needs_one_angle_for_each_joint() -> None:
    """Lengths are checked where it costs nothing."""
    with pytest.raises(JointEmulatorError, match="5 angles"):
        exoskeleton().reset([0.0] * 5)


# The process


@pytest.mark.skipif(sys.platform == "win32", reason="its C library has no function of that type")
def test_stopwatch_at_rest_changes_no_motion() -> None:
    """In a process of its own, whose MuJoCo then reads no clock any more: the same angles, to the last bit."""
    program = """
import mujoco

from joint_emulators.models.exoskeleton import JOINT_NAMES, USER_75KG, build_mjcf
from joint_emulators.motor import MOTORS
from joint_emulators.plant import Plant, rest_stopwatch

rest_stopwatch()
plant = Plant(build_mjcf(USER_75KG, MOTORS, False), JOINT_NAMES)
for step in range(500):
    plant.step([10.0, -5.0, 1.0, -10.0, 5.0, -1.0])
assert mujoco.get_mjcb_time() is not None
print(plant.q)
"""
    told = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True).stdout
    plant = Plant(build_mjcf(USER_75KG, MOTORS, False), JOINT_NAMES)
    for _ in range(500):
        plant.step([10.0, -5.0, 1.0, -10.0, 5.0, -1.0])
    assert told.strip() == str(plant.q)
