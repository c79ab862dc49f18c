"""Quantities with units become SI values, exactly where time is concerned, and nothing else passes."""

import contextlib
import math
from fractions import Fraction

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fi_gateway.quantity import (
    UNITS,
    Dimension,
    QuantityError,
    format_duration,
    format_hertz,
    format_quantity,
    parse_duration,
    parse_hertz,
    parse_quantity,
    parse_share,
    si_unit,
)


@pytest.mark.parametrize(
    ("text", "dimension", "value"),
    [
        ("0.05 rad", Dimension.ANGLE, 0.05),
        ("-60 deg", Dimension.ANGLE, math.radians(-60)),
        ("90deg", Dimension.ANGLE, math.pi / 2),
        ("3 mrad", Dimension.ANGLE, 0.003),
        ("1.2 rad/s", Dimension.SPEED, 1.2),
        ("180 deg/s", Dimension.SPEED, math.pi),
        ("60 rpm", Dimension.SPEED, 2 * math.pi),
        ("5 N m", Dimension.TORQUE, 5.0),
        ("5  N   m", Dimension.TORQUE, 5.0),
        ("5 Nm", Dimension.TORQUE, 5.0),
        ("72900 mN m", Dimension.TORQUE, 72.9),
        ("1e-3 s", Dimension.TIME, 0.001),
        (" +.5 ms ", Dimension.TIME, 0.0005),
        ("0.5 kHz", Dimension.FREQUENCY, 500.0),
        ("2 min", Dimension.TIME, 120.0),
        ("0.25 stride", Dimension.PHASE, 0.25),
        ("-25 %", Dimension.PHASE, -0.25),
    ],
)
def test_a_quantity_is_its_si_value(text: str, dimension: Dimension, value: float) -> None:
    """Quantities are strings with units; one rounding of a product is allowed."""
    assert parse_quantity(text, dimension) == pytest.approx(value, rel=2**-52, abs=0)


@pytest.mark.parametrize("given", [5, 0, 0.3, "5", "-1.5", "1e3"])
@pytest.mark.parametrize("dimension", list(Dimension))
def test_a_bare_number_is_refused_with_the_units_allowed(given: object, dimension: Dimension) -> None:
    """Bare numbers are refused where a unit is needed."""
    with pytest.raises(QuantityError, match="has no unit") as caught:
        parse_quantity(given, dimension)
    assert all(unit in str(caught.value) for unit in UNITS[dimension])


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ("5 parsec", "unknown unit 'parsec'"),
        ("5 S", "unknown unit 'S'"),
        ("5 deg", "is an angle; a duration is wanted"),
        ("5 stride", "is a gait phase; a duration is wanted"),
        ("5 %", "unknown unit '%'"),
        ("nan s", "is not a duration"),
        ("inf s", "is not a duration"),
        (".inf s", "is not a duration"),
        ("", "is not a duration"),
        ("s", "is not a duration"),
        ("1 + 1 s", "unknown unit"),
        ("2**9 s", "unknown unit"),
        ("0x10 s", "unknown unit"),
        ("1,5 s", "unknown unit"),
        ("1_000 s", "unknown unit"),
        ("\uff11 s", "is not a duration"),
        ("1e31 s", "too large; allowed up to 1e30"),
        ("100e29 s", "too large; allowed up to 1e30"),
        ("1e9999 s", "unknown unit"),
        ("1" * 61 + " s", "is not a duration"),
        (None, "got nothing"),
        (True, "got true"),
        ([1], "got a list"),
        ({"s": 1}, "got a mapping"),
    ],
)
def test_what_is_no_quantity_is_refused(given: object, words: str) -> None:
    """Plain syntax only: no expressions, no infinities, no other number notations."""
    with pytest.raises(QuantityError) as caught:
        parse_quantity(given, Dimension.TIME)
    assert words in str(caught.value)


@pytest.mark.parametrize(
    ("text", "ns"),
    [
        ("0.3 s", 300_000_000),  # 0.3 is not a binary fraction: exact only in decimal arithmetic
        ("1 ms", 1_000_000),
        ("0.1 us", 100),
        ("1 ns", 1),
        ("-1 ns", -1),
        ("1e-9 s", 1),
        ("0 s", 0),
        ("1.000000001 s", 1_000_000_001),
        ("1 µs", 1_000),
        ("1000000000 s", 10**18),
    ],
)
def test_durations_are_exact_nanoseconds(text: str, ns: int) -> None:
    """Time is int ns; durations are read exactly."""
    assert parse_duration(text) == ns


@pytest.mark.parametrize("text", ["0.5 ns", "1e-10 s", "0.0000000001 s", "1.0000000001 s"])
def test_parts_of_a_nanosecond_are_refused(text: str) -> None:
    """Sub-ns durations are refused, not rounded."""
    with pytest.raises(QuantityError, match="whole number of nanoseconds"):
        parse_duration(text)


def test_a_duration_beyond_the_clock_is_refused() -> None:
    """Times stay below NEVER."""
    with pytest.raises(QuantityError, match="longest"):
        parse_duration("1000000000.000000001 s")


@given(st.integers(-(10**18), 10**18))
def test_every_duration_survives_being_written(ns: int) -> None:
    """Round trip ns -> text -> ns."""
    assert parse_duration(format_duration(ns)) == ns


@pytest.mark.parametrize(
    ("ns", "text"),
    [(300_000_000, "0.3 s"), (50_000_000, "50 ms"), (1_000_000, "1 ms"), (1_500, "1.5 us"), (7, "7 ns"), (0, "0 s"),
     (7_000_000_000, "7 s"), (100_000_000_000, "100 s")],
)  # fmt: skip
def test_durations_are_written_as_people_write_them(ns: int, text: str) -> None:
    """A resolved scenario is read by people."""
    assert format_duration(ns) == text


@given(st.floats(-1e30, 1e30), st.sampled_from(Dimension))
def test_every_si_value_survives_being_written(value: float, dimension: Dimension) -> None:
    """Round trip SI -> text -> SI, to the last bit."""
    assert parse_quantity(format_quantity(value, dimension), dimension) == value


@pytest.mark.parametrize(("text", "hertz"), [("500 Hz", 500), ("62.5 Hz", 62.5), ("1 kHz", 1000)])
def test_rates_are_exact_and_written_back(text: str, hertz: float) -> None:
    """A rate makes a whole number of ns or is refused, so it must not be rounded on the way."""
    assert parse_hertz(text) == Fraction(hertz)
    assert parse_hertz(format_hertz(parse_hertz(text))) == Fraction(hertz)


@pytest.mark.parametrize(
    ("given", "share"), [(0, 0), (1, 1), (0.0005, 0.0005), ("20 %", 0.2), ("0 %", 0), ("100 %", 1)]
)
def test_probabilities_are_numbers_or_percentages(given: object, share: float) -> None:
    """A probability needs no unit."""
    assert parse_share(given) == share


@pytest.mark.parametrize(
    "given", [-1e-9, 1.0000001, 2, "101 %", "-1 %", "0.2", "20", True, None, math.nan, math.inf, [0.5]]
)
def test_what_is_no_probability_is_refused(given: object) -> None:
    """0..1, dense at the boundaries."""
    with pytest.raises(QuantityError, match=r"0\.\.1"):
        parse_share(given)


@given(st.text(max_size=80) | st.integers() | st.floats() | st.none() | st.booleans())
def test_any_input_is_a_value_or_a_clear_refusal(given: object) -> None:
    """No crash on anything a file can hold."""
    for dimension in Dimension:
        value, said = 0.0, si_unit(dimension)
        try:
            value = parse_quantity(given, dimension)
        except QuantityError as error:
            said = str(error)
        assert math.isfinite(value)
        assert si_unit(dimension) in said or "too large" in said
    with contextlib.suppress(QuantityError):
        assert isinstance(parse_duration(given), int)
