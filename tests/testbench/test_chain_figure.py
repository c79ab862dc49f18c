"""The picture of who started whom: everything linked is on it, and nothing lies on something else."""

from collections.abc import Callable
from itertools import combinations, pairwise
from pathlib import Path

import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import FancyBboxPatch

from fi_gateway.activation import Activation
from fi_gateway.trigger_specs import PatternSpec, TriggerSpec
from testbench.chain_figure import CHAIN_PLOT, chain_figure
from testbench.report import save
from testbench.store import FILES

ActivationMaker = Callable[..., Activation]

BRANCHES = {
    "zero": TriggerSpec(any=("freeze",), on="manifested", delay_ns=20_000_000, probability=0.5),
    "join": TriggerSpec(all=("zero", "late"), on="ended"),
    "flips": TriggerSpec(any=("late", "freeze"), edge="level"),
    "spoof": TriggerSpec(frame=PatternSpec(0x6F0, "2A 00")),
    "after": TriggerSpec(any=("join",)),
}


def words(figure: Figure) -> list[str]:
    """All text on the sheet, on one line each."""
    (axes,) = figure.axes
    return [" ".join(text.get_text().split()) for text in (*figure.texts, *axes.texts) if text.get_text()]


def boxes(figure: Figure) -> list[FancyBboxPatch]:
    (axes,) = figure.axes
    return [patch for patch in axes.patches if isinstance(patch, FancyBboxPatch)]


def test_every_linked_injector_and_frame_is_there_with_what_it_did(activation_maker: ActivationMaker) -> None:
    """A reader sees source, signal, delay, chance, and how often it came to that."""
    activations = [activation_maker("freeze"), activation_maker("freeze", index=1), activation_maker("zero")]
    said = words(chain_figure(BRANCHES, activations, "knee, seed 3"))
    for name in ("freeze", "late", *BRANCHES, "frame 0x6F0 2A 00"):
        assert said.count(name) == 1
    assert "knee, seed 3: triggers" in said
    assert "2 activated, 296 manifested" in said
    assert "1 activated, 148 manifested" in said
    assert said.count("0 activated, 0 manifested") == 5
    assert "manifested, 20 ms later, with probability 0.5" in said
    assert (said.count("all ended"), said.count("activated, while it holds")) == (2, 2)


def test_boxes_and_labels_do_not_cover_each_other() -> None:
    """Also where an arrow passes a column."""
    figure = chain_figure(BRANCHES, [], "x")
    renderer = FigureCanvasAgg(figure).get_renderer()  # type: ignore[no-untyped-call]
    (axes,) = figure.axes
    found = [patch.get_window_extent(renderer) for patch in boxes(figure)]
    found += [text.get_window_extent(renderer) for text in axes.texts if text.get_text() and text.get_bbox_patch()]
    assert len(found) == 8 + 6
    for one, other in combinations(found, 2):
        assert not one.overlaps(other)
    for one in found:
        assert figure.bbox.x0 <= one.x0 < one.x1 <= figure.bbox.x1
        assert figure.bbox.y0 <= one.y0 < one.y1 <= figure.bbox.y1


def test_sources_stand_left_of_what_they_start() -> None:
    """The direction of cause is the direction of reading."""
    figure = chain_figure(BRANCHES, [], "x")
    (axes,) = figure.axes
    at = {text.get_text(): text.get_position()[0] for text in axes.texts}
    assert at["freeze"] == at["late"] < at["zero"] == at["flips"] < at["join"] < at["after"]


def test_an_arrow_that_passes_a_column_goes_through_no_box() -> None:
    """late -> join passes the column of zero and flips."""
    figure = chain_figure(BRANCHES, [], "x")
    (axes,) = figure.axes
    for line in axes.lines:
        points = np.asarray(line.get_xydata())
        for (left, above), (right, below) in pairwise(points.tolist()):
            for box in boxes(figure):
                inside = box.get_x() < (left + right) / 2 < box.get_x() + box.get_width()
                assert not (inside and box.get_y() < (above + below) / 2 < box.get_y() + box.get_height())
    assert any(len(np.asarray(line.get_xdata())) > 2 for line in axes.lines)


@pytest.mark.parametrize("name", ["a" * 200, "$x^2$", "Fußgelenk & Co."])
def test_any_name_is_drawn(tmp_path: Path, name: str) -> None:
    """A name may hold what looks like mathematics, and be too long for its box."""
    assert CHAIN_PLOT in FILES
    save(chain_figure({name: TriggerSpec(any=("b",))}, [], name), tmp_path / CHAIN_PLOT)
    assert (tmp_path / CHAIN_PLOT).read_bytes().startswith(b"\x89PNG")
