"""A record is checked where it is made."""

from collections.abc import Callable

import numpy as np
import pytest

from testbench.errors import BenchError
from testbench.record import Commands, RunRecord, Truth, motion_rows


def good(rows: int = 5, joints: int = 6) -> np.ndarray[tuple[int, int], np.dtype[np.float64]]:
    return np.zeros((rows, joints))


def test_truth_that_fits_together_is_kept_as_given() -> None:
    """Constructors store."""
    t_s = np.arange(5) / 1000
    truth = Truth(t_s, good(), good(), good())
    assert truth.t_s is t_s


@pytest.mark.parametrize(
    ("t_s", "q", "message"),
    [
        (np.arange(4) / 1000, good(5), "q of shape"),
        (np.arange(6) / 1000, good(5), "q of shape"),
        (np.arange(5) / 1000, np.zeros(5), "q of shape"),
        (np.zeros((5, 1)), good(5), "t_s of shape"),
        (np.zeros(0), good(0), "at least one instant"),
        (np.array([0, 1, 1, 2, 3]) / 1000, good(5), "rise"),
        (np.array([0, 2, 1, 3, 4]) / 1000, good(5), "rise"),
        (np.array([0, 1, 2, 3, np.nan]), good(5), "t_s is not finite"),
        (np.array([0, 1, 2, 3, np.inf]), good(5), "t_s is not finite"),
    ],
)
def test_arrays_that_do_not_fit_are_refused(
    t_s: np.ndarray[tuple[int], np.dtype[np.float64]],
    q: np.ndarray[tuple[int, int], np.dtype[np.float64]],
    message: str,
) -> None:
    """A record says what does not fit instead of taking sums over it."""
    with pytest.raises(BenchError, match=message):
        Truth(t_s, q, good(), good())


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("name", ["q_ref", "dq_ref", "tau_command"])
def test_number_that_is_not_finite_is_refused_by_name_and_instant(name: str, value: float) -> None:
    """No neutral value stands for failure: a NaN never reaches a mean."""
    bad = good()
    bad[3, 2] = value
    arrays = {key: bad if key == name else good() for key in ("q_ref", "dq_ref", "tau_command")}
    with pytest.raises(BenchError, match=rf"commands: {name} is not finite at row 3, t = 0\.006 s"):
        Commands(np.arange(5) / 500, **arrays)


@pytest.mark.parametrize(
    ("t_s", "inside"),
    [(-0.001, False), (-1e-9, False), (0.0, True), (0.001, True), (7.0, True), (7.0 + 1e-9, False), (7.001, False)],
)
def test_motion_is_closed_at_both_ends(t_s: float, inside: bool) -> None:
    """Limits hold in 0..7 s, ends included, to the nanosecond."""
    assert motion_rows(np.array([t_s]), 7.0).tolist() == [inside]


@pytest.mark.parametrize("start_ns", [0, 55_000, 3_000_056_000, 3_600_000_000_000])
def test_rounding_of_seconds_moves_no_sample_out_of_the_motion(start_ns: int) -> None:
    """7 s at 1 kHz are 7001 samples wherever time 0 lies on the loop's clock."""
    t_s = np.arange(start_ns - 10_000_000, start_ns + 7_010_000_001, 1_000_000) / 1e9 - start_ns / 1e9
    assert motion_rows(t_s, 7.0).sum() == 7001


def test_run_is_valid_exactly_when_there_is_no_reason_against_it(run_maker: Callable[..., RunRecord]) -> None:
    """A run is invalid for stated reasons only."""
    assert run_maker().valid
    assert not run_maker(invalid_reasons=["drive bus: 3 frames lost"]).valid
    assert run_maker(duration_s=1.5).duration_s == 1.5
