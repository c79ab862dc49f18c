"""Rhythmic dynamic movement primitives, all joints on one phase.

Source: Ijspeert, Nakanishi, Hoffmann, Pastor & Schaal (2013), Neural Computation 25(2), section 2.1, as the exoskeleton
paper uses them:

    tau z' = alpha_z (beta_z (g - y) - z) + f(phi),   tau y' = z,   tau phi' = 1,   beta_z = alpha_z / 4
    f(phi) = sum psi_i w_i / sum psi_i,   psi_i = exp(width (cos(phi - c_i) - 1)),   tau = stride time / 2 pi

(amplitude 1). The weights w are least squares on the f that the recorded gait asks for.

Integration is exact, not approximate. With beta_z = alpha_z / 4 the homogeneous part is a double pole at
-a, a = alpha_z / (2 tau), whose transition over a time h is known in closed form:

    (y - g, z)  ->  exp(-a h) [[1 + a h, h / tau], [-a^2 h tau, 1 - a h]] (y - g, z)

and the part that f adds over a cycle depends on the phase alone. A stride is a whole number of cycles, so the phases
are a fixed grid and those parts a table made once. The phase is the cycle number modulo that grid: it cannot drift.
y and z stay true states: pushed off the gait or given another goal, they return by the equations above.

Cost for six joints in plain Python floats: `step` 0.7 us, `ahead` 1.1 us. The step with numpy arrays of six took
2.8 us: ten small operations, each with its overhead (CPython 3.11, numpy 2.4).
Leaves out: discrete primitives, changes of tau while running, coupling terms.
"""

import math
from typing import Final, final

import numpy as np
from numpy.typing import NDArray

from hlc.errors import HlcError
from hlc.gait import Gait

Array = NDArray[np.float64]

ALPHA_Z: Final = 25.0
"""Gain of the transformation system: the value customary in the literature, the paper gives none."""

BETA_Z: Final = ALPHA_Z / 4
"""Critical damping (the paper's equations)."""

BASIS_FUNCTIONS: Final = 25
"""With WIDTH they reproduce seven harmonics to below 1e-7 rad."""

WIDTH: Final = 10.0
"""Concentration of the von Mises bells: narrower ones (30) leave 1e-4 rad and 0.6 rad/s^2 of ripple, wider ones (2.5)
make the weights 60 times larger."""

_NODES: Final = 8
"""Gauss-Legendre nodes per integral: exact to rounding, f changes little within a cycle."""

MAX_CYCLES: Final = 100_000
"""Longest stride in cycles: the tables hold four values a joint and cycle."""


@final
class RhythmicState:
    """Where the primitive is. cycle: cycles since phase 0; y: rad; z: rad (tau y'); goal: rad. Lists of n_joints."""

    __slots__ = ("cycle", "goal", "y", "z")

    def __init__(self) -> None:
        self.cycle: int = 0
        self.y: list[float] = []
        self.z: list[float] = []
        self.goal: list[float] = []


@final
class RhythmicDmp:
    """A learned rhythmic primitive; never changed after it is made, state is kept apart.

    cycle_ns: time of one step [ns]; ahead_ns: how far `ahead` looks [ns], from the state's cycle.
    n_cycles: cycles in a stride; tau_s: tau [s].
    """

    def __init__(self, gait: Gait, cycle_ns: int, ahead_ns: int) -> None:
        self.n_cycles: Final[int] = cycles_per_stride(gait.stride_ns, cycle_ns)
        if not 0 <= ahead_ns < gait.stride_ns:
            raise HlcError(f"primitive: ahead by {ahead_ns} ns given, allowed 0 to below a stride, {gait.stride_ns} ns")
        self.joint_names: Final[tuple[str, ...]] = gait.joint_names
        self.n_joints: Final[int] = len(gait.joint_names)
        self.stride_ns: Final[int] = gait.stride_ns
        self.cycle_ns: Final[int] = cycle_ns
        self.ahead_ns: Final[int] = ahead_ns
        self.tau_s: Final[float] = gait.stride_ns * 1e-9 / (2 * math.pi)
        self._per_tau: Final[float] = 1.0 / self.tau_s
        self.weights: Final = learn_weights(gait)
        self._start_y: Final[list[float]] = gait.q(np.zeros(1))[0].tolist()
        self._start_z: Final[list[float]] = (self.tau_s * gait.dq(np.zeros(1))[0]).tolist()
        self._goal: Final[list[float]] = gait.mean().tolist()

        step_s, ahead_s = cycle_ns * 1e-9, ahead_ns * 1e-9
        self._yy: Final[float] = _transition(self.tau_s, step_s)[0]
        self._yz: Final[float] = _transition(self.tau_s, step_s)[1]
        self._zy: Final[float] = _transition(self.tau_s, step_s)[2]
        self._zz: Final[float] = _transition(self.tau_s, step_s)[3]
        self._ahead_yy: Final[float] = _transition(self.tau_s, ahead_s)[0]
        self._ahead_yz: Final[float] = _transition(self.tau_s, ahead_s)[1]
        self._ahead_zy: Final[float] = _transition(self.tau_s, ahead_s)[2]
        self._ahead_zz: Final[float] = _transition(self.tau_s, ahead_s)[3]

        phase = 2 * math.pi * np.arange(self.n_cycles) / self.n_cycles
        y, z = _forced(phase, self.weights, self.tau_s, step_s)
        self._step_y: Final[list[list[float]]] = y.tolist()
        self._step_z: Final[list[list[float]]] = z.tolist()
        y, z = _forced(phase, self.weights, self.tau_s, ahead_s)
        self._ahead_y: Final[list[list[float]]] = y.tolist()
        self._ahead_z: Final[list[list[float]]] = z.tolist()
        # tau^2 y'' = f - alpha_z (beta_z (y - g) + z), with y and z as they are `ahead_ns` later
        per_tau2 = 1.0 / self.tau_s**2
        force = basis(phase + ahead_s / self.tau_s) @ self.weights
        self._ahead_f: Final[list[list[float]]] = ((force - ALPHA_Z * (BETA_Z * y + z)) * per_tau2).tolist()
        yy, yz, zy, zz = _transition(self.tau_s, ahead_s)
        self._ahead_ay: Final[float] = -ALPHA_Z * (BETA_Z * yy + zy) * per_tau2
        self._ahead_az: Final[float] = -ALPHA_Z * (BETA_Z * yz + zz) * per_tau2

    def __deepcopy__(self, memo: dict[int, object]) -> "RhythmicDmp":
        """Itself: nothing in it changes."""
        return self

    def start(self) -> RhythmicState:
        """The state at phase 0 on the gait itself, so that there is nothing to settle."""
        state = RhythmicState()
        state.y = list(self._start_y)
        state.z = list(self._start_z)
        state.goal = list(self._goal)
        return state

    def phase(self, cycle: int) -> float:
        """Phase of a cycle, 0 to below 1 stride; exact for any cycle number."""
        return (cycle % self.n_cycles) / self.n_cycles

    def step(self, state: RhythmicState) -> None:
        """Advance the state by one cycle."""
        at = state.cycle % self.n_cycles
        forced_y, forced_z = self._step_y[at], self._step_z[at]
        yy, yz, zy, zz = self._yy, self._yz, self._zy, self._zz
        y, z = state.y, state.z
        for j, goal in enumerate(state.goal):
            gap = y[j] - goal
            rate = z[j]
            y[j] = goal + yy * gap + yz * rate + forced_y[j]
            z[j] = zy * gap + zz * rate + forced_z[j]
        state.cycle += 1

    def ahead(self, state: RhythmicState, q: list[float], dq: list[float]) -> None:
        """Write angle and velocity at `ahead_ns` after the state's cycle: rad, rad/s."""
        at = state.cycle % self.n_cycles
        forced_y, forced_z = self._ahead_y[at], self._ahead_z[at]
        yy, yz, zy, zz = self._ahead_yy, self._ahead_yz, self._ahead_zy, self._ahead_zz
        y, z, goal = state.y, state.z, state.goal
        per_tau = self._per_tau
        for j in range(self.n_joints):
            gap = y[j] - goal[j]
            q[j] = goal[j] + yy * gap + yz * z[j] + forced_y[j]
            dq[j] = (zy * gap + zz * z[j] + forced_z[j]) * per_tau

    def reference(self, state: RhythmicState) -> tuple[list[float], list[float]]:
        """Velocity [rad/s] at the state's cycle, and acceleration [rad/s^2] `ahead_ns` after it: (n_joints,) each."""
        ay, az, per_tau = self._ahead_ay, self._ahead_az, self._per_tau
        dq = [0.0] * self.n_joints
        ddq = [0.0] * self.n_joints
        y, z, force = state.y, state.z, self._ahead_f[state.cycle % self.n_cycles]
        for j, goal in enumerate(state.goal):
            rate = z[j]
            dq[j] = rate * per_tau
            ddq[j] = force[j] + ay * (y[j] - goal) + az * rate
        return dq, ddq


def cycles_per_stride(stride_ns: int, cycle_ns: int) -> int:
    """Cycles in a stride; raises HlcError unless it is a whole number within reason."""
    if cycle_ns <= 0 or stride_ns <= 0 or stride_ns % cycle_ns or stride_ns // cycle_ns > MAX_CYCLES:
        raise HlcError(
            f"primitive: stride of {stride_ns} ns with a cycle of {cycle_ns} ns given; allowed is a stride of 1 to "
            f"{MAX_CYCLES} whole cycles, so that phases repeat exactly: make the stride time a multiple of the cycle"
        )
    return stride_ns // cycle_ns


def basis(phase: Array) -> Array:
    """Normalised von Mises bells at phases (n,) [rad]: (n, BASIS_FUNCTIONS), each row sums to 1."""
    centres = 2 * np.pi * np.arange(BASIS_FUNCTIONS) / BASIS_FUNCTIONS
    bells = np.exp(WIDTH * (np.cos(phase[:, None] - centres) - 1.0))
    normalised: Array = bells / bells.sum(axis=1, keepdims=True)
    return normalised


def learn_weights(gait: Gait) -> Array:
    """Weights (BASIS_FUNCTIONS, n_joints) [rad] whose f makes the gait the solution, by least squares over a stride."""
    turns = np.arange(20 * BASIS_FUNCTIONS) / (20 * BASIS_FUNCTIONS)
    tau_s = gait.stride_ns * 1e-9 / (2 * math.pi)
    gap = gait.q(turns) - gait.mean()
    target = tau_s**2 * gait.ddq(turns) + ALPHA_Z * (BETA_Z * gap + tau_s * gait.dq(turns))
    weights: Array = np.linalg.lstsq(basis(2 * np.pi * turns), target, rcond=None)[0].astype(np.float64)
    return weights


def _transition(tau_s: float, time_s: float) -> tuple[float, float, float, float]:
    """What (y - g, z) becomes after `time_s` without f: the four coefficients, row by row."""
    ah = ALPHA_Z / (2 * tau_s) * time_s
    decay = math.exp(-ah)
    return decay * (1 + ah), decay * time_s / tau_s, -decay * ah * ALPHA_Z / 2, decay * (1 - ah)


def _forced(phase: Array, weights: Array, tau_s: float, time_s: float) -> tuple[Array, Array]:
    """What f adds to y and z within `time_s` from each phase (n,) [rad] on: two arrays (n, n_joints), rad.

    An impulse f ds / tau in z, a time s before the end, leaves the second column of the transition over s.
    """
    nodes, node_weights = np.polynomial.legendre.leggauss(_NODES)
    y = np.zeros((len(phase), weights.shape[1]))
    z = np.zeros_like(y)
    for node, node_weight in zip(nodes, node_weights, strict=True):
        since = 0.5 * time_s * (1.0 + float(node))
        impulse = basis(phase + since / tau_s) @ weights * (0.5 * time_s * float(node_weight) / tau_s)
        _, to_y, _, to_z = _transition(tau_s, time_s - since)
        y += to_y * impulse
        z += to_z * impulse
    return y, z
