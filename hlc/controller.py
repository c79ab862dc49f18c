"""Computed-torque control of the exoskeleton: what torque each joint gets in each control cycle.

Source: the computed-torque law of robotics textbooks (Siciliano et al., Robotics, 8.5.2), as in the exoskeleton paper:

    qdd = qdd_d + kd (dq_d - dq) + kp (q_d - q),   tau = inverse dynamics(q, dq, qdd), clamped

The error then obeys e'' + kd e' + kp e = 0; KP and KD make both poles -10/s (a textbook choice, not tuned).

Which reference belongs to cycle k. Its samples are latched at SYNC k; its torque reaches the drives before SYNC k+1 and
acts until SYNC k+2. The angles and velocities compared with the samples are those wanted at SYNC k, the time of the
samples. The acceleration fed forward is that wanted `ahead_ns` later, one cycle by default: when the torque begins to
act. It is reference, known beforehand; no measurement is extrapolated, the model is evaluated at the samples.

Why one cycle. The middle of the time it acts, 1.5 cycles, would be right if the model were evaluated there too, which
needs extrapolated samples and would spread a wrong velocity into the angles. With the samples as they came, one cycle
is best or close to it. Tracking error of the suspended exoskeleton over all joints, rms, for 0, 1 and 1.5 cycles: 3.1,
2.4, 2.3 mrad at 500 Hz; 10.8, 7.3, 7.9 mrad at 100 Hz, where 0 also asks the hip for more than its 72.9 N m (encoder of
131072 counts, velocity filtered at 100 Hz, motor lag 2.8 ms).

Fade-in. The reference is s(t) q(t), s = 10 u^3 - 15 u^4 + 6 u^5 rising from 0 to 1 over one stride. Cycle 0 is the SYNC
at which it begins; time 0 of the experiment is the cycle at which s reaches 1 (`time_zero_cycle`). Before cycle 0 the
reference is the upright posture, 0 rad. Old samples are used like new ones (hold); their age is counted elsewhere.

Cost of a step for six joints: 5.7 us, 2.4 us of them inverse dynamics (CPython 3.11, one core of a small server).
Leaves out: bus frames and clocks, observers, balance.
"""

import copy
from typing import Final, final

from hlc.dmp import RhythmicDmp, RhythmicState
from hlc.dynamics import Dynamics
from hlc.errors import HlcError
from hlc.gait import Gait, Recording
from hlc.limits import limits_of

KP: Final = 100.0
"""Position gain [1/s^2]: natural frequency 10 rad/s."""

KD: Final = 20.0
"""Velocity gain [1/s]: critical damping at KP."""


@final
class ControllerParams:
    """What the controller is built with; never changed.

    kp: 1/s^2; kd: 1/s; cycle_ns: SYNC period; stride_ns: stride time, a whole number of cycles; torque_limit_nm: clamp
    per joint, N m; ahead_ns: from the samples to the moment whose acceleration is fed forward.
    """

    __slots__ = ("ahead_ns", "cycle_ns", "kd", "kp", "stride_ns", "torque_limit_nm")

    def __init__(
        self, kp: float, kd: float, cycle_ns: int, stride_ns: int, torque_limit_nm: tuple[float, ...], ahead_ns: int
    ) -> None:
        if not (kp >= 0.0 and kd >= 0.0):
            raise HlcError(f"controller: kp {kp} and kd {kd} given, allowed are gains from 0 up")
        if any(not limit > 0.0 for limit in torque_limit_nm):
            raise HlcError(f"controller: torque limits {torque_limit_nm} N m given, allowed are torques above 0")
        self.kp: Final[float] = kp
        self.kd: Final[float] = kd
        self.cycle_ns: Final[int] = cycle_ns
        self.stride_ns: Final[int] = stride_ns
        self.torque_limit_nm: Final[tuple[float, ...]] = torque_limit_nm
        self.ahead_ns: Final[int] = ahead_ns


def paper_params(joint_names: tuple[str, ...], cycle_ns: int, stride_ns: int) -> ControllerParams:
    """KP and KD, the paper's torque limits as the clamp, and acceleration fed forward for one cycle later."""
    limits = tuple(limits_of(name).torque_nm for name in joint_names)
    return ControllerParams(KP, KD, cycle_ns, stride_ns, limits, cycle_ns)


@final
class ControllerState:
    """What the last cycle came to; lists of n_joints.

    cycle: its number; q_d: rad and dq_d: rad/s, wanted at its SYNC; ddq_d: rad/s^2, wanted `ahead_ns` later;
    tau_command: N m, before the clamp; tau: N m, after it.
    """

    __slots__ = ("cycle", "ddq_d", "dmp", "dq_d", "q_d", "tau", "tau_command")

    def __init__(self) -> None:
        self.cycle: int = -1
        self.dmp: RhythmicState = RhythmicState()
        self.q_d: list[float] = []
        self.dq_d: list[float] = []
        self.ddq_d: list[float] = []
        self.tau_command: list[float] = []
        self.tau: list[float] = []


@final
class Controller:
    """From samples to torques, one call a cycle.

    state: all there is to know of the last cycle; time_zero_cycle: the cycle at which the fade-in is over.
    """

    def __init__(self, params: ControllerParams, dmp: RhythmicDmp, dynamics: Dynamics) -> None:
        n_joints = len(params.torque_limit_nm)
        if dmp.joint_names != dynamics.joint_names or n_joints != len(dmp.joint_names):
            raise HlcError(
                f"controller: primitive of {dmp.joint_names}, dynamics of {dynamics.joint_names} and {n_joints} torque "
                "limits given, allowed are the same joints in the same order"
            )
        times = (dmp.cycle_ns, dmp.stride_ns, dmp.ahead_ns)
        wanted = (params.cycle_ns, params.stride_ns, params.ahead_ns)
        if times != wanted:
            raise HlcError(
                f"controller: primitive with cycle, stride and look-ahead of {times} ns given, allowed {wanted} ns; "
                "make it from the same parameters"
            )
        self.params: Final = params
        self.dmp: Final = dmp
        self.dynamics: Final = dynamics
        self.n_joints: Final[int] = n_joints
        self.time_zero_cycle: Final[int] = dmp.n_cycles
        self._q_then: Final[list[float]] = [0.0] * n_joints
        self._dq_then: Final[list[float]] = [0.0] * n_joints
        self.state: ControllerState = ControllerState()
        self.restart()

    def __deepcopy__(self, memo: dict[int, object]) -> "Controller":
        """A controller in the same state; parameters, primitive and model are shared, they do not change."""
        twin = Controller(self.params, self.dmp, self.dynamics)
        twin.state = copy.deepcopy(self.state, memo)
        return twin

    def restart(self) -> None:
        """Forget the motion; the next cycle may be 0 or before again."""
        zero = [0.0] * self.n_joints
        state = ControllerState()
        state.dmp = self.dmp.start()
        state.q_d, state.dq_d, state.ddq_d = list(zero), list(zero), list(zero)
        state.tau_command, state.tau = list(zero), list(zero)
        self.state = state

    def step(self, cycle: int, q: list[float], dq: list[float]) -> list[float]:
        """Torques [N m], clamped, for the samples q [rad] and dq [rad/s] latched at SYNC `cycle` of the fade-in.

        Cycles do not go back; those left out are caught up with.
        """
        if cycle >= 0 or self.state.dmp.cycle > 0:
            self._refer(cycle)
        state, params = self.state, self.params
        kp, kd = params.kp, params.kd
        q_d, dq_d = state.q_d, state.dq_d
        qdd = [0.0] * self.n_joints
        for j, ahead in enumerate(state.ddq_d):
            qdd[j] = ahead + kd * (dq_d[j] - dq[j]) + kp * (q_d[j] - q[j])
        command = self.dynamics.inverse(q, dq, qdd)
        tau = list(command)
        for j, limit in enumerate(params.torque_limit_nm):
            wanted = command[j]
            if wanted > limit:
                tau[j] = limit
            elif wanted < -limit:
                tau[j] = -limit
        state.cycle = cycle
        state.tau_command = command
        state.tau = tau
        return tau

    def phase(self, cycle: int) -> float:
        """Phase of the gait at a cycle, 0 to below 1 stride; 0 is right heel strike."""
        return self.dmp.phase(cycle)

    def _refer(self, cycle: int) -> None:
        """Bring the primitive to `cycle` and the reference in `state` with it."""
        state = self.state
        dmp, primitive = self.dmp, state.dmp
        if cycle < primitive.cycle:
            raise HlcError(
                f"controller: cycle {cycle} given after cycle {state.cycle}, allowed are rising cycles; "
                "restart() goes back"
            )
        while primitive.cycle < cycle:
            dmp.step(primitive)
        q_d = list(primitive.y)
        dq_d, ddq_d = dmp.reference(primitive)
        if cycle < self.time_zero_cycle:
            self._fade(cycle, q_d, dq_d, ddq_d)
        state.q_d, state.dq_d, state.ddq_d = q_d, dq_d, ddq_d

    def _fade(self, cycle: int, q_d: list[float], dq_d: list[float], ddq_d: list[float]) -> None:
        """Turn q(t) at `cycle` into s(t) q(t), and its acceleration `ahead_ns` later into that of the latter."""
        params = self.params
        q_then, dq_then = self._q_then, self._dq_then
        self.dmp.ahead(self.state.dmp, q_then, dq_then)
        now_ns = cycle * params.cycle_ns
        s, ds, _ = fade_in(now_ns, params.stride_ns)
        s_then, ds_then, dds_then = fade_in(now_ns + params.ahead_ns, params.stride_ns)
        for j in range(self.n_joints):
            dq_d[j] = ds * q_d[j] + s * dq_d[j]
            q_d[j] = s * q_d[j]
            ddq_d[j] = dds_then * q_then[j] + 2.0 * ds_then * dq_then[j] + s_then * ddq_d[j]


def build_controller(
    params: ControllerParams, joint_names: tuple[str, ...], recording: Recording, mjcf: str
) -> Controller:
    """Learn the recorded gait, compile the model and join them; takes some milliseconds."""
    gait = Gait(params.stride_ns, joint_names, recording)
    return Controller(params, RhythmicDmp(gait, params.cycle_ns, params.ahead_ns), Dynamics(mjcf, joint_names))


def fade_in(since_ns: int, length_ns: int) -> tuple[float, float, float]:
    """The quintic from 0 to 1 with its derivatives: s, s' [1/s], s'' [1/s^2]; at rest outside 0..length_ns."""
    if since_ns <= 0:
        return 0.0, 0.0, 0.0
    if since_ns >= length_ns:
        return 1.0, 0.0, 0.0
    u = since_ns / length_ns
    rate = 1e9 / length_ns
    s = u * u * u * (10.0 + u * (6.0 * u - 15.0))
    ds = 30.0 * u * u * (1.0 + u * (u - 2.0)) * rate
    dds = 60.0 * u * (1.0 + u * (2.0 * u - 3.0)) * rate * rate
    return s, ds, dds
