"""The computed-torque controller, its reference and its loop on a plant."""

import copy
import math

import mujoco
import numpy as np
import pytest

from hlc.controller import KD, KP, Controller, ControllerParams, build_controller, fade_in, paper_params
from hlc.dmp import RhythmicDmp
from hlc.dynamics import Dynamics
from hlc.errors import HlcError
from hlc.gait import Gait, packaged_recording
from hlc.limits import limits_of
from joint_emulators.models.exoskeleton import USER_75KG, build_mjcf
from joint_emulators.motor import MOTORS
from joint_emulators.plant import Plant
from joint_emulators.sensors import ENCODER, VELOCITY, VelocityEstimateState, encode, estimate_velocity

NAMES = ("left_hip", "left_knee", "left_ankle", "right_hip", "right_knee", "right_ankle")
STRIDE_NS = 1_500_000_000
CYCLE_NS = 2_000_000
MS = 1_000_000
NO_CLAMP = (1e9,) * 6


def legs() -> str:
    """Two suspended legs of three links, without motors."""
    joint = 'axis="0 -1 0" armature="0.1" damping="1"'
    found = ""
    for side, y in (("left", 0.1), ("right", -0.1)):
        found += (
            f'<body pos="0 {y} 0"><joint name="{side}_hip" {joint}/>'
            '<inertial pos="0 0 -0.18" mass="10" diaginertia="0.19 0.19 0.03"/>'
            f'<body pos="0 0 -0.42"><joint name="{side}_knee" {joint}/>'
            '<inertial pos="0 0 -0.18" mass="5.5" diaginertia="0.09 0.09 0.01"/>'
            f'<body pos="0 0 -0.43"><joint name="{side}_ankle" {joint}/>'
            '<inertial pos="0.06 0 -0.04" mass="2.6" diaginertia="0.01 0.01 0.01"/></body></body></body>'
        )
    return f'<mujoco><option timestep="0.0001" jacobian="dense"/><worldbody>{found}</worldbody></mujoco>'


MJCF = legs()


def make(ahead_ns: int = CYCLE_NS, limits: tuple[float, ...] = NO_CLAMP, cycle_ns: int = CYCLE_NS) -> Controller:
    params = ControllerParams(KP, KD, cycle_ns, STRIDE_NS, limits, ahead_ns)
    return build_controller(params, NAMES, packaged_recording(), MJCF)


@pytest.fixture(scope="module")
def gait() -> Gait:
    return Gait(STRIDE_NS, NAMES, packaged_recording())


@pytest.fixture(scope="module")
def shared() -> Controller:
    return make()


@pytest.fixture
def controller(shared: Controller) -> Controller:
    shared.restart()
    return shared


def reference(controller: Controller, cycles: range) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """q_d, dq_d, ddq_d of the cycles, each (cycles, n_joints)."""
    rows: tuple[list[list[float]], ...] = ([], [], [])
    for cycle in cycles:
        controller.step(cycle, [0.0] * 6, [0.0] * 6)
        state = controller.state
        for row, values in zip(rows, (state.q_d, state.dq_d, state.ddq_d), strict=True):
            row.append(values)
    return np.array(rows[0]), np.array(rows[1]), np.array(rows[2])


@pytest.mark.parametrize("cycle", [-1, 0, 300, 749, 750, 2000])
def test_the_plant_gets_the_acceleration_of_the_law(controller: Controller, cycle: int) -> None:
    """Under the torque, forward dynamics of the plant give qdd_d + kd (dq_d - dq) + kp (q_d - q)."""
    q, dq = [0.3, -0.6, 0.1, -0.2, -0.1, 0.2], [1.0, -2.0, 0.5, 0.0, 3.0, -1.0]
    tau = controller.step(cycle, q, dq)
    plant = mujoco.MjModel.from_xml_string(MJCF)
    data = mujoco.MjData(plant)
    data.qpos[:], data.qvel[:], data.qfrc_applied[:] = q, dq, tau
    mujoco.mj_forward(plant, data)
    state = controller.state
    law = np.array(state.ddq_d) + 20 * (np.array(state.dq_d) - dq) + 100 * (np.array(state.q_d) - q)
    # accelerations up to 200 rad/s^2, inertias from 0.1 kg m2: rounding
    assert data.qacc == pytest.approx(law, abs=1e-9)


def test_on_an_ideal_plant_errors_decay_with_a_double_pole() -> None:
    """s^2 + 20 s + 100: e(t) = e0 (1 + 10 t) exp(-10 t); joints do not disturb each other.

    Control and plant at 0.1 ms: the sampled loop lags by half a step, |de/dt| dt/2 < 0.3 x 3.7/s x 0.05 ms = 6e-5 rad,
    and as much again for MuJoCo's semi-implicit Euler; 2e-4 rad.
    """
    controller = make(ahead_ns=0)
    plant = mujoco.MjModel.from_xml_string(MJCF)
    data = mujoco.MjData(plant)
    start = np.array([0.3, -0.2, 0.1, 0.0, -0.3, 0.0])
    data.qpos[:] = start
    for i in range(5000):
        if i % 100 == 0:
            t = i * 1e-4
            assert data.qpos == pytest.approx(start * (1 + 10 * t) * math.exp(-10 * t), abs=2e-4)
        data.qfrc_applied[:] = controller.step(-1, data.qpos.tolist(), data.qvel.tolist())
        mujoco.mj_step(plant, data)


def test_torques_beyond_the_limit_are_clamped_and_remembered() -> None:
    """tau_command is the torque before the clamp (the torque error counts there), tau after it."""
    limits = (1.0, 2.0, 3.0, 4.0, 5.0, 6.0)
    free, clamped = make(), make(limits=limits)
    q = [-0.5, 0.4, 0.0, 0.001, -0.5, 0.3]
    command = free.step(-1, q, [0.0] * 6)
    tau = clamped.step(-1, q, [0.0] * 6)
    assert clamped.state.tau_command == command
    assert clamped.state.tau is tau
    assert tau == [min(max(value, -limit), limit) for value, limit in zip(command, limits, strict=True)]
    assert any(abs(value) > limit for value, limit in zip(command, limits, strict=True))
    assert any(abs(value) < limit for value, limit in zip(command, limits, strict=True))


@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize("share", [0.999999, 1.0, 1.000001])
def test_the_clamp_begins_at_the_limit(sign: float, share: float) -> None:
    """At the limit nothing is taken away; beyond it all of the excess."""
    q = [-0.5 * sign] * 6
    command = make().step(-1, q, [0.0] * 6)
    limits = tuple(abs(value) / share for value in command)
    tau = make(limits=limits).step(-1, q, [0.0] * 6)
    for before, after, limit in zip(command, tau, limits, strict=True):
        assert after == math.copysign(min(abs(before), limit), before)


@pytest.mark.parametrize(
    ("since_ns", "expected"),
    [
        (-1, (0.0, 0.0, 0.0)),
        (0, (0.0, 0.0, 0.0)),
        (STRIDE_NS // 2, (0.5, 1.875 / 1.5, 0.0)),  # quintic: s' = 15/8 per length in the middle
        (STRIDE_NS, (1.0, 0.0, 0.0)),
        (STRIDE_NS + 1, (1.0, 0.0, 0.0)),
        (1 << 60, (1.0, 0.0, 0.0)),
    ],
)
def test_fade_in_starts_and_ends_at_rest(since_ns: int, expected: tuple[float, float, float]) -> None:
    """A quintic from 0 to 1 over one stride."""
    assert fade_in(since_ns, STRIDE_NS) == pytest.approx(expected, abs=1e-12)


def test_fade_in_derivatives_are_those_of_the_quintic() -> None:
    """numpy's polynomial and its derivatives; no jump at either end."""
    quintic = np.polynomial.Polynomial([0, 0, 0, 10, -15, 6])
    for part in range(1, 100):
        u = part / 100
        expected = (quintic(u), quintic.deriv(1)(u) / 1.5, quintic.deriv(2)(u) / 1.5**2)
        assert fade_in(part * STRIDE_NS // 100, STRIDE_NS) == pytest.approx(expected, abs=1e-12)
    for edge in (1, STRIDE_NS - 1):
        _, ds, dds = fade_in(edge, STRIDE_NS)
        assert abs(ds) < 1e-12
        assert abs(dds) < 1e-6


def test_time_zero_is_the_cycle_at_which_the_gait_is_full(controller: Controller, gait: Gait) -> None:
    """s reaches 1 after one stride; from then on the reference is the gait (1e-7 rad: what the primitive leaves)."""
    assert controller.time_zero_cycle == 750
    q_d, dq_d, _ = reference(controller, range(1500))
    phases = np.arange(1500) / 750
    assert q_d[750:] == pytest.approx(gait.q(phases)[750:], abs=1e-7)
    assert dq_d[750:] == pytest.approx(gait.dq(phases)[750:], abs=1e-5)
    assert np.abs(q_d[749] - gait.q(phases)[749]).max() > 0
    s = np.array([fade_in(cycle * CYCLE_NS, STRIDE_NS)[0] for cycle in range(750)])
    assert q_d[:750] == pytest.approx(s[:, None] * gait.q(phases)[:750], abs=1e-7)


@pytest.mark.parametrize("cycle", [-1000, -1, 0])
def test_before_the_fade_in_the_reference_is_upright_rest(controller: Controller, cycle: int) -> None:
    """0 rad, held by the same law."""
    controller.step(cycle, [0.0] * 6, [0.0] * 6)
    assert controller.state.q_d == [0.0] * 6
    assert controller.state.dq_d == [0.0] * 6


@pytest.mark.long
@pytest.mark.parametrize("ahead", [0, 1, 2])
def test_the_reference_agrees_with_itself(ahead: int) -> None:
    """dq_d at k is the slope of q_d; ddq_d at k is the slope of dq_d `ahead` cycles later.

    Central differences over two cycles err by h^2/6 of the third and fourth derivative: below 1e-3 rad/s, 0.03 rad/s^2.
    Across the seam at time 0 too: the quintic ends with s' = s'' = 0.
    """
    controller = make(ahead_ns=ahead * CYCLE_NS)
    q_d, dq_d, ddq_d = reference(controller, range(1600))
    span = 2 * CYCLE_NS * 1e-9
    assert (q_d[2:] - q_d[:-2]) / span == pytest.approx(dq_d[1:-1], abs=1e-3)
    slope = (dq_d[2:] - dq_d[:-2]) / span  # slope[i] belongs to cycle i + 1
    assert slope[ahead:] == pytest.approx(ddq_d[1 : len(slope) + 1 - ahead], abs=0.03)


def test_phase_counts_strides_from_right_heel_strike(controller: Controller) -> None:
    """0 at time 0; exact for any cycle."""
    assert controller.phase(controller.time_zero_cycle) == 0.0
    assert controller.phase(controller.time_zero_cycle + 375) == 0.5
    assert controller.phase(10**9 * 750 + 1) == 1 / 750


@pytest.mark.parametrize("skip", [2, 7])
def test_cycles_left_out_are_caught_up_with(controller: Controller, skip: int) -> None:
    """The reference depends on the cycle number alone."""
    q, dq = [0.1] * 6, [0.2] * 6
    every = [controller.step(cycle, q, dq) for cycle in range(800)]
    controller.restart()
    for cycle in range(0, 800, skip):
        assert controller.step(cycle, q, dq) == every[cycle]


@pytest.mark.parametrize("back", [99, 0, -1])
def test_cycles_do_not_go_back_unless_restarted(controller: Controller, back: int) -> None:
    """A programming error, told as such."""
    first = controller.step(0, [0.1] * 6, [0.0] * 6)
    controller.step(100, [0.0] * 6, [0.0] * 6)
    with pytest.raises(HlcError, match="rising cycles"):
        controller.step(back, [0.0] * 6, [0.0] * 6)
    controller.restart()
    assert controller.step(0, [0.1] * 6, [0.0] * 6) == first


def test_a_copy_goes_on_alike_and_apart(controller: Controller) -> None:
    """Snapshots: parameters and models shared, state copied."""
    q, dq = [0.1] * 6, [0.2] * 6
    for cycle in range(100):
        controller.step(cycle, q, dq)
    twin = copy.deepcopy(controller)
    assert twin.dynamics is controller.dynamics
    ahead = [controller.step(cycle, q, dq) for cycle in range(100, 200)]
    assert [twin.step(cycle, q, dq) for cycle in range(100, 200)] == ahead
    assert twin.state.cycle == 199


def test_results_of_one_cycle_are_not_overwritten_by_the_next(controller: Controller) -> None:
    """Whoever records the lists may keep them."""
    controller.step(800, [0.1] * 6, [0.0] * 6)
    state = controller.state
    kept = (state.q_d, state.dq_d, state.ddq_d, state.tau_command, state.tau)
    values = [list(row) for row in kept]
    controller.step(801, [0.2] * 6, [0.0] * 6)
    assert [list(row) for row in kept] == values


def test_paper_params_are_the_papers() -> None:
    """Kp = 100 s-2, Kd = 20 s-1, clamp at the table's torques."""
    params = paper_params(NAMES, CYCLE_NS, STRIDE_NS)
    assert (params.kp, params.kd) == (100.0, 20.0)
    assert params.torque_limit_nm == (72.9, 54.9, 128.7, 72.9, 54.9, 128.7)
    assert params.ahead_ns == CYCLE_NS


@pytest.mark.parametrize(
    ("kp", "kd", "limit", "message"),
    [
        (-1.0, 20.0, 1.0, "gains from 0 up"),
        (100.0, math.nan, 1.0, "gains from 0 up"),
        (100.0, 20.0, 0.0, "torques above 0"),
        (100.0, 20.0, math.nan, "torques above 0"),
    ],
)
def test_parameters_that_make_no_sense_are_refused(kp: float, kd: float, limit: float, message: str) -> None:
    """Gains from 0, limits above 0."""
    with pytest.raises(HlcError, match=message):
        ControllerParams(kp, kd, CYCLE_NS, STRIDE_NS, (limit,), 0)


def test_parts_that_do_not_belong_together_are_refused(gait: Gait) -> None:
    """Same joints in the same order, same times."""
    params = paper_params(NAMES, CYCLE_NS, STRIDE_NS)
    right, dynamics = RhythmicDmp(gait, CYCLE_NS, CYCLE_NS), Dynamics(MJCF, NAMES)
    with pytest.raises(HlcError, match="same joints in the same order"):
        Controller(params, right, Dynamics(MJCF, NAMES[:3]))
    with pytest.raises(HlcError, match="same joints in the same order"):
        Controller(paper_params(NAMES[:5], CYCLE_NS, STRIDE_NS), right, dynamics)
    with pytest.raises(HlcError, match="same parameters"):
        Controller(params, RhythmicDmp(gait, 2 * CYCLE_NS, CYCLE_NS), dynamics)


class Walk:
    """Seven seconds of fault-free walking after the fade-in, on the exoskeleton: what each joint came to in them."""

    def __init__(self, cycle_ns: int) -> None:
        text = build_mjcf(USER_75KG, MOTORS, stops=False)
        params = paper_params(NAMES, cycle_ns, STRIDE_NS)
        controller = build_controller(params, NAMES, packaged_recording(), text)
        self.plant = Plant(text, NAMES)
        self.plant.reset([0.0] * 6)
        self.filters = [VelocityEstimateState() for _ in NAMES]
        self.q: list[float] = []
        self.dq: list[float] = []
        self.sense()
        wanted, was, torque, speed, angle = [], [], [], [], []
        now, late = [0.0] * 6, [0.0] * 6
        for cycle in range(controller.time_zero_cycle + 7_000 * MS // cycle_ns):
            now, late = late, controller.step(cycle, self.q, self.dq)  # sampled in a cycle, acts in the next one
            motion = cycle >= controller.time_zero_cycle
            if motion:
                wanted.append(controller.state.q_d)
                was.append(self.plant.q)
            for _ in range(cycle_ns // MS):
                self.plant.step(now)
                self.sense()
                if motion:
                    torque.append(self.plant.tau)
                    speed.append(self.plant.dq)
                    angle.append(self.plant.q)
        self.rmse = np.sqrt(np.mean((np.array(wanted) - was) ** 2, axis=0))
        self.torque = np.abs(torque).max(axis=0)
        self.speed = np.abs(speed).max(axis=0)
        self.angle = np.array(angle)

    def sense(self) -> None:
        """Encoder counts and the drive's velocity, back in rad and rad/s."""
        counts = [encode(q, ENCODER) for q in self.plant.q]
        speeds = [estimate_velocity(VELOCITY, *pair) for pair in zip(self.filters, counts, strict=True)]
        unit = math.tau / ENCODER.counts_per_revolution
        self.q = [unit * value for value in counts]
        self.dq = [unit * value for value in speeds]


@pytest.fixture(scope="module")
def walk() -> Walk:
    return Walk(CYCLE_NS)


def test_fault_free_tracking_is_better_than_a_hundredth_of_a_radian(walk: Walk) -> None:
    """RMSE over 7 s, 500 Hz, one cycle of delay; measured 0.0011, 0.0035, 0.0022 rad (hip, knee, ankle)."""
    assert (walk.rmse < 0.01).all()


def test_fault_free_walking_stays_inside_every_limit(walk: Walk) -> None:
    """A fault-free run shows no error and no failure."""
    for j, name in enumerate(NAMES):
        limits = limits_of(name)
        assert walk.torque[j] < limits.torque_nm
        assert walk.speed[j] < limits.speed_rad_s
        assert limits.min_angle_rad < walk.angle[:, j].min()
        assert walk.angle[:, j].max() < limits.max_angle_rad


def test_fault_free_peaks_are_those_of_the_plan(walk: Walk) -> None:
    """About 66, 38, 10 N m and 21.8, 44.9, 26.2 rpm.

    Speeds are the gait's, within 2 %. Torques hang on masses and on where the foot's mass lies: 5 % for hip and knee,
    1 N m for the ankle, whose torque is the foot's alone.
    """
    assert walk.speed[3:] * 60 / math.tau == pytest.approx([21.8, 44.9, 26.2], rel=0.02)
    assert walk.torque[3:5] == pytest.approx([66.0, 38.0], rel=0.05)
    assert walk.torque[5] == pytest.approx(10.0, abs=1.0)


def test_at_100_hz_it_still_walks_inside_the_limits() -> None:
    """Five times the delay: hip torque below its limit (it is beyond it when nothing is fed forward), knee below 0."""
    slow = Walk(10 * MS)
    assert slow.torque[3] < 72.9
    assert slow.angle[:, 4].max() < 0.0
    assert (slow.rmse < 0.02).all()
