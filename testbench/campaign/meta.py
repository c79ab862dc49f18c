"""What a report says about a campaign besides its runs: the file, what was asked for, where and how it was run.

Plain data; whoever keeps the store fills it in. Numbers are SI.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field

from testbench.campaign.records import Point


@dataclass(frozen=True, slots=True)
class Axis:
    """An axis as the report needs it.

    keys: what of the scenario it sets; unit: of the SI values, "" for plain numbers and for texts; values: text as in
    `Point` -> SI number, in the order of the file, None for what is no number (`on`, `off`).
    """

    name: str
    keys: tuple[str, ...]
    unit: str
    values: Mapping[str, float | None]

    @property
    def is_numeric(self) -> bool:
        """Whether every value is a number, so that there is an order and a distance."""
        return all(value is not None for value in self.values.values())


@dataclass(frozen=True, slots=True)
class FigureWanted:
    """A figure asked for by the file: y over the axis x.

    y: a metric (`right_knee.rmse_position_rad`), a number of the run (`beyond_deg`), an outcome or `failure`, whose
    share is then drawn. low, high: the part of x shown and fitted, both ends included. fit: `quadratic` or "". paper:
    (x, y) of published numbers.
    """

    x: str
    y: str
    low: float = float("-inf")
    high: float = float("inf")
    fit: str = ""
    paper: tuple[tuple[float, float], ...] = ()


@dataclass(frozen=True, slots=True)
class Meta:
    """A campaign without its runs.

    file: name of the campaign file, text: its content as run; store: path of the store, as the commands in the report
    are to name it; axes: in order; points: all places of the grid that passed the filters, in order; asked: what was
    wanted of each point, in words ("30 runs a point"); wanted: number of runs the plan wants by now; seed: of the
    campaign; command: what was typed; started, ended: UTC, ISO 8601; wall_s: of all its invocations together; jobs:
    processes; notes: what the reader has to know, a line each.
    """

    name: str
    description: str
    file: str
    text: str
    store: str
    axes: tuple[Axis, ...]
    points: tuple[Point, ...]
    asked: str
    wanted: int
    seed: int
    figures: tuple[FigureWanted, ...] = ()
    command: str = ""
    started: str = ""
    ended: str = ""
    wall_s: float = 0.0
    jobs: int = 1
    versions: Mapping[str, str] = field(default_factory=dict)
    notes: tuple[str, ...] = ()

    def axis(self, name: str) -> Axis:
        """The axis of that name; KeyError when there is none."""
        for axis in self.axes:
            if axis.name == name:
                return axis
        raise KeyError(f"campaign {self.name} has no axis {name!r}; it has {', '.join(a.name for a in self.axes)}")
