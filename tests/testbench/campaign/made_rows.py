"""Rows and metas made by hand, for tests of what is said about them."""

import hashlib
from collections.abc import Mapping, Sequence

from testbench.campaign.file.axes import Axis
from testbench.campaign.file.rules import Figure, FixedRuns, Rule
from testbench.campaign.records import FAILURES, Outcome, Point, RunRow
from testbench.campaign.report.meta import Meta

RMSE = "right_knee.rmse_position_rad"
ALL = (float("-inf"), float("inf"))


def point(**parameters: str) -> Point:
    return Point(tuple(parameters.items()))


def row(
    at: Point,
    number: int = 0,
    outcome: Outcome = Outcome.MASKED,
    metrics: Mapping[str, float] | None = None,
    beyond_deg: float = 0.0,
    first_phase: float | None = 0.25,
    detection_latency_s: float | None = None,
    reason: str = "",
    attempts: int = 1,
    wall_s: float = 1.0,
    ended_s: float | None = 7.0,
    activated: int = 1,
) -> RunRow:
    failed = outcome in FAILURES
    return RunRow(
        identity=hashlib.sha256(f"{at.parameters} {number}".encode()).hexdigest(),
        point=at,
        number=number,
        seed=1 + number,
        outcome=outcome,
        reason=reason,
        metrics=metrics or {},
        first_start_s=1.0,
        first_phase=first_phase,
        activated=activated,
        detection_latency_s=detection_latency_s,
        beyond_deg=beyond_deg,
        beyond_joint="right_knee" if beyond_deg else "",
        errors=int(outcome is Outcome.ERROR),
        failures=int(failed),
        ended_s=ended_s,
        golden_hash="ab" * 32,
        attempts=attempts,
        wall_s=wall_s,
        machine="bench",
        versions={"exo-hil": "0.1.0"},
    )


def figure(
    y: str = RMSE, fit: str = "", paper: tuple[tuple[float, float], ...] = (), span: tuple[float, float] = ALL
) -> Figure:
    return Figure("duration", y, span[0], span[1], fit, paper)


def axis(name: str, *texts: str) -> Axis:
    return Axis(name, (f"injectors.freeze.{name}",), texts)


def meta(
    axes: Sequence[Axis],
    points: Sequence[Point],
    figures: Sequence[Figure] = (),
    rule: Rule | None = None,
    wanted: int = 0,
    name: str = "knee",
    description: str = "a frozen knee",
    text: str = "name: knee\n",
    store: str = "results/campaigns/knee.sqlite",
    motions: Mapping[Point, float] | None = None,
) -> Meta:
    return Meta(
        name=name,
        description=description,
        file="campaigns/knee.yaml",
        text=text,
        store=store,
        axes=tuple(axes),
        points=tuple(points),
        rule=FixedRuns(3) if rule is None else rule,
        asked="3 runs a point",
        wanted=wanted,
        seed=1,
        figures=tuple(figures),
        command="exo-hil campaign run campaigns/knee.yaml",
        versions={"exo-hil": "0.1.0"},
        motions=motions or {},
    )


def over_duration(
    durations: Sequence[str], values: Mapping[str, Sequence[float]], **others: str
) -> tuple[list[Point], list[RunRow]]:
    """Points over an axis `duration`, and a run for each value, with that RMSE."""
    points = [point(duration=text, **others) for text in durations]
    rows = [
        row(at, number, metrics={RMSE: value})
        for at, text in zip(points, durations, strict=True)
        for number, value in enumerate(values[text])
    ]
    return points, rows
