"""JUnit XML of a campaign: one test suite a point, with its shares as properties and one test case in it.

Properties of a test case are not in the common schema (junit-10.xsd of Jenkins' xunit plug-in), those of a suite are;
hence a suite for each point. A case is an error when runs of the point make no statement, and skipped while it has no
runs. A failed run is a result of the campaign, not a failure of the test.
"""

import re
from collections.abc import Sequence
from typing import Final
from xml.etree.ElementTree import Element, SubElement, indent, tostring

from testbench.campaign.file.rules import FAILURE
from testbench.campaign.records import NO_STATEMENT, Outcome, RunRow
from testbench.campaign.report.measured import EXCEEDED, by_point, count, points_of, stating, words_of
from testbench.campaign.report.meta import Meta
from testbench.campaign.statistics.shares import wilson

_NOT_XML: Final = re.compile("[^\t\n\r\x20-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")
"""Characters XML 1.0 cannot hold, not even escaped (clause 2.2)."""
_MOST_REASONS: Final = 10


def junit_text(rows: Sequence[RunRow], meta: Meta) -> str:
    """The whole document."""
    top = Element("testsuites")
    totals = {"tests": 0, "failures": 0, "errors": 0}
    for point, runs in by_point(rows, points_of(rows, meta)).items():
        suite = _suite(meta, words_of(point), runs)
        top.append(suite)
        for key in totals:
            totals[key] += int(suite.get(key, "0"))
    top.set("name", _clean(meta.name))
    top.set("time", f"{sum(row.wall_s for row in rows):.3f}")
    for key, total in totals.items():
        top.set(key, str(total))
    indent(top)
    return '<?xml version="1.0" encoding="UTF-8"?>\n' + tostring(top, encoding="unicode") + "\n"


def _suite(meta: Meta, point: str, runs: Sequence[RunRow]) -> Element:
    mute = [row for row in runs if row.outcome in NO_STATEMENT]
    suite = Element(
        "testsuite",
        name=_clean(f"{meta.name}: {point}"),
        tests="1",
        failures="0",
        errors=str(int(bool(mute))),
        skipped=str(int(not runs)),
        time=f"{sum(row.wall_s for row in runs):.3f}",
    )
    properties = SubElement(suite, "properties")
    for name, value in _properties(runs).items():
        SubElement(properties, "property", name=name, value=value)
    case = SubElement(suite, "testcase", classname=_clean(meta.name), name=_clean(point), time=suite.get("time", "0"))
    if not runs:
        SubElement(case, "skipped")
    if mute:
        kinds = " and ".join(sorted({row.outcome.value for row in mute}))
        told = f"{len(mute)} of {len(runs)} runs make no statement"
        error = SubElement(case, "error", type=kinds, message=told)
        lines = [f"run {row.number}, seed {row.seed}: {row.outcome.value}: {row.reason}" for row in mute]
        more = [f"and {len(lines) - _MOST_REASONS} more"] if len(lines) > _MOST_REASONS else []
        error.text = _clean("\n".join([*lines[:_MOST_REASONS], *more]))
    return suite


def _properties(runs: Sequence[RunRow]) -> dict[str, str]:
    """Counts of all outcomes; shares 0..1 with their Wilson interval at 95 %, where there is something to divide by."""
    judged = stating(runs)
    found = {"runs": str(len(runs)), "runs_with_statement": str(len(judged))}
    found |= {f"count.{one.value}": str(sum(row.outcome is one for row in runs)) for one in Outcome}
    if judged:
        for what in (FAILURE, EXCEEDED):
            part = count(judged, what)
            interval = wilson(part, len(judged))
            found[f"share.{what}"] = f"{part / len(judged):.6g}"
            found[f"share.{what}.low"] = f"{interval.low:.6g}"
            found[f"share.{what}.high"] = f"{interval.high:.6g}"
    return found


def _clean(text: str) -> str:
    return _NOT_XML.sub("\N{REPLACEMENT CHARACTER}", text)
