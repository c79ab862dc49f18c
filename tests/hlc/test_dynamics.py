"""Inverse dynamics against closed forms and against MuJoCo's own inverse."""

import copy
import math

import mujoco
import numpy as np
import pytest

from hlc.dynamics import Dynamics
from hlc.errors import HlcError

GRAVITY = 9.81
NAMES = ("left_hip", "left_knee", "left_ankle", "right_hip", "right_knee", "right_ankle")


def link(name: str, mass: float, com: float, inertia: float, at: float, inner: str, extra: str = "") -> str:
    """A body whose hinge is `at` below its parent, its centre of mass `com` below the hinge."""
    return (
        f'<body pos="0 0 {-at}"><joint name="{name}" axis="0 -1 0" {extra}/>'
        f'<inertial pos="0 0 {-com}" mass="{mass}" diaginertia="{inertia} {inertia} {inertia}"/>{inner}</body>'
    )


def model(bodies: str, actuators: str = "") -> str:
    return (
        f'<mujoco><option timestep="0.001" integrator="implicitfast" jacobian="dense" gravity="0 0 {-GRAVITY}"/>'
        f"<worldbody>{bodies}</worldbody><actuator>{actuators}</actuator></mujoco>"
    )


def legs(extra: str) -> str:
    """Two legs of three links with different numbers."""
    found = ""
    for i, side in enumerate(("left", "right")):
        foot = link(f"{side}_ankle", 2.6 + i, 0.05, 0.01, 0.43, "", extra)
        shank = link(f"{side}_knee", 5.5, 0.19, 0.09, 0.43, foot, extra)
        found += link(f"{side}_hip", 10.0, 0.18, 0.19, 0.1, shank, extra)
    return found


@pytest.mark.parametrize("q", [0.0, 0.5, math.pi / 2, -1.2, 3.0])
@pytest.mark.parametrize("dq", [0.0, 2.5])
@pytest.mark.parametrize("qdd", [0.0, -7.0])
def test_pendulum_torque_is_the_closed_form(q: float, dq: float, qdd: float) -> None:
    """tau = (I + m c^2 + armature) qdd + damping dq + m g c sin q."""
    m, c, inertia, armature, damping = 3.0, 0.4, 0.05, 0.1, 1.5
    dynamics = Dynamics(
        model(link("a", m, c, inertia, 0.0, "", f'armature="{armature}" damping="{damping}"')), ("a",)
    )
    expected = (inertia + m * c * c + armature) * qdd + damping * dq + m * GRAVITY * c * math.sin(q)
    assert dynamics.inverse([q], [dq], [qdd])[0] == pytest.approx(expected, abs=1e-12)


def test_two_links_are_the_textbook_double_pendulum() -> None:
    """Lagrange's equations of a double pendulum in relative angles: inertia, Coriolis, centrifugal, gravity."""
    m1, c1, i1, l1 = 10.0, 0.18, 0.19, 0.42
    m2, c2, i2 = 6.0, 0.21, 0.12
    dynamics = Dynamics(model(link("a", m1, c1, i1, 0.0, link("b", m2, c2, i2, l1, ""))), ("a", "b"))
    rng = np.random.default_rng(1)
    for _ in range(50):
        (q1, q2), (v1, v2), (a1, a2) = rng.normal(size=(3, 2)) * [[1.0], [5.0], [50.0]]
        m12 = i2 + m2 * (c2 * c2 + l1 * c2 * math.cos(q2))
        m11 = i1 + m1 * c1 * c1 + i2 + m2 * (l1 * l1 + c2 * c2 + 2 * l1 * c2 * math.cos(q2))
        coupling = m2 * l1 * c2 * math.sin(q2)
        g2 = m2 * c2 * GRAVITY * math.sin(q1 + q2)
        g1 = (m1 * c1 + m2 * l1) * GRAVITY * math.sin(q1) + g2
        tau1 = m11 * a1 + m12 * a2 - coupling * (2 * v1 * v2 + v2 * v2) + g1
        tau2 = m12 * a1 + (i2 + m2 * c2 * c2) * a2 + coupling * v1 * v1 + g2
        # torques reach some hundred N m; 1e-10 is their rounding
        assert dynamics.inverse([q1, q2], [v1, v2], [a1, a2]) == pytest.approx([tau1, tau2], abs=1e-10)


def test_the_short_way_equals_mujocos_inverse() -> None:
    """mj_inverse does all stages and adds armature and damping itself, those of actuators (gear squared) included."""
    motors = "".join(
        f'<motor joint="{name}" gear="{5 + i}" armature="0.002" damping="0.01"/>' for i, name in enumerate(NAMES)
    )
    text = model(legs('armature="0.1" damping="1"'), motors)
    dynamics = Dynamics(text, NAMES)
    reference = mujoco.MjModel.from_xml_string(text)
    data = mujoco.MjData(reference)
    rng = np.random.default_rng(2)
    for _ in range(100):
        data.qpos[:], data.qvel[:], data.qacc[:] = rng.normal(size=(3, 6)) * [[1.0], [5.0], [50.0]]
        q, dq, qdd = data.qpos.tolist(), data.qvel.tolist(), data.qacc.tolist()
        mujoco.mj_inverse(reference, data)
        # rounding of sums of some hundred N m
        assert dynamics.inverse(q, dq, qdd) == pytest.approx(data.qfrc_inverse.tolist(), abs=1e-10)


def test_armature_and_damping_of_actuators_count_with_the_gear_squared() -> None:
    """Joint 0.1 kg m2 and 1 N m s/rad; motor 0.001 and 0.02 behind 1 : 10 add 0.1 and 2; other joints get nothing."""
    chain = link("a", 1.0, 0.1, 0.1, 0.0, link("b", 1.0, 0.1, 0.1, 0.2, "", 'armature="0.1" damping="1"'))
    motor = '<motor joint="b" gear="10" armature="0.001" damping="0.02"/>'
    dynamics = Dynamics(model(chain, motor), ("a", "b"))
    assert dynamics.armature == pytest.approx([0.0, 0.2], abs=1e-15)
    assert dynamics.damping == pytest.approx([0.0, 3.0], abs=1e-15)


def test_driven_by_it_the_plant_accelerates_as_wanted() -> None:
    """Forward dynamics of the same model under the torque returns qdd."""
    text = model(legs('armature="0.1" damping="1"'))
    dynamics = Dynamics(text, NAMES)
    plant = mujoco.MjModel.from_xml_string(text)
    data = mujoco.MjData(plant)
    rng = np.random.default_rng(3)
    data.qpos[:], data.qvel[:], wanted = rng.normal(size=(3, 6))
    data.qfrc_applied[:] = dynamics.inverse(data.qpos.tolist(), data.qvel.tolist(), wanted.tolist())
    mujoco.mj_forward(plant, data)
    assert data.qacc == pytest.approx(wanted, abs=1e-9)


def test_motors_in_the_model_do_not_matter() -> None:
    """The controller's model is the plant's text: what its motors do is not part of the inverse dynamics."""
    motor = (
        '<dcmotor joint="left_knee" motorconst="0.1" resistance="0.3" inductance="0.001" gear="50" input="ff" '
        'ctrlrange="-20 20"/>'
    )
    with_motor, without = Dynamics(model(legs(""), motor), NAMES), Dynamics(model(legs("")), NAMES)
    rows = [[0.1 * i for i in range(6)], [0.5] * 6, [3.0] * 6]
    assert with_motor.inverse(*rows) == without.inverse(*rows)


def test_it_is_a_function_of_its_arguments() -> None:
    """Calls in between change nothing, so copies may share it; the result is a fresh list of plain floats."""
    dynamics = Dynamics(model(legs("")), NAMES)
    first = dynamics.inverse([0.1] * 6, [1.0] * 6, [2.0] * 6)
    dynamics.inverse([-3.0] * 6, [9.0] * 6, [-5.0] * 6)
    again = dynamics.inverse([0.1] * 6, [1.0] * 6, [2.0] * 6)
    assert again == first
    assert again is not first
    assert type(again[0]) is float
    assert copy.deepcopy(dynamics) is dynamics


def test_joints_behind_others_are_found() -> None:
    """A root that moves comes first in the model and stays at 0: the legs get the torques of a fixed root."""
    text = model(
        '<body><joint name="x" type="slide" axis="1 0 0"/><joint name="pitch" axis="0 -1 0"/>'
        f'<inertial pos="0 0 0" mass="6" diaginertia="1 1 1"/>{legs("")}</body>'
    )
    rows = [[0.1 * i for i in range(6)], [0.5] * 6, [3.0] * 6]
    free, fixed = Dynamics(text, NAMES), Dynamics(model(legs("")), NAMES)
    assert free.inverse(*rows) == pytest.approx(fixed.inverse(*rows), abs=1e-11)


@pytest.mark.parametrize(
    ("names", "message"),
    [
        (("left_hip", "elbow"), "joint 'elbow' given, the model has left_hip, left_knee"),
        (("left_knee", "left_hip"), "hinges that follow each other"),
        (("left_hip", "left_ankle"), "hinges that follow each other"),
        (("left_hip", "left_hip"), "hinges that follow each other"),
    ],
)
def test_joints_that_do_not_fit_are_refused(names: tuple[str, ...], message: str) -> None:
    """Only named hinges in model order."""
    with pytest.raises(HlcError, match=message):
        Dynamics(model(legs("")), names)


def test_a_slide_is_no_hinge() -> None:
    """Torques are of hinges."""
    text = model('<body><joint name="x" type="slide"/><inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/></body>')
    with pytest.raises(HlcError, match="hinges"):
        Dynamics(text, ("x",))


def test_a_model_that_does_not_compile_is_refused() -> None:
    """With MuJoCo's reason."""
    with pytest.raises(HlcError, match="does not compile"):
        Dynamics("<mujoco><nonsense/></mujoco>", NAMES)


@pytest.mark.parametrize("size", [5, 7])
def test_lists_of_another_length_are_a_programming_error(size: int) -> None:
    """Not silently cut or filled."""
    dynamics = Dynamics(model(legs("")), NAMES)
    with pytest.raises(Exception, match="pack_into expected 6"):
        dynamics.inverse([0.0] * size, [0.0] * 6, [0.0] * 6)
