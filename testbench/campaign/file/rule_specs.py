"""The parts of a campaign file that say how many runs are wanted, what is searched and what is drawn."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, fields
from decimal import Decimal
from typing import Annotated, Final, Literal

from pydantic import BeforeValidator, Field

from fi_gateway.boundary import Count, Share, SpecModel, Text, Time, validate
from fi_gateway.marked_yaml import Data, Document, Keys, did_you_mean
from fi_gateway.quantity import describe_value, format_number
from testbench.campaign.file.axes import Axis
from testbench.campaign.file.rules import FAILURE, OUTCOMES, Figure, FixedRuns, Rule, Until
from testbench.campaign.file.values import common_unit, number_of, text_of
from testbench.campaign.plans.search import CombinationSearch, CriticalSearch
from testbench.campaign.records import RunRow
from testbench.campaign.statistics.shares import outcomes_named
from testbench.document import JointEntry
from testbench.scenario import JOINT_NAMES

MOST_OF_A_POINT: Final = 100_000

RUN_NUMBERS: Final = tuple(
    entry.name
    for entry in fields(RunRow)
    if entry.type in (float, float | None) and entry.name not in ("cpu_s", "forked_s")
)
"""Numbers of a run that a figure may draw."""


def _outcome(given: object) -> str:
    if not isinstance(given, str):
        raise ValueError(f"expected an outcome, such as failure; got {describe_value(given)}")
    outcomes_named(given)
    return given


def _part(given: object) -> float:
    if isinstance(given, bool) or not isinstance(given, int | float) or not 0 < given < 1:
        raise ValueError(f"expected a number between 0 and 1, such as 0.1; got {describe_value(given)}")
    return float(given)


_Outcome = Annotated[str, BeforeValidator(_outcome)]
_Width = Annotated[float, BeforeValidator(_part)]
_Runs = Annotated[Count, Field(le=MOST_OF_A_POINT)]


@dataclass(frozen=True, slots=True)
class StopSpec(SpecModel):
    """When a run is not carried on."""

    on: Literal["failure"]
    grace_ns: Annotated[Time, Field(alias="grace")] = 0


@dataclass(frozen=True, slots=True)
class WidthSpec(SpecModel):
    """A share and how well it is to be known."""

    outcome: _Outcome
    width: _Width


@dataclass(frozen=True, slots=True)
class UntilSpec(SpecModel):
    """As many runs as it takes."""

    until: WidthSpec
    most: _Runs
    batch: _Runs = 20
    least: _Runs = 20


@dataclass(frozen=True, slots=True)
class CriticalSpec(SpecModel):
    """A search along one axis."""

    axis: Text
    tolerance: Annotated[str, BeforeValidator(text_of)]
    outcome: _Outcome = FAILURE
    quantile: Share = 0.5
    method: Literal["bisection", "logistic"] = "bisection"
    batch: _Runs = 10
    most: _Runs = 400


@dataclass(frozen=True, slots=True)
class CombinationsSpec(SpecModel):
    """A search for sets of injectors."""

    injectors: tuple[Text, ...]
    outcome: _Outcome = FAILURE
    runs: _Runs = 5
    most: Count = 2
    least: Count = 1


@dataclass(frozen=True, slots=True)
class SearchSpec(SpecModel):
    """One of the two."""

    critical: CriticalSpec | None = None
    combinations: CombinationsSpec | None = None


@dataclass(frozen=True, slots=True)
class FigureSpec(SpecModel):
    """A figure of the report."""

    x: Text
    y: Text
    low: Annotated[str | None, BeforeValidator(text_of), Field(alias="from")] = None
    high: Annotated[str | None, BeforeValidator(text_of), Field(alias="to")] = None
    fit: Literal["", "quadratic"] = ""
    paper: dict[str, float] = field(default_factory=dict)


def read_rule(runs: Data, search: Data, axes: Sequence[Axis], document: Document) -> Rule | None:
    """`runs` or `search`; None when it is wrong, which the document is told."""
    if (runs is None) == (search is None):
        text = "give one of the two, runs or search" if search is not None else "missing; needed: runs (or search)"
        document.report(("runs",), text, at_key=True)
        return None
    if search is not None:
        return _read_search(search, axes, document)
    if isinstance(runs, dict):
        spec = validate(UntilSpec, runs, ("runs",), document)
        if spec is None:
            return None
        if spec.most < max(spec.least, spec.batch):
            text = f"{spec.most} given; allowed from {max(spec.least, spec.batch)} up, which are least and batch"
            document.report(("runs", "most"), text)
            return None
        return Until(spec.until.outcome, spec.until.width, spec.batch, spec.least, spec.most)
    if isinstance(runs, bool) or not isinstance(runs, int) or not 1 <= runs <= MOST_OF_A_POINT:
        form = "or {until: {outcome: failure, width: 0.1}, batch: 20, most: 400}"
        text = f"expected the number of runs of a point, 1..{MOST_OF_A_POINT}, {form}; got {describe_value(runs)}"
        document.report(("runs",), text)
        return None
    return FixedRuns(runs)


def _read_search(data: Data, axes: Sequence[Axis], document: Document) -> Rule | None:
    spec = validate(SearchSpec, data, ("search",), document)
    if spec is None:
        return None
    if (spec.critical is None) == (spec.combinations is None):
        document.report(("search",), "expected one of critical, combinations", at_key=True)
        return None
    try:
        if spec.combinations is not None:
            one = spec.combinations
            return CombinationSearch(one.injectors, one.outcome, one.runs, one.most, one.least)
        assert spec.critical is not None
        return _critical(spec.critical, axes, document)
    except ValueError as error:  # which key it is about, the message says
        kind = "critical" if spec.combinations is None else "combinations"
        document.report(("search", kind), str(error), at_key=True)
        return None


def _critical(spec: CriticalSpec, axes: Sequence[Axis], document: Document) -> CriticalSearch | None:
    """The search along an axis, in the axis's unit; raises ValueError."""
    at: Keys = ("search", "critical")
    axis = next((axis for axis in axes if axis.name == spec.axis), None)
    if axis is None:
        names = [axis.name for axis in axes]
        told = f"there is no axis {spec.axis!r}{did_you_mean(spec.axis, names)} (axes: {', '.join(names) or 'none'})"
        document.report((*at, "axis"), told)
        return None
    ordered = sorted((number.value, text) for text in axis.texts if (number := axis.number(text)) is not None)
    if len(ordered) < 2:
        text = f"{spec.axis} has no two numbers to search between; give its ends: between: {{from: ..., to: ...}}"
        document.report((*at, "axis"), text)
        return None
    numbers, unit = common_unit((ordered[0][1], ordered[-1][1], spec.tolerance))
    low, high, tolerance = (Decimal(format_number(number)) for number in numbers)
    return CriticalSearch(
        axis=spec.axis,
        low=low,
        high=high,
        tolerance=tolerance,
        unit=unit,
        outcome=spec.outcome,
        quantile=spec.quantile,
        method=spec.method,
        batch=spec.batch,
        most=spec.most,
    )


def read_figures(given: Sequence[FigureSpec], axes: Sequence[Axis], document: Document) -> tuple[Figure, ...]:
    """The figures of the report, each about an axis that there is and something that is measured."""
    known = {axis.name: axis for axis in axes}
    measured = (*(f"{joint}.{name}" for joint in JOINT_NAMES for name in JointEntry.__annotations__), *RUN_NUMBERS)
    allowed = (*measured, *OUTCOMES)
    figures = []
    for index, spec in enumerate(given):
        at: Keys = ("report", "figures", index)
        if spec.y not in allowed:
            text = f"unknown quantity {spec.y!r}{did_you_mean(spec.y, allowed)} (allowed: JOINT.QUANTITY as in the"
            document.report((*at, "y"), f"{text} document of a run, {', '.join((*RUN_NUMBERS, *OUTCOMES))})")
        axis = known.get(spec.x)
        if axis is None:
            names = ", ".join(known) or "none"
            document.report((*at, "x"), f"there is no axis {spec.x!r}{did_you_mean(spec.x, known)} (axes: {names})")
            continue
        numbers = {key: _on_axis(spec, key, axis, (*at, key), document) for key in ("low", "high")}
        paper = [(_number(text, axis, (*at, "paper", text), document), y) for text, y in spec.paper.items()]
        low, high = numbers["low"], numbers["high"]
        figures.append(Figure(spec.x, spec.y, low, high, spec.fit, tuple(paper)))
    return tuple(figures)


def _on_axis(spec: FigureSpec, key: str, axis: Axis, at: Keys, document: Document) -> float:
    text, otherwise = (spec.low, -math.inf) if key == "low" else (spec.high, math.inf)
    place = (*at[:-1], "from" if key == "low" else "to")
    return otherwise if text is None else _number(text, axis, place, document)


def _number(text: str, axis: Axis, at: Keys, document: Document) -> float:
    """A value of an axis in SI; reported when it is none."""
    number = number_of(text)
    if number is None or number.unit != axis.unit or axis.cases:
        example = axis.texts[0]
        document.report(at, f"{text!r} is no value of axis {axis.name}, whose values are such as {example!r}")
        return math.nan
    return number.value
