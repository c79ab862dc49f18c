"""The parts of a report that say what the results hang on: gait phase of the fault, and the parameters, ranked."""

from collections.abc import Sequence
from typing import Final

from testbench.campaign.file.rules import FAILURE
from testbench.campaign.records import RunRow
from testbench.campaign.report.markup import Content, Html, table, tag
from testbench.campaign.report.measured import count, is_share, number_at, quantity, stating, value_of
from testbench.campaign.report.meta import Meta
from testbench.campaign.report.sections import bar
from testbench.campaign.report.tables import plain_share
from testbench.campaign.statistics.phases import by_phase
from testbench.campaign.statistics.ranking import Effect, Ranking, rank_parameters
from testbench.campaign.statistics.shares import NotEstimableError

_BINS: Final = 10
_TOGETHER: Final = (
    "All points together; phase 0 is right heel strike. The points have the same seeds, and with drawn times a seed "
    "has its first fault in the same phase everywhere: the number of seeds counts, so there are no intervals here."
)
PHASE: Final = "gait phase of the first fault"


def phase_section(rows: Sequence[RunRow]) -> Html | None:
    """Failures by the gait phase in which the first fault began; None where no run knows one."""
    known = [(row.first_phase, row) for row in stating(rows) if row.first_phase is not None]
    if not known:
        return None
    body: list[list[Content]] = []
    for one in by_phase([(phase, row.outcome) for phase, row in known], FAILURE, _BINS):
        found = [row for phase, row in known if one.low <= phase % 1 < one.high]
        worst = f"{max(row.beyond_deg for row in found):.1f}" if found else "none"
        span = f"{100 * one.low:.0f} to {100 * one.high:.0f} %"
        share = plain_share(one.tally.successes, one.tally.trials)
        seeds = str(len({row.seed for row in found}))
        body.append([span, str(one.tally.trials), seeds, bar(found), share, worst])
    several = sum(row.activated > 1 for _, row in known)
    note = f" In {several} of these {len(known)} runs more than one window of a fault opened." if several else ""
    heads = ("phase", "runs", "seeds", "outcomes", "failed", "worst, deg beyond")
    return tag(
        "section",
        tag("h2", "By gait phase"),
        table("By gait phase of the first fault", heads, body, (0, 3)),
        tag("p", f"{_TOGETHER}{note}", class_="note"),
        id="phase",
    )


def ranking_section(rows: Sequence[RunRow], meta: Meta) -> Html | None:
    """How much of the order of each result a parameter explains by itself; None with nothing that varies."""
    judged = stating(rows)
    names = [PHASE, *(axis.name for axis in meta.axes if len(set(_texts(judged, axis.name))) > 1)]
    results = list(dict.fromkeys((FAILURE, *(one.y for one in meta.figures))))
    parts: list[Html] = []
    for result in results:
        try:
            parts += _ranking(result, ranking(judged, meta, result, names))
        except NotEstimableError as error:
            parts.append(tag("p", f"{_named(result)}: {error}", class_="note"))
    if not judged:
        return None
    note = (
        "Explained: share of the variance of the ranks that the parameter explains, corrected for chance. "
        "Rank correlation: Spearman, its 95 % interval with the seeds as groups; it sees what "
        "rises or falls, eta squared any difference between values; it is left out for a gait phase that was drawn, "
        "which belongs to its seed alone: of that only what rises or falls over the stride is seen. What acts only in "
        "combination is not seen. Runs in which no fault began have no gait phase and are not in here."
    )
    return tag("section", tag("h2", "What matters"), *parts, tag("p", note, class_="note"), id="ranking")


def ranking(judged: Sequence[RunRow], meta: Meta, result: str, names: Sequence[str]) -> Ranking:
    """Parameters ranked for a metric, or for an outcome as 1 and 0; raises NotEstimableError."""
    axes = {axis.name: axis for axis in meta.axes}
    used, values = [], []
    for row in judged:
        value = float(count([row], result)) if is_share(result) else value_of(row, result)
        if value is not None and row.first_phase is not None:
            used.append(row)
            values.append(value)
    columns: dict[str, list[float] | list[str]] = {}
    for name in names:
        if name == PHASE:
            columns[name] = [row.first_phase for row in used if row.first_phase is not None]
            continue
        numbers = [number_at(row.point, axes[name]) for row in used]
        known = [value for value in numbers if value is not None]
        columns[name] = known if len(known) == len(used) else _texts(used, name)
    return rank_parameters(columns, values, [row.seed for row in used])


def _ranking(result: str, found: Ranking) -> list[Html]:
    heads = ("parameter", "values", "explained", "rank correlation", "eta squared")
    made = [table(f"{_named(result)}, {found.n} runs", heads, [_effect(one) for one in found.effects])]
    for pair in found.not_separable:
        text = f"{pair.first} and {pair.second} vary together here: their effects cannot be told apart."
        made.append(tag("p", text, class_="note"))
    return made


def _effect(one: Effect) -> list[Content]:
    if one.strength is None:
        return [one.parameter, str(one.levels), one.reason, "", ""]
    rho = "" if one.rho is None else f"{one.rho:.2f}"
    if one.interval is not None:
        rho += f" ({one.interval.low:.2f} to {one.interval.high:.2f})"
    eta = "" if one.eta_squared is None else f"{one.eta_squared:.2f}"
    return [one.parameter, str(one.levels), f"{max(0.0, 100 * one.strength):.0f} %", rho, eta]


def _named(result: str) -> str:
    words = f"share of runs: {result.replace('_', ' ')}" if is_share(result) else quantity(result).words
    return f"{words[0].upper()}{words[1:]}"


def _texts(rows: Sequence[RunRow], name: str) -> list[str]:
    return [dict(row.point.parameters).get(name, "") for row in rows]
