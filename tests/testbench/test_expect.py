"""`expect:` lines are read into a quantity, a comparison and an SI value, or refused with what is allowed."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from testbench.expect import Expectation, parse_expectation, quantities

JOINTS = ("left_knee", "right_knee")


@pytest.mark.parametrize(
    ("line", "path", "operator", "value"),
    [
        ("failures == 0", "failures", "==", 0),
        ("errors<=3", "errors", "<=", 3),
        ("  injections   !=   10 ", "injections", "!=", 10),
        ("golden.tracking_rmse < 0.01 rad", "golden.tracking_rmse", "<", 0.01),
        ("golden.tracking_rmse.left_knee < 1 deg", "golden.tracking_rmse.left_knee", "<", math.pi / 180),
        ("joints.right_knee.rmse_position >= 0.1 rad", "joints.right_knee.rmse_position", ">=", 0.1),
        ("joints.right_knee.rmse_velocity > 60 rpm", "joints.right_knee.rmse_velocity", ">", 2 * math.pi),
        ("joints.right_knee.max_torque < 54.9 N m", "joints.right_knee.max_torque", "<", 54.9),
        ("joints.right_knee.min_angle > -90 deg", "joints.right_knee.min_angle", ">", -math.pi / 2),
    ],
)
def test_a_line_is_quantity_operator_and_si_value(line: str, path: str, operator: str, value: float) -> None:
    """SI: rad, rad/s, N m; counts as they are. One rounding of a product is allowed."""
    found = parse_expectation(line, JOINTS)
    assert (found.path, found.operator) == (path, operator)
    assert found.value == pytest.approx(value, rel=2**-52, abs=0)
    assert parse_expectation(found.text, JOINTS) == found


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("failures", "expected QUANTITY OPERATOR VALUE"),
        ("failures = 0", "expected QUANTITY OPERATOR VALUE"),
        ("failures =< 0", "expected QUANTITY OPERATOR VALUE"),
        ("0 == failures", "expected QUANTITY OPERATOR VALUE"),
        ("failures ==", "expected QUANTITY OPERATOR VALUE"),
        ("", "expected QUANTITY OPERATOR VALUE"),
        (5, "got 5"),
        (None, "got nothing"),
        ({"failures": 0}, "got a mapping"),
        ("failure == 0", "unknown quantity 'failure'; did you mean 'failures'? (allowed: errors, failures,"),
        ("golden.tracking_rmse_rad < 1 rad", "did you mean 'golden.tracking_rmse'?"),
        ("joints.left_hip.max_speed < 1 rpm", "with JOINT one of left_knee, right_knee"),
        ("failures == 0.5", "failures is a count; expected a whole number such as 0, got '0.5'"),
        ("failures == -1", "is a count"),
        ("failures == 0 rad", "is a count"),
        ("golden.tracking_rmse < 0.01", "'0.01' has no unit; an angle needs one (units: rad, mrad, deg"),
        ("golden.tracking_rmse < 1 rpm", "'1 rpm' is an angular velocity; an angle is wanted"),
        ("golden.tracking_rmse == 0.01 rad", "never exactly equal"),
        ("golden.tracking_rmse != 0.01 rad", "never exactly equal"),
    ],
)
def test_a_line_that_means_nothing_is_refused(line: object, words: str) -> None:
    """What, got, allowed, what was probably meant."""
    with pytest.raises(ValueError) as caught:  # noqa: PT011 (the text is checked below)
        parse_expectation(line, JOINTS)
    assert words in str(caught.value)


def test_every_quantity_can_be_written_in_a_line() -> None:
    """The documented names are the ones that are read."""
    units = {None: "", "angle": " rad", "angular velocity": " rad/s", "torque": " N m"}
    for path, dimension in quantities(JOINTS).items():
        line = f"{path} < 1{units[dimension.value if dimension else None]}"
        assert parse_expectation(line, JOINTS) == Expectation(path, "<", 1.0, line)


@given(st.text(max_size=40) | st.text("abfailures.rd <>=!0123 ", max_size=40))
def test_any_line_is_read_or_refused(line: str) -> None:
    """No crash on any text."""
    said = ""
    try:
        found = parse_expectation(line, JOINTS)
        assert found.path in quantities(JOINTS)
    except ValueError as error:
        said = str(error)
        assert said
