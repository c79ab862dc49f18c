"""Campaign files: a scenario, what is varied in it, how many runs, and what is shown of them.

A file is read once, every complaint at once with its place, the scenario's own and those of every point of the grid
included: what `load_campaign` returns can be run. The lists of a file are data, nothing in it is evaluated.
"""

import itertools
import re
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Final, Literal

from pydantic import AfterValidator, Field

from fi_gateway.boundary import Span, SpecModel, Text, validate
from fi_gateway.marked_yaml import (
    Data,
    Document,
    FileErrors,
    Keys,
    Mark,
    did_you_mean,
    load,
    parse,
)
from testbench.campaign.file.axes import Axis, grid, read_axis, size
from testbench.campaign.file.base import base_scenario, check_injectors, check_keys
from testbench.campaign.file.filters import Filter, parse_filter
from testbench.campaign.file.rule_specs import FigureSpec, StopSpec, read_figures, read_rule
from testbench.campaign.file.rules import Figure, FixedRuns, Rule, StopEarly
from testbench.campaign.file.settings import Settings, checked
from testbench.campaign.making.identity import identity, with_seed
from testbench.campaign.plans.combinations import CombinationPlan
from testbench.campaign.plans.search import CombinationSearch, CriticalSearch
from testbench.campaign.records import Point, RunSpec, Wanted
from testbench.scenario import MAX_SEED, Name, Seed

MOST_POINTS: Final = 20_000
MOST_RUNS: Final = 1_000_000

_KEYS: Final = frozenset({"scenario", "axes", "runs", "search", "filter", "traces", "stop_early"})
_SCENARIO_KEYS: Final = frozenset({"rig", "motion", "injectors"})


def _wall(given: int) -> int:
    if given > 24 * 3600 * 10**9:
        raise ValueError("allowed up to 24 h")
    return given


@dataclass(frozen=True, slots=True)
class ReportSpec(SpecModel):
    """What the report shows besides what every report shows."""

    figures: tuple[FigureSpec, ...] = ()


@dataclass(frozen=True, slots=True)
class CampaignFile(SpecModel):
    """The file as written; what has several forms is read in a second step."""

    name: Name
    scenario: object
    description: Text = ""
    changes: Annotated[dict[str, object], Field(alias="set")] = field(default_factory=dict)
    axes: dict[str, object] = field(default_factory=dict)
    together: tuple[tuple[Text, ...], ...] = ()
    filters: Annotated[object, Field(alias="filter")] = ()
    runs: object = None
    search: object = None
    seed: Seed = 1
    stop_early: StopSpec | None = None
    traces: Literal["never", "failures", "always"] = "never"
    time_limit_ns: Annotated[Span, AfterValidator(_wall), Field(alias="time_limit")] = 120 * 10**9
    report: ReportSpec = field(default_factory=ReportSpec)


@dataclass(frozen=True, slots=True)
class Campaign:
    """A campaign that can be run.

    source: the file, as named; text: its content; changes, runs: `--set` and `--runs` on top of it; axes: as in the
    file; points: of the grid, in order, for a search those of the axes it does not move along. texts: point -> resolved
    YAML, seed 0.
    """

    name: str
    description: str
    source: str
    text: str
    changes: tuple[str, ...]
    runs: int | None
    seed: int
    axes: tuple[Axis, ...]
    points: tuple[Point, ...]
    rule: Rule
    stop_early: StopEarly | None
    traces: str
    time_limit_s: float
    figures: tuple[Figure, ...]
    settings: Settings
    texts: dict[Point, str]

    def scenario_text(self, point: Point) -> str:
        """Resolved YAML of a point, seed 0; raises FileErrors for a point of a search that cannot be run."""
        text = self.texts.get(point)
        if text is None:
            text = self.texts[point] = replace(self.settings.scenario(point), seed=0).resolved_yaml()
        return text

    def seed_of(self, wanted: Wanted) -> int:
        """Run k of every point has the same seed, so that points are compared on the same draws."""
        return self.seed + wanted.number

    def identity_of(self, wanted: Wanted, version: str) -> str:
        """Of the run with that code version."""
        stop = self.stop_early
        on, grace_s = (None, 0.0) if stop is None else (stop.on, stop.grace_s)
        return identity(self.scenario_text(wanted.point), self.seed_of(wanted), version, on, grace_s)

    def spec_of(self, wanted: Wanted, version: str, folder: str, fork: bool) -> RunSpec:
        """The run to be made; folder: where result folders of runs are kept."""
        stop, name = self.stop_early, self.identity_of(wanted, version)
        seed = self.seed_of(wanted)
        return RunSpec(
            identity=name,
            wanted=wanted,
            seed=seed,
            scenario=with_seed(self.scenario_text(wanted.point), seed),
            code_version=version,
            stop_on=None if stop is None else stop.on,
            grace_s=0.0 if stop is None else stop.grace_s,
            keep_traces=self.traces,
            folder=str(Path(folder) / name[:16]),
            time_limit_s=self.time_limit_s,
            fork=fork,
        )


def is_campaign(data: Data) -> bool:
    """Whether a file is a campaign: no scenario and no fault file has any of these keys."""
    return isinstance(data, dict) and not _KEYS.isdisjoint(data)


def is_campaign_file(path: Path | str) -> bool:
    """Whether a file can be read and is a campaign."""
    try:
        return is_campaign(load(path).data)
    except FileErrors:
        return False


def load_campaign(path: Path | str, changes: Sequence[str] = (), runs: int | None = None) -> Campaign:
    """The campaign in a file. changes: `key=value` for the scenario; runs: instead of the file's runs per point.

    Raises FileErrors with everything that is wrong.
    """
    document = load(path)
    if isinstance(document.data, dict) and _SCENARIO_KEYS & document.data.keys() and not is_campaign(document.data):
        told = f"this is a scenario; `exo-hil run {path}` runs it, a campaign file names it (docs/campaigns.md)"
        raise FileErrors([f"{path}: {told}"])
    text = Path(path).read_text(encoding="utf-8-sig")
    return campaign_in(document, text, changes, runs)


def parse_campaign(text: str, source: str, changes: Sequence[str] = (), runs: int | None = None) -> Campaign:
    """As load_campaign, from text; a scenario's path counts from the folder of `source`."""
    return campaign_in(parse(text, source), text, changes, runs)


def stored_campaign(text: str, source: str, scenario: str, changes: Sequence[str], runs: int | None) -> Campaign:
    """A campaign that was checked when it was run; scenario: its text then, as the file may be another one by now."""
    return campaign_in(parse(text, source), text, changes, runs, scenario)


def campaign_in(
    document: Document, text: str, changes: Sequence[str], runs: int | None, stored: str | None = None
) -> Campaign:
    """Check shape, then sense, then every point; raises FileErrors.

    stored: text of the scenario, and then the points are not looked at.
    """
    if runs is not None and isinstance(document.data, dict):
        document.values["runs",] = document.keys["runs",] = Mark(1, 0, f"--runs {runs}")
        document.data["runs"] = runs
    whole = validate(CampaignFile, document.data, (), document)
    data = document.data if isinstance(document.data, dict) else {}
    seed = whole.seed if whole is not None else 1
    axes = _read_axes(data.get("axes"), document, seed)
    rule = read_rule(data.get("runs"), data.get("search"), axes, document)
    broken = _names(data.get("axes")) - {axis.name for axis in axes}
    figures = read_figures(whole.report.figures if whole is not None and not broken else (), axes, document)
    base, messages = base_scenario(data, document, changes, stored)
    if isinstance(rule, CombinationSearch):
        check_injectors(rule, base, document)
    check_keys(axes, base, document)
    points = _read_grid(whole, data, axes, rule, document)
    _raise(document, messages)
    assert whole is not None
    assert rule is not None
    settings = Settings(base, tuple(axes), _labels(axes, document))
    texts: dict[Point, str] = {}
    if stored is None:
        messages, texts = checked(settings, _tried_first(points, rule, axes))
        _raise(document, messages)
    stop = whole.stop_early
    return Campaign(
        name=whole.name,
        description=whole.description,
        source=document.source,
        text=text,
        changes=tuple(changes),
        runs=runs,
        seed=whole.seed,
        axes=tuple(axes),
        points=points,
        rule=rule,
        stop_early=None if stop is None else StopEarly(stop.on, stop.grace_ns / 1e9),
        traces=whole.traces,
        time_limit_s=whole.time_limit_ns / 1e9,
        figures=figures,
        settings=settings,
        texts=texts,
    )


def _read_grid(
    whole: CampaignFile | None, data: dict[str, Data], axes: Sequence[Axis], rule: Rule | None, document: Document
) -> tuple[Point, ...]:
    """The points, when everything about them is right; what is not is reported."""
    _check_open(axes, rule, document)
    searched = rule.axis if isinstance(rule, CriticalSearch) else ""
    spanned = [axis for axis in axes if axis.name != searched]
    together = _read_together(whole.together if whole is not None else (), spanned, document)
    broken = _names(data.get("axes")) - {axis.name for axis in axes}
    kept = _read_filters(data.get("filter"), spanned, broken, document)
    seed = whole.seed if whole is not None else 1
    return () if document.problems else _read_points(spanned, together, kept, rule, seed, document)


def _raise(document: Document, messages: Sequence[str]) -> None:
    """Raise what is wrong with the campaign, and with its scenario."""
    try:
        document.raise_problems()
    except FileErrors as error:
        raise FileErrors([*error.messages, *messages]) from None
    if messages:
        raise FileErrors(messages)


def _read_axes(data: Data, document: Document, seed: int) -> list[Axis]:
    axes = []
    for name, given in data.items() if isinstance(data, dict) else ():
        if not name.isidentifier() or name in ("and", "or", "not", "in"):
            text = f"{name!r} is no name for an axis; allowed are letters, digits and _, but not and, or, not, in"
            document.report(("axes", name), text, at_key=True)
            continue
        axis = read_axis(name, given, ("axes", name), document, seed)
        if axis is not None:
            axes.append(axis)
    return axes


def _check_open(axes: Sequence[Axis], rule: Rule | None, document: Document) -> None:
    """Report axes of which only the ends are given and that no search moves along."""
    for axis in axes:
        if axis.is_open and not (isinstance(rule, CriticalSearch) and rule.axis == axis.name):
            text = "two ends are for the axis that search.critical moves along; here give range, linear, log or values"
            document.report(("axes", axis.name, "between"), text, at_key=True)


def _read_together(
    given: Sequence[Sequence[str]], axes: Sequence[Axis], document: Document
) -> tuple[tuple[str, ...], ...]:
    """Groups of axes that go in step."""
    lengths, seen = {axis.name: len(axis.texts) for axis in axes}, set[str]()
    for index, names in enumerate(given):
        at: Keys = ("together", index)
        for name in names:
            if name not in lengths:
                document.report(at, f"there is no axis {name!r}{did_you_mean(name, lengths)}")
            elif name in seen:
                document.report(at, f"axis {name!r} is named twice")
            seen.add(name)
        found = {name: lengths[name] for name in names if name in lengths}
        if len(set(found.values())) > 1:
            told = ", ".join(f"{name} has {length}" for name, length in found.items())
            document.report(at, f"axes that go together need the same number of values; {told}")
    return tuple(tuple(names) for names in given)


def _names(data: Data) -> set[str]:
    return set(data) if isinstance(data, dict) else set()


def _read_filters(data: Data, axes: Sequence[Axis], broken: set[str], document: Document) -> list[Filter]:
    """The filters; those about axes that are wrong themselves are not looked at."""
    values = dict.fromkeys(sorted(broken), ("0",)) | {axis.name: axis.texts for axis in axes}
    filters = []
    items = data if isinstance(data, list) else [] if data is None else [data]
    for index, item in enumerate(items):
        if not broken.isdisjoint(re.findall(r"\w+", str(item))):
            continue
        try:
            filters.append(parse_filter(item, values))
        except ValueError as error:
            document.report(("filter", index) if isinstance(data, list) else ("filter",), str(error))
    return filters


def _read_points(
    axes: Sequence[Axis],
    together: Sequence[Sequence[str]],
    filters: Sequence[Filter],
    rule: Rule | None,
    seed: int,
    document: Document,
) -> tuple[Point, ...]:
    """The grid, when it is not empty and not absurdly large."""
    points = size(axes, together)
    if points > 50 * MOST_POINTS:
        document.report(("axes",), f"that is a grid of {points} points; allowed are {MOST_POINTS}", at_key=True)
        return ()
    kept = tuple(grid(axes, together, filters))
    each = rule.runs if isinstance(rule, FixedRuns) else getattr(rule, "most", 0)
    if not kept:
        document.report(
            ("filter",), f"none of the {points} points is left: the filters exclude each other", at_key=True
        )
    elif len(kept) > MOST_POINTS:
        document.report(("axes",), f"that is a grid of {len(kept)} points; allowed are {MOST_POINTS}", at_key=True)
    elif len(kept) * each > MOST_RUNS:
        text = f"{len(kept)} points with up to {each} runs are {len(kept) * each} runs; allowed are {MOST_RUNS}"
        document.report(("runs",), text, at_key=True)
    elif seed + each > MAX_SEED:
        document.report(("seed",), f"run k has seed {seed} + k; allowed up to {MAX_SEED}")
    return kept


def _tried_first(points: Sequence[Point], rule: Rule, axes: Sequence[Axis]) -> list[Point]:
    """What is looked at before the first run: all points; of a search the ends between which it will move."""
    if isinstance(rule, CriticalSearch):
        found = []
        for point, index in itertools.product(points, (0, rule.steps)):
            texts = {**dict(point.parameters), rule.axis: rule.text(index)}
            found.append(Point(tuple((axis.name, texts[axis.name]) for axis in axes)))
        return found
    if isinstance(rule, CombinationSearch):
        plan, sets = CombinationPlan(rule, points), [(), *((name,) for name in rule.injectors)]
        return [plan.point(point, some) for point, some in itertools.product(points, sets)]
    return list(points)


def _labels(axes: Sequence[Axis], document: Document) -> dict[tuple[str, str], str]:
    """Where each value of each axis stands in the campaign file."""
    labels = {}
    for axis in axes:
        for text, place in zip(axis.texts, axis.places, strict=True):
            mark = document.mark(place)
            labels[axis.name, text] = f"{document.source}:{mark.line}:{mark.column}"
    return labels
