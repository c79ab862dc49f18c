"""Table 1 at its edges, outcome, verdict and expectations."""

import dataclasses
import math
from collections.abc import Callable, Sequence

import numpy as np
import pytest

from fi_gateway.activation import Activation
from hlc.limits import JointLimits, limits_of
from testbench import expect
from testbench.errors import BenchError
from testbench.expect import parse_expectation
from testbench.golden import compare, tracking_rmse
from testbench.record import Commands, RunRecord, Truth
from testbench.verdict import evaluate, judge, limit_errors, limit_failures, quantities

RunMaker = Callable[..., RunRecord]
ActivationMaker = Callable[..., Activation]

SIX = ("left_hip", "left_knee", "left_ankle", "right_hip", "right_knee", "right_ankle")
LIMITS = {joint: limits_of(joint) for joint in SIX}
INSIDE = np.radians([10.0, -30.0, 0.0, 10.0, -30.0, 0.0])
TIMES = np.arange(8) / 1000  # 0..7 ms; the motion of these tests lasts 5 ms
DURATION_S = 0.005


def truth(joint: str = "right_knee", q: float | None = None, dq: float = 0.0, at: Sequence[int] = (3,)) -> Truth:
    """Six joints inside every limit, but for one joint at some samples."""
    k = SIX.index(joint)
    angles, speeds = np.tile(INSIDE, (8, 1)), np.zeros((8, 6))
    for sample in at:
        angles[sample, k] = INSIDE[k] if q is None else q
        speeds[sample, k] = dq
    return Truth(TIMES, angles, speeds, np.zeros((8, 6)))


def commands(joint: str = "right_knee", torque_nm: float = 0.0, at: int = 1) -> Commands:
    """Torque commands every 2 ms, nought but for one."""
    torque = np.zeros((4, 6))
    torque[at, SIX.index(joint)] = torque_nm
    return Commands(TIMES[::2], np.zeros((4, 6)), np.zeros((4, 6)), torque)


def above(value: float) -> float:
    return math.nextafter(value, math.inf)


def below(value: float) -> float:
    return math.nextafter(value, -math.inf)


@pytest.mark.parametrize(
    ("kind", "torque_nm", "speed_rpm", "min_deg", "max_deg"),
    [("hip", 72.9, 23.4, -30, 90), ("knee", 54.9, 65.2, -90, 0), ("ankle", 128.7, 50.8, -30, 30)],
)
@pytest.mark.parametrize("side", ["left", "right"])
def test_entries_carry_the_limits_of_table_1(
    side: str, kind: str, torque_nm: float, speed_rpm: float, min_deg: float, max_deg: float
) -> None:
    """ESREL 2020, table 1, in its own units and to the digit, for both sides."""
    joint = f"{side}_{kind}"
    far = truth(joint, q=100.0, dq=1000.0, at=(1,))
    (torque, speed) = sorted(
        limit_errors(SIX, LIMITS, far, commands(joint, 1e6), DURATION_S), key=lambda entry: entry.kind, reverse=True
    )
    (high,) = limit_failures(SIX, LIMITS, far, DURATION_S, 0.0)
    (low,) = limit_failures(SIX, LIMITS, truth(joint, q=-100.0), DURATION_S, 0.0)
    assert (torque.joint, torque.kind, torque.limit) == (joint, "torque", torque_nm)
    assert (speed.joint, speed.kind, speed.limit) == (joint, "speed", speed_rpm)
    assert (low.joint, low.kind, low.limit) == (joint, "min_angle", min_deg)
    assert (high.joint, high.kind, high.limit) == (joint, "max_angle", max_deg)


@pytest.mark.parametrize("sign", [1, -1])
@pytest.mark.parametrize("joint", SIX)
def test_torque_is_an_error_only_beyond_its_limit(joint: str, sign: int) -> None:
    """|command| > limit: the limit itself is inside, the next number is not, in either direction."""
    limit = LIMITS[joint].torque_nm
    for value, count in ((below(limit), 0), (limit, 0), (above(limit), 1)):
        found = limit_errors(SIX, LIMITS, truth(), commands(joint, sign * value), DURATION_S)
        assert [entry.kind for entry in found] == ["torque"] * count


@pytest.mark.parametrize("sign", [1, -1])
@pytest.mark.parametrize("joint", SIX)
def test_speed_is_an_error_only_beyond_its_limit(joint: str, sign: int) -> None:
    """|speed| > limit: the limit itself is inside, the next number is not, in either direction."""
    limit = LIMITS[joint].speed_rad_s
    for value, count in ((below(limit), 0), (limit, 0), (above(limit), 1)):
        found = limit_errors(SIX, LIMITS, truth(joint, dq=sign * value), commands(), DURATION_S)
        assert [entry.kind for entry in found] == ["speed"] * count


@pytest.mark.parametrize("tolerance_rad", [0.0, 0.01, math.radians(3)])
@pytest.mark.parametrize("joint", SIX)
def test_angle_is_a_failure_only_beyond_its_limit_by_more_than_the_tolerance(joint: str, tolerance_rad: float) -> None:
    """Failure = beyond the limit by more than `tolerance`, on both sides."""
    low, high = LIMITS[joint].min_angle_rad - tolerance_rad, LIMITS[joint].max_angle_rad + tolerance_rad
    expected = [
        (above(low), []),
        (low, []),
        (below(low), ["min_angle"]),
        (below(high), []),
        (high, []),
        (above(high), ["max_angle"]),
    ]
    for q, kinds in expected:
        found = limit_failures(SIX, LIMITS, truth(joint, q=q), DURATION_S, tolerance_rad)
        assert [entry.kind for entry in found] == kinds


@pytest.mark.parametrize(("sample", "counts"), [(0, True), (1, True), (5, True), (6, False), (7, False)])
def test_any_single_sample_of_the_motion_counts_and_none_after_it(sample: int, counts: bool) -> None:
    """Any single sample; 0 to the end of the motion only, both ends included."""
    far = truth("left_hip", q=2.0, dq=9.0, at=(sample,))
    assert bool(limit_failures(SIX, LIMITS, far, DURATION_S, 0.0)) is counts
    assert bool(limit_errors(SIX, LIMITS, far, commands(), DURATION_S)) is counts


@pytest.mark.parametrize(("sample", "counts"), [(0, True), (2, True), (3, False)])
def test_a_command_after_the_motion_does_not_count(sample: int, counts: bool) -> None:
    """Commands lie at 0, 2, 4 and 6 ms; the motion lasts 5 ms."""
    found = limit_errors(SIX, LIMITS, truth(), commands("left_hip", 100.0, at=sample), DURATION_S)
    assert bool(found) is counts


def test_what_happens_before_time_0_does_not_count() -> None:
    """Fading in is not judged."""
    early = Truth(TIMES - 0.001, np.vstack([[9.0] * 6, *[INSIDE] * 7]), np.zeros((8, 6)), np.zeros((8, 6)))
    assert limit_failures(SIX, LIMITS, early, DURATION_S, 0.0) == ()


def test_entry_has_the_first_time_and_the_worst_value() -> None:
    """One entry a joint and kind: first sample beyond, worst value of the run, in table units."""
    q = np.tile(INSIDE, (8, 1))
    q[2:6, 4] = np.radians([1.0, 12.0, 4.0, -120.0])
    found = limit_failures(SIX, LIMITS, Truth(TIMES, q, np.zeros((8, 6)), np.zeros((8, 6))), DURATION_S, 0.0)
    assert [(entry.kind, entry.time_s) for entry in found] == [("max_angle", 0.002), ("min_angle", 0.005)]
    assert [entry.value for entry in found] == pytest.approx([12.0, -120.0], rel=1e-12)


def test_speed_is_reported_in_rpm() -> None:
    """2 pi rad/s is 60 rpm; a negative speed counts by its magnitude."""
    (entry,) = limit_errors(SIX, LIMITS, truth("left_hip", dq=-2 * math.pi), commands(), DURATION_S)
    assert entry.value == pytest.approx(60.0, rel=1e-12)
    assert entry.limit == 23.4


def test_entries_come_in_order_of_time() -> None:
    """The first thing that went wrong stands first."""
    q = np.tile(INSIDE, (8, 1))
    q[4, 0], q[1, 5] = 3.0, 3.0
    found = limit_failures(SIX, LIMITS, Truth(TIMES, q, np.zeros((8, 6)), np.zeros((8, 6))), DURATION_S, 0.0)
    assert [entry.joint for entry in found] == ["right_ankle", "left_hip"]


def test_joint_without_limits_is_told(run_maker: RunMaker) -> None:
    """A joint is never left out of the judgement silently."""
    limits = {joint: limit for joint, limit in LIMITS.items() if joint != "left_knee"}
    with pytest.raises(BenchError, match=r"left_knee.*right_knee"):
        judge(SIX, limits, run_maker(), run_maker())


def wide(joint: str, **changed: float) -> dict[str, JointLimits]:
    """Limits nothing reaches, but for one."""
    limits = {name: JointLimits(1e6, 1e6, -1e6, 1e6) for name in SIX}
    values = {"torque_nm": 1e6, "speed_rad_s": 1e6, "min_angle_rad": -1e6, "max_angle_rad": 1e6} | changed
    limits[joint] = JointLimits(**values)
    return limits


@pytest.mark.parametrize(
    ("activated", "limits", "outcome", "passed"),
    [
        (False, wide("right_knee"), "not_activated", True),
        (True, wide("right_knee"), "masked", True),
        (True, wide("right_knee", torque_nm=1.0), "error", True),
        (True, wide("right_knee", speed_rad_s=0.1), "error", True),
        (True, wide("right_knee", max_angle_rad=0.5), "failure", False),
        (True, wide("right_knee", torque_nm=1.0, max_angle_rad=0.5), "failure", False),
        (False, wide("right_knee", max_angle_rad=0.5), "failure", False),
        (True, wide("right_knee", max_angle_rad=-0.5), "invalid", False),  # the golden run fails as well
        (True, wide("right_knee", min_angle_rad=-0.5), "invalid", False),
        (False, wide("right_knee", torque_nm=1.0), "error", True),
    ],
)
def test_outcome_is_the_worst_that_happened(
    run_maker: RunMaker,
    activation_maker: ActivationMaker,
    activated: bool,
    limits: dict[str, JointLimits],
    outcome: str,
    passed: bool,
) -> None:
    """Verdict: any failure fails, errors alone do not."""
    faulted = run_maker(bump_rad=2.0, activations=[activation_maker()] if activated else [])
    found = judge(SIX, limits, run_maker(), faulted)
    assert (found.outcome, found.passed) == (outcome, passed)


@pytest.mark.parametrize(
    ("activated", "limits", "outcome", "passed"),
    [
        (True, wide("right_knee"), "detected_safe", True),
        (False, wide("right_knee"), "detected_safe", True),  # a cut cable is no injector's
        (True, wide("right_knee", torque_nm=1.0), "detected_safe", True),
        (True, wide("right_knee", max_angle_rad=0.5), "failure", False),
        (True, wide("right_knee", max_angle_rad=-0.5), "invalid", False),
    ],
)
def test_motion_that_was_ended_early_without_a_failure_is_detected_safe(
    run_maker: RunMaker,
    activation_maker: ActivationMaker,
    activated: bool,
    limits: dict[str, JointLimits],
    outcome: str,
    passed: bool,
) -> None:
    """Drive or controller ended the motion: safe unless a joint left its range all the same; errors are lesser."""
    faulted = run_maker(bump_rad=2.0, activations=[activation_maker()] if activated else [])
    found = judge(SIX, limits, run_maker(), dataclasses.replace(faulted, completed=False))
    assert (found.outcome, found.passed) == (outcome, passed)


def test_detected_safe_passes_on_errors_only_when_they_do_not_fail(run_maker: RunMaker) -> None:
    """`fail_on: error` counts errors whatever the outcome is called; `completed` can be asked for."""
    ended = dataclasses.replace(run_maker(), completed=False)
    limits = wide("left_hip", torque_nm=1.0)
    found = judge(SIX, limits, run_maker(), ended, fail_on="error")
    assert (found.outcome, found.passed) == ("detected_safe", False)
    wanted = [parse_expectation("completed == 1", SIX)]
    found = judge(SIX, limits, run_maker(), ended, expectations=wanted)
    assert (found.outcome, found.passed, found.expectations[0].found) == ("detected_safe", False, 0.0)
    assert judge(SIX, limits, run_maker(), run_maker(), expectations=wanted).passed


@pytest.mark.parametrize(
    ("changed", "outcome"),
    [
        ((), "not_activated"),
        ((0,), "not_manifested"),
        ((0, 0), "not_manifested"),
        ((1,), "masked"),
        ((0, 1), "masked"),
        ((1, 0), "masked"),
        ((150, 148), "masked"),
    ],
)
def test_faults_that_changed_no_frame_are_not_masked(
    run_maker: RunMaker, activation_maker: ActivationMaker, changed: tuple[int, ...], outcome: str
) -> None:
    """Masked says something about the rig only when a frame really came out different: one of any activation."""
    activations = []
    for index, frames in enumerate(changed):
        one = activation_maker(index=index)
        one.frames_changed = frames
        activations.append(one)
    found = judge(SIX, wide("left_hip"), run_maker(), run_maker(activations=activations))
    assert (found.outcome, found.passed) == (outcome, True)


def test_not_manifested_is_the_least_that_can_be_said(
    run_maker: RunMaker, activation_maker: ActivationMaker
) -> None:
    """An error, a motion that was ended, or a failure is worse, and is said instead."""
    one = activation_maker()
    one.frames_changed = 0
    faulted = run_maker(bump_rad=2.0, activations=[one])
    ended = dataclasses.replace(faulted, completed=False)
    assert judge(SIX, wide("right_knee", torque_nm=1.0), run_maker(), faulted).outcome == "error"
    assert judge(SIX, wide("right_knee"), run_maker(), ended).outcome == "detected_safe"
    assert judge(SIX, wide("right_knee", max_angle_rad=0.5), run_maker(), faulted).outcome == "failure"


@pytest.mark.parametrize(("tolerance_deg", "outcome"), [(0.0, "invalid"), (1.9, "invalid"), (2.1, "not_activated")])
def test_golden_run_is_held_to_the_same_tolerance(run_maker: RunMaker, tolerance_deg: float, outcome: str) -> None:
    """A golden run 2 deg beyond a limit: invalid unless the scenario allows as much."""
    top = run_maker().truth.q[:, 4].max()
    limits = wide("right_knee", max_angle_rad=top - math.radians(2.0))
    found = judge(SIX, limits, run_maker(), run_maker(), tolerance_rad=math.radians(tolerance_deg))
    assert (found.outcome, bool(found.golden_failures)) == (outcome, outcome == "invalid")


@pytest.mark.parametrize(("fail_on", "passed"), [("failure", True), ("error", False)])
def test_errors_fail_only_when_asked_for(run_maker: RunMaker, fail_on: str, passed: bool) -> None:
    """`fail_on: error` makes errors fail."""
    found = judge(SIX, wide("left_hip", torque_nm=1.0), run_maker(), run_maker(), fail_on=fail_on)
    assert (found.outcome, found.passed) == ("error", passed)


@pytest.mark.parametrize("which", ["golden", "faulted"])
def test_invalid_run_never_passes(run_maker: RunMaker, which: str) -> None:
    """A run that proves nothing is not a pass, whichever of the pair it is."""
    bad, good = run_maker(invalid_reasons=["drive bus: 3 frames lost"]), run_maker()
    found = judge(SIX, wide("left_hip"), bad if which == "golden" else good, bad if which == "faulted" else good)
    assert (found.outcome, found.passed) == ("invalid", False)


def test_tolerance_moves_failures_but_not_the_count_at_3_deg(run_maker: RunMaker) -> None:
    """Failures at the stated tolerance; beside them always those at 3 deg."""
    top = run_maker().truth.q[:, 4].max()
    for beyond_deg, tolerance_deg, failures, at_3deg in (
        (2.0, 0.0, 1, 0),
        (2.0, 2.5, 0, 0),
        (4.0, 0.0, 1, 1),
        (4.0, 5.0, 0, 1),
    ):
        limits = wide("right_knee", max_angle_rad=top - math.radians(beyond_deg))
        found = judge(SIX, limits, run_maker(), run_maker(), tolerance_rad=math.radians(tolerance_deg))
        assert (len(found.failures), len(found.failures_at_3deg)) == (failures, at_3deg)
        assert found.tolerance_deg == tolerance_deg
        assert found.passed is (failures == 0)


def test_golden_run_is_judged_for_itself(run_maker: RunMaker) -> None:
    """A rig that fails without any fault proves nothing about faults: the pair is invalid, and says why."""
    found = judge(SIX, LIMITS, run_maker(bump_rad=2.0), run_maker())
    assert [entry.kind for entry in found.golden_failures] == ["max_angle"]
    assert {entry.kind for entry in found.golden_errors} == {"torque", "speed"}
    assert found.failures == found.errors == ()
    assert (found.outcome, found.passed) == ("invalid", False)


@pytest.mark.parametrize(
    ("name", "value"), [("fail_on", "never"), ("tolerance_rad", -1e-9), ("tolerance_rad", math.nan)]
)
def test_settings_that_make_no_sense_are_refused(run_maker: RunMaker, name: str, value: object) -> None:
    """What, got, allowed."""
    with pytest.raises(BenchError, match="given, allowed"):
        judge(SIX, LIMITS, run_maker(), run_maker(), **{name: value})  # type: ignore[arg-type]


def test_every_documented_quantity_is_found_and_no_other(run_maker: RunMaker) -> None:
    """What a scenario may name is what a judgement can answer."""
    run = run_maker()
    found = quantities(
        compare(SIX, run.truth, run.truth, 7.0), tracking_rmse(SIX, run.truth, run.commands, 7.0), 0, 0, run
    )
    assert set(found) == set(expect.quantities(SIX))


@pytest.mark.parametrize(
    ("line", "met"),
    [
        ("failures == 0", False),
        ("failures >= 1", True),
        ("failures != 1", False),
        ("errors <= 2", True),
        ("errors < 2", False),
        ("injections == 1", True),
        ("golden.tracking_rmse < 0.01 rad", True),
        ("golden.tracking_rmse < 0.0001 rad", False),
        ("golden.tracking_rmse.right_hip < 1 deg", True),
        ("joints.right_knee.rmse_position > 0.1 rad", True),
        ("joints.left_knee.rmse_position > 0 rad", False),
        ("joints.right_knee.max_angle > 0 deg", True),
        ("joints.right_knee.max_angle > 40 deg", False),
        ("joints.right_knee.max_speed > 65.2 rpm", True),
        ("joints.right_knee.max_torque < 1000 N m", True),
    ],
)
def test_expect_line_is_judged_in_its_own_unit(
    run_maker: RunMaker, activation_maker: ActivationMaker, line: str, met: bool
) -> None:
    """`expect:` lines compare in SI what was written with any unit; one that is not met fails the verdict."""
    faulted = run_maker(bump_rad=1.2, activations=[activation_maker()])
    limits = LIMITS | {"right_knee": JointLimits(1e6, 1.0, -9.0, 9.0)}
    found = judge(SIX, limits, run_maker(), faulted, expectations=[parse_expectation(line, SIX)])
    # with these limits the right knee has one error (speed) and no failure; failures are made with the next
    strict = judge(SIX, LIMITS, run_maker(), faulted, expectations=[parse_expectation(line, SIX)])
    assert found.passed is found.expectations[0].met
    assert strict.expectations[0].text == line
    assert strict.expectations[0].met is met


def test_value_found_is_reported_with_the_line(run_maker: RunMaker) -> None:
    """An expectation that is not met says what was found, in SI."""
    lines = [parse_expectation("joints.right_knee.min_angle > -10 deg", SIX), parse_expectation("errors == 0", SIX)]
    found = judge(SIX, wide("left_hip"), run_maker(), run_maker(), expectations=lines)
    assert [one.met for one in found.expectations] == [False, True]
    assert found.expectations[0].found == pytest.approx(math.radians(-58), rel=1e-6)  # samples miss the very peak
    assert not found.passed


def test_unknown_quantity_or_operator_raises_and_lists_what_there_is() -> None:
    """A line that cannot be judged is never taken as met."""
    with pytest.raises(BenchError, match=r"unknown quantity 'falls', allowed are errors"):
        evaluate(expect.Expectation("falls", "<", 1.0, "falls < 1"), {"errors": 0.0})
    with pytest.raises(BenchError, match=r"operator '~' given, allowed are <"):
        evaluate(expect.Expectation("errors", "~", 1.0, "errors ~ 1"), {"errors": 0.0})
