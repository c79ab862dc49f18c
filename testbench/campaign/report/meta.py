"""What a report says about a campaign besides its runs: the file, what was asked for, where and how it was run.

Plain data; whoever keeps the store fills it in.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field

from testbench.campaign.file.axes import Axis
from testbench.campaign.file.rules import Figure, Rule
from testbench.campaign.records import Point


@dataclass(frozen=True, slots=True)
class Meta:
    """A campaign without its runs.

    file: name of the campaign file, text: its content; store: path of the store, as the commands in the report are to
    name it; axes, points: as in the file, after filters; asked: what was wanted of each point, in words ("30 runs a
    point"); wanted: number of runs the plan wants by now; seed: of the campaign; command: what was typed; started,
    ended: UTC, ISO 8601; wall_s: of all its invocations together; jobs: processes; notes: what the reader has to know
    besides, a line each; changes: `key=value` that were set on top of the file;
    motions: full length of the motion at each point with runs [s], {} where none can end early.
    """

    name: str
    description: str
    file: str
    text: str
    store: str
    axes: tuple[Axis, ...]
    points: tuple[Point, ...]
    rule: Rule
    asked: str
    wanted: int
    seed: int
    figures: tuple[Figure, ...] = ()
    command: str = ""
    started: str = ""
    ended: str = ""
    wall_s: float = 0.0
    jobs: int = 1
    versions: Mapping[str, str] = field(default_factory=dict)
    notes: tuple[str, ...] = ()
    changes: tuple[str, ...] = ()
    motions: Mapping[Point, float] = field(default_factory=dict)
