"""Encoder, speed estimate and hall sensors."""

import itertools
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.signal import lfilter

from joint_emulators.errors import JointEmulatorError
from joint_emulators.sensors import (
    ENCODER,
    INT32_MAX,
    INT32_MIN,
    VELOCITY,
    EncoderParams,
    HallParams,
    JointSensor,
    VelocityEstimateParams,
    VelocityEstimateState,
    encode,
    estimate_velocity,
    hall_state,
    sample,
    to_int32,
)

COUNT_RAD = 2.0 * math.pi / 131072


@pytest.mark.parametrize(
    ("q", "counts"),
    [
        (0.0, 0),
        (2.0 * math.pi, 131072),
        (-math.pi / 2, -32768),
        (0.49 * COUNT_RAD, 0),
        (0.51 * COUNT_RAD, 1),
        (-0.49 * COUNT_RAD, 0),
        (-0.51 * COUNT_RAD, -1),
        (1.49 * COUNT_RAD, 1),
        (1.51 * COUNT_RAD, 2),
    ],
)
def test_encoder_gives_the_nearest_count(q: float, counts: int) -> None:
    """17 bit per joint revolution, rounded to the nearest count."""
    assert encode(q, ENCODER) == counts


@given(st.floats(-1000.0, 1000.0))
def test_encoder_is_never_off_by_more_than_half_a_count(q: float) -> None:
    """Quantisation bound: half a count, and double rounding at 2e7 counts (1e-8)."""
    assert abs(encode(q, ENCODER) * COUNT_RAD - q) <= (0.5 + 1e-6) * COUNT_RAD


@given(st.floats(-10.0, 10.0), st.integers(-1000, 1000))
def test_offset_is_added_in_counts_and_direction_mirrors_the_angle(q: float, offset: int) -> None:
    """offset: counts at q = 0; direction -1 counts the other way."""
    assert encode(q, EncoderParams(4096, offset, 1)) == encode(q, EncoderParams(4096, 0, 1)) + offset
    assert encode(q, EncoderParams(4096, offset, -1)) == encode(-q, EncoderParams(4096, offset, 1))


@pytest.mark.parametrize(
    ("turns", "counts"),
    [
        (16383.0, 16383 * 131072),
        (16384.0, INT32_MAX),
        (1e300, INT32_MAX),
        (-16384.0, INT32_MIN),
        (-16385.0, INT32_MIN),
    ],
)
def test_counts_clip_at_int32(turns: float, counts: int) -> None:
    """0x6064 is an INTEGER32: it clips, it does not wrap."""
    assert encode(turns * 2.0 * math.pi, ENCODER) == counts


@pytest.mark.parametrize(("counts", "direction"), [(0, 1), (-4, 1), (4096, 0), (4096, 2)])
def test_impossible_encoder_is_refused(counts: int, direction: int) -> None:
    """Counts from 1, direction 1 or -1."""
    with pytest.raises(JointEmulatorError, match="allowed"):
        EncoderParams(counts, 0, direction)


def run_estimate(counts: list[int], params: VelocityEstimateParams = VELOCITY) -> list[int]:
    state = VelocityEstimateState()
    return [to_int32(estimate_velocity(params, state, value)) for value in counts]


@given(st.lists(st.floats(-2e5, 2e5), max_size=30), st.integers(-1000, 1000), st.sampled_from([1, -1]))
def test_sensor_of_a_joint_is_encoder_and_speed_estimate_in_one(
    angles: list[float], offset: int, direction: int
) -> None:
    """`sample`: to the last bit what `encode` and `estimate_velocity` give, beyond int32 too."""
    params = EncoderParams(131072, offset, direction)
    sensor, state = JointSensor(params, VELOCITY), VelocityEstimateState()
    for at, q in enumerate(angles):
        sample([sensor], [q], [float(at)])
        counts = encode(q, params)
        speed = estimate_velocity(VELOCITY, state, counts)
        assert (sensor.counts, sensor.speed, sensor.torque_nm) == (counts, speed, at)


def test_first_sample_has_no_speed_wherever_the_joint_stands() -> None:
    """One sample makes no difference."""
    assert run_estimate([123456, 123456, 123456]) == [0, 0, 0]


@pytest.mark.parametrize("step", [-700, -1, 1, 20, 142438])
def test_speed_follows_a_ramp_as_a_first_order_100_hz_low_pass(step: int) -> None:
    """Velocity actual = encoder difference with 100 Hz low-pass: v (1 - exp(-2 pi 100 t)), rounded to a count/s."""
    estimates = run_estimate([step * n for n in range(40)])
    for n, estimate in enumerate(estimates):
        expected = 1000.0 * step * (1.0 - math.exp(-2.0 * math.pi * 100.0 * 0.001 * n))
        assert abs(estimate - expected) <= 0.5 + 1e-6  # rounding to whole counts/s
    assert abs(estimates[-1] - 1000 * step) <= 0.5 + 1e-9 * abs(1000 * step)  # e^-25 of the step is left


def test_speed_equals_an_independent_filter_on_random_motion() -> None:
    """The same difference and pole through scipy.signal.lfilter."""
    counts = np.cumsum(np.random.default_rng(1).integers(-300, 300, 500))
    pole = math.exp(-2.0 * math.pi * 0.1)
    expected = lfilter([1.0 - pole], [1.0, -pole], np.diff(counts) * 1000.0)
    assert np.abs(np.array(run_estimate(counts.tolist())[1:]) - expected).max() <= 0.5 + 1e-6


@pytest.mark.parametrize("dq", [0.001, 0.3, 2.27, -6.83])
def test_quantisation_disturbs_the_speed_by_467_counts_per_s_at_most(dq: float) -> None:
    """Half a count either way in both samples, through the low-pass: gain x 1 count / 1 ms; + 0.5 for rounding."""
    estimates = run_estimate([encode(dq * 0.001 * n, ENCODER) for n in range(400)])
    assert VELOCITY.gain * 1000.0 == pytest.approx(466.5, abs=0.1)
    assert max(abs(value - dq / COUNT_RAD) for value in estimates[60:]) <= 467.0 + 0.5


def test_speed_clips_at_int32_and_recovers() -> None:
    """0x606C is an INTEGER32; a jump across the whole range of counts does not wrap."""
    estimates = run_estimate([INT32_MIN, INT32_MAX] + [INT32_MAX] * 100)
    assert estimates[1] == INT32_MAX
    assert estimates[-1] == 0


@pytest.mark.parametrize(("sample_s", "cutoff_hz"), [(0.0, 100.0), (0.001, 0.0), (-0.001, 100.0), (0.001, math.nan)])
def test_impossible_low_pass_is_refused(sample_s: float, cutoff_hz: float) -> None:
    """Sample time and cut-off are above 0."""
    with pytest.raises(JointEmulatorError, match="allowed"):
        VelocityEstimateParams(sample_s, cutoff_hz)


ONE_POLE = HallParams(1, 1.0, 0.0)


@pytest.mark.parametrize(("sector", "state"), list(enumerate([5, 1, 3, 2, 6, 4])))
@pytest.mark.parametrize("within_deg", [0.001, 30.0, 59.999])
def test_hall_sectors_of_60_degrees(sector: int, state: int, within_deg: float) -> None:
    """Three 120 degree signals: six sectors an electrical turn."""
    assert hall_state(math.radians(60.0 * sector + within_deg), ONE_POLE) == state


@pytest.mark.parametrize("signal", [0, 1, 2])
def test_hall_signals_are_high_for_half_a_turn_120_degrees_apart(signal: int) -> None:
    """Signal k is high from 120 k to 120 k + 180 electrical degrees."""
    for degree in range(360):
        high = hall_state(math.radians(degree + 0.5), ONE_POLE) >> signal & 1
        assert high == int((degree + 0.5 - 120.0 * signal) % 360.0 < 180.0)


@given(st.floats(-1e6, 1e6), st.integers(1, 40), st.floats(0.1, 200.0), st.floats(-10.0, 10.0))
def test_hall_state_is_always_legal(q: float, pole_pairs: int, gear: float, offset: float) -> None:
    """000 and 111 come from faults only."""
    assert 1 <= hall_state(q, HallParams(pole_pairs, gear, offset)) <= 6


@pytest.mark.parametrize("direction", [1, -1])
def test_one_joint_turn_gives_six_changes_per_pole_pair_and_gear_turn_one_signal_at_a_time(direction: int) -> None:
    """10 pole pairs behind a gear of 22: 1320 changes a joint turn, each in one signal."""
    params = HallParams(10, 22.0, 0.1)
    states = [hall_state(direction * 2.0 * math.pi * n / 13200, params) for n in range(13201)]
    changes = [a ^ b for a, b in itertools.pairwise(states) if a != b]
    assert len(changes) == 1320
    assert set(changes) == {1, 2, 4}


@pytest.mark.parametrize(("pole_pairs", "gear"), [(0, 22.0), (10, 0.0), (10, -1.0), (10, math.nan)])
def test_impossible_hall_sensors_are_refused(pole_pairs: int, gear: float) -> None:
    """Pole pairs from 1, gear above 0."""
    with pytest.raises(JointEmulatorError, match="allowed"):
        HallParams(pole_pairs, gear, 0.0)
