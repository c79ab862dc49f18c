"""Comparison with the golden run, against closed forms."""

import math
from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from canopen_exo.bus.frame import Frame
from canopen_exo.bus.medium import Transmission
from testbench.errors import BenchError
from testbench.golden import compare, first_difference, rmse, tracking_rmse
from testbench.record import Array, Commands, RunRecord, Truth

ONE = ("right_knee",)
TWO = ("left_knee", "right_knee")


def truth(t_s: Array, q: Array, dq: Array | None = None, tau: Array | None = None) -> Truth:
    """A truth of one joint."""
    columns = [q, np.zeros_like(q) if dq is None else dq, np.zeros_like(q) if tau is None else tau]
    return Truth(t_s, *(column.reshape(-1, 1) for column in columns))


def commands(t_s: Array, q_ref: Array) -> Commands:
    empty = np.zeros((t_s.size, 1))
    return Commands(t_s, q_ref.reshape(-1, 1), empty, empty)


def test_equal_runs_differ_by_exactly_nothing(
    joints: tuple[str, ...], run_maker: Callable[..., RunRecord]
) -> None:
    """A run without a fault is its golden run."""
    found = compare(joints, run_maker().truth, run_maker().truth, 7.0)
    assert tuple(found) == joints
    assert all(one.rmse_position_rad == one.rmse_velocity_rad_s == one.rmse_torque_nm == 0.0 for one in found.values())


def test_only_the_joint_that_moved_differs(joints: tuple[str, ...], run_maker: Callable[..., RunRecord]) -> None:
    """Every joint is compared with its own golden run; the columns are not mixed up."""
    found = compare(joints, run_maker().truth, run_maker(bump_rad=0.5).truth, 7.0)
    assert [joint for joint, one in found.items() if one.rmse_position_rad > 0] == ["right_knee"]


def test_rmse_of_a_sine_over_whole_periods_is_its_amplitude_over_root_two() -> None:
    """Closed form: mean square of A sin over whole periods is A^2 / 2, exact for equidistant samples."""
    t_s = np.arange(7000) / 1000
    wave = 0.3 * np.sin(2 * np.pi * t_s)
    found = compare(ONE, truth(t_s, 0 * wave), truth(t_s, wave, 2 * wave, 10 * wave), 7.0)["right_knee"]
    assert found.rmse_position_rad == pytest.approx(0.3 / math.sqrt(2), rel=1e-12)  # rounding of 7000 terms
    assert found.rmse_velocity_rad_s == pytest.approx(0.6 / math.sqrt(2), rel=1e-12)
    assert found.rmse_torque_nm == pytest.approx(3.0 / math.sqrt(2), rel=1e-12)


@given(offset=st.floats(-100, 100), values=st.lists(st.floats(-10, 10), min_size=1, max_size=20))
def test_rmse_of_a_constant_offset_is_the_offset(offset: float, values: list[float]) -> None:
    """Closed form, whatever the motion."""
    a = np.array(values).reshape(-1, 1)
    assert rmse(a, a + offset)[0] == pytest.approx(abs(offset), abs=1e-12)  # rounding of 110 + offset


def test_a_whole_turn_is_not_wrapped_away() -> None:
    """A knee spun once round is 2 pi from where it was: plain difference."""
    t_s = np.arange(100) / 1000
    found = compare(ONE, truth(t_s, np.zeros(100)), truth(t_s, np.full(100, 2 * np.pi)), 0.099)["right_knee"]
    assert found.rmse_position_rad == pytest.approx(2 * math.pi, rel=1e-12)
    assert found.max_angle_deg == pytest.approx(360, rel=1e-12)


def test_extremes_are_those_of_the_faulted_run_in_table_units() -> None:
    """deg, rpm and N m; magnitudes for speed and torque."""
    t_s = np.arange(4) / 1000
    speed, torque = np.array([0.0, -2 * np.pi, np.pi, 0.0]), np.array([3.0, -7.0, 5.0, 0.0])
    faulted = truth(t_s, np.radians([-60.0, 5.0, 0.0, 1.0]), speed, torque)
    found = compare(ONE, truth(t_s, np.full(4, 9.0), np.full(4, 99.0), np.full(4, 999.0)), faulted, 0.003)["right_knee"]
    assert found.min_angle_deg == pytest.approx(-60, rel=1e-12)
    assert found.max_angle_deg == pytest.approx(5, rel=1e-12)
    assert found.max_speed_rpm == pytest.approx(60, rel=1e-12)
    assert found.max_torque_nm == 7.0


def test_samples_outside_the_motion_do_not_count() -> None:
    """Limits and RMSE: 0..duration only."""
    t_s = np.arange(-5, 15) / 1000
    wrong = np.where((t_s < 0) | (t_s > 0.01), 50.0, 0.0)
    found = compare(ONE, truth(t_s, np.zeros(20)), truth(t_s, wrong), 0.01)["right_knee"]
    assert found.rmse_position_rad == 0.0
    assert found.max_angle_deg == 0.0


@pytest.mark.parametrize(("shift_s", "rows"), [(0.0, 99), (0.0005, 100), (1e-8, 100)])
def test_runs_on_different_instants_are_not_compared(shift_s: float, rows: int) -> None:
    """A comparison of samples taken at different times would be no comparison."""
    golden = truth(np.arange(100) / 1000, np.zeros(100))
    other = truth(np.arange(rows) / 1000 + shift_s, np.zeros(rows))
    with pytest.raises(BenchError, match="different instants"):
        compare(ONE, golden, other, 1.0)


def test_names_and_columns_must_agree() -> None:
    """A joint too many is told, not cut off."""
    one = truth(np.arange(3) / 1000, np.zeros(3))
    with pytest.raises(BenchError, match="2 names"):
        compare(TWO, one, one, 1.0)


def test_tracking_compares_at_the_control_instants() -> None:
    """The reference at 500 Hz meets the truth at 1 kHz at the same instants, not sample by sample."""
    t_s = np.arange(1001) / 1000
    lag = 0.01
    found = tracking_rmse(ONE, truth(t_s, 3 * t_s - lag), commands(t_s[::2], 3 * t_s[::2]), 1.0)
    assert found["right_knee"] == pytest.approx(lag, rel=1e-9)  # cancellation of 3 against 0.01


def test_tracking_uses_the_sample_latched_at_the_sync() -> None:
    """Design: SYNC latches the last finished plant step, also when SYNC lies between two steps."""
    t_step = np.arange(101) / 1000 - 56e-6  # steps lie 56 us before the SYNC that latches them
    t_sync = np.arange(0, 100, 2) / 1000
    found = tracking_rmse(ONE, truth(t_step, np.arange(101.0)), commands(t_sync, np.arange(0.0, 100, 2)), 1.0)
    assert found["right_knee"] == 0.0


def test_rounding_of_seconds_does_not_change_the_sample() -> None:
    """The same nanosecond, reached by two ways of computing seconds, is the same instant."""
    t_s = np.arange(11) / 1000
    t_command = np.nextafter(t_s[2::2], -np.inf)
    found = tracking_rmse(ONE, truth(t_s, np.arange(11.0)), commands(t_command, np.arange(2.0, 11, 2)), 0.01)
    assert found["right_knee"] == 0.0


def test_tracking_leaves_out_what_is_outside_the_motion_or_has_no_sample() -> None:
    """Fading in is not tracking; an instant before the first sample has nothing to be compared with."""
    t_s = np.arange(0, 11) / 1000
    t_command = np.array([-0.002, 0.0, 0.002, 0.012])
    found = tracking_rmse(ONE, truth(t_s, np.zeros(11)), commands(t_command, np.array([9.0, 0.5, 0.5, 9.0])), 0.01)
    assert found["right_knee"] == 0.5
    with pytest.raises(BenchError, match="no control instant"):
        tracking_rmse(ONE, truth(t_s, np.zeros(11)), commands(np.array([-1.0]), np.zeros(1)), 0.01)


def row(time_ns: int, data: bytes = b"\x01", bus: int = 0, sender: int = 0) -> Transmission:
    return Transmission(time_ns, bus, Frame(0x181, data), sender)


@pytest.mark.parametrize(
    ("faulted", "index", "time_ns"),
    [
        ([row(1), row(2), row(3, b"\x02")], 2, 3),
        ([row(1), row(2), row(3, bus=1)], 2, 3),
        ([row(1), row(2), row(3, sender=1)], 2, 3),
        ([row(1), row(2), row(5)], 2, 3),
        ([row(0), row(2), row(3)], 0, 0),
        ([row(1), row(2)], 2, 3),
        ([row(1), row(2), row(3), row(9)], 3, 9),
        ([], 0, 1),
    ],
    ids=["data", "bus", "sender", "later", "earlier", "ends early", "goes on", "empty"],
)
def test_first_difference_is_found(faulted: list[Transmission], index: int, time_ns: int) -> None:
    """Traces part at the first row that differs in anything, or where one ends."""
    found = first_difference([row(1), row(2), row(3)], faulted)
    assert found is not None
    assert (found.index, found.time_ns) == (index, time_ns)
    assert found.faulted == (faulted[index] if index < len(faulted) else None)


@pytest.mark.parametrize("count", [0, 1, 3])
def test_equal_traces_have_no_difference(count: int) -> None:
    """The rows are compared by what they say, not by being the same objects."""
    assert first_difference([row(k) for k in range(count)], [row(k) for k in range(count)]) is None
