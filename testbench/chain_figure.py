"""Who started whom, as a picture: injectors that are linked by triggers, with what each of them did in the run.

Sources stand left of what they start; an arrow that passes a column has a place of its own in it. Injectors without a
link are in the lanes of the fault plot alone.
"""

import textwrap
from collections.abc import Mapping, Sequence
from functools import partial
from typing import TYPE_CHECKING, Final

from fi_gateway.activation import Activation
from fi_gateway.trigger_specs import TriggerSpec

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

CHAIN_PLOT: Final = "triggers.png"

_ACTED: Final = "#f3c55b"
_IDLE: Final = "#ffffff"
_FRAME: Final = "#dfe9f5"
_EDGE: Final = "#555555"
_BOX: Final = (2.1, 0.62)
"""Width and height of a box [in]."""
_GAP: Final = (2.1, 0.45)
"""Between two boxes [in]; the labels of the arrows stand in it."""
_MOST_LETTERS: Final = 24

Triggers = Mapping[str, TriggerSpec]
"""By the injector that they start; circles are refused when a scenario is read."""
Slot = tuple[str, str]
"""An injector, or a frame in words, and ""; or the source and the target of an arrow that passes."""
Point = tuple[float, float]
"""In inches, from the upper left corner."""


def chain_figure(triggers: Triggers, activations: Sequence[Activation], title: str) -> "Figure":
    """triggers: at least one; activations: of the run; title: scenario and seed. Imports matplotlib."""
    from matplotlib.figure import Figure

    columns = _columns(triggers)
    rows = max(len(column) for column in columns)
    pitch = (_BOX[0] + _GAP[0], _BOX[1] + _GAP[1])
    width, height = max(len(columns) * pitch[0] - _GAP[0] + 0.4, 6.0), rows * pitch[1] + 0.7
    figure = Figure(figsize=(width, height))
    heading = textwrap.shorten(f"{title}: triggers", 80, placeholder=" ...")
    figure.text(0.2 / width, 1 - 0.35 / height, heading, weight="bold", parse_math=False)
    axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    axes.set_axis_off()
    axes.set_xlim(-0.2, width - 0.2)
    axes.set_ylim(height - 0.6, -0.6)
    places = {
        (level, slot): (level * pitch[0], (row + (rows - len(column)) / 2 + 0.5) * pitch[1])
        for level, column in enumerate(columns)
        for row, slot in enumerate(column)
    }
    for name, trigger in triggers.items():
        for source in _sources(trigger):
            _arrow(axes, _way(source, name, places), _label(trigger))
    frames = {source for trigger in triggers.values() if trigger.frame is not None for source in _sources(trigger)}
    for (_, (name, target)), place in places.items():
        if not target:
            _box(axes, place, name, None if name in frames else _done(name, activations))
    return figure


def _columns(triggers: Triggers) -> list[list[Slot]]:
    """What stands in each column, from above: sources as far left as they can, each as near to its own as it can."""
    levels: dict[str, int] = {}

    def level(name: str) -> int:
        if name not in levels:
            trigger = triggers.get(name)
            levels[name] = 0 if trigger is None else 1 + max(level(source) for source in _sources(trigger))
        return levels[name]

    columns: list[list[Slot]] = [[] for _ in range(1 + max(level(name) for name in triggers))]
    for name, at in levels.items():
        columns[at].append((name, ""))
        for source in _sources(triggers[name]) if name in triggers else ():
            for between in range(levels[source] + 1, at):
                columns[between].append((source, name))
    for number, column in enumerate(columns[1:]):
        rows = {slot: row - (len(columns[number]) - 1) / 2 for row, slot in enumerate(columns[number])}
        column.sort(key=partial(_row_before, triggers, rows))
    return columns


def _row_before(triggers: Triggers, rows: Mapping[Slot, float], slot: Slot) -> float:
    """The mean row of what leads to a slot from the column before. rows: of that column."""
    name, target = slot
    arrows = [slot] if target else [(source, name) for source in _sources(triggers[name])]
    found = [rows[before] for source, to in arrows for before in ((source, ""), (source, to)) if before in rows]
    return sum(found) / len(found)


def _way(source: str, name: str, places: Mapping[tuple[int, Slot], Point]) -> list[Point]:
    """The corners of an arrow."""
    corners: list[Point] = []
    for (_, slot), (x, y) in places.items():  # from left to right
        if slot == (source, ""):
            corners.append((x + _BOX[0], y))
        elif slot == (source, name):
            corners += [(x, y), (x + _BOX[0], y)]
        elif slot == (name, ""):
            corners.append((x, y))
    return corners


def _sources(trigger: TriggerSpec) -> tuple[str, ...]:
    """Injectors, or the frame in words."""
    return (trigger.frame.words(),) if trigger.frame is not None else tuple(dict.fromkeys(trigger.sources))


def _label(trigger: TriggerSpec) -> str:
    if trigger.frame is not None:
        return trigger.rest().removeprefix(", ")
    every = "all " if trigger.all is not None and len(trigger.all) > 1 else ""
    level = ", while it holds" if trigger.edge == "level" else ""
    return f"{every}{trigger.on}{level}{trigger.rest()}"


def _done(name: str, activations: Sequence[Activation]) -> tuple[int, int]:
    """Windows, and frames that manifested."""
    own = [one for one in activations if one.injector == name]
    return len(own), sum(one.manifested for one in own)


def _arrow(axes: "Axes", corners: list[Point], label: str) -> None:
    """Through all corners; the label lies near the first, where arrows to one target are still apart."""
    *_, last, tip = corners
    axes.plot([x for x, _ in corners[:-1]], [y for _, y in corners[:-1]], color=_EDGE, lw=1.1, zorder=1)
    style = {"arrowstyle": "-|>", "color": _EDGE, "lw": 1.1, "shrinkA": 0, "shrinkB": 0}
    axes.annotate("", xy=tip, xytext=last, arrowprops=style)
    if label:
        (left, above), (right, below) = corners[:2]
        at = (left + 0.5 * (right - left), above + 0.5 * (below - above))
        white = {"facecolor": "white", "edgecolor": "none", "pad": 1.0}
        text = textwrap.fill(label, _MOST_LETTERS)
        axes.text(*at, text, fontsize=7, ha="center", va="center", bbox=white, zorder=3, parse_math=False)


def _box(axes: "Axes", place: Point, name: str, done: tuple[int, int] | None) -> None:
    """done: None for a frame from the bus."""
    from matplotlib.patches import FancyBboxPatch

    width, height = _BOX
    face = _FRAME if done is None else _ACTED if done[1] else _IDLE
    corner = (place[0], place[1] - height / 2)
    style = "round,pad=0,rounding_size=0.1"
    axes.add_patch(FancyBboxPatch(corner, width, height, style, fc=face, ec=_EDGE, lw=1.0, zorder=2))
    x, y = place[0] + width / 2, place[1]
    if done is None:
        text = textwrap.fill(name, _MOST_LETTERS + 4)
        axes.text(x, y, text, fontsize=8, ha="center", va="center", zorder=3, parse_math=False)
        return
    short = name if len(name) <= _MOST_LETTERS else f"{name[: _MOST_LETTERS - 3]}..."
    axes.text(x, y - 0.12, short, fontsize=9, ha="center", va="center", weight="bold", zorder=3, parse_math=False)
    counts = f"{done[0]} activated, {done[1]} manifested"
    axes.text(x, y + 0.15, counts, fontsize=7, ha="center", va="center", zorder=3)
