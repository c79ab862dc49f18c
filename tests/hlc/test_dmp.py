"""The rhythmic movement primitive."""

import copy
import math
from fractions import Fraction

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from hlc.dmp import (
    ALPHA_Z,
    BASIS_FUNCTIONS,
    BETA_Z,
    MAX_CYCLES,
    RhythmicDmp,
    RhythmicState,
    basis,
    cycles_per_stride,
)
from hlc.errors import HlcError
from hlc.gait import Gait, packaged_recording

NAMES = ("left_hip", "left_knee", "left_ankle", "right_hip", "right_knee", "right_ankle")
STRIDE_NS = 1_500_000_000
CYCLE_NS = 2_000_000


@pytest.fixture(scope="module")
def gait() -> Gait:
    return Gait(STRIDE_NS, NAMES, packaged_recording())


@pytest.fixture(scope="module")
def dmp(gait: Gait) -> RhythmicDmp:
    return RhythmicDmp(gait, CYCLE_NS, CYCLE_NS)


def run(dmp: RhythmicDmp, state: RhythmicState, cycles: int) -> tuple[np.ndarray, np.ndarray]:
    """Angles and velocities at the state's cycle and the next ones: two arrays (cycles, n_joints)."""
    y, dy = [], []
    for _ in range(cycles):
        y.append(list(state.y))
        dy.append([z / dmp.tau_s for z in state.z])
        dmp.step(state)
    return np.array(y), np.array(dy)


@pytest.mark.parametrize("cycle_ns", [1_000_000, 2_000_000, 10_000_000])
def test_primitive_reproduces_the_gait(gait: Gait, cycle_ns: int) -> None:
    """25 basis functions reproduce the gait to 1e-4 rad over fade-in and 7 s.

    Measured 5.3e-8 rad, 4e-6 rad/s, 3e-4 rad/s^2 (what the basis leaves); bounds twice that, far inside the promise.
    """
    dmp = RhythmicDmp(gait, cycle_ns, 0)
    state = dmp.start()
    cycles = 8_500_000_000 // cycle_ns
    accelerations = []
    ahead = copy.deepcopy(state)
    for _ in range(cycles):
        accelerations.append(dmp.reference(ahead)[1])
        dmp.step(ahead)
    y, dy = run(dmp, state, cycles)
    phases = np.arange(cycles) * cycle_ns / STRIDE_NS
    assert np.abs(y - gait.q(phases)).max() < 1e-7
    assert np.abs(dy - gait.dq(phases)).max() < 1e-5
    assert np.abs(np.array(accelerations) - gait.ddq(phases)).max() < 1e-3


def test_steps_solve_the_papers_equations(dmp: RhythmicDmp) -> None:
    """tau z' = alpha_z (beta_z (g - y) - z) + f, tau y' = z: against scipy's DOP853, off the gait, half a stride."""
    state = dmp.start()
    state.y = [0.3, -0.2, 0.1, 0.0, 0.5, -0.4]
    state.z = [0.1, 0.2, -0.3, 0.0, 0.0, 1.0]
    tau, goal, start = dmp.tau_s, np.array(state.goal), np.array(state.y + state.z)

    def rates(t: float, x: np.ndarray) -> np.ndarray:
        f = (basis(np.array([t / tau])) @ dmp.weights)[0]
        return np.concatenate((x[6:], ALPHA_Z * (BETA_Z * (goal - x[:6]) - x[6:]) + f)) / tau

    solution = solve_ivp(rates, (0.0, 0.75), start, method="DOP853", rtol=1e-10, atol=1e-12, t_eval=[0.01, 0.1, 0.75])
    for at, cycles in enumerate((5, 45, 325)):
        for _ in range(cycles):
            dmp.step(state)
        # 1e-8: rtol 1e-10 over the few hundred steps scipy takes
        assert state.y + state.z == pytest.approx(solution.y[:, at], abs=1e-8)


@pytest.mark.parametrize("cycles", [0, 1, 2, 7])
def test_looking_ahead_is_what_comes(gait: Gait, cycles: int) -> None:
    """`ahead` equals the state so many cycles later, from any state, without changing it."""
    dmp = RhythmicDmp(gait, CYCLE_NS, cycles * CYCLE_NS)
    state = dmp.start()
    state.cycle = 740  # the stride ends within the look-ahead
    state.y[2] += 0.2
    before = (list(state.y), list(state.z), state.cycle)
    q, dq = [0.0] * 6, [0.0] * 6
    dmp.ahead(state, q, dq)
    acceleration = dmp.reference(state)[1]
    assert (state.y, state.z, state.cycle) == before
    for _ in range(cycles):
        dmp.step(state)
    assert q == pytest.approx(state.y, abs=1e-12)
    assert dq == pytest.approx([z / dmp.tau_s for z in state.z], abs=1e-11)
    f = (basis(np.array([2 * np.pi * dmp.phase(state.cycle)])) @ dmp.weights)[0]
    gap = np.array(state.goal) - np.array(state.y)
    wanted = (ALPHA_Z * (BETA_Z * gap - np.array(state.z)) + f) / dmp.tau_s**2  # tau z' with z = tau y'
    assert acceleration == pytest.approx(wanted.tolist(), abs=1e-9)


def test_pushed_off_it_returns_as_a_double_pole(dmp: RhythmicDmp) -> None:
    """Critically damped, a = alpha_z / (2 tau): a push d leaves d (1 + a t) exp(-a t); other joints do not notice."""
    straight, pushed = dmp.start(), dmp.start()
    pushed.y[4] += 0.3
    a = ALPHA_Z / (2 * dmp.tau_s)
    y, dy = run(dmp, straight, 100)
    y_pushed, dy_pushed = run(dmp, pushed, 100)
    t = np.arange(100) * CYCLE_NS * 1e-9
    assert y_pushed[:, 4] - y[:, 4] == pytest.approx(0.3 * (1 + a * t) * np.exp(-a * t), abs=1e-12)
    assert dy_pushed[:, 4] - dy[:, 4] == pytest.approx(-0.3 * a * a * t * np.exp(-a * t), abs=1e-10)
    others = [0, 1, 2, 3, 5]
    assert (y_pushed[:, others] == y[:, others]).all()


def test_another_goal_moves_the_whole_gait(dmp: RhythmicDmp) -> None:
    """y - g obeys the same equation: after one stride (exp(-78)) the motion is the old one, shifted."""
    old, new = dmp.start(), dmp.start()
    new.goal[1] -= 0.25
    y_old, _ = run(dmp, old, 1500)
    y_new, _ = run(dmp, new, 1500)
    assert y_new[0, 1] == y_old[0, 1]
    assert y_new[750:, 1] - y_old[750:, 1] == pytest.approx(np.full(750, -0.25), abs=1e-12)


def test_left_leg_follows_half_a_stride_later(dmp: RhythmicDmp) -> None:
    """Each joint has its own weights, one phase: equal to what the basis can hold, 1e-7 rad (25 bells, half = 12.5)."""
    y, _ = run(dmp, dmp.start(), 1500)
    assert y[375:1125, :3] == pytest.approx(y[:750, 3:], abs=2e-7)


def test_phase_does_not_drift() -> None:
    """After 10^5 cycles and more the phase is the exact fraction, and the state that of the same phase early on."""
    gait = Gait(STRIDE_NS, NAMES[:1], packaged_recording())
    dmp = RhythmicDmp(gait, CYCLE_NS, 0)
    for cycle in (0, 1, 749, 750, 100_000, 10**15 + 1):
        assert dmp.phase(cycle) == float(Fraction(cycle * CYCLE_NS % STRIDE_NS, STRIDE_NS))
    first, late = dmp.start(), dmp.start()
    for _ in range(750 + 250):
        dmp.step(first)
    for _ in range(100_000):  # 133 strides and 250 cycles
        dmp.step(late)
    # a fixed point is reached but for rounding: no error grows with the number of cycles
    assert late.y == pytest.approx(first.y, abs=1e-14)
    assert late.z == pytest.approx(first.z, abs=1e-13)


def test_same_steps_same_bits(dmp: RhythmicDmp) -> None:
    """Deterministic; the primitive itself is shared by copies, the state is not."""
    state = dmp.start()
    run(dmp, state, 10)
    twin_dmp, twin = copy.deepcopy((dmp, state))
    assert twin_dmp is dmp
    assert twin is not state
    run(dmp, state, 900)
    run(twin_dmp, twin, 900)
    assert (twin.y, twin.z, twin.cycle) == (state.y, state.z, state.cycle)


def test_basis_is_periodic_even_and_sums_to_one() -> None:
    """Normalised von Mises bells: one centre to the next is a shift."""
    phase = np.linspace(0, 2 * math.pi, 101)
    bells = basis(phase)
    assert bells.shape == (101, BASIS_FUNCTIONS)
    assert bells.sum(axis=1) == pytest.approx(np.ones(101), abs=1e-14)
    assert basis(phase + 2 * math.pi) == pytest.approx(bells, abs=1e-13)
    spacing = 2 * math.pi / BASIS_FUNCTIONS
    assert basis(phase + spacing)[:, 1:] == pytest.approx(bells[:, :-1], abs=1e-13)


@pytest.mark.parametrize(
    ("stride_ns", "cycle_ns", "cycles"),
    [
        (STRIDE_NS, CYCLE_NS, 750),
        (STRIDE_NS, STRIDE_NS, 1),
        (MAX_CYCLES, 1, MAX_CYCLES),
        (MAX_CYCLES + 1, 1, None),
        (STRIDE_NS + 1, CYCLE_NS, None),
        (CYCLE_NS, STRIDE_NS, None),
        (STRIDE_NS, 0, None),
        (0, CYCLE_NS, None),
        (STRIDE_NS, -CYCLE_NS, None),
    ],
)
def test_a_stride_is_a_whole_number_of_cycles(stride_ns: int, cycle_ns: int, cycles: int | None) -> None:
    """So that phases are an exact grid."""
    if cycles is None:
        with pytest.raises(HlcError, match="whole cycles"):
            cycles_per_stride(stride_ns, cycle_ns)
    else:
        assert cycles_per_stride(stride_ns, cycle_ns) == cycles


@pytest.mark.parametrize("ahead_ns", [-1, STRIDE_NS])
def test_looking_ahead_is_bounded(gait: Gait, ahead_ns: int) -> None:
    """From 0 to below a stride."""
    with pytest.raises(HlcError, match="ahead"):
        RhythmicDmp(gait, CYCLE_NS, ahead_ns)
