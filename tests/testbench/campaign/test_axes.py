"""Axes and filters: which values, which points, in which order."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fi_gateway.marked_yaml import parse
from testbench.campaign.file.axes import Axis, grid, read_axis, size
from testbench.campaign.file.filters import parse_filter
from testbench.campaign.file.values import number_of, text_of, with_unit


def axis(text: str, name: str = "x", seed: int = 1) -> Axis:
    """An axis as in a file; it must be right."""
    document = parse(text, "file")
    found = read_axis(name, document.data, (), document, seed)
    document.raise_problems()
    assert found is not None
    return found


@pytest.mark.parametrize(
    ("written", "texts"),
    [
        ("values: [0.05 s, 100 ms]", ["0.05 s", "100 ms"]),
        ("values: [on, off]", ["on", "off"]),
        ("values: [1, 2.5, 1e-3]", ["1", "2.5", "0.001"]),
        ("values: [true, false]", ["true", "false"]),
        ("values: 3 s", ["3 s"]),
        ("range: {from: 0.05 s, to: 0.2 s, step: 0.05 s}", ["0.05 s", "0.1 s", "0.15 s", "0.2 s"]),
        ("range: {from: -10 deg, to: 10 deg, step: 10 deg}", ["-10 deg", "0 deg", "10 deg"]),
        ("range: {from: 0, to: 31, step: 31}", ["0", "31"]),
        ("range: {from: 1.23456789 s, to: 1.23456789 s, step: 1 s}", ["1.23456789 s"]),
        ("values: [{range: {from: 1 s, to: 2 s, step: 1 s}}, 5 s]", ["1 s", "2 s", "5 s"]),
        ("linear: {from: 0 %, to: 75 %, points: 4}", ["0 %", "25 %", "50 %", "75 %"]),
        ("linear: {from: 0 s, to: 1 s, points: 4}", ["0 s", "0.333333 s", "0.666667 s", "1 s"]),
        ("log: {from: 0.01, to: 1, points: 5}", ["0.01", "0.0316228", "0.1", "0.316228", "1"]),
    ],
)
def test_values_of_an_axis(written: str, texts: list[str]) -> None:
    """Lists, ranges with both ends, linear and logarithmic steps of six digits."""
    assert list(axis(f"set: a.b\n{written}").texts) == texts


def test_steps_of_a_range_are_exact() -> None:
    """0.1 + 0.2 is 0.3, and the hundredth step is as exact as the first."""
    texts = axis("set: a\nrange: {from: 0.1 s, to: 10 s, step: 0.1 s}").texts
    assert texts[2] == "0.3 s"
    assert texts[99] == "10 s"
    assert all(len(text) <= len("0.1 s") for text in texts)


def test_axis_sets_one_key_or_several() -> None:
    several = axis("set: [a.b, c]\nvalues: [1, 2]")
    assert several.settings("2") == (("a.b", "2"), ("c", "2"))
    assert axis("set: a.b\nvalues: [1]").settings("1") == (("a.b", "1"),)


def test_cases_set_what_they_say() -> None:
    """Each its own keys, with any value; their order is that of the file."""
    cases = axis("cases: {pins: {rig.stops: on}, 'soft pins': {rig.stops: on, tolerance: 3 deg, a: {b: [1, 2]}}}")
    assert cases.texts == ("pins", "soft pins")
    assert cases.settings("pins") == (("rig.stops", "on"),)
    assert cases.settings("soft pins")[1:] == (("tolerance", "3 deg"), ("a", "{b: [1, 2]}"))


def test_random_values_hang_on_seed_and_name_alone() -> None:
    """Drawn once, the same on every machine; another seed or name draws others. The numbers are fixed here."""
    spec = "set: a\nrandom: {uniform: {from: -0.2 rad, to: 0.2 rad}, points: 4}"
    assert axis(spec).texts == ("0.0533005 rad", "-0.186963 rad", "0.158815 rad", "-0.184514 rad")
    assert axis(spec).texts == axis(spec).texts
    assert axis(spec, seed=2).texts != axis(spec).texts
    assert axis(spec, name="y").texts != axis(spec).texts


@pytest.mark.parametrize(
    ("distribution", "low", "high", "middle"),
    [
        ("uniform: {from: 2 s, to: 4 s}", 2, 4, 3),
        ("log_uniform: {from: 0.001 s, to: 1 s}", 0.001, 1, 0.0316),
        ("normal: {mean: 5 deg, sd: 1 deg}", -1, 1, 0.0873),
    ],
)
def test_random_values_follow_their_distribution(distribution: str, low: float, high: float, middle: float) -> None:
    """Within their ends; half of them below the median (binomial: 400 of 800 within 6 sigma = 85)."""
    texts = axis(f"set: a\nrandom: {{{distribution}, points: 800}}").texts
    numbers = [found.value for text in texts if (found := number_of(text)) is not None]
    assert len(numbers) == 800
    assert all(low <= number <= high for number in numbers)
    assert abs(sum(number < middle for number in numbers) - 400) < 85


X, Y = Axis("x", ("a",), ("1", "2", "3")), Axis("y", ("b",), ("on", "off"))


def texts_of(points: list[tuple[tuple[str, str], ...]]) -> list[str]:
    return ["".join(text for _, text in point) for point in points]


def test_grid_is_the_product_the_last_axis_fastest() -> None:
    points = [point.parameters for point in grid([X, Y], (), [])]
    assert texts_of(points) == ["1on", "1off", "2on", "2off", "3on", "3off"]
    assert points[0] == (("x", "1"), ("y", "on"))
    assert size([X, Y], ()) == 6


def test_axes_together_go_in_step() -> None:
    """Value k of one with value k of the other; parameters stay in the order of the file."""
    z = Axis("z", ("c",), ("7", "8", "9"))
    points = [point.parameters for point in grid([X, Y, z], [("x", "z")], [])]
    assert texts_of(points) == ["1on7", "1off7", "2on8", "2off8", "3on9", "3off9"]
    assert size([X, Y, z], [("x", "z")]) == 6


def test_grid_without_axes_is_one_point() -> None:
    assert [point.parameters for point in grid([], (), [])] == [()]


VALUES = {"duration": ("0.05 s", "0.5 s", "1 s"), "limit": ("100 ms", "1 s"), "stops": ("on", "off"), "case": ("a b",)}
POINT = {"duration": "0.5 s", "limit": "100 ms", "stops": "off", "case": "a b"}


@pytest.mark.parametrize(
    ("text", "holds"),
    [
        ("duration <= 0.5 s", True),
        ("duration < 500 ms", False),
        ("duration == 500 ms", True),
        ("duration != 0.5 s", False),
        ("duration > limit", True),
        ("stops == off", True),
        ("stops != off", False),
        ("case == 'a b'", True),
        ('case == "a b"', True),
        ("duration in [1 s, 0.5 s]", True),
        ("stops in [on]", False),
        ("not stops == on", True),
        ("duration > 0.5 s or stops == off", True),
        ("duration > 0.5 s and stops == off", False),
        ("stops == off or stops == on and duration > 0.5 s", True),  # `and` binds tighter
        ("(stops == off or stops == on) and duration > 0.5 s", False),
        ("not (duration>0.5s or stops==on)", True),
    ],
)
def test_filter_holds(text: str, holds: bool) -> None:
    """Comparisons in SI, words, lists, and, or, not, parentheses."""
    assert parse_filter(text, VALUES).holds(POINT) is holds


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("durtion < 1 s", "no axis 'durtion'; did you mean 'duration'?"),
        ("duration < 1 deg", "duration is a duration, 1 deg is an angle"),
        ("duration < 1", "duration is a duration, 1 is a number"),
        ("duration == off", "duration is a duration, off is a word"),
        ("stops < on", "stops is a word and has no order; allowed are == != in"),
        ("stops == of", "stops is never 'of'; did you mean 'off'?"),
        ("stops == duration", "stops is a word, duration is a duration"),
        ("1 s < duration", "expected an axis, found '1 s'"),
        ("duration <", "expected a value to compare duration with, found 'the end'"),
        ("duration", "after duration, found 'the end'"),
        ("(stops == on", "expected ')'"),
        ("stops == on off", "expected and, or, or the end before 'off'"),
        ("stops == on and", "expected an axis, found 'the end'"),
        ("duration in 1 s", "expected '['"),
        ("duration < 1 parsec", "is a number"),
        ("__import__('os')", "no axis '__import__'"),
        ("stops == on; 1", "not understood from '; 1' on"),
        ("", "expected a comparison over axes"),
        (["stops == on"], "expected a comparison over axes"),
    ],
)
def test_filter_is_refused_with_what_is_wrong(text: object, words: str) -> None:
    """Names, kinds, units and words are checked when the file is read."""
    with pytest.raises(ValueError) as caught:  # noqa: PT011 - the words are looked for below
        parse_filter(text, VALUES)
    assert words in str(caught.value)


@given(st.text(alphabet="duration stops<>=!()[],'\"0.5s andornotin%", max_size=40))
def test_filter_reads_or_refuses_any_text(text: str) -> None:
    """Nothing but ValueError, and what reads can be asked."""
    try:
        found = parse_filter(text, VALUES)
    except ValueError:
        return
    assert found.holds(POINT) in (True, False)


@given(st.text(max_size=30))
def test_text_of_an_axis_is_what_the_scenario_reads(text: str) -> None:
    """Whatever a value is, set_value reads it as the same."""
    from fi_gateway.marked_yaml import Mark, set_value

    document = parse("a: 0", "file")
    try:
        written = text_of(text)
    except ValueError:
        return
    set_value(document, "a", written, Mark(1, 1))
    assert not document.problems
    assert document.data == {"a": text}


@pytest.mark.parametrize(
    ("text", "value", "unit"),
    [
        *(("50 ms", 0.05, "s"), ("-90 deg", -1.5707963267948966, "rad")),
        *(("25 %", 0.25, "%"), ("5 Nm", 5, "N m"), ("7", 7, "")),
    ],
)
def test_number_behind_a_text(text: str, value: float, unit: str) -> None:
    """In SI; a share from 0 to 1."""
    found = number_of(text)
    assert found is not None
    assert found.value == pytest.approx(value, rel=1e-15)
    assert found.unit == unit


@pytest.mark.parametrize("text", ["off", "right_knee", "0x10", "5 parsec", "120 %", "", "1 2", "nan", "1e999 s"])
def test_text_without_a_number(text: str) -> None:
    assert number_of(text) is None


def test_six_digits_are_kept() -> None:
    assert with_unit(1 / 3, "s") == "0.333333 s"
    assert with_unit(1234567.0, "") == "1.23457e+06"
