"""What of a run a report can show over an axis, and which runs count for it."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Final

from testbench.campaign.file.axes import Axis
from testbench.campaign.file.rule_specs import RUN_NUMBERS
from testbench.campaign.file.rules import OUTCOMES
from testbench.campaign.plans.search import CombinationSearch, CriticalSearch
from testbench.campaign.records import FAILURES, NO_STATEMENT, UNITS, Point, RunRow
from testbench.campaign.report.meta import Meta
from testbench.campaign.statistics.shares import outcomes_named

EXCEEDED: Final = "exceeded"
"""Any limit exceeded: an error or a failure."""
BEYOND_3DEG: Final = "beyond_3deg"
"""A joint beyond its range by more than 3 deg, because mechanical pins are soft."""

_NAMED: Final = {
    "beyond_deg": ("angle beyond the range of travel", "deg"),
    "beyond_s": ("time beyond the range of travel", "s"),
    "detection_latency_s": ("time from the first fault to the first reaction", "s"),
    "detected_s": ("time of the first reaction", "s"),
    "first_start_s": ("start of the first fault", "s"),
    "first_phase": ("gait phase of the first fault", ""),
    "failure_s": ("time of the first failure", "s"),
    "ended_s": ("end of the motion", "s"),
}
"""Numbers of a run, which belong to no joint."""


@dataclass(frozen=True, slots=True)
class Quantity:
    """A number of a run: its name in rows, in words, and its unit ("" for none)."""

    name: str
    words: str
    unit: str

    @property
    def label(self) -> str:
        """For an axis of a figure or the head of a table."""
        return f"{self.words} [{self.unit}]" if self.unit else self.words


def quantity(name: str) -> Quantity:
    """`right_knee.rmse_position_rad` -> right knee, position RMSE, rad."""
    if name in _NAMED:
        return Quantity(name, *_NAMED[name])
    joint, dot, what = name.rpartition(".")
    unit, words = "", what
    for ending, found in UNITS:
        if what.endswith(ending):
            unit, words = found, what.removesuffix(ending)
            break
    if words.startswith("rmse_"):
        words = words.removeprefix("rmse_") + " RMSE"
    words = words.replace("_", " ")
    return Quantity(name, f"{joint.replace('_', ' ')}, {words}" if dot else words, unit)


def is_share(name: str) -> bool:
    """Whether a figure of that name shows a share of the runs: `failure`, or an outcome."""
    return name in OUTCOMES


def value_of(row: RunRow, name: str) -> float | None:
    """The number of that name, None where this run has none."""
    if name in RUN_NUMBERS:
        found = getattr(row, name)
        return None if found is None else float(found)
    return row.metrics.get(name)


def values_of(rows: Iterable[RunRow], name: str) -> list[float]:
    """The numbers of all runs that have one, in their order."""
    return [value for row in rows if (value := value_of(row, name)) is not None]


def stating(rows: Iterable[RunRow]) -> list[RunRow]:
    """The runs that make a statement about the system; shares are taken over these."""
    return [row for row in rows if row.outcome not in NO_STATEMENT]


def count(rows: Iterable[RunRow], what: str) -> int:
    """How many runs came out as named: `failure`, an outcome, `exceeded` or `beyond_3deg`."""
    if what == BEYOND_3DEG:
        return sum(row.failures_at_3deg > 0 for row in rows)
    if what == EXCEEDED:
        return sum(row.errors > 0 or row.failures > 0 or row.outcome in FAILURES for row in rows)
    named = outcomes_named(what)
    return sum(row.outcome in named for row in rows)


def by_point(rows: Iterable[RunRow], points: Iterable[Point] = ()) -> dict[Point, list[RunRow]]:
    """The runs of each point, by number; in the order given, further points behind it as they come."""
    found: dict[Point, list[RunRow]] = {point: [] for point in points}
    for row in rows:
        found.setdefault(row.point, []).append(row)
    return {point: sorted(runs, key=lambda row: row.number) for point, runs in found.items()}


def points_of(rows: Iterable[RunRow], meta: Meta) -> list[Point]:
    """The points of a grid, whether they have runs or not; of a search, those where it has looked, in their order."""
    if not is_search(meta):
        return list(meta.points)
    return sorted({row.point for row in rows}, key=lambda point: [_place(point, axis) for axis in meta.axes])


def is_search(meta: Meta) -> bool:
    """Whether the campaign chooses where to look by what it has found."""
    return isinstance(meta.rule, CriticalSearch | CombinationSearch)


def _place(point: Point, axis: Axis) -> tuple[float, str]:
    """For sorting: by number where there is one, else as listed in the file."""
    text = dict(point.parameters).get(axis.name, "")
    value = number_at(point, axis)
    if value is None:
        value = float(axis.texts.index(text)) if text in axis.texts else float(len(axis.texts))
    return value, text


def number_at(point: Point, axis: Axis) -> float | None:
    """SI value of an axis at a point; None for a text, or where the point has no such axis."""
    text = dict(point.parameters).get(axis.name)
    number = None if text is None else axis.number(text)
    return None if number is None else number.value


def words_of(point: Point) -> str:
    """`duration 0.05 s, stops off`."""
    return ", ".join(f"{name} {text}" for name, text in point.parameters) or "the scenario as it is"


def ended_early(rows: Iterable[RunRow], motions: Mapping[Point, float]) -> int:
    """Runs whose motion was shorter than their point's [s], so that their metrics cover a part of it only."""
    full = ((row.ended_s, motions.get(row.point)) for row in rows)
    return sum(ended is not None and motion is not None and ended < motion - 1e-9 for ended, motion in full)
