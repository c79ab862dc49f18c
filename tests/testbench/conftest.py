"""Runs that never ran: smooth sinusoids for six joints, with and without a fault at the right knee."""

from collections.abc import Callable, Sequence

import numpy as np
import pytest

from canopen_exo.bus.frame import Frame
from canopen_exo.bus.medium import Transmission
from fi_gateway.activation import Activation
from testbench.record import Array, BusStats, Commands, RigEvent, RunRecord, Truth

JOINTS = ("left_hip", "left_knee", "left_ankle", "right_hip", "right_knee", "right_ankle")
MEAN_DEG = (10.0, -30.0, 0.0, 10.0, -30.0, 0.0)
SWING_DEG = (20.0, 28.0, 10.0, 20.0, 28.0, 10.0)
TORQUE_NM = (40.0, 25.0, 8.0, 40.0, 25.0, 8.0)
TIME0_NS = 3_000_056_000
STRIDE_S = 1.5


def wave(t_s: Array, order: int, lag_s: float = 0.0) -> Array:
    """The order-th derivative of every joint's angle, (n, 6), rad per s^order; left half a stride later."""
    rate = 2 * np.pi / STRIDE_S
    columns = []
    for k in range(6):
        phase = rate * (t_s - lag_s) + (np.pi if k < 3 else 0) + k
        value = np.radians(SWING_DEG[k]) * rate**order * np.sin(phase + order * np.pi / 2)
        columns.append(value + (np.radians(MEAN_DEG[k]) if order == 0 else 0))
    return np.stack(columns, axis=1)


def make_run(
    *,
    bump_rad: float = 0.0,
    start_s: float = 3.0,
    end_s: float = 3.4,
    activations: Sequence[Activation] = (),
    duration_s: float = 7.0,
    invalid_reasons: Sequence[str] = (),
) -> RunRecord:
    """A run whose right knee is `bump_rad` off at most, in a smooth bump; every joint lags its reference by 2 ms."""
    t_s = np.arange(round(duration_s * 1000) + 1) / 1000
    q, dq, tau = wave(t_s, 0, 0.002), wave(t_s, 1, 0.002), wave(t_s, 2) * np.array(TORQUE_NM) / 10
    width = end_s - start_s
    inside = (t_s > start_s) & (t_s < end_s)
    angle = 2 * np.pi * (t_s[inside] - start_s) / width
    q[inside, 4] += bump_rad * (1 - np.cos(angle)) / 2
    dq[inside, 4] += bump_rad * np.sin(angle) * np.pi / width
    tau[inside, 4] += bump_rad * 20 * np.cos(angle)
    t_command = t_s[::2]
    command = tau[::2].copy()
    command[(t_command > start_s) & (t_command < end_s), 4] += bump_rad * 100
    rows = [
        Transmission(TIME0_NS + k * 2_000_000, bus, Frame(0x80, bytes([k % 240 + 1])), 0)
        for k in range(50)
        for bus in (0, 1)
    ]
    return RunRecord(
        rows=rows,
        time0_ns=TIME0_NS,
        duration_ns=round(duration_s * 1e9),
        truth=Truth(t_s, q, dq, tau),
        commands=Commands(t_command, wave(t_command, 0), wave(t_command, 1), command),
        activations=list(activations),
        buses=(BusStats("controller", 42_000, 0.66), BusStats("drive", 42_000, 0.661)),
        notes=[RigEvent(3.1, "right_knee", "emcy", "0x8400 velocity")] if bump_rad else [],
        invalid_reasons=list(invalid_reasons),
    )


def make_activation(
    injector: str = "freeze_position",
    signal: str = "right_knee.position",
    start_s: float = 3.0,
    duration_s: float = 0.3,
    index: int = 0,
) -> Activation:
    """A closed activation on the loop's clock, with 150 frames seen and 148 changed."""
    start_ns = TIME0_NS + round(start_s * 1e9)
    made = Activation(injector, index, signal, "event", start_ns, start_ns, round(duration_s * 1e9))
    made.frames_seen, made.frames_injected, made.frames_changed = 150, 150, 148
    made.first_ns = start_ns + 1_000_000
    made.first_before = Frame(0x185, bytes.fromhex("0102030405060708"))
    made.first_after = Frame(0x185, bytes.fromhex("0000000005060708"))
    return made


@pytest.fixture(scope="session")
def joints() -> tuple[str, ...]:
    return JOINTS


@pytest.fixture(scope="session")
def run_maker() -> Callable[..., RunRecord]:
    return make_run


@pytest.fixture(scope="session")
def activation_maker() -> Callable[..., Activation]:
    return make_activation
