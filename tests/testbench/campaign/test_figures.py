"""Figures of a report: nothing of the data is lost, and several can stand on one page."""

import re

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from testbench.campaign.report.figures import (
    Column,
    Curve,
    Share,
    decimated,
    inline_svg,
    map_figure,
    metric_figure,
    share_figure,
)

COLUMNS = [Column(x / 10, x + 1.0, x + 0.5, x + 1.5, x + 0.9, (x + 0.3, x + 1.7)) for x in range(5)]
DOTS = [(column.x, column.mean + step / 10) for column in COLUMNS for step in range(-5, 6)]
NUMBERS = st.floats(-1e6, 1e6)


@given(st.lists(st.tuples(NUMBERS, NUMBERS), max_size=60))
def test_decimation_keeps_the_extremes(dots: list[tuple[float, float]]) -> None:
    """What is not drawn lies in one cell with what is; the lowest and the highest value are always drawn."""
    kept = decimated(dots, (8, 8))
    assert set(kept) <= set(dots)
    assert len(kept) <= 2 * 9 * 9
    if dots:
        heights = [y for _, y in dots]
        assert min(y for _, y in kept) == min(heights)
        assert max(y for _, y in kept) == max(heights)


def test_few_dots_are_all_drawn() -> None:
    """600 runs of a campaign lose none that can be told apart."""
    assert decimated(DOTS, (400, 300)) == sorted(DOTS)


@pytest.mark.long
def test_many_dots_become_few() -> None:
    """A report stays small whatever the number of runs."""
    dots = [(k * 0.754877 % 1, k * 0.569840 % 1) for k in range(50_000)]
    kept = decimated(dots, (400, 300))
    assert 1000 < len(kept) <= 4000
    assert {min(dots, key=lambda dot: dot[1]), max(dots, key=lambda dot: dot[1])} <= set(kept)


def svg(number: int = 1) -> str:
    figure = metric_figure(DOTS, COLUMNS, Curve([0.0, 0.4], [1.0, 5.0]), [(0.1, 2.5)], ("duration [s]", "RMSE [rad]"))
    return inline_svg(figure, number, "a < b", "what & why")


def test_svg_names_no_address_and_brings_no_script_or_style() -> None:
    """Self-contained: nothing to fetch, nothing that acts on the rest of the page."""
    text = svg()
    for word in ("://", "<script", "<style", "<metadata", "<!--"):
        assert word not in text


def test_svg_says_what_it_shows() -> None:
    """Accessible: title and description, read out for the image, escaped."""
    text = svg(3)
    assert 'role="img" aria-labelledby="f3-title" aria-describedby="f3-desc"' in text
    assert '<title id="f3-title">a &lt; b</title><desc id="f3-desc">what &amp; why</desc>' in text


def test_two_figures_on_a_page_share_no_name() -> None:
    """Every id carries the figure's number; every reference leads to one."""
    first, second = svg(1), svg(2)
    for text in (first, second):
        ids = re.findall(r' id="([^"]+)"', text)
        assert len(ids) == len(set(ids))
        assert set(re.findall(r'(?:href="#|url\(#)([^")]+)', text)) <= set(ids)
    assert not set(re.findall(r' id="([^"]+)"', first)) & set(re.findall(r' id="([^"]+)"', second))


def test_same_data_give_the_same_bytes() -> None:
    """Reproducible down to the picture."""
    assert svg() == svg()


def test_everything_that_is_drawn_is_in_the_legend() -> None:
    """Single runs, their middle half, mean, median, fit and the paper's numbers, with their values."""
    text = svg()
    for words in ("single runs", "middle half", "median", "mean, and its interval", "quadratic fit", "paper"):
        assert words in text
    assert ">2.5<" in text.replace("\n", "")


def test_runs_far_above_all_means_are_told_instead_of_squeezing_the_rest() -> None:
    """A knee that spun for whole turns would hide the rest of the figure; how many, and how far, is written on it."""
    figure = metric_figure([*DOTS, (0.1, 900.0), (0.2, 1000.0)], COLUMNS, None, [], ("x", "y"))
    (axes,) = figure.axes
    assert axes.get_ylim()[1] < 30
    assert [text.get_text() for text in axes.texts] == ["2 runs above, up to 1e+03"]


def test_paper_and_intervals_are_inside_the_figure() -> None:
    """Also where all of our runs lie below."""
    figure = metric_figure(DOTS, COLUMNS, None, [(0.1, 25.0)], ("x", "y"))
    (axes,) = figure.axes
    assert axes.get_ylim()[1] > 25


def test_share_is_drawn_in_percent_with_its_interval() -> None:
    """0..1 in the data, 0 to 100 % in the figure."""
    figure = share_figure([Share(0.1, 0.0, 0.0, 0.2), Share(0.2, 0.5, 0.3, 0.7)], [(0.2, 0.9)], ("x", "y"))
    (axes,) = figure.axes
    drawn = [list(np.asarray(line.get_ydata())) for line in axes.lines]
    assert [0.0, 50.0] in drawn
    assert [90.0] in drawn
    low, high = axes.get_ylim()
    assert low < 0 < 100 < high


def test_map_has_a_cell_for_every_combination() -> None:
    """Cells say their value; one without is empty of colour and still says why."""
    figure = map_figure(
        [[0.1, 0.2], [None, 0.4]], [["0.1", "0.2"], ["?", ">0.4"]], (["a", "b"], ["c", "d"]), ("x", "y", "z")
    )
    axes = figure.axes[0]
    assert [text.get_text() for text in axes.texts] == ["0.1", "0.2", "?", ">0.4"]
    assert [label.get_text() for label in axes.get_xticklabels()] == ["a", "b"]
    assert [label.get_text() for label in axes.get_yticklabels()] == ["c", "d"]
